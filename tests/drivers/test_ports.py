"""Sources against emulated devices over real sockets and pseudo-terminals, with what goes wrong there."""

from __future__ import annotations

import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uwbslam_drivers import Source, dwm1000, dwm1001, hokuyo, open_source, rplidar
from uwbslam_drivers.clock import host_time
from uwbslam_drivers.device import DeviceFailure, DriverError
from uwbslam_drivers.emulators.command import EmulateOptions, emulate
from uwbslam_drivers.emulators.faults import Faults, Line, within
from uwbslam_drivers.emulators.plugs import Plug, PtyPlug, TcpPlug
from uwbslam_drivers.emulators.robot import Departure, DeviceTime
from uwbslam_drivers.emulators.serve import EMULATORS, Server
from uwbslam_drivers.ports import SerialPort
from uwbslam_drivers.source import DEVICES, Reading, parse_url
from uwbslam_jax.__main__ import main
from uwbslam_jax.evaluation import Truth
from uwbslam_jax.measurements import RangeMessage, ScanMessage
from uwbslam_jax.sim import Scenario, make_scenario

MS = 1_000_000
PATIENCE = 30.0
"""After this time a test gives up [s]; none of them takes nearly as long."""


@contextmanager
def served(
    name: str, plug: Plug, made: Scenario, faults: Faults | None = None, shows: int = 42_000_000_000
) -> Iterator[tuple[Server, Departure]]:
    """A device that is switched on now; its clock shows some time [ns] and runs too fast."""
    departure = Departure()
    device = EMULATORS[name](DeviceTime(host_time(), shows, 50.0))
    server = Server(device, plug, made, departure, faults, number=2)  # the first fault comes early
    server.start()
    try:
        yield server, departure
    finally:
        server.stop()


def plug_of(name: str, folder: Path) -> Plug:
    return TcpPlug("127.0.0.1", 0) if name == "hokuyo" else PtyPlug(folder / name)


def kind_of(name: str) -> str:
    return "lidar" if name in ("hokuyo", "rplidar") else "uwb"


def collect(source: Source, enough: Callable[[list[Reading]], bool]) -> list[Reading]:
    """Readings until there are enough; fails where they do not come."""
    late = threading.Timer(PATIENCE, source.close)
    late.start()
    readings: list[Reading] = []
    for reading in source:
        readings.append(reading)
        if enough(readings):
            source.close()
    late.cancel()
    assert enough(readings), f"{len(readings)} readings, {source.failure or 'no failure'}, {dict(source.counts)}"
    assert source.status == "closed"
    return readings


def workshop(seconds: float = 60.0) -> Scenario:
    return make_scenario("workshop", 0, seconds)


# Devices -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "query"),
    [
        ("hokuyo", "&mode=md"),
        ("hokuyo", "&mode=me"),
        ("rplidar", "&mode=express"),
        ("rplidar", "&mode=standard"),
        ("dwm1000", ""),
        ("linktrack", "&baud=115200"),
        ("dwm1001", "&id=9"),
        ("makerfabs", ""),
    ],
)
def test_every_device_is_made_to_talk_over_its_port(name: str, query: str, tmp_path: Path) -> None:
    made = workshop()
    if name == "dwm1001":
        made = replace(made, uwb=replace(made.uwb, robot_id=9))
    with served(name, plug_of(name, tmp_path), made) as (server, departure):
        source = open_source(server.url + query, kind_of(name))
        number = 5 if name == "rplidar" else 30
        readings = collect(source, lambda found: len(found) >= number)
    assert departure.at is not None
    kind = ScanMessage if kind_of(name) == "lidar" else RangeMessage
    assert all(isinstance(reading.message, kind) for reading in readings)
    assert source.counts["connections"] == 1
    assert not [reason for reason in source.counts if ":" in reason], source.counts
    for reading in readings:
        assert departure.at - 1 * MS <= reading.message.stamp <= reading.received
        if isinstance(reading.message, RangeMessage):
            assert reading.message.source == made.uwb.robot_id or name == "dwm1000"


@pytest.mark.parametrize(("name", "says"), [("rplidar-c1", "0x85 (dense capsules"), ("rplidar-old", "old firmware")])
def test_a_scanner_whose_express_scan_is_not_read_scans_all_the_same(name: str, says: str, tmp_path: Path) -> None:
    with served(name, PtyPlug(tmp_path / name), workshop()) as (server, departure):
        source = open_source(server.url, "lidar")
        readings = collect(source, lambda found: len(found) >= 8)
    (note,) = source.notes
    assert says in note
    assert "mode=standard" in note
    assert not [reason for reason in source.counts if ":" in reason], source.counts
    scans = [reading.message for reading in readings if isinstance(reading.message, ScanMessage)]
    # of 2000 samples a second, a tenth in each turn; old firmware does not tell, and turns are read late by turns
    assert abs(scans[-1].time_increment / 500e-6 - 1.0) < (0.1 if name == "rplidar-old" else 1e-6)
    assert {195 < scan.ranges.size < 205 for scan in scans} == {True}
    assert departure.at is not None
    assert all(departure.at - 1 * MS <= scan.stamp for scan in scans)


class Answering:
    """A port behind which each line or request gets an answer."""

    def __init__(self, answer: Callable[[bytes], bytes]):
        self._answer, self._said = answer, b""

    def read(self, timeout: float) -> bytes:
        said, self._said = self._said, b""
        time.sleep(0.0 if said else min(timeout, 0.01))
        return said

    def write(self, data: bytes) -> None:
        self._said += self._answer(data)

    def close(self) -> None:
        pass


def test_the_speeds_of_a_scanner_are_tried_in_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rplidar, "_ANSWER", 0.05)

    def noise() -> Answering:
        return Answering(lambda data: b"\x80")

    with served("rplidar", PtyPlug(tmp_path / "scanner"), workshop()) as (server, _):
        address = parse_url(server.url, "lidar")
        assert len(address.ways) == 4
        assert len(parse_url(f"{server.url}&baud=460800", "lidar").ways) == 1
        source = Source(replace(address, ways=[noise, address.open]))
        collect(source, lambda found: len(found) >= 2)
    assert source.counts["connection: lost or refused"] == 1
    source = Source(replace(address, ways=[noise]))
    with pytest.raises(DeviceFailure, match="460800 C1, 1000000 S2, S3"):
        source.address.device.start(source.address.open(), address.options, source.counts)


@pytest.mark.parametrize(
    ("protocol", "answer", "says"),
    [
        ("rplidar", lambda data: rplidar.RATE_HEADER + bytes(4), "descriptor 0x15 in place of 0x06"),
        ("hokuyo", lambda data: data + b"E\n\n", "SCIP 1 only, update its firmware"),
        ("hokuyo", lambda data: b"", "not a SCIP 2 sensor, no power"),
        ("dwm1001", lambda data: b"\x40\x01\x01", "generic (TLV) mode"),
        ("dwm1001", lambda data: b"", "no power, or another baud"),
    ],
)
def test_a_device_that_does_not_talk_as_it_should_is_told_why(
    protocol: str, answer: Callable[[bytes], bytes], says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rplidar, "_ANSWER", 0.05)
    monkeypatch.setattr(hokuyo, "_ANSWER", 0.02)
    monkeypatch.setattr(dwm1001, "_ANSWER", 0.05)
    monkeypatch.setattr(dwm1001, "_LISTEN", 0.05)
    options = {name: option.default for name, option in DEVICES[protocol].options.items()}
    with pytest.raises(DeviceFailure) as error:
        DEVICES[protocol].start(Answering(answer), options, Counter())
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_hokuyo_stamps_are_the_times_of_the_first_beams(tmp_path: Path) -> None:
    made = workshop()
    made = replace(made, lidar=replace(made.lidar, jitter=0.0))
    with served("hokuyo", TcpPlug("127.0.0.1", 0), made) as (server, departure):
        readings = collect(open_source(server.url, "lidar"), lambda found: len(found) >= 60)
    assert departure.at is not None
    since = np.array([reading.message.stamp - departure.at for reading in readings])
    late = since - 25 * MS * np.round(since / (25 * MS))
    # The clock tells whole milliseconds; an exchange on a busy machine is off by half of what it takes.
    assert np.abs(np.median(late)) < 4 * MS
    # What remains in single scans is the resolution and the search for the least delay at the beginning.
    assert np.ptp(late[20:]) < 2.1 * MS


@pytest.mark.parametrize(("name", "wrap"), [("hokuyo", hokuyo.WRAP), ("dwm1000", dwm1000.WRAP)])
def test_the_clock_of_a_device_may_wrap(name: str, wrap: int, tmp_path: Path) -> None:
    with served(name, plug_of(name, tmp_path), workshop(), shows=wrap - 1500 * MS) as (server, departure):
        source = open_source(server.url, kind_of(name))
        readings = collect(source, lambda found: found[-1].received - found[0].received > 2000 * MS)
    assert departure.at is not None
    ticks = np.array([reading.device for reading in readings])
    assert ticks.max() > wrap - 100 * MS
    assert ticks[-1] < 1500 * MS
    # Host times go on as if nothing had happened: no more than a delay apart.
    stamps = np.array([reading.message.stamp for reading in readings])
    assert np.abs(np.diff(stamps)).max() < 500 * MS
    assert stamps[-1] - stamps[0] > 1900 * MS
    assert not [reason for reason in source.counts if ":" in reason]


def test_hokuyo_over_a_serial_port_goes_on_after_a_client_that_was_killed(tmp_path: Path) -> None:
    with served("hokuyo", PtyPlug(tmp_path / "urg"), workshop()) as (server, _):
        first = open_source(server.url, "lidar")
        port = first.address.open()
        port.write(b"MD0000108001000\n")
        time.sleep(0.2)
        port.close()  # without QT: the sensor goes on sending to nobody
        readings = collect(open_source(server.url, "lidar"), lambda found: len(found) >= 10)
    assert all(np.isfinite(reading.message.ranges).mean() > 0.9 for reading in readings)  # type: ignore[union-attr]


# Faults --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["hokuyo", "rplidar", "dwm1000"])
def test_damaged_and_lost_bytes_in_pieces_cost_only_what_they_hit(name: str, tmp_path: Path) -> None:
    faults = Faults(drop=0.002, corrupt=0.002, split=600, coalesce=0.03)
    number = 8 if name == "rplidar" else 60
    with served(name, plug_of(name, tmp_path), workshop(), faults) as (server, departure):
        source = open_source(server.url, kind_of(name))
        readings = collect(source, lambda found: len(found) >= number)
    assert departure.at is not None
    assert sum(count for reason, count in source.counts.items() if ":" in reason) > 0
    for reading in readings:
        message = reading.message
        assert departure.at - 100 * MS < message.stamp <= reading.received
        if isinstance(message, ScanMessage):
            assert np.isfinite(message.ranges).mean() > 0.1
        else:
            assert 0.0 < message.range < 30.0


@pytest.mark.parametrize("name", ["hokuyo", "dwm1000", "dwm1001"])
def test_a_pulled_plug_is_found_again(name: str, tmp_path: Path) -> None:
    faults = Faults(unplug=(6.0, 0.6))  # first from 0.96 s to 1.56 s

    def twice(found: list[Reading]) -> bool:
        return source.counts["connections"] >= 2 and len(found) >= before.setdefault("second", len(found) + 12)

    before: dict[str, int] = {}
    made = workshop()
    with served(name, plug_of(name, tmp_path), made, faults) as (server, departure):
        source = open_source(server.url, kind_of(name))
        readings = collect(source, twice)
    assert departure.at is not None
    assert source.counts["connection: lost or refused"] >= 1
    gaps = np.diff([reading.received for reading in readings]) / 1e9
    assert gaps.max() > 0.55
    stamps = np.array([reading.message.stamp for reading in readings])
    assert (stamps > departure.at - 1 * MS).all()
    assert (stamps <= [reading.received for reading in readings]).all()


def test_a_pause_delays_but_loses_nothing(tmp_path: Path) -> None:
    faults = Faults(pause=(1.0, 0.4))
    with served("dwm1000", PtyPlug(tmp_path / "uwb"), workshop(), faults) as (server, departure):
        source = open_source(server.url, "uwb")
        readings = collect(source, lambda found: len(found) >= 200)
    assert departure.at is not None
    assert not [reason for reason in source.counts if ":" in reason]
    delays = np.array([reading.received - reading.message.stamp for reading in readings]) / MS
    assert delays.max() > 200.0  # held back
    assert np.median(delays) < 100.0  # and stamped with the time of the exchange all the same


def test_a_device_that_says_nothing_is_tried_again_and_can_be_closed_at_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        source = open_source(f"tcp://127.0.0.1:{listener.getsockname()[1]}?protocol=rplidar", "lidar")
        thread = threading.Thread(target=lambda: list(source))
        thread.start()
        listener.settimeout(PATIENCE)
        accepted, _ = listener.accept()
        with accepted:
            source.close()
            thread.join(PATIENCE)
    assert not thread.is_alive()
    assert source.status == "closed"
    assert source.counts["connections"] == 0


def test_a_refused_connection_is_told_and_tried_again() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
    source = open_source(url, "lidar")
    thread = threading.Thread(target=lambda: list(source))
    thread.start()
    until = time.monotonic() + PATIENCE
    while source.counts["connection: lost or refused"] < 2 and time.monotonic() < until:
        time.sleep(0.01)
    source.close()
    thread.join(PATIENCE)
    assert source.counts["connection: lost or refused"] >= 2
    assert "refused" in source.failure
    assert "\n" not in source.failure


def test_a_serial_port_is_opened_by_one_program_only(tmp_path: Path) -> None:
    plug = PtyPlug(tmp_path / "uwb")
    first = SerialPort(str(tmp_path / "uwb"), 115200)
    with pytest.raises(OSError):
        SerialPort(str(tmp_path / "uwb"), 115200)
    first.close()
    plug.pull()


# URLs ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("url", "kind", "complaint"),
    [
        ("/dev/ttyACM0", "uwb", "must begin with tcp:// or serial://"),
        ("tcp://", "lidar", "no host"),
        ("tcp://host:x", "lidar", "x"),
        ("tcp://host", "uwb", "no port"),
        ("serial://", "uwb", "no port"),
        ("serial://ttyACM0", "uwb", "no port"),
        ("serial:///dev/x?baud=fast", "uwb", "baud fast"),
        ("serial:///dev/x?protocol=hokuyo", "uwb", "no uwb protocol hokuyo; there are dwm1000"),
        ("serial:///dev/x?bad=1", "uwb", "unknown option bad; there is baud"),
        ("serial:///dev/x?modes=md&protocol=rplidar", "lidar", "unknown option modes; there is mode"),
        ("tcp://host?baud=9600", "lidar", "unknown option baud"),
        ("serial:///dev/x?baud", "uwb", "bad query"),
        ("tcp://host?mode=fast", "lidar", "mode fast: must be md or me"),
        ("serial:///dev/x?protocol=dwm1001&id=-1", "uwb", "id -1: must be a whole number"),
    ],
)
def test_a_bad_url_is_told_in_one_line(url: str, kind: str, complaint: str) -> None:
    with pytest.raises(DriverError, match=complaint) as error:
        open_source(url, kind)
    assert str(error.value).startswith(url)
    assert "\n" not in str(error.value)


def test_a_url_has_the_defaults_of_its_device() -> None:
    assert parse_url("tcp://192.168.0.10", "lidar").protocol == "hokuyo"
    assert parse_url("serial:///dev/ttyACM0", "uwb").protocol == "dwm1000"
    assert parse_url("serial:///dev/x?protocol=linktrack", "uwb").options == {"baud": "921600"}
    assert parse_url("tcp://host?protocol=rplidar&mode=standard", "lidar").options == {"mode": "standard"}


# Emulators -----------------------------------------------------------------------------------------------------------


def test_lines_with_faults_do_what_they_say() -> None:
    rng = np.random.default_rng(0)
    data = bytes(range(256)) * 400
    kept = Line(Faults(drop=0.1), rng).mangle(data)
    assert 0.88 < len(kept) / len(data) < 0.92
    changed = np.frombuffer(Line(Faults(corrupt=0.1), rng).mangle(data), np.uint8) != np.frombuffer(data, np.uint8)
    assert 0.08 < changed.mean() < 0.12
    pieces = Line(Faults(split=7), rng).take(data, 0.0)
    assert b"".join(pieces) == data
    assert {len(piece) for piece in pieces} == set(range(1, 8))
    slow = Line(Faults(coalesce=0.5), rng)
    assert [slow.take(b"ab", t) for t in (0.0, 0.2, 0.4, 0.6)] == [[], [], [], [b"abababab"]]
    resting = Line(Faults(pause=(10.0, 2.0)), rng)
    assert [resting.take(b"ab", t) for t in (7.9, 8.1, 9.9, 10.0)] == [[b"ab"], [], [], [b"ababab"]]
    assert within((10.0, 2.0), 3.1, phase=0.5)
    assert not within((10.0, 2.0), -1.0)


def test_emulate_serves_one_robot_at_several_ports_and_writes_its_truth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    devices = (f"hokuyo=serial://{tmp_path}/lidar", f"dwm1000=serial://{tmp_path}/uwb")
    options = EmulateOptions(devices, duration=6.0, truth=tmp_path / "truth.npz")
    command = threading.Thread(target=emulate, args=(options,))
    command.start()
    while not (tmp_path / "uwb").exists() or not (tmp_path / "lidar").exists():
        assert command.is_alive()
        time.sleep(0.01)
    lidar = open_source(f"serial://{tmp_path}/lidar?protocol=hokuyo", "lidar")
    uwb = open_source(f"serial://{tmp_path}/uwb", "uwb")
    scans: list[Reading] = []
    listener = threading.Thread(target=lambda: scans.extend(lidar))
    listener.start()
    # The robot drives after 4 s; from then on times matter.
    ranges = collect(uwb, lambda found: found[-1].message.stamp - found[0].message.stamp > 5.2e9)
    command.join(PATIENCE)
    lidar.close()
    listener.join(PATIENCE)
    assert not command.is_alive()
    assert not (tmp_path / "uwb").exists()
    said = capsys.readouterr().out
    assert f"uwbslam live --lidar 'serial://{tmp_path}/lidar?protocol=hokuyo' --uwb 'serial://{tmp_path}/uwb" in said
    truth = Truth.load(tmp_path / "truth.npz")
    assert set(truth.beacons) == {1, 2, 3, 4, 5}
    stamps = np.array([reading.message.stamp for reading in ranges])
    assert truth.stamps[0] - 100 * MS < stamps.min()
    robot = truth.poses_at(stamps)
    for k, reading in enumerate(ranges):
        message = reading.message
        assert isinstance(message, RangeMessage)
        if message.source == 0:
            distance = np.hypot(*(robot[k, :2] - truth.beacons[message.target][0, 1:]))
            assert message.range == pytest.approx(distance, abs=0.5)  # five sigma
    assert len(scans) > 200


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["emulate"], "no device given; there are hokuyo"),
        (["emulate", "hokuy"], "no emulated device hokuy, did you mean hokuyo?"),
        (["emulate", "hokuyo=/dev/x"], "/dev/x: must be tcp://HOST:PORT or serial:///PATH"),
        (["emulate", "hokuyo", "--world", "moon"], "no world moon; there are workshop"),
        (["emulate", "hokuyo", "--drop", "2"], "drop 2: must be at least 0 and less than 1"),
        (["emulate", "hokuyo", "--unplug", "5", "9"], "unplug 5 9: the second must be between 0 and the first"),
    ],
)
def test_bad_options_of_emulate_are_told_in_one_line(
    words: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    told = capsys.readouterr().err
    assert complaint in told
    assert told.count("\n") == 1
