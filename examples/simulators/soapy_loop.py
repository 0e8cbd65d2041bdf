"""A tip-tilt loop in soapy: one layer of turbulence, a vibration of 47 Hz, a Shack-Hartmann sensor, two frames of delay.

The integrator runs first; what it has recorded tells the controller what to correct. `NUMBA_NUM_THREADS=1 python soapy_loop.py`
prints both.
"""

from pathlib import Path

import numpy as np
import soapy
from scipy.signal import lfilter

import wfsobs

rate, learnt, frames = 500.0, 2000, 4000
rng = np.random.default_rng(1)
np.random.seed(1)  # noqa: NPY002  soapy's own

sim = soapy.Sim(str(Path(__file__).with_name("soapy_loop.yaml")))
sim.aoinit()
sensor, mirror = sim.wfss[0], sim.dms[0]
pupil = mirror.mask[1:-1, 1:-1] > 0
scale = 1e-3 * np.array([shape[pupil].std() for shape in mirror.iMatShapes])  # rms of a unit command [um]
pole = np.exp((-0.01 + 1j) * 2.0 * np.pi * 47.0 / rate)
shake = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], rng.normal(size=(frames, 2)), axis=0)
shake *= 0.1 / shake.std(axis=0)


def slopes(screens, tiptilt, calibrates=False):
    """Return the slopes with this much tip and tilt [um] added to the screens."""
    correction = mirror.dmFrame(-tiptilt / scale)  # subtracted from the wavefront
    return sensor.frame(screens, phase_correction=correction[None], iMatFrame=calibrates).copy()


pushed = [slopes(None, 0.05 * row, calibrates=True) / 0.05 for row in np.eye(2)]
reconstructor = np.linalg.pinv(np.transpose(pushed))
y, u = np.zeros((frames, 2)), np.zeros((frames, 2))


def measure(k):
    """Return tip and tilt of frame k [um], while the mirror has the command of two frames before."""
    return reconstructor @ slopes(sim.atmos.moveScrns(), shake[k] + u[k - 2])


for k in range(learnt):
    y[k] = measure(k)
    u[k] = u[k - 1] - 0.4 * y[k]

# the controller in its place
told = wfsobs.identify(wfsobs.Record(y[:learnt], u[:learnt], 1.0 / rate))
controller = wfsobs.design("lqg-kf-multi", told)
for k in range(learnt, frames):
    y[k] = measure(k)
    u[k] = controller.update(y[k])

before, after = (1e3 * y[part].std() for part in (slice(500, learnt), slice(learnt + 500, frames)))
print(f"measured: {before:.1f} nm with the integrator, {after:.1f} nm with the controller")
