"""The site of the lessons: whole without a network, linked, failing when they do."""

import importlib.util
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import nbformat
import pytest
from conftest import ROOT
from playwright.sync_api import Browser, Page

BUILD = ROOT / "docs" / "site" / "build.py"
NAME = "00_start_here"


@pytest.fixture(scope="module")
def builder() -> Iterator[ModuleType]:
    """Yield the script as a module."""
    spec = importlib.util.spec_from_file_location("lesson_site", BUILD)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site of the first lesson."""
    out = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, BUILD, NAME, "--out", out],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return out


# --- What is written --------------------------------------------------------------


@pytest.mark.slow
def test_no_other_host(site: Path) -> None:
    """Whatever a page loads lies in its own folder."""
    loads = r'<(?:script|img|iframe|link)\b[^>]*?(?:src|href)="([^"]*)"'
    for path in site.rglob("*.html"):
        page = path.read_text(encoding="utf-8")
        assert "//cdn." not in page
        for address in re.findall(loads, page):
            inside = address.startswith("data:") or (path.parent / address).is_file()
            assert inside, address
    for path in site.rglob("*.css"):
        style = path.read_text(encoding="utf-8")
        assert not re.search(r"@import|url\(.?(https?:|//)", style)


@pytest.mark.slow
def test_links_are_files(builder: ModuleType, site: Path) -> None:
    """Documents and their headings are where links say; so would be other lessons."""
    others = {builder.place(one.path) for one in builder.lessons()}
    names = {path.relative_to(site).as_posix() for path in site.rglob("*.html")}
    assert names >= {"index.html", f"{NAME}.html", "docs/choosing.html"}
    for path in site.rglob("*.html"):
        page = path.read_text(encoding="utf-8")
        for address in re.findall(r'<a [^>]*?href="([^"]*)"', page):
            file, _, anchor = address.partition("#")
            if re.match(r"[a-z]+:", address):
                continue
            target = (path.parent / file).resolve() if file else path
            if not target.is_file() and target.relative_to(site) in others:
                continue
            assert target.is_file(), address
            headings = target.read_text(encoding="utf-8") if anchor else ""
            assert not anchor or f'id="{anchor}"' in headings, address


@pytest.mark.slow
def test_link_between_lessons(builder: ModuleType, site: Path) -> None:
    """What a lesson calls ``00_start_here.ipynb`` is a page beside it."""
    renderer = builder.Renderer(builder.LESSONS / "08_state_dependent.ipynb")
    html = builder.text(f"You need [lesson 00]({NAME}.ipynb).", renderer)
    (address,) = re.findall('href="(.*?)"', html)
    assert (site / address).is_file()


def test_equations_are_kept(builder: ModuleType) -> None:
    """Signs of HTML and Markdown within equations stay what they are."""
    renderer = builder.Renderer(builder.LESSONS / f"{NAME}.ipynb")
    html = builder.text("$a_1 < b_1$ and $$x_{k} & y_{k} \\tag{1}$$", renderer)
    assert '<span class="math">a_1 &lt; b_1</span>' in html
    assert '<span class="math display">x_{k} &amp; y_{k} \\tag{1}</span>' in html


def test_no_line_begins_with_a_comma(builder: ModuleType) -> None:
    """An equation stays together with the brackets and marks around it."""
    renderer = builder.Renderer(builder.LESSONS / f"{NAME}.ipynb")
    html = builder.text("Here ($x$), there $y$ or $z$.", renderer)
    assert re.findall(r'<span class="whole">(.*?</span>.*?)</span>', html) == [
        '(<span class="math">x</span>),',
        '<span class="math">z</span>.',
    ]


def test_dashboard_is_told(builder: ModuleType) -> None:
    """A link that needs a server says so; others say nothing."""
    renderer = builder.Renderer(builder.LESSONS / f"{NAME}.ipynb")
    html = builder.text("[Tune](http://127.0.0.1:5006/tune?case=a)", renderer)
    assert re.search(r'href="http://127.0.0.1:5006/tune\?case=a" title=".*make s', html)
    assert "title" not in builder.text("[theirs](https://arxiv.org/)", renderer)


def test_missing_target_is_told(builder: ModuleType) -> None:
    """A link to nothing ends the run; folders and solutions are only named."""
    renderer = builder.Renderer(builder.LESSONS / f"{NAME}.ipynb")
    with pytest.raises(SystemExit, match=r"points to nowhere\.md"):
        builder.text("[there](nowhere.md)", renderer)
    assert "href" not in builder.text("[runs](../benchmarks)", renderer)
    named = builder.text("[answers](solutions/answers.py)", renderer)
    assert "href" not in named


def test_other_folders_are_kept(builder: ModuleType, tmp_path: Path) -> None:
    """Only a site that was written before is replaced."""
    (tmp_path / "mine.txt").write_text("kept", encoding="utf-8")
    with pytest.raises(SystemExit, match="something else"):
        builder.build([NAME], tmp_path, 1)
    assert (tmp_path / "mine.txt").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "says"),
    [("import warnings\nwarnings.warn('old')", "old"), ("1 / 0", "ZeroDivision")],
)
def test_failure_ends_the_run(
    builder: ModuleType, source: str, says: str, tmp_path: Path
) -> None:
    """A lesson that warns or fails gives no page."""
    lesson = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source)])
    nbformat.write(lesson, tmp_path / "01_broken.ipynb")
    with pytest.raises(RuntimeError, match=rf"(?s)01_broken.*{says}"):
        builder.write_lesson(tmp_path / "01_broken.ipynb", tmp_path, "", "")
    assert list(tmp_path.glob("*.html")) == []


# --- In the browser ---------------------------------------------------------------

Open = Callable[[Path], Page]


@pytest.fixture
def visit(browser: Browser) -> Iterator[Open]:
    """Yield a function that opens a page on a phone without network, in the dark."""
    said: list[str] = []
    phone = {"viewport": {"width": 390, "height": 800}, "has_touch": True}
    phone |= {"is_mobile": True, "color_scheme": "dark"}
    with browser.new_context(**phone) as context:
        context.set_offline(True)
        page = context.new_page()
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("requestfailed", lambda request: said.append(request.url))
        page.on(
            "console",
            lambda m: said.append(m.text) if m.type in ("error", "warning") else None,
        )

        def open_page(path: Path) -> Page:
            page.goto(path.as_uri())
            page.locator("html[data-fitted]").wait_for()
            return page

        yield open_page
    assert said == []


@pytest.fixture
def opened(site: Path, visit: Open) -> Page:
    """Return the lesson with all its figures drawn."""
    page = visit(site / f"{NAME}.html")
    for figure in page.locator(".drawn").all():
        figure.locator("canvas").first.wait_for()
    return page


@pytest.mark.slow
def test_page_works_offline(opened: Page) -> None:
    """Equations are typeset, figures drawn and movable, nothing sticks out."""
    formulas = opened.locator(".math").count()
    assert formulas > 15
    assert opened.locator(".math > mjx-container > svg").count() == formulas
    assert opened.locator("[data-mjx-error]").count() == 0
    assert opened.evaluate("document.documentElement.scrollWidth") == 390
    assert opened.locator(".drawn").count() == 8
    tools = opened.evaluate(
        "[...Bokeh.documents[0]._all_models.values()].map((model) => model.type)"
    )
    assert {"BoxZoomTool", "ResetTool"} <= set(tools)


@pytest.mark.slow
def test_finger_scrolls(opened: Page) -> None:
    """A finger that lands on a figure moves the page, not the figure."""
    opened.evaluate("document.querySelector('canvas, .drawn').scrollIntoView()")
    opened.wait_for_timeout(200)
    before = opened.evaluate("scrollY")
    hand = opened.context.new_cdp_session(opened)
    for kind, y in ("Start", 200), ("Move", 150), ("Move", 50), ("End", None):
        points = [{"x": 200, "y": y}] if y else []
        touch = {"type": f"touch{kind}", "touchPoints": points}
        hand.send("Input.dispatchTouchEvent", touch)
    opened.wait_for_function(f"scrollY > {before} + 50")


@pytest.mark.slow
def test_slider_answers(opened: Page) -> None:
    """A slider was asked beforehand, and moves the figure."""
    control = opened.locator(".drawn").filter(has=opened.locator(".noUi-handle"))
    before = control.screenshot()
    control.locator(".noUi-handle").press("ArrowLeft")
    opened.wait_for_timeout(500)
    assert control.screenshot() != before
    drawn = opened.evaluate(
        "Bokeh.documents.flatMap((doc) => [...doc._all_models.values()])"
        ".map((model) => model.label?.value).filter(Boolean)"
    )
    assert "R = 20000" in drawn
    assert opened.locator(".told").count() == 0


CONTROLS = """\
import panel as pn
from bokeh.plotting import figure

pn.extension(inline=True)
slider = pn.widgets.IntSlider(label="n", start=0, end=102, value=7)
share = pn.widgets.FloatSlider(label="share", start=0.1, end=1.0, step=0.3, value=1.0)
word = pn.widgets.TextInput(label="word", value="ab")
times = pn.bind(lambda n: f"{n} times", slider.param.value_throttled)
part = pn.bind(lambda x: f"{x} of it", share)
wide = figure(width=700)
wide.line([0, 1], [0, 1])
"""


@pytest.fixture(scope="module")
def controls(builder: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the page of a lesson about controls."""
    cells = [
        nbformat.v4.new_markdown_cell("# One\n\n**The question**: two?\n\nThree."),
        nbformat.v4.new_code_cell(CONTROLS),
        nbformat.v4.new_code_cell("pn.Column(slider, times)"),
        nbformat.v4.new_code_cell("pn.Column(share, part)"),
        nbformat.v4.new_code_cell("pn.Row(word, pn.pane.Bokeh(wide))"),
    ]
    out = tmp_path_factory.mktemp("controls")
    nbformat.write(nbformat.v4.new_notebook(cells=cells), out / "01_one.ipynb")
    builder.write_assets(out)
    builder.write_lesson(out / "01_one.ipynb", out, "", "")
    return out / "01_one.html"


@pytest.mark.slow
def test_controls_without_answers(controls: Path, visit: Open) -> None:
    """A text field is off, with a word about it; nothing is wider than a phone."""
    page = visit(controls)
    assert page.locator(".told").count() == 1
    assert page.locator("input[type=text]").is_disabled()
    page.locator("canvas").first.wait_for()
    page.wait_for_function(
        "[...document.querySelectorAll('.drawn')]"
        ".every((place) => place.scrollWidth <= place.clientWidth)"
    )


@pytest.mark.slow
def test_slider_has_its_ends(controls: Path, visit: Open) -> None:
    """A slider of many values stops at its ends, where it started, and in between."""
    page = visit(controls)
    handle = page.locator(".noUi-handle").first
    page.get_by_text("7 times", exact=True).wait_for()
    for key, answer in ("Home", 0), ("ArrowRight", 5), ("ArrowRight", 7), ("End", 102):
        handle.press(key)
        page.get_by_text(f"{answer} times", exact=True).wait_for()


@pytest.mark.slow
def test_slider_that_starts_at_its_end(controls: Path, visit: Open) -> None:
    """It can go back there, and says 0.7 and not 0.7000000000000001."""
    page = visit(controls)
    for key, answer in ("ArrowLeft", 0.7), ("ArrowRight", 1.0):
        page.locator(".noUi-handle").last.press(key)
        page.get_by_text(f"{answer} of it", exact=True).wait_for()
