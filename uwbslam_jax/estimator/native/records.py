"""What a step is given, carries on and reports, as the loops see it: records of what has one size, and arrays of what
grows with beacons, ranges or beams. Twins: settings.Params, estimator.State, measurements.Frame, estimator.Estimate.

Each field and array stands for a leaf of its twin, named by the leaf's path in the tree. A tree that has gained or lost
a leaf is refused by `Leaves`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.tree_util import keystr, tree_flatten_with_path
from jaxtyping import Float
from numpy import ndarray

EPS = float(np.finfo(np.float32).eps)
"""Of float32, in which the twins compute [1]."""
Record = Any
"""One entry of a structured array."""


def _record(*groups: tuple[str, type, tuple[int, ...]]) -> np.dtype:
    """Type of a record. groups: names, divided by blanks, the type of each of them, and its shape."""
    return np.dtype((np.record, [(name, kind, shape) for names, kind, shape in groups for name in names.split()]))


CONFIG = _record(
    ("resolution nlos_gap_db", np.float64, ()), ("cells levels", np.int64, ()), ("lidar_only draws", np.bool_, ())
)
"""Config but for the sizes that arrays tell."""
PARAMS = _record(
    ("gamma sigma_n sigma_w sigma_w_paper sigma_w_yaw sigma_w_beacon sigma_w_carried sigma_l", np.float64, ()),
    ("independent_beams sigma_map sigma_map_yaw odom_sigma_xy odom_sigma_yaw bias_scale", np.float64, ()),
    ("odom_sigma_floor antenna", np.float64, (2,)),
    ("lidar", np.float32, (3,)),
)
"""Params but for bias and height."""
STATE = _record(
    ("map_spread_views map_spread_way map_spread_epoch", np.float32, ()),
    ("scans_drawn", np.int32, ()),
    ("frame_slots", np.int32, (2,)),
    ("unrest grid_origin", np.float32, (2,)),
    ("drawn_pose", np.float32, (3,)),
    ("map_spread_apart", np.float32, (3, 3)),
)
"""State but for belief, nodes, scatter and the window's cells."""
FRAME = _record(
    ("dt", np.float64, ()),
    ("has_scan odometry_valid", np.bool_, ()),
    ("odometry_increment", np.float64, (3,)),
    ("scan_angle_min scan_angle_increment scan_time_increment", np.float32, ()),
)
"""Frame but for beams and ranges."""
TOLD = _record(
    ("pose map_error matched_pose", np.float32, (3,)),
    ("pose_cov information", np.float32, (3, 3)),
    ("velocity", np.float32, (2,)),
    ("yaw_rate score known log_likelihood", np.float32, ()),
    ("poor searched drawn", np.bool_, ()),
)
"""Estimate but for beacons and ranges."""


class Belief(NamedTuple):
    """Twin: numerics.Gaussian, in float64 and changed in place."""

    mean: Float[ndarray, "n"]
    cov: Float[ndarray, "n n"]


class Model(NamedTuple):
    """Twin: Params. params: PARAMS. bias, height: (K,) [m]."""

    params: Record
    bias: Float[ndarray, "K"]
    height: Float[ndarray, "K"]


class Memory(NamedTuple):
    """Twin: State but for the window.

    Attributes:
      state: STATE. mean, cov: of the belief. nodes: (2, K) active and moving, 1 or 0. scatter: (3, K, K) log, last and
        heard.
    """

    state: Record
    mean: Float[ndarray, "n"]
    cov: Float[ndarray, "n n"]
    nodes: Float[ndarray, "2 K"]
    scatter: Float[ndarray, "3 K K"]


class Measured(NamedTuple):
    """Twin: Frame.

    Attributes:
      frame: FRAME. beams: (2, B) range and valid. slots: (2, M) i and j of the ranges. ranges: (4, M) range, age,
        power gap and valid.
    """

    frame: Record
    beams: Float[ndarray, "2 B"]
    slots: Float[ndarray, "2 M"]
    ranges: Float[ndarray, "4 M"]


class Told(NamedTuple):
    """Twin: Estimate. told: TOLD. ranges: (3, M) innovation, normalised and weight."""

    told: Record
    ranges: Float[ndarray, "3 M"]


class Leaves:
    """The leaves of a tree, and where in the buffers each of them lies."""

    def __init__(self, like: Any, targets: Mapping[str, np.ndarray]):
        """Args: like: a tree of the structure. targets: by the path of a leaf, its parts joined by _.

        Raises:
          TypeError: the tree has other leaves than there are targets.
        """
        found, self._structure = tree_flatten_with_path(like)
        names = ["_".join(part for part in keystr(path).split(".") if part) for path, _ in found]
        if set(names) != set(targets):
            raise TypeError(f"{type(like).__name__}: {sorted(set(names) ^ set(targets))} known to one engine only")
        self._targets = [targets[name] for name in names]
        self._dtypes = [leaf.dtype for _, leaf in found]

    def write(self, tree: Any) -> None:
        """A tree into the buffers; a leaf that lies there already is left alone."""
        for target, leaf in zip(self._targets, jax.tree.leaves(tree), strict=True):
            if leaf is not target:
                target[...] = leaf

    def view(self) -> Any:
        """The tree; a leaf is the buffer itself where that has the leaf's type."""
        leaves = [t.astype(d, copy=False) for t, d in zip(self._targets, self._dtypes, strict=True)]
        return jax.tree.unflatten(self._structure, leaves)


def fields(records: np.ndarray) -> dict[str, np.ndarray]:
    """The fields of an array of one record."""
    return {name: records[name].reshape(records[name].shape[1:]) for name in records.dtype.names or ()}
