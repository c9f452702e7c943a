"""The pages of the web book: each is a single file, and none needs a network.

build.py hands over the notebooks and writes the pages.  nbconvert renders the cells; here are the
page around them, the links within the book, and the formulas: LaTeX becomes MathML, which browsers
draw by themselves.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from html import escape
from pathlib import Path

from bs4 import BeautifulSoup
from latex2mathml.converter import convert
from nbconvert import HTMLExporter
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath, MathInlineParser
from nbformat import NotebookNode
from pygments.formatters import HtmlFormatter

ROOT = Path(__file__).resolve().parents[1]
GOALS = "**After this notebook you can**"
Neighbour = tuple[str, str] | None  # file and title of the page before or after

# --- Markdown ---


def mathml(tex: str, display: str) -> str:
    r"""Turn LaTeX into MathML, `display` being "inline" or "block".

    The converter hands on what it does not know, and takes some operators for identifiers.
    """
    try:
        # It knows {aligned} by the name {split}, and no \_ within \text.
        result = convert(tex.replace("{aligned}", "{split}"), display=display).replace(r"\_", "_")
    except Exception as error:
        raise ValueError(f"cannot convert the formula {tex!r}: {error!r}") from error
    unknown = re.findall(r"\\\w+|<mi>&</mi>", result)
    braces = re.sub(r"\\[{}]", "", tex)
    if unknown or braces.count("{") != braces.count("}"):
        reason = " ".join(unknown) or "unbalanced braces"
        raise ValueError(f"cannot convert the formula {tex!r}: {reason}")
    return re.sub(r"<mi>(&#x0(?:2A..|27F.|00B1|007E);)</mi>", r"<mo>\1</mo>", result)


class Inline(MathInlineParser):
    """Dollars enclose a formula if no space is inside and no digit follows: $5 is an amount."""

    SPECIFICATION = MathInlineParser.SPECIFICATION | {
        "inline_math_tex": r"(?<![$\\])\$(?=\S)(?P<math_inline_tex>[^$`]+?)(?<=[^\s\\])\$(?![\d$])"
    }


class Renderer(IPythonRenderer):
    """What a page of the book needs besides nbconvert's own rendering of Markdown."""

    def inline_math(self, body: str) -> str:
        """Render $...$."""
        return mathml(body, "inline")

    def block_math(self, body: str) -> str:
        """Render $$...$$."""
        return mathml(body, "block")

    def latex_environment(self, name: str, body: str) -> str:
        r"""Render \begin{name}...\end{name} outside of dollars."""
        return mathml(rf"\begin{{{name}}}{body}\end{{{name}}}", "block")

    def block_html(self, html: str) -> str:
        """Leave a fold open: its answer is Markdown and ends with a block of its own."""
        return html if re.match("</?details", html) else super().block_html(html)

    def heading(self, text: str, level: int, **attrs: object) -> str:
        """Give a heading an anchor; that of an exercise is its number."""
        words = re.sub(r"<[^>]*>", "", text).lower()
        exercise = re.match(r"exercise \d+", words)
        anchor = re.sub(r"[^\w -]", "", exercise[0] if exercise else words).replace(" ", "-")
        return f'<h{level} id="{anchor}">{text}</h{level}>\n'

    def codespan(self, text: str) -> str:
        """Let a long name break after its parts."""
        return re.sub(r"(::|[_./])(?=[^<]*</code>)", r"\1<wbr>", super().codespan(text))

    def table(self, text: str) -> str:
        """Let a wide table scroll by itself."""
        return f'<div class="table" tabindex="0"><table>{text}</table></div>\n'

    def link(self, text: str, url: str, title: str | None = None) -> str:
        """Link to the web and to pages of the book; the project's other files are not in it."""
        page = re.fullmatch(
            r"(?:\.\./|notebooks/)*(README|paper|\d\d_\w+)\.(?:md|ipynb|py)(#.*)?", url
        )
        if page:
            url = f"{page[1].lower()}.html{page[2] or ''}"
        return super().link(text, url, title) if page or re.match("#|https?:", url) else text


def markdown(source: str, folder: Path = ROOT / "notebooks") -> str:
    """Render Markdown; pictures from files in the folder are embedded."""
    renderer = Renderer(escape=False, embed_images=True, path=str(folder))
    return MarkdownWithMath(renderer, inline=Inline()).render(source)


# --- notebooks ---


class Exporter(HTMLExporter):
    """The cells of a notebook without prompts.

    Checks are folded away above a link to the solution, code tagged "hide-input" above what it
    shows.
    """

    exclude_input_prompt = exclude_output_prompt = True
    raw_template = """{% extends "basic/index.html.j2" %}
{% block input %}{% if cell.metadata.solution %}
<details class="code"><summary>The check of this exercise</summary>{{ super() }}</details>
<p><a href="{{ cell.metadata.solution }}">Solution</a></p>
{% elif "hide-input" in cell.metadata.get("tags", []) %}
<details class="code"><summary>The code of this cell</summary>{{ super() }}</details>
{% else %}{{ super() }}{% endif %}{% endblock %}"""

    def markdown2html(self, source: str) -> str:
        """Render Markdown as elsewhere in the book."""
        return markdown(source)


def render(name: str, notebook: NotebookNode) -> str:
    """Render the cells of a notebook."""
    checks = (cell for cell in notebook.cells if "check" in cell.metadata.get("tags", []))
    for k, cell in enumerate(checks, 1):
        cell.metadata["solution"] = f"{name}_solutions.html#exercise-{k}"
    try:
        return Exporter().from_notebook_node(notebook)[0]
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def title_of(source: str) -> str:
    """Return the first heading of a Markdown text."""
    return source.splitlines()[0].strip("# ")


def contents(notebooks: dict[str, NotebookNode]) -> str:
    """List the chapters, each with what a reader can do after it."""
    items = ["<h2>Chapters, and what you can do after each</h2>"]
    for name, notebook in notebooks.items():
        first = notebook.cells[0].source
        goals = first.partition(GOALS)[2].partition("**Covers**")[0]
        bullets = "\n".join(re.findall(r"^[-*] .*(?:\n .*)*", goals, re.MULTILINE))
        items.append(f'<h3><a href="{name}.html">{escape(title_of(first))}</a></h3>')
        items.append(markdown(bullets))
    return "\n".join(items)


# --- pages ---


def make_pages(
    notebooks: dict[str, NotebookNode], solutions: dict[str, NotebookNode]
) -> dict[str, str]:
    """Return the pages of the book by file name: contents, chapters, paper.md, README, solutions."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    chapters = [
        (f"{name}.html", title_of(notebook.cells[0].source), render(name, notebook))
        for name, notebook in notebooks.items()
    ]
    opening = markdown(readme.partition("\n## ")[0], ROOT)
    chapters.insert(0, ("index.html", title_of(readme), opening + contents(notebooks)))
    paper = (ROOT / "notebooks" / "paper.md").read_text(encoding="utf-8")
    chapters.append(("paper.html", title_of(paper), markdown(paper)))
    chapters.append(("readme.html", "The project", markdown(readme, ROOT)))
    pages = {}
    for i, (file, title, body) in enumerate(chapters):
        before, after = chapters[:i][-1:], chapters[i + 1 :][:1]
        pages[file] = page(
            title, body, *(near[0][:2] if near else None for near in (before, after))
        )
    for name, notebook in solutions.items():
        chapter = title_of(notebooks[name].cells[0].source)
        title = f"Solutions to {chapter}"
        body = f"<h1>{escape(title)}</h1>\n{render(f'solutions/{name}', notebook)}"
        pages[f"{name}_solutions.html"] = page(title, body, (f"{name}.html", chapter), None)
    return pages


def page(title: str, body: str, before: Neighbour, after: Neighbour) -> str:
    """Wrap a body in a page that needs no other file."""
    soup = BeautifulSoup(body, "html.parser")
    parts = [(part["id"], part.get_text()) for part in soup.find_all("h2", id=True)]
    links = "".join(f'<li><a href="#{anchor}">{escape(text)}</a></li>' for anchor, text in parts)
    on_page = f'<nav aria-label="On this page"><ul>{links}</ul></nav>' if links else ""
    turn = ""
    if before:
        turn += f'<a rel="prev" href="{before[0]}">← {escape(before[1])}</a>'
    if after:
        turn += f'<a rel="next" href="{after[0]}">{escape(after[1])} →</a>'
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{escape(title)}</title>
<link rel="icon" href="data:,">
<style>{style()}</style>
</head>
<body>
<a class="skip" href="#main">Skip to the text</a>
<header><a href="index.html">Contents</a>{on_page}</header>
<main id="main">
{soup}
</main>
<footer><nav aria-label="Chapters" class="turn">{turn}</nav></footer>
</body>
</html>
"""


def loads(html: str) -> list[str]:
    """List what a browser would fetch besides the page."""
    soup = BeautifulSoup(html, "html.parser")
    sources = [
        tag[key]
        for tag in soup.find_all(True)
        for key in ("src", "srcset", "poster", "data", "href", "xlink:href", "background")
        if tag.get(key) and not (tag.name == "a" and key == "href")
    ]
    css = [tag.get_text() for tag in soup.find_all("style")]
    css += [tag["style"] for tag in soup.find_all(style=True)]
    for text in css:
        sources += re.findall(r"""(?:url\(|@import)\s*["']?([^"')\s;]+)""", text)
    return [source for source in sources if not source.startswith(("data:", "#"))]


def flaws(pages: dict[str, str]) -> Iterator[str]:
    """Find pages that load anything, and links within the book that lead nowhere."""
    targets = set(pages)
    for file, html in pages.items():
        yield from (f"{file} loads {source}" for source in loads(html))
        targets |= {f"{file}#{anchor}" for anchor in re.findall(r'\bid="([^"]+)"', html)}
    for file, html in pages.items():
        for url in re.findall(r'<a [^>]*?\bhref="([^"]+)"', html):
            if "://" not in url and (file + url if url.startswith("#") else url) not in targets:
                yield f"{file} links to {url}, which is not in the book"


# --- looks ---

# The browser, too, is told to fetch nothing.
POLICY = (
    "default-src 'none'; img-src data:; media-src data:; font-src data:; frame-src data:; "
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)


def style() -> str:
    """Return the style sheet; code in colours of contrast 4.5 and more on both backgrounds."""
    light, dark = (
        "\n".join(rule for rule in rules.splitlines() if rule.startswith(".highlight ."))
        for rules in (
            HtmlFormatter(style=name).get_style_defs(".highlight")
            for name in ("xcode", "github-dark")
        )
    )
    return f"{SHAPE}{light}\n@media screen and (prefers-color-scheme: dark) {{{DARK}{dark}\n}}"


DARK = """
:root { --text: #e4e8ec; --paper: #14181c; --soft: #1f262d; --line: #47525d; --link: #7cbcff; }
.output_png img, p > img { filter: brightness(0.9); }
"""

SHAPE = """
:root { --text: #1b1f24; --paper: #fff; --soft: #f4f6f8; --line: #c8d0d8; --link: #0b57a4; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--text); overflow-wrap: break-word;
  font: 1.0625rem/1.6 system-ui, "Segoe UI", "Helvetica Neue", Arial, sans-serif; }
header, main, footer { max-width: 54rem; margin: 0 auto; padding: 0.75rem 1.25rem; }
a { color: var(--link); text-underline-offset: 0.15em; }
:focus-visible { outline: 3px solid var(--link); }
.skip { position: absolute; left: -99rem; }
.skip:focus { left: 1rem; top: 0.5rem; padding: 0.25rem 0.5rem; background: var(--paper); }
header { font-size: 0.9rem; border-bottom: 1px solid var(--line); }
header ul { list-style: none; margin: 0.25rem 0 0; padding: 0; }
header li { display: inline-block; margin-right: 1.25rem; }
h1, h2, h3 { line-height: 1.25; margin: 2.2em 0 0.6em; }
h1 { font-size: 1.9rem; margin-top: 1rem; }
h2 { font-size: 1.4rem; }
h3 { font-size: 1.1rem; }
p, ul, ol { max-width: 46rem; }
header ul { max-width: none; }
img { max-width: 100%; height: auto; }
.output_png img, .output_html, p > img { background: #fff; border-radius: 4px; }
.output_html { color: #1b1f24; color-scheme: light; }
code, pre { font: 0.875em/1.5 ui-monospace, "Cascadia Mono", Menlo, Consolas, "DejaVu Sans Mono",
  monospace; }
:not(pre) > code { background: var(--soft); padding: 0.1em 0.3em; border-radius: 3px; }
pre { margin: 0; padding: 0.75rem 1rem; overflow-x: auto; font-size: 0.82rem; }
.input pre, div.highlight pre, main > pre { background: var(--soft); border-radius: 4px; }
main > pre, .cell { margin: 1rem 0; }
.output_area, .table { overflow-x: auto; margin: 0.5rem 0; }
.output_text { border-left: 4px solid var(--line); }
table { border-collapse: collapse; font-size: 0.9rem; }
th, td { border: 1px solid var(--line); padding: 0.3rem 0.6rem; vertical-align: top; }
th { background: var(--soft); text-align: left; }
math { font-family: "STIX Two Math", "Cambria Math", "Latin Modern Math", "Libertinus Math",
  "TeX Gyre Termes Math", "DejaVu Math TeX Gyre", math; }
math[display="block"] { overflow-x: auto; overflow-y: hidden; padding: 0.4em 0; }
[mathvariant^="bold"] { font-weight: bold; }
[mathvariant="bold"], [mathvariant="sans-serif"] { text-transform: none; }
[mathvariant="sans-serif"] { font-family: sans-serif; }
mtable[displaystyle="true"] { math-style: normal; }
mtable[columnspacing="0em"] > mtr > mtd { padding-left: 0; padding-right: 0; }
mtd[columnalign="left"] { text-align: left; }
mtd[columnalign="right"] { text-align: right; }
summary { cursor: pointer; margin: 0.5rem 0; color: var(--link); }
.turn { display: flex; flex-wrap: wrap; gap: 0.5rem 2rem; justify-content: space-between;
  border-top: 1px solid var(--line); padding: 1rem 0 2rem; }
.turn a[rel="next"] { margin-left: auto; text-align: right; }
@media print {
  header, footer, .skip, .code { display: none; }
  #the-sheet, #recall { break-before: page; }
  main { max-width: none; }
  body { font-size: 10pt; line-height: 1.35; }
  h2 { margin-top: 1em; }
  th, td { padding: 0.1rem 0.5rem; }
  pre { white-space: pre-wrap; }
  .output_png, tr { break-inside: avoid; }
  h2, h3 { break-after: avoid; }
}
"""
