"""Results made up: a run around a room with two beacons, and one in which nothing was ever decided."""

from __future__ import annotations

from typing import Any

import numpy as np

from uwbslam_jax.result import BeaconEstimate, BeaconStatus, Event, EventKind, MapImage, Result

START = 1_700_000_000_000_000_000


def make_result(frames: int = 200, **changes: Any) -> Result:
    """A run around a 4 x 3 m room with two beacons."""
    rng = np.random.default_rng(0)
    turn = np.linspace(0, 2 * np.pi, frames)
    log_odds = np.zeros((80, 100), np.float32)
    log_odds[10:70, 10:90] = -2.0
    log_odds[10, 10:90] = log_odds[69, 10:90] = 3.0
    residuals = np.column_stack(
        [np.linspace(0, 20, 400), np.zeros(400), rng.integers(1, 3, 400), rng.normal(0, 0.1, 400)]
    )
    fields: dict[str, Any] = {
        "stamps": START + np.arange(frames) * 100_000_000,
        "poses": np.column_stack([2 + np.cos(turn), 1.5 + np.sin(turn), turn + np.pi / 2]),
        "online_covs": np.broadcast_to(np.diag([0.01, 0.02, 0.001]) ** 2, (frames, 3, 3)),
        "beacons": [
            BeaconEstimate(1, np.array([0.0123, 3.4567]), np.diag([0.0042, 0.0051]) ** 2, BeaconStatus.STATIC),
            BeaconEstimate(4294967295, np.array([3.9, 0.0]), np.diag([0.1, 0.1]), BeaconStatus.SILENT),
        ],
        "beacon_tracks": {1: np.array([[1.0, 0.0, 3.4, 0.1], [9.0, 0.012, 3.456, 0.01]])},
        "map": MapImage(log_odds, 0.05, np.array([-0.5, -0.5])),
        "range_residuals": residuals,
        "scan_points": rng.uniform(0, 3, (50, 2)),
        "diagnostics": {"match_score": rng.uniform(0.8, 1, frames), "hypotheses": np.ones(frames, int)},
        "events": [
            Event(START, EventKind.STATUS, detail="waiting for motion"),
            Event(START + 3_210_000_000, EventKind.FRAME_DECIDED, detail="1 and 2"),
        ],
        "summary": {
            "steps": frames,
            "duration_s": 19.9,
            "step_ms_median": 2.345,
            "step_ms_p95": 3.456,
            "real_time_factor": 43.2,
            "decided_at": 3.2,
            "dropped": {"nlos": 137},
            "config": "[uwb]\nsigma_n = 0.125\n",
        },
    }
    fields["online"] = changes.get("poses", fields["poses"])
    return Result(**{**fields, **changes})


def empty_result(**changes: Any) -> Result:
    """A run in which nothing was ever decided."""
    fields = {
        "poses": np.full((200, 3), np.nan),
        "online_covs": np.full((200, 3, 3), np.nan),
        "beacons": [],
        "beacon_tracks": {},
        "map": MapImage(np.zeros((4, 4), np.float32), 0.05, np.zeros(2)),
        "range_residuals": np.zeros((0, 4)),
        "scan_points": np.zeros((0, 2)),
        "diagnostics": {},
        "events": [],
        "summary": {},
    }
    return make_result(**{**fields, **changes})
