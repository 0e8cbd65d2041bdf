"""Estimates of turbulence and vibration together, of the observers that estimate both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from wfsobs.observers.base import TARGETS
from wfsobs.observers.estimates import TOTAL, Estimate
from wfsobs.typing import Array


def with_total(parts: Mapping[str, Array]) -> dict[str, Array]:
    """Return what there is of each target, and where there is both also the sum."""
    both = {TOTAL: np.sum([parts[target] for target in TARGETS], axis=0)} if set(TARGETS) <= set(parts) else {}
    return {**parts, **both}


def totals(estimates: Sequence[Estimate]) -> list[Estimate]:
    """Return the estimate of the sum of turbulence and vibration of every observer that estimates both."""
    return [
        replace(
            parts[0],
            target=TOTAL,
            values=np.sum([e.values for e in parts], axis=0),
            seconds_per_step=max(e.seconds_per_step for e in parts),
            sd=parts[0].sd_of_sum.get(TOTAL),
        )
        for parts in of_both(estimates).values()
    ]


def of_both(estimates: Sequence[Estimate]) -> dict[str, list[Estimate]]:
    """Return the estimates of every observer that has both targets."""
    whole: dict[str, list[Estimate]] = {}
    for estimate in estimates:
        whole.setdefault(estimate.observer, []).append(estimate)
    return {observer: parts for observer, parts in whole.items() if {e.target for e in parts} == set(TARGETS)}
