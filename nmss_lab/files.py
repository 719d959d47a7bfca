"""Designs, records, estimates and runs in a small JSON file, to the last digit.

Numbers are written with all their digits; infinite and missing ones as "inf", "-inf"
and "nan".  Nothing but data is read: no code, no class outside the list below.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

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
    )
}
"""What a file may hold."""


def save(path: str | Path, content: Study | Design | Record | Estimate) -> None:
    """Write a study, design, record or estimate; the old file stays if writing fails.

    Raises
    ------
    ValueError
        If the content holds something that is not data, such as a function.
    OSError
        If the file cannot be written.
    """
    text = dumps(content)
    target = Path(path)
    draft = target.with_name(target.name + ".part")
    try:
        draft.write_text(text, encoding="utf-8")
        draft.replace(target)
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
    return loads(Path(path).read_text(encoding="utf-8"))


def dumps(content: Study | Design | Record | Estimate) -> str:
    """Text of the file for ``content``; see ``save``."""
    return json.dumps(
        {"nmss_lab": SCHEMA, "content": _encode(content, "content")}, allow_nan=False
    )


def loads(text: str) -> Any:
    """Content of a file's text; see ``load``."""
    try:
        document = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(
            f"not a JSON file: {error.msg} at line {error.lineno}, column {error.colno}"
        ) from error
    version = document.get("nmss_lab") if isinstance(document, dict) else None
    if not isinstance(version, int):
        raise ValueError('not a file of NMSS Lab: it has no "nmss_lab" version')
    if version > SCHEMA:
        raise ValueError(
            f"the file has version {version}, this program reads up to {SCHEMA}: "
            "update NMSS Lab"
        )
    return _decode(document.get("content"), "content")


def _encode(value: Any, where: str) -> Any:
    if isinstance(value, np.ndarray):
        return {
            "array": [_number(x) for x in value.ravel().tolist()],
            "shape": list(value.shape),
            "dtype": value.dtype.name,
        }
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
    if value in ("inf", "-inf", "nan"):
        return float(value)
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return _array(value, where)
    if "map" in value:
        return {k: _decode(v, f"{where}.{k}") for k, v in value["map"].items()}
    kind = value.get("kind")
    if kind not in KINDS:
        raise ValueError(f"{where}: unknown kind {kind!r}")
    parts = {k: _decode(v, f"{where}.{k}") for k, v in value.items() if k != "kind"}
    return _build(KINDS[kind], parts, where)


def _array(value: dict[str, Any], where: str) -> Array:
    try:
        numbers = np.array([float(x) for x in value["array"]])
        return numbers.astype(value["dtype"]).reshape(value["shape"])
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{where}: not an array of numbers ({error})") from error


def _build(kind: type, parts: dict[str, Any], where: str) -> Any:
    run = parts.get("run")
    try:
        if kind is Run:
            return parts  # waits for the design that its controller is built from
        if kind is Study and isinstance(run, dict):
            parts["run"] = Run(controller=parts["design"].build(), **run)
        return kind(**parts)
    except (TypeError, ValueError, KeyError, AttributeError) as error:
        raise ValueError(f"{where}: not a valid {kind.__name__}: {error}") from error
