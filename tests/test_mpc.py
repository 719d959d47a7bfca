"""Designs: weights, limits, horizons, terminal conditions, and what they refuse."""

import numpy as np
import pytest
from conftest import ALGEBRA, DECISION, REPLAY, printed
from scipy.linalg import block_diag
from strategies import play, positive, random_model, relative

from nmss_lab.cases import shell_model, shell_weights
from nmss_lab.controller import Limits, Status
from nmss_lab.models import DifferenceModel
from nmss_lab.mpc import (
    STRUCTURES,
    disturbance_direct,
    integral_of_error,
    minimal,
    state_weight,
    wang_young,
)
from nmss_lab.predict import Horizon
from nmss_lab.qp import solve
from nmss_lab.simulate import Scenario, closed_loop

MODEL = DifferenceModel([-1.5, 0.56], [0.1, 0.08], [0.05, 0.02])
H = Horizon(8, 3)


# --- Weights -------------------------------------------------------------------------


def test_weights_may_be_given_in_many_shapes(rng):
    """A number, a channel each, a matrix, one a step, the full matrix."""
    model = random_model(rng, 2, 2)
    full = block_diag(*[np.diag([2.0, 3.0])] * 4)
    ways = [[2.0, 3.0], np.diag([2.0, 3.0]), [np.diag([2.0, 3.0])] * 4, full]
    programs = [wang_young(model, Horizon(4, 2), Q, 0.1).program for Q in ways]
    for each in programs[1:]:
        assert relative(each.H, programs[0].H) <= ALGEBRA
        assert relative(each.f, programs[0].f) <= ALGEBRA
    one = wang_young(model, Horizon(4, 2), 2.0, 0.1).program
    two = wang_young(model, Horizon(4, 2), [2.0, 2.0], 0.1 * np.eye(4)).program
    assert relative(one.H, two.H) <= ALGEBRA


def test_weights_may_differ_at_every_step():
    """One number a step for a single output (5.4)."""
    falling = wang_young(MODEL, Horizon(4, 2), [4.0, 3.0, 2.0, 1.0], [0.1, 0.2])
    full = wang_young(
        MODEL, Horizon(4, 2), np.diag([4.0, 3.0, 2.0, 1.0]), np.diag([0.1, 0.2])
    )
    assert relative(falling.program.H, full.program.H) <= ALGEBRA
    level = wang_young(MODEL, Horizon(4, 2), 4.0, [0.1, 0.2])
    assert relative(falling.program.H, level.program.H) > 0.1


def test_only_the_symmetric_part_of_a_weight_counts(rng):
    """The form x'Qx does not see the rest."""
    model = random_model(rng, 2, 2)
    Q = positive(rng, 2)
    skew = np.array([[0.0, 1.0], [-1.0, 0.0]])
    a, b = (wang_young(model, H, each, 0.1).program for each in (Q, Q + skew))
    assert relative(a.H, b.H) <= ALGEBRA


def test_state_weight_is_5_6a(rng):
    """Blocks in the order of the state of (3.2)."""
    model = random_model(rng, 2, 1, 0, 2, 3)
    w_y, w_u, w_z = positive(rng, 2), 0.3, positive(rng, 2)
    wanted = block_diag(w_y, w_y, 0.3, 0.3, w_z)
    assert relative(state_weight(model, w_y, w_u, w_z), wanted) <= ALGEBRA
    short = random_model(rng, 2, 1, 0, 1, 1)
    assert state_weight(short, 1.0, 9.0, 2.0).tolist() == np.diag([1, 1, 2, 2]).tolist()


@pytest.mark.parametrize(
    ("Q", "R", "message"),
    [
        (np.ones(3), 1.0, r"Q has shape \(3,\), expected a number"),
        (np.eye(3), 1.0, r"Q has shape \(3, 3\)"),
        (1.0, np.ones(2), r"R has shape \(2,\)"),
        (np.nan, 1.0, "Q holds entries that are not finite"),
        (1.0, np.inf, "R holds entries that are not finite"),
        (1.0, -5.0, "smallest eigenvalue"),
        (0.0, 0.0, "smallest eigenvalue"),
    ],
)
def test_weights_that_do_not_fit_are_refused(Q, R, message):
    """The message names the weight."""
    with pytest.raises(ValueError, match=message):
        wang_young(MODEL, H, Q, R)


def shell_program(w_z):
    """Build the design of 5.3.2.1 with a weight of the sums of the error."""
    model = shell_model()
    Q = state_weight(model, [0.056, 1.0, 0.629], 0.01, w_z)
    R = np.diag([0.01, 0.01, 0.1163])
    return integral_of_error(model, Horizon(10, 5), Q, R, reference="next").program


PRINTED_W_Z = [[0.036, 0.005, 0.005], [0.005, 0.005, 0.2118], [0.005, 0.2118, 0.1923]]


def test_misprinted_weight_of_the_shell_design_is_refused():
    """Section 5.3.2.1: entries (2,2) and (2,3) swapped, H has an eigenvalue of -5.1."""
    with pytest.raises(ValueError, match=r"smallest eigenvalue .* -5\.1"):
        shell_program(PRINTED_W_Z)
    corrected = [[0.036, 0.005, 0.005], [0.005, 0.2118, 0.005], [0.005, 0.005, 0.1923]]
    assert np.linalg.eigvalsh(shell_program(corrected).H)[0] > 0


def test_indefinite_blocks_are_accepted_when_the_hessian_is_positive():
    """Row a of Table 5.2 as printed has indefinite w_{u-} and w_u."""
    w_y, w_past, w_z, w_u = shell_weights("a")
    blocks = [np.atleast_2d(w) for w in (w_past, w_u)]
    assert min(np.linalg.eigvalsh(w)[0] for w in blocks) < 0
    model = shell_model()
    Q = state_weight(model, w_y, w_past, w_z)
    c = integral_of_error(model, Horizon(10, 5), Q, w_u, reference="next")
    assert np.linalg.eigvalsh(c.program.H)[0] > 0


# --- Limits --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"u": (1.0, -1.0)}, "limits on u: the low side 1.0 exceeds"),
        ({"y": ([0, 0], [1, -1])}, "limits on y: the low side"),
        ({"du": (np.nan, 1.0)}, "limits on du: nan to 1.0 are not numbers"),
        ({"du": (0.1, 1.0)}, "limits on du: 0.1 to 1.0 exclude zero"),
        ({"outputs": "firm"}, 'outputs = "firm": expected "hard"'),
        ({"soft_weight": 0.0}, "soft_weight = 0.0 must be positive"),
    ],
)
def test_limits_with_a_mistake_are_refused(fields, message):
    """The signal at fault is named."""
    with pytest.raises(ValueError, match=message):
        Limits(**fields)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (Limits(u=([-1, -1], [1, 1])), r"limits on u have shape \(2,\)"),
        (Limits(y=(-1, [1, 1, 1])), r"limits on y have shape \(3,\)"),
        (Limits(priority=(1, 2)), r"priority = \(1, 2\): expected 1 ranks"),
    ],
)
def test_limits_of_another_size_are_refused(limits, message):
    """When the design is built."""
    with pytest.raises(ValueError, match=message):
        wang_young(MODEL, H, 1.0, 1.0, limits)


def test_each_limit_may_be_infinite_on_a_side():
    """Only finite sides make rows; each channel on its own."""
    model = random_model(np.random.default_rng(1), 2, 2)
    limits = Limits(u=([-1, -np.inf], [np.inf, np.inf]), y=(-np.inf, [np.inf, 3.0]))
    c = wang_young(model, Horizon(4, 2), 1.0, 1.0, limits)
    found = {(row.name, row.channel) for row in c.program.labels}
    assert found == {("u", 0), ("y", 1)}


def test_limits_on_inputs_bind_only_where_moves_begin():
    """Nc rows of u and du, Np rows of y."""
    limits = Limits(u=(-1, 1), du=(-1, 1), y=(-1, 1))
    c = wang_young(MODEL, Horizon(8, 3), 1.0, 1.0, limits)
    assert {name: len(rows) for name, rows in c.program.rows.items()} == {
        "u": 3,
        "du": 3,
        "y": 8,
    }


@pytest.mark.parametrize("name", ["integral_of_error", "wang_young"])
def test_output_limits_are_kept(name):
    """A step that would overshoot is held at the limit."""
    model = DifferenceModel([-1.7, 0.8], [0.1])
    free = STRUCTURES[name](model, Horizon(15, 5), 1.0, 0.01)
    top = closed_loop(model.plant(), free, Scenario(np.ones(40))).y.max() - 0.05
    limits = Limits(y=(-np.inf, top))
    c = STRUCTURES[name](model, Horizon(15, 5), 1.0, 0.01, limits)
    run = closed_loop(model.plant(), c, Scenario(np.ones(40)))
    assert run.y.max() <= top + DECISION
    assert (run.status == Status.LIMITED).any()


# --- Moves in blocks -----------------------------------------------------------------


@pytest.mark.parametrize("name", ["integral_of_error", "wang_young"])
def test_blocked_moves_change_only_where_a_block_begins(name):
    """The plan stands still inside a block, and is the best of its kind."""
    limits = Limits(u=(-0.3, 0.3), du=(-0.1, 0.1))
    blocked = STRUCTURES[name](MODEL, Horizon(9, 3, (1, 3, 5)), 1.0, 0.1, limits)
    case_ = Scenario(np.ones(20), v=np.zeros(20))
    run = closed_loop(MODEL.plant(), blocked, case_)
    du = run.trail("du")[..., 0]
    inside = [1 + 1, 1 + 2, 4 + 1, 4 + 2, 4 + 3, 4 + 4]
    assert not du[:, inside].round(12).any()
    assert np.abs(du[:, [0, 1, 4]]).max() == pytest.approx(0.1, abs=DECISION)
    assert np.abs(run.u).max() <= 0.3 + 1e-12


def test_blocks_of_one_sample_are_no_blocks():
    """(1, 1, 1) is Nc = 3."""
    plain = wang_young(MODEL, Horizon(8, 3), 1.0, 0.1)
    blocked = wang_young(MODEL, Horizon(8, 3, (1, 1, 1)), 1.0, 0.1)
    assert relative(plain.free_gain, blocked.free_gain) <= ALGEBRA


def test_fewer_moves_cost_more():
    """Blocking restricts the plan, so the optimum cannot be better."""
    costs = []
    for horizon in (Horizon(9, 9), Horizon(9, 3, (1, 1, 7)), Horizon(9, 1)):
        R = np.full(horizon.Nc, 0.1)
        c = wang_young(MODEL, horizon, 1.0, R)
        h = play(c, np.random.default_rng(5))
        z = solve(c.program, h.known).decision
        costs.append(c.program.cost(z, h.known))
    assert costs[0] < costs[1] < costs[2]


# --- Terminal conditions -------------------------------------------------------------


@pytest.mark.parametrize("name", ["integral_of_error", "wang_young", "minimal"])
def test_terminal_equality_ends_at_rest(name):
    """(C.2.1): if the input stays put after the horizon, so does the output, at r."""
    Np = 8
    c = STRUCTURES[name](
        MODEL, Horizon(Np, Np), 1.0, 0.1, terminal="equality", reference="held"
    )
    memory = c.measure(c.start(), [0.0], [1.5], [0.0])
    move = c.decide(memory)
    u = c.plan(move, "u")[:, 0]
    y = c.plan(move, "y")[:, 0]
    assert y[-3:] == pytest.approx([1.5] * 3, abs=DECISION)
    # roll on with the last input held, from the last outputs of the plan
    ys, us = list(y), list(u)
    for _ in range(10):
        ys.append(1.5 * ys[-1] - 0.56 * ys[-2] + 0.1 * us[-1] + 0.08 * us[-2])
        us.append(us[-1])
    # errors of 1e-6 in the last rows grow at most tenfold in ten samples
    assert ys[Np:] == pytest.approx([1.5] * 10, abs=10 * DECISION)
    assert us[-1] == pytest.approx(u[-2], abs=DECISION)


def test_terminal_equality_makes_the_cost_fall():
    """With previewed constants the optimal cost is a Lyapunov function (C.2)."""
    limits = Limits(u=(-2.0, 2.0), du=(-0.5, 0.5))
    c = wang_young(MODEL, Horizon(12, 12), 1.0, 0.1, limits, terminal="equality")
    run = closed_loop(MODEL.plant(), c, Scenario(np.ones(30), v=np.zeros(30)))
    assert (run.status <= Status.LIMITED).all()
    assert (np.diff(run.cost) <= REPLAY).all()
    assert run.cost[-1] < 1e-6 * run.cost[0]


def test_lq_tail_makes_the_horizon_irrelevant():
    """Without limits the first move is that of the infinite horizon for any Np."""
    gains = []
    for Np in (3, 6, 20):
        c = wang_young(MODEL, Horizon(Np, Np), 1.0, 0.1, terminal="lq")
        gains.append(c.free_gain)
    assert relative(gains[0], gains[2]) <= 1e-7
    assert relative(gains[1], gains[2]) <= 1e-7
    bare = wang_young(MODEL, Horizon(3, 3), 1.0, 0.1)
    assert relative(bare.free_gain, gains[2]) > 0.01


# --- Refusals ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("wang_young", {"reference": "zero"}, '"zero" leaves nothing to follow'),
        ("wang_young", {"reference": "soon"}, 'reference = "soon": expected one of'),
        ("integral_of_error", {"reference": "soon"}, 'reference = "soon"'),
        ("wang_young", {"terminal": "soft"}, 'terminal = "soft": expected "none"'),
        ("wang_young", {"backend": "magic"}, 'backend = "magic"'),
        ("disturbance_direct", {"forecast": "rain"}, 'forecast = "rain"'),
        ("minimal", {"observer": "guess"}, 'observer = "guess": expected'),
    ],
)
def test_unknown_choices_are_refused(name, options, message):
    """The message names the choice and the possible ones."""
    with pytest.raises(ValueError, match=message):
        STRUCTURES[name](MODEL, H, 1.0, 1.0, **options)


@pytest.mark.parametrize("name", ["disturbance_direct", "disturbance_augmented"])
def test_model_without_disturbances_is_refused(name):
    """There is nothing to measure."""
    with pytest.raises(ValueError, match=r"model\.g is missing"):
        STRUCTURES[name](DifferenceModel([-0.5], [1.0]), H, 1.0, 1.0)


# --- Forecasts -----------------------------------------------------------------------


def test_forecast_by_a_function_is_the_forecast_given():
    """A function of the latest values, asked at every sample."""
    asked = []

    def drift(latest, steps):
        asked.append(latest.copy())
        return latest[0] + 0.1 * np.arange(1, steps + 1)[:, None]

    own = disturbance_direct(MODEL, H, 1.0, 0.1, forecast=drift)
    told = disturbance_direct(MODEL, H, 1.0, 0.1, forecast="given")
    held = disturbance_direct(MODEL, H, 1.0, 0.1)
    v = 0.1 * np.arange(30.0)
    moves = []
    for c, ahead in ((own, None), (told, v[5 : 5 + H.Np]), (held, None)):
        memory = c.start()
        for k in range(6):
            memory = c.measure(memory, [0.0], [1.0], v[[k]])
            if k < 5:
                memory = c.apply(memory, [0.2 * k], c.decide(memory))
        rows = None if ahead is None else ahead[:, None]
        moves.append(c.decide(memory, v=rows).u[0])
    assert moves[0] == pytest.approx(moves[1], abs=REPLAY)
    assert abs(moves[0] - moves[2]) > 1e-3
    assert asked[-1] == pytest.approx(v[[5, 4, 3], None])


@pytest.mark.parametrize(
    ("forecast", "message"),
    [
        (lambda v, n: np.zeros((n + 1, 1)), "forecast returned shape"),
        (lambda v, n: np.full((n, 1), np.nan), "not finite"),
    ],
)
def test_forecast_with_a_mistake_is_refused(forecast, message):
    """Shape and numbers are checked."""
    c = disturbance_direct(MODEL, H, 1.0, 0.1, forecast=forecast)
    memory = c.measure(c.start(), [0.0], [1.0], [0.0])
    with pytest.raises(ValueError, match=message):
        c.decide(memory)


def test_knowing_the_disturbance_helps():
    """The measured disturbance is countered before it is seen in the output."""
    v = np.repeat([0.0, 3.0], 20)
    errors = {}
    for name in ("wang_young", "disturbance_direct"):
        c = STRUCTURES[name](MODEL, H, 1.0, 0.01)
        run = closed_loop(MODEL.plant(), c, Scenario(np.zeros(40), v=v))
        errors[name] = np.abs(run.y).sum()
    assert errors["disturbance_direct"] < 0.2 * errors["wang_young"]


# --- Numbers -------------------------------------------------------------------------


def test_minimal_state_is_as_small_as_the_plant_and_its_integrators():
    """Shell fractionator: 13 states in place of 24."""
    assert minimal(shell_model(), Horizon(10, 5), 1.0, 1.0).form.n_x == 13
    assert wang_young(shell_model(), Horizon(10, 5), 1.0, 1.0).form.n_x == 24


def test_double_integrator_has_its_reference_gain():
    """Section 4.4.1 with Q = 15/5: K of an independent computation."""
    model = DifferenceModel([-2.0, 1.0], [0.5, 0.5])
    c = integral_of_error(model, Horizon(5, 3), 3.0, 1 / 3, reference="preview")
    K = -c.free_gain[0, c.knowledge.layout["x"]]
    wanted = ["2.2061721", "-1.3254176", "0.6627088", "-0.3197408"]
    for found, text in zip(K, wanted, strict=True):
        assert found == pytest.approx(float(text), abs=printed(text))
