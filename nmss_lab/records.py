"""Sampled data: what was measured, when, and in which units.

A `Record` holds outputs y, inputs u, measured disturbances v and references r over
time, with the names and units of their columns.  It is what identification reads and
what a closed-loop run can be exported to.  Nothing here knows about models.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from os import PathLike
from typing import Any, Literal, TextIO, TypeAlias

import numpy as np

Array = np.ndarray[Any, np.dtype[np.float64]]
File: TypeAlias = str | PathLike[str] | TextIO
Trend: TypeAlias = Literal["constant", "linear", "first"]

GROUPS = ("y", "u", "v", "r")

# Time stamps rounded by a logger still count as regular below this share of dt.
IRREGULAR = 1e-3
# Start and stop of a selection may miss a time stamp by this share of the interval.
ROUNDING = 1e-6


def _empty() -> Array:
    return np.empty((0, 0))


@dataclass(frozen=True, eq=False)
class Record:
    """Signals sampled at the same, increasing times; one row is one sample.

    Parameters
    ----------
    time : array of shape (N,)
        Sampling times, strictly increasing.
    y : array of shape (N, n_y) or (N,)
        Outputs, at least one column.
    u, v : arrays of shape (N, n_u), (N, n_v) or (N,), optional
        Inputs and measured disturbances; an empty array means none.
    r : array of shape (N, n_y) or (N,), optional
        References, one for each output, or empty.
    names : mapping from "y", "u", "v", "r" to a tuple of column names, optional
        Missing groups are called y1, y2, ... and so on.  All names differ.
    units : mapping from column name (or "time") to unit, optional
        Columns without a unit are left out.

    Raises
    ------
    ValueError
        If lengths, names or units do not fit, if time does not increase, or if a value
        is not finite; the message names the column and the row, counted from 0.

    Examples
    --------
    >>> record = Record(time=[0.0, 0.5, 1.0], y=[20.0, 21.0, 21.5], u=[0.0, 1.0, 1.0])
    >>> record.y.shape, record.dt, record.names["u"]
    ((3, 1), 0.5, ('u1',))
    """

    time: Array
    y: Array
    u: Array = field(default_factory=_empty)
    v: Array = field(default_factory=_empty)
    r: Array = field(default_factory=_empty)
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        time = _frozen(self.time)
        if time.ndim != 1 or time.size == 0:
            raise ValueError(f"time has shape {time.shape}; expected (N,) with N >= 1")
        object.__setattr__(self, "time", time)
        for group in GROUPS:
            signal = _as_signal(getattr(self, group), group, time.size)
            object.__setattr__(self, group, signal)
        object.__setattr__(self, "names", self._complete_names())
        object.__setattr__(self, "units", dict(self.units))
        self._check()

    def _complete_names(self) -> dict[str, tuple[str, ...]]:
        """Fill in default names for the groups that were not named."""
        unknown = set(self.names) - set(GROUPS)
        if unknown:
            raise ValueError(f"names has groups {sorted(unknown)}; use {GROUPS}")
        counts = {group: getattr(self, group).shape[1] for group in GROUPS}
        return {
            group: tuple(self.names.get(group) or _numbered(group, counts[group]))
            for group in GROUPS
        }

    def _check(self) -> None:
        """Check what the shapes alone do not say."""
        n_y = self.y.shape[1]
        if n_y == 0:
            raise ValueError("y has no column; expected at least one output")
        if self.r.shape[1] not in (0, n_y):
            raise ValueError(f"r has {self.r.shape[1]} columns; expected {n_y} or none")
        for group, names in self.names.items():
            count = getattr(self, group).shape[1]
            if len(names) != count:
                raise ValueError(
                    f"names[{group!r}] has {len(names)} names, not {count}"
                )
        columns = ("time", *self.columns)
        if len(set(columns)) != len(columns):
            raise ValueError(f"column names must differ: {columns}")
        unknown = set(self.units) - set(columns)
        if unknown:
            raise ValueError(f"units names unknown columns {sorted(unknown)}")
        _check_finite(columns, np.column_stack([self.time, self.values]))
        steps = np.diff(self.time)
        if np.any(steps <= 0):
            row = int(np.argmax(steps <= 0)) + 1
            raise ValueError(
                f"time does not increase at row {row} ({self.time[row]:g})"
            )

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of all columns but time, in the order y, u, v, r."""
        return tuple(name for group in GROUPS for name in self.names[group])

    @property
    def values(self) -> Array:
        """All columns but time, side by side in the order of `columns`."""
        return np.column_stack([self.y, self.u, self.v, self.r])

    @property
    def dt(self) -> float:
        """Sampling interval.

        Raises
        ------
        ValueError
            With fewer than two samples, or if the sampling is irregular: the message
            gives the largest deviation and where it is.
        """
        if self.time.size < 2:
            raise ValueError("one sample has no sampling interval")
        steps = np.diff(self.time)
        usual = float(np.median(steps))
        deviation = np.abs(steps - usual)
        worst = int(np.argmax(deviation))
        if deviation[worst] > IRREGULAR * usual:
            raise ValueError(
                f"irregular sampling: the interval is {usual:g} but {steps[worst]:g} "
                f"between rows {worst} and {worst + 1} (time {self.time[worst]:g}), "
                f"a deviation of {deviation[worst]:g}"
            )
        return float(self.time[-1] - self.time[0]) / (self.time.size - 1)

    def detrend(self, kind: Trend) -> Record:
        """Subtract from every column its mean, straight line or first value.

        Parameters
        ----------
        kind : {"constant", "linear", "first"}
            What is taken away: the mean, the least-squares line, or the value at the
            first sample.  A reference loses the trend of its output, so that control
            errors stay what they were.

        Returns
        -------
        Record
            With the same times, names and units.

        Examples
        --------
        >>> record = Record(time=[0.0, 1.0, 2.0], y=[5.0, 6.0, 7.0], r=[8.0, 8.0, 8.0])
        >>> record.detrend("first").r.ravel()
        array([3., 3., 3.])
        """
        if kind not in _TRENDS:
            raise ValueError(f"kind is {kind!r}; expected one of {tuple(_TRENDS)}")
        trend = _TRENDS[kind]
        y, u, v = (trend(self.time, signal) for signal in (self.y, self.u, self.v))
        r = self.r - y if self.r.size else self.r
        return replace(self, y=self.y - y, u=self.u - u, v=self.v - v, r=r)

    def select(self, start: float | None = None, stop: float | None = None) -> Record:
        """Keep the samples with start <= time < stop (None: no bound).

        Raises
        ------
        ValueError
            If no sample is left.
        """
        first = 0 if start is None else self._row_at(start)
        last = self.time.size if stop is None else self._row_at(stop)
        if last <= first:
            raise ValueError(
                f"no sample with {start} <= time < {stop}; "
                f"the record runs from {self.time[0]:g} to {self.time[-1]:g}"
            )
        return self._rows(first, last)

    def split(
        self, fraction: float | None = None, *, time: float | None = None
    ) -> tuple[Record, Record]:
        """Cut the record in two, e.g. for estimation and validation.

        Parameters
        ----------
        fraction : float between 0 and 1, optional
            Share of the samples that goes to the first part.
        time : float, optional
            Time at which the second part starts.  Give one of the two.

        Raises
        ------
        ValueError
            If both or neither are given, or if one of the parts would be empty.
        """
        if (fraction is None) == (time is None):
            raise ValueError("give either fraction or time")
        size = self.time.size
        row = round(fraction * size) if fraction is not None else 0
        row = self._row_at(time) if time is not None else row
        if not 0 < row < size:
            cut = f"fraction {fraction:g}" if time is None else f"time {time:g}"
            raise ValueError(f"{cut} leaves one part of {size} samples empty")
        return self._rows(0, row), self._rows(row, size)

    def _row_at(self, time: float) -> int:
        """First row at or after a time, forgiving the rounding of time stamps."""
        steps = np.diff(self.time)
        slack = ROUNDING * float(np.min(steps)) if steps.size else 0.0
        return int(np.searchsorted(self.time, time - slack))

    def _rows(self, start: int, stop: int) -> Record:
        parts = {name: getattr(self, name)[start:stop] for name in ("time", *GROUPS)}
        return replace(self, **parts)

    @classmethod
    def from_csv(
        cls,
        file: File,
        *,
        y: Sequence[str],
        u: Sequence[str] = (),
        v: Sequence[str] = (),
        r: Sequence[str] = (),
        time: str | None = None,
        dt: float | None = None,
    ) -> Record:
        """Read columns by name from a comma-separated file with one header row.

        A unit in square brackets after a name, "T1 [degC]", is read as the unit of
        column "T1".  Other columns of the file are ignored.

        Parameters
        ----------
        file : path or open text file
            Text in UTF-8.
        y, u, v, r : sequences of column names
            Which columns are outputs, inputs, measured disturbances and references.
        time : str, optional
            Name of the column of time stamps.
        dt : float, optional
            Sampling interval if the file has no time column.  Give one of the two.

        Returns
        -------
        Record
            Its names are those of the columns.

        Raises
        ------
        ValueError
            If a column is missing or named twice, or if a cell is not a finite number:
            the message gives the row of the file (the header is row 1) and the column.
        """
        _check_choice(y, time, dt)
        groups = {"y": y, "u": u, "v": v, "r": r}
        wanted = [name for group in groups.values() for name in group]
        wanted += [time] if time is not None else []
        with _opened(file, "r") as stream:
            table, units = _read_columns(stream, wanted)
        if time is not None and time in units:
            units["time"] = units.pop(time)
        size = next(iter(table.values())).size
        stamps = np.arange(float(size))
        stamps = stamps * dt if dt is not None else table[str(time)]
        signals = {
            group: np.array([table[name] for name in names]).T
            for group, names in groups.items()
        }
        names = {group: tuple(columns) for group, columns in groups.items()}
        return cls(time=stamps, names=names, units=units, **signals)

    def to_csv(self, file: File) -> None:
        """Write time and all columns, units in the header, numbers without loss."""
        header = [
            f"{name} [{self.units[name]}]" if name in self.units else name
            for name in ("time", *self.columns)
        ]
        with _opened(file, "w") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(header)
            writer.writerows(np.column_stack([self.time, self.values]).tolist())


def _numbered(letter: str, count: int) -> tuple[str, ...]:
    return tuple(f"{letter}{i + 1}" for i in range(count))


def _frozen(values: object) -> Array:
    """Copy to a read-only array of floats."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def _as_signal(values: object, group: str, size: int) -> Array:
    """Bring one group to shape (N, n); an empty one becomes (N, 0)."""
    array = np.array(values, dtype=np.float64)
    if array.size == 0:
        return _frozen(np.empty((size, 0)))
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[0] != size:
        raise ValueError(f"{group} has shape {array.shape}; expected ({size}, n)")
    return _frozen(array)


def _check_finite(columns: Sequence[str], values: Array) -> None:
    bad = np.argwhere(~np.isfinite(values))
    if bad.size:
        row, column = bad[0]
        raise ValueError(
            f"column {columns[column]!r}, row {row} is {values[row, column]}; "
            f"expected a finite number ({len(bad)} such values)"
        )


def _line(time: Array, signal: Array) -> Array:
    regressors = np.column_stack([np.ones_like(time), time - time.mean()])
    coefficients: Array = np.linalg.lstsq(regressors, signal, rcond=None)[0]
    return regressors @ coefficients


_TRENDS: dict[str, Callable[[Array, Array], Array]] = {
    "constant": lambda _, signal: signal.mean(axis=0, keepdims=True),
    "linear": _line,
    "first": lambda _, signal: signal[:1],
}


def _check_choice(y: Sequence[str], time: str | None, dt: float | None) -> None:
    """Check what `Record.from_csv` is asked to read."""
    if (time is None) == (dt is None):
        raise ValueError("give either time (a column name) or dt (an interval)")
    if not y or isinstance(y, str):
        raise ValueError(f"y is {y!r}; expected a list of column names")
    if dt is not None and not (np.isfinite(dt) and dt > 0):
        raise ValueError(f"dt is {dt}; expected a positive number")


@contextmanager
def _opened(file: File, mode: Literal["r", "w"]) -> Iterator[TextIO]:
    """Open a path, or hand through a file that the caller opened and will close."""
    if not isinstance(file, str | PathLike):
        yield file
        return
    encoding = "utf-8-sig" if mode == "r" else "utf-8"
    with open(file, mode, encoding=encoding, newline="") as stream:
        yield stream


def _read_columns(
    stream: TextIO, wanted: Sequence[str]
) -> tuple[dict[str, Array], dict[str, str]]:
    """Read the wanted columns and their units."""
    rows = csv.reader(stream)
    heads = [_name_and_unit(cell) for cell in next(rows, [])]
    names = [name for name, _ in heads]
    for name in wanted:
        if names.count(name) != 1:
            found = "missing" if name not in names else "there more than once"
            raise ValueError(f"column {name!r} is {found}; the file has {names}")
    places = {name: names.index(name) for name in wanted}
    lines = [
        [_number(row, place, rows.line_num, name) for name, place in places.items()]
        for row in rows
        if row
    ]
    if not lines:
        raise ValueError("the file has no data below its header")
    units = {name: unit for name, unit in heads if unit and name in places}
    return dict(zip(places, np.array(lines).T, strict=True)), units


def _name_and_unit(cell: str) -> tuple[str, str]:
    match = re.fullmatch(r"\s*(.*?)\s*\[(.*)\]\s*", cell)
    return (match[1], match[2].strip()) if match else (cell.strip(), "")


def _number(row: Sequence[str], place: int, line: int, name: str) -> float:
    """Convert one cell; errors count rows as a reader of the file does."""
    cell = row[place].strip() if place < len(row) else ""
    try:
        value = float(cell)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ValueError(
            f"row {line}, column {name!r}: {cell!r} is not a finite number"
        )
    return value
