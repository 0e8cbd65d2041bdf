"""A linear controller written for a program elsewhere: as arrays, for other simulators, and by `c99` as C99.

Of the measurements that arrays take none is missing. Other simulators give the controller what their sensor measures, the
residual of the loop, so that the commands which the pseudo-open-loop measurement subtracts become states of the system.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat
from scipy.linalg import block_diag

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.files import write_text, write_whole
from wfsobs.handover.c99 import make_vectors, write_c99
from wfsobs.handover.linear import LinearDesign, linear_design
from wfsobs.observers.step import StepError
from wfsobs.observers.stepping import Gain
from wfsobs.priors_from.controllers import own_settings, plant_of
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError
from wfsobs.signal.gate import GateSettings
from wfsobs.stepping import prior_in, sampling_of
from wfsobs.telemetry.formats.fits import astropy_fits
from wfsobs.typing import Array

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
    write_whole(path, lambda file: np.savez_compressed(file, allow_pickle=False, **arrays(design)))


def write_mat(path: str | Path, design: LinearDesign) -> None:
    """Write the arrays to a MATLAB file. Raises OSError."""
    values = {name: str(x) if x.dtype.kind == "U" else x for name, x in arrays(design).items()}
    buffer: Any = BytesIO()
    savemat(buffer, values)
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
    m, q = len(C), len(design.taps) - 1
    taken = np.kron(design.taps[None, 1:], np.eye(m))  # what the mirror did of y, out of the history
    keep = np.eye(m * q, k=-m)
    to_u, new = np.hstack([C, -D @ taken]), np.eye(m * q, m)
    above = np.hstack([A, -B @ taken])
    below = np.hstack([np.zeros((m * q, len(A))), keep]) + new @ to_u
    return np.vstack([above, below]), np.vstack([B, new @ D]), to_u, D


def estimator_system(design: LinearDesign) -> tuple[Array, Array, Array]:
    """Return (A, L, K) from y to u, with x[k] = A x[k-1] + L y[k], u[k] = K x[k]; raises as `closed_system`.

    The states are the estimates after the measurement, then u[k], u[k-1], ... of all modes.
    """
    check_time_invariant(design)
    steps = [mode.gains.estimator().steps[0] for mode in design.modes]
    F, L = (block_diag(*(step[i] for step in steps)) for i in (0, 1))
    row = block_diag(*(mode.row[None] for mode in design.modes))
    m, q = len(row), len(design.taps) - 1
    taken = np.kron(design.taps[None, 1:], np.eye(m))
    estimate = np.hstack([F, -L @ taken])
    keep = np.hstack([np.zeros((m * q, len(F))), np.eye(m * q, k=-m)])
    new = np.eye(m * q, m)
    A = np.vstack([estimate, keep + new @ row @ estimate])
    return A, np.vstack([L, new @ row @ L]), np.hstack([row, np.zeros((m, m * q))])


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
    text = np.array("\n".join(conventions(design, COMPASS)))
    values = {"A": A, "L": L, "K": K, "F": np.eye(len(K))}
    matrices = {name: np.asarray(x, np.float32) for name, x in values.items()}
    write_whole(path, lambda file: np.savez_compressed(file, allow_pickle=False, conventions=text, **matrices))


FORMATS = ("c99", "compass", "control", "mat", "npz", "specula")
"""What a design can be written as."""

ARRAYS = {"compass": write_compass, "control": write_control, "mat": write_mat, "npz": write_npz, "specula": write_specula}


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
    controller, sampling, plant = CONTROLLERS[name], sampling_of(scenario), plant_of(scenario)
    groups = own_settings(controller, scenario)
    prior = prior_in(name, scenario, controller.parts(groups), scenario, sampling, None)
    linear = linear_design(controller.design(prior, plant, groups, sampling))
    if form == "c99":
        gate = GateSettings(scenario.sensors.gate_level)
        write_c99(path, linear, make_vectors(controller, prior, plant, groups, sampling, gate), gate)
    else:
        ARRAYS[form](path, linear)
