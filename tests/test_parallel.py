"""Tasks here, in processes and on a real cluster: same numbers, nothing lost."""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

import nmss_lab as lab
from nmss_lab import montecarlo
from nmss_lab.parallel import each, executor_for, in_order

MODEL = lab.DifferenceModel([-1.5, 0.56], [0.1, 0.08])
DESIGN = lab.Design(
    "wang_young", MODEL, lab.Horizon(8, 3), 1.0, 0.3, lab.Limits(u=(-1.5, 1.5))
)
SCENARIO = lab.Scenario(np.ones(25))
UNCERTAIN = lab.RelativeRanges(MODEL, {"a": 0.05, "b": 0.2})
REALISATIONS = 520
"""Six parts of a study: enough to go on after one of two workers is gone."""


# --- Tasks, at the top of a module so that other processes find them ---------------


def square(number: int) -> int:
    """Return the square."""
    return number * number


def squared_later(task: tuple[float, int]) -> int:
    """Return the square after some seconds."""
    seconds, number = task
    time.sleep(seconds)
    return square(number)


def angry(number: int) -> int:
    """Refuse one number."""
    if number == 3:
        raise ValueError("three is not for me")
    return number


def where(_: int) -> int:
    """Return the number of the process."""
    return os.getpid()


class DyingOnce:
    """Task that kills its own process, but only the first time it is run."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __call__(self, number: int) -> int:
        """Return the square, unless this is the first call of number 4."""
        if number == 4 and not self.mark.exists():
            self.mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return square(number)


class MeasureThatKills:
    """Measure of a run: its mean input; its first call ends the process it is in."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __call__(self, run: lab.Run) -> float:
        """Return the mean input."""
        if not self.mark.exists():
            self.mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return float(run.u.mean())


# --- Executors ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def pool() -> Iterator[Executor]:
    """Yield two processes."""
    with executor_for(2) as executor:
        yield executor


@pytest.fixture(scope="module")
def cluster() -> Iterator[object]:
    """Yield a real cluster of two worker processes on this machine."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=None,
    ) as running:
        yield running


@pytest.fixture(params=["here", "pool", "cluster"])
def anywhere(request: pytest.FixtureRequest) -> Iterator[Executor | None]:
    """Yield each kind of executor in turn."""
    if request.param == "here":
        yield None
    elif request.param == "pool":
        yield request.getfixturevalue("pool")
    else:
        address = request.getfixturevalue("cluster").scheduler_address
        with executor_for(cluster=address) as executor:
            yield executor


# --- Order, errors, withdrawal -----------------------------------------------------


def test_results_carry_their_numbers(anywhere: Executor | None) -> None:
    """Every task is done once, and comes with its own number."""
    found = list(each(square, range(12), anywhere))
    assert sorted(found) == [(i, i * i) for i in range(12)]


def test_order_is_that_of_the_tasks(anywhere: Executor | None) -> None:
    """Tasks that end in another order are given back in theirs."""
    tasks = [(0.3, 0), (0.0, 1), (0.1, 2), (0.0, 3)]
    assert list(in_order(squared_later, tasks, anywhere)) == [0, 1, 4, 9]
    assert list(in_order(squared_later, tasks, anywhere)) == [0, 1, 4, 9]


def test_no_tasks_no_results(anywhere: Executor | None) -> None:
    """Nothing to do is no error."""
    assert list(in_order(square, [], anywhere)) == []


def test_executors_are_other_processes(pool: Executor, cluster: object) -> None:
    """The comparison below compares something: tasks do not run in this process."""
    assert os.getpid() not in in_order(where, range(4), pool)
    with executor_for(cluster=cluster.scheduler_address) as executor:
        found = set(in_order(where, range(8), executor))
    assert os.getpid() not in found


def test_errors_reach_the_caller(anywhere: Executor | None) -> None:
    """The task's own exception is raised, with its words."""
    with pytest.raises(ValueError, match="three is not for me"):
        list(each(angry, range(6), anywhere))


def test_first_results_come_before_the_last_task() -> None:
    """Results are handed out as they are made, not at the end."""
    go = threading.Event()
    with ThreadPoolExecutor(2) as threads:
        results = each(lambda wait: go.wait(60) if wait else True, [1, 0], threads)
        assert next(results) == (1, True)  # the other task still waits
        go.set()
        assert list(results) == [(0, True)]


@pytest.mark.parametrize("of", [each, in_order])
def test_closing_withdraws_tasks(of: Callable[..., Iterator]) -> None:
    """What has not begun when the results are no longer wanted is never run."""
    begun, hold = [], threading.Event()

    def task(number: int) -> int:
        begun.append(number)
        if number:
            hold.wait(60)
        return number

    with ThreadPoolExecutor(1) as threads:
        results = of(task, range(50), threads)
        next(results)
        results.close()
        hold.set()
    assert len(begun) <= 2  # the one that was asked for and the one then running


def test_an_executor_that_goes_away_is_told() -> None:
    """Whoever waits learns that tasks were withdrawn, and how many."""
    hold = threading.Event()
    with ThreadPoolExecutor(1) as threads:
        results = each(lambda wait: hold.wait(60) if wait else True, [0, 1, 1], threads)
        assert next(results) == (0, True)
        threading.Timer(0.1, hold.set).start()
        threads.shutdown(cancel_futures=True)
        with pytest.raises(ConnectionError, match=r"of 3 tasks were withdrawn"):
            list(results)


def test_closing_a_study_withdraws_its_parts() -> None:
    """The same through the generator of a study."""
    begun = []

    class Counting(ThreadPoolExecutor):
        def submit(self, function, /, *arguments):
            future = super().submit(function, *arguments)
            begun.append(future)
            return future

    with Counting(1) as threads:
        parts = lab.monte_carlo_parts(
            {"one": DESIGN}, UNCERTAIN, SCENARIO, 2000, executor=threads
        )
        assert len(next(parts)) == montecarlo.PART
        parts.close()
    assert len(begun) == 20
    assert sum(future.cancelled() for future in begun) >= 10


# --- The same numbers wherever they are computed -----------------------------------


def study(executor: Executor | None = None, **more) -> lab.MonteCarlo:
    """Return a small study of two designs."""
    designs = {"one": DESIGN, "two": lab.Design("forward_path", MODEL, R=0.1)}
    arguments = {"n": REALISATIONS, "seed": 3, "keep": "signals", **more}
    return lab.monte_carlo(designs, UNCERTAIN, SCENARIO, executor=executor, **arguments)


@pytest.fixture(scope="module")
def undisturbed() -> lab.MonteCarlo:
    """Return the study made in this process."""
    return study()


def assert_same(found: lab.MonteCarlo, wanted: lab.MonteCarlo) -> None:
    """Compare two studies bit by bit."""
    assert found.table.equals(wanted.table)
    assert np.array_equal(found.realisations, wanted.realisations)
    for name, kept in wanted.signals.items():
        assert np.array_equal(found.poles[name], wanted.poles[name], equal_nan=True)
        assert np.array_equal(found.signals[name].y, kept.y)
        assert np.array_equal(found.signals[name].u, kept.u)


def test_studies_agree_bitwise(
    anywhere: Executor | None, undisturbed: lab.MonteCarlo
) -> None:
    """A study does not depend on where it was made."""
    assert_same(study(anywhere), undisturbed)


def tuned(executor: Executor | None = None) -> lab.Tuned:
    """Return a short search."""
    return lab.tune(
        DESIGN,
        [lab.Goal("overshoot", 0.02), lab.Goal("IAE", 2.0)],
        [lab.Trial([MODEL, MODEL.varied(numerator=1.2)], SCENARIO)],
        starts=2,
        seed=5,
        evaluations=60,
        executor=executor,
    )


def test_searches_agree_bitwise(anywhere: Executor | None) -> None:
    """Nor does a search: the same steps, the same weights."""
    found, wanted = tuned(anywhere), tuned()
    assert found.attainment == wanted.attainment
    assert found.evaluations == wanted.evaluations
    assert [s.attainment for s in found.history] == [
        s.attainment for s in wanted.history
    ]
    for name, weight in wanted.weights.items():
        assert np.array_equal(found.weights[name], weight)


# --- Workers that are killed -------------------------------------------------------


def test_a_killed_process_loses_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A pool breaks when one of its processes dies; what it owed is done here."""
    task = DyingOnce(tmp_path / "died")
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        found = list(each(task, range(10), executor))
    assert task.mark.exists()
    assert sorted(found) == [(i, i * i) for i in range(10)]
    assert "going on in one process" in caplog.text


def test_a_study_survives_a_killed_process(
    tmp_path: Path, undisturbed: lab.MonteCarlo
) -> None:
    """The study is the undisturbed one, bit by bit."""
    measure = MeasureThatKills(tmp_path / "died")
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as executor:
        found = study(executor, measures={"mean u": measure})
    assert measure.mark.exists()
    assert found.table.drop(columns="mean u").equals(undisturbed.table)
    assert found.table["mean u"].notna().all()


def test_a_study_survives_a_killed_worker(
    cluster: object, tmp_path: Path, undisturbed: lab.MonteCarlo
) -> None:
    """A worker of the cluster dies in the middle of a part; another takes it over."""
    measure = MeasureThatKills(tmp_path / "died")
    with executor_for(cluster=cluster.scheduler_address) as executor:
        found = study(executor, measures={"mean u": measure})
    assert measure.mark.exists()
    assert found.table.drop(columns="mean u").equals(undisturbed.table)
    assert found.table["mean u"].notna().all()


def test_a_study_survives_a_worker_killed_from_outside(
    cluster: object, undisturbed: lab.MonteCarlo
) -> None:
    """Parts that were done on a dead worker, but not yet fetched, are made again."""
    designs = {"one": DESIGN, "two": lab.Design("forward_path", MODEL, R=0.1)}
    with executor_for(cluster=cluster.scheduler_address) as executor:
        victim = next(in_order(where, [0], executor))
        parts = lab.monte_carlo_parts(
            designs,
            UNCERTAIN,
            SCENARIO,
            REALISATIONS,
            3,
            "signals",
            executor=executor,
        )
        made = [next(parts)]
        os.kill(victim, signal.SIGKILL)
        made += parts
    assert_same(montecarlo.join(made), undisturbed)


# --- Opening executors -------------------------------------------------------------


def test_one_worker_is_this_process() -> None:
    """No executor is opened for one worker."""
    with executor_for(1) as executor:
        assert executor is None


@pytest.mark.parametrize("workers", [0, -2])
def test_workers_must_be_positive(workers: int) -> None:
    """The message names the argument and what is expected."""
    with (
        pytest.raises(ValueError, match=f"workers = {workers}: expected at least 1"),
        executor_for(workers),
    ):
        pass


def test_nobody_answers() -> None:
    """An address without a scheduler is an OSError that names it."""
    address = "tcp://127.0.0.1:1"  # a port that no one listens on without being root
    with (
        pytest.raises(OSError, match=f"no scheduler answers at {address}"),
        executor_for(cluster=address),
    ):
        pass


@pytest.mark.parametrize(
    ("address", "message"), [("nonsense", "port"), ("foo://here:1", "scheme")]
)
def test_addresses_that_cannot_be(address: str, message: str) -> None:
    """What is no address is a ValueError that says what is missing."""
    with pytest.raises(ValueError, match=message), executor_for(cluster=address):
        pass


def test_a_cluster_needs_dask(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without Dask the message says how to get it."""
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(ValueError, match=r"pip install 'nmss-lab\[cluster\]'"),
        executor_for(cluster="tcp://127.0.0.1:1"),
    ):
        pass
