"""Decoders against bytes published by the makers, against the emulators, and against garbage."""

from __future__ import annotations

import math
import re
from collections import Counter
from pathlib import Path

import fuzz_drivers
import numpy as np
import pytest
from emulated import DEPARTURE, LANGUAGES, SHOWS, decode, held, spoken, stream, workshop
from hypothesis import given, settings, strategies as st

from uwbslam_drivers import dwm1000, dwm1001, linktrack, makerfabs, rplidar, scip
from uwbslam_drivers.hokuyo import UTM_30LX_EW, HokuyoDecoder, Specification, parse_specification
from uwbslam_jax.measurements import RangeMessage, ScanMessage
from uwbslam_jax.sim import START_NS

MS = 1_000_000
README = Path(__file__).parents[2] / "drivers" / "README.md"
languages = pytest.mark.parametrize("name", LANGUAGES)


# Published bytes -----------------------------------------------------------------------------------------------------


def test_scip_sums_and_numbers_of_the_specification() -> None:
    assert chr(scip.checksum(b"Hokuyo")) == "o"
    assert chr(scip.checksum(b"00")) == "P"
    assert chr(scip.checksum(b"99")) == "b"
    for text, value in ((b"CB", 1234), (b"1Dh", 5432), (b"m2@0", 16_000_000)):
        assert scip.decode(text) == value
        assert scip.encode(value, len(text)) == text


NODEFRAME3 = bytes.fromhex(
    "55 05 32 00 02 01 f8 11 07 00 6f d0 6e 00 00 00 01 02 5a 13 04 01 00 22 0b 00 b5 9f 01 01 a3 17 00 b6 a0 01 02 88"
    "1c 00 aa 9f 01 03 e6 14 00 b8 a0 9a"
)
NODEFRAME2 = bytes.fromhex(
    "55 04 ac 00 02 01 ba 66 1d 00 06 09 ff de 0a 00 df ff ff e8 03 00 fa ff ff 1a 00 00 00 00 00 c0 12 00 00 00 00 00"
    "00 00 27 ac e2 3c 56 ed 1c 3c d2 70 3b bd 32 57 66 3e 3b cb 1b 41 93 70 61 bd 25 b2 6b 41 a1 22 6c 41 da da 6b 41"
    "6d 23 e9 23 70 dd db f7 30 3f 5f d6 31 3f ba 81 1e 3e 47 69 e2 bd 91 9b 40 40 c5 23 00 00 40 40 5c d5 1c 00 00 00"
    "1d 00 6d 13 04 01 00 6b 0c 00 b1 9f a6 66 1d 00 16 45 01 01 ac 15 00 b4 a1 a6 66 1d 00 d3 01 01 02 48 1a 00 ca 9f"
    "a6 66 1d 00 38 ba 01 03 2b 12 00 c6 a0 a6 66 1d 00 64 40 25"
)


@pytest.mark.parametrize(
    ("frame", "system", "nodes"),
    [
        (NODEFRAME3, 7262319, [(0, 2.850, -79.5, -90.5), (257, 6.051, -80.0, -91.0), (2, 7.304, -79.5, -85.0)]),
        (NODEFRAME2, 1926822, [(0, 3.179, -79.5, -88.5), (257, 5.548, -80.5, -90.0), (2, 6.728, -79.5, -101.0)]),
    ],
    ids=["NodeFrame3", "NodeFrame2"],
)
def test_linktrack_frames_of_the_maker(frame: bytes, system: int, nodes: list[tuple[int, float, float, float]]) -> None:
    # The tag has id 1, and so has an anchor: that one becomes 256 + 1, as in recordings.
    found = linktrack.LinkTrackDecoder(Counter()).feed(frame, 0)
    assert [m.device for m in found] == [system * MS] * 4
    messages = [m.message for m in found if isinstance(m.message, RangeMessage)]
    told = [(m.target, m.range, m.receive_power, m.first_path_power) for m in messages]
    assert told[:3] == nodes
    assert {m.source for m in messages} == {1}


def test_dwm1001_line_of_the_maker() -> None:
    line = b"DIST,4,AN0,1151,5.00,8.00,2.25,6.44,AN1,0CA8,0.00,8.00,2.25,6.50,AN2,111C,5.00,0.00,2.25,3.24,"
    line += b"AN3,1150,0.00,0.00,2.25,3.19,POS,2.55,2.01,1.71,98"
    assert dwm1001.parse(line) == [(0x1151, 6.44), (0x0CA8, 6.5), (0x111C, 3.24), (0x1150, 3.19)]
    assert dwm1001.parse(line[:-60]) is None


@pytest.mark.parametrize(
    ("line", "ranges"),
    [
        (
            b"AT+RANGE=tid:1,mask:04,seq:63,range:(0,0,30,0,0,0,0,0),rssi:(0.00,0.00,-77.93,0.00,0.00,0.00,0.00,0.00)",
            [(1, 2, 0.30, -77.93)],
        ),
        (
            b"AT+RANGE=tid:7,mask:0F,seq:128,range:(997,1321,911,738,0,0,0,0),ancid:(0,1,2,7,-1,-1,-1,-1)",
            [(7, 0, 9.97, math.nan), (7, 1, 13.21, math.nan), (7, 2, 9.11, math.nan), (7, 263, 7.38, math.nan)],
        ),
        (b"AT+RANGE=tid:7,mask:0F,seq:128,range:(997,13x1,911", None),
    ],
)
def test_makerfabs_lines_of_the_maker(line: bytes, ranges: list[tuple[int, int, float, float]] | None) -> None:
    found = makerfabs.parse(line)
    if ranges is None:
        assert found is None
        return
    assert found is not None
    np.testing.assert_equal(np.array(found), np.array(ranges))


def test_dwm1000_check_and_powers() -> None:
    assert dwm1000.checksum(b"123456789") == 0x29B1  # the check value of CRC-16/CCITT-FALSE in every catalogue
    # User manual 4.7: both formulas by hand, F = 1000, 2000, 3000, C = 5000, N = 100, PRF 64 MHz.
    receive, first = dwm1000.powers(64, 1000, 2000, 3000, 5000, 100)
    assert receive == pytest.approx(10.0 * math.log10(5000 * 2**17 / 1e4) - 121.74)
    assert first == pytest.approx(10.0 * math.log10(14e6 / 1e4) - 121.74)
    assert dwm1000.powers(16, 1000, 2000, 3000, 5000, 100)[0] == pytest.approx(receive + 121.74 - 113.77)
    assert np.isnan(dwm1000.powers(64, 0, 0, 0, 0, 100)).all()
    assert np.isnan(dwm1000.powers(64, 1, 1, 1, 1, 0)).all()


def test_dwm1000_lines_of_the_readme() -> None:
    examples = re.findall(r"^ {4}(\$UWB.*\*[0-9A-F]{4})$", README.read_text(encoding="utf-8"), re.MULTILINE)
    diagnosed, powered = (dwm1000.parse(example.encode()) for example in examples)
    assert diagnosed is not None
    assert powered is not None
    assert isinstance(diagnosed.message, RangeMessage)
    assert (diagnosed.device, diagnosed.message.source, diagnosed.message.target) == (4294967295 * 1000, 0, 3)
    assert diagnosed.message.range == 5.23
    assert diagnosed.message.receive_power > diagnosed.message.first_path_power
    assert powered.message == RangeMessage(0, 0, 3, 5.23, -81.5, -84.25)
    line = examples[0].encode()
    assert dwm1000.parse(line.replace(b"5230", b"5231")) is None
    powers = dwm1000.parse(dwm1000.frame("UWBP,1,2,3,-40,,-93.5").strip())
    assert powers is not None
    assert isinstance(powers.message, RangeMessage)
    assert powers.message.range == -0.04
    assert math.isnan(powers.message.receive_power)
    assert powers.message.first_path_power == -93.5


def test_rplidar_samples_of_the_protocol() -> None:
    # One node: quality 15, start, 1.5 degrees, 1000.25 mm; the bytes follow the tables of the protocol.
    node = bytes([15 << 2 | 1, (96 << 1 | 1) & 0xFF, 96 >> 7, 0xA1, 0x0F])
    assert rplidar._node(node, 0) == (1.5, 1.00025)
    assert rplidar._node(bytes([node[0] ^ 2]) + node[1:], 0) is None


# Emulator to decoder -------------------------------------------------------------------------------------------------


@languages
def test_pieces_of_any_size_give_the_same_as_the_whole(name: str) -> None:
    data = stream(name, 0.35)
    whole = decode(LANGUAGES[name].decoder(Counter()), data)
    assert whole, "nothing was decoded"
    for size in (1, 7, 1000):
        dropped: Counter[str] = Counter()
        pieces = decode(LANGUAGES[name].decoder(dropped), data, size)
        assert [m.device for m in pieces] == [m.device for m in whole]
        for a, b in zip(pieces, whole, strict=True):
            if isinstance(a.message, ScanMessage) and isinstance(b.message, ScanMessage):
                np.testing.assert_array_equal(a.message.ranges, b.message.ranges)
            else:
                assert repr(a.message) == repr(b.message)
        assert not dropped, "clean bytes were dropped"


@pytest.mark.parametrize("name", ["hokuyo md", "hokuyo me"])
def test_hokuyo_scans_are_those_of_the_simulator(name: str) -> None:
    decoder = LANGUAGES[name].decoder(Counter())
    sent = spoken(name, 0.3)
    found = [m for _, data, _ in sent for m in decode(decoder, data)]
    assert len(found) == len(sent) >= 10
    for measured, (_, _, scan) in zip(found, sent, strict=True):
        assert isinstance(measured.message, ScanMessage)
        assert measured.device is not None
        np.testing.assert_allclose(measured.message.ranges, scan.ranges, atol=5.1e-4)  # whole millimetres
        assert measured.message.angle_min == pytest.approx(-0.75 * np.pi)
        assert measured.message.angle_increment == pytest.approx(np.deg2rad(0.25))
        assert measured.message.time_increment == pytest.approx(scan.time_increment)
        late = measured.device - SHOWS - (scan.stamp - START_NS)
        assert -1.01 * MS < late < 0.01 * MS  # the sensor's clock tells whole milliseconds


@pytest.mark.parametrize("name", ["dwm1000", "dwm1000-powers"])
def test_dwm1000_ranges_are_those_of_the_simulator(name: str) -> None:
    decoder = LANGUAGES[name].decoder(Counter())
    sent = spoken(name, 1.0)
    found = [m for _, data, _ in sent for m in decode(decoder, data)]
    assert len(found) == len(sent) > 100
    for measured, (_, _, message) in zip(found, sent, strict=True):
        told = measured.message
        assert isinstance(told, RangeMessage)
        assert (told.source, told.target) == (message.source, message.target)
        assert told.range == pytest.approx(message.range, abs=5.1e-4)
        # The registers are whole numbers: some hundredths of a decibel.
        assert told.receive_power == pytest.approx(message.receive_power, abs=0.1)
        assert told.first_path_power == pytest.approx(message.first_path_power, abs=0.1)
        assert measured.device == pytest.approx(SHOWS + message.stamp - START_NS, abs=1001)


@pytest.mark.parametrize(
    ("name", "distance", "power", "time"),
    [
        ("linktrack", 5.1e-4, 0.26, 1 * MS),
        ("linktrack3", 5.1e-4, 0.26, 60 * MS),  # one time for a whole round
        ("dwm1001", 5.1e-3, None, None),
        ("makerfabs", 5.1e-3, 0.01, None),
    ],
)
def test_rounds_of_ranges_are_those_of_the_simulator(
    name: str, distance: float, power: float | None, time: float | None
) -> None:
    decoder = LANGUAGES[name].decoder(Counter())
    sent = spoken(name, 1.0)
    assert len(sent) >= 8
    for host, data, messages in sent:
        found = decoder.feed(data, host)
        assert len(found) == len(messages) > 0
        for measured, message in zip(found, messages, strict=True):
            told = measured.message
            assert isinstance(told, RangeMessage)
            assert (told.source, told.target) == (message.source, message.target)
            assert told.range == pytest.approx(message.range, abs=distance)
            if power is not None:
                assert told.receive_power == pytest.approx(message.receive_power, abs=power)
            if time is not None:
                assert measured.device == pytest.approx(SHOWS + message.stamp - START_NS, abs=time + 0.01 * MS)
            else:
                assert measured.device is None
                assert told.stamp == host


@pytest.mark.parametrize(("name", "samples"), [("rplidar standard", 200), ("rplidar express", 400)])
def test_rplidar_scans_are_what_stands_around_the_robot(name: str, samples: int) -> None:
    decoder = LANGUAGES[name].decoder(Counter())
    found = [m for host, data, _ in spoken(name, 1.0) for m in decoder.feed(data, host)]
    assert len(found) >= 7
    for measured in found:
        scan = measured.message
        assert isinstance(scan, ScanMessage)
        assert abs(scan.ranges.size - samples) <= 1
        assert scan.angle_increment == pytest.approx(-2.0 * np.pi / samples, rel=1e-3)
        # A turn begins each tenth of a second; the bytes are sent without delay.
        begin = (scan.stamp - DEPARTURE) / 1e8
        assert begin == pytest.approx(round(begin), abs=0.02)
        angles = scan.angle_min + scan.angle_increment * np.arange(scan.ranges.size)
        error = np.abs(scan.ranges - _seen(angles, round(begin) / 10.0))
        # Five sigma of its noise, but for a beam on an edge, where 1/64 degree is another wall.
        assert np.mean(error < 0.05) > 0.97


def _seen(angles: np.ndarray, t: float) -> np.ndarray:
    """Distances [m] along bearings [rad] from the resting robot, wall by wall."""
    made = workshop()
    x, y, yaw = made.path.pose(np.array([t]))[0]
    direction = np.exp(1j * (yaw + angles))
    result = np.full(angles.size, np.inf)
    for x1, y1, x2, y2 in made.world.segments:
        a, along = complex(x1 - x, y1 - y), complex(x2 - x1, y2 - y1)
        with np.errstate(divide="ignore", invalid="ignore"):
            det = (np.conj(direction) * along).imag
            reach, share = (np.conj(a) * along).imag / det, (np.conj(a) * direction).imag / det
        hit = (reach > 0.0) & (share >= 0.0) & (share <= 1.0)
        result = np.where(hit, np.minimum(result, reach), result)
    return result


# Hokuyo, what a scan may hold ----------------------------------------------------------------------------------------


def hokuyo_reply(values: np.ndarray, first: int, last: int, stamp: int = 1234) -> bytes:
    text = scip.encode(stamp, 4)
    head = b"MD%04d%04d01000\n99b\n" % (first, last) + text + bytes([scip.checksum(text)]) + b"\n"
    return head + scip.encode_blocks(values) + b"\n"


def test_hokuyo_error_codes_are_no_return_and_the_step_range_is_the_sensors_own() -> None:
    # A URG-04LX as its manual prints PP: 240 degrees of 1024 steps, values under 20 are error codes.
    told = {"DMIN": "20", "DMAX": "5600", "ARES": "1024", "AMIN": "44", "AMAX": "725", "AFRT": "384", "SCAN": "600"}
    spec = parse_specification(told)
    assert spec == Specification(44, 725, 384, 1024, 20, 5600, 600)
    values = np.arange(spec.beams)
    (measured,) = HokuyoDecoder(spec, Counter()).feed(hokuyo_reply(values, 44, 725), 0)
    scan = measured.message
    assert isinstance(scan, ScanMessage)
    assert np.isinf(scan.ranges[:20]).all()
    np.testing.assert_allclose(scan.ranges[20:], values[20:] / 1e3, rtol=1e-6)
    assert scan.angle_min == pytest.approx(-340 * 2.0 * np.pi / 1024)
    assert scan.time_increment == pytest.approx(0.1 / 1024)
    assert (scan.range_min, scan.range_max) == (0.02, 5.6)
    # From the rear to the first beam it turns 512 - 340 steps.
    assert measured.device == 1234 * MS + round(172 / 1024 * 1e8)


@pytest.mark.parametrize("told", [{"AFRT": "10"}, {"AMIN": "9"}, {"SCAN": "0"}, {"ARES": "5"}, {"DMAX": "x"}])
def test_hokuyo_specification_that_makes_no_sense_is_none(told: dict[str, str]) -> None:
    good = {"DMIN": "2", "DMAX": "60", "ARES": "9", "AMIN": "0", "AMAX": "8", "AFRT": "4", "SCAN": "600"}
    assert parse_specification(good) is not None
    assert parse_specification(good | told) is None
    assert parse_specification({name: value for name, value in good.items() if name not in told}) is None


def test_hokuyo_keeps_what_is_intact_of_a_damaged_scan() -> None:
    values = np.random.default_rng(0).integers(23, 30000, 1081)
    reply = hokuyo_reply(values, 0, 1080)
    head = reply.index(b"99b\n") + 10
    damages = {
        "changed": reply[: head + 100] + b"#" + reply[head + 101 :],
        "lost": reply[: head + 100] + reply[head + 101 :],
        "added": reply[: head + 100] + b"0" + reply[head + 100 :],
        "line end lost": reply[: head + 131] + reply[head + 132 :],
        "end lost": reply[:-1] + hokuyo_reply(values, 0, 1080),
    }
    for name, data in damages.items():
        dropped: Counter[str] = Counter()
        scan = HokuyoDecoder(UTM_30LX_EW, dropped).feed(data, 0)[0].message
        assert isinstance(scan, ScanMessage)
        good = ~np.isnan(scan.ranges)
        np.testing.assert_allclose(scan.ranges[good], values[good] / 1e3, rtol=1e-6, err_msg=name)
        # One block holds 21 to 22 values of 3 characters; two more straddle its ends.
        assert np.count_nonzero(~good) <= 23, name
        assert dropped["scan: blocks damaged"] == (0 if name == "end lost" else 1), name


# Garbage -------------------------------------------------------------------------------------------------------------

edits = st.lists(
    st.tuples(
        st.sampled_from(["change", "drop", "insert", "cut", "repeat"]), st.integers(0, 2**16), st.binary(max_size=20)
    ),
    max_size=25,
)


def mutate(data: bytes, changes: list[tuple[str, int, bytes]]) -> bytes:
    for kind, place, noise in changes:
        at = place % (len(data) + 1)
        match kind:
            case "change":
                data = data[:at] + noise + data[at + len(noise) :]
            case "drop":
                data = data[:at] + data[at + 1 + len(noise) :]
            case "insert":
                data = data[:at] + noise + data[at:]
            case "cut":
                data = data[at:]
            case "repeat":
                data = data[:at] + data[max(0, at - 300) : at] * 2 + data[at:]
    return data


@languages
@settings(max_examples=30)
@given(changes=edits, noise=st.binary(max_size=400), size=st.integers(20, 3000))
def test_after_mutated_and_random_bytes_the_next_good_frame_is_found(
    name: str, changes: list[tuple[str, int, bytes]], noise: bytes, size: int
) -> None:
    language = LANGUAGES[name]
    seconds = 0.45
    clean = [(m.message, m.device) for m in decode(language.decoder(Counter()), stream(name, seconds))]
    decoder = language.decoder(Counter())
    for data in (mutate(stream(name, 0.25), changes), noise):
        decode(decoder, data, size)
        assert held(decoder) < language.holds
    found = [(m.message, m.device) for m in decode(decoder, stream(name, seconds), size)]
    kept = len(clean) - language.loses
    assert kept > 0
    assert [_told(*m) for m in found[len(found) - kept :]] == [_told(*m) for m in clean[len(clean) - kept :]]


def _told(message: RangeMessage | ScanMessage, device: int | None) -> tuple:
    if isinstance(message, RangeMessage):
        return device, message.source, message.target, message.range
    return device, message.ranges.tobytes()


@languages
def test_endless_noise_is_neither_kept_nor_believed(name: str) -> None:
    rng = np.random.default_rng(1)
    dropped: Counter[str] = Counter()
    decoder = LANGUAGES[name].decoder(dropped)
    found = 0
    for _ in range(40):
        found += len(decode(decoder, rng.integers(0, 256, 5000, dtype=np.uint8).tobytes()))
        assert held(decoder) < LANGUAGES[name].holds
    # A one-byte sum passes one frame of noise in 256, if its header looks right: some, but never many.
    assert found <= 50
    assert all(count > 0 for count in dropped.values())


def test_the_fuzzer_finds_branches_and_keeps_what_takes_them() -> None:
    rng = np.random.default_rng(0)
    corpus, branches = fuzz_drivers.explore("makerfabs", 120, rng)
    assert branches > 20
    assert len(corpus) > len(fuzz_drivers.SEED_SECONDS)
    again, most, dropped = fuzz_drivers.endure("makerfabs", 120_000, corpus, rng)
    assert again == 2
    assert 0 < most < LANGUAGES["makerfabs"].holds
    assert dropped
