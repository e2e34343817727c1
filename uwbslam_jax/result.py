"""What a run hands over when it ends: host data for files, report and evaluation. No computation, no files."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from typing import Any

import numpy as np

OCCUPIED_THRESHOLD = 0.65
"""Probability from which a cell is a wall [1]: map_server's default."""
_OCCUPIED, _FREE, _UNKNOWN = 0, 254, 205
"""Gray values of map_server's trinary maps [0 to 255]."""


class RunStatus(StrEnum):
    """How far start-up is; the value is what files and pages say.

    UNSEEN: a run ended waiting for motion that no scan and no odometry could have shown.
    """

    LIDAR_ONLY = "LiDAR only"
    WAITING = "waiting for motion"
    UNSEEN = "motion not known"
    PLACING = "placing beacons"
    UNDECIDED = "reflection undecided"
    DECIDED = "decided"


class BeaconStatus(StrEnum):
    """What a beacon does, as the run has it.

    WAITING: heard but not placed. RELATIVE: the robot has not moved, only the geometry among the nodes is known, in a
    frame of its own.
    """

    STATIC = "static"
    MOVING = "moving"
    SILENT = "silent"
    DROPPED = "dropped"
    WAITING = "waiting"
    RELATIVE = "relative"


class EventKind(Enum):
    """What happened in a run; the value is its sentence, {} stands for an event's detail."""

    STATUS = "{}"
    WAITS = "start-up waits: {}"
    FRAME_DECIDED = "frame decided by beacons {}"
    CORRECTED = "beacons and map corrected by the run so far"
    BIASED = "ranges are biased: biases and beacons solved from the run so far"
    LOCALISING = "localising in a saved map"
    RESUMED = "going on from a saved run"
    ROBOT_CARRIED = "robot was carried: found again by its ranges"
    PLACED = "placed"
    PLACED_MOVING = "placed while it is carried"
    CARRIED = "is being carried"
    PUT_DOWN = "was put down: rests at a new place"
    MOVED = "was moved: rests at a new place"
    LOST_MOVING = "was lost while carried"
    SILENT_MOVING = "fell silent while it was carried"
    SILENT = "fell silent"
    HEARD_AGAIN = "is heard again"
    DROPPED = "dropped: not heard for a minute"
    DOUBTED = "ranges do not fit ({} m): a clock, walls, or it was moved"
    FITS_AGAIN = "ranges fit again"


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened in a run.

    Attributes:
      stamp: when [ns].
      kind: what.
      node: id of the beacon that it happened to, None where it is the robot or the run as a whole.
      detail: what the kind leaves open.
    """

    stamp: int
    kind: EventKind
    node: int | None = None
    detail: str = ""

    @property
    def text(self) -> str:
        """The event as a sentence for people."""
        return ("" if self.node is None else f"beacon {self.node} ") + self.kind.value.format(self.detail)


@dataclass(frozen=True, slots=True)
class BeaconEstimate:
    """Last estimate of one beacon ever placed, in the published frame.

    Attributes:
      id: the node's id.
      position: (2,) [m].
      cov: (2, 2) [m^2].
      status: see there.
      z, sigma_z: of its antenna above the floor, as configured (sigma 0) or found; NaN where neither is the case [m].
    """

    id: int
    position: np.ndarray
    cov: np.ndarray
    status: BeaconStatus
    z: float = math.nan
    sigma_z: float = math.nan


@dataclass(frozen=True, slots=True)
class MapImage:
    """Occupancy of the finest level in the published frame.

    Attributes:
      log_odds: (rows, cols) float32; row 0 is the smallest y; exactly 0 where never observed.
      resolution: side of a cell [m].
      origin: (2,) corner of cell (0, 0), the smallest x and y [m].
    """

    log_odds: np.ndarray
    resolution: float
    origin: np.ndarray


@dataclass(slots=True)
class Result:
    """Everything a run found. T frames from the first scan on (from the first odometry where there is no scan), all
    poses in the published frame.

    Attributes:
      stamps: (T,) int64 [ns].
      poses: (T, 3) x, y, yaw as estimated from the whole run [m, m, rad].
      online: (T, 3) as they were published along the way; those from before the frame was decided were filled in then.
      online_covs: (T, 3, 3) of these [m, m, rad].
      beacons: last estimate of every beacon ever placed.
      beacon_tracks: id -> (n, 4) of t [s since stamps[0]], x, y, sigma [m], thinned; for plots.
      map: the occupancy map.
      range_residuals: (R, 4) of t [s since stamps[0]], node a, node b, measured minus predicted [m]; thinned.
      scan_points: last scan in the published frame (n, 2) [m].
      diagnostics: name -> (T,) array, one value a frame (match score, hypotheses, searches, ranges used ...).
      events: of start-up and beacon life.
      summary: the content of summary.json (docs/formats.md), without evaluation figures.
    """

    stamps: np.ndarray
    poses: np.ndarray
    online: np.ndarray
    online_covs: np.ndarray
    beacons: list[BeaconEstimate]
    beacon_tracks: dict[int, np.ndarray]
    map: MapImage
    range_residuals: np.ndarray
    scan_points: np.ndarray
    diagnostics: dict[str, np.ndarray] = field(default_factory=dict)
    events: list[Event] = field(default_factory=list)
    summary: dict[str, Any] = field(default_factory=dict)


def crop(image: MapImage) -> MapImage:
    """The smallest part of a map that holds every observed cell; a single unknown cell where there is none."""
    rows, columns = (np.flatnonzero((image.log_odds != 0).any(axis=axis)) for axis in (1, 0))
    if rows.size == 0:
        return MapImage(np.zeros((1, 1), np.float32), image.resolution, np.asarray(image.origin, dtype=np.float64))
    part = image.log_odds[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    origin = np.asarray(image.origin, dtype=np.float64) + image.resolution * np.array([columns[0], rows[0]])
    return MapImage(part, image.resolution, origin)


def trinary(log_odds: np.ndarray) -> np.ndarray:
    """Gray values of map_server: 0 occupied (probability over 0.65), 254 free (seen, more free than not), 205 else.

    A cell counts as free from its first miss on, as in HectorSLAM's published map: few beams cross a far cell twice.
    """
    occupied = log_odds > math.log(OCCUPIED_THRESHOLD / (1 - OCCUPIED_THRESHOLD))
    return np.select([occupied, log_odds < 0], [_OCCUPIED, _FREE], _UNKNOWN).astype(np.uint8)
