"""The command line under arguments nobody wrote: it runs, helps, or says in one line what is wrong.

Runs are tiny, in a folder of their own; networks are never trained.
"""

import io
import os
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import landing
from perception import train_models

TINY = {"training": 33, "held_out": 300, "epochs": 1, "architecture": [(8, 1, 2), (9, 1, 2)]}
#: Text that names no folder outside: without dots and slashes.
TEXT = st.text(st.characters(exclude_characters="./\\", codec="utf-8"), max_size=8)
COUNTS = ["1", "2", "4", " 3", "0", "-1", "1.5", "nan", "1e3", "1_0", "9" * 30, "9" * 400]
WEIGHTS = ["0", "0.5", "1", "1e-300", "1e300", "1e308", "-0.0", "-1", "nan", "inf", "1e999"]
POOLS = {
    "--experiment": ["simulated", "trained", "Simulated"],
    "--preset": ["published", "textbook", "moon"],
    "--information": ["open_loop", "preview", "causal", "measurement", "none"],
    "--horizon": COUNTS,
    "--trials": COUNTS,
    "--alpha": WEIGHTS,
    "--beta": WEIGHTS,
    "--upsilon": [*WEIGHTS, "1e14", "None"],
    "--switch-cost": WEIGHTS,
    "--budget": [*WEIGHTS, "1e14", "none"],
    "--front": ["0", "0.1", "-1", "nan", "inf", "all"],
    "--cost": ["linear", "counted", "free"],
    "--seed": [*COUNTS, "123456789012345678901234567890"],
    "--out": ["out", "new/er", "file", "file/below", "", "a\0b", "x" * 300],
    "--json": ["r.json", "new/r.json", "file", "out", "", "a\0b", "x" * 300],
}


@st.composite
def options(draw):
    """A list of arguments: most have a meaning, some values are bad, a few things are lost."""
    argv = []
    for flag in draw(st.lists(st.sampled_from(sorted(POOLS)), max_size=5)):
        value = draw(st.sampled_from(POOLS[flag]) | TEXT)
        argv += draw(st.sampled_from([[flag, value], [f"{flag}={value}"]] * 4 + [[flag], [value]]))
    argv += draw(
        st.lists(st.sampled_from(["--quiet", "-h", "--help", "--", "-", "--ho"]), max_size=1)
    )
    return [*argv, "--no-figures"]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    trained = train_models(np.random.default_rng(0), **TINY)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("folder"))
        patch.setattr(landing, "learn", lambda *_, **__: trained)
        Path("file").write_text("kept")
        yield Path.cwd()


def run(argv):
    """Exit status, standard output and standard error."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            status = landing.main(argv)
        except SystemExit as ended:
            status = ended.code
    return status, out.getvalue(), err.getvalue()


def written(place):
    return {str(path.relative_to(place)) for path in place.rglob("*") if path.is_file()}


@given(options())
def test_any_arguments_run_or_help_or_end_in_one_line(place, argv):
    around = set(os.listdir(place.parent))
    small = ["--horizon", "2", "--trials", "2", "--quiet"]  # unless said otherwise, and later
    status, out, err = run([*small, *argv])
    assert status in (0, 2)
    if status == 2:
        assert err.startswith("landing.py: error: ") and err.endswith("\n") and err.count("\n") == 1
        assert "Traceback" not in err and len(err) < 1000
        assert out == ""
    else:
        assert err == ""
        assert ("usage" in out or "--horizon" in out) if {"-h", "--help"} & set(argv) else out == ""
    assert Path("file").read_text() == "kept"
    assert set(os.listdir(place.parent)) == around
    assert not [name for name in written(place) if name.endswith(".part")]


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ("--seed -1", "seed: expected an integer >= 0"),
        ("--upsilon 1e308", "overflow"),
        ("--alpha 1e308", "overflow"),
        ("--beta 1e300 --upsilon 1e14", "overflow"),
        ("--preset published --experiment trained", "preset: the cameras need"),
        ("--switch-cost 1e308", "overflow"),
        ("--switch-cost 1e308 --budget 1", "overflow"),
        ("--experiment trained --budget 0", "budget: expected one of at least"),
        ("--cost counted", "cost: simulated models have linear cost"),
    ],
)
def test_what_cannot_be_is_named(place, argv, words):
    status, out, err = run([*argv.split(), "--no-figures", "--quiet"])
    assert (status, out) == (2, "")
    assert words in err and err.count("\n") == 1


def test_a_large_seed_is_kept_to_the_last_digit(place):
    argv = ["--horizon", "2", "--trials", "2", "--quiet", "--no-figures", "--json", "seed.json"]
    assert run([*argv, "--seed", "9007199254740993"]) == (0, "", "")
    assert '"seed": 9007199254740993' in Path("seed.json").read_text()


@given(st.data())
def test_good_arguments_run(place, data):
    good = {
        "--preset": ["published", "textbook"],
        "--information": ["open_loop", "preview", "causal", "measurement"],
        "--horizon": ["1", "2", "5"],
        "--trials": ["1", "3"],
        "--alpha": ["0", "0.5", "1e-300"],
        "--beta": ["0", "0.5", "1e-300"],
        "--upsilon": ["0", "1", "1e14"],
        "--switch-cost": ["0", "1", "1e14"],
        "--budget": ["0", "1", "1e14", "1e30"],
        "--seed": ["0", "7", "9" * 18],
    }
    flags = data.draw(st.sets(st.sampled_from(sorted(good))))
    argv = [word for flag in flags for word in (flag, data.draw(st.sampled_from(good[flag])))]
    small = ["--horizon", "2", "--trials", "2", "--no-figures"]
    status, out, err = run([*small, *argv])
    assert (status, err) == (0, "") and "Clairvoyant" in out


def test_networks_that_are_not_given_are_learned(place):
    chosen = {"experiment": "trained"} | landing.DEFAULTS["trained"]
    result = landing.run_experiment(landing.Settings(**chosen, horizon=2, trials=2))
    assert result.trained is landing.learn(0)
