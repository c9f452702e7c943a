# %% [markdown]
# # 2. Bias, noise and what a controller feels of them
#
# **After this notebook you can**
#
# - derive what random errors cost, and say where each assumption enters;
# - tell which of two models flies better when their mean squares mislead;
# - say when to choose step by step is right, and when it is wrong;
# - treat errors that persist: as a portfolio, not as known biases.
#
# **Covers** `prob:model_selection_expectation`, `ass:indepRV`, `eq:expTmp1`, `eq:expTmp2`,
# `eq:perModelExp`, `eq:perModelVar`, `eq:jp`, `eq:jtot`, `thm:equivalence`,
# `opt:model_selection`.
#
# Errors are random. A model card prints one number for them, a mean square or an accuracy. What
# does the controller feel?

# %%
from dataclasses import replace
from itertools import product

import matplotlib.pyplot as plt
import numpy as np

import landing
import modelselect as ms

# %% tags=["hide-input"]
plt.rcParams.update(landing.STYLE)
BLACK, BLUE, GREEN, ORANGE, RED = "#000000", "#0072B2", "#009E73", "#E69F00", "#D55E00"

# %% [markdown]
# ## Two steps, three models of mean square 1
#
# Let $\Psi = (0.9, 0.3;\ 0.3, 0.6)$, so that errors cost $0.9 e_0^2 + 0.6 e_1^2 + 0.6 e_0 e_1$. A
# **biased** model errs by $(1, 1)$, a **noisy** one by independent $\pm 1$, an **alternating** one
# by $(1, -1)$. The squares cost 1.5 each time. The last term is $0.6$ for the biased one, $-0.6$
# for the alternating one, and averages out for the noisy one:

# %% alt="Three bars. The biased model costs 2.1: 1.5 for the squares and 0.6 for errors that meet. The noisy one costs 1.5, the squares alone. The alternating one costs 0.9, as its errors cancel by 0.6." tags=["hide-input"]
figure, axes = plt.subplots(figsize=(9, 3.2))
for y, (name, meet) in enumerate({"alternating": -0.6, "noisy": 0, "biased": 0.6}.items()):
    axes.barh(y, 1.5, color=BLUE, height=0.6, label="squares" if y == 0 else None)
    look = {"facecolor": "white" if meet < 0 else RED, "edgecolor": RED, "hatch": "//"}
    axes.barh(y, meet, left=1.5, height=0.6, label="where errors meet" if y == 2 else None, **look)
    axes.text(1.55 + max(meet, 0), y, f"{name}: {1.5 + meet:.1f}", va="center")
axes.set(
    yticks=[], xlim=(0, 3.7), xlabel="cost (hatched: taken off)", title="Equal on the model card"
)
axes.legend(loc="center right")
plt.show()

# %% [markdown]
# ## In general
#
# Let $e = \mu + n$, a mean and a noise; $\Sigma_t$ is the covariance of $n_t$.
#
# 1. **Linearity** (`eq:expTmp1`): $E[e^\top \Psi e] = \sum_{t,k} E[e_t^\top \Psi_{tk} e_k]$.
# 2. **The mean splits off**: mixed terms $2\mu^\top \Psi E[n]$ vanish.
# 3. **Trace**: $E[n_t^\top \Psi_{tk} n_k] = \mathrm{tr}(\Psi_{tk} E[n_k n_t^\top])$.
# 4. **No correlation between steps**: only $t = k$ stays.
#
# $$E[e^\top \Psi e] = \mu^\top \Psi \mu + \sum_t \mathrm{tr}(\Psi_{tt} \Sigma_t).$$
#
# A schedule $c$ runs model $c_t$ at step $t$. It chooses a mean $\mu_{t,c_t}$ (`eq:perModelExp`;
# stacked, $\mu_c$), a variance $\Sigma_{t,c_t}$ (`eq:perModelVar`) and a price $\kappa_{c_t}$ for
# each step. With weights $\alpha$ and $\beta$ (1 unless said), the total to minimise (`eq:jp`,
# `eq:jtot`) is
#
# $$\mathrm{total}(c) = \alpha \Big(\mu_c^\top \Psi \mu_c + \sum_t \mathrm{tr}(\Psi_{tt}
# \Sigma_{t,c_t})\Big) + \beta \sum_t \kappa_{c_t} .$$
#
# Any distribution will do, two models may share their noise (one runs at a time), and components of
# one step may correlate if $\Sigma_t$ is given as a matrix. (`ass:indepRV` and the lines about
# `eq:expTmp2` are misprinted: [paper.md](paper.md).) A mean that is known in flight one would
# subtract; what stays after that comes below. Four equally likely pairs of signs a step make an
# exact average:

# %%
H, p, rng = 3, 2, np.random.default_rng(2)
task = ms.ControlTask(rng.normal(size=(2, 2)), [[0], [1]], np.eye(2), np.eye(2), [[1]], horizon=H)
Psi, mu = ms.psi(task), rng.normal(size=(H, 1, p))
roots = rng.normal(size=(H, p, p))  # Sigma_t = roots_t roots_t'
signs = np.array(list(product((-1.0, 1.0), repeat=H * p))).reshape(-1, H, p)
e = (mu[:, 0] + np.einsum("tij,ntj->nti", roots, signs)).reshape(len(signs), -1)
average = ((e @ Psi) * e).sum(axis=1).mean()
Sigma = roots @ roots.swapaxes(1, 2)
formula = ms.SelectionProblem(Psi, mu, Sigma[:, None], model_cost=[0]).total_cost([0] * H)
print(f"average of {len(e)} draws {average:.6f}, formula {formula:.6f}")
np.testing.assert_allclose(average, formula)

# %% [markdown]
# ## What the mean square hides
#
# Now a robot on a line, $x_{t+1} = x_t + u_t + s_t$, whose position is charged by $Q$ on the way and
# by 1 at the end. A bias costs $\mathbf 1^\top \Psi \mathbf 1$, noise of equal mean square
# $\mathrm{tr}\, \Psi$. **Predict** how their ratio grows with the horizon.


# %%
def line(H, Q=1.0):
    """Return the robot on a line."""
    return ms.ControlTask([[1]], [[1]], [[1]], [[Q]], [[1]], H, Q_final=[[1]])


def ratio(H, Q, information):
    """Return the cost of a constant bias over that of noise of equal mean square."""
    Psi = ms.psi(line(H, Q), information)
    return Psi.sum() / Psi.trace()


# %% alt="Cost of a constant bias divided by that of noise of equal mean square, against the horizon, both on log scales. Open loop it is the horizon itself if only the end is charged (80 at H = 80) and grows with it if the position is charged (54). Under preview it grows more slowly (19) or levels off at 2.2; under causal it is 1." tags=["hide-input"]
horizons = np.array([1, 2, 3, 5, 8, 12, 20, 30, 50, 80])
cases = [
    ("open_loop", 0.0, RED, "o", "-"),
    ("open_loop", 1.0, RED, "o", "--"),
    ("preview", 0.0, BLUE, "s", "-"),
    ("preview", 1.0, BLUE, "s", "--"),
    ("causal", 1.0, GREEN, "^", "--"),
]
figure, axes = plt.subplots()
for information, Q, color, marker, style in cases:
    factor = [ratio(H, Q, information) for H in horizons]
    where = "position charged" if Q else "only the end charged"
    label = f"{information}, {where}: {factor[-1]:.3g}"
    axes.loglog(horizons, factor, color=color, marker=marker, ls=style, ms=7, label=label)
axes.set(xlabel="horizon $H$ (steps)", ylabel="bias / noise of equal mean square")
axes.set_title("A plan pays for a bias in proportion to H; feedback can cap it")
axes.legend(title="pattern, cost: factor at H = 80", loc="upper left")
plt.show()
row = ms.psi(line(80), "preview")[40]  # of the level curve
np.testing.assert_allclose(row[41:50] / row[40:49], (3 - 5**0.5) / 2, rtol=1e-6)
np.testing.assert_allclose(row.sum() / row[40], 5**0.5, rtol=1e-6)

# %% [markdown]
# - **Plan once, only the end charged**: $\Psi = \frac{H}{H+1} \mathbf 1 \mathbf 1^\top$, the factor
#   is $H$: distances that add up against a random walk.
# - **Preview, position charged**: bracing begins a few steps ahead. $\Psi_{tk}$ decays like
#   $a^{|t-k|}$, $a = (3 - \sqrt 5)/2$, and the factor tends to $(1 + a)/(1 - a) = \sqrt 5$. (With
#   only the end charged nothing urges it to act early or late: it spreads the work, and the factor
#   grows.)
# - **Causal**: errors never meet. The mean square says it all.
#
# So it can pay to run the model with the *larger* mean square. Here, planned once (which `ms.psi`
# assumes unless told) with the position charged, 1 (noise) against 0.49 (bias):

# %%
H = 12
mean, variance = np.zeros((2, H, 2, 1))
mean[:, 0], variance[:, 1] = 0.7, 1.0
pair = ms.SelectionProblem(ms.psi(line(H)), mean, variance, model_cost=[0, 0])
greedy, best = ms.stepwise_cost(pair).argmin(axis=1), ms.solve(pair)
print("lower mean square:", *greedy, f" costs {pair.total_cost(greedy):.1f}")
print("optimum:          ", *best.choices, f" costs {best.cost:.1f}")
assert best.is_optimal and not greedy.any() and pair.total_cost(greedy) > 4 * best.cost

# %% [markdown]
# Measure bias and variance separately (notebook 7).
#
# ## Step by step: right or wrong?
#
# Each $\Sigma_t$ stands beside its own $\Psi_{tt}$: **noise never couples steps**. Two means do, by
# $2\alpha\, \delta_t^\top \Psi_{tk} \delta_k$, $\delta$ being the difference of the models' means. So
# if all means are 0, or $\Psi$ is block diagonal, the cheapest model of each step is the optimum. Else
# this *greedy* choice can be wrong. First 200 random problems; then two models that err to opposite
# sides, beside an exact one that costs 1 a step:

# %%
right, excess = 0, []
for seed in range(200):
    rng = np.random.default_rng(seed)
    means, prices = rng.normal(size=(8, 3, 1)) / [[1], [2], [4]], [0, 0.2, 0.6]
    test = ms.SelectionProblem(ms.psi(line(8), "preview"), means, 0 * means, prices)
    greedy = float(test.total_cost(ms.stepwise_cost(test).argmin(axis=1)))
    excess.append(greedy / ms.solve(test).cost - 1)
print(f"preview: right on {sum(x < 1e-9 for x in excess)} of 200, at worst {max(excess):.0%} above")

means = np.tile([[-0.5], [0.6], [0.0]], (H, 1, 1))  # left, right, exact at a price of 1
opposite = ms.SelectionProblem(ms.psi(line(H)), means, 0 * means, model_cost=[0, 0, 1])
greedy, best = ms.stepwise_cost(opposite).argmin(axis=1), ms.solve(opposite)
for name, c in {"exact": np.full(H, 2), "greedy": greedy, "optimum": best.choices}.items():
    print(f"open_loop, {name:8}", *c, f" costs {opposite.total_cost(c):.2f}")
assert 2 not in best.choices and opposite.total_cost(greedy) > opposite.total_cost(np.full(H, 2))

# %% [markdown]
# Two wrong models in turn beat the right one. Nor does a coin between models help: its expected
# cost is an average over schedules, and an average is never below its minimum.
#
# ## Errors that persist
#
# Consecutive pictures look alike. Let noise of variance 1 have correlation $\rho^{|t-k|}$; step 3 of
# the derivation still holds, $E[e^\top \Psi e] = \sum_{t,k} \Psi_{tk} \rho^{|t-k|}$:

# %% alt="Cost relative to independent errors, against their correlation rho. For rho above 0 open loop rises to 8.8 at rho = 1 and preview to 2.1; for rho below 0 both fall toward 0. Causal stays at 1 throughout." tags=["hide-input"]
rhos = np.array([-0.9, -0.6, -0.3, 0, 0.3, 0.6, 0.8, 0.9, 1])
looks = {"open_loop": (RED, "o"), "preview": (BLUE, "s"), "causal": (GREEN, "^")}
white = np.ones((H, 1, 1))
figure, axes = plt.subplots()
for information, (color, marker) in looks.items():
    alone = ms.SelectionProblem(ms.psi(line(H), information), 0 * white, white, [0])
    share = [
        ms.correlated_cost(alone, [0] * H, ms.autoregressive_errors(white, rho))
        / float(alone.total_cost([0] * H))
        for rho in rhos
    ]
    label = f"{information}: {share[5]:.2f} at $\\rho$ = 0.6, {share[-1]:.2f} at 1"
    axes.plot(rhos, share, color=color, marker=marker, ms=8, label=label)
    np.testing.assert_allclose(share[-1], ratio(H, 1.0, information))  # that of a constant bias
axes.set(xlabel="correlation $\\rho$ of consecutive errors", ylabel="cost / cost if independent")
axes.set_title("Errors that persist cost like a bias, errors that alternate cancel")
axes.legend(loc="upper left")
plt.show()

# %% [markdown]
# At $\rho = 1$ an error is a bias that was drawn once and stays: what a calibration leaves, of a
# size $\tau$ that you know and a **sign that you do not**. It is tempting to enter it as a mean, $+\tau$
# for one model and $-\tau$ for another. For a single model that is right: a square has no sign. With
# two the optimum cancels them, on paper:

# %%
tau, none = np.array([1.0, 1.0]), np.zeros((8, 2, 1))
believed = ms.SelectionProblem(
    ms.psi(line(8)), np.array([[1.0], [-1.0]]) + none, none, model_cost=[0, 0]
)
unknown, covariance = replace(believed, mean=none), ms.persistent_bias(tau**2, none)
for c in (np.zeros(8, dtype=int), ms.solve(believed).choices):
    true = ms.correlated_cost(unknown, c, covariance)
    print(*c, f" predicted {believed.total_cost(c):6.2f}, true {true:6.2f}")

# %% [markdown]
# The biases are independent, so half of the time their signs agree. What *is* true: with $\mathbf
# 1_w$ marking the steps that run model $w$, the cost is $\sum_w \tau_w^2\, \mathbf 1_w^\top \Psi
# \mathbf 1_w$. Where all errors meet alike, two halves cost half of the whole: a **portfolio**. Then
# it can pay to mix models, even if one of them is best alone. Where errors of different steps do not
# meet (`causal`), or one model is far steadier, the steadiest runs alone. `correlated_problem` makes
# this a selection problem of its own, with one component a model, and `solve` proves its optimum:

# %%
H, tau = 12, np.array([0.7, 1.0, 1.2])
quiet = np.full((H, 3, 1), 0.05)  # what is drawn anew at every step
covariance = ms.persistent_bias(tau**2, quiet)
free = ms.SelectionProblem(ms.psi(line(H)), 0 * quiet, quiet, model_cost=[0, 0, 0])
independent = replace(free, variance=quiet + tau[:, None] ** 2)  # as if drawn at every step
signed = replace(free, mean=0 * quiet + (tau * [1, -1, 1])[:, None])  # as if known
portfolio = ms.solve(ms.correlated_problem(free, covariance))
schedules = {
    "as if independent": (ms.solve(independent).choices, independent),
    "as if known, ±τ": (ms.solve(signed).choices, signed),
    "portfolio": (portfolio.choices, None),
}
paid = {name: ms.correlated_cost(free, c, covariance) for name, (c, _) in schedules.items()}
assert portfolio.is_optimal and np.isclose(portfolio.cost, paid["portfolio"])
assert portfolio.cost < 0.6 * paid["as if independent"]
apart = replace(free, psi=ms.psi(line(H), "causal"))  # errors never meet
assert not any(ms.solve(ms.correlated_problem(apart, covariance)).choices)
steady = ms.persistent_bias(np.array([0.1, 1, 1.2]) ** 2, quiet)
assert not any(ms.solve(ms.correlated_problem(free, steady)).choices)

# %% alt="Left, predicted and true costs of three schedules: as if independent, 39 predicted and 317 true; as if known, 4 and 222; the portfolio, 176 and 176. Right, the models they run: the first runs the steadiest model only; the second all three in turn; the portfolio the steadiest at seven steps, the next at three, the least steady at two." tags=["hide-input"]
figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4.4), width_ratios=[3, 4])
for y, (name, (c, model)) in enumerate(schedules.items()):
    predicted = paid[name] if model is None else float(model.total_cost(c))
    left.barh(y - 0.2, predicted, 0.38, color="#bbbbbb", label="predicted" if y == 0 else None)
    left.barh(y + 0.2, paid[name], 0.38, color=RED, label="true" if y == 0 else None)
    left.text(paid[name], y + 0.2, f" {paid[name]:.0f}", va="center")
    left.text(predicted, y - 0.2, f" {predicted:.0f}", va="center")
    for w, (color, marker) in enumerate(((BLUE, "s"), (ORANGE, "o"), (GREEN, "^"))):
        label = f"$\\tau$ = {tau[w]}" if y == 0 else None
        steps = np.flatnonzero(np.array(c) == w)
        right.plot(steps, y + 0 * steps, ls="", color=color, marker=marker, label=label)
left.set(yticks=range(3), yticklabels=schedules, xlabel="expected cost", ylim=(2.6, -0.6))
left.set(xlim=(0, 400), title="Promised and paid")
right.set(yticks=range(3), yticklabels=[], xlabel="step", ylim=(2.6, -1), title="Models run")
left.legend()
right.legend(ncols=3, loc="upper center")
plt.show()

# %% [markdown]
# ## Is the objective exact?
#
# `thm:equivalence`: minimising the simulated $\alpha J + \beta J^{\mathrm{per}}$, averaged over the
# noise, and minimising our total (`opt:model_selection`) give the same schedules, as the two differ
# by $\alpha J$ of the controller that is fed the truth, which no schedule changes. **With a
# forecast** this holds for every $s$; **without** one, on average over $s$ (notebook 1). All 81
# schedules of four steps, for all 16 signs of the noise and all 16 of the pushes:

# %%
H, alpha, beta = 4, 0.8, 0.2
mean, spread = rng.normal(size=(H, 3, 1)) / [[1], [2], [4]], rng.uniform(0.1, 0.6, (H, 3, 1))
everything, t = np.array(list(product(range(3), repeat=H))), np.arange(H)
signs = np.array(list(product((-1.0, 1.0), repeat=H)))[:, :, None]  # (16, H, 1)
errors = mean[t, everything] + signs[:, None, None] * spread[t, everything]  # (16, 1, 81, H, 1)
s = signs[:, None] + 0 * errors  # (16, 16, 81, H, 1)
for information in ("open_loop", "preview", "causal"):
    task = line(H)
    test = ms.SelectionProblem(ms.psi(task, information), mean, spread**2, [0, 2, 6], alpha, beta)
    J = ms.control_cost(task, *ms.run_controller(task, [3.0], s, s + errors, information))
    true = ms.control_cost(task, *ms.run_controller(task, [3.0], s, s, information))
    total = (
        alpha * (J - true) + beta * test.perception_term(everything) - test.total_cost(everything)
    )
    by_sea = np.abs(total.mean(axis=0)).max()  # one sea at a time, the noise averaged
    print(f"{information:10} off by at most {by_sea:.4f} in one sea", end=", ")
    print(f"{np.abs(total.mean(axis=(0, 1))).max():.4f} on average")
    np.testing.assert_allclose(total.mean(axis=(0, 1)), 0, atol=1e-9)
    assert (by_sea < 1e-9) == (information != "causal")

# %% [markdown]
# **In one paragraph.** A controller feels the mean of the errors through all of $\Psi$, and their
# covariance within a step through its diagonal blocks. A bias costs up to $H$ times what its square
# says, or nothing. So mean squares mislead, and choosing step by step can be wrong wherever means
# meet. Errors that persist meet like a bias, but of unknown sign: they may ask for a portfolio. Next:
# how to find the best of $W^H$ schedules, with a proof.
#
# ## Recall
#
# <details><summary>Which assumption makes the variance enter through the diagonal blocks alone?</summary>
#
# Errors of different steps are uncorrelated (step 4). Shape, shared noise and components within a
# step do not matter.
#
# </details>
# <details><summary>Two models have mean square 1 and 2. When is the second one certainly the worse choice, at equal prices?</summary>
#
# With $p = 1$, if steps do not meet: block diagonal $\Psi$, or no means. Else look at bias and noise
# (and at which component errs).
#
# </details>
# <details><summary>Each of two free models has an unknown persistent bias of size 1. Why alternate?</summary>
#
# Their biases are independent, so the cross terms average out. Squares of halves add up to half the
# square of the whole (if all errors meet alike).
#
# </details>
#
# ## Exercises
#
# ### Exercise 1: fool the greedy choice
#
# Invent two models without noise for `line(6)`, planned once: means $(6, 2, 1)$ and two prices $\ge
# 0$, for which choosing each step by itself costs at least ten times the optimum, and the optimum
# is positive. (At a tie model 0 is chosen.)


# %% tags=["exercise"]
fooling_means = ...
fooling_prices = ...


# %% tags=["check", "skip-execution"]
assert fooling_means is not ... and fooling_prices is not ..., (
    "Exercise 1: set fooling_means (6, 2, 1) and fooling_prices (2,)"
)
fooling_means = np.asarray(fooling_means, dtype=float)
fooling_prices = np.asarray(fooling_prices, dtype=float)
assert fooling_means.shape == (6, 2, 1), (
    f"Exercise 1: expected means of shape (6, 2, 1), found {fooling_means.shape}"
)
assert fooling_prices.shape == (2,) and (fooling_prices >= 0).all(), (
    "Exercise 1: expected two prices of at least 0"
)
assert np.isfinite(fooling_means).all(), "Exercise 1: expected finite means"
fooled = ms.SelectionProblem(ms.psi(line(6)), fooling_means, 0 * fooling_means, fooling_prices)
cheap = float(fooled.total_cost(ms.stepwise_cost(fooled).argmin(axis=1)))
least = ms.enumerate_schedules(fooled).cost
assert least > 1e-9, f"Exercise 1: the optimum must be positive, found {least:.3g}"
assert cheap >= 10 * least, (
    f"Exercise 1: greedy costs {cheap:.4g}, the optimum {least:.4g}: only {cheap / least:.2f} times"
)
print("Exercise 1: right")

# %% [markdown]
# ### Exercise 2: three parts of an error
#
# From `residuals` (N, H), N runs of one model with $e_t = b + z + n_t$ (a mean $b$ for ever, $z$
# drawn once a run, $n_t$ anew at every step), estimate $b$, $\tau^2 = \mathrm{var}\, z$ and
# $\sigma^2 = \mathrm{var}\, n$, so that the estimates are right **on average**. (The mean of a run
# varies by more than $\tau^2$.)


# %% tags=["exercise"]
def split(residuals):
    """Return estimates of b, tau squared and sigma squared without bias."""
    ...


# %% tags=["check", "skip-execution"]
draw, truth, found = np.random.default_rng(0), np.array([0.5, 0.3, 2.0]), []
for _ in range(4000):
    z, n = 0.3**0.5 * draw.normal(size=(5, 1)), 2**0.5 * draw.normal(size=(5, 4))
    answer = split(0.5 + z + n)
    assert answer is not None and np.shape(answer) == (3,), "Exercise 2: return three numbers"
    found.append(answer)
off = (np.mean(found, axis=0) - truth) / (np.std(found, axis=0) / len(found) ** 0.5)
for name, value, average, z in zip(
    ("b", "tau^2", "sigma^2"), truth, np.mean(found, axis=0), off, strict=True
):
    assert abs(z) < 4, (
        f"Exercise 2: {name} is {value}; the average of 4000 estimates is {average:.3f}. "
        "What does noise add to the variance of a run's mean? How many freedoms has a run?"
    )
print("Exercise 2: right")

# %% [markdown]
# ### Exercise 3: a portfolio by hand
#
# Plan once, only the end charged: $\Psi \propto \mathbf 1 \mathbf 1^\top$. Free models have
# independent persistent biases of variance $\tau_w^2$. Only the number $n_w$ of steps that a model
# runs matters, $\sum_w \tau_w^2 n_w^2$. Return the best counts for $H$ steps. (What does one more
# step cost each model? Why is taking the least each time right here?)


# %% tags=["exercise"]
def portfolio_counts(tau_squared, H):
    """Return how many of H steps each model should run, an integer array (W,)."""
    ...


# %% tags=["check", "skip-execution"]
for seed in range(20):
    draw = np.random.default_rng(seed)
    sizes, steps = draw.uniform(0.1, 2, 3), int(draw.integers(1, 25))
    answer = portfolio_counts(sizes.copy(), steps)
    assert answer is not None and np.shape(answer) == (3,), "Exercise 3: return three counts"
    assert np.sum(answer) == steps and np.min(answer) >= 0, f"Exercise 3: they must sum to {steps}"
    least = min(
        sizes @ (np.array([i, j, steps - i - j]) ** 2)
        for i in range(steps + 1)
        for j in range(steps + 1 - i)
    )
    value = sizes @ (np.asarray(answer) ** 2)
    assert np.isclose(value, least), f"Exercise 3: {value:.3f}, and {least:.3f} is possible"
print("Exercise 3: right")

# %% [markdown]
# ### Exercise 4 (open): a patient robot
#
# Under `preview` with the position charged the factor above stops at $\sqrt 5$. What would raise
# it: dearer thrust? a heavier end? another $A$? Predict, then build `patient()`: a `ControlTask`
# with $n = p = 1$, $Q > 0$ and $H \ge 60$ whose factor under `preview` is above 15, and a sentence
# that says why.


# %% tags=["exercise"]
def patient():
    """Return a ControlTask on which a bias costs 15 times its square, and a sentence."""
    ...


# %% tags=["check", "skip-execution"]
answer = patient()
assert answer is not None and len(answer) == 2, "Exercise 4: return a task and a sentence"
test, why = answer
assert isinstance(test, ms.ControlTask) and test.n == test.p == 1, "Exercise 4: n = p = 1"
assert test.horizon >= 60 and np.min(test.Q) > 0, "Exercise 4: H >= 60 and Q > 0"
Psi = ms.psi(test, "preview")
assert Psi.sum() > 15 * Psi.trace(), f"Exercise 4: the factor is {Psi.sum() / Psi.trace():.1f}"
assert len(why.split()) >= 8, "Exercise 4: explain it in a sentence"
print("Exercise 4: right")
