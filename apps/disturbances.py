"""Choices of the page on measured disturbances, and what it says in words."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import param

from apps.session import (
    HELD,
    KEPT,
    LoopChoices,
    _largest,
    _round_number,
    known_case,
    literal,
    plain,
)
from nmss_lab.cases import LINEAR_CASES, Case
from nmss_lab.design import Design
from nmss_lab.measures import rejection
from nmss_lab.models import Array
from nmss_lab.plots import time_unit
from nmss_lab.simulate import Run, Scenario

WITHOUT, DIRECT, AUGMENTED = TRIO = (
    "wang_young",
    "disturbance_direct",
    "disturbance_augmented",
)
"""One cost and three controllers: the first does not see the disturbance."""

WORDS = {
    WITHOUT: "Without the measurement (Wang-Young)",
    DIRECT: "With it, direct",
    AUGMENTED: "With it, augmented",
    "held": "v stays as it is",
    "line": "v goes on along a line",
    "given": "the true future is given",
    "step": "a step",
    "ramp": "a ramp",
    "sine": "a sine",
}

BEGINS = {
    "measured_disturbance_7_4_1": 50,
    "temperature_7_4_2": 550,
    "wood_berry": 135,
}
"""Sample at which the disturbance of a case sets in: the mean, the door, the feed."""

FIRST_INPUT = {"temperature_7_4_2": 1}
"""Input shown at first: the inlet, as in figure 7.9."""

OWN_SIZE = {"temperature_7_4_2": -1.0}
"""Size of one's own disturbance at first, where half its range is too much."""

SHAPES = {
    "step": "(k >= 0)",
    "ramp": "np.clip(k / {length}, 0.0, 1.0)",
    "sine": "(k >= 0) * np.sin(2.0 * np.pi * k / {length})",
}
"""Python of a disturbance of size 1 that sets in at k = 0."""

EQUAL = 1e-6
"""Inputs that differ by less, relative to their size, are called the same."""


class DisturbanceChoices(LoopChoices):
    """Choices of the page on measured disturbances."""

    disturbance = param.Integer(
        0,
        bounds=(0, 11),
        label="Disturbance shown",
        doc="Which measured disturbance v the plots show.",
    )
    shape = param.Selector(
        default="case",
        objects=["case", *SHAPES],
        label="Disturbance v",
        doc="That of the case, or one of your own in its place.",
    )
    times = param.Number(
        1.0,
        bounds=(0.0, 3.0),
        step=0.05,
        label="Size, times the case's",
        doc="Makes the disturbance of the case larger or smaller.",
    )
    size = param.Number(
        0.0,
        bounds=(-1.0, 1.0),
        label="Size of your own disturbance",
        doc="In the unit of v; the amplitude of a sine.",
    )
    onset = param.Integer(
        0,
        bounds=(0, 100),
        label="Counted from sample",
        doc="The second table counts from here on; your own disturbance sets in here.",
    )
    length = param.Integer(
        20,
        bounds=(2, 400),
        label="Samples of the ramp, or of a period",
        doc="How long the ramp lasts, or one period of the sine.",
    )
    forecast = param.Selector(
        default="held",
        objects=["held", "line", "given"],
        label="Knowledge of v ahead",
        doc="What a plan takes v to be after the present sample; the line goes through "
        "the latest two values.",
    )
    path = param.Number(
        0.0,
        bounds=(-100.0, 100.0),
        step=5.0,
        label="Model of the path from v, per cent off",
        doc="Coefficients g of the model against the plant's; at -100 nothing is "
        "expected of v.",
    )

    when: ClassVar[dict[str, tuple[str, Any]]] = {
        **LoopChoices.when,
        "times": ("shape", "case"),
        "size": ("shape", list(SHAPES)),
        "length": ("shape", ["ramp", "sine"]),
    }
    groups: ClassVar[dict[str, tuple[str, ...]]] = {
        "Case": ("case", "structures", "output", "input", "disturbance"),
        "Disturbance": ("shape", "times", "size", "onset", "length"),
        "What the controllers know": ("forecast", "path", "gain"),
        "Design": ("Np", "Nc", "weight_y", "weight_move"),
        "Limits": ("limit_u", "u_max", "limit_du", "du_max", "limit_y", "y_max"),
    }
    default_case: ClassVar[str] = "temperature_7_4_2"
    makes: ClassVar[str] = "disturbances"
    of_design: ClassVar[tuple[str, ...]] = (
        "forecast",
        "path",
        *groups["Design"],
        *groups["Limits"],
    )

    @classmethod
    @functools.cache
    def cases(cls) -> list[str]:
        """Cases with a measured disturbance, those of chapter 7 first."""
        return [
            name
            for name in sorted(LINEAR_CASES, key=lambda name: name not in BEGINS)
            if _controllers(known_case(name))
        ]

    def _welcome(self, name: str) -> None:
        if name in KEPT and not _controllers(KEPT[name]):
            raise ValueError(
                f"case = {name!r}: it has no measured disturbance, or no controller of "
                "this page"
            )
        super()._welcome(name)

    def take_case(self, name: str) -> None:
        """Choose a case, its controllers and the size of its disturbance."""
        example = known_case(name)
        v = example.scenario.of("v", example.model.n_v)
        self.param["onset"].bounds = (0, len(v) - 1)
        super().take_case(name)
        self._offer(_controllers(example))
        self.structures = self._offered[:2]
        self.param["disturbance"].bounds = (0, example.model.n_v - 1)
        self.input = FIRST_INPUT.get(name, 0)
        self.onset = BEGINS.get(name, _changed_most(v))
        self.shape = "case" if np.ptp(v, axis=0).any() else "step"
        size = _round_number(_largest(v - self._level))
        self.param["size"].bounds, self.param["size"].step = (-size, size), size / 50
        self.size = OWN_SIZE.get(name, size / 2)

    @property
    def _level(self) -> Array:
        """Disturbance about which it varies, (n_v,): zero for deviations."""
        scenario, n_v = self.example.scenario, self.example.model.n_v
        if scenario.v0 is None:
            return np.zeros(n_v)
        v = scenario.of("v", n_v)
        middle: Array = np.round((v.min(axis=0) + v.max(axis=0)) / 2, 1)
        return middle

    def _shown(self, key: str) -> bool:
        if key == "disturbance":
            return self.example.model.n_v > 1
        return super()._shown(key)

    def _item(self, key: str) -> dict[str, Any]:
        item = super()._item(key)
        if key != "disturbance":
            return item
        options = [[i, name] for i, name in enumerate(self.example.model.v_names)]
        return {**item, "kind": "one", "options": options}

    def _word(self, key: str, name: str) -> str:
        if name in WORDS and key in ("structures", "shape", "forecast"):
            return WORDS[name]
        return super()._word(key, name)

    def scenario(self) -> Scenario:
        """Scenario of the case with the chosen disturbance."""
        scenario, level = super().scenario(), self._level
        if self.shape != "case":
            k = np.arange(self._samples) - self.onset
            v = np.tile(level, (len(k), 1))
            v[:, self.disturbance] += self.size * self._profile(k)
            return replace(scenario, v=v, v0=level)
        if self.times == 1.0:
            return scenario
        v = level + self.times * (scenario.of("v", len(level)) - level)
        v0 = level if scenario.v0 is None else scenario.v0
        return replace(scenario, v=v, v0=level + self.times * (v0 - level))

    def _profile(self, k: Array) -> Array:
        if self.shape == "step":
            return (k >= 0).astype(float)
        if self.shape == "ramp":
            return np.clip(k / self.length, 0.0, 1.0)
        wave: Array = (k >= 0) * np.sin(2.0 * np.pi * k / self.length)
        return wave

    def _scenario_lines(self) -> list[str]:
        lines, level = super()._scenario_lines(), literal(self._level)
        if self.shape != "case":
            profile = SHAPES[self.shape].format(length=self.length)
            return [
                *lines,
                f"level = {level}",
                f"k = np.arange({self._samples}) - {self.onset}",
                "v = np.tile(level, (len(k), 1))",
                f"v[:, {self.disturbance}] += {self.size!r} * {profile}",
                "scenario = replace(scenario, v=v, v0=level)",
            ]
        if self.times == 1.0:
            return lines
        return [
            *lines,
            f"level = {level}",
            f"v = level + {self.times!r} * (scenario.v - level)",
            "v0 = level if scenario.v0 is None else scenario.v0",
            f"v0 = level + {self.times!r} * (v0 - level)",
            "scenario = replace(scenario, v=v, v0=v0)",
        ]

    def _changed(self, design: Design) -> Design:
        design = super()._changed(design)
        if design.structure == WITHOUT:
            return design
        factor = 1.0 + self.path / 100.0
        return replace(
            design,
            model=replace(design.model, g=factor * design.model.g),
            options={**design.options, "forecast": self.forecast},
        )

    def _changed_lines(self) -> list[str]:
        lines = super()._changed_lines()
        if not set(self.structures) & {DIRECT, AUGMENTED}:
            return lines
        return [
            *lines,
            f'    if name != "{WITHOUT}":',
            "        design = designs[name]",
            f"        factor = 1.0 + {self.path!r} / 100.0",
            "        model = replace(design.model, g=factor * design.model.g)",
            f'        options = {{**design.options, "forecast": "{self.forecast}"}}',
            "        designs[name] = replace(design, model=model, options=options)",
        ]

    def script(self) -> str:
        """Python that computes what the page shows and prints both tables."""
        rejected = f"rejection(run, {self.onset}, {self.output}, {self.input})"
        return (
            f"{super().script()}"
            "for name, run in runs.items():\n"
            f"    print(name, {rejected})\n"
        )

    def _head(self, imports: Iterable[str]) -> list[str]:
        return super()._head([*imports, "from nmss_lab.measures import rejection"])

    def rejected(self, runs: Mapping[str, Run]) -> dict[str, dict[str, float]]:
        """Measures of every run after the disturbance."""
        return {
            name: rejection(run, self.onset, self.output, self.input)
            for name, run in runs.items()
        }

    def verdict(self, runs: Mapping[str, Run]) -> list[str]:
        """Sentences that compare the numbers of the runs."""
        found = self.rejected(runs)
        own = [name for name in found if name not in HELD]
        aware = [name for name in own if name != WITHOUT]
        said = []
        if WITHOUT in found and aware:
            said.append(_compared(found[WITHOUT], found[aware[0]], self.forecast))
        if {DIRECT, AUGMENTED} <= set(found):
            said.append(_alike(runs[DIRECT], runs[AUGMENTED]))
        held_back = {name: self._samples_at_limits(run) for name, run in runs.items()}
        if any(held_back.values()):
            counts = ", ".join(f"{plain(n)} {count}" for n, count in held_back.items())
            of = self._samples - self.onset
            said.append(f"Samples, of {of}, with an input at its limit: {counts}.")
        return said

    def _samples_at_limits(self, run: Run) -> int:
        """Count the samples after the disturbance with some input at its limit."""
        low, high = run.controller.limits.of("u", run.u.shape[1])
        room = EQUAL * (1.0 + np.abs(run.u))
        at = ((run.u <= low + room) | (run.u >= high - room))[self.onset :]
        return int(at.any(axis=1).sum())

    def told_from(self, run: Run) -> str:
        """Time from which the second table counts, in words."""
        seconds, unit = time_unit(run)
        return f"sample {self.onset}, {self.onset * run.t[1] / seconds:.4g} {unit}"


def _controllers(example: Case) -> list[str]:
    """List the controllers of a case to compare; none without a disturbance."""
    has = example.equation is None and example.model.n_v > 0
    return [name for name in TRIO if has and name in example.designs]


def _changed_most(v: Array) -> int:
    """Sample of the largest change of a disturbance; the first one that is as large."""
    if len(v) < 2:
        return 0
    return 1 + int(np.argmax(np.abs(np.diff(v, axis=0)).max(axis=1)))


def _compared(
    without: Mapping[str, float], told: Mapping[str, float], forecast: str
) -> str:
    """Compare a controller that is told the disturbance with one that is not."""
    belief = {
        "held": "held over each plan",
        "line": "continued along a line",
        "given": "with its true future",
    }[forecast]
    figures = {"peak": "peak deviation", "IAE": "IAE", "travel": "travel of the input"}
    parts = [f"{word} {_change(told[k], without[k])}" for k, word in figures.items()]
    return f"Told v, {belief}, against not told: {'; '.join(parts)}."


def _change(new: float, old: float) -> str:
    """Say by how much a number is less or more than another."""
    share = 100.0 * (new / old - 1.0) if old else np.nan
    if abs(new - old) <= 0.005 * abs(old):
        return "as large"
    if not np.isfinite(share):
        return f"{new:.3g} instead of none"
    return f"{abs(share):.0f} % {'less' if share < 0 else 'more'}"


def _alike(direct: Run, augmented: Run) -> str:
    """Say how far the two ways to use the measurement are apart."""
    apart = float(np.abs(direct.u - augmented.u).max())
    if apart <= EQUAL * (1.0 + float(np.abs(direct.u).max())):
        return (
            "Direct and augmented are one controller in two ways of writing: their "
            f"inputs differ by {apart:.1g} at most."
        )
    return f"The inputs of direct and augmented differ by up to {apart:.3g}."
