"""Files: what is saved opens again and gives the same numbers; bad files say why."""

import json

import numpy as np
import pytest

from nmss_lab import Design, DifferenceModel, Horizon, Limits, Record, Scenario
from nmss_lab.files import Study, dumps, load, loads, save
from nmss_lab.predictive import PredictiveController
from nmss_lab.sdp_mpc import Settling
from nmss_lab.simulate import closed_loop
from nmss_lab.state_dependent import StateDependentModel, StateDependentPlant


def study() -> Study:
    """Make a constrained run with a disturbance, a limit hit and infinite limits."""
    model = DifferenceModel([-1.7, 1.0], [-1.0, 2.0], y_names=["level"])
    design = Design(
        "wang_young", model, Horizon(12, 4, (1, 1, 2, 3)), 1.0, 0.3, Limits(u=(-1, 1))
    )
    scenario = Scenario(
        np.ones(30), output_disturbance=0.1 * (np.arange(30) > 15), manual=None
    )
    run = closed_loop(model.plant(), design.build(), scenario)
    return Study(design, model.plant(), scenario, run)


def test_study_gives_the_same_numbers_after_a_round_trip(tmp_path):
    """A saved run and the run made again from the file are equal to the last bit."""
    before = study()
    save(tmp_path / "study.json", before)
    after = load(tmp_path / "study.json")
    assert np.array_equal(after.run.y, before.run.y)
    assert np.array_equal(after.run.trail("y"), before.run.trail("y"))
    again = closed_loop(after.plant, after.design.build(), after.scenario)
    assert np.array_equal(again.u, before.run.u)
    assert after.design.model.y_names == ("level",)


def test_infinite_limits_and_record_survive(tmp_path):
    """Infinite limits, names and units come back; the file is plain JSON."""
    design = Design("wang_young", DifferenceModel([-0.5], [1.0]))
    text = dumps(design)
    json.loads(text, parse_constant=pytest.fail)
    assert np.isinf(loads(text).limits.u[0])
    record = Record(
        np.arange(4.0),
        np.arange(4.0)[:, None],
        np.ones((4, 1)),
        names={"y": ("T",), "u": ("Q",)},
        units={"T": "degC"},
    )
    save(tmp_path / "record.json", record)
    opened = load(tmp_path / "record.json")
    assert np.array_equal(opened.y, record.y)
    assert opened.names["y"] == ("T",)
    assert opened.units["T"] == "degC"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not a JSON file: .* line 1"),
        ("[1, 2]", "no .nmss_lab. version"),
        ('{"nmss_lab": 99}', "version 99.*update"),
        (
            '{"nmss_lab": 1, "content": {"kind": "Popen"}}',
            "content: unknown kind 'Popen'",
        ),
        (
            '{"nmss_lab": 1, "content": {"kind": "Horizon", "Np": 3, "Nc": 9}}',
            "content: not a valid Horizon: .*Nc <= Np",
        ),
        (
            '{"nmss_lab": 1, "content": {"kind": "Design", "structure": "pip", "model":'
            ' {"kind": "DifferenceModel", "a": {"array": ["x"]}, "b": [1.0]}}}',
            "content.model.a: not an array",
        ),
    ],
)
def test_broken_files_say_what_is_broken_and_where(text, message):
    """Each fault is reported with its place in the file."""
    with pytest.raises(ValueError, match=message):
        loads(text)


def test_what_is_not_data_is_refused_and_the_old_file_stays(tmp_path):
    """A design with a function cannot be saved and spoils nothing."""
    model = DifferenceModel([-0.5], [1.0], [1.0])
    path = tmp_path / "design.json"
    save(path, Design("wang_young", model))
    old = path.read_text()
    custom = Design("disturbance_direct", model, options={"forecast": print})
    with pytest.raises(ValueError, match=r"content\.options\.forecast is a builtin"):
        save(path, custom)
    assert path.read_text() == old
    assert list(tmp_path.iterdir()) == [path]


def test_loaded_design_still_checks_itself():
    """What a file asks for goes through the same border as an argument."""
    text = dumps(Design("wang_young", DifferenceModel([-0.5], [1.0])))
    with pytest.raises(ValueError, match='structure = "magic"'):
        loads(text.replace("wang_young", "magic"))


def test_controller_of_a_loaded_run_predicts():
    """The run of a loaded study has the controller of its design."""
    opened = loads(dumps(study()))
    assert isinstance(opened.run.controller, PredictiveController)
    assert opened.run.controller.horizon.blocks == (1, 1, 2, 3)


def varying_study(b="c*u[k-2]", structure="sdp_increments") -> Study:
    """Make a run of a state-dependent design, settled in its own way."""
    model = StateDependentModel(
        [-0.7], [b], y_names=["T"], units={"T": "K"}, constants={"c": 1.0}, u_lags=2
    )
    options = {"settling": Settling("newton", passes=20)}
    limits = Limits(u=(-0.8, 0.8))
    design = Design(structure, model, Horizon(6, 4), 0.1, 1.0, limits, options=options)
    scenario = Scenario(np.r_[np.ones(3), np.full(9, 2.0)], y0=1.0, u0=0.5)
    plant = StateDependentPlant(model, 0.02)
    return Study(design, plant, scenario, closed_loop(plant, design.build(), scenario))


@pytest.mark.parametrize("structure", ["sdp_increments", "sdp_integral_of_error"])
def test_a_state_dependent_study_comes_back(tmp_path, structure):
    """Texts, constants, the way to settle, load and run: the same numbers."""
    before = varying_study(structure=structure)
    save(tmp_path / "study.json", before)
    after = load(tmp_path / "study.json")
    assert after.design.options["settling"] == Settling("newton", passes=20)
    assert after.design.model.b == before.design.model.b
    assert after.design.model.units == {"T": "K"}
    for name in ("y", "u", "status", "iterations"):
        assert np.array_equal(getattr(after.run, name), getattr(before.run, name))
    assert np.array_equal(after.run.trail("y"), before.run.trail("y"))
    again = closed_loop(after.plant, after.design.build(), after.scenario)
    assert np.array_equal(again.u, before.run.u)


def test_a_coefficient_that_is_a_function_is_refused():
    """A file holds data; a text would do."""
    study = varying_study(lambda y, u: u[..., 1, 0])
    with pytest.raises(ValueError, match=r"content\.design\.model\.b.* function"):
        dumps(study)
