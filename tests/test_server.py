"""``nmss-lab serve``: pages, resources from installed packages only, a clean stop."""

import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urljoin, urlsplit

import pytest
from conftest import Server
from playwright.sync_api import Page

from apps.lessons import lessons
from apps.pages.live import PAGES

PATHS = ["", *(path for path, _ in PAGES)]
"""All pages; the empty path is the index."""

LOADING = {
    "script": "src",
    "link": "href",
    "img": "src",
    "iframe": "src",
    "source": "src",
    "audio": "src",
    "video": "src",
    "embed": "src",
    "object": "data",
}
"""Attributes whose address a browser fetches without being asked; <a> is not one."""


class Resources(HTMLParser):
    """Collects the addresses which a page loads."""

    def __init__(self, base: str) -> None:
        super().__init__()
        self.base = base
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note the address of an element that loads something."""
        address = dict(attrs).get(LOADING.get(tag, ""))
        if address and not address.startswith("data:"):
            self.found.append(urljoin(self.base, address))


def get(url: str) -> bytes:
    """Return what is at an address; a missing page raises HTTPError."""
    with urllib.request.urlopen(url, timeout=60) as answer:
        content: bytes = answer.read()
        return content


def resources(url: str) -> list[str]:
    """Return the addresses loaded by the page at an address."""
    parser = Resources(url)
    parser.feed(get(url).decode())
    return parser.found


def elsewhere(urls: list[str]) -> list[str]:
    """Return the addresses that are not on this machine."""
    return [
        url
        for url in urls
        if urlsplit(url).scheme not in {"data", "blob"}
        and urlsplit(url).hostname != "127.0.0.1"
    ]


def test_resources_are_recognised() -> None:
    """The check sees a foreign script, style sheet and picture, and no mere link."""
    parser = Resources("http://127.0.0.1:1/page")
    parser.feed(
        '<a href="https://a.org"><script src="https://b.org/x.js"></script>'
        '<link href="//c.org/x.css"><img src="static/x.png">'
    )
    assert elsewhere(parser.found) == ["https://b.org/x.js", "http://c.org/x.css"]
    assert "http://127.0.0.1:1/static/x.png" in parser.found


@pytest.mark.parametrize("path", PATHS)
def test_page_names_only_local_resources(server: Server, path: str) -> None:
    """Scripts, style sheets and pictures of each page come from this server."""
    found = resources(server.url + path)
    assert any(url.endswith(".js") or ".js?" in url for url in found)
    assert elsewhere(found) == []


@pytest.mark.parametrize("path", PATHS)
def test_resources_of_page_exist(server: Server, path: str) -> None:
    """Each script, style sheet and picture a page names is really there."""
    for url in resources(server.url + path):
        assert get(url), url


@pytest.mark.parametrize("path", PATHS)
def test_page_works_without_network(server: Server, page: Page, path: str) -> None:
    """In a browser each page appears, asks nobody else and reports no error."""
    asked: list[str] = []
    complaints: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.on("websocket", lambda socket: asked.append(socket.url))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on(
        "console",
        lambda said: complaints.append(said.text) if said.type == "error" else None,
    )
    page.on(
        "response",
        lambda answer: (
            complaints.append(f"{answer.status} {answer.url}")
            if answer.status >= 400
            else None
        ),
    )
    page.goto(server.url + path)
    page.wait_for_function(
        "window.Bokeh && Bokeh.documents.length && Bokeh.documents[0].is_idle",
        timeout=60_000,
    )
    assert any(url.startswith("ws://127.0.0.1") for url in asked)
    assert elsewhere(asked) == []
    assert complaints == []


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals")
def test_stops_when_told(tmp_path: Path, name: str) -> None:
    """Ctrl-C and termination end the server with code 0 and without a traceback."""
    running = Server(tmp_path / "stderr.log")
    assert get(running.url)
    running.process.send_signal(getattr(signal, name))
    said, _ = running.process.communicate(timeout=20)
    assert running.process.returncode == 0
    assert "stopped" in said
    assert "Traceback" not in running.log.read_text()


def test_occupied_port_is_explained() -> None:
    """A port in use ends the command with code 1 and says which port."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        done = subprocess.run(
            [sys.executable, "-m", "nmss_lab.cli", "serve", "--port", port],
            capture_output=True,
            text=True,
            timeout=60,
        )
    assert done.returncode == 1
    assert f"port {port}" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("path", PATHS[1:])
def test_each_page_leads_to_its_lesson(server: Server, path: str) -> None:
    """The link is there, and answers: with the lesson, or with how to write it."""
    page = get(server.url + path).decode()
    found = lessons(path)
    assert found
    for address, title in found:
        assert f'<a href="{address}">{title}</a>' in page
        answer = get(urljoin(server.url, address)).decode()
        assert title in answer
        assert "make lessons" in answer or "MathJax" in answer or "bokeh" in answer


@pytest.mark.parametrize(
    "address", ["lessons/none.html", "lessons/..%2f..%2fREADME.md", "lessons/%2e%2e/x"]
)
def test_lessons_are_all_that_is_read(server: Server, address: str) -> None:
    """No other file of the checkout can be had by that way."""
    with pytest.raises(urllib.error.HTTPError):
        get(urljoin(server.url, address))
