r"""A choice held for several steps: another problem of the same kind, with fewer steps.

Where loading a model takes long, or a schedule may change at whole seconds only, a choice holds for
k steps.  A problem of H steps is then one of ceil(H/k) steps with p' = k p components: the errors
of k steps stacked, their prices added, Psi the same.  Where k does not divide H, the last choice
holds for the steps that are left; errors of steps after the end cost nothing.

>>> mean = [[[1], [0]], [[1], [0]], [[1], [0]]]
>>> problem = SelectionProblem(np.ones((3, 3)), mean, np.zeros((3, 2, 1)), [0, 1])
>>> held = hold(problem, 2)
>>> held.total_cost([[0, 0], [0, 1]]), problem.total_cost([[0, 0, 0], [0, 0, 1]])
(array([9., 5.]), array([9., 5.]))
>>> expand_choices([0, 1], 2, 3)
array([0, 0, 1])
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import (
    Array,
    Choices,
    check_array,
    check_choices,
    check_class,
    check_count,
)
from modelselect_parts.problem import SelectionProblem


def hold(problem: SelectionProblem, steps: int) -> SelectionProblem:
    """Return the problem in which every choice holds for k = `steps` steps: ceil(H/k) of them.

    mean (ceil(H/k), W, kp); variances stacked, covariances on the diagonal of (kp, kp); a model is
    available where it is at all k steps.  Weights, switching costs, the first model and the budget
    stay.  Psi of a linear system becomes its matrix.
    """
    check_class("problem", problem, "SelectionProblem")
    H, W, p = problem.mean.shape
    k = check_count("steps", steps)
    N = -(-H // k)
    Psi = np.asarray(problem.psi)
    if N * k > H:
        Psi = np.pad(Psi, (0, (N * k - H) * p))
    price = np.broadcast_to(problem.model_cost, (H, W))
    return replace(
        problem,
        psi=Psi,
        mean=_stacked(problem.mean, k),
        variance=_stacked_variance(problem.variance, k),
        model_cost=_in_groups(price, k).sum(axis=1),
        pull=None if problem.pull is None else _in_groups(problem.pull, k).reshape(N, k * p),
    )


def expand_choices(choices: npt.ArrayLike, steps: int, horizon: int) -> Choices:
    """Return for every step of the `horizon` H the one of `choices` that holds there, (..., H).

    `choices` (..., ceil(H/k)), each for k = `steps` steps: a schedule of the problem of `hold`.
    """
    k, H = check_count("steps", steps), check_count("horizon", horizon)
    c = check_array("choices", choices, "... N", (-(-H // k),))
    return np.repeat(check_choices(c, None, np.iinfo(np.int32).max), k, axis=-1)[..., :H]


def _in_groups(array: Array, k: int) -> Array:
    """Zeros appended to the first axis, of which k at a time become the second: (N, k, ...)."""
    H = len(array)
    padded = np.pad(array, [(0, -H % k)] + [(0, 0)] * (array.ndim - 1))
    return padded.reshape(-1, k, *array.shape[1:])


def _stacked(array: Array, k: int) -> Array:
    """(H, W, p) to (N, W, kp): components of the same choice beside each other, step by step."""
    groups = _in_groups(array, k).swapaxes(1, 2)
    return groups.reshape(*groups.shape[:2], -1)


def _stacked_variance(variance: Array, k: int) -> Array:
    """Variances (N, W, kp), or covariances (N, W, kp, kp) that are zero between steps."""
    if variance.ndim == 3:
        return _stacked(variance, k)
    groups = _in_groups(variance, k)  # (N, k, W, p, p)
    N, _, W, p, _ = groups.shape
    blocks, step = np.zeros((N, W, k, p, k, p)), np.arange(k)
    blocks[:, :, step, :, step, :] = groups.transpose(1, 0, 2, 3, 4)
    return blocks.reshape(N, W, k * p, k * p)
