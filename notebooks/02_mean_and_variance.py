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
# Random errors $e$ cost a controller $e^\top \Psi e$ (notebook 1). A model card prints one number
# for them, a mean square. What does the controller feel?

# %% tags=["hide-input"]
from dataclasses import replace
from itertools import product

import matplotlib.pyplot as plt
import numpy as np

import landing
import modelselect as ms

plt.rcParams.update(landing.STYLE)
BLUE, GREEN, RED = (landing.LOOK[name]["color"] for name in ("Best Single", "Greedy", "Optimal"))

# %% [markdown]
# ## Two steps, three models of mean square 1
#
# Let $\Psi = (0.9, 0.3;\ 0.3, 0.6)$, so that errors cost $0.9 e_0^2 + 0.6 e_1^2 + 0.6 e_0 e_1$. A
# **biased** model errs by $(1, 1)$, a **noisy** one by independent $\pm 1$, an **alternating** one
# by $(1, -1)$. The squares cost 1.5 each time; the last term $0.6$, 0 on average, and $-0.6$:

# %% alt="Three bars. The biased model costs 2.1: 1.5 for the squares and 0.6 for errors that meet. The noisy one costs 1.5, the squares alone. The alternating one costs 0.9, as its errors cancel by 0.6." tags=["hide-input"]
names, meet = ["alternating", "noisy", "biased"], np.array([-0.6, 0, 0.6])
figure, axes = plt.subplots(figsize=(9, 3.2))
axes.barh(names, 1.5, color=BLUE, label="squares")
look = {"facecolor": "white", "edgecolor": RED, "hatch": "//"}
axes.barh(names, meet, left=1.5, label="where errors meet", **look)
for y, x in enumerate(meet):
    axes.text(1.55 + max(x, 0), y, f"{1.5 + x:.1f}", va="center")
axes.set(
    xlim=(0, 3.4), xlabel="cost (hatched below 1.5: taken off)", title="Equal on the model card"
)
axes.legend(loc="center right")
plt.show()

# %% [markdown]
# ## In general
#
# Let $e = \mu + n$, a mean and a noise; $\Sigma_t$ is the covariance of $n_t$, $\Psi_{tk}$ the
# block of steps $t$ and $k$.
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
# each step. With weights $\alpha, \beta$ (1 unless said), the total to minimise (`eq:jp`,
# `eq:jtot`) is
#
# $$\mathrm{total}(c) = \alpha \Big(\mu_c^\top \Psi \mu_c + \sum_t \mathrm{tr}(\Psi_{tt}
# \Sigma_{t,c_t})\Big) + \beta \sum_t \kappa_{c_t} .$$
#
# Any distribution will do, and two models may share their noise: one runs at a time.
# (`ass:indepRV` and the lines about `eq:expTmp2` are misprinted: [paper.md](paper.md).)
#
# **Is it exact?** `thm:equivalence`: simulated control cost $\alpha J$ and prices, averaged over
# the noise, are our total (`opt:model_selection`) plus $\alpha J$ of the controller that is fed the
# truth, the same for all schedules. So both have the same minima. **With a forecast** of all pushes
# $s$ (`open_loop` plans once, `preview` also looks) this holds for every $s$; with **the next push
# alone** (`causal`), on average if $s$ has mean 0. The folded cell tries it on a robot on a line,
# $x_{t+1} = x_t + u_t + s_t$, with all schedules of three steps, all signs of noise and pushes:


# %%
def line(H, Q=1.0):
    """Return the robot (A, B, C, Q, R, H); Q charges its position on the way, 1 at the end."""
    return ms.ControlTask([[1]], [[1]], [[1]], [[Q]], [[1]], H, Q_final=[[1]])


# %% tags=["hide-input"]
H, alpha, beta, rng = 3, 0.8, 0.2, np.random.default_rng(2)
mean, spread = rng.normal(size=(H, 3, 1)), rng.uniform(0.1, 0.6, (H, 3, 1))
every, t = np.array(list(product(range(3), repeat=H))), np.arange(H)
signs = np.array(list(product((-1.0, 1.0), repeat=H)))[:, :, None]
e = mean[t, every] + signs[:, None, None] * spread[t, every]  # (noise, 1, schedules, H, 1)
s = signs[:, None] + 0 * e  # (noise, pushes, schedules, H, 1)
for information in ("open_loop", "preview", "causal"):
    psi = ms.psi(line(H), information)
    test = ms.SelectionProblem(psi, mean, spread**2, [0, 2, 6], alpha, beta)
    fed, true = (
        ms.control_cost(line(H), *ms.run_controller(line(H), [3.0], s, seen, information))
        for seen in (s + e, s)
    )
    off = (alpha * (fed - true)).mean(axis=0) + beta * test.perception_term(every)
    off -= test.total_cost(every)
    print(f"{information:10} off by at most {abs(off).max():.4f} for one s", end=", ")
    print(f"{abs(off.mean(axis=0)).max():.4f} on average")
    np.testing.assert_allclose(off.mean(axis=0), 0, atol=1e-9)
    assert (abs(off).max() < 1e-9) == (information != "causal")

# %% [markdown]
# ## What the mean square hides
#
# A bias of 1 at every step costs $\mathbf 1^\top \Psi \mathbf 1$, noise of equal mean square
# $\mathrm{tr}\, \Psi$. **Predict** how their ratio grows with the horizon of the robot on a line.


# %% tags=["hide-input"]
def ratio(H, Q, information):
    """Return the cost of a constant bias over that of noise of equal mean square."""
    Psi = ms.psi(line(H, Q), information)
    return Psi.sum() / Psi.trace()


# %% alt="Cost of a constant bias divided by that of noise of equal mean square, against the horizon, both on log scales. Open loop, only the end charged, it is the horizon itself, 80 at H = 80. Under preview, position charged, it levels off at 2.2; under causal it is 1." tags=["hide-input"]
horizons = [1, 2, 3, 5, 8, 12, 20, 30, 50, 80]
cases = (("open_loop", 0.0, RED, "o-"), ("preview", 1.0, BLUE, "s--"), ("causal", 1.0, GREEN, "^:"))
figure, axes = plt.subplots(figsize=(10, 4.8))
for information, Q, color, look in cases:
    factor = [ratio(H, Q, information) for H in horizons]
    label = f"{information}, {'position' if Q else 'end'} charged: {factor[-1]:.3g} at H = 80"
    axes.loglog(horizons, factor, look, color=color, ms=7, label=label)
axes.set(xlabel="horizon $H$ (steps)", ylabel="cost of bias / of noise")
axes.set_title("A plan pays for a bias in proportion to H; feedback can cap it")
axes.legend()
plt.show()
row = ms.psi(line(80), "preview")[40]
np.testing.assert_allclose(row[41:50] / row[40:49], (3 - 5**0.5) / 2, rtol=1e-6)
np.testing.assert_allclose(row.sum() / row[40], 5**0.5, rtol=1e-6)

# %% [markdown]
# - **Plan once, only the end charged**: every thrust is off by $d = \mathbf 1^\top e / (H+1)$, the
#   end by $Hd$: in all $Hd^2 + (Hd)^2 = \frac{H}{H+1} (\mathbf 1^\top e)^2$, the factor is $H$.
# - **Preview, position charged**: it braces a few steps ahead. $\Psi_{tk}$ decays like
#   $a^{|t-k|}$ with the closed loop $a = (3 - \sqrt 5)/2$ (undisturbed, $x_{t-1} + x_{t+1} =
#   3x_t$), the factor tends to $(1 + a)/(1 - a) = \sqrt 5$. (With only the end charged it braces
#   from the start: no bound.)
# - **Causal**: $\Psi$ is diagonal, errors never meet. The mean square says it all.
#
# So measure bias and variance separately (notebook 7).
#
# ## Step by step: right or wrong?
#
# Each $\Sigma_t$ stands beside its own $\Psi_{tt}$: **noise drawn anew never couples steps**. Means
# do: switching models at $t$ and $k$ costs $2\alpha\, \delta_t^\top \Psi_{tk} \delta_k$ beyond the
# two alone, $\delta$ the difference of the means. If all means are 0, or $\Psi$ is block diagonal,
# the model that is cheapest at each step alone is the optimum. Else this *greedy* choice can fail.
# Under `open_loop`, the default, position charged, `H = 12`: a bias of 0.7 (model 0) or noise of
# variance 1; then biases of -0.5 and 0.6, or an exact model (2) that costs 1 a step.

# %% tags=["hide-input"]
H = 12
cases = {"bias or noise": ([0.7, 0], [0, 1], [0, 0])}  # means, variances, prices
cases["left, right or exact"] = ([-0.5, 0.6, 0], [0, 0, 0], [0, 0, 1])
for name, (mean, variance, price) in cases.items():
    mean, variance = (np.tile(row, (H, 1))[:, :, None] for row in (mean, variance))
    test = ms.SelectionProblem(ms.psi(line(H)), mean, variance, price)
    greedy, best = ms.stepwise_cost(test).argmin(axis=1), ms.solve(test)
    print(f"{name}\n  greedy  ", *greedy, f" costs {test.total_cost(greedy):.2f}")
    print("  optimum ", *best.choices, f" costs {best.cost:.2f}")
    assert best.is_optimal and test.total_cost(greedy) > 4 * best.cost
assert test.total_cost(greedy) > test.total_cost([2] * H) > 20 * best.cost

# %% [markdown]
# The larger mean square wins (one bias meets no other), and two wrong models in turn beat
# the right one (12 throughout; greedy leaves it at the end, where $0.5^2\, \Psi_{tt} < 1$).
#
# ## Errors that persist
#
# Consecutive pictures look alike. Let noise of variance 1 have correlation $\rho^{|t-k|}$; step 3
# still holds, $E[e^\top \Psi e] = \sum_{t,k} \Psi_{tk} \rho^{|t-k|}$. For $\rho$ of -0.6, 0, 0.6
# and 1:

# %% tags=["hide-input"]
white = np.ones((H, 1, 1))
for information in ("open_loop", "preview", "causal"):
    alone = ms.SelectionProblem(ms.psi(line(H), information), 0 * white, white, [0])
    cost = [
        ms.correlated_cost(alone, [0] * H, ms.autoregressive_errors(white, rho))
        for rho in (-0.6, 0, 0.6, 1)
    ]
    print(f"{information:9}", *(f"{x:7.1f}" for x in cost))
    np.testing.assert_allclose(cost[-1], alone.psi.sum())  # that of a constant bias

# %% [markdown]
# At $\rho = 1$ the noise is a bias that was drawn once, of size $\tau$ and a **sign that you do not
# know**. It is tempting to enter it as a mean, $+\tau$ for one model, $-\tau$ for another. Right
# for a single model: a square has no sign. For two it is not. Take two steps, all entries of $\Psi$
# equal to 1, both $\tau = 1$: either model alone costs 4; in turn 0 on paper. But independent
# signs agree half of the time: truly it is 2, the average of 0 and 4.
#
# Still less than 4. With $\mathbf 1_w$ marking the steps that run model $w$, the cost is $\sum_w
# \tau_w^2\, \mathbf 1_w^\top \Psi \mathbf 1_w$: where errors meet, it can pay to mix models, a
# **portfolio**, even if one of them is best alone. Where they do not (`causal`), or where one model
# is far steadier and $H$ short, at equal prices and noise the steadiest runs alone.
# `correlated_problem` writes this cost as an ordinary problem, and `solve` proves the optimum:

# %%
tau, quiet = np.array([0.7, 1.0, 1.2]), np.full((H, 3, 1), 0.05)  # quiet is drawn anew each step
covariance = ms.persistent_bias(tau**2, quiet)
free = ms.SelectionProblem(ms.psi(line(H)), 0 * quiet, quiet, model_cost=[0, 0, 0])
views = {
    "as if drawn anew": replace(free, variance=quiet + tau[:, None] ** 2),
    "as if known, ±τ": replace(free, mean=0 * quiet + (tau * [1, -1, 1])[:, None]),
    "portfolio": ms.correlated_problem(free, covariance),
}
found = {name: ms.solve(problem) for name, problem in views.items()}
paid = [ms.correlated_cost(free, answer.choices, covariance) for answer in found.values()]

# %% alt="Predicted and true costs of three schedules. As if drawn anew: the steadiest model throughout, 39 predicted and 317 true. As if known: all three in turn, 4 and 222. The portfolio: the steadiest at seven steps, the next at three, the least steady at two, 176 and 176." tags=["hide-input"]
best = found["portfolio"]
assert best.is_optimal and np.isclose(best.cost, paid[2]) and paid[2] < 0.6 * paid[0]
np.testing.assert_allclose(views["as if known, ±τ"].total_cost([0] * H), paid[0])  # one alone
apart = replace(free, psi=ms.psi(line(H), "causal"))  # errors never meet
assert not any(ms.solve(ms.correlated_problem(apart, covariance)).choices)
steady = ms.persistent_bias(np.array([0.1, 1, 1.2]) ** 2, quiet)
assert not any(ms.solve(ms.correlated_problem(free, steady)).choices)

figure, axes = plt.subplots(figsize=(11, 4.4))
rows = [f"{name}\n{' '.join(map(str, answer.choices))}" for name, answer in found.items()]
predicted = [answer.cost for answer in found.values()]
for shift, color, label in ((-0.2, "#bbbbbb", "predicted"), (0.2, RED, "true")):
    cost = predicted if shift < 0 else paid
    bars = axes.barh(np.arange(3) + shift, cost, 0.38, color=color, label=label)
    axes.bar_label(bars, fmt=" %.0f")
axes.set(yticks=range(3), yticklabels=rows, ylim=(2.6, -0.6), xlim=(0, 360))
axes.set(xlabel="expected cost", title="Promised and paid, and the models run")
axes.legend()
plt.show()

# %% [markdown]
# **In one paragraph.** A controller feels the mean of the errors through all of $\Psi$, and their
# covariance within a step through its diagonal blocks. With one component a bias costs up to $H$
# times what noise of its mean square does. Mean squares can mislead, and so can choosing step by
# step, where means meet. Errors that persist meet like a bias of unknown sign: they may ask for a
# portfolio. Next: the best of all schedules, with a proof.
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
# If errors have one component and steps do not meet: diagonal $\Psi$, or only noise drawn anew.
# Else look at bias, noise (and which component errs).
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
# ### Exercise 1: three parts of an error
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
    found.append(split(0.5 + z + n))
    assert np.shape(found[-1]) == (3,), "Exercise 1: return three numbers"
average, error = np.mean(found, axis=0), np.std(found, axis=0) / len(found) ** 0.5
assert (abs(average - truth) < 4 * error).all(), (
    f"Exercise 1: b, tau^2, sigma^2 are {truth}, your estimates on average {average.round(3)}. "
    "What does noise add to the variance of a run's mean? How many freedoms has a run?"
)
print("Exercise 1: right")

# %% [markdown]
# ### Exercise 2: a portfolio by hand
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
    assert answer is not None and np.shape(answer) == (3,), "Exercise 2: return three counts"
    assert np.sum(answer) == steps and np.min(answer) >= 0, f"Exercise 2: they must sum to {steps}"
    least = min(
        sizes @ (np.array([i, j, steps - i - j]) ** 2)
        for i in range(steps + 1)
        for j in range(steps + 1 - i)
    )
    value = sizes @ (np.asarray(answer) ** 2)
    assert np.isclose(value, least), f"Exercise 2: {value:.3f}, and {least:.3f} is possible"
print("Exercise 2: right")

# %% [markdown]
# ### Exercise 3 (open): a patient robot
#
# Under `preview` with the position charged the factor above stops at $\sqrt 5$. What would raise
# it: dearer thrust? a heavier end? another $A$? Predict, then build `patient()`: a `ControlTask`
# with one state, one push, $Q > 0$ and $H \ge 60$ whose factor under `preview` is above 15, and a
# sentence that says why.


# %% tags=["exercise"]
def patient():
    """Return a ControlTask on which a bias costs 15 times as much as noise, and a sentence."""
    ...


# %% tags=["check", "skip-execution"]
answer = patient()
assert answer is not None and len(answer) == 2, "Exercise 3: return a task and a sentence"
test, why = answer
assert isinstance(test, ms.ControlTask) and test.n == test.p == 1, "Exercise 3: n = p = 1"
assert test.horizon >= 60 and np.min(test.Q) > 0, "Exercise 3: H >= 60 and Q > 0"
Psi = ms.psi(test, "preview")
assert Psi.sum() > 15 * Psi.trace(), f"Exercise 3: the factor is {Psi.sum() / Psi.trace():.1f}"
assert len(why.split()) >= 8, "Exercise 3: explain it in a sentence"
print("Exercise 3: right")
