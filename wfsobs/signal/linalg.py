"""The BLAS and LAPACK routines that the observers need, from scipy, on sub-matrices in place.

scipy publishes the addresses of its BLAS and LAPACK for other compiled code (`scipy.linalg.cython_blas`). Called
through ctypes they work on any part of a column-major matrix without a copy, and without the interpreter lock, so
that two modes run on two cores. scipy's own Python wrappers do neither.

Every matrix here is float64 in column-major (Fortran) order, or a rectangular part of one, and only lower
triangles of symmetric matrices are read or written.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.linalg import cython_blas, cython_lapack

from wfsobs.typing import Array

_api = ctypes.pythonapi
_name, _pointer = _api.PyCapsule_GetName, _api.PyCapsule_GetPointer
_name.restype, _name.argtypes = ctypes.c_char_p, [ctypes.py_object]
_pointer.restype, _pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]


def _routine(module: Any, name: str, n_arguments: int):
    """Return a Fortran routine by name; every argument is an address."""
    capsule = module.__pyx_capi__[name]
    return ctypes.CFUNCTYPE(None, *([ctypes.c_void_p] * n_arguments))(_pointer(capsule, _name(capsule)))


_potrf = _routine(cython_lapack, "dpotrf", 5)
_trsm = _routine(cython_blas, "dtrsm", 11)
_syrk = _routine(cython_blas, "dsyrk", 10)

_keep: list[ctypes._SimpleCData] = []  # what the addresses below point at


@cache
def _at(kind: type[Any], value: Any) -> int:
    """Return the address of a value that is kept."""
    _keep.append(kind(value))
    return ctypes.addressof(_keep[-1])


_int, _real = partial(_at, ctypes.c_int), partial(_at, ctypes.c_double)
_L, _R, _N, _T = (_at(ctypes.c_char, letter) for letter in (b"L", b"R", b"N", b"T"))


def _place(S: Array) -> tuple[int, int]:
    """Return the addresses of the first element and of the distance from column to column."""
    return S.ctypes.data, _int(S.strides[1] // S.itemsize)


def _divide(side: int, turn: int, m: int, n: int, L: int, lead: int, X: int, step: int) -> None:
    """Solve, in place of X (m, n), with the lower triangle L on its left or right, transposed or not."""
    _trsm(side, _L, turn, _N, _int(m), _int(n), _real(1.0), L, lead, X, step)


PANEL = 256
"""Columns eliminated at a time: no more work than all at once, and the computation can stop in between."""


def eliminate(S: Array, n: int, check: Callable[[], None]) -> None:
    """Eliminate the first `n` rows and columns of the symmetric S, in place.

    With S11 = L L', the lower triangle of S[n:, n:] becomes the Schur complement S22 - S21 S11^-1 S12, and the first n
    columns become L over S21 L'^-1.

    Parameters
    ----------
    S : Array
        Symmetric matrix, (N, N), column-major; its lower triangle is used.
    n : int
        Number of rows and columns to eliminate.
    check : callable
        Called between blocks; an exception that it raises ends the computation.

    Raises
    ------
    numpy.linalg.LinAlgError
        S11 is not positive definite.
    """
    for done in range(0, n, PANEL):
        check()
        _eliminate_panel(S[done:, done:], min(PANEL, n - done))


def _eliminate_panel(S: Array, n: int) -> None:
    rest, (here, lead), item = S.shape[0] - n, _place(S), S.itemsize
    below, corner = here + n * item, here + n * (S.strides[1] + item)
    info = ctypes.c_int(0)
    _potrf(_L, _int(n), here, lead, ctypes.addressof(info))
    if info.value:
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    _divide(_R, _T, rest, n, here, lead, below, lead)
    _syrk(_L, _N, _int(rest), _int(n), _real(-1.0), below, lead, _real(1.0), corner, lead)


def solve_rows(S: Array, n: int) -> Array:
    """Return S21 S11^-1, (N - n, n), from the result of `eliminate`; in place of S21."""
    here, lead = _place(S)
    _divide(_R, _N, S.shape[0] - n, n, here, lead, here + n * S.itemsize, lead)
    return S[n:, :n]


def solve_lower(L: Array, X: Array) -> Array:
    """Return L^-1 X for the lower triangle L (n, n) and X (n, k); in place of X."""
    n, k = X.shape
    _divide(_L, _N, n, k, *_place(L), *_place(X))
    return X
