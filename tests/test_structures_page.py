"""The page Structures in a real browser, and its choices and scores without one."""

from __future__ import annotations

import ast
import contextlib
import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from conftest import (
    REPLAY,
    ROUND,
    Open,
    Server,
    picture,
    settled,
    slide,
    watched,
)
from playwright.sync_api import Browser, Page, expect
from test_dashboard import anything

from apps.pages.structures import COLUMNS, LOOK, StructuresPage
from apps.session import held, keep_case, keep_model
from apps.structures import StructuresChoices, best_of, completed, verdict
from nmss_lab import (
    STRUCTURES,
    Design,
    DifferenceModel,
    Scenario,
    closed_loop,
    compare,
    linear_loop,
)
from nmss_lab.cases import LINEAR_CASES, case
from nmss_lab.comparison import FADING, Score, all_structures, disturbed_from
from nmss_lab.identify import Orders, sriv
from nmss_lab.plots import comparison_charts
from nmss_lab.records import shipped

IFAC = "ifac93_6_3_3"
QUICK = "case=governor_3_4"
BY_NAME = [key for key, *_ in COLUMNS]

# --- Scores -------------------------------------------------------------------------

MODEL = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
"""Plant (6.10): its poles lie on the unit circle."""


@pytest.fixture(scope="module")
def scores() -> dict[str, Score]:
    """Return scores of two structures over (6.10), pushed at the input."""
    designs = {
        name: case("marginally_stable_6_3_2").designs[name]
        for name in ("wang_young", "forward_path")
    }
    push = np.repeat([0.0, 0.2], 60)
    scenario = Scenario(np.ones(120), input_disturbance=push)
    return compare(designs, MODEL, scenario)


def test_scores_say_what_hides(scores: dict[str, Score]) -> None:
    """The forward path follows as feedback does, and never takes a push out."""
    feedback, forward = (s.figures for s in scores.values())
    assert feedback["hidden modes"] == 0
    assert np.isnan(feedback["largest hidden"])
    assert forward["hidden modes"] == 2
    assert forward["largest hidden"] == pytest.approx(1.0)
    for key in ("rise", "settling", "overshoot", "IAE r"):
        assert forward[key] == pytest.approx(feedback[key], rel=1e-9)
    assert forward["IAE d"] > 10.0 * feedback["IAE d"]
    assert forward["offset u"] == forward["peak S_i"] == np.inf
    assert forward["margin"] == 0.0
    assert forward["peak S_o"] < feedback["peak S_o"]


def test_errors_are_split_where_the_disturbance_sets_in(
    scores: dict[str, Score],
) -> None:
    """IAE of reference and disturbance, summed by hand, are those of the run."""
    for score in scores.values():
        error = np.abs(score.run.r - score.run.y)[:, 0]
        assert score.figures["IAE r"] == pytest.approx(error[:60].sum())
        assert score.figures["IAE d"] == pytest.approx(error[60:].sum())


def test_a_plant_within_the_margin_is_held() -> None:
    """Gains up to 1 + margin leave the loop stable, for every structure and case."""
    for name in ("ifac93_6_3_3", "quadruple_tank_minus"):
        choices = StructuresChoices(case=name)
        plant = choices.plant()
        for key, score in choices.sheet().scores.items():
            gain = 1.0 + 0.999 * score.figures["margin"]
            wrong = StructuresChoices(case=name)
            controller = wrong.example.designs[key].build()
            stronger = plant.__class__(plant.A, gain * plant.B, plant.C, dt=plant.dt)
            loop = linear_loop(controller, stronger)
            assert loop.is_stable, (name, key)


def test_states_that_no_output_shows_are_left_out() -> None:
    """Each level of the tank is slowed by its own mode once, not once a channel."""
    choices = StructuresChoices(case="quadruple_tank_minus")
    score = choices.sheet().scores["wang_young"]
    full = linear_loop(score.run.controller, choices.plant())
    tank = np.exp(-5.0 / 62.7)  # T1 of Johansson (2000), twice in the plant
    assert np.abs(full.poles - tank).min() < 1e-4
    assert np.abs(score.loop.poles - tank).min() > 1e-3
    omega = np.geomspace(1e-3, 0.6, 20)
    for which in ("T", "S_i", "S_o"):
        ours, theirs = (
            loop.frequency_response(which, omega) for loop in (score.loop, full)
        )
        assert np.abs(ours - theirs).max() < 1e-9


def test_a_disturbance_is_found_whatever_it_is() -> None:
    """A change of v counts from its past; the reference does not count."""
    ones = np.ones(10)
    step = np.repeat([0.0, 1.0], [7, 3])
    assert disturbed_from(Scenario(ones)) is None
    assert disturbed_from(Scenario(ones, output_disturbance=step)) == 7
    assert disturbed_from(Scenario(ones, v=5.0 * ones, v0=[5.0])) is None
    assert disturbed_from(Scenario(ones, v=5.0 * ones)) == 0
    both = Scenario(ones, v=step, input_disturbance=np.repeat([0.0, 1.0], [4, 6]))
    assert disturbed_from(both) == 4


def test_a_loop_that_runs_away_has_no_times() -> None:
    """What diverged is scored where it can be."""
    design = Design("wang_young", DifferenceModel([-0.9], [0.1]), R=1e-3)
    wrong = DifferenceModel([-1.2], [-0.4])
    found = compare({"it": design}, wrong, Scenario(np.ones(200)))
    (score,) = found.values()
    assert score.figures["largest pole"] > 1.0
    assert np.isnan(score.figures["rise"])
    assert score.figures["peak S_o"] == np.inf
    for chart in comparison_charts(found)[:2]:
        assert 1 < len(chart.curves[0].t) < 10
        assert np.abs(chart.curves[0].values).max() < 1e3


# --- Choices, without a browser ------------------------------------------------------


@pytest.mark.parametrize("name", LINEAR_CASES)
def test_every_case_opens_with_all_that_suits_it(name: str) -> None:
    """Each structure has a row or a reason, each figure is finite or explained."""
    choices = StructuresChoices(case=name)
    assert name in LOOK
    sheet = choices.sheet()
    known = choices.example.designs
    built = {known[key].structure for key in sheet.scores}
    assert built & set(STRUCTURES) | set(sheet.reasons) == set(STRUCTURES)
    assert built.isdisjoint(sheet.reasons)
    for why in sheet.reasons.values():
        assert "no measured disturbances" in why
    gains = {k for k, d in case(name).designs.items() if d.structure == "pip"}
    assert gains <= set(sheet.scores)
    titles = {key: choices.title(key) for key in sheet.scores}
    assert len(set(titles.values())) == len(titles)
    assert verdict(sheet.scores, titles).endswith(".")
    for score in sheet.scores.values():
        assert set(score.figures) >= set(BY_NAME)
        assert np.abs(score.run.y[:4] - score.run.r[:4]).max() < 1e-9  # at rest
    charts = comparison_charts({k: sheet.scores[k] for k in choices.structures})
    assert [c.name for c in charts] == ["output", "input", "S_o", "S_i", "poles"]


def figure(name: str, key: str) -> dict[str, float]:
    """Return a figure of every structure of a case as it opens."""
    scores = StructuresChoices(case=name).sheet().scores
    return {structure: score.figures[key] for structure, score in scores.items()}


def test_words_about_cases_are_true() -> None:
    """What the page says to look at can be seen."""
    peak = figure("shell_5_3_2", "peak S_o")
    assert 18.0 < peak["wang_young"] / peak["forward_path"] < 24.0
    left = figure("gasifier_6_3_4", "IAE d")
    assert left["forward_path"] > 10.0 * left["wang_young"]
    moves = figure("temperature_7_4_2", "RMS du")
    assert 0.2 < moves["disturbance_direct"] / moves["wang_young"] < 0.3
    margin = figure("wood_berry", "margin")
    assert margin["wang_young"] < 0.01
    assert margin["forward_path"] > 0.95
    assert figure(IFAC, "margin")["forward_path"] > 0.9
    error, top = (figure("quadruple_tank_plus", k) for k in ("IAE d", "peak S_o"))
    assert error["wang_young"] < 0.6 * error["forward_path"]
    assert top["wang_young"] > 4.0 * top["forward_path"]


def test_what_a_case_lacks_is_made() -> None:
    """A case of one design gets the others, and says whose weights they have."""
    example = case("measured_disturbance_7_4_1")
    alone = {"integral_of_error": example.designs["integral_of_error"]}
    name = keep_case(
        "tuned",
        "one design",
        example.__class__(**{**vars(example), "designs": alone, "title": "One design"}),
        held_origin(),
    )
    choices = StructuresChoices(case=name)
    assert set(choices.rows) == set(STRUCTURES)
    assert choices.note("integral_of_error") == ""
    assert choices.note("forward_path") == "weights of Integral of error"
    scores = choices.sheet().scores
    assert all(score.loop.is_stable for score in scores.values())


def held_origin() -> Any:
    """Return the Python of a case with one design."""
    from apps.session import Origin

    return Origin(
        ("from nmss_lab.cases import case",),
        (
            'example = case("measured_disturbance_7_4_1")',
            'one = {"integral_of_error": example.designs["integral_of_error"]}',
            "example = replace(example, designs=one)",
        ),
    )


SHEETS: dict[str, dict[str, Any]] = {
    "as it is": {"case": IFAC},
    "off": {"case": IFAC, "gain": 20.0, "dynamics": -5.0},
    "own": {"case": "governor_3_4", "horizons": "own", "Np": 12, "Nc": 3},
    "limits": {"case": "governor_3_4", "limit_u": "own", "u_max": 1.5, "step_y": 0.4},
    "tanks": {"case": "quadruple_tank_minus", "output": 1, "input": 1, "samples": 90},
    "measured": {"case": "measured_disturbance_7_4_1", "step_at": 30},
    "operating point": {"case": "temperature_7_4_2", "samples": 60},
    "printed weights": {"case": "shell_5_3_2", "limit_u": "off"},
}


def printed(text: str) -> dict[str, dict[str, float]]:
    """Run a script as if it were pasted; return what it prints, by structure."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), np.errstate(all="ignore"):
        exec(compile(text, "shown", "exec", dont_inherit=True), {})
    found = {}
    for line in said.getvalue().splitlines():
        name, _, rest = line.partition(" ")
        plain = rest.replace("nan", "None").replace("inf", "1e999")
        found[name] = ast.literal_eval(plain)
    return found


def same(script: str, scores: dict[str, Score]) -> None:
    """Assert that a script prints the figures of scores."""
    found = printed(script)
    assert list(found) == list(scores)
    for name, score in scores.items():
        for key, value in score.figures.items():
            theirs = np.nan if found[name][key] is None else found[name][key]
            assert theirs == pytest.approx(value, rel=REPLAY, abs=1e-12, nan_ok=True)


@pytest.mark.parametrize("kind", SHEETS)
def test_python_shown_prints_the_sheet(kind: str) -> None:
    """The script of the page runs, and its numbers are those of the sheet."""
    choices = StructuresChoices(**SHEETS[kind])
    same(choices.script(), dict(choices.sheet().scores))


def test_python_of_kept_and_held_designs() -> None:
    """Cases of other pages and held designs are rows, and in the script as well."""
    record = shipped("gas_furnace").detrend("constant")
    estimate = sriv(record, Orders(1, (3,), (3,)), "estimate")
    choices = StructuresChoices(case=keep_model(estimate))
    assert "forward_path" in choices.rows
    first = StructuresChoices(case=IFAC, horizons="own", Np=30)
    choices = StructuresChoices(case=IFAC)
    choices.accept({"A": first.hold("forward_path")})
    assert choices.rows[-1] == "A"
    assert held(choices.A).design.horizon.Np == 30
    sheet = choices.sheet()
    assert "Np 30" in choices.note("A")
    same(choices.script(), dict(sheet.scores))


def test_an_operating_point_is_rest() -> None:
    """Limits move with it, and every loop is where the case holds it."""
    choices = StructuresChoices(case="temperature_7_4_2")
    run = choices.sheet().scores["wang_young"].run
    start = case("temperature_7_4_2").scenario
    low, high = run.controller.limits.u
    assert low == pytest.approx(np.array([10.0, 15.0]) - start.u0)
    assert high == pytest.approx(np.array([25.0, 27.0]) - start.u0)
    before = run.u[: choices.samples // 2 - 1]
    assert np.abs(before).max() < 1e-9


def test_horizons_are_those_of_the_case_until_chosen() -> None:
    """A design with horizons of its own keeps them; chosen ones hold for all."""
    choices = StructuresChoices(case="gasifier_6_3_4")
    integral = choices.sheet().scores["integral_of_error"]
    assert integral.loop.is_stable  # with Np = 80; with 60 it is not
    choices.accept({"horizons": "own"})
    assert not choices.sheet().scores["integral_of_error"].loop.is_stable


def test_best_ones_are_stable_and_not_alike() -> None:
    """An unstable loop is best at nothing, and where all are equal nobody is."""
    found = StructuresChoices(case="marginally_stable_6_3_2").sheet().scores
    for key in BY_NAME:
        assert "forward_path" not in best_of(found, key)
    assert best_of(found, "offset y") == []
    # forward path and feedback are one law for the reference, feedback is stable
    assert best_of(found, "IAE r") == ["wang_young", "minimal"]


def test_the_verdict_follows_the_numbers() -> None:
    """Another plant, another sentence; unstable ones are named first."""
    choices = StructuresChoices(case=IFAC)
    titles = {name: choices.title(name) for name in choices.rows}
    first = verdict(choices.sheet().scores, titles)
    assert first.startswith("Wang-Young takes the disturbance out best (IAE 0.377")
    assert "Forward path hides a mode of modulus 0.9055" in first
    choices.accept({"dynamics": 10.0, "gain": 50.0})
    scores = choices.sheet().scores
    lost = [name for name, score in scores.items() if not score.loop.is_stable]
    assert lost
    second = verdict(scores, titles)
    assert "not stable here" in second.partition(";")[0]
    assert all(titles[name] in second.partition(";")[0] for name in lost)


def test_every_choice_is_explained() -> None:
    """Each control has a label, a sentence of help and bounds."""
    for name in (IFAC, "temperature_7_4_2"):
        choices = StructuresChoices(case=name)
        items = [item for group in choices.description() for item in group["items"]]
        shown = {item["name"] for item in items}
        assert "structures" not in shown  # chosen in the sheet
        assert ("step_v" in shown) == (name != IFAC)
        for item in items:
            assert item["label"]
            assert item["help"].endswith(".")
            if "low" in item:
                assert item["low"] < item["high"]


@pytest.mark.filterwarnings("error")
def test_any_combination_is_scored_or_explained(rng: np.random.Generator) -> None:
    """Whatever is chosen, there is a sheet with pictures or a sentence."""
    names = [n for n in LINEAR_CASES if n not in ("gasifier_6_3_4",)]
    scored = 0
    for number in range(36):
        choices = StructuresChoices(case=names[number % len(names)])
        anything(choices, rng)
        try:
            sheet = choices.sheet()
        except ValueError:
            continue
        scored += 1
        titles = {n: choices.title(n) for n in (*sheet.scores, *sheet.reasons)}
        assert verdict(sheet.scores, titles)
        shown = {n: sheet.scores[n] for n in choices.structures if n in sheet.scores}
        for chart in comparison_charts(shown, choices.output, choices.input):
            assert np.isfinite(chart.vertical).all()
            for curve in chart.curves:
                assert not np.isnan(curve.values).any()
    assert scored > 18


def test_hidden_modes_are_those_that_last() -> None:
    """Those near the origin, where long histories put many, are not counted."""
    score = StructuresChoices(case="wood_berry").sheet().scores["wang_young"]
    assert len(score.hidden_modes) == 2
    assert np.abs(score.hidden_modes).min() > FADING


def test_completed_cases_keep_their_own_designs() -> None:
    """What a case has is not made anew."""
    example = case(IFAC)
    made = all_structures(example)
    for name, design in made.designs.items():
        assert example.designs[name] is design
    assert completed(example).scenario is example.scenario


def test_impossible_choices_keep_the_sheet() -> None:
    """What cannot be built is said; the last scores stay."""
    page = StructuresPage()
    before = page.found
    sent = {**page.choices.values(), "horizons": "own", "Np": 5, "Nc": 9}
    page.controls.sent = {**sent, "message": 1}
    assert page.found is before
    assert "Nc" in page.alert.object
    page.controls.sent = {**sent, "Nc": 3, "message": 2}
    assert page.found is not before
    assert page.alert.object == ""
    before = page.found
    chosen = {"structures": ["minimal"], "message": 3}
    page.controls.sent = {**page.choices.values(), **chosen}
    assert page.found is before  # nothing that counts has changed
    assert page.sheet.chosen == ["minimal"]


def test_the_bar_holds_and_saves_what_is_scored() -> None:
    """A design held is a row; files hold the design and the run as they are scored."""
    page = StructuresPage()
    page.choices.accept({"case": "temperature_7_4_2"})
    page.controls.sent = {**page.choices.values(), "message": 1}
    study = page.choices.study_of("wang_young")
    run = page._run_of("wang_young")
    again = closed_loop(study.plant, study.design.build(), study.scenario)
    assert np.array_equal(again.y, run.y)
    page.bar.sent = {"act": "hold", "which": "A", "name": "wang_young"}
    assert page.alert.object == ""
    assert page.found.scores["A"].figures == pytest.approx(
        page.found.scores["wang_young"].figures, nan_ok=True
    )


def test_names_are_text() -> None:
    """What an address says appears as text, never as HTML."""
    page = StructuresPage()
    page.complaint = "<img src=x onerror=alert(1)>"
    page._tell()
    assert "<img" not in page.alert.object


# --- In the browser ------------------------------------------------------------------

READY = "window.nmssSheet?.rows() > 0"


@pytest.fixture
def visit(server: Server, browser: Browser) -> Iterator[Open]:
    """Yield a function that opens the page."""
    with watched(server, browser, READY, "structures") as open_page:
        yield open_page


def cells(page: Page, column: int) -> list[str]:
    """Return one column of the sheet, from top to bottom."""
    rows = page.locator(".scores tbody tr").all()
    return [row.locator("th, td").nth(column).inner_text().strip() for row in rows]


def test_the_sheet_shows_what_the_library_computes(visit: Open) -> None:
    """Rows, marks, missing structures and the sentence are those of the choices."""
    page = visit(f"structures?{QUICK}")
    choices = StructuresChoices(case="governor_3_4")
    found = choices.sheet().scores
    assert cells(page, 0) == [choices.title(name) for name in found]
    radius = [f"{score.figures['largest pole']:.4f}" for score in found.values()]
    assert [text.split()[-1] for text in map(plain, cells(page, 2))] == radius
    best = page.locator(".scores tbody tr").filter(has=page.locator("td.best"))
    assert best.count() >= 3
    first = best_of(found, "IAE d")[0]
    row = page.locator(".scores tbody tr", has_text=choices.title(first)).first
    at = 2 + BY_NAME.index("IAE d")
    expect(row.locator("th, td").nth(at)).to_have_class("best")
    titles = {name: choices.title(name) for name in found}
    expect(page.locator(".verdict")).to_have_text(verdict(found, titles))
    expect(page.locator(".missing")).to_contain_text("no measured disturbances")


def plain(text: str) -> str:
    """Return the text of a cell without the mark of the best."""
    return text.replace("\u2605", "").replace("best", "").strip()


def test_headings_sort(visit: Open) -> None:
    """A click sorts, another one turns round; the keyboard keeps its place."""
    page = visit(f"structures?{QUICK}")
    heading = page.get_by_role("button", name="Largest pole")
    heading.click()
    values = [float(plain(text)) for text in cells(page, 2)]
    assert values == sorted(values)
    expect(page.locator("th[aria-sort=ascending]")).to_have_count(1)
    heading.press("Enter")
    values = [float(plain(text)) for text in cells(page, 2)]
    assert values == sorted(values, reverse=True)
    page.get_by_role("button", name="Structure").click()
    assert cells(page, 0) == sorted(cells(page, 0))


DRAWN = """(name) => Bokeh.documents[0].get_model_by_name(name).renderers
  .filter((r) => /^(style|ring|cross)/.test(r.name) && r.data_source.data.t.length)
  .map((r) => r.name)"""


def test_rows_are_chosen_for_the_plots(visit: Open) -> None:
    """Up to three at once, one at least; the address restores them."""
    page = visit(f"structures?{QUICK}")
    boxes = page.locator(".scores tbody input")
    expect(page.locator(".scores tbody input:checked")).to_have_count(3)
    expect(page.locator(".scores tbody input:not(:checked)").first).to_be_disabled()
    before = picture(page)
    page.get_by_role("checkbox", name="Forward path").uncheck()
    settled(page)
    page.get_by_role("checkbox", name="Wang-Young").uncheck()
    settled(page)
    page.wait_for_function(f"({DRAWN})('output').length === 1")
    assert picture(page) != before
    expect(page.locator(".scores tbody input:checked")).to_be_disabled()
    page.get_by_role("checkbox", name="Governor").check()
    settled(page)
    expect(page.locator(".legend")).to_contain_text("Governor")
    page.wait_for_function("location.search.includes('structures=')")
    address = page.evaluate("location.pathname.slice(1) + location.search")
    again = visit(address)
    assert again.evaluate("nmssSheet.chosen()") == ["integral_of_error", "governor"]
    assert boxes.count() == 6


def test_hidden_modes_are_crossed(visit: Open) -> None:
    """Poles are open markers, hidden ones crossed, the circle is round."""
    page = visit("structures?case=marginally_stable_6_3_2&structures=forward_path")
    assert page.evaluate(DRAWN, "poles") == ["ring0", "cross0"]
    places = page.evaluate(
        "() => { const { t, y } = Bokeh.documents[0].get_model_by_name('poles')"
        ".renderers.find((r) => r.name === 'cross0').data_source.data;"
        " return [Array.from(t), Array.from(y)] }"
    )
    modes = np.array(places[0]) + 1j * np.array(places[1])
    wanted = np.roots([1.0, -1.7, 1.0])
    assert np.sort_complex(modes) == pytest.approx(np.sort_complex(wanted), abs=1e-5)
    page.wait_for_function(ROUND)


def test_gains_are_those_of_the_library(visit: Open) -> None:
    """S_o and S_i are drawn over logarithmic axes up to Nyquist's frequency."""
    page = visit(f"structures?{QUICK}&structures=wang_young")
    loop = StructuresChoices(case="governor_3_4").sheet().scores["wang_young"].loop
    for name in ("S_o", "S_i"):
        t, y, axis = page.evaluate(
            "(name) => { const plot = Bokeh.documents[0].get_model_by_name(name);"
            " const { t, y } = plot.renderers.find((r) => r.name === 'style0')"
            ".data_source.data;"
            " return [Array.from(t), Array.from(y), plot.below[0].type] }",
            name,
        )
        assert axis == "LogAxis"
        assert t[-1] == pytest.approx(np.pi, rel=1e-6)
        gains = loop.singular_values(name, np.array(t[:-1]))[:, 0]
        # frequencies are sent as float32 as well, and S_i has a notch
        assert np.array(y[:-1]) == pytest.approx(gains, rel=1e-5, abs=1e-7)


def test_sliders_score_anew(visit: Open) -> None:
    """A plant of another gain has other scores; impossible choices are explained."""
    page = visit(f"structures?{QUICK}")
    before = cells(page, 2)
    slide(page, "gain", "max")
    expect(page.locator(".verdict")).to_contain_text("not stable")
    assert cells(page, 2) != before
    page.get_by_role("button", name="Reset all choices").click()
    settled(page)
    page.locator("select[name=case]").select_option('"quadruple_tank_minus"')
    settled(page)
    expect(page.locator(".told")).to_contain_text("largest singular value")
    page.locator("select[name=horizons]").select_option('"own"')
    settled(page)
    slide(page, "Np", "min")
    expect(page.get_by_role("alert")).to_contain_text("Nc")
    assert len(cells(page, 2)) == 4


def test_wrong_links_are_explained(visit: Open) -> None:
    """An address with impossible choices opens the case as it is, and says so."""
    for wrong in ("structures=foo", "case=none", "step_r=nan", "horizons=own&Np=2"):
        page = visit(f"structures?{wrong}")
        expect(page.get_by_role("alert")).to_contain_text("address of this page")
        expect(page.locator(".scores tbody tr")).to_have_count(4)


@pytest.mark.parametrize(("width", "scheme"), [(390, "dark"), (1024, "light")])
def test_fits_the_screen_in_the_colours_asked_for(
    visit: Open, width: int, scheme: str
) -> None:
    """Nothing scrolls sideways but the sheet itself; figures follow the scheme."""
    page = visit(f"structures?{QUICK}", width, color_scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for chart in page.locator(".chart").all():
        assert chart.bounding_box()["width"] > 250
    label = "Bokeh.documents[0].get_model_by_name('S_o').title.text_color"
    dark = page.evaluate(label)
    page.get_by_role("button", name="Light or dark colours").click()
    page.wait_for_function(f"{label} !== '{dark}'")
    page.wait_for_function(ROUND)


def test_server_says_nothing_bad(visit: Open, server: Server) -> None:
    """Opening and using the page leaves no fault in the log."""
    page = visit(f"structures?{QUICK}")
    slide(page, "step_u", "min")
    slide(page, "samples", "max")
    expect(page.locator(".wrong")).to_have_count(0)
    assert server.faults() == []


def test_the_index_leads_here(visit: Open) -> None:
    """The page has its place in the navigation and a card on the index."""
    page = visit("", until="document.querySelector('nav')")
    names = page.locator("nav a").all_inner_texts()
    assert names.index("Structures") == names.index("Receding horizon") + 1
    page.locator("a.card[href=structures]").click()
    page.wait_for_function(READY, timeout=60_000)


def test_the_run_shown_is_that_of_the_library() -> None:
    """The scores' runs are closed loops of the designs on the plant chosen."""
    choices = StructuresChoices(case=IFAC, gain=10.0)
    for name, score in choices.sheet().scores.items():
        design = choices.example.designs[name]
        run = closed_loop(choices.plant(), design.build(), choices.scenario())
        assert np.array_equal(run.y, score.run.y)
