"""Proportional-integral-plus control: gains and the law with limits."""

import numpy as np
import pytest
from conftest import DECISION, REPLAY, printed
from strategies import positive, random_model, relative

from nmss_lab.controller import Limits, Status
from nmss_lab.models import DifferenceModel
from nmss_lab.nmss import integral_of_error_form
from nmss_lab.pip import lq_gain, pip, pole_gain
from nmss_lab.simulate import Scenario, closed_loop

MODEL = DifferenceModel([-1.7, 1.0], [-1.0, 2.0])
K = pole_gain(MODEL, [0.0, 0.0, 0.2, 0.2])


def closed_poles(model, gain):
    """Return the poles of the loop, the largest first."""
    form = integral_of_error_form(model)
    return np.linalg.eigvals(form.A - form.B @ gain)


def test_gain_of_section_3_4():
    """Two poles at the origin, two at 0.2: the printed gain for the corrected plant."""
    for found, text in zip(K[0], ["3.16", "-3.05", "6.10", "-0.64"], strict=True):
        assert found == pytest.approx(float(text), abs=printed(text))


def test_printed_plant_of_section_3_4_has_another_gain():
    """With -0.5 in place of -1 the right gain is this, and the printed one unstable."""
    misprint = DifferenceModel([-1.7, 1.0], [-0.5, 2.0])
    gain = pole_gain(misprint, [0.0, 0.0, 0.2, 0.2])
    for found, text in zip(
        gain[0], ["2.074", "-1.775", "3.550", "-0.427"], strict=True
    ):
        assert found == pytest.approx(float(text), abs=printed(text))
    largest = np.abs(closed_poles(misprint, np.array([[3.16, -3.05, 6.10, -0.64]])))
    assert largest.max() == pytest.approx(2.79, abs=printed("2.79"))


SIZES = [(1, 1, 0, 1, 1), (1, 1, 0, 2, 3), (2, 2, 0, 1, 2), (2, 2, 0, 2, 1)]


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_distinct_poles_are_placed(rng, sizes):
    """Real ones and a conjugate pair, one input or several."""
    model = random_model(rng, *sizes)
    n = integral_of_error_form(model).n_x
    wanted = list(np.linspace(0.1, 0.7, n))
    if n > 2:
        wanted[-2:] = [0.4 + 0.3j, 0.4 - 0.3j]
    found = np.poly(closed_poles(model, pole_gain(model, wanted)))
    assert found == pytest.approx(np.poly(wanted), abs=DECISION)


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_repeated_poles_are_placed(rng, sizes):
    """All at one place, more often than there are inputs."""
    model = random_model(rng, *sizes)
    wanted = np.full(integral_of_error_form(model).n_x, 0.3)
    found = np.poly(closed_poles(model, pole_gain(model, wanted)))
    # an n-fold pole itself moves by the n-th root of rounding: compare coefficients
    assert found == pytest.approx(np.poly(wanted), abs=DECISION)


@pytest.mark.parametrize(
    ("model", "poles", "message"),
    [
        (MODEL, [0.1, 0.2], r"poles has shape \(2,\), expected \(4,\)"),
        (MODEL, [0.1, 0.2, 0.3, 0.4j], "conjugate pairs"),
        (
            DifferenceModel([-1.4, 0.45], [0.3, -0.27]),
            [0.0, 0.1, 0.2, 0.3],
            r"reaches 3 of 4 states.*fixed poles at \[0\.9",
        ),
    ],
)
def test_poles_that_cannot_be_placed_are_refused(model, poles, message):
    """The message says why; section 7.4.1 has a common factor 0.9."""
    with pytest.raises(ValueError, match=message):
        pole_gain(model, poles)


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_lq_gain_solves_the_riccati_equation(rng, sizes):
    """And is cheaper than gains nearby, from any state."""
    model = random_model(rng, *sizes)
    form = integral_of_error_form(model)
    Q, R = positive(rng, form.n_x), positive(rng, model.n_u)
    gain = lq_gain(model, Q, R)
    assert np.abs(closed_poles(model, gain)).max() < 1.0

    def cost(K_, x):
        total = 0.0
        for _ in range(400):
            u = -K_ @ x
            total += x @ Q @ x + u @ R @ u
            x = form.A @ x + form.B @ u
        return total

    x = rng.standard_normal(form.n_x)
    for _ in range(4):
        nearby = gain + 0.02 * rng.standard_normal(gain.shape)
        assert cost(gain, x) < cost(nearby, x)


def test_lq_without_a_stabilising_solution_is_refused():
    """A plant with a zero at 1 hides the sum of the error from the input."""
    with pytest.raises(ValueError, match="no stabilising solution"):
        lq_gain(DifferenceModel([-0.5], [1.0, -1.0]), 1.0, 1.0)


def run(law, path="feedback", limits=None, anti_windup=True, r=None, plant=None):
    """Run the loop of section 3.4."""
    r = np.repeat([0.0, 5.0, -5.0], [5, 26, 29]) if r is None else r
    c = pip(MODEL, K, limits, law, path, anti_windup)
    return closed_loop((plant or MODEL).plant(), c, Scenario(r))


def test_laws_agree_without_limits():
    """Incremental, positional and forward path, with an exact model."""
    runs = [run("incremental"), run("positional"), run("incremental", "forward")]
    assert np.abs(runs[0].u).max() == pytest.approx(4.9, abs=printed("4.9"))
    for each in runs[1:]:
        assert each.u == pytest.approx(runs[0].u, abs=DECISION)


def test_incremental_law_is_3_13_corrected():
    """Written out: rate first, then level, from the input that was applied."""
    limits = Limits(u=(-2.0, 1.5), du=(-0.5, 0.3))
    found = run("incremental", limits=limits)
    y, u, before = [0.0] * 3, [0.0] * 2, 0.0
    for k in range(len(found)):
        y = [found.y[k, 0], *y[:2]]
        error = found.r[k, 0] - y[0]
        dx = np.array([y[0] - y[1], y[1] - y[2], u[0] - u[1], error])
        step = np.clip(-K[0] @ dx, -0.5, 0.3)
        before = np.clip(before + step, -2.0, 1.5)
        # this fast gain amplifies rounding from sample to sample
        assert found.u[k, 0] == pytest.approx(before, abs=DECISION), f"k = {k}"
        u = [before, u[0]]


def test_positional_law_is_3_4():
    """The law u = -K x over the state of (3.2) when nothing saturates."""
    found = run("positional")
    z, y, u = 0.0, [0.0, 0.0], 0.0
    for k in range(len(found)):
        y = [found.y[k, 0], y[0]]
        z += found.r[k, 0] - y[0]
        u = -K[0] @ [*y, u, z]
        assert found.u[k, 0] == pytest.approx(u, abs=DECISION), f"k = {k}"


def test_anti_windup_of_the_positional_law_can_be_left_out():
    """Then the sum of the error winds up at the limit."""
    model = DifferenceModel([-0.9], [0.1])
    gain = lq_gain(model, [1.0, 0.05], 0.1)
    r = np.repeat([3.0, 0.5], [60, 60])
    late = {}
    for anti in (True, False):
        c = pip(model, gain, Limits(u=(-1.0, 1.0)), "positional", anti_windup=anti)
        u = closed_loop(model.plant(), c, Scenario(r)).u[60:, 0]
        late[anti] = int((u >= 1.0).sum())
    assert late[True] <= 1
    assert late[False] > 10


def test_forward_path_sees_only_the_model():
    """With a wrong model the two paths differ, and neither has an offset."""
    model = DifferenceModel([-0.9], [0.1])
    gain = lq_gain(model, [1.0, 0.05], 0.1)
    plant = model.varied(numerator=1.3).plant()
    r = np.ones(150)
    pair = [
        closed_loop(plant, pip(model, gain, path=path), Scenario(r))
        for path in ("feedback", "forward")
    ]
    assert np.abs(pair[0].y - pair[1].y).max() > 1e-3
    for each in pair:
        assert each.y[-1] == pytest.approx([1.0], abs=DECISION)


def test_clipping_is_told():
    """The status says where the law asked for more."""
    found = run("incremental", limits=Limits(du=(-0.5, 0.5)))
    clipped = found.status == Status.CLIPPED
    assert clipped.any()
    assert np.abs(found.du[clipped]) == pytest.approx(0.5, abs=REPLAY)
    assert (np.abs(found.du[~clipped]) <= 0.5).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"K": np.zeros((1, 3))}, r"K has shape \(1, 3\), expected \(1, 4\)"),
        ({"law": "other"}, 'law = "other"'),
        ({"path": "other"}, 'path = "other"'),
        ({"law": "positional", "path": "forward"}, 'needs law = "incremental"'),
    ],
)
def test_mistakes_are_refused(options, message):
    """The argument at fault is named."""
    with pytest.raises(ValueError, match=message):
        pip(MODEL, **{"K": K, **options})


def test_unused_gains_are_the_same_for_one_row_or_a_matrix():
    """A single input may have its gain as a vector."""
    a, b = pip(MODEL, K[0]), pip(MODEL, K)
    assert relative(a.K, b.K) == 0.0


@pytest.mark.parametrize(
    ("Q", "R", "message"),
    [(-1.0, 1.0, "Q has the eigenvalue -1"), (1.0, -1.0, "R has the eigenvalue -1")],
)
def test_negative_weights_are_refused(Q, R, message):
    """A Riccati solver may well return a gain for them."""
    with pytest.raises(ValueError, match=message):
        lq_gain(DifferenceModel([-0.9], [0.0, 0.2]), Q, R)
