"""The tasks of `wfsobs bench`: the observers, and the same work in the textbook's form or in another library's.

Each yields rows without their ratios. Gains are the same for all and found beforehand.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import median
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from wfsobs.bench import textbook
from wfsobs.bench.measure import (
    ENOUGH_FOR_P999,
    OURS,
    RATE,
    Latency,
    Row,
    back_to_back,
    max_error,
    measure_time,
    peak_memory_mb,
    reference_step,
    row,
    run_paced,
    set_aside,
    step_of,
    with_ratios,
)
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.execution import run_observer
from wfsobs.observers import OBSERVERS
from wfsobs.observers.base import TARGETS, VIBRATION
from wfsobs.observers.baselines import online_reference
from wfsobs.observers.gpr.offline import train, training_targets
from wfsobs.observers.gpr.online import gpr_online
from wfsobs.observers.gpr.windows import SquaredExponential, kernel_of, window_signals
from wfsobs.observers.kalman.adaptive import adapt
from wfsobs.observers.kalman.filters import multirate_filter, multirate_noise, steady_filter
from wfsobs.pipeline import run
from wfsobs.prior import Bands
from wfsobs.priors_from.scenario import bands_of, model_of, modelled_processes, prior_of, usual_observers
from wfsobs.progress import QUIET
from wfsobs.record import Record, pseudo_open_loop
from wfsobs.scenario import Scenario
from wfsobs.scenario.presets import paper
from wfsobs.signal.gains import steady_state
from wfsobs.signal.statespace import paper_matrices
from wfsobs.simulation.disturbance import SOURCES
from wfsobs.simulation.loop import simulate
from wfsobs.typing import Array

EXACT_STEPS = 3000
"""Steps compared with the textbook's loop in extended precision."""

PHI = np.array([0, 2])
"""Where phi_turb[k] and phi_vib[k] are in the paper's state."""

Library = Mapping[str, Callable[..., Any]]
"""Task -> function of its problem that returns the estimates.

"offline-gpr" instead takes training windows (m, p), targets (m,) and kernel, and returns the weights (m,) and the function from
windows (n, p) to their mean (n,).
"""


@dataclass(frozen=True)
class Sizes:
    """Sizes of all tasks; data and all other settings are those of the preset `paper`.

    settings          : changes to the preset
    duration          : record of the GPR tasks and of the whole run [s]
    filter_duration   : record of the Kalman filters [s]
    repeats           : every time is the median of at least so many
    textbook_steps    : steps of the textbook's online GPR; a quarter of them for `more_online`
    library_steps     : the same for a library; offline it predicts 50 times as many
    exact_steps       : steps at which GPR results are compared with a direct solve
    more_online       : further (m, d) of the online GPR
    more_steps        : predicted steps of each of these
    order, layers     : radial order and number of layers of the larger frozen-flow task
    step_count        : steps timed back to back, of every observer and controller
    paced_duration    : of such steps at a paced rate [s]
    longest_duration  : of a whole run of which the memory is measured too [s], or None
    libraries         : other libraries to compare with, by name
    """

    settings: Mapping[str, Any] = field(default_factory=dict)
    duration: float = 10.0
    filter_duration: float = 60.0
    repeats: int = 3
    textbook_steps: int = 32
    library_steps: int = 8
    exact_steps: int = 8
    more_online: tuple[tuple[int, int], ...] = ()
    more_steps: int = 2048
    order: int = 5
    layers: int = 10
    step_count: int = 2000
    paced_duration: float = 1.0
    longest_duration: float | None = None
    libraries: Mapping[str, Library] = field(default_factory=dict)

    def scenario(self, duration: float, changes: Mapping[str, Any] | None = None) -> Scenario:
        """Return the scenario of a task: preset, settings, duration [s], and the task's own changes."""
        return paper().replace({**self.settings, "run.duration": duration, **(changes or {})})

    def others(self, task: str) -> dict[str, Callable[..., Any]]:
        """Return the functions of the libraries that do a task, by library."""
        return {name: library[task] for name, library in self.libraries.items() if task in library}


QUICK = Sizes()
FULL = Sizes(
    step_count=20_000,
    paced_duration=60.0,
    more_online=((511, 1000), (1024, 170), (1024, 1000), (2048, 170), (2048, 1000)),
    longest_duration=60.0,
)


class KalmanProblem(NamedTuple):
    """The paper's filter of one mode.

    A to u  : arguments of `textbook.kalman_loop`, with the mirror in the state, n = 6
    Q, R, P : drive (4, 4) and noise [um^2] of the disturbances alone, and the steady covariance (4, 4) before a measurement
    z       : measurements without the mirror's part, (n_steps,)
    """

    A: Array
    B: Array
    C: Array
    L: Array
    y: Array
    u: Array
    Q: Array
    R: float
    P: Array
    z: Array


class MultirateProblem(NamedTuple):
    """Arguments of `textbook.multirate_loop`, with n = 6."""

    A: Array
    B: Array
    C: Array
    C_ngs: Array
    L: Array
    L_both: Array
    y: Array
    z_ngs: Array
    u: Array


@dataclass(frozen=True)
class OnlineProblem:
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


def time_row(
    task: str,
    size: str,
    variant: str,
    work: Callable[[], Any],
    repeats: int,
    steps: int | None = None,
    error: Callable[[Any], float] | None = None,
) -> Row:
    """Return the measurement of some work; error : of what it returns."""
    seconds, values = measure_time(work, repeats)
    return row(task, size, variant, seconds, steps, max_error_over_std=error and error(values))


def kalman_record(sizes: Sizes) -> Iterator[Row]:
    """Time the steady-state Kalman filter on LGS, one mode over a long record."""
    scenario = sizes.scenario(sizes.filter_duration)
    record, prior = simulate(scenario), model_of(scenario, 0)
    y, u = record.y_lgs[:, 0], record.u[:, 0]
    noise = prior.lgs_noise
    ours, _ = steady_filter(prior.disturbance(), noise)
    A, B, C, Q = paper_model(scenario, record.dt)
    steady = steady_state(A[:4, :4], C[:4], Q, np.array(noise**2))
    problem = KalmanProblem(A, B, C, _with_mirror(steady.L[:, 0]), y, u, Q, noise**2, steady.P, pseudo_open_loop(y, u))

    def run_ours() -> Array:
        return ours.run(pseudo_open_loop(y, u)[:, None])

    yield from _filters(sizes, "kalman-record", problem, run_ours, textbook.kalman_loop, problem[:6])


def multirate_record(sizes: Sizes) -> Iterator[Row]:
    """Time the paper's multi-rate filter, one mode over a long record."""
    scenario = sizes.scenario(sizes.filter_duration)
    record, prior = simulate(scenario), model_of(scenario, 0)
    assert record.ratio is not None
    y, u, z_ngs = record.y_lgs[:, 0], record.u[:, 0], record.z_ngs[:, 0]
    lgs, ngs = multirate_noise(scenario.multirate, prior)
    ours = multirate_filter(prior.disturbance(), record.ratio, lgs, ngs)
    A, B, C, Q = paper_model(scenario, record.dt)
    C_ngs = np.array([0.0, 1.0, 0.0, 1.0, 0.0, 0.0])  # of z_ngs, from which the mirror's part has been taken
    L = steady_state(A[:4, :4], C[:4], Q, np.array(lgs**2)).L[:, 0]
    L_both = steady_state(A[:4, :4], np.vstack([C[:4], C[:4]]), Q, np.diag([lgs**2, ngs**2])).L
    problem = MultirateProblem(A, B, C, C_ngs, _with_mirror(L), _with_mirror(L_both), y, z_ngs, u)

    def run_ours() -> Array:
        return ours.run(np.column_stack([pseudo_open_loop(y, u), np.nan_to_num(z_ngs)]))

    yield from _filters(sizes, "multirate-record", problem, run_ours, textbook.multirate_loop, problem)


def _filters(
    sizes: Sizes, task: str, problem: Any, ours: Callable[[], Array], loop: Callable[..., Array], arguments: tuple[Array, ...]
) -> Iterator[Row]:
    """Time our filter, the textbook's loop, and those of libraries, whose results are states."""
    exact = loop(*(a.astype(np.longdouble)[:EXACT_STEPS] for a in arguments))[:, PHI]
    n = len(arguments[-1])
    works = {"numpy-loop": lambda: loop(*arguments)} | {k: partial(v, problem) for k, v in sizes.others(task).items()}
    states = {name: lambda work=work: work()[:, PHI] for name, work in works.items()}

    def error(values: Array) -> float:
        return max(max_error(values[: len(exact), i], exact[:, i]) for i in range(len(TARGETS)))

    for variant, work in ({OURS: ours} | states).items():
        yield time_row(task, f"{n} steps, 6 states", variant, work, sizes.repeats, n, error)


def paper_model(scenario: Scenario, dt: float) -> tuple[Array, Array, Array, Array]:
    """Return A (6, 6), B (6,), C (6,) of the paper's state, and Q (4, 4) [um^2] of its disturbances."""
    turbulence, vibration = modelled_processes(scenario, 0, dt)
    drives = np.array([turbulence.drive_variance, 0.0, vibration.drive_variance, 0.0])
    return *paper_matrices(turbulence, vibration), np.diag(drives)


def _with_mirror(L: Array) -> Array:
    """Extend a gain (4, ...) of the disturbances to the paper's state, (6, ...), whose commands are known."""
    return np.concatenate([L, np.zeros((2, *L.shape[1:]))])


def adaptive_record(sizes: Sizes) -> Iterator[Row]:
    """Time the adaptive Kalman filter, one mode over a long record: identification and filter of every window."""
    scenario = sizes.scenario(sizes.filter_duration)
    z, a = simulate(scenario).z[:, 0], scenario.adaptive
    size = f"{len(z)} steps, {a.window:g} s every {a.interval:g} s"
    yield time_row("adaptive-record", size, OURS, lambda: adapt(z, scenario.dt, a, lambda _fraction: None), sizes.repeats, len(z))


def online_problem(record: Record, scenario: Scenario, count: int) -> OnlineProblem:
    """Return the problem of the first mode, with `count` rows for the others."""
    g = scenario.gpr_online
    X = textbook.windows(window_signals(g, record.y_lgs, record.u, record.z, 0, record.dt), g.depth)
    f = np.append(online_reference(bands_of(scenario), record.z, record.dt)[g.depth :, 0], 0.0)
    rows = np.unique(np.linspace(g.training_size, len(X) - 1, count).astype(int))
    return OnlineProblem(X, f, g.training_size, g.depth, kernel_of(g), rows)


def cut_windows(record: Record, n_steps: int, n_modes: int) -> Record:
    """Return the start of a record, its measurements and commands alone."""
    part = np.s_[:n_steps, :n_modes]
    return Record(y_lgs=record.y_lgs[part], u=record.u[part], dt=record.dt)


def online_record(sizes: Sizes) -> Iterator[Row]:
    """Time the online GPR over a record; `ours` is one mode, `ours-two-modes` both at the same time."""
    scenario = sizes.scenario(sizes.duration)
    record = simulate(scenario)
    yield from _online_record(record, scenario, sizes, sizes.textbook_steps, both=True)
    for m, depth in sizes.more_online:
        changes = {"gpr_online.training_size": m, "gpr_online.depth": depth}
        scenario = sizes.scenario(sizes.duration, changes)
        part = cut_windows(record, m + depth - 1 + sizes.more_steps, 1)
        yield from _online_record(part, scenario, sizes, max(1, sizes.textbook_steps // 4), both=False)


def _online_record(record: Record, scenario: Scenario, sizes: Sizes, count: int, both: bool) -> Iterator[Row]:
    task, g = "online-gpr-record", scenario.gpr_online
    size = f"m={g.training_size} d={g.depth}"
    steps = record.n_steps - g.depth - g.training_size + 1
    ours = []
    for variant, n_modes in ((OURS, 1), ("ours-two-modes", 2)) if both else ((OURS, 1),):
        part = cut_windows(record, record.n_steps, n_modes)
        estimator, given = gpr_online(prior_of(scenario, part, (Bands,)), g, part.sampling, 0.0), part.measurements()
        run = partial(estimator.run, given, QUIET)
        seconds, result = measure_time(lambda run=run: run()[VIBRATION], sizes.repeats)
        ours.append((variant, seconds, result[:, 0]))
    problem = online_problem(record, scenario, count)  # only now: much memory held slows down the allocation of more
    std = float(np.nanstd(ours[0][2]))
    for variant, seconds, values in ours:
        error = problem.error(values[problem.rows + g.depth - 1], std, sizes.exact_steps)
        yield row(task, size, variant, seconds, steps, max_error_over_std=error)
    others = [("gemm-cholesky", lambda p: textbook.predict_online(p.X, p.f, p.rows, p.m, p.kernel), count)]
    if both:
        others += [(name, predict, sizes.library_steps) for name, predict in sizes.others(task).items()]
    for variant, predict, n in others:
        p = replace(problem, rows=problem.rows[:: -(-len(problem.rows) // n)])
        error = partial(p.error, std=std, count=sizes.exact_steps)
        yield time_row(task, size, variant, partial(predict, p), sizes.repeats, len(p.rows), error)


def online_stream(sizes: Sizes) -> Iterator[Row]:
    """Time the online GPR of one mode one sample at a time. Both prepare what does not need the sample."""
    scenario = sizes.scenario(sizes.duration)
    g = scenario.gpr_online
    task, size = "online-gpr-stream", f"m={g.training_size} d={g.depth}"
    record = cut_windows(simulate(scenario), scenario.n_steps, 1)
    runs = [_stream(scenario, record) for _ in range(sizes.repeats)]
    values = runs[-1][0]
    problem = online_problem(record, scenario, sizes.textbook_steps)
    error = partial(problem.error, std=float(np.nanstd(values)), count=sizes.exact_steps)
    yield _stream_row(task, size, OURS, [times for _, times in runs], error(values[problem.rows + g.depth - 1]))

    runs = [_textbook_stream(problem) for _ in range(sizes.repeats)]
    yield _stream_row(task, size, "gemm-cholesky", [times for _, times in runs], error(runs[-1][0]))


def _stream(scenario: Scenario, record: Record) -> tuple[Array, Array]:
    """Estimates (n_steps,), and for every step that has one: sample to estimate, whole step [s]."""
    prior, sampling = prior_of(scenario, record, (Bands,)), record.sampling._replace(n_modes=1)
    estimator = gpr_online(prior, scenario.gpr_online, sampling, 0.0)
    values, times = np.empty(record.n_steps), np.empty((record.n_steps, 2))
    for k, (z, u) in enumerate(zip(record.z[:, :1], record.u[:, :1], strict=True)):
        start = perf_counter()
        estimator.advance(z, None, u)
        values[k] = estimator.predict(0.0, VIBRATION)[0][0]
        ready = perf_counter()
        estimator.settle()
        times[k] = ready - start, perf_counter() - start
    return values, times[~np.isnan(values)]


def _textbook_stream(problem: OnlineProblem) -> tuple[Array, Array]:
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
        max_error_over_std=error,
        per_step_us=float(np.median(whole)),
        p999_us=p999,
        ready_us=float(np.median(ready)),
    )


def offline(sizes: Sizes) -> Iterator[Row]:
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

    def fit_textbook() -> tuple[Array, Callable[[Array], Array]]:
        weights = textbook.train_textbook(X, f, kernel)
        return weights, lambda windows: textbook.predict_textbook(windows, X, weights, kernel)

    seconds, model = measure_time(lambda: train(learn, targets, d, m, kernel), sizes.repeats)
    yield row(task, size, OURS, seconds, max_error_over_std=max_error(model.weights, exact))
    means = {}
    libraries = {name: partial(fit, X, f, kernel) for name, fit in sizes.others("offline-gpr").items()}
    for name, fit in ({"gemm-cholesky": fit_textbook} | libraries).items():
        seconds, (weights, means[name]) = measure_time(fit, sizes.repeats)
        yield row(task, size, name, seconds, max_error_over_std=max_error(weights, exact))

    whole = {OURS: lambda: model.predict(signals)[d - 1 :], "gemm-stored-weights": partial(means.pop("gemm-cholesky"), T)}
    for name, predict in (whole | {name: partial(mean, T[some]) for name, mean in means.items()}).items():
        seconds, values = measure_time(predict, sizes.repeats)
        error = max_error(values[some] if name in whole else values, exact_mean)
        yield row("offline-gpr-predict", size, name, seconds, len(values), max_error_over_std=error)


ONE_LAYER: dict[str, Any] = {"turbulence.source": "frozen-flow"}
"""As the preset is otherwise: tip and tilt, one layer, two LGS on the axis and an NGS."""


def many_layers(sizes: Sizes) -> dict[str, Any]:
    """Modes up to the order and layers as the sizes say, four LGS beside the axis and an NGS."""
    return {
        "turbulence.source": "frozen-flow",
        "telescope.radial_order": sizes.order,
        "sensors.lgs_count": 4,
        "sensors.lgs_radius": 64.0,
        "turbulence.layers": [
            {"height": 2000.0 * i, "wind_factor": 0.4 + 0.2 * i, "wind_direction": 36.0 * i, "fraction": 0.1}
            for i in range(sizes.layers)
        ],
    }


def frozen(sizes: Sizes) -> Iterator[Row]:
    """Few modes in one layer and many in ten, through Shack-Hartmann sensors and through ideal ones."""
    for changes, repeats in ((ONE_LAYER, sizes.repeats), (many_layers(sizes), 1)):
        scenario = sizes.scenario(sizes.duration, changes)
        layers = len(scenario.turbulence.layers)
        size = f"{sizes.duration:g} s, {len(scenario.modes)} modes, {layers} layer{'s' if layers > 1 else ''}"
        for variant, kind in ((OURS, "shack-hartmann"), ("ideal-sensors", "zernike")):
            made = scenario.replace({"sensors.kind": kind})
            make = partial(SOURCES["frozen-flow"], made, made.n_steps)
            seconds, _ = measure_time(lambda make=make: make(np.random.default_rng(1), QUIET), repeats)
            yield row("frozen-flow", size, variant, seconds, scenario.n_steps, peak_memory_mb=peak_memory_mb())


def steps(sizes: Sizes) -> Iterator[Row]:
    """Time the step of every observer and controller with two modes, beside the reference."""
    scenario = sizes.scenario(sizes.duration)
    record = simulate(scenario)
    for name in (*OBSERVERS, *CONTROLLERS):
        try:
            step = step_of(name, scenario, record)
        except ValueError:
            continue
        settle = scenario.gpr_online.depth + scenario.gpr_online.training_size if "gpr" in name else 0
        for k in range(settle):
            step(k)
        n = sizes.step_count
        alone = [back_to_back(one, n) for one in (step, reference_step())]
        yield from _step_rows(f"{name}, 2 modes, back to back", alone)
        yield from _step_rows(
            f"{name}, 2 modes, {RATE:g} Hz", run_paced((step, reference_step()), max(round(sizes.paced_duration * RATE / 2), 1))
        )


def _step_rows(size: str, latencies: list[Latency]) -> Iterator[Row]:
    for variant, one in zip((OURS, "reference"), latencies, strict=True):
        yield row("step", size, variant, float(one.seconds.sum()), len(one.seconds), **one.percentiles())


def longest_run(sizes: Sizes) -> Iterator[Row]:
    """Time a long run and its memory."""
    if sizes.longest_duration is not None:
        scenario = sizes.scenario(sizes.longest_duration)
        seconds, _ = measure_time(lambda: run(scenario), 1)
        size = _length(sizes.longest_duration)
        yield row("whole-run", size, OURS, seconds, scenario.n_steps, peak_memory_mb=peak_memory_mb())


def whole_run(sizes: Sizes) -> Iterator[Row]:
    """Time simulation, every observer on two modes, and scores."""
    scenario, size = sizes.scenario(sizes.duration), _length(sizes.duration)
    learning = tuple(name for name, observer in OBSERVERS.items() if observer.slow)
    for variant, left_out in ((OURS, ()), ("without-online-gpr", ("gpr-online",)), ("without-learning", learning)):
        names = [name for name in usual_observers(scenario) if name not in left_out]
        yield time_row("whole-run", size, variant, partial(run, scenario, observers=names), sizes.repeats, scenario.n_steps)


def each_observer(sizes: Sizes) -> Iterator[Row]:
    """Every observer of the registry on the same record of two modes; one that has no estimate of it is left out."""
    scenario, size = sizes.scenario(sizes.duration), _length(sizes.duration)
    record = simulate(scenario)
    for name in OBSERVERS:
        try:
            work = partial(run_observer, name, record, scenario)
            found = time_row("observer", f"{name}, {size}", OURS, work, sizes.repeats, record.n_steps)
        except ValueError:
            continue
        yield found


def _length(duration: float) -> str:
    return f"{duration:g} s, 2 modes"


TASKS: dict[Callable[[Sizes], Iterator[Row]], float] = {
    longest_run: 1.0,  # first, so that the memory is its own; it comes last in the table
    online_record: 5.0,
    online_stream: 4.0,
    offline: 3.0,
    kalman_record: 2.0,
    multirate_record: 2.0,
    adaptive_record: 2.0,
    each_observer: 2.0,
    steps: 20.0,
    frozen: 20.0,
    whole_run: 3.0,
}
"""Task -> its share of the time."""


def measure_all(sizes: Sizes, progress: Callable[[float], None]) -> list[Row]:
    """Return every row. progress: receives the fraction done."""
    done, found = 0.0, list[list[Row]]()
    with threadpool_limits(1, user_api="blas"), set_aside():
        for task, weight in TASKS.items():
            found.append(with_ratios(list(task(sizes))))
            done += weight
            progress(done / sum(TASKS.values()))
    return [r for rows in [*found[1:], found[0]] for r in rows]
