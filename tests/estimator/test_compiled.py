"""Trees as vectors: what comes back is what went in, bit by bit, on the host and inside a compiled function."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from uwbslam_jax.estimator.packing import Packing
from uwbslam_jax.measurements import Frame, empty_frame


def frame(seed: int) -> Frame:
    """A frame of 7 beams and 5 ranges with every kind of number in it."""
    rng = np.random.default_rng(seed)

    def filled(leaf):
        leaf = np.asarray(leaf)
        if leaf.dtype == bool:
            return rng.random(leaf.shape) < 0.5
        if leaf.dtype == np.int32:
            return rng.integers(0, 2**24, leaf.shape, np.int32)
        return rng.choice(np.array([np.nan, -0.0, 1e-30, 3.3, -7e8], np.float32), leaf.shape)

    return jax.tree.map(filled, empty_frame(7, 5))


def assert_same(a: Frame, b: Frame) -> None:
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert np.asarray(x).dtype == np.asarray(y).dtype
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


@pytest.mark.parametrize("seed", range(3))
def test_a_frame_comes_back_bit_by_bit(seed):
    packing, one = Packing(empty_frame(7, 5)), frame(seed)
    vector = np.empty(packing.size, np.float32)
    packing.pack(one, vector)
    assert vector.shape == (packing.size,)
    assert_same(packing.unpack(vector), one)
    there_and_back = jax.jit(lambda v: packing.pack_device(packing.unpack(v)))
    assert_same(packing.unpack(np.asarray(there_and_back(vector))), one)


def test_a_tree_of_another_size_is_refused():
    packing = Packing(empty_frame(7, 5))
    with pytest.raises(ValueError):
        packing.pack(empty_frame(8, 5), np.empty(packing.size, np.float32))
