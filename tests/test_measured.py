"""The measured spectrum: its lines, its floor, and a vibration that has them."""

from importlib.resources import files

import numpy as np
import pytest

from wfsobs.app.views.plots import marked_peaks
from wfsobs.scenario import Scenario
from wfsobs.scenario.groups.atmosphere import Vibration
from wfsobs.scenario.measured_spectra import ALL, LINES, PARTS, SPECTRA, measured_spectrum
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.disturbance import make_disturbance, vibration_variance

ERIS = measured_spectrum("eris-ut4")
DF = 0.028


def test_the_settings_offer_what_there_is():
    settings = Vibration.settings()
    assert list(settings["spectrum"].objects) == list(SPECTRA)
    assert list(settings["part"].objects) == list(PARTS)


def test_the_licence_lies_beside_the_table():
    folder = files("wfsobs.assets")
    for table in SPECTRA.values():
        assert "MIT License" in folder.joinpath(table.replace(".csv", ".LICENSE.txt")).read_text(encoding="utf-8")
        assert "astro-tiptop==1.6.0; MIT licence" in folder.joinpath(table).read_text(encoding="utf-8")


def test_lines_and_floor_are_those_of_the_source():
    """36.9 and 50.7 nm rms above the floor from 7.5 Hz, worked out on the original file; 97.7 % of the bins on the floor
    of 4e4 / f^2 nm^2/Hz, whose own rms has the closed form 4e4 (1 / f1 - 1 / f2)."""
    f, whole, lines = ERIS.frequency, ERIS.part(ALL) * 1e6, ERIS.part(LINES) * 1e6
    assert f.shape == (3393,) and f[0] == pytest.approx(5.012) and f[-1] == pytest.approx(99.988)
    np.testing.assert_allclose(np.sqrt(lines.sum(axis=0) * DF), [36.9, 50.7], atol=0.05)
    on_floor = np.abs(whole * f[:, None] ** 2 / 4e4 - 1.0) < 1e-3
    np.testing.assert_allclose(on_floor.mean(axis=0), 0.977, atol=0.002)
    rest = np.sqrt(((whole - lines)[f >= 7.5]).sum(axis=0) * DF)
    np.testing.assert_allclose(rest, np.sqrt(4e4 * (1 / 7.5 - 1 / 100)), rtol=0.01)


def test_the_strongest_line_above_12_hz():
    strongest = max((line for line in ERIS.lines() if line.frequency > 12), key=lambda line: max(line.rms))
    assert strongest.frequency == pytest.approx(48.31, abs=0.005)
    assert strongest.rms[1] * 1e3 == pytest.approx(26.5, abs=0.05)
    assert PRESETS["ut4"]().kalman.frequency == pytest.approx(strongest.frequency, abs=0.005)


def test_lines_lose_no_power():
    total = np.sum([np.square(line.rms) for line in ERIS.lines()], axis=0)
    np.testing.assert_allclose(total, ERIS.part(LINES).sum(axis=0) * DF, rtol=1e-12)
    frequencies = [line.frequency for line in ERIS.lines()]
    assert np.diff(frequencies).min() > DF
    strong = ERIS.lines(0.004)
    assert strong == [line for line in ERIS.lines() if max(line.rms) > 0.004] and 20 < len(strong) < len(frequencies)


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("seconds", [1.0, 10.0, 60.0])
def test_the_vibration_has_the_spectrum(part: str, seconds: float):
    """Its variance, and the share of it in each 2 Hz, whatever the record's own grid. A bin of the record that straddles
    a border (1 / seconds wide) may lie on either side, hence bands whose borders lie between lines at 10 s and more."""
    s = Scenario().replace(
        {
            "vibration.source": "measured",
            "vibration.synthesis": "random-phase",
            "vibration.part": part,
            "vibration.cutoff": 100.0,
            "run.duration": seconds,
            "turbulence.source": "none",
        }
    )
    x = make_disturbance(s, s.n_steps, np.random.default_rng(5)).vibration
    power = np.abs(np.fft.rfft(x, axis=0)) ** 2 * 2.0 / len(x) ** 2
    f = np.fft.rfftfreq(len(x), 1e-3)
    for mode in range(2):
        wanted = ERIS.part(part)[:, mode] * DF
        assert x[:, mode].var() == pytest.approx(wanted.sum(), rel=0.005)  # of the two ends of the table half a bin
        assert vibration_variance(s, mode) == pytest.approx(x[:, mode].var(), rel=1e-10)
        if seconds < 10:
            continue
        for low, high in ((7.6, 9.6), (9.6, 12.0), (15.0, 20.0), (23.0, 27.0), (44.0, 47.0), (47.0, 50.0), (72.0, 73.0)):
            band = wanted[(low <= ERIS.frequency) & (high > ERIS.frequency)].sum()
            assert power[(f >= low) & (f < high), mode].sum() == pytest.approx(band, rel=0.02, abs=1e-8)


def test_presets_and_marks():
    assert PRESETS["ut4"]().vibration.part == LINES and PRESETS["ut4-floor"]().vibration.part == ALL
    changed = PRESETS["ut4"]().difference(PRESETS["ut4-floor"]())
    assert changed == {"vibration": {"part": "lines"}}
    marks = marked_peaks(PRESETS["ut4"]())
    assert [m.frequency for m in marks] == [line.frequency for line in ERIS.lines(0.004)]
    assert [m.frequency for m in marked_peaks(PRESETS["ut4"]().replace({"vibration.cutoff": 20.0}))] == [
        m.frequency for m in marks if m.frequency <= 20
    ]
    assert marked_peaks(PRESETS["ut4"]().replace({"vibration.source": "none"})) == []
