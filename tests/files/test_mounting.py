"""Where sensors sit: what a recording's transforms tell, what settings make of it, and odometry that is in them."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from transform_log import SCAN, T0, measured, transform, write

from uwbslam_jax import api
from uwbslam_jax.files import Recording, mounting
from uwbslam_jax.measurements import OdometryMessage
from uwbslam_jax.session.frame_assembler import pad_scan
from uwbslam_jax.settings import RobotSettings, Settings

PI = math.pi


@pytest.mark.parametrize("slash", ["", "/"])
@pytest.mark.parametrize(
    ("turn", "pose", "flip"),
    [
        ((0.0, 0.0, 0.0), (0.1, 0.02, 0.0), False),
        ((0.0, 0.0, PI / 2), (0.1, 0.02, PI / 2), False),
        ((PI, 0.0, 0.0), (0.1, 0.02, 0.0), True),
        ((0.0, PI, 0.0), (0.1, 0.02, PI), True),
        ((PI, 0.0, 1.0), (0.1, 0.02, 1.0), True),
        ((PI, PI, 0.0), (0.1, 0.02, PI), False),
    ],
)
def test_the_scanners_frame_tells_where_it_sits(
    tmp_path: Path, slash: str, turn: tuple[float, float, float], pose: tuple[float, float, float], flip: bool
) -> None:
    still = transform(T0, f"{slash}base_link", f"{slash}laser", (0.1, 0.02, 0.3), turn)
    reader = Recording(write(tmp_path / "a.mcap", [("/tf_static", T0, still), *measured()]))
    lidar = reader.mounting.lidar
    assert lidar is not None
    assert (lidar.frame, lidar.base, lidar.flip) == ("laser", "base_link", flip)
    apart = np.subtract(lidar.pose, pose)
    np.testing.assert_allclose([*apart[:2], math.remainder(apart[2], 2 * PI)], 0.0, atol=1e-5)
    assert lidar.tilt < 1e-3
    robot = mounting.mounted(Settings(), reader.mounting).robot
    assert (robot.lidar, robot.lidar_flip) == (lidar.pose, flip)
    assert not mounting.contradictions(Settings(robot=robot), reader.mounting)


def test_a_chain_across_files_late_and_with_a_radio(tmp_path: Path) -> None:
    first = write(
        tmp_path / "a.mcap", [*measured(), ("/tf_static", T0 + 10, transform(T0, "mount", "laser", (0.1, 0, 0)))]
    )
    late = [
        ("/tf_static", T0 + 10**10, transform(T0, "base_footprint", "mount", (0.2, 0, 0.5), (0, 0, PI / 2))),
        ("/tf_static", T0 + 10**10, transform(T0, "mount", "uwb", (0.0, 0.1, 0.4))),
    ]
    found = Recording([first, write(tmp_path / "b.mcap", late)]).mounting
    assert found.lidar is not None
    assert found.lidar.base == "base_footprint"
    assert found.lidar.pose == pytest.approx((0.2, 0.1, PI / 2), abs=1e-5)
    assert found.antenna == pytest.approx((0.1, 0.0, 0.9), abs=1e-5)


def test_transforms_at_rest_on_tf_count_and_those_that_turn_do_not(tmp_path: Path) -> None:
    still = [("/tf", T0 + k, transform(T0 + k, "base_link", "laser", (0.1, 0, 0))) for k in range(5)]
    turning = [("/tf", T0 + k, transform(T0 + k, "base_link", "laser", (0.1, 0, 0), (0, 0, 0.1 * k))) for k in range(5)]
    found = Recording(write(tmp_path / "a.mcap", [*measured(), *still])).mounting.lidar
    assert found is not None
    assert found.pose == (0.1, 0.0, 0.0)
    assert Recording(write(tmp_path / "b.mcap", [*measured(), *turning])).mounting.lidar is None


@pytest.mark.parametrize("links", [[], [("map", "laser")], [("laser", "laser")], [("a", "laser"), ("laser", "a")]])
def test_no_way_to_the_robot_tells_nothing(tmp_path: Path, links: list[tuple[str, str]]) -> None:
    still = [("/tf_static", T0, transform(T0, *link)) for link in links]
    reader = Recording(write(tmp_path / "a.mcap", [*still, *measured()]))
    assert reader.mounting == mounting.Mounting()
    assert mounting.mounted(Settings(), reader.mounting) == Settings()


def test_what_is_configured_holds_and_is_told_where_it_differs(tmp_path: Path) -> None:
    still = transform(T0, "base_link", "laser", (0.1, 0.0, 0.3), (PI, 0.0, 0.0))
    path = write(tmp_path / "a.mcap", [("/tf_static", T0, still), *measured()])
    wanted = Settings(robot=RobotSettings(lidar=(0.1, 0.0, PI)))
    told = mounting.contradictions(mounting.mounted(wanted, Recording(path).mounting), Recording(path).mounting)
    assert len(told) == 1
    assert "upside down" in told[0]
    assert "--robot.lidar 0.1 0 0 --robot.lidar-flip" in told[0]
    assert mounting.mounted(wanted, Recording(path).mounting) == wanted
    assert told == [p for p in api.inspect(path, wanted).problems if p in told]
    assert not api.inspect(path).problems
    assert "mounting: laser sits on base_link at 0.1 0 0 (x, y [m], yaw [rad]), upside down" in str(api.inspect(path))


def test_a_tilted_scanner_is_told(tmp_path: Path) -> None:
    still = transform(T0, "base_link", "laser", (0.1, 0.0, 0.3), (0.0, 0.2, 0.0))
    path = write(tmp_path / "a.mcap", [("/tf_static", T0, still), *measured()])
    (told,) = api.inspect(path).problems
    assert "tilted by 11 deg" in told


def test_bearings_of_a_scanner_upside_down_are_turned_over() -> None:
    """Beams that hit the same walls as those of one the right way up, in the other order."""
    upright = pad_scan(SCAN, Settings())
    turned = dataclasses.replace(SCAN, ranges=SCAN.ranges[::-1].copy(), time_increment=-1e-5)
    flipped = pad_scan(turned, Settings(robot=RobotSettings(lidar_flip=True)))
    beams = SCAN.ranges.size

    def by_bearing(scan):
        bearing = scan.angle_min + scan.angle_increment * np.arange(beams)
        order = np.argsort(bearing)
        return bearing[order], scan.ranges[:beams][order]

    for a, b in zip(by_bearing(upright), by_bearing(flipped), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_odometry_is_read_from_transforms_where_it_has_no_topic(tmp_path: Path) -> None:
    moving = []
    for k in range(10):
        stamp = T0 + k * 10**8
        moving += [
            ("/tf", stamp + 5, transform(stamp, "base_link", "wheel", (0, 0.1, 0), (0, 0.1 * k, 0))),
            ("/tf", stamp + 6, transform(stamp, "/odom", "/base_footprint", (0.1 * k, 0, 0), (0, 0, 0.05 * k))),
            ("/tf", stamp + 7, transform(stamp, "map", "odom", (0, 0.01 * k, 0))),
        ]
    reader = Recording(write(tmp_path / "a.mcap", [*measured(), *moving]))
    assert reader.topics["/tf"] == "odom"
    found = [m for m in reader if isinstance(m, OdometryMessage)]
    assert [m.stamp for m in found] == [T0 + k * 10**8 for k in range(10)]
    np.testing.assert_allclose(
        [(m.x, m.y, m.yaw) for m in found], [(0.1 * k, 0, 0.05 * k) for k in range(10)], atol=1e-12
    )
    assert "/tf" not in Recording(tmp_path / "a.mcap", odom_topic=None).topics
    without = Recording(write(tmp_path / "b.mcap", [*measured(), *moving[::3]]))
    assert "odom" not in without.topics.values()


def test_odometry_without_an_orientation_is_left_out_and_told(tmp_path: Path) -> None:
    moving = [("/tf", T0 + k, transform(T0 + k, "odom", "base_link", (0.1 * k, 0, 0))) for k in range(6)]
    q = moving[3][2].transforms[0].transform.rotation
    q.x = q.y = q.z = q.w = 0.0
    reader = Recording(write(tmp_path / "a.mcap", [*measured(), *moving]))
    assert sum(isinstance(m, OdometryMessage) for m in reader) == 5
    assert reader.dropped == {"odometry: orientation is no rotation": 1}
    assert "--no-odom" in reader.warnings[-1]
