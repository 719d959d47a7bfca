"""Chapter 7: measured disturbances."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator

import numpy as np

from nmss_lab import cases
from nmss_lab.models import Array
from nmss_lab.nmss import differenced_form
from nmss_lab.reproduce.rows import Claim, claim, unchecked
from nmss_lab.reproduce.shared import built, case_of, keeps_limits, simulated
from nmss_lab.simulate import Run, Scenario, closed_loop


def _forms_7() -> Iterator[Claim]:
    case = case_of("measured_disturbance_7_4_1")
    model = case.model
    direct = differenced_form(model, disturbances="direct")
    augmented = differenced_form(model, disturbances="augmented")
    for name, form, size in (("direct", direct, 4), ("augmented", augmented, 6)):
        yield claim(
            "7.4.1",
            f"state, {name}",
            "size of the listed state",
            size,
            form.n_x,
            0,
            "a count",
        )
    added = augmented.n_x - direct.n_x
    n, m, p, q = model.na, model.nb, model.n_y, model.n_u
    yield claim(
        "7.2.1, Table 7.1",
        "rows of G_Delta,1",
        "G_Delta,1 has np + (m-1)q rows; here those that the augmented state adds",
        n * p + (m - 1) * q,
        added,
        because="they are the past disturbances, lr; see E7.3",
    )
    blocks = built(case.designs["disturbance_direct"]).knowledge.layout.shapes["dv"]
    yield claim(
        "7.3",
        "blocks of Delta V",
        "l + 1 blocks of changes enter the prediction when v is held",
        model.ng + 1,
        blocks[0],
        because="the changes vanish from i = l on, so l blocks suffice",
    )


SEEDS = range(20)


def _disturbed(seed: int) -> Scenario:
    """Scenario of 7.4.1 with white noise from a seed, 65 samples."""
    noise = 0.3 * np.random.default_rng(seed).standard_normal((65, 1))
    v = noise + cases.piecewise(65, (50, 0.5))
    return Scenario(cases.piecewise(65, (10, 1.0)), v=v)


@functools.cache
def _mean_error(name: str, literal: bool = False) -> float:
    """Mean over seeds of the sum of absolute errors of Table 7.2, a setting of ours."""
    case = case_of("measured_disturbance_7_4_1")
    design = case.designs[name]
    if name != "integral_of_error":
        design = dataclasses.replace(design, R=0.05, reference="preview")
    if literal:
        design = dataclasses.replace(design, options={"forecast": _counted_twice})
    controller = design.build()
    runs = [closed_loop(case.plant, controller, _disturbed(seed)) for seed in SEEDS]
    return float(np.mean([np.abs(run.y - run.r).sum() for run in runs]))


def _counted_twice(latest: Array, samples: int) -> Array:
    """Forecast that the literal (7.4) amounts to: the last change happens again."""
    return np.repeat(2.0 * latest[:1] - latest[1:2], samples, axis=0)


def _table_7_2() -> Iterator[Claim]:
    for title, name, literal, printed in (
        ("direct", "disturbance_direct", False, 3.0156),
        ("augmented", "disturbance_augmented", True, 2.5159),
        ("Chapter 4", "integral_of_error", False, 9.7692),
        ("Wang and Young", "wang_young", False, 8.6010),
    ):
        yield unchecked(
            "7.4.1, Table 7.2",
            f"sum of errors, {title}",
            "sum of absolute errors",
            "weights, horizons, length and noise are not printed",
            printed,
            _mean_error(name, literal),
            "ours: mean over 20 seeds, 65 samples, Np = 10, Nc = 3, R/Q = 0.05, "
            "previewed reference" + (", literal (7.4)" if literal else ""),
        )


def _disturbance_pays() -> Iterator[Claim]:
    direct, plain = _mean_error("disturbance_direct"), _mean_error("wang_young")
    yield claim(
        "7.4.1, Table 7.2",
        "measuring the disturbance pays",
        "designs that use v err far less (less than half) than those that do not",
        True,
        max(direct, _mean_error("disturbance_augmented"))
        < 0.5 * min(plain, _mean_error("integral_of_error")),
        note=f"direct {direct:.2f}, Wang and Young {plain:.2f}",
    )
    augmented = _mean_error("disturbance_augmented")
    yield claim(
        "7.4.1, Table 7.2",
        "augmented better than direct",
        "the augmented form errs less than the direct one",
        True,
        augmented < direct - 1e-6,
        because="written so that the present change counts once they are the same "
        "controller; see E7.1",
    )
    twice = _mean_error("disturbance_augmented", literal=True)
    yield claim(
        "7.4.1, Table 7.2",
        "augmented better than direct, literal",
        "the same with (7.4) taken literally",
        True,
        twice < direct,
        erratum="E7.1",
        note=f"{twice:.2f} against {direct:.2f}",
    )
    yield from _same_controller()


def _same_controller() -> Iterator[Claim]:
    case = case_of("measured_disturbance_7_4_1")
    steady = Scenario(np.ones((150, 1)), v=cases.piecewise(150, (50, 0.5)))
    names = (
        "disturbance_direct",
        "disturbance_augmented",
        "integral_of_error",
        "wang_young",
    )
    runs = {name: simulated(case.designs[name], case.plant, steady) for name in names}
    yield claim(
        "7.4.1, figs 7.1-7.2",
        "constant disturbance rejected",
        "every controller rejects the change of the mean; largest error after 100 "
        "samples",
        0.0,
        max(abs(run.y[-1, 0] - 1.0) for run in runs.values()),
        0.001,
        "0.1 % of the set-point",
    )
    gap = np.abs(runs[names[0]].y - runs[names[1]].y).max()
    yield claim(
        "7.2",
        "direct and augmented",
        "two forms of one model: their responses agree when written consistently",
        0.0,
        gap,
        1e-9,
        "rounding",
        erratum="E7.1",
    )


@functools.cache
def _temperature(name: str, noise: float = 0.0) -> Run:
    case = case_of("temperature_7_4_2")
    scenario = cases.temperature_scenario(1501)
    drawn = noise * np.random.default_rng(42).standard_normal((1501, 2))
    design = case.designs[name]
    return simulated(design, case.plant, dataclasses.replace(scenario, noise=drawn))


def _temperature_model() -> Iterator[Claim]:
    model = cases.temperature_model()
    drive = np.full(2, 23.0) - model.disturbance_gain()[:, 0] * 22.5
    u = np.linalg.solve(model.steady_state_gain(), drive)
    for unit, low, high in (("1 m3/h", 1000.0, 2500.0), ("100 m3/h", 10.0, 25.0)):
        printed = unit == "1 m3/h"
        yield claim(
            "7.4.2, Table 7.4",
            f"unit of u1: {unit}",
            "the inputs that hold 23 degC in surroundings of 22.5 degC lie within "
            "Table 7.4",
            True,
            bool(low <= u[0] <= high and 15.0 <= u[1] <= 27.0),
            erratum="" if printed else "E7.2",
            because=f"with the printed B_1 the ventilation would be {u[0]:.1f}; see "
            "E7.2",
            note=f"u = {u[0]:.2f}, {u[1]:.2f}",
        )
    yield claim(
        "7.4.2.2",
        "orders",
        "n = 1, m = 3, l = 3",
        (1, 3, 3),
        (model.na, model.nb, model.ng),
    )
    yield unchecked(
        "7.4.2.2",
        "quality of the model",
        "R_T^2 = 0.95 and YIC = -7.6",
        "the measured series are not public",
        (0.95, -7.6),
    )


def _temperature_loop() -> Iterator[Claim]:
    direct = _temperature("disturbance_direct")
    error = np.abs(direct.y - 23.0)[50:]
    for name, statement, printed, ours in (
        ("mean error", "mean absolute error, degC", 0.11, error.mean()),
        ("largest error", "within 1 degC at all times", 1.0, error.max()),
        ("door", "about 0.5 degC after the door opens", 0.5, error[500:540].mean()),
    ):
        yield unchecked(
            "7.4.2.3, fig. 7.8",
            f"temperature, {name}",
            statement,
            "the measured surroundings and the 36 sensor models are not public",
            printed,
            ours,
            "ours: group models and synthetic surroundings, without the first 5 h",
        )
    yield claim(
        "7.4.2.3, fig. 7.7",
        "limits of Table 7.4",
        "inputs and rates stay within Table 7.4 (synthetic surroundings)",
        True,
        keeps_limits(direct),
        erratum="E7.2",
    )


def _temperature_compared() -> Iterator[Claim]:
    direct, plain = _temperature("disturbance_direct"), _temperature("wang_young")
    means = [float(np.abs(run.y - 23.0)[50:].mean()) for run in (direct, plain)]
    yield claim(
        "7.4.2.3",
        "similar overall",
        "Wang and Young's controller gives similar results (mean error within 30 %)",
        True,
        abs(means[1] / means[0] - 1.0) < 0.3,
        erratum="E7.2",
        note=f"{means[0]:.3f} against {means[1]:.3f} degC, synthetic surroundings",
    )
    noisy = [_roughness(_temperature(name, 0.05)) for name in SMOOTH]
    clean = [_roughness(_temperature(name)) for name in SMOOTH]
    yield claim(
        "7.4.2.3, fig. 7.9",
        "smoother inlet temperature",
        "with the disturbance model the changes of u2 are smoother",
        True,
        clean[0] < clean[1],
        erratum="E7.2",
        note=f"RMS change of du2 {clean[0]:.4f} against {clean[1]:.4f}; with 0.05 degC "
        f"of measurement noise {noisy[0]:.4f} against {noisy[1]:.4f}",
    )


SMOOTH = ("disturbance_direct", "wang_young")


def _roughness(run: Run) -> float:
    """RMS change from sample to sample of the change of u2."""
    return float(np.sqrt(np.mean(np.diff(run.du[50:, 1]) ** 2)))


TOPICS = (
    _forms_7,
    _table_7_2,
    _disturbance_pays,
    _temperature_model,
    _temperature_loop,
    _temperature_compared,
)
"""Topics in the order of the text."""
