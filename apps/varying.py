"""Choices of the page on state-dependent plants."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import param

from apps.kept import KEPT
from apps.session import DesignChoices, known_case, literal, plain
from nmss_lab.cases import VARYING_CASES, Case, equation_case
from nmss_lab.convergence import Best, Iterate, best_plan, iterates
from nmss_lab.design import Design
from nmss_lab.predict import Horizon
from nmss_lab.sdp_mpc import SDP_STRUCTURES, Settling
from nmss_lab.simulate import Run, Scenario
from nmss_lab.state_dependent import StateDependentModel, StateDependentPlant

EQUATION = "a1", "a2", "b1", "b2", "target"
"""Choices that make the typed case."""

OWN = "own"
"""Name of the case whose equation is typed."""

PATIENCE = 10.0
"""Seconds a run may take."""

OPENS_WITH = {
    "bilinear_8_5_1": ["sdp_governor", "sdp_pip_naive", "iterated"],
    "product_8_5_2": ["frozen", "iterated", "gauss_newton"],
}

LOOKS_INTO = {"conical_tank": 92}
"""Sample looked into at first; 5, where the reference steps, in other cases."""

STARTS = 4
"""Random starts of the search for the lowest cost in a sample."""


@dataclass(frozen=True, eq=False)
class Hasty(StateDependentPlant):
    """A plant that gives up when a run takes too long."""

    until: float = np.inf

    def step(self, state: Any, u: Any, v: Any) -> Any:
        """Past one sample later.

        Raises
        ------
        ValueError
            After the time allowed.
        """
        if time.monotonic() > self.until:
            raise ValueError(
                f"this takes more than {PATIENCE:g} s: allow fewer passes, look less "
                "far ahead, or free fewer moves"
            )
        return super().step(state, u, v)


class VaryingChoices(DesignChoices):
    """Choices of the page on state-dependent control."""

    a1 = param.String("-0.9 + 0.1*y[k-1]**2", label="a1", doc="Multiplies y[k-1].")
    a2 = param.String("0", label="a2", doc="Multiplies y[k-2].")
    b1 = param.String("0.3 + 0.2*y[k-1]", label="b1", doc="Multiplies u[k-1].")
    b2 = param.String("0", label="b2", doc="Multiplies u[k-2].")
    target = param.Number(
        1.5,
        bounds=(-100.0, 100.0),
        label="Reference from sample 5 on",
        doc="Before it, the reference is the output at the start.",
    )
    Np = param.Integer(
        10,
        bounds=(1, 40),
        label="Prediction horizon Np",
        doc="Number of samples Np over which the controller predicts.",
    )
    damping = param.Number(
        0.5,
        bounds=(0.0, 0.95),
        step=0.05,
        label="Damping",
        doc="Share of a step that 'Iterated' leaves out; 0 is Algorithm 8.3.1.",
    )
    tolerance = param.Number(
        1e-6,
        bounds=(1e-12, 1e-1),
        label="Tolerance",
        doc="Change of the plan that counts as settled, relative to 1 + its size.",
    )
    passes = param.Integer(
        40,
        bounds=(1, 100),
        label="Most passes a sample",
        doc="Programs that may be solved before the best plan so far is taken.",
    )
    warm_start = param.Selector(
        default="last plan",
        objects=["last plan", "frozen model"],
        label="First plan of a sample",
        doc="The last plan shifted by a sample, or the frozen model's optimum.",
    )
    y_start = param.Number(
        0.0,
        bounds=(-1.0, 1.0),
        label="Output at the start",
        doc="Initial condition y0.",
    )
    u_start = param.Number(
        0.0, bounds=(-1.0, 1.0), label="Input at the start", doc="Initial condition u0."
    )
    inside = param.Integer(
        5,
        bounds=(0, 200),
        label="Sample looked into",
        doc="The lower plots show every pass of this sample.",
    )

    scale: ClassVar[dict[str, str]] = {**DesignChoices.scale, "tolerance": "log"}
    when: ClassVar[dict[str, tuple[str, str]]] = {
        **DesignChoices.when,
        **dict.fromkeys(EQUATION, ("case", OWN)),
    }
    groups: ClassVar[dict[str, tuple[str, ...]]] = {
        "Case": ("case", *EQUATION, "structures", "output", "input", "inside"),
        "Settling": ("damping", "tolerance", "passes", "warm_start"),
        "Design": ("Np", "Nc", "weight_y", "weight_move"),
        "Limits": ("limit_u", "u_max", "limit_du", "du_max", "limit_y", "y_max"),
        "Start and disturbances": ("y_start", "u_start", "step_u", "step_y", "step_at"),
    }
    default_case: ClassVar[str] = "product_8_5_2"
    makes: ClassVar[str] = "state_dependent"
    of_design: ClassVar[tuple[str, ...]] = (
        *EQUATION,
        *groups["Settling"],
        *groups["Design"],
        *groups["Limits"],
    )

    def __init__(self, **values: Any) -> None:
        self._own = _own_case(*(type(self).param[key].default for key in EQUATION))
        self._kept: tuple[Any, dict[str, Run]] = (None, {})
        super().__init__(**values)

    @classmethod
    def cases(cls) -> list[str]:
        """Cases of state-dependent plants, and the typed one."""
        return [*VARYING_CASES, OWN]

    def _case_of(self, name: str) -> Case:
        return self._own if name == OWN else known_case(name)

    @property
    def example(self) -> Case:
        """The chosen case; of a typed one the last equation that could be read."""
        return self._case_of(self.case)

    def take_case(self, name: str) -> None:
        """Choose a case and put every other choice where the case has it."""
        if name == OWN:
            self._own = _own_case(*(type(self).param[key].default for key in EQUATION))
        example = self._case_of(name)
        for key in ("y_start", "u_start"):
            self.param[key].bounds = (None, None)
        super().take_case(name)
        self._offer(example.designs)
        self.structures = OPENS_WITH.get(name) or _first_three(example)
        self._fit(example)

    def _fit(self, example: Case) -> None:
        """Put horizons, starting values and their ranges where the case has them."""
        design = self._main_design
        self.Np, self.Nc = design.horizon.Np, min(design.horizon.Nc, 20)
        last = len(example.scenario) - 1
        self.param["inside"].bounds = (0, last)
        self.inside = min(LOOKS_INTO.get(example.name, 5), last)
        self.output = example.model.n_y - 1
        settling = _settling(design)
        self.passes = min(settling.passes, 40)  # shipped cases answer quickly
        if example.name in KEPT:  # what was opened is shown as it is
            self.passes = settling.passes
            self.damping, self.tolerance = settling.damping, settling.tolerance
            self.warm_start = "last plan" if settling.warm_start else "frozen model"
        scenario = example.scenario
        for key, value, size in (
            ("y_start", scenario.y0, np.ptp(scenario.reference[:, -1])),
            ("u_start", scenario.u0, 0.0),
        ):
            start = float(np.ravel(0.0 if value is None else value)[-1])
            reach = float(max(size, 0.5 * abs(start), 0.1))
            self.param[key].bounds = (start - reach, start + reach)
            self.param[key].step = reach / 50.0
            setattr(self, key, start)

    @property
    def _main_design(self) -> Design:
        designs = self.example.designs
        first = next(iter(designs.values()))
        return first if self.case in KEPT else designs.get("iterated", first)

    def accept(self, values: Mapping[str, Any]) -> None:
        """Take over values; an equation that cannot be read leaves the last one.

        Raises
        ------
        ValueError
            As ``Choices.accept``, or if the equation cannot be read.
        """
        if values.get("case", self.case) != self.case:
            self._welcome(values["case"])
            self.take_case(values["case"])
        if self.case == OWN:
            values = self._with_equation(values)
        self.put({key: value for key, value in values.items() if key != "case"})

    def _with_equation(self, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Take over the equation; return the values that are still meant."""
        self.put({key: values[key] for key in EQUATION if key in values})
        before, self._own = self._own, _own_case(*(getattr(self, k) for k in EQUATION))
        if self._own is before:
            return values
        inside = self.inside
        self._fit(self._own)
        self.inside = inside
        # a start that was the old equation's rest makes room for the new one's
        stale = {"y_start": before.scenario.y0, "u_start": before.scenario.u0}
        return {
            key: value
            for key, value in values.items()
            if key not in EQUATION
            and not (key in stale and np.isclose(float(value), stale[key]))
        }

    def _read(self, key: str, value: Any) -> Any:
        is_text = key in EQUATION and isinstance(self.param[key], param.String)
        return str(value) if is_text else super()._read(key, value)

    def _item(self, key: str) -> dict[str, Any]:
        parameter = self.param[key]
        if not isinstance(parameter, param.String):
            return super()._item(key)
        item = {"name": key, "label": parameter.label, "help": parameter.doc}
        return {**item, "when": self.when.get(key), "kind": "text", "longest": 200}

    def _word(self, key: str, name: str) -> str:
        if key == "case" and name == OWN:
            return "Your own equation"
        return super()._word(key, name)

    # From choices to runs

    def _changed(self, design: Design) -> Design:
        design = replace(design, limits=self.limits(design.limits))
        if design.structure == "sdp_governor":
            return replace(design, horizon=Horizon(self.Np, self.Np))
        if design.structure not in SDP_STRUCTURES:
            return design
        settling = replace(
            _settling(design),
            damping=self.damping,
            tolerance=self.tolerance,
            passes=self.passes,
            warm_start=self.warm_start == "last plan",
        )
        return replace(
            design,
            horizon=Horizon(self.Np, self.Nc),
            Q=self.weight_y * np.asarray(design.Q),
            R=self.weight_move * np.asarray(design.R),
            options={**design.options, "settling": settling},
        )

    def plant(self) -> Any:
        """Plant of the case, which gives up after a while."""
        model = self.example.equation
        assert model is not None
        return Hasty(model, until=time.monotonic() + PATIENCE)

    def _as_data(self) -> Any:
        return self.example.plant

    def scenario(self) -> Scenario:
        """Scenario of the case from the chosen start, with the chosen disturbances."""
        scenario = super().scenario()
        y0 = np.array(np.broadcast_to(scenario.y0, (self.example.model.n_y,)), float)
        y0[-1] = self.y_start
        manual = scenario.manual
        if manual is not None:
            manual = np.where(np.isfinite(manual), self.u_start, np.nan)
        return replace(scenario, y0=y0, u0=self.u_start, manual=manual)

    def runs(self) -> dict[str, Run]:
        """Run every design, unless nothing but the sample looked into has changed."""
        key = {k: str(v) for k, v in self.values().items() if k not in NOT_RUN}
        if self._kept[0] != key:
            self._kept = key, super().runs()
        return self._kept[1]

    def passes_inside(self) -> tuple[dict[str, list[Iterate]], Best, Run]:
        """Repeat the passes of the sample looked into, and find the best plan there.

        Where no chosen controller settles predictions, one that does is run for it.
        """
        able = {
            name: run
            for (name, run), design in zip(
                self.runs().items(), self.designs().values(), strict=True
            )
            if design.structure in SDP_STRUCTURES
        } or self._iterated_alone()
        last = list(able.values())[-1]
        k = self.inside
        with np.errstate(all="ignore"):
            passes = {plain(name): iterates(run, k) for name, run in able.items()}
            return passes, best_plan(last, k, STARTS), last

    def _iterated_alone(self) -> dict[str, Run]:
        design = self._changed(self.example.designs["iterated"])
        run = self._run("iterated", design, self.plant(), self.scenario())
        return {"iterated, not in the plots above": run}

    # The same as Python

    def _plant_lines(self) -> list[str]:
        return ["plant = example.plant"]

    def _changed_lines(self) -> list[str]:
        return [
            "    designs[name] = design = replace(design, limits=limits)",
            '    if design.structure == "sdp_governor":',
            f"        horizon = Horizon({self.Np}, {self.Np})",
            "        designs[name] = replace(design, horizon=horizon)",
            '    if "settling" in design.options:',
            "        settling = replace(",
            '            design.options["settling"],',
            f"            damping={self.damping!r},",
            f"            tolerance={self.tolerance!r},",
            f"            passes={self.passes!r},",
            f"            warm_start={self.warm_start == 'last plan'},",
            "        )",
            "        designs[name] = replace(",
            "            design,",
            f"            horizon=Horizon({self.Np}, {self.Nc}),",
            f"            Q={self.weight_y!r} * np.asarray(design.Q),",
            f"            R={self.weight_move!r} * np.asarray(design.R),",
            '            options={**design.options, "settling": settling},',
            "        )",
        ]

    def _case_imports(self) -> tuple[str, ...]:
        if self.case != OWN:
            return super()._case_imports()
        return (
            "from nmss_lab.cases import equation_case",
            "from nmss_lab.state_dependent import StateDependentModel",
        )

    def _case_lines(self) -> list[str]:
        if self.case != OWN:
            return super()._case_lines()
        equation = self.example.equation
        assert equation is not None
        a = [entry for ((entry,),) in equation.a]
        b = [entry for ((entry,),) in equation.b]
        return [
            f"model = StateDependentModel({a!r}, {b!r})",
            f"example = equation_case(model, {self.target!r})",
        ]

    def _scenario_lines(self) -> list[str]:
        first, *others = super()._scenario_lines()
        scenario = self.scenario()
        start = f"y0={literal(np.ravel(scenario.y0))}, u0={self.u_start!r}"
        lines = [first, f"scenario = replace(scenario, {start})"]
        if scenario.manual is not None:
            by_hand = "np.isfinite(scenario.manual)"
            lines += [
                f"manual = np.where({by_hand}, {self.u_start!r}, np.nan)",
                "scenario = replace(scenario, manual=manual)",
            ]
        return [*lines, *others]


NOT_RUN = "inside", "output", "input"
"""Choices that no run depends on."""


@functools.lru_cache(maxsize=64)
def _own_case(a1: str, a2: str, b1: str, b2: str, target: float) -> Case:
    a, b = ([text.strip() or "0" for text in pair] for pair in ((a1, a2), (b1, b2)))
    a, b = ([first] if second == "0" else [first, second] for first, second in (a, b))
    return equation_case(StateDependentModel(a, b), target)


def _first_three(example: Case) -> list[str]:
    """Structures a case opens with: three schemes, a design of one's own first."""
    first = next(iter(example.designs))
    others = [name for name in ("frozen", "iterated", "gauss_newton") if name != first]
    return [first, *others][:3]


def _settling(design: Design) -> Settling:
    settling = design.options.get("settling", Settling())
    assert isinstance(settling, Settling)
    return settling
