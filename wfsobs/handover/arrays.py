"""A linear controller as arrays: NPZ, MATLAB and a module for python-control. They predict no missing measurements."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat
from scipy.linalg import block_diag

from wfsobs.files import write_whole
from wfsobs.handover.linear import LinearDesign
from wfsobs.observers.step import StepError
from wfsobs.observers.stepping import Gain
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
    write_whole(path, lambda file: file.write(text.encode()))
