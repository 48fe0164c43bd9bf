"""Vibration of the mount, and swinging after a knock, in the residuals of frames about the smoothed pose.

A line in the spectrum above the noise floor is a vibration, which a Wiener filter restores (all six axes together at
each frequency).  Where frames scatter far more than their reported variance for a while, the transform follows them.
"""

from __future__ import annotations

import numpy as np
from scipy import signal
from scipy.ndimage import median_filter, uniform_filter1d

from gripmon.model.records import Array

SPECTRUM_FRAMES, SPECTRUM_STEP_FRAMES = 256, 64
AVERAGED_SPECTRA = 32
"""Windows over which a spectrum is averaged; some twelve of them don't overlap."""
FLOOR_BINS = 25
"""Bins whose median is the floor; a line, by the window's shape, has three."""
LINE_OVER_FLOOR = 8.0
"""Multiple of the floor from which the largest of six eigenvalues is not due to chance: of noise, with twelve windows,
it is (1 + sqrt(6/12))² = 2.9 times the floor on average (Marchenko and Pastur).
"""
SWING_FRAMES = 12
"""Frames over which squares are averaged to find swinging."""
SWING_RATIO = 5.0
"""Multiple of the usual and of the reported variance from which frames swing: of the mean of 12 squares by six axes,
noise reaches it never, errors as their background has them (one, twice over) hardly.
"""


def vibration(rest: Array, lowest: float) -> tuple[Array, Array]:
    """The vibration in the residuals (n, a) of frames, from ``lowest`` cycles a frame, and the mean squares (n, a) of
    its error.
    """
    quick, error = np.zeros((2, *rest.shape))
    if len(rest) < 2 * SPECTRUM_FRAMES:
        return quick, error
    first = int(np.ceil(lowest * SPECTRUM_FRAMES))
    shape = signal.get_window("hann", SPECTRUM_FRAMES)
    transform = signal.ShortTimeFFT(shape, SPECTRUM_STEP_FRAMES, 1.0)
    spectra = np.moveaxis(transform.stft(rest.T), 0, -1)  # (frequencies, windows, a)
    kept, lost = np.zeros_like(spectra), np.zeros(spectra.shape[1:])
    for begin in range(0, spectra.shape[1], AVERAGED_SPECTRA):
        part = spectra[:, begin : begin + AVERAGED_SPECTRA]
        end = begin + part.shape[1]
        gain, power = _lines(spectra[:, max(end - AVERAGED_SPECTRA, 0) : end], first)
        kept[:, begin:end] = np.einsum("fij,fwj->fwi", gain, part)
        lost[begin:end] = 2.0 * power / (SPECTRUM_FRAMES * float((shape**2).sum()))
    quick = np.real(transform.istft(np.moveaxis(kept, -1, 0), k1=len(rest)).T)
    middles = transform.t(len(rest))
    for axis, values in enumerate(lost.T):
        error[:, axis] = np.interp(np.arange(len(rest)), middles, values)
    return quick, error


def _lines(spectra: Array, first: int) -> tuple[Array, Array]:
    """Wiener gains (f, a, a) from the windows' mean cross spectra, and the power (a,) of their error; none before the
    ``first`` frequency.
    """
    cross = np.einsum("fwi,fwj->fij", spectra, spectra.conj()) / spectra.shape[1]
    floor = median_filter(np.real(np.einsum("fii->fi", cross)), size=(FLOOR_BINS, 1), mode="reflect") + 1e-300
    root = np.sqrt(floor)
    values, directions = np.linalg.eigh(cross / (root[:, :, None] * root[:, None, :]))
    share = np.where(values > LINE_OVER_FLOOR, 1.0 - 1.0 / np.maximum(values, 1.0), 0.0)
    share[:first] = 0.0
    gain = np.einsum("fi,fik,fk,fjk,fj->fij", root, directions, share, directions.conj(), 1.0 / root, optimize=True)
    return gain, (np.einsum("fik,fk->fi", np.abs(directions) ** 2, share) * floor).sum(axis=0)


def swings(rest: Array, claimed: Array) -> Array:
    """Variance (n, a) of swinging, 0 where there is none; ``claimed`` (n, a): reported variance of the frames."""
    local = uniform_filter1d(rest * rest, SWING_FRAMES, axis=0, mode="nearest")
    usual = np.median(local, axis=0)
    swinging = ((local / claimed).mean(axis=1) > SWING_RATIO) & ((local / (usual + 1e-12)).mean(axis=1) > SWING_RATIO)
    return np.where(swinging[:, None], np.maximum(local - usual, 0.0), 0.0)
