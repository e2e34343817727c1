"""How many times as long as the track the ranges are: lengths in other units, or counted there and back."""

from __future__ import annotations

import math

import numpy as np

from uwbslam_jax.reasons import Lack, StartUpLacks
from uwbslam_jax.startup.keyframe_buffer import Buffer

_APART = 1.5
"""Ranges and track that are apart by less than this factor may be so by biases, heights and a track that slips: that is
for the placement to find out [ratio]."""
_SIGMAS = 3.0
"""And by so much at least [standard deviations]: while it is in doubt nothing is decided, and more ranges tell."""
_NOTHING = 1e-7
"""Ranges whose squares change by a smaller share of the way's do not go with it at all [ratio]."""
_FEWEST, _BLIND = 30, 0.2
"""Fewer ranges of a beacon tell nothing [ranges], nor does a track of which such a share may be slipping [ratio]."""
_PASSES = 6
"""Solutions in turn, each with less weight for what is off [solutions]."""


def wrong_scale(buffer: Buffer) -> Lack | None:
    """What start-up lacks where ranges and track are plainly of different scale; None where not, or nothing tells.

    A range r to a beacon at b from the place p is s |p - b|, so r^2 = a |p|^2 + (linear in p) with a = s^2: one least
    squares problem for all beacons, without knowing where they are.
    """
    keys = buffer.keyframes
    if len(keys) < 3 or sum(key.blind for key in keys[1:]) > _BLIND * len(keys):
        return None
    left, right = [], []
    for kept in buffer.sightings.values():
        if len(kept) < _FEWEST:
            continue
        place, distance = np.array([s.pose[:2] for s in kept]), np.array([s.distance for s in kept])
        place = place - place.mean(axis=0)
        columns = np.column_stack([np.ones(len(place)), place, (place**2).sum(axis=1), distance**2])
        weight = 1.0 / np.maximum(distance, 0.1)  # the square of a range errs by 2 r sigma
        base, _ = np.linalg.qr(columns[:, :3] * weight[:, None])
        rest = columns[:, 3:] * weight[:, None]
        rest = rest - base @ (base.T @ rest)
        left.append(rest[:, 0])
        right.append(rest[:, 1])
    if not left:
        return None
    square, sigma = _robust(np.concatenate(left), np.concatenate(right))
    if not square > _NOTHING or abs(square - 1.0) < _SIGMAS * sigma:
        return None
    factor = math.sqrt(square)
    return StartUpLacks.scale(factor) if abs(math.log(factor)) > math.log(_APART) else None


def _robust(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """The a of y = a x, and its standard deviation."""
    weight = np.ones(len(x))
    a = spread = 0.0
    for _ in range(_PASSES):
        power = float(np.sum(weight * x * x))
        if not power > 0.0:
            return 0.0, math.inf
        a = float(np.sum(weight * x * y)) / power
        error = y - a * x
        spread = 1.4826 * float(np.median(np.abs(error)))
        weight = 1.0 / (1.0 + (error / max(3.0 * spread, 1e-9)) ** 2)
    return a, spread / math.sqrt(float(np.sum(weight * x * x)))
