"""Weights of designs in small tables, by the blocks of (5.6)."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from apps.pages.live import _number
from nmss_lab.design import Design
from nmss_lab.models import Array
from nmss_lab.mpc import state_weight
from nmss_lab.qp import weight

BLOCK_WORDS = {
    "weight_y": "Outputs y",
    "weight_past_u": "Past inputs u",
    "weight_integral": "Sum of the error z",
    "weight_u": "Moves \u0394u",
}

A_LINE = 5
"""Weights along the horizon in one line of a table."""


@dataclass(frozen=True, eq=False)
class Part:
    """One weight of a design: its name, and a matrix for each step or for all."""

    name: str
    steps: tuple[Array, ...]

    @cached_property
    def same(self) -> bool:
        """Whether all steps have one weight."""
        return all(np.array_equal(step, self.steps[0]) for step in self.steps)


def parts_of(design: Design) -> list[Part]:
    """Weights of a design by the blocks of (5.6), or whole where they are none."""
    model: Any = design.model
    horizon = design.horizon
    if design.structure == "pip":
        return [Part("Gain K", (np.atleast_2d(design.options["K"]),))]
    R = weight("R", design.R, horizon.Nc, model.n_u)
    moves = Part(BLOCK_WORDS["weight_u"], _each(R, horizon.Nc))
    if design.structure != "integral_of_error":
        Q = weight("Q", design.Q, horizon.Np, model.n_y)
        return [Part(BLOCK_WORDS["weight_y"], _each(Q, horizon.Np)), moves]
    moves = replace(moves, name="Inputs u")
    p, q, na, nb = model.n_y, model.n_u, model.na, model.nb
    size = p * (na + 1) + q * (nb - 1)
    steps = _each(weight("Q", design.Q, horizon.Np, size), horizon.Np)
    y = [step[:p, :p] for step in steps]
    past = [step[p * na : p * na + q, p * na : p * na + q] for step in steps]
    z = [step[-p:, -p:] for step in steps]
    whole = [state_weight(model, *parts) for parts in zip(y, past, z, strict=True)]
    if not all(np.allclose(a, b) for a, b in zip(whole, steps, strict=True)):
        return [Part("State x, whole", steps), moves]
    named = [("weight_y", y), ("weight_past_u", past), ("weight_integral", z)]
    return [
        *(Part(BLOCK_WORDS[n], tuple(s)) for n, s in named if s[0].size),
        moves,
    ]


def _each(full: Array, steps: int) -> tuple[Array, ...]:
    n = len(full) // steps
    return tuple(full[i * n : (i + 1) * n, i * n : (i + 1) * n] for i in range(steps))


def weight_table(designs: Mapping[str, Design]) -> str:
    """Weights of designs side by side, as small tables."""
    parts = {name: parts_of(design) for name, design in designs.items()}
    rows = list(dict.fromkeys(part.name for each in parts.values() for part in each))
    head = "".join(
        f'<th><span class="swatch style{i}"></span>{html.escape(name)}</th>'
        for i, name in enumerate(designs)
    )
    body = ""
    for row in rows:
        cells = ""
        for each in parts.values():
            found = next((part for part in each if part.name == row), None)
            cells += f"<td>{_part(found)}</td>" if found else "<td>\u2013</td>"
        body += f'<tr><th scope="row">{html.escape(row)}</th>{cells}</tr>'
    return (
        '<p class="quiet small">Weights</p><table class="weights">'
        f"<thead><tr><th>Block</th>{head}</tr></thead><tbody>{body}</tbody></table>"
    )


def _part(part: Part) -> str:
    """Matrix of a weight; of one along the horizon every step."""
    if part.same:
        return _matrix(part.steps[0])
    if part.steps[0].size == 1:
        numbers = [float(step[0, 0]) for step in part.steps]
        rows = [numbers[i : i + A_LINE] for i in range(0, len(numbers), A_LINE)]
        return f'<span class="quiet small">step by step</span>{_matrix(rows)}'
    return "".join(
        f'<span class="quiet small">{word}</span>{_matrix(step)}'
        for word, step in _distinct(part.steps)
    )


def _distinct(steps: Sequence[Array]) -> list[tuple[str, Array]]:
    """Join equal steps, each with its numbers in words."""
    found: list[tuple[int, int, Array]] = []
    for i, step in enumerate(steps, 1):
        if found and np.array_equal(found[-1][2], step):
            found[-1] = found[-1][0], i, step
        else:
            found.append((i, i, step))
    return [
        (f"step {a}" if a == b else f"steps {a} to {b}", step) for a, b, step in found
    ]


def _matrix(matrix: Iterable[Iterable[float]]) -> str:
    rows = "".join(
        f"<tr>{''.join(f'<td>{_number(x)}</td>' for x in row)}</tr>" for row in matrix
    )
    return f'<table class="matrix"><tbody>{rows}</tbody></table>'
