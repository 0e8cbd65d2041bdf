"""A report on its way to another process: text and plain arrays, never a pickle."""

from __future__ import annotations

import io
import json

import numpy as np

from wfsobs.app.report.data import Report, State
from wfsobs.app.report.grid import Floats, Grid
from wfsobs.scenario.configfile import from_toml, to_toml
from wfsobs.scenario.grid import Variation


def pack(report: Report) -> bytes:
    """Write a report as a file of plain arrays and text."""
    words = {
        "preset": report.preset,
        "base": to_toml(report.base),
        "recorded": report.is_recorded,
        "command": report.command,
        "sweep": report.sweep,
        "comparison": report.comparison,
        "variations": [[v.path, v.values] for v in report.variations],
        "states": [
            {
                "toml": to_toml(s.scenario),
                "rows": s.rows,
                "reasons": s.reasons,
                "grid": [s.grid.n, s.grid.dt, s.grid.bins],
                "loop": list(s.loop),
                "budgets": list(s.budgets),
                "seeds": s.seeds,
                "verdicts": list(s.verdicts),
                "main": s.main,
            }
            for s in report.states
        ],
    }
    arrays = {f"{i}/{name}": line for i, s in enumerate(report.states) for name, line in s.lines.items()}
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, words=np.array(json.dumps(words)), **arrays)
    return file.getvalue()


def unpack(content: bytes) -> Report:
    """Read the report that `pack` wrote."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        words = json.loads(str(file["words"]))
        lines: list[dict[str, Floats]] = [{} for _ in words["states"]]
        for key in file.files:
            number, slash, name = key.partition("/")
            if slash:
                lines[int(number)][name] = file[key]
    states = tuple(
        State(
            from_toml(s["toml"]),
            s["rows"],
            tuple(s["reasons"]),
            Grid(*s["grid"]),
            of,
            *(s[name] for name in ("loop", "budgets", "seeds", "verdicts", "main")),
        )
        for s, of in zip(words["states"], lines, strict=True)
    )
    variations = tuple(Variation(path, tuple(values)) for path, values in words["variations"])
    rest = (words[name] for name in ("recorded", "command", "sweep", "comparison"))
    return Report(words["preset"], from_toml(words["base"]), variations, states, *rest)
