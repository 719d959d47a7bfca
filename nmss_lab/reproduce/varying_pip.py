"""State-dependent PIP control and the governor: sections 8.2 and 8.5.1."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import numpy as np

from nmss_lab.controller import Limits
from nmss_lab.measures import steps
from nmss_lab.models import Array, DifferenceModel
from nmss_lab.nmss import integral_of_error_form
from nmss_lab.pip import pole_gain
from nmss_lab.reproduce.rows import Claim, claim
from nmss_lab.reproduce.shared import case_of, keeps_limits, simulated
from nmss_lab.simulate import Run, Scenario
from nmss_lab.state_dependent import StateDependentModel

BILINEAR, PRODUCT = "bilinear_8_5_1", "product_8_5_2"

EXACT = 1e-9, "rounding"
"""Tolerance and reason."""


def model_of(name: str) -> StateDependentModel:
    """State-dependent model of a case."""
    model = next(iter(case_of(name).designs.values())).model
    assert isinstance(model, StateDependentModel)
    return model


def _frozen_bilinear(past: float) -> DifferenceModel:
    """Model (8.11) frozen where y_{k-1} is ``past``."""
    return model_of(BILINEAR).frozen(np.array([[1.0], [past]]), np.zeros((1, 1)))


def frozen_product(past: float) -> DifferenceModel:
    """Model of 8.5.2 frozen where u_{k-1} is ``past``."""
    return model_of(PRODUCT).frozen(np.ones((1, 1)), np.array([[0.0], [past]]))


def _forms_8() -> Iterator[Claim]:
    for where, freeze, name in (
        ("8.5.1", _frozen_bilinear, "y_{k-1}"),
        ("8.5.2", frozen_product, "u_{k-1}"),
    ):
        form = integral_of_error_form(freeze(3.0))
        parts = (form.A, form.B, form.D, form.C)
        yield claim(
            where,
            "A, b, d, c",
            f"A = [0.7 0; -0.7 1], b = {name} [1; -1], d = [0; 1], c = [1 0]; here "
            f"{name} = 3",
            (0.7, 0.0, -0.7, 1.0, 3.0, -3.0, 0.0, 1.0, 1.0, 0.0),
            np.concatenate([part.ravel() for part in parts]),
            *EXACT,
        )
    form = integral_of_error_form(_frozen_bilinear(3.0))
    for name, used, erratum in (("as printed", 1.0, ""), ("one later", 2.0, "E8.1")):
        yield claim(
            "8.2, (8.2a)",
            f"reference in the state, {name}",
            "x_{k+1} takes d r_k" if not erratum else "x_{k+1} takes d r_{k+1}",
            form.D[:, 0] * used,
            form.D[:, 0] * 2.0,
            *EXACT,
            erratum=erratum,
            because="in (3.1a) and (8.7) the sum of the error at k+1 holds r_{k+1}; "
            "here r goes from 1 to 2; see E8.1",
        )
    yield from _closed_matrix()


def _closed(frozen: DifferenceModel, poles: tuple[float, ...]) -> Array:
    form = integral_of_error_form(frozen)
    closed: Array = form.A - form.B @ pole_gain(frozen, poles)
    return closed


def _closed_matrix() -> Iterator[Claim]:
    places = (0.5, 1.0, -2.0)
    poles = (0.3, 0.6)
    short = [_closed(_frozen_bilinear(past), poles) for past in places]
    yield claim(
        "8.2",
        "constant closed loop",
        "A_k - b_k k_k does not change with k; here (8.11), poles 0.3 and 0.6",
        0.0,
        np.ptp(short, axis=0).max(),
        *EXACT,
    )
    long = StateDependentModel([-0.7], ["y[k-2]", 0.3])
    frozen = [long.frozen(np.array([[1.0], [p]]), np.zeros((2, 1))) for p in places]
    wide = [_closed(each, (0.3, 0.6, 0.0)) for each in frozen]
    yield claim(
        "8.2",
        "constant closed loop, m = 2",
        "the same for a plant with a second input coefficient, 0.3",
        0.0,
        np.ptp(wide, axis=0).max(),
        *EXACT,
        because="the row of the past input is -k_k: poles of each frozen matrix are "
        "constant, the matrix is not, and fixed poles of changing matrices decide "
        "nothing; with m = 1 no such row exists",
    )


def _gain_8_5_1() -> Iterator[Claim]:
    printed, ours = [], []
    for d1, d2, past in ((0.0, 0.0, 1.0), (-0.9, 0.18, 2.0), (0.2, 0.5, -0.4)):
        printed += [(0.7 - d2) / past, -(1.0 + d1 + d2) / past]
        wanted = np.roots([1.0, d1, d2])
        ours += [*pole_gain(_frozen_bilinear(past), tuple(wanted)).ravel()]
    yield claim(
        "8.5.1",
        "gain",
        "k = [0.7 - d2, -(1 + d1 + d2)] / y_{k-1} places the roots of (8.13); three "
        "polynomials and values of y_{k-1}",
        printed,
        ours,
        1e-8,
        "rounding of roots and of the placement",
    )
    nothing = _frozen_bilinear(0.0)
    form = integral_of_error_form(nothing)
    reached = np.hstack([form.B, form.A @ form.B])
    yield claim(
        "8.5.1, 9.2.2",
        "loss of controllability",
        "the model may become ill-conditioned, uncontrollable; here at y_{k-1} = 0",
        True,
        bool(np.linalg.matrix_rank(reached) == 0),
        note="no gain exists there and near it the gain has no bound: ours holds the "
        "input beyond a largest gain and says so",
    )


def _bilinear(name: str, scenario: Scenario | None = None, **changes: Any) -> Run:
    case = case_of(BILINEAR)
    design = dataclasses.replace(case.designs[name], **changes)
    return simulated(design, case.plant, scenario or case.scenario)


@functools.cache
def _pip_runs() -> dict[str, Run]:
    none = Limits()
    return {
        "deadbeat": _bilinear("sdp_pip", limits=none),
        "naive, no limits": _bilinear("sdp_pip_naive", limits=none),
        "naive": _bilinear("sdp_pip_naive"),
        "follows": _bilinear("sdp_pip"),
        "governed": _bilinear("sdp_governor"),
        "governed at once": _bilinear("sdp_governor", reference="held"),
    }


def _overshoot(run: Run) -> float:
    return float(steps(run)[-1].overshoot)


def _deadbeat_8_5_1() -> Iterator[Claim]:
    for name, z0, erratum in (("as printed", 0.0, ""), ("at rest", 1.0, "E8.7")):
        still = Scenario(np.ones(12), y0=1.0, u0=0.3, z0=z0)
        run = _bilinear("sdp_pip", still, limits=Limits())
        yield claim(
            "8.5.1, fig. 8.1",
            f"start, {name}",
            f"(y, u, z) = (1, 0.3, {z0:g}), taken as the rest before the step: largest "
            "move while r stays 1",
            0.0,
            np.abs(run.y - 1.0).max(),
            *EXACT,
            erratum=erratum,
            because="u = -k x with z = 0 is -0.7: y falls to 0 and the gain is "
            "lost; see E8.7",
        )
    y = _pip_runs()["deadbeat"].y[:, 0]
    away = np.flatnonzero(np.abs(y - 2.0) > 1e-9)
    yield claim(
        "8.5.1, fig. 8.1",
        "deadbeat",
        "without limits a step from 1 to 2 is deadbeat: at 2 within two samples and "
        "from then on",
        True,
        bool(away[-1] - 3 < 2),
        erratum="E8.7",
        note=f"y = 2 from {away[-1] - 2} sample after the change is measured on",
    )


def _incremental_8_5_1() -> Iterator[Claim]:
    runs, where = _pip_runs(), "8.5.1, (3.13)"
    yield claim(
        where,
        "incremental form, as printed",
        "the incremental form is the same controller away from limits: no overshoot",
        0.0,
        _overshoot(runs["naive, no limits"]),
        *EXACT,
        because="k_k dx_k sums changes that were weighed with different gains: "
        "another law, deadbeat no longer; see E8.9",
    )
    y = _summed_by_hand()
    yield claim(
        where,
        "incremental form",
        "u_k = (y_{k-2} u_{k-1} - [0.7 -1] dx_k) / y_{k-1} gives the deadbeat response",
        0.0,
        np.abs(y - runs["deadbeat"].y[: len(y), 0]).max(),
        *EXACT,
        erratum="E8.9",
    )


def _summed_by_hand() -> Array:
    """Plant (8.11) under the increment of y_{k-1} u_k, no limits."""
    y, u = [1.0, 1.0], 0.3
    outputs = []
    for r in case_of(BILINEAR).scenario.reference[:12, 0]:
        outputs.append(y[0])
        before = outputs[-2] if len(outputs) > 1 else y[0]
        past = outputs[-3] if len(outputs) > 2 else 1.0
        change = 0.7 * (y[0] - before) - (r - y[0])
        u = (past * u - change) / y[1]
        y = [0.7 * y[0] + y[1] * u, y[0]]
    return np.array(outputs)


def _limited_8_5_1() -> Iterator[Claim]:
    runs, where = _pip_runs(), "8.5.1, fig. 8.2"
    governed, naive = runs["governed"], runs["naive"]
    for name, run in (("with governor", governed), ("without", naive)):
        yield claim(
            where,
            f"limit kept, {name}",
            "|u| stays within 0.5",
            True,
            keeps_limits(run),
        )
    for name, run, because in (
        ("(3.13)", naive, ""),
        ("sum follows u", runs["follows"], _NOT_AT_ALL),
    ):
        yield claim(
            where,
            f"overshoot without governor, {name}",
            "without the governor the output overshoots 2",
            True,
            _overshoot(run) > 0.01,
            because=because,
            note=f"{100 * _overshoot(run):.1f} % of the step",
        )
    yield claim(
        where,
        "no overshoot with governor",
        "the governor removes the overshoot",
        True,
        _overshoot(governed) < 1e-9,
    )
    yield claim(
        where,
        "deadbeat to the governed reference",
        "the loop is deadbeat to the reference that the governor hands it: largest "
        "distance of y_{k+1} from w_k",
        0.0,
        np.abs(governed.y[1:] - governed.w[:-1]).max(),
        *EXACT,
    )


_NOT_AT_ALL = (
    "the law of (8.3) whose sum follows the applied input does not overshoot at all: "
    "what overshoots is (3.13) with a gain that varies, another law, see E8.9"
)


def _speed_8_5_1() -> Iterator[Claim]:
    runs, where = _pip_runs(), "8.5.1, fig. 8.2"
    rises = {name: steps(run)[-1].rise for name, run in runs.items()}
    yield claim(
        where,
        "faster without governor",
        "without the governor the output rises faster",
        True,
        rises["naive"] < rises["governed"] - 1e-9,
        note=f"10 to 90 %: {rises['naive']:.2f} against {rises['governed']:.2f} "
        "samples, with the timing of (3.12)",
    )
    yield claim(
        where,
        "faster without governor, w_k chosen at k",
        "the same for a governor that chooses w_k when r_k is measured",
        True,
        rises["naive"] < rises["governed at once"] - 1e-9,
        because="its response is then sample by sample that of the clipped law whose "
        "sum follows the input: the gain is the right one for u_k, and only later "
        "inputs are judged with a gain that is out of date",
        note=f"largest difference from the clipped law "
        f"{np.abs(runs['governed at once'].y - runs['follows'].y).max():.1e}",
    )
    used = {name: _at_limit(run) for name, run in runs.items()}
    yield claim(
        where,
        "more of the input used without governor",
        "without the governor more of the allowed input is used (samples at 0.5)",
        True,
        used["naive"] > used["governed"],
        note=f"{used['naive']} against {used['governed']} samples",
    )
    gap = _misjudged_inputs(runs["governed"])
    yield claim(
        "8.2, (3.9)",
        "inputs in the governor's rows",
        "a gain that varies is all that changes in (3.9), read as that of sample k: "
        "planned inputs are those that the planned outputs need; largest difference",
        0.0,
        gap,
        *EXACT,
        because="K_1 and K_2 hold the gain of sample k for the whole horizon, while "
        "the loop will use that of each sample: the outputs are predicted exactly, "
        "the inputs not",
    )
    yield from _closer(runs)


def _at_limit(run: Run) -> int:
    return int((np.abs(run.u) > 0.5 - 1e-9).sum())


def _misjudged_inputs(run: Run) -> float:
    """Difference of planned inputs from those that the plan's outputs need."""
    y = np.concatenate([run.y[:, None, 0], run.trail("y")[:, :, 0]], axis=1)[1:]
    y = np.concatenate([run.y[:-1], y], axis=1)
    need = (y[:, 2:] - 0.7 * y[:, 1:-1]) / y[:, :-2]
    return float(np.abs(need - run.trail("u")[1:, :, 0]).max())


def _closer(runs: dict[str, Run]) -> Iterator[Claim]:
    wanted = runs["deadbeat"].y
    far = {name: float(np.abs(run.y - wanted).sum()) for name, run in runs.items()}
    for name, other, because in (
        ("(3.13)", "naive", ""),
        ("sum follows u", "follows", _SAME),
    ):
        yield claim(
            "8.5.1, 8.6",
            f"closer to the design, {name}",
            "with the governor (w_k chosen at k) the limited loop is closer to the "
            "response without limits than without it",
            True,
            far["governed at once"] < far[other] - 1e-9,
            because=because,
            note=f"sums of distances {far['governed at once']:.3f} and "
            f"{far[other]:.3f}",
        )


_SAME = "the two give one response: clipping this law is all that the limit needs"


TOPICS_8_2 = (
    _forms_8,
    _gain_8_5_1,
    _deadbeat_8_5_1,
    _incremental_8_5_1,
    _limited_8_5_1,
    _speed_8_5_1,
)
"""Topics of 8.2 and 8.5.1."""
