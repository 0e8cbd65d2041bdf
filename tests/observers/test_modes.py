"""Modes side by side: one that fails stops the others, and so does whoever waits for them."""

import threading

import numpy as np
import pytest

from wfsobs.observers.gpr.windows import over_modes
from wfsobs.progress import QUIET, Cancelled, Watch


def test_columns_in_the_order_of_the_modes():
    got = over_modes(3, lambda mode, _watch: np.full(4, float(mode)), QUIET)
    assert np.array_equal(got, np.tile([0.0, 1.0, 2.0], (4, 1)))


def test_a_mode_that_fails_stops_the_others():
    stopped, both = threading.Event(), threading.Barrier(2)

    def work(mode: int, watch: Watch) -> np.ndarray:
        both.wait()
        if mode == 0:
            raise ValueError("no")
        try:
            while True:  # ends only by being told
                watch.check()
        except Cancelled:
            stopped.set()
            raise

    with pytest.raises(ValueError, match="no"):
        over_modes(2, work, QUIET)
    assert stopped.is_set()


def test_a_cancelled_watch_reaches_every_mode():
    def work(_mode: int, watch: Watch) -> np.ndarray:
        watch.check()
        return np.zeros(1)

    with pytest.raises(Cancelled):
        over_modes(2, work, Watch(is_cancelled=lambda: True))
