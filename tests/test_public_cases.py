"""Public cases with published numbers, computed with the library's own parts."""

import numpy as np
import pytest
import scipy.linalg
from conftest import printed

from nmss_lab.cases import quadruple_tank_plant, wood_berry_plant
from nmss_lab.models import DifferenceModel
from nmss_lab.mpc import wang_young
from nmss_lab.nmss import Layout, observed_form
from nmss_lab.predict import Affine, Horizon, decided, known_part, predict
from nmss_lab.qp import Cost, Limit, assemble, solve

# --- L. Wang, Model Predictive Control System Design (2009), examples 1.1 to 1.3 ------


def wang(weight):
    """Build y_{k+1} = 0.8 y_k + 0.1 u_k, Np = 10, Nc = 4, weight of the moves r_w."""
    model = DifferenceModel([-0.8], [0.1])
    return wang_young(model, Horizon(10, 4), 1.0, weight)


def at(c):
    """Known vector of the book's x = [0.1, 0.2] (change and output), r = 1."""
    return c.knowledge.layout.pack(x=[0.1, 0.2], r=[1.0])


PHI_PHI = """1.1541 1.0407 0.9116 0.7726
             1.0407 0.9549 0.8475 0.7259
             0.9116 0.8475 0.7675 0.6674
             0.7726 0.7259 0.6674 0.5943"""
PHI_F = "9.2325 3.2147  8.3259 2.7684  7.2927 2.3355  6.1811 1.9194"


def table(text, columns):
    """Return numbers printed to four decimals."""
    return np.array(text.split(), dtype=float).reshape(-1, columns)


def test_wang_condensed_matrices():
    """The products Phi'Phi and Phi'F of example 1.2."""
    program = wang(0.0).program
    tolerance = printed("1.1541")
    wanted = table(PHI_PHI, 4)
    assert np.abs(program.H - wanted).max() <= tolerance
    c = wang(0.0)
    found = c.program.f[:, c.knowledge.layout["x"]]
    assert found == pytest.approx(table(PHI_F, 2), abs=tolerance)


@pytest.mark.parametrize(
    ("weight", "moves"),
    [
        (0.0, ["7.2", "-6.4", "0.0000", "0.0000"]),
        (10.0, ["0.1269", "0.1034", "0.0829", "0.065"]),
    ],
)
def test_wang_optimal_moves(weight, moves):
    """The plan of example 1.2 without and with a weight on the moves."""
    c = wang(weight)
    found = c.program.free @ at(c)
    for value, text in zip(found, moves, strict=True):
        assert value == pytest.approx(float(text), abs=printed(text))


@pytest.mark.parametrize(
    ("weight", "gains"), [(0.0, ["8", "10"]), (10.0, ["0.6939", "0.2453"])]
)
def test_wang_gains(weight, gains):
    """State feedback of example 1.3."""
    c = wang(weight)
    K = -c.free_gain[0, c.knowledge.layout["x"]]
    for value, text in zip(K, gains, strict=True):
        assert value == pytest.approx(float(text), abs=printed(text))


def test_wang_closed_loop_poles():
    """Example 1.3 with r_w = 10: 0.8530 +- 0.0542 j."""
    c = wang(10.0)
    K = -c.free_gain[:, c.knowledge.layout["x"]]
    poles = np.linalg.eigvals(c.form.A - c.form.B @ K)
    assert poles.real == pytest.approx([0.8530] * 2, abs=printed("0.8530"))
    assert np.abs(poles.imag) == pytest.approx([0.0542] * 2, abs=printed("0.0542"))


# --- Camacho and Bordons, Model Predictive Control: the GPC example ------------------


@pytest.fixture
def gpc():
    """Build (1 - 0.8 z^-1) y = (0.4 + 0.6 z^-1) u(t-1), N = 3, lambda = 0.8."""
    model = DifferenceModel([-0.8], [0.4, 0.6])
    return wang_young(model, Horizon(3, 3), 1.0, 0.8, reference="preview")


def test_gpc_dynamic_matrix(gpc):
    """Step responses in G."""
    wanted = [[0.4, 0.0, 0.0], [1.32, 0.4, 0.0], [2.056, 1.32, 0.4]]
    assert gpc.signals["y"].gain == pytest.approx(np.array(wanted), abs=1e-12)


def test_gpc_is_nmss_predictive_control(gpc):
    """The printed control law on past move, outputs and future references."""
    layout = gpc.knowledge.layout
    on_change, on_last_move, on_y = gpc.free_gain[0, layout["x"]]
    law = {
        "du(t-1)": (on_last_move, "-0.6042"),
        "y(t)": (on_change + on_y, "-1.3720"),
        "y(t-1)": (-on_change, "0.8056"),
    }
    for name, (value, text) in law.items():
        assert value == pytest.approx(float(text), abs=printed(text)), name
    on_r = gpc.free_gain[0, layout["r"]]
    for value, text in zip(on_r, ["0.1334", "0.2859", "0.1471"], strict=True):
        assert value == pytest.approx(float(text), abs=printed(text))


# --- MATLAB documentation of cloffset: offset-free control with an observer -----------


def cloffset_form():
    """Build tf(1, [1 1], 0.2), that is 1/(z + 1), with the toolbox's own estimator.

    An integrator of gain 0.2 disturbs the output; white noise of unit variance on it,
    on the input and on the measurement; the Kalman filter in current form.
    """
    Ts, a, b = 0.2, -1.0, 1.0
    model = DifferenceModel([-a], [b], dt=Ts)
    C = np.array([[1.0, 1.0]])
    A = np.diag([a, 1.0])
    noise = np.diag([b, Ts])
    P = scipy.linalg.solve_discrete_are(A.T, C.T, noise @ noise.T, np.eye(1))
    M = np.vstack([P @ C.T / (C @ P @ C.T + 1.0), 0.0])
    # the last state is the input before, so that changes of it drive the form
    whole = np.array([[a, 0.0, b], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    B = np.array([[b], [0.0], [1.0]])
    return observed_form(model, whole, B, np.array([[1.0, 1.0, 0.0]]), M, whole @ M)


def first_gain(form, horizon, weight_du):
    """Gain (1, n_x) of the first move on the state, from predict and assemble."""
    Np, n = horizon.Np, horizon.Nc
    known = Layout(x=form.n_x)
    spread = horizon.impulses(1)
    moves = [decided(spread[[i]], known) for i in range(Np)]
    nothing = Affine(np.zeros((form.n_x, n)), np.zeros((form.n_x, form.n_x)))
    x = known_part(known, "x", n)
    X = predict([form.A] * Np, [form.B] * Np, x, moves, [nothing] * Np)
    Y = np.kron(np.eye(Np), form.C) @ X
    dU = decided(np.eye(n), known)
    program = assemble([Cost(Y, np.eye(Np)), Cost(dU, weight_du * np.eye(n))], [])
    return program.free[:1]


def test_cloffset_controller():
    """0.45205 z^2 (z - 1.5) / ((z - 1)(z - 0.02575)(z + 0.02485)) from y to u."""
    form = cloffset_form()
    gain = first_gain(form, Horizon(10, 2), 0.1**2)
    r = form.recipe
    law = gain @ r.state  # change of the input from the memory after measuring
    law = law + r.layout.select("u")[:1]
    measured = r.enter[:, :1]
    stored = r.store[:, :1] + r.store[:, 1:2]
    A = (r.keep + stored @ law) @ r.carry
    B = (r.keep + stored @ law) @ measured

    def controller(z):
        m = np.linalg.solve(z * np.eye(len(A)) - A, B)
        return (law @ (r.carry @ m + measured))[0, 0]

    def published(z):
        return 0.45205 * z**2 * (z - 1.5) / ((z - 1) * (z - 0.02575) * (z + 0.02485))

    for z in (2.0, 1.1, 1j, 0.6 + 0.8j, -1.0):
        assert controller(z) == pytest.approx(published(z), rel=1e-4)


# --- MPT3: regulation problem, also in the tests of python-control --------------------


def test_mpt_regulation_problem():
    """Double integrator, |x| <= 5, |u| <= 1, Q = I, R = 1, x_0 = (4, 0), four moves."""
    A, B, N = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0], [0.5]]), 4
    known = Layout(x=2)
    x = known_part(known, "x", N)
    moves = [decided(row[None], known) for row in np.eye(N)]
    nothing = Affine(np.zeros((2, N)), np.zeros((2, 2)))
    X = predict([A] * N, [B] * N, x, moves, [nothing] * N)
    U = decided(np.eye(N), known)
    costs = [Cost(x, np.eye(2)), Cost(X, np.eye(2 * N)), Cost(U, np.eye(N))]
    rows = [
        Limit("x", X, np.full(2 * N, -5.0), np.full(2 * N, 5.0), 2, np.arange(N)),
        Limit("u", U, -np.ones(N), np.ones(N), 1, np.arange(N)),
    ]
    program, start = assemble(costs, rows), np.array([4.0, 0.0])
    s = solve(program, start)
    for value, text in zip(s.decision, ["-1", "-1", "0.1393", "0.3361"], strict=True):
        assert value == pytest.approx(float(text), abs=printed(text))
    cost = program.cost(s.decision, start)
    assert cost == pytest.approx(32.4898, abs=printed("32.4898"))
    # the exact rational solution along the active set
    assert s.decision[2:] == pytest.approx([0.139344, 0.336066], abs=1e-6)


# --- Two inputs, two outputs ----------------------------------------------------------


def relative_gain(gain):
    """Return the (1, 1) entry of the relative gain array."""
    return (gain * np.linalg.inv(gain).T)[0, 0]


@pytest.mark.parametrize(("minimum_phase", "rga"), [(True, "1.40"), (False, "-0.64")])
def test_quadruple_tank_relative_gain(minimum_phase, rga):
    """Johansson (2000): 1.40 in one setting of the valves, -0.64 in the other."""
    plant = quadruple_tank_plant(minimum_phase)
    found = relative_gain(plant.steady_state_gain())
    assert found == pytest.approx(float(rga), abs=printed(rga))


@pytest.mark.parametrize(
    ("minimum_phase", "zeros"),
    [(True, (-0.060, -0.018)), (False, (0.013, -0.057))],
)
def test_quadruple_tank_zeros(minimum_phase, zeros):
    """Zeros of the sampled model seen in continuous time; the paper rounds first."""
    dt = 0.5
    model = quadruple_tank_plant(minimum_phase).difference_model(dt)
    gain = max(np.abs(model.zeros()))
    found = np.log(model.zeros().astype(complex)) / dt
    slow = sorted(found[np.abs(found) < 0.2].real)
    assert (gain > 1.0) == (not minimum_phase)
    # 0.002: the paper takes its time constants rounded to whole seconds
    assert slow[-1] == pytest.approx(max(zeros), abs=2e-3)
    assert slow[0] == pytest.approx(min(zeros), abs=2.5e-3)


def test_wood_berry_relative_gain():
    """Pairing of the distillation column: 2.01."""
    gain = wood_berry_plant().steady_state_gain()[:, :2]
    assert relative_gain(gain) == pytest.approx(2.01, abs=printed("2.01"))
    assert gain == pytest.approx(np.array([[12.8, -18.9], [6.6, -19.4]]), rel=1e-12)
