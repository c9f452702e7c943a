# %% [markdown]
# ## Exercise 1
#
# The list is a stack, so this goes deep first and soon has a good schedule; `branch_and_bound`
# takes the table of lowest bound next, which needs the fewest relaxations but a queue. Every
# schedule is in some table, and a table is dropped only if its bound, or its only schedule, is no
# better than the best.


# %%
def branch(problem):
    """Return choices (H,), cost and the number of relaxations."""
    best, cost, count = None, np.inf, 0
    tables = [np.ones(problem.mean.shape[:2], dtype=bool)]
    while tables:
        allowed, count = tables.pop(), count + 1
        point = ms.relax_interior_point(problem, allowed=allowed, ceiling=cost)
        choices = np.where(allowed, point.weights, -1).argmax(axis=1)
        if problem.total_cost(choices) < cost:
            best, cost = choices, problem.total_cost(choices)
        undecided = allowed.sum(axis=1) > 1
        if point.bound >= cost * (1 - 1e-9) or not undecided.any():
            continue
        step = np.where(undecided, point.weights.max(axis=1), np.inf).argmin()
        for model in np.flatnonzero(allowed[step]):
            child = allowed.copy()
            child[step] = np.arange(len(child[step])) == model
            tables.append(child)
    return best, cost, count


# %% [markdown]
# ## Exercise 2
#
# The cheapest way to model $w$ at step $t$ comes from some model $v$: $F_{tw} = G_{tw} + \min_v
# (F_{t-1,v} + \beta\sigma_{vw})$. Without arcs the minimum is the same for all $w$, and $F$ adds
# up $\min_w G_{tw}$.


# %%
def path_bound(problem, d):
    """Return the cheapest path of nodes G and arcs, less d'Psi d."""
    pull = problem.quadratic @ d
    G = 2 * problem.mean[:, :, 0] * pull[:, None] + problem.linear
    cheapest = G[0]
    for node in G[1:]:
        cheapest = node + (cheapest[:, None] + problem.beta * problem.switch_cost).min(axis=0)
    return cheapest.min() - d @ pull


# %% [markdown]
# ## Exercise 3
#
# One step is enough. Model 0 is free and errs by 1, model 1 costs 1 and errs by 0.01: either
# costs 1. Half of each errs by 0.5 and costs about $0.25 + 0.5$: a blend need not cancel errors
# to gain, as the square is convex and the price of accuracy is linear. With more models between
# 0.01 and 1 the gap would close. That the published problem has none is a fact of its numbers,
# not of its signs.


# %%
def one_sign():
    """Return ms.SelectionProblem(psi, mean, variance, model_cost) and why it has a gap."""
    problem = ms.SelectionProblem([[1.0]], [[[1.0], [0.01]]], [[[0.0], [0.0]]], [0.0, 1.0])
    return problem, "the square of a blended error lies below the line between its two ends"
