"""What is equal keeps its order, however many are sorted side by side."""

import numpy as np
import pytest

from pagas_cl.method.surface import weld


@pytest.mark.parametrize("many", [0, 1 << 20])
@pytest.mark.parametrize("spread", [1, 30, 4000])
def test_numbers_are_grouped_in_their_order(monkeypatch, many, spread):
    monkeypatch.setattr(weld, "_MANY", many)
    numbers = (np.random.default_rng(1).uniform(size=10_000) ** 3 * spread).astype(np.int32)      # the first ones often
    first, order = weld.grouped(numbers, spread + 5)
    assert np.array_equal(order, np.argsort(numbers, kind="stable"))
    assert np.array_equal(first, np.searchsorted(numbers[order], np.arange(spread + 6)))
    assert first.dtype == order.dtype == np.int32
