"""The paper's results, as bands on medians over seeds: preset paper, tip.

RMS errors that the paper reports, x 1e-3: Butterworth on open-loop data 7.66, on closed-loop data 13.4, LGS KF 16.6,
offline GPR 12.4, online GPR 13.3, so ratios to the KF of 0.46, 0.81, 0.75 and 0.80. Its spectrum, noise and gain are
not published; the bands are as wide as that leaves them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from wfsobs import PRESETS, Record, observe, simulate
from wfsobs.record import Training

pytestmark = pytest.mark.slow

SEEDS = range(1, 9)
OBSERVERS = ["kf-lgs", "kf-ngs", "multirate", "butterworth-ol", "butterworth-cl", "gpr-offline", "gpr-online", "zero"]


def tip_only(record: Record) -> Record:
    """The record of the first mode alone."""
    names = ("y_lgs", "u", "y_ngs", "turbulence", "vibration", "open_loop_y")
    t = record.training
    assert t is not None and t.open_loop_y is not None
    return replace(
        record,
        **{name: getattr(record, name)[:, :1] for name in names},
        training=Training(t.y_lgs[:, :1], t.u[:, :1], t.open_loop_y[:, :1]),
    )


@pytest.fixture(scope="module", name="errors")
def _errors() -> dict[tuple[str, str], np.ndarray]:
    """RMS error [um] of each (observer, target), one number per seed; 5 s scored of each."""
    found: dict[tuple[str, str], list[float]] = {}
    for seed in SEEDS:
        s = PRESETS["paper"]().replace({"run.seed": seed, "run.duration": 6.0})
        result = observe(tip_only(simulate(s)), s, observers=OBSERVERS)
        assert not result.failures
        for row in result.scores:
            found.setdefault((row.observer, row.target), []).append(row.rms)
    return {key: np.array(values) for key, values in found.items()}


@pytest.mark.parametrize(
    ("observer", "low", "high"),
    [
        ("gpr-offline", 0.60, 0.92),
        ("gpr-online", 0.65, 0.97),
        ("butterworth-ol", 0.35, 0.60),
        ("butterworth-cl", 0.65, 1.0),
    ],
)
def test_vibration_relative_to_the_kalman_filter(
    errors: dict[tuple[str, str], np.ndarray], observer: str, low: float, high: float
) -> None:
    """The paper's own ratios lie in these bands: 0.75, 0.80, 0.46, 0.81."""
    ratio = np.median(errors[observer, "vibration"] / errors["kf-lgs", "vibration"])
    assert low < ratio < high


def test_both_gpr_are_better_than_the_kalman_filter_at_every_seed(errors: dict[tuple[str, str], np.ndarray]) -> None:
    for observer in ("gpr-offline", "gpr-online"):
        assert (errors[observer, "vibration"] < errors["kf-lgs", "vibration"]).all()


def test_the_kalman_filter_of_the_paper_does_no_better_than_zero(errors: dict[tuple[str, str], np.ndarray]) -> None:
    """It reports 16.6e-3 and that the filter overshoots; with the model's vibration fitted to that the error is as large
    within a tenth, and larger than the vibration itself."""
    kalman, vibration = errors["kf-lgs", "vibration"], errors["zero", "vibration"]
    assert np.median(kalman) == pytest.approx(0.0166, rel=0.1)
    assert np.median(kalman / vibration) > 1.0


def test_open_loop_data_beat_closed_loop_data(errors: dict[tuple[str, str], np.ndarray]) -> None:
    """Paper: 7.66 against 13.4. It is the zero phase that does it, not the open loop."""
    assert (errors["butterworth-ol", "vibration"] < errors["butterworth-cl", "vibration"]).all()


def test_turbulence_ngs_before_multirate_before_lgs(errors: dict[tuple[str, str], np.ndarray]) -> None:
    """Paper, section 3, with the cone effect of 49 nm per guide star: at every seed and in the median."""
    ngs, both, lgs = (errors[name, "turbulence"] for name in ("kf-ngs", "multirate", "kf-lgs"))
    assert np.median(ngs) < np.median(both) < np.median(lgs)
    assert (ngs < both).all() and (both < lgs).all()


def test_without_the_slow_error_the_order_turns_round() -> None:
    """The order is that of the sensors' errors, not of the observers: perfect guide stars make the LGS filter best."""
    errors = []
    for seed in SEEDS:
        s = PRESETS["paper"]().replace(
            {
                "run.seed": seed,
                "run.duration": 6.0,
                "sensors.lgs_low_frequency_rms": 0.0,
                "gpr_offline.training_size": 2,
                "gpr_offline.depth": 1,
            }
        )
        scores = observe(simulate(s), s, observers=["kf-lgs", "kf-ngs"]).scores
        errors.append([row.rms for row in scores if row.mode == "tip" and row.target == "turbulence"])
    lgs, ngs = np.median(errors, axis=0)
    assert lgs < ngs


def test_a_matched_kalman_filter_does_better_than_zero() -> None:
    """The same filter with the vibration's own rms in place of the fitted 60 nm."""
    ratios = []
    for seed in SEEDS:
        s = PRESETS["paper"]().replace(
            {
                "run.seed": seed,
                "run.duration": 6.0,
                "kalman.process_noise": "matched",
                "gpr_offline.training_size": 2,
                "gpr_offline.depth": 1,
            }
        )
        scores = observe(simulate(s), s, observers=["kf-lgs"]).scores
        ratios.append(next(r.normalised_rms for r in scores if r.mode == "tip" and r.target == "vibration"))
    assert 0.85 < np.median(ratios) < 1.0
