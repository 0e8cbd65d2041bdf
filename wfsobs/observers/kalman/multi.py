"""The Kalman filter that knows every peak of the scenario, which the paper expects to help (its conclusion).

The filter is that of `kalman`, its model one AR(2) per line of the vibration and, as an option, turbulence of third order.
"""

from __future__ import annotations

from dataclasses import replace
from math import sqrt

import numpy as np

from wfsobs.observers.kalman.single import by_target, measurement_noise, modelled_processes, steady_filter
from wfsobs.prior.model import Line, Prior
from wfsobs.progress import Watch
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3, fitted_ar3
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.simulation.disturbance import vibration_lines
from wfsobs.simulation.true_spectra import seen_turbulence
from wfsobs.simulation.turbulence import processes, turbulence_rms
from wfsobs.typing import Array


def prior(scenario: Scenario, mode: int, dt: float) -> Prior:
    """Noise, turbulence and all the lines of one mode. Raises ValueError where the vibration names no lines."""
    if scenario.vibration.source == "psd":
        raise ValueError("vibration.source = psd is a table, not lines that a model could have")
    return Prior(measurement_noise(scenario, mode)[0], dt, _turbulence(scenario, mode, dt),
                 tuple(Line(*line) for line in vibration_lines(scenario, mode)))


def multi_model(scenario: Scenario, mode: int, dt: float) -> DisturbanceModel:
    """The state-space model of that. Raises ValueError where the vibration names no lines."""
    return prior(scenario, mode, dt).model(scenario.multipeak.line_width)


def _turbulence(scenario: Scenario, mode: int, dt: float) -> tuple[Ar2 | Ar3, ...]:
    """A scenario's own processes, in the strength that the model has; else one process."""
    found = processes(scenario, mode, dt) if scenario.turbulence.source == "processes" else []
    if not found:
        return (modelled_turbulence(scenario, mode, dt),)
    if scenario.kalman.process_noise == "matched":
        return tuple(found)
    factor = modelled_processes(scenario, mode, dt)[0].rms / turbulence_rms(scenario, mode)
    return tuple(replace(p, rms=factor * p.rms) for p in found)


def modelled_turbulence(scenario: Scenario, mode: int, dt: float) -> Ar2 | Ar3:
    """The turbulence of the model: that of `kalman`, or of third order and nearest to the true spectrum that the LGS see."""
    process, _ = modelled_processes(scenario, mode, dt)
    if scenario.multipeak.turbulence_order == 2 or process.rms == 0:
        return process
    noise, _ = measurement_noise(scenario, mode)
    start = Ar3(process.omega, process.damping, 5.0 * process.omega, process.rms, dt)
    return fitted_ar3(seen_turbulence(scenario, mode), noise**2, start)


def kf_multi(record: Record, scenario: Scenario, watch: Watch) -> dict[str, Array]:
    """The filter on the LGS measurement, at every fast step."""
    z = record.z
    columns = []
    for mode in range(record.n_modes):
        watch.step(mode / record.n_modes)
        told = prior(scenario, mode, record.dt)
        kalman, _ = steady_filter(told.model(scenario.multipeak.line_width), told.noise)
        columns.append(kalman.run(z[:, None, mode, None])[:, :, 0])
    return by_target(columns)


def predicted_rms(scenario: Scenario, mode: int) -> float:
    """What the filter believes its error of the next phi_dist to be, rms [um]."""
    model = multi_model(scenario, mode, scenario.dt)
    row = np.sum(list(model.outputs.values()), axis=0)
    _, steady = steady_filter(model, measurement_noise(scenario, mode)[0])
    return sqrt(float(row @ steady.P @ row))
