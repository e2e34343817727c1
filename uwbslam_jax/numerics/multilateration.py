"""One node from ranges to known points, at rest or carried: its best place, the second best, how certain (float64)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import shortest_path

from uwbslam_jax.numerics.robust import _SOFT, DECIDED, RANGE_FLOOR_M, SIGMA_ENOUGH_M, soften

WALK_M_S = 1.0
"""Standard deviation of each component of the velocity of somebody who carries a beacon."""
_APART_M = 0.5
"""Two places closer than this are one."""
_AT_REST = 1e-6
"""The same of a node at rest: none, but not singular [m/s]."""
_MOVES = 12
"""Gauss-Newton steps, of 2 m at most: enough for a place within a radio's reach."""
_ENOUGH = 1e-3
"""A place is settled when a move gains less log-likelihood than this."""


class Spot(NamedTuple):
    """Where a node is by its ranges.

    Attributes:
      place: (2,) at time 0 [m].
      velocity: (2,) [m/s].
      cov: (4, 4) of both.
      cost: negative log-likelihood (Geman-McClure).
      pull: (R, 4, 2) how place and velocity follow when an anchor moves.
    """

    place: np.ndarray
    velocity: np.ndarray
    cov: np.ndarray
    cost: float
    pull: np.ndarray

    @property
    def sigma(self) -> float:
        """Largest standard deviation of the place [m]."""
        return float(np.sqrt(np.linalg.eigvalsh(self.cov[:2, :2])[-1]))

    @property
    def speed_sigma(self) -> float:
        """Largest standard deviation of the velocity [m/s]."""
        return float(np.sqrt(np.linalg.eigvalsh(self.cov[2:, 2:])[-1]))


def multilaterate(anchors: np.ndarray, distance: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The best and the second-best place of one node, from ranges to known points; the same place twice where there
    is no second.

    Args:
      anchors: (R, 2) [m]; distance, sigma: (R,) [m].
    """
    first = np.argmin(sigma)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    spots = anchors[first] + distance[first] * np.stack([np.cos(angle), np.sin(angle)], -1)
    states, cost = _descend(spots, _Ranges(np.zeros(len(distance)), anchors, distance, sigma), _AT_REST)
    order = np.argsort(cost)
    best = states[order[0], :2]
    apart = [k for k in order if np.linalg.norm(states[k, :2] - best) > _APART_M]
    return best, states[apart[0], :2] if apart else best


def fit(
    starts: np.ndarray,
    time: np.ndarray,
    anchors: np.ndarray,
    distance: np.ndarray,
    sigma: np.ndarray,
    *,
    carried: bool,
) -> list[Spot]:
    """Places that explain the ranges, the best first; one of several that are the same.

    Args:
      starts: (S, 2) places to start from [m].
      time: (R,) of the ranges; the place is that of time 0 [s].
      anchors: (R, 2); distance, sigma: (R,) [m].
      carried: whether the node may have a velocity, of `WALK_M_S`; otherwise it rests.
    """
    walk = WALK_M_S if carried else _AT_REST
    to = _Ranges(time, anchors, distance, sigma)
    states, cost = _descend(starts, to, walk)
    found: list[int] = []
    for k in map(int, np.argsort(cost)):
        if all(np.linalg.norm(states[k, :2] - states[other, :2]) > _APART_M for other in found):
            found.append(k)
    return [_spot(states[k], float(cost[k]), to, walk) for k in found]


def settle(place: np.ndarray, anchors: np.ndarray, distance: np.ndarray, sigma: np.ndarray, common: np.ndarray) -> Spot:
    """The place of a node at rest, near a first guess, from ranges whose anchors err together.

    Args:
      place: (2,) the guess [m].
      anchors: (R, 2); distance, sigma: (R,) [m].
      common: (R, R) covariance of the anchors' errors, the same in every direction [m^2]. It makes ranges from about
        one direction nearly one range.
    """
    here = _Settled.at(place, anchors, distance, sigma, common)
    damping = 1e-3
    for _ in range(2 * _MOVES):
        A = here.u.T @ here.W @ here.u
        move = np.linalg.solve(A + (damping * np.trace(A) + 1e-6) * np.eye(2), here.u.T @ here.W @ here.r)
        there = _Settled.at(here.place - move, anchors, distance, sigma, common)
        gain = here.cost - there.cost
        here, damping = (there, damping / 5) if gain > 0 else (here, damping * 10)
        if 0 < gain < _ENOUGH or damping > 1e3:
            break
    cov = np.linalg.inv(here.u.T @ here.W @ here.u + 1e-6 * np.eye(2))
    both = np.zeros((4, 4))
    both[:2, :2], both[2:, 2:] = cov, _AT_REST**2 * np.eye(2)
    pull = np.zeros((len(distance), 4, 2))
    pull[:, :2] = (cov @ here.u.T @ here.W).T[:, :, None] * here.u[:, None]
    return Spot(here.place, np.zeros(2), both, here.cost, pull)


class _Ranges(NamedTuple):
    """Times (R,) [s], anchors (R, 2), distances and standard deviations (R,) [m] of ranges."""

    time: np.ndarray
    anchors: np.ndarray
    distance: np.ndarray
    sigma: np.ndarray


class _Settled(NamedTuple):
    """A place (2,) with the residuals (R,), unit vectors (R, 2) and weights (R, R) of its ranges, and its cost."""

    place: np.ndarray
    r: np.ndarray
    u: np.ndarray
    W: np.ndarray
    cost: float

    @staticmethod
    def at(
        place: np.ndarray, anchors: np.ndarray, distance: np.ndarray, sigma: np.ndarray, common: np.ndarray
    ) -> _Settled:
        u = _unit(place, anchors)
        r = np.linalg.norm(place - anchors, axis=1) - distance
        together = (u @ u.T) * common
        # an outlier is one by itself: its own noise is what is raised (Black, Rangarajan 1996)
        doubt = 1.0 + r**2 / (_SOFT**2 * (sigma**2 + np.diag(together)))
        W = np.linalg.inv(np.diag(sigma**2 * doubt**2) + together)
        return _Settled(place, r, u, W, 0.5 * float(r @ W @ r + _SOFT**2 * np.sum((1.0 - 1.0 / doubt) ** 2)))


def mirrored(place: np.ndarray, anchors: np.ndarray) -> np.ndarray:
    """A place (2,) on the other side of the line that the anchors (R, 2) are nearest to [m]."""
    middle = anchors.mean(0)
    normal = np.linalg.svd(anchors - middle)[2][1]
    return place - 2 * ((place - middle) @ normal) * normal


def _unit(place: np.ndarray, anchors: np.ndarray) -> np.ndarray:
    u = place - anchors
    return u / np.maximum(np.linalg.norm(u, axis=1), 1e-6)[:, None]


def locate(anchors: np.ndarray, distance: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Place (2,) and covariance (2, 2) of a node at rest from ranges to known points, None where they do not
    determine it.

    Args:
      anchors: (R, 2) [m]; distance, sigma: (R,) [m].
    """
    starts = np.stack(multilaterate(anchors, distance, sigma))
    spot, *others = fit(starts, np.zeros(len(distance)), anchors, distance, sigma, carried=False)
    if spot.sigma > SIGMA_ENOUGH_M or (others and others[0].cost - spot.cost < DECIDED):
        return None
    residual = np.linalg.norm(anchors - spot.place, axis=1) - distance
    if np.median(np.abs(residual)) > 3 * np.median(sigma):
        return None  # no one place explains the ranges
    return spot.place, spot.cov[:2, :2] + RANGE_FLOOR_M**2 * np.eye(2)


def scaled(count: int, i: np.ndarray, j: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """(count, 2) places from the distances (L,) between some of them, by classical multidimensional scaling [m].

    Missing distances are the shortest way round (as in Isomap); between groups that nothing ties, the largest known.
    """
    known = np.full((count, count), np.inf)
    known[i, j] = known[j, i] = distance
    square = shortest_path(known, directed=False) ** 2
    square[~np.isfinite(square)] = square[np.isfinite(square)].max()
    centre = np.eye(count) - 1.0 / count
    values, vectors = np.linalg.eigh(-0.5 * centre @ square @ centre)
    return vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 1e-6))


def _descend(starts: np.ndarray, to: _Ranges, walk: float) -> tuple[np.ndarray, np.ndarray]:
    """States (S, 4) of place and velocity after Gauss-Newton from places (S, 2) at once, and their costs (S,)."""
    states = np.column_stack([starts, np.zeros_like(starts)])
    prior = np.array([0.0, 0.0, walk**-2, walk**-2])
    cost = np.zeros(len(states))
    for move_number in range(_MOVES + 1):
        r, J = _linearise(states, to)
        cost = 0.5 * (r**2).sum(1) + 0.5 * (prior * states**2).sum(1)
        if move_number == _MOVES:
            break
        A = np.einsum("sri,srj->sij", J, J) + np.diag(prior + 1e-3)
        move = np.linalg.solve(A, (np.einsum("sri,sr->si", J, r) + prior * states)[..., None])[..., 0]
        states = states - np.clip(move, -2.0, 2.0)
    return states, cost


def _linearise(states: np.ndarray, to: _Ranges) -> tuple[np.ndarray, np.ndarray]:
    """Whitened residuals (S, R) and their Jacobian (S, R, 4)."""
    u = states[:, None, :2] + to.time[:, None] * states[:, None, 2:] - to.anchors
    d = np.maximum(np.linalg.norm(u, axis=2), 1e-6)
    r, scale = soften((d - to.distance) / to.sigma)
    J = (scale / to.sigma / d)[..., None] * u
    return r, np.concatenate([J, to.time[:, None] * J], axis=2)


def _spot(state: np.ndarray, cost: float, to: _Ranges, walk: float) -> Spot:
    _, J = _linearise(state[None], to)
    J = J[0]
    cov = np.linalg.inv(J.T @ J + np.diag([1e-6, 1e-6, walk**-2, walk**-2]))
    # a residual depends on its anchor as on the place, with the other sign
    pull = (J @ cov)[:, :, None] * J[:, None, :2]
    return Spot(state[:2], state[2:], cov, cost, pull)
