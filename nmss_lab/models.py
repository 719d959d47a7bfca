"""Models of plants: the difference equation (2.1), (7.1) and sampled linear plants.

A model knows nothing of states for control (``nmss``) or of horizons (``predict``).
Everything here is in discrete time; ``continuous`` samples continuous plants exactly.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import scipy.linalg

Array = np.ndarray[Any, np.dtype[Any]]
"""Array of numbers; float64 unless a docstring says otherwise."""

Numbers = Any
"""Whatever numpy makes an array of, as an argument; an Array once it is stored."""


class Plant(Protocol):
    """What a closed loop asks of a plant; any object with these members will do.

    ``reset`` gives the state at rest for constant inputs, ``output`` the outputs
    y_k (n_y,) of a state, and ``step`` the state one sample later when the inputs
    u (n_u,) and measured disturbances v (n_v,) are held.
    """

    @property
    def n_y(self) -> int:
        """Number of outputs."""

    @property
    def n_u(self) -> int:
        """Number of inputs."""

    @property
    def n_v(self) -> int:
        """Number of measured disturbances."""

    @property
    def dt(self) -> float:
        """Sampling interval in seconds."""

    def reset(self, u0: Array, v0: Array, y0: Array | None = None) -> Any:
        """State at rest for constant inputs, disturbances and, perhaps, outputs."""

    def output(self, state: Any) -> Array:
        """Return the outputs y_k (n_y,)."""

    def step(self, state: Any, u: Array, v: Array) -> Any:
        """State one sample later."""


@dataclass(frozen=True, eq=False)
class Between:
    """Outputs between two samples of a sampled plant.

    At ``times[j]`` seconds after sample k, 0 < times <= dt, the output is
    ``C[j] x_k + B[j] u_k + G[j] v_k``; shapes (m, n_y, n_x), (m, n_y, n_u),
    (m, n_y, n_v).
    """

    times: Array
    C: Array
    B: Array
    G: Array


@dataclass(frozen=True, eq=False)
class LinearPlant:
    r"""A linear plant in discrete time, without feedthrough.

    .. math:: x_{k+1} = A x_k + B u_k + G v_k, \qquad y_k = C x_k

    Parameters
    ----------
    A, B, C : arrays (n_x, n_x), (n_x, n_u), (n_y, n_x)
    G : array (n_x, n_v), optional
        Effect of measured disturbances; none if absent.
    dt : float
        Sampling interval in seconds.
    between : Between, optional
        Inter-sample outputs, for a plant sampled from continuous time.
    rest : array (n_x, n_y + n_u + n_v), optional
        State for a past in which y, u and v have been constant.  Without it the
        equilibrium for constant u and v is used.
    """

    A: Array
    B: Array
    C: Array
    G: Array = None  # type: ignore[assignment]  # zero columns once built
    dt: float = 1.0
    between: Between | None = None
    rest: Array | None = None

    def __post_init__(self) -> None:
        """Fill in a missing disturbance matrix."""
        if self.G is None:
            object.__setattr__(self, "G", np.zeros((self.A.shape[0], 0)))

    @property
    def n_x(self) -> int:
        """Number of states."""
        return self.A.shape[0]

    @property
    def n_y(self) -> int:
        """Number of outputs."""
        return self.C.shape[0]

    @property
    def n_u(self) -> int:
        """Number of inputs."""
        return self.B.shape[1]

    @property
    def n_v(self) -> int:
        """Number of measured disturbances."""
        return self.G.shape[1]

    @property
    def substeps(self) -> int:
        """Number of outputs in an interval, as ``ContinuousPlant.sampled`` takes it."""
        return 1 if self.between is None else len(self.between.times)

    def reset(self, u0: Array, v0: Array, y0: Array | None = None) -> Array:
        """State at rest for constant inputs ``u0`` (n_u,) and disturbances ``v0``.

        ``y0`` (n_y,) is a constant past output for plants that keep one (a
        difference equation); others are put at the equilibrium of u0 and v0.

        Raises
        ------
        ValueError
            If the plant integrates and has no equilibrium for these inputs.
        """
        drive = self.B @ u0 + self.G @ v0
        if y0 is None or self.rest is None:
            state, *_ = np.linalg.lstsq(np.eye(self.n_x) - self.A, drive, rcond=None)
            drift = np.abs(self.A @ state + drive - state).max(initial=0.0)
            if drift > 1e-8 * (1.0 + np.abs(drive).max(initial=0.0)):
                raise ValueError(
                    f"u0 = {u0}, v0 = {v0} give no equilibrium: the plant integrates. "
                    "Start from inputs that cancel, or from u0 = 0 and v0 = 0."
                )
            return state
        rest: Array = self.rest @ np.concatenate([y0, u0, v0])
        return rest

    def output(self, state: Array) -> Array:
        """Return the outputs y_k (n_y,) of a state; an ensemble of states works too."""
        y: Array = state @ self.C.T
        return y

    def step(self, state: Array, u: Array, v: Array) -> Array:
        """State one sample later, with ``u`` and ``v`` held."""
        following: Array = self.A @ state + self.B @ u + self.G @ v
        return following

    def poles(self) -> Array:
        """Eigenvalues of A, the largest first."""
        return sort_by_size(np.linalg.eigvals(self.A))

    def response(self, z: complex) -> Array:
        """Transfer matrix from u to y at ``z``, complex (n_y, n_u)."""
        at_z: Array = self.C @ np.linalg.solve(z * np.eye(self.n_x) - self.A, self.B)
        return at_z


@dataclass(frozen=True, eq=False)
class DifferenceModel:
    r"""Difference equation of a plant with n_y outputs, n_u inputs, n_v disturbances.

    .. math:: y_k + \sum_{i=1}^{n_a} a_i y_{k-i} = \sum_{i=1}^{n_b} b_i u_{k-i}
              + \sum_{i=1}^{n_g} g_i v_{k-i}

    which is thesis (2.1), and (7.1) with measured disturbances v.

    Parameters
    ----------
    a, b, g : arrays (na, n_y, n_y), (nb, n_y, n_u), (ng, n_y, n_v)
        Coefficients; ``a[0]`` multiplies y_{k-1}.  One-dimensional lists describe a
        single-input single-output model.  ``g`` may be left out.
    dt : float
        Sampling interval in seconds.
    y_names, u_names, v_names : sequences of str, optional
    units : mapping from a signal's name to its unit, optional

    Raises
    ------
    ValueError
        If a shape does not fit, a coefficient is not finite, or dt <= 0.

    Examples
    --------
    The marginally stable plant (6.10), one output and one input:

    >>> model = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
    >>> model.na, model.nb, model.n_y
    (2, 2, 1)
    >>> float(model.steady_state_gain()[0, 0].round(4))
    3.3333
    """

    a: Numbers
    b: Numbers
    g: Numbers = None
    dt: float = 1.0
    y_names: Sequence[str] = ()
    u_names: Sequence[str] = ()
    v_names: Sequence[str] = ()
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check and complete the fields."""
        a = coefficients("a", self.a)
        b = coefficients("b", self.b)
        n_y = a.shape[1]
        none = self.g is None or np.size(self.g) == 0
        g = np.zeros((0, n_y, 0)) if none else coefficients("g", self.g)
        if a.shape[2] != n_y:
            raise ValueError(f"a has shape {a.shape}, expected (na, n_y, n_y)")
        for name, value in (("b", b), ("g", g)):
            if value.shape[1] != n_y:
                raise ValueError(
                    f"{name} has shape {value.shape}, expected {n_y} rows as in a"
                )
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise ValueError(f"dt = {self.dt} is not a positive number of seconds")
        set_ = object.__setattr__
        for key, array in (("a", a), ("b", b), ("g", g)):
            array.setflags(write=False)
            set_(self, key, array)
        for key, size in (("y", n_y), ("u", b.shape[2]), ("v", g.shape[2])):
            set_(self, f"{key}_names", _names(key, getattr(self, f"{key}_names"), size))
        set_(self, "units", dict(self.units))

    @property
    def na(self) -> int:
        """Number of past outputs, the thesis's n."""
        return self.a.shape[0]

    @property
    def nb(self) -> int:
        """Number of past inputs, the thesis's m."""
        return self.b.shape[0]

    @property
    def ng(self) -> int:
        """Number of past measured disturbances, the thesis's l."""
        return self.g.shape[0]

    @property
    def n_y(self) -> int:
        """Number of outputs, the thesis's p."""
        return self.a.shape[1]

    @property
    def n_u(self) -> int:
        """Number of inputs, the thesis's q."""
        return self.b.shape[2]

    @property
    def n_v(self) -> int:
        """Number of measured disturbances, the thesis's r."""
        return self.g.shape[2]

    @property
    def dead_time(self) -> Array:
        """Samples before each input reaches each output, (n_y, n_u); at least 1.

        A pathway that is zero counts as nb + 1.
        """
        moved = np.abs(self.b) > 0
        first = np.where(moved.any(axis=0), moved.argmax(axis=0) + 1, self.nb + 1)
        return first.astype(float)

    def poles(self) -> Array:
        """Roots of det A(z), the largest first, (na n_y,)."""
        n = self.na * self.n_y
        companion = np.eye(n, k=-self.n_y)
        companion[: self.n_y] = -np.hstack(list(self.a))
        return sort_by_size(np.linalg.eigvals(companion))

    def zeros(self) -> Array:
        """Finite transmission zeros of a square model, the largest first.

        Raises
        ------
        ValueError
            If the model has not as many inputs as outputs.
        """
        if self.n_y != self.n_u:
            raise ValueError(
                f"zeros() needs a square model; this one has {self.n_y} outputs and "
                f"{self.n_u} inputs"
            )
        A, B, C = minimal_realisation(*self._matrices())
        n, p = A.shape[0], self.n_y
        pencil = np.block([[A, B], [C, np.zeros((p, p))]])
        mass = scipy.linalg.block_diag(np.eye(n), np.zeros((p, p)))
        found = scipy.linalg.eigvals(pencil, mass, homogeneous_eigvals=True)
        finite = np.abs(found[1]) > 1e-6 * np.abs(found[0])
        return sort_by_size(found[0][finite] / found[1][finite])

    def steady_state_gain(self) -> Array:
        """Gain A(1)^-1 B(1), (n_y, n_u); infinite where the model integrates."""
        return self._gain(self.b)

    def disturbance_gain(self) -> Array:
        """Gain A(1)^-1 G(1) from measured disturbances, (n_y, n_v)."""
        return self._gain(self.g)

    def _gain(self, numerator: Array) -> Array:
        a1 = np.eye(self.n_y) + self.a.sum(axis=0)
        if np.linalg.cond(a1) > 1e12:
            return np.full(numerator.shape[1:], np.inf)
        gain: Array = np.linalg.solve(a1, numerator.sum(axis=0))
        return gain

    def response(self, z: complex) -> Array:
        """Transfer matrix A(z)^-1 B(z) at ``z``, complex (n_y, n_u)."""
        a = np.eye(self.n_y) + np.tensordot(
            z ** -np.arange(1.0, self.na + 1), self.a, 1
        )
        b = np.tensordot(z ** -np.arange(1.0, self.nb + 1), self.b, 1)
        at_z: Array = np.linalg.solve(a, b)
        return at_z

    def simulate(
        self, u: Array, v: Array | None = None, y0: Array | None = None
    ) -> Array:
        """Compute outputs y (N, n_y) for inputs u (N, n_u) and disturbances v (N, n_v).

        ``y[k]`` does not depend on ``u[k]``: the equation has one sample of delay.
        Before the first sample, u and v are zero and y is ``y0`` (zero by default).
        """
        u = np.asarray(u, dtype=float).reshape(len(u), self.n_u)
        v = np.zeros((len(u), self.n_v)) if v is None else np.asarray(v, dtype=float)
        v = v.reshape(len(u), self.n_v)
        plant = self.plant()
        rest = np.zeros(self.n_y) if y0 is None else np.atleast_1d(y0)
        state = plant.reset(np.zeros(self.n_u), np.zeros(self.n_v), rest)
        y = np.empty((len(u), self.n_y))
        for k in range(len(u)):
            y[k] = plant.output(state)
            state = plant.step(state, u[k], v[k])
        return y

    def varied(
        self, numerator: float = 1.0, denominator: float = 1.0
    ) -> DifferenceModel:
        """Model with b (and g) and a multiplied by factors, as in (6.11)."""
        g = self.g * numerator
        return dataclasses.replace(
            self, a=self.a * denominator, b=self.b * numerator, g=g
        )

    def plant(self) -> LinearPlant:
        """Plant that obeys this equation, in observer canonical form."""
        A, B, C, G = self._canonical()
        return LinearPlant(A, B, C, G, self.dt, rest=self._rest())

    def _depth(self) -> int:
        return max(self.na, self.nb, self.ng)

    def _padded(self) -> tuple[Array, Array, Array]:
        def pad(c: Array) -> Array:
            return np.concatenate([c, np.zeros((self._depth() - len(c), *c.shape[1:]))])

        return pad(self.a), pad(self.b), pad(self.g)

    def _canonical(self) -> tuple[Array, Array, Array, Array]:
        a, b, g = self._padded()
        n, p = self._depth(), self.n_y
        A = np.eye(n * p, k=p)
        A[:, :p] = -a.reshape(n * p, p)
        C = np.eye(p, n * p)
        return A, b.reshape(n * p, self.n_u), C, g.reshape(n * p, self.n_v)

    def _matrices(self) -> tuple[Array, Array, Array]:
        A, B, C, _ = self._canonical()
        return A, B, C

    def _rest(self) -> Array:
        """Map from constant past (y0, u0, v0) to the canonical state."""
        a, b, g = self._padded()
        blocks = np.concatenate([-a, b, g], axis=2)
        rest = np.cumsum(blocks[::-1], axis=0)[::-1]
        rest = rest.reshape(self._depth() * self.n_y, -1).copy()
        rest[: self.n_y] = np.eye(self.n_y, rest.shape[1])
        return rest


def minimal_realisation(A: Array, B: Array, C: Array) -> tuple[Array, Array, Array]:
    """Find the controllable and observable part of (A, B, C) by projection."""
    V = reachable_basis(A, B)
    A, B, C = V.T @ A @ V, V.T @ B, C @ V
    W = reachable_basis(A.T, C.T)
    return W.T @ A @ W, W.T @ B, C @ W


def observable_part(plant: LinearPlant) -> LinearPlant:
    """Plant without the states that no output shows at any sample.

    A plant sampled from transfer functions carries a mode once for each channel that
    has it; the outputs show only some sum of them.
    """
    W = reachable_basis(plant.A.T, plant.C.T)
    return LinearPlant(W.T @ plant.A @ W, W.T @ plant.B, plant.C @ W, dt=plant.dt)


def reachable_basis(A: Array, B: Array, tolerance: float = 1e-8) -> Array:
    """Orthonormal basis (n_x, rank) of the states that inputs can reach.

    Directions smaller than ``tolerance``, relative to the largest entry of A and B,
    count as zero.
    """
    size = max(np.abs(A).max(initial=0.0), np.abs(B).max(initial=0.0), 1e-300)
    basis = np.zeros((A.shape[0], 0))
    fresh = B
    while fresh.shape[1]:
        fresh = fresh - basis @ (basis.T @ fresh)
        fresh = fresh - basis @ (basis.T @ fresh)  # twice: orthogonal to rounding
        left, values, _ = np.linalg.svd(fresh, full_matrices=False)
        fresh = left[:, values > tolerance * size]
        basis = np.hstack([basis, fresh])
        fresh = A @ fresh
    return basis


def sort_by_size(values: Array) -> Array:
    """Complex numbers, the largest modulus first, conjugates side by side."""
    order = np.lexsort((-values.imag, -np.round(np.abs(values), 9)))
    ordered: Array = values[order]
    return ordered


def coefficients(name: str, value: Any) -> Array:
    """Coefficients as an array (order, rows, columns); a plain list is SISO.

    Raises
    ------
    ValueError
        If the value is not a finite array of 1 or 3 dimensions with an entry.
    """
    array = np.array(value, dtype=float)
    if array.ndim == 1:
        array = array[:, None, None]
    if array.ndim != 3 or array.shape[0] == 0:
        raise ValueError(
            f"{name} has shape {array.shape}, expected (order, rows, columns) with an "
            "order of at least 1, or a plain list for a single input and output"
        )
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name}{list(where)} is not finite")
    return array


def _names(letter: str, names: Sequence[str], size: int) -> tuple[str, ...]:
    chosen = tuple(names) or tuple(f"{letter}{i + 1}" for i in range(size))
    if len(chosen) != size or len(set(chosen)) != size:
        raise ValueError(
            f"{letter}_names = {chosen}: expected {size} different names, one a signal"
        )
    return chosen
