# %% [markdown]
# # 1. What does a perception error cost a controller?
#
# **After this notebook you can**
#
# - derive the price of an error for two steps with pencil and paper;
# - build the matrix $\Psi$ of a controller from three answers: what does it remember, use now,
#   foresee?
# - read $\Psi$: its diagonal, its signs, its blocks;
# - say why the same errors cost another controller more, or nothing.
#
# **Covers** `eq:dynamics`, `eq:jc`, `eq:relCtrlCost`, `eq:control_cost_diff`,
# `prob:model_selection_naive`, `prob:model_selection`, `fig:one`.
#
# These notebooks follow *Dynamic Selection of Perception Models for Robotic Control* (Ghosh and
# others). A robot with $n$ states, $m$ commands and $p$ perception inputs moves $H$ steps and pays:
#
# $$x_{t+1} = A x_t + B u_t + C s_t, \qquad
# J = \sum_{t=1}^{H-1} x_t^\top Q x_t + x_H^\top Q_f x_H + \sum_{t=0}^{H-1} u_t^\top R u_t .$$
#
# (`eq:jc` prints $x_{H-1}$ for $x_H$; all errata are in [paper.md](paper.md).) It never sees $s$:
# wind, waves, a slope. A perception model tells it $\hat s = s + e$. Larger models err less and
# cost more. **The question**: which model should run at which step, so that errors and models
# together cost least? This notebook finds what errors cost.

# %%
from dataclasses import replace
from fractions import Fraction
from itertools import product

import matplotlib.pyplot as plt
import numpy as np

import landing
import modelselect as ms

# %% alt="Block diagram. The world's s reaches small, medium and large perception models; a switch, set by the schedule, passes one estimate, s hat = s + e, to the controller, which commands the robot by u. The world's s pushes the robot, too. Its state x goes back to the controller by a dashed arrow marked feedback, not in every pattern." tags=["hide-input"]
plt.rcParams.update(landing.STYLE)
BLUE, GREEN, RED = "#0072B2", "#009E73", "#D55E00"
figure, axes = plt.subplots(figsize=(12, 4))
axes.set(xlim=(0, 12), ylim=(0, 4.2))
axes.axis("off")
place = {"world": (0.8, 2.5), "large": (3.4, 3.6), "medium": (3.4, 2.5), "small": (3.4, 1.4)}
place |= {"controller": (8, 2.5), "robot": (11.2, 2.5)}
edge = {"facecolor": "white", "edgecolor": "black", "boxstyle": "square,pad=0.6", "lw": 2}
middle = {"ha": "center", "va": "center"}
box = {name: axes.text(*xy, name, bbox=edge, **middle) for name, xy in place.items()}


def arrow(start, end, text="", at=(0, 0), shape="arc3", style="-"):
    """Draw an arrow from a box or a point to a box, and its text."""
    look = {"arrowstyle": "->", "lw": 2, "ls": style, "connectionstyle": shape}
    look |= {"patchA": box[start].get_bbox_patch()} if start in box else {"shrinkA": 0}
    look |= {"patchB": box[end].get_bbox_patch()}
    axes.annotate("", place[end], place.get(start, start), arrowprops=look)
    axes.text(*at, text, **middle)


for name in ("large", "medium", "small"):
    arrow("world", name)
    axes.plot([3.4, 5], [place[name][1]] * 2, "o-", color="black", lw=2, markevery=[1], zorder=0)
axes.plot([5, 5.7], [1.4, 2.5], color="black", lw=5)
axes.text(5.6, 1.7, "set by the schedule")
arrow((5.7, 2.5), "controller", "$\\hat s = s + e$", (6.4, 2.75))
arrow("controller", "robot", "$u$", (9.7, 2.7))
arrow("robot", "controller", "$x$: feedback, if any", (9.6, 3.9), "bar,fraction=0.35", "--")
arrow("world", "robot", "$s$", (5, 0.7), "bar,fraction=0.2")
plt.show()

# %% [markdown]
# ## Two steps by hand
#
# Take $x_{t+1} = x_t + u_t + s_t$ and $J = x_2^2 + u_0^2 + u_1^2$. **Regret** is, here and
# throughout, $J$ fed $s + e$ less $J$ of the *same controller* fed $s$.
#
# **Plan once.** Left alone the robot would end at $z = x_0 + s_0 + s_1$. The best plan is $u_0 =
# u_1 = -z/3$, and $J = z^2/3$. Fed $\hat s$ it believes in $z + \varepsilon$, $\varepsilon = e_0 +
# e_1$:
#
# $$J = \frac{(z - 2\varepsilon)^2 + 2(z + \varepsilon)^2}{9} = \frac{z^2}{3} +
# \frac23 \varepsilon^2 .$$
#
# So the regret is $\frac23 (e_0 + e_1)^2$, whatever $x_0$ and $s$ are. We write it $e^\top \Psi e$,
# with all errors in one column $e$; here each entry of the matrix $\Psi$ is $\frac23$. Errors
# $(1, -1)$ cost nothing. (`eq:relCtrlCost`, $J(u^*) < J(\hat u)$ for the commands from $s$ and from
# $\hat s$, should allow equality.)
#
# **Look on the way.** Before $u_1$ let it see $x_1$, and believe $\hat s_1$ as before: $u_1 =
# -(x_1 + \hat s_1)/2$. **Predict** what $(1, -1)$ costs now.


# %% tags=["hide-input"]
def cost(x0, s, s_hat, looks):
    """Return J of the robot, in fractions."""
    u0 = -Fraction(x0 + sum(s_hat)) / 3
    x1 = x0 + u0 + s[0]
    u1 = -Fraction(x1 + s_hat[1]) / 2 if looks else u0
    return (x1 + u1 + s[1]) ** 2 + u0**2 + u1**2


for looks in (False, True):
    regret = cost(1, (1, 1), (2, 0), looks) - cost(1, (1, 1), (1, 1), looks)
    print(f"looks: {looks}, regret {regret}")

# %% [markdown]
# Half. In the plan the two errors undo each other. Feedback sees $x_1$, which repairs what it
# believed of $s_0$, and then believes the second error alone. So $\Psi$ depends on **what the controller knows, and when**.
#
# ## Any robot: three answers
#
# **What a command costs.** From $P_H = Q_f$ backwards, the Riccati recursion of LQR finds for each
# step $S_t = R + B^\top P_{t+1} B$, a gain $K_t = S_t^{-1} B^\top P_{t+1} A$ and $P_t = Q + A^\top
# P_{t+1} (A - BK_t)$. Completing the square, for *any* commands,
#
# $$J = \mathrm{const} + \sum_t (u_t - u_t^*)^\top S_t (u_t - u_t^*), \qquad
# u_t^* = -S_t^{-1} B^\top \big(P_{t+1} (A x_t + C s_t) + q_{t+1}\big).$$
#
# The costate $q$ is what later inputs ask for: $q_H = 0$, $q_t = (A - BK_t)^\top (P_{t+1} C s_t +
# q_{t+1})$.
#
# **What a controller gets wrong.** Each uses the formula of $u_t^*$ with what it *believes*. So its
# command is off by three wrong beliefs at most: of its state, by $m_t$ (memory); of this input, by
# $C e_t$ (now); of later ones, by $q(e)$, the recursion fed $e$ in place of $s$ (foresight). With
# $S_t = G_t G_t^\top$,
#
# $$e^\top \Psi e = \sum_t |\mathrm{row}_t\, e|^2, \qquad \mathrm{row}_t\, e = G_t^{-1} B^\top
# \big(P_{t+1} (A m_t + C e_t) + q_{t+1}(e)\big).$$
#
# The table says which parts a controller has; a part that it lacks is 0. (Without foresight, even
# right beliefs miss $u_t^*$. Then $e^\top \Psi e$ is the regret on average only: see *Fly it*.)
#
# | pattern | memory $m_t$ | now $C e_t$ | foresight $q(e)$ | a robot |
# |---|---|---|---|---|
# | `open_loop` | past: $m_0 = 0$, $m_{t+1} = A m_t + C e_t$ | yes | yes | an arm replays its plan |
# | `preview` | 0: it sees $x_t$ | yes | yes | a car sees the road ahead |
# | `causal` | 0: it sees $x_t$ | yes | 0 | a drone senses the wind of now |
# | `measurement` | $C e_t$: it misreads $x_t$ | 0 | 0 | a drone reads its altitude off a picture |
# | `filter` | what an observer remembers | 0 | 0 | most robots (notebook 7) |
#
# (In the last two rows $s$ pushes unseen; models measure the part of the state on which $C$ acts,
# wrong by $C e$.) In code each row is a matrix, (m, pH), that multiplies $e$. Stacked they are $Y$,
# and $\Psi = Y^\top Y$; `closed_loop` holds $A - BK_t$:

# %%
TABLE = {  # memory, now, foresight
    "open_loop": ("past", 1, 1),
    "preview": ("none", 1, 1),
    "causal": ("none", 1, 0),
    "measurement": ("misread", 0, 0),
}


def rows(task, information):
    """Return Y (mH, pH); each column is what a unit error does."""
    (memory, now, foresight), law, H = TABLE[information], ms.riccati(task), task.horizon
    Ce = task.C @ np.eye(task.p * H).reshape(H, task.p, -1)  # (H, n, pH)
    q, past, Y = np.zeros((H + 1, *Ce[0].shape)), 0 * Ce[0], []
    for t in reversed(range(H)):
        q[t] = foresight * law.closed_loop[t].T @ (law.P[t + 1] @ Ce[t] + q[t + 1])
    for t in range(H):
        m = {"past": past, "none": 0 * past, "misread": Ce[t]}[memory]
        wrong = law.P[t + 1] @ (task.A @ m + now * Ce[t]) + q[t + 1]
        Y.append(np.linalg.solve(np.linalg.cholesky(law.S[t]), task.B.T @ wrong))
        past = task.A @ past + Ce[t]
    return np.concatenate(Y)


# %% tags=["hide-input"]
two = ms.ControlTask([[1]], [[1]], [[1]], [[0]], [[1]], horizon=2, Q_final=[[1]])
for information in TABLE:
    Y = rows(two, information)
    print(f"{information:12} 6 Psi = {(6 * Y.T @ Y).round(6).tolist()}")
    np.testing.assert_allclose(Y.T @ Y, ms.psi(two, information))

# %% [markdown]
# `open_loop` is $\frac23$ throughout, as by hand. `preview` has $P_2 = 1$, $S_1 = 2$, $P_1 = A -
# BK_1 = \frac12$, $S_0 = \frac32$, and pays $\frac12 e_1^2 + \frac23 (\frac12 e_0 + \frac12
# e_1)^2$: a half for $(1, -1)$. The last two agree because $AC = C$ here.
#
# **The paper** states the policy `preview` in its section II and takes $\Psi$ from a source that
# plans once: `open_loop`. Either is sound; take the $\Psi$ of the controller that runs.
#
# **A forecast refreshed at every step** (MPC) is the commonest of all and needs no line of its own.
# Step $t$ acts on the forecast made at $t$, with errors $e^{(t)}$, and pays $|\mathrm{row}_t\,
# e^{(t)}|^2$ of `preview`. No later step uses that forecast, so steps decouple (exercise 2).
#
# ## Fly it
#
# A boat holds its place for 40 steps of 0.2 s; its state is offset and speed. Waves carry it at
# $s_t$ (m/s), a mooring pulls it back, a thruster pushes. Offset and thrust are charged ($Q_f = Q$
# unless told). We feed it the same errors $e$ in 1000 random seas and in their mirror images, so
# that the mean sea is 0; `regrets` flies each sea twice, fed $s + e$ and fed $s$:

# %% tags=["hide-input"]
dt, H, rng = 0.2, 40, np.random.default_rng(1)
boat = ms.ControlTask(
    A=[[1, dt], [-dt, 0.95]], B=[[0], [dt]], C=[[dt], [0]], Q=np.diag([1, 0]), R=[[0.1]], horizon=H
)


def regrets(task, x0, s, e, information):
    """Return J fed s + e less J fed s, by roll-out; leading axes are trials."""
    fed = ms.run_controller(task, x0, s, s + e, information)
    true = ms.run_controller(task, x0, s, s, information)
    return ms.control_cost(task, *fed) - ms.control_cost(task, *true)


# %%
e, seas = rng.normal(size=(H, 1)), rng.normal(size=(1000, H, 1))
seas = np.concatenate([seas, -seas])
for information in TABLE:
    price = ((rows(boat, information) @ e) ** 2).sum()
    found = regrets(boat, [1, 0], seas, e + 0 * seas, information)
    span = f"{found.min():6.3f} to {found.max():6.3f}, mean {found.mean():6.3f}"
    print(f"{information:12} e'Psi e = {price:6.3f}; regrets {span}")
    np.testing.assert_allclose(found.mean(), price)

# %% [markdown]
# With a right forecast (`open_loop`, `preview`) the commands are $u^*$, so $e^\top \Psi e$ is exact
# in every sea. Without one even right beliefs miss $u^*$, and an error may happen to help. If $s$
# has the mean that the controller expects, 0, and is independent of $e$, this averages out:
# $e^\top \Psi e$ is exact **in expectation**.
#
# ## Reading $\Psi$
#
# $e^\top \Psi e = \sum_{t,k} e_t^\top \Psi_{tk} e_k$. Each $\Psi_{tk}$ is a $p \times p$ block, here
# a number. $\Psi_{tt}$ is what an error of 1 at step $t$ costs alone; $2\Psi_{tk} e_t e_k$ what two
# cost *together*, beyond that. Red: errors of one sign make each other dearer, opposite ones
# cancel. Blue: the other way round. Below: what each step pays, $|\mathrm{row}_t\, e|^2$, if the
# estimate of step 20 is wrong by 1.

# %% alt="Three columns. Causal: the matrix Psi is a diagonal, and of an error at step 20 step 20 alone pays, 0.025. Preview: a narrow red band; steps up to 20 pay, most from step 13 on, and none after, 0.139 in all. Open loop: a wide red diagonal stripe with a blue, negative one some 15 steps off it; the same steps pay as under preview, and then again until the end, 0.388 in all." tags=["hide-input"]
figure, panels = plt.subplots(2, 3, sharex=True, sharey="row", figsize=(13, 7.4))
words = {"causal": "now", "preview": "now, foresight", "open_loop": "now, foresight, memory"}
bills = {information: rows(boat, information)[:, 20] ** 2 for information in words}
for (top, bottom), (information, bill) in zip(panels.T, bills.items(), strict=True):
    Psi = ms.psi(boat, information)
    largest = np.abs(Psi).max()
    top.imshow(Psi, cmap="RdBu_r", vmin=-largest, vmax=largest, aspect="auto")
    top.set_title(f"{information}: {words[information]}\n$\\Psi$ up to {largest:.3f}", size=15)
    top.grid(visible=False)
    bottom.bar(range(H), bill, color="black")
    bottom.set_title(f"in all {bill.sum():.3f}", size=15)
panels[0, 0].set_ylabel("$\\Psi_{tk}$, step $t$")
panels[1, 0].set_ylabel("paid at each step")
figure.supxlabel("step (above: $k$)")
plt.show()
np.testing.assert_allclose(bills["open_loop"][:21], bills["preview"][:21])
assert not bills["preview"][21:].any() and not np.delete(bills["causal"], 20).any()

# %% [markdown]
# Preview *braces* beforehand for a wave that will not come. The bracing of two errors overlaps: the
# band. Open loop also believes itself elsewhere afterwards, and the boat swings: errors of one
# sign, half a swing apart, cancel. `measurement` is a diagonal, as `causal`.
#
# So one error alone costs `causal` least and `open_loop` most, for every robot. *Two* errors need
# not: $(1, -1)$ cost feedback more. `measurement` has no place in this order, and late errors are
# not always cheap. One state, 20 steps, all matrices 1 unless told:


# %% tags=["hide-input"]
def scalar(A=1.0, Q_final=1.0):
    """Return a robot with one state and 20 steps."""
    return ms.ControlTask([[A]], [[1]], [[1]], [[1]], [[1]], 20, Q_final=[[Q_final]])


for name in ("measurement", "preview"):
    print(f"A = 2, step 10: {name} {ms.psi(scalar(2.0), name)[10, 10]:.1f}")
for Q_final in (1, 100):
    first, *_, last = ms.psi(scalar(Q_final=Q_final), "causal").diagonal()
    print(f"causal, Q_f = {Q_final}: first step {first:.2f}, last step {last:.2f}")

# %% [markdown]
# ## Three models of equal mean square
#
# The same robot, $A = 1$ (`scalar()`), plans once, which `ms.psi` assumes unless told. No input
# comes, but it is fed $+1$ always, or random signs, or $+1, -1, \dots$:

# %% alt="Positions over 20 steps of a robot that plans once, fed errors of size 1. The biased model makes it drift away in a straight line to about -20. Thirty runs with random signs wander apart in a fan, up to 10 from zero. With alternating signs it stays within 1 of zero. The legend gives their mean regrets." tags=["hide-input"]
fans = {
    "noisy": (rng.choice([-1.0, 1.0], (3000, 20, 1)), BLUE, 1, "-"),
    "biased": (np.ones((1, 20, 1)), RED, 4, "-"),
    "alternating": (((-1.0) ** np.arange(20))[None, :, None], GREEN, 4, "--"),
}
figure, axes = plt.subplots(figsize=(10, 5.4))
prices = {}
for name, (errors, colour, width, style) in fans.items():
    states, _ = ms.run_controller(scalar(), [0], 0 * errors, errors)
    prices[name] = regrets(scalar(), [0], 0 * errors, errors, "open_loop").mean()
    first, *_ = axes.plot(states[:30, :, 0].T, color=colour, lw=width, ls=style)
    first.set_label(f"{name}: {prices[name]:.0f}")
axes.set(xlabel="step", ylabel="position", xticks=range(0, 21, 5))
axes.set_title("A bias drifts, noise wanders, alternation hugs zero")
axes.legend(title="regret (noisy: mean of 3000)", loc="lower left")
plt.show()
assert prices["alternating"] < prices["noisy"] < prices["biased"]

# %% [markdown]
# Notebook 2 makes this precise. Now the paper's question, for the boat: a small model errs by
# $+0.4$ at every step and is free, a medium one by $+0.15$ at 0.1 a step, a large one by 0 at 0.3.
# The total, $e^\top \Psi e$ plus prices, is least for these schedules (first number: that total;
# second: the best single model's; `0 * errors`: no variance, these errors are known):

# %%
errors = np.tile([[0.4], [0.15], [0.0]], (H, 1, 1))  # (H, W, p): small, medium, large
for name in ("open_loop", "preview", "causal"):
    problem = ms.SelectionProblem(ms.psi(boat, name), errors, 0 * errors, model_cost=[0, 0.1, 0.3])
    best, single = ms.solve(problem), problem.total_cost(np.arange(3)[:, None] + [0] * H).min()
    print(f"{name:9}", "".join("sml"[w] for w in best.choices), f"{best.cost:.2f}, {single:.2f}")
    assert best.is_optimal

# %% [markdown]
# The answer depends on the pattern. Open loop buys better estimates at seven steps only, and pays
# less than half of what its best single model costs.
#
# **In one paragraph.** Regret is a sum over steps of what wrong beliefs do to each command: beliefs
# about the state (memory), this input (now), later ones (foresight). These three answers make
# $\Psi$: dense with a forecast or a memory of earlier errors, block diagonal without. Its signs say
# which errors cancel. Next: what of a random error does $\Psi$ feel?
#
# ## Recall
#
# <details><summary>Under preview or open_loop, why has the regret no term of first order in e?</summary>
#
# A right forecast gives $u^*$, the minimum, whatever $s$ and $x_0$ are; there the slope is 0.
#
# </details>
# <details><summary>Which patterns let errors of two steps meet, and through what?</summary>
#
# `preview` by foresight, `open_loop` by foresight and memory, `filter` by memory. `causal` and
# `measurement` have neither.
#
# </details>
# <details><summary>An MPC gets a fresh forecast at every step. Its errors correlate along the forecast. Do steps couple?</summary>
#
# No. Each forecast is used for one command. Its correlations enter that step's price alone.
#
# </details>
#
# ## Exercises
#
# ### Exercise 1: the robot on a line, any horizon
#
# $x_{t+1} = x_t + u_t + s_t$, $J = x_H^2 + r \sum_t u_t^2$, planned once. Show that the regret is
# a number times $(e_0 + \dots + e_{H-1})^2$, and return this number as an exact fraction. ($H = 2$,
# $r = 1$: $\frac23$.)


# %% tags=["exercise"]
def gain(horizon, price):
    """Return the number as a Fraction; horizon is an int, price (r) a Fraction."""
    ...


# %% tags=["check", "skip-execution"]
for horizon, price in product((1, 2, 5), (Fraction(1, 2), Fraction(1), Fraction(3))):
    answer = gain(horizon, price)
    test = ms.ControlTask([[1]], [[1]], [[1]], [[0]], [[float(price)]], horizon, Q_final=[[1]])
    expected, case = ms.psi(test)[0, 0], f"for H = {horizon}, r = {price}"
    assert answer is not None, "Exercise 1: let gain(horizon, price) return the number"
    assert np.isclose(float(answer), expected), (
        f"Exercise 1: {case} psi says {expected:.4f}, you say {float(answer):.4f}; "
        "add what all H commands and the last state cost"
    )
    assert isinstance(answer, Fraction), "Exercise 1: right in value; return it as a Fraction"
print("Exercise 1: right")

# %% [markdown]
# ### Exercise 2: a forecast refreshed at every step
#
# Write `mpc_regret(task, forecasts)`: `forecasts[t, k]` (H, H, p) is the error, in the forecast
# made at step $t$, of $s_k$. (Entries with $k < t$ are of the past and used by nobody.) First by
# `rows`; then, with pencil: what is $\Psi$ if all forecasts are one and the same?


# %% tags=["exercise"]
def mpc_regret(task, forecasts):
    """Return the regret of a controller that plans anew from each step's own forecast."""
    ...


# %% tags=["check", "skip-execution"]
plane = ms.ControlTask(np.eye(2), np.eye(2), [[1, 0.5], [0, 1]], np.diag([1, 4]), np.eye(2), 5)
for task in (replace(boat, horizon=8), plane):
    wrong = np.random.default_rng(2).normal(size=(task.horizon, task.horizon, task.p))
    s, x, J = np.random.default_rng(3).normal(size=wrong[0].shape), np.ones(task.n), 0.0
    for t in range(task.horizon):
        rest = replace(task, horizon=task.horizon - t)
        u = ms.plan(rest, x, s[t:] + wrong[t, t:])[0]
        x = task.A @ x + task.B @ u + task.C @ s[t]
        J += x @ (task.Q_final if t == task.horizon - 1 else task.Q) @ x + u @ task.R @ u
    true = ms.control_cost(task, *ms.run_controller(task, np.ones(task.n), s, s, "preview"))
    answer = mpc_regret(task, wrong)
    assert answer is not None and np.ndim(answer) == 0, "Exercise 2: return a number"
    assert np.isclose(answer, J - true), (
        f"Exercise 2: a roll-out finds {J - true:.4f}, you {answer:.4f}; step t owns m rows of Y"
    )
print("Exercise 2: right")

# %% [markdown]
# ### Exercise 3 (open): late errors
#
# When are late errors dear? Predict for `open_loop`: can the last error cost ten times the first?
# Build `late_is_dear()`: a `ControlTask` of at least 10 steps with $\Psi_{H-1,H-1} \ge 10\,
# \Psi_{00}$ when it **plans once**, and a sentence that says why. ($\Psi_{00} > 0$.)


# %% tags=["exercise"]
def late_is_dear():
    """Return a ControlTask, and a sentence that explains its dear last error."""
    ...


# %% tags=["check", "skip-execution"]
answer = late_is_dear()
assert answer is not None and len(answer) == 2, "Exercise 3: return a task and a sentence"
test, why = answer
assert isinstance(test, ms.ControlTask) and test.p == 1, "Exercise 3: a ControlTask with p = 1"
assert test.horizon >= 10, "Exercise 3: at least 10 steps"
first, *_, last = ms.psi(test).diagonal()
assert first > 0 and last >= 10 * first, f"Exercise 3: first error {first:.3g}, last {last:.3g}"
assert len(why.split()) >= 8, "Exercise 3: explain it in a sentence"
print("Exercise 3: right")
