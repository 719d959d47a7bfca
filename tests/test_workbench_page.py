"""The page Workbench in a real browser, and its steps without one."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Open, Server, watched
from playwright.sync_api import Browser, Page, expect

from apps.identification import uploaded
from apps.pages.workbench import WorkbenchPage
from apps.session import held
from apps.workbench import STEPS, Bench, WorkbenchChoices, charts, do, script
from nmss_lab.files import Study, load, loads

MEASURED = ["gas_furnace", "tclab_step_test"]


def choices_of(record: str, **values: Any) -> WorkbenchChoices:
    """Choices about a record, the quicker ones by default."""
    choices = WorkbenchChoices()
    choices.take_record(record)
    choices.accept({"record": record, "n": 40, "most": 50, **values})
    return choices


def all_done(choices: WorkbenchChoices, last: str = "report") -> Bench:
    """Do the steps in this process."""
    bench = Bench()
    for step in bench.missing(last, choices):
        bench.put(step, choices, do(step, choices, bench.results))
    return bench


def csv_of(samples: int = 120, seed: int = 0, v: bool = False) -> bytes:
    """Write the record of a plant that is known: gain 2, time constant 9 samples."""
    rng = np.random.default_rng(seed)
    u = 5.0 + np.repeat(rng.choice([-1.0, 1.0], samples // 10), 10)
    w = np.repeat(rng.choice([-1.0, 1.0], samples // 8 + 1), 8)[:samples] * v
    y = np.zeros(samples)
    for k in range(2, samples):
        y[k] = 0.9 * y[k - 1] + 0.2 * (u[k - 2] - 5.0) + 0.1 * w[k - 1]
    y += 40.0 + 0.01 * rng.standard_normal(samples)
    head = "time_s,level_mm,valve_percent" + ",inflow" * v
    rows = zip(np.arange(samples) * 2.0, y, u, *([w] if v else []), strict=True)
    lines = [",".join(f"{x:.6g}" for x in row) for row in rows]
    return "\n".join([head, *lines]).encode()


# --- Steps, without a browser ---------------------------------------------------------


@pytest.mark.parametrize("record", MEASURED)
def test_every_step_of_a_measured_record(record: str) -> None:
    """A record becomes a design without offset, in limits, with a report."""
    choices = choices_of(record)
    bench = all_done(choices)
    assert [bench.state(step, choices) for step in STEPS] == ["done"] * 7
    assert bench.verdict(choices) == (True, [])
    done = bench.results
    assert f"{len(choices.whole.time)} samples" in done["data"].words
    assert done["model"].orders == done["model"].rows[0]["orders"]
    assert done["robustness"].words.startswith("0 of 40 plants unstable [0, 8.8 %]")
    study = loads(done["report"].design)
    assert isinstance(study, Study)
    assert study.design.structure == "wang_young"
    assert "ParameterCovariance(" in done["report"].html
    drawn = charts(done)
    assert len({chart.name for chart in drawn}) == len(drawn) == 10


@pytest.mark.parametrize("record", MEASURED)
def test_the_script_runs_and_prints_what_the_page_says(
    record: str, tmp_path: Path
) -> None:
    """One script does all steps as they were done, and writes the same design."""
    choices = choices_of(record)
    bench = all_done(choices)
    printed = run(script(bench, choices), tmp_path)
    tuned = bench.results["tuning"].tuned
    for row in tuned.table():
        assert f"'after': {row['after']!r}" in printed
    worst = bench.results["robustness"].study.table["radius"].max()
    assert repr(float(worst)) in printed
    made, own = load(tmp_path / "design.json"), loads(bench.results["report"].design)
    np.testing.assert_array_equal(made.design.R, own.design.R)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert text == bench.results["report"].html


def run(text: str, folder: Path) -> str:
    """Run a script in a process of its own; return what it printed."""
    (folder / "shown.py").write_text(text, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "shown.py"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_file_of_ones_own_with_a_measured_disturbance(tmp_path: Path) -> None:
    """Its limits are absolute, its structure counts v in, its script reads it."""
    data = csv_of(v=True)
    (tmp_path / "tank.csv").write_bytes(data)
    choices = WorkbenchChoices()
    choices.take_file(uploaded("tank.csv", data))
    columns = {"output": "level_mm", "inputs": ["valve_percent"]}
    choices.accept(
        {
            **columns,
            "disturbances": ["inflow"],
            "detrend": "constant",
            "nk_high": 3,
            "n": 20,
        }
    )
    assert (choices.u_low, choices.u_high) == ("4", "6")
    bench = all_done(choices)
    limits = bench.results["tuning"].tuned.design.limits
    rest = choices.rest[1]
    assert np.allclose([limits.u[0] + rest, limits.u[1] + rest], [[4.0], [6.0]])
    assert bench.results["structure"].words.startswith("Disturbance, direct")
    gain = bench.results["model"].estimate.derived()["gain of valve_percent"][0]
    assert abs(gain - 2.0) < 0.3
    assert "20" in run(script(bench, choices), tmp_path)


def test_a_choice_makes_its_step_and_later_ones_out_of_date() -> None:
    """Results stay, and are current again when the choice changes back."""
    choices = choices_of("gas_furnace")
    bench = all_done(choices)
    choices.accept({"u_high": "2.0"})
    states = [bench.state(step, choices) for step in STEPS]
    assert states == ["done"] * 3 + ["stale"] * 4
    assert "step 4, limits, is out of date" in bench.verdict(choices)[1]
    assert "tune(" not in script(bench, choices)
    choices.accept({"u_high": "2.84"})
    assert bench.verdict(choices) == (True, [])


def test_another_row_of_the_ranking_needs_no_new_search() -> None:
    """The model chosen is that of the row; the ranking is the same object."""
    choices = choices_of("gas_furnace")
    bench = all_done(choices, "model")
    before = bench.results["model"]
    choices.accept({"model": before.rows[2]["orders"]})
    after = do("model", choices, bench.results)
    assert after.found is before.found
    assert after.orders == before.rows[2]["orders"]


@pytest.mark.parametrize(
    ("values", "step", "why"),
    [
        ({"detrend": "constant"}, "model", "no structure gave a model to trust"),
        ({"u_low": "50"}, "limits", "lies outside 50 to 100"),
        ({"u_low": "0, 1, 2"}, "limits", "3 numbers, expected one"),
        ({"structure": "disturbance_direct"}, "structure", "the record has none"),
        ({"model": "[9 9 9]"}, "model", "no model of this search"),
    ],
)
def test_what_cannot_be_done_says_why(
    values: dict[str, Any], step: str, why: str
) -> None:
    """A step that fails names the reason and what to do; earlier ones are kept."""
    choices = choices_of("tclab_step_test", **values)
    before = list(STEPS)[list(STEPS).index(step) - 1]
    bench = all_done(choices, before)
    with pytest.raises(ValueError, match=why) as caught:
        do(step, choices, bench.results)
    bench.fail(step, choices, str(caught.value))
    assert bench.state(step, choices) == "failed"
    assert bench.state(before, choices) == "done"


def test_limits_are_numbers() -> None:
    """A text that is none is refused, and what was there stays."""
    choices = choices_of("gas_furnace")
    with pytest.raises(ValueError, match="u_high = 'much': expected numbers"):
        choices.accept({"u_high": "much"})
    assert choices.u_high == "2.84"


def test_a_step_can_be_called_off() -> None:
    """What hears of its progress may end it; nothing is taken over then."""

    class Enough(Exception):  # noqa: N818  nothing went wrong
        pass

    choices, heard = choices_of("gas_furnace"), threading.Event()

    def stop(done: int, total: int) -> bool:
        heard.set()
        raise Enough

    bench = all_done(choices, "limits")
    for step in ("tuning", "model"):
        heard.clear()
        choices.accept({"na_high": 3})
        with pytest.raises(Enough):
            do(step, choices, bench.results, stop)
        assert heard.is_set()


def test_designs_are_held_for_other_pages() -> None:
    """The bar of designs has the tuned one, and the address makes it."""
    page = WorkbenchPage()
    page.bench = all_done(page.choices)
    page._tell()
    assert page._shown_designs() == ["tuned"]
    text = page._address("tuned")
    tuned = page.bench.results["tuning"].tuned.design
    np.testing.assert_array_equal(held(text).design.R, tuned.R)


# --- In the browser ------------------------------------------------------------------

OPENED = "window.nmssWorkbench?.states()[1] === 'done' && !nmssWorkbench.running()"


@pytest.fixture
def visit(server: Server, browser: Browser) -> Iterator[Open]:
    """Yield a function that opens the page; nothing may complain or call away."""
    with watched(server, browser, OPENED, "workbench?n=40&most=50") as open_page:
        yield open_page
    assert server.faults() == []


def states(page: Page) -> list[str]:
    """States of the steps, in their order."""
    return list(page.evaluate("nmssWorkbench.states()"))


def do_all(page: Page) -> None:
    """Press "Do all" and wait for its end."""
    before = page.evaluate("nmssWorkbench.ended")
    page.get_by_role("button", name="Do all").click()
    page.wait_for_function(f"nmssWorkbench.ended > {before}", timeout=120_000)


def test_from_the_record_to_the_report(visit: Open) -> None:
    """It opens with two steps done; all the others follow, and files can be saved."""
    page = visit()
    assert states(page) == ["done"] * 2 + ["ready"] + ["waiting"] * 4
    expect(page.locator("#step-model .chart").first).to_be_visible()
    expect(page.locator("#step-tuning .chart").first).to_be_hidden()
    do_all(page)
    assert states(page) == ["done"] * 7
    expect(page.locator(".conductor .verdict")).to_contain_text("Verified")
    expect(page.locator("#step-robustness")).to_contain_text("0 of 40 plants unstable")
    for step in ("data", "model", "limits", "tuning", "robustness"):
        box = page.locator(f"#step-{step} .chart").first.bounding_box()
        assert box is not None
        assert box["height"] > 150
        expect(page.locator(f"#step-{step} .stephead .state")).to_have_text("done")
    with page.expect_download() as got:
        page.get_by_role("button", name="Save the design").click()
    assert isinstance(load(got.value.path()), Study)
    page.get_by_role("link", name="Closer look: Robustness").click()
    page.wait_for_function("window.nmssStudy?.shown() === 40", timeout=60_000)
    expect(page.locator(".designbar")).to_contain_text("Tuned")


def test_a_choice_marks_what_is_out_of_date(visit: Open) -> None:
    """Later steps say so and keep their pictures; undo makes them current again."""
    page = visit()
    do_all(page)
    field = page.locator("input[name=u_high]")
    field.fill("2")
    field.press("Enter")
    page.wait_for_function("nmssWorkbench.states()[3] === 'stale'")
    assert states(page) == ["done"] * 3 + ["stale"] * 4
    expect(page.locator("#step-tuning .chart").first).to_be_visible()
    expect(page.locator(".conductor .verdict")).to_contain_text("out of date")
    page.locator("#step-tuning").get_by_role("button", name="Do again").click()
    page.wait_for_function("nmssWorkbench.states()[4] === 'done'", timeout=60_000)
    assert states(page)[5:] == ["stale"] * 2


def test_another_model_by_the_keyboard(visit: Open) -> None:
    """Rows of the ranking are radio buttons; the one chosen is the model."""
    page = visit()
    first = page.locator("#step-model input[type=radio]").first
    first.focus()
    first.press("ArrowDown")
    chosen = page.locator("#step-model input[type=radio]").nth(1).get_attribute("value")
    expect(page.locator("#step-model .words")).to_contain_text(str(chosen))


def test_a_file_of_ones_own(visit: Open) -> None:
    """A small file goes all the way; one with a constant input says what is wrong."""
    page = visit()
    upload = page.locator("input[name=upload]")
    rows = csv_of().decode().splitlines()
    still = "\n".join([rows[0], *(f"{r.rsplit(',', 1)[0]},5" for r in rows[1:])])
    bad = {"name": "bad.csv", "mimeType": "text/csv", "buffer": still.encode()}
    upload.set_input_files(bad)
    expect(page.locator(".alert")).to_contain_text("'valve_percent' is constant")
    own = {"name": "tank.csv", "mimeType": "text/csv", "buffer": csv_of()}
    upload.set_input_files(own)
    expect(page.locator("#step-data .words")).to_contain_text("120 samples every 2 s")
    do_all(page)
    assert states(page) == ["done"] * 7
    expect(page.locator("#step-limits .words")).to_contain_text("valve")
    page.get_by_text("The Python that computes this").click()
    expect(page.locator(".text-python")).to_contain_text("tank.csv")


def test_a_failure_stops_all(visit: Open) -> None:
    """The step that failed says why; the head says where it stopped."""
    page = visit()
    page.locator("select[name=structure]").select_option(
        json.dumps("disturbance_direct")
    )
    do_all(page)
    assert states(page)[2:4] == ["failed", "waiting"]
    expect(page.locator("#step-structure .problem")).to_contain_text("has none")
    expect(page.locator(".conductor .note")).to_contain_text("Stopped at step 3")


def test_cancel_keeps_what_is_done(visit: Open) -> None:
    """Long work ends at once; the steps before it stay."""
    page = visit("workbench?n=2000&record=tclab_step_test")
    page.get_by_role("button", name="Do all").click()
    page.wait_for_function("nmssWorkbench.states()[5] === 'working'", timeout=90_000)
    page.locator(".conductor").get_by_role("button", name="Cancel").click()
    page.wait_for_function("!nmssWorkbench.running()")
    assert states(page) == ["done"] * 5 + ["ready", "waiting"]
    expect(page.locator(".conductor .note")).to_contain_text("Cancelled in step 6")


@pytest.mark.parametrize(
    ("width", "scheme"), [(390, "light"), (390, "dark"), (1440, "dark")]
)
def test_narrow_and_dark(visit: Open, width: int, scheme: str) -> None:
    """Nothing sticks out; a card leads to its choices, by the keyboard too."""
    page = visit(width=width, color_scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    button = page.get_by_role("button", name="Choices: Tuning")
    button.focus()
    button.press("Enter")
    expect(page.locator("input[name=faster]")).to_be_focused()
