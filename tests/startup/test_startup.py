"""Start-up: what is said before the beacons are placed, which mirror image it is, and the change of frame."""

from __future__ import annotations

from collections import deque

import jax.numpy as jnp
import numpy as np
import pytest
import start_of_run
from start_of_run import BEACONS, IDS, SETTINGS

from uwbslam_jax.estimator import HostView, init, state_vector
from uwbslam_jax.mapping.tiled_map import Tiles
from uwbslam_jax.numerics import TrackRanges, median_range, se2, se2_host
from uwbslam_jax.settings import make_config, make_host_params, make_params
from uwbslam_jax.startup import adopt, decide

TRUTH = np.array(list(BEACONS.values()))
CONFIG, PARAMS = make_config(SETTINGS), make_params(SETTINGS)


def solved(poses, **options) -> decide.Outcome:
    return decide.solve(start_of_run.buffer(poses, **options), IDS)


def test_at_rest_it_waits_for_motion():
    outcome = solved(start_of_run.straight(0.6))
    assert (outcome.status, outcome.hypotheses, outcome.placement) == ("waiting for motion", 0, None)


def test_an_empty_buffer_waits_for_motion():
    empty = decide.Buffer(make_host_params(SETTINGS, PARAMS))
    assert decide.solve(empty, IDS).status == "waiting for motion"


def test_one_beacon_alone_makes_no_frame():
    outcome = solved(start_of_run.with_a_turn(), beacons={1: BEACONS[1]})
    assert outcome.status == "placing beacons"
    assert outcome.placement is None


@pytest.mark.parametrize("seed", range(3))
def test_on_a_straight_path_the_reflection_is_undecided(seed):
    outcome = solved(start_of_run.straight(), seed=seed, antenna=(0.0, 0.0))
    assert outcome.status == "reflection undecided"
    assert outcome.hypotheses == 2
    assert outcome.margin < 3.0  # 0.5 to 3 on a straight path
    assert outcome.placement is None


@pytest.mark.parametrize("side", [1, -1], ids=["left", "right"])
@pytest.mark.parametrize("seed", range(2))
def test_after_a_turn_the_mirror_images_are_told_apart(seed, side):
    """A mirrored world makes every left turn a right turn: the same beacons seen from the other turn are mirrored."""
    poses = start_of_run.with_a_turn() * [1, side, side]
    outcome = solved(poses, seed=seed)
    assert outcome.status == "decided"
    assert outcome.margin > 100.0
    assert outcome.placement.slots == [1, 2, 3]
    np.testing.assert_allclose(outcome.placement.beacons, TRUTH, atol=0.1)


def test_published_frame_has_the_lowest_id_at_the_origin_and_the_farthest_beacon_on_x():
    outcome = solved(start_of_run.with_a_turn())
    # slot 3 is 9.9 m from slot 1 and 8.1 m from slot 2
    assert decide.choose_frame(outcome.placement, {0: 0, 1: 30, 2: 12, 3: 7}) == (3, 1)


MOTION = [2 * CONFIG.nodes, 2 * CONFIG.nodes + 1, 4 * CONFIG.nodes + 1]
"""Where velocity and yaw rate of the robot stand in the state vector."""
MOTION_COV = np.array([[0.04, 0.01, 0.002], [0.01, 0.01, -0.003], [0.002, -0.003, 0.09]], np.float32)


def adopted_case():
    """A decided start, and a LiDAR-only state that has driven a little on from the last keyframe."""
    kept = start_of_run.buffer(start_of_run.with_a_turn())
    outcome = decide.solve(kept, IDS)
    state = init(CONFIG)
    pose = kept.keyframes[-1].pose + np.array([0.05, 0.1, 0.02])
    s = state_vector.unpack(state.belief.mean)
    mean = state_vector.pack(
        s._replace(
            positions=s.positions.at[0].set(jnp.asarray(pose[:2])),
            velocities=s.velocities.at[0].set(jnp.array([0.3, 0.7])),
            heading=jnp.float32(pose[2]),
            yaw_rate=jnp.float32(0.1),
        )
    )
    at = np.array(MOTION)
    cov = np.array(state.belief.cov)
    cov[np.ix_(at, at)] = MOTION_COV
    state = state._replace(belief=state.belief._replace(mean=mean, cov=jnp.asarray(cov)))
    frame_slots = decide.choose_frame(outcome.placement, IDS)
    nothing = Tiles(CONFIG.resolution), {}, [], np.zeros((0, 3)), {}, {}
    view = HostView(CONFIG, PARAMS, kept.host, state, *nothing)
    adopted, _, moved = adopt(view, kept, outcome.placement, frame_slots)
    return outcome.placement, state, frame_slots, adopted, moved, pose


def published(x: np.ndarray, onward: np.ndarray, frame: tuple[int, int]) -> np.ndarray:
    """Robot and beacons in the frame of two beacons, by homogeneous matrices."""

    def matrix(p):
        return np.array([[np.cos(p[2]), -np.sin(p[2]), p[0]], [np.sin(p[2]), np.cos(p[2]), p[1]], [0, 0, 1]])

    beacons = x[3:].reshape(-1, 2)
    origin, along = beacons[frame[0] - 1], beacons[frame[1] - 1]
    G = np.linalg.inv(matrix([*origin, np.arctan2(*(along - origin)[::-1])]))
    robot = G @ matrix(x[:3]) @ matrix(onward)
    moved = [(G @ [*b, 1.0])[:2] for b in beacons]
    return np.concatenate([robot[:2, 2], [np.arctan2(robot[1, 0], robot[0, 0])], np.ravel(moved)])


def test_adopted_state_is_the_start_in_the_published_frame():
    placement, state, frame, adopted, _, pose = adopted_case()
    onward = se2_host.between(_last_key(), pose)
    want = published(np.concatenate([placement.poses[-1], placement.beacons.ravel()]), onward, frame)
    s = state_vector.unpack(adopted.belief.mean)
    np.testing.assert_allclose(s.positions[0], want[:2], atol=1e-4)  # float32 of some metres
    np.testing.assert_allclose(np.exp(1j * float(s.heading)), np.exp(1j * want[2]), atol=1e-5)
    np.testing.assert_allclose(s.positions[1:], want[3:].reshape(-1, 2), atol=1e-5)
    np.testing.assert_allclose(s.positions[frame[0]], 0.0, atol=1e-6)
    assert float(s.positions[frame[1], 0]) > 0
    np.testing.assert_array_equal(adopted.active, True)
    # the velocity turns with the frame: the same speed, the same angle against the heading
    v, before = np.asarray(s.velocities[0]), np.array([0.3, 0.7])
    np.testing.assert_allclose(np.hypot(*v), np.hypot(*before), rtol=1e-6)
    turned = np.asarray(se2.rotation(-s.heading) @ s.velocities[0])
    np.testing.assert_allclose(turned, se2_host.rotation_matrix(-pose[2]) @ before, atol=1e-5)
    assert float(s.yaw_rate) == float(state_vector.unpack(state.belief.mean).yaw_rate)


def _last_key() -> np.ndarray:
    return start_of_run.with_a_turn()[-1]


def test_adopted_covariance_is_that_of_samples_put_through_the_change_of_frame():
    placement, _, frame, adopted, _, pose = adopted_case()
    n = placement.poses.size
    x = np.concatenate([placement.poses[-1], placement.beacons.ravel()])
    cov = placement.cov[n - 3 :, n - 3 :]
    onward = se2_host.between(_last_key(), pose)
    # a tenth of the spread, so that the map is linear over the samples
    samples = np.random.default_rng(0).multivariate_normal(x, cov / 100, 4000)
    mapped = np.array([published(sample, onward, frame) for sample in samples])
    want = 100 * np.cov(mapped.T)
    P = np.asarray(adopted.belief.cov)
    nodes = CONFIG.nodes
    at = [*state_vector.pose_indices(nodes), *range(2, 2 * nodes)]
    # a sample covariance of 4000 is right to 2.2 % of each pair's spread; four times that
    spread = np.sqrt(np.diag(want))
    np.testing.assert_allclose(P[np.ix_(at, at)], want, atol=0.09 * np.outer(spread, spread).max())
    for known in (2 * frame[0], 2 * frame[0] + 1, 2 * frame[1] + 1):
        assert P[known, known] < 1e-10  # the frame's own coordinates
    error = np.array(state_vector.map_error_indices(nodes))
    robot = np.array(state_vector.pose_indices(nodes))
    C = np.asarray(state_vector.matched_pose_jacobian(nodes))
    # what a match reports is known: the map was drawn at the estimated poses
    np.testing.assert_allclose(C @ P @ C.T, 0.0, atol=1e-8)
    np.testing.assert_allclose(P[np.ix_(error, error)], P[np.ix_(robot, robot)], atol=1e-10)
    assert np.linalg.eigvalsh((P + P.T) / 2).min() > -1e-7


def test_covariance_of_the_velocity_turns_with_the_frame():
    _, _, _, adopted, _, pose = adopted_case()
    turn = float(state_vector.unpack(adopted.belief.mean).heading) - pose[2]
    J = np.eye(3)
    J[:2, :2] = se2_host.rotation_matrix(turn)
    P = np.asarray(adopted.belief.cov)
    np.testing.assert_allclose(P[np.ix_(MOTION, MOTION)], J @ MOTION_COV @ J.T, atol=1e-6)  # float32


def test_earlier_poses_are_republished_with_the_keyframes_around_them():
    placement, _, _, _, moved, _ = adopted_case()
    track = start_of_run.with_a_turn()
    np.testing.assert_allclose(moved.carry(moved.anchors, track), moved.after, atol=1e-9)
    # a pose between two keyframes keeps its place relative to both, the nearer one counting more
    later = (track[3] + np.array([0.1, 0.02, 0.05]))[None]
    quarter = moved.anchors[3:4] + (moved.anchors[4] - moved.anchors[3]) // 4
    ends = [se2_host.compose(moved.after[k], se2_host.between(track[k], later)) for k in (3, 4)]
    np.testing.assert_allclose(moved.carry(quarter, later), 0.75 * ends[0] + 0.25 * ends[1], atol=1e-9)
    # before the first keyframe: by the first
    first = moved.carry(np.array([moved.anchors[0] - 5]), track[:1])
    np.testing.assert_allclose(first, moved.after[:1], atol=1e-9)
    assert len(placement.poses) == len(moved.after)


def test_host_compose_and_between_are_those_of_the_device():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 3))
    device = se2.compose(jnp.asarray(a), jnp.asarray(b))
    np.testing.assert_allclose(se2_host.compose(a, b), device, atol=1e-6)  # float32
    np.testing.assert_allclose(se2_host.compose(a, se2_host.between(a, b)), b, atol=1e-12)


def test_biased_radios_are_told():
    assert solved(start_of_run.with_a_turn(8.0), each=10, bias={0: 0.5, 1: -0.6, 2: 0.8, 3: 0.7}).open == ("bias",)


def test_calibrated_radios_are_not_called_biased():
    assert not any(solved(start_of_run.with_a_turn(), seed=seed).open for seed in range(5))


def test_a_long_start_is_thinned_without_losing_ranges():
    kept = start_of_run.buffer(start_of_run.with_a_turn())
    count, last = len(kept.keyframes), kept.newest
    kept._thin()
    assert count / 2 <= len(kept.keyframes) <= count / 2 + 2
    assert kept.newest == last
    averages = TrackRanges(*map(np.concatenate, zip(*kept.averages(kept.keyframes), strict=True)))
    # each range still stands where it was taken, half of them now half-way between two keyframes
    poses = np.array([key.pose for key in kept.keyframes])
    from_before = poses[averages.at, :2] + se2_host.turned(poses[averages.at, 2], averages.lever_at)
    after = averages.after
    assert (after == np.minimum(averages.at + 1, len(poses) - 1)).all()
    from_after = poses[after, :2] + se2_host.turned(poses[after, 2], averages.lever_after)
    np.testing.assert_allclose(from_before, from_after, atol=1e-9)
    assert set(np.round(averages.share, 6)) == {0.0, 0.5}


def test_scatter_tells_ranges_through_walls_from_quiet_ones():
    kept = start_of_run.buffer(start_of_run.with_a_turn(), each=3)
    rng = np.random.default_rng(0)
    kept.sightings[2] = deque(s._replace(distance=s.distance + rng.exponential(0.8)) for s in kept.sightings[2])
    kept.pairs[1, 3] = deque(d + rng.exponential(0.8) for d in kept.pairs[1, 3])
    sigma = {int(means.to[0]): means.sigma for means in kept.averages(kept.keyframes)}
    assert np.median(sigma[2]) > 4 * np.median(np.concatenate([sigma[1], sigma[3]]))
    of_median = {pair: median_range(np.array(d), SETTINGS.uwb.sigma_n)[1] for pair, d in kept.pairs.items()}
    assert of_median[1, 3] > 4 * max(of_median[1, 2], of_median[2, 3])
    factor = np.exp(kept.scatter(4))
    assert factor[0, 2] > 4
    assert factor[1, 3] > 3
    assert max(factor[0, 1], factor[0, 3], factor[1, 2], factor[2, 3]) < 1.6
    np.testing.assert_array_equal(factor, factor.T)
