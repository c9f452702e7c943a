# %% [markdown]
# ## Exercise 1
#
# The sum $\sum_{t,w} G_{tw}(b_{tw} - b'_{tw})$ is largest where $\sum_w G_{tw} b'_{tw}$ is least,
# step by step. A linear function over a simplex is least at a corner, so that least value is
# $\min_w G_{tw}$, and the gap is $\sum_t (\sum_w G_{tw} b_{tw} - \min_w G_{tw})$.

# %%
def frank_wolfe_gap(problem, b):
    """Return the duality gap of the relaxation at the weights b (H, W), a float."""
    H, _, p = problem.mean.shape
    d = np.einsum("tw,twi->ti", b, problem.mean).ravel()
    pull = (problem.quadratic @ d).reshape(H, p)
    G = 2 * np.einsum("twi,ti->tw", problem.mean, pull) + problem.linear
    return float((G * b).sum() - G.min(axis=1).sum())


# %% [markdown]
# ## Exercise 2
#
# On the line $x_0 + x_1 = 1$ the nearest point takes $h = (v_0 + v_1 - 1)/2$ from both entries,
# so $c = v_1 - h = (1 + v_1 - v_0)/2$. The simplex is the part of that line with $0 \le c \le 1$,
# and the squared distance along the line is $2(c - c^*)^2$ plus a constant: the nearest point of
# the segment is $c^*$ clipped.


# %%
def project_pair(v):
    """Return c (...) such that (1 - c, c) is the point of the simplex nearest to v (..., 2)."""
    return np.clip((1 + v[..., 1] - v[..., 0]) / 2, 0, 1)


# %% [markdown]
# ## Exercise 3
#
# With the other rows fixed, the expectation is the average over $w$, with chances $b_{tw}$, of
# the expectations with row $t$ at corner $w$. The least of these is at most their average, so no
# step raises the expectation. After the last step every row is a corner, there is nothing left to
# draw, and the expectation is the cost of the schedule.


# %%
def derandomise(problem, b):
    """Return choices (H,) that cost no more than a draw with chances b (H, W) on average."""
    b = np.array(b)
    for t in range(len(b)):
        tried = []
        for corner in np.eye(b.shape[1]):
            b[t] = corner
            tried.append(expected_draw(problem, b))
        b[t] = np.eye(b.shape[1])[np.argmin(tried)]
    return ms.from_one_hot(b)


# %% [markdown]
# ## Exercise 4
#
# A schedule costs $\frac{H}{1+H}$ times the squared signed sum, plus less than half of
# $\frac{H}{1+H}$. The signed sum is an integer: if it is zero the cost is below $\frac{H}{1+H}$,
# otherwise at least $\tfrac12$. In the first case the steps of model 0 (sign $+$) and those
# of model 1 (sign $-$) balance.


# %%
def halves(integers):
    """Return two lists of equal sum that share out the integers, or None if there are none."""
    schedule = ms.solve(ms.partition_problem(integers))
    if schedule.cost > 0.375:  # well between the two cases, so rounding cannot matter
        return None
    plus, minus = ([a for a, w in zip(integers, schedule.choices, strict=True) if w == side]
                   for side in (0, 1))  # fmt: skip
    return plus, minus
