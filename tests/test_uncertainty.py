"""Draws of plants, and how far one may be off: names, statistics, bounds."""

import functools
import itertools
import json
from pathlib import Path

import numpy as np
import pytest
from conftest import ALGEBRA
from strategies import random_model, relative

import nmss_lab as lab
from nmss_lab.cases import STRESS_LEVELS, stress
from nmss_lab.identify import Orders, sriv
from nmss_lab.uncertainty import Bounds, realisations

GOLDEN = Path(__file__).parent / "golden" / "thesis_chapters_6_7.json"
MODEL = lab.DifferenceModel([-1.5, 0.56], [0.1, 0.08])
COVARIANCE = 1e-4 * np.array(
    [
        [4.0, -3.0, 0.5, 0.0],
        [-3.0, 3.0, 0.0, 0.2],
        [0.5, 0.0, 1.0, -0.6],
        [0.0, 0.2, -0.6, 1.0],
    ]
)
DRAWS = 4000


def drawn(uncertainty, n: int = DRAWS, seed: int = 0) -> np.ndarray:
    """Return the values of many draws, (n, parameters)."""
    return np.array([list(d.values.values()) for d in realisations(uncertainty, n)])


# --- Realisations ------------------------------------------------------------------

KINDS = {
    "ranges": lab.RelativeRanges(MODEL, {"a": 0.05, "b": 0.1}),
    "covariance": lab.ParameterCovariance(MODEL, COVARIANCE),
    "intervals": stress(2),
    "corners": stress(2, corners=True),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_realisation_is_its_number_and_seed(kind: str) -> None:
    """It does not matter how many are drawn, in which order, or what before."""
    few, many = realisations(KINDS[kind], 3), realisations(KINDS[kind], 9)
    for i in (8, 2, 0):
        alone = lab.realisation(KINDS[kind], i)
        assert alone.values == many[i].values
        assert i >= len(few) or alone.values == few[i].values
        # the plant too, not only what is told of it
        plants = [
            p.plant() if isinstance(p, lab.DifferenceModel) else p
            for p in (alone.plant, many[i].plant)
        ]
        assert np.array_equal(plants[0].A, plants[1].A)
        assert np.array_equal(plants[0].B, plants[1].B)


@pytest.mark.parametrize("kind", ["ranges", "covariance", "intervals"])
def test_seeds_and_numbers_differ(kind: str) -> None:
    """No two realisations are the same plant, nor are those of two seeds."""
    found = [
        tuple(lab.realisation(KINDS[kind], i, seed).values.values())
        for i, seed in itertools.product(range(5), range(3))
    ]
    assert len(set(found)) == 15


def test_how_many_there_are() -> None:
    """Corners end by themselves; of draws one has to say how many."""
    assert len(realisations(KINDS["corners"])) == 32
    with pytest.raises(ValueError, match="n is missing"):
        realisations(KINDS["ranges"])


# --- Relative ranges ---------------------------------------------------------------


def test_ranges_hold_and_are_filled() -> None:
    """Every coefficient stays within its share, and comes near both its ends."""
    values = drawn(KINDS["ranges"])
    center = np.array([-1.5, 0.56, 0.1, 0.08])
    share = np.array([0.05, 0.05, 0.1, 0.1])
    off = (values / center - 1.0) / share
    assert np.abs(off).max() <= 1.0
    # 4000 uniform draws leave a gap of 0.01 at an end with probability 2e-9
    assert off.min(axis=0).max() < -0.99
    assert off.max(axis=0).min() > 0.99
    # mean and spread of a uniform draw on [-1, 1], four standard errors
    assert np.abs(off.mean(axis=0)).max() < 4.0 / np.sqrt(3.0 * DRAWS)
    assert off.var(axis=0) == pytest.approx(np.full(4, 1.0 / 3.0), abs=0.02)


def test_one_coefficient_alone() -> None:
    """A name moves its coefficient only; a name goes before its group."""
    uncertain = lab.RelativeRanges(MODEL, {"a2": 0.1})
    one = lab.realisation(uncertain, 0)
    assert list(one.values) == ["a2"]
    assert one.plant.a[0] == MODEL.a[0]
    assert np.array_equal(one.plant.b, MODEL.b)
    assert one.plant.a[1, 0, 0] == one.values["a2"] != 0.56
    kept = lab.realisation(lab.RelativeRanges(MODEL, {"a": 0.1, "a2": 0.0}), 0)
    assert list(kept.values) == ["a1"]


def test_names_of_a_model_with_many_channels(rng: np.random.Generator) -> None:
    """Lag, output and input; zeros have no name and stay zero."""
    model = random_model(rng, 2, 2, 1, 1, 1, 1)
    b = model.b.copy()
    b[0, 1, 0] = 0.0
    model = lab.DifferenceModel(model.a, b, model.g)
    uncertain = lab.RelativeRanges(model, {"b": 0.5, "g1[2,1]": 0.1})
    assert "b1[1,2]" in uncertain.names
    assert "b1[2,1]" not in uncertain.names
    one = lab.realisation(uncertain, 3)
    assert set(one.values) == {"b1[1,1]", "b1[1,2]", "b1[2,2]", "g1[2,1]"}
    assert one.plant.b[0, 1, 0] == 0.0
    assert one.plant.b[0, 0, 1] == one.values["b1[1,2]"]
    assert one.plant.g[0, 1, 0] == one.values["g1[2,1]"]
    assert one.plant.g[0, 0, 0] == model.g[0, 0, 0]


@pytest.mark.parametrize(
    ("share", "message"),
    [
        ({"c": 0.1}, 'share "c": expected "a", "b", "g" or one of a1, a2, b1, b2'),
        ({"b3": 0.1}, 'share "b3"'),
        ({"a": -0.1}, 'share "a" = -0.1: expected 0 or more'),
        ({"a": np.nan}, 'share "a" = nan'),
    ],
)
def test_shares_are_checked(share: dict[str, float], message: str) -> None:
    """Unknown names and impossible shares are refused."""
    with pytest.raises(ValueError, match=message):
        lab.RelativeRanges(MODEL, share)


# --- Covariances -------------------------------------------------------------------


def check_moments(values: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> None:
    """Compare with the stated moments, within five standard errors each."""
    n, deviation = len(values), np.sqrt(np.diag(covariance))
    off = (values.mean(axis=0) - mean) / (deviation / np.sqrt(n))
    assert np.abs(off).max() < 5.0
    # Var of a sample covariance of normal draws: (s_ij^2 + s_ii s_jj) / n
    spread = np.sqrt((covariance**2 + np.outer(deviation, deviation) ** 2) / n)
    assert (np.abs(np.cov(values.T) - covariance) < 5.0 * spread).all()


def test_covariance_draws_have_it() -> None:
    """Mean and covariance are those stated, in the order a1, a2, b1, b2."""
    uncertain = KINDS["covariance"]
    assert list(lab.realisation(uncertain, 0).values) == ["a1", "a2", "b1", "b2"]
    check_moments(drawn(uncertain), np.array([-1.5, 0.56, 0.1, 0.08]), COVARIANCE)
    one = lab.realisation(uncertain, 1)
    assert one.plant.a[1, 0, 0] == one.values["a2"]
    assert one.plant.b[0, 0, 0] == one.values["b1"]


def test_singular_covariances_are_drawn() -> None:
    """Parameters that are known exactly stay, and what is tied moves together."""
    tied = np.zeros((4, 4))
    tied[:2, :2] = 1e-4 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    values = drawn(lab.ParameterCovariance(MODEL, tied), 20)
    assert np.abs(values[:, 2:] - [0.1, 0.08]).max() < 1e-12
    assert np.abs(values[:, 0] + values[:, 1] + 0.94).max() < 1e-9
    assert values[:, 0].std() > 1e-3


@pytest.mark.parametrize(
    ("model", "covariance", "message"),
    [
        (MODEL, np.eye(3), r"covariance has shape \(3, 3\), expected \(4, 4\)"),
        (MODEL, np.diag([1.0, 1.0, 1.0, -1.0]), "the negative eigenvalue -1"),
        (
            lab.DifferenceModel([-0.8 * np.eye(2)], [np.eye(2)]),
            np.eye(4),
            "expected one output and one input; for others see EstimatedModels",
        ),
    ],
)
def test_covariances_are_checked(model, covariance, message: str) -> None:
    """Sizes and signs."""
    with pytest.raises(ValueError, match=message):
        lab.ParameterCovariance(model, covariance)


def record(rng: np.random.Generator, outputs: int) -> lab.Record:
    """Return a simulated record with white noise on the outputs."""
    u = np.repeat(rng.standard_normal((100, 1)), 4, axis=0)
    y = lab.closed_loop(
        MODEL, lab.pip(MODEL, np.zeros(4)), lab.Scenario(np.zeros(400), manual=u)
    ).y
    names = {"y": tuple(f"y{i + 1}" for i in range(outputs)), "u": ("u1",)}
    both = np.hstack([y, 0.5 * y])[:, :outputs]
    noisy = both + 0.02 * rng.standard_normal(both.shape)
    empty = np.zeros((400, 0))
    return lab.Record(np.arange(400.0), noisy, u, empty, empty, names, {})


def test_identified_models_are_drawn(rng: np.random.Generator) -> None:
    """A real identification: draws have its estimate and its P*."""
    measured = record(rng, 1)
    estimate = sriv(measured, Orders(2, (2,), (1,)))
    uncertain = lab.EstimatedModels([estimate])
    one = lab.realisation(uncertain, 0)
    assert list(one.values) == list(estimate.names)
    check_moments(drawn(uncertain), estimate.parameters, estimate.covariance)
    model = one.plant
    assert isinstance(model, lab.DifferenceModel)
    assert model.a.ravel().tolist() == [one.values["a1"], one.values["a2"]]
    # The true plant is among what the estimate leaves possible: 99.99 % of chi^2(4)
    off = estimate.parameters - np.array([-1.5, 0.56, 0.1, 0.08])
    assert off @ np.linalg.solve(estimate.covariance, off) < 23.5


def test_identified_models_of_two_outputs(rng: np.random.Generator) -> None:
    """One estimate an output; values carry the output's name."""
    measured = record(rng, 2)
    estimates = [
        sriv(part, Orders(2, (2,), (1,)))
        for part in (
            lab.Record(
                measured.time,
                measured.y[:, [i]],
                measured.u,
                measured.v,
                measured.r,
                {"y": (f"y{i + 1}",), "u": ("u1",)},
                {},
            )
            for i in range(2)
        )
    ]
    one = lab.realisation(lab.EstimatedModels(estimates), 0)
    assert (one.plant.n_y, one.plant.n_u) == (2, 1)
    assert [name for name in one.values if name.startswith("y2: ")] == [
        f"y2: {name}" for name in estimates[1].names
    ]
    drawn_b = [one.values[f"y2: {name}"] for name in estimates[1].names[2:4]]
    assert one.plant.b[:2, 1, 0].tolist() == drawn_b


# --- Intervals, samplers -----------------------------------------------------------


def test_corners_are_those_of_table_4_1() -> None:
    """All sign combinations, in the order of itertools.product, the low side first."""
    found = [d.values for d in realisations(stress(2, corners=True))]
    nominal = {"T1": 5.0, "T2": 0.4, "w0": 5.0, "zeta": 0.3, "K": 1.0}
    signs = itertools.product((-1, 1), repeat=5)
    for values, side in zip(found, signs, strict=True):
        for (name, value), sign in zip(values.items(), side, strict=True):
            wanted = nominal[name] + sign * STRESS_LEVELS[2][name]
            assert value == pytest.approx(wanted)


def test_draws_stay_between_the_corners() -> None:
    """Uniform draws lie within the intervals and fill them."""
    low, high = (
        np.array([pair[side] for pair in stress(2).intervals.values()])
        for side in (0, 1)
    )
    place = (drawn(stress(2), 300) - low) / (high - low)
    assert (place >= 0.0).all()
    assert (place <= 1.0).all()
    # 300 draws leave a gap of 0.05 at an end with probability 2e-7
    assert np.abs(place - 0.5).max(axis=0).min() > 0.45


def test_a_corner_that_is_not_there() -> None:
    """The message says how many there are."""
    with pytest.raises(ValueError, match="corner 32: expected one from 0 to 31"):
        lab.realisation(stress(1, corners=True), 32)


def test_empty_intervals_are_refused() -> None:
    """Low above high, or infinite."""
    for pair in ((1.0, 0.0), (0.0, np.inf)):
        with pytest.raises(ValueError, match='interval "K"'):
            lab.Intervals(lambda K: MODEL, {"K": pair})


def test_functions_of_ones_own() -> None:
    """A sampler returns a plant, or a plant with what was drawn."""

    def plain(rng: np.random.Generator) -> lab.DifferenceModel:
        return MODEL.varied(numerator=rng.uniform(0.5, 1.5))

    def told(rng: np.random.Generator) -> tuple:
        gain = rng.uniform(0.5, 1.5)
        return MODEL.varied(numerator=gain), {"gain": gain}

    one, other = (lab.realisation(lab.Sampler(f), 4) for f in (plain, told))
    assert np.array_equal(one.plant.b, other.plant.b)
    assert one.values == {}
    assert one.plant.b == pytest.approx(MODEL.b * other.values["gain"])


# --- Bounds: Table 6.1 -------------------------------------------------------------


def varied(model: lab.DifferenceModel, side: str, factor: float):
    """Return a model with numerator (eps1) or denominator (eps2) times a factor."""
    kind = "numerator" if side == "eps1" else "denominator"
    return model.varied(**{kind: factor})


@pytest.mark.parametrize(
    ("form", "structure"), [("fb", "wang_young"), ("fp", "forward_path")]
)
@pytest.mark.parametrize("factor", ["eps1", "eps2"])
def test_table_6_1(form: str, structure: str, factor: str) -> None:
    """Bounds and the pole that leaves first, as computed independently."""
    wanted = json.loads(GOLDEN.read_text())["table61"][form]
    design = lab.case("ifac93_6_3_3").designs[structure]
    found = lab.uncertainty_bounds(
        design.build(), functools.partial(varied, design.model, factor)
    )
    for end, bound, pole in (
        ("min", found.low, found.low_pole),
        ("max", found.high, found.high_pole),
    ):
        row = wanted[f"{factor}_{end}"]
        # the golden values and the walk are found to 1e-10; poles near 0.1 apart
        # from each other amplify rounding a little
        assert bound == pytest.approx(row["bound"], abs=1e-6)
        real, imaginary = row["binding_nominal_pole"]
        assert pole.real == pytest.approx(real, abs=1e-6)
        assert abs(pole.imag) == pytest.approx(abs(imaginary), abs=1e-6)


def test_bounds_of_a_simple_loop() -> None:
    """Deadbeat control of a gain: the pole is 1 - factor, exactly 0.1 away."""
    model = lab.DifferenceModel([0.0], [1.0])
    K = lab.pole_gain(model, [0.0, 0.0])
    found = lab.uncertainty_bounds(
        lab.pip(model, K), lambda factor: model.varied(numerator=factor)
    )
    loop = [
        lab.linear_loop(lab.pip(model, K), model.varied(numerator=f)).radius
        for f in (found.low, found.high)
    ]
    assert loop == pytest.approx([0.1, 0.1], abs=1e-6)
    assert found.low < 1.0 < found.high


def test_bounds_of_several_outputs() -> None:
    """For any plant: at the bounds some pole is at the distance, inside none is."""
    model = lab.DifferenceModel([np.diag([-0.8, -0.9])], [[[0.5, 0.1], [0.2, 0.4]]])
    controller = lab.wang_young(model, lab.Horizon(6, 2), 1.0, 0.5)

    def scaled(factor: float) -> lab.DifferenceModel:
        b = model.b.copy()
        b[:, 0, 0] *= factor
        return lab.DifferenceModel(model.a, b)

    found = lab.uncertainty_bounds(controller, scaled, distance=0.05, step=0.01)
    assert 0.0 < found.low < 1.0 < found.high < 10.0
    nominal = lab.linear_loop(controller, model).poles

    def nearest(factor: float, pole: complex) -> float:
        return float(
            np.abs(lab.linear_loop(controller, scaled(factor)).poles - pole).min()
        )

    for bound, pole in ((found.low, found.low_pole), (found.high, found.high_pole)):
        assert np.abs(nominal - pole).min() < 1e-6  # a nominal pole
        assert nearest(bound, pole) == pytest.approx(0.05, abs=1e-3)
        assert nearest((1.0 + bound) / 2.0, pole) < 0.05


def test_a_walk_that_ends_without_leaving() -> None:
    """The ends of the walk are returned, and no pole is named."""
    controller = lab.wang_young(MODEL, lab.Horizon(8, 3), 1.0, 1.0)
    found = lab.uncertainty_bounds(
        controller,
        lambda factor: MODEL.varied(numerator=factor),
        distance=5.0,
        step=0.05,
        reach=(0.5, 1.5),
    )
    assert (found.low, found.high) == (0.5, 1.5)
    assert np.isnan(found.low_pole)
    assert np.isnan(found.high_pole)
    assert isinstance(found, Bounds)


@pytest.mark.parametrize("change", [{"distance": 0.0}, {"step": -1.0}])
def test_walks_are_checked(change: dict[str, float]) -> None:
    """Radius and step are positive."""
    controller = lab.wang_young(MODEL, lab.Horizon(8, 3), 1.0, 1.0)
    with pytest.raises(ValueError, match="expected positive numbers"):
        lab.uncertainty_bounds(controller, lambda _: MODEL, **change)


def test_a_factor_of_one_is_the_model() -> None:
    """The helper above varies what it says."""
    assert relative(varied(MODEL, "eps1", 1.0).b, MODEL.b) < ALGEBRA
    assert relative(varied(MODEL, "eps2", 2.0).a, 2.0 * MODEL.a) < ALGEBRA
