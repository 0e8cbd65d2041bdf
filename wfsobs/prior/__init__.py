"""Priors: what observers and controllers receive beside measurements."""

from __future__ import annotations

from dataclasses import dataclass

from wfsobs.prior.parts import Bands, Beams, LgsError, Line, Lines, Model, Spectra
from wfsobs.record import Training

__all__ = ["PARTS", "Bands", "Beams", "LgsError", "Line", "Lines", "Model", "Part", "Prior", "Spectra", "Training"]

Part = type[Model] | type[LgsError] | type[Lines] | type[Beams] | type[Bands] | type[Spectra] | type[Training]
"""A kind of thing that an observer or a controller can ask for."""

PARTS: dict[Part, tuple[str, ...]] = {
    Model: ("model",),
    LgsError: ("model",),
    Lines: ("model", "true lines"),
    Beams: ("model",),
    Bands: ("bands",),
    Spectra: ("true spectra",),
    Training: ("training data",),
}
"""Part -> what it is called in the column "Needs"."""


@dataclass(frozen=True)
class Prior:
    """The parts that an observer or a controller asked for, empty or None where it did not.

    model, lgs_error, lines, beams, spectra : one per mode
    bands    : of all modes
    training : a record to learn from
    """

    model: tuple[Model, ...] = ()
    lgs_error: tuple[LgsError, ...] = ()
    lines: tuple[Lines, ...] = ()
    beams: tuple[Beams, ...] = ()
    bands: Bands | None = None
    spectra: tuple[Spectra, ...] = ()
    training: Training | None = None
