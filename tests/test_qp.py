"""The quadratic program: assembly, solving, judging, relaxing."""

import itertools

import numpy as np
import pytest
from conftest import ALGEBRA, DECISION, SOLVER
from scipy.optimize import minimize
from strategies import positive, relative

from nmss_lab import qp
from nmss_lab.predict import Affine
from nmss_lab.qp import (
    Cost,
    Limit,
    Problem,
    QPStatus,
    QuadraticProgram,
    Row,
    assemble,
    kkt_residual,
    solve,
)

BACKENDS = ["daqp", "proxqp", "qpsolvers/quadprog", "qpsolvers/daqp"]


def affine(rng, rows, n_z=4, n_theta=3):
    """Return a random signal."""
    return Affine(
        rng.standard_normal((rows, n_z)), rng.standard_normal((rows, n_theta))
    )


def limit(rng, name, signal, width=1.0):
    """Return limits of one channel a step around zero."""
    n = len(signal)
    low, high = -width * rng.random(n) - 0.1, width * rng.random(n) + 0.1
    return Limit(name, signal, low, high, 1, np.arange(n))


@pytest.fixture
def program(rng):
    """Return a program of four variables and eight rows, and its theta."""
    costs = [Cost(affine(rng, 6), positive(rng, 6))]
    signals = [affine(rng, 5), affine(rng, 3)]
    # rows hardly moved by theta: z = 0 keeps them, the free optimum does not
    signals = [Affine(s.gain, 0.02 * s.known) for s in signals]
    rows = [limit(rng, n, s) for n, s in zip("uy", signals, strict=True)]
    return assemble(costs, rows), rng.standard_normal(3)


def test_cost_of_the_program_is_the_sum_of_the_costs(rng):
    """J with its constant, for any decision and known vector, one or many."""
    costs = [Cost(affine(rng, n), positive(rng, n)) for n in (3, 5, 2)]
    program = assemble(costs, [])
    z, theta = rng.standard_normal((7, 4)), rng.standard_normal((7, 3))
    wanted = []
    for pair in zip(z, theta, strict=True):
        values = [(c.signal.value(*pair), c.weight) for c in costs]
        wanted.append(sum(s @ W @ s for s, W in values))
    assert relative(program.cost(z, theta), np.array(wanted)) <= 10 * ALGEBRA
    assert relative(program.cost(z[0], theta[0]), np.array(wanted[0])) <= 10 * ALGEBRA


def test_free_optimum_has_no_gradient(rng):
    """And is a minimum: every step away costs more."""
    program = assemble([Cost(affine(rng, 6), positive(rng, 6))], [])
    theta = rng.standard_normal(3)
    z = program.free @ theta
    assert np.abs(program.H @ z + program.f @ theta).max() <= 1e-9
    for step in np.eye(4):
        assert program.cost(z + 0.1 * step, theta) > program.cost(z, theta)


@pytest.mark.parametrize("backend", BACKENDS)
def test_optimum_is_found_by_brute_force_too(program, backend):
    """Against every possible set of active rows."""
    p, theta = program
    known = p.offset @ theta
    best, cost = None, np.inf
    sides = [-1, 0, 1]
    for held in itertools.product(sides, repeat=len(p.labels)):
        at = np.flatnonzero(held)
        if len(at) > 4:
            continue
        edge = np.where(np.array(held) > 0, p.upper, p.lower)[at] - known[at]
        n = len(at)
        kkt = np.block([[p.H, p.M[at].T], [p.M[at], np.zeros((n, n))]])
        z = np.linalg.solve(kkt, np.concatenate([-p.f @ theta, edge]))[:4]
        if (p.room(z, theta) > -1e-9).all() and p.cost(z, theta) < cost:
            best, cost = z, p.cost(z, theta)
    found = solve(p, theta, backend)
    assert found.status is QPStatus.SOLVED
    assert found.decision == pytest.approx(best, abs=DECISION)
    assert found.active.any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_general_optimiser_agrees(program, backend):
    """SLSQP knows nothing of quadratic programs."""
    p, theta = program
    known = p.offset @ theta
    rows = {
        "type": "ineq",
        "fun": lambda z: np.concatenate(
            [p.upper - known - p.M @ z, p.M @ z + known - p.lower]
        ),
    }
    other = minimize(
        lambda z: p.cost(z, theta), np.zeros(4), constraints=rows, tol=1e-12
    )
    assert solve(p, theta, backend).decision == pytest.approx(other.x, abs=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_contradicting_rows_are_reported(backend):
    """Infeasible is an answer, not an exception; and it comes soon."""
    gain = np.array([[1.0, 0.0], [1.0, 0.0]])
    signal = Affine(gain, np.zeros((2, 1)))
    rows = [Limit("u", signal, np.array([1.0, -2.0]), np.array([2.0, -1.0]), 2, [0])]
    p = assemble([Cost(Affine(np.eye(2), np.zeros((2, 1))), np.eye(2))], rows)
    answer = solve(p, np.zeros(1), backend)
    assert not answer.found
    # ProxQP runs out of iterations where the others can tell
    assert answer.status in (QPStatus.INFEASIBLE, QPStatus.INACCURATE, QPStatus.FAILED)
    if backend == "daqp":
        assert answer.status is QPStatus.INFEASIBLE


@pytest.mark.parametrize("backend", BACKENDS)
def test_equal_sides_are_an_equality(rng, backend):
    """Lower = upper holds the row."""
    costs = [Cost(affine(rng, 6), positive(rng, 6))]
    row = affine(rng, 1)
    p = assemble(costs, [Limit("e", row, np.ones(1), np.ones(1), 1, np.array([0]))])
    theta = rng.standard_normal(3)
    s = solve(p, theta, backend)
    assert s.found
    assert row.value(s.decision, theta) == pytest.approx([1.0], abs=DECISION)


@pytest.mark.parametrize("backend", BACKENDS)
def test_sign_of_a_multiplier_tells_the_side(backend):
    """Positive at an upper limit, negative at a lower one, zero inside."""
    signal = Affine(np.eye(3), np.zeros((3, 1)))
    low, high = np.full(3, -1.0), np.full(3, 1.0)
    rows = [Limit("u", signal, low, high, 3, np.array([0]))]
    # pulled to (5, -5, 0.5)
    target = Affine(np.eye(3), -np.array([[5.0], [-5.0], [0.5]]))
    s = solve(assemble([Cost(target, np.eye(3))], rows), np.ones(1), backend)
    assert s.decision == pytest.approx([1.0, -1.0, 0.5], abs=DECISION)
    assert s.multipliers == pytest.approx([4.0, -4.0, 0.0], abs=DECISION)
    assert s.active.tolist() == [True, True, False]


def test_one_sided_form_says_the_same(program, rng):
    """M z <= N of the thesis holds exactly where lower <= row <= upper does."""
    p, theta = program
    M, N = p.one_sided(theta)
    assert M.shape == (2 * len(p.labels), 4)
    for z in rng.standard_normal((50, 4)):
        assert (M @ z <= N).all() == (p.room(z, theta) >= 0).all()


def test_infinite_sides_are_left_out_of_the_one_sided_form(rng):
    """A row limited above only gives one inequality; one without limits, none."""
    signal = affine(rng, 3)
    low, high = np.array([-np.inf, -1.0, -np.inf]), np.array([1.0, np.inf, np.inf])
    p = assemble(
        [Cost(affine(rng, 6), np.eye(6))],
        [Limit("u", signal, low, high, 1, np.arange(3))],
    )
    assert p.labels == (Row("u", 0, 0), Row("u", 0, 1))
    M, N = p.one_sided(np.zeros(3))
    assert relative(M, np.vstack([-signal.gain[1], signal.gain[0]])) <= ALGEBRA
    assert relative(N, np.ones(2)) <= ALGEBRA


def test_rows_that_no_decision_moves_are_left_out_and_named(rng):
    """They could only make the program infeasible."""
    gain = rng.standard_normal((4, 4))
    gain[[0, 3]] = 0.0
    signal = Affine(gain, rng.standard_normal((4, 3)))
    sides = np.full(4, -1.0), np.full(4, 1.0)
    p = assemble(
        [Cost(affine(rng, 6), np.eye(6))],
        [Limit("y", signal, *sides, 2, np.array([5, 6]))],
    )
    assert p.left_out == (Row("y", 0, 5), Row("y", 1, 6))
    assert p.labels == (Row("y", 1, 5), Row("y", 0, 6))
    assert relative(p.M, gain[1:3]) <= ALGEBRA


def test_rows_can_be_dropped_by_name(program):
    """Labels, matrices and bounds stay together."""
    p, _ = program
    rest = p.without("u")
    assert {row.name for row in rest.labels} == {"y"}
    assert relative(rest.M, p.M[5:]) <= ALGEBRA
    assert relative(rest.upper, p.upper[5:]) <= ALGEBRA
    assert p.rows["y"].tolist() == [5, 6, 7]
    assert len(p.without("u", "y").labels) == 0


def test_softened_rows_are_broken_at_their_price(rng):
    """One variable pulled to 10 against a limit of 1: weight w lets it out."""
    signal = Affine(np.eye(1), np.zeros((1, 1)))
    pull = Affine(np.eye(1), np.array([[-10.0]]))
    rows = [Limit("y", signal, -np.ones(1), np.ones(1), 1, np.array([0]))]
    p = assemble([Cost(pull, np.eye(1))], rows)
    for w in (1.0, 9.0, 1e4):
        s = solve(p.softened(np.array([0]), np.array([w])), np.ones(1))
        # min (z - 10)^2 + w (z - 1)^2
        assert s.decision[0] == pytest.approx((10 + w) / (1 + w), rel=DECISION)
        assert s.decision[1] == pytest.approx(1 - s.decision[0], rel=DECISION)


def test_indefinite_block_is_accepted_when_the_sum_is_positive(rng):
    """The condensed H decides, not its parts."""
    identity = Affine(np.eye(2), np.zeros((2, 1)))
    negative = Cost(identity, np.diag([1.0, -0.5]))
    p = assemble([negative, Cost(identity, np.eye(2))], [])
    smallest, largest = np.linalg.eigvalsh(p.H)
    assert (smallest, largest) == pytest.approx((0.5, 2.0))


def test_indefinite_sum_is_refused_with_its_eigenvalue():
    """The message gives the smallest eigenvalue."""
    identity = Affine(np.eye(2), np.zeros((2, 1)))
    with pytest.raises(ValueError, match=r"weights Q.*smallest eigenvalue.*-0\.25 "):
        assemble([Cost(identity, np.diag([1.0, -0.25]))], [], "weights Q")
    with pytest.raises(ValueError, match="not convex"):
        assemble([Cost(identity, np.zeros((2, 2)))], [])


def test_unknown_solver_is_refused_with_the_known_ones():
    """The message lists what there is."""
    with pytest.raises(
        ValueError, match=r'backend = "magic": expected one of active_set, daqp'
    ):
        qp.find_backend("magic")
    with pytest.raises(ValueError, match="qpsolvers/magic"):
        qp.find_backend("qpsolvers/magic")


def test_wrong_answers_are_told_from_right_ones(program):
    """The residual of a solution is small, that of anything else is not."""
    p, theta = program
    known = p.offset @ theta
    problem = Problem(p.H, p.f @ theta, p.M, p.lower - known, p.upper - known)
    s = solve(p, theta)
    assert kkt_residual(problem, s.decision, s.multipliers) <= SOLVER
    assert s.residual <= SOLVER
    spoiled = {
        "stationarity": (s.decision, 1.1 * s.multipliers),
        "feasibility": (s.decision + 0.01, s.multipliers),
        "sign": (s.decision, -s.multipliers),
        "free": (p.free @ theta, 0 * s.multipliers),
    }
    for name, answer in spoiled.items():
        assert kkt_residual(problem, *answer) > 100 * SOLVER, name


def test_multiplier_of_a_row_inside_its_limits_is_wrong():
    """Complementarity counts even where the gradient happens to vanish."""
    problem = Problem(np.eye(1), -np.ones(1), np.eye(1), -np.ones(1), 2 * np.ones(1))
    # stationary at z = 0.5 with multiplier 0.5, but the limit is at 2
    assert kkt_residual(problem, np.array([0.5]), np.array([0.5])) > 0.1


def test_inaccurate_solver_is_polished_to_the_exact_answer(program, monkeypatch):
    """A rough answer with the right active rows is refined."""
    p, theta = program
    exact = solve(p, theta)

    def rough(problem):
        noise = 1e-5 * np.ones(4)
        return exact.decision + noise, 1.001 * exact.multipliers, 1, False

    monkeypatch.setitem(qp.BACKENDS, "rough", rough)
    found = solve(p, theta, "rough")
    assert found.status is QPStatus.SOLVED
    assert found.decision == pytest.approx(exact.decision, abs=1e-9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_program_without_rows_is_solved(rng, backend):
    """As after dropping all limits."""
    p = assemble([Cost(affine(rng, 6), positive(rng, 6))], [])
    theta = rng.standard_normal(3)
    s = solve(p, theta, backend)
    assert s.found
    assert s.decision == pytest.approx(p.free @ theta, abs=DECISION)


def test_program_is_data(program):
    """Replaced bounds apply to one call only."""
    p, theta = program
    wide = np.full(len(p.labels), 1e3)
    free = solve(p, theta, bounds=(-wide, wide))
    assert free.decision == pytest.approx(p.free @ theta, abs=DECISION)
    assert isinstance(p, QuadraticProgram)
    assert solve(p, theta).active.any()
