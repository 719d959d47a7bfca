"""Comparison of designs: one plant, one scenario, one sheet of scores."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from nmss_lab.analysis import LinearLoop, linear_loop
from nmss_lab.cases import Case
from nmss_lab.design import Design
from nmss_lab.matching import equal_speed
from nmss_lab.measures import iae, measures, steps
from nmss_lab.models import (
    Array,
    DifferenceModel,
    LinearPlant,
    Numbers,
    observable_part,
)
from nmss_lab.mpc import STRUCTURES
from nmss_lab.simulate import DIVERGED, Run, Scenario, closed_loop

FADING = 0.3
"""Modulus below which a mode is gone within four samples."""


@dataclass(frozen=True, eq=False)
class Score:
    """What one design does on the plant, see ``compare``.

    Parameters
    ----------
    loop : LinearLoop
        Around the plant, with no limit active; states of the plant that no output
        shows are left out.
    hidden_modes : complex array
        Those of the loop around the controller's own model that take more than three
        samples to die out; long histories put many others near the origin.
    run : Run
        With limits.
    figures : mapping of str to float
        Of the loop without limits: "largest pole", "hidden modes" (how many),
        "largest hidden" (modulus, nan without any), "offset u" and "offset y" (error
        that a unit step at the input and at the output leaves, inf where the output
        never comes to rest), "peak S_o", "peak S_i" (largest singular values over
        frequency) and "margin" (relative error of the plant, at its output, below
        which the loop stays stable whatever the error is: 1 / peak of T_o; zero if
        the loop is not stable).

        Of the run: "rise", "settling" (s), "overshoot" (%) and "IAE r" of the first
        change of the reference, until a disturbance sets in; "IAE d" from then on;
        "RMS du" of the whole run; nan where there is none, or the run diverged.
    """

    loop: LinearLoop
    hidden_modes: Array
    run: Run
    figures: Mapping[str, float]


def compare(
    designs: Mapping[str, Design],
    plant: LinearPlant | DifferenceModel,
    scenario: Scenario,
    channel: int = 0,
) -> dict[str, Score]:
    """Score designs on the same plant in the same scenario.

    Parameters
    ----------
    designs : mapping of str to Design
        On difference equations, by name.
    plant : LinearPlant or DifferenceModel
    scenario : Scenario
        The first change of anything but the reference is the disturbance.
    channel : int
        Output whose response is measured.

    Returns
    -------
    dict of str to Score

    Raises
    ------
    ValueError
        If a design cannot be built, or does not fit plant or scenario; says which.

    Examples
    --------
    Feedback and forward path, a plant that is stronger than the model:

    >>> from nmss_lab.predict import Horizon
    >>> model = DifferenceModel([-0.9], [0.1])
    >>> designs = {
    ...     name: Design(name, model, Horizon(20, 5), R=0.1)
    ...     for name in ("wang_young", "forward_path")
    ... }
    >>> step = Scenario(np.ones(60), input_disturbance=np.repeat([0.0, 0.5], 30))
    >>> for name, score in compare(designs, model.varied(1.2), step).items():
    ...     print(name, round(score.figures["IAE d"], 2))
    wang_young 0.22
    forward_path 1.19
    """
    at = disturbed_from(scenario)
    return {
        name: _score(name, design, plant, scenario, channel, at)
        for name, design in designs.items()
    }


def all_structures(example: Case) -> Case:
    """Case with one design of every structure that suits its model.

    The case's own where it has some, the first of each predictive structure, then its
    PIP controllers and governors.  Others are made by ``equal_speed`` from the first
    predictive design, and named by their structure.

    Examples
    --------
    >>> from nmss_lab.cases import model_case
    >>> example = model_case(DifferenceModel([-0.9], [0.1]))
    >>> sorted(set(all_structures(example).designs) - set(example.designs))
    ['forward_path']
    """
    known, designs = example.designs, dict[str, Design]()
    main = next((d for d in known.values() if d.structure in STRUCTURES), None)
    for structure in STRUCTURES:
        own = [key for key, design in known.items() if design.structure == structure]
        if own:
            key = structure if structure in own else own[0]
            designs[key] = known[key]
        elif main is not None:
            with contextlib.suppress(ValueError, np.linalg.LinAlgError):
                designs[structure] = equal_speed(main, structure)
    gains = {k: d for k, d in known.items() if d.structure in ("pip", "governor")}
    return replace(example, designs={**designs, **gains})


def in_deviations(design: Design, u0: Numbers, y0: Numbers) -> Design:
    """Design for signals that are deviations from an operating point.

    Its limits on u and y are moved; laws are linear, and those on du stay.

    Parameters
    ----------
    design : Design
    u0, y0 : arrays (n_u,), (n_y,)
        Input and output at the operating point.
    """
    limits = design.limits
    (low_u, high_u), (low_y, high_y) = limits.u, limits.y
    u, y = np.asarray(u0, float), np.asarray(y0, float)
    moved = replace(limits, u=(low_u - u, high_u - u), y=(low_y - y, high_y - y))
    return replace(design, limits=moved)


def disturbed_from(scenario: Scenario) -> int | None:
    """First sample at which a disturbance, measured or not, is another one."""
    starts = []
    for name in ("v", "input_disturbance", "output_disturbance"):
        series = getattr(scenario, name)
        if series is None:
            continue
        before = scenario.v0 if name == "v" and scenario.v0 is not None else 0.0
        known = np.vstack([np.broadcast_to(before, series.shape[1]), series[:-1]])
        changed = np.flatnonzero((series != known).any(axis=1))
        starts += changed[:1].tolist()
    return min(starts, default=None)


def _score(
    name: str,
    design: Design,
    plant: LinearPlant | DifferenceModel,
    scenario: Scenario,
    channel: int,
    at: int | None,
) -> Score:
    try:
        controller = design.build()
        seen = plant.plant() if isinstance(plant, DifferenceModel) else plant
        loop = linear_loop(controller, observable_part(seen))
        with np.errstate(all="ignore"):
            run = closed_loop(plant, controller, scenario)
            figures = {**_of_loop(loop), **_of_run(run, channel, at)}
    except (ValueError, np.linalg.LinAlgError) as error:
        raise ValueError(f"{name}: {error}") from error
    hidden = linear_loop(controller).hidden_modes
    hidden = hidden[np.abs(hidden) > FADING]
    figures["hidden modes"] = float(len(hidden))
    figures["largest hidden"] = float(np.abs(hidden).max()) if len(hidden) else np.nan
    return Score(loop, hidden, run, figures)


def _of_loop(loop: LinearLoop) -> dict[str, float]:
    stable = loop.is_stable
    return {
        "largest pole": loop.radius,
        "offset u": loop.offset("S_i"),
        "offset y": loop.offset("S_o"),
        "peak S_o": loop.peak("S_o").gain,
        "peak S_i": loop.peak("S_i").gain,
        "margin": 1.0 / loop.peak("T_o").gain if stable else 0.0,
    }


def _of_run(run: Run, channel: int, at: int | None) -> dict[str, float]:
    names = "rise", "settling", "overshoot", "IAE r", "IAE d", "RMS du"
    if not np.all(np.abs(run.y_fine) < DIVERGED):
        return dict.fromkeys(names, np.nan)
    first = next(iter(steps(run, channel, at)), None)
    return {
        "rise": first.rise if first else np.nan,
        "settling": first.settling if first else np.nan,
        "overshoot": 100.0 * first.overshoot if first else np.nan,
        "IAE r": first.iae if first else np.nan,
        "IAE d": np.nan if at is None else iae(run, channel, at),
        "RMS du": measures(run, channel).smoothness,
    }
