"""The tables of docs/events.md: `python docs/scripts/events.py [seeds] [preset ...]`."""

from __future__ import annotations

import sys
from itertools import groupby

from wfsobs.cli.recovery_tables import OverTime, recovery_texts
from wfsobs.evaluation.rows import label_of
from wfsobs.observers.base import TARGETS
from wfsobs.pipeline import run
from wfsobs.scenario.presets import PRESETS

CASES = {
    "peak-jump": TARGETS[1:],
    "peak-drift": TARGETS[1:],
    "wind-change": TARGETS,
    "laser-dropout": TARGETS,
    "lost-frames": TARGETS,
}
"""Preset -> the targets that are worth a table."""
WINDOW = 2.0
LEFT_OUT = ("zero", "ridge", "persistence")


def tables(preset: str, seeds: int) -> str:
    """Error on tip before, at its worst after and at the end, and the time to be back, as markdown."""
    scenario = PRESETS[preset]()
    history = OverTime(scenario, WINDOW)
    for seed in range(1, seeds + 1):
        history.add(run(scenario.replace({"run.seed": seed})), seed)
    out = [f"`{preset}`, tip, rms over {WINDOW:g} s, {seeds} seeds together:\n"]
    lines = [line for line in history.recoveries() if line[0] in CASES[preset] and line[1] == "tip" and line[3] not in LEFT_OUT]
    for (target, _, event), group in groupby(lines, key=lambda line: line[:3]):
        out.append(f"| {target}, {event} | before, nm | worst after | at the end | back after, s |\n|---|---|---|---|---|")
        out += [f"| {label_of(name)} | {' | '.join(recovery_texts(r))} |" for *_, name, r in group]
        out.append("")
    return "\n".join(out)


if __name__ == "__main__":
    number, *chosen = sys.argv[1:] or ["20"]
    for one in chosen or CASES:
        print(tables(one, int(number)))
