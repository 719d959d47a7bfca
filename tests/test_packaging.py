"""The wheel works away from the checkout; the pins keep to the declared ranges."""

import email
import os
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from importlib.metadata import requires, version
from pathlib import Path

import pytest
from conftest import ROOT, Server
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import nmss_lab

COMMANDS = ["serve", "reproduce", "simulate", "identify"]

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
    "project"
]
DECLARED = [
    Requirement(line)
    for line in PROJECT["dependencies"] + PROJECT["optional-dependencies"]["test"]
]
PINS = [
    Requirement(line)
    for line in (ROOT / "requirements.txt").read_text(encoding="utf-8").splitlines()
    if line and not line.startswith("#")
]


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command that must succeed and return what it printed."""
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env=clean_environment(),
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def clean_environment() -> dict[str, str]:
    """Return the environment without paths that could lead back to the checkout."""
    return {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel with the pinned hatchling."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = (sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation")
    run(*pip, "--wheel-dir", folder, ROOT, cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install the wheel in an environment that cannot see the checkout.

    The dependencies are borrowed from the running environment by naming their
    folders: files ending in .pth there, such as that of an installation in place,
    are not read from a borrowed folder.
    """
    home = tmp_path_factory.mktemp("away")
    run(sys.executable, "-m", "venv", "--without-pip", home / "venv", cwd=home)
    programs = home / "venv" / ("Scripts" if sys.platform == "win32" else "bin")
    ask = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(run(programs / "python", "-c", ask, cwd=home).strip())
    (site / "borrowed.pth").write_text("\n".join(borrowed()), encoding="utf-8")
    pip = (sys.executable, "-m", "pip", "--python", programs / "python")
    run(*pip, "install", "--no-deps", "--no-index", wheel, cwd=home)
    return programs


def borrowed() -> Iterator[str]:
    """Yield the folders of installed packages, without the checkout itself."""
    for folder in map(Path, sys.path):
        if any(part in {"site-packages", "dist-packages"} for part in folder.parts):
            yield str(folder)


def test_wheel_carries_everything(wheel: Path) -> None:
    """Modules, records with their licences, pages and the like are in the wheel."""
    names = set(zipfile.ZipFile(wheel).namelist())
    modules = {
        path.relative_to(ROOT).as_posix()
        for path in ROOT.glob("nmss_lab/**/*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    pages = {
        f"nmss_lab/_pages/{path.relative_to(ROOT).as_posix()}"
        for path in ROOT.glob("apps/**/*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert modules | pages | {"nmss_lab/py.typed"} <= names
    assert any(name.endswith("LICENSE") for name in names)
    assert {name.split("/")[0].partition("-")[0] for name in names} == {"nmss_lab"}


def test_wheel_metadata(wheel: Path) -> None:
    """The wheel says name, version, Python and licence as the project does."""
    with zipfile.ZipFile(wheel) as archive:
        (path,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        said = email.message_from_bytes(archive.read(path))
    assert said["Name"] == "nmss-lab"
    assert said["Version"] == nmss_lab.__version__
    assert said["Requires-Python"] == ">=3.11"
    assert said["License-Expression"] == "BSD-3-Clause AND MIT AND CC-BY-SA-4.0"


def test_import_away_from_checkout(installed: Path, tmp_path: Path) -> None:
    """The installed package is imported, not the checkout, and knows its version."""
    code = (
        "import nmss_lab, importlib.metadata as m; print(nmss_lab.__file__); "
        "print(nmss_lab.__version__ == m.version('nmss-lab'), sorted(nmss_lab.__all__))"
    )
    where, what = run(installed / "python", "-c", code, cwd=tmp_path).splitlines()
    assert Path(where).is_relative_to(installed.parent)
    assert what == f"True {sorted(nmss_lab.__all__)}"


def test_every_module_imports_away_from_checkout(
    installed: Path, tmp_path: Path
) -> None:
    """No module of the wheel needs a file which only the checkout has."""
    modules = [f"nmss_lab.{path.stem}" for path in ROOT.glob("nmss_lab/[!_]*.py")]
    run(installed / "python", "-c", f"import {', '.join(modules)}", cwd=tmp_path)


def test_version(installed: Path, tmp_path: Path) -> None:
    """``nmss-lab --version`` says the version."""
    said = run(installed / "nmss-lab", "--version", cwd=tmp_path)
    assert said == f"nmss-lab {nmss_lab.__version__}\n"


@pytest.mark.parametrize("command", COMMANDS)
def test_help(installed: Path, tmp_path: Path, command: str) -> None:
    """Every command explains itself, and the main help names it."""
    said = run(installed / "nmss-lab", command, "--help", cwd=tmp_path)
    assert said.startswith(f"usage: nmss-lab {command}")
    assert command in run(installed / "nmss-lab", "--help", cwd=tmp_path)


def test_installed_wheel_serves(installed: Path, tmp_path: Path) -> None:
    """The installed command serves the pages the wheel carries."""
    running = Server(
        tmp_path / "stderr.log",
        command=(str(installed / "nmss-lab"),),
        cwd=tmp_path,
        env=clean_environment(),
    )
    code, _ = running.stop()
    assert code == 0


def pins() -> dict[str, Requirement]:
    """Return the pins that apply to this machine by name."""
    return {
        canonicalize_name(pin.name): pin
        for pin in PINS
        if pin.marker is None or pin.marker.evaluate()
    }


@pytest.mark.parametrize("pin", PINS, ids=str)
def test_pin_is_plain(pin: Requirement) -> None:
    """A line of requirements.txt is name==version, perhaps for one platform."""
    (only,) = pin.specifier
    assert only.operator == "=="
    assert pin.url is None
    assert "*" not in only.version


@pytest.mark.parametrize("need", DECLARED, ids=lambda need: need.name)
def test_pins_keep_to_the_ranges(need: Requirement) -> None:
    """Each declared dependency is pinned, everywhere to a version it allows."""
    versions = [
        next(iter(pin.specifier)).version
        for pin in PINS
        if canonicalize_name(pin.name) == canonicalize_name(need.name)
    ]
    assert versions, f"{need.name} has no pin"
    assert [v for v in versions if v not in need.specifier] == []


def test_environment_has_the_pins() -> None:
    """These tests run with the versions of requirements.txt, not with others."""
    wrong = {
        name: (version(name), str(pin.specifier))
        for name, pin in pins().items()
        if version(name) not in pin.specifier
    }
    assert wrong == {}


def test_pins_are_complete() -> None:
    """What a pinned package needs is pinned too, so that nothing else can move."""
    missing = {
        (name, need.name)
        for name, pin in pins().items()
        for need in map(Requirement, requires(name) or [])
        if applies(need, pin.extras) and canonicalize_name(need.name) not in pins()
    }
    assert missing == set()


def applies(need: Requirement, extras: set[str]) -> bool:
    """Return whether a requirement holds here, for a package with some extras."""
    return need.marker is None or any(
        need.marker.evaluate({"extra": extra}) for extra in {"", *extras}
    )
