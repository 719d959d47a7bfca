"""Forms: states from history, one step on, hidden poles, observers."""

import numpy as np
import pytest
from conftest import ALGEBRA, DECISION
from strategies import (
    SIZES,
    changes,
    next_output,
    play,
    random_model,
    relative,
    roll_out,
)

from nmss_lab.controller import Limits
from nmss_lab.governor import governor
from nmss_lab.models import DifferenceModel
from nmss_lab.mpc import STRUCTURES
from nmss_lab.nmss import (
    Layout,
    differenced_form,
    incremental_pip_form,
    integral_of_error_form,
    minimal_form,
    observed_form,
)
from nmss_lab.pip import lq_gain, pip
from nmss_lab.predict import Horizon

DISTURBED = [each for each in SIZES if each[2]]


def controller(name, model):
    """Return the plainest design of a structure."""
    return STRUCTURES[name](model, Horizon(2, 2), 1.0, 1.0)


def state(c, h):
    """Return x_k of a history."""
    return c.form.recipe.state @ h.memory.vector


@pytest.mark.parametrize("name", list(STRUCTURES))
@pytest.mark.parametrize("sizes", DISTURBED, ids=str)
def test_state_from_history_and_one_step_is_the_model(rng, sizes, name):
    """C (A x + B nu + D r + G delta) is the next output of (7.1)."""
    model = random_model(rng, *sizes)
    aware = name.startswith("disturbance")
    if not aware:  # the model knows its disturbance but the structure does not look
        model = DifferenceModel(model.a, model.b)
    c = controller(name, model)
    h = play(c, rng, steps=12, consistent=True)
    u, r = rng.random(model.n_u), rng.random(model.n_y)
    x, form = state(c, h), c.form
    nu = u if form.drive == "u" else u - h.u[-1]
    after = form.A @ x + form.B @ nu + form.D @ r
    if form.lags:
        dv = changes(h.v)[::-1]
        known = [dv[i] if i >= 0 else np.zeros(model.n_v) for i in form.lags]
        after = after + form.G @ np.concatenate(known)
    wanted = next_output(model, h.y, [*h.u, u], h.v)
    if name == "minimal":  # the near-deadbeat observer still has 0.1**12 to go
        assert form.C @ after == pytest.approx(wanted, abs=DECISION)
    else:
        assert relative(form.C @ after, wanted) <= 100 * ALGEBRA


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_incremental_pip_state_is_the_change_of_the_state(rng, sizes):
    """Delta x_k of (3.13): its last entries are r_k - y_k."""
    model = random_model(rng, *sizes)
    n_x = integral_of_error_form(model).n_x
    c = pip(model, np.zeros((model.n_u, n_x)))
    h = play(c, rng)
    dy, du = changes(h.y)[::-1], changes(h.u)[::-1]
    wanted = [*dy[: model.na], *du[: model.nb - 1], h.r[-1] - h.y[-1]]
    assert relative(state(c, h), np.concatenate(wanted)) <= ALGEBRA
    assert len(incremental_pip_form(model).names) == n_x


def test_governed_sum_takes_the_governed_reference(rng):
    """Not the one that was measured."""
    model = random_model(rng, 1, 1, 0, 2, 2, radius=0.8)
    c = governor(model, lq_gain(model, 1.0, 1.0), 3, Limits(u=(-0.3, 0.3)))
    h = play(c, rng, own=True)
    assert np.abs(sum(h.w) - sum(h.r[:-1])).max() > 1e-3
    assert state(c, h)[-1] == pytest.approx((sum(h.w) - sum(h.y))[0], abs=1e-12)


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_forecast_is_one_step_of_the_model(rng, sizes):
    """What stands in for a measurement that is not a number."""
    model = random_model(rng, *sizes)
    c = controller("wang_young", model)
    h = play(c, rng, steps=8, consistent=True)
    move = c.decide(h.memory)
    memory = c.apply(h.memory, move.u, move)
    found = c.form.recipe.forecast @ memory.vector
    wanted = next_output(model, h.y, [*h.u, move.u], h.v)
    assert relative(found, wanted) <= 100 * ALGEBRA


# --- Reachability --------------------------------------------------------------------


def test_common_factor_leaves_a_fixed_pole():
    """Section 7.4.1: rank 3 of 4 and a pole at 0.9 that nothing moves."""
    model = DifferenceModel([-1.4, 0.45], [0.3, -0.27])
    form = integral_of_error_form(model)
    assert (form.controllable_rank(), form.n_x) == (3, 4)
    assert form.fixed_poles() == pytest.approx([0.9], abs=1e-9)
    rng = np.random.default_rng(0)
    for _ in range(5):
        gain = rng.standard_normal((1, 4))
        poles = np.linalg.eigvals(form.A - form.B @ gain)
        assert np.abs(poles - 0.9).min() < 1e-9


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_random_models_have_no_fixed_poles(rng, sizes):
    """Square models without a common factor are reachable."""
    p, _, _, n, m, _ = sizes
    form = integral_of_error_form(random_model(rng, p, p, 0, n, m))
    assert form.controllable_rank() == form.n_x
    assert form.fixed_poles().size == 0


def test_fewer_inputs_than_outputs_leave_an_integrator():
    """Two sums of errors, one input: one of them cannot be moved."""
    form = integral_of_error_form(random_model(np.random.default_rng(3), 2, 1))
    assert form.fixed_poles() == pytest.approx([1.0], abs=1e-8)


# --- Observers -----------------------------------------------------------------------


@pytest.mark.parametrize("sizes", SIZES[:4], ids=str)
def test_minimal_form_is_the_differenced_one_from_outside(rng, sizes):
    """The same response to changes of the input, with as few states as possible."""
    model = random_model(rng, *sizes)
    big, small = differenced_form(model), minimal_form(model)
    assert small.n_x <= big.n_x
    x, s = np.zeros(big.n_x), np.zeros(small.n_x)
    for _ in range(12):
        du = rng.standard_normal(model.n_u)
        x, s = big.A @ x + big.B @ du, small.A @ s + small.B @ du
        assert relative(small.C @ s, big.C @ x) <= 1e-9


def test_estimate_converges_after_a_load():
    """A step at the output is taken up by the integrators of the realisation."""
    model = DifferenceModel([-1.5, 0.56], [0.1, 0.08])
    for observer in ("deadbeat", "kalman"):
        c = STRUCTURES["minimal"](model, Horizon(4, 2), 1.0, 1.0, observer=observer)
        h = play(c, np.random.default_rng(1), 60, consistent=True, offset=3.0)
        predicted = c.form.C @ state(c, h)
        assert predicted == pytest.approx(h.y[-1], abs=1e-3), observer


@pytest.mark.parametrize("sizes", SIZES[:4], ids=str)
def test_near_deadbeat_poles_lie_close_to_the_origin(rng, sizes):
    """Of the estimation error, inside 0.1."""
    model = random_model(rng, *sizes)
    form = minimal_form(model)
    keep, part = form.recipe.keep, form.recipe.layout["estimate"]
    poles = np.linalg.eigvals(keep[part, part])
    assert np.abs(poles).max() <= 0.1 + 1e-6


def test_observed_form_in_current_and_prediction_form(rng):
    """Run by hand: x_hat corrected with M, advanced with A, B and L."""
    model = random_model(rng, 1, 1, 0, 2, 2)
    base = differenced_form(model)
    A, B, C = base.A, base.B, base.C
    M, L = rng.standard_normal((4, 1)), rng.standard_normal((4, 1))
    recipe = observed_form(model, A, B, C, M, L).recipe
    memory, x, last = np.zeros(recipe.layout.size), np.zeros(4), np.zeros(1)
    for _ in range(6):
        y, u = rng.standard_normal(1), rng.standard_normal(1)
        memory = recipe.carry @ memory + recipe.enter @ np.concatenate([y, [0.0]])
        assert relative(recipe.state @ memory, x + M @ (y - C @ x)) <= 10 * ALGEBRA
        memory = recipe.keep @ memory + recipe.store @ np.concatenate([u, u, [0.0]])
        x, last = A @ x + B @ (u - last) + L @ (y - C @ x), u


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("kalman", 0.0, 1.0), "process_noise = 0.0"),
        (("kalman", 1.0, -1.0), "measurement_noise = -1.0"),
        (("luenberger",), 'observer = "luenberger": expected "deadbeat" or "kalman"'),
    ],
)
def test_observers_with_a_mistake_are_refused(arguments, message):
    """Kind and variances are checked."""
    with pytest.raises(ValueError, match=message):
        minimal_form(DifferenceModel([-0.5], [1.0]), *arguments)


# --- Layout --------------------------------------------------------------------------


def test_layout_names_the_parts_of_a_vector(rng):
    """Pack, read and select are about the same entries."""
    layout = Layout(x=2, r=(3, 2), none=(0, 4))
    r = rng.random((3, 2))
    vector = layout.pack(x=[1.0, 2.0], r=r)
    assert layout.size == 8
    assert "r" in layout
    assert "y" not in layout
    assert relative(layout.read(vector, "r"), r) == 0.0
    assert relative(layout.select("r") @ vector, r.ravel()) == 0.0
    many = np.stack([vector, 2 * vector])
    assert layout.read(many, "r").shape == (2, 3, 2)
    assert layout.read(many, "none").shape == (2, 0, 4)


def test_forward_path_remembers_the_model_not_the_plant(rng):
    """Past changes come from the simulated model; the last entries are measured."""
    model = random_model(rng, 2, 1, 0, 2, 2)
    c = controller("forward_path", model)
    h = play(c, rng)
    inside = [np.zeros(2)]
    inside += roll_out(model, inside, [], [], h.u, [np.zeros(0)] * len(h.u))
    dy, du = changes(inside)[::-1], changes(h.u)[::-1]
    wanted = np.concatenate([*dy[:2], *du[:1], h.y[-1]])
    assert relative(state(c, h), wanted) <= 10 * ALGEBRA
