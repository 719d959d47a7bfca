"""Lessons and solutions: stored without outputs, in small cells, nothing hidden.

nbval runs them, once each; `QuietNotebooks` of conftest.py looks for warnings.
"""

import ast
import itertools
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import nbformat
import pytest
from conftest import ROOT

LESSONS = sorted(ROOT.glob("notebooks/[0-9]*.ipynb"))
SOLUTIONS = sorted(ROOT.glob("notebooks/solutions/*.ipynb"))
LONGEST = 20
"""Lines of code in a cell: what fits on a projector beside its output."""


def each(paths: list[Path]) -> pytest.MarkDecorator:
    """Run a test for each notebook."""
    return pytest.mark.parametrize("path", paths, ids=lambda path: path.stem)


each_lesson, each_solution = each(LESSONS), each(SOLUTIONS)
each_notebook = each(LESSONS + SOLUTIONS)


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


@each_notebook
def test_no_stored_outputs(path: Path) -> None:
    """Outputs come from a run, never from the repository."""
    kept = [cell for cell in code(path) if cell["outputs"] or cell["execution_count"]]
    assert kept == []


@each_notebook
def test_cells_are_small(path: Path) -> None:
    """No code cell is longer than a screen."""
    lengths = [len(cell["source"].splitlines()) for cell in code(path)]
    assert max(lengths) <= LONGEST


@each_notebook
def test_nothing_is_hidden(path: Path) -> None:
    """All code is shown and is Python: no tags, folded cells, magics or shell."""
    notes = [cell["metadata"] for cell in cells(path) if cell["metadata"]]
    assert notes == []
    for cell in code(path):
        ast.parse(cell["source"])
        assert "NBVAL" not in cell["source"]


@each_notebook
def test_text_between_all_code(path: Path) -> None:
    """Every code cell follows a text cell, and the notebook ends with text."""
    kinds = [cell["cell_type"] for cell in cells(path)]
    assert kinds[0] == kinds[-1] == "markdown"
    assert ("code", "code") not in set(itertools.pairwise(kinds))


@each_lesson
def test_length(path: Path) -> None:
    """A lesson has 15 to 30 cells."""
    assert 15 <= len(cells(path)) <= 30


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


@each_notebook
def test_links_exist(path: Path) -> None:
    """Files that a lesson points to are there."""
    for cell in cells(path):
        for link in re.findall(r"\]\(([^)\s#]+)", cell["source"]):
            assert "://" in link or (path.parent / link).exists(), link


@each_notebook
def test_python_3_kernel(path: Path) -> None:
    """Any Jupyter finds the kernel."""
    metadata = json.loads(path.read_text(encoding="utf-8"))["metadata"]
    assert metadata["kernelspec"]["name"] == "python3"


# --- The table in the README ------------------------------------------------------


def test_readme_lists_every_lesson() -> None:
    """The table has one row a lesson, with its title, in order, and no other row."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    rows = re.findall(
        r"^\| \[(.+?)\]\(notebooks/(.+?)\.ipynb\) \| \w.+ \|$", readme, re.M
    )
    titles = [cells(path)[0]["source"].splitlines()[0] for path in LESSONS]
    wanted = list(zip(titles, (path.stem for path in LESSONS), strict=True))
    assert [(f"# {title}", name) for title, name in rows] == wanted


# --- Solutions --------------------------------------------------------------------


def checks(path: Path) -> list[str]:
    """Return the checks that the exercises of a lesson call."""
    source = "\n".join(cell["source"] for cell in code(path))
    return re.findall(r"^print\((check_\w+)\(", source, re.MULTILINE)


def asked(path: Path, how: str) -> list[str]:
    """Return the checks asked by ``accepts`` or ``refuses``, once for each call."""
    source = "\n".join(cell["source"] for cell in code(path))
    return re.findall(rf"^ *{how}\(\s*lesson\.(check_\w+)", source, re.MULTILINE)


@each_lesson
def test_lesson_has_solutions(path: Path) -> None:
    """Each lesson has its notebook of solutions."""
    assert path.parent / "solutions" / f"{path.stem}_solutions.ipynb" in SOLUTIONS


@each_solution
def test_every_exercise_is_answered(path: Path) -> None:
    """A right answer or more, and two wrong ones or more, to each exercise."""
    name = path.stem.removesuffix("_solutions")
    lesson = path.parent.parent / f"{name}.ipynb"
    assert f'lesson = run("{name}")' in "".join(cell["source"] for cell in code(path))
    right, wrong = asked(path, "accepts"), asked(path, "refuses")
    assert set(right) == set(wrong) == set(checks(lesson))
    assert min(wrong.count(check) for check in checks(lesson)) >= 2


@each_solution
def test_parts_of_solutions(path: Path) -> None:
    """A section an exercise, with its name in the lesson, and a way back."""
    headings = [
        re.findall(r"^## (Exercise \d: .*)$", text, re.MULTILINE)
        for text in (
            "\n".join(c["source"] for c in cells(each) if c["cell_type"] == "markdown")
            for each in (path, path.parent.parent / path.name.replace("_solutions", ""))
        )
    ]
    assert headings[0] == headings[1]
    lesson = path.name.replace("_solutions", "")
    assert f"](../{lesson})" in cells(path)[-1]["source"]


# --- The watch itself -------------------------------------------------------------


def written(folder: Path, source: str) -> Path:
    """Write a notebook of one cell."""
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source)])
    nbformat.write(notebook, folder / "one.ipynb")
    return folder / "one.ipynb"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("import warnings\nwarnings.warn('old')", "wrote to standard error"),
        ("1 / 0", "ZeroDivisionError"),
        ("print('fine')", "1 passed"),
    ],
)
def test_warnings_fail(source: str, says: str, tmp_path: Path) -> None:
    """A cell that warns or raises fails under the command of the Makefile."""
    command = "-m", "pytest", "-p", "conftest", "--nbval-lax", "--nbval-current-env"
    done = subprocess.run(
        [sys.executable, *command, "--rootdir", tmp_path, written(tmp_path, source)],
        env=os.environ | {"PYTHONPATH": str(ROOT / "tests")},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (done.returncode == 0) == ("passed" in says), done.stdout
    assert says in done.stdout
