"""The page on measured disturbances: choices, words, plans, and a real browser."""

from __future__ import annotations

import contextlib
import io
from typing import Any

import numpy as np
import pytest
from conftest import ALGEBRA, DECISION, REPLAY, Open, Server, settled, slide
from PIL import Image
from playwright.sync_api import Page, expect
from test_dashboard import anything, sliders

from apps.disturbances import AUGMENTED, DIRECT, TRIO, WITHOUT, DisturbanceChoices
from apps.pages import disturbances
from apps.pages.disturbances import DisturbancePage, floor
from apps.session import HELD, open_design, plain
from nmss_lab.cases import case
from nmss_lab.design import Design
from nmss_lab.files import dumps
from nmss_lab.measures import iae, rejection, table
from nmss_lab.models import Array, DifferenceModel
from nmss_lab.plots import disturbance_charts, pack
from nmss_lab.simulate import closed_loop

PAGE = "disturbances"
SISO = "measured_disturbance_7_4_1"
HALL = "temperature_7_4_2"
ALL = ",".join(TRIO)

# --- The library behind it ----------------------------------------------------------


def along(latest: Array, steps: int) -> Array:
    """Return a straight line through the latest two values, one value a step."""
    return np.array(
        [latest[0] + i * (latest[0] - latest[1]) for i in range(1, steps + 1)]
    )


@pytest.mark.parametrize("structure", [DIRECT, AUGMENTED])
def test_line_is_the_line_through_the_latest_two(structure: str) -> None:
    """The named forecast does what a function that says the same does."""
    example = case(SISO)
    runs = [
        closed_loop(
            example.plant,
            Design(
                structure, example.model, options={"forecast": forecast}, R=0.1
            ).build(),
            example.scenario,
        )
        for forecast in ("line", along)
    ]
    assert np.abs(runs[0].u - runs[1].u).max() <= REPLAY
    assert not np.allclose(runs[0].u, DisturbanceChoices(case=SISO).runs()[DIRECT].u)


def test_rejection_counts_from_its_sample() -> None:
    """Peak, integral and travel are those of the samples from there on."""
    run = DisturbanceChoices(case=SISO).runs()[DIRECT]
    found = rejection(run, 50)
    error = np.abs(run.y - run.r)[50:, 0]
    assert found["peak"] == error.max()
    assert found["IAE"] == pytest.approx(error.sum(), rel=ALGEBRA)
    assert found["IAE"] == iae(run, 0, 50)
    assert found["travel"] == np.abs(run.du[50:]).sum()
    for wrong in ({"first": 100}, {"first": 0, "input": 1}, {"first": 0, "channel": 1}):
        with pytest.raises(ValueError, match=f"{list(wrong)[-1]} = "):
            rejection(run, **wrong)


@pytest.mark.parametrize("forecast", ["held", "line", "given"])
def test_expected_disturbance_is_what_the_plan_took(forecast: str) -> None:
    """Outputs rolled out with the drawn expectation are those the plan predicts."""
    choices = DisturbanceChoices(case=SISO, forecast=forecast, structures=ALL)
    runs = choices.runs()
    model = choices.example.model
    (drawn,) = [c for c in disturbance_charts(runs) if c.name == "disturbance"]
    assert [curve.label for curve in drawn.curves] == [DIRECT, AUGMENTED]
    for curve in drawn.curves:
        run, k = runs[curve.label], 37
        v = [run.v[k - 1, 0], *curve.trail[k]]
        u = [run.u[k - 1, 0], *run.trail("u")[k, :, 0]]
        y = [run.y[k - 1, 0], run.y[k, 0]]
        for i in range(10):
            a, b, g = model.a.ravel(), model.b.ravel(), model.g.ravel()
            y.append(-a @ [y[-1], y[-2]] + b @ [u[i + 1], u[i]] + g @ [v[i + 1], v[i]])
        assert np.abs(np.array(y[2:]) - run.trail("y")[k, :, 0]).max() <= REPLAY
        truth = run.v[k : k + 10, 0]
        assert np.array_equal(curve.trail[k], truth) == (forecast == "given") or (
            np.abs(curve.trail[k] - truth).max() <= ALGEBRA
        ) == (forecast == "given")


def test_charts_refuse_a_disturbance_that_is_not_there() -> None:
    """A channel that no model has is refused by name."""
    runs = DisturbanceChoices(case=SISO).runs()
    with pytest.raises(ValueError, match="disturbance = 1"):
        disturbance_charts(runs, 0, 0, 1)


def test_plan_belongs_to_the_model() -> None:
    """Zones and actuators of the plan are outputs and inputs, and fill the building."""
    example = case(HALL)
    plan, model = example.plan, example.model
    assert plan is not None
    assert sorted(z.output for z in plan.zones if z.output is not None) == [0, 1]
    for zone in plan.zones:
        if zone.output is not None:
            assert zone.name.lower() == model.y_names[zone.output].lower()
    assert sorted(each.input for each in plan.actuators) == [0, 1]
    assert 0 <= plan.outside < model.n_v
    ends = [zone.left + zone.length for zone in plan.zones]
    assert [zone.left for zone in plan.zones] == [0.0, *ends[:-1]]
    assert ends[-1] == plan.length
    assert any("schematic" in note for note in example.notes)


# --- Choices, without a browser ------------------------------------------------------


@pytest.mark.parametrize("name", DisturbanceChoices.cases())
def test_every_case_opens(name: str) -> None:
    """Each case has its charts, words on what to look at, and choices explained."""
    choices = DisturbanceChoices(case=name)
    charts = disturbance_charts(choices.runs())
    assert [chart.name for chart in charts] == [
        *("output", "input", "disturbance", "increment", "error")
    ]
    assert np.isfinite(pack(charts)["data"]).all()
    assert name in disturbances.LOOK
    shown = [item for group in choices.description() for item in group["items"]]
    hidden = {"output", "input", "disturbance"}
    assert {item["name"] for item in shown} | hidden == {*choices.names(), *hidden} - {
        *HELD
    }
    assert all(item["label"] and item["help"].endswith(".") for item in shown)
    assert all(low < high for _, low, high in sliders(choices))


def test_cases_are_those_with_a_measured_disturbance() -> None:
    """The two of chapter 7 come first."""
    assert DisturbanceChoices.cases() == [SISO, HALL, "wood_berry"]
    with pytest.raises(ValueError, match="no such case"):
        DisturbanceChoices(case="governor_3_4")


@pytest.mark.parametrize(
    "given",
    [
        {"case": SISO, "structures": ALL, "forecast": "line", "path": 30.0},
        {"case": SISO, "shape": "sine", "length": 13, "size": 0.7, "gain": 10.0},
        {"case": SISO, "times": 1.5, "structures": WITHOUT, "limit_u": "own"},
        {"case": HALL, "times": 0.5, "forecast": "given", "output": 1, "Np": 15},
        {"case": HALL, "shape": "ramp", "length": 80, "onset": 300},
        {"case": "wood_berry", "shape": "step", "size": -0.2, "weight_move": 3.0},
    ],
)
def test_python_shown_computes_what_is_shown(given: dict[str, Any]) -> None:
    """The script runs; its runs and both tables are those of the page."""
    choices = DisturbanceChoices(**given)
    names: dict[str, Any] = {}
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(choices.script(), "shown", "exec"), names)
    runs = choices.runs()
    assert list(names["runs"]) == list(runs)
    for name, run in runs.items():
        scale = np.abs(run.y).max()
        for signal in ("y", "u", "v"):
            ours, theirs = getattr(run, signal), getattr(names["runs"][name], signal)
            assert np.abs(theirs - ours).max() <= REPLAY * scale
    rows = [str(row) for row in table(runs, choices.output)]
    rejected = [f"{name} {row}" for name, row in choices.rejected(runs).items()]
    assert printed.getvalue().splitlines() == rows + rejected


@pytest.mark.parametrize("name", [SISO, HALL])
def test_direct_and_augmented_are_one_controller(name: str) -> None:
    """Whatever the forecast, and the page says so."""
    for forecast in ("held", "line", "given"):
        choices = DisturbanceChoices(case=name, structures=ALL, forecast=forecast)
        runs = choices.runs()
        assert np.abs(runs[DIRECT].u - runs[AUGMENTED].u).max() <= DECISION
        assert "one controller" in " ".join(choices.verdict(runs))


def test_words_say_what_the_numbers_say() -> None:
    """The comparison names the change of each measure, up or down."""
    for given in ({"case": SISO}, {"case": HALL}, {"case": HALL, "forecast": "line"}):
        choices = DisturbanceChoices(**given)
        runs = choices.runs()
        found = choices.rejected(runs)
        said = choices.verdict(runs)[0]
        for key, word in (("peak", "peak deviation"), ("IAE", "IAE")):
            share = 100 * (found[DIRECT][key] / found[WITHOUT][key] - 1)
            change = f"{abs(share):.0f} % {'less' if share < 0 else 'more'}"
            assert f"{word} {change}" in said
    assert (
        "more"
        in DisturbanceChoices(case=HALL).verdict(DisturbanceChoices(case=HALL).runs())[
            0
        ]
    )  # held is worse on average than not to measure: lesson 07


def test_samples_at_a_limit_are_counted() -> None:
    """As many as a comparison with the limits finds."""
    choices = DisturbanceChoices(case=HALL, structures=WITHOUT)
    run = choices.runs()[WITHOUT]
    u = run.u[choices.onset :]
    low, high = run.controller.limits.of("u", 2)
    count = int((np.isclose(u, low) | np.isclose(u, high)).any(axis=1).sum())
    assert count > 0
    assert (
        f"of 250, with an input at its limit: Wang-Young {count}."
        in (choices.verdict(choices.runs())[-1])
    )


def test_measured_disturbance_lets_it_act_earlier() -> None:
    """What the page says of the door: the inlet moves before the zones feel it."""
    runs = DisturbanceChoices(case=HALL).runs()
    told, not_told = runs[DIRECT], runs[WITHOUT]
    falls = 550 + int(np.argmax(np.diff(told.v[550:, 0]) < -0.1)) + 1
    felt = falls + 2  # G_1 = 0: two samples later
    moved = {name: run.u[falls, 1] - run.u[falls - 1, 1] for name, run in runs.items()}
    assert moved[DIRECT] > 0.1
    assert moved[WITHOUT] < 0.0  # it still cools
    for run in runs.values():
        assert (np.diff(run.y[:, 0])[felt - 3 : felt - 1] > 0).all()
    assert told.y[felt:].min() > not_told.y[felt:].min()


def test_own_disturbance_starts_from_its_level() -> None:
    """Nothing happens before it sets in, and it has the size and shape chosen."""
    choices = DisturbanceChoices(case=HALL, shape="ramp", length=50, size=-1.0)
    v = choices.scenario().v[:, 0]
    assert np.ptp(v[: choices.onset + 1]) == 0.0
    assert v[-1] - v[0] == pytest.approx(-1.0)
    assert v[choices.onset + 25] - v[0] == pytest.approx(-0.5)
    assert choices.scenario().v0 == v[0]
    wave = DisturbanceChoices(case=SISO, shape="sine", length=8, size=0.4, onset=10)
    v = wave.scenario().v[:, 0]
    assert not v[:10].any()
    assert v[12] == pytest.approx(0.4)
    assert v[16] == pytest.approx(-0.4)


def test_without_a_path_the_measurement_is_ignored() -> None:
    """A model that expects nothing of v is Wang and Young's controller."""
    runs = DisturbanceChoices(case=SISO, path=-100.0).runs()
    assert np.abs(runs[DIRECT].u - runs[WITHOUT].u).max() <= REPLAY


def test_kept_cases_with_a_disturbance_are_shown() -> None:
    """An opened design comes with the controllers it has; others are refused."""
    example = case(SISO)
    name = open_design(dumps(example.designs[DIRECT])).partition("case=")[2]
    choices = DisturbanceChoices(case=name)
    assert choices.structures == [DIRECT]
    assert choices.shape == "step"  # its scenario has no disturbance
    assert choices.runs()[DIRECT].v.any()
    alone = Design("wang_young", DifferenceModel([-0.9], [0.1]))
    other = open_design(dumps(alone)).partition("case=")[2]
    with pytest.raises(ValueError, match="no measured disturbance"):
        choices.accept({"case": other})
    assert choices.case == name


def test_held_design_is_shown_beside_the_others() -> None:
    """Its address makes it again, forecast and all."""
    choices = DisturbanceChoices(case=SISO, forecast="given", path=10.0)
    address = choices.hold(DIRECT)
    assert "forecast=given" in address
    beside = DisturbanceChoices(case=SISO, A=address, structures=f"A,{WITHOUT}")
    assert beside.runs()["A"].controller.forecast == "given"
    exec(compile(beside.script(), "shown", "exec"), {})


def test_wrong_choices_are_named() -> None:
    """What an address must not hold is refused by name; the rest is taken."""
    choices = DisturbanceChoices()
    with pytest.raises(ValueError, match="onset = '9000'"):
        choices.accept({"onset": "9000", "forecast": "line"})
    assert choices.forecast == "line"
    with pytest.raises(ValueError, match="forecast"):
        choices.accept({"forecast": "rain"})
    choices.structures = []
    with pytest.raises(ValueError, match="0 chosen"):
        choices.runs()


@pytest.mark.parametrize("seed", range(6))
def test_any_combination_is_drawn_or_explained(seed: int) -> None:
    """Whatever is chosen ends in finite charts or in one sentence."""
    rng = np.random.default_rng(seed)
    choices = DisturbanceChoices(case=SISO if seed % 2 else "wood_berry")
    anything(choices, rng)
    said = ""
    try:
        charts = disturbance_charts(choices.runs(), choices.output, choices.input)
    except ValueError as error:
        said = str(error)
    assert said or np.isfinite(pack(charts)["data"]).all()


def test_page_keeps_its_picture() -> None:
    """An impossible choice is a message; plans, charts and tables stay."""
    shown = DisturbancePage()
    before = shown.floor.plan, shown.player.run, shown.measures.object
    values = {**shown.choices.values(), "Np": 2, "Nc": 9, "message": 1}
    shown._take(type("Event", (), {"new": values})())
    assert "Nc" in shown.alert.object
    assert (shown.floor.plan, shown.player.run, shown.measures.object) == before


def test_plan_holds_the_run() -> None:
    """What the plans draw is the run, and nothing without a plan."""
    choices = DisturbanceChoices(case=HALL)
    runs = {plain(name): run for name, run in choices.runs().items()}
    sent = floor(choices.example.plan, runs)
    assert [run["knows"] for run in sent["runs"]] == ["does not see v", "sees v"]
    for drawn, run in zip(sent["runs"], runs.values(), strict=True):
        assert np.array_equal(drawn["y"], run.y.astype(np.float32).ravel())
        assert np.array_equal(drawn["u"], run.u.astype(np.float32).ravel())
    low = [each["low"] for each in sent["actuators"]]
    assert low == [10.0, 15.0]
    assert floor(None, runs) == {}


# --- In a browser ---------------------------------------------------------------------


def written(page: Page, number: int = 0) -> dict[str, list[str]]:
    """Return what one of the plans has written in it, by class."""
    found: dict[str, list[str]] = page.evaluate(
        """(number) => {
          const find = (root) => {
            for (const node of root.querySelectorAll("*")) {
              if (node.matches(".floor .plans")) return node
              const inside = node.shadowRoot && find(node.shadowRoot)
              if (inside) return inside
            }
          }
          const svg = find(document).querySelectorAll("svg")[number]
          const of = (name) => [...svg.querySelectorAll("." + name)]
          return {
            value: of("value").map((n) => n.textContent),
            off: of("off").map((n) => n.textContent),
            amount: of("amount").map((n) => n.textContent),
            outside: of("outside").map((n) => n.textContent),
            fill: of("zone").map((n) => n.getAttribute("fill")),
            dotted: of("cold").map((n) => getComputedStyle(n).visibility === "visible"),
            width: of("filled").map((n) => n.getAttribute("width")),
          }
        }""",
        number,
    )
    return found


def minus(text: str) -> float:
    """Read a number as the page writes it."""
    return float(text.split(" ")[0].replace("\u2212", "-"))


def go_to(page: Page, sample: int) -> None:
    """Move the player to a sample, as a hand would."""
    page.get_by_label("Sample", exact=True).evaluate(
        "(input, k) => { input.value = k; input.dispatchEvent(new Event('input')) }",
        sample,
    )
    page.wait_for_function(f"nmssPlayer.sample === {sample}")


def played(page: Page, wait: float) -> tuple[int, float]:
    """Return frames drawn while waiting, and the processor's seconds for them."""
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable", {"timeDomain": "threadTicks"})

    def now() -> tuple[int, float]:
        told = session.send("Performance.getMetrics")["metrics"]
        (busy,) = [m["value"] for m in told if m["name"] == "TaskDuration"]
        return page.evaluate("nmssPlayer.frames"), busy

    first, began = now()
    page.wait_for_timeout(1000 * wait)
    last, ended = now()
    return last - first, ended - began


def test_plans_show_the_sample_of_the_player(visit: Open) -> None:
    """Numbers, bars and colours are those of the run, at any sample."""
    page = visit(f"{PAGE}?structures={ALL}")
    runs = DisturbanceChoices(case=HALL, structures=ALL).runs()
    assert page.evaluate("nmssPlayer.sample") == 550
    for k in (550, 556, 0, 799):
        go_to(page, k)
        for number, run in enumerate(runs.values()):
            found = written(page, number)
            assert np.allclose([minus(t) for t in found["value"]], run.y[k], atol=0.006)
            off = run.y[k] - run.r[k]
            assert np.allclose([minus(t) for t in found["off"]], off, atol=0.006)
            assert np.allclose(
                [minus(t) for t in found["amount"]], run.u[k], atol=0.006
            )
            share = (run.u[k] - [10.0, 15.0]) / [15.0, 12.0]
            assert np.allclose(
                [float(w) / 88 for w in found["width"]], share, atol=1e-3
            )
            assert f"{run.v[k, 0]:.2f}" in found["outside"][0]


def test_colours_tell_cold_from_warm(visit: Open) -> None:
    """A zone that is colder is blue and dotted, a warmer one orange and plain."""
    page = visit(PAGE)

    def channels(text: str) -> list[int]:
        return [int(part) for part in text[4:-1].split()]

    run = DisturbanceChoices(case=HALL).runs()[WITHOUT]
    cold = int(np.argmin(run.y[550:, 0])) + 550
    for k, sign in ((cold, "\u2212"), (600, "+")):
        go_to(page, k)
        found = written(page)
        assert found["off"][0].startswith(sign)
        red, _, blue = channels(found["fill"][0])
        assert (blue > red) == (sign == "\u2212")
        assert found["dotted"][0] == (sign == "\u2212")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_grey_tells_cold_from_warm(visit: Open, scheme: Any) -> None:
    """Without colour a colder zone has dots where no word is, and a warmer one none."""
    page = visit(PAGE, color_scheme=scheme)
    page.add_style_tag(content="html { filter: grayscale(1) }")
    deviation = DisturbanceChoices(case=HALL).runs()[WITHOUT]
    off = (deviation.y - deviation.r)[:, 0]
    for k in (int(np.argmin(off)), int(np.argmax(off))):
        go_to(page, k)
        first = page.locator(".floor svg .zone").first
        first.scroll_into_view_if_needed()
        zone = first.bounding_box()
        clip = {  # below the words
            "x": zone["x"] + 4,
            "y": zone["y"] + 0.85 * zone["height"],
            "width": zone["width"] - 8,
            "height": 0.12 * zone["height"],
        }
        shades = np.array(
            Image.open(io.BytesIO(page.screenshot(clip=clip))).convert("L")
        )
        assert (np.ptp(shades) > 60) == (off[k] < 0)
        assert off[k] < 0 or np.ptp(shades) < 5


def test_playing_moves_the_plans_and_asks_nobody(visit: Open) -> None:
    """Frames take the page less than a thirtieth of a second, three plans included.

    The time is that of the processor: the machine of the tests is shared, and frames
    wait for their turn there.
    """
    page = visit(f"{PAGE}?structures={ALL}")
    settled(page)
    page.evaluate(
        "() => { window.sentFrames = 0; const send = WebSocket.prototype.send;"
        " WebSocket.prototype.send = function (...a)"
        " { window.sentFrames += 1; return send.apply(this, a) } }"
    )
    page.keyboard.press("Home")
    page.wait_for_function("nmssPlayer.sample === 0")
    before = written(page)["value"]
    page.get_by_label("Speed").select_option("50")
    page.keyboard.press("Space")
    page.wait_for_function("nmssPlayer.sample > 100")
    assert written(page)["value"] != before
    frames, seconds = played(page, 3.0)
    page.keyboard.press("Space")
    assert frames > 3
    assert seconds / frames < 1 / 30
    assert page.evaluate("window.sentFrames") == 0


def test_plan_is_hidden_where_there_is_no_building(visit: Open) -> None:
    """It goes with the case, and comes back with it."""
    page = visit(f"{PAGE}?case={SISO}")
    expect(page.locator(".floorplan")).to_be_hidden()
    page.get_by_label("Case", exact=True).select_option(f'"{HALL}"')
    settled(page)
    expect(page.locator(".floorplan")).to_be_visible()
    expect(page.locator(".floorplan svg")).to_have_count(2)
    expect(page.locator(".floorplan")).to_contain_text("Schematic")
    page.get_by_label("Case", exact=True).select_option(f'"{SISO}"')
    settled(page)
    expect(page.locator(".floorplan")).to_be_hidden()


def test_link_restores_the_choices(visit: Open) -> None:
    """Forecast, shape and onset are in the address, and it opens as it was."""
    page = visit(f"{PAGE}?case={SISO}")
    page.get_by_label("Knowledge of v ahead").select_option('"line"')
    page.get_by_label("Disturbance v", exact=True).select_option('"ramp"')
    settled(page)
    slide(page, "onset", "min")
    page.wait_for_function("location.search.includes('onset=0')")
    address = page.url.rpartition("/")[2]
    assert "forecast=line" in address
    assert "shape=ramp" in address
    again = visit(address)
    expect(again.get_by_label("Knowledge of v ahead")).to_have_value('"line"')
    expect(again.locator("input[name=onset]")).to_have_value("0")
    expect(again.locator(".measures")).to_contain_text("From sample 0, 0 s on")


def test_every_slider_to_both_ends(visit: Open) -> None:
    """No end of a slider leaves the page with a fault."""
    page = visit(f"{PAGE}?case={SISO}&shape=ramp")
    for name, _, _ in sliders(DisturbanceChoices(case=SISO, shape="ramp")):
        for end in ("min", "max"):
            slide(page, name, end)
    expect(page.locator(".wrong", has_text="fault")).to_have_count(0)


@pytest.mark.parametrize(
    ("width", "height"), [(1920, 1080), (1440, 900), (1024, 768), (390, 844)]
)
def test_nothing_sticks_out(visit: Open, width: int, height: int) -> None:
    """At any width the page scrolls down only; plans stand in a row or a column."""
    page = visit(f"{PAGE}?structures={ALL}", width, height)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    boxes = [svg.bounding_box() for svg in page.locator(".floorplan svg").all()]
    tops = {round(box["y"]) for box in boxes if box}
    assert len(tops) == (3 if width == 390 else 1)
    expect(page.locator(".floorplan .zone")).to_have_count(9)


def test_server_says_nothing_bad(visit: Open, server: Server) -> None:
    """Opening and choosing leave no traceback."""
    page = visit(f"{PAGE}?case={SISO}")
    page.get_by_label("Knowledge of v ahead").select_option('"given"')
    settled(page)
    expect(page.locator(".wrong")).to_have_count(0)
    assert server.faults() == []
