"""The `Scenario`, the tree of all settings; its groups are declared in `wfsobs.scenario.groups`, one module per topic.

Labels contain the name and the paper's letter, documentation strings the unit in [brackets] and the
source. "The paper" is Jaufmann et al., "Simulation of Wavefront-based Disturbance Observers for
Large Telescopes". Wavefronts are Noll-normalised Zernike coefficients in micrometres rms.

Settings that have no effect for the values of the others are told with the reason: rules within a group by the group
(`Group.used_when`), those across groups here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache, lru_cache
from importlib.metadata import entry_points
from itertools import pairwise
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import param

from wfsobs import registry
from wfsobs.scenario.groups.atmosphere import PsdTable, Telescope, Turbulence, Vibration
from wfsobs.scenario.groups.events import FRAMES, LASER, PEAK, WIND, Event, shift, turbulence_time
from wfsobs.scenario.groups.plant import Control, Loop, PlantErrors, Run
from wfsobs.scenario.groups.sensors import Sensors, fit_lenslets
from wfsobs.sensors.zernike import Mode, modes_up_to
from wfsobs.settings.group import Group, Section, section
from wfsobs.settings.priors import Butterworth, Kalman
from wfsobs.settings.values import Plain, SettingError, declared_settings
from wfsobs.signal.gate import GateSettings

if TYPE_CHECKING:
    from wfsobs.observers.gpr.offline import OfflineGpr
    from wfsobs.observers.gpr.online import OnlineGpr
    from wfsobs.observers.kalman.adaptive import Adaptive
    from wfsobs.observers.kalman.filters import MultiPeak, MultiRate


HIGHEST = 0.9
"""Maximum height of a layer over that of the laser guide stars: in a higher one the beam nearly vanishes."""
SMALLEST = 0.25
"""Minimum outer scale over the aperture: below, variance moves to waves that frozen flow samples coarsely."""
SLOWEST = 4e6
"""Maximum steps in which a layer crosses the aperture: frozen flow takes Fourier transforms of four times as many."""

MAX_TURBULENCE_RATIO = 10.0
"""Maximum duration of turbulence over that of the run, for wind that increases."""


class Scenario(Group):
    """All settings of a run, in groups.

    Parameters
    ----------
    **values
        Groups or settings; the others have their defaults.

    See Also
    --------
    wfsobs.PRESETS : Functions that return ready scenarios.
    Scenario.replace : A copy with some settings changed.

    Examples
    --------
    >>> s = Scenario()
    >>> s.set("turbulence.wind_speed", 200)
    Traceback (most recent call last):
    ...
    wfsobs.settings.values.SettingError: turbulence.wind_speed = 200: takes a number from 0.1 to 100 m/s
    """

    telescope: Telescope = section(Telescope, "Telescope")
    turbulence: Turbulence = section(Turbulence, "Turbulence")
    vibration: Vibration = section(Vibration, "Vibration")
    sensors: Sensors = section(Sensors, "Sensors")
    loop: Loop = section(Loop, "Loop")
    kalman: Kalman = section(Kalman, "Kalman filters")
    butterworth: Butterworth = section(Butterworth, "Butterworth reference")
    control: Control = section(Control, "Controllers")
    plant: PlantErrors = section(PlantErrors, "Plant errors")
    run: Run = section(Run, "Run")
    events: param.List[list[Event]] = param.List(
        [], item_type=Event, bounds=(0, 20), label="Events", doc="What changes during the record."
    )

    if TYPE_CHECKING:  # what observers of wfsobs bring along
        multipeak: MultiPeak
        adaptive: Adaptive
        multirate: MultiRate
        gpr_offline: OfflineGpr
        gpr_online: OnlineGpr

    @classmethod
    def settings(cls) -> dict[str, param.Parameter[Any]]:
        """Name -> param.Parameter of every setting; the groups that observers and controllers bring along before `control`."""
        from wfsobs.observers import OBSERVERS  # late, as what is in it takes its time

        OBSERVERS.complete()
        if _has_controllers():  # else they are not imported: those of wfsobs bring no settings
            from wfsobs.control.controllers import CONTROLLERS

            CONTROLLERS.complete()
        return cls._with(tuple(registry.sections().values()))

    @classmethod
    @lru_cache(maxsize=4)
    def _with(cls, own: tuple[Section, ...]) -> dict[str, param.Parameter[Any]]:
        known = declared_settings(cls)
        for name, label, group in own:
            if name not in known:
                cls.param.add_parameter(name, cast(param.Parameter, section(group, label)))
        declared, names = declared_settings(cls), [one.name for one in own]
        rest = [name for name in known if name not in names]
        before = rest.index("control")
        return {name: declared[name] for name in (*rest[:before], *names, *rest[before:])}

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle plain values: where they are read, the settings of observers may not have been declared yet."""
        return type(self).from_dict, (self.to_dict(),)

    @property
    def modes(self) -> tuple[Mode, ...]:
        """The Zernike modes of the run, one column of every array each."""
        return modes_up_to(self.telescope.radial_order)

    @property
    def dt(self) -> float:
        """Time step of the loop [s]."""
        return 1.0 / self.sensors.lgs_rate

    @property
    def n_steps(self) -> int:
        """Number of steps of the record."""
        return round(self.run.duration * self.sensors.lgs_rate)

    @property
    def gate(self) -> GateSettings | None:
        """How outliers of a record that is not a simulation are kept from observers and controllers; None for not at all."""
        action = self.sensors.gate
        return None if action == "off" else GateSettings(self.sensors.gate_level, action)

    @property
    def before_events(self) -> Scenario:
        """The scenario without its events: the observers' models and the training record are made from it."""
        return self.replace({"events": []}) if self.events else self

    @property
    def turbulence_duration(self) -> float:
        """Duration of turbulence crossing the aperture during the record, at the wind speed without events [s]."""
        wind = [event for event in self.events if event.kind == WIND]
        return float(turbulence_time(wind, np.linspace(0.0, self.run.duration, 1001))[-1]) if wind else self.run.duration

    def validate(self) -> None:
        """Check settings against each other: raise SettingError naming the settings and the limit."""
        nyquist = self.sensors.lgs_rate / 2
        if round(self.run.warm_up / self.dt) >= self.n_steps:  # rounded as where it is left out
            raise SettingError(
                f"run.warm_up = {self.run.warm_up:g}: must be below run.duration = {self.run.duration:g} s by a step"
            )
        for i, peak in enumerate(self.vibration.peaks):
            if peak.frequency >= nyquist:
                raise SettingError(
                    f"vibration.peaks.{i}.frequency = {peak.frequency:g}: must be below half the LGS rate, {nyquist:g} Hz"
                )
        if self.kalman.frequency >= nyquist:
            raise SettingError(f"kalman.frequency = {self.kalman.frequency:g}: must be below half the LGS rate, {nyquist:g} Hz")
        if self.vibration.source == "psd":
            _validate_psd(self.vibration.psd, "vibration")
        if self.turbulence.source == "psd":
            _validate_psd(self.turbulence.psd, "turbulence")
        if self.turbulence.source == "frozen-flow":
            self._validate_layers()
        if self.sensors.noise_from == "photons" or (
            self.turbulence.source == "frozen-flow" and self.sensors.kind == "shack-hartmann"
        ):
            for kind in ("lgs", "ngs"):
                fit_lenslets(self.sensors.lenslets, kind, self.telescope.diameter, self.telescope.radial_order)
        self._validate_events()
        if self.plant.start >= self.run.duration:
            raise SettingError(f"plant.start = {self.plant.start:g}: must be below run.duration = {self.run.duration:g} s")
        least = self.control.delay + self.plant.delay_error - self.plant.delay_jitter
        if least < 1.0:
            raise SettingError(
                f"plant.delay_error = {self.plant.delay_error:g}: with control.delay = {self.control.delay:g} and "
                f"plant.delay_jitter = {self.plant.delay_jitter:g} a delay is {least:g} frames; it must be at least 1"
            )
        widest = max(self.butterworth.bandwidth_offline, self.butterworth.bandwidth_online) / 2
        for i, f in enumerate(self.butterworth.frequencies):
            if not (f - widest > 0 and f + widest < nyquist):
                raise SettingError(
                    f"butterworth.frequencies.{i} = {f:g}: the band of +- {widest:g} Hz around it must lie "
                    f"between 0 and half the LGS rate, {nyquist:g} Hz"
                )

    def _validate_events(self) -> None:
        stars = self.sensors.lgs_count
        for i, event in enumerate(self.events):
            if event.start >= self.run.duration:
                raise SettingError(f"events.{i}.start = {event.start:g}: must be below run.duration = {self.run.duration:g} s")
            if event.kind in (LASER, FRAMES) and event.duration == 0:
                raise SettingError(f"events.{i}.duration = 0: takes a number above 0 s, for kind {event.kind}")
            if event.kind == LASER and event.lasers > stars:
                raise SettingError(f"events.{i}.lasers = {event.lasers}: takes up to sensors.lgs_count = {stars}")
            if event.kind == PEAK:
                self._validate_moving_peak(i, event)
        if self.turbulence_duration > (MAX_TURBULENCE_RATIO + 1e-9) * self.run.duration:
            raise SettingError(
                f"events: the wind carries {self.turbulence_duration:.3g} s of turbulence past in {self.run.duration:g} s; at "
                f"most {MAX_TURBULENCE_RATIO:g} times as much as the record is long"
            )

    def _validate_moving_peak(self, i: int, event: Event) -> None:
        v, nyquist = self.vibration, self.sensors.lgs_rate / 2
        if v.source not in ("peaks", "ar2"):
            raise SettingError(f"events.{i}.kind = peak: takes vibration.source = peaks or ar2, not {v.source}")
        if event.peak >= len(v.peaks):
            raise SettingError(f"events.{i}.peak = {event.peak}: vibration.peaks has {len(v.peaks)} entries, numbered from 0")
        own = [e for e in self.events if e.kind == PEAK and e.peak == event.peak]
        turning = np.array([t for e in own for t in (np.nextafter(e.start, 0.0), e.start, e.start + e.duration)])
        reached = v.peaks[event.peak].frequency + shift(own, np.minimum(turning, self.run.duration))
        for f in reached:
            if not 0 < f < nyquist:
                raise SettingError(
                    f"events.{i}.frequency_shift = {event.frequency_shift:g}: moves peak {event.peak} to {f:g} "
                    f"Hz; it must stay between 0 and half the LGS rate, {nyquist:g} Hz"
                )

    def _validate_layers(self) -> None:
        layers, smallest = self.turbulence.layers, SMALLEST * self.telescope.diameter
        if self.turbulence.outer_scale < smallest:
            raise SettingError(
                f"turbulence.outer_scale = {self.turbulence.outer_scale:g}: frozen flow takes {SMALLEST:g} of "
                f"telescope.diameter or more, {smallest:g} m"
            )
        if not sum(layer.fraction for layer in layers) > 0:
            raise SettingError("turbulence.layers: needs a layer of a fraction above 0, for turbulence.source = frozen-flow")
        for i, layer in enumerate(layers):
            if layer.height > HIGHEST * self.sensors.lgs_altitude:
                raise SettingError(
                    f"turbulence.layers.{i}.height = {layer.height:g}: takes up to {HIGHEST:g} of "
                    f"sensors.lgs_altitude, {HIGHEST * self.sensors.lgs_altitude:g} m"
                )
            crossing = self.telescope.diameter / (self.turbulence.wind_speed * layer.wind_factor)
            if crossing * self.sensors.lgs_rate > SLOWEST:
                raise SettingError(
                    f"turbulence.layers.{i}.wind_factor = {layer.wind_factor:g}: it takes {crossing:.3g} s to "
                    f"cross the aperture, at most {SLOWEST / self.sensors.lgs_rate:.3g} s at this LGS rate"
                )


@cache
def _has_controllers() -> bool:
    """Return whether an installed package has controllers."""
    return bool(entry_points(group=registry.CONTROLLERS))


def register(entry: Any) -> None:
    """Register an observer or a controller, beside those of wfsobs.

    An installed package declares its own by an entry point instead, which other processes see as well.

    Parameters
    ----------
    entry : Observer or Controller
        What to register; the same one again changes nothing.

    Raises
    ------
    RegistrationError
        An id or a group of settings is taken or has forbidden characters, or `entry` is neither.
    """
    from wfsobs.control.controllers import CONTROLLERS
    from wfsobs.observers import OBSERVERS

    if isinstance(entry, OBSERVERS.kind):
        OBSERVERS.add(entry)
    elif isinstance(entry, CONTROLLERS.kind):
        CONTROLLERS.add(entry)
    else:
        raise registry.RegistrationError(f"register: takes an Observer or a Controller, not {registry.kind_of(entry)}")


def _validate_psd(psd: PsdTable, group: str) -> None:
    f = psd.frequency
    if len(f) < 2 or any(b <= a for a, b in pairwise(f)):
        raise SettingError(f"{group}.psd.frequency: needs at least two frequencies, increasing, for {group}.source = psd")
    for name in ("tip", "tilt"):
        if len(getattr(psd, name)) != len(f):
            raise SettingError(f"{group}.psd.{name}: has {len(getattr(psd, name))} numbers, {group}.psd.frequency {len(f)}")


registry.announce(Scenario)


FLOW_ONLY = (
    "telescope.zenith_angle",
    "sensors.kind",
    "sensors.lgs_altitude",
    "sensors.lgs_radius",
    "sensors.lgs_angle",
    "sensors.ngs_direction",
)
"""Settings of frozen flow, outside the group of the turbulence."""

SIMULATION_ONLY = ("loop", "events", "run.seed")
"""Settings that only the simulation of a record reads."""

RECORD_ONLY = ("sensors.gate", "sensors.gate_level")
"""Settings that no simulation of a record reads."""


def idle_settings(scenario: Scenario, *, is_simulated: bool = True) -> dict[str, str]:
    """Return the settings without effect.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    is_simulated : bool
        Whether the record is simulated from them; otherwise it is given.

    Returns
    -------
    dict of str to str
        Dotted path of a setting, a list or a group -> reason in one line. What is below a path has no effect either.

    Examples
    --------
    >>> idle_settings(Scenario())["gpr_online.highpass"]
    'Used only where Filter of the inputs is high-pass'
    """
    out = dict(_within(scenario, "")) | dict(_across(scenario))
    if is_simulated:
        out |= dict.fromkeys(RECORD_ONLY, "Used only with a record that is given; a simulated one has no outliers")
    else:
        out |= dict.fromkeys(SIMULATION_ONLY, "Used only by a simulation; here the record is given")
    return out


def why_idle_at(path: str, idle: Mapping[str, str]) -> str:
    """Return why the setting of a dotted path has no effect, by `idle_settings`; empty where it has one."""
    keys = path.split(".")
    return next((idle[above] for i in range(len(keys)) if (above := ".".join(keys[: i + 1])) in idle), "")


def used_settings(scenario: Scenario) -> Plain:
    """Return the settings that have an effect, as nested plain values."""
    tree = scenario.effective_values()
    for path in (*RECORD_ONLY, *(path for path, _ in _across(scenario))):
        *above, name = path.split(".")
        node: Any = tree
        for key in above:
            node = node[int(key)] if isinstance(node, list) else node.get(key, {})
        node.pop(name, None)
    return tree


def _within(group: Group, prefix: str) -> Iterator[tuple[str, str]]:
    """Yield the idle settings of a group and of the groups and lists in it, by their own rules."""
    idle = group.idle()
    yield from ((f"{prefix}{name}", reason) for name, reason in idle.items())
    for name in group.settings():
        value = getattr(group, name)
        if name in idle:
            continue
        if isinstance(value, Group):
            yield from _within(value, f"{prefix}{name}.")
        elif isinstance(value, list):
            for i, item in enumerate(value):
                if isinstance(item, Group):
                    yield from _within(item, f"{prefix}{name}.{i}.")


def _across(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """Yield the idle settings by rules across groups."""
    s, flow = scenario.sensors, scenario.turbulence.source == "frozen-flow"
    if not flow:
        yield from ((path, "Used only where Source of turbulence is frozen-flow") for path in FLOW_ONLY)
        if scenario.telescope.radial_order == 1:
            yield "turbulence.outer_scale", "Used only with frozen flow, and for radial orders above 1"
    else:
        yield "sensors.lgs_low_frequency_rms", "Used only where Source of turbulence is not frozen-flow"
        if len(scenario.turbulence.layers) == 1:
            yield "turbulence.layers.0.fraction", "Used only where there are several layers: they share the turbulence"
        if s.lgs_radius == 0:
            yield "sensors.lgs_angle", "Used only where LGS asterism, radius is above 0"
    if scenario.turbulence.source == "none":
        yield "sensors.tip_tilt_indetermination", "Used only where there is turbulence"
    if scenario.plant.mount == "custom" and not scenario.plant.resonance:
        yield "plant.damping", "Used only where Resonance is above 0"
    if not scenario.plant.hysteresis:
        yield "plant.hysteresis_range", "Used only where Hysteresis is above 0"
    if not scenario.plant.optical_gain_rms:
        yield "plant.optical_gain_time", "Used only where Optical gain, rms is above 0"
    if s.noise_from == "nm" and not (flow and s.kind == "shack-hartmann"):
        yield "sensors.lenslets", "Used only by Shack-Hartmann sensors in frozen flow, and for noise from photons"
    if scenario.kalman.peak == "matched" and _every_mode_has_a_line(scenario):
        yield "kalman.frequency", "Used only where Vibration peak is manual, or a mode has no line"
        yield "kalman.damping", "Used only where Vibration peak is manual, or a mode has no line"


def _every_mode_has_a_line(scenario: Scenario) -> bool:
    """Return whether a list of peaks gives every mode a line; for other sources False."""
    v = scenario.vibration
    if v.source not in ("peaks", "ar2"):
        return False
    found = [peak.rms for peak in v.peaks if v.source == "ar2" or peak.frequency <= v.cutoff]
    return all(any(i < len(rms) and rms[i] > 0 for rms in found) for i in range(len(scenario.modes)))
