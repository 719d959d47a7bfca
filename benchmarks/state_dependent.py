"""A sample of state-dependent predictive control beside do-mpc.

Run as ``python benchmarks/state_dependent.py``, with the extra ``nmss-lab[bench]``:
do-mpc is general nonlinear predictive control, by CasADi and IPOPT.  All close the same
loops in one process, sample by sample in turns; ``decide`` and ``make_step`` are timed,
and all samples count.  That gauss-newton and do-mpc find the same inputs is checked.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from frame import Figure, compared, show, uncollected
from peers import FAST, ByDoMpc, casadi, do_mpc

from nmss_lab.cases import case
from nmss_lab.controller import Limits
from nmss_lab.design import Design
from nmss_lab.sdp_mpc import SCHEMES, UNSETTLED, Settling

PART = "State-dependent control"
REPEATS = 5
SAME = 1e-6
"""Largest difference of inputs, relative to the largest one."""

TIGHT = FAST | {"ipopt.tol": 1e-10, "ipopt.bound_relax_factor": 0.0}
GENERAL = {"do-mpc, default": {}, "do-mpc, fast": FAST}
"""Options of IPOPT; by default its tolerance is 1e-8 and multipliers start anew."""

OTHER = {
    "frozen": "another problem: the model stays as it is now",
    "iterated": "another problem: how the model moves with the plan is left out",
}
"""Schemes whose plan is not the optimum that the others find."""


class Task(NamedTuple):
    """A loop; f gives the next outputs, from x, u and the last u, to do-mpc."""

    title: str
    design: Design
    reference: np.ndarray
    y0: np.ndarray
    u0: np.ndarray
    f: Callable[..., Any]


def reactor(x: Any, u: Any, _: Any) -> list[Any]:
    """Reactor of ``nmss_lab.cases``, written as its balances."""
    rate, h, jacket = 7.2e10 * casadi.exp(-8750.0 / x[1]), 0.05, 5e4 / 23900.0
    c = (x[0] + h) / (1.0 + h * (1.0 + rate))
    heat = 350.0 + 5e4 / 239.0 * rate * c + jacket * u
    return [c, (x[1] + h * heat) / (1.0 + h * (1.0 + jacket))]


def cone(x: Any, u: Any, _: Any) -> list[Any]:
    """Conical tank of ``nmss_lab.cases``, written as its balance."""
    area = np.pi / 4.0 * x[0] ** 2
    return [x[0] + 5.0 * (u - 60.0 * x[0] ** 0.5) / area]


def tasks() -> list[Task]:
    """List the loops; as do-mpc predicts, so without the last miss of the model."""
    busy = np.where(np.arange(100) // 20 % 2, 1.0, 2.0)[:, None]
    product = case("product_8_5_2").designs["newton"]
    return [
        Task(
            "product of two inputs of 8.5.2",
            product,
            busy,
            np.ones(1),
            np.array([0.547]),
            lambda x, u, last: [0.7 * x[0] + last * u],
        ),
        shipped("stirred_reactor", "stirred reactor", reactor),
        shipped("conical_tank", "conical tank, its level not limited", cone),
    ]


def shipped(name: str, title: str, f: Callable[..., Any]) -> Task:
    """Loop of a case, without limits of outputs: do-mpc prices them otherwise."""
    example = case(name)
    design, run = example.designs["newton"], example.scenario
    design = dataclasses.replace(
        design,
        options={"offset_free": False},
        limits=Limits(u=design.limits.u, du=design.limits.du),
    )
    y0, u0 = (np.atleast_1d(np.asarray(part, float)) for part in (run.y0, run.u0))
    return Task(title, design, run.reference, y0, u0, f)


def ours(task: Task, settling: Settling) -> Any:
    """By the library: a function from y, r to u, seconds, passes, unsettled."""
    options = {**task.design.options, "settling": settling}
    controller = dataclasses.replace(task.design, options=options).build()
    memory = controller.start(task.y0, task.u0, r0=task.reference[0])

    def sample(y: np.ndarray, r: np.ndarray) -> Any:
        nonlocal memory
        memory = controller.measure(memory, y, r)
        begin = time.perf_counter()
        move = controller.decide(memory)
        seconds = time.perf_counter() - begin
        memory = controller.apply(memory, move.u, move)
        return move.u, seconds, int(move.iterations), int(move.status) in UNSETTLED

    return sample


def theirs(task: Task, options: dict[str, Any]) -> Any:
    """By do-mpc, the same."""

    def f(x: Any, du: Any, last: Any) -> Any:
        return casadi.vertcat(*task.f(casadi.vertsplit(x), last + du, last))

    everything, size = np.eye(len(task.y0)), np.abs(task.y0)
    general = ByDoMpc(task.design, f, everything, options, task.y0, task.u0, size)
    last = task.u0

    def sample(y: np.ndarray, r: np.ndarray) -> Any:
        nonlocal last
        found = general(y, last, r)
        last = last + found.du
        return last, found.seconds, found.iterations, found.failed

    return sample


class Row(NamedTuple):
    """A sample of a loop, or arrays of many; ``off`` is how far f is off."""

    u: Any
    seconds: Any
    passes: Any
    unsettled: Any
    cost: Any
    off: Any


def closed(task: Task, sample: Any) -> Iterator[Row]:
    """Close a loop, sample by sample."""
    plant, Q = task.design.model.plant(), np.ravel(task.design.Q)[-1]
    last = task.u0
    state = plant.reset(last, np.zeros(0), task.y0)
    for r in task.reference:
        y = plant.output(state)
        u, *told = sample(y, r)
        state = plant.step(state, u, np.zeros(0))
        cost = Q * (y - r)[-1] ** 2 + task.design.R * ((u - last) ** 2).item()
        following = np.ravel(task.f(y, u.item(), last.item()))
        off = np.abs(following - plant.output(state)).max()
        yield Row(u.item(), *told, cost, off)
        last = u


def compare(task: Task, repeats: int) -> Iterator[Figure]:
    """Close one loop by everyone, in turns, and yield what they took.

    Raises
    ------
    RuntimeError
        See ``check``.
    """
    ways = {scheme: (ours, Settling(scheme)) for scheme in SCHEMES}
    ways |= {name: (theirs, options) for name, options in GENERAL.items()}
    rounds = []
    with uncollected():
        for _ in range(repeats):
            loops = [closed(task, make(task, way)) for make, way in ways.values()]
            rounds.append(list(zip(*loops, strict=True)))
    # by round, sample, way and field
    fields = Row(*np.moveaxis(np.array(rounds, float), 3, 0))
    names, seconds = list(ways), fields.seconds.reshape(-1, len(ways))
    times = dict(zip(names, 1e3 * seconds.T, strict=True))
    passes, unsettled = fields.passes.mean((0, 1)), fields.unsettled.mean((0, 1))
    cost, u = fields.cost[0].sum(axis=0), fields.u[0]
    check(task, u[:, names.index("gauss-newton")])
    horizon = task.design.horizon
    for scheme in SCHEMES:
        i = names.index(scheme)
        for general in GENERAL:
            remark = (
                f"{passes[i]:.1f} passes, {unsettled[i]:.0%} unsettled, cost "
                f"{cost[i]:.6g} beside {cost[names.index(general)]:.6g}"
            )
            yield compared(
                PART,
                f"a sample, {scheme}",
                f"{task.title}: Np = {horizon.Np}, Nc = {horizon.Nc}; "
                f"{len(times[scheme])} samples",
                times[scheme],
                general,
                times[general],
                unit="ms",
                note="; ".join(filter(None, (OTHER.get(scheme), remark))),
            )


def check(task: Task, u: np.ndarray) -> None:
    """Compare the inputs of a loop with those of do-mpc at a tight tolerance."""
    exact = Row(*np.array(list(closed(task, theirs(task, TIGHT))), float).T)
    apart = np.abs(exact.u - u).max() / np.abs(u).max()
    off = exact.off.max() / np.abs(task.y0).max()
    if not (apart <= SAME and off <= SAME):
        raise RuntimeError(
            f"{task.title}: gauss-newton and do-mpc are {apart} apart in u, and the "
            f"plant and its equation {off}"
        )


def measure(
    quick: bool = False, say: Callable[[str], None] = print
) -> Iterator[Figure]:
    """Yield the figures of state-dependent control."""
    if do_mpc is None:
        say("state-dependent control is skipped: no do-mpc here (nmss-lab[bench])")
        return
    for task in tasks():
        say(f"state-dependent control: {task.title}")
        if quick:
            task = task._replace(reference=task.reference[:15])
        yield from compare(task, 1 if quick else REPEATS)


if __name__ == "__main__":
    show(measure)
