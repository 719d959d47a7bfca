"""What the benchmarks share: a figure, the machine it was measured on, tables of both.

Every figure is a ratio of two medians that were measured in the same process and in
turns; lower is better.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import importlib.metadata
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

USED = (
    "nmss-lab",
    "numpy",
    "scipy",
    "daqp",
    "proxsuite",
    "qpsolvers",
    "quadprog",
    "qpmpc",
    "do-mpc",
    "casadi",
    "panel",
    "bokeh",
    "playwright",
)
"""Distributions whose versions are told, if they are installed."""


@dataclass(frozen=True)
class Figure:
    """One comparison.

    Parameters
    ----------
    part, name : str
        Where it belongs, and what was measured.
    unit : str
        Of the four numbers.
    baseline : str
        What it is compared with.
    value, p99 : float
        Median and 99th percentile of ours.
    against, against_p99 : float
        The same of the baseline.
    size : str
        What was run.
    target : str
        What the ratio shall be, in words.
    bound : float, optional
        Largest ratio that meets the target.
    note : str
    """

    part: str
    name: str
    unit: str
    baseline: str
    value: float
    p99: float
    against: float
    against_p99: float
    size: str
    target: str = ""
    bound: float | None = None
    note: str = ""

    @property
    def ratio(self) -> float:
        """Ours as a multiple of the baseline."""
        return self.value / self.against

    @property
    def met(self) -> bool | None:
        """Whether the target is met; None where there is none."""
        return None if self.bound is None else bool(self.ratio <= self.bound)


def compared(
    part: str,
    name: str,
    size: str,
    ours: Sequence[float],
    baseline: str,
    theirs: Sequence[float],
    unit: str = "us",
    **more: Any,
) -> Figure:
    """Figure of two samples of measured values."""
    return Figure(
        part,
        name,
        unit,
        baseline,
        float(np.median(ours)),
        float(np.percentile(ours, 99)),
        float(np.median(theirs)),
        float(np.percentile(theirs, 99)),
        size,
        **more,
    )


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Keep the collector of garbage from falling into what is timed."""
    gc.collect()
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def in_turns(
    tasks: Mapping[str, Callable[[], Any]],
    rounds: int,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[dict[str, list[float]], dict[str, Any]]:
    """Seconds of each task in every round, and what it returned last."""
    times: dict[str, list[float]] = {name: [] for name in tasks}
    results = {}
    with uncollected():
        for _ in range(rounds):
            for name, task in tasks.items():
                begin = clock()
                results[name] = task()
                times[name].append(clock() - begin)
    return times, results


def processor() -> str:
    """Name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if "model name" in line]
    return names[0] if names else platform.processor() or "unknown"


def machine() -> dict[str, Any]:
    """Tell the processor, the system and the versions."""
    versions = {"python": platform.python_version()}
    for name in USED:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "processor": processor(),
        "processors": os.cpu_count(),
        "system": platform.system(),
        "versions": versions,
    }


def as_json(figures: Iterable[Figure]) -> dict[str, Any]:
    """Machine and figures, for ``json.dump``."""
    rows = [
        {**dataclasses.asdict(figure), "ratio": figure.ratio, "met": figure.met}
        for figure in figures
    ]
    return {"machine": machine(), "figures": rows}


HERE = Path(__file__).resolve().parent
PICTURES = {
    "Design": (
        ("Time to build a controller over the horizon", "growth_Np.svg"),
        ("Time to build a controller over the length of the state", "growth_n_x.svg"),
    )
}
"""Pictures that a benchmark draws beside its figures."""

HEAD = (
    "| What | Ran | Ours: median (p99) | Baseline | Its median (p99) | Ratio | Target |"
)
RULE = "|" + "---|" * (HEAD.count("|") - 1)


def line(figure: Figure) -> str:
    """Figure as a row of a table."""
    ours = f"{figure.value:.3g} ({figure.p99:.3g}) {figure.unit}"
    theirs = f"{figure.against:.3g} ({figure.against_p99:.3g}) {figure.unit}"
    verdict = {None: "", True: ": met", False: ": **missed**"}[figure.met]
    cells = (
        figure.name + (f" ({figure.note})" if figure.note else ""),
        figure.size,
        ours,
        figure.baseline,
        theirs,
        f"{figure.ratio:.3g}",
        f"{figure.target}{verdict}",
    )
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def markdown(figures: Sequence[Figure]) -> str:
    """Tables of all figures, one a part."""
    here = machine()
    versions = ", ".join(f"{name} {at}" for name, at in here["versions"].items())
    lines = [
        "# Results of the benchmarks",
        "",
        "Written by `make bench`. A ratio is the median of ours as a multiple of the "
        "baseline's, both measured in turns in this run; lower is better.",
        "",
        f"{here['processor']}, {here['processors']} processors, {here['system']}; "
        f"{versions}.",
    ]
    for part in dict.fromkeys(figure.part for figure in figures):
        lines += ["", f"## {part}", "", HEAD, RULE]
        lines += [line(figure) for figure in figures if figure.part == part]
        for title, name in PICTURES.get(part, ()):
            if (HERE / name).exists():
                lines += ["", f"![{title}]({name})"]
    return "\n".join(lines) + "\n"


def show(measure: Callable[[], Iterable[Figure]]) -> None:
    """Print the figures of one benchmark as they come."""
    print(HEAD)
    for figure in measure():
        print(line(figure), flush=True)
