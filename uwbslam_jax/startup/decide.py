"""Start-up without prior knowledge (DESIGN 1.7): where the beacons stand in the frame the robot started in.

While the step runs on LiDAR (and odometry) alone, a `Buffer` keeps keyframes and what was ranged around them.
`solve` places the beacons in every way that may explain the ranges and says how much better the best one does.
`adopt` puts a decided placement into the state: the paper's frame, the joint covariance, the map drawn again.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import partial

import jax.numpy as jnp
import numpy as np

from uwbslam_jax.estimator import state_vector
from uwbslam_jax.settings import Config, Params
from uwbslam_jax.numerics.gaussian import Gaussian
from uwbslam_jax.startup.hypotheses import explanations
from uwbslam_jax.startup.keyframe_buffer import Buffer
from uwbslam_jax.measurements import Ranges
from uwbslam_jax.numerics.multilateration import DECIDED, SIGMA_ENOUGH_M
from uwbslam_jax.startup.placement import CALIBRATED_M, Placement, Problem, largest_sigma, rotation
from uwbslam_jax.mapping.redraw import redraw
from uwbslam_jax.estimator.step import State
from uwbslam_jax.mapping.tiled_map import Tiles

_MOVED_ENOUGH_M = 1.0
_BIAS_M = 0.3
"""Prior spread of a node's range bias once ranges do not look calibrated [m]."""
_HEADING_ENOUGH = 0.026
"""Start-up ends when the robot's heading among the beacons is known this well [rad]."""
_UNDRAWN_HEADING = 0.15
_UNDRAWN_SIGMA = 0.05
"""The same without a map [rad], and for positions as a share of the distance between beacons."""
_UNDRAWN_WAIT_S = 60.0
"""Without a map so long is waited for beacons that are not yet certain: placed together they are placed best."""


def usable(ranges: Ranges, nlos_gap_db: float) -> np.ndarray:
    """(M,) which ranges of a frame start-up may use: measured, and not NLOS by their powers."""
    return np.asarray(ranges.valid) & ~(np.asarray(ranges.power_gap) > nlos_gap_db)


@dataclass(frozen=True)
class Outcome:
    """What start-up knows now.

    Attributes:
      status: "waiting for motion", "placing beacons", "reflection undecided" or "decided".
      hypotheses: how many explanations are alive (0 before there is one).
      margin: difference of log-likelihood between the two reflections.
      placement: the decided one, else None.
      biased: whether the ranges are explained far better with a bias of each node; a placement
        then has them.
    """

    status: str
    hypotheses: int
    margin: float
    placement: Placement | None
    biased: bool = False


def solve(buffer: Buffer, ids: dict[int, int]) -> Outcome:
    """Place the beacons if what is buffered determines them. ids: slot -> node id."""
    if buffer.extent < _MOVED_ENOUGH_M and not any(key.blind for key in buffer.keyframes[1:]):
        return Outcome("waiting for motion", 0, 0.0, None)
    problem = Problem.build(buffer)
    if len(problem.slots) < 2:
        return Outcome("placing beacons", 0, 0.0, None)
    found, bias_sigma = _explain(problem)
    best, biased = found[0], bias_sigma > CALIBRATED_M
    margin = found[1].cost - best.cost if len(found) > 1 else float("inf")
    if margin < DECIDED:
        alive = sum(other.cost - best.cost < DECIDED for other in found)
        return Outcome("reflection undecided", alive, margin, None, biased)
    drawn = any(key.information.any() for key in buffer.keyframes)
    sure = _keep_certain(problem.keep_unique(best, bias_sigma), ids, drawn=drawn)
    waits = not drawn and buffer.newest - buffer.keyframes[0].frame.stamp < _UNDRAWN_WAIT_S * 1e9
    if sure is None or (waits and len(sure.slots) < len(problem.slots)):
        return Outcome("placing beacons", 1, margin, None, biased)
    return Outcome("decided", 1, margin, sure, biased)


def _explain(problem: Problem) -> tuple[list[Placement], float]:
    """Explanations, the best first, with ranges taken as calibrated, or with a bias of each node where that explains
    them far better; and the spread of the biases that was allowed [m]."""
    found = explanations(problem, CALIBRATED_M)
    freed = problem.minimise(found[0].beacons, found[0].poses, _BIAS_M)
    if found[0].cost - freed.cost < DECIDED + 3.0 * len(freed.bias):
        return found, CALIBRATED_M
    return explanations(problem, _BIAS_M), _BIAS_M


def _keep_certain(placement: Placement, ids: dict[int, int], *, drawn: bool) -> Placement | None:
    """The beacons whose place in the published frame is certain, None where the robot's own is not.

    The start frame is no measure: all beacons turn together with the heading that the track started with. Where no map
    is drawn, nothing is lost by a frame that is known less well: the filter only has to be near enough to be linear.
    """
    if len(placement.slots) < 2:
        return None
    frame_slots = choose_frame(placement, ids)
    sigma_enough, heading_enough = SIGMA_ENOUGH_M, _HEADING_ENOUGH
    if not drawn:
        span = float(np.max(np.linalg.norm(placement.beacons - placement.beacons[0], axis=1)))
        sigma_enough, heading_enough = max(sigma_enough, _UNDRAWN_SIGMA * span), _UNDRAWN_HEADING
    onward = np.zeros(3)
    x, cov = _last_and_beacons(placement)
    J = numeric_jacobian(partial(published, slots=placement.slots, frame_slots=frame_slots, onward=onward), x)
    cov = J @ cov @ J.T
    if np.sqrt(cov[2, 2]) > heading_enough or largest_sigma(cov[:2, :2])[0] > sigma_enough:
        return None
    certain = largest_sigma(cov[3:, 3:]) < sigma_enough
    return placement.only([b for b, ok in enumerate(certain) if ok]) if sum(certain) >= 2 else None


def choose_frame(placement: Placement, ids: dict[int, int]) -> tuple[int, int]:
    """Slots of the beacons at the origin and on +x: the lowest id, and the one farthest from it, which fixes the
    direction best. ids: slot -> node id."""
    origin = min(placement.slots, key=lambda slot: ids[slot])
    away = np.linalg.norm(placement.beacons - placement.beacons[placement.slots.index(origin)], axis=1)
    return origin, placement.slots[int(np.argmax(away))]


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


def carried_along(
    stamps: np.ndarray, poses: np.ndarray, anchors: np.ndarray, before: np.ndarray, after: np.ndarray
) -> np.ndarray:
    """Poses (T, 3) taken at stamps (T,) [ns] of a track whose keyframes, at anchors (N,) [ns], have moved from before
    (N, 3) to after (N, 3): each with the keyframes before and after it."""
    last = len(anchors) - 1
    at = np.clip(np.searchsorted(anchors, stamps, side="right") - 1, 0, last)
    next_one = np.minimum(at + 1, last)
    span = np.maximum(anchors[next_one] - anchors[at], 1)
    share = np.clip((stamps - anchors[at]) / span, 0.0, 1.0)[:, None]
    ends = [compose(after[k], between(before[k], poses)) for k in (at, next_one)]
    return (1 - share) * ends[0] + share * ends[1]


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
    belief = anchored(state.belief, config.nodes, y(x), cov, placement.slots, pose)
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


def frame_motion(beacons: np.ndarray, slots: Sequence[Hashable], frame_slots: Sequence[Hashable]) -> np.ndarray:
    """(3,) the rigid motion that puts one of the beacons (B, 2) at the origin and another on +x."""
    origin, along = (beacons[slots.index(s)] for s in frame_slots)
    theta = -np.arctan2(along[1] - origin[1], along[0] - origin[0])
    return np.append(-rotation(theta) @ origin, theta)


def published(x: np.ndarray, *, slots, frame_slots, onward) -> np.ndarray:
    """Robot pose now and beacons in the published frame, from the last keyframe and beacons in the start frame."""
    beacons = x[3:].reshape(-1, 2)
    motion = frame_motion(beacons, slots, frame_slots)
    robot = compose(motion, compose(x[:3], onward))
    return np.concatenate([robot, (beacons @ rotation(motion[2]).T + motion[:2]).ravel()])


def numeric_jacobian(function, x: np.ndarray) -> np.ndarray:
    h = 1e-6
    columns = [(function(x + h * e) - function(x - h * e)) / (2 * h) for e in np.eye(len(x))]
    return np.stack(columns, axis=1)


def anchored(
    belief: Gaussian,
    nodes: int,
    values: np.ndarray,
    cov: np.ndarray,
    slots: list[int],
    old_pose: np.ndarray,
    apart: Sequence[int] = (),
) -> Gaussian:
    """State vector and covariance from robot pose and beacons (3 + 2 B,); velocities turn with the frame.

    The map is drawn at the estimated poses, so its error is that of the pose with the other sign: a match then
    reports what the track already says, and only the ranges can tell the two apart.

    Args:
      slots: of the beacons; old_pose: (3,) of the robot in the belief. apart: slots that are to stay as they are.
    """
    mean, P = np.array(belief.mean, float), np.array(belief.cov, float)
    pose, error = np.array(state_vector.pose_indices(nodes)), np.array(state_vector.map_error_indices(nodes))
    velocity, beacon_velocities = np.arange(2 * nodes, 2 * nodes + 2), np.arange(2 * nodes + 2, 4 * nodes)
    placed = np.concatenate([[2 * s, 2 * s + 1] for s in slots])
    R = rotation(values[2] - old_pose[2])
    mean[velocity] = R @ mean[velocity]
    moving = np.append(velocity, 4 * nodes + 1)
    motion_cov = P[np.ix_(moving, moving)]
    motion_cov[:2] = R @ motion_cov[:2]
    motion_cov[:, :2] = motion_cov[:, :2] @ R.T
    own = P
    P = np.eye(len(mean))
    P[beacon_velocities, beacon_velocities] = 1e-8
    P[np.ix_(moving, moving)] = motion_cov
    for slot in apart:  # what is not among the beacons keeps what is known of it by itself
        rows = np.array([2 * slot, 2 * slot + 1, 2 * (nodes + slot), 2 * (nodes + slot) + 1])
        P[np.ix_(rows, rows)] = own[np.ix_(rows, rows)]
    known = np.concatenate([pose, placed])
    P[np.ix_(known, known)] = cov
    P[np.ix_(error, known)] = -cov[:3]
    P[np.ix_(known, error)] = -cov[:, :3]
    P[np.ix_(error, error)] = cov[:3, :3]
    mean[pose], mean[placed], mean[error] = values[:3], values[3:], 0.0
    return Gaussian(jnp.asarray(mean, jnp.float32), jnp.asarray(P, jnp.float32))


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Host version of geometry.compose for (..., 3) poses in float64; headings are not wrapped."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack([x, y, a[..., 2] + b[..., 2]], axis=-1)


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Host version of geometry.between for (..., 3) poses in float64; headings are not wrapped."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return np.stack([c * dx + s * dy, -s * dx + c * dy, b[..., 2] - a[..., 2]], axis=-1)
