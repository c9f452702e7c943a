"""Execute the notebooks, check that the committed ones still hold, bind them into a web book.

    python notebooks/build.py            # execute each NN_name.py and write NN_name.ipynb
    python notebooks/build.py --check    # execute, write nothing, fail if what is committed differs
    python notebooks/build.py --book     # write book/*.html from the committed notebooks
    python notebooks/build.py 03_exact   # that one alone; also with --check

NN_name.py is the source, in percent format.  A code cell that shows a picture says in its header
what the picture shows (alt="...").  Exercises end a notebook: a cell tagged "exercise" holds a
placeholder, the next one, tagged "check" and "skip-execution", asserts that the answer is right.
solutions/NN_name.py has a code cell for each exercise, which replaces the placeholder.
"""

from __future__ import annotations

import argparse
import difflib
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from decimal import Decimal
from pathlib import Path

import jupytext
import nbformat
from ipykernel.kernelspec import get_kernel_dict
from jupyter_client import AsyncKernelManager
from jupyter_client.kernelspec import KernelSpec, KernelSpecManager
from matplotlib import font_manager  # noqa: F401  builds the font list here, not in a cell's output
from nbclient import NotebookClient
from nbclient.exceptions import CellControlSignal, CellExecutionError, DeadKernelError
from nbformat import NotebookNode
from nbformat.v4 import new_code_cell, new_notebook
from tqdm import tqdm

from book import flaws, make_pages

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
CELL_SECONDS = 600


class Finding(Exception):
    """What is wrong with a notebook, in one line."""


# --- the source and its exercises ---


def names() -> list[str]:
    """All notebooks in reading order: those of which there is a source or a result."""
    return sorted({path.stem for path in HERE.glob("[0-9][0-9]_*.*") if path.suffix != ".tmp"})


def read_source(path: Path) -> NotebookNode:
    """Read a percent file as a notebook without outputs; a cell's id is its place."""
    if not path.exists():
        raise Finding(f"{path.relative_to(HERE)} is missing")
    cells = jupytext.read(path, fmt="py:percent").cells
    for place, cell in enumerate(cells, 1):
        cell.id = f"{path.stem.replace('_', '-')}-{place:03d}"
        cell.metadata = {key: cell.metadata[key] for key in ("alt", "tags") if key in cell.metadata}
    return nbformat.from_dict(new_notebook(cells=cells, metadata=METADATA))


def read_committed(name: str) -> NotebookNode:
    """Read NN_name.ipynb, which must have the cells of NN_name.py."""
    path = HERE / f"{name}.ipynb"
    if not path.exists():
        raise Finding(f"{path.name} is missing: run make notebooks")
    committed = nbformat.read(path, as_version=4)
    outlines = [
        [(cell.id, cell.cell_type, cell.source, dict(cell.metadata)) for cell in notebook.cells]
        for notebook in (read_source(HERE / f"{name}.py"), committed)
    ]
    for source, result in zip(*outlines, strict=False):
        if source != result:
            raise Finding(f"stale from cell {source[0]} on: run make notebooks")
    if len(outlines[0]) != len(outlines[1]) or committed.metadata != METADATA:
        raise Finding("stale: run make notebooks")
    return committed


def tagged(cell: NotebookNode, tag: str) -> bool:
    """Whether a cell carries a tag."""
    return tag in cell.metadata.get("tags", [])


def exercises(name: str, notebook: NotebookNode) -> list[tuple[str, str]]:
    """Return the code of check and solution of each exercise, in order."""
    places = [i for i, cell in enumerate(notebook.cells) if tagged(cell, "exercise")]
    checks = [i for i, cell in enumerate(notebook.cells) if tagged(cell, "check")]
    if not 3 <= len(places) <= 5:
        raise Finding(f"{len(places)} exercises; a notebook has three to five")
    if checks != [place + 1 for place in places]:
        raise Finding("each exercise cell must be followed by its check, and no other cell by one")
    for cell in (notebook.cells[i] for i in checks):
        if not tagged(cell, "skip-execution"):
            raise Finding(f"cell {cell.id} is a check without the tag skip-execution")
    answers = solutions(name, len(places))
    return [(notebook.cells[i].source, answer) for i, answer in zip(checks, answers, strict=True)]


def solutions(name: str, count: int) -> list[str]:
    """Return the code of each solution; a text that says why it is right stands above it."""
    cells = read_source(HERE / "solutions" / f"{name}.py").cells
    texts = [cell.source for cell in cells[::2]]
    if [cell.cell_type for cell in cells] != ["markdown", "code"] * count or not all(
        text.startswith(f"## Exercise {k}") for k, text in enumerate(texts, 1)
    ):
        raise Finding(
            f"solutions/{name}.py must have, for each of the {count} exercises, a markdown cell "
            "(## Exercise k) and a code cell, and nothing else"
        )
    return [cell.source for cell in cells[1::2]]


# --- execution ---


class ThisInterpreter(KernelSpecManager):
    """The kernel is the Python that runs this script, whichever kernels are installed."""

    def get_kernel_spec(self, kernel_name: str) -> KernelSpec:
        """Describe how to start it."""
        return KernelSpec(**get_kernel_dict(["--log-level=ERROR"]) | {"env": ENVIRONMENT})


def execute(name: str) -> tuple[NotebookNode, list[str]]:
    """Run a notebook, then its exercises; return it with its outputs, and the findings."""
    notebook = read_source(HERE / f"{name}.py")
    pairs = exercises(name, notebook)
    client = NotebookClient(
        notebook,
        km=AsyncKernelManager(kernel_spec_manager=ThisInterpreter()),
        resources={"metadata": {"path": str(HERE)}},
        timeout=CELL_SECONDS,
        record_timing=False,
        coalesce_streams=True,
    )
    with client.setup_kernel(cleanup_kc=True):
        for i, cell in enumerate(notebook.cells):
            try:
                client.execute_cell(cell, i)
            except CellExecutionError as error:
                raise Finding(f"cell {cell.id} raised {error.ename}: {error.evalue}") from None
            if cell.metadata.get("alt"):
                for output in pictures(cell):
                    output.metadata["image/png"] = {"alt": cell.metadata.alt}  # nbconvert reads it
        notebook.metadata = nbformat.from_dict(METADATA)
        return notebook, [*inspect(notebook), *try_exercises(client, pairs)]


def try_exercises(client: NotebookClient, pairs: list[tuple[str, str]]) -> Iterator[str]:
    """Every check must refuse the placeholder, saying why, and accept the solution."""
    for k, (check, solution) in enumerate(pairs, 1):
        refusal, _ = run(client, check)
        if not refusal.startswith(f"AssertionError: Exercise {k}:"):
            yield (
                f"exercise {k}: its check met the placeholder with {refusal or 'no error'!r} "
                f"instead of 'AssertionError: Exercise {k}: ...'"
            )
        error, _ = run(client, solution)
        if error:
            yield f"exercise {k}: its solution raised {error!r}"
            continue
        error, printed = run(client, check)
        if error or not printed.endswith(f"Exercise {k}: right\n"):
            yield (
                f"exercise {k}: its check met the solution with {error or printed!r} "
                f"instead of printing 'Exercise {k}: right'"
            )


def run(client: NotebookClient, code: str) -> tuple[str, str]:
    """Run code in the kernel, outside the notebook; return its error and what it printed."""
    cell = new_code_cell(code, metadata={"tags": ["raises-exception"]})
    client.nb.cells.append(cell)
    client.execute_cell(cell, len(client.nb.cells) - 1)
    client.nb.cells.pop()
    errors = [f"{out.ename}: {out.evalue}" for out in cell.outputs if out.output_type == "error"]
    return "".join(errors), "".join(out.get("text", "") for out in cell.outputs)


# --- what a notebook may show ---


def pictures(cell: NotebookNode) -> list[NotebookNode]:
    """Return the outputs of a cell that are pictures."""
    outputs = cell.get("outputs", [])
    return [output for output in outputs if "image/png" in output.get("data", {})]


def inspect(notebook: NotebookNode) -> Iterator[str]:
    """Find errors, warnings, addresses, pictures without words and exercises that say anything."""
    for cell in notebook.cells:
        alt = cell.metadata.get("alt", "")
        shown = pictures(cell)
        if bool(shown) != bool(alt):
            yield f"cell {cell.id} has " + ("alt but no picture" if alt else "a picture but no alt")
        elif len(shown) > 1:
            yield f"cell {cell.id} has {len(shown)} pictures; one alt text describes one"
        elif shown and shown[0].metadata.get("image/png", {}).get("alt") != alt:
            yield f"cell {cell.id}: the alt text is not with the picture"
        for output in cell.get("outputs", []):
            if output.output_type == "error" or output.get("name") == "stderr":
                yield f"cell {cell.id} shows an error or a warning: {text_of(output)!r}"
            elif tagged(cell, "exercise"):
                yield f"cell {cell.id}: the placeholder of an exercise must show nothing"
            elif " at 0x" in text_of(output):
                yield f"cell {cell.id} prints the address of an object: {text_of(output)!r}"


def text_of(output: NotebookNode) -> str:
    """Return what an output says in plain text; a picture or a page stands for itself."""
    if output.output_type == "error":
        return f"{output.ename}: {output.evalue}"
    if output.output_type == "stream":
        return output.text
    for kind in ("text/html", "image/png"):
        if kind in output.data:
            return f"[{kind}]\n"
    return output.data.get("text/plain", "") + "\n"


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


def changes(committed: NotebookNode, executed: NotebookNode) -> Iterator[str]:
    """Find the cells whose text differs from the committed one."""
    for old, new in zip(committed.cells, executed.cells, strict=True):
        before, after = ("".join(map(text_of, cell.get("outputs", []))) for cell in (old, new))
        if not alike(before, after):
            lines = (text.splitlines() for text in (before, after))
            diff = difflib.unified_diff(*lines, "committed", "now", lineterm="", n=1)
            yield "\n    ".join([f"cell {old.id}: its output has changed", *diff])


def check(name: str) -> list[str]:
    """Execute a notebook and compare it with the committed one."""
    committed = read_committed(name)
    executed, findings = execute(name)
    return [*findings, *inspect(committed), *changes(committed, executed)]


def write(name: str) -> list[str]:
    """Execute a notebook and, if all is well, write it."""
    notebook, findings = execute(name)
    if not findings:
        put(HERE / f"{name}.ipynb", nbformat.writes(notebook).rstrip("\n") + "\n")
    return findings


def put(path: Path, text: str) -> None:
    """Write a file if its content changes, and then at one stroke."""
    if path.exists() and path.read_text(encoding="utf-8") == text:
        return
    beside = path.with_name(path.name + ".tmp")
    beside.write_text(text, encoding="utf-8")
    os.replace(beside, path)


# --- command line ---


def each(work: Callable[[str], list[str]], chosen: list[str], quiet: bool) -> list[str]:
    """Do the work for each notebook and gather the findings, one a line."""
    findings = []
    for name in tqdm(chosen, unit="notebook", disable=quiet or None):
        try:
            found = work(name)
        except (Finding, CellControlSignal, DeadKernelError) as error:
            found = [str(error)]
        findings += [f"{name}: {line}" for line in found]
    return findings


def pages() -> dict[str, str]:
    """Make the pages of the book from the committed notebooks."""
    return make_pages(
        {name: read_committed(name) for name in names()},
        {name: read_source(HERE / "solutions" / f"{name}.py") for name in names()},
    )


def bind(keep: bool) -> list[str]:
    """Make the book; keep it if nothing is wrong with it."""
    try:
        made = pages()
    except (Finding, ValueError) as error:
        return [f"book: {error}"]
    findings = [f"book: {line}" for line in flaws(made)]
    if keep and not findings:
        BOOK.mkdir(exist_ok=True)
        for old in set(BOOK.glob("*.html")) - {BOOK / file for file in made}:
            old.unlink()
        for file, html in made.items():
            put(BOOK / file, html)
    return findings


def main() -> int:
    """Parse the command line, do what it says, print the findings; 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NN_name", help="default: all notebooks")
    mode = parser.add_mutually_exclusive_group()
    mode.add_argument("--check", action="store_true", help="write nothing; fail on a difference")
    mode.add_argument(
        "--book", action="store_true", help="write book/*.html of all, executing nothing"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    options = parser.parse_args()
    unknown = set(options.names) - set(names())
    if unknown or not names():
        parser.error(f"no such notebook: {', '.join(sorted(unknown))}; there are {names()}")
    chosen = [name for name in names() if name in (options.names or names())]
    findings = []
    if not options.book:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            ENVIRONMENT["IPYTHONDIR"] = folder  # instead of the user's own startup files
            findings = each(check if options.check else write, chosen, options.quiet)
    if options.book or (options.check and not findings and not options.names):
        findings = bind(keep=options.book)
    done = f"{BOOK.relative_to(ROOT)}/index.html" if options.book else ", ".join(chosen)
    print("\n".join(findings) or f"all is well: {done}")
    return int(bool(findings))


if __name__ == "__main__":
    sys.exit(main())
