"""The plant of a closed loop, from its commands and measurements: delay, gain and rotation, with standard deviations.

The mirror holds a command for a frame and the sensor averages over one, so that with the delay d + p, 0 <= p < 1, in frames,

    y[k] = disturbance[k] + R(angle) diag(gain) m[k] + noise[k],    m[k] = (1 - p) u[k-d] + p u[k-d-1].

The disturbance and the noise of each mode have a spectrum S of a stated form: white noise, turbulence of second or third order, a
coloured background where it is worth it, and resonances. Whittle's likelihood of z = y - R diag(gain) m,

    - log L = sum log S + |Z|^2 / S    over modes and frequencies,

has its maximum over plant and spectra together (the direct method: U. Forssell and L. Ljung, Automatica 35, 1999). The plant's
covariance is its block of the inverse of the joint information: in a closed loop what a plant explains a spectrum may explain as
well. A probe in the commands makes that small. Without one, and under one linear controller, any plant under which the loop would
be stable fits some spectrum: the result is as good as the form is.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from math import sqrt
from typing import Any

import numpy as np
from scipy.fft import irfft, rfft
from scipy.stats import chi2

from wfsobs.control.residual import residual_density
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError, hold_last
from wfsobs.scenario import Scenario
from wfsobs.sensors.modes import HIGHEST_ORDER, TIP_TILT, modes_up_to
from wfsobs.sensors.zernike import noll
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.wiener import circle_mean
from wfsobs.simulation.true_spectra import true_spectra
from wfsobs.spectral.missing import MissingSamples, find_outlying
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.periodogram import Cells, fast_length, inflation, periodogram_frequencies, taper
from wfsobs.spectral.quick import behind_pole, quick_spectrum
from wfsobs.spectral.whittle import spectrum_negative_log_likelihood
from wfsobs.typing import Array

LONGEST = 6
"""Largest delay [frames]."""

SHORTEST, MOST_STEPS = 1000, 100_000
"""Minimum frames of a record; frames that are looked at, its first."""

ORDER, SPAN, DEGREE = 16, 12, 4
"""Of the first guess: frames of the past that predict a measurement, and frames after it over which the response of a disturbance
is a polynomial of this degree."""

PEAKS, MOST_PEAKS, LOWEST = 10, 40, 5.0
"""Maximum number of resonances per mode, while a maximum is looked for and then; their minimum frequency [Hz]."""

STARTS, REFINED, SAME, REFINEMENTS = (1.25, 2.25, 3.25, 4.5), 2, 0.05, 3
"""Delays at which a search starts [frames]; how many of the likeliest maxima are then fitted with all peaks, and how often;
distance below which two maxima are one."""

THIRD = (1.5, 6.0)
"""Third corners of turbulence, over the first two, that are tried."""

STEPS, REACH, ENOUGH = 25, 0.3, 0.02
"""Newton steps; maximum change of a number of the plant in one; gain of log-likelihood below which they end."""

NARROW, BAND, LOOSE = 10.0, 0.1, 0.1
"""Bands over which the correlation of plant and spectra is smoothed: bins, and share of the frequency added to it; information on
each number of a spectrum beside that of the data, which keeps those that the data say nothing of.
"""

FAR = 0.05
"""Gain of the first guess below which, or over whose inverse, it is not taken for 1."""

RIVAL, APART = 4.0, 4.0
"""Another maximum counts if its log-likelihood is lower by no more than this, and if it is as many standard deviations away."""

WIDEST_DELAY, WIDEST_GAIN, WIDEST_ANGLE = 0.25, 0.25, np.radians(15.0)
"""Standard deviation, of the gain over itself, beyond which a number is not identifiable."""

DIFFERS = 0.01
"""Probability with which two modes of one delay, or of one gain, are taken for different."""

EXCITED = 1e-3
"""Share of what is new in the commands that the measurements do not explain, from which on they have a probe."""


@dataclass(frozen=True)
class PlantNumber:
    """A number and its standard deviation; both None where it is not identifiable."""

    value: float | None = None
    sd: float | None = None

    def text(self, unit: str = "") -> str:
        """Return it with its standard deviation, in two digits of that."""
        if self.value is None or self.sd is None:
            return "not identifiable"
        digits = max(1 - int(np.floor(np.log10(self.sd))), 0)
        return f"{self.value:.{digits}f} +- {self.sd:.{digits}f}{unit}"


@dataclass(frozen=True)
class GroupPlant:
    """The plant of one mode, or of the two modes of one radial and azimuthal order.

    Attributes
    ----------
    modes : tuple of str
        Their names.
    delay, gain : tuple of PlantNumber
        Of every mode [frames], one delay for both where they do not differ; the gain is that of mirror and sensor together,
        negative for an axis that is flipped.
    rotation : PlantNumber or None
        Angle of y = R u [rad], in (-pi, pi]; None for one mode.
    common_delay, common_gain : PlantNumber
        Those of the modes together, where they do not differ; the gain above zero.
    uncertainty : float
        95 % limit of the rms of what the uncertainty of the plant puts into z, over the rms of z, in the worst octave between
        1 Hz and a quarter of the rate; infinite where the plant is not identifiable.
    peaks : tuple of int
        Resonances in the spectrum of every mode.
    has_background : bool
        Whether the spectrum of a mode has a coloured background.
    own_share : float
        Share of what is new in the commands that the measurements do not explain: of a probe, or a change of the controller.
    """

    modes: tuple[str, ...]
    delay: tuple[PlantNumber, ...]
    gain: tuple[PlantNumber, ...]
    rotation: PlantNumber | None
    common_delay: PlantNumber
    common_gain: PlantNumber
    uncertainty: float
    peaks: tuple[int, ...]
    has_background: bool
    own_share: float

    @property
    def degrees(self) -> PlantNumber:
        """The rotation [degrees]."""
        angle = self.rotation or PlantNumber()
        return PlantNumber(*(None if x is None else float(np.degrees(x)) for x in (angle.value, angle.sd)))

    @property
    def flipped_mode(self) -> str:
        """Name of the mode whose commands act the other way round while those of the other do not; empty where none is."""
        if self.rotation is None or self.gain[1].value is None or self.gain[1].value > 0 or self.rotation.value is None:
            return ""
        return self.modes[int(abs(self.rotation.value) < np.pi / 2)]


def identify_plant(record: Record, watch: Watch = QUIET) -> tuple[GroupPlant, ...]:
    """Identify the delay, gain and rotation of the commands of a record.

    Parameters
    ----------
    record : Record
        Measurements, and commands as they were given; its own delay plays no part.
    watch : Watch, optional
        Receives the progress, and is asked whether to stop.

    Returns
    -------
    tuple of GroupPlant
        One for every mode without azimuthal order and every pair of one such order. Numbers that the data do not decide are None.

    Raises
    ------
    RecordError
        The record is too short, or its commands do not move.
    Cancelled
        `watch` asks to stop.
    """
    y, u = _known_signals(record, MOST_STEPS)
    if len(y) < SHORTEST:
        raise RecordError(f"the record has {len(y)} frames, the plant needs {SHORTEST}")
    out = []
    groups = list(_groups(record.n_modes))
    for i, columns in enumerate(groups):
        watch.check()
        names = tuple(modes_up_to(HIGHEST_ORDER)[c].name for c in columns)
        if (np.ptp(u[:, columns], axis=0) == 0).any():
            raise RecordError(f"the commands of {' and '.join(names)} do not move: there is no plant to identify")
        out.append(_identify_group(names, y[:, columns], u[:, columns], record.dt))
        watch.step((i + 1) / len(groups))
    return tuple(out)


def contradiction(record: Record, sign: int = 1, delay: float | None = None, gain: Sequence[float] = (1.0,)) -> str:
    """Return in a line why the data exclude the plant with which a record was read; empty where they do not.

    The likeliest plant near the stated one, of tip and tilt over CHECKED frames, is compared with the stated one, each with the
    spectra that are likeliest for it. A loop that reduces an error tells sign and rotation besides, where what is new in its
    commands follows from the measurement of the row. This takes a tenth of the time of `identify_plant`, which looks farther.

    Parameters
    ----------
    record : Record
        As it was read: y = disturbance + u, `record.delay` steps later.
    sign, delay, gain : int, float, sequence of float
        Sign, delay and gain of the commands as they were stated, for the line alone.
    """
    y, u = (x[:, : len(TIP_TILT)] for x in _known_signals(record, CHECKED))
    moving = np.flatnonzero(np.ptp(u, axis=0) > 0)
    if len(y) < SHORTEST or not moving.size or record.delay > LONGEST or np.isnan(y).mean(axis=0).max() > 0.5:
        return ""
    y, u = (x[:, moving] / np.nanstd(y) for x in (y, u))
    with suppress(np.linalg.LinAlgError), np.errstate(all="ignore"):  # numbers without noise decide nothing
        return _contradiction_of(_Data(y, u, record.dt), record.delay, (sign, delay or record.delay, gain), moving)
    return ""


def _contradiction_of(data: _Data, delay: int, statement: tuple[int, float, Sequence[float]], moving: Array) -> str:
    k, (guess, excited) = moving.size, _first_guess(data)
    names, ways = [TIP_TILT[i].name for i in moving], (*statement[:2], np.resize(statement[2], k))
    stated = np.concatenate([np.full(k, float(delay)), np.ones(k), np.zeros(k - 1)])
    is_turned = excited < REVERSED and bool((guess[k : 2 * k] < 0).any() or (k == 2 and abs(guess[-1]) > np.pi / 4))
    start = np.concatenate([stated[:k], guess[k:]]) if is_turned else stated
    ties = np.eye(3 * k - 1)[:, k - 1 :]
    ties[:k, 0] = 1.0
    new = _nearest(data, start, ties)
    if not is_turned and _is_far(new):  # from a delay that is frames off there is no way to the right one
        new = _nearest(data, np.concatenate([np.full(k, np.mean(guess[:k])), guess[k:]]), ties)
    if (_is_far(new) and not is_turned) or not _what_is_off(new, stated, names, ways):
        return ""
    new = data.fit(data.with_spectra(new.theta, new.spectra, MOST_PEAKS, plain=False), ties, STEPS)
    # where nothing excites the loop, a plant is known as well as the form of the background
    rests_on_form = any(s.background for s in new.spectra) and excited < EXCITED and not is_turned
    none = np.concatenate([stated[:k], np.full(k, 1e-9), stated[2 * k :]])
    first = {i: data.with_spectra(x).spectra for i, x in enumerate((stated, none))}
    again = (data.with_spectra(x, first[i], MOST_PEAKS, plain=False) for i, x in enumerate((stated, none)))
    old, idle = (data.fit(one, ties[:, :0], STEPS) for one in again)
    worth, better = min(old.criterion, idle.criterion) - new.criterion, _what_is_off(new, stated, names, ways)
    if not worth > CLEAR * (FORM if rests_on_form else 1.0) or not better:
        return ""
    return f"command {better[0]} is excluded by the data, which are likelier by {worth:.0f} (log-likelihood) with {better[1]}"


def _nearest(data: _Data, theta: Array, ties: Array) -> _Fit:
    """Fit a plant from a start, its spectra first."""
    begin = data.with_spectra(theta)
    if any(missing.any for missing in data.missing):  # no longer filled by straight lines
        begin = data.with_spectra(theta, begin.spectra)
    return data.fit(begin, ties, STEPS)


def _is_far(fit: _Fit) -> bool:
    """Return whether commands follow nothing, or are of another unit."""
    k = (len(fit.theta) + 1) // 3
    gains = fit.theta[k : 2 * k]
    return bool(np.any((gains < NEAR[0]) | (gains > NEAR[1])))


def _what_is_off(fit: _Fit, theta: Array, names: Sequence[str], ways: tuple[int, float, Array]) -> tuple[str, str] | None:
    """Return what of a stated plant is off the fitted one, and what it is there; None where nothing is.

    ways : sign, delay and gains as they were stated
    """
    k, (sign, delay, gains) = len(names), ways
    sd, off = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0)), fit.theta - theta
    least = np.array([OFF_DELAY] * k + [OFF_GAIN] * k + [np.radians(TURNED)] * (k - 1))
    is_off: Array = np.abs(off) > np.maximum(SURE * sd, np.where(sd > 0.0, least, np.inf))
    turn, is_flipped = float(np.degrees(off[-1])) if k == 2 else 0.0, fit.theta[k : 2 * k] < 0
    if is_flipped.any() and not is_flipped.all():
        return f"sign {sign:+d} of {names[int(abs(turn) < 90.0)]}", f"{-sign:+d}, and that of the other mode as it is"
    if is_flipped.any() or abs(turn) > 135.0:
        return f"sign {sign:+d}", f"{-sign:+d}"
    if is_off[0]:
        return f"delay {delay:g}", PlantNumber(delay + float(off[0]), float(sd[0])).text()
    if is_off[2 * k :].any():
        return "rotation 0", f"{turn:+.1f} degrees, y = R u"
    for i in np.flatnonzero(is_off[k : 2 * k]).tolist():
        of = f" of {names[i]}" * (k == 2)
        return f"gain {gains[i]:g}{of}", PlantNumber(*(float(gains[i] * x) for x in (fit.theta[k + i], sd[k + i]))).text()
    return None


CHECKED, CLEAR, SURE = 20_000, 30.0, 6.0
"""Of a plant that is excluded: frames that are looked at, the first; log-likelihood by which, after Schwarz, another is better;
standard deviations by which it is off."""

FORM = 10.0
"""How many times as much where it rests on the form of a background."""

REVERSED = 0.5
"""Share of what is new in the commands that the measurements do not explain, beyond which their signs say nothing."""

NEAR = (0.3, 1.7)
"""Gains between which a plant is near a stated one."""

OFF_DELAY, OFF_GAIN, TURNED = 0.2, 0.1, 10.0
"""Distance of a delay [frames], a gain and an angle [degrees] from what is stated below which a record is not refused."""


def _known_signals(record: Record, most: int) -> tuple[Array, Array]:
    """Return the first measurements of a record, NaN where a command that they may see is lost, and commands."""
    y, u = record.y_lgs[:most].copy(), hold_last(record.u[:most])
    lost = np.isnan(record.u[:most]).sum(axis=1) > 0
    for lag in range(1, LONGEST + 2):
        y[lag:][lost[:-lag]] = np.nan
    return y, u


def plant_dict(groups: Sequence[GroupPlant]) -> dict[str, Any]:
    """Return a plant as plain values: lists by mode, and by pair of modes; None where a number is not identifiable."""
    pairs = [group for group in groups if group.rotation is not None]
    numbers = {
        "delay_frames": [n for group in groups for n in group.delay],
        "gain": [n for group in groups for n in group.gain],
        "rotation_deg": [group.degrees for group in pairs],
    }
    worst = max(group.uncertainty for group in groups)
    return {
        "modes": [name for group in groups for name in group.modes],
        "pairs": [list(group.modes) for group in pairs],
        **{key: [n.value for n in found] for key, found in numbers.items()},
        **{f"{key}_sd": [n.sd for n in found] for key, found in numbers.items()},
        "trustworthy_to_percent": 100.0 * worst if np.isfinite(worst) else None,
        "excited": all(group.own_share > EXCITED for group in groups),
        "remarks": plant_lines(groups),
    }


def plant_lines(groups: Sequence[GroupPlant]) -> list[str]:
    """Return what a plant means and what it rests on, a line each."""
    worst, peaks = max(group.uncertainty for group in groups), [n for group in groups for n in group.peaks]
    colour = "a coloured background, " if any(group.has_background for group in groups) else ""
    form = f"white noise, turbulence of second or third order, {colour}{min(peaks)} to {max(peaks)} resonances per mode"
    new = min(group.own_share for group in groups)
    basis = (
        f"the commands are excited: {100.0 * new:.2g} % of what is new in them does not follow from the measurements"
        if new > EXCITED
        else "neither a probe nor a change of the controller is in the commands: all rests on the form of the disturbance"
    )
    trust = (
        f"to {100.0 * worst:.2g} %: 95 % limit of what the uncertainty of the plant puts into it, over its own rms, in the worst "
        "octave between 1 Hz and a quarter of the rate"
        if np.isfinite(worst)
        else "to no known extent: the plant is not identifiable"
    )
    return [
        "gain: of mirror and sensor (optical gain) together, which cannot be told apart; negative of a flipped axis",
        "delay: group delay at low frequencies, that of the mirror included",
        f"disturbance: {form}; {basis}",
        f"the pseudo-open-loop is trustworthy {trust}",
    ]


@dataclass(frozen=True)
class Probe:
    """White commands above a frequency, beside those of the loop of a scenario, which is its integrator at a delay of two.

    Attributes
    ----------
    low : float
        Minimum frequency, the maximum is half the rate [Hz].
    rms : float
        Of the commands of each mode [um].
    bound : dict of str to float
        Cramer-Rao bounds of the probe alone, whatever the plant's own motion tells: `delay_frames`, `gain` of a mode, and
        `rotation_deg`, the largest of the modes.
    cost : float
        What it adds to the rms of the residual of a mode while it lasts, over that; the largest of the modes.
    """

    low: float
    rms: float
    bound: dict[str, float]
    cost: float

    def commands(self, n: int, n_modes: int, dt: float, rng: np.random.Generator) -> Array:
        """Return its commands (n, n_modes) [um], to be added to those of the loop."""
        x = rfft(rng.standard_normal((n, n_modes)), axis=0)
        x[np.arange(len(x)) / (n * dt) < self.low] = 0.0
        x = irfft(x, n, axis=0)
        return self.rms * x / x.std(axis=0)


def design_probe(scenario: Scenario, seconds: float, accuracy: Mapping[str, float]) -> Probe:
    """Design the probe that adds least to the residual of a scenario's loop, for standard deviations of the plant.

    Parameters
    ----------
    scenario : Scenario
        Disturbance, noise, integrator.
    seconds : float
        How long it lasts [s].
    accuracy : mapping of str to float
        Standard deviations by name, as `Probe.bound`.

    Returns
    -------
    Probe
        The one whose lowest frequency, of LOW over the rate, costs least.
    """
    modes = range(2)
    spectra = [true_spectra(scenario, mode) for mode in modes]
    probes = []
    for share in LOW:
        information, rotation, excess = np.zeros((2, 2, 2)), 0.0, []
        density = []
        for s in spectra:
            omega = np.pi * np.arange(s.measurement.size) / (s.measurement.size - 1)
            forgets = 1.0 - scenario.loop.leak * np.exp(-1j * omega)
            sensitivity = forgets / (forgets + scenario.loop.gain * scenario.loop.closed * np.exp(-2j * omega))
            own = residual_density(1.0 - sensitivity, s.total[0], s.total[1], s.measurement)
            power = np.abs(sensitivity) ** 2 * np.where(omega >= 2.0 * np.pi * share, 0.5 / (0.5 - share), 0.0)
            excess.append(circle_mean(power) / circle_mean(own))
            density.append((omega, power))
        n = seconds / scenario.dt
        for mode, s in enumerate(spectra):
            (omega, power), other = density[mode], density[1 - mode][1]
            slopes = np.array([np.exp(-1j * omega) - 1.0, np.ones_like(omega)])  # by delay and gain, but for two frames
            products = np.real(slopes[:, None] * slopes.conj()) * power / s.measurement
            information[mode] = n * np.array([[circle_mean(x) for x in row] for row in products])
            rotation += n * circle_mean(other / s.measurement) if other.size == omega.size else 0.0
        sd = np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2).max(axis=0))
        unit = {"delay_frames": sd[0], "gain": sd[1], "rotation_deg": np.degrees(1.0 / sqrt(rotation))}
        rms = max(unit[name] / accuracy[name] for name in unit)
        cost = sqrt(1.0 + rms**2 * max(excess)) - 1.0
        probes.append(Probe(share / scenario.dt, float(rms), {name: float(x / rms) for name, x in unit.items()}, cost))
    return min(probes, key=lambda probe: probe.cost)


LOW = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)
"""Lowest frequencies of a probe that are tried, over the rate."""


def _groups(n_modes: int) -> Iterator[list[int]]:
    """Yield the columns of every mode without azimuthal order and every pair of one."""
    orders = [noll(j) for j in range(2, n_modes + 2)]
    for order in dict.fromkeys((n, abs(m)) for n, m in orders):
        yield [i for i, (n, m) in enumerate(orders) if (n, abs(m)) == order]


def _identify_group(names: tuple[str, ...], y: Array, u: Array, dt: float) -> GroupPlant:
    data, k = _Data(y, u, dt), len(names)
    guess, excited = _first_guess(data)
    pooled = np.zeros((2 * k + (k == 2), 2 + (k == 2)))
    pooled[:k, 0], pooled[k : 2 * k, 1], pooled[2 * k :, 2:] = 1.0, np.sign(guess[k : 2 * k]), 1.0
    fits: list[_Fit] = []
    spectra: Sequence[Spectrum] = ()
    for delay in STARTS:
        start = np.concatenate([np.full(k, delay), guess[k:]])
        fits.append(data.fit(data.with_spectra(start, spectra), pooled, STEPS))
        spectra = fits[-1].spectra
    first, *others = sorted(fits, key=lambda fit: fit.criterion)
    fits = [first, *(fit for fit in others if abs(fit.theta[0] - first.theta[0]) > SAME)][:REFINED]
    gains = np.column_stack([pooled[:, 0], np.eye(len(pooled))[:, k:]])
    for again in range(REFINEMENTS):
        more = [data.fit(data.with_spectra(fit.theta, fit.spectra, MOST_PEAKS), gains, STEPS) for fit in fits]
        better = [new.criterion < old.criterion - 1.0 for old, new in zip(fits, more, strict=True)]
        fits = [new if again == 0 or new.criterion < old.criterion else old for old, new in zip(fits, more, strict=True)]
        if not any(better):
            break
    each = min(fits, key=lambda fit: fit.criterion)
    coloured = data.with_spectra(each.theta, each.spectra, MOST_PEAKS, plain=False)
    if any(s.background for s in coloured.spectra):
        each = min(each, data.fit(coloured, gains, STEPS), key=lambda fit: fit.criterion)
    for corner in THIRD:
        third = [_third_order(s, corner) for s in each.spectra]
        each = min(each, data.fit(replace(each, spectra=third), gains, STEPS), key=lambda fit: fit.criterion)
    apart = data.fit(each, np.eye(len(pooled)), STEPS)
    difference = np.append(-1.0, 1.0) if k == 2 else np.zeros(1)
    signs = np.sign(each.theta[k : 2 * k])
    one_delay, one_gain = (
        (c @ apart.theta[at]) ** 2 <= chi2.isf(DIFFERS, 1) * (c @ apart.covariance[at, at] @ c)
        for at, c in ((slice(0, k), difference), (slice(k, 2 * k), difference * signs))
    )
    middle = np.concatenate([each.theta[:k], signs * np.abs(each.theta[k : 2 * k]).mean(), each.theta[2 * k :]])
    common = data.fit(replace(each, theta=middle), pooled, STEPS) if one_delay and one_gain else each
    rivals = [fit.theta - each.theta for fit in fits if fit.criterion - each.criterion < RIVAL]
    each = each if one_delay else apart

    def number(fit: _Fit, i: int) -> PlantNumber:
        """Return a number of the plant, if it is near enough to that of every other plant that is as likely."""
        value, sd = float(fit.theta[i]), float(np.sqrt(max(fit.covariance[i, i], 0.0)))
        widest = WIDEST_DELAY if i < k else WIDEST_GAIN * abs(value) if i < 2 * k else WIDEST_ANGLE
        near = all(abs(rival[i]) <= APART * sd for rival in rivals)
        return PlantNumber(value, sd) if near and 0.0 < sd < widest else PlantNumber()

    def positive(n: PlantNumber) -> PlantNumber:
        return n if n.value is None else replace(n, value=abs(n.value))

    delay, gain = tuple(number(each, i) for i in range(k)), tuple(number(each, k + i) for i in range(k))
    rotation = number(each, 2 * k) if k == 2 else None
    common_delay = number(common, 0) if one_delay else PlantNumber()
    common_gain = positive(number(common, k)) if one_delay and one_gain else PlantNumber()
    if rotation is not None and rotation.value is not None:
        rotation = replace(rotation, value=float(-((np.pi - rotation.value) % (2.0 * np.pi) - np.pi)))
    uncertainty = data.uncertainty(each) if all(n.value is not None for n in (*delay, *gain)) else np.inf
    peaks, coloured = tuple(len(s.resonances) for s in each.spectra), any(s.background for s in each.spectra)
    return GroupPlant(names, delay, gain, rotation, common_delay, common_gain, uncertainty, peaks, coloured, excited)


@dataclass(frozen=True)
class _Fit:
    """Plant: delays, gains and, of two modes, the angle; spectra; - log L; covariance of the plant; bins."""

    theta: Array
    spectra: Sequence[Spectrum]
    value: float = np.inf
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    bins: int = 0

    @property
    def criterion(self) -> float:
        """That of Schwarz: a number of a spectrum has to be worth half of the log of the bins."""
        return self.value + 0.5 * np.log(max(self.bins, 1)) * sum(s.starts[-1] for s in self.spectra)


class _Data:
    """Measurements, and commands of up to LONGEST + 1 frames before, of the modes of a group, with their Fourier transforms."""

    def __init__(self, y: Array, u: Array, dt: float):
        skip = LONGEST + 1
        self.n, self.dt, self.k = fast_length(len(y) - skip), dt, y.shape[1]
        self.f = periodogram_frequencies(self.n, dt)
        u = u - u.mean(axis=0)
        self.u = np.array([u[skip - j : skip - j + self.n] for j in range(LONGEST + 2)])
        self.y = (y - np.nanmean(y, axis=0))[skip : skip + self.n]
        self.y = np.column_stack([np.where(np.isnan(x) | find_outlying(x), np.nan, x) for x in self.y.T])
        self.missing = [MissingSamples(np.isnan(x), dt) for x in self.y.T]
        self.U = np.array([self._transform(x) for x in self.u])
        self.Y = self._transform(self.filled_y)

    @property
    def filled_y(self) -> Array:
        """Measurements with straight lines through gaps."""
        return np.column_stack([m.interpolate(x) for m, x in zip(self.missing, self.y.T, strict=True)])

    def _transform(self, x: Array) -> Array:
        """Return the Fourier transform of the columns (k, bins), such that its square is the periodogram."""
        return np.sqrt(2.0 * self.dt / self.n) * rfft(taper(self.n)[:, None] * x, axis=0)[1 : (self.n + 1) // 2].T

    def with_spectra(self, theta: Array, spectra: Sequence[Spectrum] = (), most: int = PEAKS, *, plain: bool = True) -> _Fit:
        """Return a plant with first guesses of the spectra; missing samples are filled by those before.

        plain : without a background, which the commands of a wrong plant look like
        """
        seen = self._mirror_signal(theta)
        z = self.y - seen
        for i, missing in enumerate(self.missing):
            z[:, i] = missing.interpolate(z[:, i]) if not spectra else missing.fill(z[:, i], spectra[i].psd(self.f))
        if any(missing.any for missing in self.missing):
            self.Y = self._transform(z + seen)
        some = zip(z.T, spectra or [None] * self.k, strict=True)
        found = [quick_spectrum(x, self.dt, most, LOWEST, s, complete=not plain) for x, s in some]
        return _Fit(theta, [replace(s, background=None) if plain else s for s in found])

    def _mirror_signal(self, theta: Array) -> Array:
        """Return the commands as the measurements see them, (n, k)."""
        whole = np.minimum(theta[: self.k].astype(int), LONGEST)
        part = theta[: self.k] - whole
        m = [(1.0 - p) * self.u[d, :, j] + p * self.u[d + 1, :, j] for j, (d, p) in enumerate(zip(whole, part, strict=True))]
        return np.array(m).T @ self._matrix(theta).T

    def _matrix(self, theta: Array, turn: float = 0.0) -> Array:
        return _rotation((theta[-1] if self.k == 2 else 0.0) + turn)[: self.k, : self.k] * theta[self.k : 2 * self.k]

    def z(self, theta: Array, lower: Array) -> tuple[Array, Array]:
        """Return the transform of z (k, bins) and its derivatives by theta (p, k, bins); lower : whole part of the delays."""
        before, change = (np.array([x[d, j] for j, d in enumerate(lower)]) for x in (self.U, self.U[1:] - self.U[:-1]))
        m, matrix = before + (theta[: self.k] - lower)[:, None] * change, self._matrix(theta)
        by_delay = [-matrix[:, j, None] * change[j] for j in range(self.k)]
        by_gain = [-matrix[:, j, None] / theta[self.k + j] * m[j] for j in range(self.k)]
        by_angle = [-self._matrix(theta, np.pi / 2.0) @ m] if self.k == 2 else []
        return self.Y - matrix @ m, np.array(by_delay + by_gain + by_angle)

    def fit(self, start: _Fit, ties: Array, steps: int) -> _Fit:
        """Take damped Newton steps with the expected second derivatives; ties : theta by its free numbers (p, q)."""
        theta, spectra = start.theta, list(start.spectra)
        cells = [
            Cells(self.f, np.zeros_like(self.f), np.ones_like(self.f), [p.omega / (2.0 * np.pi) for p in s.resonances])
            for s in spectra
        ]
        lower, held = np.minimum(theta[: self.k].astype(int), LONGEST), 1e-3
        best, F = np.inf, np.zeros((0, 0))
        theta_there, spectra_there, lower_there = theta, spectra, lower
        step = gradient = np.zeros(0)
        for _ in range(steps):
            Z, dZ = self.z(theta_there, lower_there)
            for cell, z in zip(cells, Z, strict=True):
                cell.mean = _means(np.abs(z) ** 2, cell)
            there = sum(spectrum_negative_log_likelihood(s, cell) for s, cell in zip(spectra_there, cells, strict=True))
            gain = best - there
            crossed = (lower_there != lower).any()
            if gain >= 0:
                theta, spectra, lower, best, held = theta_there, spectra_there, lower_there, there, 0.2 * held
                F, gradient = self._second_derivatives(dZ, Z, spectra, cells, ties)
                if gain < ENOUGH and not crossed:
                    break
            else:
                held = max(10.0 * held, 1e-3)
                if held > 1e4:
                    break
            step = np.linalg.solve(F + np.diag(held * np.diag(F) + 1e-9), -gradient)
            q = ties.shape[1]
            theta_there = theta + np.clip(ties @ step[:q], -REACH, REACH)
            theta_there, lower_there = self._within(theta_there, lower)
            spectra_there, at = [], q
            for s in spectra:
                vector, free = s.vector.copy(), _free(s)
                vector[free] += np.clip(step[at : at + len(free)], -1.0, 1.0)
                at += len(free)
                spectra_there.append(s.with_vector(vector))
        covariance = np.linalg.inv(F)[: ties.shape[1], : ties.shape[1]] * inflation(self.n)
        covariance /= 1.0 - max(missing.is_missing.mean() for missing in self.missing)  # filled ones tell nothing
        return _Fit(theta, spectra, float(best), ties @ covariance @ ties.T, self.f.size)

    def _within(self, theta: Array, lower: Array) -> tuple[Array, Array]:
        """Stop delays at the next whole number, where the derivative changes; they go on from there in the next step."""
        theta, out = theta.copy(), lower.copy()
        for j, d in enumerate(lower):
            if theta[j] >= d + 1:
                theta[j], out[j] = d + 1, min(d + 1, LONGEST)
            elif theta[j] <= d:
                theta[j], out[j] = d, max(d - 1, 1)
        return theta, out

    def _second_derivatives(
        self, dZ: Array, Z: Array, spectra: Sequence[Spectrum], cells: Sequence[Cells], ties: Array
    ) -> tuple[Array, Array]:
        """Return the expected second derivatives and the gradient of - log L by the free numbers of plant and spectra."""
        dZ = np.tensordot(ties.T, dZ, 1)
        q = len(dZ)
        size = q + sum(len(_free(s)) for s in spectra)
        F, gradient, at = np.zeros((size, size)), np.zeros(size), q
        for i, (s, cell) in enumerate(zip(spectra, cells, strict=True)):
            S, free = s.psd(cell.frequency), _free(s)
            slopes, own = s.slopes(cell.frequency, free) / S, slice(at, at + len(free))
            weighted = dZ[:, i] / np.repeat(S, cell.count.astype(int))
            by_cell = 2.0 * np.add.reduceat(np.real(np.conj(Z[i]) * weighted), _edges(cell), axis=1)
            gradient[:q] += by_cell.sum(axis=1)
            gradient[own] = slopes @ (cell.count * (1.0 - cell.mean / S))
            F[:q, :q] += 2.0 * np.real(weighted @ dZ[:, i].conj().T)
            smooth = np.array([np.interp(cell.frequency, *self._band_means(x / cell.count, cell)) for x in by_cell])
            smooth = smooth.reshape(q, len(cell.count))
            F[:q, own] = -(smooth * cell.count) @ slopes.T
            F[own, own] = (slopes * cell.count) @ slopes.T + LOOSE * np.eye(len(free))
            at += len(free)
        F[q:, :q] = F[:q, q:].T
        return F, gradient

    def _band_means(self, x: Array, cell: Cells) -> tuple[Array, Array]:
        """Return frequencies and means of x over bands: as Z times its derivatives over S, it is smooth but for its scatter."""
        band = np.cumsum(cell.count / (NARROW + BAND * self.n * self.dt * cell.frequency)).astype(int)
        weight = np.bincount(band, cell.count)
        some = weight > 0
        frequency, mean = (np.bincount(band, cell.count * one)[some] / weight[some] for one in (cell.frequency, x))
        return frequency, mean

    def uncertainty(self, fit: _Fit) -> float:
        """Return the 95 % limit of the rms of the error of z over the rms of z, in the worst octave."""
        Z, dZ = self.z(fit.theta, np.minimum(fit.theta[: self.k].astype(int), LONGEST))
        values, vectors = np.linalg.eigh(fit.covariance)
        dZ = np.tensordot((vectors * np.sqrt(np.maximum(values, 0.0))).T, dZ, 1)
        low, worst = 1.0, 0.0
        while low < 0.25 / self.dt:
            octave = (self.f >= low) & (self.f < min(2.0 * low, 0.25 / self.dt))
            for i in range(self.k if octave.any() else 0):
                part = dZ[:, i, octave]
                sizes = np.maximum(np.linalg.eigvalsh(np.real(part @ part.conj().T)), 0.0)
                freedom = sizes.sum() ** 2 / max((sizes**2).sum(), 1e-300)  # as of a multiple of chi squared
                limit = sizes.sum() * chi2.ppf(0.95, freedom) / freedom if freedom > 0 else 0.0
                worst = max(worst, limit / max(float(np.sum(np.abs(Z[i, octave]) ** 2)), 1e-300))
            low *= 2.0
        return float(np.sqrt(worst))


def _rotation(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _angle(matrix: Array) -> float:
    """Return the angle of the rotation that is nearest to a matrix (2, 2)."""
    return float(np.arctan2(matrix[1, 0] - matrix[0, 1], matrix[0, 0] + matrix[1, 1]))


def _third_order(s: Spectrum, corner: float) -> Spectrum:
    """Return a spectrum whose turbulence has a third corner, over the first two."""
    return replace(s, turbulence=behind_pole(t, corner * t.omega)) if isinstance(t := s.turbulence, Ar2) else s


def _free(s: Spectrum) -> list[int]:
    return [i for i in range(s.starts[-1]) if i not in s.fixed_parameters]


def _edges(cells: Cells) -> Array:
    return np.concatenate([[0], np.cumsum(cells.count)[:-1]]).astype(int)


def _means(x: Array, cells: Cells) -> Array:
    return np.add.reduceat(x, _edges(cells)) / cells.count


def _first_guess(data: _Data) -> tuple[Array, float]:
    """Return a plant to start from, but for its delay, and the share of what is new in u that y does not explain.

    Sign and angle are those under which the commands reduce what is new in the measurements, or, where most of the commands does
    not follow from them, those of the strongest response to it; the gain is 1 or, where that is far
    off, as of other units, the one that makes the response of the disturbance smoothest: with w[k] the error of the prediction of
    y[k] from the past, h[i] = cov(y[k+i], w[k]) / var(w) and g[i] the same of u, that response is h[i] - gain R g[i - delay].
    """
    y, u, k = data.filled_y, data.u[0], data.k
    n = data.n - ORDER
    past = np.column_stack([x[ORDER - i : ORDER - i + n] for x in (y, u) for i in range(1, ORDER + 1)])
    w, v = (x[ORDER:] - past @ np.linalg.lstsq(past, x[ORDER:], rcond=1e-10)[0] for x in (y, u))
    turn = -np.linalg.lstsq(w, v, rcond=None)[0]
    own = v + w @ turn
    excited = float(np.sum(own**2) / max(np.sum(v**2), 1e-300))
    source, basis = w if excited < 0.5 else own, np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, SPAN), DEGREE + 1))[0]
    source = source[: n - SPAN]
    inverse = np.linalg.inv(source.T @ source)
    h, g = (np.array([x[ORDER + i : ORDER + i + len(source)].T @ source @ inverse for i in range(SPAN + 1)]) for x in (y, u))
    if excited >= 0.5:  # commands of their own: what they do is seen directly
        turn = max(h[1:], key=np.linalg.norm)
    flip = np.diag([1.0, np.sign(np.linalg.det(turn))]) if k == 2 else np.sign(turn)
    angle = _angle(turn @ flip) if k == 2 else 0.0
    R = _rotation(angle)[:k, :k] @ flip

    def rough(x: Array) -> Array:
        """Return what a polynomial leaves of responses (SPAN, k, k)."""
        return x - np.tensordot(basis @ basis.T, x, 1)

    best = (0.0, 1.0)
    for delay in range(1, LONGEST + 1):
        seen = R @ rough(np.concatenate([np.zeros((delay - 1, k, k)), g[: SPAN - delay + 1]]))
        product, power = float(np.sum(rough(h[1:]) * seen)), float(np.sum(seen**2))
        if product > 0:
            best = max(best, (product**2 / power, product / power))
    explained = best[0] > 0.5 * np.sum(rough(h[1:]) ** 2)
    gain = best[1] if explained and not FAR < best[1] < 1.0 / FAR else 1.0
    return np.concatenate([np.zeros(k), gain * np.diag(flip), [angle] * (k == 2)]), excited
