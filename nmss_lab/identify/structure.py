"""Orders of a model with one output, and the polynomials and regressors they imply."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from nmss_lab.models import Array
from nmss_lab.records import Record

Start = Literal["rest", "skip", "estimate"]
"""What is assumed of the time before the first sample.

"rest": nothing moved.  "skip": as "rest", but the samples that the equation reaches
back from are not fitted, which is enough where the past has died out by then.
"estimate": anything; its free response is fitted along with the parameters.
"""

ONE = np.ones(1)
"""The polynomial 1."""


@dataclass(frozen=True)
class Orders:
    """Orders of a model with one output: the [na, nb, nk] of the field.

    Parameters
    ----------
    na : int
        Past outputs, at least 1.
    nb, nk : tuples of int
        Coefficients and samples of delay of each input; every nb and nk at least 1
        and 1 (``nk = 1`` is the delay of a held input).

    Raises
    ------
    ValueError
        If an order is too small or nb and nk differ in length.

    Examples
    --------
    >>> print(Orders(1, (3,), (3,)))
    [1 3 3]
    """

    na: int
    nb: tuple[int, ...]
    nk: tuple[int, ...]

    def __post_init__(self) -> None:
        """Check the orders."""
        if len(self.nb) != len(self.nk) or not self.nb:
            raise ValueError(
                f"nb = {self.nb}, nk = {self.nk}: expected one entry an input in each"
            )
        if self.na < 1 or min(self.nb) < 1 or min(self.nk) < 1:
            raise ValueError(f"orders {self}: na, nb and nk must be at least 1")

    def __str__(self) -> str:
        """Return the orders in brackets, na first."""
        return f"[{' '.join(map(str, (self.na, *self.nb, *self.nk)))}]"

    @property
    def count(self) -> int:
        """Number of parameters."""
        return self.na + sum(self.nb)

    @property
    def delays(self) -> list[tuple[int, int]]:
        """Delay and number of coefficients of each input."""
        return list(zip(self.nk, self.nb, strict=True))

    @property
    def reach(self) -> int:
        """Number of past samples that the equation looks at."""
        return max(self.na, *(k + n - 1 for k, n in self.delays))

    def split(self, parameters: Array) -> tuple[Array, list[Array]]:
        """Polynomials A and B_i in powers of z^-1, from z^0 on."""
        a, rest = np.split(parameters[: self.count], [self.na])
        b = np.split(rest, np.cumsum(self.nb)[:-1])
        lead = [np.zeros(k) for k in self.nk]
        joined = [np.concatenate(pair) for pair in zip(lead, b, strict=True)]
        return np.concatenate([ONE, a]), joined

    def regressors(self, y: Array, inputs: Array) -> Array:
        """Past outputs (with a minus sign) and inputs of every sample, (N, count).

        What lies before the first sample counts as zero.
        """
        terms = [(-y, i + 1) for i in range(self.na)]
        return columns(terms + self.of_inputs(inputs.T))

    def of_inputs(self, inputs: Array) -> list[tuple[Array, int]]:
        """List what the coefficients of B_i multiply: inputs (n_u, N) and delays."""
        return [
            (u, k + i)
            for u, (k, n) in zip(inputs, self.delays, strict=True)
            for i in range(n)
        ]


@dataclass(frozen=True)
class Noise:
    """Orders of the noise model xi = (D / C) e: ``ar`` of C, ``ma`` of D.

    Raises
    ------
    ValueError
        If an order is negative.
    """

    ar: int
    ma: int = 0

    def __post_init__(self) -> None:
        """Check the orders."""
        if self.ar < 0 or self.ma < 0:
            raise ValueError(f"{self}: orders must not be negative")


def delayed(signal: Array, samples: int) -> Array:
    """Signal ``samples`` later, zero before."""
    late = np.zeros_like(signal)
    late[samples:] = signal[: max(len(signal) - samples, 0)]
    return late


def columns(terms: Sequence[tuple[Array, int]]) -> Array:
    """Signals side by side, each with its own delay, zero before: (N, n)."""
    samples = len(terms[0][0])
    late = np.zeros((len(terms), samples))
    for row, (signal, delay) in zip(late, terms, strict=True):
        row[delay:] = signal[: max(samples - delay, 0)]
    return late.T


def stabilised(polynomial: Array) -> Array:
    """Monic polynomial in z^-1 with roots outside the unit circle reflected into it."""
    if is_stable(polynomial):
        return polynomial
    roots = np.roots(polynomial)
    size = np.abs(roots)
    outside = size >= 1.0
    short = np.minimum(1.0 / size[outside], 0.999)
    roots[outside] *= short / size[outside]
    return np.concatenate([ONE, np.real(np.poly(roots))[1:]])


def is_stable(polynomial: Array) -> bool:
    """Whether all roots of a monic polynomial in z^-1 lie inside the unit circle.

    By the recursion of Schur and Cohn, which is faster than the roots.
    """
    a = polynomial.tolist()
    while len(a) > 1:
        k = a[-1]
        if not abs(k) < 1.0:
            return False
        rest = 1.0 - k * k
        a = [(x - k * y) / rest for x, y in zip(a[:-1], a[:0:-1], strict=True)]
    return True


def inputs_of(record: Record) -> Array:
    """Put inputs and measured disturbances side by side, (N, n_u + n_v).

    Raises
    ------
    ValueError
        If the record has neither.
    """
    parts = [part for part in (record.u, record.v) if part.size]
    if not parts:
        raise ValueError("record has no inputs u or measured disturbances v")
    return np.hstack(parts)


def input_names(record: Record) -> tuple[str, ...]:
    """Names of the columns of ``inputs_of``."""
    groups = [record.names[g] for g in ("u", "v") if getattr(record, g).size]
    return tuple(itertools.chain(*groups))
