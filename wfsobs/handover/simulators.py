"""A linear controller for other simulators: the filter of SPECULA, the matrices of COMPASS.

Both give the controller what their sensor measures, the residual of the loop, so that the commands which the
pseudo-open-loop measurement subtracts become states of the system.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from wfsobs.files import write_whole
from wfsobs.handover.arrays import check_time_invariant, state_space
from wfsobs.handover.linear import LinearDesign
from wfsobs.telemetry.formats.fits import astropy_fits
from wfsobs.typing import Array


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
    delay = " + ".join(f"{tap:g} u[k-{i}]" for i, tap in enumerate(design.taps) if tap)
    return [
        f"Controller {design.id} of wfsobs, {len(design.modes)} modes, one step every {design.dt:g} s.",
        "In: y[k], the residual of every mode that the sensor measures; out: its command, both in the same unit.",
        f"Designed for a loop in which y[k] contains {delay}. None may be missing.",
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
