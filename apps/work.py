"""Long work away from the event loop: threads that wait, processes that compute."""

from __future__ import annotations

import logging
import multiprocessing
import os
import threading
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, ThreadPoolExecutor

WAITING = ThreadPoolExecutor(max_workers=8, thread_name_prefix="waiting")
"""One thread for each study or search of all sessions; more of them wait."""

_LOCK = threading.Lock()
_POOLS: list[ProcessPoolExecutor] = []


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
            count = min(os.cpu_count() or 1, 4)
            _POOLS.append(
                ProcessPoolExecutor(count, mp_context=fresh, initializer=_quiet)
            )
        return _POOLS[0]


def _quiet() -> None:
    """Limits that cannot all be kept are an ordinary sight here."""
    logging.getLogger("nmss_lab").setLevel(logging.ERROR)
