"""What every controller promises in a closed loop, and the loop itself."""

import dataclasses
import pickle

import numpy as np
import pytest
from conftest import DECISION, REPLAY
from strategies import random_model, roll_out

from nmss_lab import qp
from nmss_lab.cases import shell_model
from nmss_lab.controller import Limits, Status
from nmss_lab.design import Design
from nmss_lab.governor import governor
from nmss_lab.models import Between, DifferenceModel, LinearPlant
from nmss_lab.mpc import STRUCTURES, integral_of_error, wang_young
from nmss_lab.pip import lq_gain, pip, pole_gain
from nmss_lab.predict import Horizon
from nmss_lab.simulate import (
    Scenario,
    closed_loop,
    closed_loops,
    loops_of,
    samples,
)

MODEL = DifferenceModel([-1.5, 0.56], [0.1, 0.08], [0.05, 0.02])
"""Stable, with gain 3 from the input and 1.167 from the disturbance."""

CHANGES_Q = {"Q": 1.0, "R": 0.3}
SUMS_Q = {"Q": [0.1, 0.1, 0.01, 0.1], "R": 0.1}

ALL = [*STRUCTURES, "governor", "pip", "positional pip", "forward pip"]


def build(name, limits=None, model=MODEL, **options):
    """Return a controller of any structure for ``MODEL``."""
    limits = limits or Limits()
    if name == "governor":
        K = lq_gain(model, SUMS_Q["Q"], SUMS_Q["R"])
        return governor(model, K, 12, limits, **options)
    if name.endswith("pip"):
        K = lq_gain(model, SUMS_Q["Q"], SUMS_Q["R"])
        law = "positional" if name.startswith("pos") else "incremental"
        path = "forward" if name.startswith("for") else "feedback"
        return pip(model, K, limits, law, path)
    weights = SUMS_Q if name == "integral_of_error" else CHANGES_Q
    return STRUCTURES[name](
        model, Horizon(12, 4), limits=limits, **{**weights, **options}
    )


def steps(*levels, each=40):
    """Return a reference of several levels, ``each`` samples long."""
    return np.repeat(levels, each)


def check_inputs(run, limits, name=""):
    """Every input and change of it is a number within its limits."""
    for signal, (low, high) in ((run.u, limits.u), (run.du, limits.du)):
        assert np.isfinite(signal).all(), name
        assert (signal >= np.asarray(low) - 1e-12).all(), (name, signal.min())
        assert (signal <= np.asarray(high) + 1e-12).all(), (name, signal.max())


# --- Promise 1 and 2: limits always, never NaN, fallbacks in order -------------------


def raising(problem):
    """Break as a solver may."""
    raise RuntimeError("out of memory")


def numberless(problem):
    """Answer with NaN."""
    nothing = np.full(len(problem.f), np.nan)
    return nothing, np.zeros(len(problem.lower)), 3, False


def wrong(problem):
    """Answer with something that is not optimal."""
    return np.full(len(problem.f), 7.0), np.zeros(len(problem.lower)), 3, False


def giving_up(problem):
    """Claim that there is no solution."""
    return None, np.zeros(len(problem.lower)), 3, True


def silent(problem):
    """Give no answer and no reason."""
    return None, None, 0, False


def misshapen(problem):
    """Answer with a vector of another length."""
    return np.zeros(len(problem.f) + 1), np.zeros(len(problem.lower)), 0, False


BROKEN = [raising, numberless, wrong, giving_up, silent, misshapen]
LIMITS = Limits(u=(-1.0, 1.0), du=(-0.2, 0.2))


@pytest.fixture(params=BROKEN, ids=lambda f: f.__name__)
def broken(request, monkeypatch):
    """Register a solver that fails in one of the ways; yield a switch for it."""
    works = {"now": True}

    def solver(problem):
        answer = qp._daqp if works["now"] else request.param
        return answer(problem)

    monkeypatch.setitem(qp.BACKENDS, "broken", solver)
    return works


QP_STRUCTURES = [*STRUCTURES, "governor"]


@pytest.mark.parametrize("name", QP_STRUCTURES)
def test_failing_solver_is_survived_by_the_last_plan(name, broken):
    """Promise 2: the plan made before the failure is continued, and it says so."""
    controller = build(name, LIMITS, backend="broken")
    scenario = Scenario(steps(1.0, -2.0), v=np.zeros(80))
    seen = []
    for sample in samples(MODEL.plant(), controller, scenario):
        broken["now"] = sample.k < 41
        seen.append(sample)
    shifted = [s for s in seen if s.move.status == Status.SHIFTED]
    assert [s.k for s in shifted[:2]] == [42, 43]
    plan = controller.plan(seen[41].move, "u")[:, 0]
    for sample in shifted[:5]:
        assert sample.u[0] == pytest.approx(plan[sample.k - 41], abs=DECISION)
        assert sample.move.shift == sample.k - 41
    u = np.array([s.u[0] for s in seen])
    assert np.isfinite(u).all()
    assert np.abs(u).max() <= 1.0
    assert np.abs(np.diff(u, prepend=0.0)).max() <= 0.2 + 1e-12


@pytest.mark.parametrize("name", QP_STRUCTURES)
def test_solver_that_never_worked_leaves_the_input_where_it_is(name, broken):
    """Promise 2: with no plan to continue, hold."""
    broken["now"] = False
    controller = build(name, LIMITS, backend="broken")
    run = closed_loop(MODEL.plant(), controller, Scenario(steps(2.0), v=np.zeros(40)))
    assert (run.status == Status.HELD).all()
    assert not run.u.any()
    assert np.isfinite(run.cost).all()


@pytest.mark.parametrize("name", QP_STRUCTURES)
def test_loop_recovers_when_the_solver_does(name, broken):
    """A failure of ten samples does not spoil what follows."""
    controller = build(name, LIMITS, backend="broken")
    scenario = Scenario(steps(2.0, each=150), v=np.zeros(150))
    y = []
    for sample in samples(MODEL.plant(), controller, scenario):
        broken["now"] = not 3 <= sample.k < 13
        y.append(sample.y[0])
    assert y[-1] == pytest.approx(2.0, abs=0.01)


def test_plan_is_shifted_not_restarted_in_the_trail(broken):
    """The trail of a continued plan starts at the present sample."""
    controller = build("wang_young", LIMITS, backend="broken")
    scenario = Scenario(steps(1.0, -2.0), v=np.zeros(80))
    for sample in samples(MODEL.plant(), controller, scenario):
        broken["now"] = sample.k < 41
        if sample.k == 41:
            fresh = controller.plan(sample.move, "y")
        if sample.k == 44:
            shifted = controller.plan(sample.move, "y")
            break
    assert shifted[:-3] == pytest.approx(fresh[3:], abs=REPLAY)
    assert shifted[-3:] == pytest.approx(np.repeat(fresh[-1:], 3, 0), abs=REPLAY)


MIXED = DifferenceModel(-0.8 * np.eye(2)[None], np.array([[[0.2], [0.15]]]), dt=1.0)
"""Two outputs, one input: they cannot be held apart."""


def squeezed(outputs, backend="daqp", **more):
    """Return a run in which an output disturbance makes the limits contradict."""
    limits = Limits(y=([-1, -1], [1, 1]), outputs=outputs, **more)
    controller = wang_young(MIXED, Horizon(8, 3), 1.0, 0.1, limits, backend=backend)
    push = np.zeros((30, 2))
    push[10:20] = [3.0, -3.0]
    scenario = Scenario(np.zeros((30, 2)), output_disturbance=push)
    return closed_loop(MIXED.plant(), controller, scenario)


BACKENDS = ["daqp", "proxqp", "qpsolvers/quadprog", "qpsolvers/daqp"]


@pytest.mark.parametrize("backend", BACKENDS)
def test_hard_output_limits_are_dropped_and_it_says_so(backend):
    """Promise 2 (6.1.2): rows go for these samples only; no input limits are left."""
    run = squeezed("hard", backend)
    assert (run.status[10:14] == Status.DROPPED).all()
    assert (run.status[:10] == Status.FREE).all()
    assert (run.status[25:] == Status.FREE).all()
    assert np.isfinite(run.u).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_soft_output_limits_are_relaxed_and_it_says_so(backend):
    """Promise 2: a violation at a price, shared by both outputs."""
    run = squeezed("soft", backend)
    assert (run.status[10:14] == Status.SOFTENED).all()
    worst = np.abs(run.y[11:14]).max(axis=0)
    assert np.abs(worst[0] - worst[1]) < 1.0


PRICED = 1e-5
"""A violation is made small by a price of 1e6 times the Hessian, not forbidden."""


def test_priority_keeps_the_important_output():
    """Promise 2: the first in rank is kept as soon as it can be, the other is not."""
    for first, ranks in ((0, (1, 2)), (1, (2, 1))):
        run = squeezed("priority", priority=ranks)
        assert (run.status[10:14] == Status.SOFTENED).all()
        # at 11 the plan still took the push for the plant's own motion
        assert np.abs(run.y[12:20, first]).max() <= 1.0 + PRICED
        assert np.abs(run.y[12:20, 1 - first]).max() > 2.0


def test_priority_breaks_the_less_important_no_more_than_needed():
    """The predicted violation of rank 2 is the least that rank 1 allows."""
    run = squeezed("priority", priority=(1, 2))
    y = run.trail("y")[10]
    assert y[:, 0].max() <= 1.0 + PRICED
    # the input lowers both; holding y1 at its limit is all that is asked of it
    assert y[-1, 0] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("name", ALL)
def test_measurement_that_is_not_a_number_is_refused(name):
    """Promise 2: it never enters; its prediction stands in, also under a load."""
    noise = np.zeros(140)
    noise[[60, 61, 62]] = np.nan
    noise[100] = np.inf
    scenario = Scenario(
        steps(2.0, each=140),
        v=np.zeros(140),
        noise=noise,
        output_disturbance=0.3 * (np.arange(140) > 3),
    )
    run = closed_loop(MODEL.plant(), build(name, LIMITS), scenario)
    assert (run.status[[60, 61, 62, 100]] == Status.REFUSED).all()
    assert (run.status != Status.REFUSED).sum() == 136
    check_inputs(run, LIMITS, name)
    # with an exact model the prediction is the measurement: nothing changes
    clean = closed_loop(
        MODEL.plant(), build(name, LIMITS), dataclasses.replace(scenario, noise=None)
    )
    assert np.abs(run.y - clean.y).max() < DECISION, name


@pytest.mark.parametrize("name", ALL)
def test_gap_during_a_step_does_not_spoil_the_loop(name):
    """Promise 2: from the very first sample, in the transient, and on another plant."""
    noise = np.zeros(150)
    noise[[0, 1, 5, 6, 7]] = np.nan
    scenario = Scenario(steps(1.0, each=150), v=np.zeros(150), noise=noise)
    run = closed_loop(MODEL.varied(1.05, 0.99), build(name, LIMITS), scenario)
    check_inputs(run, LIMITS, name)
    assert run.y[-1, 0] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("name", ["disturbance_direct", "disturbance_augmented"])
def test_disturbance_that_is_not_a_number_is_refused(name):
    """Promise 2 for the measured disturbance."""
    controller = build(name, LIMITS)
    memory = controller.start()
    memory = controller.measure(memory, [0.5], [1.0], [2.0])
    memory = controller.apply(memory, [0.1], controller.decide(memory))
    memory = controller.measure(memory, [0.6], [1.0], [np.nan])
    move = controller.decide(memory)
    assert move.status == Status.REFUSED
    assert np.isfinite(memory.vector).all()
    assert controller.form.recipe.layout.read(memory.vector, "v")[0] == [2.0]


def test_reference_that_is_not_a_number_is_an_error():
    """It comes from the user, not from a sensor."""
    controller = build("wang_young")
    with pytest.raises(ValueError, match=r"r = .* is not finite"):
        controller.measure(controller.start(), [0.0], [np.nan], [0.0])


@pytest.mark.parametrize("name", ALL)
def test_input_outside_its_limits_comes_back_at_the_allowed_rate(name):
    """Promise 1: where level and rate contradict, the rate wins."""
    u0 = np.array([2.0])
    limits = Limits(u=(-1.0, 1.0), du=(-0.2, 0.2))
    scenario = Scenario(np.zeros(60), v=np.zeros(60), u0=u0, y0=np.array([6.0]))
    run = closed_loop(MODEL.plant(), build(name, limits), scenario)
    assert np.abs(run.du).max() <= 0.2 + 1e-12
    assert run.u[:5, 0] == pytest.approx([1.8, 1.6, 1.4, 1.2, 1.0], abs=DECISION)
    assert (run.u[5:] <= 1.0 + 1e-12).all()
    assert not np.isin(run.status, [Status.SHIFTED, Status.HELD]).any()


def test_limits_are_kept_in_two_hundred_random_runs():
    """Promises 1, 2 and 4 for random models, structures, limits and disturbances."""
    names = ["integral_of_error", "wang_young", "disturbance_direct"]
    for seed in range(200):
        rng = np.random.default_rng(seed)
        p, q = rng.integers(1, 3, 2)
        model = random_model(rng, p, q, 1, 2, 2, 1, radius=rng.uniform(0.3, 1.0))
        high, rate = rng.uniform(0.1, 1.0, q), rng.uniform(0.05, 0.5, q)
        limits = Limits(
            u=(-high, 2 * high),
            du=(-rate, rate),
            y=(-1.0, rng.uniform(0.5, 3.0)) if seed % 2 else (-np.inf, np.inf),
            outputs=["hard", "soft", "priority"][seed % 3],
        )
        controller = STRUCTURES[names[seed % len(names)]](
            model, Horizon(6, 3), 1.0, 0.1, limits
        )
        scenario = Scenario(
            np.repeat(rng.uniform(-3, 3, (2, p)), 5, 0),
            v=rng.standard_normal((10, 1)),
            noise=0.1 * rng.standard_normal((10, p)),
            output_disturbance=np.repeat(rng.standard_normal((2, p)), 5, 0),
        )
        run = closed_loop(model.plant(), controller, scenario)
        check_inputs(run, limits, f"seed {seed}")
        told = [Status(code) for code in np.unique(run.status)]
        assert max(told) <= Status.DROPPED, f"seed {seed}: {told}"


# --- Promise 3: no wind-up, bumpless -------------------------------------------------


@pytest.mark.parametrize("name", ALL)
def test_actuator_that_saturates_causes_no_wind_up(name):
    """Promise 3: after 100 samples at the end stop it leaves it at once."""
    scenario = Scenario(
        np.repeat([9.0, 1.0], [100, 60]), v=np.zeros(160), actuator=(-1.0, 1.0)
    )
    run = closed_loop(MODEL.plant(), build(name), scenario)
    assert run.u[99, 0] == 1.0
    back = np.argmax(run.u[100:, 0] < 1.0)
    assert back <= 1, f"{name}: {back} samples late"
    assert np.abs(run.y[-15:] - 1.0).max() < 0.05


@pytest.mark.parametrize("name", ALL)
def test_manual_to_automatic_is_bumpless(name):
    """Promise 3: at rest where the hand left it, there is no reason to move."""
    manual = np.full(120, np.nan)
    manual[:80] = 0.7
    r = np.full(120, 3.0 * 0.7)
    r[:70] = -4.0  # far away while the hand is on
    scenario = Scenario(r, v=np.zeros(120), manual=manual)
    run = closed_loop(MODEL.plant(), build(name), scenario)
    assert (run.u[:80] == 0.7).all()
    # the plant is within 1e-6 of rest, so a bump of 1e-3 is three orders above it
    assert np.abs(run.u[80:] - 0.7).max() < 1e-3, name


@pytest.mark.parametrize("name", ALL)
def test_switching_on_at_rest_is_bumpless(name):
    """Starting from a constant past that is not zero."""
    u0, y0 = np.array([0.5]), np.array([1.5])
    scenario = Scenario(np.full(20, 1.5), v=np.zeros(20), u0=u0, y0=y0)
    run = closed_loop(MODEL.plant(), build(name, LIMITS), scenario)
    assert np.abs(run.u - 0.5).max() < DECISION, name
    assert np.abs(run.y - 1.5).max() < DECISION, name


@pytest.mark.parametrize("name", ALL)
def test_input_that_cannot_be_applied_is_an_error(name):
    """Nothing that is not a number enters the memory."""
    controller = build(name)
    memory = controller.measure(controller.start(), [0.0], [1.0], [0.0])
    move = controller.decide(memory)
    with pytest.raises(ValueError, match=r"u = .* is not finite"):
        controller.apply(memory, [np.nan], move)


# --- The loop ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALL)
def test_loop_applies_the_equation_of_the_plant(name, rng):
    """Outputs are those of (7.1) for the inputs, disturbances and loads applied."""
    N = 30
    scenario = Scenario(
        steps(1.0, each=N),
        v=rng.standard_normal((N, 1)),
        input_disturbance=rng.standard_normal((N, 1)),
        output_disturbance=rng.standard_normal((N, 1)),
        noise=rng.standard_normal((N, 1)),
    )
    run = closed_loop(MODEL.plant(), build(name), scenario)
    into = list(run.u + scenario.input_disturbance)
    y = [np.zeros(1), *roll_out(MODEL, [np.zeros(1)], [], [], into, list(scenario.v))]
    wanted = np.array(y[:N]) + scenario.output_disturbance
    assert run.y == pytest.approx(wanted, abs=REPLAY)
    assert run.measured == pytest.approx(wanted + scenario.noise, abs=REPLAY)
    assert run.du[1:] == pytest.approx(np.diff(run.u, axis=0), abs=REPLAY)
    assert run.t.tolist() == list(range(N))


@pytest.mark.parametrize("name", ALL)
def test_design_is_not_changed_by_use(name, rng):
    """Same design, two runs, and two loops in turns: the same numbers."""
    controller = build(name, LIMITS)
    v = rng.standard_normal(60)
    one, two = (
        Scenario(steps(1, -1, each=30), v=v),
        Scenario(steps(-2, 2, each=30), v=v),
    )
    first = [closed_loop(MODEL.plant(), controller, each) for each in (one, two)]
    fresh = closed_loop(MODEL.plant(), build(name, LIMITS), one)
    turns = zip(
        samples(MODEL.plant(), controller, one),
        samples(MODEL.plant(), controller, two),
        strict=True,
    )
    for a, b in turns:
        assert a.u == pytest.approx(first[0].u[a.k], abs=REPLAY)
        assert b.u == pytest.approx(first[1].u[b.k], abs=REPLAY)
    assert fresh.u == pytest.approx(first[0].u, abs=REPLAY)


@pytest.mark.parametrize("name", ALL)
def test_samples_give_what_the_whole_run_gives(name, rng):
    """The generator and the bulk form are one loop."""
    controller = build(name, LIMITS)
    scenario = Scenario(steps(1, -2), v=rng.standard_normal(80))
    run = closed_loop(MODEL.plant(), controller, scenario)
    taken = list(samples(MODEL.plant(), controller, scenario))
    for field in ("y", "u", "measured"):
        found = np.array([getattr(s, field) for s in taken])
        assert found == pytest.approx(getattr(run, field), abs=REPLAY)
    for field in ("status", "cost", "active", "w"):
        found = np.array([getattr(s.move, field) for s in taken]) * 1.0
        assert found == pytest.approx(getattr(run, field) * 1.0, abs=REPLAY)


@pytest.mark.parametrize("name", ALL)
def test_ensemble_in_lock_step_equals_single_runs(name, rng):
    """Each plant of an ensemble runs as if it were alone."""
    controller = build(name, LIMITS)
    noise = 0.05 * rng.standard_normal(50)
    noise[20] = np.nan
    scenario = Scenario(steps(1, -2, each=25), v=rng.standard_normal(50), noise=noise)
    plants = [MODEL.varied(f).plant() for f in (0.8, 1.0, 1.3)]
    together = closed_loops(plants, controller, scenario, keep_moves=True)
    for plant, found in zip(plants, together, strict=True):
        alone = closed_loop(plant, controller, scenario)
        for field in ("y", "u", "du", "w", "status", "cost"):
            pair = getattr(found, field) * 1.0, getattr(alone, field) * 1.0
            assert pair[0] == pytest.approx(pair[1], abs=DECISION), field
        if hasattr(controller, "signals"):
            assert found.trail("y") == pytest.approx(alone.trail("y"), abs=DECISION)


def test_plant_of_the_users_own_kind(rng):
    """Anything with reset, output and step will do."""

    class Tank:
        n_y, n_u, n_v, dt = 1, 1, 0, 1.0

        def reset(self, u0, v0, y0=None):
            return 0.0

        def output(self, state):
            return np.array([state])

        def step(self, state, u, v):
            return 0.9 * state + 0.1 * u[0]

    model = DifferenceModel([-0.9], [0.1])
    controller = wang_young(model, Horizon(10, 3), 1.0, 0.1, LIMITS)
    scenario = Scenario(steps(0.5))
    own = closed_loop(Tank(), controller, scenario)
    ours = closed_loop(model.plant(), controller, scenario)
    assert own.u == pytest.approx(ours.u, abs=REPLAY)


def test_trail_starts_where_the_loop_goes():
    """Without surprises the next output is the first one that was predicted."""
    controller = build("wang_young", LIMITS)
    scenario = Scenario(steps(1.0), v=np.zeros(40))
    run = closed_loop(MODEL.plant(), controller, scenario)
    trail = run.trail("y")
    assert trail.shape == (40, 12, 1)
    assert trail[:-1, 0] == pytest.approx(run.y[1:], abs=DECISION)
    assert run.trail("u")[:, 0] == pytest.approx(run.u, abs=DECISION)
    assert run.trail("du")[:, 0] == pytest.approx(run.du, abs=DECISION)


def test_active_rows_are_those_at_their_limit():
    """The rows reported are equalities."""
    controller = build("wang_young", LIMITS)
    run = closed_loop(MODEL.plant(), controller, Scenario(steps(2.0), v=np.zeros(40)))
    labels = controller.program.labels
    assert run.active.any()
    for k, row in np.argwhere(run.active):
        name, channel, step = labels[row]
        value = run.trail(name)[k, step, channel]
        edge = 1.0 if name == "u" else 0.2
        assert abs(value) == pytest.approx(edge, abs=DECISION)


def test_preview_moves_before_the_reference_does():
    """Only the previewing design reads ahead."""
    scenario = Scenario(np.repeat([0.0, 1.0], 20), v=np.zeros(40))
    moved = {}
    for reading in ("held", "next", "preview"):
        controller = build("wang_young", reference=reading)
        run = closed_loop(MODEL.plant(), controller, scenario)
        moved[reading] = int(np.argmax(np.abs(run.u[:, 0]) > 1e-9))
    assert moved == {"held": 20, "next": 19, "preview": 8}


def test_status_is_told_in_sentences():
    """Counts and words of what happened."""
    run = closed_loop(
        MODEL.plant(), build("pip", LIMITS), Scenario(steps(2.0), v=np.zeros(40))
    )
    assert sum(int(each.split()[0]) for each in run.sentences) == 40
    assert any("clipped" in each for each in run.sentences)


# --- Ensembles -----------------------------------------------------------------------

TOGETHER = 1e-8
"""A loop in an ensemble and alone: unique optima, found in two ways."""


def spread(model, loops, seed=5):
    """Return plants around a model."""
    factors = np.random.default_rng(seed).uniform([0.8, 0.97], [1.25, 1.0], (loops, 2))
    return [model.varied(*each).plant() for each in factors]


def check_together(plants, controller, scenario):
    """Every loop of an ensemble runs as if alone; return the runs of the ensemble."""
    together = closed_loops(plants, controller, scenario, keep_moves=True)
    for plant, found in zip(plants, together, strict=True):
        alone = closed_loop(plant, controller, scenario)
        assert np.array_equal(found.status, alone.status)
        for field in ("y", "measured", "u", "du", "w"):
            pair = getattr(found, field), getattr(alone, field)
            assert pair[0] == pytest.approx(pair[1], abs=TOGETHER), field
        # rows that depend on each other share their push in more than one way
        pushes = [run.multipliers @ controller.program.M for run in (found, alone)]
        for pair in (
            (found.moves.decision, alone.moves.decision),
            (found.cost, alone.cost),
            pushes,
        ):
            size = 1.0 + np.abs(pair[1]).max()
            assert np.abs(pair[0] - pair[1]).max() <= 10 * TOGETHER * size
    return together


def shared_share(runs):
    """Share of the limited samples at which a region answered, not the solver."""
    status = np.array([run.status for run in runs])
    solved = np.array([run.iterations for run in runs]) > 0
    limited = status == Status.LIMITED
    assert limited.any()
    return (limited & ~solved).sum() / limited.sum()


TIGHT = Limits(u=(-0.5, 0.5), du=(-0.137, 0.137), y=(-1.2, 1.2))


@pytest.mark.parametrize("name", QP_STRUCTURES)
def test_limited_loops_learn_from_each_other(name, rng):
    """Limits on u, du and y hold; most answers come from another loop's."""
    scenario = Scenario(steps(1.3, -1.3, each=30), v=0.1 * rng.standard_normal(60))
    controller = build(name, TIGHT)
    runs = check_together(spread(MODEL, 25), controller, scenario)
    assert shared_share(runs) > 0.5
    rows = np.any([run.active.any(axis=0) for run in runs], axis=0)
    kinds = {controller.program.labels[i].name for i in np.flatnonzero(rows)}
    assert kinds == {"u", "du", "y"}


@pytest.mark.parametrize("name", ["wang_young", "forward_path", "integral_of_error"])
def test_limited_loops_of_many_channels_learn_from_each_other(name):
    """The Shell fractionator with three inputs and outputs, and a plant of two."""
    shell, two = shell_model(), random_model(np.random.default_rng(3), 2, 2, radius=0.8)
    for model in (shell, two):
        p = model.n_y
        limits = Limits(u=(-0.4, 0.4), du=(-0.113, 0.113), y=(-5.0, 5.0))
        weights = {"Q": 1.0, "R": 0.5}
        controller = STRUCTURES[name](model, Horizon(12, 4), limits=limits, **weights)
        r = np.repeat([np.full(p, 0.3), np.linspace(-0.4, 0.4, p)], 20, axis=0)
        runs = check_together(spread(model, 12), controller, Scenario(r))
        assert shared_share(runs) > 0.2


@pytest.mark.parametrize("reference", ["held", "preview"])
def test_governed_loops_learn_from_each_other(reference):
    """Also where the decision cannot move the present input."""
    model = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
    limits = Limits(u=(-2.0, 2.0), du=(-0.5, 0.5))
    K = pole_gain(model, [0.0, 0.0, 0.2, 0.2])
    controller = governor(model, K, 10, limits, reference)
    plants = [model.varied(f).plant() for f in np.linspace(0.97, 1.03, 12)]
    runs = check_together(plants, controller, Scenario(steps(3.0, -3.0, each=25)))
    assert shared_share(runs) > 0.3


@pytest.mark.parametrize("outputs", ["hard", "soft", "priority"])
def test_limits_that_give_way_do_so_in_an_ensemble_too(outputs):
    """No region of the whole program stands in for rows dropped or softened."""
    limits = Limits(u=(-2, 2), y=([-1, -1], [1, 1]), outputs=outputs, priority=(1, 2))
    controller = wang_young(MIXED, Horizon(8, 3), 1.0, 0.1, limits)
    push = np.zeros((30, 2))
    push[5:10], push[15:20] = [1.5, 0.9], [3.0, -3.0]
    scenario = Scenario(np.zeros((30, 2)), output_disturbance=push)
    runs = check_together(spread(MIXED, 8), controller, scenario)
    gave_way = Status.DROPPED if outputs == "hard" else Status.SOFTENED
    assert all((run.status == gave_way).any() for run in runs)
    solved = np.array([run.iterations for run in runs]) > 0
    told = np.array([run.status for run in runs])
    assert solved[told == gave_way].all()
    if outputs == "soft":  # a price is not in the program that regions are of
        assert solved[told == Status.LIMITED].all()
    else:
        assert shared_share(runs) > 0.1


def test_plants_of_any_size_keep_their_order():
    """Those of equal size run together, and each run is that of its own plant."""
    model = DifferenceModel([-0.5], [0.5])
    plants = [model, DifferenceModel([-0.9, 0.2], [0.2, 0.1]), model.varied(1.2)]
    plants.insert(1, LongWay(model.plant()))
    controller = wang_young(model, Horizon(5, 2), 1.0, 1.0, Limits(u=(-0.8, 1.1)))
    scenario = Scenario(np.ones(20))
    for plant, run in zip(plants, loops_of(plants, controller, scenario), strict=True):
        alone = closed_loop(plant, controller, scenario)
        assert np.allclose(run.y, alone.y, atol=1e-8)  # regions against a solver


class LongWay:
    """A plant that is no LinearPlant, though it does the same."""

    def __init__(self, inner):
        self.inner, self.n_y, self.n_u, self.n_v = inner, 1, 1, 0
        self.dt, self.reset, self.output = inner.dt, inner.reset, inner.output
        self.step = inner.step


def test_a_start_may_be_a_plain_number():
    """As for a state-dependent plant: one number stands for every output."""
    model = DifferenceModel([-0.5], [0.5])
    controller = wang_young(model, Horizon(5, 2), 1.0, 1.0)
    run = closed_loop(model, controller, Scenario(np.ones(4), y0=1.0, u0=1.0))
    assert np.allclose(run.y, 1.0)  # at rest from the start


def test_input_outside_its_limits_has_bounds_of_its_own_in_an_ensemble():
    """They are wider there, so that no region fits; afterwards regions do."""
    controller = build("wang_young", LIMITS)
    scenario = Scenario(np.zeros(40), v=np.zeros(40), u0=[2.0], y0=[6.0])
    runs = check_together(spread(MODEL, 10), controller, scenario)
    outside = np.array([run.u[:, 0] for run in runs]) > 1.0
    solved = np.array([run.iterations for run in runs]) > 0
    assert solved[:, 1:][outside[:, :-1]].all()
    assert outside.any()
    assert shared_share(runs) > 0.0


@pytest.mark.parametrize("reading", ["held", "zero"])
def test_sums_of_the_error_stop_in_an_ensemble_too(reading):
    """Promise 3: the input leaves its limit as soon as a single loop's does."""
    lag = DifferenceModel([-0.9], [0.1])
    controller = integral_of_error(
        lag, Horizon(12, 4), 0.1, 0.1, Limits(u=(-1, 1)), reading
    )
    plants = [lag.varied(f).plant() for f in np.linspace(0.9, 1.1, 7)]
    runs = check_together(plants, controller, Scenario(steps(3.0, 0.5, each=100)))
    for run in runs:
        assert run.u[95:100] == pytest.approx(1.0)
        assert run.u[102, 0] < 1.0 - DECISION
        assert run.y[-1, 0] == pytest.approx(0.5, abs=1e-2)


def test_ensemble_gives_the_same_numbers_always(rng):
    """To the last digit: with the same controller again, and with a fresh one."""
    scenario = Scenario(steps(1.3, -1.3, each=30), v=0.1 * rng.standard_normal(60))
    plants, controller = spread(MODEL, 20), build("wang_young", TIGHT)
    before = closed_loops(plants, controller, scenario)
    closed_loops(spread(MODEL, 30, seed=8), controller, scenario)
    for other in (controller, build("wang_young", TIGHT)):
        after = closed_loops(plants, other, scenario)
        for a, b in zip(before, after, strict=True):
            for field in ("y", "u", "status", "cost", "multipliers", "iterations"):
                assert np.array_equal(getattr(a, field), getattr(b, field)), field
    assert all(run.controller is controller for run in before)
    assert controller.regions is None
    copy = pickle.loads(pickle.dumps(before[3]))
    assert np.array_equal(copy.u, before[3].u)


WILD = DifferenceModel([-4.0], [0.1, 0.08], [0.05, 0.02])
"""No input within ``TIGHT`` holds it."""


@pytest.mark.parametrize("name", ["wang_young", "integral_of_error", "governor", "pip"])
def test_loop_that_diverges_leaves_the_others_alone(name, rng):
    """To the last digit, also those that hit limits; and it says where it ended."""
    scenario = Scenario(
        steps(1.3, -1.3, each=40),
        v=0.1 * rng.standard_normal(80),
        noise=0.05 * rng.standard_normal(80),
    )
    controller = build(name, TIGHT)
    plants = spread(MODEL, 15)
    wild = WILD.varied().plant()
    wild = LinearPlant(*_padded(wild, plants[0].n_x), dt=wild.dt)
    lost = closed_loops([*plants[:4], wild, *plants[5:]], controller, scenario)
    well = closed_loops(plants, controller, scenario)
    for i in {*range(15)} - {4}:
        for field in ("y", "u", "status", "cost", "multipliers", "w", "measured"):
            assert np.array_equal(getattr(lost[i], field), getattr(well[i], field))
        assert np.isfinite(lost[i].y).all()
    run = lost[4]
    end = int(np.argmax(np.isnan(run.y[:, 0])))
    assert 5 < end < 75
    assert np.abs(run.y[:end]).max() <= 1e9
    assert np.isfinite(run.u).all()
    assert (run.u[end:] == run.u[end - 1]).all()
    assert not run.du[end:].any()
    for field in ("y", "measured", "y_fine", "cost"):
        assert np.isnan(getattr(run, field)[end:]).all(), field
        assert np.isfinite(getattr(run, field)[:end]).all(), field
    assert (run.status[end:] >= Status.REFUSED).all()
    assert not run.active[end:].any()


@pytest.mark.parametrize("name", ["wang_young", "integral_of_error", "governor", "pip"])
def test_only_loop_of_an_ensemble_is_as_any_other(name, rng):
    """It runs as a single loop does, and may diverge as one of many."""
    controller = build(name, TIGHT)
    scenario = Scenario(steps(1.3, -1.3, each=40), noise=0.05 * rng.standard_normal(80))
    for model in (MODEL, WILD):
        alone, (first, _) = (
            closed_loops([model] * count, controller, scenario) for count in (1, 2)
        )
        # a governor's wishes for a loop that has run away are rounding
        fields = "y", "measured", "y_fine", "u", "du", *("w", "cost") * (model is MODEL)
        for field in fields:
            a, b = getattr(alone[0], field), getattr(first, field)
            size = 1.0 + np.nanmax(np.abs(b))
            assert np.allclose(a, b, rtol=0.0, atol=REPLAY * size, equal_nan=True), (
                field
            )
        lost = np.isnan(first.y[:, 0])
        assert lost.any() == (model is WILD)
        assert np.isnan(alone[0].cost[lost]).all()
        assert (alone[0].status[lost] >= Status.REFUSED).all()


def _padded(plant, n_x):
    """Matrices of a plant with states that do nothing."""
    more = n_x - plant.n_x
    return (
        np.pad(plant.A, ((0, more), (0, more))),
        np.pad(plant.B, ((0, more), (0, 0))),
        np.pad(plant.C, ((0, 0), (0, more))),
        np.pad(plant.G, ((0, more), (0, 0))),
    )


@pytest.mark.parametrize("pole", [3.0, 1e5, 1e200])
def test_output_between_samples_ends_with_its_loop(pole):
    """No number that has run away is left, and nothing overflows for long."""

    def plant(a):
        inside = Between(
            np.array([0.5, 1.0]),
            np.full((2, 1, 1), a),
            np.ones((2, 1, 1)),
            np.zeros((2, 1, 0)),
        )
        return LinearPlant(
            np.array([[a]]), np.ones((1, 1)), np.ones((1, 1)), between=inside
        )

    # what this model expects where nothing is measured runs away too
    model = DifferenceModel([-3.0], [1.0])
    controller = wang_young(model, Horizon(5, 2), 1.0, 1.0, Limits(u=(-1, 1)))
    scenario = Scenario(
        np.ones(700), input_disturbance=3.0 * np.ones(700), noise=np.ones(700)
    )
    tame, wild = closed_loops([plant(0.5), plant(pole)], controller, scenario)
    end = int(np.argmax(np.isnan(wild.y[:, 0])))
    assert end > 0
    assert np.isfinite(wild.y_fine[: 2 * end]).all()
    assert np.isnan(wild.y_fine[2 * end :]).all()
    assert len(wild.y_fine) == len(wild.t_fine) == 1401
    assert np.isfinite(tame.y_fine).all()
    assert np.isfinite(tame.y).all()


# --- Errors --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"v": np.zeros(9)}, "v has 9 samples, expected 10"),
        ({"noise": np.zeros((4, 1))}, "noise has 4 samples"),
        ({"input_disturbance": np.full(10, np.nan)}, "input_disturbance is not finite"),
        ({"reference": np.full(10, np.inf)}, "reference is not finite at sample 0"),
        ({"reference": np.zeros((2, 3, 4))}, "reference has shape"),
    ],
)
def test_scenario_with_a_mistake_is_refused(fields, message):
    """The series at fault is named."""
    with pytest.raises(ValueError, match=message):
        Scenario(**{"reference": np.zeros(10), **fields})


@pytest.mark.parametrize(
    ("plant", "scenario", "message"),
    [
        (MIXED.plant(), Scenario(np.zeros((9, 2))), "plant has 2 outputs and 1 inputs"),
        (
            DifferenceModel([-0.5], [1.0], [1.0], dt=0.1).plant(),
            Scenario(np.zeros(9)),
            "sampled every 0.1 s",
        ),
        (DifferenceModel([-0.5], [1.0]).plant(), Scenario(np.zeros(9)), "0 measured"),
        (MODEL.plant(), Scenario(np.zeros((9, 2))), "reference has 2 columns"),
        (MODEL.plant(), Scenario(np.zeros(9), v=np.zeros((9, 2))), "v has 2 columns"),
    ],
)
def test_parts_that_do_not_fit_are_refused(plant, scenario, message):
    """Plant, controller and scenario must have the same sizes."""
    with pytest.raises(ValueError, match=message):
        closed_loop(plant, build("disturbance_direct"), scenario)


def test_ensemble_of_different_sizes_is_refused():
    """Lock step needs equal shapes."""
    controller = build("wang_young")
    scenario = Scenario(np.zeros(5), v=np.zeros(5))
    with pytest.raises(ValueError, match="plants is empty"):
        closed_loops([], controller, scenario)
    with pytest.raises(ValueError, match="plants differ"):
        closed_loops([MODEL.plant(), MIXED.plant()], controller, scenario)


def test_trail_of_a_controller_without_predictions_is_refused():
    """PIP predicts nothing; MPC predicts no "beta"."""
    scenario = Scenario(np.zeros(5), v=np.zeros(5))
    with pytest.raises(ValueError, match="no predictions"):
        closed_loop(MODEL.plant(), build("pip"), scenario).trail("y")
    with pytest.raises(ValueError, match="predicts u, du, y"):
        closed_loop(MODEL.plant(), build("wang_young"), scenario).trail("beta")


def test_plan_that_knows_no_reference_is_not_continued(broken):
    """Promise 2: the plan of reading "zero" leads away, so the input is held."""
    controller = integral_of_error(
        MODEL, Horizon(10, 4), 1.0, 1.0, Limits(u=(-1, 1)), "zero", backend="broken"
    )
    scenario = Scenario(steps(5.0, each=60), v=np.zeros(60))
    broken["now"] = False
    run = closed_loop(MODEL, controller, scenario)
    first = np.flatnonzero(run.status)[0]
    assert (run.status[first:] == Status.HELD).all()
    assert np.ptp(run.u[max(first - 1, 0) :]) == 0.0


@pytest.mark.parametrize("reading", ["held", "zero"])
@pytest.mark.parametrize("stops", [True, False])
def test_sum_of_the_error_stops_at_a_level_limit(reading, stops):
    """Promise 3: after a reference out of reach the input leaves its limit at once."""
    lag = DifferenceModel([-0.9], [0.1])
    limits = Limits(u=(-1.0, 1.0))
    controller = integral_of_error(
        lag, Horizon(12, 4), 0.1, 0.1, limits, reading, anti_windup=stops
    )
    run = closed_loop(lag, controller, Scenario(steps(3.0, 0.5, each=100)))
    assert run.u[95:100] == pytest.approx(1.0)
    left = run.u[102, 0] < 1.0 - DECISION
    assert left == stops  # the thesis's sum keeps it there for the whole window
    if stops:
        assert run.y[-1, 0] == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda c, m: c.measure(m, np.zeros(3), [0.0], [0.0]), "y has shape"),
        (lambda c, m: c.measure(m, [0.0], np.zeros(3), [0.0]), "r has shape"),
        (lambda c, m: c.measure(m, [0.0], [0.0], np.zeros(3)), "v has shape"),
        (lambda c, m: c.decide(m, r=np.zeros((1, 3))), "r has shape"),
        (lambda c, m: c.apply(m, np.zeros(3), c.decide(m)), "u has shape"),
        (lambda c, m: c.start(y0=np.zeros(2)), "y0 has shape"),
        (lambda c, m: c.start(u0=[np.nan]), "u0 = .* is not finite"),
    ],
)
def test_vectors_of_the_wrong_size_are_refused(call, message):
    """Each argument is named with its shape."""
    controller = build("disturbance_direct")
    memory = controller.measure(controller.start(), [0.0], [0.0], [0.0])
    with pytest.raises(ValueError, match=message):
        call(controller, memory)


def test_integral_of_error_alone_holds_its_sum(rng):
    """The sum of the error in the memory is the sum of the error of the run."""
    controller = integral_of_error(
        MODEL, Horizon(6, 3), 1.0, 1.0, LIMITS, anti_windup=False
    )
    scenario = Scenario(steps(0.5), v=np.zeros(40), noise=rng.standard_normal(40))
    layout = controller.form.recipe.layout
    total = 0.0
    for sample in samples(MODEL.plant(), controller, scenario):
        total += 0.5 - sample.measured[0]
        held = layout.read(sample.memory.vector, "integral")[0]
        assert held == pytest.approx(total, abs=REPLAY)


def test_design_in_place_of_a_controller_is_explained():
    """What is easily mistaken for each other."""
    design = Design("wang_young", MODEL)
    with pytest.raises(ValueError, match=r"Design, expected a Controller.*build\(\)"):
        closed_loop(MODEL, design, Scenario(np.ones(3)))


def test_loop_that_diverges_says_when():
    """An unstable plant that its limits cannot hold ends in a message, not in NaN."""
    wild = DifferenceModel([-3.0], [1.0])
    controller = wang_young(wild, Horizon(5, 2), 1.0, 1.0, Limits(u=(-1, 1)))
    scenario = Scenario(np.zeros(1000), output_disturbance=np.full(1000, 5.0))
    with (
        np.errstate(over="ignore", invalid="ignore"),
        pytest.raises(ValueError, match="diverged: y is no longer finite at sample"),
    ):
        closed_loop(wild, controller, scenario)


def test_input_pinned_at_zero_is_a_limit():
    """Sides that coincide at zero hold, and the moves say so."""
    controller = wang_young(MODEL, Horizon(5, 2), 1, 1, Limits(du=(0, 0)))
    run = closed_loop(MODEL, controller, Scenario(np.ones(6), v=np.zeros(6)))
    assert np.abs(run.u).max() < DECISION
    assert (run.status == Status.LIMITED).any()


def test_plain_number_is_one_channel():
    """A single measurement needs no brackets."""
    controller = build("wang_young")
    memory = controller.measure(controller.start(), 0.5, 1.0, 0.0)
    same = controller.measure(controller.start(), [0.5], [1.0], [0.0])
    assert np.array_equal(memory.vector, same.vector)
