"""Take the pictures of the live pages that the README shows.

Run it from a checkout with the test environment: ``python docs/screenshots.py``.
It serves the pages on a free port and writes one PNG a page beside this file.  Set
the variable CHROMIUM to the browser to use; chromium or google-chrome otherwise.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

HERE = Path(__file__).resolve().parent
VIEWS = {
    "receding_horizon": ("?gain=20", 22, True),
    "governor": ("", 34, False),
    "state_dependent": ("?structures=frozen,iterated", 9, True),
    "disturbances": ("?case=measured_disturbance_7_4_1", 55, False),
}
"""Page: choices in its address, sample shown, whether past plans are drawn."""


def serve() -> tuple[subprocess.Popen[str], str]:
    """Start the server; return its process and address."""
    command = [sys.executable, "-m", "nmss_lab.cli", "serve", "--port", "0"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, cwd=HERE.parent
    )
    assert process.stdout is not None
    found = re.search(r"http://\S+/", process.stdout.readline())
    if not found:
        raise RuntimeError("the server gave no address")
    return process, found[0]


def robustness(page: Page, url: str) -> None:
    """Open the study that the page begins with, and wait for all of it."""
    page.goto(f"{url}robustness")
    page.wait_for_function("window.nmssStudy?.shown() === 300", timeout=60_000)


def tune(page: Page, url: str) -> None:
    """Tune the example that the page begins with."""
    page.goto(f"{url}tune")
    page.get_by_role("button", name="Tune", exact=True).click()
    page.wait_for_function("window.nmssTune?.finished === 1", timeout=120_000)


def workbench(page: Page, url: str) -> None:
    """Go from the record that the page begins with to the report."""
    page.goto(f"{url}workbench")
    page.wait_for_function("window.nmssWorkbench?.states()[1] === 'done'")
    page.get_by_role("button", name="Do all").click()
    page.wait_for_function("nmssWorkbench.states()[6] === 'done'", timeout=120_000)


def floor_plan(page: Page, url: str) -> None:
    """Open the temperature installation while its door is open."""
    page.goto(f"{url}disturbances?case=temperature_7_4_2")
    page.wait_for_function("window.nmssPlayer?.frames > 0")
    page.locator(".floorplan").scroll_into_view_if_needed()


def structures(page: Page, url: str) -> None:
    """Open the sheet that the page begins with."""
    page.goto(f"{url}structures")
    page.wait_for_function("window.nmssSheet?.rows() > 0")


def identify(page: Page, url: str) -> None:
    """Open the record that the page begins with, and wait for its search."""
    page.goto(f"{url}identify")
    page.locator("td").first.wait_for(timeout=60_000)


STUDIES = {
    "robustness": robustness,
    "tune": tune,
    "workbench": workbench,
    "structures": structures,
    "identify": identify,
    "floor_plan": floor_plan,
}
"""Pictures that show finished work, or no player's sample."""


def take(page: Page, url: str, name: str) -> None:
    """Open a page, play it to the chosen sample, and keep the picture."""
    choices, sample, past = VIEWS[name]
    page.goto(f"{url}{name}{choices}")
    page.wait_for_function("window.nmssPlayer?.frames > 0")
    page.get_by_role("slider", name="Sample", exact=True).fill(str(sample))
    if past:
        page.get_by_label("Past plans").check()
    page.mouse.move(0, 0)
    page.evaluate("scrollTo(0, 0)")
    page.wait_for_timeout(1000)
    page.screenshot(path=HERE / f"{name}.png")


def main() -> None:
    """Take all pictures."""
    process, url = serve()
    chromium = os.environ.get("CHROMIUM") or shutil.which("chromium")
    chromium = chromium or shutil.which("google-chrome")
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(
                executable_path=chromium, args=["--no-sandbox"]
            )
            page = browser.new_page(viewport={"width": 1440, "height": 900})
            for name in VIEWS:
                take(page, url, name)
            for name, make in STUDIES.items():
                make(page, url)
                page.wait_for_timeout(1000)
                page.screenshot(path=HERE / f"{name}.png")
            browser.close()
    finally:
        process.terminate()
        process.wait()


if __name__ == "__main__":
    main()
