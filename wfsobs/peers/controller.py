"""A controller behind the interface of a modal filter: the residual of a frame in, the command out, in the loop's own unit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.record import Sampling
from wfsobs.stepping import design
from wfsobs.typing import Array


class ControllerError(ValueError):
    """Error: a controller that cannot run in the loop; one line with the reason."""


class LoopController:
    """Commands the modes of a loop whose mirror subtracts them: residual = disturbance - command.

    Parameters
    ----------
    n_modes : int
        Modes of the loop.
    controller : str
        Id; one without NGS.
    prior : str
        The file of `wfsobs identify --out`.
    dt : float
        Time step [s].
    delay : float
        Frames from a command to the first measurement that sees it, 1 or more.
    scale : float
        Micrometres per unit of the modes.
    settings : mapping, optional
        Settings by dotted name, such as {"integrator.gain": 0.4}.

    Raises
    ------
    ControllerError
        A number is out of range, or the controller cannot run here.
    SettingError
        The file or a setting is refused.
    """

    def __init__(
        self,
        n_modes: int,
        controller: str,
        prior: str,
        dt: float,
        *,
        delay: float = 2.0,
        scale: float = 1.0,
        settings: Mapping[str, Any] | None = None,
    ):
        if controller not in CONTROLLERS or CONTROLLERS[controller].ngs:
            known = ", ".join(name for name, one in CONTROLLERS.items() if not one.ngs)
            raise ControllerError(f"controller {controller!r}: takes one of {known}")
        if n_modes < 1 or not dt > 0 or not delay >= 1 or not 0 < scale < np.inf:
            given = f"n_modes = {n_modes}, dt = {dt}, delay = {delay}, scale = {scale}"
            raise ControllerError(f"{given}: take 1 or more, a time step, 1 or more frames, and a number above 0")
        from wfsobs.scenario import configfile  # needs a writer of TOML, which the core is installed without

        told = configfile.load_scenario(prior).replace({"sensors.lgs_rate": 1.0 / dt})
        own = told.replace({**(settings or {}), "control.delay": float(delay)})
        self._controller = design(controller, told, scenario=own, sampling=Sampling(n_modes, dt))
        self._scale = float(scale)

    def update(self, residual: ArrayLike) -> Array:
        """Return the command after a measurement of the residual, both (n_modes,); NaN is missing. Raises StepError."""
        return -self._controller.update(self._scale * np.asarray(residual, dtype=float)) / self._scale

    def reset(self) -> None:
        """Go back to before the first frame, the mirror at rest, and keep the design."""
        self._controller.reset()
