"""A move of linear predictive control beside qpmpc and do-mpc, on the same loops.

Run as ``python benchmarks/peers.py``, with the extra ``nmss-lab[bench]``.  The loops
are those of ``steps.py``, each run once for everyone, in turns.  All minimise the same
cost under the same limits, and it is checked at every sample that the first moves
agree.  What is kind to the others: the state is handed to them, their problems are made
before, and the faster of the solvers counts.  qpmpc is used as its documentation does,
and, without a target, with matrices kept and vectors updated, which it allows.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import dataclasses
import itertools
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import qpsolvers
import scipy.linalg
from frame import Figure, compared, show, uncollected
from steps import Loop, Took, loops, timed

from nmss_lab.controller import Status
from nmss_lab.design import Design
from nmss_lab.predictive import PredictiveController
from nmss_lab.qp import weight
from nmss_lab.simulate import samples

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # do-mpc names its optional parts that are missing
    try:
        import casadi
        import do_mpc
    except ImportError:
        casadi = do_mpc = None
    else:
        if hasattr(casadi.GlobalOptions, "setNumpyMode"):
            casadi.GlobalOptions.setNumpyMode(-1)  # as do-mpc expects, unsaid
    try:
        import qpmpc
    except ImportError:
        qpmpc = None

PART = "Peers"
ROUNDS, QUICK = (3, None), (1, 25)
"""Loops of each example, and samples of each (all); the same of a quick run."""

FAINT = 1e-6
"""Scale of the states without a weight: qpmpc weighs all alike, these with 1e-12."""

LEAST = 1e-2
"""Least eigenvalue of R: qpmpc takes positive weights only."""

FAST = {
    "ipopt.warm_start_init_point": "yes",  # multipliers of the last sample are used
    "ipopt.warm_start_bound_push": 1e-6,
    "ipopt.warm_start_mult_bound_push": 1e-6,
    "ipopt.mu_init": 1e-4,
    "calc_lam_p": False,
}
"""Options of IPOPT that make a sample of do-mpc faster than its own do."""

SOLVERS = "daqp", "quadprog"
"""Of qpsolvers, for qpmpc; those that are installed."""

MAKE_STEP = "do-mpc, make_step, warm start"
ANEW, KEPT = "qpmpc.solve_mpc", "qpmpc, matrices kept"


def weighable(loop: Loop) -> Loop:
    """Loop whose R has no eigenvalue below ``LEAST``."""
    R = weight("R", loop.design.R, 1, loop.design.model.n_u)
    sizes, axes = np.linalg.eigh(R)
    if sizes[0] >= LEAST:
        return loop
    R = axes * np.maximum(sizes, LEAST) @ axes.T
    title = f"{loop.title}, R's eigenvalue {sizes[0]:.2g} raised to {LEAST:g}"
    return loop._replace(title=title, design=dataclasses.replace(loop.design, R=R))


class Asked(NamedTuple):
    """What a peer answers: change of the input, seconds, iterations, whether failed."""

    du: np.ndarray
    seconds: float
    iterations: int = 0
    failed: bool = False


class ByQpmpc:
    """The program of a design as qpmpc takes it.

    Its state is ours and the last input, scaled so that the outputs weigh Q and the
    rest next to nothing; its inputs are scaled so that they weigh R.  After the control
    horizon they have no effect, hence are zero, and there are no limits.

    Parameters
    ----------
    design : Design
        One of "wang_young" with weights that do not change along the horizon.
    controller : PredictiveController
        That of the design.
    solver : str
    kept : bool
        Whether the matrices are made once and only vectors anew at every sample.
    """

    def __init__(
        self, design: Design, controller: PredictiveController, solver: str, kept: bool
    ) -> None:
        form, (Np, Nc) = controller.form, (design.horizon.Np, design.horizon.Nc)
        n_y, n_u, rest = form.n_y, form.n_u, form.n_x - form.n_y
        self.root = np.linalg.cholesky(weight("Q", design.Q, 1, n_y)).T
        self.unscale = np.linalg.inv(
            np.linalg.cholesky(weight("R", design.R, 1, n_u)).T
        )
        faint = FAINT * np.eye(rest), FAINT * np.eye(n_u)
        self.scale = scipy.linalg.block_diag(faint[0], self.root, faint[1])
        back = np.linalg.inv(self.scale)
        A = self.scale @ scipy.linalg.block_diag(form.A, np.eye(n_u)) @ back
        B = self.scale @ np.vstack([form.B, np.eye(n_u)]) @ self.unscale
        on_x, on_du, sides = self._limits(design, form.n_x)
        none = np.zeros((0, len(A))), np.zeros((0, n_u)), np.zeros(0)
        free = Np - Nc
        self.problem = qpmpc.MPCProblem(
            A,
            [B] * Nc + [np.zeros_like(B)] * free,
            [on_x @ back] * Nc + [none[0]] * free,
            [on_du @ self.unscale] * Nc + [none[1]] * free,
            [sides] * Nc + [none[2]] * free,
            Np,
            terminal_cost_weight=1.0,
            stage_state_cost_weight=1.0,
            stage_input_cost_weight=1.0,
        )
        self.rest, self.solver = rest, solver
        self._tell(np.zeros(len(A)), np.zeros(len(A) * Np))
        self.qp = qpmpc.MPCQP(self.problem) if kept else None

    @staticmethod
    def _limits(design: Design, n_x: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rows of a step, on [x; last u] and on the change, and their upper sides."""
        n_u = design.model.n_u
        (low, high), (slow, fast) = (design.limits.of(n, n_u) for n in ("u", "du"))
        sides = np.concatenate([high, -low, fast, -slow])
        eye, no = np.eye(n_u), np.zeros((n_u, n_u))
        on_u, finite = np.vstack([eye, -eye, no, no]), np.isfinite(sides)
        on_x = np.hstack([np.zeros((4 * n_u, n_x)), on_u])
        on_du = np.vstack([eye, -eye, eye, -eye])
        return on_x[finite], on_du[finite], sides[finite]

    def __call__(self, x: np.ndarray, last: np.ndarray, r: np.ndarray) -> Asked:
        """Answer for a state, the last input and a reference."""
        state = self.scale @ np.concatenate([x, last])
        goal = np.zeros(len(state))
        goal[self.rest : len(x)] = self.root @ r
        targets = np.tile(goal, self.problem.nb_timesteps)
        begin = time.perf_counter()
        self._tell(state, targets)
        plan = self._solve()
        seconds = time.perf_counter() - begin
        if plan.is_empty:
            return Asked(np.full(len(last), np.nan), seconds, failed=True)
        return Asked(self.unscale @ plan.first_input, seconds)

    def _tell(self, state: np.ndarray, targets: np.ndarray) -> None:
        """Tell a state and where it shall be at every step, at the end as before."""
        self.problem.update_initial_state(state)
        self.problem.update_goal_state(targets[-len(state) :])
        self.problem.update_target_states(targets)

    def _solve(self) -> Any:
        if self.qp is None:
            return qpmpc.solve_mpc(self.problem, self.solver)
        self.qp.update_cost_vector(self.problem)
        self.qp.update_constraint_vector(self.problem)
        solution = qpsolvers.solve_problem(self.qp.problem, self.solver)
        return qpmpc.Plan(self.problem, solution)


class ByDoMpc:
    """The program of a design by do-mpc.

    Changes of the input are its inputs, the last input a state: all limits are bounds.
    After the control horizon the bounds are zero.

    Parameters
    ----------
    design : Design
        One on changes of the input.
    f : callable
        Next state from the state, the change of the input and the last input.
    C : array (n_y, n_x)
        Outputs of a state.
    options : mapping
        Of IPOPT.
    x0, u0 : arrays (n_x,), (n_u,)
        Where the first guess is.
    scale : array (n_x,), optional
        Size of the states.
    """

    def __init__(
        self,
        design: Design,
        f: Callable[[Any, Any, Any], Any],
        C: np.ndarray,
        options: dict[str, Any],
        x0: np.ndarray,
        u0: np.ndarray,
        scale: np.ndarray | None = None,
    ) -> None:
        n_u, horizon = design.model.n_u, design.horizon
        model = do_mpc.model.Model("discrete", "SX")
        x = model.set_variable("_x", "x", (len(x0), 1))
        last = model.set_variable("_x", "last", (n_u, 1))
        du = model.set_variable("_u", "du", (n_u, 1))
        # constant over the horizon: a parameter
        r = model.set_variable("_p", "r", (len(C), 1))
        model.set_rhs("x", f(x, du, last))
        model.set_rhs("last", last + du)
        model.setup()
        mpc = do_mpc.controller.MPC(model)
        mpc.settings.n_horizon, mpc.settings.t_step = horizon.Np, 1.0
        # else the last u of the plan is unlimited
        mpc.settings.use_terminal_bounds = True
        mpc.settings.store_lagr_multiplier = False
        mpc.settings.store_solver_stats = []
        mpc.settings.supress_ipopt_output()
        mpc.settings.nlpsol_opts.update({"ipopt.linear_solver": "mumps"} | options)
        Q, R = weight("Q", design.Q, 1, len(C)), weight("R", design.R, 1, n_u)
        error = casadi.bilin(casadi.DM(Q), casadi.DM(C) @ x - r)
        moved = casadi.bilin(casadi.DM(R), du)
        mpc.set_objective(lterm=error + moved, mterm=error)
        mpc.set_rterm(du=0.0)  # it would weigh changes of du
        if scale is not None:
            mpc.scaling["_x", "x"] = scale
        for i, side in enumerate(("lower", "upper")):
            mpc.bounds[side, "_x", "last"] = design.limits.of("u", n_u)[i]
            mpc.bounds[side, "_u", "du"] = design.limits.of("du", n_u)[i]
        self.now = mpc.get_p_template(1)
        mpc.set_p_fun(lambda _: self.now)
        mpc.setup()
        for bound in (mpc.lb_opt_x, mpc.ub_opt_x):
            bound["_u", horizon.Nc :] = 0.0
        mpc.x0 = np.concatenate([x0, u0])
        mpc.set_initial_guess()
        self.mpc = mpc

    def __call__(self, x: np.ndarray, last: np.ndarray, r: np.ndarray) -> Asked:
        """Answer for a state, the last input and a reference."""
        self.now["_p", 0, "r"] = r
        state = np.concatenate([x, last])
        begin = time.perf_counter()
        move = self.mpc.make_step(state)
        seconds = time.perf_counter() - begin
        told = self.mpc.solver_stats
        return Asked(move[:, 0], seconds, told["iter_count"], not told["success"])


def qpmpcs(design: Design, controller: PredictiveController) -> dict[str, ByQpmpc]:
    """Ways to use qpmpc, by what they are called."""
    solvers = [name for name in SOLVERS if name in qpsolvers.available_solvers]
    return {
        f"{way}, {solver}": ByQpmpc(design, controller, solver, way == KEPT)
        for solver in solvers
        for way in (ANEW, KEPT)
    }


def do_mpcs(design: Design, controller: PredictiveController) -> dict[str, ByDoMpc]:
    """Build do-mpc on the form of a design."""
    form = controller.form
    A, B = casadi.DM(form.A), casadi.DM(form.B)
    at_rest = np.zeros(form.n_x), np.zeros(form.n_u)
    made = ByDoMpc(design, lambda x, du, _: A @ x + B @ du, form.C, FAST, *at_rest)
    return {MAKE_STEP: made}


class Peer(NamedTuple):
    """A library, if installed, how to use it, and what is expected beside each way."""

    name: str
    module: Any
    ways: Callable[[Design, PredictiveController], dict[str, Any]]
    targets: dict[str, tuple[str, float] | None]
    same: float


PEERS = (
    Peer(
        "qpmpc",
        qpmpc,
        qpmpcs,
        {ANEW: ("at least 8 times faster", 1 / 8), KEPT: None},
        1e-5,  # active-set methods keep limits to 1e-6
    ),
    Peer(
        "do-mpc",
        do_mpc,
        do_mpcs,
        {MAKE_STEP: ("at least 100 times faster", 0.01)},
        # where a limit is hardly active an interior-point method is off by the square
        # root of its complementarity, 1e-8, over the curvature, 1e-2 along the least R
        1e-3,
    ),
)
"""``same`` is the difference of first moves, relative to 1 + their size."""


def asked(
    loop: Loop, controller: PredictiveController, name: str, way: Any, same: float
) -> Iterator[Took]:
    """Run a loop in which a peer is asked at every sample; see ``Took``.

    Raises
    ------
    RuntimeError
        If a first move is not ours.
    """
    layout = controller.knowledge.layout
    for sample in samples(loop.plant, controller, loop.scenario):
        move = sample.move
        x, last, aim = (move.known[layout[part]].copy() for part in ("x", "u", "r"))
        du, answer = move.u - last, way(x, last, aim)
        apart = np.abs(answer.du - du).max() / (1.0 + np.abs(du).max())
        if not apart <= same:
            raise RuntimeError(
                f"{loop.title}, sample {sample.k}: {name} moves {answer.du}, not {du}"
            )
        yield bool(move.status == Status.LIMITED), 1e6 * answer.seconds, 0.0


def figures(loop: Loop, peer: Peer, rounds: int, steps: int | None) -> Iterator[Figure]:
    """Yield figures of a loop: samples without and with active limit."""
    controller = loop.design.build()
    assert isinstance(controller, PredictiveController)
    ways = peer.ways(loop.design, controller)
    took: dict[str, list[Took]] = {name: [] for name in ("ours", *ways)}
    with uncollected():
        list(timed(loop, controller, loop.scenario))  # it has run the loop before
        for _ in range(rounds):
            took["ours"] += itertools.islice(
                timed(loop, controller, loop.scenario), steps
            )
            for name, way in ways.items():
                answers = asked(loop, controller, name, way, peer.same)
                took[name] += itertools.islice(answers, steps)
    horizon = loop.design.horizon
    size = f"{loop.title}: Np = {horizon.Np}, Nc = {horizon.Nc}"
    for limited, what in ((False, "no limit active"), (True, "a limit active")):
        times = {
            name: [us for active, us, _ in rows if active == limited]
            for name, rows in took.items()
        }
        for way, target in peer.targets.items() if times["ours"] else ():
            best = min(
                (n for n in ways if n.startswith(way)),
                key=lambda n: np.median(times[n]),
            )
            goal = {} if target is None else {"target": target[0], "bound": target[1]}
            at = f"{size}; {len(times['ours'])} samples"
            name = f"a move, {what}"
            yield compared(PART, name, at, times["ours"], best, times[best], **goal)


def measure(
    quick: bool = False, say: Callable[[str], None] = print
) -> Iterator[Figure]:
    """Yield the figures of linear predictive control."""
    for peer in PEERS:
        if peer.module is None:
            say(f"{peer.name} is skipped: it is not installed (nmss-lab[bench])")
            continue
        for loop in loops():
            say(f"{peer.name}: {loop.title}")
            yield from figures(weighable(loop), peer, *(QUICK if quick else ROUNDS))


if __name__ == "__main__":
    show(measure)
