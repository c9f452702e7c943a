# %% [markdown]
# # 4. What is lost when a choice may be a fraction?
#
# **After this notebook you can**
#
# - relax a choice among models to weights on a simplex, and say what the relaxed value proves;
# - follow projected gradient step by step and read its duality gap as a certificate;
# - explain why gradients crawl on a stiff $\Psi$, and why Newton's method does not;
# - turn relaxed weights into a schedule with a proved gap, and say why drawing at random does not
#   help;
# - tell the polynomial case of the paper (blends, Problem 4) from the NP-hard one, and prove the
#   latter.
#
# **Covers** `eq:perEncoding` (relaxed), `eq:perModelExpCont` to `eq:perDiffEncodingCont`,
# `prob:model_selection_expectation_cont`, `eq:sdp_proof_4`, `opt:model_selection_cont`,
# `opt:canonical`, `thm:psi`, `ass:pt`, `opt:sdp`, `remark:np_status`; `project_to_simplex`,
# `projected_gradient`, `relax`, `relax_interior_point`, `round_and_swap`, `BlendProblem`,
# `solve_blend`, `sdp_blocks`, `partition_problem`.
#
# A relaxation answers an easier question and keeps the answer as a bound: first how to compute
# it, then what it does and does not tell you.

# %%
from dataclasses import replace
from itertools import product

import matplotlib.pyplot as plt
import numpy as np

import landing
import modelselect as ms
from perception import textbook_suite

plt.rcParams.update(landing.STYLE)
BLUE, RED, GREEN, ORANGE = (
    landing.LOOK[name]["color"] for name in ("Best Single", "Optimal", "Greedy", "All Large")
)

# %% [markdown]
# ## From one-hot to the simplex
#
# A schedule is a table $b$ of zeros and ones with a single 1 in each row (`eq:perEncoding`). The
# **relaxation** keeps the row sums and drops the rest: $b_{tw} \ge 0$, $\sum_w b_{tw} = 1$. With
# the blended mean $d_t = \sum_w b_{tw}\,\mu_{tw}$, it minimises
#
# $$f(b) = d^\top(\alpha\Psi)\,d + \sum_{t,w} \ell_{tw}\, b_{tw},$$
#
# a convex quadratic over a product of simplexes. At the corners $f$ is the expected total of a
# schedule, so the minimum over all $b$ is a lower bound on every schedule.
#
# The smallest case worth drawing: an integrator over two steps (`open_loop`) and two models.
# Model 0 is free and errs by $+1$; model 1 costs 0.3 and errs by $-0.5$.

# %%
one = np.eye(1)
integrator = ms.ControlTask(A=one, B=one, C=one, Q=one, R=one, horizon=2)
mean = np.tile([[1.0], [-0.5]], (2, 1, 1))
small = ms.SelectionProblem(ms.psi(integrator), mean, 0 * mean, model_cost=[0, 0.3])
corners = np.array(list(product((0, 1), repeat=2)))
for c in corners:
    print(f"schedule {c}: one-hot {ms.one_hot(c, 2).tolist()}, cost {small.total_cost(c):.2f}")

# %% [markdown]
# With two models one number a step is enough, the weight of model 1. So the relaxed problem lives
# on a square whose corners are the four schedules. **Predict** where the minimum of $f$ is.

# %%
relaxed = ms.relax_interior_point(small, gap=1e-9)
best = ms.enumerate_schedules(small)
print(f"weights of model 1: {relaxed.weights[:, 1].round(3)}")
print(f"relaxation {relaxed.value:.3f}, lower bound {relaxed.bound:.3f}")
print(f"best schedule {best.choices}, cost {best.cost:.3f}")
assert relaxed.bound <= best.cost
np.testing.assert_allclose(small.psi, [[1.4, 0.8], [0.8, 0.6]])
np.testing.assert_allclose(relaxed.reference, [-0.1, 0.3], atol=1e-4)
np.testing.assert_allclose(relaxed.value, 0.38, rtol=1e-6)

# %% [markdown]
# By hand: a weight shifted from model 0 to model 1 moves $d_t$ by $-1.5$ and costs 0.3, so at a
# minimum inside the square $2(\Psi d)_t \cdot 1.5 = 0.3$ at both steps. With the $\Psi$ asserted
# above that means $d = (-0.1, 0.3)$, weights $(1 - d_t)/1.5 = (0.733, 0.467)$, and
# $f = d^\top\Psi d + 0.3 \cdot 1.2 = 0.02 + 0.36$.

# %% alt="Contours of the relaxed cost over the square of weights: a long valley whose lowest point, 0.38, lies inside at (0.73, 0.47). The four corners are the schedules and cost 3.60, 1.05, 0.45 and 1.50, all more."
side = np.linspace(0, 1, 101)
square = np.stack(np.meshgrid(side, side), axis=-1)  # [..., t] is the weight of model 1 at step t
surface = ms.BlendProblem(small).total_cost(square)  # f in these weights; more of it below


def draw_square(axes, values):
    """Draw costs over the square of weights, the schedules at its corners."""
    ticks, levels = np.linspace(0, 1, len(values)), np.geomspace(0.36, 3.7, 13)
    shades = axes.contourf(ticks, ticks, values, levels, cmap="cividis")
    axes.contour(ticks, ticks, values, levels, colors="white", linewidths=0.4)
    axes.plot(*corners.T, "s", color="black", clip_on=False, zorder=3)
    for c in corners:
        place = (12 - 24 * c[0], 12 - 24 * c[1])
        axes.annotate(
            f"{small.total_cost(c):.2f}",
            c,
            place,
            textcoords="offset points",
            ha="right" if c[0] else "left",
            va="top" if c[1] else "bottom",
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 2},
        )
    axes.set(xlabel="weight of model 1 at step 0", ylabel="and at step 1", aspect="equal")
    axes.set(xticks=[0, 0.5, 1], yticks=[0, 0.5, 1])
    return shades


figure, axes = plt.subplots(figsize=(7.5, 5.8))
shades = draw_square(axes, surface)
axes.plot(*relaxed.weights[:, 1], "o", color=RED, markeredgecolor="white")
axes.annotate("0.38", relaxed.weights[:, 1], (12, 8), textcoords="offset points", color="white")
figure.colorbar(shades, label="cost", ticks=[0.4, 0.8, 1.6, 3.2], format="%.1f")
axes.set_title("Relaxed, lower than every corner")
plt.show()

# %% [markdown]
# Inside the square the errors $+1$ and $-0.5$ cancel on average. No schedule can do that: the best
# corner costs 0.45. The difference, **the gap**, is left to rounding and search.
#
# ## The nearest point of a simplex
#
# Gradient steps leave the simplex; a projection brings them back. The nearest point to $v$ is
# $x = \max(v - h, 0)$ with one threshold $h$ for all entries, chosen so that $x$ sums to one.
# `project_to_simplex` finds $h$ by sorting. By hand, for $v = (0.9, 0.5, -0.2)$: keeping two
# entries gives $h = (0.9 + 0.5 - 1)/2 = 0.2$, and indeed $-0.2 < 0.2$.

# %%
v = np.array([0.9, 0.5, -0.2])
x = ms.project_to_simplex(v)
print("nearest point:", x.round(3))
np.testing.assert_allclose(x, [0.7, 0.3, 0], atol=1e-12)

# %% [markdown]
# **Optimality condition.** $x$ is nearest exactly if $v - x$ makes no acute angle with the way to
# any point $y$ of the simplex, $(v - x)^\top(y - x) \le 0$; as that is linear in $y$, testing the
# corners is enough.

# %%
points = np.random.default_rng(0).normal(size=(1000, 3))
nearest = ms.project_to_simplex(points)
angles = np.einsum("ki,kji->kj", points - nearest, np.eye(3) - nearest[:, None])
assert nearest.min() >= 0 and np.abs(nearest.sum(axis=1) - 1).max() < 1e-12
assert angles.max() < 1e-12
print("no acute angle for any of 1000 random points")

# %% [markdown]
# The picture for three models, in the plane in which entries sum to one; there the simplex is a
# triangle. What lands on an edge or a corner has thrown models out: **projection makes zeros**, and
# that is why relaxed weights are sparse.

# %% alt="The simplex of three models, a triangle, with 45 points joined to their nearest points on it. Most points lie outside and land on an edge, where one model has weight zero, or on a corner, where two have; only the six inside stay where they are."
plane = points - (points.sum(axis=1, keepdims=True) - 1) / 3  # the same nearest point
shown = plane[np.abs(plane).max(axis=1) < 1.6][:45]
landed = ms.project_to_simplex(shown)
flat = np.array([[0, 0], [1, 0], [0.5, np.sqrt(3) / 2]])  # corners of the triangle on paper
figure, axes = plt.subplots(figsize=(8, 6.6))
axes.fill(*flat.T, color="#dddddd", zorder=0)
kinds = {1: ("to a corner", RED, "s"), 2: ("to an edge", BLUE, "o"), 3: ("to itself", GREEN, "^")}
for kept, (name, colour, marker) in kinds.items():
    these = (landed > 0).sum(axis=1) == kept
    start, end = shown[these] @ flat, landed[these] @ flat
    axes.plot(*np.stack([start.T, end.T], axis=1), color=colour, linewidth=1)
    label = f"{name}: {kept} model{'s' * (kept > 1)} left"
    axes.plot(*start.T, marker, color=colour, markersize=7, label=label)
    axes.plot(*end.T, ".", color="black", markersize=5)
for w, corner in enumerate(0.8 * flat + 0.2 * flat.mean(axis=0)):
    axes.text(*corner, f"{w}", ha="center", va="center", weight="bold")
axes.set(aspect="equal", xticks=[], yticks=[], xlabel="corner w: all weight on model w")
axes.set_title("Beyond an edge or a corner, models drop out")
figure.legend(loc="outside lower center", ncols=3, fontsize=12, handletextpad=0.1, columnspacing=1)
plt.show()

# %% [markdown]
# ## One gradient step, and the certificate that comes with it
#
# The derivative of $f$ with respect to $b_{tw}$ is
# $G_{tw} = 2\mu_{tw}^\top(\alpha\Psi d)_t + \ell_{tw}$. A common shift of a row of $G$ changes
# nothing on the simplex, so the reduced cost $r = G - \min_w G$ of `reference_bound` serves as
# gradient. By convexity, for every $b'$,
#
# $$f(b') \ge f(b) + \sum_{t,w} G_{tw}(b'_{tw} - b_{tw}) \ge f(b) - \sum_{t,w} r_{tw} b_{tw} .$$
#
# The right-hand side is the bound $\mathrm{LB}(d)$ of the last notebook, now for $d$ at a relaxed
# point. The difference $\sum r b$ is the **duality gap** of Frank and Wolfe: it needs no optimum
# to compare with, and any iterate has one.


# %%
def evaluate(problem, b):
    """Return value, lower bound and gradient of the relaxation at the weights b."""
    d = np.einsum("tw,twi->ti", b, problem.mean).ravel()
    bound, r = ms.reference_bound(problem, d)
    return bound + (r * b).sum(), bound, r


b = np.full((2, 2), 0.5)
value, bound, r = evaluate(small, b)
d = b @ [1, -0.5]
np.testing.assert_allclose(value, d @ small.quadratic @ d + (b * small.linear).sum())
np.testing.assert_allclose(value - bound, max((r * (b - ms.one_hot(c, 2))).sum() for c in corners))
print(f"at the centre: value {value:.4f}, bound {bound:.4f}, gap {value - bound:.4f}")
assert bound <= relaxed.value <= value

# %% [markdown]
# The first line checks that value against the definition of $f$, the second that the gap is the
# most that the tangent plane promises at any corner. Now a step of length $1/L$, where $L$ bounds
# the curvature. With $p = 1$ and centred means of size
# $S_t = (\sum_w (\mu_{tw} - \bar\mu_t)^2)^{1/2}$, $L$ is twice the largest eigenvalue of
# $\mathrm{diag}(S)\,\alpha\Psi\,\mathrm{diag}(S)$. One step by hand, and by `projected_gradient`,
# whose first step has no momentum yet:


# %%
def curvature(problem):
    """Return L, the largest eigenvalue of the Hessian of f along the simplexes (p = 1)."""
    S = np.linalg.norm(problem.mean - problem.mean.mean(axis=1, keepdims=True), axis=(1, 2))
    return 2 * np.linalg.eigvalsh(S[:, None] * problem.quadratic * S)[-1]


def run(problem, steps, restarts=1):
    """Run projected gradient from the centre; list (weights, value, bound) after every step."""
    seen, step = [], np.full((1, 1), 1 / curvature(problem))  # one length for all

    def look(b):
        found = evaluate(problem, b)
        seen.append((b, *found[:2]))
        return found

    H, W, _ = problem.mean.shape
    b = np.full((H, W), 1 / W)
    for _ in range(restarts):
        b, _ = ms.projected_gradient(look, ms.project_to_simplex, b, step, 0.0, 0.0, steps)
    return seen if restarts == 1 else seen[::2]  # a restart looks at its first point again


by_hand = ms.project_to_simplex(b - r / curvature(small))
path = run(small, 12)
np.testing.assert_allclose(path[1][0], by_hand)
for k in (0, 1, 2, 4, 8, 12):
    point, value, bound = path[k]
    print(f"step {k:2}: weights {point[:, 1].round(3)}  value {value:.4f}  bound {bound:.4f}")
    assert bound <= best.cost

# %% [markdown]
# Whenever you stop, value and bound bracket the optimum 0.38 of the relaxation. (In general neither
# need move steadily.) For schedules only the bound counts.
#
# ## At full scale: why gradients crawl
#
# The published landing: $H = 150$ steps, $W = 8$ models. We run plain projected gradient (momentum
# thrown away after every step), the accelerated method of `projected_gradient`, and
# `relax_interior_point`, which uses Newton's method. Predict: how many steps until the gap is a
# millionth?

# %%
published = landing.run_experiment(landing.Settings(trials=1)).problem
exact = ms.relax_interior_point(published, gap=0)
runs = {"plain gradient": run(published, 1, restarts=1001), "accelerated": run(published, 2000)}
newton = [ms.relax_interior_point(published, gap=0, max_iterations=k) for k in range(1, 13)]
gaps = {name: (seen[-1][1] - seen[-1][2]) / exact.value for name, seen in runs.items()}
print(f"plain gradient: after 1000 steps the gap is {gaps['plain gradient']:.1%} of the optimum")
for name, gap in (("accelerated, 2000 steps", gaps["accelerated"]), ("Newton, 10", newton[9].gap)):
    print(f"{name}: less than a millionth")
    assert gap < 1e-6

# %% alt="Gap against step, both axes logarithmic. After 1000 steps plain gradient is still at one per cent; with momentum the gap is below a millionth after some 1800 steps, with Newton's method after ten. The true error, dashed, lies just below the gap."
figure, axes = plt.subplots()
styles = {"plain gradient": (BLUE, "o"), "accelerated": (RED, "s")}
for name, (colour, marker) in styles.items():
    value, bound = np.array([(point[1], point[2]) for point in runs[name][1:]]).T / exact.value
    k, marks = np.arange(1, len(value) + 1), {"marker": marker, "markevery": 0.12, "markersize": 8}
    axes.loglog(k, value - bound, color=colour, label=f"{name}: gap", **marks)
    axes.loglog(k, value - 1, "--", color=colour, label=f"{name}: true error")
gap = np.array([point.gap for point in newton])
axes.loglog(np.arange(1, 13), gap, "^-", color="black", markersize=8, label="Newton: gap")
axes.axhline(1e-6, color="grey", linestyle=":")
axes.set(xlabel="step", ylabel="share of the optimum", ylim=(1e-10, 10))
axes.set_title("Gradients need a thousand steps and more, Newton ten")
axes.legend(fontsize=12)
plt.show()

# %% [markdown]
# And the gap lies above the true error by little: it is a certificate you can afford to stop on.
#
# The reason why gradients crawl is **conditioning**. A gradient step is as long as the steepest
# direction allows, $1/L$; along a direction of curvature $\lambda$ it covers a share of about
# $\lambda/L$ of the way. The published $\Psi$ weighs an error at step 0 thousands of times as much as one at the
# end, and its directions differ by far more. (Its smallest eigenvalue is zero up to rounding, so
# we look at the second.)

# %%
diagonal, spectrum = published.psi.diagonal(), np.linalg.eigvalsh(published.psi)
print(f"Psi[0, 0] / Psi[149, 149] = {diagonal[0] / diagonal[-1]:.1e}")
print(f"largest eigenvalue / second smallest = {spectrum[-1] / spectrum[1]:.0e}")
assert spectrum[-1] / spectrum[1] > 1e6

# %% [markdown]
# To isolate the effect, conditioning as a knob: a random orthogonal basis, eigenvalues from
# $1/\kappa$ to 1, errors $-1$ and $+1$, and prices that put the relaxed optimum inside the cube.


# %%
def stiff(kappa, H=30):
    """Return a problem of two models whose Psi has condition number kappa."""
    rng = np.random.default_rng(0)
    V = np.linalg.qr(rng.normal(size=(H, H)))[0]
    root = np.sqrt(np.geomspace(1 / kappa, 1, H))[:, None] * V.T
    Psi, d = root.T @ root, rng.uniform(-0.7, 0.7, H)
    mean = np.tile([[-1.0], [1.0]], (H, 1, 1))
    price = np.stack([0 * d, -4 * Psi @ d], axis=1)  # so that d is optimal: its gradient vanishes
    return ms.SelectionProblem(Psi, mean, 0 * mean, price - price.min())


kappas = 10.0 ** np.arange(1, 6)
gradients, interior = (
    [method(stiff(k), gap=1e-8) for k in kappas] for method in (ms.relax, ms.relax_interior_point)
)
for one_way, other in zip(gradients, interior, strict=True):
    np.testing.assert_allclose(one_way.value, other.value, rtol=2e-8)
assert max(point.iterations for point in interior) <= 10 < 500 < gradients[-1].iterations
print("Newton's method never needs more than ten steps; gradients end far above 500")

# %% alt="Left, a narrow valley of cost: 60 plain gradient steps creep along its floor and stop half way, Newton's method reaches the optimum in a few jumps. Right, steps to a gap of 1e-8: as the condition number goes from 10 to 100,000, those of relax grow from about 50 to 3000, those of the interior point stay near 6."
pair = stiff(100, H=2)
flat_path = np.array([point[0][:, 1] for point in run(pair, 1, restarts=60)])
middle = [ms.relax_interior_point(pair, gap=0, max_iterations=k) for k in range(1, 8)]
straight = np.array([[0.5, 0.5]] + [point.weights[:, 1] for point in middle])
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 5))
heights = ms.BlendProblem(pair).total_cost(square)
left.contour(side, side, heights - heights.min(), np.geomspace(1e-5, 1, 14), colors="#999999")
left.plot(*flat_path.T, "o-", color=RED, markersize=4, label="60 plain gradient steps")
left.plot(*straight.T, "^--", color="black", markersize=8, label="Newton")
left.plot(*middle[-1].weights[:, 1], "*", color=BLUE, markersize=18, label="optimum")
left.set(xlabel="weight at step 0", ylabel="weight at step 1", xlim=(0.45, 0.95))
left.set(ylim=(0.2, 0.9))
left.set_title("Creeping along a valley")
left.legend(fontsize=12, loc="lower right", framealpha=1, frameon=True)
for found, look, colour, name in (
    (gradients, "s-", RED, "relax (accelerated)"),
    (interior, "^--", "black", "interior point"),
):
    right.loglog(kappas, [point.iterations for point in found], look, color=colour, label=name)
right.set(xlabel="condition number of $\\Psi$", ylabel="steps to a gap of 1e-8")
right.set_title("Stiffness costs gradients only")
right.legend(fontsize=12)
plt.show()

# %% [markdown]
# **What the interior-point method does instead.** It keeps every weight $b$ and every slack
# $z = G - y$ ($y_t$ the multiplier of $\sum_w b_{tw} = 1$) positive, and lets their products $bz$
# fall to zero together. Each step solves the linearised optimality conditions, curvature included,
# so it hardly feels a change of units or of basis. The price is one positive definite system of
# size $pH$ per step ($H^3$ operations against $H^2$ for a gradient); at $H = 150$ that is a
# bargain.
#
# ## What relaxed weights look like
#
# Two problems of full scale. In the **published** one all mean errors are positive. In the
# **mixed** one (textbook aircraft, `preview`) each model errs with a sign of its own. Predict: in
# which of the two is it tempting to blend?

# %%
textbook = landing.preset("textbook")
suite = textbook_suite(textbook.path[:-1], np.random.default_rng(0), signs="model")
Psi = ms.psi(textbook.task, "preview")
price = suite.cost * landing.cost_scale(Psi, suite)
mixed = ms.SelectionProblem(Psi, suite.mean, suite.variance, price, alpha=0.8, beta=0.2)
problems = {"published": published, "mixed": mixed}
weights = {}
for name, problem in problems.items():
    weights[name] = b = ms.relax_interior_point(problem, gap=0).weights
    fractional, most = (b.max(axis=1) < 0.999).sum(), (b > 1e-3).sum(axis=1).max()
    print(f"{name}: {fractional} of 150 steps fractional, at most {most} models at a step")

# %% alt="Weight of each of eight models over 150 steps. In the published problem every step puts all weight on one model, from b4 and b5 at first down to b0 at the end. In the mixed problem 55 steps, marked by triangles, split it between two models."
figure, panels = plt.subplots(2, sharex=True, figsize=(10, 6.4))
for axes, (name, b) in zip(panels, weights.items(), strict=True):
    picture = axes.imshow(b.T, aspect="auto", origin="lower", cmap="viridis", vmin=0, vmax=1)
    split = np.flatnonzero(b.max(axis=1) < 0.999)
    axes.plot(split, np.full(len(split), 7.9), "v", color=RED, markersize=6)
    axes.set(yticks=range(8), ylabel="model", ylim=(-0.5, 8.3))
    axes.set_title(f"{name}: {len(split)} of 150 steps fractional (triangles)")
    axes.grid(visible=False)
axes.set_xlabel("step")
figure.colorbar(picture, ax=panels, label="weight")
plt.show()

# %% [markdown]
# Errors of opposite signs cancel in a blend, and a third of the steps use that. Errors of one sign
# only add up, and here nothing is blended at all: the published relaxation *is* a schedule, so
# rounding alone is a proof. Is that luck? Five draws of the suite (the first is the one above):

# %%
counts = []
for seed in range(5):
    problem = landing.run_experiment(landing.Settings(trials=1, seed=seed)).problem
    point = ms.relax_interior_point(problem, gap=0)
    counts.append(int((point.weights.max(axis=1) < 0.999).sum()))
    assert problem.total_cost(point.weights.argmax(axis=1)) < point.bound * (1 + 1e-5)
print("fractional steps in five draws:", counts)

# %% [markdown]
# A little: one to three steps may stay fractional, though rounding still ends within $10^{-5}$ of
# the bound. (With $p = 1$ two models a step are enough, as the cheapest way to a mean $d_t$ lies on
# an edge of the lower convex envelope of the points $(\mu_{tw}, \ell_{tw})$.)
#
# ## From weights to a schedule
#
# **Draw at random?** Draw model $w$ at step $t$ with chance $b_{tw}$, independently. The mean
# error is then $d$ on average, but the draw itself adds a variance:
#
# $$\mathbb{E}\,\mathrm{total} = f(b) + \sum_t \alpha\, \mathrm{tr}(\Psi_{tt} V_t), \qquad
# V_t = \sum_w b_{tw}(\mu_{tw} - d_t)(\mu_{tw} - d_t)^\top .$$
#
# We check it on all $2^2$ schedules of the small problem, weighed by their chances.


# %%
def expected_draw(problem, b):
    """Return the expected total of independent draws with chances b (p = 1)."""
    d = np.einsum("tw,twi->ti", b, problem.mean)
    V = (b * ((problem.mean - d[:, None]) ** 2)[..., 0]).sum(axis=1)
    return evaluate(problem, b)[0] + problem.quadratic.diagonal() @ V


b = relaxed.weights
chances = np.array([b[[0, 1], c].prod() for c in corners])
average = chances @ small.total_cost(corners)
print(f"relaxed value {relaxed.value:.3f}; a draw costs {average:.3f} on average")
np.testing.assert_allclose(expected_draw(small, b), average)

# %% [markdown]
# No draw keeps the promise of 0.38. It cannot: however you draw, the expectation is an average over
# schedules, and an average is never below the least of its numbers. **Randomising does not help.**
# For independent draws there is even a way down: the expectation is linear in each row of $b$ while
# the others are fixed (*multilinear*), so one row after the other can move to its best corner
# without ever raising it. Exercise 3 makes an algorithm of that.

# %% alt="Two maps over the square of weights, equal at the corners. Left, the relaxed cost has its minimum inside. Right, the expected cost of a draw is a saddle, and its minimum is the corner of cost 0.45."
shares = np.stack([1 - square[::5, ::5], square[::5, ::5]], axis=-1)  # weights of both models
lottery = np.array([[expected_draw(small, b) for b in row] for row in shares])
assert lottery.min() >= best.cost - 1e-12  # no lottery beats the best schedule
figure, panels = plt.subplots(1, 2, figsize=(10, 5.2), sharey=True)
draw_square(panels[0], surface)
panels[0].plot(*relaxed.weights[:, 1], "o", color=RED, markeredgecolor="white")
panels[0].set_title("Relaxed: minimum inside")
draw_square(panels[1], lottery)
panels[1].plot(*best.choices, "o", color=RED, markeredgecolor="white", clip_on=False, zorder=4)
panels[1].set(title="Drawn: minimum at a corner", ylabel="")
plt.show()

# %% [markdown]
# **Round and swap.** Take the model of the largest weight at each step, then change single steps
# for as long as that lowers the cost: `round_and_swap`. A fair rival is the best of many draws.

# %%
b, root = weights["mixed"], ms.relax_interior_point(mixed)
uniform = np.random.default_rng(1).random((2000, 150, 1))
draws = mixed.total_cost((uniform > b.cumsum(axis=1)).sum(axis=2).clip(max=7))
optimal = ms.solve(mixed)
costs = {
    "draw, expected": expected_draw(mixed, b),
    "draw, average of 2000": draws.mean(),
    "draw, best of 2000": draws.min(),
    "rounded": mixed.total_cost(b.argmax(axis=1)),
    "rounded and swapped": ms.round_and_swap(mixed, root).cost,
    "optimal (solve)": optimal.cost,
}
above = {name: 100 * (cost / root.bound - 1) for name, cost in costs.items()}
for name, percent in above.items():
    print(f"{name:22} {percent:5.2f}% above the bound")
assert root.bound <= optimal.cost <= costs["rounded and swapped"] <= costs["rounded"]
assert abs(draws.mean() - costs["draw, expected"]) < 4 * draws.std() / np.sqrt(2000)

# %% alt="Histogram of the costs of 2000 draws, from 1.8 to about 30% above the bound of the relaxation, with mean 8.3%. The rounded schedule, at 4.2%, beats most draws; swapping brings it to 1.2%, below every draw, near the optimum at 0.9%."
figure, axes = plt.subplots()
axes.hist(100 * (draws / root.bound - 1), bins=40, color="#bbbbbb", label="2000 draws")
axes.axvline(0, color="black", linewidth=3, label="bound of the relaxation")
looks = {
    "optimal (solve)": (RED, "-"),
    "rounded and swapped": (GREEN, ":"),
    "rounded": (ORANGE, "-."),
    "draw, expected": (BLUE, "--"),
}
for name, (colour, style) in looks.items():
    label = f"{name}: {above[name]:.1f}%"
    axes.axvline(above[name], color=colour, linestyle=style, linewidth=3, label=label)
axes.set(xlabel="cost above the bound (%)", ylabel="draws", xlim=(-0.5, None))
axes.set_title("Rounding and swapping beats every draw")
axes.legend()
plt.show()

# %% [markdown]
# So before any search we know: the swapped schedule is at most 1.23% from the best. How much of
# that is the schedule's fault and how much the bound's? `solve` settles it: `dynamic_program`
# starts from this bound and this schedule, discards what cannot lie between them, and closes the
# gap.

# %%
share = above["optimal (solve)"] / above["rounded and swapped"]
print(f"proved optimal: {optimal.is_optimal}, by {optimal.solver}")
print(f"share of the gap that no schedule could have closed: {share:.2f}")
ms.check_certificate(mixed, optimal)  # derives the root bound and the cost anew
assert root.bound <= optimal.lower_bound <= optimal.cost and optimal.is_optimal
assert ms.round_and_swap(published, exact).is_optimal  # there, rounding alone closes it

# %% [markdown]
# Three quarters of the gap belonged to the bound, not to the schedule.
#
# ## Problem 4: blends
#
# The paper's section V makes fractions legal. Only the worst and the best model are left, and
# $c_t \in [0, 1]$ blends their means, variances and costs linearly (`eq:perModelExpCont`,
# `eq:perModelVarCont`). With $\delta = \mu^{best} - \mu^{worst}$, and $D$ the $pH \times H$ matrix
# that holds $\delta_t$ in column $t$,
#
# $$f(c) = c^\top\Psi' c + g^\top c + \mathrm{const}, \qquad \Psi' = \alpha D^\top \Psi D .$$
#
# This is the relaxation again, with all models but two forbidden. So its optimum is never above the
# best schedule *of these two models*; against the best schedule of *all* models (Problem 3) it may
# lie on either side. `solve_blend` is projected gradient on the box, with the same gap. (Slips of
# the paper: it charges $c\Upsilon$, where the best of $W$ models costs $(W-1)\Upsilon$, so
# `BlendProblem` takes the models' own prices; and it calls the programme Boolean and a solution to
# Problem 3.)

# %%
labels = ["relaxation", "Problem 4: blend", "best schedule", "best of two models"]
order = {}
for name, problem in {"two steps": small, **problems}.items():
    ends = np.zeros(problem.mean.shape[1], dtype=bool)
    ends[[0, -1]] = True
    blend = ms.solve_blend(ms.BlendProblem(problem))
    narrow = ms.relax_interior_point(problem, allowed=np.tile(ends, (len(problem.mean), 1)))
    np.testing.assert_allclose(blend.cost, narrow.value, rtol=1e-6)  # one problem, two solvers
    two = ms.solve(replace(problem, model_cost=np.where(ends, problem.model_cost, np.inf)))
    every = ms.solve(problem)
    costs = [ms.relax_interior_point(problem).value, blend.cost, every.cost, two.cost]
    order[name] = np.array(costs) / every.cost
    assert costs[0] <= costs[1] * (1 + 1e-6) and blend.lower_bound <= two.cost
print(" " * 9, *(f"{label:>20}" for label in labels))
for name, costs in order.items():
    print(f"{name:9}", *(f"{x:20.3f}" for x in costs))

# %% [markdown]
# Costs as shares of the best schedule's. Where $W = 2$ the blend costs less than any schedule; in
# the other two it costs more, as most models are missing.
#
# A linear variance is the paper's choice. *Drawing* one of two models with chance $c_t$ would add
# $\alpha\,c_t(1 - c_t)\,\delta_t^\top\Psi_{tt}\delta_t$, and is the # is the saddle of the picture above.
#
# ## Theorem 4: the blend is convex, for every suite
#
# Theorem 4 (`thm:psi`) says that $\Psi'$ is positive semidefinite, under assumption `ass:pt`. The
# assumption is not needed: $x^\top \Psi' x = \alpha\,(Dx)^\top \Psi\,(Dx) \ge 0$, whatever the
# models. The paper works with $p$ tied copies of every $c_t$; then $\Psi'$ is the elementwise
# product $\alpha\Phi \circ \Psi$ with $\Phi = \delta\delta^\top$, and tying the copies with the
# 0-1 matrix $E$ gives ours.
#
# **Erratum, the printed $\Phi$.** The paper prints
#
# $$\Phi_{ij} = \Gamma^0_i\Gamma^0_j + \Gamma^0_i\Gamma^1_j + \Gamma^1_i\Gamma^0_j
# + \Gamma^1_i\Gamma^1_j = (\Gamma^0 + \Gamma^1)_i\,(\Gamma^0 + \Gamma^1)_j .$$
#
# It should be $(\Gamma^1 - \Gamma^0)_i(\Gamma^1 - \Gamma^0)_j$, as the coefficient of $c_t$ in
# the mean is $\Gamma^1 - \Gamma^0$. Both are rank-one Gram matrices, so both keep the theorem
# true; but only one belongs to the objective. Second differences of $f$ decide, here on a task with
# two perception components:

# %%
double = ms.ControlTask(
    A=[[1, 0.5], [0, 1]], B=[[0], [0.5]], C=[[0.5, 0], [0, 0.5]], Q=np.eye(2), R=[[0.2]], horizon=4
)
rng = np.random.default_rng(3)
mean, variance = rng.normal(size=(4, 2, 2)), rng.random((4, 2, 2))
example = ms.SelectionProblem(ms.psi(double), mean, variance, model_cost=[0, 0.5], alpha=0.8)
blend = ms.BlendProblem(example)
G0, G1 = mean[:, 0].ravel(), mean[:, 1].ravel()  # the paper's Gamma^0 and Gamma^1
E = np.kron(np.eye(4), np.ones((2, 1)))  # copies: c' = E c
corrected = 0.8 * np.outer(G1 - G0, G1 - G0) * example.psi
np.testing.assert_allclose(E.T @ corrected @ E, blend.quadratic, atol=1e-12)
f, unit = blend.total_cost, np.eye(4)
second = [[(f(i + j) - f(i) - f(j) + f(0 * i)) / 2 for j in unit] for i in unit]
printed = E.T @ (0.8 * np.outer(G0 + G1, G0 + G1) * example.psi) @ E
np.testing.assert_allclose(second, blend.quadratic, atol=1e-12)
off = np.abs(printed - second).max() / np.abs(second).max()
print(f"corrected: agrees with f; printed: off by {off:.2f} times the largest entry")
assert off > 0.05

# %% [markdown]
# **Erratum, the assumption.** `ass:pt` splits $\Phi = \Phi_c + \Phi_\delta$ with
# $\Phi_c = \tilde\epsilon I + \mathrm{mean}(\Phi)\,\mathbf{1}\mathbf{1}^\top$ and asks for
# $\|\Phi_\delta\| \kappa(\Phi_c) / \|\Phi_c\| \le 1$. But $\Phi$ has rank one, so for $pH \ge 2$ it
# is singular, and no singular matrix is nearer to $\Phi_c$ than its smallest singular value
# $\|\Phi_c\|/\kappa(\Phi_c)$ (Eckart and Young). So the ratio never falls below 1: the assumption
# holds with equality at best, and in general fails for every $\tilde\epsilon$.

# %%
Phi = np.outer(G1 - G0, G1 - G0)
for epsilon in (0.1, 1.0, 10.0, 100.0, 1000.0):
    centre = epsilon * np.eye(8) + Phi.mean()
    distance, size = np.linalg.norm(Phi - centre, 2), np.linalg.norm(centre, 2)
    ratio = distance * np.linalg.cond(centre) / size
    print(f"epsilon {epsilon:6.1f}: ratio {ratio:.4g}")
    assert ratio > 1
assert np.linalg.eigvalsh(blend.quadratic)[0] > 0  # and yet Psi' is semidefinite, even definite

# %% [markdown]
# ## The semidefinite form
#
# The paper proves polynomial time by a semidefinite programme (`opt:sdp`). With
# $\Psi' = N^\top N$, the inequality $f(c) \le \theta$ is a Schur complement:
#
# $$\begin{pmatrix} I & Nc \\ (Nc)^\top & \theta - g^\top c - \mathrm{const} \end{pmatrix} \succeq 0
# \quad\Longleftrightarrow\quad \|Nc\|^2 \le \theta - g^\top c - \mathrm{const} .$$
#
# `sdp_blocks` builds it, with the box as blocks $[1 - c_t]$ and $[c_t]$. (Printed is $-1 - c_t$,
# which together with $c_t \ge 0$ no $c$ satisfies.) Exactly at $\theta = f(c)$ the smallest
# eigenvalue of the block turns non-negative:

# %%
solved = ms.solve_blend(blend)
candidates = {"the best blend": solved.choices, "half and half": np.full(4, 0.5)}
for name, c in candidates.items():
    near = float(f(c)) + np.array([-1e-6, 1e-6])
    below, above = (np.linalg.eigvalsh(ms.sdp_blocks(blend, x, c)[-1])[0] >= 0 for x in near)
    print(f"{name}: f(c) = {f(c):.3f}; feasible just below: {below}, just above: {above}")
    assert above and not below

# %% [markdown]
# An independent check: give the block, which is affine in $(\theta, c)$, to a general solver.

# %%
import cvxpy as cp

zero = ms.sdp_blocks(blend, 0.0, np.zeros(4))[-1]
per_theta = ms.sdp_blocks(blend, 1.0, np.zeros(4))[-1] - zero
per_c = [ms.sdp_blocks(blend, 0.0, e)[-1] - zero for e in unit]
theta, c = cp.Variable(), cp.Variable(4)
block = zero + theta * per_theta + sum(c[t] * per_c[t] for t in range(4))
programme = cp.Problem(cp.Minimize(theta), [(block + block.T) / 2 >> 0, c >= 0, c <= 1])
programme.solve(solver="CLARABEL")
print(f"semidefinite programme {programme.value:.3f}, solve_blend {solved.cost:.3f}")
print("its blend:", np.abs(solved.choices).round(3))
np.testing.assert_allclose(programme.value, solved.cost, rtol=1e-5)

# %% [markdown]
# ## What is polynomial
#
# The semidefinite detour is correct, but not needed. The paper takes it because, $\Psi'$ being
# positive semidefinite, the quadratic programme "cannot be solved in (weakly) polynomial time",
# citing Kozlov, Tarasov and Khachiyan. **Erratum:** that paper proves the opposite. Its title is
# *The polynomial solvability of convex quadratic programming* (USSR Computational Mathematics and
# Mathematical Physics 20, 1980): the ellipsoid method is polynomial in the length of the input.
# (`solve_blend` is no such method, as its steps depend on the accuracy asked for; but its
# certificate does not care how it got there.)

# %% [markdown]
# ## What is NP-hard: the paper's open question
#
# `remark:np_status` says that the Boolean *formulation* belongs to an NP-hard class, and leaves
# open whether model selection itself is NP-hard. It is. The proof is a gadget that hides
# PARTITION (split integers $a_0, \dots, a_{H-1}$ into two halves of equal sum) in the simplest
# robot there is:
#
# - **Robot.** $x_{t+1} = x_t + B_t u_t + s_t$ with $B_0 = 1$ and then 0, $Q = 0$, $R = 1$,
#   terminal weight 1: only $u_0$ acts, so whoever foresees the inputs plans the same.
# - **Its $\Psi$.** The cost is $u_0^2 + x_H^2$ with $x_H = x_0 + u_0 + \sum s_t$. So
#   $u_0 = -\tfrac12 (x_0 + \sum \hat s_t)$, and an error of the sum costs half its square:
#   $\;\Psi = \tfrac12\,\mathbf{1}\mathbf{1}^\top$.
# - **Models.** At step $t$, model 0 errs by $+a_t$ and model 1 by $-a_t$; model 1 costs a crumb.
#
# A schedule costs $\tfrac12(\sum_t \pm a_t)^2$ plus crumbs that add up to less than half of
# $\tfrac12$. The signed sum is an integer. So the optimum lies below $\tfrac12$ **if
# and only if** some signs give zero: a perfect partition. The gadget is no longer to write down
# than the integers, up to a constant factor, so who solved it fast would solve PARTITION fast.

# %%
split, stuck = [3, 1, 1, 2, 2, 1], [5, 5, 5, 3]
for integers in (split, stuck):
    H = len(integers)
    g, gadget = 1 / 2, ms.partition_problem(integers)
    np.testing.assert_allclose(gadget.psi, g * np.ones((H, H)))
    B = np.zeros((H, 1, 1))
    B[0] = 1
    robot = ms.ControlTask(one, B, one, 0 * one, one, H, Q_final=one)
    e = np.random.default_rng(0).normal(size=(H, 1))  # the regret of flying with errors e
    flown = ms.control_cost(robot, *ms.run_controller(robot, [0], 0 * e, e))
    np.testing.assert_allclose(flown, g * e.sum() ** 2)
    schedule = ms.solve(gadget)
    signs = np.where(schedule.choices == 0, 1, -1)
    balance = signs @ integers
    half = ms.relax_interior_point(gadget).value
    print(f"{integers}: optimum {schedule.cost:.3f}, threshold {g:.3f}, sum {abs(balance)}")
    print(f"  relaxation {half:.3f}")
    assert schedule.is_optimal and (schedule.cost < g) == (balance == 0) and half < 0.1
    np.testing.assert_allclose(ms.partition_problem(integers, "preview").psi, 0.5)

# %% [markdown]
# The first optimum lies below the threshold and its schedule *is* the partition; for the second,
# of even sum as well, none exists. Errors are known here and $W = 2$, $n = m = p = 1$: so Problem
# 2 is NP-hard already in this corner, and Problem 3, which contains it, is too. (The same gadget
# works in `preview`, with a robot that can act at $t = 0$ only; then
# $\Psi = \frac12\mathbf{1}\mathbf{1}^\top$.) The relaxation is of no use: half of each model at
# every step has no error at all, so it promises next to nothing for both.
#
# ## Weakly hard: labels and signed sums
#
# PARTITION is only *weakly* NP-hard: a table over the possible sums solves it, and there are few
# sums while the integers are small. `dynamic_program` finds that table by itself. Its label
# carries an offset, here one number, the signed sum so far; equal offsets merge. So it keeps no
# more than about one label for each distinct signed sum. We make the total odd, so that no perfect
# partition ends the work early.


# %%
def gadget_labels(H, top):
    """Return labels and distinct signed sums by number of steps decided, for H odd-sum integers."""
    a = np.random.default_rng(1).integers(1, top, H)
    a[0] += 1 - a.sum() % 2
    sums, distinct = {0}, []
    for value in a[::-1].tolist():  # the last step is decided first
        sums = {s + sign * value for s in sums for sign in (1, -1)}
        distinct.append(len(sums))
    schedule = ms.dynamic_program(ms.partition_problem(a.tolist()))
    # Costs lie up to 1e9 below the terms they are summed from: what rounding leaves open is a gap.
    labels = schedule.work["labels"][::-1]
    assert schedule.gap < 1e-2 and (labels <= 2 * np.array(distinct) + 8).all()
    return labels, np.array(distinct)


long, sizes = gadget_labels(40, 30), 4 ** np.arange(1, 8)
growth = np.array([[counts.max() for counts in gadget_labels(16, int(top))] for top in sizes])
print(f"40 integers below 30: at most {long[1].max()} distinct sums, of 2^40 partial schedules")

# %% alt="Counts on a logarithmic axis. Left, 40 integers below 30: the labels kept lie on the curve of distinct signed sums, which levels off near 600 while the partial schedules pass a million at step 20. Right, 16 integers: sums and labels grow with the integers, the sums towards the 65,536 schedules, the labels to a few thousand."
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 5), sharey=True)
decided = np.arange(1, 41)
left.semilogy(decided, 2.0**decided, "k:", label="partial schedules, $2^k$")
left.semilogy(decided, long[1], color=BLUE, linewidth=3, label="distinct signed sums")
left.semilogy(decided, long[0], "o", color=RED, markersize=5, label="labels kept")
left.set(xlabel="steps decided, k (40 integers below 30)", ylabel="count", ylim=(0.8, 1e6))
left.set_title("Few sums, few labels")
left.legend(fontsize=12, loc="upper right", bbox_to_anchor=(1, 0.8))
right.loglog(sizes, growth[:, 1], color=BLUE, linewidth=3)
right.loglog(sizes, growth[:, 0], "o", color=RED, markersize=8)
right.axhline(2.0**16, color="black", linestyle=":")
right.annotate("$2^{16}$", (4, 2.0**16), (0, 6), textcoords="offset points")
right.set(xlabel="limit of the integers (16 of them)")
right.set_title("Larger integers, more labels")
plt.show()

# %% [markdown]
# The work is polynomial in the *size* of the integers, not in the number of their digits
# (pseudo-polynomial). On the right, $2^{16}$ schedules are all there are, and dominance thins out
# sums that nearly agree. (The last step keeps the winner only.) What this does **not** say:
#
# - *Nothing about real data.* Measured errors are no small integers, and their partial sums do not
#   coincide. What keeps labels few on the landing is dominance and a narrow gap, and for that there
#   is no theorem here.
# - *Nothing about typical instances.* NP-hard is a statement on the worst case; the published
#   problem was closed by its relaxation alone.
# - *Nothing about `causal` and `measurement`.* There steps decouple, and one minimum a step is the
#   optimum. Hardness comes from acting on a forecast.
# - *Nothing stronger.* This $\Psi$ has rank one. Whether the general problem is hard even with
#   small integers (strongly NP-hard) is not settled by it.
#
# **In one paragraph.** Letting weights be fractions turns selection into a convex problem whose
# value bounds every schedule, and at any iterate the duality gap says how far that bound can still
# rise. Gradients get there slowly on a stiff $\Psi$, Newton's method in ten steps. Errors of one
# sign leave the weights nearly integral; with mixed signs rounding and swapping ends about a per
# cent above the bound and a search settles the rest. Random draws never help in expectation. The
# blend of Problem 4 is this relaxation for two models: convex for every suite, and polynomial. The
# discrete problem is NP-hard. The next notebook flies the schedules: the paper's landing, policy
# against policy.

# %% [markdown]
# ## Exercises
#
# ### Exercise 1: the duality gap from its definition
#
# Write `frank_wolfe_gap(problem, b)` for a `SelectionProblem` and weights `b` (H, W): the largest
# value of $\sum_{t,w} G_{tw}(b_{tw} - b'_{tw})$ over all $b'$ on the simplexes, where $G$ is the
# gradient of $f$ at $b$: $G_{tw} = 2\mu_{tw}^\top(\alpha\Psi d)_t + \ell_{tw}$ with
# $d_t = \sum_w b_{tw}\mu_{tw}$. Do not call `reference_bound`. Hints: `problem.quadratic` is
# $\alpha\Psi$, `problem.linear` is $\ell$, `problem.mean` is (H, W, p), and $d$ is flattened with
# entry $r$ of step $t$ at $tp + r$. A linear function over a simplex is extreme at a corner, so
# each step contributes its own term.


# %% tags=["exercise"]
def frank_wolfe_gap(problem, b):
    """Return the duality gap of the relaxation at the weights b (H, W), a float."""
    ...


# %% tags=["check", "skip-execution"]
for seed, p in ((0, 1), (1, 2)):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(5 * p, 5 * p))
    shape = (5, 3, p)
    test = ms.SelectionProblem(
        root.T @ root, rng.normal(size=shape), rng.random(shape), rng.random(3), alpha=0.7
    )
    b = rng.dirichlet(np.ones(3), size=5)
    d = np.einsum("tw,twi->ti", b, test.mean).ravel()
    bound, r = ms.reference_bound(test, d)
    try:
        found = frank_wolfe_gap(test, b)
    except (ValueError, IndexError) as error:
        raise AssertionError(f"Exercise 1: it fails for H, W, p = 5, 3, {p}: {error}") from error
    right = (r * b).sum()
    assert found is not None, "Exercise 1: return the gap, a number"
    assert np.ndim(found) == 0, "Exercise 1: return one number: add up the steps"
    pull = np.einsum("twi,ti->tw", test.mean, (test.quadratic @ d).reshape(5, p))
    G = pull + test.linear
    assert not np.isclose(found, (b * (G - G.min(1, keepdims=True))).sum()), (
        "Exercise 1: the derivative of d'Md is 2 M d; a factor 2 is missing"
    )
    G = 2 * pull / test.alpha + test.linear
    assert not np.isclose(found, (b * (G - G.min(1, keepdims=True))).sum()), (
        "Exercise 1: alpha is missing beside Psi"
    )
    assert not np.isclose(found, (2 * pull * b).sum() - 2 * pull.min(1).sum()), (
        "Exercise 1: the linear cost belongs to the gradient too"
    )
    assert not np.isclose(found, -right), (
        "Exercise 1: the gap is positive; G(b - b'), not G(b' - b)"
    )
    assert np.isclose(found, right, rtol=1e-9), "Exercise 1: sum over t of (G.b - min over w of G)"
print("Exercise 1: right")

# %% [markdown]
# ### Exercise 2: two models, one number
#
# For two models a row of weights is $(1 - c, c)$. Show on paper that the projection of
# $(v_0, v_1)$ on the simplex is $(1 - c, c)$ with $c$ a number clipped to $[0, 1]$, and write
# `project_pair(v)` for `v` (..., 2) that returns these $c$ (...) without calling
# `project_to_simplex`. (So for two models projected gradient on simplexes is projected gradient
# on a box, as in `solve_blend`.) Hint: the nearest point of the *line* $x_0 + x_1 = 1$ takes the
# same amount from both entries.


# %% tags=["exercise"]
def project_pair(v):
    """Return c (...) such that (1 - c, c) is the point of the simplex nearest to v (..., 2)."""
    ...


# %% tags=["check", "skip-execution"]
v = np.random.default_rng(5).normal(size=(40, 5, 2)) * 2
found = project_pair(v)
assert found is not None, "Exercise 2: return c, an array"
found = np.asarray(found)
assert found.shape == (40, 5), "Exercise 2: return one number for each pair, shape v.shape[:-1]"
assert found.min() >= 0 and found.max() <= 1, "Exercise 2: clip c to [0, 1]"
expected = ms.project_to_simplex(v)[..., 1]
assert not np.allclose(found, 1 - expected), "Exercise 2: c is the weight of the second entry"
assert not np.allclose(found, np.clip(v[..., 1], 0, 1)), (
    "Exercise 2: clipping v_1 alone ignores v_0: first go to the line x_0 + x_1 = 1"
)
assert np.allclose(found, expected), (
    "Exercise 2: not the nearest point; on the line it is (v_0 - h, v_1 - h), which h makes sum to 1"
)
print("Exercise 2: right")

# %% [markdown]
# ### Exercise 3: draw without luck
#
# A draw costs `expected_draw(problem, b)` on average. Write `derandomise(problem, b)`, which
# turns weights `b` (H, W) into choices (H,) that cost *at most* that (p = 1): go through the
# steps $t = 0, 1, \dots$; at each, try every model by setting row $t$ of the weights to that
# corner, keep the one of the least expected draw, and go on with the changed weights. This is the
# method of conditional expectations. You may call `expected_draw` (defined above) and
# `ms.one_hot` or `np.eye`; don't change the caller's `b`.


# %% tags=["exercise"]
def derandomise(problem, b):
    """Return choices (H,) that cost no more than a draw with chances b (H, W) on average."""
    ...


# %% tags=["check", "skip-execution"]
for seed in range(20):
    rng = np.random.default_rng(seed)
    root, mean = rng.normal(size=(6, 6)), rng.normal(size=(6, 3, 1))
    test = ms.SelectionProblem(root.T @ root, mean, rng.random((6, 3, 1)), [0, 0.5, 1])
    b = rng.dirichlet(np.ones(3), size=6)
    kept = b.copy()
    found = derandomise(test, b)
    assert found is not None, "Exercise 3: return the choices, one model a step"
    found = np.asarray(found)
    assert found.shape == (6,), "Exercise 3: return one model for each of the H steps"
    assert np.array_equal(b, kept), "Exercise 3: you changed the caller's weights; copy them first"
    everything = np.array(list(product(range(3), repeat=6)))
    chance = kept[np.arange(6), everything].prod(axis=1)
    average = chance @ test.total_cost(everything)
    for t in range(6):  # the conditional expectations, by enumeration
        agree = (everything[:, :t] == found[:t]).all(axis=1)
        rest = kept[np.arange(t + 1, 6), everything[:, t + 1 :]].prod(axis=1)
        options = [
            (rest * test.total_cost(everything))[agree & (everything[:, t] == w)].sum()
            for w in range(3)
        ]
        assert np.isclose(options[int(found[t])], min(options)), (
            f"Exercise 3: at step {t} another model has the lower expectation, given the steps "
            "before it (are earlier rows fixed at their corners, later rows still at b?)"
        )
    assert test.total_cost(found) <= average + 1e-9, "Exercise 3: costs more than an average draw"
print("Exercise 3: right")

# %% [markdown]
# ### Exercise 4: split a heap by choosing perception models
#
# Write `halves(integers)`: two lists of equal sum that together hold exactly the given positive
# integers, or `None` if there are none. Let `ms.partition_problem` and `ms.solve` do the work:
# read the decision off the cost (threshold $\tfrac12$) and the two lists off the schedule. Return
# a pair of lists.


# %% tags=["exercise"]
def halves(integers):
    """Return two lists of equal sum that share out the integers, or None if there are none."""
    return ...


# %% tags=["check", "skip-execution"]
heaps = [[2, 3], [1, 1], [2, 2, 3], [5, 5, 5, 3], [3, 1, 1, 2, 2, 1], [4, 5, 6, 7, 8], [9, 2, 2, 1]]
heaps += [np.random.default_rng(seed).integers(1, 50, 12).tolist() for seed in range(6)]
for heap in heaps:
    found, reachable = halves(heap), {0}
    assert found is not ..., "Exercise 4: return a pair of lists, or None"
    for value in heap:
        reachable |= {s + value for s in reachable}
    possible = 2 * max(s for s in reachable if 2 * s <= sum(heap)) == sum(heap)
    if not possible:
        assert found is None, f"Exercise 4: {heap} has no perfect partition; compare with 1/2"
        continue
    assert found is not None, f"Exercise 4: {heap} has a perfect partition"
    assert len(found) == 2, "Exercise 4: return two lists"
    first, second = (list(part) for part in found)
    assert sorted(first + second) == sorted(heap), "Exercise 4: use every integer exactly once"
    assert sum(first) == sum(second), f"Exercise 4: {first} and {second} do not have equal sums"
print("Exercise 4: right")
