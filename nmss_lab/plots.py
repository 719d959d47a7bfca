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
from typing import Any

import numpy as np
from bokeh.layouts import gridplot
from bokeh.models import (
    ColumnDataSource,
    CustomJSTickFormatter,
    DataRange1d,
    GridPlot,
    HoverTool,
    Legend,
    Range1d,
    Span,
)
from bokeh.plotting import figure

from nmss_lab.controller import Status
from nmss_lab.models import Array
from nmss_lab.predictive import PredictiveController
from nmss_lab.simulate import Run

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
    """

    label: str
    t: Array
    values: Array
    held: bool = False
    style: int = 0
    trail: Array | None = None
    ahead: int = 0
    present: Array | None = None


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
        values = np.concatenate([c.values for c in (*self.curves, *self.references)])
        low, high = float(values.min()), float(values.max())
        if self.counts:
            low, high = 0.0, max(high, 1.0)
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
    """Charts of a loop with a governor, the first run, beside the loop without.

    Returns
    -------
    list of Chart
        Named "output", "input", "increment", "reference" and "beta".

    Raises
    ------
    ValueError
        As ``loop_charts``, or if the first run has no governor.
    """
    plain = loop_charts(runs, output, input)[:3]
    name, governed = next(iter(runs.items()))
    ahead = 0 if getattr(governed.controller, "causal", True) else 1
    model = governed.controller.model
    unit = _unit(model.units.get(model.y_names[output], ""))
    t, r, w = governed.t, governed.r[:, output], governed.w[:, output]
    planned_w = governed.trail("w")[:, :, output]
    planned_beta = governed.trail("beta")[:, :, output]
    reference = Chart(
        "reference",
        "Reference r and governed w",
        f"r, w{unit}",
        (Curve(f"w, {name}", t, w, True, 0, planned_w, ahead),),
        (Curve("reference r", t, r, held=True),),
    )
    beta = Chart(
        "beta",
        "Perturbation of the reference",
        f"\u03b2 = w \u2212 r{unit}",
        (Curve(f"beta, {name}", t, w - r, True, 0, planned_beta, ahead),),
        (Curve("zero", t, np.zeros(len(t)), held=True),),
    )
    return [*plain, *(_timed(chart, governed) for chart in (reference, beta))]


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
    seconds = float(run.t[-1])
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
    names = {"u": model.u_names, "du": model.u_names, "y": model.y_names}

    def key(row: Any) -> tuple[str, int]:
        return row.name, row.channel

    parts = []
    for (name, channel), group in itertools.groupby(sorted(rows, key=key), key):
        steps = sorted(row.step for row in group)
        known = names.get(name)
        label = known[channel] if known else "end"
        before = {"du": "change of ", "u": "", "y": ""}.get(name, f"{name} ")
        parts.append(f"{before}{label} {_steps(steps)}")
    return f"At a limit: {'; '.join(parts)}."


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
        self.figure = _empty_figure(chart.name, times or Range1d(*chart.span))
        self.curves = [ColumnDataSource({"t": [], "y": []}) for _ in STYLES]
        self.references = ColumnDataSource({"t": [], "y": []})
        self._lines = [
            _add_line(self.figure, source, number)
            for number, source in enumerate(self.curves)
        ]
        ink = self.figure.line(
            "t", "y", source=self.references, color=INK, width=1.4, level="overlay"
        )
        ink.name = "ink"
        self.limits = [_limit_line() for _ in range(2)]
        for line in self.limits:
            self.figure.add_layout(line)
        hover = HoverTool(
            renderers=self._lines,
            tooltips=[("time", "@t{0.00}"), ("value", "@y{0.0000}")],
            mode="mouse",
        )
        self.figure.add_tools(hover)
        if chart.counts:
            self.figure.yaxis[0].ticker.min_interval = 1
        self.show(chart)

    def show(self, chart: Chart) -> None:
        """Draw another chart."""
        with_style = {curve.style: curve for curve in chart.curves}
        for style, source in enumerate(self.curves):
            _fill(source, with_style.get(style))
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
        self.figure.xaxis.axis_label = f"time [{chart.unit}]"
        self.figure.title.text = chart.title


def _empty_figure(name: str, times: Range1d | DataRange1d) -> figure:
    plot = figure(
        name=name,
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
    return plot.line(
        "t",
        "y",
        source=source,
        color=style["color"],
        width=2.2,
        line_dash=list(style["dash"]),
        line_join="round",
        name=f"style{number}",
    )


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
