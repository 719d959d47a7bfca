"""The page on state-dependent plants: choices, charts, and a real browser."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import Open, settled, slide
from playwright.sync_api import expect
from test_dashboard import anything, script_computes_what_is_shown, sliders

from apps.pages import state_dependent
from apps.pages.live import LivePage
from apps.session import HELD
from apps.varying import OWN, VaryingChoices
from nmss_lab.cases import VARYING_CASES
from nmss_lab.controller import Status
from nmss_lab.plots import draw, pack, varying_charts

PAGE = "state_dependent"
QUICK = "structures=frozen,gauss_newton"
"""Two controllers that answer fast."""

# --- Choices, without a browser ----------------------------------------------------


def test_every_choice_is_explained() -> None:
    """Each control has a label and a sentence of help, each slider has bounds."""
    choices = VaryingChoices(case=OWN)
    shown = [item for group in choices.description() for item in group["items"]]
    assert {item["name"] for item in shown} | {"input", "output", *HELD} == set(
        choices.names()
    )
    assert all(item["label"] and item["help"].endswith(".") for item in shown)
    assert all(low < high for _, low, high in sliders(choices))


@pytest.mark.parametrize("case", [*VARYING_CASES, OWN])
def test_every_case_opens(case: str) -> None:
    """Each case has six charts over time, four within a sample, and words for both."""
    choices = VaryingChoices(case=case)
    runs = choices.runs()
    charts = varying_charts(runs, choices.output, choices.input)
    assert [chart.name for chart in charts][-2:] == ["decrease", "passes"]
    assert case in state_dependent.LOOK
    assert np.isfinite(pack(charts)["data"]).all()
    assert state_dependent.SUBJECT.inside is not None
    within, words = state_dependent.SUBJECT.inside(choices)
    assert [chart.name for chart in within][:2] == ["change", "gap"]
    packed = pack(within)
    assert np.isfinite(packed["data"]).all()
    for said in words:
        assert len(said["which"]) == packed["samples"]
        assert max(said["which"]) == len(said["texts"]) - 1


@pytest.mark.parametrize(
    "given",
    [
        {"case": "bilinear_8_5_1"},
        {"damping": 0.0, "passes": 12, "tolerance": 1e-5, "Np": 8, "Nc": 3},
        {"structures": "integral_iterated", "weight_y": 2.0, "limit_du": "off"},
        {"y_start": 0.9, "u_start": 0.6, "step_y": 0.1, "step_at": 60},
        {"case": "conical_tank", "structures": "gauss_newton", "step_u": 20.0},
        {
            "case": "stirred_reactor",
            "structures": "newton",
            "warm_start": "frozen model",
        },
        {"case": OWN, "b1": "u[k-2]**2 + 0.3", "target": 1.2, "structures": "newton"},
    ],
)
def test_python_shown_computes_what_is_shown(given: dict[str, Any]) -> None:
    """The script of the page runs, and its runs and measures are those of the page."""
    script_computes_what_is_shown(VaryingChoices(**given))


def test_samples_that_did_not_settle_are_crossed() -> None:
    """Exactly those, in the output, the cost and the passes; in a notebook too."""
    choices = VaryingChoices(structures="frozen,iterated", passes=3)
    runs = choices.runs()
    unsettled = runs["iterated"].status == Status.UNSETTLED
    assert unsettled.any()
    charts = {chart.name: chart for chart in varying_charts(runs)}
    for name in ("output", "cost", "passes"):
        frozen, iterated = charts[name].curves
        assert np.array_equal(iterated.flags, unsettled)
        assert not frozen.flags.any()
    (row,) = draw([charts["passes"]]).children
    crosses = next(r for r in row[0].renderers if r.name == "flag1").data_source
    assert len(crosses.data["t"]) == unsettled.sum()


def test_passes_inside_end_where_the_run_did() -> None:
    """The last plan within a sample starts with the input that was applied there."""
    choices = VaryingChoices(inside=6)
    passes, best, _ = choices.passes_inside()
    for name, run in choices.runs().items():
        (found,) = [p for key, p in passes.items() if key.lower()[:5] == name[:5]]
        planned = float(found[-1].u[0, 0])
        # of a settled sample the last plan is within its tolerance of the optimum
        assert abs(planned - run.u[6, 0]) < 1e-4
        assert best.cost <= found[-1].cost * (1 + 1e-9)
        assert found[-1].status.sentence


def test_looking_elsewhere_runs_nothing_anew() -> None:
    """Another sample looked into leaves the runs as they are."""
    choices = VaryingChoices()
    before = choices.runs()
    choices.accept({"inside": 9})
    assert choices.runs() is before
    choices.accept({"damping": 0.4})
    assert choices.runs() is not before


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"b1": "y[k-1] +"}, "b\\[0, 0, 0\\]"),
        ({"a1": "__import__('os').system('x')"}, "a\\[0, 0, 0\\]"),
        ({"a1": "y[k]"}, "past"),
        ({"a1": "1/0"}, "finite"),
        ({"target": "1e9"}, "target"),
        ({"a1": "9" * 5000}, "expected 1 to 500"),
    ],
)
def test_equations_that_cannot_be_read_are_explained(
    given: dict[str, Any], message: str
) -> None:
    """The message names the coefficient; the last equation stays."""
    choices = VaryingChoices(case=OWN)
    before = choices.example
    with pytest.raises(ValueError, match=message):
        choices.accept({"case": OWN, **given})
    assert choices.example is before


def test_new_equation_starts_at_its_own_rest() -> None:
    """What was the old equation's rest gives way; a start of one's own stays."""
    choices = VaryingChoices(case=OWN)
    old = choices.values()
    choices.accept({**old, "b1": "0.5"})
    rest = choices.example.scenario.y0
    assert choices.y_start == pytest.approx(rest)
    assert choices.y_start != pytest.approx(old["y_start"])
    mine = VaryingChoices(case=OWN, b1="0.5", y_start=rest + 0.05)
    assert mine.y_start == pytest.approx(rest + 0.05)


def test_long_runs_are_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """After the time allowed there is a sentence that says what to do."""
    monkeypatch.setattr("apps.varying.PATIENCE", 0.02)
    with pytest.raises(ValueError, match=r"more than 0\.02 s.*fewer passes"):
        VaryingChoices(case="conical_tank").runs()


@pytest.mark.filterwarnings("error")
def test_any_combination_is_drawn_or_explained(rng: np.random.Generator) -> None:
    """Whatever is chosen, there is a finite picture or a sentence, nothing else."""
    drawn = 0
    for number in range(24):
        case = ("product_8_5_2", "bilinear_8_5_1", OWN)[number % 3]
        choices = VaryingChoices(case=case)
        anything(choices, rng)
        choices.passes = min(choices.passes, 20)
        choices.structures = [str(rng.choice(list(choices.example.designs)))]
        try:
            runs = choices.runs()
            within, _ = state_dependent.SUBJECT.inside(choices)
        except ValueError:  # says what was wrong; anything else fails here
            continue
        charts = varying_charts(runs, choices.output, choices.input)
        assert np.isfinite(pack(charts)["data"]).all()
        assert np.isfinite(pack(within)["data"]).all()
        drawn += 1
    assert drawn > 8


def test_a_fault_keeps_both_pictures() -> None:
    """An impossible choice is told; the runs and the passes shown stay."""
    page = LivePage(state_dependent.SUBJECT)
    assert page.inside is not None
    runs, inside = page.runs, page.inside.run
    page.controls.sent = {**page.choices.values(), "Np": 3, "Nc": 9, "message": 1}
    assert page.runs is runs
    assert page.inside.run is inside
    assert "Nc" in page.alert.object


# --- In the browser ------------------------------------------------------------------


def test_within_a_sample(visit: Open) -> None:
    """Passes play on their own; another sample is looked into from the player."""
    page = visit(f"{PAGE}?{QUICK}")
    settled(page)
    inside = page.get_by_role("group", name="Passes within the sample")
    inside.get_by_role("button", name="Play").click()
    page.wait_for_function("nmssInside.sample > 1")
    inside.get_by_role("button", name="Pause").click()
    assert page.evaluate("nmssPlayer.playing") is False
    inside.get_by_role("slider", name="Pass").fill("3")
    page.wait_for_function("nmssInside.sample === 3")
    expect(page.locator("#inside")).to_contain_text("Pass 4 along the plan")
    player = page.get_by_role("group", name="Player")
    player.get_by_role("slider", name="Sample").fill("9")
    player.get_by_role("button", name="Look into this sample").click()
    page.wait_for_function("location.search.includes('inside=9')")
    settled(page)
    expect(page.get_by_label("Sample looked into")).to_have_value("9")
    expect(page.locator(".wrong")).to_have_count(0)


def test_damping_and_passes_act(visit: Open) -> None:
    """Fewer passes leave samples unsettled, and the words say so."""
    page = visit(f"{PAGE}?structures=iterated")
    expect(page.locator("#status")).to_contain_text("A limit is active")
    slide(page, "passes", "min")
    expect(page.locator("#status")).to_contain_text("Passes ran out")
    page.get_by_role("button", name="Reset all choices").click()
    settled(page)
    expect(page.locator("#status")).not_to_contain_text("Passes ran out")


def test_own_equation(visit: Open) -> None:
    """Typed, refused with a reason, mended, and kept in the address."""
    page = visit(f"{PAGE}?case=own&{QUICK}")
    field = page.get_by_label("b1", exact=True)
    field.fill("0.2 + nothing[k-1]")
    field.press("Enter")
    expect(page.locator(".wrong")).to_contain_text("nothing")
    field.fill("0.2 + 0.1*u[k-2]**2")
    field.press("Enter")
    expect(page.locator(".wrong")).to_have_count(0)
    page.wait_for_function("location.search.includes('b1=')")
    settled(page)
    again = visit(page.url.rpartition("/")[2])
    expect(again.get_by_label("b1", exact=True)).to_have_value("0.2 + 0.1*u[k-2]**2")


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (1024, 768), (390, 844)])
def test_nothing_sticks_out(visit: Open, width: int, height: int) -> None:
    """At any width the page scrolls down only."""
    page = visit(f"{PAGE}?{QUICK}", width, height)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
