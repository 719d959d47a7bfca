"""Structures: all of them on one plant, in one scenario, on one sheet of scores."""

from __future__ import annotations

import html
from collections.abc import Mapping
from typing import Any

import numpy as np
import panel as pn
import param
from bokeh.models import Range1d
from panel.custom import JSComponent

from apps.pages.background import BackgroundPage
from apps.pages.bar import WithBar
from apps.pages.live import (
    WithForm,
    _code,
    _complaint,
    _from_address,
    _notes,
    _number,
    _paragraph,
    _text,
    fill,
    page_template,
)
from apps.player import STYLE, Controls, script
from apps.structures import (
    FIRST,
    Sheet,
    StructuresChoices,
    best_of,
    verdict,
)
from apps.work import Withdrawn
from nmss_lab.analysis import OFFSET_FREE, ROUNDING
from nmss_lab.comparison import FADING, Score
from nmss_lab.plots import (
    Chart,
    ChartFigure,
    PoleFigure,
    comparison_charts,
    time_unit,
)
from nmss_lab.simulate import Run

PATH, HEADING = "structures", "Structures"

PARTS = "bar", "lead", "alert", "sheet", "legend", "python", "notes", "controls"

LOOK = {
    "governor_3_4": "Six structures on a plant at the edge of stability: the forward "
    "path follows as well as feedback, and swings for ever once something pushes the "
    "input.",
    "double_integrator_4_4_1": "The forward path hides the double integrator: a push "
    "at the input, which its model does not see, is never taken out.",
    "ifac93_4_4_2": "A plant of seventh order, a model of first: structures that are "
    "one law on the model part on the plant. Compare them with the peak of S_o.",
    "shell_5_3_2": "Feedback and forward path respond alike to the reference, and "
    "their peaks of S_o differ twentyfold: look at the gains at high frequency.",
    "marginally_stable_6_3_2": "Two forward paths hide the plant's own poles on the "
    "unit circle: the reference does not show them, the push at the input does.",
    "ifac93_6_3_3": "Feedback takes the push at the input out first, the forward path "
    "bears a plant that is almost twice as strong: raise the gain and see who begins "
    "to swing.",
    "gasifier_6_3_4": "Nearly the same peak of S_o for three structures, and still the "
    "forward path leaves ten times the error after the push: its slowest hidden mode.",
    "measured_disturbance_7_4_1": "The disturbance is measured: see who uses it, who "
    "does without, and which mode no structure can move.",
    "temperature_7_4_2": "Surroundings get warmer: two structures measure it, and move "
    "the inputs a quarter as much as feedback that finds out from the rooms.",
    "quadruple_tank_minus": "Three structures are one law for the reference: compare "
    "what they make of a push at pump 1, and the peak of S_o.",
    "quadruple_tank_plus": "A right-hand zero: feedback buys its speed with the peak "
    "of S_o, the forward path with a slow return after the push.",
    "wood_berry": "Long dead times: feedback of past outputs bears less than 1 % of "
    "error of the plant, the forward path almost 100 %.",
}

COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("largest pole", "Largest pole", "Modulus of the largest pole of the loop"),
    (
        "largest hidden",
        "Hidden modes",
        "How many poles the response to the reference does not show, of the loop with "
        f"an exact model, slower than {FADING:g}; and the largest modulus",
    ),
    ("offset u", "Offset after d_u", "Error that a unit step at the input leaves"),
    ("offset y", "Offset after d_y", "Error that a unit step at the output leaves"),
    ("peak S_o", "Peak S_o", "Largest gain from a disturbance at the output to y"),
    ("peak S_i", "Peak S_i", "Largest gain from a disturbance at the input to y"),
    (
        "margin",
        "Plant error [%]",
        "The loop stays stable for every relative error of the plant, at its output, "
        "below this at all frequencies: one over the peak of I - S_o",
    ),
    ("rise", "Rise [{time}]", "From 10 to 90 % of the step of the reference"),
    ("settling", "Settling [{time}]", "Until it stays within 5 % of the step"),
    ("overshoot", "Overshoot [%]", "Beyond the reference, before the disturbance"),
    ("IAE r", "IAE refer\u00adence", "Integral of the absolute error before that"),
    ("IAE d", "IAE distur\u00adbance", "Integral of the absolute error from then on"),
    ("RMS du", "RMS of du", "Root mean square of the changes of the inputs"),
)
LINEAR = 7
"""Columns, the first ones, that are of the loop without limits."""

NOT_RANKED = "offset u", "offset y", "largest hidden"


class ScoreSheet(JSComponent):
    """The sheet: one row a structure, sorted by a click, up to three to be plotted.

    Rows that are ticked are told to the form by the event "nmss-choose".
    """

    sheet = param.Dict(default={})
    chosen = param.List(default=[])
    figures = param.Integer(default=0)

    _esm = script("sheet.js")
    _stylesheets = (STYLE,)


class StructuresPage(WithForm, WithBar, BackgroundPage):
    """One session's page: keeps the last good sheet."""

    def __init__(self) -> None:
        super().__init__()
        self.choices = StructuresChoices()
        self.complaint = _from_address(self.choices)
        self.lead, self.alert, self.legend, self.python, self.notes = (
            _text(name) for name in ("lead", "alert", "legend", "python", "notes")
        )
        self.found, self.scored = self._opened(self._scored)
        self.figures = _figures(self._charts())
        self.sheet = ScoreSheet(figures=len(self.figures), sizing_mode="stretch_width")
        self.controls = Controls(
            form=self._form(), state=self._state(0), sizing_mode="stretch_width"
        )
        self._make_bar()
        self._tell()
        self._tabulate()

    def _scored(self) -> tuple[Sheet, dict[str, Any]]:
        """Score; at least one of the rows that are to be plotted has scores."""
        sheet, names = self.choices.sheet(), self.choices.structures
        if not any(name in sheet.scores for name in names):
            raise ValueError(
                f"{self.choices.title(names[0])}: {sheet.reasons[names[0]]}"
            )
        return sheet, self._to_score()

    def _to_score(self) -> dict[str, Any]:
        """Choices that the scores depend on."""
        values = self.choices.values()
        return {k: v for k, v in values.items() if k != "structures"}

    def _take(self, event: Any) -> None:
        """Take over what the form sent, score, show, and answer."""
        sent = dict(event.new)
        message = sent.pop("message", 0)
        try:
            with self._attended(message):
                good = self._guard(lambda: self._score(sent), self.choices.values())
        except Withdrawn:
            return
        if good:
            charts = self._charts()
            self._painted(lambda: self._paint(charts))
            self._tabulate()
        if self.choices.description() != self.controls.form["groups"]:
            self.controls.form = self._form()
        self._tell()
        self.controls.state = self._state(message)

    def _score(self, sent: Mapping[str, Any]) -> None:
        """Take over choices, and score anew where more than the plots is another."""
        self._accept(sent)
        self.choices.designs()
        if self._to_score() != self.scored or not self._shown():
            self.found, self.scored = self._scored()

    def _shown(self) -> dict[str, Score]:
        """Scores that are plotted, by their names in words."""
        scores = self.found.scores
        names = [name for name in self.choices.structures if name in scores]
        return {self.choices.title(name): scores[name] for name in names}

    def _charts(self) -> list[Chart]:
        return comparison_charts(self._shown(), self.choices.output, self.choices.input)

    def _paint(self, charts: list[Chart]) -> None:
        for chart in charts:
            self.figures[chart.name].show(chart)

    def _run_of(self, name: str) -> Run:
        return self.found.scores[name].run

    # Words and numbers

    def _tell(self) -> None:
        """Words around the plots."""
        example = self.choices.example
        self.lead.object = _paragraph(LOOK.get(example.name, f"{example.title}."))
        self.alert.object = _complaint(self.complaint)
        self.notes.object = _notes(
            example,
            "The scenario is the page's own: disturbances are steps, and no internal "
            "model sees them.",
        )
        self.bar.told = self._loaded()

    def _tabulate(self) -> None:
        """Fill sheet, legend and Python."""
        choices, scores = self.choices, self.found.scores
        titles = {name: choices.title(name) for name in (*scores, *self.found.reasons)}
        seconds, unit = time_unit(next(iter(scores.values())).run)
        best = {
            key: best_of(scores, key) for key, *_ in COLUMNS if key not in NOT_RANKED
        }
        rows = [
            {
                "name": name,
                "title": titles[name],
                "note": choices.note(name),
                "stable": _stability(score),
                "cells": [
                    {**_cell(score, key, seconds), "best": name in best.get(key, ())}
                    for key, *_ in COLUMNS
                ],
            }
            for name, score in scores.items()
        ]
        self.sheet.sheet = {
            "columns": [
                {"key": key, "label": label.format(time=unit), "title": title}
                for key, label, title in COLUMNS
            ],
            "linear": LINEAR,
            "rows": rows,
            "missing": _grouped(self.found.reasons, titles),
            "verdict": verdict(scores, titles),
            "told": self._told(),
        }
        self.sheet.chosen = [name for name in choices.structures if name in scores]
        self.legend.object = "".join(
            f'<span class="key"><span class="swatch style{style}"></span>'
            f"{html.escape(title)}</span>"
            for style, title in enumerate(self._shown())
        )
        self.python.object = _code(choices.sheet_script(scores))

    def _told(self) -> str:
        """Say what the numbers are of."""
        choices, model = self.choices, self.choices.example.model
        output = model.y_names[choices.output]
        parts = [f"the reference steps at sample {FIRST}"] if choices.step_r else []
        steps = [
            (choices.step_u, f"the input {model.u_names[choices.input]}"),
            (choices.step_y, f"the output {output}"),
            (choices.step_v, "the measured disturbance"),
        ]
        where = [words for size, words in steps if size]
        if where:
            verb = "steps" if len(where) == 1 else "step"
            parts.append(f"{' and '.join(where)} {verb} at sample {choices._first}")
        several = (
            ""
            if model.n_y == model.n_u == 1
            else " Peaks are of the largest singular value, and depend on units."
        )
        point = (
            " Signals are deviations from the operating point."
            if choices._operating_point
            else ""
        )
        return (
            "Left: the loop around this plant with no limit active; hidden modes with "
            f"an exact model. Right: this run, with limits, of {output}: "
            f"{', and '.join(parts) or 'nothing happens'}.{several}{point} "
            "Best of the stable loops: \u2605."
        )

    def template(self) -> pn.Template:
        """Put the page together."""
        page = page_template(PATH, HEADING, list(self.figures))
        fill(page, self, PARTS, self.figures)
        self.served = True
        return page


def _figures(charts: list[Chart]) -> dict[str, ChartFigure]:
    """Figures of the first charts; what lies across is moved together."""
    shared = {chart.across: Range1d(*chart.span) for chart in charts}
    return {
        chart.name: (PoleFigure if chart.name == "poles" else ChartFigure)(
            chart, shared[chart.across]
        )
        for chart in charts
    }


def _grouped(reasons: Mapping[str, str], titles: Mapping[str, str]) -> list[list[str]]:
    """Names in words and the reason that they share, for each reason."""
    return [
        [" and ".join(titles[n] for n in reasons if reasons[n] == why), why]
        for why in dict.fromkeys(reasons.values())
    ]


def _stability(score: Score) -> list[Any]:
    """Words about stability, and a number to sort by."""
    radius = score.loop.radius
    if score.loop.is_stable:
        return ["yes", 0]
    return ["edge", 1] if radius < 1.0 + ROUNDING else ["no", 2]


def _cell(score: Score, key: str, seconds: float) -> dict[str, Any]:
    """Text of a figure, and the value to sort by, None where there is none."""
    value = score.figures[key]
    if key == "largest hidden":
        count = int(score.figures["hidden modes"])
        text = f"{count}: {value:.4f}" if count else "none"
        return {"text": text, "value": value if count else 0.0}
    if key.startswith("offset"):
        none = value <= OFFSET_FREE
        text = "none" if none else "no rest" if np.isinf(value) else _number(value)
        return {"text": text, "value": 0.0 if none else _plain(value)}
    scales = {"rise": 1.0 / seconds, "settling": 1.0 / seconds, "margin": 100.0}
    value *= scales.get(key, 1.0)
    if key == "largest pole":
        return {"text": f"{value:.4f}", "value": value}
    text = "\u221e" if np.isinf(value) else _short(value)
    return {"text": text, "value": _plain(value)}


def _short(value: float) -> str:
    """Three digits: a sheet is read at a glance, its script prints all of them."""
    return "0" if abs(value) < 5e-7 else _number(float(f"{value:.3g}"))


def _plain(value: float) -> float | None:
    """Value for the browser; what is infinite is larger than anything."""
    return None if np.isnan(value) else float(np.clip(value, -1e300, 1e300))


def page() -> pn.Template:
    """Build the page for a new session."""
    return StructuresPage().template()
