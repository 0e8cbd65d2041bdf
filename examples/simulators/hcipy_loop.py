"""A tip-tilt loop in HCIPy: one layer of turbulence, a vibration of 47 Hz, a Shack-Hartmann sensor, two frames of delay.

The integrator runs first; what it has recorded tells the controller what to correct. `python hcipy_loop.py` prints both.
"""

import hcipy
import numpy as np
from scipy.ndimage import sum_labels
from scipy.signal import lfilter

import wfsobs

rate, learnt, frames = 500.0, 2000, 4000
rng = np.random.default_rng(1)

grid = hcipy.make_pupil_grid(64, 8.0)
star = hcipy.Wavefront(hcipy.evaluate_supersampled(hcipy.make_circular_aperture(8.0), grid, 4), 700e-9)
layer = hcipy.InfiniteAtmosphericLayer(grid, hcipy.Cn_squared_from_fried_parameter(0.15), L0=25.0, velocity=10.0, seed=1)
tiptilt = hcipy.make_zernike_basis(2, 8.0, grid, starting_mode=2)  # of rms 1 over the pupil
mirror, shaker = hcipy.DeformableMirror(tiptilt), hcipy.DeformableMirror(tiptilt)
pole = np.exp((-0.01 + 1j) * 2.0 * np.pi * 47.0 / rate)
shake = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], rng.normal(size=(frames, 2)), axis=0)
shake *= 0.1 / shake.std(axis=0)

relay = hcipy.Magnifier(1e-3)
lenslets = hcipy.SquareShackHartmannWavefrontSensorOptics(grid.scaled(1e-3), 50, 8, 8e-3)
light = sum_labels(lenslets(relay(star)).power, lenslets.mla_index, np.arange(lenslets.mla_grid.size))
centroids = hcipy.ShackHartmannWavefrontSensorEstimator(lenslets.mla_grid, lenslets.mla_index, light > 0.5 * light.max())


def slopes(beam, photons=0):
    """Return the slopes of a beam, with the noise of so many photons."""
    image = lenslets(relay(beam)).power
    if photons:
        image = hcipy.Field(rng.poisson(photons * image / image.sum()).astype(float), image.grid)
    return centroids.estimate([image]).ravel()


flat, pushed = slopes(star), []
for i in range(2):
    mirror.actuators = 25e-9 * np.eye(2)[i]  # of surface [m]: 0.05 um of wavefront
    pushed.append((slopes(mirror(star)) - flat) / 0.05)
reconstructor = np.linalg.pinv(np.transpose(pushed))
y, u = np.zeros((frames, 2)), np.zeros((frames, 2))


def measure(k):
    """Return tip and tilt of frame k [um], while the mirror has the command of two frames before."""
    layer.evolve_until(k / rate)
    shaker.actuators, mirror.actuators = 0.5e-6 * shake[k], 0.5e-6 * u[k - 2]
    return reconstructor @ (slopes(mirror(shaker(layer(star))), photons=1e5) - flat)


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
