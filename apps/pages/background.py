"""What pages share whose work goes on in the background of a session."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import panel as pn

from apps.pages.live import FAULT, KEPT

LOG = logging.getLogger(__name__)


def hand_over(component: Any, name: str, /, **what: Any) -> None:
    """Have the browser keep a file ("saved"), open an address ("leads") or the like.

    The number tells the same thing asked for twice from the same thing told twice.
    """
    number = getattr(component, name).get("number", 0) + 1
    setattr(component, name, {**what, "number": number})


class BackgroundPage:
    """One session's page: what threads find out is said on its event loop."""

    def __init__(self) -> None:
        self.complaint = ""
        self.document, self.served = pn.state.curdoc, False

    def _later(self, action: Callable[[], None]) -> None:
        """Do something on the event loop of this session, if it still is there."""
        document = self.document
        if document is None:
            action()
        elif document.session_context is not None:
            document.add_next_tick_callback(action)

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
        except ValueError as error:
            self.complaint = f"{error}.\n{KEPT}".replace("..\n", ".\n")
        except Exception:  # whoever asked waits for an answer, whatever happens
            LOG.exception("%s: %s", type(self).__name__, about)
            self.complaint = f"{FAULT}\n{KEPT}"
        else:
            self.complaint = ""
            return True
        return False
