"""Every setting, declared once: the `Scenario` tree.

Labels carry the name and the paper's letter, documentation strings the unit in [brackets] and the
source. "The paper" is Jaufmann et al., "Simulation of Wavefront-based Disturbance Observers for
Large Telescopes". Wavefronts are Noll-normalised Zernike coefficients in micrometres rms.
"""

from __future__ import annotations

from itertools import pairwise

import param

from wfsobs.modes import TIP_TILT, Mode
from wfsobs.parameters import Real, Reals, Whole
from wfsobs.settings import Group, SettingError, section

PAPER_PEAK_HZ = 47.4969
"""The dominant natural frequency of VLT UT4 (paper, Table 2)."""


class Telescope(Group):
    """The aperture."""

    diameter = Real(8.0, bounds=(0.1, 100.0), label="Aperture diameter D",
                    doc="Diameter of the aperture [m] (paper, Table 1).")


class Turbulence(Group):
    """Atmospheric turbulence."""

    source = param.Selector(default="ar2", objects=["ar2", "none"], label="Source",
                            doc="How turbulence is made: the AR(2) process of the paper, eq. 1, or none.")
    wind_speed = Real(15.0, bounds=(0.1, 100.0), softbounds=(1.0, 40.0), step=0.5, label="Wind speed V₀",
                      doc="Wind speed [m/s]; sets the corner w0 = 0.6 pi (n + 1) V0 / D (paper, eq. 1d and Table 1).")
    damping = Real(0.9, bounds=(0.01, 1.0), step=0.01, label="Damping ξ",
                   doc="Damping factor of the AR(2) process (paper, Table 1).")
    rms = Real(0.5, bounds=(0.0, 100.0), softbounds=(0.0, 2.0), step=0.01, label="Strength, rms",
               doc="Standard deviation of each mode [um]; the paper gives none, r0 = 0.157 m, L0 = 25 m "
                   "on 8 m give 0.529 um.")


class Peak(Group):
    """One line of the vibration spectrum: a damped resonance, or a pure line at damping 0."""

    frequency = Real(PAPER_PEAK_HZ, bounds=(0.01, 5000.0), softbounds=(5.0, 80.0), step=0.1, label="Frequency f",
                     doc="Natural frequency [Hz]. The paper's dominant one is 47.4969 Hz (Table 2).")
    damping = Real(0.03, bounds=(0.0, 1.0), softbounds=(0.0, 0.1), step=0.001, label="Damping ξ",
                   doc="Damping ratio; 0 is a pure line. The paper has 0.03 (Table 2).")
    rms = Reals([0.01, 0.01], item_bounds=(0.0, 100.0), bounds=(1, 64), label="Strength per mode, rms",
                doc="Standard deviation of the line [um], one number per mode: tip, tilt; modes beyond "
                    "the list have none.")


class PsdTable(Group):
    """A one-sided power spectral density given as a table."""

    frequency = Reals([], item_bounds=(0.0, 5000.0), bounds=(0, 100_000), label="Frequencies",
                      doc="Frequencies [Hz], increasing.")
    tip = Reals([], item_bounds=(0.0, 1e6), bounds=(0, 100_000), label="PSD of tip",
                doc="One-sided power spectral density of tip [um^2/Hz], one number per frequency.")
    tilt = Reals([], item_bounds=(0.0, 1e6), bounds=(0, 100_000), label="PSD of tilt",
                 doc="One-sided power spectral density of tilt [um^2/Hz], one number per frequency.")


class Vibration(Group):
    """Structural vibration of the telescope."""

    source = param.Selector(default="peaks", objects=["peaks", "psd", "measured", "ar2", "none"], label="Source",
                            doc="How vibration is made: inverse DFT of the peak list (paper, Algorithm 4), of the PSD table or "
                                "of a measured spectrum, each peak as an AR(2) process (paper, eq. 2), or none.")
    spectrum = param.Selector(default="eris-ut4", objects=["eris-ut4"], label="Measured spectrum",
                              doc="For source measured: eris-ut4, measured at VLT UT4 with ERIS (astro-tiptop/TIPTOP, MIT).")
    part = param.Selector(default="lines", objects=["lines", "all"], label="Part of the spectrum",
                          doc="For source measured: the lines that stand above its synthetic floor 4e4 / f^2 nm^2/Hz, from "
                              "7.5 Hz up, or all of it.")
    cutoff = Real(80.0, bounds=(0.1, 5000.0), softbounds=(10.0, 200.0), label="Cut-off f_c",
                  doc="Nothing above this frequency in an inverse DFT [Hz] (paper, section 2.4).")
    peaks = param.List([Peak()], item_type=Peak, bounds=(0, 100), label="Peaks",
                       doc="The lines of the spectrum.")
    psd = section(PsdTable, "PSD table", "The spectrum as a table, for source psd.")


class Sensors(Group):
    """Wavefront sensors: a natural guide star (NGS) and laser guide stars (LGS)."""

    lgs_rate = Real(1000.0, bounds=(10.0, 100_000.0), label="LGS rate 1/T",
                    doc="Frame rate of the LGS sensors and of the loop [Hz] (paper, Table 3: 1000 Hz).")
    exposure_ratio = Whole(5, bounds=(1, 100), softbounds=(1, 20), label="Exposure ratio n",
                           doc="NGS exposure over LGS exposure, n = T_NGS / T_LGS (paper: 5 ms over 1 ms).")
    lgs_count = Whole(2, bounds=(1, 16), label="Number of LGS", doc="Laser guide stars; their plain mean is used (paper).")
    lgs_noise = Real(0.02, bounds=(0.0, 10.0), softbounds=(0.0, 0.2), step=0.001, label="LGS noise",
                     doc="White measurement noise of each LGS and mode, rms [um]; not given in the paper.")
    ngs_noise = Real(0.01, bounds=(0.0, 10.0), softbounds=(0.0, 0.2), step=0.001, label="NGS noise",
                     doc="White measurement noise of an NGS frame and mode, rms [um]; not given in the paper.")
    lgs_low_frequency_rms = Real(
        0.049, bounds=(0.0, 10.0), softbounds=(0.0, 0.2), step=0.005, label="LGS low-frequency error",
        doc="Slow tip-tilt error of each LGS, rms [um], independent between LGS: the stand-in for cone effect and "
            "uplink turbulence. 0.049 um is the cone effect of one layer at 8 km and a guide star at 90 km.")
    tip_tilt_indetermination = param.Boolean(
        False, label="Tip-tilt indetermination",
        doc="An LGS that cannot see turbulent tip-tilt at all, as in reality; off in the paper, whose "
            "simulator does not model it.")


class Loop(Group):
    """The control loop that makes the record."""

    closed = param.Boolean(True, label="Closed loop", doc="Drive the deformable mirror; off keeps u = 0.")
    gain = Real(0.3, bounds=(0.0, 1.0), inclusive_bounds=(True, False), step=0.01, label="Integrator gain g",
                doc="u[k] = leak u[k-1] - g y_lgs[k]; not given in the paper. Stable below 1.")
    leak = Real(1.0, bounds=(0.0, 1.0), step=0.001, label="Integrator leak", doc="1 is a pure integrator.")


class Kalman(Group):
    """The model inside the Kalman filters: AR(2) turbulence plus one vibration peak."""

    frequency = Real(PAPER_PEAK_HZ, bounds=(0.01, 5000.0), softbounds=(5.0, 80.0), step=0.1, label="Model frequency f_f",
                     doc="Natural frequency of the modelled vibration [Hz] (paper, Table 2).")
    damping = Real(0.03, bounds=(0.0, 1.0), softbounds=(0.0, 0.1), step=0.001, label="Model damping ξ_f",
                   doc="Damping of the modelled vibration (paper, Table 2); the model never goes below 1e-4.")
    process_noise = param.Selector(
        default="matched", objects=["matched", "manual"], label="Process noise Q",
        doc="matched: Q from the rms of the scenario's turbulence and vibration; manual: from the two numbers below.")
    turbulence_rms = Real(0.5, bounds=(1e-6, 100.0), softbounds=(0.001, 2.0), label="Model turbulence rms",
                          doc="Standard deviation of the modelled turbulence [um], for process noise manual.")
    vibration_rms = Real(0.015, bounds=(1e-6, 100.0), softbounds=(0.001, 0.2), label="Model vibration rms",
                         doc="Standard deviation of the modelled vibration [um], for process noise manual.")
    measurement_noise = param.Selector(
        default="matched", objects=["matched", "manual"], label="Measurement noise R",
        doc="matched: R from the white noise of the scenario's sensors; manual: from the two numbers below.")
    lgs_noise = Real(0.0141, bounds=(1e-6, 100.0), softbounds=(0.001, 0.2), label="Model LGS noise",
                     doc="Noise of the mean LGS measurement, rms [um], for measurement noise manual.")
    ngs_noise = Real(0.01, bounds=(1e-6, 100.0), softbounds=(0.001, 0.2), label="Model NGS noise",
                     doc="Noise of an NGS frame, rms [um], for measurement noise manual.")
    ngs_between_frames = param.Selector(
        default="hold", objects=["hold", "propagate"], label="NGS KF between frames",
        doc="hold: the NGS filter's estimate stays until the next frame (paper); propagate: it follows the fast model.")


class MultiRate(Group):
    """Noise weights of the multi-rate Kalman filter."""

    measurement_noise = param.Selector(
        default="matched", objects=["matched", "manual"], label="Measurement noise R",
        doc="matched: as the Kalman filters; manual: the two numbers below, r_NGS < r_LGS (paper, section 2.2.1).")
    lgs_noise = Real(0.05, bounds=(1e-6, 100.0), softbounds=(0.001, 0.2), label="Weight of LGS",
                     doc="Square root of r_LGS [um], for measurement noise manual.")
    ngs_noise = Real(0.01, bounds=(1e-6, 100.0), softbounds=(0.001, 0.2), label="Weight of NGS",
                     doc="Square root of r_NGS [um], for measurement noise manual.")
    model_lgs_error = param.Boolean(
        True, label="LGS error in the optimal filter",
        doc="Whether the optimal multi-rate filter knows of the slow LGS error (a state of its own); without it the filter "
            "trusts the LGS far too much.")


class Butterworth(Group):
    """The sum of band-passes that isolates vibration, as reference and as GPR target."""

    frequencies = Reals([17.1, 24.3, 34.1, 47.7, 54.3, 61.5], item_bounds=(0.01, 5000.0), bounds=(1, 100),
                        label="Centre frequencies", doc="Centres of the band-passes [Hz] (paper, Table 4).")
    bandwidth_offline = Real(3.0, bounds=(0.01, 1000.0), softbounds=(0.5, 10.0), step=0.1, label="Bandwidth, open loop",
                             doc="Width of each band on open-loop data [Hz] (paper, Table 4).")
    bandwidth_online = Real(2.0, bounds=(0.01, 1000.0), softbounds=(0.5, 10.0), step=0.1, label="Bandwidth, closed loop",
                            doc="Width of each band on closed-loop data [Hz] (paper, Table 4).")
    order = Whole(1, bounds=(1, 4), label="Filter order", doc="Order of each band-pass (paper, Table 4).")


class _Gpr(Group):
    """What both GPR share; the numbers are those of Table 4."""

    inputs = param.Selector(
        default="u-y", objects=["u-y", "z"], label="Inputs",
        doc="What a window holds: commands and LGS measurements (paper, eq. 14) or pseudo-open-loop measurements z.")
    training_size = Whole(1000, bounds=(2, 2048), label="Training size m", doc="Number of training windows (paper, Table 4).")
    depth = Whole(407, bounds=(1, 2000), label="Depth d", doc="Samples in a window (paper, Table 4).")
    signal_std = Real(10.0, bounds=(1e-3, 1e4), softbounds=(0.1, 100.0), label="Output scale σ_SE",
                      doc="sigma_SE of the squared-exponential kernel [um] (paper, eq. 13 and Table 4).")
    length_scale = Real(
        300.0, bounds=(0.1, 1e5), softbounds=(1.0, 1000.0), label="Length scale l",
        doc="l of the squared-exponential kernel [um] (paper, eq. 13 and Table 4). Far above the windows' norm the "
            "kernel is linear: ridge regression with weight (sigma_n l / sigma_SE)^2.")
    noise_std = Real(0.13, bounds=(1e-4, 10.0), softbounds=(0.01, 1.0), label="Noise σ_awgn",
                     doc="sigma_awgn on the diagonal of the covariance [um] (paper, Table 4).")


class OfflineGpr(_Gpr):
    """Offline GPR: trained once, on a record of its own."""


class OnlineGpr(_Gpr):
    """Online GPR: trained anew at every step on the last windows."""

    training_size = Whole(511, bounds=(2, 2048), label="Training size m", doc="Number of training windows (paper, Table 4).")
    depth = Whole(170, bounds=(1, 2000), label="Depth d", doc="Samples in a window (paper, Table 4).")
    signal_std = Real(30.0, bounds=(1e-3, 1e4), softbounds=(0.1, 100.0), label="Output scale σ_SE",
                      doc="sigma_SE of the squared-exponential kernel [um] (paper, eq. 13 and Table 4).")
    noise_std = Real(0.1, bounds=(1e-4, 10.0), softbounds=(0.01, 1.0), label="Noise σ_awgn",
                     doc="sigma_awgn on the diagonal of the covariance [um] (paper, Table 4).")


class Run(Group):
    """Length of the record, what is scored, and the seed."""

    duration = Real(10.0, bounds=(0.1, 3600.0), softbounds=(2.0, 60.0), label="Duration",
                    doc="Length of the record [s].")
    warm_up = Real(1.0, bounds=(0.0, 600.0), softbounds=(0.0, 5.0), label="Warm-up",
                   doc="Start of the record that no score counts [s].")
    seed = Whole(1, bounds=(0, 2**32 - 1), softbounds=(0, 1000), label="Seed",
                 doc="Seed of every random number of the run.")


class Scenario(Group):
    """Every setting of a run.

    >>> s = Scenario()
    >>> s.set("turbulence.wind_speed", 200)
    Traceback (most recent call last):
    ...
    wfsobs.settings.SettingError: turbulence.wind_speed = 200: takes a number from 0.1 to 100 m/s
    """

    telescope = section(Telescope, "Telescope")
    turbulence = section(Turbulence, "Turbulence")
    vibration = section(Vibration, "Vibration")
    sensors = section(Sensors, "Sensors")
    loop = section(Loop, "Loop")
    kalman = section(Kalman, "Kalman filters")
    multirate = section(MultiRate, "Multi-rate filter")
    butterworth = section(Butterworth, "Butterworth reference")
    gpr_offline = section(OfflineGpr, "Offline GPR")
    gpr_online = section(OnlineGpr, "Online GPR")
    run = section(Run, "Run")

    @property
    def modes(self) -> tuple[Mode, ...]:
        """The Zernike modes of the run, one column of every array each."""
        return TIP_TILT

    @property
    def dt(self) -> float:
        """Time step of the loop [s]."""
        return 1.0 / self.sensors.lgs_rate

    @property
    def n_steps(self) -> int:
        """Number of steps of the record."""
        return round(self.run.duration * self.sensors.lgs_rate)

    def validate(self) -> None:
        """Check what no single setting can: raises SettingError naming the settings and the limit."""
        nyquist = self.sensors.lgs_rate / 2
        if self.run.warm_up >= self.run.duration:
            raise SettingError(f"run.warm_up = {self.run.warm_up:g}: must be below run.duration = {self.run.duration:g} s")
        for i, peak in enumerate(self.vibration.peaks):
            if peak.frequency >= nyquist:
                raise SettingError(f"vibration.peaks.{i}.frequency = {peak.frequency:g}: must be below half the "
                                   f"LGS rate, {nyquist:g} Hz")
        if self.kalman.frequency >= nyquist:
            raise SettingError(f"kalman.frequency = {self.kalman.frequency:g}: must be below half the LGS rate, {nyquist:g} Hz")
        if self.vibration.source == "psd":
            self._validate_psd()
        widest = max(self.butterworth.bandwidth_offline, self.butterworth.bandwidth_online) / 2
        for i, f in enumerate(self.butterworth.frequencies):
            if not (f - widest > 0 and f + widest < nyquist):
                raise SettingError(f"butterworth.frequencies.{i} = {f:g}: the band of +- {widest:g} Hz around it must lie "
                                   f"between 0 and half the LGS rate, {nyquist:g} Hz")

    def _validate_psd(self) -> None:
        psd = self.vibration.psd
        f = psd.frequency
        if len(f) < 2 or any(b <= a for a, b in pairwise(f)):
            raise SettingError("vibration.psd.frequency: needs at least two frequencies, increasing, for vibration.source = psd")
        for name in ("tip", "tilt"):
            if len(getattr(psd, name)) != len(f):
                raise SettingError(f"vibration.psd.{name}: has {len(getattr(psd, name))} numbers, "
                                   f"vibration.psd.frequency {len(f)}")
