"""The pages of the web book: each is a single file, and none needs a network.

build.py hands over the notebooks and writes the pages.  nbconvert renders the cells; here are the
page around them, the links within the book, and the formulas: LaTeX becomes MathML, which browsers
draw by themselves.
"""

from __future__ import annotations

import re
from html import escape
from pathlib import Path

from latex2mathml.converter import convert
from nbconvert import HTMLExporter
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath
from nbformat import NotebookNode
from pygments.formatters import HtmlFormatter

import sliders

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
SLIDES = "Slides: all figures"
Neighbour = tuple[str, str] | None  # file and title of the page before or after


def read(path: Path) -> str:
    """Read a text."""
    return path.read_text(encoding="utf-8")


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


class Renderer(IPythonRenderer):
    """What a page of the book needs besides nbconvert's own rendering of Markdown."""

    def inline_math(self, body: str) -> str:
        """Render $...$."""
        return mathml(body, "inline")

    def block_math(self, body: str) -> str:
        """Render $$...$$."""
        return mathml(body, "block")

    def block_html(self, html: str) -> str:
        """Leave a fold open: its answer is Markdown and ends with a block of its own."""
        return html if re.match("</?details", html) else super().block_html(html)

    def heading(self, text: str, level: int, **attrs: object) -> str:
        """Give a heading the anchor that it has on GitHub."""
        anchor = re.sub(r"<[^>]*>|[^\w\s-]", "", text).lower().replace(" ", "-")
        return f'<h{level} id="{anchor}">{text}</h{level}>\n'

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
    return MarkdownWithMath(renderer).render(source)


# --- notebooks ---

# Checks are folded away above a link to the solution, code tagged "hide-input" above what it shows.
CELLS = """{% extends "basic/index.html.j2" %}
{% block input %}
{% set tags = cell.metadata.get("tags", []) %}
{% if "check" in tags %}
<details class="code"><summary>The check of this exercise</summary>{{ super() }}</details>
{% set number = cell.source.partition("Exercise ")[2][0] %}
<p><a href="{{ resources.solutions }}#exercise-{{ number }}">Solution</a></p>
{% elif "hide-input" in tags %}
<details class="code"><summary>The code of this cell</summary>{{ super() }}</details>
{% else %}{{ super() }}{% endif %}
{% endblock %}"""


def render(notebook: NotebookNode, solutions: str = "") -> str:
    """Render the cells of a notebook, whose solutions are on the page named."""
    exporter = HTMLExporter(
        raw_template=CELLS,
        exclude_input_prompt=True,
        exclude_output_prompt=True,
        filters={"markdown2html": markdown},
    )
    return exporter.from_notebook_node(notebook, {"solutions": solutions})[0]


def title_of(source: str) -> str:
    """Return the first heading of a Markdown text."""
    return source.splitlines()[0].strip("# ")


def pictures(cell: NotebookNode) -> list[NotebookNode]:
    """Return the outputs of a cell that are pictures."""
    return [out for out in cell.get("outputs", []) if "image/png" in out.get("data", {})]


def contents(notebooks: dict[str, NotebookNode]) -> str:
    """List the chapters, each with what a reader can do after it."""
    lines = ["## Chapters, and what you can do after each"]
    for name, notebook in notebooks.items():
        first = notebook.cells[0].source
        goals = first.partition("**After this notebook you can**")[2].partition("**Covers**")[0]
        lines.append(f"### [{title_of(first)}]({name}.ipynb)\n{goals}")
    return markdown("\n\n".join(lines))


def slide_show(notebooks: dict[str, NotebookNode]) -> str:
    """Write a slide for every picture, under the heading that it stands below."""
    figures = []
    for name, notebook in notebooks.items():
        heading = title_of(notebook.cells[0].source)
        source = f'<a href="{name}.html">{escape(heading)}</a>'
        for cell in notebook.cells:
            if cell.cell_type == "markdown":
                heading = [heading, *re.findall(r"^##+ (.*)", cell.source, re.MULTILINE)][-1]
            for picture in pictures(cell):
                data, alt = picture.data["image/png"].strip(), escape(cell.metadata.alt)
                figures.append((source, heading, data, alt))
    slides, count = [], len(figures)
    for k, (source, heading, data, alt) in enumerate(figures, 1):
        title = markdown(heading).strip().removeprefix("<p>").removesuffix("</p>")
        slides.append(f"""<section class="slide">
<p><a href="#{max(k - 1, 1)}">← Back</a> {k} of {count}
<a href="#{min(k + 1, count)}">On →</a> {source}</p>
<h2 tabindex="-1" id="{k}">{title}</h2>
<figure><img src="data:image/png;base64,{data}" alt="{alt}">
<figcaption aria-hidden="true">{alt}</figcaption></figure>
</section>""")
    return f"""<h1>{SLIDES}</h1>
<p>Every figure of the notebooks. The arrow keys turn, Home and End lead to the first and the last;
printed, they are a sheet with two figures a page.</p>
{"".join(slides)}<script>{read(HERE / "slides.js")}</script>"""


def with_sliders(source: str) -> str:
    """Write the page whose comments stand in the places of panels."""
    body = markdown(source)
    for key, panel in sliders.panels().items():
        body = body.replace(f"<!-- {key} -->", panel)
    return f"{body}<script>{read(HERE / 'sliders.js')}</script>"


# --- pages ---


def make_pages(
    notebooks: dict[str, NotebookNode], solutions: dict[str, NotebookNode]
) -> dict[str, str]:
    """Return the pages of the book by file name: contents, chapters, what is besides, solutions."""
    readme, paper, play = map(read, (ROOT / "README.md", HERE / "paper.md", HERE / "play.md"))
    titles = {name: title_of(notebook.cells[0].source) for name, notebook in notebooks.items()}
    chapters = [
        (f"{name}.html", titles[name], render(notebook, f"{name}_solutions.html"))
        for name, notebook in notebooks.items()
    ]
    besides = [
        ("play.html", title_of(play), with_sliders(play)),
        ("slides.html", SLIDES, slide_show(notebooks)),
        ("paper.html", title_of(paper), markdown(paper)),
        ("readme.html", "The project", markdown(readme, ROOT)),
    ]
    links = "".join(f'<li><a href="{file}">{escape(name)}</a></li>' for file, name, _ in besides)
    opening = markdown(readme.partition("\n## ")[0], ROOT) + contents(notebooks)
    opening += f'<h2 id="besides">Besides</h2><ul>{links}</ul>'
    bound = [("index.html", title_of(readme), opening), *chapters, *besides]
    turns = [None, *(chapter[:2] for chapter in bound), None]
    pages = {
        file: page(name, body, before, after)
        for (file, name, body), before, after in zip(bound, turns, turns[2:], strict=False)
    }
    for name, notebook in solutions.items():
        title, before = f"Solutions to {titles[name]}", (f"{name}.html", titles[name])
        body = f"<h1>{escape(title)}</h1>\n{render(notebook)}"
        pages[f"{name}_solutions.html"] = page(title, body, before, None)
    return pages


def page(title: str, body: str, before: Neighbour, after: Neighbour) -> str:
    """Wrap a body in a page that needs no other file, and that fetches nothing."""
    parts = re.findall(r'<h2 id="([^"]+)">(.*?)</h2>', body)
    links = "".join(f'<li><a href="#{anchor}">{text}</a></li>' for anchor, text in parts)
    on_page = f'<nav aria-label="On this page"><ul>{links}</ul></nav>' if links else ""
    turn = f'<a rel="prev" href="{before[0]}">← {escape(before[1])}</a>' if before else ""
    turn += f'<a rel="next" href="{after[0]}">{escape(after[1])} →</a>' if after else ""
    code = HtmlFormatter(style="xcode").get_style_defs(".highlight")
    style = code + read(HERE / "book.css")
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none';
img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<link rel="icon" href="data:,">
<style>{style}</style>
</head>
<body>
<a class="skip" href="#main">Skip to the text</a>
<header><a href="index.html">Contents</a>{on_page}</header>
<main id="main">
{body}
</main>
<footer><nav aria-label="Chapters" class="turn">{turn}</nav></footer>
</body>
</html>
"""
