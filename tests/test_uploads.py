"""Files that no page should have been given: each is answered in words.

Records go to the page Identify, designs through the bar of any page.  One visit takes
all of them in turn: after each the last good picture is still there, and at the end a
good file is read as if nothing had happened.  What tests/test_identify_page.py gives to
the page already (empty, ragged, constant, running backwards, ...) is not given again.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from conftest import PATIENCE, Open, Server, watched
from playwright.sync_api import Browser, Page, expect
from test_identify_page import DONE, ranking, table, text, upload, with_cell

from apps.identification import LARGEST
from apps.pages import bar
from nmss_lab.cases import case
from nmss_lab.design import Design
from nmss_lab.files import Study, dumps
from nmss_lab.models import DifferenceModel
from nmss_lab.records import Record
from nmss_lab.simulate import Scenario

SCRIPT = "<script>window.hurt = 1</script>"
IMAGE = "<img src=x onerror='window.hurt = 1'>"
PICTURE = b"\x89PNG\r\n\x1a\n" + bytes(range(256))


UNREAD = """() => {
  const read = () => { window.hurt = 1 }
  FileReader.prototype.readAsDataURL = Blob.prototype.text = read
}"""
"""From now on a file that is read hurts, in JavaScript."""


def named(*heads: str) -> bytes:
    """Return the good file with other names of its columns."""
    return text([list(heads), *table()[1:]])


def filled(column: int, value: str) -> bytes:
    """Return the good file with the same cell all down one column."""
    head, *rows = table()
    return text([head, *([*r[:column], value, *r[column + 1 :]] for r in rows)])


def spreadsheet() -> bytes:
    """Return the beginnings of a workbook, which is a zip file."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as book:
        book.writestr("xl/workbook.xml", "<workbook/>")
    return stream.getvalue()


def german() -> bytes:
    """Return the good file as a spreadsheet in much of Europe writes it."""
    return text([[cell.replace(".", ",") for cell in row] for row in table()], ";")


RECORDS: dict[str, tuple[bytes, str]] = {
    "header.csv": (b"time,u,y\n", "only 0 rows of data"),
    "one.csv": (text(table()[:2]), "only 1 row of data"),
    "picture.csv": (PICTURE, "row 1 holds bytes"),
    "wide.csv": (text(table()).decode().encode("utf-16"), "saved as UTF-8"),
    "latin.csv": (named("time", "é", "y").decode().encode("latin-1"), "row 1 holds"),
    "book.csv": (spreadsheet(), "row 1 holds bytes"),
    "null.csv": (with_cell(5, 1, "1\0"), "row 5 holds bytes of a binary file"),
    "twice.csv": (named("time", SCRIPT, SCRIPT), f"{SCRIPT!r} more than once"),
    "unnamed.csv": (named("time", "", "y"), "row 1, column 2 has no name"),
    "image.csv": (with_cell(7, 2, IMAGE), "row 7, column 'y': "),
    "formula.csv": (with_cell(7, 1, "=cmd|' /C calc'!A1"), "row 7, column 'u': \"=cmd"),
    "comma.csv": (german(), "separated by semicolons, expected commas"),
    "nan.csv": (filled(1, "nan"), "row 2, column 'u' is 'nan'"),
    "late.csv": (with_cell(60, 2, "nan"), "row 60, column 'y': 'nan'"),
    "inf.csv": (with_cell(9, 2, "inf"), "row 9, column 'y': 'inf'"),
    "huge.csv": (with_cell(9, 2, "-1e308"), "row 9, column 'y': -1e+308 is too large"),
    "huger.csv": (with_cell(9, 2, "1e999"), "'1e999' is not a finite number"),
    "million.csv": (with_cell(9, 2, "1" * 1_000_000), "row 9 is no row of cells"),
    "quote.csv": (with_cell(9, 1, '"1'), "row 9 has 2 cells"),
    "still.csv": (filled(2, "4"), "column 'y' is constant: 4"),
    "stands.csv": (with_cell(10, 0, "7"), "'7' does not come after the row before"),
    "never.csv": (with_cell(121, 0, "inf"), "row 121, column 'time'"),
    "page.csv": (f"<html>{SCRIPT}</html>".encode(), "only 0 rows of data"),
    "../../up.csv": (b"", "the file is empty"),
    f"{SCRIPT}.csv": (b"", "the file is empty"),
}
"""Records that cannot be used, by the file's name, and what has to be said."""

READ = {
    "bytes.csv": b"\xef\xbb\xbf" + text(table()).replace(b"\n", b"\r\n"),
    "script.csv": named("time [s]", SCRIPT, "y [m]"),
    "units.csv": named(f"time [{IMAGE}]", f"u [{SCRIPT}]", "y [°C]"),
    "cell.csv": named("time", "=cmd|' /C calc'!A1", "y"),
}
"""Records that are odd but can be read: what they hold is text."""


@pytest.fixture
def visit(server: Server, browser: Browser) -> Iterator[Open]:
    """Yield a function that opens a page; nothing may complain or call away."""
    before = len(server.log.read_text())
    with watched(server, browser, DONE, "identify") as open_page:
        yield open_page
    assert server.faults() == []
    assert "Warning" not in server.log.read_text()[before:]


def unhurt(page: Page) -> None:
    """Check that no script of a file has run, and none of its pictures is there."""
    assert page.evaluate("window.hurt") is None
    expect(page.locator("img")).to_have_count(0)


def test_bad_records(visit: Open) -> None:
    """Each is explained with its place; ranking and record stay; a good one is read."""
    page = visit()
    alert = page.get_by_role("alert")
    before = ranking(page)
    for name, (data, words) in RECORDS.items():
        upload(page, data, name)
        expect(alert).to_contain_text(f"{name.rpartition('/')[2]}: ")
        expect(alert).to_contain_text(words)
        unhurt(page)
    page.evaluate(UNREAD)
    upload(page, b"0" * (LARGEST + 1), "large.csv")
    expect(alert).to_contain_text("up to 5 MB")  # though nothing was read
    unhurt(page)
    assert ranking(page) == before
    expect(page.locator("select[name=record]")).to_have_value('"gas_furnace"')


def test_odd_records(visit: Open) -> None:
    """Names and units that look like something else are shown as they are."""
    page = visit()
    for name, data in READ.items():
        upload(page, data, name)
        expect(page.locator(".text-lead")).to_contain_text(name)
        expect(page.locator(".wrong")).to_have_count(0)
        head = data.decode("utf-8-sig").split("\n")[0].split(",")[1]
        chosen = page.locator("input[name=inputs]:checked")
        expect(chosen).to_have_value(head.partition(" [")[0].strip())
        unhurt(page)
    page.get_by_role("button", name="Search").click()
    page.wait_for_function(f"nmssIdentify.finished > 0 && {DONE}", timeout=60_000)
    assert ranking(page)[0].startswith("[1 1 1]")
    unhurt(page)


# --- Designs --------------------------------------------------------------------------

EXAMPLE = case("wood_berry")
GOOD = dumps(EXAMPLE.designs["wang_young"])


def but(**fields: Any) -> bytes:
    """Return the good design with other fields."""
    document = json.loads(GOOD)
    document["content"].update(fields)
    return json.dumps(document).encode()


def array(shape: list[int], dtype: str = "float64") -> dict[str, Any]:
    """Return ones as they stand in a file; three of them whatever the shape."""
    return {"array": [1.0] * 3, "shape": shape, "dtype": dtype}


RECORD = Record([0.0, 1.0, 2.0], [[0.0], [1.0], [2.0]], [[0.0], [1.0], [1.0]])

LONG = Study(
    Design("wang_young", DifferenceModel([-0.9], [0.1])),
    None,
    Scenario(np.ones((100_000, 1))),
)

DESIGNS: dict[str, tuple[bytes, str]] = {
    "nothing.json": (b"", "not a JSON file"),
    "picture.json": (PICTURE, "not a JSON file"),
    "list.json": (b"[1, 2, 3]", 'it has no "nmss_lab" version'),
    "other.json": (b'{"name": "another program"}', 'it has no "nmss_lab" version'),
    "newer.json": (GOOD.replace('lab": 1', 'lab": 2', 1).encode(), "update NMSS Lab"),
    "half.json": (GOOD[: len(GOOD) // 2].encode(), "line 1, column"),
    "deep.json": (b"[" * 100_000, "nested more deeply"),
    "nan.json": (b'{"nmss_lab": NaN}', "NaN is no JSON"),
    "kind.json": (
        b'{"nmss_lab": 1, "content": {"kind": "os.system", "command": "ls"}}',
        "unknown kind 'os.system'",
    ),
    "part.json": (
        b'{"nmss_lab": 1, "content": {"kind": "Horizon", "Np": 3, "Nc": 1}}',
        "content is a Horizon",
    ),
    "record.json": (dumps(RECORD).encode(), "holds a record"),
    "shape.json": (but(Q=array([3])), "Q has shape (3,), expected"),
    "lies.json": (but(Q=array([2, 2])), "content.Q: not an array of numbers"),
    "object.json": (but(R=array([3], "object")), "dtype 'object', expected"),
    "words.json": (but(Q=SCRIPT), f"Q is the text {SCRIPT!r}, expected numbers"),
    "structure.json": (but(structure=SCRIPT), f'structure = "{SCRIPT}"'),
    "field.json": (but(extra=1), 'unknown field "extra"'),
    "horizon.json": (
        but(horizon={"kind": "Horizon", "Np": 10**9, "Nc": 1}),
        "Np = 1000000000 times",
    ),
    "backwards.json": (
        but(horizon={"kind": "Horizon", "Np": -3, "Nc": 1}),
        "Np = -3, Nc = 1",
    ),
    "long.json": (dumps(LONG).encode(), "open a shorter scenario"),
    f"{SCRIPT}.json": (b"{}", 'it has no "nmss_lab" version'),
}
"""Files that hold no design that can be used, and what has to be said."""


def test_bad_designs(visit: Open) -> None:
    """Each is explained; the run that is shown stays; a good one opens after all."""
    shown = "window.nmssPlayer?.frames > 0 && nmssForm.idle()"
    page = visit("receding_horizon?case=governor_3_4", until=shown)
    address, alert = page.url, page.get_by_role("alert")
    before = page.locator(".text-measures").inner_text()
    field = page.get_by_label("Design file")

    def give(name: str, data: bytes) -> None:
        field.set_input_files(
            {"name": name, "mimeType": "application/json", "buffer": data}
        )

    for name, (data, words) in DESIGNS.items():
        give(name, data)
        expect(alert).to_contain_text(f"{name}: ")
        expect(alert).to_contain_text(words)
        unhurt(page)
    give("long.json", dumps(LONG).encode())
    stop = page.get_by_role("button", name="Stop opening")
    stop.click()
    expect(alert).to_contain_text("long.json: given up")
    expect(stop).to_be_hidden()
    page.evaluate(UNREAD)
    give("large.json", b" " * (bar.LARGEST + 1))
    expect(alert).to_contain_text("up to 2 MB")  # though nothing was read
    unhurt(page)
    assert page.url == address
    assert page.locator(".text-measures").inner_text() == before
    page.reload()
    page.wait_for_function(shown, timeout=3 * PATIENCE)
    study = Study(EXAMPLE.designs["wang_young"], EXAMPLE.plant, EXAMPLE.scenario)
    give("good.json", dumps(study).encode())
    page.wait_for_url("**/receding_horizon?case=opened-*")
    page.wait_for_function(shown, timeout=3 * PATIENCE)
    expect(page.locator(".wrong")).to_have_count(0)
