"""Controllers for programs elsewhere: what they give is what the run over a record gives, and a wrong number is noticed."""

from __future__ import annotations

import errno
import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import IO

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner
from scipy.io import loadmat

from wfsobs import handover
from wfsobs.cli import main
from wfsobs.files import write_whole
from wfsobs.signal.gate import GateSettings, OutlierGate

ROUNDING = 1e-12
"""Over the std of the commands: sums in another order."""


def write(tmp_path: Path, controller: str, form: str, *more: str) -> Path:
    path = tmp_path / f"out{handover.ENDINGS.get(form, '')}"
    result = CliRunner().invoke(main, ["design", "--controller", controller, "--to", form, "--out", str(path), *more])
    assert result.exit_code == 0, result.output
    return path


def vectors(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """z and ngs (n, 4), and commands (n, 2)."""
    return np.fromfile(path / "input.f64", "<f8").reshape(-1, 4), np.fromfile(path / "output.f64", "<f8").reshape(-1, 2)


def make(path: Path, *options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["make", "-C", str(path), "test", *options], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def integrator(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Whose gate.f64 each test makes anew; the program is compiled once."""
    return write(tmp_path_factory.mktemp("integrator"), "integrator", "c99")


@pytest.mark.slow
@pytest.mark.parametrize(("start", "stop"), [(0, 150), (0, 300), (20, 200), (130, 2000)])
def test_the_gate_in_c99_is_that_of_python_after_an_early_gap(integrator: Path, start: int, stop: int) -> None:
    whole = (integrator / "gate.f64").read_bytes()
    z = np.frombuffer(whole, "<f8").reshape(-1, 4)[:, :2].copy()
    z[start:stop] = np.nan
    np.hstack([z, OutlierGate(2, GateSettings()).check_all(z)]).tofile(integrator / "gate.f64")
    done = make(integrator)
    (integrator / "gate.f64").write_bytes(whole)
    assert done.returncode == 0 and done.stdout.count("equal") == 2, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "controller",
    ["integrator", "lqg-kf-lgs", "lqg-kf-multi", "h2-fir", "lqg-multirate", "lqg-multirate-optimal", "lqg-multirate-multi"],
)
def test_c99_is_the_run_over_a_record_and_its_test_notices_one_wrong_number(tmp_path: Path, controller: str) -> None:
    path = write(tmp_path, controller, "c99")
    given, commands = vectors(path)
    assert len(commands) >= 10_000 and np.isnan(given[:, :2]).any(axis=0).all()
    done = make(path)
    assert done.returncode == 0 and done.stdout.count("equal") == 2, done.stdout + done.stderr
    assert "warning" not in done.stderr and done.stdout.count(" us where one in seven is missing, ") == 2
    # all that changes is the caller's; the test runs another controller between the steps of the one that it compares
    assert not re.search(r"^static (?!const )[^(]*;", (path / "wfsobs_controller.c").read_text(), flags=re.M)
    commands[5000, 1] += 1e-3 * commands.std()
    commands.tofile(path / "output.f64")
    assert make(path).returncode != 0
    vector = np.fromfile(path / "output.f64", "<f8")
    vector[2 * 5000 + 1] -= 1e-3 * commands.std()
    vector.tofile(path / "output.f64")
    gate = np.fromfile(path / "gate.f64", "<f8").reshape(-1, 4)
    outliers = ~np.isnan(gate[:, :2]) & np.isnan(gate[:, 2:])
    assert 150 < outliers.sum() < 500  # 200 were put in, a jump, a vibration that appears
    gate[5000, 2] = np.nan if gate[5000, 2] == gate[5000, 2] else 0.0
    gate.tofile(path / "gate.f64")
    assert "the gate differs in 1 measurements" in make(path).stdout
    gate[5000, 2] = gate[5000, 0]
    gate.tofile(path / "gate.f64")
    source = (path / "wfsobs_controller.c").read_text()
    tables = re.findall(r"static const real (t\d+)\[\] = \{([^}]*)\}", source)
    name, row = next((name, text) for name, text in tables if re.search(rf"\}}, {name}\}}", source))
    numbers = [float(x) for x in row.split(",")]
    wrong = int(np.argmax(np.abs(numbers)))
    numbers[wrong] *= 1.001
    (path / "wfsobs_controller.c").write_text(
        source.replace(f"{name}[] = {{{row}}}", f"{name}[] = {{{', '.join(map(repr, numbers))}}}")
    )
    assert make(path, "CFLAGS=-O0").returncode != 0  # a number is as wrong, and compiled in half the time


def run(arrays: dict[str, np.ndarray], given: np.ndarray) -> np.ndarray:
    """The equations that the file names, without gaps."""
    out = np.empty((len(given), 2))
    for mode in range(2):
        A, C, L = (arrays[f"mode{mode}_{name}"] for name in "ACL")
        row, x, repeat = np.ravel(arrays[f"mode{mode}_row"]), np.zeros(A.shape[1]), len(A)
        v = given[:, [mode, 2 + mode]][:, : C.shape[1]]
        for k, measured in enumerate(np.nan_to_num(v)):
            step = (A[(k - 1) % repeat], C[(k - 1) % repeat], L[(k - 1) % repeat])
            if k == 0 and f"mode{mode}_first_A" in arrays:
                step = tuple(arrays[f"mode{mode}_first_{name}"] for name in "ACL")
            a, c, gain = step
            w = x + gain @ (measured - c @ x)
            out[k, mode], x = row @ w, a @ w
    return out


@pytest.fixture(scope="module", name="whole")
def _whole() -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Measurements without gaps, and the commands for them by controller, from the run over a record."""
    from wfsobs.control.controllers import CONTROLLERS
    from wfsobs.priors_from.controllers import own_settings, plant_of, prior_for
    from wfsobs.record import Measurements
    from wfsobs.scenario.presets import paper

    scenario, rng = paper(), np.random.default_rng(3)
    z = np.cumsum(0.01 * rng.standard_normal((600, 2)), axis=0)
    ngs = np.full((600, 2), np.nan)
    ngs[5::5] = z[5::5] + 0.01 * rng.standard_normal((119, 2))
    commands = {}
    for name in ("integrator", "lqg-kf-multi", "lqg-multirate-multi"):
        controller, settings, plant = CONTROLLERS[name], own_settings(CONTROLLERS[name], scenario), plant_of(scenario)
        prior = prior_for(controller, scenario)
        measurements = Measurements(z, np.zeros_like(z), scenario.dt, ngs, 5)
        commands[name] = controller.commands(controller.laws(prior, plant, settings, 2), measurements, prior, plant, settings)[0]
    return np.hstack([z, ngs]), commands


@pytest.mark.parametrize("form", ["npz", "mat"])
@pytest.mark.parametrize("controller", ["integrator", "lqg-kf-multi", "lqg-multirate-multi"])
def test_arrays_are_the_run_over_a_record(tmp_path: Path, form: str, controller: str, whole: tuple) -> None:
    path = write(tmp_path, controller, form)
    if form == "npz":
        with np.load(path) as file:
            arrays = dict(file)
    else:
        arrays = loadmat(path)
        for i in range(2):  # MATLAB has no vectors and drops the last of three dimensions where it is 1
            n = np.ravel(arrays[f"mode{i}_row"]).size
            for name, shape in (
                ("A", (-1, n, n)),
                ("C", (arrays[f"mode{i}_A"].shape[0], -1, n)),
                ("L", (arrays[f"mode{i}_A"].shape[0], n, -1)),
            ):
                arrays[f"mode{i}_{name}"] = arrays[f"mode{i}_{name}"].reshape(shape)
    assert "NaN" not in str(arrays["conventions"]) and "z[k] = y[k] - (1 u[k-2])" in str(arrays["conventions"])
    given, commands = whole
    want = commands[controller]
    np.testing.assert_allclose(run(arrays, given), want, rtol=0, atol=ROUNDING * want.std())


@pytest.mark.parametrize("controller", ["integrator", "lqg-kf-multi"])
def test_the_module_for_python_control(tmp_path: Path, controller: str, whole: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, controller, "control")
    names: dict = {}
    monkeypatch.setitem(__import__("sys").modules, "control", SimpleNamespace(StateSpace=lambda *system: system))
    exec(compile(path.read_text(), "control", "exec"), names)
    A, B, C, D, dt = names["system"]()
    given, commands = whole
    x, want, got = np.zeros(len(A)), commands[controller], []
    for z in given[:, :2]:
        got.append(C @ x + D @ z)
        x = A @ x + B @ z
    assert dt == 1e-3
    np.testing.assert_allclose(got, want, rtol=0, atol=ROUNDING * want.std())


def in_a_loop(A: np.ndarray, B: np.ndarray, C: np.ndarray, D: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Commands of a system that is given y[k] = z[k] + u[k-2], as a sensor in a loop gives it."""
    x, u = np.zeros(len(A)), np.zeros((len(z) + 2, 2))
    for k, disturbance in enumerate(z):
        y = disturbance + u[k]
        u[k + 2] = C @ x + D @ y
        x = A @ x + B @ y
    return u[2:]


@pytest.mark.parametrize("controller", ["integrator", "lqg-kf-multi"])
def test_the_file_for_specula(tmp_path: Path, controller: str, whole: tuple) -> None:
    path = write(tmp_path, controller, "specula")
    with fits.open(path) as file:
        header = file[0].header
        A, B, C, D = (np.asarray(file[name].data, float) for name in "ABCD")
    assert (header["VERSION"], header["NFILTER"], header["NSTATES"]) == (1, 2, len(A))
    assert "1 u[k-2]" in str(header["COMMENT"]) and "delay: 1" in str(header["COMMENT"])
    given, commands = whole
    want = commands[controller]
    got = in_a_loop(A, B, -C, -D, given[:, :2])  # SPECULA's mirror subtracts
    # Rounding comes back through the loop: its largest gain, some 10, times that of one pass
    np.testing.assert_allclose(got, want, rtol=0, atol=10 * ROUNDING * want.std())


@pytest.mark.parametrize("controller", ["integrator", "lqg-kf-multi"])
def test_the_matrices_for_compass(tmp_path: Path, controller: str, whole: tuple) -> None:
    path = write(tmp_path, controller, "compass")
    with np.load(path) as file:
        assert "polc False" in str(file["conventions"]) and {file[name].dtype for name in "ALKF"} == {np.dtype("f4")}
        A, L, K, F = (file[name].astype(float) for name in "ALKF")
    given, commands = whole
    want = commands[controller]
    # x[k] = A x[k-1] + L s[k], u[k] = F K x[k], as a system whose state is x[k-1]
    got = in_a_loop(A, L, F @ K @ A, F @ K @ L, given[:, :2])
    # Single precision is what COMPASS has: 6e-8 of numbers, some hundred of which add up, many cancelling
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-4 * want.std())


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("lqg-multirate", "control"), "repeats every 5 steps"),
        (("lqg-multirate-multi", "specula"), "repeats every 5 steps"),
        (("lqg-multirate-multi", "compass"), "repeats every 5 steps"),
        (("gpr-online", "specula"), "no such controller"),
        (("integrator+gpr-online", "c99"), "no linear form"),
        (("lqg-kf-adaptive", "c99"), "there is no law to write, or none that stays as it is"),
        (("none", "npz"), "there is no law"),
        (("integrator", "npz", "--set", "control.stroke=1"), "limits of the mirror"),
        (("kf-lgs", "npz"), "no such controller"),
        (("integrator", "pdf"), "takes one of c99, compass, control, mat, npz, specula"),
    ],
)
def test_what_a_format_cannot_hold_is_refused_in_one_line(tmp_path: Path, arguments: tuple[str, ...], reason: str) -> None:
    name, form, *more = arguments
    path = tmp_path / f"out{handover.ENDINGS.get(form, '')}"
    result = CliRunner().invoke(main, ["design", "--controller", name, "--to", form, "--out", str(path), *more])
    assert result.exit_code == 2 and reason in result.output and result.output.count("\n") == 1
    assert not path.exists()


def test_c99_overwrites_nothing(tmp_path: Path) -> None:
    (tmp_path / "mine.c").write_text("")
    result = CliRunner().invoke(main, ["design", "--controller", "integrator", "--to", "c99", "--out", str(tmp_path)])
    assert result.exit_code == 2 and "takes a new or empty directory" in result.output


@pytest.mark.parametrize("is_there", [False, True])
def test_c99_leaves_nothing_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_there: bool) -> None:
    def write_some(path: Path, write: Callable[[IO[bytes]], object]) -> None:
        if path.name == "test.c":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        write_whole(path, write)

    if is_there:
        (tmp_path / "out").mkdir()
    with monkeypatch.context() as patched:
        patched.setattr(handover, "write_whole", write_some)
        done = CliRunner().invoke(main, ["design", "--controller", "integrator", "--to", "c99", "--out", str(tmp_path / "out")])
    assert done.exit_code == 2 and "No space left" in done.output
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == ["out"] * is_there
    assert (write(tmp_path, "integrator", "c99") / "output.f64").exists()
