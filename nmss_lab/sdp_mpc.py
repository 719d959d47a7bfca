r"""Predictive control of state-dependent plants (thesis 8.3, 8.4), and beyond.

The quadratic program is that of the linear structures, with coefficients that change
along the horizon.  They depend on the plan, so program and plan have to be brought to
agree (Algorithm 8.3.1): predict under the plan, read the coefficients along the way,
solve, and repeat until the plan stops moving.  Which coefficients are read is the
scheme:

- ``"frozen"``: those of the present sample, all along; solved once.
- ``"iterated"``: those along the predicted trajectory.  A fixed point is optimal for
  coefficients that the plan does not move, in general not for the plant.
- ``"gauss-newton"``: the derivatives of the equation along the trajectory, and what
  is left over as a known offset.  The gradient is that of the true problem, so a fixed
  point meets its optimality conditions.
- ``"newton"``: the same with the curvature of the equation in the Hessian.
"""

from __future__ import annotations

import dataclasses
import itertools
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.linalg

from nmss_lab.controller import Limits, Memory, Move, Status, as_ensemble
from nmss_lab.models import Array
from nmss_lab.mpc import Reading, Setup, Terminal
from nmss_lab.nmss import Form, Layout, integral_of_error_form, past_form
from nmss_lab.pip import check_signs
from nmss_lab.predict import Horizon, known_part
from nmss_lab.predictive import Knowledge, PredictiveController, RankedProgram
from nmss_lab.qp import QPStatus, QuadraticProgram, Solution, find_backend, weight
from nmss_lab.sdp import (
    NOT_LINEAR,
    check_equation,
    expected,
    follow,
    missed_by,
    thesis_state,
)
from nmss_lab.sdp_problem import SCHEMES, Point, Problem, Scheme
from nmss_lab.state_dependent import StateDependentModel

LOG = logging.getLogger(__name__)

RUNAWAY = 1e8
"""Predicted outputs this many times beyond what is known count as running away."""


@dataclass(frozen=True)
class Settling:
    """How plan and predictions are brought to agree.

    Parameters
    ----------
    scheme : "frozen", "iterated", "gauss-newton" or "newton"
    damping : float
        Share of each step that is left out, for the scheme "iterated": 0 is the plain
        Algorithm 8.3.1.  The other schemes halve a step that does not lower the cost.
    tolerance : float
        Largest change of the plan that counts as settled, relative to 1 + its size.
    passes : int
        Most programs solved in a sample.
    seconds : float
        Time a sample may take.
    warm_start : bool
        Whether to start from the last plan, shifted; otherwise from the frozen model.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    scheme: Scheme = "iterated"
    damping: float = 0.5
    tolerance: float = 1e-8
    passes: int = 100
    seconds: float = np.inf
    warm_start: bool = True

    def __post_init__(self) -> None:
        """Check each value."""
        if self.scheme not in SCHEMES:
            raise ValueError(
                f'scheme = "{self.scheme}": expected one of {", ".join(SCHEMES)}'
            )
        for name in ("damping", "tolerance", "seconds"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(
                value, int | float | np.number
            ):
                raise ValueError(f"{name} = {value!r}: expected a number")
        if not 0.0 <= self.damping < 1.0:
            raise ValueError(f"damping = {self.damping}: expected 0 <= damping < 1")
        if not self.tolerance > 0.0:
            raise ValueError(f"tolerance = {self.tolerance} must be positive")
        whole = isinstance(self.passes, int | np.integer)
        if isinstance(self.passes, bool) or not whole or not self.passes >= 1:
            raise ValueError(
                f"passes = {self.passes!r}: expected a whole number, at least 1"
            )
        if not self.seconds > 0.0:
            raise ValueError(f"seconds = {self.seconds} must be positive")


@dataclass(frozen=True, eq=False)
class Pass:
    """One pass of Algorithm 8.3.1: a plan, and the optimum of the program made there.

    Parameters
    ----------
    point : Point
    solution : Solution
    status : Status
        FREE, LIMITED, or how rows gave way.
    change : float
        Largest entry of the way from the plan to the optimum.
    """

    point: Point
    solution: Solution
    status: Status
    change: float


@dataclass(frozen=True, eq=False)
class StateDependentController(PredictiveController):
    """Predictive controller of a state-dependent plant.

    Build it with ``sdp_integral_of_error`` or ``sdp_increments``.  Its ``model`` gives
    sizes and names only.

    Parameters
    ----------
    equation : StateDependentModel
    settling : Settling
    problem : Problem
    offset_free : bool
        Whether what the equation misses at this sample is expected to stay.
    """

    equation: StateDependentModel = field(kw_only=True)
    settling: Settling = field(kw_only=True)
    problem: Problem = field(kw_only=True)
    offset_free: bool = field(kw_only=True, default=True)

    @property
    def follows_laws(self) -> bool:
        """Never: the program is another at each sample."""
        return False

    def free_law(self) -> tuple[Array, Array]:
        """Refuse: the law of a state-dependent plant is not linear."""
        raise ValueError(NOT_LINEAR)

    # The known vector: that of the program, then the plan and what is told of it.

    @property
    def _plan_layout(self) -> Layout:
        return self.knowledge.layout

    def _base(self, memory: Memory, r: Array, v: Array) -> Array:
        """Known vectors (loops, n_theta) of the programs, offsets not yet along."""
        known = self._known(memory.vector, r, v)
        layout = self._plan_layout
        known[:, layout["one"]] = 1.0
        if self.offset_free:
            load = missed_by(self.equation, self.form.recipe.layout, memory.vector)
            known[:, layout["c"]] = np.tile(load, self.horizon.Np)
        return known

    def _expected(self, vector: Array) -> Array:
        return expected(self.equation, self.form.recipe.layout, vector)

    # Algorithm 8.3.1

    def passes(
        self, theta: Array, start: Point, settling: Settling | None = None
    ) -> Iterator[Pass]:
        """Pass after pass of Algorithm 8.3.1, without end.

        Parameters
        ----------
        theta : array (n_theta,)
            Known vector of the sample's program.
        start : Point
        settling : Settling, optional
            In place of the design's own.
        """
        settling = settling or self.settling
        before = theta[self.problem.known["u"]]
        point, guess = start, None
        while True:
            solution, status = self._optimum(point, before, guess)
            change = float(np.abs(solution.decision - point.z).max())
            each = Pass(point, solution, status, change)
            yield each
            guess = solution.decision, solution.multipliers
            point = self._following(each, theta, settling)

    def _optimum(
        self, point: Point, before: Array, guess: tuple[Array, Array] | None
    ) -> tuple[Solution, Status]:
        """Optimum of the program of a point, limits looked at first."""
        program, theta = point.program, point.theta
        nothing = np.zeros(program.n_z), np.zeros(self.n_rows)
        if not np.isfinite(point.cost):
            told = "the predictions run away before any program can be made"
            return Solution(*nothing, QPStatus.FAILED, message=told), Status.HELD
        try:
            z = _free_optimum(program, theta)
        except (np.linalg.LinAlgError, ValueError) as error:
            return Solution(*nothing, QPStatus.FAILED, message=str(error)), Status.HELD
        if (program.room(z, theta) >= -program.slack).all():
            solution = Solution(z, np.zeros(self.n_rows), QPStatus.SOLVED)
            return solution, Status.FREE
        ranked = RankedProgram(program, self.ranks, self.limits, self.backend)
        low, high = self._reachable(before)
        open_ = np.isinf(program.lower) & np.isinf(program.upper)
        bounds = np.where(open_, -np.inf, low), np.where(open_, np.inf, high)
        return ranked.solve(theta, bounds, guess)

    def _following(self, each: Pass, theta: Array, settling: Settling) -> Point:
        """Point of the next pass: a full, damped or halved step to the optimum."""
        point, solution, scheme = each.point, each.solution, settling.scheme
        step = solution.decision - point.z
        if point.frozen or not np.isfinite(point.cost):
            return self.problem.at(solution.decision, theta, scheme)
        share = 1.0 - settling.damping if scheme == "iterated" else 1.0
        price = 4.0 * np.abs(solution.multipliers[self.problem.on_outputs]).max(
            initial=0.0
        )
        most = self._most(each, price, scheme)
        trials = []
        for _ in range(12):
            z = point.z + share * step
            trials.append(self.problem.at(z, theta, scheme, solution.multipliers))
            if self.problem.merit(trials[-1], price) <= most:
                return trials[-1]
            share /= 2.0
        # nothing near is better: the rows bend, or the program does not fit; go on
        finite = [trial for trial in trials if np.isfinite(trial.cost)]
        return finite[0] if finite else trials[-1]

    def _most(self, each: Pass, price: float, scheme: Scheme) -> float:
        """Largest merit that the next point may have."""
        point, merit = each.point, self.problem.merit(each.point, price)
        by_rank = each.status is Status.SOFTENED and self.limits.outputs != "soft"
        if scheme == "iterated" or by_rank:
            return np.finfo(float).max  # anything that has not run away
        slope = point.program.H @ point.z + point.program.f @ point.theta
        step = each.solution.decision - point.z
        room = 1e-12 * (1.0 + abs(merit))
        if not point.broken.any() and abs(slope @ step) <= 10.0 * room:
            return np.finfo(float).max  # a decrease within rounding cannot be seen
        return merit + room

    def start_of(
        self, theta: Array, plan: Array | None, settling: Settling | None = None
    ) -> Point:
        """Where the passes of a sample begin.

        Parameters
        ----------
        theta : array (n_theta,)
        plan : array (Np, n_u), optional
            Inputs from this sample on; without them the frozen model's optimum is the
            first plan.
        """
        scheme = (settling or self.settling).scheme
        if plan is not None and scheme != "frozen":
            z = self.problem.from_inputs(self.kept_within(plan, theta), theta)
            point = self.problem.at(z, theta, scheme)
            if np.isfinite(point.cost):
                return point
        rest = np.tile(theta[self.problem.known["u"]], (self.horizon.Np, 1))
        z = self.problem.from_inputs(rest, theta)
        return self.problem.at(z, theta, "frozen")

    def kept_within(self, plan: Array, theta: Array) -> Array:
        """Plan (Np, n_u) clipped to the limits on inputs and rates, step by step."""
        before, kept = theta[self.problem.known["u"]], plan.copy()
        for i in range(len(plan)):
            kept[i] = before = self.clip(plan[i], before)
        return kept

    def runaway(self, theta: Array) -> float:
        """Size of predicted outputs from which on passes count as running away."""
        known = np.abs(theta[self.problem.known["x"]]).max(initial=0.0)
        return RUNAWAY * (1.0 + float(known))

    def _settle(self, theta: Array, plan: Array | None) -> Outcome:
        """Run passes until the plan stops moving, or something else ends them."""
        began, settling = time.perf_counter(), self.settling
        trace = Trace(settling, self.problem)
        runaway = self.runaway(theta)
        for each in self.passes(theta, self.start_of(theta, plan)):
            trace.take(each)
            verdict = trace.verdict(runaway, time.perf_counter() - began)
            if verdict is None:
                continue
            if verdict in (Status.UNSETTLED, Status.OUT_OF_TIME):
                trace.consider(self._following(each, theta, settling))
            return Outcome(verdict, each, trace.best, len(trace.changes), trace.ratio)
        raise AssertionError("passes have no end")

    def _decide(self, memory: Memory, r: Array, v: Array) -> Move:
        known = self._base(memory, r, v)
        move = self._move(np.zeros((len(known), self.model.n_u)), r, known=known)
        for i in range(len(known)):
            self._decide_one(move, memory, i)
        return self._clipped(move, memory)

    def _decide_one(self, move: Move, memory: Memory, i: int) -> None:
        theta = move.known[i, : self.problem.known.size]
        outcome = self._settle(theta, self._last_plan(memory, i))
        move.iterations[i] = outcome.passes
        if outcome.plan is None:
            LOG.warning("%s", outcome.last.solution.message or outcome.status.sentence)
            self._fall_back(move, memory, i)
            return
        point, z = outcome.plan
        settled = outcome.status not in UNSETTLED
        Y = point.Y.value(z, point.theta) if settled else point.y.ravel()
        layout, known = self._plan_layout, move.known[i]
        # no nan among what is known: plans are read from it by products
        known[layout["contraction"]] = np.nan_to_num(outcome.ratio)
        known[layout["change"]] = outcome.last.change
        self._keep_law(known, point)
        self._plan(move, i, z, Y, self._told(outcome, z, theta))
        move.cost[i] = point.cost
        if settled:
            move.multipliers[i] = outcome.last.solution.multipliers
            if self.settling.scheme != "newton":  # its Hessian is not that of J
                move.cost[i] = point.program.cost(z, point.theta)
        if move.status[i] == Status.GUARDED:
            self._hold(move, i, Status.GUARDED)

    def _plan(self, move: Move, i: int, z: Array, Y: Array, status: Status) -> None:
        """Note a plan and its predictions in row i of a move."""
        layout, known = self._plan_layout, move.known[i]
        theta = known[: self.problem.known.size]
        U = self.problem.U.value(z, theta)
        known[layout["plan_u"]] = U
        known[layout["plan_du"]] = self.problem.dU.value(z, theta)
        known[layout["plan_y"]] = np.nan_to_num(Y, posinf=0.0, neginf=0.0)
        move.decision[i], move.u[i], move.status[i] = z, U[: self.model.n_u], status

    def _fall_back(self, move: Move, memory: Memory, i: int) -> None:
        """Continue the last plan, or hold the input where there is none.

        A plan that knows no reference (reading "zero") leads away from it: better hold.
        """
        theta = move.known[i, : self.problem.known.size]
        plan = self._shifted_plan(memory, i)
        if plan is None or self.knowledge.layout.shapes["r"][0] == 0:
            self._hold(move, i, Status.HELD)
            move.shift[i] = -1
            return
        z = self.problem.from_inputs(self.kept_within(plan, theta), theta)
        self._carry_out(move, i, z, Status.SHIFTED)

    def _hold(self, move: Move, i: int, status: Status) -> None:
        theta = move.known[i, : self.problem.known.size]
        rest = np.tile(theta[self.problem.known["u"]], (self.horizon.Np, 1))
        self._carry_out(move, i, self.problem.from_inputs(rest, theta), status)

    def _carry_out(self, move: Move, i: int, z: Array, status: Status) -> None:
        """Note a plan that no program was solved for, with its true cost."""
        theta = move.known[i, : self.problem.known.size]
        point = self.problem.at(z, theta, "gauss-newton")
        self._plan(move, i, z, point.y.ravel(), status)
        move.cost[i] = np.nan_to_num(point.cost, posinf=0.0)

    def _told(self, outcome: Outcome, z: Array, theta: Array) -> Status:
        """Status of a plan, and whether one of the opposite sign would do as well."""
        if outcome.status in UNSETTLED:
            return outcome.status
        point, _ = outcome.plan  # type: ignore[misc]
        if not np.abs(point.Y.gain).max() > 1e-9:
            return Status.GUARDED
        if self.settling.scheme != "frozen" and self._mirrored(point, z, theta):
            return Status.AMBIGUOUS
        return outcome.status

    def _mirrored(self, point: Point, z: Array, theta: Array) -> bool:
        """Whether inputs of the opposite sign are allowed and do exactly the same."""
        U = self.problem.U.value(z, theta).reshape(self.horizon.Np, -1)
        size, before = np.abs(U).max(), theta[self.problem.known["u"]]
        if not size > 1e-9 * (1.0 + np.abs(before).max()):
            return False
        if not np.abs(self.clip(-U[0], before) + U[0]).max() <= 1e-9 * size:
            return False
        if not np.abs(self.kept_within(-U, theta) + U).max() <= 1e-9 * size:
            return False
        other = self.problem.from_inputs(-U, theta)
        twin = self.problem.at(other, theta, self.settling.scheme)
        moved = np.abs(point.Y.gain @ z).max()
        apart = np.abs(twin.y - point.y).max()
        alike = abs(twin.cost - point.cost) <= 1e-7 * abs(point.cost)
        return bool(alike and apart <= 1e-6 * moved)

    def _last_plan(self, memory: Memory, i: int) -> Array | None:
        """Give the plan that passes begin with, if they begin with the last one."""
        return self._shifted_plan(memory, i) if self.settling.warm_start else None

    def _shifted_plan(self, memory: Memory, i: int) -> Array | None:
        """Shift the inputs of the last plan to this sample, its last value repeated."""
        last, Np = memory.last, self.horizon.Np
        if last.shift[i] < 0:
            return None
        plan = last.known[i, self._plan_layout["plan_u"]].reshape(Np, -1)
        return plan[np.minimum(np.arange(Np) + 1 + last.shift[i], Np - 1)]

    def _clipped(self, move: Move, memory: Memory) -> Move:
        clipped = self.clip(move.u, self.last_input(memory.vector))
        cut = np.abs(clipped - move.u).max(axis=-1) > 1e-6
        move.status[cut & (move.status < Status.CLIPPED)] = Status.CLIPPED
        move.u[:] = clipped
        return move

    # The sum of the error follows the applied input by the law of the last program.

    def _keep_law(self, known: Array, point: Point) -> None:
        layout = self._plan_layout
        if "law" not in layout or not np.isfinite(point.cost):
            return
        program, n_u, p = point.program, self.model.n_u, self.model.n_y
        x = self.problem.known["x"]
        if "terminal" in program.rows:
            gain = program.free[:n_u]
            free, on_sum = gain @ point.theta, gain[:, x.stop - p : x.stop]
        else:
            right = [program.f @ point.theta, program.f[:, x.stop - p : x.stop]]
            law = -np.linalg.solve(program.H, np.column_stack(right))[:n_u]
            free, on_sum = law[:, 0], law[:, 1:]
        known[layout["free_u"]], known[layout["law"]] = free, on_sum.ravel()

    def _followed(self, memory: Memory, u: Array, move: Move) -> Array:
        layout = self._plan_layout
        if not self.anti_windup:
            return memory.vector
        free = layout.read(move.known, "free_u")
        missed = np.where(self._overruled(u, free, move), u - free, 0.0)
        law = layout.read(move.known, "law")
        return follow(self.form.recipe.layout, memory.vector, missed, law)

    def _balanced(self, vector: Array, y: Array, u: Array) -> Array:
        layout, r = self._plan_layout, np.tile(y, (1, 1 + self.preview, 1))
        for _ in range(30):
            memory = as_ensemble(self._fresh(vector))
            move = self._decide(memory, r, np.zeros((1, 1, 0)))
            missed = u - layout.read(move.known[0], "free_u")
            if np.abs(missed).max() < 1e-10 * (1.0 + np.abs(u).max()):
                break
            law = layout.read(move.known[0], "law")
            vector = follow(self.form.recipe.layout, vector, missed, law)
        return vector


UNSETTLED = (Status.UNSETTLED, Status.OUT_OF_TIME, Status.CYCLED, Status.DIVERGED)
"""Ways in which passes end without a plan that agrees with its predictions."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """How the passes of a sample ended.

    Parameters
    ----------
    status : Status
    last : Pass
    best : Point, optional
        The best plan that was met on the way.
    passes : int
    ratio : float
        Contraction estimate: by which factor a pass makes the change smaller.
    """

    status: Status
    last: Pass
    best: Point | None
    passes: int
    ratio: float

    @property
    def plan(self) -> tuple[Point, Array] | None:
        """Point and decision to apply; None when no plan was found."""
        if self.status not in UNSETTLED:
            found = self.last.solution.found
            return (self.last.point, self.last.solution.decision) if found else None
        return None if self.best is None else (self.best, self.best.z)


class Trace:
    """What the passes of a sample have shown so far."""

    def __init__(self, settling: Settling, problem: Problem) -> None:
        self.settling, self.problem = settling, problem
        self.changes: list[float] = []
        self.plans: list[Array] = []
        self.best: Point | None = None
        self.last: Pass | None = None

    def take(self, each: Pass) -> None:
        """Note a pass."""
        self.last = each
        self.changes.append(each.change)
        self.plans.append(each.point.z)
        if not each.point.frozen:
            self.consider(each.point)

    def consider(self, point: Point) -> None:
        """Keep the better of two plans: the lower cost among the least broken."""
        if not np.isfinite(point.cost):
            return
        standing = self.problem.standing
        if self.best is None or standing(point) < standing(self.best):
            self.best = point

    @property
    def ratio(self) -> float:
        """Geometric mean of the last ratios of changes; nan before there are two."""
        changes = [c for c in self.changes[-6:] if c > 0.0]
        if len(changes) < 2:
            return np.nan
        return float((changes[-1] / changes[0]) ** (1.0 / (len(changes) - 1)))

    def verdict(self, runaway: float, seconds: float) -> Status | None:
        """Status if the passes should end here, None to go on."""
        each = self.last
        assert each is not None
        point, settling = each.point, self.settling
        if not each.solution.found:
            away = self.best is not None and not np.isfinite(point.cost)
            return Status.DIVERGED if away else Status.HELD
        if settling.scheme == "frozen":
            return each.status
        small = settling.tolerance * (1.0 + np.abs(each.solution.decision).max())
        if each.change <= small and not point.frozen:
            return each.status
        if not point.frozen and not np.abs(point.y).max() < runaway:
            return Status.DIVERGED
        if self._swings():
            return Status.CYCLED
        if len(self.changes) >= settling.passes:
            return Status.UNSETTLED
        return Status.OUT_OF_TIME if seconds > settling.seconds else None

    def _swings(self) -> bool:
        """Whether the last plans are two in turn, pass after pass."""
        if len(self.plans) < 8:
            return False
        last = self.plans[-6:]
        near = max(np.abs(b - a).max() for a, b in zip(last, last[2:], strict=False))
        far = min(np.abs(b - a).max() for a, b in itertools.pairwise(last))
        return bool(near < 1e-4 * far)


def _free_optimum(program: QuadraticProgram, theta: Array) -> Array:
    """Optimum of a program without limits, a terminal equality kept."""
    if "terminal" in program.rows:
        return program.free @ theta
    _, z, wrong = scipy.linalg.lapack.dposv(program.H, -program.f @ theta)
    if wrong:
        raise np.linalg.LinAlgError("the Hessian is not positive definite")
    optimum: Array = z
    return optimum


def sdp_integral_of_error(
    model: StateDependentModel,
    horizon: Horizon,
    Q: Any,
    R: Any,
    limits: Limits | None = None,
    reference: Reading = "held",
    settling: Settling | None = None,
    terminal: Terminal = "none",
    backend: str = "daqp",
    anti_windup: bool = True,
) -> StateDependentController:
    r"""Predictive control with an integral of the error, plant (8.1), thesis 8.3.

    .. math:: J = X' \bar Q X + U' \bar R U

    as in ``integral_of_error``, which it is when the coefficients are constant.

    Parameters
    ----------
    model : StateDependentModel
    horizon, limits, reference, backend : see ``integral_of_error``
    Q : weight of the state [y_k ... y_{k-na+1}; u_{k-1} ... u_{k-nb+1}; sum of error]
    R : weight of the inputs
        Both in the ways of ``integral_of_error``; Q without negative eigenvalues, R
        with positive ones, since the program is made anew at each pass.
    settling : Settling, optional
        Scheme, damping, tolerance and bounds; iterated with damping 0.5 by default.
    terminal : "none" or "equality"
    anti_windup : bool
        While a level limit holds the input, set the sum of the error to what the law
        of the last program needs for that input.

    Raises
    ------
    ValueError
        If a weight or limit has a wrong shape or sign, or an argument is unknown.
    """
    check_equation(model)
    form = integral_of_error_form(model.wide)
    kept = thesis_state(model, form.n_x)
    weight_x = weight("Q", Q, horizon.Np, len(kept))
    weight_u = weight("R", R, horizon.Nc, model.n_u)
    check_signs(weight_x, weight_u)
    spread = np.kron(np.eye(horizon.Np), np.eye(form.n_x)[kept])
    weight_x = spread.T @ weight_x @ spread
    parts = model, form, horizon, reference, weight_x, weight_u
    built = _build(*parts, limits, settling, terminal, backend, False, False)
    return dataclasses.replace(built, anti_windup=anti_windup)


def sdp_increments(
    model: StateDependentModel,
    horizon: Horizon,
    Q: Any,
    R: Any,
    limits: Limits | None = None,
    reference: Reading = "held",
    settling: Settling | None = None,
    terminal: Terminal = "none",
    backend: str = "daqp",
    offset_free: bool = True,
) -> StateDependentController:
    r"""Predictive control by changes of the input, plant (8.1), thesis 8.4.

    .. math:: J = (Y - S)' \bar Q (Y - S) + \Delta U' \bar R \Delta U

    Parameters
    ----------
    Q, R : weights of outputs and of moves, in the ways of ``wang_young``
        Q without negative eigenvalues, R with positive ones.
    offset_free : bool
        Whether the difference between y_k and what the equation gives for it is
        expected to stay, which removes the offset after constant disturbances and, with
        constant coefficients, makes it ``wang_young``.  The thesis predicts without.
    model, horizon, limits, reference, settling, terminal, backend :
        See ``sdp_integral_of_error``.

    Raises
    ------
    ValueError
        As ``sdp_integral_of_error``.
    """
    if reference == "zero":
        raise ValueError(
            'reference = "zero" leaves nothing to follow: use "held", "next" or '
            '"preview"'
        )
    check_equation(model)
    form = past_form(model.wide)
    weight_y = weight("Q", Q, horizon.Np, model.n_y)
    weight_du = weight("R", R, horizon.Nc, model.n_u)
    check_signs(weight_y, weight_du)
    parts = model, form, horizon, reference, weight_y, weight_du
    return _build(*parts, limits, settling, terminal, backend, True, offset_free)


SDP_STRUCTURES: dict[str, Callable[..., StateDependentController]] = {
    "sdp_integral_of_error": sdp_integral_of_error,
    "sdp_increments": sdp_increments,
}
"""Predictive structures for state-dependent models, by name."""


def _build(
    model: StateDependentModel,
    form: Form,
    horizon: Horizon,
    reference: Reading,
    weight_x: Array,
    weight_z: Array,
    limits: Limits | None,
    settling: Settling | None,
    terminal: Terminal,
    backend: str,
    increments: bool,
    offset_free: bool,
) -> StateDependentController:
    if terminal not in ("none", "equality"):
        raise ValueError(f'terminal = "{terminal}": expected "none" or "equality"')
    if settling is not None and not isinstance(settling, Settling):
        raise ValueError(
            f"settling = {settling!r}: expected a Settling, such as "
            'Settling("gauss-newton")'
        )
    find_backend(backend)
    limits = limits or Limits()
    setup = Setup(
        model.wide, form, horizon, reference, c=(horizon.Np, model.n_y), one=1
    )
    problem = Problem(model, setup, weight_x, weight_z, increments, limits, terminal)
    knowledge = _knowledge(setup, not increments)
    layout, n_z = knowledge.layout, setup.n_z
    signals = {
        name: known_part(layout, f"plan_{name}", n_z) for name in ("u", "du", "y")
    }
    return StateDependentController(
        model.wide,
        form,
        limits,
        horizon,
        problem.template,
        signals,
        knowledge,
        problem.ranks,
        backend,
        equation=model,
        settling=settling or Settling(),
        problem=problem,
        offset_free=offset_free,
    )


def _knowledge(setup: Setup, integral: bool) -> Knowledge:
    """Known vector of the program, followed by the plan and what is told of it."""
    base, Np = setup.knowledge(), setup.horizon.Np
    p, q = setup.model.n_y, setup.model.n_u
    parts: dict[str, Any] = {
        "plan_u": (Np, q),
        "plan_du": (Np, q),
        "plan_y": (Np, p),
        "contraction": 1,
        "change": 1,
    }
    if integral:
        parts |= {"free_u": q, "law": (q, p)}
    layout = Layout(**base.layout.shapes, **parts)
    room = ((0, layout.size - base.layout.size), (0, 0))
    return Knowledge(
        layout,
        np.pad(base.from_memory, room),
        np.pad(base.from_r, room),
        np.pad(base.from_v, room),
    )
