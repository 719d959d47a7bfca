"""Continuous plants: exact sampling, difference equations, systems of other packages.

The brute-force reference puts the dead times on a fine grid and lets SciPy simulate
every channel on it; nothing of the library takes part.
"""

import json
from functools import reduce
from itertools import pairwise
from pathlib import Path

import control
import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from conftest import ALGEBRA
from hypothesis import given, settings
from hypothesis import strategies as st

from nmss_lab.continuous import ContinuousPlant, TransferFunction, difference_model
from nmss_lab.models import DifferenceModel, LinearPlant

RECURSION = 1e-10
"""Relative to the largest output: a difference equation against the sampled states.

Coefficients are rounded to 1e-16 of the largest; poles near 1 amplify that by 1/A(1),
here up to 1e5.
"""

FINE = 20
"""Grid points in a sampling interval of the brute-force reference."""

GOLDEN = Path(__file__).parent / "golden"


def poly(*roots: complex) -> np.ndarray:
    """Return the real polynomial with these roots, leading coefficient 1."""
    return np.real(np.poly(roots))


def ifac93() -> ContinuousPlant:
    """Return the 7th-order plant (4.22) with its nominal parameters."""
    num = np.array([-0.4, 1.0]) * 25.0 * 225.0
    factors = [[1, 3.0, 25.0], [5.0, 1], [1, 18.0, 225.0], [1 / 8, 1], [1 / 12, 1]]
    return ContinuousPlant([[TransferFunction(num, reduce(np.polymul, factors))]])


def first_order_table(table: list, **names) -> list:
    """Return rows of channels from (gain, time constant, dead time)."""
    return [[TransferFunction([K], [T, 1.0], td) for K, T, td in row] for row in table]


def wood_berry() -> ContinuousPlant:
    """Return the distillation column of Wood and Berry, minutes; feed as v."""
    return ContinuousPlant(
        first_order_table(
            [[(12.8, 16.7, 1), (-18.9, 21, 3)], [(6.6, 10.9, 7), (-19.4, 14.4, 3)]]
        ),
        first_order_table([[(3.8, 14.9, 8.1)], [(4.9, 13.2, 3.4)]]),
        y_names=("distillate", "bottoms"),
        u_names=("reflux", "steam"),
        v_names=("feed",),
        units={"distillate": "%", "feed": "lb/min"},
    )


def shell() -> ContinuousPlant:
    """Return the Shell fractionator of Table 5.1 (time constant 50 in row 1)."""
    return ContinuousPlant(
        first_order_table(
            [
                [(4.05, 50, 27), (1.77, 60, 28), (5.88, 50, 27)],
                [(5.39, 50, 18), (5.72, 60, 14), (6.90, 40, 15)],
                [(3.66, 9, 2), (1.65, 30, 20), (5.53, 40, 2)],
            ]
        )
    )


def run(plant: LinearPlant, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return outputs at the samples and between them for w = [u, v], from rest."""
    state = np.zeros(plant.n_x)
    y, between = [], []
    for k in range(len(w)):
        u, v = w[k, : plant.n_u], w[k, plant.n_u :]
        y.append(plant.output(state))
        if plant.between is not None:
            inner = plant.between
            between += list(inner.C @ state + inner.B @ u + inner.G @ v)
        state = plant.step(state, u, v)
    return np.array(y), np.array(between)


def brute_force(plant: ContinuousPlant, w: np.ndarray, dt: float) -> np.ndarray:
    """Return outputs on the fine grid, (FINE len(w) + 1, n_y)."""
    grid = np.repeat(w, FINE, axis=0)
    grid = np.vstack([grid, grid[-1]])
    time = np.arange(len(grid)) * dt / FINE
    y = np.zeros((len(grid), plant.n_y))
    for i in range(plant.n_y):
        row = [*plant.channels[i], *plant.disturbance_channels[i]]
        for j, channel in enumerate(row):
            if channel is None:
                continue
            late = round(channel.delay / dt * FINE)
            delayed = np.concatenate([np.zeros(late), grid[:, j]])[: len(grid)]
            pair = (np.array(channel.num), np.array(channel.den))
            y[:, i] += scipy.signal.lsim(pair, delayed, time, interp=False)[1]
    return y


def simulate(model: DifferenceModel, w: np.ndarray) -> np.ndarray:
    """Return outputs of a difference equation for w = [u, v]."""
    return model.simulate(w[:, : model.n_u], w[:, model.n_u :])


def assert_close(actual: np.ndarray, expected: np.ndarray, tolerance: float) -> None:
    """Compare relative to the largest entry expected."""
    scale = max(np.abs(expected).max(initial=0.0), 1e-300)
    assert np.abs(actual - expected).max(initial=0.0) <= tolerance * scale


def orders(model: DifferenceModel) -> list[int]:
    """Return the order of each output's own equation."""
    own = model.a.diagonal(axis1=1, axis2=2).T
    return [int(np.max(np.flatnonzero(a), initial=-1)) + 1 for a in own]


# Plants of the thesis and of the literature


def test_ifac93_plant_is_accurate_to_rounding():
    """Sampled plant and difference equation give the independent step response."""
    expected = json.loads((GOLDEN / "ifac93_step.json").read_text())["y"]
    ones = np.ones((len(expected), 1))
    plant, model = ifac93().sampled(0.5), ifac93().difference_model(0.5)
    for y in (run(plant, ones)[0], model.simulate(ones)):
        assert np.abs(y[:, 0] - expected).max() < 1e-12
    assert (model.na, model.nb) == (7, 7)
    poles = np.sort_complex(np.exp(0.5 * ifac93().poles()))
    assert_close(np.sort_complex(model.poles()), poles, 1e-11)  # roots of order 7
    assert model.steady_state_gain() == pytest.approx(1.0, abs=ALGEBRA)


@pytest.mark.parametrize("dt", [2.0, 1.0, 0.2, 0.1])
def test_ifac93_equation_follows_the_states_at_other_rates(dt, rng):
    """Fast poles that fade within a sample cost order, not accuracy."""
    w = rng.normal(size=(200, 1))
    y, _ = run(ifac93().sampled(dt), w)
    model = ifac93().difference_model(dt)
    assert_close(model.simulate(w), y, RECURSION)
    assert model.na == {2.0: 4, 1.0: 6}.get(dt, 7)


@pytest.mark.parametrize(
    ("plant", "dt", "orders"),
    [
        (wood_berry(), 1.0, (3, 10, 12)),
        (wood_berry(), 0.5, (3, 17, 20)),
        (shell(), 10.0, (3, 5, 0)),
        (shell(), 4.0, (3, 9, 0)),
    ],
    ids=["wood-berry 1", "wood-berry 0.5", "shell 10", "shell 4"],
)
def test_plants_with_many_dead_times(plant, dt, orders, rng):
    """Dead times, whole and fractional, in every channel, with disturbances."""
    w = rng.normal(size=(60, plant.n_u + plant.n_v))
    model = plant.difference_model(dt)
    y, _ = run(plant.sampled(dt), w)
    assert (model.na, model.nb, model.ng) == orders
    assert_close(y, brute_force(plant, w, dt)[:-1:FINE], RECURSION)
    assert_close(simulate(model, w), y, RECURSION)
    assert_close(model.steady_state_gain(), plant.steady_state_gain(), RECURSION)


def test_shared_time_constant_is_one_pole():
    """Row 1 of the fractionator has two channels with the same pole: order 2."""
    model = shell().difference_model(10.0)
    assert orders(model) == [2, 3, 3]
    assert not np.any(model.a * (1 - np.eye(3)))
    assert len(shell().poles()) == 8


def test_names_and_units_reach_the_model():
    """Names belong to the plant and stay with it."""
    model = wood_berry().difference_model(1.0)
    assert model.y_names == ("distillate", "bottoms")
    assert (model.u_names, model.v_names) == (("reflux", "steam"), ("feed",))
    assert model.units["distillate"] == "%"


@pytest.mark.parametrize(
    ("levels", "k", "gamma", "kc_zeros"),
    [
        ((12.4, 12.7, 1.8, 1.4), (3.33, 3.35), (0.7, 0.6), (-0.058, -0.017)),
        ((12.6, 13.0, 4.8, 4.9), (3.14, 3.29), (0.43, 0.34), (-0.056, 0.0128)),
    ],
    ids=["minimum phase", "non-minimum phase"],
)
def test_quadruple_tank_rows_are_of_second_order(levels, k, gamma, kc_zeros, rng):
    """Each output sees two of four tanks; the zeros are Johansson's (2000)."""
    area, hole = np.array([28.0, 32, 28, 32]), np.array([0.071, 0.057, 0.071, 0.057])
    T = area / hole * np.sqrt(2 * np.array(levels) / 981.0)
    A = np.diag(-1 / T)
    A[0, 2], A[1, 3] = 1 / T[2], 1 / T[3]
    B = np.zeros((4, 2))
    B[0, 0], B[3, 0] = gamma[0] * k[0] / 28, (1 - gamma[0]) * k[0] / 32
    B[1, 1], B[2, 1] = gamma[1] * k[1] / 32, (1 - gamma[1]) * k[1] / 28
    C = 0.5 * np.eye(2, 4)
    matrices = (A, B, C, np.zeros((2, 2)))
    model = difference_model(scipy.signal.StateSpace(*matrices), dt=1.0)
    u = rng.normal(size=(200, 2))
    _, y, _ = scipy.signal.dlsim(scipy.signal.cont2discrete(matrices, 1.0), u)
    assert (model.na, model.nb) == (2, 2)
    assert_close(model.simulate(u), y, RECURSION)
    zeros = np.sort(np.log(model.zeros().real))
    assert zeros == pytest.approx(kc_zeros, rel=0.02)  # printed with two digits


# Exactness of sampling


@pytest.mark.parametrize("delay", [0.0, 0.3, 1.0, 1.7, 2.999])
def test_fractional_dead_time_of_a_first_order_lag(delay):
    """The analytic formula: the new input acts for the rest of the interval."""
    K, T, dt = 2.0, 5.0, 1.0
    model = ContinuousPlant([[TransferFunction([K], [T, 1.0], delay)]])
    model = model.difference_model(dt)
    lag, late = int(delay), delay - int(delay)
    pole = np.exp(-dt / T)
    now = K * (1 - np.exp(-(dt - late) / T))
    before = K * np.exp(-(dt - late) / T) * (1 - np.exp(-late / T))
    expected = [0.0] * lag + [now] + ([before] if late else [])
    assert_close(model.a.ravel(), np.array([-pole]), ALGEBRA)
    assert_close(model.b.ravel(), np.array(expected), ALGEBRA)


def test_dead_time_that_is_whole_but_for_rounding():
    """0.3 / 0.1 is not 3 in binary numbers, but three samples are meant."""
    plant = ContinuousPlant([[TransferFunction([1.0], [1.0, 1.0], 0.3)]])
    assert plant.difference_model(0.1).dead_time.tolist() == [[4.0]]
    assert plant.sampled(0.1).n_x == 4


def test_between_samples_against_an_integrated_differential_equation(rng):
    """An adaptive integrator follows the delayed input from step to step."""
    plant = ContinuousPlant([[TransferFunction([-2.0, 1.0], [2.0, 1.0, 3.0], 1.3)]])
    w = rng.normal(size=(12, 1))
    _, inner = run(plant.sampled(1.0, substeps=10), w)

    def follow(start: float, stop: float, x: np.ndarray) -> np.ndarray:
        k = int(np.floor((start + stop) / 2 - 1.3))
        u = w[k, 0] if k >= 0 else 0.0
        return scipy.integrate.solve_ivp(
            lambda _, x: [x[1], (u - x[1] - 3.0 * x[0]) / 2.0],
            (start, stop), x, method="DOP853", rtol=1e-12, atol=1e-14,
        ).y[:, -1]  # fmt: skip

    x, y = np.zeros(2), []
    times = np.arange(121) / 10  # the input steps at multiples of 0.1, too
    for start, stop in pairwise(times):
        x = follow(start, stop, x)
        y.append(x[0] - 2.0 * x[1])
    assert_close(inner[:, 0], np.array(y), 1e-10)  # the integrator's own error


REAL_POLES = st.floats(-3.0, -0.05)
PAIRS = st.tuples(st.floats(-2.0, -0.05), st.floats(0.1, 3.0))
SHARED = st.sampled_from([-0.5, -1.0])


@st.composite
def channels(draw) -> TransferFunction | None:
    """Draw nothing, or a channel of order 1 to 3 with a dead time on the fine grid."""
    if draw(st.integers(0, 5)) == 0:
        return None
    kind = draw(st.sampled_from(["shared", "real", "pair", "shared pair"]))
    poles = [draw(SHARED if "shared" in kind else REAL_POLES)]
    if "pair" in kind:
        real, imaginary = draw(PAIRS)
        poles += [real + 1j * imaginary, real - 1j * imaginary]
    size = draw(st.integers(1, len(poles)))
    num = [draw(st.sampled_from([-2.0, -1.0, 0.5, 1.0, 3.0])) for _ in range(size)]
    return TransferFunction(num, poly(*poles), draw(st.integers(0, 60)) / FINE)


@st.composite
def plants(draw) -> ContinuousPlant:
    """Draw a plant of up to 3 outputs, 3 inputs and 2 disturbances; dt = 1."""
    n_y, n_u, n_v = (draw(st.integers(*ends)) for ends in ((1, 3), (1, 3), (0, 2)))
    table = [[draw(channels()) for _ in range(n_u)] for _ in range(n_y)]
    disturbances = [[draw(channels()) for _ in range(n_v)] for _ in range(n_y)]
    return ContinuousPlant(table, disturbances if n_v else None)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(plants())
def test_any_plant_agrees_with_brute_force(plant):
    """At the samples, between them, and as a difference equation."""
    rng = np.random.default_rng(0)
    w = rng.normal(size=(25, plant.n_u + plant.n_v))
    fine = brute_force(plant, w, 1.0)
    y, inner = run(plant.sampled(1.0, substeps=5), w)
    model = plant.difference_model(1.0)
    assert_close(y, fine[:-1:FINE], RECURSION)
    assert_close(inner, fine[FINE // 5 :: FINE // 5], RECURSION)
    assert_close(simulate(model, w), y, RECURSION)
    assert not np.any(model.a * (1 - np.eye(plant.n_y)))


@settings(max_examples=40, deadline=None, derandomize=True)
@given(plants())
def test_every_delay_is_whole_leading_zeros(plant):
    """The first coefficient that is not zero stands where the dead time says."""
    dead_time = plant.difference_model(1.0).dead_time
    for i, row in enumerate(plant.channels):
        for j, channel in enumerate(row):
            if channel is not None:
                assert dead_time[i, j] == int(channel.delay + 1e-9) + 1


# Orders: nothing missing, nothing spurious


@pytest.mark.parametrize(
    ("row", "order"),
    [
        (([1.0], poly(-1, -1)), 2),
        (([1.0], poly(-1, -1), [2.0], poly(-1)), 2),
        (([1.0], poly(-1, -1, -1), [2.0], poly(-1, -2), [1.0], poly(-2, -2)), 5),
        (([1.0], [1, 0], [1.0], [1, 0, 0], [2.0], [1, 0]), 2),
        ((poly(-3), poly(-1, -3)), 1),
        ((poly(-3), poly(-1, -3), [1.0], poly(-3)), 2),
        (([1.0], poly(0.5, -1), [1.0], poly(0.5)), 2),
        (([1e-6], poly(-1, -2), [1e6], poly(-1.1)), 3),
        (([1e-9], poly(-1, -2), [1e9], poly(-1.1), [1.0], poly(-1)), 3),
        (([1.0], poly(-1), [1.0], poly(-1.00001)), 2),
        (([1.0], poly(-1), [1.0], poly(-1 - 1e-8)), 2),
        (([1.0], poly(-1, -1000), [1.0], poly(-1, -0.001)), 2),
    ],
    ids=[
        "double pole", "double and single", "triple and double", "integrators",
        "common factor", "common factor needed by another", "unstable",
        "gains of 1e-6 and 1e6", "such gains and a shared pole", "nearly equal poles",
        "poles a little further apart than rounding", "a pole that fades at once",
    ],
)  # fmt: skip
def test_order_is_the_least_common_multiple(row, order, rng):
    """Repeated, shared, cancelled, unstable and badly scaled poles."""
    pairs = zip(row[::2], row[1::2], strict=True)
    plant = ContinuousPlant([[TransferFunction(num, den) for num, den in pairs]])
    w = rng.normal(size=(60, plant.n_u))
    model = plant.difference_model(0.5)
    assert model.na == order
    assert_close(model.simulate(w), run(plant.sampled(0.5), w)[0], RECURSION)


def test_common_integrator_is_one_state():
    """Two inputs that cancel leave an integrating plant at rest."""
    tank = ContinuousPlant(
        [[TransferFunction([1.0], [2.0, 0.0]), TransferFunction([-3.0], [4.0, 0.0])]]
    )
    plant = tank.sampled(1.0)
    assert plant.n_x == 1
    state = plant.reset(np.array([3.0, 2.0]), np.zeros(0))
    assert np.abs(plant.step(state, np.array([3.0, 2.0]), np.zeros(0))).max() == 0.0
    assert np.isinf(tank.steady_state_gain()).all()


def test_channels_that_do_nothing():
    """None is a zero channel; an output that nothing moves has zero coefficients."""
    lag = TransferFunction([1.0], [2.0, 1.0])
    model = ContinuousPlant([[None, None], [lag, None]]).difference_model(1.0)
    assert (model.na, model.nb) == (1, 1)
    assert not model.a[:, 0].any()
    assert not model.b[:, 0].any()
    assert model.simulate(np.ones((5, 2)))[-1, 0] == 0.0
    assert ContinuousPlant([[None]]).sampled(1.0).n_x == 0


# Systems of other packages

A2 = np.array([[-1.0, 0.5], [0.0, -2.0]])
MATRICES = (A2, np.array([[1.0, 0.0], [1.0, 2.0]]), np.eye(2), np.zeros((2, 2)))


@pytest.mark.parametrize(
    "system",
    [
        scipy.signal.TransferFunction([1.0, 3.0], poly(-1, -2, -4)),
        scipy.signal.ZerosPolesGain([-3.0], [-1, -2, -4], 1.0),
        scipy.signal.TransferFunction([1.0, 3.0], poly(-1, -2, -4)).to_ss(),
        control.tf([1.0, 3.0], poly(-1, -2, -4)),
        control.ss(control.tf([1.0, 3.0], poly(-1, -2, -4))),
        TransferFunction([1.0, 3.0], poly(-1, -2, -4)),
        ContinuousPlant([[TransferFunction([1.0, 3.0], poly(-1, -2, -4))]]),
    ],
    ids=lambda system: (
        f"{type(system).__module__.split('.')[0]} {type(system).__name__}"
    ),
)
def test_one_continuous_system_in_seven_guises(system):
    """All become the equation that SciPy's own conversion gives."""
    model = difference_model(system, dt=0.5)
    num, den, _ = scipy.signal.cont2discrete(([1.0, 3.0], poly(-1, -2, -4)), 0.5)
    assert_close(model.a.ravel(), den[1:], ALGEBRA)
    assert_close(model.b.ravel(), num[0, 1:], ALGEBRA)
    assert model.dt == 0.5


@pytest.mark.parametrize("package", [scipy.signal.StateSpace, control.ss])
def test_state_space_with_many_outputs(package, rng):
    """Row by row, continuous and discrete."""
    u = rng.normal(size=(50, 2))
    discrete = scipy.signal.cont2discrete(MATRICES, 0.5)
    _, expected, _ = scipy.signal.dlsim(discrete, u)
    sampled = {"dt": 0.5} if package is scipy.signal.StateSpace else {}
    same = package(*discrete[:4], **sampled) if sampled else package(*discrete)
    for model in (difference_model(package(*MATRICES), 0.5), difference_model(same)):
        assert_close(model.simulate(u), expected, RECURSION)
        assert orders(model) == [2, 1]


@pytest.mark.parametrize("continuous", [True, False])
def test_units_do_not_change_orders(continuous):
    """States, inputs and outputs in odd units hide no mode and show none."""
    A = np.array([[-1.0, 0.5, 0.0], [0.0, -2.0, 0.0], [0.3, 0.4, -0.5]])
    A = A if continuous else 0.2 * A
    B, C = np.array([[1.0, 0.0], [1.0, 2.0], [0.0, 1.0]]), np.eye(2, 3)
    D, x, u, y = np.zeros((2, 2)), np.diag([1e6, 1.0, 1e-6]), 1e-12, 1e-14
    own = {} if continuous else {"dt": 0.5}
    dt = 0.5 if continuous else None
    plain = difference_model(scipy.signal.StateSpace(A, B, C, D, **own), dt)
    odd = (x @ A @ np.linalg.inv(x), x @ B * u, C @ np.linalg.inv(x) * y, D)
    model = difference_model(scipy.signal.StateSpace(*odd, **own), dt)
    assert orders(plain) == [2, 1]
    assert_close(model.a, plain.a, ALGEBRA)
    assert_close(model.b / (u * y), plain.b, ALGEBRA)


@pytest.mark.parametrize("seed", range(20))
def test_rotated_states_hide_nothing(seed):
    """Modes that an output does not see stay unseen when all matrices are full."""
    rng = np.random.default_rng(seed)
    A = -np.diag(rng.uniform(0.05, 1.0, 4))
    A[0, 2], A[1, 3] = 0.3, 0.5
    B = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0.4, 0], [0.5, 0, 0]])
    C, D = np.eye(4)[[0, 1, 3]], np.zeros((3, 3))
    Q, _ = np.linalg.qr(rng.normal(size=(4, 4)))
    plain = difference_model(scipy.signal.StateSpace(A, B, C, D), 1.0)
    turned = scipy.signal.StateSpace(Q @ A @ Q.T, Q @ B, C @ Q.T, D)
    model = difference_model(turned, 1.0)
    assert orders(model) == orders(plain) == [2, 2, 1]
    assert np.array_equal(model.dead_time, plain.dead_time)
    assert_close(model.b, plain.b, ALGEBRA)


def test_matrix_of_transfer_functions():
    """Python-control's tables of num and den: each row gets its common multiple."""
    num = [[[1.0], [2.0]], [[1.0, 0.0], [3.0]]]
    den = [[[1.0, 1.0], [1.0, 2.0]], [[1.0, 0.5, 1.0], [1.0, 1.0]]]
    model = difference_model(control.tf(num, den), dt=0.5)
    expected = ContinuousPlant(
        [[TransferFunction(*pair) for pair in zip(*row, strict=True)]
         for row in zip(num, den, strict=True)]
    ).difference_model(0.5)  # fmt: skip
    assert np.array_equal(model.a, expected.a)
    assert np.array_equal(model.b, expected.b)
    assert orders(model) == [2, 3]


def test_discrete_matrix_of_transfer_functions(rng):
    """Different denominators in z, one with a pole at zero, against their responses."""
    num = [[[1.0], [2.0], [0.0]], [[1.0, 0.0], [3.0], [1.0]]]
    den = [
        [[1.0, -0.5], [1.0, -0.2, 0.0], [1.0]],
        [[1.0, 0.5, 0.1], [1.0, -0.5], [1.0, -0.5]],
    ]
    model = difference_model(control.tf(num, den, 0.1))
    u = rng.normal(size=(40, 3))
    for i in range(2):
        parts = [scipy.signal.dlti(num[i][j], den[i][j], dt=0.1) for j in range(2)]
        if i == 1:
            parts.append(scipy.signal.dlti([1.0], [1.0, -0.5], dt=0.1))
        y = sum(scipy.signal.dlsim(p, u[:, j])[1] for j, p in enumerate(parts))
        assert_close(model.simulate(u)[:, i], y[:, 0], ALGEBRA)
    assert orders(model) == [2, 3]
    assert model.dt == 0.1


def test_coefficients_of_a_discrete_transfer_function_are_kept():
    """No digit changes, and a factor that cancels stays if it was given."""
    model = difference_model(scipy.signal.dlti([0.0946], [1, -0.9055, 0], dt=0.5))
    assert model.a.ravel().tolist() == [-0.9055]
    assert model.b.ravel().tolist() == [0.0, 0.0946]
    model = difference_model(scipy.signal.dlti([2, -1.0], [2, -2.4, 0.7], dt=1.0))
    assert model.a.ravel().tolist() == [-1.2, 0.35]
    assert model.b.ravel().tolist() == [1.0, -0.5]


def test_one_input_and_many_outputs_in_scipy():
    """SciPy's table of numerators over one denominator."""
    model = difference_model(scipy.signal.TransferFunction([[1], [2]], [1, 1]), dt=1.0)
    assert (model.n_y, model.n_u) == (2, 1)
    assert_close(model.steady_state_gain(), np.array([[1.0], [2.0]]), ALGEBRA)


def test_pure_delay_in_discrete_time():
    """Poles at zero are dead time: y_k = u_{k-2}."""
    model = difference_model(scipy.signal.dlti([1.0], [1.0, 0.0, 0.0], dt=1.0))
    assert model.a.ravel().tolist() == [0.0]
    assert model.b.ravel().tolist() == [0.0, 1.0]
    chain = scipy.signal.dlti([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], [[0]], dt=1.0)
    assert difference_model(chain).b.ravel() == pytest.approx([0.0, 1.0], abs=ALGEBRA)


# What is refused


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([1, 1], [1, 2]), "num has degree 1 and den degree 1; .* no u_k"),
        (([0, 0], [1, 2]), "None is a channel that does nothing"),
        (([1], [0]), "den has no coefficient other than zero"),
        (([1], [1, np.nan]), "expected a list of finite numbers"),
        (([1], [1, 1], -0.1), "delay is -0.1"),
    ],
)
def test_transfer_functions_are_checked(arguments, message):
    """The message names the argument."""
    with pytest.raises(ValueError, match=message):
        TransferFunction(*arguments)


def test_leading_zeros_are_no_degree():
    """Tables of coefficients often carry leading zeros."""
    assert TransferFunction([0, 0, 1], [0, 2, 1]) == TransferFunction([1], [2, 1])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((TransferFunction([1], [1, 1]),), "expected a list of rows"),
        (([],), "expected a list of rows"),
        (([[1.0]],), r"channels\[0\]\[0\] is a float"),
        (([[None], [None, None]],), r"rows of \[1, 2\] channels"),
        (([[None]], [[None], [None]]), "disturbance_channels has 2 rows; expected 1"),
    ],
)
def test_tables_are_checked(arguments, message):
    """Rows are outputs, and alike."""
    with pytest.raises(ValueError, match=message):
        ContinuousPlant(*arguments)


@pytest.mark.parametrize(
    ("system", "dt", "message"),
    [
        (3.0, 1.0, "system is a float"),
        (control.tf([1, 1], [1, 2]), 1.0, "no feedthrough"),
        (scipy.signal.StateSpace(-1, 1, 1, 1), 1.0, r"feedthrough, D = \[\[1.0\]\]"),
        (scipy.signal.dlti([1], [1, 0.5]), None, "dt is missing"),
        (scipy.signal.lti([1], [1, 0.5]), None, "dt is missing"),
        (scipy.signal.dlti([1], [1, 0.5], dt=0.1), 0.2, "sampled every 0.1"),
        (scipy.signal.lti([1], [1, 0.5]), -1.0, "dt is -1.0"),
    ],
)
def test_unfit_systems_are_refused(system, dt, message):
    """Feedthrough, unknown objects and missing or contradicting intervals."""
    with pytest.raises(ValueError, match=message):
        difference_model(system, dt)


def test_sampling_arguments_are_checked():
    """Both numbers are named."""
    with pytest.raises(ValueError, match="dt is 0"):
        ifac93().sampled(0)
    with pytest.raises(ValueError, match="substeps is 0"):
        ifac93().sampled(0.5, substeps=0)
    assert ifac93().sampled(0.5).between is None
