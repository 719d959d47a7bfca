"""The page Identify in a real browser, and its choices without one."""

from __future__ import annotations

import contextlib
import io
import json
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
from conftest import ALGEBRA, Open, Server, watched
from playwright.sync_api import Browser, Page, expect

from apps.identification import LARGEST, LOOK, RECORDS, IdentifyChoices, uploaded
from apps.pages.identify import SEARCHES, IdentifyPage
from apps.session import KEPT, LoopChoices, keep_model
from nmss_lab.cases import model_case
from nmss_lab.files import load
from nmss_lab.identify import (
    Orders,
    draw,
    experiment,
    pole_draws,
    prbs,
    sriv,
    step_band,
    step_response,
)
from nmss_lab.models import DifferenceModel
from nmss_lab.plots import EstimateFigure, estimate_charts, record_charts
from nmss_lab.records import shipped
from nmss_lab.simulate import closed_loop

OWN = [name for name in RECORDS if name != "file"]
"""Records that need no upload."""

ORDERS = Orders(1, (3,), (3,))
"""The orders that the literature gives to the gas furnace."""


def table(rows: int = 120, dt: float = 1.0) -> list[list[Any]]:
    """Return header and rows of a first-order plant moved by a binary signal."""
    u = prbs(rows, 5)
    y = np.zeros(rows)
    for k in range(1, rows):
        y[k] = 0.8 * y[k - 1] + 0.5 * u[k - 1]
    y += 0.01 * np.random.default_rng(3).standard_normal(rows)
    lines = zip(dt * np.arange(rows), u, y, strict=True)
    return [["time", "u", "y"], *([f"{x:.6g}" for x in line] for line in lines)]


def text(rows: list[list[Any]], sign: str = ",") -> bytes:
    """Return rows as the bytes of a file."""
    return "\n".join(sign.join(map(str, row)) for row in rows).encode()


def with_cell(row: int, column: int, value: str) -> bytes:
    """Return the good file with one cell changed; the header is row 1."""
    rows = table()
    rows[row - 1][column] = value
    return text(rows)


def without(row: int) -> bytes:
    """Return the good file without one row."""
    rows = table()
    del rows[row - 1]
    return text(rows)


def constant() -> bytes:
    """Return the good file with an input that never moves."""
    rows = table()
    return text([rows[0], *([t, 3, y] for t, _, y in rows[1:])])


BAD: dict[str, tuple[bytes, str]] = {
    "empty": (b"", "empty"),
    "words": (b"note,comment\n" + b"good,day\n" * 40, "row 2, column 'note' is 'good'"),
    "missing cell": (with_cell(31, 1, ""), "row 31, column 'u'"),
    "no number": (with_cell(17, 2, "warm"), "row 17, column 'y': 'warm'"),
    "gap in time": (without(50), "rows 49 and 50, column 'time'"),
    "constant input": (constant(), "column 'u' is constant: 3 from row 2 to row 121"),
    "semicolons": (text(table(), ";"), "row 1 is one column, 'time;u;y'"),
    "binary": (b"PK\x03\x04\x00\x00\xff\xfe" * 50, "row 1 holds bytes"),
    "no header": (text(table()[1:]), "row 1"),
    "ragged": (with_cell(9, 1, "1,2"), "row 9 has 4 cells"),
    "same name": (text([["t", "y", "y"], *table()[1:]]), "'y' more than once"),
    "too short": (text(table()[:9]), "only 8 rows"),
    "time goes back": (with_cell(40, 0, "2"), "row 40, column 'time'"),
}
"""Files that cannot be used, and what has to be said of each."""


# --- The library behind the page -----------------------------------------------------


def test_bands_and_clouds_come_from_the_covariance() -> None:
    """The same seed draws the same models; their responses and poles are shown."""
    record = shipped("gas_furnace").detrend("constant")
    found = sriv(record, ORDERS, "estimate")
    drawn = draw(found, 200, np.random.default_rng(5))
    poles = pole_draws(found, 200, np.random.default_rng(5))
    assert np.abs(poles[:, 0] + drawn[:, 0]).max() < ALGEBRA
    one = np.array(
        [step_response(found.with_parameters(parameters), 40) for parameters in drawn]
    )
    low, high = step_band(found, 40, np.random.default_rng(5))
    inside = (low <= one) & (one <= high)
    # Of 200 draws, five lie beyond each quantile, where the response has begun.
    assert inside[:, 10:].mean() == pytest.approx(0.95, abs=0.01)
    gain = found.derived()["gain of u_gas_rate"][0]
    last = step_response(found, 400)[-1]
    assert last == pytest.approx(gain, rel=1e-9)  # settled but for 0.6^400


def test_experiment_is_the_plant_at_rest() -> None:
    """Without noise a planned experiment is the plant's own simulation."""
    model = DifferenceModel([-1.2, 0.5], [1.0, 0.4])
    u = prbs(100, 4)
    record = experiment(model.plant(), u, 0.0, np.random.default_rng(0))
    assert np.abs(record.y - model.simulate(u[:, None])[: len(u)]).max() < 1e-12 * 10
    with pytest.raises(ValueError, match="moved = 1"):
        experiment(model.plant(), u, 0.0, np.random.default_rng(0), moved=1)


def test_a_model_becomes_a_case() -> None:
    """Every design of an identified model's case settles at the reference."""
    record = shipped("gas_furnace").detrend("constant")
    found = sriv(record, ORDERS, "estimate")
    made = model_case(found.to_model(), found.covariance)
    assert made.covariance is found.covariance
    for design in made.designs.values():
        run = closed_loop(made.plant, design.build(), made.scenario)
        # before the disturbance and at the end; what settling within 5 % leaves
        assert abs(run.y[-1, 0] - run.r[-1, 0]) < 0.05
    with pytest.raises(ValueError, match="stable"):
        model_case(DifferenceModel([-1.0], [1.0]))


def test_charts_draw_bands_and_points() -> None:
    """A figure takes charts of estimates: stems, a band, a cloud of points."""
    record = shipped("gas_furnace").detrend("constant")
    found = {"one": sriv(record, ORDERS, "estimate")}
    charts = [*record_charts(record, found, record), *estimate_charts(found)]
    figures = {chart.name: EstimateFigure(chart) for chart in charts}
    assert list(figures) == ["output", "signal", "step", "poles", "auto", "cross"]
    assert len(figures["poles"].points[0].data["t"]) == 201
    band = figures["step"].bands[0].data
    assert (band["low"] <= band["high"]).all()
    with pytest.raises(ValueError, match="4 estimates"):
        estimate_charts({str(i): found["one"] for i in range(4)})


# --- Choices, without a browser ------------------------------------------------------


@pytest.mark.parametrize("name", OWN)
def test_python_shown_finds_the_same(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The script of each record runs and ranks the same models as the page."""
    monkeypatch.chdir(tmp_path)
    choices = IdentifyChoices()
    choices.take_record(name)
    choices.na_high = choices.nb_high = 2
    assert name in LOOK
    names: dict[str, Any] = {}
    found = choices.search()()
    with contextlib.redirect_stdout(io.StringIO()):
        exec(
            compile(choices.script(str(found[1].orders)), "shown", "exec"),
            names,
        )
    assert [str(c.orders) for c in names["found"]] == [str(c.orders) for c in found]
    saved, here = load("model.json"), found[1].estimate
    assert here is not None
    assert np.array_equal(saved.parameters, here.parameters)
    assert np.array_equal(saved.covariance, here.covariance)


def test_python_of_a_file_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The script of an upload reads the file by its name."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.csv").write_bytes(text(table()))
    choices = IdentifyChoices()
    choices.take_file(uploaded("mine.csv", text(table())))
    assert (choices.time, choices.output, choices.inputs) == ("time", "y", ["u"])
    names: dict[str, Any] = {}
    with contextlib.redirect_stdout(io.StringIO()):
        exec(compile(choices.script(), "shown", "exec"), names)
    best = names["best"]
    error = np.abs(best.parameters[:2] - [-0.8, 0.5]) / best.standard_errors[:2]
    assert str(best.orders) == "[1 1 1]"
    assert error.max() < 4.0  # four standard errors of a seeded record


@pytest.mark.parametrize("kind", BAD)
def test_bad_files_change_nothing(kind: str) -> None:
    """Each bad file is explained; all choices and the record stay."""
    data, message = BAD[kind]
    page = IdentifyPage()
    before, record = page.choices.values(), page.choices.whole
    with pytest.raises(ValueError, match=r".") as said:
        page.choices.take_file(uploaded("bad.csv", data))
    assert message in str(said.value)
    assert page.choices.values() == before
    assert page.choices.whole.y.tobytes() == record.y.tobytes()


def test_size_is_limited_on_the_server_too() -> None:
    """What a page should not have sent is refused before it is read."""
    with pytest.raises(ValueError, match=r"6\.0 MB; up to 5 MB"):
        uploaded("large.csv", b"", 6_000_000)


def test_rows_can_be_left_out() -> None:
    """Bad rows and gaps are bridged on request, and the page says so."""
    choices = IdentifyChoices()
    choices.take_file(uploaded("good.csv", text(table())))
    assert choices.whole.notes == ()
    choices.bad = "skip_bad"
    choices.take_file(uploaded("gap.csv", without(50)))
    assert "resampled every 1" in choices.whole.notes[0]
    assert len(choices.whole.time) == 120


def test_choices_are_taken_whole_or_not_at_all() -> None:
    """A span without samples or a column with two roles leaves all as it was."""
    choices = IdentifyChoices()
    choices.take_file(uploaded("good.csv", text(table())))
    before = choices.values()
    for wrong in ({"est_to": 0.0}, {"inputs": ["y"]}, {"est_to": 1e9}, {"na_low": 0}):
        with pytest.raises(ValueError, match=r"."):
            choices.accept({**before, **wrong})
        assert choices.values() == before
    with pytest.raises(ValueError, match="no file"):
        IdentifyChoices().accept({"record": "file"})


def test_links_name_what_differs() -> None:
    """What an address holds is taken in the order in which it makes sense."""
    choices = IdentifyChoices()
    choices.accept({"est_to": "300", "record": "ifac93", "samples": "1000"})
    assert (choices.record, choices.samples, choices.est_to) == ("ifac93", 1000, 300.0)
    assert len(choices.fitted.time) == 600
    choices.accept({"record": "shell", "clock": "20"})
    assert choices.est_to == choices.val_from
    before = choices.values()
    for wrong in ({"record": "<b>"}, {"record": "file"}, {"method": "x"}):
        with pytest.raises(ValueError, match=r"."):
            choices.accept(wrong)
        assert choices.values() == before


def test_every_choice_is_explained() -> None:
    """Each control has a label and a sentence of help."""
    for name in OWN:
        choices = IdentifyChoices()
        choices.take_record(name)
        items = [item for group in choices.description() for item in group["items"]]
        for item in items:
            assert item["label"]
            assert item["help"].endswith(".")


def test_kept_models_open_on_the_other_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kept model is a case there, with a script; a forgotten one is explained."""
    monkeypatch.chdir(tmp_path)
    record = shipped("gas_furnace").detrend("constant")
    found = sriv(record, ORDERS, "estimate")
    name = keep_model(found)
    choices = LoopChoices(case=name)
    runs = choices.runs()
    names: dict[str, Any] = {}
    (tmp_path / "model.json").write_text(_file(found))
    with contextlib.redirect_stdout(io.StringIO()):
        exec(compile(choices.script(), "shown", "exec"), names)
    for key, run in runs.items():
        assert np.array_equal(names["runs"][key].y, run.y)
    del KEPT[name]
    with pytest.raises(ValueError, match="no longer kept"):
        LoopChoices(case=name)


def _file(found: Any) -> str:
    from nmss_lab.files import dumps

    return dumps(found)


# --- The search, without a browser ---------------------------------------------------


def ended(page: IdentifyPage) -> None:
    """Wait until the search has ended."""
    until = time.monotonic() + 60.0
    while page.work is not None or page.ranking.progress["running"]:
        assert time.monotonic() < until
        time.sleep(0.01)


class Paused:
    """A search that stands still after its second fit until it is told to go on."""

    def __init__(self, page: IdentifyPage) -> None:
        self.reached, self.go_on = threading.Event(), threading.Event()
        self.left = threading.Event()
        job = page.choices.search()
        page.choices.search = lambda: self._searches(job)
        page._begin()
        del page.choices.search
        assert self.reached.wait(30)

    def _searches(self, job: Any) -> Any:
        def search(progress: Any) -> Any:
            def heard(done: int, total: int) -> Any:
                if done == 2:
                    self.reached.set()
                    assert self.go_on.wait(30)
                return progress(done, total)

            try:
                return job(progress=heard)
            finally:
                self.left.set()

        return search


def test_cancel_keeps_what_was_fitted() -> None:
    """Two of thirty were fitted: they are ranked, and the better one is drawn."""
    page = IdentifyPage()
    paused = Paused(page)
    assert page.ranking.progress["running"]
    page.ranking.sent = {"act": "cancel", "number": 1}
    paused.go_on.set()
    ended(page)
    assert page.note.startswith("Cancelled: 2 fitted")
    assert len(page.ranking.rows) == 2
    assert len(page.shown) == 1
    assert not page.ranking.progress["running"]


def test_newer_search_supersedes() -> None:
    """The older one is called off, and what it found is not shown."""
    page = IdentifyPage()
    paused = Paused(page)
    older = page.work
    page.choices.na_high = 1
    page._begin()
    assert older is not None
    assert older.stop.is_set()
    ended(page)
    rows, note = page.ranking.rows, page.note
    paused.go_on.set()
    assert paused.left.wait(30)
    time.sleep(0.2)
    assert page.ranking.rows is rows
    assert len(rows) == page.choices.tries
    assert page.note == note


def test_search_that_cannot_begin_leaves_the_other() -> None:
    """Too many structures are refused while an earlier search goes on."""
    page = IdentifyPage()
    paused = Paused(page)
    page.choices.accept({"na_high": 6, "nb_high": 6, "nk_high": 30})
    page._begin()
    assert "up to 500" in page.alert.object
    paused.go_on.set()
    ended(page)
    assert len(page.ranking.rows) == 30


def test_search_called_off_in_the_queue_is_told() -> None:
    """It never began: nothing is ranked, and the note says so."""
    page = IdentifyPage()
    gate = threading.Event()
    busy = [SEARCHES.submit(gate.wait, 30) for _ in range(SEARCHES._max_workers)]
    page._begin()
    assert page.note == "Waiting for its turn"
    page.call_off()  # as a session does that closes
    gate.set()
    ended(page)
    assert page.note == "Cancelled before the first fit"
    assert page.ranking.rows == []
    assert all(each.result(30) for each in busy)


def test_fault_in_a_search_is_logged_and_told(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A fault of the program ends the search in words, as a wrong record does."""
    page = IdentifyPage()
    for raised, says in ((KeyError("gone"), "fault"), (ValueError("odd"), "odd")):

        def search(progress: Any, raised: Exception = raised) -> Any:
            raise raised

        page.choices.search = lambda search=search: search
        page._begin()
        ended(page)
        assert says in page.alert.object
        assert not page.ranking.progress["running"]
    assert [record.exc_info[0] for record in caplog.records] == [KeyError]


def test_short_spans_are_answered() -> None:
    """A span without samples is refused; one of a few samples is fitted and drawn."""
    page = IdentifyPage()
    page._begin()
    ended(page)
    before = page.choices.values()
    page.controls.sent = {**before, "val_from": 1900.0, "val_to": 1901.0, "message": 7}
    assert "holds no sample" in page.alert.object
    assert page.choices.values() == before
    assert page.controls.state["message"] == 7
    page.controls.sent = {**before, "est_to": 135.0, "message": 8}
    page._begin()
    ended(page)
    assert page.alert.object == ""
    assert page.shown


# --- In the browser ------------------------------------------------------------------

DONE = "window.nmssIdentify?.rows() > 0 && !nmssIdentify.running() && nmssForm.idle()"


@pytest.fixture
def visit(server: Server, browser: Browser) -> Iterator[Open]:
    """Yield a function that opens the page; nothing may complain or call away."""
    with watched(server, browser, DONE, "identify") as open_page:
        yield open_page


def choose(page: Page, name: str, value: str) -> None:
    """Choose an option and wait until the page has answered and searched."""
    page.locator(f"select[name={name}]").select_option(json.dumps(value))
    page.wait_for_function(DONE, timeout=60_000)


def search(page: Page) -> None:
    """Start a search and wait until it has ended."""
    before = page.evaluate("nmssIdentify.finished")
    page.get_by_role("button", name="Search").click()
    page.wait_for_function(f"nmssIdentify.finished > {before}", timeout=60_000)


def upload(page: Page, data: bytes, name: str = "mine.csv") -> None:
    """Give a file to the page."""
    page.locator("input[name=upload]").set_input_files(
        {"name": name, "mimeType": "text/csv", "buffer": data}
    )


def ranking(page: Page) -> list[str]:
    """Return the rows of the ranking as text."""
    return page.locator(".rows tbody tr").all_inner_texts()


def test_each_record_from_data_to_controller(visit: Open, server: Server) -> None:
    """Every shipped record is ranked; a row goes on to the other page, or a file."""
    page = visit()
    for name in [*OWN[1:], OWN[0]]:
        choose(page, "record", name)
        assert len(ranking(page)) >= 30
        best = page.locator(".picked b").inner_text()
        expect(page.locator(".text-measures")).to_contain_text(best)
        expect(page.locator(".text-measures")).to_contain_text("\u00b1")
    with page.expect_download() as got:
        page.get_by_role("button", name="Save as JSON").click()
    saved = load(got.value.path())
    assert str(saved.orders) == best
    assert saved.covariance.shape == (saved.orders.count,) * 2
    expect(page.get_by_role("button", name="Govern it")).to_have_count(1)
    page.get_by_role("button", name="Control it").click()
    page.wait_for_function("window.nmssPlayer?.frames > 0", timeout=60_000)
    assert page.url.startswith(f"{server.url}receding_horizon?case=model-")
    chosen = page.locator("select[name=case] option:checked")
    expect(chosen).to_contain_text("Your model of")
    expect(page.locator(".text-measures tbody tr")).to_have_count(2)
    expect(page.locator(".wrong")).to_have_count(0)
    page.goto(page.url.replace("receding_horizon", "governor"))
    page.wait_for_function("window.nmssPlayer?.frames > 0", timeout=60_000)
    expect(page.locator("select[name=case] option:checked")).to_contain_text("Your")
    expect(page.locator(".text-measures tbody tr")).to_have_count(2)
    expect(page.locator(".wrong")).to_have_count(0)
    assert server.faults() == []


def test_rows_are_sorted_and_compared(visit: Open) -> None:
    """Headers sort; up to three rows are drawn side by side with their values."""
    page = visit()
    first = ranking(page)[0]
    page.get_by_role("button", name="BIC").click()
    expect(page.locator("th[aria-sort=ascending]")).to_contain_text("BIC")
    assert ranking(page)[0] != first
    numbers = [row.split("\t")[2] for row in ranking(page)]
    values = [float(n.replace("\u2212", "-")) for n in numbers]
    assert values == sorted(values)
    boxes = page.locator(".rows tbody input")
    boxes.nth(0).check()
    expect(page.locator(".picked > div")).to_have_count(2)
    page.keyboard.press("Tab")
    page.keyboard.press("Space")
    expect(page.locator(".picked > div")).to_have_count(3)
    expect(page.locator(".text-measures thead th")).to_have_count(4)
    expect(page.locator(".rows tbody input:not(:checked)").first).to_be_disabled()
    drawn = "Bokeh.documents[0].get_model_by_name('step').renderers"
    page.wait_for_function(
        f"{drawn}.filter((r) => r.name.startsWith('band')"
        " && r.data_source.data.t.length > 0).length === 3"
    )


def test_held_designs_in_the_ranking(visit: Open) -> None:
    """Held models stand on top with their fit; ticked they are drawn, by the link too.

    What does not fit says why, and cannot be ticked.
    """
    page = visit()
    boxes = page.locator(".rows tbody:not(.held) input")
    orders = boxes.first.locator("..").inner_text().strip()
    page.locator("summary", has_text="A:").click()
    page.get_by_role("button", name=f"Hold model {orders} as A").click()
    held = page.locator(".rows tbody.held tr")
    expect(held).to_have_count(1)
    ours, theirs = held.first.inner_text(), ranking(page)[1]
    assert ours.split("\t")[4] == theirs.split("\t")[4] != "\u2013"
    held.get_by_role("checkbox").check()
    expect(page.locator(".text-measures thead th")).to_have_count(3)
    expect(page.locator(".text-measures")).to_contain_text("design A")
    expect(page.locator(".picked > div")).to_have_count(2)
    page.wait_for_function("location.search.includes('beside=A')")
    tanks = LoopChoices(case="wood_berry").hold("wang_young")
    address = page.evaluate("location.pathname.slice(1) + location.search")
    again = visit(f"{address}&B={quote(tanks)}")
    expect(again.locator(".picked > div")).to_have_count(2)
    kept = again.locator(".rows tbody.held tr")
    assert kept.first.inner_text() == ours
    expect(kept.nth(1)).to_contain_text("its model has 2 outputs, this record has 1")
    expect(kept.nth(1).get_by_role("checkbox")).to_be_disabled()
    drawn = "Bokeh.documents[0].get_model_by_name('output').renderers"
    again.wait_for_function(
        f"{drawn}.filter((r) => r.name.startsWith('style')"
        " && r.data_source.data.t.length > 0).length === 2"
    )
    kept.first.get_by_role("checkbox").uncheck()
    expect(again.locator(".picked > div")).to_have_count(1)
    again.get_by_role("button", name="A | B").click()
    expect(again.locator(".picked > div")).to_have_count(2)
    again.get_by_role("button", name="Undo").click()
    expect(again.locator(".text-measures thead th")).to_have_count(3)


def test_spans_by_mouse_and_by_keyboard(visit: Open) -> None:
    """Dragging a box and typing a time do the same; the link restores it."""
    page = visit()
    field = page.locator("input[name=est_to]")
    before = field.input_value()
    frame = page.locator(".chart.output").bounding_box()
    x = frame["x"] + page.evaluate(TO_PIXELS, float(before))
    y = frame["y"] + 0.66 * frame["height"]
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 120, y, steps=6)
    page.mouse.up()
    expect(field).not_to_have_value(before)
    dragged = page.evaluate("Bokeh.documents[0].get_model_by_name('span-est').right")
    expect(field).to_have_value(re.compile(rf"^{int(dragged)}\b"))  # the last step
    page.wait_for_function("nmssForm.idle()")
    assert float(field.input_value()) < float(before)
    field.fill("1200")
    field.press("Tab")
    page.wait_for_function(
        "Bokeh.documents[0].get_model_by_name('span-est').right === 1200"
    )
    page.wait_for_function("location.search.includes('est_to=1200')")
    note = page.locator(".note")
    expect(note).to_contain_text("with earlier choices")
    search(page)
    expect(note).not_to_contain_text("earlier")
    address = page.evaluate("location.pathname.slice(1) + location.search")
    again = visit(address)
    expect(again.locator("input[name=est_to]")).to_have_value("1200")
    assert ranking(again) == ranking(page)
    field.fill("99999")
    field.press("Tab")
    expect(page.get_by_role("alert")).to_contain_text("est_to")
    expect(field).to_have_value("1200")


def test_upload_of_a_good_file(visit: Open) -> None:
    """A file is read, its columns are assigned, names stay text, a model comes out."""
    page = visit()
    rows = table()
    rows[0] = ["time", "<img src=x onerror=alert(1)>", "y"]
    upload(page, text(rows), "<b>mine</b>.csv")
    expect(page.locator("select[name=time]")).to_have_value('"time"')
    expect(page.locator(".ranking > .quiet")).to_contain_text("Nothing searched yet")
    expect(page.locator(".text-lead")).to_contain_text("<b>mine</b>.csv")
    search(page)
    assert ranking(page)[0].startswith("[1 1 1]")
    expect(page.locator(".text-measures")).to_contain_text("gain of <img src=x")
    assert page.locator("img").count() == 0
    choose(page, "record", "gas_furnace")
    choose_file = page.locator("select[name=record]")
    choose_file.select_option('"file"')
    expect(page.locator("select[name=output]")).to_have_value('"y"')


def test_bad_files_are_explained_on_the_page(visit: Open) -> None:
    """Every bad file gets its message; ranking and choices stay."""
    page = visit()
    before = ranking(page)
    for kind, (data, message) in BAD.items():
        upload(page, data, f"{kind}.csv")
        alert = page.get_by_role("alert")
        expect(alert).to_contain_text(f"{kind}.csv: ")
        expect(alert).to_contain_text(message)
    upload(page, b"0" * (LARGEST + 1), "large.csv")
    expect(page.get_by_role("alert")).to_contain_text("up to 5 MB")
    assert ranking(page) == before
    expect(page.locator("select[name=record]")).to_have_value('"gas_furnace"')
    choose(page, "method", "sriv")
    expect(page.locator(".wrong")).to_have_count(0)


def test_a_long_search_is_cancelled(visit: Open) -> None:
    """A search of a long record shows progress, leaves the page alive, and stops."""
    page = visit()
    upload(page, text(table(60_000)), "long.csv")
    # two megabytes travel and are read: more than the usual five seconds under load
    expect(page.locator("select[name=time]")).to_have_count(1, timeout=30_000)
    for name in ("na_high", "nb_high"):
        slide = page.locator(f"input[name={name}]")
        slide.fill("6")
    page.wait_for_function("nmssForm.idle()")
    page.get_by_role("button", name="Search").click()
    cancel = page.get_by_role("button", name="Cancel")
    expect(cancel).to_be_enabled()
    page.wait_for_function("nmssIdentify.running()")
    page.locator("input[name=nk_high]").fill("4")
    page.wait_for_function("nmssForm.idle()", timeout=5_000)
    assert page.evaluate("nmssIdentify.running()")
    cancel.click()
    expect(page.locator(".note")).to_contain_text("Cancelled", timeout=15_000)
    expect(cancel).to_be_hidden()
    assert len(ranking(page)) < 180


def test_too_many_structures_are_refused(visit: Open) -> None:
    """A range that is too wide says so, and what was found stays."""
    page = visit()
    before = ranking(page)
    for name, value in (("na_high", "6"), ("nb_high", "6"), ("nk_high", "30")):
        page.locator(f"input[name={name}]").fill(value)
        page.wait_for_function("nmssForm.idle()")
    page.get_by_role("button", name="Search 1080 structures").click()
    expect(page.get_by_role("alert")).to_contain_text("up to 500")
    assert ranking(page) == before


@pytest.mark.parametrize(("width", "scheme"), [(390, "dark"), (1024, "light")])
def test_fits_the_screen_in_the_colours_asked_for(
    visit: Open, width: int, scheme: str
) -> None:
    """Nothing scrolls sideways; figures follow the scheme; controls have names."""
    page = visit("identify", width, color_scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for chart in page.locator(".chart").all():
        assert chart.bounding_box()["width"] > 250
    label = "Bokeh.documents[0].get_model_by_name('poles').title.text_color"
    dark = page.evaluate(label)
    page.get_by_role("button", name="Light or dark colours").click()
    page.wait_for_function(f"{label} !== {json.dumps(dark)}")
    assert page.evaluate(NAMELESS) == []


TO_PIXELS = """(time) => {
  const find = (view) => view.model?.name === "output" ? view
    : (view.child_views ?? []).map(find).find(Boolean)
  const roots = Object.values(Bokeh.index.roots ?? Bokeh.index)
  return roots.map(find).find(Boolean).frame.x_scale.compute(time)
}"""

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
