"""What commands and scripts that are copied have in common: settings, and the record that was loaded."""

from __future__ import annotations

import json
import shlex

from wfsobs.app.share import LONGEST, changes
from wfsobs.app.sources import LoadedRecord
from wfsobs.scenario import Scenario, configfile


def as_path(name: str) -> str:
    """Return the name of a file; one that starts with a dash would be read as an option."""
    return f"./{name}" if name.startswith("-") else name


def given_options(scenario: Scenario, preset: str, file: str) -> list[str]:
    """List the options that give the settings, or a file of them where they are long."""
    words = ["--preset", preset]
    for path, value in changes(scenario, preset).items():
        words += ["--set", f"{path}={configfile.format_value(value)}"]
    return words if len(shlex.join(words)) <= LONGEST else ["--config", file]


def stated_options(source: LoadedRecord) -> list[str]:
    """List what the user stated about a file, and what tells the file from others."""
    stated = source.declaration
    sign = None if stated.command_sign is None else f"{stated.command_sign:+d}"
    named = {
        "unit": stated.unit,
        "command-sign": sign,
        "command-delay": stated.command_delay,
        "rate": stated.rate,
        "sha256": source.sha256 or None,
    }
    words = [word for name, value in named.items() if value is not None for word in (f"--{name}", str(value))]
    words += ["--trust"] * stated.trust
    return words + [word for role, name in stated.columns.items() for word in ("--column", f"{role}={name}")]


RECORD_IMPORTS = {"from wfsobs.telemetry.intake import DeclaredFormat", "from wfsobs.telemetry.records import load_record"}
"""Of `record_code`."""


def record_code(source: LoadedRecord) -> str:
    """Write the line of Python that loads a record."""
    stated = "".join(f"{name}={value!r}, " for name, value in vars(source.declaration).items() if value not in (None, {}, False))
    check = f", sha256={source.sha256!r}" if source.sha256 else ""
    return f"record = load_record({source.name!r}, scenario, DeclaredFormat({stated.removesuffix(', ')}){check})"


def import_order(line: str) -> tuple[bool, str]:
    """Return the place of a line among the imports."""
    return line.startswith("from"), line


def scenario_code(scenario: Scenario, preset: str, file: str) -> str:
    """Write the settings as an expression of Python, or the loading of a file of them where they are long."""
    lines = [f"    {json.dumps(path)}: {value!r},\n" for path, value in changes(scenario, preset).items()]
    made = f'wfsobs.PRESETS["{preset}"]()' + (f".replace({{\n{''.join(lines)}}})" if lines else "")
    return made if len(made) <= LONGEST else f'configfile.load_scenario("{file}")'
