# %% [markdown]
# ## Exercise 1
#
# A schedule that uses model $w$ at step $t$ costs at least $LB(d) + r_{tw}$. It can be cheaper than
# the given one only if $LB(d) + r_{tw} < \mathrm{cost}$. The reduced costs belong to $LB(d)$ at
# $d$ = `schedule.reference`, which is what `reference_bound` returns with them;
# `schedule.lower_bound` may lie above it, proved by a search, and would rule out too much.


# %%
def ruled_out(problem, schedule):
    """Return which entries (H, W) no schedule cheaper than this one can use."""
    bound, reduced = ms.reference_bound(problem, schedule.reference)
    return reduced >= schedule.cost - bound


# %% [markdown]
# ## Exercise 2
#
# $LB(d) = \sum_t \min_w G_{tw}(d) - d^\top M d$. Where schedule $c$ alone attains the minima, the
# slope is $2M\mu_c - 2Md$, so towards $\mu_c$ the bound rises at first (by twice the squared length
# of $\mu_c - d$ under $M$). Frank and Wolfe's step lengths $2/(k+2)$ make $d$ an average of
# means of schedules, hence the mean of a relaxation, and the bound converges to the top at a rate
# of $1/k$.


# %%
def climb(problem, steps):
    """Return the reference point (pH,) of the highest bound seen in so many rounds."""
    d = problem.chosen_mean(np.zeros(len(problem.mean)))
    bound, reduced = ms.reference_bound(problem, d)
    best, highest = d, bound
    for k in range(steps):
        d = d + 2 / (k + 2) * (problem.chosen_mean(reduced.argmin(axis=1)) - d)
        bound, reduced = ms.reference_bound(problem, d)
        if bound > highest:
            best, highest = d, bound
    return best


# %% [markdown]
# ## Exercise 3
#
# Add $\Delta - x_j$ to both sides of $x_i + 2\rho\sqrt{\Delta - x_j} + \rho^2 \le x_j$. The left
# side becomes $x_i$ plus a square: $x_i + (\rho + \sqrt{\Delta - x_j})^2 \le \Delta$. Move $x_i$ across
# and take roots: $\rho + \sqrt{\Delta - x_j} \le \sqrt{\Delta - x_i}$. The distance of the centres
# plus the radius of $j$ is at most the radius of $i$: the ball of $j$ lies inside the ball of $i$.


# %%
def dominates(x_i, y_i, x_j, y_j, budget):
    """Return whether all that label j can still afford, label i can afford as well."""
    rho = np.linalg.norm(np.asarray(y_i) - np.asarray(y_j))
    return bool(rho + np.sqrt(budget - x_j) <= np.sqrt(budget - x_i))


# %% [markdown]
# ## Exercise 4
#
# Walk from the node to the root and write down what each node on the way has fixed. No step occurs
# twice, as a step that is fixed has one model left and is not split again. The audit then
# finds what a bound means: no schedule below the node costs less than the bound, or than the
# incumbent of that moment if that is smaller, because models that cannot beat the incumbent were
# forbidden.


# %%
def path(tree, k):
    """Return {step: model} of the choices made at node k and above it."""
    choices = {}
    while tree[k].parent >= 0:
        choices[tree[k].step] = tree[k].model
        k = tree[k].parent
    return choices
