"""One entry on one scenario: run it on every record and score the answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from wfsobs.control.base import Controller
from wfsobs.evaluation.scores import calibration
from wfsobs.observers.base import Observer
from wfsobs.priors_from.controllers import controller_arguments, own_settings, plant_of, prior_for
from wfsobs.record import NEXT_Z, TOTAL, Record
from wfsobs.typing import Array
from wfsobs_arena.cases import Case, mean_square
from wfsobs_arena.definition import Rules
from wfsobs_arena.entries import ArenaEntry, load_object
from wfsobs_arena.process import Answer, EntryError, EntryProcess
from wfsobs_arena.tracks import DISTURBANCE, NEXT, TRACKS, Track


@dataclass(frozen=True)
class Trial:
    """Result on one record.

    Attributes
    ----------
    seed : int
        Of the record.
    record : str
        SHA-256 of the record.
    squares : list of float
        Mean square of the error [um^2], all modes together, one per sample; of estimating zero where there is no answer.
    reference : list of float
        Mean square of the reference [um^2], one per sample.
    failure : str
        Why there is no answer; empty where there is one.
    microseconds : float or None
        Computing time per step [us].
    calibration : mapping of str to float
        Of stated standard deviations, means over the modes: "sd" [um], "within_68", "within_95", "crps" [um], and the
        number of "modes"; empty without.
    """

    seed: int
    record: str
    squares: list[float]
    reference: list[float]
    failure: str = ""
    microseconds: float | None = None
    calibration: Mapping[str, float] = field(default_factory=dict[str, float])


def try_record(
    entry: ArenaEntry,
    case: Case,
    seed: int,
    record: Record,
    references: list[float],
    process: EntryProcess | None,
    rules: Rules,
) -> Trial:
    """Return the result of an entry on one record.

    references : mean squares of the reference [um^2], one per sample
    process    : in which it runs; None for a folder of estimates
    """
    track, truth = TRACKS[case.track], case.truth(record)
    same = seed, case.record_id(seed)
    stretches = case.stretches(record)
    try:
        if process is None:
            answer = _read_estimate(Path(entry.place), case.record_id(seed), record)
        else:
            arguments = _controller_inputs if track.is_loop else _observer_inputs
            answer = process.run(rules.seconds(record.n_steps * record.dt), *arguments(load_object(entry), case, record))
        error, sd = _error(answer, track, case, truth)
        _check_numbers(error, truth, stretches)
    except ValueError as reason:
        return Trial(*same, [mean_square(truth[part]) for part in stretches], references, " ".join(str(reason).split()))
    squares = [mean_square(error[part]) for part in stretches]
    per_step = None if process is None else answer.seconds / record.n_steps * 1e6
    return Trial(*same, squares, references, "", per_step, _calibrate(error, sd, stretches))


def _observer_inputs(observer: Observer, case: Case, record: Record) -> tuple[Any, ...]:
    if missing := observer.missing(record):
        raise EntryError(f"the record has no {', '.join(missing)}")
    return observer.measurements(record), *case.prior_and_settings(observer, record)


def _controller_inputs(controller: Controller, case: Case, record: Record) -> tuple[Any, ...]:
    settings = own_settings(controller, case.scenario)
    measured, prior = controller_arguments(controller, record, settings, prior_for(controller, case.scenario))
    return measured, prior, plant_of(case.scenario), settings


def _error(answer: Answer, track: Track, case: Case, truth: Array) -> tuple[Array, Array | None]:
    """Return the error of an answer, and the standard deviation that it states."""
    if track.is_loop:
        return truth + plant_of(case.scenario).mirror.correction(_array(answer, "u", truth)), None
    whole = {DISTURBANCE: TOTAL, NEXT: NEXT_Z}.get(track.target, track.target)
    if "estimate" in answer.arrays:
        values, sd = _array(answer, "estimate", truth), answer.arrays.get("sd")
    else:
        values = np.sum([_array(answer, target, truth) for target in track.targets], axis=0)
        sd = answer.arrays.get(f"sd of {whole}")
    return values - truth, None if sd is None else np.broadcast_to(sd, truth.shape)


def _array(answer: Answer, name: str, truth: Array) -> Array:
    values = answer.arrays.get(name)
    if values is None:
        raise EntryError(f"returns no {name}")
    if values.shape != truth.shape or values.dtype.kind != "f":
        raise EntryError(f"{name} takes numbers of shape {truth.shape}, (n_steps, n_modes), not {values.shape} of {values.dtype}")
    return values


def _check_numbers(error: Array, truth: Array, stretches: list[slice]) -> None:
    gone = sum(int((~np.isfinite(error[part]) & np.isfinite(truth[part])).any(axis=1).sum()) for part in stretches)
    if gone:
        raise EntryError(f"no number in {gone} of {sum(len(truth[part]) for part in stretches)} steps that are scored")


def _calibrate(error: Array, sd: Array | None, stretches: list[slice]) -> dict[str, float]:
    """Return the calibration of stated standard deviations, means over the modes."""
    if sd is None:
        return {}
    scored = slice(stretches[0].start, stretches[-1].stop)
    found = [calibration(error[scored, mode], sd[scored, mode]) for mode in range(error.shape[1])]
    known = [one._asdict() for one in found if one is not None]
    if not known:
        return {}
    return {name: float(np.mean([one[name] for one in known])) for name in known[0]} | {"modes": error.shape[1]}


def _read_estimate(folder: Path, record_id: str, record: Record) -> Answer:
    """Return the estimate of a record from a folder, RECORD.npz with "estimate" and perhaps "sd". Raises EntryError."""
    path = folder / f"{record_id}.npz"
    try:
        with np.load(path, allow_pickle=False) as file:
            if file["estimate"].nbytes > 8 * record.y_lgs.size:
                raise EntryError(f"{path.name}: estimate has more numbers than the record")
            return Answer({name: file[name] for name in ("estimate", "sd") if name in file.files}, 0.0)
    except FileNotFoundError:
        raise EntryError(f"{path.name}: there is no such file") from None
    except (OSError, KeyError, ValueError, EOFError) as error:
        raise EntryError(f"{path.name}: takes an .npz with estimate, (n_steps, n_modes) [um]: {error}") from None
