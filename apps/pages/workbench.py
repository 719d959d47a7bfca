"""Workbench: from a record to a verified design in seven steps."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import panel as pn
import param
from bokeh.models import Range1d
from panel.custom import JSComponent

from apps.identification import RECORDS
from apps.pages.background import BackgroundPage, Work
from apps.pages.bar import WithBar
from apps.pages.identify import Upload, WithRecord
from apps.pages.live import (
    WithForm,
    _code,
    _complaint,
    _from_address,
    _paragraph,
    _text,
    fill,
    page_template,
)
from apps.player import STYLE, Controls, hand_over, script
from apps.session import held_as, plain
from apps.work import get_ready
from apps.workbench import (
    STEPS,
    Bench,
    WorkbenchChoices,
    charts,
    closer_look,
    do,
    structure_of,
    study_of,
)
from apps.workbench import script as python_of
from nmss_lab.files import Study
from nmss_lab.plots import Chart, ChartFigure, EnsembleFigure, EstimateFigure
from nmss_lab.simulate import Run, closed_loop

PATH, HEADING = "workbench", "Workbench"

CARDS = tuple(f"step_{name}" for name in STEPS)
PARTS = (
    *("bar", "lead", "alert", "conductor", *CARDS),
    *("python", "upload", "controls"),
)

LEAD = (
    "From a record of a step test to a constrained controller that leaves no offset "
    "and bears what the model does not know: step by step, or all at once."
)

PICTURES = {
    "data": ("data_output", "data_signal"),
    "model": ("fit", "response"),
    "limits": ("loop_output", "loop_input"),
    "tuning": ("tuned_output", "tuned_input"),
    "robustness": ("band_output", "band_input"),
}
"""Figures of the steps; each pair but the model's shares its times."""

LEGENDS = {
    "model": (("ink", "measured"), ("style0", "model, over both spans")),
    "limits": (("ink", "reference"), ("style0", "loop on its own model")),
    "tuning": (("ink", "reference"), ("style0", "before"), ("style1", "tuned")),
    "robustness": (
        ("ink", "reference"),
        ("style0", "median of all plants, in their 95 % band"),
    ),
}

STATES = {
    "waiting": "waits for the step before",
    "ready": "ready",
    "done": "done",
    "stale": "out of date: an earlier choice has changed",
    "failed": "failed",
    "working": "working",
}

TOLD_EVERY = 0.2
"""Seconds between messages of progress."""


class Card(JSComponent):
    """What there is to say of one step, or of all of them, and buttons.

    ``card`` comes from the server; ``sent`` goes to it: what to do ("act") up to
    which "step".  ``saved`` is a file for the browser to keep.
    """

    card = param.Dict(default={})
    sent = param.Dict(default={})
    saved = param.Dict(default={})
    figures = param.Integer(default=0)

    _esm = script("workbench.js")
    _stylesheets = (STYLE,)


class WorkbenchPage(WithRecord, WithForm, WithBar, BackgroundPage):
    """One session's page: results stay until there are new ones."""

    def __init__(self) -> None:
        super().__init__()
        self.choices = WorkbenchChoices()
        self.complaint = _from_address(self.choices)  # type: ignore[arg-type]
        self.bench = Bench()
        self.work: Work | None = None
        self.doing, self.counted, self.note = "", (0, 0), ""
        self.lead, self.alert, self.python = map(_text, ("lead", "alert", "python"))
        self.figures = _figures()
        self.upload = Upload(sizing_mode="stretch_width")
        self.controls = Controls(
            form=self._form(), state=self._state(0), sizing_mode="stretch_width"
        )
        self.conductor = Card(figures=len(self.figures), sizing_mode="stretch_width")
        self.cards = {name: Card(sizing_mode="stretch_width") for name in STEPS}
        for name, card in self.cards.items():
            setattr(self, f"step_{name}", card)
        self.upload.param.watch(self._take_file, "sent")
        for card in (self.conductor, *self.cards.values()):
            card.param.watch(self._act, "sent")
        self._make_bar()
        self._tell()
        if self.document is not None:
            get_ready()
            self._ends_with_its_page()
            pn.state.onload(lambda: self._later(lambda: self._begin("model")))

    def call_off(self) -> None:
        """Have the work stop at once; steps that are done are kept."""
        if self.work is not None:
            self.work.call_off()

    # From the form

    def _take(self, event: Any) -> None:
        """Take over what the form sent, and answer."""
        sent = dict(event.new)
        message = sent.pop("message", 0)
        record, described = self.choices._of_record(), self.choices.description()
        model = self.choices.model
        good = self._guard(lambda: self._accept(sent), self.choices.values())
        fresh = self.choices._of_record() != record
        anew = fresh or self.choices.description() != described
        last = ""
        if good and (fresh or self.choices.model != model):
            last = "data" if self.choices.record == "file" and fresh else "model"
        self._later(lambda: self._answer(message, anew, last))

    def _answer(self, message: int, anew: bool, last: str) -> None:
        """Show the choices that were taken over, and do steps up to the last one.

        Threads take choices over; whatever is shown is set on the event loop, or an
        older state might overtake a newer one.
        """
        if anew:
            self.controls.form = self._form()
        if last:
            self._begin(last)
        self._tell()
        self.controls.state = self._state(message)

    def _take_file(self, event: Any) -> None:
        """Take over an uploaded file, or say what is wrong with it."""
        sent = dict(event.new)
        last = "data"
        if not self._guard(lambda: self._open(sent), sent.get("name")):
            self.complaint = f"{str(sent.get('name'))[:80]}: {self.complaint}"
            last = ""

        def answer() -> None:
            self._answer(0, True, last)
            self.upload.answered += 1

        self._later(answer)

    # The work

    def _act(self, event: Any) -> None:
        """Do what a card asks for."""
        sent = dict(event.new)
        actions: dict[str, Callable[[], None]] = {
            "do": lambda: self._begin(str(sent["step"])),
            "cancel": self.call_off,
            "report": lambda: self._give("report.html", "text/html"),
            "design": lambda: self._give("design.json", "application/json"),
        }
        if sent.get("act") not in actions:
            return

        def act() -> None:
            self._guard(actions[sent["act"]], sent)
            self._tell()

        self._later(act)

    def _begin(self, last: str) -> None:
        """Do all steps up to one that are not done; earlier work is called off."""
        if last not in STEPS:
            raise ValueError(f"there is no step {last!r}")
        self.call_off()
        self.work, self.doing, self.note = None, "", ""
        missing = self.bench.missing(last, self.choices)
        if not missing:
            return
        work, choices = Work(), self.choices.copy()
        done = dict(self.bench.results)
        self.work, self.doing, self.counted = work, missing[0], (0, 0)
        self._in_thread(
            work,
            lambda: self._go_through(work, missing, choices, done),
            lambda problem: self._ended(work, choices, problem),
        )
        self._tell()

    def _go_through(
        self,
        work: Work,
        steps: list[str],
        choices: WorkbenchChoices,
        done: dict[str, Any],
    ) -> None:
        """Do steps one after another, in a thread; each is shown when it is done."""
        for step in steps:
            self._later(lambda step=step: self._count(work, step, (0, 0)))
            heard = self._heard(work, step)
            done[step] = do(step, choices, done, heard, work.lent)
            work.check()
            pictures = charts(done)
            shown = [c for c in pictures if c.name in PICTURES.get(step, ())]
            self._later(
                lambda step=step, shown=shown: self._did(
                    work, step, choices, done[step], shown
                )
            )

    def _heard(self, work: Work, step: str) -> Callable[[int, int], bool]:
        """Give what hears of a step's progress, and says whether to stop."""
        told = 0.0

        def heard(done: int, total: int) -> bool:
            nonlocal told
            work.check()
            time.sleep(0)  # let the other sessions in
            now = time.monotonic()
            if now - told > TOLD_EVERY:
                told = now
                self._later(lambda: self._count(work, step, (done, total)))
            return False

        return heard

    def _count(self, work: Work, step: str, counted: tuple[int, int]) -> None:
        """Show how far a step is."""
        if work is self.work:
            self.doing, self.counted = step, counted
            self._show_steps()

    def _did(
        self,
        work: Work,
        step: str,
        choices: WorkbenchChoices,
        result: Any,
        shown: list[Chart],
    ) -> None:
        """Take over a step that is done."""
        if work is not self.work or work.stop.is_set():
            return
        self.bench.put(step, choices, result)
        for chart in shown:
            self.figures[chart.name].show(chart)
        self._tell()

    def _ended(self, work: Work, choices: WorkbenchChoices, problem: str) -> None:
        """Show how the work ended."""
        if work is not self.work:
            return
        step = self.doing
        number = list(STEPS).index(step) + 1
        if problem:
            self.bench.fail(step, choices, problem)
            self.note = f"Stopped at step {number}, {STEPS[step]}."
        elif work.stop.is_set():
            self.note = f"Cancelled in step {number}; what was done before is kept."
        self.work, self.doing = None, ""
        self._tell()

    def _give(self, name: str, kind: str) -> None:
        """Hand a file of the last step over."""
        written = self.bench.results.get("report")
        if written is None:
            raise ValueError("do step 7 first: there is no report yet")
        text = written.html if name.endswith("html") else written.design
        card = self.cards["report"]
        hand_over(card, "saved", name=name, text=text, type=kind)

    # To the page

    def _tell(self) -> None:
        """Words of the page."""
        self.lead.object = _paragraph(LEAD)
        self.alert.object = _complaint(self.complaint)
        text = python_of(self.bench, self.choices)
        self.python.object = _code(text)
        self.bar.told = self._loaded()
        self._show_steps()

    def _show_steps(self) -> None:
        """Words of all steps, and the verdict."""
        states = {step: self.bench.state(step, self.choices) for step in STEPS}
        if self.work is not None:
            states[self.doing] = "working"
        for number, step in enumerate(STEPS, 1):
            self.cards[step].card = self._card(number, step, states[step])
        good, against = self.bench.verdict(self.choices)
        self.conductor.card = {
            "steps": [[step, name, states[step]] for step, name in STEPS.items()],
            "running": self.work is not None,
            "left": len(self.bench.missing("report", self.choices)),
            "note": self.note,
            "good": good,
            "against": against,
        }

    def _card(self, number: int, step: str, state: str) -> dict[str, Any]:
        """Describe one step as plain data."""
        result = self.bench.results.get(step)
        failure = self.bench.failures.get(step, ((), ""))[1]
        card: dict[str, Any] = {
            "number": number,
            "step": step,
            "name": STEPS[step],
            "state": state,
            "told": STATES[state],
            "counted": list(self.counted) if state == "working" else [0, 0],
            "problem": failure if state == "failed" else "",
            "words": "" if result is None else result.words,
            "pictured": result is not None and step in PICTURES,
            "choices": any(map(self.choices._shown, self.choices.of_step[step])),
        }
        if result is None:
            return card
        to, page = closer_look(step, self.choices, result)
        card |= {"to": to, "page": page, "legend": LEGENDS.get(step, ())}
        if step == "model":
            card |= {"rows": result.best, "chosen": result.orders}
        if step in ("structure", "tuning"):
            found = result.review.findings
            card["findings"] = [[f.verdict, f"{f.topic}: {f.sentence}"] for f in found]
        card["files"] = step == "report"
        return card

    # What the bar has of this page

    def _subject(self) -> str:
        file = self.choices.file
        own = self.choices.record == "file" and file is not None
        return file.name if own else RECORDS[self.choices.record]

    def _designs(self) -> dict[str, tuple[str, str]]:
        """Cases of the designs there are, and their names in them."""
        results, found = self.bench.results, {}
        if "limits" in results:
            kept = results["limits"].kept
            found["before"] = kept, results["limits"].design.structure
        if "tuning" in results:
            found["tuned"] = results["tuning"].kept, "tuned"
        return found

    def _shown_designs(self) -> list[str]:
        return list(self._designs())[-1:]

    def _design_named(self, name: str) -> str:
        return f"{plain(structure_of(self.choices))}, {name}"

    def _address(self, name: str) -> str:
        case, design = self._designs()[name]
        return held_as("case", case, design)

    def _without(self, which: str) -> dict[str, Any]:
        return {which: ""}

    def _study(self, name: str) -> Study:
        return study_of(self.bench.results)

    def _run_of(self, name: str) -> Run:
        run: Run = self.bench.results["limits"].run
        if name == "tuned":
            study = self._study(name)
            run = closed_loop(study.plant, study.design.build(), study.scenario)
        return run

    def _uncertain(self) -> dict[str, Any]:
        """Plants that a report tries: those of step 6."""
        found = self.bench.results.get("robustness")
        if found is None:
            return {}
        drawn: Mapping[str, Any] = {
            "uncertainty": found.uncertainty,
            "realisations": found.study.asked,
            "seed": found.study.seed,
        }
        return dict(drawn)

    def template(self) -> pn.Template:
        """Put the page together."""
        page = page_template(PATH, HEADING, list(self.figures))
        page.add_variable("steps", list(STEPS.items()))
        page.add_variable("pictures", PICTURES)
        fill(page, self, PARTS, self.figures)
        self.served = True
        return page


def _figures() -> dict[str, ChartFigure]:
    """Empty figures of all steps."""
    found: dict[str, ChartFigure] = {}
    for step, names in PICTURES.items():
        kind = EnsembleFigure if step == "robustness" else EstimateFigure
        times = None if step == "model" else Range1d(0.0, 1.0)
        for name in names:
            found[name] = kind(Chart(name, name, "", ()), times)
    return found


def page() -> pn.Template:
    """Build the page for a new session."""
    return WorkbenchPage().template()
