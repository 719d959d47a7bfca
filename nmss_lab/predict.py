r"""Predictions that are affine in the decision and in what is known.

Every signal along the horizon is

.. math:: s = \text{gain}\, z + \text{known}\, \theta

with the decision z (inputs, changes of inputs, or perturbations of a reference) and
the known vector :math:`\theta` (state, last input, reference, disturbances).  One
forward loop makes it for every structure; a model that changes along the horizon is a
sequence of different matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nmss_lab.models import Array
from nmss_lab.nmss import Layout


@dataclass(frozen=True, eq=False)
class Affine:
    """Signal ``gain @ z + known @ theta``.

    Parameters
    ----------
    gain, known : arrays (rows, n_z), (rows, n_theta)

    Examples
    --------
    >>> s = Affine(np.array([[2.0]]), np.array([[0.0, 1.0]]))
    >>> (s + s).gain
    array([[4.]])
    >>> s.value(np.array([3.0]), np.array([5.0, 7.0]))
    array([13.])
    """

    gain: Array
    known: Array

    def __add__(self, other: Affine) -> Affine:
        """Sum of two signals of the same length."""
        return Affine(self.gain + other.gain, self.known + other.known)

    def __sub__(self, other: Affine) -> Affine:
        """Difference of two signals of the same length."""
        return Affine(self.gain - other.gain, self.known - other.known)

    def __rmatmul__(self, matrix: Array) -> Affine:
        """Signal multiplied by a matrix from the left."""
        return Affine(matrix @ self.gain, matrix @ self.known)

    def __getitem__(self, rows: slice | Array | list[int]) -> Affine:
        """Return some rows of the signal."""
        return Affine(self.gain[rows], self.known[rows])

    @property
    def table(self) -> Array:
        """Gain and known side by side, (rows, n_z + n_theta)."""
        return np.concatenate([self.gain, self.known], axis=1)

    def __len__(self) -> int:
        """Return the number of rows."""
        return self.gain.shape[0]

    def value(self, z: Array, theta: Array) -> Array:
        """Numbers (..., rows) for decisions (..., n_z) and known vectors."""
        value: Array = z @ self.gain.T + theta @ self.known.T
        return value

    def effect_of(self, known: Layout, name: str) -> Array:
        """Columns that the known part ``name`` acts through: F, H_r, H_v of the thesis.

        The decision's own effect, Phi, is ``gain``.
        """
        columns: Array = self.known[:, known[name]]
        return columns


# Without this numpy would try ``matrix @ affine`` element by element.
Affine.__array_ufunc__ = None  # type: ignore[attr-defined]


def stack(signals: Sequence[Affine]) -> Affine:
    """Signals one above the other."""
    return Affine(
        np.concatenate([s.gain for s in signals]),
        np.concatenate([s.known for s in signals]),
    )


def blocks(signal: Affine, size: int) -> list[Affine]:
    """Parts of ``size`` rows, one a step."""
    return [signal[slice(i, i + size)] for i in range(0, len(signal), size)]


def by_step(matrix: Array, rows: Array) -> Array:
    """Product of the matrix of each step with its rows, one above the other.

    ``matrix`` is one for all steps (m, n), or one for each (steps, m, n).
    """
    step = rows.reshape(-1, matrix.shape[-1], rows.shape[1])
    product: Array = (matrix @ step).reshape(-1, rows.shape[1])
    return product


def at_each_step(matrix: Array, signal: Affine) -> Affine:
    """Signal of which each step's part is multiplied by ``matrix`` (m, n)."""
    return Affine(by_step(matrix, signal.gain), by_step(matrix, signal.known))


def changes(signal: Affine, n: int) -> Affine:
    """Difference of each step's part to the one before: C_2 of (3.10).

    The first part, of ``n`` rows as all are, stays.
    """
    return signal - Affine(*(_later(part, n) for part in (signal.gain, signal.known)))


def _later(part: Array, n: int) -> Array:
    later = np.zeros_like(part)
    later[n:] = part[:-n]
    return later


def sums(signal: Affine, n: int) -> Affine:
    """Sum of all parts of ``n`` rows up to each: C_2 of section 7.3."""
    parts = signal.gain, signal.known
    return Affine(
        *(p.reshape(-1, n, p.shape[1]).cumsum(axis=0).reshape(p.shape) for p in parts)
    )


def known_part(known: Layout, name: str, n_z: int) -> Affine:
    """Part ``name`` of the known vector as a signal that no decision moves."""
    rows = known.select(name)
    return Affine(np.zeros((rows.shape[0], n_z)), rows)


def decided(matrix: Array, known: Layout) -> Affine:
    """Signal ``matrix @ z`` that depends on the decision alone."""
    return Affine(matrix, np.zeros((matrix.shape[0], known.size)))


def predict(
    A: Sequence[Array],
    B: Sequence[Array],
    state: Affine,
    inputs: Sequence[Affine],
    offsets: Sequence[Affine],
) -> Affine:
    r"""Predict the stacked states over the horizon.

    Runs the model forward once, one block row a step:

    .. math:: x_{k+i+1} = A_i x_{k+i} + B_i \nu_{k+i} + e_{k+i}, \quad i = 0..N_p-1

    With constant matrices the gain is Phi of (4.8), or Phi + Phi_1 of (4.14) when the
    last input is held, and the known part holds F and H_r of (3.8); with matrices that
    change it is (8.5).  Only products are formed: past-input rows make the A of an
    NMSS form singular, so a recursion that inverts it cannot be used.

    Parameters
    ----------
    A, B : sequences of Np arrays, shapes (n_x, n_x) and (n_x, n_in)
        Model at each step; repeat one matrix if it is constant.
    state : Affine with n_x rows
        State x_k.
    inputs, offsets : sequences of Np Affine with n_in and n_x rows
        What drives the model, and known terms such as D r_{k+i+1} or G dv_{k+i}.

    Returns
    -------
    Affine with Np n_x rows
        Block row i (from 0) is the state at sample k + i + 1.

    Raises
    ------
    ValueError
        If the sequences differ in length.

    Examples
    --------
    One state, one free input, two steps; the decision is [u_k, u_k+1]:

    >>> x = Affine(np.zeros((1, 2)), np.array([[1.0]]))
    >>> none = Affine(np.zeros((1, 2)), np.zeros((1, 1)))
    >>> u = [Affine(row[None], np.zeros((1, 1))) for row in np.eye(2)]
    >>> a, b = np.array([[0.5]]), np.array([[2.0]])
    >>> predict([a, a], [b, b], x, u, [none, none]).gain
    array([[2., 0.],
           [1., 2.]])
    """
    lengths = {len(A), len(B), len(inputs), len(offsets)}
    if len(lengths) != 1:
        raise ValueError(
            f"A, B, inputs and offsets have {len(A)}, {len(B)}, {len(inputs)} and "
            f"{len(offsets)} steps; expected the same number, Np"
        )
    nu, e = tables(inputs), tables(offsets)
    X = run_forward(np.stack(A), np.stack(B), state.table, nu, e)
    n_z = state.gain.shape[1]
    return Affine(X[:, :n_z].copy(), X[:, n_z:].copy())


def tables(signals: Sequence[Affine]) -> Array:
    """Tables of signals of the same length, (steps, rows, n_z + n_theta)."""
    return np.stack([signal.table for signal in signals])


def run_forward(A: Array, B: Array, state: Array, inputs: Array, e: Array) -> Array:
    """Do what ``predict`` does with tables of the signals, and return one."""
    states = B @ inputs + e
    for a, following in zip(A, states, strict=True):
        following += a @ state  # now x_{k+i+1} in terms of z and theta
        state = following
    return states.reshape(-1, states.shape[2])


@dataclass(frozen=True)
class Horizon:
    """Prediction horizon Np, control horizon Nc, and optionally blocks of moves.

    Parameters
    ----------
    Np : int
        Samples that are predicted.
    Nc : int
        Free moves; the input is held after the last one.
    blocks : tuple of int, optional
        How long each free move is held, Nc lengths; one sample each by default.

    Raises
    ------
    ValueError
        Unless 1 <= Nc <= Np and the blocks fit into Np.
    """

    Np: int
    Nc: int
    blocks: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Check the horizons and normalise the blocks."""
        for name, value in (("Np", self.Np), ("Nc", self.Nc)):
            if isinstance(value, bool) or not isinstance(value, int | np.integer):
                raise ValueError(
                    f"{name} = {value!r}: expected a whole number of samples"
                )
        if not 1 <= self.Nc <= self.Np:
            raise ValueError(
                f"Np = {self.Np}, Nc = {self.Nc}: expected 1 <= Nc <= Np samples"
            )
        blocks = tuple(self.blocks)
        if blocks and (
            len(blocks) != self.Nc or min(blocks) < 1 or sum(blocks) > self.Np
        ):
            raise ValueError(
                f"blocks = {blocks}: expected Nc = {self.Nc} lengths of at least one "
                f"sample that together do not exceed Np = {self.Np}"
            )
        object.__setattr__(self, "blocks", blocks)

    @property
    def starts(self) -> Array:
        """Sample, from 0, at which each free move begins, (Nc,) integers."""
        lengths = self.blocks or (1,) * self.Nc
        return np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(int)

    def held(self, n: int) -> Array:
        """Map (Np n, Nc n) from free values to a sequence that holds each of them."""
        which = np.searchsorted(self.starts, np.arange(self.Np), side="right") - 1
        return np.kron(np.eye(self.Nc)[which], np.eye(n))

    def impulses(self, n: int) -> Array:
        """Map (Np n, Nc n) from free changes to a sequence that is zero elsewhere."""
        spread = np.zeros((self.Np, self.Nc))
        spread[self.starts, np.arange(self.Nc)] = 1.0
        return np.kron(spread, np.eye(n))

    def rows_of_moves(self, n: int) -> Array:
        """Rows of an Np n sequence at which a free move begins."""
        return (self.starts[:, None] * n + np.arange(n)).ravel()
