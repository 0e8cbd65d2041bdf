"""What the arena is: its scenarios, seeds and rules, from one versioned TOML file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wfsobs.scenario.configfile import parse_toml, preset
from wfsobs.settings.values import SettingError, leaves
from wfsobs.simulation.disturbance import period_steps
from wfsobs_arena.cases import Case, SimulatedCase
from wfsobs_arena.telemetry import TelemetryCase
from wfsobs_arena.tracks import TRACKS

FILE = Path(__file__).with_name("arena.toml")
"""The arena of this version."""

KEYS = ("version", "seeds", "first_seed", "reach", "time_limit", "memory", "settings", "scenario")
OF_SCENARIO = ("track", "name", "help", "preset", "settings")

QUICK_SEEDS, QUICK_DURATION, QUICK_WARM_UP = 2, 3.0, 1.0
"""Seeds, length [s] and warm-up [s] of a trial of the arena, whose scores say nothing."""


@dataclass(frozen=True)
class Rules:
    """Limits of an entry.

    Attributes
    ----------
    time_limit : float
        Time for a record over its length.
    memory : float
        Address space of its process [GB].
    """

    time_limit: float
    memory: float

    LEAST_TIME = 60.0

    def seconds(self, duration: float) -> float:
        """Return the time [s] that an entry has for a record of this length [s].

        >>> Rules(20.0, 4.0).seconds(9.0)
        180.0
        """
        return max(self.LEAST_TIME, self.time_limit * duration)


@dataclass(frozen=True)
class Arena:
    """The arena.

    Attributes
    ----------
    version : int
        Of scenarios, rules and score.
    cases : tuple of Case
        Scenarios, in the order of the tracks.
    rules : Rules
        Limits of an entry.
    """

    version: int
    cases: tuple[Case, ...]
    rules: Rules

    @property
    def digest(self) -> str:
        """SHA-256 of version, rules and records."""
        known = [self.version, [self.rules.time_limit, self.rules.memory], [case.digest for case in self.cases]]
        return hashlib.sha256(json.dumps(known).encode()).hexdigest()


def load_arena(path: Path = FILE, *, seeds: int | None = None, quick: bool = False) -> Arena:
    """Read the arena.

    Parameters
    ----------
    path : Path
        TOML file.
    seeds : int, optional
        Number of seeds; by default that of the file.
    quick : bool
        Whether to take few seeds, short records and the first scenario of each track, for a trial.

    Returns
    -------
    Arena
        Scenarios and rules.

    Raises
    ------
    SettingError
        A value cannot be used.
    OSError
        The file cannot be read.
    """
    values = parse_toml(path.read_text(encoding="utf-8"))
    _check_keys(values, KEYS, "arena")
    count = min(seeds or values["seeds"], QUICK_SEEDS if quick else values["seeds"])
    chosen = range(values["first_seed"], values["first_seed"] + count)
    cases = [_case(entry, values["settings"], chosen, values["reach"], quick) for entry in values["scenario"]]
    if quick:
        cases = list({case.track: case for case in reversed(cases)}.values())
    names = [(case.track, case.name) for case in cases]
    if len(set(names)) < len(names):
        raise SettingError("arena: two scenarios of a track have one name")
    cases.sort(key=lambda case: list(TRACKS).index(case.track))
    return Arena(values["version"], tuple(cases), Rules(values["time_limit"], values["memory"]))


def add_records(arena: Arena, files: Sequence[Path]) -> Arena:
    """Return the arena with records of telemetry. Raises RecordError where one cannot be used, SettingError for equal names."""
    given = [TelemetryCase(path) for path in files]
    for case in given:
        case.whole  # noqa: B018  read now: a file that cannot be used ends nothing that has run long
        if [other.name for other in given].count(case.name) > 1:
            raise SettingError(f"--record {case.path}: two records have the name {case.name}")
    return Arena(arena.version, (*arena.cases, *given), arena.rules)


def _case(entry: Mapping[str, Any], common: Mapping[str, Any], seeds: range, reach: float, quick: bool) -> SimulatedCase:
    _check_keys(entry, OF_SCENARIO, "arena.scenario")
    track, name = entry["track"], entry["name"]
    if track not in TRACKS:
        raise SettingError(f"arena.scenario {name}: track {track!r} is not one of {', '.join(TRACKS)}")
    changes = {**dict(leaves(common)), **dict(leaves(entry.get("settings", {})))}
    if quick:
        changes |= {"run.duration": QUICK_DURATION, "run.warm_up": QUICK_WARM_UP, "adaptive.window": 0.5, "events": []}
        changes = {path: value for path, value in changes.items() if not path.startswith("events.")}
    scenario = preset(entry["preset"]).replace(changes)
    scenario.validate()
    n = scenario.n_steps
    if scenario.vibration.synthesis != "gaussian" or period_steps(scenario, n) < reach * n:
        raise SettingError(f"arena.scenario {name}: a record takes a synthesis {reach:g} times as long, without random phases")
    return SimulatedCase(track, name, entry.get("help", ""), seeds, scenario)


def _check_keys(values: Mapping[str, Any], keys: tuple[str, ...], where: str) -> None:
    for key in values:
        if key not in keys:
            raise SettingError(f"{where}.{key}: takes {', '.join(keys)}")
