"""Measures on runs whose answers are known by hand."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from conftest import ALGEBRA

from nmss_lab import cases
from nmss_lab.controller import Limits
from nmss_lab.design import Design
from nmss_lab.measures import iae, measures, steps, table, violations
from nmss_lab.models import DifferenceModel
from nmss_lab.predict import Horizon
from nmss_lab.simulate import Run, Scenario, closed_loop


def made_up(
    reference: Sequence[Any], y: Sequence[Any], fine: Sequence[Any] | None = None
) -> Run:
    """Return a run with given reference and output, dt = 2 s, and zero input.

    ``fine`` holds the outputs after the first one, several a sample.
    """
    r, out = (np.array(part, dtype=float) for part in (reference, y))
    r, out = r.reshape(len(r), -1), out.reshape(len(out), -1)
    p = r.shape[1]
    model = DifferenceModel(-0.5 * np.eye(p)[None], np.eye(p)[None], dt=2.0)
    limits = Limits(u=(-1.0, 1.0), du=(-0.5, 0.5), y=(-2.0, 2.0))
    controller = Design("wang_young", model, Horizon(5, 2), limits=limits).build()
    run = closed_loop(model.plant(), controller, Scenario(0.0 * r))
    t_fine, y_fine = run.t, out
    if fine is not None:
        inside = np.array(fine, dtype=float).reshape(-1, p)
        step = 2.0 * len(r) / len(inside)
        t_fine = step * np.arange(len(inside) + 1)
        y_fine = np.vstack([out[:1], inside])
    return dataclasses.replace(run, r=r, y=out, t_fine=t_fine, y_fine=y_fine)


def test_a_ramp() -> None:
    """From 0 to 1 in ten samples of 0.1, then at rest: everything by hand."""
    y = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.0, 1.0]
    (step,) = steps(made_up([1.0] * 13, y))
    assert (step.start, step.size) == (0.0, 1.0)
    assert step.t10 == pytest.approx(2.0, abs=ALGEBRA)
    assert step.t90 == pytest.approx(18.0, abs=ALGEBRA)
    assert step.rise == pytest.approx(16.0, abs=ALGEBRA)
    assert step.settling == pytest.approx(20.0, abs=ALGEBRA)
    assert step.overshoot == 0.0
    assert step.undershoot == 0.0
    assert step.peak == 1.0
    assert step.iae == pytest.approx(2.0 * 5.5, abs=ALGEBRA)


def test_times_are_interpolated() -> None:
    """10 and 90 % fall between samples."""
    (step,) = steps(made_up([1.0] * 3, [0.0, 0.4, 1.4]))
    assert step.t10 == pytest.approx(0.5, abs=ALGEBRA)
    assert step.t90 == pytest.approx(3.0, abs=ALGEBRA)
    assert step.overshoot == pytest.approx(0.4, abs=ALGEBRA)


def test_a_step_down_after_a_step_up() -> None:
    """Sizes are shares of the change of the reference, whatever its sign."""
    reference = [1.0] * 3 + [-1.0] * 4
    y = [0.0, 1.2, 1.0, 1.0, 1.2, -1.5, -1.0]
    up, down = steps(made_up(reference, y))
    assert up.overshoot == pytest.approx(0.2, abs=ALGEBRA)
    assert (down.start, down.size) == (6.0, -2.0)
    assert down.undershoot == pytest.approx(-0.1, abs=ALGEBRA)
    assert down.overshoot == pytest.approx(0.25, abs=ALGEBRA)
    assert down.peak == -1.5
    assert down.settling == pytest.approx(6.0, abs=ALGEBRA)


def test_what_never_happens_is_nan() -> None:
    """An output that stays away neither rises nor settles."""
    (step,) = steps(made_up([1.0] * 5, [0.0] * 5))
    assert np.isnan([step.t10, step.t90, step.rise, step.settling]).all()
    assert step.iae == 10.0


def test_no_step_no_measures_of_steps() -> None:
    """A constant reference at the output has no steps, and the table says nan."""
    run = made_up([0.0] * 4, [0.0, 1.0, 0.5, 0.0])
    assert steps(run) == ()
    (row,) = table({"quiet": run})
    assert row["run"] == "quiet"
    assert np.isnan([row["rise"], row["settling"], row["overshoot"]]).all()
    assert row["IAE"] == pytest.approx(3.0, abs=ALGEBRA)
    assert row["ISE"] == pytest.approx(2.5, abs=ALGEBRA)


def test_between_the_samples() -> None:
    """A peak between samples counts, and integrals use the finer points."""
    fine = [0.0, 1.5, 1.0, 1.0]
    (step,) = steps(made_up([1.0, 1.0], [0.0, 1.5], fine))
    assert step.overshoot == pytest.approx(0.5, abs=ALGEBRA)
    assert step.iae == pytest.approx(1.5, abs=ALGEBRA)
    assert step.t90 == pytest.approx(1.0 + 0.6, abs=ALGEBRA)


def test_coupling_is_what_other_references_cause() -> None:
    """Only errors after another reference changed, and before its own does, count."""
    reference = [[0, 0], [1, 0], [1, 0], [1, 1], [1, 1]]
    y = [[0, 0], [0, 0.3], [1, 0.2], [0.5, 0], [1, 1]]
    run = made_up(reference, y)
    assert measures(run, 0).coupling == pytest.approx(2.0 * 0.5, abs=ALGEBRA)
    assert measures(run, 1).coupling == pytest.approx(2.0 * 0.5, abs=ALGEBRA)


def test_violations_are_counted_once_a_sample() -> None:
    """Channels and points between samples do not count twice."""
    run = made_up([[0, 0]] * 3, [[0, 0], [3, -2.5], [0, 0]])
    run = dataclasses.replace(
        run, u=np.array([[1.5, -1.2], [0, 0], [0, 1]]), du=np.full((3, 2), 0.5)
    )
    found = violations(run)
    assert (found["u"].samples, found["du"].samples, found["y"].samples) == (1, 0, 1)
    assert found["u"].worst == pytest.approx(0.5, abs=ALGEBRA)
    assert found["y"].worst == pytest.approx(1.0, abs=ALGEBRA)
    wide = violations(run, Limits())
    assert all(part == type(part)(0, 0.0) for part in wide.values())


def test_violations_between_samples() -> None:
    """An excursion between two samples is a violation of that sample."""
    fine = [0.0, 2.5, 0.0, 0.0, 0.0, 0.0]
    run = made_up([0.0] * 3, [0.0] * 3, fine)
    assert violations(run)["y"].samples == 1


def test_smoothness() -> None:
    """Root mean square of all changes of the inputs."""
    run = made_up([0.0] * 4, [0.0] * 4)
    run = dataclasses.replace(run, du=np.array([[3.0], [0.0], [-4.0], [0.0]]))
    assert measures(run).smoothness == pytest.approx(2.5, abs=ALGEBRA)


def test_a_channel_that_is_not_there() -> None:
    """The message names the argument and what there is."""
    run = made_up([0.0] * 3, [0.0] * 3)
    for function in (measures, steps):
        with pytest.raises(ValueError, match="channel = 1: the run has outputs 0 to 0"):
            function(run, 1)


def test_measures_of_every_case_are_numbers() -> None:
    """Integrals are finite for a run of each kind of plant."""
    for name in ("ifac93_4_4_2", "shell_5_3_2", "temperature_7_4_2"):
        case = cases.case(name)
        run = closed_loop(
            case.plant, next(iter(case.designs.values())).build(), case.scenario
        )
        for channel in range(run.y.shape[1]):
            found = measures(run, channel)
            assert np.isfinite([found.iae, found.ise, found.coupling]).all()


def test_windows_end_where_they_are_told_to() -> None:
    """A disturbance from sample 3 on is left out of a step, and measured alone."""
    run = made_up([1.0] * 6, [0.0, 0.5, 1.0, 1.4, 1.2, 1.0])
    (step,) = steps(run, until=3)
    assert step.overshoot == 0.0
    assert step.settling == pytest.approx(4.0)
    assert step.iae == pytest.approx(2.0 * 1.5)
    assert iae(run, until=3) == pytest.approx(2.0 * 1.5)
    assert iae(run, first=3) == pytest.approx(2.0 * 0.6)
    assert iae(run) == pytest.approx(measures(run).iae)
    assert steps(run, until=0) == ()
    fine = [0.0, 1.0, 1.0, 1.0, 3.0, 1.0]
    between = made_up([1.0] * 3, [0.0, 1.0, 1.0], fine)
    assert iae(between, first=2) == pytest.approx(2.0 * 2.0 / 2.0)
    with pytest.raises(ValueError, match="channel = 1"):
        iae(run, 1)
