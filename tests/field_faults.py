"""What goes wrong with recordings in the field, as changes of the rows of a `field_log`."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable

import field_log
import numpy as np
import transform_log
from field_log import BEAMS, HALF, LONG, ODOM, SCAN, T0, UWB, Row, Rows, S, of, still

WALL = 1_790_000_000 * S
"""Another time than the stamps' [ns]."""
Fault = Callable[[Rows], Rows]


def each(topics: str | tuple[str, ...], change: Callable[[Row], object], since: int = 0, until: int = WALL) -> Fault:
    """A fault of every message of some topics that was logged in a time [ns]."""
    names = (topics,) if isinstance(topics, str) else topics

    def spoil(rows: Rows) -> Rows:
        for row in rows:
            if row.topic in names and since <= row.log < until:
                change(row)
        return rows

    return spoil


ALL = (SCAN, UWB, ODOM)


def every(topic: str, n: int, change: Callable[[Row], object]) -> Fault:
    """A fault of every n-th message of a topic."""

    def spoil(rows: Rows) -> Rows:
        for row in of(rows, topic)[::n]:
            change(row)
        return rows

    return spoil


def fields(**values: object) -> Callable[[Row], object]:
    """Sets fields of a message."""
    return lambda row: [setattr(row.message, name, value) for name, value in values.items()]


def times(**factors: float) -> Callable[[Row], object]:
    """Multiplies fields of a message."""
    return lambda row: [
        setattr(row.message, name, getattr(row.message, name) * factor) for name, factor in factors.items()
    ]


def readings(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Row], object]:
    return lambda row: setattr(row.message, "ranges", change(row.message.ranges).astype(np.float32))


def called(names: dict[int, int]) -> Callable[[Row], object]:
    """Nodes of other ids."""

    def change(row: Row) -> None:
        row.message.source = names.get(row.message.source, row.message.source)
        row.message.target = names.get(row.message.target, row.message.target)

    return change


def simulated(rows: Rows, start: int) -> Rows:
    """Stamps count from the start of a simulation, log times are a computer's."""
    for row in rows:
        row.later(start - T0, log=False)
        row.log += WALL - T0
    return rows


def no_stamp_at_first(rows: Rows) -> Rows:
    for topic in (SCAN, UWB):
        for row in of(rows, topic)[:2]:
            row.stamp = 0
    return simulated(rows, S)


def turned_over(row: Row) -> None:
    """The other order in space and time."""
    m = row.message
    row.later(round(m.time_increment * (BEAMS - 1) * S), log=False)
    m.ranges, m.time_increment = m.ranges[::-1].copy(), -m.time_increment


def clockwise(row: Row) -> None:
    turned_over(row)
    m = row.message
    m.angle_min, m.angle_max, m.angle_increment = m.angle_max, m.angle_min, -m.angle_increment


def turned_back(row: Row) -> None:
    row.message.angle_min += math.pi
    row.message.angle_max += math.pi


def mirrored(row: Row) -> None:
    turned_over(row)
    m = row.message
    m.angle_min, m.angle_max = -m.angle_max, -m.angle_min


def upside_down(rows: Rows) -> Rows:
    return [*each(SCAN, mirrored)(rows), still((math.pi, 0.0, 0.0))]


def thinned(row: Row) -> None:
    """A number of readings that varies, with an increment that fits."""
    m = row.message
    every = 1 + row.stamp // (S // 10) % 3
    m.ranges, m.time_increment = m.ranges[::every].copy(), m.time_increment * every
    m.angle_increment *= every
    m.angle_max = m.angle_min + m.angle_increment * (m.ranges.size - 1)


def invalid(row: Row) -> None:
    """REP 117."""
    m = row.message
    m.ranges = m.ranges.copy()
    m.ranges[::17], m.ranges[5::17], m.ranges[9::17] = -np.inf, np.nan, np.inf


def in_transforms(row: Row) -> None:
    p = row.message.pose.pose
    place, yaw = (p.position.x, p.position.y, 0.0), 2 * math.atan2(p.orientation.z, p.orientation.w)
    row.message = transform_log.transform(row.stamp, "odom", "base_link", place, (0.0, 0.0, yaw))
    row.topic = "/tf"


def restarted(rows: Rows) -> Rows:
    """The base begins at zero again."""
    start = field_log.wheels(2.5)
    for row in of(rows, ODOM):
        if row.stamp >= HALF:
            x, y, yaw = field_log.wheels((row.stamp - T0) / S)
            c, s, dx, dy = math.cos(start[2]), math.sin(start[2]), x - start[0], y - start[1]
            row.message = field_log.odometry(row.stamp, (c * dx + s * dy, c * dy - s * dx, yaw - start[2]))
    return rows


def looped(rows: Rows) -> Rows:
    again = copy.deepcopy(rows)
    for row in again:
        row.log += LONG
        row.arrival += LONG
    return rows + again


def twice(rows: Rows) -> Rows:
    again = copy.deepcopy(of(rows, SCAN))
    for row in again:
        row.arrival += 1
    return rows + again


def standing(rows: Rows) -> Rows:
    """Three seconds of the first again and again before the drive."""
    first, rng = [row for row in rows if row.stamp < T0 + S], np.random.default_rng(0)
    for row in rows:
        row.later(3 * S)
        row.arrival = row.log
    for k in range(3):
        for row in copy.deepcopy(first):
            row.later(k * S - 3 * S)
            row.arrival = row.log
            if row.topic == SCAN:
                row.message.ranges += (0.01 * rng.normal(size=BEAMS)).astype(np.float32)
            rows.append(row)
    return rows


def own_posts(rows: Rows) -> Rows:
    posts = np.arange(BEAMS) % 30 < 2
    return each(SCAN, readings(lambda r: np.where(posts, 0.22, r)))(rows)


def one(topic: str, change: Callable[[Row], object], number: int = 40) -> Fault:
    def spoil(rows: Rows) -> Rows:
        change(of(rows, topic)[number])
        return rows

    return spoil


def no_quaternion(row: Row) -> None:
    q = row.message.pose.pose.orientation
    q.x = q.y = q.z = q.w = 0.0


def in_halves(rows: Rows) -> Rows:
    """Two messages a sweep, as some drivers publish each half turn."""
    for row in of(rows, SCAN):
        first, second = row.message, copy.deepcopy(row.message)
        half = first.ranges.size // 2
        first.ranges, second.ranges = first.ranges[:half].copy(), second.ranges[half:].copy()
        second.angle_min = first.angle_min + half * first.angle_increment
        first.angle_max = second.angle_min - first.angle_increment
        late = round(half * first.time_increment * S)
        rows.append(Row(SCAN, row.log + late, second))
        rows[-1].stamp = row.stamp + late
    return rows


def copied(late: int) -> Fault:
    """Scans and ranges once more, so much later [ns]."""

    def spoil(rows: Rows) -> Rows:
        again = copy.deepcopy([row for row in rows if row.topic in (SCAN, UWB)])
        for row in again:
            row.log += late
            row.arrival += late
        return rows + again

    return spoil


def shuffled(rows: Rows) -> Rows:
    """Logged up to two seconds late, each message for itself."""
    rng = np.random.default_rng(0)
    for row in rows:
        row.log += int(rng.integers(2 * S))
        row.arrival = row.log
    return rows


def in_bursts(rows: Rows) -> Rows:
    """Scans over a network that lets go once a second."""
    for row in of(rows, SCAN):
        row.log = row.arrival = row.log // S * S + S
    return rows


def on_other_topics_too(rows: Rows) -> Rows:
    """A filtered scan, and a second program that publishes the radio's ranges."""
    again = copy.deepcopy([row for row in rows if row.topic in (SCAN, UWB)])
    for row in again:
        row.topic += "_again"
    return rows + again


def both_ends(rows: Rows) -> Rows:
    """Both nodes tell of each exchange."""
    again = copy.deepcopy(of(rows, UWB))
    for row in again:
        row.message.source, row.message.target = row.message.target, row.message.source
        row.arrival += 1
    return rows + again


def nanosec_counts_us(row: Row) -> None:
    row.stamp -= row.stamp % S - row.stamp % S // 1000


def unchanged(rows: Rows) -> Rows:
    return rows


def of_the_robot(rows: Rows) -> Rows:
    return [row for row in rows if row.topic != UWB or 0 in (row.message.source, row.message.target)]
