"""Start-up of a robot with wheels whose scans lie far apart; how often and how large it is solved; what it lacks."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
import pytest
import start_of_run
from start_of_run import BEACONS, IDS, SETTINGS

from uwbslam_jax.estimator import Estimate, HostView, init, state_vector
from uwbslam_jax.mapping import Tiles
from uwbslam_jax.measurements import Odometry, StampedFrame
from uwbslam_jax.numerics import se2_host
from uwbslam_jax.reasons import StartUpLacks
from uwbslam_jax.result import EventKind, RunStatus
from uwbslam_jax.settings import make_config, make_host_params, make_params
from uwbslam_jax.startup import StartUp, adopt, decide, start_up
from uwbslam_jax.startup.keyframe_buffer import Buffer
from uwbslam_jax.startup.placement import Placement, Problem

CONFIG, PARAMS = make_config(SETTINGS), make_params(SETTINGS)
HOST = make_host_params(SETTINGS, PARAMS)
TRUTH = np.array(list(BEACONS.values()))
SPARSE = 4
"""Every so many poses of 0.25 m there is a scan."""
TOLD = np.diag([1 / 0.01**2, 1 / 0.01**2, 1 / 0.002**2])


def estimate(pose: np.ndarray, *, scan: bool, poor: bool = False) -> Estimate:
    """What a step reports of a pose."""
    told = {"pose": pose, "velocity": np.zeros(2), "yaw_rate": np.zeros(()), "poor": np.bool_(poor)}
    told["information"] = TOLD * (scan and not poor)
    return Estimate(**{name: told.get(name) for name in Estimate._fields})


def frame(stamp: int, step: np.ndarray | None, *, scan: bool) -> StampedFrame:
    """A frame with an increment of the wheels, where they measured it."""
    made = start_of_run.frame(stamp)
    odometry = Odometry(np.float32(np.zeros(3) if step is None else step), np.bool_(step is not None))
    return replace(made, frame=made.frame._replace(odometry=odometry, has_scan=np.bool_(scan)))


def driven(poses: np.ndarray, *, wheels: bool, scans: int | None = SPARSE) -> Buffer:
    """What is buffered along some poses with a scan at each so many of them, wheels in between or not."""
    dense = start_of_run.buffer(poses)
    kept = Buffer(dense.host)
    for k, pose in enumerate(poses):
        scan = scans is not None and k % scans == 0
        if scan or wheels:
            step = se2_host.between(poses[k - 1], pose) if wheels and k else None
            kept.add(frame(int(k * 3e8), step, scan=scan), estimate(pose, scan=scan and k > 0))
    kept.sightings, kept.pairs = dense.sightings, dense.pairs
    return kept


def placed(kept: Buffer) -> Placement:
    problem = Problem.build(kept)
    assert problem is not None
    return problem.minimise(TRUTH)


def heading_sigma(found: Placement) -> float:
    """Standard deviation of the heading of the last scan among the beacons [rad]."""
    columns = found.columns(found.drawn)
    x = np.concatenate([found.poses[found.drawn], found.beacons.ravel()])
    J = se2_host.numeric_jacobian(lambda x: x[2:3] - np.arctan2(*(x[5:7] - x[3:5])[::-1]), x)
    return float(np.sqrt(J @ found.cov[np.ix_(columns, columns)] @ J.T)[0, 0])


@pytest.mark.parametrize("poses", [13, 19, 24])
def test_wheels_between_scans_leave_nothing_less_certain(poses: int) -> None:
    """What a match tells holds from the scan before it: put on the last quarter of a metre alone, with wheels of a
    degree a quarter of a metre before that, it left the heading open for ten minutes."""
    track = start_of_run.with_a_turn()[:poses]
    with_wheels, without = (placed(driven(track, wheels=w)) for w in (True, False))
    assert heading_sigma(with_wheels) < 1.1 * heading_sigma(without)
    assert (with_wheels.beacon_sigma() < 1.1 * without.beacon_sigma()).all()


@pytest.mark.parametrize("poses", [20, 23, 26])
def test_wheels_never_make_a_decision_later(poses: int) -> None:
    track = start_of_run.with_a_turn()[:poses]
    with_wheels, without = (decide.solve(driven(track, wheels=w), IDS) for w in (True, False))
    assert without.status == with_wheels.status == RunStatus.DECIDED
    assert with_wheels.placement is not None
    np.testing.assert_allclose(with_wheels.placement.beacons, TRUTH, atol=0.15)


def test_a_scan_takes_the_place_of_a_keyframe_by_wheels_that_is_near() -> None:
    kept = Buffer(HOST)
    for k in range(9):  # 0.15 m a frame: keyframes at 0, 0.3, 0.6 and 0.9 m, a scan at 1.05 m
        pose, scan = np.array([0.15 * k, 0.0, 0.0]), k in (0, 7)
        kept.add(frame(int(k * 1e8), np.array([0.15, 0.0, 0.0]), scan=scan), estimate(pose, scan=scan and k > 0))
    np.testing.assert_allclose([key.pose[0] for key in kept.keyframes], [0.0, 0.3, 0.6, 1.05])
    assert [key.matched for key in kept.keyframes] == [True, False, False, True]
    np.testing.assert_allclose(kept.keyframes[-1].wheels, [0.45, 0.0, 0.0], atol=1e-6)  # float32
    kept.add(
        frame(int(1e9), np.array([0.4, 0.0, 0.0]), scan=True), estimate(np.array([1.6, 0, 0]), scan=True, poor=True)
    )
    assert not kept.keyframes[-1].matched  # a match that is not believed tells no more than wheels


def test_a_thinned_start_keeps_its_scans_and_what_wheels_measured() -> None:
    track = np.concatenate([start_of_run.straight(4.0), np.zeros((0, 3))])
    kept = driven(track, wheels=True)
    scans = [key.pose[0] for key in kept.keyframes if key.matched]
    kept._thin()
    assert [key.pose[0] for key in kept.keyframes if key.matched] == scans
    steps = np.diff([key.pose[0] for key in kept.keyframes])
    np.testing.assert_allclose([key.wheels[0] for key in kept.keyframes[1:]], steps, atol=1e-6)


def adopted(scans: int | None) -> tuple[Placement, np.ndarray]:
    """A start whose last poses were driven by wheels alone, and the covariance that it is taken over with."""
    kept = driven(start_of_run.with_a_turn()[:24], wheels=True, scans=scans)
    found, state = placed(kept), init(CONFIG)
    mean = state.belief.mean.at[np.array(state_vector.pose_indices(CONFIG.nodes))].set(kept.track()[-1].pose)
    state = state._replace(belief=state.belief._replace(mean=mean))
    view = HostView(CONFIG, PARAMS, HOST, state, Tiles(CONFIG.resolution), {}, [], np.zeros((0, 3)), {}, {})
    after, _, _ = adopt(view, kept, found, (1, 2))
    return found, np.asarray(after.belief.cov, float)


def test_a_map_hangs_on_the_last_scan_and_what_wheels_drove_since_the_next_match_tells() -> None:
    found, P = adopted(scans=SPARSE)
    last = len(found.poses) - 1
    assert found.drawn < last
    C = np.asarray(state_vector.matched_pose_jacobian(CONFIG.nodes))
    apart = np.zeros(found.cov.shape[0])
    apart[[3 * last + 2, 3 * found.drawn + 2]] = 1.0, -1.0
    assert (C @ P @ C.T)[2, 2] == pytest.approx(apart @ found.cov @ apart, rel=1e-3)
    assert (C @ P @ C.T)[2, 2] > 0.01**2
    assert np.linalg.eigvalsh((P + P.T) / 2).min() > -1e-7
    _, P = adopted(scans=1)  # every pose has a scan: a match can tell nothing new
    np.testing.assert_allclose(C @ P @ C.T, 0.0, atol=1e-8)


class Asked:
    """Stands for `solve`: notes what it is asked, and decides nothing."""

    def __init__(self) -> None:
        self.keyframes: list[int] = []
        self.ranges: list[int] = []

    def __call__(self, kept: Buffer, ids: dict[int, int]) -> decide.Outcome:
        self.keyframes.append(len(kept.track()))
        self.ranges.append(sum(map(len, kept.sightings.values())))
        return decide.Outcome(RunStatus.UNDECIDED, 2, 0.0, None, StartUpLacks.SIDE)


def test_a_start_that_cannot_be_decided_costs_less_and_less_and_says_what_it_waits_for(monkeypatch) -> None:
    asked, part = Asked(), StartUp(HOST)
    monkeypatch.setattr(start_up, "solve", asked)
    pose, events, solved = np.zeros(3), [], []
    nothing = init(CONFIG), Tiles(CONFIG.resolution), {}
    for second in range(900):  # a metre a second in a straight line
        seen = []
        for tenth in range(2):
            pose = pose + np.array([0.5, 0.0, 0.0])
            made = frame(int(second * 1e9 + tenth * 5e8), np.array([0.5, 0.0, 0.0]), scan=tenth == 0)
            valid, j = np.ones(4, bool), np.array([1, 2, 3, 1], np.int32)
            r = made.frame.ranges._replace(i=np.zeros(4, np.int32), j=j, range=np.full(4, 5.0), valid=valid)
            made = replace(made, frame=made.frame._replace(ranges=r))
            seen.append((made, estimate(pose, scan=tenth == 0)))
        changes = part.look(HostView(CONFIG, PARAMS, HOST, *nothing, seen, np.zeros((0, 3)), {}, {}))
        events += [(second, event) for event in changes.events]
        solved.append(len(asked.keyframes))
    assert max(asked.keyframes) <= 66
    assert max(asked.ranges) <= 3 * 3001
    minutes = np.diff([0, *solved[59::60]])
    assert minutes[0] <= 45
    assert minutes[-1] <= 2  # of 60 s each
    waits = [(second, event) for second, event in events if event.kind is EventKind.WAITS]
    assert [(second, event.detail) for second, event in waits] == [(60, StartUpLacks.SIDE)]
    assert part.overdue
    assert part.lack.advice


@pytest.mark.parametrize(
    ("poses", "options", "lack"),
    [
        (start_of_run.straight(0.6), {}, StartUpLacks.MOTION),
        (start_of_run.with_a_turn(), {"beacons": {1: BEACONS[1]}}, StartUpLacks.RANGES),
        (start_of_run.straight(), {"antenna": (0.0, 0.0)}, StartUpLacks.SIDE),
        (start_of_run.straight(12.0), {"wrong": True}, StartUpLacks.FIT),
    ],
    ids=lambda value: value.split()[0] if isinstance(value, str) else "",
)
def test_what_is_waited_for_has_its_own_words(poses, options, lack) -> None:
    wrong = options.pop("wrong", False)
    kept = start_of_run.buffer(poses, **options)
    if wrong:
        kept.sightings = {
            slot: deque(seen._replace(distance=0.5) for seen in own) for slot, own in kept.sightings.items()
        }
    assert decide.solve(kept, IDS).lack is lack


def test_a_decided_start_lacks_nothing() -> None:
    assert decide.solve(start_of_run.buffer(start_of_run.with_a_turn()), IDS).lack is None
