"""The cases as data: they build, run, and say what they assume."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from conftest import ALGEBRA

from nmss_lab import cases
from nmss_lab.analysis import linear_loop
from nmss_lab.cli import main
from nmss_lab.controller import Status
from nmss_lab.models import minimal_realisation
from nmss_lab.nmss import _deadbeat, differenced_form
from nmss_lab.records import Record
from nmss_lab.sdp_mpc import SCHEMES
from nmss_lab.simulate import closed_loop
from nmss_lab.uncertainty import realisations

DESIGNS = [
    (name, design) for name in cases.CASES for design in cases.case(name).designs
]
LINEAR = [(name, design) for name, design in DESIGNS if name in cases.LINEAR_CASES]


@pytest.mark.parametrize("name", cases.CASES)
def test_a_case_is_complete(name: str) -> None:
    """Name, source and notes are there, and structures can be compared."""
    case = cases.case(name)
    assert case.name == name
    assert case.title
    assert case.section or name in cases.VARYING_CASES
    assert case.source
    assert len(case.notes) >= 3
    assert all(note.endswith(".") for note in case.notes)
    structures = {design.structure for design in case.designs.values()}
    linear = {"integral_of_error", "wang_young", "forward_path", "minimal"}
    if name in cases.VARYING_CASES:
        settlings = [design.options.get("settling") for design in case.designs.values()]
        assert set(SCHEMES) == {each.scheme for each in settlings if each is not None}
        assert {"frozen", "iterated", "gauss_newton", "newton"} <= set(case.designs)
    else:
        assert linear <= structures
    for design in case.designs.values():
        assert np.isclose(design.model.dt, case.plant.dt)
    for low, high in case.bands.values():
        assert (np.asarray(low) < np.asarray(high)).all()


@pytest.mark.parametrize(("name", "design"), DESIGNS)
def test_every_design_runs(name: str, design: str) -> None:
    """The whole scenario gives finite signals within the input's limits."""
    case = cases.case(name)
    controller = case.designs[design].build()
    run = closed_loop(case.plant, controller, case.scenario)
    assert np.isfinite(run.y_fine).all()
    assert np.isfinite(run.u).all()
    for signal, kind in ((run.u, "u"), (run.du, "du")):
        low, high = controller.limits.of(kind, controller.model.n_u)
        assert (signal >= low - 1e-9).all()  # rounding of sums of changes
        assert (signal <= high + 1e-9).all()
    varies = list(range(Status.AMBIGUOUS, Status.GUARDED + 1))
    allowed = varies if name in cases.VARYING_CASES else []
    fine = (run.status <= Status.CLIPPED) | np.isin(run.status, allowed)
    assert fine.all(), run.sentences


@pytest.mark.parametrize(("name", "design"), LINEAR)
def test_designs_are_stable_on_their_model(name: str, design: str) -> None:
    """All but those that are kept to show that they fail.

    The forward path never damps the poles of its model on the unit circle; the
    gasifier's printed horizons do not stabilise it.
    """
    case = cases.case(name)
    chosen = case.designs[design]
    radius = linear_loop(chosen.build()).radius
    marginal = np.abs(np.abs(chosen.model.poles()) - 1.0).min() < 1e-6
    forward = "forward" in design
    if forward and marginal:
        assert radius == pytest.approx(1.0, abs=1e-6)  # double poles: root of rounding
    elif design == "wang_young_printed":
        assert radius > 1.02
    else:
        assert radius < 1.0


def test_an_unknown_case_is_refused() -> None:
    """The message lists the names."""
    with pytest.raises(ValueError, match=r'case "tank": expected one of governor_3_4'):
        cases.case("tank")


def test_what_is_synthetic_says_so() -> None:
    """Made-up disturbances are called synthetic in the notes."""
    for name in ("temperature_7_4_2", "gasifier_6_3_4"):
        text = " ".join(cases.case(name).notes)
        assert re.search("synthetic", text, re.IGNORECASE)
    assert "synthetic" in cases.case("temperature_7_4_2").title


def test_piecewise_series() -> None:
    """Values hold from their sample on; several channels at once."""
    series = cases.piecewise(4, (1, [1.0, 2.0]), (3, [0.0, 5.0]))
    assert series.tolist() == [[0, 0], [1, 2], [1, 2], [0, 5]]
    assert cases.pulse(6, 2, 3, 0.5).ravel().tolist() == [0, 0, 0.5, 0.5, 0.5, 0]
    assert cases.square_wave(5, 2).ravel().tolist() == [1, 1, -1, -1, 1]


# IFAC'93


def test_ifac93_plant() -> None:
    """Seven poles, unit gain, and the zero at 1/T2."""
    plant = cases.ifac93_plant()
    poles = plant.poles()
    expected = [-12.0, -8.0, -0.2]
    real = np.sort(poles[np.abs(poles.imag) < 1e-9].real)
    assert len(poles) == 7
    assert real == pytest.approx(expected, rel=1e-9)  # roots of a product of factors
    assert plant.steady_state_gain()[0, 0] == pytest.approx(1.0, abs=ALGEBRA)


@pytest.mark.parametrize("level", [1, 2, 3])
def test_stress_corners(level: int) -> None:
    """32 corners in the stated order; the gain moves as Table 4.1 says."""
    corners = realisations(cases.stress(level, corners=True))
    deviation = cases.STRESS_LEVELS[level]["K"]
    gains = [corner.plant.response(1.0)[0, 0] for corner in corners]
    signs = [s[-1] for s in itertools.product((-1, 1), repeat=5)]
    # expm and a solve of 7 states
    assert gains == pytest.approx([1.0 + s * deviation for s in signs], abs=1e-8)
    T1 = cases.STRESS_LEVELS[level]["T1"]
    assert corners[0].values["T1"] == pytest.approx(5.0 - T1)
    slow = np.abs(corners[-1].plant.poles()).max()
    assert slow == pytest.approx(np.exp(-0.5 / (5.0 + T1)), rel=1e-9)


def test_an_unknown_stress_level_is_refused() -> None:
    """There are three."""
    with pytest.raises(ValueError, match="level = 4: expected 1, 2 or 3"):
        cases.stress(4)


# Shell


@pytest.mark.parametrize("output", [0, 1, 2])
def test_shell_desired_response(output: int) -> None:
    """0.3 after the dead time of the output, then towards 1; the others stay at 0."""
    desired = cases.shell_desired(22, output)
    dead = cases.SHELL_DEAD_TIMES[output]
    assert (desired[:dead] == 0).all()
    assert desired[dead, output] == pytest.approx(0.3, abs=ALGEBRA)
    assert desired[dead + 1, output] == pytest.approx(0.51, abs=ALGEBRA)
    assert np.delete(desired, output, axis=1).max() == 0.0


def test_shell_dead_times() -> None:
    """They are those of the model (5.7)."""
    dead = cases.shell_model().dead_time.min(axis=1)
    assert dead.tolist() == list(cases.SHELL_DEAD_TIMES)


# Gasifier, temperature


def test_gasifier_zero() -> None:
    """The transmission zero outside the unit circle that makes Np = 20 too short."""
    zeros = cases.gasifier_model().zeros()
    assert np.abs(zeros[0]) == pytest.approx(1.0381, abs=5e-5)


def test_surrounding_temperature() -> None:
    """A swing of about 7 degC, a fall of nearly 2 degC at the door, no jumps."""
    v = cases.surrounding_temperature(1501)[:, 0]
    assert 5.0 < np.ptp(v) < 8.0
    assert np.abs(np.diff(v)).max() < 0.4
    assert v[558] - v[550] == pytest.approx(-2.0, abs=0.6)  # day and drift go on


def test_surroundings_in_which_both_groups_can_be_held() -> None:
    """About 21.3 to 23.1 degC, as the notes say: elsewhere an input hits its limit."""
    model = cases.temperature_model()
    v = np.arange(20.0, 25.0, 0.01)
    drive = 23.0 - np.outer(model.disturbance_gain()[:, 0], v)
    u = np.linalg.solve(model.steady_state_gain(), drive)
    low, high = np.array([[10.0], [15.0]]), np.array([[25.0], [27.0]])
    held = v[((u >= low) & (u <= high)).all(axis=0)]
    assert held.min() == pytest.approx(21.3, abs=0.1)
    assert held.max() == pytest.approx(23.1, abs=0.1)


def test_units_of_the_ventilation() -> None:
    """The unit is stated with the model."""
    assert cases.temperature_model().units["ventilation"] == "100 m3/h"
    assert cases.temperature_model(1.0).units["ventilation"] == "m3/h"


# Public cases: numbers of their sources


@pytest.mark.parametrize(
    ("minimum_phase", "T", "zeros", "relative_gain"),
    [
        (True, (62.0, 90.0, 23.0, 30.0), (-0.060, -0.018), 1.40),
        (False, (63.0, 91.0, 39.0, 56.0), (0.013, -0.057), -0.64),
    ],
)
def test_quadruple_tank(
    minimum_phase: bool,
    T: tuple[float, ...],
    zeros: tuple[float, ...],
    relative_gain: float,
) -> None:
    """Time constants, zeros and relative gain of Johansson (2000).

    The paper rounds the time constants before it computes the zeros.
    """
    plant = cases.quadruple_tank_plant(minimum_phase)
    found = np.unique(np.round(-1.0 / plant.poles().real, 6))
    assert np.sort(found) == pytest.approx(np.sort(T), abs=1.0)
    gain = plant.steady_state_gain()
    ours = gain[0, 0] * gain[1, 1] / np.linalg.det(gain)
    assert ours == pytest.approx(relative_gain, abs=0.005)
    determinant = np.poly1d([1.0])
    (a, b), (c, d) = plant.channels
    assert a
    assert b
    assert c
    assert d
    upper = np.polymul(b.num, c.num)
    shared = np.polymul(np.polydiv(b.den, a.den)[0], np.polydiv(c.den, d.den)[0])
    direct = np.polymul(np.polymul(a.num, d.num), shared)
    determinant = np.polysub(direct, upper)
    assert np.sort(np.roots(determinant).real) == pytest.approx(
        np.sort(zeros), abs=0.002
    )


def test_wood_berry() -> None:
    """Relative gain 2.01, and dead times of 1 to 7 minutes as samples."""
    gain = cases.wood_berry_plant().steady_state_gain()
    relative = gain[0, 0] * gain[1, 1] / np.linalg.det(gain)
    assert relative == pytest.approx(2.0094, abs=5e-5)
    model = cases.case("wood_berry").model
    assert model.dead_time.tolist() == [[2, 4], [8, 4]]


# The observer of the minimal designs


@pytest.mark.parametrize("name", cases.LINEAR_CASES)
def test_deadbeat_observers_are_gentle(name: str) -> None:
    """Errors vanish in as many samples as states, and gains stay of order one.

    Placing distinct poles near the origin gave gains up to 3e4 on the column.
    """
    base = differenced_form(cases.case(name).model)
    A, _, C = minimal_realisation(base.A, base.B, base.C)
    L = _deadbeat(A, C)
    after = np.linalg.matrix_power(A - L @ C, len(A))
    assert np.abs(after).max() < ALGEBRA
    assert np.abs(L).max() < 5.0


# The command


def test_simulate_lists_the_cases(capsys: pytest.CaptureFixture[str]) -> None:
    """Without a name every case is listed with its designs."""
    assert main(["simulate"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in cases.CASES)
    assert "forward_path_optimised" in text


def test_simulate_prints_measures(capsys: pytest.CaptureFixture[str]) -> None:
    """A table for each output, and how the moves came about."""
    assert main(["simulate", "governor_3_4", "--structure", "governor"]) == 0
    text = capsys.readouterr().out
    assert "82.75" in text
    assert "of 60: A limit is active in the plan" in text


def test_simulate_writes_a_record(tmp_path: Path) -> None:
    """The file opens as a record with names and units, and holds the run."""
    file = str(tmp_path / "run.csv")
    case, design = "temperature_7_4_2", "disturbance_direct"
    assert main(["simulate", case, "--structure", design, "--csv", file]) == 0
    model = cases.case(case).model
    record = Record.from_csv(
        file, y=model.y_names, u=model.u_names, v=model.v_names, time="time"
    )
    assert record.y.shape == (800, 2)
    assert record.dt == pytest.approx(360.0)
    assert record.units["inlet"] == "degC"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "expected one of governor_3_4"),
        (["shell_5_3_2", "--structure", "pip"], "this case has integral_of_error"),
        (["shell_5_3_2", "--csv", "x.csv"], "name it with --structure"),
    ],
)
def test_simulate_says_what_is_wrong(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    """Mistakes end with exit code 1 and one sentence."""
    assert main(["simulate", *arguments]) == 1
    assert message in capsys.readouterr().err
