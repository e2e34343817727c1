"""Device clocks to host time, against clocks whose offset, drift and delays are known."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given, strategies as st

from uwbslam_drivers.clock import DeviceClock, _slope, host_time

MS = 1_000_000
S = 1_000_000_000
START = 1_800_000_000 * S
"""Host time at which each of these stories begins [ns]."""


def story(
    seconds: float, *, rate: float = 40.0, drift: float = 0.0, offset: int = 5 * S, delay: float = 1.0, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True host time, device time and arrival [ns] of measurements; delays are exponential with a mean [ms]."""
    rng = np.random.default_rng(seed)
    true = START + np.round(np.arange(int(seconds * rate)) / rate * S).astype(np.int64)
    device = offset + np.round((true - START) * (1.0 + drift)).astype(np.int64)
    return true, device, true + np.round(rng.exponential(delay * MS, true.size)).astype(np.int64)


def errors(clock: DeviceClock, true: np.ndarray, device: np.ndarray, received: np.ndarray) -> np.ndarray:
    """How far stamps are off [ms]; NaN where there is none."""
    stamps = [clock.host_stamp(int(d), int(r)) for d, r in zip(device, received, strict=True)]
    return np.array([np.nan if s is None else (s - t) / MS for s, t in zip(stamps, true, strict=True)])


@pytest.mark.parametrize("drift", [0.0, 80e-6, -300e-6])
def test_offset_and_drift_are_found_below_the_delays(drift: float) -> None:
    clock = DeviceClock()
    late = errors(clock, *story(300.0, drift=drift, delay=3.0))
    # Delays of 3 ms and more shift single arrivals; the least of 40 a second is within some tenths.
    assert np.abs(late[40 * 20 :]).max() < 1.0
    assert clock.drift == pytest.approx(-drift, abs=10e-6)
    assert clock.restarts == 0


def test_a_stretch_of_long_delays_does_not_move_the_clock() -> None:
    true, device, received = story(120.0)
    busy = (np.arange(true.size) > 2400) & (np.arange(true.size) < 3400)
    late = errors(DeviceClock(), true, device, received + busy * 150 * MS)
    assert np.abs(late[400:]).max() < 1.0


@pytest.mark.parametrize("bits", [24, 32])
def test_the_device_clock_wraps(bits: int) -> None:
    wrap = (1 << bits) * MS
    true, device, received = story(60.0, offset=wrap - 30 * S, drift=50e-6)
    clock = DeviceClock(wrap)
    late = errors(clock, true, device % wrap, received)
    assert (device >= wrap).any()
    assert np.abs(late[400:]).max() < 1.0
    assert clock.restarts == 0


def test_a_silence_longer_than_the_wrap_is_no_restart() -> None:
    wrap = (1 << 24) * MS
    true, device, received = story(30.0)
    clock = DeviceClock(wrap)
    errors(clock, true, device % wrap, received)
    later = 3 * wrap + 77 * S
    late = errors(clock, true + later, (device + later) % wrap, received + later)
    assert np.abs(late).max() < 2.0
    assert clock.restarts == 0


def test_a_damaged_time_is_refused_and_forgotten() -> None:
    true, device, received = story(30.0)
    wrong = device.copy()
    wrong[[700, 900]] += [4000 * S, -2 * S]
    clock = DeviceClock()
    late = errors(clock, true, wrong, received)
    # 2 s too early is a delay that a busy host could have: it is stamped, and moves nothing.
    assert np.isnan(late[700])
    assert np.abs(np.delete(late, [700, 900])[400:]).max() < 1.0
    assert clock.restarts == 0


@pytest.mark.parametrize("by", [10, 60, 190])
def test_a_time_that_was_damaged_a_little_does_not_move_the_clock(by: int) -> None:
    """Short sums let one damaged time in 64 through; taken for the least delay it would shift two minutes of stamps."""
    true, device, received = story(60.0)
    wrong = device.copy()
    wrong[[500, 900, 1300]] += by * MS
    late = errors(DeviceClock(), true, wrong, received)
    assert late[400:].max() < 100.0  # the damaged ones are stamped with their arrival
    assert (late[[500, 900, 1300]] >= 0.0).all()
    assert np.abs(np.delete(late, [500, 900, 1300])[400:]).max() < 1.0


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_stamped_later_than_it_came(seed: int) -> None:
    """Not even where delays end and come back, and what ends them is not equally early."""
    true, device, received = story(60.0, delay=4.0, seed=seed)
    held = (np.arange(true.size) // 200) % 2 == 0
    late = received + held * 30 * MS
    clock = DeviceClock()
    stamps = [clock.host_stamp(int(d), int(r)) for d, r in zip(device, late, strict=True)]
    assert all(stamp is not None and stamp <= r for stamp, r in zip(stamps, late.tolist(), strict=True))


def test_a_delay_that_ends_is_followed() -> None:
    true, device, received = story(60.0, delay=0.1)
    held = np.arange(true.size) < 800
    late = errors(DeviceClock(), true, device, received + held * 50 * MS)
    assert not np.isnan(late).any()
    assert np.abs(late[1700:]).max() < 1.0  # by then the window no longer takes the end of the delay for a slope


@pytest.mark.parametrize("shows", [0, 9999 * S])
def test_a_restarted_device_is_followed_after_a_few_measurements(shows: int) -> None:
    true, device, received = story(60.0, offset=500 * S)
    off = true >= START + 30 * S
    device = np.where(off, device - 530 * S + shows, device)
    clock = DeviceClock()
    late = errors(clock, true, device, received)
    assert np.isnan(late).sum() == 3
    assert clock.restarts == 1
    assert np.abs(late[1200 + 80 :]).max() < 1.0


def test_a_reference_takes_out_the_least_delay() -> None:
    true, device, received = story(60.0, delay=0.5, drift=20e-6)
    scan_time = 25 * MS  # nothing arrives before the scan is done
    reference = (int(device[0]) - 3 * S, int(true[0]) - 3 * S)
    late = errors(DeviceClock(reference=reference), true, device, received + scan_time)
    assert np.abs(late).max() < 1.0
    without = errors(DeviceClock(), true, device, received + scan_time)
    assert np.median(without) > 24.0
    told = errors(DeviceClock(least_delay=scan_time), true, device, received + scan_time)
    assert np.abs(told[400:]).max() < 1.0


def test_measurements_may_come_out_of_order() -> None:
    true, device, received = story(60.0)
    order = np.arange(true.size).reshape(-1, 4)[:, ::-1].ravel()
    late = errors(DeviceClock(), true[order], device[order], np.maximum.accumulate(received[order]))
    # Four arrive together with the last of them, up to 75 ms late; the last is not.
    assert np.abs(late[400:]).max() < 1.0


@given(
    st.lists(st.tuples(st.integers(0, 10_000), st.floats(-1.0, 1.0)), min_size=2, max_size=40, unique_by=lambda p: p[0])
)
def test_the_slope_is_that_of_the_best_line_below_all_points(points: list[tuple[int, float]]) -> None:
    ordered = sorted((float(x), y) for x, y in points)
    x, y = np.array(ordered).T
    slope = _slope(ordered)
    offset = np.min(y - slope * x)
    cost = np.sum(y - slope * x - offset)
    # Any line below all points through two of them; the best one is among those.
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = ((y[:, None] - y) / (x[:, None] - x))[~np.eye(x.size, dtype=bool)]
    offsets = np.min(y - slopes[:, None] * x, axis=1)
    costs = np.sum(y - slopes[:, None] * x - offsets[:, None], axis=1)
    assert cost <= costs.min() + 1e-6 * (1.0 + abs(costs.min()))


@given(st.lists(st.tuples(st.integers(0, 2**40), st.integers(0, 2**40)), max_size=60), st.sampled_from([None, 2**32]))
def test_any_times_are_survived(times: list[tuple[int, int]], wrap: int | None) -> None:
    clock = DeviceClock(wrap)
    for device, received in times:
        stamp = clock.host_stamp(device, received)
        assert stamp is None or abs(stamp - received) < 20 * S


def test_host_time_is_now_and_never_steps_back() -> None:

    times = [host_time() for _ in range(1000)]
    assert times == sorted(times)
    assert abs(times[-1] - time.time_ns()) < 10 * S
