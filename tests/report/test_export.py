"""`wfsobs export` as a person types it, and the report that the dashboard has made beside it."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from wfsobs import pipeline
from wfsobs.app.report import page as report_export
from wfsobs.app.work import RunResults
from wfsobs.cli import main
from wfsobs.evaluation.result import TIME, score_rows
from wfsobs.progress import QUIET, Cancelled, Watch
from wfsobs.scenario import Scenario

QUICK = [
    "--set",
    "run.duration=1.5",
    "--set",
    "run.warm_up=0.5",
    "--set",
    "gpr_online.training_size=20",
    "--set",
    "gpr_offline.training_size=50",
    "--set",
    "gpr_online.depth=20",
    "--set",
    "gpr_offline.depth=20",
    "--set",
    "adaptive.window=0.5",
]
FEW = ["--observer", "kf-lgs", "--observer", "gpr-online", "--observer", "multirate-multi"]


def call(*arguments: str) -> Result:
    return CliRunner().invoke(main, arguments, catch_exceptions=False)


def untimed(given: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{key: value for key, value in row.items() if key != TIME} for row in given]


def test_every_state_has_the_numbers_of_its_own_run(tmp_path: Path, parse: Any) -> None:
    path = tmp_path / "r.html"
    done = call(
        *("export", str(path), *QUICK, *FEW, "--set", "loop.gain=0.4"),
        *("--vary", "turbulence.wind_speed=8,20", "--vary", "run.seed=1,7"),
    )
    assert (done.exit_code, done.output) == (0, "")
    assert [p.name for p in tmp_path.iterdir()] == ["r.html"]
    parsed = parse(path.read_text(encoding="utf-8"))
    assert "left out" not in parsed.text, "of observers that were not to run"
    again = f"{shlex.join(FEW)} --vary turbulence.wind_speed=8,20"
    assert again in parsed.text, "other observers would have other samples in common"
    states = parsed.data("rows")
    alone = [
        json.loads(
            call(
                "run",
                *QUICK,
                *FEW,
                "--set",
                "loop.gain=0.4",
                "--set",
                f"turbulence.wind_speed={speed}",
                "--set",
                f"run.seed={seed}",
                "--json",
            ).stdout
        )
        for speed in (8, 20)
        for seed in (1, 7)
    ]
    assert [untimed(state["rows"]) for state in states] == alone


def test_settings_from_a_file_are_compared_with_its_preset(tmp_path: Path, parse: Any) -> None:
    config = tmp_path / "c.toml"
    config.write_text('preset = "ut4"\nloop.gain = 0.2\n', encoding="utf-8")
    assert call("export", str(tmp_path / "r.html"), "--config", str(config), *QUICK, *FEW).exit_code == 0
    it = parse((tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "--preset ut4 --set loop.gain=0.2 " in it.text and "Preset ut4, 8 settings changed" in it.text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["r.html", "--vary", "turbulence.wind_speed=5,200"], "turbulence.wind_speed = 200: takes a number from 0.1 to 100 m/s"),
        (["r.html", "--vary", "wind"], "--vary wind: takes name=value,value"),
        (["r.html", "--vary", "run.seed=1,2,3,4,5,6,7,8", "--vary", "loop.gain=0.1,0.2,0.3,0.4,0.5,0.6,0.7,0.8"], "8 x 8 = 64"),
        (["r.html", "--vary", "run.warm_up=1,10"], "run.warm_up = 10: must be below run.duration"),
        (["r.html", "--preset", "nope"], "preset = 'nope'"),
        (["no/such/r.html"], "no/such: No such file or directory"),
        (["."], ".: Is a directory"),
        (["file/r.html"], "file: Not a directory"),
    ],
)
def test_what_cannot_be_is_said_before_anything_runs(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    monkeypatch.setattr(pipeline, "simulate", lambda *_, **__: pytest.fail("it ran"))
    result = call("export", *arguments)
    assert result.exit_code == 2 and message in result.stderr and result.stderr.count("\n") == 1 and result.stdout == ""
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_without_bokeh_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("wfsobs.app.report")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "bokeh.document", None)
    result = call("export", str(tmp_path / "r.html"))
    assert result.exit_code == 2 and "a report needs bokeh" in result.stderr and "wfsobs[app]" in result.stderr


def test_a_run_that_fails_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "r.html"
    path.write_text("before", encoding="utf-8")

    def broken(*_: object, **__: object) -> None:
        raise RuntimeError

    monkeypatch.setattr(pipeline, "simulate", broken)
    with pytest.raises(RuntimeError):
        call("export", str(path), *QUICK)
    assert path.read_text(encoding="utf-8") == "before" and list(tmp_path.iterdir()) == [path]


def test_the_dashboards_report_has_the_numbers_given_to_it(result: Any, parse: Any) -> None:
    it = parse(report_export.make(RunResults(result), "paper", QUIET).decode())
    assert it.data("rows")[0]["rows"] == score_rows(result.scores, result.scenario.run.seed)
    assert "wfsobs export report.html --preset paper --set" in it.text


def test_what_nobody_wants_any_more_is_stopped(result: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[Any] = []
    monkeypatch.setattr(report_export, "page", lambda *of: written.append(of))
    with pytest.raises(Cancelled):
        report_export.make(RunResults(result), "paper", Watch(is_cancelled=lambda: True))
    assert not written


def test_a_failure_of_an_observer_is_in_the_report(short: Scenario, tmp_path: Path, parse: Any) -> None:
    weights = ("measurement_noise=manual", "lgs_noise=0.04", "ngs_noise=0.001")
    words = [word for w in weights for word in ("--set", f"multirate.{w}")]
    done = call("export", str(tmp_path / "r.html"), *QUICK, *FEW, "--observer", "multirate", *words)
    assert done.exit_code == 0 and "multirate left out" in done.stderr
    assert "the cycle of 5 steps is unstable" in parse((tmp_path / "r.html").read_text(encoding="utf-8")).text
