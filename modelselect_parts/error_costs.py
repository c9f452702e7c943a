r"""What errors cost a controller: of models that run at every step, and correlated over time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import (
    Array,
    as_numbers,
    check_array,
    check_choices,
    check_semidefinite,
)
from modelselect_parts.problem import SelectionProblem


@dataclass(frozen=True, eq=False)
class ErrorCost:
    """What each model would cost the controller if it ran at every step (see `error_cost`)."""

    mean_square: Array  #: (W,), mean squared error per step: what model cards print
    uncoupled: Array  #: (W,), sum_t trace(Psi_tt E[e_t e_t']): what follows from squared errors
    bias: Array  #: (W,), mu'Psi mu
    noise: Array  #: (W,), sum_t trace(Psi_tt Sigma_t)


def error_cost(problem: SelectionProblem) -> ErrorCost:
    """Split the control cost of each model into bias and noise, beside its mean squared error.

    Noise costs what its square says: ``noise`` is part of ``uncoupled``.  A bias also meets
    itself at other steps, through the blocks Psi_tk: it costs more than its square where the
    products add up and less where they cancel, so two models of equal squared error can differ
    either way.  bias + noise is the control term, unweighted and without a pull; uncoupled alone
    is what greedy selection sees.
    """
    H, W, _ = problem.mean.shape
    always = np.repeat(np.arange(W)[:, None], H, axis=1)
    noise = problem.spread.sum(axis=0)
    own = np.einsum("twi,tij,twj->w", problem.mean, problem.blocks, problem.mean)
    variance = problem.variance
    if variance.ndim == 4:
        variance = np.diagonal(variance, axis1=-2, axis2=-1)
    mean_square = (problem.mean**2 + variance).sum(axis=-1).mean(axis=0)
    mu = problem.chosen_mean(always)
    return ErrorCost(mean_square, own + noise, ((mu @ problem.psi) * mu).sum(axis=1), noise)


def correlated_cost(
    problem: SelectionProblem,
    choices: npt.ArrayLike,
    covariance: Callable[[int, int, int, int], npt.ArrayLike],
) -> float:
    """Return the exact expected total cost of `choices` (H,) whose errors correlate over time.

    alpha (mu_c'Psi mu_c + sum_{t,k} sum(Psi_tk * Cov[e_t, e_k]) + g'mu_c) + beta perception_term,
    an extension of ``eq:expTmp1``, whose assumption of independence keeps the terms t = k only.
    covariance(t, w, k, v), (p, p) or a number where p = 1, is that of model w's error at step t
    with model v's at step k, in the place of `problem.variance`.
    """
    H, W, p = problem.mean.shape
    c = check_choices(choices, H, W)

    def block(t: int, k: int) -> Array:
        found = as_numbers("covariance", covariance(t, int(c[t]), k, int(c[k])))
        found = found.reshape(1, 1) if p == 1 and found.ndim == 0 else found
        return check_array("covariance", found, "p p", (p, p))

    joint = np.block([[block(t, k) for k in range(H)] for t in range(H)])
    check_semidefinite("covariance", joint)
    mu = problem.chosen_mean(c)
    control = mu @ problem.psi @ mu + (problem.psi * joint).sum()
    control += 0.0 if problem.pull is None else problem.pull.ravel() @ mu
    return float(problem.alpha * control + problem.beta * problem.perception_term(c))
