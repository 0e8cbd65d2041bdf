"""Second-order autoregressive processes, phi[k+1] = a1 phi[k] + a2 phi[k-1] + v[k].

The paper's eq. 1 (turbulence) and eq. 2 (vibration) are the same process with other numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter, lfiltic

from wfsobs.typing import Array


def turbulence_corner(wind_speed: float, diameter: float, radial_order: int) -> float:
    """Return the corner frequency of the turbulence model, w0 = 0.6 pi (n + 1) V0 / D (paper, eq. 1d).

    Parameters
    ----------
    wind_speed : float
        V0 [m/s].
    diameter : float
        Aperture diameter D [m].
    radial_order : int
        Radial order n of the Zernike mode.

    Returns
    -------
    float
        Corner frequency [rad/s].

    Examples
    --------
    >>> round(turbulence_corner(15.0, 8.0, 1), 4)
    7.0686
    """
    return 0.6 * np.pi * (radial_order + 1) * wind_speed / diameter


@dataclass(frozen=True)
class Ar2:
    """AR(2) process of given corner frequency, damping and rms.

    Attributes
    ----------
    omega : float
        Corner or natural frequency [rad/s].
    damping : float
        Damping ratio xi, above 0 and at most 1.
    rms : float
        Standard deviation of phi [any unit].
    dt : float
        Time step [s].
    """

    omega: float
    damping: float
    rms: float
    dt: float

    def at(self, dt: float) -> Ar2:
        """Return the same process sampled every `dt` [s]."""
        return replace(self, dt=dt)

    @property
    def frequency(self) -> float:
        """Corner or natural frequency [Hz]."""
        return self.omega / (2.0 * np.pi)

    @property
    def a1(self) -> float:
        """First AR coefficient, 2 exp(-xi w T) cos(w sqrt(1 - xi^2) T) (paper, eq. 1b)."""
        angle = self.omega * np.sqrt(1.0 - self.damping**2) * self.dt
        return float(2.0 * np.exp(-self.damping * self.omega * self.dt) * np.cos(angle))

    @property
    def a2(self) -> float:
        """Second AR coefficient, -exp(-2 xi w T) (paper, eq. 1c)."""
        return float(-np.exp(-2.0 * self.damping * self.omega * self.dt))

    @property
    def transition(self) -> Array:
        """Transition matrix A of the state (phi[k], phi[k-1]), shape (2, 2) (paper, eq. 7c)."""
        return np.array([[self.a1, self.a2], [1.0, 0.0]])

    @property
    def drive_variance(self) -> float:
        """Variance of the drive v for which phi has the variance rms^2."""
        return self.rms**2 * self.unit_drive_variance

    @property
    def unit_drive_variance(self) -> float:
        """Variance of the drive v for which phi has the variance 1.

        (1 + a2) ((1 - a2)^2 - a1^2) / (1 - a2), with the small factors (1 - a1 - a2) and
        (1 + a2) written so that nothing cancels when the process is slow or lightly damped.
        """
        damped, angle = self.damping * self.omega * self.dt, self.omega * np.sqrt(1.0 - self.damping**2) * self.dt
        one_plus_a2 = -np.expm1(-2.0 * damped)
        # 1 -+ a1 - a2 = |1 -+ exp(-damped + i angle)|^2
        at_zero = np.expm1(-damped) ** 2 + 4.0 * np.exp(-damped) * np.sin(angle / 2.0) ** 2
        at_nyquist = np.expm1(-damped) ** 2 + 4.0 * np.exp(-damped) * np.cos(angle / 2.0) ** 2
        return float(one_plus_a2 * at_zero * at_nyquist / (1.0 - self.a2))

    def autocovariance(self, n: int) -> Array:
        """Return E phi[k] phi[k-j] for j = 0 ... n - 1, shape (n,)."""
        rho1 = self.a1 / (1.0 - self.a2)
        state = lfiltic([1.0], [1.0, -self.a1, -self.a2], [rho1, 1.0])
        tail, _ = lfilter([1.0], [1.0, -self.a1, -self.a2], np.zeros(max(n - 2, 0)), zi=state)
        return self.rms**2 * np.concatenate([[1.0, rho1], tail])[:n]

    def psd(self, frequency: Array) -> Array:
        """Return the one-sided power spectral density [unit^2/Hz] at `frequency` [Hz]."""
        turn = 2j * np.pi * np.asarray(frequency) * self.dt
        pole = complex(-self.damping * self.omega, self.omega * np.sqrt(1.0 - self.damping**2)) * self.dt
        # |1 - a1 q - a2 q^2| with q = exp(-turn), as the product of the distances to both poles
        distance = np.abs(np.expm1(pole - turn) * np.expm1(pole.conjugate() - turn))
        return 2.0 * self.dt * self.drive_variance / distance**2

    def extrapolate(self, last: Array, n: int) -> Array:
        """Return the expected next `n` steps after the `last` two, shape (n,).

        With the two in reverse order, these are the expected steps before them.
        """
        denominator = [1.0, -self.a1, -self.a2]
        return lfilter([1.0], denominator, np.zeros(n), zi=lfiltic([1.0], denominator, [last[1], last[0]]))[0]

    def sample(self, n: int, rng: np.random.Generator) -> Array:
        """Draw `n` steps of the process, stationary from the first, shape (n,)."""
        start = rng.standard_normal(2)
        rho1 = self.a1 / (1.0 - self.a2)
        before = self.rms * start[0]  # phi[-2], and phi[-1] given it
        last = rho1 * before + self.rms * np.sqrt(max(1.0 - rho1**2, 0.0)) * start[1]
        drive = np.sqrt(self.drive_variance) * rng.standard_normal(n)
        denominator = [1.0, -self.a1, -self.a2]
        out, _ = lfilter([1.0], denominator, drive, zi=lfiltic([1.0], denominator, [last, before]))
        return out
