"""The page Tune in a real browser, and its choices without one."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import ALGEBRA, REPLAY, Open, Server, watched
from playwright.sync_api import Browser, Page, expect
from visitors import Visitor, run

from apps.goals import KINDS, MOST_GOALS, Aim, aims_of, gain_of
from apps.pages.background import Work
from apps.pages.live import KEPT as KEPT_HERE
from apps.pages.tune import TunePage
from apps.session import KEPT, LoopChoices
from apps.tuning import TuneChoices, first_order
from apps.weight_tables import parts_of
from apps.work import Withdrawn
from nmss_lab.cases import shell_desired, shell_step
from nmss_lab.design import Design
from nmss_lab.files import load
from nmss_lab.matching import match
from nmss_lab.mpc import state_weight
from nmss_lab.plots import history_chart
from nmss_lab.simulate import closed_loop
from nmss_lab.tuning import OBJECTIVES, Step, evaluate, tune

FEW = {"most": 50, "starts": 1}
"""A search that ends soon."""

# --- Choices, without a browser ------------------------------------------------------


@pytest.mark.parametrize("name", TuneChoices.cases())
def test_every_case_opens_with_goals(name: str) -> None:
    """Each case suggests goals that can be told of the design to begin with."""
    choices = TuneChoices(case=name)
    bench, start = choices.bench(), choices.start()
    aims = choices.aims(bench)
    values = bench.values(start, choices.library(aims, bench, start))
    assert 1 <= len(aims) <= MOST_GOALS
    assert np.isfinite(list(values.values())).all()
    assert aims_of(";".join(aim.text for aim in aims), 12) == aims
    if choices.by_step:
        assert len(bench.trials) == choices.example.model.n_y


def test_the_thesis_example_opens() -> None:
    """Section 5.3.1: unit weights, horizons 10 and 5, limits of 5, three goals."""
    choices = TuneChoices()
    design, bench = choices.start(), choices.bench()
    assert (design.structure, design.reference) == ("integral_of_error", "zero")
    assert (design.horizon.Np, design.horizon.Nc) == (10, 5)
    assert (design.Q, design.R, design.limits.u) == (1.0, 1.0, (-5.0, 5.0))
    aims = choices.aims(bench)
    assert [aim.objective for aim in aims] == ["peak", "rise", "IAE"]
    now = bench.values(design, choices.library(aims, bench, design))
    wanted = [1.0, now["rise:0"], 0.8 * now["IAE:0"]]
    # suggested targets have three digits
    assert [aim.target for aim in aims] == pytest.approx(wanted, rel=5e-3)


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"structure": "pip", "plants": "ranges", "drawn": 2, "over": "nine in ten"},
        {
            "structure": "wang_young",
            "plants": "stress",
            "along": "each",
            "goals": "distance:0:10:100:3;violations:0:0:50",
        },
        {
            "structure": "forward_path",
            "tried": "steps",
            "limit_du": "own",
            "reading": "preview",
            "block_y": "fixed",
        },
        {
            "case": "shell_5_3_2",
            "goals": "distance:0:1:100:28;coupling:1:5:0;radius:0:0.9:50",
            "block_u": "diagonal",
        },
        {"case": "wood_berry", "tried": "scenario", "begin": "unit"},
    ],
)
def test_python_shown_attains_the_same(given: dict[str, Any]) -> None:
    """The script of the page runs and reaches the page's attainment."""
    choices = TuneChoices(**given, **FEW)
    bench, start = choices.bench(), choices.start()
    aims = choices.aims(bench)
    found = tune(**choices.job(start, aims, bench))
    names = _run(choices.script_of(start, aims))
    assert names["tuned"].attainment == found.attainment
    assert np.array_equal(names["tuned"].values, found.values)
    again = choices.script_of(found.design, aims)  # continued from there
    assert _run(again)["tuned"].before == pytest.approx(found.values, rel=REPLAY)


def _run(text: str) -> dict[str, Any]:
    names: dict[str, Any] = {}
    with contextlib.redirect_stdout(io.StringIO()):
        exec(compile(text, "shown", "exec"), names)
    return names


def test_python_of_a_match_finds_the_same() -> None:
    """The script of a matched gain gives the same weights."""
    choices = TuneChoices()
    K = np.array([[2.0, 0.1, -0.5]])
    start = choices.start()
    found = match(K, start)
    names = _run(choices.script_of(start, [], K))
    assert names["found"].distance == found.distance
    # the match has weights that are no blocks of (5.6): they are shown whole
    assert [part.name for part in parts_of(found.design)] == [
        "State x, whole",
        "Inputs u",
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "0 goals"),
        ("peak:0:1:100;" * 9, "9 goals"),
        ("peak:0:1", "goal 1"),
        ("IAE:0:1:100;swagger:0:1:100", "goal 2"),
        ("peak:3:1:100", "output 3"),
        ("peak:0:nan:100", "goal 1: target nan"),
        ("peak:0:one:100", "goal 1, peak"),
        ("peak:0:1:-5", "importance -5"),
        ("distance:0:1:100", "time constant"),
    ],
)
def test_bad_rows_are_explained(text: str, message: str) -> None:
    """Each bad row is named, and nothing changes."""
    with pytest.raises(ValueError, match=message):
        aims_of(text, 1)


def test_searches_that_make_no_sense_are_refused() -> None:
    """Two rows that measure the same, hard goals alone, nothing free."""
    choices = TuneChoices()
    bench, start = choices.bench(), choices.start()
    for aims, message in (
        ([Aim("peak", 0, 1.0), Aim("peak", 0, 2.0)], "goals 1 and 2"),
        ([Aim("peak", 0, 1.0, 0.0)], "hard"),
    ):
        with pytest.raises(ValueError, match=message):
            choices.job(start, aims, bench)
    for block in ("y", "past_u", "integral", "u"):
        setattr(choices, f"block_{block}", "fixed")
    with pytest.raises(ValueError, match="nothing is left"):
        choices.job(start, [Aim("peak", 0, 1.0)], bench)


def test_all_objectives_can_be_goals() -> None:
    """Every objective of the library is offered, the radius and a distance too."""
    assert set(KINDS) == {*OBJECTIVES, "radius", "distance"}
    choices = TuneChoices(case="shell_5_3_2")
    bench, start = choices.bench(), choices.start()
    aims = [Aim(name, 1, 1.0, 100.0, 28.0) for name in KINDS]
    values = bench.values(start, choices.library(aims, bench, start))
    assert np.isfinite(list(values.values())).all()
    assert all(choices.unit(aim) for aim in aims)


def test_desired_response_is_that_of_table_5_2() -> None:
    """A pole of 0.7 after the dead time, as (5.8) has it."""
    choices = TuneChoices(case="shell_5_3_2")
    tau = -10.0 / np.log(0.7)
    for output in range(3):
        lag, pole = choices._first_order(
            Aim("distance", output, 1.0, 100.0, tau), choices.start()
        )
        reference = shell_step(22, output).reference
        found = first_order(reference, np.zeros(3), lag, pole)
        assert np.abs(found - shell_desired(22, output)).max() < ALGEBRA


def test_worst_plant_counts() -> None:
    """An ensemble's value is the worst of its plants, each run alone."""
    choices = TuneChoices(plants="ranges", drawn=3)
    bench, start = choices.bench(), choices.start()
    aims = [Aim("IAE", 0, 1.0)]
    goals = choices.library(aims, bench, start)
    each = [
        evaluate(start, list(goals.values()), [replace(bench.trials[0], plants=p)])
        for p in bench.trials[0].plants
    ]
    assert len(each) == 4
    found = bench.values(start, goals)["IAE:0"]
    assert found == pytest.approx(float(np.max(each)), rel=REPLAY)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1, 2", "1 x 2 numbers, expected 1 x 3"),
        ("1, b, 3", "number 2: 'b'"),
        ("1, 2, inf", "not finite"),
        ("", "expected 1 x 3"),
    ],
)
def test_bad_gains_are_explained(text: str, message: str) -> None:
    """A gain that cannot be read says where and what was expected."""
    with pytest.raises(ValueError, match=message):
        gain_of(text, 1, 3)


def test_weights_are_shown_as_they_are() -> None:
    """Blocks put together again are the weights of the design."""
    choices = TuneChoices(case="shell_5_3_2", begin="case")
    design = choices.start()
    y, past, z, u = (part.steps[0] for part in parts_of(design))
    assert np.array_equal(state_weight(design.model, y, past, z), np.array(design.Q))
    assert np.array_equal(u, np.array(design.R))
    free = choices.free(choices.start())
    vector = free.start + 0.3
    made = free.dressed(free.matrices(vector))
    assert np.array_equal(made.Q, free.apply(vector).Q)


def test_tuned_designs_open_on_the_other_page() -> None:
    """A kept tuned design runs there as here, with a script that runs."""
    choices = TuneChoices(structure="wang_young", along="each", **FEW)
    bench, start = choices.bench(), choices.start()
    found = tune(**choices.job(start, choices.aims(bench), bench))
    name = choices.keep(found.design, start)
    assert name == choices.keep(found.design, start)
    there = LoopChoices(case=name, structures="tuned,before", Np=40, Nc=3)
    here = closed_loop(
        choices.example.plant, found.design.build(), choices.example.scenario
    )
    runs = there.runs()
    assert np.array_equal(runs["tuned"].y, here.y)  # weights along keep their horizon
    names = _run(there.script())
    for key, one in runs.items():
        assert np.array_equal(names["runs"][key].y, one.y)
    again = TuneChoices(case=name, **FEW)
    assert again.structure == "tuned"
    assert again.aims(again.bench())
    del KEPT[name]
    with pytest.raises(ValueError, match="tuned design is no longer kept"):
        LoopChoices(case=name)


def test_every_choice_is_explained() -> None:
    """Each control has a label and a sentence of help."""
    for name in ("ifac93_4_4_2", "shell_5_3_2"):
        choices = TuneChoices(case=name)
        items = [item for group in choices.description() for item in group["items"]]
        for item in items:
            assert item["label"]
            assert item["help"].endswith(".")


def test_history_is_drawn_up_to_now() -> None:
    """The last value holds until the last design; huge ones stay in the picture."""
    chart = history_chart([(1, 500.0), (4, 0.5), (9, -0.1)], 20)
    (curve,) = chart.curves
    assert curve.t.tolist() == [1.0, 4.0, 9.0, 20.0]
    assert curve.values.tolist() == [1.0, 0.5, -0.1, -0.1]
    assert history_chart([], 0).curves == ()


def test_a_session_without_a_browser() -> None:
    """Tune, undo, continue, keep, match: the state of a page is what was done."""
    page = TunePage()
    page.choices.put(FEW)
    start = page.present

    def act(act: str, **more: Any) -> None:
        page.goals.sent = {"act": act, "number": act_number(), **more}

    act("tune")
    assert page.running is None or page.running.result(timeout=120) is None
    assert page.complaint == ""
    tuned = page.place.after
    assert isinstance(tuned, Design)
    assert page.goals.progress["attainment"] < 0.1
    page.bar.sent = {"act": "hold", "which": "A", "name": "tuned", "number": 1}
    act("continue")
    assert page.place.before is tuned
    act("undo")
    act("undo")
    assert page.place.after is None
    assert np.array_equal(page.present.Q, start.Q)
    act("undo")
    assert "nothing to undo" in page.complaint
    act("match", text="2, 0.1, -0.5")
    assert page.running is None or page.running.result(timeout=120) is None
    assert "relative distance" in page.matched
    page.choices.view = "compare"
    assert list(page._designs()) == ["A", "present"]
    act("goals", rows=[{"objective": "peak", "output": 0, "target": 1, "share": 0}])
    act("tune")
    assert "hard" in page.complaint
    page.controls.sent = {**page.choices.values(), "case": "shell_5_3_2", "message": 1}
    assert "1 outputs, this plant has 3" in page.bar.told["held"]["A"]["misfit"]
    assert page.place.after is None
    assert len(page.goals.state["rows"]) == 6


NUMBERS = iter(range(1, 1000))


def act_number() -> int:
    """Return a number that no message had."""
    return next(NUMBERS)


def test_a_stopped_search_reports_what_it_has() -> None:
    """Cancelling ends with the best so far; a search called off leaves no trace."""
    page = TunePage()
    heard = page.goals.param.watch(
        lambda event: event.new["tried"] < 6 or page.stopping or page._cancel(event),
        "progress",
    )
    page.goals.sent = {"act": "tune", "number": act_number()}
    assert page.running is None or page.running.result(timeout=120) is None
    page.goals.param.unwatch(heard)
    assert page.place.after is not None
    assert "Cancelled" in page.place.note
    assert page.goals.progress["attainment"] < 0.25
    before = page.place
    assert page.work is not None
    page._heard(page.work, None, 3)
    page._ended(Work(), "late", [], lambda found: None)
    assert page.place is before
    assert page.complaint == ""


def test_choices_that_cannot_be_built_change_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The form is answered, says what is wrong, and everything is as it was."""
    page = TunePage()
    values, place = page.choices.values(), page.place
    start = TuneChoices.start

    def refused(self: TuneChoices) -> Design:
        if self.Np == 11 or self.case != "ifac93_4_4_2":
            raise ValueError("this design cannot be built")
        return start(self)

    monkeypatch.setattr(TuneChoices, "start", refused)
    for number, wrong in enumerate(({"Np": 11}, {"case": "shell_5_3_2"}), 1):
        page.controls.sent = {**values, **wrong, "message": number}
        assert page.controls.state["message"] == number
        assert "cannot be built" in page.complaint
        assert page.choices.values() == values
        assert page.place is place
    page.controls.sent = {**values, "most": 100, "message": 3}
    assert page.complaint == ""


MANY = {"plants": "ranges", "drawn": 40, "limit_y": "own"}
"""Plants whose limits give way: gasifiers take seconds."""


def test_a_bench_tells_how_far_it_is_and_can_be_ended() -> None:
    """The share grows at each sample up to all of it; whoever hears may end it."""
    choices, shares = TuneChoices(plants="ranges", drawn=3), list[float]()
    bench = choices.bench()
    goals = choices.library([Aim("IAE", 0, 1.0)], bench, bench.start)
    asked = {bench.start: goals, choices.start(): goals}
    bench.prepare(asked, shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert len(shares) == 2 * 2 * len(bench.trials[0].scenario)
    bench.prepare(asked, shares.append)
    assert len(shares) == 2 * 2 * len(bench.trials[0].scenario)  # nothing was new
    plain = choices.bench()
    assert plain.values(plain.start, goals) == bench.values(bench.start, goals)

    def end(share: float) -> None:
        if share > 0.4:
            raise Withdrawn

    with pytest.raises(Withdrawn):
        plain.prepare({choices.start(): goals}, end)


def test_what_a_bench_cannot_afford_is_refused() -> None:
    """Horizons, samples and plants have a budget; the page keeps what it shows."""
    page = TunePage()
    page.controls.sent = {**page.choices.values(), "case": "shell_5_3_2", "message": 1}
    values, place = page.choices.values(), page.place
    pictures = page.figures["output"].curves[0].data, page.measures.object
    wanted = {"Np": 80, "Nc": 30, "length": 400, **MANY}
    page.controls.sent = {**values, **wanted, "message": 2}
    assert page.controls.state["message"] == 2
    for words in ("50400 samples", "lower Np to 13", "choose fewer plants", KEPT_HERE):
        assert words in page.complaint
    assert page.choices.values() == values
    assert page.place is place
    now = page.figures["output"].curves[0].data, page.measures.object
    assert now == pictures
    page.controls.sent = {**values, "length": 60, "message": 3}
    assert page.complaint == ""


def test_what_is_found_waits_for_an_answer_but_keeps_no_event_loop() -> None:
    """While an answer is under way, a result is looked at again a little later."""
    page, done = TunePage(), list[str]()
    later = list[Any]()
    page.document = SimpleNamespace(  # type: ignore[assignment]
        session_context=True,
        add_timeout_callback=lambda action, after: later.append(action),
    )
    with page.lock, ThreadPoolExecutor(1) as loop:
        loop.submit(page._when_free, lambda: done.append("it")).result(timeout=10)
        assert not done
    later.pop()()
    assert done == ["it"]
    assert not later


def test_a_step_without_a_finite_value_has_no_picture() -> None:
    """A best so far that cannot be told is not drawn."""
    page = TunePage()
    job = page.choices.job(page.place.before, page._aims(), page.bench)
    step = Step(1, np.inf, np.full(3, np.nan), {})
    page._picture(Work(), job, step, ["a", "b", "c"], page.bench)
    assert page.live is None


# --- In the browser ------------------------------------------------------------------

READY = "window.nmssTune && window.nmssForm && nmssForm.idle() && nmssTune.idle()"


@pytest.fixture
def visit(server: Server, browser: Browser) -> Iterator[Open]:
    """Yield a function that opens the page; nothing may complain or call away."""
    with watched(server, browser, READY, "tune") as open_page:
        yield open_page


def test_a_long_answer_gives_way(server: Server) -> None:
    """Of form and rows: each tells how far it is; the next, or a cancel, is answered.

    While a search goes on, the page answers, too.
    """

    async def visit() -> None:
        visitor = await Visitor.open(server.url, "tune?case=gasifier_6_3_4&drawn=40")
        first = visitor.value("Controls", "state")["values"]

        def busy(component: str, message: int) -> bool:
            told = visitor.value(component, "busy") or {"message": 0}
            return bool(told["message"] == message and 0.0 < told["share"] < 1.0)

        def said() -> str:
            return visitor.value("text-alert", "text") or ""

        async def ask(component: str, message: int, **more: Any) -> None:
            number = {"Controls": "message", "Goals": "number"}[component]
            await visitor.put(component, "sent", {**more, number: message})

        async def answered(component: str, message: int) -> None:
            key = {"Controls": "message", "Goals": "answer"}[component]
            await visitor.until(
                lambda: visitor.value(component, "state").get(key) == message
            )

        many = {**first, "plants": "ranges"}
        measures = visitor.value("text-measures", "text")
        await ask("Controls", 1, **many)
        await visitor.until(lambda: busy("Controls", 1))
        await ask("Controls", 2, **{**first, "seed": 7})
        await answered("Controls", 2)
        assert visitor.value("Controls", "state")["values"] == {**first, "seed": 7}
        assert not said()
        await ask("Controls", 3, **many)
        await visitor.until(lambda: busy("Controls", 3))
        await ask("Controls", 4, cancel=True)
        await answered("Controls", 4)
        assert visitor.value("Controls", "state")["values"] == {**first, "seed": 7}
        assert "Cancelled." in said()
        assert KEPT_HERE in said()
        assert visitor.value("text-measures", "text") == measures

        await ask("Controls", 5, **{**many, "drawn": 10})
        await answered("Controls", 5)
        assert not said()
        await ask("Goals", 1, act="tune")
        await visitor.until(lambda: visitor.value("Goals", "progress")["running"])
        rows = visitor.value("Goals", "state")["rows"]
        other = [{**rows[0], "objective": "effort", "target": None}]
        await ask("Goals", 2, act="goals", rows=other)
        await visitor.until(lambda: busy("Goals", 2))
        harder = [{**rows[0], "target": 0.5 * rows[0]["target"]}]
        await ask("Goals", 3, act="goals", rows=harder)
        await answered("Goals", 3)
        (row,) = visitor.value("Goals", "state")["rows"]
        assert row["objective"] == rows[0]["objective"]
        assert row["target"] == pytest.approx(harder[0]["target"], rel=1e-5)
        assert not said()
        await ask("Goals", 4, act="goals", rows=other)
        await visitor.until(lambda: busy("Goals", 4))
        await ask("Goals", 5, act="stay")
        await answered("Goals", 5)
        await visitor.until(lambda: "Cancelled." in said())
        assert visitor.value("Goals", "state")["rows"] == [row]
        assert visitor.value("Goals", "progress")["running"]
        await visitor.put("Goals", "stop", 1)
        await visitor.until(lambda: not visitor.value("Goals", "progress")["running"])
        await visitor.close()

    run(visit())


def press(page: Page, name: str) -> None:
    """Press a button by its whole name."""
    page.get_by_role("button", name=name, exact=True).click()


def search(page: Page) -> None:
    """Tune and wait until the search has ended."""
    before = page.evaluate("nmssTune.finished")
    press(page, "Tune")
    page.wait_for_function(f"nmssTune.finished > {before}", timeout=120_000)


def factor(page: Page) -> float:
    """Return the attainment factor that is shown."""
    return float(page.evaluate("nmssTune.progress().attainment"))


def bars(page: Page) -> list[str]:
    """Return the words beside the bars."""
    return page.locator(".goals .words").all_inner_texts()


def test_bars_move_and_the_page_answers(visit: Open, server: Server) -> None:
    """A search shows its best so far, the form answers, Cancel keeps the best."""
    page = visit("tune?most=6000&starts=10")
    before = factor(page)
    words = bars(page)
    press(page, "Tune")
    page.wait_for_function(
        "nmssTune.running() && nmssTune.progress().attainment !== null"
        f" && nmssTune.progress().attainment < {0.8 * before}",
        timeout=60_000,
    )
    assert page.evaluate("nmssTune.running()")
    assert bars(page) != words
    drawn = "Bokeh.documents[0].get_model_by_name('output').renderers"
    page.wait_for_function(
        f"{drawn}.filter((r) => r.name.startsWith('style')"
        " && r.data_source.data.t.length > 0).length === 2"
    )
    page.locator("input[name=seed]").fill("7")
    page.wait_for_function("nmssForm.idle()")
    slider = page.locator("input[name=slide-0]")
    slider.fill("0.8")
    page.wait_for_function("nmssTune.idle()")
    assert page.evaluate("nmssTune.running()")
    expect(page.locator("input[name=target-0]")).to_have_value("0.8")
    press(page, "Cancel")
    page.wait_for_function("nmssTune.finished === 1", timeout=60_000)
    expect(page.locator(".attained")).to_contain_text("Cancelled")
    slider.fill("1")
    page.wait_for_function("nmssTune.idle()")
    assert factor(page) < before
    press(page, "Undo tuning")
    page.wait_for_function("!nmssTune.progress().undo")
    assert factor(page) == before
    assert server.faults() == []


def test_rows_are_edited_and_restored(visit: Open) -> None:
    """Rows are added, changed, made hard and removed; the address holds them."""
    page = visit()
    press(page, "Add a goal")
    expect(page.locator(".goals li")).to_have_count(4)
    page.get_by_label("Objective of goal 4").select_option(json.dumps("distance"))
    expect(page.get_by_label("Time constant of goal 4")).to_be_visible()
    page.wait_for_function(READY)
    page.locator("input[name=target-3]").fill("12.5")
    page.keyboard.press("Tab")
    page.wait_for_function(READY)
    page.locator("input[name=share-2]").fill("0")
    expect(page.locator(".goals li").nth(2)).to_contain_text("hard")
    expect(page.locator(".attained")).to_contain_text("A hard goal is missed")
    page.get_by_label("Remove goal 1").click()
    expect(page.locator(".goals li")).to_have_count(3)
    page.wait_for_function(READY)
    page.wait_for_function("location.search.includes('goals=')")
    expect(page.locator(".text-measures tbody tr")).to_have_count(4)
    address = page.evaluate("location.pathname.slice(1) + location.search")
    again = visit(address)
    assert bars(again) == bars(page)
    expect(again.locator("input[name=target-2]")).to_have_value("12.5")
    press(again, "Suggest")
    expect(again.get_by_label("Objective of goal 1")).to_have_value('"peak"')


def test_coupling_is_shown_cell_by_cell(visit: Open) -> None:
    """Three references, three outputs: nine plots with the design before and after."""
    page = visit("tune?case=shell_5_3_2&most=60&starts=1")
    expect(page.locator(".coupling svg")).to_have_count(9)
    expect(page.locator(".coupling .line1")).to_have_count(0)
    search(page)
    expect(page.locator(".coupling .line1")).to_have_count(9)
    expect(page.locator(".text-weights tbody").first).to_contain_text("Sum of the")
    page.locator("select[name=stepped]").select_option("2")
    expect(page.locator(".text-legend")).to_contain_text("reference of y3 steps")
    page.locator("select[name=case]").select_option('"ifac93_4_4_2"')
    expect(page.locator(".coupling svg")).to_have_count(0)
    expect(page.locator(".coupling-box")).to_be_hidden()


def hold(page: Page, which: str, name: str) -> None:
    """Hold a design by the menu of the bar."""
    page.locator("summary", has_text=f"{which}:").click()
    page.get_by_role("button", name=f"{name} as {which}").click()
    held = page.locator("summary", has_text=f"{which}:")
    expect(held).not_to_contain_text("empty")
    page.wait_for_function(READY)


def test_designs_are_kept_and_sent(visit: Open, server: Server) -> None:
    """A and B are compared with the present one; it goes to another page and a file."""
    page = visit("tune?most=60&starts=1")
    hold(page, "A", "before")
    search(page)
    hold(page, "B", "tuned")
    page.locator("select[name=structure]").select_option('"wang_young"')
    page.wait_for_function(READY)
    page.locator("select[name=view]").select_option('"compare"')
    expect(page.locator(".text-measures thead th")).to_have_count(5)
    expect(page.locator(".text-legend")).to_contain_text("B: Tuned")
    search(page)
    page.locator("summary", has_text="File").click()
    with page.expect_download() as got:
        press(page, "Design file of Wang-Young, present")
    saved = load(got.value.path()).design
    assert (saved.structure, saved.horizon.Np) == ("wang_young", 10)
    press(page, "Receding horizon \u2192")
    page.wait_for_function("window.nmssPlayer?.frames > 0", timeout=60_000)
    assert page.url.startswith(f"{server.url}receding_horizon?case=tuned-")
    expect(page.locator(".text-measures tbody tr")).to_have_count(2)
    expect(page.locator(".text-measures tbody")).to_contain_text("Before tuning")
    expect(page.locator(".wrong")).to_have_count(0)
    assert server.faults() == []


def test_a_gain_is_matched(visit: Open) -> None:
    """The gain of the case is typed and matched; undo takes it back."""
    page = visit()
    page.get_by_text("Match a PIP gain").click()
    press(page, "Gain of the case")
    expect(page.locator("input[name=gain]")).not_to_have_value("")
    press(page, "Match")
    note = page.locator(".match .note")
    expect(note).to_contain_text("is the given one", timeout=60_000)
    expect(page.locator(".text-weights")).to_contain_text("matched")
    page.locator("input[name=gain]").fill("1, x")
    press(page, "Match")
    expect(page.get_by_role("alert")).to_contain_text("'x' is no number")
    press(page, "Undo tuning")
    expect(page.locator(".text-weights")).not_to_contain_text("matched")
    expect(page.locator(".wrong")).to_have_count(0)


def test_wrong_addresses_are_explained(visit: Open) -> None:
    """What cannot be taken is named; the page opens all the same."""
    for query, message in (
        ("goals=swagger:0:1:2", "goal 1"),
        ("case=tuned-123456789abc", "no longer kept"),
        ("structure=<b>x</b>", "structure"),
        ("most=1", "most"),
    ):
        page = visit(f"tune?{query}")
        expect(page.get_by_role("alert")).to_contain_text(message)
        expect(page.locator(".goals li")).to_have_count(3)


def test_the_server_stops_while_it_tunes(browser: Browser, tmp_path: Path) -> None:
    """A running search does not keep the server, and nothing is complained of."""
    running = Server(tmp_path / "stderr.log")
    with browser.new_context() as context:
        page = context.new_page()
        page.goto(running.url + "tune?most=6000&starts=10")
        page.wait_for_function(READY, timeout=60_000)
        press(page, "Tune")
        page.wait_for_function("nmssTune.progress().tried > 0", timeout=60_000)
        code, _ = running.stop()
    assert code == 0
    assert running.log.read_text() == ""


@pytest.mark.parametrize(("width", "scheme"), [(390, "dark"), (1024, "light")])
def test_fits_the_screen_in_the_colours_asked_for(
    visit: Open, width: int, scheme: str
) -> None:
    """Nothing scrolls sideways; figures follow the scheme; controls have names."""
    page = visit("tune?case=shell_5_3_2", width, color_scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for chart in page.locator(".chart").all():
        assert chart.bounding_box()["width"] > 250
    label = "Bokeh.documents[0].get_model_by_name('history').title.text_color"
    dark = page.evaluate(label)
    press(page, "Light or dark colours")
    page.wait_for_function(f"{label} !== {json.dumps(dark)}")
    assert page.evaluate(NAMELESS) == []


NAMELESS = """() => {
  const bad = []
  const look = (root) => {
    for (const node of root.querySelectorAll("*")) {
      if (node.shadowRoot) look(node.shadowRoot)
      if (!/^(INPUT|SELECT|BUTTON|PROGRESS)$/.test(node.tagName)) continue
      const id = node.getAttribute("aria-describedby")
      const named = node.labels?.length || node.ariaLabel || node.textContent
      const helped = !id || root.getElementById(id)?.textContent
      if (!named || !helped) bad.push(node.outerHTML)
    }
  }
  look(document)
  return bad
}"""
