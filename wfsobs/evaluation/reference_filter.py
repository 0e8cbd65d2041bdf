"""The Kalman filter of the right model: what a filter of the same measurements can do at best with the lines it is given.

Its turbulence has the true spectrum, of third order where that is no autoregressive process, its lines and its noise are those
of the scenario, and the sensors see the turbulence on the axis.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from wfsobs.evaluation.known_lines import is_near
from wfsobs.observers.base import TARGETS
from wfsobs.observers.kalman.multirate_optimal import optimal_cycle, optimal_filter
from wfsobs.observers.kalman.single import MIN_NOISE, steady_filter
from wfsobs.prior import Line, Lines
from wfsobs.priors_from.turbulence import modelled_turbulence
from wfsobs.priors_from.vibration import vibration_continuum
from wfsobs.scenario import Scenario
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.simulation.disturbance import vibration_lines
from wfsobs.simulation.guide_stars import lgs_noise_rms
from wfsobs.simulation.sensing import OpenLoop
from wfsobs.simulation.sensor_noise import noise_rms
from wfsobs.simulation.turbulence import processes, third_order_process, turbulence_process
from wfsobs.typing import Array


def follow_signal(
    scenario: Scenario, mode: int, given_lines: Sequence[float], sensors: Sequence[str], open_loop: OpenLoop, ratio: int
) -> dict[str, Array]:
    """Run the filter on the noiseless measurements of one mode.

    Parameters
    ----------
    scenario : Scenario
        Settings of the simulation, without events.
    mode : int
        Index of the mode.
    given_lines : sequence of float
        Lines [Hz] in the model.
    sensors : sequence of str
        Sensors in use, of "lgs" and "ngs".
    open_loop : OpenLoop
        What the sensors measure of turbulence and lines; steps without a frame count as zero.
    ratio : int
        Steps per NGS frame.

    Returns
    -------
    dict of str to Array
        Target -> estimate, (n_steps,) [um].
    """
    model, noise = right_model(scenario, mode, given_lines), max(lgs_noise_rms(scenario, mode), MIN_NOISE)
    if model is None:
        return {target: np.zeros(len(open_loop.lgs)) for target in TARGETS}
    if "ngs" not in sensors:
        out = steady_filter(model, noise)[0].run(open_loop.lgs[:, None, mode, None])[:, :, 0]
    else:
        cycle = optimal_cycle(model, ratio, noise, max(noise_rms(scenario, "ngs")[mode], MIN_NOISE))
        used = np.array([[float("lgs" in sensors)], [1.0]])
        rows = model.output_rows(TARGETS)
        rows = np.hstack([rows, np.zeros((len(rows), 1))])
        kalman, _ = optimal_filter([(A, used * C, Q, R) for A, C, Q, R in cycle], rows)
        out = kalman.run(np.column_stack([open_loop.lgs[:, mode], open_loop.ngs[:, mode]]))
    return {target: out[:, i] for i, target in enumerate(TARGETS)}


def right_model(scenario: Scenario, mode: int, given_lines: Sequence[float]) -> DisturbanceModel | None:
    """Return the state-space model of the true turbulence and of the lines [Hz] that are given, None where there is neither.

    Who is given all lines is given what is no line as well.
    """
    lines = [Line(*line) for line in vibration_lines(scenario, mode)]
    near = is_near(np.array([line.frequency for line in lines]), given_lines)
    known = tuple(line for line, is_given in zip(lines, near, strict=True) if is_given)
    turbulence = true_turbulence(scenario, mode)
    if not (known or turbulence):
        return None
    continuum = vibration_continuum(scenario, mode) if len(known) == len(lines) else ()
    return Lines(0.0, scenario.dt, turbulence, known, continuum).disturbance(scenario.multipeak.line_width)


def true_turbulence(scenario: Scenario, mode: int) -> tuple[Ar2 | Ar3, ...]:
    """Return processes that have the spectrum of the turbulence, or are nearest to it."""
    source = scenario.turbulence.source
    if source == "none":
        return ()
    if source == "processes":
        return tuple(processes(scenario, mode, scenario.dt))
    if source == "ar2":
        return (turbulence_process(scenario, mode, scenario.dt),)
    if source == "ar3":
        return (third_order_process(scenario, mode, scenario.dt),)
    matched = {"multipeak.turbulence_order": 3, "kalman.process_noise": "matched", "kalman.measurement_noise": "matched"}
    return (modelled_turbulence(scenario.replace(matched), mode, scenario.dt),)
