# %% [markdown]
# ## Exercise 1
#
# All commands do the same work at the same price, so they are equal. With $z = x_0 + \sum_t s_t$
# the plan minimises $(z + Hu)^2 + rHu^2$, so $u^* = -z/(H + r)$. Fed wrong estimates, each command
# is off by $d = -\varepsilon/(H + r)$ with $\varepsilon = \sum_t e_t$. At a minimum the linear term
# vanishes, and the regret is $(H^2 + rH)d^2 = \frac{H}{H + r}\varepsilon^2$.


# %%
def gain(horizon, price):
    """Return g as a Fraction; horizon is an int, price a Fraction."""
    return Fraction(horizon) / (horizon + price)


# %% [markdown]
# ## Exercise 2
#
# Step $t$ pays what it pays under preview, for the errors of its own forecast. There the rows and
# columns of $k < t$ are 0: nobody uses a forecast of the past. If all forecasts are the same, the
# sum is preview's $e^\top \Psi e$.


# %%
def mpc_regret(task, forecasts):
    """Return the regret of a controller that plans anew from each step's own forecast."""
    errors = forecasts.reshape(task.horizon, -1)
    return sum(e @ pays @ e for e, pays in zip(errors, psi_by_step(task, "preview"), strict=True))


# %% [markdown]
# ## Exercise 3
#
# A robot that forgets, $A = 0.5$, and is charged for its end alone: an early push has died out by
# then, by itself, so a good plan does not answer it. A late one counts in full. Where states do not
# die out, an open-loop plan pays for an early error in every later state that is charged, and the
# last is seldom dearer.


# %%
def late_is_dear():
    """Return a ControlTask, and a sentence that explains its dear last error."""
    task = ms.ControlTask([[0.5]], [[1]], [[1]], [[0]], [[1]], 10, Q_final=[[1]])
    return (
        task,
        "early pushes die out before the only state that is charged, so nobody answers them",
    )
