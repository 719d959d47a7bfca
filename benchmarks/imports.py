"""Time to import ``nmss_lab`` beside the parts of NumPy and SciPy that it needs.

Run as ``python benchmarks/imports.py``.  Each import happens in a new process; the
clock starts in that process, so that starting Python itself does not count.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator

from frame import Figure, compared, show

ROUNDS, QUICK = 30, 1
KEPT_OUT = "panel", "bokeh", "pandas", "matplotlib", "jupyterlab", "qpsolvers"
"""What importing the library must not bring along."""

NEEDED = """
import sys, nmss_lab
print(*sorted(
    name for name in sys.modules
    if name.split(".")[0] in ("numpy", "scipy") and not name.split(".")[-1][0] == "_"
))
"""
LOADED = "import sys, nmss_lab; print(*sys.modules)"
TIMED = "import time; begin = time.perf_counter(); {}; print(time.perf_counter()-begin)"


def said(program: str) -> str:
    """Run a program in a new Python and return what it printed."""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    return done.stdout


def measure(
    quick: bool = False, say: Callable[[str], None] = print
) -> Iterator[Figure]:
    """Measure in turns."""
    say("imports")
    loaded = {name.split(".")[0] for name in said(LOADED).split()}
    for name in KEPT_OUT:
        if name in loaded:
            raise SystemExit(f"importing nmss_lab imports {name}")
    needed = said(NEEDED).split()
    programs = {
        "ours": TIMED.format("import nmss_lab"),
        "parts": TIMED.format("import " + ", ".join(needed)),
    }
    taken: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(QUICK if quick else ROUNDS):
        for name, program in programs.items():
            taken[name].append(1e3 * float(said(program)))
    yield compared(
        "Import",
        "import nmss_lab",
        f"{len(needed)} modules of NumPy and SciPy",
        taken["ours"],
        "importing these alone",
        taken["parts"],
        "ms",
        target="below 1.5",
        bound=1.5,
    )


if __name__ == "__main__":
    show(measure)
