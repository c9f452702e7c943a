# %% [markdown]
# ## Exercise 1
#
# From the distance $z$ the pad is $w = S \cdot \mathrm{PAD} / (\mathrm{TANGENT} \cdot z)$ pixels
# wide, so one pixel means $z / w = z^2 \cdot \mathrm{TANGENT} / (S \cdot \mathrm{PAD})$ feet: the
# square of the distance. Solve for $z$; the drone is `MOUNT` lower. Twice the pixels carry only
# $\sqrt{2}$ times as far.


# %%
def highest(side, feet):
    """Return the altitude at which one pixel means an error of this many feet."""
    return (feet * side * PAD / TANGENT) ** 0.5 - MOUNT


# %% [markdown]
# ## Exercise 2
#
# Each weight of a layer is used once in every window, and a layer with $k$ by $k$ windows on $S$
# by $S$ places has $(\lfloor (S - k)/2 \rfloor + 1)^2$ of them. The third layer has a single
# window over all $P^2$ places with `2 * filters` numbers each.


# %%
def work(side, filters, width):
    """Return the multiplications for one picture."""
    first = (side - 4) // 2 + 1
    second = (first - 3) // 2 + 1
    total = first**2 * 16 * filters
    total += second**2 * (9 * filters) * (2 * filters)
    total += second**2 * (2 * filters) * width
    return total + width


# %% [markdown]
# ## Exercise 3
#
# The mean is measured on the same residuals from which the squares are taken, so they lie closer
# to it than to the true mean: dividing by $n - 1$ (`ddof=1`) corrects that. A mean of $n$
# independent errors of variance $v$ has the variance $v/n$.


# %%
def bin_moments(residuals, w, low, high):
    """Return mean, unbiased variance, and standard error of the mean."""
    inside = (residuals.altitude >= low) & (residuals.altitude < high)
    r = residuals.residual[inside & (residuals.model == w)]
    variance = r.var(ddof=1)
    return r.mean(), variance, np.sqrt(variance / len(r))


# %% [markdown]
# ## Exercise 4
#
# All models are equal, so the measured cost of the chosen one differs from its true cost by the
# smallest of $W$ errors. For $W = 8$ its mean is about $-1.42$: the promise is too good by 1.4
# standard errors, although every single measurement is unbiased. 200,000 draws bring the error of
# the simulated mean below 0.003.


# %%
def expected_promise(W):
    """Return the mean of the smallest of W standard normal errors."""
    errors = np.random.default_rng(0).standard_normal((200_000, W))
    return errors.min(axis=1).mean()


# %% [markdown]
# ## Exercise 5
#
# Part B took no part in the choice, so its judgement carries no luck of the choice: it is noisy,
# but not biased. The price is that the schedule was chosen from half the pictures. (Swapping the
# parts and averaging, which is called cross-fitting, uses all of them.)


# %%
def pose(part):
    """Return the selection problem of this notebook with the table of other residuals."""
    fitted = landing.fit_landing(drone, part, result.suite.cost, bins=10)
    return replace(problem, mean=fitted.mean, variance=fitted.variance)


def honest(residuals):
    """Return the promised and the honest total cost of a schedule chosen from part A."""
    number = np.tile(np.arange(897), 8)
    parts = []
    for remainder in (0, 1):
        rows = number % 2 == remainder
        columns = (residuals.model, residuals.altitude, residuals.residual)
        parts.append(Residuals(residuals.names, *(column[rows] for column in columns)))
    A, B = map(pose, parts)
    choices = solve(A).choices
    return A.total_cost(choices), B.total_cost(choices)
