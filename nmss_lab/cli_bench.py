"""The command ``nmss-lab bench``: times beside a baseline of the same run."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from pathlib import Path
from typing import Any

from nmss_lab.cli_serve import beside


def add_bench(commands: Any) -> None:
    """Add the command to a parser's commands."""
    bench = commands.add_parser(
        "bench", help="measure times, each beside a baseline of the same run"
    )
    add = bench.add_argument
    add("part", nargs="*", help="such as steps or pages; all by default")
    add("--quick", action="store_true", help="few repetitions: does it run?")
    add("--json", action="store_true", help="print JSON")
    add(
        "--out",
        metavar="FILE",
        help="write the tables to FILE; of all parts in a checkout, without --quick, "
        "to benchmarks/RESULTS.md by default",
    )
    bench.set_defaults(command=_bench)


def _bench(arguments: argparse.Namespace) -> int:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    folder = beside() / "benchmarks"
    sys.path.insert(0, str(folder))
    frame, run = (importlib.import_module(name) for name in ("frame", "run"))
    unknown = [part for part in arguments.part if part not in run.PARTS]
    if unknown:
        known = ", ".join(run.PARTS)
        raise ValueError(f'there is no benchmark "{unknown[0]}"; there are {known}')
    parts = arguments.part or run.PARTS
    figures, failures = run.collect(parts, arguments.quick, _say)
    if arguments.json:
        print(json.dumps(frame.as_json(figures), indent=1))
    else:
        print(frame.markdown(figures), end="")
    out = arguments.out
    complete = not (arguments.part or arguments.quick or failures)
    if out is None and complete and (folder.parent / "pyproject.toml").exists():
        out = folder / "RESULTS.md"
    if out is not None:
        Path(out).write_text(frame.markdown(figures), encoding="utf-8")
        _say(f"written to {out}")
    for failure in failures:
        _say(f"failed: {failure}")
    return 1 if failures else 0


def _say(text: str) -> None:
    """Tell how far it is, apart from what is printed."""
    print(text, file=sys.stderr, flush=True)
