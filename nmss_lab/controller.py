"""What every controller shares: limits, memory, moves, and the promises it keeps.

A controller is a frozen design.  What changes from sample to sample is its ``Memory``,
handed in and returned, so one design serves many loops at once:

>>> # memory = controller.start()
>>> # each sample:  memory = controller.measure(memory, y, r)
>>> #               move = controller.decide(memory)
>>> #               memory = controller.apply(memory, applied_u, move)

All of ``Memory`` and ``Move`` may carry a leading axis, one row a loop.
"""

from __future__ import annotations

import dataclasses
import enum
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from nmss_lab.laws import Law
from nmss_lab.models import Array, DifferenceModel
from nmss_lab.nmss import Form

Pair = tuple[Any, Any]
Softening = Literal["hard", "soft", "priority"]


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits on inputs, their change per sample, and outputs.

    Parameters
    ----------
    u, du, y : pair (low, high)
        Numbers for all channels or arrays with one entry a channel, in the signal's
        units; infinite where there is no limit.  ``du`` must allow zero.
    outputs : "hard", "soft" or "priority"
        What happens to output limits.  Hard ones are dropped for the samples at which
        they cannot be kept (6.1.2); soft ones may be broken at a quadratic price;
        with priorities, the least important give way first and by as little as
        possible.
    soft_weight : float
        Price of one squared unit of violation when ``outputs = "soft"``.
    priority : tuple of int
        Rank of each output, 1 the most important, when ``outputs = "priority"``.

    Raises
    ------
    ValueError
        If a limit is not a number, low exceeds high, or ``du`` excludes zero.
    """

    u: Pair = (-np.inf, np.inf)
    du: Pair = (-np.inf, np.inf)
    y: Pair = (-np.inf, np.inf)
    outputs: Softening = "hard"
    soft_weight: float = 1e4
    priority: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Check each pair of limits."""
        for name in ("u", "du", "y"):
            low, high = (np.asarray(side, dtype=float) for side in getattr(self, name))
            if np.isnan(low).any() or np.isnan(high).any():
                raise ValueError(f"limits on {name}: {low} to {high} are not numbers")
            if (low > high).any():
                raise ValueError(
                    f"limits on {name}: the low side {low} exceeds the high side {high}"
                )
            if name == "du" and ((low > 0).any() or (high < 0).any()):
                raise ValueError(
                    f"limits on du: {low} to {high} exclude zero, so no input could "
                    "ever come to rest"
                )
        if self.outputs not in ("hard", "soft", "priority"):
            raise ValueError(
                f'outputs = "{self.outputs}": expected "hard", "soft" or "priority"'
            )
        if not self.soft_weight > 0:
            raise ValueError(f"soft_weight = {self.soft_weight} must be positive")

    def of(self, name: Literal["u", "du", "y"], size: int) -> tuple[Array, Array]:
        """Lower and upper limits of a signal, each (size,).

        Raises
        ------
        ValueError
            If there are not as many limits as channels.
        """
        sides = [np.asarray(side, dtype=float) for side in getattr(self, name)]
        for side in sides:
            if side.ndim > 1 or (side.ndim == 1 and side.shape[0] not in (1, size)):
                raise ValueError(
                    f"limits on {name} have shape {side.shape}, expected a number or "
                    f"({size},), one entry a channel"
                )
        low, high = (np.broadcast_to(side, (size,)).copy() for side in sides)
        return low, high

    def ranks(self, n_y: int) -> Array:
        """Priority of each output, (n_y,); all equal when none is given.

        Raises
        ------
        ValueError
            If there are not as many ranks as outputs.
        """
        ranks = np.array(self.priority or (1,) * n_y)
        if ranks.shape != (n_y,):
            raise ValueError(
                f"priority = {self.priority}: expected {n_y} ranks, one an output"
            )
        return ranks


class Status(enum.IntEnum):
    """How a move came about; ``sentence`` says it in words.

    Up to 7 higher is worse; from 8 on are those of plants whose parameters vary.
    """

    FREE = 0
    LIMITED = 1
    SOFTENED = 2
    DROPPED = 3
    CLIPPED = 4
    REFUSED = 5
    SHIFTED = 6
    HELD = 7
    AMBIGUOUS = 8
    UNSETTLED = 9
    OUT_OF_TIME = 10
    CYCLED = 11
    DIVERGED = 12
    GUARDED = 13

    @property
    def sentence(self) -> str:
        """The status in plain words."""
        return _SENTENCES[self]


_SENTENCES = {
    Status.FREE: "No limit is active: the linear law was applied.",
    Status.LIMITED: "A limit is active in the plan: the quadratic program was solved.",
    Status.SOFTENED: "Limits could not all be kept: some were relaxed.",
    Status.DROPPED: "Output limits (or the terminal equality) could not be kept: they "
    "were dropped this sample.",
    Status.CLIPPED: "The law asked for more than the input can do: it was clipped.",
    Status.REFUSED: "A measurement was not a number: its prediction stood in for it.",
    Status.SHIFTED: "The solver failed: the last plan was continued and clipped.",
    Status.HELD: "There was no plan worth continuing: the last input was held.",
    Status.AMBIGUOUS: "A plan of the opposite sign costs the same: one was chosen.",
    Status.UNSETTLED: "Passes ran out before the predictions settled: the best plan so "
    "far was applied.",
    Status.OUT_OF_TIME: "Time ran out before the predictions settled: the best plan so "
    "far was applied.",
    Status.CYCLED: "The predictions swing between two plans: the better one was "
    "applied.",
    Status.DIVERGED: "The predictions ran away: the best plan so far was applied.",
    Status.GUARDED: "The input has next to no effect here: it was held.",
}


@dataclass(eq=False, slots=True)
class Move:
    """Decision of one sample.

    Parameters
    ----------
    u : array (..., n_u)
        Input to apply; within the limits on u and du, finite.
    w : array (..., n_y)
        Reference in force at this sample: the governed one under a governor.
    governed : array (..., n_y)
        Reference that enters the sum of the error when the move is applied.
    decision, known : arrays (..., n_z), (..., n_theta)
        Optimal decision and what it was made from: signals of the plan are
        ``controller.signals[name].value(decision, known)``.
    status : integer array (...)
        Code of ``Status``.
    cost : array (...)
        Optimal cost J of the sample, in the weights' units.
    multipliers : array (..., rows)
        Multiplier of each row of the program: positive where an upper limit holds it,
        negative where a lower one does, zero elsewhere.  One unit more of a limit
        changes the cost J by twice its multiplier.
    iterations : integer array (...)
    shift : integer array (...)
        Age of the plan in samples: 0 when it was made now, -1 when there is none.
    law : Law, optional
        The law that gave the move of a single loop, where one did.
    """

    u: Array
    w: Array
    governed: Array
    decision: Array
    known: Array
    status: Array
    cost: Array
    multipliers: Array
    iterations: Array
    shift: Array
    law: Law | None = field(default=None, init=False)

    @property
    def active(self) -> Array:
        """Rows held by a limit, (..., rows) of bool."""
        return self.multipliers != 0.0

    @property
    def sentence(self) -> str:
        """Status of a single move in plain words."""
        return Status(int(self.status)).sentence


@dataclass(eq=False, slots=True)
class Memory:
    """All that changes in a controller from sample to sample; never changed itself.

    Parameters
    ----------
    vector : array (..., n_m)
        Histories, laid out by the form's recipe.
    refused : bool array (...)
        Whether the latest measurement was not finite.
    last : Move
        The last move: a plan to fall back on, and to start the next from.
    """

    vector: Array
    refused: Array
    last: Move


@dataclass(frozen=True, eq=False)
class Controller(ABC):
    """Base of all controllers: keeps the memory, leaves the decision to subclasses.

    Parameters
    ----------
    model : DifferenceModel
        Model the design rests on.
    form : Form
        State and how it is remembered.
    limits : Limits
    """

    model: DifferenceModel
    form: Form
    limits: Limits

    @property
    def n_z(self) -> int:
        """Length of the decision that a memory keeps; 0 without a plan."""
        return 0

    @property
    def n_theta(self) -> int:
        """Length of the known vector that a memory keeps."""
        return 0

    @property
    def n_rows(self) -> int:
        """Number of limited rows whose multipliers a memory keeps."""
        return 0

    @property
    def preview(self) -> int:
        """How many samples of r beyond r_k ``decide`` reads."""
        return 0

    @property
    def forecast_steps(self) -> int:
        """How many samples of v beyond v_k ``decide`` reads."""
        return 0

    @property
    def governs_ahead(self) -> int:
        """Samples between a decision and the reference that ``Move.governed`` is."""
        return 0

    @cached_property
    def limits_u(self) -> tuple[Array, Array]:
        """Level limits (n_u,) each."""
        return self.limits.of("u", self.model.n_u)

    @cached_property
    def limits_du(self) -> tuple[Array, Array]:
        """Rate limits (n_u,) each."""
        return self.limits.of("du", self.model.n_u)

    @abstractmethod
    def free_law(self) -> tuple[Array, Array]:
        """First move without limits: gains on the memory (n_u, n_m) and on r.

        The second gain, (n_u, (1 + preview) n_y), acts on r_k, r_{k+1}, ... as far as
        ``decide`` is handed them.
        """

    @abstractmethod
    def _decide(self, memory: Memory, r: Array, v: Array) -> Move:
        """Decide for memories with a leading axis of loops."""

    def _move(self, u: Array, r: Array, **parts: Array) -> Move:
        """Move without a plan for inputs u (loops, n_u); ``parts`` replace the rest."""
        loops = len(u)
        plain: dict[str, Array] = {
            "w": r[:, 0].copy(),
            "governed": r[:, 0].copy(),
            "decision": np.zeros((loops, self.n_z)),
            "known": np.zeros((loops, self.n_theta)),
            "status": np.full(loops, int(Status.FREE)),
            "cost": np.zeros(loops),
            "multipliers": np.zeros((loops, self.n_rows)),
            "iterations": np.zeros(loops, dtype=int),
            "shift": np.full(loops, 0 if self.n_z else -1),
        }
        return Move(u, **{**plain, **parts})

    def together(self) -> Controller:
        """Return the controller that decides for an ensemble; this one by default."""
        return self

    def start(
        self,
        y0: Array | None = None,
        u0: Array | None = None,
        v0: Array | None = None,
        r0: Array | None = None,
        z0: Array | None = None,
    ) -> Memory:
        """Memory for a past in which y, u and v were constant (zero by default).

        With a past that is not zero, the sum of the error is chosen so that the law
        asks for u0: switching on is bumpless; ``z0`` (n_y,) sets it instead.

        Raises
        ------
        ValueError
            If a size does not fit or a value is not finite.
        """
        model, layout = self.model, self.form.recipe.layout
        y = signal("y0", y0, model.n_y)
        u = signal("u0", u0, model.n_u)
        v = signal("v0", v0, model.n_v)
        r = signal("r0", r0, model.n_y)
        past = {"y": y, "u": u, "v": v, "r": y, "y_model": y, "u_model": u, "w": r}
        parts = {
            name: np.broadcast_to(value, layout.shapes[name])
            for name, value in past.items()
            if name in layout
        }
        vector = layout.pack(**parts)
        if "estimate" in layout:
            vector[layout["estimate"]] = self._estimate_at_rest(y)
        if "integral" in layout and z0 is not None:
            vector[layout["integral"]] = signal("z0", z0, model.n_y)
        elif "integral" in layout and (np.any(y) or np.any(u)):
            vector = self._balanced(vector, y, u)
            if "w" in layout:  # measuring takes y off, and w is added on applying
                vector[layout["integral"]] += y
        return self._fresh(vector)

    def _fresh(self, vector: Array) -> Memory:
        """Memory without a plan."""
        none = np.zeros((1, self.model.n_u)), np.zeros((1, 1, self.model.n_y))
        last = self._move(*none, shift=np.array([-1]))
        return Memory(vector, np.array(False), _single(last))

    def _balanced(self, vector: Array, y: Array, u: Array) -> Array:
        """Memory at rest at y whose sum of the error makes the law ask for u."""
        asked = self._free_move(vector, np.tile(y, 1 + self.preview))
        return self._tracked(vector, u - asked)

    def measure(
        self, memory: Memory, y: Array, r: Array, v: Array | None = None
    ) -> Memory:
        """Take in the measurements y_k (..., n_y), r_k (..., n_y) and v_k (..., n_v).

        An entry of y or v that is not finite never enters: the model's prediction of
        it, or the last v, takes its place, and the next move says so.

        Raises
        ------
        ValueError
            If a size does not fit or r is not finite.
        """
        layout, model = self.form.recipe.layout, self.model
        before = memory.vector
        y, r = _channels("y", y, model.n_y), _channels("r", r, model.n_y)
        v = layout.read(before, "v")[..., 0, :] if v is None else v
        v = _channels("v", v, model.n_v)
        parts = [before, *(_alike(part, before) for part in (y, v, r))]
        both = np.concatenate(parts, axis=-1)
        finite = np.isfinite(both[..., before.shape[-1] :])
        good = finite[..., : model.n_y + model.n_v].all(axis=-1)
        if not finite.all():
            if not np.isfinite(r).all():
                raise ValueError(f"r = {r} is not finite")
            y = np.where(np.isfinite(y), y, self._expected(before))
            v = np.where(np.isfinite(v), v, layout.read(before, "v")[..., 0, :])
            parts[1:3] = _alike(y, before), _alike(v, before)
            both = np.concatenate(parts, axis=-1)
        return Memory(both @ self._measuring.T, ~np.asarray(good), memory.last)

    @cached_property
    def _measuring(self) -> Array:
        """Memory after measuring from [memory; y_k; v_k; r_k]."""
        recipe = self.form.recipe
        return np.hstack([recipe.carry, recipe.enter])

    @cached_property
    def _applying(self) -> Array:
        """Memory after applying from [memory; u_k; u seen; governed reference]."""
        recipe = self.form.recipe
        return np.hstack([recipe.keep, recipe.store])

    def _expected(self, vector: Array) -> Array:
        """y_k (..., n_y) that the model expects, from the memory before measuring."""
        expected: Array = vector @ self.form.recipe.forecast.T
        return expected

    def decide(
        self, memory: Memory, r: Array | None = None, v: Array | None = None
    ) -> Move:
        """Choose u_k from what has been measured.

        Parameters
        ----------
        memory : Memory
            After ``measure``.
        r : array (1 + preview, n_y) or (..., 1 + preview, n_y), optional
            r_k, r_{k+1}, ... as far as the design reads ahead; r_k is held otherwise.
        v : array (1 + forecast_steps, n_v), optional
            v_k, v_{k+1}, ... when the design takes a forecast; v_k is held otherwise.

        Raises
        ------
        ValueError
            If r or v is not finite or has another shape.
        """
        single = memory.vector.ndim == 1
        many = as_ensemble(memory) if single else memory
        move = self._decide(many, *self._given(many, r, v))
        worse = many.refused & (move.status < Status.REFUSED)
        move.status[worse] = Status.REFUSED
        return _single(move) if single else move

    def _given(
        self, memory: Memory, r: Array | None, v: Array | None
    ) -> tuple[Array, Array]:
        """Give r and v from sample k on, for memories with a leading axis."""
        layout = self.form.recipe.layout
        r_now = layout.read(memory.vector, "r")
        v_now = layout.read(memory.vector, "v")[:, 0]
        return (
            _ahead("r", r, r_now, 1 + self.preview),
            _ahead("v", v, v_now, 1 + self.forecast_steps),
        )

    def apply(
        self, memory: Memory, u: Array, move: Move, seen: Array | None = None
    ) -> Memory:
        """Remember the input that was really applied.

        Parameters
        ----------
        memory : Memory
            The one ``decide`` was given.
        u : array (..., n_u)
            Input after every saturation, or set by hand.
        move : Move
            What ``decide`` returned.
        seen : array (..., n_u), optional
            Input that an internal model sees, if not u.

        Raises
        ------
        ValueError
            If a size does not fit or an input is not finite.
        """
        layout = self.form.recipe.layout
        u = _channels("u", u, self.model.n_u)
        seen = u if seen is None else _channels("seen", seen, self.model.n_u)
        if not (np.isfinite(u).all() and (seen is u or np.isfinite(seen).all())):
            raise ValueError(f"u = {u}, seen as {seen}, is not finite")
        vector = memory.vector
        if "integral" in layout:
            vector = self._followed(memory, u, move)
        applied = np.concatenate([vector, u, seen, move.governed], axis=-1)
        return Memory(applied @ self._applying.T, memory.refused, move)

    def _followed(self, memory: Memory, u: Array, move: Move) -> Array:
        """Memory vector whose sum of the error fits the applied input."""
        missed = self._missed(memory, u, move)
        return self._tracked(memory.vector, missed) if missed.any() else memory.vector

    def _missed(self, memory: Memory, u: Array, move: Move) -> Array:
        """By how much the sum of the error must move the law, (..., n_u).

        Zero while the decided input is applied; else the way from what the law without
        limits asks for to the applied input, so that nothing winds up.
        """
        r = np.tile(self.form.recipe.layout.read(memory.vector, "r"), 1 + self.preview)
        free = self._free_move(memory.vector, r)
        return np.where(self._overruled(u, free, move), u - free, 0.0)

    def _overruled(self, u: Array, free: Array, move: Move) -> Array:
        """Whether another input was applied than was decided, (..., 1)."""
        size = 1e-9 * (1.0 + np.abs(u).max(axis=-1, keepdims=True))
        other: Array = np.abs(u - move.u).max(axis=-1, keepdims=True) > size
        return other

    def clip(self, u: Array, before: Array) -> Array:
        """Nearest input within the limits, given the one before.

        Where the level cannot be reached at the allowed rate, the rate wins.
        """
        u = np.clip(u, *self.limits_u)
        low, high = self.limits_du
        clipped: Array = np.clip(u, before + low, before + high)
        return clipped

    def last_input(self, vector: Array) -> Array:
        """u_{k-1} (..., n_u) from a memory vector."""
        return self.form.recipe.layout.read(vector, "u")[..., 0, :]

    def _free_move(self, vector: Array, r: Array) -> Array:
        """Input that the law without limits asks for, r_k, r_{k+1}, ... in one row."""
        on_memory, on_r = self.free_law()
        free: Array = vector @ on_memory.T + r @ on_r.T
        return free

    def _tracked(self, vector: Array, missed: Array) -> Array:
        """Change the sum of the error so that the law moves by ``missed``."""
        tracked = np.array(vector)
        integral = self.form.recipe.layout["integral"]
        tracked[..., integral] += missed @ self._integral_inverse.T
        return tracked

    @cached_property
    def _integral_inverse(self) -> Array:
        on_memory, _ = self.free_law()
        integral = self.form.recipe.layout["integral"]
        return np.linalg.pinv(on_memory[:, integral])

    def _estimate_at_rest(self, y: Array) -> Array:
        form = self.form
        still = np.vstack([np.eye(form.n_x) - form.A, form.C])
        rest = np.concatenate([np.zeros(form.n_x), y])
        estimate: Array = np.linalg.lstsq(still, rest, rcond=None)[0]
        return estimate


def signal(name: str, value: Array | None, size: int) -> Array:
    """Check a vector of ``size`` channels; None is zero and a number fills it.

    Raises
    ------
    ValueError
        If it has another shape or is not finite.
    """
    if value is None:
        return np.zeros(size)
    array = np.asarray(value, dtype=float)
    if array.ndim > 1 or (array.ndim == 1 and array.shape[0] != size):
        raise ValueError(f"{name} has shape {array.shape}, expected ({size},)")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} = {array} is not finite")
    return np.broadcast_to(array, (size,)).copy()


def _channels(name: str, value: Any, size: int) -> Array:
    """Signals (..., size) as numbers; a plain number is one channel."""
    array = np.asarray(value, dtype=float)
    array = array if array.ndim else array[None]
    if array.shape[-1:] != (size,):
        raise ValueError(f"{name} has shape {array.shape}, expected (..., {size})")
    return array


def _alike(value: Array, memory: Array) -> Array:
    """Signals (n,) or (loops, n) with the leading axes of a memory."""
    if value.shape[:-1] == memory.shape[:-1]:
        return value
    return np.broadcast_to(value, (*memory.shape[:-1], value.shape[-1]))


def _ahead(name: str, given: Array | None, now: Array, steps: int) -> Array:
    """Values from sample k on, (loops, steps, channels); the present one is held."""
    loops, channels = now.shape
    if given is None:
        return np.broadcast_to(now[:, None], (loops, steps, channels))
    values = np.asarray(given, dtype=float)
    if values.ndim == 1:
        values = values[None]
    if values.shape[-2] < steps or values.shape[-1] != channels:
        raise ValueError(
            f"{name} has shape {values.shape}, expected (.., {steps}, {channels}): the "
            f"present value and {steps - 1} samples ahead"
        )
    if not np.isfinite(values).all():
        raise ValueError(f"{name} is not finite at every step of the horizon")
    return np.broadcast_to(values[..., :steps, :], (loops, steps, channels))


def as_ensemble(memory: Memory) -> Memory:
    """Memory of one loop with a leading axis, as an ensemble of one."""
    return stacked([memory], np.array([0]))


def stacked(memories: Sequence[Memory], rows: Array) -> Memory:
    """Memory of an ensemble whose loops start as ``rows`` of some memories say."""
    parts = zip(*(_parts(memory.last) for memory in memories), strict=True)
    return Memory(
        np.stack([memory.vector for memory in memories])[rows],
        np.stack([memory.refused for memory in memories])[rows],
        Move(*(np.stack(part)[rows] for part in parts)),
    )


def _single(move: Move) -> Move:
    """Move of the only loop, without a leading axis."""
    return Move(*(part[0] for part in _parts(move)))


def _parts(move: Move) -> list[Array]:
    names = (part.name for part in dataclasses.fields(move) if part.init)
    return [getattr(move, name) for name in names]
