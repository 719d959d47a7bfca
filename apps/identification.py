"""Choices of the page Identify: a record, its spans, and which models to try."""

from __future__ import annotations

import csv
import functools
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import param

from apps.session import HELD, Holding, held, known_case, literal
from nmss_lab.identify import (
    Candidate,
    Estimate,
    Noise,
    Orders,
    Start,
    experiment,
    multilevel,
    order_search,
    prbs,
)
from nmss_lab.identify.structure import is_stable
from nmss_lab.models import Array, DifferenceModel
from nmss_lab.records import Record, shipped
from nmss_lab.tables import name_and_unit

RECORDS = {
    "gas_furnace": "Gas furnace, measured",
    "tclab_step_test": "TCLab step test, measured",
    "ifac93": "IFAC'93 plant, planned experiment",
    "shell": "Shell fractionator, planned experiment",
    "file": "Your own file",
}
PLANTS = {"ifac93": "ifac93_4_4_2", "shell": "shell_5_3_2"}
"""Case whose plant a planned experiment is made on."""

PRESETS: dict[str, dict[str, Any]] = {
    "gas_furnace": {
        "detrend": "constant",
        "start": "estimate",
        "method": "riv",
        "na_high": 2,
        "nk_high": 5,
    },
    "tclab_step_test": {"detrend": "output", "start": "rest", "nk_high": 6},
    "ifac93": {"na_high": 4, "nb_high": 4, "nk_high": 3},
    "shell": {"na_high": 2, "nb_high": 2, "nk_high": 10, "clock": 8},
    "file": {"detrend": "constant", "start": "estimate", "nk_high": 5},
}
"""What a record opens with, where it differs from the defaults."""

LOOK = {
    "gas_furnace": "Methane into a furnace, CO2 out of it: the noise is far from "
    "white, so look at the autocorrelation, then compare SRIV with RIV.",
    "tclab_step_test": "One step of a heater: two modes fit far better than one. "
    "Little moves in the settled last third, so read its R\u00b2 with care.",
    "ifac93": "A plant of order seven moved by a planned signal: how few parameters "
    "are enough, and what does noise do to the band of the step response?",
    "shell": "One input of the fractionator moves: see the delay show in the ranking, "
    "and how rows with a wrong one fail.",
    "file": "Your record: choose its columns and spans, then search.",
}

LARGEST = 5_000_000
"""Bytes of an uploaded file."""

BEYOND = 1e100
"""Numbers that large have no squares to be summed."""

FEWEST = 20
"""Samples of a record that is worth a fit."""

MOST_STRUCTURES = 500
SEED = 1
"""Of the planned experiments."""

NONE = "(none)"
WORDS = {
    "prbs": "random binary signal",
    "levels": "random levels",
    "none": "nothing",
    "first": "first values",
    "output": "first value of the output alone",
    "constant": "means",
    "linear": "straight lines",
    "rest": "at rest",
    "skip": "at rest, first samples not fitted",
    "estimate": "anything, fitted along",
    "sriv": "SRIV (white noise)",
    "riv": "RIV (noise model AR)",
    "refuse": "say where they are",
    "skip_bad": "leave out, read at regular times",
}


@dataclass(frozen=True)
class Upload:
    """A file of comma-separated numbers whose header has been read.

    Parameters
    ----------
    name, text : str
    heads : tuple of str
        Names of the columns.
    numeric : tuple of str
        Those whose first cell is a number.
    """

    name: str
    text: str
    heads: tuple[str, ...]
    numeric: tuple[str, ...]


def uploaded(name: str, data: bytes, size: int | None = None) -> Upload:
    """Read the header of a file and check that it is a table.

    Raises
    ------
    ValueError
        Saying what is wrong with the file, with row and column where there is one.
    """
    size = len(data) if size is None else size
    if size > LARGEST:
        raise ValueError(
            f"the file has {size / 1e6:.1f} MB; up to {LARGEST / 1e6:.0f} MB are read"
        )
    text = _text(data)
    lines = csv.reader(io.StringIO(text, newline=""))
    try:
        rows = list(lines)
    except csv.Error as error:
        raise ValueError(f"row {lines.line_num} is no row of cells: {error}") from error
    if not any(rows):
        raise ValueError("the file is empty: row 1 should name the columns")
    heads = _heads(rows[0])
    _check_rows(rows, len(heads))
    numeric = tuple(n for n, cell in zip(heads, rows[1], strict=True) if _is(cell))
    usable = [n for n in numeric if not _is_clock(n)]
    if len(usable) < 2:
        odd = next((n for n in heads if n not in numeric), heads[0])
        cell = rows[1][heads.index(odd)]
        raise ValueError(
            "no input and output found: fewer than two columns hold numbers; "
            f"row 2, column {odd!r} is {cell!r}"
        )
    return Upload(name, text, heads, numeric)


def _text(data: bytes) -> str:
    if not data.strip():
        raise ValueError("the file is empty: row 1 should name the columns")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data[: error.start].count(b"\n") + 1
        raise ValueError(
            f"row {row} holds bytes that are not text in UTF-8: is this a CSV "
            "file, saved as UTF-8?"
        ) from error
    if "\0" in text:
        row = text[: text.index("\0")].count("\n") + 1
        raise ValueError(f"row {row} holds bytes of a binary file: is this a CSV file?")
    return text


def _heads(row: Sequence[str]) -> tuple[str, ...]:
    first = ",".join(row)
    for sign, word in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
        if first.count(sign) > first.count(","):
            raise ValueError(
                f"row 1 is one column, {first[:60]!r}: columns seem to be separated "
                f"by {word}, expected commas"
            )
    heads = tuple(name_and_unit(cell)[0] for cell in row)
    for place, name in enumerate(heads, 1):
        if not name:
            raise ValueError(f"row 1, column {place} has no name")
        if heads.count(name) > 1:
            raise ValueError(f"row 1 names column {name!r} more than once")
    if all(_is(name) for name in heads):
        raise ValueError(
            f"row 1 holds numbers ({heads[0]!r}): expected the names of the columns"
        )
    return heads


def _check_rows(rows: Sequence[Sequence[str]], width: int) -> None:
    filled = [(number, row) for number, row in enumerate(rows, 1) if row]
    for number, row in filled:
        if len(row) != width:
            raise ValueError(
                f"row {number} has {len(row)} cells, the header in row 1 has {width}"
            )
    if len(filled) < 1 + FEWEST:
        count = len(filled) - 1
        noun = "row" if count == 1 else "rows"
        raise ValueError(f"only {count} {noun} of data; expected at least {FEWEST}")


def _is(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return False


def _is_clock(name: str) -> bool:
    word = name.lower().rstrip("_s")
    return word in ("t", "time", "date", "datetime", "timestamp", "second", "")


@dataclass(frozen=True, eq=False)
class Spans:
    """What models are compared on: fitted and checked part, and how the first began."""

    fitted: Record
    checked: Record
    start: Start


@dataclass(frozen=True, eq=False)
class Given(Estimate):
    """A model that was not fitted to its record, and whose uncertainty is not known.

    It is simulated as fitted ones are: where they have the response to what went before
    fitted along, so has this one.
    """

    @cached_property
    def simulated(self) -> Array:
        """Output of the model for the recorded inputs, (N,)."""
        return self.explained(self.record, self.start)


def given(model: DifferenceModel, record: Record, start: Start) -> Given:
    """Give the model of a design, of one output, as an estimate on a record."""
    a = np.trim_zeros(model.a[:, 0, 0], "b")
    a = a if a.size else np.zeros(1)
    inputs = [*model.b[:, 0].T, *model.g[:, 0].T]
    moved = [np.flatnonzero(b) if b.any() else np.zeros(1, int) for b in inputs]
    terms = [b[at[0] : at[-1] + 1] for b, at in zip(inputs, moved, strict=True)]
    orders = Orders(
        len(a), tuple(map(len, terms)), tuple(int(at[0]) + 1 for at in moved)
    )
    unknown = np.full((orders.count, orders.count), np.nan)
    parameters = np.concatenate([a, *terms])
    return Given(orders, parameters, unknown, unknown, record, "given", 0, start=start)


class IdentifyChoices(Holding):
    """Which record, which spans of it, and which models to try."""

    beside = param.ListSelector(
        default=[],
        objects=list(HELD),
        label="Held designs drawn",
        doc="Whose models are simulated beside those of the ranking.",
    )
    record = param.Selector(
        default="gas_furnace",
        objects=list(RECORDS),
        label="Record",
        doc="A measured record, an experiment on a plant, or the file you uploaded.",
    )
    output = param.Selector(
        objects=[""],
        label="Output y",
        doc="The output that models are fitted to, one at a time.",
    )
    signal = param.Selector(
        default="prbs",
        objects=["prbs", "levels"],
        label="Planned input",
        doc="Two levels or many, changing at random after whole clock periods.",
    )
    moved = param.Selector(
        default="u1",
        objects=["u1", "u2", "u3"],
        label="Input that moves",
        doc="The other inputs rest and are not part of the record.",
    )
    samples = param.Integer(
        400,
        bounds=(60, 2000),
        step=20,
        label="Samples",
        doc="Length of the experiment.",
    )
    clock = param.Integer(
        10,
        bounds=(1, 50),
        label="Clock period, samples",
        doc="How long the input rests at least between changes.",
    )
    noise = param.Number(
        0.05,
        bounds=(0.0, 0.5),
        step=0.01,
        label="Noise",
        doc="White noise on y, as a share of the standard deviation of y.",
    )
    time = param.Selector(
        objects=[NONE],
        label="Column of time",
        doc="Seconds or ISO dates; without one give the sampling interval.",
    )
    dt = param.Number(
        1.0,
        bounds=(1e-6, 1e6),
        label="Sampling interval, seconds",
        doc="Used if the file has no column of time.",
    )
    inputs = param.ListSelector(
        default=[],
        objects=[],
        label="Inputs u",
        doc="What was moved: one to three columns.",
    )
    disturbances = param.ListSelector(
        default=[],
        objects=[],
        label="Measured disturbances v",
        doc="What else acted on the output and was measured.",
    )
    bad = param.Selector(
        default="refuse",
        objects=["refuse", "skip_bad"],
        label="Bad rows and gaps",
        doc="Cells that are no numbers, and intervals unlike the others.",
    )
    est_from = param.Number(
        0.0,
        bounds=(0.0, 1.0),
        label="Estimation from",
        doc="First time that is fitted; drag the lower, blue box in the plot.",
    )
    est_to = param.Number(
        1.0,
        bounds=(0.0, 1.0),
        label="Estimation up to",
        doc="Samples before this time are fitted.",
    )
    val_from = param.Number(
        0.0,
        bounds=(0.0, 1.0),
        label="Validation from",
        doc="First time of the part for validation; the upper, orange box.",
    )
    val_to = param.Number(
        1.0,
        bounds=(0.0, 1.0),
        label="Validation up to",
        doc="Samples before this time are simulated but not fitted.",
    )
    detrend = param.Selector(
        default="none",
        objects=["none", "first", "output", "constant", "linear"],
        label="Take away first",
        doc="Subtracted from the whole record, so that signals are deviations.",
    )
    start = param.Selector(
        default="rest",
        objects=["rest", "skip", "estimate"],
        label="State before the record",
        doc="What is assumed of the time before the first fitted sample.",
    )
    na_low = param.Integer(
        1,
        bounds=(1, 6),
        label="Least na",
        doc="Smallest number of coefficients a_1 ... a_na.",
    )
    na_high = param.Integer(
        3,
        bounds=(1, 6),
        label="Most na",
        doc="Largest number of coefficients a_1 ... a_na.",
    )
    nb_low = param.Integer(
        1,
        bounds=(1, 6),
        label="Least nb",
        doc="Smallest number of coefficients of each input.",
    )
    nb_high = param.Integer(
        3,
        bounds=(1, 6),
        label="Most nb",
        doc="Largest number of coefficients of each input.",
    )
    nk_low = param.Integer(
        1,
        bounds=(1, 30),
        label="Shortest delay nk",
        doc="In samples; 1 is the delay of a held input.",
    )
    nk_high = param.Integer(
        3, bounds=(1, 30), label="Longest delay nk", doc="In samples, for each input."
    )
    method = param.Selector(
        default="sriv",
        objects=["sriv", "riv"],
        label="Method",
        doc="Refined instrumental variables, simplified or with a model of the noise.",
    )
    ar = param.Integer(
        2,
        bounds=(1, 6),
        label="Order of the noise model",
        doc="Coefficients c_1 ... of the autoregression C that whitens residuals.",
    )

    when: ClassVar[dict[str, tuple[str, str]]] = {
        "ar": ("method", "riv"),
        "dt": ("time", NONE),
    }
    groups: ClassVar[dict[str, tuple[str, ...]]] = {
        "Record": (
            "record",
            "time",
            "dt",
            "output",
            "inputs",
            "disturbances",
            "bad",
            "signal",
            "moved",
            "samples",
            "clock",
            "noise",
        ),
        "Spans": ("est_from", "est_to", "val_from", "val_to", "detrend", "start"),
        "Models to try": (
            "na_low",
            "na_high",
            "nb_low",
            "nb_high",
            "nk_low",
            "nk_high",
            "method",
            "ar",
        ),
    }
    fields: ClassVar[tuple[str, ...]] = (
        "dt",
        "est_from",
        "est_to",
        "val_from",
        "val_to",
    )
    spans: ClassVar[tuple[str, ...]] = fields[1:]
    of_file: ClassVar[tuple[str, ...]] = (
        "time",
        "dt",
        "inputs",
        "disturbances",
        "bad",
    )
    of_plan: ClassVar[tuple[str, ...]] = ("signal", "samples", "clock", "noise")

    def __init__(self) -> None:
        super().__init__()
        self.file: Upload | None = None
        self.take_record("gas_furnace")

    @classmethod
    def names(cls) -> list[str]:
        """Names of all choices; which held designs are drawn is chosen with models."""
        return [*super().names(), "beside"]

    def misfit(self, text: str) -> str:
        """Say why the model of a held design cannot be simulated on this record."""
        model, names = held(text).design.model, self.whole.names
        if not isinstance(model, DifferenceModel):
            return "its model is state-dependent, this page shows linear ones"
        for word, theirs, ours in (
            ("outputs", model.n_y, 1),
            ("inputs", model.n_u, len(names["u"])),
            ("measured disturbances", model.n_v, len(names["v"])),
        ):
            if theirs != ours:
                return f"its model has {theirs} {word}, this record has {ours}"
        if not np.isclose(model.dt, self.whole.dt):
            return f"it acts every {model.dt:g} s, not every {self.whole.dt:g} s"
        if not is_stable(np.concatenate([[1.0], model.a[:, 0, 0]])):
            return "its model is not stable, as one of a record must be"
        return ""

    def given(self, spans: Spans) -> dict[str, Given]:
        """Models of held designs on the span that others are fitted to."""
        return {
            key: given(design.model, spans.fitted, spans.start)
            for key, design in self.fitting().items()
        }

    def take_record(self, name: str) -> None:
        """Choose a record and put every other choice where the record has it."""
        if name not in RECORDS:
            raise ValueError(f"record = {name!r}: expected one of {tuple(RECORDS)}")
        if name == "file" and self.file is None:
            raise ValueError("no file has been uploaded on this page yet")
        kept = {"record", "output", *HELD, "beside", *self.spans, *self.of_file}
        for key in (key for key in self.names() if key not in kept):
            setattr(self, key, PRESETS[name].get(key, self.param[key].default))
        self.record = name
        if name == "file":
            self._guess(self.file)
        else:
            outputs = self._outputs()
            self.param["output"].objects = outputs
            self.output = outputs[0]
        self._load()

    def take_file(self, file: Upload) -> None:
        """Choose an uploaded file; columns are guessed from their names.

        Raises
        ------
        ValueError
            If no record can be made of it; all stays as it was.
        """
        before = self.file, self.record, self.values(), self._objects()
        try:
            self.file = file
            self.take_record("file")
        except ValueError:
            self.file, self.record, values, objects = before
            for key, options in objects.items():
                self.param[key].objects = options
            self.put(values)
            raise

    def _objects(self) -> dict[str, list[str]]:
        keys = ("time", "output", "inputs", "disturbances")
        return {key: list(self.param[key].objects) for key in keys}

    def _guess(self, file: Upload | None) -> None:
        """Choose columns by their names: time, then y or the last, then the rest."""
        assert file is not None
        numbers = [name for name in file.numeric if not _is_clock(name)]
        clocks = [name for name in file.heads if _is_clock(name)]
        named = [n for n in numbers if n.lower().startswith(("y", "out"))]
        output = (named or numbers[-1:])[0]
        moved = [
            n for n in numbers if n.lower().startswith(("u", "in")) and n != output
        ]
        others = [n for n in numbers if n != output and n not in named[1:]]
        self.inputs, self.disturbances = [], []
        self.param["time"].objects = [NONE, *file.heads]
        for key in ("output", "inputs", "disturbances"):
            self.param[key].objects = list(file.heads)
        self.time = clocks[0] if clocks else NONE
        self.output = output
        self.inputs = (moved or others or numbers[:1])[:1]

    def accept(self, values: dict[str, Any]) -> None:
        """Take over values that came from outside, all or none.

        Raises
        ------
        ValueError
            Saying what is wrong; nothing has changed then.
        """
        before = self.values()
        try:
            if values.get("record", self.record) != self.record:
                self.take_record(values["record"])
            old = self._of_record()
            late = {"record", *self.spans}
            self.put({key: v for key, v in values.items() if key not in late})
            spans = {key: values[key] for key in self.spans if key in values}
            if self._of_record() != old:
                self._load()
                spans = {k: v for k, v in spans.items() if v != before[k]}
            self.put(spans)
            self._check_spans()
        except ValueError:
            self._restore(before)
            raise

    def _restore(self, before: dict[str, Any]) -> None:
        if before["record"] != self.record:
            self.take_record(before["record"])
        self.put({k: v for k, v in before.items() if k not in self.spans})
        self._load()
        self.put(before)

    def _of_record(self) -> tuple[Any, ...]:
        """Choices that the record depends on."""
        keys = ("record", "output", "moved", *self.of_file, *self.of_plan)
        return tuple(repr(getattr(self, key)) for key in keys)

    def _check_spans(self) -> None:
        for word, first, last in (
            ("Estimation", self.est_from, self.est_to),
            ("Validation", self.val_from, self.val_to),
        ):
            try:
                self.whole.select(first, last)
            except ValueError as error:
                raise ValueError(
                    f"{word}: from {first:g} up to {last:g} holds no sample"
                ) from error

    def _load(self) -> None:
        """Read the record and put the spans in two thirds and the rest."""
        self.whole = self._record()
        t = self.whole.time
        end = float(t[-1]) + self.whole.dt
        cut = float(t[min(2 * len(t) // 3, len(t) - 1)])
        places = (float(t[0]), cut, cut, end)
        for key, place in zip(self.spans, places, strict=True):
            self.param[key].bounds = (float(t[0]), end)
            setattr(self, key, place)

    def _outputs(self) -> list[str]:
        if self.record in PLANTS:
            plant = known_case(PLANTS[self.record]).plant
            return [f"y{i + 1}" for i in range(plant.n_y)]
        return list(shipped(self.record).names["y"])

    def _record(self) -> Record:
        if self.record in PLANTS:
            return self._planned().output(self.output)
        if self.record == "file":
            return self._from_file()
        record = shipped(self.record).output(self.output)
        return record.resample(1.0) if record.gaps() else record

    def _planned(self) -> Record:
        plant = known_case(PLANTS[self.record]).plant
        signal = (
            prbs(self.samples, self.clock)
            if self.signal == "prbs"
            else multilevel(
                self.samples, self.clock, LEVELS, np.random.default_rng(SEED)
            )
        )
        moved = self._moved
        return experiment(plant, signal, self.noise, np.random.default_rng(SEED), moved)

    @property
    def _moved(self) -> int:
        return int(self.moved[1:]) - 1 if self.record == "shell" else 0

    def _from_file(self) -> Record:
        assert self.file is not None
        self._check_columns()
        record = Record.from_csv(
            io.StringIO(self.file.text, newline=""), **self._columns()
        )
        gaps = record.gaps()
        if gaps and self.bad == "refuse":
            gap = gaps[0]
            raise ValueError(
                f"rows {gap.row + 2} and {gap.row + 3}, column {self.time!r}: an "
                f"interval of {gap.length:g} instead of {gap.usual:g} "
                f"({len(gaps)} such places); choose to read at regular times instead"
            )
        if gaps:
            record = record.resample(gaps[0].usual)
        _check_moves(record, self.start)
        return record

    def _check_columns(self) -> None:
        chosen = [self.output, *self.inputs, *self.disturbances]
        chosen += [] if self.time == NONE else [self.time]
        for name in chosen:
            if chosen.count(name) > 1:
                raise ValueError(f"column {name!r} has been given two roles")
        if not self.inputs and not self.disturbances:
            raise ValueError("no input chosen: expected one to three columns")

    def _columns(self) -> dict[str, Any]:
        columns: dict[str, Any] = {"y": [self.output], "u": list(self.inputs)}
        if self.disturbances:
            columns["v"] = list(self.disturbances)
        columns |= {"dt": self.dt} if self.time == NONE else {"time": self.time}
        return columns | ({"bad": "skip"} if self.bad == "skip_bad" else {})

    # What a search works on. Every line here has its twin in ``script``.

    @property
    def treated(self) -> Record:
        """The record after its trend was taken away."""
        if self.detrend == "none":
            return self.whole
        if self.detrend == "output":
            return self.whole.detrend("first", ["y"])
        return self.whole.detrend(self.detrend)

    @property
    def fitted(self) -> Record:
        """Span for estimation."""
        return self.treated.select(self.est_from, self.est_to)

    @property
    def checked(self) -> Record:
        """Span for validation."""
        return self.treated.select(self.val_from, self.val_to)

    @property
    def compared_on(self) -> Spans:
        """Both spans, and what is assumed of the time before them."""
        return Spans(self.fitted, self.checked, self.start)

    def _ranges(self) -> list[tuple[int, int]]:
        """First and last na, nb and nk."""
        pairs = (
            (getattr(self, f"{n}_low"), getattr(self, f"{n}_high")) for n in ORDERS
        )
        return [(min(pair), max(pair)) for pair in pairs]

    @property
    def tries(self) -> int:
        """Number of structures to try."""
        na, nb, nk = (high - low + 1 for low, high in self._ranges())
        inputs = len(self.whole.names["u"]) + len(self.whole.names["v"])
        return int(na * (nb * nk) ** inputs)

    def search(self) -> Callable[..., list[Candidate]]:
        """Prepare to fit every structure chosen; later choices do not matter to it.

        Returns
        -------
        function of progress, as ``order_search`` takes it

        Raises
        ------
        ValueError
            If there are too many, or the span does not allow a fit.
        """
        if self.tries > MOST_STRUCTURES:
            raise ValueError(
                f"{self.tries} structures; up to {MOST_STRUCTURES} are tried at once: "
                "narrow na, nb or nk"
            )
        na, nb, nk = (range(low, high + 1) for low, high in self._ranges())
        noise = Noise(self.ar) if self.method == "riv" else None
        start: Start = self.start
        return functools.partial(
            order_search, self.fitted, na, nb, nk, noise, start=start
        )

    # Words and Python

    def defaults(self) -> dict[str, Any]:
        """All choices as they are when the record is chosen."""
        fresh = type(self)()
        if self.record == "file" and self.file is not None:
            fresh.take_file(self.file)
        else:
            fresh.take_record(self.record)
        return {**fresh.values(), "record": "gas_furnace"}

    def description(self) -> list[dict[str, Any]]:
        """Describe groups of controls, those of other kinds of records left out."""
        return [group for group in super().description() if group["items"]]

    def _shown(self, key: str) -> bool:
        if key in self.of_file:
            return self.record == "file"
        if key in self.of_plan:
            return self.record in PLANTS
        if key == "moved":
            return self.record == "shell"
        return key != "output" or len(self.param["output"].objects) > 1

    def _item(self, key: str) -> dict[str, Any]:
        item = super()._item(key)
        return {**item, "least": 0} if key == "disturbances" else item

    def _options(self, key: str) -> list[list[str]]:
        options = super()._options(key)
        if key == "record" and self.file is None:
            return [pair for pair in options if pair[0] != "file"]
        return options

    def _word(self, key: str, name: str) -> str:
        if key in ("output", "inputs", "disturbances", "time", "moved"):
            return name
        return RECORDS.get(name) or WORDS.get(name, name)

    def script(self, orders: str = "", shown: Mapping[str, Given] = {}) -> str:
        """Python that makes the same search and writes the chosen model.

        Held models that are shown are checked in it, too.
        """
        na, nb, nk = (f"range({low}, {high + 1})" for low, high in self._ranges())
        more = f"Noise({self.ar}), " if self.method == "riv" else ""
        pick = (
            f'next(c.estimate for c in found if str(c.orders) == "{orders}")'
            if orders
            else "found[0].estimate"
        )
        detrend = {
            "none": "",
            "output": 'record = record.detrend("first", ["y"])\n',
        }.get(self.detrend, f'record = record.detrend("{self.detrend}")\n')
        return (
            f"{self._record_lines(bool(shown))}{detrend}"
            f"fitted = record.select({self.est_from!r}, {self.est_to!r})\n"
            f"checked = record.select({self.val_from!r}, {self.val_to!r})\n\n"
            f"found = order_search(\n    fitted, {na}, {nb}, {nk}, {more}"
            f'start="{self.start}"\n)\n'
            "print(table(found))\n\n"
            f"best = {pick}\n"
            'print(best.derived(), best.validate(checked, "estimate"))\n'
            'save("model.json", best)\n'
            f"{self._held_lines(shown)}"
        )

    def _held_lines(self, shown: Mapping[str, Given]) -> str:
        """Lines that check held models: other numbers in place of the estimate's."""
        return "".join(
            f"\n# {key}: {held(getattr(self, key)).words}\n"
            f"model = replace(\n    best,\n    orders={found.orders!r},\n"
            f"    parameters={literal(found.parameters)},\n)\n"
            f'print(model.validate(checked, "estimate"))\n'
            for key, found in shown.items()
        )

    def _record_lines(self, compared: bool) -> str:
        """Lines that make the record, and imports of whatever comes later."""
        names = ["order_search", "table"] + ["Noise"] * (self.method == "riv")
        names += ["Orders"] * compared
        first = "from dataclasses import replace\n\n" if compared else ""
        numbers = "import numpy as np\n\n"
        if self.record in PLANTS:
            signal = (
                f"prbs({self.samples}, {self.clock})"
                if self.signal == "prbs"
                else f"multilevel(\n    {self.samples}, {self.clock}, {LEVELS}, "
                f"np.random.default_rng({SEED})\n)"
            )
            names += ["experiment", "prbs" if self.signal == "prbs" else "multilevel"]
            return (
                f"{first}{numbers}from nmss_lab.cases import case\n{_imports(names)}\n"
                f'plant = case("{PLANTS[self.record]}").plant\n'
                f"u = {signal}\nrng = np.random.default_rng({SEED})\n"
                f"record = experiment(plant, u, {self.noise!r}, rng, {self._moved})\n"
                f'record = record.output("{self.output}")\n'
            )
        if self.record == "file":
            assert self.file is not None
            columns = ", ".join(f"{k}={v!r}" for k, v in self._columns().items())
            read = f"Record.from_csv({self.file.name!r}, {columns})"
            what = "Record"
        else:
            read, what = f'shipped("{self.record}").output("{self.output}")', "shipped"
        again = f"record = record.resample({self.whole.dt!r})\n"
        regular = self.bad == "skip_bad" or self.record == "tclab_step_test"
        return (
            f"{first}{numbers if compared else ''}{_imports(names)}"
            f"from nmss_lab.records import {what}\n\n"
            f"record = {read}\n{again if regular else ''}"
        )


LEVELS = (-1.0, -0.5, 0.0, 0.5, 1.0)
ORDERS = ("na", "nb", "nk")


def _imports(names: Sequence[str]) -> str:
    listed = ", ".join(sorted(names, key=str.lower))
    return f"from nmss_lab.files import save\nfrom nmss_lab.identify import {listed}\n"


def _check_moves(record: Record, start: str) -> None:
    """Refuse columns that nothing can be learnt of: too large, or never moving."""
    last = len(record.time) + 1
    groups = (("y", record.y), ("u", record.u), ("v", record.v))
    for group, signals in groups:
        for name, values in zip(record.names[group], signals.T, strict=True):
            at = int(np.argmax(np.abs(values)))
            if abs(values[at]) > BEYOND:
                raise ValueError(
                    f"row {at + 2}, column {name!r}: {values[at]:g} is too large to "
                    f"compute with; expected less than {BEYOND:g}"
                )
            stepped = group != "y" and start == "rest" and values[0] != 0.0
            if np.ptp(values) == 0.0 and not stepped:
                hint = (
                    ""
                    if group == "y"
                    else ". If it stepped there at the first sample, choose "
                    "'at rest' as the state before the record first"
                )
                raise ValueError(
                    f"column {name!r} is constant: {values[0]:g} from row 2 to "
                    f"row {last}{hint}"
                )
