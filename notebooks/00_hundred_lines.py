# %% [markdown]
# # 0. The whole of it in a hundred lines
#
# **After this notebook you can**
#
# - go from a robot's $A, B, C$ to a schedule of perception models with a proof;
# - say which of five kinds of controllers is yours;
# - change the hundred lines, and know what stays proved.
#
# **Covers** `eq:dynamics`, `eq:control_cost_diff`, `prob:model_selection_expectation`,
# `sol:model_selection_expectation`.
#
# A robot pushed by $s_t$ follows $x_{t+1} = A x_t + B u_t + C s_t$ and pays $x^\top Q x + u^\top R
# u$ at each step. A perception model tells it $\hat s_t = s_t + e_t$; large models err less and
# cost more. **Which model should run at which step?** The answer in NumPy alone; notebooks 1 to 4
# say why. Skim now, come back later.
#
# ## Two steps by hand
#
# All matrices are 1. The robot sees its state and acts on a forecast (`preview`). Model b0 is free
# and errs by 1; b1 costs 0.2 and errs by -0.5.
#
# 1. `riccati`, from $P_2 = Q$ back: $P_2, S_1, P_1, S_0 = 1, 2, \frac32, \frac52$. A command that
#    is off by $v_t$ costs $S_t v_t^2$ more.
# 2. `sensitivity`: $e_1$ puts the last command off by $v_1 = P_2 e_1 / S_1 = \frac12 e_1$. The
#    rest, $\frac12 e_1$, its **costate**, is foreseen: $v_0 = (P_1 e_0 + \frac12 e_1) / S_0$. Both
#    cost $e^\top \Psi e = S_0 v_0^2 + S_1 v_1^2 = 0.9 e_0^2 + 0.6 e_0 e_1 + 0.6 e_1^2$. So `[1 0]`,
#    with errors -0.5 and 1, costs 0.725, the others 0.925 or more: errors that cancel win.
# 3. `certificate`: the convex cost of errors lies above its tangent at any $d$, $2 (\Psi d)^\top
#    e - d^\top \Psi d$. `reference` finds about $d = (\frac2{45}, \frac4{45})$, where $2 \Psi d =
#    (\frac2{15}, \frac2{15})$. With it b0 and b1 cost the same: $\frac2{15} = -\frac1{15} +
#    \frac15$. So no schedule is below $\frac4{15} - d^\top \Psi d = 0.258$.
# 4. `search`, from the last step back, extends **labels**: the models from some step on, their
#    cost above the bound (`extra`), their costate. It drops what cannot beat 0.725 or what another
#    always beats.
#
# `schedule` does it all; a narrow search finds the schedule to beat. `PATTERNS` says what the
# controller knows (the sheet below).

# %% tags=["copy"]
import numpy as np
from numpy.linalg import pinv, solve

PATTERNS = {  # error m_t of the believed state; does u_t use e_t (told)? later e (foresight)?
    # from z = A m_{t-1}, before = C e_{t-1}, now = C e_t
    "open_loop": (lambda z, before, now, gain: z + before, 1, 1),
    "preview": (lambda z, before, now, gain: 0 * z, 1, 1),
    "causal": (lambda z, before, now, gain: 0 * z, 1, 0),
    "measurement": (lambda z, before, now, gain: now, 0, 0),
    "filter": (lambda z, before, now, gain: z + gain @ (now - z), 0, 0),  # C of full column rank
}


def riccati(A, B, Q, R, H):
    """Return (P_{t+1}, S_t, A - B K_t) of each step."""
    P, steps = Q, []
    for _ in range(H):
        S = R + B.T @ P @ B
        closed = A - B @ solve(S, B.T @ P @ A)
        steps.insert(0, (P, S, closed))
        P = Q + A.T @ P @ closed
    return steps


def sensitivity(A, B, C, Q, R, H, pattern, gain=0):
    """Psi: the sum of w_t' S_t^{-1} w_t, where w_t = B'(P_{t+1}(A m_t + C e_t) + q_{t+1})."""
    memory, told, foresight = PATTERNS[pattern]
    steps, (n, p) = riccati(A, B, Q, R, H), C.shape
    Ce = C @ np.eye(p * H).reshape(H, p, p * H)  # each column: an error of 1 at one step
    q = np.zeros((H + 1, n, p * H))
    for t in reversed(range(H)):
        P, _, closed = steps[t]
        q[t] = foresight * closed.T @ (P @ Ce[t] + q[t + 1])
    m, before, Psi = 0 * q[0], 0 * q[0], 0
    for t, (P, S, _) in enumerate(steps):
        m = memory(A @ m, before, Ce[t], np.dot(gain, pinv(C)))
        wrong = B.T @ (P @ (A @ m + told * Ce[t]) + q[t + 1])
        Psi, before = Psi + wrong.T @ solve(S, wrong), Ce[t]
    return Psi


def certificate(Psi, mean, linear, d):
    """For any d: total(c) = bound + sum_t reduced[t, c_t] + (mu_c - d)'Psi(mu_c - d)."""
    G = 2 * mean * (Psi @ d)[:, None] + linear
    return G.min(axis=1).sum() - d @ Psi @ d, G - G.min(axis=1, keepdims=True)


def reference(Psi, mean, linear, rounds=2000):
    """A good d: average the schedules that the gradient likes best, one after the other."""
    T, d = np.arange(len(mean)), mean[:, 0]
    for k in range(rounds):
        c = certificate(Psi, mean, linear, d)[1].argmin(axis=1)
        d = d + (mean[T, c] - d) / (k + 1)
    return d


def search(A, B, C, Q, R, mean, d, reduced, room, width):
    """Return the labels (extra, costate, models) left at step 0, and all: (t, label, kept)."""
    steps, felt, log = riccati(A, B, Q, R, len(mean)), [0 * A], []
    for _, S, closed in steps:  # what earlier steps feel of a difference of costates
        felt.append(B @ solve(S, B.T) + closed @ felt[-1] @ closed.T)
    alive = [(0.0, np.zeros(len(A)), ())]
    for t in reversed(range(len(mean))):
        (P, S, closed), grown = steps[t], []
        for extra, q, later in alive:
            for w, error in enumerate(mean[t]):
                h = P @ C[:, 0] * (error - d[t]) + q
                paid = B.T @ h @ solve(S, B.T @ h)
                grown.append((extra + reduced[t, w] + paid, closed.T @ h, (w, *later)))
        alive = []
        for x, q, models in sorted(grown, key=lambda label: label[0]):
            fits = x <= room and len(alive) < width
            for y, other, _ in alive if fits else ():
                far = np.sqrt(max(0, (q - other) @ felt[t] @ (q - other)))
                fits = fits and far + np.sqrt(room - x) > np.sqrt(room - y)  # no disc in a disc
            log.append((t, (x, q, models), fits))
            if fits:
                alive.append((x, q, models))
    return alive, log


def schedule(A, B, C, Q, R, mean, linear):
    """Return the cheapest schedule (preview, p = 1), its cost, bound, d, room and the log."""
    Psi, T = sensitivity(A, B, C, Q, R, len(mean), "preview"), np.arange(len(mean))
    d = reference(Psi, mean, linear)
    bound, reduced = certificate(Psi, mean, linear, d)
    off = mean[T, reduced.argmin(axis=1)] - d
    room = off @ Psi @ off  # a schedule of reduced costs 0 costs just this above the bound
    for width in (10, np.inf):
        spare = room + 1e-9 * (bound + room)  # for rounding
        alive, log = search(A, B, C, Q, R, mean, d, reduced, spare, width)
        room = min([room] + [label[0] for label in alive])
    extra, _, c = alive[0]
    return np.array(c), bound + extra, bound, d, spare, log


# %% [markdown]
# The two steps, checked:

# %%
robot = 5 * [np.eye(1)]  # A, B, C, Q, R
np.testing.assert_allclose(sensitivity(*robot, 2, "preview"), [[0.9, 0.3], [0.3, 0.6]])
c, cost, bound, *_ = schedule(*robot, np.array(2 * [[1, -0.5]]), np.array(2 * [[0, 0.2]]))
print(c, f"costs {cost:.3f}, bound {bound:.3f}")
assert c.tolist() == [1, 0] and np.isclose(cost, 0.725) and np.isclose(bound, 58 / 225, atol=2e-4)

# %% [markdown]
# A cart, pushed off by what it estimates: 40 steps, three models, errors of random signs.

# %%
H, dt = 40, 0.1
A, B, C = np.array([[1, dt], [0, 1]]), np.array([[0], [dt]]), np.array([[dt], [0]])
Q, R, size = np.eye(2), np.array([[0.1]]), np.array([0.5, 0.2, 0.05])
mean = np.random.default_rng(0).choice([-1, 1], (H, 3)) * size
Psi = sensitivity(A, B, C, Q, R, H, "preview")
linear = np.diag(Psi)[:, None] * (0.2 * size) ** 2 + [0, 0.002, 0.004]  # variance and price
best, cost, bound, d, room, log = schedule(A, B, C, Q, R, mean, linear)
single = [mean[:, w] @ Psi @ mean[:, w] + linear[:, w].sum() for w in range(3)]
print(*best, f"\ncosts {cost:.5f}, root bound {bound:.5f}, best single {min(single):.5f}", sep="")
print(f"{len(log)} labels in the last search, of {3.0**H:.0e} schedules")
assert bound < cost < 0.51 * min(single)

# %% [markdown]
# Half the cost of the best single model. 21 of 40 steps take the free one, whose errors cancel in
# part. The modules find the same schedule:

# %%
import landing
import modelselect as ms

answer = ms.solve(ms.SelectionProblem(Psi, mean[:, :, None], 0 * mean[:, :, None], linear))
assert answer.is_optimal and (answer.choices == best).all() and np.isclose(answer.cost, cost)

# %% [markdown]
# ## A picture of the labels
#
# Left, each label's extra cost $x$; above 1 there is no room. Right, the discs of step 15: around
# each costate, of radius $\sqrt{\text{room}-x}$. A disc inside another may go: whatever it can
# still afford, the other can, at no higher cost.

# %% alt="Left, labels by step, from step 39 to step 0, at the height of their extra cost over the room: at most 29 dots a step are kept, crosses are dropped, all above 1 among them; the line of the optimum climbs from 0 to 1. Right, the discs of step 15 in the plane of costates: 14 kept ones overlap in a long cloud, each filled grey one lies inside a kept one; the optimum's is orange." tags=["hide-input"]
import matplotlib.pyplot as plt

plt.rcParams.update(landing.STYLE)
ORANGE, BLUE, at = landing.LOOK["Optimal"]["color"], landing.LOOK["Best Single"]["color"], 15
figure, (left, right) = plt.subplots(1, 2, figsize=(13, 6))
for fate, label, look, colour in ((0, "dropped", "x", "#999999"), (1, "kept", "o", BLUE)):
    points = [(t, x / room) for t, (x, *_), kept in log if kept == fate and x < 1.3 * room]
    left.plot(*np.transpose(points), look, color=colour, ms=6, label=label)
ours = [(t, x / room) for t, (x, _, models), _ in log if models == tuple(best[t:])]
left.plot(*np.transpose(ours), color=ORANGE, lw=4, label="the optimum")
left.axhline(1, color="black", lw=1)
left.set(xlim=(H, -1), ylim=(-0.03, 1.5), xlabel="step, from the last to the first")
left.set(ylabel="extra cost / room", title="Few labels live at a time")
left.legend(ncols=3, columnspacing=0.8, handletextpad=0.2)

felt = 0 * A  # as in search
for _, S, closed in riccati(A, B, Q, R, H)[:at]:
    felt = B @ solve(S, B.T) + closed @ felt @ closed.T
for t, (x, q, models), kept in log:
    if t == at and x < room:
        edge = ORANGE if models == tuple(best[t:]) else BLUE if kept else "#777777"
        look = {"edgecolor": edge, "lw": 2, "facecolor": "none" if kept else "#cccccc"}
        centre = -np.linalg.cholesky(felt).T @ q
        right.add_patch(plt.Circle(centre, np.sqrt(room - x), zorder=2 + kept, **look))
right.set(title=f"Step {at}: a disc in a disc may go", xlabel="costate, as earlier steps feel it")
right.axis("equal")
plt.show()

# %% [markdown]
# **In one paragraph.** A backward sweep gives the controller, one formula its sensitivity to wrong
# beliefs, any reference point a bound: expand the last square below. A search from the last step
# fills the room above it; that it missed nothing only a new search can check (notebook 3).
#
# ## The sheet
#
# | symbol | meaning |
# |---|---|
# | $H, W, n, p$ | steps; models; numbers in a state, in a perception input |
# | $A, B, C, Q, R$ | $x_{t+1} = Ax_t + Bu_t + Cs_t$, $J = \sum x^\top Qx + u^\top Ru$ |
# | $P_t, K_t$ | cost-to-go, gain of the controller |
# | $S_t$ | what a wrong command costs: $R + B^\top P_{t+1} B$ |
# | $s, \hat s, e$ | perception input, its estimate, its error $\hat s - s$ |
# | $\mu_{tw}, V_{tw}, \kappa_w$ | mean and covariance of model $w$'s error at step $t$; its price |
#
# **The objective.** A schedule $c$ of mean errors $\mu_c$ has $\mathrm{total}(c) = \mu_c^\top \Psi
# \mu_c + \sum_t \ell_{t,c_t}$, with $\ell_{tw} = \mathrm{tr}(\Psi_{tt} V_{tw}) + \kappa_w$ (weights
# left out). Independence across steps is assumed: means couple steps, variances do not.
#
# **Which pattern is my robot?**
#
# | models give | the controller | pattern | memory $m_t$ | now, foresight |
# |---|---|---|---|---|
# | a forecast, once | never looks again | `open_loop` | $Am_{t-1} + Ce_{t-1}$ | yes, yes |
# | a forecast, once | sees its state | `preview` | 0 | yes, yes |
# | this step's input | sees its state | `causal` | 0 | yes, no |
# | the state | feeds it back | `measurement` | $Ce_t$ | no, no |
# | the state | runs an observer | `filter` | $(I - \Gamma C^+) A m_{t-1} + \Gamma e_t$ | no, no |
#
# Under `causal` and `measurement` steps decouple: take the cheapest model of each. So they do if
# the forecast is made anew at every step (MPC, notebook 1). Otherwise search (`ms.solve`
# takes any $\Psi$).
#
# **One formula.** $e^\top \Psi e = \sum_t w_t^\top S_t^{-1} w_t$ with $w_t = B^\top (P_{t+1}(A
# m_t + C e_t) + q_{t+1})$. The believed state errs by $m_t$ ($C^+$: pseudo-inverse, $\Gamma$: the
# observer's gains). "Now: no" drops $C e_t$. Foresight is $q_t = (A - BK_t)^\top (P_{t+1} C e_t +
# q_{t+1})$ from $q_H = 0$, else all 0. If models measure the state, $C e_t$ is the error of what
# they measure; the rest is known (`measurement`) or estimated (`filter`), and $s$ is an unknown
# push of mean 0.
#
# **The certificate.** For every $d$, with $G_{tw} = 2\mu_{tw}^\top (\Psi d)_t + \ell_{tw}$ and
# $r_{tw} = G_{tw} - \min_v G_{tv}$,
#
# $$\mathrm{total}(c) = \Big[\sum_t \min_w G_{tw} - d^\top \Psi d\Big] + \sum_t r_{t,c_t}
# + (\mu_c - d)^\top \Psi (\mu_c - d).$$
#
# The bracket is a bound. With a schedule at cost $U$ in hand, the room is $\Delta = U - [\cdot]$. A
# model with $r_{tw} > \Delta$ is out. So is label $j$ if some label $i$ has $\rho + \sqrt{\Delta -
# x_j} \le \sqrt{\Delta - x_i}$ ($\rho$: the distance of their costates, as earlier steps feel it).
#
# ## Recall
#
# <details><summary>A bug in `reference` returns a poor d. Which results are wrong?</summary>
#
# None. The bound is lower, the room larger, the search slower.
#
# </details>
# <details><summary>Why does a label keep a costate, and not the errors chosen so far?</summary>
#
# Earlier steps feel those only through $q$: $n$ numbers, whatever $H$.
#
# </details>
# <details><summary>For which patterns is the search superfluous, and why?</summary>
#
# `causal` and `measurement`: no errors of two steps meet, so each step's cheapest model is right.
#
# </details>
#
# ## Exercises
#
# ### Exercise 1: a state that comes late
#
# A robot learns its state one step late: at step $t$ it knows $x_{t-1}$, believes $\hat x_t =
# Ax_{t-1} + Bu_{t-1} + C\hat s_{t-1}$, uses $\hat s_t$, and expects nothing later. ($x_0$ is
# known.) First predict how far apart two steps may be whose errors meet ($\Psi_{tk} \ne 0$); then
# write its row `late` of `PATTERNS`.

# %% tags=["exercise"]
late, furthest = ..., ...  # (memory, told, foresight); the largest |t - k|

# %% tags=["check", "skip-execution"]
assert late is not ... and furthest is not ..., "Exercise 1: set late and furthest"
PATTERNS["late"] = late
found = sensitivity(A, B, C, Q, R, 6, "late")
for e in np.random.default_rng(0).normal(size=(20, 6)):
    x, believed, J = np.zeros(2), np.zeros(2), 0.0
    for t, (P, S, _) in enumerate(riccati(A, B, Q, R, 6)):
        u = -solve(S, B.T @ P @ (A @ believed + C[:, 0] * e[t]))
        believed = A @ x + B @ u + C[:, 0] * e[t]  # of the next state: from x, one step late
        x = A @ x + B @ u
        J += x @ Q @ x + u @ R @ u
    assert np.isclose(e @ found @ e, J), (
        f"Exercise 1: errors {e.round(1)} cost {J:.4f} in a simulation, by your row "
        f"{e @ found @ e:.4f}; is the believed state wrong by this step's e, or by the last?"
    )
met = np.argwhere(abs(found) > 1e-12 * found.max())
assert abs(met @ [1, -1]).max() == furthest, "Exercise 1: other steps meet; print found"
print("Exercise 1: right")

# %% [markdown]
# ### Exercise 2: what a narrow search still proves
#
# A search that keeps `width` labels a step drops some that might have become the optimum. Yet no
# completion of a label costs less than bound plus extra. Write `narrow`: the labels left at step 0,
# and the least extra, within the room, of any that came when its step had kept `width` already
# (infinity if none did). The optimum is at least bound + min(both). Use `search` and its log, in
# which the labels of a step stand from the cheapest to the dearest.


# %% tags=["exercise"]
def narrow(A, B, C, Q, R, mean, d, reduced, room, width):
    """Return the labels left at step 0 and the least extra dropped for lack of width."""
    ...


# %% tags=["check", "skip-execution"]
given = A, B, C, Q, R, mean, d, certificate(Psi, mean, linear, d)[1], room
for width, right in ((1, 0.06345), (3, 0.06434), (10, 0.06552), (np.inf, cost)):
    answer, labels = narrow(*given, width), search(*given, width)[0]
    assert answer is not None and len(answer) == 2, "Exercise 2: return the labels and a number"
    assert [x[2] for x in answer[0]] == [x[2] for x in labels], "Exercise 2: other labels are left"
    proved = bound + min([answer[1]] + [x[0] for x in labels])
    assert np.isclose(proved, right, atol=2e-5), (
        f"Exercise 2: width {width} proves {right:.5f}, by your answer {proved:.5f}"
    )
print("Exercise 2: right")

# %% [markdown]
# ### Exercise 3 (open): make it work hard
#
# The cart, 20 steps: with the models above the search keeps at most some 20 labels a step. Predict
# what makes it keep more: larger errors? closer prices? errors that differ from step to step? Then
# build `hard()`: `mean` and `linear`, up to three models, for which more than 100 labels live at
# some step, and a sentence that says why.


# %% tags=["exercise"]
def hard():
    """Return mean (20, W), linear (20, W) and a sentence that says why this is hard."""
    ...


# %% tags=["check", "skip-execution"]
answer = hard()
assert answer is not None and len(answer) == 3, "Exercise 3: return mean, linear and a sentence"
errors, fees, why = answer
assert np.shape(errors) == np.shape(fees), "Exercise 3: mean and linear have one shape"
assert len(errors) == 20 and len(errors[0]) <= 3, "Exercise 3: 20 steps, at most three models"
story = schedule(A, B, C, Q, R, errors, fees)[-1]
most = max(sum(k for s, _, k in story if s == t) for t in range(20))
assert most > 100, f"Exercise 3: at most {most} labels live at a step"
assert len(why.split()) >= 8, "Exercise 3: explain it in a sentence"
print("Exercise 3: right")
