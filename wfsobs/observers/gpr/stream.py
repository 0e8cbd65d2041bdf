"""Online Gaussian process regression of one mode as a stream: one sample in, one estimate out, then an update.

The numbers are those of `gpr_online` over a record. `wfsobs.observers.gpr.sliding_regression` does the work.
"""

from __future__ import annotations

import numpy as np

from wfsobs.observers.gpr.inputs import Scale, StreamingInputs
from wfsobs.observers.gpr.online import OnlineGpr, kernel_of
from wfsobs.observers.gpr.sliding_regression import SlidingRegression
from wfsobs.prior import Bands
from wfsobs.signal.bandpass import StreamingBank, bandpass_bank


class OnlineGprStream:
    """The online GPR of one mode, one sample at a time, as a control loop calls it.

    >>> settings = OnlineGpr(training_size=3, depth=2)
    >>> stream = OnlineGprStream(settings, Bands((47.7,), 3.0, 2.0, 1), dt=1e-3)
    >>> [bool(np.isnan(stream.step(y, u=0.0))) for y in (0.0, 0.1, 0.0, -0.1, 0.0)]
    [True, True, True, True, False]
    """

    def __init__(self, settings: OnlineGpr, bands: Bands, dt: float, scale: Scale | None = None):
        """dt: step [s]; scale: of standardised inputs, from `inputs.scale_of`."""
        g = settings
        self._inputs, self._streaming_inputs = g.inputs, StreamingInputs(g, dt, scale)
        self._bank = StreamingBank(bandpass_bank(bands.frequencies, bands.bandwidth_online, bands.order, dt))
        self._regression = SlidingRegression(g.depth, g.training_size, 1 if g.inputs == "z" else 2, kernel_of(g))
        self._u = (0.0, 0.0)  # u[k-1], u[k-2]
        self._now: float | None = None
        self._pending = False

    def estimate(self, y: float, u: float | None = None) -> float:
        """Estimate the vibration at this step [um] from its LGS measurement y [um].

        And from its command u [um], unless the windows are of z. NaN until the training set is full. `update` must follow.
        """
        if self._pending:
            raise RuntimeError("estimate was called twice without update")
        z = y - self._u[1]
        if self._inputs == "z":
            sample = np.array([z])
        elif u is None:
            raise ValueError("windows of u and y need the command of this step")
        else:
            sample = np.array([u, y])
        self._now, self._pending = u, True
        target = np.array([self._bank.push(z)])
        return float(self._regression.predict(self._streaming_inputs.step(sample)[None], target)[0])

    def update(self, u: float | None = None) -> None:
        """Learn from the last sample. u: its command [um], where `estimate` was not told."""
        u = self._now if u is None else u
        if u is None or not self._pending:
            raise ValueError("update needs the command u, and an estimate before it")
        self._regression.update()
        self._bank.settle()
        self._u, self._pending = (u, self._u[0]), False

    def step(self, y: float, u: float) -> float:
        """`estimate`, then `update`."""
        value = self.estimate(y, u)
        self.update()
        return value
