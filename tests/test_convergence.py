"""What passes did and what their plans are worth: against a plain optimisation."""

import dataclasses
import logging

import numpy as np
import pytest
import scipy.optimize
from conftest import DECISION, REPLAY
from test_sdp_mpc import (
    CYCLE,
    FORMS,
    LEVELS,
    MOVES,
    PRODUCT,
    REST,
    STEP,
    cycle_run,
    levels,
    moves,
    run_step,
)

from nmss_lab import qp
from nmss_lab.controller import Limits, Status
from nmss_lab.convergence import (
    best_plan,
    examine,
    iterates,
    shares,
    trail_mismatch,
)
from nmss_lab.mpc import wang_young
from nmss_lab.predict import Horizon
from nmss_lab.sdp_mpc import Settling, sdp_increments
from nmss_lab.simulate import Scenario, closed_loop

STATIONARY = 1e-7
"""What the issue asks of fixed points: residual of the optimality conditions."""

TIGHT = {"tolerance": 1e-10}

SHORT = STEP[:14]


def true_cost(z, y, u, r):
    """Cost of moves with the weights of 8.5.2, by a plain loop."""
    total, level, before = 0.0, y, u
    for i in range(10):
        change = z[i] if i < 8 else 0.0
        now = before + change
        level = 0.7 * level + before * now
        before = now
        total += 0.1 * (level - r) ** 2 + change**2
    return total


def best_by_hand(y, u, r):
    """Lowest cost with inputs to 0.82 and rates to 0.15, from several starts."""
    rows = scipy.optimize.LinearConstraint(
        np.vstack([np.tri(8), np.eye(8)]),
        np.r_[np.full(8, -0.82 - u), np.full(8, -0.15)],
        np.r_[np.full(8, 0.82 - u), np.full(8, 0.15)],
    )
    starts = [np.zeros(8), *np.random.default_rng(3).uniform(-0.1, 0.1, (4, 8))]
    return min(
        scipy.optimize.minimize(
            true_cost,
            start,
            (y, u, r),
            method="SLSQP",
            constraints=[rows],
            options={"ftol": 1e-13, "maxiter": 300},
        ).fun
        for start in starts
    )


def test_best_plan_is_the_best_of_a_plain_optimisation():
    """The thesis example right after its step."""
    run = run_step(moves(Settling(damping=0.0)), SHORT)
    for k in (5, 6, 8):
        before = run.u[k - 1, 0]
        wanted = best_by_hand(run.y[k, 0], before, run.r[k, 0])
        best = best_plan(run, k, starts=2)
        found = true_cost(best.decision, run.y[k, 0], before, run.r[k, 0])
        assert best.cost == pytest.approx(found, rel=REPLAY)
        assert best.cost <= wanted + 1e-7 * wanted  # differences there, slopes here
        assert 1 <= best.found <= best.starts
        assert np.abs(best.u).max() <= 0.82 + DECISION


@pytest.mark.parametrize("scheme", ["gauss-newton", "newton"])
@pytest.mark.parametrize("form", FORMS)
def test_settled_plans_meet_the_true_conditions(form, scheme):
    """Stationary for the true problem; the search finds nothing better."""
    # gauss-newton takes hundreds of passes with the sum
    run = run_step(FORMS[form](Settling(scheme, passes=600, **TIGHT)), STEP[:9])
    found = examine(run, starts=1)
    settled = run.status <= Status.LIMITED
    assert settled.all(), run.sentences
    assert found.stationarity[settled].max() < STATIONARY
    assert (found.cost >= found.best - REPLAY * (1.0 + found.best)).all()
    after = settled & (np.arange(len(run)) >= 5) & (found.best > 1e-6)
    assert after.any()
    assert found.gap[after].max() < 1e-9


@pytest.mark.parametrize("form", FORMS)
def test_iterated_plans_do_not(form):
    """They leave out how coefficients move with the plan; the gap is small here."""
    run = run_step(FORMS[form](Settling(**TIGHT)), SHORT)
    assert (run.status <= Status.LIMITED).all(), run.sentences
    found = examine(run, starts=1)
    after = slice(5, None)
    assert found.stationarity[after].max() > 1e3 * STATIONARY
    assert (found.cost >= found.best - REPLAY * (1.0 + found.best)).all()
    assert 1e-4 < found.gap[5] < 0.1


def test_no_scheme_beats_the_best_plan():
    """The same sample for all of them."""
    for form in (levels, moves):
        for scheme in ("frozen", "iterated", "newton"):
            run = run_step(form(Settling(scheme)), STEP[:6])
            found = examine(run, starts=1)
            slack = REPLAY * (1.0 + np.abs(found.best))
            assert (found.cost >= found.best - slack).all()
            assert (found.gap[np.isfinite(found.gap)] >= -DECISION).all()


def test_examination_tells_of_passes():
    """Numbers of the moves, and the contraction of the plain algorithm: 0.79."""
    run = run_step(moves(Settling(damping=0.0, **TIGHT)), SHORT)
    found = examine(run)
    assert np.array_equal(found.passes, run.iterations)
    assert found.contraction[8:].min() > 0.6
    assert found.contraction[8:].max() < 0.9
    assert np.isnan(found.best).all()
    assert np.isnan(found.gap).all()
    assert np.isnan([found.mismatch[0], found.decrease[0], found.promised[0]]).all()
    assert found.decrease[1:] == pytest.approx(run.cost[:-1] - run.cost[1:])
    seen = []
    examine(run, progress=lambda done, all_: seen.append((done, all_)))
    assert seen == [(k + 1, len(run)) for k in range(len(run))]


def test_what_was_promised_is_the_cost_of_the_shifted_plan():
    """By a plain loop; moves on shift to zero at the end."""
    run = run_step(moves(Settling("newton")), SHORT)
    found, du = examine(run), run.trail("du")[:, :, 0]
    for k in range(1, len(run)):
        shifted = du[k - 1, 1:9]
        wanted = true_cost(shifted, run.y[k, 0], run.u[k - 1, 0], run.r[k, 0])
        assert found.promised[k] == pytest.approx(wanted, rel=REPLAY, abs=1e-15)


@pytest.mark.parametrize("scheme", ["gauss-newton", "newton"])
def test_the_shifted_plan_bounds_the_cost_with_a_terminal_equality(scheme):
    """As proofs need it, on an undisturbed loop with a constant reference."""
    run = run_step(
        moves(Settling(scheme), LEVELS, terminal="equality"), np.full(8, 1.2)
    )
    found = examine(run)
    assert found.kept.all()
    assert (found.decrease[1:] >= -REPLAY).all()


def test_mismatch_is_that_of_overlapping_predictions():
    """Root mean square, from the trail; nan where there is no overlap."""
    run = run_step(moves(Settling("frozen")), SHORT)
    y, found = run.trail("y")[:, :, 0], trail_mismatch(run)
    wanted = [
        np.sqrt(np.mean([(y[k, i] - y[k - 1, i + 1]) ** 2 for i in range(9)]))
        for k in range(1, len(run))
    ]
    assert found[1:] == pytest.approx(np.array(wanted), abs=REPLAY)


def test_a_horizon_of_one_sample_can_be_examined():
    """Nothing overlaps: the mismatch is nan."""
    c = sdp_increments(PRODUCT, Horizon(1, 1), 0.1, 1.0, MOVES)
    found = examine(run_step(c, SHORT), starts=1)
    assert np.isnan(found.mismatch).all()
    assert np.isfinite(found.cost).all()


def test_one_sample_can_be_examined():
    """A run of length one."""
    found = examine(run_step(moves(), STEP[:1]), starts=1)
    assert found.cost.shape == (1,)


# Passes of a sample


@pytest.mark.parametrize("scheme", ["frozen", "iterated", "gauss-newton", "newton"])
@pytest.mark.parametrize("form", FORMS)
def test_iterates_are_the_passes_of_the_run(form, scheme):
    """As many, ending in the same way, at the same plan."""
    run = run_step(FORMS[form](Settling(scheme)), SHORT[:8])
    for k in (0, 5, 7):
        met = iterates(run, k)
        more = 1 if scheme == "frozen" else 0  # the plan it leads to
        assert len(met) == run.iterations[k] + more
        assert met[-1].status == run.status[k]
        applied = min(np.abs(each.u[0] - run.u[k]).max() for each in met[-2:])
        assert applied <= 10 * DECISION  # the last step is not shown
        for each in met:
            rolled = PRODUCT.roll_out(
                run.y[k][None],
                run.u[k - 1][None] if k else np.array([[REST]]),
                each.u,
            )
            assert each.y == pytest.approx(rolled, abs=REPLAY)


def test_iterates_may_settle_in_another_way():
    """The two-cycle again, resolved from the same start."""
    run = cycle_run(Settling(damping=0.0))
    assert iterates(run, 0)[-1].status == Status.CYCLED
    other = iterates(run, 0, Settling(damping=0.5))
    assert other[-1].status <= Status.LIMITED
    assert other[0].frozen
    assert not other[-1].frozen
    few = iterates(run, 0, Settling(damping=0.0, passes=4))
    assert len(few) == 4
    assert few[-1].status == Status.UNSETTLED


def test_shares_add_up():
    """Of all samples of all runs."""
    runs = [cycle_run(Settling(damping=d), 12) for d in (0.0, 0.5)]
    found = shares(runs)
    parts = (
        found.settled,
        found.cycled,
        found.unsettled,
        found.diverged,
        found.other,
    )
    assert sum(parts) == pytest.approx(1.0)
    assert found.samples == 24
    assert found.cycled > 0.0
    assert found.passes == pytest.approx(
        np.concatenate([run.iterations for run in runs]).mean()
    )


# Samples without a plan


def raising(problem):
    """Solver that is not there."""
    raise RuntimeError("no licence")


@pytest.fixture
def broken(monkeypatch):
    """Backend that always raises, and no log."""
    monkeypatch.setitem(qp.BACKENDS, "broken", raising)
    logging.disable(logging.CRITICAL)
    yield "broken"
    logging.disable(logging.NOTSET)


def test_continued_plans_are_examined_at_their_own_sample(broken):
    """They carry the known vector of the sample that applies them."""
    run = run_step(moves(Settling("frozen"), backend=broken), SHORT)
    gone = run.status == Status.SHIFTED
    assert gone.any()
    found = examine(run)
    k = int(np.flatnonzero(gone)[1])
    # the plan made before the step of the reference does nothing: du = 0 from here on
    wanted = true_cost(np.zeros(8), run.y[k, 0], run.u[k - 1, 0], run.r[k, 0])
    assert found.cost[k] == pytest.approx(wanted, rel=1e-3)  # it moves a little
    assert found.promised[k] == pytest.approx(found.cost[k])
    assert run.cost[k] == pytest.approx(found.cost[k])


def test_a_run_that_never_had_a_plan_can_be_examined(broken):
    """From the first sample on the solver fails."""
    c = moves(limits=Limits(u=(-1, 1), du=(-1e-3, 1e-3)), backend=broken)
    run = run_step(c, np.full(4, 2.0))
    assert (run.status == Status.HELD).any(), run.sentences
    found = examine(run, starts=1)
    assert np.isnan(found.cost[run.status == Status.HELD]).all()


def test_best_plan_starts_from_outside_the_limits_too():
    """By hand beyond the level limit: limits widen to what can be reached."""
    manual = np.full(8, np.nan)
    manual[:4] = 1.5
    limits = Limits(u=(-0.8, 0.8), du=(-0.05, 0.05))
    run = run_step(moves(limits=limits), np.ones(8), manual=manual)
    best = best_plan(run, 4, 2)
    assert np.isfinite(best.cost)
    assert np.abs(np.diff(best.u[:, 0], prepend=1.5)).max() <= 0.05 + DECISION


# Mistakes


def test_mistakes_are_named():
    """Another controller, no moves, no such sample."""
    run = run_step(moves(), STEP[:3])
    with pytest.raises(ValueError, match="k = 3: the run has samples 0 to 2"):
        iterates(run, 3)
    with pytest.raises(ValueError, match="k = -1"):
        best_plan(run, -1)
    with pytest.raises(ValueError, match="kept no moves"):
        examine(dataclasses.replace(run, moves=None))
    from nmss_lab.models import DifferenceModel

    plant = DifferenceModel([-0.5], [1.0])
    linear = closed_loop(
        plant, wang_young(plant, Horizon(3, 2), 1.0, 1.0), Scenario(np.ones(3))
    )
    with pytest.raises(ValueError, match="PredictiveController, expected one of sdp_"):
        examine(linear)


def test_the_cycle_is_the_one_of_the_notes():
    """Horizon, weights and limits as written down."""
    assert CYCLE["horizon"] == Horizon(10, 6)


def test_passes_shown_are_those_of_a_run_that_settles_so():
    """Another way to settle, asked of one run's sample, takes the passes of its own."""
    run = run_step(moves(Settling("iterated")), SHORT)
    for settling in (Settling("gauss-newton"), Settling("iterated", damping=0.0)):
        own = run_step(moves(settling), SHORT[:1])
        other = run_step(moves(Settling("newton")), SHORT[:1])
        shown = [iterates(each, 0, settling) for each in (own, other)]
        assert len(shown[0]) == own.iterations[0]
        assert [each.cost for each in shown[0]] == [each.cost for each in shown[1]]
    assert len(iterates(run, 5)) == run.iterations[5]
