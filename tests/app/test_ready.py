"""A page that is made before its visitor comes."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from wfsobs.app import serve as ready
from wfsobs.app.jobs import Job
from wfsobs.app.limits import Limits
from wfsobs.app.service import Full, Service, Session


@pytest.fixture
def service() -> Iterator[Service]:
    service = Service(Limits(sessions=2), 1, 1_000_000, lambda *_: pytest.fail("nobody has asked for a run"))
    yield service
    service.close(5.0)


class Held:
    """In the place of the server's session: how often its end is put off."""

    blocked = 0

    def block_expiration(self) -> None:
        self.blocked += 1

    def unblock_expiration(self) -> None:
        self.blocked -= 1


class Context:
    """Makes pages as the server does, and notes whose they are."""

    application = type("A", (), {"process_request": staticmethod(lambda _request: {})})

    def __init__(self) -> None:
        self.made: list[tuple[Any, Held]] = []

    async def create_session_if_needed(self, _name: str, request: Any, _token: str) -> Held:
        assert (request.path, request.arguments) == ("/lab/", {})
        self.made.append((ready.NEXT.get(), Held()))
        return self.made[-1][1]


def run(service: Service, steps: Callable[[Any, Context], Any]) -> None:
    async def inside() -> None:
        context: Any = Context()
        page = ready.NextPage(service, "/lab", b"secret", 60, 0.0)
        page.context = context
        await steps(page, context)

    asyncio.run(inside())


def test_a_page_is_made_once_nobody_wants_anything(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    async def steps(page: Any, context: Context) -> None:
        await page.look()
        assert not context.made, "somebody has just asked for something"
        monkeypatch.setattr(ready, "QUIET", -1.0)
        await page.look()
        await page.look()
        assert len(context.made) == 1 and context.made[0][1].blocked == 1
        assert service.sessions == 0, "nobody has come"
        assert page.take() is context.made[0][1] and service.sessions == 1
        assert page.take() is None, "the next visitor has a page of their own"
        await asyncio.sleep(0.05)
        assert context.made[0][1].blocked == 0, "it ends as all pages do"
        await page.look()
        assert page.take() is context.made[1][1] and service.sessions == 2
        await page.look()
        assert len(context.made) == 2, "there is no room for another"
        context.made[0][0].leave()
        assert service.sessions == 1

    run(service, steps)


def test_an_old_page_is_made_anew(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ready, "QUIET", -1.0)
    monkeypatch.setattr(ready, "FRESH", -1.0)

    async def steps(page: Any, context: Context) -> None:
        await page.look()
        assert page.take() is None
        await page.look()
        await asyncio.sleep(0.05)
        assert [held.blocked for _, held in context.made] == [0, 1]

    run(service, steps)


def test_what_is_not_known_waits_for_the_visitor(service: Service) -> None:
    session, told, ran, done = Session(service), [], [], threading.Event()
    service.cache.put("known", 1)

    def job(key: str) -> Job:
        return Job("run", lambda _watch, _tell: ran.append(key), key=key)

    session.submit(job("known"), lambda news: told.append(news["result"]))
    session.submit(job("taken back"), lambda _news: None)()
    session.submit(job("wanted"), lambda news: done.set() if news.get("state") == "done" else None)
    assert told == [1] and service.queue.length == service.queue.running == 0
    session.enter()
    assert done.wait(20.0)
    assert ran == ["wanted"] and service.sessions == 1
    assert session.number == 1
    session.leave()
    assert service.sessions == 0


def test_no_more_come_than_there_is_room_for(service: Service) -> None:
    late = Session(service)
    for _ in range(2):
        service.enter()
    with pytest.raises(Full):
        late.enter()
    late.leave()
    assert service.sessions == 2, "who has not come does not go"
