"""The waterfall of the live loop: power is kept, columns do not depend on when they are drawn."""

from __future__ import annotations

import numpy as np
import pytest

from wfsobs.app.display import Display
from wfsobs.app.pages.live_figures import COLUMNS, MEASUREMENT, Waterfall
from wfsobs.live.board import LiveView, trace_width
from wfsobs.live.finding import LOWEST, ROWS, second_spectrum
from wfsobs.live.ring import LiveFrame
from wfsobs.signal.spectrum import psd

DT = 1e-3
EDGES = np.geomspace(LOWEST, 500.0, ROWS + 1)


def test_power_is_kept_and_a_line_is_where_it_is() -> None:
    t = np.arange(1000) * DT
    x = 0.02 * np.sqrt(2.0) * np.sin(2 * np.pi * 48.0 * t)
    rows = second_spectrum(x, DT)
    # a Hann window spreads a line over three bins of 1 Hz, all within 40 to 56 Hz
    within = (EDGES[1:] > 40.0) & (EDGES[:-1] < 56.0)
    assert np.sum((rows * np.diff(EDGES))[within]) == pytest.approx(0.02**2, rel=1e-9)
    top = int(np.argmax(rows))
    assert EDGES[top] < 48.5 and EDGES[top + 1] > 47.5
    noise = np.random.default_rng(1).normal(size=1000)
    frequency, density = psd(noise[:, None], DT, resolution=1.0)
    # bands end in the middle between two frequencies: half the first and none of the mean
    rest = density[1, 0] * 0.5 + density[2:-1].sum() + 0.5 * density[-1, 0]
    assert np.sum(second_spectrum(noise, DT) * np.diff(EDGES)) == pytest.approx(rest, rel=1e-9)
    assert frequency[1] == 1.0


def test_what_is_missing_is_bridged_up_to_a_fifth() -> None:
    t = np.arange(1000) * DT
    x = np.sin(2 * np.pi * 3.0 * t)
    holes = x.copy()
    holes[10::10] = np.nan
    # a line of 3 Hz between neighbours of 1 ms: (2 pi 3 / 1000)^2 / 8 of it is lost at most
    assert second_spectrum(holes, DT)[:30] == pytest.approx(second_spectrum(x, DT)[:30], rel=2e-3, abs=1e-9)
    holes[:250] = np.nan
    assert np.isnan(second_spectrum(holes, DT)).all()


def view_of(z: np.ndarray, first: int, stop: int) -> LiveView:
    n = stop - first
    nothing = np.full((n, 2), np.nan)
    return LiveView(first, DT, LiveFrame(np.zeros(n), z[first:stop], *[nothing] * 4), np.full((n, trace_width(2)), np.nan))


def test_columns_do_not_depend_on_when_they_are_drawn() -> None:
    z = np.random.default_rng(3).normal(size=(20_000, 2))
    often, once, display = Waterfall(), Waterfall(), Display()
    for stop in range(2000, 9700, 170):
        often.draw(view_of(z, stop - 2000, stop), MEASUREMENT, "turbulence", display, 1.0)
    once.draw(view_of(z, 0, 9650), MEASUREMENT, "turbulence", display, 1.0)
    np.testing.assert_array_equal(often.columns, once.columns)
    known = ~np.isnan(once.columns).any(axis=0)
    # half seconds from 1 s to 9.5 s, the newest last
    assert known.sum() == 18 and known[-18:].all()
    assert once.columns[:, -1] == pytest.approx(second_spectrum(z[8500:9500, 0], DT), rel=1e-12)
    # a page that slept for 5 s: what it has not seen stays empty, and what it shows is now
    often.draw(view_of(z, 12_600, 14_600), MEASUREMENT, "turbulence", display, 1.0)
    known = ~np.isnan(often.columns).any(axis=0)
    assert known[-2:].all() and not known[-8:-2].any() and known[-10 - 18 : -10].all()
    assert often.figure.x_range.end == pytest.approx(14.5)
    often.draw(view_of(z, 17_600, 19_600), MEASUREMENT, "turbulence", Display(mode="tilt"), 1.0)
    assert (~np.isnan(often.columns).any(axis=0)).sum() == 2 and COLUMNS > 60
