"""Components that run in the browser: the form of choices and the player."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import param
from panel.custom import JSComponent

from nmss_lab.plots import Chart, pack, sentences
from nmss_lab.simulate import Run

HERE = Path(__file__).resolve().parent
STYLE = (HERE / "parts.css").read_text(encoding="utf-8")


def script(name: str) -> str:
    """Text of a component's script, after what all of them share."""
    parts = (HERE / part for part in ("figures.js", name))
    return "\n".join(part.read_text(encoding="utf-8") for part in parts)


def hand_over(component: Any, name: str, /, **what: Any) -> None:
    """Have the browser keep a file ("saved"), open an address ("leads") or the like.

    The number tells the same thing asked for twice from the same thing told twice.
    """
    number = getattr(component, name).get("number", 0) + 1
    setattr(component, name, {**what, "number": number})


class Controls(JSComponent):
    """A form made from a description of choices.

    ``form`` and ``state`` come from the server: "groups" and "defaults", and "values"
    and the number of the "message" they answer; ``form`` is set before ``state``, or
    has a "number" which ``state`` names as "form".
    ``busy`` tells of a message whose answer takes a while, and the "share" that is
    done.  ``sent`` goes to the server: all values, or "cancel", and the number of the
    "message"; it may do so before the answer to one that is told to be busy.
    """

    form = param.Dict(default={})
    state = param.Dict(default={})
    busy = param.Dict(default={})
    sent = param.Dict(default={})

    _esm = script("controls.js")
    _stylesheets = (STYLE,)
    _debounce = 0  # the form itself sends one message at a time


LOOP = {
    "status": "status",
    "statistics": "nmssPlayer",
    "label": "Player",
    "noun": "Sample",
    "plural": "samples",
    "past": "Past plans",
    "rate": 10,
    "keys": True,
}
"""Words and places of the player of a loop."""

INSIDE = {
    "status": "inside",
    "statistics": "nmssInside",
    "label": "Passes within the sample",
    "noun": "Pass",
    "plural": "passes",
    "past": "Earlier passes",
    "rate": 5,
    "keys": False,
}
"""The same of the player of the passes within a sample."""


class Player(JSComponent):
    """Moves through a run that was sent once; see ``moving``."""

    run = param.Dict(default={})
    place = param.Dict(default=LOOP)

    _esm = script("player.js")
    _stylesheets = (STYLE,)


def stepping(charts: Sequence[Chart], words: list[dict[str, Any]]) -> dict[str, Any]:
    """Gather what a player needs to step through versions of one prediction.

    Parameters
    ----------
    charts : sequence of Chart
        The first one runs over the steps.
    words : list
        For each curve a "name", "texts", and "which" of them each step shows.
    """
    return {**pack(charts), "words": words, "start": 0, "fresh": True}


def moving(
    charts: Sequence[Chart], runs: Mapping[str, Run], start: int, fresh: bool
) -> dict[str, Any]:
    """Gather what a player needs: trails, words for every sample, and where to begin.

    Parameters
    ----------
    start : int
        Sample shown first.
    fresh : bool
        Whether to go there, or to stay where the player is.
    """
    first = next(iter(runs.values()))
    words = []
    for name, run in runs.items():
        texts, which = sentences(run)
        words.append({"name": name, "texts": texts, "which": which.tolist()})
    return {
        **pack(charts),
        "words": words,
        "start": min(start, len(first) - 1),
        "fresh": fresh,
    }
