"""What is asked of a run besides its averages: small functions over what it published and what was true.

Each returns one figure that has to stay at or below a limit; NaN, which never does, where there is nothing to judge.
Pure: a Trial is arrays only, laid over the truth by one rigid motion, and who made them is in `trials`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from uwbslam_jax.numerics import wrapped
from uwbslam_jax.sim import Interval

NAN = float("nan")
_PUT_DOWN_S = 10.0
"""A beacon has this long to be known again after it was put down [s]."""
_PICKED_UP_S = 3.0
"""It takes this long until a beacon is known to be carried, or to be there at all [s]."""
_LOST = (0.1, np.deg2rad(5.0))
"""A robot farther off or turned more than this does not know where it is [m, rad]."""
_UNDECIDED_S = 3.0
"""So long before the first turn nothing but two reflections may be told [s]."""


@dataclass(frozen=True)
class Stay:
    """A beacon at rest, or one that is carried: id and from, to [s]."""

    node: int
    begin: float
    end: float


@dataclass(frozen=True)
class Trial:
    """What a run published, laid over the truth. T scans.

    Attributes:
      t: (T,) since the scenario's start [s].
      poses, true: (T, 3) [m, m, rad].
      beacons, true_beacons: id -> (n, 3) of t, x, y, as they were published over time and as they were [s, m, m].
      decided: when the frame was decided [s], NaN where it never was.
      hypotheses: (T,) how many explanations of the start were alive.
      warnings: one line each.
      memory: (m,) memory in use over the run, evenly in its messages [MB].
      scale: of the ranges, as it was found [m/m].
    """

    t: np.ndarray
    poses: np.ndarray
    true: np.ndarray
    beacons: Mapping[int, np.ndarray] = field(default_factory=dict)
    true_beacons: Mapping[int, np.ndarray] = field(default_factory=dict)
    decided: float = NAN
    hypotheses: np.ndarray = field(default_factory=lambda: np.zeros(0))
    warnings: Sequence[str] = ()
    memory: np.ndarray = field(default_factory=lambda: np.zeros(0))
    scale: float = 0.0

    @property
    def offset(self) -> np.ndarray:
        """(T, 2) error of the robot's position [m]."""
        return self.poses[:, :2] - self.true[:, :2]

    def within(self, intervals: Iterable[Interval]) -> np.ndarray:
        """(T,) which scans were taken in one of the intervals [s]."""
        chosen = np.zeros(self.t.shape, bool)
        for begin, end in intervals:
            chosen |= (self.t >= begin) & (self.t < end)
        return chosen


def rms_within(trial: Trial, intervals: Iterable[Interval]) -> float:
    """RMS of the robot's error in some intervals [m]."""
    return _rms(trial.offset[trial.within(intervals)])


def rms_outside(trial: Trial, intervals: Iterable[Interval]) -> float:
    """RMS of the robot's error in the rest of the run [m]."""
    return _rms(trial.offset[~trial.within(intervals)])


def _rms(offset: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(offset**2, axis=1)))) if len(offset) else NAN


def largest_jump(trial: Trial) -> float:
    """Most that the published track moves from one scan to the next beyond what the robot moved [m]."""
    return float(np.linalg.norm(np.diff(trial.offset, axis=0), axis=1).max()) if len(trial.t) > 1 else NAN


def time_lost(trial: Trial, since: float) -> float:
    """How long after `since` [s] the robot last did not know where it is [s]; 0 where it always did."""
    turned = np.abs(wrapped(trial.poses[:, 2] - trial.true[:, 2]))
    known = (np.linalg.norm(trial.offset, axis=1) <= _LOST[0]) & (turned <= _LOST[1])
    lost = trial.t[(trial.t >= since) & ~known]
    return float(lost[-1] - since) if len(lost) else 0.0 if np.any(trial.t >= since) else NAN


def length_error(trial: Trial, stops: Sequence[float]) -> float:
    """Most that the distance from one stop [s] to the next is wrong [m]."""
    at = np.array([np.argmin(np.abs(trial.t - stop)) for stop in stops], int)
    if len(at) < 2:
        return NAN
    lengths = [np.linalg.norm(np.diff(track[at, :2], axis=0), axis=1) for track in (trial.poses, trial.true)]
    return float(np.abs(lengths[0] - lengths[1]).max())


def told_too_early(trial: Trial, turn: float) -> float:
    """Share of the last seconds before the first turn [s] in which the reflection was not told as undecided."""
    before = trial.within([(turn - _UNDECIDED_S, turn)])
    if trial.decided < turn:
        return 1.0
    return float(np.mean(trial.hypotheses[before] != 2)) if before.any() else NAN


def decided_late(trial: Trial, turn: float) -> float:
    """How long after the first turn [s] the frame was decided [s]."""
    return trial.decided - turn


def filled_in(trial: Trial) -> float:
    """RMS of the robot's error before the frame was decided [m]; NaN where a pose is missing or it never was."""
    return rms_within(trial, [(-np.inf, trial.decided)])


def resting_error(trial: Trial, rests: Iterable[Stay]) -> float:
    """Worst published position of a beacon at rest, from ten seconds after it was put down or first decided [m]."""
    worst = [0.0]
    for rest in rests:
        begin = max(rest.begin, trial.decided) + _PUT_DOWN_S
        if begin < rest.end:
            errors = _beacon_errors(trial, rest.node, begin, rest.end)
            worst.append(float(errors.max()) if len(errors) else NAN)
    return float(np.max(worst))  # Python's own max loses a NaN


def carried_error(trial: Trial, carries: Iterable[Stay]) -> float:
    """Worst published position of a beacon while it is carried [m]; NaN where it is not published half of the time."""
    worst = [0.0]
    for carry in carries:
        begin = max(carry.begin, trial.decided) + _PICKED_UP_S
        errors = _beacon_errors(trial, carry.node, begin, carry.end)
        enough = len(errors) > 0 and len(errors) >= 0.5 * (carry.end - begin)
        worst.append(float(errors.max()) if enough else NAN)
    return float(np.max(worst))


def _beacon_errors(trial: Trial, node: int, begin: float, end: float) -> np.ndarray:
    """(n,) errors of what was published of a beacon, about once a second, between two times [s; m]."""
    published, true = (of.get(node, np.zeros((0, 3))) for of in (trial.beacons, trial.true_beacons))
    published = published[(published[:, 0] >= begin) & (published[:, 0] < end)]
    if not len(true):
        return np.full(len(published), NAN)
    was = np.stack([np.interp(published[:, 0], true[:, 0], true[:, k]) for k in (1, 2)], -1)
    return np.linalg.norm(published[:, 1:] - was, axis=1)


def untold(trial: Trial, word: str) -> float:
    """0 where a warning has the word, 1 where none has."""
    return float(not any(word in warning for warning in trial.warnings))


def scale_error(trial: Trial, scale: float) -> float:
    """By how much the scale of the ranges was found wrong [%]. scale: the true one [m/m]."""
    return 100.0 * abs(trial.scale - scale)


def memory_growth(trial: Trial) -> float:
    """By how much more memory is in use in the second half of the run than half way [MB]."""
    half = len(trial.memory) // 2
    return float(trial.memory[half:].max() - trial.memory[half]) if half else NAN
