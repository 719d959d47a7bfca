"""The block matrices of the thesis, written out as printed, against the library.

Where the thesis has a misprint the corrected block is written and a comment says so.
Loops are plain on purpose: nothing here shares code with the library.
"""

import numpy as np
import pytest
from conftest import ALGEBRA
from scipy.linalg import block_diag
from strategies import SIZES, play, positive, random_model, relative

from nmss_lab.controller import Limits
from nmss_lab.governor import governor
from nmss_lab.mpc import (
    disturbance_augmented,
    disturbance_direct,
    integral_of_error,
    wang_young,
)
from nmss_lab.nmss import differenced_form, integral_of_error_form
from nmss_lab.pip import lq_gain
from nmss_lab.predict import Horizon

NP, NC = 6, 3


@pytest.fixture(params=SIZES, ids=str)
def sizes(request):
    """Return the sizes n_y, n_u, n_v, na, nb, ng of a model."""
    return request.param


# --- Chapter 3 and 4: the forms ----------------------------------------------------


def past_matrices(model):
    """A_Delta and B_Delta of (4.3): the first rows and columns of (3.3), too."""
    p, q, n, m = model.n_y, model.n_u, model.na, model.nb
    A = np.zeros((n * p + (m - 1) * q,) * 2)
    for i in range(n):
        A[:p, i * p : (i + 1) * p] = -model.a[i]
    for j in range(1, m):
        at = n * p + (j - 1) * q
        A[:p, at : at + q] = model.b[j]
    for i in range(1, n):
        A[i * p : (i + 1) * p, (i - 1) * p : i * p] = np.eye(p)
    for j in range(2, m):
        row = n * p + (j - 1) * q
        A[row : row + q, row - q : row] = np.eye(q)
    B = np.zeros((len(A), q))
    B[:p] = model.b[0]
    if m > 1:
        B[n * p : n * p + q] = np.eye(q)
    return A, B


def form_3_3(model):
    """Return A, B, C, D of (3.3)."""
    p = model.n_y
    inner, B_past = past_matrices(model)
    n = len(inner) + p
    A = np.zeros((n, n))
    A[:-p, :-p] = inner
    A[-p:, :-p] = -inner[:p]  # A_1 .. A_n, -B_2 .. -B_m
    A[-p:, -p:] = np.eye(p)
    B = np.vstack([B_past, -model.b[0]])
    C, D = np.zeros((p, n)), np.zeros((n, p))
    C[:, :p] = np.eye(p)
    D[-p:] = np.eye(p)
    return A, B, C, D


def form_4_6(model):
    """Return A, B, C of (4.6), with C_Delta where C_m is printed."""
    p = model.n_y
    A_delta, B_delta = past_matrices(model)
    n = len(A_delta)
    C_delta = np.zeros((p, n))
    C_delta[:, :p] = np.eye(p)
    A = np.block([[A_delta, np.zeros((n, p))], [C_delta @ A_delta, np.eye(p)]])
    B = np.vstack([B_delta, C_delta @ B_delta])
    C = np.hstack([np.zeros((p, n)), np.eye(p)])
    return A, B, C


def test_form_with_the_sum_of_the_error_is_3_3(rng, sizes):
    """Every block of (3.3)."""
    model = random_model(rng, *sizes)
    form = integral_of_error_form(model)
    for name, wanted in zip("ABCD", form_3_3(model), strict=True):
        assert relative(getattr(form, name), wanted) <= ALGEBRA, name


def test_state_has_as_many_entries_as_the_corrected_count(rng, sizes):
    """(n+1)p + (m-1)q; section 3.1 prints m(q-1)."""
    p, q, _, n, m, _ = sizes
    form = integral_of_error_form(random_model(rng, *sizes))
    assert form.n_x == (n + 1) * p + (m - 1) * q
    assert len(form.names) == form.n_x


def test_differenced_form_is_4_6(rng, sizes):
    """Every block of (4.6)."""
    model = random_model(rng, *sizes)
    form = differenced_form(model)
    for name, wanted in zip("ABC", form_4_6(model), strict=True):
        assert relative(getattr(form, name), wanted) <= ALGEBRA, name


# --- Horizons ----------------------------------------------------------------------


def powers(A, count):
    """I, A, A^2, ..., ``count`` of them."""
    found = [np.eye(len(A))]
    while len(found) < count:
        found.append(A @ found[-1])
    return found


def free_response(A, Np=NP):
    """F of (3.8), (4.8)."""
    return np.vstack(powers(A, Np + 1)[1:])


def toeplitz(A, B, columns, Np=NP):
    """Phi of (4.8), H_r of (3.8) with ``columns`` = Np, H_v of (7.6) with l."""
    power, n, width = powers(A, Np), len(A), B.shape[1]
    Phi = np.zeros((Np * n, columns * width))
    for i in range(Np):
        for j in range(min(i + 1, columns)):
            block = power[i - j] @ B
            Phi[i * n : (i + 1) * n, j * width : (j + 1) * width] = block
    return Phi


def held_after(A, B, Np=NP, Nc=NC):
    """Phi_1 of (4.14): the last move acts on, B + AB + ..."""
    power, n, q = powers(A, Np), len(A), B.shape[1]
    Phi_1 = np.zeros((Np * n, Nc * q))
    for i in range(Nc, Np):
        total = sum(power[j] @ B for j in range(i - Nc + 1))
        Phi_1[i * n : (i + 1) * n, -q:] = total
    return Phi_1


def differences(steps, q):
    """C_1 and C_2 of (3.10)."""
    C_1, C_2 = np.zeros((steps * q, q)), np.eye(steps * q)
    C_1[:q] = np.eye(q)
    for i in range(1, steps):
        C_2[i * q : (i + 1) * q, (i - 1) * q : i * q] = -np.eye(q)
    return C_1, C_2


def sums(steps, q):
    """C_1 and C_2 of section 7.3, with I_q where I_p is printed."""
    C_1, C_2 = np.zeros((steps * q, q)), np.zeros((steps * q,) * 2)
    for i in range(steps):
        C_1[i * q : (i + 1) * q] = np.eye(q)
        for j in range(i + 1):
            C_2[i * q : (i + 1) * q, j * q : (j + 1) * q] = np.eye(q)
    return C_1, C_2


def limits_for(rng, p, q):
    """Different limits on every channel and side."""
    return Limits(
        u=(-1 - rng.random(q), 1 + rng.random(q)),
        du=(-0.1 - rng.random(q), 0.1 + rng.random(q)),
        y=(-3 - rng.random(p), 3 + rng.random(p)),
    )


def one_sided(parts, limits):
    """M and N with all lower sides first, from (name, gain, known, steps) parts."""
    lower_M, lower_N, upper_M, upper_N = [], [], [], []
    for name, gain, known, steps in parts:
        low, high = (np.tile(side, steps) for side in getattr(limits, name))
        moved = np.abs(gain).max(axis=1) > 1e-12 * np.abs(gain).max()
        lower_M.append(-gain[moved])
        lower_N.append((-low + known)[moved])
        upper_M.append(gain[moved])
        upper_N.append((high - known)[moved])
    M = np.vstack([*lower_M, *upper_M])
    return M, np.concatenate([*lower_N, *upper_N])


def random_theta(controller, rng, S):
    """Return a known vector with a random state and input and the reference ``S``."""
    layout = controller.knowledge.layout
    theta = rng.standard_normal(layout.size)
    theta[layout["r"]] = S
    return theta, theta[layout["x"]], theta[layout["u"]]


# --- Chapter 3: the governor -------------------------------------------------------


@pytest.fixture
def governed(rng, sizes):
    """Return model, gain and limits with the printed timing of (3.12)."""
    p, q, _, n, m, _ = sizes
    model = random_model(rng, p, q if q >= p else p, 0, n, m)
    K = lq_gain(model, 1.0, 0.3)
    return model, K, limits_for(rng, p, model.n_u)


def matrices_3(model, K):
    """F, H_r of (3.8), the maps to U of (3.9), C_1, C_2 of (3.10) and C-bar."""
    A, B, C, D = form_3_3(model)
    A_tilde, n, q = A - B @ K, len(A), model.n_u
    K_1, K_2 = np.zeros((NP * q, n)), np.zeros((NP * q, NP * n))
    K_1[:q] = -K
    for i in range(1, NP):
        K_2[i * q : (i + 1) * q, (i - 1) * n : i * n] = -K
    C_bar = block_diag(*[C] * NP)
    F, H_r = free_response(A_tilde), toeplitz(A_tilde, D, NP)
    return F, H_r, K_1, K_2, *differences(NP, q), C_bar


def test_governor_predicts_with_3_8_to_3_10(governed):
    """Effects of state, reference, last input and perturbation."""
    model, K, limits = governed
    c = governor(model, K, NP, limits, reference="preview")
    F, H_r, K_1, K_2, C_1, C_2, C_bar = matrices_3(model, K)
    U_x, U_r = K_1 + K_2 @ F, K_2 @ H_r
    wanted = {
        "u": (U_x, U_r, np.zeros((len(U_x), model.n_u))),
        "du": (C_2 @ U_x, C_2 @ U_r, -C_1),  # C_1 is printed without its sign
        "y": (C_bar @ F, C_bar @ H_r, np.zeros((len(C_bar), model.n_u))),
    }
    layout = c.knowledge.layout
    for name, (on_x, on_r, on_u) in wanted.items():
        signal = c.signals[name]
        assert relative(signal.effect_of(layout, "x"), on_x) <= ALGEBRA, name
        assert relative(signal.effect_of(layout, "r"), on_r) <= ALGEBRA, name
        assert relative(signal.effect_of(layout, "u"), on_u) <= ALGEBRA, name
        assert relative(signal.gain, on_r) <= ALGEBRA, name


def test_governor_program_is_3_12(rng, governed):
    """M, N, H and p; rows that no perturbation moves are left out."""
    model, K, limits = governed
    p, q = model.n_y, model.n_u
    c = governor(model, K, NP, limits, reference="preview")
    F, H_r, K_1, K_2, C_1, C_2, C_bar = matrices_3(model, K)
    S = rng.standard_normal(NP * p)
    theta, x, u = random_theta(c, rng, S)
    U = (K_1 + K_2 @ F) @ x + K_2 @ H_r @ S
    parts = [
        ("u", K_2 @ H_r, U, NP),
        ("du", C_2 @ K_2 @ H_r, -C_1 @ u + C_2 @ U, NP),
        ("y", C_bar @ H_r, C_bar @ (F @ x + H_r @ S), NP),
    ]
    M, N = one_sided(parts, limits)
    found_M, found_N = c.program.one_sided(theta)
    assert relative(found_M, M) <= ALGEBRA
    assert relative(found_N, N) <= ALGEBRA
    # H = 2 I for 1/2 z'Hz: the library's cost is twice the program's objective
    assert relative(c.program.H, np.eye(NP * p)) <= ALGEBRA
    assert not c.program.f.any()
    # beta_1 acts on u_{k+1} first: the rows of u_k and y_{k+1} are zero and left out
    left_out = set(c.program.left_out)
    assert {("u", i, 0) for i in range(q)} <= left_out
    assert {("du", i, 0) for i in range(q)} <= left_out
    assert {("y", i, 0) for i in range(p)} <= left_out


# --- Chapter 4: integral of error --------------------------------------------------


@pytest.fixture
def ioe(rng, sizes):
    """Return model, weights and limits of an integral-of-error design."""
    model = random_model(rng, *sizes)
    n_x = integral_of_error_form(model).n_x
    Q, R = positive(rng, n_x), positive(rng, model.n_u)
    return model, Q, R, limits_for(rng, model.n_y, model.n_u)


def matrices_4(model):
    """F, Phi + Phi_1, H_r of (4.14) and C-bar."""
    A, B, C, D = form_3_3(model)
    Phi = toeplitz(A, B, NC) + held_after(A, B)
    return free_response(A), Phi, toeplitz(A, D, NP), block_diag(*[C] * NP)


def test_integral_of_error_predicts_with_4_14(ioe):
    """F, Phi + Phi_1 and H_r."""
    model, Q, R, limits = ioe
    c = integral_of_error(model, Horizon(NP, NC), Q, R, limits, "preview")
    F, Phi, H_r, C_bar = matrices_4(model)
    y, layout = c.signals["y"], c.knowledge.layout
    assert relative(y.gain, C_bar @ Phi) <= ALGEBRA
    assert relative(y.effect_of(layout, "x"), C_bar @ F) <= ALGEBRA
    assert relative(y.effect_of(layout, "r"), C_bar @ H_r) <= ALGEBRA


def test_integral_of_error_program_is_4_16(rng, ioe):
    """H, p, M and N."""
    model, Q, R, limits = ioe
    p, q = model.n_y, model.n_u
    c = integral_of_error(model, Horizon(NP, NC), Q, R, limits, "preview")
    F, Phi, H_r, C_bar = matrices_4(model)
    Q_bar, R_bar = block_diag(*[Q] * NP), block_diag(*[R] * NC)
    S = rng.standard_normal(NP * p)
    theta, x, u = random_theta(c, rng, S)
    ahead = F @ x + H_r @ S
    assert relative(c.program.H, Phi.T @ Q_bar @ Phi + R_bar) <= ALGEBRA
    assert relative(c.program.f @ theta, Phi.T @ Q_bar @ ahead) <= ALGEBRA
    C_1, C_2 = differences(NC, q)
    parts = [
        ("u", np.eye(NC * q), np.zeros(NC * q), NC),  # I_{q Nc}, printed I_{Nc}
        ("du", C_2, -C_1 @ u, NC),
        ("y", C_bar @ Phi, C_bar @ ahead, NP),
    ]
    M, N = one_sided(parts, limits)
    found_M, found_N = c.program.one_sided(theta)
    assert relative(found_M, M) <= ALGEBRA
    assert relative(found_N, N) <= ALGEBRA


def test_free_law_is_4_17(rng, ioe):
    """K_s and R_s."""
    model, Q, R, _ = ioe
    c = integral_of_error(model, Horizon(NP, NC), Q, R, None, "preview")
    F, Phi, H_r, _ = matrices_4(model)
    Q_bar, R_bar = block_diag(*[Q] * NP), block_diag(*[R] * NC)
    H = Phi.T @ Q_bar @ Phi + R_bar
    K_s = np.linalg.solve(H, Phi.T @ Q_bar @ F)[: model.n_u]
    R_s = np.linalg.solve(H, Phi.T @ Q_bar @ H_r)[: model.n_u]
    layout = c.knowledge.layout
    # solving with H loses digits in proportion to its condition
    tolerance = ALGEBRA * np.linalg.cond(H)
    assert relative(c.free_gain[:, layout["x"]], -K_s) <= tolerance
    assert relative(c.free_gain[:, layout["r"]], -R_s) <= tolerance


# --- Chapters 4 and 7: changes of the input ----------------------------------------


@pytest.fixture
def incremental(rng, sizes):
    """Return model, weights and limits of a design that decides changes."""
    model = random_model(rng, *sizes)
    Q, R = positive(rng, model.n_y), positive(rng, model.n_u)
    return model, Q, R, limits_for(rng, model.n_y, model.n_u)


def incremental_program(c, model, Q, R, limits, S, theta, offset):
    """Compare H, f, M, N with (4.10), (7.7) and the M, N of section 7.3."""
    q = model.n_u
    A, B, C = form_4_6(model)
    F, Phi, C_bar = free_response(A), toeplitz(A, B, NC), block_diag(*[C] * NP)
    Q_bar, R_bar = block_diag(*[Q] * NP), block_diag(*[R] * NC)
    layout = c.knowledge.layout
    x, u = theta[layout["x"]], theta[layout["u"]]
    ahead = C_bar @ F @ x[: A.shape[0]] + offset
    H = Phi.T @ C_bar.T @ Q_bar @ C_bar @ Phi + R_bar
    f = Phi.T @ C_bar.T @ Q_bar @ (ahead - S)
    assert relative(c.program.H, H) <= ALGEBRA
    assert relative(c.program.f @ theta, f) <= 10 * ALGEBRA  # ahead - S cancels
    C_1, C_2 = sums(NC, q)
    parts = [
        ("u", C_2, C_1 @ u, NC),
        ("du", np.eye(NC * q), np.zeros(NC * q), NC),
        ("y", C_bar @ Phi, ahead, NP),
    ]
    M, N = one_sided(parts, limits)
    found_M, found_N = c.program.one_sided(theta)
    assert relative(found_M, M) <= ALGEBRA
    assert relative(found_N, N) <= ALGEBRA


def test_wang_young_predicts_with_4_8(incremental):
    """F and Phi."""
    model, Q, R, limits = incremental
    c = wang_young(model, Horizon(NP, NC), Q, R, limits, "preview")
    A, B, C = form_4_6(model)
    C_bar, y, layout = block_diag(*[C] * NP), c.signals["y"], c.knowledge.layout
    assert relative(y.gain, C_bar @ toeplitz(A, B, NC)) <= ALGEBRA
    assert relative(y.effect_of(layout, "x"), C_bar @ free_response(A)) <= ALGEBRA
    assert not y.effect_of(layout, "r").any()


def test_wang_young_program_is_4_10(rng, incremental):
    """H, p, M and N."""
    model, Q, R, limits = incremental
    c = wang_young(model, Horizon(NP, NC), Q, R, limits, "preview")
    S = rng.standard_normal(NP * model.n_y)
    theta, _, _ = random_theta(c, rng, S)
    incremental_program(c, model, Q, R, limits, S, theta, np.zeros(NP * model.n_y))


DISTURBED = [each for each in SIZES if each[2]]


@pytest.mark.parametrize("disturbed", DISTURBED, ids=str)
def test_direct_disturbances_are_7_5_and_7_6(rng, disturbed):
    """G and H_v, and the program (7.7)."""
    model = random_model(rng, *disturbed)
    p, q, r, _, _, lags = disturbed
    Q, R = positive(rng, p), positive(rng, q)
    limits = limits_for(rng, p, q)
    c = disturbance_direct(model, Horizon(NP, NC), Q, R, limits, "preview")
    A, _, C = form_4_6(model)
    G = np.zeros((len(A), lags * r))
    for j in range(lags):
        G[:p, j * r : (j + 1) * r] = model.g[j]
        G[-p:, j * r : (j + 1) * r] = model.g[j]
    assert relative(c.form.G, G) <= ALGEBRA
    S = rng.standard_normal(NP * p)
    theta, _, _ = random_theta(c, rng, S)
    dv = theta[c.knowledge.layout["dv"]]  # v_k - v_{k-1}, ..., l of them
    # Delta v-bar vanishes from i = l on: l block columns suffice (printed: l + 1)
    delta_V = np.zeros(lags * lags * r)
    for i in range(lags):
        at = i * lags * r
        delta_V[at + i * r : at + lags * r] = dv[: (lags - i) * r]
    offset = block_diag(*[C] * NP) @ toeplitz(A, G, lags) @ delta_V
    on_dv = c.signals["y"].effect_of(c.knowledge.layout, "dv")
    assert relative(on_dv @ dv, offset) <= ALGEBRA
    incremental_program(c, model, Q, R, limits, S, theta, offset)


@pytest.mark.parametrize("disturbed", DISTURBED, ids=str)
def test_augmented_disturbances_are_7_3_corrected(rng, disturbed):
    """The increment of the disturbance that enters is the coming one."""
    model = random_model(rng, *disturbed)
    p, q, r, _, _, lags = disturbed
    form = disturbance_augmented(model, Horizon(NP, NC), 1.0, 1.0).form
    inner, B_1 = past_matrices(model)
    n = len(inner)
    A_2, A_3 = np.zeros((n, lags * r)), np.zeros((lags * r,) * 2)
    for j in range(lags):
        A_2[:p, j * r : (j + 1) * r] = model.g[j]
    for j in range(1, lags):
        A_3[j * r : (j + 1) * r, (j - 1) * r : j * r] = np.eye(r)
    A_delta = np.block([[inner, A_2], [np.zeros((lags * r, n)), A_3]])
    B_delta = np.vstack([B_1, np.zeros((lags * r, q))])
    G_delta = np.zeros((n + lags * r, r))
    G_delta[n : n + r] = np.eye(r)
    C_delta = np.zeros((p, n + lags * r))
    C_delta[:, :p] = np.eye(p)
    zeros = np.zeros((n + lags * r, p))
    A = np.block([[A_delta, zeros], [C_delta @ A_delta, np.eye(p)]])
    assert relative(form.A, A) <= ALGEBRA
    assert relative(form.B, np.vstack([B_delta, C_delta @ B_delta])) <= ALGEBRA
    assert relative(form.G, np.vstack([G_delta, C_delta @ G_delta])) <= ALGEBRA
    assert relative(form.C, np.hstack([zeros.T, np.eye(p)])) <= ALGEBRA


def test_states_hold_what_4_2_and_3_2_say(rng, sizes):
    """Histories in the state: y_k .. y_{k-n+1}, u_{k-1} .. u_{k-m+1}, and z_k."""
    model = random_model(rng, *sizes)
    c = integral_of_error(model, Horizon(NP, NC), 1.0, 1.0)
    h = play(c, rng)
    z = sum(r - y for r, y in zip(h.r, h.y, strict=True))
    y, u = h.y[::-1][: model.na], h.u[::-1][: model.nb - 1]
    x = h.known[c.knowledge.layout["x"]]
    assert relative(x, np.concatenate([*y, *u, z])) <= ALGEBRA
