"""The script for the Keck telemetry, on files of the same form: what it writes is the open-loop signal of its authors."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from click.testing import CliRunner

from wfsobs.cli import main
from wfsobs.scenario import configfile
from wfsobs.telemetry.records import load_record

DOCS = Path(__file__).parents[2] / "docs" / "scripts"


def load_script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def convert(folder: Path, out: Path) -> None:
    load_script("keck_record").convert(folder, out)


@pytest.mark.slow
def test_the_record_of_a_keck_like_loop(tmp_path, capsys) -> None:
    """An integrator of gain 0.1 on a line of 20 Hz and noise, in arcsec; commands are taken off, seen one row later."""
    rng = np.random.default_rng(4)
    n = 8000
    disturbance = 0.05 * np.cos(2 * np.pi * 19.96e-3 * np.arange(n))[:, None] + 0.02 * rng.standard_normal((n, 2))
    centroid, commands = np.zeros((n, 2)), np.zeros((n, 2))
    for k in range(n):
        centroid[k] = disturbance[k] - (commands[k - 1] if k else 0.0)
        commands[k] = (commands[k - 1] if k else 0.0) + 0.1 * centroid[k]
    np.save(tmp_path / "Centroid_n0001.npy", centroid.astype(">f4"))
    np.save(tmp_path / "Commands_n0001.npy", commands.astype(">f4"))
    np.save(tmp_path / "OpenLoop_n0001.npy", (commands[:-1] + centroid[1:]).astype("f4"))
    convert(tmp_path, tmp_path / "keck.npz")
    assert "Commands[k] + Centroid[k+1]" in capsys.readouterr().out
    scenario = configfile.load_scenario(DOCS / "keck.toml")
    record = load_record(tmp_path / "keck.npz", scenario)
    um_per_arcsec = 1e6 * np.deg2rad(1 / 3600) * 10.0 / 4.0
    assert (record.n_steps, record.delay, record.training.y_lgs.shape) == (3000, 1, (5000, 2))
    np.testing.assert_allclose(record.z[1:], disturbance[5001:] * um_per_arcsec, atol=1e-5)
    done = CliRunner().invoke(
        main,
        [
            "observe",
            str(tmp_path / "keck.npz"),
            "--config",
            str(DOCS / "keck.toml"),
            "--set",
            "gpr_online.training_size=20",
            "--set",
            "gpr_offline.training_size=50",
        ],
    )
    assert done.exit_code == 0 and "next z" in done.stdout, done.stderr
    assert "keck.npz: read as unit arcsec, aperture 10 m, command sign -1\n" in done.stderr


def test_files_that_do_not_go_together(tmp_path) -> None:
    with pytest.raises(ValueError, match=r"has 0 files Centroid\*\.npy, not one"):
        convert(tmp_path, tmp_path / "keck.npz")
    np.save(tmp_path / "Centroid_n1.npy", np.zeros((5, 2)))
    np.save(tmp_path / "Commands_n1.npy", np.zeros((6, 2)))
    with pytest.raises(ValueError, match=r"Centroid has shape \(5, 2\), Commands \(6, 2\)"):
        convert(tmp_path, tmp_path / "keck.npz")


def test_taps_predict_what_two_samples_say() -> None:
    """A cosine is x[k+1] = 2 cos(w) x[k] - x[k-1]: no error, but of the first two where the taps start from zeros."""
    k = np.arange(400)
    z = np.cos(0.1 * k[:, None] + [0.0, 1.0])
    taps_errors = load_script("keck_prediction").taps_errors
    np.testing.assert_allclose(taps_errors(z, 200, 2, knows_first=True), 0.0, atol=1e-12)
    at_rest = taps_errors(z, 200, 2, knows_first=False)
    np.testing.assert_allclose(at_rest[:2], [z[200], z[201] - 2.0 * np.cos(0.1) * z[200]], rtol=1e-10)
    np.testing.assert_allclose(at_rest[2:], 0.0, atol=1e-12)
