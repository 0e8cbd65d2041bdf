"""A controller as a filter of SPECULA: `class: WfsobsFilter` with `add_modules: [wfsobs.peers]` in its YAML file.

SPECULA looks for a class in the module of its name. The class is made when it is asked for, as its base is SPECULA's.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
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


@cache
def make_filter() -> type:
    """Return the class that SPECULA runs, a `BaseFilter` of its own.

    Raises
    ------
    ImportError
        SPECULA is not installed.
    """
    from specula import cpuArray  # pyright: ignore[reportMissingImports]
    from specula.processing_objects.base_filter import BaseFilter  # pyright: ignore[reportMissingImports]

    class WfsobsFilter(BaseFilter):
        """A controller between the reconstructed modes and a mirror that subtracts its command (sign -1, SPECULA's own).

        Parameters
        ----------
        simul_params : SimulParams
            For the time step.
        controller : str
            Id; one without NGS.
        prior : str
            The file of `wfsobs identify --out`.
        n_modes : int
            Modes that come in.
        delay : float
            Frames before the command goes out; a mirror that is read with `:-1` adds one more, and the controller is designed
            for both.
        scale : float
            Micrometres per unit of the modes; SPECULA's modes are in nanometres.
        gain : float
            What the sensor shows of a mode, as measured: measurements are divided by it.
        target_device_idx, precision : int, optional
            Those of SPECULA.
        """

        def __init__(
            self,
            simul_params: Any,
            controller: str,
            prior: str,
            n_modes: int = 2,
            delay: float = 1.0,
            scale: float = 1e-3,
            gain: float = 1.0,
            target_device_idx: Any = None,
            precision: Any = None,
        ):
            super().__init__(n_modes, delay=delay, target_device_idx=target_device_idx, precision=precision)
            self._law = LoopController(n_modes, controller, prior, float(simul_params.time_step), delay=delay + 1.0, scale=scale)
            self._sensor_gain = gain

        def trigger_code(self) -> None:
            if not np.all(cpuArray(self._gain_mod) == 1.0):
                raise ControllerError("gain_mod: the controller knows its own commands and takes none")
            self.output_buffer[:, 0] = self.to_xp(
                self._law.update(cpuArray(self.delta_comm) / self._sensor_gain), dtype=self.dtype
            )

        def reset_states(self) -> None:
            super().reset_states()
            self._law.reset()

    return WfsobsFilter


def __getattr__(name: str) -> Any:
    """Return the filter when SPECULA asks for it."""
    if name != "WfsobsFilter":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return make_filter()
