r"""Regions of the known vector in which a program's solution is one affine map.

While the same rows are held at the same limits, decision and multipliers of a strictly
convex program are affine in the known vector (explicit predictive control):

.. math:: \begin{bmatrix} H & M_a' \\ M_a & 0 \end{bmatrix}
          \begin{bmatrix} z \\ \lambda \end{bmatrix}
          = \begin{bmatrix} -f\theta \\ b_a - offset_a\,\theta \end{bmatrix}

Instead of all regions, of which there are far too many, only those are kept that a
solver came upon: loops of an ensemble share most of them, and a single loop meets them
again (``nmss_lab.laws``).
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

ROUNDING = 1e-12
"""Error of a region up to which its answers need not be looked at one by one."""

Answer = tuple[Array, Array, Array]
"""Numbers of known vectors (found,), decisions (found, n_z), multipliers."""


@dataclass(frozen=True, eq=False)
class Region:
    """Solution of a program while certain rows are held, for any known vector.

    Parameters
    ----------
    program : QuadraticProgram
    held : integer array (rows,)
        1 for rows held by their upper limit, -1 by the lower one, else 0.
    solution : array (n_z + rows, n_theta + 1)
        Decision and multipliers as a map of [theta; 1].
    test : array (tested, n_theta + 1)
        What must be positive inside, as such a map: the room of each limit of a row
        that is not held, less its slack, and the multipliers of the held rows, with
        the sign of the side that holds them.
    signed : int
        How many rows of the test are multipliers; they come first.
    tested, instead : integer arrays (tested,), (tested,)
        The row of the program that each test is about, and how it is held beyond: let
        go where its multiplier has the wrong sign, held where its room is used up.
    error : float
        Largest violation of the equations above that rounding leaves, relative to the
        size of their terms.
    """

    program: QuadraticProgram
    held: Array
    solution: Array
    test: Array
    signed: int
    tested: Array
    instead: Array
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
        if self.error <= ROUNDING:
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
    push, M = program.push[:, rows], program.M[rows]
    moved = M @ push
    if not _independent(moved):
        return None
    edge = np.where(held > 0.0, program.upper, program.lower)[rows]
    z = _affine(program.bare)
    forces = np.linalg.solve(moved, _affine(program.bare_rows[rows], -edge))
    z -= push @ forces
    known = np.concatenate([_affine(program.f), _affine(program.offset[rows], -edge)])
    kkt = np.block([[program.H, M.T], [M, np.zeros((len(rows), len(rows)))]])
    both = np.concatenate([z, forces])
    error = _error(kkt, both, known)
    if error > 1e-1 * ROUNDING:  # held rows leave little of what was subtracted
        left = kkt @ both + known
        alone = program.inverse @ left[: program.n_z]
        more = np.linalg.solve(moved, left[program.n_z :] - M @ alone)
        both -= np.concatenate([alone + push @ more, -more])
        error = _error(kkt, both, known)
    z, forces = both[: program.n_z], both[program.n_z :]
    value = program.M @ z
    value[:, :-1] += program.offset
    solution = np.zeros((program.n_z + len(held), z.shape[1]))
    solution[: program.n_z], solution[program.n_z + rows] = z, forces
    one_sided = rows[~equal[rows]]  # multipliers of an equality may have either sign
    signs = np.sign(held).astype(np.int8)
    signed = signs[one_sided][:, None] * forces[~equal[rows]]
    room, tested, instead = _room(program, value, np.delete(np.arange(len(held)), rows))
    return Region(
        program,
        signs,
        solution,
        np.concatenate([signed, room]),
        len(signed),
        np.concatenate([one_sided, tested]),
        np.concatenate([np.zeros(len(signed), np.int8), instead]),
        error,
    )


def _error(kkt: Array, both: Array, known: Array) -> float:
    """Violation of the equations, relative to the size of their terms."""
    left = np.abs(kkt @ both + known).sum(axis=1)
    terms = (np.abs(kkt) @ np.abs(both) + np.abs(known)).sum(axis=1)
    return float((left / np.where(terms > 0.0, terms, 1.0)).max(initial=0.0))


def _independent(pushed: Array) -> bool:
    """Whether held rows can be moved independently, from what they move each other."""
    try:
        alone = np.linalg.cholesky(pushed).diagonal() ** 2
    except np.linalg.LinAlgError:
        return False
    return bool((alone > 1e-10 * pushed.diagonal()).all())


def _affine(gain: Array, constant: Array | float = 0.0) -> Array:
    """Map of [theta; 1]."""
    full = np.empty((gain.shape[0], gain.shape[1] + 1))
    full[:, :-1], full[:, -1] = gain, constant
    return full


def _room(
    program: QuadraticProgram, value: Array, rows: Array
) -> tuple[Array, Array, Array]:
    """Room of rows to their finite limits, less the slack, and which limits it is to.

    ``value`` is a map of [theta; 1], as the room is.
    """
    slack = program.slack[rows]
    below, above = value[rows], -value[rows]
    below[:, -1] -= program.lower[rows] + slack
    above[:, -1] += program.upper[rows] - slack
    room = np.concatenate([below, above])
    sides = np.repeat(np.array([-1, 1], np.int8), len(rows))
    finite = np.isfinite(room[:, -1])
    return room[finite], np.tile(rows, 2)[finite], sides[finite]


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
