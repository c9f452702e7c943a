"""What errors cost a controller, of models that run at every step; whether steps couple."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modelselect_parts.checks import Array, check_class
from modelselect_parts.objects import Record
from modelselect_parts.problem import SelectionProblem
from modelselect_parts.sensitivity import Sensitivity


@dataclass(frozen=True, eq=False)
class ErrorCost(Record):
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
    check_class("problem", problem, "SelectionProblem")
    H, W, _ = problem.mean.shape
    always = np.repeat(np.arange(W)[:, None], H, axis=1)
    with np.errstate(all="ignore"):
        noise = problem.spread.sum(axis=0)
        own = np.einsum("twi,tij,twj->w", problem.mean, problem.blocks, problem.mean)
        variance = problem.variance
        if variance.ndim == 4:
            variance = np.diagonal(variance, axis1=-2, axis2=-1)
        mean_square = (problem.mean**2 + variance).sum(axis=-1).mean(axis=0)
        mu = problem.chosen_mean(always)
        bias = ((mu @ problem.psi) * mu).sum(axis=1)
    if not np.isfinite([mean_square, own, bias]).all():
        raise ValueError("problem: the error cost overflows; rescale psi or the mean errors")
    return ErrorCost(mean_square, own + noise, bias, noise)


def is_separable(problem: SelectionProblem) -> bool:
    """Whether steps meet neither through Psi nor through switching costs or a budget."""
    check_class("problem", problem, "SelectionProblem")
    H, _, p = problem.mean.shape
    felt = (problem.mean != 0).any(axis=1).ravel() & (problem.alpha != 0)
    if isinstance(problem.psi, Sensitivity):
        return problem.form.bare and not (felt.any() and problem.psi.coupled)
    meets = ((problem.psi != 0) & felt[:, None] & felt).reshape(H, p, H, p).any(axis=(1, 3))
    return problem.form.bare and not (meets & ~np.eye(H, dtype=bool)).any()
