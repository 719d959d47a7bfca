"""The constraint microscope: which limits hold the plan of a sample, and why."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import param
from panel.custom import JSComponent

from apps.player import STYLE, script
from nmss_lab.plots import row_in_words
from nmss_lab.predictive import PredictiveController
from nmss_lab.prices import Price, prices
from nmss_lab.simulate import Run

MOST = 6
"""Limits of a sample that are shown, the dearest ones."""


class Microscope(JSComponent):
    """A table of the limits that hold the plan of the player's sample.

    ``seen`` comes from the server with each run: see ``magnified``.
    """

    seen = param.Dict(default={})

    _esm = script("microscope.js")
    _stylesheets = (STYLE,)


WIDTH = 5
"""Numbers for each limit."""


def magnified(
    runs: Mapping[str, Run],
    input: int,
    hears: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Gather the prices of all samples, for ``Microscope``.

    Parameters
    ----------
    runs : mapping of str to Run
    input : int
        The input whose moves are shown.
    hears : function of a share, optional
        Hears at each sample which share of them is done, and may end it by raising.

    Returns
    -------
    dict
        "samples", "input" and its "unit"; "runs", each with its "name", whether it
        "plans", the limits in words ("rows"), and for every sample the number of
        limits ("counts") and of those not shown ("more"); "data" holds for each limit
        its row, saving, share of the cost, reach and move, float32.
    """
    first = next(iter(runs.values()))
    count, total = itertools.count(1), sum(map(len, runs.values()))

    def heard() -> None:
        if hears is not None:
            hears(next(count) / total)

    name = first.controller.model.u_names[input]
    return {
        "samples": len(first),
        "width": WIDTH,
        "input": name,
        "unit": first.controller.model.units.get(name, ""),
        "runs": [_of(name, run, input, heard) for name, run in runs.items()],
    }


def _of(name: str, run: Run, input: int, heard: Callable[[], None]) -> dict[str, Any]:
    model = run.controller.model
    texts: dict[tuple[str, ...], int] = {}
    counts, more, data = [], [], []
    for k in range(len(run)):
        heard()
        found = prices(run, k)
        counts.append(len(found[:MOST]))
        more.append(len(found) - counts[-1])
        for price in found[:MOST]:
            number = texts.setdefault(_in_words(price, model), len(texts))
            share = price.saving / run.cost[k] if run.cost[k] > 0.0 else np.nan
            move = price.move[input]
            move = 0.0 if abs(move) < 1e-9 else move
            data.append([number, price.saving, share, price.up_to, move])
    return {
        "name": name,
        "plans": isinstance(run.controller, PredictiveController),
        "rows": list(texts),
        "counts": counts,
        "more": more,
        "data": np.array(data, np.float32).ravel(),
    }


def _in_words(price: Price, model: Any) -> tuple[str, str, str]:
    """Limit in words, its step, and its unit."""
    label, unit = row_in_words(price.row, model)
    side = "\u2264" if price.upper else "\u2265"
    limit = f"{price.limit:.4g}".replace("-", "\u2212")
    return f"{label} {side} {limit} {unit}".strip(), str(price.row.step), unit
