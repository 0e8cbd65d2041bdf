"""The tables of docs/reproduction.md, as Markdown: `python docs/scripts/reproduction.py`, or with the names of some of them.

Every number is a median over seeds 1 ... 20 of the RMS error after the warm-up [nm], with the smallest and largest where a
range is shown. The `paper` preset unless a column says otherwise.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Sequence
from statistics import median

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # two are slower at these sizes; before numpy is loaded

import numpy as np

import wfsobs
from wfsobs.observers import OBSERVERS
from wfsobs.observers.kalman.filters import steady_filter
from wfsobs.priors_from.scenario import measurement_noise, modelled_processes
from wfsobs.record import Record, Training, by_name
from wfsobs.signal.autoregressive import Ar2
from wfsobs.signal.spectrum import bandpass_bank, filter_causal, filter_zero_phase, rms
from wfsobs.signal.statespace import disturbance_model

SEEDS = range(1, 21)
PRINTED = {"butterworth-ol": 7.66, "butterworth-cl": 13.4, "kf-lgs": 16.6, "gpr-offline": 12.4, "gpr-online": 13.3}
TURBULENCE = ("kf-lgs", "kf-ngs", "multirate", "multirate-optimal")
NAMES = {
    "butterworth-ol": "Butterworth, open loop",
    "butterworth-cl": "Butterworth, closed loop",
    "kf-lgs": "LGS KF",
    "kf-ngs": "NGS KF",
    "multirate": "Multi-rate KF",
    "multirate-optimal": "Optimal multi-rate KF",
    "gpr-offline": "Offline GPR",
    "gpr-online": "Online GPR",
    "zero": "Zero",
}
Errors = dict[tuple[str, str, str], list[float]]
"""(observer, target, mode) -> RMS error [nm] of every seed; observer "truth" -> rms of the truth."""


def errors(changes: dict[str, object], observers: Sequence[str] = tuple(NAMES), preset: str = "paper") -> Errors:
    """Run all the seeds with some settings changed; the observers of the tables unless told, scored from the warm-up on."""
    out: Errors = {}
    for seed in SEEDS:
        scenario = wfsobs.PRESETS[preset]().replace(changes | {"run.seed": seed})
        for s in wfsobs.run(scenario, observers=observers).scores:
            out.setdefault((s.observer, s.target, s.mode), []).append(s.rms * 1e3)
            if s.observer == "zero":
                out.setdefault(("truth", s.target, s.mode), []).append(s.truth_rms * 1e3)
    return out


def table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Print a Markdown table."""
    head = list(head)
    print("| " + " | ".join(head) + " |")
    print("|" + "---|" * len(head))
    for row in rows:
        print("| " + " | ".join(map(str, row)) + " |")
    print()


def middle(values: Sequence[float], spread: bool = True) -> str:
    """Median and range."""
    return f"{median(values):.2f} ({min(values):.2f} - {max(values):.2f})" if spread else f"{median(values):.1f}"


def ratio(values: Sequence[float], base: Sequence[float]) -> str:
    """Median of the ratios, seed by seed."""
    return f"{median(a / b for a, b in zip(values, base, strict=True)):.2f}"


def vibration() -> None:
    """The five numbers of the paper, beside the preset and beside the matched Kalman filter."""
    order = ("butterworth-ol", "butterworth-cl", "kf-lgs", "gpr-offline", "gpr-online", "zero")
    fitted, matched = errors({}, order), errors({"kalman.process_noise": "matched"}, ("kf-lgs",))
    for mode in ("tip", "tilt"):
        here = {name: fitted[name, "vibration", mode] for name in order}
        best, truth = matched["kf-lgs", "vibration", mode], fitted["truth", "vibration", mode]
        rows = [
            (
                NAMES[n],
                PRINTED.get(n, "-"),
                middle(v),
                ratio(v, truth),
                f"{PRINTED[n] / 16.6:.2f}" if n in PRINTED else "-",
                ratio(v, here["kf-lgs"]),
                ratio(v, best),
            )
            for n, v in here.items()
        ]
        rows.insert(3, ("LGS KF, matched", "-", middle(best), ratio(best, truth), "-", ratio(best, here["kf-lgs"]), "1.00"))
        table((f"{mode}", "paper", "here", "here / truth", "paper / KF", "here / KF", "here / matched KF"), rows)


def fit() -> None:
    """The Kalman filter against the vibration rms of its model."""
    rows = []
    for model in (0.005, 0.01, 0.0155, 0.03, 0.045, 0.06, 0.08, 0.12):
        e = errors({"kalman.vibration_rms": model}, ("kf-lgs",))
        rows.append((f"{model * 1e3:g}", middle(e["kf-lgs", "vibration", "tip"]), middle(e["kf-lgs", "vibration", "tilt"])))
    table(("model vibration rms [nm]", "LGS KF, tip", "LGS KF, tilt"), rows)


def butterworth() -> None:
    """What makes the open-loop reference better than the closed-loop one."""
    found: dict[tuple[str, str, float], list[float]] = {}
    for seed in SEEDS:
        scenario = wfsobs.PRESETS["paper"]().replace({"run.seed": seed})
        record = wfsobs.simulate(scenario)
        start = round(scenario.run.warm_up / record.dt)
        signals = {"open loop": record.open_loop_y, "z[k] = y[k] - u[k-2]": record.z, "y[k] - u[k]": record.y_lgs - record.u}
        for width in (2.0, 3.0):
            bank = bandpass_bank(scenario.butterworth.frequencies, width, 1, record.dt)
            for name, signal in signals.items():
                ahead = np.vstack([filter_zero_phase(bank, signal)[1:], np.zeros((1, 2))])
                for how, value in (("zero-phase", ahead), ("causal", filter_causal(bank, signal))):
                    error = (value - record.vibration)[start:-1, 0]
                    found.setdefault((name, how, width), []).append(rms(error) * 1e3)
    names = dict.fromkeys(name for name, *_ in found)
    columns = [(how, width) for how in ("zero-phase", "causal") for width in (3.0, 2.0)]
    table(
        ("tip", *(f"{how}, {width:g} Hz" for how, width in columns)),
        [(name, *(middle(found[name, how, width], False) for how, width in columns)) for name in names],
    )


def training() -> None:
    """What the offline GPR is trained on, and what the windows hold."""
    cases: dict[str, Callable[[Record], Training]] = {
        "closed loop (u, y), target from the open-loop twin": lambda r: r.training,
        "closed loop (u, y), target from z": lambda r: Training(r.training.y_lgs, r.training.u),
        "open loop (0, y)": lambda r: Training(r.training.open_loop_y, np.zeros_like(r.training.u), r.training.open_loop_y),
    }
    rows = []
    for name, make in cases.items():
        for inputs in ("u-y", "z"):
            if inputs == "z" and not name.startswith("closed loop (u, y), target from the"):
                continue
            found: dict[str, list[float]] = {"tip": [], "tilt": []}
            for seed in SEEDS:
                scenario = wfsobs.PRESETS["paper"]().replace({"run.seed": seed, "gpr_offline.inputs": inputs})
                record = wfsobs.simulate(scenario)
                changed = Record(**{**vars(record), "training": make(record)})
                for s in wfsobs.observe(changed, scenario, observers=["gpr-offline"]).scores:
                    found[s.mode].append(s.rms * 1e3)
            rows.append((name if inputs == "u-y" else "closed loop, windows of z", middle(found["tip"]), middle(found["tilt"])))
    table(("training record of the offline GPR", "tip", "tilt"), rows)


def all_peaks() -> None:
    """A Kalman filter whose model holds every peak of the scenario, which no observer here is given."""
    found: dict[str, list[float]] = {"tip": [], "tilt": []}
    for seed in SEEDS:
        scenario = wfsobs.PRESETS["paper"]().replace({"run.seed": seed, "kalman.process_noise": "matched"})
        record = wfsobs.simulate(scenario)
        columns = []
        for mode in range(2):
            turbulence, _ = modelled_processes(scenario, mode, record.dt)
            peaks = [
                Ar2(2.0 * np.pi * p.frequency, p.damping, p.rms[mode], record.dt)
                for p in scenario.vibration.peaks
                if p.rms[mode] > 0
            ]
            kalman, _ = steady_filter(disturbance_model([turbulence], peaks), measurement_noise(scenario, mode)[0])
            columns.append(kalman.run(record.z[:, [mode]]))
        start = round(scenario.run.warm_up / record.dt)
        error = (by_name(np.stack(columns, axis=-1))["vibration"] - record.vibration)[start:]
        for mode, name in enumerate(found):
            found[name].append(rms(error[:, mode]) * 1e3)
    table(("", "tip", "tilt"), [("LGS KF, all 15 peaks modelled", middle(found["tip"]), middle(found["tilt"]))])


def gpr_turbulence() -> None:
    """The two GPR against the strength of the turbulence in their windows."""
    rows = []
    for strength in (0.0, 0.25, 0.4, 0.5, 0.6, 0.7, 1.0, 2.0):
        e = errors({"turbulence.rms": strength}, ("gpr-offline", "gpr-online"))
        rows.append(
            (
                f"{strength:g}",
                *(
                    middle(e[name, "vibration", mode], False)
                    for mode in ("tip", "tilt")
                    for name in ("gpr-offline", "gpr-online")
                ),
            )
        )
    table(("turbulence [um]", "offline, tip", "online, tip", "offline, tilt", "online, tilt"), rows)


def gpr_inputs() -> None:
    """The two GPR in turbulence of 2 um (preset strong-turbulence), by what is done to their inputs."""
    rows = []
    kinds = (("raw", "raw", 300.0), ("high-pass, 10 Hz", "high-pass", 300.0), ("standardised, l = 1000", "standardised", 1000.0))
    for name, kind, length in kinds:
        changes: dict[str, object] = {
            f"{gpr}.{key}": value
            for gpr in ("gpr_offline", "gpr_online")
            for key, value in (("inputs_filter", kind), ("length_scale", length))
        }
        e = errors(changes, ("gpr-offline", "gpr-online", "kf-multi", "zero"), "strong-turbulence")
        rows.append((name, *(middle(e[n, "vibration", "tip"], False) for n in ("gpr-offline", "gpr-online", "kf-multi", "zero"))))
    table(("inputs", "offline", "online", "multi-peak KF", "zero"), rows)


def turbulence() -> None:
    """The turbulence comparison at the preset."""
    e = errors({}, (*TURBULENCE, "zero"))
    m = errors({"kalman.process_noise": "matched"}, TURBULENCE)
    rows = [
        (NAMES[n], *(middle(runs[n, "turbulence", mode], runs is e) for mode in ("tip", "tilt") for runs in (e, m)))
        for n in TURBULENCE
    ]
    table(("turbulence", "tip", "tip, matched", "tilt", "tilt, matched"), rows)


def sweep(setting: str, values: Sequence[float], label: str, fixed: dict[str, object], spread: bool = False) -> None:
    """Turbulence errors on tip against one setting in [um]."""
    rows = []
    for value in values:
        e = errors(fixed | {setting: value}, TURBULENCE)
        numbers = {n: e[n, "turbulence", "tip"] for n in TURBULENCE}
        order = sorted(TURBULENCE[:3], key=lambda n: median(numbers[n]))
        rows.append(
            (
                f"{value * 1e3:g}",
                *(middle(v, spread) for v in numbers.values()),
                " < ".join(NAMES[n].removesuffix(" KF") for n in order),
            )
        )
    table((label, *(NAMES[n] for n in TURBULENCE), "order of the paper's three"), rows)


LOW = (0.0, 0.01, 0.02, 0.03, 0.049, 0.07, 0.1)


def lgs_error() -> None:
    """Against the slow error of each LGS."""
    sweep("sensors.lgs_low_frequency_rms", LOW, "LGS slow error [nm]", {})


def indetermination() -> None:
    """The same with LGS that see no turbulence."""
    sweep("sensors.lgs_low_frequency_rms", (0.0, 0.049, 0.1), "LGS slow error [nm]", {"sensors.tip_tilt_indetermination": True})


def ngs_noise() -> None:
    """Against the noise of an NGS frame, at the preset's LGS error and without."""
    for low in (0.049, 0.0):
        print(f"LGS slow error {low * 1e3:g} nm:\n")
        sweep("sensors.ngs_noise", (0.001, 0.005, 0.01, 0.02, 0.05), "NGS noise [nm]", {"sensors.lgs_low_frequency_rms": low})


def weights() -> None:
    """The multi-rate filter with weights set by hand, r_LGS standing for the slow error too."""
    rows = []
    for lgs in (0.0141, 0.02, 0.03, 0.05, 0.1, 0.2):
        e = errors({"multirate.measurement_noise": "manual", "multirate.lgs_noise": lgs}, ("multirate",))
        v = e.get(("multirate", "turbulence", "tip"))
        rows.append((f"{lgs * 1e3:g}", middle(v) if v else "unstable cycle"))
    table(("weight of the LGS [nm]", "Multi-rate KF, tip"), rows)


def lgs_model() -> None:
    """The optimal filter with and without the slow LGS error in its model."""
    rows = []
    for low in LOW:
        e = {
            on: errors({"sensors.lgs_low_frequency_rms": low, "multirate.model_lgs_error": on}, ("multirate-optimal",))
            for on in (True, False)
        }
        rows.append((f"{low * 1e3:g}", *(middle(e[on]["multirate-optimal", "turbulence", "tip"], False) for on in (True, False))))
    table(("LGS slow error [nm]", "in the model", "not in the model"), rows)


def ut4() -> None:
    """Frozen flow and the ERIS spectrum of UT4, its lines alone and with its floor."""
    names = dict.fromkeys((*TURBULENCE, *PRINTED, "kf-multi", "ridge-30", "zero"))
    runs = [errors({}, tuple(names), preset) for preset in ("ut4", "ut4-floor")]
    for target, names in (
        ("turbulence", (*TURBULENCE, "kf-multi")),
        ("vibration", (*PRINTED, "multirate-optimal", "kf-multi", "ridge-30")),
    ):
        rows = [
            (
                OBSERVERS[name].label if name in OBSERVERS else "Truth",
                *(middle(e[name, target, mode], e is runs[0]) for mode in ("tip", "tilt") for e in runs),
            )
            for name in (*names, "truth")
        ]
        table((target, "tip, lines", "tip, all", "tilt, lines", "tilt, all"), rows)


TABLES: dict[str, Callable[[], None]] = {
    f.__name__: f
    for f in (
        vibration,
        fit,
        butterworth,
        training,
        all_peaks,
        gpr_turbulence,
        gpr_inputs,
        turbulence,
        lgs_error,
        indetermination,
        ngs_noise,
        weights,
        lgs_model,
        ut4,
    )
}

if __name__ == "__main__":
    for name in sys.argv[1:] or TABLES:
        print(f"**{name}** - {TABLES[name].__doc__}\n")
        TABLES[name]()
