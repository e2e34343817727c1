"""What a run reported, kept on the host for the files that are written when it ends.

A few numbers a frame, so that memory grows by about 300 bytes a frame; residuals are thinned.
"""

from __future__ import annotations

import numpy as np

from uwbslam_jax.measurements import StampedFrame
from uwbslam_jax.slam import Estimate
from uwbslam_jax.startup import Adopted

_RESIDUALS_EVERY_S = 1.0
"""Of each pair one is kept this often: frames at fixed times would see the same pairs again and again, or none."""
_TRACK_EVERY_S = 1.0


class History:
    """Poses, covariances and diagnostics of every frame since the first scan, beacons once a second, events.

    Attributes:
      stamps, poses, covs: one entry a frame; decided: whether the published frame was known then.
      diagnostics: one entry a frame by name.
      residuals: (t, slot, slot, measured minus predicted); tracks: (t, slot, x, y, sigma).
      events: (stamp, text).
      beacons: slot -> position (2,) [m] and covariance (2, 2) [m^2] when it was last in the state.
      last_scan: number, frame and estimate of the last frame that had a scan.
    """

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.poses: list[np.ndarray] = []
        self.covs: list[np.ndarray] = []
        self.has_scan: list[bool] = []
        self.diagnostics: dict[str, list[float]] = {}
        self.residuals: list[tuple[int, int, int, float]] = []
        self.tracks: list[tuple[int, int, float, float, float]] = []
        self.events: list[tuple[int, str]] = []
        self.beacons: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self.last_scan: tuple[int, StampedFrame, Estimate] | None = None
        self._residuals_at: dict[tuple[int, int], int] = {}
        self._tracks_at = 0

    def add(self, frame: StampedFrame, estimate: Estimate, hypotheses: int) -> None:
        """Take in one step."""
        self.stamps.append(frame.stamp)
        self.poses.append(np.asarray(estimate.pose, float))
        self.covs.append(np.asarray(estimate.pose_cov))
        self.has_scan.append(bool(frame.frame.has_scan))
        r = frame.frame.ranges
        used = estimate.weight > 0
        values = {
            "match_score": float(estimate.score),
            "known_share": float(estimate.known),
            "poor_match": float(estimate.poor),
            "searched": float(estimate.searched),
            "drawn": float(estimate.drawn),
            "hypotheses": float(hypotheses),
            "beacons": float(np.sum(estimate.active) - 1),
            "ranges": float(np.sum(r.valid)),
            "ranges_used": float(np.sum(estimate.weight > 0.25)),
            "ranges_nlos": float(np.sum(r.valid & ~used & estimate.active[r.i] & estimate.active[r.j])),
            "ranges_doubted": float(np.sum(used & (estimate.weight <= 0.25))),
        }
        for name, value in values.items():
            self.diagnostics.setdefault(name, []).append(value)
        for k in np.flatnonzero(used):
            pair = int(r.i[k]), int(r.j[k])
            if frame.stamp - self._residuals_at.get(pair, 0) > _RESIDUALS_EVERY_S * 1e9:
                self._residuals_at[pair] = frame.stamp
                self.residuals.append((frame.stamp, *pair, float(estimate.innovation[k])))
        if frame.stamp - self._tracks_at > _TRACK_EVERY_S * 1e9:
            self._tracks_at = frame.stamp
            for slot in np.flatnonzero(estimate.active[1:]) + 1:
                x, y = estimate.beacons[slot]
                sigma = float(np.sqrt(max(np.linalg.eigvalsh(estimate.beacon_covs[slot])[-1], 0.0)))
                self.tracks.append((frame.stamp, int(slot), float(x), float(y), sigma))
        for slot in np.flatnonzero(estimate.active[1:]) + 1:
            self.beacons[int(slot)] = (np.asarray(estimate.beacons[slot]), np.asarray(estimate.beacon_covs[slot]))
        if frame.frame.has_scan:
            self.last_scan = (len(self.stamps) - 1, frame, estimate)

    def event(self, stamp: int, text: str) -> None:
        """Something worth telling happened."""
        self.events.append((stamp, text))

    def republish(self, adopted: Adopted) -> None:
        """The frame was decided: what was reported in the start frame is put into the published one."""
        poses = adopted.republish(np.array(self.stamps), np.array(self.poses))
        turn = adopted.after[-1, 2] - adopted.before[-1, 2]
        c, s = np.cos(turn), np.sin(turn)
        R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        self.poses = list(poses)
        self.covs = [R @ P @ R.T for P in self.covs]
