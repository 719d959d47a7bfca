"""Predictions of every structure against a step-by-step simulation with plain loops."""

from itertools import pairwise

import numpy as np
import pytest
import scipy.linalg
from conftest import ALGEBRA
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import (
    SIZES,
    changes,
    horizons,
    models,
    play,
    positive,
    random_model,
    relative,
    roll_out,
    roll_out_changes,
)

from nmss_lab import predict as prediction
from nmss_lab.controller import Limits
from nmss_lab.governor import governor
from nmss_lab.mpc import (
    disturbance_augmented,
    disturbance_direct,
    forward_path,
    integral_of_error,
    wang_young,
)
from nmss_lab.nmss import Layout, integral_of_error_form
from nmss_lab.pip import lq_gain
from nmss_lab.predict import (
    Affine,
    Horizon,
    at_each_step,
    by_step,
    decided,
    known_part,
    predict,
    stack,
)

ROLLED = 100 * ALGEBRA
"""Unstable models over the horizon amplify rounding by up to about a hundred."""

FEW = settings(max_examples=40, deadline=None, derandomize=True)


def blocks(vector, size):
    """Rows of ``size`` of a stacked vector."""
    return list(vector.reshape(-1, size))


def planned_u(model, horizon, z, last, moves):
    """Return the inputs over the horizon that a decision stands for."""
    free, u = blocks(z, model.n_u), []
    for i in range(horizon.Np):
        if moves == "u":
            u.append(free[min(i, horizon.Nc - 1)])
        else:
            last = last + free[i] if i < horizon.Nc else last
            u.append(last)
    return u


def check_inputs(c, z, known, u, last):
    """Compare the signals u and du with what the decision says."""
    du = [u[0] - last, *(b - a for a, b in pairwise(u))]
    assert relative(c.signals["u"].value(z, known), np.concatenate(u)) <= ALGEBRA
    assert relative(c.signals["du"].value(z, known), np.concatenate(du)) <= ALGEBRA


def quadratic(rows, weights):
    """Sum of x_i' W_i x_i."""
    return sum(x @ W @ x for x, W in zip(rows, weights, strict=True))


def future_reference(reading, rng, Np, p):
    """Values beyond k, and the S that each reading makes of them and r_k."""
    future = rng.standard_normal((Np, p))
    if reading == "preview":
        return future, lambda r: list(future)
    if reading == "next":
        return future[:1], lambda r: [future[0]] * Np
    if reading == "zero":
        return None, lambda r: [np.zeros(p)] * Np
    return None, lambda r: [r] * Np


READINGS = ["held", "next", "preview"]


@FEW
@given(
    model=models(),
    sizes=horizons(),
    reading=st.sampled_from([*READINGS, "zero"]),
    seed=st.integers(0, 999),
)
def test_integral_of_error(model, sizes, reading, seed):
    """Inputs, outputs and the cost over the whole state, weights changing by step."""
    rng, horizon = np.random.default_rng(seed), Horizon(*sizes)
    n_x = integral_of_error_form(model).n_x
    Q = [positive(rng, n_x) for _ in range(horizon.Np)]
    R = [positive(rng, model.n_u) for _ in range(horizon.Nc)]
    c = integral_of_error(model, horizon, np.array(Q), np.array(R), None, reading)
    future, make_S = future_reference(reading, rng, horizon.Np, model.n_y)
    h = play(c, rng, r_ahead=future)
    z = rng.standard_normal(c.n_z)
    u = planned_u(model, horizon, z, h.u[-1], "u")
    check_inputs(c, z, h.known, u, h.u[-1])
    # this structure does not look at measured disturbances
    still = [np.zeros(model.n_v)] * horizon.Np
    y = roll_out(model, h.y, h.u, [], u, still)
    assert relative(c.signals["y"].value(z, h.known), np.concatenate(y)) <= ROLLED
    error = sum(r - y_k for r, y_k in zip(h.r, h.y, strict=True))
    states, ys, us = [], list(h.y), list(h.u)
    for y_i, u_i, r_i in zip(y, u, make_S(h.r[-1]), strict=True):
        ys.append(y_i)
        us.append(u_i)
        error = error + r_i - y_i
        newest_y = [ys[-1 - i] for i in range(model.na)]
        newest_u = [us[-1 - i] for i in range(model.nb - 1)]
        states.append(np.concatenate([*newest_y, *newest_u, error]))
    J = quadratic(states, Q) + quadratic(blocks(z, model.n_u), R)
    assert c.program.cost(z, h.known) == pytest.approx(J, rel=ROLLED)


INCREMENTAL = {
    "wang_young": wang_young,
    "forward_path": forward_path,
    "disturbance_direct": disturbance_direct,
    "disturbance_augmented": disturbance_augmented,
}


def check_incremental(c, h, z, y, S, Q, R):
    """Compare outputs, inputs and the cost of a structure that decides changes."""
    model, horizon = c.model, c.horizon
    u = planned_u(model, horizon, z, h.u[-1], "du")
    check_inputs(c, z, h.known, u, h.u[-1])
    assert relative(c.signals["y"].value(z, h.known), np.concatenate(y)) <= ROLLED
    errors = [y_i - r_i for y_i, r_i in zip(y, S, strict=True)]
    J = quadratic(errors, Q) + quadratic(blocks(z, model.n_u), R)
    assert c.program.cost(z, h.known) == pytest.approx(J, rel=ROLLED)


@FEW
@given(
    name=st.sampled_from(["wang_young", "disturbance_direct", "disturbance_augmented"]),
    model=models(disturbed=True),
    sizes=horizons(),
    reading=st.sampled_from(READINGS),
    forecast=st.sampled_from(["held", "given"]),
    seed=st.integers(0, 999),
)
def test_structures_that_decide_changes(name, model, sizes, reading, forecast, seed):
    """Disturbances ignored, held or forecast; any reading of the reference."""
    rng, horizon = np.random.default_rng(seed), Horizon(*sizes)
    Q = [positive(rng, model.n_y) for _ in range(horizon.Np)]
    R = [positive(rng, model.n_u) for _ in range(horizon.Nc)]
    aware = name != "wang_young"
    more = {"forecast": forecast} if aware else {}
    c = INCREMENTAL[name](
        model, horizon, np.array(Q), np.array(R), None, reading, **more
    )
    future, make_S = future_reference(reading, rng, horizon.Np, model.n_y)
    given_v = aware and forecast == "given"
    v_next = rng.standard_normal((horizon.Np - 1, model.n_v)) if given_v else None
    h = play(c, rng, r_ahead=future, v_ahead=v_next)
    z = rng.standard_normal(c.n_z)
    u = planned_u(model, horizon, z, h.u[-1], "du")
    v_ahead = [h.v[-1], *(v_next if given_v else [h.v[-1]] * (horizon.Np - 1))]
    v_past = h.v[:-1]
    if not aware:
        v_past, v_ahead = [], [np.zeros(model.n_v)] * horizon.Np
    y = roll_out_changes(model, h.y, h.u, v_past, u, v_ahead)
    check_incremental(c, h, z, y, make_S(h.r[-1]), Q, R)


@FEW
@given(
    model=models(),
    sizes=horizons(),
    reading=st.sampled_from(READINGS),
    seed=st.integers(0, 999),
)
def test_forward_path(model, sizes, reading, seed):
    """The internal model's changes on top of the measured output."""
    rng, horizon = np.random.default_rng(seed), Horizon(*sizes)
    Q = [positive(rng, model.n_y) for _ in range(horizon.Np)]
    R = [positive(rng, model.n_u) for _ in range(horizon.Nc)]
    c = forward_path(model, horizon, np.array(Q), np.array(R), None, reading)
    future, make_S = future_reference(reading, rng, horizon.Np, model.n_y)
    h = play(c, rng, r_ahead=future)
    z = rng.standard_normal(c.n_z)
    u = planned_u(model, horizon, z, h.u[-1], "du")
    inside = [np.zeros(model.n_y)]  # the model's own outputs, up to k
    unseen = [np.zeros(model.n_v)] * len(h.u)  # it does not look at disturbances
    inside += roll_out(model, inside, [], [], h.u, unseen)
    change, d_u = changes(inside), changes(h.u)
    level, y = h.y[-1], []
    for i in range(horizon.Np):
        d_u = changes([*h.u, *u[: i + 1]])
        step = roll_out(model, change, d_u[:-1], [], d_u[-1:], [np.zeros(model.n_v)])
        change = [*change, *step]
        level = level + step[0]
        y.append(level)
    check_incremental(c, h, z, y, make_S(h.r[-1]), Q, R)


@FEW
@given(
    model=models(square=True),
    Np=st.integers(1, 7),
    reading=st.sampled_from(["held", "preview"]),
    options=st.sampled_from([{}, {"decay": 0.7}, {"free_until": 1}]),
    seed=st.integers(0, 999),
)
def test_governor(model, Np, reading, options, seed):
    """Inputs and outputs of u = -K x when the reference is perturbed."""
    rng, p = np.random.default_rng(seed), model.n_y
    form = integral_of_error_form(model)
    if form.controllable_rank() < form.n_x:
        return
    K = lq_gain(model, 1.0, 0.5)
    c = governor(model, K, Np, Limits(u=(-1e6, 1e6)), reading, **options)
    future = rng.standard_normal((Np, p)) if reading == "preview" else None
    h = play(c, rng, r_ahead=future, own=True)
    z = rng.standard_normal(c.n_z)
    beta = [b * options.get("decay", 1.0) ** i for i, b in enumerate(blocks(z, p))]
    beta += [np.zeros(p)] * (Np - len(beta))
    r = [h.r[-1]] * Np if future is None else list(future)
    w = [a + b for a, b in zip(r, beta, strict=True)]
    assert (
        relative(c.signals["beta"].value(z, h.known), np.concatenate(beta)) <= ALGEBRA
    )
    assert relative(c.signals["w"].value(z, h.known), np.concatenate(w)) <= ALGEBRA
    # w_0 .. w_{k-1} are in the sum; causal: w_k is decided now, else it was before
    error = sum(h.w) - sum(h.y)
    coming = w if reading == "held" else [np.zeros(p), *w]
    ys, us = list(h.y), list(h.u)
    for i in range(Np):
        error = error + coming[i]
        newest_y = [ys[-1 - j] for j in range(model.na)]
        newest_u = [us[-1 - j] for j in range(model.nb - 1)]
        us.append(-K @ np.concatenate([*newest_y, *newest_u, error]))
        ys.append(roll_out(model, ys, us[:-1], [], us[-1:], [np.zeros(model.n_v)])[0])
        error = error - ys[-1]
    u, y = us[len(h.u) :], ys[len(h.y) :]
    # the loop's own gain amplifies rounding; compare with the largest signal
    size = 1.0 + np.abs(np.concatenate([*us, *ys])).max()
    found_u = c.signals["u"].value(z, h.known)
    found_y = c.signals["y"].value(z, h.known)
    du = [b - a for a, b in zip([h.u[-1], *u[:-1]], u, strict=True)]
    found_du = c.signals["du"].value(z, h.known)
    assert np.abs(found_u - np.concatenate(u)).max() <= ROLLED * size
    assert np.abs(found_du - np.concatenate(du)).max() <= ROLLED * size
    assert np.abs(found_y - np.concatenate(y)).max() <= ROLLED * size


@given(
    n_x=st.integers(1, 4),
    n_in=st.integers(1, 3),
    Np=st.integers(1, 6),
    seed=st.integers(0, 999),
)
@FEW
def test_matrices_that_differ_at_every_step(n_x, n_in, Np, seed):
    """(8.5): index errors hide behind constant matrices."""
    rng = np.random.default_rng(seed)
    A = list(rng.standard_normal((Np, n_x, n_x)))
    B = list(rng.standard_normal((Np, n_x, n_in)))
    A[0][:] = 0.0  # a singular A must be no obstacle
    known = Layout(x=n_x, e=(Np, n_x))
    n_z = Np * n_in
    state = known_part(known, "x", n_z)
    inputs = [decided(row, known) for row in np.eye(n_z).reshape(Np, n_in, n_z)]
    whole = known_part(known, "e", n_z)
    offsets = [whole[slice(i * n_x, (i + 1) * n_x)] for i in range(Np)]
    X = predict(A, B, state, inputs, offsets)
    z, theta = rng.standard_normal(n_z), rng.standard_normal(known.size)
    x, rolled = theta[known["x"]], []
    for i in range(Np):
        e = theta[known["e"]].reshape(Np, n_x)[i]
        x = A[i] @ x + B[i] @ z.reshape(Np, n_in)[i] + e
        rolled.append(x)
    assert relative(X.value(z, theta), np.concatenate(rolled)) <= ROLLED


def test_sequences_of_different_length_are_refused(rng):
    """The message counts the steps of each."""
    known = Layout(x=1)
    x = known_part(known, "x", 1)
    A = [np.eye(1)] * 2
    with pytest.raises(ValueError, match="2, 2, 1 and 2 steps"):
        predict(A, A, x, [x], [x, x])


def test_a_signal_is_affine_and_adds_up(rng):
    """Sum, difference, product, rows and stack act on the values."""
    a, b = (Affine(rng.random((3, 2)), rng.random((3, 4))) for _ in range(2))
    z, theta, M = rng.random(2), rng.random(4), rng.random((5, 3))
    value = a.value(z, theta)
    assert relative((a + b).value(z, theta), value + b.value(z, theta)) <= ALGEBRA
    assert relative((a - b).value(z, theta), value - b.value(z, theta)) <= ALGEBRA
    assert relative((M @ a).value(z, theta), M @ value) <= ALGEBRA
    assert relative(a[[2, 0]].value(z, theta), value[[2, 0]]) <= ALGEBRA
    assert len(stack([a, b])) == 6
    both = np.concatenate([value, b.value(z, theta)])
    assert relative(stack([a, b]).value(z, theta), both) <= ALGEBRA
    many_z, many_theta = rng.random((7, 2)), rng.random((7, 4))
    rows = [a.value(*pair) for pair in zip(many_z, many_theta, strict=True)]
    assert relative(a.value(many_z, many_theta), np.array(rows)) <= ALGEBRA


# --- Horizons ----------------------------------------------------------------------


def test_moves_in_blocks_are_held_as_long_as_asked():
    """Held values, impulses and rows of the moves."""
    horizon = Horizon(7, 3, blocks=(1, 2, 3))
    held = horizon.held(1) @ np.array([10.0, 20.0, 30.0])
    assert held.tolist() == [10, 20, 20, 30, 30, 30, 30]
    moved = horizon.impulses(1) @ np.array([1.0, 2.0, 3.0])
    assert moved.tolist() == [1, 2, 0, 3, 0, 0, 0]
    assert horizon.rows_of_moves(2).tolist() == [0, 1, 2, 3, 6, 7]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((3, 4), "Np = 3, Nc = 4: expected 1 <= Nc <= Np"),
        ((3, 0), "Nc = 0"),
        ((5, 2, (1,)), "Nc = 2 lengths"),
        ((5, 2, (3, 3)), "do not exceed Np = 5"),
        ((5, 2, (0, 3)), "at least one"),
    ],
)
def test_impossible_horizons_are_refused(arguments, message):
    """The message names the numbers."""
    with pytest.raises(ValueError, match=message):
        Horizon(*arguments)


def test_sums_undo_differences(rng):
    """C_2 of section 7.3 is the inverse of C_2 of (3.10)."""
    signal = Affine(rng.standard_normal((12, 5)), rng.standard_normal((12, 2)))
    again = prediction.sums(prediction.changes(signal, 3), 3)
    assert relative(again.table, signal.table) <= ALGEBRA
    each = prediction.changes(signal, 3).gain
    assert np.array_equal(each[:3], signal.gain[:3])
    assert np.array_equal(each[6:9], signal.gain[6:9] - signal.gain[3:6])


def test_each_step_is_multiplied_by_itself(rng):
    """As by a block-diagonal matrix, with one block for all steps or one for each."""
    signal = Affine(rng.standard_normal((12, 5)), rng.standard_normal((12, 2)))
    C = rng.standard_normal((2, 3))
    wanted = np.kron(np.eye(4), C) @ signal
    assert relative(at_each_step(C, signal).table, wanted.table) <= ALGEBRA
    each = rng.standard_normal((4, 2, 3))
    wanted = scipy.linalg.block_diag(*each) @ signal.gain
    assert relative(by_step(each, signal.gain), wanted) <= ALGEBRA


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_next_state_predicts_the_next_state(rng, sizes):
    """State from history, one step of the form, equals the state a sample later."""
    model = random_model(rng, *sizes)
    c = integral_of_error(model, Horizon(1, 1), 1.0, 1.0)
    layout = c.knowledge.layout
    h = play(c, rng, consistent=True, steps=6)
    x, u, r = h.known[layout["x"]], rng.random(model.n_u), rng.random(model.n_y)
    quiet = [np.zeros(model.n_v)]
    y = roll_out(model, h.y, h.u, [], [u], quiet)[0]
    after = c.form.A @ x + c.form.B @ u + c.form.D @ r
    assert relative(c.form.C @ after, y) <= ALGEBRA


@pytest.mark.parametrize("sizes", [(2.5, 1), ("3", 1), (3, None), (True, True)])
def test_horizons_are_whole_numbers(sizes):
    """The argument is named, not a step of the construction."""
    with pytest.raises(ValueError, match=r"N[pc] = .*: expected a whole number"):
        Horizon(*sizes)
