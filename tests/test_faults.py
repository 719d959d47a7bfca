"""What goes wrong while pages are served: each fault stays where it happened."""

from __future__ import annotations

import asyncio
import os
import signal
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest
from conftest import Server
from test_serving import LINUX, children, health, serving, until, wait_for_none
from visitors import Visitor, run

import apps.work
from apps.pages.live import FAULT, KEPT
from apps.serving import SORRY
from apps.work import ENDED, Lent
from nmss_lab.cases import case
from nmss_lab.cli import main
from nmss_lab.files import load, save

FAULTY = """
import sys
import apps.session
import nmss_lab.laws
import nmss_lab.qp
from apps.pages import governor
from nmss_lab.cli import main

def solver(problem):
    if len(problem.H) == 7:
        raise RuntimeError("the solver is poorly")
    return healthy(problem)

def held(self, theta):
    if len(self.program.H) == 7:
        raise RuntimeError("the solver is poorly")
    return asked(self, theta)

def loop(plant, controller, scenario):
    if getattr(controller, "horizon", None) and controller.horizon.Np == 13:
        raise RuntimeError("the loop is poorly")
    return sound(plant, controller, scenario)

def page():
    if b"9" in governor.pn.state.session_args.get("Np", []):
        raise RuntimeError("the page is poorly")
    return whole()

healthy, sound, whole = nmss_lab.qp._daqp, apps.session.closed_loop, governor.page
asked = nmss_lab.laws.Solver.held
nmss_lab.qp.BACKENDS["active_set"] = solver
nmss_lab.laws.Solver.held = held
apps.session.closed_loop = loop
governor.page = page
sys.exit(main(sys.argv[1:]))
"""
"""Serves pages some of whose choices meet a fault in the program."""


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Yield a server of pages with faults."""
    folder = tmp_path_factory.mktemp("faulty")
    running = Server(folder / "stderr.log", command=(sys.executable, "-c", FAULTY))
    yield running
    assert running.stop()[0] == 0


# --- A fault in the program ----------------------------------------------------------


def test_a_faulty_loop_is_told_and_the_picture_stays(faulty: Server) -> None:
    """The page says what happened, shows what it showed, and goes on; so do others."""

    async def visit() -> None:
        one = await Visitor.open(faulty.url, "receding_horizon")
        other = await Visitor.open(faulty.url, "receding_horizon")
        await one.choose(Np=20)
        before = one.value("Player", "run"), one.value("text-measures", "text")
        await one.choose(Np=13)
        said = one.value("text-alert", "text")
        assert FAULT in said
        assert KEPT in said
        assert "poorly" not in said
        now = one.value("Player", "run"), one.value("text-measures", "text")
        assert now == before
        await other.choose(Np=14)
        assert not other.value("text-alert", "text")
        await one.choose(Np=15)
        assert not one.value("text-alert", "text")
        assert one.value("Player", "run") != before[0]
        await one.close()
        await other.close()

    run(visit())
    log = faulty.log.read_text()
    assert "the loop is poorly" in log
    assert "'Np': 13" in log


def test_a_solver_that_raises_is_told_sample_by_sample(faulty: Server) -> None:
    """The loop goes on without the solver, and the page says at which samples."""

    async def visit() -> None:
        visitor = await Visitor.open(faulty.url, "receding_horizon")
        await visitor.choose(Nc=7)
        words = str(visitor.value("Player", "run")["words"])
        assert "The solver failed" in words
        await visitor.choose(Nc=6)
        assert "solver failed" not in str(visitor.value("Player", "run")["words"])
        await visitor.close()

    run(visit())


def test_a_page_that_cannot_be_built_says_so(faulty: Server) -> None:
    """No traceback reaches the browser; the log has it."""

    async def visit() -> str:
        visitor = await Visitor.open(faulty.url, "governor?Np=9")
        text = str(visitor.document)
        await visitor.close()
        return text

    text = run(visit())
    assert SORRY.split("\n")[1].removeprefix("<h1>").removesuffix("</h1>") in text
    assert "poorly" not in text
    assert "Traceback" not in text
    assert "the page is poorly" in faulty.log.read_text()


# --- A worker that is killed ---------------------------------------------------------


class Dying:
    """A pool that breaks at each task."""

    def submit(self, task: Callable[[], Any]) -> Future[Any]:
        """Break."""
        raise BrokenProcessPool("killed")


class Living:
    """A pool that works."""

    def submit(self, task: Callable[[], Any]) -> Future[Any]:
        """Do it at once."""
        done: Future[Any] = Future()
        done.set_result(task())
        return done


def test_what_a_killed_process_owed_is_done_by_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A task is given to new processes once; then whoever waits is told why."""
    monkeypatch.setattr(apps.work, "processes", Living)
    assert Lent(Dying()).submit(lambda: 7).result(timeout=10) == 7  # type: ignore[arg-type]
    monkeypatch.setattr(apps.work, "processes", Dying)
    with pytest.raises(ValueError, match=ENDED):
        Lent(Dying()).submit(lambda: 7).result(timeout=10)  # type: ignore[arg-type]


def workers(server: Server) -> list[int]:
    """Return the processes that compute for a server."""
    found = []
    for pid in children(server.process.pid):
        words = Path(f"/proc/{pid}/cmdline").read_text()
        if "spawn_main" in words and "resource_tracker" not in words:
            found.append(pid)
    return found


def spent(server: Server) -> float:
    """Return the seconds that the processes of a server have computed."""
    ticks = 0
    for pid in workers(server):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


async def busy(server: Server, at_least: float = 0.5) -> None:
    """Wait until the processes compute."""
    before = spent(server)
    for _ in range(600):
        if spent(server) > before + at_least:
            return
        await asyncio.sleep(0.1)
    raise AssertionError("nothing is computed")


def resting(server: Server) -> bool:
    """Whether nothing is computed for two seconds."""
    before = spent(server)
    time.sleep(2.0)
    return spent(server) < before + 0.1


LONG_STUDY = "robustness?case=ifac93_6_3_3&uncertainty=gains&n=10000"
LONG_SEARCH = "tune?most=6000&starts=10"


@LINUX
def test_a_study_outlives_a_killed_worker(server: Server) -> None:
    """A process is killed while a study runs: the study is finished all the same."""

    async def visit() -> None:
        visitor = await Visitor.open(
            server.url, "robustness?case=ifac93_6_3_3&uncertainty=gains&n=1500"
        )
        await visitor.put("StudyPanel", "sent", {"act": "run", "message": 1})
        await visitor.until(lambda: visitor.value("StudyPanel", "progress")["running"])
        await busy(server)
        os.kill(workers(server)[0], signal.SIGKILL)
        await visitor.until(
            lambda: not visitor.value("StudyPanel", "progress")["running"]
        )
        assert visitor.value("StudyPanel", "progress")["done"] == 1500
        assert not visitor.value("text-alert", "text")
        await visitor.close()

    run(visit())
    assert health(server)["status"] == "ok"


@LINUX
def test_a_search_outlives_a_killed_worker(server: Server) -> None:
    """A process is killed while the page tunes: the search goes on."""

    async def visit() -> None:
        visitor = await Visitor.open(server.url, LONG_SEARCH)
        await visitor.put("Goals", "sent", {"act": "tune", "number": 1})
        await visitor.until(lambda: visitor.value("Goals", "progress")["running"])
        await busy(server)
        os.kill(workers(server)[0], signal.SIGKILL)
        tried = visitor.value("Goals", "progress")["tried"]
        await visitor.until(
            lambda: visitor.value("Goals", "progress")["tried"] > tried + 20
        )
        await visitor.put("Goals", "stop", 1)
        await visitor.until(lambda: not visitor.value("Goals", "progress")["running"])
        assert not visitor.value("text-alert", "text")
        await visitor.close()

    run(visit())


# --- A browser that is closed --------------------------------------------------------


@LINUX
@pytest.mark.parametrize(
    ("path", "component", "sent"),
    [
        (LONG_STUDY, "StudyPanel", {"act": "run", "message": 1}),
        (LONG_SEARCH, "Goals", {"act": "tune", "number": 1}),
    ],
)
def test_work_ends_with_its_page(
    tmp_path: Path, path: str, component: str, sent: dict[str, Any]
) -> None:
    """A page is closed in the middle: its work is withdrawn, the next has the pool."""

    async def leave(server: Server) -> None:
        visitor = await Visitor.open(server.url, path)
        await visitor.put(component, "sent", sent)
        await busy(server)
        await visitor.close()

    async def come(server: Server) -> None:
        visitor = await Visitor.open(server.url, "robustness?uncertainty=ranges&n=40")
        progress = "StudyPanel", "progress"
        await visitor.until(lambda: visitor.value(*progress)["done"] == 40)
        await visitor.close()

    with serving(tmp_path) as server:
        run(leave(server))
        wait_for_none(server)
        until(lambda: resting(server))  # tasks that have begun go on to their end
        run(come(server))
        assert "ERROR" not in server.log.read_text()


# --- One that never ends, and its neighbours -----------------------------------------


@LINUX
def test_a_search_leaves_others_their_pace(server: Server) -> None:
    """While one page tunes, the slider of another answers within twice its time."""

    async def pace(visitor: Visitor) -> float:
        return statistics.median(
            [await visitor.choose(Np=10 + number % 7) for number in range(15)]
        )

    async def visit() -> float:
        one = await Visitor.open(server.url, "receding_horizon")
        other = await Visitor.open(server.url, LONG_SEARCH)
        await pace(one)
        alone = await pace(one)
        await other.put("Goals", "sent", {"act": "tune", "number": 1})
        await busy(server)
        beside = await pace(one)
        assert other.value("Goals", "progress")["running"]
        await other.put("Goals", "stop", 1)
        await other.until(lambda: not other.value("Goals", "progress")["running"])
        again = await pace(one)
        await one.close()
        await other.close()
        return beside / max(alone, again)

    # whatever else this machine does may fall into one of two times, not into both
    assert min(run(visit()) for _ in range(2)) < 2.0


# --- A full disk ---------------------------------------------------------------------


@LINUX
def test_a_full_disk_leaves_the_old_file(tmp_path: Path) -> None:
    """What cannot be written whole is not written; the error names the file."""
    designs = list(case("ifac93_6_3_3").designs.values())
    file = tmp_path / "design.json"
    save(file, designs[0])
    before = file.read_bytes()
    (tmp_path / "design.json.part").symlink_to("/dev/full")
    with pytest.raises(OSError, match=r"No space left on device: .*design\.json"):
        save(file, designs[1])
    assert file.read_bytes() == before
    assert load(file).structure == designs[0].structure
    assert [path.name for path in tmp_path.iterdir()] == ["design.json"]


@LINUX
def test_a_full_disk_is_told_by_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A search whose design cannot be written ends with code 1 and says why."""
    file = tmp_path / "design.json"
    (tmp_path / "design.json.part").symlink_to("/dev/full")
    arguments = ["--structure", "wang_young", "--goal", "IAE<=25"]
    arguments += ["--evaluations", "20", "--design", str(file)]
    assert main(["tune", "ifac93_6_3_3", *arguments]) == 1
    assert f"No space left on device: '{file}'" in capsys.readouterr().err
    assert not file.exists()
