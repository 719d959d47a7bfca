"""Choices of the page Robustness: which plants might be the true one, and the study.

Studies and scripts are made from the same lines, as in ``apps.session``.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import param

from apps.session import (
    LoopChoices,
    Origin,
    _largest,
    _round_number,
    keep_case,
    known_case,
)
from nmss_lab.cases import Case, ifac93_plant, stress
from nmss_lab.continuous import ContinuousPlant
from nmss_lab.design import Design
from nmss_lab.models import Array, DifferenceModel, LinearPlant
from nmss_lab.montecarlo import EVENTS, Event, MonteCarlo, event
from nmss_lab.simulate import Scenario, closed_loop
from nmss_lab.uncertainty import (
    Intervals,
    ParameterCovariance,
    RelativeRanges,
    Uncertainty,
    realisation,
)

KINDS = {
    "covariance": "P*: covariance of the parameters",
    "ranges": "Ranges of the coefficients, (6.11)",
    "stress": "Stress level of Table 4.1, draws",
    "stress_corners": "Stress level of Table 4.1, all corners",
    "gains": "Gains and speed, draws",
    "gains_corners": "Gains and speed, all corners",
}
DRAWN = "covariance", "ranges", "stress", "gains"

MEASURES = {
    "IAE": "IAE",
    "ISE": "ISE",
    "overshoot": "Overshoot of the first step",
    "rise": "Rise time of the first step",
    "settling": "Settling time of the first step",
    "coupling": "Coupling",
    "RMS du": "RMS of du",
    "peak": "Peak of the output",
    "excess": "Worst excess over a limit",
    "radius": "Largest pole",
}
CLOUDS = {
    "draws": "of every realisation",
    "b": "while one factor on b walks",
    "a": "while one factor on a walks",
}

BY_ITSELF = 200
"""A study of up to this many realisations starts by itself when choices change."""

AT_FIRST = 1000
"""The same when the page is opened, or a case chosen: there is nothing to lose."""

MOST = 10_000
MOST_BYTES = 256e6
"""Room for the outputs and inputs of one study."""


def slower(
    continuous: ContinuousPlant,
    dt: float,
    substeps: int,
    time: float = 1.0,
    **gain: float,
) -> LinearPlant:
    """Sample a plant that is slower by a factor, the gain of each input multiplied."""
    plant = continuous.sampled(dt / time, substeps)
    factors = np.array(list(gain.values()))
    between = plant.between
    if between is not None:
        times = between.times * time
        between = replace(between, B=between.B * factors, times=times)
    return replace(plant, B=plant.B * factors, dt=dt, between=between)


def multiplied(
    model: DifferenceModel, a: float = 1.0, **gain: float
) -> DifferenceModel:
    """Multiply the coefficients a by a factor, and those b of each input by its own."""
    factors = np.array(list(gain.values()))
    return replace(model, a=a * model.a, b=model.b * factors)


def certain_delays(model: DifferenceModel, covariance: Array) -> Array:
    """Widen P* by coefficients that a delay makes zero: they are certain.

    Raises
    ------
    ValueError
        If the covariance does not belong to the coefficients that are not zero.
    """
    parameters = np.concatenate([model.a.ravel(), model.b.ravel()])
    free = np.flatnonzero(parameters)
    if len(covariance) == len(parameters):
        return covariance
    if len(covariance) != len(free):
        raise ValueError(
            f"P* has {len(covariance)} rows, but the model has {len(free)} "
            "coefficients that are not zero"
        )
    wide = np.zeros((len(parameters), len(parameters)))
    wide[np.ix_(free, free)] = covariance
    return wide


@dataclass(frozen=True, eq=False)
class Study:
    """Everything that a study needs."""

    designs: dict[str, Design]
    uncertainty: Uncertainty
    scenario: Scenario
    nominal: LinearPlant
    n: int
    seed: int


class RobustnessChoices(LoopChoices):
    """Choices of the page Robustness."""

    uncertainty: Any = param.Selector(
        objects=list(KINDS),
        label="What is uncertain",
        doc="Which plants might be the true one; every structure meets the same ones.",
    )
    b_range = param.Number(
        10.0,
        bounds=(0.0, 60.0),
        step=0.5,
        label="Coefficients b, plus or minus per cent",
        doc="Each is drawn evenly from this range about its value.",
    )
    a_range = param.Number(
        2.0,
        bounds=(0.0, 30.0),
        step=0.1,
        label="Coefficients a, plus or minus per cent",
        doc="Each is drawn evenly from this range about its value; a little moves "
        "poles far.",
    )
    level: Any = param.Selector(
        default="2",
        objects=["1", "2", "3"],
        label="Stress level",
        doc="How far T1, T2, w0, zeta and K of the plant may lie from their values: "
        "Table 4.1. Level 1 leaves K alone.",
    )
    gain_range = param.Number(
        20.0,
        bounds=(0.0, 80.0),
        step=1.0,
        label="Gains, plus or minus per cent",
        doc="The gain of each input varies on its own.",
    )
    speed_range = param.Number(
        20.0,
        bounds=(0.0, 60.0),
        step=0.1,
        label="Speed, plus or minus per cent",
        doc="Time constants and dead times of the continuous plant, all by one "
        "factor; of a difference equation its coefficients a, as in (6.11).",
    )
    n = param.Integer(
        300,
        bounds=(1, MOST),
        label="Realisations",
        doc=f"Number of plants, up to {MOST:,}.",
    )
    seed = param.Integer(
        0,
        bounds=(0, 2**31 - 1),
        label="Seed",
        doc="The same seed draws the same plants.",
    )
    cloud: Any = param.Selector(
        default="draws",
        objects=list(CLOUDS),
        label="Closed-loop poles",
        doc="Of the plants drawn, or the root locus of a factor from 0.5 to 1.5 on "
        "the model's coefficients, with the bounds of Table 6.1.",
    )
    measure: Any = param.Selector(
        default="IAE",
        objects=list(MEASURES),
        label="Measure",
        doc="Its distribution is shown, and the worst realisations by it.",
    )
    peak = param.Number(
        1.5,
        label="Event: output beyond a peak of",
        doc="Counted in the table of rates: the output shown exceeds this size.",
    )

    fields: ClassVar[tuple[str, ...]] = ("n", "seed")
    when: ClassVar[dict[str, tuple[str, Any]]] = {
        **LoopChoices.when,
        "b_range": ("uncertainty", "ranges"),
        "a_range": ("uncertainty", "ranges"),
        "level": ("uncertainty", ("stress", "stress_corners")),
        "gain_range": ("uncertainty", ("gains", "gains_corners")),
        "speed_range": ("uncertainty", ("gains", "gains_corners")),
        "n": ("uncertainty", DRAWN),
        "seed": ("uncertainty", DRAWN),
    }
    groups: ClassVar[dict[str, tuple[str, ...]]] = {
        "Case": ("case", "structures", "output", "input"),
        "Uncertainty": (
            "uncertainty",
            "b_range",
            "a_range",
            "level",
            "gain_range",
            "speed_range",
            "n",
            "seed",
        ),
        "Pictures": ("cloud", "measure", "peak"),
        "Design": ("Np", "Nc", "weight_y", "weight_move", "reading"),
        "Limits": ("limit_u", "u_max", "limit_du", "du_max", "limit_y", "y_max"),
        "Disturbances": ("step_u", "step_y", "step_at"),
    }
    default_case: ClassVar[str] = "marginally_stable_6_3_2"

    def take_case(self, name: str) -> None:
        """Choose a case and the uncertainty that belongs to it."""
        example = known_case(name)
        self.param["uncertainty"].objects = list(KINDS)
        self.param["peak"].bounds = None
        super().take_case(name)
        kinds = kinds_of(example)
        self.param["uncertainty"].objects = kinds
        self.uncertainty = next(
            kind for kind in ("covariance", "stress_corners", "gains") if kind in kinds
        )
        if example.continuous is None:
            self.speed_range = 0.0
        size = usual_peak(example)
        most = _round_number(3.0 * size)
        self.param["peak"].bounds, self.param["peak"].step = (0.0, most), most / 200
        self.peak = float(f"{size:.2g}")

    def _word(self, key: str, name: str) -> str:
        words = {"uncertainty": KINDS, "measure": MEASURES, "cloud": CLOUDS}
        return words[key][name] if key in words else super()._word(key, name)

    # From choices to a study. Every line here has its twin in ``script``.

    @property
    def count(self) -> int:
        """Number of realisations of the study."""
        return self.n if self.uncertainty in DRAWN else self.plants().size or 0

    def plants(self) -> Uncertainty:
        """Plants that might be the true one.

        Raises
        ------
        ValueError
            If they do not belong to this case.
        """
        example, model = self.example, self.example.model
        corners = self.uncertainty.endswith("_corners")
        if self.uncertainty == "covariance":
            assert example.covariance is not None
            covariance = certain_delays(model, example.covariance)
            return ParameterCovariance(model, covariance)
        if self.uncertainty == "ranges":
            return RelativeRanges(model, self._shares())
        if self.uncertainty.startswith("stress"):
            level, dt = int(self.level), example.plant.dt
            return stress(level, corners, dt, example.plant.substeps)
        build: Any = functools.partial(multiplied, model)
        if example.continuous is not None:
            build = functools.partial(
                slower,
                example.continuous,
                example.plant.dt,
                example.plant.substeps,
            )
        return Intervals(build, self._intervals(), corners)

    def _shares(self) -> dict[str, float]:
        shares = {"a": self.a_range / 100.0, "b": self.b_range / 100.0}
        return {**shares, "g": shares["b"]} if self.example.model.n_v else shares

    def _intervals(self) -> dict[str, tuple[float, float]]:
        """Factors of Intervals by name: of the speed, and of the gain of each input."""
        model = self.example.model
        speed = "a" if self.example.continuous is None else "time"
        names = model.u_names if model.n_u > 1 else ("",)
        gains = [f"gain {name}".strip() for name in names]
        widths = {speed: self.speed_range} | dict.fromkeys(gains, self.gain_range)
        return {
            name: (round(1.0 - width / 100.0, 6), round(1.0 + width / 100.0, 6))
            for name, width in widths.items()
            if width or name != speed  # corners without it come once, not in pairs
        }

    def study(self) -> Study:
        """Make the study.

        Raises
        ------
        ValueError
            If a choice does not fit the case, or the study is too large to keep.
        """
        self._check_size()
        on_model = self.uncertainty in ("covariance", "ranges") or (
            self.example.continuous is None
        )
        nominal = self.example.model.plant() if on_model else self.example.plant
        assert isinstance(nominal, LinearPlant)
        return Study(
            self.designs(),
            self.plants(),
            self.scenario(),
            nominal,
            self.count,
            self.seed,
        )

    def _check_size(self) -> None:
        """Refuse what would fill the memory of a server that others use as well."""
        model, structures = self.example.model, max(len(self.structures), 1)
        each = 8.0 * self._samples * (model.n_y + model.n_u) * structures
        if self.count * each > MOST_BYTES:
            raise ValueError(
                f"n = {self.count}: runs of this case are long, choose up to "
                f"{int(MOST_BYTES / each)} realisations here, or measures alone in "
                "Python"
            )

    def events(self, peak: float) -> dict[str, Event]:
        """Events that are counted."""
        return {**EVENTS, f"peak beyond {peak:.4g}": event("peak", peak)}

    # Python

    def study_lines(self) -> list[str]:
        """Python that makes the study, up to its results; tells studies apart."""
        size = f"n={self.n}, seed={self.seed}" if self.uncertainty in DRAWN else ""
        arguments = ["designs", "uncertainty", "scenario", *([size] if size else [])]
        names = "from nmss_lab.montecarlo import EVENTS, event, monte_carlo"
        return [
            *self._head([names, *self._study_imports()]),
            "",
            *self._held_lines(),
            *self._case_lines(),
            *self._scenario_lines(),
            *self._uncertainty_lines(),
            "",
            *self._designs_lines(),
            "",
            f"study = monte_carlo({', '.join(arguments)})",
        ]

    def rates_script(self, output: int, peak: float, done: int | None = None) -> str:
        """Python that makes the study and prints its table of rates."""
        name = self.example.model.y_names[output]
        words = f"peak beyond {peak:.4g}"
        lines = [
            *self.study_lines(),
            f'shown = study.table[study.table["output"] == "{name}"]',
            f'events = {{**EVENTS, "{words}": event("peak", {peak!r})}}',
            "rates = replace(study, table=shown).rates(events)",
            "print(rates.to_string())",
        ]
        if done is not None and done < self.count:
            lines.append(f"# The page shows {done} of these realisations: cancelled.")
        return "\n".join(lines) + "\n"

    def script(self) -> str:
        """Python that computes what the page shows."""
        return self.rates_script(self.output, self.peak)

    def _study_imports(self) -> list[str]:
        """Say what scenario, designs and uncertainty import."""
        return [
            "from nmss_lab.cases import piecewise",
            "from nmss_lab.predict import Horizon",
            *self._uncertainty_imports(),
        ]

    def _uncertainty_imports(self) -> list[str]:
        if self.uncertainty == "covariance":
            return ["from nmss_lab.uncertainty import ParameterCovariance"]
        if self.uncertainty == "ranges":
            return ["from nmss_lab.uncertainty import RelativeRanges"]
        if self.uncertainty.startswith("stress"):
            return ["from nmss_lab.cases import stress"]
        return [
            "import functools",
            "from nmss_lab.continuous import ContinuousPlant",
            "from nmss_lab.models import DifferenceModel, LinearPlant",
            "from nmss_lab.uncertainty import Intervals",
        ]

    def _uncertainty_lines(self) -> list[str]:
        corners, example = self.uncertainty.endswith("_corners"), self.example
        dt = "example.plant.dt"
        if self.uncertainty == "covariance":
            model, covariance = example.model, example.covariance
            if covariance is not None and len(covariance) == model.na + model.nb:
                return [
                    "uncertainty = ParameterCovariance("
                    "example.model, example.covariance)"
                ]
            return [
                "model = example.model",
                "# a delay makes coefficients zero: these are certain",
                "parameters = np.concatenate([model.a.ravel(), model.b.ravel()])",
                "free = np.flatnonzero(parameters)",
                "covariance = np.zeros((len(parameters), len(parameters)))",
                "covariance[np.ix_(free, free)] = example.covariance",
                "uncertainty = ParameterCovariance(model, covariance)",
            ]
        if self.uncertainty == "ranges":
            return [f"uncertainty = RelativeRanges(example.model, {self._shares()})"]
        if self.uncertainty.startswith("stress"):
            return [
                f"uncertainty = stress({self.level}, {corners}, {dt}, "
                f"{example.plant.substeps})"
            ]
        function: Any = multiplied
        start = "functools.partial(multiplied, example.model)"
        if self.example.continuous is not None:
            function, start = (
                slower,
                f"functools.partial(slower, example.continuous, {dt}, "
                f"{example.plant.substeps})",
            )
        return [
            "",
            "",
            *inspect.getsource(function).splitlines(),
            "",
            "",
            f"build = {start}",
            f"intervals = {self._intervals()}",
            f"uncertainty = Intervals(build, intervals, corners={corners})",
        ]

    # To the page Receding horizon

    def keep_drawn(self, number: int, samples: int | None = None) -> str:
        """Keep the case with a plant that was drawn; return the name of its case.

        Parameters
        ----------
        number : int
            Of the realisation.
        samples : int, optional
            Where its scenario ends, if it is to be cut.
        """
        study, example = self.study(), self.example
        plant = realisation(study.uncertainty, number, study.seed).plant
        if isinstance(plant, DifferenceModel):
            plant = plant.plant()
        scenario = study.scenario
        if samples is not None:
            scenario = shortened(scenario, samples)
        drawn = replace(
            example,
            title=f"{example.title}: realisation {number}",
            plant=plant,
            designs=study.designs,
            scenario=scenario,
            notes=(self._of_drawn(number, samples), *example.notes),
            continuous=None,
        )
        lines = [
            *self._held_lines(),
            *self._case_lines(),
            *self._scenario_lines(),
            *self._uncertainty_lines(),
            *self._designs_lines(),
            f"plant = realisation(uncertainty, {number}, seed={study.seed}).plant",
            'plant = plant.plant() if hasattr(plant, "plant") else plant',
            *_shortening_lines(samples),
            "example = replace(",
            "    example, plant=plant, designs=designs, scenario=scenario, "
            "continuous=None",
            ")",
        ]
        imports = (
            *self._study_imports(),
            *self._cases_imports(),
            "from nmss_lab.uncertainty import realisation",
        )
        origin = Origin(imports, tuple(lines))
        return keep_case("drawn", f"{self.case}{lines}", drawn, origin)

    def _of_drawn(self, number: int, samples: int | None) -> str:
        seed = f" of seed {self.seed}" if self.uncertainty in DRAWN else ""
        words = f"The plant is realisation {number}{seed}, from the page Robustness"
        end = f"; the run is cut after {samples} samples, as it grows without end"
        return f"{words} ({KINDS[self.uncertainty]}){end if samples else ''}."


SERIES = "reference", "v", "input_disturbance", "output_disturbance", "noise", "manual"


def shortened(scenario: Scenario, samples: int) -> Scenario:
    """First samples of a scenario."""
    series = {name: getattr(scenario, name) for name in SERIES}
    return replace(
        scenario, **{k: x[:samples] for k, x in series.items() if x is not None}
    )


def _shortening_lines(samples: int | None) -> list[str]:
    if samples is None:
        return []
    return [
        f"series = {{name: getattr(scenario, name) for name in {SERIES}}}",
        f"series = {{k: x[:{samples}] for k, x in series.items() if x is not None}}",
        "scenario = replace(scenario, **series)",
    ]


def kinds_of(example: Case) -> list[str]:
    """Uncertainties that make sense for a case."""
    model = example.model
    single = (model.n_y, model.n_u, model.n_v) == (1, 1, 0)
    kinds = {
        "covariance": example.covariance is not None and single,
        "ranges": True,
        "stress": is_ifac93(example),
        "stress_corners": is_ifac93(example),
        "gains": True,
        "gains_corners": model.n_u < math.log2(MOST) - 1,
    }
    return [kind for kind, fits in kinds.items() if fits]


@functools.lru_cache(maxsize=64)
def usual_peak(example: Case) -> float:
    """Size of the first output that is worth counting, of the case or of its run."""
    if "allowed" in example.bands:
        return _largest(np.ravel(example.bands["allowed"][1])[:1])
    design = next(iter(example.designs.values()))
    with np.errstate(all="ignore"):
        run = closed_loop(example.plant, design.build(), example.scenario)
    y = run.y_fine[:, 0]
    return 1.5 * _largest(y[np.abs(y) < 1e6])


def is_ifac93(example: Case) -> bool:
    """Tell whether Table 4.1 is about the plant of a case."""
    continuous = example.continuous
    return continuous is not None and continuous.channels == ifac93_plant().channels


def at_channel(study: MonteCarlo, output: int, names: Iterable[str]) -> MonteCarlo:
    """Rows of one output only."""
    name = list(names)[output]
    table = study.table[study.table["output"] == name]
    return replace(study, table=table)


def centre(choices: RobustnessChoices) -> dict[str, float]:
    """Nominal values of the parameters that are drawn, by name."""
    plants, model = choices.plants(), choices.example.model
    if isinstance(plants, Intervals):
        pairs = plants.intervals.items()
        return {name: 0.5 * (low + high) for name, (low, high) in pairs}
    arrays = [np.asarray(getattr(model, letter)) for letter in "abg"]
    parameters = np.concatenate([array[np.nonzero(array)] for array in arrays])
    known = RelativeRanges(model, {}).names
    nominal = dict(zip(known, parameters.tolist(), strict=True))
    return {name: nominal.get(name, 0.0) for name in _drawn_names(plants)}


def _drawn_names(plants: Uncertainty) -> list[str]:
    return list(realisation(plants, 0).values)
