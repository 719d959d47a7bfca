"""Cross-coupling: every output for a step of every reference, in a grid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import param
from panel.custom import JSComponent

from apps.player import STYLE, script
from nmss_lab.models import Array
from nmss_lab.simulate import Run

POINTS = 120
"""Points of a curve in a cell, at about."""


class Coupling(JSComponent):
    """Small plots of every output for a step of every reference."""

    grid = param.Dict(default={})

    _esm = script("coupling.js")
    _stylesheets = (STYLE,)


def cells(
    runs: Sequence[Sequence[Run]], references: Sequence[Array], clock: tuple[float, str]
) -> dict[str, Any]:
    """Gather what ``Coupling`` draws.

    Parameters
    ----------
    runs : sequence of designs, each a sequence of Run
        One run a trial; trial i steps the reference of output i.
    references : sequence of arrays (N, n_y)
    clock : pair (seconds, name)
        Unit of time.
    """
    first = runs[0][0]
    model, (seconds, unit) = first.controller.model, clock
    every = max(1, len(first) // POINTS)
    outputs = range(model.n_y)
    ends = [
        _ends(np.concatenate([r.y[:, k] for each in runs for r in each]), references, k)
        for k in outputs
    ]
    return {
        "rows": list(model.y_names),
        "outputs": list(model.y_names),
        "units": [model.units.get(name, "") or "-" for name in model.y_names],
        "unit": unit,
        "t": (first.t[::every] / seconds).tolist(),
        "low": [low for low, _ in ends],
        "high": [high for _, high in ends],
        "references": [[_plain(r[::every, k]) for k in outputs] for r in references],
        "cells": [
            [[_plain(each[i].y[::every, k]) for each in runs] for k in outputs]
            for i in range(len(references))
        ],
    }


def _ends(y: Array, references: Sequence[Array], k: int) -> tuple[float, float]:
    """Give the scale of an output: over all designs and steps."""
    values = np.concatenate([y, *(r[:, k] for r in references)])
    values = np.clip(values[np.isfinite(values)], -1e6, 1e6)
    room = 0.05 * max(float(np.ptp(values)), 1e-9)
    return float(values.min()) - room, float(values.max()) + room


def _plain(values: Array) -> list[float | None]:
    """Numbers for the browser, None where there is none."""
    return [float(f"{x:.5g}") if np.isfinite(x) else None for x in values]
