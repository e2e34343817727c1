"""A run: nothing is traced again while beacons come and go, online and batch give the same bits."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import small_room as room
from room_drive import BEACONS, SETTINGS, Drive, assert_same_bits, pose_at

from uwbslam_jax.estimator import compiled, init
from uwbslam_jax.estimator.compiled import TRACES
from uwbslam_jax.result import EventKind
from uwbslam_jax.session.session import CONTROL_EVERY, Session
from uwbslam_jax.settings import FilterSettings, Settings, UwbSettings


@pytest.fixture(scope="module")
def decided() -> tuple[Session, Drive, dict[str, int]]:
    """A run that started on two beacons and has decided its frame; and what had been traced after the first looks."""
    run = Session(SETTINGS)
    drive = Drive(run)
    for frame in drive.frames(CONTROL_EVERY, (10, 20)):
        run.step(frame)
    run.steps(drive.frames(CONTROL_EVERY, (10, 20)))
    warm = dict(TRACES)
    while run.decided_at is None and drive.time < 20.0:
        for frame in drive.frames(CONTROL_EVERY, (10, 20)):
            run.step(frame)
    return run, drive, warm


def test_a_drive_around_a_room_is_decided_and_right(decided):
    run, drive, _ = decided
    assert run.status == "decided"
    assert run.hypotheses == 1
    # published frame: node 10 at the origin, node 20 on +x
    s = np.asarray(run.state.belief.mean[:6], float).reshape(3, 2)
    np.testing.assert_allclose(s[1], [0, 0], atol=0.05)
    np.testing.assert_allclose(s[2], [np.hypot(*(BEACONS[20] - BEACONS[10])), 0], atol=0.05)  # a range's noise
    axis = BEACONS[20] - BEACONS[10]
    turn = np.arctan2(axis[1], axis[0])
    R = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    want = R @ (pose_at(drive.time)[:2] - BEACONS[10])
    np.testing.assert_allclose(s[0], want, atol=0.15)  # a cell and a half
    estimate = run.step(drive.frames(1, (10, 20))[0])
    assert bool(estimate.active[1])
    while run.room() != CONTROL_EVERY:
        run.step(drive.frames(1, (10, 20))[0])


def test_nothing_is_traced_again_while_beacons_join_fall_silent_and_drop(decided):
    run, drive, warm = decided
    assert run.decided_at is not None
    while run.room() != CONTROL_EVERY:
        run.step(drive.frames(1, (10, 20))[0])
    for _ in range(12):  # a third one is heard: it joins
        run.steps(drive.frames(CONTROL_EVERY, (10, 20, 30)))
    slot = run.slots[30]
    assert run.beacon_status(slot) == "static"
    assert bool(run.state.active[slot])
    # it falls silent for more than a minute, the robot at rest: it is dropped
    drive.time = 20.0 * np.ceil(drive.time / 20.0)
    for _ in range(8):
        for frame in drive.frames(CONTROL_EVERY, (10, 20), dt=1.0, moving=False):
            run.step(frame)
    assert run.beacon_status(slot) == "dropped"
    assert not bool(run.state.active[slot])
    # a mask changed from outside, and the map's window moved
    run.state = run.state._replace(active=run.state.active.at[2].set(False))
    grid = run.tiles.recentre(run.state.grid, np.array([7.0, 0.0]))
    run.state = run.state._replace(grid=run.tiles.recentre(grid, np.zeros(2)))
    run.steps(drive.frames(CONTROL_EVERY, (10, 20), moving=False))
    for frame in drive.frames(CONTROL_EVERY, (10, 20, 30), moving=False):
        run.step(frame)
    assert warm["step"] >= 1
    assert dict(TRACES) == warm


def test_a_beacon_that_is_only_doubted_keeps_its_place_in_the_graph():
    run = Session(SETTINGS)
    drive = Drive(run)
    while run.decided_at is None and drive.time < 20.0:
        run.steps(drive.frames(CONTROL_EVERY, (10, 20, 30)))
    slot = run.slots[30]
    place = run.graph.ranges.node(slot)
    told = []
    while not told and drive.time < 30.0:  # a metre too long, but not from one other place: a wall, or its clock
        frames = drive.frames(CONTROL_EVERY, (10, 20, 30))
        for r in (frame.frame.ranges for frame in frames):
            r.range[(r.i == slot) | (r.j == slot)] += np.float32(1.0)
        run.steps(frames)
        told = [event for event in run.history.events if event.kind is EventKind.DOUBTED]
    run.steps(drive.frames(CONTROL_EVERY, (10, 20, 30)))
    assert [event.node for event in told] == [30]
    assert told[0].text == f"beacon 30 ranges do not fit ({told[0].detail} m): a clock, walls, or it was moved"
    assert run.graph.ranges.node(slot) == place
    means = run.graph.ranges.means.values
    assert set(means["place"][means["slot"] == slot].tolist()) == {place[1]}


@pytest.mark.parametrize("engine", ["jax", pytest.param("native", marks=pytest.mark.slow)])
def test_online_and_batch_give_the_same_bits(engine):
    settings = replace(SETTINGS, filter=replace(SETTINGS.filter, engine=engine))
    online, batch = Session(settings), Session(settings)
    assert online.engine == engine
    frames = Drive(online).frames(4 * CONTROL_EVERY, (10, 20, 30))
    one_by_one = [online.step(frame) for frame in frames]
    chunked = [e for k in range(4) for e in batch.steps(frames[CONTROL_EVERY * k : CONTROL_EVERY * (k + 1)])]
    for a, b in zip(one_by_one, chunked, strict=True):
        assert_same_bits(a, b)
    assert_same_bits(online.state, batch.state)
    np.testing.assert_array_equal(online.history.poses, batch.history.poses)
    assert online.history.events == batch.history.events
    assert online.status == batch.status


def test_compiled_steps_give_the_same_bits_with_beacons_in_the_state():
    """Every part of the step at work: ranges that count, matches, drawing, frames without a scan."""
    run = Session(SETTINGS)
    frames = Drive(run).frames(12, (10, 20, 30))
    frames[5] = replace(frames[5], frame=room.frame(run.config, 0.1, None, frames[5].frame.ranges))

    def start():
        state = init(run.config)
        first = pose_at(0.0)
        c, s = np.cos(first[2]), np.sin(first[2])
        seen = np.array([(b - first[:2]) @ np.array([[c, -s], [s, c]]) for b in BEACONS.values()])
        mean = state.belief.mean.at[2:8].set(jnp.asarray(seen.ravel(), jnp.float32))
        cov = state.belief.cov.at[jnp.arange(2, 8), jnp.arange(2, 8)].set(0.01)
        return state._replace(belief=state.belief._replace(mean=mean, cov=cov), active=jnp.ones(4, bool))

    state, estimates = start(), []
    for frame in frames:
        state, (estimate,) = compiled.step(run.config, run.params, state, [frame.frame])
        estimates.append(estimate)
    other, many = start(), []
    for few in (frames[:7], frames[7:]):
        other, told = compiled.step(run.config, run.params, other, [frame.frame for frame in few])
        many += told
    assert_same_bits(state, other)
    assert_same_bits(estimates, many)
    assert max(float(np.max(estimate.weight)) for estimate in many) > 0
    assert any(bool(estimate.drawn) for estimate in many)
    with pytest.raises(ValueError):
        compiled.step(run.config, run.params, start(), [frame.frame for frame in frames])


def test_fewer_frames_than_a_chunk_are_stepped_one_by_one():
    run, other = Session(SETTINGS), Session(SETTINGS)
    frames = Drive(run).frames(3, (10,))
    got = run.steps(frames)
    assert run.room() == CONTROL_EVERY - 3
    for a, b in zip(got, [other.step(f) for f in frames], strict=True):
        assert_same_bits(a, b)


def test_at_rest_the_status_says_that_it_waits_for_motion():
    run = Session(SETTINGS)
    for _ in range(3):
        run.steps(Drive(run).frames(CONTROL_EVERY, (10, 20, 30), moving=False))
    assert run.status == "waiting for motion"
    assert run.decided_at is None
    np.testing.assert_array_equal(run.state.active, [True, False, False, False])


def test_biases_and_heights_follow_the_ids_as_they_are_heard():
    settings = Settings(
        uwb=UwbSettings(max_beacons=3, bias={"20": 0.2}, height={"10": 1.5}),
        lidar=SETTINGS.lidar,
        map=SETTINGS.map,
    )
    run = Session(settings)
    drive = Drive(run)
    np.testing.assert_array_equal(run.params.bias, 0.0)
    run.step(drive.frames(1, (20,))[0])
    np.testing.assert_allclose(run.params.bias, [0, 0.2, 0, 0])
    run.step(drive.frames(1, (20, 10))[0])
    np.testing.assert_allclose(run.params.height, [0, 0, 1.5, 0])
    assert run.slots == {0: 0, 20: 1, 10: 2}


def test_lidar_only_needs_no_beacon():
    settings = Settings(
        uwb=SETTINGS.uwb, lidar=SETTINGS.lidar, map=SETTINGS.map, filter=FilterSettings(lidar_only=True)
    )
    run = Session(settings)
    drive = Drive(run)
    for _ in range(4):
        last = run.steps(drive.frames(CONTROL_EVERY, (10, 20, 30)))[-1]
    assert run.status == "LiDAR only"
    first = pose_at(0.0)
    c, s = np.cos(first[2]), np.sin(first[2])
    want = (pose_at(drive.time)[:2] - first[:2]) @ np.array([[c, -s], [s, c]])
    np.testing.assert_allclose(last.pose[:2], want, atol=0.1)  # a cell


def test_the_map_is_drawn_where_it_is():
    """A step that draws copies no level of the map: its buffers are those that were handed in."""
    run = Session(SETTINGS)
    frames = Drive(run).frames(4, (10,))
    run.step(frames[0])
    before = [level.unsafe_buffer_pointer() for level in run.state.grid.levels]
    assert all(bool(run.step(frame).drawn) for frame in frames[1:])
    assert [level.unsafe_buffer_pointer() for level in run.state.grid.levels] == before
