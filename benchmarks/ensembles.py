"""Time of a Monte Carlo ensemble beside a plain loop over quadratic programs.

Run as ``python benchmarks/ensembles.py``.  Both run the IFAC'93 benchmark under
predictive control with |u| <= 5 on plants drawn within stress level 2, in the same
process and in turns, with one thread; processor time counts.  The loop is what one
writes with a solver at hand: the matrices are condensed once, the vectors are built at
every sample, and ``qpsolvers.solve_qp`` is called for each.  It is timed for every
solver installed, on the first plants only, as each takes the same time.  That all find
the same inputs and outputs is checked.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import qpsolvers
from frame import Figure, compared, in_turns, show

from nmss_lab.cases import STRESS_LEVELS, case, ifac93_plant, square_wave
from nmss_lab.controller import Status
from nmss_lab.models import LinearPlant
from nmss_lab.parallel import each, executor_for
from nmss_lab.predictive import PredictiveController
from nmss_lab.simulate import Run, Scenario, closed_loops

PART = "Ensembles"
SAMPLES, LEVEL = 200, 2
SAME = 1e-8
"""Largest difference in u and y."""

NOMINAL = {"T1": 5.0, "T2": 0.4, "w0": 5.0, "zeta": 0.3, "K": 1.0}
TOLERANCES: dict[str, dict[str, float]] = {
    "daqp": {"primal_tol": 1e-10, "dual_tol": 1e-12},
    "proxqp": {"eps_abs": 1e-11, "eps_rel": 0.0},
}
"""Tighter than the solvers' own, so that trajectories can be compared to 1e-8; DAQP,
like quadprog an active-set method, takes no longer for it."""

Trajectories = tuple[np.ndarray, np.ndarray]


def plants(seed: int, size: int) -> list[LinearPlant]:
    """Draw sampled plants, uniform within the stress level."""
    rng = np.random.default_rng([1993, seed])
    spans = STRESS_LEVELS[LEVEL].items()
    return [
        ifac93_plant(
            **{name: NOMINAL[name] + rng.uniform(-span, span) for name, span in spans}
        ).sampled(0.5)
        for _ in range(size)
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


def difference(runs: list[Run], others: list[Trajectories]) -> float:
    """Largest difference in u and y."""
    return max(
        np.abs([run.u[:, 0] - u, run.y[:, 0] - y]).max()
        for run, (u, y) in zip(runs, others, strict=True)
    )


def plain_loops(
    drawn: list[LinearPlant], built: PredictiveController
) -> dict[str, Callable[[], list[Trajectories]]]:
    """Plain loops on all plants, by solver."""
    r = square_wave(SAMPLES, 20)[:, 0].tolist()
    loops = {
        name: partial(
            plain_loop, built=built, r=r, solver=name, **TOLERANCES.get(name, {})
        )
        for name in qpsolvers.available_solvers
    }
    return {
        name: lambda loop=loop: [loop(plant) for plant in drawn]
        for name, loop in loops.items()
    }


def compare(
    reading: str, realisations: int, plain: int, rounds: int
) -> Iterator[Figure]:
    """Yield the time of a realisation beside every loop over programs.

    Raises
    ------
    RuntimeError
        If results differ by more than ``SAME``.
    """
    drawn = plants(0, realisations)
    built, scenario = controller(reading), Scenario(square_wave(SAMPLES, 20))
    loops = plain_loops(drawn[:plain], built)
    ensemble = {"ours": lambda: closed_loops(drawn, built, scenario)}
    times, results = in_turns(ensemble | loops, rounds, time.process_time)
    runs = results["ours"]
    for name in loops:
        apart = difference(runs[:plain], results[name])
        if not apart <= SAME:
            raise RuntimeError(f"closed_loops and the loop with {name}: {apart} apart")
    limited = np.mean([run.status == Status.LIMITED for run in runs])
    solved = sum(int((run.iterations > 0).sum()) for run in runs)
    best = min(loops, key=lambda name: float(np.median(times[name])))
    for name in loops:
        target = {"target": "at most 1/20", "bound": 0.05} if name == best else {}
        yield compared(
            PART,
            f'a realisation, reading "{reading}"',
            f"IFAC'93, {SAMPLES} samples, {realisations} plants of stress level "
            f"{LEVEL}; {rounds} times",
            1e3 * np.array(times["ours"]) / realisations,
            f"loop over qpsolvers, {name}, {plain} plants",
            1e3 * np.array(times[name]) / plain,
            unit="ms of processor time",
            note=f"a limit held at {limited:.1%} of the samples, {solved} programs "
            "solved in all",
            **target,
        )


def draw_and_run(task: tuple[int, int]) -> Trajectories:
    """Draw a chunk of plants, by seed and size, and run it."""
    scenario = Scenario(square_wave(SAMPLES, 20))
    runs = closed_loops(plants(*task), controller("held"), scenario)
    return np.array([run.u for run in runs]), np.array([run.y for run in runs])


def growth(chunks: int, size: int, rounds: int) -> Iterator[Figure]:
    """Yield the time with worker processes beside that without.

    Raises
    ------
    RuntimeError
        If the numbers depend on where they were computed.
    """
    tasks = [(seed, size) for seed in range(chunks)]
    counts = [count for count in (1, 2, 4) if count <= max(os.cpu_count() or 1, 2)]
    with contextlib.ExitStack() as stack:
        pools = {n: stack.enter_context(executor_for(n)) for n in counts}
        works = {
            str(n): lambda pool=pool: dict(each(draw_and_run, tasks, pool))
            for n, pool in pools.items()
        }
        for work in works.values():
            work()  # starts the processes
        times, found = in_turns(works, rounds)
    for name in list(works)[1:]:
        if not all(np.array_equal(found["1"][i], found[name][i]) for i in found["1"]):
            raise RuntimeError(f"in {name} processes the numbers are not the same")
        yield compared(
            PART,
            f"an ensemble in {name} processes, drawing and sampling included",
            f"IFAC'93, {SAMPLES} samples, {chunks} chunks of {size} plants; "
            f"{rounds} times",
            times[name],
            "the same in one process",
            times["1"],
            unit="s",
            target=f"ideally {1 / int(name):g}",
        )


def measure(
    quick: bool = False, say: Callable[[str], None] = print
) -> Iterator[Figure]:
    """Yield the figures of ensembles."""
    for reading in ("zero", "held"):
        say(f'ensembles: reading "{reading}"')
        yield from compare(reading, *((100, 2, 2) if quick else (1000, 20, 7)))
    say("ensembles: worker processes")
    yield from growth(*((4, 25, 2) if quick else (16, 250, 5)))


if __name__ == "__main__":
    show(measure)
