"""Every setting, declared once: the `Scenario` tree; its groups are declared in `wfsobs.groups`, one module per topic.

Labels carry the name and the paper's letter, documentation strings the unit in [brackets] and the
source. "The paper" is Jaufmann et al., "Simulation of Wavefront-based Disturbance Observers for
Large Telescopes". Wavefronts are Noll-normalised Zernike coefficients in micrometres rms.
"""

from __future__ import annotations

from itertools import pairwise

from wfsobs.groups.atmosphere import Telescope, Turbulence
from wfsobs.groups.observers import Butterworth, Kalman, MultiRate, OfflineGpr, OnlineGpr
from wfsobs.groups.run import Loop, Run
from wfsobs.groups.sensors import Sensors
from wfsobs.groups.vibration import Vibration
from wfsobs.modes import TIP_TILT, Mode
from wfsobs.settings import Group, SettingError, section


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
