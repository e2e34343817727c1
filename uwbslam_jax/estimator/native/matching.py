"""Aligning a scan with the map, and the score of a match. Twin: estimator.matching and lidar_objective."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from uwbslam_jax.estimator import matching as twin
from uwbslam_jax.estimator.lidar_objective import _JITTER
from uwbslam_jax.estimator.native.grid import Ends, Window, corner_log_odds, sigmoid, size_of
from uwbslam_jax.estimator.native.loops import loops, sums
from uwbslam_jax.estimator.native.records import EPS, Belief
from uwbslam_jax.estimator.native.small import inverse3, product, solve3, times
from uwbslam_jax.estimator.native.sweep import Surface, Sweep, thinned
from uwbslam_jax.numerics import gaussian

f32: Any = np.float32


class Match(NamedTuple):
    """Twin: Match; informed is a projector of poses, whose heading is always told."""

    pose: Float[ndarray, "3"]
    information: Float[ndarray, "3 3"]
    informed: Float[ndarray, "3 3"]
    score: float
    known: float
    blurred: float


class Blind(NamedTuple):
    """Twin: Blind."""

    x: float
    y: float
    weight: float


class View(NamedTuple):
    """Twin: View; surface: (3, B). ends, on_wall: (B,) work of whoever looks at the map."""

    sweep: Sweep
    surface: Surface
    blind: Blind
    sigma_l: float
    ends: Ends
    on_wall: Float[ndarray, "B"]


class Walls(NamedTuple):
    """Sums over beams with a surface: of the products of tangents, and how many they are."""

    xx: float
    xy: float
    yy: float
    count: float


@sums
def walls_of(surface: Surface, valid: Float[ndarray, "B"], some: Float[ndarray, "B"]) -> Walls:
    """Args: some: weight of each beam, 0 or 1."""
    tx, ty, bare = surface[0], surface[1], surface[2]
    xx = xy = yy = count = f32(0.0)
    for i in range(some.size):
        x, y = tx[i] * some[i], ty[i] * some[i]
        xx += x * x
        xy += x * y
        yy += y * y
        count += (valid[i] - bare[i]) * some[i]
    return Walls(float(xx), float(xy), float(yy), float(count))


@loops
def blind_direction(walls: Walls) -> Blind:
    few = max(walls.count, 1.0)
    a, b, c = walls.xx / few, walls.xy / few, walls.yy / few
    angle = 0.5 * math.atan2(2 * b, a - c)
    least = max(0.5 * (a + c - math.sqrt((a - c) ** 2 + 4 * b**2)), 0.0)
    weight = (twin._BLIND[1] - least) / (twin._BLIND[1] - twin._BLIND[0])
    weight = min(max(weight, 0.0), 1.0) if walls.count > twin._FEW_SURFACES else 0.0
    return Blind(math.cos(angle), math.sin(angle), weight)


@loops
def seen(blind: Blind, heading: float) -> Float[ndarray, "3 3"]:
    """Projector on what the scan sees of a pose, in the frame of a heading; it always sees the heading."""
    c, s, S = math.cos(heading), math.sin(heading), np.zeros((3, 3))
    x, y = c * blind.x - s * blind.y, s * blind.x + c * blind.y
    S[0, 0], S[1, 1], S[2, 2] = 1.0 - blind.weight * x * x, 1.0 - blind.weight * y * y, 1.0
    S[0, 1] = S[1, 0] = -blind.weight * x * y
    return S


@loops
def share_of_walls(every: Walls, some: Walls, heading: float, beams: float) -> Float[ndarray, "3 3"]:
    """Args: every, some: of all beams, and of those on the walls asked about. beams: with a return."""
    few = twin._BLIND[0] * max(beams, 1.0)
    xx, xy, yy = every.yy + few, -every.xy, every.xx + few  # of normals
    det = xx * yy - xy * xy
    R, share = np.zeros((3, 3)), np.zeros((3, 3))
    R[0, 0] = R[1, 1] = math.cos(heading)
    R[1, 0] = math.sin(heading)
    R[0, 1] = -R[1, 0]
    share[0, 0], share[0, 1] = (yy * some.yy + xy * some.xy) / det, (-yy * some.xy - xy * some.xx) / det
    share[1, 0], share[1, 1] = (-xy * some.yy - xx * some.xy) / det, (xy * some.xy + xx * some.xx) / det
    turned = product(R, share)
    R[0, 1], R[1, 0] = R[1, 0], R[0, 1]
    return product(turned, R)


@sums
def gram_of(pose: Float[ndarray, "3"], size: float, ends: Ends, beams: int) -> Float[ndarray, "4 4"]:
    """Twin: lidar_objective.lidar_gram, of ends whose cells were looked up."""
    px, py, per, one, rows = f32(pose[0]), f32(pose[1]), f32(1.0) / size, f32(1.0), ends.rows
    x, y, at_x, at_y, inside, cell_a, cell_b = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5], rows[6]
    cell_c, cell_d, values = rows[7], rows[8], rows[9]
    xx = xy = xt = xr = yy = yt = yr = tt = tr = rr = f32(0.0)
    for i in range(beams):
        a, b, c, d = sigmoid(cell_a[i]), sigmoid(cell_b[i]), sigmoid(cell_c[i]), sigmoid(cell_d[i])
        low, high = a + at_x[i] * (b - a), c + at_x[i] * (d - c)
        value = low + at_y[i] * (high - low)
        values[i] = value
        gx = ((one - at_y[i]) * (b - a) + at_y[i] * (d - c)) * per * inside[i]
        gy = (high - low) * per * inside[i]
        turn, rest = gx * (y[i] - py) - gy * (x[i] - px), (one - value) * inside[i]
        xx += gx * gx
        xy += gx * gy
        xt -= gx * turn
        xr -= gx * rest
        yy += gy * gy
        yt -= gy * turn
        yr -= gy * rest
        tt += turn * turn
        tr += turn * rest
        rr += rest * rest
    G = np.empty((4, 4))
    G[0, 0], G[1, 1], G[2, 2], G[3, 3] = xx, yy, tt, rr
    G[0, 1] = G[1, 0] = xy
    G[0, 2] = G[2, 0] = xt
    G[0, 3] = G[3, 0] = xr
    G[1, 2] = G[2, 1] = yt
    G[1, 3] = G[3, 1] = yr
    G[2, 3] = G[3, 2] = tr
    return G


@sums
def score_of(valid: Float[ndarray, "B"], ends: Ends) -> tuple[float, float]:
    """Score and known share, of ends whose values are known."""
    total, count, returns, zero = f32(0.0), f32(0.0), f32(0.0), f32(0.0)
    inside, a, b, c, d, value = ends.rows[4], ends.rows[5], ends.rows[6], ends.rows[7], ends.rows[8], ends.rows[9]
    for i in range(valid.size):
        drawn = (a[i] != zero) | (b[i] != zero) | (c[i] != zero) | (d[i] != zero)
        observed = inside[i] if drawn else zero
        total += observed * value[i]
        count += observed
        returns += valid[i]
    return float(total / max(count, f32(1.0))), float(count / max(returns, f32(1.0)))


@loops
def gram(window: Window, k: int, pose: Float[ndarray, "3"], sweep: Sweep, ends: Ends) -> Float[ndarray, "4 4"]:
    corner_log_odds(window, k, pose, sweep, ends)
    return gram_of(pose, size_of(window, k), ends, sweep.rows.shape[1])


@loops
def fit(window: Window, k: int, pose: Float[ndarray, "3"], sweep: Sweep, ends: Ends) -> tuple[float, float]:
    """Score and known share against a level."""
    gram(window, k, pose, sweep, ends)
    return score_of(sweep.rows[2], ends)


class Prior(NamedTuple):
    """What holds an alignment: information I about the mean, what the scan sees T, and by how much a square counts."""

    mean: Float[ndarray, "3"]
    information: Float[ndarray, "3 3"]
    seen: Float[ndarray, "3 3"]
    per_square: float


@loops
def information_of(cov: Float[ndarray, "3 3"]) -> Float[ndarray, "3 3"]:
    """Inverse of a covariance, as numerics.symmetric_root makes it one."""
    scaled, std = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        std[i] = math.sqrt(max(cov[i, i], gaussian._LEAST_VARIANCE))
    for i in range(3):
        for j in range(3):
            scaled[i, j] = cov[i, j] / (std[i] * std[j])
    inverse = inverse3(scaled, gaussian._ROUNDINGS * EPS * 3)
    for i in range(3):
        for j in range(3):
            inverse[i, j] /= std[i] * std[j]
    return inverse


class Effort(NamedTuple):
    """Steps at most, and the length of a step that is the last one [cells of m or rad]."""

    steps: int
    converged: float


@loops
def at_level(window: Window, k: int, view: View, prior: Prior, pose: Float[ndarray, "3"], effort: Effort) -> None:
    """Gauss-Newton at one level, the pose in place; a step that is not finite is not taken, and is the last."""
    T, away, held, slope = prior.seen, np.empty(3), np.empty(3), np.empty(3)
    still = effort.converged * window.size * (1 << k)
    for _ in range(effort.steps):
        for i in range(3):
            away[i] = pose[i] - prior.mean[i]
        # what the scan cannot see is left to the prior
        for i in range(3):
            held[i] = prior.mean[i] + T[i, 0] * away[0] + T[i, 1] * away[1] + T[i, 2] * away[2]
        G = gram(window, k, held, view.sweep, view.ends)
        for i in range(4):  # the jitter of the twin's root
            G[i, i] += _JITTER[0] * max(G[i, i], _JITTER[1])
        H, pull = product(product(T, G), T), times(prior.information, away)
        for i in range(3):
            slope[i] = -(T[i, 0] * G[0, 3] + T[i, 1] * G[1, 3] + T[i, 2] * G[2, 3]) * prior.per_square - pull[i]
            for j in range(3):
                H[i, j] = H[i, j] * prior.per_square + prior.information[i, j]
        move = solve3(H, slope)
        if not math.isfinite(move[0] + move[1] + move[2]):
            return
        for i in range(3):
            pose[i] += move[i]
        if max(abs(move[0]), abs(move[1]), abs(move[2])) < still:
            return


@loops
def align(window: Window, view: View, start: Float[ndarray, "3"], prior: Belief, near: bool) -> Float[ndarray, "3"]:
    pose, sweep = start.copy(), view.sweep
    per_square, finest, effort = 1.0 / view.sigma_l**2, window.levels - 1, Effort(twin._STEPS[0], twin._CONVERGED)
    if near:
        few = thinned(sweep, twin._NEARBY_BEAMS)
        # fewer beams weigh as much as all of them
        per_square *= sweep.rows.shape[1] / few.rows.shape[1]
        view = View(few, view.surface, view.blind, view.sigma_l, view.ends, view.on_wall)
        finest, effort = 0, Effort(twin._NEARBY_STEPS, twin._NEARBY_CONVERGED)
    held = Prior(prior.mean, information_of(prior.cov), seen(view.blind, start[2]), per_square)
    for k in range(finest, -1, -1):
        steps = effort.steps if k == 0 else twin._STEPS[min(k, 2)]
        at_level(window, k, view, held, pose, Effort(steps, effort.converged))
    return pose


@loops
def middle(window: Window) -> int:
    return min(1, window.levels - 1)


@loops
def on_known_wall(ends: Ends, on_wall: Float[ndarray, "B"]) -> None:
    """1 for beams with a return inside the window and next to a wall, of ends that were looked up."""
    zero, inside, a, b, c, d = f32(0.0), ends.rows[4], ends.rows[5], ends.rows[6], ends.rows[7], ends.rows[8]
    for i in range(on_wall.size):
        wall = (a[i] > zero) | (b[i] > zero) | (c[i] > zero) | (d[i] > zero)
        on_wall[i] = inside[i] if wall else zero


@loops
def assess(window: Window, view: View, pose: Float[ndarray, "3"]) -> Match:
    sweep, ends = view.sweep, view.ends
    G = gram(window, 0, pose, sweep, ends)
    score, known = score_of(sweep.rows[2], ends)
    blurred, _ = fit(window, middle(window), pose, sweep, ends)
    on_known_wall(ends, view.on_wall)
    T = seen(blind_direction(walls_of(view.surface, sweep.rows[2], view.on_wall)), pose[2])
    return Match(pose, product(product(T, G), T), T, score, known, blurred)
