"""What README.md and benchmarks/README.md show: code runs, commands exist, numbers are measured."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest

import landing
from modelselect_parts.flights import estimate
from modelselect_parts.tables import table_of_front

pytestmark = pytest.mark.no_cover

ROOT = Path(__file__).resolve().parents[1]
README, MEASURED = (
    (ROOT / page).read_text(encoding="utf-8") for page in ("README.md", "benchmarks/README.md")
)
PEERS, CONSTRAINED, SCALING, DETECTORS = (
    (ROOT / "benchmarks" / "results" / f"{page}.md").read_text(encoding="utf-8")
    for page in ("peers", "constrained", "scaling", "detectors")
)


def rows(text, head):
    """Cells of the table with this head, which is there once."""
    [table] = re.findall(
        rf"^\| {re.escape(head)} \|.*\n\|[-| :]+\|\n((?:\|.*\n)+)", text, re.MULTILINE
    )
    return [
        [cell.strip() for cell in re.split(r" \| ", line.strip("| "))]
        for line in table.splitlines()
    ]


def numbers(text):
    """All numbers in a text, without their signs of operation."""
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", text)]


def passage(start):
    """The paragraph of README that starts with these words, on one line."""
    [found] = re.findall(rf"^{re.escape(start)}.*?(?=\n\n)", README, re.MULTILINE | re.DOTALL)
    return found.replace("\n", " ")


# -------------------------------------------------------------------------------------- its code


def test_it_is_read_in_a_minute():
    assert len(README.splitlines()) <= 160


def the_example():
    """Run the only block of Python; returns the names that it leaves."""
    [example] = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(example.splitlines()) == 10
    names = {}
    exec(example, names)
    return names


def test_the_example_runs_and_is_certified(capsys):
    names = the_example()
    assert names["schedule"].is_optimal
    assert str(names["schedule"].cost) in capsys.readouterr().out
    assert set(np.unique(names["schedule"].choices)) <= {0, 1, 2}


def beyond(what, names):
    """Run the lines of a row of what is beyond the paper; returns the value of the last one."""
    [lines] = [re.findall(r"`([^`]+)`", how) for said, how in BEYOND if said == what]
    assert 1 <= len(lines) <= 3
    for line in lines[:-1]:
        exec(line, names)
    assigned = re.sub(r"^\w+ = ", "", lines[-1])
    return eval(assigned, names)


BEYOND = rows(README, "what")


@pytest.mark.parametrize("what", [what for what, _ in BEYOND])
def test_what_is_beyond_the_paper_takes_three_lines_after_the_example(what, tmp_path, monkeypatch):
    names = the_example()
    for imported in re.findall(r"`((?:from|import) [^`]+)`", passage("After the ten lines")):
        exec(imported, names)
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    looks = [f"{w},{z},{rng.normal()}" for z in range(41) for w in "abc" for _ in range(2)]
    Path("mine.csv").write_text("\n".join(["model,altitude,residual", *looks]))
    assert beyond(what, names) is not None


def test_rows_with_limits_keep_them_and_cost_more(capsys):
    names = the_example()
    exec("from dataclasses import replace\nimport modelselect as ms, perception as pc", names)
    best, problem = names["schedule"], names["problem"]
    loaded = beyond("switching costs, a model in memory", names)
    assert loaded.is_optimal and loaded.cost > best.cost
    assert beyond("a hard budget, what a little more saves a unit", names) > 0
    limited = names["solve"](names["replace"](problem, budget=0.5))
    assert limited.is_optimal and problem.perception_term(limited.choices) <= 0.5
    front = beyond("all Pareto points, each proved", names)
    assert len(front) > 2 and all(point.is_optimal for point in front)
    assert beyond("a choice held for 5 steps", names).shape == best.choices.shape
    back = beyond("on board: problems, schedules as JSON", names)
    np.testing.assert_array_equal(back.psi, problem.psi)


def test_the_proof_is_named_as_it_says():
    assert the_example()["schedule"].proof in ("root", "search")
    assert '`schedule.proof` is `"search"`' in README


# ---------------------------------------------------------------------- its commands and links


@pytest.mark.parametrize("text", [README, MEASURED], ids=["README.md", "benchmarks/README.md"])
def test_the_commands_are_targets_of_the_makefile(text):
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    named = re.findall(
        r"\bmake ([a-z-]+)", "".join(re.findall(r"`make[^`]*`|^ +make.*", text, re.MULTILINE))
    )
    assert named and set(named) <= set(targets)
    assert text is MEASURED or {"landing", "test", "help"} <= set(named)


@pytest.mark.parametrize("text", [README, MEASURED], ids=["README.md", "benchmarks/README.md"])
def test_the_landings_that_it_names_are_ones_that_can_be_asked_for(text, capsys):
    commands = re.findall(r'make landing ARGS="([^"]*)"', text)
    assert commands
    for command in commands:
        with pytest.raises(SystemExit) as ended:
            landing.main([*command.split(), "--help"])
        assert ended.value.code == 0, command
        known = capsys.readouterr().out
        assert not [option for option in re.findall(r"--[a-z-]+", command) if option not in known]


@pytest.mark.parametrize("page", ["README.md", "benchmarks/README.md", "notebooks/paper.md"])
def test_files_pictures_and_headings_it_links_to_exist(page):
    path = ROOT / page
    links = re.findall(r"\]\(([^)#]*)#?([^)]*)\)", path.read_text(encoding="utf-8"))
    assert len(links) > 5
    for name, heading in links:
        if "://" in name:
            continue
        found = path.parent / name if name else path
        assert found.exists(), name
        if heading:
            titles = re.findall(r"^#+ (.*)", found.read_text(encoding="utf-8"), re.MULTILINE)
            anchors = [re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles]
            assert heading in anchors, f"{name}#{heading}"


def test_every_script_that_measures_is_named_with_its_page():
    named = {
        script.split()[0]
        for _, cell, _ in rows(MEASURED, "question")
        for script in re.findall(r"`([^`]+)`", cell)
    }
    pages = {path.name for path in (ROOT / "benchmarks" / "results").glob("*.md")}
    assert all((ROOT / "benchmarks" / script).is_file() for script in named)
    assert pages == set(re.findall(r"results/(\w+\.md)\) \|", MEASURED))


# -------------------------------------------------------------------------------------- numbers


@pytest.mark.unmutated
def test_what_weights_reach_of_the_front_is_what_it_says():
    run = landing.run_experiment(
        landing.Settings("simulated", "textbook", "open_loop", 20, 1, switch_cost=60)
    )
    said = "\n".join(table_of_front(landing.whole_front(run.problem, 300)))
    assert said in MEASURED and "--preset textbook --horizon 20 --switch-cost 60" in MEASURED


def test_its_table_of_policies_is_an_extract_of_the_report():
    # test_landing.py compares the report itself with a run.
    shown = rows(README, "policy")
    [report] = re.findall(r"```text\nMeans.*?\n(.*?)\nOracle \(", MEASURED, re.DOTALL)
    assert len(shown) == len(re.findall(r"^[A-Z]", report, re.MULTILINE)) == 8
    for policy, *cells in shown:
        name = re.match(r"\**([A-Z][a-z]+(?: [A-Z][a-z]+)?)", policy)[1]
        [line] = re.findall(rf"^{name} .*\d$", report, re.MULTILINE)
        assert line.removeprefix(name).split() == " ".join(cells).split()
    cost = {policy: numbers(f"{cells}") for policy, *cells in shown}
    optimal, random = cost["**Optimal**, proved in 0.02 s"], cost["Random"]
    less, paid = 100 * (1 - optimal[0] / random[0]), 100 * (1 - optimal[2] / random[2])
    assert f"{less:.1f}% less control cost" in README and f"{paid:.1f}% less perception" in README


def test_its_claims_on_solvers_are_those_of_the_measurements():
    families = rows(PEERS, "family | ours, s")
    faster = [(int(numbers(row[3])[0]), ">=" in row[3]) for row in families]
    closed = [times for times, cut in faster if not cut]
    at_least = min(times for times, cut in faster if cut)
    instances = sum(int(row[4].split(" of ")[1]) for row in families)
    assert all(row[4].split(" of ")[0] == row[4].split(" of ")[1] for row in families)
    [longest] = re.findall(r"no run over 0\.6 s \| ([\d.]+) s \| yes", PEERS)
    limited = rows(CONSTRAINED, "kind | family | ours, s")
    both = max(max(numbers(row[2])) for row in limited if row[0] == "both")
    lasting = rows(SCALING, "family | H")
    long = max(float(row[7]) for row in lasting if row[0].startswith("long") and row[1] == "10000")
    assert (
        f"all {instances} instances are proved, in {longest} s at most; by family the median "
        f"is {min(closed)} to {max(closed)} times faster than SCIP's on the five families that it "
        f"closes in 60 s, at least {at_least} times on two. Switching costs and a budget "
        f"together take {np.ceil(both):.0f} s at most, H = 10,000 up to {np.ceil(long):.0f} s"
    ) in passage("**The solvers**")
    assert len(closed) == 5


def test_its_claims_on_the_detector_are_those_of_the_measurements():
    said = passage("**A real detector")
    lead, decided = {}, []
    for pattern, _, _, flown, *_ in rows(DETECTORS, "pattern"):
        decided.append(numbers(flown)[0] > numbers(flown)[1])
        assert decided[-1] == ("undecided" not in flown)
        lead.setdefault(pattern, []).append(numbers(flown)[0])
    assert f"{sum(decided)} of {len(decided)} intervals are above 0" in said
    for pattern, found in lead.items():
        low, high = re.findall(rf"([\d.]+) to\s+([\d.]+)% under `{pattern}`", said)[0]
        for number, end in ((low, min(found)), (high, max(found))):
            assert abs(float(number) - end) <= 0.5, pattern


def test_what_experiment_2_came_to_is_in_its_results():
    with open(ROOT / "benchmarks" / "results" / "stages.csv", newline="") as file:
        table = list(csv.DictReader(file))

    def over_seeds(stage, name, unit=1.0):
        values = [unit * float(row[name]) for row in table if row["stage"] == stage]
        return estimate(np.array(values))[0].tolist()

    text = passage("**Experiment 2, rebuilt**")
    decided = []
    for stage in ("bins", "kernel", "calibrated", "on-policy", "filter"):
        mean, half = over_seeds(stage, "below Best Single", 100)
        assert f"{mean:.1f} ± {half:.1f}%" in text
        decided.append(abs(mean) > half)
    assert decided == [False, True, True, False, False]
    for stage in ("bins", "on-policy"):
        mean, half = over_seeds(stage, "flown/promised")
        assert f"{mean:.2f} ± {half:.2f}" in text
    first, last, filtered = (over_seeds(k, "total")[0] for k in ("bins", "on-policy", "filter"))
    assert f"{100 * (1 - last / first):.0f}% below that of bins" in text
    assert 7 < last / filtered < 8 and "seven times lower" in text
