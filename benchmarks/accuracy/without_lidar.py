"""Figures of the public recordings without LiDAR: a robot with wheels and ranges, and nodes at rest.

Rows for `benchmarks.accuracy.recordings`; a folder that is absent gives the reason instead.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import uwbslam_jax as us
from benchmarks.accuracy import batch_solution
from benchmarks.accuracy.public_logs import DRIVEN, P2P_BAR_M, PublicLog, p2p
from benchmarks.tables import figures_table

_RANGE_SIGMA = {"plaza2": 0.6, "labyrinth": 0.1}
"""What the batch solution takes for the ranges' noise [m]."""
_CONFIGURED: dict[str, list[dict[str, Any]]] = {
    "plaza2": [{}, {"bias_scale": 0.07}, {"bias_scale": 0.07, "sigma_n": 0.6}],
    "labyrinth": [{}, {"bias": {"0": 0.12}}],
}
"""Keys of [uwb] that the owner of the radios would have calibrated, none at first."""
_DRIVEN = {
    "robot_rmse_m": ("robot RMS [m]", 3),
    "robot_ate_m": ("robot ATE [m]", 3),
    "robot_max_m": ("robot max [m]", 3),
    "beacon_mean_m": ("beacons mean [m]", 3),
    "decided_at": ("decided at [s]", 1),
    "real_time_factor": ("real-time factor", 0),
    "batch_robot_rmse_m": ("batch: robot RMS [m]", 3),
    "batch_robot_ate_m": ("batch: robot ATE [m]", 3),
    "batch_beacon_mean_m": ("batch: beacons mean [m]", 3),
    "batch_bias_scale": ("batch: bias_scale", 3),
}
_REST = {
    "rms_m": ("nodes RMS [m]", 3),
    "residual_rms_m": ("residual of the links, RMS [m]", 3),
    "links": ("links used", 0),
    "links_rejected": ("links left out", 0),
    "ranges_rejected": ("ranges left out", 0),
    "offset_m": ("offset found [m]", 2),
}


def driven_rows(folder: Path) -> Iterator[dict[str, Any]]:
    """Runs and batch solutions of every recording with wheels, with the reason where it is absent."""
    for name, read in DRIVEN.items():
        try:
            log = read(folder / name)
        except FileNotFoundError:
            yield {"recording": name, "skipped": "it is not in the folder"}
            continue
        yield from _driven(log)


def _driven(log: PublicLog) -> Iterator[dict[str, Any]]:
    reference: dict[str, float] = {}
    for keys in _CONFIGURED[log.name]:
        settings = replace(log.settings, uwb=replace(log.settings.uwb, **keys))
        result = us.run(log.messages, settings)
        truth = result.truth
        assert truth is not None
        if not reference:
            solved = batch_solution.solve(log.messages, truth, log.settings.robot.id, _RANGE_SIGMA[log.name])
            keys_of_it = ("robot_rmse_m", "robot_ate_m", "beacon_mean_m", "bias_scale")
            reference = {f"batch_{key}": solved[key] for key in keys_of_it}
        found = {**us.evaluate(result, truth), **result.summary, **reference}
        configured = ", ".join(f"{key} = {value}" for key, value in keys.items()) or "-"
        yield {"recording": log.name, "configured": configured, **{key: found[key] for key in _DRIVEN}}


def rest_rows(folder: Path) -> Iterator[dict[str, Any]]:
    """Relative geometry of the nodes at rest, the common offset given and found."""
    for offset_given in (True, False):
        try:
            log = p2p(folder / "p2p", offset_given=offset_given)
        except FileNotFoundError:
            yield {"recording": "p2p", "skipped": "it is not in the folder"}
            return
        result = us.run(log.messages, log.settings)
        placed = {beacon.id: beacon.position for beacon in result.beacons}
        told = result.summary["relative"]
        counts = {"links_rejected": len(told["links_rejected"])}
        found = {"rms_m": orthogonal_rms(placed, log.beacons), **told, **counts}
        yield {"recording": log.name, "configured": log.configured, **{key: found[key] for key in _REST}}


def orthogonal_rms(placed: dict[int, np.ndarray], true: dict[int, tuple[float, float]]) -> float:
    """RMS distance of the nodes [m] after the best rigid motion, with reflection where it fits better: at rest nothing
    tells the two apart."""
    A, B = np.array([placed[node] for node in true]), np.array(list(true.values()))
    A, B = A - A.mean(0), B - B.mean(0)
    u, _, vt = np.linalg.svd(A.T @ B)
    return float(np.sqrt(np.mean(np.sum((A @ u @ vt - B) ** 2, axis=1))))


def tables(driven: list[dict[str, Any]], rest: list[dict[str, Any]]) -> list[str]:
    """Both tables in Markdown."""
    return [
        "",
        "Without LiDAR: wheels and ranges, each beside a batch solution of the whole recording that starts from the "
        "true beacons and finds a bias of each beacon and one that grows with the distance. ATE: the track aligned "
        "alone. Real recordings: `plaza2` (CMU, 1.35 km, ranges 7 % too long), `labyrinth` (libRSF, 9 m in one room).",
        "",
        *_table(driven, _DRIVEN),
        "",
        f"Without LiDAR and at rest: relative geometry of eight nodes that range to each other, real DW1000 ranges, "
        f"seven of known place; reflection allowed. Bar {P2P_BAR_M:.2f} m with the common offset given.",
        "",
        *_table(rest, _REST),
    ]


def _table(rows: list[dict[str, Any]], columns: dict[str, tuple[str, int]]) -> list[str]:
    told = [row["configured"] if "configured" in row else f"skipped: {row['skipped']}" for row in rows]
    words = ((row["recording"], text) for row, text in zip(rows, told, strict=True))
    return figures_table(("recording", "configured"), columns, zip(words, rows, strict=True))
