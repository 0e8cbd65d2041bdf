"""The bar at the top: its style, and the state of the run in it."""

from __future__ import annotations

import param

from wfsobs.app.component import Component
from wfsobs.app.controls.names import setting_name
from wfsobs.app.jobs import CANCELLED, DONE, FAILED, RUNNING
from wfsobs.app.store import Store
from wfsobs.app.style import script, sheets
from wfsobs.app.work import RunResults

ON_BAR = {
    "color": "#fff",
    "borderColor": "#fff",
    "&.Mui-disabled": {"color": "#ffffff80", "borderColor": "#ffffff60"},
    "&:hover": {"backgroundColor": "#ffffff30", "borderColor": "#fff", "color": "#fff"},
    "@media (max-width: 600px)": {
        "fontSize": 0,
        "minWidth": "40px",
        "height": "34px",
        "padding": 0,
        "& .MuiButton-startIcon": {"margin": 0, "fontSize": "22px"},
    },
}
"""Buttons on the bar at the top, which is dark in either mode; on a phone their icons alone are seen."""

BAR = ":host { align-items: center; }"

STATUS_ON_BAR = """
:host { color: #fff; display: contents !important; }
progress::-webkit-progress-value { background: #8fd3f0; }
progress::-moz-progress-bar { background: #8fd3f0; }
.line { white-space: nowrap; }
.note { color: #ffc9c2; height: auto; }
"""


class Status(Component):
    """The state of the run in the browser."""

    progress: param.Number[float] = param.Number(0.0, doc="Fraction done.")
    text: param.String[str] = param.String("", doc="The state, in words.")
    note: param.String[str] = param.String("", doc="What was refused.")
    label: param.String[str] = param.String("Progress of the run", doc="What the bar is the progress of.")

    _esm = script("status")
    _stylesheets = sheets("base", "status")


def status_of(store: Store) -> tuple[float, str, str]:
    """Return how much of the run is done, its state in one line, and what was refused in another.

    Work that goes on after it takes its place.
    """
    run, progress = store.run, store.run.progress
    seconds = f" in {run.result.seconds:.2f} s{_share(run.result)}" if run.result and run.state == DONE else ""
    text = {
        RUNNING: run.line(),
        DONE: f"Done{seconds}",
        CANCELLED: "Cancelled",
        FAILED: "The run failed",
    }.get(run.state, "")
    if store.waiting:
        text = waiting_text(store.waiting)
    elif run.state != RUNNING and store.session.doing:
        progress, text = next(reversed(store.session.doing.values()))
    note = f"Not accepted: {', '.join(map(setting_name, store.errors))}" if store.errors else ""
    return progress, text, note


def _share(run: RunResults) -> str:
    """Say how many observers ran where not all did."""
    every = {item.observer for item in (*run.result.estimates, *run.result.failures)}
    return f", {len(run.ran)} of {len(every)} ran" if run.ran is not None and len(run.ran) < len(every) else ""


def waiting_text(seconds: float) -> str:
    """How long a run takes that waits to be asked for.

    >>> waiting_text(12.3), waiting_text(1000.0)
    ('About 12 s: press Run', 'About 17 min: press Run')
    """
    length = f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
    return f"About {length}: press Run"
