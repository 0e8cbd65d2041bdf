"""The models inside the observers as numbers: coefficients, gains, poles, and the equivalent ridge of a GPR.

Gains are in the paper's state (phi_turb[k], phi_turb[k-1], phi_vib[k], phi_vib[k-1]); the mirror's two states are known
without error and have none. Poles are those of A - K C of the disturbance model, for the multi-rate filters those of one cycle.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from wfsobs.observers.kalman.filters import multirate_filter, multirate_noise, optimal_filter, optimal_model, steady_filter
from wfsobs.prior import Prior
from wfsobs.priors_from.scenario import lgs_error_of, model_of
from wfsobs.scenario import Scenario
from wfsobs.signal.autoregressive import Ar2
from wfsobs.signal.periodic import PeriodicFilter
from wfsobs.signal.statespace import paper_matrices
from wfsobs.simulation.sensor_noise import aliasing_rms, noise_rms
from wfsobs.typing import Array


@dataclass(frozen=True)
class FilterFacts:
    """A Kalman filter.

    Attributes
    ----------
    step : float
        Time between its estimates [s].
    period : float
        Time of the poles, one step or one cycle [s].
    gains : dict of str to Array
        Measurement -> filter gain L, (4,).
    poles : Array
        Poles of A - K C, or of one cycle, the largest first.
    reason : str
        Why there is no such filter, in one line; empty where there is.
    """

    step: float
    period: float
    gains: dict[str, Array]
    poles: Array
    reason: str = ""

    @property
    def radius(self) -> float | None:
        """Largest modulus of a pole; below 1 the filter is stable."""
        return float(np.abs(self.poles).max()) if self.poles.size else None


@dataclass(frozen=True)
class GprFacts:
    """A Gaussian process regression.

    Attributes
    ----------
    ridge : float
        (sigma_n l / sigma_SE)^2, the weight of the nearly equal ridge regression [um^2].
    window : float
        Length of a window [s].
    training : float
        Time from the first to the last training window [s].
    """

    ridge: float
    window: float
    training: float


@dataclass(frozen=True)
class SensorFacts:
    """Errors of one LGS, or of the NGS, rms: white noise of a frame, and aliasing [um]."""

    noise: float
    aliasing: float


@dataclass(frozen=True)
class Description:
    """The model of one mode: its processes, per fast step, A, B, C (paper, eq. 7), and the filters, GPR and sensors."""

    mode: str
    ratio: int
    turbulence: Ar2
    vibration: Ar2
    A: Array
    B: Array
    C: Array
    filters: dict[str, FilterFacts]
    gprs: dict[str, GprFacts]
    sensors: dict[str, SensorFacts]


def describe(scenario: Scenario, mode: int) -> Description:
    """Return the numbers of a scenario's observers for one mode.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    mode : int
        Index of the mode.

    Returns
    -------
    Description
        Model, filters, GPR and sensors; a filter that does not exist has its reason in place of numbers.
    """
    dt, ratio, own = scenario.dt, scenario.sensors.exposure_ratio, scenario.multirate
    prior = model_of(scenario, mode)
    model, slow, both = prior.disturbance(), prior.at(ratio * dt).disturbance(), ("LGS with NGS", "NGS")

    def optimal() -> PeriodicFilter:
        steps = optimal_model(own, Prior((prior,), (lgs_error_of(scenario, mode),)), 0, ratio).steps
        return optimal_filter(steps, np.pad(model.pairs, ((0, 0), (0, len(steps[0][0]) - len(model.A)))))[0]

    def multirate() -> PeriodicFilter:
        return multirate_filter(model, ratio, *multirate_noise(own, prior), model.pairs)

    filters = {
        "kf-lgs": _facts(dt, dt, lambda: steady_filter(model, prior.lgs_noise, model.pairs)[0], ["LGS"]),
        "kf-ngs": _facts(ratio * dt, ratio * dt, lambda: steady_filter(slow, prior.ngs_noise, slow.pairs)[0], ["NGS"]),
        "multirate": _facts(dt, ratio * dt, multirate, both, "LGS alone"),
        "multirate-optimal": _facts(dt, ratio * dt, optimal, both, "LGS, step 1"),
    }
    gprs = {
        name: GprFacts((g.noise_std * g.length_scale / g.signal_std) ** 2, g.depth * dt, (g.training_size + g.depth - 1) * dt)
        for name, g in (("gpr-offline", scenario.gpr_offline), ("gpr-online", scenario.gpr_online))
    }
    sensors = {
        kind.upper(): SensorFacts(float(noise_rms(scenario, kind)[mode]), float(aliasing_rms(scenario, kind)[mode]))
        for kind in ("lgs", "ngs")
    }
    processes = prior.turbulence, prior.vibration
    return Description(scenario.modes[mode].name, ratio, *processes, *paper_matrices(*processes), filters, gprs, sensors)


def _facts(
    step: float, period: float, make: Callable[[], PeriodicFilter], sensors: Sequence[str], alone: str = ""
) -> FilterFacts:
    """Return the gains of the last step of a cycle, by sensor, and of the LGS in the first of several; the poles of a cycle."""
    try:
        found = make()
    except ValueError as error:
        return FilterFacts(step, period, {}, np.empty(0), str(error))
    (*_, first), (*_, last) = found.steps[0], found.steps[-1]
    gains = ({alone: first[:, 0]} if len(found.steps) > 1 else {}) | dict(zip(sensors, last.T, strict=True))
    poles = np.linalg.eigvals(found.cycle_matrix())
    return FilterFacts(step, period, gains, poles[np.argsort(-np.abs(poles), kind="stable")])
