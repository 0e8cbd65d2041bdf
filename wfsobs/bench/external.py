"""The same tasks with scikit-learn, filterpy and statsmodels (the extra `bench`), as their users would write them for speed.

Fixed hyper-parameters, steady gains.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np

from wfsobs.observers.gpr.kernels import SquaredExponential
from wfsobs.typing import Array

SKLEARN, FILTERPY, STATSMODELS = "scikit-learn", "filterpy", "statsmodels"
LIBRARIES = {SKLEARN: "sklearn", FILTERPY: "filterpy", STATSMODELS: "statsmodels"}
"""Library -> the module it is imported as."""


def is_installed() -> tuple[str, ...]:
    """Those of LIBRARIES that can be imported."""
    return tuple(name for name, module in LIBRARIES.items() if find_spec(module))


def sklearn_regressor(kernel: SquaredExponential) -> Any:
    """Return a GaussianProcessRegressor with fixed numbers of the kernel."""
    from sklearn.gaussian_process import GaussianProcessRegressor  # pyright: ignore[reportMissingImports]
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel  # pyright: ignore[reportMissingImports]

    covariance = ConstantKernel(kernel.variance, "fixed") * RBF(kernel.length_scale, "fixed")
    keep: Any = None  # no optimizer, which its annotation does not know of
    return GaussianProcessRegressor(covariance, alpha=kernel.noise_std**2, optimizer=keep)


def sklearn_online(X: Array, f: Array, rows: Array, m: int, kernel: SquaredExponential) -> Array:
    """Mean at some rows of X (n, p), fitted anew to the m rows before each; compare `textbook.predict_online`."""
    model = sklearn_regressor(kernel)
    return np.array([model.fit(X[r - m : r], f[r - m : r]).predict(X[r : r + 1])[0] for r in rows])


def filterpy_kalman(A: Array, B: Array, C: Array, L: Array, y: Array, u: Array) -> Array:
    """Compare `textbook.kalman_loop`; filterpy's steady-state functions are lighter than its filter object."""
    predict, update = _filterpy_steps()
    H, x, out = C[None], np.zeros((len(B), 1)), np.empty((len(y), len(B)))
    column, gain = B[:, None], L[:, None]
    for k in range(len(y)):
        x = update(x, y[k], gain, H)
        out[k] = x[:, 0]
        x = predict(x, A, u[k], column)
    return out


def filterpy_multirate(
    A: Array, B: Array, C: Array, C_ngs: Array, L: Array, L_both: Array, y: Array, z_ngs: Array, u: Array
) -> Array:
    """Compare `textbook.multirate_loop`."""
    predict, update = _filterpy_steps()
    H, H_both, both, frame = C[None], np.vstack([C, C_ngs]), np.column_stack([y, z_ngs]), ~np.isnan(z_ngs)
    x, out = np.zeros((len(B), 1)), np.empty((len(y), len(B)))
    column, gain = B[:, None], L[:, None]
    for k in range(len(y)):
        x = update(x, both[k], L_both, H_both) if frame[k] else update(x, y[k], gain, H)
        out[k] = x[:, 0]
        x = predict(x, A, u[k], column)
    return out


def _filterpy_steps() -> tuple[Callable[..., Array], Callable[..., Array]]:
    from filterpy.kalman import predict_steadystate, update_steadystate  # pyright: ignore[reportMissingImports]

    return predict_steadystate, update_steadystate


def statsmodels_kalman(A: Array, C: Array, Q: Array, R: float, P: Array, z: Array) -> Array:
    """Return the filtered states (n_steps, n) of the disturbance model, with n = 4, of z (n_steps,).

    It starts in the steady state P (n, n), so that statsmodels finds it converged; its loop is compiled.
    """
    from statsmodels.tsa.statespace.kalman_filter import KalmanFilter  # pyright: ignore[reportMissingImports]

    n = len(A)
    model = KalmanFilter(k_endog=1, k_states=n, k_posdef=n)
    model["design"], model["obs_cov"] = C[None], np.array([[R]])
    model["transition"], model["selection"], model["state_cov"] = A, np.eye(n), Q
    model.initialize_known(np.zeros(n), P)
    model.bind(z)
    return model.filter().filtered_state.T
