"""A short memory of one node's ranges to nodes of known place, and what they say: it rests, it is carried, it is
biased. Host arrays only; nothing here changes a state.

A row is (time [s], other slot, x, y of the robot's antenna [m], distance in the plane [m], normalised innovation);
where the other node is a beacon, its place is looked up when it is needed, because it gets better all the time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from uwbslam_jax.numerics import (
    DECIDED,
    RANGE_FLOOR_M,
    SIGMA_ENOUGH_M,
    Spot,
    fit,
    mirrored,
    misfit,
    multilaterate,
    settle,
)

TIME, OTHER, X, Y, DISTANCE, NORMALISED = range(6)
"""Columns of a sighting: when [s], the other node, where it was [m], distance [m], normalised innovation."""
MEMORY_S = 40.0
"""Rows are kept this long."""
_WINDOWS_S = (40.0, 20.0, 10.0, 5.0, 2.0)
"""A node that may have come to rest a while ago is looked for over these last times, the longest first."""
_LONG_S = 600.0
"""And over so long before, where it has been ranged for longer and is not placed yet: one that is heard seldom, or only
when the robot passes by, tells where it is over several passes [s]."""
_LONG_STEP_M, _LONG_MOST = 0.3, 100
"""Of what is older than `MEMORY_S` one range is kept in so much of the way [m], and so many of them."""
_HELD_M = 20.0
"""Farther back the track is held by the beacons, and errs by no more than over so much of the way: 0.1 m."""
_GROUP_S = 0.5
"""Ranges to one node within this time are averaged."""
_HEADING_WALK = 0.002
"""Random walk of the heading error of the robot's own track with its way [rad/m^0.5]."""
_TRACK_FLOOR_M = 0.05
"""What that comes to in a velocity, which is seen over some seconds."""
_FEWEST_ROWS, _FEWEST_GROUPS = 12, 3
"""Rows and groups that a fit needs: a velocity has four unknowns, and a wrong range must show."""
_SPEED_SIGMA = 0.1
"""A node is known to rest when its velocity is known this well and is not different from zero [m/s]."""
_SLOW = 0.02
"""A velocity this small is none: the robot's own track drifts as fast [m/s]."""
_RECENT_S, _FEWEST_JUDGED = 1.0, 5
"""A node is judged by the ranges of the last second [s], and by no fewer than this."""
_CARRIED_SIGMA_M = 0.3
"""A carried node is followed from a place that is known this well: the filter is linear within it [m]."""
_WALL_COST = 6.0
"""Log-likelihood that it costs to say that a wall has come between two nodes."""
_WALL_M = 3.0
"""No wall makes ranges too long by more than this, for long."""
_NOISE = 3.0
"""Sum of squares of whitened residuals beyond its mean that is still taken for noise [standard deviations]."""
_SUPPORTS = 0.5
"""Share of `DECIDED` by which an explanation must still win without the node that speaks for it the loudest."""


class Sightings:
    """Rows of one node, in order of time.

    Attributes:
      count: rows ever added.
    """

    def __init__(self) -> None:
        self.count = 0
        self._chunks: list[np.ndarray] = []
        self._older = np.zeros((0, 6))  # some of those before the chunks

    def add(self, rows: np.ndarray) -> None:
        """Newer rows (R, 6)."""
        self._chunks.append(rows)
        self.count += len(rows)

    @property
    def reach_back(self) -> bool:
        """Whether there are rows of long ago."""
        return len(self._older) > 0

    def since(self, time: float) -> np.ndarray:
        """Rows (R, 6) from a time on [s]."""
        rows = np.concatenate([self._older, *(c for c in self._chunks if c[-1, TIME] >= time)])
        return rows[rows[:, TIME] >= time]

    def forget(self, *, before: float = -np.inf, other: int | None = None) -> None:
        """Drop what is older than a time [s], and all rows to one node."""
        kept = [self._older[self._older[:, TIME] >= before], *(c for c in self._chunks if c[-1, TIME] >= before)]
        if other is not None:
            kept = [c[c[:, OTHER] != other] for c in kept]
        self._older, self._chunks = kept[0], [c for c in kept[1:] if len(c)]

    def condense(self, now: float) -> None:
        """Of what is older than the memory only some of the robot's ranges are left, spread over its way."""
        parts = [np.split(c, [np.searchsorted(c[:, TIME], now - MEMORY_S)]) for c in self._chunks]
        self._chunks = [late for _, late in parts if len(late)]
        kept = list(self._older)
        for row in (row for early, _ in parts for row in early if row[OTHER] == 0):
            if not kept or np.hypot(row[X] - kept[-1][X], row[Y] - kept[-1][Y]) > _LONG_STEP_M:
                kept.append(row)
        kept = [row for row in kept if row[TIME] >= now - _LONG_S]
        while len(kept) > _LONG_MOST:
            kept = kept[::2]
        self._older = np.array(kept).reshape(-1, 6)

    def carry(self, move: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
        """The track has moved. move: from times (R,) [s] and places (R, 2) on it to the new places (R, 2) [m]."""
        for rows in (self._older, *self._chunks):
            own = rows[:, OTHER] == 0
            rows[np.ix_(own, [X, Y])] = move(rows[own, TIME], rows[np.ix_(own, [X, Y])])


class Known(NamedTuple):
    """What rows are compared with.

    Attributes:
      places: (K, 2) of the nodes now [m].
      variance: (K,) largest variance of each place [m^2].
      trusted: (K,) whether a node may serve as an anchor.
      sigma_n: of a range between quiet nodes [m].
      noise: (K,) of this node's ranges to each other one, by how they scatter lately [m].
      now: the present [s].
    """

    places: np.ndarray
    variance: np.ndarray
    trusted: np.ndarray
    sigma_n: float
    noise: np.ndarray
    now: float

    def sigma(self, rows: np.ndarray) -> np.ndarray:
        """(R,) standard deviation of each row's range [m]."""
        return self.noise[rows[:, OTHER].astype(int)]


def _since(sightings: Sightings, known: Known, seconds: float) -> np.ndarray:
    """The newest rows to nodes that may serve as anchors."""
    rows = sightings.since(known.now - seconds)
    return rows[known.trusted[rows[:, OTHER].astype(int)]]


def anchors(rows: np.ndarray, known: Known) -> np.ndarray:
    """(R, 2) places that the rows range to."""
    other = rows[:, OTHER].astype(int)
    return np.where((other == 0)[:, None], rows[:, [X, Y]], known.places[other])


def resting_place(sightings: Sightings, known: Known) -> tuple[Spot, np.ndarray] | None:
    """Where the node rests and the averaged rows that say so; None where they do not say it, or leave two places."""
    windows = (_LONG_S, *_WINDOWS_S) if sightings.reach_back else _WINDOWS_S
    for window in windows:
        rows = _since(sightings, known, window)
        if len(rows) < _FEWEST_ROWS:
            return None
        if rows[-1, TIME] - rows[0, TIME] < 0.5 * window and window not in (_LONG_S, _WINDOWS_S[-1]):
            continue  # no more than a shorter window has
        # two beacons at rest have one distance, however often it is measured
        groups, sigma = _averaged(rows, known, np.where(rows[:, OTHER] == 0, rows[:, TIME] // _GROUP_S, 0.0))
        if len(groups) < _FEWEST_GROUPS:
            continue
        spots = _resting_spots(groups, sigma, known)
        newest = rows[rows[:, TIME] >= known.now - MEMORY_S]  # many of long ago must not speak louder than they do
        agree = window != _LONG_S or not len(newest) or _explains(spots[0], newest, known)
        if agree and _explains(spots[0], groups, known) and _rests(rows, known, spots[0]):
            # a shorter window would only know less
            return (spots[0], groups) if _certain(spots, known.sigma_n) else None
    return None


def _resting_spots(groups: np.ndarray, sigma: np.ndarray, known: Known) -> list[Spot]:
    """Places that a node at rest may be at, the likeliest first."""
    at, distance = anchors(groups, known), groups[:, DISTANCE]
    common = _common_error(groups, known)
    near, far = multilaterate(at, distance, np.sqrt(sigma**2 + np.diag(common)))
    first = settle(near, at, distance, sigma, common)
    guesses = [far, mirrored(first.place, at)]
    robot = groups[:, OTHER] == 0
    if np.sum(robot) > 1:
        guesses.append(mirrored(first.place, at[robot]))
    found = [first, *(settle(guess, at, distance, sigma, common) for guess in guesses)]
    return sorted(found, key=lambda spot: spot.cost)


def _certain(spots: list[Spot], sigma_n: float) -> bool:
    """Whether the first of some places is known well, and likelier by far than any other.

    As well as one range tells is well enough, however coarse the radio is.
    """
    best = spots[0]
    apart = [s for s in spots if np.linalg.norm(s.place - best.place) > 3 * best.sigma + RANGE_FLOOR_M]
    return best.sigma < max(SIGMA_ENOUGH_M, sigma_n) and all(other.cost - best.cost > DECIDED for other in apart)


def _explains(spot: Spot, groups: np.ndarray, known: Known) -> bool:
    left = np.abs(np.linalg.norm(spot.place - anchors(groups, known), axis=1) - groups[:, DISTANCE])
    return bool(np.median(left / known.sigma(groups)) < 3)


def _rests(rows: np.ndarray, known: Known, spot: Spot) -> bool:
    """Whether the rows leave no room for a velocity."""
    groups, sigma = _averaged(rows, known, rows[:, TIME] // _GROUP_S)
    at, distance, time = anchors(groups, known), groups[:, DISTANCE], groups[:, TIME] - known.now
    sigma = np.hypot(sigma, np.where(groups[:, OTHER] == 0, _TRACK_FLOOR_M, 0.0))
    moving = fit(spot.place[None], time, at, distance, sigma, carried=True)[0]
    speed = float(np.linalg.norm(moving.velocity))
    return moving.speed_sigma < _SPEED_SIGMA and speed < 3 * moving.speed_sigma + _SLOW


def _common_error(groups: np.ndarray, known: Known) -> np.ndarray:
    """(R, R) covariance of the errors of the groups' anchors, the same in x and y [m^2].

    A beacon's is its own. The robot's track, as seen from where it is now, bends like the integral of a heading that
    drifts at random with the way: cov = q^2 m^2 (3 M - m) / 6 for ways m <= M back from now, at most `_HELD_M`.
    """
    other = groups[:, OTHER]
    common = np.where(other[:, None] == other, known.variance[other.astype(int)], 0.0)
    robot = np.flatnonzero(other == 0)
    steps = np.hypot(*np.diff(groups[robot][:, [X, Y]], axis=0).T)
    back = np.minimum(np.append(np.cumsum(steps[::-1])[::-1], 0.0)[: len(robot)], _HELD_M)
    near, far = np.minimum(back[:, None], back), np.maximum(back[:, None], back)
    common[np.ix_(robot, robot)] = _HEADING_WALK**2 * near**2 * (3 * far - near) / 6
    return common


def carried_place(sightings: Sightings, known: Known) -> tuple[Spot, np.ndarray] | None:
    """Where a node is that is being carried, and the rows that say so; None where that is not certain."""
    rows = _since(sightings, known, _RECENT_S)
    if len(rows) < _FEWEST_ROWS or rows[-1, TIME] - rows[0, TIME] < 0.5 * _RECENT_S:
        return None
    spot, *others = _moving_fits(rows, known)
    if spot.sigma > _CARRIED_SIGMA_M or (others and others[0].cost - spot.cost < DECIDED):
        return None
    if np.linalg.norm(spot.velocity) < 3 * spot.speed_sigma + _SPEED_SIGMA:
        return None  # it may well rest: some more ranges will tell
    return spot, rows


def _moving_fits(rows: np.ndarray, known: Known, also: np.ndarray | None = None) -> list[Spot]:
    at, distance, time = anchors(rows, known), rows[:, DISTANCE], rows[:, TIME] - known.now
    sigma = np.sqrt(known.sigma(rows) ** 2 + known.variance[rows[:, OTHER].astype(int)])
    starts = np.stack(multilaterate(at, distance, sigma))
    if also is not None:
        starts = np.concatenate([starts, also[None]])
    return fit(starts, time, at, distance, sigma, carried=True)


class Verdict(NamedTuple):
    """Whether a node's newest ranges still fit its place.

    Attributes:
      fits: they do.
      carried: the motion that explains them instead, None where there is none; rows: that say so.
      bias: median of measured minus expected [m]; 0 where what is left is noise.
    """

    fits: bool
    carried: Spot | None
    rows: np.ndarray
    bias: float


def judge(sightings: Sightings, known: Known, slot: int, velocity: np.ndarray) -> Verdict:
    """Whether a node is where the state has it, by its ranges of the last second.

    It was carried off when a motion explains them better than its place does, by the word of more than one other
    node, and better than one bias common to all: a node whose clock is off spoils every range to it, and one that
    hears such a node must not be blamed.
    """
    rows = _since(sightings, known, _RECENT_S)
    at, distance, time = anchors(rows, known), rows[:, DISTANCE], rows[:, TIME] - known.now
    sigma = np.sqrt(known.sigma(rows) ** 2 + known.variance[slot] + known.variance[rows[:, OTHER].astype(int)])
    here = known.places[slot] + time[:, None] * velocity
    rests = not np.any(velocity)
    off = distance - np.linalg.norm(here - at, axis=1)
    if len(rows) < _FEWEST_JUDGED or _is_noise(here, at, off / sigma, sigma, time, np.zeros(1, int))[0]:
        return Verdict(True, None, rows, 0.0)
    bias = float(np.median(off))
    as_it_is = misfit(here, at, distance, sigma)
    if as_it_is.sum() < DECIDED:
        return Verdict(True, None, rows, bias)
    biased = as_it_is - misfit(here, at, distance - bias, sigma)
    spots = _moving_fits(rows, known, known.places[slot])
    best = [spot for spot in spots if spot.cost - spots[0].cost < DECIDED]
    if not best:  # a state that is not finite any more, as the paper's own steps may end up with
        return Verdict(True, None, rows, bias)
    spot = min(best, key=lambda s: float(np.linalg.norm(s.place - known.places[slot])))
    held = _unless_walled(as_it_is, off, rows) if rests else as_it_is
    moved = held - misfit(spot.place + time[:, None] * spot.velocity, at, distance, sigma)
    several = len(np.unique(rows[:, OTHER])) > 1  # a second of ranges to one node leaves a motion open
    if several and _decides(moved, rows) and moved.sum() > biased.sum() + DECIDED:
        return Verdict(False, spot, rows, bias)
    return Verdict(not (_decides(moved, rows) or _decides(biased, rows)), None, rows, bias)


def calm(sightings: Mapping[int, Sightings], known: Known, noise: np.ndarray, velocities: np.ndarray) -> set[int]:
    """Those of some slots of which `judge` would say at a glance that they are where the state has them, or have too
    few ranges to tell. So much cheaper than to judge each that it is asked first.

    Args:
      known: of any node. noise: (K, K) of each pair's ranges, see Known [m]. velocities: (K, 2) of the nodes [m/s].
    """
    recent = {slot: _since(seen, known, _RECENT_S) for slot, seen in sightings.items()}
    quiet = {slot for slot, rows in recent.items() if len(rows) < _FEWEST_JUDGED}
    told = {slot: rows for slot, rows in recent.items() if slot not in quiet}
    if not told:
        return quiet
    rows, counts = np.concatenate(list(told.values())), [len(rows) for rows in told.values()]
    slot, other, time = np.repeat(list(told), counts), rows[:, OTHER].astype(int), rows[:, TIME] - known.now
    sigma = np.sqrt(noise[slot, other] ** 2 + known.variance[slot] + known.variance[other])
    here, at = known.places[slot] + time[:, None] * velocities[slot], anchors(rows, known)
    off = rows[:, DISTANCE] - np.linalg.norm(here - at, axis=1)
    fits = _is_noise(here, at, off / sigma, sigma, time, np.cumsum([0, *counts[:-1]]))
    return quiet | {slot for slot, fit in zip(told, fits, strict=True) if fit}


def _is_noise(
    here: np.ndarray, at: np.ndarray, whitened: np.ndarray, sigma: np.ndarray, time: np.ndarray, first: np.ndarray
) -> np.ndarray:
    """(G,) whether rows scatter about a place (R, 2) as their noise lets them, and neither another place, nor a
    velocity, nor a bias could explain them much better: what it can gain is that of the linear problem. Of several
    nodes at once; first: (G,) where the rows of each begin."""
    count = np.diff(np.append(first, len(whitened)))
    square = np.add.reduceat(whitened**2, first)
    u = here - at
    u = u / np.maximum(np.sqrt((u**2).sum(1)), 1e-6)[:, None]
    J = np.column_stack([u, time[:, None] * u, np.ones(len(u))]) / sigma[:, None]
    A = np.add.reduceat(J[:, :, None] * J[:, None, :], first)
    pull = np.add.reduceat(J * whitened[:, None], first)
    gain = np.sum(pull * np.linalg.solve(A + 1e-6 * np.eye(5), pull[:, :, None])[:, :, 0], axis=1)
    return (square <= count + _NOISE * np.sqrt(2.0 * count)) & (gain < DECIDED)


def resting_elsewhere(sightings: Sightings, known: Known, slot: int) -> tuple[Spot, np.ndarray] | None:
    """Another place than the state's that a node rests at by the ranges of some seconds, by the same rules as in
    `judge`; None where there is none. This serves where the ranges of one second leave a motion open."""
    found = resting_place(sightings, known)
    if found is None:
        return None
    spot, rows = found
    at, distance, here = anchors(rows, known), rows[:, DISTANCE], known.places[slot]
    sigma = known.sigma(rows)
    away = float(np.linalg.norm(spot.place - here))
    if away < 4 * np.hypot(spot.sigma, np.sqrt(known.variance[slot])) + RANGE_FLOOR_M:
        return None
    as_it_is = misfit(here, at, distance, sigma)
    bias = float(np.median(distance - np.linalg.norm(here - at, axis=1)))
    biased = as_it_is - misfit(here, at, distance - bias, sigma)
    off = distance - np.linalg.norm(here - at, axis=1)
    moved = _unless_walled(as_it_is, off, rows) - misfit(spot.place, at, distance, sigma)
    return found if _decides(moved, rows) and moved.sum() > biased.sum() + DECIDED else None


def _unless_walled(cost: np.ndarray, off: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Costs (R,) of rows at a place, where those to one node that are too long by `off` (R,) [m] cost no more than
    saying that a wall has come in between."""
    cost = cost.copy()
    for other in np.unique(rows[:, OTHER]):
        mine = rows[:, OTHER] == other
        if 0 < np.median(off[mine]) < _WALL_M:
            cost[mine] *= min(1.0, _WALL_COST / max(float(cost[mine].sum()), 1e-9))
    return cost


def _decides(gain: np.ndarray, rows: np.ndarray) -> bool:
    """Whether gains of log-likelihood by row decide for an explanation, and still do without any one other node."""
    by_node = [float(gain[rows[:, OTHER] == other].sum()) for other in np.unique(rows[:, OTHER])]
    total = sum(by_node)
    return total > DECIDED and (len(by_node) == 1 or total - max(by_node) > _SUPPORTS * DECIDED)


def _averaged(rows: np.ndarray, known: Known, key: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows to one node and of one key averaged, in order of node and key, and the standard deviation of each."""
    _, which, count = np.unique(np.stack([rows[:, OTHER], key]), axis=1, return_inverse=True, return_counts=True)
    parts = np.split(rows[np.argsort(which.ravel(), kind="stable")], np.cumsum(count)[:-1])
    groups = np.stack([np.append(part[:, :DISTANCE].mean(0), np.median(part[:, DISTANCE:], axis=0)) for part in parts])
    # a median of n is as good as a mean of 0.64 n
    other = groups[:, OTHER].astype(int)
    variance = known.sigma_n**2 / np.maximum(0.64 * count, 1.0) + RANGE_FLOOR_M**2
    # what makes a pair scatter more than its radios do does not average out, nor do many averages of it
    excess = np.maximum(known.noise[other] ** 2 - known.sigma_n**2, 0.0)
    return groups, np.sqrt(variance + excess * np.sum(other[:, None] == other, axis=1))
