"""The controllers, by id: what each is, and what it has to be given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from wfsobs.control.integrator import best_gain, integrator_law
from wfsobs.control.law import Law
from wfsobs.control.lqg import LQG
from wfsobs.control.mirror import Mirror
from wfsobs.control.prediction import gpr_offline_ahead, gpr_online_ahead
from wfsobs.observers.base import BANDS, LINES, MODEL, NOTHING, SPECTRA, TRAINING
from wfsobs.progress import Watch
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.simulation.true_spectra import TrueSpectra
from wfsobs.typing import Array

MakeLaw = Callable[[Scenario, int, Mirror, TrueSpectra | None], Law]
"""(scenario, mode, mirror, its true spectra if known) -> law. Raises ValueError saying why there is none."""

Predict = Callable[[Record, Scenario, Mirror, Watch], Array]
"""Vibration while u[k] acts, (n_steps, n_modes) [um], NaN where it is not known yet."""


@dataclass(frozen=True)
class Controller:
    """An entry of the registry: a linear law, or an integrator beside a prediction of the vibration, or nothing.

    id, label : for tables and files, and for people
    needs     : what it must be given beside measurements, the gain of an integrator aside
    law       : of one mode; of an integrator with a prediction, that of the integrator
    predict   : of the vibration
    ngs       : whether it uses NGS frames
    weight    : its computing time relative to a linear law's
    """

    id: str
    label: str
    needs: tuple[str, ...] = ()
    law: MakeLaw | None = None
    predict: Predict | None = None
    ngs: bool = False
    weight: float = 1.0

    def needed(self, scenario: Scenario) -> str:
        """What it must be given beside measurements, for people; an optimised gain takes the true spectra."""
        gain = (SPECTRA,) if self.law is _integrator and scenario.control.integrator == "optimised" else ()
        return ", ".join((*gain, *self.needs)) or NOTHING


def _integrator(scenario: Scenario, mode: int, mirror: Mirror, spectra: TrueSpectra | None) -> Law:
    c = scenario.control
    if c.integrator == "manual":
        return integrator_law(mirror, c.gain, c.leak)
    if spectra is None:
        raise ValueError(
            f"the spectrum of turbulence from {scenario.turbulence.source} is not known: set control.integrator "
            "to manual, and control.gain"
        )
    return integrator_law(mirror, best_gain(spectra, mirror, c.leak), c.leak)


def _lqg(id_: str) -> MakeLaw:
    return lambda scenario, mode, mirror, _spectra: LQG[id_](scenario, mode, mirror)


CONTROLLERS: dict[str, Controller] = {
    c.id: c
    for c in (
        Controller("none", "No control", weight=0.1),
        Controller("integrator", "Integrator", law=_integrator),
        Controller("lqg-kf-lgs", "LQG, LGS KF", (MODEL,), _lqg("lqg-kf-lgs")),
        Controller("lqg-kf-multi", "LQG, multi-peak KF", (MODEL, LINES), _lqg("lqg-kf-multi")),
        Controller("lqg-multirate", "LQG, multi-rate KF", (MODEL,), _lqg("lqg-multirate"), ngs=True),
        Controller("lqg-multirate-optimal", "LQG, optimal multi-rate KF", (MODEL,), _lqg("lqg-multirate-optimal"), ngs=True),
        Controller("lqg-multirate-multi", "LQG, multi-rate multi-peak KF", (MODEL, LINES), _lqg("lqg-multirate-multi"), ngs=True),
        Controller(
            "integrator+gpr-offline", "Integrator and offline GPR", (TRAINING, BANDS), _integrator, gpr_offline_ahead, weight=20.0
        ),
        Controller("integrator+gpr-online", "Integrator and online GPR", (BANDS,), _integrator, gpr_online_ahead, weight=200.0),
    )
}
"""Every controller, in the order of tables and legends."""
