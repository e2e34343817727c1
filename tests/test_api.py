"""The front door: what `import uwbslam_jax` gives, and that every way in gives the same bits."""

from __future__ import annotations

import ast
import dataclasses
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import uwbslam_jax as us
from uwbslam_jax.__main__ import main
from uwbslam_jax.errors import RunError, UsageError
from uwbslam_jax.result import EventKind, RunStatus

SECONDS = 13.5
"""Of the hall: decided after 8 s, and not a whole number of groups of frames."""
SETTINGS = us.Settings(map=us.MapSettings(size_m=25.6))
IDS = {3, 5, 7, 9, 12}
FILES = {"trajectory.tum", "beacons.csv", "map.pgm", "map.yaml", "result.mcap", "summary.json", "report.html"}


class Fed(NamedTuple):
    """A Slam fed message by message: its result, its updates, those told to the listener, and its map on the way."""

    result: us.Result
    updates: list[us.Update]
    listened: list[us.Update]
    map: us.MapImage


def fed(log: Path, **goes_on: Any) -> Fed:
    """A recording fed message by message."""
    listened: list[us.Update] = []
    slam = us.Slam(SETTINGS, on_update=listened.append, **goes_on)
    assert slam.status is RunStatus.WAITING
    updates = [update for message in us.read(log) for update in slam.add(message)]
    assert slam.status is RunStatus.DECIDED
    on_the_way = slam.map()
    return Fed(slam.finish(), updates, listened, on_the_way)


def same_bits(a: us.Result, b: us.Result) -> None:
    """Tracks, beacons, map and events are equal to the last bit."""
    for name in ("stamps", "poses", "online", "online_covs", "range_residuals", "scan_points"):
        assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True), name
    assert np.array_equal(a.map.log_odds, b.map.log_odds)
    beacons = [[(x.id, x.status, *x.position, *x.cov.ravel()) for x in result.beacons] for result in (a, b)]
    assert beacons[0] == beacons[1]
    assert a.events == b.events


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hall as a small scanner sees it, with ground truth."""
    path = tmp_path_factory.mktemp("log") / "hall.mcap"
    us.simulate("hall", 0, SECONDS, beams=181).save(path)
    return path


@pytest.fixture(scope="module")
def result(log: Path) -> us.Result:
    return us.run(log, SETTINGS)


@pytest.fixture(scope="module")
def saved(result: us.Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the result was saved to."""
    folder = tmp_path_factory.mktemp("run") / "made" / "out"
    result.save(folder)
    return folder


@pytest.fixture(scope="module")
def online(log: Path) -> Fed:
    return fed(log)


@pytest.fixture(scope="module")
def localised(log: Path, saved: Path) -> us.Result:
    return us.run(log, SETTINGS, localize=saved)


@pytest.fixture(scope="module")
def resumed(log: Path, saved: Path) -> us.Result:
    return us.run(log, SETTINGS, resume=saved)


class TestNames:
    def test_the_import_loads_neither_jax_nor_numpy(self) -> None:
        code = "import sys, uwbslam_jax; print(sorted({'jax', 'jaxlib', 'numpy', 'scipy'} & sys.modules.keys()))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout == "[]\n"

    def test_every_name_is_there_and_listed(self) -> None:
        assert all(getattr(us, name) is not None for name in us.__all__)
        assert dir(us) == sorted(us.__all__)
        assert len(set(us.__all__)) == len(us.__all__)
        with pytest.raises(AttributeError, match="has no attribute 'slam'"):
            _ = us.slam

    def test_type_checkers_see_the_same_names(self) -> None:
        (block,) = [node for node in ast.parse(Path(us.__file__).read_text()).body if isinstance(node, ast.If)]
        seen: dict[str, set[str]] = {}
        for node in block.body:
            assert isinstance(node, ast.ImportFrom)
            assert all(alias.asname == alias.name for alias in node.names)  # what makes an import an export
            module = (node.module or "").removeprefix("uwbslam_jax").lstrip(".")
            seen.setdefault(module, set()).update(alias.name for alias in node.names)
        assert seen.pop("") == {"estimator"}
        assert seen == {module: set(names.split()) for module, names in us._HOME.items()}

    def test_the_pure_function_comes_with_all_that_it_takes(self) -> None:
        names = ("init", "step", "Config", "Params", "State", "Estimate", "make_config", "make_params")
        assert all(hasattr(us.estimator, name) for name in names)


class TestSameBits:
    def test_of_a_reader(self, log: Path, result: us.Result) -> None:
        same_bits(us.run(us.read(log), SETTINGS), result)

    def test_of_messages_that_can_be_read_only_once(self, log: Path, result: us.Result) -> None:
        same_bits(us.run(iter(list(us.read(log))), SETTINGS), result)

    def test_message_by_message(self, online: Fed, result: us.Result) -> None:
        same_bits(online.result, result)


class TestResult:
    def test_the_truth_of_a_recording_comes_along(self, result: us.Result) -> None:
        assert result.truth is not None
        assert set(result.truth.beacons) == IDS
        figures = result.errors()
        assert figures["robot_rmse_m"] < 0.05
        assert figures["beacon_mean_m"] < 0.05
        assert figures["online_ate_m"] < 0.1
        assert 0.0 < figures["pose_nees_ratio"] < 10.0

    def test_without_truth_there_are_no_errors(self, result: us.Result) -> None:
        with pytest.raises(UsageError, match="no ground truth"):
            dataclasses.replace(result, truth=None).errors()

    def test_every_file_is_saved(self, saved: Path) -> None:
        assert {path.name for path in saved.iterdir()} == FILES | {"state.npz"}

    def test_folder_and_result_are_as_far_from_the_truth(self, log: Path, saved: Path, result: us.Result) -> None:
        assert result.truth is not None
        told, of_files = us.evaluate(result, result.truth), us.evaluate(saved, log)
        assert told == {name: result.errors()[name] for name in told}
        assert told.pop("beacons_missing") == of_files.pop("beacons_missing") == []
        # the files hold micrometres and microradians
        assert told == pytest.approx(of_files, abs=5e-6 * 180 / np.pi)

    def test_a_report_by_itself(self, result: us.Result, tmp_path: Path) -> None:
        result.report(tmp_path / "report.html", "A title")
        assert "A title" in (tmp_path / "report.html").read_text(encoding="utf-8")

    def test_a_plot(self, result: us.Result) -> None:
        pyplot = pytest.importorskip("matplotlib.pyplot", reason="matplotlib is not installed")
        figure, axes = pyplot.subplots()
        assert result.plot(axes) is axes
        assert {text.get_text() for text in axes.texts} >= {str(node) for node in IDS}
        pyplot.close(figure)


class TestSlam:
    def test_each_frame_is_told_once(self, online: Fed) -> None:
        stamps = online.result.stamps.tolist()
        assert [update.stamp for update in online.listened] == stamps
        # what still waits at the end is stepped by `finish`
        assert [update.stamp for update in online.updates] == stamps[: len(online.updates)]
        assert len(online.updates) >= len(stamps) - 1

    def test_an_update_before_anything_is_decided(self, online: Fed) -> None:
        first = online.updates[0]
        assert first.status is RunStatus.WAITING
        assert not first.decided
        assert all(np.isnan(beacon.position).all() for beacon in first.beacons.values())
        assert first.links == {}

    def test_an_update_afterwards(self, online: Fed) -> None:
        last = online.updates[-1]
        k = online.result.stamps.tolist().index(last.stamp)
        assert last.status is RunStatus.DECIDED
        assert last.decided
        np.testing.assert_array_equal(last.pose.astype(np.float32), online.result.online[k].astype(np.float32))
        np.testing.assert_allclose(last.cov, online.result.online_covs[k], rtol=1e-6)
        assert np.linalg.eigvalsh(last.cov).min() > 0
        assert last.velocity.shape == (3,)
        assert 0.1 < np.hypot(*last.velocity[:2]) < 2.0  # it drives
        assert last.beacons.keys() == IDS
        assert all(node == beacon.id and beacon.status == "static" for node, beacon in last.beacons.items())
        final = {beacon.id: beacon.position for beacon in online.result.beacons}
        assert max(np.linalg.norm(beacon.position - final[node]) for node, beacon in last.beacons.items()) < 0.2
        assert last.score is not None
        assert 0.5 < last.score <= 1.0
        assert last.links
        for (a, b), residual in last.links.items():
            assert a < b
            assert {a, b} <= IDS | {0}
            assert residual is None or abs(residual) < 0.5

    def test_there_is_a_map_on_the_way(self, online: Fed) -> None:
        assert np.count_nonzero(online.map.log_odds > 0) > 100
        assert online.map.resolution == SETTINGS.map.resolution

    def test_nothing_is_saved_before_the_frame_is_decided(self, log: Path, tmp_path: Path) -> None:
        slam = us.Slam(SETTINGS)
        assert slam.save(tmp_path / "out") is False
        assert not (tmp_path / "out").exists()

    def test_a_late_lidar_may_have_any_number_of_beams(self) -> None:
        slam = us.Slam(SETTINGS)
        for k in range(12):  # more than is waited for a scan
            slam.add(us.RangeMessage(10**18 + k * 100_000_000, 0, 1, 2.0))
        assert slam.settings.lidar.max_beams == SETTINGS.lidar.max_beams


class TestGoingOn:
    def test_localising_leaves_map_and_beacons_as_they_were(self, localised: us.Result, result: us.Result) -> None:
        assert np.array_equal(localised.map.log_odds, result.map.log_odds)
        before = {beacon.id: beacon.position for beacon in result.beacons}
        assert {beacon.id for beacon in localised.beacons} == IDS
        for beacon in localised.beacons:
            np.testing.assert_allclose(beacon.position, before[beacon.id], atol=1e-3)
        assert [event.kind for event in localised.events][:1] == [EventKind.LOCALISING]
        assert localised.state is None  # there is nothing new to go on from

    def test_localising_finds_the_robot_where_it_was(self, localised: us.Result, result: us.Result) -> None:
        _, ours, theirs = np.intersect1d(localised.stamps, result.stamps, return_indices=True)
        assert len(ours) > 0.9 * len(result.stamps)
        off = np.linalg.norm(localised.poses[ours, :2] - result.poses[theirs, :2], axis=1)
        assert np.median(off) < 0.03
        assert off.max() < 0.2

    def test_the_command_line_localises_alike(
        self, localised: us.Result, log: Path, saved: Path, tmp_path: Path
    ) -> None:
        words = ["run", str(log), "-o", str(tmp_path / "out"), "--localize", str(saved), "--map.size-m", "25.6"]
        assert main([*words, "--quiet"]) == 0
        localised.save(tmp_path / "again")
        for name in ("trajectory.tum", "beacons.csv", "map.pgm"):
            assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
        assert not (tmp_path / "out" / "state.npz").exists()

    def test_a_run_goes_on_at_once(self, resumed: us.Result) -> None:
        assert resumed.summary["decided_at"] < 1.0
        assert EventKind.RESUMED in [event.kind for event in resumed.events]
        assert resumed.errors()["robot_rmse_m"] < 0.1
        assert resumed.state is not None

    def test_it_goes_on_to_the_same_bits_as_on_the_robot(self, log: Path, saved: Path, resumed: us.Result) -> None:
        same_bits(fed(log, resume=saved).result, resumed)

    def test_one_of_both(self, log: Path, saved: Path) -> None:
        for begin in (us.Slam, partial(us.run, log)):
            with pytest.raises(UsageError, match="one of them"):
                begin(resume=saved, localize=saved)

    @pytest.mark.parametrize("how", ["resume", "localize"])
    def test_from_a_folder_without_a_state(self, how: str, tmp_path: Path) -> None:
        with pytest.raises(RunError, match=r"state\.npz"):
            us.Slam(**{how: tmp_path})


class TestSimulation:
    @pytest.mark.slow
    def test_a_run_needs_nothing_else(self) -> None:
        simulation = us.simulate("lever_arms", 3, 2.0, beams=61)
        result = us.run(simulation)
        assert result.summary["config"]["robot"]["antenna"] == simulation.settings.robot.antenna
        assert result.summary["steps"] == len(result.stamps) == 20
        assert result.truth is not None
        np.testing.assert_array_equal(result.truth.robot, simulation.truth.robot)
        assert result.errors()["robot_ate_m"] < 0.05

    def test_it_gives_the_same_messages_each_time(self) -> None:
        simulation = us.simulate("hall", 1, 0.5, beams=61)
        first, again = list(simulation), list(simulation)
        assert [type(message) for message in first] == [type(message) for message in again]
        assert {m.ranges.size for m in first if isinstance(m, us.ScanMessage)} == {61}
        assert [m for m in first if isinstance(m, us.RangeMessage)] == [
            m for m in again if isinstance(m, us.RangeMessage)
        ]

    @pytest.mark.parametrize(
        ("words", "says"),
        [
            ({"name": "hal"}, "no scenario hal; there are workshop"),
            ({"name": "hall", "seed": -1}, "seed -1"),
            ({"name": "hall", "duration": 0.0}, "duration 0 s"),
            ({"name": "hall", "beams": 1}, "beams 1"),
        ],
    )
    def test_what_cannot_be_simulated(self, words: dict[str, Any], says: str) -> None:
        with pytest.raises(UsageError, match=says):
            us.simulate(**words)

    def test_every_scenario_is_named(self) -> None:
        assert us.simulate(next(iter(us.SCENARIOS))).scenario.duration > 0
