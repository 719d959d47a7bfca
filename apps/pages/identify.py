"""Identify: from a record to a ranking of models, compared and sent on."""

from __future__ import annotations

import base64
import binascii
import html
import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np
import panel as pn
import param
from bokeh.models import BoxAnnotation, Range1d
from panel.custom import JSComponent

from apps.identification import LARGEST, LOOK, RECORDS, IdentifyChoices, uploaded
from apps.pages.background import BackgroundPage
from apps.pages.bar import WithBar
from apps.pages.live import (
    ADDRESS,
    FAULT,
    _code,
    _complaint,
    _from_address,
    _number,
    _paragraph,
    _text,
    fill,
    page_template,
)
from apps.player import STYLE, Controls, hand_over, script
from apps.session import held_as, keep_model
from apps.work import ends_with_the_server
from nmss_lab.files import dumps
from nmss_lab.identify import Candidate, Estimate
from nmss_lab.plots import Chart, EstimateFigure, estimate_charts, record_charts

LOG = logging.getLogger(__name__)
PATH, HEADING = "identify", "Identify"

PARTS = (
    *("bar", "lead", "alert", "ranking"),
    *("measures", "python", "upload", "controls"),
)

WORKERS = ThreadPoolExecutor(max_workers=2, thread_name_prefix="search")
"""Searches of all sessions; more of them wait."""

TOLD_EVERY = 0.1
"""Seconds between messages of progress."""

MOST_COMPARED = 3
SPANS = {"est": "#0072B2", "val": "#E69F00"}


class Upload(JSComponent):
    """A button that takes a file: its name, size and content in base64."""

    sent = param.Dict(default={})
    answered = param.Integer(default=0)
    most = param.Integer(default=LARGEST)

    _esm = script("upload.js")
    _stylesheets = (STYLE,)


class Ranking(JSComponent):
    """Button and progress of a search, and a table of its rows to choose from.

    ``sent`` goes to the server: what to do ("act") and with which rows.  ``saved`` is
    a file for the browser to keep, ``leads`` an address for it to open.
    """

    rows = param.List(default=[])
    chosen = param.List(default=[])
    progress = param.Dict(default={})
    figures = param.Integer(default=0)
    sent = param.Dict(default={})
    saved = param.Dict(default={})
    leads = param.Dict(default={})

    _esm = script("ranking.js")
    _stylesheets = (STYLE,)


class WithRecord:
    """A page whose choices begin with a record, shipped or uploaded."""

    choices: Any

    def _accept(self, sent: dict[str, Any]) -> None:
        """Take over what the form sent: all anew, another record, or choices."""
        if sent.pop("whole", False):
            self.choices.accept(sent)
        elif sent.pop("reset", False):
            self.choices.take_record("gas_furnace")
        elif sent.get("record") != self.choices.record:
            self.choices.accept({"record": sent.get("record")})
        else:
            self.choices.accept(sent)

    def _open(self, sent: Mapping[str, Any]) -> None:
        """Take over an uploaded file."""
        try:
            data = base64.b64decode(str(sent["data"]), validate=True)
        except binascii.Error as error:
            raise ValueError("the file did not arrive whole: try again") from error
        size = max(int(sent["size"]), len(data))
        self.choices.take_file(uploaded(str(sent["name"]), data, size))


class IdentifyPage(WithRecord, WithBar, BackgroundPage):
    """One session's page: keeps the last good record and ranking."""

    def __init__(self) -> None:
        super().__init__()
        self.choices = IdentifyChoices()
        self.complaint = _from_address(self.choices)  # type: ignore[arg-type]
        self.found: list[Candidate] = []
        self.chosen: list[int] = []
        self.stop = threading.Event()
        self.search: Future[None] | None = None
        self.hint = self.note = ""
        self.searched: tuple[Any, ...] = ()
        self.total = 0
        self.lead, self.alert, self.measures, self.python = (
            _text(name) for name in ("lead", "alert", "measures", "python")
        )
        self.figures = _figures(self._charts())
        self.boxes = {name: _box(name, color) for name, color in SPANS.items()}
        self._placing = False
        for name, box in self.boxes.items():
            self.figures["output"].figure.add_layout(box)
            box.on_change("left", self._dragged(name))
            box.on_change("right", self._dragged(name))
        self.upload = Upload(sizing_mode="stretch_width")
        self.upload.param.watch(self._take_file, "sent")
        self.controls = Controls(
            form=self._form(), state=self._state(0), sizing_mode="stretch_width"
        )
        self.ranking = Ranking(
            progress=self._progress(0),
            figures=len(self.figures),
            sizing_mode="stretch_width",
        )
        self.ranking.param.watch(self._act, "sent")
        self._make_bar()
        self._tell()
        self._show()
        if self.document is not None:
            ends_with_the_server(self, self.document)
            pn.state.onload(self._begin)

    def call_off(self) -> None:
        """Have the search stop after the fit that is being made."""
        self.stop.set()

    # From the form and the plot

    def _take(self, event: Any) -> None:
        """Take over what the form sent, show, and answer."""
        sent = dict(event.new)
        message, record = sent.pop("message", 0), self.choices.record
        before, seen = self.choices._of_record(), self._seen
        self._guard(lambda: self._accept(sent), self.choices.values())
        fresh = self.choices._of_record() != before
        if fresh:
            self._forget()
            self._show()
            if self.choices.record != "file":
                self._begin()
        if fresh or record != self.choices.record:
            self.controls.form = self._form()
        if self._seen != seen or self.complaint:
            self._draw_record()
        self._tell()
        self.ranking.progress = self._progress(0)
        self.controls.state = self._state(message)

    @property
    def _seen(self) -> tuple[Any, ...]:
        """Choices that the plot of the record depends on."""
        choices = self.choices
        spans = (getattr(choices, key) for key in choices.spans)
        return (*choices._of_record(), choices.detrend, *spans)

    @property
    def _asked(self) -> tuple[Any, ...]:
        """All choices: what a ranking was asked for with."""
        return tuple(repr(value) for value in self.choices.values().values())

    def _take_file(self, event: Any) -> None:
        """Take over an uploaded file, or say what is wrong with it."""
        sent = dict(event.new)
        if self._guard(lambda: self._open(sent), sent.get("name")):
            self._forget()
            self._show()
        elif self.complaint:
            self.complaint = f"{str(sent.get('name'))[:80]}: {self.complaint}"
        self._tell()
        self.ranking.progress = self._progress(0)
        self.controls.form = self._form()
        self.controls.state = self._state(0)
        self.upload.answered += 1

    def _dragged(self, name: str) -> Callable[[str, Any, Any], None]:
        """Return what takes over the span of a box that was moved."""

        def moved(attribute: str, old: Any, new: Any) -> None:
            if self._placing:
                return
            box, t = self.boxes[name], self.choices.whole.time
            ends = float(t[0]), float(t[-1]) + self.choices.whole.dt
            left, right = (float(np.clip(x, *ends)) for x in (box.left, box.right))
            if right > left:
                values = {f"{name}_from": left, f"{name}_to": right}
                self._guard(lambda: self.choices.accept(values), values)
                self._tell()
                self.ranking.progress = self._progress(0)
                self.controls.state = self._state(1_000_000_000)

        return moved

    # The search

    def _act(self, event: Any) -> None:
        """Do what the ranking asks for."""
        sent = dict(event.new)
        act = sent.get("act")
        if act == "search":
            self._begin()
        elif act == "cancel":
            self.call_off()
        elif act == "choose":
            self._choose(sent.get("chosen", []))
        elif act in ("control", "govern", "save"):
            self._guard(lambda: self._give(act, sent.get("id")), sent)
            self._tell()

    def _begin(self) -> None:
        """Start a search off the event loop; an older one is called off."""
        self.call_off()
        self.stop = stop = threading.Event()
        self.hint = ""
        try:
            job, checked = self.choices.search(), self.choices.checked
        except ValueError as error:
            self.complaint = str(error)
            self._tell()
            return
        self.searched, self.total = self._asked, self.choices.tries
        self.note = "Waiting for its turn"
        self.search = WORKERS.submit(self._work, stop, job, checked)
        self.ranking.progress = self._progress(0)

    def _work(
        self,
        stop: threading.Event,
        job: Callable[..., list[Candidate]],
        checked: Any,
    ) -> None:
        """Search, in a thread of its own; what it says is said on the event loop."""
        told = 0.0

        def progress(done: int, total: int) -> bool:
            nonlocal told
            if time.monotonic() - told > TOLD_EVERY:
                told = time.monotonic()
                self._later(lambda: self._counted(stop, done))
            time.sleep(0)  # let the other sessions in
            return stop.is_set()

        try:
            found = [] if stop.is_set() else job(progress=progress)
            rows = [_row(i, c, checked) for i, c in enumerate(found)]
        except ValueError as error:
            text = str(error)
            self._later(lambda: self._failed(stop, text))
        except Exception:
            LOG.exception("search %s", self.choices.values())
            self._later(lambda: self._failed(stop, FAULT))
        else:
            self._later(lambda: self._finished(stop, found, rows))

    def _counted(self, stop: threading.Event, done: int) -> None:
        if stop is self.stop and self.search is not None:
            self.note = f"{done} of {self.total}"
            self.ranking.progress = self._progress(done)

    def _failed(self, stop: threading.Event, text: str) -> None:
        if stop is not self.stop:
            return
        self.search, self.complaint = None, text
        self.note = ""
        self._tell()
        self.ranking.progress = self._progress(0)

    def _finished(
        self, stop: threading.Event, found: list[Candidate], rows: list[Any]
    ) -> None:
        if stop is not self.stop:
            return
        self.search = None
        if stop.is_set() and not found:
            self.note = "Cancelled before the first fit"
        else:
            self.found, self.ranking.rows = found, rows
            good = sum(row["usable"] for row in rows)
            word = "Cancelled: " if stop.is_set() else ""
            self.note = f"{word}{len(rows)} fitted, {good} to be trusted"
            self._choose([row["id"] for row in rows if row["usable"]][:1])
        self.complaint = "" if rows else self.complaint
        if rows and not any(row["usable"] for row in rows):
            self.complaint = f"No structure gave a model to trust: {rows[0]['problem']}"
        self._tell()
        self._later(self._rest)  # after the pictures

    def _rest(self) -> None:
        self.ranking.progress = self._progress(0)

    def _choose(self, chosen: Any) -> None:
        usable = {row["id"] for row in self.ranking.rows if row["usable"]}
        self.chosen = [i for i in chosen if i in usable][:MOST_COMPARED]
        self.ranking.chosen = list(self.chosen)
        self._show()

    def _give(self, act: str, which: Any) -> None:
        """Send a model to another page, or to the browser as a file."""
        if which not in self.chosen:
            raise ValueError("choose a row of the ranking first")
        found = self.found[which].estimate
        assert found is not None
        if act == "save":
            hand_over(self.ranking, "saved", name="model.json", text=dumps(found))
        else:
            page = {"control": "receding_horizon", "govern": "governor"}[act]
            to = f"{page}?case={keep_model(found)}"
            hand_over(self.ranking, "leads", to=to)

    def _forget(self) -> None:
        """Drop the ranking of another record."""
        self.call_off()
        self.stop = threading.Event()
        self.search, self.note = None, ""
        self.found, self.chosen = [], []
        self.ranking.rows, self.ranking.chosen = [], []
        self.hint = "Nothing searched yet. Choose columns and spans, then search."

    # To the page

    @property
    def compared(self) -> dict[str, Estimate]:
        """Estimates of the rows chosen, by their orders."""
        rows = (self.found[i] for i in self.chosen)
        return {str(c.orders): c.estimate for c in rows if c.estimate is not None}

    def _charts(self) -> list[Chart]:
        checked = self.choices.checked if self.chosen else None
        charts = record_charts(self.choices.treated, self.compared, checked)
        return [*charts, *estimate_charts(self.compared)]

    def _draw_record(self) -> None:
        checked = self.choices.checked if self.chosen else None
        self._paint(record_charts(self.choices.treated, self.compared, checked))

    def _paint(self, charts: list[Chart]) -> None:
        """Draw charts; once they are served, figures change on the event loop only."""

        def paint() -> None:
            for chart in charts:
                self.figures[chart.name].show(chart)
            self._place()

        self._painted(paint)

    def _show(self) -> None:
        """Draw the record and the rows chosen, and say what they are."""
        with np.errstate(all="ignore"):
            self._paint(self._charts())
        self.measures.object = _parameters(self.compared)
        self._tell()

    def _place(self) -> None:
        """Put the boxes where the spans are: estimation below, validation above."""
        y = self.figures["output"].figure.y_range
        middle = (y.start + y.end) / 2.0
        halves = {"est": (y.start, middle), "val": (middle, y.end)}
        self._placing = True
        for name, (bottom, top) in halves.items():
            left, right = (getattr(self.choices, f"{name}_{e}") for e in ("from", "to"))
            self.boxes[name].update(left=left, right=right, bottom=bottom, top=top)
        self._placing = False

    def _tell(self) -> None:
        """Words around the plots."""
        choices = self.choices
        name = f"{choices.file.name}: " if choices.record == "file" else ""
        notes = "".join(f"Note: {note}." for note in choices.whole.notes)
        words = f"{name}{LOOK[choices.record]} {notes}".strip()
        self.lead.object = _paragraph(words)
        self.alert.object = _complaint(self.complaint)
        orders = next(iter(self.compared), "")
        self.python.object = _code(choices.script(orders))
        self.bar.told = self._loaded()

    # What the bar has of this page: models, and the design that each begins with

    def _subject(self) -> str:
        return RECORDS[self.choices.record]

    def _shown_designs(self) -> list[str]:
        return list(self.compared)

    def _design_named(self, name: str) -> str:
        return f"model {name}"

    def _files(self) -> Mapping[str, str]:
        return {"save": "File of {}"}

    def _address(self, name: str) -> str:
        return held_as("case", keep_model(self.compared[name]), "wang_young")

    def _without(self, which: str) -> dict[str, Any]:
        return {which: ""}

    def _save_design(self, name: str) -> None:
        text = dumps(self.compared[name])
        hand_over(self.bar, "saved", name="model.json", text=text)

    def _progress(self, done: int) -> dict[str, Any]:
        running = self.search is not None
        stale = bool(self.found) and not running and self.searched != self._asked
        return {
            "running": running,
            "done": done,
            "total": self.total if running else self.choices.tries,
            "note": f"{self.note}, with earlier choices" if stale else self.note,
            "hint": self.hint,
        }

    def _form(self) -> dict[str, Any]:
        choices = self.choices
        return {"groups": choices.description(), "defaults": choices.defaults()}

    def _state(self, message: int) -> dict[str, Any]:
        return {"values": self.choices.values(), "message": message}

    def template(self) -> pn.Template:
        """Put the page together."""
        page = page_template(PATH, HEADING, list(self.figures))
        fill(page, self, PARTS, self.figures)
        self.served = True
        return page


def _figures(charts: list[Chart]) -> dict[str, EstimateFigure]:
    times = Range1d(*charts[0].span)
    shared = {"output": times, "signal": times}
    return {c.name: EstimateFigure(c, shared.get(c.name)) for c in charts}


def _box(name: str, color: str) -> BoxAnnotation:
    return BoxAnnotation(
        name=f"span-{name}",
        editable=True,
        resizable="x",
        movable="x",
        symmetric=False,
        fill_color=color,
        fill_alpha=0.13,
        line_color=color,
        line_alpha=0.7,
        hover_fill_color=color,
        hover_fill_alpha=0.22,
        hover_line_color=color,
        level="underlay",
    )


def _row(number: int, candidate: Candidate, checked: Any) -> dict[str, Any]:
    """One line of the ranking as plain data; no number is None."""
    found, row = candidate.estimate, candidate.row
    beyond = math.nan
    if found is not None and found.is_good:
        beyond = found.validate(checked, "estimate")
    numbers = {**{key: row[key] for key in ("yic", "bic", "r2_t")}, "checked": beyond}
    return {
        "id": number,
        "orders": row["orders"],
        "problem": row["problem"],
        "usable": found is not None and found.is_good,
        **{k: float(v) if np.isfinite(v) else None for k, v in numbers.items()},
    }


def _parameters(compared: Mapping[str, Estimate]) -> str:
    """Parameters, gains, time constants and delays, each with its standard error."""
    if not compared:
        return '<p class="quiet">No row of the ranking is chosen.</p>'
    columns = [_values(found) for found in compared.values()]
    names = list(dict.fromkeys(name for column in columns for name in column))
    head = "".join(
        f'<th><span class="swatch style{i}"></span>{html.escape(name)}</th>'
        for i, name in enumerate(compared)
    )
    body = "".join(
        f'<tr><th scope="row">{html.escape(name)}</th>'
        + "".join(f"<td>{column.get(name, chr(0x2013))}</td>" for column in columns)
        + "</tr>"
        for name in names
    )
    caption = "Parameters and what follows from them, \u00b1 one standard error from P*"
    return (
        f'<p class="quiet small">{caption}</p><table><thead><tr><th>Value</th>{head}'
        f"</tr></thead><tbody>{body}</tbody></table>"
    )


def _values(found: Estimate) -> dict[str, str]:
    errors = zip(found.parameters, found.standard_errors, strict=True)
    pairs = dict(zip(found.names, errors, strict=True)) | found.derived()
    shown = {
        f"{name}{_unit_of(name)}": f"{_number(value)} \u00b1 {_number_short(error)}"
        for name, (value, error) in pairs.items()
    }
    inputs = (*found.record.names["u"], *found.record.names["v"])
    for name, delay in zip(inputs, found.orders.nk, strict=True):
        seconds = _number(delay * found.record.dt)
        shown[f"delay of {name}"] = f"{delay} samples, {seconds} s"
    return shown


def _unit_of(name: str) -> str:
    if name.startswith("time constant"):
        return " [s]"
    return " [rad/s]" if name.startswith("natural frequency") else ""


def _number_short(value: float) -> str:
    return f"{value:.2g}" if math.isfinite(value) else "\u2013"


def page() -> pn.Template:
    """Build the page for a new session."""
    made = IdentifyPage()
    if pn.state.curdoc is not None:
        pn.state.on_session_destroyed(lambda _: made.call_off())
    return made.template()


__all__ = ["ADDRESS", "RECORDS", "IdentifyPage", "page"]
