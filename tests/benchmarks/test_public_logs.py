"""Converters of the public logs without LiDAR against their own references, and the batch solution beside them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from wheel_drive import SCALE, driven

from benchmarks.accuracy import batch_solution
from benchmarks.accuracy.public_logs import DRIVEN, P2P_BAR_M, p2p
from benchmarks.accuracy.without_lidar import orthogonal_rms, rest_rows, tables
from uwbslam_jax.evaluation import Truth, absolute_trajectory_error
from uwbslam_jax.measurements import OdometryMessage, RangeMessage, TruthMessage
from uwbslam_jax.startup import static_geometry
from uwbslam_jax.startup.static_geometry import Links


def truth_of(messages) -> Truth:
    return Truth.from_messages(m for m in messages if isinstance(m, TruthMessage))


@pytest.mark.parametrize(("name", "seconds", "off"), [("plaza2", 60.0, 1.5), ("labyrinth", 30.0, 0.08)])
def test_wheels_turn_and_drive_as_the_reference_does(shared_data: Path, name: str, seconds: float, off: float) -> None:
    """Dead reckoning follows the reference for a while: a wrong sign, unit or wheel would not."""
    log = DRIVEN[name](shared_data / name)
    wheels = [m for m in log.messages if isinstance(m, OdometryMessage)]
    wheels = [m for m in wheels if m.stamp - wheels[0].stamp < seconds * 1e9]
    truth = truth_of(log.messages)
    true = truth.poses_at(np.array([m.stamp for m in wheels]))
    assert np.hypot(*np.diff(true[:, :2], axis=0).T).sum() > 5.0
    assert absolute_trajectory_error(np.array([(m.x, m.y) for m in wheels]), true[:, :2]) < off
    assert {m.source + m.target - log.settings.robot.id for m in log.messages if isinstance(m, RangeMessage)} == set(
        log.beacons
    )


def test_nodes_at_rest_are_placed_within_the_bar(shared_data: Path) -> None:
    log = p2p(shared_data / "p2p")
    links = Links()
    for m in log.messages:
        if isinstance(m, RangeMessage) and 0 < m.range < log.settings.uwb.max_range:
            in_sight = not m.receive_power - m.first_path_power > log.settings.uwb.nlos_gap_db
            delay = sum(log.settings.uwb.bias[str(node)] for node in (m.source, m.target))
            links.add(m.source, m.target, m.range - delay, in_sight=in_sight)
    found = static_geometry.solve(links.averages())
    assert found.links == 28
    assert found.gross > 16
    placed = dict(zip(found.nodes, found.positions, strict=True))
    assert orthogonal_rms(placed, log.beacons) < P2P_BAR_M


def test_a_log_that_is_absent_is_told_in_its_row(tmp_path: Path) -> None:
    rows = list(rest_rows(tmp_path))
    assert rows == [{"recording": "p2p", "skipped": "it is not in the folder"}]
    assert "| p2p | skipped: it is not in the folder |" in "\n".join(tables([], rows))


class TestBatchSolution:
    def test_derivatives(self) -> None:
        problem = batch_solution.BatchProblem.build(driven(12.0), 0, 0.1)
        rng = np.random.default_rng(0)
        unknown = problem.track.size + 3 * len(problem.ids) + 1
        x = np.concatenate([problem.track.ravel(), np.zeros(unknown - problem.track.size)]) + rng.normal(size=unknown)
        x[-1] = 0.05
        h, direction = 1e-6, rng.normal(size=unknown)
        numeric = (problem.residuals(x + h * direction) - problem.residuals(x - h * direction)) / (2 * h)
        np.testing.assert_allclose(problem.jacobian(x) @ direction, numeric, rtol=1e-6, atol=1e-4)

    def test_it_finds_track_beacons_and_scale(self) -> None:
        messages = driven()
        found = batch_solution.solve(messages, truth_of(messages), 0, 0.1)
        assert found["robot_rmse_m"] < 0.08
        # wheels that measure 1 % too much, and what a constant bias of each beacon takes over from the scale
        assert found["beacon_mean_m"] < 0.3
        assert found["beacons_missing"] == []
        assert found["bias_scale"] == pytest.approx(SCALE, abs=0.02)  # wheels of 1 %
