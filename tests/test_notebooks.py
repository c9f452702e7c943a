"""The committed notebooks: complete, legible without eyes or network, and of use as a course.

`make notebooks-check` executes them.  Here only files are read, except at the end, where the tools
of notebooks/build.py are tested if they are installed.
"""

import ast
import importlib
import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import landing
import modelselect
import perception
from modelselect_parts.regulator import PATTERNS

pytestmark = pytest.mark.no_cover

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "notebooks"
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAPER = (NOTEBOOKS / "paper.md").read_text(encoding="utf-8")
NAMES = sorted(path.stem for path in NOTEBOOKS.glob("[0-9][0-9]_*.py"))
MODULES = (modelselect, perception, landing)
PUBLIC = {
    name
    for module in MODULES
    for name, value in vars(module).items()
    if name[0] != "_" and getattr(value, "__module__", None) == module.__name__
}
SOLVERS = {"gurobipy", "highspy", "pyscipopt"}  # ours are the subject; CVXPY may stand beside
LABEL = re.compile(r"\b(?:eq|prob|thm|sol|opt|optAppx|ass|fig|remark):\w+")
MACHINE = re.compile(r"/(?:tmp|home|root|work|usr|Users)/|[A-Z]:\\\\|0x[0-9a-f]{6}")
LOADS = re.compile(r"""(?:src|srcset|poster)\s*=\s*["']?\s*(?!data:)\w*:?//|url\(\s*["']?\w*:?//""")
MOST_HTML = 1_500_000  # bytes of a page inside a notebook, such as an animation

# Twenty minutes of reading.  Words: of all Markdown, with answers and exercises; formulas, names in
# code and numbers are none.  Lines: not blank, and open to the eye: no hidden, exercise or check.
MOST_WORDS, MOST_LINES = 1400, 120
UNSEEN = {"hide-input", "exercise", "check"}
MOST_COPIED = 100  # lines of the cell that is the whole of it, in 00

each_notebook = pytest.mark.parametrize("name", NAMES)


@cache
def cells(name: str) -> list[dict]:
    return json.loads((NOTEBOOKS / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]


def source(cell: dict) -> str:
    return "".join(cell["source"])


def code(name: str) -> list[str]:
    return [source(cell) for cell in cells(name) if cell["cell_type"] == "code"]


def outputs(name: str) -> list[tuple[dict, dict]]:
    return [(cell, output) for cell in cells(name) for output in cell.get("outputs", [])]


def with_tag(name: str, tag: str) -> list[dict]:
    return [cell for cell in cells(name) if tag in cell["metadata"].get("tags", [])]


def section(mark: str) -> str:
    return PAPER.partition(f"<!-- {mark} -->")[2].partition(f"<!-- /{mark} -->")[0]


# --- files ---


def test_there_are_eight_numbered_in_order():
    assert [name[:3] for name in NAMES] == [f"{k:02d}_" for k in range(8)]


@each_notebook
def test_each_has_its_result_and_its_solutions(name):
    assert (NOTEBOOKS / f"{name}.ipynb").exists()
    assert (NOTEBOOKS / "solutions" / f"{name}.py").exists()


def test_no_result_and_no_solution_is_without_its_notebook():
    results = {path.stem for path in NOTEBOOKS.glob("*.ipynb")}
    solutions = {path.stem for path in (NOTEBOOKS / "solutions").glob("*.py")}
    assert results | solutions <= set(NAMES)


@each_notebook
def test_the_readme_names_it(name):
    assert f"notebooks/{name}.ipynb" in README


@each_notebook
def test_a_cell_is_known_by_its_place(name):
    stem = name.replace("_", "-")
    ids = [cell["id"] for cell in cells(name)]
    assert ids == [f"{stem}-{place:03d}" for place in range(1, len(ids) + 1)]


@each_notebook
def test_cells_were_executed_once_from_top_to_bottom(name):
    ran = [cell for cell in cells(name) if cell["cell_type"] == "code"]
    ran = [cell for cell in ran if "skip-execution" not in cell["metadata"].get("tags", [])]
    assert [cell["execution_count"] for cell in ran] == list(range(1, len(ran) + 1))


# --- what a reader meets ---


@each_notebook
def test_it_opens_with_its_title_its_goals_and_what_it_covers(name):
    opening = source(cells(name)[0])
    assert re.match(rf"# {int(name[:2])}\. [^$`*]+\n", opening)  # plain: it is a link's text, too
    goals, _, covers = opening.partition("**After this notebook you can**")[2].partition("**Covers")
    assert 3 <= len(re.findall(r"^[-*] ", goals, re.MULTILINE)) <= 5
    assert LABEL.search(covers)


@each_notebook
def test_the_labels_it_names_are_of_the_paper(name):
    text = "\n".join(source(cell) for cell in cells(name))
    known = set(LABEL.findall(section("index") + section("errata")))
    assert set(LABEL.findall(text)) <= known


@each_notebook
def test_the_index_leads_to_it_and_each_label_there_is_in_it(name):
    text = "\n".join(source(cell) for cell in cells(name))
    rows = [row.rsplit("|", 2) for row in section("index").splitlines() if row.count("|") > 3]
    here = [row for row, column, _ in rows if re.search(rf"\b{name[:2]}(?:_|\b)", column)]
    assert here
    assert not [row for row in here if not set(LABEL.findall(row)) & set(LABEL.findall(text))]


@each_notebook
def test_it_ends_with_a_summary_and_exercises(name):
    text = "\n".join(source(cell) for cell in cells(name) if cell["cell_type"] == "markdown")
    assert re.search(r"^(?:## |\*\*)In one paragraph", text, re.MULTILINE)
    titles = re.findall(r"^## Exercises$|^### Exercise (\d)(?: \(open\))?: \S", text, re.MULTILINE)
    assert titles == ["", *(str(k) for k in range(1, len(titles)))]


@each_notebook
def test_it_has_three_to_five_exercises_each_with_a_check_and_a_solution(name):
    tasks, checks = with_tag(name, "exercise"), with_tag(name, "check")
    assert 3 <= len(tasks) <= 5
    places = [cells(name).index(cell) for cell in tasks]
    assert [cells(name).index(cell) for cell in checks] == [place + 1 for place in places]
    solutions = (NOTEBOOKS / "solutions" / f"{name}.py").read_text(encoding="utf-8")
    found = re.findall(r"^# ## Exercise (\d)", solutions, re.MULTILINE)
    assert found == [str(k) for k in range(1, len(tasks) + 1)]


@each_notebook
def test_a_check_says_which_exercise_it_is_about_and_is_not_run(name):
    for k, cell in enumerate(with_tag(name, "check"), 1):
        assert "skip-execution" in cell["metadata"]["tags"]
        assert not cell["outputs"]
        assert "assert" in source(cell)
        assert set(re.findall(r"Exercise (\d):", source(cell))) == {str(k)}
        assert source(cell).rstrip().endswith(f'print("Exercise {k}: right")')


@each_notebook
def test_every_picture_is_described_in_words(name):
    described = [cell["metadata"]["alt"] for cell in cells(name) if "alt" in cell["metadata"]]
    assert described
    assert all(len(alt.split()) >= 8 for alt in described)
    for cell in cells(name):
        shown = [out for out in cell.get("outputs", []) if "image/png" in out.get("data", {})]
        alts = [picture["metadata"]["image/png"]["alt"] for picture in shown]
        assert alts == ([cell["metadata"]["alt"]] if "alt" in cell["metadata"] else []), cell["id"]


@each_notebook
def test_claims_are_asserted_before_the_readers_eyes(name):
    shown = [text for text in code(name) if "Exercise " not in text]
    assert sum("assert" in text for text in shown) >= 3


@each_notebook
def test_it_is_read_in_twenty_minutes(name):
    text = " ".join(source(cell) for cell in cells(name) if cell["cell_type"] == "markdown")
    seen = [c for c in cells(name) if not UNSEEN & set(c["metadata"].get("tags", []))]
    lines = [
        line
        for cell in seen
        if cell["cell_type"] == "code"
        for line in source(cell).splitlines()
        if line.strip()
    ]
    assert len(text.split()) <= MOST_WORDS  # formulas, tables and folded answers among them
    assert len(lines) <= MOST_LINES


@each_notebook
def test_it_asks_three_questions_and_folds_the_answers(name):
    text = "\n".join(source(cell) for cell in cells(name) if cell["cell_type"] == "markdown")
    recall = text.partition("\n## Recall\n")[2].partition("\n## Exercises\n")[0]
    assert len(re.findall(r"<details><summary>[^<]+\?</summary>", recall)) >= 3
    assert len(re.findall(r"^### Exercise \d \(open\): ", text, re.MULTILINE)) >= 1


def test_the_hundred_lines_stand_alone_and_agree_with_the_modules():
    (cell,) = with_tag("00_hundred_lines", "copy")
    tree, ours = ast.parse(source(cell)), {}
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    assert {name for node in imports for name in re.findall(r"'(\w+)", ast.dump(node))} <= {
        *("numpy", "np", "linalg", "cholesky", "pinv", "solve")
    }
    assert len(source(cell).splitlines()) <= MOST_COPIED
    exec(compile(tree, "00_hundred_lines", "exec"), ours)
    assert set(ours["PATTERNS"]) == set(PATTERNS)
    rng = np.random.default_rng(0)
    for n, m, p in [(1, 1, 1), (3, 2, 2), (2, 1, 1), (3, 1, 1)]:
        A, B, C = (rng.normal(size=(n, k)) for k in (n, m, p))
        robot, gains = (A, B, C, np.eye(n), np.eye(m)), rng.normal(size=(n, p))
        task = modelselect.ControlTask(*robot, 6)
        for name in PATTERNS:
            theirs = modelselect.psi(task, name, gains=gains if PATTERNS[name].gains else None)
            found = ours["sensitivity"](*robot, 6, name, gains)
            np.testing.assert_allclose(found, theirs, atol=1e-9 * theirs.max())
        if p == 1:
            mean, linear = rng.normal(size=(6, 3)), rng.uniform(0, 2, (6, 3))
            c, cost, bound, d, _, _ = ours["schedule"](*robot, mean, linear)
            mean = mean[:, :, None]
            problem = modelselect.SelectionProblem(
                modelselect.psi(task, "preview"), mean, 0 * mean, linear
            )
            np.testing.assert_allclose(cost, modelselect.enumerate_schedules(problem).cost)
            np.testing.assert_allclose(cost, problem.total_cost(c))
            np.testing.assert_allclose(bound, modelselect.reference_bound(problem, d)[0])


# --- what must not be there ---


@each_notebook
def test_no_error_no_warning_and_no_exercise_shows_anything(name):
    for cell, output in outputs(name):
        assert output["output_type"] != "error"
        assert output.get("name") != "stderr"
        assert "exercise" not in cell["metadata"].get("tags", [])


@each_notebook
def test_it_uses_the_modules_and_repeats_none_of_their_names(name):
    trees = [ast.parse(text) for text in code(name)]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    defined = {node.name for node in nodes if isinstance(node, ast.FunctionDef | ast.ClassDef)}
    assert not defined & PUBLIC
    imported = {alias.name for n in nodes if isinstance(n, ast.Import) for alias in n.names}
    imported |= {
        name
        for n in nodes
        if isinstance(n, ast.ImportFrom)
        for name in (n.module, *(f"{n.module}.{alias.name}" for alias in n.names))
    }
    assert imported & {module.__name__ for module in MODULES}
    assert not imported & SOLVERS


@each_notebook
def test_its_results_tell_nothing_of_the_machine_that_made_them(name):
    for cell, output in outputs(name):
        said = {k: v for k, v in output.get("data", {}).items() if not k.startswith("image/")}
        text = "".join(output.get("text", [])) + json.dumps(said)
        assert not MACHINE.search(text), cell["id"]


@each_notebook
def test_its_pages_are_small_and_load_nothing(name):
    for cell, output in outputs(name):
        html = "".join(output.get("data", {}).get("text/html", []))
        assert not LOADS.search(html) and "<link" not in html and "@import" not in html, cell["id"]
        assert len(html.encode()) <= MOST_HTML, cell["id"]


# --- the tools, where they are installed ---


@pytest.fixture
def build(monkeypatch):
    for needed in ("jupytext", "latex2mathml", "nbclient", "nbconvert"):
        pytest.importorskip(needed)
    monkeypatch.syspath_prepend(NOTEBOOKS)
    return importlib.import_module("build")


@pytest.fixture
def book(build):
    return importlib.import_module("book")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("cost 0.1234", "cost 0.1235"),  # one unit in the last printed place
        ("9.999e+15", "1.000e+16"),
        ("[1.     0.5]", "[0.9999 0.5]"),  # NumPy cuts trailing zeros
        ("[ 0.00 -1.50]", "[-0.00 -1.50]"),
        ("a  1.0\nb", "a 1.0 \nb"),
    ],
)
def test_a_last_digit_and_a_space_are_no_change(build, old, new):
    assert build.alike(old, new)
    assert build.alike(new, old)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("cost 0.1234", "cost 0.1236"),
        ("9.999e+15", "9.999e+14"),
        ("1.0", "-1.0"),
        ("1. 0.5", "0.1 0.5"),
        ("150 steps", "151 steps"),  # whole numbers count something
        ("proved", "not proved"),
        ("0.5", "nan"),
        ("0.5 0.5", "0.5"),
    ],
)
def test_words_counts_and_larger_differences_are_changes(build, old, new):
    assert not build.alike(old, new)
    assert not build.alike(new, old)


def code_cell(build, outputs=(), **metadata):
    outputs = [build.nbformat.from_dict(output) for output in outputs]
    return build.new_code_cell("1", outputs=outputs, metadata=metadata, id="01-x-001")


PICTURE = {
    "output_type": "display_data",
    "data": {"image/png": "aGk=", "text/plain": "<Figure size 640x480 with 1 Axes>"},
    "metadata": {"image/png": {"alt": "words"}},
}


def test_a_change_is_shown_as_a_difference(build):
    printed = {"output_type": "stream", "name": "stdout"}
    before, after = (
        build.new_notebook(cells=[code_cell(build, [{**printed, "text": text}])])
        for text in ("cost 1.0\nproved\n", "cost 1.0\nnot proved\n")
    )
    (found,) = build.changes(before, after)
    assert "\n    -proved\n    +not proved" in found
    assert not [*build.changes(before, before)]


@pytest.mark.parametrize(
    ("text", "html"),
    [
        ("so $a<b$", ["<mo><</mo>", "<mo>&#x0003C;</mo>"]),
        (r"$$\begin{aligned} a &= 1 \\ &= 2 \end{aligned}$$", ["<mtable"]),
        ("- item $x$\n- other", ["<math"]),
        ("| a |\n|---|\n| $\\frac12$ |", ["<mfrac>"]),
        ("<details><summary>q</summary>\n\n$x$\n\n</details>", ["</math></p>\n</details>"]),
    ],
)
def test_formulas_become_mathml(book, text, html):
    assert any(part in book.markdown(text) for part in html)


@pytest.mark.parametrize("tex", [r"\nosuchthing", "a & b", r"\frac{1", "x_{", r"\text{\foo}"])
def test_a_formula_that_cannot_be_converted_is_named(book, tex):
    with pytest.raises(ValueError, match=re.escape(repr(tex))):
        book.mathml(tex, "inline")


def test_hidden_code_is_folded_and_its_picture_is_not(build, book):
    cell = code_cell(build, [PICTURE], alt="words", tags=["hide-input"])
    html = book.render(build.new_notebook(cells=[cell]))
    folded, _, rest = html.partition("</details>")
    assert "highlight" in folded.partition("<summary>")[2]
    assert "<img" in rest and "<img" not in folded


def test_a_page_is_whole_and_told_to_load_nothing(book):
    html = book.page("A < B", '<h1>A</h1><h2 id="b">B</h2>', None, ("c.html", "C"))
    for part in ('lang="en"', "<title>A &lt; B</title>", "default-src 'none'", '<main id="main">'):
        assert part in html
    assert re.search(r'<a class="skip" href="#main">.*<a href="#b">B</a>', html, re.DOTALL)
    assert '<a rel="next" href="c.html">C →</a>' in html
