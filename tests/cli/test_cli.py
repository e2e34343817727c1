"""The command line as a user calls it, and the run behind it: files, figures, one-line errors, same bits both ways."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from uwbslam_jax.__main__ import COMMANDS, main
from uwbslam_jax.api import Result, run
from uwbslam_jax.cli import commands
from uwbslam_jax.files import settings_file
from uwbslam_jax.files.mcap_log import LogWriter, Recording
from uwbslam_jax.files.run_folder import read_run
from uwbslam_jax.measurements import Message, RangeMessage, ScanMessage, TruthMessage
from uwbslam_jax.session.result_builder import Facts, to_result
from uwbslam_jax.session.runner import fit_beams
from uwbslam_jax.session.session import CONTROL_EVERY, Session
from uwbslam_jax.settings import Settings
from uwbslam_jax.sim import make_scenario, settings_overrides, simulate

BEAMS = 181
FRAMES = 135  # decided after 8 s; not a whole number of groups
SMALL = replace(Settings(), map=replace(Settings().map, size_m=25.6))
FILES = {"trajectory.tum", "beacons.csv", "map.pgm", "map.yaml", "result.mcap", "summary.json", "report.html"}


def write(path: Path, messages: Sequence[Message]) -> Path:
    with LogWriter(path) as writer:
        for message in messages:
            writer.write(message)
    return path


@pytest.fixture(scope="session")
def messages() -> list[Message]:
    """A hall as a small scanner sees it, long enough to be decided, with ground truth."""
    made = make_scenario("hall", 0, FRAMES / 10)
    return list(simulate(replace(made, lidar=replace(made.lidar, beams=BEAMS))))


@pytest.fixture(scope="session")
def log(tmp_path_factory: pytest.TempPathFactory, messages: list[Message]) -> Path:
    return write(tmp_path_factory.mktemp("log") / "hall.mcap", messages)


@pytest.fixture(scope="session")
def batch(log: Path) -> Result:
    return run(log, SMALL)


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory, log: Path) -> Path:
    """What `uwbslam run` writes, with a settings file of which one key is overridden by a flag."""
    made = tmp_path_factory.mktemp("run")
    (made / "my.toml").write_text("[uwb]\nsigma_n = 0.3\nmax_range = 90.0\n[map]\nsize_m = 25.6\n")
    words = ["run", str(log), "-o", str(made / "out"), "--config", str(made / "my.toml"), "--uwb.sigma-n", "0.1"]
    assert main([*words, "--quiet"]) == 0
    return made / "out"


class TestHelp:
    def test_loads_no_jax(self) -> None:
        code = "import sys; from uwbslam_jax.__main__ import main; main(['--help']); assert 'jax' not in sys.modules"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=False)
        assert done.returncode == 0, done.stderr
        assert all(name in done.stdout for name in COMMANDS)

    @pytest.mark.parametrize("name", COMMANDS)
    def test_every_command_tells_its_options(self, name: str, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(SystemExit) as end:
            main([name, "--help"])
        assert end.value.code == 0
        assert f"uwbslam {name}" in capsys.readouterr().out

    def test_every_key_of_the_settings_is_a_flag(self, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(SystemExit):
            main(["run", "--help"])
        told = capsys.readouterr().out
        for section, keys in ((s, vars(getattr(Settings(), s))) for s in vars(Settings())):
            assert all(f"--{section}.{key.replace('_', '-')}" in told for key in keys)


@pytest.mark.slow
def test_demo(tmp_path: Path) -> None:
    """The slow one: a process of its own, at full size."""
    words = [sys.executable, "-m", "uwbslam_jax", "demo", "--duration", "20", "-o", str(tmp_path / "out"), "--quiet"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert "robot, RMS" in done.stdout
    assert "report.html" in done.stdout
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES | {"state.npz", "demo.mcap"}
    found = read_run(tmp_path / "out")
    assert len(found.stamps) == 200
    assert found.summary["decided_at"] < 20
    assert len(found.beacons) == 5
    assert found.summary["robot_rmse_m"] < 0.05
    assert found.summary["beacon_mean_m"] < 0.05
    assert 0.0 < found.summary["pose_nees_ratio"] < 10.0
    assert 0.0 < found.summary["beacon_nees_ratio"] < 10.0
    assert "Pose NEES / dof" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


class TestRun:
    def test_files(self, folder: Path) -> None:
        assert {path.name for path in folder.iterdir()} == FILES | {"state.npz"}
        summary = json.loads((folder / "summary.json").read_text())
        assert summary["steps"] == FRAMES
        assert summary["ids"] == [3, 5, 7, 9, 12]
        assert summary["duration_s"] == pytest.approx((FRAMES - 1) / 10, abs=0.005)  # sweeps begin up to 2 ms late
        numbers = ("wall_s", "compile_s", "step_ms_median", "step_ms_p95", "real_time_factor", "peak_rss_mb")
        assert all(summary[key] >= 0 for key in numbers)
        told = ("dropped", "decided_at", "hypotheses", "status", "warnings", "version", "truncated", "odometry_used")
        assert set(told) <= summary.keys()
        assert summary["robot_rmse_m"] < 0.05

    def test_flags_go_before_the_file(self, folder: Path) -> None:
        settings = json.loads((folder / "summary.json").read_text())["config"]
        assert settings["uwb"]["sigma_n"] == 0.1
        assert settings["uwb"]["max_range"] == 90.0
        assert settings["map"]["size_m"] == 25.6

    def test_evaluate(self, folder: Path, log: Path, capsys: pytest.CaptureFixture[str]) -> None:
        capsys.readouterr()
        assert main(["evaluate", str(folder), str(log)]) == 0
        told = dict(line.rsplit("  ", 1) for line in capsys.readouterr().out.splitlines())
        figures = {name.strip(): value for name, value in told.items()}
        summary = json.loads((folder / "summary.json").read_text())
        # the files hold micrometres, the figures millimetres
        assert figures["robot, RMS"] == f"{summary['robot_rmse_m']:.3f} m"
        assert figures["beacons, mean"] == f"{summary['beacon_mean_m']:.3f} m"
        assert figures["heading, median"] == f"{summary['heading_deg_median']:.2f} deg"

    def test_online_and_batch_give_the_same_bits(self, log: Path, batch: Result) -> None:
        online, grouped = run(log, SMALL, online=True), batch
        assert FRAMES % CONTROL_EVERY, "the last frames are no whole group: both ways of stepping take part"
        assert grouped.summary["decided_at"] is not None
        for name in ("stamps", "poses", "online_covs", "range_residuals", "scan_points"):
            assert np.array_equal(getattr(online, name), getattr(grouped, name)), name
        assert np.array_equal(online.map.log_odds, grouped.map.log_odds)
        assert [(b.id, *b.position, *b.cov.ravel()) for b in online.beacons] == [
            (b.id, *b.position, *b.cov.ravel()) for b in grouped.beacons
        ]
        assert online.events == grouped.events

    def test_a_result_speaks_of_ids_and_seconds(self, batch: Result, messages: list[Message]) -> None:
        result, truth = batch, batch.truth
        ids = {3, 5, 7, 9, 12}
        assert truth is not None
        assert set(truth.beacons) == ids
        assert {b.id for b in result.beacons} == set(result.beacon_tracks) == ids
        assert set(result.range_residuals[:, 1:3].ravel()) <= ids | {0}
        assert 0 < result.range_residuals[:, 0].min() < result.range_residuals[:, 0].max() < FRAMES / 10
        stamps = [m.stamp for m in messages if isinstance(m, ScanMessage)]
        assert result.stamps.tolist() == stamps
        assert all(len(series) == FRAMES for series in result.diagnostics.values())

    def test_the_last_scan_lies_on_the_walls(self, batch: Result) -> None:
        result = batch
        cells = np.floor((result.scan_points - result.map.origin) / result.map.resolution).astype(int)
        size = np.array(result.map.log_odds.shape)[::-1]
        cells = cells[((cells > 0) & (cells < size - 1)).all(axis=1)]  # the small window does not hold every wall
        assert len(cells) > 0.7 * len(result.scan_points)
        around = [result.map.log_odds[cells[:, 1] + dy, cells[:, 0] + dx] for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
        assert np.mean(np.max(around, axis=0) > 0) > 0.9

    def test_the_estimator_never_sees_the_truth(self, tmp_path: Path, batch: Result, messages: list[Message]) -> None:
        blind = write(tmp_path / "blind.mcap", [m for m in messages if not isinstance(m, TruthMessage)])
        result = run(blind, SMALL)
        assert result.truth is None
        assert np.array_equal(result.poses, batch.poses)

    def test_a_cut_recording_is_used_up_to_there(
        self, tmp_path: Path, log: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        whole = log.read_bytes()
        (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
        words = ["run", str(tmp_path / "cut.mcap"), "-o", str(tmp_path / "out"), "--map.size-m", "25.6", "--quiet"]
        assert main(words) == 0
        assert "recording breaks after" in capsys.readouterr().err
        summary = json.loads((tmp_path / "out" / "summary.json").read_text())
        assert "recording breaks after" in summary["truncated"]
        assert 10 < summary["steps"] < FRAMES

    @pytest.mark.slow
    def test_without_ranges_it_is_lidar_only(self, tmp_path: Path, messages: list[Message]) -> None:
        scans = [m for m in messages if not isinstance(m, RangeMessage)]
        path = write(tmp_path / "scans.mcap", scans[: len(scans) // 4])
        # frame by frame: one program to compile instead of two
        words = ["run", str(path), "-o", str(tmp_path / "out"), "--map.size-m", "25.6", "--online", "--quiet"]
        assert main(words) == 0
        found = read_run(tmp_path / "out")
        assert found.summary["warnings"] == ["no UWB topic: LiDAR only"]
        assert found.summary["config"]["filter"]["lidar_only"] is True
        assert found.summary["decided_at"] is None
        assert found.summary["robot_ate_m"] < 0.05
        assert not len(found.beacons)

    def test_a_beacon_that_left_keeps_its_last_place(self) -> None:
        session = Session(replace(SMALL, lidar=replace(SMALL.lidar, max_beams=BEAMS)))
        session.slots[77] = 1
        session.history._left[1] = (np.array([1.0, 2.0]), np.eye(2) * 0.01)
        (beacon,) = to_result(session, Facts()).beacons
        assert (beacon.id, beacon.status, beacon.position.tolist()) == (77, "dropped", [1.0, 2.0])

    @pytest.mark.parametrize(
        ("sizes", "most", "slots"), [([180] * 12, 1081, 180), ([2000], 1081, 1081), ([400, 420], 1081, 525), ([], 9, 2)]
    )
    def test_slots_for_beams(self, sizes: list[int], most: int, slots: int) -> None:
        settings = replace(Settings(), lidar=replace(Settings().lidar, max_beams=most))
        scans = [ScanMessage(k, 0.0, 0.01, 0.0, 0.1, 30.0, np.ones(n, np.float32)) for k, n in enumerate(sizes)]
        assert fit_beams(settings, scans).lidar.max_beams == slots


def test_tune_writes_settings_that_run_takes(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without noises: their gradient takes long to compile."""
    words = [
        "tune",
        str(log),
        "-o",
        str(tmp_path),
        "--params",
        "bias.7",
        "lidar.yaw",
        "--map.size-m",
        "25.6",
        "--quiet",
    ]
    assert main(words) == 0
    told = capsys.readouterr().out
    settings = settings_file.load_settings(tmp_path / "tuned.toml")
    assert settings.map.size_m == 25.6
    assert abs(settings.uwb.bias["7"]) < 0.1  # there is none
    assert settings.robot.lidar == (0.0, 0.0, 0.0)
    assert "| lidar.yaw | rad | 0.0000 | 0.0000 | - | not observed |" in told  # there are no wheels
    assert (tmp_path / "tuning.md").read_text() in told
    assert json.loads((tmp_path / "tuning.json").read_text())["calibration"]["names"] == ["bias.7", "lidar.yaw"]


def test_inspect(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["inspect", str(log)]) == 0
    told = capsys.readouterr().out
    assert f"beams a scan: {BEAMS}" in told
    assert "pairs heard: 15 of 15" in told
    assert "ground truth: yes" in told


class TestSimulate:
    def test_settings_that_fit_go_beside(self, tmp_path: Path) -> None:
        path = tmp_path / "made.mcap"
        assert main(["simulate", "lever_arms", "--seed", "3", "--duration", "1", "-o", str(path), "--quiet"]) == 0
        made = make_scenario("lever_arms", 3, 1.0)
        assert settings_file.load_settings(path.with_suffix(".toml")) == settings_file.from_dict(
            settings_overrides(made)
        )
        assert sum(isinstance(m, ScanMessage) for m in Recording(path)) == 10

    def test_defaults_need_none(self, tmp_path: Path) -> None:
        path = tmp_path / "made.mcap"
        assert main(["simulate", "hall", "--duration", "0.3", "-o", str(path), "--quiet"]) == 0
        assert [p.name for p in tmp_path.iterdir()] == ["made.mcap"]


def ranges_only(folder: Path) -> str:
    return str(write(folder / "ranges.mcap", [RangeMessage(10**18, 0, 1, 2.5)]))


def no_return(folder: Path) -> str:
    empty = ScanMessage(10**18, 0.0, 0.01, 0.0, 0.1, 30.0, np.zeros(0, np.float32))
    return str(write(folder / "empty.mcap", [empty]))


def text_file(name: str, text: str) -> Callable[[Path], str]:
    def make(folder: Path) -> str:
        (folder / name).write_text(text)
        return str(folder / name)

    return make


WRONG: dict[str, tuple[list[Any], str]] = {
    "missing": (["run", "none.mcap", "-o", "out"], "none.mcap: no such file"),
    "not an mcap": (["run", text_file("a.mcap", "hello"), "-o", "out"], "neither an MCAP file nor"),
    "no scans": (
        ["run", ranges_only, "-o", "out", "--map.size-m", "12.8", "--online"],  # compiles faster
        "no ranges that fix a geometry on /uwb/ranges",
    ),
    "no usable scan": (["run", no_return, "-o", "out"], "no usable scan"),
    "unknown key": (
        ["run", "x.mcap", "-o", "out", "--config", text_file("a.toml", "[uwb]\nsigma = 1\n")],
        "unknown key uwb.sigma, did you mean uwb.sigma_n?",
    ),
    "no settings file": (["run", "x.mcap", "-o", "out", "--config=none.toml"], "none.toml: No such file"),
    "value out of range": (["run", "x.mcap", "-o", "out", "--uwb.sigma-n", "-1"], "uwb.sigma_n = -1.0: must be"),
    "folder is a file": (["run", "x.mcap", "-o", text_file("taken", "")], "taken: File exists"),
    "scenario": (["simulate", "hal", "-o", "x.mcap"], "no scenario hal; there are workshop, hall"),
    "seed": (["demo", "--seed", "-1", "-o", "out"], "seed -1"),
    "duration": (["demo", "--duration", "0", "-o", "out"], "duration 0 s"),
    "command": (["ran", "x.mcap"], "no command ran, did you mean run?"),
    "no run": (["evaluate", "none", "none.mcap"], "trajectory.tum: No such file"),
    "no parameter": (
        ["tune", "x.mcap", "-o", "out", "--params", "sigma_m"],
        "no parameter sigma_m to tune, did you mean",
    ),
    "no ranges to tune by": (["tune", "x.mcap", "-o", "out", "--filter.lidar-only"], "filter.lidar_only = true"),
    "no truth": (["tune", ranges_only, "-o", "out", "--objective", "truth"], "has no ground truth of the robot"),
    "no start-up": (["tune", ranges_only, "-o", "out"], "ranges.mcap: start-up has decided nothing"),
    "inspect": (["inspect", text_file("a.mcap", "")], "the file is empty"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_a_user_can_mend_is_one_line(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words, says = WRONG[case]
    assert main([word if isinstance(word, str) else word(tmp_path) for word in words]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("uwbslam: ")
    assert told.err.count("\n") == 1
    assert says in told.err


@pytest.mark.parametrize(("name", "content"), [("truth.npz", "no zip"), ("truth.mcap", None)])
def test_a_truth_that_is_none_is_one_line(
    folder: Path, tmp_path: Path, name: str, content: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    write(path, [RangeMessage(10**18, 0, 1, 2.5)]) if content is None else path.write_text(content)
    capsys.readouterr()
    assert main(["evaluate", str(folder), str(path)]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert name in told


def test_a_defect_of_ours_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "call", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(["demo"])


def test_interrupted(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "call", interrupt)
    assert main(["demo"]) == 130
    assert capsys.readouterr().err == "uwbslam: interrupted\n"
