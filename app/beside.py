"""A long computation that a session asks for beside its run: progress, cancel, a time that it may take."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable
from functools import partial
from time import monotonic
from typing import Any

import param

from wfsobs.app.run import CANCELLED, DONE, FAILED, IDLE, RUNNING, Run
from wfsobs.app.work import INTERVAL
from wfsobs.watch import Cancelled, Watch

log = logging.getLogger(__name__)

Tell = Callable[[Any], None]
Work = Callable[[Watch, Tell], Any]
"""What is to be done: (watch, told what is known so far) -> result. A ValueError of it is a reason in one line."""


class Beside(param.Parameterized):
    """The state machine of one computation. What it gives lands on the session's thread, unless superseded or cancelled."""

    state = param.Selector(default=IDLE, objects=[IDLE, RUNNING, DONE, CANCELLED, FAILED])
    progress = param.Number(0.0, bounds=(0.0, 1.0), doc="Fraction done.")
    message = param.String("", doc="Why it failed, in one line.")
    latest = param.Parameter(None, doc="What the work has told of itself so far.")
    result = param.Parameter(None, doc="The latest result.")

    def __init__(self, run: Run, most_seconds: float = math.inf):
        """most_seconds : after which the work is told to stop [s]."""
        super().__init__()
        self.run, self.most_seconds = run, most_seconds
        self._cancel = threading.Event()

    def start(self, work: Work) -> None:
        """Do it in a thread of the session, in place of what is being done."""
        self._cancel.set()
        self._cancel = cancel = threading.Event()
        self.param.update(state=RUNNING, progress=0.0, message="", latest=None)
        self.run.aside(partial(self._work, work, cancel))

    def cancel(self) -> None:
        """Stop; the result before stays."""
        if self.state == RUNNING:
            self._cancel.set()
            self.param.update(state=CANCELLED)

    def refuse(self, why: str) -> None:
        """Say in one line why it is not even begun."""
        self._cancel.set()
        self.param.update(state=FAILED, message=why)

    def _work(self, work: Work, cancel: threading.Event) -> None:
        """In a thread of the pool."""
        end, told = monotonic() + self.most_seconds, 0.0

        def land(**news: Any) -> None:
            def there() -> None:
                if not cancel.is_set():
                    self.param.update(**news)
            if not cancel.is_set():
                self.run.post(there)

        def progress(fraction: float) -> None:
            nonlocal told
            if monotonic() - told >= INTERVAL:
                told = monotonic()
                land(progress=min(max(fraction, 0.0), 1.0))

        def over() -> bool:
            return cancel.is_set() or self.run.closed or monotonic() > end

        try:
            result = work(Watch(progress, over), lambda latest: land(latest=latest))
        except Cancelled:
            land(state=FAILED, message=f"It took more than {self.most_seconds:g} s, which is what this server allows")
        except ValueError as error:  # settings or a record that this cannot be done with
            land(state=FAILED, message=str(error))
        except Exception as error:  # a bug, but the session goes on
            log.exception("the computation failed")
            land(state=FAILED, message=f"{type(error).__name__}: {error}")
        else:
            land(state=DONE, progress=1.0, result=result)
