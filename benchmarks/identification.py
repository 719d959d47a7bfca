"""Time of an order search beside a plain loop over output-error fits by SciPy.

Run as ``python benchmarks/identification.py``.  Both fit the same 64 structures to the
same 1,000 samples in the same process, three times in turn; the shortest times count.
The loop is what one writes without a library for the task: start at least squares on
the equation, minimise the simulation error with ``scipy.optimize.least_squares``.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import platform
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import scipy
from scipy.optimize import least_squares
from scipy.signal import lfilter

import nmss_lab
from nmss_lab.identify import Orders, order_search, prbs, structures
from nmss_lab.records import Record

SAMPLES = 1000
RANGE = range(1, 5)
"""Values of each of na, nb and nk: 64 structures."""

REPEATS = 3
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


def fastest(task: Callable[[], object]) -> float:
    """Seconds of the fastest of the repetitions."""
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        task()
        times.append(time.perf_counter() - begin)
    return min(times)


def processor() -> str:
    """Name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if "model name" in line]
    return names[0] if names else platform.processor() or "unknown"


def main() -> None:
    """Measure and print."""
    data = record()
    tries = structures(1, RANGE, RANGE, RANGE)
    ours = {str(c.orders): c.estimate for c in order_search(data, RANGE, RANGE, RANGE)}
    theirs = {str(orders): by_scipy(data, orders) for orders in tries}
    ratios = np.array([ours[k].variance / theirs[k] for k in theirs if ours[k]])
    loop = fastest(lambda: [by_scipy(data, orders) for orders in tries])
    serial = fastest(lambda: order_search(data, RANGE, RANGE, RANGE))
    with ProcessPoolExecutor(2) as pool:
        order_search(data, [1], [1], [1, 2], executor=pool)  # starts the processes
        pair = fastest(lambda: order_search(data, RANGE, RANGE, RANGE, executor=pool))
    print(f"{len(tries)} structures, {SAMPLES} samples, fastest of {REPEATS}")
    print(
        f"nmss-lab {nmss_lab.__version__}, Python {platform.python_version()}, "
        f"NumPy {np.__version__}, SciPy {scipy.__version__}; {processor()}, "
        f"{os.cpu_count()} processors"
    )
    print(f"output error by SciPy   {loop:8.3f} s")
    print(f"order_search            {serial:8.3f} s, {loop / serial:.1f} times as fast")
    print(f"  in two processes      {pair:8.3f} s, {loop / pair:.1f} times as fast")
    print(
        f"mean square error: the same in {np.sum(np.abs(ratios - 1) < SAME)}, lower in "
        f"{np.sum(ratios < 1 - SAME)}, higher in {np.sum(ratios > 1 + SAME)} structures"
    )
    print("order_search also gives covariances and criteria; the loop does not")


if __name__ == "__main__":
    main()
