"""What `wfsobs check` says of the plants of simulated loops: python scripts/measure_plant.py [LOOPS [probe]]

Delay 1 to 3 frames, half of them whole, gain 0.7 to 1.3, any rotation, sign included; an integrator or an LQG controller designed
for the next whole delay and a gain of one; turbulence, a line, noise; 20 s at 1 kHz. The bound is that of Cramer and Rao for
plant and spectra together.

With `probe`: loops of `paper` with an integrator of 0.4 and the probe of `wfsobs probe`, 20 s, mirrors without dynamics and of
second order in turn; rms errors, the same over the bound that the probe has, and shares in the 95 % intervals.
"""

from __future__ import annotations

import sys
from math import pi

import numpy as np
from scipy.linalg import solve_discrete_are

from wfsobs import PRESETS
from wfsobs import simulate as disturbance_of
from wfsobs.control.true_plant import ActingPlant, TruePlant
from wfsobs.identification.plant import identify_plant
from wfsobs.identification.plant_likelihood import PlantFit, PlantLikelihood, rotation_matrix
from wfsobs.identification.probe import design_probe
from wfsobs.record import Record
from wfsobs.signal.autoregressive import Ar2
from wfsobs.spectral.model import Spectrum
from wfsobs.telemetry.check import known_numbers, sign_of
from wfsobs.typing import Array

DT, N = 1e-3, 20_000

MIRRORS = ((0.0, 0.3), (300.0, 0.3), (300.0, 0.7), (600.0, 0.3), (600.0, 0.7))
"""Natural frequency [Hz], 0 without dynamics, and damping."""


def predictor(spectrum: Spectrum, delay: int) -> tuple[Array, Array, Array]:
    """Return A - K C, K and the row that predicts the disturbance when a command acts, of the steady-state Kalman filter."""
    processes = [p for p in spectrum.processes if isinstance(p, Ar2)]
    A, Q, C = np.zeros((2 * len(processes),) * 2), np.zeros(2 * len(processes)), np.zeros((1, 2 * len(processes)))
    for i, p in enumerate(processes):
        r, a = np.exp(-p.damping * p.omega * DT), p.omega * np.sqrt(1.0 - p.damping**2) * DT
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = [[2.0 * r * np.cos(a), -(r**2)], [1.0, 0.0]]
        Q[2 * i], C[0, 2 * i] = p.drive_variance, 1.0
    P = solve_discrete_are(A.T, C.T, np.diag(Q), np.array([[spectrum.noise**2]]))
    K = A @ P @ C.T / (C @ P @ C.T + spectrum.noise**2)
    return A - K @ C, K, C @ np.linalg.matrix_power(A, delay - 1)


def simulate(rng: np.random.Generator) -> tuple[Record, Array, list[Spectrum], str]:
    """Return a record, its plant (delays, gains, angle), its spectra and the name of its controller."""
    delay = rng.uniform(1.0, 3.0) if rng.random() < 0.5 else float(rng.integers(1, 4))
    gain, angle = rng.uniform(0.7, 1.3), rng.uniform(-pi, pi) if rng.random() < 0.5 else pi * rng.integers(0, 2)
    noise, spectra = rng.uniform(0.01, 0.04), []
    for _ in range(2):
        slow = Ar2(2.0 * pi * rng.uniform(0.5, 3.0), 0.9, rng.uniform(0.2, 0.5), DT)
        line = Ar2(2.0 * pi * rng.uniform(15.0, 80.0), rng.uniform(0.003, 0.02), rng.uniform(0.01, 0.08), DT)
        spectra.append(Spectrum(noise, DT, slow, (line,)))
    seen = np.column_stack([sum(p.sample(N, rng) for p in s.processes) + noise * rng.standard_normal(N) for s in spectra])
    R, d, p = rotation_matrix(angle), int(delay), delay % 1.0
    name, step = ("integrator", rng.uniform(0.15, 0.45)) if rng.random() < 0.5 else ("LQG", 0.0)
    nominal = int(np.ceil(delay))
    filters, states = [predictor(s, nominal + 1) for s in spectra], [np.zeros((4, 1)) for _ in spectra]
    y, u = np.zeros((N, 2)), np.zeros((N, 2))  # u : along the sensor's axes
    for k in range(N):
        now, before = (u[k - lag] if k >= lag else np.zeros(2) for lag in (d, d + 1))
        y[k] = seen[k] + gain * ((1.0 - p) * now + p * before)
        if step:
            u[k] = (u[k - 1] if k else 0.0) - step * y[k]
            continue
        z = y[k] - (u[k - nominal] if k >= nominal else 0.0)
        for i, (move, K, C) in enumerate(filters):
            states[i] = move @ states[i] + K * z[i]
            u[k, i] = -(C @ states[i])[0, 0]
    theta = np.array([delay, delay, gain, gain, angle])
    return Record(y, u @ R, DT), theta, spectra, name


def main(loops: int) -> None:
    """Print a line per loop, and the shares at the end."""
    rng = np.random.default_rng(37)
    ties = np.array([[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1.0]])
    rows = []
    for i in range(loops):
        while not np.abs((made := simulate(rng))[0].y_lgs).max() < 10.0:
            pass  # not stable
        record, theta, spectra, name = made
        bound = np.sqrt(np.diag(PlantLikelihood(record.y_lgs, record.u, DT).fit(PlantFit(theta, spectra), ties, 1).covariance))
        (found,) = identify_plant(record)
        delay, gain = (
            known_numbers(found, "delay"),
            known_numbers(found, "gain"),
        )
        off_delay = None if delay is None else max(abs((n.value or 0.0) - theta[0]) for n in delay)
        off_gain = None if gain is None else max(abs(abs(n.value or 0.0) / theta[2] - 1.0) for n in gain)
        turn = found.degrees.value
        off = None if turn is None else abs((turn - np.degrees(theta[4]) + 180.0) % 360.0 - 180.0)
        sign = sign_of(found)
        z = [
            None if n.sd is None else ((n.value or 0.0) - t) / n.sd
            for n, t in ((found.common_delay, theta[0]), (found.common_gain, theta[2]))
        ]
        rows.append((bound[0], bound[2] / theta[2], off_delay, off_gain, off, z[0], z[1], sign))
        numbers = " ".join("-" if x is None else f"{x:.3f}" for x in (*bound[[0, 2]], off_delay, off_gain, off, *z))
        print(i, name, np.round(theta[[0, 2]], 2), f"{np.degrees(theta[4]):.0f}", numbers, sign, flush=True)

    def share(found: list[bool]) -> str:
        return f"{sum(found)} of {len(found)}"

    for at, least, limit, what in ((0, 0.03, 0.1, "delay"), (1, 0.025, 0.06, "gain")):
        print(f"{what} decided where its bound is below {least}:", share([r[2 + at] is not None for r in rows if r[at] < least]))
        print(f"{what} decided:", share([r[2 + at] is not None for r in rows]))
        print(f"... within {limit}:", share([r[2 + at] < limit for r in rows if r[2 + at] is not None]))
        print("in its 95 % interval:", share([abs(r[5 + at]) < 1.96 for r in rows if r[5 + at] is not None]))
        print("rms error over its bound:", np.sqrt(np.mean([(r[2 + at] / r[at]) ** 2 for r in rows if r[2 + at] is not None])))
    print("rotation within 5 degrees:", share([r[4] < 5.0 for r in rows if r[4] is not None]), "decided")


def probed(loops: int) -> None:
    """Print a line per loop, and per mirror what `probe` is asked for."""
    scenario = PRESETS["paper"]().replace({"run.duration": N * DT, "loop.gain": 0.4})
    probe = design_probe(scenario, N * DT, {"delay_frames": 0.03, "gain": 0.02, "rotation_deg": 1.0})
    print(probe)
    errors, scaled = np.full((2, loops, 3), np.nan)
    for i in range(loops):
        frequency, damping = MIRRORS[i % len(MIRRORS)]
        rng = np.random.default_rng(i)
        z = disturbance_of(scenario.replace({"run.seed": i})).z
        dead, gain, angle, omega = rng.uniform(1.5, 2.5), rng.uniform(0.8, 1.2), rng.uniform(-0.2, 0.2), 2.0 * pi * frequency * DT
        mirror = ActingPlant(TruePlant(gain * rotation_matrix(angle), dead, 0.0, omega, damping))
        own, (integral, correction), (y, u) = probe.commands(N, 2, DT, rng), np.zeros((2, 2)), np.zeros((2, N, 2))
        for k in range(N):
            y[k] = z[k] + correction
            integral = integral - scenario.loop.gain * y[k]
            u[k] = integral + own[k]
            correction = mirror.take(u[k])
        (found,) = identify_plant(Record(y, u, DT))
        truth = dead + (2.0 * damping / omega if omega else 0.0), gain, np.degrees(angle)
        for j, (n, right) in enumerate(zip((found.common_delay, found.common_gain, found.degrees), truth, strict=True)):
            if n.value is not None and n.sd is not None:
                errors[i, j], scaled[i, j] = (n.value - right) / (gain if j == 1 else 1.0), (n.value - right) / n.sd
        what = np.round(errors[i], 4), np.round(scaled[i], 2), f"{found.chance:.0e} {found.rigid:.0e}"
        print(i, frequency, damping, *what, flush=True)
    bound = np.array(list(probe.bound.values()))
    of_mirror = {str(mirror): np.arange(loops) % len(MIRRORS) == i for i, mirror in enumerate(MIRRORS)}
    for name, which in (of_mirror | {"all": np.ones(loops, bool)}).items():
        rms, known = np.sqrt(np.nanmean(errors[which] ** 2, axis=0)), np.isfinite(errors[which])
        inside = (np.abs(scaled[which]) < 1.96).sum(axis=0) / known.sum(axis=0)
        shares = f"95 %: {np.round(inside, 3)} of {known.sum(axis=0)}"
        print(f"{name}: rms {np.round(rms, 4)}, over the bound {np.round(rms / bound, 2)}, {shares}")


if __name__ == "__main__":
    (probed if "probe" in sys.argv else main)(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
