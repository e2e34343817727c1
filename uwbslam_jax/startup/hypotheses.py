"""Explanations to start the batch problem of start-up from: which side of the track the beacons are on, and which way
round the geometry of the ranges lies on it.

The track alone places each beacon on one of two sides; the ranges between beacons tie the sides together. Where LiDAR
sees nothing along a corridor the track is of little use, and the ranges' own geometry (all nodes among themselves) is
laid on what the track does say, in every way that fits it.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise, product

import numpy as np

from uwbslam_jax.numerics import cost_of, multilaterate, rotation_matrix, scaled, soften, turned
from uwbslam_jax.startup.placement import LAST, Placement, Problem

_ANGLES, _WAYS = 72, 2
"""Angles that are looked at, one every 5 degrees; so many ways of laying the ranges' geometry on the track are tried,
for each reflection."""
_PATH_SIGMA = 0.07
"""How well ranges place the robot between beacons that are known [m]."""
_SIDES = 3
"""So many choices of the sides are tried."""
_TRY_ALL, _TRIALS = 10, 16
"""Of more beacons than so many not all choices are looked at, but those that so many random ones lead to."""
_MENDED, _GAIN = 3, 1.0
"""So many of the best minima are looked through for a beacon that had better be elsewhere [minima], by so much at least
[log-likelihood]."""
_SAME_M = 0.3
"""Beacons closer than this are the same place."""


def explanations(problem: Problem) -> list[Placement]:
    """Distinct minima of the batch problem, the best first; see the module's first lines.

    Minima are distinct when at least half of their beacons are elsewhere: what only one beacon's side decides is for
    keep_unique.
    """
    starts = [(beacons, problem.track) for beacons in track_sides(problem)]
    starts += laid_on_track(problem)
    found = [problem.minimise(beacons, poses) for beacons, poses in starts]
    best = min(found, key=lambda p: p.cost)
    # every start may have slid into one valley: ask the exact mirror images as well
    found += [problem.minimise(beacons, poses) for beacons, poses in problem.images(best)]
    found.sort(key=lambda p: p.cost)
    found = [*(_mended(problem, p) for p in found[:_MENDED]), *found[_MENDED:]]
    found.sort(key=lambda p: p.cost)
    distinct: list[Placement] = []
    for placement in found:
        if all(np.mean(placement.apart(other) > _SAME_M) >= 0.5 for other in distinct):
            distinct.append(placement)
    return distinct


def _mended(problem: Problem, placement: Placement) -> Placement:
    """The placement with each beacon that slid into a place of its own, or out of the world, where its ranges to the
    track and to the other beacons put it: a range that is far off pulls no more."""
    for _ in problem.slots:
        best = min(_elsewhere(problem, placement), key=lambda other: other[0])
        if best[0] > placement.cost - _GAIN:
            break
        moved = problem.minimise(best[1], placement.poses, placement.off)
        if moved.cost > placement.cost - _GAIN:
            break
        placement = moved
    return placement


def _elsewhere(problem: Problem, placement: Placement) -> Iterator[tuple[float, np.ndarray]]:
    """Costs and beacons (B, 2) with one of them at another place."""
    antenna, ends, pairs = problem.ranges.antenna(placement.poses), problem.pairs.ends, problem.pairs
    rows = problem.rows(placement.poses[0], LAST)
    for b in range(len(problem.slots)):
        mine, first, second = problem.ranges.to == b, ends[:, 0] == b, ends[:, 1] == b
        anchors = [antenna[mine], placement.beacons[ends[first, 1]], placement.beacons[ends[second, 0]]]
        distance = [problem.ranges.distance[mine], pairs.flat[first], pairs.flat[second]]
        sigma = [problem.ranges.sigma[mine], pairs.sigma[first], pairs.sigma[second]]
        for spot in multilaterate(*map(np.concatenate, (anchors, distance, sigma))):
            beacons = placement.beacons.copy()
            beacons[b] = spot
            yield cost_of(rows, problem.joined(placement.poses, beacons, placement.off)), beacons


def track_sides(problem: Problem) -> list[np.ndarray]:
    """Beacon positions (B, 2) by the track: the sides that fit best what was ranged along it and between the beacons,
    the next best ones, and the other side for all of the best."""
    antenna = problem.ranges.antenna(problem.track)
    spots = np.zeros((len(problem.slots), 2, 2))
    misfit = np.zeros((len(problem.slots), 2))
    for b in range(len(problem.slots)):
        mine = problem.ranges.to == b
        spots[b] = multilaterate(antenna[mine], problem.ranges.distance[mine], problem.ranges.sigma[mine])
        apart = np.linalg.norm(antenna[mine, None] - spots[b], axis=2)
        off = (apart - problem.ranges.distance[mine, None]) / problem.ranges.sigma[mine, None]
        misfit[b] = 0.5 * (soften(off)[0] ** 2).sum(0)
    choices = _best_sides(problem, spots, misfit)
    every = np.arange(len(spots))
    return [spots[every, choice] for choice in [*choices, 1 - choices[0]]]


def _best_sides(problem: Problem, spots: np.ndarray, misfit: np.ndarray) -> list[np.ndarray]:
    """For each beacon which of its two places (B, 2, 2) it is at, in the ways that fit best. misfit: (B, 2) of what was
    ranged along the track."""
    count = len(spots)
    if count <= _TRY_ALL:
        tried = np.array(list(product((0, 1), repeat=count)))
    else:
        rng = np.random.default_rng(0)
        starts = [np.argmin(misfit, axis=1), *rng.integers(0, 2, (_TRIALS, count))]
        tried = np.unique([_descended(problem, spots, misfit, start) for start in starts], axis=0)
    cost = _side_cost(problem, spots, misfit, tried)
    return list(tried[np.argsort(cost, kind="stable")[:_SIDES]])


def _descended(problem: Problem, spots: np.ndarray, misfit: np.ndarray, choice: np.ndarray) -> np.ndarray:
    """Sides from which no single beacon's other side is better."""
    while True:
        flipped = np.vstack([choice, choice ^ np.eye(len(choice), dtype=choice.dtype)])
        cost = _side_cost(problem, spots, misfit, flipped)
        if cost.argmin() == 0:
            return choice
        choice = flipped[cost.argmin()]


def _side_cost(problem: Problem, spots: np.ndarray, misfit: np.ndarray, choices: np.ndarray) -> np.ndarray:
    """(C,) misfit of ranges along the track and between beacons for choices (C, B)."""
    every = np.arange(len(spots))
    cost = misfit[every, choices].sum(1)
    if len(problem.pairs.ends):
        at = spots[every, choices]
        apart = np.linalg.norm(at[:, problem.pairs.ends[:, 0]] - at[:, problem.pairs.ends[:, 1]], axis=2)
        # the track is not exact, and what it errs by is in the places; that two beacons at rest are as far apart as
        # hundreds of ranges say is no outlier
        sigma = np.hypot(problem.pairs.sigma, _SAME_M)
        cost = cost + (np.abs(apart - problem.pairs.flat) / sigma).sum(1)
    return cost


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
    i, j = problem.pairs.ends.T
    if count < 3 or len(i) < 2 * count - 3 or len(np.union1d(i, j)) < count:
        return None
    spots = scaled(count, i, j, problem.pairs.flat)
    for _ in range(10):
        u = spots[i] - spots[j]
        d = np.maximum(np.linalg.norm(u, axis=1), 1e-6)
        r, scale = soften((d - problem.pairs.flat) / problem.pairs.sigma)
        J = np.zeros((len(d), 2 * count))
        rows = np.arange(len(d))
        for axis in range(2):
            pull = scale / problem.pairs.sigma * u[:, axis] / d
            J[rows, 2 * i + axis], J[rows, 2 * j + axis] = pull, -pull
        spots = spots - np.linalg.solve(J.T @ J + 1e-3 * np.eye(2 * count), J.T @ r).reshape(-1, 2)
    return spots


def _path(problem: Problem, beacons: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intervals (P,) in which the robot heard three beacons or more, and where it was among them (P, 2) [m]."""
    keys, path = [], []
    for k in range(len(problem.track)):
        mine = problem.ranges.at == k
        if mine.sum() < 3:
            continue
        spots = multilaterate(
            beacons[problem.ranges.to[mine]], problem.ranges.distance[mine], problem.ranges.sigma[mine]
        )
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
            root = np.linalg.inv(problem.edges.roots[k])
            R = rotation_matrix(problem.track[k, 2])
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
    antenna = problem.ranges.antenna(poses)
    return np.array([antenna[problem.ranges.at == k].mean(0) for k in keys])


def _laid(problem: Problem, keys: np.ndarray, path: np.ndarray, beacons: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Beacons and poses of a path among beacons that was turned onto the track: moved to where the track began."""
    offset = path - _centres(problem, problem.track, keys)
    along = np.arange(len(problem.track))
    poses = problem.track.copy()
    for axis in range(2):
        poses[:, axis] += np.interp(along, keys, offset[:, axis])
    shift = problem.track[0, :2] - poses[0, :2]
    poses[:, :2] += shift
    return beacons + shift, poses
