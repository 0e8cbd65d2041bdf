"""How promises hold in loops whose plant and spectra are hidden: python scripts/measure_promise.py [LOOPS] [FIRST] [probe]

Turbulence of 5 to 15 m/s, one to four lines per mode, noise of an LGS of 10 to 40 nm; delay +-0.5 frame, gain +-20 %, rotation
+-10 degrees; an integrator of 0.2 to 0.5 closes the loop for 20 s, the other controllers the next 20 s, on the plant as it is.

With `probe`: the mirror has dynamics, of 150 to 600 Hz in turn, and the integrator adds the probe of `wfsobs probe`.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from time import process_time

import numpy as np

import wfsobs
from wfsobs.closed_loop.promise import make_promise
from wfsobs.control.true_plant import FAR, ActingPlant, TruePlant, drive
from wfsobs.identification.probe import design_probe
from wfsobs.priors_from.controllers import full_plant_of
from wfsobs.record import Record, RecordError

CONTROLLERS = ("integrator", "lqg-kf-lgs", "lqg-kf-multi", "h2-fir")
START = 1000
MIRRORS = ((300.0, 0.3), (300.0, 0.7), (600.0, 0.3), (150.0, 0.5))
"""Natural frequency [Hz] and damping."""


def hidden(rng: np.random.Generator, seed: int) -> wfsobs.Scenario:
    """Return the scenario of a loop that nobody is told."""
    peaks = [
        {"frequency": f, "damping": rng.uniform(0.003, 0.02), "rms": rng.uniform(0.01, 0.08, 2).tolist()}
        for f in rng.uniform(15.0, 90.0, rng.integers(1, 5)).tolist()
    ]
    return wfsobs.PRESETS["paper"]().replace(
        {
            "run.duration": 20.0,
            "run.seed": seed,
            "turbulence.wind_speed": rng.uniform(5.0, 15.0),
            "vibration.source": "ar2",
            "vibration.peaks": peaks,
            "sensors.lgs_low_frequency_rms": 0.0,
            "sensors.lgs_noise": rng.uniform(0.01, 0.04),
            "control.integrator": "manual",
            "control.gain": rng.uniform(0.2, 0.5),
            "plant.delay_error": rng.uniform(-0.5, 0.5),
            "plant.gain_error": [rng.uniform(-0.2, 0.2)] * 2,
            "plant.rotation": rng.uniform(-10.0, 10.0),
        }
    )


def telemetry_of(scenario: wfsobs.Scenario, plant: TruePlant, has_probe: bool, rng: np.random.Generator) -> Record:
    """Return measurements and commands of an integrator on a plant."""
    z = wfsobs.simulate(scenario).z
    y, u, probe, own, seen = np.zeros_like(z), np.zeros_like(z), np.zeros_like(z), np.zeros(2), np.zeros(2)
    if has_probe:
        wanted = {"delay_frames": 0.03, "gain": 0.02, "rotation_deg": 1.0}
        probe = design_probe(scenario, len(z) * scenario.dt, wanted).commands(len(z), 2, scenario.dt, rng)
    mirror = ActingPlant(plant)
    for k in range(len(z)):
        y[k] = z[k] + seen
        own = own - scenario.control.gain * y[k]
        u[k] = own + probe[k]
        seen = mirror.take(u[k])
    return Record(y, u, scenario.dt)


def main(loops: int, first: int, has_probe: bool) -> None:
    """Print a line per loop and controller, and the shares at the end."""
    inside: dict[bool, list[bool]] = {True: [], False: []}
    said, undecided, widths = list[bool](), 0, list[float]()
    for i in range(first, first + loops):
        rng = np.random.default_rng(i)
        scenario, begun = hidden(rng, i), process_time()
        if has_probe:
            frequency, damping = MIRRORS[i % len(MIRRORS)]
            scenario = scenario.replace({"plant.resonance": frequency, "plant.damping": damping})
        true = full_plant_of(scenario)
        telemetry = telemetry_of(scenario, true, has_probe, rng)
        if not np.abs(telemetry.y_lgs).max() < FAR:
            print(i, "the integrator is not stable")
            continue
        try:
            found = make_promise(telemetry, scenario.replace({"control.integrator": "optimised"}), controllers=CONTROLLERS)
        except RecordError as error:
            undecided += 1
            print(i, error, flush=True)
            continue
        plant = replace(true, matrix=true.matrix @ np.linalg.inv(found.matrix))
        ahead = wfsobs.simulate(scenario.replace({"run.seed": i + 100_000}))
        assert ahead.turbulence is not None and ahead.vibration is not None
        left = {}
        for one in found.residuals:
            _, correction = drive(wfsobs.design(one.controller, found.scenario), ahead.measurements(), plant, rng)
            residual = ahead.turbulence + ahead.vibration + correction
            left[one.controller] = np.sqrt(np.square(residual[START:]).mean(axis=0))
        for one in found.residuals:
            rms = left[one.controller]
            worse = not np.square(rms).sum() <= np.square(left["integrator"]).sum()
            if one.controller != "integrator" and worse:
                said.append(not one.switch_on)
            if one.rms is not None and one.low is not None and one.high is not None:
                inside[one.switch_on] += ((rms > one.low) & (rms < one.high)).tolist()
                widths += one.switch_on * [(h - low) / m for m, low, h in zip(one.rms, one.low, one.high, strict=True)]
            numbers = [np.round(1e3 * np.array(x), 2).tolist() for x in (one.low or (), rms, one.high or ())]
            print(i, one.controller, *numbers, "on" if one.switch_on else "off", "worse" if worse else "", one.note, flush=True)
        print(i, f"{process_time() - begun:.1f} s", flush=True)
    for on, name in ((True, "to be switched on"), (False, "not to be")):
        print(f"{name}: {sum(inside[on])} of {len(inside[on])} within their 95 % intervals")
    print(f"median width of those to be switched on {np.median(widths):.1%} of the rms")
    print(f"worse than the integrator: {len(said)}, said so: {sum(said)}; undecided: {undecided} of {loops} loops")


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[1:] if word != "probe"]
    main(*numbers, *(200, 0)[len(numbers) :], has_probe="probe" in sys.argv)
