"""The predictive structures of the thesis, one short function each.

A structure says what its state is, what drives the model along the horizon, what is
weighed and what is limited (the table of the design document); everything else is
shared.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np
import scipy.linalg

from nmss_lab.controller import Limits
from nmss_lab.models import Array, DifferenceModel
from nmss_lab.nmss import (
    Form,
    Layout,
    differenced_form,
    integral_of_error_form,
    minimal_form,
)
from nmss_lab.pip import lq_cost
from nmss_lab.predict import (
    Affine,
    Horizon,
    at_each_step,
    blocks,
    changes,
    decided,
    known_part,
    predict,
    stack,
    sums,
)
from nmss_lab.predictive import (
    Forecast,
    Knowledge,
    PredictiveController,
    limit,
    output_ranks,
)
from nmss_lab.qp import (
    Cost,
    Limit,
    assemble,
    find_backend,
    weight,
    weight_blocks,
)

Reading = Literal["held", "next", "preview", "zero"]
"""What S holds: r_k repeated, r_{k+1} repeated, the true future, or nothing (the
reference then enters through the sum of the error alone, as in PIP control)."""

Terminal = Literal["none", "equality", "lq"]


def integral_of_error(
    model: DifferenceModel,
    horizon: Horizon,
    Q: Any,
    R: Any,
    limits: Limits | None = None,
    reference: Reading = "held",
    terminal: Terminal = "none",
    backend: str = "active_set",
    anti_windup: bool = True,
) -> PredictiveController:
    r"""Predictive control with an integral-of-error state (thesis 4.2).

    .. math:: J = X' \bar Q X + U' \bar R U

    over the state of (3.2) and the inputs themselves; the last input is held.

    Parameters
    ----------
    model : DifferenceModel
    horizon : Horizon
    Q : weight of the state, n_x = n_y (na + 1) + n_u (nb - 1)
        A number, one weight a state, a matrix (n_x, n_x), one matrix a step
        (Np, n_x, n_x), or the full (Np n_x, Np n_x); see ``state_weight`` for (5.6).
    R : weight of the inputs, the same ways with n_u and Nc
    limits : Limits, optional
    reference : "held", "next", "preview" or "zero"
        What is known of the reference along the horizon.
    terminal : "none", "equality" or "lq"
        ``"equality"`` asks for rest at the reference at the end of the horizon (C.2.1),
        ``"lq"`` weighs the last state with the infinite-horizon LQ cost.
    backend : str
        Solver, see ``nmss_lab.qp.BACKENDS``.
    anti_windup : bool
        While a level limit holds the input, set the sum of the error to what the law
        without limits would need for that input.  The thesis sums on regardless.

    Raises
    ------
    ValueError
        If a weight or limit has a wrong shape, or the condensed Hessian is not
        positive definite.
    """
    form = integral_of_error_form(model)
    problem = Setup(model, form, horizon, reference, "held")
    U, dU = problem.levels()
    X = problem.predicted(U, [form.D @ r for r in problem.reference])
    weight_x = weight_blocks("Q", Q, horizon.Np, form.n_x)
    weight_u = weight_blocks("R", R, horizon.Nc, model.n_u)
    if terminal == "lq":
        last = weight_x[-1, -form.n_x :, -form.n_x :]
        last[:] = _riccati(form, last, weight_u, model.n_u)
    costs = [Cost(X, weight_x), Cost(problem.decision, weight_u)]
    built = problem.build(costs, U, dU, X, limits, terminal, backend)
    return replace(built, anti_windup=anti_windup)


def wang_young(
    model: DifferenceModel,
    horizon: Horizon,
    Q: Any,
    R: Any,
    limits: Limits | None = None,
    reference: Reading = "held",
    terminal: Terminal = "none",
    backend: str = "active_set",
) -> PredictiveController:
    r"""Predictive control of Wang and Young (2006), thesis 4.1.

    .. math:: J = (Y - S)' \bar Q (Y - S) + \Delta U' \bar R \Delta U

    Changes of the input are decided; after the control horizon they are zero.

    Parameters
    ----------
    Q, R : weights of outputs (n_y, over Np) and of moves (n_u, over Nc)
        A number, one weight a channel, a matrix, one matrix a step (5.4), or full.
    model, horizon, limits, reference, terminal, backend :
        See ``integral_of_error``; ``reference = "zero"`` makes no sense here.

    Raises
    ------
    ValueError
        As ``integral_of_error``.
    """
    form = differenced_form(model)
    return _incremental(
        model, form, horizon, Q, R, limits, reference, terminal, backend
    )


def forward_path(
    model: DifferenceModel,
    horizon: Horizon,
    Q: Any,
    R: Any,
    limits: Limits | None = None,
    reference: Reading = "held",
    terminal: Terminal = "none",
    backend: str = "active_set",
) -> PredictiveController:
    """Forward-path predictive control (thesis 6.2).

    The design of ``wang_young``; only the state differs: changes of past outputs come
    from an internal model, and the last entries stay the measured outputs.  All
    open-loop poles remain as hidden modes of the loop, so the model must be stable.

    Parameters and errors are those of ``wang_young``.
    """
    form = differenced_form(model, internal_model=True)
    return _incremental(
        model, form, horizon, Q, R, limits, reference, terminal, backend
    )


def minimal(
    model: DifferenceModel,
    horizon: Horizon,
    Q: Any,
    R: Any,
    limits: Limits | None = None,
    reference: Reading = "held",
    terminal: Terminal = "none",
    backend: str = "active_set",
    observer: Literal["deadbeat", "kalman"] = "deadbeat",
) -> PredictiveController:
    """Predictive control on a minimal realisation with an observer (5.1.3).

    The cost is that of ``wang_young``.

    Parameters
    ----------
    observer : "deadbeat" or "kalman"
        See ``nmss_lab.nmss.minimal_form``.
    model, horizon, Q, R, limits, reference, terminal, backend :
        See ``wang_young``.
    """
    form = minimal_form(model, observer)
    return _incremental(
        model, form, horizon, Q, R, limits, reference, terminal, backend
    )


def disturbance_direct(
    model: DifferenceModel,
    horizon: Horizon,
    Q: Any,
    R: Any,
    limits: Limits | None = None,
    reference: Reading = "held",
    terminal: Terminal = "none",
    backend: str = "active_set",
    forecast: Forecast = "held",
) -> PredictiveController:
    """Measured disturbances as known offsets of the prediction (thesis 7.2.2).

    ``forecast`` says what is known of v beyond v_k: it is held (Assumption 7.3.1), goes
    on along the line through the latest two values ("line"), is handed to ``decide``
    ("given"), or asked of a function, see ``Forecast``.

    Raises
    ------
    ValueError
        As ``wang_young``, or if the model has no measured disturbances.
    """
    form = differenced_form(_with_disturbances(model), disturbances="direct")
    return _incremental(
        model, form, horizon, Q, R, limits, reference, terminal, backend, forecast
    )


def disturbance_augmented(
    model: DifferenceModel,
    horizon: Horizon,
    Q: Any,
    R: Any,
    limits: Limits | None = None,
    reference: Reading = "held",
    terminal: Terminal = "none",
    backend: str = "active_set",
    forecast: Forecast = "held",
) -> PredictiveController:
    """Measured disturbances as part of the state (thesis 7.2.1, corrected).

    Written so that the present increment counts once, it is the same controller as
    ``disturbance_direct`` with a larger state.
    """
    form = differenced_form(_with_disturbances(model), disturbances="augmented")
    return _incremental(
        model, form, horizon, Q, R, limits, reference, terminal, backend, forecast
    )


STRUCTURES: dict[str, Callable[..., PredictiveController]] = {
    "integral_of_error": integral_of_error,
    "wang_young": wang_young,
    "forward_path": forward_path,
    "minimal": minimal,
    "disturbance_direct": disturbance_direct,
    "disturbance_augmented": disturbance_augmented,
}
"""Predictive structures by name."""


def _incremental(
    model: DifferenceModel,
    form: Form,
    horizon: Horizon,
    Q: Any,
    R: Any,
    limits: Limits | None,
    reference: Reading,
    terminal: Terminal,
    backend: str,
    forecast: Forecast = "held",
) -> PredictiveController:
    """Build any structure whose decision is the change of the input."""
    if reference == "zero":
        raise ValueError(
            'reference = "zero" leaves nothing to follow: a structure that decides '
            'changes of the input has no sum of the error; use "held", "next" or '
            '"preview"'
        )
    problem = Setup(model, form, horizon, reference, forecast)
    U, dU = problem.increments()
    X = problem.predicted(dU, problem.disturbances())
    weight_y = weight_blocks("Q", Q, horizon.Np, model.n_y)
    weight_du = weight_blocks("R", R, horizon.Nc, model.n_u)
    Y = at_each_step(form.C, X)
    S = problem.stacked_reference()
    costs = [Cost(Y - S, weight_y), Cost(problem.decision, weight_du)]
    if terminal == "lq":
        costs.append(_tail(problem, X, weight_y, weight_du))
    return problem.build(costs, U, dU, X, limits, terminal, backend)


class Setup:
    """What the builders share: the known vector, the reference, limits, assembly."""

    def __init__(
        self,
        model: DifferenceModel,
        form: Form,
        horizon: Horizon,
        reference: Reading,
        forecast: Forecast = "held",
        **more: int | tuple[int, ...],
    ) -> None:
        self.model, self.form, self.horizon = model, form, horizon
        self.reading, self.forecast = reference, forecast
        self.n_z = horizon.Nc * model.n_u
        self.known = self._layout(more)
        self.decision = decided(np.eye(self.n_z), self.known)

    def _layout(self, more: Mapping[str, int | tuple[int, ...]]) -> Layout:
        sizes = {"held": 1, "next": 1, "preview": self.horizon.Np, "zero": 0}
        if self.reading not in sizes:
            raise ValueError(
                f'reference = "{self.reading}": expected one of {", ".join(sizes)}'
            )
        if not (callable(self.forecast) or self.forecast in ("held", "line", "given")):
            raise ValueError(
                f'forecast = "{self.forecast}": expected "held", "line", "given" or a '
                "function"
            )
        model = self.model
        return Layout(
            x=self.form.n_x,
            u=model.n_u,
            r=(sizes[self.reading], model.n_y),
            dv=(self._past, model.n_v),
            dv_ahead=(self._ahead, model.n_v),
            **more,
        )

    @property
    def _past(self) -> int:
        """Past changes of v that enter the prediction, the present one included."""
        return max((lag + 1 for lag in self.form.lags), default=0)

    @property
    def _ahead(self) -> int:
        """Coming changes of v that enter the prediction."""
        held = self.forecast == "held" or not self.form.lags
        return 0 if held else self.horizon.Np - 1

    def levels(self) -> tuple[Affine, Affine]:
        """Give decided inputs, held, and their changes, Np n_u rows each."""
        horizon, n_u = self.horizon, self.model.n_u
        U = decided(horizon.held(n_u), self.known)
        first = np.eye(horizon.Np * n_u, n_u)
        last_u = first @ known_part(self.known, "u", self.n_z)
        return U, changes(U, n_u) - last_u

    def increments(self) -> tuple[Affine, Affine]:
        """Give inputs, and their changes that are decided, Np n_u rows each."""
        horizon, n_u = self.horizon, self.model.n_u
        dU = decided(horizon.impulses(n_u), self.known)
        ones = np.tile(np.eye(n_u), (horizon.Np, 1))
        last_u = ones @ known_part(self.known, "u", self.n_z)
        return sums(dU, n_u) + last_u, dU

    @property
    def reference(self) -> list[Affine]:
        """S, step by step: r_{k+i+1} as far as it is known, n_y rows each."""
        part, p = known_part(self.known, "r", self.n_z), self.model.n_y
        if self.reading == "zero":
            nothing = Affine(np.zeros((p, self.n_z)), np.zeros((p, self.known.size)))
            return [nothing] * self.horizon.Np
        if self.reading == "preview":
            return blocks(part, p)
        return [part] * self.horizon.Np

    def stacked_reference(self) -> Affine:
        """S as one signal of Np n_y rows."""
        return stack(self.reference)

    def disturbances(self) -> list[Affine]:
        """Offsets G delta_{k+i} of each step of the horizon, n_x rows each."""
        past = known_part(self.known, "dv", self.n_z)
        ahead = known_part(self.known, "dv_ahead", self.n_z)
        r, n_x = self.model.n_v, self.form.n_x
        nothing = Affine(np.zeros((n_x, self.n_z)), np.zeros((n_x, self.known.size)))
        offsets = [nothing] * self.horizon.Np
        for i in range(self.horizon.Np):
            for j, lag in enumerate(self.form.lags):
                source, block = (past, lag - i) if i <= lag else (ahead, i - lag - 1)
                if (block + 1) * r <= len(source):
                    G = self.form.G[:, _block(j, r)]
                    offsets[i] = offsets[i] + G @ source[_block(block, r)]
        return offsets

    def predicted(self, inputs: Affine, offsets: list[Affine]) -> Affine:
        """States over the horizon, Np n_x rows, for what drives the form."""
        steps, n_u = self.horizon.Np, self.model.n_u
        state = known_part(self.known, "x", self.n_z)
        A, B = [self.form.A] * steps, [self.form.B] * steps
        return predict(A, B, state, blocks(inputs, n_u), offsets)

    def build(
        self,
        costs: list[Cost],
        U: Affine,
        dU: Affine,
        X: Affine,
        limits: Limits | None,
        terminal: Terminal,
        backend: str,
    ) -> PredictiveController:
        """Condense costs and limits and freeze the design."""
        model, horizon = self.model, self.horizon
        limits = limits or Limits()
        find_backend(backend)
        Y = at_each_step(self.form.C, X)
        rows = self.rows(U, dU, Y, limits, terminal)
        program = assemble(costs, rows, "weights Q and R")
        return PredictiveController(
            model,
            self.form,
            limits,
            horizon,
            program,
            {"u": U, "du": dU, "y": Y},
            self.knowledge(),
            output_ranks(program, limits, model.n_y),
            backend,
            self.forecast,
        )

    def rows(
        self, U: Affine, dU: Affine, Y: Affine, limits: Limits, terminal: Terminal
    ) -> list[Limit]:
        """List what is limited along the horizon."""
        model, horizon = self.model, self.horizon
        moves, steps = horizon.rows_of_moves(model.n_u), np.arange(horizon.Np)
        rows = [
            limit("u", U[moves], limits.of("u", model.n_u), horizon.starts),
            limit("du", dU[moves], limits.of("du", model.n_u), horizon.starts),
            limit("y", Y, limits.of("y", model.n_y), steps),
        ]
        if terminal == "equality":
            if self.reading == "zero":
                raise ValueError(
                    'terminal = "equality" with reference = "zero" asks for rest at '
                    "zero, not at the reference: use another reading"
                )
            rows.append(self._rest(Y, dU))
        elif terminal not in ("none", "lq"):
            raise ValueError(
                f'terminal = "{terminal}": expected "none", "equality" or "lq"'
            )
        return rows

    def _rest(self, Y: Affine, dU: Affine) -> Limit:
        """Rows of (C.2.1): na + 1 outputs at r, nb - 1 changes of inputs at zero."""
        model, Np = self.model, self.horizon.Np
        outputs = min(model.na + 1, Np) * model.n_y
        inputs = min(model.nb - 1, Np) * model.n_u
        error = (Y - self.stacked_reference())[slice(Np * model.n_y - outputs, None)]
        still = dU[slice(Np * model.n_u - inputs, None)]
        signal = stack([error, still])
        zero = np.zeros(len(signal))
        return Limit("terminal", signal, zero, zero, 1, np.full(len(signal), Np - 1))

    def knowledge(self) -> Knowledge:
        """How theta is made of memory, reference and disturbances."""
        model, recipe, known = self.model, self.form.recipe, self.known
        p, r = model.n_y, model.n_v
        from_memory = np.zeros((known.size, recipe.layout.size))
        from_memory[known["x"]] = recipe.state
        from_memory[known["u"]] = recipe.layout.select("u")[: model.n_u]
        if self._past:
            v = recipe.layout.select("v")
            from_memory[known["dv"]] = (v[:-r] - v[r:])[: self._past * r]
        reads = {"held": 0, "zero": 0, "next": 1, "preview": self.horizon.Np}
        from_r = np.zeros((known.size, (1 + reads[self.reading]) * p))
        if self.reading == "held":
            from_memory[known["r"]] = recipe.layout.select("r")
        elif self.reading != "zero":
            from_r[known["r"], p:] = np.eye(reads[self.reading] * p)
        from_v = np.zeros((known.size, (1 + self._ahead) * r))
        if self._ahead:
            changes = np.eye(self._ahead * r, from_v.shape[1], k=r)
            changes -= np.eye(self._ahead * r, from_v.shape[1])
            from_v[known["dv_ahead"]] = changes
        return Knowledge(known, from_memory, from_r, from_v)


def state_weight(
    model: DifferenceModel, weight_y: Any, weight_past_u: Any, weight_integral: Any
) -> Array:
    """Weight (n_x, n_x) of the state of (3.2), by its parts: (5.6a).

    Parameters
    ----------
    model : DifferenceModel
    weight_y, weight_past_u, weight_integral : weights of past outputs, past inputs, sum
        Each a number, one weight a channel, a matrix, or one matrix a lag.
    """
    parts = [weight("weight_y", weight_y, model.na, model.n_y)]
    if model.nb > 1:
        parts.append(weight("weight_past_u", weight_past_u, model.nb - 1, model.n_u))
    parts.append(weight("weight_integral", weight_integral, 1, model.n_y))
    joined: Array = scipy.linalg.block_diag(*parts)
    return joined


def _riccati(form: Form, Q: Array, R: Array, n_u: int) -> Array:
    """Cost-to-go from the last state; the cost counts x_{k+Np} itself as well."""
    return lq_cost(form.A, form.B, Q, R[-1, -n_u:, -n_u:])


def _tail(problem: Setup, X: Affine, weight_y: Array, weight_du: Array) -> Cost:
    """LQ cost beyond the horizon, on the last state seen from rest at r."""
    form, model, Np = problem.form, problem.model, problem.horizon.Np
    Q = form.C.T @ weight_y[-1, -model.n_y :, -model.n_y :] @ form.C
    P = lq_cost(form.A, form.B, Q, weight_du[-1, -model.n_u :, -model.n_u :])
    still = np.vstack([np.eye(form.n_x) - form.A, form.C])
    rest = np.linalg.pinv(still)[:, form.n_x :]
    x_last = X[_block(Np - 1, form.n_x)] - rest @ problem.reference[-1]
    return Cost(x_last, P - Q)


def _with_disturbances(model: DifferenceModel) -> DifferenceModel:
    if model.n_v == 0:
        raise ValueError("model.g is missing: the model has no measured disturbances")
    return model


def _block(i: int, size: int) -> slice:
    return slice(i * size, (i + 1) * size)
