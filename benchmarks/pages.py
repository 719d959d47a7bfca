"""Live pages beside an empty Panel page, the floor of their stack, in a real browser.

Run as ``python benchmarks/pages.py``; needs Linux, Chromium and Playwright
(``nmss-lab[test]``), and for sessions without a browser a checkout.  Both servers run
in processes of their own, and all is measured in turns:

- from a slider's input event to the first frame with the new data in all figures;
- milliseconds from frame to frame while a run is played, and what that costs the
  server;
- how many sessions of one process double the 95th percentile of the time to an answer;
- memory of a session, and whether the process grows when sessions come and go.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import itertools
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from frame import Figure, compared, show

try:
    from playwright.sync_api import Browser, Page, sync_playwright
except ImportError:
    sync_playwright = None

HERE = Path(__file__).resolve().parent
PART = "Page"
OURS = "-m", "nmss_lab.cli", "serve", "--port", "0"
BARE = (str(HERE / "bare_page.py"),)

SLID = {
    "receding_horizon": "IFAC'93 of 6.3.3, two loops",
    "governor": "case of 3.4, with and without a governor",
    "state_dependent": "product of 8.5.2, three schemes",
    "disturbances": "house of 7.4.2, with floor plans",
}
"""Pages whose slider is moved and whose runs are played."""

BASELINES = {
    "floor": "Panel page of one slider and one figure, slider heard at once",
    "panel": "the same as Panel has it: a change waits 50 ms for others",
}
SLIDER = "Np"
CROWDED = "receding_horizon"
VALUES = 40
"""Movements of each slider."""

TURNS, LASTING = 3, 5.0
"""Times that each run is played, and their seconds: a server looks after its sessions
every five, so that each time has one look.
"""

SECONDS, MOST = 8.0, 64
"""Seconds of each size of the crowd, and the largest one."""

OPENED, ROUNDS, FORGOTTEN = 20, 3, 30.0
"""Pages open at once, how often, and seconds after which closed ones are forgotten."""

WATCH = """() => {
  const views = []
  const look = (view) => {
    if (view.model?.type === "Figure") views.push(view)
    for (const child of view.child_views ?? []) look(child)
  }
  for (const root of Object.values(Bokeh.index.roots ?? Bokeh.index)) look(root)
  const stale = new Set()
  let begin = 0, heard = 0, done = null, points = 0
  for (const view of views) {
    for (const { data_source } of view.model.renderers) {
      points += Object.values(data_source.data)[0].length
      data_source.change.connect(() => {
        heard ||= performance.now()
        stale.add(view)
      })
    }
    view.repainted.connect(() => {
      stale.delete(view)
      if (!done || !heard || stale.size) return
      const told = done
      done = null
      // painted within a frame: when the next one begins, it is on the screen
      requestAnimationFrame(() => told([heard - begin, performance.now() - begin]))
    })
  }
  window.timed = (act) => new Promise((resolve) => {
    done = resolve
    heard = 0
    begin = performance.now()
    act()
  })
  return [views.length, points]
}"""
"""Have ``timed`` tell when figures heard of new data and when all had painted them;
how many figures and points there are."""

SLIDE = """(input, more) => timed(() => {
  input.value = Number(input.dataset.own ??= input.value) + more
  input.dispatchEvent(new Event("input", { bubbles: true }))
})"""
SET = """(value) => timed(() => {
  const models = [...Bokeh.documents[0]._all_models.values()]
  models.find((model) => model.type === "Slider").value = value
})"""

COUNT = """(seconds) => new Promise((done) => {
  const gaps = [], end = performance.now() + 1000 * seconds
  let last, frames
  const look = (moment) => {
    const now = window.nmssPlayer?.frames ?? moment
    if (now !== frames && last) gaps.push(moment - last)
    if (now !== frames) [last, frames] = [moment, now]
    if (moment < end) requestAnimationFrame(look)
    else done(gaps)
  }
  requestAnimationFrame(look)
})"""
"""Milliseconds between frames that the player drew; without a player, all frames."""


@dataclass(frozen=True)
class Served:
    """A server in a process of its own."""

    url: str
    pid: int

    def processor_time(self) -> float:
        """Milliseconds that all its threads have run."""
        threads = Path(f"/proc/{self.pid}/task").glob("*/schedstat")
        return sum(int(file.read_text().split()[0]) for file in threads) / 1e6

    def memory(self) -> float:
        """Resident memory in MB."""
        pages = Path(f"/proc/{self.pid}/statm").read_text().split()[1]
        return int(pages) * os.sysconf("SC_PAGE_SIZE") / 1e6


@contextlib.contextmanager
def serving(*arguments: str) -> Iterator[Served]:
    """Run a server that prints its address first; stop it at the end."""
    process = subprocess.Popen(
        [sys.executable, *arguments],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )
    try:
        said = process.stdout.readline()
        address = re.search(r"http://127\.0\.0\.1:\d+/", said)
        if not address:
            raise RuntimeError(f"no address of a server in {said!r}")
        yield Served(address[0], process.pid)
    finally:
        process.terminate()
        process.communicate()


def find_chromium(own: str) -> str | None:
    """Return Chromium: that of the variable CHROMIUM, the system's, or Playwright's."""
    named = os.environ.get("CHROMIUM")
    names = [named] if named else ["chromium", "google-chrome", own]
    return next(filter(None, map(shutil.which, names)), None)


# --- In the browser ----------------------------------------------------------------


@contextlib.contextmanager
def opened(browser: Browser, address: str, ready: str) -> Iterator[Page]:
    """Open a page, wait until it rests, and close it at the end."""
    with browser.new_context(viewport={"width": 1440, "height": 900}) as context:
        page = context.new_page()
        page.goto(address)
        page.wait_for_function(ready, timeout=60_000)
        page.wait_for_timeout(1500)
        yield page


def our_page(browser: Browser, server: Served, path: str) -> Any:
    """Open one of our pages."""
    return opened(browser, server.url + path, "window.nmssPlayer?.frames > 0")


def bare_page(browser: Browser, server: Served, path: str) -> Any:
    """Open a bare page."""
    return opened(browser, server.url + path, "window.Bokeh?.documents[0]?.is_idle")


def slide(page: Page, number: int) -> list[float]:
    """Move our slider; milliseconds until the data were there, and painted."""
    slider = page.locator(f"input[name={SLIDER}]")
    times = slider.evaluate(SLIDE, number % 5)
    page.wait_for_function("window.nmssForm.idle()")
    return times


def slide_bare(page: Page, number: int) -> list[float]:
    """Do the same on a bare page."""
    return page.evaluate(SET, 1.0 + number % 19)


def painted(
    browser: Browser, ours: Served, bare: Served, paths: Sequence[str], n: int
) -> Iterator[Figure]:
    """Yield from a slider's input event to the frame that shows the new data."""
    rng = np.random.default_rng(1)
    for path in paths:
        with contextlib.ExitStack() as stack:
            page = stack.enter_context(our_page(browser, ours, path))
            figures, points = page.evaluate(WATCH)
            turns: dict[str, tuple[Page, Any]] = {"ours": (page, slide)}
            for kind in BASELINES:
                address = f"{kind}?points={points}"
                other = stack.enter_context(bare_page(browser, bare, address))
                other.evaluate(WATCH)
                turns[kind] = other, slide_bare
            times: dict[str, list[list[float]]] = {kind: [] for kind in turns}
            for number in range(n + 3):
                for kind, (each, move) in turns.items():
                    each.bring_to_front()
                    # a hand knows nothing of frames
                    each.wait_for_timeout(rng.uniform(50.0, 150.0))
                    times[kind].append(move(each, number))
        heard, seen = np.transpose(times["ours"][3:])
        for kind, baseline in BASELINES.items():
            yield compared(
                PART,
                f"slider to painted figure, {path}",
                f"{SLID[path]}, {figures} figures, {points} points; n={n}",
                seen,
                baseline,
                [late for _, late in times[kind][3:]],
                "ms",
                note=f"its data are there after {np.median(heard):.0f} ms",
            )


def playing(
    browser: Browser, ours: Served, paths: Sequence[str], turns: int
) -> Iterator[Figure]:
    """Yield the time from frame to frame, and the processor time of the server."""
    with contextlib.ExitStack() as stack:
        # all at once: the server tidies up after a page that was closed
        pages = {
            path: stack.enter_context(our_page(browser, ours, path)) for path in paths
        }
        empty = stack.enter_context(opened(browser, "about:blank", "true"))
        for path, page in pages.items():
            gaps, costs = played(page, empty, ours, turns)
            size = f"{SLID[path]}, 10 samples/s; {turns} x {LASTING:g} s"
            rates = [1e3 / float(np.mean(each)) for each in gaps]
            yield compared(
                PART,
                f"from frame to frame while playing, {path}",
                size,
                gaps[0],
                "an empty page",
                gaps[1],
                "ms",
                target="at most 2 x",
                bound=2.0,
                note="{:.0f} frames/s, empty {:.0f}".format(*rates),
            )
            yield compared(
                PART,
                f"processor time of the server while playing, {path}",
                size,
                costs[0],
                "the same page at rest",
                costs[1],
                "ms/s",
            )


def played(page: Page, empty: Page, ours: Served, turns: int) -> Any:
    """Milliseconds from frame to frame, and of the server in a second, at play and not.

    While frames of the empty page are counted, the player rests.
    """
    gaps: tuple[list[float], list[float]] = [], []
    costs: tuple[list[float], list[float]] = [], []
    button = page.locator(".playbar button.main").first
    for _ in range(turns):
        for which, each in enumerate((page, empty)):
            button.click()
            each.bring_to_front()
            each.wait_for_timeout(500)
            began, spent = time.perf_counter(), ours.processor_time()
            gaps[which].extend(each.evaluate(COUNT, LASTING))
            spent = ours.processor_time() - spent
            costs[which].append(spent / (time.perf_counter() - began))
    return gaps, costs


# --- Without a browser ---------------------------------------------------------------


def visitors() -> ModuleType | None:
    """Sessions without a browser, which the tests of a checkout have."""
    file = HERE.parent / "tests" / "visitors.py"
    if not file.exists():
        return None
    found = importlib.util.spec_from_file_location("visitors", file)
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


@dataclass(frozen=True)
class Site:
    """A page that sessions open, and how they change its slider."""

    served: Served
    path: str
    change: Callable[[Any, int], Any]

    async def open(self, module: ModuleType) -> Any:
        """Open a session; its slider has been moved once."""
        visitor = await module.Visitor.open(self.served.url, self.path)
        visitor.socket.protocol.set_nodelay(True)  # as browsers do
        await self.change(visitor, 0)
        return visitor


async def choose(visitor: Any, number: int) -> float:
    """Move our slider; seconds until the answer."""
    values = visitor.value("Controls", "state")["values"]
    return await visitor.choose(**{SLIDER: values[SLIDER] + (-1) ** number})


async def choose_bare(visitor: Any, number: int) -> float:
    """Do the same on a bare page, whose figure's title follows its data."""
    visitor.components["slider"] = of_kind(visitor.document, "Slider")
    title, value = of_kind(visitor.document, "Title"), 0.5 + number % 19
    began = time.monotonic()
    await visitor.put("slider", "value", value)
    await visitor.until(lambda: visitor.seen.get((title, "text")) == str(value))
    return time.monotonic() - began


def of_kind(part: Any, kind: str) -> str | None:
    """Identity of the first model of a kind within a document."""
    if isinstance(part, dict):
        if part.get("name") == kind and "attributes" in part:
            return part["id"]
        part = list(part.values())
    if not isinstance(part, list):
        return None
    return next(filter(None, (of_kind(each, kind) for each in part)), None)


async def crowd(site: Site, guests: list[Any], seconds: float) -> list[float]:
    """Move the slider of every session about once a second; seconds to the answers."""
    times: list[float] = []
    end = time.monotonic() + seconds

    async def use(visitor: Any, seed: int) -> None:
        rng, number = np.random.default_rng(seed), seed
        await asyncio.sleep(rng.uniform(0.0, 1.0))
        while time.monotonic() < end:
            pause = asyncio.sleep(rng.uniform(0.5, 1.5))
            number += 1
            took, _ = await asyncio.gather(site.change(visitor, number), pause)
            times.append(took)

    await asyncio.gather(*(use(visitor, i) for i, visitor in enumerate(guests)))
    return times


@dataclass
class Growth:
    """A crowd that grows: its sessions, and what was measured."""

    site: Site
    guests: list[Any] = field(default_factory=list)
    alone: list[float] = field(default_factory=list)
    sizes: list[tuple[int, float]] = field(default_factory=lambda: [(1, 1.0)])

    @property
    def p95(self) -> float:
        """Milliseconds within which 95 % of the answers to one session come."""
        return 1e3 * float(np.percentile(self.alone, 95))

    @property
    def over(self) -> bool:
        """Whether the p95 has doubled for good: at two sizes, one after the other."""
        return len(self.sizes) > 2 and min(ratio for _, ratio in self.sizes[-2:]) >= 2

    @property
    def doubling(self) -> float:
        """Sessions at which it doubles, between two sizes on a straight line."""
        if not self.over:
            return float(self.sizes[-1][0])
        sizes, ratios = zip(*self.sizes[-3:-1], strict=True)
        return float(np.interp(2.0, ratios, sizes))

    async def grow(self, module: ModuleType, size: int, seconds: float) -> str:
        """Measure a size of the crowd, and one session again just before."""
        while len(self.guests) < size:
            self.guests.append(await self.site.open(module))
        self.alone += await crowd(self.site, self.guests[:1], seconds)
        times = await crowd(self.site, self.guests, seconds)
        p95 = 1e3 * float(np.percentile(times, 95))
        self.sizes.append((size, p95 / self.p95))
        return f"{size} sessions: p95 {p95:.1f} ms, one alone {self.p95:.1f} ms"


async def crowds(
    module: ModuleType, sites: dict[str, Site], most: int, seconds: float, say: Any
) -> dict[str, Growth]:
    """Let crowds grow, in turns, until the p95 has doubled."""
    crowds = {name: Growth(site) for name, site in sites.items()}
    size = 2
    while size <= most and not all(each.over for each in crowds.values()):
        for name, each in crowds.items():
            if not each.over:
                say(f"{name}, {await each.grow(module, size, seconds)}")
        size *= 2
    for visitor in itertools.chain(*(each.guests for each in crowds.values())):
        await visitor.close()
    return crowds


async def remembered(
    module: ModuleType, sites: dict[str, Site], count: int, rounds: int
) -> dict[str, np.ndarray]:
    """MB of each server before, with and after many sessions, a row a round."""
    first = [await site.open(module) for site in sites.values()]  # fills what is shared
    found: dict[str, list[list[float]]] = {name: [] for name in sites}
    for _ in range(rounds):
        guests = []
        for name, site in sites.items():
            before = site.served.memory()
            guests += [await site.open(module) for _ in range(count)]
            found[name].append([before, site.served.memory()])
        for visitor in guests:
            await visitor.close()
        await asyncio.sleep(FORGOTTEN)
        for name, site in sites.items():
            found[name][-1].append(site.served.memory())
    for visitor in first:
        await visitor.close()
    return {name: np.array(rows) for name, rows in found.items()}


def sites(ours: Served, bare: Served) -> dict[str, Site]:
    """Give the two pages of which many sessions are opened."""
    return {
        "ours": Site(ours, CROWDED, choose),
        "bare": Site(bare, "floor", choose_bare),
    }


def sessions(
    ours: Served, bare: Served, quick: bool, say: Callable[[str], None]
) -> Iterator[Figure]:
    """Yield what many sessions cost a process."""
    module = visitors()
    if module is None:
        say("sessions of one process are skipped: they need the tests of a checkout")
        return
    most, seconds = (2, 2.0) if quick else (MOST, SECONDS)
    found = module.run(crowds(module, sites(ours, bare), most, seconds, say))
    yield doubled(found["ours"], found["bare"])
    count, rounds = (3, 1) if quick else (OPENED, ROUNDS)
    # processes that have served others would only take up again what these left
    with serving(*OURS) as fresh, serving(*BARE) as fresh_bare:
        held = module.run(remembered(module, sites(fresh, fresh_bare), count, rounds))
    # later rounds take up again what the first one left to the process
    more = {name: (rows[0, 1] - rows[0, 0]) / count for name, rows in held.items()}
    yield compared(
        PART,
        "memory of an open session",
        f"{CROWDED}, {count} at once",
        [more["ours"]],
        BASELINES["floor"],
        [more["bare"]],
        "MB",
    )
    before, during, after = held["ours"][-1]
    yield compared(
        PART,
        "memory of the process when sessions have been closed",
        f"{CROWDED}, {count} at once, round {rounds}",
        [after],
        "before they came",
        [before],
        "MB",
        target="at most 1.05 x",
        bound=1.05,
        note=f"{during:.0f} MB while they are open",
    )


def doubled(ours: Growth, bare: Growth) -> Figure:
    """Compare shares of a process, so that less is better: sessions are the inverse."""
    return compared(
        PART,
        "share of a process that one session takes",
        f"{CROWDED}, each session a change a second",
        [100.0 / ours.doubling],
        BASELINES["floor"],
        [100.0 / bare.doubling],
        "%",
        note=f"p95 doubles at {ours.doubling:.0f} sessions, from {ours.p95:.0f} ms "
        f"alone; bare at {bare.doubling:.0f}, from {bare.p95:.0f} ms",
    )


def measure(
    quick: bool = False, say: Callable[[str], None] = print
) -> Iterator[Figure]:
    """Yield the figures of the pages."""
    if sync_playwright is None or not Path("/proc/self/schedstat").exists():
        say("pages are skipped: they need Linux and Playwright (nmss-lab[test])")
        return
    with serving(*OURS) as ours, serving(*BARE) as bare:
        with sync_playwright() as playwright:
            path = find_chromium(playwright.chromium.executable_path)
            if path is None:
                say("pages in a browser are skipped: no Chromium found")
            else:
                browser = playwright.chromium.launch(
                    executable_path=path, args=["--no-sandbox"]
                )
                paths = [CROWDED] if quick else list(SLID)
                yield from playing(browser, ours, paths, 1 if quick else TURNS)
                yield from painted(browser, ours, bare, paths, 3 if quick else VALUES)
                browser.close()
        yield from sessions(ours, bare, quick, say)


if __name__ == "__main__":
    show(measure)
