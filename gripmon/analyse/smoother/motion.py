"""Motion that is real and quick: a mount that vibrates, a camera that swings after a knock.

What is left of the frames after the slow motion is noise and quick motion.  A line in its spectrum that stands out of
the floor is a vibration, and is given back as far as it stands out (Wiener's filter, all six axes together at each
frequency).  Where frames scatter far more than they claim for a while, the transform follows them.
"""

from __future__ import annotations

import numpy as np
from scipy import signal
from scipy.ndimage import median_filter, uniform_filter1d

from gripmon.model.records import Array

WINDOW, HOP = 256, 64
AVERAGED = 32
"""Windows over which a spectrum is averaged."""
BESIDE = (3, 12)
"""Frequencies beside a line whose median is the floor; the higher one of both sides: the spectrum may fall steeply."""
STANDS_OUT = 8.0
"""So many times the floor the largest of six parts is by more than chance (of about twelve windows that don't overlap
it is three times the floor on average).
"""
LOWEST_BIN = 5
SWING_FRAMES = 12
SWING_FROM, SWING_CLAIM = 8.0, 5.0
"""Frames scatter so many times more than usual, and than they claim: the camera swings."""


def vibration(rest: Array) -> tuple[Array, Array]:
    """The vibration in what is left (n, a) of frames, and the mean squares (n, a) of its error."""
    none = np.zeros_like(rest)
    if len(rest) < 2 * WINDOW:
        return none, none.copy()
    shape = signal.get_window("hann", WINDOW)
    transform = signal.ShortTimeFFT(shape, HOP, 1.0)
    spectra = transform.stft(rest.T)
    spectra = np.moveaxis(spectra, 0, -1)  # (frequencies, windows, a)
    frequencies, windows, series = spectra.shape
    kept = np.zeros_like(spectra)
    lost = np.zeros((frequencies, windows, series))
    for begin in range(0, windows, AVERAGED):
        part = slice(begin, min(begin + AVERAGED, windows))
        own, variance = _stands_out(spectra[:, max(part.stop - AVERAGED, 0) : part.stop])
        kept[:, part] = np.einsum("fij,fwj->fwi", own, spectra[:, part])
        lost[:, part] = variance[:, None]
    back = transform.istft(np.moveaxis(kept, -1, 0), k1=len(rest)).T
    power = (lost.sum(axis=0) * 2.0) / (WINDOW * float((shape**2).sum()))
    at = np.clip(transform.t(len(rest)), 0, len(rest) - 1)
    error = np.stack([np.interp(np.arange(len(rest)), at, power[:, j]) for j in range(series)], axis=1)
    return np.real(back), error


def _stands_out(spectra: Array) -> tuple[Array, Array]:
    """Wiener gains (f, a, a) by the windows' mean cross spectra, and what their error's power is (f, a)."""
    count = spectra.shape[1]
    cross = np.einsum("fwi,fwj->fij", spectra, spectra.conj()) / count
    power = np.real(np.einsum("fii->fi", cross))
    floor = _floor(power) + 1e-300
    root = np.sqrt(floor)
    values, directions = np.linalg.eigh(cross / (root[:, :, None] * root[:, None, :]))
    share = np.where(values > STANDS_OUT, 1.0 - 1.0 / np.maximum(values, 1.0), 0.0)
    share[:LOWEST_BIN] = 0.0
    gain = np.einsum("fik,fk,fjk->fij", directions, share, directions.conj())
    gain = root[:, :, None] * gain / root[:, None, :]
    error = np.einsum("fik,fk->fi", np.abs(directions) ** 2, share) * floor
    return gain, error


def _floor(power: Array) -> Array:
    """(f, a) what the spectrum is without lines."""
    near, far = BESIDE
    size = far - near
    # The median of what lies around a place ``offset`` away.
    middle = median_filter(power, size=(size, 1), mode="nearest")
    offset = near + size // 2
    below = np.concatenate([np.repeat(middle[:1], offset, axis=0), middle[:-offset]])
    above = np.concatenate([middle[offset:], np.repeat(middle[-1:], offset, axis=0)])
    return np.maximum(below, above)


def swings(rest: Array, claimed: Array) -> Array:
    """Variance (n, a) of quick motion where there is some, else 0; ``claimed`` (n, a) is that of the frames."""
    squares = np.where(np.isfinite(rest), rest, 0.0) ** 2
    local = uniform_filter1d(squares, SWING_FRAMES, axis=0, mode="nearest")
    usual = np.median(local, axis=0)
    ratio = (local / np.maximum(claimed, 1e-12)).mean(axis=1)
    swinging = (ratio > SWING_CLAIM) & ((local / (usual + 1e-12)).mean(axis=1) > SWING_FROM)
    return np.where(swinging[:, None], np.maximum(local - usual, 0.0), 0.0)
