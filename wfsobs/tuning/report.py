"""A tuning as a plain dictionary, as lines of text, and as a TOML file of settings."""

from __future__ import annotations

from functools import reduce
from typing import Any

from wfsobs.evaluation.rows import row_label
from wfsobs.scenario import Scenario
from wfsobs.scenario.configfile import add_comments, changed_settings, to_toml
from wfsobs.tuning.judge import Errors
from wfsobs.tuning.records import TRUTH
from wfsobs.tuning.tuning import Stage, TuningResult


def tuning_dict(tuned: TuningResult) -> dict[str, Any]:
    """Return the output of `wfsobs tune --json`.

    Errors in um, null where the observer failed; likelihoods in nats, null where there is no GPR.
    """

    def stage(s: Stage) -> dict[str, Any]:
        return {
            "validation_rms_um": s.validation.rms if s.validation else None,
            "validation_um": _modes(s.validation),
            "test_rms_um": s.test.rms if s.test else None,
            "test_um": _modes(s.test),
            "other_target_test_um": _modes(s.other),
            "log_marginal_likelihood": list(s.likelihood) if s.likelihood else None,
        }

    return {
        "observer": tuned.observer,
        "target": tuned.target,
        "against": tuned.against,
        "settings": changed_settings(tuned.scenario, tuned.before.scenario),
        "start": tuned.start,
        "before": stage(tuned.before),
        "after": stage(tuned.after),
        "evaluations": [
            {"settings": e.changes, "rms_um": e.errors.rms if e.errors else None, "reason": e.reason or None}
            for e in tuned.history
        ],
    }


def _modes(errors: Errors | None) -> dict[str, float] | None:
    return dict(errors.modes) if errors else None


def settings(tuned: TuningResult) -> list[tuple[str, str, str]]:
    """(dotted path, before, after) of every setting that was searched or set by hand."""
    changed = [path for path in changed_settings(tuned.scenario, tuned.before.scenario) if path not in tuned.start]
    before = {path: _before(tuned, path) for path in (*changed, *tuned.start)}
    if tuned.scenario == tuned.before.scenario:
        return [(path, text, text) for path, text in before.items()]
    return [(path, text, _format(_value(tuned.scenario, path))) for path, text in before.items()]


def _before(tuned: TuningResult, path: str) -> str:
    return _format(tuned.start.get(path, _value(tuned.before.scenario, path)))


def _value(scenario: Scenario, path: str) -> Any:
    return reduce(getattr, path.split("."), scenario)


def _format(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def nm(rms: float) -> str:
    """Format an error in [nm], to two digits."""
    return f"{rms * 1e3:.2f}"


def tuning_remarks(tuned: TuningResult) -> list[str]:
    """Return one line on each fact that is not in the tables."""
    out = [] if tuned.against == TRUTH else [f"compared with {tuned.against}, no truth being known"]
    known = [s.likelihood for s in (tuned.before, tuned.after)]
    if all(known):
        text = " -> ".join(", ".join(f"{x:.1f}" for x in values) for values in known if values)
        out.append(f"log marginal likelihood of the training targets (information only), per mode: {text}")
    if tuned.scenario == tuned.before.scenario:
        out.append("nothing that was tried is better than the settings as they were")
    failed = [e for e in tuned.history if not e.errors]
    if failed:
        out.append(f"{len(failed)} of {len(tuned.history)} evaluations failed, the last of them: {failed[-1].reason}")
    return out


def tuning_toml(tuned: TuningResult) -> str:
    """Return the tuned scenario as TOML, with the former values beside changed settings."""
    base = tuned.before.scenario
    notes = {
        path: f"{'tuned' if path in tuned.paths else 'with it'}, {_before(tuned, path)} before"
        for path in changed_settings(tuned.scenario, base)
    }
    head = [
        f"{row_label(tuned.observer)} tuned for {tuned.target}, against {tuned.against}, in {len(tuned.history)} evaluations.",
        *(
            f"{tuned.measure}, {name}: {_of(before)} before, {_of(after)} after"
            for name, before, after in (
                ("validation", tuned.before.validation, tuned.after.validation),
                ("test", tuned.before.test, tuned.after.test),
            )
        ),
    ]
    return "\n".join(f"# {line}" for line in head) + "\n\n" + add_comments(to_toml(tuned.scenario), notes)


def _of(errors: Errors | None) -> str:
    return f"{nm(errors.rms)} nm" if errors else "fails"
