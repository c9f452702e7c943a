# %% [markdown]
# # 1. What does a perception error cost a controller?
#
# **After this notebook you can**
#
# - price the errors of two steps with pencil and paper;
# - build a controller's matrix $\Psi$ from three answers: what does it remember, use now, foresee?
# - say why the same errors cost another controller more, or nothing.
#
# **Covers** `eq:dynamics`, `eq:jc`, `eq:relCtrlCost`, `eq:control_cost_diff`,
# `prob:model_selection_naive`, `prob:model_selection`, `fig:one`.
#
# These notebooks follow *Dynamic Selection of Perception Models for Robotic Control* (its errata:
# [paper.md](paper.md)). A robot with state $x$ and commands $u$ moves $H$ steps and pays:
#
# $$x_{t+1} = A x_t + B u_t + C s_t, \qquad
# J = \sum_{t=1}^{H-1} x_t^\top Q x_t + x_H^\top Q_f x_H + \sum_{t=0}^{H-1} u_t^\top R u_t .$$
#
# It never sees $s_t$, $p$ numbers: wind, waves, a slope. A perception model tells it $\hat s = s +
# e$. Larger models err less and cost more. **The question**: which model should run at which step?
# First: what errors cost.

# %% tags=["hide-input"]
from dataclasses import replace
from fractions import Fraction
from itertools import product

import matplotlib.pyplot as plt
import numpy as np

import landing
import modelselect as ms

# %% alt="Block diagram. The world's s reaches three perception models and the robot. A switch, set by the schedule, passes one estimate, s hat = s + e, to the controller, which commands the robot by u. A dashed arrow, feedback if any, leads its state x back." tags=["hide-input"]
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
arrow("world", "robot", "$s$", (8, 0.55), "bar,fraction=0.2")
plt.show()

# %% [markdown]
# ## Two steps by hand
#
# Take $x_{t+1} = x_t + u_t + s_t$ and $J = x_2^2 + u_0^2 + u_1^2$. Start from the end.
#
# - The best last command is $u_1 = -\frac12 (x_1 + s_1)$. Off by $v$, it costs $2v^2$ more.
# - That leaves $\frac12 (x_1 + s_1)^2 + u_0^2$: the best first one is $u_0 = -\frac13 (x_0 + s_0 +
#   s_1)$. Off by $v$, it costs $\frac32 v^2$ more.
#
# Now $s$ is estimated with errors $e_0$ and $e_1$. The first command is off by $\frac13 (e_0 +
# e_1)$, up to its sign. The second depends on the controller:
#
# - `preview` looks at $x_1$ first. Only $e_1$ misleads it: it is off by $\frac12 e_1$.
# - `open_loop` plans once, for an $x_1$ that is wrong by $e_0$: it is off by $\frac12 (e_0 + e_1)$.
#
# In all the errors cost
#
# $$\text{preview: } \tfrac16 (e_0 + e_1)^2 + \tfrac12 e_1^2, \qquad
# \text{open\_loop: } \tfrac23 (e_0 + e_1)^2 .$$
#
# **Predict** what $(1, -1)$ costs each. Below: the **regret**, the cost fed $s + e$ less the cost of
# the *same controller* fed $s$.


# %% tags=["hide-input"]
def cost(x0, s, s_hat, information):
    """Return J of the robot, in fractions."""
    u0 = -Fraction(x0 + sum(s_hat)) / 3
    x1 = x0 + u0 + s[0]
    believed = {"preview": x1, "open_loop": x0 + u0 + s_hat[0]}[information]
    u1 = -Fraction(believed + s_hat[1]) / 2
    return (x1 + u1 + s[1]) ** 2 + u0**2 + u1**2


for information in ("preview", "open_loop"):
    fed, true = (cost(1, (1, 1), s_hat, information) for s_hat in ((2, 0), (1, 1)))
    print(f"{information:9} regret {fed - true}")

# %% [markdown]
# In the plan the two errors undo each other. `preview` sees the true $x_1$, and the second stands
# alone. So the price depends on **what the controller knows, and when**. We write it $e^\top \Psi
# e$, with all errors in one column.
#
# ## Any robot: three answers
#
# LQR finds the same for any robot. The best command is minus a gain $K_t$ times the state, minus
# gains $F_{tk}$ times the inputs of this step and of later ones. One that is off by $v$ costs
# $v^\top S_t v$ more, in any state. (Above, $F_{01} = \frac13$ and $S_0 = \frac32$.)
#
# A controller puts its *beliefs* in the place of state and inputs. So its command is off by the
# same gains times its errors, and prices add:
#
# $$v_t = \underbrace{K_t m_t}_{\text{memory}} + \underbrace{F_{tt} e_t}_{\text{now}} +
# \underbrace{F_{t,t+1} e_{t+1} + \dots}_{\text{foresight}}, \qquad
# e^\top \Psi e = \sum_t v_t^\top S_t v_t .$$
#
# | pattern | memory $m_t$: its error about $x_t$ | now | foresight |
# |---|---|---|---|
# | `open_loop`: an arm replays its plan | $m_{t+1} = A m_t + C e_t$, from 0 | yes | yes |
# | `preview`: a car sees the road ahead | 0: it looks | yes | yes |
# | `causal`: a drone senses the wind | 0: it looks | yes | no |
# | `measurement`: a drone reads its altitude off pictures | $C e_t$: it misreads | no | no |
# | `filter`: most robots (notebook 7) | what an observer remembers | no | no |
#
# In the last two rows $e$ is in a reading of the state, and $s$ pushes unseen.
#
# In code each quantity is a matrix that multiplies $e$. Half the slope of the cost to come, at
# $x_{t+1}$, is $P_{t+1}(Ax_t+Bu_t)$ plus `push` of this input and `q` of later ones. `B.T` takes it
# to the command, `closed_loop.T` to $x_t$, as commands answer:

# %%
TABLE = {  # memory, now, foresight
    "open_loop": ("past", 1, 1),
    "preview": ("none", 1, 1),
    "causal": ("none", 1, 0),
    "measurement": ("misread", 0, 0),
}


def psi_by_step(task, information):
    """Return (H, pH, pH): e' psi_by_step[t] e is what step t pays; their sum is Psi."""
    (memory, now, foresight), H = TABLE[information], task.horizon
    law = ms.riccati(task)  # LQR. P: what a state costs; K; S = R + B'PB; closed_loop = A - BK
    Ce = task.C @ np.eye(task.p * H).reshape(H, task.p, -1)
    past = [0 * Ce[0]]
    for t in range(H - 1):
        past.append(task.A @ past[t] + Ce[t])
    m = {"past": past, "none": 0 * Ce, "misread": Ce}[memory]
    pays, q = [], 0
    for t in reversed(range(H)):
        push = law.P[t + 1] @ Ce[t]
        told = task.B.T @ (now * push + foresight * q)
        v = law.K[t] @ m[t] + np.linalg.solve(law.S[t], told)  # the last term: all those with F
        pays.insert(0, v.T @ law.S[t] @ v)
        q = law.closed_loop[t].T @ (push + q)
    return np.array(pays)


# %% tags=["hide-input"]
two = ms.ControlTask([[1]], [[1]], [[1]], [[0]], [[1]], horizon=2, Q_final=[[1]])
for information in TABLE:
    Psi = psi_by_step(two, information).sum(axis=0)
    print(f"two steps, {information:12} 6 Psi = {(6 * Psi).round(6).tolist()}")
    np.testing.assert_allclose(Psi, ms.psi(two, information))

# %% [markdown]
# The paper's policy is `preview`, its $\Psi$ that of `open_loop`. Take the running controller's.
#
# **With a forecast refreshed at every step** (MPC) step $t$ pays as under `preview`, for the errors
# of the forecast made at $t$. No later step uses it, so steps decouple.
#
# ## Fly it
#
# A boat holds its place against waves for 40 steps; offset and thrust cost. It gets the same errors
# in 1000 random seas and their mirror images:

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


e, seas = rng.normal(size=(H, 1)), rng.normal(size=(1000, H, 1))
seas = np.concatenate([seas, -seas])
for information in TABLE:
    price = (e.T @ psi_by_step(boat, information) @ e).sum()
    found = regrets(boat, [1, 0], seas, e + 0 * seas, information)
    span = f"{found.min():6.3f} to {found.max():6.3f}, mean {found.mean():6.3f}"
    print(f"{information:12} e'Psi e = {price:6.3f}; regrets {span}")
    np.testing.assert_allclose(found.mean(), price)

# %% [markdown]
# With a forecast the price is exact in every sea. Without one even right beliefs miss waves, and an
# error may help. Where $s$ has mean 0 and is independent of $e$, this averages out:
# $e^\top \Psi e$ is exact **in expectation**.
#
# ## Reading $\Psi$
#
# $\Psi_{tt}$ is what an error of 1 at step $t$ costs alone; $2\Psi_{tk}$ what errors of 1 at two
# steps cost *together*, beyond that. Red: errors of one sign make each other dearer. Blue: they
# cancel, in part. Below: what each step pays if only the estimate of step 20 is wrong, by 1.

# %% alt="Causal: Psi is a diagonal; step 20 alone pays, 0.025. Preview: a red band; steps 13 to 20 pay most, none later, 0.139 in all. Open loop: a wide red stripe, a blue one 15 steps off; the same steps pay, then others until the end, 0.388 in all." tags=["hide-input"]
figure, panels = plt.subplots(2, 3, sharex=True, sharey="row", figsize=(13, 7.4))
words = {"causal": "now", "preview": "now, foresight", "open_loop": "now, foresight, memory"}
bills = {information: psi_by_step(boat, information)[:, 20, 20] for information in words}
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
# Preview *braces* beforehand for a wave that will not come, and the bracing of two errors overlaps:
# the band. Open loop also believes itself elsewhere afterwards.
#
# So one error alone costs `causal` least and `open_loop` most, for every robot. *Two* errors need
# not. `measurement` has no place in this order, and late errors are not always cheap. One state, 20
# steps, all matrices 1 unless told:


# %% tags=["hide-input"]
def scalar(A=1.0, Q_final=1.0):
    """Return a robot with one state and 20 steps."""
    return ms.ControlTask([[A]], [[1]], [[1]], [[1]], [[1]], 20, Q_final=[[Q_final]])


for name in ("measurement", "preview"):
    print(f"A = 2, an error at step 10 costs {name} {ms.psi(scalar(2.0), name)[10, 10]:.1f}")
for Q_final in (1, 100):
    first, *_, last = ms.psi(scalar(Q_final=Q_final), "causal").diagonal()
    print(f"Q_f = {Q_final}: it costs causal {first:.2f} at the first step, {last:.2f} at the last")

# %% [markdown]
# ## Three models of equal mean square
#
# This robot, all matrices 1, plans once. No input comes, but models report +1 always, or random
# signs, or +1 and -1 in turn:

# %% alt="Positions over 20 steps, errors of size 1. The biased model makes the robot drift in a straight line to about -20. Thirty runs with random signs fan out, up to 10 from zero. With alternating signs it stays within 1." tags=["hide-input"]
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
# ## Which model at which step?
#
# At every step of the boat a small model errs by +0.4 and is free, a medium one by +0.15 and costs
# 0.1, a large one is right and costs 0.3. The cheapest schedules, their totals (errors and models),
# and the best single model's (small):

# %% tags=["hide-input"]
errors = np.tile([[0.4], [0.15], [0.0]], (H, 1, 1))  # (H, 3, p): small, medium, large
for name in ("open_loop", "preview", "causal"):
    problem = ms.SelectionProblem(
        ms.psi(boat, name), mean=errors, variance=0 * errors, model_cost=[0, 0.1, 0.3]
    )
    best, single = ms.solve(problem), problem.total_cost(np.arange(3)[:, None] + [0] * H).min()
    print(f"{name:9}", "".join("sml"[w] for w in best.choices), f"{best.cost:.2f}, {single:.2f}")
    assert best.is_optimal

# %% [markdown]
# One error alone is dearest under `open_loop`, 40 alike are not: there seven better estimates let red
# and blue nearly cancel; under `preview` the blue is too pale.
#
# **In one paragraph.** Wrong beliefs about the state (memory), this input (now) and later ones
# (foresight) put commands off. $e^\top \Psi e$ is what all commands pay. By memory and foresight
# steps meet, and the signs of $\Psi$ say which errors cancel.
#
# ## Recall
#
# <details><summary>Under preview or open_loop, why has the regret no term of first order in e?</summary>
#
# A right forecast gives the best commands. Off by $v$, each adds a square.
#
# </details>
# <details><summary>Which patterns let errors of two steps meet, and through what?</summary>
#
# `preview` by foresight, `open_loop` by foresight and memory, `filter` by memory. `causal` and
# `measurement` use an error once.
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
# $r = 1$: $\frac23$. All commands of the plan are equal; without them the robot would end at $z =
# x_0 + s_0 + \dots + s_{H-1}$.)


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
# `psi_by_step`; then, with pencil: what is the regret if all forecasts are one and the same?


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
        f"Exercise 2: a roll-out finds {J - true:.4f}, you {answer:.4f}; "
        "which errors does step t pay for?"
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
