# %% [markdown]
# # 3. How do you prove that no other schedule is better?
#
# **After this notebook you can**
#
# - split any cost into a bound and two excesses, and rule models out by it;
# - say what a label must remember, and when it may die;
# - extend the proof to switching costs and a budget.
#
# **Covers** `sol:model_selection`, `sol:model_selection_expectation`, `remark:np_status`.
#
# ## Two steps, nine schedules
#
# A cart follows $x_{t+1} = x_t + u_t + s_t$ for two steps, with $Q = R = 1$, and acts on a forecast
# (`preview`). Model b0 is free and errs by 1; b1 costs 0.2 and errs by -0.5; b2 costs 0.6 and errs
# by 0.1. A schedule with errors $e$ costs $e^\top \Psi e$ (notebook 1) plus its prices. All costs,
# step 0 downwards, step 1 to the right:

# %% tags=["hide-input"]
from dataclasses import replace
from unittest.mock import patch

import matplotlib.pyplot as plt
import numpy as np

import landing
import modelselect as ms

one, mean = np.eye(1), np.tile([[1.0], [-0.5], [0.1]], (2, 1, 1))
small = ms.ControlTask(one, one, one, one, one, horizon=2)
toy = ms.SelectionProblem(ms.psi(small, "preview"), mean, 0 * mean, model_cost=[0, 0.2, 0.6])
nine = np.indices((3, 3)).reshape(2, -1).T
print(f"Psi = {toy.psi.round(3).tolist()}\n{toy.total_cost(nine).reshape(3, 3).round(3)}")

# %% [markdown]
# The best is b1, then b0, at 0.725: errors partly cancel.
#
# Pick **any** point $d$, say $(\frac{2}{45}, \frac{4}{45})$. Replace $e^\top \Psi e$ by its
# tangent there, $2e^\top \Psi d - d^\top \Psi d$. A sum over steps: as $2\Psi d =
# (\frac{2}{15},\frac{2}{15})$, an error $\mu$ costs $\frac{2}{15}\mu$ at either. With prices, b0
# and b1 cost 0.133, b2 costs 0.613.
#
# - **The bound**: the cheapest of each step, 0.133 twice, less $d^\top \Psi d = 0.009$: 0.258.
# - **Reduced costs**: what a model costs above the cheapest of its step, 0.48 for b2.
# - **The square** that the tangent omits, $(e - d)^\top \Psi (e - d) \ge 0$.
#
# Every schedule costs their sum:

# %% alt="Nine bars from the cheapest schedule, 0.725, to the dearest, 2.1: each is the bound 0.258, plus 0.48 for each use of b2, plus a square. The five with b2 pass 0.725 without their square." tags=["hide-input"]
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
# The best schedule known leaves a **room** of $\Delta = 0.725 - 0.258 = 0.467$ above the bound. One
# b2 adds 0.48: no better schedule has any; four are left.
#
# ## In general
#
# A schedule $c$ with mean errors $\mu_c$ costs $\mu_c^\top \Psi \mu_c + \sum_t \ell_{t,c_t}$, where
# $\ell$ adds variance and price (notebook 2). For every $d$,
#
# $$\mathrm{total}(c) = LB(d) + \sum_t r_{t,c_t} + (\mu_c - d)^\top \Psi (\mu_c - d).$$
#
# `G` is what a model costs along the tangent:


# %%
def certificate(Psi, mean, linear, d):
    """Return LB(d) and the reduced costs, for means (H, W): H steps, W models."""
    G = 2 * mean * (Psi @ d)[:, None] + linear
    return G.min(axis=1).sum() - d @ Psi @ d, G - G.min(axis=1, keepdims=True)


# %% [markdown]
# A bad $d$ makes the bound low, never wrong. The best $d$, like that above, is the mean error of
# the cheapest **blend**: weights of models in place of a choice (notebook 4).
#
# A longer cart has $R = 30$, eight steps and four models, priced 0 to 3. The identity holds for all
# its schedules, at a random $d$ and the blend's:


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
Psi, mean, linear, steps = problem.psi, problem.mean[:, :, 0], problem.linear, np.arange(8)
everything = np.indices((4,) * 8).reshape(8, -1).T  # (65536, 8)
costs = problem.total_cost(everything)
quick = ms.round_and_swap(problem)  # a schedule, with the blend's d
for d in (np.random.default_rng(0).normal(size=8), quick.reference):  # any d; the blend's
    bound, reduced = certificate(Psi, mean, linear, d)
    away = mean[steps, everything] - d
    square = ((away @ Psi) * away).sum(axis=1)
    np.testing.assert_allclose(bound + reduced[steps, everything].sum(axis=1) + square, costs)
    print(f"LB(d) = {bound:6.2f} <= optimum {costs.min():.2f} <= {quick.cost:.2f}, quickly found")
room = quick.cost - bound + 1e-9 * quick.cost  # Delta, and a little for rounding
left = (reduced <= room).sum(axis=1).prod()
print(f"room {room:.2f}: the models left make {left} schedules, of {len(costs)}")

# %% [markdown]
# Of the $8^{150}$ schedules of the paper's landing reduced costs leave:

# %% tags=["hide-input"]
full = landing.run_experiment(landing.Settings(trials=1)).problem
claim = ms.round_and_swap(full, ms.relax_interior_point(full, gap=1e-9))
low, above = certificate(full.quadratic, full.mean[:, :, 0], full.linear, claim.reference)
possible = above <= claim.cost - low + 1e-9 * claim.cost
print(possible.sum(axis=1).prod())
assert possible.sum() == 150 and possible[np.arange(150), claim.choices].all()

# %% [markdown]
# The landing needs no search. The cart does: there a blend is cheaper than any schedule.
#
# ## Labels: what a partial schedule must remember
#
# We go from the last step to the first. Under `preview` the square is a regret, as in notebook 1,
# of deviations $\varepsilon_t=\mu_{t,c_t}-d_t$. Step $t$ of a cart feels $h_t =
# P_{t+1}\varepsilon_t + q_{t+1}$: its own deviation and, in the **costate** $q$, all later ones. It
# pays $h_t^2/S_t$ and leaves $q_t = (1-K_t)\,h_t$ to the step before ($P, K$: Riccati matrices and
# gains; $S_t=R+P_{t+1}$).
#
# Two steps: $q_2=0,\ P_2=1,\ S_1=2,\ K_1=\frac12$, then $P_1=\frac32,\ S_0=\frac52$. Expanded,
# $(\frac32\varepsilon_0+\frac12\varepsilon_1)^2/\frac52+\varepsilon_1^2/2$ is the square. If b1
# runs at step 0, $P_1\varepsilon_0=-0.817$ (no reduced costs):
#
# | step 1 | pays | leaves $q_1$ | $h_0$ | step 0 pays | in all |
# |---|---|---|---|---|---|
# | b1 | 0.173 | -0.294 | $-0.817-0.294$ | 0.494 | 0.667 |
# | b0 | 0.415 | 0.456 | $-0.817+0.456$ | 0.052 | 0.467 |
#
# b1 was cheaper so far, but what b0 leaves cancels over half of -0.817.
#
# A **label** is a schedule from some step to the last. It keeps its models, its extra cost $x$
# (reduced costs and squares) and its costate, all that earlier steps feel of it.
#
# ## When a label may die
#
# **Out of room**: its extra cost exceeds $\Delta$.
#
# **Dominated.** On two steps, step 0 adds a reduced cost and $(v + q)^2/S_0$ to a label; the model
# there sets $v=P_1\varepsilon_0$. So each label is a parabola over $v$. A bar shows where it is
# within the room. Dashed: a fourth model.

# %% alt="Three equal parabolas over v and a line at the room, 0.467. Bars show where each is below it. That of b0 reaches left beyond that of b1: it lives. That of the dashed one lies inside that of b1: it dies." tags=["hide-input"]
low, _ = ms.reference_bound(toy, [2 / 45, 4 / 45])
delta, v = 0.725 - low, np.linspace(-1.6, 1.6, 400)
figure, axes = plt.subplots(figsize=(10, 5))
labels = (
    ("b1", 0.2, -0.5, BLUE, "-"),
    ("b0", 0.0, 1.0, ORANGE, "-"),
    ("price 0.3, error -0.4", 0.3, -0.4, GREY, "--"),
)
spans = {}
for k, (name, price, error, colour, style) in enumerate(labels):
    off = error - 4 / 45
    x, q = 2 / 15 * error + price - 2 / 15 + off**2 / 2, off / 2
    spans[name] = -q + np.sqrt(2.5 * (delta - x)) * np.array([-1, 1])
    axes.plot(v, x + (v + q) ** 2 / 2.5, style, color=colour, lw=3, label=name)
    axes.plot(spans[name], [delta + 0.012 * (k + 1)] * 2, color=colour, lw=5)
axes.axhline(delta, color="black", lw=1)
axes.text(1.48, delta - 0.02, "room $\\Delta$", ha="right")
axes.set(ylim=(0.05, 0.6), xlim=(-1.3, 1.5), xlabel="$v$", ylabel="extra cost")
axes.set_title("A bar inside another: that label may die")
axes.legend(title="step 1 runs", loc="lower left")
plt.show()
dashed = spans["price 0.3, error -0.4"]
assert spans["b1"][0] <= dashed[0] and dashed[1] <= spans["b1"][1]
assert spans["b0"][0] < spans["b1"][0]

# %% [markdown]
# **If the bar of $j$ lies inside that of $i$, $j$ may die.** At the ends of its bar $j$ reaches the
# room. There $i$ is not above, nor in between, as two parabolas of one shape differ by a straight
# line. In units of $\sqrt{S_0}$ a bar reaches $\sqrt{\Delta - x}$ either side of its lowest
# point. If these points are $\rho$ apart, the rule is
#
# $$\rho + \sqrt{\Delta - x_j} \le \sqrt{\Delta - x_i} .$$
#
# With more steps `felt` replaces $1/S_0$: others feel what the step before leaves, too. All else
# they pay is equal for both labels and shortens both bars, the shorter one more: it stays inside.
# With more states bars become balls (notebook 0). The whole search, for a cart:


# %%
def dominated(j, i, felt, room):
    """Say whether label i is at most label j wherever j is within the room."""
    rho = np.sqrt(felt) * abs(j[1] - i[1])
    return rho + np.sqrt(room - j[0]) <= np.sqrt(room - i[0])


def search(task, mean, reduced, d, room):
    """Return the cheapest label (extra cost, costate, models), and how many each step kept."""
    law = ms.riccati(task)
    P, S, closed = law.P.ravel(), law.S.ravel(), law.closed_loop.ravel()  # closed: 1 - K
    felt, labels, kept = [0.0], [(0.0, 0.0, ())], []
    for t in range(task.horizon):
        felt.append(1 / S[t] + closed[t] ** 2 * felt[t])
    for t in reversed(range(task.horizon)):
        grown = []
        for x, q, later in labels:
            for model, error in enumerate(mean[t]):
                h = P[t + 1] * (error - d[t]) + q
                grown.append((x + reduced[t, model] + h**2 / S[t], closed[t] * h, (model, *later)))
        labels = []
        for new in sorted(grown):  # cheapest first
            if new[0] <= room and not any(dominated(new, old, felt[t], room) for old in labels):
                labels.append(new)
        kept.append(len(labels))
    return labels[0], kept


(extra, _, models), kept = search(task, mean, reduced, d, room)
print(f"bound + least extra = {bound + extra:.3f}: {models}; labels kept, last step first: {kept}")
np.testing.assert_allclose(bound + extra, costs.min())

# %% [markdown]
# `dynamic_program` is this search for every pattern and cost. It may be slow: the problem is
# NP-hard (`remark:np_status`, notebook 4).
#
# ## Whose word is a bound?
#
# `check_certificate` derives cost and $LB(d)$ anew. Unable to repeat a search, it accepts any
# `lower_bound` between them. `Schedule.proof` says whose word it is: `"root"`, which you can check,
# or `"search"`. A lie of `quick`, found above, passes; only 10.03 is vouched for:

# %%
lie = replace(quick, lower_bound=quick.cost)  # not the optimum
print(lie.is_optimal, lie.proof, round(ms.check_certificate(problem, lie), 2))
assert lie.is_optimal and lie.cost > 1.01 * costs.min() and lie.proof == "search"

# %% [markdown]
# ## Switching costs and a budget: the same certificate
#
# Let a change of model cost 0.5. Now a schedule is a **path**: nodes cost `G`, arcs 0.5 where
# the model changes. The cheapest path replaces the sum of minima.
#
# Let a schedule also spend at most a budget of 3 on models and changes. Each unit spent then
# costs any $\lambda \ge 0$ more. The cheapest path, less $d^\top \Psi d$ and $3\lambda$, is the
# bound. Above it come the path's excess over the cheapest, $\lambda$ times what is left of the
# budget, and the square: within the budget none is negative. On the longer cart, with
# $\lambda$ such that the cheapest blend spends 3, and its $d$:

# %% tags=["hide-input"]
limited = replace(problem, switch_cost=0.5 * (1 - np.eye(4)), budget=3.0)
answer, point = ms.solve(limited), ms.relax_by_columns(limited)
lam, spent = point.multiplier, limited.perception_term(answer.choices)
bound, _ = ms.reference_bound(limited, point.reference, lam)
print(f"LB(d, {lam:.2f}) = {bound:.2f}; optimum {answer.cost:.2f}: {answer.choices} spends {spent}")
assert bound <= answer.cost
np.testing.assert_allclose(answer.cost, ms.enumerate_schedules(limited).cost)

# %% [markdown]
# **In one paragraph.** Any $d$ splits every cost into a bound, a square and reduced costs, which
# rule models out. The rest is searched from the last step: a label dies out of room or dominated.
# Next: where $d$ comes from.
#
# ## Recall
#
# <details><summary>Why is LB(d) a bound for a badly chosen d, too?</summary>
#
# The identity holds for every $d$, and what follows $LB(d)$ is never negative.
#
# </details>
# <details><summary>Two labels of one step, x = 1 and x = 2, room 3. May the dearer one die?</summary>
#
# Only if their costates are near: $\rho \le \sqrt{3 - 1} - \sqrt{3 - 2} = 0.41$. Otherwise
# earlier steps may cancel the dearer one's and not the other's.
#
# </details>
# <details><summary>A schedule says gap 0 and proof "search". What can you check?</summary>
#
# Its cost and its root bound. That nothing lies between is the search's word.
#
# </details>
#
# ## Exercises
#
# ### Exercise 1: branch and bound by hand
#
# The root of a tree allows all models. Relax: the cheapest blend gives a bound. If that reaches the
# best schedule known, nothing below is better. If not, split a step: a child for each model. The
# module's tree for the longer cart (reduced costs save children):

# %% alt="A tree of 16 nodes as an indented list, each with step and model. The root's bound is 10.0281; its four children settle step 2. The six nodes that were split have bounds below the optimum, 11.5894, the last by 0.0001." tags=["hide-input"]
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
# Write `branch(problem)`, about 20 lines, that returns choices, cost and the number of
# relaxations. Keep a list of boolean tables `allowed` (H, W), at first all true, and a best
# schedule (cost at first `np.inf`). Take a table; `ms.relax_interior_point(problem,
# allowed=allowed, ceiling=cost)` gives a `.bound` and `.weights` (H, W), or stops early at the
# ceiling. Round the weights to a schedule; better than the best? Drop the table if its bound
# reaches `cost * (1 - 1e-9)` or one model a step is left. Otherwise split the step of the most
# divided weights.


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
# Write `path_bound(problem, d)`: $LB(d)$ with switching costs, in $O(HW^2)$, without `ms`.
# `problem.mean[:, :, 0]` is $\mu$, `problem.linear` is $\ell$;
# `problem.beta * problem.switch_cost` are the arcs, row to column. Step by step, find the cheapest
# way to each model.


# %% tags=["exercise"]
def path_bound(problem, d):
    """Return the cheapest path of nodes G and arcs, less d'Psi d."""
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
# The landing's errors have one sign, no entry of its $\Psi$ is negative, and reduced costs prove
# the optimum. Is that why? Predict, then build `one_sign()`: a problem with positive means and
# $\Psi \ge 0$ whose cheapest blend stays more than 20% below the optimum. Say in a sentence why.


# %% tags=["exercise"]
def one_sign():
    """Return ms.SelectionProblem(psi, mean, variance, model_cost) and why.

    Means and variances are (H, W, 1), with H steps and W models.
    """
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
