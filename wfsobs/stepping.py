"""From the table to a loop: an observer or a controller by its id, designed once and then called frame by frame."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING, Any

from wfsobs.control.controllers import CONTROLLERS
from wfsobs.observers import OBSERVERS
from wfsobs.observers.step import Naming, StepError
from wfsobs.prior import LgsStars, Part, Prior, Spectra, Training
from wfsobs.priors_from.controllers import own_settings, plant_of
from wfsobs.priors_from.scenario import SHARED, as_sampled, observer_settings, prior_of
from wfsobs.priors_from.telemetry import as_training, told_by
from wfsobs.record import Record, Sampling, as_whole
from wfsobs.scenario import Scenario
from wfsobs.settings.values import SettingError
from wfsobs.signal.gate import GateSettings
from wfsobs.simulation.loop import simulate

if TYPE_CHECKING:
    from wfsobs.identification.result import Identification


def design(
    name: str,
    prior: Prior | Identification | Scenario,
    *,
    scenario: Scenario | None = None,
    sampling: Sampling | None = None,
    horizon: float = 0.0,
    train: Record | Training | None = None,
    gate: GateSettings | None = None,
) -> Any:
    """Design an observer or a controller for a loop that calls it frame by frame.

    Parameters
    ----------
    name : str
        Id of the observer or controller.
    prior : Prior, Identification or Scenario
        What it is told: numbers of its own, what `identify` found, or settings.
    scenario : Scenario, optional
        Its settings, and the mirror of a controller; by default those of `prior` where that is a scenario, else those of
        `Scenario()`.
    sampling : Sampling, optional
        Number of modes, time step, NGS ratio and delay of the loop; by default those of `scenario`. `record.sampling` has them.
    horizon : float
        Frames ahead that predictions are wanted for. Observers that are trained for one predict no other.
    train : Record or Training, optional
        Training data, for observers that learn beforehand: a record of the same loop. By default a simulation of `scenario`.
    gate : GateSettings, optional
        How it is kept from outliers, such as `scenario.gate`; by default not at all: a simulation has none.

    Returns
    -------
    StepObserver or StepController
        An observer receives measurements by `update` and is asked by `predict`; the `update` of a controller returns a command.

    Raises
    ------
    SettingError
        The name is unknown.
    StepError
        It cannot run frame by frame, or not for this horizon; the prior lacks a part that it needs, or has fewer modes.
    ValueError
        There is no such design for the prior; one line with the reason.

    Examples
    --------
    >>> import numpy as np, wfsobs
    >>> observer = wfsobs.design("kf-lgs", wfsobs.PRESETS["paper"]())
    >>> observer.update(np.array([0.1, np.nan]))
    >>> mean, sd = observer.predict(1, "turbulence")
    >>> mean.shape, sd.shape
    ((2,), (2,))
    >>> controller = wfsobs.design("lqg-kf-multi", wfsobs.PRESETS["paper"]())
    >>> controller.update(np.array([0.1, np.nan])).shape
    (2,)
    """
    if name not in OBSERVERS and name not in CONTROLLERS:
        known = ", ".join([*OBSERVERS, *CONTROLLERS])
        raise SettingError(f"design {name!r}: no such observer or controller; there are {known}")
    settings = scenario or (prior if isinstance(prior, Scenario) else Scenario())
    sampling = _whole_sampling(name, sampling or _sampling(prior, settings))
    if not horizon >= 0.0:
        raise StepError(f"{name}: horizon = {horizon:g}: takes 0 frames or more")
    if not isinstance(prior, (Prior, Scenario)) and len(prior.modes) < sampling.n_modes:
        raise StepError(f"{name}: the identification has {len(prior.modes)} modes, the loop has {sampling.n_modes}")
    settings = as_sampled(settings, sampling)
    told = prior if isinstance(prior, Prior) else settings
    if not isinstance(prior, Prior) and (scenario is not None or not isinstance(prior, Scenario)):
        told = as_sampled(told_by(prior, settings), sampling)
    if name in OBSERVERS:
        observer = OBSERVERS[name]
        own = observer_settings(observer, settings)
        given = prior_in(name, told, observer.parts(own), settings, sampling, train)
        with Naming(name):
            return observer.design(given, own, sampling, horizon, gate)
    if horizon:
        raise StepError(f"{name}: a controller has the horizon of its mirror, control.delay; leave horizon out")
    controller = CONTROLLERS[name]
    groups = own_settings(controller, settings)
    given = prior_in(name, told, controller.parts(groups), settings, sampling, train)
    with Naming(name):
        return controller.design(given, plant_of(settings), groups, sampling, gate)


def prior_in(
    name: str,
    source: Prior | Scenario,
    parts: tuple[Part, ...],
    scenario: Scenario,
    sampling: Sampling,
    train: Record | Training | None,
) -> Prior:
    """Return these parts of what is told, for the modes of the loop."""
    prior = source if isinstance(source, Prior) else prior_of(source.before_events, None, parts)
    prior = _of_modes(prior, name, sampling.n_modes)
    if Training in parts:
        given = train if prior.training is None else prior.training
        prior = replace(prior, training=_training(scenario, given, sampling))
    where = {**SHARED, Spectra: "spectra"}  # the parts whose absence has no reason of its own
    del where[LgsStars]  # known where the number of LGS changes
    for field in (where[part] for part in parts if part in where):
        if not getattr(prior, field) and not (field == "noise" and prior.model):  # a model may have the noise
            raise StepError(f"{name}: the prior has no {field}")
    if prior.training is not None and prior.training.y_lgs.shape[1] < sampling.n_modes:
        raise StepError(f"{name}: the training data have {prior.training.y_lgs.shape[1]} modes, the loop has {sampling.n_modes}")
    return prior


def _whole_sampling(name: str, sampling: Sampling) -> Sampling:
    """Return a sampling whose numbers of modes and steps are integers. Raises StepError."""
    n_modes, dt, ratio, delay = sampling
    whole = as_whole(n_modes), None if ratio is None else as_whole(ratio), as_whole(delay)
    if 0 in whole or not 0.0 < dt < inf:
        raise StepError(f"{name}: {sampling}: takes whole numbers of modes, ratio and delay from 1, and dt above 0")
    return Sampling(whole[0], dt, whole[1], whole[2])


def _sampling(prior: Prior | Identification | Scenario, scenario: Scenario) -> Sampling:
    """Return the sampling of what is told, where that has one, or of the scenario."""
    own = sampling_of(scenario)
    if isinstance(prior, Prior):
        n = max(len(prior.model), len(prior.lines))
        return own._replace(n_modes=n) if n else own
    return own if isinstance(prior, Scenario) else own._replace(n_modes=len(prior.modes), dt=prior.dt)


def sampling_of(scenario: Scenario) -> Sampling:
    """Return modes, step and NGS ratio of a scenario."""
    return Sampling(len(scenario.modes), scenario.dt, scenario.sensors.exposure_ratio)


def _of_modes(prior: Prior, name: str, n: int) -> Prior:
    """Return the prior of the first n modes. Raises StepError where it has fewer."""
    parts = {part: getattr(prior, part) for part in ("model", "noise", "lgs_error", "stars", "lines", "beams", "spectra")}
    for part, given in parts.items():
        if given and len(given) < n:
            raise StepError(f"{name}: the prior has {part} of {len(given)} modes, the loop has {n}")
    flow = None if prior.flow is None else prior.flow.first(n)
    asterism = None if prior.asterism is None else prior.asterism.first(n)
    return replace(prior, flow=flow, asterism=asterism, **{part: given[:n] for part, given in parts.items()})


def _training(scenario: Scenario, train: Record | Training | None, sampling: Sampling) -> Training:
    """Return training data without gaps."""
    if train is None:
        made = simulate(scenario).training
        assert made is not None
        return made
    if isinstance(train, Training):
        train = Record(train.y_lgs, train.u, sampling.dt, open_loop_y=train.open_loop_y, delay=sampling.delay)
    return as_training(train)
