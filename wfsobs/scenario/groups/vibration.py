"""Settings of the telescope's vibration."""

from __future__ import annotations

from types import MappingProxyType
from typing import ClassVar

import param

from wfsobs.scenario.groups.atmosphere import PsdTable
from wfsobs.settings.group import Group, UsedWhen, section
from wfsobs.settings.parameters import Real, Reals
from wfsobs.settings.priors import PAPER_PEAK_HZ


class Peak(Group):
    """One vibration peak: a damped resonance, or a line at damping 0."""

    frequency: Real = Real(
        PAPER_PEAK_HZ,
        bounds=(0.01, 50_000.0),
        softbounds=(5.0, 80.0),
        step=0.1,
        label="Frequency f",
        doc="Natural frequency [Hz]. The dominant one of the paper is 47.4969 Hz (Table 2).",
    )
    damping: Real = Real(
        0.03,
        bounds=(0.0, 1.0),
        softbounds=(0.0, 0.1),
        step=0.001,
        label="Damping ξ",
        doc="Damping ratio; 0 is a line. The paper has 0.03 (Table 2).",
    )
    rms: Reals = Reals(
        [0.01, 0.01],
        item_bounds=(0.0, 1e4),
        bounds=(1, 64),
        label="Strength per mode, rms",
        doc="Standard deviation of the peak [um], one number per mode: tip, tilt, ...; zero for modes beyond the list.",
    )


class Vibration(Group):
    """Structural vibration of the telescope."""

    used_when: ClassVar[UsedWhen] = MappingProxyType(
        {
            "synthesis": ("source", ("peaks", "psd", "measured")),
            "spectrum": ("source", ("measured",)),
            "part": ("source", ("measured",)),
            "cutoff": ("source", ("peaks", "psd", "measured")),
            "peaks": ("source", ("peaks", "ar2")),
            "psd": ("source", ("psd",)),
        }
    )

    source: param.Selector[str] = param.Selector(
        default="peaks",
        objects=["peaks", "psd", "measured", "ar2", "none"],
        label="Source",
        doc="Model of the vibration. peaks: inverse DFT of the peak list (paper, Algorithm 4); psd: of the PSD table; "
        "measured: of a measured spectrum; ar2: each peak as an AR(2) process (paper, eq. 2); none: no vibration.",
    )
    synthesis: param.Selector[str] = param.Selector(
        default="gaussian",
        objects=["gaussian", "random-phase"],
        label="Synthesis",
        doc="Signal of an inverse DFT. gaussian: a section of a stationary Gaussian process, cut from a period many "
        "times as long; random-phase: fixed amplitudes and random phases, as long as the record and periodic with "
        "it (paper, Algorithm 4).",
    )
    spectrum: param.Selector[str] = param.Selector(
        default="eris-ut4",
        objects=["eris-ut4"],
        label="Measured spectrum",
        doc="Measured spectrum, for source measured. eris-ut4: measured at VLT UT4 with ERIS (astro-tiptop/TIPTOP, MIT).",
    )
    part: param.Selector[str] = param.Selector(
        default="lines",
        objects=["lines", "all"],
        label="Part of the spectrum",
        doc="Part of the measured spectrum, for source measured. lines: above its synthetic floor 4e4 / f^2 nm^2/Hz, "
        "from 7.5 Hz up; all: the whole spectrum.",
    )
    cutoff: Real = Real(
        80.0,
        bounds=(0.1, 50_000.0),
        softbounds=(10.0, 200.0),
        label="Cut-off f_c",
        doc="Cut-off frequency of an inverse DFT [Hz]; no vibration above it (paper, section 2.4).",
    )
    peaks: param.List[list[Peak]] = param.List(
        [Peak()], item_type=Peak, bounds=(0, 2000), label="Peaks", doc="Peaks of the vibration spectrum."
    )
    psd: PsdTable = section(PsdTable, "PSD table", "Spectrum of the vibration as a table, for source psd.")
