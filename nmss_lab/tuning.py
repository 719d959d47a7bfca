r"""Tuning by goals: the goal attainment method (thesis 5.2), for every structure.

.. math:: \min_{\lambda, f} \lambda \quad\text{subject to}\quad
          F_i(f) - w_i \lambda \le F_i^*, \qquad f \in \Omega

with objectives :math:`F_i`, goals :math:`F_i^*` and importances :math:`w_i`; a goal
with :math:`w_i = 0` is hard.  A negative attainment factor :math:`\lambda` says that
every goal is more than reached.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
import scipy.optimize

from nmss_lab.analysis import linear_loop
from nmss_lab.controller import Controller
from nmss_lab.design import Design
from nmss_lab.measures import measures, steps, violations
from nmss_lab.models import Array
from nmss_lab.parallel import in_order
from nmss_lab.simulate import Run, Scenario, loops_of
from nmss_lab.weights import Weights

NOT_REACHED = 1e3
"""Attainment counted for an objective that is not finite, or a broken hard goal."""


PASSES = 25
"""Passes of the quadratic programming before it starts again where it has come to."""


@dataclass(frozen=True, eq=False)
class Trial:
    """What a design is tried on: a scenario, with one plant or an ensemble.

    Parameters
    ----------
    plants : plant, model, or sequence of linear plants
    scenario : Scenario
    """

    plants: Any
    scenario: Scenario

    def runs(self, controller: Controller) -> list[Run]:
        """Run the controller on every plant."""
        return loops_of(self.all_plants, controller, self.scenario)

    @property
    def all_plants(self) -> list[Any]:
        """Plants as a list."""
        many = isinstance(self.plants, Sequence)
        return list(self.plants) if many else [self.plants]


Objective = Callable[[Run], float]
"""A measure of a run, the smaller the better."""


@dataclass(frozen=True, eq=False)
class Goal:
    """One objective, what it should become, and how much it matters to miss that.

    Parameters
    ----------
    objective : str or callable
        A name in ``OBJECTIVES``, "radius" (largest closed-loop pole without limits),
        or a function of a Run, such as ``Distance``; a function of a module where an
        executor is used.
    target : float
        In the objective's own unit; smaller values are better.
    importance : float, optional
        By how much the target may be missed for one unit of the attainment factor; 0
        for a hard goal.  ``abs(target)``, or 1 for a target of 0, by default.
    channel : int
        Output that is looked at.
    trial : int, optional
        Number of the trial; None for the runs of all trials together.
    over : float or "mean"
        Quantile over the runs, such as the plants of an ensemble: 1, the worst, by
        default.
    name : str
        For display; made of the others by default.
    """

    objective: str | Objective
    target: float
    importance: float | None = None
    channel: int = 0
    trial: int | None = 0
    over: float | Literal["mean"] = 1.0
    name: str = ""

    def __post_init__(self) -> None:
        """Check what can be checked without a run."""
        named = isinstance(self.objective, str)
        if named and self.objective not in (*OBJECTIVES, "radius"):
            raise ValueError(
                f'objective "{self.objective}": expected one of '
                f"{', '.join(OBJECTIVES)}, radius, or a function of a Run"
            )
        if not np.isfinite(self.target):
            raise ValueError(f"target = {self.target} is not finite")
        if self.importance is not None and not 0.0 <= self.importance < np.inf:
            raise ValueError(f"importance = {self.importance}: expected 0 or more")
        if self.over != "mean" and not 0.0 <= self.over <= 1.0:
            raise ValueError(
                f'over = {self.over}: expected "mean" or a quantile from 0 to 1'
            )

    @property
    def weight(self) -> float:
        """Importance w_i of (5.5)."""
        if self.importance is not None:
            return self.importance
        return abs(self.target) or 1.0

    @property
    def is_hard(self) -> bool:
        """Whether the goal must be met."""
        return self.weight == 0.0

    @property
    def label(self) -> str:
        """Name for display."""
        plain = self.objective if isinstance(self.objective, str) else "own measure"
        return self.name or f"{plain}, output {self.channel + 1}"

    def attainment(self, value: float) -> float:
        """Missed share of the importance: negative where the goal is more than met.

        Of a hard goal: the miss relative to the target, 0 where it is met.
        """
        missed = value - self.target
        if not np.isfinite(missed):
            return NOT_REACHED
        if self.is_hard:
            return max(missed, 0.0) / (abs(self.target) or 1.0)
        return missed / self.weight


def _steps_worst(name: str) -> Callable[[Run, int], float]:
    """Worst of a measure over all steps of the reference."""

    def worst(run: Run, channel: int) -> float:
        found = [float(getattr(step, name)) for step in steps(run, channel)]
        # An event that never came counts as one after twice the whole run.
        late = 2.0 * len(run) * run.controller.model.dt
        return max((late if np.isnan(x) else x for x in found), default=np.nan)

    return worst


OBJECTIVES: Mapping[str, Callable[[Run, int], float]] = {
    "overshoot": _steps_worst("overshoot"),
    "undershoot": lambda run, channel: (
        -min((step.undershoot for step in steps(run, channel)), default=np.nan)
    ),
    "peak": lambda run, channel: float(np.abs(run.y_fine[:, channel]).max()),
    "rise": _steps_worst("rise"),
    "reach": _steps_worst("t90"),
    "settling": _steps_worst("settling"),
    "IAE": lambda run, channel: measures(run, channel).iae,
    "ISE": lambda run, channel: measures(run, channel).ise,
    "coupling": lambda run, channel: measures(run, channel).coupling,
    "effort": lambda run, channel: float(np.sqrt(np.mean(run.u**2))),
    "smoothness": lambda run, channel: float(np.sqrt(np.mean(run.du**2))),
    "violations": lambda run, channel: (
        sum(part.samples for part in violations(run).values()) / len(run)
    ),
}
"""Objectives by name: functions of a run and the number of an output.

Over several steps the worst one counts.  overshoot, undershoot: shares of the step;
peak: largest abs(y); rise (10 to 90 %), reach (to 90 %), settling (5 %): seconds; IAE,
ISE, coupling: integrals of the error (coupling: while only other references changed);
effort, smoothness: RMS of u and of du; violations: broken limits a sample.
"""


@dataclass(frozen=True, eq=False)
class Distance:
    """Objective: integral of abs(y - desired), as in Table 5.2.

    Parameters
    ----------
    desired : array (N,) or (N, n_y)
    channel : int
        Output that is looked at; all together by default.
    """

    desired: Array
    channel: int | None = None

    def __call__(self, run: Run) -> float:
        """Sum over the samples times the sampling interval."""
        desired = np.reshape(self.desired, (len(self.desired), -1))
        if len(desired) != len(run):
            raise ValueError(
                f"desired has {len(desired)} samples, the run has {len(run)}"
            )
        y = run.y if self.channel is None else run.y[:, [self.channel]]
        wanted = desired[:, [self.channel or 0]] if desired.shape[1] > 1 else desired
        wanted = desired if self.channel is None else wanted
        return float(np.abs(y - wanted).sum() * run.controller.model.dt)


@dataclass(frozen=True, eq=False)
class Step:
    """Best design so far, as a search goes on.

    Parameters
    ----------
    evaluation : int
        Designs tried so far.
    attainment : float
    values : array (goals,)
        Objectives of the best design.
    weights : mapping of str to array
    """

    evaluation: int
    attainment: float
    values: Array
    weights: Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class Tuned:
    """Outcome of a search.

    Parameters
    ----------
    design : Design
        With the best weights found.
    attainment : float
        Factor of (5.5) that it reaches: at most 0 when every goal is met.
    goals : tuple of Goal
    before, values : arrays (goals,)
        Objectives of the design at the start, and of the tuned one.
    weights : mapping of str to array
    history : tuple of Step
        Every improvement.
    evaluations : int
        Designs that were tried.
    stopped : str
        Why the search ended, a sentence.
    """

    design: Design
    attainment: float
    goals: tuple[Goal, ...]
    before: Array
    values: Array
    weights: Mapping[str, Array]
    history: tuple[Step, ...]
    evaluations: int
    stopped: str

    @property
    def is_attained(self) -> bool:
        """Whether every goal is met, to 1e-6 of its importance."""
        return self.attainment <= 1e-6

    def table(self) -> list[dict[str, Any]]:
        """Rows for display, one a goal: ``missed`` is negative where it is met."""
        return [
            {
                "goal": goal.label,
                "target": goal.target,
                "hard": goal.is_hard,
                "before": float(before),
                "after": float(value),
                "missed": float(value) - goal.target,
                "attainment": goal.attainment(value),
            }
            for goal, before, value in zip(
                self.goals, self.before, self.values, strict=True
            )
        ]


def evaluate(design: Design, goals: Sequence[Goal], trials: Sequence[Trial]) -> Array:
    """Objectives (goals,) of a design, nan where one cannot be told.

    Raises
    ------
    ValueError
        If the design cannot be built or does not fit a trial.
    """
    controller = design.build()
    runs: dict[int, list[Run]] = {}
    values = []
    for goal in goals:
        numbers = range(len(trials)) if goal.trial is None else [goal.trial]
        for i in numbers:
            if i not in runs:
                runs[i] = trials[i].runs(controller)
        found = [
            value
            for i in numbers
            for value in _objectives(goal, controller, trials[i], runs[i])
        ]
        values.append(_summed_up(goal, found))
    return np.array(values)


def attained(goals: Sequence[Goal], values: Array) -> float:
    """Attainment factor of (5.5) for values of the objectives.

    It is at least ``NOT_REACHED`` times the miss where a hard goal is missed.
    """
    pairs = list(zip(goals, values, strict=True))
    soft = max((g.attainment(v) for g, v in pairs if not g.is_hard), default=0.0)
    hard = max((g.attainment(v) for g, v in pairs if g.is_hard), default=0.0)
    return max(soft, 0.0) + NOT_REACHED * hard if hard > 1e-9 else soft


def _objectives(
    goal: Goal, controller: Controller, trial: Trial, runs: Sequence[Run]
) -> list[float]:
    """Objective of a goal for every run of a trial."""
    if goal.objective == "radius":
        return [linear_loop(controller, plant).radius for plant in trial.all_plants]
    if isinstance(goal.objective, str):
        of = OBJECTIVES[goal.objective]
        return [
            float("nan") if np.isnan(run.y).any() else of(run, goal.channel)
            for run in runs  # what a loop did before it was given up tells nothing
        ]
    return [float(goal.objective(run)) for run in runs]


def _summed_up(goal: Goal, values: Sequence[float]) -> float:
    """Make one number of the objective of many runs."""
    found = np.array(values, dtype=float)
    told = np.isfinite(found)
    if goal.over == "mean":
        return float(found.mean()) if told.all() else float("nan")
    if told.all():
        return float(np.quantile(found, goal.over))
    # What cannot be told counts as worst, and nothing is interpolated towards it.
    place = float(
        np.quantile(np.where(told, found, np.inf), goal.over, method="higher")
    )
    return place if np.isfinite(place) else float("nan")


@dataclass(frozen=True, eq=False)
class _Problem:
    """What one evaluation needs, on any machine."""

    weights: Weights
    goals: tuple[Goal, ...]
    trials: tuple[Trial, ...]


def _evaluated(task: tuple[_Problem, Array]) -> Array:
    """Objectives at a vector; nan where the weights give no sound loop."""
    problem, vector = task
    try:
        design = problem.weights.apply(vector)
        return evaluate(design, problem.goals, problem.trials)
    except (ValueError, np.linalg.LinAlgError):  # the start was checked: it is these
        return np.full(len(problem.goals), np.nan)


class _StopSearchError(Exception):
    """Ends a search from inside the optimiser."""


def tune(
    design: Design,
    goals: Sequence[Goal],
    trials: Sequence[Trial],
    weights: Weights | None = None,
    starts: int = 3,
    seed: int = 0,
    bounds: tuple[float, float] = (1e-4, 1e4),
    evaluations: int = 2000,
    callback: Callable[[Step], bool | None] | None = None,
    executor: Executor | None = None,
    also: Sequence[Design] = (),
) -> Tuned:
    """Find weights that attain goals.

    Sequential quadratic programming on the epigraph form (5.5) from several starts,
    then a search without derivatives from the best of them, because measures such as
    the settling time jump.  The best design met is returned, wherever it came from.

    Parameters
    ----------
    design : Design
        Its weights are the first start.
    goals, trials : sequences of Goal and of Trial
    weights : Weights, optional
        What may change; all blocks of (5.6), in full, by default.
    starts : int
        Starts, the design's own weights included; the others are drawn around it.
    seed : int
        The same seed gives the same answer, with any executor.
    bounds : pair of float
        Of the diagonal of the factors of the weights, squared.
    evaluations : int
        Designs to try at most.
    callback : callable, optional
        Takes a ``Step`` after each improvement and at least after every 20 designs;
        return True to stop with what there is.
    executor : concurrent.futures.Executor, optional
        Where designs are tried, see ``nmss_lab.parallel``.
    also : sequence of Design
        Further starts, such as printed weights: of the same structure and sizes.

    Raises
    ------
    ValueError
        If there is no soft goal, a goal names a trial that is not there, or the
        design cannot be run.
    """
    goals, trials = tuple(goals), tuple(trials)
    _check(goals, trials, starts, evaluations)
    weights = weights or Weights(design)
    before = evaluate(design, goals, trials)
    search = _Search(
        _Problem(weights, goals, trials),
        tuple(np.log(bounds) / 2.0),
        evaluations,
        callback,
        executor,
    )
    rng = np.random.default_rng(seed)
    given = [weights.start]
    given += [dataclasses.replace(weights, design=other).start for other in also]
    while len(given) < starts + len(also):
        given.append(given[0] + rng.standard_normal(weights.count))
    stopped = search.run(given)
    best = search.best
    tuned, values, factor = weights.apply(best.vector), best.values, best.attainment
    found = weights.matrices(best.vector)
    own = attained(goals, before)
    if own <= factor:  # the start itself is the best, such as one no vector can say
        tuned, values, factor, found = design, before, own, dict(weights.own)
    return Tuned(
        tuned,
        factor,
        goals,
        before,
        values,
        found,
        tuple(search.history),
        search.count,
        stopped,
    )


def pareto(
    design: Design,
    goals: Sequence[Goal],
    trials: Sequence[Trial],
    points: int = 9,
    **options: Any,
) -> list[Tuned]:
    """Trade the first two goals off: attainment along several directions.

    The importances of the two goals are turned from nearly all on the first to nearly
    all on the second; every search also starts from the result before it.

    Parameters
    ----------
    design, goals, trials : see ``tune``
        The targets of the first two goals should be out of reach together, such as
        their values at the best of each alone.
    points : int
        Directions that are searched.
    **options :
        Further arguments of ``tune``.

    Returns
    -------
    list of Tuned
        Those not beaten in both by another, in the order of the first objective.

    Raises
    ------
    ValueError
        If there are not two soft goals to begin with, or as ``tune``.
    """
    if len(goals) < 2 or goals[0].is_hard or goals[1].is_hard:
        raise ValueError("goals: the first two are traded off and must be soft")
    if points < 2:
        raise ValueError(f"points = {points}: expected at least 2")
    found: list[Tuned] = []
    for angle in np.linspace(0.0, np.pi / 2.0, points + 2)[1:-1]:
        turned = [
            dataclasses.replace(goal, importance=goal.weight * float(share))
            for goal, share in zip(goals, (np.cos(angle), np.sin(angle)), strict=False)
        ]
        also = [*options.get("also", ()), *(t.design for t in found[-1:])]
        result = tune(
            design, [*turned, *goals[2:]], trials, **{**options, "also": also}
        )
        found.append(result)
    return sorted(
        (t for t in found if not any(_beats(o, t) for o in found)),
        key=lambda t: float(t.values[0]),
    )


def _beats(one: Tuned, other: Tuned) -> bool:
    """Whether one result is at least as good in both goals and better in one."""
    a, b = one.values[:2], other.values[:2]
    return bool((a <= b).all() and (a < b).any())


def _check(
    goals: Sequence[Goal], trials: Sequence[Trial], starts: int, evaluations: int
) -> None:
    if not any(not goal.is_hard for goal in goals):
        raise ValueError(
            "goals has no soft goal: give one at least an importance above 0, it is "
            "what the attainment factor measures"
        )
    for goal in goals:
        if goal.trial is not None and not 0 <= goal.trial < len(trials):
            raise ValueError(
                f'goal "{goal.label}" names trial {goal.trial}, there are {len(trials)}'
            )
    if starts < 1:
        raise ValueError(f"starts = {starts}: expected at least 1")
    if evaluations < 1:
        raise ValueError(f"evaluations = {evaluations}: expected at least 1")


@dataclass(eq=False)
class _Best:
    vector: Array
    values: Array
    attainment: float


@dataclass(eq=False)
class _Search:
    """One search: counts, remembers the best, and tells the callback."""

    problem: _Problem
    ends: tuple[float, float]
    limit: int
    callback: Callable[[Step], bool | None] | None
    executor: Executor | None
    count: int = 0
    history: list[Step] = field(default_factory=list)
    told: int = 0
    known: dict[bytes, Array] = field(default_factory=dict)

    @cached_property
    def best(self) -> _Best:
        nothing = np.full(len(self.problem.goals), np.nan)
        return _Best(self.problem.weights.start, nothing, np.inf)

    @cached_property
    def box(self) -> tuple[Array, Array]:
        low, high = np.exp(2.0 * np.array(self.ends))
        return self.problem.weights.bounds(low, high)

    def run(self, starts: Sequence[Array]) -> str:
        """Search from every start; say why it ended."""
        starts = [np.clip(start, *self.box) for start in starts]
        try:
            self.values_of(starts)
            if len(starts) > 1:
                for start in starts:
                    self.descend(start, 1.0)
            self.converge()
            self.polish()
        except _StopSearchError as reason:
            return str(reason)
        if not np.isfinite(self.best.values).all():
            return "No design that was tried has a finite value for every goal."
        return "The search has converged from every start."

    def values_of(self, vectors: Sequence[Array]) -> list[Array]:
        """Objectives at vectors, each computed once."""
        keys = [vector.tobytes() for vector in vectors]
        new = {
            key: vector
            for key, vector in zip(keys, vectors, strict=True)
            if key not in self.known
        }
        new = dict(itertools.islice(new.items(), self.limit - self.count))
        tasks = [(self.problem, vector) for vector in new.values()]
        with closing(in_order(_evaluated, tasks, self.executor)) as found:
            for (key, vector), values in zip(new.items(), found, strict=True):
                self.known[key] = values
                self._note(vector, values)
        if self.count >= self.limit:
            raise _StopSearchError(
                f"The search has tried {self.count} designs, as allowed."
            )
        return [self.known[key] for key in keys]

    def _note(self, vector: Array, values: Array) -> None:
        self.count += 1
        factor = attained(self.problem.goals, values)
        better = factor < self.best.attainment
        if better:
            best = self.best
            best.vector, best.values, best.attainment = vector.copy(), values, factor
        if better or self.count - self.told >= 20:
            self.told = self.count
            best = self.best
            found = self.problem.weights.matrices(best.vector)
            step = Step(self.count, best.attainment, best.values, found)
            if better:
                self.history.append(step)
            if self.callback is not None and self.callback(step):
                raise _StopSearchError("The search was stopped by the callback.")

    def missed(self, values: Array) -> Array:
        """Misses of all goals, relative; of hard ones negative where they are met."""
        return np.array(
            [
                NOT_REACHED if not np.isfinite(v) else (v - g.target) / _scale(g)
                for g, v in zip(self.problem.goals, values, strict=True)
            ]
        )

    def converge(self) -> None:
        """Descend from the best again and again, in a smaller region when it fails."""
        radius = 1.0
        while radius > 0.05:
            before = self.best.attainment
            self.descend(self.best.vector, radius)
            if not before - self.best.attainment > 1e-3 * max(abs(before), 0.1):
                radius /= 4.0

    def descend(self, start: Array, radius: float) -> None:
        """Sequential quadratic programming on the epigraph form, near the start.

        Far from it loops may be unstable and their measures huge: a quadratic model
        of the start says nothing there.
        """
        n = len(start)
        soft = np.array([not goal.is_hard for goal in self.problem.goals])

        def factor(x: Array) -> float:
            return float(x[n])

        def upwards(x: Array) -> Array:
            return np.eye(n + 1)[n]

        def room(x: Array) -> Array:
            (values,) = self.values_of([x[:n]])
            return x[n] * soft - self.missed(values)

        def slope(x: Array) -> Array:
            width = 1e-4
            moved = [x[:n] + width * row for row in np.eye(n)]
            here, *there = self.values_of([x[:n], *moved])
            base = self.missed(here)
            columns = [(self.missed(values) - base) / width for values in there]
            return np.column_stack([-np.array(columns).T, soft])

        low = np.maximum(self.box[0], start - radius)
        high = np.minimum(self.box[1], start + radius)
        first = float(self.missed(self.values_of([start])[0])[soft].max())
        scipy.optimize.minimize(
            factor,
            np.append(start, first),
            jac=upwards,
            method="SLSQP",
            bounds=scipy.optimize.Bounds(
                np.append(low, -np.inf), np.append(high, np.inf)
            ),
            constraints=scipy.optimize.NonlinearConstraint(room, 0.0, np.inf, slope),
            options={"maxiter": PASSES, "ftol": 1e-6},
        )

    def polish(self) -> None:
        """Search around the best without derivatives."""
        centre = self.best.vector
        low, high = self.box
        simplex = np.vstack([centre, centre + 0.2 * np.eye(len(centre))])

        def merit(x: Array) -> float:
            (values,) = self.values_of([x])
            return attained(self.problem.goals, values)

        scipy.optimize.minimize(
            merit,
            np.clip(centre, low, high),
            method="Nelder-Mead",
            bounds=list(zip(low, high, strict=True)),
            options={
                "initial_simplex": np.clip(simplex, low, high),
                "adaptive": len(centre) > 2,
                "xatol": 1e-3,
                "fatol": 1e-5,
                "maxfev": 50 * len(centre),
            },
        )


def _scale(goal: Goal) -> float:
    """Take the importance of a soft goal, the size of the target of a hard one."""
    return (abs(goal.target) or 1.0) if goal.is_hard else goal.weight
