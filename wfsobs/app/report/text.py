"""The words of a report: names and values of settings, what the page needs to say what the numbers mean, the command."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Iterable, Sequence
from datetime import datetime
from typing import Any

from wfsobs import __version__
from wfsobs.app.display import label_of
from wfsobs.app.report.data import Report, State, window_of
from wfsobs.bench.measure import machine
from wfsobs.evaluation.scores import BOUND, RESIDUAL
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import changed_settings, format_value, reference_preset, to_toml

LONGEST = 8000
"""Characters of a command line; settings that need more go by file."""

FILE = "wfsobs.toml"


def summary(report: Report, date: datetime) -> str:
    """Say in one line what this is."""
    base, count = report.base, len(changed_settings(report.base, reference_preset(report.preset)))
    length = report.states[0].grid.n * report.states[0].grid.dt
    parts = [
        f"Preset {report.preset}" + (f", {count} setting{'s' * (count > 1)} changed" if count else ""),
        f"{length:g} s at {base.sensors.lgs_rate:g} Hz",
        "of a loaded record" if report.is_recorded else f"seed {base.run.seed}",
        *([f"{len(report.states)} variations"] if len(report.states) > 1 else []),
        f"made {date:%Y-%m-%d %H:%M %Z}".rstrip() + f" with wfsobs {__version__}",
    ]
    return " · ".join(parts)


# ---------------------------------------------------------------------- settings in words


def setting_label(scenario: Scenario, path: str) -> str:
    """Write a setting's label with its unit in [brackets]; the path itself if it has no label."""
    p = {known: p for known, _, p in scenario.walk()}.get(path)
    return path if p is None else label_of(p)


def value_of(value: Any) -> str:
    """Write a setting's value for people."""
    if isinstance(value, bool):
        return "on" if value else "off"
    text = f"{value:.6g}" if isinstance(value, (int, float)) else format_value(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def state_name(report: Report, state: State, index: int) -> str:
    """Name a state by the values of what varies."""
    parts = []
    for variation, value in zip(report.variations, values_of(report, index), strict=True):
        label, bracket, unit = setting_label(state.scenario, variation.path).partition(" [")
        parts.append(f"{label} {value_of(value)}{' ' + unit.rstrip(']') if bracket else ''}")
    return ", ".join(parts)


def values_of(report: Report, index: int) -> list[Any]:
    """List the value of every variation in a state."""
    out = []
    for variation in reversed(report.variations):
        index, at = divmod(index, len(variation.values))
        out.append(variation.values[at])
    return out[::-1]


# ---------------------------------------------------------------------- sections


def scenario_values(report: Report) -> dict[str, Any]:
    """Collect what differs from the preset, what varies, and every setting."""
    preset = reference_preset(report.preset)
    toml = f'preset = "{report.preset}"\n{to_toml(report.base)}'
    return {
        "changed": [
            {
                "name": setting_label(report.base, path),
                "path": path,
                "before": value_of(_at(preset, path)),
                "now": value_of(value),
            }
            for path, value in changed_settings(report.base, preset).items()
        ],
        "variations": [
            {
                "name": setting_label(report.states[0].scenario, v.path),
                "path": v.path,
                "texts": [value_of(value) for value in v.values],
            }
            for v in report.variations
        ],
        "file": FILE,
        "toml": toml,
        "toml_base64": base64.b64encode(toml.encode()).decode(),
    }


def meaning_values(report: Report) -> dict[str, Any]:
    """Collect what the explanation of the numbers depends on.

    matched : what the Kalman filters are given that a real one has to estimate
    points  : points kept of a trace, the fewest and the most of the states; none where every sample is
    """
    rows = [row for state in report.states for row in state.rows]
    kalman, grids = report.base.kalman, [state.grid for state in report.states]
    noises = {"disturbances": kalman.process_noise, "sensor noise": kalman.measurement_noise}
    counts = sorted({g.n if g.whole else 2 * g.bins + g.width for g in grids})
    return {
        "warm_up": f"{report.base.run.warm_up:g}",
        "truthless": any(row["target"] == RESIDUAL for row in rows),
        "bounded": any(row["observer"] == BOUND for row in rows),
        "seeds": n_seeds(report),
        "budgeted": any(state.budgets for state in report.states),
        "matched": [what for what, how in noises.items() if how == "matched"],
        "points": [] if all(g.whole for g in grids) else counts if len(counts) < 2 else [counts[0], counts[-1]],
        "window": window_of(report.states),
    }


def n_seeds(report: Report) -> int:
    """Return the number of seeds that the errors rest on."""
    return max((int(state.seeds.get("count", 1)) for state in report.states), default=1)


def origin_values(report: Report, date: datetime) -> dict[str, Any]:
    """Collect versions, date, seed, and the command that makes the report again."""
    command, by_file = command_of(report)
    facts = {"Program": f"wfsobs {__version__}, {machine(('bokeh',))}", "Made": f"{date:%Y-%m-%d %H:%M:%S %Z}".rstrip()}
    if not report.is_recorded:
        facts["Seed"] = str(report.base.run.seed)
    return {"facts": facts, "command": command, "by_file": by_file}


def command_of(report: Report) -> tuple[str, bool]:
    """Write the command line of a report; say whether it takes its settings from FILE, being too long otherwise."""
    if report.is_recorded:
        command = report.command or f"wfsobs observe RECORD --config {FILE}"
        return command, f"--config {FILE}" in command
    changed = changed_settings(report.base, reference_preset(report.preset))
    seeds = n_seeds(report)
    ends = [*_words("--vary", report.variations), *(["--seeds", str(seeds)] if seeds > 1 else [])]
    command = _command(
        ["--preset", report.preset, *_words("--set", (f"{k}={format_value(v)}" for k, v in changed.items())), *ends]
    )
    return (command, False) if len(command) <= LONGEST else (_command(["--config", FILE, *ends]), True)


def _command(words: Sequence[str]) -> str:
    return shlex.join(["wfsobs", "export", "report.html", *words])


def _words(option: str, values: Iterable[object]) -> list[str]:
    return [word for value in values for word in (option, str(value))]


def _at(scenario: Scenario, path: str) -> Any:
    """Look up the plain value at a dotted path of groups."""
    node: Any = scenario.to_dict()
    for key in path.split("."):
        node = node[key]
    return node
