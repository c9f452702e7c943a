"""Options of a command line: numbers as people write them, and errors on one line.

Python reads ``1_0`` and digits of other scripts as numbers, and an empty path as the current
folder.  On a command line such a value is a slip, and is refused.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from modelselect_parts.checks import shown

INTERRUPTED = 130  #: exit status after Ctrl-C: 128 and the number of the signal
Number = TypeVar("Number", int, float)


def _as(kind: Callable[[str], Number], expected: str, text: str) -> Number:
    try:
        if not text.isascii() or "_" in text:
            raise ValueError
        return kind(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected {expected}, found {shown(text)}") from None


def whole(text: str) -> int:
    """Return the integer that a `text` of ASCII digits means."""
    return _as(int, "an integer", text)


def real(text: str) -> float:
    """Return the number that a `text` in ASCII means; what it may be is for others to say."""
    return _as(float, "a number", text)


def place(text: str) -> Path:
    """Return the path that a `text` names; an empty one names none."""
    if not text.strip():
        raise argparse.ArgumentTypeError(f"expected a path, found {shown(text)}")
    return Path(text)


class Parser(argparse.ArgumentParser):
    """A parser without usage lines, which ends with status 2 after one line on what is wrong."""

    def add_fields(
        self,
        values: Mapping[str, Any],
        names: Mapping[str, Collection[str]],
        said: Mapping[str, str],
        about: Mapping[str, str],
    ) -> None:
        """Add an option a field, with its default in `values`, as `said` where None says nothing.

        A field of `names` is one of those that are known, one that is False is switched on; what
        each is `about` is its help.
        """
        kinds: dict[type, Callable[[str], Any]] = {int: whole, float: real, type(None): real}
        for name, value in values.items():
            flag, known = f"--{name.replace('_', '-')}", names.get(name)
            if value is False:
                self.add_argument(flag, action="store_true", help=about[name])
                continue
            kind, default = kinds.get(type(value), str), said.get(name, value)
            words = f"{about[name]}; default: {default}"
            self.add_argument(flag, type=kind, choices=known, default=value, help=words)

    def error(self, message: object) -> NoReturn:
        """End with status 2, after the `message` on one line."""
        try:
            sys.stdout.flush()
        except OSError:  # Python would try once more at its end, and complain
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        self.exit(2, f"{self.prog}: error: {' '.join(str(message).split())}\n")

    def interrupted(self) -> int:
        """Say on one line that Ctrl-C ended the work, and return the status to end with."""
        print(f"{self.prog}: interrupted", file=sys.stderr)
        return INTERRUPTED


@contextmanager
def plain_warnings(program: str) -> Iterator[None]:
    """Say each warning on one line, as an error is said, and not where in our code it arose."""

    def show(message: object, *_: Any, **__: Any) -> None:
        print(f"{program}: warning: {' '.join(str(message).split())}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


# ----------------------------------------------------------------------------- the landing's own

#: What the command line says of each option.
ABOUT = {
    "experiment": "whose errors: the paper's formulas, networks that learn from rendered pictures, "
    "or a detector measured on them; the last two have other defaults",
    "preset": "whose aircraft",
    "information": "what the controller knows, and when: see modelselect.PATTERNS",
    "horizon": "steps of a landing",
    "trials": "landings",
    "alpha": "weight of control cost",
    "beta": "weight of perception cost",
    "upsilon": "price of one model up",
    "cost": "prices of models: w * upsilon; counted operations; or milliseconds a picture "
    "(EfficientNet's on an i7-12700H, a detector's own), the dearest as dear beside control cost "
    "as at w * upsilon",
    "seed": "of everything random",
    "switch_cost": "price of changing models, in units of the prices: ms if those are latency",
    "budget": "the most that perception may cost on a landing, switches included, in those units",
    "front": "find all Pareto points (under the budget), or as many as so many seconds prove; say "
    "how many weights alpha : beta reach, and what the best of those costs beside the best",
    "fit": "how errors of networks are pooled along the way",
    "calibrate": "networks report what is expected where they say what they say",
    "rounds": "of 20 landings that networks are labelled on, flown with what is best until then",
    "residuals": "CSV for experiment measured; default: that of a tag detector, "
    "notebooks/data/tags.csv",
    "out": "where figures and percentages.csv go; default: figures",
    "json": "write means, intervals, schedule and settings",
    "no-figures": "write no figures, no percentages",
    "quiet": "print nothing",
}


def of_landings(fields: Mapping[str, Any], names: Mapping[str, Collection[str]]) -> Parser:
    """Make the parser of landing.py: options for `fields`, and for what to read and write."""
    about = "Land an aircraft, choosing perception models."
    parser = Parser("landing.py", usage=argparse.SUPPRESS, description=about)
    parser.add_fields(fields, names, {"upsilon": "as the preset", "budget": "none"}, ABOUT)
    for name, kind, metavar in (
        ("residuals", place, "FILE"),
        ("front", real, "SECONDS"),
        ("out", place, "FOLDER"),
        ("json", place, "FILE"),
    ):
        parser.add_argument(f"--{name}", type=kind, metavar=metavar, help=ABOUT[name])
    parser.set_defaults(out=Path("figures"))
    for name in ("no-figures", "quiet"):
        parser.add_argument(f"--{name}", action="store_true", help=ABOUT[name])
    return parser
