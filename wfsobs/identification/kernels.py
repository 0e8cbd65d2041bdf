"""Kernels of Gaussian processes in time fitted to a record by likelihood, and the scenario that tells observers of them.

The logarithms of all positive numbers of the kernels and of the noise are moved to the maximum of the exact likelihood of z,
missing samples left out. Standard deviations are those of the curvature there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from math import exp, inf, nan, pi, sqrt
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import minimize

from wfsobs.identification.process import Number
from wfsobs.identification.result import MATCHED, base_scenario, model_settings, seen_z
from wfsobs.notebook import import_extra
from wfsobs.observers.gp import Kernel, Matern, Sho, SquaredExponentialInTime, Sum, log_likelihood
from wfsobs.prior import Line, Lines
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError
from wfsobs.registry import kind_of
from wfsobs.sensors.zernike import MODE_NAMES
from wfsobs.settings.values import check_kind
from wfsobs.signal.autoregressive import Ar2
from wfsobs.typing import Array

if TYPE_CHECKING:
    import pandas

    from wfsobs.scenario import Scenario

SHORTEST = 100
"""Minimum samples of a mode."""
FARTHEST = 1e4
"""Maximum ratio of a number to its start, and of its start to it."""
ARRIVED = 0.1
"""Maximum distance to the maximum, over the standard deviation."""
STEP = 1e-4
"""Of the differences between gradients that the curvature is of, in logarithms."""


@dataclass(frozen=True)
class KernelFit:
    """Fitted kernels of one mode.

    Attributes
    ----------
    name : str
        Name of the mode.
    turbulence, vibration, background : tuple of Kernel
        The kernels at the maximum of the likelihood.
    noise : Number
        Rms of z's white noise [um].
    numbers : dict of str to Number
        What was fitted, such as `vibration.0.omega`, in the unit of the kernel's number; std is NaN where the likelihood has no
        maximum in it.
    log_likelihood : float
        Of the samples.
    """

    name: str
    turbulence: tuple[Kernel, ...]
    vibration: tuple[Kernel, ...]
    background: tuple[Kernel, ...]
    noise: Number
    numbers: dict[str, Number]
    log_likelihood: float


@dataclass(frozen=True)
class KernelFits:
    """Fitted kernels of a record: one fit per mode, at steps of `dt` [s]."""

    modes: tuple[KernelFit, ...]
    dt: float

    def to_dataframe(self) -> pandas.DataFrame:
        """Return a pandas table: a row per mode and number that was fitted. Raises ImportError without pandas."""
        rows = [(mode.name, name, *number) for mode in self.modes for name, number in mode.numbers.items()]
        return import_extra("pandas", "arrays").DataFrame(rows, columns=["mode", "number", "value", "std"])

    def scenario(self, base: Scenario | None = None) -> Scenario:
        """Return a scenario that tells `gp-lgs` and `gp-both` of the kernels.

        Parameters
        ----------
        base : Scenario, optional
            All other settings, such as the slow error of the LGS and the noise of the NGS, which z alone does not tell.

        Returns
        -------
        Scenario
            The scenario. The background is the same in all modes: the mean of its variances and of its times.

        Raises
        ------
        ValueError
            The settings have no such kernel: turbulence is a sum of `Sho`, of `Matern` of one order, or of
            `SquaredExponentialInTime`, vibration one of `Sho`, the background one `Matern` of order 1.
        """
        kinds = {_kind(kernel) for mode in self.modes for kernel in mode.turbulence} or {"as told"}
        colours = [k for mode in self.modes for k in mode.background if isinstance(k, Matern) and k.order == 1]
        counts = [len(mode.background) for mode in self.modes]
        is_one = max(counts) < 2 and len(colours) == sum(counts)
        if len(kinds) > 1 or not is_one or not all(isinstance(k, Sho) for mode in self.modes for k in mode.vibration):
            raise ValueError(
                "observers take turbulence of one kind of kernels, vibration of Sho, and a background Matern of order 1"
            )
        changes: dict[str, Any] = {"gp.turbulence": kinds.pop(), "gp.background_rms": 0.0}
        if colours:
            changes["gp.background_rms"] = sqrt(sum(k.rms**2 for k in colours) / len(self.modes))
            changes["gp.background_scale"] = 1e3 * float(np.mean([k.scale for k in colours]))
        out = base_scenario(len(self.modes), self.dt, base)
        return out.replace(changes | model_settings([_as_lines(mode, self.dt) for mode in self.modes], out) | MATCHED)


def fit_kernels(
    record: Record,
    *,
    turbulence: Sequence[Kernel] = (),
    vibration: Sequence[Kernel] = (),
    background: Sequence[Kernel] = (),
    noise: float = 0.01,
    watch: Watch = QUIET,
) -> KernelFits:
    """Fit a sum of kernels to every mode of a record, by the likelihood of its pseudo-open-loop measurement z.

    Parameters
    ----------
    record : Record
        Measurements and commands; NaN is a missing sample.
    turbulence, vibration, background : sequence of Kernel
        Kernels of `wfsobs.observers.gp` whose sum z is, but for white noise, with the numbers where the search starts:
        rms [um], times [s], natural frequencies [rad/s]. The likelihood does not know which is which; observers do.
    noise : float
        Rms of the white noise where the search starts [um].
    watch : Watch, optional
        Receives the progress, and is asked before every evaluation whether to stop.

    Returns
    -------
    KernelFits
        Kernels and noise of every mode, with standard deviations.

    Raises
    ------
    RecordError
        The record is too short or infinite.
    ValueError
        There is no kernel, or one that cannot be fitted, or the search would start from a number that is not above 0.
    Cancelled
        `watch` asks to stop.
    """
    check_kind("fit_kernels", record, Record)
    z = seen_z(record)
    if np.isfinite(z).sum(axis=0).min(initial=len(z)) < SHORTEST:
        raise RecordError(f"a mode has fewer than {SHORTEST} samples")
    names = MODE_NAMES[: z.shape[1]]
    parts = {"turbulence": turbulence, "vibration": vibration, "background": background}
    parts = {part: _kernels(part, kernels) for part, kernels in parts.items()}
    _check_start("noise", noise)
    fits = []
    for i, name in enumerate(names):
        watch.step(i / len(names))
        fits.append(_fit_mode(name, parts, noise, record.dt, z[:, i], watch))
    return KernelFits(tuple(fits), record.dt)


def fitted_numbers(kernel: Kernel) -> list[str]:
    """Return the names of the numbers of a kernel that can be fitted; ValueError where there is none."""
    found = [field.name for field in fields(kernel) if field.type == "Number"]
    if not found:
        raise ValueError(f"{type(kernel).__name__} cannot be fitted; a sum is given as a sequence of its parts")
    return found


def _kernels(part: str, kernels: Iterable[Kernel]) -> tuple[Kernel, ...]:
    """Return the kernels of a part. Raises ValueError, one line, where the search cannot start from them."""
    if not isinstance(kernels, Iterable):
        raise ValueError(f"{part}: takes a sequence of kernels, not {kind_of(kernels)}")
    kernels = tuple(kernels)
    for i, kernel in enumerate(kernels):
        if isinstance(kernel, type) or not hasattr(kernel, "state_space"):
            raise ValueError(f"{part}.{i}: takes a kernel, not {kind_of(kernel)}")
        for name in fitted_numbers(kernel):
            _check_start(f"{part}.{i}.{name}", getattr(kernel, name))
    return kernels


def _check_start(name: str, value: Any) -> None:
    if not isinstance(value, (int, float, np.integer, np.floating)) or not 0.0 < value < inf:
        raise ValueError(f"{name} = {value}: takes a number above 0 to start from")


def _fit_mode(name: str, parts: dict[str, tuple[Kernel, ...]], noise: float, dt: float, z: Array, watch: Watch) -> KernelFit:
    numbered = [(f"{part}.{i}", kernel) for part, all_ in parts.items() for i, kernel in enumerate(all_)]
    if not numbered:
        raise ValueError("there is no kernel to fit")
    begin = {f"{place}.{field}": getattr(kernel, field) for place, kernel in numbered for field in fitted_numbers(kernel)}
    begin["noise"] = noise
    start = np.log([*begin.values()])

    def at(x: Array) -> dict[str, tuple[Kernel, ...]]:
        values = iter(np.exp(x).tolist())  # in the order of `begin`
        return {
            part: tuple(replace(kernel, **{field: next(values) for field in fitted_numbers(kernel)}) for kernel in all_)
            for part, all_ in parts.items()
        }

    def model(x: Array) -> tuple[Kernel, Any]:
        return Sum(tuple(kernel for all_ in at(x).values() for kernel in all_)), np.exp(x[-1])

    def cost(x: Array) -> tuple[float, Array]:
        watch.check()
        value, gradient = log_likelihood(model, x, dt, z)
        return -value, -gradient

    bounds = [(x - np.log(FARTHEST), x + np.log(FARTHEST)) for x in start]
    found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds)
    std = _standard_deviations(lambda x: cost(x)[1], found.x)
    best = zip(begin, found.x.tolist(), std.tolist(), strict=True)
    numbers = {number: Number(exp(value), exp(value) * spread) for number, value, spread in best}
    return KernelFit(name, noise=numbers["noise"], numbers=numbers, log_likelihood=-float(found.fun), **at(found.x))


def _standard_deviations(gradient: Callable[[Array], Array], x: Array) -> Array:
    """Return those of the logarithms, from the curvature at the minimum; NaN where it is none, or a step of Newton leads away."""
    steps = STEP * np.eye(len(x))
    curvature = np.array([(gradient(x + step) - gradient(x - step)) / (2.0 * STEP) for step in steps])
    curvature = 0.5 * (curvature + curvature.T)
    if np.linalg.eigvalsh(curvature).min() <= 0:
        return np.full(len(x), nan)
    std = np.sqrt(np.diag(np.linalg.inv(curvature)))
    return np.where(np.abs(np.linalg.solve(curvature, gradient(x))) < ARRIVED * std, std, nan)


KINDS = {1: "matern-1/2", 3: "matern-3/2", 5: "matern-5/2"}


def _kind(kernel: Kernel) -> str:
    """Return the kind of a turbulence kernel among the settings, or its class."""
    if isinstance(kernel, Sho):
        return "as told"
    if isinstance(kernel, Matern):
        return KINDS[kernel.order]
    return "squared-exponential" if isinstance(kernel, SquaredExponentialInTime) else type(kernel).__name__


def _as_lines(fit: KernelFit, dt: float) -> Lines:
    """Return the model of a mode as an observer is told it: a kernel by its rms and corner."""
    lines = tuple(Line(k.omega / (2.0 * pi), k.damping, k.rms) for k in fit.vibration if isinstance(k, Sho))
    return Lines(fit.noise.value, dt, tuple(_process(k, dt) for k in fit.turbulence), lines)


def _process(kernel: Kernel, dt: float) -> Ar2:
    if isinstance(kernel, Sho):
        return Ar2(kernel.omega, kernel.damping, kernel.rms, dt)
    if isinstance(kernel, Matern):
        return Ar2(sqrt(kernel.order) / kernel.scale, 1.0, kernel.rms, dt)
    assert isinstance(kernel, SquaredExponentialInTime)
    return Ar2(1.0 / kernel.scale, 1.0, kernel.rms, dt)
