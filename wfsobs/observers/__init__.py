"""The observers, by id; each is declared at the end of its own module."""

from __future__ import annotations

from wfsobs import registry
from wfsobs.observers.base import Observer
from wfsobs.observers.baselines import BUTTERWORTH_CL, BUTTERWORTH_OL, PERSISTENCE, ZERO
from wfsobs.observers.gp import GP_BOTH, GP_LGS
from wfsobs.observers.gpr.adaptive import GPR_ADAPTIVE
from wfsobs.observers.gpr.offline import GPR_OFFLINE
from wfsobs.observers.gpr.online import GPR_ONLINE
from wfsobs.observers.gpr.ridge import RIDGE, RIDGE_30
from wfsobs.observers.kalman.adaptive import KF_ADAPTIVE, MULTIRATE_ADAPTIVE
from wfsobs.observers.kalman.filters import KF_LGS, KF_MULTI, KF_NGS, MULTIRATE, MULTIRATE_MULTI, MULTIRATE_OPTIMAL
from wfsobs.observers.kalman.joint import KF_ASTERISM, KF_COUPLED, MULTIRATE_COUPLED
from wfsobs.registry import Registry

BUILT_IN = (
    KF_LGS,
    KF_MULTI,
    KF_COUPLED,
    KF_ASTERISM,
    KF_ADAPTIVE,
    KF_NGS,
    MULTIRATE,
    MULTIRATE_OPTIMAL,
    MULTIRATE_MULTI,
    MULTIRATE_COUPLED,
    MULTIRATE_ADAPTIVE,
    GP_LGS,
    GP_BOTH,
    BUTTERWORTH_OL,
    BUTTERWORTH_CL,
    GPR_OFFLINE,
    GPR_ONLINE,
    GPR_ADAPTIVE,
    RIDGE,
    RIDGE_30,
    PERSISTENCE,
    ZERO,
)
"""Those of wfsobs, in the order of tables and legends."""

OBSERVERS = Registry(Observer, registry.OBSERVERS, BUILT_IN, reserved_ids=("truth", "loop", "bound", "bound-both", "bound-stars"))
"""Every observer: those above, and those of installed packages (`wfsobs.registry`)."""
