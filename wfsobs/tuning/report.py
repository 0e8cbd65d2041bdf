"""A tuning as a plain dictionary, as lines of text, and as a TOML file of settings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from wfsobs.closed_loop.envelope import Spread
from wfsobs.scenario.configfile import add_comments, changed_settings, to_toml
from wfsobs.tuning.records import P95, TRUTH, WORST
from wfsobs.tuning.trials import Errors, Evaluation, Stage
from wfsobs.tuning.tuning import TuningResult
from wfsobs.typing import Array

Rows = list[tuple[str, str, float | str | None, float | str | None]]
"""(section, name, before, after)."""

SETTING, VALIDATION, TEST, OTHER, LIKELIHOOD = "setting", "validation", "test", "other target", "likelihood"

TOGETHER = "rms over modes"


def tuning_dict(result: TuningResult) -> dict[str, Any]:
    """Return the output of `wfsobs tune --json`.

    Errors in um, null where the observer failed; likelihoods in nats, null where there is no GPR. Of a controller, `envelope` has
    what it leaves of the plants of the search and of others, null where it is not stable.
    """

    def stage(s: Stage) -> dict[str, Any]:
        return {
            "validation_rms_um": s.validation.rms if s.validation else None,
            "validation_um": _modes(s.validation),
            "test_rms_um": s.test.rms if s.test else None,
            "test_um": _modes(s.test),
            "other_target_test_um": _modes(s.other),
            "log_marginal_likelihood": list(s.likelihood) if s.likelihood else None,
            "envelope": dict(zip(("searched", "others"), map(_spread, s.spreads), strict=True)) if s.spreads else None,
        }

    return {
        "controller" if result.after.spreads else "observer": result.observer,
        "target": result.target,
        "against": result.against,
        "settings": changed_settings(result.scenario, result.before.scenario),
        "start": result.start,
        "before": stage(result.before),
        "after": stage(result.after),
        "evaluations": [
            {"settings": e.changes, "rms_um": e.errors.rms if e.errors else None, "reason": e.reason or None}
            for e in result.history
        ],
    }


def _spread(of: Spread) -> dict[str, Any]:
    left = {name: _finite(getattr(of, name)) for name in ("nominal", "p95", "worst")}
    return {**{f"{name}_um": x for name, x in left.items()}, "unstable": of.unstable, "plants": len(of.points)}


def _finite(rms: Array) -> list[float] | None:
    return rms.tolist() if np.isfinite(rms).all() else None


def _modes(errors: Errors | None) -> dict[str, float] | None:
    return dict(errors.modes) if errors else None


def settings(result: TuningResult) -> list[tuple[str, str, str]]:
    """(dotted path, before, after) of every setting that was searched or set by hand."""
    changed = [path for path in changed_settings(result.scenario, result.before.scenario) if path not in result.start]
    before = {path: _before(result, path) for path in (*changed, *result.start)}
    if result.scenario == result.before.scenario:
        return [(path, text, text) for path, text in before.items()]
    return [(path, text, _format(result.scenario.lookup(path))) for path, text in before.items()]


def _before(result: TuningResult, path: str) -> str:
    return _format(result.start.get(path, result.before.scenario.lookup(path)))


def _scores(result: TuningResult) -> list[tuple[str, Errors | None, Errors | None]]:
    """(section, before, after) of either record."""
    return [(name, getattr(result.before, name), getattr(result.after, name)) for name in (VALIDATION, TEST)]


def _format(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def nm(rms: float) -> str:
    """Format an error in [nm], to two digits."""
    return f"{rms * 1e3:.2f}"


def tuning_remarks(result: TuningResult) -> list[str]:
    """Return one line on each fact that is not in the tables."""
    out = [] if result.against in (TRUTH, WORST, P95) else [f"compared with {result.against}, no truth being known"]
    known = [s.likelihood for s in (result.before, result.after)]
    if all(known):
        text = " -> ".join(", ".join(f"{x:.1f}" for x in values) for values in known if values)
        out.append(f"log marginal likelihood of the training targets (information only), per mode: {text}")
    if result.scenario == result.before.scenario:
        out.append("nothing that was tried is better than the settings as they were")
    failed = [e for e in result.history if not e.errors]
    if failed:
        out.append(f"{len(failed)} of {len(result.history)} evaluations failed, the last of them: {failed[-1].reason}")
    return out


def tuning_toml(result: TuningResult) -> str:
    """Return the tuned scenario as TOML, with the former values beside changed settings."""
    base = result.before.scenario
    notes = {
        path: f"{'tuned' if path in result.paths else 'with it'}, {_before(result, path)} before"
        for path in changed_settings(result.scenario, base)
    }
    evaluations, where = len(result.history), "at" if result.after.spreads else "against"
    head = [
        f"{result.label} tuned for {result.target}, {where} {result.against}, in {evaluations} evaluations.",
        *(f"{result.measure}, {name}: {_of(before)} before, {_of(after)} after" for name, before, after in _scores(result)),
    ]
    return "\n".join(f"# {line}" for line in head) + "\n\n" + add_comments(to_toml(result.scenario), notes)


def _of(errors: Errors | None) -> str:
    return f"{nm(errors.rms)} nm" if errors else "fails"


def best_so_far(history: Sequence[Evaluation]) -> list[float]:
    """Compute the least error after every evaluation [um], infinite until one has succeeded."""
    return np.minimum.accumulate([evaluation.rms for evaluation in history]).tolist()


def tuning_rows(result: TuningResult) -> Rows:
    """List settings as text, errors [um] by mode and together, a GPR's log marginal likelihoods by mode; None for failures."""
    out: Rows = [(SETTING, *row) for row in settings(result)]
    stages = result.before, result.after
    for section, before, after in _scores(result):
        out += [(section, name, _error(before, name), _error(after, name)) for name in (*_mode_names(stages), TOGETHER)]
    if any(s.other for s in stages):
        before, after = stages
        out.append((OTHER, TOGETHER, _error(before.other, TOGETHER), _error(after.other, TOGETHER)))
    if any(s.likelihood for s in stages):
        values = [s.likelihood or (None,) * len(_mode_names(stages)) for s in stages]
        out += [(LIKELIHOOD, *row) for row in zip(_mode_names(stages), *values, strict=True)]
    return out


def _error(errors: Errors | None, name: str) -> float | None:
    return None if errors is None else errors.rms if name == TOGETHER else errors.modes[name]


def _mode_names(stages: Sequence[Stage]) -> tuple[str, ...]:
    return tuple(next(e.modes for s in stages for e in (s.validation, s.test) if e))
