"""Theoretical limits: the minimum error of any causal linear observer, by the information that it has.

Every bound is that of the true spectra and noises of a scenario (`true_spectra`), after an infinitely long record. For Gaussian
signals no observer is better, linear or not, unless it has more information, or remembers a record of random phases, which is
periodic (`turbulence`).

- *lgs*: all measurements of the mean of the LGS in one mode, or of what `sensors.lgs_combination` makes of them: the error of the
  Wiener filter (`wiener`). Undamped lines are then known. A record is neither infinitely long nor the mean of all:
  `PeriodicError.interval` is the range of the rms of an optimal observer of all samples since the start, in 95 % of records.
- *both*: the NGS frames, too (`sensor_array`). The error is periodic: least when an NGS frame has just been read.
- *stars*: every LGS by itself, and the NGS (`sensor_array`). Where all stars see the same turbulence, but for independent errors,
  their mean has all the information that they have, and the bound is that of both.
- *modes*, *both-modes*, *asterism*: the same from all modes together. Their error is what the best weights of very many means
  of the past leave, exponential ones of all times in a geometric series, turning ones among them (`signal.joint_states`): such
  means come as near to any function of the past as one likes. More of them change the figures of the preset `higher-orders` by
  0.1 % at most; three times as many frequencies in the sums, and more about the lines, those of it, `ut4` and `galacsi-nfm` by
  0.06 %. Lines are as wide as those of the record at least; near narrow ones what is found is up to 2.5 % above the minimum, as
  single modes show, whose bound is known: a row of a table is the lesser of the two.

The bound of the closed loop is the minimum residual of any causal linear controller of a mirror without limits. With a delay of
whole frames it is the minimum error of a prediction. With a fraction f of a frame besides, the mirror makes
c[k] = (1 - f) u[k] + f u[k-1] of the commands. Up to half a frame any c follows from commands that stay finite, and the fraction
costs nothing. Beyond, u[k-1] = (1/f) sum_j w^j c[k+j], w = -(1 - f) / f, has to be known at step k - 1: what step k brings
to this sum cannot be used. The nearest c that brings nothing leaves, beside the error of the whole frames,

    (1 - w^2) (variance of sum_j w^j phi[k+j] given step k - 1, less that given step k),

which for f = 1 is what one frame more costs (inner-outer factorisation of the mirror, by steps).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from math import inf, log, pi

import numpy as np
from scipy import fft
from scipy.special import diric, gammaincinv

from wfsobs.evaluation.result import JOINT_BOUNDS
from wfsobs.evaluation.scores import (
    BOUND,
    BOUND_ASTERISM,
    BOUND_BOTH,
    BOUND_MODES,
    BOUND_STARS,
    BOUNDS,
    COMMON_BOUNDS,
    SCORED,
    Score,
)
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS, TURBULENCE
from wfsobs.observers.kalman.joint_model import AsterismModel, flow_model
from wfsobs.prior import Asterism, Flow, FlowOfBoth, Lines
from wfsobs.priors_from.scenario import has_prior, prior_of
from wfsobs.record import TOTAL, Record
from wfsobs.scenario import Scenario
from wfsobs.settings.values import check_kind
from wfsobs.signal.joint_states import running_means
from wfsobs.signal.sensor_array import FastSensors, SlowSensor, SlowTarget, variance_from_frames, variance_from_sensors
from wfsobs.signal.spectrum import rms
from wfsobs.signal.wiener import Complex, advance_spectrum, circle_mean, degrees_of_freedom, explained_variance, in_two_threads
from wfsobs.simulation.disturbance import line_width
from wfsobs.simulation.mode_spectra import AXIS, FIRST, LGS, NGS, StarSpectra, are_coupled, star_spectra
from wfsobs.simulation.sensing import MEAN, stars_differ
from wfsobs.simulation.true_spectra import UNRESOLVED, CausalEstimate, TrueSpectra, has_known_spectra, true_spectra
from wfsobs.typing import Array

INFORMATION: Mapping[str, str] = dict(zip(("lgs", "both", "stars", "modes", "both-modes", "asterism"), BOUNDS, strict=True))
"""Information that an observer can have -> row of its bound."""

ALONE: dict[str, str] = dict(zip(BOUNDS[3:], BOUNDS[:3], strict=True))
"""Row of the bound of all modes together -> that of every mode by itself."""

NO_BOUND = f"no bound: {UNRESOLVED}"

SHARE = 0.95
"""Share of the records whose rms lies in an interval."""

MOST_PAST = 4000
"""Measurements up to which their gain is computed.

The remaining gain falls with the inverse of their number, as it does for undamped lines.
"""

LEARNT = 5e-3
"""Share of the minimum error; where more measurements bring no more than this, nothing is left to learn."""

FREED = 31 * 2**20
"""Size of the largest array whose memory is used again; the C library of Linux allows 32 MiB [bytes]."""

MEANS = running_means([0.0, *(1.6**i for i in range(20))], turns=(0.0, 2.0, 4.0, 6.0))
"""Means over 1 to 7600 steps, of modes of the LGS together."""

MEANS_OF_BOTH, FRAME_MEANS = (running_means([0.0, *(2.0**i for i in range(n))], (0.0, 2.0, 4.0)) for n in (12, 9))
"""Means over 1 to 2048 steps and over 1 to 256 frames, of modes of all sensors together."""

TRUE_MODEL: dict[str, str | int] = {
    "kalman.process_noise": "matched",
    "kalman.measurement_noise": "matched",
    "multipeak.turbulence_order": 3,
}
"""Settings of the filters whose states stand beside the means: a row does not depend on what the observers are set to."""


@dataclass(frozen=True)
class PeriodicError:
    """Error of an estimate that repeats with the NGS frames.

    Attributes
    ----------
    variance : Array
        Variance in a step with an NGS frame, one step later, ..., (ratio,) [um^2]; of the LGS alone the same at all steps, (1,).
    covariance : Array
        Of the bound of the LGS: autocovariance after an infinitely long record, (n_lags,) [um^2].
    transient : Array
        The same: variance after 0, 1, 2, ... measurements, as far as it falls by more than LEARNT, (n_past,) [um^2].
    n_lines : float
        The same: number of undamped lines, whose phases and amplitudes are learnt from the record; of unlike ones, that of equal
        ones whose errors together scatter as much.
    """

    variance: Array
    covariance: Array = field(default_factory=partial(np.empty, 0))
    transient: Array = field(default_factory=partial(np.empty, 0))
    n_lines: float = 0.0

    @property
    def rms(self) -> float:
        """Rms over all steps [um]."""
        return float(np.sqrt(self.variance.mean()))

    @property
    def phases(self) -> tuple[float, ...]:
        """Rms in a step with an NGS frame, one step later, ... [um]."""
        return tuple(np.sqrt(self.variance).tolist())

    def interval(self, first: int, last: int) -> tuple[float, float] | None:
        """Return the range of the rms [um] over the steps `first` to `last` of a record, in SHARE of records, where known."""
        if not self.covariance.size:
            return None
        least = float(self.covariance[0])
        excess, past = np.maximum(self.transient[first:last] - least, 0.0), self.transient.size
        later = max(self.transient[-1] - least, 0.0) * past / np.arange(max(first, past) + 1, last + 1)
        learning = float(excess.sum() + later.sum()) / (last - first)
        mean = least + learning
        if not mean > 0:
            return 0.0, 0.0
        n = degrees_of_freedom(self.covariance, last - first) if least > 0 else inf
        if self.n_lines:
            n = mean**2 / (least**2 / n + learning**2 / (2 * self.n_lines * learning_freedom(last / max(first, 1))))
        low, high = np.sqrt(2.0 * mean * gammaincinv(0.5 * n, [0.5 - 0.5 * SHARE, 0.5 + 0.5 * SHARE]) / n)
        return float(low), float(high)


Errors = dict[str, PeriodicError]
"""Target -> error; TOTAL is that of both together."""


def learning_freedom(ratio: float) -> float:
    """Return the degrees of freedom of the mean square of W(t) / t from t = 1 to `ratio`.

    W(t) / t is the error of an amplitude learnt in white noise. W is Brownian, so that the mean square has the mean ln r and the
    variance 4 (ln r - 1 + 1 / r), either over r - 1, its square.
    """
    if ratio < 1.01:
        return 1.0
    return log(ratio) ** 2 / (2.0 * (log(ratio) - 1.0 + 1.0 / ratio))


def bound(scenario: Scenario, *, information: str = "lgs", ahead: float = 0, modes: Sequence[int] | None = None) -> list[Errors]:
    """Compute the minimum error of any causal linear observer with this information.

    Parameters
    ----------
    scenario : Scenario
        Settings.
    information : {"lgs", "both", "stars", "modes", "both-modes", "asterism"}
        Measurements of the mean of the LGS; with the NGS; every LGS by itself with the NGS; and the same of all modes together.
    ahead : float
        Steps of prediction: of phi[k + ahead] from measurements up to step k. Whole ones where every mode is by itself.
    modes : sequence of int, optional
        Indices of the modes; by default all.

    Returns
    -------
    list of dict of str to PeriodicError
        Per mode: target -> variance at every step of the cycle of an NGS frame [um^2], whose `rms` is in um; "total" is that of
        turbulence and vibration together.

    Raises
    ------
    ValueError
        The spectra of the scenario are not known, it has no such mode, or there is no such information in it: its modes are
        independent ("modes", "both-modes"), or all LGS see the same ("asterism").

    Notes
    -----
    The causal Wiener filter by spectral factorisation (Oppenheim and Schafer, Discrete-Time Signal Processing, section 13.6); of
    all modes together the Kalman filter of the whole model.

    See Also
    --------
    run : Has these bounds as rows, each where an observer has that information.

    Examples
    --------
    >>> import wfsobs
    >>> lgs, both = (wfsobs.bound(wfsobs.PRESETS["paper"](), information=of)[0]["total"].rms for of in ("lgs", "both"))
    >>> 0.0 < both < lgs
    True
    """
    check_kind("bound", scenario, Scenario)
    if information not in INFORMATION:
        raise ValueError(f"information = {information!r}: takes one of {', '.join(INFORMATION)}")
    if not has_known_spectra(scenario):
        raise ValueError(NO_BOUND)
    every = range(len(scenario.modes))
    row, chosen = INFORMATION[information], every if modes is None else modes
    if wrong := [mode for mode in chosen if mode not in every]:
        raise ValueError(f"modes: takes indices from 0 to {every[-1]}, not {wrong[0]}")
    if not 0 <= ahead < inf:
        raise ValueError(f"ahead = {ahead:g}: takes 0 steps or more")
    if row in ALONE:
        found = _least_together(scenario.replace({"run.seed": 0}), row, ahead)
        return [dict(found[mode]) for mode in chosen]
    if ahead != int(ahead):
        raise ValueError(f"ahead = {ahead:g}: takes whole steps where every mode is by itself")
    return [_least_of_mode(scenario, mode, (row,), int(ahead))[row] for mode in chosen]


def bound_rms(scenario: Scenario, mode: int, ahead: float = 0, information: str = "lgs") -> dict[str, float]:
    """Return target -> rms [um] of the minimum error, as `bound`, of one mode."""
    return {name: error.rms for name, error in bound(scenario, information=information, ahead=ahead, modes=[mode])[0].items()}


# ---------------------------------------------------------------------- every mode by itself


def _least_of_mode(scenario: Scenario, mode: int, rows: Collection[str], ahead: int = 0, n_steps: int = 1) -> dict[str, Errors]:
    """Return row -> minimum errors of one mode; n_steps : of the record of the intervals."""
    spectra, out = true_spectra(scenario, mode), dict[str, Errors]()
    if BOUND in rows:
        out[BOUND] = least_errors(spectra, ahead, n_steps)
    if BOUND_BOTH in rows:
        out[BOUND_BOTH] = least_errors_of_both(spectra, ahead)
    if BOUND_STARS in rows:
        plain = scenario.replace({"sensors.lgs_combination": MEAN})
        mean = spectra if plain == scenario else true_spectra(plain, mode)
        stars = star_spectra(scenario, mode, mean) if stars_differ(scenario, mode) else None
        out[BOUND_STARS] = least_errors_of_both(mean, ahead, stars)
    return out


def least_errors(spectra: TrueSpectra, ahead: int = 0, n_steps: int = 1) -> Errors:
    """Compute the minimum error of phi[k + ahead] from z[k], z[k-1], ....

    Parameters
    ----------
    spectra : TrueSpectra
        Spectra of one mode.
    ahead : int
        Steps of prediction.
    n_steps : int
        Steps of the record of the intervals.

    Returns
    -------
    dict of str to PeriodicError
        Target -> error.
    """
    known = spectra.without_lines
    whitener, parts, sums = known.whitener, spectra.parts, _sums(spectra.parts)
    past = min(n_steps, MOST_PAST, whitener.n // 2)  # a correlation of half a transform, and no more, is what it is
    best = [known.estimate(*parts[of], ahead=ahead) for of in sums.values()]
    lines = np.outer([name != TURBULENCE for name in sums], spectra.line_covariance(past + 1 + ahead))
    cross = np.array([fft.irfft(one.cross, whitener.n)[:past] for one in best]) + spectra.gain * lines[:, 1 + ahead :]
    measured = fft.irfft(known.measurement, whitener.n)[:past] + spectra.gain**2 * spectra.line_covariance(past)
    covariance = np.array([fft.irfft(one.error, whitener.n)[: min(n_steps, whitener.n // 2)] for one in best])
    variance = lines[:, 0] + [sum(circle_mean(known.signal[part]) for part in parts[of]) for of in sums.values()]
    gained = explained_variance(measured, cross, enough=variance - (1.0 + LEARNT) * covariance[:, 0])
    transient = variance[:, None] - np.hstack([np.zeros((len(sums), 1)), gained])
    counts = [_count_lines(spectra, one, name, ahead, n_steps) for name, one in zip(sums, best, strict=True)]
    found = zip(sums, covariance, transient, counts, strict=True)
    return _complete({name: PeriodicError(left[:1], left, learnt, n) for name, left, learnt, n in found}, known)


def _count_lines(spectra: TrueSpectra, best: CausalEstimate, target: str, ahead: int, n_steps: int) -> float:
    """Return (sum c)^2 / sum c^2, c : error of the target, in power, by each undamped line after `n_steps`; 0 of none.

    A line is learnt in the spectrum of the rest of z. The filter of that rest takes a share of its error away.
    """
    if not spectra.pure:
        return 0.0
    whitener, gain = spectra.without_lines.whitener, spectra.gain
    at, power = zip(*((min(round(f * whitener.n), whitener.n // 2), power) for f, power in spectra.pure), strict=True)
    taken = ((best.cross * whitener.backwards - best.to_come.conj()) * whitener.backwards.conj())[list(at)]
    own = (target != TURBULENCE) * np.exp(2j * pi * (1 + ahead) * np.array(at) / whitener.n)
    rest = 2.0 * whitener.spectrum[list(at)] / n_steps
    c = np.abs(own - gain * taken) ** 2 / (gain**2 / rest + 1.0 / np.array(power))
    return float(c.sum() ** 2 / (c**2).sum())


def least_errors_of_both(spectra: TrueSpectra, ahead: int = 0, stars: StarSpectra | None = None) -> Errors:
    """Compute the minimum error of phi[k + ahead] from all of z and all NGS frames up to step k.

    Parameters
    ----------
    spectra : TrueSpectra
        Spectra of one mode, with those of the plain mean of the LGS where there are `stars`.
    ahead : int
        Steps of prediction.
    stars : StarSpectra, optional
        Those of the differences between the LGS, which are then measured, too.

    Returns
    -------
    dict of str to PeriodicError
        Target -> error.
    """
    known = spectra.without_lines
    parts, (frames, exposure) = known.parts, ngs_frames(known)
    wanted = [
        SlowTarget(*known.estimate(name, ahead=ahead)[:2], advance_spectrum(known.ngs.cross[name] * exposure.conj(), ahead))
        for name in parts
    ]
    if stars is None:
        gained = variance_from_frames(wanted, known.whitener, frames)
    else:
        others = FastSensors(
            stars.n_differences,
            stars.between,
            lambda i: stars.pair(FIRST + i, LGS),
            lambda i: advance_spectrum(stars.pair(NGS, FIRST + i) * exposure, 1),
        )
        on_axis = {TURBULENCE: lambda i: advance_spectrum(stars.pair(AXIS, FIRST + i), 1 + ahead)}
        targets = [(one, on_axis.get(name)) for name, one in zip(parts, wanted, strict=True)]
        gained = variance_from_sensors(targets, known.whitener, others, frames)
    alone = {name: circle_mean(known.estimate(*parts[of], ahead=ahead).error) for name, of in _sums(parts).items()}
    left = {name: alone[name] - gained[:, of, of].sum(axis=(1, 2)) for name, of in _sums(parts).items()}
    return _complete({name: PeriodicError(np.maximum(variance, 0.0)) for name, variance in left.items()}, known)


def _sums(parts: Sequence[str]) -> dict[str, slice]:
    """Return target -> its place in those that are not zero, and TOTAL -> all of them where there is more than one."""
    return {name: slice(i, i + 1) for i, name in enumerate(parts)} | ({TOTAL: slice(None)} if len(parts) > 1 else {})


def _complete(errors: Errors, spectra: TrueSpectra) -> Errors:
    """Return the errors of every target, also of one that is zero, and of both together."""
    first = next(iter(errors.values()))
    nothing = PeriodicError(0.0 * first.variance, 0.0 * first.covariance, 0.0 * first.transient)
    return {name: errors.get(name, nothing) for name in spectra.signal} | {TOTAL: errors.get(TOTAL, first)}


def ngs_frames(spectra: TrueSpectra) -> tuple[SlowSensor, Complex]:
    """Return the NGS as a slow sensor beside z, and the response of its exposure."""
    ngs, exposure = spectra.ngs, exposure_response(spectra.ngs.ratio, spectra.measurement.size)
    cross = advance_spectrum(ngs.measurement_cross * exposure, 1)
    return SlowSensor(ngs.signal * np.abs(exposure) ** 2, cross, ngs.noise, ngs.ratio), exposure


@lru_cache(maxsize=2)
def exposure_response(ratio: int, size: int) -> Complex:
    """Return the response of the mean of the last `ratio` steps before the present one, at `size` frequencies from 0 to 1/2."""
    omega = pi * np.arange(size) / (size - 1)
    out = np.asarray(np.exp(-0.5j * (ratio + 1) * omega) * diric(omega, ratio), dtype=np.complex128)
    out.flags.writeable = False
    return out


# ---------------------------------------------------------------------- all modes together


def _raise_threshold() -> None:
    """Have the C library keep the memory of arrays.

    That of Linux returns every array to the system that is larger than any freed before. One of a few MB after the other is then
    cleared page by page, which takes as long as the computations.
    """
    np.empty(FREED, dtype=np.uint8)


@lru_cache(maxsize=4)
def _least_together(scenario: Scenario, row: str, ahead: float) -> list[Errors]:
    """Return the minimum errors of every mode from the measurements of all modes; row : of ALONE."""
    _raise_threshold()
    of_stars = row == BOUND_ASTERISM
    if not of_stars and not are_coupled(scenario):
        raise ValueError("the modes of this scenario are independent: the bound of each is its own")
    true = scenario.replace({**TRUE_MODEL, "multipeak.line_width": line_width(scenario)})
    if row == BOUND_MODES:
        model = flow_model(prior_of(true, None, (Lines, Flow)), true.multipeak, MEANS)
    else:
        prior, ratio = prior_of(true, None, (Lines, Asterism if of_stars else FlowOfBoth)), scenario.sensors.exposure_ratio
        model = AsterismModel(prior, true.multipeak, ratio, MEANS_OF_BOTH, FRAME_MEANS)
    variance = {target: model.plan(ahead, target)[1][:-1] ** 2 for target in (*TARGETS, TOTAL)}
    modes = range(len(scenario.modes))
    return [{target: PeriodicError(of[:, mode]) for target, of in variance.items()} for mode in modes]


# ---------------------------------------------------------------------- closed loop


def least_residual(spectra: TrueSpectra, delay: float, information: str) -> float:
    """Return the rms [um] of the minimum residual of a causal controller.

    Parameters
    ----------
    spectra : TrueSpectra
        Spectra of one mode.
    delay : float
        Of the mirror [frames], at least 1.
    information : {"lgs", "both"}
        Measurements of the controller.
    """
    least = least_errors_of_both if information == "both" else least_errors
    ahead, fraction = int(delay) - 1, delay - int(delay)
    variance = least(spectra, ahead)[TOTAL].rms ** 2
    if fraction > 0.5:
        w = -(1.0 - fraction) / fraction
        later = summed_ahead(spectra, w)
        one, next_one = (least(later, steps)[TOTAL].rms ** 2 for steps in (ahead, ahead + 1))
        variance += (1.0 - w**2) * max(next_one - one, 0.0)
    return float(np.sqrt(variance))


def summed_ahead(spectra: TrueSpectra, w: float) -> TrueSpectra:
    """Return the spectra with sum_j w^j s[k+j], j from 0, in place of every target s[k]; |w| below 1."""
    known = spectra.without_lines
    size = known.measurement.size
    weight = 1.0 / (1.0 - w * np.exp(1j * np.pi * np.arange(size) / (size - 1)))
    return TrueSpectra(
        known.measurement,
        {name: signal * np.abs(weight) ** 2 for name, signal in known.signal.items()},
        {name: cross * weight for name, cross in known.cross.items()},
        replace(known.ngs, cross={name: cross * weight for name, cross in known.ngs.cross.items()}),
    )


# ---------------------------------------------------------------------- rows of a table


@dataclass(frozen=True)
class Bound:
    """Minimum error of a target in a mode of a record.

    Attributes
    ----------
    row : str
        One of BOUNDS.
    target, mode : str
        Target, and name of the mode.
    column : int
        Index of the mode.
    error : PeriodicError
        The error.
    """

    row: str
    target: str
    mode: str
    column: int
    error: PeriodicError


def record_bounds(scenario: Scenario, record: Record, observers: Collection[str] = ()) -> list[Bound]:
    """Compute the bounds of a record that was simulated from the scenario; none where its spectra are not known.

    observers : ids of those in the table. The bounds of all modes together take a second and more: they are computed where an
        observer that they are for is among them
    """
    if not has_known_spectra(scenario):
        return []
    plain = scenario.replace({"run.seed": 0})
    rows = [dict(of_mode) for of_mode in _least_of_modes(plain, record.n_modes, record.n_steps)]
    for row in (JOINT_BOUNDS[observer] for observer in joint_observers(scenario, observers)):
        for of_mode, together in zip(rows, _least_together(plain, row, 0), strict=True):
            alone = of_mode.get(ALONE[row], together)  # no number of means is enough for a narrow line, or for a continuum
            lesser = {name: it if it.rms <= alone[name].rms else alone[name] for name, it in together.items()}
            of_mode[row] = {name: PeriodicError(it.variance) for name, it in lesser.items()}
    return [
        Bound(row, target, it.name, i, errors[target])
        for i, it in enumerate(scenario.modes[: record.n_modes])
        for row, errors in rows[i].items()
        for target in SCORED
    ]


def joint_observers(scenario: Scenario, observers: Collection[str]) -> list[str]:
    """Return those of JOINT_BOUNDS among observers for which the scenario has a prior."""
    return [name for name in JOINT_BOUNDS if name in observers and has_prior(OBSERVERS[name], scenario)]


@lru_cache(maxsize=4)  # no seed changes them, and they take longer than most observers
def _least_of_modes(scenario: Scenario, n_modes: int, n_steps: int) -> list[dict[str, Errors]]:
    """Compute row -> errors of the first modes of a scenario, each by itself."""
    _raise_threshold()

    def of_mode(mode: int) -> dict[str, Errors]:
        rows = (*COMMON_BOUNDS, BOUND_STARS) if stars_differ(scenario, mode) else COMMON_BOUNDS
        return _least_of_mode(scenario, mode, rows, n_steps=n_steps)

    return in_two_threads(of_mode, range(n_modes))


def bound_scores(bounds: Sequence[Bound], record: Record, scores: Sequence[Score], warm_up: float) -> list[Score]:
    """Return the scores of bounds, on the samples of the observers' scores, or on all after the warm-up [s]."""
    stretches = {(s.target, s.mode): (s.start, s.stop) for s in scores if not s.apart}
    out = []
    for it in bounds:
        start, stop = stretches.get((it.target, it.mode), (None, None))
        first = round((warm_up if start is None else start) / record.dt)
        last = record.n_steps if stop is None else round(stop / record.dt)
        truth, error = record.truth(it.target), it.error
        if truth is not None and first < last:
            scale = rms(truth[first:last, it.column])
            seen = error.rms, scale, error.rms / scale if scale > 0 else None, None, 0.0, first * record.dt, last * record.dt
            phases = error.phases if error.variance.size > 1 else None
            out.append(Score(it.row, it.target, it.mode, *seen, interval=error.interval(first, last), phases=phases))
    return out
