"""Monte Carlo studies: tables, rates with intervals, bands, parts, memory."""

import os
import subprocess
import sys
import textwrap

import numpy as np
import pandas as pd
import pytest
import scipy.stats
from conftest import REPLAY

import nmss_lab as lab
from nmss_lab import montecarlo
from nmss_lab.cases import stress
from nmss_lab.measures import measures, summary
from nmss_lab.montecarlo import EVENTS, PART, Event, event, join, wilson

MODEL = lab.DifferenceModel([-1.5, 0.56], [0.1, 0.08])
TWO = lab.DifferenceModel(
    [np.diag([-0.8, -0.9])], [[[0.5, 0.1], [0.2, 0.4]]], y_names=("hot", "cold")
)
DESIGNS = {
    "feedback": lab.Design("wang_young", MODEL, lab.Horizon(8, 3), 1.0, 0.3),
    "limited": lab.Design(
        "wang_young", MODEL, lab.Horizon(8, 3), 1.0, 0.3, lab.Limits(u=(-0.6, 0.6))
    ),
}
RANGES = lab.RelativeRanges(MODEL, {"a": 0.02, "b": 0.3})
SCENARIO = lab.Scenario(np.ones(25))
N = 130
"""Two parts of different length."""


@pytest.fixture(scope="module")
def study() -> lab.MonteCarlo:
    """Return a study that keeps everything."""
    return lab.monte_carlo(DESIGNS, RANGES, SCENARIO, N, keep="runs")


# --- The table ---------------------------------------------------------------------


def test_a_row_for_each_loop_and_output(study: lab.MonteCarlo) -> None:
    """Designs one after the other, realisations in order, one row an output."""
    table = study.table
    assert len(table) == 2 * N
    assert len(study) == study.asked == N
    for name, part in table.groupby("design"):
        assert part["realisation"].tolist() == list(range(N)), name
    assert table["design"].tolist() == ["feedback"] * N + ["limited"] * N


def test_columns(study: lab.MonteCarlo) -> None:
    """Who, what was drawn, the largest pole, the measures, and how it ended."""
    first = ["design", "realisation", "output", "a1", "a2", "b1", "b2", "radius"]
    last = ["peak", "excess", "failures", "diverged"]
    measured = list(summary(measures(study.runs["feedback"][0])))
    assert list(study.table.columns) == [*first, *measured, *last]


def test_rows_are_the_measures_of_their_loop(study: lab.MonteCarlo) -> None:
    """Each row is what one loop on that very plant gives."""
    for name, i in (("feedback", 0), ("limited", 99), ("limited", 129)):
        controller = DESIGNS[name].build()
        drawn = lab.realisation(RANGES, i)
        run = lab.closed_loop(drawn.plant, controller, SCENARIO)
        row = study.table.query("design == @name and realisation == @i").iloc[0]
        for key, value in {**summary(measures(run)), **drawn.values}.items():
            # another order of sums in lock step
            assert row[key] == pytest.approx(value, abs=100 * REPLAY, nan_ok=True), key
        loop = lab.linear_loop(controller, drawn.plant)
        assert row["radius"] == pytest.approx(loop.radius, abs=REPLAY)
        assert row["peak"] == pytest.approx(np.abs(run.y).max())
        assert study.poles[name][i] == pytest.approx(loop.poles, abs=1e-6)


def test_nominal_poles(study: lab.MonteCarlo) -> None:
    """The cloud has its centre: the poles on the design's own model."""
    for name, design in DESIGNS.items():
        wanted = lab.linear_loop(design.build()).poles
        assert study.nominal[name] == pytest.approx(wanted)


def test_every_design_meets_the_same_plants(study: lab.MonteCarlo) -> None:
    """Realisations are paired, so that designs can be compared one by one."""
    one, other = (study.table.query("design == @name") for name in DESIGNS)
    for name in ("a1", "a2", "b1", "b2"):
        assert one[name].tolist() == other[name].tolist()
        assert one[name].nunique() == N


def test_several_outputs_have_a_row_each() -> None:
    """With the output's name and its own measures."""
    uncertain = lab.RelativeRanges(TWO, {"b": 0.1})
    scenario = lab.Scenario(np.column_stack([np.ones(20), np.zeros(20)]))
    design = {"one": lab.Design("wang_young", TWO, lab.Horizon(6, 2))}
    found = lab.monte_carlo(design, uncertain, scenario, 5).table
    assert found["output"].tolist() == ["hot", "cold"] * 5
    assert found.query("output == 'hot'")["rise"].notna().all()
    assert found.query("output == 'cold'")["rise"].isna().all()  # it has no step
    assert (found.query("output == 'cold'")["coupling"] > 0.0).all()


def test_measures_of_ones_own() -> None:
    """A further column, a function of the run."""
    own = {"last u": lambda run: float(run.u[-1, 0])}
    found = lab.monte_carlo(DESIGNS, RANGES, SCENARIO, 4, measures=own, keep="signals")
    for name in DESIGNS:
        wanted = found.signals[name].u[:, -1, 0]
        column = found.table.query("design == @name")["last u"]
        assert column.to_numpy() == pytest.approx(wanted)


# --- What is kept ------------------------------------------------------------------


def test_measures_only() -> None:
    """By default no trajectory is kept."""
    found = lab.monte_carlo(DESIGNS, RANGES, SCENARIO, 4)
    assert not found.signals
    assert not found.runs


def test_signals_and_runs(study: lab.MonteCarlo) -> None:
    """On request y and u, or whole runs with their predictions."""
    signals = lab.monte_carlo(DESIGNS, RANGES, SCENARIO, N, keep="signals")
    assert not signals.runs
    for name, kept in signals.signals.items():
        assert kept.y.shape == kept.u.shape == (N, 25, 1)
        for i in (0, 100, 129):
            run = study.runs[name][i]
            assert kept.y[i] == pytest.approx(run.y, abs=REPLAY)
            assert kept.u[i] == pytest.approx(run.u, abs=REPLAY)
            assert run.trail("y").shape == (25, 8, 1)
        assert kept.t == pytest.approx(np.arange(25.0))
        assert kept.r == pytest.approx(np.ones((25, 1)))


def test_bands(study: lab.MonteCarlo) -> None:
    """Quantiles over the realisations at every sample."""
    kept = study.signals["feedback"]
    low, middle, high = kept.band((0.1, 0.5, 0.9))
    inside = ((kept.y >= low) & (kept.y <= high)).mean(axis=0)
    # By the definition of quantiles, to the one realisation that a rank is.
    assert inside[5:] == pytest.approx(np.full((20, 1), 0.8), abs=2.0 / N)
    assert (middle >= low).all()
    assert np.abs(middle[5:] - np.median(kept.y, axis=0)[5:]).max() < 0.02


def test_bands_with_loops_that_ran_away() -> None:
    """They count as infinitely far, on either side, and leave the middle alone."""
    y = np.tile(np.arange(10.0)[:, None, None], (1, 3, 1))
    y[[2, 5], 1:] = np.nan
    kept = montecarlo.Signals(np.arange(3.0), np.zeros((3, 1)), y, y)
    low, middle, high = kept.band((0.0, 0.5, 0.99))
    assert low[:, 0].tolist() == [0.0, -np.inf, -np.inf]
    assert high[:, 0].tolist() == [9.0, np.inf, np.inf]
    assert np.isfinite(middle).all()


# --- Rates -------------------------------------------------------------------------

CASE = lab.case("marginally_stable_6_3_2")
P_STAR = lab.ParameterCovariance(CASE.model, CASE.covariance)


@pytest.fixture(scope="module")
def unstable() -> lab.MonteCarlo:
    """Return a study of 6.3.2, in which many loops are unstable and some diverge."""
    designs = {name: CASE.designs[name] for name in ("wang_young", "forward_path")}
    return lab.monte_carlo(designs, P_STAR, CASE.scenario, 250, keep="signals")


def test_rates_are_counts_of_poles(unstable: lab.MonteCarlo) -> None:
    """As a direct count over the cloud of poles, severity beside it."""
    rates = unstable.rates().set_index(["design", "event"])
    for name, cloud in unstable.poles.items():
        radii = np.abs(cloud).max(axis=1)
        row = rates.loc[name, "unstable"]
        assert row["count"] == (radii >= 1.0 + 1e-6).sum() > 10
        assert row["n"] == 250
        assert row["share"] == row["count"] / 250
        assert row["worst"] == pytest.approx(radii.max())
        assert row["median"] == pytest.approx(np.median(radii[radii >= 1.0 + 1e-6]))
        assert row["low"] < row["share"] < row["high"]


def test_count_and_severity_disagree(unstable: lab.MonteCarlo) -> None:
    """The finding of 6.3.2: forward paths are more often unstable, but mildly so."""
    rates = unstable.rates().set_index(["design", "event"])
    feedback, forward = (
        rates.loc[name, "unstable"] for name in ("wang_young", "forward_path")
    )
    assert forward["count"] > feedback["count"]
    assert forward["worst"] < 1.05 < feedback["worst"]
    # the shares of the 2000 draws of the errata lie in our intervals of 250
    assert feedback["low"] < 0.237 < feedback["high"]
    assert forward["low"] < 0.513 < forward["high"]


def test_diverging_loops_are_counted(unstable: lab.MonteCarlo) -> None:
    """They do not end the study: given up, they have infinite measures."""
    table = unstable.table.query("design == 'wang_young'").reset_index()
    y = unstable.signals["wang_young"].y
    gone = np.isnan(y).any(axis=(1, 2))
    assert 0 < gone.sum() < 250
    assert table["diverged"].tolist() == gone.tolist()
    assert np.isinf(table["IAE"][gone]).all()
    assert np.isinf(table["peak"][gone]).all()
    assert np.isfinite(table["peak"][~gone]).all()
    assert (table["radius"][gone] > 1.0).all()
    assert (table["excess"] == 0.0).all()  # there are no limits to be beyond
    rates = unstable.rates().set_index(["design", "event"])
    assert rates.loc[("wang_young", "diverges"), "count"] == gone.sum()


def test_loops_that_run_away_break_output_limits() -> None:
    """Without a number for how far, the excess is infinite."""
    limits = lab.Limits(y=(-2.0, 2.0))
    design = lab.Design(
        "wang_young", MODEL, lab.Horizon(8, 3), 1.0, 0.5, limits, "held"
    )
    wild = lab.Sampler(lambda rng: MODEL.varied(numerator=60.0))
    found = lab.monte_carlo({"one": design}, wild, lab.Scenario(np.ones(80)), 2)
    assert found.table["diverged"].all()
    assert np.isinf(found.table["excess"]).all()
    rates = found.rates().set_index("event")
    assert rates.loc["breaks a limit", "count"] == 2
    assert rates.loc["breaks a limit", "worst"] == np.inf


def test_events_of_ones_own(study: lab.MonteCarlo) -> None:
    """A level of a column, or any function of the table; nan counts as beyond."""
    limited = study.table.query("design == 'limited'")
    level = float(limited["IAE"].median())
    rates = study.rates(
        {
            "slow": event("IAE", level),
            "high": Event(lambda t: t["peak"] > 1.1, "peak"),
        }
    ).set_index(["design", "event"])
    assert rates.loc[("limited", "slow"), "count"] == (limited["IAE"] > level).sum()
    assert rates.loc[("limited", "high"), "count"] == (limited["peak"] > 1.1).sum()
    table = pd.DataFrame({"x": [1.0, 3.0, np.nan]})
    assert event("x", 2.0).happens(table).tolist() == [False, True, True]


def test_a_loop_counts_once() -> None:
    """An event of any of its outputs is one event of the loop."""
    uncertain = lab.RelativeRanges(TWO, {"b": 0.1})
    scenario = lab.Scenario(np.ones((20, 2)))
    found = lab.monte_carlo(
        {"one": lab.Design("wang_young", TWO)}, uncertain, scenario, 6
    )
    rates = found.rates({"any": event("IAE", -1.0)})
    assert rates["count"].tolist() == [6]
    assert rates["n"].tolist() == [6]
    assert rates["worst"][0] == found.table["IAE"].max()


def test_nothing_happens(study: lab.MonteCarlo) -> None:
    """A count of zero has an interval, and no severity."""
    row = study.rates().set_index(["design", "event"]).loc["feedback", "unstable"]
    assert row["count"] == 0
    assert row["low"] == 0.0 < row["high"] < 0.04
    assert np.isnan(row["worst"])
    assert list(EVENTS) == ["unstable", "breaks a limit", "diverges"]


@pytest.mark.parametrize(
    ("count", "n"), [(0, 1), (1, 1), (0, 250), (3, 32), (474, 2000), (249, 250)]
)
def test_wilson_intervals(count: int, n: int) -> None:
    """As SciPy computes them."""
    wanted = scipy.stats.binomtest(count, n).proportion_ci(method="wilson")
    assert wilson(count, n) == pytest.approx((wanted.low, wanted.high), abs=1e-7)


@pytest.mark.parametrize(("count", "n"), [(1, 0), (-1, 5), (6, 5)])
def test_wilson_is_checked(count: int, n: int) -> None:
    """A count is from none to all."""
    with pytest.raises(ValueError, match=f"count = {count} of n = {n}"):
        wilson(count, n)


# --- Parts -------------------------------------------------------------------------


def test_parts_join_in_any_order(
    study: lab.MonteCarlo, rng: np.random.Generator
) -> None:
    """However they arrive, the study is the same."""
    parts = list(
        lab.monte_carlo_parts(DESIGNS, RANGES, SCENARIO, 3 * PART, keep="signals")
    )
    assert [len(part) for part in parts] == [PART] * 3
    whole = join(parts)
    mixed = join([parts[i] for i in (2, 0, 1)])
    assert mixed.table.equals(whole.table)
    for name in DESIGNS:
        assert np.array_equal(mixed.poles[name], whole.poles[name])
        assert np.array_equal(mixed.signals[name].y, whole.signals[name].y)
    shorter = whole.table.query("realisation < @N").reset_index(drop=True)
    assert shorter.equals(study.table) or np.allclose(
        # The last part of `study` is shorter, so its loops share other sums.
        shorter.select_dtypes("number"),
        study.table.select_dtypes("number"),
        atol=100 * REPLAY,
        equal_nan=True,
    )


def test_stopping_early_keeps_what_there_is() -> None:
    """Closing the generator ends the study; the parts so far are one of their own."""
    begun = []

    def drawn(rng: np.random.Generator) -> lab.DifferenceModel:
        begun.append(1)
        return MODEL.varied(numerator=rng.uniform(0.9, 1.1))

    parts = lab.monte_carlo_parts(DESIGNS, lab.Sampler(drawn), SCENARIO, 1000)
    made = [next(parts), next(parts)]
    parts.close()
    found = join(made)
    assert (len(found), found.asked) == (2 * PART, 1000)
    assert len(begun) == 2 * PART  # nothing was computed beyond
    assert found.rates()["n"].tolist() == [2 * PART] * 6


def test_seeds_give_other_studies() -> None:
    """The same seed the same table, another seed another."""
    one, same, other = (
        lab.monte_carlo(DESIGNS, RANGES, SCENARIO, 5, seed=seed).table
        for seed in (4, 4, 5)
    )
    assert one.equals(same)
    assert not one["a1"].equals(other["a1"])


def test_corners_are_taken_all() -> None:
    """Without n: all there are; with a larger n no more than there are."""
    case = lab.case("ifac93_6_3_3")
    designs = {"one": case.designs["forward_path"]}
    scenario = lab.Scenario(np.ones(10))
    found = lab.monte_carlo(designs, stress(2, corners=True), scenario)
    more = lab.monte_carlo(designs, stress(2, corners=True), scenario, 50)
    assert len(found) == found.asked == len(more) == 32


# --- Plants of other kinds ---------------------------------------------------------


def test_state_dependent_plants() -> None:
    """They have no poles, but everything that is measured."""
    example = lab.case("bilinear_8_5_1")
    names = "sdp_pip", "frozen"
    designs = {name: example.designs[name] for name in names}
    model = example.equation

    def drawn(rng: np.random.Generator) -> tuple:
        return model.plant(), {"nothing": float(rng.uniform())}

    found = lab.monte_carlo(designs, lab.Sampler(drawn), example.scenario, 3)
    assert found.table["radius"].isna().all()
    assert np.isnan(found.poles["frozen"]).all()
    run = lab.closed_loop(model.plant(), designs["frozen"].build(), example.scenario)
    frozen = found.table.query("design == 'frozen'")
    assert frozen["IAE"].tolist() == pytest.approx([summary(measures(run))["IAE"]] * 3)
    assert found.rates().query("event == 'unstable'")["count"].tolist() == [0, 0]


def test_plants_of_different_size() -> None:
    """Loops that cannot run in lock step run one by one; rows of poles are filled."""

    def drawn(rng: np.random.Generator) -> lab.DifferenceModel:
        if rng.uniform() < 0.5:
            return MODEL
        return lab.DifferenceModel([-1.5, 0.56, 0.0, 0.0], [0.1, 0.08, 0.0, 0.01])

    found = lab.monte_carlo(DESIGNS, lab.Sampler(drawn), SCENARIO, 6)
    filled = np.isnan(found.poles["feedback"]).any(axis=1)
    assert 0 < filled.sum() < 6
    assert found.table["radius"].notna().all()
    assert found.table["IAE"].nunique() == 4  # two plants, two designs


# --- Errors ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"designs": {}}, "designs is empty"),
        ({"n": 0}, "n = 0: expected a whole number from 1 on"),
        ({"n": 2.5}, "n = 2.5"),
        ({"keep": "all"}, 'keep = "all": expected "measures", "signals" or "runs"'),
        ({"designs": {"one": lab.Design("wang_young", MODEL, R=-1.0)}}, "convex"),
        ({"scenario": lab.Scenario(np.ones((9, 2)))}, "2 columns"),
    ],
)
def test_errors_name_the_argument(change: dict, message: str) -> None:
    """Before or at the first part, with a sentence."""
    arguments = {
        "designs": DESIGNS,
        "uncertainty": RANGES,
        "scenario": SCENARIO,
        "n": 3,
    }
    with pytest.raises(ValueError, match=message):
        lab.monte_carlo(**{**arguments, **change})


def test_no_parts_no_study() -> None:
    """Joining nothing says that nothing was finished."""
    with pytest.raises(ValueError, match="no part of the study was finished"):
        join([])


# --- Memory ------------------------------------------------------------------------


@pytest.mark.slow
def test_ten_thousand_realisations_hold_under_one_gigabyte() -> None:
    """Measured over a process of its own, libraries included."""
    program = """
        import resource

        import numpy as np

        import nmss_lab as lab

        case = lab.case("ifac93_6_3_3")
        uncertain = lab.RelativeRanges(case.model, {"a": 0.05, "b": 0.15})
        scenario = lab.Scenario(case.scenario.reference[:40])
        designs = {name: case.designs[name] for name in ("wang_young", "forward_path")}
        study = lab.monte_carlo(designs, uncertain, scenario, 10_000)
        kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        print(len(study), len(study.table), kilobytes)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)],
        capture_output=True,
        text=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        check=True,
    )
    realisations, rows, kilobytes = map(int, done.stdout.split())
    assert (realisations, rows) == (10_000, 20_000)
    assert kilobytes < 1_000_000
