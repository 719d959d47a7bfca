"""Predictive designs that feel like a given PIP loop."""

import dataclasses

import numpy as np
import pytest
from conftest import DECISION
from strategies import relative

import nmss_lab as lab
from nmss_lab.matching import EXACT
from nmss_lab.nmss import integral_of_error_form

MODEL = lab.DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
"""Plant (6.10)."""

LAG = lab.DifferenceModel([-0.9055], [0.0, 0.0946])
"""Model (4.23)."""

TWO = lab.DifferenceModel(
    [np.diag([-0.8, -0.9])],
    [[[0.5, 0.1], [0.2, 0.4]], [[0.1, 0.0], [0.0, 0.1]]],
)

GAINS = {
    "poles of 6.3.2": (MODEL, lab.pole_gain(MODEL, [0, 0.5, 0.4 + 0.3j, 0.4 - 0.3j])),
    "LQ": (LAG, lab.lq_gain(LAG, [1.0, 0.1, 0.2], 0.3)),
    "poles of a lag": (LAG, lab.pole_gain(LAG, [0.0, 0.7 + 0.1j, 0.7 - 0.1j])),
    "two inputs, LQ": (TWO, lab.lq_gain(TWO, np.diag([1, 1, 0.1, 0.1, 0.1, 0.1]), 1.0)),
}


def design(model: lab.DifferenceModel, structure: str = "integral_of_error", **more):
    """Return a design that follows the reference as PIP does."""
    reading = "zero" if structure == "integral_of_error" else "held"
    horizon = lab.Horizon(6, 6)
    return lab.Design(structure, model, horizon, 1.0, 0.1, reference=reading, **more)


def steps(model: lab.DifferenceModel, samples: int = 40) -> lab.Scenario:
    """Return a step of every reference and, later, one of every input."""
    push = np.zeros((samples, model.n_u))
    push[samples // 2 :] = 0.2
    reference = np.ones((samples, model.n_y)) * (1.0 + np.arange(model.n_y))
    return lab.Scenario(reference, input_disturbance=push)


@pytest.mark.parametrize("name", GAINS)
def test_the_law_is_found(name: str) -> None:
    """Without limits the matched design moves as the PIP loop does."""
    model, K = GAINS[name]
    found = lab.match(K, design(model))
    assert found.is_exact
    assert found.distance <= EXACT
    wanted, ours = (
        lab.closed_loop(model, controller, steps(model))
        for controller in (lab.pip(model, K), found.design.build())
    )
    # The law is equal to 1e-6 of its size, and these loops are well damped.
    assert relative(ours.u, wanted.u) < 10.0 * EXACT
    assert relative(ours.y, wanted.y) < 10.0 * EXACT
    # The same poles but for those at the origin, which histories add.
    first, second = (np.poly(p) for p in (found.poles, found.wanted_poles))
    size = max(len(first), len(second))
    first, second = (np.pad(p, (0, size - len(p))) for p in (first, second))
    assert np.abs(first - second).max() < 100.0 * EXACT


def test_increments_are_matched() -> None:
    """The law of 6.3.2 is also one that weighs changes of the input."""
    model, K = GAINS["poles of 6.3.2"]
    found = lab.match(K, design(model, "wang_young"))
    assert found.is_exact
    law = lab.control_polynomials(found.design.build())
    assert pytest.approx(-K[:, -1:], abs=10.0 * EXACT) == law.K_I


def test_the_horizon_does_not_matter_for_an_optimal_law() -> None:
    """The weight at the end stands for all that follows it."""
    model, K = GAINS["LQ"]
    for steps_ahead in (3, 6, 12):
        horizon = lab.Horizon(steps_ahead, steps_ahead)
        chosen = dataclasses.replace(design(model), horizon=horizon)
        assert lab.match(K, chosen).is_exact, steps_ahead


@pytest.mark.parametrize("limit", [(-0.9, 0.9), (-0.25, 0.25)])
def test_with_limits_nothing_changes_far_from_them(limit: tuple[float, float]) -> None:
    """While no limit is in the plan the input is that of PIP; then it is kept."""
    model, K = GAINS["poles of 6.3.2"]
    found = lab.match(K, design(model, limits=lab.Limits(u=limit)))
    assert found.is_exact
    scenario = lab.Scenario(np.ones(40))
    run = lab.closed_loop(model, found.design.build(), scenario)
    free = lab.closed_loop(model, lab.pip(model, K), scenario)
    touched = np.flatnonzero(run.status != lab.Status.FREE)
    before = touched[0] if len(touched) else len(run)
    assert before > 0
    assert relative(run.u[:before], free.u[:before]) < DECISION * 10.0
    assert (np.abs(run.u) <= limit[1] + 1e-9).all()
    assert len(touched) > 0 or limit[1] > 0.5


def test_what_is_lost_is_the_floor_of_the_distance() -> None:
    """A gain whose loop has no pole at the origin moves on what the model forgets.

    No cost gives that part, so no match comes nearer than it; here the rest is an LQ
    gain, which is found.
    """
    model, optimal = GAINS["LQ"]
    A = integral_of_error_form(model).A
    forgotten = np.linalg.svd(A)[2][-1]
    assert np.abs(A @ forgotten).max() < 1e-12
    K = optimal + 0.2 * forgotten
    found = lab.match(K, design(model), starts=1)
    assert found.lost == pytest.approx(0.2 / np.linalg.norm(K))
    assert not found.is_exact
    # the distance is flat at its floor: the search ends within the root of EXACT
    assert found.distance == pytest.approx(found.lost, rel=1e-4)
    assert found.distance >= found.lost * (1.0 - 1e-9)


def test_nothing_is_lost_where_nothing_is_forgotten() -> None:
    """Without past inputs every entry of the state has an effect."""
    model = lab.DifferenceModel([-1.5, 0.56], [0.1])
    K = lab.pole_gain(model, [0.5, 0.6, 0.7])
    found = lab.match(K, design(model))
    assert found.lost == 0.0
    assert found.is_exact


def test_the_weights_are_admissible() -> None:
    """What is found is a design like any other: positive weights, the rest kept."""
    model, K = GAINS["two inputs, LQ"]
    limits = lab.Limits(u=(-3.0, 3.0))
    found = lab.match(K, design(model, limits=limits)).design
    for step in found.Q:
        assert np.linalg.eigvalsh(step)[0] >= -1e-12
    assert np.linalg.eigvalsh(found.R)[0] > 0.0
    assert found.limits is limits
    assert found.reference == "zero"


def test_the_same_seed_the_same_match() -> None:
    """Bit by bit, though starts are drawn."""
    model = lab.DifferenceModel([-1.5, 0.56], [0.1, 0.08])
    K = lab.pole_gain(model, [0.2, 0.5, 0.4 + 0.2j, 0.4 - 0.2j])
    one, same = (
        lab.match(K, design(model), starts=2, seed=7, evaluations=300) for _ in range(2)
    )
    assert np.array_equal(one.design.Q, same.design.Q)
    assert one.distance == same.distance


@pytest.mark.parametrize(
    ("structure", "K", "options", "message"),
    [
        ("minimal", np.ones(4), {}, 'structure = "minimal": expected one of integral'),
        ("integral_of_error", np.ones(3), {}, "K has shape"),
        ("integral_of_error", np.ones(4), {"starts": 0}, "starts = 0: expected"),
    ],
)
def test_errors_name_the_argument(
    structure: str, K: np.ndarray, options: dict, message: str
) -> None:
    """What cannot be matched is refused with a sentence."""
    with pytest.raises(ValueError, match=message):
        lab.match(K, design(MODEL, structure), **options)


# --- Other structures of the same speed ---------------------------------------------


def rise(found: lab.Design) -> float:
    """Return the mean rise time on the model, each output for its own reference."""
    model, times = found.model, []
    free = dataclasses.replace(found, limits=lab.Limits())
    for output in range(model.n_y):
        scenario = lab.Scenario(np.tile(np.eye(model.n_y)[output], (200, 1)))
        run = lab.closed_loop(model, free.build(), scenario)
        times.append(lab.measures.steps(run, output)[0].rise)
    return float(np.mean(times))


@pytest.mark.parametrize("model", [LAG, TWO], ids=["a lag", "two inputs"])
def test_sums_and_increments_become_equally_fast(model: lab.DifferenceModel) -> None:
    """From moves to the sum of the error and back, outputs rise as before."""
    first = dataclasses.replace(
        design(model, "wang_young", limits=lab.Limits(u=(-2.0, 2.0))), R=0.01
    )
    other = lab.equal_speed(first, "integral_of_error")
    assert other.limits is first.limits
    assert other.horizon is first.horizon
    # the factor is sought to 1e-4 of itself, and rise follows it less than linearly
    assert rise(other) == pytest.approx(rise(first), rel=1e-3)
    back = lab.equal_speed(other, "forward_path")
    assert rise(back) == pytest.approx(rise(first), rel=1e-3)


@pytest.mark.parametrize("structure", ["forward_path", "minimal"])
def test_structures_with_the_same_cost_are_one_law_on_the_model(structure: str) -> None:
    """They take over the weights, and respond alike without limits."""
    first = design(TWO, "wang_young")
    other = lab.equal_speed(first, structure)
    ours, theirs = (
        lab.closed_loop(TWO, d.build(), lab.Scenario(np.ones((40, 2)))).y
        for d in (other, first)
    )
    assert relative(ours, theirs) < DECISION


def test_what_has_no_equal_says_so() -> None:
    """Unknown structures, and those that need a measured disturbance, are named."""
    with pytest.raises(ValueError, match="pip"):
        lab.equal_speed(design(LAG, "wang_young"), "pip")
    with pytest.raises(ValueError, match=r"model\.g is missing"):
        lab.equal_speed(design(LAG, "wang_young"), "disturbance_direct")
    slow = dataclasses.replace(design(LAG, "wang_young"), Q=0.0)
    with pytest.raises(ValueError, match="do not rise"):
        lab.equal_speed(slow, "integral_of_error")
