"""Choices of the page Tune: a design, what it is tried on, and goals for it."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import param
from scipy.signal import lfilter

from apps.goals import KINDS, MOST_GOALS, OVER, Aim, Bench, aims_of
from apps.session import KEPT, LoopChoices, Origin, keep_case, known_case, literal
from nmss_lab.cases import Case, piecewise, stress
from nmss_lab.design import Design
from nmss_lab.files import dumps
from nmss_lab.models import Array
from nmss_lab.mpc import STRUCTURES
from nmss_lab.pip import lq_gain
from nmss_lab.plots import unit_of_time
from nmss_lab.simulate import Scenario
from nmss_lab.tuning import Distance, Goal, Trial
from nmss_lab.uncertainty import RelativeRanges, realisations
from nmss_lab.weights import Weights

UNIT_WEIGHTS = "ifac93_4_4_2", "shell_5_3_2"
"""Cases that open as sections 5.3.1 and 5.3.2 begin: with all weights one."""

LOOK = {
    "ifac93_4_4_2": "Section 5.3.1: begin with all weights one and ask for no "
    "overshoot, a rise as before and 80 % of the error. Press Tune and watch what "
    "gives way.",
    "shell_5_3_2": "Section 5.3.2: each reference steps in turn and all outputs move. "
    "Ask for less coupling and watch what it costs the outputs themselves.",
}
"""What to look at, by case."""

OTHERWISE = (
    "State what the loop should become, press Tune, and see what can be attained and "
    "at what price."
)


class TuneChoices(LoopChoices):
    """Which design is tuned, what of it is free, and what it is tried on."""

    structure = param.Selector(
        objects=[""],
        label="Structure",
        doc="The controller that is tuned; kept designs A and B may have another.",
    )
    begin = param.Selector(
        default="case",
        objects=["case", "unit"],
        label="Weights to begin with",
        doc="Another choice here, of structure or of horizons begins anew.",
    )
    view = param.Selector(
        default="tuning",
        objects=["tuning", "compare"],
        label="Compare",
        doc="Before and after tuning, or the kept designs A and B with the present "
        "one.",
    )
    stepped = param.Integer(
        0,
        bounds=(0, 11),
        label="Trial shown",
        doc="Which reference steps in the plots over time.",
    )
    block_y = param.Selector(
        default="full",
        objects=["full", "diagonal", "fixed"],
        label="Outputs y",
        doc="Weight of the outputs, in (5.6) of the past outputs.",
    )
    block_past_u = param.Selector(
        default="full",
        objects=["full", "diagonal", "fixed"],
        label="Past inputs u",
        doc="Weight of the past inputs in the state.",
    )
    block_integral = param.Selector(
        default="full",
        objects=["full", "diagonal", "fixed"],
        label="Sum of the error z",
        doc="Weight of the sum of the error in the state.",
    )
    block_u = param.Selector(
        default="full",
        objects=["full", "diagonal", "fixed"],
        label="Inputs u",
        doc="Weight R of the inputs or their moves.",
    )
    along = param.Selector(
        default="one",
        objects=["one", "each"],
        label="Along the horizon",
        doc="One weight for all steps, or one weight a step (5.4): many more numbers "
        "to find.",
    )
    tried = param.Selector(
        default="scenario",
        objects=["scenario", "steps"],
        label="Tried on",
        doc="The scenario of the case, or a step of each reference in turn, from rest.",
    )
    length = param.Integer(
        60,
        bounds=(10, 400),
        step=2,
        label="Samples after a step",
        doc="Length of each trial.",
    )
    plants = param.Selector(
        default="nominal",
        objects=["nominal", "ranges", "stress"],
        label="Plants",
        doc="The plant of the case, draws around the model, or the 32 corners of a "
        "stress level (Table 4.1). Plots show the plant of the case.",
    )
    vary_a = param.Number(
        2.0,
        bounds=(0.0, 30.0),
        step=0.5,
        label="Dynamics a, plus and minus per cent",
        doc="Each coefficient a of the model is drawn within this range.",
    )
    vary_b = param.Number(
        20.0,
        bounds=(0.0, 80.0),
        step=1.0,
        label="Gains b, plus and minus per cent",
        doc="Each coefficient b of the model is drawn within this range.",
    )
    drawn = param.Integer(
        8, bounds=(1, 40), label="Plants drawn", doc="Besides the model itself."
    )
    draw_seed = param.Integer(
        0, bounds=(0, 99), label="Seed of the plants", doc="The same seed, the same."
    )
    level = param.Integer(
        1, bounds=(1, 3), label="Stress level", doc="1 is mild, 3 severe."
    )
    over = param.Selector(
        default="worst",
        objects=list(OVER),
        label="What counts",
        doc="The worst over all plants, what nine in ten stay below, or the mean.",
    )
    starts = param.Integer(
        3,
        bounds=(1, 10),
        label="Starts",
        doc="The design itself, and others drawn around it.",
    )
    seed = param.Integer(
        0,
        bounds=(0, 99),
        label="Seed of the starts",
        doc="The same seed gives the same answer.",
    )
    most = param.Integer(
        1500,
        bounds=(50, 6000),
        step=50,
        label="Most designs to try",
        doc="The search ends here at the latest; so does Cancel, with the best so far.",
    )
    goals = param.String(
        label="Goals", doc="Rows objective:output:target:importance; empty by default."
    )

    when: ClassVar[dict[str, tuple[str, str]]] = {
        **LoopChoices.when,
        "length": ("tried", "steps"),
        "vary_a": ("plants", "ranges"),
        "vary_b": ("plants", "ranges"),
        "drawn": ("plants", "ranges"),
        "draw_seed": ("plants", "ranges"),
        "level": ("plants", "stress"),
    }
    groups: ClassVar[dict[str, tuple[str, ...]]] = {
        "Case": ("case", "structure", "begin"),
        "Shown": ("view", "stepped", "output", "input"),
        "Design": ("Np", "Nc", "reading"),
        "Free weights": (
            "block_y",
            "block_past_u",
            "block_integral",
            "block_u",
            "along",
        ),
        "Trials and plants": (
            "tried",
            "length",
            "plants",
            "vary_a",
            "vary_b",
            "drawn",
            "draw_seed",
            "level",
            "over",
        ),
        "Search": ("starts", "seed", "most"),
        "Limits": ("limit_u", "u_max", "limit_du", "du_max", "limit_y", "y_max"),
    }
    default_case: ClassVar[str] = "ifac93_4_4_2"
    of_design: ClassVar[tuple[str, ...]] = ("case", "structure", "begin", "Np", "Nc")
    """What begins anew."""

    of_trials: ClassVar[tuple[str, ...]] = (
        *("reading", *groups["Limits"]),
        *groups["Trials and plants"],
    )
    """What changes the conditions under which designs are compared."""

    @classmethod
    def names(cls) -> list[str]:
        """Names of all choices, goals among them."""
        return [*super().names(), "goals"]

    def take_case(self, name: str) -> None:
        """Choose a case, its first structure, and what suits it."""
        designs = known_case(name).designs
        offered = [
            key
            for key, design in designs.items()
            if design.structure in (*STRUCTURES, "pip")
        ]
        self.param["structure"].objects = ["", *offered]  # none while the case changes
        super().take_case(name)
        predictive = [key for key in offered if designs[key].structure != "pip"]
        first = "integral_of_error" if name in UNIT_WEIGHTS else predictive[0]
        self.structure = first
        self.param["structure"].objects = offered
        example = self.example
        horizon = designs[self.structure].horizon
        self.Np, self.Nc = horizon.Np, horizon.Nc
        if name in UNIT_WEIGHTS:
            self.begin, self.Np, self.Nc = "unit", 10, 5
        n_y = example.model.n_y
        self.param["stepped"].bounds = (0, n_y - 1)
        moved = np.ptp(example.scenario.reference, axis=0) > 0.0
        if n_y > 1 and moved.all():
            self.tried = "steps"
            self.length = min(max(len(example.scenario) // n_y, 22), 200)
        stressed = ["stress"] if name.startswith("ifac93") else []
        self.param["plants"].objects = ["nominal", "ranges", *stressed]

    def _read(self, key: str, value: Any) -> Any:
        if key != "goals":
            return super()._read(key, value)
        text = str(value)
        if text:
            aims_of(text, self.example.model.n_y)
        return text

    def _shown(self, key: str) -> bool:
        blocks = {"block_y", "block_past_u", "block_integral", "block_u"}
        if key in blocks:
            return f"weight_{key.removeprefix('block_')}" in self._blocks
        if key in ("along", "Np", "Nc", "reading"):
            return self._structure != "pip"
        if key == "stepped":
            return self.example.model.n_y > 1 and self.tried == "steps"
        return super()._shown(key)

    def _item(self, key: str) -> dict[str, Any]:
        item = super()._item(key)
        if key == "stepped":
            names = self.example.model.y_names
            options = [[i, f"reference of {name}"] for i, name in enumerate(names)]
            return {**item, "kind": "one", "options": options}
        return item

    def _options(self, key: str) -> list[list[str]]:
        options = super()._options(key)
        if not key.startswith("block_"):
            return options
        model = self.example.model
        size = model.n_u if key.endswith("_u") else model.n_y
        if size > 1:
            return options
        now = getattr(self, key)
        keep = "diagonal" if now == "diagonal" else "full"
        return [[keep, "free"], ["fixed", "fixed"]]

    def _word(self, key: str, name: str) -> str:
        words = {
            ("begin", "case"): "as in the case",
            ("begin", "unit"): "all one",
            ("view", "tuning"): "before and after",
            ("view", "compare"): "A, B and the present design",
            ("along", "one"): "one weight for all steps",
            ("along", "each"): "one weight a step",
            ("tried", "scenario"): "scenario of the case",
            ("tried", "steps"): "each reference steps in turn",
            ("plants", "nominal"): "the plant of the case",
            ("plants", "ranges"): "draws around the model",
            ("plants", "stress"): "corners of a stress level",
        }
        if key in ("structure", "over") or key.startswith("block_"):
            return super()._word("structures", name) if key == "structure" else name
        return words.get((key, name)) or super()._word(key, name)

    # The design

    @property
    def _known(self) -> Design:
        """Design of the case with the chosen structure."""
        return self.example.designs[self.structure]

    @property
    def _structure(self) -> str:
        return self._known.structure

    @property
    def _blocks(self) -> tuple[str, ...]:
        return Weights(self._known).names

    def start(self) -> Design:
        """Design to begin with.

        Raises
        ------
        ValueError
            If it cannot be built.
        """
        design = self.dressed(self._known)
        if self.begin == "unit":
            design = replace(design, Q=1.0, R=1.0)
        if self._structure != "pip":
            design = replace(design, horizon=self._horizon(design))
        elif self.begin == "unit":
            options = {**design.options, "K": lq_gain(self.example.model, 1.0, 1.0)}
            design = replace(design, options=options)
        design.build()
        return design

    def dressed(self, design: Design) -> Design:
        """Design with the chosen limits and reading of the reference."""
        limits = self.limits(self._known.limits)
        if self._structure == "pip":
            return replace(design, limits=limits)
        own = self._known.reference
        reading = own if self.reading == "case" else self.reading
        return replace(design, limits=limits, reference=reading)

    def free(self, design: Design) -> Weights:
        """Weights of a design that may change.

        Raises
        ------
        ValueError
            If nothing is left to tune.
        """
        return Weights(design, **self._free())

    def _free(self) -> dict[str, Any]:
        kinds = {n: getattr(self, f"block_{n[7:]}") for n in self._blocks}
        along = self.along == "each" and self._structure != "pip"
        return {
            "full": [n for n, kind in kinds.items() if kind == "full"],
            "fixed": [n for n, kind in kinds.items() if kind == "fixed"],
            "per_step": along,
        }

    # What it is tried on. Every line here has its twin in ``script``.

    @property
    def conditions(self) -> tuple[Any, ...]:
        """Choices on which the values of objectives depend, beside the design."""
        return tuple(getattr(self, key) for key in self.of_trials)

    def bench(self) -> Bench:
        """Set up what designs are tried on.

        Raises
        ------
        ValueError
            If the plants cannot be drawn, or the design to begin with not be built.
        """
        plants = self._drawn()
        scenarios = self._scenarios()
        trials = [Trial(plants, scenario) for scenario in scenarios]
        return Bench(trials, self.example.plant, self.start())

    def _drawn(self) -> Any:
        model, plant = self.example.model, self.example.plant
        if self.plants == "ranges":
            share = {"a": self.vary_a / 100.0, "b": self.vary_b / 100.0}
            draws = realisations(
                RelativeRanges(model, share), self.drawn, self.draw_seed
            )
            return [model, *(draw.plant for draw in draws)]
        if self.plants == "stress":
            corners = stress(self.level, True, plant.dt, self.example.plant.substeps)
            return [draw.plant for draw in realisations(corners)]
        return plant

    @property
    def by_step(self) -> bool:
        """Whether each reference steps in a trial of its own."""
        return bool(self.tried == "steps")

    @property
    def rest(self) -> Array:
        """References from which the steps set out, (n_y,)."""
        scenario = self.example.scenario
        held = scenario.y0 is not None or scenario.u0 is not None
        rest: Array = scenario.reference[0] * float(held)
        return rest

    @property
    def _sizes(self) -> Array:
        """Size of the step of each reference: the largest in the case's scenario."""
        reach = np.abs(self.example.scenario.reference - self.rest).max(axis=0)
        sizes: Array = np.where(reach > 0.0, reach, 1.0)
        return sizes

    def _scenarios(self) -> list[Scenario]:
        scenario = self.example.scenario
        if not self.by_step:
            return [scenario]
        v = None if scenario.v is None else np.tile(scenario.v[0], (self.length, 1))
        return [
            replace(
                scenario,
                reference=self.rest + piecewise(self.length, (1, change)),
                v=v,
                input_disturbance=None,
                output_disturbance=None,
                noise=None,
                manual=None,
            )
            for change in np.diag(self._sizes)
        ]

    @property
    def _dt(self) -> float:
        return float(self.example.plant.dt)

    @property
    def clock(self) -> tuple[float, str]:
        """Unit of time that suits the trials: its seconds, and its name."""
        samples = self.length if self.by_step else len(self.example.scenario)
        return unit_of_time((samples - 1) * self._dt)

    # Goals

    def aims(
        self, bench: Bench, hears: Callable[[float], None] | None = None
    ) -> list[Aim]:
        """Rows that were chosen, or those that suit the design to begin with.

        For ``hears`` see ``Bench.prepare``.
        """
        if self.goals:
            return aims_of(self.goals, self.example.model.n_y)
        if not bench.suggested:
            bench.suggested = self._suggested(bench, hears)
        return list(bench.suggested)

    def _suggested(
        self, bench: Bench, hears: Callable[[float], None] | None
    ) -> list[Aim]:
        n_y, start = self.example.model.n_y, bench.start
        first = []
        if n_y == 1:
            first = [Aim("overshoot", 0, 0.05)]
            if self.case == "ifac93_4_4_2":
                first = [Aim("peak", 0, 1.0)]
            wanted = [("rise", 1.0), ("IAE", 0.8)]
            probes = [Aim(name, 0, 1.0) for name, _ in wanted]
        else:
            wanted = [("IAE", 0.8)] * n_y
            probes = [Aim("IAE", i, 1.0) for i in range(n_y)]
            if self.by_step:
                wanted += [("coupling", 0.5)] * n_y
                probes += [Aim("coupling", i, 1.0) for i in range(n_y)]
        goals = self.library([*first, *probes], bench, start)
        bench.prepare({start: goals}, hears)
        now = bench.values(start, goals)
        aims = [
            replace(probe, target=float(f"{share * now[probe.key]:.3g}"))
            for probe, (_, share) in zip(probes, wanted, strict=True)
            if np.isfinite(now[probe.key])
        ][:MOST_GOALS]
        if self.case == "ifac93_4_4_2" or np.isfinite(now.get("rise:0", np.nan)):
            return [*first, *aims]
        return aims or [Aim("smoothness", 0, 1.0)]

    def library(
        self, aims: Sequence[Aim], bench: Bench, design: Design
    ) -> dict[str, Goal]:
        """Goals as the library takes them, by key."""
        over = OVER[self.over]
        return {
            aim.key: Goal(
                self._measure(aim, bench, design),
                aim.target,
                aim.importance,
                aim.output,
                self._trial(aim),
                over if self.plants != "nominal" else 1.0,
                name=self.label(aim),
            )
            for aim in aims
        }

    def _trial(self, aim: Aim) -> int | None:
        """Trial of a goal: that of its output's step, or all of them."""
        if not self.by_step or self.example.model.n_y == 1 or aim.objective == "radius":
            return 0
        own = KINDS[aim.objective].stepped or aim.objective in (
            "IAE",
            "ISE",
            "distance",
        )
        return aim.output if own else None

    def _measure(self, aim: Aim, bench: Bench, design: Design) -> Any:
        if aim.objective != "distance":
            return aim.objective
        lag, a = self._first_order(aim, design)
        reference = bench.trials[self._trial(aim) or 0].scenario.reference
        return Distance(first_order(reference, self.rest, lag, a), aim.output)

    def _first_order(self, aim: Aim, design: Design) -> tuple[int, float]:
        """Find the delay of the desired response in samples, and its pole."""
        b = self.example.model.b[:, aim.output]
        dead = int(np.flatnonzero(np.abs(b).max(axis=1) > 0.0)[0]) + 1
        ahead = design.reference in ("next", "preview")
        return dead - ahead, float(np.exp(-self._dt / aim.tau))

    def factor(self, objective: str) -> float:
        """Own units in one unit that is shown."""
        kind = KINDS[objective].unit
        return {"%": 0.01, "time": self.clock[0]}.get(kind, 1.0)

    def unit(self, aim: Aim) -> str:
        """Name the unit that a row is shown in."""
        model, kind = self.example.model, KINDS[aim.objective].unit
        y = model.units.get(model.y_names[aim.output], "")
        u = model.units.get(model.u_names[0], "")
        return {
            "time": self.clock[1],
            "y": y or "-",
            "y s": f"{y}\u00b7s" if y else "s",
            "y\u00b2 s": f"{y}\u00b2\u00b7s" if y else "s",
            "u": (u or "-") if model.n_u == 1 else "-",
        }.get(kind, kind)

    def label(self, aim: Aim) -> str:
        """Words for a row."""
        kind = KINDS[aim.objective]
        one = not kind.each or self.example.model.n_y == 1
        return kind.label + (
            "" if one else f", {self.example.model.y_names[aim.output]}"
        )

    # Words and Python

    def defaults(self) -> dict[str, Any]:
        """All choices as they are when the case is chosen."""
        return {**super().defaults(), "goals": ""}

    def job(self, design: Design, aims: Sequence[Aim], bench: Bench) -> dict[str, Any]:
        """Arguments of ``tune``."""
        keys = [aim.key for aim in aims]
        for i, key in enumerate(keys):
            if key in keys[:i]:
                raise ValueError(
                    f"goals {keys.index(key) + 1} and {i + 1} measure the same: "
                    "remove one"
                )
        if all(aim.importance == 0.0 for aim in aims):
            raise ValueError(
                "all goals are hard: give one at least an importance above 0, it is "
                "what the attainment factor measures"
            )
        return {
            "design": design,
            "goals": list(self.library(aims, bench, design).values()),
            "trials": bench.trials,
            "weights": self.free(design),
            "starts": self.starts,
            "seed": self.seed,
            "evaluations": self.most,
        }

    def script_of(
        self, design: Design, aims: Sequence[Aim], gain: Array | None = None
    ) -> str:
        """Python that tunes a design to goals, or matches it to a gain."""
        lines = [*self._case_lines(), *self.design_lines("design", design), ""]
        if gain is not None:
            names = ["from nmss_lab.matching import match"]
            lines += [
                *_wrapped(f"K = {literal(gain)}"),
                "found = match(K, design)",
                "print(found.distance, found.lost)",
            ]
        else:
            names, more = self._tune_lines(design, aims)
            lines += more
        names.append("from nmss_lab.predict import Horizon")
        return "\n".join([*self._head(names), "", *lines]) + "\n"

    def design_lines(self, name: str, design: Design) -> list[str]:
        """Lines that make a design from the case's."""
        known, own = self._known, f'example.designs["{self.structure}"]'
        parts = [f"horizon=Horizon({design.horizon.Np}, {design.horizon.Nc})"]
        parts = [] if design.structure == "pip" else parts
        parts += [
            f"{letter}={literal(getattr(design, letter))}"
            for letter in ("Q", "R")
            if getattr(design, letter) is not getattr(known, letter)
        ]
        changed = ", ".join(f"{key}={text}" for key, _, text in self._own_limits())
        if changed:
            parts.append(f"limits=replace({own}.limits, {changed})")
        if design.reference != known.reference:
            parts.append(f'reference="{design.reference}"')
        if design.options.get("K") is not known.options.get("K"):
            K = literal(design.options["K"])
            parts.append(f'options={{**{own}.options, "K": {K}}}')
        lines = [line for part in parts for line in _wrapped(f"    {part},")]
        return [f"{name} = replace(", f"    {own},", *lines, ")"]

    def _tune_lines(
        self, design: Design, aims: Sequence[Aim]
    ) -> tuple[list[str], list[str]]:
        """Give imports, and lines from the trials on."""
        names, lines = self._trial_lines()
        used = ["Goal", "Trial", "tune"]
        distances = [aim for aim in aims if aim.objective == "distance"]
        if distances:
            used.append("Distance")
            names.append("from scipy.signal import lfilter")
            lines += [
                "",
                "",
                "def first_order(reference, lag, pole):",
                f"    rest = {literal(self.rest)}",
                "    b, a = [0.0] * lag + [1.0 - pole], [1.0, -pole]",
                "    return rest + lfilter(b, a, reference - rest, axis=0)",
                "",
                "",
            ]
        lines += ["goals = [", *(self._goal_line(aim, design) for aim in aims), "]"]
        free = ", ".join(f"{key}={value!r}" for key, value in self._free().items())
        lines += [
            f"weights = Weights(design, {free})",
            "",
            "tuned = tune(",
            "    design,",
            "    goals,",
            "    trials,",
            "    weights,",
            f"    starts={self.starts},",
            f"    seed={self.seed},",
            f"    evaluations={self.most},",
            ")",
            "print(tuned.attainment, tuned.stopped)",
            "for row in tuned.table():",
            "    print(row)",
        ]
        listed = ", ".join(sorted(used, key=str.lower))
        names += [
            f"from nmss_lab.tuning import {listed}",
            "from nmss_lab.weights import Weights",
        ]
        return names, lines

    def _goal_line(self, aim: Aim, design: Design) -> str:
        measure, trial = f'"{aim.objective}"', self._trial(aim)
        if aim.objective == "distance":
            lag, pole = self._first_order(aim, design)
            reference = f"trials[{trial}].scenario.reference"
            desired = f"first_order({reference}, {lag}, {pole!r})"
            measure = f"Distance({desired}, {aim.output})"
        over = OVER[self.over] if self.plants != "nominal" else 1.0
        rest = f"{aim.target!r}, {aim.importance!r}, {aim.output}, {trial}, {over!r}"
        return f"    Goal({measure}, {rest}),"

    def _trial_lines(self) -> tuple[list[str], list[str]]:
        names: list[str] = []
        lines = ["plants = example.plant"]
        if self.plants == "ranges":
            names.append(
                "from nmss_lab.uncertainty import RelativeRanges, realisations"
            )
            share = {"a": self.vary_a / 100.0, "b": self.vary_b / 100.0}
            lines = [
                f"ranges = RelativeRanges(example.model, {share!r})",
                f"draws = realisations(ranges, {self.drawn}, {self.draw_seed})",
                "plants = [example.model, *(draw.plant for draw in draws)]",
            ]
        if self.plants == "stress":
            names += [
                "from nmss_lab.cases import stress",
                "from nmss_lab.uncertainty import realisations",
            ]
            lines = [
                f"corners = stress({self.level}, True, {self._dt!r}, "
                f"{self.example.plant.substeps})",
                "plants = [draw.plant for draw in realisations(corners)]",
            ]
        if not self.by_step:
            return names, [*lines, "trials = [Trial(plants, example.scenario)]"]
        names.append("from nmss_lab.cases import piecewise")
        v = "None"
        if self.example.scenario.v is not None:
            v = f"np.tile(example.scenario.v[0], ({self.length}, 1))"
        scenario = [
            "example.scenario,",
            f"reference={literal(self.rest)} + piecewise({self.length}, (1, change)),",
            f"v={v},",
            "input_disturbance=None,",
            "output_disturbance=None,",
            "noise=None,",
            "manual=None,",
        ]
        return names, [
            *lines,
            "scenarios = [",
            "    replace(",
            *(f"        {line}" for line in scenario),
            "    )",
            f"    for change in np.diag({literal(self._sizes)})",
            "]",
            "trials = [Trial(plants, scenario) for scenario in scenarios]",
        ]

    # For the other pages

    def keep(self, tuned: Design, before: Design) -> str:
        """Keep a tuned design as a case for the other pages; return its name."""
        example = self.example
        designs = {"tuned": tuned, "before": before}
        others = {k: d for k, d in example.designs.items() if k not in designs}
        title = example.title if self.case in KEPT else f"{example.title}, tuned"
        made: Case = replace(example, title=title, designs={**designs, **others})
        imports = *self._case_imports(), "from nmss_lab.predict import Horizon"
        lines = (
            *self._case_lines(),
            *self.design_lines("tuned", tuned),
            *self.design_lines("before", before),
            'designs = {"tuned": tuned, "before": before}',
            "others = {k: d for k, d in example.designs.items() if k not in designs}",
            "example = replace(example, designs={**designs, **others})",
        )
        content = self.case + dumps(tuned) + dumps(before)
        return keep_case("tuned", content, made, Origin(imports, lines))


def first_order(reference: Array, rest: Array, lag: int, pole: float) -> Array:
    """Desired response (N, n_y) to the reference: of first order after a delay."""
    b, a = [0.0] * lag + [1.0 - pole], [1.0, -pole]
    desired: Array = rest + lfilter(b, a, reference - rest, axis=0)
    return desired


def _wrapped(line: str) -> list[str]:
    """Lines of at most 88 characters, broken between numbers."""
    indent = " " * (len(line) - len(line.lstrip()) + 4)
    return textwrap.wrap(
        line,
        88,
        subsequent_indent=indent,
        drop_whitespace=True,
        break_long_words=False,
        break_on_hyphens=False,
    )
