"""Lens maps behind :mod:`gripmon.model.camera`: ideal <-> distorted normalised coordinates, with analytic Jacobians.

``xy`` are ideal normalised coordinates x/z, y/z, ``q`` distorted ones, ``((u - cx)/fx, (v - cy)/fy)``, both (2, n).
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from gripmon.model.records import Array

_WIDEST_RAD = math.radians(89.0)  # beyond it x/z is not a useful coordinate
_TABLE_SIZE = 2048
_NEWTON_STEPS = 30
_NEWTON_TOLERANCE = 1e-7  # of the last step; convergence is quadratic, so the remaining error is about 1e-14

Jacobian = tuple[Array, Array, Array, Array]  # 2x2 by entries, row by row, each (n,)


class LensMap(Protocol):
    """Maps ideal (2, n) <-> distorted (2, n) normalised coordinates; NaN outside the domain."""

    fold_q: float  # distorted radius at which the model ends: it folds, or reaches the widest angle
    folds: bool  # whether the model ends by folding

    def distort(self, xy: Array) -> Array: ...
    def distort_with_jacobian(self, xy: Array) -> tuple[Array, Jacobian]: ...
    def undistort(self, q: Array) -> Array: ...
    def undistort_with_jacobian(self, q: Array) -> tuple[Array, Jacobian]: ...


class PaperMap:
    """``xy = q (1 + k |q|²)``; its inverse is the real root of a cubic, in closed form."""

    def __init__(self, k: float) -> None:
        self._k = k
        self.folds = k < 0.0
        self.fold_q = 1.0 / math.sqrt(-3.0 * k) if self.folds else math.inf
        self._fold_q2 = self.fold_q**2

    def distort(self, xy: Array) -> Array:
        x, y = xy
        # s + k s³ = r has s = (2/w) sinh(asinh(1.5 w)/3) r with w = sqrt(3 k) r; sines where k < 0.  The tiny addend
        # keeps w > 0 on the axis, where the quotient is then exactly 1.
        w = np.sqrt((3.0 * abs(self._k)) * (x * x + y * y) + 1e-300)
        if self.folds:
            domain = np.where(w < 2.0 / 3.0, w, np.nan)
            scale: Array = np.sin(np.arcsin(1.5 * domain) * (1.0 / 3.0)) * 2.0 / w
        else:
            scale = np.sinh(np.arcsinh(1.5 * w) * (1.0 / 3.0)) * 2.0 / w
        return xy * scale

    def distort_with_jacobian(self, xy: Array) -> tuple[Array, Jacobian]:
        q = self.distort(xy)
        qx, qy = q
        ks2 = self._k * (qx * qx + qy * qy)
        # Sherman-Morrison on the Jacobian of the undistortion, (1 + k s²) I + 2 k q qᵀ.
        g = 1.0 / (1.0 + ks2)
        h = (2.0 * self._k) * g / (1.0 + 3.0 * ks2)
        hx = h * qx
        off = -hx * qy
        return q, (g - hx * qx, off, off, g - h * qy * qy)

    def undistort(self, q: Array) -> Array:
        return q * (1.0 + self._k * self._radius2(q))

    def undistort_with_jacobian(self, q: Array) -> tuple[Array, Jacobian]:
        qx, qy = q
        stretch = 1.0 + self._k * self._radius2(q)
        kx = (2.0 * self._k) * qx
        off = kx * qy
        return q * stretch, (stretch + kx * qx, off, off, stretch + (2.0 * self._k) * qy * qy)

    def _radius2(self, q: Array) -> Array:
        qx, qy = q
        radius2: Array = qx * qx + qy * qy
        return np.where(radius2 < self._fold_q2, radius2, np.nan) if self.folds else radius2


class BrownMap:
    """OpenCV's rational polynomial with tangential and thin-prism terms; inverted by Newton's method in 2D."""

    def __init__(self, coefficients: tuple[float, ...]) -> None:
        padded = (*coefficients, *([0.0] * (12 - len(coefficients))))
        k1, k2, self._p1, self._p2, k3, k4, k5, k6, s1, s2, s3, s4 = padded
        self._numerator, self._denominator = (k1, k2, k3), (k4, k5, k6)
        self._prism = (s1, s2, s3, s4)
        self._rational = any(self._denominator)
        top = np.polynomial.Polynomial([1.0, k1, k2, k3])
        bottom = np.polynomial.Polynomial([1.0, k4, k5, k6])
        t = np.polynomial.Polynomial([0.0, 1.0])
        # d/dr of r N(r²)/D(r²) is zero where this polynomial in t = r² is; the model also ends where D is zero.
        slope = top * bottom + 2.0 * t * (top.deriv() * bottom - top * bottom.deriv())
        fold_r2 = min(_first_positive_root(slope), _first_positive_root(bottom))
        self.folds = fold_r2 < math.tan(_WIDEST_RAD) ** 2
        fold_rad = math.atan(math.sqrt(fold_r2)) if self.folds else _WIDEST_RAD
        self._max_r2 = math.tan(fold_rad) ** 2
        # The map can't be inverted at the fold itself: the table stops just before it.
        self._table_r = np.tan(np.linspace(0.0, fold_rad * (1.0 - 1e-9), _TABLE_SIZE))
        r2 = self._table_r**2
        self._table_q: Array = self._table_r * top(r2) / bottom(r2)
        self.fold_q = float(self._table_q[-1])

    def distort(self, xy: Array) -> Array:
        x, y = xy
        r2 = x * x + y * y
        r2 = np.where(r2 < self._max_r2, r2, np.nan)
        radial = _horner(self._numerator, r2)
        if self._rational:
            radial = radial * (1.0 / _horner(self._denominator, r2))
        tangent = 2.0 * (self._p1 * y + self._p2 * x)
        q: Array = xy * (radial + tangent)
        q[0] += self._p2 * r2
        q[1] += self._p1 * r2
        if any(self._prism):
            s1, s2, s3, s4 = self._prism
            q[0] += r2 * (s1 + s2 * r2)
            q[1] += r2 * (s3 + s4 * r2)
        return q

    def distort_with_jacobian(self, xy: Array) -> tuple[Array, Jacobian]:
        x, y = xy
        r2 = x * x + y * y
        r2 = np.where(r2 < self._max_r2, r2, np.nan)
        radial, slope = _horner(self._numerator, r2), _horner_slope(self._numerator, r2)
        if self._rational:
            per_bottom = 1.0 / _horner(self._denominator, r2)
            radial = radial * per_bottom
            slope = (slope - radial * _horner_slope(self._denominator, r2)) * per_bottom
        p1, p2 = self._p1, self._p2
        # tangential terms: x (2 p1 y + 2 p2 x) + p2 r² and y (2 p1 y + 2 p2 x) + p1 r², the same as OpenCV's
        scale = radial + 2.0 * (p1 * y + p2 * x)
        q: Array = xy * scale
        q[0] += p2 * r2
        q[1] += p1 * r2
        ax, ay = 2.0 * slope * x + 2.0 * p2, 2.0 * slope * y + 2.0 * p1
        j00, j01 = scale + x * ax + (2.0 * p2) * x, x * ay + (2.0 * p2) * y
        j10, j11 = y * ax + (2.0 * p1) * x, scale + y * ay + (2.0 * p1) * y
        if any(self._prism):
            s1, s2, s3, s4 = self._prism
            q[0] += r2 * (s1 + s2 * r2)
            q[1] += r2 * (s3 + s4 * r2)
            bx, by = 2.0 * s1 + (4.0 * s2) * r2, 2.0 * s3 + (4.0 * s4) * r2
            j00, j01, j10, j11 = j00 + bx * x, j01 + bx * y, j10 + by * x, j11 + by * y
        return q, (j00, j01, j10, j11)

    def undistort(self, q: Array) -> Array:
        return self.undistort_with_jacobian(q)[0]

    def undistort_with_jacobian(self, q: Array) -> tuple[Array, Jacobian]:
        """The Jacobian is that of the last Newton step, within the step's tolerance of the exact one."""
        radius = np.sqrt(q[0] * q[0] + q[1] * q[1] + 1e-300)
        xy = q * (np.interp(radius, self._table_q, self._table_r) / radius)
        for _ in range(_NEWTON_STEPS):
            value, (j00, j01, j10, j11) = self.distort_with_jacobian(xy)
            ex, ey = q - value
            per_det = 1.0 / (j00 * j11 - j01 * j10)
            inverse = (j11 * per_det, -j01 * per_det, -j10 * per_det, j00 * per_det)
            step = np.stack((inverse[0] * ex + inverse[1] * ey, inverse[2] * ex + inverse[3] * ey))
            xy = xy + step
            unfinished = np.abs(step) > _NEWTON_TOLERANCE  # False for NaN: points that left the domain stay NaN
            if not unfinished.any():
                return xy, inverse
        mask = np.where(unfinished.any(axis=0), np.nan, 1.0)
        return xy * mask, (inverse[0] * mask, inverse[1] * mask, inverse[2] * mask, inverse[3] * mask)


class FisheyeMap:
    """Purely radial in the angle from the axis; inverted by Newton's method in one dimension."""

    def __init__(self, coefficients: tuple[float, ...]) -> None:
        k1, k2, k3, k4 = coefficients
        self._k = (k1, k2, k3, k4)
        self._slope = (3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4)
        fold_theta2 = _first_positive_root(np.polynomial.Polynomial([1.0, *self._slope]))
        self.folds = fold_theta2 < _WIDEST_RAD**2
        self._max_theta = math.sqrt(fold_theta2) if self.folds else _WIDEST_RAD
        self._table_theta = np.linspace(0.0, self._max_theta * (1.0 - 1e-9), _TABLE_SIZE)
        self._table_q: Array = self._table_theta * _horner(self._k, self._table_theta**2)
        self.fold_q = float(self._table_q[-1])

    def distort(self, xy: Array) -> Array:
        r, theta = self._angle(xy)
        return xy * (theta * _horner(self._k, theta * theta) / r)

    def distort_with_jacobian(self, xy: Array) -> tuple[Array, Jacobian]:
        r, theta = self._angle(xy)
        theta2 = theta * theta
        across = theta * _horner(self._k, theta2) / r
        along = _horner(self._slope, theta2) / (1.0 + r * r)
        return xy * across, _radial_jacobian(xy / r, along, across)

    def undistort(self, q: Array) -> Array:
        radius, theta = self._solve(q)
        return q * (np.tan(theta) / radius)

    def undistort_with_jacobian(self, q: Array) -> tuple[Array, Jacobian]:
        radius, theta = self._solve(q)
        r = np.tan(theta)
        across = r / radius
        along = (1.0 + r * r) / _horner(self._slope, theta * theta)
        return q * across, _radial_jacobian(q / radius, along, across)

    def _angle(self, xy: Array) -> tuple[Array, Array]:
        """Radius (kept above zero) and angle from the axis, NaN outside the domain."""
        r = np.sqrt(xy[0] * xy[0] + xy[1] * xy[1] + 1e-300)
        theta = np.arctan(r)
        return r, np.where(theta < self._max_theta, theta, np.nan)

    def _solve(self, q: Array) -> tuple[Array, Array]:
        """Distorted radius (kept above zero) and angle from the axis, NaN outside the domain."""
        radius = np.sqrt(q[0] * q[0] + q[1] * q[1] + 1e-300)
        theta = np.interp(radius, self._table_q, self._table_theta, right=np.nan)
        for _ in range(_NEWTON_STEPS):
            theta2 = theta * theta
            step = (radius - theta * _horner(self._k, theta2)) / _horner(self._slope, theta2)
            theta = theta + step
            unfinished = np.abs(step) > _NEWTON_TOLERANCE
            if not unfinished.any():
                return radius, np.where(theta < self._max_theta, theta, np.nan)
        return radius, np.where(unfinished, np.nan, theta)


def _radial_jacobian(direction: Array, along: Array, across: Array) -> Jacobian:
    """Jacobian of a radial map from its slope along the radius and its scale across it; direction is (2, n), unit."""
    nx, ny = direction
    excess = along - across
    mixed = excess * nx * ny
    return across + excess * nx * nx, mixed, mixed, across + excess * ny * ny


def _horner(coefficients: tuple[float, ...], t: Array) -> Array:
    """1 + c1 t + c2 t² + …"""
    value: Array = coefficients[-1] * t
    for c in coefficients[-2::-1]:
        value += c
        value *= t
    value += 1.0
    return value


def _horner_slope(coefficients: tuple[float, ...], t: Array) -> Array:
    """Derivative of 1 + c1 t + c2 t² + c3 t³ by t."""
    c1, c2, c3 = coefficients
    value: Array = (3.0 * c3) * t
    value += 2.0 * c2
    value *= t
    value += c1
    return value


def _first_positive_root(polynomial: np.polynomial.Polynomial) -> float:
    """Smallest positive real root, infinity if there is none."""
    roots = polynomial.trim().roots()
    real = roots.real[(np.abs(roots.imag) <= 1e-7 * np.abs(roots)) & (roots.real > 0.0)]
    return float(real.min()) if real.size else math.inf
