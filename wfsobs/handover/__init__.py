"""A controller's design for programs elsewhere: matrices, C99, python-control.

What every format holds is a linear controller as matrices. Per mode, with e[k] the innovation of the measurements v[k] (z alone,
or z and the NGS frame):

    e = v - C x,    w = x + L e,    u = row w,    x <- A w,

(A, C, L) repeating every few steps. To a Kalman filter a measurement that is missing is none, and near it the gains are those of
its covariance (`wfsobs.signal.gains`). To another controller its innovation is that of what a filter of its own predicts.

In C99, with the gate before it and without dependencies, sparse rows of A and dense C and L are tables of constants; one function
runs any of the filters. The state is a struct of the caller's. Near gaps the covariance of a Kalman filter goes along, in double
precision; it starts from that of the steady state, which is a table as well.

A test comes with it on vectors: measurements with gaps, and the commands of its run over the record.

Of the measurements that arrays take none is missing. Other simulators give the controller what their sensor measures, the
residual of the loop, so that the commands which the pseudo-open-loop measurement subtracts become states of the system.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
from scipy.linalg import block_diag

from wfsobs.control.base import Controller, Settings
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.mirror import Mirror, Plant
from wfsobs.control.step import Integrators, KalmanLaws, LinearLaws, StepController
from wfsobs.files import check_writable, write_text, write_whole
from wfsobs.observers.step import Naming, StepError
from wfsobs.observers.stepping import Gain, GainCycle
from wfsobs.prior import Prior
from wfsobs.priors_from.controllers import own_settings, plant_of
from wfsobs.record import Measurements, Sampling
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError
from wfsobs.signal import gate
from wfsobs.signal.gains import ONE, GapGains, Step
from wfsobs.signal.gate import GateSettings, OutlierGate
from wfsobs.stepping import prior_in, sampling_of
from wfsobs.telemetry.formats.fits import astropy_fits
from wfsobs.typing import Array


class ModeMatrices(NamedTuple):
    """One mode.

    gains, row : of the controller
    gaps       : gains near gaps; None where missing measurements are bridged
    lgs, ngs   : of what then predicts a missing measurement or NGS frame; None where the last one is held
    """

    gains: GainCycle
    row: Array
    gaps: GapGains | None = None
    lgs: GainCycle | None = None
    ngs: GainCycle | None = None


@dataclass(frozen=True)
class LinearDesign:
    """A controller of one or several modes.

    Attributes
    ----------
    id : str
        Of the controller.
    dt : float
        Time step [s].
    ratio : int
        Frames per NGS frame; 0 for a controller without NGS.
    taps : Array
        Weights of u[k], u[k-1], ... in y[k]: delay and mirror that it was designed for.
    modes : tuple of ModeMatrices
        One per mode.
    """

    id: str
    dt: float
    ratio: int
    taps: Array
    modes: tuple[ModeMatrices, ...]

    @property
    def mirror_text(self) -> str:
        """The commands in a measurement, as text."""
        return " + ".join(f"{tap:g} u[k-{i}]" for i, tap in enumerate(self.taps) if tap)

    @property
    def period(self) -> int:
        """Steps after which the gains repeat."""
        return max(len(mode.gains.steps) for mode in self.modes)

    def conventions(self, takes_gaps: bool) -> list[str]:
        """Return units, signs and timing, as lines of text; takes_gaps : whether measurements may be missing."""
        gaps = "none to a Kalman filter, to others predicted, or the last one held"
        lines = [
            f"Controller {self.id} of wfsobs, {len(self.modes)} modes, one call every {self.dt:g} s.",
            "In: z, the pseudo-open-loop measurement of every mode [um rms, Noll-normalised Zernike coefficients].",
            f"    z[k] = y[k] - ({self.mirror_text}), y the measurement of the sensor, u the commands that the mirror took.",
            f"    NaN is a missing measurement: {gaps}." if takes_gaps else "    None may be missing.",
            "Out: u[k], the command of every mode [um], computed once y[k] is known. The residual is disturbance + u.",
            "    Limits of the mirror are the caller's: subtract in z the commands that it took.",
        ]
        if self.ratio:
            lines += [
                f"In: ngs, the NGS frame in the calls k = {self.ratio}, {2 * self.ratio}, ..., any number in the others [um]:",
                f"    its measurement less the mean of what z[k] ... z[k-{self.ratio - 1}] have subtracted.",
                f"The gains repeat every {self.ratio} calls, from call 1 on; call 0 has gains of its own.",
            ]
        return lines


def linear_design(controller: StepController) -> LinearDesign:
    """Return a controller as matrices. Raises StepError with the reason where it is none."""
    law = controller.law
    if controller.ahead is not None:
        raise StepError(f"{controller.id}: a prediction by Gaussian process regression has no linear form")
    if not isinstance(law, (KalmanLaws, LinearLaws, Integrators)):
        raise StepError(f"{controller.id}: there is no law to write, or none that stays as it is")
    if isinstance(law, Integrators) and controller.plant.mirror.has_limits:
        raise StepError(f"{controller.id}: limits of the mirror stop an integrator, which no linear form does: leave them at 0")
    lgs, ngs = ({}, {}) if controller.bridges is None else (bridge.gains for bridge in controller.bridges)
    modes = []
    for mode, one in enumerate(law.laws):
        if one.gains is None or one.row is None:
            raise StepError(f"{controller.id}: its law is not known as gains of an observer")
        gaps = one.filter._replace(mean=ONE).gaps() if one.filter is not None and controller.bridges is None else None
        modes.append(ModeMatrices(one.gains, one.row, gaps, lgs.get(mode), ngs.get(mode)))
    ratio = controller.sampling.ratio or 0 if controller.uses_ngs else 0
    return LinearDesign(controller.id, controller.sampling.dt, ratio, controller.plant.mirror.taps, tuple(modes))


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
        """Return the initialiser of a step: sparse A, then a row of C and a column of L for each of two sensors."""
        dense = (self.numbers("real", x) for pair in zip(gain.C, gain.L.T, strict=True) for x in pair)
        return _initialiser(*self.sparse("real", gain.A), *dense, *("0", "0") * (2 - len(gain.C)))

    def sparse(self, kind: str, A: Array) -> list[str]:
        """Return the names of the non-zero elements of a matrix row by row, their columns, and where each row starts."""
        rows = [np.flatnonzero(row) for row in A]
        starts = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
        values = np.concatenate([A[i, row] for i, row in enumerate(rows)])
        return [self.numbers(kind, values), self.numbers("int", np.concatenate(rows)), self.numbers("int", starts)]

    def gap_step(self, step: Step, posterior: Array) -> str:
        """Return the initialiser of a step near a gap: sparse A and Q, C, the variances of the noise, the steady covariance."""
        A, C, Q, R = step
        dense = (self.numbers("double", x) for x in (C, np.diag(R), posterior))
        return _initialiser(*self.sparse("double", A), *self.sparse("double", Q), *dense)

    def gaps(self, gaps: GapGains | None, name: str) -> str:
        """Return the initialiser of the gains near gaps, with their covariance."""
        if gaps is None:
            return _initialiser(*[0] * 6)
        steps = _initialiser(*map(self.gap_step, gaps.cycle, gaps.posteriors))
        self.lines.append(f"static const struct gap_step {name}_steps[] = {steps};")
        weights, first = self.numbers("double", gaps.weights), self.n_covariances
        self.n_covariances += len(gaps.weights) ** 2
        return _initialiser(len(gaps.cycle), len(gaps.cycle[0][1]), f"{name}_steps", weights, repr(gaps.most), first)

    def filter(self, gains: GainCycle | None, name: str) -> str:
        """Return the initialiser of a filter, its state behind those before it."""
        if gains is None:
            return _initialiser(*[0] * 5)
        steps = [*filter(None, [gains.first]), *gains.steps]
        n, first = len(steps[0].A), self.n_states
        self.lines.append(f"static const struct step {name}_steps[] = {_initialiser(*map(self.step, steps))};")
        self.n_states, self.most = first + n, max(self.most, n)
        return _initialiser(n, len(steps), int(gains.first is not None), f"{name}_steps", first)


def _initialiser(*parts: object) -> str:
    return f"{{{', '.join(map(str, parts))}}}"


def source(design: LinearDesign, gate_settings: GateSettings) -> Mapping[str, str]:
    """Return the text files of the design by name: templates in which @NAME@ is a word of below, or a number of the gate."""
    tables, modes = _Tables(), []
    for i, mode in enumerate(design.modes):
        parts = (
            tables.filter(mode.gains, f"u{i}"),
            tables.filter(mode.lgs, f"z{i}"),
            tables.filter(mode.ngs if design.ratio else None, f"s{i}"),
            tables.gaps(mode.gaps, f"g{i}"),
            tables.numbers("real", mode.row),
        )
        modes.append(_initialiser(*parts))
    lines = design.conventions(True)
    words: dict[str, object] = {
        "CONVENTIONS": "\n".join(f"   {line}" for line in lines),
        "TEXT": "\n".join(lines),
        "MODES": len(modes),
        "RATIO": design.ratio,
        "X": tables.n_states,
        "P": max(tables.n_covariances, 1),
        "STATES": tables.most,
        "PRODUCT": tables.most**2 if tables.n_covariances else 1,
        "TABLES": "\n".join(tables.lines),
        "FILTERS": ",\n    ".join(modes),
        "LEVEL": float(gate_settings.level),
        "MEMORY": 1.0 - 1.0 / gate.MEMORY,
    }

    def word(place: re.Match[str]) -> str:
        return str(words[place[1]] if place[1] in words else getattr(gate, place[1]))

    return {name: re.sub("@([A-Z]+)@", word, (TEMPLATES / name).read_text(encoding="utf-8")) for name in TEXTS}


TEXTS: Sequence[str] = (
    "wfsobs_controller.h",
    "wfsobs_controller.c",
    "wfsobs_gate.h",
    "wfsobs_gate.c",
    "test.c",
    "Makefile",
    "README.txt",
)


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


EQUATIONS = (
    "e[k] = v[k] - C x[k],  w = x[k] + L e[k],  u[k] = row w,  x[k+1] = A w,  x[0] = 0,",
    "mode by mode: mode0_A, mode0_C, mode0_L, mode0_row, ...; the first index of A, C and L is the step. Several steps repeat",
    "from k = 1 on, and mode0_first_A, mode0_first_C, mode0_first_L are those of k = 0; one step is that of every k.",
    "v = z, or (z, ngs) with any number for ngs where no frame is due.",
)


def arrays(design: LinearDesign) -> dict[str, Array]:
    """Return the design as named arrays."""
    text = "\n".join([*design.conventions(False), *EQUATIONS])
    out = {"conventions": np.array(text), "dt": np.array(design.dt), "taps": design.taps, "ratio": np.array(design.ratio)}
    for i, mode in enumerate(design.modes):
        for name in Gain._fields:
            out[f"mode{i}_{name}"] = np.array([getattr(step, name) for step in mode.gains.steps])
            if mode.gains.first is not None:
                out[f"mode{i}_first_{name}"] = getattr(mode.gains.first, name)
        out[f"mode{i}_row"] = mode.row
    return out


def write_npz(path: str | Path, design: LinearDesign) -> None:
    """Write the arrays to an NPZ file. Raises OSError."""
    _write_arrays(path, arrays(design))


def _write_arrays(path: str | Path, values: Mapping[str, Array]) -> None:
    write_whole(path, lambda file: np.savez_compressed(file, allow_pickle=False, **values))


def write_mat(path: str | Path, design: LinearDesign) -> None:
    """Write the arrays to a MATLAB file. Raises OSError."""
    values = {name: str(x) if x.dtype.kind == "U" else x for name, x in arrays(design).items()}
    buffer: Any = BytesIO()
    scipy.io.savemat(buffer, values)
    write_whole(path, lambda file: file.write(buffer.getvalue()))


def check_time_invariant(design: LinearDesign) -> None:
    """Refuse a controller that changes from step to step. Raises StepError."""
    if design.period > 1 or design.ratio:
        raise StepError(
            f"{design.id}: repeats every {design.period} steps, which no time-invariant system does; c99, npz and mat do"
        )


def state_space(design: LinearDesign) -> tuple[Array, Array, Array, Array]:
    """Return (A, B, C, D) from z to u of all modes together. Raises StepError for a controller that changes from step to step."""
    check_time_invariant(design)
    modes = [mode.gains.filter(mode.row[None]).steps[0] for mode in design.modes]
    A, B, C, D = (block_diag(*parts) for parts in zip(*modes, strict=True))
    return A, B, C, D


def _history(design: LinearDesign) -> tuple[Array, Array, Array]:
    """Return of the last commands of all modes: what the mirror does by them, how they grow older, and where the newest goes."""
    m, q = len(design.modes), len(design.taps) - 1
    return np.kron(design.taps[None, 1:], np.eye(m)), np.eye(m * q, k=-m), np.eye(m * q, m)


MODULE = '''"""{conventions}

    system() is x[k+1] = A x[k] + B z[k], u[k] = C x[k] + D z[k].
"""

import control
import numpy as np

A = np.array({A})
B = np.array({B})
C = np.array({C})
D = np.array({D})
DT = {dt!r}


def system():
    """Return the controller from z to u."""
    return control.StateSpace(A, B, C, D, DT)
'''


def write_control(path: str | Path, design: LinearDesign) -> None:
    """Write a Python module that makes the `StateSpace` of python-control. Raises StepError, OSError."""
    matrices = {name: x.tolist() for name, x in zip("ABCD", state_space(design), strict=True)}
    text = MODULE.format(conventions="\n".join(design.conventions(False)), dt=design.dt, **matrices)
    write_text(path, text)


def closed_system(design: LinearDesign) -> tuple[Array, Array, Array, Array]:
    """Return (A, B, C, D) from the measurements y to the commands u of all modes, with x[k+1] = A x[k] + B y[k], u = C x + D y.

    The states are those of the controller, then the commands u[k-1], u[k-2], ... of all modes. Raises StepError for a
    controller that changes from step to step.
    """
    A, B, C, D = state_space(design)
    taken, keep, new = _history(design)
    to_u = np.hstack([C, -D @ taken])
    below = np.pad(keep, ((0, 0), (len(A), 0))) + new @ to_u
    return np.vstack([np.hstack([A, -B @ taken]), below]), np.vstack([B, new @ D]), to_u, D


def estimator_system(design: LinearDesign) -> tuple[Array, Array, Array]:
    """Return (A, L, K) from y to u, with x[k] = A x[k-1] + L y[k], u[k] = K x[k]; raises as `closed_system`.

    The states are the estimates after the measurement, then u[k], u[k-1], ... of all modes.
    """
    check_time_invariant(design)
    steps = [mode.gains.estimator().steps[0] for mode in design.modes]
    F, L = (block_diag(*(step[i] for step in steps)) for i in (0, 1))
    row = block_diag(*(mode.row[None] for mode in design.modes))
    taken, keep, new = _history(design)
    estimate = np.hstack([F, -L @ taken])
    A = np.vstack([estimate, np.pad(keep, ((0, 0), (len(F), 0))) + new @ row @ estimate])
    return A, np.vstack([L, new @ row @ L]), np.pad(row, ((0, 0), (0, len(keep))))


def conventions(design: LinearDesign, lines: tuple[str, ...]) -> list[str]:
    """Return what a file says of its controller."""
    return [
        f"Controller {design.id} of wfsobs, {len(design.modes)} modes, one step every {design.dt:g} s.",
        "In: y[k], the residual of every mode that the sensor measures; out: its command, both in the same unit.",
        f"Designed for a loop in which y[k] contains {design.mirror_text}. None may be missing.",
        *lines,
    ]


SPECULA = (
    "For SPECULA: SsrFilterData.restore(FILE) and an SsrFilter with output_uses_new_state: False, in which",
    "x[k+1] = A x[k] + B y[k], out[k] = C x[k] + D y[k]. The mirror subtracts the command (DM with sign -1): out = -u.",
    "The delay of the loop is that of the simulation, one frame of the sensor and the delay of the filter: of both together",
    "this controller was designed for the frames above, so that two frames are an SsrFilter with delay: 1.",
)

COMPASS = (
    "For COMPASS, controller generic_linear with polc False, modal True, one slope buffer, one state buffer, no IIR vectors:",
    "x[k] = A x[k-1] + L s[k], u[k] = K x[k], command = F u. set_A_matrix(c, 0, A), set_L_matrix(c, 0, L @ R),",
    "set_K_matrix(c, K) and set_F_matrix(c, F), with R (modes, slopes) your reconstructor and F (actuators, modes) your",
    "modes; F of the file is the identity. The residual is disturbance + u.",
)


def write_specula(path: str | Path, design: LinearDesign) -> None:
    """Write a FITS file that `SsrFilterData.restore` of SPECULA reads. Raises StepError, RecordError, OSError."""
    fits = astropy_fits()
    A, B, C, D = closed_system(design)
    header = fits.Header()
    header["VERSION"], header["NFILTER"], header["NSTATES"] = 1, len(C), len(A)
    for line in conventions(design, SPECULA):
        header.add_comment(line)
    images = [fits.ImageHDU(x, name=name) for name, x in zip("ABCD", (A, B, -C, -D), strict=True)]
    buffer = BytesIO()
    fits.HDUList([fits.PrimaryHDU(header=header), *images]).writeto(buffer)
    write_whole(path, lambda file: file.write(buffer.getvalue()))


def write_compass(path: str | Path, design: LinearDesign) -> None:
    """Write the matrices of COMPASS's `generic_linear` to an NPZ file. Raises StepError, OSError."""
    A, L, K = estimator_system(design)
    matrices = {name: np.asarray(x, np.float32) for name, x in {"A": A, "L": L, "K": K, "F": np.eye(len(K))}.items()}
    _write_arrays(path, {"conventions": np.array("\n".join(conventions(design, COMPASS))), **matrices})


ARRAYS = {"compass": write_compass, "control": write_control, "mat": write_mat, "npz": write_npz, "specula": write_specula}
ENDINGS = {"compass": ".npz", "control": ".py", "mat": ".mat", "npz": ".npz", "specula": ".fits"}
"""Of the files that these write."""

FORMATS = ("c99", *ARRAYS)
"""What a design can be written as."""


def write_design(name: str, scenario: Scenario, form: str, path: str | Path) -> None:
    """Write a controller of a scenario.

    Parameters
    ----------
    name : str
        Id of the controller.
    scenario : Scenario
        What it is told, its settings, and the loop.
    form : str
        One of `FORMATS`.
    path : str or Path
        File, or for c99 a new directory.

    Raises
    ------
    SettingError
        No such controller or format.
    StepError
        The format cannot hold the controller.
    OSError
        The file cannot be written.
    """
    CONTROLLERS.check_ids([name])
    if form not in FORMATS:
        raise SettingError(f"--to {form}: takes one of {', '.join(FORMATS)}")
    if form != "c99":
        check_writable(path, endings=(ENDINGS[form],))
    controller, sampling, plant = CONTROLLERS[name], sampling_of(scenario), plant_of(scenario)
    groups = own_settings(controller, scenario)
    prior = prior_in(name, scenario, controller.parts(groups), scenario, sampling, None)
    with Naming(name):
        linear = linear_design(controller.design(prior, plant, groups, sampling))
    if form == "c99":
        gate = GateSettings(scenario.sensors.gate_level)
        write_c99(path, linear, make_vectors(controller, prior, plant, groups, sampling, gate), gate)
    else:
        ARRAYS[form](path, linear)
