"""The plant of a closed loop, from its commands and measurements: delay, gain and rotation, with standard deviations.

They are likeliest together with the spectra of the disturbance. Without a probe, and under one linear controller, any plant under
which the loop would be stable fits some spectrum: the result is as good as the form of the disturbance is that it assumes.

`stated_plant` tests whether the data exclude the sign, delay, gain or rotation of commands as they were stated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.linalg import block_diag
from scipy.special import chdtri

from wfsobs.identification.plant_likelihood import (
    LONGEST,
    MOST_PEAKS,
    SHAPES,
    PlantFit,
    PlantLikelihood,
    Response,
    few_lags,
    guess_plant,
    known_signals,
    second_order,
)
from wfsobs.identification.process import Number, format_number
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError
from wfsobs.sensors.zernike import MODE_NAMES, TIP_TILT, noll
from wfsobs.signal.autoregressive import Ar2
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.quick import behind_pole
from wfsobs.typing import Array

SHORTEST, MOST_STEPS = 1000, 100_000
"""Minimum frames of a record; frames that are looked at, its first."""

MOST_MISSING, MOST_RECORD_LOSS = 0.2, 0.03
"""Share of missing frames beyond which no plant is identified or excluded: with a third of them a shorter delay is likelier. The
second one holds where the controller received them and there is no probe: 5 % are then enough for that."""

FROZEN = 100
"""Frames in a row with the same measurement that are taken for one that was not renewed."""

STARTS, REFINED, SAME, REFINEMENTS = (1.25, 2.25, 3.25, 4.5), 2, 0.05, 3
"""Delays at which a search starts [frames]; how many of the likeliest maxima are then fitted with all peaks, and how often;
distance below which two maxima are one."""

THIRD = (1.5, 6.0)
"""Third corners of turbulence, over the first two, that are tried."""

RIVAL, APART = 4.0, 4.0
"""Another maximum counts if its log-likelihood is lower by no more than this, and if it is as many standard deviations away."""

STEP, MOST, NEGLIGIBLE, ACROSS = (0.002, 0.1), 16, 6.0, 0.2
"""Of the delays at which the likelihood is looked at: distance at least and at most [frames], most of them on either side of a
maximum, and by how much lower the log-likelihood is where the last one is; where the search in the next frame begins."""

WIDEST_DELAY, WIDEST_GAIN, WIDEST_ANGLE = 0.25, 0.25, np.radians(15.0)
"""Standard deviation, of the gain over itself, beyond which a number is not identifiable."""

DIFFERS = 0.001
"""Probability with which two modes of one delay, or of one gain, are taken for different."""

EXCITED = 1e-3
"""Share of what is new in the commands that the measurements do not explain, from which on they have a probe."""

PROBED, OTHERWISE, SWINGS = 0.05, 1e-4, 1.0
"""Share of a probe from which the mirror's dynamics are estimated, and the residual tested for what is left of the probe;
probability below which this test rejects the plant; log-likelihood ratio from which a second-order mirror replaces few lags."""


@dataclass(frozen=True)
class PlantNumber:
    """A number and its standard deviation; both None where it is not identifiable."""

    value: float | None = None
    sd: float | None = None

    def text(self, unit: str = "") -> str:
        """Return it with its standard deviation, in two digits of that."""
        if self.value is None or self.sd is None:
            return "not identifiable"
        return format_number(Number(self.value, self.sd)) + unit


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
    covariance : Array
        Of delays [frames], gains and, of two modes, the rotation [rad] together.
    swinging : PlantFit or None
        Fit of a second-order mirror, where a probe shows dynamics and no other response is more likely by `RIVAL`: delays, gains
        and rotation, then the logarithms of natural frequency over frame rate and of damping ratio.
    chance, rigid : float
        Probability that what the measurements hold of a probe beside this plant, and beside one of a delay and a gain alone, is
        chance; where the first is below `OTHERWISE` nothing is identifiable. 1 where a probe is small.
    record_loss : float
        Share of frames that are missing although the controller received them, where without a probe it is above
        `MOST_RECORD_LOSS`: nothing is identifiable then. Otherwise 0.
    loop_loss : float
        Share of frames that are missing because the controller did not receive them either.
    outlying_commands : int
        Commands that the mirror cannot have received (`not_received`): taken as lost.
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
    covariance: Array = field(repr=False, compare=False)
    chance: float = 1.0
    rigid: float = 1.0
    record_loss: float = 0.0
    loop_loss: float = 0.0
    swinging: PlantFit | None = field(default=None, repr=False, compare=False)
    outlying_commands: int = 0

    @property
    def has_dynamics(self) -> bool:
        """Whether a probe shows that the mirror does more than delay."""
        return self.rigid < OTHERWISE

    def numbers(self, subject: str) -> tuple[PlantNumber, ...]:
        """Return the "delay" or the "gain", one number where the modes do not differ in it."""
        one: PlantNumber = getattr(self, f"common_{subject}")
        return (one,) if one.value is not None else getattr(self, subject)

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
        The record is too short, too much of a mode is missing, or its commands or measurements do not move.
    Cancelled
        `watch` asks to stop.
    """
    y, u = known_signals(record, MOST_STEPS)
    outlying = int(np.isnan(u).any(axis=1).sum() - np.isnan(record.u[: len(u)]).any(axis=1).sum())
    if len(y) < SHORTEST:
        raise RecordError(f"the record has {len(y)} frames, the plant needs {SHORTEST}")
    for name, gone in zip(MODE_NAMES, np.isnan(y).mean(axis=0).tolist(), strict=False):
        if gone > MOST_MISSING:
            what = "of the frames are missing, or follow a lost command"
            raise RecordError(f"{name}: {100.0 * gone:.0f} % {what}; at most {100.0 * MOST_MISSING:.0f} %")
    out = []
    groups = list(_groups(record.n_modes))
    for i, columns in enumerate(groups):
        watch.check()
        names = tuple(MODE_NAMES[c] for c in columns)
        _check_motion(names, y[:, columns], u[:, columns])
        out.append(replace(_identify_group(names, y[:, columns], u[:, columns], record.dt), outlying_commands=outlying))
        watch.step((i + 1) / len(groups))
    return tuple(out)


def _check_motion(names: tuple[str, ...], y: Array, u: Array) -> None:
    """Raise RecordError where commands or measurements of a group do not tell what the plant does."""
    for signals, what in ((u, "commands"), (y, "measurements")):
        moves = np.fmax.reduce(signals) > np.fmin.reduce(signals)
        if still := [name for name, it_does in zip(names, moves, strict=True) if not it_does]:
            raise RecordError(f"the {what} of {' and '.join(still)} do not move: there is no plant to identify")
        if len(names) == 2 and np.array_equal(signals[:, 0], signals[:, 1], equal_nan=True):
            raise RecordError(f"the {what} of {' and '.join(names)} are the same: there is no plant to identify")
    changes = np.flatnonzero(np.append(True, (np.diff(y, axis=0) != 0).any(axis=1)))  # NaN is a change
    length = np.diff(np.append(changes, len(y)))
    longest = int(length.argmax())
    if length[longest] > FROZEN:
        raise RecordError(
            f"the measurements of {' and '.join(names)} stay the same for {length[longest]} frames "
            f"from frame {changes[longest]} on: leave out what is not measured"
        )


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
    number = " to ".join(dict.fromkeys(f"{n(peaks)}" for n in (min, max)))
    form = f"white noise, turbulence of second or third order, {colour}resonances per mode: {number}"
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
    otherwise = [
        f"{' and '.join(g.modes)}: the probe acts otherwise than {through} (probability {chance:.0e})"
        for g in groups
        for chance, through in (
            (g.rigid, "by a delay and a gain: the mirror has dynamics"),
            (g.chance, "by any mirror of second order"),
        )
        if chance < OTHERWISE
    ]
    unrecorded = [
        f"{' and '.join(g.modes)}: {100.0 * g.record_loss:.2g} % of the frames that the controller received are missing: "
        f"without a probe no plant is identifiable beyond {100.0 * MOST_RECORD_LOSS:g} %"
        for g in groups
        if g.record_loss
    ]
    loss, outlying = max(group.loop_loss for group in groups), groups[0].outlying_commands
    missed = f"{100.0 * loss:.2g} % of the frames are missing: by its commands, the controller did not receive them either"
    return [
        *otherwise,
        *unrecorded,
        *[missed] * (loss > 0.0),
        *[f"commands taken as lost: {outlying}, far from those around them, and no measurement shows them"] * (outlying > 0),
        "gain: of mirror and sensor (optical gain) together, which cannot be told apart; negative of a flipped axis",
        "delay: group delay at low frequencies, that of the mirror included",
        f"disturbance: {form}; {basis}",
        f"the pseudo-open-loop is trustworthy {trust}",
    ]


def _groups(n_modes: int) -> Iterator[list[int]]:
    """Yield the columns of every mode without azimuthal order and every pair of one."""
    orders = [noll(j) for j in range(2, n_modes + 2)]
    for order in dict.fromkeys((n, abs(m)) for n, m in orders):
        yield [i for i, (n, m) in enumerate(orders) if (n, abs(m)) == order]


def _identify_group(names: tuple[str, ...], y: Array, u: Array, dt: float) -> GroupPlant:
    data, k = PlantLikelihood(y, u, dt), len(names)
    guess, excited, own = guess_plant(data)
    pooled = np.zeros((2 * k + (k == 2), 2 + (k == 2)))
    pooled[:k, 0], pooled[k : 2 * k, 1], pooled[2 * k :, 2:] = 1.0, np.sign(guess[k : 2 * k]), 1.0
    fits: list[PlantFit] = []
    spectra: Sequence[Spectrum] = ()
    for delay in STARTS:
        start = np.concatenate([np.full(k, delay), guess[k:]])
        fits.append(data.fit(data.with_spectra(start, spectra), pooled))
        spectra = fits[-1].spectra
    first, *others = sorted(fits, key=lambda fit: fit.criterion)
    fits = [first, *(fit for fit in others if abs(fit.theta[0] - first.theta[0]) > SAME)][:REFINED]
    gains = np.column_stack([pooled[:, 0], np.eye(len(pooled))[:, k:]])
    for again in range(REFINEMENTS):
        more = [data.fit(data.with_spectra(fit.theta, fit.spectra, MOST_PEAKS), gains) for fit in fits]
        better = [new.criterion < old.criterion - 1.0 for old, new in zip(fits, more, strict=True)]
        before = fits if again else [data.fit(fit, gains) for fit in fits]  # with gains of their own as well
        fits = [_likeliest(*pair) for pair in zip(before, more, strict=True)]
        if not any(better):
            break
    each = _likeliest(*fits)
    coloured = data.with_spectra(each.theta, each.spectra, MOST_PEAKS, plain=False)
    if any(s.background for s in coloured.spectra):
        each = _likeliest(each, data.fit(coloured, gains))
    for corner in THIRD:
        third = [_third_order(s, corner) for s in each.spectra]
        each = _likeliest(each, data.fit(replace(each, spectra=third), gains))
    apart = data.fit(each, np.eye(len(pooled)))
    together = np.append(np.full(k, apart.theta[:k].mean()), apart.theta[k:])
    each = _likeliest(each, data.fit(replace(apart, theta=together), gains))
    one_delay = each.value - apart.value <= 0.5 * chdtri(1, DIFFERS)
    rivals = [fit.theta - each.theta for fit in fits if fit.criterion - each.criterion < RIVAL]
    both = np.column_stack([pooled[:, 0], np.eye(len(pooled))[:, 1:]])
    each, ties = (_over_delays(data, each, gains), gains) if one_delay else (_over_delays(data, apart, both), both)
    chance, rigid, mirror, swinging = 1.0, 1.0, each, None
    gone = max(float(missing.is_missing.mean()) for missing in data.missing)
    record_loss = gone * (not data.is_blind and gone > MOST_RECORD_LOSS and excited <= PROBED)
    loop_loss = float(np.isnan(y).any(axis=1).mean()) * data.is_blind
    if excited > PROBED:
        rigid, (mirror, swinging) = data.response_left(each, own), _with_dynamics(data, each, ties)
        chance = data.response_left(mirror, own)
        each = replace(each, theta=mirror.theta[: data.size], covariance=mirror.covariance[: data.size, : data.size])
    equal = np.zeros(len(pooled))
    equal[k : 2 * k] = np.sign(each.theta[k : 2 * k]) * ([1.0, -1.0] if k == 2 else 0.0)
    variance, off = equal @ each.covariance @ equal, equal @ each.theta
    one_gain = off**2 <= chdtri(1, DIFFERS) * variance
    common = each
    if variance and one_delay and one_gain:  # given that the gains are one
        gain_of = each.covariance @ equal / variance
        common = replace(
            each, theta=each.theta - off * gain_of, covariance=each.covariance - np.outer(gain_of, gain_of) * variance
        )

    def number(fit: PlantFit, i: int) -> PlantNumber:
        """Return a number of the plant, if it is near enough to that of every other plant that is as likely."""
        value, sd = float(fit.theta[i]), float(np.sqrt(max(fit.covariance[i, i], 0.0)))
        widest = WIDEST_DELAY if i < k else WIDEST_GAIN * abs(value) if i < 2 * k else WIDEST_ANGLE
        near = all(abs(rival[i]) <= APART * sd for rival in rivals)
        return PlantNumber(value, sd) if near and 0.0 < sd < widest and chance >= OTHERWISE and not record_loss else PlantNumber()

    delay, gain = tuple(number(each, i) for i in range(k)), tuple(number(each, k + i) for i in range(k))
    rotation = number(each, 2 * k) if k == 2 else None
    common_delay = number(common, 0) if one_delay else PlantNumber()
    common_gain = number(common, k) if one_delay and one_gain else PlantNumber()
    if common_gain.value is not None:
        common_gain = replace(common_gain, value=abs(common_gain.value))
    if rotation is not None and rotation.value is not None:
        rotation = replace(rotation, value=float(-((np.pi - rotation.value) % (2.0 * np.pi) - np.pi)))
    is_known = all(n.value is not None for n in (*delay, *gain))
    uncertainty = data.uncertainty(each, mirror if rigid < OTHERWISE else each) if is_known else np.inf
    peaks, coloured = tuple(len(s.resonances) for s in each.spectra), any(s.background for s in each.spectra)
    numbers = delay, gain, rotation, common_delay, common_gain
    swinging = replace(swinging, fill=None) if swinging and rigid < OTHERWISE <= chance else None
    return GroupPlant(
        names, *numbers, uncertainty, peaks, coloured, excited, each.covariance, chance, rigid, record_loss, loop_loss, swinging
    )


def _likeliest(*fits: PlantFit) -> PlantFit:
    """Return the fit with the best criterion."""
    return min(fits, key=lambda fit: fit.criterion)


def _with_dynamics(data: PlantLikelihood, fit: PlantFit, ties: Array) -> tuple[PlantFit, PlantFit | None]:
    """Fit a mirror with dynamics.

    Returns the response over few lags, or the second-order one where its log-likelihood is larger by SWINGS; and the second-order
    one, None where its log-likelihood is smaller by RIVAL.
    """
    ties, fill = block_diag(ties, np.eye(2)), data.fill(fit.theta, fit.spectra)

    def of(mirror: Response, shape: Sequence[float]) -> PlantFit:
        return data.newton_fit(replace(fit, theta=np.append(fit.theta, shape), mirror=mirror, fill=fill), ties)

    few = of(partial(few_lags, int(fit.theta[: data.k].mean())), (0.0, 0.0))
    swinging = min((of(second_order, shape) for shape in SHAPES), key=lambda one: one.value)
    better = few.value - swinging.value
    return swinging if better > SWINGS else few, swinging if better > -RIVAL else None


def _over_delays(data: PlantLikelihood, fit: PlantFit, ties: Array) -> PlantFit:
    """Return a fit with the mean and the covariance of its likelihood over the delay, all else likeliest for each.

    That has a kink at whole numbers of frames, often a maximum on either side, and is no parabola where little is known. Each
    frame is looked at by steps of its own; the first number of the ties is the delay.
    """
    k, lower = data.k, np.floor(fit.theta[: data.k])
    points = list[tuple[float, PlantFit]]()  # weight but for the likelihood
    tops = [fit]
    for frame, place in ((-1, 1.0 - ACROSS), (0, 0.0), (1, ACROSS)):
        if lower.min() + frame < 1 or lower.max() + frame >= LONGEST:
            continue
        theta = fit.theta.copy()
        theta[:k] = lower + frame + (place or theta[:k] - lower)
        top = data.newton_fit(replace(fit, theta=theta), ties, stays=True)
        tops.append(top)
        if top.value - min(one.value for one in tops) < NEGLIGIBLE:
            points += _along(data, top, ties[:, 1:], lower + frame)
    if not points:  # a likelihood that is no number
        return fit
    best = min((one for _, one in points), key=lambda one: one.value)
    if best.value < fit.value - 1.0:  # with spectra that are likelier in the other frames, too
        return _over_delays(data, best, ties)
    weights = np.array([width * np.exp(best.value - one.value) for width, one in points])
    weights /= weights.sum()
    theta = sum((w * one.theta for w, (_, one) in zip(weights, points, strict=True)), np.zeros_like(fit.theta))
    off = [one.theta - theta for _, one in points]
    parts = [w * (one.covariance + np.outer(d, d)) for w, (_, one), d in zip(weights, points, off, strict=True)]
    return replace(best, theta=theta, covariance=np.sum(parts, axis=0))


def _along(data: PlantLikelihood, top: PlantFit, rest: Array, lower: Array) -> list[tuple[float, PlantFit]]:
    """Return (step, fit) at delays around a maximum within a frame, evenly spaced; rest : ties of all other numbers."""
    k = data.k
    step = float(np.clip(0.5 * np.sqrt(max(top.covariance[:k, :k].mean(), 0.0)), *STEP))

    def at(near: PlantFit, shift: float) -> PlantFit:
        theta = near.theta.copy()
        theta[:k] = np.clip(theta[:k] + shift, lower, lower + 1.0)
        return data.newton_fit(replace(near, theta=theta), rest)

    found = {0: at(top, 0.0)}
    for way in (-1, 1):
        last = 0
        for i in range(way, way * (MOST + 1), way):
            ahead = found[last].theta[:k] + way * step
            if (ahead < lower).any() or (ahead > lower + 1.0).any() or found[last].value - found[0].value > NEGLIGIBLE:
                break
            found[i], last = at(found[last], way * step), i
        for i in range(last - way, -way, -way):  # back: what a fit has missed
            found[i] = min(found[i], at(found[i + way], -way * step), key=lambda one: one.value)
    return [(step, one) for one in found.values()]


def _third_order(s: Spectrum, corner: float) -> Spectrum:
    """Return a spectrum whose turbulence has a third corner, over the first two."""
    return replace(s, turbulence=behind_pole(t, corner * t.omega)) if isinstance(t := s.turbulence, Ar2) else s


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


@dataclass(frozen=True)
class Contradiction:
    """Why the data exclude how a record was read.

    Attributes
    ----------
    text : str
        In a line.
    proposal : dict of str to float
        What to state in place of the sign or the delay, by the names of `DeclaredFormat`; empty where it is something else.
    """

    text: str
    proposal: dict[str, float] = field(default_factory=dict)


def contradiction(
    record: Record, sign: int = 1, delay: float | None = None, gain: Sequence[float] = (1.0,)
) -> Contradiction | None:
    """Return why the data exclude the plant with which a record was read; None where they do not.

    The likeliest plant near the stated one, of tip and tilt over CHECKED frames, is compared with the stated one, each with the
    spectra that are likeliest for it. A loop that reduces an error tells sign and rotation besides, where what is new in its
    commands follows from the measurement of the row. What else is in them may be rounding or noise of their read-back, which
    the mirror does not follow: the stated plant is tried without it, too. This takes a tenth of the time of `identify_plant`,
    which looks farther.

    Parameters
    ----------
    record : Record
        As it was read: y = disturbance + u, `record.delay` steps later.
    sign, delay, gain : int, float, sequence of float
        Sign, delay and gain of the commands as they were stated, for the line alone.
    """
    y, u = (x[:, : len(TIP_TILT)] for x in known_signals(record, CHECKED))
    moving = np.flatnonzero(np.fmax.reduce(u) > np.fmin.reduce(u))
    if len(y) < SHORTEST or not moving.size or record.delay > LONGEST or np.isnan(y).mean(axis=0).max() > MOST_MISSING:
        return None
    y, u = (x[:, moving] / np.nanstd(y) for x in (y, u))
    with suppress(np.linalg.LinAlgError), np.errstate(all="ignore"):  # numbers without noise decide nothing
        return _contradiction_of(PlantLikelihood(y, u, record.dt), record.delay, (sign, delay or record.delay, gain), moving)
    return None


def _contradiction_of(
    data: PlantLikelihood, delay: int, statement: tuple[int, float, Sequence[float]], moving: Array
) -> Contradiction | None:
    k, (guess, excited, own) = moving.size, guess_plant(data)
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
        return None
    unseen = data.without(own)  # where that is an error of the record: neither the loop nor the mirror knows it

    def finish(some: PlantLikelihood, fit: PlantFit, free: Array) -> PlantFit:
        return some.fit(some.with_spectra(fit.theta, fit.spectra, MOST_PEAKS, plain=False), free)

    acts, is_lost = (finish(some, new, ties) for some in (data, unseen))
    new = _likeliest(acts, is_lost)
    # where nothing excites the loop, a plant is known as well as the form of the background
    rests_on_form = any(s.background for s in new.spectra) and (excited < EXCITED or new is is_lost) and not is_turned
    none = np.concatenate([stated[:k], np.full(k, 1e-9), stated[2 * k :]])
    olds = (data, stated), (data, none), (unseen, stated)
    starts = [(some, some.with_spectra(theta)) for some, theta in olds]  # all before the gaps are filled for one
    old = _likeliest(*(finish(*start, ties[:, :0]) for start in starts))
    worth, better = old.criterion - new.criterion, _what_is_off(new, stated, names, ways)
    if not worth > CLEAR * (FORM if rests_on_form else 1.0) or not better:
        return None
    what, there, proposal = better
    text = f"command {what} is excluded by the data, which are likelier by {worth:.0f} (log-likelihood) with {there}"
    return Contradiction(text, proposal)


def _nearest(data: PlantLikelihood, theta: Array, ties: Array) -> PlantFit:
    """Fit a plant from a start, its spectra first."""
    begin = data.with_spectra(theta)
    if any(missing.any for missing in data.missing):  # no longer filled by straight lines
        begin = data.with_spectra(theta, begin.spectra)
    return data.fit(begin, ties)


def _is_far(fit: PlantFit) -> bool:
    """Return whether commands follow nothing, or are of another unit."""
    k = (len(fit.theta) + 1) // 3
    gains = fit.theta[k : 2 * k]
    return bool(np.any((gains < NEAR[0]) | (gains > NEAR[1])))


def _what_is_off(
    fit: PlantFit, theta: Array, names: Sequence[str], ways: tuple[int, float, Array]
) -> tuple[str, str, dict[str, float]] | None:
    """Return what of a stated plant is off the fitted one, what it is there, and what to state; None where nothing is.

    ways : sign, delay and gains as they were stated
    """
    k, (sign, delay, gains) = len(names), ways
    sd, off = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0)), fit.theta - theta
    least = np.array([OFF_DELAY] * k + [OFF_GAIN] * k + [np.radians(TURNED)] * (k - 1))
    is_off: Array = np.abs(off) > np.maximum(SURE * sd, np.where(sd > 0.0, least, np.inf))
    turn, is_flipped = float(np.degrees(off[-1])) if k == 2 else 0.0, fit.theta[k : 2 * k] < 0
    late = delay + float(off[0])
    delays: dict[str, float] = {}
    if is_off[0]:  # no number is off that is none
        delays["command_delay"] = round(late) if abs(late - round(late)) < 3.0 * sd[0] else float(f"{late:.3g}")
    if is_flipped.any() and not is_flipped.all():
        return f"sign {sign:+d} of {names[int(abs(turn) < 90.0)]}", f"{-sign:+d}, and that of the other mode as it is", {}
    if is_flipped.any() or abs(turn) > 135.0:
        return f"sign {sign:+d}", f"{-sign:+d}", {"command_sign": -sign, **delays}
    if is_off[0]:
        return f"delay {delay:g}", PlantNumber(late, float(sd[0])).text(), delays
    if is_off[2 * k :].any():
        return "rotation 0", f"{turn:+.1f} degrees, y = R u: state the inverse of R as --command-modes of wfsobs convert", {}
    for i in np.flatnonzero(is_off[k : 2 * k]).tolist():
        of = f" of {names[i]}" * (k == 2)
        return f"gain {gains[i]:g}{of}", PlantNumber(*(float(gains[i] * x) for x in (fit.theta[k + i], sd[k + i]))).text(), {}
    return None
