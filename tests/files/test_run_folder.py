"""The files of a run directory, read back by other means than those that wrote them."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

from uwbslam_jax.errors import RunError
from uwbslam_jax.files.run_folder import read_run, read_trajectory, write_result, write_trajectory
from uwbslam_jax.result import BeaconEstimate, BeaconStatus, Event, EventKind, MapImage, Result, trinary

T0 = 1_700_000_000_123_456_789  # ns; no float64 holds it
FRAMES = 60


def make_result() -> Result:
    """Six seconds at 10 Hz, the first five poses undecided; three beacons, a map of which 3 x 4 cells were seen."""
    stamps = T0 + np.arange(FRAMES, dtype=np.int64) * 100_000_000
    turn = np.linspace(-3.0, 3.0, FRAMES)
    poses = np.stack([np.cos(turn), np.sin(turn), turn], axis=1)
    poses[:5] = np.nan
    covs = np.tile(np.array([[0.01, 0.002, 0.003], [0.002, 0.04, 0.005], [0.003, 0.005, 0.09]]), (FRAMES, 1, 1))
    log_odds = np.zeros((20, 30), np.float32)
    log_odds[4:7, 10:14] = [[3.0, -0.4, -3.0, 0.0], [0.3, 3.0, -3.0, -3.0], [-3.0, 0.0, 0.0, 5.0]]
    seconds = np.arange(0.0, 6.0, 0.5)
    track = np.stack([seconds, np.full(12, 1.0), np.full(12, 2.0), np.full(12, 0.2)], axis=1)
    return Result(
        stamps=stamps,
        poses=poses,
        online=poses + 0.25,
        online_covs=covs,
        beacons=[
            BeaconEstimate(4_000_000_000, np.array([5.0, 6.0]), np.diag([0.01, 0.04]), BeaconStatus.SILENT),
            BeaconEstimate(1, np.array([1.0, 2.0]), np.diag([0.04, 0.01]), BeaconStatus.STATIC, 1.4, 0.02),
        ],
        beacon_tracks={1: track, 4_000_000_000: track[6:]},
        map=MapImage(log_odds, 0.05, np.array([-1.0, -2.0])),
        range_residuals=np.zeros((0, 4)),
        scan_points=np.zeros((0, 2)),
        diagnostics={"score": np.linspace(0, 1, FRAMES), "hypotheses": np.ones(FRAMES, np.int64)},
        events=[Event(T0, EventKind.STATUS, detail="waiting for motion")],
        summary={
            "steps": np.int64(FRAMES),
            "step_ms_median": np.float32(1 / 3),
            "robot_rmse_m": math.nan,
            "worst": math.inf,
            "dropped": {"range: malformed": 2},
            "ids": [1, np.uint32(7)],
            "frame": None,
            "decided": True,
            "where": Path("x"),
            "cov": np.eye(2),
        },
    )


@pytest.fixture
def run(tmp_path: Path) -> Path:
    write_result(make_result(), tmp_path / "a" / "run")
    return tmp_path / "a" / "run"


def test_every_file_is_there(run: Path) -> None:
    names = {"trajectory.tum", "beacons.csv", "map.pgm", "map.yaml", "result.mcap", "summary.json"}
    assert {path.name for path in run.iterdir()} == names


def test_trajectory(run: Path) -> None:
    result = make_result()
    lines = (run / "trajectory.tum").read_text().splitlines()
    assert len(lines) == FRAMES - 5  # undecided poses are left out
    assert lines[0].startswith("1700000000.623456789 ")
    table = np.array([[float(word) for word in line.split()] for line in lines])
    assert table.shape == (FRAMES - 5, 8)
    np.testing.assert_allclose(table[:, 1:3], result.poses[5:, :2], atol=1e-6)
    np.testing.assert_allclose(2 * np.arctan2(table[:, 6], table[:, 7]), result.poses[5:, 2], atol=1e-8)
    assert (table[:, 3:6] == 0).all()


@given(st.lists(st.integers(0, 2**62), min_size=1, max_size=20), st.floats(-1e4, 1e4), st.floats(-3.14, 3.14))
def test_no_nanosecond_is_lost(tmp_path_factory: Any, stamps: list[int], x: float, yaw: float) -> None:
    path = tmp_path_factory.mktemp("run") / "trajectory.tum"
    write_trajectory(np.array(stamps, dtype=np.int64), np.tile([x, -x, yaw], (len(stamps), 1)), path)
    found, poses = read_trajectory(path)
    assert found.tolist() == stamps
    np.testing.assert_allclose(poses, np.tile([x, -x, yaw], (len(stamps), 1)), atol=1e-6)


def test_beacons(run: Path) -> None:
    with (run / "beacons.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["id"] for row in rows] == ["1", "4000000000"]
    first = {"id": "1", "x": "1.000000", "y": "2.000000", "sigma_x": "0.200000", "sigma_y": "0.100000"}
    assert rows[0] == first | {"z": "1.400000", "sigma_z": "0.020000", "status": "static"}
    assert (rows[1]["z"], rows[1]["sigma_z"], rows[1]["status"]) == ("", "", "silent")


def read_pgm(path: Path) -> np.ndarray:
    """(rows, columns) uint8, the first row at the top."""
    lines = path.read_bytes().split(b"\n", 4)
    assert lines[0] == b"P5"
    columns, rows = (int(word) for word in lines[2].split())
    assert lines[3] == b"255"
    return np.frombuffer(lines[4], np.uint8).reshape(rows, columns)


def test_map(run: Path) -> None:
    gray = read_pgm(run / "map.pgm")
    assert gray.tolist() == [[254, 205, 205, 0], [205, 0, 254, 254], [0, 254, 254, 205]]
    settings = dict(line.split(": ") for line in (run / "map.yaml").read_text().splitlines())
    assert settings["image"] == "map.pgm"
    assert settings["mode"] == "trinary"
    assert float(settings["resolution"]) == 0.05
    assert json.loads(settings["origin"]) == [-0.5, -1.8, 0.0]
    assert (settings["negate"], settings["occupied_thresh"], settings["free_thresh"]) == ("0", "0.65", "0.196")


def test_map_server_reads_the_same_three_classes(run: Path) -> None:
    """nav2_map_server's rule: p = (255 - gray) / 255; over occupied_thresh occupied, under free_thresh free."""
    p = (255 - read_pgm(run / "map.pgm").astype(float)) / 255
    classes = np.select([p > 0.65, p < 0.196], [1, 0], -1)
    assert classes.tolist() == [[0, -1, -1, 1], [-1, 1, 0, 0], [1, 0, 0, -1]]


def test_a_map_never_seen_is_one_unknown_cell(tmp_path: Path) -> None:
    result = make_result()
    result.map = MapImage(np.zeros((5, 5), np.float32), 0.05, np.zeros(2))
    write_result(result, tmp_path)
    assert read_pgm(tmp_path / "map.pgm").tolist() == [[205]]


def test_trinary_at_the_thresholds() -> None:
    edge = math.log(0.65 / 0.35)
    log_odds = np.array([[edge + 1e-3, edge - 1e-3, 1e-6, 0.0, -1e-6, -50.0, 50.0]], np.float32)
    assert trinary(log_odds).tolist() == [[0, 205, 205, 205, 254, 254, 0]]


def test_summary(run: Path) -> None:
    found = json.loads((run / "summary.json").read_text())
    assert found == {
        "steps": FRAMES,
        "step_ms_median": 0.333333,
        "robot_rmse_m": None,
        "worst": None,
        "dropped": {"range: malformed": 2},
        "ids": [1, 7],
        "frame": None,
        "decided": True,
        "where": "x",
        "cov": [[1.0, 0.0], [0.0, 1.0]],
    }


def test_read_run(run: Path) -> None:
    result, found = make_result(), read_run(run)
    assert found.stamps.tolist() == result.stamps[5:].tolist()
    np.testing.assert_allclose(found.poses, result.poses[5:], atol=1e-6)
    assert found.beacon_ids.tolist() == [1, 4_000_000_000]
    assert found.beacons.tolist() == [[1.0, 2.0], [5.0, 6.0]]
    assert found.beacon_sigmas.tolist() == [[0.2, 0.1], [0.1, 0.2]]
    assert found.beacon_status == ["static", "silent"]
    assert found.summary["steps"] == FRAMES


def test_an_empty_run(tmp_path: Path) -> None:
    empty = np.zeros((0, 4))
    image = MapImage(np.zeros((0, 0), np.float32), 0.05, np.zeros(2))
    covs = np.zeros((0, 3, 3))
    none = np.zeros((0, 3))
    write_result(Result(np.zeros(0, np.int64), none, none, covs, [], {}, image, empty, empty[:, :2]), tmp_path)
    found = read_run(tmp_path)
    assert found.stamps.shape == (0,)
    assert found.poses.shape == (0, 3)
    assert found.beacons.shape == (0, 2)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("trajectory.tum", None, "No such file"),
        ("trajectory.tum", "# t x\n1.5 0 0 0 0 0 0 1\n1.5 0 0\n", "line 3"),
        ("trajectory.tum", "x 0 0 0 0 0 0 1\n", "line 1"),
        ("beacons.csv", None, "No such file"),
        ("beacons.csv", "id,x\n1,2\n", "not a table of"),
        ("beacons.csv", "id,x,y,sigma_x,sigma_y,status\n1,2,three,4,5,static\n", "not a table of"),
        ("beacons.csv", "id,x,y,sigma_x,sigma_y,status\n1,2,3,4,5,gone\n", "'gone' is not a valid BeaconStatus"),
        ("summary.json", "{", "summary.json"),
    ],
)
def test_a_run_that_cannot_be_read(run: Path, name: str, content: str | None, says: str) -> None:
    (run / name).unlink()
    if content is not None:
        (run / name).write_text(content)
    with pytest.raises(RunError, match=says) as caught:
        read_run(run)
    assert str(run / name) in str(caught.value)


class TestResultLog:
    """result.mcap through mcap-ros2-support, which shares no code with what wrote it."""

    @pytest.fixture
    def messages(self, run: Path) -> list[tuple[str, int, Any]]:
        reader = pytest.importorskip("mcap_ros2.reader")
        found = reader.read_ros2_messages(str(run / "result.mcap"), log_time_order=False)
        return [(m.channel.topic, m.log_time_ns, m.ros_msg) for m in found]

    def test_topics_and_order(self, messages: list[tuple[str, int, Any]]) -> None:
        topics = [topic for topic, _, _ in messages]
        counts = {topic: topics.count(topic) for topic in set(topics)}
        poses = FRAMES - 5
        wanted = {"/map": 1, "/path": 1, "/pose": poses, "/tf": poses + 1, "/diagnostics": FRAMES, "/beacons": 7}
        assert counts == wanted
        times = [time for _, time, _ in messages]
        assert times == sorted(times)

    def test_map(self, messages: list[tuple[str, int, Any]]) -> None:
        (grid,) = (m for topic, _, m in messages if topic == "/map")
        assert (grid.info.width, grid.info.height) == (4, 3)
        assert grid.info.resolution == pytest.approx(0.05)
        assert (grid.info.origin.position.x, grid.info.origin.position.y) == pytest.approx((-0.5, -1.8))
        assert list(grid.data) == [95, 40, 5, -1, 57, 95, 5, 5, 5, -1, -1, 99]
        assert grid.header.frame_id == "map"

    def test_poses(self, messages: list[tuple[str, int, Any]]) -> None:
        result = make_result()
        poses = [m for topic, _, m in messages if topic == "/pose"]
        last = poses[-1]
        assert last.header.stamp.sec * 10**9 + last.header.stamp.nanosec == result.stamps[-1]
        position = last.pose.pose.position
        assert (position.x, position.y) == pytest.approx((result.online[-1, 0], result.online[-1, 1]))
        turn = last.pose.pose.orientation
        assert 2 * math.atan2(turn.z, turn.w) == pytest.approx(result.online[-1, 2])
        cov = np.array(last.pose.covariance).reshape(6, 6)
        np.testing.assert_array_equal(cov[np.ix_([0, 1, 5], [0, 1, 5])], result.online_covs[-1])
        assert np.count_nonzero(cov) == 9

    def test_path_and_transforms(self, messages: list[tuple[str, int, Any]]) -> None:
        (path,) = (m for topic, _, m in messages if topic == "/path")
        assert len(path.poses) == FRAMES - 5
        transforms = [m.transforms[0] for topic, _, m in messages if topic == "/tf"]
        children = [(t.header.frame_id, t.child_frame_id) for t in transforms]
        assert children == [("map", "uwb")] + [("map", "base_link")] * (FRAMES - 5)
        assert transforms[0].transform.rotation.w == 1.0
        assert transforms[-1].transform.translation.x == pytest.approx(make_result().poses[-1, 0])

    def test_a_path_of_many_poses_is_thinned(self, tmp_path: Path) -> None:
        """At 40 Hz every fourth pose, and the last one; the transforms have them all."""
        result = make_result()
        result.stamps = result.stamps[0] + 25_000_000 * np.arange(FRAMES)
        write_result(result, tmp_path)
        reader = pytest.importorskip("mcap_ros2.reader")
        (path,) = (m.ros_msg for m in reader.read_ros2_messages(str(tmp_path / "result.mcap"), topics=["/path"]))
        stamps = np.array([p.header.stamp.sec * 10**9 + p.header.stamp.nanosec for p in path.poses])
        assert stamps[-1] == result.stamps[np.isfinite(result.poses).all(axis=1)][-1]
        assert (np.diff(stamps)[1:-1] == 100_000_000).all()
        assert 0 < len(stamps) < FRAMES / 3

    def test_beacons(self, messages: list[tuple[str, int, Any]]) -> None:
        arrays = [m.markers for topic, _, m in messages if topic == "/beacons"]
        assert len(arrays[0]) == 3  # one beacon heard yet: post, text, ellipse
        assert [marker.text for marker in arrays[-1] if marker.type == 9] == ["4000000000 silent", "1"]
        ellipse = arrays[-1][-1]
        assert (ellipse.scale.x, ellipse.scale.y) == pytest.approx((0.8, 0.4))  # 2 sigma to both sides, 0.2 and 0.1
        assert abs(math.cos(2 * math.atan2(ellipse.pose.orientation.z, ellipse.pose.orientation.w))) == pytest.approx(1)
        keys = [(marker.ns, marker.id) for marker in arrays[-1]]
        assert len(set(keys)) == len(keys)

    def test_diagnostics(self, messages: list[tuple[str, int, Any]]) -> None:
        arrays = [m for topic, _, m in messages if topic == "/diagnostics"]
        values = {pair.key: pair.value for pair in arrays[-1].status[0].values}
        assert values == {"score": "1", "hypotheses": "1"}


def test_the_foxglove_layout_shows_what_is_there(run: Path) -> None:
    """Its panels name topics of result.mcap, and the recording's own scans."""
    reader = pytest.importorskip("mcap_ros2.reader")
    layout = json.loads((Path(__file__).parents[2] / "docs" / "foxglove.json").read_text(encoding="utf-8"))
    panels = layout["configById"]
    named = {path["value"].split(".")[0] for path in panels["Plot!uwbslam-error"]["paths"]}
    named |= set(panels["3D!uwbslam"]["topics"]) | {panels["DiagnosticStatusPanel!uwbslam"]["topicToRender"]}
    topics = {message.channel.topic for message in reader.read_ros2_messages(str(run / "result.mcap"))}
    assert named == topics - {"/tf"} | {"/scan"}

    def shown(node: Any) -> set[str]:
        return {node} if isinstance(node, str) else shown(node["first"]) | shown(node["second"])

    assert shown(layout["layout"]) == set(panels)


def test_diagnostics_come_at_most_ten_times_a_second(tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap_ros2.reader")
    result = make_result()
    result.stamps = T0 + np.arange(FRAMES, dtype=np.int64) * 25_000_000
    write_result(result, tmp_path)
    topics = [m.channel.topic for m in reader.read_ros2_messages(str(tmp_path / "result.mcap"))]
    assert topics.count("/diagnostics") == FRAMES // 4


def test_a_clock_that_was_set_by_years_takes_no_longer(tmp_path: Path) -> None:
    result = make_result()
    result.stamps[:30] -= 50 * 365 * 86_400 * 1_000_000_000
    write_result(result, tmp_path)
    assert (tmp_path / "result.mcap").stat().st_size < 1_000_000
