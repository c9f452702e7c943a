# %% [markdown]
# ## Exercise 1
#
# After the third step nothing has been assumed about independence:
# $E[e^\top \Psi e] = \mu^\top \Psi \mu + \mathrm{tr}(\Psi S)$. For symmetric matrices the trace of
# the product is the sum of the products of their entries.


# %%
def expected_regret(Psi, mean, covariance):
    """Return E[e'Psi e] for errors with this mean (pH,) and covariance (pH, pH)."""
    return mean @ Psi @ mean + (Psi * covariance).sum()


# %% [markdown]
# ## Exercise 2
#
# A constant bias costs $b^2\, \mathbf 1^\top \Psi \mathbf 1$, the sum of all entries. Independent
# noise costs $\sigma^2\, \mathrm{tr}\,\Psi$, the sum of the diagonal. Equate and take the root.


# %%
def break_even_bias(Psi, sigma):
    """Return the constant bias that costs as much as independent noise of deviation sigma."""
    return sigma * np.sqrt(np.trace(Psi) / Psi.sum())


# %% [markdown]
# ## Exercise 3
#
# Two opposite errors of nearly equal size. Step by step the smaller one always wins, and its errors
# add up; run in turn, the two nearly cancel.

# %%
fooling_means = np.tile([[1.0], [-1.1]], (6, 1, 1))
fooling_prices = [0, 0]


# %% [markdown]
# ## Exercise 4
#
# At step $t$ the coin's error has mean $m_t = \sum_w b_{tw} \mu_{tw}$ and variance
# $\sum_w b_{tw} (\mu_{tw} - m_t)^2$: the models' own errors do not vary, but which of them strikes
# does. Steps are independent, so the formula of this notebook applies to these moments. The added
# variance is what a coin pays and a blend does not.


# %%
def price_of_a_coin(problem, weights):
    """Return the expected total cost of drawing models with these probabilities (H, W)."""
    mu, b = problem.mean[:, :, 0], np.asarray(weights)
    m = (b * mu).sum(axis=1)
    variance = (b * (mu - m[:, None]) ** 2).sum(axis=1)
    control = m @ problem.psi @ m + problem.psi.diagonal() @ variance
    return problem.alpha * control + problem.beta * (b @ problem.model_cost).sum()
