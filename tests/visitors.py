"""Sessions without a browser: a page is fetched, and its websocket spoken to."""

from __future__ import annotations

import asyncio
import json
import re
import time
import urllib.parse
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

from bokeh.util.token import get_session_id
from tornado.httpclient import AsyncHTTPClient, HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

T = TypeVar("T")

PATIENCE = 60.0
"""Seconds that an answer may take."""

MUCH = 100_000_000
"""Bytes of a message that a visitor takes."""


def http(
    url: str, path: str, headers: dict[str, str] | None = None, **more: Any
) -> HTTPRequest:
    """Return a request for a page of a server."""
    return HTTPRequest(url + path, headers=headers, request_timeout=PATIENCE, **more)


def run(work: Coroutine[Any, Any, T]) -> T:
    """Run in a thread of its own: that of a test may have the browser's event loop."""
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(asyncio.run, work).result()


class Visitor:
    """A page that is open: its document is known, what changes in it is noted."""

    def __init__(self, socket: WebSocketClientConnection, session: str) -> None:
        self.socket, self.session = socket, session
        self.seen: dict[tuple[str, str], Any] = {}
        self.components: dict[str, str] = {}
        self.document: dict[str, Any] = {}
        self.ended = False
        self._changed = asyncio.Event()
        self._listening: asyncio.Task[None] | None = None
        self._numbers = 0

    @classmethod
    async def open(
        cls, url: str, path: str = "", headers: dict[str, str] | None = None
    ) -> Visitor:
        """Open a page as a browser does: by HTTP, then by its websocket.

        Parameters
        ----------
        url : str
            Of the server, with a slash at the end.
        """
        client = AsyncHTTPClient(max_clients=1000)
        page = (await client.fetch(http(url, path, headers))).body.decode()
        found = re.search(r'"token":"([^"]+)"', page)
        assert found, page[:500]
        return await cls.connect(url, path, found[1], headers)

    @classmethod
    async def connect(
        cls, url: str, path: str, token: str, headers: dict[str, str] | None = None
    ) -> Visitor:
        """Connect to the session of a token and take over its document."""
        parts = urllib.parse.urlsplit(url + path)
        query = f"?{parts.query}" if parts.query else ""
        address = f"ws://{parts.netloc}{parts.path.rstrip('/')}/ws{query}"
        socket = await websocket_connect(
            HTTPRequest(address, headers=headers, connect_timeout=PATIENCE),
            subprotocols=["bokeh", token],
            max_message_size=MUCH,
        )
        visitor = cls(socket, get_session_id(token))
        visitor._listening = asyncio.create_task(visitor._listen())
        await visitor._whole()
        return visitor

    async def _send(self, kind: str, content: dict[str, Any]) -> None:
        self._numbers += 1
        header = {"msgid": str(self._numbers), "msgtype": kind}
        for part in (header, {}, content):
            await self.socket.write_message(json.dumps(part))

    async def _listen(self) -> None:
        """Read messages of three parts and pairs of buffers until the end."""
        parts: list[Any] = []
        while (text := await self.socket.read_message()) is not None:
            parts.append(text)
            if len(parts) < 3:
                continue
            header = json.loads(parts[0])
            if len(parts) == 3 + 2 * header.get("num_buffers", 0):
                self._hear(header["msgtype"], json.loads(parts[2]))
                parts = []
        self.ended = True
        self._changed.set()

    def _hear(self, kind: str, content: dict[str, Any]) -> None:
        if kind == "ACK":
            self.seen["", "greeting"] = True
        elif kind == "PULL-DOC-REPLY":
            self.document = content["doc"]
            self._find(self.document["roots"])
            self.seen["", "document"] = True
        elif kind == "PATCH-DOC":
            for event in content["events"]:
                if event["kind"] == "ModelChanged":
                    self._note(event["model"]["id"], event["attr"], event["new"])
                elif event["kind"] == "MessageSent":
                    self.seen["", event["msg_type"]] = event.get("msg_data")
        elif kind == "ERROR":
            raise RuntimeError(content["text"])
        self._changed.set()

    def _note(self, model: str, name: str, value: Any) -> None:
        self.seen[model, name] = _plain(value)

    def _find(self, value: Any) -> None:
        """Find the data of components, and what they hold, in a document."""
        if isinstance(value, dict):
            attributes = value.get("attributes", {})
            data = attributes.get("data") if isinstance(attributes, dict) else None
            if isinstance(data, dict) and "esm" in attributes:
                name = data["name"].rstrip("0123456789")
                self.components[name] = data["id"]
                for key, held in data.get("attributes", {}).items():
                    self._note(data["id"], key, held)
            elif isinstance(attributes, dict) and "css_classes" in attributes:
                for word in attributes["css_classes"]:
                    if str(word).startswith("text-"):
                        self.components[word] = value["id"]
                        self._note(value["id"], "text", attributes.get("text"))
            for part in value.values():
                self._find(part)
        elif isinstance(value, list):
            for part in value:
                self._find(part)

    async def _whole(self) -> None:
        """Take over the document, and say what a browser says when it is drawn."""
        await self.until(lambda: ("", "greeting") in self.seen)
        await self._send("PULL-DOC-REQ", {})
        await self.until(lambda: ("", "document") in self.seen)
        drawn = {"msg_type": "bokeh_event", "msg_data": _ready()}
        await self._send("PATCH-DOC", {"events": [{"kind": "MessageSent", **drawn}]})

    def value(self, component: str, name: str) -> Any:
        """Return a property of a component, as it was last heard of."""
        return self.seen.get((self.components[component], name))

    async def put(self, component: str, name: str, value: Any) -> None:
        """Set a property of a component, as the browser does."""
        model = {"id": self.components[component]}
        change = {"kind": "ModelChanged", "model": model, "attr": name}
        change["new"] = _written(value)
        await self._send("PATCH-DOC", {"events": [change]})

    async def until(self, true: Callable[[], Any]) -> None:
        """Wait until something has been heard."""
        end = time.monotonic() + PATIENCE
        while not true():
            assert not self.ended, "the server has closed the connection"
            self._changed.clear()
            await asyncio.wait_for(self._changed.wait(), end - time.monotonic())

    async def choose(self, **values: Any) -> float:
        """Send the form with some choices changed; return the seconds to its answer."""
        state = self.value("Controls", "state")
        message = state["message"] + 1
        sent = {**state["values"], **values, "message": message}
        began = time.monotonic()
        await self.put("Controls", "sent", sent)
        await self.until(lambda: self.value("Controls", "state")["message"] >= message)
        return time.monotonic() - began

    async def close(self) -> None:
        """Close the page."""
        self.socket.close()
        if self._listening is not None:
            await self._listening


def _ready() -> dict[str, Any]:
    values = {"type": "map", "entries": []}
    return {"type": "event", "name": "document_ready", "values": values}


def _written(value: Any) -> Any:
    """Write a value as the protocol does."""
    if isinstance(value, dict):
        pairs = [[key, _written(part)] for key, part in value.items()]
        return {"type": "map", "entries": pairs}
    if isinstance(value, list):
        return [_written(part) for part in value]
    return value


def _plain(value: Any) -> Any:
    """Read a value that the protocol wrote; numbers in buffers stay as they are."""
    if isinstance(value, dict) and value.get("type") == "map":
        return {_plain(k): _plain(v) for k, v in value.get("entries", [])}
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return value
