"""The book: its links lead somewhere, sliders show the modules' numbers, nothing is fetched.

For what a browser shows, Chromium and its driver must be on the system; selenium (the extra
`browser`) downloads nothing here.  What keyboards, screen readers, paper and pages without scripts
get is looked at, too.
"""

import importlib
import json
import re
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from modelselect import pareto_front, solve

pytestmark = [pytest.mark.unmutated, pytest.mark.no_cover]
NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
PROGRAMS = ("chromium", "chromium-browser", "google-chrome"), ("chromedriver",)


@pytest.fixture(scope="module")
def tool():
    """Import a build script."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(NOTEBOOKS)
        yield importlib.import_module


@pytest.fixture(scope="module")
def sliders(tool):
    return tool("sliders")


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    found = [next(filter(None, map(shutil.which, names)), None) for names in PROGRAMS]
    if None in found:
        pytest.skip("no Chromium, or no chromedriver, on this system")
    options = webdriver.ChromeOptions()
    options.binary_location = found[0]
    for switch in ("--headless=new", "--no-sandbox", "--window-size=1000,900"):
        options.add_argument(switch)
    options.add_argument("--host-resolver-rules=MAP * ~NOTFOUND")  # no network
    options.add_argument(f"--user-data-dir={tmp_path_factory.mktemp('profile')}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(found[1]))
    driver.get("about:blank")  # ends what the browser's own first page fetches
    yield driver
    driver.quit()


def visit(browser, path):
    """Open a page, and wait until all of it is there, which a driver under load does not."""
    browser.get(path.as_uri())
    waits = importlib.import_module("selenium.webdriver.support.ui").WebDriverWait(browser, 60)
    waits.until(lambda page: page.execute_script("return document.readyState") == "complete")


@pytest.fixture(scope="module")
def pages(tool):
    """Return what makes the book from the committed notebooks, once it is asked for."""
    for needed in ("jupytext", "latex2mathml", "nbclient", "nbconvert"):
        pytest.importorskip(needed)
    return cache(tool("build").pages)


@pytest.fixture(scope="module")
def book(browser, pages, tmp_path_factory):
    """Write the book into a folder."""
    folder = tmp_path_factory.mktemp("book")
    for file, html in pages().items():
        (folder / file).write_text(html, encoding="utf-8")
    return folder


# --- without a browser ---


def loads(html: str) -> list[str]:
    """List what a browser would fetch besides the page."""
    soup = pytest.importorskip("bs4").BeautifulSoup(html, "html.parser")
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


def dead_links(pages: dict[str, str]) -> list[str]:
    """List the links within the book that lead nowhere."""
    targets = set(pages)
    for file, html in pages.items():
        targets |= {f"{file}#{anchor}" for anchor in re.findall(r'\bid="([^"]+)"', html)}
    return [
        f"{file} links to {url}"
        for file, html in pages.items()
        for url in re.findall(r'<a [^>]*?\bhref="([^"]+)"', html)
        if "://" not in url and (file + url if url.startswith("#") else url) not in targets
    ]


def test_no_page_loads_anything_and_each_link_leads_somewhere(pages):
    assert not {file: found for file, html in pages().items() if (found := loads(html))}
    assert not dead_links(pages())


def raw_markup(html: str) -> list[str]:
    """List what is left of formulas and Markdown in the text of a page."""
    soup = pytest.importorskip("bs4").BeautifulSoup(html, "html.parser")
    for tag in soup.find_all(["code", "pre", "script", "style"]):
        tag.decompose()
    return re.findall(r"\$.*|\\\w+|\*\*.*", soup.get_text())


def test_every_formula_is_drawn(pages):
    assert not {file: found for file, html in pages().items() if (found := raw_markup(html))}
    assert raw_markup("<p>$a</p><ul><li>b$</li></ul>")  # cut in two by a line that opens a list


@pytest.mark.parametrize(
    "html",
    [
        '<script src="https://x.org/a.js"></script>',
        "<img src=//x.org/a.png>",
        '<img src="figures/a.png">',
        '<link rel="stylesheet" href="http://x.org/a.css">',
        "<style>@import 'https://x.org/a.css';</style>",
        '<p style="background: url(https://x.org/a.png)">',
    ],
)
def test_a_page_that_loads_anything_is_found(html):
    assert loads(html)


def test_links_that_the_reader_may_follow_load_nothing():
    html = '<a href="https://x.org">x</a><a href="#here">y</a><p id="here"><img src="data:,">'
    assert not loads(html)
    assert not dead_links({"a.html": html})
    assert dead_links({"a.html": html.replace("#here", "#there")})


# --- pages in a browser ---


def complaints(browser, path: Path) -> list[str]:
    """Open a page; return what its console says and what it asks a network for."""
    for kind in ("browser", "performance"):
        browser.get_log(kind)
    visit(browser, path)
    said = [f"{entry['level']}: {entry['message']}" for entry in browser.get_log("browser")]
    events = (json.loads(entry["message"])["message"] for entry in browser.get_log("performance"))
    sent = [e["params"]["request"]["url"] for e in events if e["method"].endswith("BeSent")]
    assert path.as_uri() in sent  # the log is one of requests
    return said + [url for url in sent if not url.startswith(("data:", path.as_uri()))]


def test_every_page_opens_without_a_word_in_the_console_and_fetches_nothing(browser, book):
    pages = sorted(book.glob("*.html"))
    assert {"index.html", "play.html", "slides.html"} <= {path.name for path in pages}
    assert not {path.name: said for path in pages if (said := complaints(browser, path))}


@pytest.mark.parametrize(
    "html",
    [
        "<script>nothing.there()</script>",
        "<script>console.error('no')</script>",
        "<img src='http://localhost:9/x.png'>",
        "<script>fetch('https://example.org/').catch(() => {})</script>",
    ],
)
def test_an_error_and_a_fetch_would_be_found(browser, tmp_path, html):
    (tmp_path / "page.html").write_text(html)
    assert complaints(browser, tmp_path / "page.html")


# --- sliders ---


@pytest.fixture
def play(browser, book):
    visit(browser, book / "play.html")
    return browser


def put(play, panel: str, slider: int, place: int) -> None:
    """Move a slider as a hand on the keyboard does."""
    keys = importlib.import_module("selenium.webdriver").Keys
    play.find_element("id", f"{panel}-{slider}").send_keys(keys.HOME, keys.ARROW_RIGHT * place)


def facts(play, panel: str) -> dict[str, str]:
    output = play.find_element("id", f"{panel}-facts")
    names, values = (output.find_elements("tag name", tag) for tag in ("dt", "dd"))
    return {name.text: value.text for name, value in zip(names, values, strict=True)}


def drawn_models(play, panel: str, count: int) -> list[int]:
    """Read the schedule off its picture, in which models are rows from 373.8 up to 298.2."""
    path = play.find_element("css selector", f"#{panel} .stairs")
    heights = re.findall(r" ([\d.]+)", path.get_attribute("d"))[::2]  # each step has two ends
    return [round((373.8 - float(height)) / (373.8 - 298.2) * (count - 1)) for height in heights]


@pytest.mark.parametrize("place", [0, 5, 11, 15])
def test_alpha_to_beta_shows_the_optimum_of_the_landing(play, sliders, place):
    alpha, beta = sliders.RATIOS[place]
    problem = sliders.landing_problem(alpha, beta)
    best = solve(problem)
    put(play, "weights", 0, place)
    shown = facts(play, "weights")
    assert best.is_optimal and problem.alpha / problem.beta == pytest.approx(alpha / beta)
    assert shown["weighted total"] == shown["no schedule is below"] == f"{best.cost:,.0f}"
    assert shown["expected control cost of errors"] == sliders.number(
        problem.control_term(best.choices)
    )
    assert shown["perception cost"] == sliders.number(problem.perception_term(best.choices))
    assert drawn_models(play, "weights", 8) == best.choices.tolist()


@pytest.mark.parametrize(("bias", "noise"), [(0, 9), (3, 4), (10, 0), (5, 5)])
def test_bias_and_noise_show_their_optimum_and_its_spread(play, sliders, bias, noise):
    put(play, "errors", 0, bias)
    put(play, "errors", 1, noise)
    b, sd = bias / 10, (noise + 1) / 10
    problem = sliders.boat_problem(b, sd)
    best, M = solve(problem), problem.psi
    shown = facts(play, "errors")
    assert shown["mean square, biased and noisy"] == f"{b * b:.2f} and {sd * sd:.2f}"
    assert float(shown["cost of always biased"]) == pytest.approx(b * b * M.sum(), rel=5e-3)
    assert float(shown["cost of always noisy"]) == pytest.approx(sd * sd * np.trace(M), rel=5e-3)
    assert float(shown["cost of the optimum"]) == pytest.approx(best.cost, rel=5e-3)
    assert drawn_models(play, "errors", 2) == best.choices.tolist()
    assert play.find_elements("css selector", "#errors .band")


@pytest.mark.parametrize("place", [0, 4, 12])
def test_a_cost_of_switching_shows_fewer_switches(play, sliders, place):
    toll = sliders.TOLLS[place]
    best = solve(sliders.cart_problem(toll))
    put(play, "switching", 0, place)
    shown, switches = facts(play, "switching"), np.count_nonzero(np.diff(best.choices))
    assert shown["switches"] == f"{switches}, for {sliders.number(toll * switches)}"
    assert shown["total"] == shown["no schedule is below"] == f"{best.cost:.3g}"
    assert drawn_models(play, "switching", 4) == best.choices.tolist()


@pytest.mark.parametrize("budget", [0, 32, 72])
def test_a_budget_shows_the_best_within_it(play, sliders, budget):
    problem = sliders.budget_problem(budget)
    best = solve(problem)
    put(play, "budget", 0, budget)
    shown = facts(play, "budget")
    assert shown["spent"] == f"{problem.perception_term(best.choices):g} of {budget}"
    assert shown["control"] == sliders.number(best.cost)
    assert drawn_models(play, "budget", 4) == best.choices.tolist()


def panel_data(book, key: str) -> dict:
    html = (book / "play.html").read_text(encoding="utf-8")
    panel = html.partition(f'<div class="panel" id="{key}"')[2]
    return json.loads(re.search(r'<script type="application/json">(.*?)</script>', panel)[1])


def test_the_points_are_those_of_the_front_and_corners_those_of_weights(sliders):
    points = sorted(set(sliders.front()[1]))
    corners = sliders.corners(points)
    problem = replace(sliders.budget_problem(0), budget=None)
    for best in pareto_front(problem, resolution=9):
        assert (problem.perception_term(best.choices), pytest.approx(best.cost)) in points
    for weight in (0.001, 0.003, 0.02):  # of a unit spent, beside control
        best = solve(replace(problem, beta=weight)).choices
        assert problem.perception_term(best) in [x for x, _ in corners]
    assert len(corners) < len(points)


def test_every_position_keeps_its_own_optimum(book, sliders):
    for key in ("weights", "errors", "switching", "budget"):
        panel = panel_data(book, key)
        count = np.prod([len(values) for _, values, _ in panel["sliders"]])
        assert len(panel["frames"]) == count
    spent = [int(f["facts"]["spent"].split()[0]) for f in panel["frames"]]
    assert spent == sorted(spent) and all(x <= k for k, x in enumerate(spent))


def test_corners_lie_below_all_chords(sliders):
    points = [(0.0, 4.0), (1.0, 3.5), (2.0, 1.0), (3.0, 0.5), (4.0, 0.0)]
    assert sliders.corners(points) == [(0.0, 4.0), (2.0, 1.0), (4.0, 0.0)]


def test_what_is_not_proved_is_not_shown(sliders, monkeypatch):
    problem = sliders.boat_problem(0.3, 0.5)
    best = solve(problem)
    loose = replace(best, lower_bound=0.9 * best.cost, root_bound=None)
    monkeypatch.setattr(sliders.ms, "solve", lambda _: loose)
    monkeypatch.setattr(sliders.ms, "check_certificate", lambda *_: None)
    with pytest.raises(ValueError, match="a gap of 1"):
        sliders.proved(problem)


# --- without a mouse, eyes, scripts or a screen ---


def test_sliders_have_names_values_in_words_and_an_order(play):
    keys = importlib.import_module("selenium.webdriver").Keys
    order = ["errors-0", "errors-1"]
    first = play.find_element("id", order[0])
    assert first.aria_role == "slider" and first.accessible_name == "bias of the biased model"
    put(play, "errors", 0, 7)
    assert first.get_attribute("aria-valuetext") == "0.7 m/s"
    assert play.find_element("id", "errors-facts").aria_role == "status"  # spoken as it changes
    first.send_keys(keys.TAB)
    assert play.switch_to.active_element.get_attribute("id") == order[1]
    play.switch_to.active_element.send_keys(keys.TAB)
    button, table = play.switch_to.active_element, play.find_element("id", "errors-all")
    assert button.text == "All as a table" and not table.is_displayed()
    button.send_keys(keys.ENTER)
    assert table.is_displayed() and button.get_attribute("aria-expanded") == "true"
    picture = play.find_element("css selector", "#errors svg")
    assert "bias of the biased model 0.7 m/s" in picture.accessible_name


@pytest.mark.parametrize("way", ["paper", "no scripts"])
def test_on_paper_and_without_scripts_a_table_has_all(browser, book, way):
    scripts = "Emulation.setScriptExecutionDisabled"
    browser.execute_cdp_cmd(scripts, {"value": way == "no scripts"})
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print" * (way == "paper")})
    try:
        visit(browser, book / "play.html")
        assert not browser.find_element("id", "weights-0").is_displayed()
        for key, rows in (("weights", 16), ("errors", 11), ("switching", 13), ("budget", 73)):
            table = browser.find_element("id", f"{key}-all")
            assert table.is_displayed()
            assert len(table.find_elements("css selector", "th[scope=row]")) == rows
    finally:
        browser.execute_cdp_cmd(scripts, {"value": False})
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})


# --- slides ---


def test_every_figure_is_a_slide_that_arrow_keys_reach(browser, book, tool):
    keys = importlib.import_module("selenium.webdriver").Keys
    build = tool("build")
    cells = [cell for name in build.names() for cell in build.read_committed(name).cells]
    alts = [cell.metadata.alt for cell in cells if build.pictures(cell)]
    visit(browser, book / "slides.html")
    slides = browser.find_elements("class name", "slide")
    images = [slide.find_element("tag name", "img") for slide in slides]
    assert [image.get_attribute("alt") for image in images] == alts
    assert all(slide.find_element("tag name", "h2") for slide in slides)

    def seen() -> list[int]:
        return [k for k, slide in enumerate(slides) if slide.is_displayed()]

    def press(key: str) -> None:
        browser.switch_to.active_element.send_keys(key)

    assert seen() == [0]
    press(keys.ARROW_RIGHT)
    press(keys.ARROW_RIGHT)
    press(keys.ARROW_LEFT)
    assert seen() == [1]
    assert browser.switch_to.active_element.text == slides[1].find_element("tag name", "h2").text
    assert f"2 of {len(alts)}" in slides[1].text
    press(keys.END)
    press(keys.ARROW_RIGHT)
    assert seen() == [len(alts) - 1]
    browser.refresh()
    assert browser.find_elements("class name", "slide")[-1].is_displayed()
