"""From the table to a loop: an observer or a controller by its id, designed once and then called frame by frame."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from wfsobs.observers import OBSERVERS
from wfsobs.observers.missing import fill_missing
from wfsobs.observers.step import StepError, StepObserver
from wfsobs.prior import Prior, Training
from wfsobs.priors_from.identification import told_by
from wfsobs.priors_from.scenario import observer_settings, prior_of
from wfsobs.record import Record, Sampling
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError
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
) -> StepObserver:
    """Design an observer for a loop that calls it frame by frame.

    Parameters
    ----------
    name : str
        Id of the observer.
    prior : Prior, Identification or Scenario
        What it is told: numbers of its own, what `identify` found, or settings.
    scenario : Scenario, optional
        Its settings; by default those of `prior` where that is a scenario, else those of `Scenario()`.
    sampling : Sampling, optional
        Number of modes, time step, NGS ratio and delay of the loop; by default those of `scenario`. `record.sampling` has them.
    horizon : float
        Frames ahead that predictions are wanted for. Observers that are trained for one predict no other.
    train : Record or Training, optional
        Training data, for observers that learn beforehand: a record of the same loop. By default a simulation of `scenario`.

    Returns
    -------
    StepObserver
        To be told the measurements by `update`, and asked by `predict`.

    Raises
    ------
    SettingError
        The observer is unknown.
    StepError
        It cannot run frame by frame, or not for this horizon.
    ValueError
        The prior lacks what it needs; one line with the reason.

    Examples
    --------
    >>> import numpy as np, wfsobs
    >>> observer = wfsobs.design("kf-lgs", wfsobs.PRESETS["paper"]())
    >>> observer.update(np.array([0.1, np.nan]))
    >>> mean, sd = observer.predict(1, "turbulence")
    >>> mean.shape, sd.shape
    ((2,), (2,))
    """
    if name not in OBSERVERS:
        raise SettingError(f"observer {name!r}: no such observer; there are {', '.join(OBSERVERS)}")
    observer = OBSERVERS[name]
    settings = scenario or (prior if isinstance(prior, Scenario) else Scenario())
    sampling = sampling or _sampling(prior, settings)
    settings = as_sampled(settings, sampling)
    own = observer_settings(observer, settings)
    parts = (*observer.prior, *observer.asks(own))
    if not isinstance(prior, Prior):
        told = settings if scenario is None and isinstance(prior, Scenario) else as_sampled(told_by(prior, settings), sampling)
        prior = prior_of(told.before_events, None, parts)
    prior = _of_modes(prior, name, sampling.n_modes)
    if Training in parts and prior.training is None:
        prior = replace(prior, training=_training(settings, train))
    return observer.design(prior, own, sampling, horizon)


def _sampling(prior: Prior | Identification | Scenario, scenario: Scenario) -> Sampling:
    """Return the sampling of what is told, where that has one, or of the scenario."""
    own = Sampling(len(scenario.modes), scenario.dt, scenario.sensors.exposure_ratio)
    if isinstance(prior, Prior):
        n = max(len(prior.model), len(prior.lines))
        return own._replace(n_modes=n) if n else own
    return own if isinstance(prior, Scenario) else own._replace(n_modes=len(prior.modes), dt=prior.dt)


def as_sampled(scenario: Scenario, sampling: Sampling) -> Scenario:
    """Return the scenario with the time step and exposure ratio of a loop."""
    changes: dict[str, float] = {}
    if abs(sampling.dt * scenario.sensors.lgs_rate - 1.0) > 1e-12:
        changes["sensors.lgs_rate"] = 1.0 / sampling.dt
    if sampling.ratio is not None and sampling.ratio != scenario.sensors.exposure_ratio:
        changes["sensors.exposure_ratio"] = sampling.ratio
    return scenario.replace(changes) if changes else scenario


def _of_modes(prior: Prior, name: str, n: int) -> Prior:
    """Return the prior of the first n modes. Raises StepError where it has fewer."""
    parts = {"model": prior.model, "lgs_error": prior.lgs_error, "lines": prior.lines, "spectra": prior.spectra}
    for part, given in parts.items():
        if given and len(given) < n:
            raise StepError(f"{name}: the prior has {part} of {len(given)} modes, the loop has {n}")
    return replace(prior, **{part: given[:n] for part, given in parts.items()})


def _training(scenario: Scenario, train: Record | Training | None) -> Training:
    if train is None:
        made = simulate(scenario).training
        assert made is not None
        return made
    if isinstance(train, Training):
        return train
    whole = fill_missing(train, Prior())
    return Training(whole.y_lgs, whole.u, whole.open_loop_y).copy()
