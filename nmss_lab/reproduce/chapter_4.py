"""Chapter 4: the sum of the error in the state."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from nmss_lab import cases
from nmss_lab.analysis import control_polynomials, linear_loop
from nmss_lab.continuous import ContinuousPlant, TransferFunction
from nmss_lab.measures import steps
from nmss_lab.models import Array
from nmss_lab.nmss import integral_of_error_form
from nmss_lab.predictive import PredictiveController
from nmss_lab.reproduce.rows import Claim, claim, unchecked
from nmss_lab.reproduce.shared import (
    POINTS,
    Robust,
    built,
    case_of,
    keeps_limits,
    loop_of,
    nominal,
    robust,
    robustness,
    short_sighted,
    simulated,
    value_at,
)
from nmss_lab.simulate import Scenario


def _double_integrator() -> Iterator[Claim]:
    case = case_of("double_integrator_4_4_1")
    exact = ContinuousPlant([[TransferFunction([1.0], [1.0, 0.0, 0.0])]])
    model = exact.difference_model(1.0)
    yield claim(
        "4.4.1",
        "sampled double integrator",
        "1/s^2 sampled at 1 s is (0.5 z^-1 + 0.5 z^-2)/(1 - 2 z^-1 + z^-2)",
        (-2.0, 1.0, 0.5, 0.5),
        (*model.a.ravel(), *model.b.ravel()),
        1e-12,
        "exact numbers, rounding",
    )
    form = integral_of_error_form(case.model)
    A = np.array([[2, -1, 0.5, 0], [1, 0, 0, 0], [0, 0, 0, 0], [-2, 1, -0.5, 1]])
    B, D, C = np.array([[0.5, 0, 1, -0.5], [0, 0, 0, 1], [1, 0, 0, 0]])
    printed = np.column_stack([A, B, D, C])
    ours = np.column_stack([form.A, form.B, form.D, form.C.T])
    yield claim(
        "4.4.1",
        "matrices A, B, D, C",
        "the printed matrices of the state space form",
        tuple(printed.ravel()),
        ours,
        1e-12,
        "exact numbers, rounding",
    )


def _figure_4_2() -> Iterator[Claim]:
    case = case_of("double_integrator_4_4_1")
    run = simulated(case.designs["integral_of_error"], case.plant, case.scenario)
    yield claim(
        "4.4.1, fig. 4.2",
        "output disturbance rejected",
        "a step of 15 at the output is rejected before the next one comes",
        0.0,
        run.y[20, 0],
        0.15,
        "1 % of the disturbance",
    )
    yield claim(
        "4.4.1, fig. 4.2",
        "input disturbance rejected",
        "a step of -5 at the input is rejected at the end of the figure",
        0.0,
        run.y[-1, 0],
        0.1,
        "1 % of the largest excursion",
    )
    yield claim(
        "4.4.1, fig. 4.2",
        "limits kept",
        "input and rate stay within 10 and 7",
        True,
        keeps_limits(run),
        note=f"max u {np.abs(run.u).max():.2f}: only the rate limit is ever active",
    )
    yield unchecked(
        "4.4.1",
        "Q as weight over horizon",
        "Q = 5/15 is the ratio of a weight and the prediction horizon",
        "the denominator is 15 while Np = 5, and nothing printed tells which of the "
        "two is meant",
        "15",
        "5",
    )


def _steady_state_4() -> Iterator[Claim]:
    for name, title in (
        ("double_integrator_4_4_1", "double integrator"),
        ("ifac93_4_4_2", "IFAC'93"),
        ("shell_5_3_2", "Shell"),
    ):
        loop = loop_of(case_of(name).designs["integral_of_error"])
        for which, statement in (
            ("T", "T(1) = I: no offset"),
            ("S_i", "S_i(1) = 0: constant input disturbances are rejected"),
            ("S_o", "S_o(1) = 0: constant output disturbances are rejected"),
        ):
            target = np.eye(len(loop.C)) if which == "T" else 0.0
            gap = np.abs(loop.transfer(which, 1.0) - target).max()  # type: ignore[arg-type]
            yield claim(
                "4.3.1", f"{which}(1), {title}", statement, 0.0, gap, 1e-8, "rounding"
            )


def _limited_offset() -> Iterator[Claim]:
    case = case_of("double_integrator_4_4_1")
    long = Scenario(
        np.zeros(200),
        output_disturbance=cases.piecewise(200, (5, 15.0)),
        input_disturbance=cases.piecewise(200, (20, -5.0)),
    )
    run = simulated(case.designs["integral_of_error"], case.plant, long)
    yield claim(
        "4.3.1",
        "Remark 4.3.1",
        "with limits there is no offset either where the target can be reached",
        0.0,
        run.y[-1, 0],
        1e-6,
        "200 samples, accuracy of the solver",
    )
    yield claim(
        "4.3.2",
        "stability for any weights",
        "the scheme is asymptotically stable (here plant (6.10), Np = Nc = 3, unit "
        "weights)",
        True,
        short_sighted("integral_of_error").is_stable,
        because="the proof needs the terminal equality of Appendix C, which the "
        "program (4.16) does not have; the largest pole has modulus "
        f"{short_sighted('integral_of_error').radius:.2f}",
    )


def _polynomial_form() -> Iterator[Claim]:
    case = case_of("shell_5_3_2")
    design = dataclasses.replace(case.designs["integral_of_error"], reference="preview")
    controller = built(design)
    loop = linear_loop(controller)
    for which, where in (
        ("T", "4.3.1, (4.18)"),
        ("S_i", "4.3.1, (4.20)"),
        ("S_o", "4.3.1, (4.21)"),
    ):
        gaps = [
            np.abs(
                loop.transfer(which, z)  # type: ignore[arg-type]
                - _transfer_4(controller, z)[which]
            ).max()
            for z in POINTS
        ]
        yield claim(
            where,
            f"{which}(z) of chapter 4",
            f"{which}(z) in polynomial form; here for the Shell model at five points",
            0.0,
            max(gaps),
            1e-8,
            "rounding",
            erratum="E4.2",
        )


def _polynomial_form_literal() -> Iterator[Claim]:
    controller = built(case_of("shell_5_3_2").designs["integral_of_error"])
    loop = linear_loop(controller)
    gap = max(
        np.abs(loop.transfer("S_o", z) - _transfer_4(controller, z, -1.0)["S_o"]).max()
        for z in POINTS
    )
    yield claim(
        "4.3.1, (4.21)",
        "S_o(z), sign as printed",
        "S_o(z) with K_{m+n} replaced by -K_I as printed, at the same points",
        0.0,
        gap,
        1e-8,
        "rounding",
        because="the integral gain then has the wrong sign; see E4.2",
    )


def _transfer_4(
    controller: PredictiveController, z: complex, sign: float = 1.0
) -> dict[str, Array]:
    """(4.18), (4.20), (4.21) with K_I = sign K_{m+n}."""
    parts = control_polynomials(controller)
    P, L = value_at(parts.P, z), value_at(parts.L, z)
    K_I = -sign * parts.K_I
    G, rate, one = controller.model.response(z), 1.0 - 1.0 / z, np.eye(len(K_I))
    ahead = controller.gain("r").reshape(len(K_I), -1, controller.model.n_y)
    R = np.einsum("i,qip->qp", z ** np.arange(1.0, ahead.shape[1] + 1), ahead)
    through = G @ np.linalg.inv(L)
    inner = through @ (K_I - rate * P)
    return {
        "T": np.linalg.solve(inner - rate * one, through @ (K_I + rate * R)),
        "S_i": np.linalg.solve(rate * one - inner, rate * G),
        "S_o": np.linalg.solve(rate * one - inner, rate * one),
    }


def _ifac93_4() -> Iterator[Claim]:
    case = case_of("ifac93_4_4_2")
    yield claim(
        "4.4.2, (4.22)",
        "order of the plant",
        "the benchmark is of 7th order",
        7,
        len(case.continuous.poles()) if case.continuous else 0,
    )
    run = nominal("ifac93_4_4_2", "integral_of_error")
    first = steps(run)[0]
    yield claim(
        "4.4.2, fig. 4.3",
        "nominal response",
        "acceptable: within +-1.2, both steps settled in their half period",
        True,
        bool(np.abs(run.y_fine).max() < 1.2) and math.isfinite(first.settling),
        erratum="E4.1",
        note=f"overshoot {100 * first.overshoot:.1f} %, settling "
        f"{first.settling:.2f} s",
    )
    yield claim(
        "4.4.2, fig. 4.3",
        "input within +-5",
        "the input stays within its limits",
        True,
        keeps_limits(run),
    )


def _ifac93_4_literal() -> Iterator[Claim]:
    case = case_of("ifac93_4_4_2")
    literal = dataclasses.replace(case.designs["integral_of_error"], reference="held")
    held = steps(simulated(literal, case.plant, case.scenario))[0]
    yield claim(
        "4.4.2, fig. 4.3",
        "nominal response, S as in (4.16)",
        "the same with S holding r_k (overshoot below 20 %)",
        True,
        held.overshoot < 0.2,
        because=f"with S in the cost the overshoot is {100 * held.overshoot:.0f} %; "
        "see E4.1",
    )


def _robust_4() -> Iterator[Claim]:
    ours = robust("ifac93_4_4_2", "integral_of_error")
    pip = robust("ifac93_4_4_2", "pip")
    yield claim(
        "4.4.2, fig. 4.4", "realisations", "32 realisations", 32, len(ours.peaks)
    )
    yield claim(
        "4.4.2, fig. 4.4",
        "corners of level 2",
        "some realisations of stress level 2 leave +-1.5, most do not",
        True,
        0 < ours.beyond(1.5) < 16,
        erratum="E4.1",
        note=f"{ours.beyond(1.2)} of 32 beyond 1.2, {ours.beyond(1.5)} beyond 1.5, "
        f"largest {ours.peaks.max():.2f}",
    )
    yield claim(
        "4.4.2",
        "robustness of PIP retained",
        "as robust as a PIP design: as many corners beyond 1.5 (here LQ, same weights)",
        pip.beyond(1.5),
        ours.beyond(1.5),
        1,
        "one corner of 32",
        erratum="E4.1",
    )
    held = dataclasses.replace(
        case_of("ifac93_4_4_2").designs["integral_of_error"], reference="held"
    )
    literal = robustness(held)
    yield claim(
        "4.4.2, fig. 4.4",
        "corners of level 2, S as in (4.16)",
        "most realisations stay within +-1.5 with S holding r_k",
        True,
        literal.beyond(1.5) < 16,
        because=f"{literal.beyond(1.5)} of 32 leave it; see E4.1",
    )
    yield from _against_wang(ours)


def _against_wang(ours: Robust) -> Iterator[Claim]:
    equal = robust("ifac93_4_4_2", "wang_young")
    faster = robust("ifac93_6_3_3", "wang_young")
    settle = [
        steps(nominal("ifac93_4_4_2", name))[0].settling
        for name in ("integral_of_error", "wang_young")
    ]
    yield claim(
        "4.4.2, fig. 4.5",
        "similar settling",
        "Wang and Young's design settles in a similar time (Q = 0.085, R = 0.1, our "
        "choice)",
        settle[0],
        settle[1],
        0.25,
        "half a sample",
        erratum="E4.1",
    )
    yield claim(
        "4.4.2, fig. 4.5",
        "more corners behave, faster rival",
        "more corners stay within the bands than with Wang and Young's design (with "
        "the weights of 6.3.3)",
        True,
        ours.beyond(1.2) < faster.beyond(1.2) and ours.beyond(1.5) < faster.beyond(1.5),
        erratum="E4.1",
        note=f"beyond 1.2 and 1.5: {ours.beyond(1.2)}/{ours.beyond(1.5)} against "
        f"{faster.beyond(1.2)}/{faster.beyond(1.5)}",
    )
    yield claim(
        "4.4.2, fig. 4.5",
        "more corners behave, equal settling",
        "the same when both settle in the same time: fewer leave each band",
        True,
        ours.beyond(1.2) < equal.beyond(1.2) and ours.beyond(1.5) < equal.beyond(1.5),
        because=f"then they are alike: {ours.beyond(1.2)}/{ours.beyond(1.5)} against "
        f"{equal.beyond(1.2)}/{equal.beyond(1.5)} beyond 1.2 and 1.5",
    )


TOPICS = (
    _double_integrator,
    _figure_4_2,
    _steady_state_4,
    _limited_offset,
    _polynomial_form,
    _polynomial_form_literal,
    _ifac93_4,
    _ifac93_4_literal,
    _robust_4,
)
"""Topics in the order of the text."""
