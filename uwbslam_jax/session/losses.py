"""What a run has to say for measurements that it lost and beacons that it did not place. Pure: counts in, lines out."""

from __future__ import annotations

from collections.abc import Mapping

from uwbslam_jax.reasons import Lack, Reason, Sensor

MANY = 0.2
"""Losing a larger share of a sensor is told [0 to 1]: a tenth is a slow computer, a fifth is a fault."""
FEW = 5
"""Fewer than so many that are lost are not told, unless all are [measurements]: a device may start within a line."""
_ENDED_S = 5.0
"""Scans that end by so much before the run are no failure [s]: programs are stopped one after the other."""
_MOST_REASONS = 2
"""So many reasons are named, the most frequent first [reasons]: a line is not a table."""
_PLURAL = {Sensor.SCAN: "scans", Sensor.RANGE: "ranges", Sensor.ODOMETRY: "odometry poses"}
"""Several measurements of a sensor [sensor -> words]."""


def losses(used: Mapping[Sensor, int], dropped: Mapping[str, int], least: int = 1) -> dict[Sensor, str]:
    """A line for each sensor of which more than a fifth was lost: how much, why, and what helps. What is told already
    where it is found out is not told again.

    Args:
      used: measurements that went into frames.
      dropped: measurements left out, by reason; what is no `Reason` is of no sensor.
      least: fewer that are lost are not told, even where they are all.
    """
    told = {}
    for sensor in Sensor:
        own = {why: n for why, n in dropped.items() if isinstance(why, Reason) and why.sensor is sensor and n > 0}
        told_already = sum(n for why, n in own.items() if why.told)
        own = {why: n for why, n in own.items() if not why.told}
        lost, kept = sum(own.values()), used.get(sensor, 0) + told_already
        if lost > MANY * (lost + kept) and lost >= (max(FEW, least) if kept else least):
            often = sorted(own, key=lambda why: -own[why])
            share = f"{lost} of {lost + kept}" if kept else f"all {lost}"
            named = ", ".join(f"{own[why]} x {why.words}" for why in often[:_MOST_REASONS])
            told[sensor] = f"{share} {_PLURAL[sensor]} were left out ({named}): {often[0].advice}"
    return told


def blank_scans(scans: int, blank: int) -> list[str]:
    """A line where most of the scans that were used held no return."""
    if 2 * blank <= scans:
        return []
    helps = "is the LiDAR covered, or are its readings in another unit? see --lidar.min-range and --lidar.max-range"
    return [f"{blank} of {scans} scans hold no return within the limits: {helps}"]


def unmatched(scans: int, poor: int, apart: float) -> list[str]:
    """A line where many of the scans did not fit the map. apart: usual time between two scans [s]."""
    if poor < FEW or poor <= MANY * scans:
        return []
    where = f"{poor} of {scans} scans did not fit the map, and the heading is not known there"
    return [f"{where}: odometry helps, and scans that are less than {apart:.2g} s apart"]


def ended(after: float, duration: float) -> list[str]:
    """A line where the scans of a run end long before it. after: the time of the last; duration: of the run [s]."""
    if duration - after <= max(MANY * duration, _ENDED_S):
        return []
    return [f"no scan came after {after:.1f} s of {duration:.1f} s: did the LiDAR, its cable or its driver fail?"]


def unplaced(lack: Lack, *, ranges: int, seen: bool) -> str:
    """The line of a run that heard beacons, or should have, and has placed none.

    Args:
      lack: what start-up waits for.
      ranges: how many went into frames.
      seen: whether scans that fitted, or odometry, showed how the robot moved.
    """
    if not ranges:
        return "no range was heard: no beacon is placed; is the radio on, and does --uwb.topic name its ranges?"
    if not seen:
        return "no beacon is placed: neither scans nor odometry show how the robot moves"
    return f"no beacon is placed: {lack}; {lack.advice}"
