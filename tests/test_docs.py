"""The pages tell the truth: links, code paths, commands, and the settings page."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import doctest
import importlib.util
import inspect
import io
import json
import re
import shlex
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner

import wfsobs
from wfsobs import RecordError
from wfsobs.campaign.plan import parse_plan
from wfsobs.cli import main
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import Observer
from wfsobs.scenario import Scenario, configfile
from wfsobs.scenario.presets import PRESETS
from wfsobs.streams.shared_image import SharedImage, stream_path

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
DOCS = ROOT / "docs"
PAGES = [README, *sorted(DOCS.glob("**/*.md"))]
COMMANDS = [p for p in PAGES if p.stem != "read-your-telemetry"]
"""Pages whose commands stand alone; those of the other go with its code."""
ALONE = set[tuple[str, ...]]()
"""Commands that have run, and neither read nor wrote a file: they need not again, on another page."""
NOTEBOOKS = sorted(DOCS.glob("tutorials/*.ipynb"))
SHORT = (
    "--set",
    "run.duration=1.2",
    "--set",
    "run.warm_up=0.3",
    "--set",
    "events=[]",
    "--set",
    "gpr_online.training_size=50",
    "--set",
    "gpr_offline.training_size=50",
)
FEW = ("--observer", "kf-lgs", "--observer", "multirate-multi")


def script(name: str) -> ModuleType:
    sys.path.insert(0, str(DOCS / "scripts"))  # they import each other
    try:
        return load_script(name)
    finally:
        sys.path.remove(str(DOCS / "scripts"))


def load_script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / "scripts" / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), flags=re.M | re.S)


def prose(page: Path) -> str:
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)


def anchors(page: Path) -> set[str]:
    heads = re.findall(r"^#+ (.*)$", prose(page), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in heads}


def test_settings_page_is_what_the_script_gives() -> None:
    assert script("settings_table").page() == (ROOT / "docs" / "settings.md").read_text(encoding="utf-8"), (
        "run: python docs/scripts/settings_table.py"
    )


def test_notebooks_are_kept_without_outputs() -> None:
    """They are run when the documentation is built; what they claim of their numbers they assert."""
    assert len(NOTEBOOKS) == 5
    for path in NOTEBOOKS:
        code = [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
        assert not any(cell["outputs"] or cell["execution_count"] for cell in code)
        assert any("assert " in "".join(cell["source"]) for cell in code)


def test_settings_page_names_every_setting() -> None:
    page = (ROOT / "docs" / "settings.md").read_text(encoding="utf-8")
    missing = [path for path, *_ in Scenario().walk() if f"`{re.sub(r'[.]0[.]', '.N.', path)}`" not in page]
    assert not missing


@pytest.mark.parametrize("page", [*PAGES, *NOTEBOOKS], ids=lambda p: p.name)
def test_relative_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), target


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_code_paths_exist(page: Path) -> None:
    for path, name in re.findall(r"`((?:wfsobs|tests|docs)/[\w/.]*)(?::([\w.]+))?`", prose(page)):
        file = ROOT / path
        assert file.exists(), path
        if name:
            assert name in names_of(file), f"{path}:{name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_named_tests_exist(page: Path) -> None:
    """A test in brackets after a module, `tests/x.py` (`test_y`), is in that module."""
    for path, name in re.findall(r"`(tests/[\w/]+\.py)` \(`(test_\w+)`\)", prose(page)):
        assert name in names_of(ROOT / path), f"{path}: {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_named_settings_exist(page: Path) -> None:
    paths = {path for path, *_ in Scenario().walk()}
    groups = {path.split(".")[0] for path in paths}
    for path in re.findall(r"`([a-z_]+(?:\.[a-z_0-9N]+)+)`", prose(page)):
        if path.split(".")[0] in groups and not path.endswith(".py"):
            assert path.replace(".N.", ".0.") in paths | dict(Scenario().lists()).keys(), path


@cache
def names_of(file: Path) -> set[str]:
    """Top-level names of a module, and Class.member."""
    out: set[str] = set()
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            out.add(node.name)
        if isinstance(node, ast.ClassDef):
            out |= {f"{node.name}.{inner.name}" for inner in node.body if isinstance(inner, ast.FunctionDef)}
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        out |= {t.id for t in targets if isinstance(t, ast.Name)}
    return out


def test_the_page_of_observers_lists_them() -> None:
    rows = re.findall(r"^\| `([\w-]+)` \| ([^|]+?) \| ([^|]+?) \| ([^|]+?) \|", prose(DOCS / "observers.md"), flags=re.M)
    here = {row for row in rows if row[0] in OBSERVERS}
    assert here == {(o.id, o.label, ", ".join(o.targets), o.help) for o in OBSERVERS.values()}


@pytest.mark.parametrize("page", COMMANDS, ids=lambda p: p.name)
def test_commands_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every line of a ```sh block that starts with wfsobs, in order, in one folder.

    On short records and with few observers and controllers, evaluations and values.
    """
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "examples" / "wind.toml", tmp_path)
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path))
    for name in ("aol1_modevalOL", "aol2_modevalOL", "aol1_modevalWFS"):
        SharedImage.create(stream_path(name), (2,))
    for line in "".join(blocks(page, "sh")).splitlines():
        words = shlex.split(line)
        if words[0] != "wfsobs":
            continue
        words, out = (words[:-2], words[-1]) if ">" in words else (words, None)
        for option, value in (("--seeds", "2"), ("--seconds", "0.1")):
            if option in words:
                words[words.index(option) + 1] = value
        if "--vary" in words:  # the first and the last value of each
            words = [re.sub(r"^([\w.]+=[^,]+,).*,", r"\1", word) for word in words]
        short = SHORT if words[1] in ("run", "observe", "tune", "loop", "export", "sweep") else ()
        short = ("--seconds", "0.1") if words[1] == "attach" else short
        if words[1] == "tune":
            short = (*short, "--evaluations", "2")
        if words[1] == "loop" and "--controller" not in words:
            short = (*short, "--controller", "integrator", "--controller", "lqg-kf-multi")
        if words[1] == "envelope":
            short = ("--points", "8", *(() if "--controller" in words else ("--controller", "lqg-kf-lgs")))
        if words[1] in ("run", "observe", "export", "sweep", "live") and "--observer" not in words:
            short = (*short, *FEW)
        before, words = {*tmp_path.iterdir()}, [*words[1:], *short]
        if tuple(words) in ALONE:
            continue
        result = CliRunner().invoke(main, words)
        assert result.exit_code == 0, (line, result.output)
        if {*tmp_path.iterdir()} == before and not any(Path(word).exists() for word in words):
            ALONE.add(tuple(words))
        if out:
            Path(out).write_text(result.stdout, encoding="utf-8")


def test_the_plan_on_the_page_of_campaigns_is_one(tmp_path: Path) -> None:
    (tmp_path / "nights.csv").write_text("r0,noise_nm\n0.1,20\n0.2,10\n", encoding="utf-8")
    plan = parse_plan(blocks(DOCS / "campaigns.md", "toml")[0], tmp_path)
    assert len(plan.cells) == 2 * 2 * 32 * 3 and len(plan.axes) == 4


def test_output_on_the_page_of_the_command_line_is_real() -> None:
    """The errors and truths in the table under `wfsobs run` are those of that command."""

    def table(text: str) -> list[list[str]]:
        return [[cell.strip() for cell in line.strip("│").split("│")][:6] for line in text.splitlines() if line.startswith("│")]

    printed = table(blocks(DOCS / "command-line.md", "text")[0])
    assert len(printed) > 10
    assert sorted(table(CliRunner().invoke(main, ["run"]).stdout)) == sorted(printed)


def test_readme_is_short() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) < 120


@pytest.mark.parametrize("page", [README, DOCS / "python.md"], ids=lambda p: p.name)
def test_python_of_readme_and_its_page(page: Path) -> None:
    said = io.StringIO()
    (code,) = blocks(page, "python")
    with contextlib.redirect_stdout(said):
        exec(compile(code, page.name, "exec"), {})
    assert "gpr-online vibration tip" in said.getvalue()


@pytest.mark.slow
def test_python_of_the_page_of_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = run_page(DOCS / "figures.md")
    assert Path("vibration.pdf").exists() and Path("errors.html").exists()
    assert list(names["signals"].observer) == ["kf-lgs", "kf-multi", "gpr-online"]
    assert names["density"].shape == (names["frequency"].size, 2)


def test_page_of_python_names_the_public_functions() -> None:
    """With their first arguments, by name and in order."""
    listed = re.findall(r"^\| `wfsobs\.(\w+)\(([^)]*)\)`", prose(DOCS / "python.md"), flags=re.M)
    functions = {name: getattr(wfsobs, name) for name in wfsobs.__all__ if inspect.isfunction(getattr(wfsobs, name))}
    assert dict(listed).keys() == functions.keys()
    for name, arguments in listed:
        assert list(inspect.signature(functions[name]).parameters)[: arguments.count(",") + 1] == arguments.split(", "), name


def test_settings_file_of_the_command_line() -> None:
    (text,) = blocks(DOCS / "command-line.md", "toml")
    assert configfile.from_toml(text).sensors.lgs_count == 4


def test_the_new_observer_is_the_example_and_runs() -> None:
    """In a process of its own, which may keep it. It is better than taking the measurement as it is."""
    page, example = DOCS / "how-to" / "add-an-observer.md", ROOT / "examples" / "wfsobs-example"
    code, package = blocks(page, "python"), blocks(page, "toml")
    assert code[0] == (example / "wfsobs_example.py").read_text(encoding="utf-8")
    assert package == [(example / "pyproject.toml").read_text(encoding="utf-8")]
    done = subprocess.run([sys.executable, "-c", "\n".join(code)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    errors = {line.split()[0]: float(line.split()[1]) for line in done.stdout.splitlines()}
    assert set(errors) >= {"low-pass", "kf-lgs", "persistence"}
    assert errors["low-pass"] < errors["persistence"]


def test_the_new_observer_names_every_field() -> None:
    named = re.findall(r"^\| (`.*?`) \|", prose(DOCS / "how-to" / "add-an-observer.md"), flags=re.M)
    fields = {field.name for field in dataclasses.fields(Observer)} - {"asks"}
    assert {name for cell in named for name in re.findall(r"`(\w+)`", cell)} == fields


def test_the_new_format_brings_a_record_back(tmp_path: Path) -> None:
    names = run_page(DOCS / "how-to" / "add-a-file-format.md")
    arrays = {"y_lgs": np.array([[0.1, np.nan], [0.3, -1e-9]]), "u": np.zeros((2, 2)), "dt": np.array(1e-3)}
    with (tmp_path / "record.json").open("wb+") as file:
        names["write"](file, arrays)
        size = file.seek(0, 2)
        file.seek(0)
        back = names["read"](file, size).arrays
        assert back.keys() == arrays.keys()
        assert all(np.array_equal(back[name], arrays[name], equal_nan=True) for name in arrays)
        file.seek(0)
        with pytest.raises(RecordError, match="holds more than"):
            names["read"](file, size - 1)
    with pytest.raises(RecordError, match="is no JSON"):
        names["read"](io.BytesIO(b"{"), 100)


def test_telemetry_is_read_as_the_page_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its commands and its code in the order of the page, on a shorter record."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    text = (DOCS / "how-to" / "read-your-telemetry.md").read_text(encoding="utf-8")
    for language, block in re.findall(r"^```(python|sh)\n(.*?)^```$", text, flags=re.M | re.S):
        if language == "python":
            exec(compile(block.replace('"run.duration": 20.0', '"run.duration": 6.0'), "page", "exec"), names)
        else:
            result = CliRunner().invoke(main, [*shlex.split(block)[1:], "--set", "gpr_online.training_size=50"])
            assert result.exit_code == 0, result.output
    assert names["vibration"].shape == names["telemetry"].u.shape


def run_page(page: Path) -> dict[str, Any]:
    """Every block of Python on a page, in order, in one namespace."""
    names: dict[str, Any] = {}
    for code in blocks(page, "python"):
        exec(compile(code, page.name, "exec"), names)
    return names


def test_reference_holds_every_entry_and_module() -> None:
    made = script("reference").pages()
    for page, entries in (("presets", PRESETS), ("observers", OBSERVERS), ("controllers", CONTROLLERS)):
        text = made[f"reference/{page}.md"]
        assert all(name in text for name in entries), page
    sections = dict(re.findall(r"^## wfsobs ([\w-]+)\n(.*?)(?=^## |\Z)", made["reference/command-line.md"], flags=re.M | re.S))
    context = click.Context(main)
    commands = {name: main.get_command(context, name) for name in main.list_commands(context)}
    assert sections.keys() == commands.keys() >= {"run", "observe"}
    for name, command in commands.items():
        assert command, name
        assert all(option in sections[name] for p in command.params for option in p.opts if option.startswith("-")), name
    shown = set(re.findall(r"^::: (wfsobs\.[\w.]+)$", "\n".join(made.values()), flags=re.M))
    library = [p for p in (ROOT / "wfsobs").rglob("*.py") if p.relative_to(ROOT / "wfsobs").parts[0] not in ("app", "assets")]
    assert shown == {".".join(p.relative_to(ROOT).with_suffix("").parts) for p in library if not p.stem.startswith("__")}


def test_docstrings_of_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "griffe", SimpleNamespace(Extension=object))  # type: ignore[arg-type]
    docstrings = script("docstrings")
    assert doctest.testmod(docstrings).failed == 0
    sections = "Sum.\n\nParameters\n----------\nx : float\n    A number."
    assert docstrings.as_markdown(sections) == sections
    text = "Sum.\n\nx : a number,\n    of any size\n\nFor x: more."
    assert docstrings.as_markdown(text) == "Sum.\n\n- `x`: a number,\n    of any size\n\nFor x: more."


def test_plan_of_the_code_is_that_of_the_imports(tmp_path: Path) -> None:
    rooms = script("rooms")
    for name, code in {
        "__init__.py": "",
        "units.py": "",
        "far.py": "from wfsobs.low import one\n",
        "low/__init__.py": '"""Low."""\n',
        "low/one.py": "from typing import TYPE_CHECKING\nimport numpy\nfrom wfsobs import units\n"
        "if TYPE_CHECKING:\n    from wfsobs.far import x\n",
        "top/__init__.py": "import wfsobs.far\nimport wfsobs.units\n\ndef later():\n    from wfsobs.low.one import x\n",
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(code, encoding="utf-8")
    told = rooms.plan(tmp_path)
    assert told.imports == {"units": set(), "far": {"low"}, "low": {"units"}, "top": {"far", "units"}}
    assert told.later == {"units": set(), "far": set(), "low": set(), "top": {"low"}}
    assert told.says["low"] == "Low."
    assert rooms.floors(told.imports) == {"units": 0, "low": 1, "far": 2, "top": 3}
    assert rooms.reduced(told.imports)["top"] == {"far"}
    assert rooms.svg(told).count("<rect") == 4 and rooms.svg(told).count("<path") == 4
    assert rooms.floors({"a": {"b"}, "b": {"a"}, "c": {"a"}}) == {"a": 0, "b": 0, "c": 1}


def test_pins_of_the_documentation_are_those_of_the_tests() -> None:
    """They stand in two files, since the documentation is built without the dashboard; ruff's is that of the tests."""

    def pins(name: str) -> dict[str, str]:
        lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
        return dict(line.split("==") for line in lines if "==" in line)

    ours = pins("requirements-docs.txt")
    others = pins("requirements.txt") | pins("requirements-bench.txt") | pins("requirements-test.txt")
    assert {"numpy", "ruff", "matplotlib", "mkdocs-material"} <= ours.keys()
    assert {name: version for name, version in ours.items() if others.get(name, version) != version} == {}


def test_check_of_the_site_finds_what_is_wrong(tmp_path: Path) -> None:
    good = '<a href="b.html#here">b</a><a href="https://example.org">elsewhere</a><img src="p.png">'
    (tmp_path / "a.html").write_text(good, "utf-8")
    (tmp_path / "b.html").write_text('<p id="here">', "utf-8")
    (tmp_path / "p.png").write_bytes(b"")
    check = script("check_site")
    assert check.faults(tmp_path) == []
    bad = '<p id="there"><a href="none.html"></a><script src="https://example.org/x.js"></script>'
    (tmp_path / "b.html").write_text(bad, "utf-8")
    (tmp_path / "s.css").write_text("@import 'https://example.org/font.css'", "utf-8")
    assert check.faults(tmp_path) == [
        "a.html: b.html#here leads nowhere",
        "b.html: loads https://example.org/x.js",
        "b.html: none.html leads nowhere",
        "s.css: loads https://example.org/font.css",
    ]


def test_texts_of_the_command_line_are_what_the_program_says() -> None:
    _, listed, refused = blocks(DOCS / "command-line.md", "text")
    assert CliRunner().invoke(main, ["presets"]).stdout == listed
    result = CliRunner().invoke(main, ["run", "--set", "turbulence.wind_speed=200"])
    assert result.exit_code == 2 and result.stderr == refused


def test_cone_effect_is_the_number_of_the_presets() -> None:
    cone = script("cone_effect")
    assert cone.cone_error(8.0)[0] == pytest.approx(49.4, abs=0.05)
    assert cone.cone_error(10.0)[0] == pytest.approx(62.0, abs=0.05)
    assert cone.integral_nm2(lambda k: cone.tip(k, cone.DIAMETER) ** 2) ** 0.5 == pytest.approx(529.3, abs=0.05)


def test_model_page_prints_what_the_script_prints(capsys: pytest.CaptureFixture[str]) -> None:
    source = ROOT / "docs" / "scripts" / "cone_effect.py"
    exec(compile(source.read_text(encoding="utf-8"), str(source), "exec"), {"__name__": "__main__"})
    page = (ROOT / "docs" / "model.md").read_text(encoding="utf-8")
    lines = capsys.readouterr().out.splitlines()
    assert lines
    for line in lines:
        assert line in page


def test_closed_loop_page_prints_what_the_theory_says(capsys: pytest.CaptureFixture[str]) -> None:
    script("closed_loop").delays()
    page = (ROOT / "docs" / "closed_loop.md").read_text(encoding="utf-8")
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) > 5
    for line in lines:
        assert line in page
    run_page(ROOT / "docs" / "closed_loop.md")
    said = capsys.readouterr().out
    assert "Margins(gain=" in said and "lqg-kf-multi tilt" in said and "bound tip" in said


def test_reproduction_page_holds(capsys: pytest.CaptureFixture[str]) -> None:
    """Seeds 1 and 2 lie in the ranges that the page gives for twenty, and the full filter beats both GPR."""
    reproduction = script("reproduction")
    reproduction.SEEDS = (1, 2)
    errors = reproduction.errors({})
    page = (ROOT / "docs" / "reproduction.md").read_text(encoding="utf-8")
    tables = re.split(r"^#+ .*$|^The paper shows tip only", page, flags=re.M)
    places = {
        ("vibration", "tip"): r"Tip \| paper",
        ("vibration", "tilt"): r"Tilt \| here",
        ("turbulence", "tip"): r"\| Tip \| Tip, matched",
        ("turbulence", "tilt"): r"\| Tip \| Tip, matched",
    }
    checked = 0
    for (target, mode), head in places.items():
        (text,) = [t for t in tables if re.search(head, t)]
        for line in text.splitlines():
            name = line.split("|")[1].strip().removesuffix(" (fitted)") if line.startswith("|") else ""
            ids = [id_ for id_, label in reproduction.NAMES.items() if label == name]
            if not ids:
                continue
            ranges = re.findall(r"\(([\d.]+) - ([\d.]+)\)", line)
            low, high = ranges[-1 if (target, mode) == ("turbulence", "tilt") else 0]
            for value in errors[ids[0], target, mode]:
                assert float(low) - 0.01 <= value <= float(high) + 0.01, (name, target, mode, value)
            checked += 1
    assert checked == 6 + 6 + 4 + 4
    reproduction.all_peaks()
    full = float(capsys.readouterr().out.splitlines()[2].split("|")[2].split()[0])
    assert full < min(*errors["gpr-offline", "vibration", "tip"], *errors["gpr-online", "vibration", "tip"])


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_scripts_named_on_a_page_have_the_tables_named(page: Path) -> None:
    """A table of docs/reproduction.md is followed by the name that the script knows it by."""
    known = script("reproduction").TABLES
    named = re.findall(r"^`(\w+)`[;.,]", page.read_text(encoding="utf-8"), flags=re.M)
    assert set(named) == (set(known) if page.name == "reproduction.md" else set())


def test_the_page_of_loops() -> None:
    """Its code runs; the residual of its controller is less than a quarter of the disturbance, as in the closed loop."""
    names = run_page(DOCS / "your-loop.md")
    assert names["residual"][500:].std() < 0.25 * names["disturbance"][500:].std()
    assert np.isfinite(names["mean"]).all() and (names["sd"] > 0).all()


def test_the_page_of_gaussian_processes() -> None:
    """Its code runs: the line is found where it is, and an observer that is told of the kernels removes half of it."""
    names = run_page(DOCS / "gaussian-processes.md")
    for mode in names["fit"].modes:
        omega = mode.numbers["vibration.0.omega"]
        assert abs(omega.value - 2.0 * np.pi * 48.0) < 4.0 * omega.std < 10.0, mode.name
    for name in ("gp-lgs", "gp-both"):
        error = names["result"].estimate(name, "vibration").values - names["used_on"].vibration
        assert error[1000:].std() < 0.5 * names["used_on"].vibration[1000:].std()


def test_a_ratio_of_paired_errors_and_its_jackknife() -> None:
    """Of the means; its standard error is zero where errors go together, and that of a mean where the other is constant."""
    rms_ratio = script("told_nothing").rms_ratio
    squares = np.random.default_rng(1).uniform(1.0, 1.1, 400)
    assert rms_ratio(4.0 * squares, squares) == pytest.approx((2.0, 0.0), abs=1e-12)
    # the square root halves the relative error; what it bends is as small as the spread itself, 3 %
    ratio, spread = rms_ratio(squares, np.full(400, 1.0))
    assert ratio == pytest.approx(np.sqrt(squares.mean()), rel=1e-12)
    assert spread == pytest.approx(0.5 * squares.std(ddof=1) / 20.0 / ratio, rel=1e-2)
