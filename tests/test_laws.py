"""Laws of a single loop: right wherever they answer, learnt once, exact on limits."""

import dataclasses
import gc
import pickle

import numpy as np
import pytest

from nmss_lab import qp
from nmss_lab.cases import CASES, case, square_wave
from nmss_lab.controller import Limits, Status
from nmss_lab.governor import governor
from nmss_lab.laws import Law, Laws, Solver
from nmss_lab.models import DifferenceModel
from nmss_lab.mpc import integral_of_error, wang_young
from nmss_lab.pip import pole_gain
from nmss_lab.predict import Horizon
from nmss_lab.predictive import PredictiveController
from nmss_lab.simulate import Scenario, closed_loop, samples

MODEL = DifferenceModel([-1.5, 0.56], [0.1, 0.06])
TIGHT = Limits(u=(-1.0, 1.0), du=(-0.17, 0.17))
SCENARIO = Scenario(1.5 * square_wave(60, 30))

SAME = 1e-8
"""Two exact solutions of one program, relative to 1 + its size; 1e-10 is seen."""


def built(limits=TIGHT, **more):
    """Return a controller that meets its limits in ``SCENARIO``."""
    return wang_young(MODEL, Horizon(20, 5), 1.0, 0.1, limits, **more)


@pytest.fixture
def asked(monkeypatch):
    """Known vectors for which a solver was asked."""
    vectors = []

    def counting(self, theta, ask=Solver.held):
        vectors.append(theta)
        return ask(self, theta)

    monkeypatch.setattr(Solver, "held", counting)
    return vectors


def by_laws(controller):
    """Whether a controller has limits and follows laws."""
    if not (isinstance(controller, PredictiveController) and controller.n_rows):
        return False
    return controller.follows_laws and controller.ranked.strict


@pytest.mark.parametrize("name", CASES)
def test_move_is_the_solution_of_the_program(name):
    """In every worked case and design, at every sample, whichever law gave it."""
    found = case(name)
    for design in found.designs.values():
        controller = design.build()
        if by_laws(controller):
            check_moves(controller, found.plant, found.scenario)


def check_moves(controller, plant, scenario):
    """Compare each move of a law with a solver's."""
    counted = 0
    for sample in samples(plant, controller, scenario):
        move = sample.move
        if move.law is None:
            continue
        counted += 1
        wanted = qp.solve(controller.program, move.known, "daqp")
        size = 1.0 + np.abs(wanted.decision).max()
        assert np.abs(move.decision - wanted.decision).max() < SAME * size
        u = controller.first_move.value(wanted.decision, move.known)
        assert np.abs(move.u - u).max() < SAME * size
    assert counted > 0.8 * len(scenario)


def test_each_set_of_held_rows_is_solved_once(asked):
    """The second loop asks no solver, and has the same numbers to the last digit."""
    controller = built()
    first = closed_loop(MODEL, controller, SCENARIO)
    assert (first.status == Status.LIMITED).sum() > 20
    sets = {row.tobytes() for row in np.sign(first.multipliers)}
    assert 0 < len(asked) <= len(sets)
    asked.clear()
    second = closed_loop(MODEL, controller, SCENARIO)
    assert asked == []
    for name in ("y", "u", "status", "cost", "multipliers", "iterations"):
        assert np.array_equal(getattr(first, name), getattr(second, name)), name


def test_named_solver_is_asked_whenever_a_limit_holds(asked, monkeypatch):
    """Who chooses DAQP or ProxQP gets it, and the same loop."""
    learnt = closed_loop(MODEL, built(), SCENARIO)
    for name in ("daqp", "proxqp"):
        calls = []

        def counting(problem, solver=qp.BACKENDS[name], calls=calls):
            calls.append(problem)
            return solver(problem)

        monkeypatch.setitem(qp.BACKENDS, name, counting)
        run = closed_loop(MODEL, built(backend=name), SCENARIO)
        assert len(calls) == (run.status == Status.LIMITED).sum() > 20
        assert run.u == pytest.approx(learnt.u, abs=1e-7)  # ProxQP's own 1e-9, fed back


def test_inputs_are_exactly_on_the_limits_that_hold_them():
    """Level and rate, without rounding: no actuator sees more than it may."""
    controller = wang_young(MODEL, Horizon(20, 5), 1.0, 0.1, Limits((-0.7, 0.7)))
    run = closed_loop(MODEL, controller, SCENARIO)
    assert np.abs(run.u).max() == 0.7
    third = Limits(du=(-0.1 / 3, 0.1 / 3))
    loop = samples(MODEL, built(third), SCENARIO)
    before, held = np.zeros(1), 0
    for sample in loop:
        exact = before + np.sign(sample.u - before) * (0.1 / 3)
        held += int((sample.u == exact).all())
        assert np.clip(sample.u, before - 0.1 / 3, before + 0.1 / 3) == sample.u
        before = sample.u
    assert held > 20


def test_input_left_outside_by_hand_is_not_answered_by_a_law(asked):
    """Its limits are wider as long as the rate cannot bring it back."""
    controller = built()
    closed_loop(MODEL, controller, SCENARIO)  # learns laws on the limits
    asked.clear()
    manual = np.full((60, 1), np.nan)
    manual[10:14] = 3.0
    scenario = Scenario(np.full(60, 1.5), manual=manual)
    for sample in samples(MODEL, controller, scenario):
        before = controller.last_input(sample.memory.vector)
        if sample.k > 13 and before > 1.0 + 1e-6:
            assert sample.move.law is None or not sample.move.law.limited
        if sample.k == 14:
            assert sample.u == pytest.approx(2.83)
    assert asked


def test_memory_of_another_design_brings_no_law_with_it():
    """A design may be changed while the loop runs."""
    one, other = built(), built(Limits(u=(-0.5, 0.5)))
    loop = samples(MODEL, one, SCENARIO)
    memories = (sample.memory for sample in loop)
    memory = next(m for m in memories if m.last.law and m.last.law.limited)
    fresh = dataclasses.replace(memory, last=other.start().last)
    assert np.array_equal(other.decide(memory).u, other.decide(fresh).u)
    assert np.abs(other.decide(memory).u).max() <= 0.5


def test_laws_do_not_travel():
    """A controller or a run that goes to another process takes only the free law."""
    controller = built()
    run = closed_loop(MODEL, controller, SCENARIO)
    assert len(controller.laws) > 3
    there = pickle.loads(pickle.dumps(run))
    assert len(there.controller.laws) == 1
    again = closed_loop(MODEL, there.controller, SCENARIO)
    assert np.array_equal(again.u, run.u)


def test_rows_that_depend_on_each_other_go_to_the_solver(asked):
    """A level that is a multiple of the rate: both hold the same input at times."""
    limits = Limits(u=(-0.4, 0.4), du=(-0.2, 0.2))
    controller = wang_young(MODEL, Horizon(20, 5), 1.0, 0.01, limits)
    closed_loop(MODEL, controller, SCENARIO)
    asked.clear()
    run = closed_loop(MODEL, controller, SCENARIO)
    assert 0 < len(asked) < 10
    plain = closed_loop(
        MODEL, dataclasses.replace(controller, backend="daqp"), SCENARIO
    )
    assert run.u == pytest.approx(plain.u, abs=SAME)
    assert np.abs(run.u).max() == 0.4


def test_what_is_kept_is_bounded(monkeypatch):
    """Old laws go together, and the loop does not feel it."""
    monkeypatch.setattr("nmss_lab.laws.MOST", 3)
    few, many = built(), built()
    run = closed_loop(MODEL, few, SCENARIO)
    assert len(few.laws) <= 3
    monkeypatch.undo()
    other = closed_loop(MODEL, many, SCENARIO)
    assert len(many.laws) > 3
    assert np.array_equal(run.u, other.u)


def test_laws_that_had_to_go_are_forgotten(monkeypatch):
    """Those in use do not keep alive what they once came from: loops run for years."""
    monkeypatch.setattr("nmss_lab.laws.MOST", 4)
    controller = built()
    rng = np.random.default_rng(0)
    noise = [0.2 * rng.standard_normal((60, 1)) for _ in range(3)]
    for each in noise:
        loop = Scenario(1.5 * square_wave(60, 30), noise=each)
        run = closed_loop(MODEL, controller, loop)
        assert len({row.tobytes() for row in np.sign(run.multipliers)}) > 8
        assert count_laws(controller) <= 4 + 1  # and the one without held rows


def count_laws(controller):
    """Count the laws of a controller that something still refers to."""
    gc.collect()
    laws = (each for each in gc.get_objects() if isinstance(each, Law))
    return sum(law.region.program is controller.program for law in laws)


def test_wrong_values_handed_to_decide_are_refused():
    """Also by the path without checks of its own: nan, infinity, another shape."""
    controller = built(reference="preview")
    memory = controller.measure(controller.start(), [0.0], [1.0])
    good = np.ones((21, 1))
    assert controller.decide(memory, good).law is not None
    for bad in (np.nan, np.inf, -np.inf):
        wrong = good.copy()
        wrong[-1] = bad
        with pytest.raises(ValueError, match="r is not finite"):
            controller.decide(memory, wrong)
    with pytest.raises(ValueError, match=r"r has shape \(20, 1\)"):
        controller.decide(memory, good[1:])


def test_governor_without_previews_follows_laws_too(asked):
    """The governed reference comes from the law as well."""
    model = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
    K = pole_gain(model, [0.0, 0.0, 0.2, 0.2])
    limits = Limits(u=(-2.0, 2.0), du=(-0.5, 0.5))
    controller = governor(model, K, 10, limits)
    scenario = Scenario(3.0 * square_wave(50, 25))
    run = closed_loop(model, controller, scenario)
    asked.clear()
    again = closed_loop(model, controller, scenario)
    assert asked == []
    assert np.array_equal(run.w, again.w)
    plain = governor(model, K, 10, limits, backend="daqp")
    wanted = closed_loop(model, plain, scenario)
    assert run.w == pytest.approx(wanted.w, abs=1e-7)  # gain and loop magnify rounding
    assert (np.abs(run.w - run.r) > 0.1).any()


def test_what_lies_behind_a_move_is_that_of_the_program():
    """Though it is worked out only when asked for."""
    controller = integral_of_error(MODEL, Horizon(20, 5), 1.0, 0.1, TIGHT)
    held, switched = np.zeros(controller.n_rows), 0
    for sample in samples(MODEL, controller, SCENARIO):
        move = sample.move
        wanted = controller.program.cost(move.decision, move.known)
        assert float(move.cost) == float(wanted)
        u = controller.first_move.value(move.decision, move.known)
        assert move.u == pytest.approx(u, abs=1e-12)  # rounding of two products
        other = dataclasses.replace(move, cost=np.array(7.0))
        assert float(other.cost) == 7.0
        before, held = held, np.sign(move.multipliers)
        if move.law is not None and sample.memory.last.law is not None:
            assert int(move.iterations) == np.count_nonzero(held != before)
            switched += int(move.iterations) > 0
    assert switched > 3


def test_measurement_that_is_no_number_is_said(asked):
    """Its move is refused, and limits hold all the same."""
    controller = built()
    memory = controller.measure(controller.start(), [np.nan], [9.0])
    move = controller.decide(memory)
    assert move.status == Status.REFUSED
    assert np.abs(move.u).max() <= 0.17


def test_laws_are_found_by_their_rows():
    """Signs are those of multipliers; rows that cannot be held make none."""
    laws = built().laws
    assert isinstance(laws, Laws)
    rows = [(row.name, row.step) for row in laws.program.labels]
    held = np.zeros(len(rows), dtype=np.int8)
    held[rows.index(("u", 0))] = 1
    law = laws.of(held)
    assert law.limited
    assert laws.of(held) is law
    held[rows.index(("du", 0))] = 1
    assert laws.of(held) is None
