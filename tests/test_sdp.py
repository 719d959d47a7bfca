"""State-dependent PIP control and its governor: section 8.5.1 and linear plants."""

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from conftest import DECISION, REPLAY
from strategies import SIZES, random_model

from nmss_lab.controller import Limits, Status
from nmss_lab.governor import governor
from nmss_lab.models import DifferenceModel
from nmss_lab.pip import lq_gain, pip, pole_gain
from nmss_lab.sdp import sdp_governor, sdp_pip
from nmss_lab.simulate import Scenario, closed_loop
from nmss_lab.state_dependent import StateDependentModel

GOLDEN = json.loads(
    (Path(__file__).parent / "golden" / "state_dependent.json").read_text()
)

BILINEAR = StateDependentModel([-0.7], ["y[k-2]"])
"""The plant (8.11)."""

HALF = Limits(u=(-0.5, 0.5))
DEADBEAT = (0.0, 0.0)


def step(controller, samples, after=3, **scenario):
    """Step from 1 to 2, from rest at u = 0.3."""
    r = np.where(np.arange(samples) < after, 1.0, 2.0)
    return closed_loop(BILINEAR, controller, Scenario(r, y0=1.0, u0=0.3, **scenario))


# The independent computation


@pytest.mark.parametrize(
    ("name", "build", "after"),
    [
        ("unc_ks1_pos_z0_1", lambda: sdp_pip(BILINEAR, DEADBEAT), 1),
        ("con_noRG_ks3_virt_z0_0", lambda: sdp_pip(BILINEAR, DEADBEAT, limits=HALF), 3),
        (
            "con_noRG_ks3_naive_z0_0",
            lambda: sdp_pip(BILINEAR, DEADBEAT, limits=HALF, law="incremental"),
            3,
        ),
        (
            "RG_frozen_ks3",
            lambda: sdp_governor(
                BILINEAR, DEADBEAT, Np=3, limits=HALF, reference="preview"
            ),
            3,
        ),
    ],
)
def test_section_8_5_1_is_the_independent_computation(name, build, after):
    """With its gain for each sample; the governor to the solver's accuracy."""
    golden = GOLDEN[name]
    run = step(build(), len(golden["y"]), after)
    close = DECISION if "RG" in name else REPLAY
    for signal in ("y", "u", "w"):
        if signal in golden:
            found = getattr(run, signal)[:, 0]
            assert found == pytest.approx(np.array(golden[signal]), abs=close), signal


def test_deadbeat_in_two_samples_without_limits():
    """The claim of section 8.5.1, for a step in any direction."""
    for target in (2.0, 1.5, 0.7):
        r = np.where(np.arange(10) < 2, 1.0, target)
        run = closed_loop(
            BILINEAR, sdp_pip(BILINEAR, DEADBEAT), Scenario(r, y0=1.0, u0=0.3)
        )
        assert run.y[4:, 0] == pytest.approx(np.full(6, target), abs=REPLAY)


def test_the_governor_reaches_the_reference_and_keeps_the_limit():
    """Both readings of the reference."""
    for reference in ("held", "preview"):
        c = sdp_governor(BILINEAR, DEADBEAT, Np=3, limits=HALF, reference=reference)
        run = step(c, 40)
        assert np.abs(run.u).max() <= 0.5 + 1e-12
        assert run.y[-1] == pytest.approx([2.0], abs=1e-3)  # approaches slowly
        assert run.y.max() <= 2.0 + DECISION
        assert (run.status <= Status.LIMITED).all(), run.sentences


# Where the gain is lost


def test_a_lost_gain_is_guarded():
    """The printed start z = 0 leads to y = 0, where the input has no effect."""
    run = step(sdp_pip(BILINEAR, DEADBEAT), 20, 20, z0=0.0)
    guarded = run.status == Status.GUARDED
    assert guarded.any(), run.sentences
    assert np.isfinite(run.u).all()
    assert np.isfinite(run.y).all()
    held = np.flatnonzero(guarded)
    before = np.concatenate([[0.3], run.u[:-1, 0]])
    assert run.u[held, 0] == pytest.approx(before[held], abs=REPLAY)


@pytest.mark.parametrize("law", ["positional", "incremental"])
@pytest.mark.parametrize("largest", [0.5, 5.0, 1e3])
def test_the_largest_gain_is_where_the_guard_begins(largest, law):
    """Entries 0.7/y and 1/y: below y = 1/largest the input is held."""
    c = sdp_pip(BILINEAR, DEADBEAT, law=law, largest_gain=largest)
    for y, guarded in ((0.9 / largest, True), (1.1 / largest, False)):
        memory = c.start(y0=y, u0=0.3, z0=0.0)
        move = c.decide(c.measure(memory, np.array([y]), np.array([y])))
        assert (move.status == Status.GUARDED) == guarded
        assert not guarded or move.u == pytest.approx([0.3])


def test_the_governor_guards_too():
    """And nothing that is not finite is remembered."""
    c = sdp_governor(BILINEAR, DEADBEAT, Np=3, limits=HALF)
    run = closed_loop(BILINEAR, c, Scenario(np.ones(6), y0=0.0, u0=0.2))
    assert (run.status == Status.GUARDED).all()
    assert run.u[:, 0] == pytest.approx(np.full(6, 0.2))
    assert np.isfinite(run.moves.known).all()
    assert np.isfinite(run.trail("y")).all()


# Constant coefficients


def linear(rng, sizes):
    """Random model as a difference equation and as a state-dependent one."""
    n_y, n_u, _, na, nb, _ = sizes
    plant = random_model(rng, n_y, n_u, 0, na, nb, radius=0.8)
    return plant, StateDependentModel(plant.a.tolist(), plant.b.tolist())


def disturbed(n_y, n_u):
    """Step, and unmeasured constant disturbances."""
    k = np.arange(40)[:, None]
    return Scenario(
        np.where(k < 5, 0.0, 1.0) * np.ones(n_y),
        output_disturbance=np.where(k < 20, 0.0, 0.3) * np.ones(n_y),
        input_disturbance=np.where(k < 30, 0.0, 0.1) * np.ones(n_u),
    )


SQUARE = [s for s in SIZES if s[0] == s[1] and s[2] == 0] + [(2, 2, 0, 2, 3, 0)]


@pytest.mark.parametrize("sizes", [*SQUARE, (1, 2, 0, 2, 2, 0)])
@pytest.mark.parametrize("law", ["positional", "incremental"])
def test_constant_coefficients_are_pip(sizes, law, rng):
    """The same gain at each sample, limits active."""
    plant, model = linear(rng, sizes)
    limits = Limits(u=(-0.5, 0.5), du=(-0.2, 0.2))
    K = lq_gain(plant, 1.0, 0.1)
    scenario = disturbed(plant.n_y, plant.n_u)
    wanted = closed_loop(plant, pip(plant, K, limits, law), scenario)
    found = closed_loop(
        plant, sdp_pip(model, Q=1.0, R=0.1, limits=limits, law=law), scenario
    )
    assert (wanted.status == Status.CLIPPED).any()
    assert np.abs(found.u - wanted.u).max() <= REPLAY * (1.0 + np.abs(K).max())
    assert (found.status == wanted.status).all()


def test_constant_coefficients_with_poles_are_pip(rng):
    """Poles of a single loop."""
    plant = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
    model = StateDependentModel([-1.7, 1.0], [-1.0, 2.0])
    poles = (0.0, 0.0, 0.2, 0.2)
    scenario = disturbed(1, 1)
    wanted = closed_loop(plant, pip(plant, pole_gain(plant, poles)), scenario)
    found = closed_loop(plant, sdp_pip(model, poles, law="incremental"), scenario)
    assert found.u == pytest.approx(wanted.u, abs=DECISION)


@pytest.mark.parametrize("sizes", SQUARE)
@pytest.mark.parametrize("reference", ["held", "preview"])
@pytest.mark.parametrize("outputs", ["hard", "priority"])
def test_constant_coefficients_are_the_governor(sizes, reference, outputs, rng):
    """Limits on input, rate and output."""
    plant, model = linear(rng, sizes)
    limits = Limits(u=(-0.6, 0.6), du=(-0.2, 0.2), y=(-3.0, 3.0), outputs=outputs)
    K = lq_gain(plant, 1.0, 0.1)
    scenario = disturbed(plant.n_y, plant.n_u)
    a = governor(plant, K, 8, limits, reference)
    b = sdp_governor(model, Q=1.0, R=0.1, Np=8, limits=limits, reference=reference)
    wanted, found = (closed_loop(plant, c, scenario) for c in (a, b))
    assert (wanted.status == Status.LIMITED).any()
    assert np.abs(found.u - wanted.u).max() <= DECISION
    assert np.abs(found.w - wanted.w).max() <= DECISION * (1 + np.abs(wanted.w).max())
    assert (found.status == wanted.status).all()
    for name in ("u", "du", "y", "w", "beta"):
        trail = wanted.trail(name)
        close = DECISION * (1.0 + np.abs(trail).max())
        assert np.abs(found.trail(name) - trail).max() <= close, name


def test_more_past_values_than_the_gain_reads():
    """Coefficients with lags beyond na and nb leave the thesis state as it is."""
    model = StateDependentModel(
        ["-0.7 + 0*y[k-4]"], ["1 + 0*u[k-3]", 0.3], constants={}
    )
    plant = DifferenceModel([-0.7], [1.0, 0.3])
    poles = (0.2, 0.3, 0.1)
    scenario = disturbed(1, 1)
    wanted = closed_loop(
        plant, pip(plant, pole_gain(plant, poles), law="positional"), scenario
    )
    found = closed_loop(plant, sdp_pip(model, poles), scenario)
    assert found.u == pytest.approx(wanted.u, abs=DECISION)


# In use


def test_a_measurement_that_is_no_number_is_replaced():
    """The equation stands in for it."""
    noise = np.zeros(20)
    noise[7] = np.nan
    plain, found = (
        step(sdp_pip(BILINEAR, DEADBEAT), 20),
        step(sdp_pip(BILINEAR, DEADBEAT), 20, noise=noise),
    )
    assert found.status[7] == Status.REFUSED
    assert found.u == pytest.approx(plain.u, abs=REPLAY)


@pytest.mark.parametrize("law", ["positional", "incremental"])
def test_manual_operation_and_back_without_a_bump(law):
    """By hand to another rest, then on from there."""
    manual = np.full(60, np.nan)
    manual[5:40] = 0.3
    r = np.ones(60)
    c = sdp_pip(BILINEAR, (0.5, 0.5), limits=HALF, law=law)
    run = closed_loop(BILINEAR, c, Scenario(r, y0=1.0, u0=0.3, manual=manual))
    assert np.abs(run.u - 0.3).max() <= REPLAY


@pytest.mark.parametrize("kind", ["pip", "governor"])
def test_nothing_winds_up(kind):
    """A reference out of reach for 60 samples, then back."""
    limits = Limits(u=(-0.31, 0.31))
    c = {
        "pip": lambda: sdp_pip(BILINEAR, (0.5, 0.5), limits=limits),
        "governor": lambda: sdp_governor(BILINEAR, (0.5, 0.5), Np=10, limits=limits),
    }[kind]()
    k = np.arange(110)
    r = np.where((k >= 5) & (k < 65), 30.0, 1.0)
    run = closed_loop(BILINEAR, c, Scenario(r, y0=1.0, u0=0.3))
    assert run.u[60] == pytest.approx([0.31], abs=1e-6)
    assert run.u[66] < 0.31 - 1e-3
    assert np.abs(run.y[90:] - 1.0).max() <= 1e-2
    assert np.abs(run.u).max() <= 0.31 + 1e-12


@pytest.mark.parametrize("build", [sdp_pip, sdp_governor])
def test_use_and_pickle_change_nothing(build):
    """The same numbers again, and from a copy."""
    c = build(BILINEAR, DEADBEAT, limits=HALF)
    first, second = step(c, 15), step(pickle.loads(pickle.dumps(c)), 15)
    assert np.array_equal(first.u, second.u)
    assert np.array_equal(first.u, step(c, 15).u)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "give either poles, or both weights Q and R"),
        ({"Q": 1.0}, "give either poles"),
        ({"poles": DEADBEAT, "Q": 1.0, "R": 1.0}, "give either poles"),
        ({"poles": (0.0,)}, r"poles has shape \(1,\), expected \(2,\)"),
        ({"poles": (0.1j, 0.2)}, "conjugate pairs"),
        ({"poles": DEADBEAT, "largest_gain": 0.0}, "largest_gain = 0.0"),
        ({"Q": [1.0, 2.0, 3.0], "R": 1.0}, "Q has shape"),
        ({"Q": 1.0, "R": -1.0}, "R has the eigenvalue"),
        ({"poles": DEADBEAT, "limits": Limits(u=([-1, -1], [1, 1]))}, "limits on u"),
        ({"poles": DEADBEAT, "model": DifferenceModel([-0.7], [1.0])}, "model"),
    ],
)
@pytest.mark.parametrize("build", [sdp_pip, sdp_governor])
def test_mistakes_name_the_argument(build, arguments, message):
    """When the controller is built, not in the loop or never."""
    options = {"model": BILINEAR, **arguments}
    with pytest.raises(ValueError, match=message):
        build(**options)


@pytest.mark.parametrize("poles", [(1.2, 0.0), (1.0, 0.0)])
def test_a_governor_needs_stable_poles(poles):
    """As for a linear plant, but from the poles: when it is built."""
    with pytest.raises(ValueError, match=r"poles.*1\.[02]"):
        sdp_governor(BILINEAR, poles, limits=HALF)


@pytest.mark.parametrize(
    ("build", "options", "message"),
    [
        (sdp_pip, {"law": "other"}, 'law = "other"'),
        (sdp_governor, {"reference": "next"}, 'reference = "next"'),
        (sdp_governor, {"backend": "magic"}, 'backend = "magic"'),
        (sdp_governor, {"Np": 0}, "Np = 0"),
    ],
)
def test_options_are_checked(build, options, message):
    """Names and ranges."""
    with pytest.raises(ValueError, match=message):
        build(BILINEAR, DEADBEAT, **options)


def test_no_linear_law_is_claimed():
    """The message says what to do instead."""
    for build in (sdp_pip, sdp_governor):
        with pytest.raises(ValueError, match="analyse it by simulation"):
            build(BILINEAR, DEADBEAT).free_law()
