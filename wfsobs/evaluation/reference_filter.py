"""The Kalman filter of the right model: what a filter of the same measurements can do at best with the lines it is given.

Its turbulence has the true spectrum, of third order where that is no autoregressive process, its lines and its noise are those
of the scenario. Both sensors together tell the slow error of the LGS from the turbulence, so that it is in the model of their
filter, as is the turbulence that the LGS alone see; the LGS by themselves cannot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from wfsobs.evaluation.known_lines import is_near
from wfsobs.observers.base import TARGETS
from wfsobs.observers.kalman.multirate import beam_model, estimated_cycle, optimal_filter
from wfsobs.observers.kalman.single import MIN_NOISE, steady_filter
from wfsobs.prior import Beams, Line, Lines
from wfsobs.priors_from.turbulence import beams_of, modelled_turbulence
from wfsobs.priors_from.vibration import vibration_continuum
from wfsobs.scenario import Scenario
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
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
    vibration, noise = right_vibration(scenario, mode, given_lines), max(lgs_noise_rms(scenario, mode), MIN_NOISE)
    both = set(sensors) == {"lgs", "ngs"}
    beams = true_beams(scenario, mode) if both else Beams(true_turbulence(scenario, mode))
    if not (vibration or beams.common or beams.target):
        return {target: np.zeros(len(open_loop.lgs)) for target in TARGETS}
    model = beam_model(beams, vibration)
    if "ngs" not in sensors:
        out = steady_filter(model, noise)[0].run(open_loop.lgs[:, None, mode, None])[:, :, 0]
    else:
        ngs_noise = max(noise_rms(scenario, "ngs")[mode], MIN_NOISE)
        cycle = estimated_cycle(model, ratio, noise, ngs_noise, beams.lgs)
        used = np.array([[float(both)], [1.0]])
        kalman, _ = optimal_filter([(A, used * C, Q, R) for A, C, Q, R in cycle.steps], cycle.rows)
        out = kalman.run(np.column_stack([open_loop.lgs[:, mode], open_loop.ngs[:, mode]]))
    return {target: out[:, i] for i, target in enumerate(TARGETS)}


def right_vibration(scenario: Scenario, mode: int, given_lines: Sequence[float]) -> list[Ar2]:
    """Return the processes of the lines [Hz] that are given; given all lines, of what is no line as well."""
    lines = [Line(*line) for line in vibration_lines(scenario, mode)]
    near = is_near(np.array([line.frequency for line in lines]), given_lines)
    known = tuple(line for line, is_given in zip(lines, near, strict=True) if is_given)
    continuum = vibration_continuum(scenario, mode) if len(known) == len(lines) else ()
    return Lines(0.0, scenario.dt, lines=known, continuum=continuum).vibration(scenario.multipeak.line_width)


def true_beams(scenario: Scenario, mode: int) -> Beams:
    """Return processes that have the spectra of the turbulence as the target has it and as the LGS see it, or are nearest."""
    if scenario.turbulence.source in ("none", "processes", "ar2", "ar3"):
        return replace(beams_of(scenario, mode), common=true_turbulence(scenario, mode), target=())
    return beams_of(scenario.replace(_MATCHED), mode)


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
    return (modelled_turbulence(scenario.replace(_MATCHED), mode, scenario.dt),)


_MATCHED = {"multipeak.turbulence_order": 3, "kalman.process_noise": "matched", "kalman.measurement_noise": "matched"}
