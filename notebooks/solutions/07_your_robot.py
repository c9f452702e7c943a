# %% [markdown]
# ## Exercise 1
#
# A residual is what was reported less the truth, NaN where nothing was. `ravel` goes along rows,
# look by look, so models are tiled and altitudes repeated.


# %%
def residuals_of(names, altitude, truth, reports):
    """Return the Residuals of a log."""
    N, W = reports.shape
    model = np.tile(np.arange(W), N)
    return pc.Residuals(names, model, np.repeat(altitude, W), (reports - truth[:, None]).ravel())


# %% [markdown]
# ## Exercise 2
#
# A price of infinity locks a model out. On the drone the pair is 1 and 5, at 6.54: not the two that
# are best alone, 5 and 4, but the best and the one that errs the other way.


# %%
def best_pair(problem):
    """Return (v, w), v < w, and the least cost of schedules that use no other model."""
    H, W, _ = problem.mean.shape
    found = []
    for v in range(W):
        for w in range(v + 1, W):
            price = np.full((H, W), np.inf)
            price[:, [v, w]] = np.broadcast_to(problem.model_cost, (H, W))[:, [v, w]]
            if np.isfinite(price).any(axis=1).all():  # else a step has no model
                found.append((ms.solve(replace(problem, model_cost=price)).cost, (v, w)))
    cost, pair = min(found)
    return pair, cost


# %% [markdown]
# ## Exercise 3
#
# They do not uncouple. No detector measures the speed, so the filter takes it from how heights
# differ: two errors of opposite sign look like speed, and the controller brakes against it. A
# constant bias looks like speed at the start only.


# %%
def restless():
    """Return a gust (ft/s^2), and a sentence."""
    why = (
        "the filter takes the speed from differences of heights, which errors of opposite sign in "
        "turn make large, and a constant bias at the start only"
    )
    return 100.0, why
