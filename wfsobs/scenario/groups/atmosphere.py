"""Settings of the aperture, of the turbulence above it and of the telescope's vibration."""

from __future__ import annotations

from typing import ClassVar

import param

from wfsobs.sensors.zernike import HIGHEST_ORDER
from wfsobs.settings.group import Group, UsedWhen, section
from wfsobs.settings.priors import PAPER_PEAK_HZ
from wfsobs.settings.values import Choice, Real, Reals, Whole


class Telescope(Group):
    """The aperture, its pointing, and the simulated modes."""

    diameter: Real = Real(8.0, (0.1, 100.0), "Aperture diameter D", "Diameter of the aperture [m] (paper, Table 1).")
    radial_order: Whole = Whole(
        1,
        (1, HIGHEST_ORDER),
        "Highest radial order",
        "Zernike modes up to this radial order, without piston: 1 is tip and tilt (paper), 2 to 6 are 5, 9, 14, 20 and 27 modes.",
        softbounds=(1, HIGHEST_ORDER),
    )
    zenith_angle: Real = Real(
        0.0,
        (0.0, 70.0),
        "Zenith angle",
        "Zenith angle of the line of sight [deg]. With frozen flow, the airmass 1 / cos strengthens the turbulence "
        "and lengthens the path to layers and guide stars.",
        softbounds=(0.0, 60.0),
        step=1.0,
    )


class PsdTable(Group):
    """A one-sided power spectral density given as a table."""

    frequency: Reals = Reals([], (0.0, 5000.0), (0, 100_000), "Frequencies", "Frequencies [Hz], increasing.")
    tip: Reals = Reals(
        [], (0.0, 1e6), (0, 100_000), "PSD of tip", "One-sided power spectral density of tip [um^2/Hz], one number per frequency."
    )
    tilt: Reals = Reals(
        [],
        (0.0, 1e6),
        (0, 100_000),
        "PSD of tilt",
        "One-sided power spectral density of tilt [um^2/Hz], one number per frequency.",
    )


class Layer(Group):
    """One layer of frozen flow."""

    height: Real = Real(
        8000.0, (0.0, 40_000.0), "Height h", "Height above the telescope [m].", softbounds=(0.0, 20_000.0), step=100.0
    )
    fraction: Real = Real(
        1.0,
        (0.0, 100.0),
        "Share of the turbulence",
        "Share of the turbulence, of r0^(-5/3); the shares of all layers are normalised to a sum of one.",
        softbounds=(0.0, 1.0),
        step=0.01,
    )
    wind_factor: Real = Real(
        1.0, (0.05, 20.0), "Wind over V₀", "Wind speed of the layer over turbulence.wind_speed.", softbounds=(0.2, 4.0), step=0.05
    )
    wind_direction: Real = Real(
        0.0,
        (-360.0, 360.0),
        "Wind direction",
        "Direction that the wind blows to, from the axis of tip to that of tilt [deg].",
        softbounds=(-180.0, 180.0),
        step=5.0,
    )


class Process(Group):
    """One coloured noise in the turbulence of some modes."""

    frequency: Real = Real(
        1.1, (1e-9, 1e6), "Corner", "Corner frequency of the AR(2) process, omega / 2 pi [Hz].", softbounds=(0.1, 10.0), step=0.1
    )
    damping: Real = Real(0.9, (1e-6, 1.0), "Damping ξ", "Damping ratio of the process.", softbounds=(0.1, 1.0), step=0.01)
    third_corner: Real = Real(
        0.0,
        (0.0, 1e6),
        "Third corner / first",
        "Corner beyond which the spectrum falls as f^-6 instead of f^-4, over the frequency; 0 is none.",
        softbounds=(0.0, 10.0),
        step=0.1,
    )
    rms: Reals = Reals(
        [0.5, 0.5],
        (0.0, 1e4),
        (1, 64),
        "Strength per mode, rms",
        "Standard deviation of the process [um], one number per mode: tip, tilt, ...; zero for modes beyond the list.",
    )


class Turbulence(Group):
    """Atmospheric turbulence."""

    used_when: ClassVar[UsedWhen] = {
        "third_corner": ("source", ("ar3",)),
        "rms": ("source", ("ar2", "ar3")),
        "r0": ("source", ("frozen-flow",)),
        "layers": ("source", ("frozen-flow",)),
        "processes": ("source", ("processes",)),
        "psd": ("source", ("psd",)),
    }

    source: Choice = Choice(
        ["ar2", "ar3", "processes", "frozen-flow", "psd", "none"],
        "Source",
        "Model of the turbulence. ar2: the AR(2) process of the paper, eq. 1; ar3: the same with a third corner; "
        "processes: a sum of such processes in every mode; frozen-flow: von Karman layers, with a beam of its own "
        "for every guide star; psd: inverse DFT of the PSD table; none: no turbulence.",
    )
    wind_speed: Real = Real(
        15.0,
        (0.1, 100.0),
        "Wind speed V₀",
        "Wind speed [m/s]; sets the corner w0 = 0.6 pi (n + 1) V0 / D (paper, eq. 1d and Table 1), and "
        "scales the wind of every layer of frozen flow.",
        softbounds=(1.0, 40.0),
        step=0.5,
    )
    damping: Real = Real(0.9, (0.01, 1.0), "Damping ξ", "Damping ratio of the AR(2) process (paper, Table 1).", step=0.01)
    third_corner: Real = Real(
        3.0,
        (1.0, 1000.0),
        "Third corner / w₀",
        "Corner beyond which the spectrum falls as f^-6 instead of f^-4, over the corner w0, for source ar3; not in the paper.",
        softbounds=(1.0, 10.0),
        step=0.1,
    )
    rms: Real = Real(
        0.5,
        (0.0, 100.0),
        "Strength, rms",
        "Standard deviation of tip and of tilt [um], for sources ar2 and ar3. Not given in the paper; r0 = 0.157 m "
        "and L0 = 25 m on 8 m give 0.529 um. Higher orders follow from the ratio that r0 and L0 give.",
        softbounds=(0.0, 2.0),
        step=0.01,
    )
    r0: Real = Real(
        0.157,
        (0.01, 5.0),
        "Fried parameter r₀",
        "Fried parameter at 500 nm at the zenith [m], for source frozen-flow. The seeing is 0.98 x 500 nm / r0: 0.64 arcsec.",
        softbounds=(0.05, 0.4),
        step=0.001,
    )
    outer_scale: Real = Real(
        25.0, (1.0, 1e6), "Outer scale L₀", "Outer scale of the von Karman spectrum [m].", softbounds=(5.0, 100.0), step=1.0
    )
    layers: param.List[list[Layer]] = param.List(
        [Layer()], item_type=Layer, bounds=(0, 40), label="Layers", doc="Layers of frozen flow, for source frozen-flow."
    )
    processes: param.List[list[Process]] = param.List(
        [Process()],
        item_type=Process,
        bounds=(0, 500),
        label="Processes",
        doc="Processes whose sum is the turbulence, for source processes.",
    )
    psd: PsdTable = section(PsdTable, "PSD table", "Spectrum of the turbulence as a table, for source psd.")


class Peak(Group):
    """One vibration peak: a damped resonance, or a line at damping 0."""

    frequency: Real = Real(
        PAPER_PEAK_HZ,
        (0.01, 50_000.0),
        "Frequency f",
        "Natural frequency [Hz]. The dominant one of the paper is 47.4969 Hz (Table 2).",
        softbounds=(5.0, 80.0),
        step=0.1,
    )
    damping: Real = Real(
        0.03,
        (0.0, 1.0),
        "Damping ξ",
        "Damping ratio; 0 is a line. The paper has 0.03 (Table 2).",
        softbounds=(0.0, 0.1),
        step=0.001,
    )
    rms: Reals = Reals(
        [0.01, 0.01],
        (0.0, 1e4),
        (1, 64),
        "Strength per mode, rms",
        "Standard deviation of the peak [um], one number per mode: tip, tilt, ...; zero for modes beyond the list.",
    )


class Vibration(Group):
    """Structural vibration of the telescope."""

    used_when: ClassVar[UsedWhen] = {
        "synthesis": ("source", ("peaks", "psd", "measured")),
        "spectrum": ("source", ("measured",)),
        "part": ("source", ("measured",)),
        "cutoff": ("source", ("peaks", "psd", "measured")),
        "peaks": ("source", ("peaks", "ar2")),
        "psd": ("source", ("psd",)),
    }

    source: Choice = Choice(
        ["peaks", "psd", "measured", "ar2", "none"],
        "Source",
        "Model of the vibration. peaks: inverse DFT of the peak list (paper, Algorithm 4); psd: of the PSD table; "
        "measured: of a measured spectrum; ar2: each peak as an AR(2) process (paper, eq. 2); none: no vibration.",
    )
    synthesis: Choice = Choice(
        ["gaussian", "random-phase"],
        "Synthesis",
        "Signal of an inverse DFT. gaussian: a section of a stationary Gaussian process, cut from a period many "
        "times as long; random-phase: fixed amplitudes and random phases, as long as the record and periodic with "
        "it (paper, Algorithm 4).",
    )
    spectrum: Choice = Choice(
        ["eris-ut4"],
        "Measured spectrum",
        "Measured spectrum, for source measured. eris-ut4: measured at VLT UT4 with ERIS (astro-tiptop/TIPTOP, MIT).",
    )
    part: Choice = Choice(
        ["lines", "all"],
        "Part of the spectrum",
        "Part of the measured spectrum, for source measured. lines: above its synthetic floor 4e4 / f^2 nm^2/Hz, "
        "from 7.5 Hz up; all: the whole spectrum.",
    )
    cutoff: Real = Real(
        80.0,
        (0.1, 50_000.0),
        "Cut-off f_c",
        "Cut-off frequency of an inverse DFT [Hz]; no vibration above it (paper, section 2.4).",
        softbounds=(10.0, 200.0),
    )
    peaks: param.List[list[Peak]] = param.List(
        [Peak()], item_type=Peak, bounds=(0, 2000), label="Peaks", doc="Peaks of the vibration spectrum."
    )
    psd: PsdTable = section(PsdTable, "PSD table", "Spectrum of the vibration as a table, for source psd.")
