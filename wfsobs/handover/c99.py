"""A linear controller and the gate before it as C99 without dependencies, and a test on vectors of the run over a record.

Sparse rows of A and dense C and L are tables of constants; one function runs any of the filters. The state is a struct of the
caller's. Near gaps the covariance of a Kalman filter goes along, in double precision; it starts from that of the steady state,
which is a table as well.

Test vectors of a controller: measurements with gaps, and the commands of its run over the record.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

import numpy as np

from wfsobs.control.base import Controller, Settings
from wfsobs.control.mirror import Mirror, Plant
from wfsobs.files import write_whole
from wfsobs.handover.linear import LinearDesign
from wfsobs.observers.step import StepError
from wfsobs.observers.stepping import Gain, GainCycle
from wfsobs.prior import Prior
from wfsobs.record import Measurements, Sampling
from wfsobs.signal import gate
from wfsobs.signal.gap_gains import GapGains
from wfsobs.signal.gate import GateSettings, OutlierGate
from wfsobs.signal.riccati import Step
from wfsobs.typing import Array

STEPS = 10_240
SEED = 1


class Vectors(NamedTuple):
    """z, ngs and u (n_steps, n_modes) [um], NaN where missing, ngs where no frame is due; z with outliers, and without these."""

    z: Array
    ngs: Array
    u: Array
    with_outliers: Array
    without_outliers: Array


def make_vectors(
    controller: Controller, prior: Prior, plant: Plant, settings: Settings, sampling: Sampling, gate: GateSettings
) -> Vectors:
    """Run a controller over drawn measurements: slow drifts, a line, white noise; single gaps, a long one, gaps of one mode."""
    rng = np.random.default_rng(SEED)
    n, modes, ratio = STEPS, sampling.n_modes, sampling.ratio or 1
    phase = 2.0 * np.pi * rng.random((3, modes))
    time = np.arange(n)[:, None] * sampling.dt
    slow = np.zeros((n, modes))
    for a, f, p in zip((0.3, 0.1, 0.02), (0.7, 3.1, 47.5), phase, strict=True):
        slow += a * np.sin(2.0 * np.pi * f * time + p)
    z = slow + 0.02 * rng.standard_normal((n, modes))
    ngs = np.full((n, modes), np.nan)
    ngs[ratio::ratio] = slow[ratio::ratio] + 0.01 * rng.standard_normal((len(range(ratio, n, ratio)), modes))
    z[rng.random(n) < 0.01] = np.nan
    z[rng.random((n, modes)) < 0.005] = np.nan
    z[n // 2 : n // 2 + 40] = np.nan
    ngs[rng.random((n, modes)) < 0.02] = np.nan
    still = np.zeros((n, modes))  # a mirror at rest: the measurements are pseudo-open-loop already
    measurements = Measurements(z, still, sampling.dt, ngs if sampling.ratio else None, sampling.ratio, delay=sampling.delay)
    free = Plant(Mirror(plant.mirror.delay), plant.dt, plant.ratio)
    laws = controller.laws(prior, free, settings, modes)
    broken = z.copy()
    broken[rng.random((n, modes)) < 0.01] += 0.5
    broken[n // 3 :] += 0.2  # a jump
    broken[n // 4 :] += 0.1 * np.sin(2.0 * np.pi * 0.11 * np.arange(n - n // 4))[:, None]  # a vibration that appears
    u = controller.commands(laws, measurements, prior, free, settings)[0]
    return Vectors(z, ngs, u, broken, OutlierGate(modes, gate).check_all(broken))


TEMPLATES = files("wfsobs.handover") / "templates"


class _Tables:
    """Tables of constants, each written once however often it is used.

    Attributes
    ----------
    n_states, n_covariances, most : int
        Numbers in the states of all filters together and in the covariances that go along; states of the longest filter.
    """

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.n_states = self.n_covariances = self.most = 0
        self._names: dict[tuple[str, bytes], str] = {}

    def numbers(self, kind: str, values: Array) -> str:
        """Return the name of a table of `kind`, real, double or int."""
        values = np.ascontiguousarray(values).ravel()
        key = kind, values.tobytes()
        if key not in self._names:
            self._names[key] = name = f"t{len(self._names)}"
            text = ", ".join(str(int(v)) if kind == "int" else repr(float(v)) for v in values)
            self.lines.append(f"static const {kind} {name}[] = {{{text}}};")
        return self._names[key]

    def step(self, gain: Gain) -> str:
        """Return the initialiser of a step: sparse A, then rows of C and columns of L."""
        second = len(gain.C) > 1
        parts = [
            *self.sparse("real", gain.A),
            self.numbers("real", gain.C[0]),
            self.numbers("real", gain.L[:, 0]),
            self.numbers("real", gain.C[1]) if second else "0",
            self.numbers("real", gain.L[:, 1]) if second else "0",
        ]
        return "{" + ", ".join(parts) + "}"

    def sparse(self, kind: str, A: Array) -> list[str]:
        """Return the names of the non-zero elements of a matrix row by row, their columns, and where each row starts."""
        rows = [np.flatnonzero(row) for row in A]
        starts = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
        values = np.concatenate([A[i, row] for i, row in enumerate(rows)])
        return [self.numbers(kind, values), self.numbers("int", np.concatenate(rows)), self.numbers("int", starts)]

    def gap_step(self, step: Step, posterior: Array) -> str:
        """Return the initialiser of a step near a gap: sparse A and Q, C, the variances of the noise, the steady covariance."""
        A, C, Q, R = step
        dense = (C, np.diag(R), posterior)
        return (
            "{"
            + ", ".join([*self.sparse("double", A), *self.sparse("double", Q), *(self.numbers("double", x) for x in dense)])
            + "}"
        )

    def gaps(self, gaps: GapGains | None, name: str) -> str:
        """Return the initialiser of the gains near gaps, with their covariance."""
        if gaps is None:
            return "{0, 0, 0, 0, 0, 0}"
        steps = ", ".join(map(self.gap_step, gaps.cycle, gaps.posteriors))
        n = len(gaps.weights)
        self.lines.append(f"static const struct gap_step {name}_steps[] = {{{steps}}};")
        counts, first = f"{len(gaps.cycle)}, {len(gaps.cycle[0][1])}", self.n_covariances
        self.n_covariances += n * n
        return f"{{{counts}, {name}_steps, {self.numbers('double', gaps.weights)}, {gaps.most!r}, {first}}}"

    def filter(self, gains: GainCycle | None, name: str) -> str:
        """Return the initialiser of a filter, its state behind those before it."""
        if gains is None:
            return "{0, 0, 0, 0, 0}"
        steps = ([] if gains.first is None else [gains.first]) + list(gains.steps)
        n = len(steps[0].A)
        self.lines.append(f"static const struct step {name}_steps[] = {{{', '.join(map(self.step, steps))}}};")
        first, self.n_states, self.most = self.n_states, self.n_states + n, max(self.most, n)
        return f"{{{n}, {len(steps)}, {int(gains.first is not None)}, {name}_steps, {first}}}"


GATE_NUMBERS = (
    "ORDER",
    "BLOCK",
    "RUN",
    "OPEN",
    "FORGET",
    "LASTING",
    "EARLY",
    "EARLIEST",
    "MEDIAN",
    "RIDGE",
    "FIRST",
    "PACE",
    "USUAL",
    "RAREST",
    "START",
)
"""Numbers of the gate that its source has."""


def source(design: LinearDesign, gate_settings: GateSettings) -> Mapping[str, str]:
    """Return the text files of the design by name."""
    tables, modes = _Tables(), []
    for i, mode in enumerate(design.modes):
        parts = [
            tables.filter(mode.gains, f"u{i}"),
            tables.filter(mode.lgs, f"z{i}"),
            tables.filter(mode.ngs if design.ratio else None, f"s{i}"),
            tables.gaps(mode.gaps, f"g{i}"),
            tables.numbers("real", mode.row),
        ]
        modes.append("{" + ", ".join(parts) + "}")
    words = {
        "@CONVENTIONS@": "\n".join(f"   {line}" for line in design.conventions(True)),
        "@TEXT@": "\n".join(design.conventions(True)),
        "@MODES@": str(len(modes)),
        "@RATIO@": str(design.ratio),
        "@X@": str(tables.n_states),
        "@P@": str(max(tables.n_covariances, 1)),
        "@STATES@": str(tables.most),
        "@PRODUCT@": str(tables.most**2 if tables.n_covariances else 1),
        "@TABLES@": "\n".join(tables.lines),
        "@FILTERS@": ",\n    ".join(modes),
        "@LEVEL@": repr(float(gate_settings.level)),
        "@MEMORY@": repr(1.0 - 1.0 / gate.MEMORY),
        **{f"@{name}@": repr(getattr(gate, name)) for name in GATE_NUMBERS},
    }
    return {name: _fill((TEMPLATES / name).read_text(encoding="utf-8"), words) for name in TEXTS}


TEXTS: Sequence[str] = (
    "wfsobs_controller.h",
    "wfsobs_controller.c",
    "wfsobs_gate.h",
    "wfsobs_gate.c",
    "test.c",
    "Makefile",
    "README.txt",
)


def _fill(text: str, words: Mapping[str, str]) -> str:
    for word, value in words.items():
        text = text.replace(word, value)
    return text


def write_c99(path: str | Path, design: LinearDesign, vectors: Vectors, gate_settings: GateSettings) -> None:
    """Write the design to a new or empty directory, whole or not at all. Raises StepError for another one, OSError."""
    path = Path(path)
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise StepError(f"{path}: exists; c99 takes a new or empty directory")
    contents = {name: text.encode() for name, text in source(design, gate_settings).items()}
    contents["input.f64"] = np.hstack([vectors.z, vectors.ngs]).astype("<f8").tobytes()
    contents["gate.f64"] = np.hstack([vectors.with_outliers, vectors.without_outliers]).astype("<f8").tobytes()
    contents["output.f64"] = vectors.u.astype("<f8").tobytes()
    is_new = not path.exists()
    path.mkdir(parents=True, exist_ok=True)
    try:
        for name, data in contents.items():
            write_whole(path / name, lambda file, data=data: file.write(data))
    except BaseException:  # the same command again takes no directory that has something in it
        for name in contents:
            (path / name).unlink(missing_ok=True)
        if is_new:
            path.rmdir()
        raise
