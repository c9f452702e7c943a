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
# others). A robot with $n$ states, $m$ commands and $p$ perception inputs moves and pays:
#
# $$x_{t+1} = A x_t + B u_t + C s_t, \qquad
# J = \sum_{t=1}^{H-1} x_t^\top Q x_t + x_H^\top Q_f x_H + \sum_{t=0}^{H-1} u_t^\top R u_t .$$
#
# (`eq:jc` prints $x_{H-1}$ for $x_H$; all errata are in [paper.md](paper.md).) It never sees $s$:
# wind, waves, a slope. A perception model tells it $\hat s = s + e$. Of $W$ models, the larger err
# less and cost more. **The question**: which model should run at which step, so that what the
# errors cost and what the models cost is least, weighed together? This notebook finds the first
# half, what errors cost.

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
BLACK, BLUE, GREEN, ORANGE, RED = "#000000", "#0072B2", "#009E73", "#E69F00", "#D55E00"
PATTERN = {
    "open_loop": {"color": RED, "marker": "o"},
    "preview": {"color": BLUE, "marker": "s"},
    "causal": {"color": GREEN, "marker": "^"},
    "measurement": {"color": ORANGE, "marker": "v"},
}
figure, axes = plt.subplots(figsize=(12, 4.2))
axes.set(xlim=(0, 12), ylim=(0, 4.2))
axes.axis("off")


def box(x, y, text, colour=BLACK, width=1.7, height=0.7):
    """Draw a box with its text about (x, y)."""
    corner = (x - width / 2, y - height / 2)
    axes.add_patch(plt.Rectangle(corner, width, height, facecolor="white", edgecolor=colour, lw=2))
    axes.text(x, y, text, ha="center", va="center")


def arrow(points, text="", at=(0, 0), style="-"):
    """Draw an arrow along points, and a text."""
    axes.plot(*np.transpose(points[:-1]), color=BLACK, lw=2, ls=style)
    look = {"arrowstyle": "->", "lw": 2, "ls": style, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", points[-1], points[-2], arrowprops=look)
    axes.text(*at, text, ha="center", va="center")


box(0.9, 2.6, "world", width=1.5)
for y, name, colour in ((3.6, "large", GREEN), (2.6, "medium", ORANGE), (1.6, "small", RED)):
    box(3.6, y, name, colour)
    arrow([(1.65, 2.6), (2.75, y)])
    axes.plot([4.45, 5.1], [y, y], color=colour, lw=2)
    axes.plot(5.1, y, "o", color=colour)
axes.plot([5.1, 5.8], [1.6, 2.6], color=BLACK, lw=4)
axes.text(5.75, 3.45, "schedule", ha="center")
arrow([(5.8, 3.3), (5.5, 2.35)], style=":")
arrow([(5.8, 2.6), (7.2, 2.6)], "$\\hat s = s + e$", (6.5, 2.9))
box(8.1, 2.6, "controller")
arrow([(8.95, 2.6), (10.1, 2.6)], "$u$", (9.5, 2.85))
box(10.9, 2.6, "robot", width=1.6)
arrow([(0.9, 2.25), (0.9, 0.5), (11.3, 0.5), (11.3, 2.25)], "$s$", (4.5, 0.75))
arrow(
    [(10.5, 2.25), (10.5, 1.3), (8.1, 1.3), (8.1, 2.25)], "$x$: feedback, if any", (9.25, 1.0), "--"
)
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
# Regret $\frac23 (e_0 + e_1)^2$, whatever $x_0$ and $s$: to leave a minimum is free to first order.
# We write it $e^\top \Psi e$, with all errors in one column $e$; here each entry of the matrix
# $\Psi$ is $\frac23$. Errors $(1, -1)$ cost nothing. (`eq:relCtrlCost` asks for a strict
# inequality; equality does no harm.)
#
# **Look on the way.** Before $u_1$ let it see $x_1$, and believe $\hat s_1$ as before: $u_1 =
# -(x_1 + \hat s_1)/2$. **Predict** what $(1, -1)$ costs now.


# %%
def cost(x0, s, s_hat, looks):
    """Return J of the robot, in fractions."""
    u0 = -Fraction(x0 + sum(s_hat)) / 3
    x1 = x0 + u0 + s[0]
    u1 = -Fraction(x1 + s_hat[1]) / 2 if looks else u0
    return (x1 + u1 + s[1]) ** 2 + u0**2 + u1**2


for looks in (False, True):
    print(
        f"looks: {looks}, regret {cost(1, (1, 1), (2, 0), looks) - cost(1, (1, 1), (1, 1), looks)}"
    )

# %% [markdown]
# Half. The plan expected the two errors to undo each other; feedback repaired the first and then
# believed the second. So $\Psi$ depends on **what the controller knows, and when**.
#
# ## Any robot: three answers
#
# The Riccati recursion is $P_H = Q_f$, $S_t = R + B^\top P_{t+1} B$, $K_t = S_t^{-1} B^\top
# P_{t+1} A$, $P_t = Q + A^\top P_{t+1} (A - BK_t)$. Completing the square, for *any* commands,
#
# $$J = \mathrm{const} + \sum_t (u_t - u_t^*)^\top S_t (u_t - u_t^*), \qquad
# u_t^* = -S_t^{-1} B^\top \big(P_{t+1} (A x_t + C s_t) + q_{t+1}\big),$$
#
# where $q_t = (A - BK_t)^\top (P_{t+1} C s_t + q_{t+1})$, $q_H = 0$, is what later inputs ask for.
# Every controller here uses this formula with what it *believes*. So only wrong beliefs count.
# Let $m_t$ be the error of the state that it believes, $q(e)$ the recursion fed $e$ in place of $s$,
# and $S_t = G_t G_t^\top$:
#
# $$e^\top \Psi e = \sum_t |\mathrm{row}_t|^2, \qquad \mathrm{row}_t = G_t^{-1} B^\top \big(P_{t+1}
# (A m_t + C e_t) + q_{t+1}(e)\big).$$
#
# | pattern | memory: error $m_t$ of its state | now: $C e_t$? | foresight: $q(e)$? | a robot |
# |---|---|---|---|---|
# | `open_loop` | $m_0 = 0$, $m_{t+1} = A m_t + C e_t$ | yes | yes | an arm replays its plan |
# | `preview` | 0: it sees $x_t$ | yes | yes | a car sees the road ahead |
# | `causal` | 0 | yes | no | a drone senses the wind of now |
# | `measurement` | $C e_t$: it sees $x_t + C e_t$ | no | no | a drone reads its altitude off a picture |
# | `filter` | what an observer remembers | no | no | most robots (notebook 7) |
#
# (In the last two rows models measure states: $e$ is the error of what they measure, $C$ says which
# components, and $s$ pushes unseen.)
#
# On the two steps ($P_2 = 1$, $S_1 = 2$, $A - BK_1 = P_1 = \frac12$, $S_0 = \frac32$) `preview` pays
# $\frac12 e_1^2 + \frac23 (\frac12 e_0 + \frac12 e_1)^2$, which is $\frac12$ for $(1, -1)$;
# `open_loop` remembers $m_1 = e_0$ and pays $\frac12 (e_0 + e_1)^2 + \frac16 (e_0 + e_1)^2$;
# `causal` $\frac12 e_1^2 + \frac16 e_0^2$. In code, each row is a matrix that multiplies $e$; stacked
# they are $Y$, and $\Psi = Y^\top Y$:

# %%
TABLE = {  # memory, from A m_{t-1}, C e_{t-1}, C e_t; now; foresight
    "open_loop": (lambda carried, before, present: carried + before, 1, 1),
    "preview": (lambda carried, before, present: 0 * carried, 1, 1),
    "causal": (lambda carried, before, present: 0 * carried, 1, 0),
    "measurement": (lambda carried, before, present: present, 0, 0),
}


def rows(task, information):
    """Return Y (mH, pH), Psi = Y'Y; every column is a unit error."""
    (memory, now, foresight), law, H = TABLE[information], ms.riccati(task), task.horizon
    Ce = task.C @ np.eye(task.p * H).reshape(H, task.p, -1)  # (H, n, pH)
    q, m, Y = np.zeros((H + 1, *Ce[0].shape)), 0 * Ce[0], []
    for t in reversed(range(H)):
        q[t] = foresight * law.closed_loop[t].T @ (law.P[t + 1] @ Ce[t] + q[t + 1])
    for t in range(H):
        m = memory(task.A @ m, Ce[t - 1] if t else m, Ce[t])
        wrong = law.P[t + 1] @ (task.A @ m + now * Ce[t]) + q[t + 1]
        Y.append(np.linalg.solve(np.linalg.cholesky(law.S[t]), task.B.T @ wrong))
    return np.concatenate(Y)


two = ms.ControlTask([[1]], [[1]], [[1]], [[0]], [[1]], horizon=2, Q_final=[[1]])
for information in TABLE:
    Y = rows(two, information)
    print(f"{information:12} 6 Psi = {(6 * Y.T @ Y).round(6).tolist()}")
    np.testing.assert_allclose(Y.T @ Y, ms.psi(two, information))

# %% [markdown]
# The last two agree here as $AC = C$. **The paper** states the policy `preview` in its section II
# and takes $\Psi$ from a source that plans once: `open_loop`. Either is sound; what matters is to
# take the $\Psi$ of the controller that runs.
#
# **A forecast refreshed at every step** (MPC), the commonest of all, is no row of the table, and
# simpler. Step $t$ acts on the forecast made at $t$, with errors $e^{(t)}$ of its own, and pays
# $|\mathrm{row}_t\, e^{(t)}|^2$ of `preview`. No later step uses that forecast again: steps
# decouple, however its errors correlate among themselves, and the cheapest model of each step is
# best. (With one stale forecast, errors of different steps meet.) Exercise 2 builds it.
#
# ## Read off a boat
#
# A boat holds its place; its state is offset and speed. Waves carry it at $s_t$ (m/s), a mooring
# pulls it back, a thruster pushes; offset and thrust are charged, $H = 40$ steps of 0.2 s.

# %%
dt, H, rng = 0.2, 40, np.random.default_rng(1)
boat = ms.ControlTask(
    A=[[1, dt], [-dt, 0.95]], B=[[0], [dt]], C=[[dt], [0]], Q=np.diag([1, 0]), R=[[0.1]], horizon=H
)
x0, waves = np.array([1.0, 0.0]), 0.5 * np.sin(1.6 * dt * np.arange(H)[:, None])
estimate = waves + 0.3 + 0.2 * rng.normal(size=waves.shape)  # biased and noisy


def regret(task, x0, s, e, information):
    """Return J fed s + e less J fed s, by roll-out; leading axes are trials."""
    fed = ms.run_controller(task, x0, s, s + e, information)
    true = ms.run_controller(task, x0, s, s, information)
    return ms.control_cost(task, *fed) - ms.control_cost(task, *true)


for information in TABLE:
    Psi = rows(boat, information).T @ rows(boat, information)
    np.testing.assert_allclose(Psi, ms.psi(boat, information), atol=1e-12)
    e = (estimate - waves)[:, 0]
    found = regret(boat, x0, waves, e[:, None], information)
    print(f"{information:12} e'Psi e = {e @ Psi @ e:.3f}, this roll-out {found:.3f}")

# %% alt="Two panels over 8 seconds. Above, the estimated waves lie about 0.3 m/s above the true ones. Below, a boat fed the truth (cost 5.10) comes from offset 1 m to its mark at 0 and stays there; fed the estimates it is driven past the mark: under preview (7.64) it stays about 0.3 m beyond, open loop (8.48) it swings from side to side." tags=["hide-input"]
time = dt * np.arange(H + 1)
figure, (top, bottom) = plt.subplots(2, sharex=True, figsize=(10, 6.6), height_ratios=[2, 3])
top.plot(time[:-1], waves, color=BLACK, label="true $s$")
top.plot(time[:-1], estimate, "o--", color=ORANGE, ms=5, label="estimated $\\hat s$")
flown = {"the truth, either": ms.run_controller(boat, x0, waves, waves)}
for information in ("open_loop", "preview"):
    label = f"estimates, {information}"
    flown[label] = ms.run_controller(boat, x0, waves, estimate, information)
for label, (states, controls) in flown.items():
    look = {"ls": "--", **PATTERN[label[11:]]} if label[11:] in PATTERN else {"color": BLACK}
    label = f"{label}: {ms.control_cost(boat, states, controls):.2f}"
    bottom.plot(time, states[:, 0], label=label, markevery=4, ms=7, **look)
top.set(ylabel="waves (m/s)", title="Waves that are not there push the boat off its mark")
bottom.set(xlabel="time (s)", ylabel="offset (m)")
top.legend(loc="upper right", ncols=2)
bottom.legend(title="fed, and the cost $J$", loc="upper right")
plt.show()

# %% [markdown]
# The first two agree to the last digit, the others do not. A controller with a forecast that is
# right gives $u^*$, so the square is exact, draw for draw. Without a forecast even right beliefs
# miss $u^*$, by an amount that depends on $s$, and an error may happen to help. If $s$ has the mean
# that the controller expects and is independent of $e$, this averages out: $e^\top \Psi e$ is
# exact **in expectation**.

# %% alt="Histogram of the regret of one error over 2000 random seas, divided by e'Psi e. Under preview all are 1, a single spike. Under causal they spread like a bell from -2 to 4; some are negative, and their mean is 0.98." tags=["hide-input"]
e, seas = rng.normal(size=(H, 1)), rng.normal(size=(2000, H, 1))
ratio = {}
for information in ("preview", "causal"):
    price = (e.T @ ms.psi(boat, information) @ e).item()
    ratio[information] = regret(boat, x0, seas, e + 0 * seas, information) / price
np.testing.assert_allclose(ratio["preview"], 1, rtol=1e-9)
late = ratio["causal"]
assert abs(late.mean() - 1) < 3 * late.std() / 2000**0.5 and late.min() < 0
figure, axes = plt.subplots(figsize=(10, 4.4))
axes.hist(late, bins=60, color=GREEN, alpha=0.6, label="causal: 2000 seas")
axes.axvline(late.mean(), color=BLACK, ls=":", lw=3, label=f"their mean, {late.mean():.2f}")
axes.axvline(1, color=BLUE, lw=3, label="preview: all 2000 seas")
axes.set(xlabel="regret / $e^T \\Psi e$", ylabel="seas", title="Exact, and exact on average")
axes.legend()
plt.show()

# %% [markdown]
# ## Reading $\Psi$
#
# $e^\top \Psi e = \sum_{t,k} e_t \Psi_{tk} e_k$. $\Psi_{tt}$ is what an error of 1 at step $t$
# costs alone; $2\Psi_{tk} e_t e_k$ what two cost *together*, beyond that. Red: errors of one sign
# make each other dearer, opposite ones cancel. Blue: the other way round.

# %% alt="Heat maps of the four matrices Psi. Open loop: a wide red diagonal stripe, a blue (negative) stripe about 15 steps off it and a pale red one beyond, up to 0.617. Preview: a narrow red band along the diagonal, up to 0.139. Causal and measurement: the diagonal alone, up to 0.025 and 0.018." tags=["hide-input"]
figure, panels = plt.subplots(2, 2, figsize=(10, 8.6), sharex=True, sharey=True)
step, seen = np.arange(H), ("stripes", "a band", "a diagonal", "a diagonal")
for axes, information, form in zip(panels.flat, TABLE, seen, strict=True):
    Psi = ms.psi(boat, information)
    largest = np.abs(Psi).max()
    picture = axes.imshow(Psi, cmap="RdBu_r", vmin=-largest, vmax=largest)
    figure.colorbar(picture, ax=axes, shrink=0.8)
    axes.set_title(f"{information}: {form}, up to {largest:.3f}", size=15)
    axes.grid(visible=False)
    assert form != "a diagonal" or not Psi[step[:, None] != step].any()
figure.supxlabel("step $k$")
figure.supylabel("step $t$")
plt.show()

# %% [markdown]
# The rows say why. One wrong estimate, $e_{20} = 1$, spoils these commands, at the price
# $|\mathrm{row}_t|^2$ each:

# %% alt="Bars: what each step pays for an error of 1 in the estimate of step 20, in three panels. Causal pays at step 20 alone, 0.025 in all. Preview pays from about step 13 to step 20 and nothing after, 0.139 in all. Open loop pays the same up to step 20, and then again until the end, 0.388 in all." tags=["hide-input"]
figure, panels = plt.subplots(3, sharex=True, sharey=True, figsize=(10, 7))
words = {"causal": "now", "preview": "braces, now", "open_loop": "braces, now, remembers"}
bills = {information: rows(boat, information)[:, 20] ** 2 for information in words}
for axes, (information, bill) in zip(panels, bills.items(), strict=True):
    axes.bar(step, bill, color=PATTERN[information]["color"])
    axes.set_title(f"{information}: {words[information]}; in all {bill.sum():.3f}", size=16)
np.testing.assert_allclose(bills["open_loop"][:21], bills["preview"][:21])
assert not bills["preview"][21:].any() and not np.delete(bills["causal"], 20).any()
panels[1].set_ylabel("cost paid at step $t$")
panels[2].set_xlabel("step $t$; the estimate of step 20 is wrong by 1")
plt.show()

# %% [markdown]
# Preview *braces* beforehand for a wave that will not come: the bracing of two errors overlaps, and
# this makes its band. (It has nothing to forget: it sees its true state.) Open loop also believes
# itself elsewhere afterwards, and the boat swings: errors of one sign, half a swing apart, cancel.
#
# Step by step, then, $\Psi^{\mathrm{causal}}_{tt} \preceq \Psi^{\mathrm{preview}}_{tt} \preceq
# \Psi^{\mathrm{open}}_{tt}$ for every robot. `measurement` has no place in this order, and *whole*
# matrices have none either: $(1, -1)$ cost feedback more. Nor are late errors always cheap:


# %%
def scalar(A=1.0, Q_final=1.0):
    """Return a robot with one state and 20 steps."""
    return ms.ControlTask([[A]], [[1]], [[1]], [[1]], [[1]], 20, Q_final=[[Q_final]])


for name in ("measurement", "preview"):
    print(f"A = 2, step 10: {name} {ms.psi(scalar(2.0), name)[10, 10]:.1f}")
for Q_final in (1, 100):
    first, *_, last = ms.psi(scalar(Q_final=Q_final), "causal").diagonal()
    print(f"causal, Q_f = {Q_final}: first step {first:.2f}, last step {last:.2f}")
spread = np.linalg.eigvalsh(ms.psi(boat, "open_loop") - ms.psi(boat, "preview"))
assert spread[0] < 0 < spread[-1]

# %% [markdown]
# (For the boat the last errors are free without a forecast: the last thrust changes the speed and
# only the offset is charged, $B^\top Q_f C = 0$ for `causal`, $B^\top Q_f A C = 0$ for
# `measurement`.)
#
# ## Three models of equal mean square
#
# A robot with $A = 1$ (`scalar()`) plans once, which `ms.psi` assumes unless told. No input comes,
# but it is fed $+1$ always, or random signs, or $+1, -1, \dots$:

# %% alt="Positions over 20 steps of a robot that plans once, fed errors of size 1. The biased model makes it drift away in a straight line to about -20. Thirty runs with random signs wander apart in a fan, up to 10 from zero. With alternating signs it stays within 1 of zero. The legend gives their mean regrets." tags=["hide-input"]
line, calm = scalar(), np.zeros((20, 1))
fans = {
    "biased": (np.ones((1, 20, 1)), RED, "-"),
    "noisy": (rng.choice([-1.0, 1.0], (30, 20, 1)), BLUE, "-"),
    "alternating": (((-1.0) ** np.arange(20))[None, :, None], GREEN, "--"),
}
figure, axes = plt.subplots(figsize=(10, 5.4))
prices = {}
for name, (errors, colour, style) in fans.items():
    states, _ = ms.run_controller(line, [0], calm + 0 * errors, errors)
    prices[name] = (
        np.trace(ms.psi(line))
        if name == "noisy"
        else (errors[0].T @ ms.psi(line) @ errors[0]).item()
    )
    thin = {"lw": 1, "alpha": 0.6} if name == "noisy" else {"lw": 3.5}
    for k, path in enumerate(states):
        label = (
            f"{name}: regret {prices[name]:.0f}" + " on average" * (name == "noisy")
            if k == 0
            else None
        )
        axes.plot(
            path[:, 0], color=colour, ls=style, label=label, zorder=2 + (name != "noisy"), **thin
        )
axes.set(xlabel="step", ylabel="position", xticks=range(0, 21, 5))
axes.set_title("A bias drifts, noise wanders, alternation hugs zero")
axes.legend(loc="lower left")
plt.show()
assert prices["alternating"] < prices["noisy"] < prices["biased"]

# %% [markdown]
# Notebook 2 makes this precise. And the answer to the paper's question depends on the pattern. On
# the boat a small model always errs by 0.4 and is free, a medium one by 0.15 at 0.1 a step, a large
# one by 0 at 0.3. The total, $e^\top \Psi e$ plus prices, is least for these schedules:

# %% alt="Optimal schedules of a small, a medium and a large model over 40 steps. Open loop: small, but medium from step 4 to 10 (cost 1.47, best single model 3.13). Preview: small and medium in turn (3.84 against 4.33). Causal: small throughout (0.14). The large model is never run." tags=["hide-input"]
errors = np.tile([[0.4], [0.15], [0.0]], (H, 1, 1))  # (H, W, p): small, medium, large
figure, panels = plt.subplots(3, sharex=True, figsize=(10, 7))
for axes, information in zip(panels, TABLE, strict=False):
    Psi = ms.psi(boat, information)
    problem = ms.SelectionProblem(Psi, errors, 0 * errors, model_cost=[0, 0.1, 0.3])
    schedule = ms.solve(problem)
    single = min(float(problem.total_cost(np.full(H, w))) for w in range(3))
    assert schedule.is_optimal
    axes.step(step, schedule.choices, where="mid", color="#999999", lw=1)
    axes.plot(step, schedule.choices, ls="", ms=7, **PATTERN[information])
    axes.set(yticks=[0, 1, 2], yticklabels=["small", "medium", "large"], ylim=(-0.4, 2.4))
    best = f"total {schedule.cost:.2f} (best single model: {single:.2f})"
    axes.set_title(f"{information}: {best}", size=15)
axes.set_xlabel("step")
figure.suptitle("The best schedule depends on what the controller knows")
plt.show()

# %% [markdown]
# Open loop buys better estimates at seven steps only, and more than halves the cost of the best
# single model.
#
# **In one paragraph.** Completing the square turns regret into a sum over steps of what wrong
# beliefs do to each command: beliefs about the state (memory), this input (now), later ones
# (foresight). These three answers make $\Psi$: dense with a forecast or a memory of earlier errors,
# block diagonal without. Its signs say which errors cancel. Next: what of a random error does
# $\Psi$ feel?
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
# $g \cdot (e_0 + \dots + e_{H-1})^2$, and return $g$ as an exact fraction. ($H = 2$, $r = 1$:
# $\frac23$.)


# %% tags=["exercise"]
def gain(horizon, price):
    """Return g as a Fraction; horizon is an int, price a Fraction."""
    ...


# %% tags=["check", "skip-execution"]
for horizon, price in product((1, 2, 5), (Fraction(1, 2), Fraction(1), Fraction(3))):
    answer = gain(horizon, price)
    test = ms.ControlTask([[1]], [[1]], [[1]], [[0]], [[float(price)]], horizon, Q_final=[[1]])
    expected, case = ms.psi(test)[0, 0], f"for H = {horizon}, r = {price}"
    assert answer is not None, "Exercise 1: let gain(horizon, price) return the factor g"
    assert not np.isclose(float(answer * horizon), expected) or horizon == 1, (
        f"Exercise 1: {case} this is how far one command is off, squared; prices are missing: "
        "add what all H commands and the last state cost"
    )
    assert np.isclose(float(answer), expected), (
        f"Exercise 1: {case} psi says {expected:.4f}, you say {float(answer):.4f}"
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
# ### Exercise 3: measure a $\Psi$ that you cannot open
#
# You have a simulator, no equations: `measure(price, size)` gets a function that returns the regret
# of errors (size,). Return the matrix $\Psi$, symmetric, from as few calls as you can.


# %% tags=["exercise"]
def measure(price, size):
    """Return Psi (size, size) from calls of price(e)."""
    ...


# %% tags=["check", "skip-execution"]
for task, information in product((plane, replace(boat, horizon=6)), ("open_loop", "preview")):
    hidden, calls = ms.psi(task, information), []

    def price(e, hidden=hidden, calls=calls):
        """Return e'Psi e, and count."""
        calls.append(1)
        e = np.asarray(e, dtype=float)
        return e @ hidden @ e

    found = measure(price, len(hidden))
    assert found is not None, "Exercise 3: return a matrix"
    assert np.shape(found) == hidden.shape, f"Exercise 3: expected shape {hidden.shape}"
    assert np.allclose(np.diag(found), np.diag(hidden)), "Exercise 3: start with unit errors"
    assert np.allclose(found, hidden), "Exercise 3: what do two unit errors cost together?"
    least = len(hidden) * (len(hidden) + 1) // 2
    assert len(calls) <= least, f"Exercise 3: {least} calls are enough, you made {len(calls)}"
print("Exercise 3: right")

# %% [markdown]
# ### Exercise 4 (open): late errors
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
assert answer is not None and len(answer) == 2, "Exercise 4: return a task and a sentence"
test, why = answer
assert isinstance(test, ms.ControlTask) and test.p == 1, "Exercise 4: a ControlTask with p = 1"
assert test.horizon >= 10, "Exercise 4: at least 10 steps"
first, *_, last = ms.psi(test).diagonal()
assert first > 0 and last >= 10 * first, f"Exercise 4: first error {first:.3g}, last {last:.3g}"
assert len(why.split()) >= 8, "Exercise 4: explain it in a sentence"
print("Exercise 4: right")
