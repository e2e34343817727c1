"""What the first ranges of a recording tell before it is read: in which unit they are, and which node is the robot's.

Noise is some centimetres whatever the radio, and rooms are some metres wide: that tells the unit. Beacons rest: the
node whose ranges change while those of the others among themselves do not is the robot's.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping

import numpy as np

from uwbslam_jax.files.bag import Bag
from uwbslam_jax.files.range_messages import METRES, Options
from uwbslam_jax.files.schemas import Decoder
from uwbslam_jax.measurements import RangeMessage
from uwbslam_jax.session import robot_unheard

_LOOKS = (300, 1200, 4800, 19200)
"""So many ranges are read before each look [ranges]: the first suffices for nearly all, the last is minutes long."""
_USUAL_NOISE_M, _USUAL_RANGE_M = 0.05, 5.0
"""A radio's noise, and a range [m]: a unit is the likelier the nearer it brings both to these."""
_LOUD_M = 1.0
"""Metres of which every second one is off by so much are none [m]."""
_QUIET_M, _NEAR_M = 0.01, 1.5
"""Millimetres that are so quiet and so short are none: somebody counts centimetres [m]."""
_LEAST_NOISE_M = 0.002
"""Less noise is that of a simulation or of rounding, and tells nothing [m]."""
_METRIC = ("m", "cm", "mm")
"""Units that ranges alone tell: feet and inches are too near to m and cm, only the robot's way tells them."""
_MOVED_M, _MOVED_NOISES = 0.3, 6.0
"""A pair's ranges change where nine tenths of them spread over so much [m], and so many times their noise."""


class FirstRanges:
    """Ranges by pair of nodes."""

    def __init__(self) -> None:
        self.count = 0
        self._pairs: dict[tuple[int, int], list[float]] = defaultdict(list)

    def add(self, message: RangeMessage) -> None:
        """Takes in a range."""
        self.count += 1
        self._pairs[min(message.source, message.target), max(message.source, message.target)].append(message.range)

    @property
    def pairs(self) -> dict[tuple[int, int], list[float]]:
        """Ranges of the pairs that were heard more than once: what is heard once may be an error of the radio."""
        return {pair: ranges for pair, ranges in self._pairs.items() if len(ranges) > 1}

    @property
    def nodes(self) -> list[int]:
        """Ids of the nodes that were heard more than once."""
        return sorted({node for pair in self.pairs for node in pair})

    def noise(self) -> float:
        """Standard deviation of a range about its pair's motion [their unit], robust; NaN where too few tell."""
        rows = [np.diff(ranges, 2) / math.sqrt(6.0) for ranges in self._pairs.values() if len(ranges) > 2]
        return float(np.median(np.abs(np.concatenate(rows)))) / 0.6745 if rows else math.nan

    def span(self) -> tuple[float, float]:
        """What nine tenths of the ranges lie between [their unit]; NaN where there is none."""
        ranges = [value for values in self._pairs.values() for value in values]
        low, high = np.quantile(ranges, (0.05, 0.95)).tolist() if ranges else (math.nan, math.nan)
        return low, high

    def unit(self, max_range: float, *, whole: bool) -> str:
        """The unit that explains the ranges: the usual one, unless they can be no such lengths.

        Args:
          max_range: that is used [m].
          whole: whether they are whole numbers, taken as mm; else they are as yet taken as m.
        """
        noise, ranges = self.noise(), [value for values in self._pairs.values() for value in values]
        usual = "mm" if whole else "m"
        typical = float(np.median(ranges)) if ranges else math.nan
        quiet = whole and noise < _QUIET_M and typical < _NEAR_M
        if not (typical > max_range or noise > _LOUD_M or quiet):
            return usual

        def odds(unit: str) -> float:
            metres = METRES[unit] / METRES[usual]
            told = math.log(typical * metres / _USUAL_RANGE_M) ** 2
            known = noise * metres > _LEAST_NOISE_M
            return told + (math.log(noise * metres / _USUAL_NOISE_M) ** 2 if known else 0.0)

        fitting = [unit for unit in _METRIC if typical * METRES[unit] / METRES[usual] <= max_range]
        return min(fitting, key=odds, default=usual)

    def moving(self, metres: float) -> list[tuple[int, int]]:
        """Pairs whose ranges change; metres: of the ranges' unit."""
        least = max(_MOVED_M, _MOVED_NOISES * self.noise() * metres)
        return [pair for pair, ranges in self.pairs.items() if _spread(ranges) * metres > least]

    def robot(self, robot_id: int, metres: float) -> int | None:
        """The node other than this one that is the robot's by its motion, None where none is."""
        moving = [pair for pair in self.moving(metres) if robot_id not in pair]
        nodes = set.intersection(*map(set, moving)) if len(moving) > 1 else set()
        own = [pair for pair in self.pairs if nodes & set(pair)]
        return nodes.pop() if len(nodes) == 1 and 2 * len(moving) >= len(own) else None

    def moves(self, node: int, metres: float) -> bool:
        """Whether a node moves, or there are no ranges without it to compare it with."""
        return all(node in pair for pair in self.pairs) or any(node in pair for pair in self.moving(metres))

    def centre(self) -> int | None:
        """The one node that is part of every pair, of two at least."""
        nodes = set.intersection(*map(set, self.pairs)) if len(self.pairs) > 1 else set()
        return nodes.pop() if len(nodes) == 1 else None

    def hears(self, node: int) -> bool:
        """Whether there is no doubt that a node may be the robot's: it is part of every pair, or of several."""
        own = [pair for pair in self.pairs if node in pair]
        return len(own) > 1 or (len(own) == 1 and len(self.pairs) == 1)


def _spread(ranges: list[float]) -> float:
    """What nine tenths of some ranges spread over [their unit]."""
    ranges, cut = sorted(ranges), len(ranges) // 20
    return ranges[-1 - cut] - ranges[cut]


def look_ahead(recording: Bag, decoders: Mapping[int, Decoder], options: Options, *, scans: bool) -> None:
    """Reads the first ranges, as many as it takes, and settles scale and robot_id of the options; says so in told.

    Args:
      decoders: of the ranges' channels, made with these options.
      scans: whether there are scans or odometry, and so a robot that moves.
    """
    first, looks, longest = FirstRanges(), iter(_LOOKS), options.max_range
    options.max_range, at = math.inf, next(looks)
    for log_time, number, data in recording.records(set(decoders)) if decoders else ():
        for message in decoders[number](data, log_time):
            if isinstance(message, RangeMessage):
                first.add(message)
        if first.count >= at:
            plain = first.count >= _LOOKS[1] or _unit(first, options, longest) is None
            other = first.robot(options.robot_id, 1.0) is not None
            known = not scans or other or (first.hears(options.robot_id) and first.moves(options.robot_id, 1.0))
            at = 0 if plain and known else next(looks, 0)
            if not at:
                break
    options.max_range = longest
    options.dropped.clear()
    _settle_unit(first, options)
    if scans and first.pairs:
        _settle_robot(first, options)


def _unit(first: FirstRanges, options: Options, longest: float) -> str | None:
    """The unit of the ranges where it is not the one that they are taken in; longest: that is used [m]."""
    if options.unit != "auto" or options.whole is None:
        return None
    unit = first.unit(longest, whole=options.whole)
    return None if unit == ("mm" if options.whole else "m") else unit


def _settle_unit(first: FirstRanges, options: Options) -> None:
    unit, span = _unit(first, options, options.max_range), first.span()
    if unit is not None:
        usual = METRES["mm" if options.whole else "m"]
        options.scale = METRES[unit] / usual
        told, metres = ([value * by for value in span] for by in (1.0 / usual if options.whole else 1.0, options.scale))
        options.told.append(
            f"ranges of {told[0]:.0f} to {told[1]:.0f} are taken for {unit},"
            f" so for {metres[0]:.1f} to {metres[1]:.1f} m: "
            f"if that is right say --uwb.unit {unit}, else --uwb.unit {'mm' if options.whole else 'm'}"
        )


def _settle_robot(first: FirstRanges, options: Options) -> None:
    wanted, nodes = options.robot_id, first.nodes
    if first.hears(wanted):
        other = first.robot(wanted, options.scale)
        still = [pair for pair in first.moving(options.scale) if wanted in pair and other not in pair]
        if other is not None and not still:
            options.told.append(
                f"robot.id = {wanted} rests among the others, and node {other} is the one whose ranges change: "
                f"if that is the robot's, say --robot.id {other}; or do two nodes share that id?"
            )
        return
    heard = "is heard by one node only" if wanted in nodes else "is never heard"
    found = first.robot(wanted, options.scale)
    if found is None and wanted not in nodes:
        found = first.centre()
    if found is not None:
        why = "is in every pair" if found == first.centre() else "is the one whose ranges change"
        options.told.append(
            f"robot.id = {wanted} {heard}, and node {found} {why}: it is taken for the robot's; "
            f"--robot.id {found} says so"
        )
        options.robot_id = found
        options.names |= {"@robot": found} if "@robot" in options.names else {}
    elif wanted not in nodes:
        options.told.append(robot_unheard(wanted, nodes))
