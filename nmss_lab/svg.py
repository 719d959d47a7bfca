"""Charts as SVG: text that any browser shows, prints and saves, without a script.

Lines, bands, points and limits of a ``Chart`` are drawn as ``nmss_lab.plots`` draws
them; ink is the colour of the text around.  Classes such as ``style0`` let a page
choose other colours, as in the dark.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from html import escape
from typing import NamedTuple

import numpy as np

from nmss_lab.models import Array
from nmss_lab.plots import STYLES, Chart, Cloud, Curve

WIDTH, HEIGHT, SQUARE = 480.0, 270.0, 420.0
"""Size of a picture in its own units, and height of one with equal scales."""

LETTER = 7.0
"""Width of a letter, about."""

RIGHT, BOTTOM, LINE = 12.0, 42.0, 19.0
FAR = 9999.0
"""Coordinates beyond are outside of any picture."""


class _Entry(NamedTuple):
    """What a legend says of a kind of line."""

    label: str
    look: str
    kind: str = "line"


class _Frame(NamedTuple):
    """The rectangle that curves are drawn in, and the ranges it shows."""

    left: float
    top: float
    width: float
    height: float
    across: tuple[float, float]
    up: tuple[float, float]
    log: bool

    def x(self, values: Array) -> Array:
        """Horizontal places, from the left of the frame."""
        low, high = self.across
        at: Array = np.clip((values - low) / (high - low) * self.width, -FAR, FAR)
        return at

    def y(self, values: Array) -> Array:
        """Vertical places, from the top of the frame; nan where there is no value."""
        low, high = self.up
        if self.log:
            with np.errstate(invalid="ignore", divide="ignore"):
                low, high, values = np.log10(low), np.log10(high), np.log10(values)
        at: Array = np.clip((high - values) / (high - low) * self.height, -FAR, FAR)
        return at


def svg(chart: Chart, key: str = "") -> str:
    """Draw a chart.

    Parameters
    ----------
    chart : Chart
    key : str
        Beginning of the names of its parts, different for each picture of a page; the
        chart's name by default.

    Returns
    -------
    str
        An ``svg`` element that is a file of its own as well.
    """
    key = escape(key or chart.name)
    entries = _entries(chart)
    rows = _rows(entries)
    square = chart.across == "real part"
    ticks = _ticks(*chart.vertical, log=chart.log, whole=chart.counts)
    left = 30.0 + LETTER * max((len(text) for _, text in ticks), default=1)
    top = 26.0 + LINE * len(rows)
    height = (SQUARE if square else HEIGHT) - top - BOTTOM
    width = WIDTH - left - RIGHT
    frame = _Frame(left, top, width, height, chart.span, chart.vertical, chart.log)
    if square:
        frame = _with_equal_scales(frame)
        ticks = _ticks(*frame.up)
    tall = top + height + BOTTOM
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH:g} {tall:g}" '
            f'role="img" aria-labelledby="{key}-title {key}-text" fill="currentColor" '
            'font-family="system-ui, Helvetica, Arial, sans-serif" font-size="12.5">',
            f'<title id="{key}-title">{escape(chart.title)}</title>',
            f'<desc id="{key}-text">{escape(described(chart))}</desc>',
            f'<text x="2" y="15" font-weight="bold">{escape(chart.title)}</text>',
            *_legend(rows),
            *_axes(chart, frame, ticks),
            # an inner svg cuts off what lies beyond it
            f'<svg x="{left:.4g}" y="{top:g}" width="{width:.4g}" height="{height:g}" '
            'role="presentation">',
            *_content(chart, frame),
            "</svg>",
            "</svg>",
        ]
    )


def described(chart: Chart) -> str:
    """Say in words what a chart shows, for who cannot see it."""
    low, high = (_number(end) for end in chart.span)
    parts = [f"{chart.axis} over {_across(chart)} from {low} to {high}."]
    for curve in (*chart.curves, *chart.references):
        seen = curve.values[np.isfinite(curve.values)]
        if seen.size:
            ends = _number(seen.min()), _number(seen.max()), _number(seen[-1])
            parts.append(
                f"{curve.label}: {ends[0]} to {ends[1]}, at the end {ends[2]}."
            )
    for word, limit in zip(("Lower", "Upper"), chart.limits, strict=True):
        if np.isfinite(limit):
            parts.append(f"{word} limit {_number(limit)}.")
    return " ".join(parts)


def _with_equal_scales(frame: _Frame) -> _Frame:
    """Widen a range so that a circle is round."""
    spans = [high - low for low, high in (frame.across, frame.up)]
    unit = max(spans[0] / frame.width, spans[1] / frame.height)
    wide = []
    for (low, high), size in (
        (frame.across, frame.width),
        (frame.up, frame.height),
    ):
        middle, half = (low + high) / 2.0, unit * size / 2.0
        wide.append((middle - half, middle + half))
    return frame._replace(across=wide[0], up=wide[1])


# What is drawn


def _content(chart: Chart, frame: _Frame) -> Iterator[str]:
    for curve in chart.curves:
        yield from _band(curve, frame)
    for limit in chart.limits:
        if np.isfinite(limit):
            at = float(frame.y(np.array([limit]))[0])
            yield f'<path d="M0 {at:.4g}H{frame.width:.4g}" {_LIMIT}/>'
    for curve in chart.references:
        yield f'<path d="{_path(curve, frame)}" {_INK}/>'
    for curve in chart.curves:
        if curve.marks:
            yield from _points(curve, frame)
        else:
            yield f'<path d="{_path(curve, frame)}" {_look(curve.style)}/>'
        if curve.flagged is not None:
            yield _crosses(curve.flagged, frame, 3.5)
        if isinstance(curve, Cloud):
            yield from _nominal(curve, frame)


_INK = 'fill="none" stroke="currentColor" stroke-width="1.3"'
_LIMIT = f'{_INK} stroke-dasharray="2 4" opacity="0.75"'


def _look(style: int, width: float = 2.0, dash: Sequence[float] | None = None) -> str:
    """Attributes of a line of a run."""
    dash = STYLES[style]["dash"] if dash is None else dash  # type: ignore[assignment]
    dashes = f' stroke-dasharray="{" ".join(map(str, dash))}"' if dash else ""
    return (
        f'class="style{style}" fill="none" stroke="{STYLES[style]["color"]}" '
        f'stroke-width="{width:g}" stroke-linejoin="round"{dashes}'
    )


def _band(curve: Curve, frame: _Frame) -> Iterator[str]:
    if curve.low is None or curve.high is None:
        return
    there = np.isfinite(curve.low) & np.isfinite(curve.high)
    t = curve.t[there]
    edge = Curve(
        "",
        np.concatenate([t, t[::-1]]),
        np.concatenate([curve.low[there], curve.high[there][::-1]]),
    )
    color = STYLES[curve.style]["color"]
    yield (
        f'<path d="{_path(edge, frame)}Z" class="fill{curve.style}" fill="{color}" '
        'opacity="0.2"/>'
    )


def _points(curve: Curve, frame: _Frame) -> Iterator[str]:
    """Draw dots as lines of no length with round ends, the first ones large."""
    large = 0 if isinstance(curve, Cloud) else curve.marks
    for part, size in ((slice(large), 10.0), (slice(large, None), 4.0)):
        x, y = _places(curve.t[part], curve.values[part], frame)
        path = "".join(f"M{a} {b}h0" for a, b in zip(x, y, strict=True))
        if path:
            look = _look(curve.style, size, ())
            yield f'<path d="{path}" {look} stroke-linecap="round" opacity="0.6"/>'


def _nominal(cloud: Cloud, frame: _Frame) -> Iterator[str]:
    if cloud.nominal is not None:
        path = _path(Curve("", cloud.t, cloud.nominal), frame)
        yield f'<path d="{path}" {_look(cloud.style, 1.4, (1, 3))}/>'
    if cloud.crosses is not None:
        p = np.asarray(cloud.crosses)
        yield _crosses(Curve("", p.real, p.imag, style=cloud.style), frame, 5.0)


def _crosses(curve: Curve, frame: _Frame, size: float) -> str:
    x, y = _places(curve.t, curve.values, frame)
    s, d = f"{size:g}", f"{2 * size:g}"
    path = "".join(
        f"M{a} {b}m-{s}-{s}l{d} {d}m0-{d}l-{d} {d}" for a, b in zip(x, y, strict=True)
    )
    return f'<path d="{path}" {_look(curve.style, 1.8, ())}/>'


def _places(t: Array, values: Array, frame: _Frame) -> tuple[list[str], list[str]]:
    x, y = frame.x(t), frame.y(values)
    there = np.isfinite(x) & np.isfinite(y)
    return [f"{a:.4g}" for a in x[there]], [f"{b:.4g}" for b in y[there]]


def _path(curve: Curve, frame: _Frame) -> str:
    """Path of a line, as steps where values hold, with gaps where there is none."""
    x, y = np.round(frame.x(curve.t), 1), np.round(frame.y(curve.values), 1)
    there = np.isfinite(x) & np.isfinite(y)
    # equal neighbours on both sides: a point in the middle of a level stretch
    level = np.zeros(len(y), dtype=bool)
    level[1:-1] = (y[1:-1] == y[:-2]) & (y[1:-1] == y[2:])
    parts: list[str] = []
    pen = ""
    for a, b, seen, inside in zip(x, y, there, level, strict=True):
        if not seen:
            pen = ""
        elif not pen:
            pen = f"M{a:g} {b:g}"
            parts.append(pen)
        elif not inside:
            parts.append(f"H{a:g}V{b:g}" if curve.held else f"L{a:g} {b:g}")
    return "".join(parts)


# Axes and legend


def _axes(
    chart: Chart, frame: _Frame, ticks: Sequence[tuple[float, str]]
) -> Iterator[str]:
    left, top, width, height = frame[:4]
    low, right = top + height, left + width
    yield f'<g stroke="currentColor" fill="none" opacity="0.2" {_THIN}>'
    levels = [(top + float(frame.y(np.array([v]))[0]), text) for v, text in ticks]
    times = [
        (left + float(frame.x(np.array([v]))[0]), text)
        for v, text in _ticks(*frame.across)
    ]
    grid = [f"M{left:.4g} {at:.4g}H{right:.4g}" for at, _ in levels]
    grid += [f"M{at:.4g} {top:.4g}V{low:.4g}" for at, _ in times]
    yield f'<path d="{"".join(grid)}"/></g>'
    frame_line = f"M{left:.4g} {top:.4g}V{low:.4g}H{right:.4g}"
    yield f'<path d="{frame_line}" {_INK} opacity="0.6"/>'
    for at, text in levels:
        yield f'<text x="{left - 6:.4g}" y="{at + 4:.4g}" {_END}>{text}</text>'
    for at, text in times:
        yield f'<text x="{at:.4g}" y="{low + 16:.4g}" {_MIDDLE}>{text}</text>'
    middle = top + height / 2.0
    yield (
        f'<text transform="translate(12 {middle:.4g}) rotate(-90)" {_MIDDLE}>'
        f"{escape(_short(chart.axis, height))}</text>"
    )
    across = escape(_short(_across(chart), width))
    yield (
        f'<text x="{left + width / 2:.4g}" y="{low + 35:.4g}" {_MIDDLE}>{across}</text>'
    )


_THIN, _END, _MIDDLE = 'stroke-width="1"', 'text-anchor="end"', 'text-anchor="middle"'


def _across(chart: Chart) -> str:
    return f"{chart.across} [{chart.unit}]" if chart.unit else chart.across


def _short(text: str, room: float) -> str:
    most = max(int(room / LETTER), 4)
    return text if len(text) <= most else text[: most - 1] + "\u2026"


def _entries(chart: Chart) -> list[_Entry]:
    entries = []
    for curve in chart.curves:
        if curve.marks:
            entries.append(
                _Entry(curve.label, _look(curve.style, 8.0, ()), kind="point")
            )
        else:
            entries.append(_Entry(curve.label, _look(curve.style)))
        if isinstance(curve, Cloud) and curve.nominal is not None:
            look = _look(curve.style, 1.4, (1, 3))
            entries.append(_Entry(f"{curve.label}, nominal plant", look))
    entries += [_Entry(curve.label, _INK) for curve in chart.references]
    low, high = chart.vertical
    if any(low <= limit <= high for limit in chart.limits):
        entries.append(_Entry("limits", _LIMIT))
    return entries


def _rows(entries: Sequence[_Entry]) -> list[list[_Entry]]:
    """Entries of a legend, as many in a row as fit."""
    rows: list[list[_Entry]] = []
    room = 0.0
    for entry in entries:
        entry = entry._replace(label=_short(entry.label, WIDTH - 50.0))
        room -= _width(entry)
        if not rows or room < 0.0:
            rows.append([])
            room = WIDTH - _width(entry)
        rows[-1].append(entry)
    return rows


def _width(entry: _Entry) -> float:
    return 46.0 + LETTER * len(entry.label)


def _legend(rows: Sequence[Sequence[_Entry]]) -> Iterator[str]:
    for i, row in enumerate(rows):
        at = 29.0 + LINE * i
        starts = itertools.accumulate((_width(entry) for entry in row), initial=2.0)
        for x, entry in zip(starts, row, strict=False):
            path = f"M{x:.4g} {at:g}h26"
            look = entry.look
            if entry.kind == "point":
                path, look = f"M{x + 13:.4g} {at:g}h0", f'{look} stroke-linecap="round"'
            yield f'<path d="{path}" {look}/>'
            yield f'<text x="{x + 31:.4g}" y="{at + 4:g}">{escape(entry.label)}</text>'


def _ticks(
    low: float, high: float, log: bool = False, whole: bool = False
) -> list[tuple[float, str]]:
    """Places and labels of ticks at round numbers."""
    if log:
        ends = np.ceil(np.log10(low) - 1e-9), np.floor(np.log10(high) + 1e-9)
        every = max(1, int(np.ceil((ends[1] - ends[0]) / 6.0)))
        powers = np.arange(ends[0], ends[1] + 0.5, every)
        return [(float(10.0**p), _number(float(10.0**p))) for p in powers]
    raw = (high - low) / 6.0
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * min(m for m in (1.0, 2.0, 5.0, 10.0) if m * power >= raw)
    step = max(step, 1.0) if whole else step
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    values = [float(n * step) for n in np.arange(first, last + 0.5)]
    size = max(map(abs, values), default=step)
    digits = max(5, 1 + int(np.ceil(np.log10(size / step + 1.0))))
    return [(value, _number(value, digits)) for value in values]


def _number(value: float, digits: int = 5) -> str:
    """Short text of a number."""
    text = f"{float(value) + 0.0:.{digits}g}"
    if "e" in text:
        mantissa, _, exponent = text.partition("e")
        text = f"{mantissa}e{int(exponent)}"
    return text.replace("-", "\u2212")
