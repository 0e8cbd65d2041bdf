"""The controllers, by id."""

from __future__ import annotations

from typing import Any

from wfsobs import registry
from wfsobs.control.base import Controller
from wfsobs.control.integrator import best_gain, integrator_law
from wfsobs.control.law import Law
from wfsobs.control.lqg import lqg_kf_lgs, lqg_kf_multi, lqg_multirate, lqg_multirate_multi, lqg_multirate_optimal
from wfsobs.control.mirror import Plant
from wfsobs.control.prediction import gpr_offline_ahead, gpr_online_ahead
from wfsobs.prior import Bands, LgsError, Lines, Model, Part, Prior, Spectra, Training
from wfsobs.registry import Registry


def integrator(prior: Prior, mode: int, plant: Plant, settings: Any) -> Law:
    """The integrator with the gain of the settings, or the best one for the spectra that it is told."""
    c = settings.control
    gain = c.gain if c.integrator == "manual" else best_gain(prior.spectra[mode], plant.mirror, c.leak)
    return integrator_law(plant.mirror, gain, c.leak)


def _gain(settings: Any) -> tuple[Part, ...]:
    """An optimised gain takes the spectra."""
    return (Spectra,) if settings.control.integrator == "optimised" else ()


def _gain_and_scale(settings: Any) -> tuple[Part, ...]:
    """Beside the gain, standardised inputs are divided by the deviations of a training record."""
    scale = (Training,) if settings.gpr_online.inputs_filter == "standardised" else ()
    return (*_gain(settings), *scale)


CONTROLLERS = Registry(
    Controller,
    registry.CONTROLLERS,
    (
        Controller("none", "No control", weight=0.1),
        Controller("integrator", "Integrator", integrator, settings=("control",), asks=_gain),
        Controller("lqg-kf-lgs", "LQG, LGS KF", lqg_kf_lgs, prior=(Model,)),
        Controller("lqg-kf-multi", "LQG, multi-peak KF", lqg_kf_multi, prior=(Lines,), settings=("multipeak",)),
        Controller("lqg-multirate", "LQG, multi-rate KF", lqg_multirate, prior=(Model,), settings=("multirate",), ngs=True),
        Controller(
            "lqg-multirate-optimal",
            "LQG, optimal multi-rate KF",
            lqg_multirate_optimal,
            prior=(Model, LgsError),
            settings=("multirate",),
            ngs=True,
        ),
        Controller(
            "lqg-multirate-multi",
            "LQG, multi-rate multi-peak KF",
            lqg_multirate_multi,
            prior=(Model, LgsError, Lines),
            settings=("multirate", "multipeak"),
            ngs=True,
        ),
        Controller(
            "integrator+gpr-offline",
            "Integrator and offline GPR",
            integrator,
            gpr_offline_ahead,
            (Training, Bands),
            ("control", "gpr_offline"),
            _gain,
            weight=20.0,
        ),
        Controller(
            "integrator+gpr-online",
            "Integrator and online GPR",
            integrator,
            gpr_online_ahead,
            (Bands,),
            ("control", "gpr_online"),
            _gain_and_scale,
            weight=200.0,
        ),
    ),
    reserved=("bound",),
)
"""Every controller, in the order of tables and legends."""
