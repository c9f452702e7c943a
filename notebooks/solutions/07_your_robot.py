# %% [markdown]
# ## Exercise 1
#
# The crane computes once and never looks: `open_loop`. The walker knows its state and this step's
# ground, nothing later: `causal`. The racer knows its state and all angles ahead: `preview`. The
# drone's network measures a component of the state, which is fed back as it is: `measurement`.

# %%
patterns = {
    "crane": "open_loop",
    "walker": "causal",
    "racer": "preview",
    "drone": "measurement",
}

# %% [markdown]
# ## Exercise 2
#
# The gust enters as the control does, so $C = B$: within a step, a constant acceleration $a$
# changes the climb rate by $a\,dt$ and the height by $a\,dt^2/2$.


# %%
def quadrotor_axis(dt, horizon):
    """Return the ControlTask of one axis of a quadrotor."""
    A = np.array([[0.0, 1.0], [0.0, 0.0]])
    BC = np.array([[0.0, 0.0], [1.0, 1.0]])
    A, BC, *_ = cont2discrete((A, BC, np.eye(2), np.zeros((2, 2))), dt)
    Q = np.diag([1 / 0.1**2, 1 / 0.5**2])
    return ControlTask(A, BC[:, :1], BC[:, 1:], Q, [[1 / 2.0**2]], horizon)


# %% [markdown]
# ## Exercise 3
#
# Energies at every step, then `inf` down the columns of models that are too slow, and in the last
# column at the steps between the cool ones.


# %%
def prices_with_gaps(energy, latency, step_ms, horizon, every):
    """Return prices (H, W) in J, inf where a model is not available."""
    prices = np.tile(np.asarray(energy, dtype=float), (horizon, 1))
    prices[:, np.asarray(latency) > step_ms] = np.inf
    prices[np.arange(horizon) % every != 0, -1] = np.inf
    return prices


# %% [markdown]
# ## Exercise 4
#
# With $k_{tw}$ the control cost of model $w$ at step $t$ alone, the last model $w$ beats model $v$
# as long as $k_{tw} + \beta\kappa_w \le k_{tv} + \beta\kappa_v$, so for $\beta$ up to
# $(k_{tv} - k_{tw}) / (\kappa_w - \kappa_v)$. It must beat every $v$: the minimum over models. One
# step is enough: the maximum over steps.


# %%
def worth_it(problem):
    """Return the largest beta at which the last model is used."""
    alone = stepwise_cost(replace(problem, beta=0))
    price = problem.model_cost
    limits = (alone[:, :-1] - alone[:, -1:]) / (price[-1] - price[:-1])
    return limits.min(axis=1).max()


# %% [markdown]
# ## Exercise 5
#
# Without its bias the model is another one, so the problem is another one and is solved again. For
# the floor camera *small* is the one to calibrate. Calibrating *medium* is worth **less than
# nothing**: its bias cancelled that of *small*, and taking it away leaves the other alone.


# %%
def calibration_worth(problem, model):
    """Return how much lower the optimal cost is once this model has no bias."""
    mean = problem.mean.copy()
    mean[:, model] = 0
    return solve(problem).cost - solve(replace(problem, mean=mean)).cost
