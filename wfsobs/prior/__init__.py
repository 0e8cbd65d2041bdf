"""Priors: what observers and controllers receive beside measurements."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import nan
from typing import Any, Literal

from wfsobs.prior.parts import Asterism, Beams, Flow, FlowOfBoth, LgsError, LgsStars, Line, Lines, Spectra
from wfsobs.prior.shares import Bands, LgsModel, Model, NgsModel, Noise, NoiselessModel, OfflineBands, OnlineBands
from wfsobs.record import Training

__all__ = [
    "GIVEN",
    "IDENTIFIED",
    "TRUE",
    "Asterism",
    "Bands",
    "Beams",
    "Flow",
    "FlowOfBoth",
    "LgsError",
    "LgsModel",
    "LgsStars",
    "Line",
    "Lines",
    "Model",
    "NgsModel",
    "Noise",
    "NoiselessModel",
    "OfflineBands",
    "OnlineBands",
    "Part",
    "Prior",
    "PriorSource",
    "Spectra",
    "Training",
    "ask_nothing",
    "asks_for",
    "words_for",
]

PriorSource = Literal["true", "identified", "given"]
"""Where lines and spectra of a prior come from."""
TRUE: PriorSource = "true"
"""From the settings that the record was simulated from."""
IDENTIFIED: PriorSource = "identified"
"""From an identification."""
GIVEN: PriorSource = "given"
"""From settings, on a record that was not simulated from them."""

Part = (
    type[Model]
    | type[Noise]
    | type[LgsError]
    | type[LgsStars]
    | type[Lines]
    | type[Beams]
    | type[Flow]
    | type[FlowOfBoth]
    | type[Asterism]
    | type[Bands]
    | type[Spectra]
    | type[Training]
)
"""A kind of thing that an observer or a controller can ask for."""

_WORDS: dict[Part, tuple[str, ...]] = {
    Model: ("model",),
    LgsModel: ("model",),
    NgsModel: ("model",),
    NoiselessModel: ("model",),
    Noise: ("model",),
    LgsError: ("model",),
    LgsStars: (),
    Lines: ("model", "{source} peaks"),
    Beams: ("model",),
    Flow: ("model",),
    FlowOfBoth: ("model",),
    Asterism: ("model",),
    Bands: ("bands",),
    OfflineBands: ("bands",),
    OnlineBands: ("bands",),
    Spectra: ("{source} spectra",),
    Training: ("training data",),
}
"""Part -> what it is called in the column "Prior knowledge", by the source of the prior."""


def words_for(parts: Iterable[Part], *, source: PriorSource = TRUE) -> tuple[str, ...]:
    """Return what parts of a prior are called in the column "Prior knowledge", each word once.

    >>> words_for((Model, Lines), source=IDENTIFIED)
    ('model', 'identified peaks')
    """
    return tuple(dict.fromkeys(word.format(source=source) for part in parts for word in _WORDS[part]))


def ask_nothing(_settings: Any) -> tuple[Part, ...]:
    """Return the parts that are needed for some settings alone: none."""
    return ()


def asks_for(part: Part, parts: Iterable[Part]) -> bool:
    """Return whether a part is among others, whole or as much of it as somebody needs.

    >>> asks_for(Model, (Lines, LgsModel)), asks_for(LgsModel, (Model,))
    (True, False)
    """
    return any(issubclass(one, part) for one in parts)


@dataclass(frozen=True)
class Prior:
    """The parts that an observer or a controller asked for, empty or None where it did not.

    model, noise, lgs_error, stars, lines, beams, spectra : one per mode
    flow, asterism, bands : of all modes; asterism of every LGS, or of all of them together
    training : a record to learn from
    """

    model: tuple[Model, ...] = ()
    lgs_error: tuple[LgsError, ...] = ()
    stars: tuple[LgsStars, ...] = ()
    lines: tuple[Lines, ...] = ()
    beams: tuple[Beams, ...] = ()
    flow: Flow | None = None
    asterism: Asterism | None = None
    bands: Bands | None = None
    spectra: tuple[Spectra, ...] = ()
    training: Training | None = None
    noise: tuple[Noise, ...] = ()

    def noise_of(self, mode: int) -> Noise | Model:
        """Return what tells the noise of one mode: the noise alone, or the model; NaN where neither was asked for."""
        told = self.noise or self.model
        return told[mode] if told else Noise(nan, nan)
