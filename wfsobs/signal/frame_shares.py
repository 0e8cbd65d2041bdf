"""What one disturbance and white noise bring into the states of a filter of every step and of a filter of frames.

A frame is the mean of the measurements of n steps, with noise of its own. With the disturbance's state d, the fast filter f, the
sum a of the exposure so far and the filter s of the frames, (d[k+1], f[k], a[k], s[k]) is a linear process whose matrices repeat
every n steps; its covariance is that of a Lyapunov equation of one cycle.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from wfsobs.signal.filter_covariance import lyapunov
from wfsobs.signal.joint_states import OwnShare, StateFilter
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.signal.wiener import Complex
from wfsobs.typing import Array


def frame_shares(
    fast: StateFilter,
    frames: StateFilter,
    ratio: int,
    model: DisturbanceModel,
    noise: float,
    frame_noise: float,
    gain: float = 1.0,
) -> list[OwnShare]:
    """Return the shares in the states of both filters, the fast one first, 0, 1, ..., ratio - 1 steps after a frame.

    Parameters
    ----------
    fast, frames : StateFilter
        Of every step, and of every frame.
    ratio : int
        Steps per frame.
    model : DisturbanceModel
        The disturbance.
    noise, frame_noise : float
        White noise in a step and in a frame [um].
    gain : float
        Of the fast filter's measurement for the disturbance.

    Returns
    -------
    list of OwnShare
        Covariances [um^2].
    """
    n, m, p = len(model.A), len(fast.F), len(frames.F)
    of_fast, at_sum, of_frames = slice(n, n + m), n + m, slice(n + m + 1, n + m + 1 + p)
    step = block_diag(model.A, fast.F, np.eye(1 + p))
    step[of_fast, :n], step[at_sum, :n] = np.outer(fast.G, gain * model.C), np.ravel(model.C) / ratio
    read = np.eye(len(step))  # at the end of an exposure
    read[of_frames, of_frames], read[of_frames, at_sum], read[at_sum, at_sum] = frames.F, frames.G, 0.0
    drive = block_diag(model.Q, noise**2 * np.outer(fast.G, fast.G), np.zeros((1 + p, 1 + p)))
    maps = [read @ step, *[step] * (ratio - 1)]  # to 0, 1, ... steps after a frame
    drives = [read @ drive @ read.T, *[drive] * (ratio - 1)]
    drives[0][of_frames, of_frames] += frame_noise**2 * np.outer(frames.G, frames.G)
    F, W = np.eye(len(step)), np.zeros_like(step)
    for one, more in zip([*maps[1:], maps[0]], [*drives[1:], drives[0]], strict=True):
        F, W = one @ F, one @ W @ one.T + more
    S, kept = lyapunov(F, W), np.r_[of_fast, of_frames]
    out = [OwnShare(S[np.ix_(kept, kept)], np.empty((n, m + p)))]
    for one, more in zip([*maps[1:], maps[0]], [*drives[1:], drives[0]], strict=True):
        cross = (S[:n] @ one.T)[:, kept]
        S = one @ S @ one.T + more
        out.append(OwnShare(S[np.ix_(kept, kept)], cross))
    return [out[-1], *out[1:-1]]


def frame_response(frames: StateFilter, ratio: int, omega: Array) -> Complex:
    """Return the response of the filter of frames to the measurements of every step, in a step with a frame, (p, len(omega))."""
    exposure = np.exp(-1j * np.outer(np.arange(ratio), omega)).mean(axis=0)
    return frames.response(ratio * omega) * exposure
