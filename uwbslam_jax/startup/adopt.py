"""A decided placement put into the state: the published frame, the joint covariance, the map drawn again."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
import numpy as np

from uwbslam_jax.estimator import HostView, Moved, State, anchored, frame_motion, published, state_vector
from uwbslam_jax.mapping import Tiles, redraw
from uwbslam_jax.numerics import between, compose, numeric_jacobian
from uwbslam_jax.startup.keyframe_buffer import Buffer
from uwbslam_jax.startup.placement import Placement


def _last_and_beacons(placement: Placement) -> tuple[np.ndarray, np.ndarray]:
    """Last keyframe's pose and the beacons as one vector, with their covariance."""
    last = placement.poses.size - 3
    return np.concatenate([placement.poses[-1], placement.beacons.ravel()]), placement.cov[last:, last:]


def adopt(
    view: HostView, buffer: Buffer, placement: Placement, frame_slots: tuple[int, int]
) -> tuple[State, Tiles, Moved]:
    """The state in the paper's frame (one beacon at the origin, another on +x), its covariance carried along; the map,
    drawn again; and how the keyframes have moved from the start frame into the published one.

    Args:
      view: of the LiDAR-only run in the start frame.
      frame_slots: slots of the two beacons that make the frame.
    """
    config, state, tiles = view.config, view.state, Tiles(view.tiles.resolution)
    keys = buffer.track()
    before = np.array([key.pose for key in keys])
    pose = np.asarray(state_vector.robot_pose(state.belief.mean), float)
    onward = between(before[-1], pose)
    x, cov = _last_and_beacons(placement)
    y = partial(published, slots=placement.slots, frame_slots=frame_slots, onward=onward)
    J = numeric_jacobian(y, x)
    cov = J @ cov @ J.T
    motion = frame_motion(placement.beacons, placement.slots, frame_slots)
    after = compose(motion, placement.poses)
    belief = anchored(state.belief, y(x), cov, placement.slots)
    active = jnp.zeros(config.nodes, bool).at[jnp.array([0, *placement.slots])].set(True)
    seen = [(pose, key.snapshot()) for pose, key in zip(after, keys, strict=True) if bool(key.frame.frame.has_scan)]
    grid = redraw(config, view.params, tiles, seen, y(x)[:2])
    adopted = state._replace(
        belief=belief,
        active=active,
        frame_slots=jnp.array(frame_slots, jnp.int32),
        scatter=state.scatter._replace(log=jnp.asarray(buffer.scatter(config.nodes), jnp.float32)),
        grid=grid,
        map_spread=state.map_spread._replace(epoch=jnp.ones(())),
        drawn_pose=jnp.asarray(y(x)[:3], jnp.float32),
    )
    return adopted, tiles, Moved(np.array([key.frame.stamp for key in keys]), before, after)
