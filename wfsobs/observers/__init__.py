"""The observers, by id. A new one is a function and one entry here."""

from __future__ import annotations

from wfsobs.observers.base import TARGETS, TURBULENCE, VIBRATION, Observer
from wfsobs.observers.gpr_offline import gpr_offline
from wfsobs.observers.gpr_online import gpr_online
from wfsobs.observers.kalman import kf_lgs, kf_ngs
from wfsobs.observers.kalman_multi import kf_multi
from wfsobs.observers.multirate import multirate
from wfsobs.observers.multirate_optimal import multirate_optimal
from wfsobs.observers.reference import butterworth_cl, butterworth_ol, persistence, zero
from wfsobs.observers.ridge import ridge, ridge_30

_NGS = ("y_ngs", "ratio")

OBSERVERS: dict[str, Observer] = {o.id: o for o in (
    Observer("kf-lgs", "LGS KF", TARGETS, kf_lgs),
    Observer("kf-multi", "Multi-peak KF", TARGETS, kf_multi),
    Observer("kf-ngs", "NGS KF", (TURBULENCE,), kf_ngs, needs=_NGS),
    Observer("multirate", "Multi-rate KF", (TURBULENCE,), multirate, needs=_NGS),
    Observer("multirate-optimal", "Optimal multi-rate KF", TARGETS, multirate_optimal, needs=_NGS),
    Observer("butterworth-ol", "Butterworth, open loop", (VIBRATION,), butterworth_ol, needs=("open_loop_y",), causal=False),
    Observer("butterworth-cl", "Butterworth, closed loop", (VIBRATION,), butterworth_cl),
    Observer("gpr-offline", "Offline GPR", (VIBRATION,), gpr_offline, needs=("training",), weight=20.0),
    Observer("gpr-online", "Online GPR", (VIBRATION,), gpr_online, weight=200.0),
    Observer("ridge", "Ridge", (VIBRATION,), ridge, needs=("training",)),
    Observer("ridge-30", "30-tap predictor", (VIBRATION,), ridge_30, needs=("training",)),
    Observer("persistence", "Persistence", (TURBULENCE,), persistence, weight=0.1),
    Observer("zero", "Zero", TARGETS, zero, weight=0.1),
)}
"""Every observer, in the order of tables and legends."""
