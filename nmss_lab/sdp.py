"""State-dependent PIP control and a governor over it (thesis 8.2).

At each sample the plant is frozen: its coefficients are taken as they are now, and a
gain is designed for them.  Where the input has next to no effect no gain exists, or it
is enormous; such samples are guarded, and the move says so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from nmss_lab.controller import Controller, Limits, Memory, Move, Status
from nmss_lab.governor import ReferenceGovernor, governor
from nmss_lab.models import Array, DifferenceModel
from nmss_lab.nmss import (
    Form,
    Layout,
    incremental_pip_form,
    integral_of_error_form,
)
from nmss_lab.pip import check_poles, check_signs, lq_gain, pole_gain
from nmss_lab.predict import Horizon, known_part
from nmss_lab.predictive import Knowledge, PredictiveController
from nmss_lab.qp import QuadraticProgram, Row, find_backend, weight
from nmss_lab.state_dependent import StateDependentModel

NOT_LINEAR = (
    "the plant's coefficients vary, so its controller is no linear law: analyse it by "
    "simulation, or analyse model.frozen(...) at a point"
)


@dataclass(frozen=True, eq=False)
class FrozenGain:
    """Gain on the state of (3.2), designed anew for the coefficients of each sample.

    Parameters
    ----------
    equation : StateDependentModel
    design : function DifferenceModel -> gain (n_u, n_x)
        Raises ValueError where there is none.
    largest : float
        Entries beyond it count as no gain.
    """

    equation: StateDependentModel
    design: Callable[[DifferenceModel], Array]
    largest: float

    def at(self, form: Form, vector: Array) -> tuple[DifferenceModel, Array] | None:
        """Wide frozen model and gain on the wide state; None where there is none.

        ``vector`` is a memory after measuring; u_k is not known yet, and u_{k-1}
        stands in for it where coefficients depend on it.
        """
        eq, layout = self.equation, form.recipe.layout
        y = layout.read(vector, "y")[: eq.y_lags]
        u = layout.read(vector, "u")
        u = np.concatenate([u[:1], u])[: eq.u_lags]
        try:
            with np.errstate(all="ignore"):
                frozen = eq.frozen(y, u)
                K = self.design(frozen)
        except ValueError:  # no controllable model here
            return None
        if not np.abs(K).max() <= self.largest:
            return None
        return widened(eq, frozen), K @ np.eye(form.n_x)[thesis_state(eq, form.n_x)]


def widened(equation: StateDependentModel, frozen: DifferenceModel) -> DifferenceModel:
    """Frozen model with as many past values as the equation's coefficients read."""
    a, b = equation.wide.a.copy(), equation.wide.b.copy()
    a[: frozen.na], b[: frozen.nb] = frozen.a, frozen.b
    return equation.model_of(a, b)


def thesis_state(equation: StateDependentModel, n_x: int) -> Array:
    """Where the state of (3.2) stands in that of the wide model, integers.

    ``n_x`` is the size of the wide state, whose last n_y entries are the sum.
    """
    p, q = equation.n_y, equation.n_u
    past_u = equation.y_lags * p + np.arange((equation.nb - 1) * q)
    integral = np.arange(n_x - p, n_x)
    return np.concatenate([np.arange(equation.na * p), past_u, integral])


def follow(layout: Layout, vector: Array, missed: Array, law: Array) -> Array:
    """Change the sum of the error so that a law moves by ``missed``.

    Parameters
    ----------
    layout : Layout
    vector : array (..., n_m)
    missed : array (..., n_u)
    law : array (..., n_u, n_y)
        Gain of the law on the sum; where it is zero the sum stays.
    """
    moved = np.array(vector)
    change = np.linalg.pinv(law, rcond=1e-9) @ missed[..., None]
    moved[..., layout["integral"]] += change[..., 0]
    return moved


@dataclass(frozen=True, eq=False)
class StateDependentFeedback(Controller):
    """Law u_k = -K_k x_k with a gain for each sample; build it with ``sdp_pip``.

    Parameters
    ----------
    model, form, limits : see ``Controller``
        The model gives sizes and names only.
    frozen_gain : FrozenGain
    anti_windup : bool
    """

    frozen_gain: FrozenGain
    anti_windup: bool = True

    @property
    def n_theta(self) -> int:
        """Length of the known vector: the gain."""
        return self.form.n_u * self.form.n_x

    def free_law(self) -> tuple[Array, Array]:
        """Refuse: the law is not linear."""
        raise ValueError(NOT_LINEAR)

    def _decide(self, memory: Memory, r: Array, v: Array) -> Move:
        loops, before = len(memory.vector), self.last_input(memory.vector)
        x = memory.vector @ self.form.recipe.state.T
        wanted, status = before.copy(), np.full(loops, int(Status.FREE))
        gains = np.zeros((loops, self.form.n_u, self.form.n_x))
        for i, vector in enumerate(memory.vector):
            found = self.frozen_gain.at(self.form, vector)
            if found is None:
                status[i] = Status.GUARDED
                continue
            gains[i] = found[1]
            start = before[i] if self.form.drive == "du" else 0.0
            wanted[i] = start - gains[i] @ x[i]
        u = self.clip(wanted, before)
        cut = np.abs(u - wanted).max(axis=-1) > 1e-9
        status[cut & (status == Status.FREE)] = Status.CLIPPED
        return self._move(u, r, status=status, known=gains.reshape(loops, -1))

    def _followed(self, memory: Memory, u: Array, move: Move) -> Array:
        if not self.anti_windup:
            return memory.vector
        K = move.known.reshape(*move.known.shape[:-1], self.form.n_u, self.form.n_x)
        x = memory.vector @ self.form.recipe.state.T
        missed = u + (K @ x[..., None])[..., 0]
        layout, p = self.form.recipe.layout, self.model.n_y
        return follow(layout, memory.vector, missed, -K[..., -p:])

    def _balanced(self, vector: Array, y: Array, u: Array) -> Array:
        found = self.frozen_gain.at(self.form, vector)
        return vector if found is None else _balanced(self.form, vector, u, found[1])

    def _expected(self, vector: Array) -> Array:
        return expected(self.frozen_gain.equation, self.form.recipe.layout, vector)


def _balanced(form: Form, vector: Array, u: Array, K: Array) -> Array:
    missed = u + K @ (form.recipe.state @ vector)
    return follow(form.recipe.layout, vector, missed, -K[:, -form.n_y :])


def expected(equation: StateDependentModel, layout: Layout, vector: Array) -> Array:
    """y_k that the equation and what it missed last give, (..., n_y).

    ``vector`` (..., n_m) is a memory before y_k is measured.
    """
    newest = layout.read(vector, "y")[..., 0, :]
    value = _equation_at(equation, layout, vector, 0)
    value = value + missed_by(equation, layout, vector, 1)
    return np.where(np.isfinite(value), value, newest)


def missed_by(
    equation: StateDependentModel, layout: Layout, vector: Array, age: int = 0
) -> Array:
    """Find what the equation misses of the newest output in a memory, (..., n_y).

    After measuring ``age`` is 0, before it is 1: the newest input is then one sample
    younger than what the newest output follows from.
    """
    newest = layout.read(vector, "y")[..., 0, :]
    missed = newest - _equation_at(equation, layout, vector, 1, age)
    return np.where(np.isfinite(missed), missed, 0.0)


def _equation_at(
    equation: StateDependentModel,
    layout: Layout,
    vector: Array,
    from_y: int,
    from_u: int = 0,
) -> Array:
    """Output that the equation gives, the first few entries of the past left out."""
    y = layout.read(vector, "y")[..., from_y : from_y + equation.y_lags, :]
    u = layout.read(vector, "u")[..., from_u : from_u + equation.u_lags, :]
    with np.errstate(all="ignore"):
        return equation.step(y, u)


def _gain_of(
    model: StateDependentModel,
    poles: Sequence[complex] | None,
    Q: Any,
    R: Any,
    largest: float,
) -> FrozenGain:
    """Check which design is meant, and that it is one.

    Raises
    ------
    ValueError
        Unless either poles or both weights are given, or if they can be no design for
        any plant.
    """
    check_equation(model)
    if not largest > 0:
        raise ValueError(f"largest_gain = {largest} must be positive")
    by_weights = Q is not None and R is not None
    if (poles is not None) == by_weights or (Q is None) != (R is None):
        raise ValueError("give either poles, or both weights Q and R")
    size = (model.na + 1) * model.n_y + (model.nb - 1) * model.n_u
    if by_weights:
        Q, R = weight("Q", Q, 1, size), weight("R", R, 1, model.n_u)
        check_signs(Q, R)
        return FrozenGain(model, _Weighed(Q, R), largest)
    wanted = check_poles(poles or (), size)
    return FrozenGain(model, _Placed(tuple(wanted)), largest)


def check_equation(model: Any) -> None:
    """Check that a model is a state-dependent one.

    Raises
    ------
    ValueError
        If it is something else.
    """
    if not isinstance(model, StateDependentModel):
        raise ValueError(
            f"model is a {type(model).__name__}, expected a StateDependentModel; for a "
            "DifferenceModel take the function without sdp_"
        )


def _checked(limits: Limits | None, model: StateDependentModel) -> Limits:
    """Limits that fit the model."""
    limits = limits or Limits()
    for name, size in (("u", model.n_u), ("du", model.n_u), ("y", model.n_y)):
        limits.of(name, size)  # type: ignore[arg-type]
    return limits


@dataclass(frozen=True)
class _Placed:
    poles: tuple[complex, ...]

    def __call__(self, frozen: DifferenceModel) -> Array:
        return pole_gain(frozen, self.poles)


@dataclass(frozen=True)
class _Weighed:
    Q: Any
    R: Any

    def __call__(self, frozen: DifferenceModel) -> Array:
        return lq_gain(frozen, self.Q, self.R)


LARGEST_GAIN = 1e3


def sdp_pip(
    model: StateDependentModel,
    poles: Sequence[complex] | None = None,
    Q: Any = None,
    R: Any = None,
    limits: Limits | None = None,
    law: Literal["positional", "incremental"] = "positional",
    anti_windup: bool = True,
    largest_gain: float = LARGEST_GAIN,
) -> StateDependentFeedback:
    """PIP control of a state-dependent plant, (8.3): a gain for each sample.

    Parameters
    ----------
    model : StateDependentModel
    poles : sequence of n_x numbers
        Closed-loop poles of each frozen model; or
    Q, R : weights of the state of (3.2) and of the inputs
        for the LQ gain of each frozen model.
    limits : Limits, optional
        Levels and rates of the input; output limits are ignored.
    law : "positional" or "incremental"
        Positional, u = -K x, with a sum of the error that follows the applied input.
        The incremental (3.13) with a gain that varies is *another* law: it sums
        changes that were weighed with different gains, and overshoots in 8.5.1.
    anti_windup : bool
        Whether the sum follows the applied input (positional law).
    largest_gain : float
        Where an entry of the gain would be larger, or the frozen model cannot be
        controlled, the input is held and the move's status is GUARDED.

    Raises
    ------
    ValueError
        If poles and weights are both given or both missing, or an option is unknown.
    """
    if law not in ("positional", "incremental"):
        raise ValueError(f'law = "{law}": expected "positional" or "incremental"')
    gain = _gain_of(model, poles, Q, R, largest_gain)
    limits = _checked(limits, model)
    make = integral_of_error_form if law == "positional" else incremental_pip_form
    return StateDependentFeedback(
        model.wide, make(model.wide), limits, gain, anti_windup
    )


@dataclass(frozen=True, eq=False)
class StateDependentGovernor(PredictiveController):
    """Reference governor over the gain of each sample; build it with ``sdp_governor``.

    Parameters
    ----------
    frozen_gain : FrozenGain
    reading : "held" or "preview"
    """

    frozen_gain: FrozenGain = field(kw_only=True)
    reading: Literal["held", "preview"] = field(kw_only=True, default="held")

    @property
    def causal(self) -> bool:
        """Whether w_k is chosen at k."""
        return self.reading == "held"

    @property
    def governs_ahead(self) -> int:
        """0 when w_k is chosen at k, 1 when w_{k+1} is."""
        return int(not self.causal)

    @property
    def follows_laws(self) -> bool:
        """Never: the program is another at each sample."""
        return False

    def free_law(self) -> tuple[Array, Array]:
        """Refuse: the law is not linear."""
        raise ValueError(NOT_LINEAR)

    def _decide(self, memory: Memory, r: Array, v: Array) -> Move:
        loops = len(memory.vector)
        ahead = r[:, self.governs_ahead].copy()
        move = self._move(np.zeros((loops, self.model.n_u)), r, governed=ahead)
        for i in range(loops):
            self._decide_one(move, memory, r[i], i)
        move.u[:] = self.clip(move.u, self.last_input(memory.vector))
        return move

    def _decide_one(self, move: Move, memory: Memory, r: Array, i: int) -> None:
        before = self.last_input(memory.vector[i])
        found = self.frozen_gain.at(self.form, memory.vector[i])
        if found is None:
            move.u[i], move.status[i], move.shift[i] = before, Status.GUARDED, -1
            return
        frozen, K = found
        layout, known = self.knowledge.layout, move.known[i]
        inner = self._governor(frozen, K)
        chosen = inner.decide(inner._fresh(memory.vector[i]), r)
        known[layout["K"]] = K.ravel()
        if chosen.status >= Status.SHIFTED:
            self._continue(move, memory, i, before)
            move.known[i, layout["K"]] = K.ravel()
            return
        for name in self.signals:
            known[layout[f"plan_{name}"]] = inner.plan(chosen, name).ravel()
        for name in ("u", "w", "governed", "decision", "status", "cost", "iterations"):
            getattr(move, name)[i] = getattr(chosen, name)
        where = {label: row for row, label in enumerate(self.program.labels)}
        for row, multiplier in zip(
            inner.program.labels, chosen.multipliers, strict=True
        ):
            move.multipliers[i, where[row]] = multiplier

    def _governor(self, frozen: DifferenceModel, K: Array) -> ReferenceGovernor:
        return governor(
            frozen, K, self.horizon.Np, self.limits, self.reading, backend=self.backend
        )

    def _followed(self, memory: Memory, u: Array, move: Move) -> Array:
        layout, p = self.form.recipe.layout, self.model.n_y
        K = self.knowledge.layout.read(move.known, "K")
        x = memory.vector @ self.form.recipe.state.T
        if self.causal:
            x = x + move.governed @ self.form.D.T
        missed = u + (K @ x[..., None])[..., 0]
        return follow(layout, memory.vector, missed, -K[..., -p:])

    def _balanced(self, vector: Array, y: Array, u: Array) -> Array:
        found = self.frozen_gain.at(self.form, vector)
        if found is None:
            return vector
        ahead = y if self.causal else np.zeros_like(y)  # w enters before u is decided
        u = u + found[1] @ (self.form.D @ ahead)
        return _balanced(self.form, vector, u, found[1])

    def _expected(self, vector: Array) -> Array:
        return expected(self.frozen_gain.equation, self.form.recipe.layout, vector)


def sdp_governor(
    model: StateDependentModel,
    poles: Sequence[complex] | None = None,
    Q: Any = None,
    R: Any = None,
    Np: int = 10,
    limits: Limits | None = None,
    reference: Literal["held", "preview"] = "held",
    largest_gain: float = LARGEST_GAIN,
    backend: str = "daqp",
) -> StateDependentGovernor:
    """Build a reference governor over state-dependent PIP control (8.2).

    The closed loop of the frozen model has the same poles at each sample; the rows on
    the input use the gain of the present one along the horizon.

    Parameters
    ----------
    model, poles, Q, R, largest_gain : see ``sdp_pip``
    Np : int
        Samples over which the limits are looked at.
    limits : Limits
        On u, du and y.
    reference : "held" or "preview"
        See ``nmss_lab.governor.governor``.
    backend : str

    Raises
    ------
    ValueError
        As ``sdp_pip``, or if an argument is out of range.
    """
    if reference not in ("held", "preview"):
        raise ValueError(f'reference = "{reference}": expected "held" or "preview"')
    find_backend(backend)
    gain = _gain_of(model, poles, Q, R, largest_gain)
    radius = max((abs(pole) for pole in np.ravel(poles or ())), default=0.0)
    if radius >= 1.0:
        raise ValueError(
            f"poles: the largest has modulus {radius:.4f}; a governor needs a loop "
            "that is stable, all of them less than 1"
        )
    limits, horizon = _checked(limits, model), Horizon(Np, Np)
    form = integral_of_error_form(model.wide, governed=True)
    p, q = model.n_y, model.n_u
    sizes = {"u": q, "du": q, "y": p, "w": p, "beta": p}
    layout = Layout(
        **{f"plan_{name}": (Np, size) for name, size in sizes.items()},
        r=(1, p),
        K=(q, form.n_x),
    )
    ahead = 1 if reference == "held" else 1 + Np
    knowledge = Knowledge(
        layout,
        np.zeros((layout.size, form.recipe.layout.size)),
        np.zeros((layout.size, ahead * p)),
        np.zeros((layout.size, 0)),
    )
    program = _rows_only(limits, Np, p, q, layout.size)
    ranks = np.array([int(row.name == "y") for row in program.labels], dtype=int)
    return StateDependentGovernor(
        model.wide,
        form,
        limits,
        horizon,
        program,
        {name: known_part(layout, f"plan_{name}", Np * p) for name in sizes},
        knowledge,
        ranks,
        backend,
        frozen_gain=gain,
        reading=reference,
    )


def _rows_only(
    limits: Limits, Np: int, p: int, q: int, n_theta: int
) -> QuadraticProgram:
    """Program that says which rows there are; its numbers are those of each sample."""
    labels, sides = [], []
    for name, size in (("u", q), ("du", q), ("y", p)):
        low, high = limits.of(name, size)  # type: ignore[arg-type]
        for step in range(Np):
            for channel in np.flatnonzero(np.isfinite(low) | np.isfinite(high)):
                labels.append(Row(name, int(channel), step))
                sides.append((low[channel], high[channel]))
    lower, upper = np.array(sides).reshape(-1, 2).T
    n_z, rows = Np * p, len(labels)
    return QuadraticProgram(
        np.eye(n_z),
        np.zeros((n_z, n_theta)),
        np.zeros((n_theta, n_theta)),
        np.zeros((rows, n_z)),
        np.zeros((rows, n_theta)),
        lower,
        upper,
        tuple(labels),
    )
