"""What a recording's first ranges tell: the unit, and which node is the robot's; good recordings are left alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from uwbslam_jax import api
from uwbslam_jax.files import LogWriter, Recording, inspect_log
from uwbslam_jax.measurements import Message, RangeMessage, ScanMessage
from uwbslam_jax.settings import Settings, UwbSettings

T0 = 1_700_000_000_000_000_000
SPOTS = {3: (0.0, 0.0), 5: (8.0, 1.0), 7: (7.0, 6.0), 9: (-1.0, 5.0)}
"""Beacons [m]."""


def drive(
    robot: int = 0,
    *,
    unit: float = 1.0,
    all_pairs: bool = True,
    rest_s: float = 0.0,
    noise: float = 0.05,
    beacons: dict[int, tuple[float, float]] = SPOTS,
    whole: bool = False,
) -> list[Message]:
    """12 s of ranges at 10 Hz a pair and a scan every second, of a robot that drives a circle after a rest."""
    rng = np.random.default_rng(0)
    messages: list[Message] = []
    for k in range(120):
        stamp, turn = T0 + k * 100_000_000, 0.5 * max(k / 10 - rest_s, 0.0)
        if k % 10 == 0:
            messages.append(ScanMessage(stamp, 0.0, 0.1, 0.0, 0.1, 30.0, np.linspace(1.0, 4.0, 60, dtype=np.float32)))
        places = {robot: (3.0 + 2 * np.cos(turn), 3.0 + 2 * np.sin(turn)), **beacons}
        nodes = list(places)
        pairs = [(a, b) for i, a in enumerate(nodes) for b in nodes[i + 1 :] if all_pairs or a == robot]
        for a, b in pairs:
            distance = (np.hypot(*np.subtract(places[a], places[b])) + rng.normal(0, noise)) * unit
            messages.append(RangeMessage(stamp + 1, a, b, float(np.rint(distance) if whole else distance)))
    return messages


def written(path: Path, messages: Sequence[Message]) -> Path:
    with LogWriter(path) as writer:
        for message in messages:
            writer.write(message)
    return path


def ranges(source: Recording) -> list[RangeMessage]:
    return [m for m in source if isinstance(m, RangeMessage)]


@pytest.mark.parametrize("how", [{}, {"all_pairs": False}, {"rest_s": 8.0}, {"noise": 0.0}, {"noise": 0.5}])
def test_a_good_recording_is_left_alone(tmp_path: Path, how: dict[str, Any]) -> None:
    messages = drive(**how)
    reader = Recording(written(tmp_path / "a.mcap", messages))
    wanted = [float(np.float32(m.range)) for m in messages if isinstance(m, RangeMessage)]
    assert [m.range for m in ranges(reader)] == wanted
    assert (reader.warnings, reader.robot_id) == ([], 0)


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1000.0), ("cm", 100.0)])
@pytest.mark.parametrize("how", [{}, {"all_pairs": False}, {"whole": True}, {"noise": 0.02}, {"noise": 0.15}])
def test_other_units_are_found_out(tmp_path: Path, unit: str, factor: float, how: dict[str, Any]) -> None:
    reader = Recording(written(tmp_path / "a.mcap", drive(unit=factor, **how)))
    assert 0.3 < np.median([m.range for m in ranges(reader)]) < 10.0
    assert reader.dropped.total() == 0
    assert f"say --uwb.unit {unit}, else --uwb.unit m" in reader.warnings[0]
    told = Recording(tmp_path / "a.mcap", uwb=UwbSettings(unit="cm" if unit == "cm" else "mm"))
    np.testing.assert_allclose([m.range for m in ranges(told)], [m.range for m in ranges(reader)])
    assert told.warnings == []
    assert any("--uwb.unit" in problem for problem in inspect_log(tmp_path / "a.mcap").problems)
    as_they_are = Recording(tmp_path / "a.mcap", uwb=UwbSettings(unit="m"))
    assert all(m.range <= 200 for m in ranges(as_they_are))


@pytest.mark.parametrize("how", [{}, {"all_pairs": False}, {"rest_s": 7.0}, {"unit": 1000.0}])
@pytest.mark.parametrize("beacons", [SPOTS, {0: (0.0, 0.0), 5: (8.0, 1.0), 7: (7.0, 6.0)}], ids=["others", "beacon 0"])
def test_the_robots_node_is_found(tmp_path: Path, how: dict[str, Any], beacons: dict[int, tuple[float, float]]) -> None:
    path = written(tmp_path / "a.mcap", drive(27, beacons=beacons, **how))
    reader = Recording(path)
    if 0 in beacons and how.get("all_pairs", True):
        assert reader.robot_id == 0  # in several pairs: nothing is changed that may be right
        assert any("if that is the robot's, say --robot.id 27" in told for told in reader.warnings)
        return
    assert reader.robot_id == 27
    assert any("--robot.id 27" in told for told in reader.warnings)
    assert any("--robot.id 27" in problem for problem in inspect_log(path).problems)
    _, settings = api._opened(path, Settings())
    assert settings.robot.id == 27
    assert not any("robot.id" in told for told in Recording(path, robot_id=27).warnings)


def test_one_beacon_that_ranges_to_all_is_not_the_robot(tmp_path: Path) -> None:
    messages = [m for m in drive() if not isinstance(m, RangeMessage) or 3 in (m.source, m.target)]
    reader = Recording(written(tmp_path / "a.mcap", messages))
    assert (reader.robot_id, reader.warnings) == (0, [])


def test_a_robot_that_nothing_tells_is_asked_for(tmp_path: Path) -> None:
    resting = drive(27, rest_s=30.0)
    reader = Recording(written(tmp_path / "a.mcap", resting))
    assert reader.robot_id == 0
    assert "never heard among the nodes 3, 5, 7, 9, 27: name the robot's own, --robot.id ID" in reader.warnings[0]


def test_nodes_without_a_robot_are_no_fault(tmp_path: Path) -> None:
    among = [m for m in drive() if isinstance(m, RangeMessage) and 0 not in (m.source, m.target)]
    assert Recording(written(tmp_path / "a.mcap", among)).warnings == []


def test_ids_heard_once_say_nothing(tmp_path: Path) -> None:
    junk: list[Message] = [RangeMessage(T0 + k, 40_000 + k, 50_000 + k, 3.0) for k in range(8)]
    reader = Recording(written(tmp_path / "a.mcap", [*junk, *drive(27, all_pairs=False)]))
    assert reader.robot_id == 27
