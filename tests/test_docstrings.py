"""Docstrings: one sentence, every argument named, and every example in them runs (see pyproject).

An argument is named where the text mentions it, one or many of them, or a comment `#:` stands
beside it among the fields of a class.  One whose annotation is a class of ours needs no more
words, and neither do a generator, a path and a flag.  What all checkers share stands at the top of
checks.py.  A few names that every user meets have the four parts of numpydoc.
"""

import inspect
import re
from doctest import DocTestFinder

import pytest

import landing
import modelselect as ms
import perception
from modelselect_parts import checks

from strategies import belongs

pytestmark = pytest.mark.no_cover

docscrape = pytest.importorskip("numpydoc.docscrape")

MODULES = (ms, perception, landing)
#: These have Parameters, Returns and Raises.
FORMAL = [
    *("modelselect.ControlTask", "modelselect.psi", "modelselect.SelectionProblem"),
    *("modelselect.solve", "perception.read_residuals"),
]


def public():
    """Functions and classes that users reach through the modules, methods included, by name."""
    found = {}
    for module in MODULES:
        for name, thing in vars(module).items():
            if not (belongs(name, thing, module) and callable(thing)):
                continue
            found[f"{module.__name__}.{name}"] = thing
            for key, member in vars(thing).items() if inspect.isclass(thing) else ():
                member = getattr(member, "func", getattr(member, "fget", member))  # properties
                if key[0] != "_" and inspect.isfunction(member):
                    found[f"{module.__name__}.{name}.{key}"] = member
    return found


THINGS = public()
OURS = {name.split(".")[1] for name, thing in THINGS.items() if inspect.isclass(thing)}
documented = pytest.mark.parametrize("name", THINGS)
formal = pytest.mark.parametrize("name", FORMAL)


def sections(name):
    return docscrape.NumpyDocString(inspect.getdoc(THINGS[name]))


def arguments(thing):
    return {k: v for k, v in inspect.signature(thing).parameters.items() if k != "self"}


def words(annotation):
    return set(re.findall(r"\w+", str(annotation)))


@documented
def test_opens_with_one_sentence_on_one_line(name):
    first, *rest = inspect.getdoc(THINGS[name]).split("\n")
    assert first.rstrip("`)")[-1] in ".?:"
    assert not rest or rest[0] == ""


@documented
def test_every_argument_is_named(name):
    thing = THINGS[name]
    text, plain = inspect.getdoc(thing), OURS | {"Generator", "Rng", "bool", "Path", "PathLike"}
    text += " information "  # of which `psi` says what it is
    if thing.__module__ == checks.__name__:
        text += checks.__doc__
    if inspect.isclass(thing):
        text += " ".join(re.findall(r"^    (\w+): .*#:", inspect.getsource(thing), re.M))
    missing = [
        key
        for key, argument in arguments(thing).items()
        if not plain & words(argument.annotation)
        and not re.search(rf"\b{key.removesuffix('s')}s?\b", text)
    ]
    assert not missing


@formal
def test_numpydoc_has_all_arguments_with_their_type_or_shape(name):
    entries = sections(name)["Parameters"]
    typed = {key.strip("* "): entry.type for entry in entries for key in entry.name.split(",")}
    assert set(typed) == set(arguments(THINGS[name])) and all(typed.values())
    for entry in entries:
        if "array" in entry.type:
            assert re.search(r"\(.*\)|any shape", entry.type), entry.name


@formal
def test_numpydoc_says_what_is_returned_and_raised(name):
    found = sections(name)
    assert found["Raises"] and (found["Returns"] or inspect.isclass(THINGS[name]))


@documented
def test_arrays_among_fields_have_shapes(name):
    if inspect.isclass(thing := THINGS[name]) and hasattr(thing, "_fields"):
        for line in re.findall(r"^    \w+: Array.*$", inspect.getsource(thing), re.M):
            assert re.search(r"#: \(.*\)", line), line


@pytest.mark.parametrize("module", [ms, perception], ids=lambda module: module.__name__)
def test_a_module_opens_with_a_running_example(module):
    (tests,) = DocTestFinder(recurse=False).find(module)
    assert len(tests.examples) >= 4
