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
# The largest value of $e^\top \Psi e$ over unit vectors is the largest eigenvalue of $\Psi$,
# reached at its eigenvector: the last column of what `eigh` returns. Entry $r$ of step $t$ stands
# at place $tp + r$, which is what `reshape(H, p)` undoes.


# %%
def worst_error(task, information):
    """Return errors (H, p) of unit sum of squares with the largest regret."""
    _, vectors = np.linalg.eigh(psi(task, information))
    return vectors[:, -1].reshape(task.horizon, task.p)


# %% [markdown]
# ## Exercise 3
#
# The seas are all sign patterns. Both roll-outs use the same sea and the same controller; only what
# it is fed differs. Averaging over *all* seas makes the terms between $s$ and $e$ vanish exactly.


# %%
def expected_regret(task, e, information):
    """Return the regret of errors e (H, p), averaged over all seas of -1 and 1."""
    seas = np.array(list(product((-1.0, 1.0), repeat=e.size))).reshape(-1, *e.shape)
    rest = np.zeros(task.n)
    fed = control_cost(task, *run_controller(task, rest, seas, seas + e, information))
    true = control_cost(task, *run_controller(task, rest, seas, seas, information))
    return (fed - true).mean()


# %% [markdown]
# ## Exercise 4
#
# Replay the drive under each pattern and keep the one whose commands are nearest. Comparing all
# commands matters: `open_loop` and `preview` give the same first command, since neither has seen
# anything yet.


# %%
def identify(task, x0, s, s_hat, controls):
    """Return the information pattern under which run_controller gives these controls."""

    def misfit(information):
        return np.abs(run_controller(task, x0, s, s_hat, information)[1] - controls).max()

    return min(INFORMATION, key=misfit)
