# %% [markdown]
# # 4. What is lost when a choice may be a fraction?
#
# **After this notebook you can**
#
# - relax choices to weights, stop at any round, and say what is proved;
# - explain why gradients crawl on a stiff $\Psi$ and Newton's method does not;
# - turn weights into a schedule;
# - prove that selection is NP-hard.
#
# **Covers** `eq:perEncoding`, `eq:perModelExpCont`, `prob:model_selection_expectation_cont`,
# `sol:model_selection_expectation_cont`, `thm:psi`, `remark:np_status`.

# %% tags=["hide-input"]
from dataclasses import replace
from itertools import product

import matplotlib.pyplot as plt
import numpy as np

import landing
import modelselect as ms
from modelselect_parts import trellis

plt.rcParams.update(landing.STYLE)
BLUE, RED = landing.LOOK["Best Single"]["color"], landing.LOOK["Optimal"]["color"]

# %% [markdown]
# ## Two steps, two models, a square
#
# The two steps of notebook 0: b0 is free and errs by $1$, b1 costs 0.2 and errs by $-0.5$. Errors
# $d$ cost $d^\top \Psi d$ in control, with $\Psi = (0.9, 0.3;\ 0.3, 0.6)$.
#
# A schedule is a table of zeros and ones, with one 1 for each step (`eq:perEncoding`). The
# **relaxation** allows *weights*: fractions, none negative, that add up to 1 at each step. Errors
# and prices blend by these weights. **Predict** which weights of b1 are the cheapest.

# %%
one, mean = np.eye(1), np.tile([[1.0], [-0.5]], (2, 1, 1))  # H steps, W models, p numbers
cart = ms.ControlTask(one, one, one, one, one, horizon=2)  # A, B, C, Q, R; next, 0 * mean: no noise
toy = ms.SelectionProblem(ms.psi(cart, "preview"), mean, 0 * mean, model_cost=[0, 0.2])
relaxed, best = ms.relax_interior_point(toy, gap=1e-10), ms.enumerate_schedules(toy)
print(f"weights of b1 {relaxed.weights[:, 1].round(3)}, cost {relaxed.value:.3f}")
print(f"best schedule {best.choices}, cost {best.cost:.3f}")
assert relaxed.value < best.cost

# %% [markdown]
# At $\frac23$ both errors vanish; b1's price pulls a little lower. A point of the square is a pair
# of weights, a corner a schedule. So the least cost is a **bound**: no schedule costs less than
# 0.258.

# %% alt="Contours of the relaxed cost over the square of weights: a valley whose lowest point, 0.258, lies inside at (0.64, 0.61). The four corners are the schedules and cost 2.100, 0.950, 0.725 and 0.925, all more." tags=["hide-input"]
side, corners, blend = np.linspace(0, 1, 101), [*product((0, 1), repeat=2)], ms.BlendProblem(toy)
cost = blend.total_cost(np.stack(np.meshgrid(side, side), axis=-1))  # at weights of b1
figure, axes = plt.subplots(figsize=(7.5, 5.8))
shades = axes.contourf(side, side, cost, np.geomspace(0.25, 2.2, 13), cmap="cividis")
for x, y in [*corners, relaxed.weights[:, 1]]:
    axes.plot(x, y, "o", color=RED, markeredgecolor="white", clip_on=False, zorder=3)
    look = {"textcoords": "offset points", "ha": "center", "bbox": {"facecolor": "white", "pad": 2}}
    shift = 40 * (x == 0) - 40 * (x == 1), 16 - 40 * (y == 1)
    axes.annotate(f"{blend.total_cost(np.array([x, y])):.3f}", (x, y), shift, **look)
axes.set(xlabel="weight of b1 at step 0", ylabel="and at step 1", aspect="equal")
axes.set_title("Relaxed, lower than every corner")
figure.colorbar(shades, label="cost", ticks=[0.25, 0.5, 1, 2], format="%.2f")
plt.show()

# %% [markdown]
# ## Duality
#
# Start at equal weights: $d = (\frac14,\frac14)$, cost 0.331. Replace $d^\top \Psi d$ by its
# tangent there: one unit of error costs $2 \Psi d = (0.6, 0.45)$, at any weights. So b0 costs 0.6,
# then 0.45; b1 costs $-0.5 \cdot 0.6 + 0.2 = -0.1$, then $-0.025$. The cheapest is b1, twice. With
# the tangent's constant, $-d^\top \Psi d = -0.131$, that is $-0.256$. A tangent lies below a convex
# function: the minimum is between this and 0.331.
#
# **In general**, let model $w$ at step $t$ have mean error $\mu_{tw}$ and cost $\ell_{tw}$ (price
# and noise). Weights $b$ blend the errors to $d$ and cost $f(b) = \alpha d^\top \Psi d + \sum_{tw}
# \ell_{tw} b_{tw}$ ($\alpha = 1$ so far). Under the tangent at *any* errors $x$, a model costs
# $G_{tw}$, and a schedule at least $LB(x)$:
#
# $$G_{tw} = 2 \alpha \mu_{tw}^\top (\Psi x)_t + \ell_{tw}, \qquad
# LB(x) = \sum_t \min_w G_{tw} - \alpha x^\top \Psi x .$$
#
# 1. $LB(x) \le f(b)$: the tangent is below $f$, and $LB$ is its least value.
# 2. At the best weights, with $x$ their own $d$, both are equal: no move lowers the tangent, as it
#    would lower $f$ at first.
#
# So **max LB = min f**. At any weights $f(b)$ is above the minimum by at most the **duality gap**,
# $f(b) - LB(d)$, so a method may stop at any round. *Projected gradient* steps down the
# gradient, $G$ at $d$, by one over the largest curvature, then to the nearest weights allowed:


# %%
def evaluate(problem, b):
    """Return f, LB and r, G less its least in each row, at weights b (H, W); p = 1."""
    bound, r = ms.reference_bound(problem, (b * problem.mean[:, :, 0]).sum(axis=1))
    return bound + (r * b).sum(), bound, r  # f - LB: sum(G * b) less each row's least


b, curvature = np.full((2, 2), 0.5), 2 * (mean[0] ** 2).sum() * np.linalg.eigvalsh(toy.psi).max()
for k in range(5):
    value, bound, r = evaluate(toy, b)
    print(f"round {k}: {bound:.4f} <= {value:.4f}, weights of b1 {b[:, 1].round(3)}")
    assert bound <= relaxed.value + 1e-12 <= value + 2e-12
    b = ms.project_to_simplex(b - r / curvature)  # as G would: a row's constant drops out

# %% [markdown]
# ## Conditioning
#
# A step that suits the steepest direction is too short for flat ones: rounds may grow with the
# **condition number** $\kappa$ of $\Psi$, its largest eigenvalue over its smallest (large:
# *stiff*); with Nesterov's momentum about as $\sqrt\kappa$. Newton's method scales each direction
# by its own curvature, for one linear system a round; a barrier keeps weights positive. On 20
# steps, two models that err by $\mp1$, an optimum inside:


# %% alt="Rounds to a gap of one millionth against the condition number from 1 to 1000, both logarithmic. Plain gradient rises from 1 to some 4,400, with momentum from 1 to about 200, Newton stays between 4 and 5." tags=["hide-input"]
def gradient(problem, gap, most=30_000):
    """Return how many rounds from equal weights on it takes until the gap is small."""
    size = np.linalg.norm(problem.mean[:, :, 0], axis=1)
    curvature = 2 * np.linalg.eigvalsh(size[:, None] * problem.quadratic * size).max()
    b = np.full(problem.linear.shape, 1 / problem.linear.shape[1])
    for k in range(most):
        value, bound, r = evaluate(problem, b)
        if value - bound <= gap * value:
            return k
        b = ms.project_to_simplex(b - r / curvature)


def stiff(kappa, H=20):
    """Return a problem of two models whose Psi has this condition number, its optimum inside."""
    rng = np.random.default_rng(0)
    V = np.linalg.qr(rng.normal(size=(H, H)))[0]
    root = np.sqrt(np.geomspace(1 / kappa, 1, H))[:, None] * V.T
    mean, d = np.tile([[-1.0], [1.0]], (H, 1, 1)), rng.uniform(-0.7, 0.7, H)
    price = np.stack([0 * d, -4 * root.T @ (root @ d)], axis=1)  # d's gradient vanishes
    return ms.SelectionProblem(root.T @ root, mean, 0 * mean, price - price.min())


kappas = [1, 10, 100, 1000]
rounds = {"plain gradient": [gradient(stiff(k), 1e-6) for k in kappas]}
rounds["with momentum"] = [ms.relax(stiff(k), gap=1e-6).iterations for k in kappas]
rounds["Newton"] = [ms.relax_interior_point(stiff(k), gap=1e-6).iterations for k in kappas]
figure, axes = plt.subplots(figsize=(9, 4.8))
looks = (BLUE, "o-"), (RED, "s--"), ("black", "^:")
for (name, counts), (colour, look) in zip(rounds.items(), looks, strict=True):
    axes.loglog(kappas, counts, look, color=colour, lw=2.5, label=name)
axes.set(xlabel="condition number $\\kappa$ of $\\Psi$", ylabel="rounds to a gap of $10^{-6}$")
axes.set_title("Stiffness costs gradients, not Newton")
axes.legend()
plt.show()

# %% [markdown]
# ## From weights to a schedule
#
# The cart of notebook 0, 40 steps and three models, relaxed:

# %% tags=["hide-input"]
size = np.array([[0.5], [0.2], [0.05]])
mean = np.random.default_rng(0).choice([-1, 1], (40, 3))[:, :, None] * size
A, B, C = [[1, 0.1], [0, 1]], [[0], [0.1]], [[0.1], [0]]
Psi = ms.psi(ms.ControlTask(A, B, C, np.eye(2), [[0.1]], 40), "preview")
mixed = ms.SelectionProblem(Psi, mean, (0.2 * size) ** 2 + 0 * mean, [0, 0.002, 0.004])
root = ms.relax_interior_point(mixed, gap=0)
b = root.weights
print("steps with fractional weights:", (b.max(axis=1) < 0.999).sum(), "of 40")

# %% [markdown]
# **Round and swap**: take the largest weight of each step, then change single steps while that
# helps. **Draw**: take model $w$ at step $t$ with chance $b_{tw}$, independently. Errors are $d$ on
# average, but vary about it; their variance $v_t$ costs $\alpha \Psi_{tt} v_t$ besides
# (`expected_draw`).


# %% tags=["hide-input"]
def expected_draw(problem, b):
    """Return the expected total of independent draws with chances b; p = 1."""
    mu = problem.mean[:, :, 0]
    v = (b * mu**2).sum(axis=1) - (b * mu).sum(axis=1) ** 2
    return evaluate(problem, b)[0] + problem.quadratic.diagonal() @ v


corners = [*product((0, 1), repeat=2)]
chance = [relaxed.weights[[0, 1], c].prod() for c in corners]
np.testing.assert_allclose(expected_draw(toy, relaxed.weights), chance @ toy.total_cost(corners))
results = {
    "draw, on average": expected_draw(mixed, b),
    "rounded": mixed.total_cost(b.argmax(axis=1)),
    "rounded and swapped": ms.round_and_swap(mixed, root).cost,
    "optimum": ms.solve(mixed).cost,
}
for name, cost in results.items():
    print(f"{name:20} {100 * (cost / root.bound - 1):.1f}% above the bound")

# %% [markdown]
# Chance does not know which errors are to cancel. No lottery beats the best schedule *on average*:
# its expected cost is an average over schedules.
#
# ## Switching costs: whole schedules as columns
#
# Half b0, half b1, twice: does one change? Weights of single models do not say. If a change has a
# price, give weights to whole schedules, the **columns**. Blend those at hand at least cost. The
# cheapest schedule at this blend's $G$, switches included, gives a bound and, until that meets the
# cost, the next column.
#
# The toy, at 0.3 a switch:

# %% tags=["hide-input"]
switching = replace(toy, switch_cost=0.3 * (1 - np.eye(2)))
arc, columns = switching.beta * switching.switch_cost, [np.array([0, 0])]
while True:
    means = switching.chosen_mean(np.array(columns))  # (K, pH)
    # What is linear in the blend: prices and switches, all but the errors' quadratic form.
    fees = switching.total_cost(np.array(columns)) - ((means @ toy.psi) * means).sum(axis=1)
    master = ms.SelectionProblem(toy.psi, means[None], 0 * means[None], fees)
    point = ms.relax_interior_point(master, gap=1e-9)
    bound, _ = ms.reference_bound(switching, point.reference)
    print(f"columns {np.array(columns).tolist()}: {bound:.4f} <= {point.value:.4f}")
    if bound > point.value * (1 - 1e-7):
        break
    G = 2 * toy.mean[:, :, 0] * (toy.psi @ point.reference)[:, None] + toy.linear
    columns.append(trellis.cheapest_path(G, arc))
np.testing.assert_allclose(bound, ms.relax_by_columns(switching).bound, rtol=1e-6)

# %% [markdown]
# ## Problem 4: where fractions are legal
#
# The paper's section V blends the worst and the best model, with $c_t \in [0, 1]$ of the best
# (`eq:perModelExpCont`): our relaxation with two models. Mean errors move by some $Dc$, and $c^\top
# (\alpha D^\top \Psi D)\, c = \alpha (Dc)^\top \Psi (Dc) \ge 0$ (**theorem 4**, `thm:psi`): a
# convex quadratic over a box, which takes polynomial time.

# %%
blend = ms.solve_blend(ms.BlendProblem(toy))
print(f"{blend.lower_bound:.4f} <= {blend.cost:.4f}, the relaxation again")
np.testing.assert_allclose(blend.cost, relaxed.value, rtol=1e-5)

# %% [markdown]
# ## What is NP-hard
#
# `remark:np_status` leaves open whether selection is NP-hard. It is.
#
# > **Decision problem.** Given a robot, errors and prices, all rational: is there a schedule of
# total at most $K$? One is quickly checked, so this is in NP.
# >
# > **Direction.** Write a known hard problem *as* selection, in polynomial time. Then whoever
# selects fast solves that fast. The other direction proves nothing.
# >
# > **PARTITION.** Do positive integers $a_t$ split into two groups of equal sum? A robot that
# foresees $s_t$ acts once and pays $u^2+(u+\sum s_t)^2$. Errors move its best $u$ by half their
# sum, which costs twice that half's square: $\Psi = \frac12\mathbf{1}\mathbf{1}^\top$. Let two free
# models err by $\pm a_t$. A schedule costs $\frac12(\sum\pm a_t)^2$. So one of total at most $K =
# 0$ exists **if and only if** the integers split.
# >
# > **MAXIMUM CUT.** Part the nodes of a graph so that most edges join the two sides. With a state
# for each node, and errors $\pm 1$ for the sides, the cheapest schedule is a largest cut (proof:
# `maximum_cut_problem`). Here small numbers are hard (*strongly*), in PARTITION only large ones
# (*weakly*).

# %% tags=["hide-input"]
for integers in ([3, 1, 1, 2, 2, 1], [5, 5, 5, 3]):
    schedule = ms.solve(ms.partition_problem(integers))
    off = abs(np.where(schedule.choices == 0, 1, -1) @ integers)
    print(f"{integers}: sums differ by {off}")
    assert schedule.is_optimal and (schedule.cost < 0.5) == (off == 0)
graph = np.triu(np.random.default_rng(2).random((7, 7)) < 0.5, 1)
sides = np.indices((2,) * 7).reshape(7, -1).T
cuts = [(graph & (side[:, None] != side)).sum() for side in sides]
side = ms.solve(ms.maximum_cut_problem(graph | graph.T)).choices
ours = (graph & (side[:, None] != side)).sum()
print(f"graph of {graph.sum()} edges: our cut {ours}, largest {max(cuts)}")
assert ours == max(cuts)

# %% [markdown]
# Typical instances may be easy: on the published landing, relaxing loses some $10^{-6}$.
#
# **In one paragraph.** Weights make selection convex. Any weights give a value, their tangent a
# bound; at the best weights the two meet. On a stiff $\Psi$ gradients are slow, Newton's method is
# not. Problem 4 relaxes two models, and is polynomial; selection is NP-hard.
#
# ## Recall
#
# <details><summary>At some weights f = 5 and the duality gap is 1. What do you know of the best schedule?</summary>
#
# It costs at least $LB = 4$. Not that it costs at most 5: no schedule need reach $f$.
#
# </details>
# <details><summary>Why does the best LB reach the least f, and not only stay below it?</summary>
#
# At the best weights no move lowers the tangent, as it would lower $f$ at first. So the tangent's
# least value is $f$ there.
#
# </details>
# <details><summary>To show that your problem is NP-hard: do you write it as PARTITION, or PARTITION as it?</summary>
#
# PARTITION as your problem. Then a fast method for yours would solve PARTITION.
#
# </details>
#
# ## Exercises
#
# ### Exercise 1: draw without luck
#
# Write `derandomise(problem, b)`: choices (H,) that cost *at most* `expected_draw(problem, b)`. Go
# through the steps; at each, give all weight to one model after the other, keep the model of the
# least expected draw, and go on with the changed weights. Leave the caller's `b` as it is.


# %% tags=["exercise"]
def derandomise(problem, b):
    """Return choices (H,) that cost no more than a draw with chances b (H, W) on average."""
    ...


# %% tags=["check", "skip-execution"]
for seed in range(20):
    rng = np.random.default_rng(seed)
    factor, means = rng.normal(size=(6, 6)), rng.normal(size=(6, 3, 1))
    test = ms.SelectionProblem(factor.T @ factor, means, rng.random((6, 3, 1)), [0, 0.5, 1])
    chances = rng.dirichlet(np.ones(3), size=6)
    kept = chances.copy()
    found, drawn = derandomise(test, chances), expected_draw(test, kept)
    assert np.shape(found) == (6,), "Exercise 1: return one model for each of the H steps"
    assert np.array_equal(chances, kept), "Exercise 1: you changed the caller's weights; copy them"
    cost = test.total_cost(found)
    assert cost <= drawn + 1e-9, f"Exercise 1: {cost:.3f} is dearer than a draw, {drawn:.3f}"
print("Exercise 1: right")

# %% [markdown]
# ### Exercise 2: a reduction of your own
#
# SUBSET SUM: do some of the positive integers add up to `target`? Write `subset_problem(integers,
# target)`: a `SelectionProblem` with a `psi` of your choice, two models of prices `[0, 0]`, whose
# optimum is 0 **if and only if** they do. (Hint: a last step at which both models err alike.)


# %% tags=["exercise"]
def subset_problem(integers, target):
    """Return a SelectionProblem whose optimum is 0 exactly if a subset adds up to the target."""
    ...


# %% tags=["check", "skip-execution"]
rng = np.random.default_rng(0)
for _ in range(40):
    integers = rng.integers(1, 30, rng.integers(2, 7)).tolist()
    target = int(rng.integers(1, sum(integers) + 1))
    test = subset_problem(integers, target)
    assert isinstance(test, ms.SelectionProblem), "Exercise 2: return a SelectionProblem"
    reachable = {0}
    for value in integers:
        reachable |= {x + value for x in reachable}
    least = ms.enumerate_schedules(test).cost
    assert (abs(least) < 1e-9) == (target in reachable), (
        f"Exercise 2: {integers}, target {target}: optimum {least:.3f}, and a subset "
        + ("does it" if target in reachable else "does not exist")
    )
print("Exercise 2: right")

# %% [markdown]
# ### Exercise 3 (open): when luck beats rounding
#
# Predict: can rounding the relaxation cost three times as much as an *average* draw with the same
# weights? Build `lucky()`, a problem with $p = 1$ where it does, and say in a sentence why. Why
# does this not contradict exercise 1?


# %% tags=["exercise"]
def lucky():
    """Return a SelectionProblem where drawing beats rounding, and a sentence that says why."""
    ...


# %% tags=["check", "skip-execution"]
answer = lucky()
assert answer is not None and len(answer) == 2, "Exercise 3: return a problem and a sentence"
test, why = answer
assert isinstance(test, ms.SelectionProblem), "Exercise 3: return a SelectionProblem first"
shares = ms.relax_interior_point(test, gap=1e-9).weights
ratio = test.total_cost(shares.argmax(axis=1)) / expected_draw(test, shares)
assert ratio > 3, f"Exercise 3: rounding costs only {ratio:.2f} times the average draw"
assert len(why.split()) >= 8, "Exercise 3: explain it in a sentence"
print("Exercise 3: right")
