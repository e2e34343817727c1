"""The wide search: where a scan fits that alignment has not placed. Twin: estimator.wide_search."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from uwbslam_jax.estimator import wide_search as twin
from uwbslam_jax.estimator.native.grid import Window, level_of, sigmoid, size_of
from uwbslam_jax.estimator.native.loops import loops, sums
from uwbslam_jax.estimator.native.matching import View, align, fit, middle
from uwbslam_jax.estimator.native.records import Belief
from uwbslam_jax.estimator.native.small import wrap_angle
from uwbslam_jax.estimator.native.sweep import Sweep

f32: Any = np.float32
index: Any = np.intp


class Expected(NamedTuple):
    """What is expected of a pose, the place's covariance inverted, and where the robot was last."""

    mean: Float[ndarray, "3"]
    xx: float
    xy: float
    yy: float
    last: Float[ndarray, "3"]


@loops
def unlikely(expected: Expected, x: float, y: float, heading: float) -> float:
    x, y = x - expected.mean[0], y - expected.mean[1]
    ahead = wrap_angle(heading - expected.mean[2]) / twin._TURN
    as_last = wrap_angle(heading - expected.last[2]) / twin._TURN
    away = expected.xx * x * x + 2 * expected.xy * x * y + expected.yy * y * y
    return twin._UNLIKELY * (away + min(ahead**2, as_last**2))


@loops
def probabilities(level: Float[ndarray, "c c"]) -> Float[ndarray, "c c"]:
    """Of all cells: each is looked at many times."""
    gamma = np.empty(level.shape, np.float32)
    flat, out = level.reshape(-1), gamma.reshape(-1)
    for i in range(flat.size):
        out[i] = sigmoid(flat[i])
    return gamma


@loops
def places_of(expected: Expected, spread: float) -> Float[ndarray, "p 2"]:
    """Two patches of 5 x 5 positions, around the pose that is expected and around the last one."""
    side = twin._PATCH_SIDE
    places = np.empty((2 * side * side, 2))
    for n in range(places.shape[0]):
        centre = expected.mean if n < side * side else expected.last
        row, col = n % (side * side) // side, n % side
        places[n, 0] = centre[0] + spread * (2.0 * col / (side - 1) - 1.0)
        places[n, 1] = centre[1] + spread * (2.0 * row / (side - 1) - 1.0)
    return places


class Turned(NamedTuple):
    """Returns of a scan turned to a heading, from the window's corner, in cells, for a robot at the corner."""

    x: Float[ndarray, "b"]
    y: Float[ndarray, "b"]


@loops
def turned(sweep: Sweep, stride: int, heading: float, size: float) -> Turned:
    c, s, from_x, from_y, valid = math.cos(heading), math.sin(heading), sweep.rows[0], sweep.rows[1], sweep.rows[2]
    x, y, n = np.empty(valid.size, np.float32), np.empty(valid.size, np.float32), 0
    for i in range(0, valid.size, stride):
        if valid[i] > f32(0.0):
            x[n] = (c * from_x[i] - s * from_y[i]) / size
            y[n] = (s * from_x[i] + c * from_y[i]) / size
            n += 1
    return Turned(x[:n], y[:n])


@sums
def gain(gamma: Float[ndarray, "c c"], points: Turned, x: float, y: float) -> float:
    """Sum of Gamma - 0.5 over points moved by x and y [cells]."""
    flat, side, total, zero = gamma.reshape(-1), gamma.shape[0], f32(0.0), f32(0.0)
    top = f32(side - 2)
    for i in range(points.x.size):
        u, v = points.x[i] + x, points.y[i] + y
        col, row = np.floor(u), np.floor(v)
        if (col >= zero) & (col <= top) & (row >= zero) & (row <= top):
            at = index(row) * side + index(col)
            fx, fy = u - col, v - row
            low = flat[at] + fx * (flat[at + 1] - flat[at])
            high = flat[at + side] + fx * (flat[at + side + 1] - flat[at + side])
            total += low + fy * (high - low) - f32(0.5)
    return total


@loops
def best_places(window: Window, view: View, expected: Expected, places: Float[ndarray, "p 2"]) -> Float[ndarray, "h 4"]:
    """For each heading the place that fits best: its value, and the pose."""
    k, sweep, count = middle(window), view.sweep, f32(0.0)
    gamma, size = probabilities(level_of(window, k)), float(size_of(window, k))
    stride = max(1, sweep.rows.shape[1] // twin._SEARCH_BEAMS)
    for i in range(0, sweep.rows.shape[1], stride):
        count += sweep.rows[2, i]
    best = np.empty((twin._SEARCH_HEADINGS, 4))
    for h in range(twin._SEARCH_HEADINGS):
        heading = expected.mean[2] - math.pi + 2 * math.pi * h / twin._SEARCH_HEADINGS
        points = turned(sweep, stride, heading, size)
        best[h, 0] = -math.inf
        for n in range(places.shape[0]):
            x, y = (places[n, 0] - window.x) / size - 0.5, (places[n, 1] - window.y) / size - 0.5
            value = gain(gamma, points, f32(x), f32(y)) / max(float(count), 1.0)
            value -= unlikely(expected, places[n, 0], places[n, 1], heading)
            if value > best[h, 0]:
                best[h, 0], best[h, 1], best[h, 2], best[h, 3] = value, places[n, 0], places[n, 1], heading
    return best


@loops
def peaks(best: Float[ndarray, "h 4"]) -> Float[ndarray, "s 3"]:
    """Poses of the highest peaks over the headings, the highest first."""
    n = best.shape[0]
    value = np.full(n, -math.inf)
    taken, starts = np.zeros(n, np.bool_), np.empty((twin._SEARCH_REFINED, 3))
    for h in range(n):
        if best[h, 0] >= best[h - 1, 0] and best[h, 0] >= best[(h + 1) % n, 0]:
            value[h] = best[h, 0]
    for s in range(starts.shape[0]):
        top = -1
        for h in range(n):
            if not taken[h] and (top < 0 or value[h] > value[top]):
                top = h
        taken[top] = True
        for i in range(3):
            starts[s, i] = best[top, 1 + i]
    return starts


@loops
def search(
    window: Window, view: View, expected: Belief, last: Float[ndarray, "3"], found: Float[ndarray, "3"]
) -> Float[ndarray, "3"]:
    """Best pose over the full circle of headings and two patches of positions, where it is better than `found`."""
    xx, xy, yy = expected.cov[0, 0], expected.cov[0, 1], expected.cov[1, 1]
    det = xx * yy - xy * xy
    at = Expected(expected.mean, yy / det, -xy / det, xx / det, last)
    low, high = twin._PATCH_M
    spread = min(max(twin._PATCH_SPREAD * math.sqrt(max(xx, yy)), low), high)
    starts = peaks(best_places(window, view, at, places_of(at, spread)))
    wide = np.zeros((3, 3))
    for i in range(3):
        wide[i, i] = twin._REFINE_SPREAD**2
    pose, most = found, -math.inf
    for s in range(-1, starts.shape[0]):
        start = found if s < 0 else starts[s]
        refined = align(window, view, start, Belief(start, wide), False)
        score, known = fit(window, middle(window), refined, view.sweep, view.ends)
        value = (score - 0.5) * known - unlikely(at, refined[0], refined[1], refined[2])
        if value > most:
            pose, most = refined, value
    turned_to = pose.copy()
    turned_to[2] = expected.mean[2] + wrap_angle(pose[2] - expected.mean[2])
    return turned_to
