"""What the live pages share: choices in, runs computed, figures and tables shown."""

from __future__ import annotations

import html
import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jinja2
import panel as pn
from bokeh.models import Range1d

from apps.player import INSIDE, Controls, Player, moving, stepping
from apps.session import Choices, plain
from nmss_lab.measures import table
from nmss_lab.plots import Chart, ChartFigure, busiest_sample, time_unit
from nmss_lab.simulate import Run

LOG = logging.getLogger(__name__)
HERE = Path(__file__).resolve().parent.parent
PAGES = (
    ("receding_horizon", "Receding horizon"),
    ("governor", "Reference governor"),
    ("identify", "Identify"),
    ("tune", "Tune"),
    ("state_dependent", "State-dependent"),
    ("robustness", "Robustness"),
)

PARTS = "lead", "alert", "player", "measures", "python", "notes", "controls"

ADDRESS = "In the address of this page: "
FAULT = "These choices met a fault in the program; it has been logged."
KEPT = "The picture still shows the last choices that worked."

COLUMNS = {
    "rise": "Rise [{time}]",
    "settling": "Settling [{time}]",
    "overshoot": "Overshoot [%]",
    "IAE": "IAE",
    "coupling": "Coupling",
    "RMS du": "RMS of du",
    "violations": "Limits broken",
}
IN_TIME = "rise", "settling"


@dataclass(frozen=True)
class Subject:
    """What makes one page: its choices, its charts, and words about each case.

    Parameters
    ----------
    path, heading : str
    choices : type of Choices
    charts : function of (runs, output, input)
    look : mapping from a case to one sentence: what to look at
    inside : function of choices, optional
        Charts of one sample from within, and words for each of their steps.
    """

    path: str
    heading: str
    choices: type[Choices]
    charts: Callable[[Mapping[str, Run], int, int], list[Chart]]
    look: Mapping[str, str]
    inside: Callable[[Any], tuple[list[Chart], list[Any]]] | None = None


class WithForm:
    """A page whose form is described anew whenever its choices become others."""

    choices: Any
    _forms = 0

    def _form(self) -> dict[str, Any]:
        choices = self.choices
        self._forms += 1
        return {
            "groups": choices.description(),
            "defaults": choices.defaults(),
            "number": self._forms,
        }

    def _state(self, message: int) -> dict[str, Any]:
        """Values for the latest form, which the browser waits for."""
        values = self.choices.values()
        return {"values": values, "message": message, "form": self._forms}

    def _accept(self, sent: Mapping[str, Any]) -> None:
        """Take over what the form sent: all anew, another case, or choices."""
        if sent.get("reset", False):
            self.choices.take_case(self.choices.default_case)
        elif sent.get("case") != self.choices.case:
            self.choices.accept({"case": sent.get("case")})
        else:
            self.choices.accept(sent)


class LivePage(WithForm):
    """One session's page: keeps the last good picture whatever is chosen."""

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.choices = subject.choices()
        self.complaint = _from_address(self.choices)
        self.lead, self.alert, self.measures, self.python, self.notes = (
            _text(name) for name in ("lead", "alert", "measures", "python", "notes")
        )
        self.runs, charts = self._first_picture()
        times = Range1d(*charts[0].span)
        self.figures = {chart.name: ChartFigure(chart, times) for chart in charts}
        start = busiest_sample(self.runs)
        self.player = Player(
            run=moving(charts, self._named(), start, True), sizing_mode="stretch_width"
        )
        self.within: dict[str, ChartFigure] = {}
        self.inside = self._first_inside()
        self.controls = Controls(
            form=self._form(), state=self._state(0), sizing_mode="stretch_width"
        )
        self.controls.param.watch(self._take, "sent")
        self._tell()
        self._measure()

    def _first_picture(self) -> tuple[dict[str, Run], list[Chart]]:
        """Run the choices of the address, or the case as it is if they cannot be."""
        try:
            return self._compute()
        except ValueError as error:
            self.complaint = self.complaint or f"{ADDRESS}{error}"
            self.choices.take_case(self.choices.case)
            return self._compute()

    def _first_inside(self) -> Player | None:
        """Figures and player of one sample from within, where the page has them."""
        if self.subject.inside is None:
            return None
        charts, words = self.subject.inside(self.choices)
        over = Range1d(*charts[0].span), Range1d(*charts[-1].span)
        self.within = {
            chart.name: ChartFigure(chart, over[int(chart.origin is not None)])
            for chart in charts
        }
        steps = stepping(charts, words)
        return Player(run=steps, place=INSIDE, sizing_mode="stretch_width")

    def _look_inside(self) -> None:
        """Show the chosen sample from within."""
        if self.inside is not None and self.subject.inside is not None:
            self.inside.run = stepping(*self.subject.inside(self.choices))

    def _compute(self) -> tuple[dict[str, Run], list[Chart]]:
        runs = self.choices.runs()
        named = {plain(name): run for name, run in runs.items()}
        shown = self.choices.output, self.choices.input
        return runs, self.subject.charts(named, *shown)

    def _named(self) -> dict[str, Run]:
        return {plain(name): run for name, run in self.runs.items()}

    def _take(self, event: Any) -> None:
        """Take over what the form sent, compute, show, and answer."""
        sent = dict(event.new)
        message, case = sent.pop("message", 0), self.choices.case
        try:
            self._accept(sent)
            self.runs, charts = self._compute()
            self._look_inside()
            self.complaint = ""
        except ValueError as error:
            self.complaint, charts = f"{error}\n{KEPT}", []
        except Exception:  # the form waits for an answer, whatever happens
            LOG.exception("choices %s", self.choices.values())
            self.complaint, charts = f"{FAULT}\n{KEPT}", []
        fresh = self.choices.case != case
        if charts:
            start = busiest_sample(self.runs)
            self.player.run = moving(charts, self._named(), start, fresh)
        if fresh:
            self.controls.form = self._form()
        self._tell()
        if charts:
            self._measure()
        self.controls.state = self._state(message)

    def _tell(self) -> None:
        """Words around the plots."""
        example, look = self.choices.example, self.subject.look
        self.lead.object = _paragraph(look.get(example.name, example.title + "."))
        self.alert.object = _complaint(self.complaint)
        notes = "".join(f"<li>{html.escape(note)}</li>" for note in example.notes)
        source = html.escape(f"Section {example.section}. {example.source}.")
        self.notes.object = f"<p>{source}</p><ul>{notes}</ul>"

    def _measure(self) -> None:
        """Show table and Python of the runs."""
        self.measures.object = _measures(self._named(), self.choices.output)
        self.python.object = f"<pre>{html.escape(self.choices.script())}</pre>"

    def template(self) -> pn.Template:
        """Put the page together."""
        subject = self.subject
        page = page_template(subject.path, subject.heading, list(self.figures))
        page.add_variable("within", list(self.within))
        fill(page, self, PARTS, {**self.figures, **self.within})
        if self.inside is not None:
            page.add_panel("inside", self.inside)
        return page


def live_page(subject: Subject) -> pn.Template:
    """Build the page for a new session."""
    return LivePage(subject).template()


def page_template(path: str, heading: str, charts: Sequence[str] = ()) -> pn.Template:
    """Build the frame of a page; panels are added by name."""
    page = pn.Template(_page_source())
    page.title = f"{heading} - NMSS Lab"
    page.add_variable("page_style", (HERE / "page.css").read_text(encoding="utf-8"))
    page.add_variable("pages", PAGES)
    page.add_variable("here", path)
    page.add_variable("heading", heading)
    page.add_variable("charts", list(charts))
    return page


def fill(
    page: pn.Template,
    owner: Any,
    parts: Iterable[str],
    figures: Mapping[str, ChartFigure],
) -> None:
    """Put attributes of a page's owner, and its figures, into the frame by name."""
    for name in parts:
        page.add_panel(name, getattr(owner, name))
    for name, drawn in figures.items():
        pane = pn.pane.Bokeh(drawn.figure, sizing_mode="stretch_both")
        page.add_panel(f"chart_{name}", pane)


@cache
def _page_source() -> jinja2.Template:
    source = (HERE / "page.html").read_text(encoding="utf-8")
    template: jinja2.Template = pn.io.resources._env.from_string(source)
    return template


@cache
def text_style() -> str:
    """Style sheet of texts."""
    return (HERE / "texts.css").read_text(encoding="utf-8")


def _text(name: str) -> pn.pane.HTML:
    return pn.pane.HTML(
        "",
        stylesheets=[text_style()],
        sizing_mode="stretch_width",
        margin=0,
        css_classes=[f"text-{name}"],
    )


def _from_address(choices: Choices) -> str:
    """Take the choices in the page's address; return what is wrong with them."""
    arguments = pn.state.session_args or {}
    given = {key: values[0].decode() for key, values in arguments.items()}
    try:
        choices.accept(given)
    except ValueError as error:
        return f"{ADDRESS}{error}"
    return ""


def _paragraph(text: str) -> str:
    return f"<p>{html.escape(text)}</p>"


def _complaint(text: str) -> str:
    words = "".join(f"<p>{html.escape(line)}</p>" for line in text.splitlines())
    return f'<div class="wrong">{words}</div>' if text else ""


def _measures(runs: Mapping[str, Run], channel: int) -> str:
    """Table of measures, one row a run."""
    first = next(iter(runs.values()))
    seconds, unit = time_unit(first)
    columns = {k: v.format(time=unit) for k, v in COLUMNS.items()}
    if first.y.shape[1] == 1:
        del columns["coupling"]
    head = "".join(f"<th>{html.escape(text)}</th>" for text in columns.values())
    body = "".join(
        _measures_row(row, number, columns, seconds)
        for number, row in enumerate(table(runs, channel))
    )
    caption = (
        "Rise, settling and overshoot of the first step of r; limits broken: samples "
        "outside them; the rest over the whole run"
    )
    return (
        f'<p class="quiet small">{caption}</p>'
        f"<table><thead><tr><th>Run</th>{head}</tr></thead>"
        f"<tbody>{body}</tbody></table>"
    )


def _measures_row(
    row: Mapping[str, Any], number: int, columns: Iterable[str], seconds: float
) -> str:
    name = html.escape(str(row["run"]))
    cells = "".join(
        f"<td>{_number(row[key] / (seconds if key in IN_TIME else 1.0))}</td>"
        for key in columns
    )
    swatch = f'<span class="swatch style{number}"></span>'
    return f'<tr><th scope="row">{swatch}{name}</th>{cells}</tr>'


def _number(value: float) -> str:
    if math.isnan(value):
        return "\u2013"
    text = f"{value:.0f}" if 1e4 <= abs(value) < 1e7 else f"{value:.4g}"
    return text.replace("-", "\u2212")
