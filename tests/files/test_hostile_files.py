"""Files that lie about what they hold, or were made to fill the memory or never to end, are refused in a line."""

from __future__ import annotations

import json
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from uwbslam_jax.errors import LogError
from uwbslam_jax.files import ros_types
from uwbslam_jax.files.compression import DamagedError, believable, decompress
from uwbslam_jax.files.mcap_log import Recording
from uwbslam_jax.files.range_layouts import fields_of_type
from uwbslam_jax.files.range_messages import Options
from uwbslam_jax.files.scan_messages import foxglove_protobuf
from uwbslam_jax.files.schemas import Channel, Role, make_decoder
from uwbslam_jax.measurements import ScanMessage

T0 = 1_700_000_000_000_000_000
MIB = 1 << 20
SCAN_FIELDS = "".join(f"float32 {name}\n" for name in ("angle_min", "angle_increment", "time_increment"))
SCAN_TEXT = f"{SCAN_FIELDS}float32 range_min\nfloat32 range_max\nfloat32[] ranges\n"
BOMB = bytes(200 * MIB)
PACKERS: dict[str, Any] = {"zstd": zstandard.ZstdCompressor().compress, "lz4": lz4.frame.compress}


@pytest.fixture(scope="module", params=PACKERS)
def bomb(request: pytest.FixtureRequest) -> tuple[str, bytes]:
    """A compression, and few bytes that it unpacks to 200 MiB."""
    return request.param, PACKERS[request.param](BOMB)


def chunk(kind: str, stored: bytes, says: int) -> bytes:
    """An MCAP chunk record that says how much it unpacks to."""
    body = struct.pack("<QQQII", T0, T0 + 10**9, says, 0, len(kind)) + kind.encode()
    body += struct.pack("<Q", len(stored)) + stored
    return struct.pack("<BQ", 6, len(body)) + body


def with_chunk(path: Path, record: bytes) -> Path:
    """A recording of twenty scans, whose end is the record."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1000, compression=CompressionType.ZSTD)
        writer.start()
        number = writer.register_channel(
            "/scan",
            "cdr",
            writer.register_schema(
                "sensor_msgs/msg/LaserScan", "ros2msg", ros_types.definition("sensor_msgs/msg/LaserScan")
            ),
        )
        for k in range(20):
            at = T0 + k * 10**8
            scan = ScanMessage(at, -1.0, 0.02, 0.0, 0.1, 30.0, np.full(100, 3.0 + k, np.float32))
            writer.add_message(number, at, ros_types.encode(scan)[1], at)
        writer.flush()
        file.write(record)
    return path


@pytest.mark.parametrize(("says", "cut"), [(100, 0), (100, 7), (1 << 30, 0), (1 << 30, 7), ((1 << 64) - 1, 0)])
def test_a_chunk_unpacks_to_no_more_than_it_says(tmp_path: Path, bomb: tuple[str, bytes], says: int, cut: int) -> None:
    record = chunk(*bomb, says)
    path = with_chunk(tmp_path / "a.mcap", record[: len(record) - cut])
    tracemalloc.start()
    recording = Recording(path)
    found = list(recording)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(found) == 20
    assert recording.truncated is not None
    assert len(recording.truncated.splitlines()) == 1
    assert peak < 64 * MIB


def test_what_is_unpacked_ends_at_a_limit(bomb: tuple[str, bytes]) -> None:
    kind, stored = bomb
    assert decompress(stored, kind, 1000) == bytes(1000)
    whole = PACKERS[kind](b"0123456789" * 99)
    assert decompress(whole, kind, 2000) == b"0123456789" * 99
    with pytest.raises(DamagedError, match="does not decompress"):
        decompress(b"none of these", kind, 1000)
    assert decompress(b"plain", "", 100) == b"plain"
    with pytest.raises(DamagedError, match="compressed with 'brotli'"):
        decompress(stored, "brotli", 1000)
    assert believable(100 * MIB, 1000)
    assert not believable(1 << 30, 1 << 20)
    assert believable(1 << 30, 1 << 23)


def scan_channel(text: str, language: str = "ros2msg", encoding: str = "cdr") -> Channel:
    return Channel(1, "/scan", encoding, "sensor_msgs/msg/LaserScan", language, text.encode())


def idl(inside: str) -> str:
    return f"module sensor_msgs {{ module msg {{ {inside} }}; }};\n"


NOTHING = "=" * 80 + "\nMSG: a/B\n"
BIG_FIELDS = "".join(f"string field_{k}\n" for k in range(20_000))


@pytest.mark.parametrize(
    ("text", "language", "why"),
    [
        (idl(f"const long X = {'(' * 14}1{')' * 14};"), "ros2idl", "in parentheses"),
        (idl(f"struct LaserScan {{ @default (value={'(' * 9}1{')' * 9}) long x; }};"), "ros2idl", "in parentheses"),
        (idl("const long X = 1 << 9999999999999;"), "ros2idl", "shifted too far"),
        (idl("const long X = 1 << 99; const long Y = X << X;"), "ros2idl", "shifted too far"),
        (idl(" ".join(f"const long X{k} = 1;" for k in range(2000))), "ros2idl", "over 1000 constants"),
        (idl("typedef A B; typedef B A; struct LaserScan { A x; };"), "ros2idl", "nested without end"),
        (SCAN_TEXT + "string[1000000000] b\n", "ros2msg", "fields and elements"),
        (SCAN_TEXT + "a/B[1000000000] b\n" + NOTHING + "float32 x\n", "ros2msg", "fields and elements"),
        (SCAN_TEXT + "a/B[400] b\n" + NOTHING, "ros1msg", "list of nothing"),
        (SCAN_TEXT + "a/B[] b\n" + NOTHING + "a/C x\n" + "=" * 80 + "\nMSG: a/C\n", "ros1msg", "list of nothing"),
        (SCAN_TEXT + BIG_FIELDS, "ros2msg", "longer than"),
        (SCAN_TEXT + "".join(BIG_FIELDS.splitlines(keepends=True)[:1500]), "ros2msg", "fields and elements"),
        (SCAN_TEXT + "LaserScan again\n", "ros2msg", "nested without end"),
    ],
)
def test_a_definition_that_costs_too_much_is_refused(text: str, language: str, why: str) -> None:
    with pytest.raises(LogError, match=f"^topic /scan: unreadable definition of .*{why}") as error:
        make_decoder(scan_channel(text, language), "scan", Options())
    assert len(str(error.value).splitlines()) == 1


def test_what_generators_write_stays_readable() -> None:
    text = idl(
        'struct LaserScan { @verbatim (language="comment", text="(((1 << 5)))" "(more)") /* ((( */\n'
        + '@unit (value="rad") float angle_min; float angle_increment, time_increment, range_min, range_max;\n'
        + "sequence<float> ranges; sequence<sequence<float, 3>, 4> unused; };"
    ).replace("sequence<sequence<float, 3>, 4> unused; ", "")
    decode = make_decoder(scan_channel(text, "ros2idl"), "scan", Options())
    data = ros_types.CDR + struct.pack("<5fI3f", -1.0, 0.5, 0.0, 0.1, 30.0, 3, 1.0, 2.0, 3.0)
    (scan,) = decode(data, T0)
    assert isinstance(scan, ScanMessage)
    assert scan.ranges.tolist() == [1.0, 2.0, 3.0]
    fixed = scan_channel(SCAN_TEXT + "float32[1000000000] more\nstring[400] names\n")
    options = Options()
    assert make_decoder(fixed, "scan", options)(data, T0) == []
    assert options.dropped.total() == 1


def test_a_wide_and_deep_definition_is_looked_at_for_a_while() -> None:
    kind = type("Kind", (), {"name": "NAME"})
    wide = {f"t{d}": ((), [(f"f{k}", (kind, f"t{d + 1}")) for k in range(300)]) for d in range(9)}
    assert fields_of_type(wide, "t0") == {}


def pb_scan(stamp: bytes) -> bytes:
    def field(number: int, data: bytes) -> bytes:
        return bytes([number << 3 | 2, len(data)]) + data

    angles = b"".join(bytes([n << 3 | 1]) + struct.pack("<d", v) for n, v in ((4, -1.0), (5, 1.0)))
    return field(1, stamp) + angles + field(6, struct.pack("<3d", 1.0, 2.0, 3.0))


def test_numbers_of_protobuf_have_an_end() -> None:
    assert foxglove_protobuf(pb_scan(b"\x08" + b"\xff" * 9 + b"\x01")).timestamp.sec == 2**64 - 1
    with pytest.raises(ValueError, match="without end"):
        foxglove_protobuf(b"\x08" + b"\xff" * 2_000_000)


JSON_SCAN = {"timestamp": {"sec": 1, "nsec": 0}, "start_angle": -1.0, "end_angle": 1.0, "ranges": [1.0, 2.0, 3.0]}


@pytest.mark.parametrize(
    ("role", "message", "good"),
    [
        ("scan", JSON_SCAN, True),
        ("scan", JSON_SCAN | {"timestamp": {"sec": 10**30, "nsec": 0}}, False),
        ("scan", JSON_SCAN | {"timestamp": {"sec": 1e300, "nsec": 0}}, False),
        ("scan", JSON_SCAN | {"start_angle": 10**400}, False),
        ("uwb", {"header": {"stamp": {"sec": 1, "nsec": 0}}, "source": 1, "target": 2, "range": 2.0}, True),
        ("uwb", {"header": {"stamp": {"sec": 10**30, "nsec": 0}}, "source": 1, "target": 2, "range": 2.0}, False),
        ("uwb", {"id": 1, "role": 1, "nodes": [{"id": 1, "role": 2, "dis": 2.0}]}, True),
        ("uwb", {"id": 1, "role": 1, "nodes": [{"id": 1, "role": 10**30, "dis": 2.0}]}, False),
    ],
)
def test_numbers_that_nothing_holds_are_counted(role: Role, message: dict[str, Any], good: bool) -> None:
    options = Options()
    name = {"scan": "foxglove.LaserScan", "uwb": "UwbRange"}[role]
    decode = make_decoder(Channel(1, "/a", "json", name, "jsonschema", b"{}"), role, options)
    found = decode(json.dumps(message).encode(), T0)
    assert (len(found), options.dropped.total()) == ((1, 0) if good else (0, 1))


def test_a_message_nested_without_end_is_counted() -> None:
    options = Options()
    decode = make_decoder(Channel(1, "/a", "json", "UwbRange", "jsonschema", b"{}"), "uwb", options)
    assert decode(b'{"a":' * 100_000 + b"1" + b"}" * 100_000, T0) == []
    assert options.dropped.total() == 1
