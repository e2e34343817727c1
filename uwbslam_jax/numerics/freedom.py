"""What ranges and wheels may be off by from how they are configured, and how much of it a problem should leave open."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol, TypeVar, runtime_checkable

import numpy as np

from uwbslam_jax.numerics.robust import CALIBRATED_M, DECIDED

_PRICE = 3.0
"""Log-likelihood that each unknown of a group has to gain, besides what decides between two explanations."""
_SURE = 3.0
"""So many times its price a group that is needed costs for certain, however far from linear the problem is."""
_RIVAL = 5.0
"""A group is not left open while others explain what it does but for so much log-likelihood: two beacons that stand
high look like ranges of another scale, and to take the one for the other moves them by metres."""
_LEAST_SCALE = 0.02
"""A smaller scale is not that of the ranges but of what tells the way: wheels err by as much, and a map of a building
bends [m/m]."""
_MOST_SCALE = 0.2
"""A larger one is no radio's [m/m]."""
_SEEN = 0.9
"""A scale is asked for where so much of the way is told in every direction [0 to 1]: along a corridor that scans do not
see, what they tell is too short, and would pass for ranges that are too long."""
HEIGHT_START_M = 0.5
"""Where an unknown height starts from at least [m]: at none, a range does not change with it."""


class Freedom(NamedTuple):
    """Standard deviations of what may be off from how it is configured; what has 0 is as configured, and no unknown.

    Attributes:
      bias: of each node's ranges [m]. height: of an antenna that nobody has measured [m].
      scale: of all ranges in proportion to the distance [m/m].
      lidar, wheels, map: of the way that scans tell that are laid over each other, wheels, matches with a map [m/m].
    """

    bias: float = CALIBRATED_M
    height: float = 0.0
    scale: float = 0.0
    lidar: float = 0.0
    wheels: float = 0.0
    map: float = 0.0

    @staticmethod
    def of(groups: tuple[str, ...]) -> Freedom:
        """Some of "bias", "height", "scale" left open; with the scale of ranges what it is measured by."""
        scales = Freedom() if "scale" not in groups else _OPEN
        return scales._replace(
            bias=_OPEN.bias if "bias" in groups else CALIBRATED_M, height=_OPEN.height if "height" in groups else 0.0
        )


_OPEN = Freedom(bias=0.3, height=1.0, scale=0.05, lidar=0.002, wheels=0.02, map=0.02)
"""Of antenna delays [m], of how much higher than the robot's a beacon's antenna stands [m], of the ranges' scale, the
LiDAR's, the wheels' and a map's, which bends, and is itself drawn where the ranges say [m/m]."""


class Off(NamedTuple):
    """By how much it is off, or how well that is known; S nodes, the robot first.

    Attributes:
      bias, height: (S,) of each node [m]. scale, lidar, wheels, map: see Freedom [m/m].
    """

    bias: np.ndarray
    height: np.ndarray
    scale: float = 0.0
    lidar: float = 0.0
    wheels: float = 0.0
    map: float = 0.0

    def strength(self, sigma: Off, group: str) -> float:
        """Log-likelihood that closing a group would cost at least, by how well it is known (Wald's test)."""
        of_group = [np.atleast_1d(np.abs(getattr(off, group))) for off in (self, sigma)]
        known = of_group[1] > 0
        return 0.5 * float(np.max((of_group[0][known] / of_group[1][known]) ** 2, initial=0.0))


@runtime_checkable
class Attempt(Protocol):
    """A problem solved with some groups of unknowns left open.

    Attributes:
      cost: negative log-likelihood. off: what was found.
    """

    @property
    def cost(self) -> float: ...

    @property
    def off(self) -> Off: ...

    def strength(self, group: str) -> float:
        """See Off."""
        ...


Solved = TypeVar("Solved", bound=Attempt)


def fewest_open(
    groups: tuple[str, ...],
    first: Solved,
    unknowns: Mapping[str, int],
    attempt: Callable[[tuple[str, ...], Solved], Solved],
    each: float = DECIDED,
) -> tuple[tuple[str, ...], Solved]:
    """The groups that are to be left open, and what is found then.

    Each has to pay for itself: all are left open, and then closed again one after the other. Alone, the heights, the
    scale and the biases may each pass for the others: while one may, nothing is left open that was not before.

    Args:
      groups, first: those that were found to be off before, and the problem solved with these open.
      unknowns: of each group that may be left open.
      attempt: solves with some groups open, from an attempt with others.
      each: log-likelihood that a group which was not found before has to gain besides what its unknowns have to.
    """

    def price(of: tuple[str, ...]) -> float:
        return sum((each if group not in groups else 0.0) + _PRICE * unknowns[group] for group in of)

    def paid(of: tuple[str, ...]) -> float:
        blamed = "scale" in of and not _LEAST_SCALE <= abs(tried[of].off.scale) <= _MOST_SCALE
        return np.inf if blamed else tried[of].cost + price(of)

    every = tuple(unknowns)
    tried = {groups: first, every: attempt(every, first)}
    best = groups if first.cost - tried[every].cost < DECIDED else every
    while True:
        fewer = [tuple(g for g in best if g != group) for group in best if not _needed(tried[best], group, price)]
        tried |= {left: attempt(left, tried[best]) for left in fewer if left not in tried}
        better = min([best, *fewer], key=paid)
        if better == best:
            break
        best = better
    best = min(groups, best, key=paid)
    news = [g for g in best if g not in groups and not _needed(tried[best], g, price)]
    rivals = [solved.cost for g in news for of, solved in tried.items() if g not in of and paid(of) < np.inf]
    if min(rivals, default=np.inf) - tried[best].cost < _RIVAL:
        best = groups
    return best, tried[best]


def tells_scale(sees: np.ndarray) -> bool:
    """Whether the way is a measure for ranges: by wheels alone, or by scans that see.

    Args:
      sees: (N,) whether a scan told its pose in every direction.
    """
    return len(sees) == 0 or float(np.mean(sees)) >= _SEEN


def _needed(solved: Attempt, group: str, price: Callable[[tuple[str, ...]], float]) -> bool:
    """Whether a group is known to be off without a trial: what is far off takes long to be solved without."""
    return solved.strength(group) > _SURE * price((group,))
