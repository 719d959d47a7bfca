"""Poles, transfer matrices and the review, against polynomials and simulation."""

import dataclasses

import numpy as np
import pytest
import scipy.linalg
from conftest import ALGEBRA, REPLAY
from strategies import random_model

from nmss_lab.analysis import control_polynomials, linear_loop, review
from nmss_lab.cases import case
from nmss_lab.controller import Limits
from nmss_lab.governor import governor
from nmss_lab.models import DifferenceModel, minimal_realisation
from nmss_lab.mpc import (
    STRUCTURES,
    forward_path,
    integral_of_error,
    minimal,
    wang_young,
)
from nmss_lab.pip import lq_gain, pip
from nmss_lab.predict import Horizon
from nmss_lab.simulate import Scenario, closed_loop

POINTS = [1.3, 0.7 + 0.9j, np.exp(0.3j), np.exp(2.0j), 1.0 + 1e-3j]
"""Where transfer matrices are compared: off the poles, on and off the circle."""

ROUND = 1e-9
"""Relative: a solve with a matrix of a few dozen rows, condition number up to 1e5."""


def plants(rng):
    """Return a model and a plant that differs from it, stable, 2 x 2."""
    model = random_model(rng, 2, 2, 0, 2, 2, radius=0.8)
    a = model.a + 0.02 * rng.standard_normal(model.a.shape)
    b = model.b + 0.02 * rng.standard_normal(model.b.shape)
    return model, DifferenceModel(a, b)


def polynomial(blocks, z):
    """Return the sum of blocks[i] z^-i."""
    return sum(block * z**-i for i, block in enumerate(blocks))


def parts(controller, plant, z):
    """Return G, P, L, K_I and 1 - 1/z at one point."""
    found = control_polynomials(controller)
    P, L = polynomial(found.P, z), polynomial(found.L, z)
    return plant.response(z), P, L, found.K_I, 1 - 1 / z


def near(ours, theirs):
    """Return whether two matrices are equal to rounding."""
    size = max(1.0, np.abs(theirs).max())
    return np.abs(ours - theirs).max() < ROUND * size


@pytest.mark.parametrize("z", POINTS)
def test_feedback_transfers_are_those_of_the_polynomials(rng, z):
    """(6.4) closed around another plant: T, S_i and S_o, two inputs and outputs."""
    model, plant = plants(rng)
    controller = wang_young(model, Horizon(12, 4), 1.0, 0.5)
    loop = linear_loop(controller, plant)
    G, P, L, K_I, delta = parts(controller, plant, z)
    I = np.eye(2)  # noqa: E741
    back = G @ np.linalg.inv(delta * L) @ (K_I + delta * P)
    inverse = np.linalg.inv(I + back)
    assert near(loop.transfer("S_o", z), inverse)
    assert near(loop.transfer("S_i", z), inverse @ G)
    assert near(loop.transfer("T", z), inverse @ G @ np.linalg.inv(delta * L) @ K_I)


@pytest.mark.parametrize("z", POINTS)
def test_integral_of_error_transfer_with_preview(rng, z):
    """(4.18): the previewed reference enters through R(z) as well."""
    model, plant = plants(rng)
    controller = integral_of_error(model, Horizon(6, 3), 1.0, 0.5, reference="preview")
    G, P, L, K_I, delta = parts(controller, plant, z)
    R = controller.gain("r").reshape(2, 6, 2).transpose(1, 0, 2)
    ahead = sum(block * z ** (i + 1) for i, block in enumerate(R))
    U = G @ np.linalg.inv(L)
    left = np.eye(2) + U @ (K_I / delta + P)
    expected = np.linalg.solve(left, U @ (K_I / delta - ahead))
    assert near(linear_loop(controller, plant).transfer("T", z), expected)


@pytest.mark.parametrize("seen", [True, False])
@pytest.mark.parametrize("z", POINTS)
def test_forward_path_transfers_are_those_of_6_5_to_6_7(rng, z, seen):
    """Corrected (6.5)-(6.7): (6.6) holds only if the model sees the disturbance."""
    model, plant = plants(rng)
    controller = forward_path(model, Horizon(12, 4), 1.0, 0.5)
    loop = linear_loop(controller, plant, seen=seen)
    S, P, L, K, delta = parts(controller, plant, z)
    inner = np.linalg.inv(L) @ P @ model.response(z)
    middle = np.linalg.inv(np.eye(2) + inner)
    forward = S @ middle @ np.linalg.inv(L) @ K
    inverse = np.linalg.inv(delta * np.eye(2) + forward)
    assert near(loop.transfer("T", z), inverse @ forward)
    assert near(loop.transfer("S_o", z), delta * inverse)
    through = S @ middle if seen else S
    assert near(loop.transfer("S_i", z), delta * inverse @ through)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_transfers_are_those_of_the_simulated_loop(rng, structure):
    """Sum of the impulse response times z^-k, for every structure."""
    model = random_model(rng, 2, 2, 1, 2, 2, 2, radius=0.7)
    plant = random_model(rng, 2, 2, 1, 2, 2, 2, radius=0.7).varied()
    plant = DifferenceModel(model.a + 0.02 * plant.a, model.b + 0.02 * plant.b, model.g)
    controller = STRUCTURES[structure](model, Horizon(10, 3), 1.0, 2.0)
    loop = linear_loop(controller, plant)
    assert loop.radius < 0.97
    N, z = 1200, np.exp(0.5j)
    powers = z ** -np.arange(N)
    for i in range(2):
        pulse = np.zeros((N, 2))
        pulse[0, i] = 1.0
        for which, more in (
            ("T", {"reference": pulse}),
            ("S_i", {"input_disturbance": pulse}),
            ("S_o", {"output_disturbance": pulse}),
        ):
            scenario = Scenario(**{"reference": np.zeros((N, 2)), **more})
            y = closed_loop(plant, controller, scenario).y
            # 0.97 ** 1200 is below rounding, so the cut-off sum is the transform
            found = loop.transfer(which, z)[:, i]
            assert np.abs(powers @ y - found).max() < 1e-8 * (1 + np.abs(found).max())


@pytest.mark.parametrize("structure", STRUCTURES)
def test_no_offset_at_z_equal_one(rng, structure):
    """T(1) = I and S_i(1) = S_o(1) = 0, also on a plant that is not the model."""
    model = random_model(rng, 2, 2, 1, 2, 2, 2, radius=0.7)
    plant = model.varied(numerator=1.05, denominator=1.02)
    loop = linear_loop(STRUCTURES[structure](model, Horizon(10, 3), 1.0, 2.0), plant)
    assert loop.is_stable
    assert near(loop.transfer("T", 1.0), np.eye(2))
    assert near(loop.transfer("S_i", 1.0), np.zeros((2, 2)))
    assert near(loop.transfer("S_o", 1.0), np.zeros((2, 2)))


def test_forward_path_over_an_integrating_model_leaves_an_offset():
    """S_i(1) is not zero for a disturbance that the internal model does not see."""
    tank = DifferenceModel([-1.0], [0.1])
    controller = forward_path(tank, Horizon(15, 4), 1.0, 0.1)
    push = np.full(400, 0.5)
    scenario = Scenario(np.zeros(400), input_disturbance=push)
    offset = closed_loop(tank, controller, scenario).y[-1, 0]
    loop = linear_loop(controller)
    assert loop.transfer("S_i", 1.0)[0, 0] * 0.5 == pytest.approx(offset, rel=1e-6)
    assert abs(offset) > 0.01
    seen = linear_loop(controller, seen=True).transfer("S_i", 1.0)
    assert np.abs(seen).max() < ROUND


def characteristic(model, K):
    """Return (1-z^-1)(a L + P b) + K_I b, powers of z^-1, one input and output."""
    na, nb = model.na, model.nb
    a = np.concatenate([[1.0], model.a.ravel()])
    b = np.concatenate([[0.0], model.b.ravel()])
    P, L = K[:na], np.concatenate([[1.0], K[na : na + nb - 1]])
    both = np.polynomial.polynomial.polyadd(np.convolve(a, L), np.convolve(P, b))
    loop = np.convolve([1.0, -1.0], both)
    return np.polynomial.polynomial.polyadd(loop, K[-1] * b)


@pytest.mark.parametrize("name", ["marginally_stable_6_3_2", "ifac93_6_3_3"])
def test_poles_are_roots_of_the_characteristic_polynomial(name):
    """Feedback: that polynomial; forward path: the same times the model's a."""
    model = case(name).model
    designs = case(name).designs
    K = designs["wang_young"].build().gain("x")[0]
    wanted = np.roots(np.trim_zeros(np.round(characteristic(model, K), 14), "b"))
    feedback = linear_loop(designs["wang_young"].build()).poles
    forward = linear_loop(designs["forward_path"].build())
    for pole in wanted:
        assert np.abs(feedback - pole).min() < 1e-6
        assert np.abs(forward.poles - pole).min() < 1e-6
    own = model.poles()[np.abs(model.poles()) > 1e-6]
    assert np.sort_complex(forward.hidden_modes) == pytest.approx(
        np.sort_complex(own), abs=1e-6
    )
    # all others are histories: at the origin, spread by rounding of a repeated root
    rest = [p for p in feedback if np.abs(wanted - p).min() > 1e-6]
    assert np.abs(rest).max(initial=0.0) < 0.01


def test_marginal_loop_is_not_called_stable():
    """Hidden modes on the unit circle make a loop unstable, whatever rounding says."""
    loop = linear_loop(case("marginally_stable_6_3_2").designs["forward_path"].build())
    assert loop.radius == pytest.approx(1.0, abs=1e-9)
    assert not loop.is_stable


def test_governed_and_proportional_laws_have_the_same_loop():
    """A governor that does nothing leaves the poles of its gain: 0.2 twice."""
    example = case("governor_3_4")
    K = example.designs["pip"].options["K"]
    limits = example.designs["governor"].limits
    governed = linear_loop(governor(example.model, K, 10, limits))
    plain = linear_loop(pip(example.model, K, law="positional"))
    for loop in (governed, plain):
        slow = loop.poles[np.abs(loop.poles) > 0.1]
        assert slow == pytest.approx([0.2, 0.2], abs=1e-6)  # a double root
        assert np.abs(loop.transfer("T", 1.0) - 1.0).max() < ROUND
    z = np.exp(0.4j)
    assert near(governed.transfer("T", z), plain.transfer("T", z))


def test_frequency_response_uses_the_sampling_interval(rng):
    """Frequencies are in rad/s: z = exp(j omega dt)."""
    model = DifferenceModel([-0.9], [0.1], dt=0.5)
    loop = linear_loop(wang_young(model, Horizon(10, 3), 1.0, 0.1))
    omega = np.array([0.1, 1.0, 3.0])
    response = loop.frequency_response("T", omega)
    assert response.shape == (3, 1, 1)
    single = [loop.transfer("T", np.exp(0.5j * w)) for w in omega]
    assert response == pytest.approx(np.array(single), rel=ALGEBRA)


@pytest.mark.parametrize("structure", ["wang_young", "integral_of_error"])
def test_poles_of_a_loop_at_rest_under_the_terminal_equality(structure):
    """Equalities always hold, so the linear law is the loop that runs."""
    model = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
    controller = STRUCTURES[structure](
        model, Horizon(10, 8), 1.0, 0.1, terminal="equality"
    )
    run = closed_loop(model, controller, Scenario(np.ones(60)))
    loop = linear_loop(controller)
    assert loop.radius < 0.9
    assert run.y[-1, 0] == pytest.approx(1.0, abs=1e-6)
    assert (run.status == 0).all()
    assert np.abs(run.trail("y")[:, -3:, 0] - 1.0).max() < REPLAY * 100  # ten solves


# The review


def topics(found, verdict):
    """Return the topics of the findings with that verdict."""
    return {finding.topic for finding in found.findings if finding.verdict == verdict}


def test_review_of_a_good_design_is_good():
    """Nothing bad on the IFAC'93 design, and printing gives a line a finding."""
    found = review(case("ifac93_6_3_3").designs["wang_young"].build())
    assert found.is_good
    assert len(str(found).splitlines()) == len(found.findings)
    assert {"stability", "offset", "conditioning", "horizon"} <= topics(found, "good")


def test_review_finds_the_unstable_nominal_gasifier():
    """ERRATA on 6.3.4: the printed horizons give a pole at 1.0283."""
    longer = case("gasifier_6_3_4").designs["wang_young"]
    printed = dataclasses.replace(longer, horizon=Horizon(20, 7))
    found = review(printed.build())
    sentence = next(f.sentence for f in found.findings if f.topic == "stability")
    assert "unstable, largest pole 1.028" in sentence
    assert "zeros" in topics(found, "note")


def test_review_names_hidden_modes_and_fixed_poles():
    """Modes on the unit circle are bad, a common factor is worth a note."""
    forward = case("marginally_stable_6_3_2").designs["forward_path"].build()
    assert {"stability", "hidden modes"} <= topics(review(forward), "bad")
    factor = review(case("measured_disturbance_7_4_1").designs["wang_young"].build())
    sentence = next(f.sentence for f in factor.findings if f.topic == "controllability")
    assert "reaches 3 of 4" in sentence
    assert "0.9" in sentence


def test_review_sees_a_horizon_that_ends_in_the_dead_time():
    """The prediction must see what an input does."""
    late = DifferenceModel([-0.8], [0.0, 0.0, 0.0, 0.0, 0.2], y_names=["level"])
    short = wang_young(late, Horizon(4, 2), 1.0, 0.1)
    sentence = next(f for f in review(short).findings if f.topic == "horizon")
    assert sentence.verdict == "bad"
    assert "level (5 samples)" in sentence.sentence
    assert "horizon" in topics(review(wang_young(late, Horizon(5, 2), 1, 0.1)), "good")


@pytest.mark.parametrize(("moves", "is_said"), [(3, True), (4, False)])
def test_review_says_when_a_terminal_equality_cannot_be_met(moves, is_said):
    """Plant (6.10) needs four conditions, so three moves are too few."""
    model = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
    horizon = Horizon(moves, moves)
    design = wang_young(model, horizon, 1.0, 1.0, terminal="equality")
    found = [f for f in review(design).findings if f.topic == "terminal"]
    assert bool(found) == is_said
    assert all("4 conditions" in f.sentence and "meet 3" in f.sentence for f in found)


def test_review_finds_limits_that_contradict_each_other():
    """An output that no allowed input can hold, in the output's unit."""
    model = DifferenceModel([-0.9], [0.1], units={"y1": "degC"})
    limits = Limits(u=(0.0, 1.0), y=(2.0, 3.0))
    found = review(wang_young(model, Horizon(10, 3), 1.0, 0.1, limits))
    assert "limits" in topics(found, "bad")
    assert "from 0 to 1 degC" in str(found)


def test_review_says_what_is_left_out_and_how_the_reference_is_read():
    """Rows that no decision moves, and the readings of the integral of the error."""
    model = DifferenceModel([-0.9], [0.1])
    K = lq_gain(model, 1.0, 1.0)
    printed = governor(model, K, 5, Limits(u=(-1, 1)), reference="preview")
    assert "No decision moves u1 at step 0" in str(review(printed))
    for reading, words in (("held", "overshoots"), ("zero", "expects a reference")):
        design = integral_of_error(model, Horizon(8, 3), 1, 1, reference=reading)
        assert words in str(review(design))


def test_review_of_an_observer_on_another_plant():
    """A plant may be given; its sizes are checked."""
    model = DifferenceModel([-0.9], [0.1])
    controller = minimal(model, Horizon(10, 3), 1.0, 0.1)
    assert review(controller, model.varied(numerator=1.2)).is_good
    assert not review(controller, model.varied(numerator=-1.0)).is_good
    with pytest.raises(ValueError, match="2 outputs and 2 inputs"):
        review(controller, DifferenceModel(0.5 * np.eye(2)[None], np.eye(2)[None]))


def test_what_has_no_polynomials_says_so():
    """An observer's state is not made of past outputs and inputs."""
    controller = minimal(DifferenceModel([-0.9], [0.0, 0.1]), Horizon(8, 3), 1.0, 0.1)
    with pytest.raises(ValueError, match="no polynomials"):
        control_polynomials(controller)
    with pytest.raises(ValueError, match='which = "S"'):
        linear_loop(controller).transfer("S", 1.0)


# --- Gains over frequency ------------------------------------------------------------


def reaches(A, B, C, D, gain):
    """Return whether a singular value equals ``gain`` at some frequency.

    It does where a symplectic pencil has eigenvalues on the unit circle.
    """
    R = np.linalg.inv(gain**2 * np.eye(B.shape[1]) - D.T @ D)
    drift = A + B @ R @ D.T @ C
    weight = C.T @ (np.eye(len(C)) + D @ R @ D.T) @ C
    I, O = np.eye(len(A)), np.zeros_like(A)  # noqa: E741
    left = np.block([[drift, B @ R @ B.T], [O, I]])
    right = np.block([[I, O], [weight, drift.T]])
    found = np.abs(scipy.linalg.eigvals(left, right))
    return bool((np.abs(found - 1.0) < 1e-7).any())


@pytest.mark.parametrize("structure", STRUCTURES)
@pytest.mark.parametrize("which", ["S_i", "S_o", "T_o"])
def test_peak_is_the_norm_of_the_transfer(rng, structure, which):
    """Some frequency reaches a little less, none a little more."""
    model = random_model(rng, 2, 2, 1, 2, 2, 2, radius=0.8)
    plant = model.varied(numerator=1.1, denominator=0.98)
    loop = linear_loop(STRUCTURES[structure](model, Horizon(10, 3), 1.0, 0.5), plant)
    B, D = {
        "S_i": (loop.B_u, np.zeros((2, 2))),
        "S_o": (loop.B_y, np.eye(2)),
        "T_o": (-loop.B_y, np.zeros((2, 2))),
    }[which]
    gain, omega = loop.peak(which)
    A, B, C = minimal_realisation(loop.A, B, loop.C)
    # the ends of the frequency axis are approached, not reached
    assert reaches(A, B, C, D, gain * (1 - 1e-4))
    assert not reaches(A, B, C, D, gain * (1 + 1e-4))
    at_peak = loop.singular_values(which, np.array([omega]))[0, 0]
    assert at_peak == pytest.approx(gain, rel=ROUND)


@pytest.mark.parametrize("name", ["shell_5_3_2", "wood_berry", "gasifier_6_3_4"])
def test_response_over_frequency_is_that_at_each_point(name):
    """One triangular form for all frequencies, and one solution a frequency, agree."""
    example = case(name)
    for design in example.designs.values():
        loop = linear_loop(design.build(), example.plant)
        omega = np.geomspace(1e-4, 1.0, 15) * np.pi / loop.dt
        for which in ("T", "S_i", "S_o", "T_o"):
            found = loop.frequency_response(which, omega)
            points = np.exp(1j * omega * loop.dt)
            wanted = np.stack([loop.transfer(which, z) for z in points])
            assert near(found, wanted)
            sizes = np.linalg.norm(wanted, 2, axis=(1, 2))
            assert near(loop.singular_values(which, omega)[:, 0], sizes)


def test_sensitivity_and_its_complement_add_up(rng):
    """S_o + T_o = I, at any point."""
    model, plant = plants(rng)
    loop = linear_loop(forward_path(model, Horizon(12, 4), 1.0, 0.5), plant)
    for z in POINTS:
        total = loop.transfer("S_o", z) + loop.transfer("T_o", z)
        assert near(total, np.eye(2))


def test_modes_on_the_circle_count_where_they_are_seen():
    """A forward path over (6.10): S_o is finite, an input disturbance never ends."""
    model = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
    loop = linear_loop(forward_path(model, Horizon(20, 5), 1 / 20, 1 / 5))
    assert not loop.is_stable
    assert loop.comes_to_rest("S_o")
    assert loop.peak("S_o").gain < 3.0
    assert not loop.comes_to_rest("S_i")
    gain, omega = loop.peak("S_i")
    assert gain == np.inf
    assert omega == pytest.approx(np.arccos(0.85))  # z^2 - 1.7 z + 1 = 0
    assert loop.offset("S_o") < ROUND
    assert loop.offset("S_i") == np.inf


def test_offset_is_what_a_long_run_leaves():
    """An integrator behind a forward path: a constant push leaves a constant error."""
    tank = DifferenceModel([-1.0], [0.1])
    controller = forward_path(tank, Horizon(15, 4), 1.0, 0.1)
    push = Scenario(np.zeros(400), input_disturbance=np.ones(400))
    left = closed_loop(tank, controller, push).y[-1, 0]
    assert linear_loop(controller).offset("S_i") == pytest.approx(abs(left), rel=1e-6)
    assert linear_loop(controller).offset("T") < ROUND
