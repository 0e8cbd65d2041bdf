"""A controller as a filter of SPECULA: `class: WfsobsFilter` with `add_modules: [wfsobs.peers]` in its YAML file.

SPECULA looks for a class in the module of its name. The class is made when it is asked for, as its base is SPECULA's.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from wfsobs.peers.controller import ControllerError, LoopController


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
