"""Files: what is saved opens again and gives the same numbers; bad files say why."""

import json

import numpy as np
import pytest

from nmss_lab import (
    ContinuousPlant,
    Design,
    DifferenceModel,
    Horizon,
    Limits,
    Record,
    Scenario,
    TransferFunction,
)
from nmss_lab.files import Study, case_of, dumps, load, loads, save
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


def changed(path: str, value: object) -> str:
    """Return the text of a study with one place of it changed."""
    document = json.loads(dumps(study()))
    *steps, last = path.split(".")
    place = document
    for step in steps:
        place = place[step]
    if value is ABSENT:
        del place[last]
    else:
        place[last] = value
    return json.dumps(document)


def wrapped(content: str) -> str:
    """Return the text of a file with that content."""
    return f'{{"nmss_lab": 1, "content": {content}}}'


ABSENT = object()
"""Stands for a field that is taken away."""

NUMBERS = {"array": [1.0], "shape": [1], "dtype": "float64"}
MODEL = "content.design.model"
DEEP = "nested more deeply than any study"

BROKEN = {
    "empty": ("", "not a JSON file: .* line 1, column 1"),
    "truncated": (dumps(study())[:-3], "not a JSON file: .* line 1, column"),
    "not JSON": ("y,u\n1,2\n", "not a JSON file: .* line 1"),
    "bare NaN": ('{"nmss_lab": 1, "content": NaN}', "NaN is no JSON"),
    "bare infinity": ('{"nmss_lab": 1, "content": -Infinity}', "-Infinity is no JSON"),
    "field twice": ('{"nmss_lab": 1, "nmss_lab": 1}', 'field "nmss_lab" stands twice'),
    "endless number": (f'{{"nmss_lab": 1{"0" * 5000}}}', "number of 5001 digits"),
    "list": ("[1, 2]", "no .nmss_lab. version"),
    "no version": ('{"content": {}}', "no .nmss_lab. version"),
    "version true": (changed("nmss_lab", True), "no .nmss_lab. version"),
    "version of the future": ('{"nmss_lab": 99}', "version 99.*update"),
    "no content": ('{"nmss_lab": 1}', 'has no "content"'),
    "content a number": (changed("content", 5), "content is 5, expected Study, Design"),
    "content a list": (changed("content", [1]), "content is a list, expected Study"),
    "only a part": (changed("content", {"kind": "Run"}), 'content: .*"t" is missing'),
    "unknown kind": (changed("content.kind", "Popen"), "content: unknown kind 'Popen'"),
    "kind a list": (changed("content.kind", ["Study"]), "content: unknown kind"),
    "no kind": (changed("content.design.kind", ABSENT), "design: unknown kind None"),
    "wrong kind": (
        changed("content.design", {"kind": "Limits"}),
        "content: not a valid Study: design is a Limits, expected a Design",
    ),
    "unknown field": (
        changed("content.design.colour", "red"),
        'content.design: not a valid Design: unknown field "colour"; it has structure',
    ),
    "missing field": (
        changed(MODEL + ".b", ABSENT),
        'model: not a valid DifferenceModel: the field "b" is missing',
    ),
    "field of the constructor only": (
        changed("content.run.controller", None),
        'content.run: not a valid Run: unknown field "controller"',
    ),
    "unknown structure": (
        changed("content.design.structure", "magic"),
        'content.design: not a valid Design: structure = "magic"',
    ),
    "unknown reading": (
        changed("content.design.reference", "psychic"),
        "reference is the text 'psychic', expected one of held, next, preview, zero",
    ),
    "text for a number": (changed(MODEL + ".dt", "1 s"), "dt is the text '1 s'"),
    "number for a text": (
        changed(MODEL + ".y_names", [3]),
        "y_names is a list, expected a list, each a text",
    ),
    "whole number wanted": (
        changed("content.design.horizon.Np", 12.5),
        "horizon: not a valid Horizon: Np is 12.5, expected a whole number",
    ),
    "horizons that contradict": (
        changed("content.design.horizon.Nc", 13),
        "content.design.horizon: not a valid Horizon: .*Nc <= Np",
    ),
    "text for a weight": (
        changed("content.design.Q", "heavy"),
        "Design: Q is the text 'heavy', expected numbers",
    ),
    "limits with one side": (
        changed("content.design.limits.u", [1.0]),
        "limits: not a valid Limits: u is a list, expected a list of 2",
    ),
    "limits crossed": (changed("content.design.limits.u", [1.0, -1.0]), "exceeds"),
    "nan in a model": (
        changed(MODEL + ".a.array", [-1.7, "nan"]),
        "content.design.model: not a valid DifferenceModel: a.* is not finite",
    ),
    "nan in a plant": (
        changed("content.plant.A.array", [1.7, 1.0, "nan", 0.0]),
        "content.plant: not a valid LinearPlant: A is not finite",
    ),
    "nan for a period": (changed(MODEL + ".dt", "nan"), "dt = nan is not a positive"),
    "text in an array": (
        changed(MODEL + ".a.array", ["x", 1.0]),
        "content.design.model.a: not an array of numbers: entry 0 is the text 'x'",
    ),
    "array in an array": (changed(MODEL + ".a.array", [[1.0], 2.0]), "entry 0 is a li"),
    "array of nothing": (changed(MODEL + ".a.array", None), "numbers: nothing"),
    "shape missing": (changed(MODEL + ".a.shape", ABSENT), "has the fields array, dty"),
    "shape with a fraction": (
        changed(MODEL + ".a.shape", [1e9]),
        "shape .1000000000.0",
    ),
    "shape negative": (changed(MODEL + ".a.shape", [-1]), "shape .-1., expected whole"),
    "shape too large": (changed(MODEL + ".a.shape", [10**9] * 3), "model.a: .*reshape"),
    "wrong shape": (
        changed("content.plant.B", NUMBERS),
        "content.plant: not a valid LinearPlant: B has shape .1,., expected .2, 1.",
    ),
    "run of another length": (
        changed("content.run.y", {**NUMBERS, "shape": [1, 1]}),
        r"content: not a valid Study: y has shape \(1, 1\), expected \(30, 1\)",
    ),
    "text of a gigabyte": (
        changed(MODEL + ".a.dtype", "U1000000000"),
        "model.a: dtype 'U1000000000', expected one of float64",
    ),
    "nan as whole number": (
        changed(MODEL + ".a", {"array": ["nan"], "shape": [1], "dtype": "int64"}),
        "entry 0 is the text 'nan', expected a whole number",
    ),
    "number too large for its type": (
        changed(MODEL + ".a", {"array": [300], "shape": [1], "dtype": "int8"}),
        "content.design.model.a: not an array of numbers",
    ),
    "horizon that fills the memory": (
        changed("content.design.horizon.Np", 10**9),
        "Np = 1000000000 times the channels is 1000000000, expected up to 5000",
    ),
    "map that is none": (
        changed("content.design.options", {"map": [1]}),
        "content.design.options: not a map of names to values",
    ),
    "option unknown": (
        changed("content.design.options", {"map": {"speed": 3}}),
        "content: not a valid Study: .*unexpected keyword argument 'speed'",
    ),
    "deep lists": (wrapped("[" * 100_000), DEEP),
    "less deep lists": (wrapped("[" * 900 + "]" * 900), f"{DEEP}|content is a list"),
    "deep maps": (wrapped('{"map": {"a": ' * 600 + "1" + "}}" * 600), DEEP),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_files_say_what_is_broken_and_where(name):
    """Each fault is reported with its place in the file, as a ValueError."""
    text, message = BROKEN[name]
    with pytest.raises(ValueError, match=message):
        loads(text)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ('"u_lags": 2', '"u_lags": 1000000000', "u_lags = 1000000000, expected up to"),
        ("c*u[k-2]", "u[k-1000000]", "only past values u.k-1., u.k-2., ... u.k-50."),
        ("c*u[k-2]", "(" * 10_000, "content.model: not a valid StateDependentModel"),
    ],
)
def test_a_coefficient_cannot_fill_the_memory(before, after, message):
    """Coefficients of a file are refused where they ask for too much."""
    text = dumps(varying_study().design)
    assert before in text
    with pytest.raises(ValueError, match=message):
        loads(text.replace(before, after))


def test_files_that_are_no_text_are_told(tmp_path):
    """Binary files are refused by the byte; a mark of the byte order is none."""
    path = tmp_path / "study.json"
    path.write_bytes(b"\x7fELF\x02\x01\xff\x00")
    with pytest.raises(ValueError, match="not a JSON file: byte 7 is not text"):
        load(path)
    path.write_bytes(b"\xef\xbb\xbf" + dumps(study()).encode())
    assert load(path).design.structure == "wang_young"
    with pytest.raises(OSError, match="No such file"):
        load(tmp_path / "none.json")


def places(node, path=()):
    """Yield the way to every place of a document, a few of each list."""
    yield path
    parts = node.items() if isinstance(node, dict) else enumerate(node[:4])
    for step, part in parts:
        yield from places(part if isinstance(part, dict | list) else [], (*path, step))


ODD = (None, True, -1, 1.5, 1e300, 10**18, "", "nan", [], [[]], {}, ["a"], NUMBERS)


@pytest.mark.parametrize("original", ["study", "varying"])
def test_any_place_may_be_wrong(rng, original):
    """Whatever stands where, only a ValueError leaves ``loads``."""
    text = dumps(study() if original == "study" else varying_study())
    ways = [way for way in places(json.loads(text)) if way]
    refused = 0
    for i in rng.permutation(len(ways))[:120]:
        for value in rng.choice(np.array(ODD, dtype=object), 3):
            document = json.loads(text)
            place = document
            for step in ways[i][:-1]:
                place = place[step]
            place[ways[i][-1]] = value
            try:
                loads(json.dumps(document))
            except ValueError:
                refused += 1
    assert refused > 200  # of 360; others are numbers that may be others


def test_every_kind_of_plant_comes_back():
    """Also one in continuous time without disturbances, and the case of a design."""
    lag = TransferFunction([2.0], [10.0, 1.0], delay=1.5)
    plant = ContinuousPlant([[lag, None], [None, lag]], units={"u1": "%"})
    design = Design("wang_young", plant.difference_model(1.0))
    opened = loads(dumps(Study(design, plant)))
    assert opened.plant.channels == plant.channels
    example = case_of(opened, "mine.json")
    assert np.array_equal(example.plant.A, plant.sampled(1.0).A)
    assert list(example.designs) == ["wang_young"]
    assert example.title == "wang_young from mine.json"
    assert case_of(example) is example


def test_a_name_that_reads_as_a_number_is_refused():
    """A signal called inf would come back as a number."""
    model = DifferenceModel([-0.5], [1.0], y_names=["inf"])
    with pytest.raises(ValueError, match=r"content\.model\.y_names\[0\] is the text"):
        dumps(Design("wang_young", model))


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
