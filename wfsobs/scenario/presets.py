"""Presets: one function each, every number with its source.

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


def _system() -> Scenario:
    """Return the paper's system, with records made like those of the other presets."""
    s = paper()
    s.update({"vibration": {"synthesis": "gaussian"}})
    return s


def paper() -> Scenario:
    """The paper's system, as published.

    Records are made as the paper makes them, by an inverse DFT of their own length with random phases (`vibration.synthesis`);
    no other preset does. What it leaves open, and what is taken here:

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
    s.update(
        {
            "vibration": {
                "synthesis": "random-phase",
                "peaks": [{"frequency": f, "damping": xi, "rms": [tip, tilt]} for f, xi, tip, tilt in MAVIS_PEAKS],
            },
            "kalman": {"process_noise": "manual", "turbulence_rms": 0.5, "vibration_rms": 0.06},
        }
    )
    return s


def ut4() -> Scenario:
    """Frozen flow, and the vibration lines measured at VLT UT4 with ERIS.

    - turbulence: one von Karman layer at 8 km carried along at 15 m/s, r0 = 0.157 m, L0 = 25 m; guide stars on the axis, so
      that both LGS have the same cone effect (49 nm rms per axis) and their mean has all of it;
    - vibration: what stands above the synthetic floor of the spectrum, 36.9 nm rms on tip and 50.7 nm on tilt;
    - Kalman filters matched to the scenario, their one peak on the strongest line above 12 Hz, 48.31 Hz with 26.5 nm on tilt;
      the multi-peak one with turbulence of third order, and lines 0.02 Hz wide: the true ones are narrower, but what is sure of
      a line takes long to settle (docs/observers.md).
    """
    s = Scenario()
    s.update(
        {
            "turbulence": {"source": "frozen-flow"},
            "vibration": {"source": "measured", "spectrum": "eris-ut4", "part": "lines", "cutoff": 100.0},
            "kalman": {"frequency": 48.31, "damping": 0.001},
            "multipeak": {"turbulence_order": 3, "line_width": 0.02},
        }
    )
    return s


def ut4_floor() -> Scenario:
    """Frozen flow, and the whole ERIS spectrum of VLT UT4, synthetic floor included."""
    s = ut4()
    s.update({"vibration": {"part": "all"}})
    return s


def strong_turbulence() -> Scenario:
    """The paper's system in turbulence four times as strong, which ruins a plain GPR.

    At 2 um rms both GPR are worse than answering zero: raw windows hold hardly anything but turbulence. With
    `gpr_offline.inputs_filter` = high-pass the offline one comes back; the online one does not, since what the causal
    Butterworth bank gives it as targets has turbulence in it, too (docs/reproduction.md).
    """
    s = _system()
    s.update({"turbulence": {"rms": 2.0}, "kalman": {"process_noise": "matched"}})
    return s


def galacsi_nfm() -> Scenario:
    """MUSE's narrow field on UT4: four LGS at 7.5", ten layers of wind.

    Stars, rates and atmosphere of astro-tiptop/TIPTOP, tiptop/perfTest/MUSE_LTAO.ini (MIT): seeing 0.67", L0 = 27.44 m, 24 deg
    from the zenith, sodium at 90 km, 40 x 40 subapertures at 1 kHz on the LGS, an NGS at 200 Hz. Its 2 x 2 subapertures look
    through what the LGS have corrected; here nothing is corrected, they would see coma for tip, and the NGS has 40 x 40. A
    layer's wind is a multiple of `turbulence.wind_speed` = 10 m/s. Noise is the default, vibration that of `ut4`.
    """
    s = ut4()
    s.update(
        {
            "telescope": {"zenith_angle": 24.0},
            "turbulence": {
                "r0": 0.151,
                "outer_scale": 27.44,
                "wind_speed": 10.0,
                "layers": [
                    {"height": h, "fraction": share, "wind_factor": wind / 10.0, "wind_direction": to}
                    for h, share, wind, to in MUSE_LAYERS
                ],
            },
            "sensors": {"lgs_count": 4, "lgs_radius": 7.5},
        }
    )
    return s


def galacsi_wfm() -> Scenario:
    """MUSE's wide field on UT4: as galacsi-nfm, the four LGS at 64".

    The radius is that of Stroebele et al., "GALACSI system design and analysis", Proc. SPIE 8447 (2012); MUSE-PSFR (Fusco et al.,
    A&A 635, A208, 2020; musevlt/muse-psfr) takes 63".
    """
    s = galacsi_nfm()
    s.update({"sensors": {"lgs_radius": 64.0}})
    return s


def higher_orders() -> Scenario:
    """Frozen flow as in ut4, with the 14 modes up to radial order 4.

    The paper expects more of its multi-rate filter on orders above tip and tilt, where the LGS is no handicap.
    """
    s = ut4()
    s.update({"telescope": {"radial_order": 4}})
    return s


def peak_jump() -> Scenario:
    """A line at 47.5 Hz jumps by 3 Hz: filters of a fixed model lose it, adaptive ones do not.

    - vibration: a pure line of 30 nm on tip and 20 nm on tilt, ten times what two resonances have beside it; all else is the
      paper's;
    - the filters have the line in their models where it is before the jump;
    - one Butterworth band from 40 to 60 Hz, of equal phase at the old frequency and the new one: the online GPR learns from that
      band, and what jumps out of it is lost to it (docs/events.md).
    """
    s = _system()
    s.update(
        {
            "vibration": {
                "peaks": [
                    {"frequency": 17.25, "damping": 0.013, "rms": [0.003, 0.003]},
                    {"frequency": 23.87, "damping": 0.011, "rms": [0.002, 0.003]},
                    {"frequency": 47.5, "damping": 0.0, "rms": [0.03, 0.02]},
                ]
            },
            "kalman": {"frequency": 47.5, "damping": 0.003, "process_noise": "matched"},
            "butterworth": {"frequencies": [50.0], "bandwidth_offline": 20.0, "bandwidth_online": 20.0},
            "run": {"duration": 20.0},
            "events": [{"kind": "peak", "start": 8.0, "peak": 2, "frequency_shift": 3.0}],
        }
    )
    return s


def peak_drift() -> Scenario:
    """The line of peak-jump drifts by 3 Hz in 10 s instead."""
    s = peak_jump()
    s.update({"events": [{"kind": "peak", "start": 5.0, "duration": 10.0, "peak": 2, "frequency_shift": 3.0}]})
    return s


def wind_change() -> Scenario:
    """Frozen flow whose wind doubles within 2 s, from 15 to 30 m/s.

    As `ut4`; the filters' turbulence stays that of 15 m/s.
    """
    s = ut4()
    s.update({"run": {"duration": 20.0}, "events": [{"kind": "wind", "start": 9.0, "duration": 2.0, "wind_factor": 2.0}]})
    return s


def laser_dropout() -> Scenario:
    """The paper's system; one laser drops out for 4 s, later both for 1 s.

    With one LGS its noise and its slow error are no longer halved; without any there are NGS frames alone.
    """
    s = _system()
    s.update(
        {
            "kalman": {"process_noise": "matched"},
            "run": {"duration": 20.0},
            "events": [
                {"kind": "laser", "start": 6.0, "duration": 4.0, "lasers": 1},
                {"kind": "laser", "start": 15.0, "duration": 1.0, "lasers": 2},
            ],
        }
    )
    return s


def lost_frames() -> Scenario:
    """The paper's system; it loses half the LGS frames for 5 s, later half the NGS frames."""
    s = _system()
    s.update(
        {
            "kalman": {"process_noise": "matched"},
            "run": {"duration": 20.0},
            "events": [
                {"kind": "frames", "start": 5.0, "duration": 5.0, "sensor": "lgs", "share": 0.5},
                {"kind": "frames", "start": 13.0, "duration": 5.0, "sensor": "ngs", "share": 0.5},
            ],
        }
    )
    return s


def night() -> Scenario:
    """Two minutes of changes of wind, a line, lasers and frames, for a live loop.

    As peak-jump. In the first minute the wind doubles and falls back, both lasers are out for 2 s and a tenth of the LGS frames
    is lost for 5 s. In the second the line is at 50.5 Hz, and half of the NGS frames are lost for 5 s. So the two minutes differ
    in what is identified.
    """
    s = peak_jump()
    s.update({"run": {"duration": 120.0}, "events": list(NIGHT_EVENTS)})
    return s


PRESETS: dict[str, Callable[[], Scenario]] = {
    "paper": paper,
    "strong-turbulence": strong_turbulence,
    "ut4": ut4,
    "ut4-floor": ut4_floor,
    "galacsi-nfm": galacsi_nfm,
    "galacsi-wfm": galacsi_wfm,
    "higher-orders": higher_orders,
    "peak-jump": peak_jump,
    "peak-drift": peak_drift,
    "wind-change": wind_change,
    "laser-dropout": laser_dropout,
    "lost-frames": lost_frames,
    "night": night,
}
