"""The command line as a person types it."""

import errno
import json
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner

import wfsobs
from tests.records import ON_PAPER
from wfsobs.cli import main
from wfsobs.cli.options import RECORD_OPTIONS
from wfsobs.cli.simulate import loop
from wfsobs.evaluation.scores import BOUNDS
from wfsobs.observers import OBSERVERS
from wfsobs.scenario import configfile
from wfsobs.scenario.presets import paper

QUICK = [
    "--set",
    "run.duration=1.2",
    "--set",
    "gpr_online.training_size=20",
    "--set",
    "gpr_offline.training_size=50",
    "--set",
    "adaptive.window=0.5",
]
KEYS = {
    "observer",
    "target",
    "mode",
    "rms_um",
    "truth_rms_um",
    "normalised_rms",
    "lag_s",
    "start_s",
    "stop_s",
    "apart",
    "needs",
    "interval_um",
    "phases_um",
    "sd_um",
    "within_68",
    "within_95",
    "crps_um",
    "seed",
}
SHORT = {"run.duration": 1.2, "gpr_online.training_size": 20, "gpr_offline.training_size": 50, "adaptive.window": 0.5}


def call(*arguments):
    return CliRunner().invoke(main, arguments, catch_exceptions=False)


@pytest.mark.slow
def test_json_is_nothing_but_the_rows_of_the_library():
    names = ["kf-lgs", "kf-ngs", "multirate-multi", "gpr-online"]
    few = [f"--observer={name}" for name in names]
    settings = {"turbulence.source": "ar2", "run.seed": 4}  # frozen flow takes most of the time
    told = [x for name, value in settings.items() for x in ("--set", f"{name}={value}")]
    result = call("run", "--preset", "ut4", *QUICK, *few, "--seeds", "2", *told, "--json")
    assert result.exit_code == 0
    rows = json.loads(result.stdout, parse_constant=pytest.fail)
    assert {frozenset(row) for row in rows} == {frozenset(KEYS)}
    assert sorted({row["seed"] for row in rows}) == [4, 5]
    expected = wfsobs.run(configfile.preset("ut4").replace(SHORT | settings | {"run.seed": 5}), observers=names)
    got = [(r["observer"], r["target"], r["mode"], r["rms_um"], r["truth_rms_um"]) for r in rows if r["seed"] == 5]
    assert got == [(s.observer, s.target, s.mode, s.rms, s.truth_rms) for s in expected.scores]


@pytest.mark.slow
def test_table_names_every_observer():
    result = call("run", *QUICK)
    assert result.exit_code == 0
    for name in ON_PAPER:
        assert OBSERVERS[name].label in result.stdout
    assert "nan" not in result.stdout


def observed(result):
    """The rows of the observers: a bound is known only of a scenario that is known to have made the record."""
    return [row for row in json.loads(result.stdout) if row["observer"] not in BOUNDS]


@pytest.mark.slow
def test_observers_are_chosen_by_name_in_every_command_that_runs_them(tmp_path):
    """The rows are those of these observers and of the bounds."""
    names = ("--observer", "persistence", "--observer", "zero")
    record, page = tmp_path / "record.npz", tmp_path / "page.html"
    for arguments in (("run", *QUICK, "--save", str(record)), ("observe", str(record))):
        rows = json.loads(call(*arguments, *names, "--json").stdout)
        assert {row["observer"] for row in rows} - {*BOUNDS} == {"persistence", "zero"}
    assert call("export", str(page), *QUICK, *names).exit_code == 0
    text = page.read_text(encoding="utf-8")
    assert 'data-observer="persistence"' in text and 'data-observer="butterworth-cl"' not in text
    for arguments in (("run",), ("observe", str(record)), ("export", str(page))):
        result = call(*arguments, "--observer", "nobody")
        assert (result.exit_code, result.stderr.count("\n")) == (2, 1) and "'nobody': no such observer" in result.stderr


def test_parts_that_a_saved_record_lacks_are_named(tmp_path):
    path = tmp_path / "r.aot.fits"
    result = call("run", *QUICK, "--observer", "zero", "--save", str(path))
    saved = wfsobs.load(path, trust=True)
    assert (saved.turbulence, saved.vibration, saved.training) == (None, None, None)
    assert f"wfsobs: {path}: has no place for " in result.stderr and "turbulence, vibration" in result.stderr


@pytest.mark.slow
def test_a_saved_record_gives_the_same_numbers(tmp_path):
    record, estimates = tmp_path / "r.npz", tmp_path / "e.npz"
    first = call("run", *QUICK, "--json", "--save", str(record))
    second = call("observe", str(record), *QUICK, "--json", "--out", str(estimates))
    assert second.exit_code == 0
    same = [[{k: v for k, v in row.items() if k not in ("seed", "needs")} for row in observed(r)] for r in (first, second)]
    assert same[0] == same[1]
    # Who observes a file is not told by what it was simulated from.
    needs = [{row["observer"]: row["needs"] for row in observed(r)} for r in (first, second)]
    assert needs[0]["kf-multi"] == "model, true peaks" and needs[1]["kf-multi"] == "model, given peaks"
    assert needs[1] == {observer: text.replace("true", "given") for observer, text in needs[0].items()}
    with np.load(estimates, allow_pickle=False) as file:
        keys = {f"{name}/{t}" for name in ON_PAPER for t in OBSERVERS[name].targets}
        assert set(file.files) == keys
        assert {file[k].shape for k in keys} == {(1200, 2)}


@pytest.mark.slow
def test_observers_that_lack_something_are_left_out_with_a_line(tmp_path):
    simulated = wfsobs.simulate(paper().replace(SHORT))
    np.savez(tmp_path / "bare.npz", y_lgs=simulated.y_lgs, u=simulated.u, dt=simulated.dt)
    result = call("observe", str(tmp_path / "bare.npz"), *QUICK, "--out", str(tmp_path / "e.npz"))
    assert result.exit_code == 0
    assert "kf-ngs left out: the record has no NGS measurements" in result.stderr
    assert "butterworth-ol left out: the record has no measurements with the mirror at rest" in result.stderr
    assert "gpr-offline left out: the record has no training data" in result.stderr
    scored = json.loads(call("observe", str(tmp_path / "bare.npz"), *QUICK, "--json").stdout)
    assert {(r["observer"], r["target"]) for r in scored} == {
        ("kf-lgs", "next z"),
        ("kf-multi", "next z"),
        ("kf-adaptive", "next z"),
        ("gp-lgs", "next z"),
        ("zero", "next z"),
        ("loop", "residual y"),
    }
    assert "Recorded loop" in result.stdout and "error / z" in result.stdout
    with np.load(tmp_path / "e.npz") as file:
        assert "gpr-online/vibration" in file.files
        assert "kf-ngs/turbulence" not in file.files


@pytest.mark.slow
def test_the_record_overrides_the_scenario(tmp_path):
    """A record at 500 Hz with a frame every 4 steps is scored as such, whatever the preset says."""
    scenario = paper().replace(SHORT | {"sensors.lgs_rate": 500.0, "sensors.exposure_ratio": 4})
    configfile.save_scenario(scenario, tmp_path / "s.toml")
    path = str(tmp_path / "r.npz")
    first = call("run", "--config", str(tmp_path / "s.toml"), "--json", "--save", path)
    second = call("observe", path, *QUICK, "--json")
    assert [r["rms_um"] for r in observed(second)] == [r["rms_um"] for r in observed(first)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "--set", "turbulence.wind_speed=200"], "turbulence.wind_speed = 200: takes a number from 0.1 to 100 m/s"),
        (["run", "--set", "turbulence.wind=2"], "turbulence.wind: no such setting"),
        (["run", "--set", "wind"], "--set wind: takes name=value"),
        (["run", "--preset", "nope"], "preset = 'nope': takes one of paper, "),
        (["run", "--config", "none.toml"], "none.toml: cannot be read"),
        (["run", "--set", "run.warm_up=10"], "run.warm_up = 10: must be below run.duration"),
        (["run", "--seeds", "2", "--save", "x.npz"], "--save: saves one record"),
        (["run", *QUICK, "--save", "no/such/folder/x.npz"], "no/such/folder"),
        (["run", "--psd-unit", "nm"], "--psd-unit: only with --vibration-psd"),
        (["loop", "--command-delay", "2"], "--command-delay: only with --record"),
        (["loop", "--train-until", "1"], "--train-until: only with --record"),
        (["tune", "--observer", "kf-lgs", "--open-loop"], "--open-loop: only with --record"),
        (["figure", "paper-4", "--out", "f.pdf", "--train", "r.npz"], "--train: only with --record"),
        (["figure", "paper-4", "--out", "f.pdf", "--column", "u=c"], "--column: only with --record"),
        (["figure", "paper-4", "--out", "no/such/f.pdf", "--record", "none.npz"], "no/such: No such file or directory"),
        (["live", "--headless", "--sha256", "ab"], "--sha256: only with --replay"),
        (["live", "--headless", "--unit", "nm"], "--unit: only with --replay or --in"),
        (["live", "--headless", "--port", "0"], "--port: there is no page with --headless"),
        (["live", "--headless", "--controller", "integrator"], "--controller: only with a page"),
        (["live", "--headless", "--no-controllers"], "--no-controllers: only with a page"),
        (["live", "--in", "s", "--speed", "2"], "--speed: only of a simulation or a record"),
        (["live", "--seconds", "3"], "--seconds: only with --headless"),
        (["live", "--headless", "--modes", "0"], "--modes: only with --in"),
        (["attach", "--in", "s", "--shadow", "--command-gain", "2"], "--command-gain: only with --commands or --controller"),
        (["attach", "--in", "s", "--shadow", "--ngs-lag", "2"], "--ngs-lag: only with --ngs"),
        (["observe", "none.npz"], "none.npz: cannot be read"),
        (["observe", "none.npz", "--prior", "none.toml"], "none.toml: cannot be read"),
        (["presets", "nope"], "preset = 'nope'"),
    ],
)
def test_errors_are_one_line_and_status_2(arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = call(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert result.stdout == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("run", "--save"),
        ("identify none.npz", "--out"),
        ("check none.npz", "--command-gain"),
        ("observe none.npz", "--train"),
        ("campaign report none", "--out"),
    ],
)
def test_an_empty_name_is_refused(command, option):
    done = call(*command.split(), option, "")
    assert done.exit_code == 2
    assert done.stderr.endswith(f"Error: Invalid value for '{option}': takes a text that is not empty\n")


def test_options_of_a_record_need_one_and_columns_of_a_settings_file_do_not(tmp_path):
    assert set(RECORD_OPTIONS) <= {parameter.name for parameter in loop.params}
    (tmp_path / "s.toml").write_text("[columns]\nu = 3\n")
    assert call("check", "r.npz", "--config", str(tmp_path / "s.toml")).stderr.startswith(
        f"wfsobs: {tmp_path / 's.toml'}: columns: "
    )
    (tmp_path / "s.toml").write_text('[columns]\nu = "commands"\n')
    done = call("loop", "--config", str(tmp_path / "s.toml"), "--set", "run.duration=1.2", "--controller", "integrator")
    assert done.exit_code == 0, done.stderr


@pytest.mark.slow
def test_an_unstable_multirate_cycle_leaves_only_that_observer_out():
    weights = ("measurement_noise=manual", "lgs_noise=0.04", "ngs_noise=0.001")
    result = call("run", *QUICK, *(x for w in weights for x in ("--set", f"multirate.{w}")), "--json")
    assert result.exit_code == 0
    assert "multirate left out: multi-rate filter: the cycle of 5 steps is unstable" in result.stderr
    assert "LGS noise 40 nm and NGS noise 1 nm" in result.stderr
    assert "multirate" not in {row["observer"] for row in json.loads(result.stdout)}


@pytest.mark.parametrize("still", ["tip and tilt", "tilt"])
@pytest.mark.parametrize("command", ["observe --observer kf-lgs", "tune --observer kf-lgs --record"])
def test_a_mode_that_is_one_value_is_named(command, still, tmp_path):
    path = tmp_path / "r.npz"
    y = np.random.default_rng(1).standard_normal((1500, 2)) * [name not in still for name in ("tip", "tilt")]
    np.savez(path, y_lgs=y, dt=1e-3, unit="um")
    done = call(*command.split(), str(path), "--open-loop")
    assert done.exit_code == 2 or still == "tilt"
    assert f"{path}: y_lgs of {still} is one value all the time; a measurement has noise\n" in done.stderr
    written = call("convert", str(path), str(tmp_path / "r.csv"), "--open-loop")
    assert written.exit_code == 0 and (tmp_path / "r.csv").exists(), written.stderr


def test_presets_lists_and_prints():
    listing = call("presets").stdout
    assert listing.startswith("paper ")
    assert "\nut4 " in listing and "\nut4-floor " in listing
    assert configfile.from_toml(call("presets", "ut4").stdout) == configfile.preset("ut4")


@pytest.mark.slow
def test_as_a_program():
    done = subprocess.run([sys.executable, "-m", "wfsobs", "run", "--set", "run.seed=-1"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "wfsobs: run.seed = -1: takes a whole number from 0 to 4294967295\n"


@pytest.mark.slow
def test_the_core_needs_numpy_scipy_and_param_alone():
    code = (
        "import sys\n"
        "for name in ('panel', 'bokeh', 'holoviews', 'click', 'rich', 'tomli_w', 'matplotlib', 'pandas', 'threadpoolctl',\n"
        "    'astropy', 'aotpy'):\n"
        "    sys.modules[name] = None\n"
        "import wfsobs\n"
        "s = wfsobs.PRESETS['paper']().replace({'run.duration': 1.2, 'gpr_online.training_size': 20})\n"
        "assert len(wfsobs.run(s).scores) > 10\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_loop_takes_seeds_or_a_record():
    result = call("loop", "--record", "r.npz", "--seeds", "2")
    assert result.exit_code == 2 and result.stderr == "wfsobs: --seeds: only for simulated records, not with --record\n"


@pytest.mark.slow
def test_the_file_of_an_identification_is_all_that_telemetry_needs(tmp_path):
    """As a prior it gives what it gives as settings; who is told nothing is as without it."""
    record, found = str(tmp_path / "night.npz"), str(tmp_path / "found.toml")
    light = [*QUICK, "--set", "run.duration=2"]
    call("run", *light, "--save", record, "--observer", "zero")
    call("identify", record, *light, "--out", found)

    def errors(*told):
        said = json.loads(call("observe", record, *told, "--json").stdout)
        return {(r["observer"], r["target"], r["mode"]): r["rms_um"] for r in said}

    as_prior, without = errors("--prior", found, *light), errors(*light)
    assert as_prior == errors("--config", found, *light) and as_prior.keys() == without.keys()
    table = call("observe", record, "--prior", found, *light, "--observer", "kf-multi").stdout
    assert "model, identified peaks" in table and "true" not in table.replace("truth", "")
    moved = {key[0] for key, value in as_prior.items() if value != without[key]}
    filters = {"kf-lgs", "kf-multi", "kf-ngs", "multirate", "multirate-optimal", "multirate-multi"}
    assert moved == filters | {"gp-lgs", "gp-both"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("title", "arguments"),
    [
        ("Identified from", ["identify", "RECORD", "--out"]),
        ("RMS error", ["observe", "RECORD", "--observer", "zero", "--out"]),
        ("settings after", ["tune", "--set", "run.duration=3", "--observer", "butterworth-cl", "--evaluations", "2", "--out"]),
        ("Best observer", ["sweep", *QUICK, "--over", "loop.gain=0.2,0.3", "--seeds", "1", "--observer", "zero", "--csv"]),
    ],
)
def test_what_has_been_computed_is_printed_where_it_cannot_be_saved(arguments, title, tmp_path, monkeypatch):
    record, out = tmp_path / "r.npz", tmp_path / "out.npz"
    wfsobs.save(record, wfsobs.simulate(paper().replace({"run.duration": 3.0})))

    def write(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("wfsobs.files._write_and_rename", write)
    done = CliRunner().invoke(main, [str(record) if word == "RECORD" else word for word in arguments] + [str(out)])
    assert done.exit_code == 2 and done.stderr.splitlines()[-1] == f"wfsobs: {out}: No space left on device"
    assert title in done.stdout
