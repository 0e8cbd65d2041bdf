"""The Kalman filter of one mode: its model, its gains, and how sure it is; and those of all modes together.

They run frame by frame, with gaps, and over a record at once where nothing is missing.

A process of poles exp(s_i T) with the continuous-time s_i goes on for f frames by A^f, the matrix power. With S the covariance of
the model and P that of the estimate after a measurement, the error of the prediction has the covariance

    A^f P A^f' + S - A^f S A^f'.

A measurement that is missing is NaN. Near it the gains are those of the covariance as it is there (`wfsobs.signal.gains`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import block_diag, fractional_matrix_power

from wfsobs.observers.step import Estimator, StepError, run_frames, whole_frames
from wfsobs.observers.stepping import FilterBank, Gain, GainCycle, Saved
from wfsobs.prior import Prior
from wfsobs.progress import Watch
from wfsobs.record import TARGETS, Estimates, Measurements, Sampling, by_name
from wfsobs.signal.gains import ONE, GapGains, GapStep, SensorMean, Step, lyapunov
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.typing import Array


class ModeFilter(NamedTuple):
    """The filter of one mode.

    model    : of the disturbance, the first states of the filter
    gains    : of the filter
    posterior : covariance after the measurement, of every step that repeats; empty where it is not known
    cycle    : (A, C, Q, R) of every step that repeats, C zero where nothing is measured
    mean     : the LGS whose mean it measures
    """

    model: DisturbanceModel
    gains: GainCycle
    posterior: tuple[Array, ...] = ()
    cycle: tuple[Step, ...] = ()
    mean: SensorMean = ONE

    def rows(self, targets: Sequence[str]) -> Array:
        """Return rows of the whole state that give several targets, (len(targets), n)."""
        return self._pad_rows(self.model.output_rows(targets))

    def innovation_variances(self) -> list[float]:
        """Return the variance of z less its prediction at every step that repeats [um^2]."""
        before = zip(self.posterior[-1:] + self.posterior[:-1], self.cycle[-1:] + self.cycle[:-1], self.cycle, strict=True)
        rows = [(C[0] @ A, C[0], P, Q, R[0, 0]) for P, (A, _, Q, _), (_, C, _, R) in before]
        return [float(ahead @ P[: len(c), : len(c)] @ ahead + c @ Q @ c + r) for ahead, c, P, Q, r in rows]

    def steady_sd(self) -> Array:
        """Return `StatedErrors.sd` of every step that repeats, (steps, 4) [um]."""
        stated = StatedErrors(self)
        return np.array([stated.sd(P, j) for j, P in enumerate(self.posterior)])

    def gaps(self) -> GapGains:
        """Return the gains near gaps; steady again is what knows every process and the measurement as well as without one."""
        targets, (_, C, _, _) = self.rows(tuple(self.model.outputs)), self.cycle[-1]
        scale = np.mean([np.sum((targets @ P) * targets) for P in self.posterior])
        rows = np.vstack([self._pad_rows(self.model.pairs), C])
        return GapGains(self.cycle, self.posterior, rows, float(scale), self.mean)

    def digest(self) -> bytes:
        """Return what tells models apart."""
        return b"".join(x.tobytes() for step in (*self.cycle, (self.rows(TARGETS),), self.mean) for x in step)

    def _pad_rows(self, rows: Array) -> Array:
        return np.pad(rows, ((0, 0), (0, len(self.gains.steps[0].A) - rows.shape[1])))


def lgs_mean(prior: Prior, mode: int, has_slow_error: bool = False) -> SensorMean:
    """Return the LGS whose mean a filter measures, one where it is not told.

    has_slow_error : whether the slow error of all is in its model
    """
    return prior.stars[mode].sensor_mean(has_slow_error) if prior.stars else ONE


class StatedErrors:
    """Standard deviations [um] that a filter states after a step: of turbulence, vibration, their sum and the next z.

    The next z is c A x + noise. From the estimate s x_hat of the sum it differs by c A (x - x_hat) + (c A - s) x_hat + noise,
    of which x_hat is independent of x - x_hat.

    Parameters
    ----------
    mode : ModeFilter
        The filter.
    """

    def __init__(self, mode: ModeFilter):
        A, _, Q, _ = mode.cycle[-1]
        self._mode, self._targets = mode, mode.rows(TARGETS)
        self._S = lyapunov(block_diag(A, mode.mean.A), block_diag(Q, mode.mean.Q))  # but for a running NGS frame
        self._terms: dict[tuple[int, int], tuple[Array, Array]] = {}

    def sd(self, P: Array, j: int, stars: int = 0) -> Array:
        """Return them after step j of the cycle, (4,); P : covariance after the measurement, (n, n) or of more states.

        stars : LGS that the next z is the mean over, 0 for all
        """
        if (j, stars) not in self._terms:
            self._terms[j, stars] = self._rows(j, stars)
        rows, least = self._terms[j, stars]
        n = len(P)
        variances = np.einsum("ij,ij->i", rows[:, :n] @ P, rows[:, :n])
        variances[3] -= variances[4]
        return np.sqrt(np.maximum(variances[:4] + least, 0.0))

    def _rows(self, j: int, stars: int) -> tuple[Array, Array]:
        """Return rows of the state, (5, n), and what is added to the variances of the first four."""
        cycle, mean = self._mode.cycle, self._mode.mean
        (A, _, Q, R), C = cycle[j], cycle[(j + 1) % len(cycle)][1]
        c = np.append(C[0], mean.C[stars - 1])
        ahead, targets = c @ block_diag(A, mean.A), np.pad(self._targets, ((0, 0), (0, len(mean.A))))
        total = targets.sum(axis=0)
        other = ahead - total
        if np.abs(other).max() <= 1e-9 * np.abs(total).max():
            other = np.zeros_like(other)
        noise = c @ block_diag(Q, mean.Q) @ c + R[0, 0] * mean.noise[stars - 1] ** 2
        return np.vstack([targets, total, ahead, other]), np.array([0.0, 0.0, 0.0, other @ self._S @ other + noise])


STEADY, OPEN, CLOSED = range(3)
"""A mode after a step: in its steady state, near a gap, in the last step of that."""


class GapBank(FilterBank):
    """A bank of Kalman filters; NaN in `v` is a measurement that is missing.

    Attributes
    ----------
    stars : int or None
        Sensors that the first measurement of the next step is the mean over; None for all.

    Parameters
    ----------
    gains : sequence of GainCycle
        Of the modes, in their steady state.
    make_gaps : callable
        Mode -> its gains near gaps; called when there is one.
    means : sequence of SensorMean
        The sensors of the first measurement, by mode.
    """

    has_first: bool
    is_near: bool

    def __init__(self, gains: Sequence[GainCycle], make_gaps: Callable[[int], GapGains], means: Sequence[SensorMean]):
        super().__init__([one.estimator() for one in gains])
        self._sizes = [len(one.steps[0].A) for one in gains]
        self.stars: int | None = None
        self._all = [len(one.noise) for one in means]
        self._beside = np.zeros((len(gains), max(len(one.A) for one in means)))  # states that the mean over all does not see
        self._wide = [n + len(one.A) for n, one in zip(self._sizes, means, strict=True)]
        self.has_first, self._repeat = gains[0].first is not None, len(gains[0].steps)
        self._make_gaps = make_gaps
        self._gaps: dict[int, GapGains] = {}
        self.near: list[GapStep | None] = [None] * len(gains)
        self.is_near = False

    def advance(self) -> Array:
        """Take the inputs that have been written to `v`, NaN where there is none."""
        if self.is_near or self.stars is not None or np.isnan(self.v).any():
            self._advance_near()
            return self._e
        return super().advance()

    def _advance_near(self) -> None:
        there, stars = (~np.isnan(self.v)).astype(int), self.stars
        self.v[there == 0] = 0.0
        is_first = self.has_first and self.phase == 0
        if is_first:
            there[:, 1:] = 0  # it has no NGS frame, and is the step of the cycle before the first one
        others, j = [int(not is_first)] * (there.shape[1] - 1), (self.phase - self.has_first) % self._repeat
        before, v = self.x.copy(), self.v.copy()
        super().advance()
        for mode, (n, seen) in enumerate(zip(self._sizes, there, strict=True)):
            last, most, extra = self.near[mode], self._all[mode], self._wide[mode] - n
            last = None if last is None or last.is_last else last
            seen[0] *= most if stars is None else min(stars, most)
            if last is None:
                self._beside[mode] = 0.0
                if seen.tolist() == [most, *others]:
                    self.near[mode] = None
                    continue
            if mode not in self._gaps:
                self._gaps[mode] = self._make_gaps(mode)
            step = self.near[mode] = self._gaps[mode].after(last, j, tuple(seen.tolist()))
            after = step.update @ np.concatenate([before[mode, :n], self._beside[mode, :extra], v[mode]])
            self.x[mode, :n], self._beside[mode, :extra] = after[:n], after[n:]
        self.is_near = any(one is not None for one in self.near)

    @property
    def last_in_cycle(self) -> int:
        """Which step of the cycle came last."""
        return (self.last - self.has_first) % self._repeat

    def take_near(self, mode: int, old: GapBank | None) -> None:
        """Go on near a gap as another bank, of the same model in this mode; None for a steady state."""
        self.near[mode] = None if old is None else old.near[mode]
        self._beside[mode] = 0.0 if old is None else old._beside[mode]
        self.is_near = any(one is not None for one in self.near)

    def reset(self) -> None:
        """Set the state back to rest."""
        super().reset()
        self._settle()

    def _settle(self) -> None:
        self.near[:] = [None] * len(self.near)
        self.is_near, self.stars = False, None
        self._beside[...] = 0.0

    def save(self) -> Saved:
        """Return a copy of the state."""
        n = max(self._wide)
        kind, covariance = np.zeros(len(self.near), dtype=int), np.zeros((len(self.near), n, n))
        for mode, step in enumerate(self.near):
            if step is not None:
                kind[mode] = CLOSED if step.is_last else OPEN
                covariance[mode, : self._wide[mode], : self._wide[mode]] = step.posterior
        beside = {"beside": self._beside.copy()} if self._beside.size else {}
        return {**super().save(), "near": kind, "covariance": covariance, **beside}

    def load(self, state: Mapping[str, Array]) -> None:
        """Take over a state."""
        super().load(state)
        self._settle()
        if self._beside.size:
            self._beside[...] = state["beside"]
        for mode, (kind, covariance) in enumerate(zip(state["near"], state["covariance"], strict=True)):
            if kind != STEADY:
                n = self._wide[mode]
                self.near[mode], self.is_near = GapStep(covariance[:n, :n].copy(), np.zeros((n, 0)), kind == CLOSED), True


class Plan(NamedTuple):
    """A prediction of every mode: rows (n_modes, 1, n) of the state, mean (n_modes,) and sd (maps, n_modes)."""

    rows: Array
    mean: Array
    sd: Array

    @property
    def product(self) -> Array:
        """The mean as products of rows and states have it, (n_modes, 1, 1): a view."""
        return self.mean[:, None, None]


def plan(rows: Sequence[Array], n: int, sd: Array) -> Plan:
    """Return the plan of rows of the states of the modes, padded to n states."""
    padded = np.array([[np.pad(row, (0, n - len(row)))] for row in rows])
    return Plan(padded, np.zeros(len(rows)), sd)


class LinearEstimator(Estimator):
    """What Kalman filters share: a bank of filters in the state after the measurement, and rows of it per prediction."""

    state_names: tuple[str, ...] = ("bank",)

    def __init__(self, modes: Sequence[ModeFilter]):
        self.modes: tuple[ModeFilter, ...] = tuple(modes)
        self.bank: GapBank = GapBank([mode.gains for mode in modes], self._gaps, [mode.mean for mode in modes])
        self._of_equal: dict[bytes, GapGains] = {}
        self.mark_start()

    @property
    def _states(self) -> Array:
        return self.bank.x[:, :, None]

    def _gaps(self, mode: int) -> GapGains:
        """Return the gains near gaps of a mode; modes of equal models share them."""
        model = self.modes[mode].digest()
        return self._of_equal.setdefault(model, self._of_equal.get(model) or self.modes[mode].gaps())

    def take_over(self, old: Any) -> None:
        """Go on from another design; the states of LGS error and NGS frame stay as they are."""
        self.bank.phase, self.bank.last = old.bank.phase, old.bank.last
        for mode, (new, was) in enumerate(zip(self.modes, old.modes, strict=True)):
            is_same, own, x = new.digest() == was.digest(), self.bank.x[mode], old.bank.x[mode]
            if is_same:
                n = len(new.gains.steps[0].A)
                own[:n] = x[:n]
            else:
                n, m = len(new.model.A), len(was.model.A)
                own[:n] = carry_state(new.model, was.model, x[:m])
                if own[n:].shape == x[m:].shape:
                    own[n:] = x[m:]
            self.bank.take_near(mode, old.bank if is_same else None)


class KalmanEstimator(LinearEstimator):
    """Kalman filters of all modes, of the LGS or of both sensors.

    Parameters
    ----------
    modes : sequence of ModeFilter
        One per mode.
    """

    def __init__(self, modes: Sequence[ModeFilter]):
        super().__init__(modes)
        self._plans: dict[tuple[float, str], Plan] = {}
        self._variances: dict[int, Array] = {}
        self._record: tuple[Array, Array, list[StatedErrors]] | None = None

    @property
    def uses_ngs(self) -> bool:
        """Whether it takes NGS frames."""
        return self.bank.v.shape[1] > 1

    def see_stars(self, count: int | None) -> None:
        """Take the LGS measurement of the next frame for the mean over so many stars; None for all."""
        self.bank.stars = count

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        v = self.bank.v
        v[:, 0] = z
        if v.shape[1] > 1:
            v[:, 1] = 0.0 if ngs is None else ngs
        self.bank.advance()

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return (mean, sd) of the target."""
        one = self._plans.get((frames, target)) or self._plan(frames, target)
        np.matmul(one.rows, self._states, out=one.product)
        sd = one.sd[self.bank.last]
        return one.mean, self._near_gap(one, sd, target) if self.bank.is_near else sd

    def estimate(self) -> tuple[Array, Array]:
        """Return the estimates of the last frame, (2, n_modes), and what `StatedErrors` says of them, (4, n_modes)."""
        if self._record is None:
            n = self.bank.x.shape[1]
            rows = [np.pad(one.rows(TARGETS), ((0, 0), (0, n - len(one.gains.steps[0].A)))) for one in self.modes]
            steady = np.stack([one.steady_sd() for one in self.modes], axis=-1)
            self._record = np.array(rows), steady, [StatedErrors(one) for one in self.modes]
        rows, steady, stated = self._record
        j = self.bank.last_in_cycle
        sd = steady[j].copy() if self.bank.last or not self.bank.has_first else np.full(steady[j].shape, np.nan)
        for mode, near in enumerate(self.bank.near):
            if near is not None:
                stars = min(self.bank.stars or 0, len(self.modes[mode].mean.noise))  # of the next z, as of the last
                if stars not in near.sd:
                    near.sd[stars] = stated[mode].sd(near.posterior, j, stars)
                sd[:, mode] = near.sd[stars]
        return (rows @ self._states)[:, :, 0].T, sd

    def run(self, measurements: Measurements, watch: Watch) -> Estimates:
        """Run the filters over a record from rest: all steps at once where no measurement is missing."""
        v = sensor_inputs(measurements, measurements.ratio if self.uses_ngs else None)
        if np.isnan(v).any() or measurements.lgs_stars is not None:
            return run_frames(self, TARGETS, measurements, watch)
        columns, sd = [], []
        for mode, one in enumerate(self.modes):
            watch.step(mode / len(self.modes))
            columns.append(one.gains.recursion(one.rows(TARGETS)).run(v[:, :, mode]))
            sd.append(one.steady_sd())
        return by_target(columns, sd, first=int(self.bank.has_first))

    def _near_gap(self, plan: Plan, steady: Array, target: str) -> Array:
        """Return the standard deviations where some modes are near a gap."""
        out = steady.copy()
        for mode, (near, row) in enumerate(zip(self.bank.near, plan.rows[:, 0], strict=True)):
            if near is not None:
                model = self.modes[mode].model
                out[mode] = prediction_sd(model.outputs[target], row[: len(model.A)], self._variance(mode), near.posterior)
        return out

    def _variance(self, mode: int) -> Array:
        """Return the covariance of the disturbance of a mode."""
        if mode not in self._variances:
            self._variances[mode] = lyapunov(self.modes[mode].model.A, self.modes[mode].model.Q)
        return self._variances[mode]

    def _plan(self, frames: float, target: str) -> Plan:
        powers = [matrix_power(mode.model.A, frames) for mode in self.modes]
        rows = [mode.model.outputs[target] @ power for mode, power in zip(self.modes, powers, strict=True)]
        sd = np.full((len(self.bank.maps), len(rows)), np.nan)
        if self.modes[0].posterior:
            found = [
                [prediction_sd(one.model.outputs[target], row, self._variance(mode), P) for P in one.posterior]
                for mode, (one, row) in enumerate(zip(self.modes, rows, strict=True))
            ]
            sd[-len(found[0]) :] = np.array(found).T
        self._plans[frames, target] = out = plan(rows, self.bank.x.shape[1], sd)
        return out


def sensor_inputs(measurements: Measurements, ratio: int | None) -> Array:
    """Return z and NGS frames, (n_steps, 1 or 2, n_modes) [um], NaN where one is missing, 0 where none is due.

    ratio : steps per NGS frame; None for z alone
    """
    z = measurements.z[:, None]
    if ratio is None:
        return z
    frames = np.zeros_like(z)
    frames[ratio::ratio, 0] = measurements.z_ngs[ratio::ratio]
    return np.concatenate([z, frames], axis=1)


MakeFilter = Callable[[Any, Prior, int, Any], ModeFilter]
"""(settings, prior, mode, ratio) -> the filter of that mode; ratio : None where there are no NGS frames."""


def kalman_filters(make: MakeFilter, prior: Prior, settings: Any, sampling: Sampling, _horizon: float) -> KalmanEstimator:
    """Return the filters of all modes, each by itself. Raises ValueError where one has none."""
    return KalmanEstimator([make(settings, prior, mode, sampling.ratio) for mode in range(sampling.n_modes)])


class FrameEstimator(LinearEstimator):
    """Kalman filters on NGS frames, their estimates spread over the fast steps between them.

    Parameters
    ----------
    modes : sequence of ModeFilter
        The slow filters, one per mode.
    errors : sequence of FrameErrors
        Of the slow filters.
    spread : callable
        (mode, target, fast steps since the frame) -> row of the slow filter's state.
    holds : bool
        Whether an estimate is held until the next frame, so that any fraction of a frame is defined.
    """

    errors: Sequence[FrameErrors]

    uses_ngs = True
    state_names: tuple[str, ...] = ("bank", "_since", "_pairs")

    def __init__(
        self,
        modes: Sequence[ModeFilter],
        errors: Sequence[FrameErrors],
        spread: Callable[[int, str, int], Array],
        holds: bool,
    ):
        self._since = -1
        self._pairs = np.array([one.steady for one in errors])
        super().__init__(modes)
        self.errors, self._spread, self._holds = errors, spread, holds
        self._frame_plans: dict[tuple[int, float, str], Plan] = {}
        self._unknown = np.full(len(self.modes), np.nan)

    def advance(self, z: Array, ngs: Array | None, u: Array | None) -> None:
        """Take a frame."""
        if ngs is not None:
            self.bank.step(ngs[:, None])
            self._since = 0
            found = zip(self.errors, self._pairs, self.bank.near, strict=True)
            self._pairs = np.array([one.steady if near is None else one.after(S, near.update) for one, S, near in found])
        elif self._since >= 0:
            self._since += 1

    def predict(self, frames: float, target: str) -> tuple[Array, Array]:
        """Return the mean of the target; NaN before the first NGS frame."""
        ahead = 0 if self._holds else whole_frames(frames, "an estimate between NGS frames")
        since = max(self._since, 0)
        one = self._frame_plans.get((since, frames, target)) or self._plan(since, frames, ahead, target)
        np.matmul(one.rows, self._states, out=one.product)
        if self._since < 0:
            one.mean[...] = np.nan
            return one.mean, self._unknown
        return one.mean, self._sd(one.rows, since + frames, target, self._pairs) if self.bank.is_near else one.sd[0]

    def run(self, measurements: Measurements, watch: Watch) -> Estimates:
        """Run the filters over a record from rest: all frames at once where none is missing."""
        n, n_states = measurements.ratio, self.bank.x.shape[1]
        assert n is not None
        frames = measurements.z_ngs[n::n]
        if np.isnan(frames).any():
            return run_frames(self, TARGETS, measurements, watch)
        plans = [[self._plan(since, 0.0, 0, target) for since in range(n)] for target in TARGETS]
        rows = np.array([[one.rows[:, 0] for one in plan] for plan in plans])  # (targets, n, n_modes, n_states)
        columns = []
        for mode, one in enumerate(self.modes):
            watch.step(mode / len(self.modes))
            slow = one.gains.recursion(np.eye(n_states)[:, : len(one.model.A)]).run(frames[:, mode, None])
            fast = np.full((measurements.n_steps, len(TARGETS)), np.nan)
            fast[n:] = (slow @ rows[:, :, mode].swapaxes(1, 2)).reshape(len(TARGETS), -1).T[: measurements.n_steps - n]
            columns.append(fast)
        sd = np.array([[one.sd[0] for one in plan] for plan in plans]).T
        return by_target(columns, list(sd), first=n)

    def _plan(self, since: int, frames: float, ahead: int, target: str) -> Plan:
        n_modes, n = self.bank.x.shape
        rows = [self._spread(mode, target, since + ahead) for mode in range(n_modes)]
        self._frame_plans[since, frames, target] = out = plan(rows, n, np.zeros((1, n_modes)))
        out.sd[0] = self._sd(out.rows, since + frames, target, [one.steady for one in self.errors])
        return out

    def _sd(self, rows: Array, since: float, target: str, pairs: Iterable[Array]) -> Array:
        found = zip(self.errors, self.modes, rows[:, 0], pairs, strict=True)
        return np.array([one.sd(one.model.outputs[target], row[: len(f.model.A)], since, S) for one, f, row, S in found])

    def take_over(self, old: Any) -> None:
        """Go on from another design."""
        super().take_over(old)
        self._since = old._since
        found = zip(self.errors, old._pairs, self.bank.near, strict=True)
        self._pairs = np.array([now.steady if near is None else was for now, was, near in found])


class FrameErrors:
    """Errors of a filter that sees NGS frames alone, where its model is true at the fast step and a frame is the mean that it is.

    The pair (state xi of the fast model with the running frame, estimate x_hat) after a frame goes on from frame to frame as

        xi[i+1] = Phi xi[i] + w,    x_hat[i+1] = F x_hat[i] + L (c xi[i+1] + v).

    Attributes
    ----------
    model : DisturbanceModel
        At the fast step.
    steady : Array
        Its covariance, the same after every frame unless one is missing.

    Parameters
    ----------
    model : DisturbanceModel
        At the fast step.
    slow : Gain
        The filter of the frames.
    ratio : int
        Fast steps per frame.
    noise : float
        RMS of a frame's noise [um].
    """

    def __init__(self, model: DisturbanceModel, slow: Gain, ratio: int, noise: float):
        n = len(model.A)
        A, Q = block_diag(model.A, [[1.0]]), block_diag(model.Q, [[0.0]])
        A[n, :n] = sum(model.outputs.values()) / ratio
        Phi, W = np.diag([*np.ones(n), 0.0]), np.zeros_like(A)  # a frame that has been read starts anew
        for _ in range(ratio):
            Phi, W = A @ Phi, A @ W @ A.T + Q
        self.model, self._Phi, self._W, self._noise = model, Phi, W, noise
        self.steady: Array = lyapunov(*self._map((np.eye(len(slow.L)) - slow.L @ slow.C) @ slow.A, slow.L))

    def _map(self, F: Array, L: Array) -> tuple[Array, Array]:
        """Return transition and drive of the pair; F (n, n), L (n, 1): x_hat[i+1] = F x_hat[i] + L z[i+1]."""
        m, W = len(self._Phi), self._W
        seen = np.vstack([np.eye(m), L @ np.eye(m)[-1:]])
        transition = np.hstack([seen @ self._Phi, np.vstack([np.zeros((m, len(L))), F])])
        return transition, seen @ W @ seen.T + block_diag(np.zeros_like(W), self._noise**2 * L @ L.T)

    def after(self, S: Array, update: Array) -> Array:
        """Return the covariance after a frame with another gain; update (n, n + 1): of x_hat and the frame."""
        T, drive = self._map(update[:, :-1], update[:, -1:])
        return T @ S @ T.T + drive

    def sd(self, now: Array, row: Array, since: float, S: Array | None = None) -> float:
        """Return the standard deviation of the estimate row x_hat of now x, that many fast steps after the frame [um].

        S : covariance of the pair, by default the steady one
        """
        S, n, m = self.steady if S is None else S, len(self.model.A), len(self._Phi)
        ahead = now @ matrix_power(self.model.A, since)
        variance = now @ S[:n, :n] @ now - 2.0 * ahead @ S[:n, m:] @ row + row @ S[m:, m:] @ row
        return float(np.sqrt(max(variance, 0.0)))


def over_record(sd: Array, n_steps: int, first: int = 0) -> Array:
    """Return numbers that repeat, (steps that repeat, n_modes), for every step of a record from `first` on, NaN before."""
    if len(sd) == 1 and first == 0:
        return np.broadcast_to(sd, (n_steps, sd.shape[1]))
    out = np.full((n_steps, sd.shape[1]), np.nan)
    left = max(n_steps - first, 0)
    out[first:] = np.tile(sd, (-(-left // len(sd)), 1))[:left]
    return out


def by_target(columns: Sequence[Array], sd: Sequence[Array], first: int) -> Estimates:
    """Return results per mode (n_steps, n_targets) by target.

    sd : per mode (steps that repeat, 2 or 4), as of `by_name`, from step `first` on
    """
    spreads = by_name(np.stack(sd, axis=-1))
    return Estimates(
        by_name(np.stack(columns, axis=-1)), {name: over_record(x, len(columns[0]), first) for name, x in spreads.items()}
    )


def carry_state(new: DisturbanceModel, old: DisturbanceModel, x: Array) -> Array:
    """Return the state of another model in which the disturbance is what it is in the state x (n,) of the old one.

    With as many processes each has the same phi[k] and phi[k-1], else turbulence and vibration have as a whole. Of all such
    states it is the most likely one: coordinates are uncorrelated and of unit variance.
    """
    rows = [one.pairs if new.pairs.shape == old.pairs.shape else _sums(one) for one in (new, old)]
    return np.linalg.lstsq(rows[0], rows[1] @ x, rcond=1e-12)[0]


def _sums(model: DisturbanceModel) -> Array:
    """Rows (4, n) that give turbulence and vibration now and one step ago."""
    now, before = model.pairs[::2], model.pairs[1::2]
    is_turbulence = (now @ model.outputs["turbulence"] > 0.0).astype(float)
    return np.array([weight @ rows for weight in (is_turbulence, 1.0 - is_turbulence) for rows in (now, before)])


def prediction_sd(now: Array, row: Array, S: Array, P: Array) -> float:
    """Return the standard deviation of row x_hat for now x.

    now, row : (n,)
    S        : covariance of the disturbance, (n, n)
    P        : covariance after the measurement, (n, n) or of a longer state
    """
    n = len(S)
    return float(np.sqrt(max(now @ S @ now - row @ (S - P[:n, :n]) @ row, 0.0)))


def matrix_power(A: Array, frames: float) -> Array:
    """Return A^frames, for a fraction by its continuous-time model. Raises StepError where it has none."""
    if frames == int(frames):
        return np.linalg.matrix_power(A, int(frames))
    out = fractional_matrix_power(A, frames)
    if np.iscomplexobj(out) and np.abs(out.imag).max() > 1e-9 * np.abs(out.real).max():
        raise StepError(f"frames = {frames:g}: the model has no continuous-time form; takes a whole number")
    return np.real(out)
