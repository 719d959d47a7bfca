"""Goals as rows of a page, and the bench on which designs are tried."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from apps.session import afford
from nmss_lab.design import Design
from nmss_lab.models import Array
from nmss_lab.simulate import Run, Scenario, closed_loops
from nmss_lab.tuning import Goal, Trial, evaluate

MOST_GOALS = 8

LATEST = 2
"""Designs that a bench has tried last: a search hands them over a little later."""


@dataclass(frozen=True)
class Kind:
    """What an objective is called on the page, and the unit it is shown in."""

    label: str
    unit: str
    each: bool = True
    stepped: bool = False


KINDS = {
    "overshoot": Kind("Overshoot", "%", stepped=True),
    "undershoot": Kind("Undershoot", "%", stepped=True),
    "peak": Kind("Peak of |y|", "y"),
    "rise": Kind("Rise, 10 to 90 %", "time", stepped=True),
    "reach": Kind("Reach 90 %", "time", stepped=True),
    "settling": Kind("Settling, 5 %", "time", stepped=True),
    "IAE": Kind("Error, IAE", "y s"),
    "ISE": Kind("Error, ISE", "y\u00b2 s"),
    "coupling": Kind("Coupling", "y s"),
    "distance": Kind("Distance to 1st order", "y s"),
    "effort": Kind("Effort, RMS of u", "u", each=False),
    "smoothness": Kind("Moves, RMS of \u0394u", "u", each=False),
    "violations": Kind("Limits broken", "a sample", each=False),
    "radius": Kind("Largest pole radius", "-", each=False),
}
"""Objectives that a row may have."""

OVER: Mapping[str, Any] = {"worst": 1.0, "nine in ten": 0.9, "mean": "mean"}
"""How the results of many plants become one number."""


@dataclass(frozen=True)
class Aim:
    """One row: a goal in the objective's own unit.

    Parameters
    ----------
    objective : str
        A name in ``KINDS``.
    output : int
    target : float
    share : float
        By how much the target may be missed for one unit of the attainment factor,
        per cent of the target; 0 for a hard goal.
    tau : float
        Time constant of the desired response in seconds, for "distance".
    """

    objective: str
    output: int
    target: float
    share: float = 100.0
    tau: float = 0.0

    @property
    def key(self) -> str:
        """What is measured, whatever should become of it."""
        tau = f":{self.tau:.6g}" if self.objective == "distance" else ""
        return f"{self.objective}:{self.output}{tau}"

    @property
    def text(self) -> str:
        """The row in an address."""
        tau = f":{self.tau:.6g}" if self.objective == "distance" else ""
        return f"{self.objective}:{self.output}:{self.target:.6g}:{self.share:g}{tau}"

    @property
    def importance(self) -> float:
        """Importance w_i of (5.5)."""
        size = abs(self.target) or (
            0.1 if self.objective in ("overshoot", "undershoot") else 1.0
        )
        return self.share / 100.0 * size


def aims_of(text: str, outputs: int) -> list[Aim]:
    """Read the rows of an address, or of the page.

    Raises
    ------
    ValueError
        Naming the row and what is wrong with it.
    """
    rows = [part for part in text.split(";") if part]
    if not 1 <= len(rows) <= MOST_GOALS:
        raise ValueError(f"{len(rows)} goals: expected 1 to {MOST_GOALS}")
    return [_aim(i + 1, row.split(":"), outputs) for i, row in enumerate(rows)]


def _aim(row: int, parts: Sequence[str], outputs: int) -> Aim:
    if len(parts) not in (4, 5) or parts[0] not in KINDS:
        raise ValueError(
            f"goal {row} is {':'.join(parts)!r}: expected objective:output:target:"
            f"importance with one of {', '.join(KINDS)}"
        )
    try:
        output = int(parts[1])
        target, share, *tau = (float(part) for part in parts[2:])
    except ValueError as error:
        raise ValueError(f"goal {row}, {parts[0]}: {error}") from error
    if not 0 <= output < outputs:
        raise ValueError(f"goal {row}: output {output} is none of 0 to {outputs - 1}")
    if not np.isfinite(target) or abs(target) > 1e12:
        raise ValueError(f"goal {row}: target {parts[2]} is not a usable number")
    if not 0.0 <= share <= 1000.0:
        raise ValueError(f"goal {row}: importance {parts[3]} %, expected 0 to 1000")
    if parts[0] == "distance" and not (tau and 0.0 < tau[0] < 1e9):
        raise ValueError(f"goal {row}: distance needs a time constant above 0")
    return Aim(parts[0], output, target, share, *tau)


class Heard:
    """A scenario of which somebody hears at each sample, who may end the loops.

    Loops in lock step have no plant of their own that could tell; but at each sample
    they ask for the limits of the actuator.
    """

    def __init__(self, scenario: Scenario, hears: Callable[[], None]) -> None:
        self._scenario, self._hears = scenario, hears

    def __getattr__(self, name: str) -> Any:
        return getattr(self._scenario, name)

    def __len__(self) -> int:
        return len(self._scenario)

    @property
    def actuator(self) -> Any:
        """Limits of the actuator; asked for once a sample."""
        self._hears()
        return self._scenario.actuator


class Bench:
    """What designs are tried on; each is run once.

    Parameters
    ----------
    trials : sequence of Trial
    plant : LinearPlant
        The one that pictures show.
    start : Design
        The one to begin with.
    """

    def __init__(self, trials: Sequence[Trial], plant: Any, start: Design) -> None:
        self.trials, self.plant, self.start = list(trials), plant, start
        self.suggested: list[Aim] = []
        self._values: dict[tuple[Design, str], float] = {}
        self._runs: dict[Design, list[Run]] = {}

    @property
    def samples(self) -> int:
        """Samples of all loops of a design: those of its goals, and the one shown."""
        plants = len(self.trials[0].all_plants)
        return sum(len(trial.scenario) for trial in self.trials) * (plants + 1)

    def prepare(
        self,
        goals: Mapping[Design, Mapping[str, Goal]],
        hears: Callable[[float], None] | None = None,
    ) -> None:
        """Try designs, each with goals by key, as far as they are not known.

        Parameters
        ----------
        hears : callable, optional
            Hears which share is done, and may end it by raising.

        Raises
        ------
        ValueError
            If a design cannot be built or does not fit, or all would take too long.
        """
        new = [design for design, of in goals.items() if not self._knows(design, of)]
        self._afford(new)
        total, done = len(new) * self.samples, 0

        def heard(loops: int) -> None:
            nonlocal done
            done += loops
            if hears is not None:
                hears(min(done / total, 1.0))

        for number, design in enumerate(new):
            done = number * self.samples  # goals may not need all trials
            self.values(design, goals[design], heard)
            self.runs(design, heard)

    def _knows(self, design: Design, goals: Mapping[str, Goal]) -> bool:
        known = all((design, key) in self._values for key in goals)
        return known and design in self._runs

    def _afford(self, designs: Sequence[Design]) -> None:
        """Refuse to try designs, all of them like each, for more than some ten seconds.

        Raises
        ------
        ValueError
            Saying by how much, and what to lower.
        """
        many = len(self.trials[0].all_plants) > 1
        for design in designs:
            try:
                afford({"design": design}, len(designs) * self.samples)
            except ValueError as error:
                fewer = ", or choose fewer plants" if many else ""
                raise ValueError(f"{error}{fewer}") from error

    def values(
        self,
        design: Design,
        goals: Mapping[str, Goal],
        heard: Callable[[int], None] | None = None,
    ) -> dict[str, float]:
        """Objectives of a design by key, nan where one cannot be told.

        Parameters
        ----------
        heard : callable, optional
            Takes the number of loops that have gone on by one sample.

        Raises
        ------
        ValueError
            If the design cannot be built or does not fit.
        """
        new = {k: g for k, g in goals.items() if (design, k) not in self._values}
        if new:
            with np.errstate(all="ignore"):
                found = evaluate(design, list(new.values()), self._heard(heard))
            for key, value in zip(new, found, strict=True):
                self._values[design, key] = float(value)
        return {key: self._values[design, key] for key in goals}

    def _heard(self, heard: Callable[[int], None] | None) -> list[Trial]:
        """Trials whose samples are heard of."""
        if heard is None:
            return self.trials
        loops: Callable[[], None] = partial(heard, len(self.trials[0].all_plants))
        return [
            Trial(trial.plants, Heard(trial.scenario, loops))  # type: ignore[arg-type]
            for trial in self.trials
        ]

    def know(self, design: Design, values: Mapping[str, float]) -> None:
        """Take over what a search has found out already."""
        self._values |= {(design, key): value for key, value in values.items()}

    def runs(
        self, design: Design, heard: Callable[[int], None] | None = None
    ) -> list[Run]:
        """Run the plant that is shown, once a trial; for ``heard`` see ``values``."""
        if design not in self._runs:
            controller = design.build()
            scenarios: list[Any] = [trial.scenario for trial in self.trials]
            if heard is not None:
                scenarios = [Heard(each, partial(heard, 1)) for each in scenarios]
            with np.errstate(all="ignore"):
                self._runs[design] = [
                    closed_loops([self.plant], controller, scenario)[0]
                    for scenario in scenarios
                ]
        return self._runs[design]

    def forget(self, keep: Sequence[Design]) -> None:
        """Drop designs that are no longer shown; the latest are about to be."""
        for design in [d for d in list(self._runs)[:-LATEST] if d not in keep]:
            self._runs.pop(design, None)
        for pair in list(self._values):
            if pair[0] not in keep and pair[0] not in self._runs:
                self._values.pop(pair, None)


def gain_of(text: str, n_u: int, n_x: int) -> Array:
    """Read a gain: numbers with commas, rows of further inputs after semicolons.

    Raises
    ------
    ValueError
        Saying which number is none, or how many were expected.
    """
    rows = []
    for number, row in enumerate(text.replace("\u2212", "-").split(";"), 1):
        values = []
        for place, part in enumerate(filter(None, row.replace(",", " ").split()), 1):
            try:
                values.append(float(part))
            except ValueError as error:
                raise ValueError(
                    f"gain K, row {number}, number {place}: {part!r} is no number"
                ) from error
        rows.append(values)
    if len(rows) != n_u or any(len(row) != n_x for row in rows):
        have = f"{len(rows)} x {len(rows[0])}"
        raise ValueError(
            f"gain K has {have} numbers, expected {n_u} x {n_x}: one row an input, one "
            "number a state of (3.2); commas between numbers, semicolons between rows"
        )
    K = np.array(rows)
    if not np.isfinite(K).all():
        raise ValueError("gain K holds a number that is not finite")
    return K
