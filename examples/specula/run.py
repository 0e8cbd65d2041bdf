"""Controllers of wfsobs in SPECULA beside its integrator and its AVC, and beside what theory says. See docs/specula.md.

    python run.py [SEEDS] [SECONDS] [CONTROLLER ...]

Calibrates the sensor, learns from a loop with the integrator, runs every controller (or those named) on the same seeds, and
prints residuals of tip and tilt. Everything is written to ./calibration and ./out; ./series.npz has the residuals, and the
spectra that theory says of them. Takes SPECULA's time: about 3 ms of CPU a frame.
"""

import sys
from pathlib import Path

import numpy as np
import specula
import yaml
from astropy.io import fits
from scipy.signal import welch

specula.init(-1, precision=0)
from specula.lib.avc_plant_model import generate_avc_init_conditions  # noqa: E402
from specula.simul import Simul  # noqa: E402

import wfsobs  # noqa: E402
from wfsobs.control.controllers import CONTROLLERS  # noqa: E402
from wfsobs.control.margins import residual_density  # noqa: E402
from wfsobs.control.mismatch import SensorSpectra, loops, weigh  # noqa: E402
from wfsobs.control.true_plant import TruePlant  # noqa: E402
from wfsobs.priors_from.controllers import own_settings, plant_of, prior_for  # noqa: E402
from wfsobs.scenario.configfile import load_scenario, save_scenario  # noqa: E402
from wfsobs.simulation.flow_spectra import flow_spectra  # noqa: E402

BASE = Path(__file__).with_name("tiptilt.yml")
DT, GAIN, START = 1e-3, 0.3, 1000
LINES = ((18.0, 0.02, 80.0), (47.0, 0.01, 60.0))
"""Frequency [Hz], damping and rms [nm] of the vibrations."""
OFF_GAIN = 1.3
"""Gain over what a controller is told, in the loops whose plant is not as told."""
AIR = ("atmo", "seeing", "wind_speed", "wind_direction", "vibration", "shaker", "truth", "control")


def simulate(name, changes, seconds, seed=1):
    """Run the base file with changes; return the time series that it stores, {} where it stores none."""
    seeds = {"atmo_override": {"seed": seed}, "vibration_override": {"seed": 1000 * seed}}
    seeds |= {"detector_override": {"photon_seed": 10 * seed, "readout_seed": 10 * seed + 1}}
    skipped = {f"{part}_override" for part in changes.get("remove", ())}
    over = {k: v for k, v in seeds.items() if k not in skipped} | {"main_override": {"total_time": seconds}} | changes
    Path(f"{name}.yml").write_text(yaml.safe_dump(over))
    simul = Simul(str(BASE), f"{name}.yml", log_level="error", speed_report=False)
    simul.run()
    if "store" not in over:
        return {}
    (folder,) = Path(over["store"]["store_dir"]).iterdir()
    found = {key: fits.getdata(folder / f"{key}.fits", 0).astype(float) for key in ("y", "u", "truth", "shake")}
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()
    return found


def store(command="control.out_comm_no_delay"):
    """Return the object that keeps what the sensor sees, the commands, and the residual."""
    kept = ["y-rec.out_modes", f"u-{command}", "truth-truth.out_modes", "shake-vibration.output"]
    return {"class": "DataStore", "store_dir": "./out", "data_format": "fits", "inputs": {"input_list": kept}}


def vibration_spectrum(frequency):
    """Return the one-sided spectrum of the vibrations, each a damped oscillator sampled at the rate of the loop [nm^2/Hz]."""
    total = np.zeros_like(frequency)
    fine = np.linspace(0.0, 0.5 / DT, 500_001)
    for f0, damping, rms in LINES:
        pole = np.exp((-damping + 1j * np.sqrt(1.0 - damping**2)) * 2.0 * np.pi * f0 * DT)

        def shape(f, pole=pole):
            e = np.exp(-2j * np.pi * f * DT)
            return np.abs((1.0 - pole * e) * (1.0 - np.conj(pole) * e)) ** -2.0

        total += rms**2 * shape(frequency) / np.trapezoid(shape(fine), fine)
    return total


def calibrate():
    """Find the lenslets in use and the reconstructor, by SPECULA's own calibrators; no noise, no turbulence."""
    Path("calibration/subapdata").mkdir(parents=True, exist_ok=True)
    Path("calibration/data").mkdir(parents=True, exist_ok=True)
    frequency = 0.2 * np.arange(1, 2501)
    fits.writeto("calibration/data/vibration_freq.fits", frequency, overwrite=True)
    fits.writeto("calibration/data/vibration_psd.fits", np.tile(vibration_spectrum(frequency), (2, 1)), overwrite=True)
    quiet = {"photon_noise": False, "readout_noise": False}
    lenslets = {"class": "ShSubapCalibrator", "subap_on_diameter": 8, "output_tag": "subaps", "energy_th": 0.5}
    changes = {
        "calibrator": lenslets | {"overwrite": True, "inputs": {"in_i": "sh.out_i"}},
        "prop_override": {"inputs": {"atmo_layer_list": [], "common_layer_list": ["pupilstop"]}},
        "remove": [*AIR, "dm", "slopec", "rec", "detector"],
    }
    simulate("subaps", changes, DT)
    images = {"in_slopes": "slopec.out_slopes", "in_commands": "pushpull.output"}
    matrix = {
        "class": "ImCalibrator",
        "nmodes": 35,
        "im_tag": "im",
        "overwrite": True,
        "inputs": images,
        "outputs": ["out_intmat"],
    }
    inverse = {"class": "RecCalibrator", "nmodes": 35, "rec_tag": "rec", "overwrite": True}
    changes = {
        "pushpull": {"class": "PushPullGenerator", "nmodes": 35, "amp": 50.0, "constant_amp": True, "outputs": ["output"]},
        "matrix": matrix,
        "inverse": inverse | {"inputs": {"in_intmat": "matrix.out_intmat"}},
        "prop_override": {"inputs": {"atmo_layer_list": [], "common_layer_list": ["pupilstop", "dm.out_layer"]}},
        "dm_override": {"sign": 1, "nmodes": 35, "inputs": {"in_command": "pushpull.output"}},
        "detector_override": quiet,
        "remove": [*AIR, "rec"],
    }
    simulate("matrix", changes, 70 * DT)


def learn(seconds):
    """Run the integrator; return (sensor gain, delay in frames, spectrum of the noise), and write found.toml."""
    found = simulate("learn", {"store": store()}, seconds, seed=99)
    y, u, truth, shake = (found[key][START // 2 :] for key in ("y", "u", "truth", "shake"))
    # What the sensor shows of what the shaker does: the noise goes round the loop, and is in the truth as well.
    past = np.stack([shake[20 - lag : len(shake) - lag].ravel() for lag in range(20)], axis=1)
    seen, true = (past @ np.linalg.lstsq(past, x[20:].ravel(), rcond=None)[0] for x in (y, truth))
    gain = np.sum(seen * true) / np.sum(true * true)
    lags = [np.mean((y[5:-5] - gain * truth[5 - lag : len(y) - 5 - lag]) ** 2) for lag in range(5)]
    record = wfsobs.Record(1e-3 * y / gain, -1e-3 * u, DT)
    save_scenario(wfsobs.identify(record).scenario(), "found.toml")
    f, noise = welch(1e-3 * (y / gain - truth), 1.0 / DT, nperseg=256, axis=0, detrend=False)
    return float(gain), 2 + int(np.argmin(lags)), (f, noise.mean(axis=1))


def theory(name, gain, noise, error=1.0):
    """Return what the spectra of atmosphere, vibrations and noise say of a controller's residual, tip and tilt together.

    Frequencies [Hz], one-sided spectrum of a plant as told [nm^2/Hz] and rms [nm]; error : gain over what is told. A sensor of
    another gain is a mirror of that gain in a world that is larger by it.
    """
    layer = [{"height": 0.0, "fraction": 1.0, "wind_factor": 1.0, "wind_direction": 0.0}]
    r0 = 0.9759 * 500e-9 / np.deg2rad(0.65 / 3600.0)
    air = {"source": "frozen-flow", "r0": r0, "outer_scale": 25.0, "wind_speed": 10.0, "layers": layer}
    scenario = wfsobs.Scenario().replace({f"turbulence.{key}": value for key, value in air.items()})
    frequency = np.linspace(0.0, 0.5 / DT, 2**16 + 1)
    told = load_scenario("found.toml").replace({"control.delay": 2.0})
    told = told.replace({"control.integrator": "manual", "control.gain": GAIN * gain, "control.leak": 1.0})
    controller, plant = CONTROLLERS[name], plant_of(told)
    total, density = 0.0, np.zeros_like(frequency)
    for mode in range(2):
        turbulence = flow_spectra(scenario, mode, np.maximum(frequency, frequency[1])).own
        disturbance = turbulence + 1e-6 * vibration_spectrum(frequency)
        measured = disturbance + np.interp(frequency, *noise)
        per_sample = [0.5 / DT * error**2 * one for one in (disturbance, measured, disturbance)]
        law = controller.law(prior_for(controller, told), mode, plant, own_settings(controller, told))
        true, of = TruePlant(np.array([[error]])), loops([law], plant.mirror)
        response = true.response(of.images)
        Q = of.solve(response, true.matrix)[1]
        total += of.residual(Q, response, true.matrix, [weigh(SensorSpectra(*per_sample), of)])[0] / error**2
        omega = 2.0 * np.pi * DT * frequency
        through = plant.mirror.response(omega) * law.response(omega)
        density += residual_density(through, disturbance, disturbance, measured)
    return frequency, 1e6 * density, 1e3 * np.sqrt(total)


def main():
    """Calibrate, learn, run and compare."""
    seeds, seconds = (int(x) for x in (*sys.argv[1:3], *("4", "4")[len(sys.argv[1:3]) :]))
    calibrate()
    gain, delay, noise = learn(max(seconds, 8))
    level = 1e3 * np.sqrt(noise[1].mean() * 0.5 / DT)
    print(f"calibration: gain {gain:.3f}, delay {delay} frames, noise {level:.1f} nm", flush=True)
    ours = {
        "class": "WfsobsFilter",
        "simul_params_ref": "main",
        "controller": "lqg-kf-multi",
        "prior": "found.toml",
        "n_modes": 2,
    }
    ours |= {"delay": 1.0, "gain": gain, "inputs": {"delta_comm": "rec.out_modes"}, "outputs": ["out_comm", "out_comm_no_delay"]}
    poles = [generate_avc_init_conditions(f0, DT, GAIN * gain, 2 * DT, -DT) for f0, *_ in LINES]
    avc = {"class": "AVC", "simul_params_ref": "main", "freq": [[f0 for f0, *_ in LINES]] * 2, "gx": 6.0, "gomega": 0.0, "k": 0.0}
    avc |= {"plant_re": [[p[0] for p in poles]] * 2, "plant_im": [[p[1] for p in poles]] * 2}
    both = {"class": "BaseOperation", "sum": True, "inputs": {"in_value1": "control.out_comm", "in_value2": "avc.out_comm"}}
    runs = {
        "integrator": {"store": store()},
        "integrator + AVC": {
            "avc": avc | {"inputs": {"in_measurement": "rec.out_modes"}, "outputs": ["out_comm"]},
            "both": both | {"outputs": ["out_value"]},
            "dm_override": {"inputs": {"in_command": "both.out_value"}},
            "store": store(),
        },
        "lqg-kf-multi": {"control_new": ours, "store": store("control_new.out_comm_no_delay"), "remove": ["control"]},
    }
    runs["lqg-kf-multi"]["dm_override"] = {"inputs": {"in_command": "control_new.out_comm"}}
    runs["integrator, off"] = runs["integrator"] | {"control_override": {"int_gain": [GAIN * OFF_GAIN]}}
    runs["lqg-kf-multi, off"] = runs["lqg-kf-multi"] | {"control_new": ours | {"gain": gain / OFF_GAIN}}
    series = {}
    wanted = sys.argv[3:] or runs
    for name in wanted:
        changes = runs[name]
        series[name] = [simulate("run", changes, seconds, seed)["truth"][START:] for seed in range(1, seeds + 1)]
        rms = np.sqrt([np.mean(np.sum(one**2, axis=1)) for one in series[name]])
        print(f"{name}: {rms.mean():.1f} +- {rms.std(ddof=1) / np.sqrt(seeds):.1f} nm", flush=True)
    for name in set(wanted) - {"integrator + AVC"}:
        error = OFF_GAIN if name.endswith("off") else 1.0
        frequency, density, rms = theory(name.removesuffix(", off"), gain, noise, error)
        series |= {"theory frequency": frequency, f"theory {name}": density, f"theory rms {name}": rms}
        print(f"theory, {name}: {rms:.1f} nm", flush=True)
    np.savez("series.npz", gain=gain, frequency=noise[0], noise=noise[1], **series)


if __name__ == "__main__":
    main()
