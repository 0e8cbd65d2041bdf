"""Settings of what observers are told: the model of the Kalman filters, and the bands of the vibration."""

from __future__ import annotations

from typing import ClassVar

from wfsobs.settings.group import Group, UsedWhen
from wfsobs.settings.values import Choice, Real, Reals, Whole

PAPER_PEAK_HZ = 47.4969
"""Dominant natural frequency of VLT UT4 (paper, Table 2)."""


class Kalman(Group):
    """The model inside the Kalman filters: AR(2) turbulence plus one vibration peak."""

    used_when: ClassVar[UsedWhen] = {
        "turbulence_rms": ("process_noise", ("manual",)),
        "vibration_rms": ("process_noise", ("manual",)),
        "lgs_noise": ("measurement_noise", ("manual",)),
        "ngs_noise": ("measurement_noise", ("manual",)),
    }

    peak: Choice = Choice(
        ["manual", "matched"],
        "Vibration peak",
        "manual: the frequency and damping below in every mode; matched: those of the strongest line that the scenario's "
        "vibration has in each, the ones below where it has none.",
    )
    frequency: Real = Real(
        PAPER_PEAK_HZ,
        (0.01, 50_000.0),
        "Model frequency f_f",
        "Natural frequency of the modelled vibration [Hz] (paper, Table 2).",
        softbounds=(5.0, 80.0),
        step=0.1,
    )
    damping: Real = Real(
        0.03,
        (0.0, 1.0),
        "Model damping ξ_f",
        "Damping of the modelled vibration (paper, Table 2); the model never goes below 1e-4.",
        softbounds=(0.0, 0.1),
        step=0.001,
    )
    process_noise: Choice = Choice(
        ["matched", "manual"],
        "Process noise Q",
        "matched: Q from the rms of the scenario's turbulence and vibration; manual: from the two numbers below.",
    )
    turbulence_rms: Real = Real(
        0.5,
        (1e-6, 100.0),
        "Model turbulence rms",
        "Standard deviation of the modelled turbulence in tip and tilt [um], for process noise manual; a "
        "higher order has it in the ratio that r0 and L0 give.",
        softbounds=(0.001, 2.0),
    )
    vibration_rms: Real = Real(
        0.015,
        (1e-6, 100.0),
        "Model vibration rms",
        "Standard deviation of the modelled vibration in tip and tilt [um], for process noise manual.",
        softbounds=(0.001, 0.2),
    )
    measurement_noise: Choice = Choice(
        ["matched", "manual"],
        "Measurement noise R",
        "matched: R from the white noise of the scenario's sensors; manual: from the two numbers below.",
    )
    lgs_noise: Real = Real(
        0.0141,
        (1e-6, 100.0),
        "Model LGS noise",
        "Noise of the mean LGS measurement, rms [um], for measurement noise manual.",
        softbounds=(0.001, 0.2),
    )
    ngs_noise: Real = Real(
        0.01,
        (1e-6, 100.0),
        "Model NGS noise",
        "Noise of an NGS frame, rms [um], for measurement noise manual.",
        softbounds=(0.001, 0.2),
    )
    ngs_between_frames: Choice = Choice(
        ["hold", "propagate"],
        "NGS KF between frames",
        "hold: the NGS filter's estimate stays until the next frame (paper); propagate: it follows the fast model.",
    )


class Butterworth(Group):
    """The sum of band-passes that isolates vibration, as reference and as GPR target."""

    frequencies: Reals = Reals(
        [17.1, 24.3, 34.1, 47.7, 54.3, 61.5],
        (0.01, 50_000.0),
        (1, 100),
        "Centre frequencies",
        "Centres of the band-passes [Hz] (paper, Table 4).",
    )
    bandwidth_offline: Real = Real(
        3.0,
        (0.01, 1000.0),
        "Bandwidth, open loop",
        "Width of each band on open-loop data [Hz] (paper, Table 4).",
        softbounds=(0.5, 10.0),
        step=0.1,
    )
    bandwidth_online: Real = Real(
        2.0,
        (0.01, 1000.0),
        "Bandwidth, closed loop",
        "Width of each band on closed-loop data [Hz] (paper, Table 4).",
        softbounds=(0.5, 10.0),
        step=0.1,
    )
    order: Whole = Whole(1, (1, 4), "Filter order", "Order of each band-pass (paper, Table 4).")
