"""What a session reported as a Result: node ids for slots, one pose a frame, the summary. Writes no file."""

from __future__ import annotations

import dataclasses
from array import array
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from uwbslam_jax import __version__, process
from uwbslam_jax.numerics import turned
from uwbslam_jax.reasons import Reason, Sensor
from uwbslam_jax.result import BeaconEstimate, BeaconStatus, Result, RunStatus
from uwbslam_jax.session.history import History
from uwbslam_jax.session.losses import blank_scans, ended, losses, unmatched, unplaced
from uwbslam_jax.session.session import Session
from uwbslam_jax.session.update import scan_points
from uwbslam_jax.startup import Relative

_NO_SCAN = "no scan: the track is that of odometry and ranges, the map is empty"
"""Warning [text]."""
_NO_TRACK = "no scan and no odometry: there is no track, the map is empty"
"""Warning [text]."""
_RELATIVE = "the robot has not moved: beacons are placed among themselves, rotation and reflection are arbitrary"
"""Warning [text]; said where scans, odometry or the ranges themselves show it, see Runner.relative."""
_UNSOLVED = "the run could not be solved as a whole ({}): track and beacons are those published along the way"
"""Warning [text], with what the solver said."""
_LATE = (
    "ranges are stamped {0:.2f} s {2} (standard deviation {1:.2f} s): the final track and beacons take that into "
    "account; with --uwb.latency {3:.2f} those along the way do so too"
)
"""Warning [text], with the time, its standard deviation [s], which way, and the setting that mends it [s]."""


_OBSERVED_M = 0.33
"""A height that is known no better than this is not told: a third of what is taken for it beforehand [m]."""
_NOTABLE_SCALE = 0.01
"""A scale of the ranges beyond this is told: a decimetre in a hall [m/m]."""
_SCALED = "ranges are off by {:+.1%} of the distance: solved from the run; uwb.bias_scale = {:.3f} has it so at once"
"""Warning [text]."""


@dataclass
class Facts:
    """What the Result tells besides what the session knows.

    Attributes:
      warnings: one line each.
      used, dropped: measurements that went into frames, by sensor, and that were left out, by reason.
      blank: scans that were used and held no return.
      truncated: where the recording breaks, None where it does not.
      odometry_used: whether any frame carried an increment.
      wall_s, compile_s: time taken, and how much of it JAX compiled [s].
      step_ms: one a frame [ms], without compilation.
      relative: geometry of the nodes at rest while the robot has not moved, else None.
    """

    warnings: list[str] = field(default_factory=list)
    used: Counter[Sensor] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    blank: int = 0
    truncated: str | None = None
    odometry_used: bool = False
    wall_s: float = 0.0
    compile_s: float = 0.0
    step_ms: array[float] = field(default_factory=lambda: array("f"))
    relative: Relative | None = None


def to_result(session: Session, facts: Facts) -> Result:
    """What a session reported, with node ids for slots. Poses of the frames that had a scan, of all frames where none
    had and odometry made the track, of none where there was neither.

    A run whose frame was never decided has its poses and map in the frame that the robot started in.
    """
    history = session.history
    scans = bool(history.has_scan.values.any())
    kept = history.has_scan.values if scans or not facts.odometry_used else np.ones(len(history.stamps), bool)
    at = slice(None) if kept.all() else np.flatnonzero(kept)  # nothing is copied where it is all of them
    beacons = _beacons(session, session.ids) if facts.relative is None else _relative_beacons(session, facts.relative)
    told = [*losses(facts.used, facts.dropped).values(), *blank_scans(facts.used[Sensor.SCAN], facts.blank)]
    told += _unmatched(history)
    told += _ended(history)
    told += [] if scans else [_NO_SCAN if facts.odometry_used else _NO_TRACK]
    told += [] if facts.relative is None else [_RELATIVE]
    told += [] if beacons else _unplaced(session, facts)
    told += _biases(session)
    told += _latency(session)
    told += [_UNSOLVED.format(session.back_end.failure)] if session.back_end.failure else []
    facts = dataclasses.replace(facts, warnings=[*facts.warnings, *told])
    stamps = history.stamps.values[at]
    start = int(stamps[0]) if len(stamps) else 0
    ids = session.ids
    online = np.array(history.poses, float).reshape(-1, 3)
    track = online if session.hindsight is None else session.hindsight.track
    diagnostics = {name: values[at] for name, values in history.diagnostics.items()}
    if len(facts.step_ms) == len(history.stamps):
        diagnostics["step_ms"] = np.array(facts.step_ms, float)[at]
    return Result(
        stamps=stamps,
        poses=track[at],
        online=online[at],
        online_covs=history.covs.values[at],
        beacons=beacons,
        beacon_tracks=_tracks(history, ids, start),
        map=session.map(),
        range_residuals=_residuals(history, ids, start),
        scan_points=_scan_points(session),
        diagnostics=diagnostics,
        events=list(history.events),
        summary=_summary(session, facts),
    )


def _unmatched(history: History) -> list[str]:
    """Whether many scans did not fit the map."""
    scans = history.has_scan.values
    if scans.sum() < 2:
        return []
    apart = float(np.median(np.diff(history.stamps.values[scans]))) / 1e9
    return unmatched(int(scans.sum()), int(history.diagnostics["poor_match"][scans].sum()), apart)


def _ended(history: History) -> list[str]:
    """Whether the scans end long before the run."""
    stamps, scans = history.stamps.values, history.has_scan.values
    if not scans.any():
        return []
    return ended(*((int(last) - int(stamps[0])) / 1e9 for last in (stamps[scans][-1], stamps[-1])))


def _residuals(history: History, ids: dict[int, int], start: int) -> np.ndarray:
    """(R, 4) t [s], nodes, residual [m]."""
    rows = history.residuals.values
    nodes = (np.array([ids[slot] for slot in rows[side].tolist()], float) for side in ("i", "j"))
    return np.column_stack([(rows["stamp"] - start) / 1e9, *nodes, rows["residual"]])


def _tracks(history: History, ids: dict[int, int], start: int) -> dict[int, np.ndarray]:
    """Node -> (n, 4) t [s], x, y, sigma [m], the nodes in the order in which they were placed."""
    rows = history.tracks.values
    slots, first = np.unique(rows["slot"], return_index=True)
    tracks = {}
    for slot in slots[np.argsort(first)].tolist():
        own = rows[rows["slot"] == slot]
        tracks[ids[slot]] = np.column_stack([(own["stamp"] - start) / 1e9, own["x"], own["y"], own["s"]])
    return tracks


def seen(session: Session, *, odometry_used: bool) -> bool:
    """Whether odometry, or scans of which most fit the map, showed how the robot moves."""
    history = session.history
    scans, told = history.has_scan.values, history.diagnostics
    fits = scans & (told["match_score"] > 0) & (told["poor_match"] == 0) if len(scans) else scans
    return odometry_used or bool(2 * fits.sum() > scans.sum() > 0)


def _unplaced(session: Session, facts: Facts) -> list[str]:
    """A warning where no beacon was placed although ranges were wanted; that all were lost is told already."""
    used = facts.used[Sensor.RANGE]
    lost = any(isinstance(why, Reason) and why.sensor is Sensor.RANGE for why in +facts.dropped)
    if session.settings.filter.lidar_only or (lost and not used):
        return []
    return [unplaced(session.lack, ranges=used, seen=seen(session, odometry_used=facts.odometry_used))]


def _biases(session: Session) -> list[str]:
    """Warnings where a notable bias or scale was found that nobody configured."""
    found = {session.ids[slot]: bias for slot, bias in session.found.bias.items()}
    told = ", ".join(f"node {node} {bias:+.2f} m" for node, bias in sorted(found.items()))
    advice = "set uwb.bias if the radios are known"
    warnings = [f"ranges are biased: {told} were solved from the run; {advice}"] if session.biased else []
    scale = session.found.scale
    setting = (1.0 + session.settings.uwb.bias_scale) * (1.0 + scale) - 1.0
    return warnings + ([_SCALED.format(scale, setting)] if abs(scale) > _NOTABLE_SCALE else [])


def _latency(session: Session) -> list[str]:
    """A warning where the stamps of the ranges were found to be late, or early."""
    found = session.back_end.latency
    if found is None:
        return []
    setting = session.settings.uwb.latency + found.late
    return [_LATE.format(abs(found.late), found.sigma, "late" if found.late > 0 else "early", setting)]


def _beacons(session: Session, ids: dict[int, int]) -> list[BeaconEstimate]:
    """Beacons as the whole run tells them where they rest, else as they are in the state, or were last reported."""
    told = {}
    if session.hindsight is not None:
        solution = session.hindsight.solution
        for b, node in enumerate(solution.nodes):
            block = slice(3 + 2 * b, 5 + 2 * b)
            told[node] = solution.beacons[b], solution.cov[block, block]
    active = np.asarray(session.state.active)
    mean, cov = np.asarray(session.state.belief.mean, float), np.asarray(session.state.belief.cov, float)
    found, heights = [], _heights(session)
    for slot in range(1, len(active)):
        high = heights.get(slot, ())
        status = session.beacon_status(slot)
        node = session.graph.ranges.node(slot)
        if node in told and status is not BeaconStatus.MOVING:
            position, block = told[node]
            found.append(BeaconEstimate(ids[slot], position, block, status, *high))
        elif active[slot]:
            two = slice(2 * slot, 2 * slot + 2)
            found.append(BeaconEstimate(ids[slot], mean[two], cov[two, two], status, *high))
        elif slot in session.history.beacons:
            left = status if status in (BeaconStatus.MOVING, BeaconStatus.SILENT) else BeaconStatus.DROPPED
            # one that was dropped is remembered where it rested last
            position, block = told.get((slot, node[1] - 1), session.history.beacons[slot])
            found.append(BeaconEstimate(ids[slot], position.astype(float), block.astype(float), left, *high))
    return sorted(found, key=lambda beacon: beacon.id)


def _heights(session: Session) -> dict[int, tuple[float, float]]:
    """Slot -> height of the antenna above the floor and its standard deviation [m], of those that are known."""
    configured = session.settings.uwb.height
    told = {slot: (configured[str(node)], 0.0) for node, slot in session.slots.items() if str(node) in configured}
    if session.hindsight is not None:
        solution, floor = session.hindsight.solution, session.settings.robot.antenna[2]
        sigma = {slot: s for slot, s in solution.sigma.height.items() if s < _OBSERVED_M}
        told |= {slot: (floor + solution.off.height[slot], s) for slot, s in sigma.items()}
    return told


def _relative_beacons(session: Session, relative: Relative) -> list[BeaconEstimate]:
    """Beacons around a robot at rest, or among themselves where it is not heard; see relative.solve for the frame."""
    robot = session.settings.robot
    shift = np.array(robot.antenna[:2]) if robot.id in relative.nodes else np.zeros(2)
    found = []
    for k, node in enumerate(relative.nodes):
        if node != robot.id:
            place, two = relative.positions[k] + shift, slice(2 * k, 2 * k + 2)
            found.append(BeaconEstimate(node, place, relative.cov[two, two], BeaconStatus.RELATIVE))
    return found


def _relative_summary(relative: Relative | None) -> dict[str, Any] | None:
    """What is worth telling of a relative geometry."""
    if relative is None:
        return None
    return {
        "frame": "relative: rotation and reflection are arbitrary while nothing has moved",
        "nodes": relative.nodes,
        "links": relative.links,
        "links_rejected": [list(pair) for pair in relative.rejected],
        "ranges_rejected": relative.gross,
        "residual_rms_m": relative.rms,
        "offset_m": relative.offset,
    }


def _scan_points(session: Session) -> np.ndarray:
    """(n, 2) the last scan in the published frame, each beam at its own time [m]."""
    if session.history.last_scan is None:
        return np.zeros((0, 2))
    number, frame, estimate = session.history.last_scan
    # the estimate may be older than the published frame: its velocity counts relative to its own heading
    track = session.history.poses if session.hindsight is None else session.hindsight.track
    pose, velocity = track[number], np.asarray(estimate.velocity, float)
    drift = turned(pose[2] - float(estimate.pose[2]), velocity)
    motion = np.append(drift, float(estimate.yaw_rate))
    return scan_points(frame.frame.scan, session.settings.robot.lidar, pose, motion)


def _frame_beacons(session: Session) -> list[int]:
    """Ids of the beacon at the published frame's origin and of the one on +x."""
    return [session.ids[slot] for slot in np.asarray(session.state.frame_slots).tolist()]


def _summary(session: Session, facts: Facts) -> dict[str, Any]:
    """The content of summary.json, without evaluation figures.

    The real-time factor is the recording's duration over the time taken, compilation left out.
    """
    history = session.history
    ids = session.ids
    stamps, step_ms = history.stamps, facts.step_ms
    duration = (stamps[-1] - stamps[0]) / 1e9 if stamps else 0.0
    decided = None if session.decided_at is None else max(session.decided_at - stamps[0], 0) / 1e9
    total = {name: int(np.sum(values)) for name, values in history.diagnostics.items()}
    rejected = {"not in line of sight": total.get("ranges_nlos", 0), "doubted": total.get("ranges_doubted", 0)}
    used = total.get("ranges_used", 0)
    unseen = session.status is RunStatus.WAITING and facts.relative is None
    unseen = unseen and not seen(session, odometry_used=facts.odometry_used)
    rejected["node not placed"] = total.get("ranges", 0) - used - sum(rejected.values())
    return {
        "steps": len(stamps),
        "duration_s": duration,
        "engine": session.engine,
        "wall_s": facts.wall_s,
        "compile_s": facts.compile_s,
        "step_ms_median": float(np.median(step_ms)) if step_ms else None,
        "step_ms_p95": float(np.percentile(step_ms, 95)) if step_ms else None,
        "real_time_factor": duration / max(facts.wall_s - facts.compile_s, 1e-9),
        "peak_rss_mb": process.peak_mb(),
        "decided_at": decided,
        "frame_beacons": None if decided is None else _frame_beacons(session),
        "relative": _relative_summary(facts.relative),
        "hypotheses": session.hypotheses,
        "status": RunStatus.UNSEEN if unseen else session.status,
        "ids": sorted(node for node, slot in session.slots.items() if slot > 0),
        "odometry_used": facts.odometry_used,
        "poor_matches": total.get("poor_match", 0),
        "searches": total.get("searched", 0),
        "keyframes": len(session.graph.keyframes),
        "scans_laid_over_others": len(session.graph.edges),
        "revisions": {"solved": session.back_end.revisions, "taken_over": session.back_end.taken_over},
        "events": [[round((e.stamp - int(stamps[0])) / 1e9, 3), e.text] for e in history.events],
        "ranges_used": used,
        "ranges_rejected": rejected,
        "found_bias": {str(ids[slot]): bias for slot, bias in sorted(session.found.bias.items())},
        "found_scale": session.found.scale,
        "found_height": {str(ids[slot]): height for slot, height in sorted(session.found.height.items())},
        "dropped": dict(sorted(facts.dropped.items())),
        "truncated": facts.truncated,
        "warnings": facts.warnings,
        "version": __version__,
        "config": dataclasses.asdict(session.settings),
    }
