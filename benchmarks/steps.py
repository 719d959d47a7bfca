"""Time of one decision beside direct solver calls on the same quadratic program.

Run as ``python benchmarks/steps.py``.  Closed loops of four worked examples, each run
once for every call that is timed, in turns.  A solver is given the program of that
sample: Hessian and rows were handed to it once, gradient and sides are formed before
its time begins, and it starts from its last solution.  That is the least that anybody
can do who calls it.

The controller has run the loop before: it knows which rows are held in it.  What the
first loop takes is told apart, and so are loops with output noise, none of which
repeats another.  The plan behind a move is worked out when it is asked for: decisions
whose plan was asked for at once are told apart, too.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import daqp
import numpy as np
import proxsuite
import qpsolvers
from frame import Figure, compared, show, uncollected

from nmss_lab.cases import case
from nmss_lab.controller import Limits, Move, Status
from nmss_lab.design import Design
from nmss_lab.models import Plant
from nmss_lab.predictive import PredictiveController
from nmss_lab.simulate import Scenario, closed_loop, samples

PART = "Step"
LOOPS, QUICK = 30, 2
"""Closed loops of each example, and of a quick run."""

NOISE = 0.005
"""Standard deviation of an output's noise, in shares of its largest deviation."""

SAME = 1e-7
"""Largest difference from DAQP's decision, relative to 1 + the largest entry."""


DAQP, PROXQP = "DAQP, persistent", "ProxQP, warm-started"
QPSOLVERS = "qpsolvers.solve_qp"


class Loop(NamedTuple):
    """A closed loop."""

    title: str
    plant: Plant
    design: Design
    scenario: Scenario


def loops() -> list[Loop]:
    """List the loops; where the example has no limits of its own, with some."""
    chosen = (
        ("IFAC'93", "ifac93_6_3_3", "wang_young", None),
        (
            "marginally stable plant",
            "marginally_stable_6_3_2",
            "wang_young",
            Limits(u=(-1.0, 1.0), du=(-0.2, 0.2)),
        ),
        # half the span and 0.05 a minute, as in the Shell control problem
        (
            "Shell fractionator",
            "shell_5_3_2",
            "wang_young",
            Limits(u=(-0.5, 0.5), du=(-0.2, 0.2)),
        ),
        ("gasifier", "gasifier_6_3_4", "wang_young_printed", None),
    )
    found = []
    for title, name, structure, limits in chosen:
        example = case(name)
        design = example.designs[structure]
        if limits is not None:
            design = dataclasses.replace(design, limits=limits)
        found.append(Loop(title, example.plant, design, example.scenario))
    return found


def noisy(scenario: Scenario, seed: int, spans: np.ndarray) -> Scenario:
    """Scenario with output noise of its own; with seed 0 there is none.

    ``spans`` are the largest deviations of the outputs without it.
    """
    if seed == 0:
        return scenario
    noise = np.random.default_rng(seed).standard_normal(scenario.reference.shape)
    return dataclasses.replace(scenario, noise=NOISE * spans * noise)


class Direct:
    """Solvers that hold the program of a controller and are told what changes."""

    def __init__(self, controller: PredictiveController) -> None:
        self.program = program = controller.program
        rows = len(program.lower)
        self.model = daqp.Model()
        self.held = (  # the model refers to them
            program.H.copy(),
            np.zeros(program.n_z),
            np.ascontiguousarray(program.M),
            program.upper.copy(),
            program.lower.copy(),
            np.zeros(rows, np.int32),
        )
        self.model.setup(*self.held)
        self.proxqp = proxsuite.proxqp.dense.QP(program.n_z, 0, rows)
        self.proxqp.settings.eps_abs, self.proxqp.settings.eps_rel = 1e-9, 0.0
        guess = proxsuite.proxqp.InitialGuess.WARM_START
        self.proxqp.settings.initial_guess = guess
        self.last = np.zeros(program.n_z), np.zeros(rows)
        self.proxqp.init(
            program.H,
            np.zeros(program.n_z),
            None,
            None,
            program.M,
            program.lower,
            program.upper,
        )
        self.G = np.vstack([program.M, -program.M])

    def vectors(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gradient and sides of one sample."""
        program = self.program
        known = program.offset @ theta
        return program.f @ theta, program.lower - known, program.upper - known

    def by_daqp(self, f: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Solve by the persistent model of DAQP."""
        self.model.update(None, f, None, high, low, None)
        return self.model.solve()[0]

    def by_proxqp(self, f: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Solve by ProxQP, warm-started."""
        self.proxqp.update(g=f, l=low, u=high)
        self.proxqp.solve(self.last[0], None, self.last[1])
        results = self.proxqp.results
        self.last = results.x.copy(), results.z.copy()
        return self.last[0]

    def by_qpsolvers(
        self, f: np.ndarray, low: np.ndarray, high: np.ndarray
    ) -> np.ndarray | None:
        """Solve by ``qpsolvers.solve_qp`` with DAQP."""
        sides = np.concatenate([high, -low])
        return qpsolvers.solve_qp(self.program.H, f, self.G, sides, solver="daqp")


Took = tuple[bool, float, float]
"""Whether a limit was active, microseconds of the call, and of what belongs to it: of
forming a solver's vectors, or of working out the plan behind a move."""


def timed(
    loop: Loop,
    controller: PredictiveController,
    scenario: Scenario,
    solver: Callable[..., Any] | None = None,
    direct: Direct | None = None,
) -> Iterator[Took]:
    """Run a loop; time its decisions, or a solver that is asked right after them."""
    decides = controller.decide

    def decide(*parts: Any) -> Move:
        begin = time.perf_counter()
        move = decides(*parts)
        between = time.perf_counter()
        _ = move.decision
        took[:] = between - begin, time.perf_counter() - between
        if solver is not None and direct is not None:
            begin = time.perf_counter()
            vectors = direct.vectors(move.known)
            between = time.perf_counter()
            z = solver(*vectors)
            took[:] = time.perf_counter() - between, between - begin
            if solver == direct.by_daqp:
                check(loop, z, move)
        return move

    took = np.zeros(2)
    vars(controller)["decide"] = decide  # a frozen design takes it no other way
    try:
        for sample in samples(loop.plant, controller, scenario):
            limited = bool(sample.move.status == Status.LIMITED)
            yield limited, 1e6 * took[0], 1e6 * took[1]
    finally:
        del vars(controller)["decide"]


def check(loop: Loop, z: np.ndarray, move: Move) -> None:
    """Compare a decision with DAQP's."""
    if not np.abs(z - move.decision).max() <= SAME * (1.0 + np.abs(z).max()):
        raise SystemExit(f"{loop.title}: decide and DAQP differ by {z - move.decision}")


def run(loop: Loop, seeds: Sequence[int]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Give times of the first loop's decisions, and later of all calls, by their name.

    Each in an array (samples, 3), see ``Took``.  Every loop is run once for each, in
    turns; seeds are those of the noise.
    """
    controller = loop.design.build()
    assert isinstance(controller, PredictiveController)
    direct = Direct(controller)
    first = np.array(list(timed(loop, controller, loop.scenario)))
    y = closed_loop(loop.plant, controller, loop.scenario).y
    spans = np.abs(y - y[0]).max(axis=0)
    calls = {
        "decide": None,
        DAQP: direct.by_daqp,
        PROXQP: direct.by_proxqp,
        QPSOLVERS: direct.by_qpsolvers,
    }
    rows: dict[str, list[Took]] = {name: [] for name in calls}
    for seed in seeds:
        scenario = noisy(loop.scenario, seed, spans)
        for name, solver in calls.items():
            rows[name] += timed(loop, controller, scenario, solver, direct)
    return first, {name: np.array(took) for name, took in rows.items()}


def measure(
    quick: bool = False, say: Callable[[str], None] = print
) -> Iterator[Figure]:
    """Measure all loops."""
    count = QUICK if quick else LOOPS
    for loop in loops():
        say(f"steps: {loop.title}")
        for seeds in ([0] * count, range(1, count + 1)):
            with uncollected():
                first, took = run(loop, seeds)
            yield from figures(loop, first, took, noise=seeds[0] > 0)


def figures(
    loop: Loop, first: np.ndarray, took: dict[str, np.ndarray], noise: bool
) -> Iterator[Figure]:
    """Figures of one loop, samples with and without an active limit apart."""
    direct = min((DAQP, PROXQP), key=lambda name: float(np.median(took[name][:, 1])))
    controller, horizon = loop.design.build(), loop.design.horizon
    size = (
        f"{loop.title}: Np = {horizon.Np}, Nc = {horizon.Nc}, {controller.n_z} "
        f"variables, {controller.n_rows} rows"
    )
    for limited, bound, when in (
        (0.0, 1.0, "no limit active"),
        (1.0, 1.6, "a limit active"),
    ):
        chosen = {name: rows[rows[:, 0] == limited] for name, rows in took.items()}
        ours = chosen["decide"][:, 1]
        if not ours.size:
            continue
        at, name = f"{size}; {ours.size} samples", f"decide, {when}"
        theirs = chosen[direct][:, 1]
        if noise:
            name += ", noise"
            yield compared(PART, name, at, ours, direct, theirs)
            continue
        goal = {"target": f"at most {bound}", "bound": bound}
        yield compared(PART, name, at, ours, direct, theirs, **goal)
        both = chosen[direct][:, 1:].sum(axis=1)
        yield compared(PART, name, at, ours, f"{direct}, its vectors formed", both)
        planned = chosen["decide"][:, 1:].sum(axis=1)
        asked = f"decide and its plan, {when}"
        yield compared(PART, asked, at, planned, f"{direct}, its vectors formed", both)
        theirs = chosen[QPSOLVERS][:, 1]
        yield compared(PART, name, at, ours, QPSOLVERS, theirs)
        tail, half = float(np.percentile(ours, 99)), float(np.median(ours))
        name = f"p99 of decide, {when}"
        numbers = tail, tail, half, half
        yield Figure(PART, name, "us", "its median", *numbers, at, "below 4", 4.0)
    if noise:
        return
    yield compared(
        PART,
        "decide in the first loop of a new controller",
        f"{size}; {len(first)} samples",
        first[:, 1],
        direct,
        took[direct][:, 1],
        note="each set of held rows is met for the first time",
    )


if __name__ == "__main__":
    show(measure)
