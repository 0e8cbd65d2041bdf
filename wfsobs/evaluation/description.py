"""The models inside the observers as numbers: coefficients, gains, poles, and the equivalent ridge of a GPR.

Gains are in the paper's state (phi_turb[k], phi_turb[k-1], phi_vib[k], phi_vib[k-1]); the mirror's two states are known
without error and have none. Poles are those of A - K C of the disturbance model, for the multi-rate filters those of one cycle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wfsobs.observers.kalman.multirate import MultiRate, multirate_filter, multirate_noise, optimal_filter, optimal_model
from wfsobs.observers.kalman.single import steady_filter
from wfsobs.prior import Model, Prior
from wfsobs.priors_from.scenario import model_of
from wfsobs.priors_from.turbulence import lgs_error_of
from wfsobs.scenario import Scenario
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.riccati import steady_state
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
    dt, ratio = scenario.dt, scenario.sensors.exposure_ratio
    model, own = model_of(scenario, mode), scenario.multirate

    def both() -> Prior:
        return Prior((model,), (lgs_error_of(scenario, mode),))

    filters = {
        "kf-lgs": _facts(dt, dt, lambda: _kalman(model, model.lgs_noise, "LGS")),
        "kf-ngs": _facts(ratio * dt, ratio * dt, lambda: _kalman(model.at(ratio * dt), model.ngs_noise, "NGS")),
        "multirate": _facts(dt, ratio * dt, lambda: _multirate(model, own, ratio)),
        "multirate-optimal": _facts(dt, ratio * dt, lambda: _optimal(both(), own, ratio)),
    }
    gprs = {
        name: GprFacts((g.noise_std * g.length_scale / g.signal_std) ** 2, g.depth * dt, (g.training_size + g.depth - 1) * dt)
        for name, g in (("gpr-offline", scenario.gpr_offline), ("gpr-online", scenario.gpr_online))
    }
    sensors = {
        kind.upper(): SensorFacts(float(noise_rms(scenario, kind)[mode]), float(aliasing_rms(scenario, kind)[mode]))
        for kind in ("lgs", "ngs")
    }
    matrices = paper_matrices(model.turbulence, model.vibration)
    return Description(scenario.modes[mode].name, ratio, model.turbulence, model.vibration, *matrices, filters, gprs, sensors)


Gains = dict[str, Array]


def _facts(step: float, period: float, make: Callable[[], tuple[Gains, Array]]) -> FilterFacts:
    try:
        gains, transition = make()
    except ValueError as error:
        return FilterFacts(step, period, {}, np.empty(0), str(error))
    poles = np.linalg.eigvals(transition)
    return FilterFacts(step, period, gains, poles[np.argsort(-np.abs(poles), kind="stable")])


def _kalman(prior: Model, noise: float, sensor: str) -> tuple[Gains, Array]:
    """Return gain and A - K C of a single-rate filter."""
    model = prior.disturbance()
    kalman, steady = steady_filter(model, noise)
    return {sensor: model.pairs @ steady.L[:, 0]}, kalman.cycle_matrix()


def _multirate(prior: Model, settings: MultiRate, ratio: int) -> tuple[Gains, Array]:
    """Return the paper's two gains (eq. 11), and the product of the A - K C of one cycle. Raises where that is unstable."""
    model = prior.disturbance()
    lgs, ngs = multirate_noise(settings, prior)
    cycle = multirate_filter(model, ratio, lgs, ngs).cycle
    alone = steady_state(model.A, model.C, model.Q, np.array(lgs**2)).L
    both = steady_state(model.A, np.vstack([model.C, model.C]), model.Q, np.diag([lgs**2, ngs**2])).L
    gains = {"LGS alone": alone[:, 0], "LGS with NGS": both[:, 0], "NGS": both[:, 1]}
    return {name: model.pairs @ gain for name, gain in gains.items()}, cycle.cycle_matrix()


def _optimal(prior: Prior, settings: MultiRate, ratio: int) -> tuple[Gains, Array]:
    """Return the gains of the first step and of the step with the frame, and the product of the A - K C of one cycle."""
    model = prior.model[0].disturbance()
    made, states = optimal_filter(*optimal_model(settings, prior, 0, ratio)[:2])
    n = len(model.A)
    gains = {"LGS with NGS": states[-1].L[:n, 0], "NGS": states[-1].L[:n, 1]}
    if len(states) > 1:
        gains = {"LGS, step 1": states[0].L[:n, 0], **gains}
    return {name: model.pairs @ gain for name, gain in gains.items()}, made.cycle.cycle_matrix()
