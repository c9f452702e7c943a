# %% [markdown]
# # 5. The paper's landing, run again and read with care
#
# **After this notebook you can**
#
# - run the experiment again, and check it to seven digits;
# - say why accuracy is bought early, and what Greedy overlooks;
# - tell a difference that is chance from one that is not: by pairs, and by drawing again;
# - say of a percentage what it is a percentage of, and of an experiment what it leaves open.
#
# **Covers** `subsec:expSimulation`, `eq:perceptionCost`, `eq:perceptionModelDistro`,
# `prob:model_selection_expectation`, `fig:simulation_ms`, `fig:simulation_CvL`,
# `fig:simulation_rwd`, `fig:simulation_pareto`, `fig:simulation_traj_h`,
# `fig:allResultSimulation`.
#
# An aircraft comes down from 1000. At each of 150 steps one of eight perception models says what
# disturbs it. Errors $e_t$ add $e^\top \Psi e$ to the control cost (notebook 1): $\Psi_{tt}$ weighs
# the error of step $t$ alone, $2\Psi_{tk}$ the meeting of two. A total is $\alpha$ times control
# cost plus $\beta$ times the prices paid.

# %% tags=["hide-input"]
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import landing
import modelselect as ms

plt.rcParams.update(landing.STYLE)
LOOK = landing.LOOK
ORANGE, BLUE, SKY = (LOOK[name]["color"] for name in ("Optimal", "Best Single", "All Small"))

# %% [markdown]
# ## Two steps
#
# A cart $x_{t+1} = x_t + u_t + s_t$, with $Q = Q_f = R = 1$ and $H = 2$, plans once and never
# looks. Model b0 is free and errs by 1; b1 costs 2 and makes no error; $\alpha = \beta = 1$.

# %%
one, mean = np.eye(1), np.tile([[1.0], [0.0]], (2, 1, 1))
cart = ms.ControlTask(one, one, one, one, one, horizon=2)
toy = ms.SelectionProblem(ms.psi(cart, "open_loop"), mean, 0 * mean, model_cost=[0, 2])
print(toy.psi)
np.testing.assert_allclose(toy.total_cost([[0, 0], [1, 0], [0, 1], [1, 1]]), [3.6, 2.6, 3.4, 4])

# %% alt="Four bars. b0 b0, Greedy's choice, costs 3.6: 2.0 step by step and 1.6 where errors meet. b1 b0, the optimum, costs 2.6: a price of 2 and 0.6. b0 b1 costs 3.4: 2 and 1.4. b1 b1 costs 4, all price." tags=["hide-input"]
figure, axes = plt.subplots(figsize=(10, 3.6))
bars = {"b0 b0 (Greedy)": (0, 2, 1.6), "b1 b0 (optimal)": (2, 0.6, 0)}
bars |= {"b0 b1": (2, 1.4, 0), "b1 b1": (4, 0, 0)}
price, alone, meet = np.transpose([*bars.values()])
axes.barh([*bars], price, color=SKY, label="price")
axes.barh([*bars], alone, left=price, color=BLUE, label="step by step")
axes.barh([*bars], meet, left=price + alone, color=ORANGE, hatch="//", label="where errors meet")
axes.set(ylim=(3.5, -0.5), xlabel="cost", xlim=(0, 6), title="Model b1 pays at the first step")
axes.legend(loc="center right")
plt.show()

# %% [markdown]
# Alone, the first error costs 1.4, the second 0.6: neither is worth 2. So **Greedy**, which
# looks at each step by itself, buys nothing. But errors also **meet**, for $2 \cdot 0.8$, and
# it pays 3.6.
#
# Nothing grows here: the first error costs more as the push it imagines acts on two states. No
# entry of $\Psi$ is negative, the aircraft's neither, so errors of one sign never cancel.
#
# ## The aircraft
#
# State: altitude, its rate, pitch, its rate; control: the elevator. By the authors' code it flies
# 150 steps of 0.01 s from $x_0 = (1000, 2, 2, 0.2)$, with $R = 1$ and $Q = Q_f =
# \mathrm{diag}(10^8, 1, 10^8, 1)$. What perception sees, uniform from 0 to 0.002, enters the
# pitch, and the controller plans once (`open_loop`). Model $w$ costs $w\Upsilon$, $\Upsilon =
# 10^{14}$; $\alpha = 0.8$, $\beta = 0.2$. One number of the authors' log checks most of it:
# $J^\star$, the control cost without input and error.
#
# At every step the mean error of b7 is drawn from 0 to 0.05; b6 down to b0 each add one more,
# up to 0.1, 1, 4, 8, 12, 16 and 16. Variances are summed likewise, but no draw exceeds 0.3. So
# bias differs a thousandfold, noise hardly, and **every mean error is positive**.
#
# A schedule $c$ of models $c_t$ has the means $\mu_c$ and the variances $v_{t,c_t}$. Beyond a
# flight without errors or prices it costs, in expectation,
#
# $$\alpha\Big(\mu_c^\top \Psi \mu_c + \sum_t \Psi_{tt} v_{t,c_t}\Big)
# + \beta\Upsilon \sum_t c_t .$$

# %%
aircraft = landing.preset("published")
task, H = aircraft.task, aircraft.task.horizon
nothing = np.zeros((H, 1))
perfect = ms.control_cost(task, *ms.run_controller(task, aircraft.x0, nothing, nothing))
print(f"J* = {perfect:.6e}")
assert f"{perfect:.6e}" == "5.189117e+15"  # the authors' log
result = landing.run_experiment()  # draws the suite, solves the problem, flies 100 times
suite, problem, optimal = result.suite, result.problem, result.optimal

# %% tags=["hide-input"]
for w, name in enumerate(suite.names):
    bias, noise = suite.mean[:, w].mean(), np.sqrt(suite.variance[:, w].mean())
    used = (optimal.choices == w).sum()
    print(f"{name}: mean error {bias:6.3f}, deviation {noise:.2f}, optimal at {used} steps")
assert suite.mean.min() > 0 and problem.psi.min() > 0  # so that nothing ever cancels
assert optimal.is_optimal and ms.check_certificate(problem, optimal) <= optimal.cost

# %% [markdown]
# The schedule is proved the best of $8^{150}$ (notebook 3).
#
# ## Why accuracy is bought early
#
# The optimum goes from b4 and b5 down to b0, as $\Psi_{tt}$ falls, 20-fold in 75 steps. *Predict:*
# is it the growing mode, the eigenvalue 1.0065 of $A$?

# %%
fall = problem.psi[0, 0] / problem.psi[75, 75]
growth = abs(np.linalg.eigvals(task.A)).max()
damped = task.A.copy()
damped[1, 1] = 0.99  # altitude's rate dies away, and no eigenvalue is beyond 1
calm = ms.psi(replace(task, A=damped), "open_loop").diagonal()
print(f"fall {fall:.1f}; growth alone {growth ** (2 * 75):.1f}; no growth {calm[0] / calm[75]:.1f}")
assert 20 < fall < 21 and growth ** (2 * 75) < 2.7 and calm[0] / calm[75] > 9
assert abs(np.linalg.eigvals(damped)).max() < 1 + 1e-9

# %% alt="Above, the optimal model by step: b4 and b5 at first, smaller ones after step 75, b0 in the last dozen. Below, the sensitivity relative to step 0: it falls 20-fold by step 75; without a growing mode nearly as steeply; growth alone by 2.7." tags=["hide-input"]
figure, (above, below) = plt.subplots(2, sharex=True, figsize=(10, 6.5))
above.step(range(H), optimal.choices, where="mid", color=ORANGE, lw=2)
above.set(yticks=range(8), yticklabels=suite.names, title="Accuracy is bought early")
below.semilogy(problem.psi.diagonal() / problem.psi[0, 0], color=ORANGE, label="$\\Psi_{tt}$")
below.semilogy(calm / calm[0], color=BLUE, ls="--", label="no growing mode")
below.semilogy(growth ** (-2.0 * np.arange(H)), "k:", label="growth alone")
below.set(xlabel="step", ylabel="relative to step 0", ylim=(1e-4, 2))
below.legend(loc="lower left")
plt.show()

# %% [markdown]
# Growth explains 2.7 at most: amplitudes gain $1.0065^{75} = 1.63$, costs its square. The rest
# is duration, as with the cart: a wrong pitch moves the altitude further with every step.
#
# ## Predicted, and flown
#
# The rivals: b7 or b0 throughout (All Large, All Small), the best constant choice (Best Single),
# Greedy, and one random schedule. All fly through the **same** 100 draws of input and errors, so we
# subtract flight by flight; ± gives 95% intervals of means.

# %% tags=["hide-input"]
total = {policy: -flown.reward for policy, flown in result.flights.items()}
base = total["Optimal"].mean()
print(f"Optimal: {base:.4g}. The others pay more by so many percent of it:")
for policy in ("Best Single", "All Large", "Random", "Greedy", "All Small"):
    predicted = 100 * (problem.total_cost(result.flights[policy].choices) - optimal.cost) / base
    lead = 100 * (total[policy] - total["Optimal"]) / base
    mean, half = lead.mean(), landing.half_width(lead)
    print(f"{policy:12} predicted {predicted:7.2f}, flown {mean:7.2f} ± {half:.2f}")
    assert abs(mean - predicted) < 2 * half
for policy in ("Greedy", "Optimal"):
    c = result.flights[policy].choices
    mu = problem.chosen_mean(c)
    paid, seen = mu @ problem.psi @ mu, problem.psi.diagonal() @ mu**2
    noise = problem.spread[np.arange(H), c].sum()
    print(f"{policy}: meetings make bias cost {paid / seen:.0f} times as much;", end="")
    print(f" noise costs {noise / paid:.0e} of that")
assert 50 < paid / seen < 52 and noise / paid < 0.001  # of Optimal
silent = ms.solve(replace(problem, variance=0 * problem.variance))
assert (silent.choices == optimal.choices).all()

# %% [markdown]
# **Best Single** (b4) pays 24% more: so much is a schedule worth.
#
# **Greedy** sees a small part of the bill: each of 150 errors meets 149 of its own sign.
# **Noise** decides nothing: without any, the optimum is the same. So at these prices the experiment
# cannot show "how the variance of the perception models matters".
#
# Perception against control cost, with proved optima for 40 ratios $\alpha : \beta$. Greedy
# is near the optimum for control weighted 70 times less:

# %% alt="Extra control cost on a log scale against perception cost. Forty optima form a falling line from All Small at the upper left to All Large at the lower right. Optimal lies on it, Greedy nearly, far up; Best Single and Random lie well above it." tags=["hide-input"]
figure = landing.plot_pareto(result)
plt.show()
greedy, less = result.flights["Greedy"].choices, replace(problem, alpha=problem.alpha / 70)
near = ms.solve(less).choices
assert abs(near.sum() / greedy.sum() - 1) < 0.1
assert abs(problem.control_term(near) / problem.control_term(greedy) - 1) < 0.1

# %% [markdown]
# As a film:

# %% tags=["hide-input"]
import json
from pathlib import Path
from string import Template

from IPython.display import HTML

ideal = result.flights["Oracle"].altitude[0].round()
shown = [
    {"name": k, **LOOK[k], "altitude": f.altitude[0].round().tolist(), "models": f.choices.tolist()}
    for k, f in result.flights.items()
    if k in ("Optimal", "Best Single", "All Small")
]
film = {"steps": H, "dt": aircraft.dt, "low": -2000, "high": 1050, "policies": shown}
film |= {"names": list(suite.names), "ideal": ideal.tolist(), "ticks": [-2000, -1000, 0, 1000]}
label = "Animation: altitude and model in use over time of Optimal, Best Single and All Small"
template = (Path(landing.__file__).parent / "notebooks" / "player.html").read_text("utf-8")
HTML(Template(template).substitute(name="film", label=label, data=json.dumps(film)))

# %% alt="Altitude over 1.5 seconds, eight panels; all pass through the ground. Oracle and All Large come down from 1000 to minus 220, Clairvoyant and Optimal to some minus 900, Best Single to minus 1450, Random, Greedy and All Small to minus 5000 to 14000." tags=["hide-input"]
figure = landing.plot_landing(result)
figure.set_size_inches(10, 6.2)
figure.suptitle("No policy lands (dotted: Oracle; note the scales)")
plt.show()

# %% [markdown]
# None lands: the model knows no ground, only a penalty on altitude. (Oracle neither errs
# nor pays; Clairvoyant knows each flight's errors beforehand.)
#
# ## Which differences are chance?
#
# The authors' suite is one draw, and so are ours and their *one* random schedule. No interval
# over flights knows of that, so draw all again, twenty times.

# %% tags=["hide-input"]
log, order = landing.published_log(result.settings), ("All Large", "Optimal", "Random", "All Small")
runs = [landing.run_experiment(landing.Settings(trials=1, seed=seed)) for seed in range(1, 21)]
again = np.array([[run.means()[policy][0] for policy in order] for run in runs])
for policy, values in zip(order, again.T, strict=True):
    low, theirs, high = np.array([values.min(), log[policy][0], values.max()]) / 1e15
    print(f"{policy:10} control cost by the log {theirs:8.3f}e15, ours {low:.3f} to {high:.3f}")
    assert low < theirs < high
assert (np.diff(again) > 0).all() and max(run.optimal.choices.max() for run in runs) < 7
new, old = log["Optimal"][0], log["Random"][0]
fixed = problem.alpha * perfect  # part of each total
single = [run.problem.total_cost(run.flights["Best Single"].choices) + fixed for run in runs]
more = np.array(single) / [run.optimal.cost + fixed for run in runs] - 1
print(f"Total cost, predicted: Best Single's is {more.min():.0%} to {more.max():.0%} more")
assert 0.215 < more.min() and more.max() < 0.265
print(f"Control cost: Random's is {old / new - 1:.1%} more, Optimal's {1 - new / old:.1%} less")
assert round(old / new - 1, 3) == 5.674 and round(1 - new / old, 3) == 0.850

# %% [markdown]
# The published control costs lie among ours. Not chance: the order of the four, and b7 never used.
# By the suite, Best Single's 24% is 22 to 26%, not ± 0.15.
#
# **A percentage of what?** "567.18% lower control cost" than Random, says the paper. That (567.4%
# by the log) is a share of Optimal's cost; the reduction is 85.0%. ([paper.md](paper.md) has all
# errata.)
#
# ## What it cannot show
#
# The paper's text lets the controller see the true state and plan anew. So try the other
# information patterns of notebook 1. And the true input, at most 0.002, is below b7's average
# error: try a ninth model, free, that always says 0.001.


# %% tags=["hide-input"]
def with_constant(offset=0.0, noise=0.002 / 12**0.5, run=result):
    """The problem with a ninth, free model, of this mean error and standard deviation."""
    tables = {"mean": (run.suite.mean, offset), "variance": (run.suite.variance, noise**2)}
    nine = {k: np.append(v, np.full((H, 1, 1), ninth), axis=1) for k, (v, ninth) in tables.items()}
    return replace(run.problem, **nine, model_cost=np.append(run.suite.cost, 0))


# %% tags=["hide-input"]
for information in ("preview", "causal", "measurement"):
    other = replace(problem, psi=ms.psi(task, information))
    harm = other.control_term(np.zeros(H, dtype=int)) / perfect
    print(f"{information}: All Small is optimal, and its errors cost {harm:.1%} of J*")
    assert not ms.solve(other).choices.any() and harm < 0.017
assert (ms.solve(with_constant()).choices == 8).all()

# %% [markdown]
# Under feedback perception is not worth these prices; planned once, the constant is best at every
# step. So the experiment does not show that this landing needs perception.
#
# ## The textbook aircraft
#
# Ellert and Merriam (1963): 20 s from 100 ft along a glide path, gusts of mean 0, errors that
# shrink with altitude. (Prices follow what errors cost in each row.) The guess, free, is "no gust".
# The lead is what Best Single pays beyond Optimal, paired and (apart); then as a share of Optimal's
# total, and of Best Single's excess over the Oracle.

# %% tags=["hide-input"]
print("total cost:  Optimal  Oracle   guess          lead           (apart)     in %   of excess")
flights = {}
for information in ("open_loop", "causal", "measurement"):
    run = landing.run_experiment(landing.Settings(preset="textbook", information=information))
    total = flights[information] = {policy: -f.reward for policy, f in run.flights.items()}
    best, single, oracle = (total[policy] for policy in ("Optimal", "Best Single", "Oracle"))
    lead, apart = single - best, np.hypot(*map(landing.half_width, (single, best)))
    mean, half = lead.mean(), landing.half_width(lead)
    shares = mean / best.mean(), mean / (single - oracle).mean()
    ninth = with_constant(noise=run.landing.gust, run=run)  # always says: no gust
    guess = oracle.mean() + ms.solve(ninth).cost
    assert (ms.solve(ninth).choices == 8).all() and guess < best.mean()
    print(f"{information:12}{best.mean():8.0f}{oracle.mean():8.0f}{guess:8.0f}{mean:14.1f}", end="")
    print(" ± {:6.1f}{:>8}(± {:6.1f}){:9.1%}{:9.0%}".format(half, "", apart, *shares))
    assert run.optimal.is_optimal and mean > half
    assert total["All Small"].mean() > 1.6 * best.mean()
    if information != "open_loop":  # each step for itself
        assert (run.flights["Greedy"].choices == run.optimal.choices).all()
        assert apart > mean and shares[0] < 0.015 and oracle.mean() > 0.9 * best.mean()

# %% [markdown]
# Planned once, bias accumulates. In the other rows an error is used once and meets none: Greedy
# *is* optimal, and Best Single pays 1.3% more. Paired, that lead is decided; flown apart, 100
# flights leave it **undecided**. But the Oracle pays nine tenths of the total. Of what Best Single
# pays above it, choosing saves an eighth: name the whole with every percentage. All Small pays over
# 60% more, but the guess is again best at every step.
#
# **In one paragraph.** The landing can be rebuilt: $J^\star$ to seven digits, the rest as well as
# draws allow. Accuracy is bought early, as early errors act longest; Greedy fails, as errors of one
# sign meet. The schedule is proved, and flies as predicted: Best Single pays 24% more. At its
# prices, with feedback or a constant guess, there is nothing to choose.
#
# ## Recall
#
# <details><summary>Nothing grows in the cart. Why does its first error cost more?</summary>
#
# The push that it imagines acts on two states, that of the last on one. So in the landing: without
# a growing mode $\Psi_{tt}$ still falls 9-fold in 75 steps.
#
# </details>
# <details><summary>A cost falls from 48.7 to 7.3. By how many percent?</summary>
#
# By 85% of 48.7. The 567% are of 7.3.
#
# </details>
# <details><summary>Two means differ by 5, each is known to ± 14. Undecided?</summary>
#
# If flown apart, yes. If through the same errors, take the differences flight by flight: their
# interval may be ± 1.
#
# </details>
#
# ## Exercises
#
# ### Exercise 1: how many flights?
#
# Write `flights_needed(a, b)` for the total costs of two policies, flight by flight. Return two
# numbers, if flown through the same errors, and if each through its own: the least whole $n$ at
# which $1.96\,\sigma / \sqrt n$ does not exceed the mean difference. (Independent variances add.)


# %% tags=["exercise"]
def flights_needed(a, b):
    """Return the numbers of flights (paired, apart) that decide between two policies."""
    ...


# %% tags=["check", "skip-execution"]
for information in ("causal", "open_loop"):
    a, b = (flights[information][policy] for policy in ("Best Single", "Optimal"))
    answer = flights_needed(a, b)
    assert answer is not None and len(answer) == 2, "Exercise 1: return two numbers"
    squares = {"paired": np.var(a - b), "apart": np.var(a) + np.var(b)}
    for n, (how, square) in zip(answer, squares.items(), strict=True):
        right = np.ceil(1.96**2 * square / (a.mean() - b.mean()) ** 2)
        assert n == int(n) and abs(n - right) <= 1 + 0.02 * right, (  # ddof=1 is as good
            f"Exercise 1: {how}, {right:.0f} flights are needed, not {n}"
        )
    print(information, *answer)
print("Exercise 1: right")

# %% [markdown]
# ### Exercise 2: a Greedy that adds up
#
# Is greed the fault, or not seeing the meetings? Write `adding_up(problem, order)`: decide
# steps in this order, each by what it *adds*, over the $k$ decided before:
# $M_{tt} \mu_{tw}^2 + 2\mu_{tw} \sum_k M_{tk} \mu_k + \ell_{tw}$. ($M = \alpha\Psi$ is
# `problem.quadratic`, $\mu$ `problem.mean`, (H, W, 1), $\ell$, price and noise, `problem.linear`,
# (H, W).) Is front or back better?


# %% tags=["exercise"]
def adding_up(problem, order):
    """Return choices (H,), decided step by step in the given order."""
    ...


# %% tags=["check", "skip-execution"]
for name, order in {"front": range(H), "back": range(H)[::-1]}.items():
    c = adding_up(problem, order)
    assert c is not None and np.shape(c) == (H,), "Exercise 2: return a model for each step"
    c = np.asarray(c, dtype=int)
    for i, t in enumerate(order):  # no other model may add less
        done = list(order[:i])
        met = problem.quadratic[t, done] @ problem.mean[done, c[done], 0]
        mu = problem.mean[t, :, 0]
        added = problem.quadratic[t, t] * mu**2 + 2 * mu * met + problem.linear[t]
        assert np.isclose(added[c[t]], added.min(), rtol=1e-9), (
            f"Exercise 2: from the {name}, step {t}: b{added.argmin()} adds less than b{c[t]}"
        )
    more = problem.total_cost(c) / optimal.cost - 1
    print(f"from the {name}: {more:.1%} above the optimum, both beyond a flight without errors")
print("Exercise 2: right")

# %% [markdown]
# ### Exercise 3 (open): when does a look pay?
#
# Change the world: the constant guess errs by noise of root mean square $r$, or by an unknown
# offset $r > 0$. Which makes looking pay sooner? Predict, then find the least $r$ of each at which
# the optimum of `with_constant(offset, noise)` uses another model, to 2%. Explain.


# %% tags=["exercise"]
def first_look():
    """Return r for noise alone, r for an offset alone, and a sentence that explains them."""
    ...


# %% tags=["check", "skip-execution"]
answer = first_look()
assert answer is not None and len(answer) == 3, "Exercise 3: return two numbers and a sentence"
*r, why = answer
for name, at, world in zip(("noise", "offset"), r, ((0, 1), (1, 0)), strict=True):
    for factor in (0.98, 1.02):
        test = with_constant(*(factor * at * np.array(world)))
        looks = bool((ms.solve(test).choices < 8).any())
        wrong = "too large" if looks else "too small"
        assert looks == (factor > 1), f"Exercise 3: {name}: r is {wrong}"
assert len(why.split()) >= 8, "Exercise 3: explain the two numbers in a sentence"
print(f"the noise may be {r[0] / r[1]:.1f} times the offset")
print("Exercise 3: right")
