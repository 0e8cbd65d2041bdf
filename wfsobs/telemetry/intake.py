"""From the named arrays of a file to a `Record`: the only check of shapes, units, signs and clocks.

A record has y_lgs and u (n_steps, n_modes) and dt or time; optionally frame (n_steps,), a count that skips missing frames, y_ngs
(n_steps, n_modes), NaN where there is no frame, or one row per frame, with ratio or time_ngs, the truth turbulence and vibration,
open_loop_y, lgs_stars (n_steps,), y_stars (n_steps, n_lgs, n_modes), and for the offline GPR training_y, training_u and
training_open_loop_y (n, n_modes).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from wfsobs.record import DELAY, Record, RecordError, Training
from wfsobs.scenario import Scenario
from wfsobs.sensors.modes import order_of
from wfsobs.telemetry import timestamps as clock
from wfsobs.telemetry.bridged import without_bridged
from wfsobs.telemetry.formats.contents import APART, FAST, FRAME, LARGEST, NGS, SIGNALS, STARS, TIME, TRAINING, Contents
from wfsobs.typing import Array
from wfsobs.units import ANGLES, micrometres_per, parse_unit

MOST_NAMED = 5
"""Maximum columns that are named as not used."""


@dataclass(frozen=True)
class DeclaredFormat:
    """What the user says of a file: used where the file says nothing, and never in contradiction to it.

    Attributes
    ----------
    unit : str or None
        Of y_lgs, u and the rest, one of wfsobs.units.UNITS; by default that of the signals that have one, or um.
    command_sign : int or None
        +1, y = disturbance + u, or -1, y = disturbance - u.
    command_delay : int or None
        Steps from a command to the first measurement that sees it, 1 or more.
    rate : float or None
        Rate of the fast steps [Hz].
    columns : mapping
        Which column of the file is what, {one of `wfsobs.telemetry.columns.ROLES`: name in the file}.
    trust : bool
        Whether sign and delay of the commands hold whatever the data say.
    """

    unit: str | None = None
    command_sign: int | None = None
    command_delay: int | None = None
    rate: float | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    trust: bool = False


def to_record(contents: Contents, scenario: Scenario, declaration: DeclaredFormat) -> Record:
    """Return the record of a file's contents. Raises RecordError with one line naming what, where and what is expected."""
    arrays = contents.arrays
    for name in ("y_lgs", "u"):
        if name not in arrays:
            raise RecordError(f"has no {name}; a record needs y_lgs, u and dt")
    signals = {name: _signal(name, arrays[name]) for name in SIGNALS if name in arrays}
    n, n_modes = signals["y_lgs"].shape
    most = len(scenario.modes)
    if not 1 <= n_modes <= most or n < 2:
        order = order_of(n_modes) if n_modes > most else None
        needed = f": {n_modes} modes need telescope.radial_order = {order}" if order else ""
        raise RecordError(f"y_lgs has shape {(n, n_modes)}; it takes (n_steps >= 2, 1 to {most} modes){needed}")
    for name in signals:
        rows = signals["training_y"].shape[0] if name in TRAINING and "training_y" in signals else n
        rows = signals[name].shape[0] if name == NGS else rows  # may have one row per frame
        if signals[name].shape != (rows, n_modes):
            raise RecordError(f"{name} has shape {signals[name].shape}; expected ({rows}, {n_modes})")
    if APART in arrays:
        signals[APART] = _stars_apart(arrays[APART], n, n_modes)
    origin, sign = _into_micrometres(signals, contents, declaration, scenario.telescope.diameter)
    for name in {"u", "training_u"} & signals.keys():
        signals[name] *= sign
    if STARS in arrays:
        signals[STARS] = _star_counts(arrays[STARS], n)
    dt, ratio, timing = _apply_timestamps(signals, contents, declaration)
    origin = ", ".join(filter(None, (origin, *contents.guesses, timing, _name_unused(contents.leftovers))))
    if np.isnan(signals["y_lgs"]).all(axis=0).any():
        raise RecordError("y_lgs holds no measurement of one of its modes")
    delay = _whole("delay", arrays, declaration.command_delay, DELAY)
    if delay < 1:
        raise RecordError(f"delay takes a whole number from 1, not {delay}")
    fields = {name: signals[name] for name in (*FAST, NGS) if name in signals}
    stars = np.nan_to_num(signals[STARS][:, 0]).astype(int) if STARS in signals else None
    apart = signals[APART].reshape(len(signals["y_lgs"]), -1, n_modes) if APART in signals else None
    beside = {"lgs_stars": stars, "y_stars": apart}
    record = Record(**fields, dt=dt, ratio=ratio, training=_training(signals), delay=delay, origin=origin, **beside)
    return record if stars is not None or record.missing else without_bridged(record)


def _signal(name: str, raw: Array) -> Array:
    """Return a signal as native float64 of its own, NaN where a sample is missing."""
    if raw.dtype.kind not in "fiu":
        raise RecordError(f"{name} holds {raw.dtype}, not numbers")
    if raw.ndim != 2:
        raise RecordError(f"{name} has shape {raw.shape}; expected (any, any)")
    out = np.array(raw, dtype=np.float64, order="C")
    bad = np.abs(out) > LARGEST if name not in TRAINING else ~(np.abs(out) <= LARGEST)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        most = f" up to {LARGEST:g}, NaN where one is missing" if np.isfinite(out[row, column]) else ""
        raise RecordError(f"{name} is {out[row, column]} at step {row}, mode {column}; it takes finite numbers{most}")
    return out


def _star_counts(raw: Array, n: int) -> Array:
    """Return how many LGS there are as a column, (n, 1)."""
    if raw.dtype.kind not in "fiu" or raw.shape != (n,) or not (np.isfinite(raw) & (raw >= 0) & (raw == np.round(raw))).all():
        raise RecordError(f"{STARS} takes {n} whole numbers from 0, not {raw.dtype} of shape {raw.shape}")
    return raw.astype(np.float64)[:, None]


def _stars_apart(raw: Array, n: int, n_modes: int) -> Array:
    """Return every LGS by itself, a column per star and mode, (n, n_lgs n_modes)."""
    if raw.ndim != 3 or raw.shape[::2] != (n, n_modes):
        raise RecordError(f"{APART} has shape {raw.shape}; expected ({n}, n_lgs, {n_modes})")
    return _signal(APART, raw.reshape(n, -1))


def _into_micrometres(
    signals: dict[str, Array], contents: Contents, declaration: DeclaredFormat, diameter: float
) -> tuple[str, int]:
    """Scale every signal to um; return (unit, sign and aperture as one line, sign of the commands)."""
    arrays, own = contents.arrays, contents.units
    if "unit" in arrays:
        if (unit := parse_unit(str(arrays["unit"]))) is None:
            raise RecordError(f"unit is {str(arrays['unit'])[:40]!r}, which is no unit of a wavefront")
        own = dict.fromkeys(signals, unit) | own
    for name, unit in own.items():
        if declaration.unit is not None and unit != declaration.unit:
            raise RecordError(f"{name} is in {unit}, but {declaration.unit} is stated")
    known = sorted({own[name] for name in signals if name in own})
    if len(known) > 1 and (silent := [name for name in signals if name not in own]):
        raise RecordError(f"{silent[0]} has no unit, where others have {' and '.join(known)}: give it one")
    units = {name: own.get(name, declaration.unit or (known or ["um"])[0]) for name in signals}
    if set(units.values()) & set(ANGLES) and signals["y_lgs"].shape[1] > 2:
        raise RecordError("angles are units of tip and tilt alone, which are two modes")
    for name, unit in units.items():
        signals[name] *= micrometres_per(unit, diameter)
    sign = _whole("command_sign", arrays, declaration.command_sign, 1)
    if sign not in (1, -1):
        raise RecordError(f"command_sign takes 1 or -1, not {sign}")
    said = [f"unit {unit}" for unit in dict.fromkeys(units.values()) if unit != "um"]
    said += [f"aperture {diameter:g} m"] * bool(set(units.values()) & set(ANGLES))
    said += ["command sign -1"] if sign < 0 else []
    return ", ".join([*([str(arrays["origin"])] if "origin" in arrays else []), *said]), sign


def _name_unused(columns: Sequence[str]) -> str:
    """Say which columns are no part of the record, in a few words; nothing where there is none."""
    more = f" and {len(columns) - MOST_NAMED} more" if len(columns) > MOST_NAMED else ""
    named = ", ".join(name[:40] for name in columns[:MOST_NAMED])
    return f"column{'s' * (len(columns) > 1)} {named}{more} not used" if columns else ""


def _apply_timestamps(
    signals: dict[str, Array], contents: Contents, declaration: DeclaredFormat
) -> tuple[float, int | None, str]:
    """Place the rows by the frame counter or their time stamps, and NGS frames beside them.

    Returns
    -------
    dt, ratio, said
        The fast step [s], the ratio, and what was guessed of the stamps.
    """
    arrays, n, said = contents.arrays, signals["y_lgs"].shape[0], ""
    dt = None if "dt" not in arrays else _number("dt", arrays["dt"])
    if declaration.rate is not None:
        if dt is not None and abs(dt * declaration.rate - 1.0) > clock.AGREE:
            raise RecordError(f"its rate is {1.0 / dt:.6g} Hz, but {declaration.rate:.6g} Hz are stated")
        dt = 1.0 / declaration.rate if dt is None else dt
    start = 0.0
    steps = clock.counted_steps(_clock(FRAME, arrays[FRAME], n)) if FRAME in arrays else None
    if TIME in arrays:
        time = _clock(TIME, arrays[TIME], n)
        steps, dt, said = clock.steps_of(time, dt, steps)
        start = float(time[0])
    if steps is not None:
        for name, values in signals.items():
            if name not in TRAINING and values.shape[0] == n:
                signals[name] = clock.place_rows(values, steps)
    if dt is None:
        there = f": which column is the time? It has {', '.join(contents.leftovers[:20])}" if contents.leftovers else ""
        raise RecordError(f"has no dt and no time; a record needs y_lgs, u and dt, or a stated rate{there}")
    if NGS not in signals:
        return dt, None, said
    if "time_ngs" in arrays:
        ratio = _stamped_frames(signals, arrays, start, dt)
    else:
        ratio = _whole("ratio", arrays)
        signals[NGS] = clock.place_frames(signals[NGS], signals["y_lgs"].shape[0], ratio)
    signals[NGS] = clock.drop_partial_frames(signals[NGS], ratio)
    return dt, ratio, said


def _stamped_frames(signals: dict[str, Array], arrays: Mapping[str, Array], start: float, dt: float) -> int:
    """Place the frames by their stamps, start the record `ratio` steps before a frame, and return the ratio."""
    frames, n = signals[NGS], signals["y_lgs"].shape[0]
    steps = clock.frames_at(_clock("time_ngs", arrays["time_ngs"], frames.shape[0]), start, dt)
    between = int(np.median(np.diff(steps))) if steps.size > 1 else None
    ratio = _whole("ratio", arrays, None, between)
    late = np.flatnonzero((steps - steps[0]) % ratio)
    if late.size:
        raise RecordError(f"time_ngs: the frame in row {late[0]} is not a whole number of {ratio} steps after the first")
    inside = (steps >= 0) & (steps < n)
    signals[NGS] = np.full((n, frames.shape[1]), np.nan)
    signals[NGS][steps[inside]] = frames[inside]
    for name in (*FAST, NGS, STARS, APART):
        if name in signals:
            signals[name] = signals[name][steps[0] % ratio :]
    return ratio


def _training(signals: Mapping[str, Array]) -> Training | None:
    found = [name for name in TRAINING[:2] if name in signals]
    if len(found) == 1:
        raise RecordError("training_y and training_u must come together")
    return Training(*(signals.get(name) for name in TRAINING)) if found else None  # type: ignore[arg-type]


def _clock(name: str, raw: Array, n: int) -> Array:
    if raw.dtype.kind not in "fiu" or raw.shape != (n,):
        raise RecordError(f"{name} takes {n} numbers, not {raw.dtype} of shape {raw.shape}")
    return raw.astype(np.float64)


def _number(name: str, raw: Array) -> float:
    if raw.ndim != 0 or raw.dtype.kind not in "fiu" or not np.isfinite(raw) or raw <= 0:
        raise RecordError(f"{name} takes one number above 0, not {np.array2string(raw, threshold=4)}")
    return float(raw)


def _whole(name: str, arrays: Mapping[str, Array], declaration: int | None = None, default: int | None = None) -> int:
    """Return an integer of the file, else the declared one, else the default."""
    if name not in arrays:
        if declaration is None and default is None:
            raise RecordError("y_ngs needs ratio, the number of fast steps per NGS frame")
        return int(declaration if declaration is not None else default)  # type: ignore[arg-type]
    value = float(raw) if (raw := arrays[name]).ndim == 0 and raw.dtype.kind in "fiu" else np.nan
    if value != round(value, 0) or (name == "ratio" and value <= 0):
        raise RecordError(f"{name} takes a whole number, not {value:g}")
    if declaration is not None and value != declaration:
        raise RecordError(f"{name} is {value:g}, but {declaration} is stated")
    return int(value)
