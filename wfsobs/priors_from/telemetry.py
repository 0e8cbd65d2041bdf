"""What observers are told of telemetry: an identification or the file of one, and training data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from wfsobs.observers.missing import fill_missing
from wfsobs.prior import Prior
from wfsobs.record import Record, RecordError, Training
from wfsobs.scenario import Scenario
from wfsobs.settings.values import shorten

if TYPE_CHECKING:
    from wfsobs.identification.result import Identification


FOUND = ("telescope", "turbulence", "vibration", "sensors", "kalman", "butterworth")
"""Groups of settings of which priors are made."""


def told_by(model: Scenario | Identification, scenario: Scenario) -> Scenario:
    """Return a scenario with the models of an identification, and all other settings of `scenario`.

    model : an identification, or the file of one (`wfsobs identify --out`)
    """
    if not isinstance(model, Scenario):
        model = model.scenario(scenario)
    out = scenario.before_events.copy()
    for group in FOUND:
        setattr(out, group, getattr(model, group).copy())
    out.kalman.ngs_between_frames = scenario.kalman.ngs_between_frames  # what a filter does, not what it is told
    return out


SAME_RATE = 1e-6
"""Relative difference of two rates that is none: time stamps are rounded."""


def with_training(record: Record, train: Record | float, scenario: Scenario) -> Record:
    """Return the record with training data from telemetry in place of its own.

    Parameters
    ----------
    record : Record
        What observers are run on.
    train : Record or float
        Another record of the same loop; or the duration [s] of the first part of the record, which is then not to be scored.
    scenario : Scenario
        Its settings of the offline GPR say how many samples are needed.

    Returns
    -------
    Record
        With the same measurements.

    Raises
    ------
    RecordError
        The other record has another rate, number of modes or delay, is the record itself, or either has too few samples, none of
        a mode that the record measures, or an impossible duration.
    """
    part = training_part(record, train, scenario)
    return replace(record, training=Training(part.y_lgs, part.u, part.open_loop_y).copy())


def training_of(record: Record, modes: Sequence[int] | None = None) -> Training | None:
    """Return the training data of a record as observers receive them: by its gate, missing samples bridged by the last value.

    modes : of these alone. Raises RecordError for data that do not fit the record.
    """
    if record.training_record is None:
        return None
    _check_fit(record, record.training_record)
    _check_modes(record.training_record, record)
    return _bridge_gaps(record.training_record).copy(modes)


def as_training(record: Record) -> Training:
    """Return a record as training data, without outliers, missing samples bridged by the last value.

    Raises RecordError where a mode has no measurement.
    """
    _check_modes(record)
    return _bridge_gaps(record)


def _bridge_gaps(record: Record) -> Training:
    whole = fill_missing(record.without_outliers, Prior())
    return Training(whole.y_lgs, whole.u, whole.open_loop_y).copy()


def training_part(record: Record, train: Record | float, scenario: Scenario) -> Record:
    """Return the training data of `with_training` as a record. Raises RecordError as that does."""
    other = train if isinstance(train, Record) else _first(record, train)
    _check_fit(record, other)
    _check_modes(other, record)
    if other.y_lgs.shape == record.y_lgs.shape and np.array_equal(other.y_lgs, record.y_lgs, equal_nan=True):
        raise RecordError("the training data is the record itself: training and test must differ; train on the first part of it")
    g = scenario.gpr_offline
    if other.n_steps < (needed := g.depth + g.training_size):
        raise RecordError(f"the training data has {other.n_steps} steps; gpr_offline.depth + training_size need {needed}")
    return other


def trained_until(train: Record | float | None) -> float:
    """Return the end [s] of the part of the record that is training data."""
    return 0.0 if train is None or isinstance(train, Record) else train


def _check_fit(record: Record, other: Record) -> None:
    """Raise RecordError for training data of another rate, number of modes or delay."""
    if abs(other.dt / record.dt - 1.0) > SAME_RATE:
        raise RecordError(f"the training data has a rate of {1 / other.dt:g} Hz, the record {1 / record.dt:g} Hz")
    for what, word in (("n_modes", "modes"), ("delay", "steps of delay")):
        theirs, ours = getattr(other, what), getattr(record, what)
        if theirs != ours:
            raise RecordError(f"the training data has {theirs} {word}, the record {ours}")


def _check_modes(other: Record, record: Record | None = None) -> None:
    """Raise RecordError for training data without a measurement of a mode; record : of the modes that it measures alone."""
    is_lost = np.isnan(other.y_lgs).all(axis=0)
    if record is not None:
        is_lost &= ~np.isnan(record.y_lgs).all(axis=0)
    if is_lost.any():
        raise RecordError(f"the training data holds no measurement of mode {is_lost.argmax()}")


def _first(record: Record, seconds: float) -> Record:
    length = record.n_steps * record.dt
    if isinstance(seconds, bool) or not isinstance(seconds, (int, float, np.integer, np.floating)):
        raise RecordError(f"train takes a record, or a duration [s], not {shorten(seconds)}")
    if not 0.0 < seconds < length:
        raise RecordError(f"the first {seconds:g} s as training data: takes more than 0 and less than the record's {length:g} s")
    end = round(seconds / record.dt)
    twin = None if record.open_loop_y is None else record.open_loop_y[:end]
    return Record(record.y_lgs[:end], record.u[:end], record.dt, open_loop_y=twin, delay=record.delay)
