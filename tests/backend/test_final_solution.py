"""A run looks back: corrected while it goes on, solved when it ends; the same bits online and in batch."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import small_room as room
from room_drive import BEACONS, SETTINGS, Drive, assert_same_bits, pose_at

from uwbslam_jax.backend import final_solution
from uwbslam_jax.backend.final_solution import Question, _track
from uwbslam_jax.backend.graph import KEYFRAME, Graph
from uwbslam_jax.backend.revision import Reviser
from uwbslam_jax.evaluation import rigid_fit
from uwbslam_jax.numerics import SingularError
from uwbslam_jax.numerics.se2_host import wrapped
from uwbslam_jax.result import EventKind
from uwbslam_jax.session.result_builder import Facts, to_result
from uwbslam_jax.session.session import CONTROL_EVERY, Session
from uwbslam_jax.settings import FilterSettings, Found, UwbSettings

NODES = (10, 20, 30)
BIAS = {10: 0.6, 20: -0.5, 30: 0.5}
"""Antenna delays that nobody configured [m]."""
LOOKS = 50
"""Two and a half rounds of the room."""


def driven(settings=SETTINGS, bias=None, online: bool = False, late: float = 0.0) -> tuple[Session, np.ndarray]:
    """A finished run, and where the robot truly was at each frame (T, 3)."""
    run = Session(settings)
    drive = Drive(run)
    begin = drive.time
    frames = drive.frames(LOOKS * CONTROL_EVERY, NODES)
    for frame in frames:
        r = frame.frame.ranges
        r.age[r.valid] += np.float32(late)
        for node, by in (bias or {}).items():
            r.range[(r.i == frame.slots[node]) | (r.j == frame.slots[node])] += np.float32(by)
    for k in range(LOOKS):
        group = frames[CONTROL_EVERY * k : CONTROL_EVERY * (k + 1)]
        if online:
            for frame in group:
                run.step(frame)
        else:
            run.steps(group)
    run.finish()
    times = begin + 0.1 * np.arange(1, len(frames) + 1)
    return run, np.array([pose_at(t) for t in times])


def off(run: Session, track: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors of a track (T,) and of the beacons (B,) after one rigid motion over both [m]."""
    assert run.hindsight is not None
    solution = run.hindsight.solution
    spots = np.array([BEACONS[run.ids[slot]] for slot, _ in solution.nodes])
    a, b = np.concatenate([track[:, :2], solution.beacons]), np.concatenate([truth[:, :2], spots])
    errors = np.linalg.norm(rigid_fit(a, b).points(a) - b, axis=1)
    return errors[: len(track)], errors[len(track) :]


@pytest.fixture(scope="module")
def finished() -> tuple[Session, np.ndarray]:
    return driven()


@pytest.fixture(scope="module")
def biased() -> tuple[Session, np.ndarray]:
    return driven(bias=BIAS)


def test_a_finished_run_is_better_than_what_was_published(finished) -> None:
    run, truth = finished
    assert run.hindsight is not None
    robot, beacons = off(run, run.hindsight.track, truth)
    published, _ = off(run, np.array(run.history.poses), truth)
    rms = np.sqrt(np.mean(robot**2))
    assert rms < 0.02  # scans of 60 beams, their walls known to some centimetres
    assert rms < np.sqrt(np.mean(published**2))
    assert beacons.max() < 0.03
    assert run.found == Found()


def test_it_is_in_the_published_frame(finished) -> None:
    run, _ = finished
    solution = run.hindsight.solution
    places = dict(zip(solution.nodes, solution.beacons, strict=True))
    np.testing.assert_allclose(places[run.slots[10], 0], 0.0, atol=1e-9)
    frame_slots = np.asarray(run.state.frame_slots)
    assert places[int(frame_slots[1]), 0][1] == pytest.approx(0.0, abs=1e-9)
    assert places[int(frame_slots[1]), 0][0] > 0


def test_the_map_is_drawn_where_the_run_says(finished) -> None:
    """Occupied cells lie on the walls, once the run is laid over the truth."""
    run, truth = finished
    image = run.tiles.image(run.state.grid)
    row, col = np.nonzero(image.log_odds > 1.0)
    cells = image.origin + (np.stack([col, row], -1) + 0.5) * image.resolution
    solution = run.hindsight.solution
    spots = np.array([BEACONS[node] for node, slot in run.slots.items() if slot > 0])
    at = [dict(zip(solution.nodes, solution.beacons, strict=True))[slot, 0] for slot in run.slots.values() if slot > 0]
    a = np.concatenate([run.hindsight.track[:, :2], at])
    moved = rigid_fit(a, np.concatenate([truth[:, :2], spots])).points(cells)
    start, along = room.WALLS[:, 0], room.WALLS[:, 1] - room.WALLS[:, 0]
    share = np.clip(np.sum((moved[:, None] - start) * along, -1) / np.sum(along**2, -1), 0, 1)
    distance = np.linalg.norm(moved[:, None] - start - share[..., None] * along, axis=-1).min(axis=1)
    assert len(cells) > 100
    assert np.mean(distance < 0.1) > 0.95  # a cell


def test_biases_are_found_on_the_way_and_mend_the_state(biased) -> None:
    run, truth = biased
    assert EventKind.CORRECTED in [event.kind for event in run.history.events]
    robot, _ = off(run, run.hindsight.track, truth)
    assert np.sqrt(np.mean(robot**2)) < 0.02
    for node, bias in BIAS.items():
        assert run.found.bias[0] + run.found.bias[run.slots[node]] == pytest.approx(bias, abs=0.15)
    # the state itself has them, not only the files
    last = np.array(run.history.poses)[-50:]
    late, _ = off(run, last, truth[-50:])
    assert late.max() < 0.1  # a cell


def test_biases_that_are_found_leave_the_beacons_where_they_are(biased) -> None:
    run, truth = biased
    _, beacons = off(run, run.hindsight.track, truth)
    # the worst of three in a room of 0.1 m cells; the scenario `biased` has five halls, 0.02 m on the mean
    assert beacons.max() < 0.12


def test_online_and_batch_look_back_to_the_same_bits(biased) -> None:
    batch, _ = biased
    online, _ = driven(bias=BIAS, online=True)
    assert online.history.events == batch.history.events
    np.testing.assert_array_equal(online.history.poses, batch.history.poses)
    np.testing.assert_array_equal(online.hindsight.track, batch.hindsight.track)
    np.testing.assert_array_equal(online.hindsight.solution.beacons, batch.hindsight.solution.beacons)
    assert_same_bits(online.state, batch.state)


@pytest.mark.slow
def test_the_paper_and_lidar_only_do_not_look_back() -> None:
    settings = dataclasses.replace(SETTINGS, filter=FilterSettings(preset="paper"), uwb=UwbSettings(max_beacons=3))
    run, _ = driven(settings)
    assert run.hindsight is None
    assert not len(run.graph.keyframes)


def test_between_keyframes_a_direction_that_is_not_seen_is_even(finished) -> None:
    run, _ = finished
    poses = run.hindsight.solution.poses
    history = run.history
    sight, seen = np.array(history.sight), np.array(history.map_poses)
    try:
        key = len(poses) // 2
        frames = range(*run.graph.keyframes["frame"][key : key + 2])
        for k in frames[1:]:
            history.sight.values[k] = np.inf
            history.map_poses.values[k] += np.array([0.5, -0.5, 0.0])
        track = _track(run.graph, poses, *history.passage())
        for k in frames[1:]:
            begin, end = run.graph.keyframes["stamp"][key : key + 2]
            share = (history.stamps[k] - begin) / (end - begin)
            want = (1 - share) * poses[key, :2] + share * poses[key + 1, :2]
            np.testing.assert_allclose(track[k, :2], want, atol=1e-9)
    finally:
        history.sight.values[:], history.map_poses.values[:] = sight, seen
    assert np.all(np.abs(wrapped(track[:, 2] - run.hindsight.track[:, 2])) < 1e-5)  # the history is in single precision


@pytest.mark.parametrize(("keyframes", "looks"), [(24, 2), (2500, 27)])
def test_a_revision_may_take_the_longer_the_longer_the_run_is(finished, keyframes: int, looks: int) -> None:
    """The host waits for one that is due: with a fixed delay a long run would stand still for it."""
    graph = Graph()
    graph.keyframes.extend(np.zeros(keyframes, KEYFRAME))
    run, reviser = finished[0], Reviser()
    question = Question(graph, np.zeros((keyframes, 3)), {}, run.host, ((1, 0), (2, 0)), Found())
    reviser.begin(run.config, run.params, question, 0.05, 0.0)
    for _ in range(looks - 1):
        assert reviser.look(lambda solution: True) is None
        assert not reviser.wants(10 * keyframes)
    while not reviser.wants(10 * keyframes):
        assert reviser.look(lambda solution: True) is None
        looks += 1
    reviser.close()
    assert looks < 10 + keyframes


@pytest.mark.slow
def test_ranges_that_are_stamped_late_are_found_and_taken_at_their_time() -> None:
    run, truth = driven(late=0.3)
    found = run.back_end.latency
    assert found is not None
    assert abs(found.late - 0.3) < 0.1
    assert run.hindsight is not None
    robot, beacons = off(run, run.hindsight.track, truth)
    assert np.sqrt(np.mean(robot**2)) < 0.03
    assert beacons.max() < 0.15  # nearly a circle: a lap begun later looks much like beacons turned; 0.4 m if untold


def test_ranges_that_are_on_time_are_not_late(finished) -> None:
    assert finished[0].back_end.latency is None


@pytest.mark.slow
def test_a_run_that_cannot_be_solved_keeps_what_was_published(monkeypatch: pytest.MonkeyPatch) -> None:
    def singular(*_: object) -> None:
        raise SingularError("Factor is exactly singular")

    monkeypatch.setattr(final_solution, "solve", lambda *_, **__: singular())
    run, truth = driven()
    assert run.hindsight is None
    found = to_result(run, Facts())
    assert len(found.stamps) == len(truth)
    assert len(found.beacons) == 3
    assert [told for told in found.summary["warnings"] if "could not be solved as a whole (Factor" in told]
