# %% [markdown]
# # 1. What does a perception error cost a controller?
#
# A robot acts on what its perception model says. When the model is wrong, the robot moves wrongly,
# and its control cost rises by $e^\top \Psi e$, a quadratic in the errors $e$: exactly if the
# robot acts on a forecast, on average if not. This notebook derives $\Psi$ for two steps by hand,
# computes it for any task, tests it by roll-outs, and reads it as a picture.
#
# **After this notebook you can**
#
# - derive the price of a perception error for two steps with pencil and paper;
# - pose a task, run a controller on wrong estimates, and predict the extra cost without running it;
# - read $\Psi$: its diagonal, the signs off the diagonal, its decay toward the end;
# - say which of four information patterns describes a robot, and what that changes;
# - name two places where the paper's section II needs a correction, and one where it is too strict.
#
# **Covers**: `eq:dynamics`, `eq:jc`, `eq:relCtrlCost`, `eq:control_cost_diff`,
# `prob:model_selection_naive`, `prob:model_selection`, `fig:one`; `ControlTask`, `riccati`, `plan`,
# `run_controller`, `control_cost`, `psi`, and a first look at `SelectionProblem` and `solve`.

# %%
from dataclasses import replace
from fractions import Fraction
from itertools import product

import matplotlib.pyplot as plt
import numpy as np

import landing
from modelselect import (
    INFORMATION,
    ControlTask,
    SelectionProblem,
    control_cost,
    plan,
    psi,
    riccati,
    run_controller,
    solve,
)

plt.rcParams.update(landing.STYLE)
BLACK, BLUE, GREEN, ORANGE, RED = "#000000", "#0072B2", "#009E73", "#E69F00", "#D55E00"
PATTERN = {
    "open_loop": {"color": RED, "marker": "o"},
    "preview": {"color": BLUE, "marker": "s"},
    "causal": {"color": GREEN, "marker": "^"},
    "measurement": {"color": ORANGE, "marker": "v"},
}


# %% [markdown]
# ## Two steps by hand
#
# A robot on a line moves by what it commands, $u_t$, and by what the world adds, $s_t$:
#
# $$x_{t+1} = x_t + u_t + s_t, \qquad t = 0, 1, \qquad J = x_2^2 + u_0^2 + u_1^2.$$
#
# **The best it can do.** Left alone it would end at $z = x_0 + s_0 + s_1$. Both commands do the
# same work at the same price, so they are equal. Minimise $(z + 2u)^2 + 2u^2$: the derivative
# $4(z + 2u) + 4u$ vanishes at $u^* = -z/3$, and $J(u^*) = z^2/3$.
#
# **What it does.** It never sees $s$. It is given estimates $\hat s = s + e$, believes that it will
# drift to $z + \varepsilon$ with $\varepsilon = e_0 + e_1$, and commands
# $\hat u = -(z + \varepsilon)/3$ twice. It really ends at $z + 2\hat u = (z - 2\varepsilon)/3$:
#
# $$J(\hat u) = \frac{(z - 2\varepsilon)^2 + 2(z + \varepsilon)^2}{9}
#   = \frac{z^2}{3} + \frac{2}{3}\varepsilon^2.$$
#
# The terms in $z\varepsilon$ cancel, because $u^*$ is a minimum: to first order, leaving a minimum
# is free. The **regret** $J(\hat u) - J(u^*) = \frac23 (e_0 + e_1)^2$ knows neither $x_0$ nor $s$.
#
# Numbers, in fractions: the robot starts at 1 and is pushed by 1 at each step; it overestimates the
# first push by 1.


# %%
def cost_by_hand(x0, s, u):
    """x_2^2 + u_0^2 + u_1^2 of the robot above, in exact fractions."""
    return (x0 + u[0] + s[0] + u[1] + s[1]) ** 2 + u[0] ** 2 + u[1] ** 2


def plan_by_hand(x0, s):
    """u_0 = u_1 = -z/3."""
    return [-Fraction(x0 + s[0] + s[1]) / 3] * 2


x0, s, s_hat = 1, (1, 1), (2, 1)
best, fed = plan_by_hand(x0, s), plan_by_hand(x0, s_hat)
regret = cost_by_hand(x0, s, fed) - cost_by_hand(x0, s, best)
print("u*    =", *best, "   J(u*)    =", cost_by_hand(x0, s, best))
print("u-hat =", *fed, " J(u-hat) =", cost_by_hand(x0, s, fed), "  regret =", regret)
assert regret == Fraction(2, 3) * (1 + 0) ** 2

# %% [markdown]
# Written as a quadratic, the regret is $e^\top \Psi e$ with
# $\Psi = \frac23 \begin{pmatrix} 1 & 1 \\ 1 & 1 \end{pmatrix}$. The module computes the same matrix
# from the matrices of the task. Here $A = B = C = R = 1$, nothing is charged on the way ($Q = 0$),
# and the last state is charged ($Q_f = 1$).

# %%
two_steps = ControlTask(A=[[1]], B=[[1]], C=[[1]], Q=[[0]], R=[[1]], horizon=2, Q_final=[[1]])
Psi = psi(two_steps)
print("3 Psi =", (3 * Psi).round(6).tolist())
np.testing.assert_allclose(Psi, [[2 / 3, 2 / 3], [2 / 3, 2 / 3]])

# %% [markdown]
# **Predict, then run.** The robot overestimates the first push by 1 and underestimates the second
# by 1. What is the regret of $e = (1, -1)$?

# %%
opposite = (2, 0)
fed = plan_by_hand(x0, opposite)
print("regret of e = (1, -1):", cost_by_hand(x0, s, fed) - cost_by_hand(x0, s, best))
assert fed == best

# %% [markdown]
# Nothing. The plan depends on the *sum* of the pushes only, so two wrong estimates made a right
# one. The vector $(1, -1)$ lies in the null space of $\Psi$. The paper assumes a strict inequality,
# $J(u^*) < J(\hat u)$ (`eq:relCtrlCost`); what holds is $J(u^*) \le J(\hat u)$, with equality
# exactly where $\Psi e = 0$. Nothing in the paper's argument needs the strict form.
#
# ## The same robot, looking up on the way
#
# That robot planned once and closed its eyes. Let it look at its true position before the second
# command: it still believes the estimate $\hat s_1$, but it replans from $x_1$. One step from the
# end the best command minimises $(x_1 + u_1 + \hat s_1)^2 + u_1^2$, so $u_1 = -(x_1 + \hat s_1)/2$.

# %%
u0 = plan_by_hand(x0, opposite)[0]  # believes the pushes to be (2, 0): their sum is right
x1 = x0 + u0 + s[0]  # what really happens
u1 = -(x1 + opposite[1]) / Fraction(2)  # believes that nothing pushes any more
print("x_1 =", x1, "  u_1 =", u1, "  J =", cost_by_hand(x0, s, [u0, u1]))
print("regret with feedback:", cost_by_hand(x0, s, [u0, u1]) - cost_by_hand(x0, s, best))

# %% [markdown]
# The robot with feedback pays $\frac12$ for errors that cost the robot without feedback nothing. It
# repaired a displacement that the plan expected to undo itself. Feedback is not the mistake; acting
# on the *second* wrong estimate alone is. So the same errors have another price, and $\Psi$ must
# depend on **what the controller knows, and when**. Four information patterns:

# %%
for information in INFORMATION:
    print(f"{information:12s} 6 Psi =", (6 * psi(two_steps, information)).round(6).tolist())
e = np.array([1, -1])
np.testing.assert_allclose(e @ psi(two_steps, "preview") @ e, 1 / 2)

# %% [markdown]
# | `information` | what the controller knows | for example |
# |---|---|---|
# | `open_loop` | at $t = 0$ the whole forecast, then nothing | an arm that replays a plan |
# | `preview` | its true state, and the rest of the forecast | a car that sees the road ahead |
# | `causal` | its true state, and the estimate of this step | a drone that senses the wind of now |
# | `measurement` | its state as the model sees it | a drone that reads its altitude off a picture |
#
# The last two agree here because $AC = C$: whether the robot believes in a push that is not there,
# or misreads its position by as much, it gives the same command. In general they differ.
#
# **A correction to section II of the paper.** Its text states a policy with feedback,
# $u_t = \pi(x_t, s_{t:H-1})$: that is `preview`. The matrix that it takes from the cited work, and
# that its experiments use, is the one of `open_loop`. For $e = (1, -1)$ one says $\frac12$, the
# other 0. Either is a sound choice. What matters is to take the $\Psi$ of the controller that runs.
#
# ## Any task
#
# A boat must hold its place at a mooring. Waves carry it along; the mooring pulls it back; a
# thruster pushes. Its state is the offset (m) and its speed (m/s), and the perception input $s_t$
# is the speed (m/s) at which the waves carry it during step $t$. The offset and the thrust are
# charged: $n = 2$ states, $m = 1$ command, $p = 1$ perception input.

# %%
dt, H = 0.2, 40  # seconds a step, steps
boat = ControlTask(
    A=[[1, dt], [-dt, 0.95]],  # offset and speed; the mooring pulls back
    B=[[0], [dt]],  # thrust
    C=[[dt], [0]],  # waves displace the boat
    Q=np.diag([1, 0]),
    R=[[0.1]],
    horizon=H,
)
x0 = np.array([1.0, 0.0])

# %% [markdown]
# A camera looks out to sea and estimates the waves to come. Suppose its model overestimates them
# all by 0.3 m/s and adds some noise. `run_controller` rolls the boat out under the true waves, fed
# the estimates; `control_cost` adds up $J$.

# %% alt="Two panels over 8 seconds. Above, the estimated waves lie about 0.3 m/s above the true ones. Below, a boat fed the truth (cost 5.10) comes from offset 1 m to its mark at 0 and stays there; fed the estimates it is driven past the mark: under preview (7.64) it stays about 0.3 m beyond, open loop (8.48) it swings from side to side."
rng, time = np.random.default_rng(1), dt * np.arange(H + 1)
waves = 0.5 * np.sin(1.6 * time[:-1, None])
estimate = waves + 0.3 + 0.2 * rng.normal(size=waves.shape)

figure, (top, bottom) = plt.subplots(2, sharex=True, figsize=(10, 6.6), height_ratios=[2, 3])
top.plot(time[:-1], waves, color=BLACK, label="true $s$")
top.plot(time[:-1], estimate, "o--", color=ORANGE, ms=5, label="estimated $\\hat s$")
states, controls = run_controller(boat, x0, waves, waves)
bottom.plot(
    time, states[:, 0], color=BLACK, label=f"the truth: {control_cost(boat, states, controls):.2f}"
)
for information in ("open_loop", "preview"):
    states, controls = run_controller(boat, x0, waves, estimate, information)
    label = f"estimates, {information}: {control_cost(boat, states, controls):.2f}"
    bottom.plot(
        time, states[:, 0], label=label, markevery=4, ms=7, **{"ls": "--", **PATTERN[information]}
    )
top.set(ylabel="waves (m/s)", title="Waves that are not there push the boat off its mark")
bottom.set(xlabel="time (s)", ylabel="offset (m)")
top.legend(loc="upper right", ncols=2)
bottom.legend(title="fed, and the cost $J$", loc="upper right")
plt.show()

# %% [markdown]
# Fed the truth, the boat settles near its mark, with or without feedback. Fed the estimates, it
# leans against a push that never comes.
#
# **Why the regret is a quadratic.** Stack all states, $X = F x_0 + M u + N s$, and put the costs
# $Q$ and $R$ of all steps on the diagonals of $\bar Q$ and $\bar R$. The cost is a quadratic in $u$
# with Hessian $2K$, $K = \bar R + M^\top \bar Q M$, least at
# $u^* = -K^{-1}(M^\top \bar Q F x_0 + L s)$ with $L = M^\top \bar Q N$. So the plan made from
# $\hat s = s + e$ misses $u^*$ by $\hat u - u^* = -K^{-1} L e$, whatever $x_0$ and $s$ are, and
#
# $$J(\hat u) - J(u^*) = (\hat u - u^*)^\top K (\hat u - u^*) = e^\top L^\top K^{-1} L\, e
#   = e^\top \Psi e.$$
#
# With feedback the commands miss $u^*$ by another linear map of $e$, and the form is the same with
# other $K$ and $L$. First the claim about the plans, then the claim about the costs, for random
# waves and errors and two starts.

# %%
trials = 500
s = rng.normal(size=(trials, H, 1))
e = rng.normal(size=(trials, H, 1))
difference = plan(boat, x0, s + e) - plan(boat, x0, s)
elsewhere = plan(boat, [-7, 2], 3 * s + e) - plan(boat, [-7, 2], 3 * s)
np.testing.assert_allclose(difference, elsewhere, atol=1e-9)


def regrets(task, x0, s, e, information):
    """J(fed s + e) - J(fed s) by roll-out; leading axes are trials."""
    fed = run_controller(task, x0, s, s + e, information)
    true = run_controller(task, x0, s, s, information)
    return control_cost(task, *fed) - control_cost(task, *true)


def quadratic(Psi, e):
    """e'Psi e of errors (..., H, p)."""
    e = e.reshape(*e.shape[:-2], -1)
    return ((e @ Psi) * e).sum(axis=-1)


for information in ("open_loop", "preview"):
    found = np.concatenate([regrets(boat, start, s, e, information) for start in (x0, [-7, 2])])
    expected = np.tile(quadratic(psi(boat, information), e), 2)
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    print(f"{information:10s} {len(found)} roll-outs agree with e'Psi e;", end=" ")
    print(f"first picture: {quadratic(psi(boat, information), estimate - waves):.2f}")
    assert (found >= 0).all()

# %% [markdown]
# Both are exact, draw for draw, and no regret is negative. In the first picture the costs exceed
# 5.10 by just these amounts: a boat that runs the policy of the paper's text, `preview`, pays 2.54,
# while the cited matrix, `open_loop`, says 3.38.
#
# Without a forecast $e^\top \Psi e$ cannot be exact: a robot that does not know the waves to come is
# sometimes helped by an error, by luck. What holds is the *average* over waves that are independent
# of the errors and whose mean the controller knows (here zero). The next cell draws 30 error
# vectors and rolls each out under 1000 different seas.

# %% alt="Regrets of single roll-outs against e'Psi e, with their averages over 1000 seas. Left, open loop: all dots lie on the diagonal. Right, causal: single roll-outs scatter widely about the diagonal and some are negative, but every average lies on it."
figure, panels = plt.subplots(1, 2, figsize=(10, 5.4))
errors = rng.normal(size=(30, 1, H, 1)) * np.linspace(0.3, 1.5, 30)[:, None, None, None]
sea = rng.normal(size=(30, 1000, H, 1))
for axes, information in zip(panels, ("open_loop", "causal"), strict=True):
    found = regrets(boat, x0, sea, errors + 0 * sea, information)
    expected = quadratic(psi(boat, information), errors)[:, 0]
    draws, average = found[:, :40].ravel(), found.mean(axis=1)
    axes.plot(np.repeat(expected, 40), draws, ".", color="#777777", ms=5, label="draws")
    hollow = {"ls": "", "ms": 11, "mfc": "none", "mew": 2, **PATTERN[information]}
    axes.plot(expected, average, label="averages", **hollow)
    axes.axline((0, 0), slope=1, color=BLACK, lw=1)
    axes.set(xlabel="$e^T \\Psi e$", xlim=(0, None))
    axes.legend(loc="upper left")
panels[0].set(ylabel="regret by roll-out", title="open_loop: exact, draw for draw")
panels[1].set_title("causal: exact on average")
plt.show()

# %% [markdown]
# On the left every dot lies on the line. On the right only the averages do. Now *exactly*: let every
# $s_t$ be $+1$ or $-1$ with equal chance. For eight steps these are 256 seas, and the average over
# all of them is the expectation. If the waves have a mean $m$ that the causal controller knows, and
# that it is told as `prior_mean`, the result is the same.

# %%
short = replace(boat, horizon=8)
seas = np.array(list(product((-1.0, 1.0), repeat=8)))[:, :, None]
one_error = rng.normal(size=(8, 1))
for information in INFORMATION:
    expected = quadratic(psi(short, information), one_error)
    average = regrets(short, x0, seas, one_error + 0 * seas, information).mean()
    print(f"{information:12s} e'Psi e {expected:.4f}, average of 256 seas {average:.4f}")
    np.testing.assert_allclose(average, expected, rtol=1e-9)

m = rng.normal(size=(8, 1))
fed, true = (
    control_cost(short, *run_controller(short, x0, m + seas, m + seas + e, "causal", m)).mean()
    for e in (one_error, 0 * one_error)
)
np.testing.assert_allclose(fed - true, quadratic(psi(short, "causal"), one_error))

# %% [markdown]
# For `measurement` the pushes must have mean zero.
#
# ## Reading $\Psi$
#
# Written out, the regret is a double sum, $e^\top \Psi e = \sum_t \sum_k e_t \Psi_{tk} e_k$.
#
# - **Diagonal.** $\Psi_{tt}$ is what an error of 1 at step $t$ costs when all else is right.
# - **Off the diagonal.** $2\Psi_{tk} e_t e_k$ is what two errors cost *together*, beyond what each
#   costs alone. Red (positive): errors of one sign make each other dearer, and opposite ones
#   cancel. Blue (negative): the other way round.

# %% alt="Heat maps of the four matrices Psi. Open loop: a wide red diagonal stripe, a blue (negative) stripe about 15 steps off it and a pale red one beyond, up to 0.617. Preview: a narrow red band along the diagonal, up to 0.139. Causal and measurement: the diagonal alone, up to 0.025 and 0.018."
figure, panels = plt.subplots(2, 2, figsize=(10, 8.6), sharex=True, sharey=True)
step, seen = np.arange(H), ("stripes", "a band", "a diagonal", "a diagonal")
for axes, information, form in zip(panels.flat, INFORMATION, seen, strict=True):
    Psi = psi(boat, information)
    largest = np.abs(Psi).max()
    picture = axes.imshow(Psi, cmap="RdBu_r", vmin=-largest, vmax=largest)
    figure.colorbar(picture, ax=axes, shrink=0.8)
    axes.set_title(f"{information}: {form}, up to {largest:.3f}", size=15)
    axes.grid(False)
    assert form != "a diagonal" or not Psi[step[:, None] != step].any()
figure.supxlabel("step $k$")
figure.supylabel("step $t$")
plt.show()
swing = np.linalg.eigvals(boat.A)[0]  # without thrust
assert round(2 * np.pi / abs(np.angle(swing))) == 31

# %% [markdown]
# **Open loop** is striped. The mooring makes the boat swing, with a period of 31 steps. A push
# swings back half a period later, so errors of one sign, half a period apart, cancel: the blue
# stripe. **Preview** has a band: feedback forgets a displacement within a few steps. **Causal** and
# **measurement** are diagonal. There the estimate $\hat s_t$ is used at step $t$ and never again,
# the true state (or the next look) replaces it, so no two errors ever meet.
#
# ## An error now, felt there
#
# Let the estimate be wrong at one step only, $e_{20} = 1$. When does the controller act wrongly?
# Since $\Psi$ does not depend on $x_0$ and $s$, take both zero. From any state $x$ the best
# command is then $-K_t x$, with the gains $K_t$ of the Riccati recursion. Completing squares splits
# the regret into one bill a step, which is never negative:
#
# $$J(u) - J(u^*) = \sum_t (u_t + K_t x_t)^\top S_t\, (u_t + K_t x_t), \qquad
#   S_t = R + B^\top P_{t+1} B.$$

# %% alt="What each step pays for an error of 1 in the estimate of step 20. Causal and measurement pay at step 20 alone (0.025 and 0.017 in all). Preview pays from about step 13 to step 20 and nothing after (0.139). Open loop pays the same up to step 20, and then again until the end (0.388)."
law, wrong = riccati(boat), np.zeros((H, 1))
wrong[20] = 1
bills = {}
figure, axes = plt.subplots()
for information, shift in zip(INFORMATION, (-0.3, -0.1, 0.1, 0.3), strict=True):
    states, controls = run_controller(boat, [0, 0], 0 * wrong, wrong, information)
    mistake = controls + np.einsum("tmn,tn->tm", law.K, states[:-1])
    bill = np.einsum("tm,tmk,tk->t", mistake, law.S, mistake)
    np.testing.assert_allclose(bill.sum(), psi(boat, information)[20, 20])
    bills[information] = bill
    label = f"{information}: sum {bill.sum():.3f}"
    axes.plot(
        step + shift,
        np.where(bill > 1e-9, bill, np.nan),
        ls="",
        ms=7,
        label=label,
        **PATTERN[information],
    )
    axes.vlines(step + shift, 0, bill, color=PATTERN[information]["color"], lw=2)
np.testing.assert_allclose(bills["open_loop"][:21], bills["preview"][:21], atol=1e-12)
np.testing.assert_allclose(bills["causal"][20], bills["preview"][20])
assert bills["preview"][21:].max() < 1e-12 and np.delete(bills["causal"], 20).max() < 1e-12
axes.axvline(20, color=BLACK, lw=1, ls=":")
axes.set(
    xlabel="step $t$",
    ylabel="bill of step $t$",
    title="Wrong about step 20: preview pays before, open loop also after",
)
axes.legend(loc="upper left")
plt.show()

# %% [markdown]
# **Causal** hears of the wave at step 20, errs once, and pays once. **Preview** pays the same at step
# 20, and *before* it: it braces for a wave that will not come. Afterwards it sees its true state and
# errs no more. **Open loop** pays exactly what preview pays up to step 20, and then goes on, for it
# believes itself where it is not. Each sum is $\Psi_{20,20}$. Nothing here is special to the boat:
# causal's bill is one of preview's, and preview's are among those of open loop. So for every task
# and step, in the order of semidefinite matrices,
#
# $$\Psi^{\mathrm{causal}}_{tt} \preceq \Psi^{\mathrm{preview}}_{tt} \preceq
#   \Psi^{\mathrm{open}}_{tt}.$$
#
# Does it follow that feedback never pays more? Recall $e = (1, -1)$.

# %%
for _ in range(100):  # the order of the blocks, for random tasks with two perception inputs
    A, B, C = (rng.normal(size=(3, k)) / 3**0.5 for k in (3, 2, 2))
    task = ControlTask(A, B, C, np.eye(3), np.eye(2), 5)
    causal, preview, open_loop = (psi(task, name) for name in ("causal", "preview", "open_loop"))
    for more, t in product((preview - causal, open_loop - preview), range(0, 10, 2)):
        assert np.linalg.eigvalsh(more[t : t + 2, t : t + 2])[0] > -1e-10 * open_loop.max()
gap = np.linalg.eigvalsh(psi(boat, "open_loop") - psi(boat, "preview"))
print(f"boat, open_loop - preview: eigenvalues from {gap[0]:.3f} to {gap[-1]:.3f}")
assert gap[0] < 0 < gap[-1]

# %% [markdown]
# It does not. *Block by block* open loop is dearest; *as a whole*
# $\Psi^{\mathrm{open}} - \Psi^{\mathrm{preview}}$ is indefinite. A single error costs open loop
# more. Errors that a plan expects to undo one another can cost feedback more.
#
# ## Late errors are cheap

# %% alt="The diagonal of Psi by step, on a log scale. Open loop (0.5 at first) lies above preview (0.14), causal (0.025) and measurement (0.017) throughout. All stay level or fall slowly until about step 35 and then drop steeply; preview starts as low as causal and rises for five steps."
figure, axes = plt.subplots()
for information in INFORMATION:
    diagonal = psi(boat, information).diagonal()
    assert diagonal[-1] < 0.15 * diagonal.max()
    shown = np.where(diagonal > 1e-9, diagonal, np.nan)
    axes.semilogy(step, shown, label=information, ms=6, markevery=2, **PATTERN[information])
axes.set(xlabel="step $t$", ylabel="$\\Psi_{tt}$ (cost per (m/s)$^2$)", ylim=(1e-4, 2))
axes.set_title("The price of one wrong estimate falls toward the end of the horizon")
axes.legend(loc="lower left")
plt.show()

# %% [markdown]
# A late error displaces few states, and few commands are left to be wrong. For this boat the very
# last estimate is worth nothing without a forecast (not drawn): the last thrust changes the speed,
# and only the offset is charged, $B^\top Q_f C = 0$. With a forecast the first estimates are
# cheaper too under `preview`: there was no time to brace for them, and feedback does the rest.
#
# ## Which robot is yours?
#
# Ask, in this order:
#
# 1. Does it act on estimates of what is *still to come* (waves ahead, the road ahead, a demand
#    forecast)? If not: `causal` when models estimate a disturbance and the state is known
#    otherwise, `measurement` when models estimate the state itself. The paper's story, a network
#    that reads the altitude from a picture, is of this last kind.
# 2. If so, does it correct itself on the way? Yes: `preview`. No: `open_loop`.
#
# With `causal` and `measurement` every step can be judged by itself, and choosing models is easy.
# With a forecast, errors meet, and it is hard (notebook 3). A robot that filters its measurements
# is none of the four exactly: its estimates carry old errors along (notebook 2, correlated errors).
#
# ## A slip in the time index
#
# `eq:jc` prints $J = c_{H-1}(x_{H-1}) + \sum_{t=0}^{H-1} c(x_t, u_t)$. This charges $x_{H-1}$ twice
# and never the state $x_H$ that the last command and the last push lead to. **Predict:** what does
# a huge last push cost, as printed?


# %%
def printed_cost(task, states, controls):
    """eq:jc as it stands in the paper."""
    stages = sum(x @ task.Q @ x + u @ task.R @ u for x, u in zip(states, controls, strict=False))
    return states[-2] @ task.Q_final @ states[-2] + stages


late = np.zeros((H, 1))
late[-1] = 100
huge = run_controller(boat, [0, 0], late, 0 * late)
published, calm = landing.preset("published"), np.zeros((150, 1))
undisturbed = run_controller(published.task, published.x0, calm, calm)
for name, task, flown in [
    ("huge last push", boat, huge),
    ("published landing, s = 0", published.task, undisturbed),
]:
    print(f"{name:25s} printed {printed_cost(task, *flown):12.7g}", end="   ")
    print(f"with x_H {control_cost(task, *flown):12.7g}")
assert printed_cost(boat, *huge) == 0 and np.isclose(control_cost(boat, *huge), 400)
assert f"{control_cost(published.task, *undisturbed):.6e}" == "5.189117e+15"  # the authors' log

# %% [markdown]
# As printed, nothing. The Oracle of the authors' log costs 5.189117e15: their code has the
# corrected index,
# $J = \sum_{t=1}^{H-1} x_t^\top Q x_t + x_H^\top Q_f x_H + \sum_{t=0}^{H-1} u_t^\top R u_t$.
#
# ## The question of the paper, in one sentence
#
# **At every step choose the perception model, so that the weighted sum of the control cost that its
# error causes, $e^\top \Psi e$, and of what running it costs is least.** Three models, known
# errors, and a first schedule:

# %% alt="Optimal schedules of a small, a medium and a large model over 40 steps. Open loop: small, but medium from step 4 to 10 (cost 1.47, best single model 3.13). Preview: small and medium in turn (3.84 against 4.33). Causal: small throughout (0.14). The large model is never run."
errors = np.tile([[0.4], [0.15], [0.0]], (H, 1, 1))  # (H, W, p): small, medium, large
figure, panels = plt.subplots(3, sharex=True, figsize=(10, 7))
for axes, information in zip(panels, INFORMATION[:3], strict=True):
    problem = SelectionProblem(psi(boat, information), errors, 0 * errors, model_cost=[0, 0.1, 0.3])
    schedule = solve(problem)
    single = min(float(problem.total_cost(np.full(H, w))) for w in range(3))
    assert schedule.is_optimal
    axes.step(step, schedule.choices, where="mid", color="#999999", lw=1)
    axes.plot(step, schedule.choices, ls="", ms=7, **PATTERN[information])
    axes.set(yticks=[0, 1, 2], yticklabels=["small", "medium", "large"], ylim=(-0.4, 2.4))
    axes.set_title(f"{information}: {schedule.cost:.2f} (best single model: {single:.2f})", size=15)
axes.set_xlabel("step")
figure.suptitle("The best schedule depends on what the controller knows")
plt.show()

# %% [markdown]
# Open loop buys a better model for seven steps in a row and pays less than half of what the best
# single model costs: the errors before and after cancel across the blue stripe. Preview has no such
# stripe, alternates, and pays more: one more case in which feedback costs more. Causal has so little at stake that the free model serves throughout. All three are
# proved optimal; how, is the subject of notebook 3.
#
# ## In one paragraph
#
# A controller fed wrong estimates pays $e^\top \Psi e$ more than one fed the truth, because the
# truth gives a minimum and leaving a minimum costs only to second order. $\Psi$ follows from the
# task and from the information pattern: dense where the controller acts on a forecast, block
# diagonal where it does not, smaller toward the end. Entries off the diagonal say which errors add
# up and which cancel. The next notebook lets the errors be random: what of a model's error
# distribution does the controller feel?
#
# ## Exercises
#
# ### Exercise 1: the robot on a line, any horizon
#
# Take the robot of the first section, $x_{t+1} = x_t + u_t + s_t$, but with $H$ steps and a price
# $r > 0$ on commands: $J = x_H^2 + r \sum_t u_t^2$. It plans once. Show that the regret is
# $g \cdot (e_0 + \dots + e_{H-1})^2$ and write a function that returns $g$ as an exact fraction.
# (Hint: all commands are equal; for $H = 2$, $r = 1$ the answer is $\frac23$.)


# %% tags=["exercise"]
def gain(horizon, price):
    """Return g as a Fraction; horizon is an int, price a Fraction."""
    ...


# %% tags=["check", "skip-execution"]
for horizon, price in product((1, 2, 5), (Fraction(1, 2), Fraction(1), Fraction(3))):
    answer = gain(horizon, price)
    line = ControlTask([[1]], [[1]], [[1]], [[0]], [[float(price)]], horizon, Q_final=[[1]])
    expected, case = psi(line)[0, 0], f"for H = {horizon}, r = {price}"
    assert answer is not None, "Exercise 1: let gain(horizon, price) return the factor g"
    assert not np.isclose(float(answer * horizon), expected) or horizon == 1, (
        f"Exercise 1: {case} this is how far one command is off, squared prices are missing: "
        "add what all H commands and the last state cost"
    )
    assert np.isclose(float(answer), expected), (
        f"Exercise 1: {case} psi says {expected:.4f}, you say {float(answer):.4f}"
    )
    assert isinstance(answer, Fraction), "Exercise 1: right in value; return it as a Fraction"
print("Exercise 1: right")

# %% [markdown]
# ### Exercise 2: the worst error
#
# Of all errors with $\sum_t |e_t|^2 = 1$, which costs this task most under this information
# pattern? Return it with shape $(H, p)$; its sign does not matter. (Hints: `np.linalg.eigh` returns
# the eigenvalues of a symmetric matrix in rising order, and the eigenvectors as *columns*. In a flat
# vector of $pH$ numbers component $r$ of step $t$ stands at place $tp + r$.)


# %% tags=["exercise"]
def worst_error(task, information):
    """Return errors (H, p) of unit sum of squares with the largest regret."""
    ...


# %% tags=["check", "skip-execution"]
plane = ControlTask(np.eye(2), np.eye(2), [[1, 0.5], [0, 1]], np.diag([1, 4]), np.eye(2), 5)
for task, information in product((boat, plane), INFORMATION):
    answer = worst_error(task, information)
    assert answer is not None, "Exercise 2: let worst_error return an array (H, p)"
    answer = np.asarray(answer)
    shape = (task.horizon, task.p)
    assert answer.shape == shape, f"Exercise 2: expected shape {shape}, found {answer.shape}"
    assert np.isclose((answer**2).sum(), 1), "Exercise 2: the squares must sum to 1"
    rest = np.zeros(task.n)
    found = regrets(task, rest, 0 * answer, answer, information)
    values = np.linalg.eigvalsh(psi(task, information))
    assert not np.isclose(found, values[0]), "Exercise 2: this is the cheapest error"
    assert np.isclose(found, values[-1], rtol=1e-4), (
        f"Exercise 2: {information}: yours costs {found:.4f}, another costs {values[-1]:.4f}; "
        "take the last column, not row, of the eigenvectors of this pattern's Psi"
    )
print("Exercise 2: right")

# %% [markdown]
# ### Exercise 3: an exact expectation without a forecast
#
# Let every component of every $s_t$ be $+1$ or $-1$ with equal chance, all independent: $2^{pH}$
# equally likely seas. Write a function that finds, by roll-outs alone, the exact expected regret of
# known errors $e$ of shape $(H, p)$: the average over all seas of $J$ fed $s + e$, less $J$ of **the
# same** controller fed $s$. Start from $x_0 = 0$. (Hint: `itertools.product` lists the seas;
# `run_controller` takes them all at once, with shape $(2^{pH}, H, p)$. The result should agree with
# $e^\top \Psi e$ in all four patterns.)


# %% tags=["exercise"]
def expected_regret(task, e, information):
    """Return the regret of errors e (H, p), averaged over all seas of -1 and 1."""
    ...


# %% tags=["check", "skip-execution"]
plane = ControlTask(np.eye(2), np.eye(2), [[1, 0.5], [0, 1]], np.diag([1, 4]), np.eye(2), 5)
for task, information in product(
    (replace(boat, horizon=4), replace(plane, horizon=3)), INFORMATION
):
    e = np.random.default_rng(5).normal(size=(task.horizon, task.p))
    answer = expected_regret(task, e, information)
    assert answer is not None, "Exercise 3: let expected_regret return a number"
    assert np.ndim(answer) == 0, "Exercise 3: average over the seas to get one number"
    expected = quadratic(psi(task, information), e)
    seas = np.array(list(product((-1.0, 1.0), repeat=e.size))).reshape(-1, *e.shape)
    fed = control_cost(task, *run_controller(task, np.zeros(task.n), seas, seas + e, information))
    oracle = control_cost(task, *run_controller(task, np.zeros(task.n), seas, seas, "preview"))
    assert not np.isclose(answer, -expected), "Exercise 3: the sign is the wrong way round"
    assert not np.isclose(answer, len(seas) * expected), "Exercise 3: average, do not add up"
    assert np.isclose(answer, expected) or not np.isclose(answer, (fed - oracle).mean()), (
        f"Exercise 3: {information}: you compare with a controller that knows all of s; "
        "compare with the same controller, fed s"
    )
    assert np.isclose(answer, expected), (
        f"Exercise 3: {information}: expected e'Psi e = {expected:.4f}, found {answer:.4f}"
    )
print("Exercise 3: right")

# %% [markdown]
# ### Exercise 4: which controller was this?
#
# From a test drive you have the task, the start $x_0$, the true inputs $s$, the estimates $\hat s$
# and the commands $u$ of shape $(H, m)$ that the robot gave, rounded to nine decimals as logs are.
# Write a function that returns the robot's information pattern, one of `INFORMATION`. (Hint: try
# each pattern; `run_controller` returns states *and* commands; a causal robot expects zero.)


# %% tags=["exercise"]
def identify(task, x0, s, s_hat, controls):
    """Return the information pattern under which run_controller gives these controls."""
    ...


# %% tags=["check", "skip-execution"]
plane = ControlTask(np.eye(2), np.eye(2), [[1, 0.5], [0, 1]], np.diag([1, 4]), np.eye(2), 5)
drive = np.random.default_rng(6)
for task, information in product((boat, plane), INFORMATION):
    s, e = drive.normal(size=(2, task.horizon, task.p))
    start = drive.normal(size=task.n)
    states, controls = run_controller(task, start, s, s + e, information)
    answer = identify(task, start, s, s + e, controls.round(9))
    assert answer is not None, (
        "Exercise 4: name a pattern for each drive; logged commands are rounded, never quite equal"
    )
    assert answer in INFORMATION, f"Exercise 4: expected one of {INFORMATION}, found {answer!r}"
    assert answer == information, (
        f"Exercise 4: a drive under {information} was taken for {answer}; "
        "compare all commands, and allow for rounding"
    )
print("Exercise 4: right")
