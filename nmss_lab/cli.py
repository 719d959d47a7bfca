"""The command ``nmss-lab``: serve pages, simulate, identify, study, tune, report, ...

Numerical and page libraries are imported inside the commands that need them, so
that ``--version`` and ``--help`` answer at once.
"""

import argparse
import importlib
import json
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from nmss_lab import __version__
from nmss_lab.cli_bench import add_bench
from nmss_lab.cli_serve import add_serve
from nmss_lab.cli_studies import (
    add_report,
    add_study,
    add_tune,
    case_named,
    designs_of,
)
from nmss_lab.cli_studies import line as _line

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments after the command's name; those of the process by default.

    Returns
    -------
    int
        0 after success, 1 after an error that is the caller's to mend.  Arguments
        that cannot be read leave through ``SystemExit(2)``, as argparse does.  130
        where Ctrl-C ended a study or a search, whose results so far are printed.
    """
    arguments = _parser().parse_args(argv)
    command: Callable[[argparse.Namespace], int | None] = arguments.command
    try:
        return command(arguments) or 0
    except BrokenPipeError:  # whoever read the output, such as head, has enough
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - closed with the process
    except (ValueError, OSError) as error:
        print(f"nmss-lab: {error}", file=sys.stderr)
        return 1
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="nmss-lab",
        description="Predictive control structures in the non-minimal state space.",
    )
    parser.add_argument(
        "--version", action="version", version=f"%(prog)s {__version__}"
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    add_serve(commands)
    _add_reproduce(commands)
    _add_simulate(commands)
    _add_identify(commands)
    add_study(commands)
    add_tune(commands)
    add_report(commands)
    add_bench(commands)
    return parser


def _add_reproduce(commands: Any) -> None:
    reproduce = commands.add_parser(
        "reproduce", help="compare the thesis's numbers with computed ones"
    )
    reproduce.add_argument("chapter", nargs="?", type=int, help="all by default")
    reproduce.add_argument("--json", action="store_true", help="print JSON")
    reproduce.set_defaults(command=_reproduce)


def _add_simulate(commands: Any) -> None:
    simulate = commands.add_parser(
        "simulate", help="run a case or a design file in closed loop"
    )
    simulate.add_argument(
        "case",
        nargs="?",
        help="its name, or a design file (.json); without it: list the cases",
    )
    simulate.add_argument("--structure", help="name of a structure")
    simulate.add_argument("--csv", metavar="FILE", help="write the run to FILE")
    simulate.set_defaults(command=_simulate)


def _add_identify(commands: Any) -> None:
    identify = commands.add_parser(
        "identify", help="rank models of one output of a record and write the best"
    )
    add = identify.add_argument
    add("file", help="record: .csv, .mat, .xlsx or .parquet")
    add("--inputs", type=_names, required=True, help="column names, with commas")
    add("--output", required=True, help="column name")
    add("--disturbances", type=_names, default=(), help="measured, with commas")
    clock = identify.add_mutually_exclusive_group(required=True)
    clock.add_argument("--time", help="column of seconds or of ISO dates")
    clock.add_argument("--dt", type=float, help="interval, if there is no such column")
    add("--skip-bad", action="store_true", help="leave out rows that are no numbers")
    add("--resample", type=float, metavar="DT", help="read at regular times")
    add(
        "--detrend",
        choices=("first", "output", "constant", "linear", "none"),
        default="first",
        help="subtract first values (of the output alone), means, lines or nothing",
    )
    starts = "rest", "skip", "estimate"
    add("--start", choices=starts, default="rest", help="state before the record")
    add(
        "--na", type=_whole_numbers, default=(1, 2, 3), help="past outputs, such as 1-3"
    )
    add("--nb", type=_whole_numbers, default=(1, 2, 3), help="coefficients an input")
    add(
        "--nk", type=_whole_numbers, default=(1, 2, 3, 4, 5), help="delay of each input"
    )
    add(
        "--noise",
        type=_noise_orders,
        metavar="AR[,MA]",
        help="noise model: RIV, not SRIV",
    )
    add("--model", metavar="FILE", help="write the best estimate, with covariance")
    identify.set_defaults(command=_identify)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _whole_numbers(text: str) -> tuple[int, ...]:
    """Whole numbers out of "1-3", "2" or "1,3"."""
    found: list[int] = []
    try:
        for part in text.split(","):
            first, _, last = part.partition("-")
            found += range(int(first), int(last or first) + 1)
    except ValueError:
        found = []
    if not found:
        raise argparse.ArgumentTypeError(
            f"{text!r}: expected numbers such as 1-3 or 2,4"
        )
    return tuple(found)


def _noise_orders(text: str) -> tuple[int, ...]:
    """One or two orders out of "2" or "2,1"."""
    orders = _whole_numbers(text)
    if len(orders) > 2 or "-" in text:
        raise argparse.ArgumentTypeError(f"{text!r}: expected AR or AR,MA, such as 2,1")
    return orders


def _identify(arguments: argparse.Namespace) -> None:
    """Fit every structure, print the ranking and the best model, and write it."""
    identify = importlib.import_module("nmss_lab.identify")
    record = _record(arguments)
    noise = identify.Noise(*arguments.noise) if arguments.noise else None
    print(f"{len(record.time)} samples every {record.dt:g} s", *record.notes, sep="; ")
    ranked = identify.order_search(
        record,
        arguments.na,
        arguments.nb,
        arguments.nk,
        noise,
        start=arguments.start,
    )
    _print_ranking(ranked)
    best = ranked[0]
    if best.estimate is None or best.problem:
        raise ValueError(f"no structure gave a model to trust; {best.problem}")
    _print_estimate(best.estimate)
    if arguments.model:
        importlib.import_module("nmss_lab.files").save(arguments.model, best.estimate)
        print(f"written: {arguments.model}")


def _record(arguments: argparse.Namespace) -> Any:
    """Record as the arguments ask for it."""
    record = importlib.import_module("nmss_lab.records").Record.from_file(
        arguments.file,
        y=[arguments.output],
        u=arguments.inputs,
        v=arguments.disturbances,
        time=arguments.time,
        dt=arguments.dt,
        bad="skip" if arguments.skip_bad else "refuse",
    )
    if arguments.resample:
        record = record.resample(arguments.resample)
    if arguments.detrend == "output":
        return record.detrend("first", ["y"])
    return record if arguments.detrend == "none" else record.detrend(arguments.detrend)


def _print_ranking(ranked: Sequence[Any]) -> None:
    print("\n" + _line(["orders [na nb nk]", "YIC", "BIC", "R_T^2", "parameters"]))
    for candidate in ranked[:ROWS]:
        row = candidate.row
        values = (f"{row[name]:.5g}" for name in ("yic", "bic", "r2_t", "parameters"))
        print(f"{_line([row['orders'], *values])}  {row['problem']}".rstrip())
    if len(ranked) > ROWS:
        failed = sum(bool(candidate.problem) for candidate in ranked)
        print(f"... of {len(ranked)} structures, {failed} of them not to be trusted")
    sparing = min(ranked, key=lambda c: (bool(c.problem), c.row["bic"]))
    print(f"YIC prefers {ranked[0].orders}, BIC {sparing.orders}")


def _print_estimate(estimate: Any) -> None:
    print(f"\n{estimate.method} {estimate.orders}, {estimate.passes} passes")
    errors = estimate.standard_errors
    values = zip(estimate.names, estimate.parameters, errors, strict=True)
    derived = ((name, *pair) for name, pair in estimate.derived().items())
    for name, value, error in (*values, *derived):
        print(_line([name, f"{value:.5g}", f"+- {error:.2g}"]))
    correlation, band = estimate.autocorrelation()
    outside = int((abs(correlation[1:]) > band).sum())
    print(f"{outside} of {len(correlation) - 1} autocorrelations outside the 95 % band")


ROWS = 20
"""Rows of a ranking that are printed."""


def _reproduce(arguments: argparse.Namespace) -> None:
    reproduce = importlib.import_module("nmss_lab.reproduce")
    claims = reproduce.claims(arguments.chapter)
    if arguments.json:
        print(json.dumps([claim.as_dict() for claim in claims], indent=2))
    else:
        print(reproduce.table(claims))


def _simulate(arguments: argparse.Namespace) -> None:
    """List the cases, or run one and print its notes, measures and moves."""
    if arguments.case is None:
        cases = importlib.import_module("nmss_lab.cases")
        for name in cases.CASES:
            case = cases.case(name)
            print(f"{name:<28}{case.title}\n{'':<28}{', '.join(case.designs)}")
        return
    case = case_named(arguments.case)
    designs = designs_of(case, arguments.structure and [arguments.structure])
    if arguments.csv and len(designs) > 1:
        raise ValueError("--csv writes one run: name it with --structure")
    closed_loop = importlib.import_module("nmss_lab.simulate").closed_loop
    runs = {
        name: closed_loop(case.plant, design.build(), case.scenario)
        for name, design in designs.items()
    }
    _print_runs(case, runs)
    if arguments.csv:
        next(iter(runs.values())).record().to_csv(arguments.csv)


def _print_runs(case: Any, runs: Mapping[str, Any]) -> None:
    measures = importlib.import_module("nmss_lab.measures")
    print(case.title, *case.notes, sep="\n- ")
    for channel, name in enumerate(case.model.y_names):
        print(f"\n{name}")
        rows = measures.table(runs, channel)
        print(_line(rows[0]))
        for row in rows:
            print(_line(v if isinstance(v, str) else f"{v:.5g}" for v in row.values()))
    for name, run in runs.items():
        print(f"\n{name}", *run.sentences, sep="\n- ")


if __name__ == "__main__":
    sys.exit(main())
