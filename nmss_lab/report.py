"""A report of a design: one HTML file that says, shows and reproduces all of it.

The file needs nothing else: figures are drawn in it as SVG (see ``nmss_lab.svg``), no
script runs, nothing is fetched, and the design file lies inside as a download.
"""

from __future__ import annotations

import base64
import dataclasses
import datetime
import inspect
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from html import escape
from importlib import metadata
from typing import TYPE_CHECKING, Any

import numpy as np

from nmss_lab.analysis import linear_loop, review
from nmss_lab.cases import Case
from nmss_lab.continuous import ContinuousPlant
from nmss_lab.controller import Controller, Limits
from nmss_lab.design import VARYING, Design
from nmss_lab.files import Study, case_of, dumps
from nmss_lab.governor import governor
from nmss_lab.measures import table
from nmss_lab.models import Array, DifferenceModel, LinearPlant
from nmss_lab.montecarlo import join, monte_carlo_parts
from nmss_lab.mpc import STRUCTURES
from nmss_lab.pip import pip
from nmss_lab.plots import (
    Chart,
    ensemble_charts,
    locus_chart,
    loop_charts,
    picked_charts,
    ranked,
)
from nmss_lab.sdp import sdp_governor, sdp_pip
from nmss_lab.sdp_mpc import SDP_STRUCTURES
from nmss_lab.simulate import Run, Scenario, closed_loop
from nmss_lab.state_dependent import StateDependentModel, StateDependentPlant
from nmss_lab.svg import svg
from nmss_lab.uncertainty import (
    EstimatedModels,
    Intervals,
    ParameterCovariance,
    RelativeRanges,
    Uncertainty,
)

if TYPE_CHECKING:
    from nmss_lab.montecarlo import MonteCarlo

FILE = "design.json"
"""Name of the design file within a report."""

MAKERS: Mapping[str, Callable[..., Controller]] = {
    **STRUCTURES,
    "pip": pip,
    "governor": governor,
    **SDP_STRUCTURES,
    "sdp_pip": sdp_pip,
    "sdp_governor": sdp_governor,
}
"""Functions of all structures."""

READINGS = {
    "held": "held: the present value is repeated along the horizon",
    "next": "next: the value of the next sample is repeated along the horizon",
    "preview": "preview: the true future is known",
    "zero": "zero: the reference acts through the sum of the error alone",
}

MEASURES = {
    "rise": "Rise from 10 to 90 % [s]",
    "settling": "Settling to 5 % [s]",
    "overshoot": "Overshoot [%]",
    "IAE": "Integral of the absolute error (IAE)",
    "ISE": "Integral of the squared error (ISE)",
    "coupling": "Absolute error while only other references change",
    "RMS du": "Change of the inputs, root mean square",
    "violations": "Samples at which a limit is broken",
}
"""Columns of ``nmss_lab.measures.table`` in words."""

SERIES = {
    "reference": ("Reference", "y"),
    "v": ("Measured disturbance", "v"),
    "input_disturbance": ("Disturbance at the input, not measured", "u"),
    "output_disturbance": ("Disturbance at the output, not measured", "y"),
    "noise": ("Noise of the measurement", "y"),
    "manual": ("Input set by hand", "u"),
}
"""Series of a scenario in words, and whose channels they have."""

STARTS = {
    "y0": "Constant past output",
    "u0": "Constant past input",
    "v0": "Constant past disturbance",
    "z0": "Sum of the error before the first sample",
}

SEVERITIES = {"radius": "largest pole", "excess": "excess over a limit"}
"""Columns that say how badly something happens, in words."""

SOLVERS = {"proxqp": "proxsuite"}
"""Packages of solvers that go by another name."""

NEAR_ORIGIN = 0.05
"""Poles of histories lie at the origin, which rounding spreads by up to 0.02."""

WORST = "IAE"
"""Measure by which the worst realisation of an output is chosen."""


def report(
    study: Study | Design,
    *,
    runs: Mapping[str, Run] | None = None,
    uncertainty: Uncertainty | None = None,
    realisations: int | None = None,
    seed: int = 0,
    title: str = "",
    date: datetime.date | None = None,
    executor: Executor | None = None,
    callback: Callable[[int, int], object] | None = None,
) -> str:
    """Write a report of a design as one HTML file.

    Parameters
    ----------
    study : Study or Design
        Run anew for the report; what it does not state is that of ``case_of``.
    runs : mapping of str to Run, optional
        Up to two more runs over the same samples, by name, shown beside it.
    uncertainty : Uncertainty, optional
        With it, the design is run on many plants, see ``monte_carlo``.
    realisations : int, optional
        How many; 1,000 by default, or all there are.
    seed : int
        Of these.
    title : str
        Heading; the structure's name by default.
    date : date, optional
        Day, or day and time, that the report bears; today by default.
    executor : concurrent.futures.Executor, optional
        Where the realisations run.
    callback : callable, optional
        Told after each part how many realisations are done, and of how many; a true
        answer ends the study there.

    Returns
    -------
    str
        Text of the file.  The same arguments and versions give the same text.

    Raises
    ------
    ValueError
        If the design cannot be built or run, runs have other names or lengths than
        expected, the uncertainty does not fit the design, or a part of the study is
        no data, such as a function, so that no file can hold it.
    """
    study = Study(study) if isinstance(study, Design) else study
    if not isinstance(study, Study):
        raise ValueError(
            f"study is a {type(study).__name__}, expected a Study or a Design"
        )
    subject = _Subject.of(study, runs or {})
    drawn = None
    if uncertainty is not None:
        drawn = _drawn(subject, uncertainty, realisations, seed, executor, callback)
    day = (date or datetime.date.today()).isoformat()
    title = title or f"Report of a design: {subject.name}"
    figures = _Figures()
    sections = {
        "Design": _design(subject),
        "Scenario": _scenario(subject),
        "Review": _review(subject),
        "Measures": _measures(subject),
        "Figures": figures.all(_charts(subject)),
        "Poles": _poles(subject, figures),
        "Robustness": _robustness(subject, uncertainty, drawn, figures),
        "Versions": _versions(subject, day, None if drawn is None else seed),
        "Reproduce": _reproduce(subject, uncertainty, drawn),
    }
    return _page(title, subject, day, sections)


@dataclass(frozen=True, eq=False)
class _Subject:
    """What a report is about: a study, run, and the text of its file."""

    study: Study
    file: str
    example: Case
    controller: Controller
    runs: Mapping[str, Run]

    @classmethod
    def of(cls, study: Study, others: Mapping[str, Run]) -> _Subject:
        example = case_of(study)
        design = study.design
        if design.structure in others:
            raise ValueError(
                f'runs: "{design.structure}" is the name of the run of the study itself'
            )
        plant = design.model if study.plant is None else study.plant
        complete = Study(design, plant, example.scenario)
        file = dumps(complete)  # before the work: what is no data is refused
        controller = design.build()
        run = closed_loop(example.plant, controller, example.scenario)
        complete = dataclasses.replace(complete, run=study.run)
        runs = {design.structure: run, **others}
        return cls(complete, file, example, controller, runs)

    @property
    def name(self) -> str:
        return self.study.design.structure

    @property
    def run(self) -> Run:
        return self.runs[self.name]

    @property
    def design(self) -> Design:
        return self.study.design

    @property
    def model(self) -> DifferenceModel:
        """Names, units and sizes of the signals."""
        return self.controller.model

    @property
    def linear(self) -> LinearPlant | None:
        """The plant, if the loop without limits is linear."""
        plant = self.example.plant
        fits = isinstance(plant, LinearPlant) and self.name not in VARYING
        return plant if fits and isinstance(plant, LinearPlant) else None

    def signal(self, name: str) -> str:
        """Name of a signal with its unit."""
        unit = self.model.units.get(name)
        return f"{name} [{unit}]" if unit else name


# --- HTML --------------------------------------------------------------------------


def _paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>"


def _list(sentences: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape(each)}</li>' for each in sentences)}</ul>"


def _table(caption: str, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Table of texts and numbers; the first cell of a row is its heading."""
    columns = "".join(f'<th scope="col">{escape(name)}</th>' for name in head)
    lines = []
    for first, *cells in rows:
        inside = "".join(_cell(cell) for cell in cells)
        lines.append(f'<tr><th scope="row">{escape(str(first))}</th>{inside}</tr>')
    label = escape(caption)
    return (
        f'<div class="table" role="region" tabindex="0" aria-label="{label}"><table>'
        f"<caption>{label}</caption><thead><tr>{columns}</tr></thead>"
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def _cell(value: Any) -> str:
    if isinstance(value, str):
        return f"<td>{escape(value)}</td>"
    return f'<td class="number">{_number(value)}</td>'


def _number(value: float) -> str:
    """Text of a number, as the command line prints it; a dash where there is none."""
    return "\u2013" if np.isnan(value) else f"{value + 0.0:.5g}"  # no minus zero


def _matrix(value: Any) -> str:
    """Text of a number, a row or a small matrix; of a large one, what it is like."""
    array = np.asarray(value, dtype=float)
    if array.ndim > 2 or array.size > 144:
        size = " x ".join(map(str, array.shape))
        ends = f"{_number(array.min())} to {_number(array.max())}"
        return f"{size} numbers from {ends}, all of them in {FILE}"
    rows = [", ".join(map(_number, row)) for row in np.atleast_2d(array)]
    return "; ".join(rows)


class _Figures:
    """Figures of a report, numbered."""

    def __init__(self) -> None:
        self.count = 0

    def one(self, chart: Chart) -> str:
        self.count += 1
        return f"<figure>{svg(chart, f'figure-{self.count}')}</figure>"

    def all(self, charts: Iterable[Chart]) -> str:
        return f'<div class="figures">{"".join(map(self.one, charts))}</div>'


# --- Design ------------------------------------------------------------------------


def _design(subject: _Subject) -> str:
    design = subject.design
    doc = inspect.getdoc(MAKERS[design.structure]) or ""
    rows = [("Structure", f"{design.structure}: {doc.partition(chr(10))[0]}")]
    rows += _choices(design)
    rows += [(name, _option(value)) for name, value in design.options.items()]
    return "".join(
        [
            _table("Choices", ("Choice", "Value"), rows),
            _limits(subject, design.limits),
            _model("Model of the design", design.model),
            _plant(subject),
        ]
    )


def _choices(design: Design) -> Iterator[tuple[str, str]]:
    """Horizons, weights and reading, as far as the structure uses them."""
    horizon, structure = design.horizon, design.structure
    if structure in ("governor", "sdp_governor"):
        yield "Prediction horizon Np", f"{horizon.Np} samples"
    elif structure not in ("pip", "sdp_pip"):
        yield "Prediction horizon Np", f"{horizon.Np} samples"
        yield "Control horizon Nc", f"{horizon.Nc} moves"
        if horizon.blocks:
            yield "Moves held for", f"{', '.join(map(str, horizon.blocks))} samples"
    placed = structure in ("sdp_pip", "sdp_governor") and "poles" in design.options
    if structure not in ("pip", "governor") and not placed:
        yield "Weight Q", _matrix(design.Q)
        yield "Weight R", _matrix(design.R)
    if structure not in ("pip", "sdp_pip"):
        yield "Reading of the reference", READINGS[design.reference]


def _option(value: Any) -> str:
    """Text of an option: a word, numbers, or the fields of an object."""
    if dataclasses.is_dataclass(value):
        fields = dataclasses.fields(value)
        return ", ".join(f"{f.name} {_option(getattr(value, f.name))}" for f in fields)
    if value is None or isinstance(value, bool):
        return {None: "none", True: "yes", False: "no"}[value]
    if isinstance(value, str):
        return value
    if np.iscomplexobj(value):
        return ", ".join(map(_pole, np.ravel(value)))
    return _matrix(value)


def _limits(subject: _Subject, limits: Limits) -> str:
    model = subject.model
    words = {"u": "Input", "du": "Change of the input a sample", "y": "Output"}
    rows = []
    for key, word in words.items():
        names = model.y_names if key == "y" else model.u_names
        low, high = limits.of(key, len(names))  # type: ignore[arg-type]
        for name, *sides in zip(names, low, high, strict=True):
            if np.isfinite(sides).any():
                ends = [x if np.isfinite(x) else "none" for x in sides]
                rows.append((f"{word} {subject.signal(name)}", *ends))
    if not rows:
        return _paragraph("There are no limits.")
    means = {
        "hard": "Output limits are hard: dropped for the samples at which they cannot "
        "be kept.",
        "soft": f"Output limits are soft: a squared unit of violation costs "
        f"{limits.soft_weight:.5g}.",
        "priority": "Output limits give way by rank, the least important first; ranks "
        f"of the outputs: {', '.join(map(str, limits.priority)) or 'all equal'}.",
    }
    limited = np.isfinite(np.array(limits.of("y", model.n_y))).any()
    said = _paragraph(means[limits.outputs]) if limited else ""
    return _table("Limits", ("Signal", "from", "to"), rows) + said


def _model(caption: str, model: DifferenceModel | StateDependentModel) -> str:
    """Coefficients of a difference equation, one row for each pair of signals."""
    g = getattr(model, "g", np.zeros((0, model.n_y, 0)))
    groups = (
        ("a", np.array(model.a, dtype=object), model.y_names),
        ("b", np.array(model.b, dtype=object), model.u_names),
        ("g", np.array(g, dtype=object), getattr(model, "v_names", ())),
    )
    rows = []
    for i, output in enumerate(model.y_names):
        for letter, table_, names in groups:
            for j, name in enumerate(names):
                entries = [_coefficient(entry) for entry in table_[:, i, j]]
                if set(entries) != {"0"}:
                    rows.append((output, name, letter, ", ".join(entries)))
    head = "Equation of", "acts", "letter", "coefficients at lags 1, 2, ..."
    said = [
        "y[k] + a1 y[k-1] + ... = b1 u[k-1] + ..., so that the coefficients a stand on "
        f"the left-hand side; sampled every {model.dt:.10g} s.",
    ]
    constants = getattr(model, "constants", {})
    if constants:
        listed = [f"{name} = {value:.10g}" for name, value in constants.items()]
        said.append(f"Constants: {', '.join(listed)}.")
    return _table(caption, head, rows) + "".join(map(_paragraph, said))


def _coefficient(entry: Any) -> str:
    return entry if isinstance(entry, str) else f"{entry:.8g}"


def _plant(subject: _Subject) -> str:
    plant, design = subject.study.plant, subject.design
    assert plant is not None  # a complete study has one
    if plant is design.model:
        return _paragraph("The plant is the model itself.")
    if isinstance(plant, DifferenceModel | StateDependentModel):
        return _model("Plant", plant)
    if isinstance(plant, StateDependentPlant):
        load = np.atleast_1d(plant.load)
        said = "A constant is added to its right-hand side at each sample: "
        rest = _paragraph(f"{said}{_matrix(load)}.") if load.any() else ""
        if plant.model is design.model:
            return _paragraph("The plant obeys the model's equation.") + rest
        return _model("Plant", plant.model) + rest
    if isinstance(plant, ContinuousPlant):
        return _channels(subject, plant)
    between = "" if plant.between is None else f", {plant.substeps} outputs a sample"
    poles = ", ".join(map(_pole, plant.poles()[:12]))
    return _table(
        "Plant",
        ("Property", "Value"),
        [
            ("Kind", f"linear, sampled every {plant.dt:.10g} s{between}"),
            ("States", str(plant.n_x)),
            ("Poles, the largest first", poles + (", ..." if plant.n_x > 12 else "")),
            ("Matrices", f"in {FILE}, to the last digit"),
        ],
    )


def _channels(subject: _Subject, plant: ContinuousPlant) -> str:
    model, rows = subject.model, []
    for table_, names in (
        (plant.channels, model.u_names),
        (plant.disturbance_channels or (), model.v_names),
    ):
        for output, row in zip(model.y_names, table_, strict=False):
            for name, channel in zip(names, row, strict=False):
                if channel is not None:
                    num, den = _matrix(channel.num), _matrix(channel.den)
                    rows.append((f"{name} to {output}", num, den, channel.delay))
    head = "Channel", "numerator", "denominator", "dead time [s]"
    said = f"Powers of s descend; sampled exactly every {subject.design.model.dt:g} s."
    return _table("Plant in continuous time", head, rows) + _paragraph(said)


def _pole(p: complex) -> str:
    if abs(p.imag) < 1e-9:
        return f"{p.real:.5g}"
    return f"{p.real:.5g} {'+' if p.imag > 0 else '-'} {abs(p.imag):.5g}i"


# --- Scenario ----------------------------------------------------------------------


def _scenario(subject: _Subject) -> str:
    scenario, model, run = subject.example.scenario, subject.model, subject.run
    samples = len(scenario)
    rows = []
    for key, (word, letter) in SERIES.items():
        series = getattr(scenario, key)
        if series is None:
            continue
        names = getattr(model, f"{letter}_names")
        names = names if len(names) == series.shape[1] else map(str, range(1, 99))
        for name, x in zip(names, series.T, strict=False):
            if key == "reference" or x.any():
                rows.append((word, subject.signal(name), _in_words(run.t, x)))
    low, high = scenario.actuator
    if np.isfinite([np.min(high), np.max(low)]).any():
        ends = f"from {_matrix(low)} to {_matrix(high)}"
        rows.append(("Actuator, not known to the controller", "", ends))
    for key, word in STARTS.items():
        value = getattr(scenario, key)
        if value is not None:
            rows.append((word, "", _matrix(value)))
    said = [
        f"{samples} samples of {model.dt:.10g} s, {samples * model.dt:.10g} s in all.",
    ]
    if subject.example.notes:
        said.append(f"Not stated, and assumed: {' '.join(subject.example.notes)}")
    if scenario.seen:
        said.append("An internal model is driven by the disturbed input.")
    head = "What", "signal", "how"
    return "".join(map(_paragraph, said)) + _table("What happens", head, rows)


def _in_words(t: Array, x: Array) -> str:
    """Say how a series goes: its steps, or what it is like if it has many."""
    there = np.isfinite(x)
    if not there.all():  # by hand where finite
        count = int(there.sum())
        if not count:
            return "never"
        ends = f"{_number(x[there].min())} to {_number(x[there].max())}"
        return f"at {count} of {len(x)} samples, from {ends}"
    changes = np.flatnonzero(np.diff(x)) + 1
    if len(changes) > 8:
        ends = f"from {_number(x.min())} to {_number(x.max())}"
        spread = f"standard deviation {_number(x.std())}"
        return f"changes at {len(changes)} of {len(x)} samples, {ends}, {spread}"
    if not len(changes):
        return f"{_number(x[0])} throughout"
    parts = [f"{_number(x[k])} from {t[k]:.6g} s" for k in changes]
    return "; ".join([_number(x[0]), *parts])


# --- Review, measures, figures, poles ----------------------------------------------


def _review(subject: _Subject) -> str:
    if subject.linear is None:
        return _paragraph(
            "The coefficients depend on the state: the loop has no poles, and there is "
            "no review of it. The statuses under Measures say how its samples went."
        )
    found = review(subject.controller, subject.linear)
    bad = sum(finding.verdict == "bad" for finding in found.findings)
    said = {0: "Nothing bad was found.", 1: "One finding is bad."}
    words = {"good": "good", "note": "note", "bad": "BAD"}
    items = "".join(
        f'<li class="{f.verdict}"><b>{words[f.verdict]}</b><span>{escape(f.topic)}: '
        f"{escape(f.sentence)}</span></li>"
        for f in found.findings
    )
    first = _paragraph(said.get(bad, f"{bad} findings are bad."))
    return f'{first}<ul class="review">{items}</ul>'


def _measures(subject: _Subject) -> str:
    tables = []
    for channel, output in enumerate(subject.model.y_names):
        found = table(subject.runs, channel)
        keys = [key for key in found[0] if key != "run"]
        rows = [(MEASURES.get(k, k), *(row[k] for row in found)) for k in keys]
        head = "Measure", *(str(row["run"]) for row in found)
        tables.append(_table(f"Output {subject.signal(output)}", head, rows))
    told = [
        "Rise, settling and overshoot are those of the first change of the reference; "
        "a dash means that it does not happen. Integrals are in the output's unit "
        "times seconds.",
        *_stored(subject),
    ]
    moves = [
        f"<h3>How the moves of {escape(name)} came about</h3>{_list(run.sentences)}"
        for name, run in subject.runs.items()
    ]
    return "".join(
        [f'<div class="tables">{"".join(tables)}</div>', *map(_paragraph, told), *moves]
    )


def _stored(subject: _Subject) -> Iterator[str]:
    """Compare the run that a file holds with the one made now."""
    stored, run = subject.study.run, subject.run
    if stored is None:
        return
    if stored.y.shape != run.y.shape or stored.u.shape != run.u.shape:
        yield "The stored run has another length than the scenario; it is not shown."
        return
    apart = max(np.abs(stored.y - run.y).max(), np.abs(stored.u - run.u).max())
    if apart == 0.0:
        yield "The stored run was made again: outputs and inputs are equal to the bit."
    else:
        yield (
            "The stored run was made again and differs: outputs and inputs by up to "
            f"{apart:.3g}. All numbers here are those of the new run."
        )


def _charts(subject: _Subject) -> Iterator[Chart]:
    """Charts of every output, and of every input and its change."""
    model, runs = subject.model, subject.runs
    for output in range(model.n_y):
        yield loop_charts(runs, output)[0]
    for input in range(model.n_u):
        yield from loop_charts(runs, 0, input)[1:3]


def _poles(subject: _Subject, figures: _Figures) -> str:
    if subject.linear is None:
        return _paragraph("The coefficients depend on the state: there are no poles.")
    loop = linear_loop(subject.controller, subject.linear)
    there = loop.poles[np.abs(loop.poles) > NEAR_ORIGIN]
    rows = [(_pole(p), float(np.abs(p)), _decay(p, loop.dt)) for p in there]
    rest = len(loop.poles) - len(there)
    said = "Of the loop without active limits, on the plant."
    if rest:
        said += f" {rest} more lie at the origin or within {NEAR_ORIGIN} of it."
    nominal = {subject.name: loop.poles[None]}
    chart = locus_chart(nominal, {subject.name: there}, "no limit active")
    head = "Pole", "modulus", "time constant [s]"
    listed = _table("Closed-loop poles", head, rows)
    return f'{_paragraph(said)}<div class="figures">{figures.one(chart)}{listed}</div>'


def _decay(p: complex, dt: float) -> float:
    """Time constant of a mode, nan where it does not decay."""
    return -dt / float(np.log(np.abs(p))) if np.abs(p) < 1.0 else np.nan


# --- Robustness --------------------------------------------------------------------


def _drawn(
    subject: _Subject,
    uncertainty: Uncertainty,
    realisations: int | None,
    seed: int,
    executor: Executor | None,
    callback: Callable[[int, int], object] | None,
) -> MonteCarlo:
    parts: list[MonteCarlo] = []
    scenario: Scenario = subject.example.scenario
    for part in monte_carlo_parts(
        {subject.name: subject.design},
        uncertainty,
        scenario,
        realisations,
        seed,
        "signals",
        executor=executor,
    ):
        parts.append(part)
        if callback and callback(sum(map(len, parts)), part.asked):
            break
    return join(parts)


def _robustness(
    subject: _Subject,
    uncertainty: Uncertainty | None,
    drawn: MonteCarlo | None,
    figures: _Figures,
) -> str:
    if uncertainty is None or drawn is None:
        return _paragraph("No uncertainty of the plant was stated.")
    said = f"{len(drawn):,} of {drawn.asked:,} realisations, seed {drawn.seed}."
    if len(drawn) < drawn.asked:
        said += " The study was stopped before its end."
    return "".join(
        [
            _uncertain(uncertainty),
            _paragraph(said),
            _rates(drawn),
            _worst(subject, drawn),
            figures.all(_envelopes(subject, drawn)),
        ]
    )


def _uncertain(uncertainty: Uncertainty) -> str:
    """Say what is drawn, and how."""
    if isinstance(uncertainty, RelativeRanges):
        shares = [f"{100.0 * s:.5g} % in {n}" for n, s in uncertainty.share.items()]
        return _paragraph(
            "Coefficients of the model are uniform around their values, within "
            f"{' and '.join(shares)}."
        )
    if isinstance(uncertainty, ParameterCovariance):
        errors = np.sqrt(np.diag(uncertainty.covariance))
        return _paragraph(
            "Parameters of the model are normal with a covariance; standard errors of "
            f"a1, ..., b1, ...: {_matrix(errors)}."
        )
    if isinstance(uncertainty, Intervals):
        how = "All corners of" if uncertainty.corners else "Uniform draws from"
        rows = [(name, *sides) for name, sides in uncertainty.intervals.items()]
        return _table(f"{how} the intervals", ("Parameter", "from", "to"), rows)
    if isinstance(uncertainty, EstimatedModels):
        return _paragraph(
            "Parameters are normal around their estimates, with the covariance that "
            "identification left."
        )
    return _paragraph(f"Plants are drawn by a {type(uncertainty).__name__}.")


def _rates(drawn: MonteCarlo) -> str:
    rows = []
    for row in drawn.rates().to_dict("records"):
        ends = f"{100.0 * row['low']:.1f} to {100.0 * row['high']:.1f} %"
        sizes = ["\u2013", "\u2013"]
        if row["count"]:
            sizes = [f"{row[name]:.4g}" for name in ("median", "worst")]
        share = f"{row['count']} of {row['n']}: {100.0 * row['share']:.1f} %"
        of = SEVERITIES.get(row["severity"], row["severity"])
        rows.append((row["event"], share, ends, *sizes, of))
    head = "Event", "share", "95 % interval", "median", "worst", "of"
    return _table("How often and how badly", head, rows) + _paragraph(
        "Intervals are Wilson's; median and worst are those of the realisations it "
        "happens to."
    )


def _worst_of(subject: _Subject, drawn: MonteCarlo, output: str) -> tuple[int, float]:
    """Realisation with the largest error of an output, and that error."""
    values, numbers = ranked(drawn, subject.name, output, WORST)
    return int(numbers[-1]), float(values[-1])


def _worst(subject: _Subject, drawn: MonteCarlo) -> str:
    rows = []
    for output in subject.model.y_names:
        number, value = _worst_of(subject, drawn, output)
        there = drawn.table["realisation"] == number
        found = drawn.table[there & (drawn.table["output"] == output)].iloc[0]
        names = list(drawn.table.columns)
        parameters = names[names.index("output") + 1 : names.index("radius")]
        plant = ", ".join(f"{name} = {found[name]:.5g}" for name in parameters)
        rows.append((output, value, str(number), float(found["radius"]), plant))
    head = "Output", f"largest {WORST}", "realisation", "largest pole", "plant"
    return _table("Worst case", head, rows)


def _envelopes(subject: _Subject, drawn: MonteCarlo) -> Iterator[Chart]:
    """Bands of every output with its worst realisation, of every input, and poles."""
    model, own = subject.model, {subject.name: subject.run}
    for i in range(max(model.n_y, model.n_u)):
        output, input = min(i, model.n_y - 1), min(i, model.n_u - 1)
        nominal = drawn.nominal
        charts = {
            chart.name: chart
            for chart in ensemble_charts(drawn, own, nominal, output, input)
        }
        number, _ = _worst_of(subject, drawn, model.y_names[output])
        worst = {
            chart.name: chart.curves[0]
            for chart in picked_charts(drawn, own, number, output, input, WORST)
        }
        for name, size in (("output", model.n_y), ("input", model.n_u)):
            if i < size:
                label = f"worst {WORST}, realisation {number}"
                curve = dataclasses.replace(worst[name], label=label, style=1)
                chart = charts[name]
                yield dataclasses.replace(chart, curves=(*chart.curves, curve))
        if i == 0 and subject.linear is not None:
            yield charts["poles"]


# --- Versions and Python -----------------------------------------------------------


def _versions(subject: _Subject, day: str, seed: int | None) -> str:
    backend = getattr(subject.controller, "backend", None)
    solver = "none: this structure solves no program"
    if backend is not None:
        package = SOLVERS.get(backend, backend.rpartition("/")[2])
        solver = f"{backend} ({package} {_version(package)})"
    packages = ("nmss-lab", "numpy", "scipy", "qpsolvers")
    rows = [
        *((name, _version(name)) for name in packages),
        ("Solver", solver),
        ("Python", platform.python_version()),
        ("Date", day),
        ("Seed", "none: nothing was drawn" if seed is None else str(seed)),
    ]
    return _table("What made this report", ("What", "version"), rows)


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "of unknown version"


def _script(
    subject: _Subject, uncertainty: Uncertainty | None, drawn: MonteCarlo | None
) -> str:
    """Python that prints the numbers of the report from the design file."""
    plant = "study.plant"
    if isinstance(subject.study.plant, ContinuousPlant):
        plant = "study.plant.sampled(study.design.model.dt)"
    lines = [
        f'study = load("{FILE}")',
        "controller = study.design.build()",
        f"run = lab.closed_loop({plant}, controller, study.scenario)",
        "for channel, name in enumerate(controller.model.y_names):",
        f'    print(name, *table({{"{subject.name}": run}}, channel))',
    ]
    imports = []
    if subject.linear is not None:
        lines.append(f"print(lab.review(controller, {plant}))")
        lines.append(f"print(lab.linear_loop(controller, {plant}).poles)")
    if uncertainty is not None and drawn is not None:
        made, needed = _made(uncertainty)
        imports += needed
        lines += [
            "",
            f"uncertainty = {made}",
            f'designs = {{"{subject.name}": study.design}}',
            "drawn = lab.monte_carlo(",
            f"    designs, uncertainty, study.scenario, {drawn.asked}, {drawn.seed}",
            ")",
            "print(drawn.rates().to_string())",
        ]
    return "\n".join(
        [
            *imports,
            *([""] if imports else []),
            "import nmss_lab as lab",
            "from nmss_lab.files import load",
            "from nmss_lab.measures import table",
            "",
            *lines,
        ]
    )


def _made(uncertainty: Uncertainty) -> tuple[str, list[str]]:
    """Python that makes an uncertainty, and what it imports."""
    if isinstance(uncertainty, RelativeRanges):
        shares = {name: float(share) for name, share in uncertainty.share.items()}
        return f"lab.RelativeRanges(study.design.model, {shares!r})", []
    if isinstance(uncertainty, ParameterCovariance):
        rows = np.asarray(uncertainty.covariance).tolist()
        made = f"lab.ParameterCovariance(study.design.model, np.array({rows!r}))"
        return made, ["import numpy as np"]
    return f"...  # the {type(uncertainty).__name__} that the report was given", []


def _reproduce(
    subject: _Subject, uncertainty: Uncertainty | None, drawn: MonteCarlo | None
) -> str:
    others = [name for name in subject.runs if name != subject.name]
    said = (
        f"Save {FILE} beside this script; it holds design, plant and scenario to the "
        f"last digit. The commands nmss-lab simulate {FILE} and nmss-lab report {FILE} "
        "read it as well."
    )
    if others:
        said += f" It does not hold what was shown beside it: {', '.join(others)}."
    script = f"<pre><code>{escape(_script(subject, uncertainty, drawn))}</code></pre>"
    return f"<p>{_download(subject)}</p>{_paragraph(said)}{script}"


def _download(subject: _Subject) -> str:
    """Link that saves the design file: the study without its run."""
    text = subject.file
    data = base64.b64encode(text.encode()).decode()
    return (
        f'<a class="file" download="{FILE}" href="data:application/json;base64,{data}">'
        f"Save {FILE}</a> ({len(text) / 1000.0:.0f} kB)"
    )


# --- The page ----------------------------------------------------------------------

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""What the page may load: nothing."""

STYLE = """
:root {
  color-scheme: light dark;
  --paper: #ffffff; --ink: #1f2933; --quiet: #59636e; --line: #dde3e8;
  --ground: #f4f6f8; --good: #00704f; --bad: #b3261e; --accent: #1d5fa6;
}
@media screen and (prefers-color-scheme: dark) {
  :root {
    --paper: #14191f; --ink: #e6ebf0; --quiet: #a2adb9; --line: #2a333d;
    --ground: #0d1116; --good: #3fcf9f; --bad: #ff8a80; --accent: #5aa2e6;
  }
  .style0 { stroke: #56b4e9; } .fill0 { fill: #56b4e9; }
  .style1 { stroke: #f0883e; } .fill1 { fill: #f0883e; }
  .style2 { stroke: #3fcf9f; } .fill2 { fill: #3fcf9f; }
}
* { box-sizing: border-box; }
html { background: var(--ground); -webkit-text-size-adjust: 100%; }
body {
  color: var(--ink); background: var(--paper); max-width: 1080px; margin: 0 auto;
  padding: 24px clamp(14px, 4vw, 44px) 48px; overflow-wrap: break-word;
  font: 15px/1.5 system-ui, "Segoe UI", "Helvetica Neue", Arial, sans-serif;
}
h1 { font-size: 25px; line-height: 1.2; margin: 0 0 6px; }
h2 {
  font-size: 19px; margin: 34px 0 8px; padding-bottom: 4px;
  border-bottom: 1px solid var(--line);
}
h3 { font-size: 15px; margin: 16px 0 2px; }
p { margin: 6px 0; max-width: 76ch; }
a { color: var(--accent); }
:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; }
nav ul { display: flex; flex-wrap: wrap; gap: 2px 16px; padding: 0; list-style: none; }
ul { margin: 4px 0; padding-left: 22px; }
.quiet { color: var(--quiet); }
.table { overflow-x: auto; margin: 10px 0 14px; }
table { border-collapse: collapse; font-size: 14px; }
caption {
  text-align: left; font-weight: 650; padding-bottom: 3px; white-space: nowrap;
}
th, td {
  text-align: left; vertical-align: top; padding: 3px 14px 3px 0;
  border-bottom: 1px solid var(--line); min-width: 5ch;
}
thead th { color: var(--quiet); font-weight: 500; }
tbody th { font-weight: 500; }
.number { font-variant-numeric: tabular-nums; white-space: nowrap; }
.review { padding: 0; list-style: none; }
.review li { display: flex; gap: 12px; padding: 3px 0; max-width: 84ch; }
.review b { flex: none; width: 48px; font-weight: 650; }
.review .good b { color: var(--good); } .review .bad b { color: var(--bad); }
.review .note b { color: var(--quiet); }
.figures, .tables {
  display: grid; gap: 18px 26px; align-items: start;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 390px), 1fr));
}
figure { margin: 0; }
figure > svg { display: block; width: 100%; max-width: 620px; height: auto; }
pre {
  background: var(--ground); border: 1px solid var(--line); border-radius: 8px;
  padding: 10px 12px; font-size: 13px; white-space: pre-wrap;
}
@page { size: A4; margin: 16mm 15mm; }
@media print {
  :root { color-scheme: light; }
  html, body { background: #ffffff; }
  body { padding: 0; max-width: none; font-size: 10pt; }
  nav { display: none; }
  h2, h3, caption { break-after: avoid; }
  figure, tr, li, pre { break-inside: avoid; }
  .table { overflow: visible; }
  table, pre { font-size: 8.5pt; }
  .figures, .tables { grid-template-columns: 1fr 1fr; }
  a { color: inherit; }
}
"""


def _page(title: str, subject: _Subject, day: str, sections: Mapping[str, str]) -> str:
    """Put the file together."""
    places = {name: name.lower() for name in sections}
    links = "".join(
        f'<li><a href="#{place}">{name}</a></li>' for name, place in places.items()
    )
    parts = "\n".join(
        f'<section aria-labelledby="{places[name]}">'
        f'<h2 id="{places[name]}">{name}</h2>{content}</section>'
        for name, content in sections.items()
    )
    said = escape(f"Structure {subject.name}, {day}. Made with NMSS Lab.")
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{escape(title)}</title>
<style>{STYLE}</style>
</head>
<body>
<header>
<h1>{escape(title)}</h1>
<p class="quiet">{said}</p>
<nav aria-label="Sections"><ul>{links}</ul></nav>
</header>
<main>
{parts}
</main>
</body>
</html>
"""
