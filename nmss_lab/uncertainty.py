"""Plants that one does not have: what is uncertain, draws of it, and its bounds.

An uncertainty draws plants one by one.  A realisation is known by its number and a
seed alone, so it is the same in any study, in any order, on any machine.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy.optimize

from nmss_lab.analysis import LinearLoop, linear_loop
from nmss_lab.controller import Controller
from nmss_lab.identify import Estimate, combine
from nmss_lab.identify.estimate import draw
from nmss_lab.models import Array, DifferenceModel, LinearPlant, minimal_realisation


@dataclass(frozen=True, eq=False)
class Draw:
    """One plant that might be the true one.

    Parameters
    ----------
    plant : LinearPlant, DifferenceModel or any plant
    values : mapping of str to float
        The parameters that were drawn, by name.
    """

    plant: Any
    values: Mapping[str, float] = field(default_factory=dict)


class Uncertainty(Protocol):
    """Anything that draws plants; ``size`` is None where there is no last one."""

    @property
    def size(self) -> int | None:
        """Number of realisations there are, None without an end."""

    def draw(self, i: int, rng: np.random.Generator) -> Draw:
        """Draw realisation number ``i``."""


def realisation(uncertainty: Uncertainty, i: int, seed: int = 0) -> Draw:
    """Draw realisation number ``i`` of a seed: the same wherever it is asked for.

    Parameters
    ----------
    uncertainty : Uncertainty
    i, seed : int
    """
    return uncertainty.draw(i, np.random.default_rng([seed, i]))


def realisations(
    uncertainty: Uncertainty, n: int | None = None, seed: int = 0
) -> list[Draw]:
    """Draw the first realisations of a seed, all there are without ``n``.

    Raises
    ------
    ValueError
        If there is no last one and ``n`` does not say how many.
    """
    n = uncertainty.size if n is None else n
    if n is None:
        raise ValueError("n is missing: this uncertainty has no last realisation")
    return [realisation(uncertainty, i, seed) for i in range(n)]


@dataclass(frozen=True, eq=False)
class RelativeRanges:
    """Coefficients of a difference equation, each uniform around its value (6.11).

    Parameters
    ----------
    model : DifferenceModel
    share : mapping of str to float
        Largest relative deviation, by a group, "a", "b" or "g", or by a coefficient
        such as "a1" or "b2[1,3]" (lag, output, input; the indices only where there
        are several).  What is not named stays.

    Raises
    ------
    ValueError
        If a name is unknown or a share is negative.
    """

    model: DifferenceModel
    share: Mapping[str, float]

    size = None

    def __post_init__(self) -> None:
        """Check the names."""
        known = {"a", "b", "g", *self.names}
        for name, share in self.share.items():
            if name not in known:
                raise ValueError(
                    f'share "{name}": expected "a", "b", "g" or one of '
                    f"{', '.join(self.names)}"
                )
            if not 0.0 <= share < np.inf:
                raise ValueError(f'share "{name}" = {share}: expected 0 or more')

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients that are not zero."""
        return tuple(name for name, _, _ in _coefficients(self.model))

    def draw(self, i: int, rng: np.random.Generator) -> Draw:
        """Draw every coefficient that may vary."""
        parts = {letter: getattr(self.model, letter).copy() for letter in "abg"}
        values = {}
        for name, letter, place in _coefficients(self.model):
            share = self.share.get(name, self.share.get(letter, 0.0))
            if share:
                parts[letter][place] *= 1.0 + share * rng.uniform(-1.0, 1.0)
                values[name] = float(parts[letter][place])
        return Draw(dataclasses.replace(self.model, **parts), values)


def _coefficients(
    model: DifferenceModel,
) -> Iterator[tuple[str, str, tuple[int, ...]]]:
    """Name, letter and place of each coefficient that is not zero."""
    for letter in "abg":
        array = getattr(model, letter)
        for place in zip(*np.nonzero(array), strict=True):
            lag, *rest = (int(index) + 1 for index in place)
            several = array.shape[1:] != (1, 1)
            index = f"[{','.join(map(str, rest))}]" if several else ""
            yield f"{letter}{lag}{index}", letter, place


@dataclass(frozen=True, eq=False)
class ParameterCovariance:
    """Parameters of a single-output equation, normal with a covariance (6.8), (6.9).

    Parameters
    ----------
    model : DifferenceModel
        One output and one input.
    covariance : array (na + nb, na + nb)
        P* of a_1 ... a_na, b_1 ... b_nb.

    Raises
    ------
    ValueError
        If the sizes do not fit, or the covariance has a negative eigenvalue.
    """

    model: DifferenceModel
    covariance: Array

    size = None

    def __post_init__(self) -> None:
        """Check size and sign."""
        model, count = self.model, self.model.na + self.model.nb
        if (model.n_y, model.n_u, model.n_v) != (1, 1, 0):
            raise ValueError(
                f"model has {model.n_y} outputs, {model.n_u} inputs and {model.n_v} "
                "disturbances, expected one output and one input; for others see "
                "EstimatedModels"
            )
        if np.shape(self.covariance) != (count, count):
            raise ValueError(
                f"covariance has shape {np.shape(self.covariance)}, expected "
                f"({count}, {count})"
            )
        sizes = np.linalg.eigvalsh(self.covariance)
        if sizes[0] < -1e-9 * abs(sizes[-1]):
            raise ValueError(
                f"covariance has the negative eigenvalue {sizes[0]:.3g}: it is none"
            )

    @cached_property
    def _factor(self) -> Array:
        sizes, axes = np.linalg.eigh(self.covariance)
        return axes * np.sqrt(np.maximum(sizes, 0.0))

    def draw(self, i: int, rng: np.random.Generator) -> Draw:
        """Draw all parameters together."""
        a, b = self.model.a, self.model.b
        center = np.concatenate([a.ravel(), b.ravel()])
        drawn = center + self._factor @ rng.standard_normal(center.size)
        new_a, new_b = np.split(drawn, [a.size])
        names = [f"a{i + 1}" for i in range(a.size)]
        names += [f"b{i + 1}" for i in range(b.size)]
        model = dataclasses.replace(
            self.model, a=new_a.reshape(a.shape), b=new_b.reshape(b.shape)
        )
        return Draw(model, dict(zip(names, drawn.tolist(), strict=True)))


@dataclass(frozen=True, eq=False)
class EstimatedModels:
    """Models drawn from what identification left uncertain, N(p, P*).

    Parameters
    ----------
    estimates : sequence of Estimate
        One an output, all from records with the same inputs.
    """

    estimates: Sequence[Estimate]

    size = None

    def draw(self, i: int, rng: np.random.Generator) -> Draw:
        """Draw the parameters of every output."""
        drawn = [(e, draw(e, 1, rng)[0]) for e in self.estimates]
        model = combine([dataclasses.replace(e, parameters=p) for e, p in drawn])
        values = {
            f"{e.record.names['y'][0]}: {name}" if len(drawn) > 1 else name: float(x)
            for e, p in drawn
            for name, x in zip(e.names, p, strict=True)
        }
        return Draw(model, values)


@dataclass(frozen=True, eq=False)
class Intervals:
    """Named parameters of any plant, each within an interval.

    Parameters
    ----------
    build : callable
        Takes the parameters by name and returns a plant; a function of a module, so
        that it can be sent to other processes.
    intervals : mapping of str to (low, high)
    corners : bool
        Whether to take all 2^n corners, in the order of
        ``itertools.product((low, high), ...)``, instead of uniform draws.

    Raises
    ------
    ValueError
        If an interval is empty or not finite.
    """

    build: Callable[..., Any]
    intervals: Mapping[str, tuple[float, float]]
    corners: bool = False

    def __post_init__(self) -> None:
        """Check the intervals."""
        for name, (low, high) in self.intervals.items():
            if not (np.isfinite([low, high]).all() and low <= high):
                raise ValueError(f'interval "{name}" = ({low}, {high}) is empty')

    @property
    def size(self) -> int | None:
        """Number of corners, or None for draws."""
        return 2 ** len(self.intervals) if self.corners else None

    def draw(self, i: int, rng: np.random.Generator) -> Draw:
        """Draw each parameter, or take corner number ``i``."""
        if self.corners:
            count = 2 ** len(self.intervals)
            if not 0 <= i < count:
                raise ValueError(f"corner {i}: expected one from 0 to {count - 1}")
            sides = itertools.product(*self.intervals.values())
            drawn = next(itertools.islice(sides, i, None))
        else:
            drawn = tuple(rng.uniform(*pair) for pair in self.intervals.values())
        values = {n: float(x) for n, x in zip(self.intervals, drawn, strict=True)}
        return Draw(self.build(**values), values)


@dataclass(frozen=True, eq=False)
class Sampler:
    """Plants of a function of one's own.

    Parameters
    ----------
    function : callable
        Takes a ``numpy.random.Generator`` and returns a plant, or a plant and a
        mapping of the values drawn.
    """

    function: Callable[[np.random.Generator], Any]

    size = None

    def draw(self, i: int, rng: np.random.Generator) -> Draw:
        """Ask the function."""
        drawn = self.function(rng)
        return Draw(*drawn) if isinstance(drawn, tuple) else Draw(drawn)


@dataclass(frozen=True)
class Bounds:
    """How far a factor may go before a pole leaves its circle: Table 6.1.

    Parameters
    ----------
    low, high : float
        Factors below and above 1; where the walk ended without one, the end of the
        walk.
    low_pole, high_pole : complex
        Place of the nominal pole that leaves first; nan where none did.
    """

    low: float
    high: float
    low_pole: complex
    high_pole: complex


def uncertainty_bounds(
    controller: Controller,
    plant_of: Callable[[float], LinearPlant | DifferenceModel],
    distance: float = 0.1,
    step: float = 0.002,
    reach: tuple[float, float] = (0.0, 10.0),
) -> Bounds:
    """Walk from the nominal plant until a closed-loop pole leaves its circle.

    Table 6.1 for any plant, structure and factor: every pole is matched with a
    nominal one so that the largest distance is smallest, modes included that
    cancel in the response to the reference.

    Parameters
    ----------
    controller : Controller
    plant_of : callable
        Plant for a factor; 1 is the nominal one.
    distance : float
        Radius of the circles.
    step : float
        Length of the steps of the walk; the bound itself is found to 1e-10.
    reach : pair of float
        Where the walk ends.

    Raises
    ------
    ValueError
        If ``distance`` or ``step`` is not positive.
    """
    if not (distance > 0.0 and step > 0.0):
        raise ValueError(
            f"distance = {distance}, step = {step}: expected positive numbers"
        )
    nominal = visible_poles(linear_loop(controller, plant_of(1.0)))

    def moved(factor: float) -> Array:
        poles = visible_poles(linear_loop(controller, plant_of(factor)))
        return _moved(nominal, poles)

    def excess(factor: float) -> float:
        return float(moved(factor).max(initial=0.0)) - distance

    ends, left = [], []
    for end in reach:
        inner, side = 1.0, step if end > 1.0 else -step
        while abs(inner + side - 1.0) <= abs(end - 1.0) and excess(inner + side) < 0.0:
            inner += side
        if abs(inner + side - 1.0) > abs(end - 1.0):
            ends.append(end)
            left.append(complex("nan"))
            continue
        bound = scipy.optimize.brentq(excess, inner, inner + side, xtol=1e-10)
        ends.append(float(bound))
        left.append(complex(nominal[int(np.argmax(moved(bound)))]))
    return Bounds(ends[0], ends[1], left[0], left[1])


def visible_poles(loop: LinearLoop) -> Array:
    """Poles which some reference or disturbance excites and y shows.

    Without the poles at the origin that histories add, but with the modes that cancel
    in T(z).
    """
    B = np.hstack([*loop.B_r, loop.B_u, loop.B_y])
    return np.linalg.eigvals(minimal_realisation(loop.A, B, loop.C)[0])


def _moved(nominal: Array, poles: Array) -> Array:
    """Distance of each nominal pole from the one it is matched with.

    A pole that only one of the sets has lies at the origin: there it cancels.
    """
    size = max(len(nominal), len(poles))
    nominal, poles = (np.pad(p, (0, size - len(p))) for p in (nominal, poles))
    distances = np.abs(nominal[:, None] - poles)
    rows, columns = scipy.optimize.linear_sum_assignment(distances)
    moved: Array = distances[rows, columns]
    return moved
