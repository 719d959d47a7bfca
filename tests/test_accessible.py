"""Every page for those who do not see it well, or work it without a mouse.

axe-core, the usual set of rules for accessible pages, looks at each page in both
colour schemes and on a phone; a walk by Tab and Enter alone reaches every control.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import pytest
from conftest import Open, Server, settled, slide, watched
from playwright.sync_api import Browser, Page, expect

from apps.pages.bar import FAULT
from nmss_lab.plots import STYLES, Chart, ChartFigure, EnsembleFigure, PoleFigure

ROOT = Path(__file__).resolve().parent.parent
AXE = files("axe_playwright_python").joinpath("axe.min.js").read_text("utf-8")

PLAYED = "window.nmssPlayer?.frames > 0"
READY = {
    "": "document.querySelector('main [data-root-id] *')",
    "workbench": "window.nmssWorkbench?.states()[1] === 'done'"
    " && !nmssWorkbench.running()",
    "receding_horizon": PLAYED,
    "structures": "window.nmssSheet?.rows() > 0",
    "governor": PLAYED,
    "disturbances": PLAYED,
    "identify": "window.nmssIdentify?.rows() > 0 && !nmssIdentify.running()",
    "tune": "window.nmssTune?.idle()",
    "state_dependent": PLAYED,
    "robustness": "window.nmssStudy?.shown() > 0 && !nmssStudy.running()",
}
"""When a page shows its first figure, in JavaScript, by path."""

DEEP = """
  const all = (root = document) => [...root.querySelectorAll("*")]
    .flatMap((node) => [node, ...node.shadowRoot ? all(node.shadowRoot) : []])
"""
"""All elements of a page in their order, shadow trees included."""


@pytest.fixture
def visit(server: Server, browser: Browser) -> Iterator[Open]:
    """Yield a function that opens a page; nothing may complain or call away."""
    with watched(server, browser, "document.body") as open_page:
        yield open_page
    assert server.faults() == []


def opened(visit: Open, path: str, **more: Any) -> Page:
    """Open a page and wait for its first figure."""
    return visit(path, until=READY[path.partition("?")[0]], **more)


# --- The rules of axe-core ------------------------------------------------------------


def findings(page: Page) -> list[str]:
    """Break which rules, how badly, and where."""
    return list(
        page.evaluate(
            """async () => {
              const { violations } = await axe.run({ resultTypes: ["violations"] })
              return violations.flatMap(({ id, impact, nodes }) =>
                nodes.map(({ html }) => `${impact}: ${id}: ${html.slice(0, 200)}`))
            }"""
        )
    )


def turn(page: Page, theme: str, width: int) -> None:
    """Put a page into a colour scheme, at a width."""
    page.set_viewport_size({"width": width, "height": 900})
    page.evaluate(
        "(theme) => { if (document.documentElement.dataset.theme !== theme)"
        " document.querySelector('.theme').click() }",
        theme,
    )
    page.evaluate("new Promise(requestAnimationFrame)")


def menu(page: Page, name: str) -> None:
    """Open one of the bar's menus, which closes the others."""
    page.locator(".designs summary", has_text=name).click()


@pytest.mark.parametrize("path", READY)
def test_no_rule_is_broken(visit: Open, path: str) -> None:
    """With all panels open, light and dark, at a desk and on a phone."""
    page = opened(visit, path)
    page.evaluate(
        f"() => {{ {DEEP}; for (const node of all())"
        " if (node.matches('details:not(.menu)')) node.open = true }"
    )
    page.evaluate(AXE)
    for theme, width, name in (
        ("light", 1440, "A:"),
        ("dark", 1440, "B:"),
        ("dark", 390, "File"),
        ("light", 390, "File"),
    ):
        turn(page, theme, width)
        if path:
            menu(page, name)
        assert findings(page) == [], (theme, width)


def test_broken_rules_are_found(visit: Open) -> None:
    """A label that is lost, and words too pale, deep in the shadow trees."""
    page = opened(visit, "receding_horizon")
    page.evaluate(AXE)
    page.locator("label[for=choice-Np]").evaluate("(label) => label.remove()")
    page.locator("#choice-Np-help").evaluate("(p) => { p.style.color = '#ccc' }")
    found = [one.split(": ")[:2] for one in findings(page) if "choice-Np" in one]
    assert sorted(found) == [
        ["critical", "label"],
        ["serious", "color-contrast"],
        ["serious", "label-title-only"],
    ]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize(
    "words", [{"errormessage": "wrong"}, {"LOGIN_ENDPOINT": "/login"}], ids=str
)
def test_entrance_breaks_no_rule(
    browser: Browser, scheme: Any, words: dict[str, str]
) -> None:
    """The page for name and password, refused, and the one after signing out."""
    source = (ROOT / "apps" / "entrance.html").read_text(encoding="utf-8")
    with browser.new_context(color_scheme=scheme) as context:
        page = context.new_page()
        page.set_content(jinja2.Template(source).render(words))
        page.evaluate(AXE)
        assert findings(page) == []


# --- By keyboard alone ----------------------------------------------------------------

FOCUSED = """() => {
  let node = document.activeElement
  while (node.shadowRoot?.activeElement) node = node.shadowRoot.activeElement
  if (node === document.body) return null
  const { outlineStyle, outlineWidth } = getComputedStyle(node)
  const ring = outlineStyle === "none" ? 0 : parseFloat(outlineWidth)
  window.walked = [...window.walked ?? [], node]
  return { name: node.ariaLabel || node.name || node.textContent, ring }
}"""

MISSED = (
    "() => {"
    + DEEP
    + """
  const reached = (node) => node.checkVisibility({ visibilityProperty: true })
    && node.matches("a[href], button, input, select, summary, [tabindex]")
    && !node.disabled && node.tabIndex >= 0
    && (node.type !== "radio" || node.checked)
  const wanted = all().filter(reached)
  return wanted.map((node, i) => node === walked[i] ? "" : node.outerHTML)
    .concat(walked.slice(wanted.length).map((node) => node.outerHTML)).filter(Boolean)
}"""
)
"""Controls that a walk did not reach in the order in which they stand."""


def go_to(page: Page, name: str) -> None:
    """Press Tab until a control has the focus, by its name or its beginning."""
    for _ in range(150):
        page.keyboard.press("Tab")
        now = page.evaluate(FOCUSED)
        if now and now["name"].startswith(name):
            return
    pytest.fail(f"Tab does not lead to {name}")


@pytest.mark.parametrize("path", READY)
def test_tab_leads_everywhere(visit: Open, path: str) -> None:
    """Once around a page, in its order, with the focus seen at each stop."""
    page = opened(visit, path)
    faint = []
    for _ in range(150):
        page.keyboard.press("Tab")
        now = page.evaluate(FOCUSED)
        if now is None:
            break
        if now["ring"] < 2:
            faint.append(now["name"])
    else:
        pytest.fail("the focus never leaves the page")
    assert faint == []
    assert page.evaluate(MISSED) == []


ACTS = {
    "workbench": ("Do this step: Structure", "nmssWorkbench.states()[2] === 'done'"),
    "receding_horizon": ("Play", "nmssPlayer.playing"),
    "structures": ("Settling", "true"),
    "governor": ("Play", "nmssPlayer.playing"),
    "disturbances": ("Play", "nmssPlayer.playing"),
    "identify": ("Search", "nmssIdentify.finished > 1"),
    "tune?most=100": ("Tune", "nmssTune.finished > 0"),
    "state_dependent": ("Look into this sample", "nmssForm.latency.length > 0"),
    "robustness": ("No.", "nmssStudy.picked() !== null"),
}
"""What each page is for: a control, and what is so once it was pressed."""


@pytest.mark.parametrize("path", ACTS)
def test_a_page_is_worked_by_keys(visit: Open, path: str) -> None:
    """A menu opens and closes, the page's own act is done, a choice made and undone."""
    page = opened(visit, path)
    go_to(page, "File")
    page.keyboard.press("Enter")
    link = page.get_by_role("button", name="Copy the link")
    expect(link).to_be_visible()
    go_to(page, "Copy the link")
    page.keyboard.press("Escape")
    expect(link).to_be_hidden()
    assert page.evaluate(FOCUSED)["name"] == "File"
    control, done = ACTS[path]
    go_to(page, control)
    page.keyboard.press("Enter")
    page.wait_for_function(done, timeout=60_000)
    slider = page.locator(".choices input[type=range]:visible").first
    before = slider.input_value()
    go_to(page, str(slider.get_attribute("name")))
    page.keyboard.press("ArrowRight")
    settled(page)
    assert slider.input_value() != before
    page.keyboard.press("Control+z")
    settled(page)
    assert slider.input_value() == before


# --- Ends of sliders ------------------------------------------------------------------


@pytest.mark.parametrize(
    "path",
    ["workbench", "structures", "identify", "tune", "state_dependent", "robustness"],
)
def test_every_slider_to_both_ends(visit: Open, path: str) -> None:
    """A page answers at both ends of each slider, or says in words why it cannot.

    Other pages have tests of their own for this.
    """
    page = opened(visit, path)
    alert = page.get_by_role("alert").first
    sliders = page.locator(".choices input[type=range]:visible")
    for name in sliders.evaluate_all("(found) => found.map((one) => one.name)"):
        slider = page.locator(f"input[name={name}]")
        start = slider.input_value()
        for end in ("min", "max"):
            slide(page, name, end)
            expect(alert).not_to_contain_text(FAULT)
        slider.fill(start)
        settled(page)
    page.get_by_role("button", name="Reset all choices").click()
    settled(page)
    expect(page.locator(".wrong")).to_have_count(0)


# --- Without colours ------------------------------------------------------------------


@pytest.mark.parametrize("kind", [ChartFigure, EnsembleFigure, PoleFigure])
def test_curves_differ_by_more_than_colour(kind: type[ChartFigure]) -> None:
    """Curves of one figure have dashes of their own, points their own markers."""
    looks: dict[str, list[object]] = {}
    for renderer in kind(Chart("a", "a", "a", ())).figure.renderers:
        glyph, name = renderer.glyph, renderer.name or ""
        look = getattr(glyph, "marker", None) or getattr(glyph, "line_dash", None)
        if name[:-1] in ("style", "points", "ring", "nominal", "picked"):
            looks.setdefault(name[:-1], []).append(look)
    assert looks
    for name, own in looks.items():
        assert len({str(look) for look in own}) == len(own) == len(STYLES), name
