"""Settings of the observers."""

from __future__ import annotations

import param

from wfsobs.scenario.groups.vibration import PAPER_PEAK_HZ
from wfsobs.settings.group import Group
from wfsobs.settings.parameters import Real, Reals, Whole


class Kalman(Group):
    """The model inside the Kalman filters: AR(2) turbulence plus one vibration peak."""

    peak = param.Selector(
        default="manual",
        objects=["manual", "matched"],
        label="Vibration peak",
        doc="manual: the frequency and damping below in every mode; matched: those of the strongest line that the scenario's "
        "vibration has in each, the ones below where it has none.",
    )
    frequency = Real(
        PAPER_PEAK_HZ,
        bounds=(0.01, 50_000.0),
        softbounds=(5.0, 80.0),
        step=0.1,
        label="Model frequency f_f",
        doc="Natural frequency of the modelled vibration [Hz] (paper, Table 2).",
    )
    damping = Real(
        0.03,
        bounds=(0.0, 1.0),
        softbounds=(0.0, 0.1),
        step=0.001,
        label="Model damping ξ_f",
        doc="Damping of the modelled vibration (paper, Table 2); the model never goes below 1e-4.",
    )
    process_noise = param.Selector(
        default="matched",
        objects=["matched", "manual"],
        label="Process noise Q",
        doc="matched: Q from the rms of the scenario's turbulence and vibration; manual: from the two numbers below.",
    )
    turbulence_rms = Real(
        0.5,
        bounds=(1e-6, 100.0),
        softbounds=(0.001, 2.0),
        label="Model turbulence rms",
        doc="Standard deviation of the modelled turbulence in tip and tilt [um], for process noise manual; a "
        "higher order has it in the ratio that r0 and L0 give.",
    )
    vibration_rms = Real(
        0.015,
        bounds=(1e-6, 100.0),
        softbounds=(0.001, 0.2),
        label="Model vibration rms",
        doc="Standard deviation of the modelled vibration in tip and tilt [um], for process noise manual.",
    )
    measurement_noise = param.Selector(
        default="matched",
        objects=["matched", "manual"],
        label="Measurement noise R",
        doc="matched: R from the white noise of the scenario's sensors; manual: from the two numbers below.",
    )
    lgs_noise = Real(
        0.0141,
        bounds=(1e-6, 100.0),
        softbounds=(0.001, 0.2),
        label="Model LGS noise",
        doc="Noise of the mean LGS measurement, rms [um], for measurement noise manual.",
    )
    ngs_noise = Real(
        0.01,
        bounds=(1e-6, 100.0),
        softbounds=(0.001, 0.2),
        label="Model NGS noise",
        doc="Noise of an NGS frame, rms [um], for measurement noise manual.",
    )
    ngs_between_frames = param.Selector(
        default="hold",
        objects=["hold", "propagate"],
        label="NGS KF between frames",
        doc="hold: the NGS filter's estimate stays until the next frame (paper); propagate: it follows the fast model.",
    )


class MultiPeak(Group):
    """The Kalman filter with every peak of the scenario in its model."""

    turbulence_order = Whole(
        2,
        bounds=(2, 3),
        label="Order of the turbulence model",
        doc="2: the AR(2) of the paper; 3: one more pole, fitted to the scenario's true spectrum.",
    )
    line_width = Real(
        0.025,
        bounds=(1e-4, 10.0),
        softbounds=(0.005, 1.0),
        label="Least line width",
        doc="Width at half maximum that lines have at least [Hz]; the filter averages over the inverse of it.",
    )


class Adaptive(Group):
    """The Kalman filter of a model that is identified anew all the time."""

    window = Real(
        4.0,
        bounds=(0.1, 100.0),
        softbounds=(0.5, 10.0),
        step=0.5,
        label="Window",
        doc="How much of z a model is identified from [s]: peaks closer than two over it are one, and for that long a "
        "peak that has moved is not what the filter knows.",
    )
    interval = Real(
        0.5,
        bounds=(0.01, 100.0),
        softbounds=(0.1, 5.0),
        step=0.1,
        label="Interval",
        doc="Time from one identification to the next [s].",
    )
    peak_count = Whole(
        20, bounds=(0, 60), label="Peaks at most", doc="How many vibration peaks the model of one mode has at most."
    )
    lowest = Real(
        5.0,
        bounds=(0.1, 1000.0),
        softbounds=(1.0, 20.0),
        step=0.5,
        label="Peaks from",
        doc="Frequency from which peaks are looked for [Hz]; from 15 over the window at least.",
    )


class MultiRate(Group):
    """Noise weights of the multi-rate Kalman filter."""

    measurement_noise = param.Selector(
        default="matched",
        objects=["matched", "manual"],
        label="Measurement noise R",
        doc="matched: as the Kalman filters; manual: the two numbers below, r_NGS < r_LGS (paper, section 2.2.1).",
    )
    lgs_noise = Real(
        0.05,
        bounds=(1e-6, 100.0),
        softbounds=(0.001, 0.2),
        label="Weight of LGS",
        doc="Square root of r_LGS [um], for measurement noise manual.",
    )
    ngs_noise = Real(
        0.01,
        bounds=(1e-6, 100.0),
        softbounds=(0.001, 0.2),
        label="Weight of NGS",
        doc="Square root of r_NGS [um], for measurement noise manual.",
    )
    model_lgs_error = param.Boolean(
        True,
        label="LGS error in the optimal filter",
        doc="Whether the optimal multi-rate filter knows of the slow LGS error (a state of its own); without it the filter "
        "trusts the LGS far too much.",
    )


class Butterworth(Group):
    """The sum of band-passes that isolates vibration, as reference and as GPR target."""

    frequencies = Reals(
        [17.1, 24.3, 34.1, 47.7, 54.3, 61.5],
        item_bounds=(0.01, 50_000.0),
        bounds=(1, 100),
        label="Centre frequencies",
        doc="Centres of the band-passes [Hz] (paper, Table 4).",
    )
    bandwidth_offline = Real(
        3.0,
        bounds=(0.01, 1000.0),
        softbounds=(0.5, 10.0),
        step=0.1,
        label="Bandwidth, open loop",
        doc="Width of each band on open-loop data [Hz] (paper, Table 4).",
    )
    bandwidth_online = Real(
        2.0,
        bounds=(0.01, 1000.0),
        softbounds=(0.5, 10.0),
        step=0.1,
        label="Bandwidth, closed loop",
        doc="Width of each band on closed-loop data [Hz] (paper, Table 4).",
    )
    order = Whole(1, bounds=(1, 4), label="Filter order", doc="Order of each band-pass (paper, Table 4).")


class _Gpr(Group):
    """What both GPR share; the numbers are those of Table 4."""

    inputs = param.Selector(
        default="u-y",
        objects=["u-y", "z"],
        label="Inputs",
        doc="What a window holds: commands and LGS measurements (paper, eq. 14) or pseudo-open-loop measurements z.",
    )
    inputs_filter = param.Selector(
        default="raw",
        objects=["raw", "high-pass", "standardised"],
        label="Inputs are",
        doc="What is done to the inputs first. raw: nothing (paper); high-pass: turbulence taken out below the corner; "
        "standardised: each channel over its standard deviation in the training record, so that l has no unit.",
    )
    highpass = Real(
        10.0,
        bounds=(0.1, 1000.0),
        softbounds=(1.0, 30.0),
        step=0.5,
        label="High-pass corner",
        doc="Corner of the inputs' high-pass [Hz], a Butterworth of second order; not in the paper.",
    )
    training_size = Whole(1000, bounds=(2, 2048), label="Training size m", doc="Number of training windows (paper, Table 4).")
    depth = Whole(407, bounds=(1, 2000), label="Depth d", doc="Samples in a window (paper, Table 4).")
    signal_std = Real(
        10.0,
        bounds=(1e-3, 1e4),
        softbounds=(0.1, 100.0),
        label="Output scale σ_SE",
        doc="sigma_SE of the squared-exponential kernel [um] (paper, eq. 13 and Table 4).",
    )
    length_scale = Real(
        300.0,
        bounds=(0.1, 1e5),
        softbounds=(1.0, 1000.0),
        label="Length scale l",
        doc="l of the squared-exponential kernel [um] (paper, eq. 13 and Table 4). Far above the windows' norm the "
        "kernel is linear: ridge regression with weight (sigma_n l / sigma_SE)^2.",
    )
    noise_std = Real(
        0.13,
        bounds=(1e-4, 10.0),
        softbounds=(0.01, 1.0),
        label="Noise σ_awgn",
        doc="sigma_awgn on the diagonal of the covariance [um] (paper, Table 4).",
    )


class OfflineGpr(_Gpr):
    """Offline GPR: trained once, on a record of its own."""


class OnlineGpr(_Gpr):
    """Online GPR: trained anew at every step on the last windows."""

    training_size = Whole(511, bounds=(2, 2048), label="Training size m", doc="Number of training windows (paper, Table 4).")
    depth = Whole(170, bounds=(1, 2000), label="Depth d", doc="Samples in a window (paper, Table 4).")
    signal_std = Real(
        30.0,
        bounds=(1e-3, 1e4),
        softbounds=(0.1, 100.0),
        label="Output scale σ_SE",
        doc="sigma_SE of the squared-exponential kernel [um] (paper, eq. 13 and Table 4).",
    )
    noise_std = Real(
        0.1,
        bounds=(1e-4, 10.0),
        softbounds=(0.01, 1.0),
        label="Noise σ_awgn",
        doc="sigma_awgn on the diagonal of the covariance [um] (paper, Table 4).",
    )
