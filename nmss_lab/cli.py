"""The command ``nmss-lab``: serve the live pages, reproduce the thesis, simulate.

Numerical and page libraries are imported inside the commands that need them, so
that ``--version`` and ``--help`` answer at once.
"""

import argparse
import importlib
import json
import os
import signal
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from nmss_lab import __version__

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
        that cannot be read leave through ``SystemExit(2)``, as argparse does.
    """
    arguments = _parser().parse_args(argv)
    command: Callable[[argparse.Namespace], None] = arguments.command
    try:
        command(arguments)
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
    _add_serve(commands)
    _add_reproduce(commands)
    _add_simulate(commands)
    return parser


def _add_serve(commands: Any) -> None:
    serve = commands.add_parser("serve", help="serve the live pages")
    serve.add_argument("--port", type=int, default=5006, help="0 takes any free port")
    serve.add_argument("--address", default="127.0.0.1", help="address to listen on")
    serve.add_argument("--show", action="store_true", help="open the web browser")
    serve.set_defaults(command=_serve)


def _add_reproduce(commands: Any) -> None:
    reproduce = commands.add_parser(
        "reproduce", help="compare the thesis's numbers with computed ones"
    )
    reproduce.add_argument("chapter", nargs="?", type=int, help="all by default")
    reproduce.add_argument("--json", action="store_true", help="print JSON")
    reproduce.set_defaults(command=_reproduce)


def _add_simulate(commands: Any) -> None:
    simulate = commands.add_parser("simulate", help="run a case in closed loop")
    simulate.add_argument("case", nargs="?", help="its name; without it: list them")
    simulate.add_argument("--structure", help="name of a structure")
    simulate.add_argument("--csv", metavar="FILE", help="write the run to FILE")
    simulate.set_defaults(command=_simulate)


def _reproduce(arguments: argparse.Namespace) -> None:
    reproduce = importlib.import_module("nmss_lab.reproduce")
    claims = reproduce.claims(arguments.chapter)
    if arguments.json:
        print(json.dumps([claim.as_dict() for claim in claims], indent=2))
    else:
        print(reproduce.table(claims))


def _simulate(arguments: argparse.Namespace) -> None:
    """List the cases, or run one and print its notes, measures and moves."""
    cases = importlib.import_module("nmss_lab.cases")
    if arguments.case is None:
        for name in cases.CASES:
            case = cases.case(name)
            print(f"{name:<28}{case.title}\n{'':<28}{', '.join(case.designs)}")
        return
    case = cases.case(arguments.case)
    names = [arguments.structure] if arguments.structure else list(case.designs)
    if names[0] not in case.designs:
        known = ", ".join(case.designs)
        raise ValueError(f'structure "{names[0]}": this case has {known}')
    if arguments.csv and len(names) > 1:
        raise ValueError("--csv writes one run: name it with --structure")
    closed_loop = importlib.import_module("nmss_lab.simulate").closed_loop
    runs = {
        name: closed_loop(case.plant, case.designs[name].build(), case.scenario)
        for name in names
    }
    _print_runs(case, runs)
    if arguments.csv:
        _write_run(runs[names[0]], arguments.csv)


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


def _line(cells: Iterable[str]) -> str:
    first, *rest = cells
    return f"{first:<24}" + "".join(f"{cell:>12}" for cell in rest)


def _write_run(run: Any, file: str) -> None:
    records = importlib.import_module("nmss_lab.records")
    model = run.controller.model
    names = {"y": model.y_names, "u": model.u_names}
    if model.n_v:
        names["v"] = model.v_names
    units = {"time": "s", **model.units}
    v = run.v if model.n_v else run.v[:, :0]
    records.Record(run.t, run.y, run.u, v, run.r, names, units).to_csv(file)


def _serve(arguments: argparse.Namespace) -> None:
    """Serve the pages until interrupted (Ctrl-C) or terminated."""
    # Every script, style sheet and font comes from the installed packages.
    os.environ["BOKEH_RESOURCES"] = "server"
    from panel.io.server import get_server

    pages = _pages()
    try:
        server = get_server(
            pages,
            port=arguments.port,
            address=arguments.address,
            websocket_origin=_origins(arguments.address),
            show=arguments.show,
            title="NMSS Lab",
        )
    except OSError as error:
        where = f"port {arguments.port} of {arguments.address}"
        raise OSError(f"cannot listen on {where}: {error.strerror}") from error
    # get_server has already taken care of Ctrl-C in the same way.
    signal.signal(
        signal.SIGTERM,
        lambda *_: server.io_loop.add_callback_from_signal(server.io_loop.stop),
    )
    server.start()
    address = f"http://{arguments.address}:{server.port}/"
    print(f"NMSS Lab is at {address} (Ctrl-C stops it)", flush=True)
    server.io_loop.start()
    server.stop()
    print("NMSS Lab has stopped", flush=True)


def _origins(address: str) -> str | None:
    """Return the hosts whose pages may connect; None: the address listened on."""
    return "*" if address in {"0.0.0.0", "::", ""} else None


def _pages() -> Mapping[str, Callable[[], Any]]:
    """Return the pages of ``apps.dashboard``: URL path to a builder per session.

    A wheel carries the package ``apps`` in ``nmss_lab/_pages``; in a checkout it
    lies beside ``nmss_lab``.
    """
    here = Path(__file__).resolve().parent
    shipped = here / "_pages"
    sys.path.insert(0, str(shipped if shipped.is_dir() else here.parent))
    pages: Mapping[str, Callable[[], Any]]
    pages = importlib.import_module("apps.dashboard").pages()
    return pages


if __name__ == "__main__":
    sys.exit(main())
