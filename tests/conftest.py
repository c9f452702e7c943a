"""Hypothesis profiles, and a clock for searches; HYPOTHESIS_PROFILE chooses one, `dev` by default.

dev       a few new examples in every run; a failure is kept and replayed, and prints its blob
ci        more examples, the same ones every time
mutation  few examples, the same ones every time: each of the many mutants gets the same tests
"""

import os
import signal
import sys

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: see the Makefile
os.environ.setdefault("MPLBACKEND", "Agg")  # figures are drawn without a screen

import pytest
from hypothesis import HealthCheck, settings

import modelselect as ms
from modelselect_parts import figures, passes

# Times are no verdict on a shared machine: no deadline, and slow generation is no failure.
settings.register_profile(
    "dev",
    settings.get_profile("default"),
    deadline=None,
    max_examples=20,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile(
    "ci", settings.get_profile("dev"), max_examples=100, derandomize=True, database=None
)
settings.register_profile("mutation", settings.get_profile("ci"), max_examples=10)
PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "dev")
settings.load_profile(PROFILE)

if PROFILE == "mutation":

    def too_long(signum, frame):
        raise TimeoutError("a test runs for half a minute")

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call():
        """Fail a test that takes far too long: a mutant that loops for ever is found out soon."""
        signal.signal(signal.SIGPROF, too_long)
        signal.setitimer(signal.ITIMER_PROF, 30)  # of our own time, however busy the machine
        try:
            return (yield)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)

else:

    @pytest.hookimpl(wrapper=True, trylast=True)  # inside what pytest-cov does
    def pytest_runtest_call(item):
        """Trace nothing under the mark no_cover: in a worker of xdist, pytest-cov traces on."""
        tracer = sys.gettrace()
        if item.get_closest_marker("no_cover"):
            sys.settrace(None)
        try:
            return (yield)
        finally:
            sys.settrace(tracer)


@pytest.fixture
def rough_figures(monkeypatch):
    """Save figures without a layout and in few pixels, where all else but them is looked at."""
    monkeypatch.setitem(figures.STYLE, "figure.constrained_layout.use", False)
    monkeypatch.setitem(figures.STYLE, "figure.dpi", 20)


@pytest.fixture
def ten_seconds_a_pass(monkeypatch):
    """Let a pass of the search take ten seconds of a clock that else stands still; return it."""
    now, step = [0.0], passes.Search.step

    def slow(search, width):
        now[0] += 10
        return step(search, width)

    monkeypatch.setattr(passes.Search, "step", slow)
    monkeypatch.setattr(ms, "perf_counter", lambda: now[0])
    return now
