# ruff: noqa: T201 - what a check says is printed
"""What the solutions share: a lesson's own checks, and what they say of answers.

The solutions of the lesson ``NAME.ipynb`` are ``solutions/NAME_solutions.ipynb``: it
calls ``lesson = run("NAME")`` once, then for each check of the lesson `accepts` with
at least one right answer and `refuses` with at least two wrong ones, each after text
that explains it.  ``tests/test_lessons.py`` counts these calls.
"""

import contextlib
import io
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import nbformat

LESSONS = Path(__file__).resolve().parent.parent


def run(name: str) -> SimpleNamespace:
    """Run the code of a lesson, keep its prints to itself, and return its names.

    Parameters
    ----------
    name : str
        Such as ``"00_start_here"``.

    Returns
    -------
    SimpleNamespace
        Everything the lesson defines, its checks included.
    """
    names: dict[str, Any] = {}
    lesson = nbformat.read(LESSONS / f"{name}.ipynb", as_version=4)
    with contextlib.redirect_stdout(io.StringIO()):
        for cell in lesson.cells:
            if cell.cell_type == "code":
                exec(cell.source, names)
    return SimpleNamespace(**names)


def accepts(check: Callable[..., str], *answer: Any, **named: Any) -> None:
    """Print what a check says of a right answer; fail unless it accepts it."""
    said = check(*answer, **named)
    print(said)
    assert said.startswith("Right"), said


def refuses(check: Callable[..., str], *answer: Any, saying: str, **named: Any) -> None:
    """Print what a check says of a wrong answer; fail unless it is told so.

    Parameters
    ----------
    check : function
    *answer, **named
        What it is asked.
    saying : str
        Words that must be in what it says, which tell why the answer is wrong.
    """
    said = check(*answer, **named)
    print(said)
    assert saying in said, said
    assert not said.startswith("Right"), said
