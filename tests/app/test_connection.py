"""What the browser is told of its connection, and what it may send."""

from __future__ import annotations

from typing import Any

from wfsobs.app.dashboard import MOST, Connection


def test_questions_and_changes() -> None:
    taken: list[dict[str, Any]] = []
    one, other = Connection(taken.append), Connection(taken.append)
    assert one.session and one.session != other.session
    one._handle_msg({"ask": 3})
    assert (one.last_arrival, other.last_arrival) == (3, 0)
    change = {"setting": "turbulence.wind_speed", "value": "22"}
    one._handle_msg({"changes": [change, "nonsense", {}]})
    assert taken == [change, {}]
    for nonsense in (None, [], {"ask": "x"}, {"changes": 3}):
        one._handle_msg(nonsense)
    one._handle_msg({"changes": [change] * (MOST + 5)})
    assert one.last_arrival == 3 and len(taken) == 2 + MOST
