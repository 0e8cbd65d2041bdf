"""What a controller will leave of a loop that another one closes now, with an interval, from a record of that loop alone.

Plant and disturbance are identified (`wfsobs.identification`), the controllers are designed from what was found, and theory tells
what each leaves with plants and on spectra that are drawn from their uncertainty: a design fits the spectra that it was made for
better than any other. The mean square of the next record differs from that of the process by what a record of this length tells
of it, which the scatter over simulations of what was identified shows; it is distributed as gamma. If the controller missed
frames, the next one misses as many: mean squares are multiplied by the ratio of those of simulations with and without losses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from math import pi
from typing import Any

import numpy as np
import scipy
from scipy.special import gammaincinv

from wfsobs.closed_loop.design import Design, design
from wfsobs.closed_loop.envelope import residuals
from wfsobs.closed_loop.run import each_outcome
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.true_plant import TruePlant
from wfsobs.identification.identification import identify
from wfsobs.identification.plant import GroupPlant, identify_plant
from wfsobs.identification.plant_likelihood import LAGS, LONGEST
from wfsobs.identification.result import Identification, base_scenario
from wfsobs.pipeline import as_stated
from wfsobs.prior import Line, Lines
from wfsobs.progress import QUIET, Watch
from wfsobs.record import Record, RecordError, hold_last
from wfsobs.registry import name_list
from wfsobs.scenario import Scenario
from wfsobs.sensors.zernike import HIGHEST_ORDER, modes_up_to
from wfsobs.settings.values import SettingError
from wfsobs.simulation.loop import simulate
from wfsobs.simulation.true_spectra import true_spectra
from wfsobs.spectral.whittle import (
    Cells,
    MissingSamples,
    fast_length,
    find_outlying,
    fit_spectrum,
    inflation,
    periodogram,
    periodogram_frequencies,
    spectrum_information,
)
from wfsobs.typing import Array

DRAWS, RECORDS = 64, 8
"""Plants that are drawn, each with the spectra that the record has by it, and next records of each."""

HIGHEST, NEAR_LINE = 0.49, 4
"""Largest frequency of a drawn resonance, over the rate; bins on either side of an undamped line that do not count."""

LEFT = 0.05
"""Share of the change of the spectra from one plant to another that filled samples may lack."""

CRITICAL = 0.999
"""Largest damping ratio of a mirror that `TruePlant` takes."""

SEEN = 0.01
"""Magnitude of the response from which a measurement is affected by a command that is lost."""

SECTIONS = 32
"""Simulated records, whose scatter tells how well one knows its mean square."""

MOST_STEPS = 500_000
"""Steps of all of them: beyond, they are shorter than the record."""

START = 500
"""Steps that a filter takes to start."""

SURE = 0.95
"""Share of the draws in which a controller must be stable and better than the integrator."""

INTEGRATOR = "integrator"


@dataclass(frozen=True)
class ResidualPromise:
    """What one controller will leave.

    Attributes
    ----------
    controller : str
        Id.
    rms, low, high : tuple of float or None
        Residual of every mode and its 95 % interval [um]; None where not even half of the draws are stable.
    stable_share, better_share : float
        Of the draws, in which the loop is stable, and leaves less than the integrator, modes together.
    note : str
        Why there is none.
    """

    controller: str
    rms: tuple[float, ...] | None = None
    low: tuple[float, ...] | None = None
    high: tuple[float, ...] | None = None
    stable_share: float = 0.0
    better_share: float = 0.0
    note: str = ""

    @property
    def switch_on(self) -> bool:
        """Whether it may take the place of the integrator."""
        return min(self.stable_share, self.better_share) >= SURE


@dataclass(frozen=True)
class Promise:
    """Promises of some controllers.

    Attributes
    ----------
    scenario : Scenario
        What was identified; the controllers are designed from it.
    plant : tuple of GroupPlant
        What the commands do.
    matrix : Array
        The likeliest correction of each mode by the command of each, (n_modes, n_modes).
    noise : tuple of float
        Of the measurements [um].
    residuals : tuple of ResidualPromise
        One per controller.
    """

    scenario: Scenario
    plant: tuple[GroupPlant, ...]
    matrix: Array
    noise: tuple[float, ...]
    residuals: tuple[ResidualPromise, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, the keys of `wfsobs promise --json`: numbers in um, `switch_on` last of each controller."""
        controllers = [asdict(one) | {"switch_on": one.switch_on} for one in self.residuals]
        return {"matrix": self.matrix.tolist(), "noise": list(self.noise), "controllers": controllers}

    def left_in(self, record: Record) -> tuple[float, ...]:
        """Rms of the residual of every mode [um] in the record of another controller: of its measurements, less the noise."""
        squares = np.nanmean(np.square(record.without_outliers.y_lgs), axis=0) - np.square(self.noise)
        return tuple(np.sqrt(np.maximum(squares, 0.0)).tolist())


def make_promise(
    record: Record, scenario: Scenario, *, controllers: Sequence[str] | None = None, seed: int = 0, watch: Watch = QUIET
) -> Promise:
    """State what controllers will leave of the loop of a record, before one of them is switched on.

    Parameters
    ----------
    record : Record
        Measurements, and commands as they were given.
    scenario : Scenario
        All settings that are not identified; those of the integrator among them. Its `plant` is not used: that is identified.
    controllers : sequence of str, optional
        Ids; by default all that are linear. The integrator with its optimal gain is always there.
    seed : int
        Of the draws.
    watch : Watch, optional
        Receives the progress, and is asked whether to stop.

    Returns
    -------
    Promise
        One per controller. Commands of the controllers, which are designed for a plant without gain and rotation, go through
        the inverse of `matrix`.

    Raises
    ------
    RecordError
        The data do not decide delay, gain and rotation: a probe is needed (`wfsobs probe`). Or a mode is lacking.
    SettingError
        A controller is unknown, or the integrator is not stable.
    """
    if record.n_modes < (most := len(base_scenario(record.n_modes, record.dt, scenario).modes)):
        raise RecordError(f"the record has {record.n_modes} of {most} modes; a promise takes all of a radial order")
    groups = identify_plant(record, watch.silent)
    rng = np.random.default_rng(seed)
    likeliest, *others = draw_plants(groups, record.n_modes, rng)
    corrected = as_seen(record, likeliest)
    found = identify(corrected, watch=watch.silent)
    known = {
        "control.delay": likeliest.group_delay,
        **{f"plant.{name}": value for name, value in Scenario().plant.to_dict().items()},
    }

    stated = base_scenario(record.n_modes, record.dt, as_stated(corrected, scenario)).replace(known)

    def of(identification: Identification) -> Scenario:
        out = identification.scenario(stated)
        return out.replace({"vibration.source": "ar2"}) if out.vibration.source == "peaks" else out  # no cut-off

    told = of(found)
    names = name_list(controllers)
    plan = design(told, None if names is None else [INTEGRATOR, *names])
    length = min(record.n_steps, MOST_STEPS // SECTIONS)
    model = simulate(told.replace({"run.duration": (SECTIONS * length + START) * record.dt, "run.seed": seed}))
    lossy = with_losses(model, record, has_lost_lgs=any(group.loop_loss for group in groups))
    inverse = np.linalg.inv(likeliest.matrix)
    plants = [replace(one, matrix=one.matrix @ inverse) for one in others]
    outlying = np.column_stack([find_outlying(column) for column in corrected.z.T])
    clean = replace(record, y_lgs=np.where(outlying, np.nan, record.y_lgs))
    shares = measured_shares(found, as_seen(clean, likeliest).z)
    seen = (as_seen(clean, one).z for one in others)
    drawn = [of(draw_spectra(found, z, shares, rng)) for z in seen]
    spectra = [[true_spectra(one, mode) for mode in range(record.n_modes)] for one in drawn]
    left, out = dict[str, Array](), list[ResidualPromise]()
    common = rng.uniform(size=(DRAWS, RECORDS, 1))
    for i, name in enumerate(plan.laws):
        watch.check()
        laws = [one.law for one in plan.laws[name] if one.law is not None]
        if CONTROLLERS[name].predict is not None or CONTROLLERS[name].law is None:
            out += [ResidualPromise(name, note="no linear controller: no promise")] * (name in (names or ()))
            continue
        lacks_ngs = CONTROLLERS[name].ngs and record.y_ngs is None
        if lacks_ngs or len(laws) < record.n_modes or not all(law.stable for law in laws):
            notes = ["the record has no NGS"] if lacks_ngs else [one.note for one in plan.laws[name] if one.note]
            out.append(ResidualPromise(name, note=next(iter(notes), "not stable")))
            if name == INTEGRATOR:
                raise SettingError(f"{name}: {out[-1].note}: the others cannot be compared with it")
            continue
        squares = residuals(laws, plan.mirror, plants, spectra, watch) ** 2
        residual = _residual(model, plan, name, watch)
        if lossy is not None:
            whole, residual = residual, _residual(lossy, plan, name, watch)
            squares *= np.mean(residual**2, axis=0) / np.mean(whole**2, axis=0)
        shape = record.n_steps / length / _scatter(residual) ** 2
        left[name] = (squares[:, None] * gammaincinv(shape, common) / shape).reshape(-1, record.n_modes)
        out.append(_interval_of(name, left[name], left[INTEGRATOR]))
        watch.step((i + 1) / len(plan.laws))
    return Promise(told, groups, likeliest.matrix, tuple(mode.noise.value for mode in found.modes), tuple(out))


def with_losses(model: Record, record: Record, *, has_lost_lgs: bool) -> Record | None:
    """Return the model record with the losses of a record, repeated to its length; None without losses.

    has_lost_lgs : whether its controller missed the LGS measurements that are missing; NGS frames count as missed
    """
    lgs, ngs, y_lgs, y_ngs = np.isnan(record.y_lgs) & has_lost_lgs, record.ngs_gaps, model.y_lgs.copy(), model.y_ngs
    if not (lgs.any() or ngs.any()):
        return None
    y_lgs[lgs[np.arange(model.n_steps) % record.n_steps]] = np.nan
    if ngs.any() and y_ngs is not None and model.ratio is not None:
        y_ngs = y_ngs.copy()
        frames = y_ngs[model.ratio :: model.ratio]
        frames[np.resize(ngs, len(frames))] = np.nan
    return replace(model, y_lgs=y_lgs, y_ngs=y_ngs)


def _residual(model: Record, plan: Design, name: str, watch: Watch) -> Array:
    """Return what a stable controller leaves of a model record after the start, (n_steps - START, n_modes) [um]."""
    (outcome,) = each_outcome(model, plan, watch, [name])
    assert outcome.residual is not None
    return outcome.residual[START:]


def _interval_of(name: str, squares: Array, integrator: Array) -> ResidualPromise:
    stable, total = np.isfinite(squares).all(axis=1), squares.sum(axis=1)
    if stable.mean() < 0.5:
        return ResidualPromise(name, stable_share=float(stable.mean()), note="not stable with plants that the data allow")
    low, middle, high = np.sqrt(np.quantile(squares[stable], [0.025, 0.5, 0.975], axis=0))
    better = float((total < integrator.sum(axis=1)).mean()) if name != INTEGRATOR else 1.0
    return ResidualPromise(name, tuple(middle.tolist()), tuple(low.tolist()), tuple(high.tolist()), float(stable.mean()), better)


def draw_plants(groups: Sequence[GroupPlant], n_modes: int, rng: np.random.Generator) -> list[TruePlant]:
    """Return the most likely plant and DRAWS plants drawn from the covariance of its parameters.

    Modes with different delays are given their mean. Damping ratios are limited to CRITICAL.

    Raises
    ------
    RecordError
        A parameter is not identifiable, or the mirror has dynamics other than those of one second-order system.
    """
    delays, matrices, shape = np.zeros(1 + DRAWS), np.zeros((1 + DRAWS, n_modes, n_modes)), np.zeros((1 + DRAWS, 0))
    order = [mode.name for mode in modes_up_to(HIGHEST_ORDER)]
    for group in groups:
        names, n, fit = " and ".join(group.modes), len(group.modes), group.swinging
        if group.has_dynamics and (fit is None or len(groups) > 1):
            no = "not those of one mirror of second order" if fit is None else "and there are modes of several orders"
            raise RecordError(f"the mirror has dynamics ({names}), {no}, which no promise takes into account: do not switch on")
        numbers = [("delay", x) for x in group.delay] + [("gain", x) for x in group.gain]
        numbers += [("rotation", group.rotation)] if group.rotation is not None else []
        for what, number in numbers:
            if number.value is None:
                raise RecordError(f"the data do not decide the {what} ({names}): do not switch on; wfsobs probe designs a probe")
        mean = fit.theta if fit else np.array([number.value or 0.0 for _, number in numbers])
        theta = np.tile(mean, (1 + DRAWS, 1))
        spread = fit.covariance if fit else group.covariance
        theta[1:] = rng.multivariate_normal(mean, spread, DRAWS, check_valid="ignore")  # delays may be one
        delays += theta[:, :n].sum(axis=1) / n_modes
        block = theta[:, n : 2 * n, None] * np.eye(n)
        if group.rotation is not None:
            angle = theta[:, 2 * n]
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            block = np.moveaxis(turn, 2, 0) @ block
        columns = [order.index(name) for name in group.modes]
        matrices[np.ix_(range(1 + DRAWS), columns, columns)] = block
        shape = theta[:, len(numbers) :]
    if not shape.size:
        return [TruePlant(one, max(late, 1.0)) for one, late in zip(matrices, delays.tolist(), strict=True)]
    omega, damping = 2.0 * pi * np.exp(shape[:, 0]), np.minimum(np.exp(shape[:, 1]), CRITICAL)
    dead = np.maximum(delays - 2.0 * damping / omega, 1.0)
    each = zip(matrices, dead.tolist(), omega.tolist(), damping.tolist(), strict=True)
    return [TruePlant(one, late, 0.0, *mirror) for one, late, *mirror in each]


def measured_shares(identification: Identification, z: Array) -> list[Array]:
    """Return the measured share of every bin of the spectra of z, (n_steps, n_modes), an array (bins,) for each mode."""
    shares, dt, z = list[Array](), identification.dt, _cut(z)
    f = periodogram_frequencies(len(z), dt)
    for mode, column in zip(identification.modes, z.T, strict=True):
        missing, S = MissingSamples(np.isnan(column), dt, np.random.default_rng(0)), mode.spectrum.psd(f)
        shares.append(missing.measured_share(S, missing.draw_errors(S)) if missing.any else np.ones_like(f))
    return shares


def draw_spectra(identification: Identification, z: Array, shares: Sequence[Array], rng: np.random.Generator) -> Identification:
    """Return a model of the disturbance from the uncertainty of that which fits z, (n_steps, n_modes), best; undamped lines stay.

    It is fitted from what was identified, which the z of another plant is near to. shares : of `measured_shares`
    """
    modes, dt, z = [], identification.dt, _cut(z)
    f = periodogram_frequencies(len(z), dt)
    for mode, column, share in zip(identification.modes, z.T, shares, strict=True):
        missing, pure = MissingSamples(np.isnan(column), dt), [line for line in mode.prior.lines if not line.damping]
        keep = np.ones_like(f)
        for line in pure:
            keep[np.abs(f - line.frequency) < NEAR_LINE * f[0]] = 0.0
        resonances, s = [p.omega / (2.0 * pi) for p in mode.spectrum.resonances], mode.spectrum
        for _ in range(missing.rounds(LEFT)):
            S = s.psd(f)
            cells = Cells(f, periodogram(missing.fill(column, S), dt) + (1.0 - share) * S, keep, resonances, share)
            s = fit_spectrum(s, cells)
        information = spectrum_information(s, cells) / inflation(len(z))
        spread = np.linalg.cholesky(np.linalg.inv(information + np.eye(len(information))))  # none by more than e
        s = s.with_vector(s.vector + spread @ rng.standard_normal(len(spread)))
        lines = tuple(Line(min(p.omega / (2.0 * pi), HIGHEST / dt), p.damping, p.rms) for p in s.resonances)
        modes.append(replace(mode, prior=Lines(s.noise, dt, s.continuum, (*lines, *pure))))
    return replace(identification, modes=tuple(modes))


def _cut(z: Array) -> Array:
    """Return the rows of z that every plant has commands for, of a length whose transform is fast."""
    z = z[LONGEST + 1 :]
    return z[: fast_length(len(z))]


def as_seen(record: Record, plant: TruePlant) -> Record:
    """Return the record with its commands replaced by the correction that the plant makes of them, with a delay of one frame.

    Commands before the record are taken to equal the first one. A lost command is held, and the measurements that it affects
    are missing.
    """
    u, response = hold_last(record.u), plant.frame_response(LAGS)
    moved = scipy.signal.lfilter(response, [1.0], u - u[0], axis=0) + u[0]
    lost = np.convolve(np.isnan(record.u).any(axis=1), np.abs(response) > SEEN)[: len(u)] > 0
    return replace(record, u=np.where(lost[:, None], np.nan, moved @ plant.matrix.T), delay=1)


def _scatter(residual: Array) -> Array:
    """Return the relative standard deviation of the mean square of a section of a residual, per mode."""
    squares = np.square(residual[len(residual) % SECTIONS :]).reshape(SECTIONS, -1, residual.shape[1]).mean(axis=1)
    return np.asarray(squares.std(axis=0, ddof=1) / squares.mean(axis=0))
