"""What the wavefront sensors see of the disturbance, the mirror at rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wfsobs.ar2 import Ar2, turbulence_corner
from wfsobs.arrays import Array
from wfsobs.disturbance import Disturbance
from wfsobs.record import delayed, frame_mean
from wfsobs.scenario import Scenario
from wfsobs.watch import QUIET, Watch


@dataclass(frozen=True)
class OpenLoop:
    """Open-loop measurements [um]: lgs (n_steps, n_modes), the plain mean over the LGS, and ngs, NaN
    in steps without a frame."""

    lgs: Array
    ngs: Array


def measure(
    scenario: Scenario, disturbance: Disturbance, rng: np.random.Generator, watch: Watch = QUIET
) -> OpenLoop:
    """LGS at every step, NGS at every n-th, both of the wavefront up to the step before.

    LGS: the mean over the guide stars of phi_dist[k-1] + low-frequency error + noise (paper, eq. 3),
    each guide star with noise and error of its own. NGS at k = n, 2n, ...: the mean of phi_dist[k-1]
    ... phi_dist[k-n], plus noise. With tip-tilt indetermination the LGS see no turbulence.
    """
    lgs_rng, ngs_rng = rng.spawn(2)
    n_steps, n_modes = disturbance.total.shape
    seen = disturbance.vibration if scenario.sensors.tip_tilt_indetermination else disturbance.total
    errors = [_lgs_error(scenario, n_steps, n_modes, stream, watch) for stream in lgs_rng.spawn(scenario.sensors.lgs_count)]
    lgs = delayed(seen, 1) + np.mean(errors, axis=0)

    n = scenario.sensors.exposure_ratio
    noise = scenario.sensors.ngs_noise * ngs_rng.standard_normal((n_steps, n_modes))
    frame = np.arange(n_steps)
    is_frame = (frame % n == 0) & (frame >= n)
    ngs = np.where(is_frame[:, None], frame_mean(disturbance.total, n) + noise, np.nan)
    return OpenLoop(lgs, ngs)


def _lgs_error(scenario: Scenario, n_steps: int, n_modes: int, rng: np.random.Generator, watch: Watch) -> Array:
    """Error of one guide star [um], (n_steps, n_modes): white noise plus a slow AR(2) with the corner
    of the turbulence, since the part of the beam it misses moves with the same wind."""
    noise_rng, slow_rng = rng.spawn(2)
    out = scenario.sensors.lgs_noise * noise_rng.standard_normal((n_steps, n_modes))
    for mode, stream in enumerate(slow_rng.spawn(n_modes)):
        watch.check()
        process = low_frequency_process(scenario, mode)
        out[:, mode] += process.sample(n_steps, stream)
    return out


def low_frequency_process(scenario: Scenario, mode: int) -> Ar2:
    """The AR(2) that stands for cone effect and uplink turbulence of one LGS in one mode."""
    t = scenario.turbulence
    corner = turbulence_corner(t.wind_speed, scenario.telescope.diameter, scenario.modes[mode].radial_order)
    return Ar2(corner, t.damping, scenario.sensors.lgs_low_frequency_rms, scenario.dt)
