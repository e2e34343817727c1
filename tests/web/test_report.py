"""The report: whole, offline, honest about what was not found, and safe against what the data says."""

from __future__ import annotations

import base64
import json
import re
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_result import START, empty_result, make_result

from uwbslam_jax.result import BeaconEstimate, BeaconStatus, Event, EventKind, MapImage, Result
from uwbslam_jax.web.report import write_report

MEGABYTE = 1 << 20


def page_of(tmp_path: Path, result: Result, **options: Any) -> str:
    path = tmp_path / "report.html"
    write_report(result, path, **options)
    return path.read_text(encoding="utf-8")


def data_of(page: str) -> dict[str, Any]:
    """The embedded JSON; NaN and Infinity, which are no JSON, are refused."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found
    return json.loads(found[1], parse_constant=refuse)


def png_pixels(uri: str) -> np.ndarray:
    """Decoder of the only kind of PNG that the report writes: (rows, cols, 2) grey and alpha, every checksum held."""
    raw = base64.b64decode(uri.removeprefix("data:image/png;base64,"))
    assert raw[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, at = {}, 8
    while at < len(raw):
        (length,) = struct.unpack(">I", raw[at : at + 4])
        kind, body = raw[at + 4 : at + 8], raw[at + 8 : at + 8 + length]
        assert struct.unpack(">I", raw[at + 8 + length : at + 12 + length])[0] == zlib.crc32(kind + body)
        chunks[kind] = body
        at += 12 + length
    cols, rows = struct.unpack(">II", chunks[b"IHDR"][:8])
    lines = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(rows, 1 + 2 * cols)
    return lines[:, 1:].reshape(rows, cols, 2)


def test_page_refers_to_nothing_outside_itself(tmp_path: Path) -> None:
    page = page_of(tmp_path, make_result(), metrics={"robot_rmse_m": 0.01}, title="A run")
    assert "http://" not in page
    assert "https://" not in page
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)|@import|url\(|import\s*\(|fetch\(|//cdn""", page)
    assert "default-src 'none'" in page
    assert "{{" not in page


def test_figures_of_the_run_are_on_the_page(tmp_path: Path) -> None:
    metrics = {"robot_rmse_m": 0.0123, "heading_deg_median": 0.456, "beacon_mean_m": 0.0067, "beacons_missing": [9]}
    page = page_of(tmp_path, make_result(), metrics=metrics, title="Hall 7")
    for text in ("Hall 7", "19.9 s", "2.35", "3.46", "43.2", "137", "sigma_n = 0.125", "2023-11-14 22:13:20"):
        assert text in page
    for text in ("0.012", "3.457", "0.0042", "0.0051", "4294967295", "silent"):  # beacons
        assert text in page
    for text in ("0.012", "0.46", "0.007", "Not placed although the truth has them: beacons 9."):  # errors
        assert text in page
    for text in ("waiting for motion", "frame decided", "3.21"):  # events
        assert text in page


def test_data_holds_the_track_the_map_and_the_series(tmp_path: Path) -> None:
    result = make_result()
    data = data_of(page_of(tmp_path, result))
    assert data["duration"] == pytest.approx(19.9)
    half_millimetre = 5.01e-4  # positions are rounded to one
    np.testing.assert_allclose(data["track"]["x"], result.poses[:, 0], atol=half_millimetre)
    np.testing.assert_allclose(data["track"]["yaw"], result.poses[:, 2], atol=half_millimetre)
    assert [series["name"] for series in data["diagnostics"]] == ["Match score", "Hypotheses"]
    assert data["beacons"][0]["track"]["t"] == [1, 9]
    assert len(data["residuals"]["t"]) == 400
    assert data["map"]["origin"] == pytest.approx([0.0, 0.0])
    assert (data["map"]["rows"], data["map"]["cols"], data["map"]["cell"]) == (60, 80, 0.05)
    pixels = png_pixels(data["map"]["png"])
    assert pixels.shape == (60, 80, 2)
    assert (pixels[[0, -1], :, 0] < 20).all()  # walls are dark
    assert (pixels[1:-1, :, 0] > 220).all()  # free is bright
    assert (pixels[..., 1] == 255).all()


def test_the_map_is_upright_and_unknown_is_transparent(tmp_path: Path) -> None:
    log_odds = np.zeros((3, 2), np.float32)
    log_odds[0, 0], log_odds[2, 1] = 4.0, -4.0  # wall at the smallest y, free at the greatest
    data = data_of(page_of(tmp_path, make_result(map=MapImage(log_odds, 0.1, np.zeros(2)))))
    pixels = png_pixels(data["map"]["png"])
    assert pixels[2, 0, 0] < 20
    assert pixels[0, 1, 0] > 235
    np.testing.assert_array_equal(pixels[..., 1], [[0, 255], [0, 0], [255, 0]])


def test_hostile_text_stays_text(tmp_path: Path) -> None:
    attack = "</script><script>alert(1)</script><img src=x onerror='alert(2)'>{{data}}\"&"
    beacon = BeaconEstimate(1, np.zeros(2), np.eye(2), BeaconStatus.STATIC)
    object.__setattr__(beacon, "status", attack)  # past its type: the page trusts no text
    result = make_result(
        events=[Event(START, EventKind.STATUS, detail=attack)],
        beacons=[beacon],
        diagnostics={attack: np.ones(200)},
        summary={attack: attack, "dropped": {attack: 1}, "config": attack, "warnings": [attack], "truncated": attack},
    )
    page = page_of(tmp_path, result, metrics={attack: attack}, title=attack)
    assert "<script>alert" not in page
    assert "<img" not in page
    assert page.count("</script>") == 2
    data = data_of(page)
    assert data["beacons"][0]["status"] == attack
    assert data["diagnostics"][0]["name"] == attack.capitalize()


def test_nan_and_infinity_do_not_break_the_data(tmp_path: Path) -> None:
    result = make_result()
    poses, residuals = result.poses.copy(), result.range_residuals.copy()
    poses[:50] = np.nan
    residuals[3, 3] = np.inf
    log_odds = result.map.log_odds.copy()
    log_odds[20, 20] = np.nan
    page = page_of(
        tmp_path,
        make_result(
            poses=poses,
            range_residuals=residuals,
            map=MapImage(log_odds, 0.05, np.zeros(2)),
            online_covs=np.full((200, 3, 3), np.nan),
            beacons=[BeaconEstimate(1, np.full(2, np.nan), np.full((2, 2), np.inf), BeaconStatus.STATIC)],
            diagnostics={"match_score": np.where(np.arange(200) % 2, np.nan, 0.5), "odd": np.full(200, np.nan)},
            summary={"real_time_factor": float("nan"), "wall_s": float("inf")},
        ),
        metrics={"robot_rmse_m": float("nan")},
    )
    data = data_of(page)
    assert data["track"]["x"][:50] == [None] * 50
    assert data["track"]["x"][50] is not None
    assert len(data["diagnostics"]) == 1
    assert len(data["residuals"]["t"]) == 399
    assert not re.search(r">\s*(nan|inf)\b", page)


def test_an_undecided_run_says_so(tmp_path: Path) -> None:
    page = page_of(tmp_path, empty_result())
    assert "The frame was not decided" in page
    assert "No beacon was placed" in page
    assert "No range was used" in page
    assert ">not decided<" in page
    data = data_of(page)
    assert data["map"] is None
    told = page_of(tmp_path, make_result(summary={"decided_at": None}))
    assert "The frame was not decided" in told
    assert "The frame was not decided" not in page_of(tmp_path, make_result())


def test_a_run_without_a_single_frame(tmp_path: Path) -> None:
    nothing = empty_result(
        stamps=np.zeros(0, np.int64), poses=np.zeros((0, 3)), online_covs=np.zeros((0, 3, 3)), frames=0
    )
    page = page_of(tmp_path, nothing)
    assert "No scan was processed" in page
    assert data_of(page)["track"]["t"] == []


def test_warnings_stand_first(tmp_path: Path) -> None:
    summary = {
        "warnings": ["two radios share id 3"],
        "truncated": "broken after 12.5 s",
        "decided_at": 1.0,
    }
    slow = {"step_ms": np.where(np.arange(200) % 10, 20.0, 1500.0)}  # one of ten takes long: 168 ms in the mean
    page = page_of(tmp_path, make_result(summary=summary, diagnostics=slow))
    top = page[: page.index("<main>")]
    for text in ("two radios share id 3", "broken after 12.5 s", "Slower than real time", "4294967295 silent"):
        assert text in top
    fast = {"step_ms": np.where(np.arange(200) % 10, 20.0, 800.0)}
    assert "Slower than real time" not in page_of(tmp_path, make_result(diagnostics=fast))


def test_a_long_run_of_many_nodes_stays_small(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    frames, beacons = 20_000, 50
    pairs = rng.integers(0, beacons + 1, (200_000, 2))
    pairs[:, 1] = (pairs[:, 0] + 1 + pairs[:, 1] % beacons) % (beacons + 1)
    path = np.column_stack([np.linspace(0, 150, 150), rng.normal(size=(150, 3))])
    score = np.full(frames, 0.9)
    score[12_345] = 0.1
    result = make_result(
        frames,
        beacons=[
            BeaconEstimate(k, rng.normal(size=2), np.eye(2) * 1e-4, BeaconStatus.STATIC) for k in range(1, beacons + 1)
        ],
        beacon_tracks=dict.fromkeys(range(1, beacons + 1), path),
        map=MapImage(rng.choice([-1.0, 0.0, 2.0], (4000, 3000)).astype(np.float32), 0.05, np.zeros(2)),
        range_residuals=np.column_stack([np.linspace(0, 150, 200_000), pairs, rng.normal(0, 0.1, 200_000)]),
        diagnostics={name: rng.normal(size=frames) for name in "abcdefgh"} | {"match_score": score},
    )
    page = page_of(tmp_path, result)
    assert len(page) < 6 * MEGABYTE
    data = data_of(page)
    assert max(data["map"]["rows"], data["map"]["cols"]) <= 2000
    assert data["map"]["cell"] * data["map"]["rows"] == pytest.approx(200.0)
    assert min(data["diagnostics"][0]["v"]) == 0.1  # thinning keeps peaks
    assert "The 60 pairs with the largest RMS of 1275" in page


def test_a_file_that_cannot_be_written_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No such file"):
        write_report(make_result(), tmp_path / "none" / "report.html")
