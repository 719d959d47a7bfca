r"""Analysis of the loop without active limits: poles, T, S_i, S_o, and a review.

Memory, law and plant are linear, so the whole loop is one linear system, built from
the same matrices that the simulation runs:

.. math:: \xi_{k+1} = A \xi_k + \sum_i B_r^{(i)} r_{k+i} + B_u d_{u,k} + B_y d_{y,k},
          \qquad y_k = C \xi_k + d_{y,k}

with the plant's state and the controller's memory in :math:`\xi`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize

from nmss_lab.controller import Controller
from nmss_lab.models import (
    Array,
    DifferenceModel,
    LinearPlant,
    minimal_realisation,
    sort_by_size,
)
from nmss_lab.predictive import PredictiveController

Transfer = Literal["T", "S_i", "S_o", "T_o"]

ROUNDING = 1e-8
"""A pole this close to the unit circle counts as on it."""

OFFSET_FREE = 1e-6
"""Errors below this after a unit step count as none."""

NEAR = 1e-6
"""Frequencies this close to a pole are looked at one by one: it may cancel."""


class Peak(NamedTuple):
    """Largest gain over all frequencies up to Nyquist's, and where, in rad/s."""

    gain: float
    omega: float


@dataclass(frozen=True, eq=False)
class LinearLoop:
    """A closed loop without active limits, as one linear system.

    Build it with ``linear_loop``.

    Parameters
    ----------
    A, C : arrays (n, n), (n_y, n)
    B_r : array (1 + preview, n, n_y)
        Effect of r_k, r_{k+1}, ...
    B_u, B_y : arrays (n, n_u), (n, n_y)
        Effect of disturbances at the plant's input and output.
    dt : float
    """

    A: Array
    C: Array
    B_r: Array
    B_u: Array
    B_y: Array
    dt: float

    @cached_property
    def poles(self) -> Array:
        """All poles, the largest first; histories add poles at the origin."""
        return sort_by_size(np.linalg.eigvals(self.A))

    @property
    def radius(self) -> float:
        """Modulus of the largest pole."""
        return float(np.abs(self.poles[0]))

    @property
    def is_stable(self) -> bool:
        """Whether all poles lie inside the unit circle, by more than rounding."""
        return self.radius < 1.0 - ROUNDING

    @cached_property
    def hidden_modes(self) -> Array:
        """Poles which the response to the reference does not show, 0.05 off the origin.

        The forward path keeps every open-loop pole of its model as a hidden mode: they
        cancel in T(z) when the model is exact, and come to light with a disturbance.
        """
        left = list(self.poles)
        for pole in self.poles_of("T"):
            left.pop(int(np.argmin(np.abs(np.array(left) - pole))))
        hidden = np.array(left)
        # Histories put many poles at the origin, which rounding spreads by up to 0.02.
        return hidden[np.abs(hidden) > 0.05]

    def poles_of(self, which: Transfer) -> Array:
        """Poles that one transfer shows: those its input reaches and y tells of."""
        name = "S_o" if which == "T_o" else which  # T_o = I - S_o has the same
        if name not in self._poles_of:
            B = np.hstack(list(self.B_r)) if name == "T" else self._input(name, 1.0)
            shown = minimal_realisation(self.A, B, self.C)[0]
            self._poles_of[name] = np.linalg.eigvals(shown)
        return self._poles_of[name]

    @cached_property
    def _poles_of(self) -> dict[Transfer, Array]:
        """Poles that transfers show, as far as somebody has asked."""
        return {}

    def comes_to_rest(self, which: Transfer) -> bool:
        """Whether the response to a step of that input settles, hidden modes aside."""
        poles = self.poles_of(which)
        return float(np.abs(poles).max(initial=0.0)) < 1.0 - ROUNDING

    def offset(self, which: Transfer) -> float:
        """Error that a unit step leaves, the largest entry; inf if y never settles.

        T(1) - I of a reference, S_i(1) and S_o(1) of disturbances.
        """
        if not self.comes_to_rest(which):
            return np.inf
        wanted = np.eye(len(self.C)) if which in ("T", "T_o") else 0.0
        return float(np.abs(self.transfer(which, 1.0) - wanted).max())

    def transfer(self, which: Transfer, z: complex) -> Array:
        """Transfer matrix at ``z``: "T" from r, "S_i" from d_u, "S_o" from d_y to y.

        (4.18), (4.20), (4.21) and (6.5)-(6.7) for every structure; "T_o" is the
        complementary sensitivity I - S_o.  A pole at ``z`` that cancels is left out;
        one that does not gives infinite entries.
        """
        B = self._input(which, z)
        direct = np.eye(len(self.C)) if which == "S_o" else 0.0
        at_z = _evaluate(self.A, B, self.C, z) + direct
        return at_z.real if np.isreal(z) else at_z

    def frequency_response(self, which: Transfer, omega: Array) -> Array:
        """Transfer matrices (len(omega), n_y, .) at angular frequencies in rad/s."""
        triangle, basis = self._schur
        rows, left = self.C @ basis, basis.conj().T
        direct = np.eye(len(self.C)) if which == "S_o" else 0.0
        size, found = np.eye(len(triangle)), []
        for z in np.exp(1j * np.asarray(omega) * self.dt):
            if np.abs(np.diag(triangle) - z).min() < NEAR:
                found.append(self.transfer(which, z))
                continue
            B = left @ self._input(which, z)
            solved = scipy.linalg.solve_triangular(z * size - triangle, B)
            found.append(rows @ solved + direct)
        return np.stack(found)

    def singular_values(self, which: Transfer, omega: Array) -> Array:
        """Gains (len(omega), .) at angular frequencies in rad/s, the largest first.

        Of one output and one input the modulus of the frequency response; of several
        they depend on the units of the signals.
        """
        response = self.frequency_response(which, omega)
        there = np.array([np.isfinite(each).all() for each in response])
        gains = np.linalg.svd(np.where(there[:, None, None], response, 0.0))[1]
        return np.where(there[:, None], gains, np.inf)

    def peak(self, which: Transfer) -> Peak:
        """Largest singular value over all frequencies: the norm of the transfer.

        Infinite where its response does not come to rest.
        """
        nyquist, poles = np.pi / self.dt, self.poles_of(which)
        if not self.comes_to_rest(which):
            worst = poles[np.argmax(np.abs(poles))]
            return Peak(np.inf, float(np.abs(np.angle(worst))) / self.dt)
        own = np.log(poles[np.abs(poles) > 0.3]) / self.dt  # where it may resonate
        own = np.clip(np.concatenate([np.abs(own), np.abs(own.imag)]), 0.0, nyquist)
        omega = np.union1d(np.geomspace(1e-4, 1.0, 200) * nyquist, own[own > 0.0])

        def negative(log_omega: float) -> float:
            at = np.exp([log_omega])
            return -float(self.singular_values(which, at)[0, 0])

        best = Peak(0.0, 0.0)
        gains = self.singular_values(which, omega)[:, 0]
        inner = np.pad(gains, 1, constant_values=-1.0)
        tops = np.flatnonzero((gains >= inner[:-2]) & (gains >= inner[2:]))
        for top in tops[np.argsort(gains[tops])][-3:]:
            best = max(best, Peak(float(gains[top]), float(omega[top])))
            low, high = omega[max(top - 1, 0)], omega[min(top + 1, len(omega) - 1)]
            found = scipy.optimize.minimize_scalar(
                negative,
                bounds=(float(np.log(low)), float(np.log(high))),
                method="bounded",
                options={"xatol": 1e-8},
            )
            best = max(best, Peak(-float(found.fun), float(np.exp(found.x))))
        return best

    @cached_property
    def _schur(self) -> tuple[Array, Array]:
        """Triangular form and its basis: one for all frequencies."""
        triangle, basis = scipy.linalg.schur(self.A, output="complex")
        return triangle, basis

    def _input(self, which: Transfer, z: complex) -> Array:
        if which == "S_i":
            return self.B_u
        if which == "S_o":
            return self.B_y
        if which == "T_o":
            return -self.B_y
        if which != "T":
            raise ValueError(f'which = "{which}": expected "T", "S_i", "S_o" or "T_o"')
        ahead = z ** np.arange(len(self.B_r))
        return np.tensordot(ahead, self.B_r, axes=1)


def _evaluate(A: Array, B: Array, C: Array, z: complex) -> Array:
    pencil = z * np.eye(len(A)) - A
    if np.linalg.cond(pencil) < 1e11:
        at_z: Array = C @ np.linalg.solve(pencil, B)
        return at_z
    columns = B.shape[1]
    real = np.hstack([B.real, B.imag]) if np.iscomplexobj(B) else B
    A, B, C = minimal_realisation(A, real, C)
    B = B[:, :columns] + 1j * B[:, columns:] if B.shape[1] > columns else B
    pencil = z * np.eye(len(A)) - A
    if len(A) and np.linalg.cond(pencil) >= 1e11:
        return np.full((len(C), columns), np.inf)
    return np.asarray(C @ np.linalg.solve(pencil, B))


def linear_loop(
    controller: Controller,
    plant: LinearPlant | DifferenceModel | None = None,
    seen: bool = False,
) -> LinearLoop:
    """Close the loop around a plant, with no limit active.

    Parameters
    ----------
    controller : Controller
    plant : LinearPlant or DifferenceModel, optional
        The controller's own model if absent.
    seen : bool
        Whether a disturbance at the plant's input also drives the internal model of a
        forward path: printed (6.6) needs it, a real disturbance seldom does.

    Raises
    ------
    ValueError
        If the plant is not linear, or its size differs from the model's.
    """
    model = controller.model
    plant = model if plant is None else plant
    plant = plant.plant() if isinstance(plant, DifferenceModel) else plant
    if not isinstance(plant, LinearPlant):
        raise ValueError(
            f"plant is a {type(plant).__name__}, expected a LinearPlant or "
            "DifferenceModel: only a linear loop has poles"
        )
    if (plant.n_y, plant.n_u) != (model.n_y, model.n_u):
        raise ValueError(
            f"the plant has {plant.n_y} outputs and {plant.n_u} inputs, the "
            f"controller's model {model.n_y} and {model.n_u}"
        )
    p, q, n_x = model.n_y, model.n_u, plant.n_x
    recipe = controller.form.recipe
    law, on_r = controller.free_law()
    enter_y, enter_r = recipe.enter[:, :p], recipe.enter[:, -p:]
    store_u, store_seen = recipe.store[:, :q], recipe.store[:, q : 2 * q]
    store_both, governed = store_u + store_seen, recipe.store[:, 2 * q :]
    # What happens after measuring, in terms of the memory m+ and the move u:
    # m <- keep m+ + store_both u,  x <- A x + B u.
    after = np.vstack([plant.B @ law, recipe.keep + store_both @ law])
    A = np.hstack([after @ enter_y @ plant.C, after @ recipe.carry])
    A[:n_x, :n_x] += plant.A
    by_u = np.vstack([plant.B, store_both])
    B_r = np.stack([by_u @ on_r[:, i : i + p] for i in range(0, on_r.shape[1], p)])
    B_r[0] += after @ enter_r
    B_r[controller.governs_ahead, n_x:] += governed
    B_u = np.vstack([plant.B, store_seen if seen else 0.0 * store_seen])
    C = np.hstack([plant.C, np.zeros((p, recipe.layout.size))])
    return LinearLoop(A, C, B_r, B_u, after @ enter_y, plant.dt)


@dataclass(frozen=True, eq=False)
class ControlPolynomials:
    r"""Polynomial form of the law on a non-minimal state: (6.4) and Figure 4.1.

    .. math:: L(z) u_k = \frac{K_I}{1 - z^{-1}} (r_k - y_k) - P(z) y_k

    for structures on changes (6.4); with an integral-of-error state the law adds
    -R(z) r.  ``P`` (na, n_u, n_y) and ``L`` (nb, n_u, n_u) hold coefficients of z^0,
    z^-1, ...; ``L[0]`` is the identity, and ``K_I`` (n_u, n_y) the integral gain.
    """

    P: Array
    L: Array
    K_I: Array


def control_polynomials(controller: PredictiveController) -> ControlPolynomials:
    """Polynomials of a law on past outputs, past inputs and an integral.

    Raises
    ------
    ValueError
        If the structure has another state, as with an observer.
    """
    model = controller.model
    n_past_y, n_past_u = model.na * model.n_y, (model.nb - 1) * model.n_u
    K = controller.gain("x")
    if K.shape[1] != n_past_y + n_past_u + model.n_y:
        raise ValueError(
            "this structure's state is not [past outputs, past inputs, integral]: it "
            "has no polynomials P, L and K_I"
        )
    P = K[:, :n_past_y].reshape(model.n_u, model.na, model.n_y).transpose(1, 0, 2)
    past_u = K[:, n_past_y : n_past_y + n_past_u]
    L = past_u.reshape(model.n_u, model.nb - 1, model.n_u).transpose(1, 0, 2)
    K_I = K[:, n_past_y + n_past_u :]
    sign = -1.0 if controller.form.drive == "u" else 1.0
    return ControlPolynomials(
        P, np.concatenate([np.eye(model.n_u)[None], L]), sign * K_I
    )


Verdict = Literal["good", "note", "bad"]


@dataclass(frozen=True)
class Finding:
    """One sentence of a review: its topic, how serious it is, and what was found."""

    topic: str
    verdict: Verdict
    sentence: str


@dataclass(frozen=True)
class Review:
    """Findings about a design; printing it shows them line by line.

    Parameters
    ----------
    findings : tuple of Finding
        In the order in which things were looked at.
    """

    findings: tuple[Finding, ...]

    @property
    def is_good(self) -> bool:
        """Whether nothing bad was found."""
        return all(finding.verdict != "bad" for finding in self.findings)

    def __str__(self) -> str:
        """Return the findings, one a line."""
        marks = {"good": "ok  ", "note": "note", "bad": "BAD "}
        return "\n".join(
            f"{marks[f.verdict]} {f.topic}: {f.sentence}" for f in self.findings
        )


def review(
    controller: Controller, plant: LinearPlant | DifferenceModel | None = None
) -> Review:
    """Look a design over and say in sentences what would worry an engineer.

    Parameters
    ----------
    controller : Controller
    plant : LinearPlant or DifferenceModel, optional
        Plant to judge it on; the model itself if absent.

    Raises
    ------
    ValueError
        If the plant's size differs from the model's.
    """
    loop = linear_loop(controller, plant)
    findings = [_stability(loop), *_offset(loop), *_structure(controller)]
    if isinstance(controller, PredictiveController):
        findings += [_conditioning(controller), _dead_time(controller)]
        findings += _rows_left_out(controller) + _sum_of_error(controller)
        findings += _terminal(controller)
    findings += _conflicts(controller)
    findings += _hidden(loop)
    return Review(tuple(findings))


def _stability(loop: LinearLoop) -> Finding:
    radius = f"largest pole {loop.radius:.4f}"
    if loop.is_stable:
        return Finding(
            "stability", "good", f"The loop without limits is stable, {radius}."
        )
    if loop.radius < 1.0 + ROUNDING:
        sentence = f"The loop without limits is only marginally stable, {radius}."
        return Finding("stability", "bad", sentence)
    return Finding(
        "stability",
        "bad",
        f"The loop without limits is unstable, {radius}. Lengthen Np, weigh the moves "
        "more, or use the LQ tail.",
    )


def _offset(loop: LinearLoop) -> list[Finding]:
    if loop.radius > 1.0 + ROUNDING:
        return [Finding("offset", "note", "Not looked at: the loop is unstable.")]
    cases: list[tuple[Transfer, str]] = [
        ("T", "a constant reference"),
        ("S_i", "a constant disturbance at the input"),
        ("S_o", "a constant disturbance at the output"),
    ]
    findings = []
    for which, what in cases:
        error = loop.offset(which)
        if error < OFFSET_FREE:
            sentence = f"No offset remains after {what} ({which}(1) as it should be)."
            findings.append(Finding("offset", "good", sentence))
        elif np.isinf(error):
            sentence = f"After {what} the output never comes to rest."
            findings.append(Finding("offset", "bad", sentence))
        else:
            sentence = f"{which}(1) is off by {error:.3g}: {what} leaves an offset."
            findings.append(Finding("offset", "bad", sentence))
    return findings


def _structure(controller: Controller) -> list[Finding]:
    form, model = controller.form, controller.model
    fixed = form.fixed_poles()
    findings = []
    if len(fixed):
        verdict: Verdict = "bad" if np.abs(fixed[0]) >= 1.0 else "note"
        sentence = (
            f"The input reaches {form.controllable_rank()} of {form.n_x} states: a "
            f"common factor leaves fixed poles at {_list(fixed)}."
        )
        findings.append(Finding("controllability", verdict, sentence))
    zeros = model.zeros() if model.n_y == model.n_u else np.zeros(0)
    outside = zeros[np.abs(zeros) > 1.0]
    if len(outside):
        sentence = (
            f"The plant has zeros outside the unit circle at {_list(outside)}: outputs "
            "first move the wrong way, and fast control is not to be had."
        )
        findings.append(Finding("zeros", "note", sentence))
    return findings


def _sum_of_error(controller: PredictiveController) -> list[Finding]:
    """Say what weighing the sum of the error does to a step of the reference."""
    if "integral" not in controller.form.recipe.layout or "w" in controller.signals:
        return []
    if controller.knowledge.layout.shapes["r"][0]:
        sentence = (
            "The weighed sum of the error has to return to zero, so a step of the "
            "reference overshoots by as much as it lacked; "
            'reference = "zero" leaves the reference to the integral action alone.'
        )
    else:
        sentence = (
            "The plan expects a reference of zero from the next sample on: without "
            "limits it is the law of PIP control, but limits may seem active that the "
            "loop never meets."
        )
    return [Finding("reference", "note", sentence)]


def _conditioning(controller: PredictiveController) -> Finding:
    condition = float(np.linalg.cond(controller.program.H))
    if condition < 1e8:
        return Finding(
            "conditioning",
            "good",
            f"The Hessian's condition number is {condition:.2g}.",
        )
    return Finding(
        "conditioning",
        "note" if condition < 1e12 else "bad",
        f"The Hessian's condition number is {condition:.2g}: weigh the moves more, "
        "shorten Nc, or govern a stabilising gain.",
    )


def _dead_time(controller: PredictiveController) -> Finding:
    dead = controller.model.dead_time.min(axis=1)
    late = [
        f"{name} ({int(wait)} samples)"
        for name, wait in zip(controller.model.y_names, dead, strict=True)
        if wait > controller.horizon.Np
    ]
    if late:
        sentence = (
            f"Np = {controller.horizon.Np} ends before inputs act on {', '.join(late)}."
        )
        return Finding("horizon", "bad", sentence)
    sentence = f"Np = {controller.horizon.Np} sees past every output's dead time."
    return Finding("horizon", "good", sentence)


def _rows_left_out(controller: PredictiveController) -> list[Finding]:
    rows = controller.program.left_out
    if not rows:
        return []
    listed = ", ".join(f"{r.name}{r.channel + 1} at step {r.step}" for r in rows[:4])
    more = f" and {len(rows) - 4} more" if len(rows) > 4 else ""
    sentence = f"No decision moves {listed}{more}: these limits are not promised."
    return [Finding("limits", "note", sentence)]


def _terminal(controller: PredictiveController) -> list[Finding]:
    """Terminal equalities that the free moves cannot meet."""
    program = controller.program
    rows = program.rows.get("terminal", np.zeros(0, dtype=int))
    if not len(rows):
        return []
    both = np.hstack([program.M[rows], program.offset[rows]])
    met, asked = (int(np.linalg.matrix_rank(part)) for part in (program.M[rows], both))
    if met == asked:
        return []
    sentence = (
        f"The terminal equality has {asked} conditions, of which the free moves can "
        f"meet {met}: at most samples it is dropped, and the poles are those without "
        "it. Lengthen Nc, and Np with it."
    )
    return [Finding("terminal", "bad", sentence)]


def _conflicts(controller: Controller) -> list[Finding]:
    """Output limits against what the inputs can hold at rest."""
    model = controller.model
    gain = model.steady_state_gain()
    low_u, high_u = controller.limits_u
    low_y, high_y = controller.limits.of("y", model.n_y)
    if not (np.isfinite(gain).all() and np.isfinite([low_u, high_u]).all()):
        return []
    ends = np.stack([gain * low_u, gain * high_u])
    lowest, highest = ends.min(axis=0).sum(axis=1), ends.max(axis=0).sum(axis=1)
    findings = []
    for i, name in enumerate(model.y_names):
        sentence = (
            f"Within the input limits {name} can be held from {lowest[i]:.4g} to "
            f"{highest[i]:.4g}{_unit(model, name)}; references beyond leave an error."
        )
        findings.append(Finding("reach", "note", sentence))
        if highest[i] < low_y[i] or lowest[i] > high_y[i]:
            sentence = (
                f"The limits on {name}, {low_y[i]:.4g} to {high_y[i]:.4g}, cannot be "
                "held at rest by any allowed input."
            )
            findings.append(Finding("limits", "bad", sentence))
    return findings


def _hidden(loop: LinearLoop) -> list[Finding]:
    modes = loop.hidden_modes
    if not len(modes):
        return []
    slow = np.abs(modes).max() > 1.0 - 1e-6
    sentence = (
        f"Hidden modes at {_list(modes)}: the reference does not show them, a "
        "disturbance does"
        + (", and they never die out." if slow else ", and they decay on their own.")
    )
    return [Finding("hidden modes", "bad" if slow else "note", sentence)]


def _unit(model: DifferenceModel, name: str) -> str:
    return f" {model.units[name]}" if name in model.units else ""


def _list(numbers: Array) -> str:
    return ", ".join(
        f"{complex(n):.4g}" if np.iscomplex(n) else f"{n.real:.4g}" for n in numbers
    )
