"""The solvers that ours are compared with solve the same problem, switches and budgets included."""

import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from modelselect import enumerate_schedules

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
KINDS = ["switching", "budget", "both"]


@pytest.fixture
def load(monkeypatch):
    """A module of benchmarks/ by its name; the scripts import each other like this."""
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module


@pytest.mark.parametrize("kind", KINDS)
def test_products_of_binaries_state_switches_and_budgets(load, kind):
    problem = load("families").constrained("preview/step", kind, 0, 4)
    found = load("contenders").linearised(problem, 20.0)
    best = enumerate_schedules(problem)
    assert found.closed
    assert found.bound == pytest.approx(best.cost, rel=1e-7)
    np.testing.assert_array_equal(found.choices, best.choices)


@pytest.mark.parametrize("solver", ["SCIP, one cone", "SCIP, split"])
@pytest.mark.parametrize("kind", KINDS)
def test_flows_state_switches_and_budgets(load, tmp_path, kind, solver):
    pytest.importorskip("pyscipopt", reason="pip install '.[benchmarks]'")
    families, file = load("families"), tmp_path / "problem.npz"
    problem = families.constrained("preview/step", kind, 0, 4)
    np.savez(file, **families.arguments(problem))
    request = {"file": str(file), "solver": solver, "limit": 20, "repeat": 1}
    found = load("measure").run_alone("contenders.py", request, 60)
    best = enumerate_schedules(problem).cost
    assert found["closed"], found["status"]
    assert found["cost"] == pytest.approx(best, rel=1e-5)
    assert found["bound"] == pytest.approx(best, rel=1e-5)


@pytest.mark.unmutated
def test_the_constrained_benchmark_runs_in_small(tmp_path):
    for package in ("pyscipopt", "gurobipy"):
        pytest.importorskip(package, reason="pip install '.[benchmarks]'")
    command = [sys.executable, FOLDER / "peers.py", "--constrained", "both", "--quick"]
    subprocess.run([*command, "--output", tmp_path], check=True, capture_output=True)
    written = (tmp_path / "constrained.md").read_text(encoding="utf-8")
    assert "| both | preview/step |" in written
