"""All benchmarks, one after the other: ``make bench`` or ``nmss-lab bench``."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence

from frame import Figure

PARTS = (
    "steps",
    "peers",
    "designs",
    "ensembles",
    "state_dependent",
    "identification",
    "imports",
    "pages",
)
"""Benchmarks, in the order in which they run."""


def collect(
    parts: Sequence[str], quick: bool, say: Callable[[str], None]
) -> tuple[list[Figure], list[str]]:
    """Run benchmarks; return their figures, and what went wrong in which.

    One that fails does not end the others.
    """
    figures: list[Figure] = []
    failures = []
    for part in parts:
        try:
            for figure in importlib.import_module(part).measure(quick, say):
                figures.append(figure)
        except (Exception, SystemExit) as error:
            failures.append(f"{part}: {error!r}")
    return figures, failures
