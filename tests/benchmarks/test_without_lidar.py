"""Recordings without scans: nodes at rest that range to each other, and a robot with wheels and ranges alone."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from wheel_drive import BEACONS, SCALE, START, driven

from uwbslam_jax.__main__ import main
from uwbslam_jax.api import run
from uwbslam_jax.backend import revision
from uwbslam_jax.files.mcap_log import LogWriter
from uwbslam_jax.files.run_folder import read_run
from uwbslam_jax.measurements import Message, OdometryMessage, RangeMessage
from uwbslam_jax.settings import MapSettings, RobotSettings, Settings, UwbSettings

SMALL = Settings(map=MapSettings(size_m=12.8))
"""There is nothing to draw, and a small window compiles and runs faster."""
NODES = {4: (0.0, 0.0), 9: (6.0, 0.5), 15: (1.0, 5.0), 22: (7.0, 5.5), 31: (3.5, 2.0), 57: (8.8, 2.4)}
DELAY = 77.45
"""Antenna delay of each node [m], as raw times of flight have it."""


def rms_after_fit(found: dict[int, np.ndarray], true: dict[int, tuple[float, float]]) -> float:
    """RMS distance after the best orthogonal motion, reflection allowed [m]: nothing fixes it at rest."""
    A, B = np.array([found[node] for node in true]), np.array(list(true.values()))
    A, B = A - A.mean(0), B - B.mean(0)
    u, _, vt = np.linalg.svd(A.T @ B)
    return float(np.sqrt(np.mean(np.sum((A @ u @ vt - B) ** 2, axis=1))))


def at_rest(rounds: int = 30) -> list[Message]:
    """All pairs of nodes in turn; a bias of each link, and gross outliers."""
    rng = np.random.default_rng(2)
    bias = {pair: rng.normal(0.0, 0.05) for pair in combinations(NODES, 2)}
    messages: list[Message] = []
    for a, b in list(bias) * rounds:
        distance = np.hypot(*np.subtract(NODES[a], NODES[b])) + 2 * DELAY + bias[a, b] + rng.normal(0.0, 0.04)
        if rng.random() < 0.05:
            distance += rng.choice([-1.0, 1.0]) * rng.uniform(3.0, 40.0)
        messages.append(RangeMessage(START + 3_000_000 * len(messages), a, b, float(distance)))
    return messages


class TestAtRest:
    def test_a_recording_gives_the_relative_geometry(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        with LogWriter(tmp_path / "rest.mcap") as log:
            for message in at_rest():
                log.write(message)
        delays = ", ".join(f'"{node}" = {DELAY}' for node in NODES)
        (tmp_path / "rest.toml").write_text(f"[uwb]\nbias = {{{delays}}}\n[map]\nsize_m = 12.8\n")
        words = ["run", str(tmp_path / "rest.mcap"), "-o", str(tmp_path / "out"), "--quiet", "--online"]
        assert main([*words, "--config", str(tmp_path / "rest.toml")]) == 0
        assert "rotation and reflection are arbitrary" in capsys.readouterr().err
        found = read_run(tmp_path / "out")
        beacons = dict(zip(found.beacon_ids.tolist(), found.beacons, strict=True))
        assert rms_after_fit(beacons, NODES) < 0.08
        assert set(found.beacon_status) == {"relative"}
        assert not len(found.stamps)
        assert found.summary["status"] == "waiting for motion"
        told = found.summary["relative"]
        assert told["nodes"] == sorted(NODES)
        assert told["links"] == 15
        assert 8 <= told["ranges_rejected"] <= 40  # 5 % of 450
        assert (tmp_path / "out" / "map.yaml").read_text().startswith("# nothing was observed")
        assert "relative" in (tmp_path / "out" / "report.html").read_text()
        assert json.loads((tmp_path / "out" / "summary.json").read_text())["decided_at"] is None

    def test_an_unknown_common_offset_is_found_when_asked(self) -> None:
        settings = replace(SMALL, uwb=UwbSettings(fit_offset=True))
        result = run(at_rest(), settings, online=True)
        assert result.truth is None
        assert result.summary["relative"]["offset_m"] == pytest.approx(2 * DELAY, abs=0.15)
        assert rms_after_fit({b.id: b.position for b in result.beacons}, NODES) < 0.12

    def test_a_robot_at_rest_is_the_origin(self) -> None:
        robot = RobotSettings(id=31, antenna=(0.2, -0.1, 0.0))
        messages = [m for m in at_rest() if isinstance(m, RangeMessage)]
        messages = [replace(m, range=m.range - 2 * DELAY) for m in messages]
        result = run(messages, replace(SMALL, robot=robot), online=True)
        beacons = {b.id: b.position for b in result.beacons}
        assert sorted(beacons) == sorted(set(NODES) - {31})
        for node, position in beacons.items():
            away = np.linalg.norm(position - np.array(robot.antenna[:2]))
            assert away == pytest.approx(np.hypot(*np.subtract(NODES[node], NODES[31])), abs=0.15)


class TestWheelsAndRanges:
    def test_a_recording_gives_track_and_beacons_without_a_map(self, tmp_path: Path) -> None:
        with LogWriter(tmp_path / "wheels.mcap") as log:
            for message in driven():
                log.write(message)
        # frame by frame, as above: one program to compile
        words = ["run", str(tmp_path / "wheels.mcap"), "-o", str(tmp_path / "out"), "--quiet", "--online"]
        assert main([*words, "--map.size-m", "12.8", "--uwb.bias-scale", str(SCALE)]) == 0
        found = read_run(tmp_path / "out")
        assert found.summary["odometry_used"]
        assert found.summary["decided_at"] < 40
        assert found.summary["relative"] is None
        assert found.summary["warnings"] == ["no scan: the track is that of odometry and ranges, the map is empty"]
        assert len(found.stamps) == found.summary["steps"] > 590
        assert found.beacon_ids.tolist() == sorted(BEACONS)
        # one range of 0.1 m at a time, ten a second
        assert found.summary["robot_rmse_m"] < 0.15
        assert found.summary["beacon_mean_m"] < 0.15
        names = {"trajectory.tum", "beacons.csv", "map.pgm", "map.yaml", "summary.json", "result.mcap", "report.html"}
        assert {path.name for path in (tmp_path / "out").iterdir()} == names | {"state.npz"}

    @pytest.mark.slow
    def test_a_scale_is_found_where_it_is_not_configured(self) -> None:
        """Wheels know the size of the room and the ranges say otherwise."""
        configured = replace(SMALL, uwb=UwbSettings(bias_scale=SCALE))
        beacons = []
        for settings in (SMALL, configured):
            result = run(driven(), settings, online=True)
            beacons.append({b.id: b.position for b in result.beacons})
        plain, mended = (np.linalg.norm(found[5] - found[13]) for found in beacons)
        true = np.hypot(*np.subtract(BEACONS[5], BEACONS[13]))
        assert abs(mended - true) < 0.3
        assert abs(plain - true) < 0.3
        assert SCALE * true > 3 * 0.3

    def test_wheels_alone_are_dead_reckoning(self) -> None:
        wheels = [m for m in driven(10.0) if isinstance(m, OdometryMessage)]
        result = run(wheels, SMALL, online=True)
        assert result.truth is None
        assert len(result.stamps) == 100
        assert not result.beacons
        travelled = np.linalg.norm(result.poses[-1, :2] - result.poses[0, :2])
        assert travelled == pytest.approx(np.hypot(wheels[-1].x, wheels[-1].y), abs=1e-3)


def test_a_drive_of_which_no_beacon_can_be_placed_ends_in_a_warning() -> None:
    heard = [m for m in driven(65.0) if not isinstance(m, RangeMessage) or m.target == 3]
    result = run(heard, SMALL)
    assert result.summary["decided_at"] is None
    assert not result.beacons
    assert [text for _, text in result.summary["events"] if text.startswith("start-up waits: ")]
    assert [text for text in result.summary["warnings"] if text.startswith("no beacon is placed: fewer than two")]


def test_a_run_that_is_sure_of_no_beacon_in_the_end_goes_on_without(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(revision, "SIGMA_ENOUGH_M", 0.0)
    result = run(driven(20.0), SMALL)
    assert result.summary["decided_at"] is not None
    assert not [text for text in result.summary["warnings"] if "could not be solved" in text]
    assert len(result.beacons) == len(BEACONS)
