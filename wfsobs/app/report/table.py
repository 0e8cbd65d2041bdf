"""The RMS table of one state as plain HTML, in nm; the page's script turns a copy of it to other units."""

from __future__ import annotations

import math
from html import escape
from itertools import groupby

from wfsobs.app.display import IN_MOST, NOTHING, number, per_micrometre
from wfsobs.app.report.data import State
from wfsobs.evaluation.rows import TIME, Row, competes, label_of, looks_ahead, own_stretch, stretch_of
from wfsobs.evaluation.scores import RESIDUAL

COLUMNS = {
    "Observer": "and its line in the figures",
    'RMS error [<span class="unit">nm</span>]': "of the estimate, after the warm-up, on samples that all have",
    'RMS truth [<span class="unit">nm</span>]': "the error of answering zero",
    "error / truth": "above 1 is worse than answering zero",
    "Needs": "what has to be given beside measurements",
    "Lag [ms]": "how late the estimate is",
    "Time per step [µs]": "computing time per step and mode",
    "Real-time factor": "time per step over the step of the loop; below 1 keeps up with it",
}
"""Heading -> explanation."""

WITHOUT_TRUTH = {name.replace("truth", "z"): why for name, why in COLUMNS.items()} | {
    'RMS error [<span class="unit">nm</span>]': "of z one step ahead, on samples that all have, or what the loop left"
}
"""The same where there is no truth."""

BEST, ABOVE = '<span class="tag best">best</span> ', '<span class="tag above">above truth</span> '


def state_table(state: State, name: str) -> str:
    """Every score of a state of some name, one body per target and mode, best first, and what is missing."""
    columns = WITHOUT_TRUTH if any(row["target"] == RESIDUAL for row in state.rows) else COLUMNS
    head = "".join(f'<th scope=col title="{why}">{name}</th>' for name, why in columns.items())
    groups = [list(rows) for _, rows in groupby(sorted(state.rows, key=_order(state.rows)), _group)]
    bodies = "".join(_body(state, rows) for rows in groups)
    why = "".join(f'<p class="failure">{escape(reason)}</p>' for reason in state.reasons)
    return (
        f'<div class="scroll" tabindex=0 role=region aria-label="RMS errors: {escape(name)}">'
        f'<table class="rms"><thead><tr>{head}</tr></thead>{bodies}</table></div>{why}'
    )


def _group(row: Row) -> tuple[str, str]:
    return row["target"], row["mode"]


def _order(rows: list[Row]):
    """Targets and modes as they come, best first, those that stand apart last."""
    groups = list(dict.fromkeys(map(_group, rows)))
    return lambda row: (groups.index(_group(row)), row["apart"], row["rms_um"])


def _body(state: State, rows: list[Row]) -> str:
    target, mode = _group(rows[0])
    best = min((row["rms_um"] for row in rows if competes(row["observer"], row["apart"])), default=math.inf)
    name = ", ".join((target.capitalize(), escape(mode), *filter(None, [stretch_of(rows)])))
    title = f'<tr><th colspan={len(COLUMNS)} class="target" scope=rowgroup>{name}</th></tr>'
    return (
        f'<tbody data-target="{target}" data-mode="{escape(mode)}">{title}'
        f"{''.join(_row(state, row, row['rms_um'] == best and competes(row['observer'], row['apart'])) for row in rows)}</tbody>"
    )


def _row(state: State, row: Row, best: bool) -> str:
    name, time = row["observer"], row[TIME]
    label = escape(label_of(name)) + (" <sup>looks ahead</sup>" if looks_ahead(name) else "") + apart(own_stretch(row))
    lag = NOTHING if row["lag_s"] is None else f"{1e3 * row['lag_s']:.2f}".replace("-", "−")
    cells = [
        f"<td>{BEST if best else ''}{length(row['rms_um'])}{_interval(row['interval_um'])}</td>",
        f"<td>{length(row['truth_rms_um'])}</td>",
        f"<td>{ABOVE if (row['normalised_rms'] or 0.0) > 1.0 else ''}{number(row['normalised_rms'])}</td>",
        f"<td class=words>{row['needs']}</td>",
        f"<td>{lag}</td>",
        f"<td>{number(time)}</td>",
        f"<td>{number(None if time is None else 1e-6 * time / state.grid.dt, 2)}</td>",
    ]
    return f'<tr data-observer="{name}"><th scope=row>{swatch(name)}{label}</th>{"".join(cells)}</tr>'


def apart(stretch: str) -> str:
    """What is beside the name of an observer that was scored on samples of its own."""
    return f" <sup>{stretch}</sup>" if stretch else ""


def _interval(interval: list[float] | None) -> str:
    if interval is None:
        return ""
    low, high = map(length, interval)
    return f' <span class="range" title="{IN_MOST}">{low} – {high}</span>'


def length(um: float) -> str:
    """A length of the wavefront, in nm until the page says otherwise."""
    return f'<span data-um="{um!r}">{number(um * per_micrometre("nm", 1.0))}</span>'


def swatch(name: str) -> str:
    """A short line as drawn in the figures; its symbol is in the page once."""
    return f'<svg class="swatch" width="26" height="8" aria-hidden="true"><use href="#line-{name}"/></svg>'
