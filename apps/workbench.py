"""The workbench: seven steps from a record to a verified design.

Nothing is computed here: a step puts choices into calls of the library, and
``script`` prints the same calls.  What came out belongs to the choices it was made
with; see ``Bench``.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple
from urllib.parse import urlencode

import numpy as np
import param

from apps.goals import Aim
from apps.identification import RECORDS, IdentifyChoices
from apps.kept import Origin, keep_case
from apps.robustness import RobustnessChoices
from apps.session import HELD, head, held_as, keep_model, literal, plain
from apps.tuning import TuneChoices
from nmss_lab.analysis import Review, review
from nmss_lab.cases import Case, model_case, piecewise
from nmss_lab.controller import Limits
from nmss_lab.design import Design
from nmss_lab.files import Study, dumps
from nmss_lab.identify import Candidate, Estimate
from nmss_lab.measures import StepMeasures, measures
from nmss_lab.models import Array
from nmss_lab.montecarlo import MonteCarlo, join, monte_carlo_parts
from nmss_lab.mpc import STRUCTURES
from nmss_lab.plots import (
    Chart,
    Curve,
    ensemble_charts,
    estimate_charts,
    loop_charts,
    record_charts,
)
from nmss_lab.report import report
from nmss_lab.simulate import Run, Scenario, closed_loop
from nmss_lab.tuning import Step as Tried
from nmss_lab.tuning import Tuned, tune
from nmss_lab.uncertainty import EstimatedModels, Uncertainty

STEPS = {
    "data": "Data",
    "model": "Model",
    "structure": "Structure",
    "limits": "Limits",
    "tuning": "Tuning",
    "robustness": "Robustness",
    "report": "Report",
}
"""Names of the steps, in their order."""

USUAL = "usual"
TEXTS = "u_low", "u_high", "du_most", "y_low", "y_high"
SHOWN_ROWS = 6
"""Models of the ranking to choose from."""

ORDER = {1: "First", 2: "Second", 3: "Third", 4: "Fourth", 5: "Fifth", 6: "Sixth"}
WHY = {
    "wang_young": "it moves by changes of what it measures, so no constant disturbance "
    "leaves an offset",
    "disturbance_direct": "it counts the measured disturbance in before the output "
    "feels it, and leaves no offset",
    "integral_of_error": "it sums the error up, so it rests only where there is none",
}

Told = Callable[[int, int], bool]
"""Hears how many are done, and of how many; answers whether to stop."""


class WorkbenchChoices(IdentifyChoices):
    """Choices of all steps; the groups are the steps."""

    model = param.String("", doc="Orders of the model; the best by YIC if empty.")
    structure: Any = param.Selector(
        default=USUAL,
        objects=[USUAL, "wang_young", "disturbance_direct", "integral_of_error"],
        label="Structure",
        doc="The usual one is Wang-Young, or the direct one with a measured "
        "disturbance; both are free of offset.",
    )
    weight_move = param.Number(
        1.0,
        bounds=(1e-2, 1e2),
        label="Move weight to begin with, times the default",
        doc="More makes the input calmer and the loop slower; step 5 begins here.",
    )
    step = param.Number(
        1.0,
        bounds=(-1e9, 1e9),
        label="Step of the reference",
        doc="What the loop is tried on, in the unit of y; at first a fifth of the "
        "range of the record.",
    )
    u_low = param.String(
        label="Input at least",
        doc="In the units of the record, one number or one an input; none if empty. At "
        "first the range of the record.",
    )
    u_high = param.String(label="Input at most", doc="The same at the upper end.")
    du_most = param.String(
        label="Change of the input a sample, at most",
        doc="Up and down; at first a fifth of the range of the input.",
    )
    y_low = param.String(
        label="Output at least",
        doc="Gives way where it cannot be kept; at first a little beyond the record.",
    )
    y_high = param.String(label="Output at most", doc="The same at the upper end.")
    faster = param.Integer(
        70,
        bounds=(20, 150),
        label="Settle within, per cent of the time before",
        doc="After a step of the reference, to 5 %.",
    )
    overshoot = param.Integer(
        5,
        bounds=(0, 50),
        label="Overshoot at most, per cent of the step",
        doc="How far the output may shoot over.",
    )
    calm = param.Integer(
        150,
        bounds=(30, 400),
        label="Moves at most, per cent of those before",
        doc="Root mean square of the input's changes: less is calmer.",
    )
    most = param.Integer(
        150,
        bounds=(50, 2000),
        step=50,
        label="Most designs to try",
        doc="Goals that do not go together are missed by as little as possible.",
    )
    n = param.Integer(
        300,
        bounds=(10, 2000),
        label="Plants to try",
        doc="Drawn from the covariance P* that identification left.",
    )
    seed = param.Integer(
        0,
        bounds=(0, 2**31 - 1),
        label="Seed",
        doc="The same seed draws the same plants.",
    )

    scale: ClassVar[dict[str, str]] = {"weight_move": "log"}
    groups: ClassVar[dict[str, tuple[str, ...]]] = {
        "1 Data": (*IdentifyChoices.groups["Record"], *IdentifyChoices.groups["Spans"]),
        "2 Model": (*IdentifyChoices.groups["Models to try"], "model"),
        "3 Structure": ("structure", "weight_move"),
        "4 Limits": (*TEXTS, "step"),
        "5 Tuning": ("faster", "overshoot", "calm", "most"),
        "6 Robustness": ("n", "seed"),
        "7 Report": (),
    }
    fields: ClassVar[tuple[str, ...]] = (*IdentifyChoices.fields, "step", "n", "seed")
    of_step: ClassVar[dict[str, tuple[str, ...]]] = dict(
        zip(STEPS, groups.values(), strict=True)
    )
    of_range: ClassVar[tuple[str, ...]] = groups["4 Limits"]
    """What is guessed from the range of the record."""

    def misfit(self, text: str) -> str:
        """Held designs are compared on other pages."""
        return "this page shows its own design; Receding horizon compares"

    def _load(self) -> None:
        """Read the record, and guess limits from its range."""
        super()._load()
        whole, (rest_y, rest_u) = self.whole, self.rest
        y, u = np.vstack([whole.y, rest_y]), np.vstack([whole.u, rest_u])
        room = 0.1 * np.ptp(y, axis=0)
        self.u_low, self.u_high = _ends(u.min(axis=0), u.max(axis=0))
        size = 0.2 * np.ptp(u, axis=0)
        self.du_most = _listed(size) if size.all() else ""
        self.y_low, self.y_high = _ends(y.min(axis=0) - room, y.max(axis=0) + room)
        self.step = float(f"{np.ptp(y) / 5.0:.1g}")

    def accept(self, values: dict[str, Any]) -> None:
        """Take over values that came from outside, all or none.

        Raises
        ------
        ValueError
            Saying what is wrong; nothing has changed then.
        """
        before, record = self.values(), self._of_record()
        super().accept(values)
        if self._of_record() == record:
            return
        # the guesses have come anew: over them what was stated
        late = {k: values[k] for k in self.of_range if k in values}
        self.put({k: value for k, value in late.items() if value != before[k]})

    def _read(self, key: str, value: Any) -> Any:
        if key in TEXTS:
            text = str(value).replace("\u2212", "-").strip()
            _numbers(text)
            return text
        return str(value)[:80] if key == "model" else super()._read(key, value)

    def _shown(self, key: str) -> bool:
        return key != "model" and super()._shown(key)

    def _item(self, key: str) -> dict[str, Any]:
        if key not in TEXTS:
            return super()._item(key)
        parameter = self.param[key]
        item = {"name": key, "label": parameter.label, "help": parameter.doc}
        return {**item, "when": None, "kind": "text", "longest": 60}

    def _word(self, key: str, name: str) -> str:
        if key == "structure":
            return plain(name) if name != USUAL else "the usual one"
        return super()._word(key, name)

    @property
    def rest(self) -> tuple[Array, Array]:
        """What was taken away from outputs and inputs; of a line, its last value."""
        whole, treated = self.whole, self.treated
        return (whole.y - treated.y)[-1], (whole.u - treated.u)[-1]

    @property
    def limits(self) -> Limits:
        """Limits of deviations.

        Raises
        ------
        ValueError
            If there are not as many as inputs, or the operating point is outside.
        """
        (rest_y, rest_u), names = self.rest, self.whole.names
        sides = {}
        for key, rest, of in (("u", rest_u, "u"), ("y", rest_y, "y")):
            low, high = (
                _side(getattr(self, f"{key}_{end}"), len(rest), sign)
                for end, sign in (("low", -1.0), ("high", 1.0))
            )
            for name, least, here, top in zip(names[of], low, rest, high, strict=True):
                if not least <= here <= top:
                    raise ValueError(
                        f"the record is about {name} = {here:.4g}, which lies outside "
                        f"{least:g} to {top:g}: widen these limits"
                    )
            sides[key] = low - rest, high - rest
        most = _side(self.du_most, len(rest_u), 1.0)
        return Limits(sides["u"], (-most, most), sides["y"])

    def copy(self) -> WorkbenchChoices:
        """Return the same choices, which later ones do not change."""
        other = type(self)()
        if self.file is not None:
            other.take_file(self.file)
        other.accept(self.values())
        other.put(self.values())
        return other

    def stamp(self, step: str) -> tuple[str, ...]:
        """All choices that a step and those before it depend on."""
        keys = list(STEPS)[: list(STEPS).index(step) + 1]
        values = [getattr(self, key) for part in keys for key in self.of_step[part]]
        text = self.file.text if self.record == "file" and self.file else ""
        return text, *map(repr, values)


class _Told(NamedTuple):
    """How a step tells of its progress, and where it computes."""

    heard: Told
    executor: Executor | None


@dataclass(frozen=True, eq=False)
class Data:
    """Step 1: the record, by the choices that treat it."""

    choices: WorkbenchChoices
    words: str


@dataclass(frozen=True, eq=False)
class Model:
    """Step 2: a ranking, and the model chosen from it."""

    searched: tuple[str, ...]
    found: list[Candidate]
    rows: list[dict[str, Any]]
    estimate: Estimate
    words: str

    @property
    def orders(self) -> str:
        """Orders of the model, as text."""
        return str(self.estimate.orders)

    @property
    def best(self) -> list[dict[str, Any]]:
        """First rows of the ranking, that of the model chosen among them."""
        own = [row for row in self.rows if row["orders"] == self.orders]
        first = self.rows[:SHOWN_ROWS]
        return first if own[0] in first else [*first, *own]


@dataclass(frozen=True, eq=False)
class Structure:
    """Step 3: a design without limits, and what a review says of it."""

    kept: str
    example: Case
    design: Design
    review: Review
    words: str


@dataclass(frozen=True, eq=False)
class Loop:
    """Step 4: the design with limits, run; its case is kept for the other pages."""

    kept: str
    example: Case
    design: Design
    run: Run
    stepped: Run
    words: str


@dataclass(frozen=True, eq=False)
class Better:
    """Step 5: the design tuned; its case is kept for the other pages."""

    kept: str
    tuning: TuneChoices
    tuned: Tuned
    stepped: Run
    review: Review
    words: str


@dataclass(frozen=True, eq=False)
class Robust:
    """Step 6: a study of many plants."""

    kept: str
    uncertainty: Uncertainty
    study: MonteCarlo
    nominal: Run
    unstable: int
    words: str


@dataclass(frozen=True, eq=False)
class Written:
    """Step 7: the texts of two files."""

    html: str
    design: str
    words: str


def _do_data(choices: WorkbenchChoices, done: Mapping[str, Any], told: _Told) -> Data:
    record = choices.whole
    y, *_ = record.names["y"]
    moved = ", ".join((*record.names["u"], *record.names["v"]))
    fitted, checked = len(choices.fitted.time), len(choices.checked.time)
    return Data(
        choices,
        f"{len(record.time)} samples every {record.dt:.4g} s, {y} from {moved}; "
        f"{fitted} of them to fit, {checked} to check.",
    )


def _do_model(choices: WorkbenchChoices, done: Mapping[str, Any], told: _Told) -> Model:
    own = [key for key in choices.of_step["model"] if key != "model"]
    searched = (
        *choices.stamp("data"),
        *(repr(getattr(choices, key)) for key in own),
    )
    known = done.get("model")
    if known is not None and known.searched == searched:
        found, rows = known.found, known.rows
    else:
        search = choices.search()
        found = search(progress=told.heard)
        checked = choices.checked
        rows = [_row(c.estimate, checked) for c in found if c.estimate and _sound(c)]
    good = {str(c.orders): c.estimate for c in found if c.estimate and _sound(c)}
    if not good:
        why = found[0].row["problem"] if found else "nothing was tried"
        raise ValueError(
            f"no structure gave a model to trust ({why}): look at what is taken away "
            "and at the start under 1 Data, or try other orders"
        )
    if choices.model and choices.model not in good:
        raise ValueError(
            f"{choices.model} is no model of this search to trust: choose another row"
        )
    estimate = good[choices.model or next(iter(good))]
    words = _model_words(estimate, choices, rows)
    return Model(searched, found, rows, estimate, words)


def _do_structure(
    choices: WorkbenchChoices, done: Mapping[str, Any], told: _Told
) -> Structure:
    found: Estimate = done["model"].estimate
    example = model_case(found.to_model(), found.covariance)
    name = structure_of(choices)
    if name not in example.designs:
        raise ValueError(
            f"{plain(name)} needs a measured disturbance, and the record has none: "
            "choose another structure, or a column for v under 1 Data"
        )
    design = example.designs[name]
    design = replace(design, R=choices.weight_move * np.asarray(design.R))
    looked = review(design.build())
    Np, Nc, dt = design.horizon.Np, design.horizon.Nc, example.model.dt
    bad = sum(finding.verdict == "bad" for finding in looked.findings)
    faults = "nothing bad" if looked.is_good else f"{bad} fault{'s' * (bad > 1)}"
    return Structure(
        keep_model(found),
        example,
        design,
        looked,
        f"{plain(name)}: {WHY[name]}. It predicts {Np} samples ({Np * dt:.4g} s) with "
        f"{Nc} free moves; the review finds {faults}.",
    )


def _do_limits(choices: WorkbenchChoices, done: Mapping[str, Any], told: _Told) -> Loop:
    base: Structure = done["structure"]
    if not choices.step:
        raise ValueError("a step of 0 tries nothing: state another one")
    example = _tried(choices, base)
    design = example.designs[structure_of(choices)]
    kept = keep_case("model", dumps(example), example, _origin(choices, done["model"]))
    run = closed_loop(example.plant, design.build(), example.scenario)
    stepped = closed_loop(example.plant, design.build(), _stepped(example))
    (rest_y, rest_u), names = choices.rest, choices.whole.names
    units = choices.whole.units
    rest = ", ".join(
        f"{name} {value:.4g} {units.get(name, '')}".strip()
        for name, value in zip(
            (*names["y"], *names["u"]), (*rest_y, *rest_u), strict=True
        )
    )
    return Loop(
        kept,
        example,
        design,
        run,
        stepped,
        f"From {rest}, after a step of {choices.step:g}: {_step_words(stepped)}; "
        f"{_broken(run)}. A disturbance at the input follows.",
    )


def _do_tuning(
    choices: WorkbenchChoices, done: Mapping[str, Any], told: _Told
) -> Better:
    tuning = _tuning(done["limits"], choices)
    bench, start = tuning.bench(), tuning.start()
    probes = [Aim("settling", 0, 1.0), Aim("smoothness", 0, 1.0)]
    now = bench.values(start, tuning.library(probes, bench, start))
    settling, smoothness = (
        replace(aim, target=float(f"{now[aim.key] * share / 100.0:.3g}"))
        for aim, share in zip(probes, (choices.faster, choices.calm), strict=True)
    )
    aims = settling, Aim("overshoot", 0, choices.overshoot / 100.0), smoothness
    tuning.goals = ";".join(aim.text for aim in aims)

    def heard(step: Tried) -> bool:
        return told.heard(min(step.evaluation, choices.most), choices.most)

    job = tuning.job(start, tuning.aims(bench), bench)
    tuned = tune(**job, callback=heard, executor=told.executor)
    stepped = bench.runs(tuned.design)[0]
    before = measures(bench.runs(start)[0]).steps[0]
    after = measures(stepped).steps[0]
    missed = [row["goal"] for row in tuned.table() if row["attainment"] > 1e-6]
    goals = "every goal is met"
    if missed:
        goals = f"not met: {', '.join(missed).lower()}"
    words = (
        f"Settles {_time(after.settling)}, before {_time(before.settling)}; "
        f"overshoot {100 * after.overshoot:.2g} %, before "
        f"{100 * before.overshoot:.2g} %; {goals}. {tuned.evaluations} designs tried"
    )
    words += ", none better: it stays as it was." if tuned.design is start else "."
    kept = tuning.keep(tuned.design, start)
    return Better(kept, tuning, tuned, stepped, review(tuned.design.build()), words)


def _do_robustness(
    choices: WorkbenchChoices, done: Mapping[str, Any], told: _Told
) -> Robust:
    better: Better = done["tuning"]
    example, design = done["limits"].example, better.tuned.design
    uncertainty = _uncertainty(better.kept, done["model"].estimate)
    parts: list[MonteCarlo] = []
    for part in monte_carlo_parts(
        {"tuned": design},
        uncertainty,
        example.scenario,
        choices.n,
        choices.seed,
        "signals",
        executor=told.executor,
    ):
        parts.append(part)
        told.heard(sum(map(len, parts)), choices.n)
    study = join(parts)
    rates = {row["event"]: row for row in study.rates().to_dict("records")}
    row, broken = rates["unstable"], rates["breaks a limit"]
    low, high = (f"{100 * row[end]:.2g}" for end in ("low", "high"))
    words = (
        f"{row['count']} of {row['n']} plants unstable [{low}, {high} %], "
        f"{broken['count']} break a limit; the largest pole of all has modulus "
        f"{study.table['radius'].max():.3f}."
    )
    nominal = closed_loop(example.plant, design.build(), example.scenario)
    return Robust(better.kept, uncertainty, study, nominal, int(row["count"]), words)


def _do_report(
    choices: WorkbenchChoices, done: Mapping[str, Any], told: _Told
) -> Written:
    study, robust = study_of(done), done["robustness"]
    text = report(
        study,
        uncertainty=robust.uncertainty,
        realisations=choices.n,
        seed=choices.seed,
        title=title_of(choices),
        executor=told.executor,
        callback=told.heard,
    )
    words = (
        f"A report of {len(text) / 1000:.0f} kB with figures, review, rates and "
        "Python, and the design as a file. Both speak of deviations from the operating "
        "point."
    )
    return Written(text, dumps(study), words)


WORK: Mapping[str, Callable[..., Any]] = {
    "data": _do_data,
    "model": _do_model,
    "structure": _do_structure,
    "limits": _do_limits,
    "tuning": _do_tuning,
    "robustness": _do_robustness,
    "report": _do_report,
}


def do(
    step: str,
    choices: WorkbenchChoices,
    done: Mapping[str, Any],
    heard: Told = lambda done, total: False,
    executor: Executor | None = None,
) -> Any:
    """Compute a step from what the earlier ones came to.

    Raises
    ------
    ValueError
        Saying why it cannot be, and what to do.
    """
    with np.errstate(all="ignore"):
        return WORK[step](choices, done, _Told(heard, executor))


class Bench:
    """What has been done, and with which choices.

    Results stay until there are new ones; one whose choices have changed is out of
    date, and current again when they change back.
    """

    def __init__(self) -> None:
        self.results: dict[str, Any] = {}
        self.stamps: dict[str, tuple[str, ...]] = {}
        self.failures: dict[str, tuple[tuple[str, ...], str]] = {}

    def state(self, step: str, choices: WorkbenchChoices) -> str:
        """Return "waiting", "ready", "done", "stale" or "failed"."""
        stamp = choices.stamp(step)
        if self.failures.get(step, ((), ""))[0] == stamp:
            return "failed"
        if self.stamps.get(step) == stamp:
            return "done"
        if step in self.results:
            return "stale"
        before = list(STEPS)[: list(STEPS).index(step)]
        ready = all(self.state(other, choices) == "done" for other in before)
        return "ready" if ready else "waiting"

    def missing(self, last: str, choices: WorkbenchChoices) -> list[str]:
        """List steps up to one that are not done with these choices."""
        upto = list(STEPS)[: list(STEPS).index(last) + 1]
        return [step for step in upto if self.state(step, choices) != "done"]

    def put(self, step: str, choices: WorkbenchChoices, result: Any) -> None:
        """Take over what a step came to."""
        self.results[step], self.stamps[step] = result, choices.stamp(step)
        self.failures.pop(step, None)

    def fail(self, step: str, choices: WorkbenchChoices, why: str) -> None:
        """Note that a step cannot be done with these choices."""
        self.failures[step] = choices.stamp(step), why

    def current(self, choices: WorkbenchChoices) -> dict[str, Any]:
        """Results up to the first step that is not done."""
        found = {}
        for step in STEPS:
            if self.state(step, choices) != "done":
                break
            found[step] = self.results[step]
        return found

    def verdict(self, choices: WorkbenchChoices) -> tuple[bool, list[str]]:
        """Tell whether the design is verified, and what stands against it."""
        done = self.current(choices)
        against = []
        if len(done) < len(STEPS):
            step = list(STEPS)[len(done)]
            number, why = len(done) + 1, self.state(step, choices)
            words = {"failed": "failed", "stale": "is out of date"}.get(why, "is to do")
            if step != "report":
                against.append(f"step {number}, {STEPS[step].lower()}, {words}")
        looked = [done[k].review for k in ("tuning", "structure") if k in done][:1]
        for finding in looked[0].findings if looked else ():
            if finding.verdict == "bad":
                against.append(f"{finding.topic}: {finding.sentence}")
        if "robustness" in done and done["robustness"].unstable:
            n, unstable = len(done["robustness"].study), done["robustness"].unstable
            against.append(
                f"{unstable} of {n} plants that may be the true one are unstable: ask "
                "for calmer moves, or fit a better model"
            )
        return not against, against


# Parts of the steps. Every call here has its twin in ``script``.


def structure_of(choices: WorkbenchChoices) -> str:
    """Name of the structure that is chosen."""
    if choices.structure != USUAL:
        return str(choices.structure)
    return "disturbance_direct" if choices.whole.names["v"] else "wang_young"


def title_of(choices: WorkbenchChoices) -> str:
    """Heading of the report."""
    file = choices.file.name if choices.record == "file" and choices.file else ""
    output = choices.whole.names["y"][0]
    return f"Control of {output}: {file or RECORDS[choices.record]}"


def study_of(done: Mapping[str, Any]) -> Study:
    """Return the design of the steps done, as data."""
    example = done["limits"].example
    design = done["tuning"].tuned.design if "tuning" in done else done["limits"].design
    return Study(design, design.model, example.scenario)


def _sizes(choices: WorkbenchChoices) -> tuple[float, list[float]]:
    """Sizes of the steps of reference and measured disturbances."""
    ranges = np.ptp(choices.whole.v, axis=0) / 5.0
    return choices.step, [float(f"{size:.1g}") for size in ranges]


def _tried(choices: WorkbenchChoices, base: Structure) -> Case:
    """Put the limits, and a scenario of the record's size, into a case."""
    limits, name = choices.limits, structure_of(choices)
    known, scenario = base.example.designs, base.example.scenario
    size, seen = _sizes(choices)
    disturbed = size * scenario.of("input_disturbance", base.design.model.n_u)
    designs = {
        key: replace(known[key], limits=limits)
        for key in (name, *known)
        if known[key].structure in STRUCTURES
    }
    designs[name] = replace(base.design, limits=limits)
    scenario = replace(
        scenario,
        reference=size * scenario.reference,
        v=None if scenario.v is None else scenario.v * seen,
        input_disturbance=disturbed,
    )
    return replace(base.example, designs=designs, scenario=scenario)


def _stepped(example: Case) -> Scenario:
    """Scenario of one step of the reference, and nothing else."""
    scenario, samples = example.scenario, _length(example)
    return replace(
        scenario,
        reference=piecewise(samples, (1, scenario.reference[-1])),
        v=None if scenario.v is None else np.zeros_like(scenario.v)[:samples],
        input_disturbance=None,
    )


def _length(example: Case) -> int:
    """Count samples in which a loop comes to rest after a step."""
    design = next(iter(example.designs.values()))
    return int(np.clip(3 * design.horizon.Np, 10, len(example.scenario)))


def _tuning(loop: Loop, choices: WorkbenchChoices) -> TuneChoices:
    """Choices of the page Tune about the loop: the same step, and the same search."""
    return TuneChoices(
        case=loop.kept,
        tried="steps",
        length=_length(loop.example),
        starts=1,
        most=choices.most,
    )


def _robustness(kept: str) -> RobustnessChoices:
    """Choices of the page Robustness about the tuned design."""
    choices = RobustnessChoices(case=kept)
    choices.accept({"structures": ["tuned"]})
    return choices


def _uncertainty(kept: str, found: Estimate) -> Uncertainty:
    """Plants that the estimate leaves possible, those of the page Robustness."""
    choices = _robustness(kept)
    if choices.uncertainty == "covariance":
        return choices.plants()
    return EstimatedModels([found])


def closer_look(step: str, choices: WorkbenchChoices, result: Any) -> tuple[str, str]:
    """Give the address of the page that shows all of a step, and its name."""
    if step in ("data", "model"):
        if choices.record == "file":  # the other page does not have it
            return "", ""
        here, usual = IdentifyChoices.names(), choices.defaults()
        keys = [k for k in here if k not in HELD and choices.values()[k] != usual[k]]
        return _address("identify", choices, keys), "Identify"
    if step == "structure":
        return f"structures?case={result.kept}", "Structures"
    if step == "limits":
        name = structure_of(choices)
        return held_as("receding_horizon", result.kept, name), "Receding horizon"
    if step == "tuning":
        usual = TuneChoices(case=result.tuning.case).values()
        keys = [k for k, v in result.tuning.values().items() if v != usual[k]]
        return _address("tune", result.tuning, ["case", *keys]), "Tune"
    if step == "robustness":
        more = {"n": choices.n, "seed": choices.seed}
        return held_as("robustness", result.kept, "tuned", more), "Robustness"
    return "", ""


def _address(page: str, choices: Any, keys: Sequence[str]) -> str:
    values = {key: getattr(choices, key) for key in keys}
    texts = {k: ",".join(v) if isinstance(v, list) else v for k, v in values.items()}
    return f"{page}?{urlencode(texts)}" if texts else page


# Words


def _sound(candidate: Candidate) -> bool:
    """Tell whether a fit is good, and the gain of some input known at all."""
    found = candidate.estimate
    if found is None or not found.is_good:
        return False
    gains = [pair for name, pair in found.derived().items() if name.startswith("gain")]
    return any(error < abs(value) for value, error in gains)


def _row(found: Estimate, checked: Any) -> dict[str, Any]:
    with np.errstate(all="ignore"):
        beyond = found.validate(checked, "estimate")
    numbers = {"yic": found.yic, "r2": found.r2_t, "checked": beyond}
    return {
        "orders": str(found.orders),
        **{k: float(x) if math.isfinite(x) else None for k, x in numbers.items()},
    }


def _model_words(
    found: Estimate, choices: WorkbenchChoices, rows: Sequence[Mapping[str, Any]]
) -> str:
    checked, units = choices.checked, choices.whole.units
    y = found.record.names["y"][0]
    unit = units.get(y, "")
    gains = [
        f"gain of {name.removeprefix('gain of ')} {value:.3g} \u00b1 {error:.1g}"
        for name, (value, error) in found.derived().items()
        if name.startswith("gain of")
    ]
    delays = ", ".join(map(str, found.orders.nk))
    own = next(row for row in rows if row["orders"] == str(found.orders))
    rms = float(np.std(checked.y[:, 0] - found.explained(checked, "estimate")))
    share = "" if own["checked"] is None else f" (R\u00b2 {own['checked']:.2f})"
    order = ORDER.get(found.orders.na, f"{found.orders.na}th")
    words = (
        f"{order} order {found.orders}, delay {delays} samples, {', '.join(gains)}; "
        f"misses the span for validation by {rms:.2g} {unit}".rstrip()
        + f" r.m.s.{share}."
    )
    best = max(rows, key=lambda row: _or_least(row["checked"]))
    if _or_least(best["checked"]) > _or_least(own["checked"]) + 0.05:
        words += f" {best['orders']} does better there: R\u00b2 {best['checked']:.2f}."
    return words


def _or_least(value: float | None) -> float:
    return -math.inf if value is None else value


def _time(seconds: float) -> str:
    return "never" if math.isnan(seconds) else f"in {seconds:.4g} s"


def _step_words(run: Run) -> str:
    found: StepMeasures = measures(run).steps[0]
    if math.isnan(found.settling):
        return "it does not settle, as its limits or its weights do not let it"
    over = f"overshoot {100 * found.overshoot:.2g} %"
    return f"it settles {_time(found.settling)}, {over}"


def _broken(run: Run) -> str:
    parts = measures(run).violations.items()
    found = [f"{key} {part.samples} times" for key, part in parts if part.samples]
    return f"limits broken: {', '.join(found)}" if found else "all limits are kept"


# Pictures: in the units of the record, not in deviations


def charts(done: Mapping[str, Any]) -> list[Chart]:
    """Charts of the steps that there is something of."""
    found: list[Chart] = []
    if "data" not in done:
        return found
    choices: WorkbenchChoices = done["data"].choices
    rest_y, rest_u = (float(part[0]) if len(part) else 0.0 for part in choices.rest)
    if "model" in done:
        best = {done["model"].orders: done["model"].estimate}
        spans = (choices.fitted.time[-1], choices.checked.time[0])
        part = choices.checked if spans[1] >= spans[0] else None
        fit = record_charts(choices.treated, best, part)[0]
        response = estimate_charts(best)[0]
        found += [_as("fit", _moved(fit, rest_y)), _as("response", response)]
    output, signal = record_charts(choices.whole)
    output = replace(output, title="Output, measured")
    found += [_as("data_output", output), _as("data_signal", signal)]
    loops = []
    if "limits" in done:
        loops.append(("loop", {"with limits": done["limits"].run}))
    if "tuning" in done:
        runs = {"before": done["limits"].stepped, "tuned": done["tuning"].stepped}
        loops.append(("tuned", runs))
    for name, runs in loops:
        output, moved = loop_charts(runs)[:2]
        found.append(_as(f"{name}_output", _moved(output, rest_y)))
        found.append(_as(f"{name}_input", _moved(moved, rest_u)))
    if "robustness" in done:
        robust: Robust = done["robustness"]
        pictures = ensemble_charts(
            robust.study, {"tuned": robust.nominal}, dict(robust.study.nominal)
        )
        for chart, rest in zip(pictures[1:3], (rest_y, rest_u), strict=True):
            found.append(_as(f"band_{chart.name}", _moved(chart, rest)))
    return found


def _as(name: str, chart: Chart) -> Chart:
    return replace(chart, name=name)


def _moved(chart: Chart, by: float) -> Chart:
    """Chart of deviations, in the units of the record."""

    def moved(curve: Curve) -> Curve:
        fields = [field.name for field in dataclasses.fields(curve)]
        parts = {
            key: getattr(curve, key) + by
            for key in ("values", "low", "high", "nominal")
            if key in fields and getattr(curve, key) is not None
        }
        return replace(curve, **parts)

    low, high = chart.limits
    return replace(
        chart,
        curves=tuple(map(moved, chart.curves)),
        references=tuple(map(moved, chart.references)),
        limits=(low + by, high + by),
    )


# Python


def _lines_of(choices: WorkbenchChoices, orders: str) -> tuple[list[str], list[str]]:
    """Give imports and lines of steps 1 and 2, those of the page Identify."""
    text = choices.script(orders).replace("table(found)", "ranking(found)")
    lines = text.replace(", table\n", ", table as ranking\n").splitlines()
    imports = [line for line in lines if line.startswith(("from ", "import "))]
    rest = "\n".join(line for line in lines if line not in imports).strip("\n")
    return imports, rest.splitlines()


def _case_lines(choices: WorkbenchChoices) -> list[str]:
    """Lines that make ``example`` of ``best``: steps 3 and 4."""
    rest_y, rest_u = choices.rest
    name, (size, seen) = structure_of(choices), _sizes(choices)
    sides = {
        f"{key}_{end}": _side(getattr(choices, f"{key}_{end}"), len(rest), sign)
        for key, rest in (("u", rest_u), ("y", rest_y))
        for end, sign in (("low", -1.0), ("high", 1.0))
    }
    du = _side(choices.du_most, len(rest_u), 1.0)
    lines = [
        "example = model_case(best.to_model(), best.covariance)",
        "# what was taken away from outputs and inputs: all below are deviations",
        f"rest_y, rest_u = {literal(rest_y)}, {literal(rest_u)}",
        "limits = Limits(",
        *(
            f"    {key}=({literal(sides[f'{key}_low'])} - rest_{key}, "
            f"{literal(sides[f'{key}_high'])} - rest_{key}),"
            for key in ("u", "y")
        ),
        f"    du=({literal(-du)}, {literal(du)}),",
        ")",
        f'name = "{name}"',
        "known, scenario = example.designs, example.scenario",
        "designs = {",
        "    key: replace(known[key], limits=limits)",
        "    for key in (name, *known)",
        "    if known[key].structure in STRUCTURES",
        "}",
        f"R = {choices.weight_move!r} * np.asarray(known[name].R)",
        "designs[name] = replace(designs[name], R=R)",
        f'disturbed = {size!r} * scenario.of("input_disturbance", example.model.n_u)',
        "scenario = replace(",
        f"    scenario, reference={size!r} * scenario.reference, "
        "input_disturbance=disturbed",
        ")",
    ]
    if seen:
        lines.append(f"scenario = replace(scenario, v=scenario.v * {seen!r})")
    return [*lines, "example = replace(example, designs=designs, scenario=scenario)"]


_CASE_IMPORTS = (
    "from nmss_lab.cases import model_case",
    "from nmss_lab.controller import Limits",
    "from nmss_lab.mpc import STRUCTURES",
)


def _origin(choices: WorkbenchChoices, model: Model) -> Origin:
    """Python of the case that is kept for the other pages."""
    imports, lines = _lines_of(choices, model.orders)
    needed = [line for line in imports if line != "from nmss_lab.files import save"]
    quiet = [line for line in lines if not line.startswith(("print(", "save("))]
    return Origin((*needed, *_CASE_IMPORTS), (*quiet, "", *_case_lines(choices)))


def script(bench: Bench, choices: WorkbenchChoices) -> str:
    """Python that does all the steps that are done, and prints what the page says."""
    done = bench.current(choices)
    model: Model | None = done.get("model")
    imports, lines = _lines_of(choices, model.orders if model else "")
    lines = ["# 1 Data, 2 Model", *lines]
    if "structure" in done:
        imports += [*_CASE_IMPORTS, "from nmss_lab.analysis import review"]
        lines += ["", "# 3 Structure, 4 Limits", *_case_lines(choices)]
        lines.append("print(review(designs[name].build()))")
    if "limits" in done:
        disturbed = bool(choices.whole.names["v"])
        v = ", v=np.zeros_like(scenario.v)[:N]" * disturbed
        imports += [
            "from nmss_lab.cases import piecewise",
            "from nmss_lab.measures import table",
            "from nmss_lab.simulate import closed_loop",
        ]
        lines += [
            f"N = {_length(done['limits'].example)}",
            "reference = piecewise(N, (1, scenario.reference[-1]))",
            f"step = replace(scenario, reference=reference{v}, input_disturbance=None)",
            "run = closed_loop(example.plant, designs[name].build(), step)",
            'print(*table({"with limits": run}))',
        ]
    if "tuning" in done:
        tuning: TuneChoices = done["tuning"].tuning
        start = tuning.start()
        more, search = tuning._tune_lines(start, tuning.aims(tuning.bench()))
        imports += [*more, "from nmss_lab.predict import Horizon"]
        lines += ["", "# 5 Tuning", *tuning.design_lines("design", start), *search]
        lines.append("print(review(tuned.design.build()))")
    if "robustness" in done:
        imports.append("from nmss_lab.montecarlo import monte_carlo")
        robust = _robustness(done["tuning"].kept)
        drawn = ["uncertainty = EstimatedModels([best])"]
        needed = ["from nmss_lab.uncertainty import EstimatedModels"]
        if robust.uncertainty == "covariance":
            drawn, needed = robust._uncertainty_lines(), robust._uncertainty_imports()
        imports += needed
        lines += [
            "",
            "# 6 Robustness",
            *drawn,
            'designs = {"tuned": tuned.design}',
            f"n, seed = {choices.n}, {choices.seed}",
            "study = monte_carlo(designs, uncertainty, example.scenario, n, seed)",
            "print(study.rates().to_string())",
            'print(study.table["radius"].max())',
        ]
    if "report" in done:
        imports += [
            "from pathlib import Path",
            "from nmss_lab.files import Study",
            "from nmss_lab.report import report",
        ]
        lines += [
            "",
            "# 7 Report",
            "study = Study(tuned.design, tuned.design.model, example.scenario)",
            'save("design.json", study)',
            "text = report(",
            "    study,",
            "    uncertainty=uncertainty,",
            "    realisations=n,",
            "    seed=seed,",
            f"    title={title_of(choices)!r},",
            ")",
            'Path("report.html").write_text(text, encoding="utf-8")',
        ]
    used = ["replace"] * ("structure" in done)
    needs = [line for line in dict.fromkeys(imports) if line != "import numpy as np"]
    text = "\n".join([*head(needs), "", *lines]) + "\n"
    if not used:
        text = text.replace("from dataclasses import replace\n\n", "")
        if "np." not in text:
            text = text.replace("import numpy as np\n\n", "")
    return text


# Limits as text


def _numbers(text: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",") if part.strip()]
    except ValueError as error:
        raise ValueError("expected numbers, with commas between them") from error
    if not all(math.isfinite(value) for value in values):
        raise ValueError("expected finite numbers; leave it empty for no limit")
    return values


def _side(text: str, size: int, sign: float) -> Array:
    """One side of a limit, (size,); infinite without one."""
    values = _numbers(text) or [sign * math.inf]
    if len(values) not in (1, size):
        raise ValueError(
            f"limits {text!r}: {len(values)} numbers, expected one, or one for each of "
            f"{size}"
        )
    return np.broadcast_to(np.array(values), (size,)).copy()


def _listed(values: Array) -> str:
    return ", ".join(f"{value:.3g}" for value in values)


def _ends(low: Array, high: Array) -> tuple[str, str]:
    """Texts of a range, rounded outwards."""
    size = np.maximum(high - low, 1e-3 * np.maximum(np.abs(high), 1e-9))
    unit = 10.0 ** (np.floor(np.log10(size)) - 2.0)
    sides = np.floor(low / unit + 1e-9) * unit, np.ceil(high / unit - 1e-9) * unit
    first, last = (", ".join(f"{x + 0.0:.6g}" for x in side) for side in sides)
    return first, last
