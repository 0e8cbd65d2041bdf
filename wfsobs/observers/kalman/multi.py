"""The Kalman filter that knows every peak, which the paper expects to help (its conclusion).

The filter is that of `kalman.single`, its model one AR(2) per line of the vibration and, as an option, turbulence of third order.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from wfsobs.observers.kalman.single import by_target, steady_filter
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import Measurements
from wfsobs.typing import Array

if TYPE_CHECKING:
    from wfsobs.scenario.groups.observers import MultiPeak


def kf_multi(measured: Measurements, prior: Prior, settings: MultiPeak, watch: Watch) -> dict[str, Array]:
    """The filter on the LGS measurement, at every fast step."""
    z = measured.z
    columns = []
    for mode, model in enumerate(prior.lines):
        watch.step(mode / measured.n_modes)
        kalman, _ = steady_filter(model.disturbance(settings.line_width), model.noise)
        columns.append(kalman.run(z[:, None, mode, None])[:, :, 0])
    return by_target(columns)
