"""Statements that two things are the same, each checked on random models."""

import dataclasses

import numpy as np
import pytest
from conftest import ALGEBRA, DECISION, REPLAY, SOLVER
from strategies import (
    SIZES,
    next_output,
    play,
    positive,
    random_model,
    relative,
)

from nmss_lab import qp
from nmss_lab.cases import LINEAR_CASES, case
from nmss_lab.controller import Limits, Status
from nmss_lab.governor import governor
from nmss_lab.models import DifferenceModel
from nmss_lab.mpc import (
    STRUCTURES,
    disturbance_augmented,
    disturbance_direct,
    forward_path,
    integral_of_error,
    minimal,
    wang_young,
)
from nmss_lab.pip import lq_gain, pip, pole_gain
from nmss_lab.predict import Horizon
from nmss_lab.predictive import PredictiveController
from nmss_lab.simulate import Scenario, closed_loop

DISTURBED = [each for each in SIZES if each[2]]
NARROW = Limits(u=(-0.6, 0.6), du=(-0.15, 0.15))


def levels(rng, N, n, size=1.0):
    """Return a signal (N, n) of random levels, about ten samples each."""
    return np.repeat(size * rng.standard_normal((-(-N // 10), n)), 10, 0)[:N]


def scenario(rng, model, N=40, **more):
    """Return a scenario with random levels of reference and disturbance."""
    v = levels(rng, N, model.n_v)
    return Scenario(levels(rng, N, model.n_y), v=v, **more)


# --- Structures that are one controller ----------------------------------------------


@pytest.mark.parametrize("limits", [None, NARROW], ids=["free", "limited"])
@pytest.mark.parametrize("forecast", ["held", "given"])
@pytest.mark.parametrize("sizes", DISTURBED, ids=str)
def test_direct_is_augmented(rng, sizes, forecast, limits):
    """Disturbances as offsets or in the state: the same moves (thesis: differ)."""
    model = random_model(rng, *sizes)
    arguments = model, Horizon(7, 3), 1.0, 0.2, limits, "held"
    direct = disturbance_direct(*arguments, forecast=forecast)
    augmented = disturbance_augmented(*arguments, forecast=forecast)
    case = scenario(rng, model, noise=0.1 * rng.standard_normal((40, model.n_y)))
    pair = [closed_loop(model.plant(), c, case) for c in (direct, augmented)]
    tolerance = DECISION if limits else 1e3 * REPLAY  # 40 samples with feedback
    assert relative(pair[0].u, pair[1].u) <= tolerance


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_equal_horizons_make_holding_and_zero_agree(rng, sizes):
    """With Nc = Np nothing is left to be held (Phi_1 = 0) or to be zero."""
    model = random_model(rng, *sizes)
    n = model.n_u
    horizon = Horizon(5, 5)
    assert horizon.held(n) == pytest.approx(np.eye(5 * n), abs=0)
    assert horizon.impulses(n) == pytest.approx(np.eye(5 * n), abs=0)


@pytest.mark.parametrize("Nc", [1, 3, 6])
@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_inputs_and_changes_parametrise_one_problem(rng, sizes, Nc):
    """Deciding U with the cost of (4.10) is deciding dU: U = C_1 u + C_2 dU."""
    model = random_model(rng, *sizes)
    Q, R = positive(rng, model.n_y), positive(rng, model.n_u)
    horizon, q = Horizon(6, Nc), model.n_u
    c = wang_young(model, horizon, Q, R, NARROW)
    known = play(c, rng).known
    known[c.knowledge.layout["u"]] *= 0.2  # within the limits
    last = np.tile(known[c.knowledge.layout["u"]], Nc)
    to_sums = np.kron(np.tri(Nc), np.eye(q))
    to_changes = np.linalg.inv(to_sums)
    # substitute dU = C_2^-1 (U - C_1 u): cost and rows in terms of U
    p = c.program
    shift = to_changes @ last
    f = p.f @ known - p.H @ shift
    changed = qp.QuadraticProgram(
        to_changes.T @ p.H @ to_changes,
        (to_changes.T @ f)[:, None],
        np.zeros((1, 1)),
        p.M @ to_changes,
        (p.offset @ known - p.M @ shift)[:, None],
        p.lower,
        p.upper,
        p.labels,
    )
    inputs, changes = qp.solve(changed, np.ones(1)), qp.solve(p, known)
    assert inputs.found
    assert changes.found
    sums = to_sums @ changes.decision + last
    assert sums == pytest.approx(inputs.decision, abs=DECISION)


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_forward_path_is_feedback_when_the_model_is_exact(rng, sizes):
    """And nothing disturbs; limits change nothing about it."""
    model = random_model(rng, *sizes, radius=0.8)
    arguments = model, Horizon(7, 3), 1.0, 0.2, NARROW
    case = Scenario(levels(rng, 40, model.n_y), v=np.zeros((40, model.n_v)))
    runs = [
        closed_loop(model.plant(), build(*arguments), case)
        for build in (wang_young, forward_path)
    ]
    assert relative(runs[0].u, runs[1].u) <= DECISION


def test_forward_path_differs_from_feedback_when_the_model_is_wrong(rng):
    """The check above can fail."""
    model = random_model(rng, 1, 1, 0, 2, 2, radius=0.8)
    case = Scenario(levels(rng, 40, 1))
    plant = model.varied(1.2).plant()
    runs = [
        closed_loop(plant, build(model, Horizon(7, 3), 1.0, 0.2), case)
        for build in (wang_young, forward_path)
    ]
    assert relative(runs[0].u, runs[1].u) > 1e-3


@pytest.mark.parametrize("observer", ["deadbeat", "kalman"])
@pytest.mark.parametrize("sizes", [s for s in SIZES if not s[2]], ids=str)
def test_minimal_is_wang_young_for_any_observer(rng, sizes, observer):
    """From a zero initial state, without noise or disturbance."""
    model = random_model(rng, *sizes, radius=0.8)
    arguments = model, Horizon(7, 3), 1.0, 0.2, NARROW
    case = Scenario(levels(rng, 40, model.n_y))
    ours = closed_loop(model.plant(), wang_young(*arguments), case)
    observed = minimal(*arguments, observer=observer)
    other = closed_loop(model.plant(), observed, case)
    assert relative(ours.u, other.u) <= DECISION
    assert observed.form.n_x <= wang_young(*arguments).form.n_x


def test_observer_matters_when_there_is_noise(rng):
    """The check above can fail."""
    model = random_model(rng, 1, 1, 0, 2, 2, radius=0.8)
    noise = 0.1 * rng.standard_normal((40, 1))
    case = Scenario(levels(rng, 40, 1), noise=noise)
    designs = [minimal(model, Horizon(7, 3), 1.0, 0.2, observer=o) for o in OBSERVERS]
    runs = [closed_loop(model.plant(), each, case) for each in designs]
    assert relative(runs[0].u, runs[1].u) > 1e-3


OBSERVERS = ("deadbeat", "kalman")


# --- Linear laws ---------------------------------------------------------------------


@pytest.mark.parametrize("name", list(STRUCTURES))
@pytest.mark.parametrize("sizes", DISTURBED[:3], ids=str)
def test_decision_without_active_limits_is_the_linear_gain(rng, sizes, name):
    """The same with wide limits and with none, and the same as the law on memory."""
    model = random_model(rng, *sizes)
    wide = Limits(u=(-1e4, 1e4), du=(-1e4, 1e4), y=(-1e5, 1e5))
    c = STRUCTURES[name](model, Horizon(6, 2), 1.0, 0.3, wide)
    for _ in range(5):
        h = play(c, rng)
        move = c.decide(h.memory)
        on_memory, on_r = c.free_law()
        ahead = np.tile(h.r[-1], 1 + c.preview)
        law = on_memory @ h.memory.vector + on_r @ ahead
        assert move.status == Status.FREE
        assert move.u == pytest.approx(c.free_gain @ move.known, rel=REPLAY)
        assert move.u == pytest.approx(law, rel=REPLAY)
        # and the solver, asked, would say the same
        asked = qp.solve(c.program, move.known)
        assert asked.decision == pytest.approx(move.decision, abs=DECISION)


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_wang_young_law_is_its_polynomial_form(rng, sizes):
    """(6.4): L(z) du = K_{n+m} (r - y) - P(z) (1 - z^-1) y, with L = I + ..."""
    model = random_model(rng, *sizes)
    p, q, n, m = model.n_y, model.n_u, model.na, model.nb
    c = wang_young(model, Horizon(7, 3), 1.0, 0.3)
    h = play(c, rng)
    K = -c.free_gain[:, c.knowledge.layout["x"]]
    P = [K[:, i * p : (i + 1) * p] for i in range(n)]
    L = [K[:, n * p + j * q : n * p + (j + 1) * q] for j in range(m - 1)]
    K_I = K[:, -p:]
    du = K_I @ (h.r[-1] - h.y[-1])
    for i in range(n):
        du = du - P[i] @ (h.y[-1 - i] - h.y[-2 - i])
    for j in range(m - 1):
        du = du - L[j] @ (h.u[-1 - j] - h.u[-2 - j])
    assert c.decide(h.memory).u == pytest.approx(h.u[-1] + du, rel=1e-9)


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_gain_on_the_reference_is_the_gain_on_the_output(rng, sizes):
    """w_s = K_{n+m} of section 6.2.1, for one output or several."""
    model = random_model(rng, *sizes)
    c = wang_young(model, Horizon(7, 3), 1.0, 0.3, reference="held")
    layout = c.knowledge.layout
    on_y = c.free_gain[:, layout["x"]][:, -model.n_y :]
    assert relative(c.free_gain[:, layout["r"]], -on_y) <= 1e3 * ALGEBRA


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_first_gain_on_the_reference_is_the_integral_gain(rng, sizes):
    """R_1 = K_z of (4.17): D r_{k+1} enters like z_k."""
    model = random_model(rng, *sizes)
    c = integral_of_error(model, Horizon(7, 3), 1.0, 0.3, reference="preview")
    p, layout = model.n_y, c.knowledge.layout
    K_z = c.free_gain[:, layout["x"]][:, -p:]
    R_1 = c.free_gain[:, layout["r"]][:, :p]
    assert relative(R_1, K_z) <= 1e3 * ALGEBRA


@pytest.mark.parametrize("sizes", [(1, 1, 0, 2, 2, 0), (2, 2, 0, 2, 1, 0)], ids=str)
@pytest.mark.parametrize("Np", [1, 2, 7])
def test_lq_tail_gives_the_pip_lq_gain(rng, sizes, Np):
    """S = 0, Nc = Np and the infinite-horizon cost behind: u = -K x of PIP-LQ."""
    model = random_model(rng, *sizes)
    form = integral_of_error(model, Horizon(1, 1), 1.0, 1.0).form
    Q, R = positive(rng, form.n_x), positive(rng, model.n_u)
    c = integral_of_error(model, Horizon(Np, Np), Q, R, reference="zero", terminal="lq")
    K = lq_gain(model, Q, R)
    # the Riccati solver is asked for about nine digits
    assert relative(-c.free_gain[:, c.knowledge.layout["x"]], K) <= 1e-8


def test_long_horizon_tends_to_the_lq_gain(rng):
    """Without a tail the gain converges to PIP-LQ as the horizon grows."""
    model = random_model(rng, 1, 1, 0, 2, 2, radius=0.8)
    K = lq_gain(model, 1.0, 0.5)
    missed = []
    for Np in (3, 8, 40):
        c = integral_of_error(model, Horizon(Np, Np), 1.0, 0.5, reference="zero")
        gain = -c.free_gain[:, c.knowledge.layout["x"]]
        missed.append(relative(gain, K))
    assert missed[0] > missed[1] > missed[2]
    assert missed[2] < 1e-6


# --- The governor --------------------------------------------------------------------

MARGINAL = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
K_MARGINAL = pole_gain(MARGINAL, [0.0, 0.0, 0.2, 0.2])


def test_governor_without_active_limits_leaves_the_reference_alone(rng):
    """No perturbation, w = r, and the loop is that of the positional PIP law."""
    limits = Limits(u=(-50.0, 50.0), du=(-20.0, 20.0))
    case = Scenario(levels(rng, 60, 1))
    governed = governor(MARGINAL, K_MARGINAL, 10, limits)
    run = closed_loop(MARGINAL.plant(), governed, case)
    plain = pip(MARGINAL, K_MARGINAL, law="positional")
    other = closed_loop(MARGINAL.plant(), plain, case)
    assert not run.trail("beta").any()
    assert run.w == pytest.approx(run.r, abs=0)
    assert run.u == pytest.approx(other.u, abs=REPLAY)


@pytest.mark.parametrize("Np", [3, 6, 10])
def test_causal_governor_is_the_printed_one_with_one_step_more(Np):
    """Without preview, timing w_k at k: horizon Np is the printed Np + 1."""
    r = np.repeat([0.0, 3.0, -2.0], [5, 25, 30])
    limits = Limits(u=(-2.0, 2.0), du=(-0.5, 0.5))
    causal = governor(MARGINAL, K_MARGINAL, Np, limits)
    a = closed_loop(MARGINAL.plant(), causal, Scenario(r))
    printed = governor(MARGINAL, K_MARGINAL, Np + 1, limits, "preview")
    # the printed one sees r a sample ahead: hold what it is told at r_k
    plant, memory = MARGINAL.plant(), printed.start()
    state, u = plant.reset(np.zeros(1), np.zeros(0), np.zeros(1)), []
    for k in range(len(r)):
        y = plant.output(state)
        memory = printed.measure(memory, y, r[[k]])
        # known at k: r_{k+1} is the reference that enters next
        coming = r[min(k + 1, len(r) - 1)]
        move = printed.decide(memory, np.full((Np + 2, 1), coming))
        u.append(move.u)
        memory = printed.apply(memory, move.u, move)
        state = plant.step(state, move.u, np.zeros(0))
    # both decide w_k from r_k: one at k, the other a sample before, told of it
    assert np.abs(np.array(u) - a.u).max() <= DECISION
    assert (a.status == Status.LIMITED).any()


# --- Programs ------------------------------------------------------------------------


def random_program(seed):
    """Return a constrained program, its theta and its condition."""
    rng = np.random.default_rng(seed)
    p, q = rng.integers(1, 4, 2)
    model = random_model(rng, p, q, 0, 2, 2, radius=rng.uniform(0.3, 1.0))
    limits = Limits(
        u=(-rng.uniform(0.2, 2.0, q), rng.uniform(0.2, 2.0, q)),
        du=(-rng.uniform(0.05, 0.5, q), rng.uniform(0.05, 0.5, q)),
        y=(-rng.uniform(5.0, 20.0, p), rng.uniform(5.0, 20.0, p)),
    )
    build = [integral_of_error, wang_young][seed % 2]
    Np = int(rng.integers(2, 9))
    horizon = Horizon(Np, int(rng.integers(1, Np + 1)))
    c = build(model, horizon, 1.0, 0.1, limits)
    h = play(c, rng, steps=6)
    theta = h.known.copy()
    theta[c.knowledge.layout["u"]] = np.clip(h.u[-1], -0.2, 0.2)
    return c, theta


@pytest.mark.parametrize("backend", ["proxqp", "qpsolvers/daqp", "qpsolvers/quadprog"])
def test_solvers_agree_on_the_applied_move(backend):
    """To 1e-6 on two hundred random constrained programs."""
    constrained = 0
    for seed in range(200):
        c, theta = random_program(seed)
        ours = qp.solve(c.program, theta, "daqp")
        other = qp.solve(c.program, theta, backend)
        assert ours.found == other.found, f"seed {seed}: {ours} against {other}"
        if not ours.found:
            continue
        constrained += ours.active.any()
        moves = [c.first_move.value(s.decision, theta) for s in (ours, other)]
        assert moves[0] == pytest.approx(moves[1], abs=DECISION), f"seed {seed}"
    assert constrained > 100


def limited_run(example, design):
    """Run a case's design; with tighter limits where its own are never active."""
    run = closed_loop(example.plant, design.build(), example.scenario)
    if not (run.status == Status.LIMITED).any():
        peak = 0.6 * np.abs(run.u).max(axis=0)
        design = dataclasses.replace(design, limits=Limits(u=(-peak, peak)))
        run = closed_loop(example.plant, design.build(), example.scenario)
    return run


@pytest.mark.parametrize("name", sorted(LINEAR_CASES))
def test_solvers_agree_on_the_worked_examples(name):
    """On the applied move to 1e-6, wherever a limit is active in the case's run."""
    example, compared = case(name), 0
    for title, design in example.designs.items():
        if not isinstance(design.build(), PredictiveController):
            continue
        run = limited_run(example, design)
        c = run.controller
        for k in np.flatnonzero(run.status == Status.LIMITED)[:12]:
            theta, applied = run.moves.known[k], run.u[k]
            for backend in ("daqp", "proxqp", "qpsolvers/quadprog"):
                s = qp.solve(c.program, theta, backend)
                u = c.first_move.value(s.decision, theta)
                message = f"{name}, {title}, k = {k}, {backend}: {u} against {applied}"
                assert s.found, message
                assert np.abs(u - applied).max() <= DECISION, message
                compared += 1
    assert compared > 0


def test_warm_started_solver_neither_fails_nor_drifts():
    """ProxQP from the last plan: once it called a sound program infeasible (106)."""
    for seed in range(95, 110):
        rng = np.random.default_rng(seed)
        p, q = rng.integers(1, 3, 2)
        model = random_model(rng, p, q, 0, 2, 2, 0, radius=rng.uniform(0.3, 1.0))
        limits = Limits(u=(-1, 1), du=(-0.2, 0.2))
        c = wang_young(model, Horizon(8, 4), 1.0, 0.1, limits, backend="proxqp")
        r = np.repeat(rng.uniform(-3, 3, (2, p)), 6, 0)
        run = closed_loop(model.plant(), c, Scenario(r))
        assert (run.status <= Status.LIMITED).all(), f"seed {seed}"
        for k in np.flatnonzero(run.status == Status.LIMITED):
            cold = qp.solve(c.program, run.moves.known[k], "daqp")
            u = c.first_move.value(cold.decision, run.moves.known[k])
            assert u == pytest.approx(run.u[k], abs=DECISION), f"seed {seed}, k = {k}"


def test_every_accepted_solution_meets_the_optimality_conditions():
    """Promise 4, computed here again from (2.5)."""
    for seed in range(200):
        c, theta = random_program(seed)
        s = qp.solve(c.program, theta)
        if not s.found:
            continue
        p, z, m = c.program, s.decision, s.multipliers
        gradient = p.H @ z + p.f @ theta + p.M.T @ m
        size = 1.0 + np.abs(p.H @ z).max() + np.abs(p.f @ theta).max()
        assert np.abs(gradient).max() <= SOLVER * size, f"seed {seed}"
        value = p.M @ z + p.offset @ theta
        span = 1.0 + np.abs(p.offset @ theta).max() + np.abs(value).max()
        assert (value <= p.upper + SOLVER * span).all(), f"seed {seed}"
        assert (value >= p.lower - SOLVER * span).all(), f"seed {seed}"
        pushed = np.where(m > 0, p.upper - value, np.where(m < 0, value - p.lower, 0.0))
        work = 1.0 + np.abs(z @ p.H @ z) + np.abs(p.f @ theta @ z)
        assert np.abs(pushed * m).max(initial=0.0) <= SOLVER * work, f"seed {seed}"


def test_tightening_a_limit_never_lowers_the_cost():
    """Less room, no better optimum."""
    tightened = 0
    for seed in range(60):
        c, theta = random_program(seed)
        p = c.program
        costs = []
        for share in (1.3, 1.0, 0.8):
            part = dataclasses.replace(p, lower=share * p.lower, upper=share * p.upper)
            s = qp.solve(part, theta)
            costs.append(p.cost(s.decision, theta) if s.found else np.inf)
        room = SOLVER * (1.0 + abs(costs[0]))
        assert costs[0] <= costs[1] + room, f"seed {seed}"
        assert costs[1] <= costs[2] + room, f"seed {seed}"
        tightened += costs[2] > costs[0] + 1e-3
    assert tightened > 20


@pytest.mark.parametrize("name", list(STRUCTURES))
def test_scaling_an_output_and_its_weight_changes_no_input(rng, name):
    """Units of an output are a matter of taste."""
    model = random_model(rng, 2, 2, 1, 2, 2, 1)
    s = np.array([10.0, 0.2])
    S, inverse = np.diag(s), np.diag(1 / s)
    scaled = DifferenceModel(S @ model.a @ inverse, S @ model.b, S @ model.g)
    case = scenario(rng, model)
    if name == "minimal":  # an observer's transient depends on the units it is in
        case = dataclasses.replace(case, v=np.zeros((40, 1)))
    runs = []
    for m, scale in ((model, np.ones(2)), (scaled, s)):
        Q = 1.0 / scale**2
        if name == "integral_of_error":
            Q = np.concatenate([Q, Q, np.ones(2), Q])
        limits = Limits(u=(-0.6, 0.6), du=(-0.2, 0.2), y=(-40 * scale, 40 * scale))
        c = STRUCTURES[name](m, Horizon(6, 3), Q, 0.2, limits)
        each = dataclasses.replace(case, reference=case.reference * scale)
        runs.append(closed_loop(m.plant(), c, each))
    assert runs[0].u == pytest.approx(runs[1].u, abs=DECISION)
    assert runs[0].y * s == pytest.approx(runs[1].y, abs=10 * DECISION)


@pytest.mark.parametrize("name", list(STRUCTURES))
def test_permuting_the_outputs_permutes_everything(rng, name):
    """The order of the channels does not matter."""
    model = random_model(rng, 3, 2, 1, 2, 2, 1)
    order = np.array([2, 0, 1])
    P = np.eye(3)[order]
    permuted = DifferenceModel(P @ model.a @ P.T, P @ model.b, P @ model.g)
    case = scenario(rng, model)
    if name == "minimal":  # an observer's transient depends on the order it is in
        case = dataclasses.replace(case, v=np.zeros((40, 1)))
    weights = np.array([1.0, 0.5, 2.0])
    runs = []
    for m, at in ((model, np.arange(3)), (permuted, order)):
        Q = weights[at]
        if name == "integral_of_error":
            Q = np.concatenate([Q, Q, np.ones(2), Q])
        c = STRUCTURES[name](m, Horizon(6, 3), Q, 0.2, NARROW)
        each = dataclasses.replace(case, reference=case.reference[:, at])
        runs.append(closed_loop(m.plant(), c, each))
    assert runs[0].u == pytest.approx(runs[1].u, abs=DECISION)
    assert runs[0].y[:, order] == pytest.approx(runs[1].y, abs=10 * DECISION)


# --- Steady state --------------------------------------------------------------------


@pytest.mark.parametrize("name", list(STRUCTURES))
def test_no_offset_when_the_target_can_be_reached(rng, name):
    """Remark 4.3.1: limits, loads at input and output, a wrong model."""
    model = DifferenceModel([-1.1, 0.3], [0.2, 0.1], [0.1])
    limits = Limits(u=(-2.0, 2.0), du=(-0.3, 0.3), y=(-3.0, 3.0))
    c = STRUCTURES[name](model, Horizon(12, 4), 1.0, 0.5, limits)
    ones = np.ones((200, 1))
    case = Scenario(
        1.5 * ones, v=ones, input_disturbance=0.1 * ones, output_disturbance=0.2 * ones
    )
    run = closed_loop(model.varied(1.15).plant(), c, case)
    assert run.y[-1] == pytest.approx([1.5], abs=DECISION)
    assert (run.status == Status.LIMITED).any()


def test_random_outputs_match_the_equation_one_step_on(rng):
    """The helper that all of this rests on is the canonical plant."""
    for sizes in SIZES:
        model = random_model(rng, *sizes)
        u, v = rng.random((8, model.n_u)), rng.random((8, model.n_v))
        y = model.simulate(u, v)
        for k in range(1, 8):
            wanted = next_output(model, list(y[:k]), list(u[:k]), list(v[:k]))
            assert relative(y[k], wanted) <= 10 * ALGEBRA
