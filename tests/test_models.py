"""Difference equations and sampled plants."""

import numpy as np
import pytest
from conftest import ALGEBRA, printed
from strategies import SIZES, random_model, relative, roll_out

from nmss_lab.models import DifferenceModel, LinearPlant

MODEL = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_simulation_is_the_equation(rng, sizes):
    """(7.1) with plain loops, from any constant past output."""
    model = random_model(rng, *sizes)
    u, v = rng.random((9, model.n_u)), rng.random((9, model.n_v))
    y = roll_out(model, [np.zeros(model.n_y)], [], [], list(u), list(v))
    wanted = np.array([np.zeros(model.n_y), *y[:-1]])
    assert relative(model.simulate(u, v), wanted) <= 10 * ALGEBRA
    y0 = rng.random(model.n_y)
    past = [y0] * model.na
    wanted = [y0, *roll_out(model, past, [], [], list(u), list(v))[:-1]]
    assert relative(model.simulate(u, v, y0), np.array(wanted)) <= 10 * ALGEBRA


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_plant_starts_from_any_constant_past(rng, sizes):
    """Past y, u and v need not fit each other."""
    model = random_model(rng, *sizes)
    y0, u0, v0 = (rng.random(n) for n in (model.n_y, model.n_u, model.n_v))
    plant = model.plant()
    state = plant.reset(u0, v0, y0)
    u, v = rng.random((5, model.n_u)), rng.random((5, model.n_v))
    y = [y0] * model.na
    wanted = roll_out(model, y, [u0] * model.nb, [v0] * model.ng, list(u), list(v))
    for k in range(5):
        state = plant.step(state, u[k], v[k])
        assert relative(plant.output(state), wanted[k]) <= 10 * ALGEBRA


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_steady_state_is_where_a_constant_input_leads(rng, sizes):
    """A(1)^-1 B(1) and A(1)^-1 G(1)."""
    model = random_model(rng, *sizes, radius=0.5)
    u, v = rng.random(model.n_u), rng.random(model.n_v)
    y = model.simulate(np.tile(u, (200, 1)), np.tile(v, (200, 1)))[-1]
    wanted = model.steady_state_gain() @ u + model.disturbance_gain() @ v
    assert relative(y, wanted) <= 1e-9
    plant = model.plant()
    at_rest = plant.reset(u, v)
    assert relative(plant.output(at_rest), wanted) <= 1e-9
    assert relative(plant.step(at_rest, u, v), at_rest) <= 1e-9


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_frequency_response_of_model_and_plant_agree(rng, sizes):
    """At any point of the z-plane; z = 1 is the steady-state gain."""
    model = random_model(rng, *sizes, radius=0.5)
    for z in (1.0, 1j, 0.8 + 0.6j):
        difference = model.response(z) - model.plant().response(z)
        assert np.abs(difference).max() <= 1e-9 * np.abs(model.response(z)).max()
    assert relative(model.response(1.0), model.steady_state_gain()) <= 1e-12


def test_poles_of_the_marginally_stable_plant():
    """(6.10): on the unit circle, gain 10/3, a zero at 2."""
    assert np.abs(MODEL.poles()) == pytest.approx([1.0, 1.0])
    assert MODEL.steady_state_gain()[0, 0] == pytest.approx(10 / 3)
    assert MODEL.zeros() == pytest.approx([2.0])


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_poles_are_where_the_denominator_loses_rank(rng, sizes):
    """Where det A(z) = 0, and as many as na n_y."""
    model = random_model(rng, *sizes)
    poles = model.poles()
    assert poles.size == model.na * model.n_y
    assert np.abs(poles).max() == pytest.approx(0.9)
    for z in poles:
        terms = [a * z ** -(i + 1.0) for i, a in enumerate(model.a)]
        smallest = np.linalg.svd(np.eye(model.n_y) + sum(terms), compute_uv=False)[-1]
        assert smallest < 1e-9 * (1.0 + sum(np.abs(each).max() for each in terms))


def test_zeros_of_a_square_model_block_the_transfer(rng):
    """G(z) loses rank at each."""
    model = random_model(rng, 2, 2, 0, 1, 2)
    zeros = model.zeros()
    assert zeros.size > 0
    for z in zeros:
        response = model.response(z)
        assert np.linalg.cond(response) > 1e6


def test_cancelled_factor_is_no_zero():
    """A common factor of A and B is a hidden mode, not a transmission zero."""
    model = DifferenceModel([-1.4, 0.45], [0.3, -0.27])
    assert model.zeros().size == 0
    assert np.abs(model.poles()) == pytest.approx([0.9, 0.5])


def test_integrating_model_has_an_infinite_gain():
    """And no rest for an input that is not zero."""
    model = DifferenceModel([-1.0], [0.5])
    assert np.isinf(model.steady_state_gain()).all()
    plant = LinearPlant(np.eye(1), np.ones((1, 1)), np.ones((1, 1)))
    with pytest.raises(ValueError, match="no equilibrium: the plant integrates"):
        plant.reset(np.ones(1), np.zeros(0))


def test_dead_time_counts_samples_from_input_to_output():
    """At least one; a pathway without effect counts past the last."""
    b = np.zeros((3, 2, 2))
    b[0, 0, 0], b[2, 0, 1], b[1, 1, 0] = 1.0, 2.0, 3.0
    model = DifferenceModel(-0.5 * np.eye(2)[None], b)
    assert model.dead_time.tolist() == [[1.0, 3.0], [2.0, 4.0]]


def test_coefficients_can_be_varied():
    """(6.11): numerators (of disturbances too) and denominators."""
    model = DifferenceModel([-0.5, 0.1], [1.0], [2.0], y_names=["level"])
    other = model.varied(numerator=1.1, denominator=0.9)
    assert other.a[:, 0, 0] == pytest.approx([-0.45, 0.09])
    assert other.b[:, 0, 0] == pytest.approx([1.1])
    assert other.g[:, 0, 0] == pytest.approx([2.2])
    assert other.y_names == ("level",)


def test_model_keeps_its_own_coefficients():
    """Frozen: changing the array that was handed in changes nothing."""
    a = np.array([-0.5])
    model = DifferenceModel(a, [1.0])
    a[0] = 9.0
    assert model.a[0, 0, 0] == -0.5
    with pytest.raises(ValueError, match="read-only"):
        model.a[0, 0, 0] = 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"a": np.zeros((1, 2, 3))}, r"a has shape \(1, 2, 3\), expected \(na, n_y"),
        ({"a": []}, r"a has shape \(0, 1, 1\), expected \(order"),
        ({"b": np.zeros((1, 2, 1))}, r"b has shape \(1, 2, 1\), expected 1 rows"),
        ({"b": np.zeros((2, 2))}, r"b has shape \(2, 2\)"),
        ({"g": np.zeros((1, 3, 1))}, r"g has shape \(1, 3, 1\)"),
        ({"a": [np.nan]}, r"a\[0, 0, 0\] is not finite"),
        ({"dt": 0.0}, "dt = 0.0 is not a positive"),
        ({"dt": np.nan}, "dt = nan"),
        ({"y_names": ["a", "b"]}, "y_names = .* expected 1 different names"),
    ],
)
def test_mistakes_are_refused(arguments, message):
    """The argument at fault is named with its shape."""
    with pytest.raises(ValueError, match=message):
        DifferenceModel(**{"a": [-0.5], "b": [1.0], **arguments})


def test_zeros_need_a_square_model(rng):
    """The message counts inputs and outputs."""
    with pytest.raises(ValueError, match="2 outputs and 1 inputs"):
        random_model(rng, 2, 1).zeros()


def test_printed_gains_of_the_siso_disturbance_example():
    """Section 7.4.1: 0.03 / 0.05 and 0.2 / 0.05."""
    model = DifferenceModel([-1.4, 0.45], [0.3, -0.27], [0.4, -0.2])
    assert model.steady_state_gain()[0, 0] == pytest.approx(0.6, abs=printed("0.600"))
    assert model.disturbance_gain()[0, 0] == pytest.approx(4.0, abs=printed("4.000"))
