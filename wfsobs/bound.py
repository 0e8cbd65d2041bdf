"""The bound: the least error that any causal observer of the LGS measurements could have on a scenario.

It is the Wiener filter's (`wiener`), which knows the true spectra of the scenario (`true_spectra`) and its noise, after an
infinitely long record. What a row of an observer lacks to it is what a better model, better tuning or more training could
gain. It is the mean over all records: on one of them an observer may be luckier, and one that has the NGS as well may be better.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from wfsobs.observers.base import TARGETS
from wfsobs.record import Record
from wfsobs.scenario import Scenario
from wfsobs.scores import BOUND, Score, rms
from wfsobs.true_spectra import TrueSpectra, is_known, true_spectra
from wfsobs.wiener import advanced, causal_error, factorise


def bound(scenario: Scenario, mode: int, ahead: int = 0) -> dict[str, float]:
    """Target -> rms [um] of the least error of phi[k + ahead] from z[k], z[k-1], ...; "total" is that of both together."""
    return bound_of(true_spectra(scenario, mode), ahead)


def bound_of(spectra: TrueSpectra, ahead: int = 0) -> dict[str, float]:
    """As `bound`, from the spectra of a mode."""
    whitener = factorise(spectra.measured)
    signal, shared = spectra.total
    wanted = {name: (spectra.signal[name], spectra.shared[name]) for name in spectra.signal} | {"total": (signal, shared)}
    return {
        name: float(np.sqrt(causal_error(own, advanced(cross, 1 + ahead), whitener))) for name, (own, cross) in wanted.items()}


def bound_scores(scenario: Scenario, record: Record) -> list[Score]:
    """The rows of the bound, for a record that was simulated from the scenario; none where its spectra are not known."""
    if not is_known(scenario):
        return []
    out, start = [], round(scenario.run.warm_up / record.dt)
    modes = scenario.modes[: record.n_modes]
    with ThreadPoolExecutor(2) as pool:
        bounds = list(pool.map(lambda mode: bound(scenario, mode), range(len(modes))))
    for mode, (it, least) in enumerate(zip(modes, bounds, strict=True)):
        for target in TARGETS:
            truth = record.truth(target)
            if truth is not None and truth.shape[0] > start:
                scale = rms(truth[start:, mode])
                normalised = least[target] / scale if scale > 0 else None
                out.append(Score(BOUND, target, it.name, least[target], scale, normalised, None, 0.0))
    return out
