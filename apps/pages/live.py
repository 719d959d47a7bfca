"""What the live pages share: choices in, runs computed, figures and tables shown."""

from __future__ import annotations

import contextlib
import html
import logging
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import jinja2
import panel as pn
from bokeh.document import Document
from bokeh.models import Range1d

from apps.lessons import lessons
from apps.microscope import Microscope, magnified
from apps.pages.bar import FAULT, WithBar
from apps.player import INSIDE, Controls, Player, moving, stepping
from apps.session import HELD, Choices, plain
from apps.work import Withdrawn
from nmss_lab.cases import Case
from nmss_lab.measures import table
from nmss_lab.plots import Chart, ChartFigure, busiest_sample, time_unit
from nmss_lab.simulate import Run

Opened = TypeVar("Opened")

LOG = logging.getLogger(__name__)
HERE = Path(__file__).resolve().parent.parent
PAGES = (
    ("workbench", "Workbench"),
    ("receding_horizon", "Receding horizon"),
    ("structures", "Structures"),
    ("governor", "Reference governor"),
    ("disturbances", "Disturbances"),
    ("identify", "Identify"),
    ("tune", "Tune"),
    ("state_dependent", "State-dependent"),
    ("robustness", "Robustness"),
)

PARTS = (
    *("bar", "lead", "alert", "player", "microscope"),
    *("measures", "python", "notes", "controls"),
)

ADDRESS = "In the address of this page: "
PATIENT, TOLD_EVERY = 0.5, 0.2
"""Seconds after which an answer tells how far it is, and between two times."""

OPENING = 5.0
"""Seconds that runs may take while a page opens: the others wait for them."""

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


CARRIED = (
    *("case", "structures", "Np", "Nc", "weight_y", "weight_move"),
    *("limit_u", "u_max", "limit_du", "du_max", "limit_y", "y_max"),
    *("gain", "dynamics", "step_u", "step_y", "step_at", *HELD),
)
"""Choices that go along when somebody changes pages."""


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
    complaint: str
    controls: Controls
    _forms = 0

    def _opened(self, action: Callable[[], Opened]) -> Opened:
        """Do it with the choices of the address; if it cannot be, with the case's."""
        self.choices.hears = _soon_enough()
        try:
            return action()
        except ValueError as error:
            self.complaint = self.complaint or f"{ADDRESS}{error}"
            self.choices.take_case(self.choices.case)
            self.choices.hears = _soon_enough()
            return action()
        finally:
            self.choices.hears = None

    @contextlib.contextmanager
    def _attended(self, message: int) -> Iterator[None]:
        """Tell the form how far a long answer is.

        It ends once there is a newer one, or nobody left who waits for it.
        """
        asked, told = self.controls.sent, time.monotonic() + PATIENT - TOLD_EVERY
        session = pn.state.curdoc and pn.state.curdoc.session_context

        def hears(share: float) -> None:
            nonlocal told
            if self.controls.sent is not asked or (session and session.destroyed):
                raise Withdrawn
            if time.monotonic() - told > TOLD_EVERY:
                told = time.monotonic()
                self.controls.busy = {"message": message, "share": share}

        self.choices.hears = hears
        try:
            yield
        finally:
            self.choices.hears = None

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
        if sent.get("cancel", False):
            raise ValueError("Cancelled.")
        if sent.get("whole", False):
            self.choices.accept(sent)
        elif sent.get("reset", False):
            self.choices.take_case(self.choices.default_case)
        elif sent.get("case") != self.choices.case:
            self.choices.accept({"case": sent.get("case")})
        else:
            self.choices.accept(sent)


class LivePage(WithForm, WithBar):
    """One session's page: keeps the last good picture whatever is chosen."""

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.choices = subject.choices()
        self.complaint = _from_address(self.choices)
        self.lead, self.alert, self.measures, self.python, self.notes = (
            _text(name) for name in ("lead", "alert", "measures", "python", "notes")
        )
        charts = self._opened(self._answer)
        times = Range1d(*charts[0].span)
        self.figures = {chart.name: ChartFigure(chart, times) for chart in charts}
        self.player = Player(
            run=moving(charts, self._named(), self._start(), True),
            sizing_mode="stretch_width",
        )
        self.microscope = Microscope(sizing_mode="stretch_width")
        self.within: dict[str, ChartFigure] = {}
        self.inside = self._first_inside()
        self.controls = Controls(
            form=self._form(), state=self._state(0), sizing_mode="stretch_width"
        )
        self._case = self.choices.case
        self._make_bar()
        self._tell()
        self._measure()

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

    def _answer(self) -> list[Chart]:
        """Compute the runs, one half of the work, and the prices of their limits."""
        choices, hears = self.choices, self.choices.hears
        assert hears is not None
        choices.hears = lambda share: hears(share / 2)
        runs, charts = self._compute()
        named = {plain(name): run for name, run in runs.items()}
        self.seen = magnified(
            named, choices.input, lambda share: hears((1 + share) / 2)
        )
        self.runs = runs
        return charts

    def _compute(self) -> tuple[dict[str, Run], list[Chart]]:
        runs = self.choices.runs()
        named = {plain(name): run for name, run in runs.items()}
        shown = self.choices.output, self.choices.input
        return runs, self.subject.charts(named, *shown)

    def _start(self) -> int:
        """Sample at which the player begins."""
        return busiest_sample(self.runs)

    def _named(self) -> dict[str, Run]:
        return {plain(name): run for name, run in self.runs.items()}

    def _take(self, event: Any) -> None:
        """Take over what the form sent, compute, show, and answer."""
        sent = dict(event.new)
        message = sent.pop("message", 0)
        try:
            self._accept(sent)
            with self._attended(message):
                charts = self._answer()
            self._look_inside()
            self.complaint = ""
        except Withdrawn:
            return  # whatever asked meanwhile is answered instead
        except ValueError as error:
            self.complaint, charts = f"{error}\n{KEPT}", []
        except Exception:  # the form waits for an answer, whatever happens
            LOG.exception("choices %s", self.choices.values())
            self.complaint, charts = f"{FAULT}\n{KEPT}", []
        fresh, self._case = self.choices.case != self._case, self.choices.case
        anew = fresh or self.choices.description() != self.controls.form["groups"]
        if charts:
            named, start = self._named(), self._start()
            self.player.run = moving(charts, named, start, fresh)
        if anew:
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
        self.notes.object = _notes(example)
        self.bar.told = self._loaded()

    def _measure(self) -> None:
        """Show prices, table and Python of the runs."""
        self.microscope.seen = self.seen
        self.measures.object = _measures(self._named(), self.choices.output)
        self.python.object = _code(self.choices.script())

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


class Frame(pn.Template):
    """A page whose document is gone through once, when all of it is there."""

    def __repr__(self) -> str:
        """Be brief: Panel asks at each part that is added, and would list them all."""
        return type(self).__name__

    def server_doc(
        self, doc: Document | None = None, *args: Any, **more: Any
    ) -> Document:
        """Put all parts into the document of a session."""
        document = pn.state.curdoc if doc is None else doc
        with document.models.freeze():
            return super().server_doc(document, *args, **more)


def page_template(path: str, heading: str, charts: Sequence[str] = ()) -> pn.Template:
    """Build the frame of a page; panels are added by name."""
    page = Frame(_page_source())
    page.title = f"{heading} - NMSS Lab"
    page.add_variable("page_style", (HERE / "page.css").read_text(encoding="utf-8"))
    page.add_variable("pages", PAGES)
    page.add_variable("here", path)
    page.add_variable("carried", CARRIED)
    page.add_variable("user", pn.state.user)
    page.add_variable("heading", heading)
    page.add_variable("lessons", lessons(path))
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


def _soon_enough() -> Callable[[float], None]:
    """Give what hears of the first runs, and ends them if they take too long."""
    until = time.monotonic() + OPENING

    def hears(share: float) -> None:
        if time.monotonic() > until:
            raise ValueError(
                f"this takes more than {OPENING:g} s, {share:.0%} were done; choose it "
                "again in the form"
            )

    return hears


def _from_address(choices: Choices) -> str:
    """Take the choices in the page's address; return what is wrong with them.

    Somebody who comes "via" another page brings choices along: those that this page
    does not have are left behind without a word.
    """
    arguments = pn.state.session_args or {}
    given = {k: values[0].decode(errors="replace") for k, values in arguments.items()}
    came = given.pop("via", "")
    try:
        choices.accept(given)
    except ValueError as error:
        if not came:
            return f"{ADDRESS}{error}"
        if given.get("case", choices.case) != choices.case:
            with contextlib.suppress(ValueError):
                choices.put({key: given[key] for key in HELD if key in given})
            return f"This page shows an example of its own: {error}"
    return ""


def _paragraph(text: str) -> str:
    return f"<p>{html.escape(text)}</p>"


def _code(text: str) -> str:
    """Show Python as text, which scrolls by keyboard, too."""
    return f'<pre tabindex="0">{html.escape(text)}</pre>'


def _notes(example: Case, more: str = "") -> str:
    """Where a case is from, more about it, and what it assumes."""
    section = f"Section {example.section}. " if example.section else ""
    source = html.escape(f"{section}{example.source}. {more}".strip())
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in example.notes)
    return f"<p>{source}</p><ul>{notes}</ul>"


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
