# %% [markdown]
# ## Exercise 1
#
# With the other rows fixed, the expectation is the average over $w$, with chances $b_{tw}$, of the
# expectations with row $t$ at corner $w$. The least of these is at most their average, so no step
# raises the expectation. After the last step every row is a corner, there is nothing left to draw,
# and the expectation is the cost of the schedule.


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
# ## Exercise 2
#
# Let model 0 err by 0 and model 1 by $a_t$, and let both err by minus the target at one more step.
# Under $\Psi = \mathbf{1}\mathbf{1}^\top$ a schedule costs (chosen sum - target)$^2$: 0 exactly if
# the chosen integers add up to it. The problem is written down in polynomial time, so
# SUBSET SUM is no harder than selection.


# %%
def subset_problem(integers, target):
    """Return a SelectionProblem whose optimum is 0 exactly if a subset adds up to the target."""
    mean = np.array([[0, a] for a in integers] + [[-target, -target]], dtype=float)[:, :, None]
    H = len(mean)
    return ms.SelectionProblem(np.ones((H, H)), mean, 0 * mean, [0, 0])


# %% [markdown]
# ## Exercise 3
#
# Let $\Psi = \mathbf{1}\mathbf{1}^\top$, and let every step have the same two models, $+1$ and
# $-1.5$. The relaxation blends them 3 : 2, so that nothing is left. Rounding takes $+1$
# everywhere: the errors add up, at a cost of $H^2$. Draws are independent, so only variances add
# up: $1.5 H$. (The relaxation has many optima here; a method may return another one. A trifle of
# $\Psi_{tt}$ makes it unique.) Exercise 1 does not round: each of its choices answers to those
# before it. And with two of five steps at $-1.5$ a schedule costs almost nothing.


# %%
def lucky():
    """Return a SelectionProblem where drawing beats rounding, and a sentence that says why."""
    H = 20
    mean = np.tile([[1.0], [-1.5]], (H, 1, 1))
    psi = np.ones((H, H)) + 0.01 * np.eye(H)
    problem = ms.SelectionProblem(psi, mean, 0 * mean, [0, 0])
    return problem, "rounding errs on the same side at every step, independent draws average out"
