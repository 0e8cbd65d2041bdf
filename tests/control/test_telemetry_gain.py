"""The gain from telemetry against loops closed anew with every gain, and against the true spectra."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import wfsobs
from wfsobs.cli.group import main
from wfsobs.closed_loop.design import design
from wfsobs.control.laws import best_gain, gain_from_telemetry, highest_stable_gain
from wfsobs.control.mirror import Mirror
from wfsobs.prior import Spectra
from wfsobs.record import RecordError, delay_signal
from wfsobs.signal.autoregressive import Ar2
from wfsobs.typing import Array

DT = 1e-3
SLOW, LINE = Ar2(2.0 * np.pi * 2.0, 0.8, 0.3, DT), Ar2(2.0 * np.pi * 40.0, 0.02, 0.02, DT)
NOISE = 0.03


def disturbance(rng: np.random.Generator, n: int) -> Array:
    return SLOW.sample(n, rng) + LINE.sample(n, rng)


def close(disturbance: Array, noise: Array, gain: float, mirror: Mirror, leak: float) -> tuple[Array, Array]:
    """Return measurements and commands (n,) of a loop, one frame after the other."""
    taps, n = mirror.taps, disturbance.size
    y, u = np.zeros(n), np.zeros(n)
    for k in range(n):
        seen = sum(tap * u[k - lag] for lag, tap in enumerate(taps) if lag and k >= lag)
        y[k] = (disturbance[k - 1] if k else 0.0) + seen + noise[k]
        u[k] = (leak * u[k - 1] if k else 0.0) - gain * y[k]
    return y, u


@pytest.mark.parametrize(("delay", "leak"), [(1.0, 1.0), (2.0, 0.99), (2.5, 1.0)])
def test_it_is_the_gain_whose_loop_leaves_least(delay: float, leak: float) -> None:
    rng, mirror, n = np.random.default_rng(3), Mirror(delay), 6_000
    phi, noise = disturbance(rng, n), NOISE * rng.standard_normal(n)
    y, u = close(phi, noise, 0.2, mirror, leak)
    z = y - delay_signal(mirror.correction(u), 1)
    found = gain_from_telemetry(z, mirror, leak)
    assert found.limit == highest_stable_gain(mirror, leak)
    tried = found.gain * np.array([0.9, 1.0, 1.1])
    left = [np.square(close(phi, noise, g, mirror, leak)[0][100:]).mean() for g in tried]
    assert left[1] == min(left), "no neighbour leaves less"
    # 100 of 6,000 steps, in which the loops settle, are left out: their mean square is known to a fifth
    assert found.measured_rms == pytest.approx(np.sqrt(left[1]), rel=0.2 / 60.0 / 2.0)


@pytest.mark.slow
@pytest.mark.parametrize(("delay", "gone"), [(2.0, 0.0), (2.0, 0.19), (1.0, 0.1)])
def test_it_is_that_of_the_true_spectra_within_its_deviation(delay: float, gone: float) -> None:
    """Over 60 records: no bias beyond three standard errors, deviations of the right size, and what they hold."""
    mirror, n, grid = Mirror(delay), 10_000, 2**16 + 1
    f = np.linspace(0.0, 0.5 / DT, grid)
    own = (SLOW.psd(f) + LINE.psd(f)) / (2.0 * DT)
    omega = 2.0 * np.pi * f * DT
    best = best_gain(Spectra(own, own + NOISE**2, own + 0.0 * omega), mirror, 1.0)
    found = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        z = disturbance(rng, n) + NOISE * rng.standard_normal(n)
        z[rng.random(n) < gone] = np.nan
        found.append(gain_from_telemetry(z, mirror))
    gains, deviations = np.array([(one.gain, one.deviation) for one in found]).T
    assert abs(gains.mean() - best) < 3.0 * gains.std() / np.sqrt(gains.size)
    # 60 records tell a standard deviation to 9 %, 16 blocks each of its estimates to 18 %
    assert 0.7 < np.sqrt(np.square(deviations).mean()) / gains.std() < 1.4
    # 93 % by Student's t of 15 degrees of freedom: less than 50 of 60 are one in 200
    assert np.sum(np.abs(gains - best) < 1.96 * deviations) >= 50


@pytest.mark.parametrize("gone", [0.01, 0.1, 0.19, "a burst", "the end"])
def test_missing_samples_hardly_matter(gone: float | str) -> None:
    rng = np.random.default_rng(5)
    z = disturbance(rng, 20_000) + NOISE * rng.standard_normal(20_000)
    whole = gain_from_telemetry(z, Mirror())
    spans = {"a burst": slice(9_000, 10_000), "the end": slice(16_500, None)}
    z[rng.random(z.size) < gone if isinstance(gone, float) else spans[gone]] = np.nan
    holey = gain_from_telemetry(z, Mirror())
    assert abs(holey.gain - whole.gain) < 3.0 * whole.deviation
    assert holey.deviation > 0.8 * whole.deviation, "no better known"
    # the mean of 16,500 squares of a slow process is not that of 20,000
    assert holey.measured_rms == pytest.approx(whole.measured_rms, rel=0.05)


@pytest.mark.parametrize(
    ("z", "line"),
    [
        (np.sin(np.arange(999.0)), "999 of 999 samples are measured, a gain needs 1000, and 80 %"),
        (np.where(np.arange(3_000) % 3, np.nan, 1.0), "1000 of 3000 samples are measured, a gain needs 1000, and 80 %"),
        (np.full(2_000, 3.0), "the measurements do not move: every gain is as good as another"),
    ],
)
def test_records_that_have_no_gain(z: Array, line: str) -> None:
    with pytest.raises(RecordError, match=f"^{line}$"):
        gain_from_telemetry(z, Mirror())


@pytest.mark.slow
def test_the_command(tmp_path: Path) -> None:
    scenario = wfsobs.PRESETS["paper"]().replace({"run.duration": 6.0})
    record = wfsobs.simulate(scenario)
    wfsobs.save(tmp_path / "record.npz", record)
    record = wfsobs.load(tmp_path / "record.npz").without_outliers
    rows = json.loads(CliRunner().invoke(main, ["gain", str(tmp_path / "record.npz"), "--json"]).stdout)
    for mode, row in enumerate(rows):
        found = gain_from_telemetry(record.z[record.delay :, mode], Mirror())
        assert (row["gain"], row["deviation"]) == pytest.approx((found.gain, found.deviation), rel=1e-9)
        theory = design(scenario, ["integrator"]).laws["integrator"][mode].law
        assert theory is not None and theory.gain is not None
        # narrow lines and slow winds are not the same in any 6 s: a tenth of the gain, which costs 1 % of the rms
        assert row["gain"] == pytest.approx(theory.gain, rel=0.1)
    shown = CliRunner().invoke(main, ["gain", str(tmp_path / "record.npz")]).stdout
    assert "Gain of the integrator, delay 2 frames" in shown and "tilt" in shown


def test_a_fraction_of_the_delay_in_the_file_counts(tmp_path: Path) -> None:
    rng, mirror, n = np.random.default_rng(8), Mirror(2.5), 6_000
    y, u = (np.column_stack(x) for x in zip(*(close(disturbance(rng, n), NOISE * rng.standard_normal(n), 0.2, mirror, 1.0)
                                              for _ in range(2)), strict=True))  # fmt: skip
    np.savez(tmp_path / "r.npz", y_lgs=y, u=u, dt=DT, delay=2.5)
    rows = json.loads(CliRunner().invoke(main, ["gain", str(tmp_path / "r.npz"), "--unit", "um", "--json"]).stdout)
    assert [row["limit"] for row in rows] == pytest.approx([highest_stable_gain(mirror, 1.0)] * 2, rel=1e-9)
