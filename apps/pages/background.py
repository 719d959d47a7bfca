"""What pages share whose work goes on in the background of a session."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Executor, Future
from typing import Any

import panel as pn

from apps.pages.live import FAULT, KEPT
from apps.work import WAITING, Lent, Withdrawn, ends_with_the_server

LOG = logging.getLogger(__name__)


class Work:
    """Work in a thread that waits for the shared processes; it can be called off."""

    def __init__(self) -> None:
        self.stop, self.lent = threading.Event(), Lent()

    def call_off(self) -> None:
        """Have it stop at once: what it has begun is of no use any more."""
        self.stop.set()
        self.lent.withdraw()

    def check(self) -> None:
        """Go on only if nobody has called it off.

        Raises
        ------
        Withdrawn
            If somebody has.
        """
        if self.stop.is_set():
            raise Withdrawn


class BackgroundPage:
    """One session's page: what threads find out is said on its event loop."""

    call_off: Callable[[], None]

    def __init__(self) -> None:
        self.complaint = ""
        self.document, self.served = pn.state.curdoc, False

    def _ends_with_its_page(self) -> None:
        """Have the work called off when the page is closed, or the server stops."""
        ends_with_the_server(self, self.document)
        pn.state.on_session_destroyed(lambda _: self.call_off())

    def _later(self, action: Callable[[], None]) -> None:
        """Do something on the event loop of this session, if it still is there."""
        document = self.document
        if document is None:
            action()
        elif document.session_context is not None:
            document.add_next_tick_callback(action)

    def _in_thread(
        self,
        work: Work,
        action: Callable[[], None],
        ended: Callable[[str], None],
        threads: Executor = WAITING,
    ) -> Future[None]:
        """Do something in a thread; how it ended is told on the event loop.

        ``ended`` takes what was wrong: nothing too if the work was called off.
        """

        def whole() -> None:
            problem = ""
            try:
                work.check()
                action()
            except (Withdrawn, CancelledError):
                pass
            except ValueError as error:
                problem = str(error)
            except Exception:
                if not work.stop.is_set():  # else the processes ended under it
                    LOG.exception("%s", type(self).__name__)
                    problem = FAULT
            self._later(lambda: ended(problem))

        return threads.submit(whole)

    def _painted(self, paint: Callable[[], None]) -> None:
        """Draw; figures that are served change on the event loop only."""
        if self.served:
            self._later(paint)
        else:
            paint()

    def _guard(self, action: Callable[[], None], about: Any) -> bool:
        """Do something; what is wrong with it becomes the complaint."""
        try:
            action()
        except Withdrawn:  # whatever asked meanwhile is answered instead
            raise
        except ValueError as error:
            self.complaint = f"{error}.\n{KEPT}".replace("..\n", ".\n")
        except Exception:  # whoever asked waits for an answer, whatever happens
            LOG.exception("%s: %s", type(self).__name__, about)
            self.complaint = f"{FAULT}\n{KEPT}"
        else:
            self.complaint = ""
            return True
        return False
