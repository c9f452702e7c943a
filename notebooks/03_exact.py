# %% [markdown]
# # 3. How do you prove that no other schedule is better?
#
# **After this notebook you can**
#
# - split the cost of any schedule into a bound and two excesses, and rule models out by it;
# - say what a label must remember, and when it may die;
# - copy an exact search of 25 lines, and say why what it drops is no loss;
# - read a tree of branch and bound, and say what a search's word is worth;
# - extend the proof to switching costs and a budget.
#
# **Covers** `sol:model_selection`, `sol:model_selection_expectation`, `remark:np_status`.
#
# A solver returns a schedule. Here is the other half of its answer: why none of $W^H$ schedules
# ($W$ models, $H$ steps) is cheaper.

# %%
from dataclasses import replace
from unittest.mock import patch

import matplotlib.pyplot as plt
import numpy as np

import landing
import modelselect as ms

# %% [markdown]
# ## Two steps, nine schedules
#
# A cart follows $x_{t+1} = x_t + u_t + s_t$, with $Q = R = 1$ and $H = 2$, and acts on a forecast
# of its pushes $s_t$ (`preview`). Three models: b0 is free and errs by $1$; b1 costs 0.2 and errs
# by $-0.5$; b2 costs 0.6 and errs by $0.1$. A schedule with errors $e = (e_0, e_1)$ costs the
# regret $e^\top \Psi e$ (notebook 1) plus its prices. All costs, step 0 downwards, step 1 to the
# right:

# %%
one, mean = np.eye(1), np.tile([[1.0], [-0.5], [0.1]], (2, 1, 1))
small = ms.ControlTask(one, one, one, one, one, horizon=2)
toy = ms.SelectionProblem(ms.psi(small, "preview"), mean, 0 * mean, model_cost=[0, 0.2, 0.6])
nine = np.indices((3, 3)).reshape(2, -1).T
print(f"Psi = {toy.psi.round(3).tolist()}\n{toy.total_cost(nine).reshape(3, 3).round(3)}")

# %% [markdown]
# The best is b1, then b0, at 0.725: the errors partly cancel. Judged by itself, each step takes b1
# (0.925).
#
# Now pick **any** point $d$, say $(\frac{2}{45}, \frac{4}{45})$, and replace $e^\top \Psi e$ by its
# tangent there, $2e^\top \Psi d - d^\top \Psi d$. Along it an error $\mu$ at either step costs
# $2\mu\,(\Psi d)_t = \frac{2}{15}\mu$, and steps no longer meet. With its price, b0 costs
# $\frac{2}{15} = 0.133$, b1 $-\frac1{15} + 0.2 = 0.133$, b2 $\frac{2}{150} + 0.6 = 0.613$. The
# cheapest of each step, added up, less $d^\top\Psi d = 0.009$, make $LB = 0.258$.
#
# **Every** schedule costs exactly this bound, plus the **reduced costs** of its models (what each
# costs above the cheapest: 0.48 for b2), plus a square that the tangent left out,
# $(e - d)^\top \Psi (e - d)$:

# %% alt="Nine bars from the cheapest schedule, 0.725, to the dearest, 2.1: every bar is the same bound 0.258, plus 0.48 for each use of b2, plus a square. A dotted line at 0.725: the five bars of schedules with b2 pass it by bound and reduced costs alone." tags=["hide-input"]
plt.rcParams.update(landing.STYLE)
ORANGE, BLUE = (landing.LOOK[name]["color"] for name in ("Optimal", "Best Single"))
GREY = "#999999"
low, above = ms.reference_bound(toy, [2 / 45, 4 / 45])
order = np.argsort(toy.total_cost(nine))
extra, cost = above[[0, 1], nine[order]].sum(axis=1), toy.total_cost(nine[order])
names = [f"b{a} b{b}" for a, b in nine[order]]
figure, axes = plt.subplots(figsize=(10, 4.6))
axes.barh(names, low, color=BLUE, label="$LB(d)$")
axes.barh(names, extra, left=low, color=ORANGE, hatch="//", label="reduced costs")
axes.barh(names, cost - low - extra, left=low + extra, color=GREY, label="square")
axes.axvline(cost[0], color="black", ls=":")
axes.invert_yaxis()
axes.set(xlabel="cost", title="Every schedule: one bound + reduced costs + square")
axes.legend(loc="upper right")
plt.show()

# %% [markdown]
# The **room** between the best schedule known and the bound is $\Delta = 0.725 - 0.258 = 0.467$. A
# model of reduced cost $0.48 > \Delta$ is in no better schedule: b2 is out, four schedules are
# left.
#
# ## In general
#
# A schedule $c$ costs $\mu_c^\top M \mu_c + \sum_t \ell_{t,c_t}$ (notebook 2): $\mu_c$ are the
# chosen mean errors, $M = \alpha\Psi \succeq 0$ with the weight $\alpha$ of regret, $\ell$ the
# linear costs (variance and price). For every $d$ and $c$,
# $\mu_c^\top M \mu_c = 2\mu_c^\top M d - d^\top M d + (\mu_c - d)^\top M (\mu_c - d)$, hence
#
# $$\mathrm{total}(c) = LB(d) + \sum_t r_{t,c_t} + (\mu_c - d)^\top M (\mu_c - d),$$
#
# $$G_{tw} = 2\,\mu_{tw}^\top (Md)_t + \ell_{tw}, \quad r_{tw} = G_{tw} - \min_v G_{tv} \ge 0,
# \quad LB(d) = \sum_t \min_w G_{tw} - d^\top M d .$$
#
# ($G_{tw}$ is no part of notebook 1's $S_t = G_t G_t^\top$.) No term after $LB(d)$ is negative.
# The best $d$ is the mean error of the **relaxation**, the cheapest blend: weights of the models
# at each step in place of a choice (notebook 4). On two steps it is the $d$ above. A bad $d$ makes
# the bound loose, never wrong.
#
# We check the identity on all 65,536 schedules of a longer cart: dear thrust, eight steps, four
# models with signs drawn for every step.


# %% tags=["hide-input"]
def cart(H=8, W=4, seed=46):
    """Draw a cart and a selection problem: model w costs w and errs by about 2 * 0.6^w."""
    rng = np.random.default_rng(seed)
    size = 2 * 0.6 ** np.arange(W) * rng.uniform(0.7, 1.3, (H, W))
    mean = (rng.choice([-1, 1], (H, W)) * size)[:, :, None]
    task = ms.ControlTask(one, one, one, one, 30 * one, horizon=H)
    psi = ms.psi(task, "preview")
    return task, ms.SelectionProblem(psi, mean, 0.1 * mean**2, np.arange(W))


task, problem = cart()
mu, M, linear, steps = problem.mean[:, :, 0], problem.quadratic, problem.linear, np.arange(8)
everything = np.indices((4,) * 8).reshape(8, -1).T  # (65536, 8)
costs = problem.total_cost(everything)
best = everything[costs.argmin()]
quick = ms.round_and_swap(problem)  # a schedule, with the relaxation's d


# %%
def certificate(M, mean, linear, d):
    """Return LB(d) and the reduced costs (H, W), for means (H, W)."""
    G = 2 * mean * (M @ d)[:, None] + linear
    return G.min(axis=1).sum() - d @ M @ d, G - G.min(axis=1, keepdims=True)


for d in (np.random.default_rng(0).normal(size=8), quick.reference):  # any d; the relaxation's
    bound, reduced = certificate(M, mu, linear, d)
    away = problem.chosen_mean(everything) - d
    square = ((away @ M) * away).sum(axis=1)
    np.testing.assert_allclose(bound + reduced[steps, everything].sum(axis=1) + square, costs)
    print(f"LB(d) = {bound:6.2f} <= optimum {costs.min():.2f} <= {quick.cost:.2f}, quickly found")
room = (quick.cost - bound) + 1e-9 * quick.cost  # Delta, and a little for rounding
print((reduced <= room).sum(axis=1).prod(), "schedules left")

# %% [markdown]
# ## Labels: what a partial schedule must remember
#
# We search from the last step to the first. Under `preview` the square is notebook 1's regret, a
# sum over steps, with deviations $\varepsilon_t = \mu_{t,c_t} - d_t$ in place of errors, the same
# $P$, $K$, $S$ of Riccati's recursion and the same costate $q$ ($q_H = 0$; let $\alpha = 1$):
#
# $$h_t = P_{t+1} C \varepsilon_t + q_{t+1}, \qquad q_t = (A - BK_t)^\top h_t, \qquad
# \text{step } t \text{ pays } (B^\top h_t)^\top S_t^{-1} (B^\top h_t).$$
#
# Back to two steps: $P_2 = 1$, $S_1 = 2$, $A - BK_1 = \frac12$, $P_1 = \frac32$, $S_0 = \frac52$.
# Let $d = 0$ for a moment, so that costs are plain.
#
# - Last step: b1 costs $0.2 + \frac12 \cdot 0.25 = 0.325$, b0 costs $\frac12 = 0.5$.
# - Yet b1 is not better: b0 leaves the costate $q_1 = \frac12$, and b1 at step 0 cancels
#   most of it, $h_0 = \frac32 \cdot (-0.5) + \frac12 = -\frac14$. It pays $h_0^2 / S_0 = 0.025$ and
#   its price 0.2: in all 0.725. After b1 the least is 0.925.
#
# So a **label** is: its extra cost so far (reduced costs and squares); its costate $q$, as many
# numbers as the state has, all that earlier steps feel of it; the models chosen.
#
# ## When a label may die
#
# **Out of room**: its extra cost $x$ exceeds $\Delta$.
#
# **Dominated.** Give labels $i$ and $j$ of one step the same models at all earlier steps. These add
# the same reduced costs to both, and squares $|y + v|^2$. The column $y + v$ stacks their
# $S_t^{-1/2} B^\top h_t$: $y$ is linear in the label's $q$; $v$ comes from their own deviations,
# the same for both. Within the room $x_j + |y_j + v|^2 \le \Delta$, so $v$ lies in a ball about
# $-y_j$ of radius $\sqrt{\Delta - x_j}$. **If the ball of $j$ lies inside that of $i$, $j$ may
# die**:
#
# $$\rho + \sqrt{\Delta - x_j} \le \sqrt{\Delta - x_i}, \qquad \rho = |y_i - y_j| .$$
#
# <details><summary>Why: within the room i is then never dearer</summary>
#
# Squared, this says $x_i + \rho^2 + 2\rho\sqrt{\Delta - x_j} \le x_j$. And $|y_i + v|$ is at most
# $|y_j + v| + \rho$. So every $v$ in the ball of $j$ gives $x_i + |y_i + v|^2 \le x_j + |y_j +
# v|^2$.
#
# </details>
#
# The distance needs no $y$: $\rho^2 = (q_i - q_j)^\top F_t (q_i - q_j)$. $F_t$ sums up what all
# earlier steps feel: $F_0 = 0$, $F_{t+1} = B S_t^{-1} B^\top + (A - BK_t) F_t (A - BK_t)^\top$. The
# whole search:


# %%
def search(task, mean, reduced, d, room):
    """Return the cheapest label (extra, costate, schedule) within the room, and all labels."""
    law, B, F, log = ms.riccati(task), task.B, [0 * task.A], []
    for S, closed in zip(law.S, law.closed_loop, strict=True):
        F.append(B @ np.linalg.solve(S, B.T) + closed @ F[-1] @ closed.T)
    alive = [(0.0, np.zeros(task.n), ())]
    for t in reversed(range(task.horizon)):
        grown = []
        for extra, q, later in alive:  # each label grows by each model
            for w, mu in enumerate(mean[t]):
                h = law.P[t + 1] @ task.C[:, 0] * (mu - d[t]) + q
                x = extra + reduced[t, w] + B.T @ h @ np.linalg.solve(law.S[t], B.T @ h)
                grown.append((x, law.closed_loop[t].T @ h, (w, *later)))
        alive = []
        for extra, q, models in sorted(grown, key=lambda label: label[0]):  # cheapest first
            fate = "kept" if extra <= room else "out of room"
            for x, other, _ in alive:
                rho = np.sqrt(max((q - other) @ F[t] @ (q - other), 0))
                if extra <= room and rho + np.sqrt(room - extra) <= np.sqrt(room - x):
                    fate = "dominated"
            if fate == "kept":
                alive.append((extra, q, models))
            log.append((t, extra, models, fate))
    return alive[0], log


(extra, _, found), log = search(task, mu, reduced, d, room)
print(f"bound + least extra = {bound + extra:.3f} = optimum {costs.min():.3f}: {found}")
np.testing.assert_allclose(bound + extra, costs.min())
assert tuple(best) == found

# %% alt="Labels by step, from step 8 on the left, where nothing is chosen, to step 0, at the height of their extra cost over the room. Circles, one to seven a step, are kept and joined to the label they grew from; crosses are dominated; triangles at the top are out of room. The thick path of the optimum ends at 0.9." tags=["hide-input"]
figure, axes = plt.subplots(figsize=(11, 5.6))
height = {models: x / room for _, x, models, fate in log if fate == "kept"} | {(): 0}
for models, y in height.items():
    if models:
        width = 4 if models == found[-len(models) :] else 1
        path = [9 - len(models), 8 - len(models)], [height[models[1:]], y]
        axes.plot(*path, color=ORANGE, lw=width, zorder=1)
marks = {"kept": ("o", ORANGE), "dominated": ("x", "black"), "out of room": ("^", GREY)}
for fate, (marker, colour) in marks.items():
    here = [(t, min(x / room, 1.12)) for t, x, _, f in log if f == fate]
    label = f"{fate}: {len(here)}"
    axes.plot(*np.transpose(here), marker, color=colour, ms=9, mew=2, label=label)
axes.axhline(1, color="black", lw=1)
axes.set(xlim=(8.3, -0.3), ylim=(-0.05, 1.2), xlabel="step (8: nothing is chosen yet)")
axes.set_ylabel("extra cost / $\\Delta$ (over 1.12: drawn there)")
axes.set_title("Few labels stay alive; thick line: the optimum")
figure.legend(loc="outside lower center", ncols=3)
plt.show()

# %% [markdown]
# The module's `dynamic_program` is this search for every pattern, for errors of $p$ numbers, and
# for every cost. Notebook 0 has it in NumPy alone.
#
# ## Branch and bound: the same bound on a tree
#
# Relax: find the best blend, and with its $d$ the bound. If it reaches the best schedule known,
# drop the node. If not, split a step: a child for each model that reduced costs leave there (below,
# at step 5, b0 and b2); relax each.

# %% alt="A tree of 16 nodes as an indented list. The root's bound is 10.0281. Its four children settle step 2, theirs other steps; each node names step and model. The six that were split show bounds below the optimum 11.5894, the last by 0.0001; below the dotted leaves nothing is cheaper than it." tags=["hide-input"]
tree = ms.branch_and_bound(problem).work["tree"]
split, trail = {node.parent for node in tree}, {-1: ()}
for k, node in enumerate(tree):
    trail[k] = (*trail[node.parent], k)  # from the root
row = {k: y for y, k in enumerate(sorted(range(len(tree)), key=trail.get))}
figure, axes = plt.subplots(figsize=(9, 7.5))
for k, node in enumerate(tree):
    x, y = len(trail[k]), row[k]
    if k:
        axes.plot([x - 0.9, x - 0.9, x], [row[node.parent], y, y], color=GREY, zorder=0)
    text = f"step {node.step}: b{node.model}" if k else "root"
    text += f", bound {node.bound:.4f}" if k in split else ""
    look = {"facecolor": "white", "edgecolor": BLUE, "ls": "-" if k in split else ":"}
    axes.text(x, y, text, va="center", fontsize=14, bbox=look)
axes.set(xlim=(0.9, 7), ylim=(len(tree) - 0.5, -0.5))
axes.axis("off")
axes.set_title(f"Solid: split; dotted: nothing below beats the optimum, {costs.min():.4f}")
plt.show()
leaves = [min(node.bound, node.best) for k, node in enumerate(tree) if k not in split]
assert min(leaves) >= costs.min() * (1 - 1e-9) and tree[0].bound < costs.min()

# %% [markdown]
# ## Whose word is a bound?
#
# `check_certificate` derives cost and $LB(d)$ anew. It accepts any `lower_bound` between the two,
# as it cannot repeat a search. `Schedule.proof` says what carries the bound: `"root"`, three lines
# that you can check, or `"search"`, a search's word. Here is a lie that passes; 10.03 is all that
# is vouched for:

# %%
lie = replace(quick, lower_bound=quick.cost)  # not the optimum
print(lie.is_optimal, lie.proof, round(ms.check_certificate(problem, lie), 2))
assert lie.is_optimal and lie.cost > 1.01 * costs.min() and lie.proof == "search"

# %% [markdown]
# ## Switching costs and a budget: the same certificate
#
# Let a change of model cost $\sigma$, and let a schedule spend at most $K$ (not a gain here) on
# models and changes. Now a schedule is a **path**. Its nodes, a model at each step, cost $G$; its
# arcs, from a model to the next, cost $\sigma$ where the model changes. Take any $d$, and any
# $\lambda \ge 0$ as a price on the budget: each node and arc costs $\lambda$ times what it spends,
# too. The cheapest path takes the place of the sum of minima,
# $LB(d, \lambda) = \text{cheapest path} - d^\top M d - \lambda K$:
#
# $$\mathrm{total} = LB(d, \lambda) + (\text{path} - \text{cheapest path})
# + \lambda\,(K - \mathrm{spent}) + \text{square}.$$
#
# On two steps, with $\sigma = 0.3$, the cheapest path stays with b0 or b1, and the bound is 0.258
# as before. b1, then b0 now costs 1.025, so b1 twice is the optimum. On the cart, with a budget of
# 3:

# %%
limited = replace(problem, switch_cost=0.5 * (1 - np.eye(4)), budget=3.0)
answer, point = ms.solve(limited), ms.relax_by_columns(limited)
lam, spent = point.multiplier, limited.perception_term(answer.choices)
bound, _ = ms.reference_bound(limited, point.reference, lam)
print(f"LB(d, {lam:.2f}) = {bound:.2f}; optimum {answer.cost:.2f}: {answer.choices} spends {spent}")
assert bound <= answer.cost
np.testing.assert_allclose(answer.cost, ms.enumerate_schedules(limited).cost)

# %% [markdown]
# ## The paper's experiment
#
# $H = 150$, $W = 8$, proved by the identity alone:

# %%
full = landing.run_experiment(landing.Settings(trials=1)).problem
claim = ms.round_and_swap(full, ms.relax_interior_point(full, gap=1e-9))
bound, reduced = certificate(full.quadratic, full.mean[:, :, 0], full.linear, claim.reference)
possible = reduced <= claim.cost - bound + 1e-9 * claim.cost
print(f"cost {claim.cost:.3e}, schedules left: {possible.sum(axis=1).prod()}")
assert possible.sum() == 150 and possible[np.arange(150), claim.choices].all()

# %% [markdown]
# Of $8^{150}$ schedules one is left: ours. On the cart signs are mixed, and a blend of models
# cancels better than any schedule: the bound lies below the optimum, and a search closes the gap.
# Not always in time: the problem is NP-hard (`remark:np_status`, notebook 4).
#
# **In one paragraph.** Any $d$ splits every cost into a bound, reduced costs and a square. Reduced
# costs rule models out. The rest is searched from the last step: a label remembers its extra cost
# and its costate, and dies out of room or near a cheaper label. A tree uses the same bound,
# switching costs and budgets the same identity. Next: where $d$ comes from.
#
# ## Recall
#
# <details><summary>Why is LB(d) a bound for a badly chosen d, too?</summary>
#
# The identity holds for every $d$, and what follows $LB(d)$ is never negative. A bad $d$ makes the
# bound low.
#
# </details>
# <details><summary>Two labels of one step: x = 1 and x = 2. May the dearer one die?</summary>
#
# Only if their costates are near: $\rho \le \sqrt{\Delta - 1} - \sqrt{\Delta - 2}$. Otherwise
# earlier steps may cancel the dearer one's costate and not the cheaper one's.
#
# </details>
# <details><summary>A schedule says gap 0 and proof "search". What can you check in three lines?</summary>
#
# Its cost and its root bound. That nothing lies between is the search's word.
#
# </details>
#
# ## Exercises
#
# ### Exercise 1: branch and bound by hand
#
# Write `branch(problem)`, about 20 lines, that returns choices, cost and the number of
# relaxations. Keep a list of boolean tables `allowed` (H, W), at first all true, and a best
# schedule. Take a table; `ms.relax_interior_point(problem, allowed=allowed, ceiling=cost)` gives a
# `.bound` and `.weights` (H, W); it stops early once the bound exceeds the ceiling. Round the
# weights to a schedule; better than the best? Drop the table if its bound reaches
# `cost * (1 - 1e-9)` or if one model a step is left. Otherwise split the step of the most divided
# weights: a child for each allowed model.


# %% tags=["exercise"]
def branch(problem):
    """Return choices (H,), cost and the number of relaxations."""
    ...


# %% tags=["check", "skip-execution"]
for seed in range(5):
    _, test = cart(H=6, seed=seed)
    least = ms.enumerate_schedules(test).cost
    with patch.object(ms, "relax_interior_point", wraps=ms.relax_interior_point) as relax:
        answer = branch(test)
    assert answer is not None, "Exercise 1: return choices, cost, number of relaxations"
    choices, cost, count = answer
    priced = test.total_cost(np.asarray(choices))
    assert np.isclose(priced, cost), "Exercise 1: cost and choices differ"
    assert np.isclose(cost, least), f"Exercise 1: found {cost:.3f}, and {least:.3f} is possible"
    ran = relax.call_count
    assert count == ran, f"Exercise 1: you relaxed {ran} times and say {count}"
    assert count < 400, "Exercise 1: hundreds of relaxations for six steps; do you drop tables?"
print("Exercise 1: right")

# %% [markdown]
# ### Exercise 2: the cheapest path
#
# Write `path_bound(problem, d)`: $LB(d)$ of a problem with switching costs (`problem.beta *
# problem.switch_cost` are the arcs, from row to column; errors are numbers, no budget) in
# $O(HW^2)$, without a bound of ours: from step to step, the cheapest way to each model.


# %% tags=["exercise"]
def path_bound(problem, d):
    """Return the cheapest path of nodes G and arcs, less d'Md."""
    ...


# %% tags=["check", "skip-execution"]
for seed, H in ((0, 8), (1, 8), (2, 60)):
    _, test = cart(H=H, seed=seed)
    rng = np.random.default_rng(seed)
    test = replace(test, beta=2.0, switch_cost=rng.random((4, 4)) * (1 - np.eye(4)))
    d = rng.normal(size=H)
    free, expected = (ms.reference_bound(t, d)[0] for t in (replace(test, switch_cost=None), test))
    with patch.object(ms, "reference_bound", None):
        found = path_bound(test, d)
    assert found is not None, "Exercise 2: return the bound, a number"
    assert not np.isclose(found, free), "Exercise 2: the arcs are missing"
    assert np.isclose(found, expected), f"Exercise 2: expected {expected:.6f}, found {found:.6f}"
print("Exercise 2: right")

# %% [markdown]
# ### Exercise 3 (open): one sign, and yet a gap
#
# The published errors have one sign, no entry of its $\Psi$ is negative, and the root proves it.
# Is that why? Predict, then build `one_sign()`: a problem with positive means and $\Psi \ge 0$
# whose relaxation stays more than 20% below the optimum. Say in a sentence why.


# %% tags=["exercise"]
def one_sign():
    """Return a SelectionProblem, and a sentence that explains its gap."""
    ...


# %% tags=["check", "skip-execution"]
answer = one_sign()
assert answer is not None and len(answer) == 2, "Exercise 3: return a problem and a sentence"
test, why = answer
assert isinstance(test, ms.SelectionProblem), "Exercise 3: return a SelectionProblem first"
assert np.asarray(test.psi).min() >= 0 and test.mean.min() > 0, "Exercise 3: a sign is negative"
best_cost = ms.enumerate_schedules(test).cost
root_gap = 1 - ms.relax_interior_point(test).value / best_cost
assert root_gap > 0.2, f"Exercise 3: the relaxation is only {root_gap:.0%} below the optimum"
assert len(why.split()) >= 8, "Exercise 3: explain the gap in a sentence"
print("Exercise 3: right")
