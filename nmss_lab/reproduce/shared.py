"""Runs and loops that several chapters compare with."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from nmss_lab import cases
from nmss_lab.analysis import LinearLoop, linear_loop
from nmss_lab.design import Design
from nmss_lab.measures import steps, violations
from nmss_lab.models import Array, LinearPlant, Plant
from nmss_lab.predict import Horizon
from nmss_lab.predictive import PredictiveController
from nmss_lab.simulate import Equation, Run, Scenario, closed_loop, closed_loops
from nmss_lab.uncertainty import realisations


def simulated(design: Design, plant: Plant | Equation, scenario: Scenario) -> Run:
    """Run a design in closed loop."""
    return closed_loop(plant, design.build(), scenario)


def loop_of(design: Design, plant: LinearPlant | None = None) -> LinearLoop:
    """Close the loop of a design without limits."""
    return linear_loop(design.build(), plant)


def built(design: Design) -> PredictiveController:
    """Build a predictive design.

    Raises
    ------
    TypeError
        If the structure makes no predictions.
    """
    controller = design.build()
    if not isinstance(controller, PredictiveController):
        raise TypeError(f'structure "{design.structure}" is not predictive')
    return controller


def keeps_limits(run: Run) -> bool:
    """Whether input levels and rates stay within the controller's limits."""
    found = violations(run)
    return found["u"].samples == found["du"].samples == 0


@functools.cache
def case_of(name: str) -> cases.Case:
    """Build a case once."""
    return cases.case(name)


def short_sighted(structure: str) -> LinearLoop:
    """Nominal loop on plant (6.10) with horizons too short for its zero at 2."""
    model = case_of("marginally_stable_6_3_2").model
    return loop_of(Design(structure, model, Horizon(3, 3)))


POINTS = tuple(1.2 * np.exp(1j * np.linspace(0.2, 3.0, 5)))
"""Where transfer functions are compared: outside the unit circle."""


def value_at(polynomial: Array, z: complex) -> Array:
    """Value of a matrix polynomial in z^-1."""
    powers = z ** -np.arange(float(len(polynomial)))
    value: Array = np.tensordot(powers, polynomial, 1)
    return value


@functools.cache
def corners() -> list[LinearPlant]:
    """Plants of stress level 2, with outputs every 25 ms."""
    return [d.plant for d in realisations(cases.stress(2, corners=True, substeps=20))]


@dataclass(frozen=True)
class Robust:
    """The 32 corners under one design."""

    peaks: Array
    radii: Array
    rises: Array
    smoothness: float

    def beyond(self, level: float) -> int:
        """Corners whose output leaves a band."""
        return int((self.peaks > level).sum())

    @property
    def unstable(self) -> int:
        """Corners in which the loop without limits is unstable."""
        return int((self.radii >= 1.0).sum())


@functools.cache
def robust(case_name: str, design_name: str) -> Robust:
    """Run a design of a case on the 32 corners, once."""
    return robustness(case_of(case_name).designs[design_name])


def robustness(design: Design) -> Robust:
    """Run any design for the IFAC'93 benchmark on the 32 corners."""
    controller = design.build()
    scenario = case_of("ifac93_4_4_2").scenario
    runs = closed_loops(corners(), controller, scenario)
    return Robust(
        np.array([np.abs(run.y_fine).max() for run in runs]),
        np.array([linear_loop(controller, plant).radius for plant in corners()]),
        np.array([steps(run)[0].rise for run in runs]),
        float(np.sqrt(np.mean([run.du**2 for run in runs]))),
    )


@functools.cache
def nominal(case_name: str, design_name: str) -> Run:
    """Run a design of a case in the case's own scenario, once."""
    case = case_of(case_name)
    return simulated(case.designs[design_name], case.plant, case.scenario)
