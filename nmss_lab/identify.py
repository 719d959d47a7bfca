r"""From a record to a model: refined instrumental variables (thesis 2.1, 6.3.1).

The model of one output is a transfer function with a common denominator,

.. math:: A(z^{-1})\, x_k = \sum_i B_i(z^{-1})\, u_{i,k}, \qquad
          y_k = x_k + \xi_k

with :math:`B_i = z^{-n_{k,i}} (b_0 + b_1 z^{-1} + \dots)`.  ``sriv`` is right for white
noise :math:`\xi` and stays consistent for any; ``riv`` also models
:math:`\xi = (D / C)\, e`.  Young, Biometrika 63 (1976); Young, *Recursive Estimation
and Time-Series Analysis* (2011).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import scipy.linalg
from scipy.signal import lfilter, max_len_seq

from nmss_lab.models import Array, DifferenceModel
from nmss_lab.records import Record

Start = Literal["rest", "skip", "estimate"]
"""What is assumed before the first sample: rest, nothing (the samples that need it are
not fitted), or a state that is estimated along with the parameters."""

CONVERGED = 1e-8
"""Relative change of the parameters at which the passes stop."""

PASSES = 200
"""Bound on the passes."""


@dataclass(frozen=True)
class Orders:
    """Orders of a model with one output: the [na, nb, nk] of the field.

    Parameters
    ----------
    na : int
        Past outputs, at least 1.
    nb, nk : tuples of int
        Coefficients and samples of delay of each input; every nb and nk at least 1
        and 1 (``nk = 1`` is the delay of a held input).

    Raises
    ------
    ValueError
        If an order is too small or nb and nk differ in length.

    Examples
    --------
    >>> print(Orders(1, (3,), (3,)))
    [1 3 3]
    """

    na: int
    nb: tuple[int, ...]
    nk: tuple[int, ...]

    def __post_init__(self) -> None:
        """Check the orders."""
        if len(self.nb) != len(self.nk) or not self.nb:
            raise ValueError(
                f"nb = {self.nb}, nk = {self.nk}: expected one entry an input in each"
            )
        if self.na < 1 or min(self.nb) < 1 or min(self.nk) < 1:
            raise ValueError(f"orders {self}: na, nb and nk must be at least 1")

    def __str__(self) -> str:
        """Return the orders in brackets, na first."""
        return f"[{' '.join(map(str, (self.na, *self.nb, *self.nk)))}]"

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.na + sum(self.nb)

    @property
    def reach(self) -> int:
        """Number of past samples that the equation looks at."""
        return max(self.na, *(k + n - 1 for k, n in zip(self.nk, self.nb, strict=True)))

    def split(self, parameters: Array) -> tuple[Array, list[Array]]:
        """Polynomials A and B_i in powers of z^-1, from z^0 on."""
        a, rest = np.split(parameters[: self.count], [self.na])
        b = np.split(rest, np.cumsum(self.nb)[:-1])
        lead = [np.zeros(k) for k in self.nk]
        joined = [np.concatenate(pair) for pair in zip(lead, b, strict=True)]
        return np.concatenate([[1.0], a]), joined


@dataclass(frozen=True)
class Noise:
    """Orders of the noise model xi = (D / C) e: ``ar`` of C, ``ma`` of D."""

    ar: int
    ma: int = 0


@dataclass(frozen=True, eq=False)
class Estimate:
    """A fitted model of one output, with its uncertainty.

    Parameters
    ----------
    orders : Orders
    parameters : array (n,)
        a_1.., then the coefficients of each input in turn.
    covariance : array (n, n)
        P*: noise variance times the inverse of the instruments' products.
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
    initial : array (na,)
        Numerator of the response of the state before the first sample; zero unless it
        was estimated.
    start : Start
    """

    orders: Orders
    parameters: Array
    covariance: Array
    record: Record
    method: str
    passes: int
    problem: str = ""
    noise_c: Array = field(default_factory=lambda: np.ones(1))
    noise_d: Array = field(default_factory=lambda: np.ones(1))
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
        inputs = _input_names(self.record)
        terms = zip(inputs, self.orders.nb, self.orders.nk, strict=True)
        b = [f"b{k + i}({u})" for u, n, k in terms for i in range(n)]
        return (*a, *b)

    @cached_property
    def simulated(self) -> Array:
        """Output of the model for the recorded inputs, (N,)."""
        return self.simulate(self.record, self.initial)

    @cached_property
    def residuals(self) -> Array:
        """Recorded minus simulated output, (N,); skipped samples left out."""
        first = self.orders.reach if self.start == "skip" else 0
        error: Array = (self.record.y[:, 0] - self.simulated)[first:]
        return error

    @property
    def innovations(self) -> Array:
        """Residuals whitened by the noise model, (C / D) xi."""
        return np.asarray(lfilter(self.noise_c, self.noise_d, self.residuals))

    @property
    def variance(self) -> float:
        """Mean square of the residuals."""
        return float(np.mean(self.residuals**2))

    @property
    def r2_t(self) -> float:
        """R_T^2 = 1 - mean square residual / variance of y, of the simulated output."""
        return 1.0 - self.variance / float(np.var(self.record.y[:, 0]))

    @property
    def yic(self) -> float:
        """Young's criterion: ln(s2 / s2_y) + ln(mean(P*_ii / p_i^2)).

        Large negative values are good; it tends to choose too few parameters, so look
        at ``bic`` beside it.
        """
        spread = np.diag(self.covariance) / self.parameters**2
        return float(np.log(1.0 - self.r2_t) + np.log(spread.mean()))

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
        size = float(np.mean(self.innovations**2))
        return len(self.residuals) * float(np.log(size)) + price * counted

    @cached_property
    def sandwich(self) -> Array:
        """Covariance (n, n) that stays honest when the residuals are coloured.

        Newey and West's form with Bartlett weights: instruments' products weighted by
        the residuals' own autocorrelation.  P* of ``sriv`` assumes white residuals.
        """
        work = _Work.of(self.record, self.orders, self.start)
        A, _ = self.orders.split(self.parameters)
        Z, _, _ = work.filtered(self._all, A, self.noise_c, self.noise_d)
        scores = Z * self._full_innovations(work)[:, None]
        lags = int(4 * (len(Z) / 100.0) ** (2.0 / 9.0)) + self.orders.reach
        middle = scores.T @ scores
        for lag in range(1, lags + 1):
            product = scores[lag:].T @ scores[:-lag]
            middle += (1.0 - lag / (lags + 1.0)) * (product + product.T)
        bread = np.linalg.inv(Z.T @ Z)
        n = self.orders.count
        spread: Array = (bread @ middle @ bread)[:n, :n]
        return spread

    @property
    def _all(self) -> Array:
        return np.concatenate([self.parameters, self.initial])

    def _full_innovations(self, work: _Work) -> Array:
        error = self.record.y[:, 0] - self.simulated
        whitened = np.asarray(lfilter(self.noise_c, self.noise_d, error))
        return whitened[work.first :]

    def simulate(self, record: Record, initial: Array | None = None) -> Array:
        """Output (N,) of the model for a record's inputs, from rest.

        Raises
        ------
        ValueError
            If the record has another number of inputs.
        """
        inputs = _inputs(record)
        if inputs.shape[1] != len(self.orders.nb):
            raise ValueError(
                f"the record has {inputs.shape[1]} inputs and disturbances, the model "
                f"{len(self.orders.nb)}"
            )
        A, B = self.orders.split(self.parameters)
        x = sum(lfilter(b, A, u) for b, u in zip(B, inputs.T, strict=True))
        if initial is not None and len(initial):
            impulse = np.zeros(len(inputs))
            impulse[0] = 1.0
            x = x + lfilter(initial, A, impulse)
        return np.asarray(x)

    def validate(self, record: Record) -> float:
        """R_T^2 of the simulated output on another record with the same columns."""
        error = record.y[:, 0] - self.simulate(record)
        return 1.0 - float(np.mean(error**2) / np.var(record.y[:, 0]))

    def autocorrelation(self, lags: int = 25) -> tuple[Array, float]:
        """Autocorrelation of the innovations at lags 0.., and its 95 % band."""
        e = self.innovations - self.innovations.mean()
        return _correlation(e, e, lags), 1.96 / float(np.sqrt(len(e)))

    def cross_correlation(self, lags: int = 25) -> tuple[Array, float]:
        """Correlation of the innovations with past inputs, (lags + 1, n_u), and band.

        What an input still explains at a lag is missing from the model.
        """
        e = self.innovations - self.innovations.mean()
        inputs = _inputs(self.record)[-len(e) :]
        columns = [_correlation(e, u - u.mean(), lags) for u in inputs.T]
        return np.column_stack(columns), 1.96 / float(np.sqrt(len(e)))

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """Draw parameter vectors (n, count) from N(p, P*): (6.8), (6.9)."""
        factor = np.linalg.cholesky(self.covariance)
        draws = rng.standard_normal((n, len(self.parameters)))
        return self.parameters + draws @ factor.T

    def with_parameters(self, parameters: Array) -> Estimate:
        """Return the estimate with other parameters, as drawn from its covariance."""
        return replace(self, parameters=np.asarray(parameters, dtype=float))

    def derived(self) -> dict[str, tuple[float, float]]:
        """Gain of each input, and time constants, each with its standard error.

        Time constants belong to real poles between 0 and 1; errors are propagated to
        first order from the covariance.
        """
        values = self._derive(self.parameters)
        errors: dict[str, list[float]] = {}
        for i in range(len(self.parameters)):
            step = 1e-6 * max(1.0, abs(self.parameters[i]))
            moved = self.parameters.copy()
            moved[i] += step
            for name, value in self._derive(moved).items():
                slope = (value - values[name]) / step if name in values else np.nan
                errors.setdefault(name, []).append(slope)
        return {
            name: (value, float(np.sqrt(np.array(g) @ self.covariance @ np.array(g))))
            for (name, value), g in zip(values.items(), errors.values(), strict=True)
        }

    def _derive(self, parameters: Array) -> dict[str, float]:
        A, B = self.orders.split(parameters)
        inputs = _input_names(self.record)
        found = {
            f"gain of {u}": float(b.sum() / A.sum())
            for u, b in zip(inputs, B, strict=True)
        }
        poles = np.roots(A)
        real = np.sort(
            poles[(poles.imag == 0) & (poles.real > 0) & (poles.real < 1)].real
        )
        for i, pole in enumerate(real[::-1]):
            found[f"time constant {i + 1}"] = float(-self.record.dt / np.log(pole))
        return found

    def poles(self) -> Array:
        """Poles of the model, (na,)."""
        return np.roots(self.orders.split(self.parameters)[0])

    def to_model(self) -> DifferenceModel:
        """Model for control: inputs u, measured disturbances v, names and units."""
        return combine([self])


def least_squares(record: Record, orders: Orders, start: Start = "rest") -> Estimate:
    """Fit the equation itself; biased by any noise on the output.

    Parameters
    ----------
    record : Record
        One output; inputs u, then measured disturbances v.  Detrended.
    orders : Orders
    start : Start

    Raises
    ------
    ValueError
        If the record does not fit the orders, is too short, or an input is constant.
    """
    work = _Work.of(record, orders, start)
    p, covariance = work.ordinary()
    return work.estimate(p, covariance, "least squares", 1, "")


def sriv(record: Record, orders: Orders, start: Start = "rest") -> Estimate:
    """Simplified refined instrumental variables, iterated to convergence.

    Each pass filters everything by 1 / A and takes the output of the model of the pass
    before as instruments.  Unstable passes are reflected into the unit circle; a
    result that stays unstable or does not settle says so in ``problem``.

    Parameters and errors are those of ``least_squares``.
    """
    work = _Work.of(record, orders, start)
    p, _ = work.ordinary()
    p, passes, problem = _settle(work, p, lambda q: work.refine(q, ONE, ONE))
    return work.finish(p, "sriv", passes, problem, ONE, ONE)


def riv(
    record: Record, orders: Orders, noise: Noise, start: Start = "rest"
) -> Estimate:
    """Refined instrumental variables with a model of the noise, started from ``sriv``.

    Parameters
    ----------
    noise : Noise
        AR by least squares on the residuals; ARMA by Hannan and Rissanen's two steps,
        refined to convergence.
    record, orders, start : see ``least_squares``

    Raises
    ------
    ValueError
        As ``least_squares``, or if a noise order is negative.
    """
    if noise.ar < 0 or noise.ma < 0:
        raise ValueError(f"noise = {noise}: orders must not be negative")
    first = sriv(record, orders, start)
    work = _Work.of(record, orders, start)

    def one_pass(p: Array) -> Array:
        c, d = fit_noise(work.residuals(p), noise)
        return work.refine(p, c, d)

    begin = np.concatenate([first.parameters, first.initial])
    p, passes, problem = _settle(work, begin, one_pass)
    c, d = fit_noise(work.residuals(p), noise)
    return work.finish(p, "riv", passes, problem, c, d)


def fit_noise(xi: Array, noise: Noise) -> tuple[Array, Array]:
    """Polynomials C and D of xi = (D / C) e, both stable and monic.

    Parameters
    ----------
    xi : array (N,)
    noise : Noise
    """
    if noise.ma == 0:
        return _autoregression(xi, noise.ar), ONE
    long = _autoregression(xi, min(20 + noise.ar + noise.ma, len(xi) // 5))
    e = np.asarray(lfilter(long, ONE, xi))
    c, d = ONE, ONE
    for _ in range(PASSES):
        columns = [-_delayed(xi, i) for i in range(1, noise.ar + 1)]
        columns += [_delayed(e, i) for i in range(1, noise.ma + 1)]
        rows = slice(max(noise.ar, noise.ma), None)
        theta, *_ = np.linalg.lstsq(
            np.column_stack(columns)[rows], xi[rows], rcond=None
        )
        new_c = stabilised(np.concatenate([ONE, theta[: noise.ar]]))
        new_d = stabilised(np.concatenate([ONE, theta[noise.ar :]]))
        change = max(_change(new_c, c), _change(new_d, d))
        c, d = new_c, new_d
        e = np.asarray(lfilter(c, d, xi))
        if change < 1e-7:
            break
    return c, d


def stabilised(polynomial: Array) -> Array:
    """Monic polynomial in z^-1 with roots outside the unit circle reflected into it."""
    roots = np.roots(polynomial)
    outside = np.abs(roots) >= 1.0
    if not outside.any():
        return polynomial
    inside = 0.999 / np.conj(roots[outside])
    small = np.abs(inside) < 0.999
    roots[outside] = np.where(
        small, inside, 0.999 * roots[outside] / np.abs(roots[outside])
    )
    return np.real(np.poly(roots))


def combine(estimates: Sequence[Estimate]) -> DifferenceModel:
    """Join models of single outputs into one model with a diagonal A.

    Raises
    ------
    ValueError
        If they come from records with other inputs or sampling intervals.
    """
    first = estimates[0].record
    for other in estimates[1:]:
        same = _input_names(other.record) == _input_names(first)
        if not same or not np.isclose(other.record.dt, first.dt):
            raise ValueError(
                "estimates: expected the same inputs and sampling interval in all; "
                f"{_input_names(other.record)} at {other.record.dt} s against "
                f"{_input_names(first)} at {first.dt} s"
            )
    n_y, n_u, inputs = len(estimates), first.u.shape[1], len(_input_names(first))
    na = max(e.orders.na for e in estimates)
    nb = max(k + n - 1 for e in estimates for k, n in _delays(e.orders))
    a, b = np.zeros((na, n_y, n_y)), np.zeros((nb, n_y, inputs))
    for i, each in enumerate(estimates):
        A, B = each.orders.split(each.parameters)
        a[: each.orders.na, i, i] = A[1:]
        for j, polynomial in enumerate(B):
            b[: len(polynomial) - 1, i, j] = polynomial[1:]
    units = {k: v for e in estimates for k, v in e.record.units.items() if k != "time"}
    return DifferenceModel(
        a,
        b[:, :, :n_u],
        b[:, :, n_u:],
        dt=first.dt,
        y_names=tuple(e.record.names["y"][0] for e in estimates),
        u_names=first.names["u"],
        v_names=first.names["v"] if inputs > n_u else (),
        units=units,
    )


@dataclass(frozen=True, eq=False)
class Candidate:
    """One row of an order search: an estimate, or the reason why there is none."""

    orders: Orders
    estimate: Estimate | None
    problem: str

    @property
    def row(self) -> dict[str, Any]:
        """Orders, criteria and problem, for a table."""
        row: dict[str, Any] = {
            "orders": str(self.orders),
            "parameters": self.orders.count,
        }
        names = "yic", "r2_t", "aic", "bic", "passes"
        for name in names:
            row[name] = getattr(self.estimate, name) if self.estimate else np.nan
        return {**row, "problem": self.problem}


def order_search(
    record: Record,
    na: Sequence[int],
    nb: Sequence[int],
    nk: Sequence[int],
    noise: Noise | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int], bool | None] | None = None,
    start: Start = "rest",
) -> list[Candidate]:
    """Fit every combination of orders and rank them by YIC, failures last.

    Parameters
    ----------
    record : Record
    na, nb, nk : sequences of int
        Orders to try; every input takes each nb and nk in turn.
    noise : Noise, optional
        Fit with ``riv``; ``sriv`` without.
    executor : concurrent.futures.Executor, optional
        Where to fit; in this process if absent.
    progress : function of (done, total), optional
        Called after each; returning True stops the search, keeping what is done.
    start : Start

    Returns
    -------
    list of Candidate
    """
    inputs = _inputs(record).shape[1]
    tries = [
        Orders(n, b, k)
        for n in na
        for b in itertools.product(nb, repeat=inputs)
        for k in itertools.product(nk, repeat=inputs)
    ]
    done: list[Candidate] = []
    for candidate in _fitted(record, tries, noise, start, executor):
        done.append(candidate)
        if progress is not None and progress(len(done), len(tries)):
            break
    return sorted(done, key=_rank)


def _fitted(
    record: Record,
    tries: list[Orders],
    noise: Noise | None,
    start: Start,
    executor: Executor | None,
) -> Iterator[Candidate]:
    if executor is None:
        for orders in tries:
            yield _try(record, orders, noise, start)
        return
    waiting = [executor.submit(_try, record, o, noise, start) for o in tries]
    try:
        for future in waiting:
            yield future.result()
    finally:
        for future in waiting:
            future.cancel()


def _try(
    record: Record, orders: Orders, noise: Noise | None, start: Start
) -> Candidate:
    try:
        found = (
            sriv(record, orders, start)
            if noise is None
            else riv(record, orders, noise, start)
        )
    except (ValueError, np.linalg.LinAlgError) as error:
        return Candidate(orders, None, str(error))
    return Candidate(orders, found, found.problem)


def _rank(candidate: Candidate) -> tuple[bool, float]:
    found = candidate.estimate
    if found is None or not np.isfinite(found.yic):
        return True, np.inf
    return not found.is_good, found.yic


def prbs(samples: int, clock: int = 1, low: float = -1.0, high: float = 1.0) -> Array:
    """Pseudo-random binary signal (samples,) from a maximum-length shift register.

    ``clock`` samples pass between possible changes.

    Raises
    ------
    ValueError
        If samples or clock is not positive.
    """
    if samples < 1 or clock < 1:
        raise ValueError(f"samples = {samples}, clock = {clock} must be positive")
    length = -(-samples // clock)
    register = max(2, int(np.ceil(np.log2(length + 1))))
    bits = np.asarray(max_len_seq(register, length=length)[0])
    return np.where(np.repeat(bits, clock)[:samples] > 0, high, low)


def staircase(levels: Sequence[float], hold: int, rate: float = np.inf) -> Array:
    """Signal that holds each level for ``hold`` samples, moving at most ``rate`` each.

    Raises
    ------
    ValueError
        If hold or rate is not positive.
    """
    if hold < 1 or not rate > 0:
        raise ValueError(f"hold = {hold} and rate = {rate} must be positive")
    wanted = np.repeat(np.asarray(levels, dtype=float), hold)
    signal = wanted.copy()
    for k in range(1, len(signal)):
        signal[k] = np.clip(wanted[k], signal[k - 1] - rate, signal[k - 1] + rate)
    return signal


def expected_errors(
    orders: Orders, parameters: Array, inputs: Array, noise: float
) -> Array:
    """Predict the standard errors (n,) that an experiment would give, before it is made.

    Parameters
    ----------
    orders, parameters : model that is expected
    inputs : array (N, n_u)
        Planned inputs.
    noise : float
        Standard deviation of white noise on the output.
    """
    inputs = np.asarray(inputs, dtype=float).reshape(len(inputs), -1)
    A, B = orders.split(np.asarray(parameters, dtype=float))
    x = np.sum([lfilter(b, A, u) for b, u in zip(B, inputs.T, strict=True)], axis=0)
    filtered = np.column_stack([lfilter(ONE, A, u) for u in inputs.T])
    Z = _regressors(orders, np.asarray(lfilter(ONE, A, x)), filtered)
    return noise * np.sqrt(np.diag(np.linalg.inv(Z.T @ Z)))


ONE = np.ones(1)


@dataclass(frozen=True, eq=False)
class _Work:
    """Data and regressors of one fit."""

    record: Record
    orders: Orders
    start: Start
    y: Array
    inputs: Array
    first: int

    @classmethod
    def of(cls, record: Record, orders: Orders, start: Start) -> _Work:
        """Check the record against the orders."""
        inputs, y = _inputs(record), record.y
        if y.shape[1] != 1:
            raise ValueError(f"record has {y.shape[1]} outputs, expected one at a time")
        if inputs.shape[1] != len(orders.nb):
            raise ValueError(
                f"orders {orders} are for {len(orders.nb)} inputs, the record has "
                f"{inputs.shape[1]}"
            )
        for name, u in zip(_input_names(record), inputs.T, strict=True):
            if np.ptp(u) == 0.0 and (start != "rest" or u[0] == 0.0):
                raise ValueError(
                    f"input {name} is constant: nothing can be learnt of it, unless it "
                    'stepped from zero at the first sample (start = "rest")'
                )
        if start not in ("rest", "skip", "estimate"):
            raise ValueError(
                f'start = "{start}": expected "rest", "skip" or "estimate"'
            )
        first = orders.reach if start == "skip" else 0
        if len(y) - first < 2 * orders.count:
            raise ValueError(
                f"{len(y)} samples are too few for the {orders.count} parameters of "
                f"{orders}"
            )
        return cls(record, orders, start, y[:, 0], inputs, first)

    @property
    def nuisance(self) -> int:
        """Coefficients for the state before the first sample."""
        return self.orders.na if self.start == "estimate" else 0

    @property
    def impulse(self) -> Array:
        """Unit impulse at the first sample, through which that state acts."""
        impulse = np.zeros(len(self.y))
        impulse[0] = 1.0
        return impulse

    def rows(self, y: Array, inputs: Array, impulse: Array) -> Array:
        """Regressors (N - first, count + nuisance)."""
        Z = _regressors(self.orders, y, inputs)
        extra = [_delayed(impulse, i) for i in range(self.nuisance)]
        return np.column_stack([Z, *extra])[self.first :]

    def ordinary(self) -> tuple[Array, Array]:
        """Least squares on the equation: parameters and covariance."""
        Phi, y = self.rows(self.y, self.inputs, self.impulse), self.y[self.first :]
        p, *_ = np.linalg.lstsq(Phi, y, rcond=None)
        s2 = np.sum((y - Phi @ p) ** 2) / (len(y) - self.orders.count)
        return p, s2 * np.linalg.pinv(Phi.T @ Phi)

    def model(self, p: Array) -> tuple[Array, Array, Array]:
        """Stable A, and the output x of the model, and A as it is."""
        A, B = self.orders.split(p)
        stable = stabilised(A)
        x = np.sum(
            [lfilter(b, stable, u) for b, u in zip(B, self.inputs.T, strict=True)],
            axis=0,
        )
        if self.nuisance:
            x = x + lfilter(p[self.orders.count :], stable, self.impulse)
        return stable, x, A

    def residuals(self, p: Array) -> Array:
        """Measured minus simulated output, (N - first,)."""
        error: Array = (self.y - self.model(p)[1])[self.first :]
        return error

    def filtered(
        self, p: Array, A: Array, c: Array, d: Array
    ) -> tuple[Array, Array, Array]:
        """Instruments, regressors and output, filtered by C / (A D)."""
        by = np.convolve(stabilised(A), d)
        y, x = lfilter(c, by, self.y), lfilter(c, by, self.model(p)[1])
        inputs = np.column_stack([lfilter(c, by, u) for u in self.inputs.T])
        impulse = np.asarray(lfilter(c, by, self.impulse))
        Z, Phi = self.rows(x, inputs, impulse), self.rows(y, inputs, impulse)
        return Z, Phi, np.asarray(y)[self.first :]

    def refine(self, p: Array, c: Array, d: Array) -> Array:
        """One pass of refined instrumental variables."""
        A, _ = self.orders.split(p)
        Z, Phi, y = self.filtered(p, A, c, d)
        return np.linalg.solve(Z.T @ Phi, Z.T @ y)

    def finish(
        self, p: Array, method: str, passes: int, problem: str, c: Array, d: Array
    ) -> Estimate:
        """Covariance P* at convergence, and what is wrong with the result."""
        A, _ = self.orders.split(p)
        Z, _, _ = self.filtered(p, A, c, d)
        e = np.asarray(lfilter(c, d, self.residuals(p)))[max(len(c), len(d)) - 1 :]
        free = len(self.y) - self.first - self.orders.count
        s2 = np.mean(e**2) * (len(self.y) - self.first) / free
        if np.abs(np.roots(A)).max() >= 1.0:
            problem = "the model is unstable"
        covariance = s2 * scipy.linalg.pinvh(Z.T @ Z)
        return self.estimate(p, covariance, method, passes, problem, c, d)

    def estimate(
        self,
        p: Array,
        covariance: Array,
        method: str,
        passes: int,
        problem: str,
        c: Array = ONE,
        d: Array = ONE,
    ) -> Estimate:
        """Estimate without the nuisance coefficients."""
        n = self.orders.count
        return Estimate(
            self.orders,
            p[:n],
            covariance[:n, :n],
            self.record,
            method,
            passes,
            problem,
            c,
            d,
            p[n:],
            self.start,
        )


def _settle(
    work: _Work, p: Array, one_pass: Callable[[Array], Array]
) -> tuple[Array, int, str]:
    """Repeat passes until the parameters stand still; restart once from stability."""
    restarts = 2
    for passes in range(1, PASSES + 1):
        try:
            new = one_pass(p)
        except np.linalg.LinAlgError:
            return p, passes, "the instruments do not determine the parameters"
        if not np.isfinite(new).all():
            return p, passes, "the passes diverged"
        change, p = _change(new, p), new
        if change < CONVERGED:
            A, _ = work.orders.split(p)
            if np.abs(np.roots(A)).max() < 1.0 or restarts == 0:
                return p, passes, ""
            restarts -= 1
            p = np.concatenate([stabilised(A)[1:], p[work.orders.na :]])
    return p, PASSES, f"the passes did not settle: last change {change:.1e}"


def _change(new: Array, old: Array) -> float:
    size = max(len(new), len(old))
    difference = np.pad(new, (0, size - len(new))) - np.pad(old, (0, size - len(old)))
    return float(np.abs(difference).max() / max(np.abs(new).max(), 1e-300))


def _autoregression(xi: Array, order: int) -> Array:
    if order == 0:
        return ONE
    columns = np.column_stack([-_delayed(xi, i) for i in range(1, order + 1)])[order:]
    theta, *_ = np.linalg.lstsq(columns, xi[order:], rcond=None)
    return stabilised(np.concatenate([ONE, theta]))


def _regressors(orders: Orders, y: Array, inputs: Array) -> Array:
    past = [-_delayed(y, i) for i in range(1, orders.na + 1)]
    for u, (k, n) in zip(inputs.T, _delays(orders), strict=True):
        past += [_delayed(u, k + i) for i in range(n)]
    return np.column_stack(past)


def _delays(orders: Orders) -> list[tuple[int, int]]:
    return list(zip(orders.nk, orders.nb, strict=True))


def _delayed(signal: Array, samples: int) -> Array:
    """Signal ``samples`` later, zero before."""
    if samples == 0:
        return signal
    return np.concatenate([np.zeros(samples), signal[:-samples]])


def _correlation(e: Array, u: Array, lags: int) -> Array:
    size = np.sqrt((e @ e) * (u @ u))
    return np.array([e[i:] @ u[: len(u) - i] for i in range(lags + 1)]) / size


def _inputs(record: Record) -> Array:
    """Put inputs and measured disturbances side by side, (N, n_u + n_v)."""
    parts = [part for part in (record.u, record.v) if part.size]
    if not parts:
        raise ValueError("record has no inputs u or measured disturbances v")
    return np.hstack(parts)


def _input_names(record: Record) -> tuple[str, ...]:
    groups = [record.names[g] for g in ("u", "v") if getattr(record, g).size]
    return tuple(itertools.chain(*groups))
