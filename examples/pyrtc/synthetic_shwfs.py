"""Predictors in pyRTC's synthetic Shack-Hartmann loop, frame by frame, on the disturbance of a preset. See docs/pyrtc.md.

    python synthetic_shwfs.py [SECONDS]

pyRTC's sensor renders spots with read noise, its `SlopesProcess` measures them, its `Loop` predicts and commands. In the place of
the few sines of the sensor, tip and tilt follow the preset paper. One command acts a frame later than the sensor reads it, two
frames in all, and nothing waits for a clock. Each predictor is fitted on 8 s under an integrator and runs on what follows.
"""

import sys
from uuid import uuid4

import numpy as np
import pyshmem
from pyrtc.hardware.synthetic_systems import SyntheticSHWFS
from pyrtc.slopes_process import SlopesProcess

import wfsobs
from wfsobs.peers import pyrtc as peer

LEARNT, RATE = 8000, 1000.0
PREDICTORS = {
    "ar_kalman": {},
    "least_squares": {"order": 30},
    "kf-multi": {"type": "wfsobs", "observer": "kf-multi", "rate": RATE},
    "lqg-kf-multi": {"type": "wfsobs", "observer": "lqg-kf-multi", "rate": RATE},
    "integrator+gpr-online": {"type": "wfsobs", "observer": "integrator+gpr-online", "rate": RATE},
}


class Sensor(SyntheticSHWFS):
    """pyRTC's sensor with a disturbance of its own, one number per frame and mode."""

    def __init__(self, conf, disturbance):
        super().__init__(conf)
        self.disturbance, self.held = disturbance, np.zeros(self.num_modes, np.float32)

    def _modal_disturbance(self, elapsed_seconds):
        return self.disturbance[self.frame_counter].astype(np.float32)

    def _current_correction(self):
        acts, self.held = self.held, super()._current_correction()
        return acts


def run(disturbance, predictor, gain=0.3):
    """Return the residual of every frame, (frames, modes); predictor : its options, or None for the integrator alone."""
    suffix = uuid4().hex[:8]
    name = {key: f"{key}_{suffix}" for key in ("wfs_raw", "wfs", "signal", "signal_2d", "wfc")}
    size = {"sub_ap_spacing": 8, "sub_ap_offset_x": 0, "sub_ap_offset_y": 0}
    wfc = pyshmem.create(name["wfc"], shape=(2,), dtype="float32")
    images = {"wfs_raw": name["wfs_raw"], "wfs": name["wfs"]}
    camera = {
        "name": "wfs",
        "width": 32,
        "height": 32,
        **size,
        "dark_count": 1,
        "frame_rate_hz": 0.0,
        "num_modes": 2,
        "read_noise": 40.0,
        "functions": [],
    }
    quiet = np.zeros((LEARNT, 2))
    sensor = Sensor(camera | {"input_streams": {"wfc": name["wfc"]}, "output_streams": images}, quiet)
    sensor.read_noise = 0.0
    streams = {"input_streams": {"wfs": name["wfs"]}, "output_streams": {key: name[key] for key in ("signal", "signal_2d")}}
    slopes = SlopesProcess(
        {"type": "SHWFS", "signal_type": "slopes", "image_noise": 0.0, "contrast": 0, "functions": [], **size} | streams
    )
    conf = {"functions": [], "gain": gain, "input_streams": {"signal": name["signal"]}, "output_streams": {"wfc": name["wfc"]}}
    kind = predictor or {"type": "persistence"}
    loop = peer.Loop(conf | {"predictor": {"delay_frames": 2, "horizon": 2, "gain": 1.0, "fit_frames": LEARNT - 100, **kind}})
    try:
        return _frames(sensor, slopes, loop, wfc, disturbance, predictor is not None)
    finally:
        for part in (loop, slopes, sensor):
            part.close()
        wfc.close()
        for stream in name.values():
            pyshmem.unlink(stream)


def _frames(sensor, slopes, loop, wfc, disturbance, predicts):
    def signal():
        sensor.expose()
        slopes.compute_signal()
        return np.array(loop.read_stream("signal", block=False)).ravel()

    pushed = []
    for row in 0.1 * np.eye(2, dtype=np.float32):  # the interaction matrix, without noise
        wfc.write(row)
        pushed.append([signal() for _ in range(3)][-1])
    wfc.write(np.zeros(2, np.float32))
    flat = [signal() for _ in range(3)][-1]
    loop.cm = np.linalg.pinv((np.transpose(pushed) - flat[:, None]) / 0.1).astype(np.float32)
    loop.g_cm = loop.gain * loop.cm
    sensor.read_noise, sensor.disturbance, sensor.frame_counter = 40.0, disturbance, 0
    left = np.zeros_like(disturbance)
    for k in range(len(disturbance)):
        if k == LEARNT and predicts:
            loop.fit_predictor()
        sensor.expose()
        left[k] = sensor.last_modal_disturbance - sensor.last_correction
        slopes.compute_signal()
        loop.predictive_integrator() if predicts else loop.standard_integrator()
    return left


def main():
    """Run every predictor and the best integrator; print what each leaves of tip and tilt together."""
    seconds = int(sys.argv[1]) if len(sys.argv) > 1 else 8
    record = wfsobs.simulate(wfsobs.PRESETS["paper"]().replace({"run.duration": 8.0 + seconds}))
    disturbance = record.turbulence + record.vibration

    def rms(predictor, **options):
        return 1e3 * float(np.sqrt(np.mean(run(disturbance, predictor, **options)[LEARNT + 1000 :] ** 2)))

    print(f"integrator, best gain: {min(rms(None, gain=g) for g in (0.3, 0.4, 0.5)):.1f} nm", flush=True)
    for title, options in PREDICTORS.items():
        print(f"{title}: {rms({'type': title} | options):.1f} nm", flush=True)


if __name__ == "__main__":
    main()
