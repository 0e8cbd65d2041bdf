"""Sources of error: parts of a simulated record whose sum is the record, as the sensors measure them and as they are.

    z[k] = phi_dist[k-1] + noise + what the sensors see beside the turbulence on the axis

The vibration is cut into the lines that an observer is given and the others: each frequency belongs to the nearest line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from wfsobs.evaluation.known_lines import is_near
from wfsobs.observers.base import TURBULENCE, VIBRATION
from wfsobs.record import Record, delay_signal, frame_mean
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import simulate_noise
from wfsobs.simulation.sensing import OpenLoop
from wfsobs.typing import Array

NOISE, CONE, LINES, SIGNAL = "noise", "cone", "lines", "signal"
"""White noise of the sensors; what they see beside the turbulence on the axis; vibration lines that an observer is not given;
turbulence on the axis and the lines that it is given."""


@dataclass(frozen=True)
class Source:
    """One part of a record.

    Attributes
    ----------
    measurement : OpenLoop
        What the sensors measure of it, NaN where the record has no measurement.
    truth : dict of str to Array
        Target -> part of the truth, (n_steps, n_modes) [um].
    """

    measurement: OpenLoop
    truth: dict[str, Array]


def split_record(
    scenario: Scenario, record: Record, lines: Sequence[Sequence[float]], given_lines: Sequence[Sequence[float]]
) -> dict[str, Source]:
    """Split a record into its sources.

    Parameters
    ----------
    scenario : Scenario
        Settings that the record was simulated from.
    record : Record
        The record.
    lines, given_lines : sequence
        All the lines [Hz] of the vibration, and those that an observer is given, mode by mode.

    Returns
    -------
    dict of str to Source
        The sources by name; their sum is the record.
    """
    assert record.turbulence is not None and record.vibration is not None and record.ratio is not None
    assert record.open_loop_y is not None
    total = OpenLoop(record.open_loop_y, record.z_ngs, record.lgs_stars)
    noise, nothing = simulate_noise(scenario), np.zeros_like(record.vibration)
    split = [split_lines(x, record.dt, *of) for x, *of in zip(record.vibration.T, lines, given_lines, strict=True)]
    known = np.column_stack(split)
    others = record.vibration - known
    on_axis = _see(record.turbulence + record.vibration, record.ratio)
    beside = OpenLoop(total.lgs - noise.lgs - on_axis.lgs, total.ngs - noise.ngs - on_axis.ngs)
    parts = {
        NOISE: Source(noise, {TURBULENCE: nothing, VIBRATION: nothing}),
        CONE: Source(beside, {TURBULENCE: nothing, VIBRATION: nothing}),
        LINES: Source(_see(others, record.ratio), {TURBULENCE: nothing, VIBRATION: others}),
        SIGNAL: Source(_see(record.turbulence + known, record.ratio), {TURBULENCE: record.turbulence, VIBRATION: known}),
    }
    return {name: Source(_where_measured(part.measurement, total), part.truth) for name, part in parts.items()}


def split_lines(vibration: Array, dt: float, lines: Sequence[float], given_lines: Sequence[float]) -> Array:
    """Return the part (n,) of a vibration (n,) whose frequencies belong to a line [Hz] that is given.

    A frequency belongs to the nearest of the lines; where there are none it is a line itself.
    """
    bins = np.fft.rfftfreq(vibration.size, dt)
    at = np.asarray(lines, dtype=float) if len(lines) else bins
    nearest = np.argmin(np.abs(bins[:, None] - at), axis=1) if len(lines) else np.arange(bins.size)
    known = is_near(at, given_lines)
    if known.all():
        return vibration
    return np.fft.irfft(np.fft.rfft(vibration) * known[nearest], vibration.size)


def sum_sources(parts: Sequence[Source]) -> OpenLoop:
    """Return the measurements of several sources together."""
    seen = [part.measurement for part in parts]
    return OpenLoop(sum(one.lgs for one in seen), sum(one.ngs for one in seen), seen[0].stars)  # type: ignore[arg-type]


def _see(signal: Array, ratio: int) -> OpenLoop:
    """Return the noiseless measurements of a signal that is the same for all stars."""
    return OpenLoop(delay_signal(signal, 1), frame_mean(signal, ratio))


def _where_measured(open_loop: OpenLoop, total: OpenLoop) -> OpenLoop:
    lgs, ngs = np.where(np.isnan(total.lgs), np.nan, open_loop.lgs), np.where(np.isnan(total.ngs), np.nan, open_loop.ngs)
    return OpenLoop(lgs, ngs, total.stars)
