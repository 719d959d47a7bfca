"""Cases that pages make and send to others, in memory and between processes."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from nmss_lab.cases import Case
from nmss_lab.files import dumps, loads, write

MOST_KEPT = 200

GONE = {
    "model": "its model is no longer kept",
    "tuned": "its tuned design is no longer kept",
    "drawn": "its plant is no longer kept",
    "opened": "its file is no longer kept: open it again",
}
"""What a kept case is about, by the beginning of its name."""

NAME = re.compile(rf"({'|'.join(GONE)})-[0-9a-f]{{12}}")


class Origin(NamedTuple):
    """Python of a kept case: what it imports, and lines that make ``example``."""

    imports: tuple[str, ...]
    lines: tuple[str, ...]


class Kept(dict[str, Case]):
    """Kept cases by name, the latest last; those of other processes among them.

    Processes of one server share a folder: a file for each case, of plain data.
    """

    def __init__(self) -> None:
        super().__init__()
        self.origins: dict[str, Origin] = {}
        self._folder: Path | None = None

    def share(self, folder: Path) -> None:
        """Have the other processes that share a folder see what is kept."""
        self._folder = folder

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or self._fetched(str(name))

    def __getitem__(self, name: str) -> Case:
        if name not in self:
            raise KeyError(name)
        return super().__getitem__(name)

    def keep(self, name: str, example: Case, origin: Origin) -> None:
        """Keep a case; the oldest one goes if there are too many.

        Raises
        ------
        ValueError
            If the other processes could not be told.
        """
        self.setdefault(name, example)
        self.origins[name] = origin
        if self._folder is not None and not self._file(name).exists():
            text = json.dumps({"origin": origin, "case": dumps(example)})
            try:
                write(self._file(name), text)
            except OSError as error:
                raise ValueError(
                    f"this could not be kept for the other pages: {error.strerror}"
                ) from error
        while len(self) > MOST_KEPT:
            self._drop(next(iter(self)))

    def _drop(self, name: str) -> None:
        del self[name], self.origins[name]
        if self._folder is not None:
            self._file(name).unlink(missing_ok=True)

    def _fetched(self, name: str) -> bool:
        """Take over a case from another process, if one has kept it."""
        if self._folder is None or not NAME.fullmatch(name):
            return False
        try:
            found: dict[str, Any] = json.loads(self._file(name).read_text("utf-8"))
        except FileNotFoundError:
            return False
        self[name] = loads(found["case"])
        self.origins[name] = Origin(*map(tuple, found["origin"]))
        return True

    def _file(self, name: str) -> Path:
        assert self._folder is not None
        return self._folder / f"{name}.json"


KEPT = Kept()


def keep_case(kind: str, content: str, example: Case, origin: Origin) -> str:
    """Keep a case for the other pages; return its name, the same for equal content.

    ``kind`` is a key of ``GONE``.
    """
    name = f"{kind}-{hashlib.sha256(content.encode()).hexdigest()[:12]}"
    KEPT.keep(name, replace(example, name=name), origin)
    return name
