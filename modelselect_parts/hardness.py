r"""Model selection is NP-hard: PARTITION and MAXIMUM CUT, turned into tasks and suites.

The paper's remark leaves its complexity open.  PARTITION settles it, weakly, with one state;
MAXIMUM CUT strongly, with as many states as the graph has nodes.  Each docstring is the proof.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from modelselect_parts.checks import Array, as_numbers, check_array, check_count, check_name
from modelselect_parts.problem import SelectionProblem
from modelselect_parts.regulator import PATTERNS, ControlTask, psi


def partition_problem(integers: Sequence[int], information: str = "open_loop") -> SelectionProblem:
    """Turn PARTITION of positive `integers` into model selection: the paper's open question.

    One integrator x_{t+1} = x_t + B_t u_t + s_t with B_0 = 1 and then 0, R = 1, Q = 0, Q_final = 1
    has Psi = 11'/2, for every pattern that foresees.  Let model 0 err by +a_t and model 1 by -a_t
    at step t.  A schedule costs (sum_t +-a_t)^2 / 2 plus less than 1/4 for perception, so the
    optimum is below 1/2 exactly if the integers split into two halves of equal sum: model
    selection is NP-hard (Karp 1972), weakly: with offsets so few, `dynamic_program` is
    pseudo-polynomial here.  The sum is at most 1e7, so that its square has its digits in a float.
    """
    check_array("integers", integers, "H", (None,))
    a = [check_count("integers", value) for value in as_numbers("integers", integers)]
    H = len(a)
    if sum(a) > 1e7:
        raise ValueError(f"integers: expected a sum of at most 1e7, found {sum(a)}")
    one, B = np.ones((1, 1)), np.zeros((H, 1, 1))
    B[0] = 1
    task = ControlTask(one, B, one, 0 * one, one, H, Q_final=one)
    mean = np.stack([a, np.negative(a)], axis=1)[:, :, None]
    return SelectionProblem(
        _foreseen_psi(task, information), mean, 0 * mean, np.array([0, 1 / (8 * H)])
    )


def maximum_cut_problem(
    adjacency: npt.ArrayLike, information: str = "open_loop"
) -> SelectionProblem:
    """Turn MAXIMUM CUT of a graph on H nodes, `adjacency` (H, H) of 0 and 1, into model selection.

    So model selection is strongly NP-hard where the state dimension may grow (of a graph without
    weights, Garey, Johnson and Stockmeyer 1976).  Proof.
    Let L be the graph's Laplacian, D = 2H I - L; the eigenvalues of L are at most H, so D >= H I.
    Take n = H states that shift by one place a step, s_t entering at the first; so x_H holds s_t
    in place H-1-t.  Let the control act at t = 0 only, on every place, with R = I; let Q = 0 and
    let Q_final weigh these places by H D.  Then x_H = u + s up to order, and

        Psi = H D (I + H D)^{-1} H D = H D - I + (I + H D)^{-1}.

    With two free models that err by -1 and +1, a schedule is e in {-1, 1}^H: a side for each
    node.  As e'L e = 4 cut(e) and e'e = H,

        e'Psi e = H (2 H^2 - 4 cut(e)) - H + e'(I + H D)^{-1} e,

    whose last term lies in (0, 1/2), while one more edge in the cut is worth 4H >= 4: the cheapest
    schedule is a maximum cut, and no number is larger than a polynomial in H.
    """
    graph = as_numbers("adjacency", adjacency)
    size = 2 * (graph.shape[-1:] or (None,))
    graph = check_array("adjacency", graph, "H H", size)
    if not np.isin(graph, (0, 1)).all() or graph.diagonal().any() or (graph != graph.T).any():
        raise ValueError(
            "adjacency: expected a symmetric matrix of 0 and 1 without loops, found others"
        )
    H = len(graph)
    D = 2 * H * np.eye(H) - (np.diag(graph.sum(axis=0)) - graph)
    B = np.zeros((H, H, H))
    B[0] = np.eye(H)
    shift, entry = np.roll(np.eye(H), 1, axis=0), np.eye(H)[:, :1]
    Q_final = H * D[::-1, ::-1]
    task = ControlTask(shift, B, entry, np.zeros((H, H)), np.eye(H), H, Q_final=Q_final)
    mean = np.tile([[-1.0], [1.0]], (H, 1, 1))
    return SelectionProblem(_foreseen_psi(task, information), mean, 0 * mean, np.zeros(2))


def _foreseen_psi(task: ControlTask, information: str) -> Array:
    """Psi of a pattern with foresight; under the others steps decouple, and nothing is hard."""
    foreseeing = [name for name, row in PATTERNS.items() if row.foresight]
    check_name("information", information, foreseeing)
    return psi(task, information)
