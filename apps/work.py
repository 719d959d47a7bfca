"""Long work away from the event loop: threads that wait, processes that compute."""

from __future__ import annotations

import importlib
import logging
import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    InvalidStateError,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from contextlib import suppress
from functools import partial
from typing import Any, Protocol
from weakref import WeakSet

from bokeh.application.handlers import Handler
from bokeh.document import Document

WAITING = ThreadPoolExecutor(max_workers=8, thread_name_prefix="waiting")
"""One thread for each study or search of all sessions; more of them wait."""

MOST = min(os.cpu_count() or 1, 4)

_LOCK = threading.Lock()
_POOLS: list[ProcessPoolExecutor] = []


def share(servers: int) -> None:
    """Have each of several servers of one machine open its share of processes."""
    global MOST
    MOST = max(1, MOST // servers)


def processes() -> ProcessPoolExecutor:
    """Open the processes that all sessions share: as many as cores, up to four.

    They start with the first task, and again after one of them was killed.
    """
    with _LOCK:
        if _POOLS:
            try:
                _POOLS[0].submit(os.getpid)
            except BrokenExecutor:
                _POOLS.clear()
        if not _POOLS:
            # Each keeps to one thread inside BLAS: they would only collide.
            os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
            fresh = multiprocessing.get_context("spawn")
            _POOLS.append(
                ProcessPoolExecutor(MOST, mp_context=fresh, initializer=_quiet)
            )
        return _POOLS[0]


def get_ready() -> None:
    """Have the processes begin and load what work needs, before one asks for it."""
    WAITING.submit(lambda: [processes().submit(_load) for _ in range(MOST)])


def _load() -> None:
    importlib.import_module("pandas")
    importlib.import_module("nmss_lab.cases")


def _quiet() -> None:
    """Let pages go first, and limits that cannot all be kept pass without a word."""
    if hasattr(os, "nice"):
        os.nice(10)
    logging.getLogger("nmss_lab").setLevel(logging.ERROR)


ENDED = (
    "a process that computed was ended from outside, twice; perhaps this machine has "
    "too little memory"
)


class Withdrawn(Exception):  # noqa: N818  nothing went wrong
    """The work was called off."""


class Lent(Executor):
    """The shared processes as one piece of work gets them.

    A few tasks at a time, so that the work of one session does not keep the others
    waiting; and ``withdraw`` ends whatever waits for a result at once, with a
    ``Withdrawn``, though a task that a process has begun goes on to its end.  Where a
    process is killed, what it owed is given to new ones, once.  The processes begin
    with the first task, unless another pool is given.
    """

    def __init__(self, pool: Executor | None = None, at_once: int = 4) -> None:
        self._pool, self._free = pool, at_once
        self._waiting: deque[tuple[Future[Any], Callable[[], Any]]] = deque()
        self._open: set[Future[Any]] = set()
        self._again: set[Future[Any]] = set()
        self._lock = threading.RLock()
        self._withdrawn = False

    def submit(
        self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any
    ) -> Future[Any]:
        """Put a task in the queue of this piece of work."""
        outer: Future[Any] = Future()
        with self._lock:
            if self._withdrawn:
                outer.set_exception(Withdrawn())
                return outer
            self._open.add(outer)
            self._waiting.append((outer, partial(fn, *args, **kwargs)))
        self._go_on()
        return outer

    def withdraw(self) -> None:
        """End the waiting for all results there are not yet, and for any to come."""
        with self._lock:
            self._withdrawn = True
            self._waiting.clear()
            given_up, self._open = self._open, set()
        for outer in given_up:
            with suppress(InvalidStateError):  # whoever asked has cancelled it
                outer.set_exception(Withdrawn())

    def _go_on(self) -> None:
        """Hand on what there is room for."""
        with self._lock:
            while self._waiting and self._free:
                outer, task = self._waiting.popleft()
                if outer.cancelled():
                    self._open.discard(outer)
                    continue
                self._free -= 1
                try:
                    self._pool = self._pool or processes()
                    inner = self._pool.submit(task)
                except RuntimeError as error:  # the pool broke, or is closed
                    inner = Future()
                    inner.set_exception(error)
                inner.add_done_callback(partial(self._done, outer, task))

    def _done(
        self, outer: Future[Any], task: Callable[[], Any], inner: Future[Any]
    ) -> None:
        broken = not inner.cancelled() and isinstance(inner.exception(), BrokenExecutor)
        with self._lock:
            self._free += 1
            if broken and outer in self._open and outer not in self._again:
                self._again.add(outer)
                self._pool = processes()
                self._waiting.appendleft((outer, task))
                self._go_on()
                return
            wanted = outer in self._open and outer.set_running_or_notify_cancel()
            self._open.discard(outer)
        if wanted and broken:  # nothing that this process should try itself
            outer.set_exception(ValueError(ENDED))
        elif wanted and inner.cancelled():
            outer.set_exception(CancelledError())
        elif wanted and (error := inner.exception()) is not None:
            outer.set_exception(error)
        elif wanted:
            outer.set_result(inner.result())
        self._go_on()


class Working(Protocol):
    """Anything with work that can be called off."""

    def call_off(self) -> None:
        """Have the work stop as soon as it can."""


class _AtTheEnd(Handler):
    """Calls off all work when the server stops."""

    def modify_document(self, doc: Document) -> None:
        """Leave documents as they are."""

    def on_server_unloaded(self, server_context: Any) -> None:
        """Call off the work and end the processes."""
        for working in list(_WORKING):
            working.call_off()
        for child in multiprocessing.active_children():
            child.terminate()


_WORKING: WeakSet[Any] = WeakSet()
_HEARD: WeakSet[Any] = WeakSet()


def ends_with_the_server(working: Working, document: Document) -> None:
    """Call work off when the server of a session's document stops.

    Python waits for its threads before it ends, so whatever works in one must be
    told.
    """
    _WORKING.add(working)
    context = document.session_context
    server = context.server_context.application_context if context else None
    if server is not None and server not in _HEARD:
        _HEARD.add(server)
        server.application.add(_AtTheEnd())
