"""Prediction matrices of 8.3.2 and 8.4 on a model that differs at every step.

The plants of 8.5 have a constant A, which hides errors of an index; here A and b are
drawn anew for each step, and every printed formula is compared with a forward run.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from nmss_lab.models import Array, DifferenceModel
from nmss_lab.nmss import Layout, integral_of_error_form
from nmss_lab.predict import Affine, Horizon, blocks, known_part, predict
from nmss_lab.reproduce.rows import Claim, claim

NP, NC, SIZE = 7, 3, 4
"""Horizons and size of the state of the synthetic sequence."""

ROUNDING = 1e-10, "rounding"


@dataclass(frozen=True, eq=False)
class Sequence:
    """Matrices of each step, from sample k on, and the constant d."""

    A: Array
    b: Array
    d: Array

    def chain(self, i: int, j: int) -> Array:
        """Z^{i,j} = A_{k+i-1} ... A_{k+j}; the identity where there is no factor."""
        product = np.eye(SIZE)
        for A in self.A[j:i]:
            product = A @ product
        return product

    def forward(self, decided: Array, last: Array) -> Affine:
        """States of a forward run; inputs are ``decided @ z + last u_{k-1}``.

        The known vector is [x_k; u_{k-1}; r_{k+1} ... r_{k+Np}].
        """
        known = Layout(x=SIZE, u=1, r=(NP, 1))
        inputs = Affine(decided, last @ known.select("u"))
        entering = [self.d[:, None] @ r for r in blocks(known_part(known, "r", NC), 1)]
        state = known_part(known, "x", NC)
        B = list(self.b[:, :, None])
        return predict(list(self.A), B, state, blocks(inputs, 1), entering)


@functools.cache
def drawn(constant: bool = False) -> Sequence:
    """Draw a sequence, or one matrix for all steps."""
    rng = np.random.default_rng(8)
    A, b = rng.standard_normal((NP, SIZE, SIZE)), rng.standard_normal((NP, SIZE))
    d = rng.standard_normal(SIZE)
    if constant:
        A, b = np.repeat(A[:1], NP, axis=0), np.repeat(b[:1], NP, axis=0)
    return Sequence(A, b, d)


@functools.cache
def levels(constant: bool = False) -> Affine:
    """Forward run under decided inputs, the last one held (8.3)."""
    return drawn(constant).forward(Horizon(NP, NC).held(1), np.zeros((NP, 1)))


@functools.cache
def increments(constant: bool = False) -> Affine:
    """Forward run under decided changes of the input (8.4)."""
    moves = Horizon(NP, NC).impulses(1).cumsum(axis=0)
    return drawn(constant).forward(moves, np.ones((NP, 1)))


def table(rows: int, columns: int, entry: Callable[[int, int], Array]) -> Array:
    """Block matrix of columns of SIZE entries; ``entry(i, j)`` counts from 1."""
    row = [
        np.column_stack([entry(i, j) for j in range(1, columns + 1)])
        for i in range(1, rows + 1)
    ]
    return np.vstack(row)


def gap(printed: Array, run: Array) -> float:
    """Largest difference."""
    return float(np.abs(printed - run).max())


def _formula(
    where: str,
    name: str,
    statement: str,
    ours: float,
    erratum: str = "",
    because: str = "",
    note: str = "",
) -> Claim:
    told = f"{statement}; largest difference from a forward run"
    return claim(
        where, name, told, 0.0, ours, *ROUNDING, erratum, because=because, note=note
    )


def free_response() -> Iterator[Claim]:
    """Compare F and H_r of (8.5a)."""
    s, run = drawn(), levels()
    F = np.vstack([s.chain(i, 0) for i in range(1, NP + 1)])
    H = table(NP, NP, lambda i, j: s.chain(i, j) @ s.d if j <= i else np.zeros(SIZE))
    yield _formula(
        "8.3.2, (8.5a)",
        "F and H_r",
        "products of the A of each step give F_k and H_r,k",
        max(gap(F, run.known[:, :SIZE]), gap(H, run.known[:, SIZE + 1 :])),
    )


def chains() -> Iterator[Claim]:
    """Compare the two ways to go on from one Z to the next."""
    s, where = drawn(), "8.3.2"
    pairs = [(i, j) for i in range(2, NP) for j in range(i - 1)]
    yield _formula(
        where,
        "Z, next row",
        "Z^{i+1,j} is A_{k+i} Z^{i,j}",
        max(gap(s.A[i] @ s.chain(i, j), s.chain(i + 1, j)) for i, j in pairs),
    )
    right = max(
        gap(s.chain(i, j) @ np.linalg.inv(s.A[j]), s.chain(i, j + 1)) for i, j in pairs
    )
    literal = max(
        gap(s.chain(i, j) @ np.linalg.inv(s.A[j - 1]), s.chain(i, j + 1))
        for i, j in pairs
        if j
    )
    yield _formula(
        where,
        "Z, next column, as printed",
        "Z^{i,j+1} is Z^{i,j} times the inverse of A_{k+j-1}",
        literal,
        because="the factor to take off is A_{k+j}; see E8.2",
    )
    yield claim(
        where,
        "Z, next column",
        "the same with A_{k+j}, for matrices that have an inverse; largest difference "
        "from a forward run",
        0.0,
        right,
        1e-8,
        "rounding, made larger by the inverses",
        erratum="E8.2",
    )
    form = integral_of_error_form(DifferenceModel([-0.7, 0.1], [1.0, 0.5]))
    yield claim(
        where,
        "Z, an inverse exists",
        "A of (3.3) has the inverse that the recursion asks for; here n = m = 2",
        True,
        bool(np.linalg.matrix_rank(form.A) == form.n_x),
        because=f"a past input is remembered from u_k alone: rank "
        f"{np.linalg.matrix_rank(form.A)} of {form.n_x}; predictions are rolled "
        "forward instead, see E8.2",
    )


def _own_b(s: Sequence, i: int, j: int) -> Array:
    return s.chain(i, j) @ s.b[j - 1] if j <= i else np.zeros(SIZE)


def _printed_b(s: Sequence, i: int, j: int) -> Array:
    return s.chain(i, j) @ s.b[min(j, 2) - 1] if j <= i else np.zeros(SIZE)


def forced_response() -> Iterator[Claim]:
    """Compare Phi of (8.5b)."""
    s, where = drawn(), "8.3.2, (8.5b)"
    free = s.forward(Horizon(NP, NC).impulses(1), np.zeros((NP, 1))).gain
    yield _formula(
        where,
        "Phi, as printed",
        "from the third column of Phi_k on, entries carry b_{k+1}",
        gap(table(NP, NC, lambda i, j: _printed_b(s, i, j)), free),
        because="column j carries b_{k+j-1}; see E8.4",
    )
    yield _formula(
        where,
        "Phi",
        "Phi_k with the b of the column's own step",
        gap(table(NP, NC, lambda i, j: _own_b(s, i, j)), free),
        erratum="E8.4",
    )


def held_input() -> Iterator[Claim]:
    """Compare W, what the held input adds after the control horizon."""
    s, where = drawn(), "8.3.2"
    free = s.forward(Horizon(NP, NC).impulses(1), np.zeros((NP, 1))).gain
    after = (levels().gain - free)[:, -1].reshape(NP, SIZE)
    rows = range(NC + 1, NP + 1)

    def summed(i: int, upper: int) -> Array:
        terms = [s.chain(upper, NC + n) @ s.b[NC + n - 1] for n in range(1, i - NC)]
        return np.asarray(s.b[i - 1] + sum(terms))

    yield _formula(
        where,
        "W, as printed",
        "W^i sums products Z^{i-Nc-1, Nc+l} b",
        max(gap(summed(i, i - NC - 1), after[i - 1]) for i in rows),
        because="the products reach up to step i: Z^{i, Nc+l}; see E8.3",
        note="as our copy of the text, read by machine, has it",
    )
    yield _formula(
        where,
        "W",
        "W^i sums products Z^{i, Nc+l} b",
        max(gap(summed(i, i), after[i - 1]) for i in rows),
        erratum="E8.3",
    )
    yield from _held_recursion(s, after)


def _held_recursion(s: Sequence, after: Array) -> Iterator[Claim]:
    steps = range(NC + 1, NP)

    def following(i: int, which: int) -> float:
        return gap(s.b[i] + s.A[which] @ after[i - 1], after[i])

    yield _formula(
        "8.3.2",
        "W, recursion as printed",
        "W^{i+1} is b_{k+i} + A_{k+i+1} W^i, from W^{Nc+1} = b_{k+Nc}",
        max(following(i, i + 1) for i in steps if i + 1 < NP),
        because="the step is that of sample k+i: A_{k+i}; see E8.3",
    )
    start = gap(s.b[NC], after[NC])
    yield _formula(
        "8.3.2",
        "W, recursion",
        "W^{i+1} is b_{k+i} + A_{k+i} W^i, from W^{Nc+1} = b_{k+Nc}",
        max(start, *(following(i, i) for i in steps)),
        erratum="E8.3",
    )


def _powers(s: Sequence, count: int) -> Array:
    """(I + A + ... + A^{count-1}) b of a constant model."""
    total = np.zeros(SIZE)
    for _ in range(count):
        total = s.A[0] @ total + s.b[0]
    return total


def frozen_increments() -> Iterator[Claim]:
    """Compare the frozen predictions of 8.4.1."""
    s, run, where = drawn(constant=True), increments(constant=True), "8.4.1"
    r = run.known[:, SIZE + 1 :]
    right = table(
        NP, NP, lambda i, j: s.chain(i, j) @ s.d if j <= i else np.zeros(SIZE)
    )
    literal = table(
        NP, NP, lambda i, j: _powers(s, i + 1 - j) if j <= i else np.zeros(SIZE)
    )
    yield _formula(
        where,
        "references in the sum, as printed",
        "in the general prediction r_{k+l+1} enters like a change of the input, by "
        "sums of A^j b",
        gap(literal, r),
        because="the reference enters by d, once, and then by A^{i-1-l} d; see E8.5",
    )
    yield _formula(
        where,
        "references in the sum",
        "in the general prediction r_{k+l+1} enters by A^{i-1-l} d",
        gap(right, r),
        erratum="E8.5",
    )
    first = table(NP, 1, lambda i, _: _powers(s, i))
    yield _formula(
        "8.4.1, (8.8)",
        "Phi_2",
        "u_{k-1} enters by the sums of A^j b",
        gap(first, run.known[:, SIZE : SIZE + 1]),
    )
    moves = table(NP, NC, lambda i, j: _powers(s, max(i + 1 - j, 0)))
    printed = moves.copy()
    printed[NC * SIZE : (NC + 1) * SIZE, -1] = s.A[0] @ s.b[0]
    yield _formula(
        "8.4.1, (8.8)",
        "Phi_3, as printed",
        "row N_c + 1 of Phi_3 ends with A b",
        gap(printed, run.gain),
        because="the sum has two terms there, A b + b; see E8.5",
    )
    yield _formula(
        "8.4.1, (8.8)",
        "Phi_3",
        "changes of the input enter by the sums of A^j b",
        gap(moves, run.gain),
        erratum="E8.5",
    )


def varying_increments() -> Iterator[Claim]:
    """Compare W-tilde of 8.4.2."""
    s, run = drawn(), increments()
    true = run.gain.reshape(NP, SIZE, NC)

    def summed(i: int, j: int, own: bool) -> Array:
        terms = [s.chain(i, n if own else j) @ s.b[n - 1] for n in range(j, i)]
        return np.asarray(s.b[i - 1] + sum(terms)) if j <= i else np.zeros(SIZE)

    yield _formula(
        "8.4.2",
        "W-tilde, as printed",
        "the sum over l multiplies each b by the same Z^{i,j}",
        gap(table(NP, NC, lambda i, j: summed(i, j, own=False)), run.gain),
        because="the factor moves with l: Z^{i,l}; see E8.6",
    )
    yield _formula(
        "8.4.2, (8.10)",
        "Phi_2 and Phi_3",
        "W-tilde with Z^{i,l} fills Phi_2 and Phi_3 of (8.10)",
        max(
            gap(table(NP, NC, lambda i, j: summed(i, j, own=True)), run.gain),
            gap(run.gain[:, :1], run.known[:, SIZE : SIZE + 1]),
        ),
        erratum="E8.6",
    )
    down = [
        gap(s.A[i] @ true[i - 1, :, j - 1] + s.b[i], true[i, :, j - 1])
        for i in range(1, NP)
        for j in range(1, min(i, NC) + 1)
    ]
    across = [
        gap(true[i - 1, :, j - 1] - s.chain(i, j) @ s.b[j - 1], true[i - 1, :, j])
        for i in range(2, NP + 1)
        for j in range(1, min(i, NC))
    ]
    yield _formula(
        "8.4.2",
        "W-tilde, recursions",
        "both recursions for W-tilde, started with b_k",
        max(gap(s.b[0], true[0, :, 0]), *down, *across),
    )


TOPICS_8_3 = (free_response, chains, forced_response, held_input)
"""Formulas of 8.3.2."""

TOPICS_8_4 = (frozen_increments, varying_increments)
"""Formulas of 8.4."""
