"""From the named arrays of a file to a `Record`: the only check of shapes, units, signs and clocks.

A record has y_lgs and u (n_steps, n_modes) and dt or time; optionally frame (n_steps,), a count that skips missing frames, y_ngs
(n_steps, n_modes), NaN where there is no frame, or one row per frame, with ratio or time_ngs, the truth turbulence and vibration,
open_loop_y, lgs_stars (n_steps,), y_stars (n_steps, n_lgs, n_modes), and for the offline GPR training_y, training_u and
training_open_loop_y (n, n_modes).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from wfsobs.record import DELAY, Record, RecordError, Training, as_signal, check_size, star_counts
from wfsobs.scenario import Scenario
from wfsobs.sensors.zernike import order_of
from wfsobs.telemetry.bridged import without_bridged
from wfsobs.telemetry.clocks import (
    AGREE,
    counted_steps,
    drop_partial_frames,
    frame_distance,
    frames_at,
    past_midnight,
    place_frames,
    rows_of_frames,
    steps_of,
)
from wfsobs.telemetry.columns import LoopMatrix, apply_matrices
from wfsobs.telemetry.formats.contents import APART, FAST, FRAME, NGS, SIGNALS, STARS, TIME, TRAINING, Contents
from wfsobs.typing import Array
from wfsobs.units import ANGLES, UNITS, micrometres_per, parse_unit

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
    command_delay : float or None
        Steps from a command to the first measurement that sees it, 1 or more; with parts of a step the mirror holds each command
        for a step, and a measurement is the mean over one.
    rate : float or None
        Rate of the fast steps [Hz].
    columns : mapping
        Which column of the file is what, {one of `wfsobs.telemetry.columns.ROLES`: name in the file}.
    trust : bool
        Whether sign and delay of the commands hold whatever the data and the file say.
    command_gain : tuple of float or None
        What the mirror does of a command, one number or one per mode.
    rail : float or None
        Largest command that the mirror follows, in the unit of the commands; it stays there for larger ones.
    open_loop : bool
        Whether the mirror was at rest, whatever the commands are.
    reconstructor : LoopMatrix or None
        From slopes to modes, where y_lgs holds slopes.
    command_modes : LoopMatrix or None
        From modes to commands, where u holds those of actuators.
    """

    unit: str | None = None
    command_sign: int | None = None
    command_delay: float | None = None
    rate: float | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    trust: bool = False
    command_gain: tuple[float, ...] | None = None
    rail: float | None = None
    open_loop: bool = False
    reconstructor: LoopMatrix | None = None
    command_modes: LoopMatrix | None = None

    @property
    def as_commanded(self) -> Self:
        """What is stated but for delay and gain of the mirror: with it the commands are read as they were given."""
        return replace(self, command_delay=1.0, command_gain=None, trust=True)

    def options(self, corrections: Mapping[str, str]) -> list[str]:
        """List the options of the command line that state this, with corrections by the names of options."""
        named = {
            "unit": self.unit,
            "command-sign": None if self.command_sign is None else f"{self.command_sign:+d}",
            "command-delay": self.command_delay,
            "command-gain": self.command_gain and ",".join(map(str, self.command_gain)),
            "rail": self.rail,
            "rate": self.rate,
            "reconstructor": self.reconstructor and self.reconstructor.source,
            "command-modes": self.command_modes and self.command_modes.source,
        } | dict(corrections)
        words = [word for name, value in named.items() if value is not None for word in (f"--{name}", str(value))]
        words += ["--trust"] * self.trust + ["--open-loop"] * self.open_loop
        return words + [word for role, name in self.columns.items() for word in ("--column", f"{role}={name}")]


def to_record(contents: Contents, scenario: Scenario, declaration: DeclaredFormat) -> Record:
    """Return the record of a file's contents. Raises RecordError with one line naming what, where and what is expected."""
    arrays, most = contents.arrays, len(scenario.modes)
    for name in ("y_lgs", "u")[: 1 if declaration.open_loop else 2]:
        if name not in arrays:
            at_rest = ", or --open-loop" * (name == "u")
            raise RecordError(f"has no {name}; a record needs y_lgs, u and dt{at_rest}{contents.hint}")
    signals = {name: _signal(name, arrays[name]) for name in SIGNALS if name in arrays}
    swapped = [name for name, values in signals.items() if values.shape[0] < values.shape[1] > most]
    signals |= {name: np.ascontiguousarray(signals[name].T) for name in swapped}
    if (unit := str(arrays.get("unit", "")).strip()) and parse_unit(unit) is None:
        contents.units = dict.fromkeys(signals, unit) | contents.units
    modes = apply_matrices(signals, declaration.reconstructor, declaration.command_modes)
    if declaration.reconstructor and not declaration.reconstructor.keeps_unit:
        contents.units.pop("y_lgs", None)
    if declaration.command_modes and parse_unit(contents.units.get("u", "um")) is None:  # of actuators
        del contents.units["u"]
    if declaration.open_loop:
        modes.append("open loop, u not used" if "u" in signals and signals["u"].any() else "open loop")
        signals["u"] = np.zeros_like(signals["y_lgs"])
        contents.units.pop("u", None)
    n, n_modes = signals["y_lgs"].shape
    if not 1 <= n_modes <= most or n < 2:
        order = order_of(n_modes) if n_modes > most else None
        needed = f": {n_modes} modes need telescope.radial_order = {order}" if order else ""
        needed += "; slopes need a --reconstructor" if n_modes > most else ""
        raise RecordError(f"y_lgs has shape {(n, n_modes)}; it takes (n_steps >= 2, 1 to {most} modes){needed}")
    for name in signals:
        rows = signals["training_y"].shape[0] if name in TRAINING and "training_y" in signals else n
        rows = signals[name].shape[0] if name == NGS else rows  # may have one row per frame
        if signals[name].shape != (rows, n_modes):
            actuators = "; commands of actuators need --command-modes" * (name == "u" and signals[name].shape[1] > n_modes)
            raise RecordError(f"{name} has shape {signals[name].shape}; expected ({rows}, {n_modes}){actuators}")
    if APART in arrays:
        signals[APART] = _stars_apart(arrays[APART], n, n_modes)
    delay = stated_delay(contents, declaration)
    mirror = modes + _limit(signals, declaration)
    origin = _into_micrometres(signals, contents, declaration, scenario.telescope.diameter)
    if STARS in arrays:
        signals[STARS] = star_counts(arrays[STARS], n).astype(np.float64)[:, None]
    dt, ratio, timing = _apply_timestamps(signals, contents, declaration)
    mirror += _apply_mirror(signals, delay, declaration)
    mirror += [f"{' and '.join(swapped)} with a row per mode"] if swapped else []
    origin = ", ".join(filter(None, (origin, *mirror, *contents.guesses, timing, _name_unused(contents.leftovers))))
    for name, what in (("y_lgs", "measurement"), ("u", "command")):
        if np.isnan(signals[name]).all(axis=0).any():
            raise RecordError(f"{name} holds no {what} of one of its modes")
    fields = {name: signals[name] for name in (*FAST, NGS) if name in signals}
    if STARS in signals:
        fields[STARS] = np.nan_to_num(signals[STARS][:, 0]).astype(int)
    if APART in signals:
        fields[APART] = signals[APART].reshape(len(signals["y_lgs"]), -1, n_modes)
    training, steps = _training(signals), int(delay + WHOLE)
    record = Record(**fields, dt=dt, ratio=ratio, training=training, delay=steps, origin=origin, gate=scenario.gate)
    is_told = STARS in signals or np.isnan(record.z[steps:]).any()
    return record if is_told else without_bridged(record)


def _signal(name: str, raw: Array) -> Array:
    """Return a signal as native float64 of its own, NaN where a sample is missing."""
    out = np.array(as_signal(name, raw), order="C")
    if out.ndim != 2:
        raise RecordError(f"{name} has shape {out.shape}; expected (any, any)")
    check_size(name, out, is_whole=name in TRAINING)
    return out


def _stars_apart(raw: Array, n: int, n_modes: int) -> Array:
    """Return every LGS by itself, a column per star and mode, (n, n_lgs n_modes)."""
    if raw.ndim != 3 or raw.shape[::2] != (n, n_modes):
        raise RecordError(f"{APART} has shape {raw.shape}; expected ({n}, n_lgs, {n_modes})")
    return _signal(APART, raw.reshape(n, -1))


def _into_micrometres(signals: dict[str, Array], contents: Contents, declaration: DeclaredFormat, diameter: float) -> str:
    """Scale every signal to um, commands with their sign; return unit, sign and aperture as one line."""
    arrays, own = contents.arrays, contents.units
    if unit := parse_unit(str(arrays.get("unit", ""))):
        own = dict.fromkeys(signals, unit) | own
    own = {name: unit for name, unit in own.items() if parse_unit(unit) or declaration.unit is None}
    for name, unit in own.items():
        if parse_unit(unit) is None:
            raise RecordError(f"{name} is in {unit[:40]!r}, which is no unit of a wavefront: state one of {', '.join(UNITS)}")
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
    sign = stated_sign(contents, declaration)
    for name in {"u", "training_u"} & signals.keys():
        signals[name] *= sign
    said = [f"unit {unit}" for unit in dict.fromkeys(units.values()) if unit != "um"]
    said += [f"aperture {diameter:g} m"] * bool(set(units.values()) & set(ANGLES))
    said += ["command sign -1"] if sign < 0 else []
    return ", ".join([*([str(arrays["origin"])] if "origin" in arrays else []), *said])


def _name_unused(columns: Sequence[str]) -> str:
    """Say which columns are no part of the record, in a few words; nothing where there is none."""
    columns = [*dict.fromkeys(re.sub(r"\[\d+\]$", "", name) for name in columns)]
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
        if dt is not None and abs(dt * declaration.rate - 1.0) > AGREE:
            raise RecordError(f"its rate is {1.0 / dt:.6g} Hz, but {declaration.rate:.6g} Hz are stated")
        dt = 1.0 / declaration.rate if dt is None else dt
    start = 0.0
    steps = counted_steps(_clock(FRAME, arrays[FRAME], n)) if FRAME in arrays else None
    if TIME in arrays:
        time = past_midnight(_clock(TIME, arrays[TIME], n))
        steps, dt, said = steps_of(time, dt, steps)
        start = float(time[0])
    at = np.arange(n) if steps is None else steps
    for name, values in signals.items():
        is_short = name == NGS and "time_ngs" not in arrays and values.shape[0] < n  # the blank rows at the end are not there
        if is_short or (steps is not None and name not in TRAINING and values.shape[0] == n):
            placed = np.full((at[-1] + 1, values.shape[1]), np.nan)
            placed[at[: values.shape[0]]] = values
            if not is_short or frame_distance(rows_of_frames(placed)):
                signals[name] = placed
    if dt is None:
        there = f": which column is the time? It has {', '.join(contents.leftovers[:20])}" if contents.leftovers else ""
        there = contents.hint if "--column" in contents.hint else there
        raise RecordError(f"has no dt and no time; a record needs y_lgs, u and dt, or a stated rate{there}")
    if NGS not in signals:
        return dt, None, said
    ratio, rows = _apply_frames(signals, arrays, start, dt)
    return dt, ratio, ", ".join(filter(None, (said, rows)))


def _apply_frames(signals: dict[str, Array], arrays: Mapping[str, Array], start: float, dt: float) -> tuple[int, str]:
    """Place NGS frames by their stamps, by the rows they are in or by the ratio; return the ratio, and what was guessed."""
    frames, n, said = signals[NGS], signals["y_lgs"].shape[0], ""
    steps = rows_of_frames(frames)
    distance = frame_distance(steps) if frames.shape[0] == n else None
    if "time_ngs" in arrays:
        steps = frames_at(past_midnight(_clock("time_ngs", arrays["time_ngs"], frames.shape[0])), start, dt)
        outside = int(((steps < 0) | (steps >= n)).sum())
        if outside > 0.5 * steps.size:
            end = start + (n - 1) * dt
            raise RecordError(
                f"time_ngs: {outside} of {steps.size} frames are outside of the record's {start:.9g} to {end:.9g} s; "
                "it takes stamps in the unit and on the clock of time"
            )
        ratio = _ratio(arrays, int(np.median(np.diff(steps))) if steps.size > 1 else None)
        late = np.flatnonzero((steps - steps[0]) % ratio)
        if late.size:
            raise RecordError(f"time_ngs: the frame in row {late[0]} is not a whole number of {ratio} steps after the first")
        _align_frames(signals, steps, frames, ratio)
    elif distance and distance % (ratio := _ratio(arrays, distance)) == 0:
        is_held = np.isfinite(frames).any(axis=1).sum() > steps.size + 1  # one in the first row is none
        if "ratio" not in arrays or steps[0] % ratio or is_held:
            said = f"an NGS frame in {ratio} rows, the first in row {steps[0]}"
        _align_frames(signals, steps, frames[steps], ratio)
    else:
        ratio = _ratio(arrays)
        signals[NGS] = place_frames(frames, n, ratio)
    signals[NGS] = drop_partial_frames(signals[NGS], ratio)
    return ratio, said


def _align_frames(signals: dict[str, Array], steps: Array, frames: Array, ratio: int) -> None:
    """Put the frames of these steps, (n,), in their rows, and start the record a multiple of `ratio` steps before the first."""
    n = signals["y_lgs"].shape[0]
    inside = (steps >= 0) & (steps < n)
    signals[NGS] = np.full((n, frames.shape[1]), np.nan)
    signals[NGS][steps[inside]] = frames[inside]
    for name in (*FAST, NGS, STARS, APART):
        if name in signals:
            signals[name] = signals[name][steps[0] % ratio :]


def _training(signals: Mapping[str, Array]) -> Training | None:
    y, u, open_loop_y = map(signals.get, TRAINING)
    if (y is None) != (u is None):
        raise RecordError("training_y and training_u must come together")
    return None if y is None or u is None else Training(y, u, open_loop_y)


def _clock(name: str, raw: Array, n: int) -> Array:
    if raw.dtype.kind not in "fiu" or raw.shape != (n,):
        raise RecordError(f"{name} takes {n} numbers, not {raw.dtype} of shape {raw.shape}")
    return raw.astype(np.float64)


def _number(name: str, raw: Array) -> float:
    if raw.ndim != 0 or raw.dtype.kind not in "fiu" or not np.isfinite(raw) or raw <= 0:
        raise RecordError(f"{name} takes one number above 0, not {np.array2string(raw, threshold=4)}")
    return float(raw)


def _number_of(
    name: str, arrays: Mapping[str, Array], declaration: float | None, default: float | None, trust: bool = False
) -> float:
    """Return a number of the file, else the declared one, which comes first where it is trusted, else the default."""
    if name not in arrays or (trust and declaration is not None):
        found = default if declaration is None else declaration
        if found is None:
            raise RecordError(
                "y_ngs needs ratio, the number of fast steps per NGS frame, or time_ngs, the time stamps of the frames"
            )
        return found
    raw = arrays[name]
    if raw.ndim:
        found = ", ".join(map(str, raw.tolist()))
        more = "; --trust takes what is stated" * (name != "ratio")
        raise RecordError(f"{name} differs between parts of the file: {found}{more}")
    value = float(raw) if raw.dtype.kind in "fiu" else np.nan
    if not np.isfinite(value):
        raise RecordError(f"{name} takes a number, not {np.array2string(raw, threshold=4)[:40]}")
    if declaration is not None and value != declaration:
        raise RecordError(f"{name} is {value:g}, but {declaration:g} is stated" + "; --trust takes that" * (name != "ratio"))
    return value


def stated_sign(contents: Contents, declaration: DeclaredFormat) -> int:
    """Return the sign of the commands as the file or the user states it, 1 where neither does. Raises RecordError."""
    sign = _number_of("command_sign", contents.arrays, declaration.command_sign, 1, declaration.trust)
    if sign not in (1, -1):
        raise RecordError(f"command_sign takes 1 or -1, not {sign:g}")
    return int(sign)


def stated_delay(contents: Contents, declaration: DeclaredFormat) -> float:
    """Return the delay of the commands as the file or the user states it [steps], with its fraction. Raises RecordError."""
    delay = _number_of("delay", contents.arrays, declaration.command_delay, DELAY, declaration.trust)
    if not 1 <= delay <= LONGEST_DELAY:
        raise RecordError(f"delay takes a number of steps from 1 to {LONGEST_DELAY}, not {delay:g}")
    return delay


def _ratio(arrays: Mapping[str, Array], default: int | None = None) -> int:
    value = _number_of("ratio", arrays, None, default)
    if value <= 0 or value % 1:
        raise RecordError(f"ratio takes a whole number, not {value:g}")
    return int(value)


LONGEST_DELAY = 100
"""Of a command [steps]."""

WHOLE = 1e-6
"""Part of a step that is none."""


def _limit(signals: dict[str, Array], declaration: DeclaredFormat) -> list[str]:
    """Limit the commands, in their own unit, to what the mirror follows; return in a few words what was done."""
    said = list[str]()
    if declaration.rail is not None:
        beyond = np.abs(signals["u"]) > declaration.rail
        if beyond.all():
            most = np.abs(signals["u"]).max()
            raise RecordError(f"rail = {declaration.rail:g} is below every command; the largest is {most:.4g}, in their unit")
        for name in {"u", "training_u"} & signals.keys():
            signals[name] = np.clip(signals[name], -declaration.rail, declaration.rail)
        said.append(f"{beyond.any(axis=1).sum()} commands beyond the rail of {declaration.rail:g}")
    return said


def _apply_mirror(signals: dict[str, Array], delay: float, declaration: DeclaredFormat) -> list[str]:
    """Turn commands into what a measurement sees of them `int(delay)` steps later, the mirror's mean over a step.

    With the part p of a step that is (1 - p) u[k] + p u[k-1], times the gain; what was before the record is taken as its first.
    """
    part, gain = delay - int(delay + WHOLE), np.array(declaration.command_gain or (1.0,))
    if gain.size not in (1, signals["y_lgs"].shape[1]) or not ((gain >= 1e-9) & (gain <= 1e9)).all():
        raise RecordError(f"a command gain takes a number from 1e-9 to 1e9, or {signals['y_lgs'].shape[1]}, one per mode")
    for name in {"u", "training_u"} & signals.keys():
        u = signals[name]
        signals[name] = gain * (u if part < WHOLE else (1.0 - part) * u + part * np.concatenate([u[:1], u[:-1]]))
    if declaration.open_loop:
        signals["u"][:] = 0.0
    said = [f"delay {delay:g}"] if part >= WHOLE else []
    return said + ([f"command gain {', '.join(f'{g:g}' for g in gain)}"] if declaration.command_gain else [])
