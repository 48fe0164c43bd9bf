"""Symmetric matrices of a few rows, compiled, where LAPACK takes longer to be called than to calculate."""

from __future__ import annotations

import math

from gripmon.model.compiled import compiled
from gripmon.model.records import Array

JACOBI_SWEEPS = 30
"""Sweeps of Jacobi's rotations, of which some six suffice: each squares what is left."""


@compiled
def diagonalise(matrix: Array, vectors: Array) -> None:
    """Jacobi's rotations: a symmetric ``matrix`` (n, n) gets its eigenvalues on its diagonal, in no order, and
    ``vectors`` (n, n) the eigenvectors as columns.
    """
    count = len(matrix)
    for i in range(count):
        for j in range(count):
            vectors[i, j] = 1.0 if i == j else 0.0
    for _ in range(JACOBI_SWEEPS):
        rest, whole = 0.0, 0.0
        for i in range(count):
            whole += matrix[i, i] * matrix[i, i]
            for j in range(i):
                rest += matrix[i, j] * matrix[i, j]
        if rest <= 1e-30 * whole:
            break
        for p in range(count - 1):
            for q in range(p + 1, count):
                if matrix[p, q] == 0.0:
                    continue
                theta = 0.5 * (matrix[q, q] - matrix[p, p]) / matrix[p, q]
                t = (1.0 if theta >= 0.0 else -1.0) / (abs(theta) + math.sqrt(theta * theta + 1.0))
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for i in range(count):
                    a, b = matrix[i, p], matrix[i, q]
                    matrix[i, p], matrix[i, q] = c * a - s * b, s * a + c * b
                for i in range(count):
                    a, b = matrix[p, i], matrix[q, i]
                    matrix[p, i], matrix[q, i] = c * a - s * b, s * a + c * b
                    a, b = vectors[i, p], vectors[i, q]
                    vectors[i, p], vectors[i, q] = c * a - s * b, s * a + c * b
