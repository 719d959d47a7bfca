"""The reference governor: section 3.4, its three readings, and what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import DECISION, REPLAY
from strategies import random_model

from nmss_lab.controller import Limits, Status
from nmss_lab.governor import governor
from nmss_lab.models import DifferenceModel
from nmss_lab.pip import lq_gain, pip, pole_gain
from nmss_lab.simulate import Scenario, closed_loop

MODEL = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
K = pole_gain(MODEL, [0.0, 0.0, 0.2, 0.2])
LIMITS = Limits(u=(-2.0, 2.0), du=(-0.5, 0.5))
REFERENCE = np.repeat([0.0, 5.0, -5.0], [5, 26, 29])
GOLDEN = json.loads(
    (Path(__file__).parent / "golden" / "governor_3_4.json").read_text()
)


def run(Np=10, limits=LIMITS, r=REFERENCE, **options):
    """Run the loop of section 3.4 under a governor."""
    c = governor(MODEL, K, Np, limits, **options)
    return closed_loop(MODEL.plant(), c, Scenario(r))


def large(y):
    """Return the samples from the large step on."""
    return y[31:, 0]


@pytest.mark.parametrize("Np", [3, 10])
def test_section_3_4_is_the_independent_computation(Np):
    """Trajectory values of another program, with the printed gain."""
    printed = np.array([[3.16, -3.05, 6.10, -0.64]])
    c = governor(MODEL, printed, Np, LIMITS)
    found = closed_loop(MODEL.plant(), c, Scenario(REFERENCE))
    wanted = GOLDEN[f"governor_Np{Np}"]
    y = found.y[:, 0]
    # the file holds five or six digits
    assert y[5:31].max() == pytest.approx(wanted["small_max"], abs=1e-5)
    assert y[31:].min() == pytest.approx(wanted["large_min"], abs=1e-5)
    assert y[10] == pytest.approx(wanted["y10"], abs=1e-5)
    assert y[40] == pytest.approx(wanted["y40"], abs=1e-5)
    assert np.abs(found.r - found.y).sum() == pytest.approx(wanted["IAE"], abs=1e-6)


def test_limits_hold_and_the_reference_is_reached():
    """The governor comes back to the reference; the plain law swings for long."""
    found = run()
    assert np.abs(found.u).max() <= 2.0 + 1e-12
    assert np.abs(found.du).max() <= 0.5 + 1e-12
    assert found.y[-1] == pytest.approx([-5.0], abs=1e-3)
    plain = closed_loop(MODEL.plant(), pip(MODEL, K, LIMITS), Scenario(REFERENCE))
    assert np.abs(plain.y - plain.r).sum() > 1.5 * np.abs(found.y - found.r).sum()


def test_ten_and_thirty_steps_are_the_same():
    """The claim of section 3.4; from six steps on nothing changes."""
    ten, thirty = run(10), run(30)
    assert ten.y == pytest.approx(thirty.y, abs=DECISION)
    assert np.abs(run(3).y - ten.y).max() > 0.1


def test_governed_reference_is_reference_plus_perturbation():
    """Equation (3.6), w = r + beta, in the run and in the trail."""
    found = run()
    beta, w = found.trail("beta"), found.trail("w")
    assert found.w == pytest.approx(found.r + beta[:, 0], abs=REPLAY)
    assert w == pytest.approx(found.r[:, None] + beta, abs=REPLAY)
    assert np.abs(beta).max() > 1.0


def test_perturbation_is_the_smallest_that_keeps_the_limits():
    """The cost of the sample is beta'beta; a smaller multiple breaks a limit."""
    c = governor(MODEL, K, 10, LIMITS)
    found = closed_loop(MODEL.plant(), c, Scenario(REFERENCE))
    for k in np.flatnonzero(found.status == Status.LIMITED):
        beta = found.moves.decision[k]
        assert found.cost[k] == pytest.approx(beta @ beta, rel=1e-9)
        less = c.program.room(0.99 * beta, found.moves.known[k])
        assert less.min() < 0.0


def test_input_follows_the_gain_on_the_governed_reference():
    """The law u = -K x with w in the sum of the error, whatever the limits do."""
    found = run()
    z, ys, us = 0.0, [0.0, 0.0], [0.0]
    for k in range(len(found)):
        ys.append(found.y[k, 0])
        z += found.w[k, 0] - found.y[k, 0]
        u = -K[0] @ [ys[-1], ys[-2], us[-1], z]
        assert found.u[k, 0] == pytest.approx(u, abs=1e-5), f"k = {k}"
        us.append(found.u[k, 0])


def test_forcing_the_perturbation_to_zero_needs_enough_free_moves():
    """Section 3.3: seven free moves are enough in the example, five are not."""
    enough = run(20, free_until=7)
    assert (enough.status <= Status.LIMITED).all()
    assert enough.y[-1] == pytest.approx([-5.0], abs=1e-3)
    assert not enough.trail("beta")[:, 7:].any()
    few = run(20, free_until=5)
    assert (few.status > Status.LIMITED).any()
    assert np.abs(few.u).max() <= 2.0 + 1e-12
    assert np.isfinite(few.y).all()


@pytest.mark.parametrize("decay", [0.5, 0.7, 0.9])
def test_decaying_perturbation_keeps_tracking(decay):
    """Section 3.3: the perturbation fades along the plan."""
    found = run(20, decay=decay)
    assert found.y[-1] == pytest.approx([-5.0], abs=1e-2)
    beta, z = found.trail("beta")[..., 0], found.moves.decision
    assert beta == pytest.approx(z * decay ** np.arange(20), abs=REPLAY)


def test_output_limits_give_way_and_input_limits_do_not():
    """An output limit below the reference cannot be kept for ever; inputs stay put."""
    limits = Limits(u=(-2.0, 2.0), du=(-0.5, 0.5), y=(-6.0, 5.2))
    found = run(limits=limits)
    assert np.abs(found.u).max() <= 2.0 + 1e-12
    assert found.y.max() <= 5.2 + 1e-5


@pytest.mark.parametrize("outputs", ["hard", "soft", "priority"])
def test_input_rows_are_kept_exactly_whatever_becomes_of_outputs(outputs):
    """Only output limits are soft: the applied input is the planned one."""
    limits = Limits(u=(-2.0, 2.0), du=(-0.5, 0.5), y=(-7.0, 7.0), outputs=outputs)
    found = run(limits=limits)
    planned = found.trail("u")[:, 0]
    assert found.u == pytest.approx(planned, abs=DECISION)
    assert np.abs(planned).max() <= 2.0 + DECISION


def test_printed_timing_leaves_out_and_reports_the_rows_of_u_k():
    """(3.12): a perturbation chosen now cannot move the present input."""
    c = governor(MODEL, K, 6, LIMITS, reference="preview")
    assert {(row.name, row.step) for row in c.program.left_out} == {("u", 0), ("du", 0)}
    assert c.preview == 6


def test_several_outputs(rng):
    """A perturbation each, limits respected, references reached."""
    model = random_model(rng, 2, 2, 0, 2, 2, radius=0.8)
    gain = lq_gain(model, 1.0, 0.1)
    limits = Limits(u=(-3.0, 3.0), du=(-0.2, 0.2))
    c = governor(model, gain, 15, limits)
    target = model.steady_state_gain() @ np.array([0.8, -0.6])
    found = closed_loop(model.plant(), c, Scenario(np.tile(target, (120, 1))))
    assert (found.status == Status.LIMITED).any()
    assert (np.abs(found.du) <= 0.2 + 1e-12).all()
    assert found.y[-1] == pytest.approx(target, abs=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"K": np.zeros((1, 4))}, "K does not stabilise .* modulus 1.0000"),
        ({"K": np.zeros((1, 3))}, r"K has shape \(1, 3\), expected \(1, 4\)"),
        ({"K": np.full((1, 4), np.nan)}, "K holds entries that are not finite"),
        ({"free_until": 0}, "free_until = 0: expected 1 to Np = 10"),
        ({"free_until": 11}, "free_until = 11"),
        ({"decay": 0.0}, "decay = 0.0: expected a number"),
        ({"reference": "next"}, 'reference = "next": expected "held" or "preview"'),
        ({"backend": "magic"}, 'backend = "magic"'),
    ],
)
def test_mistakes_are_refused(arguments, message):
    """The argument at fault is named."""
    options = {"K": K, **arguments}
    with pytest.raises(ValueError, match=message):
        governor(MODEL, options.pop("K"), 10, LIMITS, **options)


def test_perturbations_that_fade_at_once_leave_a_sound_program():
    """Columns that fade to nothing are left out, so the solver is not led astray."""
    model = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
    K = pole_gain(model, [0.0, 0.0, 0.2, 0.2])
    made = governor(model, K, 80, Limits(u=(-2, 2), du=(-0.5, 0.5)), decay=0.05)
    assert made.n_z == 5  # 0.05 ** 4 is still above a millionth
    run = closed_loop(model, made, Scenario(np.repeat([0.0, 3.0], 30)))
    assert not np.isin(run.status, [Status.SHIFTED, Status.HELD]).any()
