"""The models inside the observers as numbers: coefficients, gains, poles, and what a GPR amounts to.

Gains are in the paper's state (phi_turb[k], phi_turb[k-1], phi_vib[k], phi_vib[k-1]); the mirror's two states are known
without error and have none. Poles are those of A - K C of the disturbance model, for the multi-rate filters those of one cycle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from wfsobs.observers.kalman.multirate import MultiRate, multirate_filter, multirate_noise
from wfsobs.observers.kalman.multirate_optimal import optimal_filter, optimal_model
from wfsobs.observers.kalman.single import steady_filter
from wfsobs.prior import Model, Prior
from wfsobs.priors_from.scenario import lgs_error_of, model_of
from wfsobs.scenario import Scenario
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.riccati import steady_state
from wfsobs.signal.statespace import paper_matrices
from wfsobs.simulation.sensor_noise import aliasing_rms, noise_rms
from wfsobs.typing import Array


@dataclass(frozen=True)
class FilterFacts:
    """A Kalman filter.

    step   : time between its estimates [s]; period: time that the poles belong to, one step or one cycle [s]
    gains  : what is measured -> filter gain L (4,), of LGS and NGS where both are
    poles  : of A - K C, or of one cycle, the largest first
    reason : why there is no such filter, in one line, or nothing
    """

    step: float
    period: float
    gains: dict[str, Array]
    poles: Array
    reason: str = ""

    @property
    def radius(self) -> float | None:
        """The largest modulus of a pole; below 1 the filter is stable."""
        return float(np.abs(self.poles).max()) if self.poles.size else None


@dataclass(frozen=True)
class GprFacts:
    """A Gaussian process regression: ridge = (sigma_n l / sigma_SE)^2 [um^2], the weight of the ridge regression that
    it all but is; window, training: length of a window, and from the first to the last of consecutive ones [s]."""

    ridge: float
    window: float
    training: float


@dataclass(frozen=True)
class SensorFacts:
    """What one LGS, or the NGS, gets wrong by itself, rms [um]: white noise of a frame, and aliasing, see `sensors`."""

    noise: float
    aliasing: float


@dataclass(frozen=True)
class Description:
    """The model of one mode. turbulence, vibration: the processes modelled, per fast step; A, B, C (paper, eq. 7)."""

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
    """The numbers of a scenario's observers for one mode; a filter that cannot be has its reason in place of numbers."""
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
    """Gain and A - K C of a single-rate filter."""
    model = prior.disturbance()
    kalman, steady = steady_filter(model, noise)
    return {sensor: model.pairs @ steady.L[:, 0]}, kalman.cycle_matrix()


def _multirate(prior: Model, settings: MultiRate, ratio: int) -> tuple[Gains, Array]:
    """The paper's two gains (eq. 11), and the product of the A - K C of one cycle. Raises where that is unstable."""
    model = prior.disturbance()
    lgs, ngs = multirate_noise(settings, prior)
    cycle = multirate_filter(model, ratio, lgs, ngs).cycle
    alone = steady_state(model.A, model.C, model.Q, np.array(lgs**2)).L
    both = steady_state(model.A, np.vstack([model.C, model.C]), model.Q, np.diag([lgs**2, ngs**2])).L
    gains = {"LGS alone": alone[:, 0], "LGS with NGS": both[:, 0], "NGS": both[:, 1]}
    return {name: model.pairs @ gain for name, gain in gains.items()}, cycle.cycle_matrix()


def _optimal(prior: Prior, settings: MultiRate, ratio: int) -> tuple[Gains, Array]:
    """Gains of the first step of a cycle and of the one with the frame, and the product of the A - K C of one cycle."""
    model = prior.model[0].disturbance()
    made, states = optimal_filter(*optimal_model(settings, prior, 0, ratio))
    n = len(model.A)
    gains = {"LGS with NGS": states[-1].L[:n, 0], "NGS": states[-1].L[:n, 1]}
    if len(states) > 1:
        gains = {"LGS, step 1": states[0].L[:n, 0], **gains}
    return {name: model.pairs @ gain for name, gain in gains.items()}, made.cycle.cycle_matrix()
