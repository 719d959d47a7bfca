"""README, glossary and guides: examples run, shown output is real, names are there."""

import doctest
import inspect
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import ROOT

import nmss_lab
from nmss_lab import (
    STRUCTURES,
    DifferenceModel,
    Horizon,
    Limits,
    Status,
    governor,
    lq_gain,
    pip,
)
from nmss_lab.design import VARYING

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md")]
README = PAGES[0].read_text(encoding="utf-8")
GLOSSARY = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
PUBLIC = [name for name in nmss_lab.__all__ if callable(getattr(nmss_lab, name))]
by_name = pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)


# --- Examples and commands --------------------------------------------------------


@by_name
def test_examples(page: Path) -> None:
    """Python shown on a page gives the output shown."""
    failed, _ = doctest.testfile(str(page), module_relative=False)
    assert failed == 0


def test_readme_shows_an_example() -> None:
    """The README begins with one of about ten lines."""
    example, *_ = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert 8 <= len(re.findall(r"^>>> ", example, re.MULTILINE)) <= 13


COUNTED = "nmss-lab reproduce"
"""Command for all rows: its output is compared where they are worked out anyway."""


def commands() -> list[tuple[str, str]]:
    """Return each command shown as ``$ nmss-lab ...`` with the output shown."""
    blocks = re.findall(r"```console\n(.*?)```", README, re.DOTALL)
    parts = [part for block in blocks for part in re.split(r"^\$ ", block, flags=re.M)]
    found = [
        (head, shown) for head, _, shown in (p.partition("\n") for p in parts if p)
    ]
    return [(command, shown) for command, shown in found if command != COUNTED]


@pytest.mark.parametrize(("command", "shown"), commands(), ids=lambda text: text[:30])
def test_command_output_is_real(command: str, shown: str, tmp_path: Path) -> None:
    """Lines shown under a command are printed by it, in this order; ... is a gap."""
    program, *arguments = shlex.split(command)
    assert program == "nmss-lab"
    done = subprocess.run(
        [sys.executable, "-m", "nmss_lab.cli", *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    printed = iter([line.rstrip() for line in done.stdout.splitlines()])
    wanted = [line for line in map(str.rstrip, shown.splitlines()) if line != "..."]
    missing = [line for line in wanted if line not in printed]
    assert missing == [], done.stdout


# --- Names ------------------------------------------------------------------------


@pytest.mark.parametrize("name", nmss_lab.__all__)
def test_glossary_explains_every_name(name: str) -> None:
    """Each public name has a row of its own, with a sentence."""
    rows = re.findall(r"^\| (.*?) \| (.*?) \|", GLOSSARY, re.MULTILINE)
    explained = [text for head, text in rows if f"`{name}`" in head]
    assert len(explained) == 1
    assert explained[0].endswith(".")


def test_glossary_names_exist() -> None:
    """`Class.member` in the glossary is a member of that class."""
    rows = re.findall(r"^\| (`[A-Z].*?) \|", GLOSSARY, re.MULTILINE)
    wrong = [
        f"{owner}.{member}"
        for head in rows
        for owner in re.findall(r"`([A-Z]\w+)", head)
        for member in re.findall(r"\.(\w+)`", head)
        if not has_member(getattr(nmss_lab, owner), member)
    ]
    assert wrong == []


def has_member(owner: type, member: str) -> bool:
    """Return whether a class has an attribute or a field of that name."""
    return hasattr(owner, member) or member in getattr(owner, "__annotations__", {})


def test_statuses_are_explained() -> None:
    """Every status has a row in choosing.md."""
    choosing = (ROOT / "docs" / "choosing.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([A-Z_]+)` \|", choosing, re.MULTILINE)
    assert rows == [status.name for status in Status]


# --- Docstrings -------------------------------------------------------------------


def documented(name: str) -> set[str]:
    """Return the arguments that a docstring, or one it points to, documents."""
    text = inspect.getdoc(getattr(nmss_lab, name)) or ""
    section = re.search(r"Parameters\n-+\n(.*?)(?=\n\n?[A-Z]\w+\n-+\n|\Z)", text, re.S)
    lines = section[1].splitlines() if section else []
    heads = [line.split(":")[0] for line in lines if line and not line[0].isspace()]
    found = {word.strip(" *") for head in heads for word in head.split(",")}
    quoted = set(re.findall(r"``(\w+)``", text))
    elsewhere = [documented(other) for other in quoted & {*PUBLIC} - {name}]
    return found.union(quoted, *elsewhere)


def arguments(name: str) -> Iterator[str]:
    """Yield the arguments of a public function or class that a user passes."""
    thing = getattr(nmss_lab, name)
    if thing in (nmss_lab.Plant, nmss_lab.Status):  # a protocol, an enumeration
        return
    for argument in inspect.signature(thing).parameters:
        if argument not in ("model", "controller") or inspect.isclass(thing):
            yield argument


@pytest.mark.parametrize("name", PUBLIC)
def test_arguments_are_documented(name: str) -> None:
    """Each argument is in the docstring, by name, or in one the docstring points to.

    ``model`` and ``controller`` of a function say all with their type.
    """
    assert inspect.getdoc(getattr(nmss_lab, name))
    assert set(arguments(name)) - documented(name) == set()


# --- Links and tables -------------------------------------------------------------


def slug(heading: str) -> str:
    """Return the anchor that a heading gets."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


@by_name
def test_links_exist(page: Path) -> None:
    """Linked files exist, and so do the headings that links point to."""
    text = page.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" in link:
            continue
        file, _, anchor = link.partition("#")
        target = page.parent / file if file else page
        assert target.exists(), link
        if anchor:
            headings = re.findall(r"^#+ (.*)$", target.read_text("utf-8"), re.MULTILINE)
            assert anchor in map(slug, headings), link


@by_name
def test_one_sentence_a_line(page: Path) -> None:
    """Prose has one sentence a line; lists, tables and code are left alone."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    prose = [line for line in text.splitlines() if re.match(r"[A-Z]", line)]
    assert [line for line in prose if re.search(r"[a-z)`]\. [A-Z]", line)] == []


def test_dependencies_are_explained() -> None:
    """Every declared dependency has a row with a reason and a licence."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    declared = project["dependencies"] + project["optional-dependencies"]["test"]
    names = [re.match(r"[\w-]+", line)[0] for line in declared]
    section = README.partition("## Dependencies")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| ([a-z-]+) \| \w.+ \| \w.+ \|$", section, re.MULTILINE)
    assert sorted(rows) == sorted(names)


# --- The table of structures ------------------------------------------------------

MODEL = DifferenceModel([-1.2, 0.35], [0.5, 0.2], [0.3])
K = lq_gain(MODEL, 1.0, 1.0)
BUILT = {
    **{
        name: make(MODEL, Horizon(15, 4), 1.0, 1.0) for name, make in STRUCTURES.items()
    },
    "pip": pip(MODEL, K),
    "governor": governor(MODEL, K, 10, Limits(u=(-1.0, 1.0))),
}


def structure_rows() -> dict[str, list[str]]:
    """Return the rows of the table of structures, by function."""
    rows = re.findall(r"^\| `(\w+)` \| (.*) \|$", README, re.MULTILINE)
    return {name: rest.split(" | ") for name, rest in rows}


def test_every_structure_is_in_the_table() -> None:
    """The README lists all structures and no other."""
    assert set(structure_rows()) == set(BUILT) | set(VARYING)


@pytest.mark.parametrize("name", BUILT)
def test_table_tells_hidden_modes(name: str) -> None:
    """A structure said to have no hidden modes has none, a forward path has all."""
    hidden = sorted(nmss_lab.linear_loop(BUILT[name]).hidden_modes.real)
    said = structure_rows()[name][3]
    wanted = sorted(MODEL.poles().real) if said.startswith("every pole") else []
    assert hidden == pytest.approx(wanted, abs=1e-6)
