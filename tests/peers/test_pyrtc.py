"""The predictor in pyRTC itself: made from its configuration, in its loop, beside its own predictors on the same disturbance."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from uuid import uuid4

import numpy as np
import pyshmem
import pytest
import yaml
from pyrtc import predictive
from pyrtc.component_loading import import_symbol_from_file
from scipy.signal import lfilter

import wfsobs
from wfsobs.peers import pyrtc as peer
from wfsobs.peers.predictor import LoopPredictor
from wfsobs.scenario.configfile import save_scenario

EXAMPLE = Path(__file__).parents[2] / "examples" / "pyrtc" / "loop.yaml"
NOISE = 0.03
Step = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


LENGTH = 24_000


@pytest.fixture(scope="module")
def disturbance() -> np.ndarray:
    return of_the_preset()


def of_the_preset() -> np.ndarray:
    record = wfsobs.simulate(wfsobs.PRESETS["paper"]().replace({"run.duration": 1e-3 * LENGTH}))
    assert record.turbulence is not None and record.vibration is not None
    return record.turbulence + record.vibration


def of_another_kind() -> np.ndarray:
    """AR(1) of 0.2 um and 50 ms in both modes, and a line of 0.05 um in each: 31 and 53 Hz, damping 0.005."""
    rng, decay = np.random.default_rng(8), np.exp(-1.0 / 50.0)
    drift = lfilter([np.sqrt(1.0 - decay**2)], [1.0, -decay], rng.normal(0.0, 0.2, (LENGTH, 2)), axis=0)
    lines = np.empty((LENGTH, 2))
    for mode, frequency in enumerate((31.0, 53.0)):
        pole = np.exp(1e-3 * 2.0 * np.pi * frequency * (1j * np.sqrt(1.0 - 0.005**2) - 0.005))
        line = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], rng.normal(size=LENGTH))
        lines[:, mode] = 0.05 * line / line.std()
    return drift + lines


def closed_loop(disturbance: np.ndarray, step: Step, delay: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return residual and pseudo-open-loop modes; step(y, applied, last) gives the command that acts `delay` frames later."""
    n = len(disturbance)
    noise = np.random.default_rng(5).normal(0.0, NOISE, (n, 2))
    applied, last, modes = np.zeros((n + delay, 2)), np.zeros(2), np.zeros((n, 2))
    for t in range(n):
        y = disturbance[t] + applied[t] + noise[t]
        modes[t] = y - applied[t]
        last = step(y, applied[t], last)
        applied[t + delay] = last
    return disturbance + applied[:n], modes


def by(predictor: predictive.ModalPredictor) -> Step:
    def step(y: np.ndarray, applied: np.ndarray, last: np.ndarray) -> np.ndarray:
        predictor.update(y - applied)
        return -predictor.predict()

    return step


def test_importing_it_registers_the_predictor() -> None:
    code = "import wfsobs.peers.pyrtc; from pyrtc import predictive; assert 'wfsobs' in predictive.available_predictors()"
    subprocess.run([sys.executable, "-c", code], check=True, env=os.environ | {"PYTHONPATH": str(EXAMPLE.parents[2])})


@pytest.mark.parametrize(("made", "over_best"), [(of_the_preset, (0.80, 0.98)), (of_another_kind, (0.95, 1.02))])
def test_residual_beside_its_own_predictors(made: Callable[[], np.ndarray], over_best: tuple[float, float]) -> None:
    """Learn on 8 s under an integrator, run on the next 16 s; over the best of integrator, AR(2) filter and 30 taps.

    Many lines in each mode, as in the preset, take the filter to gain anything; of one line and a drift 30 taps know as much.
    """
    disturbance = made()
    learnt, run = disturbance[:8000], disturbance[8000:]
    _, modes = closed_loop(learnt, lambda y, applied, last: last - 0.3 * y)

    def rms(step: Step) -> float:
        return float(np.sqrt(np.mean(closed_loop(run, step)[0][1000:] ** 2)))

    times: dict[str, str] = {}
    left = {"integrator": min(rms(lambda y, applied, last, g=g: last - g * y) for g in np.linspace(0.1, 0.7, 13))}
    for kind, options in (
        ("ar_kalman", {}),
        ("least_squares", {"order": 30}),
        ("wfsobs", {"observer": "kf-multi", "rate": 1000.0}),
    ):
        predictor = predictive.make_predictor({"type": kind, "horizon": 2, **options}, 2).fit(modes)
        left[kind] = rms(by(predictor))
        start = perf_counter()
        for row in modes:
            predictor.update(row)
            predictor.predict()
        times[kind] = f"{1e6 * (perf_counter() - start) / len(modes):.0f} us"
    print({kind: round(1e3 * value, 2) for kind, value in left.items()}, times)
    least, most = over_best
    assert least < left["wfsobs"] / min(value for kind, value in left.items() if kind != "wfsobs") < most


@pytest.fixture
def streams() -> Iterator[tuple[str, str]]:
    names = (f"signal_{uuid4().hex[:8]}", f"wfc_{uuid4().hex[:8]}")
    made = [pyshmem.create(name, shape=(2,), dtype="float32") for name in names]
    yield names
    for stream in made:
        stream.close()
        pyshmem.unlink(stream.name)


def test_its_loop_runs_the_predictor_of_the_example(streams: tuple[str, str], disturbance: np.ndarray) -> None:
    """The loop of the example on two streams, frame by frame: its commands are those of the predictor by itself."""
    conf = yaml.safe_load(EXAMPLE.read_text())["loop"]
    file = Path(peer.__file__)
    loop_class = import_symbol_from_file(str(file), conf["class_name"])
    conf |= {"input_streams": {"signal": streams[0]}, "output_streams": {"wfc": streams[1]}, "functions": [], "gain": 0.3}
    conf["predictor"]["fit_frames"] = 4096
    loop = loop_class(conf)
    signal = pyshmem.open(streams[0])
    try:
        loop.cm = np.eye(2, dtype=np.float32)
        applied, sent = np.zeros((5200, 2)), []
        for t in range(5000):
            if t == 4500:
                loop.fit_predictor()
            signal.write((disturbance[t] + applied[t]).astype(np.float32))
            loop.predictive_integrator()
            sent.append(np.array(loop.read_stream("wfc", block=False)).ravel())
            applied[t + 2] = sent[-1]
        modes = loop.recorded_pol()
        alone = LoopPredictor(
            2, **{key: value for key, value in conf["predictor"].items() if key in ("observer", "rate", "horizon")}
        )
        history = np.array(disturbance[:5000])
        assert loop.predictor.name == "wfsobs" and loop.predictor_fitted and len(modes) == 4096
        alone.fit(disturbance[404:4500].astype(np.float32))
        for t in range(4436, 4500):
            alone.update(history[t])
        expected = []
        for t in range(4500, 5000):
            alone.update(history[t])
            expected.append(-alone.predict())
        # single precision in the streams, and a fit of what was so rounded
        np.testing.assert_allclose(sent[4500:], expected, rtol=0, atol=1e-3 * np.std(history))
    finally:
        loop.close()
        signal.close()


@pytest.fixture
def both_sensors(streams: tuple[str, str], tmp_path: Path) -> Iterator[tuple[dict, np.ndarray]]:
    """Configuration of a loop with a second sensor of four slopes, and what its slopes are of the modes."""
    to_slopes = np.random.default_rng(6).normal(size=(4, 2))
    np.save(tmp_path / "ngs.npy", np.linalg.pinv(to_slopes))
    save_scenario(wfsobs.PRESETS["paper"](), tmp_path / "found.toml")
    name = f"ngs_{uuid4().hex[:8]}"
    made = pyshmem.create(name, shape=(4,), dtype="float64")
    ngs = {"stream": name, "matrix": str(tmp_path / "ngs.npy"), "ratio": 5, "wfc": streams[1]}
    predictor = {"type": "wfsobs", "rate": 1000.0, "horizon": 2, "delay_frames": 2, "gain": 1.0, "fit_frames": 128}
    yield predictor | {"prior": str(tmp_path / "found.toml"), "ngs": ngs}, to_slopes
    made.close()
    pyshmem.unlink(name)


def two_sensor_loop(
    streams: tuple[str, str], predictor: dict, to_slopes: np.ndarray | None, record: wfsobs.Record, late: int
) -> np.ndarray:
    """Run pyRTC's loop on the open-loop measurements of a record; return its commands, (n_steps, 2) [um]."""
    conf = {"input_streams": {"signal": streams[0]}, "output_streams": {"wfc": streams[1]}, "functions": [], "gain": 0.3}
    loop = peer.Loop(conf | {"predictor": predictor})
    signal, applied, sent = pyshmem.open(streams[0]), np.zeros((record.n_steps + 2, 2)), []
    ngs = None if to_slopes is None else pyshmem.open(predictor["ngs"]["stream"])
    try:
        loop.cm = np.eye(2, dtype=np.float32)
        for t in range(record.n_steps):
            if t == 200:
                loop.fit_predictor()
            k = t - late
            if ngs is not None and to_slopes is not None and k > 0 and k % 5 == 0:
                ngs.write(to_slopes @ (record.z_ngs[k] + applied[k - 4 : k + 1].mean(axis=0)))
            signal.write((record.z[t] + applied[t]).astype(np.float32))
            loop.predictive_integrator()
            sent.append(np.array(loop.read_stream("wfc", block=False)).ravel())
            applied[t + 2] = sent[-1]
    finally:
        loop.close()
        signal.close()
        if ngs is not None:
            ngs.close()
    return np.array(sent)


@pytest.mark.parametrize("late", [0, 1])
def test_a_second_sensor_in_its_loop(streams: tuple[str, str], both_sensors: tuple[dict, np.ndarray], late: int) -> None:
    """Its commands are those of our controller of both sensors by itself, and leave less than that of the LGS alone.

    The slopes come before the signal of the frame that they belong to (0), or before the next one (1).
    """
    predictor, to_slopes = both_sensors
    predictor["ngs"]["lag"] = late
    record = wfsobs.simulate(wfsobs.PRESETS["paper"]().replace({"run.duration": 4.0}))
    sent = two_sensor_loop(streams, predictor | {"observer": "lqg-multirate-multi"}, to_slopes, record, late)
    scenario = wfsobs.PRESETS["paper"]()
    alone, u = wfsobs.design("lqg-multirate-multi", scenario), np.zeros((record.n_steps + 2, 2))
    for t in range(record.n_steps):
        ngs = record.z_ngs[t] + u[t - 4 : t + 1].mean(axis=0) if t > 0 and t % 5 == 0 else None
        u[t + 2] = alone.update(record.z[t] + u[t], ngs)
    # single precision in its streams, and another start, forgotten as fast as the slow error of the LGS is known: 1 % after 2 s
    rows = slice(2000, None)
    is_there = np.arange(2000, record.n_steps) % 5 >= late
    error = (sent - u[2:])[rows][is_there]
    assert np.std(error) < 0.01 * np.std(u[2:][rows])

    def rms(commands: np.ndarray) -> float:
        assert record.turbulence is not None and record.vibration is not None
        disturbance = (record.turbulence + record.vibration)[2:]  # a command meets the disturbance that z shows two frames later
        return float(np.sqrt(np.mean((disturbance[rows][:-1] + commands[1:-2][rows][: len(disturbance) - 2001]) ** 2)))

    lgs = {key: value for key, value in predictor.items() if key != "ngs"}
    single = two_sensor_loop(streams, lgs | {"observer": "lqg-kf-multi"}, None, record, 0)
    print({"lqg-kf-multi": 1e3 * rms(single), "lqg-multirate-multi": 1e3 * rms(sent)})
    assert rms(sent) < 0.9 * rms(single)


def test_a_mistake_in_the_configuration_is_told(both_sensors: tuple[dict, np.ndarray]) -> None:
    predictor, _ = both_sensors
    for change, reason in (
        ({"ngs": predictor["ngs"] | {"stream": "none"}}, "none: no stream"),
        ({"ngs": predictor["ngs"] | {"matrix": "none.npy"}}, "none.npy: no matrix"),
        ({"ngs": predictor["ngs"] | {"lag": 5}}, "ratio = 5, lag = 5"),
        ({"ngs": predictor["ngs"] | {"rate": 5}}, "ngs: .*rate"),
        ({"prior": None}, "takes a prior"),
        ({"observer": "kf-multi"}, "takes no second sensor"),
    ):
        with pytest.raises(ValueError, match=reason):
            predictive.make_predictor(predictor | {"observer": "lqg-multirate-multi"} | change, 2)
    with pytest.raises(ValueError, match="no such observer"):
        predictive.make_predictor({"type": "wfsobs", "observer": "kf"}, 2)
    with pytest.raises(ValueError, match="takes a second sensor"):
        predictive.make_predictor({"type": "wfsobs", "observer": "multirate-multi"}, 2)
