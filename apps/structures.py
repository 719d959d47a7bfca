"""Choices of the page Structures: every structure on one plant, and their scores.

Scores and scripts are made from the same lines, as in ``apps.session``.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import param

from apps.session import (
    HELD,
    MOST_RUNS,
    LoopChoices,
    _largest,
    _round_number,
    held,
    known_case,
    literal,
    plain,
)
from nmss_lab.analysis import OFFSET_FREE
from nmss_lab.cases import Case, piecewise
from nmss_lab.comparison import Score, all_structures, compare, in_deviations
from nmss_lab.design import Design
from nmss_lab.files import Study
from nmss_lab.matching import equal_speed
from nmss_lab.models import Array
from nmss_lab.mpc import STRUCTURES
from nmss_lab.simulate import Scenario

FIRST = 5
"""Sample at which the reference steps."""

OPENS_WITH = "disturbance_direct", "wang_young", "forward_path", "integral_of_error"
"""Rows that are plotted at first, as far as there are such, up to three."""


@functools.lru_cache(maxsize=64)
def completed(example: Case) -> Case:
    """Case with a design of every structure that suits it."""
    return all_structures(example)


@functools.lru_cache(maxsize=64)
def unsuitable(example: Case) -> dict[str, str]:
    """Say of each predictive structure that does not suit a completed case why not."""
    main = next(iter(example.designs.values()))
    reasons = {}
    for structure in set(STRUCTURES) - {d.structure for d in example.designs.values()}:
        try:
            equal_speed(main, structure)
        except (ValueError, np.linalg.LinAlgError) as error:
            reasons[structure] = str(error)
    return dict(sorted(reasons.items()))


@dataclass(frozen=True, eq=False)
class Sheet:
    """Scores by the name of the design, and why others have none."""

    scores: Mapping[str, Score]
    reasons: Mapping[str, str]


class StructuresChoices(LoopChoices):
    """Choices of the page Structures."""

    step_r = param.Number(
        1.0,
        label="Step of the reference",
        doc=f"At sample {FIRST}, of the output shown; the others rest.",
    )
    horizons: Any = param.Selector(
        default="case",
        objects=["case", "own"],
        label="Horizons",
        doc="Those of each design, or your own for all that predict.",
    )
    step_v = param.Number(
        0.0,
        label="Step of the measured disturbance",
        doc="Only structures made for it use the measurement.",
    )
    samples = param.Integer(
        100,
        bounds=(40, 600),
        step=10,
        label="Length of the run, samples",
        doc="Half of it for the reference and half for the disturbance, unless the "
        "time of the step says otherwise.",
    )

    when: ClassVar[dict[str, tuple[str, Any]]] = {
        **LoopChoices.when,
        "Np": ("horizons", "own"),
        "Nc": ("horizons", "own"),
    }
    groups: ClassVar[dict[str, tuple[str, ...]]] = {
        "Case": ("case", "structures", "output", "input"),
        "Scenario": ("step_r", "step_u", "step_y", "step_v", "step_at", "samples"),
        "Plant against model": ("gain", "dynamics"),
        "Horizons": ("horizons", "Np", "Nc"),
        "Limits": ("limit_u", "u_max", "limit_du", "du_max", "limit_y", "y_max"),
    }
    default_case: ClassVar[str] = "ifac93_6_3_3"
    makes: ClassVar[str] = "structures"
    of_design: ClassVar[tuple[str, ...]] = (*groups["Horizons"], *groups["Limits"])

    def _case_of(self, name: str) -> Case:
        return completed(known_case(name))

    def take_case(self, name: str) -> None:
        """Choose a case, every structure that suits it, and steps of fitting size."""
        for key in ("step_r", "step_v"):
            self.param[key].bounds = None
        super().take_case(name)
        example = self.example
        self._offer(example.designs)
        shown = [
            key
            for structure in OPENS_WITH
            for key, design in example.designs.items()
            if design.structure == structure
        ]
        self.structures = shown[:MOST_RUNS]
        self.samples = int(np.clip(len(example.scenario), 60, 300))
        self._take_sizes(example)

    def _take_sizes(self, example: Case) -> None:
        """Put steps where the case has them, or where they move the output alike."""
        model, size = example.model, usual_step(example)
        gain, by_v = model.steady_state_gain()[0], model.disturbance_gain()[0]
        pushes = example.scenario.input_disturbance
        limits = self.param["step_u"].bounds[1]
        if pushes is not None and pushes.any():
            first = pushes[np.flatnonzero(pushes.any(axis=1))[0]]
            self.input = int(np.argmax(np.abs(first)))
            push = float(first[self.input])
        elif np.isfinite(gain).all() and gain.any():
            self.input = int(np.argmax(np.abs(gain)))
            push = 0.5 * size / float(gain[self.input])
        else:
            push = 0.1 * limits
        seen = 0.5 * size / float(by_v[0]) if model.n_v and by_v[0] else 0.0
        for key, value, shown in (
            ("step_r", size, size if self._within_limits(size) else 0.0),
            ("step_u", push, 0.0 if seen else push),
            ("step_v", seen, seen),
        ):
            most = _round_number(2.0 * abs(value) or 1.0)
            self.param[key].bounds, self.param[key].step = (-most, most), most / 100
            setattr(self, key, float(f"{shown:.2g}"))

    def _within_limits(self, size: float) -> bool:
        """Whether inputs within the limits hold the first output at a step."""
        model, start = self.example.model, self.example.scenario
        gain = model.steady_state_gain()
        if not np.isfinite(gain).all():
            return True
        step = size * np.eye(model.n_y)[0]
        u = np.linalg.pinv(gain) @ step + (0.0 if start.u0 is None else start.u0)
        low, high = self._main_design.limits.of("u", model.n_u)
        return bool(((low <= u) & (u <= high)).all())

    def _shown(self, key: str) -> bool:
        if key == "structures":
            return False  # they are chosen in the sheet
        if key == "step_v" and not self.example.model.n_v:
            return False
        return super()._shown(key)

    # From choices to scores. Every line here has its twin in ``script``.

    @property
    def _samples(self) -> int:
        return self.samples

    @property
    def _operating_point(self) -> tuple[Array, Array] | None:
        """Input and output that all signals are deviations from, if not from zero."""
        start, plant = self.example.scenario, self.plant()
        if start.u0 is None:
            return None
        u0 = np.asarray(start.u0, float)
        v0 = np.zeros(plant.n_v) if start.v0 is None else np.asarray(start.v0, float)
        return u0, plant.C @ plant.reset(u0, v0)

    def _steps(self) -> dict[str, Array]:
        """Gather what changes and disturbs the loop, by the name of the series."""
        model = self.example.model
        sizes = {
            "v": (model.n_v, 0, self.step_v),
            "input_disturbance": (model.n_u, self.input, self.step_u),
            "output_disturbance": (model.n_y, self.output, self.step_y),
        }
        return {
            name: size * np.eye(channels)[channel]
            for name, (channels, channel, size) in sizes.items()
            if channels and (size or name == "v")
        }

    def scenario(self) -> Scenario:
        """Step of the reference, and of what disturbs the loop later."""
        change = self.step_r * np.eye(self.example.model.n_y)[self.output]
        series = {
            name: piecewise(self._samples, (self._first, size))
            for name, size in self._steps().items()
        }
        return Scenario(piecewise(self._samples, (FIRST, change)), **series)

    @property
    def rows(self) -> list[str]:
        """Names of all designs that are scored."""
        return list(self.param["structures"].objects)

    def _changed(self, design: Design) -> Design:
        horizon = design.horizon
        if self.horizons == "own" and design.structure in STRUCTURES:
            horizon = self._horizon(design)
        return replace(design, horizon=horizon, limits=self.limits(design.limits))

    def _in_place(self, design: Design) -> Design:
        """Put a design to the operating point, if there is one."""
        point = self._operating_point
        return design if point is None else in_deviations(design, *point)

    def study_of(self, name: str) -> Study:
        """Return one of the designs with plant and scenario, as they are scored."""
        study = super().study_of(name)
        return replace(study, design=self._in_place(study.design))

    def sheet(self) -> Sheet:
        """Score every structure.

        Raises
        ------
        ValueError
            If no design, or more than three, are to be plotted, or none can be built.
        """
        self.designs()
        plant, scenario = self.plant(), self.scenario()
        scores, reasons = dict[str, Score](), dict[str, str]()
        for number, name in enumerate(self.rows):
            if self.hears is not None:
                self.hears(number / len(self.rows))
            try:
                design = self._in_place(self._design(name))
                scores |= compare({name: design}, plant, scenario, self.output)
            except ValueError as error:
                reasons[name] = str(error).removeprefix(f"{name}: ")
        if not scores:
            name, reason = next(iter(reasons.items()))
            raise ValueError(f"{self.title(name)}: {reason}")
        return Sheet(scores, {**unsuitable(self.example), **reasons})

    def title(self, name: str) -> str:
        """Name of a row in words, its structure first."""
        found = self.example.designs.get(name)
        structure = name if found is None else found.structure
        if structure in (name, "pip"):
            head, _, tail = plain(name).partition(", ")
        else:
            head, tail = plain(structure), plain(name).lower()
        return f"{head} ({tail})" if tail else head

    def note(self, name: str) -> str:
        """Say where a design comes from, if it is not the case's own."""
        if name in HELD:
            return held(getattr(self, name)).words
        known = known_case(self.case).designs
        if name in known:
            return ""
        main = next(key for key, d in known.items() if d.structure in STRUCTURES)
        return f"weights of {plain(main)}"

    # Python

    def _case_imports(self) -> tuple[str, ...]:
        name = "from nmss_lab.comparison import all_structures"
        return (*super()._case_imports(), name)

    def _case_lines(self) -> list[str]:
        return [*super()._case_lines(), "example = all_structures(example)"]

    def _before_designs(self) -> list[str]:
        return []

    def _changed_lines(self) -> list[str]:
        if self.horizons == "case":
            return ["    designs[name] = replace(design, limits=limits)"]
        known = self.example.designs
        ours = [name for name in self.structures if name not in HELD]
        changed = [
            name
            for name in ours
            if known[name].structure in STRUCTURES
            and self._horizon(known[name]) is not known[name].horizon
        ]
        return [
            "    horizon = design.horizon",
            f"    if name in {changed!r}:",
            f"        horizon = Horizon({self.Np}, {self.Nc})",
            "    designs[name] = replace(design, horizon=horizon, limits=limits)",
        ]

    def _scenario_lines(self) -> list[str]:
        N = self._samples
        change = self.step_r * np.eye(self.example.model.n_y)[self.output]
        lines = ["scenario = Scenario("]
        lines.append(f"    piecewise({N}, ({FIRST}, {literal(change)})),")
        for name, size in self._steps().items():
            series = f"piecewise({N}, ({self._first}, {literal(size)}))"
            lines.append(f"    {name}={series},")
        return [*lines, ")"]

    def _point_lines(self) -> list[str]:
        """Lines that put ``designs`` to an operating point, if there is one."""
        point = self._operating_point
        if point is None:
            return []
        u0, y0 = map(literal, point)
        return [
            f"u0 = {u0}",
            f"y0 = {y0}",
            "designs = {k: in_deviations(d, u0, y0) for k, d in designs.items()}",
        ]

    def sheet_script(self, names: Iterable[str]) -> str:
        """Python that scores designs and prints the sheet, one of them a line."""
        scored = type(self)(**self.values())
        scored.structures = list(names)
        imports = [
            "from nmss_lab.cases import piecewise",
            "from nmss_lab.comparison import compare",
            "from nmss_lab.simulate import Scenario",
        ]
        others = [
            scored,
            *(held(getattr(self, k)).choices for k in scored._held_chosen),
        ]
        designs, point = scored._designs_lines(), self._point_lines()
        if point:
            imports.append("from nmss_lab.comparison import in_deviations")
        if any("Horizon(" in line for one in others for line in one._designs_lines()):
            imports.append("from nmss_lab.predict import Horizon")
        lines = [
            *scored._head(imports),
            "",
            *scored._held_lines(),
            *scored._case_lines(),
            *scored._plant_lines(),
            *scored._scenario_lines(),
            "",
            *designs,
            *point,
            "",
            f"scores = compare(designs, plant, scenario, channel={self.output})",
            "for name, score in scores.items():",
            "    print(name, dict(score.figures))",
        ]
        return "\n".join(lines) + "\n"

    def script(self) -> str:
        """Python that computes what the page shows."""
        return self.sheet_script(self.rows)


def usual_step(example: Case) -> float:
    """Size of the first step of the first reference, or what takes its place."""
    scenario, r = example.scenario, np.asarray(example.scenario.reference)[:, 0]
    start = r[0] if scenario.u0 is not None else 0.0
    moved = np.flatnonzero(np.abs(r - start) > 1e-12)
    if moved.size:
        return float(r[moved[0]] - start)
    if example.bands:
        low, high = (np.ravel(side)[0] for side in next(iter(example.bands.values())))
        return float(high - low) / 4.0
    return _largest(scenario.output_disturbance)


# Words about a sheet

SAME = 1e-3
"""Scores that differ by less, relatively, count as equal."""

HIGHER = ("margin",)
"""Figures of which more is better."""


def best_of(scores: Mapping[str, Score], figure: str) -> list[str]:
    """Name the stable designs that are best in a figure; none if all are alike."""
    values = {
        name: score.figures[figure]
        for name, score in scores.items()
        if score.loop.is_stable and np.isfinite(score.figures[figure])
    }
    if len(values) < 2:
        return []
    sign = -1.0 if figure in HIGHER else 1.0
    best = min(values.values(), key=lambda value: sign * value)
    room = SAME * abs(best) + 1e-9
    near = [name for name, value in values.items() if abs(value - best) <= room]
    return near if len(near) < len(values) else []


def verdict(scores: Mapping[str, Score], titles: Mapping[str, str]) -> str:
    """Say in one sentence what a sheet shows."""
    lost = [name for name, score in scores.items() if not score.loop.is_stable]
    parts = []
    if lost:
        verb = "is" if len(lost) == 1 else "are"
        parts.append(f"{_listed(lost, titles)} {verb} not stable here")
    rankings = [
        _ranking(scores, titles, figure, verb, words)
        for figure, verb, words in (
            ("IAE d", "take", "the disturbance out best"),
            ("IAE r", "follow", "the reference best"),
            ("margin", "bear", "the largest error of the plant"),
        )
    ]
    parts += [text for text in rankings if text]
    offsets = [
        name
        for name, score in scores.items()
        if score.loop.is_stable
        and max(score.figures[k] for k in ("offset u", "offset y")) > OFFSET_FREE
    ]
    if offsets:
        verb = "keeps" if len(offsets) == 1 else "keep"
        parts.append(f"{_listed(offsets, titles)} {verb} an offset")
    parts += _of_hidden(scores, titles)
    text = "; ".join(parts) or "all structures score alike here"
    return f"{text[0].upper()}{text[1:]}."


def _of_hidden(scores: Mapping[str, Score], titles: Mapping[str, str]) -> list[str]:
    """Say who hides the slowest mode."""
    sizes = {
        name: score.figures["largest hidden"]
        for name, score in scores.items()
        if score.figures["hidden modes"]
    }
    if not sizes:
        return []
    worst = max(sizes.values())
    names = [name for name, size in sizes.items() if size > worst - 1e-6]
    who = "all" if len(names) == len(scores) else _listed(names, titles)
    verb = "hide" if len(names) > 1 else "hides"
    return [f"{who} {verb} a mode of modulus {worst:.4g}"]


CLEARLY = 1.05
"""Ratio of the worst to the best from which a figure is worth a word."""


def _ranking(
    scores: Mapping[str, Score],
    titles: Mapping[str, str],
    figure: str,
    verb: str,
    words: str,
) -> str:
    """Compare the best and the worst of the stable designs in a figure."""
    best = best_of(scores, figure)
    if not best:
        return ""
    values = {
        name: score.figures[figure]
        for name, score in scores.items()
        if score.loop.is_stable and np.isfinite(score.figures[figure])
    }
    worst = (min if figure in HIGHER else max)(values, key=lambda name: values[name])
    a, b = values[best[0]], values[worst]
    if max(a, b) < CLEARLY * min(a, b):
        return ""
    share = figure == "margin"
    a, b = (f"{100 * x:.3g} %" if share else f"{float(f'{x:.3g}'):.6g}" for x in (a, b))
    told = f"{a} against {b} of {titles[worst]}"
    verb = verb if len(best) > 1 else f"{verb}s"
    return f"{_listed(best, titles)} {verb} {words} ({'' if share else 'IAE '}{told})"


MOST_NAMES = 3
"""More are counted instead of named."""


def _listed(names: list[str], titles: Mapping[str, str]) -> str:
    if len(names) > MOST_NAMES:
        return f"{len(names)} of them"
    words = [titles[name] for name in names]
    return " and ".join([", ".join(words[:-1]), words[-1]] if words[1:] else words)
