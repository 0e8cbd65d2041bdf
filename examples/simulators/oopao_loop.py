"""A tip-tilt loop in OOPAO: one layer of turbulence, a vibration of 47 Hz, a Shack-Hartmann sensor, two frames of delay.

The integrator runs first; what it has recorded tells the controller what to correct. `python oopao_loop.py` prints both.
"""

import numpy as np
from OOPAO.Atmosphere import Atmosphere
from OOPAO.DeformableMirror import DeformableMirror
from OOPAO.ShackHartmann import ShackHartmann
from OOPAO.Source import Source
from OOPAO.Telescope import Telescope
from OOPAO.Zernike import Zernike
from scipy.signal import lfilter

import wfsobs

rate, learnt, frames = 500.0, 2000, 4000
rng = np.random.default_rng(1)

telescope = Telescope(resolution=64, diameter=8.0, samplingTime=1.0 / rate)
star = Source("K", 9, display_properties=False)
star * telescope
air = Atmosphere(telescope, r0=0.15, L0=25.0, windSpeed=[10.0], fractionalR0=[1.0], windDirection=[0.0], altitude=[0.0])
air.initializeAtmosphere(telescope)
zernike = Zernike(telescope, 2)
zernike.computeZernike(telescope)
tiptilt = zernike.modesFullRes.reshape(-1, 2)  # of rms 1 over the pupil
mirror, shaker = (DeformableMirror(telescope, nSubap=8, modes=tiptilt, print_dm_properties=False) for _ in range(2))
sensor = ShackHartmann(nSubap=8, telescope=telescope, lightRatio=0.5)
pole = np.exp((-0.01 + 1j) * 2.0 * np.pi * 47.0 / rate)
shake = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], rng.normal(size=(frames, 2)), axis=0)
shake *= 0.1 / shake.std(axis=0)

pushed = []
for i in range(2):
    mirror.coefs = 0.05e-6 * np.eye(2)[i]  # [m]
    star * telescope * mirror * sensor
    pushed.append(sensor.signal / 0.05)
reconstructor = np.linalg.pinv(np.transpose(pushed))
sensor.cam.photonNoise, sensor.cam.random_state_photon_noise = True, np.random.RandomState(1)
y, u = np.zeros((frames, 2)), np.zeros((frames, 2))


def measure(k):
    """Return tip and tilt of frame k [um], while the mirror has the command of two frames before."""
    air.update()
    shaker.coefs, mirror.coefs = 1e-6 * shake[k], 1e-6 * u[k - 2]
    star**air * telescope * shaker * mirror * sensor
    return reconstructor @ sensor.signal


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
