"""The command ``nmss-lab serve``: the live pages, for oneself or for many."""

import argparse
import contextlib
import importlib
import json
import os
import re
import shutil
import signal
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

__all__ = ["add_serve"]

MOST_PROCESSES = 64


def add_serve(commands: Any) -> None:
    """Add the command to those of ``nmss-lab``."""
    serve = commands.add_parser("serve", help="serve the live pages")
    add = serve.add_argument
    add("--port", type=_port, default=5006, help="0 takes any free port")
    add("--address", default="127.0.0.1", help="address to listen on")
    add("--show", action="store_true", help="open the web browser")
    add(
        "--allow-websocket-origin",
        type=_origin,
        action="append",
        metavar="HOST[:PORT]",
        help="name by which browsers reach the pages, as through a proxy; repeatable",
    )
    add("--prefix", type=_prefix, default="", metavar="/PATH", help="serve below it")
    add(
        "--basic-auth",
        metavar="FILE",
        help='ask for a name and a password: a JSON file {"name": "password"}',
    )
    add(
        "--num-procs",
        type=_processes,
        default=1,
        metavar="N",
        help="serve from several processes; not on Windows",
    )
    serve.set_defaults(command=_serve)


def _port(text: str) -> int:
    """Return a port number, or 0 for any that is free."""
    if not text.isdigit() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a port from 0 to 65535")
    return int(text)


def _origin(text: str) -> str:
    """Return a host, with a port where it is not that of the scheme."""
    name, _, port = text.partition(":")
    if not re.fullmatch(r"[\w.-]+", name) or (":" in text and not port.isdigit()):
        raise argparse.ArgumentTypeError(
            f"{text!r}: expected a host, or host:port, without http://"
        )
    return text.lower()


def _prefix(text: str) -> str:
    """Return a path that begins with a slash and does not end with one; or none."""
    path = text.strip("/")
    if path and not re.fullmatch(r"[\w-]+(/[\w-]+)*", path, re.ASCII):
        raise argparse.ArgumentTypeError(
            f"{text!r}: expected a path such as /lab, of letters, digits, - and _"
        )
    return f"/{path}" if path else ""


def _processes(text: str) -> int:
    """Return a number of processes."""
    if not text.isdigit() or not 1 <= int(text) <= MOST_PROCESSES:
        raise argparse.ArgumentTypeError(
            f"{text!r}: expected a number from 1 to {MOST_PROCESSES}"
        )
    if int(text) > 1 and not hasattr(os, "fork"):
        raise argparse.ArgumentTypeError(
            f"{text!r}: this system serves from one process only"
        )
    return int(text)


def _users(file: str) -> dict[str, str]:
    """Read names and passwords."""
    path = Path(file)
    try:
        users = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"--basic-auth {file}: not a JSON file") from error
    if not isinstance(users, dict) or not users:
        raise ValueError(
            f'--basic-auth {file}: expected {{"name": "password", ...}} in the file'
        )
    for name, password in users.items():
        if not (name and isinstance(password, str) and password):
            raise ValueError(
                f"--basic-auth {file}: {name!r} has no password; expected a text"
            )
    if os.name == "posix" and path.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        print(f"nmss-lab: others may read {file}; chmod 600 it", file=sys.stderr)
    return users


def _serve(arguments: argparse.Namespace) -> None:
    """Serve the pages until interrupted (Ctrl-C) or terminated."""
    _from_the_c_library()
    users = _users(arguments.basic_auth) if arguments.basic_auth else None
    # Every script, style sheet and font comes from the installed packages.
    os.environ["BOKEH_RESOURCES"] = "server"
    serving = _serving()
    with _supervised(arguments.num_procs) as shared:
        try:
            server = serving.server(
                port=arguments.port,
                address=arguments.address,
                origins=arguments.allow_websocket_origin,
                prefix=arguments.prefix,
                users=users,
                processes=arguments.num_procs,
                shared=shared,
            )
        except OSError as error:
            where = f"port {arguments.port} of {arguments.address}"
            raise OSError(f"cannot listen on {where}: {error.strerror}") from error
        _run(server, arguments, shared)


def _from_the_c_library() -> None:
    """Start this process anew with memory that can be given back page by page.

    Python's own allocator keeps a megabyte for any small object left in it: after a
    class of a hundred has gone, twice of what was in use before.  The C library's
    costs some 5 % of the speed of an answer.
    """
    is_command = sys.argv[1:2] == ["serve"]  # not called by another program
    if sys.platform == "linux" and is_command and "PYTHONMALLOC" not in os.environ:
        os.environ["PYTHONMALLOC"] = "malloc"
        os.execv(sys.executable, sys.orig_argv)


class _Shared:
    """What the processes of one server have in common.

    ``folder`` is private to them; the end of the pipe ``watch`` is reached when the
    process that watches over the others is no more.
    """

    def __init__(self) -> None:
        self.first = os.getpid()
        self.folder = tempfile.mkdtemp(prefix="nmss-lab-")
        self.watch, self.held = os.pipe()


@contextlib.contextmanager
def _supervised(processes: int) -> Iterator[_Shared | None]:
    """Let what is inside fork; the process that began stays and ends the others.

    Of several processes only the forked ones get past the building of the server.
    The first waits inside it, starts anew whichever is killed, and leaves by the
    exception that Ctrl-C or termination raises there.
    """
    if processes == 1:
        yield None
        return
    shared = _Shared()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield shared
    except (KeyboardInterrupt, SystemExit):
        pass
    finally:
        if os.getpid() == shared.first:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            os.close(shared.held)  # tells the others
            with contextlib.suppress(ChildProcessError):
                while True:
                    os.wait()
            shutil.rmtree(shared.folder, ignore_errors=True)
            print("NMSS Lab has stopped", flush=True)


def _run(server: Any, arguments: argparse.Namespace, shared: _Shared | None) -> None:
    """Serve, in this process, until told to stop."""
    loop = server.io_loop
    # get_server has already taken care of Ctrl-C in the same way.
    signal.signal(signal.SIGTERM, lambda *_: loop.add_callback_from_signal(loop.stop))
    speaks, left = shared is None, []

    def leave(*_: Any) -> None:
        left.append(True)  # the first process ends, or was killed
        loop.stop()

    if shared is not None:
        os.close(shared.held)
        loop.add_handler(shared.watch, leave, loop.READ)
        speaks = importlib.import_module("tornado.process").task_id() == 0
    server.start()
    if speaks:
        address = f"http://{arguments.address}:{server.port}{arguments.prefix}/"
        print(f"NMSS Lab is at {address} (Ctrl-C stops it)", flush=True)
        if arguments.show:
            loop.add_callback(server.show, "/")
    loop.start()
    server.stop()
    if shared is None:
        print("NMSS Lab has stopped", flush=True)
    elif left:
        shutil.rmtree(shared.folder, ignore_errors=True)


def _serving() -> Any:
    """Return the module ``apps.serving``."""
    sys.path.insert(0, str(beside()))
    return importlib.import_module("apps.serving")


def beside() -> Path:
    """Folder of ``apps`` and ``benchmarks``.

    A wheel carries them in ``nmss_lab/_pages``; in a checkout they lie beside
    ``nmss_lab``.
    """
    here = Path(__file__).resolve().parent
    shipped = here / "_pages"
    return shipped if shipped.is_dir() else here.parent
