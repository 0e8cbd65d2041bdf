"""Ready scenarios: one function each, every number with its source.

"The paper" is Jaufmann et al., "Simulation of Wavefront-based Disturbance Observers for Large
Telescopes"; the numbers it publishes are the defaults of the settings, each documented there.
"""

from __future__ import annotations

from collections.abc import Callable

from wfsobs.scenario import Scenario

# frequency [Hz], damping, rms of tip and of tilt [um]. Derived from the UT4 Nasmyth spectrum that MASTSEL ships
# (astro-tiptop/MASTSEL, data/windpsd_mavis.fits, MIT), the nearest public relative of the spectrum of the paper's
# Figure 3: each group of neighbouring bins is one peak, its frequency their centroid, its rms their power,
# its half width at half power half their spread.
MAVIS_PEAKS = (
    (5.96, 0.042, 0.0058, 0.0048),
    (8.00, 0.009, 0.0023, 0.0000),
    (10.06, 0.014, 0.0025, 0.0019),
    (12.01, 0.007, 0.0000, 0.0025),
    (14.00, 0.005, 0.0021, 0.0013),
    (15.95, 0.006, 0.0042, 0.0000),
    (17.25, 0.013, 0.0074, 0.0075),
    (19.00, 0.004, 0.0007, 0.0022),
    (21.63, 0.009, 0.0044, 0.0000),
    (23.87, 0.011, 0.0036, 0.0074),
    (25.25, 0.009, 0.0042, 0.0017),
    (30.00, 0.013, 0.0019, 0.0016),
    (34.93, 0.009, 0.0002, 0.0024),
    (45.50, 0.003, 0.0014, 0.0009),
    (47.44, 0.004, 0.0079, 0.0027),
)

# Lines of the ERIS spectrum, measured on UT4 (astro-tiptop/TIPTOP, tiptop/data/eris_vibrations_psd.fits, MIT),
# 8 to 100 Hz, where either axis exceeds 4 nm rms above the synthetic floor of 4e4/f^2 nm^2/Hz. All are as narrow as
# its 0.028 Hz resolution, so damping 0: rotating machinery, 24.2, 48.3, 72.5 and 96.7 Hz being 1:2:3:4.
ERIS_LINES = (
    (8.00, 0.0084, 0.0028),
    (8.47, 0.0096, 0.0143),
    (8.90, 0.0084, 0.0023),
    (9.32, 0.0043, 0.0085),
    (10.00, 0.0199, 0.0267),
    (10.38, 0.0000, 0.0076),
    (11.20, 0.0047, 0.0024),
    (13.33, 0.0059, 0.0029),
    (14.00, 0.0000, 0.0084),
    (16.00, 0.0121, 0.0092),
    (17.21, 0.0065, 0.0033),
    (17.57, 0.0000, 0.0055),
    (18.00, 0.0042, 0.0052),
    (23.77, 0.0042, 0.0000),
    (24.22, 0.0074, 0.0070),
    (25.82, 0.0107, 0.0000),
    (35.33, 0.0000, 0.0076),
    (45.21, 0.0000, 0.0085),
    (45.51, 0.0113, 0.0055),
    (48.06, 0.0000, 0.0050),
    (48.17, 0.0000, 0.0083),
    (48.33, 0.0041, 0.0243),
    (48.44, 0.0000, 0.0041),
    (49.30, 0.0000, 0.0089),
    (51.56, 0.0054, 0.0000),
    (51.66, 0.0042, 0.0038),
    (72.08, 0.0000, 0.0056),
    (72.55, 0.0000, 0.0115),
    (96.74, 0.0034, 0.0084),
)


def paper() -> Scenario:
    """The paper's system, with every number that it publishes.

    What it leaves open, and what is taken here:

    - vibration: the peaks of the MAVIS spectrum of UT4, 15.5 nm rms on tip (above);
    - turbulence 0.5 um rms per mode, the size of r0 = 0.157 m, L0 = 25 m on 8 m (0.529 um);
    - noise 20 nm per LGS and 10 nm per NGS frame, so that r_NGS < r_LGS as the paper asks;
    - LGS low-frequency error 49 nm per guide star, the cone effect of one layer at 8 km, guide star at 90 km; independent
      between guide stars, as those of an asterism that sees different air, so that the mean of two has 35 nm;
    - integrator gain 0.3, no leak;
    - Kalman model: measurement noise matched; vibration rms 0.06 um set by hand, four times the truth. It is fitted:
      matched, the filter's RMS error is 14.9e-3; with 0.06 it is the 16.6e-3 of the paper, and "overshoots the reference
      regularly" as the paper says of it. The reproduction page shows both.
    """
    s = Scenario()
    s.update({
        "vibration": {"peaks": [
            {"frequency": f, "damping": xi, "rms": [tip, tilt]} for f, xi, tip, tilt in MAVIS_PEAKS
        ]},
        "kalman": {"process_noise": "manual", "turbulence_rms": 0.5, "vibration_rms": 0.06},
    })
    return s


def ut4() -> Scenario:
    """The vibration lines measured at VLT UT4 with ERIS.

    All are pure lines; the Kalman filters are matched to the scenario, their one peak on the strongest line, 48.33 Hz.
    """
    s = Scenario()
    s.update({
        "vibration": {"cutoff": 100.0, "peaks": [
            {"frequency": f, "damping": 0.0, "rms": [tip, tilt]} for f, tip, tilt in ERIS_LINES
        ]},
        "kalman": {"frequency": 48.33, "damping": 0.001},
    })
    return s


PRESETS: dict[str, Callable[[], Scenario]] = {"paper": paper, "ut4": ut4}
