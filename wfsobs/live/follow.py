"""Observers that follow a source frame by frame: their latency and their errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from math import isfinite
from time import sleep
from typing import Any

from wfsobs.live.board import NEXT, Counts
from wfsobs.live.checks import observers_on
from wfsobs.live.loop import LiveLoop
from wfsobs.live.ring import LiveFrame
from wfsobs.live.simulated import SimulatedLoop
from wfsobs.live.source import LiveSource
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.record import TOTAL
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError

PAUSE = 0.05
"""Pause between two looks at the loop [s]."""


def follow(
    scenario: Scenario,
    n_frames: int,
    observers: Sequence[str] | None = None,
    *,
    source: LiveSource | None = None,
    speed: float = 1.0,
    keep: Callable[[LiveFrame], None] | None = None,
    report: Callable[[float], None] = lambda _: None,
    say: Callable[[str], None] = lambda _: None,
    log_file: str = "",
    complain: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Let observers follow a source in real time, until Ctrl+C at most.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    n_frames : int
        Frames to follow.
    observers : sequence of str, optional
        Ids; by default those of `observers_on`.
    source : LiveSource, optional
        Of the frames; by default the simulation of the scenario.
    speed : float
        1 is real time.
    keep : callable, optional
        Receives every frame.
    report : callable
        Receives the share that is done, about once a second.
    say : callable
        Receives a line about whatever happens.
    log_file : str
        Raise alarms, and append them and what else happens to this file.
    complain : callable
        Receives why that file cannot be written, once; the loop goes on without it.

    Returns
    -------
    dict
        "frames" that every observer has taken, "lost", "late_share" (an estimate came more than 1 ms after they were due),
        "late_share_sent" (the source sent them more than 1 ms after that) and "observers": id -> latency "p50_us", "p99_9_us",
        frames "late" (longer than a frame), "rms_nm" over all targets and modes, "errors_nm" by target (both
        together, too) and mode,
        "next_nm" of the next measurement by mode, which needs no truth; None for a number that is not known.

    Raises
    ------
    SettingError
        An observer is unknown or does not run frame by frame, an event cannot be played, or a process was killed.
    """
    source = source or SimulatedLoop(scenario)
    chosen = list(dict.fromkeys(observers or observers_on(source, scenario)))
    loop = LiveLoop(source, scenario, chosen, speed=speed, n_frames=n_frames)
    if log_file:
        loop.watch(log_file, complain)
    try:
        while not loop.is_ready:
            if reason := loop.failure():
                raise SettingError(reason)
            sleep(PAUSE)
        loop.play()
        with suppress(KeyboardInterrupt):  # what has run counts
            _drain(loop, n_frames, keep, report, say)
    finally:
        loop.stop()
    board, delivery = loop.board, loop.delivery
    modes = [mode.name for mode in scenario.modes][: source.sampling.n_modes]
    return {
        "frames": delivery.frames,
        "lost": delivery.losses,
        "late_share": delivery.late_share,
        "late_share_sent": delivery.late_share_sent,
        "observers": {name: _row(board[name], OBSERVERS[name].targets, modes) for name in chosen},
    }


def _row(counts: Counts, targets: Sequence[str], modes: Sequence[str]) -> dict[str, Any]:
    """Return what is told of an observer."""
    both = [TOTAL] if set(targets) == set(TARGETS) else []

    def by_mode(quantity: str) -> dict[str, float | None]:
        return {mode: _times(1e3, x) for mode, x in zip(modes, counts.rms(quantity), strict=True)}

    return {
        "p50_us": _times(1e6, counts.latencies.quantile(0.5)),
        "p99_9_us": _times(1e6, counts.latencies.quantile(0.999)),
        "late": int(counts.late[0]),
        "rms_nm": _times(1e3, counts.total_rms(targets)),
        "errors_nm": {target: by_mode(target) for target in (*targets, *both)},
        "next_nm": by_mode(NEXT),
    }


def _times(factor: float, x: float) -> float | None:
    return factor * float(x) if isfinite(x) else None


def _drain(
    loop: LiveLoop,
    n_frames: int,
    keep: Callable[[LiveFrame], None] | None,
    report: Callable[[float], None],
    say: Callable[[str], None],
) -> None:
    """Keep every frame and say what happens, until all have been taken or no more come. Raises SettingError."""
    kept = reported = 0
    is_over, reason = False, ""
    while not is_over:
        reason = loop.failure()
        is_over = bool(reason) or loop.count >= n_frames or not (loop.feed.is_alive or loop.count < loop.newest)
        if not is_over:
            sleep(PAUSE)
        while loop.events:
            say(loop.events.popleft().line)
        for number in range(kept, loop.count if keep else 0):
            if keep is not None and (frame := loop.feed.ring.read(number)) is not None:
                keep(frame)
            kept = number + 1
        if loop.count // 1000 > reported:
            reported = loop.count // 1000
            report(loop.count / n_frames)
    if reason and loop.count < n_frames:
        raise SettingError(reason)
