"""A decided placement put into the state: the published frame, the joint covariance, the map drawn again."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax.numpy as jnp
import numpy as np

from uwbslam_jax.estimator import State, anchored, frame_motion, published, state_vector
from uwbslam_jax.mapping import Tiles, redraw
from uwbslam_jax.numerics import between, carried_along, compose, numeric_jacobian
from uwbslam_jax.settings import Config, Params
from uwbslam_jax.startup.keyframe_buffer import Buffer
from uwbslam_jax.startup.placement import Placement


def _last_and_beacons(placement: Placement) -> tuple[np.ndarray, np.ndarray]:
    """Last keyframe's pose and the beacons as one vector, with their covariance."""
    last = placement.poses.size - 3
    return np.concatenate([placement.poses[-1], placement.beacons.ravel()]), placement.cov[last:, last:]


@dataclass(frozen=True)
class Adopted:
    """A start-up that was decided.

    Attributes:
      state: the estimator's state in the published frame.
      anchors: (N,) stamps of the keyframes [ns]; before, after: (N, 3) their poses in the start frame and in the
        published one. A pose of the start moves with the keyframes before and after it.
    """

    state: State
    anchors: np.ndarray
    before: np.ndarray
    after: np.ndarray

    def republish(self, stamps: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Poses (T, 3) of the start frame, taken at stamps (T,) [ns], in the published frame."""
        return carried_along(stamps, poses, self.anchors, self.before, self.after)

    @property
    def turn(self) -> float:
        """Of the published frame against the start frame [rad]."""
        return float(self.after[-1, 2] - self.before[-1, 2])


def adopt(
    config: Config,
    params: Params,
    state: State,
    tiles: Tiles,
    buffer: Buffer,
    placement: Placement,
    frame_slots: tuple[int, int],
) -> Adopted:
    """The state in the paper's frame (one beacon at the origin, another on +x), its covariance carried along.

    Args:
      state: of the LiDAR-only run in the start frame; tiles: what of its map lies outside the window.
      frame_slots: slots of the two beacons that make the frame.
    """
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
    grid = redraw(config, params, tiles, seen, y(x)[:2])
    adopted = state._replace(
        belief=belief,
        active=active,
        frame_slots=jnp.array(frame_slots, jnp.int32),
        scatter=state.scatter._replace(log=jnp.asarray(buffer.scatter(config.nodes), jnp.float32)),
        grid=grid,
        map_spread=state.map_spread._replace(epoch=jnp.ones(())),
        drawn_pose=jnp.asarray(y(x)[:3], jnp.float32),
    )
    return Adopted(adopted, np.array([key.frame.stamp for key in keys]), before, after)
