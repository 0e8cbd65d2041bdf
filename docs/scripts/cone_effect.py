"""Tip-tilt that a laser guide star gets wrong through the cone effect, by integration over the von Karman spectrum.

One layer at height h holds all the turbulence. A star at infinity sees it through a disc of diameter D, a guide star at
height H through one of D' = D (1 - h / H). The Noll tip coefficients of the two differ by the variance

    integral W(k) |Z_D(k) - Z_D'(k)|^2 d^2k,    Z_D(k) = 4 J2(pi k D) / (pi k D) cos(angle),
    W(k) = 0.0229 r0^-5/3 (k^2 + 1 / L0^2)^-11/6 [rad^2 m^2],

where cos^2 averages to 1/2 over the angle. Tilt is the same with the sine.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import quad
from scipy.special import jv

DIAMETER = 8.0  # [m]
R0, L0 = 0.157, 25.0  # [m], r0 at the wavelength
WAVELENGTH_NM = 500.0
GUIDE_STAR_KM = 90.0


def tip(k: float, diameter: float) -> float:
    """Z_D(k) without the angle, at the spatial frequency k [1/m]."""
    x = np.pi * k * diameter
    return 4.0 * jv(2, x) / x


def integral_nm2(weight: Callable[[float], float]) -> float:
    """Integral of W(k) weight(k) cos^2(angle) over the plane [nm^2]."""

    def integrand(log_k: float) -> float:
        k = np.exp(log_k)
        density = 0.0229 * R0 ** (-5.0 / 3.0) * (k**2 + L0**-2) ** (-11.0 / 6.0)
        return density * weight(k) * np.pi * k**2  # 2 pi k dk / 2, dk = k dlog(k)

    rad2 = quad(integrand, np.log(1e-5), np.log(1e2), limit=2000, epsrel=1e-9)[0]
    return rad2 * (WAVELENGTH_NM / (2.0 * np.pi)) ** 2


def cone_error(layer_km: float) -> tuple[float, float, float]:
    """(rms of NGS - LGS [nm], its regression on the NGS tip, rms of what that leaves [nm])."""
    cone = DIAMETER * (1.0 - layer_km / GUIDE_STAR_KM)
    full = integral_nm2(lambda k: tip(k, DIAMETER) ** 2)
    error = integral_nm2(lambda k: (tip(k, DIAMETER) - tip(k, cone)) ** 2)
    common = integral_nm2(lambda k: tip(k, DIAMETER) * (tip(k, DIAMETER) - tip(k, cone)))
    return np.sqrt(error), common / full, np.sqrt(error - common**2 / full)


if __name__ == "__main__":
    print(f"tip, full aperture: {np.sqrt(integral_nm2(lambda k: tip(k, DIAMETER) ** 2)):.1f} nm rms per axis")
    for height in (4.0, 8.0, 10.0, 12.0):
        rms, share, rest = cone_error(height)
        print(
            f"layer at {height:4.1f} km: NGS - LGS {rms:.1f} nm rms per axis = "
            f"{share:.3f} times the NGS tip, and {rest:.1f} nm besides"
        )
