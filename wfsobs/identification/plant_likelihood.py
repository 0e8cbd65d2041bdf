"""The likelihood of the plant of a closed loop, together with that of the spectra of its disturbance.

The mirror holds a command for a frame and the sensor averages over one, so that with the delay d + p, 0 <= p < 1, in frames,

    y[k] = disturbance[k] + R(angle) diag(gain) m[k] + noise[k],    m[k] = (1 - p) u[k-d] + p u[k-d-1].

The disturbance and the noise of each mode have a spectrum S of a stated form: white noise, turbulence of second or third order, a
coloured background where it is worth it, and resonances. Whittle's likelihood of z = y - R diag(gain) m,

    - log L = sum log S + |Z|^2 / S    over modes and frequencies,

has its maximum over plant and spectra together (the direct method: U. Forssell and L. Ljung, Automatica 35, 1999). The plant's
covariance is its block of the inverse of the joint information: in a closed loop what a plant explains a spectrum may explain as
well. A probe in the commands makes that small.

A mirror with dynamics has an impulse response of unit gain, with a group delay at low frequency and two shape parameters: an
arbitrary response over four lags, or that of a second-order mirror.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.fft import irfft, rfft
from scipy.ndimage import maximum_filter, median_filter, minimum_filter
from scipy.special import chdtrc, chdtri

from wfsobs.record import Record, delay_signal, hold_last
from wfsobs.spectral.model import Spectrum
from wfsobs.spectral.quick import quick_spectrum
from wfsobs.spectral.whittle import (
    Cells,
    MissingSamples,
    fast_length,
    find_outlying,
    inflation,
    periodogram_frequencies,
    taper,
)
from wfsobs.typing import Array

LAGS = 256
"""Length of a response; its first lag is one frame."""

RANGE = np.log([[0.03, 0.02], [1.0, 3.0]])
"""Bounds of the shape of a second-order mirror: logarithms of natural frequency over frame rate, and of damping ratio."""

SHAPES = tuple((np.log(f), np.log(damping)) for f in (0.15, 0.3, 0.6) for damping in (0.3, 0.8))
"""Starting points of its fit."""

Response = Callable[[Array], Array]
"""From delay [frames] and shape, (3,), to the response, (LAGS,)."""


def few_lags(base: int, x: Array) -> Array:
    """Return the response over four lags around a delay of `base` whole frames, (LAGS,).

    x : delay [frames], and the sizes of two second differences, which change neither gain nor group delay at low frequency, (3,)
    """
    out, first, part = np.zeros(LAGS), max(base - 1, 1) - 1, x[0] - base
    out[base - 1 : base + 1] = 1.0 - part, part
    for i, size in enumerate(x[1:]):
        out[first + i : first + i + 3] += size * np.array([1.0, -2.0, 1.0])
    return out


def second_order(x: Array) -> Array:
    """Return the response of a second-order mirror, (LAGS,).

    x : delay [frames], logarithms of natural frequency over frame rate and of damping ratio, (3,)

    The mirror holds a command for one frame and the sensor averages over one, so that the response is the second difference of
    the integral of its step response. That integral tends to t - 2 damping / omega, the group delay at low frequency.
    """
    omega, damping = 2.0 * np.pi * np.exp(x[1]), np.exp(x[2])
    root = np.sqrt(complex(damping**2 - 1.0))
    root = root if abs(root) > 1e-4 else 1e-4
    p, q = omega * (-damping + root), omega * (-damping - root)
    t = np.maximum(np.arange(LAGS + 2) - (x[0] - 2.0 * damping / omega), 0.0)
    return np.diff(t + ((q / p * np.expm1(p * t) - p / q * np.expm1(q * t)) / (p - q)).real, 2)


LONGEST = 6
"""Largest delay [frames]."""

ORDER, SPAN, DEGREE = 16, 12, 4
"""Of the first guess: frames of the past that predict a measurement, and frames after it over which the response of a disturbance
is a polynomial of this degree, which follows lines up to about a tenth of the rate."""

PER_COEFFICIENT = 4
"""Minimum number of frames per coefficient of a regression."""

PEAKS, MOST_PEAKS, LOWEST = 10, 40, 5.0
"""Maximum number of resonances per mode, while a maximum is looked for and then; their minimum frequency [Hz]."""

STEPS, REACH, ENOUGH = 25, 0.3, 0.02
"""Newton steps; maximum change of a number of the plant in one; gain of log-likelihood below which they end."""

NARROW, BAND, LOOSE = 10.0, 0.1, 0.1
"""Bands over which the correlation of plant and spectra is smoothed: bins, and share of the frequency added to it; information on
each number of a spectrum beside that of the data, which keeps those that the data say nothing of.
"""

REFILLS = 2
"""Times that missing samples are filled anew: each leaves about the share that is missing of the error of the spectra."""

SMALL = 1e-4
"""Step of the finite differences of a response."""

FAR = 0.05
"""Gain of the first guess below which, or over whose inverse, it is not taken for 1."""


AROUND, JUMP, SEEN = 5, 5.0, 2.0
"""Samples on either side whose median one is compared with; difference from it, over what the range of these usually is, of a
command that is tested, and of a measurement that shows it: 6 deviations of white noise."""


def not_received(y: Array, u: Array) -> NDArray[np.bool_]:
    """Return which commands the mirror cannot have received, bool (n,): far from those around them, with no trace in y later on.

    Such are numbers like -9999 in place of missing ones, and errors of the link to the recorder.
    y, u : measurements and commands, (n, k) [um], NaN where one is missing
    """

    def is_far(x: Array, times: float) -> Any:
        middle, least, most = (one(x, (2 * AROUND + 1, 1)) for one in (median_filter, minimum_filter, maximum_filter))
        usual = np.median(most - least, axis=0)
        return np.any((np.abs(x - middle) > times * usual) & (usual > 0.0), axis=1)

    out = is_far(hold_last(u), JUMP)
    shows = is_far(hold_last(y), SEEN) & ~out  # a number in place of all that is missing stands in both
    shows[:AROUND] = shows[-AROUND:] = False  # what is around these is not known
    edges = np.flatnonzero(np.diff(np.pad(out, 1).astype(int)))
    for start, stop in edges.reshape(-1, 2):
        if stop - start > AROUND or shows[stop : stop + LONGEST + 1].any():
            out[start:stop] = False
    return out


def known_signals(record: Record, most: int) -> tuple[Array, Array]:
    """Return the first measurements of a record, NaN where a command that they may see is lost, and commands, NaN where lost."""
    y, u = record.y_lgs[:most].copy(), record.u[:most].copy()
    u[not_received(y, u)] = np.nan
    lost = np.isnan(u).sum(axis=1) > 0
    for lag in range(1, LONGEST + 2):
        y[lag:][lost[:-lag]] = np.nan
    return y, u


@dataclass(frozen=True)
class PlantFit:
    """Plant: delays, gains and, of two modes, the angle; spectra; - log L; covariance of the plant; bins.

    With the response of a mirror its shape follows the other numbers of the plant.
    """

    theta: Array
    spectra: Sequence[Spectrum]
    value: float = np.inf
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    bins: int = 0
    mirror: Response | None = None
    fill: Fill | None = field(default=None, repr=False, compare=False)

    @property
    def criterion(self) -> float:
        """That of Schwarz: a number of a spectrum has to be worth half of the log of the bins."""
        return self.value + 0.5 * np.log(max(self.bins, 1)) * sum(s.starts[-1] for s in self.spectra)


class PlantLikelihood:
    """Measurements, and commands of up to LONGEST + 1 frames before, of the modes of a group, with their Fourier transforms.

    Attributes
    ----------
    n, k : int
        Number of frames and of modes.
    dt : float
        Time step [s].
    f : Array
        Frequencies [Hz], (bins,).
    y, u : Array
        Measurements (n, k), NaN where one is missing or outlying, and commands of 0, 1, ... frames before, (lags, n, k) [um].
    U : Array
        Transform of the commands, (lags, k, bins).
    missing : list of MissingSamples
        The missing samples of every mode.
    is_blind : bool
        Whether the controller did not receive the missing measurements either (`missed_by_controller`).

    Parameters
    ----------
    y, u : Array
        As `known_signals` returns them, (n, k) [um].
    dt : float
        Time step [s].
    """

    n: int
    dt: float
    k: int
    f: Array
    u: Array
    y: Array
    U: Array
    missing: list[MissingSamples]
    is_blind: bool

    def __init__(self, y: Array, u: Array, dt: float):
        skip = LONGEST + 1
        self.n, self.dt, self.k = fast_length(len(y) - skip), dt, y.shape[1]
        self.f = periodogram_frequencies(self.n, dt)
        has_command, u = np.isnan(u).sum(axis=1) == 0, hold_last(u)
        u = u - u.mean(axis=0)
        self.u = np.array([u[skip - j : skip - j + self.n] for j in range(LONGEST + 2)])
        y = (y - np.nanmean(y, axis=0))[skip : skip + self.n]
        self.y = np.column_stack([np.where(np.isnan(x) | find_outlying(x), np.nan, x) for x in y.T])
        self.y -= np.nanmean(self.y, axis=0)  # regressions have no constant
        self.missing = [MissingSamples(np.isnan(x), dt, np.random.default_rng(0)) for x in self.y.T]
        self.U = np.array([self.transform(x) for x in self.u])
        masks = np.isnan(y).sum(axis=1) > 0, np.isnan(self.y).sum(axis=1) == 0, has_command[skip : skip + self.n]
        self.is_blind = any(m.any for m in self.missing) and missed_by_controller(self.filled_y, self.u[0], *masks)

    def without(self, own: Array) -> PlantLikelihood:
        """Return the same measurements with commands that lack a part (n, k)."""
        out = copy(self)
        out.u = self.u - np.array([delay_signal(own, lag) for lag in range(len(self.u))])
        out.U = np.array([self.transform(x) for x in out.u])
        return out

    @property
    def filled_y(self) -> Array:
        """Measurements with straight lines through gaps."""
        return np.column_stack([m.interpolate(x) for m, x in zip(self.missing, self.y.T, strict=True)])

    def transform(self, x: Array) -> Array:
        """Return the Fourier transform of the columns (k, bins), such that its square is the periodogram."""
        return np.sqrt(2.0 * self.dt / self.n) * rfft(taper(self.n)[:, None] * x, axis=0)[1 : (self.n + 1) // 2].T

    def with_spectra(self, theta: Array, spectra: Sequence[Spectrum] = (), most: int = PEAKS, *, plain: bool = True) -> PlantFit:
        """Return a plant with first guesses of the spectra; missing samples are filled by those before.

        plain : without a background, which the commands of a wrong plant look like
        """
        fill = self.fill(theta, spectra)
        some = zip(fill.z(theta).T, spectra or [None] * self.k, strict=True)
        found = [quick_spectrum(x, self.dt, most, LOWEST, s, complete=not plain) for x, s in some]
        return PlantFit(theta, [replace(s, background=None) if plain else s for s in found], fill=fill)

    def fill(self, theta: Array, spectra: Sequence[Spectrum]) -> Fill:
        """Return the measurements filled by spectra, and by the plant where the controller received what is missing."""
        return Fill(self, spectra, None if self.is_blind else theta)

    def mirror_signal(self, theta: Array) -> Array:
        """Return the commands as the measurements see them, (n, k)."""
        whole = np.minimum(theta[: self.k].astype(int), LONGEST)
        part = theta[: self.k] - whole
        m = [(1.0 - p) * self.u[d, :, j] + p * self.u[d + 1, :, j] for j, (d, p) in enumerate(zip(whole, part, strict=True))]
        return np.array(m).T @ self._matrix(theta).T

    @property
    def size(self) -> int:
        """Numbers of a plant but for the shape of its mirror."""
        return 2 * self.k + (self.k == 2)

    def _matrix(self, theta: Array, turn: float = 0.0) -> Array:
        angle = theta[2 * self.k] if self.k == 2 else 0.0
        return rotation_matrix(angle + turn)[: self.k, : self.k] * theta[self.k : 2 * self.k]

    def _mirror_transform(self, theta: Array, lower: Array | None, mirror: Response | None, fill: Fill) -> tuple[Array, Array]:
        """Return the commands as each mode measures them (k, k, bins), and slopes by delay and shape (k, k, 1 or 3, bins)."""
        if mirror is None:
            lower = np.minimum(theta[: self.k].astype(int), LONGEST) if lower is None else lower
            before, after = (np.stack([fill.commands(d)[:, j] for j, d in enumerate(lower + i)], axis=1) for i in (0, 1))
            change = after - before
            return before + (theta[: self.k] - lower)[:, None] * change, change[:, :, None]
        steps = SMALL * np.eye(3)
        of_modes = [np.append(delay, theta[self.size :]) for delay in theta[: self.k]]
        taps = [[mirror(x), *((mirror(x + e) - mirror(x - e)) / (2.0 * SMALL) for e in steps)] for x in of_modes]
        response = rfft(taps, self.n)
        if fill.is_alike:
            moved = irfft(response * rfft(self.u[1].T)[:, None], self.n)
            out = np.stack([fill.transform(x.T) for x in moved.swapaxes(0, 1)], axis=2)
        else:
            out = (response[..., 1 : (self.n + 1) // 2] * self.U[1][:, None])[None]
        return out[:, :, 0], out[:, :, 1:]

    def z(self, theta: Array, fill: Fill, lower: Array | None = None, mirror: Response | None = None) -> tuple[Array, Array]:
        """Return the transform of z (k, bins) and its derivatives by theta (p, k, bins); lower : whole part of the delays."""
        m, slopes = self._mirror_transform(theta, lower, mirror, fill)
        matrix = self._matrix(theta)[:, :, None]
        by_delay = [-matrix[:, j] * slopes[:, j, 0] for j in range(self.k)]
        by_gain = [-matrix[:, j] / theta[self.k + j] * m[:, j] for j in range(self.k)]
        by_angle = [-(self._matrix(theta, np.pi / 2.0)[:, :, None] * m).sum(axis=1)] if self.k == 2 else []
        by_shape = [-(matrix * slopes[:, :, i]).sum(axis=1) for i in range(1, slopes.shape[2])]
        return fill.Y - (matrix * m).sum(axis=1), np.array(by_delay + by_gain + by_angle + by_shape)

    def fit(self, start: PlantFit, ties: Array) -> PlantFit:
        """Return `newton_fit`, repeated with samples filled by its spectra where the controller missed them.

        The likelihoods of several fits can then be compared, each with its own fill. Parameters as of `newton_fit`.
        """
        found = self.newton_fit(start, ties)
        for _ in range(REFILLS * self.is_blind):
            found = self.newton_fit(replace(found, fill=self.fill(found.theta, found.spectra)), ties)
        return found

    def newton_fit(self, start: PlantFit, ties: Array, *, stays: bool = False) -> PlantFit:
        """Take damped Newton steps with the expected second derivatives.

        ties : theta by its free numbers (p, q);  stays : delays do not go beyond the whole numbers on either side
        """
        theta, spectra, mirror = start.theta, list(start.spectra), start.mirror
        fill = start.fill or self.fill(theta, spectra)
        cells = [Cells(self.f, np.zeros_like(self.f), np.ones_like(self.f), [p.frequency for p in s.resonances]) for s in spectra]
        lower, held = np.minimum(theta[: self.k].astype(int), LONGEST), 1e-3
        best, F, q = np.inf, np.zeros((0, 0)), ties.shape[1]
        theta_there, spectra_there, lower_there = theta, spectra, lower
        gradient = np.zeros(0)
        for _ in range(STEPS):
            Z, dZ = self.z(theta_there, fill, lower_there, mirror)
            for cell, power in zip(cells, np.abs(Z) ** 2 + fill.power, strict=True):
                cell.mean = np.add.reduceat(power, _edges(cell)) / cell.count
            there = sum(cell.misfit(s) for s, cell in zip(spectra_there, cells, strict=True))
            gain = best - there
            crossed = (lower_there != lower).any()
            if gain >= 0:
                theta, spectra, lower, best, held = theta_there, spectra_there, lower_there, there, 0.2 * held
                F, gradient = self._second_derivatives(dZ, Z, spectra, cells, ties, fill.spectra_share)
                if gain < ENOUGH and not crossed:
                    break
            else:
                held = max(10.0 * held, 1e-3)
                if held > 1e4:
                    break
            step = np.linalg.solve(F + np.diag(held * np.diag(F) + 1e-9), -gradient)
            theta_there = theta + np.clip(ties @ step[:q], -REACH, REACH)
            if mirror is None:
                theta_there, lower_there = self._within(theta_there, lower, stays)
            elif mirror is second_order:
                theta_there[-2:] = np.clip(theta_there[-2:], *RANGE)
            spectra_there, at = [], q
            for s in spectra:
                vector, free = s.vector, s.free_parameters
                vector[free] += np.clip(step[at : at + len(free)], -1.0, 1.0)
                at += len(free)
                spectra_there.append(s.with_vector(vector))
        covariance = np.linalg.inv(F)[:q, :q] * inflation(self.n)
        covariance /= fill.plant_share
        return PlantFit(theta, spectra, float(best), ties @ covariance @ ties.T, self.f.size, mirror, fill)

    def _within(self, theta: Array, lower: Array, stays: bool) -> tuple[Array, Array]:
        """Stop delays at the next whole number, where the derivative changes; from there they go on in the next step, or stay."""
        theta, out = theta.copy(), lower.copy()
        for j, d in enumerate(lower):
            if theta[j] >= d + 1:
                theta[j], out[j] = d + 1, d if stays else min(d + 1, LONGEST)
            elif theta[j] <= d:
                theta[j], out[j] = d, d if stays else max(d - 1, 1)
        return theta, out

    def _second_derivatives(
        self, dZ: Array, Z: Array, spectra: Sequence[Spectrum], cells: Sequence[Cells], ties: Array, shares: Sequence[float]
    ) -> tuple[Array, Array]:
        """Return the expected second derivatives and the gradient of - log L by the free numbers of plant and spectra.

        shares : of the samples of each mode that carry information on its spectrum
        """
        dZ = np.tensordot(ties.T, dZ, 1)
        q = len(dZ)
        size = q + sum(len(s.free_parameters) for s in spectra)
        F, gradient, at = np.zeros((size, size)), np.zeros(size), q
        for i, (s, cell) in enumerate(zip(spectra, cells, strict=True)):
            S, free = s.psd(cell.frequency), s.free_parameters
            slopes, own = s.slopes(cell.frequency, free) / S, slice(at, at + len(free))
            weighted = dZ[:, i] / np.repeat(S, cell.count.astype(int))
            by_cell = 2.0 * np.add.reduceat(np.real(np.conj(Z[i]) * weighted), _edges(cell), axis=1)
            gradient[:q] += by_cell.sum(axis=1)
            gradient[own] = slopes @ (cell.count * (1.0 - cell.mean / S))
            F[:q, :q] += 2.0 * np.real(weighted @ dZ[:, i].conj().T)
            smooth = np.array([np.interp(cell.frequency, *self._band_means(x / cell.count, cell)) for x in by_cell])
            smooth = smooth.reshape(q, len(cell.count))
            F[:q, own] = -(smooth * cell.count) @ slopes.T
            F[own, own] = shares[i] * (slopes * cell.count) @ slopes.T + LOOSE * np.eye(len(free))
            at += len(free)
        F[q:, :q] = F[:q, q:].T
        return F, gradient

    def _band_means(self, x: Array, cell: Cells) -> tuple[Array, Array]:
        """Return frequencies and means of x over bands: as Z times its derivatives over S, it is smooth but for its scatter."""
        band = np.cumsum(cell.count / (NARROW + BAND * self.n * self.dt * cell.frequency)).astype(int)
        weight = np.bincount(band, cell.count)
        some = weight > 0
        frequency, mean = (np.bincount(band, cell.count * one)[some] / weight[some] for one in (cell.frequency, x))
        return frequency, mean

    def response_left(self, fit: PlantFit, own: Array) -> float:
        """Return the probability of what the measurements still hold of the commands' own part (n, k), were it chance.

        Score test of a further response, as many numbers as lags for each mode, with the spectra of the fit.
        """
        assert fit.fill is not None
        Z = self.z(fit.theta, fit.fill, mirror=fit.mirror)[0]
        seen = (self._matrix(fit.theta)[:, :, None] * fit.fill.transform(own)).sum(axis=1)
        turn = np.exp(-2j * np.pi * self.f * self.dt * np.arange(1, LONGEST + 3)[:, None])
        total = 0.0
        for z, one, s in zip(Z, seen, fit.spectra, strict=True):
            D = turn * one / np.sqrt(s.psd(self.f))
            score, F = (D.conj() @ (z / np.sqrt(s.psd(self.f)))).real, (D.conj() @ D.T).real
            total += 2.0 * float(score @ np.linalg.solve(F + 1e-9 * np.trace(F) * np.eye(len(F)), score))
        return float(chdtrc(len(turn) * self.k, total))

    def uncertainty(self, fit: PlantFit, dynamic: PlantFit) -> float:
        """Return the 95 % limit of the rms of the error of z over the rms of z, in the worst octave.

        dynamic : the fit with the response of the mirror; what z lacks of that one counts as an error
        """
        assert fit.fill is not None and dynamic.fill is not None
        (Z, dZ), right = self.z(fit.theta, fit.fill), self.z(dynamic.theta, dynamic.fill, mirror=dynamic.mirror)[0]
        values, vectors = np.linalg.eigh(fit.covariance)
        dZ = np.tensordot((vectors * np.sqrt(np.maximum(values, 0.0))).T, dZ, 1)
        low, worst = 1.0, 0.0
        while low < 0.25 / self.dt:
            octave = (self.f >= low) & (self.f < min(2.0 * low, 0.25 / self.dt))
            for i in range(self.k if octave.any() else 0):
                part = dZ[:, i, octave]
                sizes = np.maximum(np.linalg.eigvalsh(np.real(part @ part.conj().T)), 0.0)
                freedom = sizes.sum() ** 2 / max((sizes**2).sum(), 1e-300)  # as of a multiple of chi squared
                limit = sizes.sum() * chdtri(freedom, 0.05) / freedom if freedom > 0 else 0.0
                limit += float(np.sum(np.abs(Z[i, octave] - right[i, octave]) ** 2))
                worst = max(worst, limit / max(float(np.sum(np.abs(right[i, octave]) ** 2)), 1e-300))
            low *= 2.0
        return float(np.sqrt(worst))


class Fill:
    """Transforms of measurements and commands without gaps.

    Missing samples are replaced by their expectation given all others, for the spectra of z, or by straight lines. Where the
    controller missed them, measurements and commands are filled alike: z is linear in them, so that the z of any plant is filled
    as well. Where the controller received them, the commands depend on them, by a law that is not known: the measurements alone
    are filled, with the z of one plant.

    Attributes
    ----------
    is_alike : bool
        Whether measurements and commands are filled alike.
    Y : Array
        Transform of the measurements, (k, bins).
    power : Array
        Power that the periodogram of z lacks because samples are filled, (k, bins).
    spectra_share : sequence of float
        Share of the samples of each mode that count in the information on its spectrum.
    plant_share : float
        Factor of the information on the plant: filled samples count in it unless measurements and commands are filled alike.

    Parameters
    ----------
    data : PlantLikelihood
        Measurements and commands.
    spectra : sequence of Spectrum
        Of z by mode; none for straight lines.
    theta : Array or None
        The plant by which the measurements alone are filled; None to fill the commands as well.
    """

    def __init__(self, data: PlantLikelihood, spectra: Sequence[Spectrum], theta: Array | None):
        self._data, self._S = data, [s.psd(data.f) for s in spectra]
        has_gaps = any(missing.any for missing in data.missing)
        self.is_alike: bool = theta is None and has_gaps
        self._commands: dict[int, Array] = {}
        shares = [1.0 - float(missing.is_missing.mean()) for missing in data.missing]
        self.spectra_share: Sequence[float] = shares if self.is_alike else [1.0] * data.k
        self.plant_share: float = 1.0 if self.is_alike else min(shares)
        self.power: Array = np.zeros((data.k, data.f.size))
        for i, missing in enumerate(data.missing):
            if self._S and missing.any and data.is_blind:
                S = self._S[i]
                self.power[i] = (1.0 - missing.measured_share(S, missing.draw_errors(S))) * S
        seen = np.zeros_like(data.y) if theta is None else data.mirror_signal(theta)
        self.Y: Array = data.transform(self._fill(data.y - seen) + seen)

    def z(self, theta: Array) -> Array:
        """Return the z of a plant, (n, k)."""
        return self._fill(self._data.y - self._data.mirror_signal(theta))

    def commands(self, lag: int) -> Array:
        """Return the transform of the commands so many frames before as each mode measures them, (k, k, bins)."""
        if lag not in self._commands:
            self._commands[lag] = self.transform(self._data.u[lag]) if self.is_alike else self._data.U[lag][None]
        return self._commands[lag]

    def transform(self, x: Array) -> Array:
        """Return the transform of the columns of x (n, k) as each mode measures them, (k or 1, k, bins)."""
        if not self.is_alike:
            return self._data.transform(x)[None]
        columns = range(self._data.k)
        return np.array([self._data.transform(np.column_stack([self._fill_one(i, x[:, j]) for j in columns])) for i in columns])

    def _fill(self, x: Array) -> Array:
        return np.column_stack([self._fill_one(i, column) for i, column in enumerate(x.T)])

    def _fill_one(self, mode: int, x: Array) -> Array:
        """Return a signal of a mode with its missing samples filled, (n,)."""
        missing = self._data.missing[mode]
        return missing.fill(x, self._S[mode]) if self._S and missing.any else missing.interpolate(x)


def rotation_matrix(angle: float) -> Array:
    """Return the matrix (2, 2) of a rotation by an angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _edges(cells: Cells) -> Array:
    return np.concatenate([[0], np.cumsum(cells.count)[:-1]]).astype(int)


def past_of(y: Array, u: Array) -> Array:
    """Return the last ORDER measurements and commands before each sample from the ORDER th on, (n - ORDER, 2 k ORDER)."""
    return np.column_stack([x[ORDER - i : len(x) - i] for x in (y, u) for i in range(1, ORDER + 1)])


def prediction_errors(y: Array, u: Array, rows: Array | None = None) -> tuple[Array, Array]:
    """Return what is new in measurements and commands, (n, ...) each, from their ORDER th sample on: not told by their past.

    rows : which of these samples it is told of, bool (n - ORDER,), all by default; zero at the others
    """
    past, rows = past_of(y, u), np.arange(len(y) - ORDER) if rows is None else np.flatnonzero(rows)
    new_y, new_u = np.zeros_like(y[ORDER:]), np.zeros_like(u[ORDER:])
    for x, new in ((y, new_y), (u, new_u)):
        new[rows] = x[ORDER:][rows] - past[rows] @ np.linalg.lstsq(past[rows], x[ORDER:][rows], rcond=1e-10)[0]
    return new_y, new_u


def missed_by_controller(y: Array, u: Array, is_missing: Array, is_known: Array, has_command: Array) -> bool:
    """Test whether the controller did not receive the measurements that are missing.

    Its command is then what its law gives for a measurement of zero, or for the expected one, and a regression on both leaves as
    little of it as the law leaves where the measurement is known. A command that follows from a measurement leaves as much as a
    prediction from the past alone.

    Parameters
    ----------
    y, u : Array
        Measurements, any numbers where one is missing, and commands, (n, k).
    is_missing, is_known : Array
        Which measurements are missing, and which are neither missing nor outlying, bool (n,).
    has_command : Array
        Which commands are in the record, bool (n,).

    Returns
    -------
    bool
        False also where there are fewer than PER_COEFFICIENT frames per coefficient.
    """
    windows = ((is_known, ORDER), (has_command, ORDER + 1))
    known, sent = (np.asarray(sliding_window_view(x, n).all(axis=1)) for x, n in windows)
    since = known[:-1] & sent
    past, k, now, gone = past_of(y, u), u.shape[1], since & is_known[ORDER:], since & is_missing[ORDER:]
    if np.count_nonzero(now) < PER_COEFFICIENT * past.shape[1] or np.count_nonzero(gone) < PER_COEFFICIENT * 2 * k:
        return False
    y, u, past, now_past = y[ORDER:], u[ORDER:], past[gone], past[now]
    both = np.column_stack([now_past, y[now]])
    law, expected = (np.linalg.lstsq(x, u[now], rcond=1e-10)[0] for x in (both, now_past))
    n, p = now_past.shape
    own, new = (np.sum((u[now] - x @ c) ** 2) * (n + p) / (n * (n - p)) for x, c in ((both, law), (now_past, expected)))
    hints = np.column_stack([past @ law[:-k], past @ expected])
    left = u[gone] - hints @ np.linalg.lstsq(hints, u[gone], rcond=1e-10)[0]
    return bool(np.sum(left**2) / (len(left) - 2 * k) < 0.5 * (own + new))


def smooth_basis() -> Array:
    """Return an orthonormal basis of the polynomials that smooth responses are, (SPAN, DEGREE + 1)."""
    return np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, SPAN), DEGREE + 1))[0]


def guess_plant(data: PlantLikelihood) -> tuple[Array, float, Array]:
    """Return a plant to start from, but for its delay, the share of what is new in u that y does not explain, and that (n, k).

    Sign and angle are those under which the commands reduce what is new in the measurements, or, where most of the commands does
    not follow from them, those of the strongest response to it; the gain is 1 or, where that is far
    off, as of other units, the one that makes the response of the disturbance smoothest: with w[k] the error of the prediction of
    y[k] from the past, h[i] = cov(y[k+i], w[k]) / var(w) and g[i] the same of u, that response is h[i] - gain R g[i - delay].

    What is new is known where none of ORDER + 1 frames is missing; where that is hardly ever so no share is known: 0.
    """
    y, u, k, n = data.filled_y, data.u[0], data.k, data.n - ORDER
    known = np.asarray(sliding_window_view(~np.isnan(data.y).any(axis=1), ORDER + 1).all(axis=1))
    is_enough = np.count_nonzero(known) >= PER_COEFFICIENT * 2 * k * ORDER
    w, v = prediction_errors(y, u, known if is_enough else None)
    turn = -np.linalg.lstsq(w, v, rcond=None)[0]
    own = v + w @ turn
    excited = float(np.sum(own**2) / max(np.sum(v**2), 1e-300)) if is_enough else 0.0
    source, basis = (w if excited < 0.5 else own)[: n - SPAN], smooth_basis()
    inverse = np.linalg.pinv(source.T @ source)
    h, g = (np.array([x[ORDER + i : ORDER + i + len(source)].T @ source @ inverse for i in range(SPAN + 1)]) for x in (y, u))
    if excited >= 0.5:  # commands of their own: what they do is seen directly
        turn = max(h[1:], key=np.linalg.norm)
    flip, angle = np.sign(turn), 0.0
    if k == 2:
        flip = np.diag([1.0, np.sign(np.linalg.det(turn))])
        near = turn @ flip  # the nearest rotation
        angle = float(np.arctan2(near[1, 0] - near[0, 1], near[0, 0] + near[1, 1]))
    R = rotation_matrix(angle)[:k, :k] @ flip

    def rough(x: Array) -> Array:
        """Return what a polynomial leaves of responses (SPAN, k, k)."""
        return x - np.tensordot(basis @ basis.T, x, 1)

    best = (0.0, 1.0)
    for delay in range(1, LONGEST + 1):
        seen = R @ rough(np.concatenate([np.zeros((delay - 1, k, k)), g[: SPAN - delay + 1]]))
        product, power = float(np.sum(rough(h[1:]) * seen)), float(np.sum(seen**2))
        if product > 0 and power > 0:
            best = max(best, (product**2 / power, product / power))
    explained = best[0] > 0.5 * np.sum(rough(h[1:]) ** 2)
    gain = best[1] if explained and not FAR < best[1] < 1.0 / FAR else 1.0
    own = np.vstack([np.zeros((ORDER, k)), own])
    return np.concatenate([np.zeros(k), gain * np.diag(flip), [angle] * (k == 2)]), excited, own
