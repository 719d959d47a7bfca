"""Affine laws: the move of a loop while the same rows of its program are held.

In each region of the known vector (``nmss_lab.regions``) move, plan, multipliers and
the room that is left are affine in what the loop remembers.  One product gives them
all, and tells whether they are right; the law without held rows is one of them.  Where
a law is not right, what it gives says which rows to hold instead: rows whose room is
used up, less those whose multiplier has the wrong sign (the primal-dual active-set
step of Hintermüller, Ito and Kunisch, SIAM J. Optim. 13, 2003).
"""

from __future__ import annotations

import importlib
import threading
from typing import Any

import numpy as np

from nmss_lab.models import Array
from nmss_lab.predict import Affine
from nmss_lab.qp import FEASIBLE, HELD, QuadraticProgram
from nmss_lab.regions import ROUNDING, Region, region

MOST, ROOM = 256, 2**24
"""Laws that are kept, and bytes that they may take."""

INPUTS = "u", "du"
"""Rows that limit the input and its change."""

LOOKS = 3
"""Known laws that are looked at until a solver is asked."""


class Law:
    """What a loop gets from its memory while certain rows are held.

    ``table @ memory + ahead @ coming + edge`` holds, in this order, the reference in
    force, u_k, the known vector, the decision, the multipliers and the tests, which
    must all be positive.

    Parameters
    ----------
    region : Region
    parts : list of arrays (n, n_theta + 1)
        The parts, in that order, as maps of [theta; 1].
    knows, coming : arrays (n_theta, n_m), (n_theta, n)
        theta from the memory, and from what is handed to ``decide``; None where that
        does not matter.
    tested, instead : integer arrays (tests,)
        See ``Region``; a row of -1 says that no other law can be right.
    limited : bool
        Whether a limit is among the held rows; terminal equalities are none.
    """

    __slots__ = (
        "after",
        "ahead",
        "changed",
        "decision",
        "edge",
        "instead",
        "known",
        "limited",
        "multipliers",
        "region",
        "table",
        "tested",
        "tests",
        "u",
        "w",
    )

    def __init__(
        self,
        region: Region,
        parts: list[Array],
        knows: Array,
        coming: Array | None,
        tested: Array,
        instead: Array,
        limited: bool,
    ) -> None:
        stacked = np.concatenate(parts)
        self.table = stacked[:, :-1] @ knows
        self.ahead = None if coming is None else stacked[:, :-1] @ coming
        self.edge = stacked[:, -1].copy()
        ends = np.cumsum([0, *(len(part) for part in parts)]).tolist()
        self.w, self.u, self.known, self.decision, self.multipliers, self.tests = (
            slice(*ends[i : i + 2]) for i in range(len(parts))
        )
        self.region, self.tested, self.instead = region, tested, instead
        self.limited = limited
        self.after: dict[bytes, Law] = {}
        self.changed: dict[bytes, Array] = {}

    def changes(self, last: Law) -> Array:
        """How many rows are held otherwise than by another law, a number."""
        key = last.region.held.tobytes()  # a law would keep all alive it led to
        if key not in self.changed:
            if len(self.changed) >= MOST:
                self.changed.clear()
            changes = np.count_nonzero(self.region.held != last.region.held)
            self.changed[key] = np.array(changes)
        return self.changed[key]

    def value(self, memory: Array, told: Array | None) -> Array:
        """All parts, for a memory vector and what ``decide`` is handed."""
        value: Array = self.table.dot(memory)
        value += self.edge
        if self.ahead is not None and told is not None:
            value += self.ahead.dot(told)
        return value


class Solver:
    """DAQP with the program of a design, asked which rows are held.

    It starts from its last solution; the answer's numbers are left to the law.
    """

    def __init__(self, program: QuadraticProgram, equal: Array) -> None:
        self.program, self.equal = program, equal
        self.upper = np.minimum(program.upper, 1e30)
        self.lower = np.maximum(program.lower, -1e30)
        self._lock = threading.Lock()  # a design serves many loops at once
        self._model = importlib.import_module("daqp").Model()
        self._told = (  # the model refers to them
            program.H.copy(),
            np.zeros(program.n_z),
            np.ascontiguousarray(program.M),
            self.upper.copy(),
            self.lower.copy(),
            np.where(equal, 5, 0).astype(np.int32),
        )
        self._model.setup(*self._told)
        self._model.settings = {"primal_tol": 1e-10, "dual_tol": 1e-12}

    def held(self, theta: Array) -> Array | None:
        """Sides that hold rows, as ``Region.held``; None if there is no solution."""
        f, known = self.program.f.dot(theta), self.program.offset.dot(theta)
        low, high = self.lower - known, self.upper - known
        with self._lock:
            self._model.update(None, f, None, high, low, None)
            _, _, flag, info = self._model.solve()
        if flag <= 0:
            return None
        multipliers = info["lam"]
        multipliers[self.equal] = 0.0  # held in any case
        least = HELD * (1.0 + np.abs(multipliers).max())
        held: Array = (multipliers > least).astype(np.int8)
        held[multipliers < -least] = -1
        return held


class Laws:
    """Laws of one design, made when a loop first needs them and kept.

    What is kept changes with use, the answers do not.

    Parameters
    ----------
    program : QuadraticProgram
    w, u : Affine
        Reference in force (n_y rows; None for the r_k of the memory) and u_k (n_u).
    r_k : array (n_y, n_m)
        Picks r_k from the memory.
    knows, coming : arrays (n_theta, n_m), (n_theta, n)
        See ``Law``.
    before : slice
        Where u_{k-1} stands in the known vector.
    sides : pair of arrays (n_u,), optional
        Limits that u_{k-1} must keep for a law with held rows to be right.
    """

    def __init__(
        self,
        program: QuadraticProgram,
        w: Affine | None,
        u: Affine,
        r_k: Array,
        knows: Array,
        coming: Array | None,
        before: slice,
        sides: tuple[Array, Array] | None,
    ) -> None:
        self.program, self.w, self.u, self.r_k = program, w, u, r_k
        self.knows, self.coming, self.before = knows, coming, before
        self.sides = sides
        labels, self._equal = program.labels, program.upper - program.lower < 1e-12
        pinned = np.flatnonzero(self._equal)
        self._pinned = any(labels[i].name != "terminal" for i in pinned)
        self._solver: Solver | None = None
        now = np.array([row.step == 0 and row.name in INPUTS for row in labels], bool)
        self._planned = np.where(now, 0.0, program.slack)
        self._kept: dict[bytes, Law | None] = {}
        self.free = self.of(np.zeros(len(program.labels), dtype=np.int8))

    def __len__(self) -> int:
        """Return how many laws are kept."""
        return len(self._kept)

    def __reduce__(self) -> tuple[Any, ...]:
        """Travel to another process without what was kept."""
        parts = self.program, self.w, self.u, self.r_k, self.knows, self.coming
        return Laws, (*parts, self.before, self.sides)

    def of(self, held: Array) -> Law | None:
        """Law while rows (signs as of multipliers, integers) are held.

        None if these rows depend on each other, or rounding would be felt.
        """
        key = held.tobytes()
        if key in self._kept:
            return self._kept[key]
        found = region(self.program, held)
        law = None
        if found is not None and found.error <= ROUNDING:
            law = self._law(found)
        size = 64 if law is None else law.table.nbytes + 64
        if len(self._kept) >= min(MOST, max(8, ROOM // size)):
            self._kept.clear()  # laws lead to one another: old ones go together
            if self.free is not None:
                self.free.after.clear()
        self._kept[key] = law
        return law

    def next(self, law: Law, tests: Array) -> Law | None:
        """Known law to look at when the tests of one are not all positive.

        The one that was right the last time the same tests failed, or that of the
        active-set step.
        """
        passed = tests > 0.0
        known = law.after.get(passed.tobytes())
        if known is not None:
            return known
        rows = law.tested[~passed]
        if not rows.size or rows.min() < 0:
            return None
        held = law.region.held.copy()
        held[rows] = law.instead[~passed]
        other = self._kept.get(held.tobytes())
        if other is not None:
            self.learn(law, tests, other)
        return other

    def asked(self, theta: Array) -> Law | None:
        """Law of the rows that a solver holds; None where there is no such law."""
        try:
            if self._solver is None:
                self._solver = Solver(self.program, self._equal)
            held = self._solver.held(theta)
        except Exception:  # the loop goes on, and asks once more where it is told
            return None
        return None if held is None else self.of(held)

    def learn(self, law: Law, tests: Array, right: Law) -> None:
        """Note which law to look at when the tests of another failed."""
        if len(law.after) >= MOST:
            law.after.clear()
        law.after[(tests > 0.0).tobytes()] = right

    def _law(self, found: Region) -> Law:
        n_z, size = self.program.n_z, len(self.knows)
        z, forces = found.solution[:n_z], found.solution[n_z:]
        u = self._first_move(found, _of(self.u, z))
        tests, tested, instead = [found.test.copy()], [found.tested], [found.instead]
        tests[0][: found.signed, -1] -= HELD
        rows = found.tested[found.signed :]
        # what is planned for later may miss by the slack, as in any solution
        tests[0][found.signed :, -1] += 2.0 * self._planned[rows]
        if found.signed and self.sides is not None:
            within = self._within(*self.sides)
            tests.append(within)
            tested.append(np.full(len(within), -1))
            instead.append(np.zeros(len(within), dtype=np.int8))
        parts = [
            np.zeros((len(self.r_k), size + 1)) if self.w is None else _of(self.w, z),
            u,
            np.eye(size, size + 1),
            z,
            forces,
            np.concatenate(tests),
        ]
        law = Law(
            found,
            parts,
            self.knows,
            self.coming,
            np.concatenate(tested),
            np.concatenate(instead),
            found.signed > 0 or self._pinned,
        )
        if self.w is None:
            law.table[law.w] = self.r_k
        return law

    def _first_move(self, found: Region, u: Array) -> Array:
        """u_k as a map of [theta; 1], exactly on a limit that holds it."""
        for row in np.flatnonzero((found.held != 0) | self._equal).tolist():
            name, channel, step = self.program.labels[row]
            if step == 0 and name in INPUTS:
                lower = found.held[row] < 0
                side = self.program.lower if lower else self.program.upper
                u[channel] = 0.0
                u[channel, -1] = side[row]
                if name == "du":
                    u[channel, self.before.start + channel] = 1.0
        return u

    def _within(self, lowest: Array, highest: Array) -> Array:
        """Room of u_{k-1} to the sides, as a map of [theta; 1]."""
        last = np.zeros((len(lowest), len(self.knows) + 1))
        last[:, self.before] = np.eye(len(lowest))
        low, high = last.copy(), -last
        low[:, -1] -= lowest - FEASIBLE * (1.0 + np.abs(lowest))
        high[:, -1] += highest + FEASIBLE * (1.0 + np.abs(highest))
        room = np.concatenate([low, high])
        return room[np.isfinite(room[:, -1])]


def _of(signal: Affine, z: Array) -> Array:
    """Signal as a map of [theta; 1] where the decision z is one."""
    value: Array = signal.gain @ z
    value[:, :-1] += signal.known
    return value
