"""Inverse optimality: predictive control that feels like a loop one already has.

The weights are sought for which the unconstrained law of a predictive design is a given
proportional-integral-plus (PIP) law; then limits can be added, and nothing changes
while none of them is near.
"""

from __future__ import annotations

import dataclasses
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize

from nmss_lab.analysis import ControlPolynomials, control_polynomials, linear_loop
from nmss_lab.design import Design
from nmss_lab.models import Array, DifferenceModel
from nmss_lab.nmss import integral_of_error_form
from nmss_lab.parallel import in_order
from nmss_lab.pip import gain, pip
from nmss_lab.predictive import PredictiveController
from nmss_lab.qp import weight

EXACT = 1e-6
"""Distance below which a match counts as the law itself."""


@dataclass(frozen=True, eq=False)
class Match:
    """A predictive design whose law without limits is, or is near, a given PIP law.

    Parameters
    ----------
    design : Design
    distance : float
        Norm of the difference of the laws' coefficients relative to the given ones.
    poles, wanted_poles : arrays
        Closed-loop poles on the model: of the design, and of the given law.
    lost : float
        Share of the gain which no quadratic cost can give, see ``match``.
    """

    design: Design
    distance: float
    poles: Array
    wanted_poles: Array
    lost: float

    @property
    def is_exact(self) -> bool:
        """Whether the two laws are the same, to rounding of the search."""
        return self.distance <= EXACT


def match(
    K: Any,
    design: Design,
    starts: int = 3,
    seed: int = 0,
    evaluations: int = 20_000,
    executor: Executor | None = None,
) -> Match:
    """Find weights for which a design's law without limits is u_k = -K x_k.

    Every block of Q and R is free as a product L L', and so is the weight at the last
    step of the horizon.  A law that minimises a quadratic cost never moves on what the
    model forgets in one step (K x = 0 where A x = 0), so its loop has poles at the
    origin; and not every other gain is optimal for some cost either.  Where there is
    no exact match the nearest is returned, with its distance.

    Parameters
    ----------
    K : array (n_u, n_x) or (n_x,)
        PIP gain on the state of (3.2), as ``lq_gain`` and ``pole_gain`` return it.
    design : Design
        "integral_of_error", "wang_young" or "forward_path" with the horizon, limits
        and reading of the reference that are wanted; its weights do not matter, only
        that they can be built.  An "integral_of_error" design follows references as
        PIP does when ``reference="zero"``.
    starts, seed : int
        Starts besides the design's own weights are drawn around them.
    evaluations : int
        Designs to try at most from each start.
    executor : concurrent.futures.Executor, optional
        Where the starts are searched from, see ``nmss_lab.parallel``.

    Raises
    ------
    ValueError
        If the structure is another, K does not fit the model, or ``starts`` is not
        positive.
    """
    allowed = "integral_of_error", "wang_young", "forward_path"
    model = design.model
    if design.structure not in allowed or not isinstance(model, DifferenceModel):
        raise ValueError(
            f'structure = "{design.structure}": expected one of {", ".join(allowed)}'
        )
    if starts < 1:
        raise ValueError(f"starts = {starts}: expected at least 1")
    form = integral_of_error_form(model)
    K = gain("K", K, form)
    wanted = _coefficients(_polynomials_of_gain(K, model))
    size = float(np.linalg.norm(wanted)) or 1.0
    space, rng = _Space(design), np.random.default_rng(seed)
    jumps = rng.standard_normal((starts, space.count))
    jumps[0] = 0.0
    passes = max(evaluations // (space.count + 1), 1)
    tasks = [_Task(space, wanted / size, size, jump, passes) for jump in jumps]
    results: list[_Result] = []
    for result in in_order(_search, tasks, executor):
        results.append(result)
        if result.distance <= EXACT:
            break
    best = min(results, key=lambda result: result.distance)
    found = space.design(best.vector)
    forgotten = np.linalg.svd(form.A)[2][np.linalg.matrix_rank(form.A) :]
    return Match(
        found,
        best.distance,
        linear_loop(found.build()).poles,
        linear_loop(pip(model, K)).poles,
        float(np.linalg.norm(K @ forgotten.T) / np.linalg.norm(K)),
    )


class _Task(NamedTuple):
    """One start of the search, on any machine."""

    space: _Space
    wanted: Array
    size: float
    jump: Array
    passes: int


class _Result(NamedTuple):
    vector: Array
    distance: float


def _search(task: _Task) -> _Result:
    """Least squares over the coefficients of the law, relative to the wanted ones."""

    def missed(vector: Array) -> Array:
        try:
            controller = task.space.design(vector).build()
        except (ValueError, np.linalg.LinAlgError):
            return np.full(task.wanted.size, 1e3)
        assert isinstance(controller, PredictiveController)
        found = _coefficients(control_polynomials(controller))
        difference: Array = found / task.size - task.wanted
        return difference

    result = scipy.optimize.least_squares(
        missed,
        task.space.start + task.jump,
        x_scale="jac",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
        max_nfev=task.passes,
    )
    return _Result(result.x, float(np.linalg.norm(result.fun)))


def _polynomials_of_gain(K: Array, model: DifferenceModel) -> ControlPolynomials:
    """Polynomials of u_k = -K x_k on the state of (3.2)."""
    p, q = model.n_y, model.n_u
    on_y, on_u, on_z = np.split(K, [p * model.na, K.shape[1] - p], axis=1)
    P = on_y.reshape(q, model.na, p).transpose(1, 0, 2)
    past = on_u.reshape(q, model.nb - 1, q).transpose(1, 0, 2)
    return ControlPolynomials(P, np.concatenate([np.eye(q)[None], past]), -on_z)


def _coefficients(law: ControlPolynomials) -> Array:
    return np.concatenate([law.P.ravel(), law.L[1:].ravel(), law.K_I.ravel()])


class _Space:
    """Weights L L' of a design as one vector: of each step, of the last, of moves."""

    def __init__(self, design: Design) -> None:
        self.base = design
        model, horizon = design.model, design.horizon
        assert isinstance(model, DifferenceModel)  # checked by ``match``
        state = design.structure == "integral_of_error"
        self.n_x = integral_of_error_form(model).n_x if state else model.n_y
        self.n_u, self.Np = model.n_u, horizon.Np
        self.sizes = [self.n_x] * min(self.Np, 2 if state else self.Np)
        # One weight can be fixed: the law depends on ratios alone.
        self.moves = [self.n_u] * (horizon.Nc if not state else 1)
        self.count = sum(n * (n + 1) // 2 for n in (*self.sizes, *self.moves))
        Q = weight("Q", design.Q, self.Np, self.n_x)[: self.n_x, : self.n_x]
        R = weight("R", design.R, horizon.Nc, self.n_u)[: self.n_u, : self.n_u]
        firsts = [Q] * len(self.sizes) + [R] * len(self.moves)
        self.start = np.concatenate([_entries(part) for part in firsts])

    def design(self, vector: Array) -> Design:
        """Design with the weights of a vector."""
        sizes = [*self.sizes, *self.moves]
        counts = [n * (n + 1) // 2 for n in sizes]
        parts = np.split(vector, np.cumsum(counts)[:-1])
        weights = [_product(v, n) for v, n in zip(parts, sizes, strict=True)]
        Q, R = weights[: len(self.sizes)], weights[len(self.sizes) :]
        Q = Q[:1] * (self.Np - len(Q)) + Q
        along = np.array(R) if len(R) > 1 else R[0]
        return dataclasses.replace(self.base, Q=np.array(Q), R=along)


def _product(vector: Array, size: int) -> Array:
    L = np.zeros((size, size))
    L[np.tril_indices(size)] = vector
    product: Array = L @ L.T
    return product


def _entries(matrix: Array) -> Array:
    """Lower triangle of the factor of a weight, or of the nearest definite one."""
    sizes, axes = np.linalg.eigh(matrix)
    floor = max(1e-3 * sizes[-1], 1e-3)
    L = np.linalg.cholesky(axes * np.maximum(sizes, floor) @ axes.T)
    return L[np.tril_indices(len(L))]
