"""One way to spread independent tasks: here, over processes, or over a cluster.

Whatever takes long takes ``executor``: none (in this process), a
``concurrent.futures.ProcessPoolExecutor``, or a Dask cluster's, such as
``Client("tcp://...").get_executor()``.  A task carries all that it needs, seeds
included, so its numbers do not depend on where it runs.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import queue
import signal
import socket
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
)
from contextlib import closing, contextmanager
from typing import TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

LOG = logging.getLogger(__name__)


def each(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    executor: Executor | None = None,
) -> Generator[tuple[int, Result], None, None]:
    """Apply a function to every task and yield results as they are done.

    A process that is killed loses nothing: a pool that breaks is given up and what it
    still owed is computed here; a cluster hands such tasks to its other workers.
    Closing the generator withdraws the tasks that have not begun.

    Parameters
    ----------
    function : callable
        Of one task; with an executor, function and tasks must be picklable.
    tasks : iterable
    executor : concurrent.futures.Executor, optional

    Yields
    ------
    pair (int, result)
        Number of the task, and what the function returned; in no given order with an
        executor.

    Raises
    ------
    ConnectionError
        If the executor withdraws tasks, such as when its cluster goes away.
    Exception
        Whatever the function raises.
    """
    tasks = list(tasks)
    if executor is None:
        yield from ((i, function(task)) for i, task in enumerate(tasks))
        return
    futures: dict[Future[Result], int] = {}
    done: queue.SimpleQueue[Future[Result]] = queue.SimpleQueue()
    owed = set(range(len(tasks)))
    try:
        for i, task in enumerate(tasks):
            future = executor.submit(function, task)
            futures[future] = i
            future.add_done_callback(done.put)
        while owed:  # ``as_completed`` would wait for a withdrawn task for ever
            future = done.get()
            result = future.result()
            owed.remove(futures[future])
            yield futures[future], result
    except BrokenExecutor as error:
        LOG.warning("The pool of workers broke (%s); going on in one process.", error)
        yield from ((i, function(tasks[i])) for i in sorted(owed))
    except CancelledError as error:
        raise ConnectionError(
            f"{len(owed)} of {len(tasks)} tasks were withdrawn: the executor was shut "
            "down, or its cluster went away"
        ) from error
    finally:
        for future in futures:
            future.cancel()


def in_order(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    executor: Executor | None = None,
) -> Generator[Result, None, None]:
    """Yield results of ``each`` in the order of the tasks, as soon as they can be."""
    waiting: dict[int, Result] = {}
    due = 0
    with closing(each(function, tasks, executor)) as done:
        for i, result in done:
            waiting[i] = result
            while due in waiting:
                yield waiting.pop(due)
                due += 1


@contextmanager
def executor_for(workers: int = 1, cluster: str = "") -> Iterator[Executor | None]:
    """Open an executor for a number of processes or for a Dask cluster.

    Parameters
    ----------
    workers : int
        Processes on this machine; with 1 no executor is opened.
    cluster : str
        Address of a Dask scheduler, such as "tcp://host:8786".

    Raises
    ------
    ValueError
        If ``workers`` is not positive, or Dask is not installed.
    OSError
        If no scheduler answers at that address.
    """
    if workers < 1:
        raise ValueError(f"workers = {workers}: expected at least 1")
    if cluster:
        with _dask_executor(cluster) as executor:
            yield executor
        return
    if workers == 1:
        yield None
        return
    # Processes side by side gain nothing from threads inside BLAS, and new ones,
    # not copies of this one, cannot inherit a lock that one of its threads holds.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    fresh = multiprocessing.get_context("spawn")
    # Ctrl-C in a terminal reaches all processes; this one decides what it means.
    ignore = signal.signal, (signal.SIGINT, signal.SIG_IGN)
    with ProcessPoolExecutor(workers, fresh, *ignore) as pool:
        yield pool


@contextmanager
def _dask_executor(address: str) -> Iterator[Executor]:
    try:
        from distributed import Client
    except ImportError as error:
        raise ValueError(
            "a cluster needs Dask: pip install 'nmss-lab[cluster]'"
        ) from error
    _call(address)
    with Client(address, timeout="10s") as client:  # type: ignore[no-untyped-call]
        yield client.get_executor()


def _call(address: str) -> None:
    """See whether anybody answers at all: Dask would try for ten seconds.

    A client of Dask that has not found its scheduler also holds up the end of the
    process, and complains.
    """
    from distributed.comm.addressing import get_address_host_port

    place = get_address_host_port(address)
    try:
        socket.create_connection(place, timeout=10.0).close()
    except OSError as error:
        raise OSError(
            f"no scheduler answers at {address}: {error.strerror or error}"
        ) from error
