"""Time of an order search beside a plain loop over output-error fits by SciPy.

Run as ``python benchmarks/identification.py``.  Both fit the same 64 structures to the
same 1,000 samples, in turns; first in one process, then both in two.  The loop is what
one writes without a library for the task: start at least squares on the equation,
minimise the simulation error with ``scipy.optimize.least_squares``.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from frame import Figure, compared, in_turns, show
from scipy.optimize import least_squares
from scipy.signal import lfilter

from nmss_lab.identify import Candidate, Orders, order_search, prbs, structures
from nmss_lab.parallel import executor_for, in_order
from nmss_lab.records import Record

PART = "Identification"
SAMPLES = 1000
RANGE = range(1, 5)
"""Values of each of na, nb and nk: 64 structures."""

SAME = 1e-3
"""Relative difference up to which two mean square errors count as one minimum."""


def record() -> Record:
    """Make a record of a plant [3 2 2] with white noise, 20 dB below its output."""
    u = prbs(SAMPLES, clock=3)
    x = lfilter([0.0, 0.0, 0.4, 0.3], np.poly([0.9, 0.6 + 0.3j, 0.6 - 0.3j]).real, u)
    noise = np.random.default_rng(1).standard_normal(SAMPLES)
    y = x + 0.1 * np.std(x) * noise
    return Record(time=np.arange(float(SAMPLES)), y=y, u=u)


def by_scipy(data: Record, orders: Orders) -> float:
    """Fit one structure by output error; return its mean square error."""
    y, u = data.y[:, 0], data.u

    def error(p: np.ndarray) -> np.ndarray:
        a, (b,) = orders.split(p)
        with np.errstate(over="ignore", invalid="ignore"):
            e = y - lfilter(b, a, u[:, 0])
            return np.nan_to_num(e, nan=1e6, posinf=1e6, neginf=-1e6).clip(-1e6, 1e6)

    begin, *_ = np.linalg.lstsq(orders.regressors(y, u), y, rcond=None)
    return float(np.mean(least_squares(error, begin, x_scale="jac").fun ** 2))


def measure(
    quick: bool = False, say: Callable[[str], None] = print
) -> Iterator[Figure]:
    """Yield the figures of an order search."""
    data, rounds = record(), 2 if quick else 9
    tries = structures(1, RANGE, RANGE, RANGE)
    fit = partial(by_scipy, data)
    for processes in (1, 2):
        say(f"identification: processes: {processes}")
        with executor_for(processes) as pool:
            works = {
                "ours": lambda pool=pool: order_search(
                    data, RANGE, RANGE, RANGE, executor=pool
                ),
                "theirs": lambda pool=pool: list(in_order(fit, tries, pool)),
            }
            for work in works.values():
                work()  # starts the processes
            times, found = in_turns(works, rounds)
        yield compared(
            PART,
            "order search" + (" in two processes" if pool else ""),
            f"{len(tries)} structures, {SAMPLES} samples; {rounds} times",
            times["ours"],
            "output-error fits by scipy" + (" in two processes" if pool else ""),
            times["theirs"],
            unit="s",
            note=quality(found["ours"], dict(zip(tries, found["theirs"], strict=True))),
        )


def quality(ours: list[Candidate], theirs: dict[Orders, float]) -> str:
    """Say how mean square errors compare."""
    ratios = np.array(
        [each.estimate.variance / theirs[each.orders] for each in ours if each.estimate]
    )
    return (
        f"mean square error: the same in {np.sum(np.abs(ratios - 1) < SAME)}, lower in "
        f"{np.sum(ratios < 1 - SAME)}, higher in {np.sum(ratios > 1 + SAME)}, none in "
        f"{len(theirs) - len(ratios)}; ours also gives covariances and criteria"
    )


if __name__ == "__main__":
    show(measure)
