"""Choices of a session, and the runs and the Python that belong to them.

Each page has one class of choices with bounds and help.  ``runs`` and ``script`` are
made from the same lines: what the page shows is what its script prints.
"""

from __future__ import annotations

import functools
import itertools
import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar
from urllib.parse import parse_qsl, urlencode

import numpy as np
import param

from apps.kept import GONE, KEPT, Origin, keep_case
from nmss_lab.cases import (
    LINEAR_CASES,
    Case,
    case,
    design_case,
    governed,
    model_case,
    piecewise,
)
from nmss_lab.controller import Limits
from nmss_lab.design import VARYING, Design
from nmss_lab.files import Study, case_of, dumps, loads
from nmss_lab.identify import Estimate
from nmss_lab.models import DifferenceModel, LinearPlant
from nmss_lab.mpc import STRUCTURES
from nmss_lab.predict import Horizon
from nmss_lab.simulate import Run, Scenario, closed_loop
from nmss_lab.state_dependent import StateDependentModel

DIVERGED = 1e9
"""Outputs and inputs beyond this are not drawn: the loop is unstable."""

MOST_RUNS = 3

MOST_DECIDED = 3.3e9
"""Samples, times the cube of what the program of each decides: some ten seconds."""

TRIAL = 3.0
"""Seconds that the runs of an opened file may take: its page needs some more."""

GOVERNORS = "governor", "sdp_governor"

HELD = "A", "B"
"""Choices that hold a design from page to page: each the address that makes it."""

MAKERS: dict[str, type[DesignChoices]] = {}
"""Choices that such an address may belong to, by page."""

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


def open_design(text: str, hears: Callable[[], None] = lambda: None) -> str:
    """Keep what a design file holds; return the address of the page that shows it.

    Parameters
    ----------
    text : str
    hears : callable
        Called while its run is tried; may end that by raising.

    Raises
    ------
    ValueError
        If the text is no such file, holds something else than a design or a model, or
        something that its page could not show.
    """
    content = loads(text)
    if isinstance(content, Estimate):
        page, name = "receding_horizon", keep_model(content)
    else:
        page, name = _keep_study(content)
    _try_out(MAKERS[page](case=name), hears)
    return f"{page}?case={name}"


def _keep_study(content: Any) -> tuple[str, str]:
    """Keep a design that can be built; return its page and the name of its case."""
    if isinstance(content, Design):
        content = Study(content)
    if not isinstance(content, Study):
        raise ValueError(
            f"the file holds a {type(content).__name__.lower()}, expected a design or "
            "a model; records are opened on the page Identify"
        )
    case_of(content, "content")  # can it be built?
    design = content.design
    example = design_case(design, content.plant, content.scenario)
    origin = Origin(
        (
            "from nmss_lab.cases import design_case",
            "from nmss_lab.files import Study, load",
        ),
        (
            "# design.json: the file that was opened",
            'study = load("design.json")',
            "study = study if isinstance(study, Study) else Study(study)",
            "example = design_case(study.design, study.plant, study.scenario)",
        ),
    )
    name = keep_case("opened", dumps(content), example, origin)
    if design.structure in VARYING:
        return "state_dependent", name
    return "governor" if design.structure in PAIR else "receding_horizon", name


def _try_out(choices: Choices, heard: Callable[[], None]) -> None:
    """Run what a page would open with, for as long as it may take there.

    Raises
    ------
    ValueError
        If it takes longer, or cannot be shown.
    """
    until = time.monotonic() + TRIAL

    def hears(share: float) -> None:
        heard()
        if time.monotonic() > until:
            raise ValueError(
                f"its run takes more than {TRIAL:g} s, {share:.0%} of all were done: "
                "open a shorter scenario, or a design with shorter horizons"
            )

    choices.hears = hears
    choices.runs()


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
        "A": "A",
        "B": "B",
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
        # what is held first: it is among what the others choose from
        given = [key for key in values if key in self.names()]
        for key in sorted(given, key=lambda key: key not in HELD):
            try:
                setattr(self, key, self._read(key, values[key]))
            except (ValueError, TypeError, OverflowError) as error:
                wrong = wrong or f"{key} = {values[key]!r:.80}: {_short(error):.400}"
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


class Holding(Form):
    """Choices that come with two held designs."""

    A = param.String("", label="Design A", doc="The address of a design that is held.")
    B = param.String("", label="Design B", doc="Another one.")

    @classmethod
    def names(cls) -> list[str]:
        """Names of all choices, held designs first."""
        return [*HELD, *super().names()]

    def _read(self, key: str, value: Any) -> Any:
        if key not in HELD:
            return super()._read(key, value)
        text = str(value)
        if text:
            held(text)
        return text

    def misfit(self, text: str) -> str:
        """Say why a held design cannot be shown here; nothing if it can."""
        raise NotImplementedError

    def fitting(self) -> dict[str, Design]:
        """Held designs that can be shown here, A before B."""
        texts = {key: getattr(self, key) for key in HELD}
        return {
            key: held(text).design
            for key, text in texts.items()
            if text and not self.misfit(text)
        }


class Choices(Holding):
    """What the pages share: case, limits, plant against model, disturbances."""

    case = param.Selector(
        label="Case", doc="A worked example: plant, model, weights and scenario."
    )
    structures = param.ListSelector(
        default=[],
        label="Structures",
        doc="Up to three controllers of this case, side by side; A and B are designs "
        "that are held.",
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
    hears: Callable[[float], None] | None = None
    """Hears which share of an answer is done, and may end it by raising."""
    makes: ClassVar[str] = ""
    """Page whose address makes the designs of these choices."""
    of_design: ClassVar[tuple[str, ...]] = ()
    """What that address states, besides case and structure."""

    def __init_subclass__(cls, **options: Any) -> None:
        """List the choices that make designs."""
        super().__init_subclass__(**options)
        if "makes" in vars(cls):
            MAKERS[cls.makes] = cls

    def __init__(self, **values: Any) -> None:
        self._offered: list[str] = []
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
            if key not in ("name", "case", *HELD):
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
        return {**self._fresh().values(), "case": self.default_case}

    def _fresh(self) -> Choices:
        """All choices as they are when the case is chosen."""
        fresh = type(self)()
        fresh._welcome(self.case)
        fresh.take_case(self.case)
        return fresh

    # Held designs

    def _read(self, key: str, value: Any) -> Any:
        value = super()._read(key, value)
        if key in HELD:
            self._offer(self._offered, {key: value})
        return value

    def _offer(self, names: Iterable[str], given: Mapping[str, str] = {}) -> None:
        """Offer structures of the case, and what is held, where it fits."""
        self._offered = list(names)
        texts = {key: given.get(key, getattr(self, key)) for key in HELD}
        fitting = [k for k, text in texts.items() if text and not self.misfit(text)]
        offered = [*self._offered, *fitting]
        self.structures = [name for name in self.structures if name in offered]
        self.param["structures"].objects = offered

    def misfit(self, text: str) -> str:
        """Say why a held design cannot control this plant; nothing if it can."""
        model, wanted = self.example.model, held(text).design.model
        for size, word in (
            ("n_y", "outputs"),
            ("n_u", "inputs"),
            ("n_v", "measured disturbances"),
        ):
            theirs, ours = getattr(_sizes(wanted), size), getattr(model, size)
            if theirs != ours:
                return f"it is for {theirs} {word}, this plant has {ours}"
        if not math.isclose(_sizes(wanted).dt, model.dt):
            return f"it acts every {_sizes(wanted).dt:g} s, not every {model.dt:g} s"
        return ""

    def hold(self, name: str) -> str:
        """Return the address that makes the design of that name, on any page."""
        if name in HELD:
            return str(getattr(self, name))
        maker = MAKERS[self.makes]
        usual = maker(case=self.case)
        stated = {
            key: getattr(self, key)
            for key in maker.of_design
            if getattr(self, key) != getattr(usual, key)
        }
        return held_as(self.makes, self.case, name, stated)

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
            return case_title(known_case(name))
        if key == "structures" and name in HELD:
            found = held(getattr(self, name))
            known = found.choices.case == self.case
            other = "" if known else f", of {found.choices.example.title}"
            return f"{name}: {found.words}{other}"
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

    def usual_structures(self) -> list[str]:
        """Structures with which the case opens."""
        return list(self._fresh().structures)

    def study_of(self, name: str) -> Study:
        """Return one of the designs with plant and scenario, as data."""
        return Study(self.designs()[name], self._as_data(), self.scenario())

    def _as_data(self) -> Any:
        """Plant as files hold it."""
        return self.plant()

    def designs(self) -> dict[str, Design]:
        """Chosen structures with the choices, and what is held as it is."""
        if not 1 <= len(self.structures) <= MOST_RUNS:
            raise ValueError(
                f"structures: {len(self.structures)} chosen, expected 1 to {MOST_RUNS}"
            )
        known = self.example.designs
        for name in self.structures:
            if name not in (*known, *HELD):
                raise ValueError(
                    f"structures: this case has no {name!r}; it has "
                    f"{', '.join(self._offered)}"
                )
        return {name: self._design(name) for name in self.structures}

    def _design(self, name: str) -> Design:
        """Return what is held as it is, or a design of the case with the choices."""
        if name not in HELD:
            return self._changed(self.example.designs[name])
        text = getattr(self, name)
        wrong = self.misfit(text) if text else "no design is held as such"
        if wrong:
            raise ValueError(f"structures: {name} cannot be shown here, {wrong}")
        return held(text).design

    def _changed(self, design: Design) -> Design:
        """Put the choices into a design of the case."""
        raise NotImplementedError

    def runs(self) -> dict[str, Run]:
        """Run every design.

        Raises
        ------
        ValueError
            If a design cannot be built, or its loop diverges; says which and why.
        """
        plant, scenario, designs = self.plant(), self.scenario(), self.designs()
        afford(designs, len(scenario))
        if self.hears is not None:
            hears, count = self.hears, itertools.count(1)
            total = len(designs) * len(scenario)
            plant = Attended(plant, lambda: hears(next(count) / total))
        return {
            name: self._run(name, design, plant, scenario)
            for name, design in designs.items()
        }

    def _run(self, name: str, design: Design, plant: Any, scenario: Scenario) -> Run:
        try:
            controller = design.build()
            with np.errstate(all="ignore"):
                run = closed_loop(plant, controller, scenario)
        except (ValueError, np.linalg.LinAlgError) as error:
            raise ValueError(f"{plain(name)}: {error}") from error
        for what, signal in (("output", run.y), ("input", run.u)):
            if not np.abs(signal).max() < DIVERGED:
                raise ValueError(
                    f"{plain(name)}: the loop is unstable, its {what} grows beyond "
                    f"{DIVERGED:g}. Try the plant nearer to the model, or wider limits."
                )
        return run

    def script(self) -> str:
        """Python that computes what the page shows and prints its measures."""
        lines = [
            *self._head(_SCRIPT_IMPORTS),
            "",
            *self._held_lines(),
            *self._case_lines(),
            *self._plant_lines(),
            *self._scenario_lines(),
            "",
            *self._designs_lines(),
            "runs = {",
            "    name: closed_loop(plant, design.build(), scenario)",
            "    for name, design in designs.items()",
            "}",
            f"for row in table(runs, channel={self.output}):",
            "    print(row)",
        ]
        return "\n".join(lines) + "\n"

    def _head(self, imports: Iterable[str]) -> list[str]:
        """First lines of a script: what it imports, and what its cases need."""
        return head([*imports, *self._cases_imports()])

    def _cases_imports(self) -> list[str]:
        """Say what the lines of the case, and of what is held, import."""
        others = [held(getattr(self, key)).choices for key in self._held_chosen]
        return [line for one in (self, *others) for line in one._case_imports()]

    @property
    def _held_chosen(self) -> list[str]:
        return [key for key in self.structures if key in HELD]

    def _held_lines(self) -> list[str]:
        """Lines that make what is held and shown."""
        lines = ["held = {}"] if self._held_chosen else []
        for key in self._held_chosen:
            found = held(getattr(self, key))
            lines += [
                f"# {key}: {found.words}",
                *found.choices._case_lines(),
                *found.choices._designs_lines(),
                f'held["{key}"] = designs["{found.name}"]',
                "",
            ]
        return lines

    def _case_imports(self) -> tuple[str, ...]:
        """Say what ``_case_lines`` import."""
        if self.case not in KEPT:
            return ("from nmss_lab.cases import case",)
        return KEPT.origins[self.case].imports

    def _case_lines(self) -> list[str]:
        if self.case not in KEPT:
            return [f'example = case("{self.case}")']
        return list(KEPT.origins[self.case].lines)

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

    def _designs_lines(self) -> list[str]:
        """Lines that make ``designs``, those that are held among them."""
        own = [name for name in self.structures if name not in HELD]
        lines = [
            *self._before_designs(),
            "designs = {}",
            f"for name in {own!r}:",
            "    design = example.designs[name]",
            "    limits = design.limits",
            *self._limit_lines(),
            *self._changed_lines(),
        ]
        if not self._held_chosen:
            return lines
        order = f"{self.structures!r}"
        return [*lines, f"designs = {{k: (designs | held)[k] for k in {order}}}"]

    def _before_designs(self) -> list[str]:
        return []

    def _changed_lines(self) -> list[str]:
        """Lines inside the loop that put the choices into ``design``."""
        raise NotImplementedError


def _sizes(model: DifferenceModel | StateDependentModel) -> DifferenceModel:
    return model.wide if isinstance(model, StateDependentModel) else model


@dataclass(frozen=True)
class Held:
    """A design that was held: its choices, its name there, itself, its differences."""

    choices: Choices
    name: str
    design: Design
    words: str


def held_as(page: str, case: str, name: str, stated: Mapping[str, Any] = {}) -> str:
    """Return the address of a design; of one "as it is" on the page "case"."""
    return f"{page}?{urlencode({'case': case, 'structures': name, **stated})}"


@functools.lru_cache(maxsize=256)
def held(text: str) -> Held:
    """Make a design of the address that holds it.

    Raises
    ------
    ValueError
        If it is none, or belongs to a case that is no longer kept.
    """
    page, _, query = text.partition("?")
    stated = dict(parse_qsl(query))
    if page not in MAKERS or not {"case", "structures"} <= set(stated):
        raise ValueError(f"{text[:80]!r} is no design that is held")
    choices = MAKERS[page](**stated)
    if len(choices.structures) != 1 or choices.structures[0] in HELD:
        raise ValueError(f"{text[:80]!r} does not name one structure")
    ((name, design),) = choices.designs().items()
    del stated["case"], stated["structures"]
    words = [plain(name), *(f"{key} {value}" for key, value in stated.items())]
    return Held(choices, name, design, ", ".join(words))


class AsItIs(Choices):
    """A design just as it is in its case."""

    groups: ClassVar[dict[str, tuple[str, ...]]] = {"Case": ("case", "structures")}
    default_case: ClassVar[str] = "ifac93_6_3_3"
    makes: ClassVar[str] = "case"

    def take_case(self, name: str) -> None:
        """Choose a case, of whatever kind, and its first design."""
        super().take_case(name)
        self._offer(self.example.designs)
        self.structures = [next(iter(self.example.designs))]

    def _changed(self, design: Design) -> Design:
        return design

    def _changed_lines(self) -> list[str]:
        return ["    designs[name] = design"]


class Attended:
    """A plant of which somebody hears at each sample, who may end the loop."""

    def __init__(self, plant: Any, hears: Callable[[], None]) -> None:
        self._plant, self._hears = plant, hears

    def __getattr__(self, name: str) -> Any:
        return getattr(self._plant, name)

    def step(self, state: Any, u: Any, v: Any) -> Any:
        """Past one sample later."""
        self._hears()
        return self._plant.step(state, u, v)


def afford(designs: Mapping[str, Design], samples: int) -> None:
    """Refuse runs that would take more than some ten seconds.

    Raises
    ------
    ValueError
        Saying by how much, and what to lower.
    """

    def share(design: Design, Np: int) -> float:
        return samples * _decided(design, Np) ** 3 / MOST_DECIDED

    shares = {name: share(d, d.horizon.Np) for name, d in designs.items()}
    times = sum(shares.values())
    if times <= 1.0:
        return
    dearest = designs[max(shares, key=lambda name: shares[name])]
    others = times - share(dearest, dearest.horizon.Np)
    advice = [
        f"lower Np to {Np}"
        for Np in range(1, dearest.horizon.Np)
        if share(dearest, Np) + others <= 1.0
    ][-1:]
    if len([each for each in shares.values() if each]) > 1:
        advice.append("choose fewer structures")
    if _may_give_way(dearest):
        advice.append("switch off the limits on y")
    raise ValueError(
        f"{samples} samples with these horizons take {times:.1f} times as long as an "
        f"answer may: {', or '.join(advice) or 'open a shorter scenario'}"
    )


def _decided(design: Design, Np: int) -> int:
    """Count what the largest program of a sample decides, with another horizon."""
    model, free = _sizes(design.model), min(design.horizon.Nc, Np)
    if design.structure in GOVERNORS:
        moves = min(design.options.get("free_until") or Np, free) * model.n_y
    elif design.structure in STRUCTURES:
        moves = free * model.n_u
    else:
        return 0
    return moves + _may_give_way(design) * Np * model.n_y


def _may_give_way(design: Design) -> bool:
    """Whether output limits have slack variables where they cannot be kept."""
    low, high = design.limits.of("y", _sizes(design.model).n_y)
    limited = bool(np.isfinite(low).any() or np.isfinite(high).any())
    soft = design.structure in GOVERNORS or design.limits.outputs != "hard"
    return limited and soft


class DesignChoices(Choices):
    """What pages share whose controllers predict: how far, and at what price."""

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
    makes: ClassVar[str] = "receding_horizon"
    of_design: ClassVar[tuple[str, ...]] = (*groups["Design"], *groups["Limits"])

    def take_case(self, name: str) -> None:
        """Choose a case: its predictive designs, and the horizons of the first."""
        designs = known_case(name).designs
        predictive = [key for key, d in designs.items() if d.structure in STRUCTURES]
        self._predictive = predictive
        super().take_case(name)
        self._offer(predictive)
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
        names = [name for name in self.structures if name not in HELD]
        designs = {name: self.example.designs[name] for name in names}
        own = ", ".join(
            f'"{name}": Horizon({design.horizon.Np}, {design.horizon.Nc})'
            for name, design in designs.items()
            if self._horizon(design) is design.horizon
        )
        if not own:
            return [], chosen
        return [f"own = {{{own}}}"], f"own.get(name, {chosen})"

    def _before_designs(self) -> list[str]:
        return self._horizon_lines()[0]

    def _changed_lines(self) -> list[str]:
        reading = (
            [] if self.reading == "case" else [f'        reference="{self.reading}",']
        )
        return [
            "    designs[name] = replace(",
            "        design,",
            f"        horizon={self._horizon_lines()[1]},",
            f"        Q={self.weight_y!r} * np.asarray(design.Q),",
            f"        R={self.weight_move!r} * np.asarray(design.R),",
            "        limits=limits,",
            *reading,
            "    )",
        ]


@functools.lru_cache(maxsize=64)
def _with_governor(example: Case) -> Case:
    return governed(example)


PAIR = "governor", "pip"
"""A gain with a governor of its reference, and alone."""


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
        "Case": ("case", "structures", "reference", "output", "input"),
        "Governor": ("Np", "reading", "free_until", "decay", "timing"),
        "Limits": ("limit_u", "u_max", "limit_du", "du_max", "limit_y", "y_max"),
        "Plant and disturbances": ("gain", "dynamics", "step_u", "step_y", "step_at"),
    }
    default_case: ClassVar[str] = "governor_3_4"
    makes: ClassVar[str] = "governor"
    of_design: ClassVar[tuple[str, ...]] = (*groups["Governor"], *groups["Limits"])

    @property
    def _main_design(self) -> Design:
        return self.example.designs["governor"]

    def _case_of(self, name: str) -> Case:
        return _with_governor(known_case(name))

    def _welcome(self, name: str) -> None:
        if name in KEPT:
            governed(KEPT[name])
        super()._welcome(name)

    def _case_imports(self) -> tuple[str, ...]:
        return (*super()._case_imports(), "from nmss_lab.cases import governed")

    def _case_lines(self) -> list[str]:
        return [*super()._case_lines(), "example = governed(example)"]

    def take_case(self, name: str) -> None:
        """Choose a case and the governor's horizon."""
        super().take_case(name)
        self._offer(PAIR)
        self.structures = list(PAIR)
        self.Np = self._main_design.horizon.Np
        self.timing = "preview" if self._main_design.reference == "preview" else "held"

    def scenario(self) -> Scenario:
        """Scenario with the reference made larger or smaller."""
        scenario = super().scenario()
        return replace(scenario, reference=self.reference * scenario.reference)

    def _changed(self, design: Design) -> Design:
        design = replace(design, limits=self.limits(design.limits))
        if design.structure != "governor":
            return design
        return replace(
            design,
            horizon=Horizon(self.Np, self.Np),
            reference=self.timing,
            options={**design.options, **self._reading()},
        )

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

    def _changed_lines(self) -> list[str]:
        return [
            "    designs[name] = design = replace(design, limits=limits)",
            '    if name == "governor":',
            "        designs[name] = replace(",
            "            design,",
            f"            horizon=Horizon({self.Np}, {self.Np}),",
            f'            reference="{self.timing}",',
            f"            options={{**design.options, **{self._reading()!r}}},",
            "        )",
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


def literal(value: Any) -> str:
    """Python of a number or an array, to the last digit."""
    array = np.asarray(value, dtype=float)
    if array.ndim == 0:
        return repr(float(array))
    return f"np.array({array.tolist()!r})".replace("inf", "np.inf")


def _parts(text: str) -> list[str]:
    """Names in an address, separated by commas."""
    return [part for part in text.split(",") if part]


def case_title(example: Case) -> str:
    """Section and title of a case."""
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
