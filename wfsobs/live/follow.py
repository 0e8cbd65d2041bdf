"""Observers that follow a source frame by frame: their latency and their errors."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from math import inf, isnan
from time import monotonic, sleep
from typing import Any

import numpy as np

from wfsobs.live.blocks import check_live
from wfsobs.live.board import Counts
from wfsobs.live.ring import LiveFrame
from wfsobs.live.simulated import SimulatedLoop
from wfsobs.live.source import LiveSource, SourceProcess
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.observers.step import StepObserver
from wfsobs.observers.step_checks import StepError
from wfsobs.priors_from.scenario import as_sampled
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError
from wfsobs.stepping import design
from wfsobs.typing import Array

POLL = 1e-4
"""Pause between two looks at the ring [s]."""
LATE = 1e-3
"""From which delay a frame counts as late [s]."""
LONG_STEPS = ("kf-adaptive", "multirate-adaptive", "gpr-offline")
"""Observers that are run if named alone."""


class Follower:
    """One observer on a source.

    Parameters
    ----------
    observer : StepObserver
        Before its first frame.
    scored_from : int
        First frame of the observer that counts in the error.
    budget : float
        Time in which the estimate should be there [s].
    counts : Counts, optional
        Where errors and latencies are counted.
    """

    def __init__(self, observer: StepObserver, scored_from: int, budget: float, counts: Counts | None = None):
        self.observer, self.scored_from, self.budget = observer, scored_from, budget
        n_modes = observer.sampling.n_modes
        self.counts = Counts.empty(n_modes) if counts is None else counts
        self._places = [TARGETS.index(target) for target in observer.targets]
        self._expects = len(self._places) == len(TARGETS)
        self._next = np.full(n_modes, np.nan)

    def take(self, frame: LiveFrame) -> tuple[float, list[Array]]:
        """Update, estimate and score on one frame; return the time that it took [s], and the estimate of every target."""
        observer, start = self.observer, monotonic()
        number = observer.frame
        ngs = None if number == 0 or np.isnan(frame.ngs[0]) else frame.ngs
        observer.update(frame.z, ngs, frame.u if observer.estimator.needs_command else None)
        means = [observer.predict(0, target)[0] for target in observer.targets]
        spent = monotonic() - start
        self.counts.latencies.add(spent)
        self.counts.late[0] += spent > self.budget
        self.counts.frames[0] += 1
        if number >= self.scored_from:
            for place, mean in zip(self._places, means, strict=True):
                self._score(place, mean - (frame.vibration if place else frame.turbulence))
            if self._expects:
                self._score(len(TARGETS), self._next - frame.z)
        if self._expects:
            self._next = means[0] + means[1]
        observer.settle()
        return spent, means

    def _score(self, place: int, error: Array) -> None:
        if is_known(error):
            self.counts.squares[place] += error * error
            self.counts.samples[place] += 1
        elif (known := ~np.isnan(error)).any():
            self.counts.squares[place, known] += error[known] ** 2
            self.counts.samples[place] += known

    def errors(self, modes: Sequence[str]) -> dict[str, dict[str, float | None]]:
        """Return target -> mode -> rms error after the warm-up [nm], None without a sample."""
        return {
            target: {name: None if isnan(x) else float(x) * 1e3 for name, x in zip(modes, self.counts.rms(target), strict=True)}
            for target in self.observer.targets
        }

    def error(self) -> float | None:
        """Return the rms error over all targets and modes [nm]."""
        n = int(self.counts.samples[self._places].sum())
        return float(np.sqrt(self.counts.squares[self._places].sum() / n)) * 1e3 if n else None


def is_known(x: Array) -> bool:
    """Return whether no number is NaN."""
    return bool(x.dot(x) < inf)


def default_observers() -> list[str]:
    """Return the ids of the observers that run frame by frame, but for those whose step may be longer than a frame."""
    return [o.id for o in OBSERVERS.values() if o.step is not None and o.id not in LONG_STEPS]


def follow(
    scenario: Scenario,
    n_frames: int,
    observers: Sequence[str] | None = None,
    *,
    source: LiveSource | None = None,
    speed: float = 1.0,
    keep: Callable[[LiveFrame], None] | None = None,
    report: Callable[[float], None] = lambda _: None,
) -> dict[str, Any]:
    """Let observers follow a source in real time.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    n_frames : int
        Frames to follow.
    observers : sequence of str, optional
        Ids; by default those of `default_observers`.
    source : LiveSource, optional
        Of the frames; by default the simulation of the scenario.
    speed : float
        1 is real time.
    keep : callable, optional
        Receives every frame.
    report : callable
        Receives the share that is done, about once a second.

    Returns
    -------
    dict
        "frames" delivered to every observer, "lost", "late_share" (reached the observers more than 1 ms after they were due) and
        "observers": id -> latency "p50_us", "p99_9_us", frames "late" (longer than a frame), "rms_nm" over all targets and modes,
        "errors_nm" by target and mode.

    Raises
    ------
    SettingError
        An observer is unknown or does not run frame by frame, or the scenario has events.
    """
    check_live(scenario)
    for name in observers or ():
        if name not in OBSERVERS:
            raise SettingError(f"observer {name!r}: no such observer; there are {', '.join(OBSERVERS)}")
    chosen = list(observers) if observers else default_observers()
    source = source or SimulatedLoop(scenario)
    sampling = source.sampling
    scenario, pace = as_sampled(scenario, sampling), sampling.dt / speed
    first = round(scenario.run.warm_up / scenario.dt)
    try:
        followers = {name: Follower(design(name, scenario, sampling=sampling), first, pace) for name in dict.fromkeys(chosen)}
    except StepError as error:
        raise SettingError(str(error)) from None
    feed = SourceProcess(source, speed, n_frames)
    try:
        feed.start()
        frames, lost, late = _drain(feed, followers, n_frames, keep, report)
    finally:
        feed.stop()
    modes = [mode.name for mode in scenario.modes][: sampling.n_modes]
    return {
        "frames": frames,
        "lost": lost,
        "late_share": late / max(frames, 1),
        "observers": {
            name: {
                "p50_us": f.counts.latencies.quantile(0.5) * 1e6,
                "p99_9_us": f.counts.latencies.quantile(0.999) * 1e6,
                "late": int(f.counts.late[0]),
                "rms_nm": f.error(),
                "errors_nm": f.errors(modes),
            }
            for name, f in followers.items()
        },
    }


def _drain(
    feed: SourceProcess,
    followers: dict[str, Follower],
    n_frames: int,
    keep: Callable[[LiveFrame], None] | None,
    report: Callable[[float], None],
) -> tuple[int, int, int]:
    """Take every frame of a source; return how many were taken, lost and late."""
    ring, number, lost, late = feed.ring, 0, 0, 0
    gc.collect()
    gc.freeze()
    while number < n_frames:
        if ring.count <= number:
            if not feed.is_alive and ring.count <= number:
                break
            sleep(POLL)
            continue
        frame = ring.read(number)
        if frame is None:
            lost += 1
        else:
            late += monotonic() - float(frame.due) > LATE
            for follower in followers.values():
                follower.take(frame)
            if keep is not None:
                keep(frame)
        number += 1
        if number % 1000 == 0:
            report(number / n_frames)
    gc.unfreeze()
    return number - lost, lost + n_frames - number, late
