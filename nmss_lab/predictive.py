"""The predictive controller: one class for every structure and for the governor.

It decides by the linear law, looks whether that keeps all limits, and only where it
does not solves the quadratic program; then the fallbacks, in order.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, cast

import numpy as np

from nmss_lab.controller import (
    Controller,
    Limits,
    Memory,
    Move,
    Status,
    as_ensemble,
)
from nmss_lab.laws import LOOKS, Law, Laws
from nmss_lab.models import Array
from nmss_lab.nmss import Layout
from nmss_lab.predict import Affine, Horizon
from nmss_lab.qp import Guess, Limit, QuadraticProgram, Solution, one_by_one, solve
from nmss_lab.regions import Regions

LOG = logging.getLogger(__name__)

Forecast = Literal["held", "line", "given"] | Callable[[Array, int], Array]
"""Measured disturbances ahead: v_k held, on along the line through the latest two
values, handed to ``decide``, or a function of the latest values (ng + 1, n_v), v_k
first, and of the number of samples ahead that returns (samples, n_v)."""


@dataclass(frozen=True, eq=False)
class Knowledge:
    """Layout of the known vector theta and how it is made.

    theta = from_memory m + from_r [r_k; r_{k+1}; ...] + from_v [v_k; v_{k+1}; ...]
    """

    layout: Layout
    from_memory: Array
    from_r: Array
    from_v: Array


def _fixed(code: int) -> Array:
    """Make a number that moves share."""
    number = np.array(code)
    number.flags.writeable = False
    return number


FREE, LIMITED, REFUSED = map(_fixed, (Status.FREE, Status.LIMITED, Status.REFUSED))
NONE = _fixed(0)


class Planned(Move):
    """Move that a law gives; what lies behind it is worked out when somebody asks."""

    __slots__ = ("last", "point")

    last: Law
    point: Array

    @classmethod
    def by(
        cls, law: Law, last: Law, point: Array, first: Array, refused: Any
    ) -> Planned:
        """Make the move from what ``law.first`` gave; ``last`` is the law before."""
        move: Planned = cls.__new__(cls)
        move.law, move.last, move.point = law, last, point
        move.u = first[law.u]
        move.w = move.governed = first[law.w]
        move.status = REFUSED if refused else LIMITED if law.limited else FREE
        move.shift = NONE
        return move

    def __getattr__(self, name: str) -> Array:
        """Fill in what is not there yet; only then is it asked here."""
        law = cast(Law, self.law)
        if name == "cost":
            self.cost = law.program.cost(self.decision, self.known)
        elif name == "iterations":
            others = law.region.held != self.last.region.held
            self.iterations = np.array(np.count_nonzero(others))
        elif name in ("known", "decision", "multipliers"):
            self.known, self.decision, self.multipliers = law.plan(self.point)
        else:
            raise AttributeError(name)
        return cast(Array, getattr(self, name))


@dataclass(frozen=True, eq=False)
class RankedProgram:
    """A program whose rows give way, in the order of their ranks, when they must.

    Parameters
    ----------
    program : QuadraticProgram
    ranks : integer array (rows,)
        Rows of the highest rank give way first; -1 for rows that never do, 0 for the
        inputs of a governed loop.
    limits : Limits
        Says how outputs give way, and at which price.
    backend : str
    """

    program: QuadraticProgram
    ranks: Array
    limits: Limits
    backend: str

    def solve(
        self, theta: Array, bounds: tuple[Array, Array], guess: Guess | None = None
    ) -> tuple[Solution, Status]:
        """Solve with all rows; if that fails let rows give way as the limits say."""
        governed = (self.ranks == 0).any()
        if not self.strict:
            solution, status = self._solve_relaxed(theta, bounds)
            if solution.found or not governed:
                return solution, status
        solution = solve(self.program, theta, self.backend, bounds, guess)
        if solution.found or not self._giving.size:
            return solution, Status.LIMITED
        if self.limits.outputs == "priority" or governed:
            return self._solve_by_rank(theta, bounds)
        return self._solve_without(theta, bounds)

    @cached_property
    def strict(self) -> bool:
        """Whether the program is first solved as it is, without a price on rows."""
        return self.limits.outputs != "soft" or not self._soft.size

    @cached_property
    def _giving(self) -> Array:
        return np.flatnonzero(self.ranks >= 0)

    @cached_property
    def _without_outputs(self) -> QuadraticProgram:
        names = {self.program.labels[i].name for i in self._giving}
        return self.program.without(*names)

    def _solve_without(
        self, theta: Array, bounds: tuple[Array, Array]
    ) -> tuple[Solution, Status]:
        """Drop the rows that may give way (6.1.2)."""
        keep = self.ranks < 0
        low, high = bounds
        solution = solve(
            self._without_outputs, theta, self.backend, (low[keep], high[keep])
        )
        multipliers = np.zeros(len(keep))
        multipliers[keep] = solution.multipliers
        return _cut(solution, self.program.n_z, multipliers), Status.DROPPED

    @cached_property
    def _soft(self) -> Array:
        """Rows with a price; the inputs of a governed loop (rank 0) have none."""
        return np.flatnonzero(self.ranks > 0)

    @cached_property
    def _relaxed(self) -> QuadraticProgram:
        weight = np.full(self._soft.size, self.limits.soft_weight)
        return self.program.softened(self._soft, weight)

    def _solve_relaxed(
        self, theta: Array, bounds: tuple[Array, Array]
    ) -> tuple[Solution, Status]:
        """Pay a quadratic price for breaking output limits."""
        solution = solve(self._relaxed, theta, self.backend, bounds)
        broken = np.abs(solution.decision[self.program.n_z :]).max(initial=0.0) > 1e-6
        status = Status.SOFTENED if broken else Status.LIMITED
        return _cut(solution, self.program.n_z, solution.multipliers), status

    @cached_property
    def _stages(self) -> list[tuple[Array, Array, QuadraticProgram]]:
        """Rows kept so far, rows of a rank, and the program that lets those give way.

        One a rank, the most important first; rows of later ranks are left out.
        """
        stages = []
        price = 1e6 * np.abs(self.program.H).max()
        for rank in np.unique(self.ranks[self._giving]):
            kept = np.flatnonzero(self.ranks <= rank)
            rows = np.flatnonzero(self.ranks == rank)
            part = self.program.only(kept.tolist())
            places, weight = np.searchsorted(kept, rows), np.full(rows.size, price)
            stages.append((kept, rows, part.softened(places, weight)))
        return stages

    def _solve_by_rank(
        self, theta: Array, bounds: tuple[Array, Array]
    ) -> tuple[Solution, Status]:
        """Break each rank of rows as little as the more important ones allow."""
        low, high = bounds[0].copy(), bounds[1].copy()
        for kept, rows, program in self._stages:
            solution = solve(program, theta, self.backend, (low[kept], high[kept]))
            if not solution.found:
                return solution, Status.SHIFTED
            missed, margin = solution.decision[self.program.n_z :], 1e-7
            low[rows] -= np.maximum(missed, 0.0) + margin
            high[rows] += np.maximum(-missed, 0.0) + margin
        solution = solve(self.program, theta, self.backend, (low, high))
        return solution, Status.SOFTENED


@dataclass(frozen=True, eq=False)
class PredictiveController(Controller):
    """A design that decides by a quadratic program; frozen, and shared by many loops.

    Parameters
    ----------
    model, form, limits : see ``Controller``
    horizon : Horizon
    program : QuadraticProgram
    signals : mapping of str to Affine
        Predicted "u" (Np n_u), "du" (Np n_u), "y" (Np n_y), and "w" and "beta" under
        a governor.
    knowledge : Knowledge
    ranks : integer array (rows,)
        Order in which rows give way when not all can be kept, the highest first;
        -1 for rows that never do.
    backend : str
    forecast : "held", "line", "given" or a function, see ``Forecast``
    anti_windup : bool
        Whether a sum of the error stops growing while a level limit holds the input.
    regions : Regions, optional
        What loops in lock step have learnt from one another, see ``together``.
    """

    horizon: Horizon
    program: QuadraticProgram
    signals: Mapping[str, Affine]
    knowledge: Knowledge
    ranks: Array
    backend: str = "active_set"
    forecast: Forecast = "held"
    anti_windup: bool = True
    regions: Regions | None = None

    def together(self) -> PredictiveController:
        """Return this controller with a place to keep solutions for other loops.

        Each call begins with none, so that an ensemble always gives the same numbers.
        """
        return dataclasses.replace(self, regions=Regions(self.program))

    @property
    def n_z(self) -> int:
        """Number of decision variables."""
        return self.program.n_z

    @property
    def n_theta(self) -> int:
        """Size of the known vector."""
        return self.knowledge.layout.size

    @property
    def n_rows(self) -> int:
        """Number of limited rows."""
        return len(self.program.labels)

    @property
    def preview(self) -> int:
        """How many samples of r beyond r_k are read."""
        return self.knowledge.from_r.shape[1] // self.model.n_y - 1

    @property
    def forecast_steps(self) -> int:
        """How many samples of v beyond v_k are read."""
        return max(self.knowledge.from_v.shape[1] // max(self.model.n_v, 1) - 1, 0)

    @cached_property
    def ranked(self) -> RankedProgram:
        """The program with the order in which its rows give way."""
        return RankedProgram(self.program, self.ranks, self.limits, self.backend)

    @cached_property
    def first_move(self) -> Affine:
        """u_k as a function of decision and known vector."""
        return self.signals["u"][: self.model.n_u]

    @cached_property
    def free_gain(self) -> Array:
        """Gain (n_u, n_theta) of u_k on the known vector without active limits."""
        free: Array = self.first_move.gain @ self.program.free + self.first_move.known
        return free

    def gain(self, name: str) -> Array:
        """Gain of the law u_k = ... - gain @ part, for a part of the known vector.

        ``gain("x")`` is the first block row of K_s and ``gain("r")`` that of R_s in
        (4.17); for structures on changes the law adds u_{k-1} and ``-gain("r")`` is
        w_s of (6.3).
        """
        part: Array = -self.free_gain[:, self.knowledge.layout[name]]
        return part

    def free_law(self) -> tuple[Array, Array]:
        """First move without limits: gains on the memory and on r_k, r_{k+1}, ..."""
        knows = self.knowledge
        return self.free_gain @ knows.from_memory, self.free_gain @ knows.from_r

    def plan(self, move: Move, name: str) -> Array:
        """Predicted signal ("u", "du", "y", ...) of a move, (..., Np, channels).

        A plan that was continued after a failure is shifted to the present sample,
        its last value repeated.
        """
        flat = self.signals[name].value(move.decision, move.known)
        steps = self.signals[name].gain.shape[0]
        width = steps // self.horizon.Np
        plan = flat.reshape(*flat.shape[:-1], self.horizon.Np, width)
        shift = np.maximum(np.asarray(move.shift), 0)[..., None]
        step = np.minimum(np.arange(self.horizon.Np) + shift, self.horizon.Np - 1)
        return np.take_along_axis(plan, step[..., None], axis=-2)

    def _missed(self, memory: Memory, u: Array, move: Move) -> Array:
        """As for any controller, by the law of the plan that was made now."""
        free = move.known @ self.free_gain.T
        older = np.asarray(move.shift != 0)
        if older.any():
            others = u - super()._missed(memory, u, move)
            free = np.where(older[..., None], others, free)
        return np.where(self._overruled(u, free, move), u - free, 0.0)

    def _overruled(self, u: Array, free: Array, move: Move) -> Array:
        """As for any controller, and where a level limit holds the input, (..., 1)."""
        other = super()._overruled(u, free, move)
        if not self.anti_windup:
            return other
        low, high = self.limits_u
        held: Array = ((free > high) & _close(u, high)) | (
            (free < low) & _close(u, low)
        )
        overruled: Array = other | held.any(axis=-1, keepdims=True)
        return overruled

    @cached_property
    def follows_laws(self) -> bool:
        """Whether a single loop's move is the affine one of ``laws``."""
        return True

    @property
    def in_force(self) -> Affine | None:
        """Reference in force (n_y rows) as a function of decision and known vector.

        None where it is the r_k of the memory.
        """
        return None

    @cached_property
    def laws(self) -> Laws:
        """Affine laws of a single loop, see ``nmss_lab.laws``."""
        # an input left outside by hand comes back as far as the rates reach
        sides = self.limits_u if np.isfinite(self.limits_du).any() else None
        return Laws(
            self.program,
            self.in_force,
            self.first_move,
            self.form.recipe.layout.select("r"),
            self.knowledge.from_memory,
            self._from_coming,
            self.knowledge.layout["u"],
            sides,
        )

    @cached_property
    def _switches(self) -> bool:
        """Whether a single loop goes from law to law before a solver is asked."""
        return self.backend == "active_set" and self.ranked.strict

    def decide(
        self, memory: Memory, r: Array | None = None, v: Array | None = None
    ) -> Move:
        """Choose u_k from what has been measured, see ``Controller.decide``.

        A single loop looks at the law of its last move first.
        """
        if memory.vector.ndim > 1 or not self.follows_laws:
            return super().decide(memory, r, v)
        laws, law = self.laws, memory.last.law
        if law is None or law.program is not self.program:
            law = laws.free
        if law is None:
            return super().decide(memory, r, v)
        told = None
        if r is not None or v is not None or laws.coming is not None:
            told = self._handed(memory, r, v)
        point = laws.point(memory.vector, told)
        last = wrong = law
        begun = signs = b""
        looks = LOOKS if self._switches else 0
        while law is not None:
            first = law.first.dot(point)
            tests = first[law.tests]
            if tests.item(tests.argmin()) > 0.0:
                if begun and last.after.get(begun) is not law:
                    last.learn(begun, law)
                    wrong.learn(signs, law)
                return Planned.by(law, last, point, first, memory.refused)
            if looks == 0:
                break
            signs, wrong, looks = np.signbit(tests).tobytes(), law, looks - 1
            begun, law = begun or signs, None
            if looks:
                law = wrong.after.get(signs) or laws.beyond(wrong, tests)
            if law is None:  # no known one: ask, and look once more
                looks, law = 0, laws.asked(wrong.known(point))
        return super().decide(memory, r, v)

    @cached_property
    def _handed_shape(self) -> tuple[int, int] | None:
        """Shape of r if that is all that laws take from what is handed to them."""
        nothing = self._from_coming is None or self.model.n_v > 0
        return None if nothing else (1 + self.preview, self.model.n_y)

    def _handed(self, memory: Memory, r: Array | None, v: Array | None) -> Array:
        """Give what ``decide`` is handed in one row, for a single loop."""
        if type(r) is np.ndarray and r.shape == self._handed_shape:
            told: Array = r.ravel()
            if math.isfinite(told.dot(told)):
                return told
        given = self._given(as_ensemble(memory), r, v)
        row: Array = self._coming(memory.vector[None], *given)[0]
        return row

    def _decide(self, memory: Memory, r: Array, v: Array) -> Move:
        theta = self._known(memory.vector, r, v)
        z = theta @ self.program.free.T
        move = self._move(self.first_move.value(z, theta), r, decision=z, known=theta)
        kept = self.program.free_is_kept(theta)
        if not kept.all():
            self._decide_all_limited(move, memory, np.flatnonzero(~kept))
        return self._finish(move, memory)

    def _decide_all_limited(self, move: Move, memory: Memory, loops: Array) -> None:
        """Fill in the rows where the free optimum breaks a limit."""
        alone = loops
        if self.regions is not None and self.ranked.strict:
            own_bounds = self._within(self.last_input(memory.vector[loops]))
            self._decide_shared(self.regions, move, memory, loops[own_bounds])
            alone = loops[~own_bounds]
        for i in alone.tolist():
            self._decide_limited(move, memory, i)

    def _decide_shared(
        self, regions: Regions, move: Move, memory: Memory, loops: Array
    ) -> None:
        """Fill in loops whose programs differ in the known vector alone."""

        def solve_one(number: int) -> Array | None:
            i = int(loops[number])
            self._decide_limited(move, memory, i)
            limited = move.status[i] == Status.LIMITED
            return move.multipliers[i] if limited else None

        known = move.known[loops]
        for numbers, z, multipliers in regions.answers(known, solve_one):
            rows, first = loops[numbers], self.first_move
            move.decision[rows], move.multipliers[rows] = z, multipliers
            move.u[rows] = one_by_one(first.gain, z)
            move.u[rows] += one_by_one(first.known, known[numbers])
            move.status[rows] = Status.LIMITED

    def _known(self, vector: Array, r: Array, v: Array) -> Array:
        theta: Array = vector @ self.knowledge.from_memory.T
        if self._from_coming is not None:
            theta += self._coming(vector, r, v) @ self._from_coming.T
        return theta

    @cached_property
    def _from_coming(self) -> Array | None:
        """Gain of theta on what ``decide`` is handed; None where it does not matter."""
        both = np.hstack([self.knowledge.from_r, self.knowledge.from_v])
        return both if both.any() else None

    def _coming(self, vector: Array, r: Array, v: Array) -> Array:
        """Give what ``decide`` is handed, r first, in one row a loop."""
        loops = len(vector)
        asked = _line if self.forecast == "line" else self.forecast
        if callable(asked) and self.knowledge.from_v.any():
            v = self._ask_forecast(asked, vector)
        return np.concatenate([r.reshape(loops, -1), v.reshape(loops, -1)], axis=1)

    def _ask_forecast(
        self, forecast: Callable[[Array, int], Array], vector: Array
    ) -> Array:
        """v_k, v_{k+1}, ... of every loop, (loops, 1 + forecast_steps, n_v)."""
        latest = self.form.recipe.layout.read(vector, "v")
        steps = self.forecast_steps
        ahead = np.array([np.asarray(forecast(v, steps), float) for v in latest])
        if ahead.shape != (len(vector), steps, self.model.n_v):
            raise ValueError(
                f"forecast returned shape {ahead.shape[1:]}, expected "
                f"({steps}, {self.model.n_v})"
            )
        if not np.isfinite(ahead).all():
            raise ValueError("forecast returned values that are not finite")
        return np.concatenate([latest[:, :1], ahead], axis=1)

    def _decide_limited(self, move: Move, memory: Memory, i: int) -> None:
        """Fill in row i, where the free optimum breaks a limit."""
        before = self.last_input(memory.vector[i])
        last = memory.last
        guess = last.decision[i], last.multipliers[i]
        solution, status = self.ranked.solve(
            move.known[i],
            self._reachable(before),
            guess if last.shift[i] >= 0 else None,
        )
        if not solution.found:
            LOG.warning("%s %s", solution.status.value, solution.message)
            self._continue(move, memory, i, before)
            return
        move.decision[i] = solution.decision
        move.u[i] = self.first_move.value(solution.decision, move.known[i])
        move.status[i] = status
        move.multipliers[i] = solution.multipliers
        move.iterations[i] = solution.iterations

    def _continue(self, move: Move, memory: Memory, i: int, before: Array) -> None:
        """Fall back on the last plan, or hold the input where there is none.

        A plan that knows no reference (reading "zero") leads away from it: better hold.
        """
        aimless = self.knowledge.layout.shapes["r"][0] == 0
        last = memory.last
        if last.shift[i] < 0 or aimless:
            move.decision[i] = 0.0
            move.u[i], move.status[i], move.shift[i] = before, Status.HELD, -1
            return
        move.decision[i], move.known[i] = last.decision[i], last.known[i]
        move.shift[i], move.status[i] = last.shift[i] + 1, Status.SHIFTED
        step = min(int(move.shift[i]), self.horizon.Np - 1)
        u = self.signals["u"].value(move.decision[i], move.known[i])
        move.u[i] = u.reshape(self.horizon.Np, -1)[step]

    def _finish(self, move: Move, memory: Memory) -> Move:
        """Apply the input's limits once more and state the cost."""
        clipped = self.clip(move.u, self.last_input(memory.vector))
        if not np.array_equal(clipped, move.u):
            cut = np.abs(clipped - move.u).max(axis=-1) > 1e-6
            move.status[cut & (move.status < Status.CLIPPED)] = Status.CLIPPED
            move.u[:] = clipped
        move.cost[:] = self.program.cost(move.decision, move.known)
        return move

    def _reachable(self, before: Array) -> tuple[Array, Array]:
        """Bounds of the rows, level limits widened to what the rates can reach."""
        low, high = self.program.lower, self.program.upper
        if self._within(before):
            return low, high
        low, high = low.copy(), high.copy()
        for row, (name, channel, step) in enumerate(self.program.labels):
            if name == "u":
                moves = 1 + np.searchsorted(self._move_steps, step)
                slowest, fastest = (side[channel] for side in self.limits_du)
                high[row] = max(high[row], before[channel] + moves * slowest)
                low[row] = min(low[row], before[channel] + moves * fastest)
        return low, high

    def _within(self, u: Array) -> Array:
        """Whether inputs (..., n_u) keep the level limits, (...)."""
        low, high = self.limits_u
        within: Array = np.all((u >= low) & (u <= high), axis=-1)
        return within

    @cached_property
    def _move_steps(self) -> Array:
        return np.unique([row.step for row in self.program.labels if row.name == "u"])


def _line(latest: Array, steps: int) -> Array:
    """Go on as the latest two values went, (steps, n_v)."""
    ahead: Array = np.arange(1.0, steps + 1.0)[:, None] * (latest[0] - latest[1])
    return latest[0] + ahead


def _close(u: Array, side: Array) -> Array:
    """As ``numpy.isclose`` for finite inputs, and much faster."""
    close: Array = np.abs(u - side) <= 1e-8 + 1e-5 * np.abs(side)
    return close


def _cut(solution: Solution, n_z: int, multipliers: Array) -> Solution:
    """Solution without slack variables and with multipliers for the original rows."""
    return Solution(
        solution.decision[:n_z],
        multipliers,
        solution.status,
        solution.iterations,
        solution.residual,
        solution.message,
    )


def limit(name: str, signal: Affine, sides: tuple[Array, Array], steps: Array) -> Limit:
    """Limit with the same sides (n,) at each of the steps."""
    low, high = sides
    return Limit(
        name,
        signal,
        np.tile(low, len(steps)),
        np.tile(high, len(steps)),
        len(low),
        steps,
    )


def output_ranks(program: QuadraticProgram, limits: Limits, n_y: int) -> Array:
    """Order in which output and terminal rows give way; -1 for input rows."""
    ranks = limits.ranks(n_y)
    last = int(ranks.max()) + 1
    order = {"y": lambda row: int(ranks[row.channel]), "terminal": lambda row: last}
    return np.array(
        [order[row.name](row) if row.name in order else -1 for row in program.labels],
        dtype=int,
    )
