"""Tuning by goals: the definition of attainment, known answers, and manners."""

import dataclasses
import functools
import pickle

import numpy as np
import pytest
from conftest import ALGEBRA

import nmss_lab as lab
from nmss_lab.measures import measures, steps
from nmss_lab.tuning import NOT_REACHED, OBJECTIVES, attained, evaluate

MODEL = lab.DifferenceModel([-1.5, 0.56], [0.1, 0.08])
DISTURBED = lab.DifferenceModel([-1.5, 0.56], [0.1, 0.08], [0.05, 0.02])
SCENARIO = lab.Scenario(np.ones(30))
TRIALS = [lab.Trial(MODEL, SCENARIO)]
DESIGN = lab.Design("wang_young", MODEL, lab.Horizon(10, 3), 1.0, 0.5)
GOALS = [lab.Goal("overshoot", 0.02), lab.Goal("IAE", 3.0)]


def short(design=DESIGN, goals=GOALS, trials=TRIALS, **more) -> lab.Tuned:
    """Return a search that takes about a second."""
    return lab.tune(design, goals, trials, **{"starts": 1, "evaluations": 40, **more})


# --- Goals -------------------------------------------------------------------------


def test_attainment_is_the_miss_over_the_importance() -> None:
    """(5.5): F - w lambda <= F*, so lambda is (F - F*) / w."""
    assert lab.Goal("IAE", 2.0, importance=0.5).attainment(3.0) == 2.0
    assert lab.Goal("IAE", 2.0, importance=0.5).attainment(1.0) == -2.0
    assert lab.Goal("IAE", 2.0).attainment(3.0) == 0.5  # relative to the target
    assert lab.Goal("IAE", 0.0).attainment(3.0) == 3.0


def test_hard_goals_count_only_when_missed() -> None:
    """Without importance a goal is hard: met or not, never paid for."""
    hard = lab.Goal("IAE", 2.0, importance=0.0)
    assert hard.is_hard
    assert hard.attainment(1.0) == 0.0
    assert hard.attainment(3.0) == 0.5
    soft = lab.Goal("overshoot", 0.1)
    assert not soft.is_hard
    assert attained([soft, hard], np.array([0.2, 1.9])) == pytest.approx(1.0)
    assert attained([soft, hard], np.array([0.0, 2.2])) >= NOT_REACHED * 0.1 - 1e-9


def test_the_factor_is_the_worst_of_the_soft_goals() -> None:
    """The smallest lambda that fulfils every row of (5.5)."""
    goals = [lab.Goal("IAE", 2.0, 1.0), lab.Goal("ISE", 1.0, 0.1)]
    values = np.array([2.5, 1.2])
    factor = attained(goals, values)
    for goal, value in zip(goals, values, strict=True):
        assert value - goal.weight * factor <= goal.target + 1e-12
        assert factor == pytest.approx(2.0)
    assert attained(goals, np.array([1.0, 0.9])) == pytest.approx(-1.0)


def test_what_cannot_be_told_is_not_reached() -> None:
    """An objective that is nan counts as far from any target."""
    assert lab.Goal("IAE", 2.0).attainment(float("nan")) == NOT_REACHED


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"objective": "beauty"}, 'objective "beauty": expected one of overshoot'),
        ({"target": np.inf}, "target = inf is not finite"),
        ({"importance": -1.0}, "importance = -1.0: expected 0 or more"),
        ({"over": 1.5}, 'over = 1.5: expected "mean" or a quantile'),
    ],
)
def test_goals_are_checked(arguments: dict, message: str) -> None:
    """Mistakes are told when the goal is written down."""
    with pytest.raises(ValueError, match=message):
        lab.Goal(**{"objective": "IAE", "target": 1.0, **arguments})


# --- Objectives --------------------------------------------------------------------


def test_objectives_are_the_measures() -> None:
    """Named objectives are what the measures of the run say."""
    run = lab.closed_loop(MODEL, DESIGN.build(), SCENARIO)
    first, found = steps(run)[0], measures(run)
    wanted = {
        "overshoot": first.overshoot,
        "rise": first.rise,
        "reach": first.t90,
        "settling": first.settling,
        "IAE": found.iae,
        "ISE": found.ise,
        "coupling": 0.0,
        "peak": run.y.max(),
        "smoothness": found.smoothness,
        "effort": np.sqrt((run.u**2).mean()),
        "violations": 0.0,
    }
    goals = [lab.Goal(name, 1.0) for name in wanted]
    values = evaluate(DESIGN, goals, TRIALS)
    assert values == pytest.approx(list(wanted.values()))
    assert set(wanted) | {"undershoot"} == set(OBJECTIVES)


def test_radius_is_the_largest_pole() -> None:
    """Of the loop without limits, on the plant of the trial."""
    plant = MODEL.varied(numerator=1.4)
    trials = [lab.Trial(plant, SCENARIO)]
    (found,) = evaluate(DESIGN, [lab.Goal("radius", 0.5)], trials)
    loop = lab.linear_loop(DESIGN.build(), plant)
    assert found == pytest.approx(loop.radius, rel=ALGEBRA)


def test_the_worst_step_counts() -> None:
    """Over several steps of the reference; one that never comes counts as late."""
    reference = np.concatenate([np.ones(30), 3.0 * np.ones(2), np.ones(30)])
    trials = [lab.Trial(MODEL, lab.Scenario(reference))]
    (rise,) = evaluate(DESIGN, [lab.Goal("rise", 1.0)], trials)
    assert rise == 2.0 * len(reference)


def test_distance_is_the_sum_of_table_5_2() -> None:
    """Sum of abs(y - desired) times dt, of one output or of all."""
    model = lab.DifferenceModel([-0.8 * np.eye(2)], [np.eye(2)], dt=2.0)
    design = lab.Design("wang_young", model, R=0.2)
    run = lab.closed_loop(model, design.build(), lab.Scenario(np.ones((9, 2))))
    desired = np.column_stack([np.full(9, 0.5), np.ones(9)])
    gap = np.abs(run.y - desired)
    assert lab.Distance(desired)(run) == pytest.approx(2.0 * gap.sum())
    assert lab.Distance(desired, 1)(run) == pytest.approx(2.0 * gap[:, 1].sum())
    assert lab.Distance(desired[:, 0], 0)(run) == pytest.approx(2.0 * gap[:, 0].sum())
    with pytest.raises(ValueError, match="desired has 8 samples, the run has 9"):
        lab.Distance(desired[:8])(run)


def last_input(run: lab.Run) -> float:
    """Return a measure of one's own."""
    return float(run.u[-1, 0])


def test_ones_own_measure() -> None:
    """A function of a run is an objective like the named ones."""
    (found,) = evaluate(DESIGN, [lab.Goal(last_input, 1.0)], TRIALS)
    run = lab.closed_loop(MODEL, DESIGN.build(), SCENARIO)
    assert found == pytest.approx(run.u[-1, 0])


ENSEMBLE = [MODEL.varied(numerator=f) for f in (0.7, 0.9, 1.0, 1.3, 1.6)]


@pytest.mark.parametrize(
    ("over", "of"),
    [
        (1.0, np.max),
        (0.5, np.median),
        (0.9, functools.partial(np.quantile, q=0.9)),
        ("mean", np.mean),
    ],
)
def test_ensembles_are_summed_up(over, of) -> None:
    """The worst plant, a quantile or the mean of all, as the goal says."""
    (found,) = evaluate(
        DESIGN, [lab.Goal("IAE", 1.0, over=over)], [lab.Trial(ENSEMBLE, SCENARIO)]
    )
    each = [
        measures(lab.closed_loop(plant, DESIGN.build(), SCENARIO)).iae
        for plant in ENSEMBLE
    ]
    assert found == pytest.approx(of(each))


WILD = MODEL.varied(numerator=60.0)
"""Plant on which the loop of ``DESIGN`` runs away."""


@pytest.mark.parametrize("objective", ["overshoot", "effort", "violations", "IAE"])
def test_a_loop_that_runs_away_has_no_measures(objective: str) -> None:
    """What it did before it was given up is not taken for a small effort."""
    trials = [lab.Trial(WILD, lab.Scenario(np.ones(80)))]
    goal = lab.Goal(objective, 1.0)
    assert np.isnan(evaluate(DESIGN, [goal], trials)).all()


def test_a_quantile_forgives_loops_that_run_away() -> None:
    """The median of five plants is told although one loop diverges; the worst not."""
    trials = [lab.Trial([*ENSEMBLE[:4], WILD], lab.Scenario(np.ones(80)))]
    goals = [lab.Goal("IAE", 1.0, over=over) for over in (0.5, 1.0, "mean")]
    median, *others = evaluate(DESIGN, goals, trials)
    each = [
        measures(lab.closed_loop(p, DESIGN.build(), trials[0].scenario)).iae
        for p in ENSEMBLE[:4]
    ]
    assert median == pytest.approx(sorted(each)[2])
    assert np.isnan(others).all()


def test_a_goal_looks_at_its_trial() -> None:
    """Of several trials one, or all together."""
    half = lab.Scenario(0.5 * np.ones(30))
    trials = [*TRIALS, lab.Trial(MODEL, half)]
    goals = [lab.Goal("IAE", 1.0, trial=trial) for trial in (0, 1, None)]
    whole, small, both = evaluate(DESIGN, goals, trials)
    assert small == pytest.approx(whole / 2.0)  # a linear loop
    assert both == whole


# --- Searches ----------------------------------------------------------------------

ONE_WEIGHT = lab.Weights(DESIGN, fixed=["weight_y"])
TRADED = [lab.Goal("IAE", 3.5, 1.0), lab.Goal("smoothness", 0.2, 0.1)]
"""A quick loop moves much: only the ratio of the two weights matters."""


def test_a_trade_off_that_a_scan_finds() -> None:
    """With one weight the optimum is where a fine scan of it says."""
    vectors = np.linspace(-3.0, 3.0, 150)
    factors = [
        attained(TRADED, evaluate(ONE_WEIGHT.apply(np.array([v])), TRADED, TRIALS))
        for v in vectors
    ]
    found = lab.tune(DESIGN, TRADED, TRIALS, ONE_WEIGHT, evaluations=300)
    best = int(np.argmin(factors))
    assert found.attainment <= factors[best]
    # At the optimum both goals are missed alike, and it lies beside the scan's best.
    assert np.ptp([row["attainment"] for row in found.table()]) < 1e-3
    vector = lab.Weights(found.design, fixed=["weight_y"]).start[0]
    assert abs(vector - vectors[best]) < 2.0 * (vectors[1] - vectors[0])


def test_importance_decides_who_gives_way() -> None:
    """The goal that matters more is missed less."""
    out_of_reach = [lab.Goal("IAE", 2.5, 1.0), lab.Goal("smoothness", 0.2, 0.1)]
    strict = [out_of_reach[0], dataclasses.replace(out_of_reach[1], importance=0.01)]
    free, bound = (
        lab.tune(DESIGN, goals, TRIALS, ONE_WEIGHT) for goals in (out_of_reach, strict)
    )
    assert bound.values[1] < free.values[1]
    assert bound.values[0] > free.values[0]


def test_hard_goals_are_met() -> None:
    """A hard goal is kept to whatever the soft one would like."""
    hard = lab.Goal("smoothness", 0.2, importance=0.0)
    found = lab.tune(DESIGN, [TRADED[0], hard], TRIALS, ONE_WEIGHT)
    assert found.values[1] <= 0.2 * (1.0 + 1e-9)
    # and the soft one uses all that is left, to the tolerance of the search
    assert found.values[1] > 0.199
    row = found.table()[1]
    assert row["hard"]
    assert row["attainment"] <= 1e-9


def test_goals_within_reach_are_more_than_met() -> None:
    """The factor is negative, and the result says that everything is attained."""
    easy = [lab.Goal("overshoot", 0.3), lab.Goal("IAE", 8.0)]
    found = short(goals=easy)
    assert found.attainment < 0.0
    assert found.is_attained
    assert all(row["missed"] < 0.0 for row in found.table())
    assert not short().is_attained


def test_the_result_is_what_it_says() -> None:
    """Values, factor and weights are those of the design that is returned."""
    found = short()
    assert evaluate(found.design, GOALS, TRIALS) == pytest.approx(found.values)
    assert evaluate(DESIGN, GOALS, TRIALS) == pytest.approx(found.before)
    assert found.attainment == pytest.approx(attained(GOALS, found.values))
    assert pytest.approx(found.weights["weight_y"]) == found.design.Q
    assert pytest.approx(found.weights["weight_u"]) == found.design.R


def test_the_same_seed_the_same_answer() -> None:
    """Bit by bit; another seed tries other designs."""
    tried: dict[str, list[float]] = {"one": [], "same": [], "other": []}

    def noted(name: str, run: lab.Run) -> float:
        tried[name].append(measures(run).iae)
        return tried[name][-1]

    found = {
        name: short(
            goals=[lab.Goal(functools.partial(noted, name), 1.0)], starts=3, seed=seed
        )
        for name, seed in (("one", 1), ("same", 1), ("other", 2))
    }
    assert tried["one"] == tried["same"]
    assert found["one"].attainment == found["same"].attainment
    for name, weight in found["one"].weights.items():
        assert np.array_equal(weight, found["same"].weights[name])
    assert tried["one"] != tried["other"]


def test_history_improves() -> None:
    """Every step is better than the one before, and the last is the result."""
    history = short(evaluations=120, starts=2).history
    factors = [step.attainment for step in history]
    assert len(factors) > 3
    assert (np.diff(factors) < 0.0).all()
    assert (np.diff([step.evaluation for step in history]) > 0).all()
    for step in history:
        assert step.attainment == pytest.approx(attained(GOALS, step.values))


@pytest.mark.parametrize("evaluations", [1, 2, 7, 40])
def test_the_budget_is_kept(evaluations: int) -> None:
    """No more designs are tried than allowed, and the sentence says so."""
    tried = []

    def counted(run: lab.Run) -> float:
        tried.append(run)
        return measures(run).iae

    found = short(goals=[lab.Goal(counted, 1.0)], evaluations=evaluations)
    assert found.evaluations == evaluations
    assert len(tried) == evaluations + 1  # and the design itself, before
    assert f"has tried {evaluations} designs, as allowed" in found.stopped


def test_a_callback_stops_and_keeps_the_best() -> None:
    """The search ends where the callback says, with what it has told last."""
    told = []

    def enough(step) -> bool:
        told.append(step)
        return len(told) == 4

    found = short(evaluations=1000, callback=enough)
    assert found.stopped == "The search was stopped by the callback."
    assert len(told) == 4
    assert found.attainment == told[-1].attainment
    assert found.evaluations == told[-1].evaluation < 1000


def test_a_callback_hears_of_fruitless_designs() -> None:
    """At least after every 20 designs, so that a bar moves and a button answers."""
    told = []
    short(evaluations=150, callback=lambda step: told.append(step.evaluation))
    assert max(np.diff([0, *told])) <= 20


def test_a_callback_stops_in_the_middle_of_a_batch() -> None:
    """The many starts are not all tried before anybody can say stop."""
    tried = []

    def counted(run: lab.Run) -> float:
        tried.append(run)
        return measures(run).iae

    found = short(goals=[lab.Goal(counted, 1.0)], starts=30, callback=lambda step: True)
    assert found.evaluations == 1
    assert len(tried) == 2  # the design before, and the first start


def test_results_can_be_sent() -> None:
    """Results can be kept and sent: they hold no function of their own."""
    again = pickle.loads(pickle.dumps(short()))
    assert evaluate(again.design, GOALS, TRIALS) == pytest.approx(again.values)


def never(run: lab.Run) -> float:
    """Return what cannot be told."""
    return float("nan")


def test_nothing_finite_is_said_in_a_sentence() -> None:
    """The design comes back as it was, and the sentence tells why."""
    found = short(goals=[lab.Goal(never, 1.0)], evaluations=1000)
    assert found.stopped == (
        "No design that was tried has a finite value for every goal."
    )
    assert found.design is DESIGN
    assert not found.is_attained


def test_a_start_that_no_vector_can_say_is_kept() -> None:
    """A gain that no weights give is returned where nothing beats it."""
    K = lab.pole_gain(MODEL, [0.0, 0.5, 0.4 + 0.3j, 0.4 - 0.3j])
    design = lab.Design("pip", MODEL, options={"K": K})
    y = lab.closed_loop(MODEL, design.build(), SCENARIO).y
    found = short(design, [lab.Goal(lab.Distance(y), 0.1)], evaluations=10)
    assert found.design is design
    assert found.attainment == pytest.approx(-1.0)
    assert found.values == pytest.approx([0.0])


def case_designs(name: str, structures: list[str]) -> dict[str, lab.Design]:
    """Return designs of a case by structure."""
    designs = lab.case(name).designs.values()
    return {d.structure: d for d in designs if d.structure in structures}


@pytest.mark.parametrize("structure", [*lab.STRUCTURES, "pip"])
@pytest.mark.parametrize("per_step", [False, True])
def test_every_structure_is_tuned(structure: str, per_step: bool) -> None:
    """At least as good as the start, and better where it began badly."""
    if structure == "pip" and per_step:
        return
    options = {"K": lab.lq_gain(DISTURBED, 1.0, 20.0)} if structure == "pip" else {}
    design = lab.Design(
        structure, DISTURBED, lab.Horizon(6, 3), 1.0, 20.0, options=options
    )
    trials = [lab.Trial(DISTURBED, lab.Scenario(np.ones(30), v=0.2 * np.ones(30)))]
    goals = [lab.Goal("IAE", 3.0), lab.Goal("overshoot", 0.1)]
    weights = lab.Weights(design, per_step=per_step)
    found = lab.tune(design, goals, trials, weights, starts=1, evaluations=60)
    assert found.attainment < attained(goals, found.before)
    assert evaluate(found.design, goals, trials) == pytest.approx(found.values)


@pytest.mark.parametrize("structure", ["sdp_increments", "sdp_integral_of_error"])
def test_state_dependent_structures_are_tuned(structure: str) -> None:
    """The same for plants whose coefficients depend on their state."""
    example = lab.case("product_8_5_2")
    design = case_designs("product_8_5_2", [structure])[structure]
    scheme = {**design.options, "settling": lab.Settling("frozen")}
    design = dataclasses.replace(design, options=scheme)
    trials = [lab.Trial(example.plant, example.scenario)]
    start = lab.Weights(design)
    sluggish = start.apply(start.start + 2.0 * np.eye(start.count)[-1])
    found = short(sluggish, [lab.Goal("IAE", 1.0)], trials, evaluations=25)
    assert found.attainment < attained(found.goals, found.before)


def test_state_dependent_pip_is_tuned() -> None:
    """Its weights are what is tuned, also where poles were given before."""
    model = lab.StateDependentModel(a=["-0.7 + 0.1*y[k-1]"], b=["1.0"])
    design = lab.Design("sdp_pip", model, options={"poles": (0.8, 0.8)})
    trials = [lab.Trial(model, lab.Scenario(0.5 * np.ones(20)))]
    found = short(design, [lab.Goal("IAE", 0.5)], trials)
    assert found.attainment < attained(found.goals, found.before)
    assert "poles" not in found.design.options


def test_several_inputs_and_outputs() -> None:
    """Cross-coupling is an objective of the output that should stay."""
    model = lab.DifferenceModel([-0.8 * np.eye(2)], [[[0.5, 0.1], [0.2, 0.4]]])
    reference = np.column_stack([np.ones(20), np.zeros(20)])
    trials = [lab.Trial(model, lab.Scenario(reference))]
    goals = [lab.Goal("IAE", 2.0, channel=0), lab.Goal("coupling", 0.05, channel=1)]
    design = lab.Design("wang_young", model, R=3.0)
    found = short(design, goals, trials, evaluations=80)
    assert (found.values < found.before).all()


def test_further_starts_are_tried() -> None:
    """A design given beside is a start: the result is at least as good as it."""
    given = ONE_WEIGHT.apply(np.array([-0.7]))
    found = lab.tune(
        DESIGN, TRADED, TRIALS, ONE_WEIGHT, starts=1, evaluations=2, also=[given]
    )
    assert found.attainment <= attained(TRADED, evaluate(given, TRADED, TRIALS)) + 1e-12


# --- Fronts ------------------------------------------------------------------------


def test_no_point_of_a_front_beats_another() -> None:
    """Quicker always costs smoothness, and the ends are far apart."""
    goals = [lab.Goal("IAE", 2.5, 1.0), lab.Goal("smoothness", 0.05, 0.1)]
    front = lab.pareto(
        DESIGN, goals, TRIALS, points=5, weights=ONE_WEIGHT, evaluations=60, starts=1
    )
    values = np.array([point.values for point in front])
    assert len(front) >= 4
    assert (np.diff(values[:, 0]) > 0.0).all()
    assert (np.diff(values[:, 1]) < 0.0).all()
    assert values[-1, 0] > 1.2 * values[0, 0]


def test_fronts_need_two_soft_goals() -> None:
    """A hard goal cannot be traded off, and one point is no front."""
    hard = lab.Goal("IAE", 1.0, importance=0.0)
    with pytest.raises(ValueError, match="the first two are traded off"):
        lab.pareto(DESIGN, [GOALS[0], hard], TRIALS)
    with pytest.raises(ValueError, match="points = 1: expected at least 2"):
        lab.pareto(DESIGN, GOALS, TRIALS, points=1)


# --- Errors ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"goals": [lab.Goal("IAE", 1.0, importance=0.0)]}, "goals has no soft goal"),
        ({"goals": []}, "goals has no soft goal"),
        ({"goals": [lab.Goal("IAE", 1.0, trial=1)]}, "names trial 1, there are 1"),
        ({"starts": 0}, "starts = 0: expected at least 1"),
        ({"evaluations": 0}, "evaluations = 0: expected at least 1"),
        ({"goals": [lab.Goal("IAE", 1.0, channel=2)]}, "channel = 2"),
        ({"trials": [lab.Trial(MODEL, lab.Scenario(np.ones((9, 2))))]}, "2 columns"),
    ],
)
def test_errors_are_named(change: dict, message: str) -> None:
    """Before the search begins, with the argument's name."""
    with pytest.raises(ValueError, match=message):
        short(**change)
