"""Pictures of runs: what is drawn as plain data, and Bokeh figures that draw it.

``loop_charts`` and ``governor_charts`` turn runs into a list of ``Chart``, which knows
nothing of a drawing library.  ``ChartFigure`` draws one chart and can be shown another
one of the same name, so that a page keeps its figures.  ``pack`` gathers what moves
with time (predicted trails, status) in one array for a player.

Colours are those of Okabe and Ito; dashes and markers tell curves apart without them.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from bokeh.layouts import gridplot
from bokeh.models import (
    ColumnDataSource,
    CustomJSTickFormatter,
    DataRange1d,
    Glyph,
    GlyphRenderer,
    GridPlot,
    HoverTool,
    Legend,
    Line,
    Range1d,
    Scatter,
    Span,
    TapTool,
    VArea,
)
from bokeh.plotting import figure

from nmss_lab.comparison import Score
from nmss_lab.controller import Status
from nmss_lab.convergence import Best, Iterate
from nmss_lab.identify import Estimate, pole_draws, step_band, step_response
from nmss_lab.models import Array
from nmss_lab.montecarlo import MonteCarlo
from nmss_lab.predictive import PredictiveController
from nmss_lab.qp import Row
from nmss_lab.records import Record
from nmss_lab.simulate import DIVERGED, Run

STYLES = (
    {"color": "#0072B2", "dash": (), "marker": "circle"},
    {"color": "#D55E00", "dash": (9, 4), "marker": "square"},
    {"color": "#009E73", "dash": (3, 3), "marker": "triangle"},
)
"""Colour, dash and marker of each run, in the order in which runs are given."""

TICKS = """
const size = Math.abs(tick)
const large = size >= 1e5 || (size > 0 && size < 1e-4)
const text = large ? tick.toExponential(1).replace(".0e", "e").replace("e+", "e")
                   : String(Number(tick.toPrecision(6)))
return text.replace("-", "\u2212")
"""
"""Short tick labels, in JavaScript."""

INK, QUIET = "#39424c", "#6b747e"
DRAWN_POINTS = 1500
"""Points of a curve are thinned to about this number; measures use all of them."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A signal of one run over time, and what was predicted of it.

    Parameters
    ----------
    label : str
    t, values : arrays (M,)
    held : bool
        Whether values hold until the next time, as inputs do.
    style : int
        Number of the run, an index of ``STYLES``.
    trail : array (N, Np), optional
        Prediction made at each sample.
    ahead : int
        Samples from the present one to the first predicted one.
    present : array (N,), optional
        Values at the samples, from which a trail that starts later sets out.
    low, high : arrays (M,), optional
        Band of uncertainty about the values.
    marks : int
        More than 0: drawn as points, this many of the first ones large.
    flags : bool array (M,), optional
        Values marked with a cross.
    """

    label: str
    t: Array
    values: Array
    held: bool = False
    style: int = 0
    trail: Array | None = None
    ahead: int = 0
    present: Array | None = None
    low: Array | None = None
    high: Array | None = None
    marks: int = 0
    flags: Array | None = None

    @property
    def flagged(self) -> Curve | None:
        """The marked values alone, as a curve."""
        if self.flags is None:
            return None
        t, values = self.t[self.flags], self.values[self.flags]
        return Curve(self.label, t, values, style=self.style)

    @property
    def reach(self) -> Array:
        """All finite values that it shows, its band included."""
        parts = [p for p in (self.values, self.low, self.high) if p is not None]
        shown = np.concatenate(parts)
        return shown[np.isfinite(shown)]


@dataclass(frozen=True, eq=False)
class Chart:
    """What one figure shows.

    Parameters
    ----------
    name : str
        The same for charts that take each other's place.
    title, axis : str
        Heading, and label of the vertical axis with its unit.
    curves : tuple of Curve
    references : tuple of Curve
        Drawn in neutral ink, as steps.
    limits : pair of float
        Infinite where there is none.
    samples : array (N,)
        Times of the samples.
    unit : str
        Unit of all times.
    counts : bool
        Whether values are whole numbers.
    across : str
        What lies on the horizontal axis.
    log, log_across : bool
        Whether the vertical and the horizontal axis are logarithmic.
    origin, step : float, optional
        Where trails begin and how far their values are apart, if trails do not move
        with the samples but are versions of one prediction.
    """

    name: str
    title: str
    axis: str
    curves: tuple[Curve, ...]
    references: tuple[Curve, ...] = ()
    limits: tuple[float, float] = (-np.inf, np.inf)
    samples: Array = dataclasses.field(default_factory=lambda: np.arange(2.0))
    unit: str = "s"
    counts: bool = False
    across: str = "time"
    log: bool = False
    log_across: bool = False
    origin: float | None = None
    step: float | None = None

    @property
    def has_flags(self) -> bool:
        """Whether curves may have values marked with a cross."""
        return any(curve.flags is not None for curve in self.curves)

    @property
    def span(self) -> tuple[float, float]:
        """First and last time."""
        return float(self.samples[0]), float(self.samples[-1])

    @property
    def vertical(self) -> tuple[float, float]:
        """Range of the vertical axis, rounded so that it seldom changes.

        Limits are included unless they are so far away that they would flatten the
        curves.
        """
        curves = (*self.curves, *self.references)
        values = np.concatenate([np.zeros(0), *(c.reach for c in curves)])
        values = values if values.size else np.zeros(1)
        if self.log:
            return _decades(values[values > 0.0])
        low, high = float(values.min()), float(values.max())
        if self.counts:  # counted from nothing, with a little room for the line
            _, top = _rounded(0.0, max(high, 1.0))
            return -0.04 * top, top
        size = max(high - low, 1e-9 * (1.0 + abs(high)))
        near = [x for x in self.limits if low - 2 * size <= x <= high + 2 * size]
        low, high = min([low, *near]), max([high, *near])
        return _rounded(low, high)


def loop_charts(
    runs: Mapping[str, Run], output: int = 0, input: int = 0
) -> list[Chart]:
    """Charts of loops side by side: output, input, increment, cost, active limits.

    Parameters
    ----------
    runs : mapping of str to Run
        Up to three runs over the same times, by name.
    output, input : int
        Which channels are shown.

    Returns
    -------
    list of Chart
        Named "output", "input", "increment", "cost" and "active".

    Raises
    ------
    ValueError
        If there is no run or too many, or no such channel.
    """
    first = _check(runs, output, input)
    model = first.controller.model
    y, u = model.y_names[output], model.u_names[input]
    in_y, in_u = (_unit(model.units.get(name, "")) for name in (y, u))
    held = [
        ("input", "Input", f"{u}{in_u}", "u"),
        ("increment", "Change of the input a sample", f"\u0394{u}{in_u}", "du"),
    ]
    charts = [
        Chart(
            "output",
            "Output and reference",
            f"{y}{in_y}",
            _outputs(runs, output),
            (Curve("reference r", first.t, first.r[:, output], held=True),),
            _sides(first, "y", output),
        )
    ]
    for name, title, axis, signal in held:
        curves = _inputs(runs, signal, input)
        limits = _sides(first, signal, input)
        charts.append(Chart(name, title, axis, curves, limits=limits))
    cost = _curves(runs, lambda run: run.cost)
    active = _curves(runs, lambda run: run.active.sum(axis=1).astype(float))
    charts.append(Chart("cost", "Cost of the plan", "J [-]", cost))
    charts.append(
        Chart("active", "Active limits in the plan", "number [-]", active, counts=True)
    )
    return [_timed(chart, first) for chart in charts]


def governor_charts(
    runs: Mapping[str, Run], output: int = 0, input: int = 0
) -> list[Chart]:
    """Charts of loops with a governor beside loops without.

    Returns
    -------
    list of Chart
        Named "output", "input", "increment", "reference" and "beta".

    Raises
    ------
    ValueError
        As ``loop_charts``, or if no run has a governor.
    """
    plain = loop_charts(runs, output, input)[:3]
    first = next(iter(runs.values()))
    model = first.controller.model
    unit = _unit(model.units.get(model.y_names[output], ""))
    t, r = first.t, first.r[:, output]
    bent: dict[str, list[Curve]] = {"w": [], "beta": []}
    for style, (name, run) in enumerate(runs.items()):
        if "beta" not in getattr(run.controller, "signals", ()):
            continue
        ahead = 0 if getattr(run.controller, "causal", True) else 1
        w = run.w[:, output]
        for signal, values in (("w", w), ("beta", w - r)):
            trail = run.trail(signal)[:, :, output]
            label = f"{signal}, {name}"
            bent[signal].append(Curve(label, t, values, True, style, trail, ahead))
    if not bent["w"]:
        raise ValueError("none of these runs has a governor: choose one")
    reference = Chart(
        "reference",
        "Reference r and governed w",
        f"r, w{unit}",
        tuple(bent["w"]),
        (Curve("reference r", t, r, held=True),),
    )
    beta = Chart(
        "beta",
        "Perturbation of the reference",
        f"\u03b2 = w \u2212 r{unit}",
        tuple(bent["beta"]),
        (Curve("zero", t, np.zeros(len(t)), held=True),),
    )
    return [*plain, *(_timed(chart, first) for chart in (reference, beta))]


def disturbance_charts(
    runs: Mapping[str, Run], output: int = 0, input: int = 0, disturbance: int = 0
) -> list[Chart]:
    """Charts of loops with and without a measured disturbance.

    The disturbance itself is a reference curve; trails show what the plans of each
    sample took it to be.

    Returns
    -------
    list of Chart
        Named "output", "input", "disturbance", "increment" and "error".

    Raises
    ------
    ValueError
        As ``loop_charts``, or if there is no such disturbance.
    """
    output_chart, input_chart, increment = loop_charts(runs, output, input)[:3]
    first = next(iter(runs.values()))
    model, t = first.controller.model, first.t
    if not 0 <= disturbance < model.n_v:
        raise ValueError(
            f"disturbance = {disturbance}: the model has {model.n_v} measured ones"
        )
    y, v = model.y_names[output], model.v_names[disturbance]
    in_y, in_v = (_unit(model.units.get(name, "")) for name in (y, v))
    expected = {
        style: (name, _expected(run, disturbance))
        for style, (name, run) in enumerate(runs.items())
    }
    measured = Chart(
        "disturbance",
        "v, measured and expected",
        f"{v}{in_v}",
        tuple(
            Curve(name, np.zeros(0), np.zeros(0), True, style, trail)
            for style, (name, trail) in expected.items()
            if trail is not None
        ),
        (Curve("disturbance v", t, first.v[:, disturbance], held=True),),
    )
    error = Chart(
        "error",
        "Deviation from the reference",
        f"y \u2212 r{in_y}",
        _curves(runs, lambda run: run.y[:, output] - run.r[:, output]),
        (Curve("zero", t, np.zeros(len(t)), held=True),),
    )
    measured, error = (_timed(chart, first) for chart in (measured, error))
    return [output_chart, input_chart, measured, increment, error]


def _expected(run: Run, channel: int) -> Array | None:
    """Disturbance over the horizon as each plan took it, (N, Np), v_k first.

    None for plans that know none; not a number where an older plan was continued.
    """
    controller, moves = run.controller, run.moves
    known = isinstance(controller, PredictiveController) and controller.form.lags
    if not known or moves is None:
        return None
    assert isinstance(controller, PredictiveController)
    ahead = controller.knowledge.layout.read(moves.known, "dv_ahead")[..., channel]
    changes = np.zeros((len(run), controller.horizon.Np))
    changes[:, 1 : 1 + ahead.shape[1]] = ahead
    changes[moves.shift != 0] = np.nan
    expected: Array = run.v[:, [channel]] + changes.cumsum(axis=1)
    return expected


def varying_charts(
    runs: Mapping[str, Run], output: int = 0, input: int = 0
) -> list[Chart]:
    """Charts of loops with state-dependent plants, unsettled samples crossed.

    Returns
    -------
    list of Chart
        Those of ``loop_charts``, with the decrease of the cost and the number of
        programs a sample in the place of the active limits.

    Raises
    ------
    ValueError
        As ``loop_charts``.
    """
    charts = loop_charts(runs, output, input)
    first = next(iter(runs.values()))
    passes = _curves(runs, lambda run: run.iterations.astype(float))
    last = Chart(
        "passes", "Programs solved a sample", "number [-]", passes, counts=True
    )
    decrease = Chart(
        "decrease",
        "Decrease of the cost",
        "before \u2212 now [-]",
        _curves(runs, lambda run: -np.diff(run.cost, prepend=run.cost[:1])),
        (Curve("zero", first.t, np.zeros(len(first))),),
    )
    charts[-1:] = [_timed(decrease, first), _timed(last, first)]
    flags = [run.status > Status.AMBIGUOUS for run in runs.values()]
    return [_flagged(c, flags) if c.name in FLAGGED else c for c in charts]


LOW = "increment", "cost", "decrease", "passes", "S_o", "S_i", "disturbance", "error"
"""Charts that pages show with little height: few ticks."""

FLAGGED = "output", "cost", "passes"
"""Charts in which samples that did not settle are crossed."""


def _flagged(chart: Chart, flags: Sequence[Array]) -> Chart:
    curves = tuple(
        dataclasses.replace(curve, flags=flags[curve.style]) for curve in chart.curves
    )
    return dataclasses.replace(chart, curves=curves)


def inside_charts(
    passes: Mapping[str, Sequence[Iterate]],
    best: Best,
    run: Run,
    k: int,
    output: int = 0,
    input: int = 0,
) -> list[Chart]:
    """Charts of the passes within one sample, and the best plan of the true problem.

    Parameters
    ----------
    passes : mapping of str to sequence of Iterate
        Up to three ways to settle, by name.
    best : Best
    run : Run
        Gives names, units and times; its controller's horizon is that of the plans.
    k : int
        The sample.
    output, input : int
        Which channels are shown.

    Returns
    -------
    list of Chart
        Named "change" and "gap", over the passes, and "inside_output" and
        "inside_input", over the horizon, with one trail a pass.
    """
    model = run.controller.model
    y, u = model.y_names[output], model.u_names[input]
    in_y, in_u = (_unit(model.units.get(name, "")) for name in (y, u))
    seconds, unit = time_unit(run)
    count = max(len(found) for found in passes.values())
    numbers = 1.0 + np.arange(float(max(count, 2)))
    step = (run.t[1] - run.t[0]) / seconds
    t = run.t[k] / seconds + step * np.arange(len(best.y) + 1)
    change = Chart(
        "change",
        "Change of the plan, pass by pass",
        f"{u}{in_u}",
        tuple(
            Curve(name, numbers[: len(found)], _changes(found), style=style)
            for style, (name, found) in enumerate(passes.items())
        ),
        samples=numbers,
        unit="-",
        across="pass",
        log=True,
    )
    gap = Chart(
        "gap",
        "True cost above the lowest found",
        "share of it [-]",
        tuple(
            Curve(name, numbers[: len(found)], _gaps(found, best), style=style)
            for style, (name, found) in enumerate(passes.items())
        ),
        samples=numbers,
        unit="-",
        across="pass",
        log=True,
    )
    trails = {
        name: [[getattr(each, signal) for each in found] for signal in ("y", "u")]
        for name, found in passes.items()
    }
    inside = []
    for name, title, axis, which, channel, ahead in (
        ("inside_output", "Predicted output, pass by pass", f"{y}{in_y}", 0, output, 1),
        ("inside_input", "Planned input, pass by pass", f"{u}{in_u}", 1, input, 0),
    ):
        lowest = (best.y, best.u)[which][:, channel]
        curves = tuple(
            _last_with_trail(
                label, t[ahead:], parts[which], channel, style, len(numbers)
            )
            for style, (label, parts) in enumerate(trails.items())
        )
        times = t[ahead : ahead + len(lowest)]
        inside.append(
            Chart(
                name,
                title,
                axis,
                tuple(dataclasses.replace(c, held=not ahead) for c in curves),
                (Curve("lowest cost found", times, lowest, held=not ahead),),
                samples=t,
                unit=unit,
                origin=float(t[ahead]),
                step=float(step),
            )
        )
    return [change, gap, *inside]


def _changes(found: Sequence[Iterate]) -> Array:
    """Take the change of each pass, above zero for a logarithmic axis."""
    return np.maximum([each.change for each in found], 1e-16)


def _gaps(found: Sequence[Iterate], best: Best) -> Array:
    costs = np.array([each.cost for each in found])
    gaps = (costs - best.cost) / max(abs(best.cost), 1e-300)
    return np.clip(np.nan_to_num(gaps, posinf=1e6), 1e-12, 1e6)


def _last_with_trail(
    label: str,
    t: Array,
    plans: Sequence[Array],
    channel: int,
    style: int,
    count: int,
) -> Curve:
    """Curve of the last pass; the trails of all, the last one repeated.

    Its band is what the passes cover, but for those far away.
    """
    trail = np.array([plan[:, channel] for plan in plans])
    trail = trail[np.minimum(np.arange(count), len(trail) - 1)]
    trail = np.clip(trail, -1e30, 1e30)
    for i in range(1, trail.shape[1]):  # what is no number any more stays where it was
        trail[:, i] = np.where(np.isfinite(trail[:, i]), trail[:, i], trail[:, i - 1])
    trail = np.nan_to_num(trail)
    last = trail[-1]
    room = 2.0 * np.ptp(last)
    low = np.maximum(trail.min(axis=0), last.min() - room)
    high = np.minimum(trail.max(axis=0), last.max() + room)
    t = t[: len(last)]
    return Curve(label, t, last, style=style, trail=trail, low=low, high=high)


def passes_in_words(passes: Mapping[str, Sequence[Iterate]]) -> list[dict[str, Any]]:
    """Words about each pass of each way to settle, as a player shows them."""
    count = max(2, max(len(found) for found in passes.values()))
    words = []
    for name, found in passes.items():
        texts = [_pass_in_words(i, each, found) for i, each in enumerate(found)]
        which = np.minimum(np.arange(count), len(found) - 1)
        words.append({"name": name, "texts": texts, "which": which.tolist()})
    return words


def _pass_in_words(i: int, each: Iterate, found: Sequence[Iterate]) -> str:
    where = "with the coefficients of this sample" if each.frozen else "along the plan"
    text = f"Pass {i + 1} {where}: cost {each.cost:.6g}, change {each.change:.2g}."
    return f"{text} {each.status.sentence}" if i == len(found) - 1 else text


# Estimates

DRAWS = 200
"""Models drawn from the covariance for bands and clouds."""

LAGS = 25


def record_charts(
    record: Record,
    estimates: Mapping[str, Estimate] | None = None,
    checked: Record | None = None,
) -> list[Chart]:
    """Charts of a record with one output: measured and simulated output, inputs.

    Parameters
    ----------
    record : Record
    estimates : mapping of str to Estimate, optional
        Up to three, by name; simulated over the record that each has.
    checked : Record, optional
        Part for validation, simulated as well, its past fitted to it.

    Returns
    -------
    list of Chart
        Named "output" and "signal".

    Raises
    ------
    ValueError
        If there are too many estimates.
    """
    estimates = estimates or {}
    _check_estimates(estimates)
    thin = slice(None, None, max(1, len(record.time) // DRAWN_POINTS))
    t, y = record.time[thin], record.y[thin, 0]
    name = record.names["y"][0]
    inputs = np.hstack([record.u, record.v])[thin, : len(STYLES)].T
    names = (*record.names["u"], *record.names["v"])[: len(STYLES)]
    output = Chart(
        "output",
        "Output, measured and simulated",
        f"{name}{_unit(record.units.get(name, ''))}",
        tuple(
            Curve(label, *_simulated(found, checked), style=style)
            for style, (label, found) in enumerate(estimates.items())
        ),
        (Curve("measured", t, y),),
    )
    units = {record.units.get(name, "") for name in names}
    unit = units.pop() if len(units) == 1 else ""
    curves = tuple(
        Curve(label, t, u, True, style)
        for style, (label, u) in enumerate(zip(names, inputs, strict=True))
    )
    axis = f"{', '.join(names)}{_unit(unit)}"
    signal = Chart("signal", "Inputs and measured disturbances", axis, curves)
    return [
        dataclasses.replace(chart, samples=record.time[[0, -1]])
        for chart in (output, signal)
    ]


def _simulated(found: Estimate, checked: Record | None) -> tuple[Array, Array]:
    """Give times and values of the simulated output, a gap between the parts."""
    t, x = found.record.time, found.simulated
    if checked is not None:
        beyond = found.explained(checked, "estimate")
        t = np.concatenate([t, [np.nan], checked.time])
        x = np.concatenate([x, [np.nan], beyond])
    every = max(1, len(t) // (2 * DRAWN_POINTS))
    return t[::every], x[::every]


def estimate_charts(
    estimates: Mapping[str, Estimate], channel: int = 0, seed: int = 0
) -> list[Chart]:
    """Charts of estimates side by side: step response, poles, correlations.

    Parameters
    ----------
    estimates : mapping of str to Estimate
        Up to three, by name; without band and cloud where the covariance is not
        finite.
    channel : int
        Input whose step and whose correlation with the residuals are shown.
    seed : int
        Of the draws from each covariance, for bands and clouds.

    Returns
    -------
    list of Chart
        Named "step", "poles", "auto" and "cross".

    Raises
    ------
    ValueError
        If there are too many estimates.
    """
    _check_estimates(estimates)
    return [
        _step_chart(estimates, channel, seed),
        _pole_chart(estimates, seed),
        _correlation_chart(
            "auto",
            "Autocorrelation of the residuals",
            {
                name: found.autocorrelation(_lags(found))
                for name, found in estimates.items()
            },
        ),
        _correlation_chart(
            "cross",
            "Residuals against past inputs",
            {
                name: (pair[0][:, channel], pair[1])
                for name, found in estimates.items()
                for pair in [found.cross_correlation(_lags(found))]
            },
        ),
    ]


# Tuning


def history_chart(found: Sequence[tuple[int, float]], tried: int) -> Chart:
    """Chart of the best attainment factor against the number of designs tried.

    Parameters
    ----------
    found : sequence of (int, float)
        Designs tried at each improvement, and the attainment factor from then on.
    tried : int
        Designs tried so far.

    Returns
    -------
    Chart
        Named "history".  Factors that hard goals make huge are drawn at the upper end.
    """
    finite = [(n, a) for n, a in found if np.isfinite(a)]
    last = finite[-1][1] if finite else 0.0
    top = max(1.0, 3.0 * abs(last))
    counts = np.array([*(float(n) for n, _ in finite), float(tried)])
    values = np.array([*(min(a, top) for _, a in finite), min(last, top)])
    ends = np.array([0.0, max(float(tried), 10.0)])
    return Chart(
        "history",
        "Best attainment factor so far",
        "attainment [-]",
        (Curve("best so far", counts, values, True, 1),) if finite else (),
        (Curve("every goal met", ends, np.zeros(2)),),
        samples=ends,
        unit="-",
        across="designs tried",
    )


def _check_estimates(estimates: Mapping[str, Estimate]) -> None:
    if len(estimates) > len(STYLES):
        raise ValueError(f"{len(estimates)} estimates: expected up to {len(STYLES)}")


def _step_chart(estimates: Mapping[str, Estimate], channel: int, seed: int) -> Chart:
    samples = max((_settled(found) for found in estimates.values()), default=2)
    curves = []
    t: Array = np.zeros(0)
    for style, (name, found) in enumerate(estimates.items()):
        t = found.record.dt * np.arange(samples)
        y = step_response(found, samples, channel)
        low = high = None
        if _has_spread(found):
            rng = np.random.default_rng(seed)
            low, high = step_band(found, samples, rng, channel, DRAWS)
        curves.append(Curve(name, t, y, style=style, low=low, high=high))
    ends = t[[0, -1]] if t.size else np.array([0.0, 1.0])
    units = {
        f"{name}{_unit(e.record.units.get(name, ''))}"
        for e in estimates.values()
        for name in e.record.names["y"]
    }
    axis = units.pop() if len(units) == 1 else "y [-]"
    title = "Response to a unit step, with 95 % band"
    return Chart("step", title, axis, tuple(curves), samples=ends)


def _lags(found: Estimate) -> int:
    """Lags to look at: not more than there are residuals."""
    return min(LAGS, len(found.residuals) - 1)


def _has_spread(found: Estimate) -> bool:
    """Whether it is known how uncertain the parameters are."""
    return bool(np.isfinite(found.covariance).all())


def _settled(found: Estimate) -> int:
    """Count the samples until a step response of a stable model is at rest."""
    size = float(np.abs(found.poles()).max())
    decay = np.log(0.01) / np.log(size) if 0.0 < size < 0.995 else 1000.0
    return int(np.clip(decay, 20.0, 1000.0)) + found.orders.reach


def _pole_chart(estimates: Mapping[str, Estimate], seed: int) -> Chart:
    curves = []
    for style, (name, found) in enumerate(estimates.items()):
        p = found.poles()
        if _has_spread(found):
            cloud = pole_draws(found, DRAWS, np.random.default_rng(seed)).ravel()
            p = np.concatenate([p, cloud])
        na = found.orders.na
        curves.append(Curve(name, p.real, p.imag, style=style, marks=na))
    left, right, half = _window(curves)
    angle = np.linspace(0.0, 2.0 * np.pi, 2881)
    x, y = np.cos(angle), np.sin(angle)
    inside = (left <= x) & (x <= right) & (np.abs(y) <= half)
    circle = Curve("unit circle", x, np.where(inside, y, np.nan))
    return Chart(
        "poles",
        "Poles, 200 models drawn from P*",
        "imaginary part [-]",
        tuple(curves),
        (circle,),
        samples=np.array([left, right]),
        unit="-",
        across="real part",
    )


def _window(curves: Sequence[Curve]) -> tuple[float, float, float]:
    """Left, right and half height of a window that shows the poles from near."""
    if not curves:
        return -1.1, 1.1, 1.1
    near = [np.quantile(c.t, (0.02, 0.98)) for c in curves]
    near += [c.t[: c.marks] for c in curves]
    left, right = float(np.concatenate(near).min()), float(np.concatenate(near).max())
    high = max(float(np.abs(c.values[: c.marks]).max()) for c in curves)
    half = min(max(0.6 * (right - left), 1.3 * high, 0.1), 1.1)
    room = max(0.15 * (right - left), 0.05)
    return max(left - room, -1.1), min(right + room, 1.1), half


def _correlation_chart(
    name: str, title: str, correlations: Mapping[str, tuple[Array, float]]
) -> Chart:
    """Stems, each drawn from zero and back to it."""
    curves = []
    for style, (label, (r, _)) in enumerate(correlations.items()):
        lags = np.repeat(np.arange(len(r)) + 0.25 * style, 3)
        stems = np.column_stack([np.zeros_like(r), r, np.zeros_like(r)]).ravel()
        curves.append(Curve(label, lags, stems, style=style))
    band = max((pair[1] for pair in correlations.values()), default=np.inf)
    return Chart(
        name,
        title,
        "correlation [-]",
        tuple(curves),
        limits=(-band, band),
        samples=np.array([-0.5, LAGS + 0.8]),
        unit="samples",
        across="lag",
    )


def _outputs(runs: Mapping[str, Run], channel: int) -> tuple[Curve, ...]:
    curves = []
    for style, (name, run) in enumerate(runs.items()):
        every = max(1, len(run.t_fine) // DRAWN_POINTS)
        t, values = run.t_fine[::every], run.y_fine[::every, channel]
        trail = _trail(run, "y", channel)
        present = run.y[:, channel]
        curves.append(Curve(name, t, values, False, style, trail, 1, present))
    return tuple(curves)


def _inputs(runs: Mapping[str, Run], signal: str, channel: int) -> tuple[Curve, ...]:
    return tuple(
        Curve(
            name,
            run.t,
            getattr(run, signal)[:, channel],
            True,
            style,
            _trail(run, signal, channel),
            0,
        )
        for style, (name, run) in enumerate(runs.items())
    )


def _curves(runs: Mapping[str, Run], values: Any) -> tuple[Curve, ...]:
    return tuple(
        Curve(name, run.t, values(run), True, style)
        for style, (name, run) in enumerate(runs.items())
    )


def _trail(run: Run, signal: str, channel: int) -> Array | None:
    if not isinstance(run.controller, PredictiveController) or run.moves is None:
        return None
    trail: Array = run.trail(signal)[:, :, channel]
    return trail


def _sides(run: Run, signal: Any, channel: int) -> tuple[float, float]:
    size = run.y.shape[1] if signal == "y" else run.u.shape[1]
    low, high = run.controller.limits.of(signal, size)
    return float(low[channel]), float(high[channel])


def time_unit(run: Run) -> tuple[float, str]:
    """Choose a unit of time for the length of a run: its seconds, and its name."""
    return unit_of_time(float(run.t[-1]))


def unit_of_time(seconds: float) -> tuple[float, str]:
    """Choose a unit for a length of time: its seconds, and its name."""
    units = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"))
    fitting = [unit for unit in units if seconds >= 8.0 * unit[0]]
    return fitting[0] if fitting else (1.0, "s")


def _timed(chart: Chart, run: Run) -> Chart:
    """Chart with times in the unit that suits the length of the run."""
    size, unit = time_unit(run)

    def timed(curves: tuple[Curve, ...]) -> tuple[Curve, ...]:
        return tuple(dataclasses.replace(c, t=c.t / size) for c in curves)

    return dataclasses.replace(
        chart,
        curves=timed(chart.curves),
        references=timed(chart.references),
        samples=run.t / size,
        unit=unit,
    )


def _unit(unit: str) -> str:
    return f" [{unit or '-'}]"


def _check(runs: Mapping[str, Run], output: int, input: int) -> Run:
    if not 1 <= len(runs) <= len(STYLES):
        raise ValueError(f"{len(runs)} runs: expected 1 to {len(STYLES)}")
    first = next(iter(runs.values()))
    model = first.controller.model
    for name, value, size in (
        ("output", output, model.n_y),
        ("input", input, model.n_u),
    ):
        if not 0 <= value < size:
            raise ValueError(f"{name} = {value}: expected 0 to {size - 1}")
    if any(len(run) != len(first) for run in runs.values()):
        raise ValueError("runs have different numbers of samples")
    return first


def _decades(values: Array) -> tuple[float, float]:
    """Powers of ten about positive values."""
    if not values.size:
        return 0.1, 10.0
    low, high = (np.log10(end) for end in (values.min(), values.max()))
    return float(10.0 ** np.floor(low - 0.01)), float(10.0 ** np.ceil(high + 0.01))


def _rounded(low: float, high: float) -> tuple[float, float]:
    """Widen a range by a margin, outwards to a multiple of a round number."""
    size = high - low
    if size < 1e-9 * (1.0 + abs(high)):
        low, high = low - 0.5 * (1.0 + abs(low)), high + 0.5 * (1.0 + abs(high))
        size = high - low
    low, high = low - 0.06 * size, high + 0.06 * size
    raw = size / 10.0
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * min(m for m in (1.0, 2.0, 5.0, 10.0) if m * power >= raw)
    return float(step * np.floor(low / step)), float(step * np.ceil(high / step))


# What moves with time


def busiest_sample(runs: Mapping[str, Run]) -> int:
    """Find a sample with most limits active; without any, with the largest error."""
    first = next(iter(runs.values()))
    held = sum(run.active.sum(axis=1) for run in runs.values())
    if np.max(held):
        most = np.flatnonzero(held == np.max(held))
        return int(most[len(most) // 2])
    return int(np.argmax(np.abs(first.r - first.y).max(axis=1)))


def pack(charts: Sequence[Chart]) -> dict[str, Any]:
    """Gather all that charts show: one float32 array and a description of it.

    Parameters
    ----------
    charts : sequence of Chart
        Over the same samples.

    Returns
    -------
    dict
        "data": times of the samples, curves and trails, one after the other, float32;
        "samples": N; "unit" of time; "charts", each with its "name", "title", "axis",
        "vertical", "span", "limits" (None where there is none), its "lines" and its
        "trails".

        "across" and "unit" label the horizontal axis; "origin" and "step" are those of
        ``Chart``.

        A line has a "name" (that of its renderer in ``ChartFigure``), and "start" and
        "size" of its times; its values follow them.  A trail has "style", "held",
        "ahead", "steps" (Np), "start", where its (N, Np) values begin, and "present",
        where the N values begin from which it sets out, or None.
    """
    box = _Box()
    t = charts[0].samples
    box.put(t)
    described = [
        {
            "name": chart.name,
            "title": chart.title,
            "axis": chart.axis,
            "vertical": chart.vertical,
            "span": chart.span,
            "limits": [side if np.isfinite(side) else None for side in chart.limits],
            "lines": _lines(box, chart),
            "trails": _trails(box, chart),
            "across": chart.across,
            "unit": chart.unit,
            "origin": chart.origin,
            "step": chart.step,
        }
        for chart in charts
    ]
    data = np.concatenate(box.parts)
    unit = charts[0].unit
    return {"data": data, "samples": len(t), "unit": unit, "charts": described}


class _Box:
    """Arrays one after the other, as float32."""

    def __init__(self) -> None:
        self.parts: list[Any] = []
        self.size = 0

    def put(self, values: Array) -> int:
        """Add an array; return where it begins."""
        self.parts.append(np.asarray(values, np.float32).ravel())
        self.size += values.size
        return self.size - values.size


def _lines(box: _Box, chart: Chart) -> list[dict[str, Any]]:
    """Every renderer's line; empty where the chart has no such curve."""
    curves: dict[str, Curve | None] = {f"style{i}": None for i in range(len(STYLES))}
    curves |= {f"style{curve.style}": curve for curve in chart.curves}
    if chart.has_flags:
        curves |= {f"flag{i}": None for i in range(len(STYLES))}
        curves |= {f"flag{curve.style}": curve.flagged for curve in chart.curves}
    curves["ink"] = chart.references[0] if chart.references else None
    lines = []
    for name, curve in curves.items():
        t, y = _corners(curve)
        lines.append({"name": name, "size": t.size, "start": box.put(t)})
        box.put(y)
    return lines


def _trails(box: _Box, chart: Chart) -> list[dict[str, Any]]:
    return [
        {
            "style": curve.style,
            "held": curve.held,
            "ahead": curve.ahead,
            "steps": curve.trail.shape[1],
            "start": box.put(curve.trail),
            "present": None if curve.present is None else box.put(curve.present),
        }
        for curve in chart.curves
        if curve.trail is not None
    ]


def _corners(curve: Curve | None) -> tuple[Array, Array]:
    """Give times and values of a line; held values become corners."""
    if curve is None:
        return np.zeros(0), np.zeros(0)
    if curve.held:
        return np.repeat(curve.t, 2)[1:], np.repeat(curve.values, 2)[:-1]
    return curve.t, curve.values


def sentences(run: Run) -> tuple[list[str], Array]:
    """State in words of every sample: the different texts, and which holds when (N,).

    Each is the status sentence, followed by the names of the limits that hold the plan.
    """
    labels = run.controller.program.labels if run.active.shape[1] else []  # type: ignore[attr-defined]
    model = run.controller.model
    texts: dict[str, int] = {}
    which = np.empty(len(run), dtype=int)
    for k, (code, held) in enumerate(zip(run.status, run.active, strict=True)):
        rows = [labels[i] for i in np.flatnonzero(held)]
        text = " ".join([Status(int(code)).sentence, _held_rows(rows, model)]).strip()
        which[k] = texts.setdefault(text, len(texts))
    return list(texts), which


def _held_rows(rows: Sequence[Any], model: Any) -> str:
    """Names of limits and the steps of the horizon at which they hold."""
    if not rows:
        return ""

    def key(row: Any) -> tuple[str, int]:
        return row.name, row.channel

    parts = []
    for _, group in itertools.groupby(sorted(rows, key=key), key):
        together = list(group)
        steps = sorted(row.step for row in together)
        parts.append(f"{row_in_words(together[0], model)[0]} {_steps(steps)}")
    return f"At a limit: {'; '.join(parts)}."


def row_in_words(row: Row, model: Any) -> tuple[str, str]:
    """Signal that a row of a program limits, in words, and its unit."""
    names = {"u": model.u_names, "du": model.u_names, "y": model.y_names}
    known = names.get(row.name)
    label = known[row.channel] if known else "end"
    before = {"du": "change of ", "u": "", "y": ""}.get(row.name, f"{row.name} ")
    return f"{before}{label}", model.units.get(label, "")


def _steps(steps: Sequence[int]) -> str:
    """Say steps in words, runs of neighbours joined: "at step 0 to 2, 5"."""
    runs: list[list[int]] = []
    for step in steps:
        if runs and step <= runs[-1][1] + 1:
            runs[-1][1] = step
        else:
            runs.append([step, step])
    words = [f"{a}" if a == b else f"{a} to {b}" for a, b in runs]
    return f"at step {', '.join(words)}"


# Bokeh


class ChartFigure:
    """A Bokeh figure for charts of one name.

    Parameters
    ----------
    chart : Chart
    times : Range1d, optional
        Horizontal range shared with other figures.

    Notes
    -----
    References and limits lie on Bokeh's overlay level, so that a player can cover
    what has not happened yet and still leave them visible.
    """

    def __init__(self, chart: Chart, times: Range1d | None = None) -> None:
        times = times or Range1d(*chart.span)
        self.figure = _empty_figure(chart, times)
        self.curves = [ColumnDataSource({"t": [], "y": []}) for _ in STYLES]
        self.flags = [
            ColumnDataSource({"t": [], "y": []}) for _ in STYLES if chart.has_flags
        ]
        self.references = ColumnDataSource({"t": [], "y": []})
        self._lines = [
            _add_line(self.figure, source, number)
            for number, source in enumerate(self.curves)
        ]
        for number, source in enumerate(self.flags):
            _add_flags(self.figure, source, number)
        ink = Line(x="t", y="y", line_color=INK, line_width=1.4)
        _add(self.figure, self.references, ink, name="ink", level="overlay")
        self.limits = [_limit_line() for _ in range(2)]
        for line in self.limits:
            self.figure.add_layout(line)
        hover = HoverTool(
            renderers=self._lines,
            tooltips=[(chart.across, "@t{%.4g}"), ("value", "@y{%.4g}")],
            formatters={"@t": "printf", "@y": "printf"},
            mode="mouse",
        )
        self.figure.add_tools(hover)
        if chart.counts:
            self.figure.yaxis[0].ticker.min_interval = 1
        if chart.name in LOW:
            self.figure.yaxis[0].ticker.desired_num_ticks = 3
        self.show(chart)

    def show(self, chart: Chart) -> None:
        """Draw another chart."""
        with_style = {curve.style: curve for curve in chart.curves}
        for style, source in enumerate(self.curves):
            _fill(source, with_style.get(style))
        for style, source in enumerate(self.flags):
            curve = with_style.get(style)
            _fill(source, curve and curve.flagged)
        _fill(self.references, chart.references[0] if chart.references else None)
        for line, value in zip(self.limits, chart.limits, strict=True):
            line.update(location=value if np.isfinite(value) else None)
        low, high = chart.vertical
        self.figure.y_range.update(start=low, end=high)
        span = chart.span
        self.figure.x_range.update(
            start=span[0], end=span[1], reset_start=span[0], reset_end=span[1]
        )
        self.figure.yaxis.axis_label = chart.axis
        self.figure.xaxis.axis_label = f"{chart.across} [{chart.unit}]"
        self.figure.title.text = chart.title


class EstimateFigure(ChartFigure):
    """A figure that also draws bands about curves, and curves as points."""

    def __init__(self, chart: Chart, times: Range1d | None = None) -> None:
        columns = ("t", "low", "high"), ("t", "y", "size", "number")
        self.bands, self.points = (
            [ColumnDataSource({key: [] for key in keys}) for _ in STYLES]
            for keys in columns
        )
        super().__init__(chart, times)
        for number, (band, points) in enumerate(
            zip(self.bands, self.points, strict=True)
        ):
            _add_band(self.figure, band, number)
            _add_points(self.figure, points, number)

    def show(self, chart: Chart) -> None:
        """Draw another chart."""
        lines = tuple(curve for curve in chart.curves if not curve.marks)
        super().show(dataclasses.replace(chart, curves=lines))
        low, high = chart.vertical
        self.figure.y_range.update(start=low, end=high)
        with_style = {curve.style: curve for curve in chart.curves}
        for style in range(len(STYLES)):
            curve = with_style.get(style)
            self.bands[style].data = _band_columns(curve)
            self.points[style].data = _point_columns(curve)


def _band_columns(curve: Curve | None) -> dict[str, Array]:
    if curve is None or curve.low is None or curve.high is None:
        return {key: np.zeros(0) for key in ("t", "low", "high")}
    return {"t": curve.t, "low": curve.low, "high": curve.high}


def _point_columns(curve: Curve | None) -> dict[str, Array]:
    if curve is None or not curve.marks:
        return {key: np.zeros(0) for key in ("t", "y", "size", "number")}
    if isinstance(curve, Cloud):
        number = curve.numbers
        t, y = (part.astype(np.float32) for part in (curve.t, curve.values))
        numbers = np.full(len(t), -1) if number is None else number
        size = np.full(len(t), 4.0, np.float32)
        return {"t": t, "y": y, "size": size, "number": numbers.astype(np.int32)}
    size = np.where(np.arange(len(curve.t)) < curve.marks, 12.0, 3.0)
    number = np.full(len(size), -1)
    return {"t": curve.t, "y": curve.values, "size": size, "number": number}


def _add_band(plot: figure, source: ColumnDataSource, number: int) -> None:
    color = STYLES[number]["color"]
    band = VArea(x="t", y1="low", y2="high", fill_color=color, fill_alpha=0.18)
    _add(plot, source, band, name=f"band{number}", level="underlay")


def _add_points(plot: figure, source: ColumnDataSource, number: int) -> None:
    style = STYLES[number]
    points = Scatter(
        x="t",
        y="y",
        size="size",
        marker=str(style["marker"]),
        fill_color=style["color"],
        line_color=style["color"],
        fill_alpha=0.3,
        line_alpha=0.8,
    )
    _add(plot, source, points, name=f"points{number}")


def _add_flags(plot: figure, source: ColumnDataSource, number: int) -> None:
    color = STYLES[number]["color"]
    flags = Scatter(x="t", y="y", size=9, marker="x", line_color=color, line_width=2)
    _add(plot, source, flags, name=f"flag{number}", level="overlay")


def _add(
    plot: figure, source: ColumnDataSource, glyph: Glyph, **more: Any
) -> GlyphRenderer:
    """Draw with a glyph, and no others for what is muted or not selected.

    They would make a figure's models twice as many, and all cost time and memory.
    """
    return plot.add_glyph(
        source, glyph, nonselection_glyph=None, muted_glyph=None, **more
    )


def _empty_figure(chart: Chart, times: Range1d | DataRange1d) -> figure:
    plot = figure(
        name=chart.name,
        x_axis_type="log" if chart.log_across else "linear",
        y_axis_type="log" if chart.log else "linear",
        height=220,
        sizing_mode="stretch_both",
        x_range=times,
        y_range=Range1d(-1, 1),
        tools="xbox_zoom,reset,save",
        toolbar_location="above",
        output_backend="canvas",
        background_fill_color=None,
        border_fill_color=None,
        outline_line_color=None,
        min_border_left=62,
        min_border_right=10,
    )
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    plot.title.text_font_size, plot.title.text_font_style = "13px", "bold"
    plot.title.text_color = INK
    for axis in (plot.xaxis[0], plot.yaxis[0]):
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = axis.major_label_text_font_size = "12px"
        axis.axis_label_text_color = axis.major_label_text_color = INK
        axis.axis_line_color = axis.major_tick_line_color = QUIET
        axis.minor_tick_line_color = None
        axis.formatter = CustomJSTickFormatter(code=TICKS)
    plot.grid.grid_line_color, plot.grid.grid_line_alpha = "#808890", 0.22
    return plot


def _add_line(plot: figure, source: ColumnDataSource, number: int) -> Any:
    style = STYLES[number]
    line = Line(
        x="t",
        y="y",
        line_color=style["color"],
        line_width=2.2,
        line_dash=list(style["dash"]),
        line_join="round",
    )
    return _add(plot, source, line, name=f"style{number}")


def _limit_line() -> Span:
    return Span(
        dimension="width",
        line_color=QUIET,
        line_dash=[2, 4],
        line_width=1.6,
        level="overlay",
        name="limit",
    )


def _fill(source: ColumnDataSource, curve: Curve | None) -> None:
    t, y = _corners(curve)
    source.data = {"t": t.astype(np.float32), "y": y.astype(np.float32)}


def draw(charts: Sequence[Chart], columns: int = 2) -> GridPlot:
    """Figures of the charts with linked times, for a notebook or a file.

    Returns
    -------
    GridPlot
        Give it to ``bokeh.plotting.show``.
    """
    times = Range1d(*charts[0].span)
    plots = [ChartFigure(chart, times).figure for chart in charts]
    for plot, chart in zip(plots, charts, strict=True):
        _add_legend(plot, chart)
    return gridplot(plots, ncols=columns, sizing_mode="stretch_width", height=240)


def _add_legend(plot: figure, chart: Chart) -> None:
    lines = plot.renderers[: len(STYLES)]
    items = [(curve.label, [lines[curve.style]]) for curve in chart.curves]
    plot.add_layout(Legend(items=items, location="top_right"))


# Ensembles: many realisations of the plant at once


MOST_POLES = 3000
"""Poles of one design that are drawn, apart from those at the origin."""

ORIGIN = 1e-3
"""Poles nearer than this to the origin are drawn once, as nominal ones."""

ALWAYS = 30
"""Worst realisations whose poles are drawn whatever their number."""

FARTHEST = 3.0
"""Poles beyond this radius lie outside the picture."""


@dataclass(frozen=True, eq=False)
class Cloud(Curve):
    """A curve that stands for many realisations.

    Parameters
    ----------
    nominal : array (M,), optional
        The same with the nominal plant, a thin line.
    crosses : complex array, optional
        Places of the nominal poles.
    numbers : array (M,), optional
        Numbers of the realisations of points, so that they can be picked.
    """

    nominal: Array | None = None
    crosses: Any = None
    numbers: Array | None = None

    @property
    def reach(self) -> Array:
        """Values about the nominal ones; loops that run away do not flatten them."""
        if self.nominal is None:
            near: Array = self.values[np.abs(self.values) <= FARTHEST]
            return near
        core = self.nominal[np.isfinite(self.nominal)]
        low, high = _room(core)
        parts = [p for p in (self.values, self.low, self.high) if p is not None]
        shown = np.concatenate([core, *parts])
        return np.clip(shown[~np.isnan(shown)], low, high)


def _room(core: Array) -> tuple[float, float]:
    size = float(np.ptp(core)) or 1.0
    return float(core.min()) - size, float(core.max()) + size


def ensemble_charts(
    study: MonteCarlo,
    nominal: Mapping[str, Run],
    poles: Mapping[str, Any],
    output: int = 0,
    input: int = 0,
    measure: str = "IAE",
) -> list[Chart]:
    """Charts of a study: pole clouds, bands of output and input, a distribution.

    Parameters
    ----------
    study : MonteCarlo
        With signals, of up to three designs.
    nominal : mapping of str to Run
        Each design's run on the nominal plant.
    poles : mapping of str to complex array
        Closed-loop poles with it.
    output, input : int
        Which channels are shown.
    measure : str
        Column of the table.

    Returns
    -------
    list of Chart
        Named "poles", "output", "input" and "distribution".

    Raises
    ------
    ValueError
        As ``loop_charts``.
    """
    first = _check(nominal, output, input)
    model = first.controller.model
    y, u = model.y_names[output], model.u_names[input]
    in_y, in_u = (_unit(model.units.get(name, "")) for name in (y, u))
    bands = "median and 95 % band"
    response = Chart(
        "output",
        f"Output: {bands}",
        f"{y}{in_y}",
        _band_clouds(study, nominal, "y", output),
        (Curve("reference r", first.t, first.r[:, output], held=True),),
        _sides(first, "y", output),
    )
    moves = Chart(
        "input",
        f"Input: {bands}",
        f"{u}{in_u}",
        _band_clouds(study, nominal, "u", input),
        limits=_sides(first, "u", input),
    )
    return [
        cloud_chart(study, poles),
        _timed(response, first),
        _timed(moves, first),
        distribution_chart(study, measure, y, first),
    ]


def _band_clouds(
    study: MonteCarlo,
    nominal: Mapping[str, Run],
    signal: Literal["y", "u"],
    channel: int,
) -> tuple[Cloud, ...]:
    clouds = []
    for style, (name, run) in enumerate(nominal.items()):
        alone = getattr(run, signal)[:, channel]
        far = 50.0 * max(float(np.ptp(alone[np.isfinite(alone)])), 1e-9)
        band = study.signals[name].band(signal=signal)[:, :, channel]
        low, middle, high = np.clip(band, -far, far)
        every = slice(None, None, max(1, len(run.t) // DRAWN_POINTS))
        parts = (run.t, middle, low, high, np.clip(alone, -far, far))
        t, middle, low, high, alone = (part[every] for part in parts)
        clouds.append(
            Cloud(name, t, middle, style=style, low=low, high=high, nominal=alone)
        )
    return tuple(clouds)


def cloud_chart(study: MonteCarlo, poles: Mapping[str, Any]) -> Chart:
    """Chart of the closed-loop poles of all realisations, or of as many as one sees."""
    clouds, shown = [], len(study)
    for style, (name, drawn) in enumerate(study.poles.items()):
        there = np.abs(drawn) > ORIGIN
        rows = _rows_shown(drawn, there)
        shown = min(shown, len(rows))
        p, there = drawn[rows].ravel(), there[rows].ravel()
        numbers = np.repeat(study.realisations[rows], drawn.shape[1])
        clouds.append(
            _pole_cloud(name, p[there], numbers[there], style, poles.get(name))
        )
    of = f"{len(study):,} realisations"
    of = of if shown == len(study) else f"{shown:,} of {of}"
    return _z_plane(f"Poles, {of}", clouds)


def _rows_shown(poles: Array, there: Array) -> Array:
    """Rows of the poles that are drawn: the first ones, and the worst."""
    most = max(int(MOST_POLES / max(there.sum(axis=1).mean(), 1.0)), ALWAYS)
    if len(poles) <= most + ALWAYS:
        return np.arange(len(poles))
    radii = np.nan_to_num(np.abs(poles)).max(axis=1)
    worst = np.argsort(radii)[-ALWAYS:]
    rows: Array = np.union1d(np.arange(most), worst)
    return rows


def _pole_cloud(
    name: str, poles: Any, numbers: Array | None, style: int, crosses: Any
) -> Cloud:
    return Cloud(
        name,
        poles.real,
        poles.imag,
        style=style,
        marks=1,
        crosses=crosses,
        numbers=numbers,
    )


def _z_plane(title: str, clouds: Sequence[Cloud]) -> Chart:
    """Chart of points about the unit circle."""
    radii = [np.abs(c.t + 1j * c.values) for c in clouds]
    far = max((float(r[r <= FARTHEST].max(initial=0.0)) for r in radii), default=0.0)
    half = max(1.1, 1.05 * far)
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    circle = Curve("unit circle", np.cos(angle), np.sin(angle))
    return Chart(
        "poles",
        title,
        "imaginary part [-]",
        tuple(clouds),
        (circle,),
        samples=np.array([-half, half]),
        unit="-",
        across="real part",
    )


def locus_chart(loci: Mapping[str, Array], poles: Mapping[str, Any], of: str) -> Chart:
    """Chart of the poles while one factor walks.

    Parameters
    ----------
    loci : mapping of str to array (n, n_poles)
        Poles for each factor, by design.
    poles : mapping of str to complex array
        Poles where the factor is at its bounds, as crosses.
    of : str
        What is multiplied, and how far.
    """
    clouds = [
        _pole_cloud(name, p[~np.isnan(p)], None, style, poles.get(name))
        for style, (name, p) in enumerate(
            (name, np.asarray(locus).ravel()) for name, locus in loci.items()
        )
    ]
    return _z_plane(f"Poles, {of}", clouds)


NAMES_OF_MEASURES = {
    "rise": "rise time [{time}]",
    "settling": "settling time [{time}]",
    "overshoot": "overshoot [%]",
    "radius": "largest pole, modulus [-]",
    "RMS du": "RMS of du",
    "excess": "worst excess over a limit",
    "peak": "peak of abs(y)",
}


def distribution_chart(study: MonteCarlo, measure: str, output: str, run: Run) -> Chart:
    """Chart of the share of realisations whose measure is at most so large."""
    seconds, unit = time_unit(run)
    scale = seconds if measure in ("rise", "settling") else 1.0
    curves, ends, starts = [], [], []
    for style, name in enumerate(study.poles):
        values = ranked(study, name, output, measure)[0] / scale
        share = np.arange(1.0, len(values) + 1.0) / len(values)
        inside = np.isfinite(values)
        x, f = values[inside], share[inside]
        middle = values[len(values) // 2]
        if len(x):
            starts.append(x[0])
            ends.append(x[-1] if not np.isfinite(middle) else min(x[-1], 4.0 * middle))
            every = slice(None, None, max(1, len(x) // DRAWN_POINTS))
            x, f = np.append(x[every], x[-1]), np.append(f[every], f[-1])
            x, f = np.insert(x, 0, x[0]), np.insert(f, 0, 0.0)
        curves.append(Curve(name, np.clip(x, -1e30, 1e30), f, style=style))
    low, high = min(starts, default=0.0), max(ends, default=1.0)
    room = 0.04 * (high - low) or 0.05 * (1.0 + abs(high))
    beyond = [
        f"{100.0 * (1.0 - float(c.values[c.t <= high + room].max(initial=0.0))):.3g} %"
        for c in curves
    ]
    words = NAMES_OF_MEASURES.get(measure, measure)
    where = f"; beyond: {', '.join(beyond)}" if set(beyond) > {"0 %"} else ""
    return Chart(
        "distribution",
        f"Distribution{where}",
        "share [-]",
        tuple(curves),
        samples=np.array([low - room, high + room]),
        unit="",
        across=words.format(time=unit),
    )


def ranked(
    study: MonteCarlo, design: str, output: str, measure: str
) -> tuple[Array, Array]:
    """Values of a measure from the best to the worst, and their realisations.

    What has no value, as a time that never comes, is infinitely bad; equal values are
    ranked by the largest pole.
    """
    table = study.table
    rows = table[(table["design"] == design) & (table["output"] == output)]
    values = rows[measure].to_numpy(float)
    values = np.where(np.isnan(values), np.inf, values)
    order = np.lexsort((np.nan_to_num(rows["radius"].to_numpy(float)), values))
    return values[order], rows["realisation"].to_numpy()[order]


def picked_charts(
    study: MonteCarlo,
    nominal: Mapping[str, Run],
    number: int,
    output: int,
    input: int,
    measure: str,
) -> list[Chart]:
    """Charts of one realisation, to be drawn over those of ``ensemble_charts``."""
    first = _check(nominal, output, input)
    place = int(np.flatnonzero(study.realisations == number)[0])
    rings: list[Curve] = []
    ys: list[Curve] = []
    us: list[Curve] = []
    marks: list[Curve] = []
    name_y = first.controller.model.y_names[output]
    seconds, _ = time_unit(first)
    scale = seconds if measure in ("rise", "settling") else 1.0
    for style, name in enumerate(nominal):
        p = study.poles[name][place]
        p = p[np.abs(p) > ORIGIN]
        rings.append(_pole_cloud(name, p, None, style, None))
        kept = study.signals[name]
        for curves, signal, channel in (
            (ys, kept.y, output),
            (us, kept.u, input),
        ):
            held = signal is kept.u
            alone = nominal[name].u if held else nominal[name].y
            values = _until_far(signal[place, :, channel], alone[:, channel])
            curves.append(Curve(name, kept.t / seconds, values, held, style))
        values, numbers = ranked(study, name, name_y, measure)
        at = int(np.flatnonzero(numbers == number)[0])
        x = np.array([min(float(values[at]) / scale, 1e30)])
        share = np.array([(at + 1.0) / len(values)])
        marks.append(Curve(name, x, share, style=style, marks=1))
    groups = {"poles": rings, "output": ys, "input": us, "distribution": marks}
    return [Chart(name, "", "", tuple(curves)) for name, curves in groups.items()]


def _until_far(values: Array, nominal: Array) -> Array:
    """Values as long as they are within the picture or near it; nan afterwards."""
    low, high = _room(nominal[np.isfinite(nominal)])
    far = ~((values > 2.0 * low - high) & (values < 2.0 * high - low))
    values = values.copy()
    if far.any():
        values[int(np.argmax(far)) + 1 :] = np.nan
    return np.clip(values, -1e30, 1e30)


class EnsembleFigure(EstimateFigure):
    """A figure of many realisations, and over them of one that was picked."""

    def __init__(self, chart: Chart, times: Range1d | None = None) -> None:
        self.thin, self.crosses, self.lines, self.rings = (
            [ColumnDataSource({"t": [], "y": []}) for _ in STYLES] for _ in range(4)
        )
        super().__init__(chart, times)
        self.clouds = [
            renderer
            for renderer in self.figure.renderers
            if str(renderer.name).startswith("points")
        ]
        for number in range(len(STYLES)):
            self._add_picked(number)
        self.figure.add_tools(TapTool(renderers=self.clouds))
        self.figure.add_tools("pan", "wheel_zoom")
        self.figure.toolbar.active_scroll = None

    def _add_picked(self, number: int) -> None:
        style = STYLES[number]
        at = {"x": "t", "y": "y", "line_color": style["color"]}
        cross = Scatter(marker="x", size=12, line_width=2.6, **at)
        shape = {"marker": str(style["marker"]), "fill_color": None}
        ring = Scatter(size=14, line_width=2.4, **shape, **at)
        dots = Line(line_dash=[1, 3 + 2 * number], line_width=1.6, **at)
        thick = Line(line_dash=list(style["dash"]), line_width=4, line_alpha=0.75, **at)
        for name, sources, glyph in (
            ("nominal", self.thin, dots),
            ("cross", self.crosses, cross),
            ("picked", self.lines, thick),
            ("ring", self.rings, ring),
        ):
            _add(self.figure, sources[number], glyph, name=f"{name}{number}")

    def show(self, chart: Chart) -> None:
        """Draw another chart; a realisation that was picked stays."""
        super().show(chart)
        if not chart.unit:
            self.figure.xaxis.axis_label = chart.across
        with_style = {curve.style: curve for curve in chart.curves}
        for style in range(len(STYLES)):
            curve = with_style.get(style)
            thin, crosses = None, None
            if isinstance(curve, Cloud) and curve.nominal is not None:
                thin = Curve("", curve.t, curve.nominal)
            if isinstance(curve, Cloud) and curve.crosses is not None:
                p = np.asarray(curve.crosses)
                crosses = Curve("", p.real, p.imag)
            _fill(self.thin[style], thin)
            _fill(self.crosses[style], crosses)

    def pick(self, chart: Chart | None) -> None:
        """Draw one realisation over all, or none."""
        with_style = {c.style: c for c in chart.curves} if chart else {}
        for style in range(len(STYLES)):
            curve = with_style.get(style)
            _fill(self.lines[style], None if curve is None or curve.marks else curve)
            _fill(self.rings[style], curve if curve and curve.marks else None)


# Structures side by side

FREQUENCIES = np.geomspace(1e-3, 1.0, 240)
"""Shares of Nyquist's frequency at which gains are drawn."""


def comparison_charts(
    scores: Mapping[str, Score], output: int = 0, input: int = 0
) -> list[Chart]:
    """Charts of scored designs side by side.

    Parameters
    ----------
    scores : mapping of str to Score
        Up to three, by name, of one scenario.
    output, input : int
        Which channels are shown over time.

    Returns
    -------
    list of Chart
        Named "output" and "input", over time; "S_o" and "S_i", largest singular
        values over frequency; and "poles", for ``PoleFigure``, with hidden modes.

    Raises
    ------
    ValueError
        As ``loop_charts``.
    """
    runs = {name: score.run for name, score in scores.items()}
    with np.errstate(all="ignore"):  # of loops that run away
        charts = loop_charts(runs, output, input)[:2]
    ends = _where_gone(runs, output)
    response, moves = (_until(chart, ends) for chart in charts)
    clouds = [
        _pole_cloud(name, score.loop.poles, None, style, score.hidden_modes)
        for style, (name, score) in enumerate(scores.items())
    ]
    poles = _z_plane("Poles; crossed: hidden modes", clouds)
    return [response, moves, *_gain_charts(scores), poles]


def _where_gone(runs: Mapping[str, Run], output: int) -> list[float]:
    """Last times at which loops are near, as a chart has them, others in sight."""
    sizes = {name: np.abs(run.y[:, output]) for name, run in runs.items()}
    peaks = [float(np.nan_to_num(size, nan=np.inf).max()) for size in sizes.values()]
    least = min(peaks)
    first = next(iter(runs.values()))
    far = float(np.abs(first.r[:, output]).max())
    far = 10.0 * max(far, least if least < DIVERGED else 0.0, 1e-9)
    ends = []
    for run, size in zip(runs.values(), sizes.values(), strict=True):
        gone = ~(size < far)
        last = int(np.argmax(gone)) if gone.any() else len(run) - 1
        ends.append(float(run.t[last] / time_unit(run)[0]))
    return ends


def _until(chart: Chart, ends: Sequence[float]) -> Chart:
    """Chart whose curves, one a loop, end at given times."""
    curves = []
    for curve in chart.curves:
        there = curve.t <= ends[curve.style]
        cut = dataclasses.replace(curve, t=curve.t[there], values=curve.values[there])
        curves.append(cut)
    return dataclasses.replace(chart, curves=tuple(curves))


def _gain_charts(scores: Mapping[str, Score]) -> list[Chart]:
    """Charts of S_o and S_i up to Nyquist's frequency, where they are finite."""
    first = next(iter(scores.values())).run.controller.model
    omega = FREQUENCIES * np.pi / first.dt
    single = first.n_y == first.n_u == 1
    units = {first.units.get(name, "") for name in (*first.y_names, *first.u_names)}
    unit = "-" if len(units) == 1 else "y/u"
    charts = []
    for which, where, letter, axis in (
        ("S_o", "output", "d_y", "S_o [-]"),
        ("S_i", "input", "d_u", f"S_i [{unit}]"),
    ):
        title = f"Disturbance at the {where} to y"
        title = title if single else f"{letter} to y, largest singular value"
        curves = []
        for style, (name, score) in enumerate(scores.items()):
            gains = score.loop.singular_values(which, omega)[:, 0]  # type: ignore[arg-type]
            there = np.isfinite(gains) & (gains > 0.0)
            t, values = omega[there], gains[there]
            curves.append(Curve(name, t, values, style=style))
        one = (Curve("1", omega[[0, -1]], np.ones(2)),) if which == "S_o" else ()
        charts.append(
            Chart(
                which,
                title,
                axis,
                tuple(curves),
                one,
                samples=omega,
                unit="rad/s",
                across="frequency",
                log=True,
                log_across=True,
            )
        )
    return charts


class PoleFigure(ChartFigure):
    """A figure of poles: open markers, and crosses where modes are hidden."""

    def __init__(self, chart: Chart, times: Range1d | None = None) -> None:
        columns = "t", "y", "modulus"
        self.rings, self.crosses = (
            [ColumnDataSource({key: [] for key in columns}) for _ in STYLES]
            for _ in range(2)
        )
        super().__init__(chart, times)
        drawn = []
        for style, kinds in enumerate(zip(self.rings, self.crosses, strict=True)):
            for kind, source, marker, size in (
                ("ring", kinds[0], STYLES[style]["marker"], 13 + 3 * style),
                ("cross", kinds[1], "x", 13),
            ):
                points = Scatter(
                    x="t",
                    y="y",
                    marker=str(marker),
                    size=size,
                    fill_color=None,
                    line_color=STYLES[style]["color"],
                    line_width=2.2,
                )
                drawn.append(_add(self.figure, source, points, name=f"{kind}{style}"))
        hover = HoverTool(
            renderers=drawn,
            tooltips=[("real", "@t"), ("imaginary", "@y"), ("modulus", "@modulus")],
            mode="mouse",
        )
        self.figure.add_tools(hover, "pan", "wheel_zoom")
        self.figure.toolbar.active_scroll = None

    def show(self, chart: Chart) -> None:
        """Draw other poles."""
        super().show(dataclasses.replace(chart, curves=()))
        low, high = chart.vertical
        self.figure.y_range.update(start=low, end=high)
        with_style = {curve.style: curve for curve in chart.curves}
        for style in range(len(STYLES)):
            curve = with_style.get(style)
            poles = np.zeros(0, dtype=complex)
            poles = poles if curve is None else curve.t + 1j * curve.values
            crosses = getattr(curve, "crosses", None)
            hidden = np.zeros(0, dtype=complex) if crosses is None else crosses
            self.rings[style].data = _place_columns(poles)
            self.crosses[style].data = _place_columns(hidden)


def _place_columns(poles: Any) -> dict[str, Array]:
    """Places of poles and their distance from the origin."""
    columns = {"t": poles.real, "y": poles.imag, "modulus": np.abs(poles)}
    return {key: part.astype(np.float32) for key, part in columns.items()}
