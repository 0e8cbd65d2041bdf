"""Slopes and commands of actuators become modes by the matrices of the loop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import wfsobs
from wfsobs.cli import main
from wfsobs.record import RecordError

N, SLOPES, ACTUATORS = 1200, 24, 40


@pytest.fixture
def signals() -> dict[str, np.ndarray]:
    """Return modes, a matrix that reconstructs them from slopes, one that makes commands of them, slopes and commands."""
    rng = np.random.default_rng(1)
    y, u = rng.standard_normal((2, N, 2))
    interaction, to_commands = rng.standard_normal((SLOPES, 2)), rng.standard_normal((ACTUATORS, 2))
    aside = np.linalg.svd(interaction.T)[2][2:]  # slopes that no mode has
    slopes = y @ interaction.T + rng.standard_normal((N, SLOPES - 2)) @ aside
    return {
        "y": y,
        "u": u,
        "R": np.linalg.pinv(interaction),
        "M": to_commands,
        "slopes": slopes,
        "volts": u @ to_commands.T,
    }


@pytest.fixture
def file(signals: dict[str, np.ndarray], tmp_path: Path) -> Path:
    path = tmp_path / "night.npz"
    np.savez(path, dt=1e-3, slopes=signals["slopes"], volts=signals["volts"], R=signals["R"], M=signals["M"])
    return path


COLUMNS = {"y_lgs": "slopes", "u": "volts"}


@pytest.mark.parametrize("is_transposed", [False, True])
def test_modes_are_those_that_the_slopes_were_made_of(
    signals: dict[str, np.ndarray], file: Path, tmp_path: Path, is_transposed: bool
) -> None:
    """By names in a file of any format, and by arrays; to rounding, of a condition below 10."""
    R, M = (signals[name].T if is_transposed else signals[name] for name in "RM")
    np.save(tmp_path / "R.npy", R)
    np.savetxt(tmp_path / "M.txt", M, fmt="%.17g")
    ways: tuple[dict[str, Any], ...] = (
        {"reconstructor": R, "command_modes": M},
        {"reconstructor": str(tmp_path / "R.npy"), "command_modes": f"{file}:M"},
        {"reconstructor": f"{file}:R", "command_modes": str(tmp_path / "M.txt")},
    )
    for matrices in ways:
        record = wfsobs.load(file, columns=COLUMNS, trust=True, **matrices)
        np.testing.assert_allclose(record.y_lgs, signals["y"], atol=1e-12)
        np.testing.assert_allclose(record.u, signals["u"], atol=1e-12)
        assert "2 modes of 24 slopes" in record.origin and "2 modes of 40 commands" in record.origin


def test_noise_of_slopes_is_carried_through(signals: dict[str, np.ndarray], tmp_path: Path) -> None:
    """White noise of slopes becomes R R' in the modes: five deviations of a sample covariance of 40,000."""
    noise = np.random.default_rng(2).standard_normal((40_000, SLOPES))
    np.savez(tmp_path / "n.npz", slopes=noise, dt=1e-3)
    record = wfsobs.load(tmp_path / "n.npz", columns={"y_lgs": "slopes"}, open_loop=True, reconstructor=signals["R"])
    expected = signals["R"] @ signals["R"].T
    np.testing.assert_allclose(np.cov(record.y_lgs.T), expected, atol=5.0 * expected.max() * np.sqrt(2.0 / 40_000))


def test_a_frame_of_which_a_slope_is_missing_is_missing(signals: dict[str, np.ndarray], tmp_path: Path) -> None:
    slopes = signals["slopes"].copy()
    slopes[7, 3] = np.nan
    np.savez(tmp_path / "n.npz", slopes=slopes, dt=1e-3)
    record = wfsobs.load(tmp_path / "n.npz", columns={"y_lgs": "slopes"}, open_loop=True, reconstructor=signals["R"])
    assert np.flatnonzero(np.isnan(record.y_lgs).any(axis=1)).tolist() == [7]


@pytest.mark.parametrize(
    ("matrix", "what"),
    [
        (np.ones((2, 5)), "a matrix of 2 x 5; it takes one of finite numbers for 24 slopes"),
        (np.ones((2, SLOPES)), "does not tell 2 modes apart"),
        (np.full((2, SLOPES), np.nan), "finite numbers"),
        ("nowhere.npy", "nowhere.npy: cannot be read"),
        ("{file}", "which of its arrays is the matrix? It has M, R, slopes, volts: give FILE:NAME"),
        ("{file}:Q", "has no matrix 'Q'"),
    ],
)
def test_a_matrix_that_does_not_fit_is_one_line(file: Path, matrix: object, what: str) -> None:
    matrix = matrix.format(file=file) if isinstance(matrix, str) else matrix
    with pytest.raises(RecordError) as error:
        wfsobs.load(file, columns=COLUMNS, reconstructor=matrix)  # type: ignore[arg-type]
    assert what in str(error.value) and "\n" not in str(error.value)


def test_slopes_without_a_matrix_are_told_of_it(file: Path) -> None:
    with pytest.raises(RecordError, match="commands of actuators need --command-modes"):
        wfsobs.load(file, columns=COLUMNS, reconstructor=f"{file}:R")
    with pytest.raises(RecordError, match="slopes need a --reconstructor"):
        wfsobs.load(file, columns=COLUMNS)


@pytest.mark.slow
def test_the_command_line_reads_them_and_repeats_how(file: Path) -> None:
    words = ["--column", "y_lgs=slopes", "--column", "u=volts", "--reconstructor", f"{file}:R", "--command-modes", f"{file}:M"]
    result = CliRunner().invoke(main, ["check", str(file), *words])
    assert result.exit_code == 0, result.output
    assert f"--reconstructor {file}:R --command-modes {file}:M" in result.output.replace("\n", " ")
