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

import sliders

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
GOALS = "**After this notebook you can**"
SLIDES = "Slides: all figures"
Chapter = tuple[str, str, str]  # file, title and body of a page
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


def markdown(source: str, folder: Path = HERE) -> str:
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


def contents(notebooks: dict[str, NotebookNode], besides: list[Chapter]) -> str:
    """List the chapters, each with what a reader can do after it, and the pages after them."""
    items = ["<h2>Chapters, and what you can do after each</h2>"]
    for name, notebook in notebooks.items():
        first = notebook.cells[0].source
        goals = first.partition(GOALS)[2].partition("**Covers**")[0]
        bullets = "\n".join(re.findall(r"^[-*] .*(?:\n .*)*", goals, re.MULTILINE))
        items.append(f'<h3><a href="{name}.html">{escape(title_of(first))}</a></h3>')
        items.append(markdown(bullets))
    links = (f'<li><a href="{file}">{escape(title)}</a></li>' for file, title, _ in besides)
    return "\n".join([*items, "<h2>Besides</h2>", "<ul>", *links, "</ul>"])


def slides(name: str, notebook: NotebookNode) -> Iterator[str]:
    """Write a slide for every picture of a notebook, under the heading that it stands below."""
    heading = chapter = title_of(notebook.cells[0].source)
    pictures = 0
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            heading = [heading, *re.findall(r"^##+ (.*)", cell.source, re.MULTILINE)][-1]
            continue
        for data in (output.get("data", {}).get("image/png") for output in cell.outputs):
            if data:
                pictures += 1
                title = markdown(heading).strip().removeprefix("<p>").removesuffix("</p>")
                alt = escape(cell.metadata.alt)
                yield f"""<section class="slide" id="{name[:2]}-{pictures}">
<p><a href="{name}.html">{escape(chapter)}</a></p>
<h2 tabindex="-1">{title}</h2>
<figure><img src="data:image/png;base64,{data.strip()}" alt="{alt}">
<figcaption aria-hidden="true">{alt}</figcaption></figure>
</section>
"""


def slide_show(notebooks: dict[str, NotebookNode]) -> str:
    """Write the slides of all notebooks; slides.js shows one at a time, paper two a page."""
    script = (HERE / "slides.js").read_text(encoding="utf-8")
    shown = "".join(slide for pair in notebooks.items() for slide in slides(*pair))
    return f"""<h1>{SLIDES}</h1>
<p>Every figure of the notebooks. The arrow keys turn, Home and End lead to the first and the last;
printed, they are a sheet with two figures a page.</p>
<div class="turner"><button type="button">← Back</button><output aria-live="polite"></output>
<button type="button">On →</button></div>
{shown}<script>{script}</script>"""


# --- pages ---


def make_pages(
    notebooks: dict[str, NotebookNode], solutions: dict[str, NotebookNode]
) -> dict[str, str]:
    """Return the pages of the book by file name: contents, chapters, what is besides, solutions."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    chapters = [
        (f"{name}.html", title_of(notebook.cells[0].source), render(name, notebook))
        for name, notebook in notebooks.items()
    ]
    paper = (HERE / "paper.md").read_text(encoding="utf-8")
    besides = [
        ("play.html", sliders.TITLE, sliders.body()),
        ("slides.html", SLIDES, slide_show(notebooks)),
        ("paper.html", title_of(paper), markdown(paper)),
        ("readme.html", "The project", markdown(readme, ROOT)),
    ]
    opening = markdown(readme.partition("\n## ")[0], ROOT) + contents(notebooks, besides)
    chapters = [("index.html", title_of(readme), opening), *chapters, *besides]
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
    shape = (HERE / "book.css").read_text(encoding="utf-8")
    return f"{shape}{light}\n@media screen and (prefers-color-scheme: dark) {{{dark}\n}}"
