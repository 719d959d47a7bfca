"""Identify: from a record to a ranking of models, compared and sent on."""

from __future__ import annotations

import base64
import binascii
import html
import math
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import panel as pn
import param
from bokeh.models import BoxAnnotation, Range1d
from panel.custom import JSComponent

from apps.identification import (
    LARGEST,
    LOOK,
    RECORDS,
    Given,
    IdentifyChoices,
    Spans,
    uploaded,
)
from apps.pages.background import BackgroundPage, Work
from apps.pages.bar import WithBar
from apps.pages.live import (
    ADDRESS,
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
from apps.session import HELD, case_title, held, held_as, keep_model
from nmss_lab.files import Study, dumps
from nmss_lab.identify import Candidate, Estimate
from nmss_lab.plots import Chart, EstimateFigure, estimate_charts, record_charts
from nmss_lab.records import Record

PATH, HEADING = "identify", "Identify"

PARTS = (
    *("bar", "lead", "alert", "ranking"),
    *("measures", "python", "upload", "controls"),
)

SEARCHES = ThreadPoolExecutor(max_workers=2, thread_name_prefix="search")
"""Searches of all sessions compute here; more of them wait, and the pages do not."""

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

    On top of it stand ``held``, the models of designs that are held; those which are
    ticked are told to the form by the event "nmss-choose".  ``sent`` goes to the
    server: what to do ("act") and with which rows.  ``saved`` is a file for the browser
    to keep, ``leads`` an address for it to open.
    """

    rows = param.List(default=[])
    held = param.List(default=[])
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
        self.spans: Spans | None = None
        self.held: dict[str, Given] = {}
        self.work: Work | None = None
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
        self._weigh()
        self._choose([])
        if self.document is not None:
            self._ends_with_its_page()
            pn.state.onload(self._begin)

    def call_off(self) -> None:
        """Have the search stop after the fit that is being made."""
        if self.work is not None:
            self.work.call_off()

    # From the form and the plot

    def _take(self, event: Any) -> None:
        """Take over what the form sent, show, and answer."""
        sent = dict(event.new)
        message, record = sent.pop("message", 0), self.choices.record
        before, seen, beside = self.choices._of_record(), self._seen, self._beside
        self._guard(lambda: self._accept(sent), self.choices.values())
        fresh = self.choices._of_record() != before
        if fresh:
            self._forget()
            if self.choices.record != "file":
                self._begin()
        elif self._beside != beside or (self._seen != seen and self.spans is None):
            self._weigh()
            self._choose(self.chosen)
        elif self._seen != seen or self.complaint:
            self._draw_record()
        if fresh or record != self.choices.record:
            self.controls.form = self._form()
        self._tell()
        self.ranking.progress = self._progress(0)
        self.controls.state = self._state(message)

    @property
    def _seen(self) -> tuple[Any, ...]:
        """Choices that the plot of the record depends on."""
        choices = self.choices
        spans = (getattr(choices, key) for key in choices.spans)
        return (*choices._of_record(), choices.detrend, choices.start, *spans)

    @property
    def _beside(self) -> tuple[Any, ...]:
        """What is held, and which of it is drawn."""
        return (*(getattr(self.choices, key) for key in HELD), *self.choices.beside)

    @property
    def _asked(self) -> tuple[Any, ...]:
        """All choices that a ranking is asked for with."""
        values = self.choices.values().items()
        return tuple(repr(v) for key, v in values if key not in (*HELD, "beside"))

    def _take_file(self, event: Any) -> None:
        """Take over an uploaded file, or say what is wrong with it."""
        sent = dict(event.new)
        if self._guard(lambda: self._open(sent), sent.get("name")):
            self._forget()
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
                if self.spans is None:
                    self._weigh()
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
        self.hint = ""
        try:
            job, spans = self.choices.search(), self.choices.compared_on
        except ValueError as error:
            self.complaint = str(error)
            self._tell()
            return
        self.call_off()
        self.work = work = Work()
        self.searched, self.total = self._asked, self.choices.tries
        self.note = "Waiting for its turn"
        self.ranking.progress = self._progress(0)
        self._in_thread(
            work,
            lambda: self._search(work, job, spans),
            lambda problem: self._ended(work, problem),
            SEARCHES,
        )

    def _search(
        self, work: Work, job: Callable[..., list[Candidate]], spans: Spans
    ) -> None:
        """Search, in a thread; what was fitted until it is called off counts."""
        told = 0.0

        def progress(done: int, total: int) -> bool:
            nonlocal told
            if time.monotonic() - told > TOLD_EVERY:
                told = time.monotonic()
                self._later(lambda: self._counted(work, done))
            time.sleep(0)  # let the other sessions in
            return work.stop.is_set()

        found = job(progress=progress)
        rows = [_row(i, c, spans.checked) for i, c in enumerate(found)]
        self._later(lambda: self._found(work, found, rows, spans))

    def _counted(self, work: Work, done: int) -> None:
        if work is self.work:
            self.note = f"{done} of {self.total}"
            self.ranking.progress = self._progress(done)

    def _found(
        self, work: Work, found: list[Candidate], rows: list[Any], spans: Spans
    ) -> None:
        """Take over what was fitted, and draw the best of it."""
        if work is not self.work:
            return
        self.found, self.spans, self.ranking.rows = found, spans, rows
        good = [row["id"] for row in rows if row["usable"]]
        word = "Cancelled: " if work.stop.is_set() else ""
        self.note = f"{word}{len(rows)} fitted, {len(good)} to be trusted"
        none = f"No structure gave a model to trust: {rows[0]['problem']}"
        self.complaint = "" if good else none
        self._weigh()
        self._choose(good[:1])
        self.work = None
        self._later(self._rest)  # after the pictures

    def _ended(self, work: Work, problem: str) -> None:
        """Say why a search ended that found nothing."""
        if work is not self.work:
            return
        self.work, self.complaint = None, problem or self.complaint
        self.note = "Cancelled before the first fit" if work.stop.is_set() else ""
        self._tell()
        self._rest()

    def _rest(self) -> None:
        self.ranking.progress = self._progress(0)

    def _weigh(self) -> None:
        """Simulate held models on what the ranking was found on, or would be."""
        choices = self.choices
        spans = self.spans or choices.compared_on
        with np.errstate(all="ignore"):
            self.held = choices.given(spans)
            self.ranking.held = [
                {
                    "id": key,
                    "orders": f"design {key}",
                    "words": _words(getattr(choices, key)),
                    "problem": choices.misfit(getattr(choices, key)),
                    **_figures_of(self.held.get(key), spans.checked),
                }
                for key in HELD
                if getattr(choices, key)
            ]

    @property
    def _drawn(self) -> list[str]:
        """Held designs whose models are drawn."""
        return [key for key in self.held if key in self.choices.beside]

    def _choose(self, chosen: Any) -> None:
        """Draw rows of the ranking, as many as there is room for beside held ones."""
        usable = {row["id"] for row in self.ranking.rows if row["usable"]}
        room = MOST_COMPARED - len(self._drawn)
        self.chosen = [i for i in chosen if i in usable][:room]
        self.ranking.chosen = [*self.chosen, *self._drawn]
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
        self.work, self.note = None, ""
        self.found, self.spans, self.ranking.rows = [], None, []
        self._weigh()
        self._choose([])
        self.hint = "Nothing searched yet. Choose columns and spans, then search."

    # To the page

    @property
    def compared(self) -> dict[str, Estimate]:
        """Estimates of the rows chosen, by their orders."""
        rows = (self.found[i] for i in self.chosen)
        return {str(c.orders): c.estimate for c in rows if c.estimate is not None}

    @property
    def shown(self) -> dict[str, Estimate]:
        """All that is drawn: rows chosen, then what is held."""
        return {**self.compared, **{f"design {k}": self.held[k] for k in self._drawn}}

    def _charts(self) -> list[Chart]:
        return [*self._record_charts(), *estimate_charts(self.shown)]

    def _record_charts(self) -> list[Chart]:
        checked = self.choices.checked if self.shown else None
        return record_charts(self.choices.treated, self.shown, checked)

    def _draw_record(self) -> None:
        with np.errstate(all="ignore"):
            self._paint(self._record_charts())

    def _paint(self, charts: list[Chart]) -> None:
        """Draw charts; once they are served, figures change on the event loop only."""

        def paint() -> None:
            for chart in charts:
                self.figures[chart.name].show(chart)
            self._place()

        self._painted(paint)

    def _show(self) -> None:
        """Draw the record and what is chosen, and say what that is."""
        with np.errstate(all="ignore"):
            self._paint(self._charts())
            self.measures.object = _parameters(self.shown)
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
        drawn = {key: self.held[key] for key in self._drawn}
        self.python.object = _code(choices.script(orders, drawn))
        self.bar.told = self._loaded()

    # What the bar has of this page: models, and the design that each begins with

    def _subject(self) -> str:
        return RECORDS[self.choices.record]

    def _shown_designs(self) -> list[str]:
        return [*self.compared, *self._drawn]

    def _design_named(self, name: str) -> str:
        return super()._design_named(name) if name in HELD else f"model {name}"

    def _files(self) -> Mapping[str, str]:
        return {"save": "File of {}"}

    def _address(self, name: str) -> str:
        return held_as("case", keep_model(self.compared[name]), "wang_young")

    def _without(self, which: str) -> dict[str, Any]:
        beside = [key for key in self.choices.beside if key != which]
        return {which: "", "beside": beside}

    def _side_by_side(self) -> dict[str, Any]:
        self._choose(self.chosen[:1])
        return {"beside": list(self.choices.fitting())}

    def _save_design(self, name: str) -> None:
        if name in HELD:
            super()._save_design(name)
            return
        text = dumps(self.compared[name])
        hand_over(self.bar, "saved", name="model.json", text=text)

    def _study(self, name: str) -> Study:
        found = held(getattr(self.choices, name))
        return found.choices.study_of(found.name)

    def _progress(self, done: int) -> dict[str, Any]:
        running = self.work is not None
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


def _row(number: int, candidate: Candidate, checked: Record) -> dict[str, Any]:
    """One line of the ranking as plain data."""
    found, row = candidate.estimate, candidate.row
    good = found if found is not None and found.is_good else None
    return {
        "id": number,
        "orders": row["orders"],
        "problem": row["problem"],
        **_figures_of(good, checked),
        **{key: _plain(row[key]) for key in ("yic", "bic", "r2_t")},
    }


def _figures_of(found: Estimate | None, checked: Record) -> dict[str, Any]:
    """How well a model fits both spans, and whether there is one."""
    fits = (math.nan,) * 2
    if found is not None:
        fits = found.r2_t, found.validate(checked, "estimate")
    r2_t, beyond = map(_plain, fits)
    return {"usable": found is not None, "r2_t": r2_t, "checked": beyond}


def _plain(value: float) -> float | None:
    """Value for the browser; no number is None."""
    return float(value) if np.isfinite(value) else None


def _words(text: str) -> str:
    """Say what a held design is."""
    found = held(text)
    return f"{found.words}, of {case_title(found.choices.example)}"


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
    if any(isinstance(found, Given) for found in compared.values()):
        caption += "; of the model of a design none is known"
    return (
        f'<p class="quiet small">{caption}</p><table><thead><tr><th>Value</th>{head}'
        f"</tr></thead><tbody>{body}</tbody></table>"
    )


def _values(found: Estimate) -> dict[str, str]:
    errors = zip(found.parameters, found.standard_errors, strict=True)
    pairs = dict(zip(found.names, errors, strict=True)) | found.derived()
    shown = {
        f"{name}{_unit_of(name)}": _with_error(value, error, isinstance(found, Given))
        for name, (value, error) in pairs.items()
    }
    inputs = (*found.record.names["u"], *found.record.names["v"])
    for name, delay in zip(inputs, found.orders.nk, strict=True):
        seconds = _number(delay * found.record.dt)
        shown[f"delay of {name}"] = f"{delay} samples, {seconds} s"
    return shown


def _with_error(value: float, error: float, alone: bool) -> str:
    return _number(value) + ("" if alone else f" \u00b1 {_number_short(error)}")


def _unit_of(name: str) -> str:
    if name.startswith("time constant"):
        return " [s]"
    return " [rad/s]" if name.startswith("natural frequency") else ""


def _number_short(value: float) -> str:
    return f"{value:.2g}" if math.isfinite(value) else "\u2013"


def page() -> pn.Template:
    """Build the page for a new session."""
    return IdentifyPage().template()


__all__ = ["ADDRESS", "RECORDS", "IdentifyPage", "page"]
