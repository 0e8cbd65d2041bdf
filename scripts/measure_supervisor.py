"""How soon a supervisor acts, and how often without cause: python scripts/measure_supervisor.py [RUNS] [HOURS]

Loops of `paper` and `ut4`: after 3 s delay and gain of the mirror, about its present position, change so that the loop grows by
up to 5 % a frame (eigenvalues of the loop), and stay so. The residual is the true one, its rms over 16 frames, over that of the
controller before and over that of the integrator, which closes the loop for the first second (gain 0.12: half of what is stable
with three frames more and a gain of 1.5). False alarms: stationary loops, whose measurement is tested as the supervisor does it.
"""

from __future__ import annotations

import sys

import numpy as np

import wfsobs
from wfsobs.closed_loop.design import design
from wfsobs.control.controllers import CONTROLLERS
from wfsobs.control.supervisor import WINDOW, SupervisedController, Supervision, _Level
from wfsobs.typing import Array

LINEAR = [name for name, c in CONTROLLERS.items() if c.law is not None and c.predict is None]


def growth(law, nominal: Array, actual: Array) -> float:
    """Return the largest pole of a loop whose mirror has other taps than it was designed for."""
    n = max(len(nominal), len(actual)) - 1
    into = np.zeros(n)  # z = (actual - nominal) u beside the disturbance; state, then commands, newest first
    into[: len(actual) - 1] += actual[1:]
    into[: len(nominal) - 1] -= nominal[1:]
    steps = law.cycle.steps
    size = steps[0][0].shape[0]
    whole = np.eye(size + n)
    for A, B, C, D in steps:
        step = np.zeros((size + n, size + n))
        step[:size, :size], step[:size, size:] = A, np.outer(B[:, 0], into)
        step[size, :size], step[size, size:] = C[0], D[0, 0] * into
        step[size + 1 :, size:-1] = np.eye(n - 1)
        whole = step @ whole
    return float(np.abs(np.linalg.eigvals(whole)).max() ** (1.0 / len(steps)))


def delayed(taps: Array, frames: int, gain: float) -> Array:
    """Return the taps of a mirror with another delay and gain."""
    return np.concatenate([np.zeros(frames), gain * taps])


def run(controller: SupervisedController, record: wfsobs.Record, actual: Array, start: int) -> Array:
    """Return the true residual (n_steps, n_modes) of a loop whose mirror becomes another one, about its present position."""
    assert record.turbulence is not None and record.vibration is not None
    disturbance = record.turbulence + record.vibration
    nominal, ratio = controller.mirror.taps[1:], record.ratio or 0
    noise = record.z - np.vstack([np.zeros(record.n_modes), disturbance[:-1]])
    ngs = record.z_ngs if ratio and controller.controller.uses_ngs else None
    sent, mirror, rest = np.zeros((len(actual) - 1, record.n_modes)), np.zeros_like(disturbance), np.zeros(record.n_modes)
    residual, last = np.zeros_like(disturbance), np.zeros(record.n_modes)
    for k in range(record.n_steps):
        if k == start:
            rest = nominal @ sent[: len(nominal)]
        mirror[k] = last - disturbance[k - 1] if k else 0.0
        frame = ngs[k] + mirror[k - ratio + 1 : k + 1].mean(axis=0) if ngs is not None and k and k % ratio == 0 else None
        u = controller.update(last + noise[k], frame)
        sent = np.vstack([u, sent[:-1]])
        moved = rest + actual[1:] @ (sent - rest) if k >= start else nominal @ sent[: len(nominal)]
        residual[k] = last = disturbance[k] + moved
    return residual


def main(runs: int, hours: float) -> None:
    """Print a line per run, then shares and counts."""
    rng, ratios, plans = np.random.default_rng(1), [], {}
    for i in range(runs):
        name, preset = LINEAR[i % len(LINEAR)], ("paper", "ut4")[i // len(LINEAR) % 2]
        scenario = wfsobs.PRESETS[preset]().replace({"run.duration": 6.0, "run.seed": i})
        if (name, preset) not in plans:
            plans[name, preset] = design(scenario, [name]).laws[name]
        supervised = SupervisedController(wfsobs.design(name, scenario), Supervision(gain=0.12))
        taps, wanted = supervised.mirror.taps, 1.0 + rng.uniform(0.002, 0.05)
        laws = [d.law for d in plans[name, preset] if d.law]
        for frames in (1, 2, 3):  # the least further delay, and then the gain, with which it grows so
            low, high = 0.5, 1.5
            for _ in range(30):
                middle = 0.5 * (low + high)
                far = max(growth(law, taps, delayed(taps, frames, middle)) for law in laws) > wanted
                low, high = (low, middle) if far else (middle, high)
            reached = max(growth(law, taps, delayed(taps, frames, low)) for law in laws)
            if reached > wanted - 1e-3:
                break
        record = wfsobs.simulate(scenario)
        residual = run(supervised, record, delayed(taps, frames, low), 3000)
        squares = np.square(residual)
        level = np.sqrt(np.apply_along_axis(lambda x: np.convolve(x, np.ones(WINDOW) / WINDOW, "valid"), 0, squares))
        own, integrator = (np.sqrt(squares[part].mean(axis=0)) for part in (slice(1500, 3000), slice(300, 1000)))
        worst = [float((level[3000:] / nominal).max()) for nominal in (own, np.maximum(own, integrator))]
        first = next((frame - 3000 for frame, _ in supervised.alarms if frame >= 3000), None)
        early = [alarm for alarm in supervised.alarms if alarm[0] < 3000]
        ratios.append(worst)
        told = f"{frames} frames, gain {low:.2f}, growth {reached:.3f}: worst {worst[0]:.2f}, {worst[1]:.2f}"
        print(f"{name:22s} {preset:5s} {told}, alarm after {first}", early or "", flush=True)
    print("below 5 times its own, and the larger of both:", *(f"{share:.1%}" for share in (np.array(ratios) < 5.0).mean(axis=0)))
    alarms, total = 0, 0.0
    for name in LINEAR:
        scenario = wfsobs.PRESETS["ut4"]().replace({"run.duration": 200.0})
        for part in range(max(1, round(hours * 3600 / 200 / len(LINEAR)))):
            made = wfsobs.close_loop(scenario.replace({"run.seed": 1000 + part}), controllers=[name])
            assert made.outcomes[0].u is not None
            y = made.record.z + np.vstack([np.zeros(2), made.design.plant.mirror.correction(made.outcomes[0].u)[:-1]])
            level = _Level(y.shape[1], Supervision().alarm)
            alarms += sum(level.exceeds(row) for row in y)
            total += 200 / 3600
    print(f"frames that exceed the level: {alarms} in {total:.2f} h")


if __name__ == "__main__":
    given = [*sys.argv[1:], *("200", "1")[len(sys.argv) - 1 :]]
    main(int(given[0]), float(given[1]))
