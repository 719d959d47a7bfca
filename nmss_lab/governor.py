r"""Reference governor over any stabilising gain (thesis 3.2, 3.3).

The governor leaves the gain alone and perturbs the reference, w = r + beta, as little
as the limits allow:

.. math:: \min_\beta \beta'\beta \quad\text{subject to limits on } u, \Delta u, y
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from numbers import Real
from typing import Literal

import numpy as np

from nmss_lab.controller import Limits, Memory, Move, Status
from nmss_lab.models import Array, DifferenceModel, Numbers
from nmss_lab.nmss import Layout, Recipe, integral_of_error_form
from nmss_lab.pip import gain
from nmss_lab.predict import (
    Affine,
    Horizon,
    at_each_step,
    changes,
    decided,
    known_part,
    predict,
    stack,
)
from nmss_lab.predictive import Knowledge, PredictiveController, limit
from nmss_lab.qp import Cost, assemble, find_backend


@dataclass(frozen=True, eq=False)
class ReferenceGovernor(PredictiveController):
    """A predictive controller whose decision is the perturbation of the reference.

    Build it with ``governor``.  ``plan(move, "beta")`` and ``plan(move, "w")`` are the
    planned perturbation and governed reference.

    Parameters
    ----------
    K : array (n_u, n_x)
        The gain that is governed.
    causal : bool
        Whether w_k is chosen at k from r_k (True), or w_{k+1} at k from the previewed
        reference, the timing printed in (3.12).
    """

    K: Array = None  # type: ignore[assignment]
    causal: bool = True

    def free_law(self) -> tuple[Array, Array]:
        """Law of the governed gain without limits, w = r."""
        knows = self.knowledge
        law = self.first_move.known
        return law @ knows.from_memory, law @ knows.from_r

    @property
    def governs_ahead(self) -> int:
        """0 when w_k is chosen at k, 1 when w_{k+1} is."""
        return int(not self.causal)

    @cached_property
    def follows_laws(self) -> bool:
        """Whether the present input is part of the plan."""
        return self.causal

    @property
    def in_force(self) -> Affine:
        """The governed reference w_k."""
        return self.signals["w"][: self.model.n_y]

    def _missed(self, memory: Memory, u: Array, move: Move) -> Array:
        """Way from what the gain asks for under the governed reference, to ``u``."""
        x = memory.vector @ self.form.recipe.state.T
        if self.causal:
            x = x + move.governed @ self.form.D.T
        missed: Array = u + x @ self.K.T
        return missed

    def _decide(self, memory: Memory, r: Array, v: Array) -> Move:
        if self.causal:
            return super()._decide(memory, r, v)
        # No decision moves u_k: plan from the input that the actuator will allow.
        asked = -memory.vector @ self.form.recipe.state.T @ self.K.T
        missed = self.clip(asked, self.last_input(memory.vector)) - asked
        vector = self._tracked(memory.vector, missed)
        move = super()._decide(replace(memory, vector=vector), r, v)
        cut = np.abs(missed).max(axis=-1) > 1e-6
        move.status[cut & (move.status < Status.CLIPPED)] = Status.CLIPPED
        return move

    def _finish(self, move: Move, memory: Memory) -> Move:
        w = self.plan(move, "w")[:, 0]
        move = super()._finish(move, memory)
        applied = move.shift >= 0
        move.governed[applied] = w[applied]
        move.w[:] = move.governed
        if not self.causal:
            move.w[:] = self.form.recipe.layout.read(memory.vector, "w")
        return move


def governor(
    model: DifferenceModel,
    K: Numbers,
    Np: int,
    limits: Limits,
    reference: Literal["held", "preview"] = "held",
    free_until: int | None = None,
    decay: float = 1.0,
    backend: str = "active_set",
) -> ReferenceGovernor:
    r"""Build a reference governor over the law u = -K x.

    Parameters
    ----------
    model : DifferenceModel
    K : array (n_u, n_x)
        Stabilising gain on the state of (3.2).
    Np : int
        Samples over which the limits are looked at.
    limits : Limits
        On u, du and y.
    reference : "held" or "preview"
        ``"held"``: r_k is all that is known and w_k is chosen at k.  ``"preview"``:
        the printed (3.12), in which w_{k+1} is chosen at k from the true future; the
        decision then cannot move u_k, whose rows are left out and listed in
        ``program.left_out``.
    free_until : int, optional
        Perturbations are free for so many steps and zero after (3.3).
    decay : float
        Perturbations are decay**i times bounded decisions, 0 < decay <= 1 (3.3).
    backend : str

    Raises
    ------
    ValueError
        If K does not stabilise the model, or an argument is out of range.
    """
    form = integral_of_error_form(model, governed=True)
    K = gain("K", K, form)
    A = form.A - form.B @ K
    radius = float(np.abs(np.linalg.eigvals(A)).max())
    if radius >= 1.0:
        raise ValueError(
            f"K does not stabilise the model: the closed loop's largest pole has "
            f"modulus {radius:.4f}; a governor needs a gain that does"
        )
    free = Np if free_until is None else free_until
    if not 1 <= free <= Np:
        raise ValueError(f"free_until = {free_until}: expected 1 to Np = {Np} steps")
    if not isinstance(decay, Real) or not 0.0 < decay <= 1.0:
        raise ValueError(f"decay = {decay!r}: expected a number, 0 < decay <= 1")
    if decay < 1.0:  # what has faded to a millionth no longer counts
        free = min(free, 1 + int(np.log(1e-6) / np.log(decay)))
    if reference not in ("held", "preview"):
        raise ValueError(f'reference = "{reference}": expected "held" or "preview"')
    find_backend(backend)
    causal, horizon, p = reference == "held", Horizon(Np, free), model.n_y
    known = Layout(x=form.n_x, u=model.n_u, r=(1 if causal else Np, p))
    fading = np.kron(np.diag(decay ** np.arange(free)), np.eye(p))
    beta = decided(horizon.impulses(p) @ fading, known)
    w = _reference(known, horizon, causal, beta) + beta
    signals = _signals(model, form.A, form.B, form.C, form.D, K, w, causal, known)
    moves, steps = np.arange(Np), np.arange(Np)
    rows = [
        limit("u", signals["u"], limits.of("u", model.n_u), moves),
        limit("du", signals["du"], limits.of("du", model.n_u), moves),
        limit("y", signals["y"], limits.of("y", p), steps),
    ]
    size = free * p
    program = assemble([Cost(decided(np.eye(size), known), np.eye(size))], rows)
    ranks = np.array([int(row.name == "y") for row in program.labels], dtype=int)
    knowledge = _knowledge(model, form.recipe, known, causal, Np)
    return ReferenceGovernor(
        model,
        form,
        limits,
        horizon,
        program,
        {**signals, "w": w, "beta": beta},
        knowledge,
        ranks,
        backend,
        K=K,
        causal=causal,
    )


def _reference(known: Layout, horizon: Horizon, causal: bool, beta: Affine) -> Affine:
    """Return r at each step of the horizon, Np n_y rows."""
    part = known_part(known, "r", beta.gain.shape[1])
    return stack([part] * horizon.Np) if causal else part


def _signals(
    model: DifferenceModel,
    A: Array,
    B: Array,
    C: Array,
    D: Array,
    K: Array,
    w: Affine,
    causal: bool,
    known: Layout,
) -> dict[str, Affine]:
    """u, du and y over the horizon under u = -K x (3.9), (3.10)."""
    p, q = model.n_y, model.n_u
    steps = len(w) // p
    references = [w[slice(i * p, (i + 1) * p)] for i in range(steps)]
    state = known_part(known, "x", w.gain.shape[1])
    none = Affine(np.zeros((p, w.gain.shape[1])), np.zeros((p, known.size)))
    if causal:  # w_k enters the state that u_k is fed back from
        state = state + D @ references[0]
        references = [*references[1:], none]
    closed = A - B @ K
    X = predict([closed] * steps, [D] * steps, state, references, [D @ none] * steps)
    before = stack([state, X[slice(0, (steps - 1) * len(state))]])
    U = at_each_step(-K, before)
    last = np.eye(steps * q, q) @ known_part(known, "u", w.gain.shape[1])
    dU = changes(U, q) - last
    return {"u": U, "du": dU, "y": at_each_step(C, X)}


def _knowledge(
    model: DifferenceModel, recipe: Recipe, known: Layout, causal: bool, Np: int
) -> Knowledge:
    memory, p = recipe.layout, model.n_y
    from_memory = np.zeros((known.size, memory.size))
    from_memory[known["x"]] = recipe.state
    from_memory[known["u"]] = memory.select("u")[: known.shapes["u"][0]]
    from_r = np.zeros((known.size, p if causal else (1 + Np) * p))
    if causal:
        from_memory[known["r"]] = memory.select("r")
    else:
        from_r[known["r"], p:] = np.eye(Np * p)
    return Knowledge(known, from_memory, from_r, np.zeros((known.size, model.n_v)))
