"""A visitor without a browser: a page's websocket, driven message by message, for scripts/load.py."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import re
from collections.abc import Callable, Iterator
from time import perf_counter
from typing import Any

from bokeh.protocol import Protocol
from bokeh.protocol.receiver import Receiver
from tornado.httpclient import AsyncHTTPClient, HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

WAIT = 60.0
ROW = re.compile(r'<tr data-observer="([^"]+)" data-target="([^"]+)"><th.*?</th>(.*?)</tr>')
NUMBER = re.compile(r"[\d.]+$")


class Visitor:
    """One session: its models as the server has told of them, and a way to change them."""

    def __init__(self, base: str):
        self.base = base
        self.models: dict[str, dict[str, Any]] = {}
        self.heard = asyncio.Condition()
        self.answered: dict[str, float] = {}
        self.drawn: list[float] = []  # when data for figures came
        self.said: list[str] = []  # what the line on the run has read
        self.closed = False
        self._numbers = itertools.count(1)
        self._socket: WebSocketClientConnection | None = None
        self._listening: asyncio.Task[None] | None = None

    async def open(self, query: str = "") -> Visitor:
        """Load the page, open its websocket, and tell the server that the page is there."""
        answer = await AsyncHTTPClient().fetch(f"http://{self.base}/{query}", request_timeout=WAIT, connect_timeout=WAIT)
        token = re.search(r'"token":"([^"]+)"', answer.body.decode())
        assert token, "a page without a session"
        await self.connect(token.group(1))
        reply = await self.ask("PULL-DOC-REQ", {})
        assert reply in self.answered
        await self.send(
            "PATCH-DOC",
            {
                "events": [
                    {
                        "kind": "MessageSent",
                        "msg_type": "bokeh_event",
                        "msg_data": {"type": "event", "name": "document_ready", "values": {"type": "map", "entries": []}},
                    }
                ]
            },
        )
        return self

    async def connect(self, token: str, origin: str = "") -> None:
        """Open the websocket."""
        request = HTTPRequest(
            f"ws://{self.base}/ws",
            headers={"Origin": origin or f"http://{self.base}"},
            connect_timeout=WAIT,
            request_timeout=WAIT,
        )
        self._socket = await websocket_connect(request, subprotocols=["bokeh", token], max_message_size=10**8)
        self._listening = asyncio.create_task(self._listen(self._socket))
        await self.until(lambda: "ACK" in self.answered)

    async def send(self, kind: str, content: Any) -> str:
        """Send one message; its name."""
        name = str(next(self._numbers))
        for part in ({"msgid": name, "msgtype": kind}, {}, content):
            await self.raw(json.dumps(part))
        return name

    async def raw(self, text: str | bytes) -> None:
        """Send whatever it is."""
        assert self._socket is not None
        await self._socket.write_message(text, binary=isinstance(text, bytes))

    async def ask(self, kind: str, content: Any) -> str:
        """Send a message and wait for the answer."""
        name = await self.send(kind, content)
        await self.until(lambda: name in self.answered)
        return name

    async def set(self, model: str, **values: Any) -> None:
        """Change a model as a click does. What follows from it comes after this has been answered."""
        events = [{"kind": "ModelChanged", "model": {"id": model}, "attr": key, "new": new} for key, new in values.items()]
        await self.ask("PATCH-DOC", {"events": events})

    async def click(self, model: str, value: str, drawings: int) -> tuple[float, float]:
        """Change a switch, and wait until so many sets of data have come: how long the first and all of them took [s]."""
        start, before = perf_counter(), len(self.drawn)
        await self.set(model, value=value)
        await self.until(lambda: len(self.drawn) >= before + drawings)
        return self.drawn[before] - start, self.drawn[before + drawings - 1] - start

    async def message(self, model: str, data: Any) -> None:
        """Send what a component of the page sends."""
        await self.send(
            "PATCH-DOC",
            {
                "events": [
                    {
                        "kind": "MessageSent",
                        "msg_type": "bokeh_event",
                        "msg_data": {
                            "type": "event",
                            "name": "data_event",
                            "values": {"type": "map", "entries": [["model", {"id": model}], ["data", data]]},
                        },
                    }
                ]
            },
        )

    async def until(self, condition: Callable[[], bool], timeout: float = WAIT) -> None:
        """Wait for what the server says. Raises TimeoutError, ConnectionError."""
        async with asyncio.timeout(timeout), self.heard:
            await self.heard.wait_for(lambda: self.closed or condition())
        if not condition():
            raise ConnectionError("closed by the server")

    def close(self) -> None:
        """Drop the connection."""
        if self._listening is not None:
            self._listening.cancel()
        if self._socket is not None:
            self._socket.close()

    # ------------------------------------------------------------------ what the page shows

    def find(self, kind: str, **attributes: Any) -> str:
        """The id of the first model of a kind with these attributes."""
        for name, model in self.models.items():
            if model["kind"].rstrip("0123456789") == kind and all(model.get(k) == v for k, v in attributes.items()):
                return name
        raise LookupError(f"no {kind} with {attributes}")

    @property
    def status(self) -> str:
        """The line on the run."""
        return self.models[self.find("Status")].get("text", "")

    @property
    def query(self) -> str:
        """The settings, as a link has them."""
        return self.models[self.find("Toolbar")].get("query", "")

    @property
    def notes(self) -> list[str]:
        """What was refused, a line each."""
        return self.models[self.find("Toolbar")].get("notes", [])

    @property
    def numbers(self) -> str:
        """The table as it came."""
        return next(text for m in self.models.values() if isinstance(text := m.get("html"), str) and 'class="rms"' in text)

    def table(self) -> dict[tuple[str, str], tuple[str, ...]]:
        """(observer, target) -> error and truth [nm] as the table has them."""
        return {
            (observer, target): tuple(_number(cell) for cell in re.findall(r"<td>(.*?)</td>", cells)[:2])
            for observer, target, cells in ROW.findall(self.numbers)
        }

    # ------------------------------------------------------------------ what the server says

    async def _listen(self, socket: WebSocketClientConnection) -> None:
        receiver = Receiver(Protocol())
        while True:
            fragment = await socket.read_message()
            message = None
            if fragment is not None:
                with contextlib.suppress(asyncio.InvalidStateError):
                    message = await receiver.consume(fragment)
                if message is None:
                    continue
            async with self.heard:
                if message is None:
                    self.closed = True
                else:
                    self._take(message.msgtype, message.header.get("reqid", ""), message.content)
                self.heard.notify_all()
            if self.closed:
                return

    def _take(self, kind: str, request: str, content: Any) -> None:
        now = perf_counter()
        self.answered[request or kind] = now
        for model in _objects(content):
            self.models[model["id"]] = {"kind": model["name"], **model.get("attributes", {})}
        for event in content.get("events", []) if kind == "PATCH-DOC" else []:
            if event["kind"] == "ModelChanged":
                model = self.models.setdefault(event["model"]["id"], {"kind": ""})
                model[event["attr"]] = event["new"]
                if model["kind"].startswith("Status") and event["attr"] == "text":
                    self.said.append(event["new"])
            elif event["kind"] == "ColumnDataChanged":
                self.drawn.append(now)
            elif event["kind"] == "MessageSent" and isinstance(sent := _plain(event["msg_data"].get("values")), dict):
                if isinstance(data := sent.get("data"), dict):  # a component's own message, kept as its attributes
                    self.models.setdefault(sent["model"]["id"], {"kind": ""}).update(data)


def _plain(value: Any) -> Any:
    """Return a mapping as the server has it, from the form in which it is sent."""
    if isinstance(value, dict) and value.get("type") == "map":
        return {key: _plain(it) for key, it in value["entries"]}
    return value


def _objects(value: Any) -> Iterator[dict[str, Any]]:
    if isinstance(value, dict):
        if value.get("type") == "object" and "id" in value:
            yield value
        for item in value.values():
            yield from _objects(item)
    elif isinstance(value, list):
        for item in value:
            yield from _objects(item)


def _number(cell: str) -> str:
    match = NUMBER.search(cell)
    return match.group() if match else ""
