"""Signals for a planned experiment, and how certain a model it would give."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter, max_len_seq

from nmss_lab.identify.fit import inverse_product
from nmss_lab.identify.structure import ONE, Orders
from nmss_lab.models import Array, LinearPlant
from nmss_lab.records import Record


def prbs(
    samples: int,
    clock: int = 1,
    low: float = -1.0,
    high: float = 1.0,
    rate: float = np.inf,
) -> Array:
    """Pseudo-random binary signal (samples,) from a maximum-length shift register.

    Parameters
    ----------
    samples : int
    clock : int
        Samples between possible changes.
    low, high : float
        The two levels.
    rate : float
        Largest change a sample.

    Raises
    ------
    ValueError
        If samples, clock or rate is not positive.
    """
    if samples < 1 or clock < 1:
        raise ValueError(f"samples = {samples}, clock = {clock} must be positive")
    length = -(-samples // clock)
    register = max(2, int(np.ceil(np.log2(length + 1))))
    bits = np.asarray(max_len_seq(register, length=length)[0])
    return _rated(np.where(np.repeat(bits, clock)[:samples] > 0, high, low), rate)


def staircase(levels: Sequence[float], hold: int, rate: float = np.inf) -> Array:
    """Signal that holds each level for ``hold`` samples, moving at most ``rate`` each.

    Raises
    ------
    ValueError
        If hold or rate is not positive.
    """
    if hold < 1:
        raise ValueError(f"hold = {hold} must be positive")
    return _rated(np.repeat(np.asarray(levels, dtype=float), hold), rate)


def multilevel(
    samples: int,
    hold: int,
    levels: Sequence[float],
    rng: np.random.Generator,
    rate: float = np.inf,
) -> Array:
    """Signal (samples,) that jumps to a random level every ``hold`` samples.

    Raises
    ------
    ValueError
        If samples, hold or rate is not positive, or no level is given.
    """
    if samples < 1 or not len(levels):
        raise ValueError(f"samples = {samples}, levels = {levels}: expected some")
    chosen = rng.choice(np.asarray(levels, dtype=float), -(-samples // max(hold, 1)))
    return staircase(chosen.tolist(), hold, rate)[:samples]


def _rated(wanted: Array, rate: float) -> Array:
    """Follow a signal with changes of at most ``rate``."""
    if not rate > 0:
        raise ValueError(f"rate = {rate} must be positive")
    if np.isinf(rate):
        return wanted
    signal = wanted.astype(float)
    for k in range(1, len(signal)):
        signal[k] = np.clip(wanted[k], signal[k - 1] - rate, signal[k - 1] + rate)
    return signal


def experiment(
    plant: LinearPlant,
    signal: Array,
    noise: float,
    rng: np.random.Generator,
    moved: int = 0,
) -> Record:
    """Record what a plant at rest does while one of its inputs follows a signal.

    Parameters
    ----------
    plant : LinearPlant
    signal : array (N,)
    noise : float
        Standard deviation of white noise on each output, as a share of that of the
        output itself.
    rng : numpy.random.Generator
    moved : int
        Which input moves; the others rest and are not part of the record.

    Raises
    ------
    ValueError
        If the plant has no such input or the noise is negative.
    """
    if not 0 <= moved < plant.n_u or noise < 0.0:
        raise ValueError(
            f"moved = {moved}, noise = {noise}: expected an input from 0 to "
            f"{plant.n_u - 1} and noise of at least 0"
        )
    x, y = np.zeros(plant.n_x), np.zeros((len(signal), plant.n_y))
    for k, u in enumerate(signal):
        y[k] = plant.C @ x
        x = plant.A @ x + plant.B[:, moved] * u
    y += noise * y.std(axis=0) * rng.standard_normal(y.shape)
    time = plant.dt * np.arange(float(len(signal)))
    return Record(time, y, signal, names={"u": (f"u{moved + 1}",)})


def expected_errors(
    orders: Orders,
    parameters: Array,
    inputs: Array,
    noise: float,
    noise_c: Array = ONE,
    noise_d: Array = ONE,
) -> Array:
    """Predict the standard errors (n,) that a planned experiment would give.

    Parameters
    ----------
    orders, parameters : model that is expected
    inputs : array (N, n_u)
        Planned inputs, from rest.
    noise : float
        Standard deviation of the white noise behind the disturbance of the output.
    noise_c, noise_d : arrays
        Polynomials of a coloured disturbance (D / C) e, known to ``riv``.
    """
    inputs = np.asarray(inputs, dtype=float).reshape(len(inputs), -1)
    A, B = orders.split(np.asarray(parameters, dtype=float))
    by = np.convolve(A, noise_d)
    x = np.sum([lfilter(b, A, u) for b, u in zip(B, inputs.T, strict=True)], axis=0)
    Z = orders.regressors(
        np.asarray(lfilter(noise_c, by, x)),
        np.asarray(lfilter(noise_c, by, inputs, axis=0)),
    )
    return noise * np.sqrt(np.diag(inverse_product(Z)[0]))
