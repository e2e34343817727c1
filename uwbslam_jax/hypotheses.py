"""Explanations to start the batch problem of start-up from: which side of the track the beacons are on, and which way
round the geometry of the ranges lies on it.

The track alone places each beacon on one of two sides; the ranges between beacons tie the sides together. Where LiDAR
sees nothing along a corridor the track is of little use, and the ranges' own geometry (all nodes among themselves) is
laid on what the track does say, in every way that fits it.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from uwbslam_jax.keyframes import turned
from uwbslam_jax.multilateration import multilaterate, soften
from uwbslam_jax.placement import Placement, Problem, rotation

_ANGLES = 72
_WAYS = 2
"""So many ways of laying the ranges' geometry on the track are tried, for each reflection."""
_PATH_SIGMA = 0.07
"""How well ranges place the robot between beacons that are known [m]."""
_SAME_M = 0.3
"""Beacons closer than this are the same place."""


def explanations(problem: Problem, bias_sigma: float) -> list[Placement]:
    """Distinct minima of the batch problem, the best first; see the module's first lines.

    Minima are distinct when at least half of their beacons are elsewhere: what only one beacon's side decides is for
    keep_unique.
    """
    starts = [(beacons, problem.track) for beacons in track_sides(problem)]
    starts += laid_on_track(problem)
    found = [problem.minimise(beacons, poses, bias_sigma) for beacons, poses in starts]
    best = min(found, key=lambda p: p.cost)
    # every start may have slid into one valley: ask the exact mirror images as well
    found += [problem.minimise(beacons, poses, bias_sigma) for beacons, poses in problem.images(best)]
    found.sort(key=lambda p: p.cost)
    distinct: list[Placement] = []
    for placement in found:
        if all(np.mean(placement.apart(other) > _SAME_M) >= 0.5 for other in distinct):
            distinct.append(placement)
    return distinct


def track_sides(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Beacon positions (B, 2) by the track: the sides that fit the beacons' own ranges best, and the other ones."""
    antenna = problem.antenna(problem.track)
    near, far = np.zeros((2, len(problem.slots), 2))
    for b in range(len(problem.slots)):
        mine = problem.to == b
        near[b], far[b] = multilaterate(antenna[mine], problem.distance[mine], problem.sigma[mine])
    choice = _consistent_sides(problem, near, far)
    return np.where(choice[:, None], far, near), np.where(choice[:, None], near, far)


def _consistent_sides(problem: Problem, near: np.ndarray, far: np.ndarray) -> np.ndarray:
    """For each beacon, whether its second candidate is the one that agrees with the ranges between beacons."""
    count = len(problem.slots)
    if not len(problem.pair):
        return np.zeros(count, bool)
    rng = np.random.default_rng(0)
    best, best_cost = np.zeros(count, bool), np.inf
    for trial in range(8):
        choice = np.zeros(count, bool) if trial == 0 else rng.random(count) < 0.5
        cost = _pair_cost(problem, np.where(choice[:, None], far, near))
        improved = True
        while improved:
            improved = False
            for b in range(count):
                choice[b] ^= True
                other = _pair_cost(problem, np.where(choice[:, None], far, near))
                if other < cost - 1e-9:
                    cost, improved = other, True
                else:
                    choice[b] ^= True
        if cost < best_cost:
            best, best_cost = choice.copy(), cost
    return best


def _pair_cost(problem: Problem, beacons: np.ndarray) -> float:
    d = np.linalg.norm(beacons[problem.pair[:, 0]] - beacons[problem.pair[:, 1]], axis=1)
    return float(np.abs(d - problem.pair_distance).sum())


def laid_on_track(problem: Problem) -> list[tuple[np.ndarray, np.ndarray]]:
    """Beacons and poses from the ranges' own geometry, turned and mirrored onto the track in the ways that fit it;
    empty where the ranges alone have no geometry (beacons that do not range to each other)."""
    relative = _relative_geometry(problem)
    if relative is None:
        return []
    keys, path = _path(problem, relative)
    if len(keys) < 4:
        return []
    starts = []
    for side in (1.0, -1.0):
        flip = np.array([1.0, side])
        for theta in _ways(problem, keys, path * flip):
            starts.append(_laid(problem, keys, turned(theta, path * flip), turned(theta, relative * flip)))
    return starts


def _relative_geometry(problem: Problem) -> np.ndarray | None:
    """(B, 2) positions of the beacons from the ranges between them: classical scaling, then least squares."""
    count = len(problem.slots)
    if count < 3 or len(problem.pair) < 2 * count - 3:
        return None
    distance = np.full((count, count), np.inf)
    np.fill_diagonal(distance, 0.0)
    i, j = problem.pair.T
    distance[i, j] = distance[j, i] = problem.pair_distance
    for k in range(count):  # what is not heard is bounded by a way round
        distance = np.minimum(distance, distance[:, k, None] + distance[None, k, :])
    if not np.isfinite(distance).all():
        return None
    centre = np.eye(count) - 1.0 / count
    values, vectors = np.linalg.eigh(-0.5 * centre @ distance**2 @ centre)
    spots = vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 0.0))
    for _ in range(10):
        u = spots[i] - spots[j]
        d = np.maximum(np.linalg.norm(u, axis=1), 1e-6)
        r, scale = soften((d - problem.pair_distance) / problem.pair_sigma)
        J = np.zeros((len(d), 2 * count))
        rows = np.arange(len(d))
        for axis in range(2):
            pull = scale / problem.pair_sigma * u[:, axis] / d
            J[rows, 2 * i + axis], J[rows, 2 * j + axis] = pull, -pull
        spots = spots - np.linalg.solve(J.T @ J + 1e-3 * np.eye(2 * count), J.T @ r).reshape(-1, 2)
    return spots


def _path(problem: Problem, beacons: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intervals (P,) in which the robot heard three beacons or more, and where it was among them (P, 2) [m]."""
    keys, path = [], []
    for k in range(len(problem.track)):
        mine = problem.at == k
        if mine.sum() < 3:
            continue
        spots = multilaterate(beacons[problem.to[mine]], problem.distance[mine], problem.sigma[mine])
        # beacons nearly on a line leave two places: the robot is where it was
        near = spots[0] if not path else min(spots, key=lambda s: float(np.linalg.norm(s - path[-1])))
        better = spots[0] if len(problem.slots) > 3 else near
        keys.append(k)
        path.append(better)
    return np.array(keys, int), np.array(path).reshape(-1, 2)


def _ways(problem: Problem, keys: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Angles by which the path among the beacons fits the steps of the track: the best local minima."""
    track = _centres(problem, problem.track, keys)
    moved, want = np.diff(path, axis=0), np.diff(track, axis=0)
    cov = np.zeros((len(moved), 2, 2))
    for m, (a, b) in enumerate(pairwise(keys)):
        for k in range(a, b):  # steps add up
            root = np.linalg.inv(problem.roots[k])
            R = rotation(problem.track[k, 2])
            cov[m] += R @ (root @ root.T)[:2, :2] @ R.T
    weight = np.linalg.inv(cov + 2 * _PATH_SIGMA**2 * np.eye(2))
    angles = np.linspace(0.0, 2 * np.pi, _ANGLES, endpoint=False)
    e = turned(angles[:, None], moved[None]) - want[None]
    whitened = np.einsum("tmi,mij,tmj->tm", e, weight, e)
    cost = np.sum(whitened / (1.0 + whitened / 16.0), axis=1)  # a wrong place now and then must not decide
    valley = np.flatnonzero((cost <= np.roll(cost, 1)) & (cost <= np.roll(cost, -1)))
    return angles[valley[np.argsort(cost[valley])[:_WAYS]]]


def _centres(problem: Problem, poses: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """(P, 2) mean place of the antenna over the ranges of each interval."""
    antenna = problem.antenna(poses)
    return np.array([antenna[problem.at == k].mean(0) for k in keys])


def _laid(problem: Problem, keys, path: np.ndarray, beacons: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Beacons and poses of a path among beacons that was turned onto the track: moved to where the track began."""
    offset = path - _centres(problem, problem.track, keys)
    along = np.arange(len(problem.track))
    poses = problem.track.copy()
    for axis in range(2):
        poses[:, axis] += np.interp(along, keys, offset[:, axis])
    shift = problem.track[0, :2] - poses[0, :2]
    poses[:, :2] += shift
    return beacons + shift, poses
