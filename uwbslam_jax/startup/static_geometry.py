"""Where nodes at rest stand among themselves, from the ranges between them alone while the robot rests.

Ranges fix such a geometry up to translation, rotation and reflection; the frame is made by convention. Host code in
float64: nothing here moves, reads a file or knows the estimator's state.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import least_squares

from uwbslam_jax.measurements import StampedFrame
from uwbslam_jax.numerics import RANGE_FLOOR_M, scaled
from uwbslam_jax.settings import HostParams

_KEPT = 1024
"""So many of a link's newest ranges are kept."""
_GROSS = 5.0
"""A range this many robust standard deviations off its link's median is a gross outlier."""
_GROSS_M = 0.3
"""Nearer to the median than this it never is [m]."""
_LINK_OFF = 4.0
"""A link that misses the others' geometry by so many robust standard deviations is left out."""
_SOFT_M = 0.1
"""Residual beyond which a link counts less while the outliers are looked for [m]."""
_IN_SIGHT_SHARE = 0.25
"""A link of which at least so many ranges are in line of sight by their powers goes by those alone."""
_RANDOM_STARTS = 8
"""Where pairs are missing the scaled start may be folded: one of so many others is not."""
_OFFSET_SHARES = (0.0, 0.5, 0.8, 0.9, 0.95, 0.98)
"""Starts of an unknown common offset, as shares of the shortest range."""

_RESTING_M = 1.0
"""Ranges of nodes at rest are spread over less, but for gross outliers [m]: behind walls they jump by decimetres."""

Pair = tuple[int, int]


class Link(NamedTuple):
    """What one pair of nodes measured.

    Attributes:
      distance: median [m]; count: ranges in it; gross: ranges that were left out of it.
    """

    distance: float
    count: int
    gross: int


class Links:
    """Ranges between nodes at rest by pair, a bounded number each.

    Attributes:
      rise: pair -> difference of the antennas' heights [m].
    """

    def __init__(self) -> None:
        self.rise: dict[Pair, float] = {}
        self._ranges: dict[Pair, deque[tuple[float, bool]]] = {}

    def hear(self, frame: StampedFrame, ids: Mapping[int, int], host: HostParams) -> None:
        """All ranges of a frame, the configured biases taken off. ids: slot -> node id."""
        r = frame.frame.ranges
        in_sight = host.usable(r)
        for k in np.flatnonzero(r.valid):
            i, j = int(r.i[k]), int(r.j[k])
            self.add(ids[i], ids[j], host.slant(float(r.range[k]), i, j), in_sight=bool(in_sight[k]))
            self.rise[min(ids[i], ids[j]), max(ids[i], ids[j])] = float(host.rise(i, j))

    def add(self, a: int, b: int, distance: float, *, in_sight: bool = True) -> None:
        """One range [m] between two nodes, what is known of its bias taken off; in_sight: by the power rule."""
        pair = (min(a, b), max(a, b))
        self._ranges.setdefault(pair, deque(maxlen=_KEPT)).append((distance, in_sight))

    def moving(self, robot: int) -> bool:
        """Whether most ranges of a node (the robot where it is heard, otherwise any) show that it does not rest."""
        middle = (0.1, 0.9)
        spread = {pair: np.ptp(np.quantile([d for d, _ in kept], middle)) for pair, kept in self._ranges.items()}
        nodes = {node for pair in spread for node in pair}
        own = [[m for pair, m in spread.items() if node in pair] for node in ({robot} & nodes or nodes)]
        return any(float(np.median(spreads)) > _RESTING_M for spreads in own)

    def averages(self) -> dict[Pair, Link]:
        """Every pair's median, without its gross outliers.

        Ranges that are not in line of sight are left out only where enough of the same link's are: a link less costs
        the geometry more than the few decimetres that it is long by.
        """
        found = {}
        for pair, kept in sorted(self._ranges.items()):
            ranges, in_sight = np.array([d for d, _ in kept]), np.array([seen for _, seen in kept])
            found[pair] = average(ranges[in_sight] if in_sight.mean() >= _IN_SIGHT_SHARE else ranges)
        return found


def average(ranges: Float[np.ndarray, "n"]) -> Link:
    """Median of a link's ranges [m] without those far off it, by the median absolute deviation."""
    off = np.abs(ranges - np.median(ranges))
    near = off <= max(_GROSS * 1.4826 * float(np.median(off)), _GROSS_M)
    return Link(float(np.median(ranges[near])), int(near.sum()), int((~near).sum()))


@dataclass(frozen=True)
class Relative:
    """Relative geometry of nodes at rest. Rotation and reflection are by convention: see `solve`.

    Attributes:
      nodes: (N,) ids in order; positions: (N, 2) [m].
      cov: (2 N, 2 N) of the inner geometry [m^2]: the pseudo-inverse, free of any choice of frame (free network).
      offset: common to all ranges [m]; the given 0 where it was not asked for.
      rms: of the used links' residuals [m]. Far above what averaging leaves, it tells that links are biased.
      links: used; rejected: pairs whose range does not fit the geometry of the others.
      gross: single ranges left out of the links' medians.
    """

    nodes: list[int]
    positions: np.ndarray
    cov: np.ndarray
    offset: float
    rms: float
    links: int
    rejected: list[Pair]
    gross: int


@dataclass(frozen=True)
class _Network:
    """Links in arrays: i, j (L,) indices of the nodes, distance and rise (L,) [m]; whether an offset is unknown."""

    count: int
    i: Int[np.ndarray, "L"]
    j: Int[np.ndarray, "L"]
    distance: Float[np.ndarray, "L"]
    rise: Float[np.ndarray, "L"]
    fit_offset: bool

    @property
    def redundancy(self) -> int:
        """Links beyond those that the geometry needs."""
        return len(self.i) - (2 * self.count - 3) - self.fit_offset

    def without(self, link: int) -> _Network:
        keep = np.arange(len(self.i)) != link
        i, j, distance, rise = (part[keep] for part in (self.i, self.j, self.distance, self.rise))
        return _Network(self.count, i, j, distance, rise, self.fit_offset)

    def residuals(self, x: Float[np.ndarray, "u"]) -> Float[np.ndarray, "L"]:
        """Predicted minus measured [m]; x holds the positions and the offset."""
        p = x[:-1].reshape(-1, 2)
        u = p[self.i] - p[self.j]
        offset = x[-1] if self.fit_offset else 0.0
        return np.sqrt((u**2).sum(1) + self.rise**2) + offset - self.distance

    def jacobian(self, x: Float[np.ndarray, "u"]) -> Float[np.ndarray, "L u"]:
        """Of the residuals."""
        p = x[:-1].reshape(-1, 2)
        u = p[self.i] - p[self.j]
        g = u / np.maximum(np.sqrt((u**2).sum(1) + self.rise**2), 1e-6)[:, None]
        rows, J = np.arange(len(u)), np.zeros((len(u), len(x)))
        for axis in range(2):
            J[rows, 2 * self.i + axis] = g[:, axis]
            J[rows, 2 * self.j + axis] = -g[:, axis]
        J[:, -1] = self.fit_offset
        return J

    def fit(self, start: Float[np.ndarray, "u"], loss: str = "linear") -> tuple[float, np.ndarray]:
        """Cost and solution from one start."""
        jacobian: Any = self.jacobian  # the types that come for SciPy know only the names of its own
        found = least_squares(self.residuals, start, jacobian, loss=loss, f_scale=_SOFT_M, x_scale="jac")
        return float(found.cost), found.x


def solve(
    links: Mapping[Pair, Link],
    rise: Mapping[Pair, float] | None = None,
    *,
    origin: int | None = None,
    fit_offset: bool = False,
) -> Relative | None:
    """The geometry that explains the links best.

    Classical MDS starts it (Torgerson 1952; a missing pair takes the shortest way round, as in Isomap), random starts
    are added where pairs are missing. Links count alike: on real radios what is wrong with a link as a whole (0.25 m
    in a room) outweighs what its ranges average out. The worst link is left out, one at a time, while it is far off
    the others (Baarda's data snooping).

    Args:
      links: pair of ids -> what it measured, biases taken off.
      rise: pair -> difference of the antennas' heights [m], 0 where not given.
      origin: id of the node at the origin, where it takes part; the lowest id otherwise. The node farthest from it
        lies on +x, the one farthest from that line on the side of +y.
      fit_offset: whether a bias common to all ranges is found as well.

    Returns:
      None where the links do not fix a geometry: fewer than three nodes, or a node with too few links.
    """
    nodes = _rigid_core(set(links))
    index = {node: k for k, node in enumerate(nodes)}
    pairs = [pair for pair in links if pair[0] in index and pair[1] in index]
    if not pairs:
        return None
    network = _Network(
        len(nodes),
        np.array([index[a] for a, _ in pairs]),
        np.array([index[b] for _, b in pairs]),
        np.array([links[pair].distance for pair in pairs]),
        np.array([(rise or {}).get(pair, 0.0) for pair in pairs]),
        fit_offset,
    )
    if network.redundancy < 0:
        return None
    x = min((network.fit(start, "soft_l1") for start in _starts(network)), key=lambda found: found[0])[1]
    network, x, rejected = _leave_out(network, x, pairs)
    _, x = network.fit(x)
    cov, determined = _covariance(network, x)
    if not determined:
        return None
    at = nodes.index(origin) if origin in nodes else 0
    positions, turn = _conventional(x[:-1].reshape(-1, 2), at)
    turns = np.kron(np.eye(len(nodes)), turn)
    rms = float(np.sqrt(np.mean(network.residuals(x) ** 2)))
    gross = sum(links[pair].gross for pair in pairs)
    offset = float(x[-1]) if fit_offset else 0.0
    return Relative(nodes, positions, turns @ cov @ turns.T, offset, rms, len(network.i), rejected, gross)


def _rigid_core(pairs: set[Pair]) -> list[int]:
    """Nodes with links to at least three others of them (to both others where there are three nodes in all)."""
    nodes = {node for pair in pairs for node in pair}
    while len(nodes) >= 3:
        degree = dict.fromkeys(nodes, 0)
        for a, b in pairs:
            if a in nodes and b in nodes:
                degree[a] += 1
                degree[b] += 1
        loose = {node for node, count in degree.items() if count < min(3, len(nodes) - 1)}
        if not loose:
            return sorted(nodes)
        nodes -= loose
    return []


def _starts(network: _Network) -> list[Float[np.ndarray, "u"]]:
    """Positions (and offset) to start from."""
    rng = np.random.default_rng(0)
    shares = _OFFSET_SHARES if network.fit_offset else (0.0,)
    complete = len(network.i) == network.count * (network.count - 1) // 2
    starts = []
    for share in shares:
        offset = share * float(network.distance.min())
        flat = np.sqrt(np.maximum((network.distance - offset) ** 2 - network.rise**2, 1e-4))
        first = scaled(network.count, network.i, network.j, flat).ravel()
        starts.append(np.append(first, offset))
        if not complete:
            spread = float(first.std()) or 1.0
            starts += [np.append(rng.normal(0.0, spread, first.size), offset) for _ in range(_RANDOM_STARTS)]
    return starts


def _leave_out(network: _Network, x: np.ndarray, pairs: list[Pair]) -> tuple[_Network, np.ndarray, list[Pair]]:
    """The network without the links that are far off the others' geometry, at most a third of the redundant ones."""
    left, rejected = list(pairs), []
    for _ in range(network.redundancy // 3):
        r = np.abs(network.residuals(x))
        worst = int(np.argmax(r))
        # residuals are smaller than errors by the unknowns that were fitted to them
        scale = 1.4826 * float(np.median(r)) * np.sqrt(len(r) / network.redundancy)
        smaller = network.without(worst)
        core = _rigid_core(set(left) - {left[worst]})
        if r[worst] < _LINK_OFF * max(scale, RANGE_FLOOR_M) or len(core) < network.count:
            break
        rejected.append(left.pop(worst))
        network = smaller
        _, x = network.fit(x, "soft_l1")
    return network, x, sorted(rejected)


def _covariance(network: _Network, x: np.ndarray) -> tuple[Float[np.ndarray, "n n"], bool]:
    """Covariance of the positions without the freedom of the frame, and whether the links determine the geometry."""
    J = network.jacobian(x)
    values = np.linalg.svd(J, compute_uv=False)
    unknowns = 2 * network.count - 3 + network.fit_offset
    determined = len(values) >= unknowns and bool(values[unknowns - 1] > 1e-3 * values[0])
    rss = float(np.sum(network.residuals(x) ** 2))
    variance = rss / network.redundancy if network.redundancy else 0.0
    cov = np.linalg.pinv(J.T @ J, rcond=1e-9, hermitian=True) * max(variance, RANGE_FLOOR_M**2)
    return cov[:-1, :-1], determined


def _conventional(positions: Float[np.ndarray, "N 2"], origin: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions in the frame of `solve`, and the orthogonal matrix (2, 2) that led there."""
    moved = positions - positions[origin]
    along = moved[int(np.argmax(np.linalg.norm(moved, axis=1)))]
    c, s = along / np.linalg.norm(along)
    turn = np.array([[c, s], [-s, c]])
    across = moved @ turn[1]
    if across[int(np.argmax(np.abs(across)))] < 0:
        turn[1] *= -1
    return moved @ turn.T, turn
