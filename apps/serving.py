"""The server of the pages: who may come in, how long a page is kept, what is logged."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import gc
import hmac
import logging
import secrets
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any
from urllib.parse import urlsplit

import panel as pn
from bokeh.protocol.exceptions import ProtocolError
from bokeh.server.urls import per_app_patterns
from bokeh.settings import settings
from bokeh.util.logconfig import basicConfig
from panel.auth import BasicAuthProvider, BasicLoginHandler, _validate_next_url
from panel.io.server import DIST_DIR, Server, WSHandler, get_server
from panel.io.state import state
from tornado.ioloop import PeriodicCallback
from tornado.web import RedirectHandler, RequestHandler, StaticFileHandler
from tornado.websocket import WebSocketClosedError

from apps import work
from apps.dashboard import pages
from apps.identification import LARGEST
from apps.kept import KEPT
from apps.lessons import ROUTE
from apps.pages.live import page_template, text_style
from nmss_lab import __version__

LOG = logging.getLogger(__name__)
HERE = Path(__file__).resolve().parent

SORRY = """
<h1>This page met a fault in the program</h1>
<p>It has been logged. The choices in its address may be the reason: choose the page
anew above, or begin at <a href="./">the list of examples</a>.</p>
"""

KEPT_FOR = 15
"""Seconds that a page without a connection is kept: one that is loading, or closed."""

LOOKED_AFTER = 5
"""Seconds between two looks for such pages."""

TO_CONNECT = 300
"""Seconds that a browser may take from fetching a page to connecting to it."""

LARGEST_MESSAGE = LARGEST * 4 // 3 + 200_000
"""Bytes of a message from the browser: a file in base64, and what is around it."""

SLOWLY = 1.0
"""Seconds until somebody whose password was wrong may try again."""

ICON = StaticFileHandler, {"path": str(DIST_DIR / "images")}

ANYWHERE = "0.0.0.0", "::", ""
"""Addresses that stand for all of this machine."""


def server(
    *,
    port: int,
    address: str,
    origins: list[str] | None,
    prefix: str,
    users: dict[str, str] | None,
    processes: int,
    shared: Any,
) -> Server:
    """Make the server of all pages; with several processes, that of each of them.

    Parameters
    ----------
    origins : list of str, optional
        Hosts whose pages may connect; by default this machine's own, by the address
        listened on, or by any name where that is all addresses.
    prefix : str
        Path below which all is served, such as "/lab".
    users : mapping of str to str, optional
        Passwords by names; without it everybody may come in.
    shared : object with a folder, optional
        What the processes share.
    """
    _log_briefly()
    if shared is not None:
        KEPT.share(Path(shared.folder))
        work.share(processes)
    own = address in ANYWHERE and not origins
    per_app_patterns[0] = (per_app_patterns[0][0], OwnPages if own else Prompt)
    secret = settings.secret_key_bytes() or secrets.token_urlsafe(32).encode()
    login: dict[str, Any] = {}
    if users:
        login = {"auth_provider": Entrance(users), "cookie_secret": secret.decode()}
    made = get_server(
        {path: _telling(path, build) for path, build in pages().items()},
        port=port,
        address=address,
        websocket_origin=origins,
        title="NMSS Lab",
        prefix=prefix,
        root_path=f"{prefix}/",
        num_procs=processes,
        extra_patterns=[("/health", Health), (r"/(favicon\.ico)", *ICON), ROUTE],
        # nobody can enter the session of another, or lead one into his own
        sign_sessions=True,
        secret_key=secret,
        session_token_expiration=TO_CONNECT,
        unused_session_lifetime_milliseconds=1000 * KEPT_FOR,
        check_unused_sessions_milliseconds=1000 * LOOKED_AFTER,
        websocket_max_message_size=LARGEST_MESSAGE,
        **login,
    )
    if prefix:  # links are relative to the folder; a watch need not know of it
        folder = {"url": f"{prefix}/", "permanent": False}
        also = [(prefix, RedirectHandler, folder), ("/health", Health)]
        made._tornado.add_handlers(".*", also)
    PeriodicCallback(Tidy(made), 1000 * LOOKED_AFTER).start()
    return made


class Tidy:
    """Gives memory back once half of the pages that were open have been closed.

    Pages are full of circles that Python clears away late, and what it has cleared
    away the C library keeps: a class that has left would be remembered all night.
    """

    def __init__(self, server: Server) -> None:
        self.server, self.most = server, 0

    def __call__(self) -> None:
        """Look how many pages there are."""
        now = len(self.server.get_sessions())
        self.most = max(self.most, now)
        if self.most and now <= self.most // 2:
            self.most = now
            gc.collect()
            with contextlib.suppress(AttributeError, OSError, TypeError):  # not on GNU
                ctypes.CDLL(None).malloc_trim(0)


def _telling(path: str, build: Callable[[], pn.Template]) -> Callable[[], pn.Template]:
    """Have a page that cannot be built say so, and the log why."""

    def page() -> pn.Template:
        try:
            return build()
        except Exception:
            LOG.exception("page %r", path)
            told = page_template("", "A fault in the program")
            told.add_panel("index", pn.pane.HTML(SORRY, stylesheets=[text_style()]))
            return told

    return page


class Health(RequestHandler):
    """Tells that the server answers; no session begins."""

    def get(self) -> None:
        """Answer with the version, and how many pages this process has open."""
        application: Any = self.application
        sessions = sum(
            len(application.get_sessions(path)) for path in application.app_paths
        )
        self.set_header("Cache-Control", "no-store")
        self.write({"status": "ok", "version": __version__, "sessions": sessions})

    head = get


class SignIn(BasicLoginHandler):
    """Asks for a name and a password, and leads to the page that was wanted."""

    users: Mapping[str, str] = MappingProxyType({})

    def _validate(self, username: str, password: str) -> bool:
        known = self.users.get(username, "")
        right = hmac.compare_digest(known.encode(), password.encode())
        return right and bool(known)

    async def post(self) -> None:
        """Let in, or ask again after a while."""
        name = self.get_argument("username", "")
        if self._validate(name, self.get_argument("password", "", strip=False)):
            self.set_current_user(name)
            wanted = self.get_cookie("next_url") or state.base_url
            self.redirect(_validate_next_url(wanted) or state.base_url)
            return
        LOG.warning("sign-in refused to %.40r from %s", name, self.request.remote_ip)
        await asyncio.sleep(SLOWLY)
        endpoint = self._login_endpoint
        page = self._login_template.render(login_endpoint=endpoint, errormessage="no")
        self.write(page)


class Entrance(BasicAuthProvider):
    """Lets in those whose names and passwords are known."""

    def __init__(self, users: Mapping[str, str]) -> None:
        page = str(HERE / "entrance.html")
        super().__init__(login_template=page, logout_template=page)
        SignIn.users = users

    @property
    def login_handler(self) -> type[RequestHandler]:
        """What asks for name and password."""
        assert super().login_handler is not None  # which it prepares
        return SignIn


class Prompt(WSHandler):
    """Sends what it has at once: an answer is several small messages.

    Otherwise each waits until the one before has been acknowledged (Nagle), some 10 ms.
    """

    def open(self) -> None:
        """Begin to talk with a page, unless it is none of ours or has gone."""
        try:
            super().open()
        except ProtocolError as error:  # the connection is closed by now
            LOG.warning("a page was refused: %s", error)
            return
        with contextlib.suppress(WebSocketClosedError):
            self.set_nodelay(True)


class OwnPages(Prompt):
    """Connects pages of this server, by whichever name it was asked for them."""

    def check_origin(self, origin: str) -> bool:
        """Whether a page that wants to connect came from here."""
        own = urlsplit(origin).netloc.lower() == self.request.host.lower()
        return own or bool(super().check_origin(origin))


def _log_briefly() -> None:
    """Log warnings and errors with their time, but no message of a browser."""
    basicConfig(format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    for handler in logging.getLogger().handlers:
        handler.addFilter(_without_data)


def _without_data(record: logging.LogRecord) -> bool:
    """Leave out what came from or went to a browser, such as a file."""
    if record.name.startswith("bokeh.") and isinstance(record.args, tuple):
        record.args = tuple(map(_short, record.args))
    return True


def _short(value: Any) -> Any:
    text = str(value)
    if isinstance(value, int | float) or len(text) < 200:
        return value
    return f"{type(value).__name__} of {len(text)} characters"
