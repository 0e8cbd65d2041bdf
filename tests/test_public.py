"""What `import wfsobs` gives, how its objects look, and how little is imported for it."""

import ast
import inspect
import json
import re
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.version import Version

import wfsobs
from tests.records import short
from wfsobs.cli.group import COMMANDS, main
from wfsobs.closed_loop.design import design
from wfsobs.closed_loop.run import closed_loop
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.telemetry.records import save_record

pytestmark = pytest.mark.slow

FUNCTIONS = (
    "bound",
    "close_loop",
    "error_budget",
    "explore",
    "export",
    "fit_kernels",
    "identify",
    "load",
    "observe",
    "plant_envelope",
    "psd",
    "run",
    "save",
    "score",
    "simulate",
    "tune",
)

QUICK = {"run.duration": 2.0, "gpr_offline.training_size": 20, "gpr_online.training_size": 20}


@pytest.fixture(scope="module")
def result() -> wfsobs.Result:
    return wfsobs.run(wfsobs.PRESETS["paper"]().replace(QUICK), observers=["kf-lgs", "zero"])


def in_a_new_process(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout


def test_every_public_name_is_there_and_listed() -> None:
    assert sorted(wfsobs.__all__) == dir(wfsobs), "completion offers what is public"
    for name in wfsobs.__all__:
        assert getattr(wfsobs, name) is not None
    with pytest.raises(AttributeError, match=r"no attribute 'nothing'"):
        wfsobs.nothing  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.parametrize(("name", "library"), [("explore", "panel"), ("export", "jinja2")])
def test_without_the_dashboard_the_extra_is_named(name: str, library: str) -> None:
    code = f"import sys; sys.modules['{library}'] = None\nimport wfsobs\ntry: wfsobs.{name}\nexcept ImportError as it: print(it)"
    assert in_a_new_process(code) == f"{name} needs {library}: pip install wfsobs[app]\n"


def test_the_names_that_a_type_checker_sees_are_those_that_are_imported() -> None:
    tree = ast.parse(Path(inspect.getfile(wfsobs)).read_text())
    (for_types,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.name: node.module
        for node in for_types.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
        if node.module
    }
    assert seen == {name: f"wfsobs.{home}" for name, home in wfsobs._HOMES.items()}
    assert set(seen) == set(wfsobs.__all__)


def test_public_functions_stay_functions_whatever_is_imported() -> None:
    """A submodule of the same name would take their place. main.py of the dashboard opens a session, so it is left out."""
    code = (
        "import importlib, inspect, pkgutil, warnings, wfsobs\n"
        "warnings.simplefilter('ignore')\n"
        "for m in pkgutil.walk_packages(wfsobs.__path__, 'wfsobs.'):\n"
        "    if m.name != 'wfsobs.app.main': importlib.import_module(m.name)\n"
        f"print([n for n in {FUNCTIONS} if not inspect.isfunction(getattr(wfsobs, n))])\n"
    )
    assert in_a_new_process(code).strip() == "[]"


@pytest.mark.parametrize("name", FUNCTIONS)
def test_options_are_keyword_only(name: str) -> None:
    """All that has a default, but for the names of settings that are tuned and the scenario that a record is observed with."""
    parameters = inspect.signature(getattr(wfsobs, name)).parameters.values()
    positional = {p.name for p in parameters if p.default is not p.empty and p.kind is not p.KEYWORD_ONLY}
    assert positional <= ({"scenario"} if name == "observe" else {"names"})


@pytest.mark.parametrize("arguments", [["--help"], ["presets"]])
def test_help_and_presets_import_no_large_library(arguments: list[str]) -> None:
    code = (
        "import sys\nfrom wfsobs.cli import main\n"
        f"main({arguments}, standalone_mode=False)\n"
        "print('large:', sorted({'scipy', 'rich', 'panel', 'bokeh', 'astropy', 'pandas'} & set(sys.modules)))\n"
    )
    assert in_a_new_process(code).splitlines()[-1] == "large: []"


def test_what_takes_long_to_import_waits_until_it_is_used() -> None:
    code = (
        "import sys, wfsobs\nimport wfsobs.live.crew\nwfsobs.run, wfsobs.design, wfsobs.load\n"
        "print('large:', sorted({'scipy.signal', 'scipy.stats', 'scipy.interpolate', 'scipy.io'} & set(sys.modules)))\n"
    )
    assert in_a_new_process(code).splitlines()[-1] == "large: []"


@pytest.mark.parametrize("name", ["kf-adaptive", "multirate-adaptive", "gpr-adaptive"])
def test_nothing_is_imported_while_a_loop_runs(name: str, tmp_path: Path) -> None:
    """It would wait for the disk; those that learn are through with their first window here."""
    save_record(tmp_path / "record.npz", wfsobs.simulate(short("paper")[1].replace({"run.duration": 4.0})))
    code = (
        "import sys, wfsobs\nfrom wfsobs.observers.step import frames_of\n"
        f"record = wfsobs.load({str(tmp_path / 'record.npz')!r})\n"
        f"observer = wfsobs.design({name!r}, wfsobs.PRESETS['paper'](), sampling=record.sampling)\n"
        "before = {*sys.modules}\n"
        "for frame in frames_of(record.measurements()):\n"
        "    observer.update(frame.z, frame.ngs, frame.u)\n"
        "    observer.predict(0, observer.targets[-1])\n"
        "    observer.settle()\n"
        "print('imported:', {*sys.modules} - before)\n"
    )
    assert in_a_new_process(code).splitlines()[-1] == "imported: set()"


def test_the_list_of_commands_says_what_each_says_of_itself() -> None:
    for name, (_, text) in COMMANDS.items():
        command = main.get_command(None, name)  # type: ignore[arg-type]
        assert command is not None and command.name == name and command.help
        assert re.sub(r" \([^)]*\)", "", command.help.splitlines()[0]) == text


def test_every_library_is_imported_before_the_limit_of_threads_is_set() -> None:
    """A BLAS library that comes later would use all processors."""
    code = (
        "import sys, threadpoolctl\nfrom wfsobs.cli import main\n"
        "main(['run', '--set', 'run.duration=1.2', '--json'], standalone_mode=False)\n"
        "print({i['num_threads'] for i in threadpoolctl.threadpool_info() if i['user_api'] == 'blas'})\n"
    )
    assert in_a_new_process(code).splitlines()[-1] == "{1}"


def test_representations_are_one_line(result: wfsobs.Result) -> None:
    assert repr(wfsobs.Scenario()) == "Scenario()"
    assert repr(wfsobs.Scenario().replace({"run.duration": 2.0, "telescope.diameter": 4.0})) == (
        "Scenario(telescope.diameter=4.0, run.duration=2.0)"
    )
    loop = wfsobs.close_loop(result.scenario, controllers=["integrator"])
    found = wfsobs.identify(result.record)
    for made in (*(make() for make in wfsobs.PRESETS.values()), result, result.record, *result.estimates, loop, found):
        assert "\n" not in repr(made) and len(repr(made)) < 200
    assert "length 2 s, rate 1000 Hz, modes 2" in repr(result.record)
    assert repr(result).startswith("Result(2 observers, 24 scores, Record(")
    assert repr(wfsobs.design("kf-lgs", result.scenario)) == "StepObserver(kf-lgs, frames 0, modes 2)"
    assert "pieces" not in repr(result.scores[0])  # numbers by the dozen


def test_a_notebook_shows_tables(result: wfsobs.Result) -> None:
    for made, cell in ((result, "kf-lgs"), (result.record, "1000 Hz"), (result.scenario, "run.duration")):
        html = made._repr_html_()
        assert html.startswith("<table>") and html.endswith("</table>") and f"<td>{cell}</td>" in html


def test_scores_are_those_of_the_run(result: wfsobs.Result) -> None:
    again = wfsobs.score(result.record, result.estimates, warm_up=result.scenario.run.warm_up)
    assert set(again) == {s for s in result.scores if s.observer not in BOUNDS}


def test_a_record_is_loaded_from_its_file(result: wfsobs.Result, tmp_path: Path) -> None:
    save_record(tmp_path / "night.npz", result.record)
    np.testing.assert_array_equal(wfsobs.load(tmp_path / "night.npz").y_lgs, result.record.y_lgs)
    bare = np.column_stack([result.record.y_lgs, result.record.u])
    np.savez(tmp_path / "bare.npz", y_lgs=bare[:, :2], u=-bare[:, 2:])
    turned = wfsobs.load(tmp_path / "bare.npz", rate=1000.0, unit="nm", command_sign=-1)
    assert turned.dt == 1e-3
    np.testing.assert_allclose(turned.u, 1e-3 * result.record.u, rtol=1e-12)  # the rounding of one product
    micron = wfsobs.load(tmp_path / "bare.npz", rate=1000.0, unit="micron", command_sign=-1)
    np.testing.assert_array_equal(micron.u, result.record.u)


@pytest.mark.parametrize(
    ("stated", "line"),
    [
        ({"unit": "furlong"}, "unit = 'furlong': takes one of um, nm, mas, arcsec, rad"),
        ({"rate": np.nan}, "rate = nan: takes a number above 0"),
        ({"rail": -1.0}, "rail = -1: takes a number above 0"),
    ],
)
def test_what_cannot_be_stated_of_a_file_is_one_line(stated: dict[str, Any], line: str) -> None:
    with pytest.raises(wfsobs.RecordError, match=f"^{line}$"):
        wfsobs.load("night.npz", **stated)


@pytest.mark.parametrize("value", ["x.npz", None])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_path_in_place_of_what_it_holds_is_one_line(name: str, value: str | None) -> None:
    function = getattr(wfsobs, name)
    arguments = {"path": "x.csv", "observer": "kf-lgs", "estimates": (), "start": 0.0}
    parameters = [p for p in inspect.signature(function).parameters.values() if p.default is p.empty]
    for one in (p.name for p in parameters if p.annotation in ("Record", "Scenario")):
        with pytest.raises(wfsobs.SettingError, match=f"^{name} takes a {one.title()}, .*, not {value!r}$"):
            function(**{p.name: value if p.name == one else arguments.get(p.name) for p in parameters})


def test_the_loop_is_closed_on_what_is_simulated() -> None:
    scenario = wfsobs.PRESETS["paper"]().replace(QUICK)
    chosen = ["integrator", "lqg-kf-lgs"]
    expected = closed_loop(wfsobs.simulate(scenario), design(scenario, chosen))
    found = wfsobs.close_loop(scenario, controllers=chosen)
    for one, other in zip(found.outcomes, expected.outcomes, strict=True):
        assert one.controller == other.controller
        np.testing.assert_array_equal(one.residual, other.residual)
    found = wfsobs.close_loop(scenario, controllers=iter(chosen))  # type: ignore[arg-type]
    assert [outcome.controller for outcome in found.outcomes] == chosen


def test_a_report_is_written(tmp_path: Path) -> None:
    done: list[wfsobs.Result] = []
    wfsobs.export(tmp_path / "report.html", wfsobs.PRESETS["paper"]().replace(QUICK), on_result=done.append)
    assert len(done) == 1
    assert (tmp_path / "report.html").read_text(encoding="utf-8").startswith("<!doctype html>")


def test_every_file_that_names_the_version_names_this_one() -> None:
    root = Path(__file__).parents[1]
    recipe = (root / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    named = {
        "CITATION.cff": re.search(r"^version: (.+)$", (root / "CITATION.cff").read_text(encoding="utf-8"), flags=re.M)[1],
        ".zenodo.json": json.loads((root / ".zenodo.json").read_text(encoding="utf-8"))["version"],
        "recipe": re.search(r'^  version: "(.+)"$', recipe, flags=re.M)[1],
        "arena": tomllib.loads((root / "packages/wfsobs-arena/pyproject.toml").read_text(encoding="utf-8"))["project"]["version"],
    }
    assert named == dict.fromkeys(named, wfsobs.__version__)


def test_the_conda_recipe_needs_what_the_package_needs() -> None:
    root = Path(__file__).parents[1]
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    run = (root / "conda" / "recipe.yaml").read_text(encoding="utf-8").split("  run:\n")[1].split("\n\n")[0]
    found = {str(Requirement(line.strip(" -"))) for line in run.splitlines()}
    assert found == {str(Requirement(line)) for line in [f"python{project['requires-python']}", *project["dependencies"]]}


def requirements() -> dict[str, Requirement]:
    """What the package, its extras and its build need, by name."""
    config = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    project, extras = config["project"], config["project"]["optional-dependencies"]
    lines = [
        *config["build-system"]["requires"],
        *project["dependencies"],
        *(line for extra in extras.values() for line in extra),
    ]
    return {it.name: it for it in map(Requirement, lines) if it.name != "wfsobs"}


def test_the_page_of_installation_names_every_extra_but_that_of_the_tests() -> None:
    root = Path(__file__).parents[1]
    extras = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    page = (root / "docs" / "installation.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)) == extras.keys() - {"test"}


def test_every_range_of_versions_has_a_ceiling() -> None:
    assert [str(it) for it in requirements().values() if not any(part.operator == "<" for part in it.specifier)] == []


@pytest.mark.parametrize("name", ["panel", "panel-material-ui", "bokeh"])
def test_a_package_whose_private_names_are_used_stays_at_its_minor_version(name: str) -> None:
    now = Version(version(name))
    assert now in requirements()[name].specifier
    assert f"{now.major}.{now.minor + 1}.0" not in requirements()[name].specifier
