"""Inverse optimality: predictive control that feels like a loop one already has.

``match`` seeks the weights for which the unconstrained law of a predictive design is a
given proportional-integral-plus (PIP) law; then limits can be added, and nothing
changes while none of them is near.  ``equal_speed`` asks for less: another structure
that is as fast, so that the two can be compared.
"""

from __future__ import annotations

import dataclasses
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize

from nmss_lab.analysis import ControlPolynomials, control_polynomials, linear_loop
from nmss_lab.controller import Limits
from nmss_lab.design import Design
from nmss_lab.measures import first_reach
from nmss_lab.models import Array, DifferenceModel
from nmss_lab.mpc import STRUCTURES, state_weight
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


FACTORS = np.geomspace(1e-5, 1e5, 11)
"""Factors on R that bracket the one which gives a wanted rise."""

LONGEST = 1000
"""Samples within which a loop has to rise."""


def equal_speed(design: Design, structure: str) -> Design:
    """Turn a predictive design into one of another structure that is as fast.

    Structures that weigh predicted errors and moves take the weights over: without
    limits, on the model, they are the same law.  From these to "integral_of_error" and
    back the weight of the outputs is kept, and R multiplied by the factor for which
    outputs rise on the model as fast as before, each for a step of its own reference,
    in the mean; where none does, by the one which comes nearest.  The sum of the error
    weighs 0.3 of the outputs, over that factor, and past inputs nothing.

    Parameters
    ----------
    design : Design
        Of a predictive structure, on a difference equation.
    structure : str
        A name in ``nmss_lab.mpc.STRUCTURES``.

    Raises
    ------
    ValueError
        If either structure is another, the new one does not suit the model, or the
        design's outputs do not rise.
    """
    model = design.model
    for name in (design.structure, structure):
        if name not in STRUCTURES:
            raise ValueError(
                f'structure = "{name}": expected one of {", ".join(STRUCTURES)}'
            )
    assert isinstance(model, DifferenceModel)  # as the structure is predictive
    if structure == design.structure:
        return design
    STRUCTURES[structure](model, design.horizon, 1.0, 1.0)  # whether it suits the model
    sums = "integral_of_error"
    if sums not in (structure, design.structure):
        return dataclasses.replace(design, structure=structure, options={})
    size = integral_of_error_form(model).n_x if design.structure == sums else model.n_y
    Q = weight("Q", design.Q, design.horizon.Np, size)[: model.n_y, : model.n_y]
    R = weight("R", design.R, design.horizon.Nc, model.n_u)[: model.n_u, : model.n_u]

    def made(log_factor: float) -> Design:
        factor = np.exp(log_factor)
        if structure == sums:
            weights = state_weight(model, Q / model.na, 0.0, 0.3 / factor * Q)
        else:
            weights = model.na * Q
        return dataclasses.replace(
            design,
            structure=structure,
            Q=weights,
            R=factor * R,
            reference="zero" if structure == sums else "held",
            options={},
        )

    wanted = _rise(design)
    if not np.isfinite(wanted):
        raise ValueError(
            f"the design's outputs do not rise within {LONGEST} samples on the model: "
            "there is no speed to be equal to"
        )

    def slower(log_factor: float) -> float:
        return _rise(made(log_factor)) - wanted

    logs = np.log(FACTORS)
    missed = np.array([slower(x) for x in logs])
    turns = np.flatnonzero((missed[:-1] < 0.0) & (missed[1:] >= 0.0))
    if len(turns):
        low, high = (float(logs[turns[0] + i]) for i in (0, 1))
        best = float(scipy.optimize.brentq(slower, low, high, xtol=1e-4))
    elif np.isfinite(missed).any():
        best = float(logs[np.nanargmin(np.abs(missed))])
    else:
        raise ValueError(f"{structure} does not rise on the model with any R")
    return made(best)


def _rise(design: Design) -> float:
    """Mean rise time of the outputs on the model without limits, or nan."""
    model = design.model
    assert isinstance(model, DifferenceModel)
    try:
        controller = dataclasses.replace(design, limits=Limits()).build()
    except (ValueError, np.linalg.LinAlgError):
        return np.nan
    loop = linear_loop(controller)
    if not loop.is_stable:
        return np.nan
    state = np.zeros((len(loop.A), model.n_y))
    by_r, done = loop.B_r.sum(axis=0), []
    for _ in range(LONGEST):
        done.append(np.diag(loop.C @ state))
        if (np.array(done) >= 0.9).any(axis=0).all():
            break
        state = loop.A @ state + by_r
    t, responses = model.dt * np.arange(len(done)), np.array(done).T
    rises = [first_reach(t, y, 0.9) - first_reach(t, y, 0.1) for y in responses]
    return float(np.mean(rises))
