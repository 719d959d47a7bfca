"""The problem of a sample of a state-dependent plant, and its program at a plan.

Which coefficients the program reads along the horizon is the scheme:

- ``"frozen"``: those of the present sample, all along.
- ``"iterated"``: those along the trajectory under the plan.
- ``"gauss-newton"``: the derivatives of the equation there, and what is left over as a
  known offset, so that the gradient is that of the true problem.
- ``"newton"``: the same with the curvature of the equation in the Hessian.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

import numpy as np

from nmss_lab.controller import Limits
from nmss_lab.models import Array
from nmss_lab.mpc import Setup, Terminal
from nmss_lab.predict import Affine, blocks, known_part, run_forward, stack, tables
from nmss_lab.predictive import output_ranks
from nmss_lab.qp import Cost, QuadraticProgram, Row, matters, sum_of_squares
from nmss_lab.state_dependent import StateDependentModel

Scheme = Literal["frozen", "iterated", "gauss-newton", "newton"]
SCHEMES: tuple[Scheme, ...] = ("frozen", "iterated", "gauss-newton", "newton")

LARGEST = 1e100
"""Programs with larger entries are not handed to a solver."""


@dataclass(frozen=True, eq=False)
class Point:
    """A plan, what the plant would do under it, and the program made there.

    Parameters
    ----------
    z : array (n_z,)
    theta : array (n_theta,)
        Known vector of the program.
    program : QuadraticProgram
    Y : Affine
        Outputs as the program predicts them, Np n_y rows.
    U : array (Np, n_u)
    y : array (Np, n_y)
        Outputs of the model itself under U.
    cost : float
        J of the plan with those outputs.
    broken : array (rows on outputs,)
        What the program's rows on outputs, a terminal condition included, are broken
        by.
    frozen : bool
        Whether the coefficients are those of the present sample.
    """

    z: Array
    theta: Array
    program: QuadraticProgram
    Y: Affine
    U: Array
    y: Array
    cost: float
    broken: Array
    frozen: bool = False


class Problem:
    """The problem of a sample: everything that depends on the design only.

    Parameters
    ----------
    equation : StateDependentModel
    setup : Setup
        On the wide model, with the parts "c" (offset of the equation at each step) and
        "one" (the number 1) in its known vector.
    weight_x, weight_z : arrays
        Weights of all predicted states (or errors of outputs), and of the decision.
    increments : bool
        Whether changes of the input are decided and errors of outputs weighed (8.4),
        or inputs decided and states weighed (8.3).
    limits, terminal : see ``nmss_lab.mpc.integral_of_error``
    """

    def __init__(
        self,
        equation: StateDependentModel,
        setup: Setup,
        weight_x: Array,
        weight_z: Array,
        increments: bool,
        limits: Limits,
        terminal: Terminal,
    ) -> None:
        self.equation, self.setup, self.increments = equation, setup, increments
        self.weight_x, self.weight_z = weight_x, weight_z
        self.limits, self.terminal = limits, terminal
        self.known, self.horizon = setup.known, setup.horizon
        self.U, self.dU = setup.increments() if increments else setup.levels()
        # what is the same in every pass
        self._inputs = tables(blocks(self.U, equation.n_u))
        self._state = known_part(self.known, "x", setup.n_z).table
        self._offsets = tables(self._offset_signals())
        self._A, self._B = (
            np.repeat(part[None], self.horizon.Np, 0)
            for part in (setup.form.A, setup.form.B)
        )
        self._reference = setup.stacked_reference()
        self._lay_out_rows()

    def _lay_out_rows(self) -> None:
        """Find the rows with limits, and which output each of them reads."""
        n, n_z = self.horizon.Np * self.equation.n_y, self.setup.n_z
        still = np.zeros((n, self.known.size))
        numbers = np.tile(np.arange(1.0, n + 1)[:, None], n_z)
        rows, bare = (
            self.setup.rows(
                self.U, self.dU, Affine(gain, still), self.limits, self.terminal
            )
            for gain in (numbers, 0.0 * numbers)
        )
        kept = np.concatenate([np.logical_and(*matters(row)) for row in rows])
        self._fixed = stack([row.signal for row in bare])[kept]
        marks = (stack([row.signal for row in rows])[kept] - self._fixed).gain[:, 0]
        self.on_outputs = marks > 0.5
        self._reads = marks[self.on_outputs].astype(int) - 1
        lower, upper = (
            np.concatenate([getattr(row, side) for row in rows])[kept]
            for side in ("lower", "upper")
        )
        labels = tuple(
            Row(row.name, i, int(step))
            for row in rows
            for step in row.steps
            for i in range(row.channels)
        )
        self.template = QuadraticProgram(
            np.eye(n_z),
            np.zeros((n_z, self.known.size)),
            np.zeros((self.known.size,) * 2),
            self._fixed.gain,
            self._fixed.known,
            lower,
            upper,
            tuple(label for label, ok in zip(labels, kept, strict=True) if ok),
        )
        self.ranks = output_ranks(self.template, self.limits, self.equation.n_y)

    def _offset_signals(self) -> list[Affine]:
        """List what enters each state: the reference, and the equation's c."""
        setup, form = self.setup, self.setup.form
        p, n_x = self.equation.n_y, form.n_x
        enter = np.zeros((n_x, p))
        enter[:p] = np.eye(p)
        if "integral" in form.recipe.layout:
            enter[-p:] = -np.eye(p)
        c = blocks(known_part(self.known, "c", setup.n_z), p)
        return [
            form.D @ r + enter @ c_i for r, c_i in zip(setup.reference, c, strict=True)
        ]

    def _matrices(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Fill A (Np, n_x, n_x) and B (Np, n_x, n_u) from coefficients of each step."""
        form, p = self.setup.form, self.equation.n_y
        steps, na = a.shape[:2]
        nb, q = b.shape[1], self.equation.n_u
        A, B = self._A.copy(), self._B.copy()
        wide = self.equation.y_lags * p
        A[:, :p, : na * p] = -a.swapaxes(1, 2).reshape(steps, p, na * p)
        past = b[:, 1:].swapaxes(1, 2).reshape(steps, p, (nb - 1) * q)
        A[:, :p, wide : wide + past.shape[2]] = past
        B[:, :p] = b[:, 0]
        if "integral" in form.recipe.layout:
            A[:, -p:, :-p] = -A[:, :p, :-p]
            B[:, -p:] = -b[:, 0]
        return A, B

    def past(self, theta: Array) -> tuple[Array, Array, Array]:
        """y_k, y_{k-1}, ... and u_{k-1}, ..., and the load, from a known vector."""
        eq, x = self.equation, theta[self.known["x"]]
        n = eq.y_lags * eq.n_y
        y = x[:n].reshape(eq.y_lags, eq.n_y)
        u = x[n : n + (eq.u_lags - 1) * eq.n_u].reshape(eq.u_lags - 1, eq.n_u)
        return y, u, theta[self.known["c"]][: eq.n_y]

    def rolled(self, z: Array, theta: Array) -> tuple[Array, Array]:
        """Give inputs (Np, n_u) of a plan and the outputs (Np, n_y) under them."""
        y, u, load = self.past(theta)
        U = self.U.value(z, theta).reshape(self.horizon.Np, -1)
        return U, self.equation.roll_out(y, u, U, load)

    def at(
        self,
        z: Array,
        theta: Array,
        scheme: Scheme,
        multipliers: Array | None = None,
    ) -> Point:
        """Point of a plan: predict, read the coefficients, make the program.

        ``multipliers`` (rows,) of the last program let the scheme "newton" see how the
        rows on outputs bend as well.
        """
        y, u, load = self.past(theta)
        U, outputs = self.rolled(z, theta)
        steps, theta = self.horizon.Np, theta.copy()
        frozen = scheme == "frozen"
        if not np.isfinite(outputs).all() and not frozen:
            return self._ran_away(z, theta, U, outputs)
        if frozen:
            last = np.concatenate([theta[self.known["u"]][None], u])
            a, b = self.equation.coefficients(y, last)
            a, b = (np.broadcast_to(c, (steps, *c.shape)) for c in (a, b))
        else:
            seen = self.equation.windows(y, u, outputs, U)
            a, b, c = self._along(scheme, seen, outputs, load)
            theta[self.known["c"]] = c.ravel()
        if not (np.isfinite(a).all() and np.isfinite(b).all()):
            return self._ran_away(z, theta, U, outputs)
        A, B = self._matrices(a, b)
        with np.errstate(all="ignore"):  # looked at just below
            both = run_forward(A, B, self._state, self._inputs, self._offsets)
            X = Affine(both[:, : self.setup.n_z], both[:, self.setup.n_z :])
            Y = self._outputs_of(X)
            program = self._program(X, Y)
            size = np.abs(program.H).max() + np.abs(program.f @ theta).max()
        if not size < LARGEST:
            return self._ran_away(z, theta, U, outputs)
        if scheme == "newton":
            if multipliers is None:
                multipliers = np.zeros(len(self.template.labels))
            price = self._prices(program, z, theta, multipliers)
            program = self._with_curvature(program, z, price, X, seen)
        cost = self._cost(z, theta, X, Y)
        broken = self._broken(program, z, theta)
        return Point(z, theta, program, Y, U, outputs, cost, broken, frozen)

    def _along(
        self, scheme: Scheme, seen: tuple[Array, Array], outputs: Array, load: Array
    ) -> tuple[Array, Array, Array]:
        """Coefficients of each step and what they leave of the equation."""
        if scheme == "iterated":
            a, b = self.equation.coefficients(*seen)
            return a, b, np.broadcast_to(load, outputs.shape)
        a, b = self.equation.derivative(*seen)
        y, u = (part[..., None] for part in seen)
        linear = ((b @ u).sum(1) - (a @ y).sum(1))[..., 0]
        return a, b, outputs - linear

    def _ran_away(self, z: Array, theta: Array, U: Array, outputs: Array) -> Point:
        n_z, n = self.setup.n_z, len(outputs.ravel())
        nothing = Affine(np.zeros((n, n_z)), np.zeros((n, self.known.size)))
        program = self._program_of(np.eye(n_z + self.known.size), nothing)
        broken = np.full(len(self._reads), np.inf)
        return Point(z, theta, program, nothing, U, outputs, np.inf, broken)

    def _outputs_of(self, X: Affine) -> Affine:
        n_x, p = self.setup.form.n_x, self.equation.n_y
        rows = (np.arange(self.horizon.Np)[:, None] * n_x + np.arange(p)).ravel()
        return X[rows]

    def _program(self, X: Affine, Y: Affine) -> QuadraticProgram:
        weighed = Y - self._reference if self.increments else X
        costs = [Cost(weighed, self.weight_x), Cost(self.setup.decision, self.weight_z)]
        return self._program_of(sum_of_squares(costs), Y)

    def _program_of(self, table: Array, Y: Affine) -> QuadraticProgram:
        """Program with the cost ``table`` on [z; theta] and all rows of the design."""
        n_z = self.setup.n_z
        M, offset = self._fixed.gain.copy(), self._fixed.known.copy()
        M[self.on_outputs] += Y.gain[self._reads]
        offset[self.on_outputs] += Y.known[self._reads]
        still = self.on_outputs & (np.abs(M).max(axis=1, initial=0.0) < 1e-12)
        lower = np.where(still, -np.inf, self.template.lower)
        upper = np.where(still, np.inf, self.template.upper)
        # solvers read memory as it lies: no views
        H, f = table[:n_z, :n_z].copy(), table[:n_z, n_z:].copy()
        constant = table[n_z:, n_z:]
        labels = self.template.labels
        return QuadraticProgram(H, f, constant, M, offset, lower, upper, labels)

    def _with_curvature(
        self,
        program: QuadraticProgram,
        z: Array,
        price: Array,
        X: Affine,
        seen: tuple[Array, Array],
    ) -> QuadraticProgram:
        """Program whose Hessian is that of the true problem, made positive definite.

        The price of an offset of the equation times the equation's curvature, along
        the windows that a plan moves, is what the Jacobian leaves out.
        """
        bent = np.einsum("ij,ijab->iab", price, self.equation.curvature(*seen))
        W = self._window_gains(X)
        H = program.H + np.einsum("iaz,iab,ibw->zw", W, bent, W)
        values, vectors = np.linalg.eigh((H + H.T) / 2.0)
        values = np.maximum(np.abs(values), 1e-8 * np.abs(values).max())
        H = (vectors * values) @ vectors.T
        f = program.f.copy()
        f[:, self.known["one"].start] += (program.H - H) @ z
        return dataclasses.replace(program, H=H, f=f)

    def _prices(
        self, program: QuadraticProgram, z: Array, theta: Array, multipliers: Array
    ) -> Array:
        """Price an offset of the equation at each step, (Np, n_y).

        The offset c stands in the known vector, so the program itself tells.
        """
        c = self.known["c"]
        price = program.f[:, c].T @ z + program.constant[c] @ theta
        price = price + program.offset[:, c].T @ multipliers
        return price.reshape(self.horizon.Np, -1)

    def _window_gains(self, X: Affine) -> Array:
        """How a decision moves the past values of each step, (Np, m, n_z)."""
        eq, Np, n_x = self.equation, self.horizon.Np, self.setup.form.n_x
        n_z, p, q = self.setup.n_z, eq.n_y, eq.n_u
        states = np.concatenate(
            [np.zeros((1, n_x, n_z)), X.gain.reshape(Np, n_x, n_z)[:-1]]
        )
        inputs = self.U.gain.reshape(Np, q, n_z)
        y, u = eq.y_lags * p, (eq.u_lags - 1) * q
        return np.concatenate([states[:, :y], inputs, states[:, y : y + u]], axis=1)

    def _cost(self, z: Array, theta: Array, X: Affine, Y: Affine) -> float:
        """J from what is weighed: ``program.cost`` loses digits where y is large."""
        weighed = Y - self._reference if self.increments else X
        value = weighed.value(z, theta)
        return float(value @ self.weight_x @ value + z @ self.weight_z @ z)

    def _broken(self, program: QuadraticProgram, z: Array, theta: Array) -> Array:
        """By how much each row on outputs is broken."""
        rows = self.on_outputs
        value = program.M[rows] @ z + program.offset[rows] @ theta
        low, high = self.template.lower[rows], self.template.upper[rows]
        return np.maximum(np.maximum(low - value, value - high), 0.0)

    def standing(self, point: Point) -> tuple[float, ...]:
        """Rank a plan among others: what it breaks, by importance, then what it costs.

        Soft limits are part of the cost.
        """
        if not np.isfinite(point.cost):
            return (np.inf,)
        if self.limits.outputs == "soft":
            return (
                point.cost
                + self.limits.soft_weight * float(point.broken @ point.broken),
            )
        ranks = self.ranks[self.on_outputs]
        sums = [point.broken[ranks == rank].sum() for rank in np.unique(ranks)]
        return (*(round(float(each), 9) for each in sums), point.cost)

    def merit(self, point: Point, price: float) -> float:
        """Give what a step should lower: the cost and a price of broken rows."""
        if not np.isfinite(point.cost):
            return np.inf
        if self.limits.outputs == "soft":
            return self.standing(point)[0]
        return point.cost + price * float(point.broken.sum())

    def from_inputs(self, U: Array, theta: Array) -> Array:
        """Decision whose inputs come closest to U (Np, n_u), step by step."""
        chosen = U[self.horizon.starts]
        if not self.increments:
            return chosen.ravel()
        before = theta[self.known["u"]][None]
        return np.diff(np.concatenate([before, chosen]), axis=0).ravel()
