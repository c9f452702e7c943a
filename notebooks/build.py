"""Execute the notebooks, check that the committed ones still hold, bind them into a web book.

    python notebooks/build.py            # execute each NN_name.py and write NN_name.ipynb
    python notebooks/build.py --check    # execute, write nothing, fail if what is committed differs
    python notebooks/build.py --book     # write book/*.html from the committed notebooks
    python notebooks/build.py 03_exact   # that one alone; also with --check

NN_name.py is the source, in percent format.  A code cell that shows a picture says in its header
what the picture shows (alt="...").  Exercises end a notebook: a cell tagged "exercise" holds a
placeholder, the next one, tagged "check" and "skip-execution", asserts that the answer is right.
solutions/NN_name.py has a code cell for each exercise, which replaces the placeholder.
tests/test_notebooks.py reads the committed notebooks: what each must have, and must not show.
"""

from __future__ import annotations

import argparse
import difflib
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path

import jupytext
import nbformat
from jupyter_client import AsyncKernelManager
from jupyter_client.kernelspec import KernelSpecManager
from matplotlib import font_manager  # noqa: F401  builds the font list here, not in a cell's output
from nbclient import NotebookClient
from nbclient.exceptions import CellControlSignal, DeadKernelError
from nbformat import NotebookNode
from nbformat.v4 import new_code_cell, new_notebook
from tqdm import tqdm

from book import make_pages, pictures

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
BOOK = ROOT / "book"

# The same on every machine: no version, no path, no time.
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"file_extension": ".py", "name": "python", "pygments_lexer": "ipython3"},
}
ENVIRONMENT = {
    "PYTHONPATH": str(ROOT),  # the modules of this checkout
    "PYTHONHASHSEED": "0",
    "OPENBLAS_NUM_THREADS": "1",
    "MPLBACKEND": "module://matplotlib_inline.backend_inline",  # make sets one that shows nothing
    "PYDEVD_DISABLE_FILE_VALIDATION": "1",  # the kernel's debugger has a warning of its own
}


class Finding(Exception):
    """What is wrong with a notebook."""


# --- files ---


def names() -> list[str]:
    """All notebooks in reading order."""
    return sorted(path.stem for path in HERE.glob("[0-9][0-9]_*.py"))


def read_source(path: Path) -> NotebookNode:
    """Read a percent file as a notebook without outputs; a cell's id is its place."""
    cells = jupytext.read(path, fmt="py:percent").cells
    for place, cell in enumerate(cells, 1):
        cell.id = f"{path.stem.replace('_', '-')}-{place:03d}"
        cell.metadata = {key: cell.metadata[key] for key in ("alt", "tags") if key in cell.metadata}
    return nbformat.from_dict(new_notebook(cells=cells, metadata=METADATA))


def read_solutions(name: str) -> NotebookNode:
    """Read the solutions to a notebook's exercises."""
    return read_source(HERE / "solutions" / f"{name}.py")


def read_committed(name: str) -> NotebookNode:
    """Read NN_name.ipynb, which must have the cells of NN_name.py."""
    committed = nbformat.read(HERE / f"{name}.ipynb", as_version=4)
    source, result = (
        (notebook.metadata, [(c.id, c.cell_type, c.source, c.metadata) for c in notebook.cells])
        for notebook in (read_source(HERE / f"{name}.py"), committed)
    )
    if source != result:
        raise Finding(f"{name}.ipynb is stale: run make notebooks")
    return committed


# --- execution ---


def execute(name: str) -> NotebookNode:
    """Run a notebook, then try its exercises; return it with its outputs."""
    notebook = read_source(HERE / f"{name}.py")
    checks = [cell for cell in notebook.cells if "check" in cell.metadata.get("tags", [])]
    solutions = [cell for cell in read_solutions(name).cells if cell.cell_type == "code"]
    trials = [
        new_code_cell(code.source, metadata={"tags": tags})
        for check, solution in zip(checks, solutions, strict=True)
        for code, tags in ((check, ["raises-exception"]), (solution, []), (check, []))
    ]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        NotebookClient(
            new_notebook(cells=[*notebook.cells, *trials]),
            # This interpreter, whichever kernels are installed, without the user's startup files.
            km=AsyncKernelManager(kernel_spec_manager=KernelSpecManager(kernel_dirs=[])),
            extra_arguments=["--log-level=ERROR"],
            resources={"metadata": {"path": str(HERE)}},
            timeout=600,
            record_timing=False,
            coalesce_streams=True,
        ).execute(env=os.environ | ENVIRONMENT | {"IPYTHONDIR": folder})
    for k, refusal in enumerate(trials[::3], 1):
        said = "".join(f"{out.ename}: {out.evalue}" for out in refusal.outputs if "ename" in out)
        if not said.startswith(f"AssertionError: Exercise {k}:"):
            raise Finding(f"the check of exercise {k} says to the placeholder: {said or 'right'}")
    for cell in notebook.cells:
        for picture in pictures(cell):  # nbconvert reads it there
            picture.metadata["image/png"] = {"alt": cell.metadata.get("alt", "")}
    return notebook


# --- comparison ---

# A whole number is a count or a label and must not change.
DECIMAL = re.compile(r"[-+]?(?:\d+\.\d*|\.\d+|\d+(?=[eE][-+]?\d))(?:[eE][-+]?\d+)?")


def alike(old: str, new: str) -> bool:
    """Whether two texts agree in their words, and in their decimals up to the last place.

    Machines and NumPy versions add in different orders, so where 0.12345 is printed with four
    digits, 0.1234 may become 0.1235: one unit in the last printed place is no change.  Neither are
    spaces, which follow from the width of the numbers.
    """
    words = [[part.split() for part in DECIMAL.split(text)] for text in (old, new)]
    if words[0] != words[1]:
        return False
    pairs = zip(*(map(Decimal, DECIMAL.findall(text)) for text in (old, new)), strict=True)
    return all(
        abs(a - b) <= Decimal((0, (1,), min(a.as_tuple().exponent, b.as_tuple().exponent)))
        for a, b in pairs
    )


def text_of(cell: NotebookNode) -> str:
    """Return what a cell says in plain text; that of a picture is its size."""
    outputs = cell.get("outputs", [])
    return "".join(out.get("text") or out.data.get("text/plain", "") + "\n" for out in outputs)


def changes(committed: NotebookNode, executed: NotebookNode) -> Iterator[str]:
    """Find the cells whose text differs from the committed one."""
    for old, new in zip(committed.cells, executed.cells, strict=True):
        before, after = text_of(old), text_of(new)
        if not alike(before, after):
            lines = (text.splitlines() for text in (before, after))
            diff = difflib.unified_diff(*lines, "committed", "now", lineterm="", n=1)
            yield "\n    ".join([f"cell {old.id}: its output has changed", *diff])


# --- command line ---


def check(name: str) -> None:
    """Execute a notebook and compare it with the committed one."""
    committed = read_committed(name)
    if found := [*changes(committed, execute(name))]:
        raise Finding("\n".join(found))


def write(name: str) -> None:
    """Execute a notebook and write it."""
    nbformat.write(execute(name), HERE / f"{name}.ipynb")


def pages() -> dict[str, str]:
    """Make the pages of the book from the committed notebooks."""
    return make_pages(
        {name: read_committed(name) for name in names()},
        {name: read_solutions(name) for name in names()},
    )


def main() -> None:
    """Parse the command line and do what it says; fail with what is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NN_name", help="default: all notebooks")
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--check", action="store_true", help="write nothing; fail on a difference")
    mode.add_argument("--book", action="store_true", help="write book/*.html, executing nothing")
    options = parser.parse_args()
    if options.book:
        BOOK.mkdir(exist_ok=True)
        for file, html in pages().items():
            (BOOK / file).write_text(html, encoding="utf-8")
        return
    findings = []
    for name in tqdm(options.names or names(), unit="notebook", disable=None):
        try:
            (check if options.check else write)(name)
        except (Finding, OSError, CellControlSignal, DeadKernelError) as error:
            findings.append(f"{name}: {error}")
    sys.exit("\n".join(findings) or None)


if __name__ == "__main__":
    main()
