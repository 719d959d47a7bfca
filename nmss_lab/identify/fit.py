r"""Least squares and refined instrumental variables on a record.

The model of one output is a transfer function with a common denominator,

.. math:: A(z^{-1})\, x_k = \sum_i B_i(z^{-1})\, u_{i,k}, \qquad
          y_k = x_k + \xi_k

with :math:`B_i = z^{-n_{k,i}} (b_0 + b_1 z^{-1} + \dots)`.  ``sriv`` is right for white
noise :math:`\xi` and stays consistent for any; ``riv`` also models
:math:`\xi = (D / C)\, e`.  Young, Biometrika 63 (1976); Young, *Recursive Estimation
and Time-Series Analysis* (2011).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import get_args

import numpy as np
from scipy.signal import lfilter

from nmss_lab.identify.estimate import Estimate
from nmss_lab.identify.noise import fit_noise, long_autoregression
from nmss_lab.identify.structure import (
    ONE,
    Noise,
    Orders,
    Start,
    columns,
    input_names,
    inputs_of,
    is_stable,
    stabilised,
)
from nmss_lab.models import Array
from nmss_lab.records import Record

CONVERGED = 1e-8
"""Change of the parameters at which the passes stop, as a share of the largest, each
weighted by the size of what it multiplies."""

FREE = 10
"""Bound on the passes of refined instrumental variables."""

GUARDED = 150
"""Bound on the steps that follow where those passes do not settle."""

GUARDED_CONVERGED = 1e-6
"""Change at which those steps stop; they settle more slowly."""

HALVINGS = 40
"""How often a guarded step is halved."""


SINGULAR = 1e-13
"""Ratio of eigenvalues, all columns scaled, below which rounding decides."""

UNDETERMINED = (
    "the record does not determine the parameters: inputs move together or too "
    "little, or the orders are too high"
)

WHITE = Noise(0)
"""White noise."""


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
        If the record does not fit the orders, is too short or irregularly sampled, or
        a column is constant.
    """
    work = Work.of(record, orders, start)
    p = work.ordinary()
    e = work.y[work.first :] - work.plain @ p
    return work.estimate(p, work.plain, e, "least squares", 1, "", ONE, ONE)


def sriv(record: Record, orders: Orders, start: Start = "rest") -> Estimate:
    """Simplified refined instrumental variables, iterated to convergence.

    Each pass filters everything by 1 / A and takes the output of the model of the pass
    before as instruments.  Unstable passes are reflected into the unit circle; passes
    that do not settle at a stable model go on as guarded Gauss-Newton steps to the same
    end.  A result that still is unstable or has not settled says so in ``problem``.

    Parameters and errors are those of ``least_squares``.
    """
    work = Work.of(record, orders, start)
    p, passes, problem = work.settle(work.ordinary(), WHITE)
    return work.finish(p, "sriv", passes, problem, ONE, ONE)


def riv(
    record: Record, orders: Orders, noise: Noise, start: Start = "rest"
) -> Estimate:
    """Refined instrumental variables with a model of the noise, started from ``sriv``.

    Parameters
    ----------
    noise : Noise
        Fitted to the residuals in every pass, see ``fit_noise``.
    record, orders, start : see ``least_squares``

    Raises
    ------
    ValueError
        As ``least_squares``, or if the record is too short for the noise model.
    """
    work = Work.of(record, orders, start)
    if len(record.y) < 4 * (noise.ar + noise.ma):
        raise ValueError(f"{len(record.y)} samples are too few for {noise}")
    begin, _, _ = work.settle(work.ordinary(), WHITE)
    p, passes, problem = work.settle(begin, noise)
    c, d = work.noise_at(p, noise)
    return work.finish(p, "riv", passes, problem, c, d)


@dataclass(frozen=True, eq=False)
class Work:
    """Data and regressors of one fit."""

    record: Record
    orders: Orders
    start: Start
    y: Array
    inputs: Array
    first: int

    @classmethod
    def of(cls, record: Record, orders: Orders, start: Start) -> Work:
        """Check the record against the orders."""
        inputs, y = inputs_of(record), record.y
        _check(record, orders, start)
        first = orders.reach if start == "skip" else 0
        unknown = orders.count + (orders.reach if start == "estimate" else 0)
        if len(y) - first < 2 * unknown or len(y) <= orders.reach:
            raise ValueError(
                f"{len(y)} samples are too few for the {unknown} unknowns of {orders} "
                f'with start = "{start}"'
            )
        return cls(record, orders, start, y[:, 0], inputs, first)

    @property
    def nuisance(self) -> int:
        """Coefficients of the response to what went before the first sample."""
        return self.orders.reach if self.start == "estimate" else 0

    @cached_property
    def base(self) -> Array:
        """Output, inputs and, if the past is fitted, an impulse in its place: rows."""
        rows = np.zeros((1 + self.inputs.shape[1] + bool(self.nuisance), len(self.y)))
        rows[0], rows[1 : 1 + self.inputs.shape[1]] = self.y, self.inputs.T
        if self.nuisance:
            rows[-1, 0] = 1.0
        return rows

    @cached_property
    def plain(self) -> Array:
        """Regressors of the equation as it is."""
        return self.rows(self.y, self.base[1:])

    @cached_property
    def size(self) -> Array:
        """Size of what each parameter multiplies: frees the passes from the units."""
        return _norms(self.plain)

    def rows(self, y: Array, known: Array) -> Array:
        """Regressors (N - first, count + nuisance) of an output and known signals."""
        past = [(-y, i + 1) for i in range(self.orders.na)]
        return columns(past + self.terms(known))[self.first :]

    def terms(self, known: Array) -> list[tuple[Array, int]]:
        """Known signals that the coefficients after A multiply, and their delays."""
        inputs = known[: self.inputs.shape[1]]
        return self.orders.of_inputs(inputs) + [
            (known[-1], i) for i in range(self.nuisance)
        ]

    def ordinary(self) -> Array:
        """Least squares on the equation."""
        scaled = self.plain / self.size
        p, *_ = np.linalg.lstsq(scaled, self.y[self.first :], rcond=None)
        return p / self.size

    def denominator(self, p: Array) -> Array:
        """Return A with its unstable roots reflected."""
        return stabilised(np.concatenate([ONE, p[: self.orders.na]]))

    def is_stable(self, p: Array) -> bool:
        """Whether A is stable as it is."""
        return is_stable(np.concatenate([ONE, p[: self.orders.na]]))

    def residuals(self, p: Array) -> Array:
        """Measured minus simulated output, (N - first,)."""
        known = np.asarray(lfilter(ONE, self.denominator(p), self.base[1:]))
        error: Array = self.y - columns(self.terms(known)) @ p[self.orders.na :]
        return error[self.first :]

    def filtered(self, p: Array, c: Array, d: Array) -> tuple[Array, Array, Array]:
        """Instruments, regressors and output, filtered by C / (A D).

        The output x of the model, which the instruments hold in place of y, is B u / A.
        """
        A = self.denominator(p)
        signals = np.asarray(lfilter(ONE, A, self.base))
        x = columns(self.terms(signals[1:])) @ p[self.orders.na :]
        if len(c) + len(d) > 2:
            signals = np.asarray(lfilter(c, d, signals))
        x = np.asarray(lfilter(c, np.convolve(A, d), x))
        Z, Phi = self.rows(x, signals[1:]), self.rows(signals[0], signals[1:])
        return Z, Phi, signals[0, self.first :]

    def refine(self, p: Array, c: Array, d: Array) -> Array:
        """One pass of refined instrumental variables."""
        Z, Phi, y = self.filtered(p, c, d)
        products = Z.T @ Phi / np.outer(self.size, self.size)
        return np.linalg.solve(products, Z.T @ y / self.size) / self.size

    def descend(self, p: Array, c: Array, d: Array) -> Array:
        """One Gauss-Newton step, of a length that lowers the residuals of a stable A.

        Its fixed points are those of ``refine``: the instruments are the slopes of the
        innovations.

        Raises
        ------
        LinAlgError
            If no part of the step does.
        """
        Z, Phi, y = self.filtered(p, c, d)
        size, e = _norms(Z), y - Phi @ p
        step = np.linalg.lstsq(Z / size, e, rcond=None)[0] / size
        now = self.cost(p, c, d)
        best = _lowest(now, -2.0 * float(step @ (Z.T @ e)), self.cost(p + step, c, d))
        for length in (best, *0.5 ** np.arange(HALVINGS)):
            new = p + length * step
            if self.is_stable(new) and self.cost(new, c, d) <= now * (1.0 + 1e-12):
                return new
        raise np.linalg.LinAlgError("no step lowers the residuals")

    def cost(self, p: Array, c: Array, d: Array) -> float:
        """Sum of squares of the innovations."""
        e = self.residuals(p)
        if len(c) + len(d) > 2:
            e = np.asarray(lfilter(c, d, e))
        return float(e @ e)

    def noise_at(self, p: Array, noise: Noise) -> tuple[Array, Array]:
        """Noise model of the residuals."""
        return fit_noise(self.residuals(p), noise) if noise != WHITE else (ONE, ONE)

    def settle(self, p: Array, noise: Noise) -> tuple[Array, int, str]:
        """Repeat passes until the parameters stand still at a stable model.

        Passes that swing, diverge or end in an unstable model go on as guarded steps,
        from where they ended or from the beginning, whichever fits better.

        Returns
        -------
        parameters, number of passes, problem
        """
        end, passes, problem = self.repeat(p, noise, self.refine, FREE, CONVERGED)
        if not problem and self.is_stable(end):
            return end, passes, problem
        starts = [
            np.concatenate([self.denominator(q)[1:], q[self.orders.na :]])
            for q in (end, p)
        ]
        best = min(starts, key=lambda q: self.cost(q, *self.noise_at(q, noise)))
        end, more, problem = self.repeat(
            best, noise, self.descend, GUARDED, GUARDED_CONVERGED
        )
        return end, passes + more, problem

    def repeat(
        self,
        p: Array,
        noise: Noise,
        one_pass: Callable[[Array, Array, Array], Array],
        bound: int,
        converged: float,
    ) -> tuple[Array, int, str]:
        """Repeat one kind of pass; see ``settle``."""
        change = np.inf
        for passes in range(1, bound + 1):
            try:
                new = one_pass(p, *self.noise_at(p, noise))
            except np.linalg.LinAlgError:
                return p, passes, "the instruments do not determine the parameters"
            if not np.isfinite(new).all():
                return p, passes, "the passes diverged"
            change, p = self.change(new, p), new
            if change < converged:
                return p, passes, ""
        return p, bound, f"the passes did not settle: last change {change:.1e}"

    def change(self, new: Array, old: Array) -> float:
        """Largest change between passes."""
        largest = max(float(np.abs(new * self.size).max()), 1e-300)
        return float(np.abs((new - old) * self.size).max()) / largest

    def finish(
        self, p: Array, method: str, passes: int, problem: str, c: Array, d: Array
    ) -> Estimate:
        """Instruments and innovations at the end of the passes."""
        Z, _, _ = self.filtered(p, c, d)
        e = np.asarray(lfilter(c, d, self.residuals(p)))
        return self.estimate(p, Z, e, method, passes, problem, c, d)

    def estimate(
        self,
        p: Array,
        Z: Array,
        e: Array,
        method: str,
        passes: int,
        problem: str,
        c: Array,
        d: Array,
    ) -> Estimate:
        """Say how certain the result is and what is wrong with it.

        Nuisance coefficients are left out after they have had their effect.
        """
        n = self.orders.count
        bread, determined = inverse_product(Z)
        if not determined:
            problem = UNDETERMINED
        if not self.is_stable(p):
            problem = "the model is unstable"
        settled = e[max(len(c), len(d)) - 1 :]
        s2 = np.mean(settled**2) * len(e) / (len(e) - n)
        return Estimate(
            orders=self.orders,
            parameters=p[:n],
            covariance=s2 * bread[:n, :n],
            sandwich=(bread @ _weighted(Z, e) @ bread)[:n, :n] * len(e) / (len(e) - n),
            record=self.record,
            method=method,
            passes=passes,
            problem=problem,
            noise_c=c,
            noise_d=d,
            initial=p[n:],
            start=self.start,
        )


def _check(record: Record, orders: Orders, start: Start) -> None:
    _ = record.dt  # refuses irregular sampling
    if start not in get_args(Start):
        raise ValueError(f'start = "{start}": expected one of {get_args(Start)}')
    if record.y.shape[1] != 1:
        raise ValueError(
            f"record has {record.y.shape[1]} outputs, expected one at a time: "
            "see Record.output"
        )
    if np.ptp(record.y) == 0.0:
        raise ValueError(f"output {record.names['y'][0]} is constant")
    inputs = inputs_of(record)
    if inputs.shape[1] != len(orders.nb):
        raise ValueError(
            f"orders {orders} are for {len(orders.nb)} inputs, the record has "
            f"{inputs.shape[1]}"
        )
    for name, u in zip(input_names(record), inputs.T, strict=True):
        if np.ptp(u) == 0.0 and (start != "rest" or u[0] == 0.0):
            raise ValueError(
                f"input {name} is constant: nothing can be learnt of it, unless it "
                'stepped from zero at the first sample (start = "rest")'
            )


def _lowest(now: float, slope: float, there: float) -> float:
    """Length of a step at the bottom of the parabola through its ends."""
    bend = there - now - slope
    return float(np.clip(-slope / (2.0 * bend), 0.1, 10.0)) if bend > 0.0 else 1.0


def _norms(signals: Array) -> Array:
    size = np.sqrt(np.einsum("ij,ij->j", signals, signals))
    return np.where(size > 0.0, size, 1.0)


def inverse_product(Z: Array) -> tuple[Array, bool]:
    """Inverse of Z'Z, and whether Z determines all its columns' factors.

    What it does not determine gets a huge variance, never none.
    """
    size = _norms(Z)
    values, axes = np.linalg.eigh((Z / size).T @ (Z / size))
    determined = bool(values.min() > SINGULAR * values.max())
    values = np.maximum(values, np.finfo(float).eps * values.max())
    return (axes / values) @ axes.T / np.outer(size, size), determined


def _weighted(Z: Array, e: Array) -> Array:
    """Covariance of Z'e for coloured e: an autoregression of e, run backwards over Z.

    Z holds nothing of the noise, so that with e = w / C the products Z'e are sums of
    the white w times Z filtered by 1 / C against time.
    """
    c = long_autoregression(e)
    w = np.asarray(lfilter(c, ONE, e))[len(c) - 1 :]
    backwards = np.asarray(lfilter(ONE, c, Z[::-1], axis=0))
    return np.mean(w**2) * (backwards.T @ backwards)
