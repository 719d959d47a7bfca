"""The live pages in a real browser, and the choices behind them without one."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import param
import pytest
from bokeh.document import Document
from conftest import REPLAY, Open, Server, picture, settled, slide
from panel.io.state import set_curdoc
from playwright.sync_api import expect

from apps.pages import governor, receding_horizon
from apps.pages.live import LivePage, Subject
from apps.session import HELD, Choices, GovernorChoices, LoopChoices, plain
from apps.work import Withdrawn
from nmss_lab.measures import table
from nmss_lab.plots import Chart, busiest_sample, draw, loop_charts, pack, sentences

PAGES = ["receding_horizon", "governor"]
SUBJECTS = [receding_horizon.SUBJECT, governor.SUBJECT]
QUICK = "case=governor_3_4"
"""A small case, so that tests of the form wait little."""

SLOW = "gasifier_6_3_4", "temperature_7_4_2"
"""Cases with many channels and samples: about a second a run at long horizons."""

# --- Choices, without a browser ----------------------------------------------------


def sliders(choices: Choices) -> Iterator[tuple[str, float, float]]:
    """Yield name and ends of every slider of a page."""
    for group in choices.description():
        for item in group["items"]:
            if item["kind"] in ("linear", "log"):
                yield item["name"], item["low"], item["high"]


@pytest.mark.parametrize("kind", [LoopChoices, GovernorChoices])
def test_every_choice_is_explained(kind: type[Choices]) -> None:
    """Each control has a label and one sentence of help, each slider has bounds."""
    choices = kind()
    shown = [item for group in choices.description() for item in group["items"]]
    assert {item["name"] for item in shown} | {"input", "output", *HELD} == set(
        kind.names()
    )
    for item in shown:
        assert item["label"]
        assert item["help"].endswith(".")
    assert all(low < high for _, low, high in sliders(choices))


@pytest.mark.parametrize("subject", SUBJECTS, ids=PAGES)
def test_every_case_opens(subject: Subject) -> None:
    """Each case can be shown as it is chosen, and says what to look at."""
    for name in subject.choices.cases():
        choices = subject.choices(case=name)
        runs = choices.runs()
        charts = subject.charts(runs, 0, 0)
        assert len(charts) == 5
        assert name in subject.look
        assert np.isfinite(pack(charts)["data"]).all()


@pytest.mark.parametrize(
    ("kind", "given"),
    [
        (LoopChoices, {"case": "governor_3_4"}),
        (
            LoopChoices,
            {
                "case": "ifac93_4_4_2",
                "Np": 30,
                "weight_move": 10.0,
                "gain": 10.0,
                "dynamics": -10.0,
                "step_u": 0.4,
                "limit_u": "own",
                "u_max": 1.5,
            },
        ),
        (
            LoopChoices,
            {
                "case": "double_integrator_4_4_1",
                "reading": "held",
                "dynamics": 1.0,
                "step_y": 0.5,
                "limit_du": "off",
                "gain": -10.0,
            },
        ),
        (
            LoopChoices,
            {"structures": "wang_young,forward_path_optimised", "Np": 30},
        ),
        (LoopChoices, {"case": "quadruple_tank_minus", "output": 1, "step_u": 0.1}),
        (
            GovernorChoices,
            {"reading": "decaying", "limit_y": "own", "y_max": 6.0, "reference": 0.8},
        ),
        (GovernorChoices, {"reading": "zero after step s", "timing": "preview"}),
    ],
)
def test_python_shown_computes_what_is_shown(
    kind: type[Choices], given: dict[str, Any]
) -> None:
    """The script of a page runs, and its runs and measures are those of the page."""
    script_computes_what_is_shown(kind(**given))


def script_computes_what_is_shown(choices: Choices) -> None:
    """Run the script of a page; compare runs and printed measures with the page's."""
    names: dict[str, Any] = {}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(choices.script(), "shown", "exec"), names)
    runs = choices.runs()
    assert list(names["runs"]) == list(runs)
    for name, run in runs.items():
        scale = np.abs(run.y).max()
        assert np.abs(names["runs"][name].y - run.y).max() <= REPLAY * scale
        assert np.abs(names["runs"][name].u - run.u).max() <= REPLAY * scale
    rows = [str(row) for row in table(runs, choices.output)]
    assert printed.getvalue().splitlines() == rows


def test_choices_out_of_bounds_are_named() -> None:
    """What an address must not hold is refused by name; the rest is taken."""
    choices = LoopChoices()
    with pytest.raises(ValueError, match="Np = '9000'"):
        choices.accept({"Np": "9000", "Nc": "3", "unknown": "1"})
    assert choices.Nc == 3
    with pytest.raises(ValueError, match="no such case"):
        choices.accept({"case": "<script>"})
    with pytest.raises(ValueError, match="gain"):
        choices.accept({"gain": "nan"})


def test_case_brings_its_own_values() -> None:
    """A case chosen anew has its own horizons; nothing of the old one stays."""
    choices = LoopChoices(case="governor_3_4", gain=20.0)
    choices.take_case("ifac93_4_4_2")
    assert (choices.Np, choices.Nc, choices.gain) == (50, 10, 0.0)


def test_impossible_design_keeps_the_picture() -> None:
    """A design that cannot be built says why; the runs shown stay."""
    page = LivePage(receding_horizon.SUBJECT)
    before = page.runs
    page.controls.sent = {**page.choices.values(), "Np": 5, "Nc": 9, "message": 1}
    assert page.runs is before
    assert "Nc" in page.alert.object
    page.controls.sent = {**page.choices.values(), "Nc": 3, "message": 2}
    assert page.runs is not before
    assert page.alert.object == ""


def test_unstable_loop_is_a_message() -> None:
    """A loop that runs away is explained and not drawn."""
    choices = LoopChoices(case="marginally_stable_6_3_2", gain=50.0, dynamics=20.0)
    with pytest.raises(ValueError, match="unstable"):
        choices.runs()


def anything(choices: Choices, rng: np.random.Generator) -> None:
    """Put every choice anywhere within its bounds, often at an end."""
    for item in (item for group in choices.description() for item in group["items"]):
        name, parameter = item["name"], choices.param[item["name"]]
        if item["kind"] in ("linear", "log"):
            low, high = parameter.bounds
            values = [low, high, rng.uniform(low, high), getattr(choices, name)]
            value = values[rng.integers(4)]
            whole = isinstance(parameter, param.Integer)
            setattr(choices, name, int(value) if whole else float(value))
        elif item["kind"] == "one" and name != "case":
            options = [value for value, _ in item["options"]]
            setattr(choices, name, options[rng.integers(len(options))])


@pytest.mark.parametrize("subject", SUBJECTS, ids=PAGES)
@pytest.mark.filterwarnings("error")
def test_any_combination_is_drawn_or_explained(
    subject: Subject, rng: np.random.Generator
) -> None:
    """Whatever is chosen, there is a finite picture or a sentence, nothing else."""
    cases = [n for n in subject.choices.cases() if n not in SLOW]
    drawn = 0
    for number in range(60):
        choices = subject.choices(case=cases[number % len(cases)])
        anything(choices, rng)
        try:
            runs = choices.runs()
        except ValueError:
            continue
        packed = pack(subject.charts(runs, choices.output, choices.input))
        assert np.isfinite(packed["data"]).all()
        drawn += 1
    assert drawn > 10


def test_names_are_text() -> None:
    """What an address says appears as text, never as HTML."""
    page = LivePage(receding_horizon.SUBJECT)
    page.complaint = "<img src=x onerror=alert(1)>"
    page._tell()
    assert "<img" not in page.alert.object


# --- Pictures as data ----------------------------------------------------------------


@pytest.fixture(scope="module")
def charts() -> list[Chart]:
    """Charts of a small case."""
    return loop_charts(LoopChoices(case="governor_3_4").runs())


def test_pack_holds_every_trail(charts: list[Chart]) -> None:
    """Trails and curves can be read back from the packed array by its description."""
    packed = pack(charts)
    data, N = packed["data"], packed["samples"]
    for chart, described in zip(charts, packed["charts"], strict=True):
        trails = [curve.trail for curve in chart.curves if curve.trail is not None]
        for trail, entry in zip(trails, described["trails"], strict=True):
            start, size = entry["start"], N * entry["steps"]
            assert np.array_equal(
                data[start : start + size], trail.astype(np.float32).ravel()
            )
        line = described["lines"][0]
        t = data[line["start"] : line["start"] + line["size"]]
        assert t[0] == chart.span[0]
        assert t[-1] == np.float32(chart.span[1])


def test_first_predicted_input_is_applied(charts: list[Chart]) -> None:
    """Each planned input starts with the one that was applied."""
    curve = next(chart for chart in charts if chart.name == "input").curves[0]
    assert curve.trail is not None
    assert np.abs(curve.trail[:, 0] - curve.values).max() < 1e-6


def test_words_name_the_active_limits() -> None:
    """Sentences tell free samples from limited ones and name channel and steps."""
    runs = LoopChoices(case="governor_3_4").runs()
    run = runs["wang_young"]
    texts, which = sentences(run)
    k = busiest_sample(runs)
    assert "At a limit" in texts[which[k]]
    assert "u1" in texts[which[k]]
    free = int(np.flatnonzero(~run.active.any(axis=1))[0])
    assert "No limit is active" in texts[which[free]]


def test_axis_holds_near_limits_only(charts: list[Chart]) -> None:
    """Limits far away do not flatten the curves."""
    chart = next(chart for chart in charts if chart.name == "input")
    low, high = chart.vertical
    assert low <= -2.0 < 2.0 <= high
    far = Chart("x", "x", "x", chart.curves, limits=(-1e6, 1e6)).vertical
    assert far[1] < 10.0


def test_charts_refuse_what_is_not_there() -> None:
    """Too many runs and unknown channels are refused by name."""
    runs = LoopChoices(case="governor_3_4").runs()
    run = next(iter(runs.values()))
    with pytest.raises(ValueError, match="4 runs"):
        loop_charts({str(i): run for i in range(4)})
    with pytest.raises(ValueError, match="output = 1"):
        loop_charts(runs, output=1)


def test_draw_for_notebooks(charts: list[Chart]) -> None:
    """Every chart becomes a figure with a legend and a unit on both axes."""
    grid = draw(charts)
    plots = [child[0] for child in grid.children]
    assert len(plots) == len(charts)
    for plot in plots:
        assert "[" in plot.xaxis[0].axis_label
        assert "[" in plot.yaxis[0].axis_label
        assert len(plot.legend) == 1


# --- In the browser ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "kind"),
    [("receding_horizon", LoopChoices), ("governor", GovernorChoices)],
)
def test_every_slider_to_both_ends(visit: Open, path: str, kind: Any) -> None:
    """Each slider goes to both ends; the page answers, and keeps working after."""
    page = visit(f"{path}?{QUICK}")
    for name, _, _ in sliders(kind(case="governor_3_4")):
        locator = page.locator(f"input[name={name}]")
        if name.endswith("_max"):
            key = name.removesuffix("_max")
            page.locator(f"select[name=limit_{key}]").select_option('"own"')
            settled(page)
        start = locator.input_value()
        for end in ("min", "max"):
            slide(page, name, end)
            assert locator.input_value() == locator.get_attribute(end)
        locator.evaluate(
            "(input, start) => { input.value = start;"
            " input.dispatchEvent(new Event('input', { bubbles: true })) }",
            start,
        )
        settled(page)
    page.get_by_role("button", name="Reset all choices").click()
    settled(page)
    expect(page.locator(".wrong")).to_have_count(0)


@pytest.mark.parametrize("path", PAGES)
def test_playing_moves_the_picture_and_asks_nobody(visit: Open, path: str) -> None:
    """Play, pause, step and scrub change the picture; the server hears nothing."""
    page = visit(f"{path}?{QUICK}")
    settled(page)
    page.evaluate(
        "() => { window.sentFrames = 0; const send = WebSocket.prototype.send;"
        " WebSocket.prototype.send = function (...a)"
        " { window.sentFrames += 1; return send.apply(this, a) } }"
    )
    before = picture(page)
    page.get_by_role("button", name="Play").click()
    page.wait_for_timeout(1000)
    page.get_by_role("button", name="Pause").click()
    played = picture(page)
    assert played != before
    sample = page.evaluate("nmssPlayer.sample")
    page.get_by_role("button", name="One sample on").click()
    page.wait_for_function(f"nmssPlayer.sample !== {sample}")
    assert picture(page) != played
    page.get_by_role("slider", name="Sample").fill("7")
    page.wait_for_function("nmssPlayer.sample === 7")
    page.keyboard.press("Escape")
    page.locator("h1").click()
    page.keyboard.press("ArrowRight")
    page.wait_for_function("nmssPlayer.sample === 8")
    page.keyboard.press("Home")
    page.wait_for_function("nmssPlayer.sample === 0")
    assert page.evaluate("window.sentFrames") == 0


def test_past_plans_add_to_the_picture(visit: Open) -> None:
    """The fan of past plans can be switched on."""
    page = visit(f"receding_horizon?{QUICK}")
    before = picture(page)
    page.get_by_label("Past plans").check()
    page.wait_for_timeout(200)
    assert picture(page) != before


def test_player_loops_and_stops(visit: Open) -> None:
    """At the end the run starts again, or stops where looping is off."""
    page = visit(f"receding_horizon?{QUICK}")
    page.get_by_label("Speed").select_option("50")
    page.get_by_label("Loop").uncheck()
    page.get_by_role("slider", name="Sample").fill("50")
    page.get_by_role("button", name="Play").click()
    page.wait_for_function("nmssPlayer.sample === 59 && !nmssPlayer.playing")


@pytest.mark.parametrize("path", PAGES)
def test_link_restores_the_choices(visit: Open, path: str) -> None:
    """The address of a changed page opens the same page again."""
    page = visit(f"{path}?{QUICK}")
    slide(page, "Np", "max")
    page.locator("select[name=limit_u]").select_option('"own"')
    settled(page)
    slide(page, "gain", "max")
    page.wait_for_function("location.search.includes('gain=50')")
    address = page.evaluate("location.pathname.slice(1) + location.search")
    measured = page.locator(".text-measures table").inner_text()
    again = visit(address)
    for name, value in (("Np", "80"), ("gain", "50")):
        expect(again.locator(f"input[name={name}]")).to_have_value(value)
    expect(again.locator("select[name=limit_u]")).to_have_value('"own"')
    expect(again.locator(".text-measures table")).to_have_text(
        measured, use_inner_text=True
    )


def test_wrong_link_is_explained(visit: Open) -> None:
    """An address with impossible choices opens a page that says so."""
    for wrong in (f"{QUICK}&Np=9999&unknown=1", f"{QUICK}&Np=2&Nc=9", "case=none"):
        page = visit(f"receding_horizon?{wrong}")
        expect(page.get_by_role("alert")).to_contain_text("address of this page")
        expect(page.locator(".text-measures tbody tr")).to_have_count(2)


def test_impossible_design_shows_a_message(visit: Open) -> None:
    """Nc beyond Np is explained, the picture stays, and mending it clears both."""
    page = visit(f"receding_horizon?{QUICK}")
    settled(page)
    before = page.locator(".text-measures table").inner_text()
    slide(page, "Np", "min")
    slide(page, "Nc", "max")
    alert = page.get_by_role("alert")
    expect(alert).to_contain_text("Nc")
    assert alert.bounding_box()["height"] > 10
    slide(page, "Nc", "min")
    expect(alert).not_to_contain_text("Nc")
    assert page.locator(".text-measures table").inner_text() != before


@pytest.mark.parametrize("subject", SUBJECTS, ids=PAGES)
def test_curves_are_those_of_the_runs_after_a_change(
    visit: Open, subject: Subject
) -> None:
    """What Bokeh draws after a slider has moved is what the library computes."""
    page = visit(f"{PAGES[SUBJECTS.index(subject)]}?{QUICK}")
    slide(page, "gain", "max")
    choices = subject.choices(case="governor_3_4")
    choices.accept({"gain": choices.param["gain"].bounds[1]})
    named = {plain(name): run for name, run in choices.runs().items()}
    picture = pack(subject.charts(named, 0, 0))
    for chart in picture["charts"]:
        drawn = page.evaluate(
            "(name) => { const plot = Bokeh.documents[0].get_model_by_name(name);"
            " return plot.renderers.map(({ name, data_source: { data } }) =>"
            " [name, Array.from(data.t), Array.from(data.y)]) }",
            chart["name"],
        )
        curves = {name: (t, y) for name, t, y in drawn}
        for line in chart["lines"]:
            start, size = line["start"], line["size"]
            for values in curves[line["name"]]:
                expected = picture["data"][start : start + size]
                assert values == pytest.approx(expected.tolist()), chart["name"]
                start += size


def test_choice_made_while_a_case_is_on_its_way(visit: Open) -> None:
    """It stays where its control is the same; the old case's values never follow."""
    page = visit("receding_horizon?case=measured_disturbance_7_4_1")
    settled(page)
    page.evaluate(
        "() => { const root = document.querySelectorAll('*');"
        " const deep = (name) => { for (const e of [...root]) {"
        " const found = e.shadowRoot?.querySelector(`[name=${name}]`);"
        " if (found) return found } };"
        " const find = (n) => document.querySelector(`[name=${n}]`) ?? deep(n);"
        " const box = find('case'); box.value = '\"governor_3_4\"';"
        " box.dispatchEvent(new Event('change', { bubbles: true }));"
        " const gain = find('gain'); gain.value = gain.max;"
        " gain.dispatchEvent(new Event('input', { bubbles: true })) }"
    )
    settled(page)
    expect(page.locator(".wrong")).to_have_count(0)
    expect(page.locator("select[name=case]")).to_have_value('"governor_3_4"')
    gain = page.locator("input[name=gain]")
    assert gain.input_value() == gain.get_attribute("max")
    page.wait_for_timeout(400)  # the address is written a quarter of a second later
    assert "disturbance_direct" not in page.url


@pytest.mark.parametrize("chosen", ["foo", "wang_young,foo"])
def test_link_with_an_unknown_structure_is_explained(visit: Open, chosen: str) -> None:
    """The page opens on the case as it is, and says which name is wrong."""
    page = visit(f"receding_horizon?structures={chosen}")
    expect(page.get_by_role("alert")).to_contain_text("foo")
    expect(page.locator(".text-measures tbody tr")).to_have_count(2)


def test_case_changes_form_and_plots(visit: Open) -> None:
    """Another case brings its channels, its horizons and its labels."""
    page = visit(f"receding_horizon?{QUICK}")
    expect(page.locator("select[name=output]")).to_have_count(0)
    page.locator("select[name=case]").select_option('"quadruple_tank_minus"')
    settled(page)
    expect(page.locator("select[name=output]")).to_have_count(1)
    axis = "Bokeh.documents[0].get_model_by_name('output').left[0].axis_label"
    assert page.evaluate(axis).startswith("level 1")
    page.locator("select[name=output]").select_option("1")
    settled(page)
    assert page.evaluate(axis).startswith("level 2")


def test_three_structures_at_most(visit: Open) -> None:
    """A fourth structure cannot be chosen, and the last one not be taken away."""
    page = visit(f"receding_horizon?{QUICK}")
    boxes = page.locator("input[name=structures]")
    boxes.and_(page.locator(":not(:checked)")).first.check()
    settled(page)
    expect(page.locator("input[name=structures]:checked")).to_have_count(3)
    expect(page.locator("input[name=structures]:not(:checked)").first).to_be_disabled()
    expect(page.locator(".text-measures tbody tr")).to_have_count(3)


def test_latest_value_wins(visit: Open) -> None:
    """Of a fast drag few values are computed, the last one always."""
    page = visit(f"receding_horizon?{QUICK}")
    settled(page)
    page.locator("input[name=Np]").evaluate(
        "async (input) => { for (let i = 10; i < 60; i++) { input.value = i;"
        " input.dispatchEvent(new Event('input', { bubbles: true }));"
        " await new Promise((done) => setTimeout(done, 10)) } }"
    )
    settled(page)
    assert page.evaluate("nmssForm.latency.length") < 45
    shown = page.evaluate("JSON.stringify(nmssPlayer.steps)")
    assert set(json.loads(shown)) == {59}


def test_answer_ends_when_its_page_is_closed() -> None:
    """Nobody waits for it, and others wait for its thread."""
    page = LivePage(receding_horizon.SUBJECT)
    context = SimpleNamespace(destroyed=False)
    document = Document()
    document._session_context = lambda: context
    with set_curdoc(document), page._attended(1):
        page.choices.hears(0.1)
        context.destroyed = True
        with pytest.raises(Withdrawn):
            page.choices.hears(0.2)


LOSE_ONE = """() => {
  const send = WebSocket.prototype.send
  let frames = []  // header, metadata and content of a message
  WebSocket.prototype.send = function (data) {
    frames.push(data)
    if (frames.length < 3) return
    const lost = frames[2].includes?.('"message"') && !window.lost
    if (lost) window.lost = true
    else for (const frame of frames) send.call(this, frame)
    frames = []
  }
}"""


def test_a_message_that_is_lost_is_sent_again(visit: Open) -> None:
    """Whoever hears nothing for ten seconds asks once more, and is answered."""
    page = visit(f"receding_horizon?{QUICK}")
    settled(page)
    page.evaluate(LOSE_ONE)
    slide(page, "Np", "max")
    assert page.evaluate("lost")
    assert page.evaluate("nmssForm.latency.at(-1)") > 9_000
    shown = page.evaluate("JSON.stringify(nmssPlayer.steps)")
    assert set(json.loads(shown)) == {
        float(page.locator("input[name=Np]").input_value())
    }


@pytest.mark.parametrize("path", PAGES)
@pytest.mark.parametrize("width", [390, 1024])
def test_fits_the_screen(visit: Open, path: str, width: int) -> None:
    """Nothing has to be scrolled sideways, from a phone up."""
    page = visit(path, width, 844)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for chart in page.locator(".chart").all():
        assert chart.bounding_box()["width"] > 250


def test_dark_follows_the_system_and_the_button(visit: Open) -> None:
    """Dark where the system asks for it; the button switches and is remembered."""
    page = visit(f"receding_horizon?{QUICK}", color_scheme="dark")
    theme = "document.documentElement.dataset.theme"
    label = "Bokeh.documents[0].get_model_by_name('output').title.text_color"
    assert page.evaluate(theme) == "dark"
    dark = page.evaluate(label)
    page.get_by_role("button", name="Light or dark colours").click()
    assert page.evaluate(theme) == "light"
    page.wait_for_function(f"{label} !== {json.dumps(dark)}")
    page.reload()
    page.wait_for_function("window.nmssPlayer?.frames > 0", timeout=60_000)
    assert page.evaluate(theme) == "light"


@pytest.mark.parametrize("path", PAGES)
def test_controls_have_names(visit: Open, path: str) -> None:
    """Every control has an accessible name; sliders and selections have a help text."""
    page = visit(path)
    nameless = page.evaluate(
        """() => {
          const bad = []
          const look = (root) => {
            for (const node of root.querySelectorAll("*")) {
              if (node.shadowRoot) look(node.shadowRoot)
              if (!/^(INPUT|SELECT|BUTTON)$/.test(node.tagName)) continue
              const named = node.labels?.length || node.ariaLabel || node.textContent
              const id = node.getAttribute("aria-describedby")
              const helped = !id || root.getElementById(id)?.textContent
              if (!named || !helped) bad.push(node.outerHTML)
            }
          }
          look(document)
          return bad
        }"""
    )
    assert nameless == []


def test_python_is_shown(visit: Open) -> None:
    """The page shows Python that names its case and its horizon."""
    allowed = ["clipboard-read", "clipboard-write"]
    page = visit(f"receding_horizon?{QUICK}&Np=17", permissions=allowed)
    page.get_by_text("The Python that computes this").click()
    code = page.locator("pre").inner_text()
    page.get_by_role("button", name="Copy").click()
    expect(page.get_by_role("button", name="Copied")).to_be_visible()
    assert page.evaluate("navigator.clipboard.readText()") == code
    assert 'case("governor_3_4")' in code
    assert "Horizon(17, 5)" in code


def test_server_says_nothing_bad(visit: Open, server: Server) -> None:
    """Opening and using pages leaves no warning and no traceback in the log."""
    # other tests of this worker may have left a page in the middle of an answer
    before = len(server.log.read_text())
    page = visit(f"governor?{QUICK}")
    slide(page, "Np", "min")
    said = server.log.read_text()[before:]
    assert "Traceback" not in said
    assert "WARNING" not in said
    assert "Warning" not in said
