"""`wfsobs attach`."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import click
import numpy as np
from click.core import ParameterSource

from wfsobs.cli.options import (
    POSITIVE,
    FiniteRange,
    json_option,
    ngs_options,
    ngs_wiring,
    refuse_options,
    scenario_options,
    stream_elements,
    told_scenario,
)
from wfsobs.cli.show import print_json, print_note
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.supervisor import SupervisedController, Supervision
from wfsobs.observers import OBSERVERS
from wfsobs.observers.step import StepError, StepObserver
from wfsobs.prior import LgsError, Lines, Model, Part, Training
from wfsobs.priors_from.controllers import own_settings
from wfsobs.priors_from.scenario import observer_settings
from wfsobs.record import DELAY, Sampling
from wfsobs.scenario import Scenario
from wfsobs.settings.group import SettingError
from wfsobs.stepping import design, prior_in
from wfsobs.streams.attach import Attachment, CommandStream, ControllerAttachment
from wfsobs.streams.follower import StreamFollower
from wfsobs.streams.network import Publication, Subscription, is_address
from wfsobs.streams.shared_image import SharedImage, StreamError, stream_path
from wfsobs.streams.wiring import LIMIT, STUCK, Fallback, NgsStream, Safety, Wiring, check_elements
from wfsobs.units import UNITS, micrometres_per

OBSERVERS_ALONE = ("name", "shadow", "commands", "delay", "fallback")
"""Options that a controller does not take."""


@click.command()
@scenario_options
@click.option(
    "--in",
    "source",
    required=True,
    metavar="STREAM",
    help="Pseudo-open-loop modes, or residuals beside --commands or for --controller: a name, a path, or tcp://host:port.",
)
@click.option(
    "--commands",
    metavar="STREAM",
    help="Commands beside --in, which then holds residual measurements: their pseudo-open-loop is made here.",
)
@click.option(
    "--command-delay",
    type=FiniteRange(1, 50),
    default=DELAY,
    metavar="N",
    help="Frames from a command to the first measurement that sees it, such as 1.5.",
)
@click.option("--command-gain", type=FiniteRange(-1e12, 1e12), default=1.0, metavar="G", help="What the mirror does of them.")
@click.option("--out", "sink", metavar="STREAM", help="Where what is sent goes, made if there is none; or tcp://*:port.")
@click.option("--shadow", is_flag=True, help="Write nothing.")
@click.option("--prior", metavar="FOUND.toml", help="Prior of the observer: the file of `wfsobs identify --out`.")
@click.option("--observer", "name", default="kf-multi", metavar="ID", help="Observer that runs.")
@click.option("--controller", metavar="ID", help="Close the loop: a controller under supervision, its commands go to --out.")
@click.option(
    "--modes",
    metavar="I,J,...",
    help="Elements of a frame, from 0, that are its modes; by default the first ones.",
)
@ngs_options
@click.option("--unit", type=click.Choice(UNITS), default="um", help="Unit of the streams.")
@click.option(
    "--delay",
    type=FiniteRange(1, 100),
    default=1.0,
    metavar="D",
    help="Frames from the newest measurement to the one that the estimate is for.",
)
@click.option("--fallback", type=click.Choice(["zero", "hold"]), default="zero", help="Output in place of an estimate.")
@click.option(
    "--limit",
    type=FiniteRange(0, 1e12, min_open=True),
    metavar="X",
    help=f"Magnitude that nothing sent may exceed; by default {LIMIT:g} times the rms of a measurement by the prior.",
)
@click.option("--stuck", type=FiniteRange(1e-3, 60), default=STUCK, metavar="S", help="Time without a frame.")
@click.option(
    "--semaphore",
    type=click.IntRange(0),
    metavar="N",
    help="Wait for this one of the stream, or a free one; else the counter is watched.",
)
@click.option("--seconds", type=POSITIVE, metavar="S", help="Duration; by default until Ctrl+C.")
@json_option("At the end print one JSON object.")
def attach(
    scenario: Scenario,
    source: str,
    commands: str | None,
    command_delay: float,
    command_gain: float,
    sink: str | None,
    shadow: bool,
    prior: str | None,
    name: str,
    controller: str | None,
    modes: str | None,
    ngs: str | None,
    ngs_modes: str | None,
    ngs_lag: int,
    unit: str,
    delay: float,
    fallback: Fallback,
    limit: float | None,
    stuck: float,
    semaphore: int | None,
    seconds: float | None,
    as_json: bool,
) -> None:
    """Run an observer or a controller on the streams of a running loop, in shared memory or by ZeroMQ (docs/streams.md)."""
    if bool(sink) == shadow:
        raise SettingError("attach: takes --out STREAM, or --shadow to write nothing")
    if controller is not None:
        refuse_options(OBSERVERS_ALONE, "applies to observers; leave it out beside --controller")
    elif commands is None:
        refuse_options(("command_delay", "command_gain"), "only with --commands or --controller")
    if ngs is None:
        refuse_options(("ngs_modes", "ngs_lag"), "only with --ngs")
    scenario = told_scenario(prior, scenario)
    elements = stream_elements(modes, len(scenario.modes))
    is_told = click.get_current_context().get_parameter_source("command_delay") is ParameterSource.COMMANDLINE
    scenario = scenario.replace({"control.delay": command_delay}) if controller and is_told else scenario
    per_unit = micrometres_per(unit, scenario.telescope.diameter)
    try:
        given = _open_source(source)
        check_elements(given, elements)
        if semaphore is not None:
            given.semaphore(semaphore)  # refused before --out is made
        spread = _spread(controller or name, scenario, len(elements))
        warm_up = max(round(scenario.run.warm_up / scenario.dt), 1)
        limits = Safety(fallback, None if limit is None else limit * per_unit, calm=warm_up)
        wiring = Wiring(elements, per_unit, delay, spread, limits, warm_up, stuck, semaphore, scenario.gate)
        second = None
        if ngs is not None:
            ngs_is = ngs_wiring(scenario, len(elements), ngs_modes, unit, ngs_lag, stuck)
            second = NgsStream(_open_source(ngs), ngs_is, _say)
        third = None
        if commands is not None:
            third = CommandStream(_open_source(commands), elements, np.array(command_gain * per_unit), command_delay)
        attachment: StreamFollower
        if controller is None:
            observer = _design(name, scenario, len(elements), delay - 1, ngs is not None)
            taken = _open_sink(sink, given, ngs, commands)
            attachment = Attachment(given, taken, observer, wiring, _say, second, third)
        else:
            law = _supervise(controller, scenario, wiring, command_gain, ngs is not None)
            taken = _open_sink(sink, given, ngs, commands)
            attachment = ControllerAttachment(given, taken, law, command_gain, _sent_last(taken, wiring), wiring, _say, second)
        with _stop_signals() as stop:
            attachment.run(seconds or np.inf, report=_say, stop=stop)
    except (StreamError, StepError) as error:
        raise SettingError(f"attach: {error}") from None
    if as_json:
        refused = {"refused": given.n_refused} if isinstance(given, Subscription) else {}
        print_json({**attachment.summary(), **refused})


def _say(line: str) -> None:
    print_note(f"attach: {line}")


def _open_source(name: str) -> SharedImage | Subscription:
    if not is_address(name):
        return SharedImage(stream_path(name))
    return click.get_current_context().with_resource(closing(Subscription(name, _say)))


def _open_sink(name: str | None, source: SharedImage | Subscription, *others: str | None) -> SharedImage | Publication | None:
    """Open the stream that is written, and make it where there is none; None for none."""
    if name is None:
        return None
    dtype = source.header.dtype.name if isinstance(source, SharedImage) else source.dtype
    if is_address(name):
        made = click.get_current_context().with_resource(closing(Publication(name, source.n, dtype)))
        _say(f"{made.path}: what is sent goes out here")
        return made
    path = stream_path(name)
    if path.resolve() in {stream_path(one).resolve() for one in (source.path, *others) if one is not None}:
        raise SettingError(f"--out {name}: is a stream that is read")
    if path.exists():
        return SharedImage(path)
    if isinstance(source, Subscription):
        return SharedImage.create(path, (source.n,), dtype=dtype)
    return SharedImage.create(path, source.header.shape, dtype=dtype, layout=source.header.layout)


def _check_kind(name: str, parts: tuple[Part, ...], has_ngs: bool, needs_ngs: bool) -> None:
    """Raise StepError for what learns from a record, which a stream has not, and where the NGS is missing or not taken."""
    if Training in parts:
        raise StepError(f"{name}: learns from a record beforehand; takes one with a model, such as kf-multi or lqg-kf-multi")
    if has_ngs != needs_ngs:
        raise StepError(
            f"{name}: takes no NGS; leave --ngs out" if has_ngs else f"{name}: takes an NGS; name its stream by --ngs"
        )


def _supervise(name: str, scenario: Scenario, wiring: Wiring, gain: float, has_ngs: bool) -> SupervisedController:
    """Return a supervised controller, whose commands are within the limits of the scenario and of the wiring."""
    CONTROLLERS.check_ids([name])
    declared = CONTROLLERS[name]
    _check_kind(name, declared.parts(own_settings(declared, scenario)), has_ngs, declared.ngs)
    if not gain:
        raise SettingError("--command-gain 0: the mirror does nothing")
    largest = float(wiring.largest.min()) * (1.0 if wiring.safety.largest is None else abs(gain))
    stroke = min(scenario.control.stroke or np.inf, largest)
    told = scenario.replace({"control.stroke": stroke})
    sampling = Sampling(len(wiring.elements), scenario.dt, scenario.sensors.exposure_ratio if has_ngs else None)
    stepper = design(name, told, sampling=sampling, gate=scenario.gate)
    return SupervisedController(stepper, Supervision(scenario.control.fallback_gain, scenario.control.leak))


def _sent_last(sink: SharedImage | Publication | None, wiring: Wiring) -> np.ndarray:
    """Return the commands that are there, (n_modes,) [unit of the stream]; 0 where that is not known."""
    found = sink.read() if isinstance(sink, SharedImage) else None
    return np.zeros(len(wiring.elements)) if found is None else found[1][list(wiring.elements)]


def _design(name: str, scenario: Scenario, n_modes: int, horizon: float, has_ngs: bool) -> StepObserver:
    OBSERVERS.check_ids([name])
    declared = OBSERVERS[name]
    if "y_stars" in declared.needs:
        raise StepError(f"{name}: takes every LGS by itself; the stream is of them together")
    _check_kind(name, declared.parts(observer_settings(declared, scenario)), has_ngs, "y_ngs" in declared.needs)
    sampling = Sampling(n_modes, scenario.dt, scenario.sensors.exposure_ratio if has_ngs else None)
    observer = design(name, scenario, sampling=sampling, horizon=horizon)
    if observer.estimator.needs_command:
        raise StepError(f"{name}: its windows hold commands, which the stream has not; set its inputs to z")
    return observer


def _spread(name: str, scenario: Scenario, n_modes: int) -> np.ndarray:
    """Return the rms of a pseudo-open-loop measurement by the prior, (n_modes,) [um]."""
    known = prior_in(name, scenario, (Model, Lines, LgsError), scenario, Sampling(n_modes, scenario.dt), None)
    noise = np.array([mode.lgs_noise for mode in known.model])
    disturbance = [(*lines.turbulence, *lines.lines, *lines.continuum) for lines in known.lines]
    parts = [[one.rms for one in (*of_mode, error.process)] for of_mode, error in zip(disturbance, known.lgs_error, strict=True)]
    return np.array([np.linalg.norm([sd, *rms]) for sd, rms in zip(noise, parts, strict=True)])


@contextmanager
def _stop_signals() -> Iterator[Callable[[], bool]]:
    """Turn Ctrl+C and SIGTERM into a wish to stop, so that the last thing sent is the safe output."""
    wishes: list[int] = []
    before = {number: signal.signal(number, lambda given, _: wishes.append(given)) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(wishes)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
