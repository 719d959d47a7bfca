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
def test_links_are_files(site: Path) -> None:
    """Lessons, documents and their headings are where links say."""
    names = {path.relative_to(site).as_posix() for path in site.rglob("*.html")}
    assert names >= {"index.html", f"{NAME}.html", "docs/choosing.html"}
    for path in site.rglob("*.html"):
        page = path.read_text(encoding="utf-8")
        for address in re.findall(r'<a [^>]*?href="([^"]*)"', page):
            file, _, anchor = address.partition("#")
            if re.match(r"[a-z]+:", address):
                continue
            target = path.parent / file if file else path
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
    size = {"width": 390, "height": 800}
    with browser.new_context(viewport=size, color_scheme="dark") as context:
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

pn.extension(inline=True)
slider = pn.widgets.IntSlider(label="n", start=1, end=4, value=1)
word = pn.widgets.TextInput(label="word", value="ab")
times = pn.bind(lambda n: f"{n} times", slider.param.value_throttled)
"""


@pytest.mark.slow
def test_controls_without_answers(
    builder: ModuleType, tmp_path: Path, visit: Open
) -> None:
    """A text field is off, with a word about it; a throttled slider works."""
    cells = [
        nbformat.v4.new_markdown_cell("# One\n\n**The question**: two?\n\nThree."),
        nbformat.v4.new_code_cell(CONTROLS),
        nbformat.v4.new_code_cell("pn.Column(slider, times)"),
        nbformat.v4.new_code_cell("pn.Column(word)"),
    ]
    nbformat.write(nbformat.v4.new_notebook(cells=cells), tmp_path / "01_one.ipynb")
    builder.write_assets(tmp_path)
    builder.write_lesson(tmp_path / "01_one.ipynb", tmp_path, "", "")
    page = visit(tmp_path / "01_one.html")
    assert page.locator(".told").count() == 1
    assert page.locator("input[type=text]").is_disabled()
    page.locator(".noUi-handle").press("ArrowRight")
    page.get_by_text("2 times").wait_for()
