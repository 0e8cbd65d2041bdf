"""A tuning as tables for people."""

from __future__ import annotations

from rich.table import Table

from wfsobs.evaluation.rows import row_label
from wfsobs.evaluation.scores import PREDICTION
from wfsobs.tuning.report import nm, settings
from wfsobs.tuning.tuning import TuningResult


def settings_table(result: TuningResult) -> Table:
    """Return the table of searched settings, and of those set by hand for the search, before and after."""
    out = Table(title=f"{row_label(result.observer)}: settings after {len(result.history)} evaluations")
    out.add_column("Setting", no_wrap=True)
    for name in ("before", "after"):
        out.add_column(name, justify="right", no_wrap=True)
    for path, before, after in settings(result):
        out.add_row(path, before, after)
    return out


def errors_table(result: TuningResult) -> Table:
    """Errors, or what takes their place, on validation and test record, mode by mode and together."""
    out = Table(title=f"{result.measure}{'' if result.target == PREDICTION else f' in {result.target}'}, nm")
    out.add_column("", no_wrap=True)
    for name in ("validation, before", "after", "test, before", "after"):
        out.add_column(name, justify="right", no_wrap=True)
    stages = (result.before, result.after)
    cells = [s.validation for s in stages] + [s.test for s in stages]
    for mode in next(e for e in cells if e).modes:
        out.add_row(mode, *(nm(e.modes[mode]) if e else "fails" for e in cells))
    out.add_section()
    out.add_row("rms over modes", *(nm(e.rms) if e else "fails" for e in cells))
    if any(s.other for s in stages):
        out.add_row("in the other target", "", "", *(nm(s.other.rms) if s.other else "fails" for s in stages))
    return out
