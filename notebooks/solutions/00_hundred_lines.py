# %% [markdown]
# ## Exercise 1
#
# The believed state is the true one but for $C e_{t-1}$, the error of the last push: `before`.
# $u_t$ also uses $\hat s_t$. So $e_t$ enters $u_t$ and $u_{t+1}$ only, and errors of neighbouring
# steps meet: $\Psi$ has three diagonals. Feedback that is late couples steps without any forecast.

# %%
late, furthest = (lambda z, before, now, gain: before, 1, 0), 1

# %% [markdown]
# ## Exercise 2
#
# What a label has paid, each of its completions pays. Some that came too late may be dominated
# besides; to count them, too, may weaken what is proved, but never makes it wrong.


# %%
def narrow(A, B, C, Q, R, mean, d, reduced, room, width):
    """Return the labels left at step 0 and the least extra dropped for lack of width."""
    alive, log = search(A, B, C, Q, R, mean, d, reduced, room, width)
    least, count = np.inf, np.zeros(len(mean))
    for t, (extra, _, _), kept in log:
        if count[t] == width and extra <= room:
            least = min(least, extra)
        count[t] += kept
    return alive, least


# %% [markdown]
# ## Exercise 3
#
# Free models of both signs. A blend of them errs by 0, so the bound is 0 and nothing is dear: all
# the cost of a schedule is room, and very many partial schedules cost about the same and differ in
# their costates. Prices settle most steps, and so make the search easy. Large errors alone do not
# matter: with prices and variances a hundred times as large, too, errors ten times as large change
# nothing.


# %%
def hard():
    """Return mean (20, W), linear (20, W) and a sentence that says why this is hard."""
    mean = np.tile([0.5, -0.3, 0.1], (20, 1))
    return mean, 0 * mean, "free models of both signs cancel in very many nearly equal ways"
