"""What the passes of a state-dependent controller did, and what they are worth.

A plan that has stopped moving agrees with its own predictions; that says nothing of
the true problem, in which coefficients move with the plan.  ``examine`` measures both
for each sample of a run, ``iterates`` shows the passes of one sample, ``best_plan``
solves the true problem from several starts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from nmss_lab.controller import Status
from nmss_lab.models import Array
from nmss_lab.qp import solve
from nmss_lab.sdp_mpc import Settling, StateDependentController, Trace
from nmss_lab.sdp_problem import Point, Scheme
from nmss_lab.simulate import Run

TRUE: Scheme = "gauss-newton"
"""The scheme whose points hold the true cost and its true gradient."""


@dataclass(frozen=True, eq=False)
class Iterate:
    """One pass within a sample; of the frozen scheme also the plan it leads to.

    Parameters
    ----------
    u, y : arrays (Np, n_u), (Np, n_y)
        Plan at which the program was made, and what the model does under it.
    cost : float
        True cost J of that plan.
    change : float
        Way from that plan to the program's optimum, its largest entry.
    status : Status
        That of the program's solution; of the ending, in the last pass.
    frozen : bool
        Whether the program's coefficients were those of the present sample.
    """

    u: Array
    y: Array
    cost: float
    change: float
    status: Status
    frozen: bool


@dataclass(frozen=True, eq=False)
class Best:
    """The best plan found for the true problem of a sample.

    Parameters
    ----------
    decision : array (n_z,)
    u, y : arrays (Np, n_u), (Np, n_y)
    cost : float
    found : int
        How many of the starts ended within a millionth of this cost.
    starts : int
    """

    decision: Array
    u: Array
    y: Array
    cost: float
    found: int
    starts: int


@dataclass(frozen=True, eq=False)
class Examination:
    """Measures of each sample of a run, arrays (N,); nan where there is none.

    Parameters
    ----------
    passes : integer array
        Programs solved.
    contraction : array
        By which factor a pass made the change smaller, near the end.
    change : array
        Last change of the plan.
    mismatch : array
        Root mean square difference of this sample's predicted outputs from the last
        one's, where they overlap.
    stationarity : array
        Residual of the true problem's optimality conditions at the plan: the projected
        gradient, relative to the gradient's terms.
    cost, best, gap : arrays
        True cost of the plan, the lowest one found, and how much higher the plan's is,
        as a share of the lowest.
    decrease : array
        How much lower the controller's own cost J is than a sample before.
    promised : array
        True cost of the last plan, shifted by a sample: the bound of the proofs.
    kept : bool array
        Whether the controller's own cost is not above what was promised.
    """

    passes: Array
    contraction: Array
    change: Array
    mismatch: Array
    stationarity: Array
    cost: Array
    best: Array
    gap: Array
    decrease: Array
    promised: Array
    kept: Array


def examine(
    run: Run,
    starts: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Examination:
    """Examine a run of a state-dependent predictive controller.

    Parameters
    ----------
    run : Run
        With its moves.
    starts : int
        Random starts of the search for the lowest cost, beside five that are near at
        hand; 0 leaves the search out, and with it ``best`` and ``gap``.
    progress : function of (samples done, samples), optional
        May raise to stop.

    Raises
    ------
    ValueError
        If the run kept no moves or its controller is of another kind.
    """
    controller = _controller(run)
    N = len(run)
    names = ("stationarity", "cost", "best", "promised")
    found = {name: np.full(N, np.nan) for name in names}
    for k in range(N):
        sample = _Sample(run, k)
        if sample.has_plan:
            point = sample.at(sample.decision)
            found["cost"][k] = point.cost
            found["stationarity"][k] = stationarity(controller, point)
        plan = sample.last_plan
        if plan is not None:
            problem = controller.problem
            z = problem.from_inputs(plan, sample.theta)
            found["promised"][k] = problem.at(z, sample.theta, TRUE).cost
        if starts:
            best = best_plan(run, k, starts)
            found["best"][k] = best.cost
        if progress is not None:
            progress(k + 1, N)
    moves = run.moves
    assert moves is not None
    layout = controller.knowledge.layout
    contraction, change = (
        layout.read(moves.known, name)[:, 0] for name in ("contraction", "change")
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        gap = (found["cost"] - found["best"]) / np.abs(found["best"])
    slack = 1e-9 * (1.0 + np.abs(found["promised"]))
    return Examination(
        passes=run.iterations,
        contraction=np.where(contraction > 0.0, contraction, np.nan),
        change=change,
        mismatch=trail_mismatch(run),
        stationarity=found["stationarity"],
        cost=found["cost"],
        best=found["best"],
        gap=gap,
        decrease=np.concatenate([[np.nan], run.cost[:-1] - run.cost[1:]]),
        promised=found["promised"],
        kept=~(run.cost > found["promised"] + slack),
    )


def trail_mismatch(run: Run) -> Array:
    """Root mean square difference of consecutive predictions of y, (N,)."""
    trail = run.trail("y")
    if trail.shape[1] == 1:  # nothing overlaps
        return np.full(len(trail), np.nan)
    apart = trail[1:, :-1] - trail[:-1, 1:]
    return np.concatenate([[np.nan], np.sqrt((apart**2).mean(axis=(1, 2)))])


def iterates(run: Run, k: int, settling: Settling | None = None) -> list[Iterate]:
    """Repeat the passes of sample k of a run and keep all of them.

    Parameters
    ----------
    run : Run
    k : int
    settling : Settling, optional
        Another way to settle from the same start.

    Raises
    ------
    ValueError
        If the run kept no moves, or has no such sample.
    """
    controller, sample = _controller(run), _Sample(run, k)
    settling = settling or controller.settling
    plan = sample.last_plan if settling.warm_start else None
    start = controller.start_of(sample.theta, plan, settling)
    trace, found = Trace(settling, controller.problem), []
    runaway = controller.runaway(sample.theta)
    for each in controller.passes(sample.theta, start, settling):
        trace.take(each)
        verdict = trace.verdict(runaway, 0.0)
        point = each.point
        status = each.status if verdict is None else verdict
        true = sample.at(point.z).cost
        found.append(Iterate(point.U, point.y, true, each.change, status, point.frozen))
        if verdict is None:
            continue
        if settling.scheme == "frozen" and each.solution.found:
            last = sample.at(each.solution.decision)
            found.append(Iterate(last.U, last.y, last.cost, each.change, status, True))
        return found
    raise AssertionError("passes have no end")


def stationarity(controller: StateDependentController, point: Point) -> float:
    """Projected gradient of the true problem at a plan, relative to its terms.

    ``point`` is one of the scheme "gauss-newton": its rows are those of the true
    Jacobian.
    """
    program, z = point.program, point.z
    curved, straight = program.H @ z, program.f @ point.theta
    size = 1.0 + max(np.abs(curved).max(), np.abs(straight).max())
    nearer = z - (curved + straight) / size
    f = np.zeros_like(program.f)
    f[:, controller.problem.known["one"].start] = -nearer
    projection = dataclasses.replace(program, H=np.eye(len(z)), f=f)
    solution = solve(projection, point.theta, controller.backend)
    return float(np.abs(solution.decision - z).max()) if solution.found else np.nan


def best_plan(run: Run, k: int, starts: int = 8, seed: int = 0) -> Best:
    """Solve the true problem of sample k of a run from several starts.

    SciPy's SLSQP with the exact gradient, from the applied plan, the last plan
    shifted, the held input, the frozen optimum and its mirror image, and ``starts``
    drawn between the limits.

    Parameters
    ----------
    run : Run
    k : int
    starts : int
    seed : int

    Raises
    ------
    ValueError
        If the run kept no moves, or has no such sample.
    """
    controller, sample = _controller(run), _Sample(run, k)
    plans = [
        found
        for start in _starts(controller, sample, starts, seed)
        for found in [_descend(controller, sample, start)]
        if found is not None
    ]
    points = [sample.at(z) for z in plans]
    points += [sample.at(sample.decision)] if sample.has_plan else []
    best = min(points, key=controller.problem.standing)
    near = 1e-6 * (1.0 + abs(best.cost))
    found = sum(point.cost <= best.cost + near for point in points[: len(plans)])
    return Best(best.z, best.U, best.y, best.cost, found, len(plans))


def _starts(
    controller: StateDependentController, sample: _Sample, count: int, seed: int
) -> list[Array]:
    problem, theta = controller.problem, sample.theta
    Np, n_u = controller.horizon.Np, controller.model.n_u
    before = theta[problem.known["u"]]
    held = np.tile(before, (Np, 1))
    frozen = controller.start_of(theta, None, Settling("frozen"))
    solution, _ = controller._optimum(frozen, before, None)
    first = problem.U.value(solution.decision, theta).reshape(Np, -1)
    plans = [held, first, -first]
    plans += [] if sample.last_plan is None else [sample.last_plan]
    rng = np.random.default_rng(seed)
    low, high = controller.limits_u
    room = 1.0 + 2.0 * np.abs(before)
    low, high = np.maximum(low, before - room), np.minimum(high, before + room)
    plans += [rng.uniform(low, high, (Np, n_u)) for _ in range(count)]
    inputs = [controller.kept_within(plan, theta) for plan in plans]
    decisions = [problem.from_inputs(u, theta) for u in inputs]
    return decisions + ([sample.decision] if sample.has_plan else [])


def _descend(
    controller: StateDependentController, sample: _Sample, start: Array
) -> Array | None:
    """Local optimum of the true problem from a start; None where SLSQP finds none."""
    seen: dict[bytes, Point] = {}

    def at(z: Array) -> Point:
        key = z.tobytes()
        if key not in seen:
            seen.clear()
            seen[key] = sample.at(z)
        return seen[key]

    def value(z: Array) -> tuple[float, Array]:
        point = at(z)
        if not np.isfinite(point.cost):
            return 1e30, np.zeros_like(z)
        gradient = point.program.H @ z + point.program.f @ point.theta
        return point.cost, 2.0 * gradient

    template = controller.problem.template
    low, high = np.isfinite(template.lower), np.isfinite(template.upper)

    def room(z: Array) -> Array:
        point = at(z)
        s = point.program.M @ z + point.program.offset @ point.theta
        return np.concatenate([(s - template.lower)[low], (template.upper - s)[high]])

    def slope(z: Array) -> Array:
        M = at(z).program.M
        return np.vstack([M[low], -M[high]])

    rows = {"type": "ineq", "fun": room, "jac": slope}
    found = scipy.optimize.minimize(  # type: ignore[call-overload]
        value,
        start,
        jac=True,
        method="SLSQP",
        constraints=[rows] if low.any() or high.any() else [],
        options={"ftol": 1e-14, "maxiter": 300},
    )
    usable = np.isfinite(found.x).all() and room(found.x).min(initial=0.0) > -1e-7
    return np.asarray(found.x) if usable else None


class _Sample:
    """One sample of a run, as its controller knew it."""

    def __init__(self, run: Run, k: int) -> None:
        controller = _controller(run)
        moves = run.moves
        assert moves is not None
        if not 0 <= k < len(run):
            raise ValueError(f"k = {k}: the run has samples 0 to {len(run) - 1}")
        self.problem = controller.problem
        self.theta = moves.known[k, : self.problem.known.size]
        self.decision = moves.decision[k]
        self.has_plan = bool(moves.shift[k] == 0)
        self.last_plan: Array | None = None
        if k > 0 and moves.shift[k - 1] >= 0:
            Np = controller.horizon.Np
            layout = controller.knowledge.layout
            plan = layout.read(moves.known[k - 1], "plan_u")
            later = np.arange(Np) + 1 + moves.shift[k - 1]
            plan = plan[np.minimum(later, Np - 1)]
            self.last_plan = controller.kept_within(plan, self.theta)

    def at(self, z: Array) -> Point:
        """Point of a plan with the true cost and gradient."""
        return self.problem.at(z, self.theta, TRUE)


def _controller(run: Run) -> StateDependentController:
    if not isinstance(run.controller, StateDependentController):
        raise ValueError(
            f"the run's controller is a {type(run.controller).__name__}, expected one "
            "of sdp_integral_of_error or sdp_increments"
        )
    if run.moves is None:
        raise ValueError("the run kept no moves: run it with closed_loop")
    return run.controller


@dataclass(frozen=True)
class Share:
    """How the samples of many runs ended.

    Parameters
    ----------
    samples : int
    settled, cycled, unsettled, diverged, other : float
        Shares of the samples; they add up to 1.
    passes : float
        Mean number of programs a sample.
    """

    samples: int
    settled: float
    cycled: float
    unsettled: float
    diverged: float
    other: float
    passes: float


SETTLED = (
    Status.FREE,
    Status.LIMITED,
    Status.SOFTENED,
    Status.DROPPED,
    Status.AMBIGUOUS,
)


def shares(runs: Sequence[Run]) -> Share:
    """Count over all samples of runs how their passes ended."""
    status = np.concatenate([run.status for run in runs])
    passes = np.concatenate([run.iterations for run in runs])

    def share(*codes: Status) -> float:
        return float(np.isin(status, [int(code) for code in codes]).mean())

    settled = share(*SETTLED)
    cycled, diverged = share(Status.CYCLED), share(Status.DIVERGED)
    unsettled = share(Status.UNSETTLED, Status.OUT_OF_TIME)
    rest = share(Status.CLIPPED, Status.REFUSED, Status.SHIFTED, Status.HELD)
    other = rest + share(Status.GUARDED)
    return Share(
        len(status), settled, cycled, unsettled, diverged, other, float(passes.mean())
    )
