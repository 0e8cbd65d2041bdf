"""The GPR tasks: online over a record and as a stream, offline training and prediction."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from statistics import median
from time import perf_counter

import numpy as np

from wfsobs.bench import external, textbook
from wfsobs.bench.external import SKLEARN
from wfsobs.bench.measure import OURS, Row, max_error, measure_time, row
from wfsobs.bench.sizes import Sizes
from wfsobs.observers.base import VIBRATION
from wfsobs.observers.baselines import online_reference
from wfsobs.observers.gpr.inputs import window_signals
from wfsobs.observers.gpr.kernels import SquaredExponential
from wfsobs.observers.gpr.offline import training_targets
from wfsobs.observers.gpr.online import gpr_online, kernel_of
from wfsobs.observers.gpr.stream import OnlineGprStream
from wfsobs.observers.gpr.trained import train
from wfsobs.prior import Bands
from wfsobs.priors_from.scenario import bands_of, prior_of
from wfsobs.progress import QUIET
from wfsobs.record import Record, pseudo_open_loop
from wfsobs.scenario import Scenario
from wfsobs.simulation.loop import simulate
from wfsobs.typing import Array

ENOUGH_FOR_P999 = 1000
"""Steps below which a 99.9th percentile says nothing."""


@dataclass(frozen=True)
class Online:
    """The online GPR of one mode as others see it.

    X, f   : a window (n, p) and a target (n,) for every step from depth - 1 on
    rows   : the windows, spread over the record, at which the others predict from the m windows before
    """

    X: Array
    f: Array
    m: int
    depth: int
    kernel: SquaredExponential
    rows: Array

    def error(self, estimates: Array, std: float, count: int) -> float:
        """Error over std of estimates at `rows`, at about `count` of them."""
        some = slice(None, None, -(-len(self.rows) // count))
        exact = textbook.exact_online(self.X, self.f, self.rows[some], self.m, self.kernel)
        return max_error(estimates[some], exact, std)


def online_problem(record: Record, scenario: Scenario, mode: int, count: int) -> Online:
    """Return the problem of one mode, with `count` rows for the others."""
    g = scenario.gpr_online
    X = textbook.windows(window_signals(g, record.y_lgs, record.u, record.z, mode, record.dt), g.depth)
    f = np.append(online_reference(bands_of(scenario), record.z, record.dt)[g.depth :, mode], 0.0)
    rows = np.unique(np.linspace(g.training_size, len(X) - 1, count).astype(int))
    return Online(X, f, g.training_size, g.depth, kernel_of(g), rows)


def cut_windows(record: Record, n_steps: int, n_modes: int) -> Record:
    """Return the start of a record, its measurements and commands alone."""
    part = np.s_[:n_steps, :n_modes]
    return Record(y_lgs=record.y_lgs[part], u=record.u[part], dt=record.dt)


def online_record(sizes: Sizes, libraries: Collection[str]) -> Iterator[Row]:
    """Time the online GPR over a record; `ours` is one mode, `ours-two-modes` both at the same time."""
    scenario = sizes.scenario(sizes.duration)
    record = simulate(scenario)
    yield from _online_record(record, scenario, sizes, libraries, sizes.textbook_steps, both=True)
    for m, depth in sizes.more_online:
        changes = {"gpr_online.training_size": m, "gpr_online.depth": depth}
        scenario = sizes.scenario(sizes.duration, changes)
        part = cut_windows(record, m + depth - 1 + sizes.more_steps, 1)
        yield from _online_record(part, scenario, sizes, (), max(1, sizes.textbook_steps // 4), both=False)


def _online_record(
    record: Record, scenario: Scenario, sizes: Sizes, libraries: Collection[str], count: int, both: bool
) -> Iterator[Row]:
    task, g = "online-gpr-record", scenario.gpr_online
    size = f"m={g.training_size} d={g.depth}"
    steps = record.n_steps - g.depth - g.training_size + 1
    ours = []
    for variant, n_modes in ((OURS, 1), ("ours-two-modes", 2)) if both else ((OURS, 1),):
        part = cut_windows(record, record.n_steps, n_modes)
        given = part.measurements(), prior_of(scenario, part, (Bands,)), g
        seconds, result = measure_time(lambda given=given: gpr_online(*given, QUIET)[VIBRATION], sizes.repeats)
        ours.append((variant, seconds, result[:, 0]))
    problem = online_problem(record, scenario, 0, count)  # only now: much memory held slows down the allocation of more
    std = float(np.nanstd(ours[0][2]))
    for variant, seconds, values in ours:
        error = problem.error(values[problem.rows + g.depth - 1], std, sizes.exact_steps)
        yield row(task, size, variant, seconds, steps, error=error)
    others: list[tuple[str, Callable[..., Array], int]] = [("gemm-cholesky", textbook.predict_online, count)]
    if SKLEARN in libraries:
        others.append((SKLEARN, external.sklearn_online, sizes.library_steps))
    for variant, predict, n in others:
        p = replace(problem, rows=problem.rows[:: -(-len(problem.rows) // n)])
        seconds, values = measure_time(lambda p=p, predict=predict: predict(p.X, p.f, p.rows, p.m, p.kernel), sizes.repeats)
        yield row(task, size, variant, seconds, len(p.rows), error=p.error(values, std, sizes.exact_steps))


def online_stream(sizes: Sizes, libraries: Collection[str]) -> Iterator[Row]:
    """Time the online GPR of one mode one sample at a time. Both prepare what does not need the sample."""
    scenario = sizes.scenario(sizes.duration)
    g = scenario.gpr_online
    task, size = "online-gpr-stream", f"m={g.training_size} d={g.depth}"
    record = cut_windows(simulate(scenario), scenario.n_steps, 1)
    runs = [_stream(scenario, record) for _ in range(sizes.repeats)]
    values = runs[-1][0]
    problem = online_problem(record, scenario, 0, sizes.textbook_steps)
    std = float(np.nanstd(values))
    error = problem.error(values[problem.rows + g.depth - 1], std, sizes.exact_steps)
    yield _stream_row(task, size, OURS, [times for _, times in runs], error)

    runs = [_textbook_stream(problem) for _ in range(sizes.repeats)]
    error = problem.error(runs[-1][0], std, sizes.exact_steps)
    yield _stream_row(task, size, "gemm-cholesky", [times for _, times in runs], error)


def _stream(scenario: Scenario, record: Record) -> tuple[Array, Array]:
    """Estimates (n_steps,), and for every step that has one: sample to estimate, whole step [s]."""
    stream = OnlineGprStream(scenario.gpr_online, bands_of(scenario), scenario.dt)
    values, times = np.empty(record.n_steps), np.empty((record.n_steps, 2))
    for k, (y, u) in enumerate(zip(record.y_lgs[:, 0].tolist(), record.u[:, 0].tolist(), strict=True)):
        start = perf_counter()
        values[k] = stream.estimate(y, u)
        ready = perf_counter()
        stream.update()
        times[k] = ready - start, perf_counter() - start
    return values, times[~np.isnan(values)]


def _textbook_stream(problem: Online) -> tuple[Array, Array]:
    """Time the textbook's version for the problem's rows; the preparation counts for the whole step."""
    stream = textbook.OnlineStream(problem.X, problem.m, problem.kernel)
    values, times = np.empty(len(problem.rows)), np.empty((len(problem.rows), 2))
    for k, r in enumerate(problem.rows):
        start = perf_counter()
        stream.prepare(r)
        sample = perf_counter()
        values[k] = stream.estimate(r, problem.f[r - problem.m : r])
        end = perf_counter()
        times[k] = end - sample, end - start
    return values, times


def _stream_row(task: str, size: str, variant: str, runs: list[Array], error: float) -> Row:
    ready, whole = np.concatenate(runs).T * 1e6
    p999 = float(np.percentile(whole, 99.9)) if len(whole) >= ENOUGH_FOR_P999 else None
    return row(
        task,
        size,
        variant,
        median(times[:, 1].sum() for times in runs),
        len(runs[0]),
        error=error,
        per_step_us=float(np.median(whole)),
        p999_us=p999,
        ready_us=float(np.median(ready)),
    )


def offline(sizes: Sizes, libraries: Collection[str]) -> Iterator[Row]:
    """Time the offline GPR of one mode: training, then prediction at every step of a record."""
    scenario = sizes.scenario(sizes.duration)
    record, g = simulate(scenario), scenario.gpr_offline
    training, kernel, d, m = record.training, kernel_of(g), g.depth, g.training_size
    assert training is not None
    task, size = "offline-gpr-train", f"m={m} d={d}"
    learn = window_signals(g, training.y_lgs, training.u, pseudo_open_loop(training.y_lgs, training.u), 0, record.dt)
    signals = window_signals(g, record.y_lgs, record.u, record.z, 0, record.dt)
    targets = training_targets(training, bands_of(scenario), record.dt)[:, 0]
    X, f, T = textbook.windows(learn, d)[:m], targets[d - 1 : d - 1 + m], textbook.windows(signals, d)
    exact, constant = textbook.exact_weights(X, f, kernel)
    some = slice(None, None, -(-len(T) // (50 * sizes.library_steps)))
    exact_mean = textbook.exact_predict(T[some], X, exact, constant, kernel)

    seconds, model = measure_time(lambda: train(learn, targets, d, m, kernel), sizes.repeats)
    yield row(task, size, OURS, seconds, error=max_error(model.weights, exact))
    seconds, weights = measure_time(lambda: textbook.train_textbook(X, f, kernel), sizes.repeats)
    yield row(task, size, "gemm-cholesky", seconds, error=max_error(weights, exact))
    regressor = None
    if SKLEARN in libraries:
        seconds, regressor = measure_time(lambda: external.sklearn_regressor(kernel).fit(X, f), sizes.repeats)
        yield row(task, size, SKLEARN, seconds, error=max_error(regressor.alpha_, exact))

    task = "offline-gpr-predict"
    seconds, values = measure_time(lambda: model.predict(signals)[d - 1 :], sizes.repeats)
    yield row(task, size, OURS, seconds, len(T), error=max_error(values[some], exact_mean))
    seconds, values = measure_time(lambda: textbook.predict_textbook(T, X, weights, kernel), sizes.repeats)
    yield row(task, size, "gemm-stored-weights", seconds, len(T), error=max_error(values[some], exact_mean))
    if regressor is not None:
        part = T[some]
        seconds, values = measure_time(lambda: regressor.predict(part), sizes.repeats)
        yield row(task, size, SKLEARN, seconds, len(part), error=max_error(values, exact_mean))
