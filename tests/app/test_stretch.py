"""The errors in the stretch of time and the band of frequencies that the figures are zoomed to."""

from __future__ import annotations

import re

import numpy as np
import pytest

from wfsobs.app.dashboard import Dashboard
from wfsobs.app.render import number
from wfsobs.app.work import TRUTH
from wfsobs.evaluation.exact_errors import band_rms, cumulative_rms
from wfsobs.signal.spectrum import psd


def lines(dashboard: Dashboard, target: str = "vibration") -> list[str]:
    text = re.sub(r"<[^>]+>", " ", dashboard.explore.stretches[target].html().replace("</p>", "\n"))
    return [" ".join(line.split()) for line in text.splitlines()]


def test_a_band_holds_the_line_that_lies_in_it() -> None:
    dt, n = 1e-3, 8000
    t = dt * np.arange(n)
    x = 0.3 * np.sqrt(2.0) * np.sin(2.0 * np.pi * 40.0 * t) + 0.1 * np.sqrt(2.0) * np.sin(2.0 * np.pi * 100.0 * t)
    frequency, density = psd(x[:, None], dt)
    # rms 0.3 at 40 Hz, 0.1 at 100 Hz; the window spreads a line over a few bins of 1 / 2 s, well inside the bands
    assert band_rms(frequency, density[:, 0], 30.0, 50.0) == pytest.approx(0.3, rel=0.01)
    assert band_rms(frequency, density[:, 0], 90.0, 110.0) == pytest.approx(0.1, rel=0.01)
    assert band_rms(frequency, density[:, 0], 0.0, 500.0) == pytest.approx(cumulative_rms(frequency, density[:, 0])[0], rel=1e-12)


class TestStretch:
    def test_nothing_where_nothing_is_zoomed(self, shared: Dashboard) -> None:
        assert shared.explore.stretches["vibration"].pane.html == "", "two seconds are the whole record"

    def test_the_rms_over_the_time_in_view(self, shared: Dashboard) -> None:
        shared.explore.traces.x_range.update(start=1.0, end=1.5)
        results = shared.store.run.result
        (line,) = lines(shared)
        assert line.startswith("RMS error, 1.00 – 1.50 s:")
        shown = [
            n for n in ("kf-lgs", "gpr-online", "kf-multi", "kf-adaptive") if n not in shared.display.hidden_lines["vibration"]
        ]
        errors = {n: (results.values(n, "vibration") - results.values(TRUTH, "vibration"))[1000:1501, 0] for n in shown}
        common = np.isfinite(np.column_stack([*errors.values()])).all(axis=1)
        assert common.any() and "kf-lgs" in errors
        for error in errors.values():
            assert f" {number(1e3 * np.sqrt(np.mean(error[common] ** 2)))} nm" in line
        found = [float(text) for text in re.findall(r"([\d.]+) nm", line)]
        assert found == sorted(found), "the best first"

    def test_the_rms_in_the_band_in_view(self, shared: Dashboard) -> None:
        shared.explore.spectra.x_range.update(start=20.0, end=60.0)
        (line,) = lines(shared, "turbulence")
        spectrum = shared.store.run.result.spectra["kf-lgs", "turbulence"]
        inside = (spectrum.frequency >= 20.0) & (spectrum.frequency <= 60.0)
        expected = np.sqrt(np.trapezoid(spectrum.error[inside, 0], spectrum.frequency[inside]))
        assert line.startswith("RMS error, 20 – 60 Hz:")
        value = re.search(r"LGS KF ([\d.]+) nm", line)
        # the trapezoidal rule leaves out half of the first and of the last bin, of 61
        assert value is not None and float(value[1]) == pytest.approx(1e3 * expected, rel=0.05)

    def test_hidden_lines_are_left_out(self, shared: Dashboard) -> None:
        shared.explore.traces.x_range.update(start=1.0, end=1.5)
        shared.explore.strips["vibration"].cards.hidden_lines = ["kf-lgs"]
        assert "LGS KF" not in lines(shared)[0] and "Offline GPR" in lines(shared)[0]


def test_the_spectra_of_the_time_in_view(shared: Dashboard) -> None:
    shared.explore.traces.x_range.update(start=1.0, end=1.6)
    source = shared.explore.spectra.spectra["vibration"].sources["kf-lgs"]
    whole = np.asarray(source.data["y"])
    shared.display.window_spectra = True
    results = shared.store.run.result
    error = (results.values("kf-lgs", "vibration") - results.values(TRUTH, "vibration"))[1000:1601, :1]
    frequency, density = psd(error, 1e-3)
    np.testing.assert_allclose(source.data["x"], frequency[1:], rtol=1e-12)
    np.testing.assert_allclose(source.data["y"], 1e6 * density[1:, 0], rtol=1e-9)
    shared.explore.traces.x_range.update(start=1.2, end=1.6)
    assert len(source.data["x"]) < len(frequency) - 1, "it follows"
    shared.display.window_spectra = False
    np.testing.assert_array_equal(source.data["y"], whole)
