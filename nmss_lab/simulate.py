"""The closed loop: one sample at a time, a whole run, or an ensemble in lock step."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from nmss_lab.controller import Controller, Memory, Move, Status, stacked
from nmss_lab.models import Array, DifferenceModel, LinearPlant, Numbers, Plant
from nmss_lab.parallel import in_order
from nmss_lab.predictive import PredictiveController
from nmss_lab.qp import one_by_one
from nmss_lab.records import Record
from nmss_lab.state_dependent import StateDependentModel

Equation = DifferenceModel | StateDependentModel
"""A model that can be its own plant."""

TOLD = "w", "status", "cost", "multipliers", "iterations"
"""What every run tells of its moves."""

KEPT = tuple(part.name for part in fields(Move) if part.init)
"""What there is to tell of moves."""

DIVERGED = 1e9
"""Output beyond which a loop of an ensemble is given up."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """What happens to a loop over N samples.

    Parameters
    ----------
    reference : array (N, n_y)
        r_k.  Beyond the end the last value is held; whether the controller reads ahead
        is the design's ``reference`` option.
    v : array (N, n_v), optional
        Measured disturbances; v_k is measured before u_k is computed.  A design with
        ``forecast = "given"`` is handed the true future.
    input_disturbance, output_disturbance : arrays (N, n_u), (N, n_y), optional
        Not measured; added to the input of the plant, and to its output.
    noise : array (N, n_y), optional
        Added to what is measured only.
    manual : array (N, n_u), optional
        Inputs set by hand where finite; nan where the controller acts.
    actuator : pair (low, high), optional
        Limits of the actuator that the controller need not know of.
    seen : bool
        Whether an internal model is driven by the disturbed input.
    y0, u0, v0 : arrays (n_y,), (n_u,), (n_v,), optional
        Constant past; y0 is left to the plant's equilibrium where it is not given.
    z0 : array (n_y,), optional
        Sum of the error before the first sample; what holds u0 where it is not given.

    Raises
    ------
    ValueError
        If lengths differ, or a value other than noise or manual is not finite.
    """

    reference: Numbers
    v: Numbers | None = None
    input_disturbance: Numbers | None = None
    output_disturbance: Numbers | None = None
    noise: Numbers | None = None
    manual: Numbers | None = None
    actuator: tuple[Any, Any] = (-np.inf, np.inf)
    seen: bool = False
    y0: Numbers | None = None
    u0: Numbers | None = None
    v0: Numbers | None = None
    z0: Numbers | None = None

    def __post_init__(self) -> None:
        """Check lengths and make every series two-dimensional."""
        r = _series("reference", self.reference)
        object.__setattr__(self, "reference", r)
        for name in ("v", "input_disturbance", "output_disturbance", "noise", "manual"):
            value = getattr(self, name)
            if value is None:
                continue
            series = _series(name, value, finite=name not in ("noise", "manual"))
            if len(series) != len(r):
                raise ValueError(
                    f"{name} has {len(series)} samples, expected {len(r)} as in "
                    "reference"
                )
            object.__setattr__(self, name, series)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.reference)

    def of(self, name: str, channels: int) -> Array:
        """Series (N, channels); zero where the scenario states none.

        Raises
        ------
        ValueError
            If the series has another number of channels.
        """
        value = getattr(self, name)
        if value is None:
            fill = np.nan if name == "manual" else 0.0
            return np.full((len(self), channels), fill)
        if value.shape[1] != channels:
            raise ValueError(
                f"{name} has {value.shape[1]} columns, expected {channels}"
            )
        series: Array = value
        return series


@dataclass(frozen=True, eq=False)
class Run:
    """Everything that happened in one closed loop; arrays, time first.

    Parameters
    ----------
    controller : Controller
    t : array (N,)
        Seconds.
    y, measured, w, r : arrays (N, n_y)
        Output with its disturbance, the same with noise, governed and actual reference.
        In a loop of an ensemble that diverged, y, measured, y_fine and cost are nan
        from where it was given up.
    u, du : arrays (N, n_u)
        Applied input and its change; the last input before a loop was given up stays.
    v : array (N, n_v)
    status : integer array (N,)
        Codes of ``Status``.
    cost : array (N,)
    multipliers : array (N, rows)
        Of the rows of the controller's program, see ``Move``; zero where no limit
        holds.
    iterations : integer array (N,)
        Of the solver; 0 where no program had to be solved.
    moves : Move, optional
        All decisions, one row a sample: ``trail`` reads predictions from them.
    t_fine, y_fine : arrays (M,), (M, n_y)
        Output between the samples; the sampled output where the plant gives no other.
    """

    controller: Controller
    t: Array
    y: Array
    measured: Array
    r: Array
    w: Array
    u: Array
    du: Array
    v: Array
    status: Array
    cost: Array
    multipliers: Array
    iterations: Array
    t_fine: Array
    y_fine: Array
    moves: Move | None = None

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.t)

    def record(self) -> Record:
        """Return what an engineer would have recorded: r, y, u and v at the samples."""
        model = self.controller.model
        names = {"y": tuple(model.y_names), "u": tuple(model.u_names)}
        if model.n_v:
            names["v"] = tuple(model.v_names)
        v = self.v if model.n_v else self.v[:, :0]
        units = {"time": "s", **model.units}
        return Record(self.t, self.y, self.u, v, self.r, names, units)

    @property
    def active(self) -> Array:
        """Rows of the controller's program held by a limit, (N, rows) of bool."""
        return self.multipliers != 0.0

    def trail(self, name: str) -> Array:
        """Predictions made at every sample: (N, Np, channels).

        ``name`` is "y" (steps k+1 to k+Np) or "u", "du" (k to k+Np-1); "w", "beta"
        under a governor.

        Raises
        ------
        ValueError
            If the run kept no moves, or the controller predicts no such signal.
        """
        controller = self.controller
        if not isinstance(controller, PredictiveController) or self.moves is None:
            raise ValueError("the run holds no predictions: its controller makes none")
        if name not in controller.signals:
            raise ValueError(
                f'trail "{name}": this controller predicts '
                f"{', '.join(controller.signals)}"
            )
        return controller.plan(self.moves, name)

    @property
    def sentences(self) -> list[str]:
        """Each way in which moves came about, and how often."""
        codes, counts = np.unique(self.status, return_counts=True)
        return [
            f"{count} of {len(self)}: {Status(int(code)).sentence}"
            for code, count in zip(codes, counts, strict=True)
        ]


@dataclass(frozen=True, eq=False)
class Sample:
    """One sample of a loop, as ``samples`` yields it; a leading axis for ensembles."""

    k: int
    y: Array
    measured: Array
    u: Array
    move: Move
    memory: Memory
    between: Array | None


def samples(
    plant: Plant | Equation, controller: Controller, scenario: Scenario
) -> Iterator[Sample]:
    """Run the loop sample by sample; stop whenever you like.

    Parameters
    ----------
    plant : Plant, DifferenceModel or StateDependentModel
        A ``LinearPlant``, a model as its own plant, or anything with ``reset``,
        ``output`` and ``step``.
    controller : Controller
    scenario : Scenario

    Yields
    ------
    Sample
        Without a leading axis.

    Raises
    ------
    ValueError
        If plant, controller and scenario do not fit together.
    """
    yield from _lock_step(_Single(plant), controller, scenario)


def closed_loop(
    plant: Plant | Equation, controller: Controller, scenario: Scenario
) -> Run:
    """Run the whole loop; see ``samples`` for the arguments and errors."""
    return _collect(_Single(plant), controller, scenario, keep_moves=True)[0]


def closed_loops(
    plants: Sequence[LinearPlant | DifferenceModel],
    controller: Controller,
    scenario: Scenario,
    keep_moves: bool = False,
) -> list[Run]:
    """Run one controller on many linear plants in lock step.

    All unconstrained decisions of a sample are one matrix product.  Loops whose limits
    are hit are answered from solutions that others have met, with the same active
    limits, and only the rest by a quadratic program: see ``nmss_lab.regions``.  One
    plant alone runs as a single loop does.

    A loop that diverges does not end the others: once an output exceeds 1e9 or is not
    finite, the loop is given up.  Its outputs are nan from there on, its input stays
    and its moves are refused.

    Parameters
    ----------
    plants : sequence of LinearPlant or DifferenceModel
        With equal sizes, as from one model with varied parameters.
    controller, scenario : see ``samples``
    keep_moves : bool
        Keep all decisions, so that each run has its ``trail``.

    Raises
    ------
    ValueError
        If the plants' sizes differ or do not fit.
    """
    together = _Only(plants[0]) if len(plants) == 1 else _Stacked(plants)
    return _collect(together, controller, scenario, keep_moves)


def loops_of(
    plants: Sequence[Plant | Equation],
    controller: Controller,
    scenario: Scenario,
    keep_moves: bool = False,
) -> list[Run]:
    """Run one controller on plants of any kind and size, in their order.

    Linear ones of equal size run in lock step, see ``closed_loops``; others one by one.
    """
    ready = [p.plant() if isinstance(p, DifferenceModel) else p for p in plants]
    runs: dict[int, Run] = {}
    alike: dict[tuple[int, ...], list[int]] = {}
    for i, plant in enumerate(ready):
        if isinstance(plant, LinearPlant):
            size = plant.n_x, plant.n_y, plant.n_u, plant.n_v, plant.substeps
            alike.setdefault(size, []).append(i)
        else:
            runs[i] = closed_loop(plant, controller, scenario)
    for numbers in alike.values():
        linear = [ready[i] for i in numbers]
        found = closed_loops(linear, controller, scenario, keep_moves)  # type: ignore[arg-type]
        runs.update(zip(numbers, found, strict=True))
    return [runs[i] for i in range(len(ready))]


def many_loops(
    tasks: Iterable[tuple[Plant | Equation, Controller, Scenario]],
    executor: Executor | None = None,
) -> Iterator[Run]:
    """Run loops that differ in plant, controller or scenario.

    Parameters
    ----------
    tasks : iterable of (plant, controller, scenario)
        See ``samples``.
    executor : concurrent.futures.Executor, optional
        Where to run them; here and one after the other by default.  Results do not
        depend on it.

    Yields
    ------
    Run
        In the order of the tasks, as soon as each is done.

    Raises
    ------
    ValueError
        As ``samples``.
    """
    yield from in_order(_loop_of, tasks, executor)


def _loop_of(task: tuple[Plant | Equation, Controller, Scenario]) -> Run:
    return closed_loop(*task)


class _Single:
    """One plant of any kind; nothing of it has a leading axis."""

    lead: tuple[int, ...] = ()
    gives_up = False

    def __init__(self, model: Plant | Equation) -> None:
        plant: Plant = model.plant() if isinstance(model, Equation) else model
        self.plant, self.dt, self.n_y = plant, plant.dt, plant.n_y
        self.n_u, self.n_v = plant.n_u, plant.n_v
        self.times, self.reset, self.step = _times(plant), plant.reset, plant.step

    def output(self, state: Any) -> Array:
        return np.asarray(self.plant.output(state), dtype=float)

    def between(self, state: Any, u: Array, v: Array) -> Array | None:
        """Return outputs (m, n_y) between this sample and the next."""
        if self.times is None:
            return None
        part = self.plant.between  # type: ignore[attr-defined]
        inside: Array = part.C @ state + part.B @ u + part.G @ v
        return inside


class _Only(_Single):
    """The only plant of an ensemble."""

    gives_up = True


class _Stacked:
    """Linear plants of equal size, their matrices stacked."""

    gives_up = True

    def __init__(self, models: Sequence[LinearPlant | DifferenceModel]) -> None:
        if not models:
            raise ValueError("plants is empty, expected at least one LinearPlant")
        plants = [m.plant() if isinstance(m, DifferenceModel) else m for m in models]
        first = plants[0]
        self.plants, self.lead = list(plants), (len(plants),)
        self.dt, self.n_y, self.n_u, self.n_v = (
            first.dt,
            first.n_y,
            first.n_u,
            first.n_v,
        )
        shapes = {(p.A.shape, p.B.shape, p.C.shape, p.dt) for p in plants}
        if len(shapes) > 1:
            raise ValueError(f"plants differ in size or dt: {sorted(map(str, shapes))}")
        A, B, self.C, G = (
            np.array([getattr(p, name) for p in plants]) for name in "ABCG"
        )
        self.n_x, self.ABG = first.n_x, np.concatenate([A, B, G], axis=2)
        self.times = _times(first)
        if self.times is not None:
            parts = [p.between for p in plants]
            self.between_C, self.between_B, self.between_G = (
                np.stack([getattr(part, name) for part in parts]) for name in "CBG"
            )

    def reset(self, u0: Array, v0: Array, y0: Array | None) -> Array:
        if not (u0.any() or v0.any() or np.any(0.0 if y0 is None else y0)):
            return np.zeros((*self.lead, self.n_x))
        return np.stack([plant.reset(u0, v0, y0) for plant in self.plants])

    def output(self, state: Array) -> Array:
        with np.errstate(over="ignore", invalid="ignore"):  # a loop may diverge
            return one_by_one(self.C, state)

    def step(self, state: Array, u: Array, v: Array) -> Array:
        both = np.concatenate([state, u, v], axis=1)
        with np.errstate(over="ignore", invalid="ignore"):
            return one_by_one(self.ABG, both)

    def between(self, state: Array, u: Array, v: Array) -> Array | None:
        """Return outputs (loops, m, n_y) between this sample and the next."""
        if self.times is None:
            return None
        with np.errstate(over="ignore", invalid="ignore"):
            inside: Array = (
                np.einsum("rmij,rj->rmi", self.between_C, state)
                + np.einsum("rmij,rj->rmi", self.between_B, u)
                + np.einsum("rmij,rj->rmi", self.between_G, v)
            )
        return inside


def _times(plant: Any) -> Array | None:
    between = getattr(plant, "between", None)
    times: Array | None = None if between is None else between.times
    return times


def _lock_step(
    plants: _Single | _Stacked, controller: Controller, scenario: Scenario
) -> Iterator[Sample]:
    """Advance all loops by one sample at a time."""
    if not isinstance(controller, Controller):
        raise ValueError(
            f"controller is a {type(controller).__name__}, expected a Controller; a "
            "Design makes one with build()"
        )
    model = controller.model
    _check_sizes(plants, controller)
    names = "input_disturbance", "output_disturbance", "noise", "manual"
    sizes = model.n_u, model.n_y, model.n_y, model.n_u
    d_u, d_y, noise, manual = (
        scenario.of(name, size) for name, size in zip(names, sizes, strict=True)
    )
    r = scenario.of("reference", model.n_y)
    v = scenario.of("v", plants.n_v)
    plants_v = v
    if plants.lead:
        plants_v = np.broadcast_to(v[:, None], (len(v), *plants.lead, plants.n_v))
    u0, v0 = _constant(scenario.u0, model.n_u), _constant(scenario.v0, plants.n_v)
    before = None if scenario.y0 is None else _constant(scenario.y0, model.n_y)
    state = plants.reset(u0, v0, before)
    y0 = plants.output(state)
    memory = _start(controller, y0, u0, v0, r[0], scenario.z0)
    # what a controller does not read ahead it holds by itself
    reads_r, reads_v = controller.preview, controller.forecast_steps
    ahead_r, ahead_v = _padded(r, reads_r), _padded(v, reads_v)
    knows_v, by_hand = model.n_v > 0, np.isfinite(manual)
    u = np.broadcast_to(u0, (*plants.lead, model.n_u))
    given_up = np.zeros(plants.lead, dtype=bool)
    for k in range(len(scenario)):
        y = plants.output(state) + d_y[k]
        given_up = given_up | _diverged(plants, y, k)
        some = bool(given_up.any())
        if some:
            y[given_up], state[given_up], memory.vector[given_up] = np.nan, 0.0, 0.0
        measured = y + noise[k]
        memory = controller.measure(memory, measured, r[k], v[k] if knows_v else None)
        move = controller.decide(
            memory,
            ahead_r[k : k + 1 + reads_r] if reads_r else None,
            ahead_v[k : k + 1 + reads_v] if knows_v and reads_v else None,
        )
        wanted = np.where(by_hand[k], manual[k], move.u)
        u_before, u = u, np.clip(wanted, *scenario.actuator)
        into = u + d_u[k]
        inside = plants.between(state, into, plants_v[k])
        if some:
            u[given_up] = u_before[given_up]
            move.cost = np.where(given_up, np.nan, move.cost)
            move.multipliers = np.where(given_up[..., None], 0.0, move.multipliers)
        yield Sample(k, y, measured, u, move, memory, inside)
        memory = controller.apply(memory, u, move, into if scenario.seen else None)
        state = plants.step(state, into, plants_v[k])


def _diverged(plants: _Single | _Stacked, y: Array, k: int) -> Array:
    """Which loops are to be given up, (*lead,); or an error where none may be."""
    if plants.gives_up:
        bounded: Array = np.all(np.abs(y) <= DIVERGED, axis=-1)
        return ~bounded
    if not np.isfinite(y).all():
        raise ValueError(f"the loop diverged: y is no longer finite at sample {k}")
    return np.zeros((), dtype=bool)


def _start(
    controller: Controller,
    y0: Array,
    u0: Array,
    v0: Array,
    r0: Array,
    z0: Numbers | None,
) -> Memory:
    """Memories of all loops, stacked; loops that start alike are made once."""
    known_v = v0 if controller.model.n_v else None
    if y0.ndim == 1:
        return controller.start(y0, u0, known_v, r0, z0)
    kinds, of_loop = np.unique(y0, axis=0, return_inverse=True)
    starts = [controller.start(y, u0, known_v, r0, z0) for y in kinds]
    return stacked(starts, of_loop.ravel())


class _Log:
    """What happens, written sample by sample, time first."""

    def __init__(self, samples: int) -> None:
        self.samples = samples
        self.arrays: dict[str, Array] = {}

    def write(self, k: int, **values: Array) -> None:
        """Note the values of sample k; those of many loops have a leading axis."""
        for name, value in values.items():
            if name not in self.arrays:
                shape = self.samples, *value.shape
                self.arrays[name] = np.zeros(shape, value.dtype)
            if value.size < 64 or value.any():  # large zeros take no memory
                self.arrays[name][k] = value

    def of(self, i: int | None) -> dict[str, Array]:
        """Values (samples, ...) of loop i of many, or of the only one (None)."""
        if i is None:
            return self.arrays
        return {name: values[:, i] for name, values in self.arrays.items()}


def _collect(
    plants: _Single | _Stacked,
    controller: Controller,
    scenario: Scenario,
    keep_moves: bool,
) -> list[Run]:
    N = len(scenario)
    log, told = _Log(N), _Log(N)
    names = KEPT if keep_moves else TOLD
    deciding = controller.together() if plants.lead else controller
    for sample in _lock_step(plants, deciding, scenario):
        log.write(sample.k, y=sample.y, measured=sample.measured, u=sample.u)
        told.write(sample.k, **{name: getattr(sample.move, name) for name in names})
        if sample.between is not None:
            log.write(sample.k, y_fine=sample.between)
    u, before = log.arrays["u"], _constant(scenario.u0, controller.model.n_u)
    before = np.broadcast_to(before, (1, *u.shape[1:]))
    log.arrays["du"] = np.diff(u, axis=0, prepend=before)
    t = np.arange(N) * plants.dt
    t_fine, log.arrays["y_fine"] = _fine(plants, log, scenario, t)
    return [
        Run(
            controller=controller,
            t=t,
            r=scenario.reference,
            v=scenario.of("v", plants.n_v),
            t_fine=t_fine,
            moves=Move(**told.of(i)) if keep_moves else None,
            **{name: told.of(i)[name] for name in TOLD},
            **log.of(i),
        )
        for i in (range(*plants.lead) if plants.lead else [None])
    ]


def _fine(
    plants: _Single | _Stacked, log: _Log, scenario: Scenario, t: Array
) -> tuple[Array, Array]:
    """Time and outputs (M, loops, n_y) between the samples, the first included."""
    y = log.arrays["y"]
    if plants.times is None:
        return t, y
    d_y = scenario.of("output_disturbance", plants.n_y)
    given_up = np.isnan(y)
    alike = tuple(range(1, 2 + len(plants.lead)))
    blocks = np.moveaxis(log.arrays["y_fine"], -2, 1) + np.expand_dims(d_y, alike)
    blocks = np.where(given_up[:, None], np.nan, blocks)
    fine = np.concatenate([y[:1], blocks.reshape(-1, *y.shape[1:])])
    fine[: -1 : len(plants.times)][given_up] = np.nan
    t_fine = (t[:, None] + plants.times).ravel()
    return np.concatenate([t[:1], t_fine]), fine


def _check_sizes(plants: _Single | _Stacked, controller: Controller) -> None:
    model = controller.model
    if (plants.n_y, plants.n_u) != (model.n_y, model.n_u):
        raise ValueError(
            f"the plant has {plants.n_y} outputs and {plants.n_u} inputs, the "
            f"controller's model {model.n_y} and {model.n_u}"
        )
    if model.n_v and plants.n_v != model.n_v:
        raise ValueError(
            f"the plant has {plants.n_v} measured disturbances, the controller's model "
            f"{model.n_v}"
        )
    if not np.isclose(plants.dt, model.dt, rtol=1e-9):
        raise ValueError(
            f"the plant is sampled every {plants.dt} s, the controller's model every "
            f"{model.dt} s"
        )


def _constant(value: Array | None, size: int) -> Array:
    return np.zeros(size) if value is None else np.broadcast_to(value, (size,)) * 1.0


def _padded(series: Array, ahead: int) -> Array:
    return np.concatenate([series, np.repeat(series[-1:], ahead, axis=0)])


def _series(name: str, value: Any, finite: bool = True) -> Array:
    series = np.asarray(value, dtype=float)
    if series.ndim == 1:
        series = series[:, None]
    if series.ndim != 2 or not len(series):
        raise ValueError(f"{name} has shape {series.shape}, expected (N, channels)")
    if finite and not np.isfinite(series).all():
        k, i = np.argwhere(~np.isfinite(series))[0]
        raise ValueError(f"{name} is not finite at sample {k}, channel {i}")
    return series
