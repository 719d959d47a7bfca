"""Time a sample of state-dependent predictive control beside do-mpc.

Run as ``python benchmarks/state_dependent.py``, with the extra ``nmss-lab[bench]`` for
the rows of do-mpc: general nonlinear predictive control, by CasADi and IPOPT.  All
close the same loops in one process, three times in turn; ``decide`` and ``make_step``
are timed, and the times of all samples count.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import dataclasses
import platform
import time
import warnings
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import scipy
from identification import processor

import nmss_lab
from nmss_lab.cases import case
from nmss_lab.design import Design
from nmss_lab.sdp_mpc import SCHEMES, UNSETTLED, Settling

warnings.simplefilter("ignore")  # do-mpc names its optional parts that are missing
try:
    import casadi
    import do_mpc
except ImportError:
    do_mpc = None

REPEATS = 3
FAST = {
    "ipopt.warm_start_init_point": "yes",  # multipliers of the last sample are used
    "ipopt.warm_start_bound_push": 1e-6,
    "ipopt.warm_start_mult_bound_push": 1e-6,
    "ipopt.mu_init": 1e-4,
    "calc_lam_p": False,
}
TIGHT = FAST | {"ipopt.tol": 1e-10, "ipopt.bound_relax_factor": 0.0}
GENERAL = {"do-mpc, default": {}, "do-mpc, fast": FAST, "do-mpc, fast, tight": TIGHT}
"""Options of IPOPT; by default its tolerance is 1e-8 and multipliers start anew."""


class Task(NamedTuple):
    """A loop; f gives the next outputs, from x, u and the last u, to do-mpc."""

    title: str
    design: Design
    reference: np.ndarray
    y0: np.ndarray
    u0: float
    f: Any = None


def reactor(x: Any, u: Any, _: Any) -> list[Any]:
    """Reactor of ``nmss_lab.cases``, written as its balances."""
    rate, h, jacket = 7.2e10 * casadi.exp(-8750.0 / x[1]), 0.05, 5e4 / 23900.0
    c = (x[0] + h) / (1.0 + h * (1.0 + rate))
    heat = 350.0 + 5e4 / 239.0 * rate * c + jacket * u
    return [c, (x[1] + h * heat) / (1.0 + h * (1.0 + jacket))]


def tasks() -> list[Task]:
    """List the loops; as do-mpc predicts, so without the last miss of the model."""
    busy = np.where(np.arange(100) // 20 % 2, 1.0, 2.0)[:, None]
    known, hot = case("product_8_5_2").designs, case("stirred_reactor")
    start, run = (busy, np.ones(1), 0.547), hot.scenario
    bare = dataclasses.replace(hot.designs["newton"], options={"offset_free": False})
    own = np.asarray(run.reference), np.asarray(run.y0), float(np.squeeze(run.u0))
    product = known["newton"], *start, lambda x, u, last: [0.7 * x[0] + last * u]
    return [
        Task("product of two inputs, changes of the input (8.4)", *product),
        Task("stirred reactor, changes of the input (8.4)", bare, *own, reactor),
        Task("product of two inputs, integral (8.3)", known["integral_newton"], *start),
    ]


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
        return move.u[0], seconds, int(move.iterations), int(move.status) in UNSETTLED

    return sample


def theirs(task: Task, options: dict[str, Any]) -> Any:
    """By do-mpc; du is its input, the last u a state: all limits are bounds."""
    design, model = task.design, do_mpc.model.Model("discrete", "SX")
    x = model.set_variable("_x", "x", (len(task.y0), 1))
    last, du = model.set_variable("_x", "last"), model.set_variable("_u", "du")
    r = model.set_variable("_p", "r")  # constant over the horizon: a parameter
    model.set_rhs("x", casadi.vertcat(*task.f(casadi.vertsplit(x), last + du, last)))
    model.set_rhs("last", last + du)
    model.setup()
    mpc = do_mpc.controller.MPC(model)
    mpc.settings.n_horizon, mpc.settings.t_step = design.horizon.Np, 1.0
    mpc.settings.use_terminal_bounds = True  # else the last u of the plan is unlimited
    mpc.settings.store_lagr_multiplier, mpc.settings.store_solver_stats = False, []
    mpc.settings.supress_ipopt_output()
    mpc.settings.nlpsol_opts.update({"ipopt.linear_solver": "mumps"} | options)
    error = np.ravel(design.Q)[-1] * (x[len(task.y0) - 1] - r) ** 2
    mpc.set_objective(lterm=error + design.R * du**2, mterm=error)
    mpc.set_rterm(du=0.0)  # it would weigh changes of du
    mpc.scaling["_x", "x"] = np.abs(task.y0)
    for i, side in enumerate(("lower", "upper")):
        mpc.bounds[side, "_x", "last"] = design.limits.u[i]
        mpc.bounds[side, "_u", "du"] = design.limits.du[i]
    now = mpc.get_p_template(1)
    mpc.set_p_fun(lambda _: now)
    mpc.setup()
    for bound in (mpc.lb_opt_x, mpc.ub_opt_x):
        bound["_u", design.horizon.Nc :] = 0.0
    u = task.u0
    mpc.x0 = np.append(task.y0, u)
    mpc.set_initial_guess()

    def sample(y: np.ndarray, r: np.ndarray) -> Any:
        nonlocal u
        now["_p", 0, "r"] = r[-1]
        begin = time.perf_counter()
        move = mpc.make_step(np.append(y, u))
        seconds, told = time.perf_counter() - begin, mpc.solver_stats
        u += float(move[0, 0])
        return u, seconds, told["iter_count"], not told["success"]

    return sample


def closed(task: Task, sample: Any) -> np.ndarray:
    """Close a loop: rows of what is told, the sample's cost, and how f errs."""
    plant, Q = task.design.model.plant(), np.ravel(task.design.Q)[-1]
    rows, last = [], task.u0
    state = plant.reset(np.array([last]), np.zeros(0), task.y0)
    for r in task.reference:
        y = plant.output(state)
        u, *told = sample(y, r)
        state = plant.step(state, np.array([u]), np.zeros(0))
        cost = Q * (y - r)[-1] ** 2 + task.design.R * (u - last) ** 2
        off = task.f(y, u, last) - plant.output(state) if do_mpc and task.f else 0.0
        rows.append([u, *told, cost, np.abs(off).max()])
        last = u
    return np.array(rows, dtype=float)


def compare(task: Task) -> None:
    """Close one loop by everyone, in turn, and print what they took."""
    beside = do_mpc and task.f
    ways = {scheme: (ours, Settling(scheme)) for scheme in SCHEMES}
    ways["iterated, damping 0"] = ours, Settling("iterated", damping=0.0)
    ways |= {name: (theirs, o) for name, o in GENERAL.items() if beside}
    turns = [*ways.values()] * REPEATS
    loops = np.array([closed(task, make(task, way)) for make, way in turns])
    pooled = np.concatenate(np.split(loops, REPEATS), axis=1)
    u, seconds, passes, unsettled, cost, off = np.moveaxis(pooled, 2, 0)
    table = pd.DataFrame(index=list(ways))
    table["median"], table["p99"] = 1e3 * np.percentile(seconds, [50, 99], axis=1)
    table["passes"], table["unsettled %"] = passes.mean(1), 100.0 * unsettled.mean(1)
    if beside:
        table["cost"] = cost.sum(1) / REPEATS
        for other in ("fast", "default"):
            table[other] = table["median"][f"do-mpc, {other}"] / table["median"]
    horizon, exact = task.design.horizon, {"cost": "{:.7g}".format}
    print(f"\n{task.title}, Np = {horizon.Np}, Nc = {horizon.Nc}")
    print(table.to_string(formatters=exact, float_format="{:.3g}".format))
    if beside:
        # y: next outputs by the equation as written for either
        apart = np.abs(u[list(ways).index("gauss-newton")] - u[-1]).max()
        print(f"gauss-newton and tight do-mpc: u {apart:.0e}, y {off.max():.0e} apart")


def main() -> None:
    """Measure and print."""
    used = [nmss_lab, np, scipy, *([do_mpc, casadi] if do_mpc else [])]
    print(*(f"{part.__name__} {part.__version__}" for part in used), sep=", ", end="; ")
    print(f"Python {platform.python_version()}, {processor()}, one thread")
    print("with do-mpc" if do_mpc else "do-mpc is not installed (nmss-lab[bench])")
    print("ms per sample; fast, default: how many times as long do-mpc takes")
    print("frozen and iterated solve another problem than gauss-newton, newton, do-mpc")
    for task in tasks():
        compare(task)


if __name__ == "__main__":
    main()
