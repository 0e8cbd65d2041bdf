"""A controller in SPECULA: its filter class as a YAML file asks for it, and its FITS file in SPECULA's own filter."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import specula
from scipy.signal import welch

specula.init(-1, precision=0)
from specula.base_value import BaseValue  # noqa: E402
from specula.data_objects.simul_params import SimulParams  # noqa: E402
from specula.data_objects.ssr_filter_data import SsrFilterData  # noqa: E402
from specula.lib.utils import get_type_hints, import_class  # noqa: E402
from specula.processing_objects.ssr_filter import SsrFilter  # noqa: E402

import wfsobs  # noqa: E402
from wfsobs.handover import write_design  # noqa: E402
from wfsobs.peers.wfsobs_filter import ControllerError  # noqa: E402
from wfsobs.scenario.configfile import save_scenario  # noqa: E402

FRAMES = 400
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def scenario() -> wfsobs.Scenario:
    return wfsobs.PRESETS["paper"]()


@pytest.fixture
def ours(scenario: wfsobs.Scenario, tmp_path: Path):
    save_scenario(scenario, tmp_path / "found.toml")
    filter_class = import_class("WfsobsFilter", ["wfsobs.peers"])
    assert "prior" in get_type_hints(filter_class)
    simul = SimulParams(pixel_pupil=8, pixel_pitch=1.0, time_step=1e-3)
    return filter_class(simul, controller="lqg-kf-multi", prior=str(tmp_path / "found.toml"), delay=1.0)


def close(one, disturbance: np.ndarray) -> np.ndarray:
    """Return the commands of a loop with a mirror that is read with :-1, all in nanometres."""
    y = BaseValue(value=np.zeros(2))
    one.inputs["delta_comm"].set(y)
    one.setup()
    sent, out, mirror = np.zeros(2), [], np.zeros(2)
    for k, row in enumerate(disturbance):
        y.value = row - mirror
        y.generation_time = k
        one.check_ready(k)
        one.trigger()
        one.post_trigger()
        mirror, sent = sent, np.array(one.out_comm.value)
        mirror = sent
        out.append(np.array(one.out_comm_no_delay.value))
    return np.array(out)


@pytest.fixture(scope="module")
def disturbance(scenario: wfsobs.Scenario) -> np.ndarray:
    return 1e3 * wfsobs.simulate(scenario.replace({"run.duration": 2.0})).z[:FRAMES]


def test_its_filter_class_is_the_controller(ours, scenario: wfsobs.Scenario, disturbance: np.ndarray) -> None:
    alone, u = wfsobs.design("lqg-kf-multi", scenario), np.zeros((FRAMES + 2, 2))
    for k, row in enumerate(disturbance):
        u[k] = alone.update(1e-3 * row + u[k - 2])
    np.testing.assert_allclose(close(ours, disturbance), -1e3 * u[:FRAMES], rtol=0, atol=1e-9 * np.abs(1e3 * u).max())


def test_its_file_in_the_filter_of_specula_gives_the_same(ours, scenario, disturbance, tmp_path: Path) -> None:
    write_design("lqg-kf-multi", scenario, "specula", tmp_path / "ssr.fits")
    theirs = SsrFilter(SsrFilterData.restore(str(tmp_path / "ssr.fits")), delay=1.0, output_uses_new_state=False)
    expected = close(ours, disturbance)
    # another order of the sums, over 400 frames of a closed loop
    np.testing.assert_allclose(close(theirs, disturbance), expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_a_mistake_in_the_file_is_told(tmp_path: Path) -> None:
    filter_class = import_class("WfsobsFilter", ["wfsobs.peers"])
    simul = SimulParams(pixel_pupil=8, pixel_pitch=1.0, time_step=1e-3)
    with pytest.raises(ControllerError, match="takes one of none"):
        filter_class(simul, controller="kf-multi", prior=str(tmp_path / "found.toml"))


@pytest.mark.timeout(3600)
def test_theory_says_what_the_loop_of_the_example_leaves(tmp_path: Path) -> None:
    """4 seeds of 3 s: within 3 standard errors and 3 % of theory, "off" with another gain than told. Spectrum above 60 Hz: 20 %.

    A band has 16 s of each of two modes, 960 independent numbers or more, and the noise that theory is told is of 8 s: 4 %
    together. Below, the windows of that noise are too short, and a damped line has some twenty independent amplitudes.
    """
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    script = ROOT / "examples" / "specula" / "run.py"
    loops = ("integrator", "lqg-kf-multi", "integrator, off", "lqg-kf-multi, off")
    done = subprocess.run(
        [sys.executable, str(script), "4", "3", *loops], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found = np.load(tmp_path / "series.npz")
    for name in loops:
        rms = np.sqrt([np.mean(np.sum(one**2, axis=1)) for one in found[name]])
        told = float(found[f"theory rms {name}"])
        standard_error = rms.std(ddof=1) / np.sqrt(len(rms))
        print(f"{name}: {np.round(rms, 1)} nm, {rms.mean():.1f} +- {standard_error:.1f} nm; theory {told:.1f} nm")
        assert abs(rms.mean() - told) < 3 * standard_error + 0.03 * told
        if name.endswith("off"):
            continue
        f, spectra = welch(found[name], 1e3, nperseg=1024, axis=1, detrend=False)
        fine, density = found["theory frequency"], found[f"theory {name}"]
        for low, high in ((60, 120), (120, 250), (250, 500)):
            seen = spectra.mean(axis=0).sum(axis=1)[(f >= low) & (f < high)].mean()
            assert seen == pytest.approx(density[(fine >= low) & (fine < high)].mean(), rel=0.2)
        assert re.search(rf"^theory, {name}: {told:.1f} nm$", done.stdout, flags=re.M)
