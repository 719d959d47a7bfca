"""Proportional-integral-plus control: gains, and the law with limits (3.4), (3.13)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy.linalg
import scipy.signal

from nmss_lab.controller import Controller, Limits, Memory, Move, Status
from nmss_lab.models import Array, DifferenceModel, Numbers
from nmss_lab.nmss import Form, incremental_pip_form, integral_of_error_form
from nmss_lab.qp import weight


@dataclass(frozen=True, eq=False)
class StateFeedback(Controller):
    """Law u = -K x, or u_k = u_{k-1} - K x when the form is driven by changes.

    Levels and rates of the input are clipped, outputs are not looked at.  Build it
    with ``pip``.

    Parameters
    ----------
    model, form, limits : see ``Controller``
    K : array (n_u, n_x)
    anti_windup : bool
        Whether the sum of the error follows the input that was really applied.
    """

    K: Array
    anti_windup: bool = True

    def free_law(self) -> tuple[Array, Array]:
        """Gains of the law on the memory (n_u, n_m), and on r (none)."""
        law = -self.K @ self.form.recipe.state
        if self.form.drive == "du":
            law = law + self.form.recipe.layout.select("u")[: self.model.n_u]
        return law, np.zeros((self.model.n_u, self.model.n_y))

    def _decide(self, memory: Memory, r: Array, v: Array) -> Move:
        on_memory, _ = self.free_law()
        before = self.last_input(memory.vector)
        wanted = memory.vector @ on_memory.T
        u = self.clip(wanted, before)
        cut = np.abs(u - wanted).max(axis=-1) > 1e-9
        status = np.where(cut, Status.CLIPPED, Status.FREE)
        return self._move(u, r, status=status)

    def _missed(self, memory: Memory, u: Array, move: Move) -> Array:
        """Way from what the law asked for to the applied input, unless windup is on."""
        asked = self._free_move(memory.vector, np.zeros_like(move.w))
        return np.where(self.anti_windup, u - asked, 0.0)


def pip(
    model: DifferenceModel,
    K: Numbers,
    limits: Limits | None = None,
    law: Literal["incremental", "positional"] = "incremental",
    path: Literal["feedback", "forward"] = "feedback",
    anti_windup: bool = True,
) -> StateFeedback:
    """PIP controller with the gain K (n_u, n_x) on the state of (3.2).

    Parameters
    ----------
    model : DifferenceModel
    K : array (n_u, n_x)
        From ``pole_gain`` or ``lq_gain``.
    limits : Limits, optional
        Levels and rates of the input; output limits are ignored.
    law : "incremental" or "positional"
        Incremental (3.13, corrected) sums changes of the input from the one that was
        applied, so nothing winds up; positional is (3.4).
    path : "feedback" or "forward"
        Forward path takes past outputs from an internal model; incremental only.
    anti_windup : bool
        For the positional law: let the sum of the error follow the applied input.

    Raises
    ------
    ValueError
        If K has a wrong shape or the positional law is asked for the forward path.
    """
    if law not in ("incremental", "positional") or path not in ("feedback", "forward"):
        raise ValueError(
            f'law = "{law}", path = "{path}": expected "incremental" or "positional", '
            '"feedback" or "forward"'
        )
    if law == "positional" and path == "forward":
        raise ValueError('path = "forward" needs law = "incremental"')
    incremental = law == "incremental"
    form = (
        incremental_pip_form(model, internal_model=path == "forward")
        if incremental
        else integral_of_error_form(model)
    )
    K = gain("K", K, form)
    return StateFeedback(model, form, limits or Limits(), K, anti_windup)


def lq_gain(model: DifferenceModel, Q: Any, R: Any) -> Array:
    """PIP-LQ gain (n_u, n_x) for the cost sum of x'Qx + u'Ru.

    Parameters
    ----------
    Q, R : weights of the state of (3.2) and of the inputs
        See ``nmss_lab.mpc.state_weight`` for (5.6).

    Raises
    ------
    ValueError
        If a weight has a wrong shape or no stabilising solution exists.
    """
    form = integral_of_error_form(model)
    Q, R = weight("Q", Q, 1, form.n_x), weight("R", R, 1, model.n_u)
    check_signs(Q, R)
    P = lq_cost(form.A, form.B, Q, R)
    K: Array = np.linalg.solve(R + form.B.T @ P @ form.B, form.B.T @ P @ form.A)
    return K


def check_signs(Q: Array, R: Array) -> None:
    """Check that Q has no negative eigenvalue and R only positive ones.

    Raises
    ------
    ValueError
        Naming the weight, with its smallest eigenvalue.
    """
    for name, matrix, least in (("Q", Q, -1e-12), ("R", R, 1e-12)):
        smallest = float(np.linalg.eigvalsh(matrix)[0])
        if smallest < least * max(1.0, np.abs(matrix).max()):
            wanted = "not be negative" if name == "Q" else "be positive"
            raise ValueError(
                f"{name} has the eigenvalue {smallest:.4g}; all of them must {wanted}"
            )


def lq_cost(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Infinite-horizon cost matrix P of x'Qx + u'Ru.

    Raises
    ------
    ValueError
        If the Riccati equation has no stabilising solution.
    """
    problem = (
        "the LQ problem has no stabilising solution: an unstable mode is not reached "
        "by the input or not seen by the weights"
    )
    try:
        P: Array = scipy.linalg.solve_discrete_are(A, B, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError(f"{problem} ({error})") from error
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    largest = float(np.abs(np.linalg.eigvals(A - B @ K)).max())
    if largest > 1.0 - 1e-7:  # rounding may hide a mode on the unit circle
        raise ValueError(f"{problem} (largest pole {largest:.6f})")
    return P


def pole_gain(model: DifferenceModel, poles: Sequence[complex]) -> Array:
    """PIP gain (n_u, n_x) that places the closed-loop poles, repeated ones too.

    Parameters
    ----------
    model : DifferenceModel
    poles : sequence of n_x numbers
        Complex ones in conjugate pairs.

    Raises
    ------
    ValueError
        If their number is not n_x, pairs are incomplete, a fixed pole cannot be moved,
        or the poles cannot be placed accurately.

    Examples
    --------
    The gain of section 3.4, two poles at the origin and two at 0.2:

    >>> model = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
    >>> pole_gain(model, [0.0, 0.0, 0.2, 0.2]).round(2)
    array([[ 3.16, -3.05,  6.1 , -0.64]])
    """
    form = integral_of_error_form(model)
    wanted = check_poles(poles, form.n_x)
    polynomial = np.poly(wanted)
    if form.controllable_rank() < form.n_x:
        raise ValueError(
            f"the input reaches {form.controllable_rank()} of {form.n_x} states: the "
            "model has a common factor or more past values than it needs, with fixed "
            f"poles at {np.round(form.fixed_poles(), 4).tolist()} and at the origin"
        )
    K = _place(form, wanted, polynomial.real)
    error = np.abs(np.poly(form.A - form.B @ K) - polynomial.real).max()
    if error > 1e-6 * np.abs(polynomial).max():
        raise ValueError(
            f"the poles cannot be placed accurately: coefficients of the polynomial "
            f"miss by {error:.2g}; use fewer repeated poles, or lq_gain"
        )
    return K


def check_poles(poles: Sequence[complex], n_x: int) -> Array:
    """Poles as an array (n_x,), complex.

    Raises
    ------
    ValueError
        If their number is not n_x or pairs are incomplete.
    """
    try:
        wanted = np.asarray(poles, dtype=complex)
    except (TypeError, ValueError) as error:
        raise ValueError(f"poles = {poles!r}: expected {n_x} numbers") from error
    if wanted.shape != (n_x,):
        raise ValueError(
            f"poles has shape {wanted.shape}, expected ({n_x},): n_y (na + 1) + "
            "n_u (nb - 1) numbers"
        )
    if not np.isfinite(wanted).all() or np.abs(np.poly(wanted).imag).max() > 1e-9:
        raise ValueError(
            "poles must be finite, and complex ones come in conjugate pairs"
        )
    return wanted


def _place(form: Form, wanted: Array, polynomial: Array) -> Array:
    _, counts = np.unique(np.round(wanted, 9), return_counts=True)
    if form.n_u > 1 and counts.max() <= form.n_u:
        placed = scipy.signal.place_poles(form.A, form.B, wanted)
        gain_matrix: Array = placed.gain_matrix
        return gain_matrix
    if form.n_u == 1:
        return _ackermann(form.A, form.B, polynomial)
    # More repetitions than inputs: steer all inputs along one direction, after a
    # feedback that makes that direction reach every state.
    rng = np.random.default_rng(0)
    before = 0.1 * rng.standard_normal((form.n_u, form.n_x))
    along = rng.standard_normal((form.n_u, 1))
    inner = form.A - form.B @ before
    return before + along @ _ackermann(inner, form.B @ along, polynomial)


def _ackermann(A: Array, b: Array, polynomial: Array) -> Array:
    """Gain of a single input from the characteristic polynomial, high power first."""
    n = A.shape[0]
    columns = [b]
    for _ in range(n - 1):
        columns.append(A @ columns[-1])
    value = np.zeros((n, n))
    for coefficient in polynomial:
        value = value @ A + coefficient * np.eye(n)
    last = np.linalg.solve(np.hstack(columns).T, np.eye(n)[-1])
    return (last @ value)[None]


def gain(name: str, value: Any, form: Form) -> Array:
    """Check a state feedback gain (n_u, n_x).

    Raises
    ------
    ValueError
        If it has another shape or is not finite.
    """
    K = np.atleast_2d(np.asarray(value, dtype=float))
    if K.shape != (form.n_u, form.n_x):
        raise ValueError(
            f"{name} has shape {K.shape}, expected ({form.n_u}, {form.n_x}): a row an "
            "input, a column a state"
        )
    if not np.isfinite(K).all():
        raise ValueError(f"{name} holds entries that are not finite")
    return K
