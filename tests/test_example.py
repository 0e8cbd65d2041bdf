"""The package in examples/, installed beside wfsobs: its observer stands wherever those of wfsobs do."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
SHORT = (
    *("--set", "run.duration=1.2", "--set", "run.warm_up=0.3", "--set", "adaptive.window=0.25"),
    *("--set", "gpr_online.training_size=20", "--set", "gpr_offline.training_size=20"),
    *("--set", "gpr_online.depth=10", "--set", "gpr_offline.depth=10"),
)

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def python(example: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Runs Python with the package installed, in a folder of its own."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (example, ROOT)))}
    options: dict[str, Any] = {"cwd": tmp_path_factory.mktemp("run"), "env": environment, "capture_output": True, "text": True}
    return lambda *arguments: subprocess.run([sys.executable, *arguments], **options)


def said(done: subprocess.CompletedProcess[str]) -> str:
    assert done.returncode == 0, done.stderr
    return done.stdout


@cache
def errors(python: Run, *more: str) -> dict[str, float]:
    """RMS error of tip turbulence of the observer and of two of ours."""
    names = ("low-pass", "persistence", "kf-lgs")
    rows = json.loads(said(python("-m", "wfsobs", *more, *SHORT, *(f"--observer={name}" for name in names), "--json")))
    return {row["observer"]: row["rms_um"] for row in rows if (row["target"], row["mode"]) == ("turbulence", "tip")}


def test_it_is_in_the_table_of_a_run_and_takes_its_setting(python: Run) -> None:
    table = said(python("-m", "wfsobs", "run", *SHORT))
    assert any("Low-pass" in line and "turbulence" in line and "none" in line for line in table.splitlines())
    usual, slow = errors(python, "run"), errors(python, "run", "--set", "low_pass.corner=1")
    assert usual["low-pass"] < usual["persistence"], "it takes noise and vibration out"
    assert slow["low-pass"] > 2.0 * usual["low-pass"], "a lag of 0.16 s"
    assert {k: v for k, v in slow.items() if k != "low-pass"} == {k: v for k, v in usual.items() if k != "low-pass"}


def test_a_setting_that_is_none_is_refused(python: Run) -> None:
    for assignment, allowed in (("corner=0", "takes a number from 0.1 to 10000 Hz"), ("edge=1", "no such setting")):
        refused = python("-m", "wfsobs", "run", "--set", f"low_pass.{assignment}")
        assert refused.returncode == 2 and refused.stderr.count("\n") == 1 and allowed in refused.stderr


def test_settings_files_hold_its_group(python: Run, tmp_path: Path) -> None:
    assert tomllib.loads(said(python("-m", "wfsobs", "presets", "paper")))["low_pass"] == {"corner": 150.0}
    (tmp_path / "mine.toml").write_text('preset = "paper"\n[low_pass]\ncorner = 1.0\n', encoding="utf-8")
    read = errors(python, "run", "--config", str(tmp_path / "mine.toml"))
    assert read == errors(python, "run", "--set", "low_pass.corner=1")


def test_it_observes_a_record_and_is_tuned(python: Run, tmp_path: Path) -> None:
    record = str(tmp_path / "night.npz")
    run = errors(python, "run", "--save", record)
    assert errors(python, "observe", record)["low-pass"] == pytest.approx(run["low-pass"], rel=1e-12)
    tuned = json.loads(said(python("-m", "wfsobs", "tune", "--observer", "low-pass", "--evaluations", "12", *SHORT, "--json")))
    best = min(e["rms_um"] for e in tuned["evaluations"])
    assert best <= tuned["evaluations"][0]["rms_um"], "the first are the settings as they are"
    assert "low_pass.corner" in json.dumps(tuned)


def test_a_report_has_its_line_and_its_setting(python: Run, tmp_path: Path) -> None:
    made = tmp_path / "report.html"
    chosen = ("--observer", "low-pass", "--observer", "kf-lgs")
    said(python("-m", "wfsobs", "export", str(made), *SHORT, *chosen, "--set", "low_pass.corner=80"))
    page = made.read_text(encoding="utf-8")
    assert "--line-low-pass:#8A4B00" in page and "--line-low-pass:#E0A050" in page
    assert '"#line-low-pass"/></svg>Low-pass <output>' in page and "low_pass.corner" in page


def test_its_controller_closes_the_loop(python: Run) -> None:
    """With the same gain it is the integrator."""
    gains = ("--set", "fixed_gain.gain=0.2", "--set", "control.integrator=manual", "--set", "control.gain=0.2")
    chosen = ("--controller", "fixed-gain", "--controller", "integrator")
    rows = json.loads(said(python("-m", "wfsobs", "loop", *chosen, *SHORT, *gains, "--json")))
    left = {(row["controller"], row["mode"]): row["residual_rms_nm"] for row in rows}
    assert left["fixed-gain", "tip"] == left["integrator", "tip"] > 0
    assert "Fixed gain" in said(python("-m", "wfsobs", "loop", *chosen, *SHORT))


DASHBOARD = """
from wfsobs.scenario.names import setting_name
from wfsobs.app.controls.panel import Controls
from wfsobs.app.share import to_command, to_python
from wfsobs.app.limits import NONE
from wfsobs.app.report.page import make
from wfsobs.app.service import Service
from wfsobs.app.share import from_query, to_query
from wfsobs.app.store import Store
from wfsobs.app.style import look, observers_of
from wfsobs.app.pages.tune import choices
from wfsobs.app.work import compute
from wfsobs.cost import part_seconds
from wfsobs.progress import QUIET
from wfsobs.scenario import configfile

service = Service(NONE, 1, 0, work=lambda *_: None)
store = Store([].append, service.enter())
controls = Controls(store)
controls.view()
controls.open_topic("low_pass")
slider, box = controls.fields["low_pass.corner"].widgets
assert controls.topics["low_pass"] == "Low-pass" and (slider.start, slider.end) == (10.0, 400.0)
box.value = "80"
assert store.scenario.low_pass.corner == 80.0 and store.changed_paths() == ["low_pass.corner"]
box.value = "0"
assert store.errors["low_pass.corner"].endswith("takes a number from 0.1 to 10000 Hz")
assert setting_name("low_pass.corner") == "Low-pass: Corner"
query = to_query(store.scenario, "paper")
assert query == "preset=paper&low_pass.corner=80" and from_query(query).scenario == store.scenario
service.close(20.0)
assert "low_pass.corner=80.0" in to_command(store.scenario, "paper")
assert "low-pass" in observers_of("turbulence") and look("low-pass").label == "Low-pass"
assert look("low-pass").colour(dark=True) == "#E0A050" and choices()["Low-pass"] == "low-pass"

scenario = configfile.scenario_from("paper", None, ASSIGNMENTS)
shown = compute(scenario, QUIET, lambda **_: None)
assert shown.result.estimate("low-pass", "turbulence") is not None
page = make(shown, "paper", QUIET).decode()  # in a process of its own
assert "--line-low-pass:#8A4B00" in page and '"#line-low-pass"/></svg>Low-pass <output>' in page

script = to_python(scenario.replace({"low_pass.corner": 1.0}), "paper")
assert '"low_pass.corner": 1.0' in script
import contextlib, io
with contextlib.redirect_stdout(io.StringIO()) as out:
    exec(script, {})
print(out.getvalue())
"""


def test_the_dashboard_has_its_settings_its_colour_and_its_report(python: Run) -> None:
    """Drawer, link, command, script, page of the tuning, report of another process."""
    assignments = tuple(word for word in SHORT if word != "--set")
    printed = said(python("-W", "error", "-c", f"ASSIGNMENTS = {assignments!r}\n{DASHBOARD}"))
    assert any(line.split()[:3] == ["turbulence", "tip", "low-pass"] for line in printed.splitlines())


REGISTERED = """
import sys
from types import SimpleNamespace
from wfsobs.bench.tasks import Sizes, each_observer
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.observers import OBSERVERS
from wfsobs.testing import check_controller, check_observer

check_observer(OBSERVERS["low-pass"])
check_controller(CONTROLLERS["fixed-gain"])
sizes = Sizes({"gpr_online.training_size": 20, "gpr_offline.training_size": 20, "adaptive.window": 0.2, "run.warm_up": 0.1},
              duration=0.5, repeats=1)
assert [r["size"] for r in each_observer(sizes)][-1] == "low-pass, 0.5 s, 2 modes"
sys.path.insert(0, SCRIPTS)
import reference, settings_table
assert "## Low-pass (`low-pass`)\\n\\nThe slow part of z." in reference.observers()
assert "| `low_pass.corner` | 150 | 0.1 to 10000 | Hz | Cut-off frequency. |" in settings_table.page()
assert "fixed-gain" in reference.controllers()
"""


def test_it_passes_the_check_and_is_in_benchmarks_and_reference(python: Run) -> None:
    said(python("-c", f"SCRIPTS = {str(ROOT / 'docs' / 'scripts')!r}\n{REGISTERED}"))


def test_help_and_the_list_of_presets_do_not_import_it(python: Run) -> None:
    code = (
        "import sys\nfrom wfsobs.cli import main\n"
        "for words in (['--help'], ['presets']):\n    main(words, standalone_mode=False)\n"
        "print({'wfsobs_example', 'wfsobs_example_controller', 'wfsobs.observers', 'scipy'} & set(sys.modules))\n"
    )
    assert said(python("-c", code)).splitlines()[-1] == "set()"


BROKEN = {
    "missing": ("no_such_module:X", "ModuleNotFoundError: No module named 'no_such_module'"),
    "raises": ("raises:X", "ZeroDivisionError: division by zero"),
    "leaves": ("leaves:X", "SystemExit: 3"),
    "wrong": ("json:dumps", "takes a wfsobs Observer, not a function"),
    "twice": ("twice:X", "observer 'kf-lgs': the id is taken, by LGS KF"),
    "taken": ("taken:X", "observer 'mine': settings 'run': the name is taken"),
}


def test_what_cannot_be_registered_is_named_and_left_out(python: Run, tmp_path: Path) -> None:
    """One line each, and the rest goes on, the example among it."""
    (tmp_path / "raises.py").write_text("1 / 0\n")
    (tmp_path / "leaves.py").write_text("import sys\nsys.exit(3)\n")
    (tmp_path / "twice.py").write_text(
        "from dataclasses import replace\nfrom wfsobs.observers import BUILT_IN\nX = replace(BUILT_IN[0])\n"
    )
    (tmp_path / "taken.py").write_text(
        "from dataclasses import replace\nfrom wfsobs.observers import BUILT_IN\nfrom wfsobs.settings import Group, Section\n"
        "X = replace(BUILT_IN[0], id='mine', label='Mine', settings=Section('run', 'Mine', Group))\n"
    )
    info = tmp_path / "broken-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    points = "".join(f"{name} = {value}\n" for name, (value, _) in BROKEN.items())
    (info / "entry_points.txt").write_text(f"[wfsobs.observers]\n{points}")
    code = f"import sys\nsys.path.insert(0, {str(tmp_path)!r})\nfrom wfsobs.cli import main\nmain({['run', *SHORT]!r})\n"
    done = python("-c", code)
    assert "Low-pass" in said(done)
    lines = sorted(line for line in done.stderr.splitlines())
    assert lines == sorted(f"wfsobs: observer {value} of broken is left out: {why}" for value, why in BROKEN.values())
