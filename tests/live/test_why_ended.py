"""Why a loop has ended, and what is said of one without a page."""

from collections import deque
from types import SimpleNamespace
from typing import Any

import pytest

from wfsobs.live.follow import _drain
from wfsobs.live.loop import LiveLoop
from wfsobs.live.source import FAILURE, LiveEvent
from wfsobs.settings.group import SettingError


@pytest.mark.parametrize(
    ("events", "reason"),
    [
        (
            [
                LiveEvent(0, "kf-ngs: needs NGS frames", kind=FAILURE),
                LiveEvent(0, "no frame for 0.1 s", origin="/dev/shm/a.im.shm"),
            ],
            "kf-ngs: needs NGS frames",
        ),
        ([LiveEvent(0, "recording on"), LiveEvent(0, "the record has ended")], "the record has ended"),
        ([], "the processes of the loop have ended"),
    ],
)
def test_the_reason_is_that_of_an_observer_whatever_a_source_says_afterwards(events, reason):
    loop: Any = SimpleNamespace(events=deque(events))
    loop._processes = SimpleNamespace(failure=str, observers_are_alive=False)
    loop.tend = lambda: None
    assert LiveLoop.failure(loop) == reason


def test_what_happens_is_said_once_each_also_what_comes_last():
    said: list[str] = []
    events = deque([LiveEvent(0, "no frame for 0.1 s"), LiveEvent(7, "frames again")])
    loop: Any = SimpleNamespace(events=events, failure=lambda: "it was killed", count=0)
    with pytest.raises(SettingError, match=r"^it was killed$"):
        _drain(loop, 10, None, lambda _: None, said.append)
    assert said == ["no frame for 0.1 s", "frames again"] and not events
