r"""One quadratic program for every structure, and the solvers it can be handed to.

.. math:: \min_z \tfrac12 z'Hz + (f\theta)'z \quad\text{subject to}\quad
          lower \le Mz + offset\,\theta \le upper

Everything that changes between samples is in the known vector :math:`\theta`; the
matrices are built once.  The program knows nothing of what its rows mean in control,
only their labels.
"""

from __future__ import annotations

import dataclasses
import enum
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, TypeGuard

import numpy as np
import scipy.linalg

from nmss_lab.models import Array
from nmss_lab.predict import Affine, by_step

FEASIBLE = 1e-9
"""A row counts as kept within this distance, relative to 1 + abs(bound)."""

ACCEPTED = 1e-8
"""Largest relative KKT residual of a solution that is applied."""

HELD = 1e-9
"""Smaller multipliers count as zero, relative to 1 + the largest."""


class Row(NamedTuple):
    """What a row limits: the kind of signal, its channel and its step, from 0."""

    name: str
    channel: int
    step: int


@dataclass(frozen=True, eq=False)
class Cost:
    """Quadratic cost signal' weight signal.

    The weight is a matrix (rows, rows), or the blocks (n, size, size) on its diagonal.
    """

    signal: Affine
    weight: Array


@dataclass(frozen=True, eq=False)
class Limit:
    """Rows lower <= signal <= upper; ``channels`` of them belong to each step.

    ``steps`` says which step of the horizon each group of rows belongs to.
    """

    name: str
    signal: Affine
    lower: Array
    upper: Array
    channels: int
    steps: Array


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """Parametric program with two-sided rows.

    Parameters
    ----------
    H, f, constant : arrays (n_z, n_z), (n_z, n_theta), (n_theta, n_theta)
        The full cost is z'Hz + 2 (f theta)'z + theta' constant theta: twice the
        program's objective and its constant, that is J of (4.10), (4.11), (3.7).
    M, offset, lower, upper : arrays (rows, n_z), (rows, n_theta), (rows,), (rows,)
    labels : tuple of Row
    left_out : tuple of Row
        Rows with limits which the decision cannot move.
    """

    H: Array
    f: Array
    constant: Array
    M: Array
    offset: Array
    lower: Array
    upper: Array
    labels: tuple[Row, ...]
    left_out: tuple[Row, ...] = ()

    @property
    def n_z(self) -> int:
        """Number of decision variables."""
        return self.H.shape[0]

    @cached_property
    def _factor(self) -> tuple[Array, bool]:
        factor: tuple[Array, bool] = scipy.linalg.cho_factor(self.H)
        return factor

    @cached_property
    def bare(self) -> Array:
        """Gain (n_z, n_theta) of the optimum without any rows, -H^-1 f."""
        bare: Array = -scipy.linalg.cho_solve(self._factor, self.f)
        return bare

    @cached_property
    def bare_rows(self) -> Array:
        """Gain (rows, n_theta) of the rows at the optimum without any."""
        gain: Array = self.M @ self.bare + self.offset
        return gain

    @cached_property
    def free(self) -> Array:
        """Gain (n_z, n_theta) of the optimum without limits.

        Terminal equalities always hold, so the optimum is taken among what meets them,
        unless they are more than the decision can meet.
        """
        equal = self.rows.get("terminal", np.zeros(0, dtype=int))
        E = self.M[equal]
        if not 0 < len(E) <= self.n_z or np.linalg.matrix_rank(E) < len(E):
            return self.bare
        push = self.push[:, equal]
        free: Array = self.bare - push @ np.linalg.solve(
            E @ push, self.bare_rows[equal]
        )
        return free

    @cached_property
    def inverse(self) -> Array:
        """H^-1, (n_z, n_z)."""
        inverse: Array = scipy.linalg.cho_solve(self._factor, np.eye(self.n_z))
        return inverse

    @cached_property
    def push(self) -> Array:
        """Change of the free optimum for a unit force in each row, H^-1 M'."""
        push: Array = scipy.linalg.cho_solve(self._factor, self.M.T)
        return push

    @cached_property
    def rows(self) -> dict[str, Array]:
        """Row numbers of each kind of limit."""
        kinds = dict.fromkeys(label.name for label in self.labels)
        return {kind: self._numbers((kind,)) for kind in kinds}

    def _numbers(self, names: Sequence[str]) -> Array:
        return np.array([i for i, row in enumerate(self.labels) if row.name in names])

    def cost(self, z: Array, theta: Array) -> Array:
        """Full cost J, constant included, for z (..., n_z) and theta (..., n_theta)."""
        quadratic = np.vecdot(z @ self.H + 2.0 * (theta @ self.f.T), z)
        cost: Array = quadratic + np.vecdot(theta @ self.constant, theta)
        return cost

    def room(self, z: Array, theta: Array) -> Array:
        """Smaller distance of each row to its limits, negative where it is broken."""
        value = z @ self.M.T + theta @ self.offset.T
        room: Array = np.minimum(value - self.lower, self.upper - value)
        return room

    @cached_property
    def slack(self) -> Array:
        """How far each row may miss its limits and still count as kept, (rows,)."""
        nearest = np.minimum(np.abs(self.lower), np.abs(self.upper))
        return FEASIBLE * (1.0 + nearest)

    @cached_property
    def free_rows(self) -> Array:
        """Gain (rows, n_theta) of the rows at the optimum without limits."""
        gain: Array = self.M @ self.free + self.offset
        return gain

    def free_is_kept(self, theta: Array) -> Array:
        """Whether the optima without limits of (loops, n_theta) keep all rows."""
        value = self.free_rows @ theta.T  # reducing columns is much faster than rows
        low, high = self.lower - self.slack, self.upper + self.slack
        inside = (value >= low[:, None]) & (value <= high[:, None])
        kept: Array = np.all(inside, axis=0)
        return kept

    def without(self, *names: str) -> QuadraticProgram:
        """Return the program without the rows of these names (6.1.2)."""
        gone = set(self._numbers(names).tolist())
        return self.only([i for i in range(len(self.labels)) if i not in gone])

    def only(self, rows: Sequence[int]) -> QuadraticProgram:
        """Return the program with some of its rows."""
        return dataclasses.replace(
            self,
            M=self.M[rows],
            offset=self.offset[rows],
            lower=self.lower[rows],
            upper=self.upper[rows],
            labels=tuple(self.labels[i] for i in rows),
        )

    def softened(self, rows: Array, weight: Array) -> QuadraticProgram:
        """Let ``rows`` be broken by slack variables s at the cost s' diag(weight) s.

        The slack variables follow the decision: n_z grows by ``len(rows)``.
        """
        extra, known = len(rows), self.f.shape[1]
        M = np.hstack([self.M, np.eye(len(self.labels))[:, rows]])
        H = scipy.linalg.block_diag(self.H, np.diag(weight))
        f = np.vstack([self.f, np.zeros((extra, known))])
        return dataclasses.replace(self, M=M, H=H, f=f)

    def one_sided(self, theta: Array) -> tuple[Array, Array]:
        """Return M and N of the thesis's M z <= N for one known vector.

        Rows without a bound on a side are left out on that side.
        """
        known = self.offset @ theta
        low, high = np.isfinite(self.lower), np.isfinite(self.upper)
        M = np.vstack([-self.M[low], self.M[high]])
        N = np.concatenate([(known - self.lower)[low], (self.upper - known)[high]])
        return M, N


def assemble(
    costs: Sequence[Cost], limits: Sequence[Limit], what: str = "weights"
) -> QuadraticProgram:
    """Sum the costs and stack the limits into one program.

    Rows without a finite bound are dropped; limited rows that the decision cannot
    move are left out and listed in ``left_out``.

    Raises
    ------
    ValueError
        If the condensed H is not positive definite, with its smallest eigenvalue.
        Indefinite blocks are fine as long as H is not.
    """
    table = sum_of_squares(costs)
    n_z = costs[0].signal.gain.shape[1]
    H, f = table[:n_z, :n_z].copy(), table[:n_z, n_z:].copy()
    constant = table[n_z:, n_z:].copy()
    smallest, largest = np.linalg.eigvalsh(H)[[0, -1]]
    if not smallest > 1e-13 * abs(largest):
        raise ValueError(
            f"the {what} give a cost that is not convex: the smallest eigenvalue of "
            f"the condensed Hessian is {smallest:.4g} (largest {largest:.4g}). "
            "Correct or weigh less a block that has negative eigenvalues itself; where "
            "there is none, weigh the moves more."
        )
    rows = [_rows(limit) for limit in limits]
    none = np.zeros((0, table.shape[1] + 2))
    stacked = np.concatenate([none, *(part for part, _, _ in rows)])
    M, offset, bounds = np.split(stacked, [n_z, table.shape[1]], axis=1)
    labels = tuple(label for _, kept, _ in rows for label in kept)
    left_out = tuple(label for _, _, left in rows for label in left)
    lower, upper = bounds.T
    return QuadraticProgram(
        H,
        f,
        constant,
        M.copy(),
        offset.copy(),
        lower.copy(),
        upper.copy(),
        labels,
        left_out,
    )


def sum_of_squares(costs: Sequence[Cost]) -> Array:
    """Sum of all costs as one symmetric matrix on [z; theta]."""
    total: Array = np.zeros(())
    for cost in costs:
        both = cost.signal.table
        weighed = by_step(cost.weight, both)
        total = total + both.T @ weighed
    return (total + total.T) / 2.0


def _rows(limit: Limit) -> tuple[Array, list[Row], list[Row]]:
    """Rows [gain, known, lower, upper] that matter, their labels, and the others."""
    labels = [
        Row(limit.name, i, int(step))
        for step in limit.steps
        for i in range(limit.channels)
    ]
    bounded, moved = matters(limit)
    table = np.column_stack(
        [limit.signal.gain, limit.signal.known, limit.lower, limit.upper]
    )
    kept = [label for label, ok in zip(labels, bounded & moved, strict=True) if ok]
    left = [label for label, ok in zip(labels, bounded & ~moved, strict=True) if ok]
    return table[bounded & moved], kept, left


def matters(limit: Limit) -> tuple[Array, Array]:
    """Which rows have a finite bound, and which the decision can move, (rows,) each."""
    bounded = np.isfinite(limit.lower) | np.isfinite(limit.upper)
    size = np.abs(limit.signal.gain).max(axis=1, initial=0.0)
    return bounded, size > 1e-12 * max(1.0, size.max(initial=0.0))


def weight(name: str, value: Any, steps: int, size: int) -> Array:
    """Block-diagonal weight (steps size, steps size), see ``weight_blocks``."""
    full: Array = scipy.linalg.block_diag(*weight_blocks(name, value, steps, size))
    return full


def weight_blocks(name: str, value: Any, steps: int, size: int) -> Array:
    """Symmetric blocks (steps, size, size) of a block-diagonal weight.

    A full matrix is a single block (1, steps size, steps size).

    Accepts a number, one weight a channel (size,), a matrix (size, size), one number a
    step (steps,) for a single channel, one matrix a step (steps, size, size), or the
    full matrix.

    Raises
    ------
    ValueError
        If the shape is another, or an entry is not finite.
    """
    array = np.asarray(value, dtype=float)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds entries that are not finite")
    if array.shape == (steps * size, steps * size) and steps > 1:
        return (array + array.T)[None] / 2.0
    if size == 1 and array.shape == (steps,):
        array = array[:, None, None]
    if array.ndim == 0:
        array = array * np.eye(size)
    if array.shape == (size,):
        array = np.diag(array)
    if array.shape == (size, size):
        array = np.broadcast_to(array, (steps, size, size))
    if array.shape != (steps, size, size):
        raise ValueError(
            f"{name} has shape {np.shape(value)}, expected a number, ({size},), "
            f"({size}, {size}), ({steps}, {size}, {size}) or the full "
            f"({steps * size}, {steps * size})"
        )
    blocks: Array = (array + array.transpose(0, 2, 1)) / 2.0
    return blocks


class QPStatus(enum.Enum):
    """How a solver ended; the values are sentences."""

    SOLVED = "The solution meets the optimality conditions."
    INFEASIBLE = "The solver found that the limits contradict each other."
    INACCURATE = "The solver's answer does not meet the optimality conditions."
    FAILED = "The solver raised an error or gave no answer."


@dataclass(frozen=True, eq=False)
class Solution:
    """Answer of a solver, which carries its own proof.

    Parameters
    ----------
    decision : array (n_z,)
    multipliers : array (rows,)
        Positive where an upper limit holds the row, negative where a lower one does.
    status : QPStatus
    iterations : int
    residual : float
        Largest relative violation of the KKT conditions (2.5): stationarity,
        feasibility, complementarity.
    message : str
        What the solver said, when it failed.
    """

    decision: Array
    multipliers: Array
    status: QPStatus
    iterations: int = 0
    residual: float = np.inf
    message: str = ""

    @property
    def found(self) -> bool:
        """Whether the decision may be applied."""
        return self.status is QPStatus.SOLVED

    @property
    def active(self) -> Array:
        """Rows held by a limit, (rows,) of bool."""
        return np.abs(self.multipliers) > 0.0


Guess = tuple[Array, Array]
"""Decision and multipliers."""


class Problem(NamedTuple):
    """Numbers of one sample: min 1/2 z'Hz + f'z, lower <= M z <= upper.

    ``guess`` holds the decision and multipliers to start from, for solvers that can be
    warm-started.
    """

    H: Array
    f: Array
    M: Array
    lower: Array
    upper: Array
    guess: Guess | None = None


Answer = tuple[Array | None, Array, int, bool]
"""What a backend returns: decision, multipliers, iterations, whether infeasible."""

Backend = Callable[[Problem], Answer]


def solve(
    program: QuadraticProgram,
    theta: Array,
    backend: str = "daqp",
    bounds: tuple[Array, Array] | None = None,
    guess: Guess | None = None,
) -> Solution:
    """Solve the program for one known vector.

    Parameters
    ----------
    program : QuadraticProgram
    theta : array (n_theta,)
    backend : str
        "active_set" (see ``BACKENDS``), "daqp", "proxqp", or "qpsolvers/NAME" for any
        solver qpsolvers finds.
    bounds : pair of arrays (rows,), optional
        Lower and upper limits in place of the program's.
    guess : pair of arrays (at most n_z,), (rows,), optional
        Decision and multipliers to start from, such as the last sample's; missing
        entries of the decision are zero.

    Returns
    -------
    Solution
        Never raises for what a solver does: look at ``status``.

    Raises
    ------
    ValueError
        If there is no such backend.
    """
    solver = find_backend(backend)
    low, high = bounds or (program.lower, program.upper)
    known = program.offset @ theta
    if guess is not None:
        guess = np.pad(guess[0], (0, program.n_z - len(guess[0]))), guess[1]
    problem = Problem(
        program.H, program.f @ theta, program.M, low - known, high - known, guess
    )
    nothing = np.zeros(program.n_z), np.zeros(len(known))
    if not len(known):  # some solvers do not take a program without rows
        free = program.free @ theta
        residual = kkt_residual(problem, free, nothing[1])
        return Solution(free, nothing[1], QPStatus.SOLVED, residual=residual)
    try:
        z, multipliers, iterations, infeasible = solver(problem)
    except Exception as error:  # a solver may raise anything; the loop must go on
        return Solution(*nothing, QPStatus.FAILED, message=f"{backend}: {error!r}")
    if infeasible:
        return Solution(*nothing, QPStatus.INFEASIBLE, iterations)
    if not (_usable(z, program.n_z) and _usable(multipliers, len(known))):
        said = f"{backend} gave no finite decision of the right size"
        return Solution(*nothing, QPStatus.FAILED, iterations, message=said)
    z, multipliers, residual = _polish(problem, z, multipliers)
    good = residual <= ACCEPTED
    status = QPStatus.SOLVED if good else QPStatus.INACCURATE
    return Solution(z, multipliers, status, iterations, residual)


def _usable(values: Array | None, size: int) -> TypeGuard[Array]:
    if values is None or np.shape(values) != (size,):
        return False
    return bool(np.isfinite(values).all())


def kkt_residual(problem: Problem, z: Array, multipliers: Array) -> float:
    """Largest relative violation of the optimality conditions (2.5).

    Stationarity is measured against the size of its terms, feasibility against
    1 + abs(bound), complementarity against the size of the objective's terms.
    """
    return float(kkt_residuals(problem, z, multipliers))


def kkt_residuals(problem: Problem, z: Array, multipliers: Array) -> Array:
    """As ``kkt_residual`` for many problems of equal H and M, one a column.

    f, lower and upper of the problem are columns too, as z and multipliers are.
    """
    Hz, value = problem.H @ z, problem.M @ z
    push, f = problem.M.T @ multipliers, problem.f
    terms = np.maximum(np.maximum(_largest(Hz), _largest(f)), _largest(push))
    stationarity = _largest(Hz + f + push) / (1.0 + terms)
    below, above = problem.lower - value, value - problem.upper
    nearest = np.minimum(np.abs(problem.lower), np.abs(problem.upper))
    broken = np.maximum(np.maximum(below, above), 0.0) / (1.0 + nearest)
    gap = np.where(multipliers > 0, above, np.where(multipliers < 0, below, 0.0))
    size = 1.0 + np.abs((z * Hz).sum(axis=0)) + np.abs((f * z).sum(axis=0))
    complementarity = _largest(gap * multipliers) / size
    residuals: Array = np.maximum(
        np.maximum(stationarity, _largest(broken)), complementarity
    )
    return residuals


def _largest(columns: Array) -> Array:
    largest: Array = np.abs(columns).max(axis=0, initial=0.0)
    return largest


def one_by_one(matrix: Array, vectors: Array) -> Array:
    """Products with vectors (loops, n), the same whichever others there are.

    To the last digit: in one product of matrices rounding depends on their sizes.
    ``matrix`` is one for all vectors, or (loops, m, n), one for each.
    """
    products: Array = (matrix @ vectors[..., None])[..., 0]
    return products


def _polish(
    problem: Problem, z: Array, multipliers: Array
) -> tuple[Array, Array, float]:
    """Solve the equations of the active rows exactly, if that is the better answer."""
    largest = np.abs(multipliers).max(initial=0.0)
    held = np.abs(multipliers) > HELD * (1.0 + largest)
    multipliers = np.where(held, multipliers, 0.0)
    residual = kkt_residual(problem, z, multipliers)
    if residual <= 1e-2 * ACCEPTED or not held.any():
        return z, multipliers, residual
    M = problem.M[held]
    wanted = np.where(multipliers > 0, problem.upper, problem.lower)[held]
    n, rows = len(z), len(wanted)
    kkt = np.block([[problem.H, M.T], [M, np.zeros((rows, rows))]])
    exact, *_ = np.linalg.lstsq(kkt, np.concatenate([-problem.f, wanted]), rcond=None)
    refined = np.zeros_like(multipliers)
    refined[held] = exact[n:]
    same_side = (refined * multipliers >= 0.0).all()
    better = kkt_residual(problem, exact[:n], refined) if same_side else np.inf
    if better < residual:
        return exact[:n], refined, better
    return z, multipliers, residual


def _daqp(problem: Problem) -> Answer:
    daqp = importlib.import_module("daqp")
    equal = problem.upper - problem.lower < 1e-12
    z, _, flag, info = daqp.solve(
        problem.H,
        problem.f,
        np.ascontiguousarray(problem.M),
        np.minimum(problem.upper, 1e30),
        np.maximum(problem.lower, -1e30),
        np.where(equal, 5, 0).astype(np.int32),
        primal_tol=1e-10,
        dual_tol=1e-12,
        iter_limit=10_000,
    )
    return (z if flag > 0 else None), info["lam"], int(info["iterations"]), flag == -1


def _proxqp(problem: Problem) -> Answer:
    proxsuite = importlib.import_module("proxsuite")
    n, rows = len(problem.f), len(problem.lower)
    qp = proxsuite.proxqp.dense.QP(n, 0, rows)
    qp.settings.eps_abs = 1e-9
    qp.settings.eps_rel = 0.0
    # Without this the stopping test ignores complementarity: errors up to 1e-2.
    qp.settings.check_duality_gap = True
    qp.settings.eps_duality_gap_abs = 1e-8
    qp.settings.eps_duality_gap_rel = 1e-9
    # Contradicting limits would keep it busy for minutes, and the loose default test
    # for them (1e-4) rejects sound problems when started warm.
    qp.settings.max_iter = 1_000
    qp.settings.eps_primal_inf = 1e-10
    qp.init(problem.H, problem.f, None, None, problem.M, problem.lower, problem.upper)
    if problem.guess is None:
        qp.solve()
    else:
        qp.settings.initial_guess = proxsuite.proxqp.InitialGuess.WARM_START
        qp.solve(problem.guess[0], None, problem.guess[1])
    results, status = qp.results, proxsuite.proxqp
    infeasible = results.info.status == status.PROXQP_PRIMAL_INFEASIBLE
    return results.x.copy(), results.z.copy(), int(results.info.iter), bool(infeasible)


def _through_qpsolvers(name: str) -> Backend:
    def run(problem: Problem) -> Answer:
        qpsolvers = importlib.import_module("qpsolvers")
        low, high = np.isfinite(problem.lower), np.isfinite(problem.upper)
        G = np.vstack([problem.M[high], -problem.M[low]])
        h = np.concatenate([problem.upper[high], -problem.lower[low]])
        solution = qpsolvers.solve_problem(
            qpsolvers.Problem(problem.H, problem.f, G, h), solver=name
        )
        multipliers = np.zeros(len(problem.lower))
        if solution.found and solution.z is not None:
            multipliers[high] += solution.z[: high.sum()]
            multipliers[low] -= solution.z[high.sum() :]
        return solution.x, multipliers, 0, not solution.found

    return run


BACKENDS: dict[str, Backend] = {
    "active_set": _daqp,
    "daqp": _daqp,
    "proxqp": _proxqp,
}
"""Solvers by name; adding one is one function ``Problem -> Answer`` and one entry.

With "active_set" a loop goes on from the rows that its last move held, see
``nmss_lab.laws``; DAQP solves what is left."""


def find_backend(name: str) -> Backend:
    """Backend of that name.

    Raises
    ------
    ValueError
        If there is none, with the names there are.
    """
    if name in BACKENDS:
        return BACKENDS[name]
    available: list[str] = importlib.import_module("qpsolvers").available_solvers
    kind, _, solver = name.partition("/")
    if kind == "qpsolvers" and solver in available:
        return _through_qpsolvers(solver)
    others = ", ".join(f"qpsolvers/{each}" for each in available)
    raise ValueError(
        f'backend = "{name}": expected one of {", ".join(BACKENDS)}, {others}'
    )
