"""What one disturbance and white noise bring into the states of a filter of every step and of a filter of frames.

A frame is the mean of the measurements of n steps, with noise of its own. With the disturbance's state d, the fast filter f, the
sum a of the exposure so far and the filter s of the frames, (d[k+1], f[k], a[k], s[k]) is a linear process whose matrices repeat
every n steps; its covariance is that of a Lyapunov equation of one cycle.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from wfsobs.signal.filter_covariance import lyapunov
from wfsobs.signal.joint_states import StateFilter
from wfsobs.signal.statespace import DisturbanceModel
from wfsobs.signal.wiener import Complex
from wfsobs.typing import Array


class FrameShare(NamedTuple):
    """What the disturbance of one mode alone, and noise, bring into the states of both filters: covariances [um^2].

    states      : of the states, (n, n)
    disturbance : of the disturbance's state and those, (n_disturbance, n)
    exposure    : of what the running frame has seen so far and those, (n,)
    """

    states: Array
    disturbance: Array
    exposure: Array


def frame_shares(
    fast: StateFilter,
    frames: StateFilter,
    ratio: int,
    model: DisturbanceModel,
    noise: float,
    frame_noise: float,
    gain: float = 1.0,
    *,
    age: int = 0,
) -> list[FrameShare]:
    """Return the shares in the states of both filters, the fast one first, in `ratio` steps one after the other.

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
    age : int
        Steps between the last frame that was read and the first of these steps, a multiple of `ratio`.

    Returns
    -------
    list of FrameShare
        Covariances, `age`, `age` + 1, ... steps after the last frame.
    """
    n, m, p = len(model.A), len(fast.F), len(frames.F)
    of_fast, at_sum, of_frames = slice(n, n + m), n + m, slice(n + m + 1, n + m + 1 + p)
    step = block_diag(model.A, fast.F, np.eye(1 + p))
    step[of_fast, :n], step[at_sum, :n] = np.outer(fast.G, gain * model.C), np.ravel(model.C) / ratio
    read = np.eye(len(step))  # at the end of an exposure
    read[of_frames, of_frames], read[of_frames, at_sum], read[at_sum, at_sum] = frames.F, frames.G, 0.0
    drive = block_diag(model.Q, noise**2 * np.outer(fast.G, fast.G), np.zeros((1 + p, 1 + p)))
    frame = (read @ step, read @ drive @ read.T)
    frame[1][of_frames, of_frames] += frame_noise**2 * np.outer(frames.G, frames.G)
    between = [(step, drive)] * (ratio - 1)
    F, W = np.eye(len(step)), np.zeros_like(step)
    for one, more in (*between, frame):
        F, W = one @ F, one @ W @ one.T + more
    S, kept, out = lyapunov(F, W), np.r_[of_fast, of_frames], list[FrameShare]()  # S: in a step with a frame
    anew = step @ np.diag(np.arange(len(step)) != at_sum)  # after the end of an exposure that was not read
    unread = [(step if i % ratio else anew, drive) for i in range(age + ratio - 1)]
    for one, more in unread if age else (*between, frame):
        cross = S[:n] @ one.T
        S = one @ S @ one.T + more
        out.append(FrameShare(S[np.ix_(kept, kept)], cross[:, kept], S[at_sum, kept]))
    return out[-ratio:] if age else [out[-1], *out[:-1]]


def frame_mean_response(ratio: int, omega: Array) -> Complex:
    """Return the response of a frame to the measurements of every step, in the last of these, (len(omega),)."""
    return np.exp(-1j * np.outer(np.arange(ratio), omega)).mean(axis=0)
