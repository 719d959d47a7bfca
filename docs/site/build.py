# ruff: noqa: T201 - a command prints
"""Write the lessons, executed, as a site that needs neither network nor server.

``make lessons`` runs this: ``python docs/site/build.py --out build/lessons``.  Each
lesson is executed in a kernel of its own, two at a time; a cell that fails or writes
to standard error ends the run.  Scripts are taken from the installed packages, once
for all pages: Bokeh draws the figures, and the MathJax inside Bokeh the equations.
Documents that a lesson points to come along.  Sliders are asked beforehand for all
their answers, so that they move where no Python runs.
"""

import argparse
import os
import re
import shutil
import sys
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import bokeh
import jinja2
import nbformat
import panel
from nbclient import NotebookClient
from nbconvert.filters import Highlight2HTML, ansi2html
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath
from nbconvert.preprocessors import CoalesceStreamsPreprocessor
from pygments.formatters import HtmlFormatter

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
LESSONS = ROOT / "notebooks"
BOKEH = Path(bokeh.__file__).parent
PANEL = Path(panel.__file__).parent
SCRIPTS = (
    *(
        BOKEH / f"server/static/js/{name}.min.js"
        for name in (
            "bokeh",
            "bokeh-gl",
            "bokeh-widgets",
            "bokeh-tables",
            "bokeh-mathjax",
        )
    ),
    PANEL / "dist/panel.min.js",
    HERE / "page.js",
)
LICENCES = """\
bokeh*.min.js: BokehJS, BSD-3-Clause, https://bokeh.org
bokeh-mathjax.min.js holds MathJax 3, Apache-2.0, https://www.mathjax.org
panel.min.js: Panel, BSD-3-Clause, https://panel.holoviz.org
"""
INDEX = """\
<h1>NMSS Lab: the lessons</h1>
<ol class="lessons">
{rows}
</ol>
<p>Executed, to be read and panned where no Python is.
In JupyterLab (<code>make lab</code>) everything can be changed and run.</p>
"""
PAGE = jinja2.Environment(
    loader=jinja2.FileSystemLoader(HERE), trim_blocks=True, lstrip_blocks=True
).get_template("page.html")
MARK = "assets/page.css"
"""A file by which an earlier site is known, which may be replaced."""

SECONDS = 300
"""For one cell: a slider is asked for all its answers, on a busy computer."""

STYLES = re.compile(r"https://cdn\.holoviz\.org/panel/[^/]+/dist/([\w./-]+\.css)")
"""Style sheets of Panel's components, which are installed, too."""

SERVED = "Part of the dashboard: it opens while make serve runs on this computer"
"""What a link to the dashboard says where the pointer rests on it."""

LOADING = "esms-options", "panel.models.browser.BrowserInfo"
"""Marks of what `panel.extension` shows, which loads scripts that a page has."""


@dataclass(frozen=True)
class Lesson:
    """A lesson by its file: its name, its title and its question.

    Parameters
    ----------
    path : Path
    title, question : str
    """

    path: Path
    title: str
    question: str

    @property
    def name(self) -> str:
        """The name of its page, without ending."""
        return self.path.stem


def lesson(path: Path) -> Lesson:
    """Read title and question from the first cell of a notebook."""
    first = nbformat.read(path, as_version=4).cells[0].source
    title = re.match(r"# (.+)", first)
    question = re.search(r"\*\*The question.*?\*\*:?\s*(.+?)\n\n", first, re.DOTALL)
    if not title or not question:
        raise SystemExit(f"{path.name}: the first cell has no title, or no question")
    asked = question[1][0].upper() + question[1][1:]
    return Lesson(path, title[1], asked)


def lessons(names: Iterable[str] = ()) -> list[Lesson]:
    """Return the lessons of those names, or all, in the order of their numbers."""
    wanted = set(names)
    found = {path.stem: path for path in sorted(LESSONS.glob("[0-9]*.ipynb"))}
    if wanted - set(found):
        raise SystemExit(f"no such lesson: {', '.join(sorted(wanted - set(found)))}")
    return [lesson(found[name]) for name in found if name in wanted or not wanted]


# --- Running a lesson -------------------------------------------------------------


def executed(path: Path) -> nbformat.NotebookNode:
    """Run a notebook in a fresh kernel; fail where it fails or warns."""
    notebook = nbformat.read(path, as_version=4)
    prelude = (HERE / "prelude.py").read_text(encoding="utf-8")
    notebook.cells.insert(0, nbformat.v4.new_code_cell(prelude))
    folder = {"metadata": {"path": str(path.parent)}}
    quiet = ["--log-level=ERROR"]  # of the kernel itself
    NotebookClient(
        notebook, timeout=SECONDS, resources=folder, extra_arguments=quiet
    ).execute()
    del notebook.cells[0]
    notebook, _ = CoalesceStreamsPreprocessor().preprocess(notebook, {})
    for number, cell in enumerate(notebook.cells):
        for output in cell.get("outputs", []):
            if output.get("name") == "stderr":
                raise RuntimeError(f"cell {number} warns:\n{output['text']}")
    return notebook


# --- Text -------------------------------------------------------------------------


MATH = r'<span class="math">[^<]*</span>'
BESIDE = re.compile(rf"[(\[]+{MATH}[^\s<]*|{MATH}[^\s<]+")
"""An equation within a line, and what stands beside it without a space."""


def slug(heading: str) -> str:
    """Return the anchor that a heading gets, as on GitHub."""
    plain = re.sub(r"<[^>]+>", "", heading).lower()
    return re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")


def place(target: Path) -> Path:
    """Return where in the site a file of the repository is.

    >>> place(ROOT / "docs" / "choosing.md").as_posix()
    'docs/choosing.html'
    >>> place(ROOT / "notebooks" / "00_start_here.ipynb").as_posix()
    '00_start_here.html'
    """
    homes = (LESSONS, ROOT, target.parent)
    base = next(home for home in homes if home in target.parents)
    inside = target.relative_to(base)
    page = inside.suffix in (".md", ".ipynb")
    return inside.with_suffix(".html") if page else inside


class Renderer(IPythonRenderer):
    """Markdown as HTML: equations for `page.js`, links to pages of the site.

    Parameters
    ----------
    source : Path
        The file whose text this is.
    """

    def __init__(self, source: Path) -> None:
        super().__init__(escape=False)
        self.source = source
        self.used: set[Path] = set()

    def heading(self, text: str, level: int, **attrs: Any) -> str:
        """Give a heading its anchor."""
        return f'<h{level} id="{slug(text)}">{text}</h{level}>\n'

    def block_math(self, body: str) -> str:
        """Leave an equation on its own line to MathJax."""
        return f'<span class="math display">{self.escape_html(body)}</span>'

    def inline_math(self, body: str) -> str:
        """Leave an equation within a line to MathJax."""
        return f'<span class="math">{self.escape_html(body)}</span>'

    def latex_environment(self, name: str, body: str) -> str:
        r"""Leave ``\begin{...}`` to MathJax."""
        return self.block_math(rf"\begin{{{name}}}{body}\end{{{name}}}")

    def link(self, text: str, url: str, title: str | None = None) -> str:
        """Lead to the page that a file became; what has none is only named."""
        if re.match(r"http://(127\.0\.0\.1|localhost)\b", url):
            title = title or SERVED
        target = self.source.parent / url.partition("#")[0]
        if "solutions" in target.parts or (url[:1] != "#" and target.is_dir()):
            return text
        return str(super().link(text, self.inside(url), title))

    def image(self, text: str, url: str, title: str | None = None) -> str:
        """Show a picture of the repository."""
        return str(super().image(text, self.inside(url), title))

    def inside(self, url: str) -> str:
        """Return the address of a file as seen from this page."""
        file, mark, anchor = url.partition("#")
        if not file or re.match(r"[a-z]+:", url):
            return url
        target = (self.source.parent / file).resolve()
        if not target.is_file():
            raise SystemExit(f"{self.source.name} points to {file}, which is not there")
        self.used.add(target)
        here = place(self.source).parent
        return Path(os.path.relpath(place(target), here)).as_posix() + mark + anchor


def text(source: str, renderer: Renderer) -> str:
    """Return Markdown as HTML; wide tables scroll, and no line begins with a comma."""
    html = MarkdownWithMath(renderer).render(source)
    html = BESIDE.sub(r'<span class="whole">\g<0></span>', html)
    html = re.sub(r"<table>", '<div class="wide"><table>', html)
    return html.replace("</table>", "</table></div>")


# --- Cells ------------------------------------------------------------------------


def shown(output: nbformat.NotebookNode) -> str:
    """Return one output of a cell as HTML."""
    if output.output_type == "stream":
        columns = " columns" if re.search(r"\S {2,}\S", output.text) else ""
        return f'<pre class="printed{columns}">{ansi2html(output.text)}</pre>'
    data = output.get("data", {})
    html = data.get("text/html", "")
    if "application/vnd.holoviews_load.v0+json" in data or not data:
        return ""
    if any(mark in html for mark in LOADING):
        return ""
    if html:
        return f'<div class="drawn">{html}</div>'
    if "image/png" in data:
        return f'<img alt="" src="data:image/png;base64,{data["image/png"]}">'
    return f"<pre class='printed'>{escape(data.get('text/plain', ''))}</pre>"


def section(cell: nbformat.NotebookNode, renderer: Renderer) -> str:
    """Return one cell as HTML, text or code with what it gave."""
    if cell.cell_type == "markdown":
        return f'<section class="text">\n{text(cell.source, renderer)}</section>'
    code = Highlight2HTML()(cell.source)
    outputs = "\n".join(filter(None, map(shown, cell.outputs)))
    return f"<section>\n{code}\n{outputs}</section>"


def write_page(out: Path, where: Path, title: str, body: str, **more: str) -> None:
    """Write one page into the site in the folder ``out``."""
    up = "../" * (len(where.parts) - 1)
    scripts = [path.name for path in SCRIPTS]
    filled = PAGE.render(title=title, body=body, up=up, scripts=scripts, **more)
    (out / where).parent.mkdir(parents=True, exist_ok=True)
    (out / where).write_text(filled, encoding="utf-8")


def at_home(body: str, out: Path) -> str:
    """Let a page take Panel's style sheets from beside the scripts."""
    for name in set(STYLES.findall(body)):
        target = out / "assets" / "panel" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(PANEL / "dist" / name, target)
    return STYLES.sub(r"assets/panel/\1", body)


def write_lesson(path: Path, out: Path, before: str, after: str) -> float:
    """Run a lesson and write its page; return the seconds."""
    began = time.monotonic()
    try:
        notebook = executed(path)
    except Exception as error:
        raise RuntimeError(f"{path.name}: {error}") from None
    renderer = Renderer(path)
    body = "\n".join(section(cell, renderer) for cell in notebook.cells)
    title, near = lesson(path).title, {"before": before, "after": after}
    write_page(out, place(path), title, at_home(body, out), **near)
    return time.monotonic() - began


# --- The site ---------------------------------------------------------------------


def pointed_to(path: Path) -> set[Path]:
    """Return the files that the text of a lesson points to; they must be there."""
    renderer = Renderer(path)
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "markdown":
            text(cell.source, renderer)
    return renderer.used


def write_documents(used: set[Path], out: Path) -> None:
    """Convert or copy what pages point to, and what that points to."""
    done: set[Path] = set()
    while waiting := sorted(used - done):
        path = waiting[0]
        done.add(path)
        if path.suffix == ".md":
            renderer = Renderer(path)
            body = text(path.read_text(encoding="utf-8"), renderer)
            write_page(out, place(path), path.stem, body)
            used |= renderer.used
        elif path.suffix != ".ipynb":
            (out / place(path)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, out / place(path))


def write_index(chosen: list[Lesson], out: Path) -> None:
    """Write the page with a line for each lesson."""
    renderer = Renderer(LESSONS / "index.md")
    rows = [
        f'<li value="{int(one.name[:2])}"><a href="{one.name}.html">{one.title}</a>'
        f" {text(one.question, renderer)}"
        for one in chosen
    ]
    body = INDEX.format(rows="\n".join(rows))
    write_page(out, Path("index.html"), "The lessons", body)


def write_assets(out: Path) -> None:
    """Copy scripts and style once for all pages."""
    assets = out / "assets"
    assets.mkdir(parents=True)
    for path in SCRIPTS:
        shutil.copyfile(path, assets / path.name)
    light, dark = (
        HtmlFormatter(style=style).get_style_defs(".highlight")
        for style in ("default", "github-dark")
    )
    style = (HERE / "page.css").read_text(encoding="utf-8")
    dark = f"@media (prefers-color-scheme: dark) {{\n{dark}\n}}\n"
    (assets / "page.css").write_text(f"{light}\n{dark}{style}", encoding="utf-8")
    licence = (BOKEH / "LICENSE.txt").read_text(encoding="utf-8")
    (assets / "LICENCES.txt").write_text(f"{LICENCES}\n{licence}", encoding="utf-8")


def build(names: Iterable[str], out: Path, workers: int) -> None:
    """Write the site; what an earlier run has written into the folder is replaced."""
    chosen = lessons(names)
    used = set().union(*(pointed_to(one.path) for one in chosen))
    if out.exists() and any(out.iterdir()) and not (out / MARK).exists():
        raise SystemExit(f"{out} holds something else than a site of lessons")
    shutil.rmtree(out, ignore_errors=True)
    write_assets(out)
    write_documents(used, out)
    write_index(chosen, out)
    around = ["", *(one.name for one in chosen), ""]
    with ProcessPoolExecutor(workers) as pool:
        jobs = [
            pool.submit(write_lesson, one.path, out, around[i], around[i + 2])
            for i, one in enumerate(chosen)
        ]
        for one, job in zip(chosen, jobs, strict=True):
            try:
                seconds = job.result()
            except Exception as error:
                pool.shutdown(cancel_futures=True)
                raise SystemExit(str(error)) from None
            print(f"{one.name}: {seconds:.0f} s", flush=True)


def main() -> None:
    """Read the command line and write the site."""
    parser = argparse.ArgumentParser(description="Write the lessons as a static site.")
    parser.add_argument("lessons", nargs="*", help="names, such as 00_start_here")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "lessons")
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    build(asked.lessons, asked.out.resolve(), asked.workers)
    print(asked.out / "index.html")


if __name__ == "__main__":
    sys.exit(main())
