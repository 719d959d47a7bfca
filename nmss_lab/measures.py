"""Measures of a run: rise, settling, overshoot, errors, coupling, limits broken.

Measures of outputs use the output between the samples where the plant gives it.
Integrals are sums times the distance of the points: over the points after a change of
the reference where there are some between the samples, over the samples from the change
on otherwise, as in the thesis's tables.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from nmss_lab.controller import Limits
from nmss_lab.models import Array
from nmss_lab.simulate import Run


@dataclass(frozen=True)
class StepMeasures:
    """How one output answers one change of its reference.

    Times are in seconds after the change, nan where the event does not happen before
    the reference changes again.  Sizes are shares of the change of the reference: 0 is
    the old reference, 1 the new one.

    Parameters
    ----------
    start : float
        Time of the change.
    size : float
        Change of the reference, in the output's unit.
    t10, t90 : float
        When 10 and 90 % of the change are first reached, by linear interpolation.
    settling : float
        From when on the output stays within 5 % of the change around the reference.
    overshoot : float
        Largest value beyond 1, at least 0.
    undershoot : float
        Smallest value: negative where the output first goes the wrong way.
    peak : float
        Output at its farthest in the direction of the change, in its unit.
    iae : float
        Integral of the absolute error, in the output's unit times seconds.
    """

    start: float
    size: float
    t10: float
    t90: float
    settling: float
    overshoot: float
    undershoot: float
    peak: float
    iae: float

    @property
    def rise(self) -> float:
        """Time from 10 to 90 % of the change."""
        return self.t90 - self.t10


@dataclass(frozen=True)
class Violations:
    """How a signal breaks its limits.

    Parameters
    ----------
    samples : int
        Samples at which some channel is outside.
    worst : float
        Largest excess of any channel, in the signal's unit; 0 without any.
    """

    samples: int
    worst: float


@dataclass(frozen=True)
class Measures:
    """Measures of a whole run, for one output.

    Parameters
    ----------
    steps : tuple of StepMeasures
        One for each change of the output's reference.
    iae, ise : float
        Integrals of the absolute and the squared error.
    coupling : float
        Integral of the absolute error while only other references had changed.
    smoothness : float
        Root mean square of the changes of the inputs, all channels together.
    violations : mapping of "u", "du", "y" to Violations
        Against the controller's own limits.
    """

    steps: tuple[StepMeasures, ...]
    iae: float
    ise: float
    coupling: float
    smoothness: float
    violations: Mapping[str, Violations]


def measures(run: Run, channel: int = 0) -> Measures:
    """Measures of output number ``channel`` of a run.

    Raises
    ------
    ValueError
        If the run has no such output.
    """
    _check_channel(run, channel)
    error = _errors(run, channel)
    alone = np.repeat(_others_changed(run, channel), _points(run))
    return Measures(
        steps=steps(run, channel),
        iae=_integral(run, error),
        ise=_integral(run, error**2),
        coupling=_integral(run, error * alone),
        smoothness=float(np.sqrt(np.mean(run.du**2))),
        violations=violations(run),
    )


def steps(
    run: Run, channel: int = 0, until: int | None = None
) -> tuple[StepMeasures, ...]:
    """Measure each change of the reference of output number ``channel``.

    The output at the start is taken as the reference before the first sample; what
    happens from sample ``until`` on is left out.

    Raises
    ------
    ValueError
        If the run has no such output.
    """
    _check_channel(run, channel)
    r = run.r[:until, channel]
    before = np.concatenate([run.y[:1, channel], r[:-1]])
    changes = np.flatnonzero(np.abs(r - before) > 1e-12)
    return tuple(
        _step(run, channel, int(k), int(end), float(before[k]))
        for k, end in itertools.pairwise([*changes, len(r)])
    )


def iae(run: Run, channel: int = 0, first: int = 0, until: int | None = None) -> float:
    """Integral of the absolute error of an output from sample ``first`` on.

    What happens from sample ``until`` on is left out.

    Raises
    ------
    ValueError
        If the run has no such output.
    """
    _check_channel(run, channel)
    return _integral(run, _errors(run, channel, first, until))


def rejection(
    run: Run, first: int, channel: int = 0, input: int = 0
) -> dict[str, float]:
    """Measure how a run copes with what happens from sample ``first`` on.

    Parameters
    ----------
    run : Run
    first : int
        Sample from which on it is measured, such as that of a disturbance.
    channel, input : int
        Which output and which input.

    Returns
    -------
    dict of str to float
        "peak", the largest absolute error of the output, "IAE", its integral, and
        "travel", the sum of the absolute changes of the input.

    Raises
    ------
    ValueError
        If the run has no such sample, output or input.
    """
    _check_channel(run, channel)
    for name, value, size in (
        ("first", first, len(run)),
        ("input", input, run.u.shape[1]),
    ):
        if not 0 <= value < size:
            raise ValueError(f"{name} = {value}: expected 0 to {size - 1}")
    error = _errors(run, channel, first)
    return {
        "peak": float(error.max()),
        "IAE": _integral(run, error),
        "travel": float(np.abs(run.du[first:, input]).sum()),
    }


def violations(run: Run, limits: Limits | None = None) -> dict[str, Violations]:
    """Violations of limits on "u", "du" and "y", the controller's own by default.

    Outputs are looked at between the samples too, and counted once a sample.
    """
    limits = limits or run.controller.limits
    model = run.controller.model
    excess = {
        "u": _excess(run.u, limits.of("u", model.n_u)),
        "du": _excess(run.du, limits.of("du", model.n_u)),
        "y": _per_sample(run, _excess(run.y_fine, limits.of("y", model.n_y))),
    }
    return {
        name: Violations(int((over > 1e-6).sum()), float(over.max()))
        for name, over in excess.items()
    }


def table(runs: Mapping[str, Run], channel: int = 0) -> list[dict[str, str | float]]:
    """Rows for display, one a run: measures of the first step and of the whole run.

    Times are in seconds, overshoot in per cent; nan where a step has no such time.
    """
    return [
        {"run": name, **summary(measures(run, channel))} for name, run in runs.items()
    ]


def summary(found: Measures) -> dict[str, float]:
    """Row of ``table`` for the measures of a run, without its name."""
    first = found.steps[0] if found.steps else None
    broken = sum(part.samples for part in found.violations.values())
    return {
        "rise": first.rise if first else np.nan,
        "settling": first.settling if first else np.nan,
        "overshoot": 100.0 * first.overshoot if first else np.nan,
        "IAE": found.iae,
        "ISE": found.ise,
        "coupling": found.coupling,
        "RMS du": found.smoothness,
        "violations": float(broken),
    }


def _step(run: Run, channel: int, k: int, end: int, before: float) -> StepMeasures:
    window = _window(run, k, end)
    t, y = run.t_fine[window] - run.t[k], run.y_fine[window, channel]
    r = float(run.r[k, channel])
    done = (y - before) / (r - before)
    farthest = int(np.argmax(done))
    return StepMeasures(
        start=float(run.t[k]),
        size=r - before,
        t10=first_reach(t, done, 0.1),
        t90=first_reach(t, done, 0.9),
        settling=_settled(t, np.abs(done - 1.0) <= 0.05),
        overshoot=max(float(done[farthest]) - 1.0, 0.0),
        undershoot=float(done.min()),
        peak=float(y[farthest]),
        iae=_integral(run, np.abs(y - r)),
    )


def _errors(run: Run, channel: int, first: int = 0, until: int | None = None) -> Array:
    """Absolute errors of an output, between the samples too, of some samples."""
    last = len(run) if until is None else until
    r = np.repeat(run.r[first:last, channel], _points(run))
    errors: Array = np.abs(r - run.y_fine[_window(run, first, last), channel])
    return errors


def _window(run: Run, k: int, end: int) -> slice:
    """Rows of ``y_fine`` from sample ``k`` to sample ``end``."""
    per_sample = (len(run.t_fine) - 1) // len(run)
    if per_sample:
        return slice(1 + k * per_sample, 1 + end * per_sample)
    return slice(k, end)


def first_reach(t: Array, done: Array, share: float) -> float:
    """First time at which ``done`` rises to ``share``; nan if it never does."""
    above = done >= share
    if not above.any():
        return float("nan")
    i = int(np.argmax(above))
    if i == 0:
        return float(t[0])
    slope = (done[i] - done[i - 1]) / (t[i] - t[i - 1])
    return float(t[i - 1] + (share - done[i - 1]) / slope)


def _settled(t: Array, inside: Array) -> float:
    """First time from which on all are inside; nan if the last one is not."""
    if not inside[-1]:
        return float("nan")
    outside = np.flatnonzero(~inside)
    return float(t[outside[-1] + 1]) if outside.size else float(t[0])


def _integral(run: Run, values: Array) -> float:
    """Sum over points of the output times their distance."""
    return float(values.sum() * run.controller.model.dt / _points(run))


def _points(run: Run) -> int:
    """Known values of the output in a sampling interval."""
    return max((len(run.t_fine) - 1) // len(run), 1)


def _others_changed(run: Run, channel: int) -> Array:
    """Tell samples (N,) after other references changed and before this one does."""
    before = np.concatenate([run.y[:1], run.r[:-1]])
    moved = np.abs(run.r - before) > 1e-12
    own, others = moved[:, channel], np.delete(moved, channel, axis=1).any(axis=1)
    when = np.arange(len(run))
    last_own = np.maximum.accumulate(np.where(own, when, -1))
    last_other = np.maximum.accumulate(np.where(others, when, -1))
    alone: Array = last_other > last_own
    return alone


def _excess(signal: Array, sides: tuple[Array, Array]) -> Array:
    """How far the worst channel is outside at each row; 0 where none is."""
    low, high = sides
    over = np.maximum(low - signal, signal - high)
    worst: Array = np.maximum(over.max(axis=1), 0.0)
    return worst


def _per_sample(run: Run, excess: Array) -> Array:
    """Largest excess (N,) in the interval after each sample."""
    inside = excess[_window(run, 0, len(run))].reshape(len(run), -1)
    worst: Array = inside.max(axis=1)
    return worst


def _check_channel(run: Run, channel: int) -> None:
    if not 0 <= channel < run.y.shape[1]:
        raise ValueError(
            f"channel = {channel}: the run has outputs 0 to {run.y.shape[1] - 1}"
        )
