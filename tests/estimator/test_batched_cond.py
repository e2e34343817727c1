"""What a step does seldom: the same as a condition, for one run and for many, and done for nobody else."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from uwbslam_jax.estimator.batched_cond import seldom

WANTED = np.array([False, True, False, True, False])
OLD = np.arange(5, dtype=np.float32)


def sum_of(old, factor):
    return old + factor * jnp.arange(3.0).sum()


def test_one_run():
    np.testing.assert_array_equal(jax.jit(lambda w: seldom(w, sum_of, 1.0, 2.0))(True), 7.0)
    np.testing.assert_array_equal(jax.jit(lambda w: seldom(w, sum_of, 1.0, 2.0))(False), 1.0)


@pytest.mark.parametrize("per_run", [False, True])
def test_many_runs_are_each_as_by_themselves(per_run):
    factor = np.linspace(1.0, 2.0, 5, dtype=np.float32) if per_run else np.float32(2.0)
    many = jax.jit(jax.vmap(lambda w, old, f: seldom(w, sum_of, old, f), in_axes=(0, 0, 0 if per_run else None)))
    np.testing.assert_allclose(many(WANTED, OLD, factor), np.where(WANTED, OLD + 3.0 * factor, OLD))


def test_what_all_runs_share_becomes_their_own():
    told = jax.vmap(lambda w: seldom(w, lambda old, f: (old[0] + f, old[1]), (jnp.float32(1.0), jnp.zeros(2)), 5.0))(
        WANTED
    )
    np.testing.assert_array_equal(told[0], np.where(WANTED, 6.0, 1.0))
    assert told[1].shape == (5, 2)


@pytest.mark.parametrize("count", [1, 5])
def test_it_is_done_only_for_those_that_want_it(count):
    done: list[float] = []

    def told(old):
        jax.debug.callback(lambda x: done.append(float(x)), old)
        return old

    run = jax.jit(jax.vmap(lambda w, old: seldom(w, told, old)))
    jax.block_until_ready(run(np.zeros(count, bool), OLD[:count]))
    jax.effects_barrier()
    assert not done
    jax.block_until_ready(run(WANTED[:count], OLD[:count]))
    jax.effects_barrier()
    assert sorted(done) == [k for k in range(count) if WANTED[k]]


def test_it_is_held_in_a_derivative():
    def through(x, wanted):
        return x**2 * seldom(wanted, lambda old, y: old * y, x, x)

    for wanted, held in ((True, 9.0), (False, 3.0)):
        assert jax.grad(through)(3.0, jnp.bool_(wanted)) == pytest.approx(2 * 3.0 * held)
    slopes = jax.vmap(jax.grad(through), in_axes=(0, 0))(jnp.array([3.0, 3.0]), jnp.array([True, False]))
    np.testing.assert_allclose(slopes, [54.0, 18.0])
    total = jax.grad(lambda x: jnp.sum(jax.vmap(through)(x, jnp.array([True, False]))))(jnp.array([3.0, 3.0]))
    np.testing.assert_allclose(total, [54.0, 18.0])
