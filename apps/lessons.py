"""The lessons that belong to the pages; a checkout has them, a wheel does not."""

from __future__ import annotations

import functools
import html
import json
from pathlib import Path

from tornado.web import StaticFileHandler

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = ROOT / "notebooks"
SITE = ROOT / "build" / "lessons"
"""Where ``make lessons`` writes them."""

OF_PAGE = {
    "": ("00_start_here",),
    "workbench": ("09_your_own_plant", "00_start_here"),
    "receding_horizon": ("02_background", "04_integral_of_error_mpc"),
    "structures": ("06_forward_path", "04_integral_of_error_mpc"),
    "governor": ("03_reference_governor",),
    "disturbances": ("07_measured_disturbances",),
    "identify": ("02_background", "09_your_own_plant"),
    "tune": ("05_tuning_by_goals",),
    "state_dependent": ("08_state_dependent",),
    "robustness": ("06_forward_path",),
}
"""Lessons that tell why, by page."""

MISSING = """<!DOCTYPE html>
<html lang="en"><meta charset="utf-8"><title>Lesson - NMSS Lab</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<style>body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 40em; margin: 3em auto;
padding: 0 1em }} code {{ white-space: nowrap }}</style>
<h1>{title}</h1>
<p>The lessons have not been written as pages here. <code>make lessons</code> does so,
once; then this address shows the lesson.</p>
<p><code>make lab</code> opens all of them in JupyterLab, where all can be changed
and run; this one is <code>notebooks/{name}.ipynb</code>.</p>
</html>
"""


@functools.cache
def title(name: str) -> str:
    """Title of a lesson; none if there is no such lesson."""
    path = NOTEBOOKS / f"{name}.ipynb"
    if not path.is_file():
        return ""
    first = json.loads(path.read_text(encoding="utf-8"))["cells"][0]["source"]
    return "".join(first).splitlines()[0].removeprefix("# ")


def lessons(page: str) -> list[tuple[str, str]]:
    """Addresses and titles of a page's lessons, as far as they are here."""
    named = [(name, title(name)) for name in OF_PAGE.get(page, ())]
    return [(f"lessons/{name}.html", words) for name, words in named if words]


class Lessons(StaticFileHandler):
    """Serves the lessons as they were written; says how, where they were not."""

    async def get(self, path: str, include_body: bool = True) -> None:
        """Answer with a file of the site, or with what to do for one."""
        name = Path(path).stem
        if title(name) and not (SITE / f"{name}.html").is_file():
            words = html.escape(title(name))
            self.write(MISSING.format(title=words, name=html.escape(name)))
            return
        await super().get(path, include_body)

    def compute_etag(self) -> str | None:
        """Mark a file by its content; what is said instead of one has no mark."""
        return super().compute_etag() if hasattr(self, "absolute_path") else None


ROUTE = r"/lessons/(.*)", Lessons, {"path": str(SITE), "default_filename": "index.html"}
"""Where the server has them."""
