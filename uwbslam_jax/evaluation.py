"""How good an estimate is against the truth: ATE, heading and beacon errors, NEES. Host arrays only.

An estimate is in a frame of its own, so it is laid over the truth by a rigid motion first. Never by a reflection: a
mirrored answer is a wrong answer.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from uwbslam_jax.measurements import NAN, TruthMessage
from uwbslam_jax.numerics import Column, rigid_fit as fit_pose, rotation_matrix, wrapped
from uwbslam_jax.result import Result

FIT_POSES, BEACON_WEIGHT = 400, 20.0
"""The joint fit takes about 400 poses, evenly, and a beacon as 20 of them [poses]: five weigh a quarter of it."""
TRUTH = np.dtype([("stamp", np.int64), ("node", np.int64), ("pose", np.float64, 3)])
"""A message of the ground truth: stamp [ns], node's id or ROBOT, pose [m, m, rad]; a run of hours has very many."""
ROBOT = -1
"""Stands for the robot among node ids [id], which are not negative."""


def truth_row(message: TruthMessage) -> tuple[int, int, tuple[float, float, float]]:
    """A row of TRUTH."""
    node = ROBOT if message.node is None else message.node
    return message.stamp, node, (message.x, message.y, message.yaw)


@dataclass(frozen=True, slots=True)
class Truth:
    """Where the robot and the beacons really were, in any one frame.

    Attributes:
      stamps: (T,) int64, increasing [ns].
      robot: (T, 3) x, y, yaw [m, m, rad].
      beacons: id -> (n, 3) of t, x, y [ns, m, m], in order of time; float64, so an epoch's t is good to 256 ns.
    """

    stamps: Int[np.ndarray, "T"]
    robot: Float[np.ndarray, "T 3"]
    beacons: dict[int, Float[np.ndarray, "_ 3"]]

    @classmethod
    def from_messages(cls, messages: Iterable[TruthMessage]) -> Truth:
        """Truth from the messages of a recording, in any order.

        Raises:
          ValueError: no message about the robot.
        """
        rows = Column(dtype=TRUTH)
        for message in messages:
            rows.append(truth_row(message))
        return cls.from_rows(rows.values)

    @classmethod
    def from_rows(cls, rows: np.ndarray) -> Truth:
        """Truth from rows of TRUTH, in any order.

        Raises:
          ValueError: no row about the robot.
        """
        rows = rows[np.argsort(rows["stamp"], kind="stable")]
        robot, others = rows[rows["node"] == ROBOT], rows[rows["node"] != ROBOT]
        if not len(robot):
            raise ValueError("the ground truth holds no pose of the robot")
        beacons = {node: others[others["node"] == node] for node in np.unique(others["node"]).tolist()}
        return cls(
            stamps=robot["stamp"].copy(),
            robot=robot["pose"].copy(),
            beacons={node: np.column_stack([own["stamp"], own["pose"][:, :2]]) for node, own in beacons.items()},
        )

    @classmethod
    def load(cls, path: Path | str) -> Truth:
        """Truth from an .npz file: t (T,) [s], robot (T, 3), ids (N,), beacons (T, N, 2); alive (T, N) is not needed.

        Raises:
          OSError: the file cannot be read.
          ValueError: an array is missing or of the wrong shape.
        """
        with np.load(path) as arrays:
            missing = {"t", "robot", "ids", "beacons"} - set(arrays)
            if missing:
                raise ValueError(f"{path}: no array named {', '.join(sorted(missing))}")
            t, robot, ids, positions = (arrays[name] for name in ("t", "robot", "ids", "beacons"))
        if t.ndim != 1 or not t.size or robot.shape != (t.size, 3) or positions.shape != (t.size, ids.size, 2):
            raise ValueError(f"{path}: t {t.shape}, robot {robot.shape}, beacons {positions.shape} do not fit together")
        stamps = np.round(t * 1e9).astype(np.int64)
        histories = {
            int(node): _changes(np.column_stack([stamps.astype(float), positions[:, column]]))
            for column, node in enumerate(ids)
        }
        return cls(stamps, robot.astype(float), {node: rows for node, rows in histories.items() if len(rows)})

    def poses_at(self, stamps: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n 3"]:
        """The robot's poses at the given times [ns], linear in between, held at both ends [m, m, rad unwrapped]."""
        start = self.stamps[0]
        seconds, known = (stamps - start) / 1e9, (self.stamps - start) / 1e9
        columns = [self.robot[:, 0], self.robot[:, 1], np.unwrap(self.robot[:, 2])]
        return np.column_stack([np.interp(seconds, known, column) for column in columns])

    def beacon_positions(self) -> dict[int, Float[np.ndarray, "2"]]:
        """Last known position of every beacon [m]."""
        return {node: history[-1, 1:] for node, history in self.beacons.items()}


def _changes(history: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """The rows of t, x, y with a known position that differs from that before."""
    history = history[np.isfinite(history[:, 1:]).all(axis=1)]
    moved = np.any(np.diff(history[:, 1:], axis=0) != 0, axis=1)
    return history[np.concatenate([np.ones(min(len(history), 1), bool), moved])]


class RigidMotion(NamedTuple):
    """x -> rotation @ x + translation, without reflection [m]."""

    rotation: Float[np.ndarray, "2 2"]
    translation: Float[np.ndarray, "2"]

    @property
    def angle(self) -> float:
        """Angle of the rotation, counter-clockwise [rad]."""
        return float(np.arctan2(self.rotation[1, 0], self.rotation[0, 0]))

    def points(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Points moved [m]."""
        return points @ self.rotation.T + self.translation

    def poses(self, poses: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Poses moved [m, m, rad]."""
        return np.column_stack([self.points(poses[:, :2]), poses[:, 2] + self.angle])

    def covs(self, covs: Float[np.ndarray, "n d d"]) -> Float[np.ndarray, "n d d"]:
        """Covariances of points (d = 2) or poses (d = 3) moved."""
        turn = np.eye(covs.shape[-1])
        turn[:2, :2] = self.rotation
        return turn @ covs @ turn.T


def rigid_fit(
    points: Float[np.ndarray, "n 2"], onto: Float[np.ndarray, "n 2"], weights: Float[np.ndarray, "n"] | None = None
) -> RigidMotion:
    """The rotation and translation with the least weighted sum of |R points + t - onto|^2 (Kabsch; Umeyama 1991).

    The determinant of R is +1 whatever the points, see `numerics.rigid_fit`.
    """
    pose = fit_pose(points, onto, weights)
    return RigidMotion(rotation_matrix(pose[2]), pose[:2])


def align(
    stamps: Int[np.ndarray, "n"],
    poses: Float[np.ndarray, "n 3"],
    beacons: Mapping[int, Float[np.ndarray, "2"]],
    truth: Truth,
) -> RigidMotion:
    """The one rigid motion that lays robot and beacons together over the truth.

    Args:
      stamps, poses: the estimated track [ns; m, m, rad], all finite, at least one pose or beacon.
      beacons: id -> estimated position [m]; ids that the truth does not know are left out.
    """
    true_beacons = truth.beacon_positions()
    common = [node for node in true_beacons if node in beacons]
    pick = slice(None, None, max(1, len(poses) // FIT_POSES))
    estimated = [poses[pick, :2], *(beacons[node][None] for node in common)]
    true = [truth.poses_at(stamps[pick])[:, :2], *(true_beacons[node][None] for node in common)]
    weights = np.concatenate([np.ones(len(estimated[0])), np.full(len(common), BEACON_WEIGHT)])
    return rigid_fit(np.concatenate(estimated), np.concatenate(true), weights)


def evaluate(
    stamps: Int[np.ndarray, "n"],
    poses: Float[np.ndarray, "n 3"],
    beacons: Mapping[int, Float[np.ndarray, "2"]],
    truth: Truth,
) -> dict[str, Any]:
    """Errors of a run after one rigid motion over robot and beacons together (robot_ate_m: over the robot alone).

    Args:
      stamps, poses: the estimated track [ns; m, m, rad]; poses that are not finite are left out.
      beacons: id -> estimated position [m].

    Returns:
      robot_rmse_m, robot_max_m, robot_ate_m, heading_deg_median, heading_deg_p95, beacon_mean_m, beacon_max_m; covered:
      time from first to last pose over that of the truth; beacons_missing: ids in the truth without an estimate. NaN
      where there is nothing to compare. Poses before or after the truth are compared with its nearest end.
    """
    known = np.isfinite(poses).all(axis=1)
    stamps, poses = stamps[known], poses[known].astype(float)
    true_beacons = truth.beacon_positions()
    placed = {node: beacons[node] for node in true_beacons if node in beacons and np.isfinite(beacons[node]).all()}
    figures: dict[str, Any] = dict.fromkeys(
        ("robot_rmse_m", "robot_ate_m", "robot_max_m", "heading_deg_median", "heading_deg_p95"), NAN
    )
    figures |= {"beacon_mean_m": NAN, "beacon_max_m": NAN, "covered": 0.0}
    figures["beacons_missing"] = [node for node in true_beacons if node not in placed]
    if not len(poses):
        return figures
    motion = align(stamps, poses, placed, truth)
    true, moved = truth.poses_at(stamps), motion.poses(poses)
    off = np.linalg.norm(moved[:, :2] - true[:, :2], axis=1)
    turned = np.rad2deg(np.abs(wrapped(moved[:, 2] - true[:, 2])))
    figures |= {
        "robot_rmse_m": float(np.sqrt(np.mean(off**2))),
        "robot_ate_m": absolute_trajectory_error(poses[:, :2], true[:, :2]),
        "robot_max_m": float(off.max()),
        "heading_deg_median": float(np.median(turned)),
        "heading_deg_p95": float(np.percentile(turned, 95)),
    }
    if placed:
        errors = [np.linalg.norm(motion.points(xy[None])[0] - true_beacons[node]) for node, xy in placed.items()]
        figures |= {"beacon_mean_m": float(np.mean(errors)), "beacon_max_m": float(np.max(errors))}
    span = truth.stamps[-1] - truth.stamps[0]
    figures["covered"] = float((stamps[-1] - stamps[0]) / span) if span > 0 else NAN
    return figures


def absolute_trajectory_error(estimated: Float[np.ndarray, "n 2"], true: Float[np.ndarray, "n 2"]) -> float:
    """ATE: root mean square distance after the best rigid motion of the track alone [m]."""
    off = rigid_fit(estimated, true).points(estimated) - true
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


class Nees(NamedTuple):
    """Normalised estimation error squared e^T P^-1 e over several estimates.

    Attributes:
      mean: its mean; for honest covariances that is dof.
      dof: numbers in one estimate.
      ratio: mean / dof; above 1 the estimate is surer of itself than it should be.
      count: estimates that went in.
    """

    mean: float
    dof: int
    ratio: float
    count: int


def nees(errors: Float[np.ndarray, "n d"], covs: Float[np.ndarray, "n d d"]) -> Nees:
    """NEES of n errors with their covariances; rows that are not finite are left out, angles are to be wrapped."""
    dof = errors.shape[1]
    known = np.isfinite(errors).all(axis=1) & np.isfinite(covs).all(axis=(1, 2))
    if not known.any():
        return Nees(NAN, dof, NAN, 0)
    e = errors[known]
    values = np.einsum("ni,ni->n", e, np.linalg.solve(covs[known], e[:, :, None])[:, :, 0])
    mean = float(values.mean())
    return Nees(mean, dof, mean / dof, len(e))


def published_frame(truth: Truth, origin: int, along: int, stamp: int) -> RigidMotion:
    """Where the published frame truly is: the motion from it into the truth's frame, for the one beacon at the origin
    and the other on +x as they stood at a time [ns].

    Raises:
      KeyError: the truth does not know a beacon.
    """
    first, second = (_position_at(truth.beacons[node], stamp) for node in (origin, along))
    (c, s) = (second - first) / np.linalg.norm(second - first)
    return RigidMotion(np.array([[c, -s], [s, c]]), first)


def _position_at(history: Float[np.ndarray, "n 3"], stamp: int) -> Float[np.ndarray, "2"]:
    """Last known position at a time [ns], the first one before there is any [m]."""
    return history[max(int(np.searchsorted(history[:, 0], stamp, side="right")) - 1, 0), 1:]


def consistency(result: Result, truth: Truth) -> dict[str, float]:
    """NEES over degrees of freedom of a run: pose_nees_ratio of the poses published since the frame was decided,
    beacon_nees_ratio of the beacons' last positions. NaN where the truth does not know the frame's beacons.

    The truth is put into the published frame by its own two beacons and not by a fit: a fit would take out the very
    error that the covariances are about. What the frame defines is no estimate and does not count.
    """
    figures = {"pose_nees_ratio": NAN, "beacon_nees_ratio": NAN}
    frame = result.summary["frame_beacons"]
    if frame is None or not all(node in truth.beacons for node in frame) or frame[0] == frame[1]:
        return figures
    decided = int(result.stamps[0]) + round(result.summary["decided_at"] * 1e9)
    into = published_frame(truth, frame[0], frame[1], decided)
    known = (result.stamps >= decided) & np.isfinite(result.online).all(axis=1)
    if known.any():
        true = truth.poses_at(result.stamps[known])
        xy = (true[:, :2] - into.translation) @ into.rotation
        errors = result.online[known] - np.column_stack([xy, true[:, 2] - into.angle])
        errors[:, 2] = wrapped(errors[:, 2])
        figures["pose_nees_ratio"] = nees(errors, result.online_covs[known]).ratio
    last = truth.beacon_positions()
    total, dof = 0.0, 0
    for beacon in result.beacons:
        free = {frame[0]: 0, frame[1]: 1}.get(beacon.id, 2)  # both coordinates, only x, or none
        if free and beacon.id in last:
            error = (beacon.position - (last[beacon.id] - into.translation) @ into.rotation)[None, :free]
            found = nees(error, np.asarray(beacon.cov, float)[None, :free, :free])
            total, dof = total + found.mean, dof + found.dof
    if dof:
        figures["beacon_nees_ratio"] = total / dof
    return figures
