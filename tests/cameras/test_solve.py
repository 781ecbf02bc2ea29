"""The small system of all cameras: sparse as dense, and what photos do not see."""

import numpy as np
import pytest

from pagas_cl.method.cameras.solve import DENSE, Term, Unknowns, assemble, pixel_scales, solve

pytestmark = pytest.mark.slow


def chain(cameras: int, rng):
    """Terms of made blocks, each view with its neighbours."""
    from pagas_cl.method.cameras.adjust import Block

    terms = []
    for t in range(cameras):
        others = tuple(k for k in (t - 2, t - 1, t + 1, t + 2) if 0 <= k < cameras)
        a = rng.normal(size=(60, 6 * len(others)))
        matrix = (a.T @ a).reshape(len(others), 6, len(others), 6)
        terms.append(Term(t, others, Block(matrix, rng.normal(size=(len(others), 6)), np.ones(4), np.ones(4))))
    return terms


def test_a_thousand_cameras_sparse_as_dense(monkeypatch):
    pytest.importorskip("scipy")
    from conftest import look_at

    from pagas_cl.method.cameras import solve as module

    rng = np.random.default_rng(0)
    cameras = [look_at((0.1 * k, 0, -4), (0.1 * k, 0, 0)) for k in range(1000)]
    for number in (30, 1000):
        unknowns = Unknowns(number, pixel_scales(cameras[:number], [1.0] * number))
        terms = chain(number, rng)
        monkeypatch.setattr(module, "DENSE", 0)
        system, right = assemble(terms, cameras, 4.0, unknowns)
        assert system.nnz < 6 * 6 * 9 * number and not isinstance(system, np.ndarray)
        y, spread = solve(system, right, np.zeros(6 * number), 1e-6, 1.0)
        hold = 1e-6 / spread**2
        monkeypatch.setattr(module, "DENSE", DENSE)
        if number <= DENSE:
            dense, same = assemble(terms, cameras, 4.0, unknowns)
            assert system.toarray() == pytest.approx(dense) and np.array_equal(right, same)
        assert np.linalg.norm(system @ y + hold * y + right) < 0.1 * np.linalg.norm(right)


def test_what_nothing_sees_stays_given():
    """Unknowns without evidence go back to where they were given; evidence below the noise moves nothing."""
    system, right = np.diag([1e4, 1e4, 0.0]), np.array([-1e4, 1e4, 0.0])
    y, spread = solve(system, right, np.array([0.0, 0.0, 0.3]), 1.0, 1.0)
    assert y == pytest.approx([1, -1, 0], abs=1e-3) and spread == pytest.approx(1, abs=0.1)
    y, spread = solve(system, 1e-3 * right, np.zeros(3), 1.0, 1.0)
    assert np.abs(y).max() < 1e-4 and spread < 1e-3
