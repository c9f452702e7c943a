"""What README.md shows: its example runs, its commands exist, its tables are the measured ones."""

import re
from pathlib import Path

import numpy as np
import pytest

import landing
from modelselect_parts.tables import table_of_front

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_example_runs_and_is_certified(capsys):
    first, second, third = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names = {}
    exec(first, names)
    assert names["schedule"].is_optimal
    assert str(names["schedule"].cost) in capsys.readouterr().out
    assert set(np.unique(names["schedule"].choices)) <= {0, 1, 2}
    exec(second, names)
    robot, limited, front = (names[name] for name in ("robot", "limited", "front"))
    assert limited.is_optimal
    assert limited.cost > names["schedule"].cost
    assert robot.perception_term(limited.choices) <= 0.5
    assert len(front) > 2
    assert all(point.is_optimal for point in front)
    exec(third, names)
    assert capsys.readouterr().out.endswith("True\n")


@pytest.mark.unmutated
def test_what_weights_reach_of_the_front_is_what_it_says():
    run = landing.run_experiment(
        landing.Settings("simulated", "textbook", "open_loop", 20, 1, switch_cost=60)
    )
    said = "\n".join(table_of_front(landing.whole_front(run.problem, 300)))
    assert said in README and "--preset textbook --horizon 20 --switch-cost 60" in README


def test_the_commands_are_targets_of_the_makefile():
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    named = re.findall(
        r"\bmake ([a-z-]+)", "".join(re.findall(r"`make[^`]*`|^ +make.*", README, re.MULTILINE))
    )
    assert {"landing", "test", "help"} <= set(named) <= set(targets)


@pytest.mark.parametrize("page", ["README.md", "notebooks/paper.md"])
def test_files_and_pictures_it_links_to_exist(page):
    path = ROOT / page
    links = re.findall(r"\]\(([^)#]+)\)", path.read_text(encoding="utf-8"))
    assert len(links) > 5
    assert not [link for link in links if "://" not in link and not (path.parent / link).exists()]


def test_its_benchmark_rows_are_those_that_the_script_wrote():
    measured = (ROOT / "benchmarks" / "results" / "peers.md").read_text(encoding="utf-8")
    rows = [
        line
        for line in README.splitlines()
        if re.match(r"\| (published|open_loop|preview)/?", line)
    ]
    assert len(rows) == 7
    assert not [row for row in rows if row not in measured.splitlines()]
