# %% [markdown]
# ## Exercise 1
#
# The weights depend on distance alone, so all models share them. The mean was fitted to the same
# errors, so they lie closer to it than to the true mean: with equal weights $1/M$, dividing by $1 -
# 1/M$ is the usual $M - 1$.


# %%
def pooled(distances, errors, z):
    """Return mean (ft), variance (ft^2) and the number of pictures that count."""
    k = np.exp(-0.5 * (np.log(distances / z) / 0.3) ** 2)
    a, r = k / k.sum(), errors / distances
    mean = a @ r
    variance = a @ (r - mean) ** 2 / (1 - a @ a)
    return z * mean, z**2 * variance, 1 / (a @ a)


# %% [markdown]
# ## Exercise 2
#
# A fold took no part in the choice, so its judgement carries none of the luck. It is noisy, and the
# schedule rests on four fifths of the pictures only; but what was promised too much by 20 bins
# shows, and how little by the kernel. 2,000 new pictures say the same.


# %%
def cross_fit(folds, fit=None):
    """Return the mean promised and the mean judged total cost; use posed and ms.solve."""
    pairs = []
    for k, fold in enumerate(folds):
        best = ms.solve(posed(np.concatenate([*folds[:k], *folds[k + 1 :]]), fit))
        pairs.append((best.cost, posed(fold, fit).total_cost(best.choices)))
    return np.mean(pairs, axis=0)


# %% [markdown]
# ## Exercise 3
#
# Too narrow: few pictures count at each step, so the optimum picks lucky ones, and promises least
# just where it is worst. Too wide: all distances count alike, so that $r$ is blurred into one number
# a model, and what differs near and far is lost; its promise is wrong, but not by luck. More pictures
# would cure the first, and not the second.


# %%
def too_narrow_too_wide():
    """Return two widths, and a sentence that explains what goes wrong with each."""
    why = "Too narrow a kernel leaves so few pictures that luck chooses; too wide a one blurs distances."
    return 0.03, 5.0, why
