"""Designs, records, estimates and runs in a small JSON file, to the last digit.

Numbers are written with all their digits; infinite and missing ones as "inf", "-inf"
and "nan".  Nothing but data is read: no code, no class outside the list below.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from nmss_lab.cases import Actuator, Case, FloorPlan, Zone, design_case
from nmss_lab.continuous import ContinuousPlant, TransferFunction
from nmss_lab.controller import Limits, Move
from nmss_lab.design import Design
from nmss_lab.identify import Estimate, Noise, Orders
from nmss_lab.models import Array, Between, DifferenceModel, LinearPlant
from nmss_lab.predict import Horizon
from nmss_lab.records import Record
from nmss_lab.sdp_mpc import Settling
from nmss_lab.simulate import Run, Scenario
from nmss_lab.state_dependent import StateDependentModel, StateDependentPlant

SCHEMA = 1
"""Version of the file's layout; files of lower versions open as well."""


@dataclass(frozen=True, eq=False)
class Study:
    """A design with what it was tried on and what came of it.

    Parameters
    ----------
    design : Design
    plant : LinearPlant, DifferenceModel, ContinuousPlant, or a state-dependent one
    scenario : Scenario, optional
    run : Run, optional
        Its controller is not stored but built again from the design.
    """

    design: Design
    plant: (
        LinearPlant
        | DifferenceModel
        | ContinuousPlant
        | StateDependentModel
        | StateDependentPlant
        | None
    ) = None
    scenario: Scenario | None = None
    run: Run | None = None


KINDS: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        Study,
        Design,
        DifferenceModel,
        StateDependentModel,
        StateDependentPlant,
        Settling,
        LinearPlant,
        Between,
        ContinuousPlant,
        TransferFunction,
        Horizon,
        Limits,
        Record,
        Orders,
        Noise,
        Estimate,
        Scenario,
        Run,
        Move,
        Case,
        FloorPlan,
        Zone,
        Actuator,
    )
}
"""What a file may hold."""

WHOLE = Study, Design, Record, Estimate, Case
"""What a file as a whole may be."""

NOT_FINITE = "inf", "-inf", "nan"

DTYPES = ("float64", "int64", "bool", "float32", "int32", "int16", "int8", "uint8")
"""Types of numbers that an array of a file may have."""

LARGEST = 5000
"""Steps along a horizon, times channels, and lags of a design in a file.

Programs grow with their square: a few characters must not fill a memory.
"""

FAULTS = (
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
)
"""What building an object from wrong data may raise."""


def save(path: str | Path, content: Study | Design | Record | Estimate | Case) -> None:
    """Write content to a file; the old file stays if writing fails.

    Raises
    ------
    ValueError
        If the content holds something that is not data, such as a function.
    OSError
        If the file cannot be written.
    """
    write(path, dumps(content))


def write(path: str | Path, text: str) -> None:
    """Write a text; the old file stays if writing fails.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    target = Path(path)
    draft = target.with_name(target.name + ".part")
    try:
        draft.write_text(text, encoding="utf-8")
        draft.replace(target)
    except OSError as error:  # such as a full disk, which names no file
        raise OSError(error.errno, error.strerror, str(target)) from error
    finally:
        draft.unlink(missing_ok=True)


def load(path: str | Path) -> Any:
    """Read what ``save`` wrote.

    Raises
    ------
    ValueError
        If the file is not such a file; the message says what is wrong and where.
    OSError
        If the file cannot be read.
    """
    try:
        text = Path(path).read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"not a JSON file: byte {error.start + 1} is not text in UTF-8"
        ) from error
    return loads(text)


def dumps(content: Study | Design | Record | Estimate | Case) -> str:
    """Text of the file for ``content``; see ``save``."""
    return json.dumps(
        {"nmss_lab": SCHEMA, "content": _encode(content, "content")}, allow_nan=False
    )


def loads(text: str) -> Any:
    """Content of a file's text; see ``load``."""
    document = _parsed(text)
    version = document.get("nmss_lab") if isinstance(document, dict) else None
    if isinstance(version, bool) or not isinstance(version, int) or version < 1:
        raise ValueError('not a file of NMSS Lab: it has no "nmss_lab" version')
    if version > SCHEMA:
        raise ValueError(
            f"the file has version {version}, this program reads up to {SCHEMA}: "
            "update NMSS Lab"
        )
    if "content" not in document:
        raise ValueError('the file has no "content"')
    try:
        content = _decode(document["content"], "content")
    except RecursionError:
        raise ValueError(TOO_DEEP) from None
    if not isinstance(content, WHOLE):
        raise ValueError(f"content is {_told(content)}, expected {_listed(WHOLE)}")
    return content


TOO_DEEP = "the file is nested more deeply than any study is"


def _parsed(text: str) -> Any:
    """Read JSON strictly: no bare NaN, no field twice."""
    try:
        return json.loads(
            text,
            parse_int=_whole_number,
            parse_constant=_refuse_constant,
            object_pairs_hook=_once,
        )
    except json.JSONDecodeError as error:
        raise ValueError(
            f"not a JSON file: {error.msg} at line {error.lineno}, column {error.colno}"
        ) from error
    except RecursionError:
        raise ValueError(TOO_DEEP) from None
    except ValueError as error:
        raise ValueError(f"not a JSON file: {error}") from error


def _whole_number(text: str) -> int:
    if len(text) > 19:
        raise ValueError(f"a whole number of {len(text)} digits, expected up to 19")
    return int(text)


def _refuse_constant(name: str) -> None:
    raise ValueError(f'{name} is no JSON; "nan", "inf" and "-inf" are written as texts')


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Object of its fields, none of them twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f'the field "{twice}" stands twice in one object')
    return found


def case_of(content: Study | Design | Case, name: str = "design") -> Case:
    """Case with the design that a file holds, ready to run; a case is one already.

    Parameters
    ----------
    content : Study, Design or Case
        What it does not state is that of ``nmss_lab.cases.design_case``.
    name : str
        Of the file.

    Returns
    -------
    Case
        Its notes say what had to be assumed.

    Raises
    ------
    ValueError
        If the content is something else, such as a record, or the design cannot be
        built.
    """
    if isinstance(content, Case):
        return content
    if not isinstance(content, Study | Design):
        raise ValueError(f"{name} holds {_told(content)}, expected a Study or a Design")
    study = Study(content) if isinstance(content, Design) else content
    design = study.design
    try:
        design.build()
    except FAULTS as error:
        what = str(error) or type(error).__name__
        raise ValueError(f"{name}: the design cannot be built: {what}") from error
    return dataclasses.replace(
        design_case(design, study.plant, study.scenario),
        name=f"the design of {name}",
        title=f"{design.structure} from {name}",
        designs={design.structure: design},
    )


def _encode(value: Any, where: str) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.name in DTYPES:
        return {
            "array": [_number(x) for x in value.ravel().tolist()],
            "shape": list(value.shape),
            "dtype": value.dtype.name,
        }
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if type(value).__name__ in KINDS and dataclasses.is_dataclass(value):
        return {"kind": type(value).__name__, **_fields(value, where)}
    if isinstance(value, Mapping):
        return {"map": {str(k): _encode(v, f"{where}.{k}") for k, v in value.items()}}
    if isinstance(value, list | tuple):
        return [_encode(v, f"{where}[{i}]") for i, v in enumerate(value)]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, str) and value in NOT_FINITE:
        raise ValueError(f"{where} is the text {value!r}, which a file reads as number")
    if value is None or isinstance(value, str | int | bool):
        return value
    raise ValueError(f"{where} is a {type(value).__name__}, which no file can hold")


def _fields(value: Any, where: str) -> dict[str, Any]:
    skip = {"controller"} if isinstance(value, Run) else set()
    return {
        part.name: _encode(getattr(value, part.name), f"{where}.{part.name}")
        for part in dataclasses.fields(value)
        if part.init and part.name not in skip
    }


def _number(value: float) -> float | str:
    return value if np.isfinite(value) else str(float(value))


def _decode(value: Any, where: str) -> Any:
    if isinstance(value, list):
        return tuple(_decode(v, f"{where}[{i}]") for i, v in enumerate(value))
    if isinstance(value, str):
        return float(value) if value in NOT_FINITE else value
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return _array(value, where)
    if "map" in value:
        content = value["map"]
        if not isinstance(content, dict) or len(value) > 1:
            raise ValueError(f"{where}: not a map of names to values")
        return {k: _decode(v, f"{where}.{k}") for k, v in content.items()}
    kind = value.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise ValueError(f"{where}: unknown kind {kind!r}")
    parts = {k: _decode(v, f"{where}.{k}") for k, v in value.items() if k != "kind"}
    return _build(KINDS[kind], parts, where)


def _array(value: dict[str, Any], where: str) -> Array:
    """Read an array, without converting what would lose something."""
    if set(value) != {"array", "shape", "dtype"}:
        raise ValueError(
            f"{where}: not an array of numbers: it has the fields "
            f"{', '.join(value)}, expected array, shape, dtype"
        )
    numbers, shape, dtype = value["array"], value["shape"], value["dtype"]
    if dtype not in DTYPES:
        raise ValueError(f"{where}: dtype {dtype!r}, expected one of {_listed(DTYPES)}")
    if not (isinstance(shape, list) and all(_fits(n, int) and n >= 0 for n in shape)):
        raise ValueError(f"{where}: shape {shape!r}, expected whole numbers from 0 on")
    if not isinstance(numbers, list):
        raise ValueError(f"{where}: not an array of numbers: {_told(numbers)}")
    allowed = {"b": bool, "i": int, "u": int}.get(np.dtype(dtype).kind, float)
    for i, x in enumerate(numbers):
        if not (_fits(x, allowed) or (allowed is float and x in NOT_FINITE)):
            raise ValueError(
                f"{where}: not an array of numbers: entry {i} is {_told(x)}, expected "
                f"{_expected(allowed)}"
            )
    try:
        entries = [float(x) for x in numbers] if allowed is float else numbers
        return np.array(entries, dtype=dtype).reshape(shape)
    except FAULTS as error:
        raise ValueError(f"{where}: not an array of numbers ({error})") from error


def _build(kind: type, parts: dict[str, Any], where: str) -> Any:
    try:
        _check_fields(kind, parts)
        if kind is Run:
            return parts  # waits for the design that its controller is built from
        if kind is Study and isinstance(parts.get("run"), dict):
            parts["run"] = _run_of(parts["design"], parts["run"])
        built = kind(**parts)
        if isinstance(built, LinearPlant):
            _check_plant(built)
        if isinstance(built, Design):
            _check_size(built)
    except FAULTS as error:
        what = str(error) or type(error).__name__
        raise ValueError(f"{where}: not a valid {kind.__name__}: {what}") from error
    return built


# What a file must be like: fields, their kinds, shapes, sizes


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    """Type of each field that a file states; Any stands for numbers of any shape."""
    hints = get_type_hints(kind)
    if kind is StateDependentModel:  # its coefficients may be texts: it looks itself
        hints |= {"a": object, "b": object}
    return {
        part.name: dict if hints[part.name] == Run | None else hints[part.name]
        for part in dataclasses.fields(kind)
        if part.init and not (kind is Run and part.name == "controller")
    }


def _check_fields(kind: type, parts: Mapping[str, Any]) -> None:
    """Refuse unknown fields, missing ones, and values of another type."""
    hints = _hints(kind)
    unknown = [name for name in parts if name not in hints]
    if unknown:
        raise ValueError(f'unknown field "{unknown[0]}"; it has {_listed(hints)}')
    absent = dataclasses.MISSING
    for part in dataclasses.fields(kind):
        if part.name not in parts:
            if part.default is absent is part.default_factory and part.name in hints:
                raise ValueError(f'the field "{part.name}" is missing')
            continue
        value, hint = parts[part.name], hints[part.name]
        if not (_fits(value, hint) or (hint is dict and value is None)):
            raise ValueError(
                f"{part.name} is {_told(value)}, expected {_expected(hint)}"
            )


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value that was read is of a type."""
    origin, inside = get_origin(hint), get_args(hint)
    if hint is Any and isinstance(value, tuple):
        return all(_fits(part, Any) for part in value)
    if hint is Any:
        return value is None or _fits(value, float) or isinstance(value, np.ndarray)
    if origin in (Union, types.UnionType):
        return any(_fits(value, part) for part in inside)
    if origin is Literal:
        return isinstance(value, str) and value in inside
    if origin is Mapping:
        return isinstance(value, dict) and (
            inside[1] is Any or all(_fits(part, inside[1]) for part in value.values())
        )
    if origin is tuple and inside[-1] is not Ellipsis:
        sized = isinstance(value, tuple) and len(value) == len(inside)
        return sized and all(map(_fits, value, inside))
    if origin in (tuple, Sequence):
        return isinstance(value, tuple) and all(_fits(v, inside[0]) for v in value)
    if hint in (int, float) and isinstance(value, bool):
        return False
    return isinstance(value, int | float if hint is float else origin or hint)


WORDS: dict[Any, str] = {
    Any: "numbers",
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "a text",
    dict: "a map",
    tuple: "a list",
    list: "a list",
    Mapping: "a map of names",
    Sequence: "a list",
    np.ndarray: "an array",
    types.NoneType: "nothing",
}


def _expected(hint: Any) -> str:
    origin, inside = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return " or ".join(_expected(part) for part in inside)
    if origin is Literal:
        return f"one of {_listed(inside)}"
    if origin is tuple and inside[-1] is not Ellipsis:
        return f"a list of {len(inside)}"
    name: str = WORDS.get(origin or hint) or f"a {hint.__name__}"
    of = [_expected(part) for part in inside[-1:] if part in WORDS]
    return f"{name}, each {of[0]}" if of else name


def _told(value: Any) -> str:
    """Say what a value is."""
    if isinstance(value, str):
        return f"the text {value[:40]!r}"
    if isinstance(value, bool | int | float):
        return repr(value)[:40]
    return WORDS.get(type(value)) or f"a {type(value).__name__}"


def _listed(names: Any) -> str:
    return ", ".join(getattr(name, "__name__", str(name)) for name in names)


def _check_size(design: Design) -> None:
    """Refuse a design whose program would fill the memory."""
    model = design.model
    steps = design.horizon.Np * max(model.n_y, model.n_u)
    if steps > LARGEST:
        raise ValueError(
            f"Np = {design.horizon.Np} times the channels is {steps}, expected up to "
            f"{LARGEST} in a file"
        )
    if isinstance(model, StateDependentModel):
        for name in ("y_lags", "u_lags"):
            if getattr(model, name) > LARGEST:
                raise ValueError(
                    f"{name} = {getattr(model, name)}, expected up to {LARGEST} in a "
                    "file"
                )


def _check_plant(plant: LinearPlant) -> None:
    """Compare shapes, which arguments of a plant are trusted to have."""
    n, n_y, n_u, n_v = (
        len(plant.A),
        len(plant.C),
        plant.B.shape[-1],
        plant.G.shape[-1],
    )
    shapes = {"A": (n, n), "B": (n, n_u), "C": (n_y, n), "G": (n, n_v)}
    _check_shapes(plant, shapes)
    if plant.rest is not None:
        _check_shapes(plant, {"rest": (n, n_y + n_u + n_v)})
    if plant.between is not None:
        m = len(plant.between.times)
        _check_shapes(
            plant.between,
            {"times": (m,), "C": (m, n_y, n), "B": (m, n_y, n_u), "G": (m, n_y, n_v)},
        )
    if not plant.dt > 0.0:
        raise ValueError(f"dt = {plant.dt} is not a positive number of seconds")


def _check_shapes(owner: Any, shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Refuse arrays of another shape, and entries of a plant that are not finite."""
    for name, shape in shapes.items():
        array = getattr(owner, name)
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
        if isinstance(owner, LinearPlant | Between) and not np.isfinite(array).all():
            raise ValueError(f"{name} is not finite")


def _run_of(design: Design, parts: dict[str, Any]) -> Run:
    """Run with the controller of its design."""
    run = Run(controller=design.build(), **parts)
    model, N, M = run.controller.model, len(run.t), len(run.t_fine)
    rows = run.controller.n_rows
    by_sample = {
        **dict.fromkeys(("y", "measured", "r", "w"), (N, model.n_y)),
        **dict.fromkeys(("u", "du"), (N, model.n_u)),
        **dict.fromkeys(("t", "status", "cost", "iterations"), (N,)),
        "multipliers": (N, rows),
    }
    _check_shapes(run, {**by_sample, "t_fine": (M,), "y_fine": (M, model.n_y)})
    if run.moves is not None:
        n_z, n_theta = run.controller.n_z, run.controller.n_theta
        shapes = {"decision": (N, n_z), "known": (N, n_theta), "multipliers": (N, rows)}
        _check_shapes(run.moves, shapes)
    return run
