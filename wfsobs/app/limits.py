"""What a visitor may ask of a server: the bounds on a run, on messages and on visitors, all in one place."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

from wfsobs.app.jobs import Job, Work
from wfsobs.cost import run_bytes, run_seconds
from wfsobs.scenario import Scenario
from wfsobs.settings.values import Reals, SettingError


@dataclass(frozen=True)
class Limits:
    """Bounds that hold on top of those of the settings; infinite unless given.

    duration      : length of a record [s]
    steps         : of a record
    training_size : m of either GPR
    depth         : d of either GPR
    items         : entries in a list of settings: peaks, layers, bands, rows of a PSD table
    seconds       : how long a run takes, as estimated from its settings [s]
    megabytes     : memory of a run, likewise [MB]
    sessions      : open pages
    sweep_seconds : how long all runs of a sweep take, as estimated [s]
    live_seconds  : how long a live loop goes on [s]
    """

    duration: float = inf
    steps: float = inf
    training_size: float = inf
    depth: float = inf
    items: float = inf
    seconds: float = inf
    megabytes: float = inf
    sessions: float = inf
    sweep_seconds: float = inf
    live_seconds: float = inf

    def check(self, scenario: Scenario) -> None:
        """Raise SettingError, one line, where a run of this scenario is more than the server allows."""
        _most("run.duration", scenario.run.duration, self.duration, " s")
        if scenario.n_steps > self.steps:
            raise SettingError(
                f"run.duration = {scenario.run.duration:g}: {scenario.n_steps} steps at sensors.lgs_rate = "
                f"{scenario.sensors.lgs_rate:g} Hz; at most {self.steps:g} on this server"
            )
        for name in ("gpr_offline", "gpr_online"):
            group = getattr(scenario, name)
            _most(f"{name}.training_size", group.training_size, self.training_size)
            _most(f"{name}.depth", group.depth, self.depth)
        of_groups = [(path, len(scenario.lookup(path))) for path, _ in scenario.lists()]
        of_numbers = [(path, len(getattr(owner, str(p.name)))) for path, owner, p in scenario.walk() if isinstance(p, Reals)]
        for path, items in (*of_groups, *of_numbers):
            if items > self.items:
                raise SettingError(f"{path}: {items} entries, at most {self.items:g} on this server")
        _whole(run_seconds(scenario), self.seconds, "s")
        _whole(run_bytes(scenario) / 1e6, self.megabytes, "MB of memory")

    def job(self, kind: str, what: str, work: Work, seconds: float) -> Job:
        """Make the job of a computation beside the runs. Raises SettingError where it would take longer than a run may."""
        if seconds > self.seconds:
            raise SettingError(f"The {what} would take about {seconds:.0f} s, at most {self.seconds:g} on this server")
        return Job(kind, work, cost=seconds, time_limit=self.seconds)

    def check_sweep(self, seconds: float, runs: int) -> None:
        """Raise SettingError where a sweep of so many runs would take longer than one may."""
        if seconds > self.sweep_seconds:
            raise SettingError(
                f"{runs} runs would take about {seconds:.0f} s, at most {self.sweep_seconds:g} on this server: take fewer "
                "values, seeds or observers, or a shorter run.duration"
            )

    def check_steps(self, n_steps: int) -> None:
        """Raise SettingError where a loaded record is longer than the server allows."""
        if n_steps > self.steps:
            raise SettingError(f"The record has {n_steps} steps; at most {self.steps:g} on this server")


NONE = Limits()
"""For those who serve themselves."""

PUBLIC = Limits(
    duration=120.0,
    steps=120_000,
    training_size=1024,
    depth=1000,
    items=100,
    seconds=20.0,
    megabytes=600.0,
    sessions=100,
    sweep_seconds=300.0,
    live_seconds=60.0,
)
"""For a server that strangers reach."""


def _most(path: str, value: float, most: float, unit: str = "") -> None:
    if value > most:
        raise SettingError(f"{path} = {value:g}: at most {most:g}{unit} on this server")


def _whole(value: float, most: float, what: str) -> None:
    if value > most:
        raise SettingError(
            f"The run would take about {value:.0f} {what}, at most {most:g} on this server: lower "
            "run.duration, sensors.lgs_rate, gpr_online.training_size or gpr_offline.training_size, or raise "
            "adaptive.interval"
        )
