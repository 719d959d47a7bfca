"""The order of the modules, who may draw, and what is public."""

import ast
import types
from collections.abc import Iterator
from pathlib import Path

import pytest

import nmss_lab

PACKAGE = Path(nmss_lab.__file__).parent

ORDER = [
    "parallel",
    "tables",
    "records",
    "models",
    "expressions",
    "state_dependent",
    "continuous",
    "identify",
    "nmss",
    "predict",
    "qp",
    "regions",
    "laws",
    "controller",
    "pip",
    "predictive",
    "mpc",
    "governor",
    "sdp",
    "sdp_problem",
    "sdp_mpc",
    "analysis",
    "simulate",
    "prices",
    "measures",
    "convergence",
    "design",
    "weights",
    "tuning",
    "matching",
    "uncertainty",
    "montecarlo",
    "cases",
    "comparison",
    "files",
    "reproduce",
    "plots",
    "svg",
    "report",
    "cli_serve",
    "cli_bench",
    "cli_studies",
    "cli",
]
"""Each module imports only modules before it."""

MODULES = sorted(path.stem for path in PACKAGE.glob("*.py") if path.stem != "__init__")


def own(name: str) -> str:
    """Return the module of nmss_lab in a dotted name, or "" if there is none."""
    package, _, rest = name.partition(".")
    return rest.partition(".")[0] if package == "nmss_lab" else ""


def imported(tree: ast.AST) -> Iterator[str]:
    """Yield every dotted name imported anywhere in a tree, functions included."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = "nmss_lab." if node.level else ""
            base = (start + (node.module or "")).rstrip(".")
            yield from (f"{base}.{alias.name}" for alias in node.names)


def imported_at_start(tree: ast.Module) -> set[str]:
    """Return what importing the module imports: all but the bodies of functions."""
    lazy = {
        name
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        or (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
        for name in imported(node)
    }
    return set(imported(tree)) - lazy


def late(module: str, names: Iterator[str]) -> list[str]:
    """Return the imported modules of nmss_lab that do not come before `module`."""
    earlier = ORDER[: ORDER.index(module)]
    return sorted({own(n) for n in names if own(n) in ORDER} - set(earlier))


def parse(module: str) -> ast.Module:
    """Return the syntax tree of a module of nmss_lab."""
    return ast.parse((PACKAGE / f"{module}.py").read_text(encoding="utf-8"))


def packages(names: Iterator[str] | set[str]) -> set[str]:
    """Return the top-level packages among dotted names."""
    return {name.partition(".")[0] for name in names}


def test_the_checks_can_fail() -> None:
    """Each way of importing a later module is noticed."""
    for line in (
        "import nmss_lab.mpc",
        "from nmss_lab import mpc",
        "from nmss_lab.mpc import x",
        "from . import mpc",
        "from .mpc import x",
        "def f():\n    from .mpc import x",
    ):
        assert late("qp", imported(ast.parse(line))) == ["mpc"], line
        assert late("cli", imported(ast.parse(line))) == [], line


def test_every_module_has_its_place() -> None:
    """A module in the package is in the order."""
    assert set(MODULES) <= set(ORDER)


@pytest.mark.parametrize("module", MODULES)
def test_imports_only_earlier_modules(module: str) -> None:
    """A module imports, also inside functions, only modules before it."""
    assert late(module, imported(parse(module))) == []


@pytest.mark.parametrize("module", MODULES)
def test_only_plots_draws(module: str) -> None:
    """Only plots imports a drawing library, none the server, tables reads lazily."""
    everywhere = packages(imported(parse(module)))
    at_start = packages(imported_at_start(parse(module)))
    assert "bokeh" not in everywhere or module == "plots"
    assert "panel" not in everywhere
    assert "pandas" not in at_start
    assert "pandas" not in everywhere or module in ("tables", "montecarlo")
    assert everywhere.isdisjoint({"matplotlib", "plotly", "apps", "control"})


def test_all_is_what_is_public() -> None:
    """`__all__` of the package names exactly its public objects, once."""
    public = {
        name
        for name, value in vars(nmss_lab).items()
        if not name.startswith("_") and not isinstance(value, types.ModuleType)
    }
    assert set(nmss_lab.__all__) - {"__version__"} == public
    assert len(nmss_lab.__all__) == len(set(nmss_lab.__all__))
