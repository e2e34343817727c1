"""What a run reported, kept on the host for the files that are written when it ends.

A few numbers a frame in arrays, so that memory grows by about a hundred bytes a frame; residuals are thinned.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uwbslam_jax.estimator import Estimate, Moved, map_pose, sight
from uwbslam_jax.measurements import StampedFrame
from uwbslam_jax.numerics import Column, rotation_matrix
from uwbslam_jax.result import Event, EventKind

_RESIDUALS_EVERY_S = 1.0
"""Of each pair one is kept this often: frames at fixed times would see the same pairs again and again, or none."""
_TRACK_EVERY_S = 1.0
"""A beacon's track is for looking at: one point a second of it [s]."""
_DIAGNOSTICS = np.dtype(
    [
        ("match_score", np.float32),
        ("known_share", np.float32),
        ("poor_match", np.bool_),
        ("searched", np.bool_),
        ("drawn", np.bool_),
        ("hypotheses", np.uint32),
        ("beacons", np.uint16),
        ("ranges", np.uint16),
        ("ranges_used", np.uint16),
        ("ranges_nlos", np.uint16),
        ("ranges_doubted", np.uint16),
    ]
)
"""Of a frame: scores and shares [0 to 1], truth values, and counts."""
_RESIDUAL = np.dtype([("stamp", np.int64), ("i", np.int32), ("j", np.int32), ("residual", np.float32)])
"""A range's stamp [ns], slots, and measured less predicted range [m]."""
_TRACK = np.dtype([("stamp", np.int64), ("slot", np.int32), ("x", np.float32), ("y", np.float32), ("s", np.float32)])
"""Rows of stamps [ns], slots, and lengths [m]."""


class History:
    """Poses, covariances and diagnostics of every frame since the first scan, beacons once a second, events.

    Attributes:
      stamps, poses, covs: one entry a frame, what was published.
      map_poses, sight: one entry a frame, see graph: where the map has the robot, and what the match could not see.
      diagnostics: one entry a frame by name.
      residuals: (t, slot, slot, measured minus predicted); tracks: (t, slot, x, y, sigma).
      events: in order of time.
      last_scan: number, frame and estimate of the last frame that had a scan.
    """

    def __init__(self) -> None:
        self.stamps = Column(dtype=np.int64)
        self.poses = Column((3,))
        self.map_poses = Column((3,))
        self.sight = Column()
        self.covs = Column((3, 3))
        self.has_scan = Column(dtype=np.bool_)
        self._diagnostics = Column(dtype=_DIAGNOSTICS)
        self.residuals = Column(dtype=_RESIDUAL)
        self.tracks = Column(dtype=_TRACK)
        self.events: list[Event] = []
        self.last_scan: tuple[int, StampedFrame, Estimate] | None = None
        self._residuals_at: dict[tuple[int, int], int] = {}
        self._tracks_at = 0
        self._left: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._seen: Estimate | None = None

    @property
    def beacons(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Slot -> position (2,) [m] and covariance (2, 2) [m^2] when it was last in the state."""
        return self._left | _in_state(self._seen)

    @property
    def diagnostics(self) -> dict[str, np.ndarray]:
        """Name -> one value a frame (float32)."""
        rows = self._diagnostics.values
        return {name: rows[name].astype(np.float32) for name in _DIAGNOSTICS.names or ()} if len(rows) else {}

    def add(self, seen: Sequence[tuple[StampedFrame, Estimate]], hypotheses: int) -> None:
        """Take in a few steps."""
        frames, estimates = zip(*seen, strict=True)

        def of(name: str) -> np.ndarray:
            return np.stack([getattr(estimate, name) for estimate in estimates])

        stamps = [frame.stamp for frame in frames]
        self.stamps.extend(stamps)
        self.poses.extend(of("pose"))
        self.map_poses.extend([map_pose(estimate) for estimate in estimates])
        self.sight.extend([sight(estimate) for estimate in estimates])
        self.covs.extend(of("pose_cov"))
        self.has_scan.extend([frame.frame.has_scan for frame in frames])
        i, j, valid = (
            np.stack([getattr(frame.frame.ranges, name) for frame in frames]) for name in ("i", "j", "valid")
        )
        active, weight = of("active"), of("weight")
        used, believed, row = weight > 0, np.count_nonzero(weight > 0.25, axis=1), np.arange(len(seen))[:, None]
        walled = valid & ~used & active[row, i] & active[row, j]
        told = {"match_score": of("score"), "known_share": of("known"), "poor_match": of("poor")}
        told |= {"searched": of("searched"), "drawn": of("drawn"), "hypotheses": hypotheses}
        told |= {"beacons": np.count_nonzero(active, axis=1) - 1, "ranges": np.count_nonzero(valid, axis=1)}
        told |= {"ranges_used": believed, "ranges_nlos": np.count_nonzero(walled, axis=1)}
        told |= {"ranges_doubted": np.count_nonzero(used, axis=1) - believed}
        rows = np.empty(len(seen), _DIAGNOSTICS)
        for name, values in told.items():
            rows[name] = values
        self._diagnostics.extend(rows)
        self._add_residuals(stamps, used, i, j, of("innovation"))
        first = len(self.stamps) - len(seen)
        for k, (frame, estimate) in enumerate(seen):
            self._follow(first + k, frame, estimate)

    def _add_residuals(
        self, stamps: list[int], used: np.ndarray, i: np.ndarray, j: np.ndarray, innovation: np.ndarray
    ) -> None:
        columns = (np.nonzero(used)[0], i[used], j[used], innovation[used])
        for frame, *pair, residual in zip(*(column.tolist() for column in columns), strict=True):
            stamp, pair = stamps[frame], tuple(pair)
            if stamp - self._residuals_at.get(pair, 0) > _RESIDUALS_EVERY_S * 1e9:
                self._residuals_at[pair] = stamp
                self.residuals.append((stamp, *pair, residual))

    def _follow(self, number: int, frame: StampedFrame, estimate: Estimate) -> None:
        """The beacons' tracks, and what was last there."""
        if frame.stamp - self._tracks_at > _TRACK_EVERY_S * 1e9:
            self._tracks_at = frame.stamp
            for slot in np.flatnonzero(estimate.active[1:]) + 1:
                x, y = estimate.beacons[slot]
                sigma = float(np.sqrt(max(np.linalg.eigvalsh(estimate.beacon_covs[slot])[-1], 0.0)))
                self.tracks.append((frame.stamp, slot, x, y, sigma))
        if self._seen is None or (estimate.active != self._seen.active).any():
            self._left |= _in_state(self._seen)
        self._seen = estimate
        if frame.frame.has_scan:
            self.last_scan = (number, frame, estimate)

    def make_room(self) -> None:
        """Steps have more slots from now on."""
        self._left, self._seen = self.beacons, None

    def passage(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stamps (T,) [ns], map poses (T, 3) in float64 and sight (T,) of all frames."""
        return np.array(self.stamps), np.array(self.map_poses, float), np.array(self.sight)

    def event(self, stamp: int, kind: EventKind, node: int | None = None, detail: str = "") -> None:
        """Something worth reporting happened, see Event."""
        self.events.append(Event(stamp, kind, node, detail))

    def carry_along(self, moved: Moved, *, republish: bool) -> None:
        """The map was drawn anew. What was published stays, unless the published frame was only now decided: then what
        was reported in the start frame is put into it."""
        stamps, turn = self.stamps.values, moved.turn
        self.map_poses.values[:] = moved.carry(stamps, self.map_poses.values)
        if republish:
            self.poses.values[:] = moved.carry(stamps, self.poses.values)
            self.sight.values[:] += turn
            R = rotation_matrix(turn, 3)
            self.covs.values[:] = R @ self.covs.values @ R.T


def _in_state(estimate: Estimate | None) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Slot -> position and covariance of the beacons that are in the state."""
    if estimate is None:
        return {}
    slots = (np.flatnonzero(estimate.active[1:]) + 1).tolist()
    return {slot: (np.array(estimate.beacons[slot]), np.array(estimate.beacon_covs[slot])) for slot in slots}
