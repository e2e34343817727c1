"""`uwbslam live` against emulated devices: how late, how much memory, what is lost, what faults and kills leave."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader

import uwbslam_jax as us
from benchmarks.metric import Metric, Report
from uwbslam_jax.files import read_run
from uwbslam_jax.live import DROPPED

_WORDS = [sys.executable, "-m", "uwbslam_jax"]
_SETTLED_S = 120.0
"""Memory is looked at from here on."""
_FIRST_S = 10.0
"""Scans dropped before are not counted."""
_FAULTS = ["--drop", "0.01", "--corrupt", "0.01", "--unplug", "60", "5"]
_WAIT_S = 180.0


def measure(*, quick: bool) -> Report:
    """Ten minutes without faults and their recording, two with faults, and twenty kills."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        metrics = _long_run(folder / "long", 60.0 if quick else 600.0)
        metrics += _faulty_run(folder, 70.0 if quick else 180.0)
        metrics += _kills(folder, 2 if quick else 20)
    about = (
        "Emulated UTM-30LX-EW (40 Hz, 1081 beams) over TCP and five DWM1000 beacons over a pseudo-terminal in the "
        "workshop, the emulators on the same machine; every run in real time. Memory: a straight line through what "
        f"the process holds from {_SETTLED_S:g} s on. With faults: 1 % of the bytes lost and 1 % damaged on either "
        "line, and every minute the plug of each device pulled for 5 s, which restarts it. Kills: SIGKILL at a random "
        "moment between 1 and 8 s after the recording began; each run resumes the one before."
    )
    return Report("Live", about, metrics)


def _long_run(out: Path, seconds: float) -> list[Metric]:
    memory: list[tuple[float, float]] = []

    def watch(process: subprocess.Popen) -> None:
        begin = time.monotonic()
        while process.poll() is None:
            memory.append((time.monotonic() - begin, _resident_mb(process.pid)))
            time.sleep(1.0)

    summary = _live(out, ["--emulate", "workshop", "--duration", str(seconds)], watch)
    t, mb = np.array([(at, held) for at, held in memory if held > 0]).T
    late = (t > min(_SETTLED_S, seconds / 2)) & (t < seconds)  # what is written at the end is not the loop's
    slope, _ = np.polyfit(t[late], mb[late], 1)
    recording = out / summary["recording"]
    lost, taken = _scans(recording)
    again = out / "again"
    subprocess.run([*_WORDS, "run", str(recording), "-o", str(again), "--quiet"], check=True, stdout=subprocess.DEVNULL)
    ours, theirs = read_run(out), read_run(again)
    differ = _differing((ours.stamps, ours.poses), (theirs.stamps, theirs.poses))
    if differ:  # a seldom fault: nobody would see it again
        print(f"kept: {shutil.copytree(out, tempfile.mkdtemp(), dirs_exist_ok=True)}", file=sys.stderr)
    return [
        Metric("length of the run", seconds, "s"),
        Metric(f"scans dropped after {_FIRST_S:g} s", 100.0 * lost / taken, "%", "lower", 0.1),
        Metric("arrival to pose, median", summary["latency_ms_median"], "ms", "lower", 5.0),
        Metric("arrival to pose, p99", summary["latency_ms_p99"], "ms", "lower", 25.0),
        Metric("memory held", float(np.median(mb[late])), "MB", "lower"),
        Metric("memory growth in 8 min", 100.0 * slope * 480.0 / float(np.median(mb[late])), "%", "lower", 1.0),
        Metric("robot RMS", summary["robot_rmse_m"], "m", "lower", 0.03),
        Metric("frames that differ when the recording is run again", float(differ), "", "lower", 0.0),
    ]


def _differing(ours: tuple[np.ndarray, np.ndarray], theirs: tuple[np.ndarray, np.ndarray]) -> int:
    """How many frames of two tracks (stamps, poses) are not the same bits, or are in one of them only."""
    both, a, b = np.intersect1d(ours[0], theirs[0], return_indices=True)
    same = int(np.count_nonzero(np.all(ours[1][a] == theirs[1][b], axis=1)))
    return len(ours[0]) + len(theirs[0]) - len(both) - same


def _faulty_run(folder: Path, seconds: float) -> list[Metric]:
    truth = folder / "faulty.truth.npz"
    with _emulated(folder, truth) as (lidar, uwb):
        robot = ["--config", str(_robot_of_the_workshop(folder)), "--duration", str(seconds)]
        summary = _live(folder / "faulty", ["--lidar", lidar, "--uwb", uwb, *robot])
    told = us.evaluate(folder / "faulty", truth)
    return [
        Metric("with faults: robot RMS", told["robot_rmse_m"], "m", "lower", 0.05),
        Metric("with faults: counted", float(sum(summary["dropped"].values())), ""),
        Metric("with faults: connections", float(sum(d["connections"] for d in summary["devices"].values())), ""),
    ]


def _kills(folder: Path, times: int) -> list[Metric]:
    rng = np.random.default_rng(0)
    out, worst, resumed = folder / "killed", 0.0, 0
    subprocess.run(
        [*_WORDS, "live", "--emulate", "workshop", "-o", str(out), "--view", "off", "--duration", "30"],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    for number in range(times):
        before = set(out.glob("live-*.mcap"))
        words = [*_WORDS, "live", "--emulate", "workshop", "-o", str(out), "--view", "off", "--resume", str(out)]
        with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
            _until_recording(process)
            time.sleep(float(rng.uniform(1.0, 8.0)))
            killed = time.time_ns()
            os.kill(process.pid, signal.SIGKILL)
        (recording,) = set(out.glob("live-*.mcap")) - before
        worst = max(worst, (killed - max(message.stamp for message in us.read(recording))) / 1e9)
        resumed += number > 0 or bool(before)
        time.sleep(1.0)  # recordings are named by the second
    last = _live(out, ["--emulate", "workshop", "--resume", str(out), "--duration", "8"])
    return [
        Metric("kills", float(resumed), ""),
        Metric("most that a kill lost", worst, "s", "lower", 1.0),
        Metric("resumed after the last: robot RMS", last["robot_rmse_m"], "m", "lower", 0.05),
    ]


def _live(out: Path, words: list[str], watch: Callable[[subprocess.Popen], object] | None = None) -> dict[str, Any]:
    """Summary of a live run. watch: called once it records."""
    command = [*_WORDS, "live", "-o", str(out), "--view", "127.0.0.1:0", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        _until_recording(process)
        if watch is not None:
            watch(process)
        said = process.communicate()[0]
    if process.returncode:
        raise RuntimeError(f"uwbslam live: {said}")
    return json.loads((out / "summary.json").read_text(encoding="utf-8"))


def _until_recording(process: subprocess.Popen) -> None:
    assert process.stdout is not None
    for text in process.stdout:
        if text.startswith("recording to"):
            return
    raise RuntimeError("uwbslam live did not begin to record")


@contextmanager
def _emulated(folder: Path, truth: Path) -> Iterator[tuple[str, str]]:
    """URLs of an emulated scanner and radio with faults."""
    devices = ["hokuyo=tcp://127.0.0.1:0", f"dwm1000=serial://{(folder / 'radio').absolute()}"]
    words = [*_WORDS, "emulate", *devices, "--world", "workshop", "--truth", str(truth), *_FAULTS]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        urls: list[str] = []
        assert process.stdout is not None
        while len(urls) < 2:
            said = process.stdout.readline()
            if not said:
                raise RuntimeError("uwbslam emulate did not begin")
            urls += [word for word in said.split()[1:2] if "://" in word]
        try:
            yield urls[0], urls[1]
        finally:
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=_WAIT_S)


def _robot_of_the_workshop(folder: Path) -> Path:
    """A settings file with what a user would configure for this robot."""
    path = folder / "robot.toml"
    us.save_settings(us.simulate("workshop").settings, path)
    return path


def _scans(recording: Path) -> tuple[int, int]:
    """Scans dropped after the first seconds, and all of that time."""
    topic, counts = us.LidarSettings().topic, {}
    with recording.open("rb") as file:
        reader = make_reader(file)
        begin = min(message.log_time for _, _, message in reader.iter_messages())
        since = begin + int(_FIRST_S * 1e9)
        for name in (topic + DROPPED, topic):
            counts[name] = sum(1 for _ in reader.iter_messages(topics=[name], start_time=since))
    return counts[topic + DROPPED], sum(counts.values())


def _resident_mb(pid: int) -> float:
    """Memory that a process holds [MB], 0 once it is gone."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="utf-8").split()[1])
    except (OSError, IndexError, ValueError):
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
