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

_BY_MAP = slice(3, 6)
"""Where the robot as its last scan has it stands behind the robot's own pose."""


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
    # the robot, and where the map has it: by its last scan and what was driven since
    last, drawn = placement.poses[-1], placement.poses[placement.drawn]
    since = compose(between(drawn, last), onward)
    columns = placement.columns(len(keys) - 1, placement.drawn)
    cov = placement.cov[np.ix_(columns, columns)]
    frame = partial(published, slots=placement.slots, frame_slots=frame_slots)

    def both(x: np.ndarray) -> np.ndarray:
        robot, by_map = frame(np.delete(x, _BY_MAP), onward=onward), frame(x[3:], onward=since)
        return np.concatenate([robot[:3], by_map])

    x = np.concatenate([last, drawn, placement.beacons.ravel()])
    J = numeric_jacobian(both, x)
    cov, values = J @ cov @ J.T, both(x)
    error_cov = np.column_stack([-np.delete(cov[_BY_MAP], _BY_MAP, axis=1), cov[_BY_MAP, _BY_MAP]])
    values, cov = np.delete(values, _BY_MAP), np.delete(np.delete(cov, _BY_MAP, axis=0), _BY_MAP, axis=1)
    motion = frame_motion(placement.beacons, placement.slots, frame_slots)
    after = compose(motion, placement.poses)
    belief = anchored(state.belief, values, cov, placement.slots, error_cov=error_cov)
    active = jnp.zeros(config.nodes, bool).at[jnp.array([0, *placement.slots])].set(True)
    scans = [key.matched and bool(key.frame.frame.has_scan) for key in keys]
    seen = [(pose, key.snapshot()) for pose, key, scan in zip(after, keys, scans, strict=True) if scan]
    grid = redraw(config, view.params, tiles, seen, values[:2])
    adopted = state._replace(
        belief=belief,
        active=active,
        frame_slots=jnp.array(frame_slots, jnp.int32),
        scatter=state.scatter._replace(log=jnp.asarray(buffer.scatter(config.nodes), jnp.float32)),
        grid=grid,
        map_spread=state.map_spread._replace(epoch=jnp.ones(())),
        drawn_pose=jnp.asarray(values[:3], jnp.float32),
    )
    return adopted, tiles, Moved(np.array([key.frame.stamp for key in keys]), before, after)
