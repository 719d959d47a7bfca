"""Monte Carlo studies: designs on many plants, measures, poles, rates with intervals.

A realisation depends on the seed and its number alone, every design meets the same
realisations, and the work is cut into parts of a fixed size: the numbers are the same
whichever executor computes them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from nmss_lab.analysis import linear_loop
from nmss_lab.controller import Controller, Status
from nmss_lab.design import VARYING, Design
from nmss_lab.measures import measures as measures_of
from nmss_lab.measures import summary
from nmss_lab.models import Array, DifferenceModel, LinearPlant
from nmss_lab.parallel import each
from nmss_lab.simulate import Run, Scenario, loops_of
from nmss_lab.uncertainty import Draw, Uncertainty, realisation

if TYPE_CHECKING:  # half a second, which only who makes a study should wait for
    import pandas as pd

Keep = Literal["measures", "signals", "runs"]
"""What a study keeps of each loop: measures and poles; y and u as well; whole runs."""

PART = 100
"""Realisations in one part of a study."""

ON_CIRCLE = 1e-6
"""Poles of a cancelled factor on the unit circle move by rounding only."""


@dataclass(frozen=True, eq=False)
class Signals:
    """Outputs and inputs of the realisations of one design.

    Parameters
    ----------
    t : array (N,)
        Seconds.
    r : array (N, n_y)
    y, u : arrays (n, N, n_y), (n, N, n_u)
    """

    t: Array
    r: Array
    y: Array
    u: Array

    def band(
        self,
        quantiles: Sequence[float] = (0.025, 0.5, 0.975),
        signal: Literal["y", "u"] = "y",
    ) -> Array:
        """Quantiles over the realisations, (len(quantiles), N, channels).

        Loops that were given up count as infinitely far away, on either side in turn.
        """
        values = self.y if signal == "y" else self.u
        away = np.where(np.arange(len(values)) % 2, -np.inf, np.inf)[:, None, None]
        ranked = np.sort(np.where(np.isnan(values), away, values), axis=0)
        place = [min(int(q * len(ranked)), len(ranked) - 1) for q in quantiles]
        return ranked[place]


@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """Results of a study.

    Parameters
    ----------
    table : DataFrame
        A row for each design, realisation and output: the parameters that were drawn,
        ``radius`` (largest closed-loop pole without limits, nan where the loop is not
        linear), the measures of ``measures.table``, ``peak`` (largest abs(y)),
        ``excess`` (worst violation of a limit), ``failures`` (share of samples at
        which no plan could be made), ``diverged``, and measures of one's own.
    poles : mapping of str to array (n, n_poles)
        Closed-loop poles without limits of every design, in the order of
        ``realisations``; nan fills up where plants differ in size.
    nominal : mapping of str to array
        Poles on each design's own model.
    signals : mapping of str to Signals
        With ``keep="signals"`` or ``"runs"``.
    runs : mapping of str to list of Run
        With ``keep="runs"``.
    realisations : array (n,)
        Numbers of the realisations.
    asked : int
        How many the whole study has.
    seed : int
    """

    table: pd.DataFrame
    poles: Mapping[str, Array]
    nominal: Mapping[str, Array]
    signals: Mapping[str, Signals]
    runs: Mapping[str, list[Run]]
    realisations: Array
    asked: int
    seed: int

    def __len__(self) -> int:
        """Return the number of realisations."""
        return len(self.realisations)

    def rates(self, events: Mapping[str, Event] | None = None) -> pd.DataFrame:
        """How often something happens, with its interval, and how badly.

        A row for each design and event: ``count`` of ``n`` realisations, ``share``
        with its 95 % interval ``low`` to ``high`` (Wilson), and the median and worst
        of the event's measure of severity among them.  A bare count misleads: many
        loops that are just unstable can be less bad than a few that are wildly so.

        Parameters
        ----------
        events : mapping of str to Event, optional
            ``EVENTS`` by default; see also ``beyond`` and ``event``.
        """
        import pandas as pd

        rows = []
        for design, part in self.table.groupby("design", sort=False):
            for name, event in (events or EVENTS).items():
                happens = event.happens(part).groupby(part["realisation"]).any()
                count, n = int(happens.sum()), len(happens)
                worst = part.groupby("realisation")[event.severity].max()[happens]
                low, high = wilson(count, n)
                rows.append(
                    {
                        "design": design,
                        "event": name,
                        "count": count,
                        "n": n,
                        "share": count / n,
                        "low": low,
                        "high": high,
                        "severity": event.severity,
                        "median": worst.median() if count else np.nan,
                        "worst": worst.max() if count else np.nan,
                    }
                )
        return pd.DataFrame(rows)


class Event(NamedTuple):
    """Something that may happen to a loop, and the column that says how badly.

    Parameters
    ----------
    happens : callable
        Takes the table and returns a Series of bool.
    severity : str
        Column of the table.
    """

    happens: Callable[[pd.DataFrame], pd.Series]
    severity: str


def event(column: str, above: float) -> Event:
    """Event that a column of the table is above a level; nan counts as beyond."""
    return Event(lambda table: ~(table[column] <= above), column)


EVENTS: Mapping[str, Event] = {
    "unstable": Event(lambda t: t["radius"] >= 1.0 + ON_CIRCLE, "radius"),
    "breaks a limit": Event(lambda t: t["violations"] > 0, "excess"),
    "diverges": Event(lambda t: t["diverged"], "radius"),
}
"""Events that ``MonteCarlo.rates`` counts by default."""


def wilson(count: int, n: int, z: float = 1.959964) -> tuple[float, float]:
    """Interval of a share ``count / n``, of 95 % by default (Wilson, 1927).

    Raises
    ------
    ValueError
        If ``n`` is not positive or ``count`` is not from 0 to n.

    Examples
    --------
    >>> low, high = wilson(0, 100)
    >>> low, round(high, 3)
    (0.0, 0.037)
    """
    if n < 1 or not 0 <= count <= n:
        raise ValueError(f"count = {count} of n = {n}: expected 0 <= count <= n, n > 0")
    share, z2 = count / n, z * z / n
    middle = (share + z2 / 2.0) / (1.0 + z2)
    half = math.sqrt(z2 * (share * (1.0 - share) + z2 / 4.0)) / (1.0 + z2)
    return (
        max(middle - half, 0.0) if count else 0.0,
        min(middle + half, 1.0) if count < n else 1.0,
    )


def monte_carlo(
    designs: Mapping[str, Design],
    uncertainty: Uncertainty,
    scenario: Scenario,
    n: int | None = None,
    seed: int = 0,
    keep: Keep = "measures",
    measures: Mapping[str, Callable[[Run], float]] | None = None,
    executor: Executor | None = None,
) -> MonteCarlo:
    """Run designs on many plants.

    Parameters
    ----------
    designs : mapping of str to Design
        By a name for display; each meets the same realisations.
    uncertainty : Uncertainty
        What draws the plants: ``RelativeRanges``, ``ParameterCovariance``,
        ``EstimatedModels``, ``Intervals`` or ``Sampler``.
    scenario : Scenario
        The same for all, noise included.
    n : int, optional
        Realisations; 1,000 by default, or all there are (corners).
    seed : int
    keep : "measures", "signals" or "runs"
        What to keep of each loop.  Ten thousand realisations need some 10 MB a design
        with "measures", and 8 bytes for each value of y and u with "signals".
    measures : mapping of str to callable, optional
        Further columns: functions of a Run.
    executor : concurrent.futures.Executor, optional
        See ``nmss_lab.parallel``; results do not depend on it.

    Raises
    ------
    ValueError
        If a design cannot be built or does not fit the plants, or an argument is not
        one of its choices.
    """
    parts = monte_carlo_parts(
        designs, uncertainty, scenario, n, seed, keep, measures, executor
    )
    return join(list(parts))


def monte_carlo_parts(
    designs: Mapping[str, Design],
    uncertainty: Uncertainty,
    scenario: Scenario,
    n: int | None = None,
    seed: int = 0,
    keep: Keep = "measures",
    measures: Mapping[str, Callable[[Run], float]] | None = None,
    executor: Executor | None = None,
) -> Iterator[MonteCarlo]:
    """Run a study part by part; stop whenever you like, and ``join`` what there is.

    Parameters and errors are those of ``monte_carlo``.

    Yields
    ------
    MonteCarlo
        Of up to ``PART`` realisations, as they are done.
    """
    n = _size(uncertainty, n)
    if not designs:
        raise ValueError("designs is empty, expected at least one Design")
    if keep not in ("measures", "signals", "runs"):
        raise ValueError(f'keep = "{keep}": expected "measures", "signals" or "runs"')
    for design in designs.values():
        design.build()  # a design that cannot be built is told before the work begins
    tasks = [
        _Task(
            dict(designs),
            uncertainty,
            scenario,
            range(first, min(first + PART, n)),
            n,
            seed,
            keep,
            dict(measures or {}),
        )
        for first in range(0, n, PART)
    ]
    with closing(each(_part, tasks, executor)) as done:
        for _, part in done:
            yield part


def join(parts: Sequence[MonteCarlo]) -> MonteCarlo:
    """Join parts of one study, in any order.

    Raises
    ------
    ValueError
        If there is none.
    """
    import pandas as pd

    if not parts:
        raise ValueError("parts is empty: no part of the study was finished")
    parts = sorted(parts, key=lambda part: int(part.realisations[0]))
    first = parts[0]
    table = pd.concat([part.table for part in parts], ignore_index=True)
    names = {name: i for i, name in enumerate(first.poles)}
    order = table["design"].map(names)
    table = table.iloc[np.argsort(order.to_numpy(), kind="stable")]
    return MonteCarlo(
        table.reset_index(drop=True),
        {name: _padded([part.poles[name] for part in parts]) for name in names},
        first.nominal,
        {
            name: Signals(
                kept.t,
                kept.r,
                np.concatenate([part.signals[name].y for part in parts]),
                np.concatenate([part.signals[name].u for part in parts]),
            )
            for name, kept in first.signals.items()
        },
        {
            name: list(itertools.chain(*(part.runs[name] for part in parts)))
            for name in first.runs
        },
        np.concatenate([part.realisations for part in parts]),
        first.asked,
        first.seed,
    )


@dataclass(frozen=True, eq=False)
class _Task:
    """Everything that one part of a study needs, on any machine."""

    designs: dict[str, Design]
    uncertainty: Uncertainty
    scenario: Scenario
    realisations: range
    asked: int
    seed: int
    keep: Keep
    measures: dict[str, Callable[[Run], float]] = field(default_factory=dict)


def _part(task: _Task) -> MonteCarlo:
    import pandas as pd

    draws = [realisation(task.uncertainty, i, task.seed) for i in task.realisations]
    rows: list[dict[str, Any]] = []
    poles, nominal, signals, kept = {}, {}, {}, {}
    for name, design in task.designs.items():
        controller = design.build()
        plants = [each_draw.plant for each_draw in draws]
        runs = loops_of(plants, controller, task.scenario, task.keep == "runs")
        nominal[name], poles[name] = _poles(controller, design, draws)
        radii = np.nanmax(np.abs(poles[name]), axis=1, initial=0.0)
        radii[np.isnan(poles[name]).all(axis=1)] = np.nan
        for i, each_draw, run, radius in zip(
            task.realisations, draws, runs, radii.tolist(), strict=True
        ):
            for channel, output in enumerate(controller.model.y_names):
                rows.append(
                    {
                        "design": name,
                        "realisation": i,
                        "output": output,
                        **each_draw.values,
                        "radius": radius,
                        **_measured(run, channel),
                        **{key: of(run) for key, of in task.measures.items()},
                    }
                )
        if task.keep != "measures":
            y, u = np.stack([r.y for r in runs]), np.stack([r.u for r in runs])
            signals[name] = Signals(runs[0].t, runs[0].r, y, u)
        if task.keep == "runs":
            kept[name] = runs
    return MonteCarlo(
        pd.DataFrame(rows),
        poles,
        nominal,
        signals,
        kept,
        np.array(task.realisations),
        task.asked,
        task.seed,
    )


def _poles(
    controller: Controller, design: Design, draws: Sequence[Draw]
) -> tuple[Array, Array]:
    """Poles of the loop without limits, nominal (n_poles,) and drawn (n, n_poles)."""
    linear = all(isinstance(d.plant, LinearPlant | DifferenceModel) for d in draws)
    if design.structure in VARYING or not linear:
        return np.full(1, np.nan + 0j), np.full((len(draws), 1), np.nan + 0j)
    poles = [linear_loop(controller, d.plant).poles for d in draws]
    return linear_loop(controller).poles, _padded([p[None] for p in poles])


def _padded(tables: Sequence[Array]) -> Array:
    """Tables below each other, rows filled up with nan."""
    width = max(table.shape[1] for table in tables)
    missing = (np.full((len(t), width - t.shape[1]), np.nan) for t in tables)
    pairs = zip(tables, missing, strict=True)
    return np.concatenate([np.hstack(pair) for pair in pairs])


def _measured(run: Run, channel: int) -> dict[str, float | bool]:
    """Measures of one loop; what cannot be told of a loop given up is infinite."""
    diverged = bool(np.isnan(run.y).any())
    failed = np.isin(run.status, (Status.SHIFTED, Status.HELD))
    found = measures_of(run, channel)
    worst = [part.worst for part in found.violations.values()]
    if diverged and not np.isfinite(np.hstack(_limits_of_y(run))).any():
        worst.pop()  # y has no limit that it could be beyond
    told: dict[str, float | bool] = {
        **summary(found),
        "peak": float(np.abs(run.y_fine[:, channel]).max()),
        "excess": float(np.max(worst)),
        "failures": float(failed.mean()),
    }
    if diverged:
        told |= {name: np.inf for name, value in told.items() if not np.isfinite(value)}
    return {**told, "diverged": diverged}


def _limits_of_y(run: Run) -> tuple[Array, Array]:
    return run.controller.limits.of("y", run.y.shape[1])


def _size(uncertainty: Uncertainty, n: int | None) -> int:
    """Check n, or choose it."""
    there_are = uncertainty.size
    if n is None:
        return 1000 if there_are is None else there_are
    if n < 1 or n != int(n):
        raise ValueError(f"n = {n}: expected a whole number from 1 on")
    return int(n) if there_are is None else min(int(n), there_are)
