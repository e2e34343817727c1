"""What a match is worth: surprise against what was expected, jumps that explain it, and what is learnt of them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_room as room

from uwbslam_jax.estimator import match_fusion, state_vector
from uwbslam_jax.estimator.matching import Match
from uwbslam_jax.estimator.state_vector import Nodes
from uwbslam_jax.numerics.gaussian import Gaussian
from uwbslam_jax.settings import Config, Params, Settings, UwbSettings, make_params

BEACONS = np.array([[-3.5, -2.5], [4.0, -2.0], [1.0, 3.0]])
NODES = 4
SIZE = state_vector.state_size(NODES)
PAIRS = [(0, 1), (2, 0), (0, 3)]
CONFIG = Config(NODES, 8, 60, 0.1, 2, 128, 10.0, "robust", True, True, False)
PARAMS: Params = make_params(Settings(uwb=UwbSettings(max_beacons=3)))
STD = 0.02
CALM = jnp.array(match_fusion.CALM) ** 2

weigh, fuse, learn_unrest = jax.jit(match_fusion.weigh), jax.jit(match_fusion.fuse), jax.jit(match_fusion.learn_unrest)
allow_jump, contradicted = jax.jit(match_fusion.allow_jump), jax.jit(match_fusion.contradicted)
anchor, revisit, learn_spread = (
    jax.jit(match_fusion.anchor),
    jax.jit(match_fusion.revisit),
    jax.jit(match_fusion.learn_spread),
)
AT, ERROR = np.array(state_vector.pose_indices(NODES)), np.array(state_vector.map_error_indices(NODES))


def expecting(pose=(0.0, 0.0, 0.0), velocity=(0.0, 0.0)) -> Gaussian:
    """The robot taken to be at a pose, 0.02 m and 0.02 rad certain; the map right."""
    positions, velocities = np.vstack([pose[:2], BEACONS]), np.zeros((NODES, 2))
    velocities[0] = velocity
    nodes = Nodes(*(jnp.asarray(x, jnp.float32) for x in (positions, velocities, pose[2], 0.0, np.zeros(3))))
    std = np.full(SIZE, 1e-3)
    std[list(state_vector.pose_indices(NODES))] = STD
    return Gaussian(state_vector.pack(nodes), jnp.asarray(np.diag(std**2), jnp.float32))


def match(pose, score=0.85, known=1.0, informed=((1.0, 0.0), (0.0, 1.0))) -> Match:
    """A scan with 1000 beams' worth of gradients of 3 per metre, as far as it is informed."""
    projector = np.eye(3)
    projector[:2, :2] = informed
    information = projector @ np.diag([9e3, 9e3, 9e4]) @ projector
    return Match(*(jnp.asarray(x, jnp.float32) for x in (pose, information, informed, score, known, score)))


def frame(truth, dt=0.1, age=0.0):
    z = room.distances(np.vstack([truth[:2], BEACONS]), PAIRS)
    return room.frame(CONFIG, dt, None, room.ranges(PAIRS, z, CONFIG.max_ranges, age))


def told(truth, pose, dt=0.1, age=0.0) -> bool:
    """Whether ranges measured at one place contradict a match at another, the robot being expected at the origin."""
    measured = jax.tree.map(jnp.asarray, frame(np.array(truth), dt, age))
    return bool(contradicted(match(pose), expecting(), measured, measured.ranges.valid, PARAMS))


def test_surprise_is_the_squared_mahalanobis_distance():
    pose = np.array([0.05, -0.03, 0.01])
    surprise, information = weigh(match(pose), expecting(), PARAMS, jnp.int32(1000))
    # 50 of 1000 beams are independent; the map's own error (0.001) and the floor of any match come on top
    Y = np.diag([9e3, 9e3, 9e4]) * 0.05 / 0.25**2
    R = np.linalg.inv(Y) + np.diag([0.004, 0.004, 0.0006]) ** 2
    S = np.eye(3) * (STD**2 + 1e-6) + R
    want = pose @ np.linalg.solve(S, pose)
    np.testing.assert_allclose(surprise, want, rtol=1e-3)  # float32
    np.testing.assert_allclose(information, np.linalg.inv(R) / (1 + want / 30.0) ** 2, rtol=1e-3, atol=1e-2)


def test_a_match_moves_the_pose_only_as_far_as_the_scan_can_tell():
    """Along a corridor in x the alignment has slid by 0.3 m: that is not information and no surprise."""
    slid = match((0.3, 0.01, 0.0), informed=np.diag([0.0, 1.0]))
    surprise, information = weigh(slid, expecting(), PARAMS, jnp.int32(1000))
    assert float(surprise) < 1.0
    after = fuse(expecting(), slid, information)
    np.testing.assert_allclose(after.mean[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(after.mean[1], 0.01, atol=0.003)


def test_headings_are_compared_around_the_circle():
    surprise, _ = weigh(match((0.0, 0.0, 2 * np.pi + 0.01)), expecting(), PARAMS, jnp.int32(1000))
    assert float(surprise) < 1.0


def test_a_jump_is_followed_and_leaves_the_velocity_alone():
    jump = match((0.17, 0.0, 0.26))
    before = expecting(velocity=(0.3, 0.0))
    assert float(weigh(jump, before, PARAMS, jnp.int32(1000))[0]) > match_fusion.SURPRISE
    belief = allow_jump(before, jump, jnp.array(True))
    surprise, information = weigh(jump, belief, PARAMS, jnp.int32(1000))
    assert float(surprise) < 5.0  # as wide as the jump is far: three coordinates of one sigma or less
    after = fuse(belief, jump, information)
    np.testing.assert_allclose(state_vector.robot_pose(after.mean), jump.pose, atol=0.01)
    np.testing.assert_allclose(state_vector.unpack(after.mean).velocities[0], [0.3, 0.0], atol=1e-3)
    for same in (allow_jump(before, jump, jnp.array(False)), allow_jump(before, match((0.02, 0, 0)), jnp.array(True))):
        np.testing.assert_array_equal(same.cov, before.cov)


@pytest.mark.parametrize("far", [0.0, 0.2, 1.0])
def test_ranges_that_agree_with_a_jump_do_not_contradict_it_and_those_of_the_expected_place_do(far):
    assert not told((far, 0.0, 0.0), (far, 0.0, 0.0))
    assert told((0.0, 0.0, 0.0), (far, 0.0, 0.0)) == (far > 0.5)  # 0.2 m is two sigma of three ranges


def test_ranges_that_were_taken_on_the_way_to_a_jump_do_not_contradict_it():
    """Half a second ago the robot was half way."""
    assert not told((0.5, 0.0, 0.0), (1.0, 0.0, 0.0), dt=1.0, age=-0.5)


def test_a_sure_match_fits_and_sees_enough():
    sure = [bool(match_fusion.is_sure(match(np.zeros(3), *fit))) for fit in [(0.85, 1.0), (0.5, 1.0), (0.85, 0.3)]]
    assert sure == [True, False, False]
    needed = [bool(match_fusion.needs_jump(match(np.zeros(3), 0.85), jnp.array(fit))) for fit in (0.3, 0.8)]
    assert needed == [True, False]


def learnt(errors, needed=0.1, std=STD) -> np.ndarray:
    """Standard deviations learnt from innovations (n, 3) where a spread of std was expected; those larger than
    `needed` are what the scan needs."""
    unrest, belief, at = CALM, expecting(), jnp.array(state_vector.pose_indices(NODES))
    cov = belief.cov * (std / STD) ** 2
    for error in errors:
        belief = belief._replace(cov=cov.at[at, at].add(unrest[jnp.array([0, 0, 1])]))  # as it is predicted
        unrest = learn_unrest(unrest, match(error), belief, jnp.array(np.abs(error).max() > needed))
    return np.sqrt(np.asarray(unrest, float))


def test_unrest_of_a_robot_that_jumps_is_learnt_and_forgotten():
    """Every fifth scan comes 0.2 m and 0.2 rad off, the others as expected."""
    rng = np.random.default_rng(0)
    errors = STD * rng.normal(size=(400, 3))
    np.testing.assert_allclose(learnt(errors), match_fusion.CALM, rtol=1e-6)
    errors[::5, [0, 2]] += 0.2
    position, heading = learnt(errors)
    # the mean of x and y: 0.2 / sqrt(2) in a fifth of the scans, running over 20 scans
    np.testing.assert_allclose(position, 0.2 / np.sqrt(2) / np.sqrt(5), rtol=0.4)
    np.testing.assert_allclose(heading, 0.2 / np.sqrt(5), rtol=0.4)
    assert bool(match_fusion.restless(jnp.array([position, heading]) ** 2))
    assert not bool(match_fusion.restless(CALM))


def test_what_the_scan_does_not_need_or_was_expected_anyway_teaches_nothing():
    errors = np.tile([0.2, 0.0, 0.2], (50, 1))
    np.testing.assert_allclose(learnt(errors, needed=1.0), match_fusion.CALM, rtol=1e-6)
    np.testing.assert_allclose(learnt(errors, std=0.3), match_fusion.CALM, rtol=1e-6)
    assert learnt(errors).min() > 0.1


# What the map errs by.


def uncertain(seed: int = 0) -> Gaussian:
    """A pose and a map error, correlated with each other and with all else."""
    rng = np.random.default_rng(seed)
    root = 0.05 * rng.normal(size=(SIZE, SIZE))
    belief = expecting(pose=(1.0, -2.0, 3.1))
    mean = belief.mean.at[ERROR].set(jnp.array([0.2, -0.1, 0.03]))
    return Gaussian(mean, jnp.asarray(root @ root.T, jnp.float32))


def blocks(cov) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Covariance of the pose, of the map error, and of the map error with the pose."""
    cov = np.asarray(cov, float)
    return cov[np.ix_(AT, AT)], cov[np.ix_(ERROR, ERROR)], cov[np.ix_(ERROR, AT)]


def test_where_all_is_new_the_map_errs_by_what_the_pose_errs_by():
    before = uncertain()
    at = jnp.array([1.3, -2.1, -3.1])  # 0.083 rad on from 3.1, through the half turn
    after = anchor(before, at, jnp.eye(3))
    np.testing.assert_allclose(after.mean[ERROR], [0.3, -0.1, 2 * np.pi - 6.2], atol=1e-5)  # float32
    pose, error, cross = blocks(after.cov)
    np.testing.assert_allclose(error, pose, atol=1e-7)
    np.testing.assert_allclose(cross, -pose, atol=1e-7)
    # a match there is expected where the scan was drawn, and nowhere else
    expected = np.asarray(match_fusion.expected_match(after)) - np.asarray(at)
    np.testing.assert_allclose(np.exp(1j * expected), 1.0, atol=1e-5)
    # nothing is learnt of anything else
    others = np.setdiff1d(np.arange(SIZE), ERROR)
    np.testing.assert_array_equal(after.mean[others], before.mean[others])
    np.testing.assert_array_equal(after.cov[np.ix_(others, others)], before.cov[np.ix_(others, others)])


def test_where_nothing_is_new_the_map_errs_as_before():
    before = uncertain()
    after = anchor(before, jnp.array([5.0, 5.0, 1.0]), jnp.zeros((3, 3)))
    np.testing.assert_array_equal(after.mean, before.mean)
    np.testing.assert_allclose(after.cov, before.cov, atol=1e-8)  # float32


def test_a_share_of_new_ground_moves_the_map_error_by_as_much():
    """Along y all is new, along x nothing, of the heading half."""
    before = uncertain()
    after = anchor(before, jnp.array([1.3, -2.4, 3.15]), jnp.diag(jnp.array([0.0, 1.0, 0.5])))
    np.testing.assert_allclose(after.mean[ERROR], [0.2, -0.4, (0.03 + 0.05) / 2], atol=1e-5)
    pose, error, _ = blocks(after.cov)
    _, was, _ = blocks(before.cov)
    np.testing.assert_allclose([error[0, 0], error[1, 1]], [was[0, 0], pose[1, 1]], rtol=1e-5)


def test_ranges_that_mend_a_pose_mend_what_its_map_errs_by():
    """The pose is found 0.1 m further on than where the scan was drawn: so the map errs by -0.1 m."""
    before = expecting()
    drawn = anchor(before, jnp.zeros(3), jnp.eye(3))
    gain = drawn.cov[:, 0] / drawn.cov[0, 0]
    mended = drawn.mean + 0.1 * gain
    np.testing.assert_allclose([mended[0], mended[ERROR[0]]], [0.1, -0.1], atol=1e-6)


def spread(apart=0.0, views=1.0, way=50.0, epoch=20.0) -> match_fusion.MapSpread:
    return match_fusion.MapSpread(apart * jnp.eye(3), jnp.float32(views), jnp.float32(way), jnp.float32(epoch))


@pytest.mark.parametrize(
    "seen", [0.0, 20.0, 20.0 + 0.9 * match_fusion._OTHER_EPOCH, 20.0 - 0.9 * match_fusion._OTHER_EPOCH]
)
def test_ground_of_the_same_epoch_or_of_none_errs_as_before(seen):
    before, known = uncertain(), spread(1e-4)
    after, still = revisit(before, known, jnp.float32(seen), PARAMS)
    np.testing.assert_array_equal(after.cov, before.cov)
    np.testing.assert_array_equal(after.mean, before.mean)
    for a, b in zip(still, known, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("apart", [0.0, 1e-4])
def test_ground_of_another_epoch_errs_the_more_differently_the_more_was_driven_in_between(apart):
    before = uncertain()

    def added(seen):
        after, known = revisit(before, spread(apart), jnp.float32(seen), PARAMS)
        assert float(known.epoch) == seen
        np.testing.assert_array_equal(after.mean, before.mean)
        return np.asarray(after.cov - before.cov, float)

    near, far, ahead = added(10.0), added(5.0), added(35.0)
    sigma = np.array([PARAMS.sigma_map, PARAMS.sigma_map, PARAMS.sigma_map_yaw])
    want = np.zeros((SIZE, SIZE))
    want[ERROR, ERROR] = 10.0 * (sigma**2 + apart / match_fusion._PATCH_M)
    np.testing.assert_allclose(near, want, atol=1e-7)  # float32
    np.testing.assert_allclose(far, 1.5 * near, atol=1e-7)
    np.testing.assert_array_equal(far, ahead)  # whichever was drawn first


def test_ground_that_is_looked_at_on_and_on_is_another_only_once():
    belief, known = revisit(uncertain(), spread(), jnp.float32(5.0), PARAMS)
    again, _ = revisit(belief, known, jnp.float32(5.0), PARAMS)
    np.testing.assert_array_equal(again.cov, belief.cov)


def test_spread_is_the_mean_covariance_of_matches_where_new_ground_was_drawn():
    known, covs, ways = match_fusion.even_map(), [], [0.2, 0.3, 0.1]
    C = np.asarray(state_vector.matched_pose_jacobian(NODES), float)
    for seed, way in enumerate(ways):
        belief = uncertain(seed)
        covs.append(C @ np.asarray(belief.cov, float) @ C.T)
        known = learn_spread(known, belief, jnp.eye(3), jnp.float32(way))
        # old ground tells nothing, but the way to it counts
        known = learn_spread(known, uncertain(9), jnp.zeros((3, 3)), jnp.float32(1.0))
    np.testing.assert_allclose(known.apart, np.mean(covs, axis=0), atol=1e-6)  # float32
    assert float(known.views) == pytest.approx(3.0)
    assert float(known.way) == pytest.approx(float(match_fusion.even_map().way) + sum(ways) + 3.0)
    assert float(known.epoch) == float(match_fusion.even_map().epoch)


def test_half_a_view_of_new_ground_counts_half():
    known = learn_spread(match_fusion.even_map(), uncertain(0), jnp.eye(3), jnp.float32(0.0))
    C = state_vector.matched_pose_jacobian(NODES)
    first, second = (C @ uncertain(seed).cov @ C.T for seed in (0, 1))
    known = learn_spread(known, uncertain(1), 0.5 * jnp.eye(3), jnp.float32(0.0))
    np.testing.assert_allclose(known.apart, (2 * first + second) / 3, atol=1e-6)  # float32
