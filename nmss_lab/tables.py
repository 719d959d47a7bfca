"""Columns of numbers out of files: text, spreadsheets, MATLAB, pandas.

Every source becomes a header and numbered rows of cells; what is a number, a time
stamp or neither is decided here once, and a bad row is named by its number in the file.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TextIO, TypeAlias

import numpy as np

Array = np.ndarray[Any, np.dtype[np.float64]]
File: TypeAlias = str | PathLike[str] | TextIO
Bad: TypeAlias = Literal["refuse", "skip"]
Rows: TypeAlias = Iterable[tuple[int, Sequence[Any]]]

SHOWN = 8
"""How many bad rows a message lists."""


@dataclass(frozen=True)
class Table:
    """Columns that were read.

    Parameters
    ----------
    columns : dict from name to array (N,)
        Dates have become seconds since the first of them.
    units : dict from name to unit
    notes : tuple of str
        What was left out on the way.
    """

    columns: dict[str, Array]
    units: dict[str, str]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class BadCell:
    """A cell that is no number, or a time that does not increase."""

    row: int
    column: str
    fault: str

    def __str__(self) -> str:
        """Name row and column."""
        return f"row {self.row}, column {self.column!r}: {self.fault}"


def read_csv(file: File, wanted: Sequence[str], time: str | None, bad: Bad) -> Table:
    """Read columns of comma-separated text with one header row, which is row 1."""
    with opened(file, "r") as stream:
        reader = csv.reader(stream)
        heads = next(reader, [])
        rows = ((reader.line_num, row) for row in reader if row)
        return collect(heads, rows, wanted, time, bad)


def read_frame(
    frame: Any, wanted: Sequence[str], time: str | None, bad: Bad, first_row: int = 0
) -> Table:
    """Read columns of a pandas DataFrame; rows are counted from ``first_row``."""
    if time is not None and time == frame.index.name:
        frame = frame.reset_index()
    heads = [str(name) for name in frame.columns]
    rows = enumerate(frame.itertuples(index=False, name=None), first_row)
    return collect(heads, rows, wanted, time, bad)


def read_file(path: Path, wanted: Sequence[str], time: str | None, bad: Bad) -> Table:
    """Read columns of a file whose ending says what it is.

    Raises
    ------
    ValueError
        If the ending is unknown, a library for it is missing, or as ``collect``.
    """
    kind = path.suffix.lower()
    if kind == ".csv":
        return read_csv(path, wanted, time, bad)
    if kind == ".mat":
        return _read_mat(path, wanted, time, bad)
    if kind in (".xlsx", ".xls"):
        frame = _through_pandas("read_excel", path, "excel")
        return read_frame(frame, wanted, time, bad, first_row=2)
    if kind == ".parquet":
        frame = _through_pandas("read_parquet", path, "parquet")
        return read_frame(frame, wanted, time, bad)
    raise ValueError(
        f"{path.name}: unknown ending {kind!r}; expected .csv, .mat, .xlsx or .parquet"
    )


def _through_pandas(reader: str, path: Path, extra: str) -> Any:
    try:
        import pandas

        return getattr(pandas, reader)(path)
    except ImportError as error:
        raise ValueError(
            f"{path.name} needs a library that is not installed: "
            f'pip install "nmss-lab[{extra}]" ({error})'
        ) from error


def _read_mat(path: Path, wanted: Sequence[str], time: str | None, bad: Bad) -> Table:
    """Read vectors by name; columns of a matrix M are M1, M2, ..."""
    from scipy.io import loadmat

    try:
        content = loadmat(path)
    except NotImplementedError as error:
        raise ValueError(
            f"{path.name} is of MATLAB's version 7.3; save it with save(..., '-v7')"
        ) from error
    columns = {
        name: column
        for key, value in content.items()
        if not key.startswith("__") and _is_numeric(value)
        for name, column in _mat_columns(key, value)
    }
    sizes = {name: len(columns[name]) for name in wanted if name in columns}
    if len(set(sizes.values())) > 1:
        raise ValueError(f"{path.name}: columns differ in length: {sizes}")
    chosen = [columns[name] for name in sizes] or [np.zeros(0)]
    rows = enumerate(zip(*chosen, strict=True), 1)
    heads = [*sizes, *(name for name in columns if name not in sizes)]
    return collect(heads, rows, wanted, time, bad)


def _is_numeric(value: Any) -> bool:
    return (
        isinstance(value, np.ndarray) and value.ndim == 2 and value.dtype.kind in "iuf"
    )


def _mat_columns(name: str, value: Array) -> list[tuple[str, Array]]:
    if 1 in value.shape:
        return [(name, value.ravel())]
    return [(f"{name}{i + 1}", column) for i, column in enumerate(value.T)]


def collect(
    heads: Sequence[str],
    rows: Rows,
    wanted: Sequence[str],
    time: str | None,
    bad: Bad,
) -> Table:
    """Turn rows of cells into columns of numbers.

    Parameters
    ----------
    heads : sequence of str
        Names, with a unit in square brackets if there is one.
    rows : iterable of (number, cells)
    wanted : sequence of str
        Names of the columns to read.
    time : str or None
        Which of them may hold dates (ISO 8601; without a zone they count as UTC) and
        has to increase.
    bad : {"refuse", "skip"}

    Raises
    ------
    ValueError
        If a column is missing or named twice, if no row is left, or, unless they are
        skipped, for bad rows.
    """
    named = [name_and_unit(head) for head in heads]
    names = [name for name, _ in named]
    for name in wanted:
        if names.count(name) != 1:
            found = "missing" if name not in names else "there more than once"
            raise ValueError(f"column {name!r} is {found}; the file has {names}")
    if bad not in ("refuse", "skip"):
        raise ValueError(f'bad = {bad!r}: expected "refuse" or "skip"')
    places = {name: names.index(name) for name in wanted}
    clock = Clock()
    good, faults = _sorted_out(rows, places, time, clock)
    if faults and bad == "refuse":
        raise ValueError(_complaint(faults))
    if not good:
        raise ValueError("the file has no data below its header")
    columns = dict(zip(places, np.array(good).T, strict=True))
    units = {name: unit for name, unit in named if unit and name in places}
    if clock.origin is not None:
        units[str(time)] = "s"
    notes = (f"left out: {_complaint(faults)}",) if faults else ()
    return Table(columns, units, notes)


def _sorted_out(
    rows: Rows, places: dict[str, int], time: str | None, clock: Clock
) -> tuple[list[list[float]], list[BadCell]]:
    """Rows of numbers, and the first fault of each bad row."""
    good: list[list[float]] = []
    faults: list[BadCell] = []
    for number, row in rows:
        values: list[float] = []
        for name, place in places.items():
            cell = row[place] if place < len(row) else ""
            value = clock.read(cell) if name == time else _number(cell)
            if isinstance(value, str):
                faults.append(BadCell(number, name, value))
                break
            values.append(value)
        else:
            good.append(values)
            clock.advance()
    return good, faults


class Clock:
    """Reads the cells of a time column: numbers or dates, which have to increase."""

    def __init__(self) -> None:
        self.origin: datetime | None = None
        self.last: float | None = None
        self.now: float | None = None

    def read(self, cell: Any) -> float | str:
        """Return the time in the column's unit or in seconds, or what is wrong."""
        value = _number(cell)
        if isinstance(value, str):
            value = self._date(cell)
        elif self.origin is not None:
            return f"{cell!r} is a number among dates"
        if isinstance(value, float) and self.last is not None and value <= self.last:
            return f"{str(cell)!r} does not come after the row before"
        self.now = value if isinstance(value, float) else None
        return value

    def advance(self) -> None:
        """Take the last time read as passed: its row was good."""
        self.last = self.now

    def _date(self, cell: Any) -> float | str:
        text = cell.isoformat() if isinstance(cell, datetime) else str(cell).strip()
        try:
            stamp = datetime.fromisoformat(text)
        except ValueError:
            return f"{text!r} is neither a finite number nor an ISO date"
        stamp = stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)
        if self.origin is None:
            if self.last is not None:
                return f"{text!r} is a date among numbers"
            self.origin = stamp
        return (stamp - self.origin).total_seconds()


def _number(cell: Any) -> float | str:
    text = cell.strip() if isinstance(cell, str) else cell
    try:
        value = float(text)
    except (TypeError, ValueError):
        value = np.nan
    return value if np.isfinite(value) else f"{text!r} is not a finite number"


def _complaint(faults: Sequence[BadCell]) -> str:
    rest = [str(fault.row) for fault in faults[1:]]
    if not rest:
        return str(faults[0])
    shown = ", ".join(rest[:SHOWN]) + (", ..." if len(rest) > SHOWN else "")
    return f"{faults[0]}; {len(rest)} more bad rows: {shown}"


def name_and_unit(cell: str) -> tuple[str, str]:
    """Split "T1 [degC]" into name and unit."""
    match = re.fullmatch(r"\s*(.*?)\s*\[(.*)\]\s*", cell)
    return (match[1], match[2].strip()) if match else (cell.strip(), "")


@contextmanager
def opened(file: File, mode: Literal["r", "w"]) -> Iterator[TextIO]:
    """Open a path, or hand through a file that the caller opened and will close."""
    if not isinstance(file, str | PathLike):
        yield file
        return
    encoding = "utf-8-sig" if mode == "r" else "utf-8"
    with open(file, mode, encoding=encoding, newline="") as stream:
        yield stream
