"""Estimates of an observer: what it returns, and one target of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from wfsobs.typing import Array

TURBULENCE, VIBRATION = "turbulence", "vibration"
TARGETS = (TURBULENCE, VIBRATION)

TOTAL, NEXT_Z = "total", "next z"
"""Of the standard deviations: the sum of turbulence and vibration, and the next measurement, as the sum predicts it."""


class Estimates(dict[str, Array]):
    """Estimates of an observer, target -> (n_steps, n_modes) [um], and how sure it is of them.

    Parameters
    ----------
    values : mapping of str to Array
        Target -> estimate, NaN where there is none.
    sd : mapping of str to Array, optional
        Target -> standard deviation of the estimate's error by the observer's own model, (n_steps, n_modes) [um], perhaps a
        read-only view of fewer numbers; no target without a model, NaN where not known. TOTAL and NEXT_Z, too, where the model
        has them: of the sum of its estimates, less the disturbance at the step and less z of the next.
    """

    def __init__(self, values: Mapping[str, Array], sd: Mapping[str, Array] | None = None):
        super().__init__(values)
        self.sd: dict[str, Array] = dict(sd or {})


def by_name(x: Array) -> dict[str, Array]:
    """Return the columns of x (n, 2 to 4, n_modes) by what they are: targets, and of standard deviations TOTAL and NEXT_Z."""
    return {name: x[:, i] for i, name in zip(range(x.shape[1]), (*TARGETS, TOTAL, NEXT_Z), strict=False)}


@dataclass(frozen=True)
class Estimate:
    """Estimate of one target by one observer.

    Attributes
    ----------
    observer, target : str
        Of whom, and of what.
    values : Array
        Estimate, (n_steps, n_modes) [um]; NaN where there is none.
    seconds_per_step : float
        Computing time per step and mode [s].
    sd : Array or None
        Standard deviation of its error by the observer's own model, (n_steps, n_modes) [um]; None where it has no model, NaN
        where there is no number.
    sd_of_sum : mapping of str to Array
        TOTAL and NEXT_Z -> that of all estimates of the observer together; empty where it has no such model.
    """

    observer: str
    target: str
    values: Array
    seconds_per_step: float
    sd: Array | None = None
    sd_of_sum: Mapping[str, Array] = field(default_factory=dict[str, Array])

    def __repr__(self) -> str:
        n_steps, n_modes = self.values.shape
        return (
            f"Estimate({self.observer}, {self.target}, steps {n_steps}, modes {n_modes}, {self.seconds_per_step:.3g} s per step)"
        )
