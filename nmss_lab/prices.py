"""Shadow prices: what the limits that hold a plan cost, and what more room would buy.

Where the rows held by limits stay the same, optimum and multipliers are affine in the
limits, so both can be told without solving anything again (see Boyd and Vandenberghe,
Convex Optimization, section 5.6).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from nmss_lab.controller import Status
from nmss_lab.models import Array
from nmss_lab.predictive import PredictiveController
from nmss_lab.qp import QuadraticProgram, Row
from nmss_lab.sdp import StateDependentGovernor
from nmss_lab.sdp_mpc import StateDependentController
from nmss_lab.simulate import Run

VARYING = StateDependentController, StateDependentGovernor
"""Controllers whose program changes with the plan: only its cost is told."""


@dataclass(frozen=True, eq=False)
class Price:
    """What a limit that holds a plan costs.

    Parameters
    ----------
    row : Row
        Signal ("u", "du", "y", ...), channel and step of the horizon, from 0.
    upper : bool
        Whether it is the upper limit, rather than the lower one.
    limit : float
        Where the limit is, in the signal's unit.
    saving : float
        Fall of the sample's cost J for a unit more room, at the margin: twice the
        multiplier.
    move : array (n_u,)
        Change of u_k for a unit more room; nan for a state-dependent plant.
    up_to : float
        Room up to which the same limits hold, so that ``move`` is exact; nan for a
        state-dependent plant.
    """

    row: Row
    upper: bool
    limit: float
    saving: float
    move: Array
    up_to: float


def prices(run: Run, k: int) -> list[Price]:
    """Prices of the limits that hold the plan of sample k, the highest first.

    Parameters
    ----------
    run : Run
    k : int
        Sample.

    Returns
    -------
    list of Price
        Empty where no limit holds the plan, where the plan is an older one, and for
        controllers that make none.

    Raises
    ------
    ValueError
        If the run has no such sample.
    """
    if not 0 <= k < len(run):
        raise ValueError(f"k = {k}: the run has samples 0 to {len(run) - 1}")
    controller = run.controller
    if not isinstance(controller, PredictiveController) or run.moves is None:
        return []
    if run.status[k] in (Status.SHIFTED, Status.HELD):
        return []
    multipliers = run.multipliers[k]
    held = np.flatnonzero(multipliers)
    n_u = controller.model.n_u
    moves, room = np.full((n_u, len(held)), np.nan), np.full(len(held), np.nan)
    if held.size and not isinstance(controller, VARYING):
        moves, room = _more_room(controller, run, k, held)
    program = controller.program
    found = [
        Price(
            program.labels[i],
            bool(multipliers[i] > 0.0),
            float((program.upper if multipliers[i] > 0.0 else program.lower)[i]),
            2.0 * abs(float(multipliers[i])),
            moves[:, j],
            float(room[j]),
        )
        for j, i in enumerate(held)
    ]
    return sorted(found, key=lambda price: -price.saving)


def _more_room(
    controller: PredictiveController, run: Run, k: int, held: Array
) -> tuple[Array, Array]:
    """Find moves for a unit more room in each held row, and how far these hold.

    The held rows, M z + offset theta = limit, stay equalities while one limit gives
    way; other rows may become active, and multipliers zero, which ends it.
    """
    assert run.moves is not None
    program, multipliers = controller.program, run.multipliers[k]
    sign = np.sign(multipliers[held]).astype(np.int8)
    known = KNOWN.setdefault(program, {})
    key = held.tobytes() + sign.tobytes()
    if key not in known:
        known[key] = _response(program, held, sign)
    found = known[key]
    z, theta, free = run.moves.decision[k], run.moves.known[k], found.free
    value = program.M[free] @ z + program.offset[free] @ theta
    small = 1e-12 * (1.0 + np.abs(program.M).max(initial=0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        up = (program.upper[free] - value)[:, None] / found.slope
        down = (program.lower[free] - value)[:, None] / found.slope
        rises, falls = found.slope > small, found.slope < -small
        reach = np.where(rises, up, np.where(falls, down, np.inf))
        turns = -multipliers[held][:, None] / found.drop
        meets = found.drop * multipliers[held][:, None] < 0.0
        turns = np.where(meets, turns, np.inf)
    ends = np.concatenate([reach, turns]).min(axis=0)
    return controller.first_move.gain @ found.change, np.maximum(ends, 0.0)


class _Response(NamedTuple):
    """What a unit more room in each held row changes.

    Decision (n_z, held), multipliers (held, held) and the other rows (free, held).
    """

    change: Array
    drop: Array
    slope: Array
    free: Array


KNOWN: WeakKeyDictionary[QuadraticProgram, dict[bytes, _Response]] = WeakKeyDictionary()
"""Responses by the rows that are held, which samples share; gone with the program."""


def _response(program: QuadraticProgram, held: Array, sign: Array) -> _Response:
    push = program.push[:, held]
    inverse = np.linalg.pinv(program.M[held] @ push, hermitian=True)
    change = push @ inverse * sign
    free = np.setdiff1d(np.arange(len(program.labels)), held)
    return _Response(change, -inverse * sign, program.M[free] @ change, free)
