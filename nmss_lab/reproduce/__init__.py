"""What the thesis prints or states, beside what the library computes.

Every row is a ``Claim``: the thesis's value, ours, a tolerance with its reason, and a
verdict that follows from the three.  Printed values are only ever compared with; no
result is made from one.  ``claims()`` computes all rows, ``claims(3)`` a chapter's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from nmss_lab.reproduce import (
    chapter_2,
    chapter_3,
    chapter_4,
    chapter_5,
    chapter_6,
    chapter_7,
    chapter_8,
)
from nmss_lab.reproduce.rows import ERRATA, Claim, table

__all__ = ["CHAPTERS", "ERRATA", "Claim", "claims", "table"]

CHAPTERS: dict[int, tuple[Callable[[], Iterator[Claim]], ...]] = {
    2: chapter_2.TOPICS,
    3: chapter_3.TOPICS,
    4: chapter_4.TOPICS,
    5: chapter_5.TOPICS,
    6: chapter_6.TOPICS,
    7: chapter_7.TOPICS,
    8: chapter_8.TOPICS,
}
"""Topics of each chapter."""


def claims(chapter: int | None = None) -> list[Claim]:
    """Compute the rows of a chapter, or of all.

    Raises
    ------
    ValueError
        If nothing of that chapter is covered.
    """
    if chapter is not None and chapter not in CHAPTERS:
        covered = ", ".join(map(str, CHAPTERS))
        raise ValueError(f"chapter = {chapter}: expected one of {covered}")
    wanted = CHAPTERS if chapter is None else {chapter: CHAPTERS[chapter]}
    return [row for topics in wanted.values() for topic in topics for row in topic()]
