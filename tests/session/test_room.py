"""Room for more beacons than a run began with: the state keeps what it knows, and batch and online stay alike."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

import uwbslam_jax as us
from uwbslam_jax.estimator import init, make_config, state_vector, widened
from uwbslam_jax.measurements import Message, RangeMessage
from uwbslam_jax.numerics import Gaussian
from uwbslam_jax.settings import MapSettings, Settings, UwbSettings, with_room


def sized(beacons: int) -> Settings:
    return Settings(uwb=UwbSettings(max_beacons=beacons), map=MapSettings(size_m=12.8))


def test_room_is_doubled_to_an_end():
    assert [with_room(sized(3), beacons).uwb.max_beacons for beacons in (2, 3, 4, 7, 500)] == [3, 3, 6, 12, 200]


def test_what_is_known_keeps_its_place():
    small, large = (make_config(sized(beacons)) for beacons in (2, 5))
    state = init(small)
    n = state_vector.state_size(small.nodes)
    belief = Gaussian(jnp.arange(n, dtype=jnp.float32), jnp.arange(n * n, dtype=jnp.float32).reshape(n, n))
    scatter = state.scatter._replace(log=jnp.ones_like(state.scatter.log))
    wide = widened(state._replace(belief=belief, active=jnp.ones(3, bool), scatter=scatter), large)
    before, after = (state_vector.unpack(b.mean) for b in (belief, wide.belief))
    for name in ("positions", "velocities"):
        np.testing.assert_array_equal(getattr(after, name)[:3], getattr(before, name))
    for name in ("heading", "yaw_rate", "map_error"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    at, were = (list(state_vector.pose_indices(config.nodes)) for config in (large, small))
    np.testing.assert_array_equal(wide.belief.cov[np.ix_(at, at)], belief.cov[np.ix_(were, were)])
    assert np.asarray(wide.active).tolist() == [True] * 3 + [False] * 3
    assert float(wide.scatter.log.sum()) == 9.0


@pytest.mark.slow
def test_beacons_that_join_a_full_run_are_placed_in_batch_and_online_alike():
    made = us.simulate("hall", duration=30.0)
    messages: list[Message] = list(made)
    late = set(sorted({n for m in messages if isinstance(m, RangeMessage) for n in (m.source, m.target)})[-2:])
    start = messages[0].stamp
    heard = [
        m
        for m in messages
        if not (isinstance(m, RangeMessage) and m.stamp < start + 15e9 and late & {m.source, m.target})
    ]
    batch, online = (us.run(heard, Settings(uwb=UwbSettings(max_beacons=3)), online=online) for online in (False, True))
    assert late <= {beacon.id for beacon in batch.beacons}
    assert batch.errors()["robot_rmse_m"] < 0.02
    assert any("--uwb.max-beacons 6" in warning for warning in batch.summary["warnings"])
    np.testing.assert_array_equal(batch.online, online.online)
