"""Robustness: how the loop behaves for the plants one does not have."""

from __future__ import annotations

import html
import math
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import panel as pn
import param
from bokeh.models import Range1d
from panel.custom import JSComponent

from apps.pages.background import BackgroundPage, Work
from apps.pages.bar import WithBar
from apps.pages.live import (
    WithForm,
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
from apps.robustness import (
    AT_FIRST,
    BY_ITSELF,
    RobustnessChoices,
    Study,
    at_channel,
    centre,
)
from apps.session import plain
from apps.work import get_ready
from nmss_lab.analysis import linear_loop
from nmss_lab.models import Array
from nmss_lab.montecarlo import MonteCarlo, join, monte_carlo_parts
from nmss_lab.plots import (
    NAMES_OF_MEASURES,
    Chart,
    EnsembleFigure,
    ensemble_charts,
    locus_chart,
    picked_charts,
    ranked,
    time_unit,
)
from nmss_lab.simulate import Run, closed_loop
from nmss_lab.uncertainty import Bounds, uncertainty_bounds

PATH, HEADING = "robustness", "Robustness"

PARTS = (
    *("bar", "lead", "alert", "told"),
    *("panel", "python", "notes", "controls"),
)

TOLD_EVERY = 0.2
"""Seconds between messages while a study grows."""

GROWN = 1.3
"""A growing study is drawn again when it has so many times the realisations."""

WORST = 5
"""Realisations listed for each structure."""

GROWS = 50.0
"""A run this many times as far as the nominal one is cut on another page."""

IN_REPORT = 300
"""Realisations of a report."""

FACTORS = np.linspace(0.5, 1.5, 101)
CIRCLE = 0.1
"""Radius of the circles of Table 6.1."""

LOOK = {
    "marginally_stable_6_3_2": "Plants drawn from P*: look first at how often each "
    "structure leaves the unit circle, and then at how far.",
    "ifac93_6_3_3": "The corners of the benchmark's stress level: the plant is of "
    "seventh order, the controller knows a first-order model.",
    "ifac93_4_4_2": "The corners of the benchmark's stress level, with the sum of the "
    "error in the state.",
}
OTHERWISE = (
    "Each plant drawn might be the true one; the controllers keep the model they have."
)
MISLEADS = (
    "A bare count misleads: many loops that are just unstable can be less bad than a "
    "few that are wildly so. Read the median and the worst beside it."
)
SEVERITY = {"radius": "largest pole", "excess": "excess", "peak": "peak"}


class StudyPanel(JSComponent):
    """Button and progress of a study, its rates, its worst, and the one picked.

    ``sent`` goes to the server: what to do ("act") and with which realisation.
    """

    progress = param.Dict(default={})
    rates = param.Dict(default={})
    worst = param.List(default=[])
    picked = param.Dict(default={})
    sent = param.Dict(default={})
    saved = param.Dict(default={})
    leads = param.Dict(default={})
    figures = param.Integer(default=0)

    _esm = script("study.js")
    _stylesheets = (STYLE,)


@dataclass(frozen=True, eq=False)
class View:
    """What of a study is shown."""

    output: int
    input: int
    measure: str
    peak: float


@dataclass(frozen=True, eq=False)
class Job:
    """A study that was begun, and what it was begun with."""

    choices: RobustnessChoices
    study: Study
    lines: tuple[str, ...]
    work: Work
    nominal: dict[str, Run]
    poles: dict[str, Array]


class RobustnessPage(WithForm, WithBar, BackgroundPage):
    """One session's page: keeps the last good study."""

    def __init__(self) -> None:
        super().__init__()
        self.choices = RobustnessChoices()
        self.complaint = _from_address(self.choices)
        self.job: Job | None = None
        self.running: Future[None] | None = None
        self.found: MonteCarlo | None = None
        self.done, self.note, self.picked = 0, "", -1
        self.loci: dict[tuple[Any, ...], tuple[dict[str, Array], list[Bounds]]] = {}
        self.walking: tuple[tuple[Any, ...], Work] | None = None
        self.lead, self.alert, self.told, self.python, self.notes = (
            _text(name) for name in ("lead", "alert", "told", "python", "notes")
        )
        self.figures = _figures()
        for source in self.figures["poles"].points:
            source.selected.on_change("indices", self._tapped(source))
        self.controls = Controls(
            form=self._form(), state=self._state(0), sizing_mode="stretch_width"
        )
        self.panel = StudyPanel(
            progress=self._progress(),
            figures=len(self.figures),
            sizing_mode="stretch_width",
        )
        self.panel.param.watch(self._act, "sent")
        self._make_bar()
        self._tell()
        if self.document is not None:
            get_ready()
            self._ends_with_its_page()
            pn.state.onload(self._open)

    def call_off(self) -> None:
        """Have study and walk stop at once; realisations that are done are kept."""
        self._cancel()
        if self.walking is not None:
            self.walking[1].call_off()

    def _cancel(self) -> None:
        if self.job is not None:
            self.job.work.call_off()

    # From the form

    def _take(self, event: Any) -> None:
        """Take over what the form sent, begin or show a study, and answer."""
        sent = dict(event.new)
        message, case = sent.pop("message", 0), self.choices.case
        cloud, view = self.choices.cloud, self._view()
        described = self.choices.description()
        good = self._guard(lambda: self._accept(sent), self.choices.values())
        fresh = self.choices.case != case or sent.get("reset", False)
        if fresh:
            self._forget()
        if fresh or self.choices.description() != described:
            self.controls.form = self._form()
        if (
            good
            and self._stale
            and self.choices.count <= (AT_FIRST if fresh else BY_ITSELF)
        ):
            self._begin()
        elif (
            good
            and self._view() == replace(view, peak=self.choices.peak)
            and (self.choices.cloud == cloud)
        ):
            self._guard(self._count_events, self.choices.values())
        elif good:
            self._guard(self._show, self.choices.values())
        self._tell()
        self.panel.progress = self._progress()
        self.controls.state = self._state(message)

    def _accept(self, sent: Mapping[str, Any]) -> None:
        """Take over choices of which a study can be made."""
        super()._accept(sent)
        self.choices.study()

    def _view(self) -> View:
        choices = self.choices
        return View(choices.output, choices.input, choices.measure, choices.peak)

    @property
    def _stale(self) -> bool:
        """Whether there is no study, or one with other choices, possible or not."""
        try:
            lines = tuple(self.choices.study_lines())
        except ValueError:  # the page says why
            return True
        return self.job is None or self.job.lines != lines

    def _open(self) -> None:
        """Begin with what the address asks for."""
        if self.choices.count <= AT_FIRST:
            said = self.complaint
            good = self._guard(self._begin, self.choices.values())
            self.complaint = said if good else self.complaint
        self._tell()
        self.panel.progress = self._progress()

    # The study

    def _act(self, event: Any) -> None:
        """Do what the panel asks for."""
        sent = dict(event.new)
        actions: dict[str, Callable[[], None]] = {
            "run": self._begin,
            "cancel": self._cancel,
            "pick": lambda: self._pick(int(sent["number"])),
            "unpick": lambda: self._pick(-1),
            "open": self._give,
            "rates": lambda: self._save("rates"),
            "table": lambda: self._save("realisations"),
        }
        if sent.get("act") in actions:
            self._guard(actions[sent["act"]], sent)
            self._tell()
            self.panel.progress = self._progress()

    def _begin(self) -> None:
        """Start a study off the event loop; an older one is called off."""
        choices = RobustnessChoices(**self.choices.values())
        study, lines = choices.study(), tuple(choices.study_lines())
        self._forget()
        job = Job(choices, study, lines, Work(), {}, {})
        self.job, self.note = job, "Waiting for its turn"
        self.running = self._in_thread(
            job.work,
            lambda: self._work(job),
            lambda problem: self._finished(job, problem),
        )
        self.panel.progress = self._progress()

    def _work(self, job: Job) -> None:
        """Study, in a thread; what it finds is shown on the event loop."""
        parts: list[MonteCarlo] = []
        told, drawn = time.monotonic(), 0
        _run_nominal(job)
        job.work.check()
        try:
            for part in _parts(job):
                parts.append(part)
                job.work.check()
                done = sum(map(len, parts))
                if time.monotonic() - told < TOLD_EVERY or done == job.study.n:
                    continue
                if done >= GROWN * drawn:
                    drawn = done
                    self._hand_over(job, join(parts))
                else:
                    self._later(partial(self._counted, job, done))
                told = time.monotonic()
        finally:  # what there is is kept, however it ends
            if parts:
                self._hand_over(job, join(parts))

    def _counted(self, job: Job, done: int) -> None:
        if job is self.job and self.running is not None:
            self.done, self.note = done, ""
            self.panel.progress = self._progress()

    def _hand_over(self, job: Job, found: MonteCarlo) -> None:
        """Draw in this thread what the event loop then shows."""
        if job is self.job:
            view = self._view()
            charts = self._charts(job, found, view)
            self._later(lambda: self._grown(job, found, charts, view))

    def _grown(
        self, job: Job, found: MonteCarlo, charts: list[Chart], view: View
    ) -> None:
        """Show what there is of a study."""
        if job is not self.job:
            return
        self.found, self.done, self.note = found, len(found), ""
        if view == self._view():
            self._paint(charts)
        else:
            self._show()
        self._tabulate()
        self._tell()
        self._later(self._count_on)  # after the pictures

    def _finished(self, job: Job, problem: str) -> None:
        """Say how a study ended."""
        if job is not self.job:
            return
        self.running = None
        self.complaint = problem or self.complaint
        self.note = self._ended(job)
        self._tell()
        self._later(self._count_on)

    def _ended(self, job: Job) -> str:
        if self.found is None:
            return "Cancelled before the first part was done" * job.work.stop.is_set()
        if len(self.found) < job.study.n:
            return f"Cancelled: {len(self.found):,} of {job.study.n:,} kept"
        return f"{job.study.n:,} realisations"

    def _count_on(self) -> None:
        self.panel.progress = self._progress()

    def _forget(self) -> None:
        """Call off and drop the study of other choices."""
        self.call_off()
        self.job, self.running, self.found, self.walking = None, None, None, None
        self.note, self.done, self.picked = "", 0, -1
        self.panel.rates, self.panel.worst, self.panel.picked = {}, [], {}

    # To the page

    def _charts(self, job: Job, found: MonteCarlo, view: View) -> list[Chart]:
        with np.errstate(all="ignore"):
            return ensemble_charts(
                found, job.nominal, job.poles, view.output, view.input, view.measure
            )

    def _paint(self, charts: list[Chart]) -> None:
        """Draw charts, over them the realisation picked, on the event loop."""
        job, found, view = self.job, self.found, self._view()
        over: dict[str, Chart] = {}
        if job is not None and found is not None and self.picked >= 0:
            picked = picked_charts(
                found,
                job.nominal,
                self.picked,
                view.output,
                view.input,
                view.measure,
            )
            over = {chart.name: chart for chart in picked}
        if self.choices.cloud != "draws":
            over.pop("poles", None)
            charts = [chart for chart in charts if chart.name != "poles"]
            charts += self._locus()

        def paint() -> None:
            for chart in charts:
                self.figures[chart.name].show(chart)
            for name, drawn in self.figures.items():
                drawn.pick(over.get(name))

        self._painted(paint)

    def _show(self) -> None:
        """Draw the study there is, and say what it found."""
        if self.job is None or self.found is None:
            return
        self._paint(self._charts(self.job, self.found, self._view()))
        self._tabulate()
        if self.picked >= 0:
            self._describe()

    def _tabulate(self) -> None:
        """Fill the tables."""
        job, found, view = self.job, self.found, self._view()
        if job is None or found is None:
            return
        self._count_events()
        names = list(found.poles)
        output = job.choices.example.model.y_names[view.output]
        run = next(iter(job.nominal.values()))
        self.panel.worst = [
            _worst(found, name, style, output, view.measure, run)
            for style, name in enumerate(names)
        ]

    def _count_events(self) -> None:
        """Fill the table of rates."""
        if self.job is None or self.found is None:
            return
        rates, names = self._rates(), list(self.found.poles)
        rows = [_rate_row(row, names) for row in rates.to_dict("records")]
        events = list(dict.fromkeys(row["event"] for row in rows))
        rows.sort(key=lambda row: (events.index(row["event"]), row["style"]))
        self.panel.rates = {"rows": rows, "verdict": _verdict(rates)}

    def _rates(self) -> Any:
        assert self.job is not None
        assert self.found is not None
        view, choices = self._view(), self.job.choices
        shown = at_channel(self.found, view.output, choices.example.model.y_names)
        return shown.rates(choices.events(view.peak))

    # Root loci

    def _locus(self) -> list[Chart]:
        """Chart of the walk of a factor; begun in the background if there is none."""
        job, letter = self.job, self.choices.cloud
        assert job is not None
        key = (letter, job.lines)
        if key not in self.loci:
            self._begin_walk(job, key)
            return []
        loci, bounds = self.loci[key]
        at = {
            name: np.concatenate([locus[_nearest(b.low)], locus[_nearest(b.high)]])
            for (name, locus), b in zip(loci.items(), bounds, strict=True)
        }
        of = f"factor on {letter} from {FACTORS[0]:g} to {FACTORS[-1]:g}"
        return [locus_chart(loci, at, of)]

    def _begin_walk(self, job: Job, key: tuple[Any, ...]) -> None:
        """Walk in the background, unless that walk has begun; an older one ends."""
        if self.walking is not None:
            if self.walking[0] == key:
                return
            self.walking[1].call_off()
        work = Work()
        self.walking = key, work
        self._in_thread(
            work,
            lambda: self._walk(work, job, key),
            lambda problem: self._walk_ended(work, problem),
        )

    def _walk(self, work: Work, job: Job, key: tuple[Any, ...]) -> None:
        """Walk, in a thread."""
        model = job.choices.example.model
        side = {"b": "numerator", "a": "denominator"}[key[0]]
        loci, bounds = {}, []
        for name, design in job.study.designs.items():
            controller = design.build()
            walked = [model.varied(**{side: f}) for f in FACTORS.tolist()]
            loci[name] = np.stack(
                [linear_loop(controller, plant).poles for plant in walked]
            )
            work.check()
            bounds.append(
                uncertainty_bounds(
                    controller,
                    lambda factor: model.varied(**{side: factor}),
                    CIRCLE,
                    0.005,
                    (float(FACTORS[0]), float(FACTORS[-1])),
                )
            )
        self._later(lambda: self._walked(work, key, (loci, bounds)))

    def _walked(self, work: Work, key: tuple[Any, ...], walk: Any) -> None:
        if self.walking == (key, work):
            self.loci = {**dict(list(self.loci.items())[-3:]), key: walk}
            if self.choices.cloud == key[0]:
                self._paint([])
                self._tell()

    def _walk_ended(self, work: Work, problem: str) -> None:
        if self.walking is not None and self.walking[1] is work:
            self.walking = None
            self.complaint = problem or self.complaint
            self._tell()

    # One realisation

    def _tapped(self, source: Any) -> Callable[[str, Any, Any], None]:
        """Return what picks the realisation of a point."""

        def tapped(attribute: str, old: Any, new: Any) -> None:
            if not new:
                return
            numbers = source.data["number"]
            number = int(numbers[new[0]]) if new[0] < len(numbers) else -1
            source.selected.indices = []
            if number >= 0:
                self._guard(lambda: self._pick(number), number)
                self._tell()

        return tapped

    def _pick(self, number: int) -> None:
        """Draw a realisation over all, or none."""
        if self.found is None or (
            number >= 0 and number not in self.found.realisations
        ):
            raise ValueError(f"realisation {number}: the study shown has no such one")
        self.picked = number
        self._paint([])
        self._describe()

    def _describe(self) -> None:
        """Say what was drawn in the realisation picked."""
        job, found = self.job, self.found
        if job is None or found is None or self.picked < 0:
            self.panel.picked = {}
            return
        table = found.table[found.table["realisation"] == self.picked]
        row = table.iloc[0]
        values = [
            [name, _number(float(row[name])), _number(nominal)]
            for name, nominal in centre(job.choices).items()
        ]
        output = job.choices.example.model.y_names[self._view().output]
        own = table[table["output"] == output].set_index("design")
        measure = self._view().measure
        run = next(iter(job.nominal.values()))
        loops = [
            {
                "design": plain(name),
                "style": style,
                "radius": _told(own.loc[name, "radius"]),
                "value": _measure(own.loc[name, measure], measure, run),
            }
            for style, name in enumerate(found.poles)
        ]
        cut = self._cut()
        words = (
            ""
            if cut is None
            else (
                f"A loop of it grows without end: the other page shows {cut} samples."
            )
        )
        self.panel.picked = {
            "number": self.picked,
            "values": values,
            "loops": loops,
            "measure": _words(measure, run),
            "note": words,
        }

    def _cut(self) -> int | None:
        """Sample at which a loop of the realisation picked has run away."""
        job, found = self.job, self.found
        assert job is not None
        assert found is not None
        place = int(np.flatnonzero(found.realisations == self.picked)[0])
        gone = len(job.study.scenario)
        for name, run in job.nominal.items():
            far = GROWS * max(float(np.nan_to_num(np.abs(run.y)).max()), 1e-9)
            far = min(far, GROWS * max(float(np.abs(run.r).max()), 1e-9)) or far
            beyond = ~(np.abs(found.signals[name].y[place]) < far)
            where = np.flatnonzero(beyond.any(axis=1))
            gone = min(gone, int(where[0]) if where.size else gone)
        return max(gone, 10) if gone < len(job.study.scenario) else None

    def _give(self) -> None:
        """Send the realisation picked to the page Receding horizon."""
        if self.job is None or self.picked < 0:
            raise ValueError("choose a realisation first")
        choices = self.job.choices
        name = choices.keep_drawn(self.picked, self._cut())
        view = self._view()
        to = f"receding_horizon?case={name}&structures={','.join(choices.structures)}"
        for key in ("output", "input"):
            to += f"&{key}={getattr(view, key)}" if getattr(view, key) else ""
        hand_over(self.panel, "leads", to=to)

    def _save(self, what: str) -> None:
        if self.found is None:
            raise ValueError("there is no study yet: press Run")
        table = self._rates() if what == "rates" else self.found.table
        hand_over(
            self.panel, "saved", name=f"{what}.csv", text=table.to_csv(index=False)
        )

    def _uncertain(self) -> dict[str, Any]:
        """Plants that a report tries: those of the study, a few hundred at most."""
        choices = self.choices
        many = min(choices.count, IN_REPORT)
        of_study = {"uncertainty": choices.plants(), "seed": choices.seed}
        return {**of_study, "realisations": many}

    # Words

    def _tell(self) -> None:
        """Words around the plots."""
        example = self.choices.example
        self.lead.object = _paragraph(LOOK.get(example.name, OTHERWISE))
        self.alert.object = _complaint(self.complaint)
        self.told.object = self._bounds_in_words()
        notes = "".join(f"<li>{html.escape(note)}</li>" for note in example.notes)
        self.notes.object = f"<ul>{notes}</ul>"
        shown = self.choices if self.job is None else self.job.choices
        done = None if self.found is None or self.running else len(self.found)
        view = self._view()
        text = shown.rates_script(view.output, view.peak, done)
        self.python.object = _code(text)
        self.bar.told = self._loaded()

    def _bounds_in_words(self) -> str:
        letter = self.choices.cloud
        if self.job is None or letter == "draws":
            return _paragraph(
                "Crosses: nominal poles; dotted: nominal response. Click a pole, or a "
                "row of the worst, to see its response as a thick line over the bands. "
                "Poles at the origin are drawn once; of a large study as many as one "
                "can see, the worst always."
            )
        walk = self.loci.get((letter, self.job.lines))
        if walk is None:
            return _paragraph("The factor walks ...")
        parts = [
            f"{plain(name)}: {_bound(b.low, b.low_pole)} to "
            f"{_bound(b.high, b.high_pole)}"
            for name, b in zip(walk[0], walk[1], strict=True)
        ]
        return _paragraph(
            f"A factor on {letter} of the model may go so far before a closed-loop "
            f"pole is {CIRCLE:g} away from its nominal place (Table 6.1): "
            f"{'; '.join(parts)}. Crosses: poles at these bounds."
        )

    def _progress(self) -> dict[str, Any]:
        running, job = self.running is not None, self.job
        total = job.study.n if job is not None else 0
        stale = job is None or self._stale
        return {
            "running": running,
            "done": self.done,
            "total": total,
            "count": self.choices.count,
            "note": self.note,
            "stale": stale,
            "studied": self.found is not None,
        }

    def template(self) -> pn.Template:
        """Put the page together."""
        page = page_template(PATH, HEADING, list(self.figures))
        fill(page, self, PARTS, self.figures)
        self.served = True
        return page


def _run_nominal(job: Job) -> None:
    """Run every design on the nominal plant, and find its poles there."""
    study = job.study
    for name, design in study.designs.items():
        controller = design.build()
        with np.errstate(all="ignore"):
            job.nominal[name] = closed_loop(study.nominal, controller, study.scenario)
        job.poles[name] = linear_loop(controller, study.nominal).poles


def _parts(job: Job) -> Any:
    study = job.study
    return monte_carlo_parts(
        study.designs,
        study.uncertainty,
        study.scenario,
        study.n,
        study.seed,
        keep="signals",
        executor=job.work.lent,
    )


def _figures() -> dict[str, EnsembleFigure]:
    """Empty figures; output and input share their times."""
    titles = {
        "poles": ("Closed-loop poles", "imaginary part [-]", "real part"),
        "output": ("Output", "y", "time"),
        "input": ("Input", "u", "time"),
        "distribution": ("Distribution", "share [-]", "IAE"),
    }
    charts = {
        name: Chart(name, title, axis, (), across=across)
        for name, (title, axis, across) in titles.items()
    }
    times = Range1d(0.0, 1.0)
    shared = {"output": times, "input": times}
    return {n: EnsembleFigure(c, shared.get(n)) for n, c in charts.items()}


def _nearest(factor: float) -> int:
    return int(np.argmin(np.abs(FACTORS - factor)))


def _bound(factor: float, pole: complex) -> str:
    """Factor at which a pole leaves its circle, or that none does."""
    if np.isnan(pole):
        return f"beyond {factor:g}"
    return f"{factor:.3f}"


def _told(value: float) -> str:
    return "\u221e" if value == math.inf else _number(float(value))


def _rate_row(row: Mapping[str, Any], names: list[str]) -> dict[str, Any]:
    """One line of the table of rates, worded."""
    percent = {k: f"{100.0 * row[k]:.3g}" for k in ("share", "low", "high")}
    return {
        "design": plain(row["design"]),
        "style": names.index(row["design"]),
        "event": row["event"],
        "count": f"{row['count']:,} of {row['n']:,}",
        "share": f"{percent['share']} % [{percent['low']}, {percent['high']}]",
        "severity": SEVERITY.get(row["severity"], row["severity"]),
        "median": _told(row["median"]),
        "worst": _told(row["worst"]),
    }


def _verdict(rates: Any) -> str:
    """Sentence about count and severity, where they point to different designs."""
    rows = rates[rates["event"] == "unstable"].to_dict("records")
    pairs = [
        (a, b)
        for a in rows
        for b in rows
        if 0 < a["count"] < b["count"] and a["worst"] > 1.001 * b["worst"]
    ]
    if not pairs:
        return MISLEADS
    a, b = max(pairs, key=lambda pair: pair[0]["worst"])
    words = (
        f"{plain(a['design'])} is unstable less often than {plain(b['design'])}, "
        f"{100 * a['share']:.3g} % against {100 * b['share']:.3g} %, but more wildly: "
        f"its worst pole has modulus {a['worst']:.4g} against {b['worst']:.4g}."
    )
    return f"{words} {MISLEADS}"


def _words(measure: str, run: Run) -> str:
    _, unit = time_unit(run)
    return NAMES_OF_MEASURES.get(measure, measure).format(time=unit)


def _measure(value: float, measure: str, run: Run) -> str:
    seconds, _ = time_unit(run)
    value = float(value) / (seconds if measure in ("rise", "settling") else 1.0)
    return "\u221e" if math.isinf(value) or math.isnan(value) else _number(value)


def _worst(
    found: MonteCarlo, name: str, style: int, output: str, measure: str, run: Run
) -> dict[str, Any]:
    """Worst realisations of one design."""
    values, numbers = ranked(found, name, output, measure)
    table = found.table
    rows = table[(table["design"] == name) & (table["output"] == output)]
    radii = rows.set_index("realisation")["radius"]
    last = range(len(values) - 1, max(len(values) - 1 - WORST, -1), -1)
    return {
        "design": plain(name),
        "style": style,
        "measure": _words(measure, run),
        "rows": [
            {
                "number": int(numbers[i]),
                "value": _measure(values[i], measure, run),
                "radius": _told(radii.loc[numbers[i]]),
            }
            for i in last
        ],
    }


def page() -> pn.Template:
    """Build the page for a new session."""
    return RobustnessPage().template()
