"""The tables of docs/events.md: `events.py [seeds] [preset, bridged, filled, loop, stars ...] [--observers ID,ID...]`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import groupby

import numpy as np

from wfsobs.cli.show import OverTime, recovery_texts
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.run import close_loop, closed_loop
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.result import row_label
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS
from wfsobs.observers.missing import fill_missing
from wfsobs.pipeline import run
from wfsobs.priors_from.scenario import arguments, prior_of
from wfsobs.record import hold_last
from wfsobs.scenario.presets import PRESETS
from wfsobs.simulation.loop import simulate
from wfsobs.telemetry.intake import without_bridged
from wfsobs.typing import Array

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


def tables(preset: str, seeds: int, observers: Sequence[str] | None) -> str:
    """Error on tip before, at its worst after and at the end, and the recovery time, as Markdown."""
    scenario = PRESETS[preset]()
    history = OverTime(scenario, WINDOW)
    for seed in range(1, seeds + 1):
        history.add(run(scenario.replace({"run.seed": seed}), observers=observers), seed)
    out = [f"`{preset}`, tip, rms over {WINDOW:g} s, {seeds} seeds together:\n"]
    lines = [line for line in history.recoveries() if line[0] in CASES[preset] and line[1] == "tip" and line[3] not in LEFT_OUT]
    for (target, _, event), group in groupby(lines, key=lambda line: line[:3]):
        out.append(f"| {target}, {event} | before, nm | worst after | at the end | recovery time, s |\n|---|---|---|---|---|")
        out += [f"| {row_label(name)} | {' | '.join(recovery_texts(r))} |" for *_, name, r in group]
        out.append("")
    return "\n".join(out)


def bridged(seeds: int, observers: Sequence[str] | None) -> str:
    """Error on tip within the lost frames of `lost-frames`, and over that of the same records with all their frames."""
    scenario = PRESETS["lost-frames"]()
    stretches = [(e.start, e.start + e.duration) for e in scenario.events]
    squares: dict[tuple[str, str, int], list[tuple[float, float]]] = {}
    for seed in range(1, seeds + 1):
        changes = ({"run.seed": seed}, {"run.seed": seed, "events": []})
        pair = [run(scenario.replace(change), observers=observers) for change in changes]
        for lossy, whole in zip(*(result.estimates for result in pair), strict=True):
            truth = getattr(pair[0].record, lossy.target)
            for i, stretch in enumerate(stretches):
                at = slice(*(round(t / scenario.dt) for t in stretch))
                means = [float(np.mean((e.values - truth)[at, 0] ** 2)) for e in (lossy, whole)]
                squares.setdefault((lossy.target, lossy.observer, i), []).append((means[0], means[1]))
    out = ["| | LGS frames lost, nm | over all frames | NGS frames lost, nm | over all frames |\n|---|---|---|---|---|"]
    for target, name in dict.fromkeys(key[:2] for key in squares):
        if name not in LEFT_OUT:
            error = [np.sqrt(np.mean(squares[target, name, i], axis=0)) for i in range(len(stretches))]
            out.append(f"| {target}, {row_label(name)} | {' | '.join(f'{1e3 * a:.2f} | {a / b:.3f}' for a, b in error)} |")
    return "\n".join(out)


LOOP_STRETCHES = {
    "laser-dropout": {
        "one laser out": (6.0, 10.0),
        "both out": (15.0, 16.0),
        "0.2 s after": (16.0, 16.2),
        "2 s after": (16.0, 18.0),
    },
    "lost-frames": {"LGS frames lost": (5.0, 10.0), "NGS frames lost": (13.0, 18.0)},
}
"""Preset -> stretches of its record [s]."""


def loop(seeds: int, controllers: Sequence[str] | None) -> str:
    """Residuals of tip in stretches of the presets that lose measurements, seeds together."""
    names, out = controllers or [name for name, c in CONTROLLERS.items() if c.predict is None and c.law is not None], []
    for preset, stretches in LOOP_STRETCHES.items():
        scenario = PRESETS[preset]()
        squares: dict[str, list[list[float]]] = {name: [] for name in names}
        for seed in range(1, seeds + 1):
            result = close_loop(scenario.replace({"run.seed": seed}), controllers=names)
            for one in result.outcomes:
                assert one.residual is not None
                cuts = [slice(round(a / scenario.dt), round(b / scenario.dt)) for a, b in stretches.values()]
                squares[one.controller].append([float(np.mean(one.residual[cut, 0] ** 2)) for cut in cuts])
        out.append(f"| `{preset}` | {', nm | '.join(stretches)}, nm |\n|---|{'---|' * len(stretches)}")
        for name, found in squares.items():
            out.append(f"| `{name}` | {' | '.join(f'{1e3 * x:.1f}' for x in np.sqrt(np.mean(found, axis=0)))} |")
        out.append("")
    return "\n".join(out)


ONE_OUT = {"run.duration": 8.0, "events": [{"kind": "laser", "start": 4.0, "duration": 4.0, "lasers": 1}]}
"""Changes of `laser-dropout`: one of two is out in the second half."""


def stars(seeds: int, names: Sequence[str] | None) -> str:
    """Errors and residuals of tip with one of two lasers out, of filters that take it for both and of such as are told."""
    names = names or ("kf-lgs", "kf-multi", "multirate", "multirate-optimal", "multirate-multi")
    scenario, squares = PRESETS["laser-dropout"]().replace(ONE_OUT), dict[str, list[list[float]]]()
    plan, half = design(scenario, [f"lqg-{name}" for name in names]), slice(round(4.0 / scenario.dt), None)
    for seed in range(1, seeds + 1):
        record = simulate(scenario.replace({"run.seed": seed}))
        errors: dict[str, list[Array]] = {}
        for one in (replace(record, lgs_stars=None), record):
            for name in names:
                found = OBSERVERS[name].estimate(*arguments(OBSERVERS[name], one, scenario.before_events))
                for target in OBSERVERS[name].targets:
                    errors.setdefault(f"{target}, {row_label(name)}", []).append(found[target] - record.truth(target))
            for outcome in closed_loop(one, plan).outcomes:
                assert outcome.residual is not None
                errors.setdefault(f"residual, `{outcome.controller}`", []).append(outcome.residual)
        for row, pair in errors.items():
            squares.setdefault(row, []).append([float(np.mean(x[half, 0] ** 2)) for x in pair])
    out = ["| one of two lasers out | taken for both, nm | told, nm |\n|---|---:|---:|"]
    for row, pairs in sorted(squares.items()):
        out.append(f"| {row} | {' | '.join(f'{1e3 * x:.2f}' for x in np.sqrt(np.mean(pairs, axis=0)))} |")
    return "\n".join(out)


AFTER = {"first frame": 1e-3, "0.2 s": 0.2, "2 s": 2.0}
"""Stretches after both lasers are back [s]."""


def filled(seeds: int, names: Sequence[str] | None) -> str:
    """Errors after both lasers are back, of missing frames that were filled in, over those of observers that are told."""
    names = names or ("kf-lgs", "kf-multi", "gp-lgs", "multirate", "multirate-optimal", "multirate-multi", "gp-both")
    scenario, squares = PRESETS["laser-dropout"](), dict[str, dict[str, list[list[float]]]]()
    settings, back = scenario.before_events, 16.0
    for seed in range(1, seeds + 1):
        record = simulate(scenario.replace({"run.seed": seed}))
        prior = prior_of(settings, record, OBSERVERS["kf-multi"].prior)
        bridges = {"held": hold_last(record.y_lgs), "predicted": fill_missing(record, prior).y_lgs}
        records = {"told": record}
        for name, y in bridges.items():
            records[name] = without_bridged(replace(record, y_lgs=y, lgs_stars=None))
            records[f"{name}, taken for measured"] = replace(record, y_lgs=y, lgs_stars=None)
        for how, one in records.items():
            for name in names:
                found = OBSERVERS[name].estimate(*arguments(OBSERVERS[name], one, settings))
                for target in OBSERVERS[name].targets:
                    error = found[target] - record.truth(target)
                    cuts = [slice(round(back / scenario.dt), round((back + length) / scenario.dt)) for length in AFTER.values()]
                    row = squares.setdefault(f"{target}, {row_label(name)}", {})
                    row.setdefault(how, []).append([float(np.mean(error[cut] ** 2)) for cut in cuts])
    hows = [how for how in records if how != "told"]
    out = [f"| {', '.join(AFTER)} after | {' | '.join(hows)} |\n|---|{'---|' * len(hows)}"]
    for row, of in sorted(squares.items()):
        told = np.mean(of["told"], axis=0)
        cells = (", ".join(f"{x:.3f}" for x in np.sqrt(np.mean(of[how], axis=0) / told)) for how in hows)
        out.append(f"| {row} | {' | '.join(cells)} |")
    return "\n".join(out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds", type=int, nargs="?", default=20)
    parser.add_argument("what", nargs="*", default=[*CASES, "bridged", "filled", "loop", "stars"])
    parser.add_argument("--observers", type=lambda text: text.split(","), help="these alone; all unless told")
    given = parser.parse_args()
    for one in given.what:
        make = {"bridged": bridged, "filled": filled, "loop": loop, "stars": stars}.get(one) or partial(tables, one)
        print(make(given.seeds, given.observers))
