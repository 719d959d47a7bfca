"""Time of a Monte Carlo ensemble beside a plain loop over quadratic programs.

Run as ``python benchmarks/ensembles.py``.  Both run the IFAC'93 benchmark under
predictive control with |u| <= 5 on plants drawn within stress level 2, in the same
process and in turns, with one thread; processor time counts.  The loop is what one
writes with a solver at hand: the matrices are condensed once, the vectors are built at
every sample, and ``qpsolvers.solve_qp`` is called for each.  It is timed for every
solver installed, on the first plants only, as each takes the same time.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import dataclasses
import platform
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import qpsolvers

import nmss_lab
from nmss_lab.cases import STRESS_LEVELS, case, ifac93_plant, square_wave
from nmss_lab.controller import Status
from nmss_lab.models import LinearPlant
from nmss_lab.parallel import each
from nmss_lab.predictive import PredictiveController
from nmss_lab.simulate import Run, Scenario, closed_loops

REALISATIONS, SAMPLES, LEVEL = 1000, 200, 2
PLAIN = 20
"""Realisations on which the plain loops are timed and compared."""

REPEATS = 5
CHUNK = 250
"""Realisations of one task of a worker process."""

NOMINAL = {"T1": 5.0, "T2": 0.4, "w0": 5.0, "zeta": 0.3, "K": 1.0}
TOLERANCES: dict[str, dict[str, float]] = {
    "daqp": {"primal_tol": 1e-10, "dual_tol": 1e-12},
    "proxqp": {"eps_abs": 1e-11, "eps_rel": 0.0},
}
"""Tighter than the solvers' own, so that trajectories can be compared to 1e-8; DAQP,
like quadprog an active-set method, takes no longer for it."""

Trajectories = tuple[np.ndarray, np.ndarray]


def plants(seed: int) -> list[LinearPlant]:
    """Draw a chunk of sampled plants, uniform within the stress level."""
    rng = np.random.default_rng([1993, seed])
    spans = STRESS_LEVELS[LEVEL].items()
    return [
        ifac93_plant(
            **{name: NOMINAL[name] + rng.uniform(-span, span) for name, span in spans}
        ).sampled(0.5)
        for _ in range(CHUNK)
    ]


def controller(reading: str) -> PredictiveController:
    """Build the case's design with a reading of the reference."""
    design = case("ifac93_4_4_2").designs["integral_of_error"]
    return dataclasses.replace(design, reference=reading).build()


def plain_loop(
    plant: LinearPlant, built: PredictiveController, r: list[float], **solver: Any
) -> Trajectories:
    """Run one closed loop with a quadratic program at every sample; return u and y.

    Of the library it uses matrices only.
    """
    program, held = built.program, built.knowledge.layout.shapes["r"][0]
    H, F = program.H, program.f
    G = np.vstack([program.M, -program.M])
    S = np.vstack([-program.offset, program.offset])
    limits = np.concatenate([program.upper, -program.lower])
    A, B, C = plant.A, plant.B[:, 0], plant.C[0]
    state, theta = np.zeros(len(A)), np.zeros(F.shape[1])
    u, integral = 0.0, 0.0
    us, ys = np.zeros(len(r)), np.zeros(len(r))
    for k, r_k in enumerate(r):
        y = C @ state
        integral += r_k - y
        theta[:4] = y, u, integral, u
        if held:
            theta[4] = r_k
        z = qpsolvers.solve_qp(H, F @ theta, G, limits + S @ theta, **solver)
        u = z[0]
        state = A @ state + B * u
        us[k], ys[k] = u, y
    return us, ys


def fastest(
    tasks: dict[str, Callable[[], Any]], clock: Callable[[], float]
) -> tuple[dict[str, float], dict[str, Any]]:
    """Seconds of each task, the fewest of all rounds, and what it returned."""
    times, results = dict.fromkeys(tasks, np.inf), {}
    for _ in range(REPEATS):
        for name, task in tasks.items():
            begin = clock()
            results[name] = task()
            times[name] = min(times[name], clock() - begin)
    return times, results


def difference(runs: list[Run], others: list[Trajectories]) -> tuple[float, float]:
    """Largest difference in u and in y."""
    pairs = list(zip(runs, others, strict=True))
    return (
        max(np.abs(run.u[:, 0] - u).max() for run, (u, _) in pairs),
        max(np.abs(run.y[:, 0] - y).max() for run, (_, y) in pairs),
    )


def shares(runs: list[Run]) -> tuple[float, int]:
    """Share of samples at which a limit held, and programs solved for them."""
    limited = np.mean([run.status == Status.LIMITED for run in runs])
    solved = sum(int((run.iterations > 0).sum()) for run in runs)
    return float(limited), solved


def plain_loops(
    drawn: list[LinearPlant], built: PredictiveController
) -> dict[str, Callable[[], list[Trajectories]]]:
    """Plain loops on the first plants, by solver."""
    r = square_wave(SAMPLES, 20)[:, 0].tolist()
    loops = {
        name: partial(
            plain_loop, built=built, r=r, solver=name, **TOLERANCES.get(name, {})
        )
        for name in qpsolvers.available_solvers
    }
    return {
        name: lambda loop=loop: [loop(plant) for plant in drawn[:PLAIN]]
        for name, loop in loops.items()
    }


def compare(drawn: list[LinearPlant], reading: str) -> None:
    """Print all times for a reading of the reference."""
    built, scenario = controller(reading), Scenario(square_wave(SAMPLES, 20))
    plain = plain_loops(drawn, built)
    ensemble = {"closed_loops": lambda: closed_loops(drawn, built, scenario)}
    times, results = fastest({**ensemble, **plain}, time.process_time)
    runs = results["closed_loops"]
    limited, solved = shares(runs)
    rate = len(drawn) / times["closed_loops"]
    print(f'reading "{reading}": a limit held at {limited:.1%} of the samples')
    print(f"  closed_loops {rate:9.0f} realisations/s, {solved} programs solved in all")
    for name in plain:
        in_u, in_y = difference(runs[:PLAIN], results[name])
        print(
            f"  {name:12} {PLAIN / times[name]:9.0f} realisations/s, "
            f"{rate * times[name] / PLAIN:6.1f} times as long; differs by {in_u:.1e} "
            f"in u, {in_y:.1e} in y"
        )
        if not max(in_u, in_y) < 1e-8:
            raise SystemExit(f"closed_loops and the loop with {name} differ")


def draw_and_run(seed: int) -> Trajectories:
    """Run the task of a worker process: draw a chunk and run it."""
    scenario = Scenario(square_wave(SAMPLES, 20))
    runs = closed_loops(plants(seed), controller("held"), scenario)
    return np.array([run.u for run in runs]), np.array([run.y for run in runs])


def scale() -> None:
    """Print times with worker processes."""
    seeds = range(16)
    with ProcessPoolExecutor(1) as one, ProcessPoolExecutor(2) as two:
        tasks = {
            name: lambda pool=pool: dict(each(draw_and_run, seeds, pool))
            for name, pool in (("one", one), ("two", two))
        }
        times, found = fastest(tasks, time.perf_counter)
    for name, seconds in times.items():
        print(f"  in {name}: {len(seeds) * CHUNK / seconds:6.0f} realisations/s")
    same = all(np.array_equal(found["one"][i], found["two"][i]) for i in seeds)
    print(
        f"  {times['one'] / times['two']:.2f} times as fast in two; the numbers are "
        f"{'the same' if same else 'NOT THE SAME'}"
    )


def processor() -> str:
    """Name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if "model name" in line]
    return names[0] if names else platform.processor() or "unknown"


def main() -> None:
    """Measure and print."""
    drawn = [plant for i in range(REALISATIONS // CHUNK) for plant in plants(i)]
    print(
        f"{REALISATIONS} realisations, {SAMPLES} samples; plain loops on {PLAIN} of "
        f"them; fastest of {REPEATS}, processor time\n"
        f"nmss-lab {nmss_lab.__version__}, Python {platform.python_version()}, "
        f"NumPy {np.__version__}, qpsolvers {qpsolvers.__version__}; {processor()}, "
        f"{os.cpu_count()} processors"
    )
    for reading in ("zero", "held"):
        compare(drawn, reading)
    print(
        f'worker processes, reading "held", {CHUNK} realisations a task, drawing and '
        "sampling the plants included; time on the wall"
    )
    scale()


if __name__ == "__main__":
    main()
