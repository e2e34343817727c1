"""How far off the answer is on recordings with known truth, with the defaults, with and without their odometry.

`python -m benchmarks.accuracy.recordings FOLDER` runs every NAME.mcap below FOLDER that has a NAME.truth.npz beside it,
and the public logs without LiDAR that lie in FOLDER, and writes results/recordings.md and .json.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import uwbslam_jax as us
from benchmarks.accuracy import without_lidar
from benchmarks.accuracy.sharpness import scan_misfit
from benchmarks.tables import figures_table, provenance, write

_COLUMNS = {
    "robot_rmse_m": ("robot RMS [m]", 3),
    "online_ate_m": ("online ATE [m]", 3),
    "robot_max_m": ("robot max [m]", 3),
    "heading_deg_median": ("heading median [deg]", 2),
    "beacon_mean_m": ("beacons mean [m]", 3),
    "beacon_max_m": ("beacons max [m]", 3),
    "scan_misfit": ("mean 1 - Gamma", 3),
    "pose_nees_ratio": ("pose NEES / dof", 2),
    "covered": ("covered", 3),
    "decided_at": ("decided at [s]", 1),
    "real_time_factor": ("real-time factor", 0),
}


def measure(log: Path, *, odometry: bool) -> dict[str, float | None]:
    """Figures of one run of a recording."""
    settings = us.Settings(odom=us.OdomSettings(use=odometry))
    result = us.run(log, settings)
    result.truth = us.Truth.load(log.with_suffix(".truth.npz"))
    scans = (message for message in us.read(log, settings) if isinstance(message, us.ScanMessage))
    limits = (settings.lidar.min_range, settings.lidar.max_range)
    misfit = scan_misfit(result.map, result.stamps, result.poses, scans, settings.robot.lidar, limits)
    found = {**result.errors(), "scan_misfit": misfit, **result.summary}
    return {key: found[key] for key in _COLUMNS}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy.recordings", description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    logs = [log for log in sorted(folder.rglob("*.mcap")) if log.with_suffix(".truth.npz").exists()]
    facts = provenance(workers=1)
    rows: list[dict[str, Any]] = [
        {"recording": log.stem, "odometry": odometry, **measure(log, odometry=odometry)}
        for log in logs
        for odometry in (True, False)
    ]
    lines = [
        "# Recordings with known truth, default settings",
        "",
        ", ".join(f"{k} {v}" for k, v in facts.items()) + ".",
    ]
    lines += [
        "",
        "`intel`: real LiDAR scans; UWB ranges and odometry drawn on the reference poses (semi-synthetic). "
        "Online: what was published at the time, laid over the truth by itself. Mean "
        "1 - Gamma: of all returns of all scans against the final map.",
        "",
    ]
    if not logs:
        lines += ["No recording with LiDAR and truth in the folder: skipped.", ""]
    told = ((row["recording"], "used" if row["odometry"] else "left out") for row in rows)
    lines += figures_table(("recording", "odometry"), _COLUMNS, zip(told, rows, strict=True))
    driven, rest = list(without_lidar.driven_rows(folder)), list(without_lidar.rest_rows(folder))
    lines += without_lidar.tables(driven, rest)
    data = {"provenance": facts, "rows": rows, "without_lidar": driven, "at_rest": rest}
    write("recordings", "\n".join(lines) + "\n", data)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
