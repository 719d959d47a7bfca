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
    """What a loop gets while certain rows are held, from its memory.

    All is affine in it: ``first`` gives, in this order, the tests, which must all be
    positive, u_k and the reference in force; ``rest`` the known vector, the decision
    and the multipliers of the held rows, which are needed later, if at all.  Both are
    to be multiplied by what ``Laws.point`` returns.

    Parameters
    ----------
    region : Region
    first, rest : lists of three arrays (n, points)
        Their parts, in that order.
    rows : integer array
        The held rows.
    tested, instead : integer arrays (tests,)
        See ``Region``; a row of -1 says that no other law can be right.
    limited : bool
        Whether a limit is among the held rows; terminal equalities are none.

    Attributes
    ----------
    after : dict
        The law that was right the last time the same tests of this one failed, by
        their signs.
    """

    __slots__ = (
        "after",
        "ends",
        "first",
        "instead",
        "limited",
        "program",
        "region",
        "rest",
        "rows",
        "tested",
        "tests",
        "u",
        "w",
    )

    def __init__(
        self,
        region: Region,
        first: list[Array],
        rest: list[Array],
        rows: Array,
        tested: Array,
        instead: Array,
        limited: bool,
    ) -> None:
        # by columns, which BLAS is a little faster with
        self.first, self.rest = (
            np.asfortranarray(np.concatenate(parts)) for parts in (first, rest)
        )
        ends = len(first[0]), len(first[0]) + len(first[1])
        self.tests, self.u, self.w = slice(ends[0]), slice(*ends), slice(ends[1], None)
        self.ends = len(rest[0]), len(rest[0]) + len(rest[1])
        self.region, self.program = region, region.program
        self.rows, self.limited = rows, limited
        self.tested, self.instead = tested, instead
        self.after: dict[bytes, Law] = {}

    @property
    def nbytes(self) -> int:
        """Bytes of both maps."""
        return self.first.nbytes + self.rest.nbytes

    def learn(self, signs: bytes, right: Law) -> None:
        """Note which law was right where tests had these signs."""
        if len(self.after) >= MOST:
            self.after.clear()
        self.after[signs] = right

    def known(self, point: Array) -> Array:
        """Known vector (n_theta,)."""
        known: Array = self.rest[: self.ends[0]].dot(point)
        return known

    def plan(self, point: Array) -> tuple[Array, Array, Array]:
        """Known vector, decision and the multipliers of all rows."""
        rest, (known, decided) = self.rest.dot(point), self.ends
        multipliers = np.zeros(len(self.region.held))
        multipliers[self.rows] = rest[decided:]
        return rest[:known], rest[known:decided], multipliers


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
        self.sides, self._remembered = sides, knows.shape[1]
        told = 0 if coming is None else coming.shape[1]
        self._points = self._remembered + told + 1
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

    def point(self, memory: Array, told: Array | None) -> Array:
        """[memory; what ``decide`` is handed, where it matters; 1]."""
        point = np.empty(self._points)
        point[: self._remembered] = memory
        if self.coming is not None:
            point[self._remembered : -1] = told
        point[-1] = 1.0
        return point

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
        size = 64 if law is None else law.nbytes + 64
        if len(self._kept) >= min(MOST, max(8, ROOM // size)):
            self._kept.clear()  # laws lead to one another: old ones go together
            if self.free is not None:
                self.free.after.clear()
        self._kept[key] = law
        return law

    def beyond(self, law: Law, tests: Array) -> Law | None:
        """Law of the active-set step from one whose tests are not all positive.

        None if there is no such law, or it is not known yet.
        """
        failed = tests <= 0.0
        rows = law.tested[failed]
        if not rows.size or rows.min() < 0:
            return None
        held = law.region.held.copy()
        held[rows] = law.instead[failed]
        return self._kept.get(held.tobytes())

    def asked(self, theta: Array) -> Law | None:
        """Law of the rows that a solver holds; None where there is no such law."""
        try:
            if self._solver is None:
                self._solver = Solver(self.program, self._equal)
            held = self._solver.held(theta)
        except Exception:  # the loop goes on, and asks once more where it is told
            return None
        return None if held is None else self.of(held)

    def _law(self, found: Region) -> Law:
        n_z, size = self.program.n_z, len(self.knows)
        z, forces = found.solution[:n_z], found.solution[n_z:]
        rows = np.flatnonzero((found.held != 0) | self._equal)
        tests, tested, instead = [found.test.copy()], [found.tested], [found.instead]
        tests[0][: found.signed, -1] -= HELD
        inside = found.tested[found.signed :]
        # what is planned for later may miss by the slack, as in any solution
        tests[0][found.signed :, -1] += 2.0 * self._planned[inside]
        tests.append(np.eye(1, size + 1, size))  # where there are no others: 1
        if found.signed and self.sides is not None:
            tests.append(self._within(*self.sides))
        others = sum(map(len, tests[1:]))
        tested.append(np.full(others, -1))
        instead.append(np.zeros(others, dtype=np.int8))
        if self.w is None:
            w = np.zeros((len(self.r_k), self._points))
            w[:, : self._remembered] = self.r_k
        else:
            w = self._of_point(_of(self.w, z))
        first = np.concatenate(tests), self._first_move(found, _of(self.u, z))
        rest = np.eye(size, size + 1), z, forces[rows]
        return Law(
            found,
            [*map(self._of_point, first), w],
            [*map(self._of_point, rest)],
            rows,
            np.concatenate(tested),
            np.concatenate(instead),
            found.signed > 0 or self._pinned,
        )

    def _of_point(self, signal: Array) -> Array:
        """Map of [theta; 1] as one of what ``point`` returns."""
        parts = [signal[:, :-1] @ self.knows]
        if self.coming is not None:
            parts.append(signal[:, :-1] @ self.coming)
        return np.concatenate([*parts, signal[:, -1:]], axis=1)

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
