"""A fitted model of one output with its uncertainty, and what follows from both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.signal import lfilter

from nmss_lab.identify.structure import (
    ONE,
    Orders,
    Start,
    delayed,
    input_names,
    inputs_of,
)
from nmss_lab.models import Array, DifferenceModel
from nmss_lab.records import Record


@dataclass(frozen=True, eq=False)
class Estimate:
    """A fitted model of one output, with its uncertainty.

    Parameters
    ----------
    orders : Orders
    parameters : array (n,)
        a_1.., then the coefficients of each input in turn.
    covariance : array (n, n)
        P*: noise variance times the inverse of the instruments' products; right if
        the innovations are white.
    sandwich : array (n, n)
        Covariance that stays honest when the residuals are coloured.
    record : Record
        What it was fitted to, with one output; detrended by the caller.
    method : str
        "least squares", "sriv" or "riv".
    passes : int
    problem : str
        Why the estimate is not to be trusted; empty when it converged to a stable
        model.
    noise_c, noise_d : arrays
        Polynomials C and D of the noise model; [1] without one.
    initial : array (reach,)
        Numerator of the response to the time before the first sample; empty unless it
        was estimated.
    start : Start
    """

    orders: Orders
    parameters: Array
    covariance: Array
    sandwich: Array
    record: Record
    method: str
    passes: int
    problem: str = ""
    noise_c: Array = field(default_factory=lambda: ONE)
    noise_d: Array = field(default_factory=lambda: ONE)
    initial: Array = field(default_factory=lambda: np.zeros(0))
    start: Start = "rest"

    @property
    def is_good(self) -> bool:
        """Whether the passes converged to a stable model."""
        return not self.problem

    @property
    def standard_errors(self) -> Array:
        """Square roots of the covariance's diagonal, (n,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, such as "a1" or "b2(u1)"."""
        a = [f"a{i + 1}" for i in range(self.orders.na)]
        terms = zip(input_names(self.record), self.orders.delays, strict=True)
        b = [f"b{k + i}({u})" for u, (k, n) in terms for i in range(n)]
        return (*a, *b)

    @cached_property
    def simulated(self) -> Array:
        """Output of the model for the recorded inputs, (N,)."""
        return self.simulate(self.record, self.initial)

    @cached_property
    def residuals(self) -> Array:
        """Recorded minus simulated output, (N,); skipped samples left out."""
        error: Array = (self.record.y[:, 0] - self.simulated)[self._first :]
        return error

    @property
    def _first(self) -> int:
        return self.orders.reach if self.start == "skip" else 0

    @cached_property
    def innovations(self) -> Array:
        """Residuals whitened by the noise model, (C / D) xi."""
        return np.asarray(lfilter(self.noise_c, self.noise_d, self.residuals))

    @property
    def variance(self) -> float:
        """Mean square of the residuals."""
        return _mean_square(self.residuals)

    @property
    def r2_t(self) -> float:
        """R_T^2 = 1 - mean square residual / variance of y, of the simulated output."""
        return 1.0 - self._share

    @property
    def _share(self) -> float:
        return self.variance / float(np.var(self.record.y[self._first :, 0]))

    @property
    def yic(self) -> float:
        """Young's criterion: ln(s2 / s2_y) + ln(mean(P*_ii / p_i^2)).

        Large negative values are good; it tends to choose too few parameters, so look
        at ``bic`` beside it.
        """
        with np.errstate(divide="ignore", over="ignore"):
            spread = np.mean(np.diag(self.covariance) / self.parameters**2)
            return float(np.log(self._share) + np.log(spread))

    @property
    def aic(self) -> float:
        """Akaike's criterion, N ln(variance of the innovations) + 2 n."""
        return self._information(2.0)

    @property
    def bic(self) -> float:
        """Schwarz's criterion, N ln(variance of the innovations) + n ln N."""
        return self._information(float(np.log(len(self.residuals))))

    def _information(self, price: float) -> float:
        counted = self.orders.count + len(self.noise_c) + len(self.noise_d) - 2
        with np.errstate(divide="ignore"):
            size = float(np.log(_mean_square(self.innovations)))
        return len(self.residuals) * size + price * counted

    def simulate(self, record: Record, initial: Array | None = None) -> Array:
        """Output (N,) of the model for a record's inputs.

        Parameters
        ----------
        record : Record
        initial : array (reach,), optional
            Numerator of the response to what went before; from rest without it.

        Raises
        ------
        ValueError
            If the record has another number of inputs.
        """
        inputs = inputs_of(record)
        if inputs.shape[1] != len(self.orders.nb):
            raise ValueError(
                f"the record has {inputs.shape[1]} inputs and disturbances, the model "
                f"{len(self.orders.nb)}"
            )
        A, B = self.orders.split(self.parameters)
        x = np.sum([lfilter(b, A, u) for b, u in zip(B, inputs.T, strict=True)], axis=0)
        if initial is not None and len(initial):
            x = x + self._free(len(inputs)) @ initial
        return np.asarray(x)

    def _free(self, samples: int) -> Array:
        """Responses (N, reach) to what may have gone before the first sample."""
        A, _ = self.orders.split(self.parameters)
        impulse = np.zeros(samples)
        impulse[0] = 1.0
        response = np.asarray(lfilter(ONE, A, impulse))
        return np.column_stack([delayed(response, i) for i in range(self.orders.reach)])

    def explained(self, record: Record, start: Start = "rest") -> Array:
        """Output (N,) of the model on another record with the same columns.

        With ``start = "estimate"`` the response to what went before is fitted to the
        record.
        """
        y, x = record.y[:, 0], self.simulate(record)
        if start == "estimate":
            free = self._free(len(y))
            x = x + free @ np.linalg.lstsq(free, y - x, rcond=None)[0]
        return x

    def validate(self, record: Record, start: Start = "rest") -> float:
        """R_T^2 of the simulated output on another record with the same columns.

        Parameters
        ----------
        record : Record
        start : Start
            With "estimate" the response to what went before is fitted to the record.
        """
        y, x = record.y[:, 0], self.explained(record, start)
        first = self.orders.reach if start == "skip" else 0
        return 1.0 - _mean_square((y - x)[first:]) / float(np.var(y[first:]))

    def autocorrelation(self, lags: int = 25) -> tuple[Array, float]:
        """Autocorrelation of the innovations at lags 0.., and its 95 % band."""
        e = self.innovations - self.innovations.mean()
        return _correlation(e, e, lags), 1.96 / float(np.sqrt(len(e)))

    def cross_correlation(self, lags: int = 25) -> tuple[Array, float]:
        """Correlation of the innovations with past inputs, (lags + 1, n_u), and band.

        What an input still explains at a lag is missing from the model.
        """
        e = self.innovations - self.innovations.mean()
        inputs = inputs_of(self.record)[-len(e) :]
        columns = [_correlation(e, u - u.mean(), lags) for u in inputs.T]
        return np.column_stack(columns), 1.96 / float(np.sqrt(len(e)))

    def with_parameters(self, parameters: Array) -> Estimate:
        """Return the estimate with other parameters, as drawn from its covariance."""
        return replace(self, parameters=np.asarray(parameters, dtype=float))

    def poles(self) -> Array:
        """Poles of the model, (na,)."""
        return np.roots(self.orders.split(self.parameters)[0])

    def pole_covariance(self) -> Array:
        """Covariance (na, 2, 2) of the real and imaginary part of each pole.

        To first order; infinite for a double pole.
        """
        slopes = self._pole_slopes()
        parts = np.stack([slopes.real, slopes.imag], axis=1)
        na = self.orders.na
        with np.errstate(invalid="ignore"):
            spread: Array = parts @ self.covariance[:na, :na] @ parts.swapaxes(1, 2)
        return np.where(np.isnan(spread), np.inf, spread)

    def _pole_slopes(self) -> Array:
        """Give the derivatives (na, na) of the poles with respect to a_1, a_2, ..."""
        A, _ = self.orders.split(self.parameters)
        poles = self.poles()
        powers = poles[:, None] ** np.arange(self.orders.na - 1.0, -1.0, -1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(-powers / np.polyval(np.polyder(A), poles)[:, None])

    def derived(self) -> dict[str, tuple[float, float]]:
        """Gains, time constants, frequencies and dampings, each with standard error.

        A real pole between 0 and 1 has a time constant (s), slowest first; a pair has
        a natural frequency (rad/s) and a damping.  Errors are carried over from the
        covariance to first order.
        """
        values = self._gains() | self._modes()
        with np.errstate(invalid="ignore"):
            return {
                name: (value, float(np.sqrt(slope @ self.covariance @ slope)))
                for name, (value, slope) in values.items()
            }

    def _gains(self) -> dict[str, tuple[float, Array]]:
        A, B = self.orders.split(self.parameters)
        na, found, at = self.orders.na, {}, self.orders.na
        for name, b, count in zip(
            input_names(self.record), B, self.orders.nb, strict=True
        ):
            gain = float(b.sum() / A.sum())
            slope = np.zeros(len(self.parameters))
            slope[:na] = -gain / A.sum()
            slope[at : at + count] = 1.0 / A.sum()
            found[f"gain of {name}"] = gain, slope
            at += count
        return found

    def _modes(self) -> dict[str, tuple[float, Array]]:
        found: dict[str, tuple[float, Array]] = {}
        pad = np.zeros(len(self.parameters) - self.orders.na)
        dt, poles, slopes = self.record.dt, self.poles(), self._pole_slopes()
        real = pair = 0
        for i in np.argsort(-np.abs(poles)):
            p, slope = poles[i], np.concatenate([slopes[i], pad])
            if p.imag == 0.0 and 0.0 < p.real < 1.0:
                real, rate = real + 1, np.log(p.real)
                slope = dt / (p.real * rate**2) * slope.real
                found[f"time constant {real}"] = float(-dt / rate), slope
            elif p.imag > 0.0:
                pair += 1
                s, ds = np.log(p) / dt, slope / (p * dt)
                wn = np.abs(s)
                dwn = (np.conj(s) * ds).real / wn
                found[f"natural frequency {pair}"] = float(wn), dwn
                dz = s.real * dwn / wn**2 - ds.real / wn
                found[f"damping {pair}"] = float(-s.real / wn), dz
        return found

    def to_model(self) -> DifferenceModel:
        """Model for control: inputs u, measured disturbances v, names and units."""
        return combine([self])


def draw(estimate: Estimate, n: int, rng: np.random.Generator) -> Array:
    """Draw parameter vectors (n, count) from N(p, P*): (6.8), (6.9)."""
    size, axes = np.linalg.eigh(estimate.covariance)
    factor = axes * np.sqrt(np.maximum(size, 0.0))
    draws = rng.standard_normal((n, len(estimate.parameters)))
    return estimate.parameters + draws @ factor.T


def combine(estimates: Sequence[Estimate]) -> DifferenceModel:
    """Join models of single outputs into one model with a diagonal A.

    Raises
    ------
    ValueError
        If there is none, or if they come from records with other inputs or sampling
        intervals.
    """
    if not estimates:
        raise ValueError("estimates is empty; expected one an output")
    first = estimates[0].record
    for other in estimates[1:]:
        _check_alike(first, other.record)
    a, b = _stacked(estimates)
    n_u = first.u.shape[1]
    has_v = bool(first.v.size)
    units = {k: v for e in estimates for k, v in e.record.units.items()}
    return DifferenceModel(
        a,
        b[:, :, :n_u],
        b[:, :, n_u:] if has_v else None,
        dt=first.dt,
        y_names=tuple(e.record.names["y"][0] for e in estimates),
        u_names=first.names["u"],
        v_names=first.names["v"] if has_v else (),
        units={k: v for k, v in units.items() if k != "time"},
    )


def _check_alike(first: Record, other: Record) -> None:
    same = all(first.names[group] == other.names[group] for group in ("u", "v"))
    if not same or not np.isclose(other.dt, first.dt):
        raise ValueError(
            "estimates: expected the same inputs and sampling interval in all; "
            f"{input_names(other)} at {other.dt} s against "
            f"{input_names(first)} at {first.dt} s"
        )


def _stacked(estimates: Sequence[Estimate]) -> tuple[Array, Array]:
    """Coefficients a (na, n_y, n_y), diagonal, and b (nb, n_y, inputs)."""
    n_y, inputs = len(estimates), len(estimates[0].orders.nb)
    na = max(e.orders.na for e in estimates)
    nb = max(k + n - 1 for e in estimates for k, n in e.orders.delays)
    a, b = np.zeros((na, n_y, n_y)), np.zeros((nb, n_y, inputs))
    for i, each in enumerate(estimates):
        A, B = each.orders.split(each.parameters)
        a[: each.orders.na, i, i] = A[1:]
        for j, polynomial in enumerate(B):
            b[: len(polynomial) - 1, i, j] = polynomial[1:]
    return a, b


def _mean_square(error: Array) -> float:
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.mean(error**2))


def _correlation(e: Array, u: Array, lags: int) -> Array:
    size = np.sqrt((e @ e) * (u @ u))
    with np.errstate(invalid="ignore"):  # a constant input has none
        return np.array([e[i:] @ u[: len(u) - i] for i in range(lags + 1)]) / size
