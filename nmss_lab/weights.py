"""Weights as a vector that a search may move freely: every vector is admissible.

Each block of weights is written as L L' (thesis 5.2.2); the vector holds the logarithms
of the diagonal of L and, relative to it, what stands below it in each column.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nmss_lab.design import Design
from nmss_lab.models import Array, DifferenceModel
from nmss_lab.mpc import state_weight
from nmss_lab.pip import lq_gain
from nmss_lab.qp import weight

STATE_BLOCKS = "weight_y", "weight_past_u", "weight_integral", "weight_u"
"""Blocks of (5.6): past outputs, past inputs, sum of the error, inputs."""

OUTPUT_BLOCKS = "weight_y", "weight_u"
"""Blocks of structures that weigh the output's error and moves."""

WITH_STATE = "integral_of_error", "sdp_integral_of_error", "pip", "sdp_pip"
"""Structures whose Q weighs the state of (3.2)."""


@dataclass(frozen=True)
class Block:
    """One weight: its name, its size, and whether it has entries off the diagonal."""

    name: str
    size: int
    full: bool

    @property
    def count(self) -> int:
        """Number of entries of the vector."""
        return self.size * (self.size + 1) // 2 if self.full else self.size

    def matrix(self, vector: Array) -> Array:
        """Weight (size, size) of a part of the vector."""
        diagonal = np.exp(vector[: self.size])
        L = np.eye(self.size)
        L[np.tril_indices(self.size, -1)] = vector[self.size :] if self.full else 0.0
        L = L * diagonal
        product: Array = L @ L.T
        return product

    def vector(self, matrix: Array) -> Array:
        """Part of the vector for a weight, or for the nearest positive definite one."""
        sizes, axes = np.linalg.eigh((matrix + matrix.T) / 2.0)
        floor = max(1e-4 * sizes[-1], 1e-6)
        if not self.full:
            return np.log(np.maximum(np.diag(matrix), floor)) / 2.0
        if sizes[0] < floor:
            matrix = axes * np.maximum(sizes, floor) @ axes.T
        L = np.linalg.cholesky(matrix)
        diagonal = np.diag(L)
        below = (L / diagonal)[np.tril_indices(self.size, -1)]
        return np.concatenate([np.log(diagonal), below])


@dataclass(frozen=True, eq=False)
class Weights:
    """Weights of a design that may change, as a vector: (5.6), or (5.4) by steps.

    Parameters
    ----------
    design : Design
        Any structure with weights Q and R; of PIP, those of its LQ gain.
    full : bool or names of blocks
        Which blocks have entries off the diagonal; all, none, or these of
        ``STATE_BLOCKS`` or ``OUTPUT_BLOCKS``.
    fixed : names of blocks
        Which stay as they are.
    per_step : bool
        A weight of its own for every step of the horizons, (5.4).

    Raises
    ------
    ValueError
        If the structure has no weights, or a name is not one of its blocks.
    """

    design: Design
    full: bool | Collection[str] = True
    fixed: Collection[str] = ()
    per_step: bool = False

    def __post_init__(self) -> None:
        """Check structure and names."""
        if self.design.structure in ("governor", "sdp_governor"):
            raise ValueError(
                f'structure = "{self.design.structure}" has no weights to tune: tune '
                "the PIP controller inside, or use a predictive structure"
            )
        if self.per_step and self.design.structure in ("pip", "sdp_pip"):
            raise ValueError("per_step = True: a PIP gain has one weight for all steps")
        full = self.full if not isinstance(self.full, bool) else ()
        for name in (*full, *self.fixed):
            if name not in self.names:
                raise ValueError(
                    f'block "{name}": this structure has {", ".join(self.names)}'
                )
        if not self.blocks:
            raise ValueError("fixed names every block: nothing is left to tune")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the structure's blocks."""
        if self._weighs_state:
            if self._nb == 1:
                return tuple(n for n in STATE_BLOCKS if n != "weight_past_u")
            return STATE_BLOCKS
        return OUTPUT_BLOCKS

    @property
    def _weighs_state(self) -> bool:
        return self.design.structure in WITH_STATE

    @property
    def _model(self) -> DifferenceModel:
        """Model with the sizes of the state that is weighed.

        A state-dependent model remembers what its coefficients read as well, but that
        has no weight.
        """
        model = self.design.model
        if isinstance(model, DifferenceModel):
            return model
        past_y = np.zeros((model.na, model.n_y, model.n_y))
        return model.model_of(past_y, np.zeros((model.nb, model.n_y, model.n_u)))

    @property
    def _nb(self) -> int:
        return self._model.nb

    @cached_property
    def blocks(self) -> tuple[Block, ...]:
        """Blocks that may change, in the order of the vector."""
        horizon, model = self.design.horizon, self._model
        found = []
        for name in self.names:
            size = model.n_u if name.endswith("_u") else model.n_y
            full = self.full if isinstance(self.full, bool) else name in self.full
            steps = horizon.Nc if name == "weight_u" else horizon.Np
            labels = (
                [f"{name}[{i + 1}]" for i in range(steps)] if self.per_step else [name]
            )
            if name not in self.fixed:
                found += [Block(label, size, full and size > 1) for label in labels]
        return tuple(found)

    @property
    def count(self) -> int:
        """Length of the vector."""
        return sum(block.count for block in self.blocks)

    @cached_property
    def start(self) -> Array:
        """Vector of the design's own weights, or of the nearest admissible ones."""
        own = self.own
        return np.concatenate([b.vector(own[b.name]) for b in self.blocks])

    def bounds(self, low: float, high: float) -> tuple[Array, Array]:
        """Bounds of the vector for weights between ``low`` and ``high``."""
        ends = []
        for end, factor in ((low, -10.0), (high, 10.0)):
            parts = [
                np.concatenate(
                    [
                        np.full(b.size, np.log(end) / 2.0),
                        np.full(b.count - b.size, factor),
                    ]
                )
                for b in self.blocks
            ]
            ends.append(np.concatenate(parts))
        return ends[0], ends[1]

    def matrices(self, vector: Array) -> dict[str, Array]:
        """Weights by name, the fixed ones included."""
        parts = np.split(vector, np.cumsum([b.count for b in self.blocks])[:-1])
        moved = {
            b.name: b.matrix(part) for b, part in zip(self.blocks, parts, strict=True)
        }
        return {**self.own, **moved}

    def apply(self, vector: Array) -> Design:
        """Design with the weights of a vector."""
        return self.dressed(self.matrices(vector))

    def dressed(self, found: Mapping[str, Array]) -> Design:
        """Design with weights that are given by name, as ``matrices`` returns them."""
        R = self._along(found, "weight_u", self.design.horizon.Nc)
        if not self._weighs_state:
            Q = self._along(found, "weight_y", self.design.horizon.Np)
            return dataclasses.replace(self.design, Q=Q, R=R)
        names = STATE_BLOCKS[:-1]
        along = {
            name: self._along(found, name, self.design.horizon.Np)
            for name in names
            if name in self.names
        }
        if self.per_step:
            Q = np.stack(
                [
                    self._state(*(along.get(n, along["weight_y"])[i] for n in names))
                    for i in range(self.design.horizon.Np)
                ]
            )
        else:
            Q = self._state(*(along.get(n, along["weight_y"]) for n in names))
        if self.design.structure == "pip":
            K = lq_gain(self._model, Q, R)
            options = {**self.design.options, "K": K}
            return dataclasses.replace(self.design, options=options, Q=Q, R=R)
        # The gain of a state-dependent PIP is that of the weights, not of given poles.
        options = {k: v for k, v in self.design.options.items() if k != "poles"}
        return dataclasses.replace(self.design, options=options, Q=Q, R=R)

    def _state(self, *parts: Array) -> Array:
        return state_weight(self._model, *parts)

    def _along(self, found: Mapping[str, Array], name: str, steps: int) -> Array:
        """Weight of a name: one matrix, or one a step."""
        if not self.per_step:
            return found[name]
        return np.stack([found[f"{name}[{i + 1}]"] for i in range(steps)])

    @cached_property
    def own(self) -> dict[str, Array]:
        """Weights of the design itself by name, as far as blocks can say."""
        design, model, horizon = self.design, self._model, self.design.horizon
        R = weight("R", design.R, horizon.Nc, model.n_u)
        n_x = model.n_y * (model.na + 1) + model.n_u * (model.nb - 1)
        size = n_x if self._weighs_state else model.n_y
        Q = weight("Q", design.Q, horizon.Np, size)
        steps_Q, steps_R = _steps(Q, size), _steps(R, model.n_u)
        found: dict[str, Array] = {}
        for name in self.names:
            many = steps_R if name == "weight_u" else steps_Q
            each = [self._part(name, step) for step in many]
            if self.per_step:
                found |= {f"{name}[{i + 1}]": part for i, part in enumerate(each)}
            else:
                found[name] = each[0]
        return found

    def _part(self, name: str, step: Array) -> Array:
        """Block of one step's weight."""
        if not self._weighs_state or name == "weight_u":
            return step
        model = self._model
        outputs = model.n_y * model.na
        first = {
            "weight_y": 0,
            "weight_past_u": outputs,
            "weight_integral": len(step) - model.n_y,
        }[name]
        size = model.n_u if name == "weight_past_u" else model.n_y
        return step[first : first + size, first : first + size]


def _steps(full: Array, size: int) -> list[Array]:
    """Blocks on the diagonal."""
    return [full[i : i + size, i : i + size] for i in range(0, len(full), size)]
