"""Closed-loop poles of uncertain plants: full polynomials, bounds, clouds."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from nmss_lab.analysis import control_polynomials
from nmss_lab.models import Array
from nmss_lab.predictive import PredictiveController
from nmss_lab.reproduce.shared import built, case_of, loop_of


@dataclass(frozen=True)
class PolePair:
    """Full characteristic polynomials of feedback and forward path, SISO.

    The factor that cancels in T(z), and the pole at the origin, are included.
    """

    controller: PredictiveController

    def poles(self, a: Array, b: Array, forward: bool) -> Array:
        """Poles (draws, degree) for plants a (draws, na), b (draws, nb)."""
        parts, model = control_polynomials(self.controller), self.controller.model
        ones, draws = np.ones((len(a), 1)), len(a)
        a, b = np.hstack([ones, a]), np.hstack([0.0 * ones, b])
        known_a = np.tile(np.append(1.0, model.a.ravel()), (draws, 1))
        known_b = np.tile(np.append(0.0, model.b.ravel()), (draws, 1))
        P, L = (np.tile(part.ravel(), (draws, 1)) for part in (parts.P, parts.L))
        rate, K_I = np.hstack([ones, -ones]), float(parts.K_I[0, 0])
        if not forward:
            inner = _sum(_product(a, L), _product(P, b))
            return _roots(_sum(_product(rate, inner), K_I * b))
        inner = _sum(_product(known_a, L), _product(P, known_b))
        through = _product(_product(rate, inner), a)
        return _roots(_sum(through, K_I * _product(b, known_a)))


def _product(x: Array, y: Array) -> Array:
    """Products of polynomials, one pair a row."""
    out = np.zeros((len(x), x.shape[1] + y.shape[1] - 1))
    for i in range(x.shape[1]):
        out[:, i : i + y.shape[1]] += x[:, i : i + 1] * y
    return out


def _sum(x: Array, y: Array) -> Array:
    out = np.zeros((len(x), max(x.shape[1], y.shape[1])))
    out[:, : x.shape[1]] += x
    out[:, : y.shape[1]] += y
    return out


def _roots(polynomials: Array) -> Array:
    """Roots in z of rows 1 + c_1 z^-1 + ... + c_n z^-n, n a row."""
    n = polynomials.shape[1] - 1
    companion = np.tile(np.eye(n, k=-1), (len(polynomials), 1, 1))
    companion[:, 0] = -polynomials[:, 1:]
    return np.asarray(np.linalg.eigvals(companion))


def bound(forward: bool, numerator: bool, side: int) -> float:
    """First factor, walking from 1, at which a pole is 0.1 from its nominal place."""
    pair = PolePair(built(case_of("ifac93_6_3_3").designs["wang_young"]))
    model = pair.controller.model
    nominal = pair.poles(model.a[:, 0].T, model.b[:, 0].T, forward)[0]

    def excess(factor: float) -> float:
        varied = model.varied(
            numerator=factor if numerator else 1.0,
            denominator=1.0 if numerator else factor,
        )
        poles = pair.poles(varied.a[:, 0].T, varied.b[:, 0].T, forward)[0]
        return _farthest(nominal, poles) - 0.1

    inner, step = 1.0, 0.002 * side
    while excess(inner + step) < 0.0:
        inner += step
    return float(scipy.optimize.brentq(excess, inner, inner + step, xtol=1e-10))


def _farthest(nominal: Array, poles: Array) -> float:
    """Largest distance when each pole is matched to a nominal one."""
    distance = np.abs(nominal[:, None] - poles)
    return float(distance[scipy.optimize.linear_sum_assignment(distance)].max())


DRAWS = 2000


CANCELLED = 1e-6
"""Poles of a cancelled factor on the unit circle move by rounding only."""


@functools.cache
def _clouds(kind: str) -> dict[str, Array]:
    """Poles (draws, degree) of both forms on (6.10) with uncertain parameters."""
    case = case_of("marginally_stable_6_3_2")
    rng, model = np.random.default_rng(2007), case.model
    center = np.concatenate([model.a.ravel(), model.b.ravel()])
    if kind == "covariance":
        assert case.covariance is not None  # this case states one
        draws = rng.multivariate_normal(
            center, case.covariance, DRAWS, method="cholesky"
        )
    else:
        share = np.repeat([0.0, 0.15] if kind == "numerator" else [0.05, 0.0], 2)
        draws = center * (1.0 + share * rng.uniform(-1.0, 1.0, (DRAWS, 4)))
    pair = PolePair(built(case.designs["wang_young"]))
    a, b = draws[:, :2], draws[:, 2:]
    return {"feedback": pair.poles(a, b, False), "forward": pair.poles(a, b, True)}


@dataclass(frozen=True)
class Cloud:
    """Summary of poles of many draws."""

    unstable: float
    radius: float
    scatter: float
    interval: tuple[float, float]

    def __str__(self) -> str:
        low, high = (100 * side for side in self.interval)
        return (
            f"{100 * self.unstable:.1f} % [{low:.1f}, {high:.1f}] unstable, largest "
            f"radius {self.radius:.3f}"
        )


@functools.cache
def cloud(kind: str, form: str) -> Cloud:
    """Summarise the poles of the draws of one kind, "feedback" or "forward"."""
    poles = _clouds(kind)[form]
    radii = np.abs(poles).max(axis=1)
    share = float((radii > 1.0 + CANCELLED).mean())
    design = case_of("marginally_stable_6_3_2").designs["wang_young"]
    nominal = loop_of(design).poles
    nominal = nominal[np.abs(nominal) > 0.05]
    nearest = np.abs(nominal[:, None, None] - poles).min(axis=2).max(axis=0)
    return Cloud(share, float(radii.max()), float(np.median(nearest)), _wilson(share))


def _wilson(share: float) -> tuple[float, float]:
    """95 % interval of a share of ``DRAWS``."""
    z2 = 1.96**2 / DRAWS
    middle = (share + z2 / 2.0) / (1.0 + z2)
    half = math.sqrt(z2 * (share * (1.0 - share) + z2 / 4.0)) / (1.0 + z2)
    return middle - half, middle + half
