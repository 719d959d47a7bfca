"""Random models, histories and controllers, and what they should predict.

Everything here is written with plain loops over the difference equation (2.1), (7.1),
so that the library's matrices are compared with something that has none.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

from nmss_lab.controller import Controller, Memory
from nmss_lab.models import DifferenceModel

SIZES = [
    # n_y, n_u, n_v, na, nb, ng
    (1, 1, 0, 1, 1, 0),
    (1, 1, 1, 2, 1, 1),
    (1, 1, 0, 2, 3, 0),
    (2, 2, 0, 1, 1, 0),
    (2, 2, 1, 2, 2, 3),
    (2, 1, 2, 1, 3, 2),
    (1, 2, 1, 3, 2, 1),
    (3, 2, 2, 2, 1, 2),
]
"""Sizes that matter: nb = 1, no disturbance, more inputs than outputs and fewer."""


def random_model(
    rng: np.random.Generator,
    n_y: int = 1,
    n_u: int = 1,
    n_v: int = 0,
    na: int = 2,
    nb: int = 2,
    ng: int = 0,
    radius: float = 0.9,
) -> DifferenceModel:
    """Return a model whose largest pole has the modulus ``radius``."""
    a = rng.standard_normal((na, n_y, n_y))
    b = rng.standard_normal((nb, n_y, n_u))
    g = rng.standard_normal((ng, n_y, n_v)) if ng and n_v else None
    largest = np.abs(DifferenceModel(a, b).poles()).max()
    # a_i s**i moves every pole from p to s p
    a = a * (radius / largest) ** np.arange(1, na + 1)[:, None, None]
    return DifferenceModel(a, b, g)


@st.composite
def models(draw: st.DrawFn, square: bool = False, disturbed: bool = False):
    """Draw a stable model of any sizes, nb = 1 and ng = 0 included."""
    n_y = draw(st.integers(1, 3), label="n_y")
    n_u = n_y if square else draw(st.integers(1, 3), label="n_u")
    n_v = draw(st.integers(int(disturbed), 2), label="n_v")
    na = draw(st.integers(1, 3), label="na")
    nb = draw(st.integers(1, 3), label="nb")
    ng = draw(st.integers(1, 3), label="ng") if n_v else 0
    radius = draw(st.sampled_from([0.3, 0.8, 1.0, 1.1]), label="radius")
    rng = np.random.default_rng(draw(st.integers(0, 10_000), label="seed"))
    return random_model(rng, n_y, n_u, n_v, na, nb, ng, radius)


@st.composite
def horizons(draw: st.DrawFn) -> tuple[int, int]:
    """Draw Np and Nc <= Np."""
    Np = draw(st.integers(1, 7), label="Np")
    return Np, draw(st.integers(1, Np), label="Nc")


def positive(rng: np.random.Generator, size: int) -> np.ndarray:
    """Return a full, well conditioned positive definite matrix."""
    root = rng.standard_normal((size, size))
    return root @ root.T / size + 0.2 * np.eye(size)


def next_output(model: DifferenceModel, y: list, u: list, v: list) -> np.ndarray:
    """Return the output that follows histories which end with the newest sample."""
    following = np.zeros(model.n_y)
    for i in range(model.na):
        following = following - model.a[i] @ past(y, i, model.n_y)
    for i in range(model.nb):
        following = following + model.b[i] @ past(u, i, model.n_u)
    for i in range(model.ng):
        following = following + model.g[i] @ past(v, i, model.n_v)
    return following


def past(series: list, i: int, size: int) -> np.ndarray:
    """Return the value i samples before the newest; zero before the start."""
    return series[-1 - i] if i < len(series) else np.zeros(size)


def roll_out(
    model: DifferenceModel, y: list, u: list, v: list, u_ahead: list, v_ahead: list
) -> list:
    """Return the outputs k+1.. of (7.1) for histories y to k, u to k-1, v to k-1.

    ``v_ahead`` starts with v_k, ``u_ahead`` with u_k.
    """
    y, u, v = list(y), list(u), list(v)
    for u_next, v_next in zip(u_ahead, v_ahead, strict=True):
        u.append(u_next)
        v.append(v_next)
        y.append(next_output(model, y, u, v))
    return y[len(y) - len(u_ahead) :]


def changes(series: list) -> list:
    """Return the changes of a series that was zero before it began."""
    return [
        value - (series[i - 1] if i else np.zeros_like(value))
        for i, value in enumerate(series)
    ]


def roll_out_changes(
    model: DifferenceModel, y: list, u: list, v: list, u_ahead: list, v_ahead: list
) -> list:
    """Return outputs k+1.. of the differenced equation (4.1), (7.1).

    Any constant disturbance of the output is carried along.
    """
    all_u, all_v = changes([*u, *u_ahead]), changes([*v, *v_ahead])
    change, level, ahead = changes(y), y[-1], []
    for i in range(len(u_ahead)):
        k = len(u) + i
        change.append(next_output(model, change, all_u[: k + 1], all_v[: k + 1]))
        level = level + change[-1]
        ahead.append(level)
    return ahead


@dataclass
class History:
    """What a loop saw until sample k, oldest first; the measured r includes r_k."""

    memory: Memory
    y: list
    u: list
    v: list
    r: list
    w: list
    known: np.ndarray


def play(
    controller: Controller,
    rng: np.random.Generator,
    steps: int = 9,
    consistent: bool = False,
    offset: float = 0.0,
    r_ahead: np.ndarray | None = None,
    v_ahead: np.ndarray | None = None,
    own: bool = False,
) -> History:
    """Feed a controller random inputs, references, disturbances and outputs.

    The outputs are random too, or those of the model plus ``offset`` when they are to
    be ``consistent``.  The inputs count as the controller's own decisions, and with
    ``own`` they are (a governor tells its gain's input from any other).  The last
    sample is measured and decided; ``known`` is its theta for the future given
    (without the present value).
    """
    model = controller.model
    memory = controller.start()
    y, u, v, r, w = [], [], [], [], []
    for k in range(steps):
        true = next_output(model, [each - offset for each in y], u, v)
        y.append(true + offset if consistent else rng.standard_normal(model.n_y))
        r.append(rng.standard_normal(model.n_y))
        v.append(rng.standard_normal(model.n_v))
        memory = controller.measure(memory, y[-1], r[-1], v[-1])
        if k == steps - 1:
            break
        u.append(rng.standard_normal(model.n_u))
        w.append(rng.standard_normal(model.n_y))
        move = controller.decide(memory)
        if own:
            u[-1], w[-1] = move.u, move.governed
        move = dataclasses.replace(move, u=u[-1], governed=w[-1])
        memory = controller.apply(memory, u[-1], move)
    ahead_r = None if r_ahead is None else np.vstack([r[-1], r_ahead])
    ahead_v = None if v_ahead is None else np.vstack([v[-1], v_ahead])
    move = controller.decide(memory, ahead_r, ahead_v)
    return History(memory, y, u, v, r, w, move.known)


def relative(found: np.ndarray, wanted: np.ndarray) -> float:
    """Return the largest difference relative to the largest entry (or to 1e-3)."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    assert found.shape == wanted.shape, f"{found.shape} instead of {wanted.shape}"
    size = max(np.abs(wanted).max(initial=0.0), 1e-3)
    return float(np.abs(found - wanted).max(initial=0.0) / size)
