"""Tables of published vibration peaks and wind layers, for the presets."""

from __future__ import annotations

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

# height above the telescope [m], share, wind [m/s], blowing to [deg] (astro-tiptop/TIPTOP, tiptop/perfTest/MUSE_LTAO.ini, MIT)
MUSE_LAYERS = (
    (30.0, 0.59, 6.6, 0.0),
    (140.0, 0.02, 5.9, 0.0),
    (281.0, 0.04, 5.1, 0.0),
    (562.0, 0.06, 4.5, 0.0),
    (1125.0, 0.01, 5.1, 90.0),
    (2250.0, 0.05, 8.3, -90.0),
    (4500.0, 0.09, 16.3, -90.0),
    (7750.0, 0.04, 30.2, 90.0),
    (11000.0, 0.05, 34.3, 0.0),
    (14000.0, 0.05, 17.5, 0.0),
)

NIGHT_EVENTS: tuple[dict[str, str | float], ...] = (
    {"kind": "wind", "start": 15.0, "duration": 6.0, "wind_factor": 2.0},
    {"kind": "laser", "start": 30.0, "duration": 2.0, "lasers": 2},
    {"kind": "wind", "start": 36.0, "duration": 6.0, "wind_factor": 0.5},
    {"kind": "frames", "start": 48.0, "duration": 5.0, "sensor": "lgs", "share": 0.1},
    {"kind": "peak", "start": 60.0, "peak": 2, "frequency_shift": 3.0},
    {"kind": "frames", "start": 90.0, "duration": 5.0, "sensor": "ngs", "share": 0.5},
)
"""Two minutes of the preset night."""
