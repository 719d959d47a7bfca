"""Choices of a session, and the runs and the Python that belong to them.

Each page has one class of choices with bounds and help.  ``runs`` and ``script`` are
made from the same lines: what the page shows is what its script prints.
"""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
import param

from nmss_lab.cases import LINEAR_CASES, Case, case, model_case, piecewise
from nmss_lab.controller import Limits
from nmss_lab.design import Design
from nmss_lab.files import dumps
from nmss_lab.identify import Estimate
from nmss_lab.models import LinearPlant
from nmss_lab.mpc import STRUCTURES
from nmss_lab.predict import Horizon
from nmss_lab.simulate import Run, Scenario, closed_loop

DIVERGED = 1e9
"""Outputs beyond this are not drawn: the loop is unstable."""

MOST_RUNS = 3

OPENS_WITH = {
    "ifac93_6_3_3": ("wang_young", "forward_path"),
    "marginally_stable_6_3_2": ("wang_young", "forward_path"),
    "shell_5_3_2": ("wang_young", "integral_of_error_b"),
}
"""Structures that cases of chapters 5 and 6 compare."""


@functools.cache
def _worked_case(name: str) -> Case:
    return case(name)


def known_case(name: str) -> Case:
    """Build a case once; cases are immutable.  Kept ones are cases as well."""
    return KEPT[name] if name in KEPT else _worked_case(name)


KEPT: dict[str, Case] = {}
"""Cases that pages made and sent to others, by name, the latest last."""

ORIGINS: dict[str, Origin] = {}
"""Python that makes each of them."""

MOST_KEPT = 200

GONE = {
    "model": "its model is no longer kept",
    "tuned": "its tuned design is no longer kept",
    "drawn": "its plant is no longer kept",
}
"""What a kept case is about, by the beginning of its name."""


class Origin(NamedTuple):
    """Python of a kept case: what it imports, and lines that make ``example``."""

    imports: tuple[str, ...]
    lines: tuple[str, ...]


def keep_case(kind: str, content: str, example: Case, origin: Origin) -> str:
    """Keep a case for the other pages; return its name, the same for equal content.

    ``kind`` is a key of ``GONE``.
    """
    name = f"{kind}-{hashlib.sha256(content.encode()).hexdigest()[:12]}"
    KEPT.setdefault(name, replace(example, name=name))
    ORIGINS[name] = origin
    while len(KEPT) > MOST_KEPT:
        oldest = next(iter(KEPT))
        del KEPT[oldest], ORIGINS[oldest]
    return name


def keep_model(estimate: Estimate) -> str:
    """Keep an identified model for the other pages; return the name of its case."""
    example = model_case(estimate.to_model(), estimate.covariance, "model")
    origin = Origin(
        (
            "from nmss_lab.cases import model_case",
            "from nmss_lab.files import load",
        ),
        (
            "# model.json: saved on the page Identify",
            'found = load("model.json")',
            "example = model_case(found.to_model(), found.covariance)",
        ),
    )
    return keep_case("model", dumps(estimate), example, origin)


def plain(name: str) -> str:
    """Name of a design or case in words."""
    special = {
        "pip": "PIP",
        "pip_forward": "PIP, forward path",
        "wang_young": "Wang-Young",
        "integral_of_error": "Integral of error",
        "integral_of_error_b": "Integral of error, weights b",
        "disturbance_direct": "Disturbance, direct",
        "disturbance_augmented": "Disturbance, augmented",
        "gauss_newton": "Gauss-Newton",
        "sdp_pip": "PIP, gain per sample",
        "sdp_pip_naive": "PIP, naive increments",
        "sdp_governor": "PIP with governor",
        "tuned": "Tuned",
        "before": "Before tuning",
    }
    scheme = name.removeprefix("integral_")
    if scheme in ("frozen", "iterated", "gauss_newton", "newton") and scheme != name:
        return f"{plain(scheme)}, integral of error"
    return special.get(name, name.replace("_", " ").capitalize())


class Form(param.Parameterized):
    """Choices that a form shows: labels, help, bounds, groups."""

    scale: ClassVar[dict[str, str]] = {}
    when: ClassVar[dict[str, tuple[str, Any]]] = {}
    """For a choice, another one and the value, or values, with which it counts."""
    groups: ClassVar[dict[str, tuple[str, ...]]] = {}
    fields: ClassVar[tuple[str, ...]] = ()
    """Numbers that are typed."""

    @classmethod
    def names(cls) -> list[str]:
        """Names of all choices, in the order in which a page shows them."""
        return [key for keys in cls.groups.values() for key in keys]

    def values(self) -> dict[str, Any]:
        """All choices, as plain data."""
        return {key: getattr(self, key) for key in self.names()}

    def put(self, values: Mapping[str, Any]) -> None:
        """Take over values that came from outside, as far as they are allowed.

        Raises
        ------
        ValueError
            Naming the first choice that is not, and what was expected; the others
            are taken.
        """
        wrong = ""
        for key in (key for key in values if key in self.names()):
            try:
                setattr(self, key, self._read(key, values[key]))
            except (ValueError, TypeError) as error:
                wrong = wrong or f"{key} = {values[key]!r}: {_short(error)}"
        if wrong:
            raise ValueError(wrong)

    def _read(self, key: str, value: Any) -> Any:
        """Value of a choice, also from the text of an address."""
        parameter = self.param[key]
        if isinstance(parameter, param.ListSelector):
            return _parts(value) if isinstance(value, str) else list(value)
        if isinstance(parameter, param.Integer):
            return int(value)
        if isinstance(parameter, param.Number):
            return float(value)
        return value

    def description(self) -> list[dict[str, Any]]:
        """Describe groups of controls: what a form needs to show each choice."""
        return [
            {"title": title, "items": [self._item(k) for k in keys if self._shown(k)]}
            for title, keys in self.groups.items()
        ]

    def _shown(self, key: str) -> bool:
        return True

    def _item(self, key: str) -> dict[str, Any]:
        parameter = self.param[key]
        item = {"name": key, "label": parameter.label, "help": parameter.doc}
        item["when"] = self.when.get(key)
        if isinstance(parameter, param.ListSelector):
            options = [[name, self._word(key, name)] for name in parameter.objects]
            return {**item, "kind": "several", "options": options, "most": MOST_RUNS}
        if isinstance(parameter, param.Selector):
            return {**item, "kind": "one", "options": self._options(key)}
        low, high = parameter.bounds
        step = parameter.step or (1 if isinstance(parameter, param.Integer) else None)
        kind = "log" if self.scale.get(key) == "log" else "linear"
        kind = "number" if key in self.fields else kind
        return {**item, "kind": kind, "low": low, "high": high, "step": step}

    def _options(self, key: str) -> list[list[str]]:
        return [[name, self._word(key, name)] for name in self.param[key].objects]

    def _word(self, key: str, name: str) -> str:
        return plain(name)


class Choices(Form):
    """What both pages share: case, limits, plant against model, disturbances."""

    case = param.Selector(
        label="Case", doc="A worked example: plant, model, weights and scenario."
    )
    output = param.Integer(
        0, bounds=(0, 11), label="Output shown", doc="Which output y the plots show."
    )
    input = param.Integer(
        0, bounds=(0, 11), label="Input shown", doc="Which input u the plots show."
    )
    Np = param.Integer(
        20,
        bounds=(1, 80),
        label="Prediction horizon Np",
        doc="Number of samples Np over which the controller predicts; weights given "
        "along the horizon keep their own.",
    )
    limit_u = param.Selector(
        default="case",
        objects=["case", "off", "own"],
        label="Limits on the input u",
        doc="Lowest and highest value of u: those of the case, none, or your own.",
    )
    u_max = param.Number(
        1.0,
        bounds=(0.01, 1000.0),
        label="Input between plus and minus",
        doc="Your own limit on u, used when 'own' is chosen.",
    )
    limit_du = param.Selector(
        default="case",
        objects=["case", "off", "own"],
        label="Limits on the change du",
        doc="How much u may change in one sample.",
    )
    du_max = param.Number(
        1.0,
        bounds=(0.01, 1000.0),
        label="Change between plus and minus",
        doc="Your own limit on du, used when 'own' is chosen.",
    )
    limit_y = param.Selector(
        default="case",
        objects=["case", "off", "own"],
        label="Limits on the output y",
        doc="Output limits give way where they cannot be kept.",
    )
    y_max = param.Number(
        1.0,
        bounds=(0.01, 1000.0),
        label="Output between plus and minus",
        doc="Your own limit on y, used when 'own' is chosen.",
    )
    gain = param.Number(
        0.0,
        bounds=(-50.0, 50.0),
        step=1.0,
        label="Gain of the plant, per cent off",
        doc="The plant's gain against the model's; the controller does not know.",
    )
    dynamics = param.Number(
        0.0,
        bounds=(-20.0, 20.0),
        step=0.5,
        label="Dynamics of the plant, per cent off",
        doc="Slower (+) or faster (-) plant; for a difference equation its "
        "coefficients a are multiplied, as in (6.11).",
    )
    step_u = param.Number(
        0.0,
        bounds=(-1.0, 1.0),
        label="Step disturbance at the input",
        doc="Added to the input u of the plant, not measured.",
    )
    step_y = param.Number(
        0.0,
        bounds=(-1.0, 1.0),
        label="Step disturbance at the output",
        doc="Added to the output y of the plant, not measured.",
    )
    step_at = param.Integer(
        50,
        bounds=(0, 100),
        label="Time of the step, per cent of the run",
        doc="When both disturbances set in.",
    )

    scale: ClassVar[dict[str, str]] = {"u_max": "log", "du_max": "log", "y_max": "log"}
    when: ClassVar[dict[str, tuple[str, Any]]] = {
        f"{key}_max": (f"limit_{key}", "own") for key in ("u", "du", "y")
    }
    groups: ClassVar[dict[str, tuple[str, ...]]] = {}
    default_case: ClassVar[str] = ""

    def __init__(self, **values: Any) -> None:
        super().__init__()
        self.param["case"].objects = self.cases()
        self.take_case(self.default_case)
        self.accept(values)

    @classmethod
    def cases(cls) -> list[str]:
        """Cases that this page can show."""
        return list(LINEAR_CASES)

    @property
    def example(self) -> Case:
        """The chosen case."""
        return self._case_of(self.case)

    def _case_of(self, name: str) -> Case:
        return known_case(name)

    def take_case(self, name: str) -> None:
        """Choose a case and put every other choice where the case has it."""
        example = self._case_of(name)
        for key, parameter in self.param.objects("existing").items():
            if key not in ("name", "case"):
                setattr(self, key, parameter.default)
        self.case = name
        for key, size in (("output", example.model.n_y), ("input", example.model.n_u)):
            self.param[key].bounds = (0, size - 1)
        scenario = example.scenario
        r = _largest(scenario.reference, scenario.output_disturbance)
        u = _largest(*_finite_sides(self._main_design.limits.u), scenario.u0)
        for key, size in (("step_y", r), ("step_u", u)):
            size = _round_number(size)
            self.param[key].bounds, self.param[key].step = (-size, size), size / 50
        limits = self._main_design.limits
        for key, sides in (
            ("u_max", limits.u),
            ("du_max", limits.du),
            ("y_max", limits.y),
        ):
            finite = _finite_sides(sides)
            setattr(self, key, min(max(_largest(*finite), 0.01), 1000.0))

    @property
    def _main_design(self) -> Design:
        return next(iter(self.example.designs.values()))

    def accept(self, values: Mapping[str, Any]) -> None:
        """Take over values that came from outside, as far as they are allowed.

        Raises
        ------
        ValueError
            Naming the first choice that is not, and what was expected; the others
            are taken.
        """
        if "case" in values and values["case"] != self.case:
            self._welcome(values["case"])
            self.take_case(values["case"])
        self.put({key: value for key, value in values.items() if key != "case"})

    def _welcome(self, name: str) -> None:
        """Let in a case, one of a kept model among them.

        Raises
        ------
        ValueError
            If there is no such case, or no longer.
        """
        known = self.param["case"].objects
        if name in KEPT and name not in known:
            self.param["case"].objects = [*known, name]
        elif name not in known:
            gone = GONE.get(str(name).partition("-")[0])
            why = f"; {gone}" if gone and "-" in str(name) else ""
            raise ValueError(f"case = {name!r}: there is no such case here{why}")

    def defaults(self) -> dict[str, Any]:
        """All choices as they are when the case is chosen."""
        fresh = type(self)()
        fresh.take_case(self.case)
        return {**fresh.values(), "case": self.default_case}

    def _shown(self, key: str) -> bool:
        model = self.example.model
        drawn = self.case.startswith("drawn-")  # its plant is one of a kind
        return not (
            (key == "output" and model.n_y == 1)
            or (key == "input" and model.n_u == 1)
            or (key == "dynamics" and drawn)
        )

    def _item(self, key: str) -> dict[str, Any]:
        item = super()._item(key)
        if key not in ("output", "input"):
            return item
        model = self.example.model
        names = model.y_names if key == "output" else model.u_names
        return {**item, "kind": "one", "options": [[i, n] for i, n in enumerate(names)]}

    def _word(self, key: str, name: str) -> str:
        if key == "case":
            return _case_title(known_case(name))
        if key == "structures":
            return plain(name)
        return {"case": "as in the case", "off": "none"}.get(name, name)

    # From choices to runs. Every line here has its twin in ``script``.

    def plant(self) -> LinearPlant:
        """Plant of the case, changed against the model as chosen."""
        example, plant = self.example, self.example.plant
        if self.dynamics and example.continuous is not None:
            slower = 1.0 + self.dynamics / 100.0
            plant = example.continuous.sampled(plant.dt / slower, plant.substeps)
            between = plant.between and replace(
                plant.between, times=plant.between.times * slower
            )
            plant = replace(plant, dt=example.plant.dt, between=between)
        elif self.dynamics:
            factor = 1.0 + self.dynamics / 100.0
            plant = example.model.varied(denominator=factor).plant()
        if self.gain:
            factor = 1.0 + self.gain / 100.0
            between = plant.between and replace(
                plant.between, B=factor * plant.between.B
            )
            plant = replace(plant, B=factor * plant.B, between=between)
        return plant

    def limits(self, limits: Limits) -> Limits:
        """Limits of a design, replaced as chosen."""
        return replace(limits, **{key: sides for key, sides, _ in self._own_limits()})

    def _own_limits(self) -> list[tuple[str, tuple[float, float], str]]:
        """Limits that differ from the case's: name, sides and their Python."""
        found = []
        for key in ("u", "du", "y"):
            kind, size = getattr(self, f"limit_{key}"), getattr(self, f"{key}_max")
            if kind == "off":
                found.append((key, (-np.inf, np.inf), "(-np.inf, np.inf)"))
            elif kind == "own":
                found.append((key, (-size, size), f"({-size!r}, {size!r})"))
        return found

    def scenario(self) -> Scenario:
        """Scenario of the case with the chosen disturbances."""
        scenario, model, N = self.example.scenario, self.example.model, self._samples
        if self.step_u:
            step = piecewise(
                N, (self._first, np.eye(model.n_u)[self.input] * self.step_u)
            )
            before = scenario.of("input_disturbance", model.n_u)
            scenario = replace(scenario, input_disturbance=before + step)
        if self.step_y:
            change = np.eye(model.n_y)[self.output] * self.step_y
            step = piecewise(N, (self._first, change))
            before = scenario.of("output_disturbance", model.n_y)
            scenario = replace(scenario, output_disturbance=before + step)
        return scenario

    @property
    def _samples(self) -> int:
        return len(self.example.scenario)

    @property
    def _first(self) -> int:
        return min(round(self.step_at / 100.0 * self._samples), self._samples - 1)

    def designs(self) -> dict[str, Design]:
        """Designs to run, by name."""
        raise NotImplementedError

    def runs(self) -> dict[str, Run]:
        """Run every design.

        Raises
        ------
        ValueError
            If a design cannot be built, or its loop diverges; says which and why.
        """
        plant, scenario = self.plant(), self.scenario()
        return {
            name: self._run(name, design, plant, scenario)
            for name, design in self.designs().items()
        }

    def _run(
        self, name: str, design: Design, plant: LinearPlant, scenario: Scenario
    ) -> Run:
        try:
            controller = design.build()
            with np.errstate(all="ignore"):
                run = closed_loop(plant, controller, scenario)
        except (ValueError, np.linalg.LinAlgError) as error:
            raise ValueError(f"{plain(name)}: {error}") from error
        if not np.abs(run.y).max() < DIVERGED:
            raise ValueError(
                f"{plain(name)}: the loop is unstable, its output grows beyond "
                f"{DIVERGED:g}. Try the plant nearer to the model, or wider limits."
            )
        return run

    def script(self) -> str:
        """Python that computes what the page shows and prints its measures."""
        lines = [
            *self._head(_SCRIPT_IMPORTS),
            "",
            *self._case_lines(),
            *self._plant_lines(),
            *self._scenario_lines(),
            "",
            *self._design_lines(),
            "",
            f"for row in table(runs, channel={self.output}):",
            "    print(row)",
        ]
        return "\n".join(lines) + "\n"

    def _head(self, imports: Iterable[str]) -> list[str]:
        """First lines of a script: what it imports, and what its case needs."""
        return head([*imports, *self._case_imports()])

    def _case_imports(self) -> tuple[str, ...]:
        """Say what ``_case_lines`` import."""
        if self.case not in KEPT:
            return ("from nmss_lab.cases import case",)
        return ORIGINS[self.case].imports

    def _case_lines(self) -> list[str]:
        if self.case not in KEPT:
            return [f'example = case("{self.case}")']
        return list(ORIGINS[self.case].lines)

    def _plant_lines(self) -> list[str]:
        lines = ["plant = example.plant"]
        if self.dynamics and self.example.continuous is not None:
            lines += [
                f"slower = 1.0 + {self.dynamics!r} / 100.0",
                "plant = example.continuous.sampled("
                f"plant.dt / slower, {self.example.plant.substeps})",
                "between = plant.between and replace(",
                "    plant.between, times=plant.between.times * slower",
                ")",
                "plant = replace(plant, dt=example.plant.dt, between=between)",
            ]
        elif self.dynamics:
            lines += [
                f"factor = 1.0 + {self.dynamics!r} / 100.0",
                "plant = example.model.varied(denominator=factor).plant()",
            ]
        if self.gain:
            lines += [
                f"factor = 1.0 + {self.gain!r} / 100.0",
                "between = plant.between and replace(",
                "    plant.between, B=factor * plant.between.B",
                ")",
                "plant = replace(plant, B=factor * plant.B, between=between)",
            ]
        return lines

    def _scenario_lines(self) -> list[str]:
        lines, model = ["scenario = example.scenario"], self.example.model
        for name, size, channel, value in (
            ("input_disturbance", model.n_u, self.input, self.step_u),
            ("output_disturbance", model.n_y, self.output, self.step_y),
        ):
            if value:
                change = f"np.eye({size})[{channel}] * {value!r}"
                lines += [
                    f"step = piecewise({self._samples}, ({self._first}, {change}))",
                    f'before = scenario.of("{name}", {size})',
                    f"scenario = replace(scenario, {name}=before + step)",
                ]
        return lines

    def _limit_lines(self) -> list[str]:
        """Lines that change ``limits`` inside the loop of a script."""
        own = ", ".join(f"{key}={text}" for key, _, text in self._own_limits())
        return [f"    limits = replace(limits, {own})"] if own else []

    def _design_lines(self) -> list[str]:
        raise NotImplementedError


class DesignChoices(Choices):
    """What pages share whose controllers predict: which, how far, and at what price."""

    structures = param.ListSelector(
        default=[],
        label="Structures",
        doc="Up to three controllers of this case, side by side.",
    )
    Nc = param.Integer(
        5,
        bounds=(1, 30),
        label="Control horizon Nc",
        doc="Number of moves Nc that are free; after them the input rests.",
    )
    weight_y = param.Number(
        1.0,
        bounds=(1e-3, 1e3),
        label="Output weight, times the case's Q",
        doc="More makes the outputs follow more tightly (Q).",
    )
    weight_move = param.Number(
        1.0,
        bounds=(1e-3, 1e3),
        label="Move weight, times the case's R",
        doc="More makes the inputs calmer (R).",
    )

    scale: ClassVar[dict[str, str]] = {
        **Choices.scale,
        "weight_y": "log",
        "weight_move": "log",
    }

    def designs(self) -> dict[str, Design]:
        """Chosen structures with the chosen horizons, weights and limits."""
        if not 1 <= len(self.structures) <= MOST_RUNS:
            raise ValueError(
                f"structures: {len(self.structures)} chosen, expected 1 to {MOST_RUNS}"
            )
        known, offered = self.example.designs, self.param["structures"].objects
        for name in self.structures:
            if name not in known:
                raise ValueError(
                    f"structures: this case has no {name!r}; it has "
                    f"{', '.join(offered)}"
                )
        return {name: self._changed(known[name]) for name in self.structures}

    def _changed(self, design: Design) -> Design:
        raise NotImplementedError


class LoopChoices(DesignChoices):
    """Choices of the page on the receding horizon."""

    reading = param.Selector(
        default="case",
        objects=["case", "held", "next", "preview", "zero"],
        label="Reading of the reference",
        doc="What the plan knows of r ahead: r_k held, r_(k+1) held, the true future, "
        "or nothing (S = 0).",
    )

    groups: ClassVar[dict[str, tuple[str, ...]]] = {
        "Case": ("case", "structures", "output", "input"),
        "Design": ("Np", "Nc", "weight_y", "weight_move", "reading"),
        "Limits": ("limit_u", "u_max", "limit_du", "du_max", "limit_y", "y_max"),
        "Plant and disturbances": ("gain", "dynamics", "step_u", "step_y", "step_at"),
    }
    default_case: ClassVar[str] = "ifac93_6_3_3"

    def take_case(self, name: str) -> None:
        """Choose a case: its predictive designs, and the horizons of the first."""
        designs = known_case(name).designs
        predictive = [key for key, d in designs.items() if d.structure in STRUCTURES]
        self.structures, self.param["structures"].objects = [], predictive
        self._predictive = predictive
        super().take_case(name)
        self.structures = list(OPENS_WITH.get(name) or _first_choice(predictive))
        horizon = self._main_design.horizon
        self.Np, self.Nc = horizon.Np, horizon.Nc

    @property
    def _main_design(self) -> Design:
        return known_case(self.case).designs[_first_choice(self._predictive)[0]]

    def _changed(self, design: Design) -> Design:
        reading = design.reference if self.reading == "case" else self.reading
        return replace(
            design,
            horizon=self._horizon(design),
            Q=self.weight_y * np.asarray(design.Q),
            R=self.weight_move * np.asarray(design.R),
            limits=self.limits(design.limits),
            reference=reading,
        )

    def _horizon(self, design: Design) -> Horizon:
        """Choose the horizons; weights given along the horizon keep theirs."""
        single = design.model.n_y == 1
        along = single and np.ndim(design.Q) == 1 and np.size(design.Q) > 1
        along = along or 3 in (np.ndim(design.Q), np.ndim(design.R))
        return design.horizon if along else Horizon(self.Np, self.Nc)

    def _horizon_lines(self) -> tuple[list[str], str]:
        """Lines before the loop of a script, and the horizon inside it."""
        chosen = f"Horizon({self.Np}, {self.Nc})"
        designs = {name: self.example.designs[name] for name in self.structures}
        own = ", ".join(
            f'"{name}": Horizon({design.horizon.Np}, {design.horizon.Nc})'
            for name, design in designs.items()
            if self._horizon(design) is design.horizon
        )
        if not own:
            return [], chosen
        return [f"own = {{{own}}}"], f"own.get(name, {chosen})"

    def _design_lines(self) -> list[str]:
        loop = "closed_loop(plant, design.build(), scenario)"
        return self._lines_for_designs("runs", loop)

    def _lines_for_designs(self, collected: str, value: str) -> list[str]:
        """Lines that make each ``design`` and collect a value of it by its name."""
        before, horizon = self._horizon_lines()
        reading = (
            [] if self.reading == "case" else [f'        reference="{self.reading}",']
        )
        return [
            *before,
            f"{collected} = {{}}",
            f"for name in {list(self.structures)!r}:",
            "    design = example.designs[name]",
            "    limits = design.limits",
            *self._limit_lines(),
            "    design = replace(",
            "        design,",
            f"        horizon={horizon},",
            f"        Q={self.weight_y!r} * np.asarray(design.Q),",
            f"        R={self.weight_move!r} * np.asarray(design.R),",
            "        limits=limits,",
            *reading,
            "    )",
            f"    {collected}[name] = {value}",
        ]


class GovernorChoices(Choices):
    """Choices of the page on the reference governor."""

    timing = param.Selector(
        default="held",
        objects=["held", "preview"],
        label="Knowledge of the reference",
        doc="'held': w_k is chosen from r_k; 'preview': w_(k+1) from the true future, "
        "as printed in (3.12).",
    )
    reading = param.Selector(
        default="free",
        objects=["free", "zero after step s", "decaying"],
        label="Perturbation beta over the horizon",
        doc="The three readings of section 3.3.",
    )
    free_until = param.Integer(
        5,
        bounds=(1, 80),
        label="Step s",
        doc="Last step at which beta is free, when 'zero after step s' is chosen.",
    )
    decay = param.Number(
        0.8,
        bounds=(0.05, 1.0),
        step=0.05,
        label="Decay",
        doc="Factor by which beta shrinks a step, when 'decaying' is chosen.",
    )
    reference = param.Number(
        1.0,
        bounds=(0.1, 3.0),
        step=0.05,
        label="Size of the reference, times the case's",
        doc="Larger steps of r bring the loop closer to its limits.",
    )

    when: ClassVar[dict[str, tuple[str, Any]]] = {
        **Choices.when,
        "free_until": ("reading", "zero after step s"),
        "decay": ("reading", "decaying"),
    }
    groups: ClassVar[dict[str, tuple[str, ...]]] = {
        "Case": ("case", "reference", "output", "input"),
        "Governor": ("Np", "reading", "free_until", "decay", "timing"),
        "Limits": ("limit_u", "u_max", "limit_du", "du_max", "limit_y", "y_max"),
        "Plant and disturbances": ("gain", "dynamics", "step_u", "step_y", "step_at"),
    }
    default_case: ClassVar[str] = "governor_3_4"

    @classmethod
    @functools.cache
    def cases(cls) -> list[str]:
        """Cases with a governor and with the same gain alone."""
        both = {"governor", "pip"}
        return [n for n in LINEAR_CASES if both <= set(known_case(n).designs)]

    @property
    def _main_design(self) -> Design:
        return known_case(self.case).designs["governor"]

    def _welcome(self, name: str) -> None:
        if name in KEPT and "governor" not in KEPT[name].designs:
            raise ValueError(
                f"case = {name!r}: no stabilising gain was found for this model, so "
                "there is nothing to govern"
            )
        super()._welcome(name)

    def take_case(self, name: str) -> None:
        """Choose a case and the governor's horizon."""
        super().take_case(name)
        self.Np = self._main_design.horizon.Np
        self.timing = "preview" if self._main_design.reference == "preview" else "held"

    def scenario(self) -> Scenario:
        """Scenario with the reference made larger or smaller."""
        scenario = super().scenario()
        return replace(scenario, reference=self.reference * scenario.reference)

    def designs(self) -> dict[str, Design]:
        """Pair the governor with its gain alone."""
        governor, pip = (self.example.designs[name] for name in ("governor", "pip"))
        options = {**governor.options, **self._reading()}
        governor = replace(
            governor,
            horizon=Horizon(self.Np, self.Np),
            limits=self.limits(governor.limits),
            reference=self.timing,
            options=options,
        )
        pip = replace(pip, limits=self.limits(pip.limits))
        return {"with governor": governor, "without": pip}

    def _reading(self) -> dict[str, Any]:
        if self.reading == "zero after step s":
            return {"free_until": self.free_until}
        return {"decay": self.decay} if self.reading == "decaying" else {}

    def _scenario_lines(self) -> list[str]:
        return [
            *super()._scenario_lines(),
            "scenario = replace(",
            f"    scenario, reference={self.reference!r} * scenario.reference",
            ")",
        ]

    def _design_lines(self) -> list[str]:
        return [
            "runs = {}",
            'for name, key in {"with governor": "governor", "without": "pip"}.items():',
            "    design = example.designs[key]",
            "    limits = design.limits",
            *self._limit_lines(),
            "    design = replace(design, limits=limits)",
            '    if key == "governor":',
            f"        options = {{**design.options, **{self._reading()!r}}}",
            "        design = replace(",
            "            design,",
            f"            horizon=Horizon({self.Np}, {self.Np}),",
            f'            reference="{self.timing}",',
            "            options=options,",
            "        )",
            "    runs[name] = closed_loop(plant, design.build(), scenario)",
        ]


def head(imports: Iterable[str]) -> list[str]:
    """Write the imports of a script in groups, those from one module in one line.

    ``replace`` and NumPy, which every script uses, come without being asked for.
    """
    groups: list[list[str]] = [
        ["from dataclasses import replace"],
        ["import numpy as np"],
        [],
    ]
    for line in imports:
        module = line.split()[1].partition(".")[0]
        groups[{"scipy": 1, "nmss_lab": 2}.get(module, 0)].append(line)
    lines: list[str] = []
    for group in groups:
        lines += ["", *_joined(group)]
    return lines[1:]


def _as_sorted(name: str) -> tuple[bool, str]:
    """Sort constants first, and the case of letters not at all."""
    return not name.isupper(), name.lower()


def _joined(imports: Iterable[str]) -> list[str]:
    plainly, found = set(), dict[str, set[str]]()
    for line in imports:
        module, is_from, names = line.partition(" import ")
        if is_from:
            found.setdefault(module, set()).update(names.split(", "))
        else:
            plainly.add(line)
    return sorted(plainly) + [
        f"{module} import {', '.join(sorted(names, key=_as_sorted))}"
        for module, names in sorted(found.items())
    ]


_SCRIPT_IMPORTS = (
    "from nmss_lab.cases import piecewise",
    "from nmss_lab.measures import table",
    "from nmss_lab.predict import Horizon",
    "from nmss_lab.simulate import closed_loop",
)


def _parts(text: str) -> list[str]:
    """Names in an address, separated by commas."""
    return [part for part in text.split(",") if part]


def _case_title(example: Case) -> str:
    return f"{example.section}  {example.title}".strip()


def _first_choice(predictive: list[str]) -> list[str]:
    """Structures a case opens with: the two that differ most in it."""
    for pair in (
        ("disturbance_direct", "wang_young"),
        ("wang_young", "integral_of_error"),
    ):
        if set(pair) <= set(predictive):
            return list(pair)
    return predictive[:2]


def _finite_sides(sides: tuple[Any, Any]) -> list[Any]:
    return [np.asarray(side, float)[np.isfinite(side)] for side in sides]


def _largest(*series: Any) -> float:
    """Largest absolute value; 1 where all are absent or zero."""
    found = [float(np.abs(s).max()) for s in series if s is not None and np.size(s)]
    return max(found, default=0.0) or 1.0


def _round_number(value: float) -> float:
    """Smallest of 1, 2, 5, 10, ... times a power of ten that is not below."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * min(
        m for m in (1.0, 2.0, 5.0, 10.0) if m * power >= value * (1 - 1e-9)
    )


def _short(error: Exception) -> str:
    """Message of an error without the name of the class it came from."""
    text = str(error)
    return text.rsplit("Choices.", 1)[-1].partition("' ")[2] or text
