"""Whether the data of a record exclude the sign, delay, gain or rotation of its commands as they were stated."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from wfsobs.identification.plant import EXCITED, SHORTEST, PlantNumber
from wfsobs.identification.plant_likelihood import (
    LONGEST,
    MOST_PEAKS,
    STEPS,
    PlantFit,
    PlantLikelihood,
    guess_plant,
    known_signals,
)
from wfsobs.record import Record
from wfsobs.sensors.modes import TIP_TILT
from wfsobs.typing import Array

CHECKED, CLEAR, SURE = 20_000, 30.0, 6.0
"""Of a plant that is excluded: frames that are looked at, the first; log-likelihood by which, after Schwarz, another is better;
standard deviations by which it is off."""

FORM = 10.0
"""How many times as much where it rests on the form of a background."""

REVERSED = 0.5
"""Share of what is new in the commands that the measurements do not explain, beyond which their signs say nothing."""

MOST_MISSING = 0.2
"""Share of missing frames beyond which nothing is excluded: where a third is missing a shorter delay seems likelier."""

NEAR = (0.3, 1.7)
"""Gains between which a plant is near a stated one."""

OFF_DELAY, OFF_GAIN, TURNED = 0.2, 0.1, 10.0
"""Distance of a delay [frames], a gain and an angle [degrees] from what is stated below which a record is not refused."""


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
    y, u = (x[:, : len(TIP_TILT)] for x in known_signals(record, CHECKED))
    moving = np.flatnonzero(np.ptp(u, axis=0) > 0)
    if len(y) < SHORTEST or not moving.size or record.delay > LONGEST or np.isnan(y).mean(axis=0).max() > MOST_MISSING:
        return ""
    y, u = (x[:, moving] / np.nanstd(y) for x in (y, u))
    with suppress(np.linalg.LinAlgError), np.errstate(all="ignore"):  # numbers without noise decide nothing
        return _contradiction_of(PlantLikelihood(y, u, record.dt), record.delay, (sign, delay or record.delay, gain), moving)
    return ""


def _contradiction_of(data: PlantLikelihood, delay: int, statement: tuple[int, float, Sequence[float]], moving: Array) -> str:
    k, (guess, excited, _) = moving.size, guess_plant(data)
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


def _nearest(data: PlantLikelihood, theta: Array, ties: Array) -> PlantFit:
    """Fit a plant from a start, its spectra first."""
    begin = data.with_spectra(theta)
    if any(missing.any for missing in data.missing):  # no longer filled by straight lines
        begin = data.with_spectra(theta, begin.spectra)
    return data.fit(begin, ties, STEPS)


def _is_far(fit: PlantFit) -> bool:
    """Return whether commands follow nothing, or are of another unit."""
    k = (len(fit.theta) + 1) // 3
    gains = fit.theta[k : 2 * k]
    return bool(np.any((gains < NEAR[0]) | (gains > NEAR[1])))


def _what_is_off(fit: PlantFit, theta: Array, names: Sequence[str], ways: tuple[int, float, Array]) -> tuple[str, str] | None:
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
