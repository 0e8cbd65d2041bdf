"""The observers, by id."""

from __future__ import annotations

from typing import Any

from wfsobs import registry
from wfsobs.observers.base import TARGETS, TURBULENCE, VIBRATION, Observer
from wfsobs.observers.baselines import butterworth_cl, butterworth_ol, persistence, zero
from wfsobs.observers.gpr.offline import gpr_offline
from wfsobs.observers.gpr.online import gpr_online
from wfsobs.observers.kalman.adaptive import kf_adaptive
from wfsobs.observers.kalman.multi import kf_multi
from wfsobs.observers.kalman.multirate import multirate
from wfsobs.observers.kalman.multirate_optimal import multirate_optimal
from wfsobs.observers.kalman.single import kf_lgs, kf_ngs
from wfsobs.observers.ridge import ridge, ridge_30
from wfsobs.prior import Bands, LgsError, Lines, Model, Part, Training
from wfsobs.registry import Registry

_NGS = ("y_ngs", "ratio")


def _standardised(settings: Any) -> tuple[Part, ...]:
    """Standardised inputs are divided by the deviations of a training record."""
    return (Training,) if settings.inputs_filter == "standardised" else ()


OBSERVERS = Registry(
    Observer,
    registry.OBSERVERS,
    (
        Observer("kf-lgs", "LGS KF", TARGETS, kf_lgs, (Model,)),
        Observer("kf-multi", "Multi-peak KF", TARGETS, kf_multi, (Lines,), "multipeak"),
        Observer("kf-adaptive", "Adaptive KF", TARGETS, kf_adaptive, (), "adaptive", weight=50.0),
        Observer("kf-ngs", "NGS KF", (TURBULENCE,), kf_ngs, (Model,), "kalman", _NGS),
        Observer("multirate", "Multi-rate KF", (TURBULENCE,), multirate, (Model,), "multirate", _NGS),
        Observer("multirate-optimal", "Optimal multi-rate KF", TARGETS, multirate_optimal, (Model, LgsError), "multirate", _NGS),
        Observer(
            "butterworth-ol",
            "Butterworth, open loop",
            (VIBRATION,),
            butterworth_ol,
            (Bands,),
            needs=("open_loop_y",),
            causal=False,
        ),
        Observer("butterworth-cl", "Butterworth, closed loop", (VIBRATION,), butterworth_cl, (Bands,)),
        Observer(
            "gpr-offline", "Offline GPR", (VIBRATION,), gpr_offline, (Training, Bands), "gpr_offline", ("training",), weight=20.0
        ),
        Observer("gpr-online", "Online GPR", (VIBRATION,), gpr_online, (Bands,), "gpr_online", asks=_standardised, weight=200.0),
        Observer("ridge", "Ridge", (VIBRATION,), ridge, (Training, Bands), "gpr_offline", ("training",)),
        Observer("ridge-30", "30-tap predictor", (VIBRATION,), ridge_30, (Training, Bands), needs=("training",)),
        Observer("persistence", "Persistence", (TURBULENCE,), persistence, weight=0.1),
        Observer("zero", "Zero", TARGETS, zero, weight=0.1),
    ),
    reserved=("truth", "loop", "bound"),
)
"""Every observer, in the order of tables and legends."""
