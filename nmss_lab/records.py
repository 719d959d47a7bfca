"""Sampled data: what was measured, when, and in which units.

A `Record` holds outputs y, inputs u, measured disturbances v and references r over
time, with the names and units of their columns.  It is what identification reads and
what a closed-loop run can be exported to.  Nothing here knows about models.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NotRequired, TypeAlias, TypedDict, Unpack

import numpy as np

from nmss_lab.tables import (
    Array,
    Bad,
    File,
    Table,
    opened,
    read_csv,
    read_file,
    read_frame,
)

Trend: TypeAlias = Literal["constant", "linear", "first"]
Method: TypeAlias = Literal["linear", "previous"]

GROUPS = ("y", "u", "v", "r")

# Time stamps rounded by a logger still count as regular below this share of dt.
IRREGULAR = 1e-3
# Start and stop of a selection may miss a time stamp by this share of the interval.
ROUNDING = 1e-6


def _empty() -> Array:
    return np.empty((0, 0))


class Columns(TypedDict):
    """What to read under which names; see `Record.from_csv`."""

    y: Sequence[str]
    u: NotRequired[Sequence[str]]
    v: NotRequired[Sequence[str]]
    r: NotRequired[Sequence[str]]
    time: NotRequired[str | None]
    dt: NotRequired[float | None]
    bad: NotRequired[Bad]


@dataclass(frozen=True)
class Gap:
    """An interval between two samples that is not the usual one.

    Parameters
    ----------
    row : int
        Sample before it, counted from 0.
    start, stop : float
        Times of the two samples.
    usual : float
        Usual interval.
    """

    row: int
    start: float
    stop: float
    usual: float

    @property
    def length(self) -> float:
        """Time between the two samples."""
        return self.stop - self.start

    @property
    def missing(self) -> int:
        """Samples that are missing in between."""
        return max(round(self.length / self.usual) - 1, 0)

    def __str__(self) -> str:
        """Say where it is and how long."""
        return (
            f"{self.length:g} instead of {self.usual:g} after row {self.row} "
            f"(time {self.start:g}), {self.missing} samples missing"
        )


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
    notes : tuple of str, optional
        What was done to the record on the way: rows left out, gaps bridged.

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
    notes: tuple[str, ...] = ()

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
                f"a deviation of {deviation[worst]:g}; `resample` makes it regular"
            )
        return float(self.time[-1] - self.time[0]) / (self.time.size - 1)

    def detrend(self, kind: Trend, groups: Sequence[str] = ("y", "u", "v")) -> Record:
        """Subtract from every column its mean, straight line or first value.

        Parameters
        ----------
        kind : {"constant", "linear", "first"}
            What is taken away: the mean, the least-squares line, or the value at the
            first sample.  A reference loses the trend of its output, so that control
            errors stay what they were.
        groups : sequence of "y", "u", "v"
            Which columns; inputs that already are deviations from rest, as of a step
            at the first sample, are to be left alone.

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
        if not set(groups) <= {"y", "u", "v"}:
            raise ValueError(f'groups = {groups}: expected some of "y", "u", "v"')
        if kind not in _TRENDS:
            raise ValueError(f"kind is {kind!r}; expected one of {tuple(_TRENDS)}")
        trend = _TRENDS[kind]
        parts = {
            group: getattr(self, group) - trend(self.time, getattr(self, group))
            for group in groups
        }
        if self.r.size and "y" in parts:
            parts["r"] = self.r - (self.y - parts["y"])
        return replace(self, **parts)

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

    def output(self, name: str) -> Record:
        """Keep one output and all inputs and disturbances, to fit a model of it.

        Raises
        ------
        ValueError
            If no output has that name.
        """
        if name not in self.names["y"]:
            raise ValueError(f"no output {name!r}; there are {self.names['y']}")
        at = self.names["y"].index(name)
        kept = {name, "time", *self.names["u"], *self.names["v"]}
        names = {"y": (name,), "u": self.names["u"], "v": self.names["v"]}
        units = {k: unit for k, unit in self.units.items() if k in kept}
        return replace(
            self, y=self.y[:, at], r=np.empty((0, 0)), names=names, units=units
        )

    def gaps(self) -> tuple[Gap, ...]:
        """Where the sampling departs from its usual interval; empty if it is regular.

        The usual interval is the median.
        """
        steps = np.diff(self.time)
        usual = float(np.median(steps)) if steps.size else 0.0
        odd = np.flatnonzero(np.abs(steps - usual) > IRREGULAR * usual)
        return tuple(
            Gap(int(i), float(self.time[i]), float(self.time[i + 1]), usual)
            for i in odd
        )

    def resample(self, dt: float, method: Method = "linear") -> Record:
        """Read all signals at regular times from the first to the last sample.

        Nothing is smoothed: take out what is faster than half the new rate before.

        Parameters
        ----------
        dt : float
            New interval, in the unit of time.
        method : {"linear", "previous"}
            Outputs and disturbances between two samples: on a line, or held.  Inputs
            and references are held, as an actuator holds them.

        Returns
        -------
        Record
            Says in ``notes`` what was bridged.

        Raises
        ------
        ValueError
            If dt is not positive or longer than the record.
        """
        span = float(self.time[-1] - self.time[0])
        if not 0 < dt <= span:
            raise ValueError(f"dt = {dt}: expected more than 0 and at most {span:g}")
        if method not in ("linear", "previous"):
            raise ValueError(f'method = {method!r}: expected "linear" or "previous"')
        time = self.time[0] + dt * np.arange(int(span / dt * (1 + ROUNDING)) + 1)
        held = np.searchsorted(self.time, time + ROUNDING * dt, side="right") - 1
        parts = {group: getattr(self, group)[held] for group in GROUPS}
        if method == "linear":
            for group in ("y", "v"):
                columns = getattr(self, group).T
                lines = [np.interp(time, self.time, column) for column in columns]
                parts[group] = np.array(lines).T
        gaps = self.gaps()
        longest = max((gap.length for gap in gaps), default=0.0)
        bridged = f", {len(gaps)} odd intervals, longest {longest:g}" if gaps else ""
        note = f"resampled every {dt:g} ({method}{bridged})"
        return replace(self, time=time, notes=(*self.notes, note), **parts)

    @classmethod
    def from_csv(cls, file: File, **columns: Unpack[Columns]) -> Record:
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
            Name of the column of time stamps: numbers, or ISO dates with their zone
            (without one they count as UTC), which become seconds since the first.
        dt : float, optional
            Sampling interval if the file has no time column.  Give one of the two.
        bad : {"refuse", "skip"}
            What to do with rows that lack a finite number or go back in time.  What
            was skipped stands in ``notes``; the gap it leaves is for ``resample``.

        Returns
        -------
        Record
            Its names are those of the columns.

        Raises
        ------
        ValueError
            If a column is missing or named twice, or for bad rows: the message gives
            the rows of the file (the header is row 1) and the column.
        """
        return cls._of(
            lambda wanted, time, bad: read_csv(file, wanted, time, bad), columns
        )

    @classmethod
    def from_frame(cls, frame: Any, **columns: Unpack[Columns]) -> Record:
        """Read columns by name from a pandas DataFrame.

        Arguments and errors are those of ``from_csv``; rows are counted from 0, and
        the index may serve as the time column if it has a name.
        """
        return cls._of(
            lambda wanted, time, bad: read_frame(frame, wanted, time, bad), columns
        )

    @classmethod
    def from_file(cls, path: str | PathLike[str], **columns: Unpack[Columns]) -> Record:
        """Read columns by name from a .csv, .mat, .xlsx or .parquet file.

        Arguments and errors are those of ``from_csv``.  In a .mat file a column is a
        vector, or one of M1, M2, ... of a matrix M.  Spreadsheets and Parquet need
        ``nmss-lab[excel]`` and ``nmss-lab[parquet]``.
        """
        return cls._of(
            lambda wanted, time, bad: read_file(Path(path), wanted, time, bad), columns
        )

    @classmethod
    def _of(
        cls,
        read: Callable[[Sequence[str], str | None, Bad], Table],
        columns: Columns,
    ) -> Record:
        """Make a record of what a reader finds under the names."""
        time, dt = columns.get("time"), columns.get("dt")
        groups: dict[str, Sequence[str]] = {
            "y": columns["y"],
            "u": columns.get("u", ()),
            "v": columns.get("v", ()),
            "r": columns.get("r", ()),
        }
        _check_choice(groups["y"], time, dt)
        wanted = [name for group in groups.values() for name in group]
        wanted += [time] if time is not None else []
        table = read(wanted, time, columns.get("bad", "refuse"))
        units = dict(table.units)
        if time is not None and time in units:
            units["time"] = units.pop(time)
        size = len(table.columns[wanted[0]])
        stamps = table.columns[time] if time is not None else np.arange(float(size))
        signals = {
            group: np.array([table.columns[name] for name in names]).T
            for group, names in groups.items()
        }
        return cls(
            time=stamps * dt if dt is not None else stamps,
            names={group: tuple(names) for group, names in groups.items()},
            units=units,
            notes=table.notes,
            **signals,
        )

    def to_csv(self, file: File) -> None:
        """Write time and all columns, units in the header, numbers without loss."""
        header = [
            f"{name} [{self.units[name]}]" if name in self.units else name
            for name in ("time", *self.columns)
        ]
        with opened(file, "w") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(header)
            writer.writerows(np.column_stack([self.time, self.values]).tolist())


def shipped(name: str) -> Record:
    """Read a record that comes with the package; ``nmss_lab/data`` says whence.

    Parameters
    ----------
    name : {"gas_furnace", "tclab_step_test"}

    Raises
    ------
    ValueError
        If there is no such record.

    Examples
    --------
    >>> shipped("gas_furnace").names["u"]
    ('u_gas_rate',)
    """
    if name not in SHIPPED:
        raise ValueError(f"name = {name!r}: expected one of {tuple(SHIPPED)}")
    columns, units = SHIPPED[name]
    record = Record.from_csv(Path(__file__).parent / "data" / f"{name}.csv", **columns)
    return replace(record, units={"time": "s", **units})


SHIPPED: dict[str, tuple[Columns, dict[str, str]]] = {
    "gas_furnace": (
        {"y": ["y_co2_percent"], "u": ["u_gas_rate"], "dt": 9.0},
        {"y_co2_percent": "%"},
    ),
    "tclab_step_test": (
        {"y": ["T1_C", "T2_C"], "u": ["Q1_percent"], "time": "time_s"},
        {"T1_C": "degC", "T2_C": "degC", "Q1_percent": "%"},
    ),
}
"""Columns and units of the records that come with the package."""


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
