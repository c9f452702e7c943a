# %% [markdown]
# ## Exercise 1
#
# A reduction is measured by what there was before: $100\,(\mathrm{old} - \mathrm{new}) /
# \mathrm{old}$. Positive costs cannot fall by more than 100%. Dividing by the new cost gives what
# the old one costs *more*, and that has no upper limit: 85.0% becomes 567%, 27.6% becomes 38%.


# %%
def reduction(new, old):
    """Percent by which new is lower than old."""
    return 100 * (old - new) / old


# %% [markdown]
# ## Exercise 2
#
# Both policies meet the same errors: a trial that is bad for one tends to be bad for the other.
# In the difference, what they share drops out, and the interval is that of one sample, of
# differences. Two intervals combined as if independent would count the shared luck twice.


# %%
def paired(a, b):
    """Mean difference over trials, and half of its 95% interval."""
    return np.mean(a - b), landing.half_width(a - b)


# %% [markdown]
# ## Exercise 3
#
# Row $k$ of the table is the schedule with $k$ steps of the first model: step $t$ runs it exactly
# if $t < k$. There are only $H + 1$ such schedules, so one tries them all.


# %%
def best_switch(problem, first, last):
    """Return the number of steps for which to run `first` before `last`."""
    H = problem.mean.shape[0]
    early = np.arange(H) < np.arange(H + 1)[:, None]
    return int(problem.total_cost(np.where(early, first, last)).argmin())


# %% [markdown]
# ## Exercise 4
#
# The schedule is chosen in a world without noise, but flown in the real one, so its cost is that of
# the true problem. On the published suite the noise is about 0.1% of the extra control cost and
# differs little between the models: ignoring it changes next to nothing.


# %%
def price_of_no_variance(problem):
    """Relative extra cost of the schedule that ignores the variances."""
    naive = solve(replace(problem, variance=0 * problem.variance))
    return problem.total_cost(naive.choices) / solve(problem).cost - 1


# %% [markdown]
# ## Exercise 5
#
# If All Small is optimal at some price, it is at every higher one: it is the only schedule whose
# cost does not rise. So there is one threshold, and bisection finds it. Prices span four orders of
# magnitude, hence the geometric mean. Twelve halvings leave a ratio of $10^{4/4096}$, 0.2%.


# %%
def threshold(problem):
    """Return the lowest price Upsilon at which All Small is optimal, to 1%."""
    low, high = 1e10, 1e14
    for _ in range(12):
        middle = (low * high) ** 0.5
        if solve(replace(problem, model_cost=middle * np.arange(8))).choices.any():
            low = middle
        else:
            high = middle
    return high
