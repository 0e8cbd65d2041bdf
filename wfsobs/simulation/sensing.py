"""Open-loop measurements: the disturbance seen by the wavefront sensors with the mirror at rest.

Several laser guide stars are combined to one measurement. The minimum-variance weights are those of the best linear estimate of
the disturbance on the axis from all LGS measurements of one step,

    W = C_ty C_yy^-1,    C_ty = E phi_dist y',    C_yy = E y y',

with the covariances of the model: turbulence in each beam, vibration, which is common to all, and noise. They account for
the angle between the stars and for their cones, not for time. They apply to pseudo-open-loop measurements, so that a loop
sees its own commands in full.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from wfsobs.progress import QUIET, Watch
from wfsobs.record import delay_signal, frame_mean
from wfsobs.scenario import Scenario
from wfsobs.signal.autoregressive import Ar2, turbulence_corner
from wfsobs.simulation import layers as atmosphere
from wfsobs.simulation.disturbance import (
    Disturbance,
    interpolate_steps,
    laser_count,
    missing_frames,
    turbulence_clock,
    turbulence_process,
    turbulence_rms,
    turbulence_steps,
    vibration_variance,
)
from wfsobs.simulation.sensor_noise import noise_covariance, noise_rms, white_noise
from wfsobs.typing import Array

MEAN = "mean"
"""The combination without a model."""


def is_blind(scenario: Scenario, mode: int) -> bool:
    """Return whether the LGS see no turbulence in a mode: tip or tilt, where they cannot tell these."""
    return scenario.sensors.tip_tilt_indetermination and scenario.modes[mode].radial_order == 1


def stars_differ(scenario: Scenario, mode: int) -> bool:
    """Return whether the LGS see different turbulence in a mode, so that each tells something that their mean does not."""
    s = scenario.sensors
    is_flow = scenario.turbulence.source == "frozen-flow"
    return is_flow and s.lgs_count > 1 and s.lgs_radius > 0 and not is_blind(scenario, mode)


def low_frequency_process(scenario: Scenario, mode: int) -> Ar2:
    """Return the AR(2) process that stands for cone effect and uplink turbulence of one LGS in one mode; zero with frozen flow.

    It has the corner of the turbulence, since the missed part of the beam moves with the same wind. A higher
    order has the rms of tip in the ratio of their cone effects.
    """
    t = scenario.turbulence
    corner = turbulence_corner(t.wind_speed, scenario.telescope.diameter, scenario.modes[mode].radial_order)
    rms = 0.0
    if t.source != "frozen-flow":
        rms = scenario.sensors.lgs_low_frequency_rms * atmosphere.relative_cone_error(scenario, mode)
    return Ar2(corner, t.damping, rms, scenario.dt)


def lgs_weights(scenario: Scenario, stars: int | None = None) -> Array:
    """Return the weights of the guide-star combination.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    stars : int, optional
        Number of stars in use, the first ones; by default all.

    Returns
    -------
    Array
        Weight of mode j of star i in mode k, (n_modes, n_lgs, n_modes).
    """
    stars, modes = stars or scenario.sensors.lgs_count, len(scenario.modes)
    if scenario.sensors.lgs_combination == MEAN:
        return np.tile(np.eye(modes)[:, None] / stars, (1, stars, 1))
    return _best_weights(scenario, stars)


@lru_cache(maxsize=8)  # a scenario is what its settings are, whenever it was asked
def _best_weights(scenario: Scenario, stars: int) -> Array:
    """Return the minimum-variance weights of the first `stars` stars."""
    modes = len(scenario.modes)
    seen, noise = lgs_turbulence_covariance(scenario), noise_covariance(scenario, "lgs")
    for mode in range(modes):
        seen[:, mode, :, mode] += vibration_variance(scenario, mode)
    for star in range(1, stars + 1):
        seen[star, :, star] += noise
    n = stars * modes
    last = 1 + stars
    measured = seen[1:last, :, 1:last].reshape(n, n)
    found = seen[0, :, 1:last].reshape(modes, n) @ np.linalg.pinv(measured, rcond=1e-12, hermitian=True)
    found.flags.writeable = False
    return found.reshape(modes, stars, modes)


def lgs_turbulence_covariance(scenario: Scenario) -> Array:
    """Return the covariance [um^2] of the turbulence on the axis and as measured by each LGS, noise excluded.

    (1 + n_lgs, n_modes, 1 + n_lgs, n_modes); the errors of the stars are included.
    """
    stars, modes = 1 + scenario.sensors.lgs_count, len(scenario.modes)
    if scenario.turbulence.source == "frozen-flow":
        out = atmosphere.star_covariance(scenario).copy()
    else:
        own = np.diag([turbulence_rms(scenario, mode) ** 2 for mode in range(modes)])
        out = np.tile(own[None, :, None, :], (stars, 1, stars, 1))
    blind = [mode for mode in range(modes) if is_blind(scenario, mode)]
    out[1:, blind] = 0.0
    out[:, :, 1:, blind] = 0.0
    for mode in range(modes):
        out[range(1, stars), mode, range(1, stars), mode] += low_frequency_process(scenario, mode).rms ** 2
    return out


def lgs_error_variance(scenario: Scenario, mode: int, stars: int | None = None) -> float:
    """Return the variance [um^2] of the combined LGS turbulence minus that on the axis, without noise.

    stars : as in `lgs_weights`
    """
    combined = np.concatenate([np.zeros((1, len(scenario.modes))), lgs_weights(scenario, stars)[mode]])
    combined[0, mode] = -1.0
    n = len(combined)
    return float(np.einsum("ij,ijkl,kl->", combined, lgs_turbulence_covariance(scenario)[:n, :, :n], combined))


def lgs_error_process(scenario: Scenario, mode: int, dt: float) -> Ar2:
    """Return the slow error of the combined LGS in one mode: AR(2), with the corner of the turbulence."""
    if scenario.turbulence.source != "frozen-flow" and scenario.sensors.lgs_combination == MEAN:
        one = low_frequency_process(scenario, mode)
        return replace(one, rms=one.rms / np.sqrt(scenario.sensors.lgs_count), dt=dt)
    rms = float(np.sqrt(max(lgs_error_variance(scenario, mode), 0.0)))
    return replace(turbulence_process(scenario, mode, dt), rms=rms)


def lgs_noise_rms(scenario: Scenario, mode: int, stars: int | None = None) -> float:
    """Return the rms [um] of the white noise of the combined LGS in one mode; stars: as `lgs_weights`."""
    if scenario.sensors.lgs_combination == MEAN:
        return float(noise_rms(scenario, "lgs")[mode] / np.sqrt(stars or scenario.sensors.lgs_count))
    own = lgs_weights(scenario, stars)[mode]
    return float(np.sqrt(np.einsum("ij,jk,ik->", own, noise_covariance(scenario, "lgs"), own)))


@dataclass(frozen=True)
class OpenLoop:
    """Open-loop measurements [um].

    Attributes
    ----------
    lgs : Array
        Combined LGS, (n_steps, n_modes); NaN where a frame is missing.
    ngs : Array
        NGS, (n_steps, n_modes); NaN in steps without a frame or where it is missing.
    stars : Array or None
        Number of LGS at each step, (n_steps,); None for all at all steps.
    each : Array or None
        Every LGS by itself, (n_steps, n_lgs, n_modes); NaN where it is out or a frame is missing; None where all see the same.
    """

    lgs: Array
    ngs: Array
    stars: Array | None = None
    each: Array | None = None


def measure_open_loop(scenario: Scenario, disturbance: Disturbance, rng: np.random.Generator, watch: Watch = QUIET) -> OpenLoop:
    """Simulate the open-loop measurements of a disturbance.

    LGS at every step, NGS at every n-th, both of the wavefront up to the step before.

    LGS: the mean over the guide stars of phi_dist[k-1] + error (paper, eq. 3), or their minimum-variance combination, each
    guide star with noise and error of its own; with frozen flow, each measures its own beam. NGS at k = n, 2n, ...: the
    mean of phi_dist[k-1] ... phi_dist[k-n], plus noise. With tip-tilt indetermination the LGS see no turbulence in tip and tilt.
    Without a laser, and where a frame is missing, NaN.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    disturbance : Disturbance
        Turbulence and vibration.
    rng : numpy.random.Generator
        Source of the noise.
    watch : Watch
        Asked at every guide star whether to stop.

    Returns
    -------
    OpenLoop
        Measurements.

    Raises
    ------
    Cancelled
        `watch` asks to stop.
    """
    lgs_rng, ngs_rng, lost_rng = rng.spawn(3)
    n_steps, n_modes = disturbance.total.shape
    errors = _lgs_errors(scenario, n_steps, n_modes, lgs_rng, watch)
    seen = [_without_tip_tilt(scenario, x) for x in disturbance.lgs_turbulence or [disturbance.turbulence]]
    working = laser_count(scenario, n_steps)
    lgs = _combine_working(scenario, seen, disturbance.vibration, errors, working)
    n = scenario.sensors.exposure_ratio
    noise = white_noise(scenario, "ngs", n_steps, ngs_rng)
    frame = np.arange(n_steps)
    is_frame = (frame % n == 0) & (frame >= n)
    ngs_turbulence = disturbance.turbulence if disturbance.ngs_turbulence is None else disturbance.ngs_turbulence
    total = ngs_turbulence + disturbance.vibration
    ngs = np.where(is_frame[:, None], frame_mean(total, n) + noise, np.nan)
    lost = missing_frames(scenario, n_steps, lost_rng)
    lgs[lost["lgs"]], ngs[lost["ngs"]] = np.nan, np.nan
    is_whole = (working == scenario.sensors.lgs_count).all()
    each = _apart(seen, disturbance.vibration, errors, working) if len(seen) > 1 and scenario.sensors.lgs_radius > 0 else None
    if each is not None:
        each[lost["lgs"]] = np.nan
    return OpenLoop(lgs, ngs, None if is_whole else working, each)


def _apart(turbulence_per_star: Sequence[Array], vibration: Array, errors: Sequence[Array], working: Array) -> Array:
    """Return what every LGS measures, (n_steps, n_lgs, n_modes), NaN where it is out; the first ones work."""
    out = np.empty((len(vibration), len(errors), vibration.shape[1]))
    for star, (turbulence, error) in enumerate(zip(turbulence_per_star, errors, strict=True)):
        out[:, star] = delay_signal(turbulence + vibration, 1) + error
        out[working <= star, star] = np.nan
    return out


def measure_noise(scenario: Scenario, n_steps: int, rng: np.random.Generator) -> OpenLoop:
    """Return the white noise in the open-loop measurements that `measure_open_loop` simulates from the same generator.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    n_steps : int
        Number of steps.
    rng : numpy.random.Generator
        Source of the noise.

    Returns
    -------
    OpenLoop
        Noise of the combined LGS and of the NGS at every step, whether it has a frame or not.
    """
    lgs_rng, ngs_rng, _ = rng.spawn(3)
    stars = [white_noise(scenario, "lgs", n_steps, star.spawn(2)[0]) for star in lgs_rng.spawn(scenario.sensors.lgs_count)]
    nothing = np.zeros_like(stars[0])
    lgs = _combine_working(scenario, [nothing], nothing, stars, laser_count(scenario, n_steps))
    return OpenLoop(np.nan_to_num(lgs), white_noise(scenario, "ngs", n_steps, ngs_rng))


def _combine_working(
    scenario: Scenario, turbulence_per_star: Sequence[Array], vibration: Array, errors: Sequence[Array], working: Array
) -> Array:
    """Combine the LGS that work, the first ones, (n_steps, n_modes); NaN where none does."""
    out = np.full(vibration.shape, np.nan)
    for stars in np.unique(working[working > 0]):
        out[working == stars] = _combine(scenario, turbulence_per_star, vibration, errors[:stars])[working == stars]
    return out


def _combine(scenario: Scenario, turbulence_per_star: Sequence[Array], vibration: Array, errors: Sequence[Array]) -> Array:
    """Combine the LGS, as many as there are errors, (n_steps, n_modes)."""
    stars = len(errors)
    if scenario.sensors.lgs_combination == MEAN:
        turbulence = turbulence_per_star[0] if len(turbulence_per_star) == 1 else np.mean(turbulence_per_star[:stars], axis=0)
        return delay_signal(turbulence + vibration, 1) + np.mean(errors, axis=0)
    every = list(turbulence_per_star) * stars if len(turbulence_per_star) == 1 else turbulence_per_star[:stars]
    each = [delay_signal(x + vibration, 1) + error for x, error in zip(every, errors, strict=True)]
    return np.tensordot(np.stack(each, axis=1), lgs_weights(scenario, stars), ([1, 2], [1, 2]))


def _without_tip_tilt(scenario: Scenario, turbulence: Array) -> Array:
    """Return the turbulence without tip and tilt where an LGS cannot see them."""
    return np.where([is_blind(scenario, mode) for mode in range(turbulence.shape[1])], 0.0, turbulence)


def _lgs_errors(scenario: Scenario, n_steps: int, n_modes: int, rng: np.random.Generator, watch: Watch) -> list[Array]:
    """Draw the errors of every guide star [um], each (n_steps, n_modes).

    White noise, plus the slow LGS error where turbulence has no layers; the wind carries it along with the turbulence.
    """
    out, at = [], turbulence_clock(scenario, n_steps)
    for star in rng.spawn(scenario.sensors.lgs_count):
        noise_rng, slow_rng = star.spawn(2)
        error = white_noise(scenario, "lgs", n_steps, noise_rng)
        for mode, stream in enumerate(slow_rng.spawn(n_modes)):
            watch.check()
            process = low_frequency_process(scenario, mode)
            if process.rms > 0:
                error[:, mode] += interpolate_steps(process.sample(turbulence_steps(at, n_steps), stream), at)
        out.append(error)
    return out
