"""What the words of the page mean, in one place; tables, cards, verdicts and the help take them from here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from markupsafe import Markup, escape

from wfsobs.app.render import macro, render
from wfsobs.app.style import HtmlComponent, script, sheets
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.evaluation.result import target_title
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TURBULENCE, VIBRATION

BOUND, NEEDS, LAG, STREHL, RELATIVE, RMS_ERROR, REAL_TIME, STATED = (
    "Theoretical limit",
    "Prior knowledge",
    "Lag",
    "Strehl",
    "Relative error",
    "RMS error",
    "Real-time factor",
    "Predicted sigma",
)

TERMS: Mapping[str, str] = {
    target_title(TURBULENCE): "Atmospheric tip/tilt, estimated from the guide stars.",
    target_title(VIBRATION): "Structural vibration, separated from turbulence.",
    "KF": (
        "Kalman filter: estimates turbulence and vibration step by step from a state-space model of both. A multi-rate one "
        "uses LGS and NGS, each at its own rate; an adaptive one identifies its model from the measurements."
    ),
    "GPR": (
        "Gaussian process regression: predicts the vibration from past measurements, without a model of its peaks. The "
        "offline one is trained on an earlier record, the online one during the run."
    ),
    "LGS": "Laser guide star: measured at the rate of the loop, with a slow error of its own in tip and tilt.",
    "NGS": "Natural guide star: measured once in several steps of the loop (exposure ratio n), without that slow error.",
    RMS_ERROR: (
        "Root mean square of estimate minus truth after the warm-up, over the samples that all observers have. Smaller is better."
    ),
    RELATIVE: "RMS error over the RMS of the truth. 0 is perfect, 1 is as good as an estimate of zero, above 1 is worse.",
    BOUND: (
        "Smallest RMS error that a causal linear observer of the mean LGS measurement, or of both sensors, can have, from "
        "the true spectra (Wiener). Where each LGS passes different turbulence, a third row is for an observer that has each "
        "of them separately. On a single record an observer may come out slightly below."
    ),
    NEEDS: "What an observer must know beside measurements: a model, peak frequencies, frequency bands or training data.",
    LAG: (
        "Delay of the estimate: where its cross-correlation with the truth has its maximum. Negative if the estimate leads. "
        "For an oscillation it is ambiguous by whole periods: the value nearest to zero is shown."
    ),
    REAL_TIME: "Computing time per step over the period of the loop. Below 1 the observer is fast enough.",
    STATED: (
        "Standard deviation that the observer's own model gives its estimates. Equal to the RMS error where that model is "
        "true; far below it, the observer is overconfident. A line shown alone has its 95 % band."
    ),
    STREHL: "Peak intensity over that of an image without error, from the residual of the simulated modes; at most 1.",
}


def sentence_on(name: str) -> str:
    """Write what an observer or a controller is in one sentence, that of its registry; nothing of what is neither.

    >>> sentence_on("persistence"), sentence_on("bound")
    ('Persistence: the newest measurement taken for the turbulence.', '')
    """
    it = OBSERVERS.get(name) or CONTROLLERS.get(name)
    return f"{it.label}: {it.help}." if it and it.help else ""


def term(name: str, words: str = "") -> Markup:
    """Write a word that says what it means when it is pressed. words : how it is written, if not as in TERMS."""
    return macro("term", words or name, TERMS[name], f"term-{name}")


def explain_first(text: str, word: str, name: str) -> Markup:
    """Escape a text, and have the first time that a word stands in it say what it means.

    >>> str(explain_first("5 % above x", "bound", BOUND))
    '5 % above x'
    """
    before, found, after = text.partition(word)
    return escape(before) + term(name, word) + escape(after) if found else escape(text)


class Help(HtmlComponent):
    """The button at the top, and what it opens."""

    _esm = script("page", "help")
    _stylesheets = sheets("base", "bare", "help")

    def __init__(self, **params: Any):
        super().__init__(html=render("help.html", terms=TERMS), width=36, margin=0, **params)
