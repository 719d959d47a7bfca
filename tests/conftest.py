"""Tolerances with reasons, a seeded generator, the browser and the server."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

ROOT = Path(__file__).resolve().parent.parent

# --- Tolerances: tests take one of these, or give the reason for another. ---------
# Use: `from conftest import ALGEBRA`.  Curves read off a figure and statistics have
# no common value: their tests derive one from the figure or from the sample size.

ALGEBRA = 1e-12
"""Relative to the largest entry: two ways of writing one matrix.

Rounding of double precision times the few dozen operations per entry; 1e-13 to
1e-16 is seen.
"""

SOLVER = 1e-8
"""Residuals of the optimality conditions: violation, stationarity, complementarity.

What the solvers are asked for, with room for the scaling of the problem.
Says nothing of the decision, which a flat cost leaves undetermined.
"""

DECISION = 1e-6
"""Moves from two solvers or two formulations of one problem.

A residual of `SOLVER` divided by curvature of 1e-2 or more: only where the Hessian
is well conditioned, which the test checks.
"""

REPLAY = 1e-9
"""The same run twice with the same seed: equal but for the order of sums in BLAS."""


def printed(text: str) -> float:
    """Return the tolerance of a printed number: half a unit of its last digit.

    Printing rounds, so the true value lies within it (`PRINTED` in the style guide).

    >>> printed("0.125"), printed("-3"), printed("1.20e-3")
    (0.0005, 0.5, 5e-06)
    """
    mantissa, _, exponent = text.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return float(f"5e{int(exponent or 0) - decimals - 1}")


@pytest.fixture
def rng() -> np.random.Generator:
    """Return a generator with a fixed seed: every run draws the same cases."""
    return np.random.default_rng(20070930)


# --- Notebooks --------------------------------------------------------------------


class QuietNotebooks:
    """Lets a cell that nbval runs fail where it writes to standard error."""

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        """Look at what the cell has put out, once it has run."""
        yield
        outputs = getattr(item, "test_outputs", None) or []
        said = [out["text"] for out in outputs if out.get("name") == "stderr"]
        if said:
            item.raise_cell_error("Cell wrote to standard error", "".join(said))


def pytest_configure(config: pytest.Config) -> None:
    """Watch notebooks, too: hooks in this file see only what is beside it."""
    config.pluginmanager.register(QuietNotebooks())


# --- The browser ------------------------------------------------------------------

PATIENCE = 20_000
"""Milliseconds that a page may take to show what is expected: the machine is shared."""

REQUIRED = os.environ.get("NMSS_REQUIRE_BROWSER", "") == "1"
NO_BROWSER = (
    "no Chromium found: set CHROMIUM, install chromium or google-chrome, "
    "or run `playwright install chromium`"
)


def find_chromium() -> str | None:
    """Return the Chromium to drive, or None.

    In this order: the variable CHROMIUM (which must then name a program), chromium,
    google-chrome, Playwright's own.
    """
    named = os.environ.get("CHROMIUM")
    if named:
        return shutil.which(named)
    return (
        shutil.which("chromium") or shutil.which("google-chrome") or _playwright_own()
    )


def _playwright_own() -> str | None:
    with sync_playwright() as playwright:
        return shutil.which(playwright.chromium.executable_path)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what drives a browser, for ``-m browser`` and ``-m "not browser"``."""
    for item in items:
        if {"browser", "page"} & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.browser)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say loudly that browser tests were left out."""
    skipped = terminalreporter.stats.get("skipped", [])
    count = sum(NO_BROWSER in str(report.longrepr) for report in skipped)
    if count:
        terminalreporter.section("NO BROWSER", sep="!", red=True, bold=True)
        terminalreporter.line(f"{count} browser tests DID NOT RUN: {NO_BROWSER}")


@pytest.fixture(scope="session")
def chromium() -> str:
    """Return the path of Chromium; without one skip, or fail where it is required."""
    path = find_chromium()
    if path is None and REQUIRED:
        pytest.fail(NO_BROWSER)
    if path is None:
        pytest.skip(NO_BROWSER)
    return path


@pytest.fixture(scope="module")
def browser(chromium: str) -> Iterator[Browser]:
    """Yield a running Chromium.

    One per file, not per session: while Playwright runs, its thread holds an event
    loop, which would disturb tests that start one of their own.
    """
    with sync_playwright() as playwright:
        expect.set_options(timeout=PATIENCE)
        # As root, as in a container, Chromium's sandbox cannot start.
        running = playwright.chromium.launch(
            executable_path=chromium, args=["--no-sandbox"]
        )
        yield running
        running.close()


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    """Yield an empty browser page of 1280 x 900 pixels."""
    with browser.new_context(viewport={"width": 1280, "height": 900}) as context:
        yield context.new_page()


# --- The server -------------------------------------------------------------------


class Server:
    """A running ``nmss-lab serve`` on a free port; its address is `url`."""

    def __init__(
        self, log: Path, *options: str, command: tuple[str, ...] = (), **popen: object
    ):
        self.log = log
        launch = command or (sys.executable, "-m", "nmss_lab.cli")
        with log.open("w") as errors:
            self.process = subprocess.Popen(
                [*launch, "serve", "--port", "0", *options],
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                **popen,
            )
        self.url = self._address()

    def faults(self) -> list[str]:
        """Return the log's tracebacks that go through the program's own code.

        Others are the server framework's, such as a page that was closed while an
        answer was on its way.
        """
        parts = re.split(r"(?m)^Traceback ", self.log.read_text())[1:]
        return [part for part in parts if re.search(r"/(apps|nmss_lab)/\w+", part)]

    def _address(self) -> str:
        first = self.process.stdout.readline()
        found = re.search(r"http://127\.0\.0\.1:\d+/\S*", first)
        if not found:
            self.process.kill()
            self.process.communicate()
            raise RuntimeError(f"no address in {first!r}\n{self.log.read_text()}")
        return found[0]

    def stop(self) -> tuple[int, str]:
        """Terminate gracefully; return the exit code and what else was printed."""
        self.process.terminate()
        try:
            rest, _ = self.process.communicate(timeout=20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.communicate()
            raise
        return self.process.returncode, rest


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Yield ``nmss-lab serve`` of this checkout; under xdist one per worker."""
    running = Server(tmp_path_factory.mktemp("server") / "stderr.log")
    yield running
    running.stop()


# --- A live page in the browser ----------------------------------------------------

Open = Callable[..., Page]


@contextmanager
def watched(
    server: Server, browser: Browser, ready: str, first: str = ""
) -> Iterator[Open]:
    """Give a function that opens pages; at the end none may have complained.

    Nor may one have asked another host for anything.

    Parameters
    ----------
    ready : str
        Condition, in JavaScript, under which a page counts as opened.
    first : str
        Path that is opened where none is given.
    """
    said: list[str] = []
    contexts = []

    def asked(request: Any) -> None:
        parts = urlsplit(request.url)
        if parts.scheme not in ("data", "blob") and parts.hostname != "127.0.0.1":
            said.append(request.url)

    def open_page(
        path: str = first,
        width: int = 1440,
        height: int = 900,
        until: str = ready,
        **more: Any,
    ) -> Page:
        context = browser.new_context(
            viewport={"width": width, "height": height}, **more
        )
        contexts.append(context)
        page = context.new_page()
        page.on("request", asked)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on(
            "console",
            lambda m: said.append(m.text) if m.type in ("error", "warning") else None,
        )
        page.goto(server.url + path)
        page.wait_for_function(until, timeout=60_000)
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert said == []


@pytest.fixture
def visit(server: Server, browser: Browser) -> Iterator[Open]:
    """Yield a function that opens a page with a player."""
    with watched(server, browser, "window.nmssPlayer?.frames > 0") as open_page:
        yield open_page


def settled(page: Page) -> None:
    """Wait until the form has no message under way."""
    page.wait_for_function("window.nmssForm.idle()", timeout=60_000)


def slide(page: Page, name: str, end: str) -> None:
    """Put a slider to one of its ends, as a hand would: by input events."""
    page.locator(f"input[name={name}]").evaluate(
        "(input, end) => { input.value = input[end];"
        " input.dispatchEvent(new Event('input', { bubbles: true })) }",
        end,
    )
    settled(page)


def picture(page: Page) -> str:
    """Return the pixels of the first chart."""
    return str(page.locator(".chart").first.screenshot())


ROUND = """() => {
  const find = (view) => view.model?.name === "poles" ? view
    : (view.child_views ?? []).map(find).find(Boolean)
  const roots = Object.values(Bokeh.index.roots ?? Bokeh.index)
  const { frame } = roots.map(find).find(Boolean)
  const across = frame.x_scale.compute(1) - frame.x_scale.compute(0)
  const up = frame.y_scale.compute(0) - frame.y_scale.compute(1)
  return Math.abs(across / up - 1) < 0.02
}"""
"""Whether the unit circle of a figure of poles is round, in JavaScript."""
