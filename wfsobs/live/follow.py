"""Observers that follow a source frame by frame: their latency and their errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isnan
from time import sleep
from typing import Any

from wfsobs.live.board import Counts
from wfsobs.live.processes import LiveProcesses
from wfsobs.live.programme import Programme, scenario_on
from wfsobs.live.ring import LiveFrame
from wfsobs.live.simulated import SimulatedLoop
from wfsobs.live.source import LiveSource
from wfsobs.observers import OBSERVERS
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError

TICK = 0.05
"""Pause between two looks at the observers [s]."""
ADAPTIVE = ("kf-adaptive", "multirate-adaptive")
"""Observers that are run if named, or where there are events; some of their steps are longer than a frame."""
LONG_STEPS = (*ADAPTIVE, "gpr-offline")
"""Observers that are run if named alone, where there are no events."""


def default_observers(scenario: Scenario) -> list[str]:
    """Return the ids of the observers that run frame by frame, but for those whose step may be longer than a frame.

    Where a scenario has events the adaptive ones run nevertheless.
    """
    welcome = ADAPTIVE if scenario.events else ()
    return [o.id for o in OBSERVERS.values() if o.step is not None and (o.id not in LONG_STEPS or o.id in welcome)]


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
        "frames" that every observer has taken, "lost", "late_share" (an estimate came more than 1 ms after they were due),
        "late_share_sent" (the source sent them more than 1 ms after that) and "observers": id -> latency "p50_us", "p99_9_us",
        frames "late" (longer than a frame), "rms_nm" over all targets and modes, "errors_nm" by target and mode.

    Raises
    ------
    SettingError
        An observer is unknown or does not run frame by frame, or an event cannot be played.
    """
    for name in observers or ():
        if name not in OBSERVERS:
            raise SettingError(f"observer {name!r}: no such observer; there are {', '.join(OBSERVERS)}")
    chosen = list(observers) if observers else default_observers(scenario)
    source = source or SimulatedLoop(scenario)
    told = scenario_on(source, scenario)
    scenario = told.before_events
    processes = LiveProcesses(source, scenario, tuple(dict.fromkeys(chosen)), speed, n_frames)
    try:
        programme = Programme(told, processes.feed.tell)
        _await_observers(processes)
        processes.feed.start()
        _drain(processes, lambda frames: programme.play(frames * source.sampling.dt), n_frames, keep, report)
    finally:
        processes.release()
    board, delivery = processes.board, processes.delivery
    modes = [mode.name for mode in scenario.modes][: source.sampling.n_modes]
    return {
        "frames": delivery.frames,
        "lost": n_frames - delivery.frames,
        "late_share": delivery.late_share,
        "late_share_sent": delivery.late_share_sent,
        "observers": {name: _row(board[name], OBSERVERS[name].targets, modes) for name in dict.fromkeys(chosen)},
    }


def _row(counts: Counts, targets: Sequence[str], modes: Sequence[str]) -> dict[str, Any]:
    """Return what is told of an observer."""
    errors = {target: dict(zip(modes, map(_nanometres, counts.rms(target)), strict=True)) for target in targets}
    return {
        "p50_us": counts.latencies.quantile(0.5) * 1e6,
        "p99_9_us": counts.latencies.quantile(0.999) * 1e6,
        "late": int(counts.late[0]),
        "rms_nm": _nanometres(counts.total_rms(targets)),
        "errors_nm": errors,
    }


def _nanometres(x: float) -> float | None:
    return None if isnan(x) else float(x) * 1e3


def _await_observers(processes: LiveProcesses) -> None:
    """Wait until the observers are designed. Raises SettingError with the reason where one cannot be."""
    while not processes.are_ready:
        if not processes.observers_are_alive:
            sleep(TICK)  # the line may still be on its way
            lines = [line for _, line in processes.news()]
            raise SettingError(lines[-1] if lines else "the process of the observers has ended")
        sleep(TICK)


def _drain(
    processes: LiveProcesses,
    play: Callable[[int], None],
    n_frames: int,
    keep: Callable[[LiveFrame], None] | None,
    report: Callable[[float], None],
) -> None:
    """Play events, count every frame, and keep it, until all have been taken or no more come."""
    feed, delivery, kept, reported = processes.feed, processes.delivery, 0, 0
    is_over = False
    while not is_over:
        may_go_on = processes.observers_are_alive and (feed.is_alive or delivery.count < feed.ring.count)
        is_over = delivery.count >= n_frames or not may_go_on
        if not is_over:
            sleep(TICK)
        play(feed.ring.count)
        delivery.collect()
        for number in range(kept, delivery.count if keep else 0):
            if keep is not None and (frame := feed.ring.read(number)) is not None:
                keep(frame)
            kept = number + 1
        if delivery.count // 1000 > reported:
            reported = delivery.count // 1000
            report(delivery.count / n_frames)
