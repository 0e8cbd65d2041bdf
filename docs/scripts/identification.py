"""The figures of docs/identification.md, over seeds: `identification.py [seeds] [duration] [parts] [presets]`.

parts : which of search, flow, filters, coverage, all unless told. Every seed that went wrong is printed.
presets : which of paper, ut4, galacsi-nfm, of flow and filters, all unless told.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from math import pi, sqrt
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.stats import binomtest, ncx2

from wfsobs import PRESETS, Record, Scenario, observe, simulate
from wfsobs.identification import Identification, identify
from wfsobs.identification.identification import ALONE, LEVEL
from wfsobs.signal.autoregressive import Ar2
from wfsobs.simulation.disturbance import turbulence_process
from wfsobs.simulation.sensing import lgs_error_process, lgs_noise_rms
from wfsobs.simulation.true_spectra import true_spectra
from wfsobs.spectral.search import BELOW, LOWEST, OF_LINES, STRUCTURES

QUIET: dict[str, Any] = {"vibration.source": "none"}
"""Turbulence and noise alone."""
LINES, RESONANCES = (15.3, 23.77, 41.13, 70.031), ((11.0, 0.02), (30.0, 0.02), (52.0, 0.01))
"""Frequency [Hz] of pure lines; frequency and damping of resonances."""
IN_ONE_BIN, ABOVE_FLOOR = 20.0, 5.0
"""Power of a line over the floor of a bin of 1 / T; density of a resonance over the floor, at its maximum."""
THRESHOLD = 0.1
"""Error of a frequency that always counts as found [Hz]."""


def floor(scenario: Scenario, f: float) -> float:
    """Density [um^2/Hz] of turbulence, slow LGS error and noise in tip at f [Hz]."""
    at, dt = np.array([f]), scenario.dt
    slow = turbulence_process(scenario, 0, dt).psd(at) + lgs_error_process(scenario, 0, dt).psd(at)
    return float(slow[0]) + 2.0 * dt * lgs_noise_rms(scenario, 0) ** 2


def power(level: float, density: Callable[[float], float], duration: float) -> float:
    """Probability that a search of this level, `density` of it per Hz, sees a line of IN_ONE_BIN at its own frequency or beside
    it; mean over LINES. Over the frequencies beside it 2 I / S is noncentral chi squared of three degrees of freedom."""

    def passed(f: float) -> float:
        u = brentq(lambda u: np.exp(-u) * (1.0 + sqrt(pi * u / 3.0)) - level * density(f) / duration, 1.0, 60.0)
        return float(ncx2.sf(2.0 * u, 3, 2.0 * IN_ONE_BIN))

    return float(np.mean([passed(f) for f in LINES]))


def theory(duration: float) -> str:
    """What can be had: the search as it is in one of two modes and in a single mode; and one that looks for nothing but lines
    below STRUCTURES, at 5 %, in two modes and in one."""
    below = 1.0 / np.log(STRUCTURES / LOWEST)
    levels = {
        "as it is": ALONE * OF_LINES * LEVEL / 2 * BELOW,
        "as it is, one mode": OF_LINES * LEVEL * BELOW,
        "lines alone, all at 5 %": 0.025,
        "lines alone, one mode, at 5 %": 0.05,
    }
    return "; ".join(f"{name} {power(level, lambda f: below / f, duration):.1%}" for name, level in levels.items())


def known_peaks(duration: float, modes: int = 2, level: float = IN_ONE_BIN) -> Scenario:
    """The preset `paper` with LINES and RESONANCES for its peaks, in tip and tilt or in tip alone. To lines, the resonances are
    part of the floor."""
    s = PRESETS["paper"]().replace({"run.duration": duration, "vibration.cutoff": 200.0})
    peaks = [(f, xi, sqrt(ABOVE_FLOOR * floor(s, f) * pi * xi * f)) for f, xi in RESONANCES]
    shapes = [Ar2(2.0 * pi * f, xi, rms, s.dt) for f, xi, rms in peaks]
    skirts = {f: sum(float(p.psd(np.array([f]))[0]) for p in shapes) for f in LINES}
    peaks += [(f, 0.0, sqrt(level * (floor(s, f) + skirts[f]) / duration)) for f in LINES]
    return s.replace({"vibration.peaks": [{"frequency": f, "damping": xi, "rms": [rms] * modes} for f, xi, rms in sorted(peaks)]})


def hits(result: Identification, scenario: Scenario) -> tuple[list[tuple[float, bool, bool]], int]:
    """(frequency, pure, found) of every peak in every mode that has it, and the number of peaks found that there are not."""
    out, false = [], 0
    for i, mode in enumerate(result.modes):
        free = list(mode.peaks)
        for peak in scenario.vibration.peaks if scenario.vibration.source != "none" else []:
            if i >= len(peak.rms) or not peak.rms[i]:
                continue
            near = [p for p in free if abs(p.frequency.value - peak.frequency) <= max(THRESHOLD, 3.0 * p.frequency.std)]
            if near:
                free.remove(min(near, key=lambda p: abs(p.frequency.value - peak.frequency)))
            out.append((peak.frequency, peak.damping == 0, bool(near)))
        false += len(free)
    return out, false


def found(scenario: Scenario, seeds: range, modes: int = 2) -> str:
    """Share of lines and resonances found in the first modes of a record, and of records with a false peak, as a row."""
    lines: list[bool] = []
    resonances: list[bool] = []
    false, coloured = [], []
    for seed in seeds:
        s = scenario.replace({"run.seed": seed})
        record = simulate(s)
        result = identify(Record(record.y_lgs[:, :modes], record.u[:, :modes], record.dt, delay=record.delay))
        hit, wrong = hits(result, s)
        lines += [ok for _, pure, ok in hit if pure]
        resonances += [ok for _, pure, ok in hit if not pure]
        false += [seed] * (wrong > 0)
        coloured += [seed] * (not result.white)
    shares = [f"{np.mean(x):.1%}" if x else "-" for x in (lines, resonances)]
    return " | ".join([*shares, counted(false, seeds), f"{len(seeds) - len(coloured)} of {len(seeds)}"])


def counted(those: list[int], seeds: range) -> str:
    """How many of the seeds, and which."""
    return f"{len(those)} of {len(seeds)}" + (f" (seeds {', '.join(map(str, those))})" if those else "")


def drawn(scenario: Scenario, seed: int) -> Record:
    """A Gaussian record of tip and tilt with the spectra that the scenario's z has, the mirror at rest: of frozen flow in a
    fraction of the time of a simulation. The DFT is longer than the record, which therefore does not come round."""
    rng, steps = np.random.default_rng(1000 + seed), round(scenario.run.duration / scenario.dt)
    z = []
    for mode in (0, 1):
        S = true_spectra(scenario, mode).measurement
        n = 2 * (len(S) - 1)
        z.append(np.fft.irfft(np.sqrt(S) * np.fft.rfft(rng.standard_normal(n)), n)[:steps])
    return Record(np.column_stack(z), np.zeros((steps, 2)), scenario.dt)


def flow(scenario: Scenario, seeds: range, modes: int = 2) -> str:
    """Of frozen flow without vibration: records in which a peak is found, and modes whose rest is white, as a row."""
    records = {seed: drawn(scenario.replace(QUIET), seed) for seed in seeds}
    results = {seed: identify(Record(r.y_lgs[:, :modes], r.u[:, :modes], r.dt)) for seed, r in records.items()}
    white = [mode.whiteness.white for r in results.values() for mode in r.modes]
    return f"{counted([seed for seed, r in results.items() if r.peaks], seeds)} | {sum(white)} of {len(white)}"


NOISE, TURBULENCE = 0.014, (7.0686, 0.9, 0.5)
"""Of `coverage`: rms of the noise [um]; omega [rad/s], damping, rms [um] of turbulence."""
WITH = ((30.0, 0.02, 0.008), (52.0, 0.01, 0.006), (20.3, 0.0, 0.002), (70.031, 0.0, 0.0015))
"""Frequency [Hz], damping, rms [um] of its peaks."""
KINDS = {
    "nothing lost": (1000.0, 0.0),
    "3 % lost": (1000.0, 0.03),
    "10 % lost": (1000.0, 0.1),
    "30 % lost": (1000.0, 0.3),
    "2 kHz, nothing lost": (2000.0, 0.0),
    "10 % lost in gaps of 0.3 s": (1000.0, 0.1, 300),
}
"""Rate [Hz], share of lost frames, and frames of a gap of its records."""


def lossy(seed: int, duration: float, rate: float, lost: float, gap: int = 1) -> Record:
    """One mode of AR(2) processes, random from the first sample on, of which a share is lost, in gaps of some frames."""
    rng, dt, n = np.random.default_rng(seed), 1.0 / rate, round(duration * rate)
    z = NOISE * rng.standard_normal(n) + Ar2(*TURBULENCE, dt).sample(n, rng)
    for f, xi, rms in WITH:
        pure = sqrt(2.0) * rms * np.cos(2.0 * pi * f * dt * np.arange(n) + rng.uniform(0.0, 2.0 * pi))
        z += pure if xi == 0 else Ar2(2.0 * pi * f, xi, rms, dt).sample(n, rng)
    z[np.convolve(rng.random(n) < lost / gap, np.ones(gap))[:n] > 0] = np.nan
    return Record(z[:, None], np.zeros((n, 1)), dt)


def held(seeds: range, duration: float, *losses: Any) -> tuple[dict[str, Counter[str]], str]:
    """By quantity, how many of the 95 % intervals, 1.96 stated standard deviations, hold the truth ("held"), of how many
    ("stated"), and how many numbers state none ("none"); and the records with a peak more."""
    out: dict[str, Counter[str]] = {}
    more = []
    for seed in seeds:
        mode = identify(lossy(seed, duration, *losses)).modes[0]
        omega, damping, rms = TURBULENCE
        pairs = [("noise", mode.noise, NOISE)]
        if t := mode.turbulence:
            pairs += [
                ("turbulence, corner", t.frequency, omega / (2.0 * pi)),
                ("turbulence, damping", t.damping, damping),
                ("turbulence, rms", t.rms, rms),
            ]
        more += [seed] * (len(mode.peaks) > len(WITH))
        for f, xi, rms in WITH:
            near = [p for p in mode.peaks if p.pure == (xi == 0) and abs(p.frequency.value - f) < max(0.3, 4.0 * p.frequency.std)]
            for p in sorted(near, key=lambda p: abs(p.frequency.value - f))[:1]:
                kind = "resonances" if xi else "lines"
                pairs += [
                    (f"{kind}, frequency", p.frequency, f),
                    (f"{kind}, rms", (p.ensemble_rms or p.rms) if xi else p.rms, rms),
                ]
                pairs += [("resonances, damping", p.damping, xi)] if xi else []
        for name, number, true in pairs:
            stated = bool(np.isfinite(number.std))
            inside = stated and abs(number.value - true) < 1.96 * number.std
            out.setdefault(name, Counter()).update(held=int(inside), stated=int(stated), none=int(not stated))
    return out, counted(more, seeds)


def share(of: Counter[str]) -> str:
    """How many hold, of how many, with the 95 % interval of the share in percent (Clopper and Pearson); how many state none."""
    low, high = binomtest(of["held"], of["stated"]).proportion_ci() if of["stated"] else (0.0, 1.0)
    none = f", {of['none']} none" if of["none"] else ""
    return f"{of['held']} of {of['stated']} ({100.0 * low:.0f} - {100.0 * high:.0f}){none}"


def coverage(count: int, duration: float) -> None:
    """Intervals that hold the truth, as a table: records of their own for every column, and all together."""
    columns = []
    for i, (name, losses) in enumerate(KINDS.items()):
        seeds = range(i * count + 1, (i + 1) * count + 1)
        found, more = held(seeds, duration, *losses)
        columns.append(found)
        print(f"{name}: seeds {seeds[0]} to {seeds[-1]}; a peak more: {more}", flush=True)
    print(f"| | {' | '.join(KINDS)} | all |\n|{'---|' * (len(KINDS) + 2)}")
    for name in columns[0]:
        cells = [found[name] for found in columns]
        print(f"| {name} | {' | '.join(map(share, [*cells, sum(cells, Counter())]))} |", flush=True)


def spread(scenario: Scenario, seeds: range) -> dict[str, Any]:
    """Standard deviation of (estimate - truth) over the standard deviation that is stated, where one is, by quantity, tip."""
    truth = turbulence_process(scenario, 0, scenario.dt)
    scores: dict[str, list[float]] = {}
    for seed in seeds:
        m = identify(simulate(scenario.replace({"run.seed": seed}))).modes[0]
        pairs = [("noise", m.noise, scenario.sensors.lgs_noise / sqrt(scenario.sensors.lgs_count))]
        if m.turbulence:
            pairs += [
                ("corner", m.turbulence.frequency, truth.omega / (2 * pi)),
                ("damping of turbulence", m.turbulence.damping, truth.damping),
            ]
        for peak in scenario.vibration.peaks:
            for p in m.peaks:
                if abs(p.frequency.value - peak.frequency) <= THRESHOLD * 5 and p.pure == (peak.damping == 0):
                    kind = "line" if p.pure else "resonance"
                    pairs += [(f"{kind}, frequency", p.frequency, peak.frequency)]
                    pairs += [(f"{kind}, rms", p.rms if p.pure else p.ensemble_rms or p.rms, peak.rms[0])]
                    pairs += [] if p.pure else [("resonance, damping", p.damping, peak.damping)]
        for name, n, value in pairs:
            scores.setdefault(name, []).extend([(n.value - value) / n.std] * bool(np.isfinite(n.std)))
    return {name: f"{np.sqrt(np.mean(np.square(x))):.2f}" for name, x in scores.items()}


def filters(scenario: Scenario, seeds: range) -> str:
    """Error of the multi-peak Kalman filter built from what was found in one record over that of the filter built from the
    truth, both on another record: vibration and turbulence, worst of tip and tilt; median, largest, share within 5 %."""
    ratios: dict[str, list[float]] = {"turbulence": [], "vibration": []}
    for seed in seeds:
        s = scenario.replace({"run.seed": seed})
        model = identify(simulate(s)).scenario(s)
        test = simulate(s.replace({"run.seed": seed + 10_000}))
        errors = [{(e.target, e.mode): e.rms for e in observe(test, x, observers=["kf-multi"]).scores} for x in (model, s)]
        for target, values in ratios.items():
            values.append(max(errors[0][key] / errors[1][key] for key in errors[1] if key[0] == target))
    return "; ".join(
        f"{target} {np.median(r):.3f} (up to {max(r):.3f}), {np.mean(np.array(r) < 1.05):.0%} below 1.05, by seed "
        + " ".join(f"{x:.3f}" for x in r)
        for target, r in ratios.items()
    )


def twin(record: Record) -> Record:
    """The record with the mirror at rest."""
    assert record.open_loop_y is not None
    return replace(record, y_lgs=record.open_loop_y, u=np.zeros_like(record.u))


def twins(scenario: Scenario, seeds: range) -> str:
    """Largest difference between closed loop and open loop, in standard deviations, and whether the same peaks are found."""
    worst, same = 0.0, True
    for seed in seeds:
        record = simulate(scenario.replace({"run.seed": seed}))
        a, b = identify(record), identify(twin(record))
        for one, other in zip(a.modes, b.modes, strict=True):
            same &= len(one.peaks) == len(other.peaks)
            for p, q in zip(one.peaks, other.peaks, strict=False):
                worst = max(
                    worst,
                    abs(p.frequency.value - q.frequency.value) / p.frequency.std,
                    abs(p.rms.value - q.rms.value) / p.rms.std,
                )
    return f"{worst:.1e} standard deviations; the same peaks: {'yes' if same else 'no'}"


if __name__ == "__main__":
    count, duration = int(sys.argv[1]) if len(sys.argv) > 1 else 100, float(sys.argv[2]) if len(sys.argv) > 2 else 60.0
    parts = [word for word in sys.argv[3:] if word not in PRESETS] or ["search", "flow", "filters", "coverage"]
    presets = [word for word in sys.argv[3:] if word in PRESETS] or ["paper", "ut4", "galacsi-nfm"]
    measured = [name for name in ("ut4", "galacsi-nfm") if name in presets]
    seeds, few = range(1, count + 1), range(1, max(count // 2, 2) + 1)
    quiet = PRESETS["paper"]().replace({**QUIET, "run.duration": duration})
    resonant = PRESETS["paper"]().replace({"run.duration": duration, "vibration.source": "ar2"})
    print(f"{count} seeds, {duration:g} s", flush=True)
    if "search" in parts:
        print("| Record | lines found | resonances found | records with a false peak | white |\n|---|---|---|---|---|")
        print("| turbulence and noise alone |", found(quiet, seeds), "|", flush=True)
        print("| lines and resonances in tip and tilt |", found(known_peaks(duration), seeds), "|", flush=True)
        print("| the same in tip alone |", found(known_peaks(duration, 1), seeds), "|", flush=True)
        print("| in tip alone, lines at 30 times the floor |", found(known_peaks(duration, 1, 30.0), seeds), "|", flush=True)
        print("| a record of tip alone |", found(known_peaks(duration, 1), seeds, 1), "|", flush=True)
        print("| in tip alone, record twice as long |", found(known_peaks(2 * duration, 1), seeds), "|\n", flush=True)
        print("Lines, at best:", theory(duration), flush=True)
        print("Closed against open loop:", twins(known_peaks(duration), range(1, 4)), flush=True)
        print("Error over stated standard deviation:", spread(known_peaks(duration, 2, 40.0), seeds), flush=True)
    if "flow" in parts:
        for name in measured:
            scenario = PRESETS[name]().replace({"run.duration": duration})
            short = scenario.replace({"run.duration": duration / 2})
            print(f"| frozen flow of {name} without vibration |", flow(scenario, seeds), "|", flush=True)
            print("| tip of it alone, half as long |", flow(short, seeds, 1), "|", flush=True)
    if "filters" in parts:
        for name in measured:
            scenario = PRESETS[name]().replace({"run.duration": duration})
            print(f"Filters, {name} with its vibration:", filters(scenario, range(1, 6)), flush=True)
        if "paper" in presets:
            print("Filters, known peaks:", filters(known_peaks(duration), few), flush=True)
            print("Filters, peaks of the paper:", filters(resonant, few), flush=True)
    if "coverage" in parts:
        coverage(count, duration)
