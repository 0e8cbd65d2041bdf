"""The observers, by id. A new one is a function and one entry here."""

from __future__ import annotations

from wfsobs.observers.base import BANDS, LINES, MODEL, TARGETS, TRAINING, TURBULENCE, VIBRATION, Observer
from wfsobs.observers.baselines import butterworth_cl, butterworth_ol, persistence, zero
from wfsobs.observers.gpr.offline import gpr_offline
from wfsobs.observers.gpr.online import gpr_online
from wfsobs.observers.kalman.adaptive import kf_adaptive
from wfsobs.observers.kalman.multi import kf_multi
from wfsobs.observers.kalman.multirate import multirate
from wfsobs.observers.kalman.multirate_optimal import multirate_optimal
from wfsobs.observers.kalman.single import kf_lgs, kf_ngs
from wfsobs.observers.ridge import ridge, ridge_30

_NGS = ("y_ngs", "ratio")

OBSERVERS: dict[str, Observer] = {o.id: o for o in (
    Observer("kf-lgs", "LGS KF", TARGETS, kf_lgs, given=(MODEL,)),
    Observer("kf-multi", "Multi-peak KF", TARGETS, kf_multi, given=(MODEL, LINES)),
    Observer("kf-adaptive", "Adaptive KF", TARGETS, kf_adaptive, weight=50.0),
    Observer("kf-ngs", "NGS KF", (TURBULENCE,), kf_ngs, needs=_NGS, given=(MODEL,)),
    Observer("multirate", "Multi-rate KF", (TURBULENCE,), multirate, needs=_NGS, given=(MODEL,)),
    Observer("multirate-optimal", "Optimal multi-rate KF", TARGETS, multirate_optimal, needs=_NGS, given=(MODEL,)),
    Observer("butterworth-ol", "Butterworth, open loop", (VIBRATION,), butterworth_ol, needs=("open_loop_y",),
             given=(BANDS,), causal=False),
    Observer("butterworth-cl", "Butterworth, closed loop", (VIBRATION,), butterworth_cl, given=(BANDS,)),
    Observer("gpr-offline", "Offline GPR", (VIBRATION,), gpr_offline, needs=("training",), given=(TRAINING, BANDS), weight=20.0),
    Observer("gpr-online", "Online GPR", (VIBRATION,), gpr_online, given=(BANDS,), weight=200.0),
    Observer("ridge", "Ridge", (VIBRATION,), ridge, needs=("training",), given=(TRAINING, BANDS)),
    Observer("ridge-30", "30-tap predictor", (VIBRATION,), ridge_30, needs=("training",), given=(TRAINING, BANDS)),
    Observer("persistence", "Persistence", (TURBULENCE,), persistence, weight=0.1),
    Observer("zero", "Zero", TARGETS, zero, weight=0.1),
)}
"""Every observer, in the order of tables and legends."""
