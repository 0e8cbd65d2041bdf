"""The tasks of `wfsobs bench` with scikit-learn, filterpy and statsmodels, as their users would write them for speed.

Fixed hyper-parameters, steady gains.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np

from wfsobs.bench.tasks import KalmanProblem, Library, MultirateProblem, OnlineProblem
from wfsobs.observers.gpr.windows import SquaredExponential
from wfsobs.typing import Array

NAMES = {"scikit-learn": "sklearn", "filterpy": "filterpy", "statsmodels": "statsmodels"}
"""Library -> the module it is imported as."""


def missing() -> list[str]:
    """Return those of NAMES that cannot be imported."""
    return [name for name, module in NAMES.items() if not find_spec(module)]


def sklearn_regressor(kernel: SquaredExponential) -> Any:
    """Return a GaussianProcessRegressor with fixed numbers of the kernel."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    covariance = ConstantKernel(kernel.variance, "fixed") * RBF(kernel.length_scale, "fixed")
    keep: Any = None  # no optimizer, which its annotation does not know of
    return GaussianProcessRegressor(covariance, alpha=kernel.noise_std**2, optimizer=keep)


def sklearn_online(problem: OnlineProblem) -> Array:
    """Mean at the rows of the problem, fitted anew to the m windows before each."""
    model, X, f, m = sklearn_regressor(problem.kernel), problem.X, problem.f, problem.m
    return np.array([model.fit(X[r - m : r], f[r - m : r]).predict(X[r : r + 1])[0] for r in problem.rows])


def sklearn_offline(X: Array, f: Array, kernel: SquaredExponential) -> tuple[Array, Callable[[Array], Array]]:
    """Weights (m,) of windows X (m, p) and targets f (m,), and the function from windows (n, p) to their mean (n,)."""
    model = sklearn_regressor(kernel).fit(X, f)
    return model.alpha_, model.predict


def filterpy_kalman(problem: KalmanProblem) -> Array:
    """Return the filtered states (n_steps, n); filterpy's steady-state functions are lighter than its filter object."""
    steps = _filterpy()

    A, B, C, L, y, u, *_ = problem
    H, x, out = C[None], np.zeros((len(B), 1)), np.empty((len(y), len(B)))
    column, gain = B[:, None], L[:, None]
    for k in range(len(y)):
        x = steps.update_steadystate(x, y[k], gain, H)
        out[k] = x[:, 0]
        x = steps.predict_steadystate(x, A, u[k], column)
    return out


def filterpy_multirate(problem: MultirateProblem) -> Array:
    """Return the filtered states (n_steps, n)."""
    steps = _filterpy()

    A, B, C, C_ngs, L, L_both, y, z_ngs, u = problem
    H, H_both, both, frame = C[None], np.vstack([C, C_ngs]), np.column_stack([y, z_ngs]), ~np.isnan(z_ngs)
    x, out = np.zeros((len(B), 1)), np.empty((len(y), len(B)))
    column, gain = B[:, None], L[:, None]
    for k in range(len(y)):
        x = steps.update_steadystate(x, both[k], L_both, H_both) if frame[k] else steps.update_steadystate(x, y[k], gain, H)
        out[k] = x[:, 0]
        x = steps.predict_steadystate(x, A, u[k], column)
    return out


def _filterpy() -> Any:
    """Return filterpy's filters, whose types are guessed wrongly from their defaults."""
    from filterpy import kalman

    return kalman


def statsmodels_kalman(problem: KalmanProblem) -> Array:
    """Return the filtered states (n_steps, 4) of the disturbance model.

    It starts in the steady state, so that statsmodels finds it converged; its loop is compiled.
    """
    from statsmodels.tsa.statespace.kalman_filter import KalmanFilter

    Q, n = problem.Q, len(problem.Q)
    model = KalmanFilter(k_endog=1, k_states=n, k_posdef=n)
    model["design"], model["obs_cov"] = problem.C[None, :n], np.array([[problem.R]])
    model["transition"], model["selection"], model["state_cov"] = problem.A[:n, :n], np.eye(n), Q
    model.initialize_known(np.zeros(n), problem.P)
    model.bind(problem.z)
    return model.filter().filtered_state.T


LIBRARIES: dict[str, Library] = {
    "scikit-learn": {"online-gpr-record": sklearn_online, "offline-gpr": sklearn_offline},
    "filterpy": {"kalman-record": filterpy_kalman, "multirate-record": filterpy_multirate},
    "statsmodels": {"kalman-record": statsmodels_kalman},  # it has no filter with given gains
}
