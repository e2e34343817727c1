"""Settings: TOML in and out, and errors that say in one line what is wrong."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from uwbslam_jax import settings
from uwbslam_jax.errors import ConfigError
from uwbslam_jax.files import settings_file
from uwbslam_jax.settings import Found, MapSettings, Settings, make_host_params, make_params

positive = st.floats(1e-6, 1e6)
finite = st.floats(-1e6, 1e6)
by_node = st.dictionaries(st.integers(0, 2**32 - 1).map(str), finite, max_size=4)
# letters, numbers, punctuation and symbols: all printable, none blank
topic = st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "S")), min_size=1, max_size=12)
layout = st.one_of(
    st.just(settings.RangeLayout()),
    st.builds(settings.RangeLayout, type=st.just("A"), target=topic, range=st.just("d"), unit=st.just("mm")),
)

settings_strategy = st.builds(
    Settings,
    robot=st.builds(settings.RobotSettings, st.integers(0, 2**32 - 1), st.tuples(finite, finite, finite)),
    uwb=st.builds(
        settings.UwbSettings,
        topic,
        sigma_n=positive,
        nlos_gap_db=st.one_of(positive, st.just(float("inf"))),
        max_beacons=st.integers(1, 200),
        height=by_node,
        bias=by_node,
        unit=st.sampled_from(["auto", "m", "cm", "mm"]),
        message=layout,
    ),
    lidar=st.builds(settings.LidarSettings, topic, st.floats(0, 1), st.floats(1.1, 100), st.integers(1, 5000)),
    odom=st.builds(settings.OdomSettings, topic, st.booleans(), positive, positive, st.tuples(positive, positive)),
    map=st.builds(settings.MapSettings, st.floats(0.04, 0.2), st.integers(1, 5), st.floats(50, 100)),
    filter=st.builds(settings.FilterSettings, st.sampled_from(["robust", "paper"]), sigma_w=positive, gamma=positive),
)


@given(settings_strategy)
def test_dump_reads_back_to_the_same_settings(settings: Settings) -> None:
    assert settings_file.from_dict(tomllib.loads(settings_file.dump(settings))) == settings


def test_defaults_are_valid_and_round_trip_through_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text(settings_file.dump(Settings()), encoding="utf-8")
    assert settings_file.load_settings(path) == settings_file.check(Settings()) == settings_file.from_dict({})


def test_the_design_example_loads(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text(
        "[robot]\nid = 0\nantenna = [0.16, 0, 1.12]\nlidar = [0.095, 0.0, 0.0]\n[uwb]\nsigma_n = 1\n"
        'height = {"1" = 1.94}\nbias = {"1" = 0.12}\n'
    )
    settings = settings_file.load_settings(str(path))
    assert settings.robot.antenna == (0.16, 0.0, 1.12)
    assert settings.uwb.sigma_n == 1.0
    assert type(settings.uwb.sigma_n) is float
    assert settings.uwb.height == {"1": 1.94}
    assert settings.map == MapSettings()


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"uwb": {"sigma_m": 0.1}}, "unknown key uwb.sigma_m, did you mean uwb.sigma_n?"),
        ({"uwb": {"sigma_w": 0.1}}, "unknown key uwb.sigma_w, did you mean filter.sigma_w?"),
        ({"lidr": {"topic": "/scan"}}, "unknown key lidr, did you mean lidar?"),
        ({"gamma": 1.0}, "unknown key gamma, did you mean filter.gamma?"),
        ({"uwb": 3}, "uwb is a section: write [uwb] with keys below it"),
        ({"uwb": {"sigma_n": "0.1"}}, "uwb.sigma_n = '0.1': must be a number"),
        ({"uwb": {"sigma_n": True}}, "uwb.sigma_n = True: must be a number"),
        ({"uwb": {"max_beacons": 8.0}}, "uwb.max_beacons = 8.0: must be an integer"),
        ({"odom": {"use": 1}}, "odom.use = 1: must be true or false"),
        ({"robot": {"antenna": [1, 2]}}, "robot.antenna = [1, 2]: must be a list of 3 numbers"),
        ({"uwb": {"unit": "km"}}, "uwb.unit = 'km': must be 'auto' or 'm' or 'cm' or 'mm' or 'ft' or 'in'"),
        ({"uwb": {"message": 1}}, "uwb.message = 1: must be a section with keys below it"),
        ({"uwb": {"message": {"ranges": "d"}}}, "unknown key uwb.message.ranges, did you mean uwb.message.range?"),
        (
            {"uwb": {"message": {"type": "A"}}},
            "uwb.message: needs type, the name of the message's type, and range, the path of the range",
        ),
        ({"uwb": {"bias": [1]}}, 'uwb.bias = [1]: must be a table of numbers by node id, as {"1" = 0.5}'),
        ({"filter": {"preset": "fast"}}, "filter.preset = 'fast': must be 'robust' or 'paper'"),
        ({"uwb": {"bias": {"x": 1.0}}}, 'uwb.bias has the key "x": must be a node id, an unsigned 32-bit integer'),
        ({"uwb": {"topic": ""}}, "uwb.topic = '': must be a topic name without blanks"),
        ({"uwb": {"sigma_n": 0.0}}, "uwb.sigma_n = 0.0: must be greater than 0"),
        ({"uwb": {"sigma_n": float("nan")}}, "uwb.sigma_n = nan: must be a finite number"),
        ({"uwb": {"max_beacons": 0}}, "uwb.max_beacons = 0: must be from 1 to 200"),
        ({"map": {"levels": 6}}, "map.levels = 6: must be from 1 to 5"),
        ({"map": {"resolution": -0.1}}, "map.resolution = -0.1: must be greater than 0"),
        ({"map": {"size_m": 0.5}}, "map.size_m = 0.5: makes 10 cells a side, must be from 32 to 4096"),
        ({"filter": {"gamma": -1.0}}, "filter.gamma = -1.0: must not be negative"),
        ({"filter": {"independent_beams": 0.0}}, "filter.independent_beams = 0.0: must be greater than 0"),
        ({"lidar": {"min_range": 40.0}}, "lidar.min_range = 40.0: must be below lidar.max_range = 30.0"),
        (
            {"filter": {"lidar_only": True, "scan_matching": False}},
            "filter.lidar_only = true: needs filter.scan_matching = true, nothing else would be left",
        ),
    ],
)
def test_errors_say_what_is_wrong_in_one_line(table: dict, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        settings_file.from_dict(table)
    assert str(error.value) == message


def test_every_unknown_key_names_a_known_one() -> None:
    for section in dataclasses.fields(Settings):
        with pytest.raises(ConfigError, match=rf"did you mean {section.name}\.\w+\?"):
            settings_file.from_dict({section.name: {"zzzzzz": 1}})


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"[uwb\n", "a.toml: Expected"), (b"[uwb]\ntopic = '\xff'\n", "a.toml: 'utf-8'"), (None, "No such file")],
)
def test_an_unreadable_file_is_a_config_error_that_names_it(
    tmp_path: Path, content: bytes | None, message: str
) -> None:
    path = tmp_path / "a.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=message) as error:
        settings_file.load_settings(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_what_a_run_has_found_comes_on_top_of_what_is_configured():
    settings = settings_file.from_dict({"uwb": {"bias": {"7": 0.1}, "bias_scale": 0.02, "height": {"7": 1.5}}})
    slots, found = {0: 0, 7: 1, 9: 2}, Found({0: 0.2, 1: 0.1}, {2: 0.8}, 0.05)
    host = make_host_params(settings, make_params(settings, slots), slots)
    assert host.surveyed[:3].tolist() == [True, True, False]
    beyond, made = host.beyond(found), make_host_params(settings, make_params(settings, slots, found), slots)
    for name in ("bias", "height", "bias_scale"):
        np.testing.assert_allclose(getattr(beyond, name), getattr(made, name), rtol=1e-6)
    measured = (1 + beyond.bias_scale) * 5.0 + beyond.bias[0] + beyond.bias[1]
    assert beyond.slant(measured, 0, 1) == pytest.approx(5.0)
    # as the problem has it: the configured model first, what was found after it
    assert host.slant(measured, 0, 1) == pytest.approx(1.05 * 5.0 + 0.3)
