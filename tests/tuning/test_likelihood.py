"""The marginal likelihood against the textbook's density of a normal distribution."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from scipy.stats import multivariate_normal
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from wfsobs.observers.gpr.offline import training_targets
from wfsobs.observers.gpr.windows import SquaredExponential
from wfsobs.priors_from.scenario import bands_of
from wfsobs.priors_from.telemetry import training_of
from wfsobs.record import Training
from wfsobs.scenario.presets import PRESETS
from wfsobs.signal.gate import GateSettings
from wfsobs.simulation.loop import simulate
from wfsobs.tuning.trials import likelihood, log_marginal_likelihood

pytestmark = pytest.mark.slow

SMALL: dict[str, Any] = {
    "run.duration": 2.0,
    "gpr_offline.training_size": 120,
    "gpr_offline.depth": 30,
    "gpr_online.training_size": 60,
    "gpr_online.depth": 30,
}


def windows(signals: np.ndarray, depth: int, first: int, m: int) -> np.ndarray:
    return sliding_window_view(signals, depth, axis=0)[first - depth + 1 : first - depth + 1 + m].reshape(m, -1)


@pytest.mark.parametrize(
    "kernel",
    [
        SquaredExponential(3.0, 2.0, 0.5),
        SquaredExponential(0.7, 20.0, 0.1),
        SquaredExponential(10.0, 300.0, 0.13),
    ],
    ids=["curved", "in between", "all but linear"],
)
def test_it_is_the_log_density_of_the_targets(kernel: SquaredExponential) -> None:
    rng = np.random.default_rng(1)
    signals, f, depth, first, m = rng.standard_normal((80, 2)), rng.standard_normal(80), 5, 11, 60
    X = windows(signals, depth, first, m)
    distance = np.square(X[:, None] - X[None]).sum(axis=2)
    C = kernel.variance * np.exp(-distance / (2.0 * kernel.length_scale**2)) + kernel.noise_std**2 * np.eye(m)
    got = log_marginal_likelihood(signals, f, depth, first, m, kernel)
    # rounding of the textbook's C: its condition number is up to 4e5
    assert got == pytest.approx(multivariate_normal(np.zeros(m), C).logpdf(f[first : first + m]), rel=1e-9)


def test_of_the_offline_gpr_it_is_that_of_scikit_learn() -> None:
    s = PRESETS["paper"]().replace(
        SMALL
        | {
            "gpr_offline.inputs": "z",
            "gpr_offline.length_scale": 5.0,
            "gpr_offline.signal_std": 0.05,
            "gpr_offline.noise_std": 0.01,
        }
    )
    record = simulate(s)
    assert record.training is not None
    got, g = likelihood("gpr-offline", record, s), s.gpr_offline
    assert got is not None
    kernel = ConstantKernel(g.signal_std**2, "fixed") * RBF(g.length_scale, "fixed") + WhiteKernel(g.noise_std**2, "fixed")
    targets = training_targets(record.training, bands_of(s), record.dt)
    u = record.training.u
    z = record.training.y_lgs - np.vstack([np.zeros((2, 2)), u[:-2]])
    for mode in range(2):
        X, f = windows(z[:, [mode]], g.depth, g.depth - 1, g.training_size), targets[g.depth - 1 :][: g.training_size, mode]
        fitted = GaussianProcessRegressor(kernel, alpha=0.0).fit(X, f)
        assert got[mode] == pytest.approx(fitted.log_marginal_likelihood(), rel=1e-9)


@pytest.mark.parametrize(("missing", "outlier"), [(np.nan, 0.0), (0.0, 3.0)], ids=["lost", "outliers"])
@pytest.mark.parametrize("observer", ["gpr-offline", "gpr-online"])
def test_it_is_that_of_the_training_data_that_observers_receive(observer: str, missing: float, outlier: float) -> None:
    s = PRESETS["paper"]().replace(SMALL | {"gpr_online.inputs_filter": "standardised"})
    record = simulate(s)
    assert record.training is not None and record.training.open_loop_y is not None
    y, twin = record.training.y_lgs.copy(), record.training.open_loop_y.copy()
    for signal in (y, twin):
        signal[60:62] += missing + outlier
    raw = replace(record, training=Training(y, record.training.u, twin), gate=GateSettings() if outlier else None)
    got = likelihood(observer, raw, s)
    assert got is not None and got == likelihood(observer, replace(raw, training=training_of(raw), gate=None), s)


def test_none_for_what_is_no_gpr_and_for_a_record_too_short() -> None:
    s = PRESETS["paper"]().replace({"run.duration": 2.0, "gpr_offline.training_size": 20, "gpr_offline.depth": 10})
    record = simulate(s)
    assert likelihood("kf-lgs", record, s) is None
    assert likelihood("gpr-online", record, s.replace({"gpr_online.depth": 1500})) is None
    assert likelihood("gpr-offline", record, s.replace({"gpr_offline.depth": 600})) is None
