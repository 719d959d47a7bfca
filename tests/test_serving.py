"""``nmss-lab serve`` for many: options, sign-in, prefix, processes, load, its stop."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import logging
import os
import re
import signal
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import param
import pytest
from conftest import Server, watched
from playwright.sync_api import Browser, expect
from tornado.httpclient import HTTPClientError
from tornado.websocket import WebSocketClosedError
from visitors import Visitor, run

from apps.disturbances import DisturbanceChoices
from apps.identification import IdentifyChoices
from apps.kept import Kept, Origin
from apps.pages.live import KEPT, PAGES
from apps.robustness import RobustnessChoices
from apps.serving import LARGEST_MESSAGE, _without_data
from apps.session import Choices, Form, GovernorChoices, LoopChoices, afford
from apps.structures import StructuresChoices
from apps.tuning import TuneChoices
from apps.varying import VaryingChoices
from apps.work import Withdrawn
from apps.workbench import WorkbenchChoices
from nmss_lab import __version__
from nmss_lab.cases import CASES, case
from nmss_lab.cli import main
from nmss_lab.cli_serve import _origin, _prefix, _processes
from nmss_lab.files import dumps

PATHS = ["", *(path for path, _ in PAGES)]
IDLE = "window.Bokeh && Bokeh.documents.length && Bokeh.documents[0].is_idle"
FORKS = pytest.mark.skipif(not hasattr(os, "fork"), reason="one process only here")
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


@contextlib.contextmanager
def serving(folder: Path, *options: str, **more: Any) -> Iterator[Server]:
    """Serve with options; at the end the server stops and has logged no fault."""
    running = Server(folder / "stderr.log", *options, **more)
    try:
        yield running
    finally:
        code, said = running.stop()
    assert code == 0
    assert "stopped" in said
    assert running.faults() == []


def ask(url: str, method: str = "GET") -> tuple[int, dict[str, str], bytes]:
    """Return status, headers and body of an answer."""
    request = urllib.request.Request(url, method=method)
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, dict(answer.headers), answer.read()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, dict(error.headers), error.read()


def health(server: Server) -> dict[str, Any]:
    """Return what the server says of itself."""
    status, _, text = ask(server.url + "health")
    assert status == 200
    told: dict[str, Any] = json.loads(text)
    return told


# --- Options -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("read", "text"),
    [
        *((_origin, text) for text in ("http://a.org", "a.org:x", "", "a b", ":80")),
        *((_prefix, text) for text in ("/a b", "/a//b", "/../etc", "/(.*)", "/ü")),
        *((_processes, text) for text in ("0", "-1", "two", "65", "1.5")),
    ],
)
def test_wrong_options_are_refused(read: Any, text: str) -> None:
    """What an option cannot be is named, and what was expected."""
    with pytest.raises(argparse.ArgumentTypeError, match="expected"):
        read(text)


def test_right_options_are_read() -> None:
    """A prefix may come with slashes or without, a host with a port or without."""
    assert [_prefix(text) for text in ("", "/", "lab", "/lab/mpc/")] == [
        *("", "", "/lab", "/lab/mpc"),
    ]
    assert _origin("Lab.Example.org:8443") == "lab.example.org:8443"
    assert _processes("4") == 4 or not hasattr(os, "fork")


def test_wrong_options_end_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    """Arguments that cannot be read leave with code 2."""
    with pytest.raises(SystemExit) as left:
        main(["serve", "--allow-websocket-origin", "https://lab.example.org"])
    assert left.value.code == 2
    assert "without http://" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ann: secret", "not a JSON file"),
        ("[1]", "expected"),
        ("{}", "expected"),
        ('{"ann": ""}', "'ann' has no password"),
        ('{"ann": 7}', "'ann' has no password"),
        (None, "No such file"),
    ],
)
def test_wrong_password_files_are_explained(
    text: str | None, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file of names and passwords that is none ends the command with code 1."""
    file = tmp_path / "users.json"
    if text is not None:
        file.write_text(text)
    assert main(["serve", "--basic-auth", str(file)]) == 1
    assert message in capsys.readouterr().err


# --- Health --------------------------------------------------------------------------


def test_health_needs_no_session(server: Server) -> None:
    """The endpoint answers GET and HEAD with the version, and opens no page."""
    before = health(server)["sessions"]
    for method in ("GET", "HEAD"):
        status, headers, body = ask(server.url + "health", method)
        assert status == 200
        assert headers["Content-Type"].startswith("application/json")
        assert headers["Cache-Control"] == "no-store"
        assert bool(body) == (method == "GET")
    told = health(server)
    assert (told["status"], told["version"]) == ("ok", __version__)
    assert told["sessions"] <= before


def test_a_closed_page_is_soon_forgotten(server: Server) -> None:
    """A page counts while it is open, and is given up within some 20 s."""

    async def visit() -> None:
        visitor = await Visitor.open(server.url, "governor")
        assert health(server)["sessions"] >= 1
        await visitor.close()

    run(visit())
    wait_for_none(server)


def wait_for_none(server: Server, seconds: float = 45.0) -> None:
    """Wait until the server keeps no page any more."""
    end = time.monotonic() + seconds
    while health(server)["sessions"]:
        assert time.monotonic() < end, "pages are kept"
        time.sleep(0.5)


# --- Who may come in -----------------------------------------------------------------


def token_of(url: str, path: str, cookie: str = "") -> str:
    """Return the token of a new session."""
    request = urllib.request.Request(url + path, headers={"Cookie": cookie})
    with urllib.request.urlopen(request, timeout=60) as answer:
        found = re.search(r'"token":"([^"]+)"', answer.read().decode())
    assert found
    return found[1]


def connect(server: Server, path: str, token: str, **headers: str) -> None:
    """Connect to a page's session and leave it; raise HTTPClientError if refused."""

    async def visit() -> None:
        visitor = await Visitor.connect(server.url, path, token, headers)
        await visitor.close()

    run(visit())


def test_pages_of_others_may_not_connect(server: Server) -> None:
    """A websocket opened by a page of another host is refused."""
    token = token_of(server.url, "governor")
    with pytest.raises(HTTPClientError, match="403"):
        connect(server, "governor", token, Origin="http://elsewhere.example.org")
    connect(server, "governor", token, Origin=server.url.rstrip("/"))


def test_named_hosts_may_connect(tmp_path: Path) -> None:
    """Hosts that were named may connect, also by a scheme's own port; others not."""
    named = ("--allow-websocket-origin", "lab.example.org")
    also = ("--allow-websocket-origin", "lab.example.org:8443")
    with serving(tmp_path, *named, *also) as server:
        token = token_of(server.url, "governor")
        connect(server, "governor", token, Origin="https://lab.example.org")
        connect(server, "governor", token, Origin="https://lab.example.org:8443")
        with pytest.raises(HTTPClientError, match="403"):
            connect(server, "governor", token, Origin="https://lab.example.org:9")


def test_on_all_addresses_own_pages_connect(tmp_path: Path) -> None:
    """Listening on all addresses, the host that was asked for the page is the one."""
    command = (sys.executable, "-c", LISTENING.format(address="0.0.0.0"))
    with serving(tmp_path, command=command) as server:
        token = token_of(server.url, "governor")
        port = server.url.rstrip("/").rpartition(":")[2]
        name = f"bench.local:{port}"
        connect(server, "governor", token, Origin=f"http://{name}", Host=name)
        with pytest.raises(HTTPClientError, match="403"):
            connect(server, "governor", token, Origin="http://elsewhere", Host=name)


LISTENING = """
import sys
from nmss_lab import cli
said = print
def told(*words, **more):
    said(*(str(word).replace("{address}", "127.0.0.1") for word in words), **more)
import builtins
builtins.print = told
sys.exit(cli.main([*sys.argv[1:], "--address", "{address}"]))
"""
"""Starts a server that the tests look for at 127.0.0.1."""


def test_nobody_makes_up_a_session(server: Server) -> None:
    """A session that the server did not begin is refused: none can be foisted."""
    status, _, _ = ask(server.url + "governor?bokeh-session-id=mine")
    assert status == 403
    token = token_of(server.url, "governor")
    body, _, signature = token.rpartition(".")
    forged = f"{body}.{signature[::-1]}"
    with pytest.raises((AssertionError, HTTPClientError)):
        connect(server, "governor", forged)


def test_sign_in(tmp_path: Path, browser: Browser) -> None:
    """Without name and password no page, no socket; with them the page asked for."""
    users = tmp_path / "users.json"
    users.write_text('{"ann": "grey heron"}')
    users.chmod(0o600)
    options = ("--basic-auth", str(users), "--prefix", "/lab")
    with (
        serving(tmp_path, *options) as server,
        watched(server, browser, "document.forms.length") as open_page,
    ):
        assert "read" not in server.log.read_text()
        assert health(server)["sessions"] == 0
        for path in PATHS:
            assert b"<form" in ask(server.url + path)[2]
        assert health(server)["sessions"] == 0
        with pytest.raises(HTTPClientError, match="403"):
            connect(server, "governor", "made.up")
        page = open_page("governor?Np=7")
        page.get_by_label("Name").fill("ann")
        page.get_by_label("Password").fill("grey hero")
        page.get_by_role("button", name="Sign in").click()
        expect(page.get_by_role("alert")).to_contain_text("wrong")
        page.get_by_label("Name").fill("ann")
        page.get_by_label("Password").fill("grey heron")
        page.get_by_role("button", name="Sign in").click()
        page.wait_for_function("window.nmssPlayer?.frames > 0", timeout=60_000)
        assert page.url == f"{server.url}governor?Np=7"
        page.get_by_role("link", name="Sign out").click()
        expect(page.get_by_text("You are signed out.")).to_be_visible()
        page.get_by_role("button", name="Sign in again").click()
        page.get_by_label("Name").fill("ann")
        page.get_by_label("Password").fill("grey heron")
        page.get_by_role("button", name="Sign in").click()
        page.wait_for_function(IDLE, timeout=60_000)
        assert page.url == server.url


def test_others_may_not_read_the_passwords(tmp_path: Path) -> None:
    """Where others may read the file of passwords, the server says so."""
    users = tmp_path / "users.json"
    users.write_text('{"ann": "grey heron"}')
    users.chmod(0o644)
    with serving(tmp_path, "--basic-auth", str(users)) as server:
        assert f"others may read {users}" in server.log.read_text()


# --- Prefix --------------------------------------------------------------------------


def test_every_page_below_a_prefix(tmp_path: Path, browser: Browser) -> None:
    """Below a prefix each page opens, its links lead on, and nothing is missing."""
    with (
        serving(tmp_path, "--prefix", "/lab/mpc") as server,
        watched(server, browser, IDLE) as open_page,
    ):
        assert server.url.endswith("/lab/mpc/")
        assert health(server)["status"] == "ok"
        missing: list[str] = []
        for path in PATHS:
            page = open_page(path)
            page.on(
                "response",
                lambda a: missing.append(a.url) if a.status >= 400 else None,
            )
            links = page.locator("a[href]").evaluate_all("all => all.map(a => a.href)")
            assert all(link.startswith(server.url) for link in links)
            page.context.close()
        page = open_page("")
        page.get_by_role("navigation").get_by_role("link").nth(1).click()
        page.wait_for_url(f"{server.url}*")
        page.wait_for_function(IDLE, timeout=60_000)
        page.get_by_role("link", name="NMSS Lab").click()
        page.wait_for_url(server.url)
        assert missing == []
        assert ask(server.url.rstrip("/"))[0] == 200
        assert ask(server.url.replace("/lab/mpc/", "/"))[0] == 404
        assert ask(server.url.replace("/lab/mpc/", "/health"))[0] == 200


# --- Several processes ---------------------------------------------------------------


@FORKS
@LINUX
def test_several_processes(tmp_path: Path) -> None:
    """Pages work whichever process answers, one that is killed comes again, all end."""
    with serving(tmp_path, "--num-procs", "2", **private(tmp_path)) as server:
        first = children(server.process.pid)
        assert len(first) == 2

        async def visit() -> None:
            for path in ("receding_horizon", "governor", "receding_horizon"):
                visitor = await Visitor.open(server.url, path)
                await visitor.choose(Np=12)
                assert visitor.value("Controls", "state")["values"]["Np"] == 12
                await visitor.close()

        run(visit())
        os.kill(first[0], signal.SIGKILL)
        until(lambda: len(set(children(server.process.pid)) - {first[0]}) == 2)
        run(visit())
        every = children(server.process.pid)
        assert list(tmp_path.glob("nmss-lab-*"))
    assert len(every) == 2
    until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in every))
    assert not list(tmp_path.glob("nmss-lab-*"))


@FORKS
@LINUX
def test_processes_end_when_the_first_is_killed(tmp_path: Path) -> None:
    """No process is left behind by a server that was killed the hard way."""
    options = ("--num-procs", "2")
    running = Server(tmp_path / "stderr.log", *options, **private(tmp_path))
    every = children(running.process.pid)
    running.process.kill()
    running.process.communicate(timeout=20)
    until(lambda: not any(map(lives, every)))
    until(lambda: not list(tmp_path.glob("nmss-lab-*")))


def lives(pid: int) -> bool:
    """Whether a process is there and not merely waiting to be buried."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"


def private(folder: Path) -> dict[str, Any]:
    """Have a server put its temporary files into a folder."""
    return {"env": {**os.environ, "TMPDIR": str(folder)}}


def children(pid: int) -> list[int]:
    """Return the processes that a process has started."""
    tasks = Path(f"/proc/{pid}/task").glob("*/children")  # each thread has its own
    return [int(word) for task in tasks for word in task.read_text().split()]


def until(true: Any, seconds: float = 30.0) -> None:
    """Wait for something that takes a moment."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end
        time.sleep(0.1)


@pytest.mark.parametrize("name", CASES)
def test_what_one_process_keeps_another_has(name: str, tmp_path: Path) -> None:
    """A kept case comes to the other process with all that is in it, and its Python."""
    one, other = Kept(), Kept()
    one.share(tmp_path)
    other.share(tmp_path)
    key, origin = "model-0123456789ab", Origin(("import a",), ("b = 1", "c = 2"))
    assert key not in other
    one.keep(key, case(name), origin)
    assert key in other
    assert other.origins[key] == origin
    assert other[key].title == one[key].title
    assert dumps(other[key]) == dumps(one[key])


@pytest.mark.parametrize("name", ["../secret", "model-../../secret", "model-ABC", ""])
def test_no_path_comes_from_an_address(name: str, tmp_path: Path) -> None:
    """A name that is not that of a kept case is not looked for among files."""
    (tmp_path / "secret.json").write_text("{}")
    inside = tmp_path / "inside"
    inside.mkdir()
    kept = Kept()
    kept.share(inside)
    assert name not in kept
    with pytest.raises(KeyError):
        kept[name]


def test_kept_cases_are_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The oldest goes, in memory and in the folder."""
    monkeypatch.setattr("apps.kept.MOST_KEPT", 3)
    kept, example = Kept(), case("governor_3_4")
    kept.share(tmp_path)
    names = [f"drawn-{number:012x}" for number in range(5)]
    for name in names:
        kept.keep(name, example, Origin((), ()))
    assert [name for name in names if name in kept] == names[2:]
    assert len(list(tmp_path.iterdir())) == 3


# --- Logs ----------------------------------------------------------------------------


def test_logs_hold_no_data() -> None:
    """Messages of a browser, a file among them, are told of by their length."""
    record = logging.LogRecord(
        "bokeh.server.views.ws",
        *(logging.ERROR, "", 0, "fault %r: %r", (KeyError("a"), "17.25," * 1000), None),
    )
    assert _without_data(record)
    assert "17.25" not in record.getMessage()
    assert "str of 6000 characters" in record.getMessage()
    assert "KeyError('a')" in record.getMessage()


# --- Uploads -------------------------------------------------------------------------


def test_a_message_beyond_the_limit_ends_its_page_only(server: Server) -> None:
    """Whoever gets round the page's own limit loses the connection, nobody else."""

    async def visit() -> None:
        other = await Visitor.open(server.url, "governor")
        visitor = await Visitor.open(server.url, "identify")
        sent = {"name": "a.csv", "size": 9, "data": "A" * LARGEST_MESSAGE, "number": 1}
        with contextlib.suppress(WebSocketClosedError):
            await visitor.put("Upload", "sent", sent)
        with pytest.raises(AssertionError, match="closed"):
            await visitor.until(lambda: False)
        await visitor.close()
        await other.choose(Np=11)
        await other.close()

    run(visit())


# --- Bounds --------------------------------------------------------------------------

RUN = LoopChoices, GovernorChoices, DisturbanceChoices, VaryingChoices
"""Choices of pages that run loops while somebody waits."""

OTHERS: dict[type[Form], Any] = {
    StructuresChoices: StructuresChoices.sheet,
    TuneChoices: TuneChoices.bench,
    RobustnessChoices: RobustnessChoices.study,
}
"""Choices of other pages with cases, and what those begin with."""


@pytest.mark.parametrize("form", [*RUN, *OTHERS, IdentifyChoices, WorkbenchChoices])
def test_every_number_is_bounded(form: type[Form]) -> None:
    """Each number of each form has a lowest and a highest value, and keeps to them."""
    choices = form()
    for key in choices.names():
        parameter = choices.param[key]
        if not isinstance(parameter, param.Number):
            continue
        low, high = parameter.bounds
        assert np.isfinite([low, high]).all(), key
        before = getattr(choices, key)
        for value in (low - 1, high + 1, "nan", "inf", -np.inf, "1e999", "9" * 9999):
            with pytest.raises(ValueError, match=f"^{key} = ") as refused:
                choices.put({key: value})
            assert len(str(refused.value)) < 600
        assert getattr(choices, key) == before


@pytest.mark.slow
@pytest.mark.parametrize("form", [*RUN, *OTHERS])
def test_every_case_opens(form: Any) -> None:
    """What a page opens with is never too much, whichever case."""
    begin = OTHERS.get(form, form.runs)
    for name in form.cases():
        assert begin(form(case=name))


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("temperature_7_4_2", {"Np": 80, "limit_y": "own"}, r"take 7\.9 times"),
        ("gasifier_6_3_4", {"Np": 80, "limit_y": "own"}, "switch off the limits on y"),
        ("gasifier_6_3_4", {"Np": 80}, "lower Np to"),
    ],
)
def test_what_takes_too_long_is_refused(
    name: str, given: dict[str, Any], message: str
) -> None:
    """Horizons and samples have a budget; what is said to fit it does, just."""
    choices = GovernorChoices(case=name)
    choices.put(given)
    with pytest.raises(ValueError, match=message) as refused:
        choices.runs()
    fits = int(re.search(r"lower Np to (\d+)", str(refused.value))[1])  # type: ignore[index]
    choices.put({"Np": fits})
    afford(choices.designs(), len(choices.scenario()))
    choices.put({"Np": fits + 1})
    with pytest.raises(ValueError, match=f"lower Np to {fits}"):
        choices.runs()


@pytest.mark.parametrize("form", RUN)
def test_runs_tell_how_far_they_are_and_can_be_ended(form: type[Choices]) -> None:
    """The share that is done grows up to all of it, and whoever hears may end it."""
    choices, shares = form(), list[float]()
    choices.hears = shares.append
    choices.runs()
    assert shares == sorted(shares)
    assert shares[-1] == 1.0

    def end(share: float) -> None:
        if share > 0.5:
            raise Withdrawn

    choices.put({"Np": choices.Np + 1})
    choices.hears = end
    with pytest.raises(Withdrawn):
        choices.runs()


def test_a_long_answer_gives_way(server: Server) -> None:
    """It tells how far it is; the next choice, or a cancel, is answered instead."""

    async def visit() -> None:
        visitor = await Visitor.open(server.url, "governor?case=temperature_7_4_2")
        values = visitor.value("Controls", "state")["values"]

        async def ask_much(message: int) -> None:
            sent = {**values, "Np": 40, "limit_y": "own", "message": message}
            await visitor.put("Controls", "sent", sent)
            await visitor.until(lambda: told()["message"] == message)
            assert 0.0 < told()["share"] < 1.0

        def told() -> dict[str, Any]:
            return visitor.value("Controls", "busy") or {"message": 0}

        async def answer(message: int) -> dict[str, Any]:
            def state() -> dict[str, Any]:
                found: dict[str, Any] = visitor.value("Controls", "state")
                return found

            await visitor.until(lambda: state()["message"] >= message)
            assert state()["message"] == message
            return state()["values"] | {"said": visitor.value("text-alert", "text")}

        before = visitor.value("Player", "run")
        await ask_much(1)
        await visitor.put("Controls", "sent", {**values, "Np": 12, "message": 2})
        given = await answer(2)
        assert given["Np"] == 12
        assert not given["said"]
        shown = visitor.value("Player", "run")
        assert shown != before
        await ask_much(3)
        await visitor.put("Controls", "sent", {"cancel": True, "message": 4})
        given = await answer(4)
        assert given["Np"] == 40
        assert "Cancelled." in given["said"]
        assert KEPT in given["said"]
        assert visitor.value("Player", "run") == shown
        await visitor.close()

    run(visit())


def test_an_address_of_any_bytes_opens(server: Server) -> None:
    """Bytes that are no text are named like any wrong choice."""

    async def visit() -> None:
        visitor = await Visitor.open(server.url, "governor?case=%ff%00%3Cb%3E")
        assert "there is no such case" in visitor.value("text-alert", "text")
        await visitor.close()

    run(visit())


# --- Many ----------------------------------------------------------------------------


SOON = """
import sys
import apps.serving
from nmss_lab.cli import main
apps.serving.KEPT_FOR, apps.serving.LOOKED_AFTER = 8, 1
sys.exit(main(sys.argv[1:]))
"""
"""Serves as ever, but forgets pages that were closed in half of the time."""


async def crowd(server: Server, count: int, seconds: float) -> None:
    """Open pages, change a slider of each every second, and close them."""
    gate = asyncio.Semaphore(4)

    async def opened() -> Visitor:
        async with gate:
            return await Visitor.open(server.url, "governor")

    visitors = await asyncio.gather(*(opened() for _ in range(count)))
    end = time.monotonic() + seconds

    async def used(visitor: Visitor, number: int) -> None:
        await asyncio.sleep(number / count)
        while time.monotonic() < end:
            Np = 10 + (int(time.monotonic()) + number) % 20
            await asyncio.gather(visitor.choose(Np=Np), asyncio.sleep(1.0))
            assert visitor.value("Controls", "state")["values"]["Np"] == Np
            assert not visitor.value("text-alert", "text")

    await asyncio.gather(*(used(visitor, i) for i, visitor in enumerate(visitors)))
    await asyncio.gather(*(visitor.close() for visitor in visitors))


def memory(server: Server) -> float:
    """Return the megabytes that a server holds."""
    status = Path(f"/proc/{server.process.pid}/status").read_text()
    found = re.search(r"VmRSS:\s+(\d+) kB", status)
    assert found
    return int(found[1]) / 1000.0


@pytest.mark.slow
@LINUX
def test_a_hundred_are_served_and_forgotten(tmp_path: Path) -> None:
    """A hundred pages are open and used at once, each answered; then none is left.

    Their memory is given back: within 10 % of what a few pages had left behind.
    """
    with serving(tmp_path, command=(sys.executable, "-c", SOON)) as server:
        run(crowd(server, 8, 2.0))
        wait_for_none(server)
        time.sleep(3.0)  # until it has been tidied up
        before = memory(server)
        run(crowd(server, 100, 8.0))
        wait_for_none(server)
        until(lambda: memory(server) < 1.1 * before)
        assert "ERROR" not in server.log.read_text()
