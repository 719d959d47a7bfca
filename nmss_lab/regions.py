r"""Regions of the known vector in which a program's solution is one affine map.

While the same rows are held at the same limits, decision and multipliers of a strictly
convex program are affine in the known vector (explicit predictive control):

.. math:: \begin{bmatrix} H & M_a' \\ M_a & 0 \end{bmatrix}
          \begin{bmatrix} z \\ \lambda \end{bmatrix}
          = \begin{bmatrix} -f\theta \\ b_a - offset_a\,\theta \end{bmatrix}

Instead of all regions, of which there are far too many, only those are kept that a
solver came upon: loops of an ensemble share most of them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass

import numpy as np

from nmss_lab.models import Array
from nmss_lab.qp import (
    ACCEPTED,
    HELD,
    Problem,
    QuadraticProgram,
    kkt_residuals,
    one_by_one,
)

MOST = 256
"""Regions that are kept."""

PATIENCE = 16
"""Regions in a row that answer nothing until a solver is asked: its answer leads
straight to the right one."""

Answer = tuple[Array, Array, Array]
"""Numbers of known vectors (found,), decisions (found, n_z), multipliers."""


@dataclass(frozen=True, eq=False)
class Region:
    """Solution of a program while certain rows are held, for any known vector.

    Parameters
    ----------
    program : QuadraticProgram
    solution : array (n_z + rows, n_theta + 1)
        Decision and multipliers as a map of [theta; 1].
    test : array (tested, n_theta + 1)
        What must be positive inside, as such a map: the room of each limit of a row
        that is not held, less its slack, and the multipliers of the held rows, with
        the sign of the side that holds them.
    signed : int
        How many rows of the test are multipliers; they come first.
    error : float
        Largest violation of the equations above for known vectors of size 1, which
        rounding leaves.
    """

    program: QuadraticProgram
    solution: Array
    test: Array
    signed: int
    error: float

    def answer(self, theta: Array) -> Answer:
        """Which known vectors (loops, n_theta) belong here, and their solutions.

        A vector belongs here if all rows are kept, all multipliers have the right sign
        and the optimality conditions hold as they must for a solver's answer.  On the
        edge, where a row is neither clearly held nor clearly inside, it does not: then
        at most one region answers a vector, whichever others are known.
        """
        inside = np.flatnonzero(self._holds(theta))
        if not inside.size:
            none = np.zeros((0, len(self.solution)))
            return inside, none[:, : self.program.n_z], none[:, self.program.n_z :]
        theta = theta[inside]
        both = one_by_one(self.solution[:, :-1], theta) + self.solution[:, -1]
        z, multipliers = both[:, : self.program.n_z], both[:, self.program.n_z :]
        if self._certain(theta, multipliers):
            return inside, z, multipliers
        good = self._residuals(theta, z, multipliers) <= ACCEPTED
        return inside[good], z[good], multipliers[good]

    def _holds(self, theta: Array) -> Array:
        """Whether vectors are inside and not on the edge, (loops,)."""
        value = self.test[:, :-1] @ theta.T + self.test[:, -1:]
        largest = value[: self.signed].max(axis=0, initial=0.0)
        value[: self.signed] -= HELD * (1.0 + largest)
        holds: Array = np.all(value > 0.0, axis=0)
        return holds

    def _certain(self, theta: Array, multipliers: Array) -> bool:
        """Whether all residuals are so small that none need be looked at one by one."""
        violation = self.error * (1.0 + np.abs(theta).max(initial=0.0))
        gap = violation * (1.0 + np.abs(multipliers).max(initial=0.0))
        return bool(gap <= 1e-2 * ACCEPTED)

    def _residuals(self, theta: Array, z: Array, multipliers: Array) -> Array:
        program, columns = self.program, theta.T
        known = program.offset @ columns
        low, high = (side[:, None] - known for side in (program.lower, program.upper))
        problem = Problem(program.H, program.f @ columns, program.M, low, high)
        return kkt_residuals(problem, z.T.copy(), multipliers.T.copy())


def region(program: QuadraticProgram, held: Array) -> Region | None:
    """Region in which rows are held; None if the held ones depend on each other.

    Parameters
    ----------
    program : QuadraticProgram
    held : array (rows,)
        Positive for rows held by their upper limit, negative for the lower one, else
        zero, as multipliers are.  Rows with equal limits are held in any case.
    """
    equal = program.upper - program.lower < 1e-12
    rows = np.flatnonzero((held != 0.0) | equal)
    M, n_z, size = program.M[rows], program.n_z, len(rows)
    if np.linalg.matrix_rank(M) < size:
        return None
    edge = np.where(held > 0.0, program.upper, program.lower)[rows]
    kkt = np.block([[program.H, M.T], [M, np.zeros((size, size))]])
    known = np.concatenate([program.f, program.offset[rows]])
    right = np.column_stack([-known, np.pad(edge, (n_z, 0))])
    both = np.linalg.solve(kkt, right)
    error = np.abs(kkt @ both - right).sum(axis=1).max()
    solution = np.zeros((n_z + len(held), both.shape[1]))
    solution[:n_z], solution[n_z + rows] = both[:n_z], both[n_z:]
    one_sided = ~equal[rows]  # multipliers of an equality may have either sign
    signs = (np.sign(held[rows])[:, None] * both[n_z:])[one_sided]
    room = _room(program, both[:n_z], np.delete(np.arange(len(held)), rows))
    test = np.concatenate([signs, room])
    return Region(program, solution, test, len(signs), float(error))


def _room(program: QuadraticProgram, z: Array, rows: Array) -> Array:
    """Room of rows to their finite limits, less the slack, as a map of [theta; 1]."""
    value = program.M[rows] @ z
    value[:, :-1] += program.offset[rows]
    below, above = value.copy(), -value
    below[:, -1] -= program.lower[rows] + program.slack[rows]
    above[:, -1] += program.upper[rows] - program.slack[rows]
    room: Array = np.concatenate([below, above])
    return room[np.isfinite(room[:, -1])]


def _without(numbers: Array, places: Array) -> Array:
    """As ``numpy.delete``, but faster."""
    left = np.ones(len(numbers), dtype=bool)
    left[places] = False
    return numbers[left]


class Regions:
    """Regions that a solver came upon, at most ``most`` of them.

    What is kept changes with use, the answers do not: at most one region has one, and
    it does not matter who taught it.  Only which loops had to be solved tells.

    Parameters
    ----------
    program : QuadraticProgram
    most : int
        When there are more, those that answered the fewest go.
    """

    def __init__(self, program: QuadraticProgram, most: int = MOST) -> None:
        self.program, self.most = program, most
        self._kept: dict[bytes, Region] = {}

    def __len__(self) -> int:
        """Return how many regions are kept."""
        return len(self._kept)

    def answers(
        self, theta: Array, solve: Callable[[int], Array | None]
    ) -> Iterator[Answer]:
        """Answer known vectors (loops, n_theta) together.

        Parameters
        ----------
        theta : array (loops, n_theta)
        solve : function of a loop's number
            Called for a loop that no region answers.  Deals with it, and returns the
            multipliers if all rows were kept, which may teach a new region: that is
            tried on the waiting loops at once.

        Yields
        ------
        numbers, decisions, multipliers : arrays (found, ...)
            Also of a loop that was solved, if its region is kept, so that no answer
            depends on which loop was the first.
        """
        used: Counter[bytes] = Counter()
        waiting = yield from self._known(theta, used)
        while waiting.size:
            answer = self._taught(theta[waiting], solve(int(waiting[0])), used)
            if answer is None:
                waiting = waiting[1:]
                continue
            yield waiting[answer[0]], *answer[1:]
            waiting = _without(waiting, answer[0])
        order = sorted(self._kept, key=used.__getitem__, reverse=True)
        self._kept = {key: self._kept[key] for key in order}

    def _known(
        self, theta: Array, used: Counter[bytes]
    ) -> Generator[Answer, None, Array]:
        """Answer by the regions that are kept; return the numbers of the others."""
        waiting, misses = np.arange(len(theta)), 0
        for key, known in self._kept.items():
            if misses == PATIENCE or not waiting.size:
                break
            found, z, multipliers = known.answer(theta[waiting])
            misses = 0 if found.size else misses + 1
            if found.size:
                used[key] = found.size
                yield waiting[found], z, multipliers
                waiting = _without(waiting, found)
        return waiting

    def _taught(
        self, theta: Array, multipliers: Array | None, used: Counter[bytes]
    ) -> Answer | None:
        """Answer by the region of a solution; None if it does not hold the first."""
        if multipliers is None:
            return None
        key = np.sign(multipliers).astype(np.int8).tobytes()
        new = self._kept.get(key) or region(self.program, multipliers)
        if new is None or 0 not in (answer := new.answer(theta))[0]:
            return None
        if key not in self._kept and len(self._kept) >= self.most:
            del self._kept[min(reversed(self._kept), key=used.__getitem__)]
        self._kept[key] = new
        used[key] += len(answer[0])
        return answer
