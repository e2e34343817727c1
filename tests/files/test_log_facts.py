"""What `inspect` notes of a recording, by messages of which one thing is peculiar."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from uwbslam_jax.files.log_facts import LogFacts
from uwbslam_jax.measurements import Message, OdometryMessage, RangeMessage, ScanMessage

S = 1_000_000_000
T0 = 1_790_000_000 * S


def messages() -> list[Message]:
    """30 s of a robot that drives: scans whose walls come nearer, ranges to two beacons, wheels."""
    found: list[Message] = []
    for k in range(300):
        stamp = T0 + k * S // 10
        walls = np.linspace(2.0, 8.0, 90, dtype=np.float32) - np.float32(0.005 * k)
        found.append(ScanMessage(stamp, 0.0, 0.07, 1e-4, 0.1, 30.0, walls))
        found += [RangeMessage(stamp + 1 + node, 0, node, 3.0 + 0.01 * k) for node in (4, 7)]
        found.append(OdometryMessage(stamp + 9, 0.02 * k, 0.0, 0.0))
    return found


def notes(changed: list[Message]) -> list[str]:
    facts = LogFacts()
    facts.take(changed)
    return facts.notes()


def test_there_is_nothing_to_note_of_a_good_recording() -> None:
    assert notes(messages()) == []
    assert notes([]) == []


def test_a_pause_is_noted_with_its_time() -> None:
    late = [m if m.stamp < T0 + 15 * S else dataclasses.replace(m, stamp=m.stamp + 600 * S) for m in messages()]
    assert notes(late)[0] == "nothing was measured for 600.1 s after 14.9 s"


def test_nodes_that_come_and_go_are_noted() -> None:
    changed = [
        dataclasses.replace(m, target=105)
        if isinstance(m, RangeMessage) and m.target == 7 and m.stamp > T0 + 15 * S
        else m
        for m in messages()
    ]
    assert notes(changed) == ["node 105 is first heard after 15.0 s", "node 7 is last heard after 14.9 s"]


@pytest.mark.parametrize("posts", [3, 20])
def test_the_robots_own_posts_are_noted_with_the_flag_that_helps(posts: int) -> None:
    def seen(m: Message) -> Message:
        if not isinstance(m, ScanMessage):
            return m
        return dataclasses.replace(m, ranges=np.where(np.arange(90) < posts, np.float32(0.22), m.ranges))

    (line,) = notes([seen(m) for m in messages()])
    assert line.startswith(f"{posts} bearings see the same 0.22 to 0.22 m")
    assert line.endswith("--lidar.min-range 0.3")


def test_a_robot_at_rest_shows_no_posts_of_its_own() -> None:
    near = np.full(90, 0.3, np.float32)
    assert notes([dataclasses.replace(m, ranges=near) for m in messages() if isinstance(m, ScanMessage)]) == []


def test_sizes_that_vary_and_sweeps_without_a_time_are_noted() -> None:
    scans = [m for m in messages() if isinstance(m, ScanMessage)]
    changed = [dataclasses.replace(m, ranges=m.ranges[: 90 - k % 3], time_increment=0.0) for k, m in enumerate(scans)]
    assert notes(changed) == [
        "scans have 88 to 90 readings",
        "scans have no time_increment: if the LiDAR turns, its sweeps are bent by the robot's motion",
    ]


def test_odometry_that_jumps_is_noted() -> None:
    changed = [
        dataclasses.replace(m, x=m.x - 3.0) if isinstance(m, OdometryMessage) and m.stamp > T0 + 15 * S else m
        for m in messages()
    ]
    (line,) = notes(changed)
    assert line.startswith("odometry jumps (1 times, first after 15.")
