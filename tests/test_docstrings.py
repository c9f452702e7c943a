"""Docstrings: complete, as numpydoc reads them, and every example in them runs (see pyproject).

An argument counts as documented where it stands in a Parameters section with a type or a shape,
or where the text of a short docstring names it.  One whose annotation is a class of ours needs
no more words, and neither do a generator and a flag.
"""

import inspect
import re
from doctest import DocTestFinder

import numpy as np
import pytest

import landing
import modelselect as ms
import perception

from strategies import belongs

docscrape = pytest.importorskip("numpydoc.docscrape")

MODULES = (ms, perception, landing)


def public():
    """(name, function or class) of all that the modules define, methods included."""
    for module in MODULES:
        for name, thing in vars(module).items():
            if not belongs(name, thing, module):
                continue
            if inspect.isclass(thing):
                own = {k: v for k, v in vars(thing).items() if k[0] != "_"}
                for k, v in own.items():
                    v = getattr(v, "func", getattr(v, "fget", v))  # properties
                    if inspect.isfunction(v):
                        yield f"{module.__name__}.{name}.{k}", v
            if callable(thing):
                yield f"{module.__name__}.{name}", thing


THINGS = dict(public())
OURS = {name.split(".")[1] for name, thing in THINGS.items() if inspect.isclass(thing)}
documented = pytest.mark.parametrize("name", THINGS)
#: What a caller needs in numpydoc's four parts; all else is said as in a book.
IN_FULL = ("ControlTask", "psi", "SelectionProblem", "solve", "read_residuals")
in_full = pytest.mark.parametrize(
    "name", [name for name in THINGS if name.split(".", 1)[1] in IN_FULL]
)


def sections(name):
    return docscrape.NumpyDocString(inspect.getdoc(THINGS[name]) or "")


def parameters(name):
    """Those that a reader must be told about."""
    thing = THINGS[name]
    if inspect.isclass(thing) and "__post_init__" not in vars(thing):
        return []  # a record: its fields carry comments
    if name == "landing.Settings":
        return []  # likewise
    known = OURS | {"Generator", "Rng", "bool", "Path"}
    return [
        key
        for key, parameter in inspect.signature(thing).parameters.items()
        if key != "self" and not known & set(re.findall(r"\w+", str(parameter.annotation)))
    ]


@documented
def test_opens_with_one_sentence_on_one_line(name):
    text = inspect.getdoc(THINGS[name])
    first, *rest = text.split("\n")
    assert first.rstrip("?`)").endswith((".", "?")) or text.endswith("?") or first.endswith("?")
    assert not rest or rest[0] == ""


@in_full
def test_every_argument_is_documented(name):
    found = sections(name)
    typed = {
        part.strip("* "): entry.type
        for entry in found["Parameters"]
        for part in entry.name.split(",")
    }
    text = inspect.getdoc(THINGS[name])
    missing = [
        key
        for key in parameters(name)
        if not (typed[key] if key in typed else re.search(rf"\b{key}\b", text))
    ]
    assert not missing
    thing = THINGS[name]
    unknown = set(typed) - set(inspect.signature(thing).parameters)
    assert not unknown


@documented
def test_arrays_have_shapes(name):
    for entry in sections(name)["Parameters"]:
        if "array" in entry.type or "ndarray" in entry.type:
            assert re.search(r"\(.*\)|any shape", entry.type), entry.name


@in_full
def test_says_when_it_raises(name):
    thing = THINGS[name]
    body = vars(thing).get("__post_init__") if inspect.isclass(thing) else thing
    if body and "raise ValueError" in inspect.getsource(body):
        assert "ValueError" in inspect.getdoc(thing)


@in_full
def test_says_what_it_returns(name):
    thing = THINGS[name]
    if inspect.isclass(thing) or inspect.signature(thing).return_annotation in (None, "None"):
        return
    text = inspect.getdoc(thing)
    told = sections(name)["Returns"] or re.search(r"\b[Rr]eturn|\([^)]*\b[HWNnpm]\b[^)]*\)", text)
    scalar = {"float", "int", "bool", "str", "Figure"} & set(
        re.findall(r"\w+", str(inspect.signature(thing).return_annotation))
    )
    ours = OURS & set(re.findall(r"\w+", str(inspect.signature(thing).return_annotation)))
    assert told or scalar or ours


@pytest.mark.parametrize("name", [name for name in THINGS if name.startswith("modelselect.")])
def test_arrays_among_fields_have_shapes(name):
    thing = THINGS[name]
    if inspect.isclass(thing) and hasattr(thing, "_fields"):
        source = inspect.getsource(thing)
        for line in re.findall(r"^    \w+: Array.*$", source, re.M):
            assert re.search(r"#: \(.*\)", line), line


EXAMPLES = ["psi", "ControlTask", "SelectionProblem", "solve"]


@pytest.mark.parametrize("name", EXAMPLES)
def test_main_functions_show_an_example(name):
    thing = getattr(ms, name)
    tests = DocTestFinder(recurse=False).find(thing, globs={"np": np})
    assert tests and tests[0].examples, name
