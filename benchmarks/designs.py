"""Time to build a controller beside the algebra that nobody can avoid.

Run as ``python benchmarks/designs.py``.  The baseline condenses the same program by
plain NumPy: a forward run of the model, the products of the weighed predictions, one
Cholesky factorisation.  It checks nothing, keeps no labels and can do nothing else.
How both grow is measured over Np = 10 to 400 and, with plants of one input and one
output whose difference equations grow longer, over n_x = 4 to 100; the exponents are
those of a straight line through the logarithms of the upper half.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import scipy.linalg
from frame import Figure, compared, in_turns, show
from steps import loops

from nmss_lab.controller import Limits
from nmss_lab.design import Design
from nmss_lab.models import DifferenceModel
from nmss_lab.plots import Chart, Curve
from nmss_lab.predict import Horizon
from nmss_lab.predictive import PredictiveController
from nmss_lab.svg import svg

PART = "Design"
ROUNDS, QUICK = 40, 3
HORIZONS = 10, 20, 50, 100, 200, 400
STATES = 4, 10, 20, 40, 70, 100
MILLISECONDS = 5.0
HERE = Path(__file__).resolve().parent


def condensed(controller: PredictiveController, Q: np.ndarray, R: np.ndarray) -> object:
    """Condense the program of ``wang_young`` by plain NumPy and factorise it."""
    form, horizon = controller.form, controller.horizon
    n_x, n_u = form.B.shape
    n_z, n_y = horizon.Nc * n_u, len(form.C)
    table = np.zeros((n_x, n_z + n_x))
    table[:, n_z:] = np.eye(n_x)
    H, f = np.kron(np.eye(horizon.Nc), R), np.zeros((n_z, n_x))
    rows = []
    for i in range(horizon.Np):
        table = form.A @ table
        if i < horizon.Nc:
            table[:, i * n_u : (i + 1) * n_u] += form.B
        y = form.C @ table
        weighed = Q @ y
        H += y[:, :n_z].T @ weighed[:, :n_z]
        f += y[:, :n_z].T @ weighed[:, n_z:]
        rows.append(y)
    factor = scipy.linalg.cho_factor(H)
    return factor, scipy.linalg.cho_solve(factor, f), np.concatenate(rows), n_y


def milliseconds(
    tasks: dict[str, Callable[[], object]], rounds: int
) -> dict[str, list[float]]:
    """Milliseconds of all tasks, in turns."""
    taken, _ = in_turns(tasks, rounds)
    return {name: [1e3 * each for each in times] for name, times in taken.items()}


def tasks(design: Design) -> tuple[PredictiveController, dict[str, Callable]]:
    """Build, and condense by plain NumPy, a design of ``wang_young``."""
    controller = design.build()
    assert isinstance(controller, PredictiveController)
    n_y, n_u = controller.model.n_y, controller.model.n_u
    Q, R = np.eye(n_y), np.eye(n_u)
    both = {
        "ours": lambda: design.build().laws,
        "plain": lambda: condensed(controller, Q, R),
    }
    return controller, both


def measure(
    quick: bool = False, say: Callable[[str], None] = print
) -> Iterator[Figure]:
    """Measure the four loops' designs, and growth."""
    rounds = QUICK if quick else ROUNDS
    for loop in loops():
        say(f"designs: {loop.title}")
        controller, both = tasks(loop.design)
        taken = milliseconds(both, rounds)
        size = (
            f"{loop.title}: Np = {controller.horizon.Np}, n_x = "
            f"{controller.form.n_x}, {controller.n_z} variables"
        )
        yield compared(
            PART,
            "building a controller",
            size,
            taken["ours"],
            "condensing and one Cholesky factorisation",
            taken["plain"],
            "ms",
            target=f"below {MILLISECONDS:g} ms",
            bound=MILLISECONDS / float(np.median(taken["plain"])),
        )
    yield from growth(rounds, quick, say)


def long_model(n_x: int) -> DifferenceModel:
    """Stable difference equation whose state of (4.5) has n_x entries."""
    na = n_x // 2
    poles = 0.9 * np.exp(1j * np.linspace(0.1, 1.5, na // 2))
    a = np.poly(np.concatenate([poles, poles.conj()])).real
    a = np.convolve(a, [1.0, -0.5]) if na % 2 else a
    return DifferenceModel(a[1:], 0.01 * np.ones(n_x - na))


def growth(rounds: int, quick: bool, say: Callable[[str], None]) -> Iterator[Figure]:
    """Exponents over the horizon and over the length of the state, with a picture."""
    limits = Limits(u=(-1.0, 1.0))
    example = loops()[3].design
    over = {
        "Np": [
            (Np, dataclasses.replace(example, horizon=Horizon(Np, 7)))
            for Np in HORIZONS
        ],
        "n_x": [
            (n, Design("wang_young", long_model(n), Horizon(50, 5), 1.0, 1.0, limits))
            for n in STATES
        ],
    }
    titles = {"Np": "gasifier, Nc = 7", "n_x": "one input, Np = 50, Nc = 5"}
    charts = []
    for name, designs in over.items():
        say(f"designs: growth with {name}")
        sizes, ours, plain = [], [], []
        for size, design in designs[:: 3 if quick else 1]:
            taken = milliseconds(tasks(design)[1], max(3, rounds // 4))
            sizes.append(float(size))
            ours.append(taken["ours"])
            plain.append(taken["plain"])
        half = min(len(sizes) // 2, len(sizes) - 2)
        mine, theirs = exponent(sizes, ours, half), exponent(sizes, plain, half)
        yield Figure(
            PART,
            f"growth with {name}: exponent",
            "",
            "exponent of condensing",
            mine,
            mine,
            theirs,
            theirs,
            f"{titles[name]}, {name} = {sizes[half]:g} to {sizes[-1]:g}",
        )
        charts.append(chart(name, titles[name], sizes, ours, plain))
    if not quick and (HERE.parent / "pyproject.toml").exists():
        for name, drawn in zip(over, charts, strict=True):
            (HERE / f"growth_{name}.svg").write_text(svg(drawn), encoding="utf-8")


def exponent(
    sizes: Sequence[float], taken: Sequence[Sequence[float]], half: int
) -> float:
    """Slope of the logarithms."""
    medians = [float(np.median(each)) for each in taken]
    return float(np.polyfit(np.log(sizes[half:]), np.log(medians[half:]), 1)[0])


def chart(
    name: str,
    title: str,
    sizes: Sequence[float],
    ours: Sequence[Sequence[float]],
    plain: Sequence[Sequence[float]],
) -> Chart:
    """Chart of medians over the sizes; a straight line is growth in proportion."""
    x = np.array(sizes)
    curves = tuple(
        Curve(label, x, np.array([np.median(each) for each in taken]), style=style)
        for style, (label, taken) in enumerate(
            (("building", ours), ("condensing by plain NumPy", plain))
        )
    )
    heading = f"Time to build: {title}"
    return Chart(name, heading, "ms", curves, samples=x, unit="", across=name)


if __name__ == "__main__":
    show(measure)
