"""The stored instances are what their format says, and nothing is cheaper than their claims."""

from pathlib import Path

import numpy as np
import pytest

import modelselect as ms

pytestmark = pytest.mark.no_cover

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks" / "instances"
FILES = sorted(FOLDER.glob("*.npz"))


def stored(file):
    with np.load(file) as archive:
        given = {name: archive[name] for name in archive.files}
    claims = [given.pop(name) for name in ("choices", "cost", "lower_bound")]
    return ms.SelectionProblem(**given), *claims


def test_there_are_thirty_in_three_megabytes():
    assert len(FILES) >= 30
    assert sum(file.stat().st_size for file in FILES) < 3e6


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_the_stored_schedule_is_feasible_and_costs_what_is_said(file):
    problem, choices, cost, bound = stored(file)
    assert problem.is_feasible(choices)
    assert problem.total_cost(choices) == pytest.approx(cost, rel=1e-12)
    assert 0 <= cost - bound <= 1e-9 * abs(cost)
    assert ms.round_and_swap(problem).root_bound <= cost


@pytest.mark.parametrize("name", ["preview-step-both-30", "loaded-large-30", "maximum-cut-12"])
def test_solve_meets_the_stored_optimum(name):
    problem, _, cost, bound = stored(FOLDER / f"{name}.npz")
    found = ms.solve(problem)
    assert found.is_optimal
    assert found.cost == pytest.approx(cost, rel=2e-9)
    assert found.lower_bound <= cost * (1 + 1e-12) + 1e-12
    assert found.cost >= bound * (1 - 1e-12)
