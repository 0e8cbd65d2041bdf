"""What strangers send, and what the served dashboard must make of it; for scripts/load.py."""

from __future__ import annotations

import asyncio
import gzip
import json
import socket
from collections.abc import Callable
from typing import Any
from urllib.parse import quote

from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from visitor import Visitor

Add = Callable[[str, str, str, bool], None]

QUERIES = {
    "malformed percent-encoding": "?%&%f&%ff%fe=%zz&turbulence.wind_speed=%00%80",
    "numbers that are none": "?turbulence.wind_speed=1e999&run.duration=nan&run.seed=0x10&loop.gain=-inf&sensors.lgs_count=1.5",
    "names that are none": "?__class__.x=1&run=5&run.duration.x=1&vibration.peaks.0.frequency=1&..=1&=1&&a[[[=1",
    "a preset from elsewhere": "?preset=" + quote("../../../../etc/passwd"),
    "nested brackets": "?vibration.peaks=" + "[" * 3000 + "&butterworth.frequencies=" + quote("{" * 900),
    "thousands of peaks": "?vibration.peaks=" + ";".join(["1,0,0"] * 1200),
    "markup": "?" + quote("<script>alert(1)</script>") + "=" + quote("'\"><img src=x onerror=alert(1)>"),
    "more than the limits": "?run.duration=3000&gpr_online.training_size=2048&sensors.lgs_rate=100000",
    "60,000 characters": "?a=" + "%41x" * 15_000,
    "900 fields": "?" + "".join(f"a{i}=1&" for i in range(900)),
    "a session of one's own choosing": "?bokeh-session-id=mine&bokeh-token=mine&turbulence.wind_speed=x",
}
PATHS = (
    "/../../../etc/passwd",
    "/%2e%2e/%2e%2e/%2e%2e/etc/passwd",
    "/static/../../../../../../etc/passwd",
    "/static/%2e%2e/%2e%2e/%2e%2e/%2e%2e/etc/passwd",
    "/static/extensions/panel/..%2f..%2f..%2f..%2fetc%2fpasswd",
    "/component-resources/os/x/..%2f..%2fetc%2fpasswd",
    "/wfsobs/../pyproject.toml",
    "/app",
    "/admin",
    "/autoload.js",
    "/metadata",
    "/ws",
    "/x" * 5000,
)
BOMB = gzip.compress(b"a = 1\n" * 10_000_000)
UPLOADS: dict[str, tuple[object, object]] = {
    "huge": ("big.toml", "# " + "x" * 3_000_000),
    "truncated": ("half.toml", '[turbulence]\nwind_speed = 20\n[sensors]\nlgs_count = "'),
    "the wrong type": ("list.toml", [1, 2]),
    "a table where a number belongs": ("odd.toml", "[run.duration]\nx = 1"),
    "nothing": ("none.toml", None),
    "not text": ("binary.toml", "\x00\x01\ufffd" * 1000),
    "a zip bomb": ("bomb.zip", BOMB.decode("latin-1")),
    "deep nesting": ("deep.toml", "a = " + "[" * 100_000),
    "deep keys": ("keys.toml", ".".join("a" * 20_000) + " = 1"),
    "a hostile name": ("../../../etc/cron.d/" + "<b>\u202e" * 2000, "[run]\nduration = -1"),
    "a path": ("/etc/passwd", 'preset = "/etc/passwd"'),
    "more than the limits": ("long.toml", "[run]\nduration = 3000"),
}
FRAMES: dict[str, list[str | bytes]] = {
    "no JSON": ["hello", "{", "{}"],
    "bytes that are none": [
        '{"msgid": "1", "msgtype": "PATCH-DOC"}',
        "{}",
        '{"events": [{"kind": "ModelChanged", "model": {"id": "p1001"}, "attr": "x", "new": {"type": "bytes"}}]}',
    ],
    "bytes where text belongs": [b"\x00\xff" * 100],
    "a message of no kind": ['{"msgid": "1", "msgtype": "NO-SUCH-KIND"}', "{}", "{}"],
    "a patch of a model that is not there": [
        '{"msgid": "1", "msgtype": "PATCH-DOC"}',
        "{}",
        '{"events": [{"kind": "ModelChanged", "model": {"id": "p999999"}, "attr": "value", "new": 1}]}',
    ],
    "a model that is no model": [
        '{"msgid": "1", "msgtype": "PATCH-DOC"}',
        "{}",
        '{"events": [{"kind": "RootAdded", "model": {"type": "object", "name": "os.system", "id": "x"}}]}',
    ],
    "JSON nested deeply": ['{"msgid": "1", "msgtype": "PATCH-DOC"}', "{}", "[" * 50_000],
    "more than a message may have": ["x" * 8_000_000],
}


async def abuse(base: str, add: Add) -> None:
    """Everything, one after the other; add is told (what, measured, must be, whether it is)."""
    await _queries(base, add)
    await _paths(base, add)
    await _uploads(base, add)
    await _frames(base, add)
    await _origins(base, add)


async def _get(url: str, **more: Any) -> tuple[int, bytes]:
    """Status and body; 599 where there was no answer."""
    try:
        answer = await AsyncHTTPClient().fetch(HTTPRequest(url, request_timeout=30, follow_redirects=False, **more))
    except HTTPClientError as error:
        return error.code, error.response.body if error.response else b""
    return answer.code, answer.body


async def _queries(base: str, add: Add) -> None:
    """A page that works, whatever the address asks for, and says what it did not use."""
    bad = []
    for what, query in QUERIES.items():
        try:
            visitor = await Visitor(base).open(query)
            await visitor.until(lambda visitor=visitor: visitor.status.startswith("Done") or "press Run" in visitor.status)
            if not visitor.notes or any("Traceback" in note for note in visitor.notes):
                bad.append(f"{what}: nothing was said of it")
            visitor.close()
        except Exception as error:  # whatever went wrong
            bad.append(f"{what}: {type(error).__name__}: {error}")
    add("Malformed addresses", f"{len(QUERIES)} opened, {len(bad)} without a page that says so {bad or ''}", "0", not bad)


async def _paths(base: str, add: Add) -> None:
    """Nothing of the machine's files, and a client's fault where it is one."""
    host, port = base.split(":")
    bad = []
    for path in PATHS:
        request = f"GET {path} HTTP/1.1\r\nHost: {base}\r\nConnection: close\r\n\r\n"
        answer = await asyncio.to_thread(_plain, host, int(port), request)
        if not answer.startswith(b"HTTP/1.1 4") or b"root:" in answer:
            bad.append(f"{path[:60]}: {answer[:40]!r}")
    for what, request in {
        "headers of 200 kB": f"GET / HTTP/1.1\r\nHost: {base}\r\nX: {'x' * 200_000}\r\n\r\n",
        "30,000 fields": f"GET /?{'a&' * 30_000} HTTP/1.1\r\nHost: {base}\r\nConnection: close\r\n\r\n",
        "no HTTP": "hello\r\n\r\n",
        "a body on the page": f"POST / HTTP/1.1\r\nHost: {base}\r\nContent-Length: 5\r\n\r\nhello",
        "a body without end": f"POST / HTTP/1.1\r\nHost: {base}\r\nContent-Length: 99999999999\r\n\r\n",
    }.items():
        answer = await asyncio.to_thread(_plain, host, int(port), request)
        if answer and not answer.startswith(b"HTTP/1.1 4"):
            bad.append(f"{what}: {answer[:40]!r}")
    add("Paths and requests that lead nowhere", f"{len(PATHS) + 5} tried, {len(bad)} answered {bad or ''}", "0", not bad)


def _plain(host: str, port: int, request: str) -> bytes:
    """The beginning of what the server answers to the very bytes."""
    with socket.create_connection((host, port), timeout=10) as s:
        try:
            s.sendall(request.encode())
            return s.recv(4000)
        except ConnectionError:
            return b""


async def _uploads(base: str, add: Add) -> None:
    """One line for each, and the settings stand."""
    visitor = await Visitor(base).open()
    await visitor.until(lambda: visitor.status.startswith("Done"))
    toolbar = visitor.find("Toolbar")
    component = next(k for k, m in visitor.models.items() if m.get("class_name") == "Toolbar")
    bad = []
    for what, (name, text) in UPLOADS.items():
        visitor.models[toolbar]["notes"] = []
        await visitor.message(component, {"action": "open", "name": name, "text": text})
        try:
            await visitor.until(lambda: visitor.notes != [], 20)
        except (TimeoutError, ConnectionError) as error:
            bad.append(f"{what}: {type(error).__name__}")
            continue
        if len(visitor.notes) != 1 or "\n" in visitor.notes[0] or len(visitor.notes[0]) > 400 or visitor.query:
            bad.append(f"{what}: {str(visitor.notes)[:100]}")
    for odd in ({"action": ["open"]}, {"action": {}}, [], "open", None, {"action": "open", "name": {}, "text": {}}):
        await visitor.message(component, odd)
    await visitor.message(component, {"action": "open", "name": "good.toml", "text": "[turbulence]\nwind_speed = 21"})
    try:
        await visitor.until(lambda: "wind_speed=21" in visitor.query, 20)
    except (TimeoutError, ConnectionError):
        bad.append("the session did not outlive them")
    visitor.close()
    add("Uploads", f"{len(UPLOADS)} hostile files, {len(bad)} not refused in one line {bad or ''}", "0", not bad)


async def _frames(base: str, add: Add) -> None:
    """Messages that no page sends: at worst the end of that session."""
    bad = []
    for what, frames in FRAMES.items():
        visitor = await Visitor(base).open()
        try:
            for frame in frames:
                await visitor.raw(frame)
            await visitor.ask("SERVER-INFO-REQ", {})
        except Exception:  # the server may close this connection as it likes
            visitor.closed = True
        visitor.close()
        if (await _get(f"http://{base}/liveness"))[0] != 200:
            bad.append(what)
    add("Messages that no page sends", f"{len(FRAMES)} kinds, {len(bad)} harmed the server {bad or ''}", "0", not bad)


async def _origins(base: str, add: Add) -> None:
    """A websocket from a page of elsewhere, and sessions by a name made up."""
    _, body = await _get(f"http://{base}/")
    token = body.decode().partition('"token":"')[2].partition('"')[0]
    got = []
    for origin in ("http://evil.example", "https://localhost.evil.example", "null", f"http://{base}.evil.example"):
        try:
            await Visitor(base).connect(token, origin)
            got.append(200)
        except HTTPClientError as error:
            got.append(error.code)
    visitor = Visitor(base)
    try:
        head, _, _ = token.rpartition(".")
        await visitor.connect(head + ".x")
        forged = "taken"
    except (ConnectionError, TimeoutError, HTTPClientError):
        forged = "refused"
    visitor.close()
    add("Foreign origins, a forged session", f"{got}, {forged}", "403, refused", set(got) == {403} and forged == "refused")


async def crowd(base: str, most: int, add: Add) -> None:
    """More pages than may be open: turned away with 503."""
    codes = [code for code, _ in await asyncio.gather(*(_get(f"http://{base}/?run.seed={i}") for i in range(2 * most)))]
    health = json.loads((await _get(f"http://{base}/liveness"))[1])
    add(
        f"{2 * most} pages at once, {most} allowed",
        f"{codes.count(200)} served, {codes.count(503)} turned away",
        f"{most} served, {most} turned away",
        codes.count(200) == codes.count(503) == most == health["sessions"],
    )
