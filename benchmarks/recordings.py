"""How far off the answer is on recordings with known truth, with the defaults, with and without their odometry.

`python -m benchmarks.recordings FOLDER` runs every NAME.mcap below FOLDER that has a NAME.truth.npz beside it and
writes results/recordings.md and .json.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path

from benchmarks.scenarios import RESULTS, line, provenance
from uwbslam_jax.__main__ import prepare

_COLUMNS = {
    "robot_rmse_m": ("robot RMS [m]", 3),
    "robot_max_m": ("robot max [m]", 3),
    "heading_deg_median": ("heading median [deg]", 2),
    "beacon_mean_m": ("beacons mean [m]", 3),
    "beacon_max_m": ("beacons max [m]", 3),
    "covered": ("covered", 3),
    "decided_at": ("decided at [s]", 1),
    "real_time_factor": ("real-time factor", 0),
}


def measure(log: Path, *, odometry: bool) -> dict[str, float | None]:
    """Figures of one run of a recording."""
    from uwbslam_jax.config import OdomSettings, Settings
    from uwbslam_jax.metrics import Truth, evaluate
    from uwbslam_jax.run import run_log

    settings = dataclasses.replace(Settings(), odom=OdomSettings(use=odometry))
    result, _ = run_log(log, settings)
    beacons = {beacon.id: beacon.position for beacon in result.beacons}
    figures = evaluate(result.stamps, result.poses, beacons, Truth.load(log.with_suffix(".truth.npz")))
    return {key: {**figures, **result.summary}[key] for key in _COLUMNS}


def main() -> None:
    """The command line."""
    prepare()  # before JAX is imported, which reads it once
    parser = argparse.ArgumentParser(prog="python -m benchmarks.recordings", description=__doc__)
    parser.add_argument("folder", type=Path)
    logs = [log for log in sorted(parser.parse_args().folder.rglob("*.mcap")) if log.with_suffix(".truth.npz").exists()]
    facts = provenance(workers=1)
    rows = [
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
        "`intel`: real LiDAR scans; UWB ranges and odometry drawn on the reference poses (semi-synthetic).",
        "",
    ]
    lines += [line(["recording", "odometry", *(label for label, _ in _COLUMNS.values())])]
    lines += [line(["---", "---", *["---:"] * len(_COLUMNS)])]
    for row in rows:
        cells = ["-" if row[k] is None else f"{row[k]:.{digits}f}" for k, (_, digits) in _COLUMNS.items()]
        lines.append(line([str(row["recording"]), "used" if row["odometry"] else "left out", *cells]))
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "recordings.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    text = json.dumps({"provenance": facts, "rows": rows}, indent=1)
    (RESULTS / "recordings.json").write_text(text + "\n", encoding="utf-8")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
