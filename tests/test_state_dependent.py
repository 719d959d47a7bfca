"""State-dependent models against a roll-out written with plain loops."""

import pickle

import numpy as np
import pytest
from conftest import ALGEBRA, REPLAY
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import relative

from nmss_lab.models import DifferenceModel
from nmss_lab.simulate import Scenario, closed_loop
from nmss_lab.state_dependent import StateDependentModel

CENTRAL = 1e-8
"""Central differences with a step of 1e-6: 1e-16 / 1e-6 and the step squared."""

CURVED = 1e-7
"""`curvature` promises about 1e-9 relative to entries of order one to ten."""

FEW = settings(max_examples=25, deadline=None, derandomize=True)


def single() -> StateDependentModel:
    """Lags of coefficients beyond na and nb, two of each."""
    return StateDependentModel(
        ["-0.5 + 0.1*u[k-3]", 0.1],
        ["1 + 0.2*y[k-3]", "c*exp(-y[k-1]**2)*u[k-2]"],
        constants={"c": 0.3},
    )


def several() -> StateDependentModel:
    """Two outputs, three inputs; texts by number and by name, and functions."""
    a = [
        [["-0.4 + 0.1*sin(h[k-2])", 0.1], [-0.2, lambda y, u: 0.1 * u[..., 1, 2] - 0.3]]
    ]
    b = [
        [[1.0, "0.2*T[k-3]", 0.3], [0.1, 0.5, "0.1*u1[k-2]*u3[k-1]"]],
        [[0.2, 0.0, lambda y, u: 0.1 * y[..., 0, 0] ** 2], ["0.3", 0.1, "0.2*u2[k-1]"]],
    ]
    return StateDependentModel(a, b, y_names=["h", "T"], u_names=["p", "q", "s"])


MODELS = [single, several]


def past_value(series, i):
    """Return the value i samples before the newest."""
    return series[-1 - i]


def single_next(y, u):
    """Equation of ``single`` by hand; histories end with the newest."""
    a1 = -0.5 + 0.1 * u[-3][0]
    b1 = 1.0 + 0.2 * y[-3][0]
    b2 = 0.3 * np.exp(-(y[-1][0] ** 2)) * u[-2][0]
    return np.array([-a1 * y[-1][0] - 0.1 * y[-2][0] + b1 * u[-1][0] + b2 * u[-2][0]])


def several_next(y, u):
    """Equation of ``several`` by hand."""
    h, T = y[-1]
    p, q, s = u[-1]
    p2, q2, s2 = u[-2]
    y1 = -(-0.4 + 0.1 * np.sin(y[-2][0])) * h - 0.1 * T
    y1 += p + 0.2 * y[-3][1] * q + 0.3 * s
    y1 += 0.2 * p2 + 0.1 * h**2 * s2
    y2 = 0.2 * h - (0.1 * s2 - 0.3) * T
    y2 += 0.1 * p + 0.5 * q + 0.1 * p2 * s * s
    y2 += 0.3 * p2 + 0.1 * q2 + 0.2 * q * s2
    return np.array([y1, y2])


NEXT = {single: single_next, several: several_next}


def by_hand(make, y, u, ahead, load=0.0):
    """Return outputs under inputs; histories start with the newest, as roll_out's."""
    outputs, inputs = list(y[::-1]), list(u[::-1])
    for u_now in ahead:
        inputs.append(u_now)
        outputs.append(NEXT[make](outputs, inputs) + load)
    return np.array(outputs[len(y) :])


def draw(model, rng, *lead, steps=6):
    """Random past and inputs ahead."""
    y = rng.uniform(-1, 1, (*lead, model.y_lags, model.n_y))
    u = rng.uniform(-1, 1, (*lead, model.u_lags, model.n_u))
    return y, u, rng.uniform(-1, 1, (*lead, steps, model.n_u))


@pytest.mark.parametrize("make", MODELS)
def test_lags_are_those_that_coefficients_read(make):
    """Lags of texts count; those of functions are told."""
    model = make()
    assert (model.y_lags, model.u_lags) == (3, 3 if make is single else 2)
    told = StateDependentModel([lambda y, u: y[..., 3, 0]], [1.0], y_lags=4)
    assert (told.y_lags, told.u_lags, told.na, told.nb) == (4, 1, 1, 1)


@pytest.mark.parametrize("make", MODELS)
@FEW
@given(seed=st.integers(0, 999))
def test_roll_out_is_the_plain_loop(make, seed):
    """Step by step, with a constant load too."""
    model, rng = make(), np.random.default_rng(seed)
    y, u, ahead = draw(model, rng)
    found = model.roll_out(y, u, ahead)
    assert relative(found, by_hand(make, y, u, ahead)) <= ALGEBRA
    load = rng.uniform(-0.5, 0.5, model.n_y)
    wanted = by_hand(make, y, u, ahead, load)
    assert relative(model.roll_out(y, u, ahead, load), wanted) <= ALGEBRA


@pytest.mark.parametrize("make", MODELS)
def test_all_functions_take_many_at_once(make, rng):
    """Leading axes give the same as one by one."""
    model = make()
    y, u, ahead = draw(model, rng, 3, 2)
    together = [
        model.roll_out(y, u, ahead),
        model.step(y, u),
        model.curvature(y, u),
        *model.coefficients(y, u),
        *model.derivative(y, u),
    ]
    for where in np.ndindex(3, 2):
        one = y[where], u[where]
        alone = [
            model.roll_out(*one, ahead[where]),
            model.step(*one),
            model.curvature(*one),
            *model.coefficients(*one),
            *model.derivative(*one),
        ]
        for many, single_ in zip(together, alone, strict=True):
            assert relative(many[where], single_) <= ALGEBRA


@pytest.mark.parametrize("make", MODELS)
def test_windows_are_what_each_step_reads(make, rng):
    """A step from each window gives the trajectory again."""
    model = make()
    y, u, ahead = draw(model, rng)
    outputs = model.roll_out(y, u, ahead)
    past_y, past_u = model.windows(y, u, outputs, ahead)
    assert past_y.shape == (6, model.y_lags, model.n_y)
    assert past_u.shape == (6, model.u_lags, model.n_u)
    assert relative(model.step(past_y, past_u), outputs) <= ALGEBRA
    assert past_u[:, 0] == pytest.approx(ahead)
    assert past_y[0] == pytest.approx(y)


def slopes(function, flat, step):
    """Central differences of a function of a vector, along a last axis."""
    columns = []
    for j in range(len(flat)):
        change = np.zeros_like(flat)
        change[j] = step
        difference = function(flat + change) - function(flat - change)
        columns.append(difference / (2.0 * step))
    return np.stack(columns, axis=-1)


def of_flat(model, function):
    """Turn a function of (y, u) into one of a flat vector."""
    n = model.y_lags * model.n_y

    def flat(x):
        return function(
            x[:n].reshape(model.y_lags, model.n_y),
            x[n:].reshape(model.u_lags, model.n_u),
        )

    return flat


def joined(model, y, u):
    """Join the derivatives by all past values, (n_y, m), outputs first."""
    a, b = model.derivative(y, u)
    return np.hstack([*(-a), *b])


@pytest.mark.parametrize("make", MODELS)
@FEW
@given(seed=st.integers(0, 999))
def test_derivative_and_curvature_against_differences(make, seed):
    """Exact first derivatives, second ones as good as promised."""
    model = make()
    y, u, _ = draw(model, np.random.default_rng(seed))
    x = np.concatenate([y.ravel(), u.ravel()])
    wanted = slopes(of_flat(model, model.step), x, 1e-6)
    assert np.abs(joined(model, y, u) - wanted).max() <= CENTRAL
    again = slopes(of_flat(model, lambda *past: joined(model, *past)), x, 1e-5)
    assert np.abs(model.curvature(y, u) - again).max() <= CURVED


def test_derivative_and_curvature_are_the_analytic_ones():
    """y_k = 0.7 y_{k-1} + u_{k-2} u_{k-1}."""
    model = StateDependentModel([-0.7], ["u[k-2]"])
    y, u = np.array([[1.3]]), np.array([[0.4], [-0.9]])
    a, b = model.derivative(y, u)
    assert a.ravel() == pytest.approx([-0.7], abs=ALGEBRA)
    assert b.ravel() == pytest.approx([-0.9, 0.4], abs=ALGEBRA)
    wanted = [[0, 0, 0], [0, 0, 1], [0, 1, 0]]
    assert model.curvature(y, u)[0] == pytest.approx(np.array(wanted), abs=CURVED)


def test_a_function_that_is_not_complex_is_not_differentiated_wrongly():
    """``np.abs`` drops what a complex step carries: a zero would be a silent error."""
    model = StateDependentModel([-0.5], [lambda y, u: 1.0 + np.abs(y[..., 0, 0])])
    y, u = np.array([[2.0]]), np.array([[3.0]])
    try:
        a, _ = model.derivative(y, u)
    except ValueError:
        return
    assert a.ravel() == pytest.approx([-3.5], abs=CENTRAL)


def test_a_function_that_ignores_leading_axes_is_refused():
    """Its values would be spread over samples without a word."""
    model = StateDependentModel([-0.5], [lambda y, u: 1.0 + y[0, 0]])
    y, u = np.arange(1.0, 4.0).reshape(3, 1, 1), np.ones((3, 1, 1))
    with pytest.raises(ValueError, match=r"b\[0"):
        model.step(y, u)


@pytest.mark.parametrize("make", MODELS)
def test_frozen_holds_the_coefficients(make, rng):
    """One step of the frozen model is one step of the plant; names come along."""
    model = make()
    y, u, _ = draw(model, rng)
    frozen = model.frozen(y, u)
    assert isinstance(frozen, DifferenceModel)
    assert frozen.y_names == model.y_names
    following = sum(frozen.b[i] @ u[i] for i in range(frozen.nb)) - sum(
        frozen.a[i] @ y[i] for i in range(frozen.na)
    )
    assert relative(following, model.step(y, u)) <= ALGEBRA


@pytest.mark.parametrize("make", MODELS)
def test_rest_stays_and_the_plant_is_the_model(make, rng):
    """A plant that starts at rest stays there; ``simulate`` is the plant."""
    model = make()
    u0 = np.full(model.n_u, 0.2)
    y0 = model.rest(u0, near=0.1)
    still = model.simulate(np.tile(u0, (8, 1)), y0, u0)
    assert np.abs(still - y0).max() <= REPLAY
    u = rng.uniform(-0.5, 0.5, (8, model.n_u))
    y, plant = model.simulate(u, y0, u0), model.plant()
    state = plant.reset(u0, np.zeros(0))
    state = plant.reset(u0, np.zeros(0), y0)
    for k in range(8):
        assert plant.output(state) == pytest.approx(y[k], abs=REPLAY)
        state = plant.step(state, u[k], np.zeros(0))
    many = model.simulate(np.stack([u, 2 * u]), y0, u0)
    assert relative(many[0], y) <= ALGEBRA


def test_rest_that_is_not_there_is_refused():
    """Y = 1 + y**2 has no rest."""
    model = StateDependentModel(["-(y[k-1] + 1/y[k-1])"], [1.0])
    with pytest.raises(ValueError, match="gives no rest"):
        model.rest(np.zeros(1))


def test_what_is_not_finite_is_named():
    """A coefficient that leaves the numbers."""
    model = StateDependentModel([-0.5], ["1/y[k-1]"])
    with pytest.raises(ValueError, match=r"b\[0, 0, 0\] is not finite"):
        model.frozen(np.zeros((1, 1)), np.zeros((1, 1)))


def test_a_run_away_trajectory_is_not_an_error():
    """It grows to what is no number, without a warning."""
    model = StateDependentModel(["-y[k-1]"], [1.0])
    ahead = np.full((30, 1), 3.0)
    y = model.roll_out(np.ones((1, 1)), np.zeros((0, 1)), ahead)
    assert not np.isfinite(y[-1]).all()
    assert np.isfinite(y[:3]).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"a": [[-0.5, 0.1]]}, r"a has shape \(1, 2\)"),
        ({"a": [[[1.0], [2.0]]]}, r"a has shape \(1, 2, 1\), b \(1, 1, 1\)"),
        ({"b": [[[1.0]], [[1.0, 2.0]]]}, "b is not regular"),
        ({"a": "y[k-1]"}, "a = 'y.*expected a list of coefficients"),
        ({"a": []}, "a has shape"),
        ({"a": ["z[k-1]"]}, r"a\[0, 0, 0\] .*z"),
        ({"b": ["y[k]"]}, r"b\[0, 0, 0\] .*only past values"),
        ({"b": [None]}, r"b\[0, 0, 0\] = None: expected a number"),
        ({"b": [np.inf]}, r"b\[0, 0, 0\] = inf is not finite"),
        ({"dt": 0.0}, "dt"),
        ({"y_names": ["a", "b"]}, "y_names"),
        ({"constants": {"c": np.nan}, "b": ["c*y[k-1]"]}, "constant c"),
    ],
)
def test_mistakes_name_the_argument(arguments, message):
    """And the entry, where it is one."""
    options = {"a": [-0.5], "b": [1.0], **arguments}
    with pytest.raises(ValueError, match=message):
        StateDependentModel(**options)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m: m.simulate(np.zeros((5, 3))), r"u has shape \(5, 3\)"),
        (lambda m: m.simulate(np.zeros(5), y0=[1.0, 2.0]), "y0"),
        (lambda m: m.simulate(np.zeros(5), u0=[1.0, 2.0]), "u0"),
        (lambda m: m.rest([1.0, 2.0]), "u0"),
    ],
)
def test_wrong_sizes_name_the_argument(call, message):
    """At the border, not deep inside numpy."""
    with pytest.raises(ValueError, match=message):
        call(StateDependentModel([-0.7], ["u[k-2]"]))


def test_pickle_keeps_texts():
    """What was read from texts is read again."""
    model = pickle.loads(pickle.dumps(single()))
    rng = np.random.default_rng(1)
    y, u, ahead = draw(model, rng)
    assert relative(model.roll_out(y, u, ahead), by_hand(single, y, u, ahead)) <= 1e-12


def test_a_linear_structure_says_that_it_needs_another_model():
    """No AttributeError deep inside."""
    from nmss_lab.mpc import wang_young
    from nmss_lab.predict import Horizon

    with pytest.raises(ValueError, match="model"):
        wang_young(single(), Horizon(3, 2), 1.0, 1.0)


def test_a_plant_with_a_load_is_another_plant():
    """The load enters each sample."""
    from nmss_lab.sdp import sdp_pip
    from nmss_lab.state_dependent import StateDependentPlant

    model = StateDependentModel([-0.7], ["u[k-2]"])
    plant = StateDependentPlant(model, 0.1)
    state = plant.reset(np.ones(1) * 0.5, np.zeros(0), np.ones(1))
    following = plant.output(plant.step(state, np.ones(1) * 0.5, np.zeros(0)))
    assert following == pytest.approx([0.7 + 0.25 + 0.1], abs=ALGEBRA)
    run = closed_loop(
        plant, sdp_pip(model, [0.5, 0.5]), Scenario(np.ones(40), y0=1.0, u0=0.5)
    )
    assert run.y[-1] == pytest.approx([1.0], abs=1e-3)  # poles of a half: 1e-12 left
