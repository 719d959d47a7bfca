"""The page Robustness in a real browser, and its choices without one."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import io
import json
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROUND, Open, Server, watched
from playwright.sync_api import Browser, Page, expect

from apps.pages.robustness import LOOK, RobustnessPage
from apps.robustness import (
    RobustnessChoices,
    at_channel,
    certain_delays,
    kinds_of,
    usual_peak,
)
from apps.session import KEPT, LoopChoices, keep_model
from apps.tuning import TuneChoices
from apps.work import Lent, Withdrawn
from nmss_lab.analysis import linear_loop
from nmss_lab.cases import LINEAR_CASES, case, stress
from nmss_lab.identify import Orders, sriv
from nmss_lab.models import DifferenceModel, LinearPlant
from nmss_lab.montecarlo import MonteCarlo, monte_carlo
from nmss_lab.plots import (
    ALWAYS,
    MOST_POLES,
    Cloud,
    EnsembleFigure,
    cloud_chart,
    ensemble_charts,
    picked_charts,
    ranked,
)
from nmss_lab.records import shipped
from nmss_lab.simulate import closed_loop
from nmss_lab.uncertainty import realisation

DEFAULT = "marginally_stable_6_3_2"
IFAC = "ifac93_6_3_3"


def pasted(text: str) -> dict[str, Any]:
    """Run a script as if it were pasted; return its names."""
    names: dict[str, Any] = {}
    with contextlib.redirect_stdout(io.StringIO()), np.errstate(all="ignore"):
        exec(compile(text, "shown", "exec", dont_inherit=True), names)
    return names


def made(choices: RobustnessChoices) -> MonteCarlo:
    """Make the study of choices in this process."""
    study = choices.study()
    with np.errstate(all="ignore"):
        return monte_carlo(
            study.designs,
            study.uncertainty,
            study.scenario,
            study.n,
            study.seed,
            keep="signals",
        )


# --- Choices, without a browser ------------------------------------------------------

STUDIES: dict[str, dict[str, Any]] = {
    "P*": {"case": DEFAULT, "n": 30},
    "ranges": {"case": DEFAULT, "uncertainty": "ranges", "n": 5, "seed": 3},
    "own design": {"case": DEFAULT, "n": 5, "Np": 30, "Nc": 4, "weight_move": 3.0},
    "own limits": {"case": DEFAULT, "n": 5, "limit_u": "own", "u_max": 0.5},
    "disturbance": {"case": DEFAULT, "n": 5, "step_y": 0.2, "reading": "next"},
    "level 3": {"case": IFAC, "uncertainty": "stress", "level": "3", "n": 4},
    "corners": {"case": IFAC, "uncertainty": "stress_corners", "level": "1"},
    "slower": {"case": IFAC, "uncertainty": "gains", "n": 4},
    "tanks": {"case": "quadruple_tank_minus", "uncertainty": "gains_corners"},
    "several": {"case": "shell_5_3_2", "n": 3, "output": 2, "speed_range": 0.1},
    "measured": {"case": "measured_disturbance_7_4_1", "uncertainty": "ranges", "n": 4},
}


@pytest.mark.parametrize("kind", STUDIES)
def test_python_shown_gives_the_same_rates(kind: str) -> None:
    """The script runs when pasted, and counts what the page counts."""
    choices = RobustnessChoices(**STUDIES[kind])
    study = made(choices)
    names = pasted(choices.script())
    shown = at_channel(study, choices.output, choices.example.model.y_names)
    assert shown.rates(choices.events(choices.peak)).equals(names["rates"])
    for name, poles in study.poles.items():
        assert np.array_equal(poles, names["study"].poles[name], equal_nan=True)


@pytest.mark.parametrize("kind", STUDIES)
def test_a_drawn_plant_opens_on_the_other_page(kind: str) -> None:
    """Its case has that plant and these designs, and its script makes the same."""
    choices = RobustnessChoices(**STUDIES[kind])
    study = choices.study()
    name = choices.keep_drawn(2, samples=12)
    drawn = realisation(study.uncertainty, 2, study.seed).plant
    drawn = drawn.plant() if isinstance(drawn, DifferenceModel) else drawn
    kept = KEPT[name].plant
    assert isinstance(kept, LinearPlant)
    assert np.array_equal(kept.A, drawn.A)
    assert np.array_equal(kept.B, drawn.B)
    other = LoopChoices(case=name, structures=list(choices.structures))
    names = pasted(other.script())
    for key, run in other.runs().items():
        assert len(run) == 12
        assert np.array_equal(names["runs"][key].y, run.y)
        mine = closed_loop(drawn, study.designs[key].build(), study.scenario)
        assert np.array_equal(run.y, mine.y[:12])
    assert "dynamics" not in str(other.description())


def test_a_tuned_design_meets_the_same_plants() -> None:
    """What the page Tune sends is studied against what it was before."""
    tune = TuneChoices()
    tune.accept({"case": IFAC})
    before = tune.example.designs["wang_young"]
    name = tune.keep(dataclasses.replace(before, Q=0.1), before)
    choices = RobustnessChoices(case=name, structures="tuned,before")
    assert (choices.uncertainty, choices.count) == ("stress_corners", 32)
    rates = made(choices).rates(choices.events(choices.peak))
    assert rates.equals(pasted(choices.script())["rates"])
    counts = rates[rates["event"] == "unstable"].set_index("design")["count"]
    assert counts["tuned"] < counts["before"] == 2  # a lower weight is more cautious


def test_every_case_has_uncertainties_and_words() -> None:
    """Each offers at least ranges and gains; what belongs to one case stays there."""
    for name in LINEAR_CASES:
        choices = RobustnessChoices(case=name)
        kinds = kinds_of(choices.example)
        assert {"ranges", "gains"} <= set(kinds)
        assert ("covariance" in kinds) == (name == DEFAULT)
        assert ("stress" in kinds) == name.startswith("ifac93")
        assert 0.0 < choices.peak <= choices.param["peak"].bounds[1]
        items = [item for group in choices.description() for item in group["items"]]
        assert all(item["label"] and item["help"].endswith(".") for item in items)
        with pytest.raises(ValueError, match="uncertainty = 'x'"):
            choices.accept({"uncertainty": "x"})
    with pytest.raises(ValueError, match="choose up to 6666 realisations"):
        RobustnessChoices(case="gasifier_6_3_4", n=10_000).study()
    RobustnessChoices(n=10_000).study()
    assert set(LOOK) <= set(LINEAR_CASES)
    assert usual_peak(case(IFAC)) == 1.5


def test_only_what_matters_makes_another_study() -> None:
    """What is merely shown does not; size, seed, design and scenario do."""
    choices = RobustnessChoices()
    first = choices.study_lines()
    for key, value in {
        "peak": 2.0,
        "measure": "ISE",
        "cloud": "a",
        "level": "3",
    }.items():
        setattr(choices, key, value)
        assert choices.study_lines() == first
    for key, value in {"n": 12, "seed": 1, "Np": 19, "step_u": 0.01}.items():
        setattr(choices, key, value)
        assert choices.study_lines() != first
        first = choices.study_lines()


def test_delays_of_an_identified_model_are_certain() -> None:
    """P* of the gas furnace moves no coefficient that its delay makes zero."""
    record = shipped("gas_furnace").detrend("constant")
    name = keep_model(sriv(record, Orders(1, (3,), (3,)), "estimate"))
    choices = RobustnessChoices(case=name, n=4)
    model = choices.example.model
    assert choices.uncertainty == "covariance"
    zero = model.b.ravel() == 0.0
    assert zero.sum() == 2
    for number in range(4):
        drawn = realisation(choices.plants(), number).plant
        # the root of what rounding leaves of an eigenvalue of zero
        assert np.abs(drawn.b.ravel()[zero]).max() < 1e-8
        assert (drawn.b.ravel()[~zero] != model.b.ravel()[~zero]).all()
    with pytest.raises(ValueError, match="P\\* has 3 rows"):
        certain_delays(model, np.eye(3))
    lines = "\n".join(choices.study_lines())
    assert "these are certain" in lines


def test_stress_levels_are_sampled_as_the_case_is() -> None:
    """Plants between the samples too, the 32 corners in the order of the library."""
    choices = RobustnessChoices(case=IFAC)
    assert (choices.uncertainty, choices.count) == ("stress_corners", 32)
    ours, theirs = choices.plants(), stress(2, corners=True, substeps=50)
    for number in (0, 31):
        one, other = (realisation(u, number).plant for u in (ours, theirs))
        assert np.array_equal(one.A, other.A)
        assert np.array_equal(one.between.C, other.between.C)


# --- Pictures ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def study() -> tuple[MonteCarlo, dict[str, Any], dict[str, Any]]:
    """Return a study of 1,500 plants from P*, nominal runs and poles."""
    choices = RobustnessChoices(n=1500)
    asked = choices.study()
    nominal = {
        name: closed_loop(asked.nominal, design.build(), asked.scenario)
        for name, design in asked.designs.items()
    }
    poles = {
        name: linear_loop(design.build(), asked.nominal).poles
        for name, design in asked.designs.items()
    }
    return made(choices), nominal, poles


def test_charts_stay_readable_though_loops_run_away(study: Any) -> None:
    """Bands lie about the nominal run; all values are finite; shares are right."""
    found, nominal, poles = study
    charts = {c.name: c for c in ensemble_charts(found, nominal, poles)}
    assert list(charts) == ["poles", "output", "input", "distribution"]
    low, high = charts["output"].vertical
    assert -6.0 < low < high < 8.0  # the nominal output moves between -1 and 2.5
    for chart in charts.values():
        figure = EnsembleFigure(chart)
        for source in (*figure.bands, *figure.thin, *figure.curves):
            for column in source.data.values():
                assert np.isfinite(column).all()
    curve = charts["distribution"].curves[0]
    values, _ = ranked(found, "wang_young", "y1", "IAE")
    share = float((values <= np.median(values)).mean())
    assert np.interp(np.median(values), curve.t, curve.values) == pytest.approx(
        share,
        abs=2 / 1500,  # points of the curve are thinned by at most one
    )


def test_a_large_cloud_says_how_many_are_shown(study: Any) -> None:
    """Poles are thinned, the worst stay, and the title has the number."""
    found, _, poles = study
    chart = cloud_chart(found, poles)
    counts = []
    for name, cloud in zip(found.poles, chart.curves, strict=True):
        assert isinstance(cloud, Cloud)
        assert cloud.numbers is not None
        _, numbers = ranked(found, name, "y1", "radius")
        assert set(numbers[-ALWAYS:]) <= set(cloud.numbers)
        assert len(cloud.t) < 1.3 * MOST_POLES  # the worst come on top
        counts.append(len(set(cloud.numbers)))
    assert chart.title == f"Poles, {min(counts):,} of 1,500 realisations"


def test_one_realisation_is_drawn_until_it_has_run_away(study: Any) -> None:
    """The line of a loop that explodes ends; those of the other structure goes on."""
    found, nominal, _ = study
    _, numbers = ranked(found, "wang_young", "y1", "IAE")
    charts = picked_charts(found, nominal, int(numbers[-1]), 0, 0, "IAE")
    wild, calm = charts[1].curves
    assert np.isnan(wild.values[-1])
    assert np.isfinite(calm.values).all()
    assert np.array_equal(
        calm.values, found.signals["forward_path"].y[numbers[-1], :, 0]
    )


# --- Work ----------------------------------------------------------------------------


def test_withdrawn_work_ends_the_waiting_at_once() -> None:
    """Who waits for a result is told, though a task goes on; others get their turn."""
    go_on = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        first, second = Lent(pool, at_once=1), Lent(pool, at_once=1)
        slow = [first.submit(go_on.wait, 60) for _ in range(5)]
        quick = second.submit(lambda: "done")
        first.withdraw()
        for future in slow:
            with pytest.raises(Withdrawn):
                future.result(timeout=60)
        go_on.set()
        assert quick.result(timeout=60) == "done"
        with pytest.raises(Withdrawn):  # nor does it begin anything more
            first.submit(lambda: "again").result(timeout=60)


def test_lent_processes_hand_on_results_and_errors() -> None:
    """Results come back in whatever number; an error is that of the task."""
    with ThreadPoolExecutor(2) as pool:
        lent = Lent(pool, at_once=2)
        futures: list[Future[Any]] = [lent.submit(pow, i, 2) for i in range(50)]
        assert [f.result(timeout=60) for f in futures] == [i * i for i in range(50)]
        with pytest.raises(ZeroDivisionError):
            lent.submit(divmod, 1, 0).result(timeout=60)


def test_a_study_called_off_keeps_what_there_is() -> None:
    """A page without a browser: what is not known is refused in words."""
    page = RobustnessPage()
    for act in ("open", "rates", "table"):
        page._act(type("Event", (), {"new": {"act": act}}))
        assert "first" in page.complaint or "Run" in page.complaint
    page.call_off()


# --- In the browser ------------------------------------------------------------------

DONE = "window.nmssStudy && nmssForm.idle() && !nmssStudy.running()"
STUDIED = f"{DONE} && nmssStudy.shown() > 0"


@pytest.fixture
def visit(server: Server, browser: Browser) -> Iterator[Open]:
    """Yield a function that opens the page; nothing may complain."""
    with watched(server, browser, STUDIED, "robustness") as open_page:
        yield open_page
    assert server.faults() == []


def rates(page: Page) -> list[list[str]]:
    """Return the table of rates as text."""
    rows = page.locator(".sheet tbody tr").all_inner_texts()
    return [[cell.strip() for cell in row.split("\t")] for row in rows]


def python(page: Page) -> dict[str, Any]:
    """Run the Python that the page shows."""
    page.locator("summary", has_text="The Python").click()
    return pasted(page.locator(".text-python pre").inner_text())


def enter(page: Page, name: str, value: str) -> None:
    """Type a number and wait for the answer."""
    field = page.locator(f"input[name={name}]")
    field.fill(value)
    field.press("Tab")
    page.wait_for_function("nmssForm.idle()")


def test_opens_with_the_lesson_of_the_thesis(visit: Open) -> None:
    """Few wild loops against many that are barely unstable; the Python agrees."""
    page = visit()
    assert page.locator(".note").inner_text() == "300 realisations"
    shown = rates(page)
    assert [row[0] for row in shown[:2]] == ["unstable", "unstable"]
    feedback, forward = (int(row[2].split()[0]) for row in shown[:2])
    worst_feedback, worst_forward = (float(row[6]) for row in shown[:2])
    assert feedback < forward
    assert worst_feedback > 1.5 > 1.02 > worst_forward
    verdict = page.locator(".verdict")
    expect(verdict).to_contain_text("less often than Forward path")
    expect(verdict).to_contain_text("A bare count misleads")
    names = python(page)
    table = names["rates"][names["rates"]["event"] == "unstable"]
    assert table["count"].tolist() == [feedback, forward]
    drawn = page.evaluate(
        "Bokeh.documents[0].get_model_by_name('poles').renderers"
        ".filter((r) => r.name.startsWith('points'))"
        ".map((r) => new Set(r.data_source.data.number).size)"
    )
    assert drawn[:2] == [300, 300]


def test_a_row_by_keyboard_leads_to_the_loop(visit: Open, server: Server) -> None:
    """Enter on a row draws its response; a button opens its loop on the other page."""
    page = visit()
    row = page.locator(".row").nth(5)
    row.focus()
    page.keyboard.press("Enter")
    page.wait_for_function("nmssStudy.picked() !== null")
    expect(page.locator(".row[aria-pressed=true]").first).to_be_visible()
    number = row.inner_text().split()[1]
    expect(page.locator(".drawn h2")).to_have_text(f"Realisation {number}")
    expect(page.locator(".drawn")).to_contain_text("b1")
    page.wait_for_function(
        "Bokeh.documents[0].get_model_by_name('output').renderers"
        ".filter((r) => r.name.startsWith('picked')"
        " && r.data_source.data.t.length > 5).length === 2"
    )
    page.get_by_role("button", name="Open on Receding horizon").click()
    page.wait_for_function("window.nmssPlayer?.frames > 0", timeout=60_000)
    assert page.url.startswith(f"{server.url}receding_horizon?case=drawn-")
    chosen = page.locator("select[name=case] option:checked")
    expect(chosen).to_contain_text(f"realisation {number}")
    expect(page.locator(".text-measures tbody tr")).to_have_count(2)
    expect(page.locator(".wrong")).to_have_count(0)
    expect(page.locator("input[name=dynamics]")).to_have_count(0)
    names = python(page)
    drawn = realisation(RobustnessChoices().plants(), int(number)).plant.plant()
    assert np.array_equal(names["example"].plant.A, drawn.A)


def test_a_wild_realisation_opens_too(visit: Open) -> None:
    """Its run is cut before it runs away, and the page says so."""
    page = visit()
    page.locator(".row").first.click()
    expect(page.locator(".drawn")).to_contain_text("grows without end")
    page.get_by_role("button", name="Open on Receding horizon").click()
    page.wait_for_function("window.nmssPlayer?.frames > 0", timeout=60_000)
    expect(page.locator(".wrong")).to_have_count(0)
    page.locator("summary", has_text="What this case assumes").click()
    expect(page.locator(".text-notes")).to_contain_text("the run is cut after")


def test_a_pole_can_be_clicked(visit: Open) -> None:
    """The realisation of the point under the mouse is shown."""
    page = visit(f"robustness?case={IFAC}&structures=wang_young")
    place = page.evaluate(PLACE)
    page.mouse.click(place["x"], place["y"])
    page.wait_for_function("nmssStudy.picked() !== null")
    assert page.evaluate("nmssStudy.picked()") == place["number"]
    page.get_by_role("button", name="Put it away").click()
    page.wait_for_function("nmssStudy.picked() === null")


def test_changes_start_small_studies_and_offer_large_ones(visit: Open) -> None:
    """What is shown of a large study stays until Run; the address restores it all."""
    page = visit()
    before = rates(page)
    enter(page, "n", "400")
    expect(page.locator(".stale")).to_contain_text("Choices have changed")
    assert rates(page) == before
    run = page.get_by_role("button", name="Run 400 realisations")
    finished = page.evaluate("nmssStudy.finished")
    run.click()
    page.wait_for_function(f"nmssStudy.finished > {finished}", timeout=60_000)
    expect(page.locator(".stale")).to_be_hidden()
    assert "of 400" in rates(page)[0][2]
    enter(page, "n", "60")
    page.wait_for_function(f"{DONE} && nmssStudy.shown() === 60", timeout=60_000)
    enter(page, "seed", "7")
    page.wait_for_function("location.search.includes('seed=7')")
    page.wait_for_function(STUDIED, timeout=60_000)
    expect(page.locator(".stale")).to_be_hidden()
    address = page.evaluate("location.pathname.slice(1) + location.search")
    again = visit(address)
    expect(again.locator("input[name=n]")).to_have_value("60")
    assert rates(again) == rates(page)


def test_a_large_study_grows_and_is_cancelled(visit: Open) -> None:
    """Its cloud grows, the form answers meanwhile, and Cancel keeps what there is."""
    page = visit()
    enter(page, "n", "10000")
    page.get_by_role("button", name="Run 10,000 realisations").click()
    page.wait_for_function(
        "nmssStudy.running() && nmssStudy.shown() >= 100", timeout=60_000
    )
    first = page.evaluate("nmssStudy.shown()")
    page.locator("select[name=measure]").select_option('"radius"')
    page.wait_for_function("nmssForm.idle()")
    page.wait_for_function(f"nmssStudy.shown() > {first}", timeout=60_000)
    assert page.evaluate("nmssStudy.running()")
    page.get_by_role("button", name="Cancel").click()
    page.wait_for_function("!nmssStudy.running()", timeout=60_000)
    shown = page.evaluate("nmssStudy.shown()")
    assert 100 <= shown < 10_000
    expect(page.locator(".note")).to_have_text(f"Cancelled: {shown:,} of 10,000 kept")
    expect(page.locator(".sheet tbody tr").first).to_contain_text(f"of {shown:,}")
    expect(page.locator(".worst")).to_contain_text("largest pole, modulus")
    expect(page.locator(".text-python")).to_contain_text(f"shows {shown} of these")


def test_root_loci_with_the_bounds_of_table_6_1(visit: Open) -> None:
    """The walk of b tells the printed bounds of both structures."""
    page = visit(f"robustness?case={IFAC}&cloud=b")
    told = page.locator(".told")
    # Table 6.1 prints 0.837 to 1.126 and 0.735 to 1.449, rounded inwards
    expect(told).to_contain_text("Wang-Young: 0.836 to 1.127", timeout=60_000)
    expect(told).to_contain_text("Forward path: 0.735 to 1.449")
    page.locator("select[name=cloud]").select_option('"a"')
    expect(told).to_contain_text("Wang-Young: 0.938 to 1.105", timeout=60_000)
    expect(told).to_contain_text("Forward path: 0.867 to 1.072")
    page.locator("select[name=cloud]").select_option('"draws"')
    expect(told).to_contain_text("Click a pole")


def test_tables_are_saved(visit: Open) -> None:
    """Rates and realisations come as CSV; the event follows its slider."""
    page = visit(f"robustness?case={IFAC}")
    assert rates(page)[-1][0] == "peak beyond 1.5"
    page.locator("input[name=peak]").evaluate(
        "(input) => { input.value = 1;"
        " input.dispatchEvent(new Event('input', { bubbles: true })) }"
    )
    page.wait_for_function("nmssForm.idle()")
    expect(page.locator(".sheet")).to_contain_text("peak beyond 1")
    for label, rows in (("Save rates as CSV", 8), ("Save all realisations", 64)):
        with page.expect_download() as got:
            page.get_by_role("button", name=label).click()
        text = Path(got.value.path()).read_text()
        assert len(list(csv.DictReader(io.StringIO(text)))) == rows


def test_bad_addresses_are_explained(visit: Open) -> None:
    """What cannot be is said; the rest is taken."""
    page = visit("robustness?n=20000&seed=4&uncertainty=stress")
    alert = page.get_by_role("alert")
    expect(alert).to_contain_text("n = '20000'")
    expect(page.locator("input[name=seed]")).to_have_value("4")
    page = visit("robustness?case=tuned-000000000000")
    expect(page.get_by_role("alert")).to_contain_text("no longer kept")
    page = visit("robustness?case=gasifier_6_3_4&n=9000", until=DONE)
    page.get_by_role("button", name="Run 9,000").click()
    expect(page.get_by_role("alert")).to_contain_text("choose up to 6666")
    page = visit("robustness?n=5000", until=DONE)
    expect(page.locator(".stale")).to_contain_text("Nothing studied yet")
    page.get_by_role("button", name="Reset all choices").click()
    page.wait_for_function(STUDIED, timeout=60_000)
    expect(page.locator("input[name=n]")).to_have_value("300")


@pytest.mark.parametrize(("width", "scheme"), [(390, "dark"), (1024, "light")])
def test_fits_the_screen_in_the_colours_asked_for(
    visit: Open, width: int, scheme: str
) -> None:
    """Nothing scrolls sideways; figures follow the scheme; the circle is round."""
    page = visit(f"robustness?case={IFAC}", width, color_scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for chart in page.locator(".chart").all():
        box = chart.bounding_box()
        assert box is not None
        assert box["width"] > 250
    label = "Bokeh.documents[0].get_model_by_name('poles').title.text_color"
    dark = page.evaluate(label)
    page.get_by_role("button", name="Light or dark colours").click()
    page.wait_for_function(f"{label} !== {json.dumps(dark)}")
    page.wait_for_function(ROUND)


def test_the_server_stops_while_a_study_runs(tmp_path: Path, browser: Browser) -> None:
    """A study of an hour does not keep the server, nor its processes."""
    own = Server(tmp_path / "own.log")
    try:
        context = browser.new_context()
        page = context.new_page()
        page.goto(f"{own.url}robustness?case=gasifier_6_3_4&n=5000")
        page.wait_for_function(DONE, timeout=60_000)
        page.get_by_role("button", name="Run 5,000 realisations").click()
        page.wait_for_function("nmssStudy.running()", timeout=60_000)
    finally:
        code, rest = own.stop()
    assert code == 0
    assert "stopped" in rest
    assert own.log.read_text() == ""
    context.close()


PLACE = """() => {
  const find = (view) => view.model?.name === "poles" ? view
    : (view.child_views ?? []).map(find).find(Boolean)
  const roots = Object.values(Bokeh.index.roots ?? Bokeh.index)
  const view = roots.map(find).find(Boolean)
  const { t, y, number } = view.model.renderers
    .find((r) => r.name === "points0").data_source.data
  // the pole farthest from the others, so that there is one under the mouse
  const near = (i) => Math.min(...Array.from(t, (x, j) =>
    j === i ? Infinity : Math.hypot(x - t[i], y[j] - y[i])))
  const distances = Array.from(t, (_, i) => near(i))
  const i = distances.indexOf(Math.max(...distances))
  const box = view.el.getBoundingClientRect()
  return { x: box.x + view.frame.x_scale.compute(t[i]),
    y: box.y + view.frame.y_scale.compute(y[i]), number: number[i] }
}"""
