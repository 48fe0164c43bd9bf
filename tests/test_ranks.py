"""Order statistics of stacks of images, held against sorting each pixel's values."""

from __future__ import annotations

import numpy as np
import pytest

from gripmon.model.ranks import median, of_ranks


@pytest.mark.parametrize("count", [1, 2, 3, 5, 12, 33])
def test_every_rank_is_that_of_sorted_values(count: int) -> None:
    stack = np.random.default_rng(count).integers(0, 9, (count, 30, 700)).astype(np.float32)  # many are equal
    given = stack.copy()
    assert (np.array(of_ranks(stack, range(count))) == np.sort(stack, axis=0)).all()
    assert (stack == given).all()


@pytest.mark.parametrize("count", [1, 2, 7, 30])
def test_the_median_is_numpys_to_the_last_digit(count: int) -> None:
    stack = np.random.default_rng(count).normal(100.0, 30.0, (count, 41, 53)).astype(np.float32)
    found = median(stack)
    assert found.dtype == np.float32
    assert (found == np.median(stack, axis=0)).all()
