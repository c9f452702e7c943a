"""The solvers that ours are compared with solve the same problem, switches and budgets included."""

import importlib
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from modelselect import correlated_cost, enumerate_schedules

pytestmark = pytest.mark.no_cover

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


@pytest.mark.unmutated
def test_the_benchmark_of_growth_proves_every_point_in_small(tmp_path):
    command = [sys.executable, FOLDER / "scaling.py", "--quick", "--output", tmp_path]
    subprocess.run(command, check=True, capture_output=True)
    written = (tmp_path / "scaling.md").read_text(encoding="utf-8")
    [(proved, points)] = re.findall(r"\| every point proved \| (\d+) of (\d+) \| yes \|", written)
    assert proved == points and int(points) > 5
    assert (tmp_path / "scaling.png").exists() and (tmp_path / "long.png").exists()


@pytest.mark.parametrize("script", ["missing.py", "scaling.py"])
def test_a_script_that_takes_no_such_request_is_a_mistake_and_no_row(load, script):
    with pytest.raises(RuntimeError, match=r"No such file|unrecognized arguments"):
        load("measure").run_alone(script, {"H": 1}, 60)


@pytest.mark.unmutated
def test_the_benchmark_of_correlated_errors_runs_in_small(tmp_path):
    for package in ("pyscipopt", "gurobipy"):  # whose versions it names
        pytest.importorskip(package, reason="pip install '.[benchmarks]'")
    command = [sys.executable, FOLDER / "correlated.py", "--quick", "--output", tmp_path]
    subprocess.run(command, check=True, capture_output=True)
    written = (tmp_path / "correlated.md").read_text(encoding="utf-8")
    assert "| persistent | 12, 2 |" in written and "| AR(1) | 12, 2 |" in written


@pytest.mark.parametrize("kind", ["persistent", "AR(1)"])
def test_the_instances_of_correlated_errors_are_solved(load, kind):
    correlated = load("correlated")
    row = correlated.run(kind, 1, 8, 2, 20.0)
    problem, Cov = correlated.instance(kind, 1, 8, 2)
    schedules = np.array(np.meshgrid(*[[0, 1]] * 8)).reshape(8, -1).T
    assert row["proved"]
    assert row["cost"] == pytest.approx(correlated_cost(problem, schedules, Cov).min(), rel=1e-9)


@pytest.mark.unmutated
def test_the_benchmark_of_planning_anew_runs_in_small(tmp_path):
    for package in ("pyscipopt", "gurobipy"):  # whose versions it names
        pytest.importorskip(package, reason="pip install '.[benchmarks]'")
    command = [sys.executable, FOLDER / "receding.py", "--quick", "--output", tmp_path]
    subprocess.run(command, check=True, capture_output=True)
    assert "| 2 | yes | mixed | 8 |" in (tmp_path / "receding.md").read_text(encoding="utf-8")


def test_the_benchmark_of_a_detector_runs_in_small(tmp_path):
    command = [sys.executable, FOLDER / "detectors.py", "--quick", "--output", tmp_path]
    subprocess.run(command, check=True, capture_output=True, timeout=100)
    written = (tmp_path / "detectors.md").read_text(encoding="utf-8")
    for pattern in ("filter", "preview", "measurement", "open_loop"):
        assert f"| {pattern} | 1 | " in written
    assert (tmp_path / "detectors.csv").exists() and (tmp_path / "detectors.png").exists()
