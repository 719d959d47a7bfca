"""Tune: goals as rows, what can be attained and at what price (thesis chapter 5)."""

from __future__ import annotations

import html
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
import panel as pn
import param
from bokeh.models import HoverTool, Range1d
from panel.custom import JSComponent

from apps.coupling import Coupling, cells
from apps.goals import KINDS, MOST_GOALS, Aim, Bench, aims_of, gain_of
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
from apps.session import HELD, held, held_as, plain
from apps.tuning import LOOK, OTHERWISE, TuneChoices
from apps.weight_tables import weight_table
from apps.work import Withdrawn, get_ready
from nmss_lab.design import Design
from nmss_lab.files import Study
from nmss_lab.matching import Match, match
from nmss_lab.models import Array
from nmss_lab.mpc import STRUCTURES
from nmss_lab.nmss import integral_of_error_form
from nmss_lab.plots import Chart, ChartFigure, history_chart, loop_charts
from nmss_lab.simulate import Run
from nmss_lab.tuning import Step, Tuned, attained, tune

Found = TypeVar("Found")

PATH, HEADING = "tune", "Tune"

PARTS = (
    *("bar", "lead", "alert", "goals", "legend", "grid"),
    *("weights", "measures", "python", "controls"),
)

TOLD_EVERY = 0.2
"""Seconds between pictures of the best so far."""

LOOK_AGAIN = 50
"""Milliseconds until what has been found is taken over, if an answer is under way."""

MATCH_EVALUATIONS = 3000
"""Designs that a match may try from each of its starts."""

STOPPING = "Stopping after the designs that are being tried."

SHOWN = ("output", "input", "increment")


class Goals(JSComponent):
    """Rows of goals, bars of what is attained, and what to do with the design found.

    ``state`` holds the rows and the number of the message it answers, ``progress`` all
    that moves; ``offer`` what rows may hold; ``typed`` a text for the field of the
    gain.  ``sent`` goes to the server: what to do ("act"), one at a time unless it was
    told by ``busy`` that the answer takes a while, and which share of it is done.
    ``stop`` counts how often the search was cancelled.
    """

    offer = param.Dict(default={})
    state = param.Dict(default={"rows": []})
    progress = param.Dict(default={})
    typed = param.Dict(default={})
    figures = param.Integer(default=0)
    busy = param.Dict(default={})
    sent = param.Dict(default={})
    stop = param.Integer(default=0)
    leads = param.Dict(default={})

    _esm = script("goals.js")
    _stylesheets = (STYLE,)
    _debounce = 0  # no message may swallow another


class Place(NamedTuple):
    """Where a session stands: what undo goes back to."""

    before: Design
    after: Design | None = None
    history: tuple[tuple[int, float], ...] = ()
    tried: int = 0
    note: str = ""
    gain: Array | None = None


class Live(NamedTuple):
    """The best design of a search that goes on."""

    design: Design
    step: Step
    values: Mapping[str, float]


class Rows(WithForm):
    """The rows and their buttons: long answers give way as those to the form do."""

    controls: Any

    def __init__(self, choices: TuneChoices, goals: Goals) -> None:
        self.choices, self.controls = choices, goals


class TunePage(WithForm, WithBar, BackgroundPage):
    """One session's page: keeps the last design and picture that worked."""

    def __init__(self) -> None:
        super().__init__()
        self.choices = TuneChoices()
        self.complaint = _from_address(self.choices)
        self.lock = threading.RLock()
        self.stopping = self.matching = False
        self.work: Work | None = None
        self.running: Future[None] | None = None
        self.began = self.lasted = 0.0
        self.past: list[Place] = []
        self.live: Live | None = None
        self.history: list[tuple[int, float]] = []
        self.tried, self.matched, self.ended = 0, "", 0
        self.made_for: tuple[Any, ...] = ()
        self.tried_for: tuple[Any, ...] = ()
        texts = ("lead", "alert", "legend", "weights", "measures", "python")
        self.lead, self.alert, self.legend, self.weights, self.measures, self.python = (
            _text(name) for name in texts
        )
        self._opened(self._open)
        charts = self._charts()
        times = Range1d(*charts[0].span)
        self.figures = {
            chart.name: ChartFigure(chart, times if chart.name in SHOWN else None)
            for chart in charts
        }
        hover = self.figures["history"].figure.select_one(HoverTool)
        hover.tooltips = [("designs", "@t{0}"), ("attainment", "@y{0.0000}")]
        self.grid = Coupling(sizing_mode="stretch_width")
        self.goals = Goals(
            offer=self._offer(),
            state={"rows": self._rows(), "answer": 0},
            progress=self._progress(),
            figures=len(self.figures),
            sizing_mode="stretch_width",
        )
        self.controls = Controls(
            form=self._form(), state=self._state(0), sizing_mode="stretch_width"
        )
        self.rows = Rows(self.choices, self.goals)
        self.goals.param.watch(self._act, "sent")
        self.goals.param.watch(self._cancel, "stop")
        self._make_bar()
        self._tell()
        if self.document is not None:
            self._ends_with_its_page()
            pn.state.onload(get_ready)

    def _open(self) -> None:
        """Begin with the choices there are."""
        self._renew()
        if not self._runs()[0]:
            raise ValueError("the loop is unstable with these choices")

    # From the form

    def _take(self, event: Any) -> None:
        """Take over what the form sent, show, and answer."""
        with self.lock:
            sent = dict(event.new)
            message = sent.pop("message", 0)
            sent.pop("goals", None)  # the rows have a way of their own
            form, seen = self.choices.description(), self._seen
            try:
                with self._attended(message):
                    self._guard(lambda: self._changed(sent), self.choices.values())
            except Withdrawn:
                return
            if self.choices.description() != form:
                self.controls.form = self._form()
            if self._seen != seen:
                self._show()
            else:
                self._tell()
            self.controls.state = self._state(message)

    @property
    def _seen(self) -> tuple[Any, ...]:
        """What the plots depend on."""
        choices = self.choices
        shown = choices.view, choices.stepped, choices.output, choices.input
        shown = *shown, choices.A, choices.B
        return (*shown, self.made_for, self.tried_for)

    def _changed(self, sent: dict[str, Any]) -> None:
        """Take over choices, all or none; what is held stays if a newer one comes."""
        before = self.choices.values()
        try:
            self._accept(sent)
            self._renew()
        except Withdrawn:
            kept = {key: getattr(self.choices, key) for key in HELD}
            self.choices.accept({**before, **kept})
            raise
        except Exception:
            self.choices.accept(before)
            raise

    def _renew(self) -> None:
        """Begin anew, or put the designs under new conditions, as choices ask for.

        Raises
        ------
        ValueError
            If a design cannot be built or tried; everything stays as it was then.
        """
        choices = self.choices
        made_for = tuple(getattr(choices, key) for key in choices.of_design)
        anew = made_for != self.made_for
        changed = choices.conditions != self.tried_for
        bench = choices.bench() if anew or changed else self.bench
        if anew:
            place = Place(bench.start)
        else:
            place = self._dressed(self.place) if changed else self.place
        self._prepare(bench, place)
        if anew:
            self.call_off()
            self.work, self.running = None, None
            self.past.clear()
            self.history, self.tried, self.matched = [], 0, ""
        elif changed and self.work is not None:
            self.work.stop.set()  # what it found so far comes all the same
        if anew or changed:
            self.live = None
        self.bench, self.place = bench, place
        self.made_for, self.tried_for = made_for, choices.conditions

    def _dressed(self, place: Place) -> Place:
        """Put the designs of a place under the conditions that are chosen."""
        dressed = self.choices.dressed
        after = place.after and dressed(place.after)
        return place._replace(before=dressed(place.before), after=after)

    def _prepare(
        self, bench: Bench, place: Place, aims: Sequence[Aim] | None = None
    ) -> None:
        """Find out on a bench all that the page shows of a place.

        Whoever attends hears of it, and may end it.

        Raises
        ------
        ValueError
            If a design cannot be tried, or all would take too long.
        """
        choices, hears = self.choices, self.choices.hears or (lambda share: None)
        if aims is None:
            aims = choices.aims(bench, lambda share: hears(share / 2))
        shown = [place.before, place.after]
        if self.live is not None and bench is self.bench:
            shown.append(self.live.design)
        if choices.view == "compare":
            shown += choices.fitting().values()
        designs = [design for design in shown if design is not None]
        goals = {design: choices.library(aims, bench, design) for design in designs}
        bench.prepare(goals, lambda share: hears((1 + share) / 2))

    # From the rows and their buttons

    def _act(self, event: Any) -> None:
        """Do what the rows ask for."""
        sent = dict(event.new)
        act, number = sent.get("act"), sent.get("number", 0)
        actions: dict[str, Callable[[], None]] = {
            "goals": lambda: self._edit(sent.get("rows", [])),
            "add": self._add,
            "suggest": self._suggest,
            "tune": self._begin,
            "undo": self._undo,
            "continue": self._go_on,
            "loop": lambda: self._send("receding_horizon"),
            "robust": lambda: self._send("robustness"),
            "match": lambda: self._match(str(sent.get("text", ""))),
            "gain": self._type_gain,
            "stay": self._stay,
        }
        if act not in actions:
            return
        with self.lock:
            try:
                with self.rows._attended(number):
                    self._guard(actions[str(act)], sent)
            except Withdrawn:
                return
            if act in ("gain", "loop", "robust"):
                self.alert.object = _complaint(self.complaint)
                self.goals.state = {**self.goals.state, "answer": number}
                return
            self._show(number)
            if act in ("goals", "add", "suggest"):
                self.controls.state = self._state(0)

    def _cancel(self, event: Any) -> None:
        """End the search with what it has found, whatever answer is under way."""
        if self.work is None or self.running is None:
            return
        if self.matching:  # half a match is none
            self.work.call_off()
        else:
            self.work.stop.set()
        self.stopping = True
        stopping = {"stopping": True, "note": STOPPING}
        self.goals.progress = {**self.goals.progress, **stopping}

    def _stay(self) -> None:
        raise ValueError("Cancelled.")

    def _edit(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Take over rows; one whose objective is new begins with what there is now."""
        try:
            texts = [self._row_text(row) for row in rows]
            new = [row["target"] is None for row in rows]
        except (KeyError, TypeError) as error:
            raise ValueError(f"goals: {error}") from error
        aims = aims_of(";".join(texts), self.choices.example.model.n_y)
        self._prepare(self.bench, self.place, aims)
        pairs = zip(aims, new, strict=True)
        self._set([self._as_now(aim) if fresh else aim for aim, fresh in pairs])

    def _row_text(self, row: Mapping[str, Any]) -> str:
        objective = str(row["objective"])
        if objective not in KINDS:
            raise ValueError(f"goals: no objective {objective!r}")
        seconds = self.choices.clock[0]
        tau = float(row.get("tau") or 0.0) * seconds
        if objective == "distance" and not tau:
            tau = 10.0 * self.choices.example.plant.dt
        target = float(row["target"] or 0.0) * self.choices.factor(objective)
        return Aim(objective, int(row["output"]), target, float(row["share"]), tau).text

    def _as_now(self, aim: Aim) -> Aim:
        """Set the target to what the design before tuning does."""
        now = self._values(self.place.before, [aim])[aim.key]
        return replace(aim, target=float(f"{now:.3g}") if math.isfinite(now) else 1.0)

    def _set(self, aims: Sequence[Aim]) -> None:
        text = ";".join(aim.text for aim in aims)
        aims_of(text, self.choices.example.model.n_y)  # refuses what cannot be
        self.choices.goals = text

    def _add(self) -> None:
        """Add the first objective that no row has and that can be told."""
        aims = self._aims()
        known = {aim.key for aim in aims}
        n_y = self.choices.example.model.n_y
        others = [
            Aim(objective, output, 0.0)
            for objective, kind in KINDS.items()
            if objective != "distance" and (objective != "coupling" or n_y > 1)
            for output in range(n_y if kind.each else 1)
        ]
        others = [aim for aim in others if aim.key not in known]
        self._prepare(self.bench, self.place, [*aims, *others])
        values = self._values(self.place.before, others)
        for aim in others:
            if math.isfinite(values[aim.key]):
                self._set([*aims, self._as_now(aim)][:MOST_GOALS])
                return

    def _suggest(self) -> None:
        before, self.choices.goals = self.choices.goals, ""
        try:
            self._prepare(self.bench, self.place)
        except Exception:
            self.choices.goals = before
            raise

    def _undo(self) -> None:
        if not self.past:
            raise ValueError("there is nothing to undo")
        place = self._dressed(self.past[-1])
        self._prepare(self.bench, place)
        self.past.pop()
        self.place = place
        self.history, self.tried = list(place.history), place.tried
        self.matched, self.lasted = "", 0.0

    def _go_on(self) -> None:
        if self.place.after is None:
            raise ValueError("tune first: there is nothing to continue from")
        self._remember()
        self.place = Place(self.place.after, note="The next tuning starts from here.")
        self.history, self.tried = [], 0

    def _remember(self) -> None:
        self.past = [*self.past[-19:], self.place]

    # What the bar has of this page

    def _shown_designs(self) -> list[str]:
        return list(self._designs())

    def _design_named(self, name: str) -> str:
        named = name in HELD
        return f"design {name}" if named else f"{plain(self.choices.structure)}, {name}"

    def _address(self, name: str) -> str:
        chosen = self._designs()[name]
        name = "before" if chosen is self.place.before else "tuned"
        kept = self.choices.keep(chosen, self.place.before)
        return held_as("case", kept, name)

    def _without(self, which: str) -> dict[str, Any]:
        return {which: ""}

    def _side_by_side(self) -> dict[str, Any]:
        return {"view": "compare"}

    def _study(self, name: str) -> Study:
        trial = self.bench.trials[self._trial]
        plant = self.choices.example.plant
        return Study(self._designs()[name], plant, trial.scenario)

    def _run_of(self, name: str) -> Run:
        return self._runs()[0][name]

    def _send(self, page: str) -> None:
        """Open another page with the design."""
        tuned, before = self._found(), self.place.before
        if page == "receding_horizon" and tuned.structure not in STRUCTURES:
            raise ValueError(
                "Receding horizon shows controllers that predict; a PIP gain does "
                "not. Robustness takes it"
            )
        name = self.choices.keep(tuned, before)
        more = ""
        if page == "receding_horizon":
            horizon = tuned.horizon
            more = f"&structures=tuned,before&Np={horizon.Np}&Nc={horizon.Nc}"
        hand_over(self.goals, "leads", to=f"{page}?case={name}{more}")

    def _found(self) -> Design:
        if self.place.after is None:
            raise ValueError("tune first: there is no tuned design yet")
        return self.place.after

    @property
    def present(self) -> Design:
        """The tuned design, or the one to begin with."""
        return self.place.after or self.place.before

    # The search

    def _begin(self) -> None:
        """Start a search off the event loop."""
        if self.running is not None:
            raise ValueError("a search is running: cancel it first")
        self._renew()
        aims = self._aims()
        job = self.choices.job(self.place.before, aims, self.bench)
        keys = [aim.key for aim in aims]
        bench = self.bench
        self.history, self.tried = [], 0
        self._start(
            lambda work: self._search(work, job, keys, bench),
            lambda found: self._finished(job["design"], *found),
        )

    def _start(
        self, find: Callable[[Work], Found], take: Callable[[Found], None]
    ) -> None:
        """Find something in a thread; take it over on the event loop."""
        work, found = Work(), list[Found]()
        self.work, self.live, self.stopping, self.matching = work, None, False, False
        self.began, self.matched = time.monotonic(), ""

        def ended(problem: str) -> None:
            self._when_free(lambda: self._ended(work, problem, found, take))

        self.running = self._in_thread(work, lambda: found.append(find(work)), ended)

    def _when_free(self, action: Callable[[], None]) -> None:
        """Do something once no answer is under way, without keeping the event loop."""
        document = self.document
        if self.lock.acquire(blocking=document is None):
            try:
                action()
            finally:
                self.lock.release()
        elif document is not None and document.session_context is not None:
            document.add_timeout_callback(lambda: self._when_free(action), LOOK_AGAIN)

    def _ended(
        self,
        work: Work,
        problem: str,
        found: Sequence[Found],
        take: Callable[[Found], None],
    ) -> None:
        """Take over what was found, or say why nothing was."""
        if work is not self.work:
            return
        if self.matching and not found and not problem:
            self.matched = "Cancelled."
        self.running, self.live, self.matching = None, None, False
        self.lasted = time.monotonic() - self.began
        self.ended += 1
        self.complaint = problem
        for result in found:
            self._remember()
            take(result)
        self._show()

    def call_off(self) -> None:
        """Have the work stop at once: what it found is of no use any more."""
        if self.work is not None:
            self.work.call_off()

    def _search(
        self, work: Work, job: dict[str, Any], keys: Sequence[str], bench: Bench
    ) -> tuple[Tuned, Design]:
        """Search in this thread; designs are tried in other processes."""
        told, pause, drawn = 0.0, TOLD_EVERY, math.inf

        def heard(step: Step) -> bool:
            nonlocal told, pause, drawn
            now = time.monotonic()
            if now - told > pause and not work.stop.is_set():
                if step.attainment < drawn or self.live is None:
                    self._picture(work, job, step, keys, bench)
                    drawn = step.attainment
                else:
                    self._later(lambda: self._heard(work, None, step.evaluation))
                told = time.monotonic()
                pause = max(TOLD_EVERY, 3.0 * (told - now))  # pictures cost time, too
            return work.stop.is_set()

        tuned = tune(**job, callback=heard, executor=work.lent)
        bench.know(tuned.design, dict(zip(keys, map(float, tuned.values), strict=True)))
        return tuned, self._tried(work, tuned.design, bench)

    def _tried(self, work: Work, found: Design, bench: Bench) -> Design:
        """Try a design under the conditions that are chosen by now; return it so."""
        design, known = found, None
        while known is not self.bench:
            with self.lock:
                if work is not self.work:
                    raise Withdrawn
                known = self.bench
                if known is not bench:  # limits have changed since
                    design = self.choices.dressed(found)
                goals = self.choices.library(self._aims(), known, design)
            known.prepare({design: goals})
        return design

    def _picture(
        self,
        work: Work,
        job: dict[str, Any],
        step: Step,
        keys: Sequence[str],
        bench: Bench,
    ) -> None:
        """Run the best design so far, and have it shown."""
        if not np.isfinite(step.attainment):
            return
        try:
            design = job["weights"].dressed(step.weights)
            bench.runs(design)
        except (ValueError, np.linalg.LinAlgError):
            return  # the picture of the one before stays
        values = dict(zip(keys, map(float, step.values), strict=True))
        bench.know(design, values)
        live = Live(design, step, values)
        self._later(lambda: self._heard(work, live, step.evaluation))

    def _heard(self, work: Work, live: Live | None, tried: int) -> None:
        """Show how far a search is, unless an answer is under way."""
        if not self.lock.acquire(blocking=False):
            return
        try:
            if work is not self.work or self.running is None or work.stop.is_set():
                return
            self.tried = tried
            if live is not None:
                self.live = live
                step = live.step
                self.history.append((step.evaluation, float(step.attainment)))
                self.bench.forget(self._in_use())
                self._paint()
            self.goals.progress = self._progress()
        finally:
            self.lock.release()

    def _finished(self, start: Design, tuned: Tuned, design: Design) -> None:
        """Take over what a search has found."""
        self.history = [(s.evaluation, float(s.attainment)) for s in tuned.history]
        self.tried = tuned.evaluations
        better = None if tuned.design is start else design
        stopped = tuned.stopped
        if self.work is not None and self.work.stop.is_set():
            stopped = "Cancelled: the best so far is kept."
        self.place = Place(
            self.place.before,
            better,
            tuple(self.history),
            self.tried,
            stopped if better else f"{stopped} No better design was found.",
        )

    # Matching a gain

    def _type_gain(self) -> None:
        K = self._case_gain()
        if K is None:
            raise ValueError("this case has no PIP design")
        text = "; ".join(", ".join(f"{x:.10g}" for x in row) for row in K)
        hand_over(self.goals, "typed", text=text)

    def _case_gain(self) -> Array | None:
        for design in self.choices.example.designs.values():
            if design.structure == "pip":
                return np.atleast_2d(design.options["K"])
        return None

    @property
    def _gain_shape(self) -> tuple[int, int]:
        model = self.choices.example.model
        return model.n_u, integral_of_error_form(model).n_x

    def _match(self, text: str) -> None:
        """Look for weights that give a gain."""
        if self.running is not None:
            raise ValueError("a search is running: cancel it first")
        self._renew()
        K, design = gain_of(text, *self._gain_shape), self.place.before
        bench = self.bench

        def find(work: Work) -> tuple[Match, Design]:
            found = match(
                K,
                design,
                starts=2,
                evaluations=MATCH_EVALUATIONS,
                executor=work.lent,
            )
            return found, self._tried(work, found.design, bench)

        self._start(find, lambda found: self._has_matched(K, *found))
        self.matching = True

    def _has_matched(self, K: Array, found: Match, design: Design) -> None:
        """Take over weights that give a gain, or nearly."""
        self.history, self.tried = [], 0
        note = "Matched to the gain."
        self.place = Place(self.place.before, design, note=note, gain=K)
        self.matched = _matched(found)

    # To the page

    def _aims(self) -> list[Aim]:
        return self.choices.aims(self.bench)

    def _values(self, design: Design, aims: Sequence[Aim]) -> dict[str, float]:
        goals = self.choices.library(aims, self.bench, design)
        return self.bench.values(design, goals)

    def _attained(self, design: Design, aims: Sequence[Aim]) -> float:
        goals = self.choices.library(aims, self.bench, design)
        values = self.bench.values(design, goals)
        found = attained(list(goals.values()), np.array(list(values.values())))
        return float(found)

    def _in_use(self) -> list[Design]:
        own = [self.place.before, self.place.after, *self.choices.fitting().values()]
        own.append(self.live.design if self.live else None)
        return [design for design in own if design is not None]

    @property
    def _word(self) -> str:
        if self.live is not None:
            return "best so far"
        return "matched" if self.place.gain is not None else "tuned"

    def _designs(self) -> dict[str, Design]:
        """Designs that are shown side by side."""
        present = self.live.design if self.live else self.present
        if self.choices.view == "compare":
            return {**self.choices.fitting(), "present": present}
        if present is self.place.before:
            return {"before": present}
        return {"before": self.place.before, self._word: present}

    def _runs(self) -> tuple[dict[str, Run], str]:
        """Give the runs of the trial shown, and the designs that have none to draw."""
        trial = self._trial
        runs = {name: self.bench.runs(d)[trial] for name, d in self._designs().items()}
        sound = {n: r for n, r in runs.items() if np.isfinite(r.y).all()}
        lost = [name for name in runs if name not in sound]
        return sound, ", ".join(lost)

    @property
    def _trial(self) -> int:
        return min(self.choices.stepped, len(self.bench.trials) - 1)

    def _charts(self) -> list[Chart]:
        runs, _ = self._runs()
        charts = []
        if runs:
            shown = self.choices.output, self.choices.input
            charts = loop_charts(runs, *shown)[: len(SHOWN)]
        return [*charts, history_chart(self.history, self.tried)]

    def _paint(self) -> None:
        """Draw the runs; figures that are served change on the event loop only."""
        charts, grid, legend = self._charts(), self._cells(), self._legend()

        def paint() -> None:
            for chart in charts:
                self.figures[chart.name].show(chart)
            self.grid.grid = grid
            self.legend.object = legend

        self._painted(paint)

    def _legend(self) -> str:
        runs, lost = self._runs()
        marks = "".join(
            f'<span class="swatch style{i}"></span>{html.escape(self._long(name))} '
            for i, name in enumerate(runs)
        )
        line = '<span class="swatch ink"></span>reference'
        what = ""
        if self.choices.by_step and len(self.bench.trials) > 1:
            name = self.choices.example.model.y_names[self._trial]
            what = f"<span>The reference of {html.escape(name)} steps.</span>"
        gone = f" Unstable and not drawn: {html.escape(lost)}." if lost else ""
        many = len(self.bench.trials[0].all_plants)
        counted = (
            f" Goals count {many} plants ({self.choices.over}); drawn is the plant of "
            "the case."
            if many > 1
            else ""
        )
        return f'<p class="small">{what}{marks}{line}.{counted}{gone}</p>'

    def _long(self, name: str) -> str:
        if name not in HELD:
            return name
        return f"{name}: {held(getattr(self.choices, name)).words}"

    def _cells(self) -> dict[str, Any]:
        trials = self.bench.trials
        if not (self.choices.by_step and len(trials) > 1):
            return {"rows": []}
        runs = [self.bench.runs(design) for design in self._designs().values()]
        references = [trial.scenario.reference for trial in trials]
        return cells(runs, references, self.choices.clock)

    def _show(self, answer: int | None = None) -> None:
        """Show the designs and all that is known of them."""
        with np.errstate(all="ignore"):
            self._paint()
        self._tell(answer)
        self.bench.forget(self._in_use())

    def _tell(self, answer: int | None = None) -> None:
        """Words and rows around the plots."""
        choices = self.choices
        offer = self._offer()
        if offer != self.goals.offer:
            self.goals.offer = offer
        answer = self.goals.state.get("answer", 0) if answer is None else answer
        self.goals.state = {"rows": self._rows(), "answer": answer}
        self.goals.progress = self._progress()
        look = LOOK.get(choices.case, f"{choices.example.title}. {OTHERWISE}")
        self.lead.object = _paragraph(look)
        self.alert.object = _complaint(self.complaint)
        self.measures.object = self._table()
        self.weights.object = weight_table(self._designs())
        aims = self._aims()
        text = choices.script_of(self.place.before, aims, self.place.gain)
        self.python.object = _code(text)
        self.bar.told = self._loaded()
        if not self.served:
            self.grid.grid = self._cells()
            self.legend.object = self._legend()

    def _offer(self) -> dict[str, Any]:
        model = self.choices.example.model
        kinds = [
            [key, kind.label, kind.each]
            for key, kind in KINDS.items()
            if key != "coupling" or model.n_y > 1
        ]
        outputs = list(model.y_names)
        time_unit = self.choices.clock[1]
        return {"kinds": kinds, "outputs": outputs, "most": MOST_GOALS} | {
            "time": time_unit
        }

    def _rows(self) -> list[dict[str, Any]]:
        """Rows as the page shows them, in units that people read."""
        choices, aims = self.choices, self._aims()
        before = self._values(self.place.before, aims)
        after = {}
        if self.place.after is not None:
            after = self._values(self.place.after, aims)
        rows = []
        for aim in aims:
            factor = choices.factor(aim.objective)
            now = before[aim.key]
            high, step = _reach(now / factor, aim.target / factor)
            rows.append(
                {
                    "objective": aim.objective,
                    "output": aim.output,
                    "target": aim.target / factor,
                    "share": aim.share,
                    "tau": aim.tau / choices.clock[0],
                    "key": aim.key,
                    "unit": choices.unit(aim),
                    "label": choices.label(aim),
                    "before": _finite(now / factor),
                    "high": high,
                    "step": step,
                }
                | (
                    {"after": _finite(after[aim.key] / factor)}
                    if aim.key in after
                    else {}
                )
            )
        return rows

    def _progress(self) -> dict[str, Any]:
        choices, running = self.choices, self.running is not None
        aims = self._aims()
        values: dict[str, float | None] = {}
        if self.live is not None:
            factor = self.live.step.attainment
            for key, value in self.live.values.items():
                values[key] = _finite(value / choices.factor(key.partition(":")[0]))
        elif running:
            factor = math.nan
        else:
            factor = self._attained(self.present, aims)
        K = self._case_gain()
        n_u, n_x = self._gain_shape
        elapsed = time.monotonic() - self.began if running else self.lasted
        shape = f"{n_u} x {n_x} numbers on the state of (3.2), commas between them" + (
            "; semicolons between inputs." if n_u > 1 else "."
        )
        return {
            "running": running,
            "matching": self.matching and running,
            "stopping": self.stopping and running,
            "tried": self.tried,
            "most": choices.most,
            "elapsed": elapsed,
            "attainment": _finite(factor),
            "note": self._note(factor, running),
            "values": values,
            "undo": bool(self.past),
            "tuned": self.place.after is not None,
            "gain": K is not None,
            "shape": shape,
            "match": self.matched,
            "ended": self.ended,
        }

    def _note(self, factor: float, running: bool) -> str:
        if self.stopping and running:
            return STOPPING
        if running:
            return "Looking for weights that match." if self.matching else "Searching."
        note = self.place.note
        if not math.isfinite(factor):
            return "A goal cannot be told of this design."
        if self._hard_is_missed():
            return f"A hard goal is missed, which counts a thousandfold. {note}".strip()
        met = (
            "Every goal is met."
            if factor <= 1e-6
            else "Not every goal is met; at most 0 means all are."
        )
        word = "" if self.place.after else "The design before tuning. "
        return f"{word}{met} {note}".strip()

    def _hard_is_missed(self) -> bool:
        hard = [aim for aim in self._aims() if aim.share == 0.0]
        return self._attained(self.present, hard) > 0.0 if hard else False

    def _table(self) -> str:
        """Goals of each design that is shown, and its attainment factor."""
        aims, choices = self._aims(), self.choices
        designs = self._designs()
        values = {name: self._values(d, aims) for name, d in designs.items()}
        head = "".join(
            f'<th><span class="swatch style{i}"></span>{html.escape(name)}</th>'
            for i, name in enumerate(designs)
        )
        body = ""
        for aim in aims:
            factor = choices.factor(aim.objective)
            label = f"{choices.label(aim)} [{choices.unit(aim)}]"
            hard = ", hard" if aim.share == 0 else ""
            cells = "".join(
                f"<td>{_number(values[name][aim.key] / factor)}</td>"
                for name in designs
            )
            body += (
                f'<tr><th scope="row">{html.escape(label)}</th>'
                f"<td>{_number(aim.target / factor)}{hard}</td>{cells}</tr>"
            )
        last = "".join(
            f"<td>{_number(self._attained(design, aims))}</td>"
            for design in designs.values()
        )
        body += f'<tr><th scope="row">Attainment factor</th><td>0</td>{last}</tr>'
        return (
            '<p class="quiet small">Goals of the designs shown</p>'
            f"<table><thead><tr><th>Goal</th><th>At most</th>{head}</tr></thead>"
            f"<tbody>{body}</tbody></table>"
        )

    def template(self) -> pn.Template:
        """Put the page together."""
        page = page_template(PATH, HEADING, list(self.figures))
        fill(page, self, PARTS, self.figures)
        self.served = True
        return page


def _reach(now: float, target: float) -> tuple[float, float]:
    """Give the upper end of a slider for a target, and its step, a round number."""
    reach = max(2.0 * abs(now) if math.isfinite(now) else 0.0, target, 1e-9)
    step = 2.0 * 10.0 ** (math.floor(math.log10(reach)) - 2)
    return step * math.ceil(reach / step - 1e-9), step


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _matched(found: Match) -> str:
    """Say how near a match is, and what cannot be matched."""
    near = (
        "The law without limits is the given one"
        if found.is_exact
        else "No weights that give this law were found; this is the nearest"
    )
    lost = ""
    if found.lost > 1e-9:
        lost = (
            f" {100.0 * found.lost:.3g} % of the gain acts on what the model forgets "
            "in one step; no quadratic cost can give that part."
        )
    return f"{near}: relative distance {found.distance:.2g}.{lost}"


def page() -> pn.Template:
    """Build the page for a new session."""
    return TunePage().template()
