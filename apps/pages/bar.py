"""The bar of every page: what is loaded, two held designs, files and pictures."""

from __future__ import annotations

import io
import logging
import threading
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import param
from panel.custom import JSComponent

from apps.player import STYLE, hand_over, script
from apps.session import HELD, case_title, held, open_design, plain
from apps.work import Withdrawn
from nmss_lab.files import Study, dumps
from nmss_lab.report import report
from nmss_lab.simulate import Run

LOG = logging.getLogger(__name__)

FAULT = "These choices met a fault in the program; it has been logged."

LARGEST = 2_000_000
"""Bytes of a design file."""


class Bar(JSComponent):
    """What is loaded and held, and a menu of files.

    ``told`` comes from the server, ``sent`` goes to it: what to do ("act") with which
    design.  ``stop`` counts how often the opening of a file was given up.  ``saved`` is
    a file for the browser to keep, ``leads`` an address to open.
    """

    told = param.Dict(default={})
    sent = param.Dict(default={})
    saved = param.Dict(default={})
    leads = param.Dict(default={})
    answered = param.Integer(default=0)
    stop = param.Integer(default=0)
    most = param.Integer(default=LARGEST)

    _esm = script("bar.js")
    _stylesheets = (STYLE,)
    _debounce = 0  # what was pressed first is heard first


class WithBar:
    """A page with the bar; its choices make designs."""

    choices: Any
    controls: Any
    complaint: str
    alert: Any
    _take: Callable[[Any], None]
    _tell: Callable[[], None]

    def _make_bar(self) -> None:
        """Make the bar; it and the form are heard one at a time, in threads or not."""
        self.bar = Bar(told=self._loaded(), sizing_mode="stretch_width")
        turn = threading.RLock()

        def in_turn(act: Callable[[Any], None]) -> Callable[[Any], None]:
            def heard(event: Any) -> None:
                with turn:
                    act(event)

            return heard

        self.controls.param.watch(in_turn(self._take), "sent")
        self.bar.param.watch(in_turn(self._bar_asks), "sent")

    def _loaded(self) -> dict[str, Any]:
        """Words for the bar: case and designs, what is held, what can be saved."""
        choices = self.choices
        shown = [[name, self._design_named(name)] for name in self._shown_designs()]
        files = [
            [act, name, words.format(label)]
            for act, words in self._files().items()
            for name, label in shown
        ]
        texts = {key: getattr(choices, key) for key in HELD}
        return {
            "title": self._subject(),
            "words": " · ".join(label for _, label in shown),
            "shown": [pair for pair in shown if pair[0] not in HELD],
            "held": {
                key: {
                    "words": held(text).words,
                    "of": held(text).choices.example.title,
                    "misfit": choices.misfit(text),
                }
                for key, text in texts.items()
                if text
            },
            "files": files,
        }

    def _subject(self) -> str:
        return case_title(self.choices.example)

    def _design_named(self, name: str) -> str:
        return f"design {name}" if name in HELD else plain(name)

    def _shown_designs(self) -> list[str]:
        return list(self.choices.structures)

    def _files(self) -> Mapping[str, str]:
        """Files that can be had of each design shown: what to do, and words."""
        return {
            "save": "Design file of {}",
            "csv": "Run of {} as CSV",
            "report": "Report on {} (HTML)",
        }

    def _bar_asks(self, event: Any) -> None:
        """Do what the bar asks for, or say why it cannot be."""
        sent = dict(event.new)
        actions: dict[str, Callable[[], None]] = {
            "hold": lambda: self._put({sent["which"]: self._address(sent["name"])}),
            "release": lambda: self._put(self._without(sent["which"])),
            "compare": lambda: self._put(self._side_by_side()),
            "save": lambda: self._save_design(sent["name"]),
            "csv": lambda: self._save_run(sent["name"]),
            "report": lambda: self._report_on(sent["name"]),
            "open": lambda: self._open_design(sent),
        }
        try:
            action = actions[sent.get("act", "")]
            action()
        except ValueError as error:
            self._complain(str(error))
        except Exception:  # whoever asked is told, whatever happens
            LOG.exception("bar: %s", sent.get("act"))
            self._complain(FAULT)
        self.bar.answered = sent.get("number", 0)

    def _complain(self, text: str) -> None:
        self.complaint = text
        self._tell()

    def _put(self, values: Mapping[str, Any]) -> None:
        """Take over choices as if the form had sent them."""
        new = {**self.choices.values(), **values, "whole": True, "message": 0}
        self._take(SimpleNamespace(new=new))

    def _address(self, name: str) -> str:
        """Return what is held when a design is."""
        return self.choices.hold(name)

    def _without(self, which: str) -> dict[str, Any]:
        """Choices once nothing is held as that."""
        left = [name for name in self.choices.structures if name != which]
        return {which: "", "structures": left or self.choices.usual_structures()}

    def _side_by_side(self) -> dict[str, Any]:
        """Choices that show what is held, beside the first design shown."""
        fitting = list(self.choices.fitting())
        present = [name for name in self.choices.structures if name not in HELD]
        present = present or self.choices.usual_structures()
        return {"structures": [*fitting, *present][: len(fitting) + 1]}

    def _study(self, name: str) -> Study:
        return self.choices.study_of(name)

    def _run_of(self, name: str) -> Run:
        runs: Mapping[str, Run] = self.choices.runs()
        return runs[name]

    def _save_design(self, name: str) -> None:
        text = dumps(self._study(name))
        hand_over(self.bar, "saved", name="design.json", text=text)

    def _save_run(self, name: str) -> None:
        stream = io.StringIO()
        self._run_of(name).record().to_csv(stream)
        name = f"run_{name}.csv"
        text, kind = stream.getvalue(), "text/csv"
        hand_over(self.bar, "saved", name=name, text=text, type=kind)

    def _report_on(self, name: str) -> None:
        title = f"{self._design_named(name)}: {self._subject()}"
        text = report(self._study(name), title=title, **self._uncertain())
        kind = "text/html"
        hand_over(self.bar, "saved", name="report.html", text=text, type=kind)

    def _uncertain(self) -> dict[str, Any]:
        """Plants that a report tries besides the given one."""
        return {}

    def _open_design(self, sent: Mapping[str, Any]) -> None:
        name, size = str(sent.get("name"))[:80], int(sent.get("size", 0))
        if size > LARGEST:
            raise ValueError(
                f"{name} has {size / 1e6:.3g} MB, a design file has up to "
                f"{LARGEST / 1e6:g} MB"
            )
        text, stop = str(sent.get("text", "")), self.bar.stop

        def goes_on() -> None:
            if self.bar.stop != stop:
                raise Withdrawn

        try:
            leads = open_design(text, goes_on)
        except Withdrawn:
            raise ValueError(f"{name}: given up") from None
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
        hand_over(self.bar, "leads", to=leads)
