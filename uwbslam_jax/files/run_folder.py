"""A Result as the files of a run directory, and such a directory read back for evaluation.

trajectory.tum, beacons.csv, map.pgm + map.yaml and summary.json; result.mcap is `result_log`.
"""

from __future__ import annotations

import csv
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uwbslam_jax.errors import RunError
from uwbslam_jax.files.result_log import write_result_log
from uwbslam_jax.result import OCCUPIED_THRESHOLD, BeaconEstimate, BeaconStatus, MapImage, Result, crop, trinary

FREE_THRESHOLD = 0.196
"""Probability below which map_server takes a cell as free [1]: under that of gray 205, 50 / 255, which is unknown."""


@dataclass(frozen=True, slots=True)
class Run:
    """What a run directory says, for evaluation. T poses, N beacons.

    Attributes:
      stamps: (T,) int64 [ns].
      poses: (T, 3) x, y, yaw [m, m, rad].
      beacon_ids: (N,) int64.
      beacons: (N, 2) positions [m].
      beacon_sigmas: (N, 2) standard deviations in x and y [m].
      beacon_status: of each.
      summary: the content of summary.json, empty where there is none.
    """

    stamps: np.ndarray
    poses: np.ndarray
    beacon_ids: np.ndarray
    beacons: np.ndarray
    beacon_sigmas: np.ndarray
    beacon_status: list[BeaconStatus]
    summary: dict[str, Any]


def write_result(result: Result, directory: str | Path) -> None:
    """Writes every file of a run into the directory, which is created; files that are there are replaced.

    Raises:
      OSError: the directory or a file cannot be written.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    write_trajectory(result.stamps, result.poses, directory / "trajectory.tum")
    write_beacons(result.beacons, directory / "beacons.csv")
    write_map(result.map, directory)
    write_summary(result.summary, directory / "summary.json")
    write_result_log(result, directory / "result.mcap")


def write_trajectory(stamps: np.ndarray, poses: np.ndarray, path: Path) -> None:
    """TUM format: t x y z qx qy qz qw. (T,) int64 [ns], (T, 3) [m, m, rad]; poses that are not finite are left out.

    The time is written from the integer: a float64 holds an epoch only to 0.2 microseconds.
    """
    with path.open("w", encoding="ascii") as file:
        for stamp, pose in zip(stamps, poses, strict=True):  # no list of them all: there may be hours
            x, y, yaw = pose.tolist()
            if math.isfinite(x + y + yaw):
                sec, nanosec = divmod(int(stamp), 1_000_000_000)
                turn = f"{math.sin(yaw / 2):.9f} {math.cos(yaw / 2):.9f}"
                file.write(f"{sec}.{nanosec:09d} {x:.6f} {y:.6f} 0 0 0 {turn}\n")


def write_beacons(beacons: list[BeaconEstimate], path: Path) -> None:
    """CSV with a head line: id,x,y,sigma_x,sigma_y,z,sigma_z,status [m]; a height that is not known is left empty."""
    with path.open("w", encoding="ascii", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["id", "x", "y", "sigma_x", "sigma_y", "z", "sigma_z", "status"])
        for beacon in sorted(beacons, key=lambda beacon: beacon.id):
            numbers = [f"{value:.6f}" for value in (*beacon.position, *np.sqrt(np.diagonal(beacon.cov)))]
            height = ["" if math.isnan(value) else f"{value:.6f}" for value in (beacon.z, beacon.sigma_z)]
            writer.writerow([beacon.id, *numbers, *height, beacon.status])


def write_map(image: MapImage, directory: Path) -> None:
    """map.pgm and map.yaml as map_server reads them, cropped to the observed area; the top row is the largest y.

    A map of which nothing was observed is a single unknown cell, and map.yaml says so.
    """
    image = crop(image)
    note = "" if image.log_odds.any() else "# nothing was observed: no scan was drawn\n"
    gray = trinary(image.log_odds)[::-1]
    rows, columns = gray.shape
    head = f"P5\n# {image.resolution:g} m/cell\n{columns} {rows}\n255\n"
    (directory / "map.pgm").write_bytes(head.encode("ascii") + gray.tobytes())
    x, y = (float(value) for value in image.origin)
    (directory / "map.yaml").write_text(
        f"{note}image: map.pgm\n"
        "mode: trinary\n"
        f"resolution: {float(image.resolution):.6g}\n"
        f"origin: [{x:.6f}, {y:.6f}, 0.0]\n"
        "negate: 0\n"
        f"occupied_thresh: {OCCUPIED_THRESHOLD}\n"
        f"free_thresh: {FREE_THRESHOLD}\n",
        encoding="ascii",
    )


def write_summary(summary: dict[str, Any], path: Path) -> None:
    """JSON with six significant digits; what is not finite becomes null."""
    path.write_text(json.dumps(_plain(summary), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    """The value in JSON's own types."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set)):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):  # arrays and their scalars
        return _plain(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)


def read_run(directory: str | Path) -> Run:
    """Reads trajectory.tum, beacons.csv and, where there is one, summary.json.

    Raises:
      RunError: a file is missing or does not hold what it should.
    """
    directory = Path(directory)
    stamps, poses = read_trajectory(directory / "trajectory.tum")
    path = directory / "beacons.csv"
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        numbers = [[float(row[key]) for key in ("x", "y", "sigma_x", "sigma_y")] for row in rows]
        ids, status = [int(row["id"]) for row in rows], [BeaconStatus(row["status"]) for row in rows]
    except OSError as error:
        raise RunError(f"{path}: {error.strerror or error}") from None
    except (KeyError, ValueError, TypeError) as error:
        raise RunError(f"{path}: not a table of id,x,y,sigma_x,sigma_y,status: {error}") from None
    table = np.array(numbers, dtype=np.float64).reshape(-1, 4)
    path = directory / "summary.json"
    try:
        summary = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    except (OSError, ValueError) as error:
        raise RunError(f"{path}: {error}") from None
    return Run(stamps, poses, np.array(ids, dtype=np.int64), table[:, :2], table[:, 2:], status, summary)


def read_trajectory(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (T,) int64 [ns] and poses (T, 3) [m, m, rad] of a TUM file; times keep their nanoseconds.

    Raises:
      RunError: no such file, or a line that is not eight numbers.
    """
    stamps: list[int] = []
    poses: list[tuple[float, float, float]] = []
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise RunError(f"{path}: {error.strerror or error}") from None
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or line.startswith("#"):
            continue
        try:
            sec, _, fraction = words[0].partition(".")
            x, y, _, qx, qy, qz, qw = (float(word) for word in words[1:])
            stamps.append(int(sec) * 1_000_000_000 + int(fraction[:9].ljust(9, "0")))
        except ValueError:
            raise RunError(f"{path}: line {number}: not t x y z qx qy qz qw") from None
        poses.append((x, y, math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))))
    return np.array(stamps, dtype=np.int64), np.array(poses, dtype=np.float64).reshape(-1, 3)
