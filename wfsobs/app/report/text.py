"""The words of a report: scenario, what the numbers mean, what it was made with."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Iterable, Sequence
from datetime import datetime
from html import escape
from typing import Any

from wfsobs import __version__
from wfsobs.app.display import label_of
from wfsobs.app.report.data import Report, State, window_of
from wfsobs.bench.measure import machine
from wfsobs.evaluation.scores import BOUND, RESIDUAL
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import changes, pristine, to_toml, written

LONGEST = 8000
"""Characters of a command line; settings that need more go by file."""

FILE = "wfsobs.toml"


def summary(report: Report, made: datetime) -> str:
    """One line on what this is."""
    base, count = report.base, len(changes(report.base, pristine(report.preset)))
    length = report.states[0].grid.n * report.states[0].grid.dt
    parts = [
        f"Preset {escape(report.preset)}" + (f", {count} setting{'s' * (count > 1)} changed" if count else ""),
        f"{length:g} s at {base.sensors.lgs_rate:g} Hz",
        "of a loaded record" if report.recorded else f"seed {base.run.seed}",
        *([f"{len(report.states)} variations"] if len(report.states) > 1 else []),
        f"made {made:%Y-%m-%d %H:%M %Z}".rstrip() + f" with wfsobs {__version__}",
    ]
    return " · ".join(parts)


# ---------------------------------------------------------------------- settings in words


def name_of(scenario: Scenario, path: str) -> str:
    """A setting's label, its unit in [brackets]; the path itself of what has none."""
    p = {known: p for known, _, p in scenario.walk()}.get(path)
    return path if p is None else label_of(p)


def value_of(value: Any) -> str:
    """A setting's value for people."""
    if isinstance(value, bool):
        return "on" if value else "off"
    text = f"{value:.6g}" if isinstance(value, (int, float)) else written(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def state_name(report: Report, state: State, index: int) -> str:
    """A state by the values of what varies."""
    parts = []
    for variation, value in zip(report.variations, values_of(report, index), strict=True):
        label, bracket, unit = name_of(state.scenario, variation.path).partition(" [")
        parts.append(f"{label} {value_of(value)}{' ' + unit.rstrip(']') if bracket else ''}")
    return ", ".join(parts)


def values_of(report: Report, index: int) -> list[Any]:
    """The value of every variation in a state."""
    out = []
    for variation in reversed(report.variations):
        index, at = divmod(index, len(variation.values))
        out.append(variation.values[at])
    return out[::-1]


# ---------------------------------------------------------------------- sections


def scenario_section(report: Report) -> str:
    """What differs from the preset, what varies, and every setting folded away."""
    preset = pristine(report.preset)
    rows = [
        f"<tr><th scope=row>{escape(name_of(report.base, path))}<br><code>{escape(path)}</code></th>"
        f"<td>{escape(value_of(_at(preset, path)))}</td><td>{escape(value_of(value))}</td></tr>"
        for path, value in changes(report.base, preset).items()
    ]
    changed = (
        (
            '<div class="scroll" tabindex=0 role=region aria-label="Settings changed"><table class="settings"><thead><tr>'
            f"<th scope=col>Setting</th><th scope=col>Preset {escape(report.preset)}</th><th scope=col>Here</th></tr></thead>"
            f"<tbody>{''.join(rows)}</tbody></table></div>"
        )
        if rows
        else f"<p>Every setting is that of the preset {escape(report.preset)}.</p>"
    )
    varied = "".join(
        f"<li>{escape(name_of(report.states[0].scenario, v.path))} (<code>{escape(v.path)}</code>): "
        f"{escape(', '.join(map(value_of, v.values)))}</li>"
        for v in report.variations
    )
    text = f'preset = "{report.preset}"\n{to_toml(report.base)}'
    link = f"data:application/toml;base64,{base64.b64encode(text.encode()).decode()}"
    return (
        f"{changed}{f'<p>Varied:</p><ul>{varied}</ul>' if varied else ''}"
        f'<details><summary>Every setting, as TOML</summary><p><a download={FILE} href="{link}">Save as {FILE}</a></p>'
        f"<pre tabindex=0><code>{escape(text)}</code></pre></details>"
    )


def meaning_section(report: Report) -> str:
    """What the numbers mean, and what they do not."""
    base = report.base
    points = [
        f"<b>RMS error</b>: root mean square of estimate minus truth, after a warm-up of {base.run.warm_up:g} s, over the steps "
        "for which every observer of the target and mode gives an estimate; a row with a stretch beside its name has "
        "its own, and is not compared with the others. One record of one seed: another "
        "seed gives other numbers (<code>wfsobs run --seeds 20</code> shows how much).",
        "<b>No truth</b>: in place of the error of an estimate there is that of its prediction of the next measurement z, noise "
        "included, of whoever estimates both turbulence and vibration; and the residual, what the recorded loop left of z. "
        "Both are divided by the rms of z."
        if _truthless(report)
        else "",
        "<b>error / truth</b> (normalised error): that error over the rms of the truth in the same steps. At 1 an observer does "
        "no better than answering zero, which is the row <b>Zero</b>, a baseline and not an observer; above 1 it does harm.",
        "<b>Looks ahead</b>: the open-loop Butterworth runs forward and backward over measurements with the mirror at rest. It "
        "uses later samples, so no controller can have it, and it is never marked best. All others are causal: an estimate at "
        "a step uses nothing measured after it.",
        "<b>Bound, mean of the LGS</b>: the least error that any causal observer of the mean of the LGS could have with the true "
        "spectra of the scenario, after an endless record; no observer, and never marked best. Beside it where the error of an "
        "optimal observer that starts with the record lies in 95 % of records."
        if _bounded(report)
        else "",
        "<b>Lag</b>: the delay at which an estimate is most like the truth; positive is late. Of signals with a strong line it "
        "can be negative without any look ahead.",
        "<b>Time per step</b>: measured once on the machine named below, per mode; the one column that is not reproducible.",
        "<b>Units</b>: Noll-normalised Zernike coefficients, rms over the pupil; tip and tilt in mas are 4 a / D on the sky, "
        "with the aperture diameter D.",
        _matched(base),
        _points(report),
    ]
    if len(report.states) > 1:
        points.append(
            "Variations of the same seed and length share their random numbers, so that differences come from the "
            "settings and not from chance."
        )
    return f"<ul>{''.join(f'<li>{point}</li>' for point in points if point)}</ul>"


def _truthless(report: Report) -> bool:
    return any(row["target"] == RESIDUAL for state in report.states for row in state.rows)


def _bounded(report: Report) -> bool:
    return any(row["observer"] == BOUND for state in report.states for row in state.rows)


def _matched(base: Scenario) -> str:
    """What the filters are told that a real one is not."""
    told = [
        what
        for what, how in (("disturbances", base.kalman.process_noise), ("sensor noise", base.kalman.measurement_noise))
        if how == "matched"
    ]
    return (
        (
            f"The Kalman filters are told the strength of the simulated {' and '.join(told)} (<code>matched</code>); a real one "
            "has to estimate it. The RMS errors are thus those of a well-tuned filter."
        )
        if told
        else ""
    )


def _points(report: Report) -> str:
    """What the lines keep of the samples."""
    grids = [state.grid for state in report.states]
    counts = sorted({g.n if g.whole else 2 * g.bins + g.width for g in grids})
    window = window_of(report.states)
    if all(g.whole for g in grids):
        kept = "The traces keep every sample"
    else:
        many = " to ".join(f"{n}" for n in (counts[0], counts[-1])[: len(counts)])
        kept = f"Each trace keeps {many} points: the lowest and the highest sample of equal bins"
        kept += f", but every sample from {window[0]:.3f} to {window[1]:.3f} s (shaded)" if window else ""
    return (
        f"{kept}. Zooming in shows no more than these; spectra (Welch, Hann windows of 2 s) and tables come from all "
        "samples. Lines are drawn to 1/65000 of their range."
    )


def origin_section(report: Report, made: datetime) -> str:
    """Versions, date, seed, and the command that makes the report again."""
    command, by_file = command_of(report)
    facts = {
        "Program": f"wfsobs {__version__}, {machine(('bokeh',))}",
        "Made": f"{made:%Y-%m-%d %H:%M:%S %Z}".rstrip(),
        **({} if report.recorded else {"Seed": str(report.base.run.seed)}),
    }
    if report.recorded:
        command, by_file = f"wfsobs observe RECORD --config {FILE}", True
    listed = "".join(f"<dt>{name}</dt><dd>{escape(fact)}</dd>" for name, fact in facts.items())
    note = f" with the settings above saved as {FILE}" if by_file else ""
    what = "These estimates of the record again" if report.recorded else "This report again"
    return f"<dl>{listed}</dl><p>{what}{note}:</p><pre class=command><code>{escape(command)}</code></pre>"


def command_of(report: Report) -> tuple[str, bool]:
    """The command line of a report, and whether it takes its settings from FILE, as too long to be written out."""
    changed = changes(report.base, pristine(report.preset))
    ends = _words("--vary", report.variations)
    command = _command(["--preset", report.preset, *_words("--set", (f"{k}={written(v)}" for k, v in changed.items())), *ends])
    return (command, False) if len(command) <= LONGEST else (_command(["--config", FILE, *ends]), True)


def _command(words: Sequence[str]) -> str:
    return shlex.join(["wfsobs", "export", "report.html", *words])


def _words(option: str, values: Iterable[object]) -> list[str]:
    return [word for value in values for word in (option, str(value))]


def _at(scenario: Scenario, path: str) -> Any:
    """The plain value at a dotted path of groups."""
    node: Any = scenario.to_dict()
    for key in path.split("."):
        node = node[key]
    return node
