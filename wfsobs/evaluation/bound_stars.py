"""Bound of every star apart: the minimum error of any causal linear observer of each LGS by itself and of the NGS.

It is as `bound_both`, for observers that are given more than the mean of the LGS. Where all stars see the same turbulence, but
for independent errors, their mean tells all that they tell and the two bounds are one (`stars_differ`). Every star gives the mode
that is estimated and no other.
"""

from __future__ import annotations

from wfsobs.evaluation.bound_both import PeriodicError, ngs_frames, target_errors
from wfsobs.observers.base import TURBULENCE
from wfsobs.scenario import Scenario
from wfsobs.signal.sensor_array import FastSensors, variance_from_sensors
from wfsobs.signal.slow_sensor import SlowTarget
from wfsobs.signal.wiener import Complex, advance_spectrum
from wfsobs.simulation.star_spectra import StarSpectra, star_spectra


def least_errors_of_stars(spectra: StarSpectra, ahead: int = 0) -> dict[str, PeriodicError]:
    """Compute the minimum error of phi[k + ahead] from all LGS, each apart, and all NGS frames up to step k.

    Parameters
    ----------
    spectra : StarSpectra
        Spectra of one mode.
    ahead : int
        Steps of prediction.

    Returns
    -------
    dict of str to PeriodicError
        Target -> error; TOTAL is that of both together.
    """
    known = spectra.mean.without_lines
    ngs = known.ngs
    frames, exposure = ngs_frames(known)
    others = FastSensors(
        spectra.n_differences, spectra.between, spectra.with_z, lambda i: advance_spectrum(spectra.with_ngs(i) * exposure, 1)
    )
    wanted = [
        SlowTarget(*known.estimate(name, ahead=ahead)[:2], advance_spectrum(ngs.cross[name] * exposure.conj(), ahead))
        for name in known.parts
    ]

    def of_stars(i: int) -> Complex:
        return advance_spectrum(spectra.with_axis(i), 1 + ahead)

    targets = [(one, of_stars if name == TURBULENCE else None) for name, one in zip(known.parts, wanted, strict=True)]
    return target_errors(known, ahead, variance_from_sensors(targets, known.whitener, others, frames))


def bound_rms_of_stars(scenario: Scenario, mode: int, ahead: int = 0) -> dict[str, float]:
    """Return target -> rms [um] of the minimum error, as `least_errors_of_stars`, of one mode of a scenario."""
    return {name: error.rms for name, error in least_errors_of_stars(star_spectra(scenario, mode), ahead).items()}
