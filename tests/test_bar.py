"""The bar of designs: held, carried along, undone, saved, opened, downloaded."""

import contextlib
import html
import io
import os
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ALGEBRA, PATIENCE, REPLAY, Open, Server, settled, slide, watched
from playwright.sync_api import Browser, Page, expect
from test_dashboard import script_computes_what_is_shown

from apps import session
from apps.identification import IdentifyChoices, given
from apps.pages import governor, receding_horizon
from apps.pages.identify import IdentifyPage
from apps.pages.live import LivePage, _number
from apps.pages.robustness import RobustnessPage
from apps.pages.tune import TunePage
from apps.robustness import RobustnessChoices
from apps.session import (
    AsItIs,
    GovernorChoices,
    LoopChoices,
    Origin,
    held,
    held_as,
    keep_case,
    known_case,
    open_design,
)
from apps.varying import VaryingChoices
from nmss_lab.cases import LINEAR_CASES, case
from nmss_lab.cli import main
from nmss_lab.design import Design
from nmss_lab.files import Study, dumps, load, loads
from nmss_lab.measures import table
from nmss_lab.models import DifferenceModel
from nmss_lab.predict import Horizon
from nmss_lab.records import Record
from nmss_lab.simulate import Scenario, closed_loop

# --- Held designs ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "given", "name"),
    [
        (LoopChoices, {"Np": 30, "weight_move": 3.0, "limit_u": "off"}, "wang_young"),
        (LoopChoices, {"case": "shell_5_3_2"}, "integral_of_error_b"),
        (GovernorChoices, {"Np": 14, "reading": "decaying", "decay": 0.6}, "governor"),
        (GovernorChoices, {"case": "wood_berry"}, "pip"),
        (VaryingChoices, {"Np": 9, "damping": 0.2}, "iterated"),
        (VaryingChoices, {"case": "own", "a1": "-0.8 + 0.1*y[k-1]**2"}, "newton"),
    ],
)
def test_address_makes_the_design_again(kind: Any, given: Any, name: str) -> None:
    """What is held is the design with its choices, to the last digit."""
    choices = kind(**given)
    choices.structures = [name]
    wanted = choices.designs()[name]
    assert dumps(held(choices.hold(name)).design) == dumps(wanted)


def test_held_design_beside_others() -> None:
    """A design that is held runs on another page, and its script gives the same."""
    text = LoopChoices(Np=25, weight_move=5.0).hold("forward_path")
    for kind in (LoopChoices, RobustnessChoices, GovernorChoices):
        choices = kind(case="ifac93_6_3_3", A=text)
        first = "governor" if kind is GovernorChoices else "wang_young"
        choices.structures = [first, "A"]
        design = choices.designs()["A"]
        assert design.horizon == Horizon(25, 10)
        if kind is not RobustnessChoices:
            script_computes_what_is_shown(choices)


def test_held_varying_design_beside_others() -> None:
    """The same for a plant whose coefficients move."""
    text = VaryingChoices(Np=9).hold("iterated")
    script_computes_what_is_shown(VaryingChoices(B=text, structures="frozen,B"))


def test_study_counts_held_designs() -> None:
    """The script of a study that holds one runs, and gives the rates of the page."""
    text = LoopChoices(case="marginally_stable_6_3_2", Np=12).hold("wang_young")
    choices = RobustnessChoices(A=text, structures="wang_young,A", n=5)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(choices.script(), "shown", "exec"), {})
    assert "A" in printed.getvalue()
    name = choices.keep_drawn(2)
    assert list(known_case(name).designs) == ["wang_young", "A"]


def test_what_does_not_fit_says_why() -> None:
    """Another number of outputs, or another clock, is refused in words."""
    tanks = LoopChoices(case="quadruple_tank_minus").hold("wang_young")
    slow = LoopChoices(case="marginally_stable_6_3_2").hold("wang_young")
    choices = LoopChoices(A=tanks, B=slow)
    assert "2 outputs" in choices.misfit(tanks)
    assert "every 1 s, not every 0.5 s" in choices.misfit(slow)
    assert not {"A", "B"} & set(choices.param["structures"].objects)
    with pytest.raises(ValueError, match="A cannot be shown here, it is for 2 outputs"):
        LoopChoices(A=tanks, structures="A").designs()
    with pytest.raises(ValueError, match="no design is held as such"):
        LoopChoices(structures="B").designs()


@pytest.mark.parametrize(
    "text",
    [
        "nonsense",
        "nowhere?case=ifac93_6_3_3&structures=wang_young",
        "receding_horizon?structures=wang_young",
        "receding_horizon?case=none&structures=wang_young",
        "receding_horizon?case=ifac93_6_3_3&structures=wang_young,minimal",
        "receding_horizon?case=ifac93_6_3_3&structures=A",
        "receding_horizon?case=ifac93_6_3_3&structures=wang_young&Np=2&Nc=9",
        "case?case=tuned-0123456789ab&structures=tuned",
    ],
)
def test_what_is_no_design_is_refused(text: str) -> None:
    """An address with something else as A keeps all other choices."""
    choices = LoopChoices()
    with pytest.raises(ValueError, match="A = "):
        choices.accept({"A": text, "Np": 33})
    assert (choices.A, choices.Np) == ("", 33)


def test_hold_stays_through_cases_and_reset() -> None:
    """Another case, or a reset, lets nothing go."""
    page = LivePage(receding_horizon.SUBJECT)
    page.bar.sent = {"act": "hold", "which": "A", "name": "wang_young", "number": 1}
    first = held(page.choices.A)
    page.controls.sent = {"case": "wood_berry", "message": 1}
    page.controls.sent = {"reset": True, "message": 2}
    assert held(page.choices.A) is first
    assert first.name == "wang_young"
    page.bar.sent = {"act": "compare", "number": 2}
    assert page.choices.structures == ["A", "wang_young"]
    assert list(page.runs) == ["A", "wang_young"]
    page.bar.sent = {"act": "release", "which": "A", "number": 3}
    assert page.choices.A == ""
    assert page.choices.structures == ["wang_young"]
    assert page.alert.object == ""


def test_tuned_design_is_held_exactly() -> None:
    """What is held on Tune is the design itself, whatever made it."""
    page = TunePage()
    page.bar.sent = {"act": "hold", "which": "B", "name": "before", "number": 1}
    assert dumps(held(page.choices.B).design) == dumps(page.place.before)
    page.bar.sent = {"act": "compare", "number": 2}
    assert list(page._designs()) == ["B", "present"]
    assert "<th>" in page.measures.object
    page.bar.sent = {"act": "save", "name": "B", "number": 3}
    study = loads(page.bar.saved["text"])
    assert dumps(study.design) == dumps(page.place.before)
    page.bar.sent = {"act": "csv", "name": "present", "number": 4}
    assert page.bar.saved["text"].startswith("time [s],y1")


def searched(page: IdentifyPage) -> None:
    """Search, and wait until that has ended."""
    page._begin()
    until = time.monotonic() + 60.0
    while page.work is not None:
        assert time.monotonic() < until
        time.sleep(0.01)


def test_held_models_are_drawn_on_identify() -> None:
    """Compared beside the first row: simulated as fitted, and in the page's link."""
    page = IdentifyPage()
    searched(page)
    page._choose([0, 2])
    first, second = page.compared.values()
    page.bar.sent = {"act": "hold", "which": "A", "name": str(second.orders)}
    assert page.choices.beside == []  # held, and not drawn before that is asked for
    assert list(page.shown) == [str(first.orders), str(second.orders)]
    page.bar.sent = {"act": "compare", "number": 2}
    assert page.alert.object == ""
    assert list(page.shown) == [str(first.orders), "design A"]
    assert page.ranking.chosen == [0, "A"]
    (row,) = page.ranking.held
    fitted = page.ranking.rows[2]
    assert row["checked"] == pytest.approx(fitted["checked"], rel=ALGEBRA)
    # its past is fitted by least squares, the other's by instrumental variables
    assert fitted["r2_t"] <= row["r2_t"] < fitted["r2_t"] + 1e-3
    drawn = page.figures["output"].curves[1].data["y"]
    assert np.isfinite(drawn).sum() == len(page.choices.whole.time)
    assert len(page.figures["poles"].points[1].data["t"]) == second.orders.na
    assert len(page.figures["step"].bands[1].data["t"]) == 0  # no uncertainty is known
    assert f"<td>{_number(second.parameters[0])}</td>" in page.measures.object
    again = IdentifyChoices()
    again.accept({k: ",".join(v) if k == "beside" else v for k, v in linked(page)})
    assert (again.A, again.beside) == (page.choices.A, ["A"])
    page.bar.sent = {"act": "release", "which": "A", "number": 3}
    assert list(page.shown) == [str(first.orders)]
    assert (page.ranking.held, page.choices.beside) == ([], [])


def linked(page: IdentifyPage) -> list[tuple[str, Any]]:
    """Return what the link to a page states."""
    usual = page.choices.defaults()
    return [(k, v) for k, v in page.choices.values().items() if v != usual[k]]


def test_identify_checks_held_models_in_python() -> None:
    """The script prints what the ranking says of a held model, to the last digit."""
    page = IdentifyPage()
    searched(page)
    page._choose([2])
    (name,) = page.compared
    page.bar.sent = {"act": "hold", "which": "B", "name": name, "number": 1}
    page._choose([0])
    page.bar.sent = {"act": "compare", "number": 2}
    printed = io.StringIO()
    shown = html.unescape(page.python.object.partition(">")[2].removesuffix("</pre>"))
    with contextlib.chdir(Path(__file__).parent), contextlib.redirect_stdout(printed):
        exec(compile(shown.replace("model.json", os.devnull), "shown", "exec"), {})
    (row,) = page.ranking.held
    assert float(printed.getvalue().splitlines()[-1]) == row["checked"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (LoopChoices(case="wood_berry").hold("wang_young"), "2 outputs, this record"),
        (LoopChoices(case="ifac93_6_3_3").hold("wang_young"), "not every 9 s"),
        (VaryingChoices().hold("iterated"), "state-dependent"),
    ],
)
def test_identify_says_what_does_not_fit(text: str, says: str) -> None:
    """Other sizes, another clock, coefficients that move: in words, and not drawn."""
    page = IdentifyPage()
    page._put({"A": text, "beside": ["A"]})
    assert says in page.ranking.held[0]["problem"]
    assert not page.ranking.held[0]["usable"]
    assert page.shown == {}
    assert says in page.bar.told["held"]["A"]["misfit"]
    assert page.alert.object == ""


def test_identify_draws_no_unstable_model() -> None:
    """An integrator has no fit to tell of: said in words."""
    design = Design("wang_young", DifferenceModel([-1.0], [0.1], dt=9.0))
    case = open_design(dumps(design)).partition("case=")[2]
    page = IdentifyPage()
    page._put({"A": held_as("case", case, "wang_young"), "beside": ["A"]})
    assert "not stable" in page.ranking.held[0]["problem"]
    assert page.shown == {}


def test_models_held_elsewhere_are_simulated() -> None:
    """Measured disturbances, delays and dead coefficients come over to the record."""
    b = [[[0.0, 0.0]], [[0.0, 0.3]], [[0.0, 0.2]]]
    model = DifferenceModel([-0.9, 0.0], b, [[[0.0]], [[0.4]]])
    rng = np.random.default_rng(4)
    u, v = rng.standard_normal((80, 2)), rng.standard_normal((80, 1))
    y = model.simulate(u, v)
    found = given(model, Record(np.arange(80.0), y, u, v), "rest")
    assert str(found.orders) == "[1 1 2 1 1 2 2]"
    assert np.abs(found.simulated - y[:, 0]).max() <= ALGEBRA * np.abs(y).max() * 80
    assert found.r2_t == pytest.approx(1.0, abs=ALGEBRA)


def test_held_model_controls() -> None:
    """A model held on Identify is a design on other pages."""
    page = IdentifyPage()
    searched(page)
    (name,) = page.compared
    page.bar.sent = {"act": "hold", "which": "A", "name": name, "number": 1}
    assert page.alert.object == ""
    found = held(page.choices.A)
    assert found.design.structure == "wang_young"
    assert found.design.model.dt == page.choices.whole.dt
    page.bar.sent = {"act": "save", "name": name, "number": 2}
    assert loads(page.bar.saved["text"]).orders == page.compared[name].orders


# --- Files ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", LINEAR_CASES)
def test_saved_design_gives_the_same_numbers(name: str, tmp_path: Path) -> None:
    """File, page, Python and command line agree to the last digit."""
    choices = LoopChoices(case=name, step_u=LoopChoices(case=name).param.step_u.step)
    structure = choices.structures[0]
    file = tmp_path / "design.json"
    file.write_text(dumps(choices.study_of(structure)), encoding="utf-8")
    study = load(file)
    run = closed_loop(study.plant, study.design.build(), study.scenario)
    here = choices.runs()[structure]
    assert np.array_equal(run.y, here.y)
    leads = open_design(file.read_text(encoding="utf-8"))
    page, _, query = leads.partition("?case=")
    assert page == "receding_horizon"
    opened = LoopChoices(case=query)
    again = opened.runs()[opened.structures[0]]
    assert np.abs(again.y - here.y).max() <= REPLAY * np.abs(here.y).max()
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert main(["simulate", str(file), "--csv", str(tmp_path / "run.csv")]) == 0
    kept = Record.from_file(
        tmp_path / "run.csv",
        y=run.controller.model.y_names,
        u=run.controller.model.u_names,
        time="time",
    )
    assert np.array_equal(kept.y, run.y)
    assert f"{table({'x': run})[0]['IAE']:.5g}" in out.getvalue()


@pytest.mark.parametrize(
    ("name", "structure", "page"),
    [
        ("governor_3_4", "governor", "governor"),
        ("ifac93_4_4_2", "pip", "governor"),
        ("product_8_5_2", "iterated", "state_dependent"),
        ("bilinear_8_5_1", "sdp_governor", "state_dependent"),
        ("bilinear_8_5_1", "sdp_pip", "state_dependent"),
    ],
)
def test_each_kind_opens_where_it_is_shown(
    name: str, structure: str, page: str
) -> None:
    """A governor opens on its page, a state-dependent design on its own."""
    example = case(name)
    design = example.designs[structure]
    text = dumps(Study(design, example.plant, example.scenario))
    path, _, kept = open_design(text).partition("?case=")
    assert path == page
    kind = {"governor": GovernorChoices, "state_dependent": VaryingChoices}[page]
    choices = kind(case=kept)
    run = choices.runs()[design.structure]
    expected = closed_loop(example.plant, design.build(), example.scenario)
    assert np.abs(run.y - expected.y).max() <= REPLAY * np.abs(expected.y).max()


def test_bare_design_and_model_open_too() -> None:
    """A design without plant and scenario gets both; a record is sent elsewhere."""
    design = case("wood_berry").designs["wang_young"]
    path, _, kept = open_design(dumps(design)).partition("?case=")
    assert path == "receding_horizon"
    assert LoopChoices(case=kept).runs()
    record = Record([0.0, 1.0, 2.0], [[0.0], [1.0], [2.0]], [[0.0], [1.0], [1.0]])
    with pytest.raises(ValueError, match="holds a record"):
        open_design(dumps(record))


def test_broken_file_keeps_the_page() -> None:
    """What is wrong is said, with the name of the file as text."""
    page = LivePage(receding_horizon.SUBJECT)
    before = page.runs
    for number, (text, says) in enumerate(
        [
            ("", "not a JSON file"),
            ("[]", "version"),
            ('{"nmss_lab": 99, "content": 1}', "update NMSS Lab"),
            (dumps(case("wood_berry").designs["wang_young"])[:900], "not a JSON file"),
        ]
    ):
        name = "<img src=x onerror=alert(1)>.json"
        sent = {"act": "open", "name": name, "size": len(text), "text": text}
        page.bar.sent = {**sent, "number": number}
        assert says in page.alert.object
        assert "<img" not in page.alert.object
        assert page.runs is before
    page.bar.sent = {"act": "open", "name": "big", "size": 3_000_000, "number": 9}
    assert "3 MB" in page.alert.object
    page.controls.sent = {**page.choices.values(), "message": 1}
    assert page.alert.object == ""


def dear_governor(samples: int) -> Study:
    """Return a governor whose output limits may give way over a long horizon."""
    example = case("governor_3_4")
    design = example.designs["governor"]
    limits = replace(design.limits, y=(-0.5, 0.5))
    design = replace(design, horizon=Horizon(80, 80), limits=limits)
    return Study(design, example.plant, Scenario(np.ones((samples, 1))))


def unstable() -> Study:
    """Return a design on a plant that it drives away."""
    design = Design("wang_young", DifferenceModel([-0.9], [0.1]))
    plant = DifferenceModel([-1.5], [-0.1]).plant()
    return Study(design, plant, Scenario(np.ones((300, 1))))


@pytest.mark.parametrize(
    ("made", "says"),
    [
        (lambda: dear_governor(20_000), "times as long as an answer may"),
        (unstable, "the loop is unstable"),
        (
            lambda: Design(
                "pip", DifferenceModel([-0.9], [0.1]), options={"K": [[9.0, 9.0]]}
            ),
            "K does not stabilise the model",
        ),
    ],
)
def test_what_its_page_cannot_show_is_not_opened(made: Any, says: str) -> None:
    """Runs beyond the budget or all bounds are refused, and the page stays."""
    page = LivePage(receding_horizon.SUBJECT)
    before, text = page.runs, dumps(made())
    page.bar.sent = {"act": "open", "name": "f", "size": len(text), "text": text}
    assert "f: " in page.alert.object
    assert says in page.alert.object
    assert page.runs is before
    assert page.bar.leads == {}


def test_long_runs_are_not_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that is cheap by the sample, and has too many of them, is given up."""
    design = Design("wang_young", DifferenceModel([-0.9], [0.1]))
    long, short = (
        dumps(Study(design, None, Scenario(np.ones((samples, 1)))))
        for samples in (100_000, 100)
    )
    assert open_design(short)
    monkeypatch.setattr(session, "TRIAL", 0.2)
    with pytest.raises(ValueError, match=r"more than 0\.2 s, \d\d?% of all were done"):
        open_design(long)


def test_kept_case_that_is_gone_is_named() -> None:
    """An address with an opened file that the server has forgotten says so."""
    with pytest.raises(ValueError, match="open it again"):
        LoopChoices(case="opened-0123456789ab")


def test_as_it_is_takes_any_design() -> None:
    """A kept PIP design is held, too."""
    example = case("ifac93_4_4_2")
    name = keep_case("tuned", "a test", example, known_origin())
    text = held_as("case", name, "pip")
    choices = LoopChoices(case="ifac93_4_4_2", A=text, structures="wang_young,A")
    assert choices.designs()["A"] is example.designs["pip"]
    script_computes_what_is_shown(choices)
    assert AsItIs(case=name).structures == ["integral_of_error"]


def known_origin() -> Origin:
    """Say how the test's case is made."""
    imports = ("from nmss_lab.cases import case",)
    return Origin(imports, ('example = case("ifac93_4_4_2")',))


def test_governor_page_takes_every_linear_case() -> None:
    """A governor comes over any gain; the script says so, too."""
    page = LivePage(governor.SUBJECT)
    for name in LINEAR_CASES:
        page.controls.sent = {"case": name, "message": 1}
        assert page.alert.object == "", name
    script_computes_what_is_shown(GovernorChoices(case="gasifier_6_3_4"))


def test_robustness_page_holds() -> None:
    """Hold and compare there, too."""
    page = RobustnessPage()
    page.bar.sent = {"act": "hold", "which": "A", "name": "wang_young", "number": 1}
    page.bar.sent = {"act": "compare", "number": 2}
    assert page.choices.structures == ["A", "wang_young"]
    assert page.alert.object == ""


# --- In the browser -------------------------------------------------------------------

READY = "window.nmssPlayer?.frames > 0 && document.querySelector('.designbar *')"


@pytest.fixture
def visit(server: Server, browser: Browser) -> Iterator[Open]:
    """Yield a function that opens a page with player and bar."""
    with watched(server, browser, READY) as open_page:
        yield open_page


def hold(page: Page, which: str, label: str) -> None:
    """Hold a design by the bar's menu."""
    page.locator("summary", has_text=f"{which}:").click()
    page.get_by_role("button", name=f"Hold {label} as {which}").click()
    settled(page)


def test_undo_and_redo(visit: Open) -> None:
    """Buttons and keys take choices back, one hand's movement at a time."""
    page = visit("receding_horizon?case=governor_3_4")
    undo = page.get_by_role("button", name="Undo")
    redo = page.get_by_role("button", name="Redo")
    expect(undo).to_be_disabled()
    slider = page.locator("input[name=Np]")
    first = slider.input_value()
    for value in ("21", "22", "23", "24"):  # one movement
        slider.evaluate(
            "(input, value) => { input.value = value;"
            " input.dispatchEvent(new Event('input', { bubbles: true })) }",
            value,
        )
    settled(page)
    page.locator("select[name=case]").select_option('"wood_berry"')
    settled(page)
    expect(page.locator("input[name=weight_y]")).to_be_visible()
    undo.click()
    settled(page)
    expect(page.locator("select[name=case]")).to_have_value('"governor_3_4"')
    expect(slider).to_have_value("24")
    page.locator("h1").click()
    page.keyboard.press("Control+z")
    settled(page)
    expect(slider).to_have_value(first)
    expect(undo).to_be_disabled()
    page.keyboard.press("Control+Shift+z")
    settled(page)
    expect(slider).to_have_value("24")
    redo.click()
    settled(page)
    expect(page.locator("select[name=case]")).to_have_value('"wood_berry"')
    expect(redo).to_be_disabled()
    expect(page.locator(".wrong")).to_have_count(0)


def test_design_travels(visit: Open) -> None:
    """Case, horizons and held designs go from page to page, and come back."""
    page = visit("receding_horizon?case=marginally_stable_6_3_2")
    hold(page, "A", "Wang-Young")
    slide(page, "Nc", "max")
    slide(page, "Np", "max")
    page.wait_for_function("location.search.includes('Np=80')")
    page.get_by_role("link", name="Robustness").click()
    page.wait_for_function("window.nmssStudy && nmssForm.idle()")
    expect(page.locator("select[name=case]")).to_have_value('"marginally_stable_6_3_2"')
    expect(page.locator("input[name=Np]")).to_have_value("80")
    expect(page.locator("summary", has_text="A: Wang-Young")).to_be_visible()
    expect(page.locator(".wrong")).to_have_count(0)
    assert "via" not in page.url
    page.get_by_role("link", name="State-dependent").click()
    page.wait_for_function(READY)
    expect(page.get_by_role("alert")).to_contain_text("example of its own")
    page.get_by_role("link", name="Receding horizon").click()
    page.wait_for_function(READY)
    expect(page.locator("select[name=case]")).to_have_value('"marginally_stable_6_3_2"')
    expect(page.locator("input[name=Np]")).to_have_value("80")
    page.get_by_role("button", name="A | B").click()
    settled(page)
    expect(page.locator("#status p")).to_have_count(2)
    page.reload()  # the address restores it
    page.wait_for_function(READY)
    expect(page.locator("#status p")).to_have_count(2)
    expect(page.locator("summary", has_text="A: Wang-Young")).to_be_visible()


def chosen(page: Page, name: str) -> Path:
    """Choose from the menu of files; return what is downloaded."""
    page.locator("summary", has_text="File").click()
    with page.expect_download(timeout=PATIENCE) as download:
        page.get_by_role("button", name=name).first.click()
    return Path(download.value.path())


def test_save_open_and_pictures(visit: Open, tmp_path: Path) -> None:
    """A design goes out to a file and in again; runs and figures are files, too."""
    page = visit("receding_horizon?case=governor_3_4&Np=17&step_u=0.5")
    measured = page.locator(".text-measures tbody tr").first.inner_text()
    saved = chosen(page, "Design file of Wang-Young")
    study = load(saved)
    assert study.design.horizon.Np == 17
    run = closed_loop(study.plant, study.design.build(), study.scenario)
    lines = chosen(page, "Run of Wang-Young as CSV").read_text().splitlines()
    assert lines[0] == "time [s],y1,u1,r1"
    assert [float(x) for x in lines[-1].split(",")][1] == run.y[-1, 0]
    picture = ET.fromstring(chosen(page, "Figures as SVG").read_text())
    assert len(picture) == page.locator(".chart").count()
    assert sum(1 for _ in picture.iter()) > 200
    image = chosen(page, "Figures as PNG").read_bytes()
    assert image[:8] == b"\x89PNG\r\n\x1a\n"
    assert len(image) > 20_000
    other = visit("robustness", until="window.nmssStudy")
    file = tmp_path / "design.json"
    file.write_bytes(saved.read_bytes())
    other.get_by_label("Design file").set_input_files(file)
    other.wait_for_url("**/receding_horizon?case=opened-*")
    other.wait_for_function(READY)
    row = other.locator(".text-measures tbody tr").first
    expect(row).to_have_text(measured, use_inner_text=True)


def test_broken_file_in_the_browser(visit: Open, tmp_path: Path) -> None:
    """A file that is none is explained; one that is too large is not read."""
    page = visit("receding_horizon?case=governor_3_4")
    for name, content, says in (
        ("notes.json", b"hello", "not a JSON file"),
        ("latin.json", "é".encode("latin-1"), "not a JSON file"),
        ("large.json", b"[" + b"0," * 1_500_000, "3 MB"),
    ):
        file = tmp_path / name
        file.write_bytes(content)
        page.get_by_label("Design file").set_input_files(file)
        expect(page.get_by_role("alert")).to_contain_text(says)
        expect(page.get_by_role("alert")).to_contain_text(name)
    slide(page, "Np", "max")
    expect(page.locator(".wrong")).to_have_count(0)


def test_menus_by_keyboard(visit: Open) -> None:
    """A menu opens with Enter, is gone through with Tab, and closes with Escape."""
    page = visit("receding_horizon?case=governor_3_4")
    page.locator("summary", has_text="A:").focus()
    page.keyboard.press("Enter")
    item = page.get_by_role("button", name="Hold Wang-Young as A")
    expect(item).to_be_visible()
    page.keyboard.press("Tab")
    expect(item).to_be_focused()
    page.keyboard.press("Escape")
    expect(item).to_be_hidden()
    expect(page.locator("summary", has_text="A:")).to_be_focused()


def test_microscope_follows_the_player(visit: Open) -> None:
    """Limits of the sample, their prices, and words where there are none."""
    page = visit("receding_horizon?case=ifac93_6_3_3&structures=wang_young")
    example = case("ifac93_6_3_3")
    run = closed_loop(
        example.plant, example.designs["wang_young"].build(), example.scenario
    )
    k = int(np.flatnonzero(run.active.any(axis=1))[0])
    table = page.locator("table.prices")
    scrub = page.get_by_role("slider", name="Sample")
    scrub.fill(str(k))
    expect(table).to_contain_text("u1 ≥ −5")
    price = 2.0 * np.abs(run.multipliers[k]).max()
    expect(table).to_contain_text(f"{price:.3g}")
    scrub.fill("5")
    expect(table).to_contain_text("no limit holds the plan")


def test_server_says_nothing_bad(server: Server) -> None:
    """All of the above leaves no fault in the log."""
    assert server.faults() == []
