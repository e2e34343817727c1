"""`uwbslam live` against emulated devices, from the first byte to the last file; its page in a headless browser."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, DRIVER, MISSING, Browser
from made_result import make_result
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from uwbslam_drivers.emulators.plugs import PtyPlug
from uwbslam_drivers.emulators.robot import Departure, DeviceTime
from uwbslam_drivers.emulators.serve import EMULATORS, Server
from uwbslam_jax.__main__ import main
from uwbslam_jax.files.mcap_log import Recording
from uwbslam_jax.files.run_folder import read_run, read_trajectory
from uwbslam_jax.measurements import ScanMessage
from uwbslam_jax.sim import make_scenario
from uwbslam_jax.web.report import write_report

PATIENCE_S = 120.0
"""After this time a test gives up; none of them takes nearly as long."""
AFTERWARDS_S = 4.0
"""The live run goes on for so long after start-up has decided, some 13 s after its beginning."""
SECOND = 1_000_000_000
FILES = {"trajectory.tum", "beacons.csv", "map.pgm", "map.yaml", "result.mcap", "summary.json", "report.html"}

needs_browser = pytest.mark.skipif(not (CHROMIUM and DRIVER), reason=MISSING)


@dataclass
class Lived:
    """A live run that has ended: its folder, and what the browser saw meanwhile."""

    folder: Path
    status: int
    seen: list[str]
    words: dict[str, str]
    console: list[str]

    @property
    def recording(self) -> Path:
        return next(self.folder.glob("live-*.mcap"))


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


POSE = "return [track.t.at(-1) || 0, track.x.at(-1), track.y.at(-1), document.getElementById('pose').textContent]"


def watch(url: str, profile: Path, over: threading.Event) -> tuple[list[str], dict[str, str], list[str]]:
    """Poses shown, as JSON of time and text; the page's words at the end; its errors."""
    seen: list[str] = []
    with Browser(profile) as browser:
        browser.open(url)
        early = browser.until("return document.getElementById('notices').textContent", lambda text: "motion" in text)
        while not over.is_set():
            seen.append(json.dumps(browser.run(POSE)))
            time.sleep(0.2)
        browser.until("return document.getElementById('link').textContent", lambda text: "ended" in text)
        ids = ("tiles", "beacon-words", "event-words", "link")
        words = {"early": early} | {name: browser.text(name) for name in ids}
        words["map"] = browser.run("return JSON.stringify([tiles.width, tiles.height, data.map.cell, beacons.length])")
        return seen, words, browser.console()


@pytest.fixture(scope="module")
def lived(tmp_path_factory: pytest.TempPathFactory) -> Lived:
    folder, port = tmp_path_factory.mktemp("live"), free_port()
    words = [sys.executable, "-m", "uwbslam_jax", "live", "--emulate", "workshop", "-o", str(folder / "out")]
    words += ["--view", f"127.0.0.1:{port}"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        over = threading.Event()
        said = "".join(process.stdout.readline() for _ in range(3))
        assert "recording to" in said, said
        threading.Thread(target=end_after_start_up, args=(process, folder / "out", over)).start()
        if CHROMIUM and DRIVER:
            seen, told, console = watch(f"http://127.0.0.1:{port}", folder / "profile", over)
        else:
            seen, told, console = [], {}, []
        process.communicate(timeout=PATIENCE_S)
    return Lived(folder / "out", process.returncode, seen, told, console)


def end_after_start_up(process: subprocess.Popen[str], folder: Path, over: threading.Event) -> None:
    """Ends a run some seconds after its state was saved for the first time: then the frame is decided."""
    end = time.monotonic() + PATIENCE_S
    while not (folder / "state.npz").exists() and time.monotonic() < end:
        time.sleep(0.1)
    time.sleep(AFTERWARDS_S)
    over.set()
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)


@pytest.mark.slow
@pytest.mark.realtime
def test_a_run_ends_with_all_files_and_says_how_late_it_was(lived: Lived) -> None:
    assert lived.status == 0
    assert {path.name for path in lived.folder.iterdir() if not path.is_symlink()} == FILES | {
        "state.npz",
        "truth.npz",
        lived.recording.name,
    }
    summary = json.loads((lived.folder / "summary.json").read_text())
    assert summary["decided_at"] > 0.0
    assert summary["robot_rmse_m"] < 0.1
    assert 0.0 < summary["latency_ms_median"] <= summary["latency_ms_p99"]
    # every scan is in the track or counted as dropped; a frame may have no scan
    stamps, _ = read_trajectory(lived.folder / "trajectory.tum")
    scans = {m.stamp for m in Recording(lived.recording, uwb_topic=None) if isinstance(m, ScanMessage)}
    lost = sum(count for reason, count in summary["dropped"].items() if reason.startswith("scan: "))
    assert summary["devices"]["lidar"]["measurements"] == len(scans & set(stamps.tolist())) + lost, summary["dropped"]
    assert summary["recording"] == lived.recording.name


@pytest.mark.slow
@pytest.mark.realtime
def test_the_recording_gives_the_same_track_bit_for_bit(lived: Lived, tmp_path: Path) -> None:
    # in a process of its own, as a user runs it: pytest has loaded numpy by now, with LAPACK's threads, which round
    # differently from one run to the next
    words = [sys.executable, "-m", "uwbslam_jax", "run", str(lived.recording), "-o", str(tmp_path), "--quiet"]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    for name in ("trajectory.tum", "beacons.csv", "map.pgm"):
        assert (tmp_path / name).read_bytes() == (lived.folder / name).read_bytes(), name
    assert len(read_trajectory(tmp_path / "trajectory.tum")[0]) > 100


@pytest.mark.slow
@pytest.mark.realtime
def test_dropped_scans_are_in_the_recording_apart(lived: Lived) -> None:
    lost = json.loads((lived.folder / "summary.json").read_text())["dropped"].get("scan: overtaken by a newer one", 0)
    apart = Recording(lived.recording, scan_topic="/scan_dropped", uwb_topic=None)
    count = sum(isinstance(m, ScanMessage) for m in apart) if "/scan_dropped" in apart.topics else 0
    assert count == lost


def published(log: Path) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (T,) [ns] and poses (T, 3) on /pose: what the run said at the time, before it knew better."""
    with log.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = [message for *_, message in reader.iter_decoded_messages(topics=["/pose"])]
    stamps = [m.header.stamp.sec * SECOND + m.header.stamp.nanosec for m in found]
    places = [m.pose.pose for m in found]
    rows = [(p.position.x, p.position.y, 2 * np.arctan2(p.orientation.z, p.orientation.w)) for p in places]
    return np.array(stamps), np.array(rows)


@pytest.mark.slow
@pytest.mark.realtime
@needs_browser
def test_the_page_shows_the_pose_that_was_sent(lived: Lived) -> None:
    stamps, poses = published(lived.folder / "result.mcap")
    decided = json.loads((lived.folder / "summary.json").read_text())["decided_at"]
    shown = 0
    for entry in lived.seen:
        t, x, y, text = json.loads(entry)
        apart = np.abs((stamps - stamps[0]) / 1e9 - t)
        k = int(np.argmin(apart))
        if t < decided + 0.5 or apart[k] > 0.002:  # before, the frame is another; poses without a scan are in no file
            continue
        turn = np.degrees(poses[k, 2])
        assert np.hypot(x - poses[k, 0], y - poses[k, 1]) < 0.002
        told = re.fullmatch(r"x (\S+) m, y (\S+) m, heading (\S+)°, ± (\S+) m", text)
        assert told, text
        np.testing.assert_allclose([float(told[1]), float(told[2])], poses[k, :2], atol=0.002)
        assert abs((float(told[3]) - turn + 180) % 360 - 180) < 0.2
        shown += 1
    assert shown >= 3


@pytest.mark.slow
@pytest.mark.realtime
@needs_browser
def test_the_page_tells_of_start_up_devices_and_beacons(lived: Lived) -> None:
    assert "Waiting for motion" in lived.words["early"]
    for text in ("Arrival to pose", "lidar", "uwb", "Hz", "Dropped", "Beacons placed5"):
        assert text in lived.words["tiles"], text
    assert lived.words["beacon-words"].count("static") == 5
    assert "frame decided by beacons" in lived.words["event-words"]
    width, height, cell, beacons = json.loads(lived.words["map"])
    assert min(width, height) * cell > 8.0  # the workshop is 12 x 19 m
    assert beacons == 5
    assert lived.console == []


@pytest.mark.slow
@pytest.mark.realtime
def test_localising_leaves_the_map_as_it_was(lived: Lived, tmp_path: Path) -> None:
    words = ["live", "--emulate", "workshop", "-o", str(tmp_path / "out"), "--duration", "4"]
    assert main([*words, "--localize", str(lived.folder), "--view", "off"]) == 0
    assert (tmp_path / "out" / "map.pgm").read_bytes() == (lived.folder / "map.pgm").read_bytes()
    found, before = read_run(tmp_path / "out"), read_run(lived.folder)
    assert found.summary["robot_rmse_m"] < 0.1
    np.testing.assert_allclose(found.beacons, before.beacons, atol=0.01)
    assert not (tmp_path / "out" / "state.npz").exists()


@pytest.mark.slow
@pytest.mark.realtime
def test_a_killed_run_has_its_recording_and_another_goes_on(lived: Lived, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "uwbslam_jax", "live", "--emulate", "workshop", "-o", str(tmp_path)]
    words += ["--resume", str(lived.folder), "--view", "off"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert "recording to" in process.stdout.readline() + process.stdout.readline()
        time.sleep(4.0)
        killed = time.time_ns()
        os.kill(process.pid, signal.SIGKILL)
    reader = Recording(next(tmp_path.glob("live-*.mcap")))
    last = max(message.stamp for message in reader)
    assert reader.truncated
    assert killed - last < SECOND
    words[words.index("--resume") + 1] = str(tmp_path)
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert "recording to" in process.stdout.readline() + process.stdout.readline()
        time.sleep(3.0)
        process.send_signal(signal.SIGINT)
        assert "arrival to pose" in process.communicate(timeout=60.0)[0]
    assert process.returncode == 0
    assert len(list(tmp_path.glob("live-*.mcap"))) == 2
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["decided_at"] < 0.5
    assert summary["robot_rmse_m"] < 0.1


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A report, in a window as narrow as Chromium makes one: about as wide as a phone."""
    folder = tmp_path_factory.mktemp("report")
    write_report(make_result(), folder / "report.html")
    with Browser(folder / "profile", (500, 900)) as browser:
        browser.open((folder / "report.html").as_uri())
        yield browser


@needs_browser
class TestReport:
    """The same page with a run that has ended."""

    def test_the_slider_moves_the_robot(self, browser: Browser) -> None:
        result = make_result()
        for k in (0, 57, 199):
            browser.run(
                f"const s = document.getElementById('time'); s.value = {k / 10}; s.dispatchEvent(new Event('input'))"
            )
            assert browser.text("clock") == f"{k / 10:.1f} s"
            x, y, yaw = result.poses[k]
            turn = (np.degrees(yaw) + 180) % 360 - 180
            told = re.match(r"x (\S+) m, y (\S+) m, heading (\S+)°", browser.text("pose"))
            assert told
            np.testing.assert_allclose([float(told[1]), float(told[2])], [x, y], atol=0.001)
            assert float(told[3]) == pytest.approx(turn, abs=0.06)

    def test_links_are_of_the_time_shown(self, browser: Browser) -> None:
        links = browser.run("setTime(10); return linksAt(now)")
        rows = make_result().range_residuals
        expected = {}
        for _, a, b, r in rows[(rows[:, 0] <= 10) & (rows[:, 0] > 8.7)]:
            expected[int(a), int(b)] = r
        assert {(a, b) for a, b, _ in links} == set(expected)
        for a, b, r in links:
            assert r == pytest.approx(expected[a, b], abs=1e-3)

    def test_keys_move_zoom_and_follow(self, browser: Browser) -> None:
        browser.run("fit(); setTime(5)")
        x, scale = browser.run("return [view.x, view.scale]")
        browser.press("\ue014")  # right
        browser.press("+")
        assert browser.run("return view.x") > x
        assert browser.run("return view.scale") == pytest.approx(1.3 * scale)
        browser.press("f")
        k = 50
        browser.until("return view.x", lambda v: abs(v - make_result().poses[k, 0]) < 1e-3)
        browser.press("0")
        assert browser.run("return document.getElementById('follow').checked") is False
        assert browser.run("return view.scale") == pytest.approx(scale)

    def test_it_plays(self, browser: Browser) -> None:
        browser.run("setTime(0); document.getElementById('play').click()")
        browser.until("return now", lambda t: t > 0.3)
        browser.run("stop()")

    def test_it_fits_a_phone_and_tells_no_error(self, browser: Browser) -> None:
        assert browser.run("return document.documentElement.scrollWidth <= window.innerWidth")
        assert browser.console() == []


WRONG: dict[str, tuple[list[str], str]] = {
    "no device": ([], "no device: give --lidar URL"),
    "bad url": (["--lidar", "ftp://x"], "must begin with tcp:// or serial://"),
    "bad uwb": (["--lidar", "tcp://x", "--uwb", "serial:///dev/x?protocol=morse"], "no uwb protocol morse"),
    "both": (["--emulate", "workshop", "--lidar", "tcp://x"], "--emulate brings its own devices"),
    "world": (["--emulate", "mars"], "no world mars; there are workshop"),
    "view": (["--lidar", "tcp://x", "--view", "8765"], "8765: must be HOST:PORT"),
    "no state": (["--lidar", "tcp://x", "--resume", "none"], "state.npz: No such file"),
    "two ways": (["--lidar", "tcp://x", "--resume", "a", "--localize", "b"], "one of them"),
    "duration": (["--lidar", "tcp://x", "--duration", "-1"], "duration -1 s"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_a_user_can_mend_is_one_line(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words, says = WRONG[case]
    assert main(["live", "-o", "out", *words]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert says in told.err


@pytest.mark.slow
@pytest.mark.realtime
def test_a_radio_alone_runs_and_says_what_it_cannot_tell(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    departure = Departure()
    device = EMULATORS["dwm1001"](DeviceTime(time.time_ns()))
    server = Server(device, PtyPlug(tmp_path / "tag"), make_scenario("workshop", 0, 60.0), departure)
    server.start()
    small = ["--map.size-m", "12.8", "--lidar.max-beams", "60", "--uwb.max-beacons", "5", "--view", "off"]
    try:
        assert main(["live", "--uwb", server.url, "-o", str(tmp_path / "out"), "--duration", "5", *small]) == 0
    finally:
        server.stop()
    told = capsys.readouterr()
    assert told.err.count("warning: no LiDAR (--lidar URL)") == 1
    assert "neither scans nor odometry show how the robot moves" in told.err
    assert "has not moved" not in told.err + told.out
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["steps"] > 0
    assert summary["ids"] == [1, 2, 3, 4, 5]
    assert summary["status"] == "motion not known"
    top = (tmp_path / "out" / "report.html").read_text().partition("<main>")[0]
    assert all(warning in top for warning in summary["warnings"])


@pytest.mark.slow
@pytest.mark.realtime
def test_devices_that_are_not_there_are_told_at_the_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    url = f"tcp://127.0.0.1:{free_port()}"
    small = ["--map.size-m", "12.8", "--lidar.max-beams", "60", "--uwb.max-beacons", "3"]  # compiles faster
    assert main(["live", "--lidar", url, "-o", str(tmp_path), "--duration", "0.5", "--view", "off", *small]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert f"nothing was measured: lidar ({url}) is closed" in told
    assert "refused" in told
