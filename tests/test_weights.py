"""Weights as vectors: every vector is a design, and a design gives its vector."""

import dataclasses

import numpy as np
import pytest
from conftest import ALGEBRA
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import SIZES, positive, random_model, relative

import nmss_lab as lab
from nmss_lab.weights import OUTPUT_BLOCKS, STATE_BLOCKS

HORIZON = lab.Horizon(5, 3)
ONE = lab.DifferenceModel([-1.5, 0.56], [0.1, 0.08])
TWO = lab.DifferenceModel(
    np.array([np.diag([-0.8, -0.6]), np.diag([0.1, 0.05])]),
    [[[0.5, 0.1], [0.2, 0.4]], [[0.1, 0.0], [0.0, 0.1]]],
    [[[0.2], [0.1]]],
)
VARYING = lab.StateDependentModel(a=["-0.7 + 0.1*y[k-1]"], b=["1.0", "0.2*u[k-1]"])

LINEAR = [*lab.STRUCTURES, "pip"]
STATE_DEPENDENT = ["sdp_increments", "sdp_integral_of_error", "sdp_pip"]
NO_STEPS = "pip", "sdp_pip"


def design(structure: str, model=None, **more) -> lab.Design:
    """Return a design of any structure with weights."""
    if structure.startswith("sdp_"):
        return lab.Design(structure, VARYING, HORIZON, **more)
    model = model or TWO
    if structure == "pip" and "options" not in more:
        more["options"] = {"K": lab.lq_gain(model, more.get("Q", 1.0), 1.0)}
    return lab.Design(structure, model, HORIZON, **more)


def check_admissible(weights: lab.Weights, vector: np.ndarray) -> None:
    """Each block is symmetric and positive definite, and the design builds."""
    for name, block in weights.matrices(vector).items():
        assert np.array_equal(block, block.T), name
        assert np.linalg.eigvalsh(block)[0] > 0.0, name
    weights.apply(vector).build()


@pytest.mark.parametrize("per_step", [False, True])
@pytest.mark.parametrize("structure", LINEAR + STATE_DEPENDENT)
@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10_000), size=st.sampled_from([0.1, 1.0, 2.0]))
def test_every_vector_is_admissible(
    structure: str, per_step: bool, seed: int, size: float
) -> None:
    """Whatever a search tries can be built; weights reach from 1e-4 to 1e4 and on."""
    if per_step and structure in NO_STEPS:
        return
    weights = lab.Weights(design(structure), per_step=per_step)
    vector = size * np.random.default_rng(seed).standard_normal(weights.count)
    check_admissible(weights, vector)


@pytest.mark.parametrize("structure", ["wang_young", "integral_of_error"])
@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_all_sizes(
    structure: str, sizes: tuple[int, ...], rng: np.random.Generator
) -> None:
    """Models without past inputs, with more inputs than outputs and fewer, too."""
    weights = lab.Weights(design(structure, random_model(rng, *sizes)))
    check_admissible(weights, rng.standard_normal(weights.count))
    check_admissible(weights, weights.start)


def state_weight(rng: np.random.Generator, model=TWO) -> np.ndarray:
    """Return a Q of (5.6) with full blocks."""
    past = [positive(rng, model.n_u)] if model.nb > 1 else [None]
    blocks = positive(rng, model.n_y), *past, positive(rng, model.n_y)
    return lab.state_weight(model, *blocks)


def full_weights(structure: str, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return random definite Q and R for a structure and ``TWO``."""
    whole = structure in ("integral_of_error", "pip")
    Q = state_weight(rng) if whole else positive(rng, 2)
    return {"Q": Q, "R": positive(rng, 2)}


@pytest.mark.parametrize("structure", LINEAR)
def test_start_gives_the_design_back(structure: str, rng: np.random.Generator) -> None:
    """The vector of definite weights is those weights: same Q, R and moves."""
    chosen = full_weights(structure, rng)
    if structure == "pip":
        K = lab.lq_gain(TWO, chosen["Q"], chosen["R"])
        first = design(structure, options={"K": K}, **chosen)
    else:
        first = design(structure, **chosen)
    weights = lab.Weights(first)
    again = weights.apply(weights.start)
    assert relative(again.Q, chosen["Q"]) < ALGEBRA
    assert relative(again.R, chosen["R"]) < ALGEBRA
    scenario = lab.Scenario(np.ones((12, 2)))
    one, other = (lab.closed_loop(TWO, d.build(), scenario) for d in (first, again))
    # Weights equal to 1e-15, times the conditioning of the programs of a few hundred.
    assert relative(other.u, one.u) < 1e3 * ALGEBRA


@pytest.mark.parametrize("structure", STATE_DEPENDENT)
def test_start_of_a_state_dependent_design(structure: str) -> None:
    """The same for state-dependent models."""
    whole = structure != "sdp_increments"
    Q = np.diag([2.0, 0.3, 0.5]) if whole else np.array([[2.0]])
    first = design(structure, Q=Q, R=0.7)
    again = lab.Weights(first).apply(lab.Weights(first).start)
    assert relative(again.Q, Q) < ALGEBRA
    assert relative(again.R, np.array([[0.7]])) < ALGEBRA


def test_what_coefficients_read_has_no_weight() -> None:
    """The state of 8.5.2 is y and the sum of the error, though b reads u[k-2]."""
    example = lab.case("product_8_5_2").designs["integral_frozen"]
    weights = lab.Weights(example)
    assert weights.names == ("weight_y", "weight_integral", "weight_u")
    again = weights.apply(weights.start)
    assert relative(again.Q, np.diag(example.Q)) < ALGEBRA
    again.build()


def test_start_per_step(rng: np.random.Generator) -> None:
    """Weights that differ along the horizons come back step by step, (5.4)."""
    Q = np.array([positive(rng, 2) for _ in range(HORIZON.Np)])
    R = np.array([positive(rng, 2) for _ in range(HORIZON.Nc)])
    weights = lab.Weights(design("wang_young", Q=Q, R=R), per_step=True)
    again = weights.apply(weights.start)
    assert relative(again.Q, Q) < ALGEBRA
    assert relative(again.R, R) < ALGEBRA
    assert weights.count == 3 * (HORIZON.Np + HORIZON.Nc)


def test_steps_are_independent() -> None:
    """Moving one entry of the vector moves the weight of one step alone."""
    weights = lab.Weights(design("integral_of_error"), per_step=True)
    place = [b.name for b in weights.blocks].index("weight_integral[2]")
    vector = weights.start.copy()
    vector[sum(b.count for b in weights.blocks[:place])] += 1.0
    before, after = weights.apply(weights.start), weights.apply(vector)
    changed = np.abs(after.Q - before.Q).max(axis=(1, 2)) > 0.0
    assert changed.tolist() == [i == 1 for i in range(HORIZON.Np)]
    assert np.array_equal(after.R, before.R)


def test_singular_weights_start_nearby() -> None:
    """A weight that no vector can say is lifted a little, not refused."""
    indefinite = np.array([[1.0, 2.0], [2.0, 1.0]])  # eigenvalues 3 and -1
    weights = lab.Weights(design("wang_young", Q=indefinite))
    found = np.linalg.eigvalsh(weights.matrices(weights.start)["weight_y"])
    assert found[1] == pytest.approx(3.0)
    assert 0.0 < found[0] < 1e-3


def test_names_of_blocks() -> None:
    """Structures that weigh the state have the blocks of (5.6); others two."""
    assert lab.Weights(design("integral_of_error")).names == STATE_BLOCKS
    assert lab.Weights(design("wang_young")).names == OUTPUT_BLOCKS
    simple = lab.DifferenceModel([-0.9], [0.2])  # without past inputs
    assert lab.Weights(design("integral_of_error", simple)).names == (
        "weight_y",
        "weight_integral",
        "weight_u",
    )


def test_diagonal_blocks() -> None:
    """With ``full=False`` nothing stands off the diagonal, with names only there."""
    weights = lab.Weights(design("integral_of_error"), full=False)
    assert weights.count == 8
    for block in weights.matrices(np.arange(8.0) / 4.0).values():
        assert np.array_equal(block, np.diag(np.diag(block)))
    some = lab.Weights(design("integral_of_error"), full=["weight_u"])
    found = some.matrices(np.ones(some.count))
    assert some.count == 9
    assert found["weight_u"][0, 1] != 0.0
    assert found["weight_y"][0, 1] == 0.0


def test_fixed_blocks_stay(rng: np.random.Generator) -> None:
    """A fixed block is not in the vector and keeps the design's weight."""
    chosen = full_weights("integral_of_error", rng)
    weights = lab.Weights(
        design("integral_of_error", **chosen), fixed=["weight_integral", "weight_u"]
    )
    vector = rng.standard_normal(weights.count)
    after = weights.apply(vector)
    assert weights.count == 6
    assert relative(after.R, chosen["R"]) < ALGEBRA
    assert np.array_equal(after.Q[-2:, -2:], chosen["Q"][-2:, -2:])
    assert not np.allclose(after.Q[:2, :2], chosen["Q"][:2, :2])


def test_bounds_hold_the_diagonal() -> None:
    """At its ends the vector gives weights whose factors reach the bounds."""
    weights = lab.Weights(design("wang_young"), full=False)
    low, high = weights.bounds(1e-2, 1e3)
    assert weights.matrices(low)["weight_y"] == pytest.approx(1e-2 * np.eye(2))
    assert weights.matrices(high)["weight_u"] == pytest.approx(1e3 * np.eye(2))


def test_pip_gets_the_gain_of_its_weights(rng: np.random.Generator) -> None:
    """The tuned PIP controller is the LQ design for the tuned weights."""
    weights = lab.Weights(design("pip"))
    after = weights.apply(rng.standard_normal(weights.count))
    wanted = lab.lq_gain(TWO, after.Q, after.R)
    assert np.array_equal(after.options["K"], wanted)


def test_given_poles_give_way_to_weights() -> None:
    """A state-dependent PIP placed by poles is moved by weights all the same."""
    first = design("sdp_pip", options={"poles": (0.0, 0.1, 0.2), "law": "incremental"})
    weights = lab.Weights(first)
    runs = [
        lab.closed_loop(
            VARYING,
            weights.apply(weights.start + jump).build(),
            lab.Scenario(0.3 * np.ones(12)),
        )
        for jump in (0.0, np.array([0.0, 0.0, 0.0, 3.0]))
    ]
    assert "poles" in first.options
    assert weights.apply(weights.start).options == {"law": "incremental"}
    assert np.abs(runs[0].y - runs[1].y).max() > 0.01


def test_other_choices_stay() -> None:
    """Horizon, limits, reading of the reference and options are the design's."""
    first = design("wang_young", limits=lab.Limits(u=(-1.0, 1.0)), reference="preview")
    weights = lab.Weights(first)
    after = weights.apply(weights.start + 1.0)
    for part in dataclasses.fields(lab.Design):
        if part.name not in ("Q", "R"):
            assert getattr(after, part.name) == getattr(first, part.name), part.name


@pytest.mark.parametrize(
    ("structure", "options", "message"),
    [
        ("governor", {}, "has no weights to tune"),
        ("pip", {"per_step": True}, "a PIP gain has one weight for all steps"),
        ("wang_young", {"fixed": ["weight_z"]}, 'block "weight_z": this structure has'),
        ("wang_young", {"full": ["weight_integral"]}, "weight_y, weight_u"),
        ("wang_young", {"fixed": OUTPUT_BLOCKS}, "nothing is left to tune"),
    ],
)
def test_errors_name_the_argument(structure: str, options: dict, message: str) -> None:
    """What cannot be is refused with a sentence."""
    chosen = design(structure, options={"K": np.ones((2, 8))})
    with pytest.raises(ValueError, match=message):
        lab.Weights(chosen, **options)
