"""A linear controller as matrices: what every format holds.

Per mode, with e[k] the innovation of the measurements v[k] (z alone, or z and the NGS frame):

    e = v - C x,    w = x + L e,    u = row w,    x <- A w,

(A, C, L) repeating every few steps. To a Kalman filter a measurement that is missing is none, and near it the gains are those of
its covariance (`wfsobs.signal.gap_gains`). To another controller its innovation is that of what a filter of its own predicts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from wfsobs.control.step import Integrators, KalmanLaws, LinearLaws, StepController
from wfsobs.observers.step import StepError
from wfsobs.observers.stepping import GainCycle
from wfsobs.signal.gap_gains import ONE, GapGains
from wfsobs.typing import Array


class ModeMatrices(NamedTuple):
    """One mode.

    gains, row : of the controller
    gaps       : gains near gaps; None where missing measurements are bridged
    lgs, ngs   : of what then predicts a missing measurement or NGS frame; None where the last one is held
    """

    gains: GainCycle
    row: Array
    gaps: GapGains | None = None
    lgs: GainCycle | None = None
    ngs: GainCycle | None = None


@dataclass(frozen=True)
class LinearDesign:
    """A controller of one or several modes.

    Attributes
    ----------
    id : str
        Of the controller.
    dt : float
        Time step [s].
    ratio : int
        Frames per NGS frame; 0 for a controller without NGS.
    taps : Array
        Weights of u[k], u[k-1], ... in y[k]: delay and mirror that it was designed for.
    modes : tuple of ModeMatrices
        One per mode.
    """

    id: str
    dt: float
    ratio: int
    taps: Array
    modes: tuple[ModeMatrices, ...]

    @property
    def mirror_text(self) -> str:
        """The commands in a measurement, as text."""
        return " + ".join(f"{tap:g} u[k-{i}]" for i, tap in enumerate(self.taps) if tap)

    @property
    def period(self) -> int:
        """Steps after which the gains repeat."""
        return max(len(mode.gains.steps) for mode in self.modes)

    def conventions(self, takes_gaps: bool) -> list[str]:
        """Return units, signs and timing, as lines of text; takes_gaps : whether measurements may be missing."""
        gaps = "none to a Kalman filter, to others predicted, or the last one held"
        lines = [
            f"Controller {self.id} of wfsobs, {len(self.modes)} modes, one call every {self.dt:g} s.",
            "In: z, the pseudo-open-loop measurement of every mode [um rms, Noll-normalised Zernike coefficients].",
            f"    z[k] = y[k] - ({self.mirror_text}), y the measurement of the sensor, u the commands that the mirror took.",
            f"    NaN is a missing measurement: {gaps}." if takes_gaps else "    None may be missing.",
            "Out: u[k], the command of every mode [um], computed once y[k] is known. The residual is disturbance + u.",
            "    Limits of the mirror are the caller's: subtract in z the commands that it took.",
        ]
        if self.ratio:
            lines += [
                f"In: ngs, the NGS frame in the calls k = {self.ratio}, {2 * self.ratio}, ..., any number in the others [um]:",
                f"    its measurement less the mean of what z[k] ... z[k-{self.ratio - 1}] have subtracted.",
                f"The gains repeat every {self.ratio} calls, from call 1 on; call 0 has gains of its own.",
            ]
        return lines


def linear_design(controller: StepController) -> LinearDesign:
    """Return a controller as matrices. Raises StepError with the reason where it is none."""
    law = controller.law
    if controller.ahead is not None:
        raise StepError(f"{controller.id}: a prediction by Gaussian process regression has no linear form")
    if not isinstance(law, (KalmanLaws, LinearLaws, Integrators)):
        raise StepError(f"{controller.id}: there is no law to write, or none that stays as it is")
    if isinstance(law, Integrators) and controller.plant.mirror.has_limits:
        raise StepError(f"{controller.id}: limits of the mirror stop an integrator, which no linear form does: leave them at 0")
    lgs, ngs = ({}, {}) if controller.bridges is None else (bridge.gains for bridge in controller.bridges)
    modes = []
    for mode, one in enumerate(law.laws):
        if one.gains is None or one.row is None:
            raise StepError(f"{controller.id}: its law is not known as gains of an observer")
        gaps = one.filter._replace(mean=ONE).gaps() if one.filter is not None and controller.bridges is None else None
        modes.append(ModeMatrices(one.gains, one.row, gaps, lgs.get(mode), ngs.get(mode)))
    ratio = controller.sampling.ratio or 0 if controller.uses_ngs else 0
    return LinearDesign(controller.id, controller.sampling.dt, ratio, controller.plant.mirror.taps, tuple(modes))
