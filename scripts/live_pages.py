"""Pages of a live loop without a browser: each answers every picture at once, as one does that has painted it."""

from __future__ import annotations

import asyncio
import contextlib
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from multiprocessing import Queue
from time import monotonic

from visitor import Visitor

SHOWN = re.compile(r"real time · ([0-9.]+) s ·")
"""What a page says of the time of the newest frame in its picture, to 0.1 s."""


class LivePage(Visitor):
    """A page that tells when each picture came [s], on the monotonic clock, and the time of the newest frame in it [s]."""

    async def watch(self, tell: Callable[[tuple[float, float]], None]) -> None:
        """Take pictures until the server ends."""
        pulse = next(name for name, model in self.models.items() if model.get("name") == "Pulse" and "class_name" in model)
        number = self.models[pulse]
        painted = number.get("picture", 0)
        await self.message(pulse, {"painted": painted})
        with contextlib.suppress(ConnectionError):
            while True:
                await self.until(lambda last=painted: number.get("picture", 0) > last, timeout=600.0)
                came, painted = monotonic(), number["picture"]
                if (shown := self._shown(number)) is not None:
                    tell((came, shown))
                await self.message(pulse, {"painted": painted})

    def _shown(self, pulse: Mapping) -> float | None:
        """Return where the axis of the traces ends; what the page says of it is to a tenth of a second, and must be the same."""
        steps = next(iter(pulse.get("changes") or [[]]))
        axis = next((values for *_, values in steps if values), None)
        for model in self.models.values() if axis else ():
            if isinstance(text := model.get("html"), str) and (found := SHOWN.search(text)):
                end = dict(axis)["end"]
                assert abs(end - float(found[1])) < 0.051, (end, found[1])
                return end
        return None


async def watch_pages(base: str, n: int, pictures: Queue) -> None:
    """Open pages one after the other and watch them; pictures : receives the number of the page with each of its pictures."""
    watching = []
    for number in range(n):
        page = await LivePage(base).open()
        watching.append(asyncio.create_task(page.watch(lambda picture, number=number: pictures.put((number, picture)))))
    await asyncio.gather(*watching)


def lags_of(told: Sequence[tuple[int, tuple[float, float]]], polls: Sequence[tuple[float, float]], start: float) -> Mapping:
    """Return how far pages are behind the source [s], and how many pictures a second each had.

    told : what `watch_pages` tells.
    polls : when the server answered and the time of the newest frame at most then [s]: the largest difference of the two is the
        clock of the source, so that lags are too large rather than too small.
    start : what came before does not count [s].

    A page is furthest behind just before the next picture comes.
    """
    ahead = max(newest - at for at, newest in polls)
    came, oldest, rates = [], [], []
    for page in sorted({number for number, _ in told}):
        pictures = [picture for number, picture in told if number == page and picture[0] >= start]
        came += [at + ahead - shown for at, shown in pictures]
        oldest += [at + ahead - shown for (_, shown), (at, _) in pairwise(pictures)]
        rates.append((len(pictures) - 1) / (pictures[-1][0] - pictures[0][0]) if len(pictures) > 1 else 0.0)
    return {
        "pictures_per_s": [round(rate, 2) for rate in rates],
        "page_behind_s": _spread(came),
        "page_behind_before_next_s": _spread(oldest),
    }


def _spread(lags: list[float]) -> dict[str, float] | None:
    lags = sorted(lags)
    return {"median": round(lags[len(lags) // 2], 3), "max": round(lags[-1], 3)} if lags else None
