"""The numbers behind the report's map and charts, thinned and rounded for JSON; the map as a PNG. Host data only."""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Iterable
from typing import Any

import numpy as np

from uwbslam_jax.result import BeaconEstimate, MapImage, Result, crop

_POSES, _SAMPLES, _RESIDUALS, _PIXELS = 6000, 2000, 12_000, 2000
"""Most poses, values of a series, residuals, and pixels along the map [each]: a screen shows no more, and the file
stays at a few megabytes."""
_DIAGNOSTICS: dict[str, tuple[str, str]] = {
    "match_score": ("Match score", ""),
    "step_ms": ("Step time", "ms"),
    "latency_ms": ("Scan arrival to pose", "ms"),
    "hypotheses": ("Hypotheses", ""),
    "ranges_used": ("Ranges used", "a frame"),
    "searched": ("Wide searches", ""),
}
"""Label and unit of a series [name -> texts]; the order is that on the page."""


def span(result: Result) -> float:
    """Time from the first to the last frame [s]."""
    return float(result.stamps[-1] - result.stamps[0]) / 1e9 if len(result.stamps) else 0.0


def pair_residuals(result: Result) -> dict[tuple[int, int], np.ndarray]:
    """Finite residuals [m] of each pair of nodes, the smaller id first."""
    rows = result.range_residuals.reshape(-1, 4)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        return {}
    nodes = np.sort(rows[:, 1:3].astype(np.int64), axis=1)
    pairs, which, counts = np.unique(nodes, axis=0, return_inverse=True, return_counts=True)
    groups = np.split(rows[np.argsort(which.ravel(), kind="stable"), 3], np.cumsum(counts)[:-1])
    return {(int(a), int(b)): group for (a, b), group in zip(pairs, groups, strict=True)}


def pair_kinds(result: Result, pairs: Iterable[tuple[int, int]]) -> dict[tuple[int, int], int]:
    """1 for two beacons, 0 where the robot takes part."""
    beacons = {beacon.id for beacon in result.beacons}
    return {pair: int(pair[0] in beacons and pair[1] in beacons) for pair in pairs}


def numbers(values: np.ndarray, digits: int) -> list[Any]:
    """Rounded numbers for JSON, None where not finite."""
    rounded = np.round(np.asarray(values, float), digits)
    return [None if not np.isfinite(v) else int(v) if v == int(v) else v for v in rounded.ravel().tolist()]


def page_data(result: Result) -> dict[str, Any]:
    """All that the page draws of a finished run."""
    seconds = (result.stamps - result.stamps[0]) / 1e9 if len(result.stamps) else np.zeros(0)
    pick = np.unique(np.linspace(0, max(len(seconds) - 1, 0), _POSES).astype(int)) if len(seconds) else slice(0)
    poses, covs = result.poses[pick], result.online_covs[pick]
    track = {"t": numbers(seconds[pick], 3)}
    track |= {name: numbers(poses[:, k], 3) for k, name in enumerate(("x", "y", "yaw"))}
    track |= {"xx": numbers(covs[:, 0, 0], 6), "xy": numbers(covs[:, 0, 1], 6), "yy": numbers(covs[:, 1, 1], 6)}
    drawn = picture(result.map)
    spots = [result.poses[:, :2], *(b.position[None] for b in result.beacons), result.scan_points.reshape(-1, 2)]
    return {
        "duration": max(span(result), 1e-3),
        "extent": extent(spots, drawn),
        "track": track,
        "beacons": [beacon(b, 4, result.beacon_tracks.get(b.id)) for b in result.beacons],
        "scan": [numbers(point, 3) for point in result.scan_points],
        "map": drawn,
        "diagnostics": diagnostics(result),
        "residuals": _residuals(result),
    }


def beacon(estimate: BeaconEstimate, digits: int, path: np.ndarray | None = None) -> dict[str, Any]:
    """A beacon as the page draws it, to some digits of a metre; path: rows (n, 4) of t, x, y, sigma [s, m]."""
    x, y = numbers(estimate.position, digits)
    cov = numbers(estimate.cov.ravel()[[0, 1, 3]], 2 * digits)
    track = None
    if path is not None and len(path):
        thin = path[:: max(1, len(path) // 500)]
        track = {name: numbers(thin[:, k], digits) for k, name in enumerate(("t", "x", "y", "sigma"))}
    return {"id": estimate.id, "status": estimate.status, "x": x, "y": y, "track": track, "cov": cov}


def diagnostics(result: Result) -> list[dict[str, Any]]:
    """The series that hold one finite number a frame at least, thinned so that peaks stay."""
    known = [name for name in _DIAGNOSTICS if name in result.diagnostics]
    series = []
    for name in [*known, *(name for name in result.diagnostics if name not in _DIAGNOSTICS)]:
        values = np.asarray(result.diagnostics[name])
        if values.shape != result.stamps.shape or values.dtype.kind not in "biuf" or not np.isfinite(values).any():
            continue
        pick = _thin(values.astype(float), _SAMPLES)
        label, unit = _DIAGNOSTICS.get(name, (name.replace("_", " ").capitalize(), ""))
        series.append(
            {
                "name": label,
                "unit": unit,
                "steps": values.dtype.kind != "f",
                "t": numbers((result.stamps[pick] - result.stamps[0]) / 1e9, 3),
                "v": numbers(values[pick], 5),
            }
        )
    return series


def _thin(values: np.ndarray, count: int) -> np.ndarray:
    """Indices of at most about `count` values: the least and the greatest of each stretch."""
    if len(values) <= count:
        return np.arange(len(values))
    width = -(-len(values) // (count // 2))
    rows = np.full((-(-len(values) // width), width), np.nan)
    rows.ravel()[: len(values)] = values
    finite = np.isfinite(rows)
    least, greatest = (np.where(finite, rows, -sign * np.inf) * sign for sign in (-1.0, 1.0))
    begin = width * np.arange(len(rows))
    return np.unique(np.concatenate([begin + least.argmax(1), begin + greatest.argmax(1)]))


def _residuals(result: Result) -> dict[str, Any]:
    """Residuals for the chart: time, pair, value [m]; the bound of the axis leaves the gross outliers out."""
    rows = result.range_residuals.reshape(-1, 4)
    rows = rows[np.isfinite(rows).all(axis=1)]
    statistics = pair_residuals(result)
    number = {pair: k for k, pair in enumerate(statistics)}
    kinds = pair_kinds(result, statistics)
    bound = max(float(np.quantile(np.abs(rows[:, 3]), 0.98)) * 1.25, 0.05) if len(rows) else 1.0
    rows = rows[:: -(-len(rows) // _RESIDUALS) or 1]
    return {
        "t": numbers(rows[:, 0], 2),
        "v": numbers(rows[:, 3], 3),
        "pair": [number[min(a, b), max(a, b)] for a, b in rows[:, 1:3].astype(int).tolist()],
        "pairs": [list(pair) for pair in statistics],
        "kind": list(kinds.values()),
        "bound": round(bound, 3),
    }


def extent(spots: list[np.ndarray], drawn: dict[str, Any] | None) -> list[float]:
    """x0, y0, x1, y1 of all that is drawn [m]: of spots (n, 2) and the picture of the map."""
    if drawn:
        x, y = drawn["origin"]
        spots = [*spots, np.array([[x, y], [x + drawn["cols"] * drawn["cell"], y + drawn["rows"] * drawn["cell"]]])]
    points = np.concatenate([np.asarray(spot, float) for spot in spots])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        return [-5.0, -5.0, 5.0, 5.0]
    middle, half = (points.min(0) + points.max(0)) / 2, (points.max(0) - points.min(0)) / 2 + 0.5
    return [float(v) for v in (*(middle - half), *(middle + half))]


def picture(image: MapImage) -> dict[str, Any] | None:
    """The observed part of the map as a PNG: grey is 255 (1 - p), never observed is transparent."""
    image = crop(image)
    odds = np.nan_to_num(image.log_odds)
    if not odds.any():
        return None
    factor = -(-max(odds.shape) // _PIXELS)
    if factor > 1:  # a wall stays a wall however small it is drawn
        odds = np.pad(odds, [(0, -side % factor) for side in odds.shape])
        blocks = odds.reshape(odds.shape[0] // factor, factor, odds.shape[1] // factor, factor)
        greatest, least = blocks.max(axis=(1, 3)), blocks.min(axis=(1, 3))
        odds = np.where(greatest > 0, greatest, least)
    grey = np.round(255 / (1 + np.exp(np.clip(odds, -30, 30)))).astype(np.uint8)
    pixels = np.stack([grey, np.where(odds != 0, 255, 0).astype(np.uint8)], axis=-1)[::-1]
    return {
        "png": "data:image/png;base64," + base64.b64encode(_png(pixels)).decode(),
        "origin": [float(v) for v in image.origin],
        "cell": float(image.resolution * factor),
        "rows": odds.shape[0],
        "cols": odds.shape[1],
    }


def _png(pixels: np.ndarray) -> bytes:
    """Grey and alpha (rows, cols, 2) uint8, top row first, as a PNG file (ISO/IEC 15948)."""
    rows, cols, _ = pixels.shape

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", cols, rows, 8, 4, 0, 0, 0)  # 8 bits a sample, grey and alpha
    lines = np.concatenate([np.zeros((rows, 1), np.uint8), pixels.reshape(rows, -1)], axis=1)  # filter 0 each
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(lines.tobytes(), 6)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body
