"""The optimal multi-rate filter that knows every peak: what `kalman.multi` models, from both sensors.

Its model has one AR(2) per line of the vibration, and turbulence in the beams of target and LGS as sums of independent processes:
in both, in the target's alone, in that of the LGS alone. The NGS frame is the mean that it is, with the periodic gains of
`kalman.multirate_optimal`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from wfsobs.observers.base import TARGETS, Look, Observer, Tunable
from wfsobs.observers.kalman.multi import PEAKS, MultiPeak, vibration_used
from wfsobs.observers.kalman.multirate import MultiRate, multirate_noise
from wfsobs.observers.kalman.multirate_optimal import Cycle, OptimalFilters, estimated_cycle
from wfsobs.observers.kalman.single import NGS
from wfsobs.prior import Beams, LgsStars, Lines, Noise, Prior
from wfsobs.signal.ar2 import Ar2
from wfsobs.signal.ar3 import Ar3
from wfsobs.signal.statespace import DisturbanceModel, disturbance_model


def every_peak_model(rates: MultiRate, peaks: MultiPeak, prior: Prior, mode: int, ratio: int) -> Cycle:
    """Return the cycle of one mode with every peak of the vibration in its model."""
    beams = prior.beams[mode]
    error = beams.lgs if rates.model_lgs_error else ()
    noises = multirate_noise(rates, prior.noise_of(mode))
    return estimated_cycle(beam_model(beams, prior.lines[mode].vibration(peaks.line_width)), ratio, *noises, error)


def beam_model(beams: Beams, vibration: Sequence[Ar2]) -> DisturbanceModel:
    """Return the model of the target's disturbance, measured as the LGS see it but for what they see alone."""
    turbulence = (*beams.common, *beams.target)
    model = disturbance_model(turbulence, vibration)
    gains = [*[beams.gain] * len(beams.common), *[0.0] * len(beams.target), *[beams.line_gain] * len(vibration)]
    poles = [3 if isinstance(process, Ar3) else 2 for process in (*turbulence, *vibration)]
    return replace(model, C=model.C * np.repeat(gains, poles))


_FILTERS = OptimalFilters(partial(every_peak_model, MultiRate()))

MULTIRATE_MULTI = Observer(
    "multirate-multi",
    "Multi-rate multi-peak KF",
    TARGETS,
    _FILTERS.run,
    help="Kalman filter on both sensors with every vibration peak in its model; not in the paper",
    prior=(Noise, LgsStars, Lines, Beams),
    settings=PEAKS,
    needs=NGS,
    linear=True,
    takes_missing=True,
    sensors=("lgs", "ngs"),
    tunable=Tunable(
        ("multipeak.line_width", "kalman.lgs_noise", "kalman.ngs_noise"),
        ("multipeak.turbulence_order", "kalman.turbulence_rms"),
    ),
    look=Look("Multi-rate multi-peak", "#AB64CF", "#F26FF3", (16, 3, 3, 3)),
    step=_FILTERS.step,
    counts=vibration_used,
)
