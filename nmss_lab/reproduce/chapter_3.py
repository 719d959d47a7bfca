"""Chapter 3: the reference governor."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator

import numpy as np

from nmss_lab import cases
from nmss_lab.controller import Limits, Status
from nmss_lab.design import Design
from nmss_lab.measures import steps
from nmss_lab.models import Array, DifferenceModel
from nmss_lab.nmss import integral_of_error_form
from nmss_lab.pip import pole_gain
from nmss_lab.predict import Horizon
from nmss_lab.reproduce.rows import PRINTED, Claim, claim
from nmss_lab.reproduce.shared import built, case_of, keeps_limits, simulated
from nmss_lab.simulate import Run, Scenario


@functools.cache
def _governed(Np: int) -> Run:
    case = case_of("governor_3_4")
    design = dataclasses.replace(case.designs["governor"], horizon=Horizon(Np, Np))
    return simulated(design, case.plant, case.scenario)


SMALL = slice(5, 31)
"""Samples after the small change of the reference in 3.4."""


LARGE = slice(31, None)
"""Samples after the large change."""


def _form_3_1() -> Iterator[Claim]:
    form = integral_of_error_form(case_of("governor_3_4").model)
    yield claim(
        "3.4", "state", "the state is [y_k, y_{k-1}, u_{k-1}, z_k]", 4, form.n_x
    )
    model = cases.shell_model()
    n, m, p, q = model.na, model.nb, model.n_y, model.n_u
    size = integral_of_error_form(model).n_x
    yield claim(
        "3.1",
        "size of the state",
        "the state of (3.2) has (n+1)p + m(q-1) entries; here for (5.7)",
        (n + 1) * p + m * (q - 1),
        size,
        because="past inputs are m - 1 vectors of q entries: (n+1)p + (m-1)q",
    )
    listed = n + (m - 1) + 1
    yield claim(
        "3.1",
        "size of the state, listed",
        "the vector listed in (3.2) has n + (m-1) + 1 blocks; here for (5.7), p = q",
        listed * p,
        size,
        erratum="E3.2",
    )


def _pip_gain() -> Iterator[Claim]:
    printed = np.array([3.16, -3.05, 6.10, -0.64])
    gains = {b1: _gain_for(b1) for b1 in (-1.0, -0.5)}
    yield claim(
        "3.4",
        "PIP gain",
        "poles 0, 0, 0.2, 0.2 need the gain [3.16 -3.05 6.10 -0.64]",
        tuple(printed),
        gains[-1.0],
        0.005,
        PRINTED,
        erratum="E3.1",
    )
    yield claim(
        "3.4",
        "PIP gain, plant as printed",
        "the same for the plant printed in 3.4",
        tuple(printed),
        gains[-0.5],
        0.005,
        PRINTED,
        because="the plant printed in 3.4 is not the one of (6.10); see E3.1",
    )


def _pip_poles() -> Iterator[Claim]:
    printed = np.array([3.16, -3.05, 6.10, -0.64])
    wanted = np.poly([0.0, 0.0, 0.2, 0.2])
    polynomial, slack = _placed(-1.0, printed)
    yield claim(
        "3.4",
        "closed-loop polynomial",
        "the printed gain gives z^2 (z - 0.2)^2",
        tuple(wanted),
        polynomial,
        slack,
        "rounding of the printed gain, carried through to the coefficients",
        erratum="E3.1",
    )
    radius = np.abs(np.roots(_placed(-0.5, printed)[0])).max()
    yield claim(
        "3.4",
        "poles, plant as printed",
        "the printed gain puts the largest pole of the printed plant at 0.2",
        0.2,
        radius,
        0.2,
        "generous: repeated poles move with the square root of rounding",
        because="with the coefficient -0.5 the printed gain is unstable; see E3.1",
    )


def _gain_for(b1: float) -> Array:
    return pole_gain(DifferenceModel([-1.7, 1.0], [b1, 2.0]), [0.0, 0.0, 0.2, 0.2])


def _placed(b1: float, gain: Array) -> tuple[Array, float]:
    """Closed-loop polynomial of a rounded gain, and what rounding may add to it."""
    form = integral_of_error_form(DifferenceModel([-1.7, 1.0], [b1, 2.0]))

    def polynomial(K: Array) -> Array:
        return np.poly(form.A - form.B @ K[None]).real

    at = polynomial(gain)
    slopes = [polynomial(gain + row) - at for row in np.eye(4)]
    return at, float(0.005 * np.abs(slopes).sum(axis=0).max())


def _without_governor() -> Iterator[Claim]:
    case = case_of("governor_3_4")
    pip = case.designs["pip"]
    free = simulated(
        dataclasses.replace(pip, limits=Limits()), case.plant, case.scenario
    )
    over = np.abs(free.u).max() > 2.0 and np.abs(free.du).max() > 0.5
    yield claim(
        "3.4, fig. 3.2",
        "limits broken without them",
        "without limits both the input and its rate exceed 2 and 0.5",
        True,
        over,
        note=f"max u {np.abs(free.u).max():.2f}, max du {np.abs(free.du).max():.2f}",
    )


def _ungoverned_changes() -> Iterator[Claim]:
    case = case_of("governor_3_4")
    pip = case.designs["pip"]
    limited = simulated(pip, case.plant, case.scenario)
    small, large = steps(limited)
    yield claim(
        "3.4, fig. 3.3",
        "small change without governor",
        "the output leaves the set-point again before it settles (over 10 %)",
        True,
        small.overshoot > 0.1,
        note=f"overshoot {100 * small.overshoot:.0f} %",
    )
    yield claim(
        "3.4, fig. 3.3",
        "large change, in the window",
        "without the governor it has not settled when the figure ends",
        True,
        math.isnan(large.settling),
    )
    longer = Scenario(cases.piecewise(400, (5, 5.0), (31, -5.0)))
    settled = steps(simulated(pip, case.plant, longer))[1].settling
    yield claim(
        "3.4",
        "large change, unstable",
        "without the governor the large change is unstable: it never settles",
        True,
        math.isnan(settled),
        because=f"the incremental law does settle, {settled:.0f} samples after the "
        "change and long after the window that the figure shows",
    )


def _literal_increment() -> Iterator[Claim]:
    y = _printed_3_13()
    yield claim(
        "3.4, (3.13b)",
        "saturation as printed",
        "the law with the printed corrections brings the small change to 5 (within 5 % "
        "at its end)",
        True,
        bool(np.abs(y[26:31] - 5.0).max() < 0.25),
        because="the printed lower branch raises the input, and the printed tests are "
        "on -K x; see E3.3",
    )
    case = case_of("governor_3_4")
    run = simulated(case.designs["pip"], case.plant, case.scenario)
    yield claim(
        "3.4, (3.13b)",
        "saturation, corrected",
        "the corrected law keeps input and rate within their limits",
        True,
        keeps_limits(run),
        erratum="E3.3",
    )


def _printed_3_13() -> Array:
    """Output under (3.13) with the branches exactly as printed."""
    case = case_of("governor_3_4")
    K, plant = case.designs["pip"].options["K"][0], case.model.plant()
    state = plant.reset(np.zeros(1), np.zeros(0), np.zeros(1))
    y_before = u = z = 0.0
    x_before, outputs = np.zeros(4), []
    for r in case.scenario.reference[:, 0]:
        y = float(plant.output(state)[0])
        z += r - y
        x = np.array([y, y_before, u, z])
        asked = -float(K @ x)
        change = 0.5 if abs(asked) > 0.5 else -float(K @ (x - x_before))
        u = float(np.clip(u + change, -2.0, 2.0))
        x_before, y_before = x, y
        outputs.append(y)
        state = plant.step(state, np.array([u]), np.zeros(0))
    return np.array(outputs)


def _with_governor() -> Iterator[Claim]:
    run = _governed(10)
    small = steps(run)[0]
    yield claim(
        "3.4, fig. 3.3",
        "limits kept",
        "with the governor (Np = 10) input and rate stay within their limits",
        True,
        keeps_limits(run),
    )
    yield claim(
        "3.4, fig. 3.3",
        "small change with governor",
        "no unwanted oscillation (overshoot below 1 %)",
        True,
        small.overshoot < 0.01 and math.isfinite(small.settling),
        note=f"overshoot {100 * small.overshoot:.2f} %",
    )
    yield claim(
        "3.4, fig. 3.3",
        "large change with governor",
        "a stable response that reaches -5",
        -5.0,
        run.y[-1, 0],
        0.05,
        "1 % of the set-point",
    )


def _short_horizon() -> Iterator[Claim]:
    short = _governed(3)
    yield claim(
        "3.4, fig. 3.4",
        "Np = 3 is stable",
        "even Np = 3 gives a stable output that reaches -5",
        -5.0,
        short.y[-1, 0],
        0.05,
        "1 % of the set-point",
    )
    peaks = [steps(_governed(Np))[1].overshoot for Np in (3, 30)]
    yield claim(
        "3.4, fig. 3.4",
        "longer horizon, less overshoot",
        "in the large change Np = 30 overshoots less than Np = 3",
        True,
        peaks[1] < peaks[0],
        note=f"{100 * peaks[0]:.1f} % against {100 * peaks[1]:.1f} % of the change",
    )
    yield from _horizons()


def _horizons() -> Iterator[Claim]:
    runs = {Np: _governed(Np) for Np in (3, 10, 30)}
    gap = np.abs(runs[3].y[SMALL] - runs[30].y[SMALL]).max()
    yield claim(
        "3.4, fig. 3.4",
        "small change, Np = 3 and 30",
        "no noticeable difference in the small change",
        0.0,
        gap,
        0.1,
        "1 % of the height of the axis, about a line's width",
    )
    gap = np.abs(runs[10].y - runs[30].y).max()
    yield claim(
        "3.4, fig. 3.4",
        "Np = 10 and 30",
        "the responses cannot be told apart",
        0.0,
        gap,
        1e-6,
        "accuracy of the solver",
    )
    turns = {Np: _turns((run.w - run.r)[LARGE, 0]) for Np, run in runs.items()}
    yield claim(
        "3.4, fig. 3.5",
        "oscillation of beta",
        "in the large change beta swings less about zero with the longer horizon",
        True,
        turns[30] < turns[3],
        note=f"changes of sign: {turns[3]} with Np = 3, {turns[30]} with Np = 30",
    )
    yield claim(
        "3.4, fig. 3.5",
        "beta draws the reference back",
        "after each change the slack reference starts near the output (within 20 % of "
        "the change)",
        True,
        all(abs(runs[30].w[k, 0] - runs[30].y[k, 0]) < 2.0 for k in (5, 31)),
    )


def _turns(beta: Array) -> int:
    large = beta[np.abs(beta) > 0.01]
    return int((np.diff(np.sign(large)) != 0).sum())


def _governor_properties() -> Iterator[Claim]:
    case = case_of("governor_3_4")
    design = case.designs["governor"]
    idle = simulated(
        dataclasses.replace(design, limits=Limits()), case.plant, case.scenario
    )
    yield claim(
        "3.2",
        "no limits, no perturbation",
        "without limits the minimising beta is zero",
        0.0,
        np.abs(idle.w - idle.r).max(),
        1e-9,
        "rounding",
    )
    rows = built(dataclasses.replace(design, reference="preview")).program
    yield claim(
        "3.2, (3.12)",
        "rows for u_k",
        "M holds rows through which beta keeps u_k and its change within limits",
        True,
        not any(row.step == 0 and row.name in ("u", "du") for row in rows.left_out),
        because="these rows are zero: beta_1 acts on u_{k+1} first; they are left out "
        "and reported",
    )
    bumped = Scenario(
        cases.piecewise(60, (5, 5.0)), output_disturbance=cases.piecewise(60, (30, 3.0))
    )
    run = simulated(
        dataclasses.replace(design, reference="preview"), case.plant, bumped
    )
    yield claim(
        "3.3",
        "limits always satisfied",
        "the governed law never asks for an input outside the limits, also after an "
        "unmeasured output disturbance of 3",
        True,
        not (run.status >= Status.CLIPPED).any(),
        because="in the printed form u_k follows from feedback alone, and was clipped "
        f"or had no plan at {(run.status >= Status.CLIPPED).sum()} of 60 samples",
    )
    yield from _tracking(case, design)


def _tracking(case: cases.Case, design: Design) -> Iterator[Claim]:
    far = Scenario(cases.piecewise(400, (5, 8.0)))
    run = simulated(
        dataclasses.replace(design, horizon=Horizon(30, 30)), case.plant, far
    )
    swing = float(np.ptp(run.y[-50:]))
    yield claim(
        "3.3",
        "tracking is practically achieved",
        "the reference is reached; here 8 with Np = 30",
        8.0,
        run.y[-1, 0],
        0.08,
        "1 % of the set-point",
        because="inputs up to 2 hold outputs up to 6.67 only; the output keeps "
        f"swinging by {swing:.2f}",
    )
    short = dataclasses.replace(design, options={**design.options, "free_until": 6})
    ended = simulated(short, case.plant, case.scenario)
    fewer = dataclasses.replace(design, options={**design.options, "free_until": 3})
    few = simulated(fewer, case.plant, case.scenario)
    yield claim(
        "3.3",
        "beta zero after a step",
        "forcing beta to zero late in the horizon (6 of 10 steps free) tracks -5",
        -5.0,
        ended.y[-1, 0],
        0.05,
        "1 % of the set-point",
        note=f"with 3 free steps the program has no solution at "
        f"{(few.status >= Status.CLIPPED).sum()} samples",
    )
    fading = dataclasses.replace(design, options={**design.options, "decay": 0.7})
    faded = steps(simulated(fading, case.plant, case.scenario))[1]
    yield claim(
        "3.3",
        "decaying beta",
        "a decaying beta (here 0.7 a step) tracks as well, in a smoother way",
        True,
        math.isfinite(faded.settling)
        and faded.overshoot < steps(_governed(10))[1].overshoot,
        note=f"overshoot of the large change {100 * faded.overshoot:.1f} %",
    )


TOPICS = (
    _form_3_1,
    _pip_gain,
    _pip_poles,
    _without_governor,
    _ungoverned_changes,
    _literal_increment,
    _with_governor,
    _short_horizon,
    _governor_properties,
)
"""Topics in the order of the text."""
