"""The command line under arguments nobody wrote: it runs, helps, or says in one line what is wrong.

Runs are tiny, in a folder of their own; networks are never trained.
"""

import io
import os
import signal
import subprocess
import sys
import time
import warnings
from contextlib import redirect_stderr, redirect_stdout
from itertools import product
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
    "--cost": ["linear", "counted", "latency", "free"],
    "--seed": [*COUNTS, "123456789012345678901234567890"],
    "--residuals": ["file", "none.csv", "", "a\0b"],
    "--out": ["out", "new/er", "file", "file/below", "", "a\0b", "x" * 300],
    "--json": ["r.json", "new/r.json", "file/r.json", "out", "", "a\0b", "x" * 300],
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
        ("--experiment measured --residuals none.csv", "none.csv: cannot be read as a CSV file"),
        ("--experiment measured --residuals file", "file, line 1: expected the header"),
        ("--experiment measured --cost linear", "cost: measured models cost their latency"),
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


#: No numbers on a command line: empty, words, digits of other scripts, and what only code has.
NO_NUMBERS = ["", " ", "x", "1_0", "\uff11", "\u0663", "1,5", "0x10", "1 2", "None", "2\n3", "--"]
NO_COUNTS = ["-1", "1.5", "nan", "inf", "1e3", "9" * 5000, *NO_NUMBERS]
NO_WEIGHTS = ["-1", "nan", "inf", "1e999", "-1e-300", *NO_NUMBERS]
NO_NAMES = ["", "none", "Published", "trained ", "0", "x\ny"]
NO_PLACES = ["", " ", "file/below", "file/below/it", "/proc/none/it", "a\0b", "new/" + "x" * 300]
BAD = {
    **dict.fromkeys(["--experiment", "--preset", "--information", "--cost", "--fit"], NO_NAMES),
    "--calibrate": ["yes"],
    "--rounds": ["9" * 26, *NO_COUNTS],
    "--horizon": ["0", "9" * 26, *NO_COUNTS],
    "--trials": ["0", "9" * 26, *NO_COUNTS],
    "--seed": NO_COUNTS,
    **dict.fromkeys(["--alpha", "--beta", "--upsilon", "--switch-cost", "--budget"], NO_WEIGHTS),
    "--front": NO_WEIGHTS,
    "--residuals": ["file", *NO_PLACES],  # of an experiment that takes none
    "--out": ["file", *NO_PLACES],
    "--json": [".", "/dev/null", "folder", "new/" + "x" * 252, *NO_PLACES],
    "--no-figures": ["yes"],
    "--quiet": ["yes"],
}


def test_the_table_has_every_option():
    known = {flag for action in landing._parser()._actions for flag in action.option_strings}
    assert set(BAD) == known - {"-h", "--help"}


@pytest.mark.parametrize(
    ("flag", "value"), [case for flag, bad in BAD.items() for case in product([flag], bad)]
)
def test_a_bad_value_is_one_line_and_status_2_before_any_work(flag, value, place, monkeypatch):
    for work in ("learn", "run_experiment"):
        monkeypatch.setattr(landing, work, lambda *_, **__: pytest.fail("it worked"))
    Path("folder").mkdir(exist_ok=True)
    around = written(place), set(place.iterdir())
    status, out, err = run([f"{flag}={value}", *["--quiet"] * (flag != "--quiet")])
    assert (status, out) == (2, "")
    assert err.startswith("landing.py: error: ") and err.endswith("\n") and err.count("\n") == 1
    assert flag[2:] in err.replace("_", "-") and len(err) < 500
    assert (written(place), set(place.iterdir())) == around


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("--horizon=1.5", "--horizon: expected an integer, found '1.5'"),
        ("--alpha=1_0", "--alpha: expected a number, found '1_0'"),
        ("--out= ", "--out: expected a path, found ' '"),
    ],
)
def test_a_slip_is_shown_beside_what_was_expected(argument, words, place):
    assert run([argument]) == (2, "", f"landing.py: error: argument {words}\n")


SWITCHES = ("--no-figures", "--quiet", "--calibrate")


@pytest.mark.parametrize("flag", [flag for flag in BAD if flag not in SWITCHES])
def test_an_option_without_its_value_is_named(flag, place):
    status, out, err = run([flag])
    assert (status, out, err) == (
        2,
        "",
        f"landing.py: error: argument {flag}: expected one argument\n",
    )


@pytest.mark.parametrize("argv", ["--json q --out q", "--json q --out q/r", "--json q --out ./q/"])
def test_one_place_is_not_a_file_and_a_folder(argv, place, monkeypatch):
    monkeypatch.setattr(landing, "run_experiment", lambda *_, **__: pytest.fail("it worked"))
    status, _, err = run([*argv.split(), "--quiet"])
    assert status == 2 and "--json: expected a file in a writable folder, found q: not a" in err


def test_a_seed_may_have_any_number_of_digits(place):
    seed = "12345678901234567890123456"
    argv = ["--horizon", "2", "--trials", "2", "--quiet", "--no-figures", "--json", "seed.json"]
    assert run([*argv, "--seed", seed]) == (0, "", "")
    assert f'"seed": {seed}' in Path("seed.json").read_text()


@pytest.mark.parametrize("stage", ["run_experiment", "report", "write_figures", "summary"])
def test_ctrl_c_ends_with_130_and_one_line(stage, place, monkeypatch, rough_figures):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(landing, stage, interrupt)
    argv = ["--horizon", "2", "--trials", "2", "--out", "stopped", "--json", "stopped/r.json"]
    status, _, err = run(argv)
    assert (status, err) == (130, "landing.py: interrupted\n")
    assert not Path("stopped/r.json").exists()


def test_ctrl_c_while_writing_leaves_the_old_file(place, monkeypatch):
    path, write = Path("results.json"), Path.write_bytes
    path.write_text("old")

    def interrupt(self, content):
        write(self, content[:9])
        raise KeyboardInterrupt

    before = written(place)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", interrupt)
        argv = ["--horizon", "2", "--trials", "2", "--no-figures", "--json", str(path)]
        assert run(argv)[0] == 130
    assert path.read_text() == "old" and written(place) == before


@pytest.mark.unmutated
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_ctrl_c_in_a_shell(tmp_path):
    argv = ["--horizon", "4", "--trials", "100000", "--json", "new/r.json"]  # minutes
    heard = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    script = f"import sys, landing; print('begins', flush=True); sys.exit(landing.main({argv}))"
    root, pipe = str(Path(landing.__file__).parent), subprocess.PIPE
    environment = os.environ | {"PYTHONPATH": root}
    with subprocess.Popen(
        [sys.executable, "-c", f"{heard}; {script}"],  # a job in the background is deaf to it
        cwd=tmp_path,
        env=environment,
        stdout=pipe,
        stderr=pipe,
    ) as child:
        child.stdout.readline()
        time.sleep(0.5)
        child.send_signal(signal.SIGINT)
        out, err = child.communicate(timeout=60)
    assert (child.returncode, out, err) == (130, b"", b"landing.py: interrupted\n")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.unmutated
def test_ctrl_c_while_the_modules_are_imported_leaves_no_traceback(tmp_path):
    (tmp_path / "numpy.py").write_text("print('begins', flush=True); import time; time.sleep(60)")
    environment, pipe = os.environ | {"PYTHONPATH": str(tmp_path)}, subprocess.PIPE
    command = [sys.executable, "-B", landing.__file__]
    with subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe) as child:
        child.stdout.readline()
        child.send_signal(signal.SIGINT)
        out, err = child.communicate(timeout=60)
    assert (child.returncode, out, err) == (130, b"", b"")


def test_a_folder_where_a_figure_should_be_is_found_before_the_work(place, monkeypatch):
    monkeypatch.setattr(landing, "run_experiment", lambda *_, **__: pytest.fail("it worked"))
    (place / "shown" / "psi.png").mkdir(parents=True)
    status, _, err = run(["--out", "shown"])
    assert status == 2 and "found the folder shown/psi.png" in err


@pytest.mark.unmutated
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a full disk of Linux")
def test_a_full_disk_behind_the_output_is_one_line():
    command = [sys.executable, landing.__file__, "--horizon", "4", "--trials", "2", "--no-figures"]
    environment = os.environ | {"PYTHONUNBUFFERED": ""}  # as in most shells
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, env=environment)
    assert done.returncode == 2
    assert done.stderr.startswith(b"landing.py: error: ") and done.stderr.count(b"\n") == 1


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
        "--budget": ["100", "1e14", "1e30"],
        "--seed": ["0", "7", "9" * 18],
        "--cost": ["linear", "latency"],
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


@pytest.mark.filterwarnings("always")
def test_a_warning_is_one_line_too(place, monkeypatch):
    def doubt(*_, **__):
        warnings.warn("rows repeat:\nwere they logged twice?", stacklevel=2)
        raise ValueError("residuals: expected others")

    monkeypatch.setattr(landing, "run_experiment", doubt)
    status, out, err = run(["--no-figures"])
    assert (status, out) == (2, "")
    assert err.splitlines() == [
        "landing.py: warning: rows repeat: were they logged twice?",
        "landing.py: error: residuals: expected others",
    ]
    assert warnings.showwarning.__module__ == "warnings"


def test_help_says_what_every_option_is_for():
    for option in landing._parser()._actions:
        said = (option.help or "").partition("default:")[0]
        assert len(said.split()) >= 1, option.dest


@pytest.fixture
def asked(place, monkeypatch):
    """What the command line asks for, with what; nothing is learned, flown, printed or drawn."""
    chosen = {"experiment": "trained"} | landing.DEFAULTS["trained"]
    result = landing.run_experiment(landing.Settings(**chosen, horizon=2, trials=2))
    made = {"learn": result.trained, "run_experiment": result, "whole_front": (), "fly_stages": {}}
    made |= {"report": "a report", "report_pictures": "on pictures", "report_measured": "on views"}
    made |= {"write_figures": None, "write_percentages": None, "summary": {"a": 1}}
    found = {}

    def stand_in(name):
        def call(*given, **options):
            found[name] = given, options
            return made[name]

        return call

    for name in made:
        monkeypatch.setattr(landing, name, stand_in(name))
    return found


@pytest.mark.parametrize("said", [*product([False, True], repeat=3)])
def test_what_is_asked_for_is_made_and_nothing_else(asked, said, place):
    quiet, bare, json = said
    Path("asked").mkdir(exist_ok=True)  # as learning leaves it
    argv = ["--experiment", "trained", "--front", "9", "--out", "asked"]
    argv += ["--quiet"] * quiet + ["--no-figures"] * bare + ["--json", "asked.json"] * json
    status, out, err = run(argv)
    assert (status, out, err) == (0, "" if quiet else "a report\n\non pictures\n", "")
    made = {"learn", "run_experiment", "whole_front"}
    made |= set() if quiet else {"report", "report_pictures"}
    made |= set() if bare else {"write_figures", "write_percentages"}
    made |= {"summary"} if json else set()
    made |= {"fly_stages"} if json or not (bare and quiet) else set()
    assert set(asked) == made
    assert {o["progress"] for _, o in asked.values() if "progress" in o} == {not quiet}
    assert asked["learn"][0] == (0, Path("asked"))
    assert asked["whole_front"][0][-1] == 9
    assert Path("asked/residuals.csv").exists()
    if not bare:
        assert asked["write_figures"][0][-1] == Path("asked")
        assert asked["write_percentages"][0][-1] == Path("asked/percentages.csv")
    if json:
        assert Path("asked.json").read_text() == '{\n "a": 1\n}'


@pytest.mark.parametrize("quiet", [False, True])
def test_reports_are_those_of_the_experiment(asked, quiet):
    for argv, printed, more in (
        (["--experiment", "measured"], "a report\n\non views\n", {"report_measured"}),
        (["--information", "causal"], "a report\n", set()),
    ):
        asked.clear()
        status, out, _ = run([*argv, "--no-figures", *["--quiet"] * quiet])
        assert (status, out) == (0, "" if quiet else printed)
        assert set(asked) == {"run_experiment"} | (set() if quiet else {"report"} | more)
