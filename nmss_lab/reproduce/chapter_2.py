"""Chapter 2 and what was identified elsewhere: the models (4.23), (5.7) and P*."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter
from scipy.stats import chi2

from nmss_lab import cases
from nmss_lab.continuous import ContinuousPlant, TransferFunction
from nmss_lab.identify import (
    Estimate,
    Noise,
    Orders,
    expected_errors,
    order_search,
    prbs,
    riv,
    sriv,
)
from nmss_lab.models import Array, LinearPlant
from nmss_lab.records import Record
from nmss_lab.reproduce.rows import Claim, claim, unchecked
from nmss_lab.reproduce.shared import case_of

MODEL_423 = (-0.9055, 0.0946)
"""Printed a1 and b2 of (4.23)."""

NOT_DESCRIBED = "2e-4: the experiment is not described; its length moves the result"


def responses(plant: LinearPlant, u: Array) -> Array:
    """Response from rest at the samples and half a sample later, (N, 2)."""
    between = plant.between
    if between is None:
        raise ValueError("plant has no outputs between the samples")
    x, found = np.zeros(plant.A.shape[0]), []
    for value in u[:, None]:
        late = between.C[0] @ x + between.B[0] @ value
        found.append([(plant.C @ x)[0], late[0]])
        x = plant.A @ x + plant.B @ value
    return np.array(found)


@functools.cache
def step_tests() -> tuple[Record, Record]:
    """Step of the IFAC'93 plant every 0.5 s, read at once and half a sample late."""
    u = np.concatenate([np.zeros(10), np.ones(200)])
    y = responses(cases.ifac93_plant().sampled(0.5, substeps=2), u)
    time = 0.5 * np.arange(float(len(u)))
    at_once, late = (Record(time=time, y=column, u=u) for column in y.T)
    return at_once, late


def _model_423() -> Iterator[Claim]:
    at_once, late = step_tests()
    orders = Orders(1, (1,), (2,))
    held, shifted = sriv(at_once, orders), sriv(late, orders)
    yield claim(
        "2.1, (4.23)",
        "estimate, output read at the sample",
        "a1 and b2 from open-loop data of (4.22) every 0.5 s, input held",
        MODEL_423,
        held.parameters,
        2e-4,
        NOT_DESCRIBED,
        because="a held input read at the sample gives other numbers; see E2.1",
        note=f"R_T^2 = {held.r2_t:.5f}",
    )
    yield claim(
        "2.1, (4.23)",
        "estimate, output read half a sample late",
        "a1 and b2 from open-loop data of (4.22) every 0.5 s",
        MODEL_423,
        shifted.parameters,
        2e-4,
        NOT_DESCRIBED,
        erratum="E2.1",
        note=f"R_T^2 = {shifted.r2_t:.5f}. {_shifts(held, shifted)}",
    )


def _shifts(held: Estimate, shifted: Estimate) -> str:
    """Say what half a sample does to the model."""
    slow, fast = (e.derived()["time constant 1"][0] for e in (held, shifted))
    before, after = (e.derived()["gain of u1"][0] for e in (held, shifted))
    return (
        f"Half a sample moves the time constant from {slow:.2f} s to {fast:.2f} s and "
        f"the gain from {before:.4f} to {after:.4f}"
    )


def _orders_423() -> Iterator[Claim]:
    for name, record, erratum in zip(
        ("at the sample", "half a sample late"),
        step_tests(),
        ("", "E2.1"),
        strict=True,
    ):
        best = order_search(record, [1, 2], [1, 2], [1, 2, 3, 4])[0]
        yield claim(
            "2.1, (4.23)",
            f"orders by YIC, output read {name}",
            "the orders with the best YIC; all with up to 2 coefficients each and up "
            "to 4 samples of delay",
            "[1 1 2]",
            str(best.orders),
            0,
            "a name",
            erratum=erratum,
            because="the zero to the right and the lags make three samples of delay "
            "the better model unless the output is read late; see E2.1",
            note=f"YIC = {best.row['yic']:.2f}",
        )


SHELL_PLANT = (
    ((4.05, 50.0, 27.0), (1.77, 60.0, 28.0), (5.88, 50.0, 27.0)),
    ((5.39, 50.0, 18.0), (5.72, 60.0, 14.0), (6.90, 40.0, 15.0)),
)
"""Gain, time constant and dead time of outputs 1 and 2, Table 5.1 with its errata."""

EARLIER = 8.54
"""Seconds by which shorter dead times explain rows 1 and 2 of (5.7)."""

SHELL_TOLERANCE = "2 % of the largest: the experiment is not described"


@functools.cache
def shell_estimate(output: int, earlier: float) -> Estimate:
    """Fit a row of (5.7), with its orders, to the plant under three PRBS, no noise."""
    channels = [
        TransferFunction([gain], [lag, 1.0], delay - earlier)
        for gain, lag, delay in SHELL_PLANT[output]
    ]
    plant = ContinuousPlant([channels]).sampled(10.0)
    u = np.column_stack([np.roll(prbs(1023), shift)[:1000] for shift in (0, 341, 682)])
    x, y = np.zeros(plant.A.shape[0]), []
    for move in u:
        y.append((plant.C @ x)[0])
        x = plant.A @ x + plant.B @ move
    record = Record(time=10.0 * np.arange(1000.0), y=np.array(y), u=u)
    return sriv(record, _shell_row(output)[0])


def _shell_row(output: int) -> tuple[Orders, Array]:
    """Orders and parameters of a row of (5.7)."""
    model = cases.shell_model()
    a, b = model.a[:, output, output], model.b[:, output, :].T
    na = int(np.flatnonzero(a)[-1]) + 1
    used = [np.flatnonzero(column) for column in b]
    nk = tuple(int(rows[0]) + 1 for rows in used)
    nb = tuple(int(rows[-1] - rows[0]) + 1 for rows in used)
    chosen = [column[r[0] : r[-1] + 1] for column, r in zip(b, used, strict=True)]
    return Orders(na, nb, nk), np.concatenate([a[:na], *chosen])


def _shell() -> Iterator[Claim]:
    model = cases.shell_model()
    yield claim(
        "2.1, 5.3.2",
        "single-output models of the Shell plant",
        "number of single-output models that make up (5.7)",
        4,
        model.n_y,
        because="it has three outputs",
    )
    for output in (0, 1):
        gains = model.steady_state_gain()[output]
        derived = shell_estimate(output, EARLIER).derived()
        yield claim(
            "2.1, (5.7)",
            f"gains of row {output + 1}",
            "steady-state gains of (5.7); ours by SRIV from Table 5.1's plant",
            gains,
            [derived[f"gain of u{i + 1}"][0] for i in range(3)],
            0.02 * float(gains.max()),
            SHELL_TOLERANCE,
            erratum="E2.2",
        )


def _shell_dynamics() -> Iterator[Claim]:
    for output in (0, 1):
        orders, known = _shell_row(output)
        for earlier, how, erratum in (
            (0.0, "dead times of Table 5.1", ""),
            (EARLIER, f"dead times {EARLIER} s shorter", "E2.2"),
        ):
            estimate = shell_estimate(output, earlier)
            yield claim(
                "2.1, (5.7)",
                f"coefficients of row {output + 1}, {how}",
                f"coefficients of (5.7) in the order of {orders}; ours by SRIV",
                known,
                estimate.parameters,
                0.02 * float(np.abs(known).max()),
                SHELL_TOLERANCE,
                erratum=erratum,
                because="the sampled plant has other dead times than (5.7); see E2.2",
                note=f"R_T^2 = {estimate.r2_t:.6f}",
            )


def _covariance() -> Iterator[Claim]:
    case = case_of("marginally_stable_6_3_2")
    if case.covariance is None:
        raise ValueError("the case of 6.3.2 has no covariance")
    printed = np.sqrt(np.diag(case.covariance))
    true = np.array([*case.model.a.ravel(), *case.model.b.ravel()])
    u = prbs(150)
    unit = expected_errors(Orders(2, (2,), (1,)), true, u, 1.0)
    noise = float(np.exp(np.mean(np.log(printed / unit))))
    spread = float(np.std(lfilter([0.0, *true[2:]], [1.0, *true[:2]], u)))
    yield unchecked(
        "2.1, 6.3.2",
        "P* from an experiment",
        "standard errors of a1, a2, b1, b2 in P*, from an experiment of little noise",
        "neither its length nor its noise is given",
        printed,
        noise * unit,
        note=f"ours: SRIV after 150 samples of a PRBS of size 1 and noise of standard "
        f"deviation {noise:.2g}, {100 * noise / spread:.0f} % of the output's. Only "
        "with a before b do the sizes agree within a factor of two",
    )


TRUE = np.array([-1.5, 0.7, 1.0, 0.5])
"""Plant of the repetitions: a1, a2, b1, b2."""

ORDERS = Orders(2, (2,), (1,))
SAMPLES = 500
RUNS = 200


@dataclass(frozen=True)
class Repetitions:
    """Estimates (runs, 4) from the same experiment with other noise."""

    parameters: Array
    inside: float

    @property
    def spread(self) -> Array:
        """Standard deviation of each parameter."""
        return self.parameters.std(axis=0, ddof=1)


def record_with(noise: Array) -> Record:
    """Output of the plant under a PRBS, plus noise."""
    u = prbs(SAMPLES)
    x = lfilter([0.0, *TRUE[2:]], [1.0, *TRUE[:2]], u)
    return Record(time=np.arange(float(SAMPLES)), y=x + noise, u=u)


def noise_of(seed: int, pole: float) -> Array:
    """Gaussian noise of a pole, white if that is 0."""
    white = np.random.default_rng([2, seed]).standard_normal(SAMPLES + 200)
    return np.asarray(lfilter([1.0], [1.0, -pole], white))[200:]


def _repeated(fit: Callable[[Record], Estimate], pole: float) -> Repetitions:
    """Repeat the experiment; count the 95 % ellipsoids of P* that hold the truth."""
    scale = np.sqrt(1.0 - pole**2)
    found = [fit(record_with(scale * noise_of(seed, pole))) for seed in range(RUNS)]
    misses = [each.parameters - TRUE for each in found]
    sizes = [
        miss @ np.linalg.solve(each.covariance, miss)
        for miss, each in zip(misses, found, strict=True)
    ]
    inside = np.array(sizes) < chi2.ppf(0.95, len(TRUE))
    return Repetitions(np.array(misses) + TRUE, float(inside.mean()))


SLOW = 0.9
"""Pole of the coloured noise."""


@functools.cache
def repetitions(method: str, pole: float) -> Repetitions:
    """Repetitions with SRIV, or with RIV and an AR(1) noise model."""
    if method == "sriv":
        return _repeated(lambda record: sriv(record, ORDERS), pole)
    return _repeated(lambda record: riv(record, ORDERS, Noise(1)), pole)


def _optimal() -> Iterator[Claim]:
    bound = expected_errors(ORDERS, TRUE, prbs(SAMPLES), 1.0)
    yield claim(
        "2.1, 6.3.1",
        "SRIV is optimal, white noise",
        "spread of the estimates over the least possible one",
        np.ones(4),
        repetitions("sriv", 0.0).spread / bound,
        0.15,
        f"three sampling errors of {RUNS} repetitions",
    )
    ratio = repetitions("sriv", SLOW).spread / repetitions("riv", SLOW).spread
    yield claim(
        "2.1, 6.3.1",
        "SRIV is optimal, coloured noise",
        "Gaussian noise suffices for SRIV to be as sharp as can be",
        True,
        bool((ratio < 1.05).all()),
        because="that needs white noise as well: with noise of a pole of "
        f"{SLOW} SRIV's estimates scatter {ratio.max():.1f} times as far as RIV's",
    )


def _distribution() -> Iterator[Claim]:
    for method, pole, name in (
        ("sriv", 0.0, "SRIV, white noise"),
        ("riv", SLOW, "RIV, coloured noise"),
        ("sriv", SLOW, "SRIV, coloured noise"),
    ):
        yield claim(
            "2.1, 6.3.1",
            f"N(p, P*), {name}",
            "share of repetitions whose 95 % ellipsoid of P* holds the true parameters",
            0.95,
            repetitions(method, pole).inside,
            0.046,
            f"three sampling errors of {RUNS} repetitions",
            because="P* of SRIV takes the residuals for white; the covariance "
            "`Estimate.sandwich` does not",
        )


SEARCHES = 25


@functools.cache
def selections() -> tuple[list[Orders], list[Orders]]:
    """Orders preferred by YIC and by BIC on records with white noise."""
    by_yic, by_bic = [], []
    for seed in range(SEARCHES):
        found = order_search(
            record_with(noise_of(seed, 0.0)), [1, 2, 3], [1, 2], [1, 2]
        )
        by_yic.append(found[0].orders)
        by_bic.append(min(found, key=lambda c: float(c.row["bic"])).orders)
    return by_yic, by_bic


def _selection() -> Iterator[Claim]:
    by_yic, by_bic = selections()
    yield claim(
        "2.1",
        "YIC avoids too many parameters",
        "a model of large negative YIC is not over-parametrised",
        True,
        max(orders.count for orders in by_yic) <= ORDERS.count,
        note=f"{SEARCHES} records of a plant {ORDERS}",
    )
    yield claim(
        "2.1",
        "YIC finds the orders",
        "YIC helps to find the orders; records of which it finds the true ones",
        SEARCHES,
        by_yic.count(ORDERS),
        because="YIC asks how certain the parameters are and takes "
        f"{max(by_yic, key=by_yic.count)} for {ORDERS}; BIC finds the orders "
        f"{by_bic.count(ORDERS)} times of {SEARCHES}",
    )


TOPICS: tuple[Callable[[], Iterator[Claim]], ...] = (
    _model_423,
    _orders_423,
    _shell,
    _shell_dynamics,
    _covariance,
    _optimal,
    _distribution,
    _selection,
)
"""Rows of the chapter, by topic."""
