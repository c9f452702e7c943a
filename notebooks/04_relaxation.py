# %% [markdown]
# # 4. What is lost when a choice may be a fraction?
#
# **After this notebook you can**
#
# - relax a choice among models to weights, and say what the relaxed value proves;
# - stop any method at any iterate, with its duality gap as the certificate;
# - explain why gradients crawl on a stiff $\Psi$ and Newton's method does not;
# - turn weights into a schedule, and say what drawing at random can and cannot do;
# - tell the polynomial case of the paper (Problem 4) from the NP-hard one, and prove the latter.
#
# **Covers** `eq:perEncoding`, `eq:perModelExpCont`, `prob:model_selection_expectation_cont`,
# `sol:model_selection_expectation_cont`, `thm:psi`, `remark:np_status`.
#
# A relaxation answers an easier question and keeps the answer as a bound.

# %%
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
# $d$ cost $d^\top \Psi d$ in control, with $\Psi = (0.9, 0.3;\ 0.3, 0.6)$. A schedule is a table
# $b$ of zeros and ones, with one 1 in each row (`eq:perEncoding`). The **relaxation** drops the
# integers: $b_{tw} \ge 0$, $\sum_w b_{tw} = 1$; errors and prices blend by these weights.
# **Predict** which weights of b1 are the cheapest.

# %%
one, mean = np.eye(1), np.tile([[1.0], [-0.5]], (2, 1, 1))  # (H, W, p)
cart = ms.ControlTask(one, one, one, one, one, horizon=2)
# A problem is Psi, mean errors (of H steps, W models, p numbers), noise (none) and prices.
toy = ms.SelectionProblem(ms.psi(cart, "preview"), mean, 0 * mean, model_cost=[0, 0.2])
relaxed, best = ms.relax_interior_point(toy, gap=1e-10), ms.enumerate_schedules(toy)
print(f"weights of b1 {relaxed.weights[:, 1].round(3)}, blended error {relaxed.reference.round(3)}")
print(f"relaxed {relaxed.value:.3f} < best schedule {best.choices}: {best.cost:.3f}")
np.testing.assert_allclose(relaxed.reference, [2 / 45, 4 / 45], atol=1e-6)

# %% [markdown]
# By hand: let weight move from b0 to b1. The error $d_t$ falls by 1.5 and the price rises by 0.2
# for each unit. Inside the square neither way gains, so $2 (\Psi d)_t \cdot 1.5 = 0.2$ at both
# steps. So $d = (\frac{2}{45}, \frac{4}{45})$: the reference point of notebook 0, and its bound.

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
# ## In general, and duality in two lines
#
# Let $M = \alpha\Psi$ (here $\alpha = 1$), $\mu_{tw}$ a model's mean error of $p$ numbers, and
# $\ell_{tw}$ its price and cost of noise (`linear`). The blended error is $d_t = \sum_w b_{tw}
# \mu_{tw}$. Minimise $f(b) = d^\top M d + \sum_{tw} \ell_{tw} b_{tw}$, a convex quadratic over
# simplexes.
#
# Notebook 3's identity holds for weights, too. At any point $x$, let $G_{tw} = 2\mu_{tw}^\top
# (Mx)_t + \ell_{tw}$. The reduced cost $r_{tw} \ge 0$ is its excess over the least of its step:
#
# $$f(b) = LB(x) + \sum_{tw} r_{tw} b_{tw} + (d - x)^\top M (d - x), \qquad
# LB(x) = \sum_t \min_w G_{tw} - x^\top M x .$$
#
# So no $LB$ exceeds $\min f$. At $x = d$ the square vanishes; the sum that is left is the **duality
# gap** of Frank and Wolfe: how far $f(b)$ can be from the minimum, known without the minimum. So
# you can stop at any iterate. At the minimum it is 0, as no weight is where $r > 0$ (moving it
# would gain): **max LB = min f**.


# %%
def evaluate(problem, b):
    """Return value, lower bound and gradient (up to a shift of each row) at weights b; p = 1."""
    bound, r = ms.reference_bound(problem, (b * problem.mean[:, :, 0]).sum(axis=1))
    return bound + (r * b).sum(), bound, r


def gradient(problem, gap, most=30_000):
    """Descend from equal weights by steps 1 / L and projection, until the gap is small."""
    mu = problem.mean[:, :, 0]
    S = np.linalg.norm(mu - mu.mean(axis=1, keepdims=True), axis=1)
    L = 2 * np.linalg.eigvalsh(S[:, None] * problem.quadratic * S)[-1]  # the largest curvature
    b = np.full(mu.shape, 1 / mu.shape[1])
    for k in range(most + 1):
        value, bound, r = evaluate(problem, b)
        if value - bound <= gap * value or k == most:
            return b, value, bound, k
        b = ms.project_to_simplex(b - r / L)


for most in (0, 1, 2, 10):
    b, value, bound, _ = gradient(toy, 0, most)
    print(f"round {most:2}: {bound:.4f} <= 0.2578 <= {value:.4f}, weights of b1 {b[:, 1].round(3)}")
    assert bound <= relaxed.value + 1e-12 <= value + 2e-12

# %% [markdown]
# (Weights of a step sum to 1, so only differences from its average model count: hence `S`.) The
# projection, the nearest point of a simplex, is $\max(v - h, 0)$, with one threshold $h$ that makes
# it sum to 1: for $v = (0.9, 0.5, -0.2)$, $h = 0.2$ and the point is $(0.7, 0.3, 0)$.
#
# ## Conditioning
#
# A gradient step is as long as the steepest direction allows. Along a flatter one it covers a share
# of the way, its curvature over $L$. So, for like models at all steps and an optimum inside, rounds
# grow with $\kappa$, the largest eigenvalue of $\Psi$ over the smallest. (An optimum at a corner
# takes fewer; where steps differ, `S` counts, too.) Nesterov's momentum (`relax`) makes that about
# $\sqrt\kappa$. Newton's method (`relax_interior_point`) bends each step by the curvature, for a
# linear system of size $pH$ a round. Here are 20 steps, two models and a $\Psi$ of each $\kappa$:


# %% alt="Rounds to a gap of one millionth against the condition number from 1 to 1000, both logarithmic. Plain gradient rises from 1 to some 4,400, with momentum from 1 to about 200, Newton stays between 4 and 5." tags=["hide-input"]
def stiff(kappa, H=20):
    """Return a problem of two models whose Psi has this condition number, its optimum inside."""
    rng = np.random.default_rng(0)
    V = np.linalg.qr(rng.normal(size=(H, H)))[0]
    root = np.sqrt(np.geomspace(1 / kappa, 1, H))[:, None] * V.T
    mean, d = np.tile([[-1.0], [1.0]], (H, 1, 1)), rng.uniform(-0.7, 0.7, H)
    price = np.stack([0 * d, -4 * root.T @ (root @ d)], axis=1)  # d's gradient vanishes
    return ms.SelectionProblem(root.T @ root, mean, 0 * mean, price - price.min())


kappas = [1, 10, 100, 1000]
rounds = {"plain gradient": [gradient(stiff(k), 1e-6)[3] for k in kappas]}
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
# The cart of notebook 0, 40 steps and three models:

# %%
size = np.array([[0.5], [0.2], [0.05]])
mean = np.random.default_rng(0).choice([-1, 1], (40, 3))[:, :, None] * size
A, B, C = [[1, 0.1], [0, 1]], [[0], [0.1]], [[0.1], [0]]
Psi = ms.psi(ms.ControlTask(A, B, C, np.eye(2), [[0.1]], 40), "preview")
mixed = ms.SelectionProblem(Psi, mean, (0.2 * size) ** 2 + 0 * mean, [0, 0.002, 0.004])
root = ms.relax_interior_point(mixed, gap=0)
b = root.weights
print("steps with divided weights:", (b.max(axis=1) < 0.999).sum(), "of 40")
print("models that share one step: at most", (b > 1e-3).sum(axis=1).max())

# %% [markdown]
# Two are enough where $p = 1$: the cheapest way to a mean error $d_t$ lies on an edge of the lower
# convex envelope of the points $(\mu_{tw}, \ell_{tw})$. (If three such points lie on one line, an
# optimum may divide weight among them, too.)
#
# There are two ways to a schedule. **Round and swap**: take the largest weight of each step, then
# change single steps while that helps. **Draw**: take model $w$ at step $t$ with chance $b_{tw}$,
# independently of other steps. The mean error is $d$ as promised, but the draw adds its own
# variance $V_t$:
#
# $$\mathbb{E}\,\mathrm{total} = f(b) + \alpha \sum_t \mathrm{tr}(\Psi_{tt} V_t), \qquad
# V_t = \sum_w b_{tw} (\mu_{tw} - d_t)(\mu_{tw} - d_t)^\top .$$


# %%
def expected_draw(problem, b):
    """Return the expected total of independent draws with chances b; p = 1."""
    d = (b * problem.mean[:, :, 0]).sum(axis=1, keepdims=True)
    V = (b * (problem.mean[:, :, 0] - d) ** 2).sum(axis=1)
    return evaluate(problem, b)[0] + problem.quadratic.diagonal() @ V


# %% tags=["hide-input"]
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
# Chance does not know which errors are to cancel. An average is never below the least of its
# numbers, so no lottery has a lower *expected* cost than the best schedule. And moving one row at a
# time to its best corner never raises the expectation (exercise 1).
#
# ## Switching costs: whole schedules as columns
#
# If changes have a price, weights on single models do not know what one costs. **Column
# generation** (Dantzig and Wolfe) puts weights on whole schedules, the columns:
#
# 1. A *master* finds the best mixture of a few columns. It is our relaxation again, with one step
#    whose "models" are the columns.
# 2. Its $d$ prices the models. The cheapest path at these prices is the next column, or the proof
#    that there is none.

# %%
switching = replace(toy, switch_cost=0.3 * (1 - np.eye(2)))
arc, columns = switching.beta * switching.switch_cost, [np.array([0, 0])]
while True:
    means = switching.chosen_mean(np.array(columns))  # (K, pH)
    # What is linear in the mixture: prices and switches, all but the errors' quadratic form.
    fees = switching.total_cost(np.array(columns)) - ((means @ toy.psi) * means).sum(axis=1)
    master = ms.SelectionProblem(toy.psi, means[None], 0 * means[None], fees)
    point = ms.relax_interior_point(master, gap=1e-9)
    bound, _ = ms.reference_bound(switching, point.reference)
    print(f"columns: {len(columns)}, {bound:.4f} <= relaxed <= {point.value:.4f}")
    if bound > point.value * (1 - 1e-7):
        break
    G = 2 * toy.mean[:, :, 0] * (toy.psi @ point.reference)[:, None] + toy.linear
    columns.append(trellis.cheapest_path(G, arc))
np.testing.assert_allclose(bound, ms.relax_by_columns(switching).bound, rtol=1e-6)

# %% [markdown]
# It is 0.2582, not 0.2578: columns that never switch blend alike at both steps, so $d_0 = d_1$.
#
# ## Problem 4: where fractions are legal
#
# The paper's section V blends the worst and the best model, $c_t \in [0, 1]$
# (`eq:perModelExpCont`). With $\delta = \mu^{best} - \mu^{worst}$ and $D$ ($pH \times H$) holding
# $\delta_t$ in column $t$, the cost is $c^\top \Psi' c + g^\top c + \mathrm{const}$, $\Psi' =
# \alpha D^\top \Psi D$. **Theorem 4** (`thm:psi`) in one line: $x^\top \Psi' x = \alpha (Dx)^\top
# \Psi (Dx) \ge 0$, for every suite. So it is a convex quadratic over a box: polynomial. It is this
# notebook's relaxation with two models. (*Drawing* one with chance $c_t$ instead adds a
# $V_t = c_t (1 - c_t) \delta_t \delta_t^\top$, which cancels the diagonal of $\Psi'$: not convex
# where steps meet. The paper's assumption, its semidefinite form and all errata:
# [paper.md](paper.md).)

# %%
for name, problem in {"toy": toy, "cart": mixed}.items():
    blend = ms.solve_blend(ms.BlendProblem(problem))
    print(f"{name:4} best blend / best schedule: {blend.cost / ms.solve(problem).cost:.3f}")
    assert blend.lower_bound > blend.cost * (1 - 1e-5)

# %% [markdown]
# Never above the best schedule *of its two models*; of all models, on either side.
#
# ## What is NP-hard
#
# `remark:np_status` leaves open whether selection is NP-hard. It is:
#
# **Decision problem.** Given (rational) $A, B, C, Q, R, H$, errors, prices and a number $K$: is
# there a schedule of total at most $K$? It is *in NP*: its cost, one linear system and a sum, is
# quickly checked.
#
# **Direction.** A known hard problem is written *as* a selection problem, in time polynomial in its
# length. So whoever selects fast solves it fast. (The other direction would prove nothing.)
#
# **PARTITION** (split positive integers into halves of equal sum) needs one state. A robot that
# acts only at $t = 0$ ($B_t = 0$ later) and pays for that and for the end is off by half the sum of
# errors at both: $\Psi = \frac12 \mathbf{1}\mathbf{1}^\top$. Let model 0 err by $+a_t$, and model 1
# by $-a_t$ for a crumb more (free would do, too). The cost is $\frac12 (\sum \pm a_t)^2$ plus less
# than $\frac14$. It is below $\frac12$ **if and only if** the integers split. *Weakly* hard: a
# search's labels carry one number, the signed sum so far, and equal sums merge. Few sums, few
# labels; larger integers, more (pseudo-polynomial).
#
# <details><summary>MAXIMUM CUT, with H states: strongly hard</summary>
#
# The states hand on all errors to the end, which is weighed by $H(2H I - L)$, $L$ the graph's
# Laplacian; errors $\pm 1$ are the sides. Again only $u_0$, now of $H$ numbers, acts. The cost is
# $H(2H^2 - 4\,\mathrm{cut}) - H$ plus less than $\frac12$, with numbers no larger than a polynomial
# in $H$. (PARTITION: Karp 1972; this cut, of edges that all count 1: Garey, Johnson and Stockmeyer
# 1976. PARTITION with constant matrices: $A = B = C = R = 1$, planned once, paying for the end, has
# $\Psi = \frac{H}{H+1} \mathbf{1}\mathbf{1}^\top$.)
#
# </details>

# %% tags=["hide-input"]
for integers in ([3, 1, 1, 2, 2, 1], [5, 5, 5, 3]):
    schedule = ms.solve(ms.partition_problem(integers))
    off = abs(np.where(schedule.choices == 0, 1, -1) @ integers)
    print(f"{integers}: optimum {schedule.cost:.2f}, sums differ by {off}")
    assert schedule.is_optimal and (schedule.cost < 0.5) == (off == 0)
graph = np.triu(np.random.default_rng(2).random((7, 7)) < 0.5, 1)
sides = np.indices((2,) * 7).reshape(7, -1).T
cuts = [(graph & (side[:, None] != side)).sum() for side in sides]
side = ms.solve(ms.maximum_cut_problem(graph | graph.T)).choices
ours = (graph & (side[:, None] != side)).sum()
print(f"{graph.sum()} edges: our cut {ours}, largest {max(cuts)}")
assert ours == max(cuts)

# %% [markdown]
# What this does not say: anything about typical instances (the relaxation of the published one is
# tight to some $10^{-6}$), or about `causal` and `measurement`, where steps decouple.
#
# **In one paragraph.** Letting choices be fractions makes selection convex; value and bound bracket
# its optimum at any iterate, and meet at the best. Gradients get there slowly on a stiff $\Psi$,
# Newton's method does not. The bound is for schedules, too; rounding and swapping gives one, a
# search closes the gap. With switching costs the fractions are of whole schedules. Problem 4 is the
# relaxation itself, and polynomial; the discrete problem is NP-hard. Next: the paper's landing.
#
# ## Recall
#
# <details><summary>At some weights f = 5 and the sum of r b is 1. What do you know of the best schedule?</summary>
#
# It costs at least $LB = 4$. Not that it costs at most 5: no schedule need reach $f$.
#
# </details>
# <details><summary>Why are two models a step enough for the relaxation, if p = 1?</summary>
#
# A mean $d_t$ is had most cheaply on an edge of the lower envelope of the points $(\mu, \ell)$,
# and an edge has two ends.
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
# through the steps; at each, set row $t$ to every corner in turn, keep the one of the least
# expected draw, and go on with the changed weights. Leave the caller's `b` as it is.


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
