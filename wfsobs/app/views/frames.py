"""Predictions for a page, one after the other: the newest wish of every figure, and what came before it is dropped."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from wfsobs.app.jobs.job import CANCELLED, CLICK, DONE, FAILED, Job
from wfsobs.app.service import Session
from wfsobs.evaluation.theory import Prediction, Theory
from wfsobs.progress import Watch
from wfsobs.scenario import Scenario


@dataclass(frozen=True)
class Wish:
    """What a figure wants predicted: of these settings, with the errors of these observers or their estimates."""

    scenario: Scenario
    target: str
    mode: int
    observers: tuple[str, ...]
    of_error: bool
    number: int = 0


Land = Callable[[Wish, list[Prediction], str], None]
"""Told a wish, what theory says, and why it says nothing."""


class Frames:
    """The predictions of one session."""

    def __init__(self, session: Session):
        self.session = session
        self._theory = Theory()
        self._next: dict[str, tuple[Wish, Land]] = {}
        self._busy = False

    def ask(self, wish: Wish, land: Land) -> None:
        """Have something predicted, in place of what the same figure still waits for."""
        self._next[wish.target] = wish, land
        self._go()

    def _go(self) -> None:
        if self._busy or not self._next:
            return
        self._busy = True
        wish, land = self._next.pop(next(iter(self._next)))
        self.session.submit(
            Job("prediction", partial(self._work, wish), priority=CLICK, quiet=True), partial(self._hear, wish, land)
        )

    def _work(self, wish: Wish, _watch: Watch, _tell: Any) -> list[Prediction]:
        return self._theory.predict(wish.scenario, wish.mode, wish.target, wish.observers, wish.of_error)

    def _hear(self, wish: Wish, land: Land, news: Mapping[str, Any]) -> None:
        """In any thread."""
        if news.get("state") in (DONE, FAILED, CANCELLED):
            self.session.post(partial(self._land, wish, land, news))

    def _land(self, wish: Wish, land: Land, news: Mapping[str, Any]) -> None:
        self._busy = False
        land(wish, news.get("result") or [], news.get("message", ""))
        self._go()
