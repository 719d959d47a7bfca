"""What an estimate's covariance means for its step response and its poles."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from nmss_lab.identify.estimate import Estimate, draw
from nmss_lab.models import Array

BAND = 0.025, 0.975
"""Quantiles between which a band lies."""


def step_response(estimate: Estimate, samples: int, channel: int = 0) -> Array:
    """Output (samples,) after a unit step of one input at the first sample.

    Parameters
    ----------
    estimate : Estimate
    samples : int
    channel : int
        Which input, measured disturbances after the inputs.
    """
    return _step(estimate, estimate.parameters, samples, channel)


def step_band(
    estimate: Estimate,
    samples: int,
    rng: np.random.Generator,
    channel: int = 0,
    draws: int = 200,
) -> tuple[Array, Array]:
    """Lower and upper end (samples,) of 95 % of the step responses drawn from P*."""
    responses = [
        _step(estimate, p, samples, channel) for p in draw(estimate, draws, rng)
    ]
    low, high = np.quantile(responses, BAND, axis=0)
    return low, high


def pole_draws(estimate: Estimate, n: int, rng: np.random.Generator) -> Array:
    """Poles (n, na), complex, of models drawn from P*."""
    A = draw(estimate, n, rng)[:, : estimate.orders.na]
    return np.array([np.roots(np.concatenate([[1.0], a])) for a in A])


def _step(estimate: Estimate, p: Array, samples: int, channel: int) -> Array:
    A, B = estimate.orders.split(p)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(lfilter(B[channel], A, np.ones(samples)))
