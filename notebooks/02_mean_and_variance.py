# %% [markdown]
# # 2. Bias, noise and what a controller feels of them
#
# Errors are random. A model card prints one number for them: a mean square, or an accuracy. This
# notebook derives what the controller feels instead, the mean and the variance, in different ways:
# variances add up step by step, means meet each other across time. Two models of equal mean square
# can differ in cost without limit, and the model with the larger one can be the better choice.
#
# **After this notebook you can**
#
# - derive $E[e^\top \Psi e] = \mu^\top \Psi \mu + \sum_t \mathrm{tr}(\Psi_{tt} \Sigma_t)$ and say
#   where each assumption enters;
# - tell from bias, variance and $\Psi$ which of two models flies better, when their mean squares
#   mislead;
# - say when choosing step by step is right, when it is wrong, and why a coin never helps;
# - treat errors correlated within a step, and judge errors correlated over time;
# - check the paper's theorem of equivalence by simulating every schedule.
#
# **Covers**: `prob:model_selection_expectation`, `sol:model_selection_expectation`, `ass:indepRV`,
# `eq:expTmp1`, `eq:expTmp2`, `eq:perModelExp`, `eq:perModelVar`, `eq:jp`, `eq:jtot`,
# `thm:equivalence`, `opt:model_selection`; `SelectionProblem`, `error_cost`, `stepwise_cost`,
# `solve_separable`, `enumerate_schedules`, `correlated_cost`.

# %%
from dataclasses import replace
from itertools import product

import matplotlib.pyplot as plt
import numpy as np

import landing
from modelselect import (
    ControlTask,
    SelectionProblem,
    control_cost,
    correlated_cost,
    correlated_problem,
    enumerate_schedules,
    error_cost,
    psi,
    run_controller,
    solve,
    solve_separable,
    stepwise_cost,
)

plt.rcParams.update(landing.STYLE)
BLACK, BLUE, GREEN, ORANGE, RED = "#000000", "#0072B2", "#009E73", "#E69F00", "#D55E00"


# %% [markdown]
# ## The expectation, in four steps
#
# Let $e = \mu + n$: a mean and a noise with $E[n] = 0$. Let $\Sigma_t$ be the covariance of $n_t$,
# within step $t$.
#
# 1. **Linearity** (`eq:expTmp1`): $E[e^\top \Psi e] = \sum_{t,k} E[e_t^\top \Psi_{tk} e_k]$.
# 2. **The mean splits off**: the mixed terms $2\mu^\top \Psi\, E[n]$ vanish, which leaves
#    $\mu^\top \Psi \mu + E[n^\top \Psi n]$.
# 3. **Trace**: $E[n_t^\top \Psi_{tk} n_k] = \mathrm{tr}(\Psi_{tk}\, E[n_k n_t^\top])$.
# 4. **Independence across steps**: $E[n_k n_t^\top] = 0$ for $t \ne k$; only $t = k$ stays.
#
# $$E[e^\top \Psi e] = \mu^\top \Psi \mu + \sum_t \mathrm{tr}(\Psi_{tt} \Sigma_t).$$
#
# We check each line exactly. Let every component of the noise be $+\sigma$ or $-\sigma$ with equal
# chance, independently: for three steps and two components these are 64 equally likely errors, and
# their average *is* the expectation. The boat of notebook 1 now estimates two inputs, waves and
# gusts.

# %%
dt = 0.2
boat = ControlTask(
    A=[[1, dt], [-dt, 0.95]],
    B=[[0], [dt]],
    C=dt * np.eye(2),
    Q=np.diag([1, 0]),
    R=[[0.1]],
    horizon=3,
)
H, p, rng = 3, 2, np.random.default_rng(2)
Psi = psi(boat)
mu, sigma = rng.normal(size=(H, p)), rng.uniform(0.5, 1.5, size=(H, p))
signs = np.array(list(product((-1.0, 1.0), repeat=H * p))).reshape(-1, H, p)
errors = mu + sigma * signs  # (64, H, p)


def quadratic(Psi, e):
    """e'Psi e of errors (..., H, p)."""
    e = e.reshape(*e.shape[:-2], -1)
    return ((e @ Psi) * e).sum(axis=-1)


blocks = Psi.reshape(H, p, H, p).swapaxes(1, 2)  # blocks[t, k] = Psi_tk
noise = errors - mu
average = quadratic(Psi, errors).mean()
moments = np.einsum("nti,nkj->tkij", noise, noise) / 64  # E[n_t n_k']
same_step = sum(np.trace(blocks[t, t] @ np.diag(sigma[t] ** 2)) for t in range(H))
for text, value in [
    ("average of 64 draws", average),
    ("1 linearity", np.einsum("nti,tkij,nkj->tk", errors, blocks, errors).sum() / 64),
    ("2 mean split off", quadratic(Psi, mu) + quadratic(Psi, noise).mean()),
    ("3 trace", quadratic(Psi, mu) + (blocks * moments).sum()),
    ("4 independence: the formula", quadratic(Psi, mu) + same_step),
]:
    print(f"{text:28s} {value:.5f}")
    np.testing.assert_allclose(value, average)
assert all(np.abs(moments[t, k]).max() < 1e-12 for t in range(H) for k in range(H) if t != k)

# %% [markdown]
# `SelectionProblem` holds the means and variances of all models and evaluates this formula; here
# with a single model. Nothing was said about the *shape* of the distribution, and nothing depends
# on it. Normal, uniform and very lopsided errors of the same mean and variance:

# %%
problem = SelectionProblem(Psi, mu[:, None], sigma[:, None] ** 2, model_cost=[0])
formula = float(problem.control_term([0, 0, 0]))
np.testing.assert_allclose(formula, average)
shapes = {
    "normal": rng.normal(size=(20_000, H, p)),
    "uniform": rng.uniform(-(3**0.5), 3**0.5, size=(20_000, H, p)),
    "exponential": rng.exponential(size=(20_000, H, p)) - 1,
}
print(f"formula     {formula:.5f}")
for name, unit_noise in shapes.items():
    drawn = quadratic(Psi, mu + sigma * unit_noise)
    standard_error = drawn.std(ddof=1) / np.sqrt(len(drawn))
    print(f"{name:11s} {drawn.mean():.5f}, standard error {standard_error:.5f}")
    assert abs(drawn.mean() - formula) < 4 * standard_error

# %% [markdown]
# ## What the paper prints
#
# The paper's result is right; three lines on the way are misprinted. `eq:expTmp2` loses $\Psi_{ij}$
# beside the means; the next line sums $\Psi_{ij}$ over all $i$ beside the variance of $d_j$; the
# last line loses $\Psi$ beside the variance. With $\alpha = 1$ and no perception cost each can be
# compared with the truth. And `ass:indepRV` asks that *any two* $d_i, d_j$ be independent. Taken at
# its word that includes $i = j$, and what is independent of itself does not vary: read so, the
# variances would drop out.

# %%
m, v = mu.ravel(), sigma.ravel() ** 2
lines = {
    "eq:expTmp2": np.outer(m, m).sum() + Psi.diagonal() @ v,
    "next line": m @ Psi @ m + (Psi @ v).sum(),
    "last line": m @ Psi @ m + v.sum(),
    "ass:indepRV with i = j": m @ Psi @ m,
    "corrected": m @ Psi @ m + Psi.diagonal() @ v,
}
for name, value in lines.items():
    print(f"{name:23s} {value:7.4f}   truth {average:.4f}")
    assert np.isclose(value, average) == (name == "corrected")

# %% [markdown]
# ## Three models of equal mean square
#
# Back to a robot on a line, $x_{t+1} = x_t + u_t + s_t$, that charges position and command alike.
# Three models err by 1 in the root mean square:
#
# - **biased**: always $+1$;
# - **noisy**: mean 0, variance 1, independent from step to step;
# - **alternating**: $+1, -1, +1, \dots$
#
# **Predict:** which one costs the controller most, which least, and by what factor?


# %%
def line(H, Q=1.0, C=((1,),)):
    """x_{t+1} = x_t + u_t + C s_t, position charged by Q on the way and by 1 at the end."""
    return ControlTask([[1]], [[1]], C, [[Q]], [[1]], H, Q_final=[[1]])


def three_models(Psi, biased=1.0, noisy=1.0, alternating=1.0):
    """Three free models with these mean squares."""
    H = len(Psi)
    mean, variance = np.zeros((2, H, 3, 1))
    mean[:, 0, 0] = biased**0.5
    variance[:, 1, 0] = noisy
    mean[:, 2, 0] = alternating**0.5 * (-1.0) ** np.arange(H)
    return SelectionProblem(Psi, mean, variance, model_cost=[0, 0, 0])


H = 12
cost = error_cost(three_models(psi(line(H))))
print("              biased   noisy   alternating")
print("mean square  {:7.2f} {:7.2f} {:7.2f}".format(*cost.mean_square))
print("uncoupled    {:7.2f} {:7.2f} {:7.2f}".format(*cost.uncoupled))
print("control cost {:7.2f} {:7.2f} {:7.2f}".format(*(cost.bias + cost.noise)))

# %% [markdown]
# `uncoupled` is what follows from squared errors alone, $\sum_t \Psi_{tt} E[e_t^2]$: the same for
# all three. The noise costs exactly that. The bias costs almost nine times as much, because it meets
# itself at every other step; the alternating errors nearly cancel. How the factor grows with the horizon
# depends on what the controller knows and on what is charged:

# %% alt="Cost of a constant bias divided by that of noise of equal mean square, against the horizon, both on log scales. Open loop it is the horizon itself if only the end is charged (80 at H = 80) and grows with it if the position is charged (54). Under preview it grows more slowly (19) or levels off at 2.2; under causal it is 1."
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
    costs = [error_cost(three_models(psi(line(H, Q), information))) for H in horizons]
    factor = [cost.bias[0] / cost.noise[1] for cost in costs]
    if (information, Q) == ("open_loop", 0.0):
        np.testing.assert_allclose(factor, horizons)
    label = (
        f"{information}, {'position charged' if Q else 'only the end charged'}: {factor[-1]:.3g}"
    )
    axes.loglog(horizons, factor, color=color, marker=marker, ls=style, ms=7, label=label)
axes.set(xlabel="horizon $H$ (steps)", ylabel="bias / noise of equal mean square")
axes.set_title("A plan pays for a bias in proportion to H; feedback can cap it")
axes.legend(title="pattern, cost: factor at H = 80", loc="upper left")
plt.show()
row = psi(line(80), "preview")[40]  # of the level curve: a geometric decay
np.testing.assert_allclose(row[41:50] / row[40:49], (3 - 5**0.5) / 2, rtol=1e-6)
np.testing.assert_allclose(row.sum() / row[40], 5**0.5, rtol=1e-6)

# %% [markdown]
# - **Plan once, charge the end**: $\Psi = \frac{H}{1+H} \mathbf 1 \mathbf 1^\top$ (exercise 1 of
#   notebook 1), and the factor is exactly $H$. The errors add up like distances when they agree, like a random walk when they
#   do not.
# - **Feedback, position charged**: $\Psi_{tk}$ decays like $a^{|t-k|}$ with $a = (3 - \sqrt 5)/2$,
#   and the factor tends to $(1 + a)/(1 - a) = \sqrt 5$. Feedback forgets, so a bias meets only its
#   neighbours. (If only the end is charged, nothing presses the robot to correct itself early, and
#   the factor grows with feedback too, more slowly than $H$.)
# - **No forecast**: errors never meet. Mean square says it all.
#
# So the advice is not "bias is worse than noise". It is: *errors of one sign are worse where the
# controller stakes many steps on them.*
#
# ## The model with the larger mean square
#
# A biased model with mean square 0.49 and a noisy one with mean square 1, at the same price. Which
# one would you run? Ask `solve`.

# %%
H = 12
both = three_models(psi(line(H)), biased=0.49)
pair = replace(both, mean=both.mean[:, :2], variance=both.variance[:, :2], model_cost=[0, 0])
best = solve(pair)
by_mean_square = np.zeros(H, dtype=int)  # the biased model looks twice as good at every step
assert (stepwise_cost(pair).argmin(axis=1) == by_mean_square).all() and best.is_optimal
print("mean squares        ", error_cost(pair).mean_square.round(2).tolist())
print("by mean square      ", *by_mean_square, f"  costs {pair.total_cost(by_mean_square):.1f}")
print("optimal schedule    ", *best.choices, f"  costs {best.cost:.1f}")
assert pair.total_cost(by_mean_square) > 4 * best.cost

# %% [markdown]
# The optimum runs the model with *twice* the mean square at all steps but the first. The score on the
# model card is an average over single pictures. It does not say whether the errors agree with each
# other, and that is what the controller feels. Measure bias and variance separately (notebook 7
# shows how).
#
# Errors that disagree can even be put to use. Model 0 errs to the left by 0.5, model 1 to the right
# by 0.6, model 2 never, at a price of 1 a step.

# %% alt="Three schedules over 12 steps with their costs. The exact model throughout costs 12.00. Greedy runs it for eight steps and then errs to the left four times: 14.76. The optimum never runs the exact model; it errs to the left and to the right in turn: 0.48."
means = np.tile([[-0.5], [0.6], [0.0]], (H, 1, 1))
opposite = SelectionProblem(psi(line(H)), means, 0 * means, model_cost=[0, 0, 1])
greedy, best = stepwise_cost(opposite).argmin(axis=1), solve(opposite)
assert best.is_optimal and 2 not in best.choices
figure, axes = plt.subplots(figsize=(10, 4.2))
for name, choices, look in [
    ("exact model throughout", np.full(H, 2), {"color": BLACK, "marker": "x", "ls": ":"}),
    ("each step by itself (greedy)", greedy, {"color": GREEN, "marker": "D", "ls": "--"}),
    ("optimal", best.choices, {"color": RED, "marker": "o", "ls": "-"}),
]:
    label = f"{name}: {opposite.total_cost(choices):.2f}"
    axes.plot(choices, ms=9, drawstyle="steps-mid", label=label, **look)
axes.set(xlabel="step", yticks=[0, 1, 2], yticklabels=["left 0.5", "right 0.6", "exact"])
axes.set(ylim=(-0.3, 4.1), title="Two wrong models in turn beat the right one")
axes.legend(loc="upper left")
plt.show()

# %% [markdown]
# Greedy pays more than the exact model throughout: each of its last four errors is cheap alone, and
# together they are not.
#
# ## Variance never couples steps; the mean does
#
# In the formula each $\Sigma_t$ stands beside its own $\Psi_{tt}$ only. So if all means are zero,
# or if $\Psi$ is block diagonal, the total is a sum over steps, and one minimum a step is the
# optimum: `solve_separable`, in $O(HW)$. To see the coupling, change two steps of a schedule one by
# one and together. If steps do not couple, the two changes add up. The interaction should be
# $2\alpha\, \delta_t^\top \Psi_{tk} \delta_k$ with the difference $\delta$ of the two models' means.
# No variance in it.


# %%
def interaction(problem, t, k):
    """How far changing steps t and k together differs from the sum of both changes."""
    base = np.zeros(len(problem.mean), dtype=int)
    first, second, together = base.copy(), base.copy(), base.copy()
    first[t] = second[k] = together[[t, k]] = 1
    total = problem.total_cost
    return float(total(together) - total(first) - total(second) + total(base))


H = 6
biases = rng.uniform(0.5, 1.5, size=(H, 3, 1)) * [[0.8], [0.4], [0.1]]  # all of one sign
variances, prices = rng.uniform(0.1, 0.5, size=(H, 3, 1)), np.array([0, 0.4, 1.2])
suites = {
    "noise only, open_loop": SelectionProblem(psi(line(H)), 0 * biases, variances, prices),
    "bias and noise, causal": SelectionProblem(psi(line(H), "causal"), biases, variances, prices),
    "bias and noise, open_loop": SelectionProblem(psi(line(H)), biases, variances, prices),
}
for name, problem in suites.items():
    delta = (problem.mean[:, 1] - problem.mean[:, 0])[:, 0]
    predicted = 2 * delta[:, None] * problem.psi * delta
    pairs = [(interaction(problem, t, k), predicted[t, k]) for t in range(H) for k in range(t)]
    found, predicted = np.array(pairs).T
    np.testing.assert_allclose(found, predicted, atol=1e-9)
    exact = enumerate_schedules(problem).cost  # all 3^6 schedules
    step_by_step = float(problem.total_cost(stepwise_cost(problem).argmin(axis=1)))
    print(f"{name:26s} largest interaction {np.abs(found).max():6.2f}", end="   ")
    print(f"step by step {step_by_step:6.2f}, optimum {exact:6.2f}")
    if name != "bias and noise, open_loop":
        np.testing.assert_allclose([solve_separable(problem).cost, step_by_step], exact)
    else:
        assert step_by_step > 1.2 * exact

# %% [markdown]
# ## A coin does not help
#
# Could a robot do better by choosing at random? Let it run model $w$ at step $t$ with probability
# $b_{tw}$, independently. Each schedule then has a probability, a product over the steps, and the
# expected total is the average over schedules. In the probabilities of *one* step it is therefore
# linear: a straight line, lowest at an end. Step by step every coin can be replaced by a choice that
# is no worse.
# (A *blend* is another thing: a new model whose error is the average of two errors, in the paper's
# Problem 4 and notebook 4. Half of $+1$ and half of $-1$ errs by 0. A coin between them has mean 0
# too, but it never errs by 0.)

# %%
H = 5
rivals = np.tile([[1.0], [-1.0]], (H, 1, 1))
duel = SelectionProblem(psi(line(H)), rivals, 0 * rivals, model_cost=[0, 0.5])
schedules = np.array(list(product(range(2), repeat=H)))
totals = duel.total_cost(schedules)


def coin_cost(weights):
    """Expected total when step t runs model w with probability weights[t, w]."""
    return weights[np.arange(H), schedules].prod(axis=1) @ totals


weights = np.full((H, 2), 0.5)  # fair coins
paid = [coin_cost(weights)]
for t in range(H):
    ends = [np.where(np.arange(H)[:, None] == t, one_model, weights) for one_model in np.eye(2)]
    np.testing.assert_allclose(paid[-1], np.mean([coin_cost(end) for end in ends]))  # a line
    weights = min(ends, key=coin_cost)
    paid.append(coin_cost(weights))
print("fair coins cost", f"{paid[0]:.2f}; replaced one by one:", *(f"{x:.2f}" for x in paid[1:]))
print(f"best schedule  {totals.min():.2f}")
assert (np.diff(paid) <= 0).all() and (paid >= totals.min()).all()

# %% [markdown]
# ## Within a step: a variance vector is not enough
#
# A model may estimate several things from one picture, and then their errors are correlated. Two
# inputs push the same robot, $x_{t+1} = x_t + u_t + s_t^{(1)} + s_t^{(2)}$. Both models below have
# variances $(1, 1)$. The errors of the cheap one agree (correlation 0.8); those of the dear one
# oppose each other ($-0.8$). `variance` of shape $(H, W, p)$ states uncorrelated components, shape
# $(H, W, p, p)$ a covariance.

# %%
H, p = 4, 2
pushed_twice = psi(line(H, C=[[1, 1]]))
correlation = np.array([0.8, -0.8])
covariance = np.broadcast_to(np.eye(2), (2, 2, 2)) + correlation[:, None, None] * np.eye(2)[::-1]
zeros = np.zeros((H, 2, p))
vector = SelectionProblem(pushed_twice, zeros, zeros + 1, model_cost=[0, 0.5])
full = replace(vector, variance=np.tile(covariance, (H, 1, 1, 1)))
signs = np.array(list(product((-1.0, 1.0), repeat=H * p))).reshape(-1, H, p)
for w in range(2):
    draws = signs @ np.linalg.cholesky(covariance[w]).T  # covariance of a step: covariance[w]
    truth = quadratic(pushed_twice, draws).mean() + H * vector.model_cost[w]
    always = [w] * H
    print(f"model {w} throughout: vector says {vector.total_cost(always):6.3f},", end=" ")
    print(f"covariance {full.total_cost(always):6.3f}, all 256 draws {truth:6.3f}")
    np.testing.assert_allclose(full.total_cost(always), truth)
chosen = solve(vector).choices
print("chosen by the vector:", *chosen, " by the covariance:", *solve(full).choices)
assert (solve(full).choices != chosen).any()

# %% [markdown]
# The theorem of Solution 2 in the paper assumes that the errors of all models at all steps are
# independent. Too much in one place: models may share their noise, since only one runs at a time.
# Too little in another: the components *within* a step must be uncorrelated, or else
# $\mathrm{tr}(\Psi_{tt} \Sigma_t)$ takes the place of $\sum_r \Psi_{tt}[r, r]\, v_{tr}$.
#
# ## Over time: independence is an assumption
#
# Consecutive pictures look alike, so a network's errors persist. Let the noise have variance 1 and
# correlation $\rho^{|t-k|}$ between steps $t$ and $k$ (an autoregressive process).
# `correlated_cost` computes the exact expected cost for any covariance over time.


# %% alt="Cost relative to independent errors, against their correlation rho. For rho above 0 open loop rises to 8.8 at rho = 1 and preview to 2.1; for rho below 0 both fall toward 0. Causal stays at 1 throughout."
def persistent(rho):
    """covariance(t, w, k, v) of errors with variance 1 and correlation rho^|t-k|."""
    return lambda t, w, k, v: rho ** abs(t - k)


H, rhos = 12, np.array([-0.9, -0.6, -0.3, 0, 0.3, 0.6, 0.8, 0.9, 1])
looks = {"open_loop": (RED, "o"), "preview": (BLUE, "s"), "causal": (GREEN, "^")}
figure, axes = plt.subplots()
for information, (color, marker) in looks.items():
    Psi = psi(line(H), information)
    white = SelectionProblem(Psi, np.zeros((H, 1, 1)), np.ones((H, 1, 1)), [0])
    always, independent = [0] * H, float(white.total_cost([0] * H))
    ratio = [correlated_cost(white, always, persistent(rho)) / independent for rho in rhos]
    label = f"{information}: {ratio[5]:.2f} at $\\rho$ = 0.6, {ratio[-1]:.2f} at 1"
    axes.plot(rhos, ratio, color=color, marker=marker, ms=8, label=label)
    np.testing.assert_allclose(ratio[-1], Psi.sum() / Psi.trace())  # that of a constant bias
axes.set(xlabel="correlation $\\rho$ of consecutive errors", ylabel="cost / cost if independent")
axes.set_title("Errors that persist cost like a bias, errors that alternate cancel")
axes.legend(loc="upper left")
plt.show()

# %% [markdown]
# At $\rho = 1$ an error never changes: a bias drawn once, with the factor of a bias. Without a
# forecast $\rho$ does not matter, unless the robot filters: a filter carries old errors along,
# which is a correlation made by the robot itself.
#
# This moves decisions. A model with variance 1 whose errors persist ($\rho = 0.9$), against one
# with variance 1.69 whose errors are independent, at the same price:

# %%
H = 8
spread = np.tile([[1.0], [1.69]], (H, 1, 1))
slow_or_white = SelectionProblem(psi(line(H)), 0 * spread, spread, model_cost=[0, 0])


def truth(t, w, k, v):
    """Model 0: variance 1, correlation 0.9^|t-k|.  Model 1: variance 1.69, independent."""
    if w != v:
        return 0.0
    return 0.9 ** abs(t - k) if w == 0 else 1.69 * (t == k)


believed = solve(slow_or_white).choices
schedules = list(product(range(2), repeat=H))
paid = [correlated_cost(slow_or_white, c, truth) for c in schedules]
best = schedules[int(np.argmin(paid))]
print("if errors were independent:", *believed, f"  really costs {paid[0]:.1f}")
print("best of all 256 schedules: ", *best, f"  costs {min(paid):.1f}")
assert tuple(believed) == schedules[0] and paid[0] > 3 * min(paid)

# %% [markdown]
# `solve` optimises for independent errors, as the paper does. `correlated_problem` makes another
# selection problem of errors that correlate, with one component a model, in which every schedule
# costs what it really costs; any solver then finds the best of all 256.

# %%
found = solve(correlated_problem(slow_or_white, truth))
print(*found.choices, f"  costs {found.cost:.1f}, proved: {found.is_optimal}")
assert found.is_optimal and np.isclose(found.cost, min(paid))

# %% [markdown]
# ## The theorem of equivalence
#
# `thm:equivalence`: minimising the simulated total $\alpha J(\hat u_c) + \beta J^{\mathrm{per}}_c$
# over all schedules $c$ (Problem 1), and minimising
# $\alpha\, e_c^\top \Psi e_c + \beta J^{\mathrm{per}}_c$ (Problem 2), have the same solutions,
# since the two differ by $\alpha J(u^*)$, which no schedule changes. With random errors the same
# holds for expectations (Problem 3). We simulate *all* schedules of a small problem: 81 schedules,
# 16 equally likely noises, three initial states.

# %% alt="Simulated against predicted totals of all 81 schedules, for three initial states. The points of each state lie on one of three parallel straight lines, so the same schedule is lowest on each."
H, W, alpha, beta = 4, 3, 0.8, 0.2
task = line(H)
mean, deviation = rng.normal(size=(H, W, 1)) / [[1], [2], [4]], rng.uniform(0.1, 0.6, (H, W, 1))
problem = SelectionProblem(psi(task), mean, deviation**2, [0, 2, 6], alpha, beta)
schedules = np.array(list(product(range(W), repeat=H)))
predicted = problem.total_cost(schedules)
noise = np.array(list(product((-1.0, 1.0), repeat=H)))[:, None, :, None]
steps = np.arange(H)
errors = mean[steps, schedules] + noise * deviation[steps, schedules]  # (16, 81, H, 1)
pushes = rng.normal(size=(H, 1))
figure, axes = plt.subplots()
for start, color, marker in ((0.0, BLACK, "o"), (-3.0, BLUE, "s"), (7.0, RED, "^")):
    s = np.broadcast_to(pushes, errors.shape)
    J = control_cost(task, *run_controller(task, [start], s, s + errors)).mean(axis=0)
    simulated = alpha * J + beta * problem.perception_term(schedules)
    oracle = float(control_cost(task, *run_controller(task, [start], pushes, pushes)))
    np.testing.assert_allclose(simulated - predicted, alpha * oracle)
    assert simulated.argmin() == predicted.argmin()
    label = f"$x_0$ = {start:g}: $\\alpha J(u^*)$ = {alpha * oracle:.2f}"
    axes.plot(predicted, simulated, color=color, marker=marker, ls="", ms=6, label=label)
axes.set(xlabel="predicted total, objective of Problem 3", ylabel="simulated total (mean of 16)")
axes.set_title("Simulated is predicted plus a constant, for every start")
axes.legend()
plt.show()
assert (solve(problem).choices == schedules[predicted.argmin()]).all()

# %% [markdown]
# Three lines of slope 1: the initial state moves all schedules up or down together, so one schedule
# is best for every start, as the paper says, and `solve` finds it. That the schedule does not depend on $x_0$ has a price
# in modelling: it also cannot react to where the robot is.
#
# ## In one paragraph
#
# Of a model's errors, a controller with linear dynamics and quadratic cost feels two things: the
# mean, through all of $\Psi$, and the covariance within each step, through its diagonal blocks.
# Noise costs what its square says; a bias costs up to $H$ times that, or nothing, depending on
# signs and on what the controller knows. So mean squares mislead, greedy choices are wrong wherever
# biases meet, coins never help, and errors that persist are biases in disguise. The objective is
# exact: simulation and prediction differ by a constant. What remains is to minimise it over $W^H$
# schedules, with a proof: notebook 3.
#
# ## Exercises
#
# ### Exercise 1: any covariance
#
# Let the errors $e \in \mathbb R^{pH}$ have mean $\mu$ and *any* joint covariance $S$ of shape
# $(pH, pH)$, across steps too. Return $E[e^\top \Psi e]$. (Hint: stop the derivation after the
# third step.)


# %% tags=["exercise"]
def expected_regret(Psi, mean, covariance):
    """Return E[e'Psi e] for errors with this mean (pH,) and covariance (pH, pH)."""
    ...


# %% tags=["check", "skip-execution"]
for seed in range(3):
    draw = np.random.default_rng(seed)
    Psi, m, root = psi(line(5, C=[[1, 2]])), draw.normal(size=10), draw.normal(size=(10, 10))
    S = root @ root.T
    answer = expected_regret(Psi, m, S)
    assert answer is not None, "Exercise 1: let expected_regret return a number"
    assert np.ndim(answer) == 0, "Exercise 1: expected one number"
    problem = SelectionProblem(Psi, m.reshape(5, 1, 2), np.zeros((5, 1, 2)), [0])
    expected = correlated_cost(
        problem, [0] * 5, lambda t, w, k, v, S=S: S[2 * t : 2 * t + 2, 2 * k : 2 * k + 2]
    )
    bias = m @ Psi @ m
    assert not np.isclose(answer, bias), "Exercise 1: what the covariance adds is missing"
    assert not np.isclose(answer, expected - bias), "Exercise 1: what the mean adds is missing"
    assert not np.isclose(answer, bias + Psi.diagonal() @ S.diagonal()), (
        "Exercise 1: you used the diagonal of S only; entries off the diagonal meet Psi too"
    )
    assert np.isclose(answer, expected), (
        f"Exercise 1: expected {expected:.4f}, found {answer:.4f}; think of the trace of a product"
    )
print("Exercise 1: right")

# %% [markdown]
# ### Exercise 2: how much bias is as bad as this noise?
#
# A model ($p = 1$) has independent errors of mean 0 and standard deviation $\sigma$ at every step.
# Which constant bias $b \ge 0$, without noise, costs the controller just as much? Return $b$ as a
# function of $\Psi$ and $\sigma$. (Hint: for the plan that charges the end only,
# $b = \sigma/\sqrt H$.)


# %% tags=["exercise"]
def break_even_bias(Psi, sigma):
    """Return the constant bias that costs as much as independent noise of deviation sigma."""
    ...


# %% tags=["check", "skip-execution"]
for information, Q, sigma in product(("open_loop", "preview"), (0.0, 1.0), (0.3, 2.0)):
    Psi = psi(line(9, Q), information)
    answer = break_even_bias(Psi, sigma)
    assert answer is not None, "Exercise 2: let break_even_bias return a number"
    assert answer >= 0, "Exercise 2: return the bias that is not negative"
    cost = error_cost(three_models(Psi, biased=answer**2, noisy=sigma**2))
    case = f"{information}, Q = {Q:g}, sigma = {sigma:g}"
    assert not np.isclose(answer, sigma), (
        f"Exercise 2: {case}: equal mean squares, but the bias costs {cost.bias[0]:.3f} "
        f"and the noise {cost.noise[1]:.3f}"
    )
    assert not np.isclose(answer, sigma**2 * np.trace(Psi) / Psi.sum()), (
        "Exercise 2: this is the square of the bias"
    )
    assert np.isclose(cost.bias[0], cost.noise[1]), (
        f"Exercise 2: {case}: your bias costs {cost.bias[0]:.4f}, the noise {cost.noise[1]:.4f}"
    )
print("Exercise 2: right")

# %% [markdown]
# ### Exercise 3: fool the greedy choice
#
# Invent two models without noise for the robot `line(6)` that plans once (`open_loop`): their mean
# errors, of shape $(6, 2, 1)$, and their prices, two numbers $\ge 0$. Choosing each step by itself
# (`stepwise_cost`) must cost at least ten times the optimum, and the optimum must be positive, or
# else ten times it would say nothing. (The weights $\alpha$ and $\beta$ are 1; where two models cost a
# step the same, model 0 is chosen.) (Hint: which errors look small one by one and add up? Or: what could two opposite errors do
# together?)


# %% tags=["exercise"]
fooling_means = ...
fooling_prices = ...


# %% tags=["check", "skip-execution"]
assert fooling_means is not ... and fooling_prices is not ..., (
    "Exercise 3: set fooling_means (6, 2, 1) and fooling_prices (2,)"
)
fooling_means = np.asarray(fooling_means, dtype=float)
fooling_prices = np.asarray(fooling_prices, dtype=float)
assert fooling_means.shape == (6, 2, 1), (
    f"Exercise 3: expected means of shape (6, 2, 1), found {fooling_means.shape}"
)
assert fooling_prices.shape == (2,) and (fooling_prices >= 0).all(), (
    "Exercise 3: expected two prices of at least 0"
)
assert np.isfinite(fooling_means).all(), "Exercise 3: expected finite means"
fooled = SelectionProblem(psi(line(6)), fooling_means, 0 * fooling_means, fooling_prices)
greedy = float(fooled.total_cost(stepwise_cost(fooled).argmin(axis=1)))
best = enumerate_schedules(fooled).cost
assert best > 1e-9, f"Exercise 3: the optimum must be positive, found {best:.3g}"
assert greedy >= 10 * best, (
    f"Exercise 3: greedy costs {greedy:.4g}, the optimum {best:.4g}: only {greedy / best:.2f} times"
)
print("Exercise 3: right")

# %% [markdown]
# ### Exercise 4: the price of a coin
#
# Return the expected total of a problem with known errors ($p = 1$, no noise) when step $t$ runs
# model $w$ with probability `weights[t, w]`, independently of the other steps. Find a formula that
# would serve at $H = 150$ too, where nobody can list the schedules. (Hint: the error of a coin is itself random. What are its mean and its variance?
# `problem.psi`, `problem.mean`, `problem.model_cost` (one price a model), `problem.alpha` and
# `problem.beta` hold all you need.)


# %% tags=["exercise"]
def price_of_a_coin(problem, weights):
    """Return the expected total cost of drawing models with these probabilities (H, W)."""
    ...


# %% tags=["check", "skip-execution"]
for seed in range(3):
    draw = np.random.default_rng(seed)
    means, chances = draw.normal(size=(5, 3, 1)), draw.dirichlet(np.ones(3), size=5)
    game = SelectionProblem(psi(line(5)), means, 0 * means, [0, 1, 3], alpha=0.7, beta=0.4)
    answer = price_of_a_coin(game, chances)
    assert answer is not None, "Exercise 4: let price_of_a_coin return a number"
    assert np.ndim(answer) == 0, "Exercise 4: expected one number"
    everything = np.array(list(product(range(3), repeat=5)))
    likely = chances[np.arange(5), everything].prod(axis=1)
    expected = likely @ game.total_cost(everything)
    middle = (chances * means[:, :, 0]).sum(axis=1)
    blended = 0.7 * middle @ game.psi @ middle + 0.4 * (chances @ game.model_cost).sum()
    assert not np.isclose(answer, blended), (
        "Exercise 4: this is what a blend costs; a coin errs by one model or the other, so it varies: "
        "add the variance between the models"
    )
    unpriced = 0.7 * likely @ game.control_term(everything)
    assert not np.isclose(answer, unpriced), "Exercise 4: the price of the models is missing"
    assert np.isclose(answer, expected), (
        f"Exercise 4: the average over schedules is {expected:.4f}, found {answer:.4f}"
    )
print("Exercise 4: right")
