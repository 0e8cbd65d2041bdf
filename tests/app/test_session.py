"""How other threads reach a session's page."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

from wfsobs.app import serve as session


class Page:
    """A document that notes who asks it for what."""

    def __init__(self) -> None:
        self.session_context = SimpleNamespace(destroyed=False)
        self.callbacks: list[Any] = []
        self.threads: set[int] = set()

    def add_next_tick_callback(self, callback: Any) -> None:
        self.threads.add(threading.get_ident())
        self.callbacks.append(callback)


def test_only_its_own_thread_touches_the_document(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight threads at once: nothing is lost, and the document, not made for several threads, sees one."""
    page, done = Page(), []
    state = SimpleNamespace(curdoc=page, onload=lambda function: function())
    monkeypatch.setattr(session, "pn", SimpleNamespace(state=state, io=session.pn.io))

    async def main() -> None:
        post = session.Poster()

        def many(i: int) -> None:
            for k in range(100):
                post(partial(done.append, (i, k)))

        with ThreadPoolExecutor(8) as pool:
            loop = asyncio.get_running_loop()
            await asyncio.gather(*(loop.run_in_executor(pool, many, i) for i in range(8)))

    asyncio.run(main())
    assert page.threads == {threading.get_ident()}
    for callback in page.callbacks:
        callback()
    assert sorted(done) == [(i, k) for i in range(8) for k in range(100)]


def test_what_is_known_goes_with_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is posted while a page is built runs before anybody is told of it; what comes of that waits until it is drawn."""
    page, done, loaded = Page(), [], []
    state = SimpleNamespace(curdoc=page, onload=loaded.append)
    monkeypatch.setattr(session, "pn", SimpleNamespace(state=state, io=session.pn.io))
    post = session.Poster()
    post(lambda: (done.append("result"), post(partial(done.append, "next"))))
    assert done == []
    post.deliver()
    assert done == ["result"]
    loaded[0]()
    assert done == ["result", "next"] and page.callbacks == []
