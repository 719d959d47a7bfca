"""Lessons: stored without outputs, in small cells, nothing hidden, no warnings."""

import ast
import itertools
import json
import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
from conftest import ROOT
from nbclient import NotebookClient

LESSONS = sorted(ROOT.glob("notebooks/**/[0-9]*.ipynb"))
LONGEST = 20
"""Lines of code in a cell: what fits on a projector beside its output."""

each_lesson = pytest.mark.parametrize("path", LESSONS, ids=lambda path: path.stem)


def cells(path: Path) -> list[dict[str, Any]]:
    """Return the cells of a notebook, their sources joined."""
    stored = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return [cell | {"source": "".join(cell["source"])} for cell in stored]


def code(path: Path) -> list[dict[str, Any]]:
    """Return the code cells of a notebook."""
    return [cell for cell in cells(path) if cell["cell_type"] == "code"]


def test_there_is_a_first_lesson() -> None:
    """Links lead to it, so its name never changes."""
    assert ROOT / "notebooks" / "00_start_here.ipynb" in LESSONS


@each_lesson
def test_no_stored_outputs(path: Path) -> None:
    """Outputs come from a run, never from the repository."""
    kept = [cell for cell in code(path) if cell["outputs"] or cell["execution_count"]]
    assert kept == []


@each_lesson
def test_cells_are_small(path: Path) -> None:
    """No code cell is longer than a screen."""
    lengths = [len(cell["source"].splitlines()) for cell in code(path)]
    assert max(lengths) <= LONGEST


@each_lesson
def test_nothing_is_hidden(path: Path) -> None:
    """All code is shown and is Python: no tags, folded cells, magics or shell."""
    notes = [cell["metadata"] for cell in cells(path) if cell["metadata"]]
    assert notes == []
    for cell in code(path):
        ast.parse(cell["source"])


@each_lesson
def test_text_between_all_code(path: Path) -> None:
    """Every code cell follows a text cell, and the lesson ends with text."""
    kinds = [cell["cell_type"] for cell in cells(path)]
    assert kinds[0] == kinds[-1] == "markdown"
    assert ("code", "code") not in set(itertools.pairwise(kinds))
    assert 15 <= len(kinds) <= 30


@each_lesson
def test_parts_of_a_lesson(path: Path) -> None:
    """A question first, predictions before reveals, checked claims, exercises."""
    text = "\n".join(c["source"] for c in cells(path) if c["cell_type"] == "markdown")
    source = "\n".join(cell["source"] for cell in code(path))
    assert "question" in cells(path)[0]["source"]
    assert len(re.findall(r"\*\*Your predictions?\*\*", text)) >= 2
    assert len(re.findall(r"^## Exercise \d", text, re.MULTILINE)) == 3
    assert len(re.findall(r"^print\(check_", source, re.MULTILINE)) == 3
    assert "What to read next" in text
    assert "pn.widgets." in source
    assert "\nassert " in source


@each_lesson
def test_links_exist(path: Path) -> None:
    """Files that a lesson points to are there."""
    for cell in cells(path):
        for link in re.findall(r"\]\(([^)\s#]+)", cell["source"]):
            assert "://" in link or (path.parent / link).exists(), link


@each_lesson
def test_python_3_kernel(path: Path) -> None:
    """Any Jupyter finds the kernel."""
    metadata = json.loads(path.read_text(encoding="utf-8"))["metadata"]
    assert metadata["kernelspec"]["name"] == "python3"


@pytest.mark.slow
@each_lesson
def test_no_warnings(path: Path) -> None:
    """A run within a minute prints nothing to standard error."""
    lesson = nbformat.read(path, as_version=4)
    folder = {"metadata": {"path": str(path.parent)}}
    NotebookClient(lesson, timeout=60, resources=folder).execute()
    outputs = [out for cell in lesson.cells for out in cell.get("outputs", [])]
    assert [out["text"] for out in outputs if out.get("name") == "stderr"] == []


# --- Exercises --------------------------------------------------------------------


@pytest.fixture(scope="module")
def start() -> dict[str, Any]:
    """Run lesson 00 in this process and return its names."""
    names: dict[str, Any] = {}
    for cell in code(ROOT / "notebooks" / "00_start_here.ipynb"):
        exec(cell["source"], names)
    return names


@pytest.mark.parametrize(
    ("check", "right", "wrong", "says"),
    [
        ("check_horizon", 5, None, "whole number"),
        ("check_horizon", 5, 4, "stays shut"),
        ("check_horizon", 5, 6, "looks less far"),
        ("check_price", 12000, -1.0, "positive"),
        ("check_price", 12000, 5000, "too cheap"),
        ("check_price", 12000, 50000, "it takes"),
    ],
)
def test_checks_of_start(
    start: dict[str, Any], check: str, right: Any, wrong: Any, says: str
) -> None:
    """Each check accepts a right answer and says what is wrong with another."""
    assert start[check](right).startswith("Right")
    assert says in start[check](wrong)


def test_check_of_design(start: dict[str, Any]) -> None:
    """The third exercise of lesson 00 has an answer, and refuses others."""
    base, check = start["base"], start["check_design"]
    change = start["dataclasses"].replace
    assert check(change(base, R=20000.0)).startswith("Right")
    assert "swings grow" in check(base)
    assert "too slow" in check(change(base, R=5000.0))
    assert "Too hot" in check(change(base, structure="forward_path"))
    assert "Keep the model" in check(change(base, model=base.model.varied(0.5)))
