"""Settings of the wavefront sensors."""

from __future__ import annotations

import param

from wfsobs.parameters import Real, Whole
from wfsobs.settings import Group


class Sensors(Group):
    """Wavefront sensors: a natural guide star (NGS) and laser guide stars (LGS)."""

    lgs_rate = Real(1000.0, bounds=(10.0, 100_000.0), label="LGS rate 1/T",
                    doc="Frame rate of the LGS sensors and of the loop [Hz] (paper, Table 3: 1000 Hz).")
    exposure_ratio = Whole(5, bounds=(1, 100), softbounds=(1, 20), label="Exposure ratio n",
                           doc="NGS exposure over LGS exposure, n = T_NGS / T_LGS (paper: 5 ms over 1 ms).")
    lgs_count = Whole(2, bounds=(1, 16), label="Number of LGS", doc="Laser guide stars; their plain mean is used (paper).")
    lgs_noise = Real(0.02, bounds=(0.0, 10.0), softbounds=(0.0, 0.2), step=0.001, label="LGS noise",
                     doc="White measurement noise of each LGS and mode, rms [um]; not given in the paper.")
    ngs_noise = Real(0.01, bounds=(0.0, 10.0), softbounds=(0.0, 0.2), step=0.001, label="NGS noise",
                     doc="White measurement noise of an NGS frame and mode, rms [um]; not given in the paper.")
    lgs_low_frequency_rms = Real(
        0.049, bounds=(0.0, 10.0), softbounds=(0.0, 0.2), step=0.005, label="LGS low-frequency error",
        doc="Slow tip-tilt error of each LGS, rms [um], independent between LGS: the stand-in for cone effect and "
            "uplink turbulence. 0.049 um is the cone effect of one layer at 8 km and a guide star at 90 km.")
    tip_tilt_indetermination = param.Boolean(
        False, label="Tip-tilt indetermination",
        doc="An LGS that cannot see turbulent tip-tilt at all, as in reality; off in the paper, whose "
            "simulator does not model it.")
