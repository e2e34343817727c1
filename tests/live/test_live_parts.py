"""The parts of a live run, each by itself: queue, recording, saved state, page, view and publisher."""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from uwbslam_jax import estimator
from uwbslam_jax.api import Slam
from uwbslam_jax.errors import RunError, UsageError
from uwbslam_jax.files import ros_types
from uwbslam_jax.files.mcap_log import LogWriter, Recording
from uwbslam_jax.live.devices import Devices
from uwbslam_jax.live.live_run import LiveRun
from uwbslam_jax.live.message_queue import BEHIND_S, MOST, OVERFULL, OVERTAKEN, Arrival, Inbox
from uwbslam_jax.mapping.tiled_map import TILE, Tiles
from uwbslam_jax.measurements import Message, RangeMessage, ScanMessage, empty_frame
from uwbslam_jax.reasons import Sensor
from uwbslam_jax.session import saved_state
from uwbslam_jax.session.frame_assembler import FrameAssembler
from uwbslam_jax.session.saved_state import Locator, Saved
from uwbslam_jax.session.session import Session
from uwbslam_jax.settings import Found, MapSettings, Settings, make_config
from uwbslam_jax.web.live_page import LivePage, Status
from uwbslam_jax.web.server import LiveView, parse_address

SECOND = 1_000_000_000
MS = 1_000_000
T0 = 1_800_000_000 * SECOND
SMALL = replace(Settings(), map=MapSettings(size_m=6.4))


def scan(stamp: int, beams: int = 4) -> ScanMessage:
    return ScanMessage(stamp, -1.0, 0.1, 0.0, 0.1, 30.0, np.full(beams, 2.5, np.float32))


class Record:
    """Keeps what it is given."""

    def __init__(self) -> None:
        self.used: list[Arrival] = []
        self.dropped: list[Arrival] = []

    def record(self, arrival: Arrival, dropped: bool) -> None:
        (self.dropped if dropped else self.used).append(arrival)


def take_all(inbox: Inbox, now: int) -> list[Message]:
    found = []
    while (arrival := inbox.take(now, 0.0)) is not None:
        found.append(arrival.message)
    return found


# The queue ------------------------------------------------------------------------------------------------------------


def test_messages_come_in_the_order_of_their_arrival_and_are_recorded_in_it() -> None:
    record = Record()
    inbox = Inbox(record.record)
    sent = [RangeMessage(T0, 0, 1, 1.0), scan(T0), RangeMessage(T0, 0, 2, 1.0), RangeMessage(T0, 0, 3, 1.0)]
    for message in sent:
        inbox.put(message, T0)  # all in one read: the same time
    assert take_all(inbox, T0) == sent
    assert [a.message for a in sorted(record.used, key=lambda a: a.log_time)] == sent
    assert len({a.log_time for a in record.used}) == len(sent)
    assert not inbox.dropped


def test_a_hiccup_costs_no_scan() -> None:
    record = Record()
    inbox = Inbox(record.record)
    for k in range(20):
        inbox.put(scan(T0 + k * 25 * MS), T0 + k * 25 * MS)
    assert len(take_all(inbox, T0 + 500 * MS)) == 20
    assert not inbox.dropped


def test_a_loop_that_is_behind_gets_the_newest_scan_until_it_has_caught_up() -> None:
    record = Record()
    inbox = Inbox(record.record)
    late = int((BEHIND_S + 0.1) * SECOND)
    for k in range(10):
        inbox.put(scan(T0 + k * MS), T0 + k * MS)
        inbox.put(RangeMessage(T0 + k * MS, 0, 1, 1.0), T0 + k * MS)
    found = take_all(inbox, T0 + late)  # ends with an empty queue, but not before the newest was taken
    assert [m.stamp for m in found if isinstance(m, ScanMessage)] == [T0 + 9 * MS]
    assert sum(isinstance(m, RangeMessage) for m in found) == 10  # ranges are not lost
    assert inbox.dropped == {OVERTAKEN: 9}
    assert [a.message.stamp for a in record.dropped] == [T0 + k * MS for k in range(9)]
    assert sum(isinstance(a.message, ScanMessage) for a in record.used) == 1
    inbox.take(T0 + late, 0.0)  # nothing waits: it has caught up
    for k in range(3):
        inbox.put(scan(T0 + late + k * MS), T0 + late + k * MS)
    assert len(take_all(inbox, T0 + late + 3 * MS)) == 3


def test_scans_that_a_hanging_loop_will_not_use_are_recorded_meanwhile() -> None:
    record = Record()
    inbox = Inbox(record.record)
    for k in range(5):
        inbox.put(scan(T0 + k * MS), T0 + k * MS)
    inbox.thin(T0 + int(BEHIND_S * SECOND) // 2)
    assert not record.dropped
    inbox.thin(T0 + int(BEHIND_S * SECOND) + 10 * MS)
    assert len(record.dropped) == 4


def test_the_queue_is_bounded() -> None:
    inbox = Inbox(Record().record)
    for k in range(MOST + 7):
        inbox.put(RangeMessage(T0 + k, 0, 1, 1.0), T0 + k)
    found = take_all(inbox, T0 + MOST)
    assert len(found) == MOST
    assert found[0].stamp == T0 + 7
    assert inbox.dropped == {OVERFULL: 7}


# The recording --------------------------------------------------------------------------------------------------------

WRITER = """
import sys, time
from pathlib import Path
import numpy as np
from uwbslam_drivers.clock import host_time
from uwbslam_jax.settings import Settings
from uwbslam_jax.session import FrameAssembler
from uwbslam_jax.live.message_queue import Inbox
from uwbslam_jax.measurements import RangeMessage, ScanMessage
from uwbslam_jax.live.recorder import LogRecorder

recorder = LogRecorder(Path(sys.argv[1]), Settings())
inbox = Inbox(recorder.record)
ranges = np.linspace(1, 9, 1081, dtype=np.float32)
for k in range(10**6):
    now = host_time()
    inbox.put(RangeMessage(now, 0, 1 + k % 5, 2.0), now)
    inbox.put(ScanMessage(now, -2.0, 0.004, 0.0, 0.1, 30.0, ranges), now)
    while inbox.take(now, 0.0):
        pass
    print(now, flush=True)
    time.sleep(0.02)
"""


@pytest.mark.parametrize("seconds", [0.8, 1.37, 2.21])
def test_a_killed_process_loses_at_most_a_second(seconds: float, tmp_path: Path) -> None:
    path = tmp_path / "live.mcap"
    with subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True) as process:
        first = int(process.stdout.readline())
        time.sleep(seconds)
        os.kill(process.pid, signal.SIGKILL)
        last = [int(line) for line in process.stdout.read().split()][-1]
    reader = Recording(path)
    found = list(reader)
    assert reader.truncated is not None
    assert reader.truncated.startswith("recording breaks")
    assert last - found[-1].stamp < SECOND
    scans = [m.stamp for m in found if isinstance(m, ScanMessage)]
    assert scans[0] == first
    assert len(scans) > (found[-1].stamp - first) / SECOND * 20  # of about 50 a second, none is missing in between
    assert max(np.diff(scans)) < 0.5 * SECOND


def test_what_was_recorded_has_the_numbers_of_what_was_used(tmp_path: Path) -> None:
    sent = [RangeMessage(T0, 0, 1, 5.23, -81.53, -84.27), replace(scan(T0), angle_increment=0.004363323129985824)]
    used = [ros_types.recorded(message) for message in sent]
    assert used[0] != sent[0]
    with LogWriter(tmp_path / "a.mcap") as writer:
        for message in used:
            writer.write(message)
    back = list(Recording(tmp_path / "a.mcap"))
    assert back[0] == used[0]
    assert isinstance(back[1], ScanMessage)
    assert isinstance(used[1], ScanMessage)
    for name in ("angle_min", "angle_increment", "time_increment", "range_min", "range_max"):
        assert getattr(back[1], name) == getattr(used[1], name)
    np.testing.assert_array_equal(back[1].ranges, used[1].ranges)


# The saved state ------------------------------------------------------------------------------------------------------

BEACONS = np.array([[0.0, 0.0], [6.0, 0.0], [2.0, 5.0], [7.0, 6.0]])


def found_before() -> Saved:
    """A state with four beacons and a tile outside the window."""
    config = make_config(SMALL)
    state = estimator.init(config)
    mean, cov = np.array(state.belief.mean), np.array(state.belief.cov)
    for slot, place in enumerate(BEACONS, start=1):
        mean[2 * slot : 2 * slot + 2] = place
        cov[[2 * slot, 2 * slot + 1], [2 * slot, 2 * slot + 1]] = 1e-4
    active = np.array(state.active)
    active[1 : 1 + len(BEACONS)] = True
    state = state._replace(belief=state.belief._replace(mean=mean, cov=cov), active=active)
    tiles = Tiles(SMALL.map.resolution)
    layers = [np.full((1, TILE >> k, TILE >> k), 1.5 + k, np.float32) for k in range(3)]
    epochs = np.asarray(state.grid.epochs)
    epochs = np.zeros((1, *(n * TILE // config.cells for n in epochs.shape[:2]), *epochs.shape[2:]), epochs.dtype)
    tiles.load(np.array([[3, -4]]), [*layers, epochs])
    return Saved(jax.device_get(state), tiles, {0: 0, 11: 1, 12: 2, 13: 3, 14: 4}, Found({1: 0.15}, {2: 1.2}, 0.01))


def test_what_is_saved_comes_back(tmp_path: Path) -> None:
    saved = found_before()
    saved_state.save(saved, tmp_path)
    back = saved_state.load(tmp_path, SMALL)
    jax.tree.map(np.testing.assert_array_equal, back.state, saved.state)
    assert back.slots == saved.slots
    assert back.found == saved.found
    places, layers = back.tiles.dump()
    assert places.tolist() == [[3, -4]]
    for mine, theirs in zip(layers, saved.tiles.dump()[1], strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert [path.name for path in tmp_path.iterdir()] == ["state.npz"]


def test_a_state_of_another_size_or_none_is_told_in_a_line(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"state\.npz: No such file"):
        saved_state.load(tmp_path, SMALL)
    saved_state.save(found_before(), tmp_path)
    with pytest.raises(RunError, match=r"map\.resolution 0\.05"):
        saved_state.load(tmp_path, replace(SMALL, map=MapSettings(size_m=6.4, resolution=0.1)))
    with pytest.raises(RunError, match=r"other map\.size_m"):
        saved_state.load(tmp_path, Settings())
    (tmp_path / "state.npz").write_bytes((tmp_path / "state.npz").read_bytes()[:-100])
    with pytest.raises(RunError, match="not a saved state"):
        saved_state.load(tmp_path, SMALL)


def test_ranges_tell_where_the_robot_is() -> None:
    rng, robot = np.random.default_rng(3), np.array([3.0, 2.0])
    locator = Locator(found_before(), SMALL)
    place, count = None, 0
    while place is None and count < 100:
        slot = 1 + count % 4
        r = float(np.hypot(*(BEACONS[slot - 1] - robot)) + 0.05 * rng.normal()) + (0.15 if slot == 1 else 0.0)
        place = locator.hear(T0 + count * 20 * MS, RangeMessage(T0 + count * 20 * MS, 0, 10 + slot, r))
        count += 1
    assert 10 < count < 30
    np.testing.assert_allclose(place, robot, atol=0.15)


def test_without_ranges_the_robot_is_where_it_was() -> None:
    locator = Locator(found_before(), SMALL)
    assert locator.hear(T0, scan(T0)) is None
    assert locator.hear(T0 + 2 * SECOND, scan(T0 + 2 * SECOND)) is None
    np.testing.assert_array_equal(locator.hear(T0 + 6 * SECOND, scan(T0)), [0.0, 0.0])


def test_a_session_goes_on_from_a_saved_state() -> None:
    for fixed in (False, True):
        session = Session(SMALL)
        session.go_on(found_before(), np.array([1.0, 2.0]), T0, fixed=fixed)
        assert session.decided_at == T0
        assert [session.beacon_status(slot) for slot in (1, 4)] == ["static", "static"]
        np.testing.assert_allclose(session.state.belief.mean[:2], [1.0, 2.0])
        assert float(session.params.bias[1]) == pytest.approx(0.15)
        assert session.config.draws != fixed


# Page and view --------------------------------------------------------------------------------------------------------


def events_of(url: str, until: str) -> list[tuple[str, Any]]:
    """Events of a live view up to one by name."""
    found = []
    with urllib.request.urlopen(url + "/events", timeout=10.0) as stream:
        name = ""
        for line in stream:
            kind, _, value = line.decode().rstrip("\n").partition(": ")
            if kind == "event":
                name = value
            elif kind == "data":
                found.append((name, json.loads(value)))
                if name == until:
                    return found
    return found


def test_a_viewer_gets_the_page_and_is_told_of_the_end() -> None:
    view = LiveView(LivePage("A <b>live</b> run"), "127.0.0.1", 0)
    with urllib.request.urlopen(view.url, timeout=10.0) as answer:
        text = answer.read().decode()
    assert "A &lt;b&gt;live&lt;/b&gt; run" in text
    assert "Waiting for the first scan" in text
    assert "http" not in text.replace(' http-equiv="', "").replace("http://www.w3.org", "")
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(view.url + "/../etc/passwd", timeout=10.0)
    foreign = urllib.request.Request(view.url, headers={"Host": "evil.example:80"})
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(foreign, timeout=10.0)
    threading.Timer(0.5, view.close).start()
    names = [name for name, _ in events_of(view.url, "end")]
    assert names[0] == "begin"
    assert names[-1] == "end"


def test_a_taken_port_and_a_bad_address_are_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UsageError, match=rf"live view at 127\.0\.0\.1:{port}: .* --view"):
            LiveView(LivePage("x"), "127.0.0.1", port)
    for bad in ("8765", "host:", "host:99999", ":80", "host:x"):
        with pytest.raises(UsageError, match="must be HOST:PORT"):
            parse_address(bad)


@cache
def blank_estimate() -> Any:
    """Of a step that learnt nothing."""
    session = Session(SMALL)
    frame = empty_frame(SMALL.lidar.max_beams, session.config.max_ranges)
    shapes = jax.eval_shape(partial(estimator.step, session.config), session.params, session.state, frame)[1]
    return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)


def notices(page: LivePage) -> str:
    return json.loads(page.words()[1])["notices"]


def test_a_page_of_radios_alone_waits_for_no_scan_and_for_no_motion() -> None:
    page, session = LivePage("x", scans=False), Session(SMALL)
    assert "Waiting for the first range." in page.whole()
    page.tell(Status(troubles=["no LiDAR"]))  # before anything was measured
    assert "no LiDAR" in notices(page)
    frames = FrameAssembler(SMALL, session.config.max_ranges)
    ranged, scanned = (*frames.add(RangeMessage(T0, 0, 1, 2.0)), *frames.flush(), *frames.add(scan(T0 + SECOND)))
    nothing = blank_estimate()
    page.step(session, session.update(ranged, nothing), Status())
    assert "nothing shows how the robot moves" in notices(page)
    page.step(session, session.update(scanned, nothing), Status())
    assert "Waiting for motion" in notices(page)
    page = LivePage("x")
    page.step(session, session.update(ranged, nothing), Status())
    assert "Waiting for the first scan." in notices(page)


def test_warnings_of_a_live_run_are_told_when_they_arise_and_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    devices = Devices(None, ["tcp://127.0.0.1:1?protocol=dwm1001"])
    source = devices.sources["uwb"]
    source.status, source.notes = "streaming", ["a note"]
    run = LiveRun(Slam(SMALL, fit=False), devices, tmp_path / "live.mcap", tell=told.append)
    few, many = Counter({OVERTAKEN: 10}), Counter({OVERTAKEN: 80})
    assert run._warn(few) == told
    assert [line[:8] for line in told] == ["no LiDAR", "uwb: a n"]
    source.status, source.failure = "opening", "refused"
    assert len(run._warn(few)) == 2  # it may be there in a moment
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 10.0)
    assert run._warn(few)[-1] == told[-1] == devices.troubles()[0]
    source.status, source.failure = "streaming", ""
    assert run._warn(many)[-1] == told[-1]
    assert told[-1].startswith("all 80 scans were left out")
    run._warn(Counter({OVERTAKEN: 90}))
    assert len(told) == len(run.told) == 4
    assert run.told[Sensor.SCAN].startswith("all 90 scans")
    run._recorder.close()


def test_a_device_that_sends_what_is_not_understood_is_told_so() -> None:
    devices = Devices(None, ["tcp://127.0.0.1:1?protocol=dwm1001"])
    source = devices.sources["uwb"]
    source.status = "waiting"
    source.counts["bytes"] = 700
    assert "700 bytes came, no measurement among them" in devices.troubles()[0]
    assert devices.silent() == [f"nothing was measured: {devices.troubles()[0]}"]
    source.counts["measurements"] = 1
    assert not devices.silent()


def test_texts_of_devices_stay_texts() -> None:
    page = LivePage("x")
    page._status = Status(troubles=["uwb is <script>alert(1)</script>"])
    _, words = page.words()
    assert "<script>" not in json.loads(words)["notices"]
    assert "alert(1)" in json.loads(words)["notices"]


# Foxglove -------------------------------------------------------------------------------------------------------------


def frame_of(stream: Any) -> tuple[int, bytes]:
    """Opcode and payload of the next WebSocket frame (RFC 6455, section 5.2)."""
    head = stream.read(2)
    length = head[1] & 0x7F
    if length >= 126:
        size = 2 if length == 126 else 8
        length = int.from_bytes(stream.read(size), "big")
    return head[0] & 0x0F, stream.read(length)


def masked(text: bytes) -> bytes:
    """A client's text frame of fewer than 126 bytes, with a mask of zeros."""
    return bytes([0x81, 0x80 | len(text)]) + bytes(4) + text


def test_published_poses_reach_a_foxglove_client() -> None:
    pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
    from uwbslam_jax.live.publisher import Publisher

    session = Session(SMALL)
    (frame,) = FrameAssembler(SMALL, session.config.max_ranges).add(scan(T0))
    estimate = blank_estimate()._replace(pose=np.array([1.25, -2.5, 0.5], np.float32))
    publisher = Publisher("127.0.0.1", 0)
    try:
        address = publisher.url.removeprefix("ws://").split(":")
        with socket.create_connection((address[0], int(address[1])), 10.0) as client:
            client.sendall(
                f"GET / HTTP/1.1\r\nHost: {address[0]}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
                "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n".encode()
            )
            stream = client.makefile("rb")
            assert b"101" in stream.readline()
            while stream.readline().strip():
                pass
            publisher.step(session, session.update(frame, estimate))
            channels: dict[str, int] = {}
            while "/pose" not in channels:
                _, payload = frame_of(stream)
                told = json.loads(payload)
                channels |= {c["topic"]: c["id"] for c in told.get("channels", [])}
            subscription = {"op": "subscribe", "subscriptions": [{"id": 7, "channelId": channels["/pose"]}]}
            client.sendall(masked(json.dumps(subscription).encode()))
            client.settimeout(0.2)
            payload = b""
            for _ in range(50):  # until the subscription is in force
                publisher.step(session, session.update(frame, estimate))
                try:
                    opcode, payload = frame_of(stream)
                except TimeoutError:
                    stream = client.makefile("rb")
                    continue
                if opcode == 2:
                    break
    finally:
        publisher.close()
    kind, number, stamp = struct.unpack_from("<BIQ", payload)
    assert (kind, number, stamp) == (1, 7, T0)
    store = get_typestore(Stores.ROS2_HUMBLE)
    message: Any = store.deserialize_cdr(payload[13:], "geometry_msgs/msg/PoseWithCovarianceStamped")
    assert (message.pose.pose.position.x, message.pose.pose.position.y) == (1.25, -2.5)
