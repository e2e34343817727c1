"""Start-up without prior knowledge (DESIGN 1.7): where the beacons stand in the frame the robot started in.

While the step runs on LiDAR (and odometry) alone, a `Buffer` keeps keyframes and what was ranged around them.
`solve` places the beacons for both reflections and says how much better one explains the ranges than the other.
`adopt` puts a decided placement into the state: the paper's frame, the joint covariance, the map drawn again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from uwbslam_jax import grid as occupancy
from uwbslam_jax import layout, slam
from uwbslam_jax.config import Config, Params
from uwbslam_jax.ekf import Gaussian
from uwbslam_jax.measurements import Ranges, Scan, StampedFrame
from uwbslam_jax.multilateration import DECIDED, SIGMA_ENOUGH_M
from uwbslam_jax.placement import Keyframe, Placement, Problem, largest_sigma, rotation
from uwbslam_jax.slam import Estimate, State
from uwbslam_jax.tiles import TILE

_KEYFRAME_MOVED = (0.25, 0.2)
"""A keyframe every so much of path or turn [m, rad]."""
_KEYFRAMES = 64
"""A longer start is thinned: every other keyframe goes."""
_MOVED_ENOUGH_M = 1.0
_HEADING_ENOUGH = 0.026
"""Start-up ends when the robot's heading among the beacons is known this well [rad]."""


class Buffer:
    """Keyframes and averaged ranges of the start, bounded in size."""

    def __init__(self, antenna: np.ndarray, height: np.ndarray, bias: np.ndarray, sigma_n: float):
        self.keyframes: list[Keyframe] = []
        self.pairs: dict[tuple[int, int], list[float]] = {}
        self.antenna, self.height, self.bias, self.sigma_n = antenna, height, bias, sigma_n

    @property
    def extent(self) -> float:
        """Largest distance from the first keyframe [m]."""
        if not self.keyframes:
            return 0.0
        return max(float(np.linalg.norm(k.pose[:2] - self.keyframes[0].pose[:2])) for k in self.keyframes)

    @property
    def newest(self) -> int:
        """Stamp of the newest keyframe [ns], 0 without any."""
        return self.keyframes[-1].frame.stamp if self.keyframes else 0

    def add(self, frame: StampedFrame, estimate: Estimate, usable: np.ndarray) -> None:
        """Take in one frame with the pose that LiDAR (and odometry) gave it, and which of its ranges may be used."""
        pose = np.asarray(estimate.pose, float)
        velocity, yaw_rate = np.asarray(estimate.velocity, float), float(estimate.yaw_rate)
        last = self.keyframes[-1].pose if self.keyframes else None
        if last is None or (
            bool(frame.frame.has_scan)
            and not estimate.poor
            and (np.hypot(*(pose - last)[:2]) > _KEYFRAME_MOVED[0] or abs(pose[2] - last[2]) > _KEYFRAME_MOVED[1])
        ):
            self.keyframes.append(Keyframe(frame, pose, np.asarray(estimate.information, float), velocity, yaw_rate))
            if len(self.keyframes) > _KEYFRAMES:
                self._thin()
        for k in np.flatnonzero(usable):
            self._add_range(frame.frame.ranges, int(k), pose, velocity, yaw_rate)

    def _add_range(self, r: Ranges, k: int, pose: np.ndarray, velocity: np.ndarray, yaw_rate: float) -> None:
        i, j = sorted((int(r.i[k]), int(r.j[k])))
        rise = self.height[i] - self.height[j]
        slant = float(r.range[k]) - self.bias[i] - self.bias[j]
        flat = float(np.sqrt(max(slant**2 - rise**2, 0.01)))
        if i > 0:
            kept = self.pairs.setdefault((i, j), [])
            kept.append(flat)
            del kept[:-400]
            return
        age = float(r.age[k])
        heading = pose[2] + yaw_rate * age
        antenna = pose[:2] + age * velocity + rotation(heading) @ self.antenna
        key = self.keyframes[-1]
        local = rotation(key.pose[2]).T @ (antenna - key.pose[:2])
        key.seen.setdefault(j, []).append((local, flat))

    def _thin(self) -> None:
        kept = [self.keyframes[0]]
        for k, key in enumerate(self.keyframes[1:], start=1):
            if k % 2 == 0 or key is self.keyframes[-1]:
                kept.append(key)
                continue
            into = kept[-1]
            move = rotation(into.pose[2]).T @ (key.pose[:2] - into.pose[:2])
            turn = rotation(key.pose[2] - into.pose[2])
            for slot, seen in key.seen.items():
                into.seen.setdefault(slot, []).extend((move + turn @ local, d) for local, d in seen)
        self.keyframes = kept


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
    """

    status: str
    hypotheses: int
    margin: float
    placement: Placement | None


def solve(buffer: Buffer, ids: dict[int, int]) -> Outcome:
    """Place the beacons if what is buffered determines them. ids: slot -> node id."""
    if buffer.extent < _MOVED_ENOUGH_M:
        return Outcome("waiting for motion", 0, 0.0, None)
    problem = Problem.build(buffer.keyframes, buffer.pairs, buffer.sigma_n)
    if len(problem.slots) < 2:
        return Outcome("placing beacons", 0, 0.0, None)
    first, second = problem.starts()
    found = sorted((problem.minimise(first), problem.minimise(second)), key=lambda p: p.cost)
    best, margin = found[0], _margin(*found)
    # the second start may have slid into the first one's valley: ask the exact mirror image as well
    mirrored = problem.minimise(problem.mirror(best))
    if mirrored.cost < best.cost:
        best, mirrored = mirrored, best
    margin = min(margin, _margin(best, mirrored))
    if margin < DECIDED:
        return Outcome("reflection undecided", 2, margin, None)
    sure = _keep_certain(problem.keep_unique(best), ids)
    if sure is None:
        return Outcome("placing beacons", 1, margin, None)
    return Outcome("decided", 1, margin, sure)


def _keep_certain(placement: Placement, ids: dict[int, int]) -> Placement | None:
    """The beacons whose place in the published frame is certain, None where the robot's own is not.

    The start frame is no measure: all beacons turn together with the heading that the track started with.
    """
    if len(placement.slots) < 2:
        return None
    frame_slots = choose_frame(placement, ids)
    onward = np.zeros(3)
    x, cov = _last_and_beacons(placement)
    J = _numeric_jacobian(partial(_published, slots=placement.slots, frame_slots=frame_slots, onward=onward), x)
    cov = J @ cov @ J.T
    if np.sqrt(cov[2, 2]) > _HEADING_ENOUGH or largest_sigma(cov[:2, :2])[0] > SIGMA_ENOUGH_M:
        return None
    certain = largest_sigma(cov[3:, 3:]) < SIGMA_ENOUGH_M
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


def _margin(best: Placement, other: Placement) -> float:
    """How much better the one explains the ranges than the other; infinite where they are the same place."""
    same = np.linalg.norm(best.beacons - other.beacons, axis=1).max() < 0.3
    return float("inf") if same else other.cost - best.cost


@dataclass(frozen=True)
class Adopted:
    """A start-up that was decided.

    Attributes:
      state: the estimator's state in the published frame.
      anchors: (N,) stamps of the keyframes [ns]; before, after: (N, 3) their poses in the start frame and in the
        published one. A pose of the start moves with the last keyframe before it.
    """

    state: State
    anchors: np.ndarray
    before: np.ndarray
    after: np.ndarray

    def republish(self, stamps: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Poses (T, 3) of the start frame, taken at stamps (T,), in the published frame."""
        at = np.clip(np.searchsorted(self.anchors, stamps, side="right") - 1, 0, len(self.anchors) - 1)
        return compose(self.after[at], between(self.before[at], poses))


def adopt(
    config: Config,
    params: Params,
    state: State,
    buffer: Buffer,
    placement: Placement,
    frame_slots: tuple[int, int],
) -> Adopted:
    """The state in the paper's frame (one beacon at the origin, another on +x), its covariance carried along.

    Args:
      state: of the LiDAR-only run in the start frame.
      frame_slots: slots of the two beacons that make the frame.
    """
    before = np.array([key.pose for key in buffer.keyframes])
    pose = np.asarray(layout.robot_pose(state.belief.mean), float)
    onward = between(before[-1], pose)
    x, cov = _last_and_beacons(placement)
    y = partial(_published, slots=placement.slots, frame_slots=frame_slots, onward=onward)
    J = _numeric_jacobian(y, x)
    cov = J @ cov @ J.T
    motion = _frame_motion(placement.beacons, placement.slots, frame_slots)
    after = compose(motion, placement.poses)
    belief = _belief(state.belief, config.nodes, y(x), cov, placement.slots, pose)
    active = jnp.zeros(config.nodes, bool).at[jnp.array([0, *placement.slots])].set(True)
    grid = _redraw(config, params, buffer.keyframes, after, y(x)[:2])
    adopted = state._replace(
        belief=belief,
        active=active,
        frame_slots=jnp.array(frame_slots, jnp.int32),
        grid=grid,
        drawn_pose=jnp.asarray(y(x)[:3], jnp.float32),
    )
    return Adopted(adopted, np.array([key.frame.stamp for key in buffer.keyframes]), before, after)


def _frame_motion(beacons: np.ndarray, slots: list[int], frame_slots: tuple[int, int]) -> np.ndarray:
    origin, along = (beacons[slots.index(s)] for s in frame_slots)
    theta = -np.arctan2(along[1] - origin[1], along[0] - origin[0])
    return np.append(-rotation(theta) @ origin, theta)


def _published(x: np.ndarray, *, slots, frame_slots, onward) -> np.ndarray:
    """Robot pose now and beacons in the published frame, from the last keyframe and beacons in the start frame."""
    beacons = x[3:].reshape(-1, 2)
    motion = _frame_motion(beacons, slots, frame_slots)
    robot = compose(motion, compose(x[:3], onward))
    return np.concatenate([robot, (beacons @ rotation(motion[2]).T + motion[:2]).ravel()])


def _numeric_jacobian(function, x: np.ndarray) -> np.ndarray:
    h = 1e-6
    columns = [(function(x + h * e) - function(x - h * e)) / (2 * h) for e in np.eye(len(x))]
    return np.stack(columns, axis=1)


def _belief(
    belief: Gaussian, nodes: int, values: np.ndarray, cov: np.ndarray, slots: list[int], old_pose: np.ndarray
) -> Gaussian:
    """State vector and covariance from robot pose and beacons; velocities turn with the frame.

    The map is drawn at the estimated poses, so its error is that of the pose with the other sign: a match then
    reports what the track already says, and only the ranges can tell the two apart.
    """
    mean, P = np.array(belief.mean, float), np.array(belief.cov, float)
    pose, error = np.array(layout.pose_indices(nodes)), np.array(layout.map_error_indices(nodes))
    velocity, beacon_velocities = np.arange(2 * nodes, 2 * nodes + 2), np.arange(2 * nodes + 2, 4 * nodes)
    placed = np.concatenate([[2 * s, 2 * s + 1] for s in slots])
    R = rotation(values[2] - old_pose[2])
    mean[velocity] = R @ mean[velocity]
    moving = np.append(velocity, 4 * nodes + 1)
    motion_cov = P[np.ix_(moving, moving)]
    motion_cov[:2] = R @ motion_cov[:2]
    motion_cov[:, :2] = motion_cov[:, :2] @ R.T
    P = np.eye(len(mean))
    P[beacon_velocities, beacon_velocities] = 1e-8
    P[np.ix_(moving, moving)] = motion_cov
    known = np.concatenate([pose, placed])
    P[np.ix_(known, known)] = cov
    P[np.ix_(error, known)] = -cov[:3]
    P[np.ix_(known, error)] = -cov[:, :3]
    P[np.ix_(error, error)] = cov[:3, :3]
    mean[pose], mean[placed], mean[error] = values[:3], values[3:], 0.0
    return Gaussian(jnp.asarray(mean, jnp.float32), jnp.asarray(P, jnp.float32))


def _redraw(config: Config, params: Params, keys: list[Keyframe], poses: np.ndarray, middle: np.ndarray):
    """A fresh window over the robot with every keyframe's scan drawn at its pose."""
    grid = occupancy.empty(config.cells, config.levels, config.resolution)
    side = TILE * config.resolution
    corner = np.round((middle - config.cells * config.resolution / 2) / side) * side
    grid = grid._replace(origin=jnp.asarray(corner, jnp.float32))
    for key, pose in zip(keys, poses, strict=True):
        if bool(key.frame.frame.has_scan):
            drift = jnp.asarray(rotation(-key.pose[2]) @ key.velocity, jnp.float32)
            grid = _draw_one(
                config,
                params,
                grid,
                jnp.asarray(pose, jnp.float32),
                key.frame.frame.scan,
                drift,
                np.float32(key.yaw_rate),
            )
    return grid


@partial(jax.jit, static_argnums=0)
def _draw_one(config: Config, params: Params, grid: occupancy.Grid, pose, scan: Scan, drift, yaw_rate):
    sweep = slam.undo_motion(scan, params.lidar, drift, yaw_rate)
    return occupancy.integrate(grid, pose, sweep, config.resolution)


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
