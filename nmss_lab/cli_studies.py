"""Commands that take long: ``study``, ``tune``, ``report``; here or on a cluster.

As in ``nmss_lab.cli``, what is numerical is imported inside the commands.
"""

from __future__ import annotations

import argparse
import re
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nmss_lab.cases import Case
    from nmss_lab.montecarlo import Event, MonteCarlo
    from nmss_lab.tuning import Goal, Step, Tuned
    from nmss_lab.uncertainty import Uncertainty

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""

SHARES = {"a": 5.0, "b": 15.0}
"""Default ranges of the coefficients in per cent, those of section 6.3.2."""

LEVELS = "stress1", "stress2", "stress3", "corners1", "corners2", "corners3"


def add_study(commands: Any) -> None:
    """Add the command ``study``."""
    study = commands.add_parser(
        "study", help="run a case on many plants and count what goes wrong"
    )
    add = study.add_argument
    add("case", help="its name, see nmss-lab simulate, or a design file (.json)")
    add("--structure", nargs="+", metavar="NAME", help="all of the case by default")
    _add_uncertainty(study)
    add("-n", type=int, help="realisations: 1000, or all corners, by default")
    add("--seed", type=int, default=0, help="the same seed draws the same plants")
    add("--csv", metavar="FILE", help="write a row for each loop and output")
    _add_executor(study)
    study.set_defaults(command=_study)


def add_tune(commands: Any) -> None:
    """Add the command ``tune``."""
    tune = commands.add_parser("tune", help="find weights that attain goals")
    add = tune.add_argument
    add("case", help="its name, see nmss-lab simulate, or a design file (.json)")
    add("--structure", metavar="NAME", help="the first of the case by default")
    add(
        "--goal",
        action="append",
        type=_wish,
        metavar="WISH",
        help="such as 'overshoot<=0.05', 'rise<=3@2' (of output 2) or 'IAE<=5*' "
        "(hard); may be repeated",
    )
    add("--evaluations", type=int, default=500, help="designs to try at most")
    add("--starts", type=int, default=3, help="places to search from")
    add("--seed", type=int, default=0, help="the same seed finds the same weights")
    add("--per-step", action="store_true", help="weights of their own at each step")
    add("--design", metavar="FILE", help="write the tuned design")
    _add_executor(tune)
    tune.set_defaults(command=_tune)


def add_report(commands: Any) -> None:
    """Add the command ``report``."""
    report = commands.add_parser(
        "report", help="write a report of a design as one HTML file"
    )
    add = report.add_argument
    add("design", help="file of a design or a study, see nmss_lab.files.save")
    add("--out", metavar="FILE", help="by default the design's name with .html")
    _add_uncertainty(report)
    add(
        "--realisations",
        type=int,
        metavar="N",
        help="run it on N plants; with an uncertainty 1000, or all corners, by default",
    )
    add("--seed", type=int, default=0, help="the same seed draws the same plants")
    _add_executor(report)
    report.set_defaults(command=_report)


def _add_uncertainty(command: Any) -> None:
    add = command.add_argument
    add(
        "--uncertainty",
        choices=("covariance", "ranges", *LEVELS),
        help="covariance of the case (default where it has one), ranges of the "
        "coefficients, or draws or all corners of a stress level of Table 4.1",
    )
    for group, share in SHARES.items():
        add(f"--{group}", type=float, help=f"range in per cent, {share:g} by default")


def _add_executor(command: Any) -> None:
    where = command.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=int, default=1, metavar="N", help="processes, 1 by default"
    )
    where.add_argument(
        "--cluster", default="", metavar="ADDRESS", help="Dask, such as tcp://host:8786"
    )


def line(cells: Iterable[str]) -> str:
    """Return a line of a table: a name and columns of numbers."""
    first, *rest = cells
    return f"{first:<24}" + "".join(f"{cell:>12}" for cell in rest)


def case_named(name: str) -> Case:
    """Build the case of that name, or that of a design file: a name with .json."""
    from nmss_lab.cases import case
    from nmss_lab.files import case_of

    if not name.endswith(".json"):
        return case(name)
    return case_of(_content(name), Path(name).name)


def _content(file: str) -> Any:
    """Content of a file; what is wrong with it is told with its name."""
    from nmss_lab.files import load

    try:
        return load(file)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def designs_of(case: Case, names: Sequence[str] | None) -> dict[str, Any]:
    """Pick designs of a case by name, all without any."""
    for name in names or ():
        if name not in case.designs:
            known = ", ".join(case.designs)
            raise ValueError(f'structure "{name}": this case has {known}')
    return {name: case.designs[name] for name in names or case.designs}


def _check_folder(file: str | None) -> None:
    """Refuse a place that cannot be written to before the work, not after it."""
    if file and not Path(file).absolute().parent.is_dir():
        raise FileNotFoundError(f"{file}: there is no such folder")


def _say(text: str) -> None:
    """Show progress: on one line of a terminal, line by line elsewhere."""
    if sys.stderr.isatty():
        print(f"\r{text:<60}", end="", file=sys.stderr, flush=True)
    else:
        print(text, file=sys.stderr, flush=True)


def _say_done(done: int, asked: int) -> None:
    _say(f"{done:,} of {asked:,}")


def _end_of_progress() -> None:
    if sys.stderr.isatty():
        print(f"\r{'':<60}\r", end="", file=sys.stderr, flush=True)


# --- Studies -----------------------------------------------------------------------


def _study(arguments: argparse.Namespace) -> int:
    """Run a study; print its rates and write its table, also after Ctrl-C."""
    from nmss_lab.montecarlo import join

    _check_folder(arguments.csv)
    chosen = case_named(arguments.case)
    uncertainty, told = _uncertainty(chosen, arguments)
    parts: list[MonteCarlo] = []
    interrupted = False
    try:
        _collect(chosen, uncertainty, arguments, parts)
    except KeyboardInterrupt:
        interrupted = True
    _end_of_progress()
    if not parts:
        print("stopped before any realisation was finished", file=sys.stderr)
        return INTERRUPTED
    study = join(parts)
    _print_study(chosen, study, told)
    if arguments.csv:
        study.table.to_csv(arguments.csv, index=False)
        print(f"\nwritten: {arguments.csv}")
    return INTERRUPTED if interrupted else 0


def _collect(
    case: Case,
    uncertainty: Uncertainty,
    arguments: argparse.Namespace,
    parts: list[MonteCarlo],
) -> None:
    """Add the parts of a study to a list, as they are done."""
    from nmss_lab.montecarlo import monte_carlo_parts
    from nmss_lab.parallel import executor_for

    designs = designs_of(case, arguments.structure)
    with executor_for(arguments.workers, arguments.cluster) as executor:
        for part in monte_carlo_parts(
            designs,
            uncertainty,
            case.scenario,
            arguments.n,
            arguments.seed,
            executor=executor,
        ):
            parts.append(part)
            _say_done(sum(map(len, parts)), part.asked)


def _uncertainty(case: Case, arguments: argparse.Namespace) -> tuple[Uncertainty, str]:
    """Return what draws the plants, and how to say it."""
    from nmss_lab.uncertainty import ParameterCovariance, RelativeRanges

    if case.equation is not None:
        raise ValueError(
            f"{case.name}: the coefficients depend on the state, so that none of "
            "these uncertainties fits; in Python, monte_carlo takes a Sampler"
        )
    usual = "ranges" if case.covariance is None else "covariance"
    kind = arguments.uncertainty or usual
    stated = {group: getattr(arguments, group) for group in SHARES}
    given = {group: share for group, share in stated.items() if share is not None}
    if given and kind != "ranges":
        raise ValueError(f"--{next(iter(given))} belongs to --uncertainty ranges")
    if kind == "ranges":
        shares = {**SHARES, **given}
        told = " and ".join(f"{share:g} % in {g}" for g, share in shares.items())
        relative = {g: share / 100.0 for g, share in shares.items()}
        return RelativeRanges(case.model, relative), f"coefficients within {told}"
    if kind == "covariance":
        if case.covariance is None:
            raise ValueError(
                f"{case.name} states no covariance: take --uncertainty ranges"
            )
        return (
            ParameterCovariance(case.model, case.covariance),
            "parameters normal with the covariance of the case",
        )
    return _stressed(case, kind)


def _stressed(case: Case, kind: str) -> tuple[Uncertainty, str]:
    """Return draws or corners of a stress level, sampled as the case's plant is."""
    from nmss_lab.cases import stress
    from nmss_lab.models import LinearPlant

    if not case.name.startswith("ifac93"):
        raise ValueError(
            f"{case.name}: stress levels are those of the IFAC'93 plant; take "
            "--uncertainty ranges"
        )
    assert isinstance(case.plant, LinearPlant)  # these cases are sampled ones
    corners, level = kind.startswith("corners"), int(kind[-1])
    told = f"{'corners' if corners else 'draws'} of stress level {level} (Table 4.1)"
    return stress(level, corners, case.plant.dt, case.plant.substeps), told


def _events(case: Case) -> Mapping[str, Event]:
    """Return the usual events, and leaving the bands of the case around zero."""
    import numpy as np

    from nmss_lab.montecarlo import EVENTS, event

    bands = {
        f"leaves {name}": event("peak", float(high))
        for name, (low, high) in case.bands.items()
        if np.ndim(high) == 0 and np.ndim(low) == 0 and low == -high
    }
    return {**EVENTS, **bands}


def _print_study(case: Case, study: MonteCarlo, told: str) -> None:
    print(f"{case.title}: {told}")
    print(f"{len(study):,} of {study.asked:,} realisations, seed {study.seed}")
    print("share with its 95 % interval; median and worst of those it happens to")
    heads = "count", "share", "from", "to", "median", "worst"
    for design, rates in study.rates(_events(case)).groupby("design", sort=False):
        print("\n" + line([str(design), *heads]))
        for row in rates.to_dict("records"):
            shares = (f"{100.0 * row[name]:.1f} %" for name in ("share", "low", "high"))
            sizes = [f"{row[name]:.4g}" for name in ("median", "worst")]
            if not row["count"]:
                sizes = ["-", "-"]
            cells = [row["event"], str(row["count"]), *shares, *sizes]
            print(f"{line(cells)}  {row['severity']}")


# --- Tuning ------------------------------------------------------------------------

WISH = re.compile(r"(\w+)\s*<=\s*([^\s*@]+)\s*(\*?)\s*(?:@\s*(\w+))?\s*(\*?)")


def _wish(text: str) -> tuple[str, float, bool, str]:
    """Objective, target, whether it is hard, and output out of "rise<=3@1*"."""
    found = WISH.fullmatch(text.strip())
    try:
        if found is None:
            raise ValueError
        name, target, hard, output, also = found.groups()
        return name, float(target), bool(hard or also), output or "1"
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r}: expected a wish such as 'overshoot<=0.05', 'rise<=3@2' or "
            "'IAE<=5*'"
        ) from None


def _tune(arguments: argparse.Namespace) -> int:
    """Tune a design; print goals and weights, and write it, also after Ctrl-C."""
    from nmss_lab.files import save
    from nmss_lab.parallel import executor_for
    from nmss_lab.tuning import Trial, tune
    from nmss_lab.weights import Weights

    _check_folder(arguments.design)
    chosen = case_named(arguments.case)
    name = arguments.structure or next(iter(chosen.designs))
    design = designs_of(chosen, [name])[name]
    weights = Weights(design, per_step=arguments.per_step)
    trials = [Trial(chosen.plant, chosen.scenario)]
    if arguments.goal:
        goals = [_goal(chosen, wish) for wish in arguments.goal]
    else:
        goals = _default_goals(chosen, design, trials)
    with (
        _until_interrupted() as interrupted,
        executor_for(arguments.workers, arguments.cluster) as executor,
    ):
        tuned = tune(
            design,
            goals,
            trials,
            weights,
            arguments.starts,
            arguments.seed,
            evaluations=arguments.evaluations,
            callback=_reporting(interrupted),
            executor=executor,
        )
    _end_of_progress()
    print(f"{chosen.title}: {name}")
    _print_tuned(tuned, "Stopped by Ctrl-C." if interrupted else tuned.stopped)
    if arguments.design:
        save(arguments.design, tuned.design)
        print(f"\nwritten: {arguments.design}")
    return INTERRUPTED if interrupted else 0


def _goal(case: Case, wish: tuple[str, float, bool, str]) -> Goal:
    from nmss_lab.tuning import Goal

    objective, target, hard, output = wish
    names = case.model.y_names
    numbers = {str(i + 1): i for i in range(len(names))}
    channels = {**numbers, **{name: i for i, name in enumerate(names)}}
    if output not in channels:
        raise ValueError(
            f'output "{output}": this case has {", ".join(names)}, or 1 to {len(names)}'
        )
    channel = channels[output]
    label = f"{objective} {names[channel]}"
    return Goal(objective, target, 0.0 if hard else None, channel, name=label)


def _default_goals(case: Case, design: Any, trials: Sequence[Any]) -> list[Goal]:
    """At most 5 % overshoot, as quick as before, and four fifths of the IAE."""
    import numpy as np

    from nmss_lab.tuning import evaluate

    measured = [
        _goal(case, (objective, 1.0, False, str(channel + 1)))
        for channel in range(case.model.n_y)
        for objective in ("overshoot", "rise", "IAE")
    ]
    before = evaluate(design, measured, trials)
    goals = []
    for goal, value in zip(measured, before, strict=True):
        if not np.isfinite(value) or (value <= 0.0 and goal.objective != "overshoot"):
            continue  # an output without a step of its own has neither
        targets = {"overshoot": 0.05, "rise": value, "IAE": 0.8 * value}
        wish = str(goal.objective), targets[str(goal.objective)], False
        goals.append(_goal(case, (*wish, str(goal.channel + 1))))
    if not goals:
        raise ValueError("the design as it is has no measures: state goals with --goal")
    return goals


@contextmanager
def _until_interrupted() -> Iterator[list[bool]]:
    """Yield a list that is empty until Ctrl-C, which stops the process if repeated."""
    happened: list[bool] = []
    before = signal.getsignal(signal.SIGINT)

    def note(number: int, frame: Any) -> None:
        happened.append(True)
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, note)
    try:
        yield happened
    finally:
        signal.signal(signal.SIGINT, before)


def _reporting(interrupted: list[bool]) -> Callable[[Step], bool]:
    def report(step: Step) -> bool:
        _say(f"{step.evaluation} designs, attainment factor {step.attainment:.4g}")
        return bool(interrupted)

    return report


def _print_tuned(tuned: Tuned, stopped: str) -> None:
    import numpy as np

    print("\n" + line(["goal", "target", "before", "after", "missed"]))
    for row in tuned.table():
        sizes = (f"{row[n]:.4g}" for n in ("target", "before", "after", "missed"))
        print(line([row["goal"], *sizes]) + ("  hard" if row["hard"] else ""))
    met = "every goal is met" if tuned.is_attained else "not every goal is met"
    print(f"\nattainment factor {tuned.attainment:.4g}: {met}")
    print(f"{tuned.evaluations} designs tried. {stopped}\n")
    for name, weight in tuned.weights.items():
        rows = np.array2string(weight, precision=5, suppress_small=True)
        print(f"{name:<24}" + rows.replace("\n", "\n" + 24 * " "))


# --- Reports -----------------------------------------------------------------------


def _report(arguments: argparse.Namespace) -> int:
    """Write a report of a design file; after Ctrl-C of what was drawn until then."""
    from nmss_lab.files import case_of, write
    from nmss_lab.parallel import executor_for
    from nmss_lab.report import report

    design = Path(arguments.design)
    out = Path(arguments.out or design.with_suffix(".html"))
    _check_folder(str(out))
    if out.absolute() == design.absolute():
        raise ValueError(f"--out {out}: this is the design file itself")
    content = _content(arguments.design)
    chosen = case_of(content, design.name)
    uncertainty, stated = None, ("realisations", "uncertainty", *SHARES)
    if any(getattr(arguments, name) is not None for name in stated):
        uncertainty, _ = _uncertainty(chosen, arguments)

    with (
        _until_interrupted() as interrupted,
        executor_for(arguments.workers, arguments.cluster) as executor,
    ):

        def told(done: int, asked: int) -> bool:
            _say_done(done, asked)
            return bool(interrupted)

        text = report(
            content,
            uncertainty=uncertainty,
            realisations=arguments.realisations,
            seed=arguments.seed,
            title=f"Report of {design.name}",
            executor=executor,
            callback=told,
        )
    _end_of_progress()
    write(out, text)
    print(chosen.title, *chosen.notes, sep="\n- ")
    print(f"written: {out}, {len(text.encode()) / 1000.0:.0f} kB")
    return INTERRUPTED if interrupted else 0
