# %% [markdown]
# ## Exercise 1
#
# Within a run only $n$ varies: its variance, with $H - 1$ freedoms, is $\sigma^2$ on average. The
# mean of a run varies by $\tau^2 + \sigma^2 / H$ from run to run. The difference may come out
# negative in one sample; cut off at 0 it would be too large on average.


# %%
def split(residuals):
    """Return estimates of b, tau squared and sigma squared without bias."""
    means = residuals.mean(axis=1)
    sigma_squared = residuals.var(axis=1, ddof=1).mean()
    tau_squared = means.var(ddof=1) - sigma_squared / residuals.shape[1]
    return means.mean(), tau_squared, sigma_squared


# %% [markdown]
# ## Exercise 2
#
# One more step costs model $w$ another $\tau_w^2 (2n_w + 1)$, which rises with $n_w$: a sum of
# convex functions of single counts. Exchanging a step between two models then never helps once the
# least increment was taken each time. Without integers $n_w \propto 1/\tau_w^2$: the steadier a
# model, the more steps, but every model gets some. (In the selection problem itself greedy is wrong
# as its steps differ, and as one choice changes the price of all others.)


# %%
def portfolio_counts(tau_squared, H):
    """Return how many of H steps each model should run, an integer array (W,)."""
    counts = np.zeros(len(tau_squared), dtype=int)
    for _ in range(H):
        counts[np.argmin(tau_squared * (2 * counts + 1))] += 1
    return counts


# %% [markdown]
# ## Exercise 3
#
# Thrust ten thousand times as dear as position: the robot spreads its answer to a push over many
# steps beforehand, so that errors far apart meet in the same commands. With $a$ the closed loop,
# near 1 here, and a long horizon the factor nears $(1 + a)/(1 - a)$. A very heavy end
# lowers it: the last error alone is dear. A stable $A$ makes errors die out and the factor fall.


# %%
def patient():
    """Return a ControlTask on which a bias costs 15 times as much as noise, and a sentence."""
    task = ms.ControlTask([[1]], [[1]], [[1]], [[1]], [[10_000]], 300)
    return task, "dear thrust spreads the bracing over many steps, where errors far apart meet"
