"""Models of coloured noise: xi = (D / C) e with white e."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from nmss_lab.identify.structure import ONE, Noise, delayed, is_stable, stabilised
from nmss_lab.models import Array

STEPS = 100
"""Bound on the Gauss-Newton steps for a moving average."""

LONGEST = 20
"""Highest order of an autoregression of residuals."""

STILL = 1e-11
"""Largest step at which the noise model counts as converged."""


def fit_noise(xi: Array, noise: Noise) -> tuple[Array, Array]:
    """Polynomials C and D of xi = (D / C) e, both stable and monic.

    AR by least squares; ARMA by Hannan and Rissanen's regression on the residuals of
    a long AR, then Gauss-Newton on the innovations.  The first samples, whose past is
    unknown, do not count.

    Parameters
    ----------
    xi : array (N,)
    noise : Noise
    """
    if noise.ma == 0:
        return _autoregression(xi, noise.ar), ONE
    theta = _hannan_rissanen(xi, noise)
    cost = np.sum(_innovations(xi, theta, noise) ** 2)
    for _ in range(STEPS):
        step = _step(xi, theta, noise)
        theta, cost, moved = _improved(xi, theta, step, cost, noise)
        if moved < STILL:
            break
    return _polynomials(theta, noise)


def long_autoregression(e: Array) -> Array:
    """Autoregression of a signal, its order chosen by Schwarz's criterion.

    Orders up to a tenth of the samples and 20, by Levinson and Durbin's recursion on
    the sample autocorrelation; the chosen one is fitted by least squares.
    """
    n, bound = len(e), min(LONGEST, len(e) // 10)
    r = np.array([e[i:] @ e[: n - i] for i in range(bound + 1)])
    c, power = ONE, float(r[0])
    best, order = n * np.log(power) if power > 0.0 else -np.inf, 0
    for i in range(1, bound + 1):
        if not power > 0.0:
            break
        reflection = -(c @ r[i:0:-1]) / power
        c = np.append(c, 0.0) + reflection * np.append(c, 0.0)[::-1]
        power *= 1.0 - reflection**2
        price = n * np.log(max(power, 1e-300)) + i * np.log(n)
        if price < best:
            best, order = price, i
    return _autoregression(e, order)


def _polynomials(theta: Array, noise: Noise) -> tuple[Array, Array]:
    c, d = np.split(theta, [noise.ar])
    return np.concatenate([ONE, c]), np.concatenate([ONE, d])


def _autoregression(xi: Array, order: int) -> Array:
    if order == 0:
        return ONE
    columns = np.column_stack([-delayed(xi, i) for i in range(1, order + 1)])[order:]
    theta, *_ = np.linalg.lstsq(columns, xi[order:], rcond=None)
    return stabilised(np.concatenate([ONE, theta]))


def _hannan_rissanen(xi: Array, noise: Noise) -> Array:
    long = _autoregression(xi, min(20 + noise.ar + noise.ma, len(xi) // 5))
    e = np.asarray(lfilter(long, ONE, xi))
    columns = [-delayed(xi, i) for i in range(1, noise.ar + 1)]
    columns += [delayed(e, i) for i in range(1, noise.ma + 1)]
    rows = slice(max(noise.ar, noise.ma), None)
    theta, *_ = np.linalg.lstsq(np.column_stack(columns)[rows], xi[rows], rcond=None)
    c, d = _polynomials(theta, noise)
    return np.concatenate([stabilised(c)[1:], stabilised(d)[1:]])


def _innovations(xi: Array, theta: Array, noise: Noise) -> Array:
    c, d = _polynomials(theta, noise)
    return np.asarray(lfilter(c, d, xi))[max(noise.ar, noise.ma) :]


def _step(xi: Array, theta: Array, noise: Noise) -> Array:
    """Gauss-Newton step: de/dc_i = z^-i xi / D, de/dd_i = -z^-i e / D."""
    c, d = _polynomials(theta, noise)
    e, from_c = lfilter(c, d, xi), np.asarray(lfilter(ONE, d, xi))
    from_d = np.asarray(lfilter(ONE, d, e))
    slopes = [delayed(from_c, i) for i in range(1, noise.ar + 1)]
    slopes += [-delayed(from_d, i) for i in range(1, noise.ma + 1)]
    first = max(noise.ar, noise.ma)
    step, *_ = np.linalg.lstsq(np.column_stack(slopes)[first:], -e[first:], rcond=None)
    return step


def _improved(
    xi: Array, theta: Array, step: Array, cost: float, noise: Noise
) -> tuple[Array, float, float]:
    """Shortest of the halved steps' list that keeps stability and lowers the cost."""
    for _ in range(30):
        new = theta + step
        if all(is_stable(part) for part in _polynomials(new, noise)):
            size = float(np.sum(_innovations(xi, new, noise) ** 2))
            if size <= cost:
                return new, size, float(np.abs(step).max())
        step = step / 2.0
    return theta, cost, 0.0
