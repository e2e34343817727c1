"""Preset "paper": errata 1-3 of docs/estimator.md, each against the form that is printed."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_room as room
from derivatives import assert_gradient, double

from uwbslam_jax.estimator import matching, paper, ranging, state_vector
from uwbslam_jax.estimator.state_vector import Nodes
from uwbslam_jax.mapping import grid as occupancy
from uwbslam_jax.numerics.gaussian import Gaussian
from uwbslam_jax.numerics.se2 import rotation, transform_points
from uwbslam_jax.settings import Settings, UwbSettings, make_params

NODES, GAMMA = 4, 20.0
SIZE = state_vector.state_size(NODES)
"""gamma makes ranges and beams weigh alike in the robot's position. A node that only ranges see does not tell the
printed form from the mended one: there both signs cancel."""
POSITIONS = np.array([[0.11, -0.07], [0.0, 0.0], [5.0, 0.0], [1.0, 4.0]])
VELOCITIES = np.array([[0.6, 0.5], [0.0, 0.0], [0.0, 0.0], [0.02, -0.01]])
FRAME = jnp.array([1, 2], jnp.int32)


def vector(positions=POSITIONS, heading=0.3) -> jax.Array:
    return state_vector.pack(
        Nodes(jnp.asarray(positions), jnp.asarray(VELOCITIES), jnp.array(heading), jnp.array(0.1), jnp.zeros(3))
    )


@pytest.fixture
def joint() -> paper._Joint:
    """The joint objective at one level, in float64 where x64 is on: a smooth random map, beams and noisy ranges."""
    rng = np.random.default_rng(0)
    pairs = room.all_pairs(NODES)
    off = np.array([[0.3, -0.2], [0, 0], [0, 0], [0, 0]])  # the ranges want the robot elsewhere
    measured = room.ranges(pairs, room.distances(POSITIONS + off, pairs) + 0.1 * rng.normal(size=6), 8)
    params = make_params(Settings(uwb=UwbSettings(max_beacons=NODES - 1)))._replace(gamma=jnp.array(GAMMA))
    arrays = 0.3 * rng.normal(size=(40, 40)), np.full(2, -4.0), np.array(0.2), rng.uniform(-2.5, 2.5, (60, 2))
    level, origin, size, points = (jnp.asarray(x) for x in arrays)
    ranges = double(measured) if jax.config.read("jax_enable_x64") else jax.tree.map(jnp.asarray, measured)
    return paper._Joint(
        level=level,
        origin=origin,
        size=size,
        points=points,
        valid=jnp.asarray(rng.random(60) < 0.8),
        vector=vector(),
        ranges=ranges,
        usable=ranges.valid,
        free=paper.free_coordinates(jnp.ones(NODES, bool), FRAME).astype(points.dtype),
        params=double(params) if jax.config.read("jax_enable_x64") else params,
    )


def gamma_of_beams(delta, a: paper._Joint):
    """Gamma(f_i) of every beam at an offset (positions, heading)."""
    pose = jnp.stack([a.vector[0] + delta[0], a.vector[1] + delta[1], a.vector[4 * NODES] + delta[-1]])
    window = occupancy.Grid((a.level,), a.origin, jnp.zeros((1, 1)))
    return occupancy.lookup(window, transform_points(pose, a.points), float(a.size))


def plain_ranges(delta, a: paper._Joint):
    """h(p_i + D_i, p_j + D_j) = |p_i - p_j| of every pair."""
    p = a.vector[: 2 * NODES].reshape(-1, 2) + delta[:-1].reshape(-1, 2)
    u = p[a.ranges.i] - p[a.ranges.j]
    return jnp.sqrt(jnp.sum(u**2, axis=1))


def papers_sums(a: paper._Joint):
    """H and M of LiDAR and UWB as defined below eq. (delta_opt), over the coordinates that are not held."""
    zero, free = jnp.zeros(2 * NODES + 1), np.asarray(a.free) > 0
    beams, usable = np.asarray(a.valid), np.asarray(a.usable)
    G = np.asarray(jax.jacfwd(gamma_of_beams)(zero, a))[beams][:, free]
    h = np.asarray(jax.jacfwd(plain_ranges)(zero, a))[usable][:, free]
    M_lid = G.T @ (1 - np.asarray(gamma_of_beams(zero, a))[beams])
    M_uwb = h.T @ np.asarray(plain_ranges(zero, a) - a.ranges.range)[usable]
    return G.T @ G, h.T @ h, M_lid, M_uwb, free


@pytest.mark.usefixtures("x64")
def test_joint_move_has_both_signs_of_gamma_mended(joint):
    """Erratum 1: (H_lid + gamma H_uwb)^-1 (M_lid - gamma M_uwb), not the printed (H - gamma H)^-1 (M + gamma M)."""
    H_lid, H_uwb, M_lid, M_uwb, free = papers_sums(joint)
    moved = np.asarray(matching.gauss_newton(paper.joint_residual, jnp.zeros(2 * NODES + 1), joint, 1))
    want = np.linalg.solve(H_lid + GAMMA * H_uwb, M_lid - GAMMA * M_uwb)
    # the root's jitter (1e-6) and the weight of 1e-3 that holds nodes without ranges, times the condition of H
    np.testing.assert_allclose(moved[free], want, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(moved[~free], 0.0, atol=1e-12)
    printed = np.linalg.solve(H_lid - GAMMA * H_uwb, M_lid + GAMMA * M_uwb)
    assert np.abs(printed - moved[free]).max() > 0.1


@pytest.mark.usefixtures("x64")
def test_slope_and_curvature_of_the_objective_have_the_mended_signs(joint):
    H_lid, H_uwb, M_lid, M_uwb, free = papers_sums(joint)

    def J(delta):
        beams = jnp.where(joint.valid, 1 - gamma_of_beams(delta, joint), 0.0)
        pairs = jnp.where(joint.usable, plain_ranges(delta, joint) - joint.ranges.range, 0.0)
        return (jnp.sum(beams**2) + GAMMA * jnp.sum(pairs**2)) / 2

    slope = np.asarray(jax.grad(J)(jnp.zeros(2 * NODES + 1)))[free]
    np.testing.assert_allclose(-slope, M_lid - GAMMA * M_uwb, rtol=1e-9, atol=1e-9)
    assert np.abs(-slope - (M_lid + GAMMA * M_uwb)).max() > 1.0
    assert np.linalg.eigvalsh(H_lid + GAMMA * H_uwb)[0] > 0
    assert np.linalg.eigvalsh(H_lid - GAMMA * H_uwb)[0] < 0  # no minimum lies at the printed form's solution


@pytest.mark.usefixtures("x64")
def test_gradient_of_the_joint_objective_agrees_with_finite_differences(joint):
    def J(at):
        delta, state, level, points, gamma, bias = at
        a = joint._replace(vector=state, level=level, points=points)
        a = a._replace(params=joint.params._replace(gamma=gamma, bias=bias))
        return 0.5 * jnp.sum(paper.joint_residual(delta, a) ** 2)

    at = (0.01 * jnp.ones(2 * NODES + 1), joint.vector, joint.level, joint.points, jnp.array(GAMMA), joint.params.bias)
    # held coordinates weigh 1e3, so their terms are of 1e2 and the root's jitter of 1e-6 of the beams' is below
    assert_gradient(J, at, rtol=1e-5, atol=1e-4)


@pytest.mark.usefixtures("x64")
def test_without_ranges_the_joint_move_is_the_lidar_move(joint):
    """gamma = 0 degenerates to HectorSLAM's objective, as the paper says."""
    H_lid, _, M_lid, _, free = papers_sums(joint)
    only = joint._replace(params=joint.params._replace(gamma=jnp.array(0.0)))
    moved = np.asarray(matching.gauss_newton(paper.joint_residual, jnp.zeros(2 * NODES + 1), only, 1))
    pose = [0, 1, -1]
    seen = [list(np.flatnonzero(free)).index(k) for k in (0, 1, 2 * NODES)]
    want = np.linalg.solve(H_lid[np.ix_(seen, seen)], M_lid[seen])
    np.testing.assert_allclose(moved[pose], want, rtol=1e-3, atol=1e-5)  # as above
    np.testing.assert_allclose(np.delete(moved, [0, 1, 2 * NODES]), 0.0, atol=1e-9)


@pytest.mark.parametrize("turn", [0.0, 0.1, -1.0])
def test_correction_turns_the_velocity_and_keeps_the_speed(turn):
    """Erratum 2: the printed form adds |v| (cos, sin), which doubles the speed of a robot that needs no correction."""
    delta = jnp.zeros(2 * NODES + 1).at[-1].set(turn).at[0].set(0.02)
    belief = Gaussian(vector(), jnp.eye(SIZE))
    s = state_vector.unpack(paper.correct(belief, delta).mean)
    v, before = np.asarray(s.velocities[0]), VELOCITIES[0]
    np.testing.assert_allclose(np.hypot(*v), np.hypot(*before), rtol=1e-6)
    np.testing.assert_allclose(v, np.asarray(rotation(jnp.array(turn))) @ before, atol=1e-6)
    np.testing.assert_allclose(s.heading, 0.3 + turn, rtol=1e-6)
    np.testing.assert_allclose(s.positions, POSITIONS + np.array([[0.02, 0], [0, 0], [0, 0], [0, 0]]), atol=1e-6)
    np.testing.assert_array_equal(s.velocities[1:], jnp.asarray(VELOCITIES[1:]))
    printed = before + np.hypot(*before) * np.array([np.cos(turn), np.sin(turn)])
    assert abs(np.hypot(*printed) - np.hypot(*before)) > 0.2


@pytest.mark.usefixtures("x64")
def test_pinned_frame_carries_the_covariance_by_the_jacobian_of_the_gauge_map():
    """Erratum 3: I (x) R on the stacked state, and J P J^T, against samples put through the map."""
    elsewhere = POSITIONS @ np.array([[0.8, 0.6], [-0.6, 0.8]]) + np.array([3.0, -2.0])
    rng = np.random.default_rng(0)
    root = np.zeros((SIZE, SIZE))
    root[: 4 * NODES + 1, :] = 0.01 * rng.normal(size=(4 * NODES + 1, SIZE))  # small: the map is linear over it
    belief = Gaussian(vector(elsewhere), jnp.asarray(root @ root.T))
    pinned = paper.pin_frame(belief, FRAME)
    s = state_vector.unpack(pinned.mean)
    np.testing.assert_allclose(s.positions[1:3], [[0, 0], [5, 0]], atol=1e-9)
    np.testing.assert_allclose(s.positions, POSITIONS, atol=1e-9)
    # velocities turn with the same R; heading by its angle
    angle = np.arctan2(0.6, 0.8)
    R = np.array([[0.8, 0.6], [-0.6, 0.8]])
    np.testing.assert_allclose(s.heading, 0.3 - angle, atol=1e-9)
    np.testing.assert_allclose(s.velocities[np.array([0, 3])], VELOCITIES[[0, 3]] @ R.T, atol=1e-9)
    np.testing.assert_allclose(s.velocities[1:3], 0.0, atol=1e-12)
    samples = np.asarray(belief.mean) + rng.normal(size=(20_000, SIZE)) @ root.T
    mapped = np.asarray(jax.vmap(lambda x: paper.to_frame(x, FRAME))(jnp.asarray(samples)))
    # a sample covariance of 20 000 is right to 1 %; four times that
    np.testing.assert_allclose(pinned.cov, np.cov(mapped.T), atol=0.04 * float(pinned.cov.max()))
    np.testing.assert_allclose(pinned.cov[2:4], 0.0, atol=1e-15)  # the origin
    np.testing.assert_allclose(pinned.cov[5], 0.0, atol=1e-15)  # y of the beacon on +x


@pytest.mark.usefixtures("x64")
def test_heading_is_the_direction_of_motion_and_stays_at_rest():
    moving = paper.heading_from_velocity(Gaussian(vector(), jnp.eye(SIZE)))
    np.testing.assert_allclose(state_vector.unpack(moving.mean).heading, np.arctan2(0.5, 0.6), rtol=1e-9)
    s = state_vector.unpack(vector())
    still = state_vector.pack(s._replace(velocities=jnp.zeros((NODES, 2))))
    resting = paper.heading_from_velocity(Gaussian(still, jnp.eye(SIZE)))
    assert float(state_vector.unpack(resting.mean).heading) == float(s.heading)
    slope = jax.grad(
        lambda x: state_vector.unpack(paper.heading_from_velocity(Gaussian(x, jnp.eye(SIZE))).mean).heading
    )
    assert np.isfinite(slope(still)).all()


def test_prediction_is_the_papers_f_and_g():
    dt = 0.1
    params = make_params(Settings(uwb=UwbSettings(max_beacons=NODES - 1)))
    rng = np.random.default_rng(0)
    root = 0.1 * rng.normal(size=(SIZE, SIZE))
    belief = Gaussian(jnp.asarray(vector(), jnp.float32), jnp.asarray(root @ root.T, jnp.float32))
    after = paper.predict(belief, params, jnp.float32(dt))
    two = 2 * NODES
    F = np.block([[np.eye(two), dt * np.eye(two)], [np.zeros((two, two)), np.eye(two)]])
    G = np.vstack([dt * np.eye(two), np.eye(two)])
    P = (root @ root.T)[: 2 * two, : 2 * two]
    want = F @ P @ F.T + float(params.sigma_w_paper) ** 2 * G @ G.T
    np.testing.assert_allclose(after.cov[: 2 * two, : 2 * two], want, atol=1e-5)  # float32
    np.testing.assert_allclose(after.mean[: 2 * two], F @ np.asarray(belief.mean[: 2 * two]), atol=1e-6)


def test_ranges_of_the_joint_objective_are_those_of_the_range_model():
    params = make_params(Settings(uwb=UwbSettings(max_beacons=NODES - 1)))
    pairs = room.all_pairs(NODES)
    ranges = jax.tree.map(jnp.asarray, room.ranges(pairs, np.zeros(6), 8))
    predicted = ranging.predicted_ranges(vector(), ranges, params)[:6]
    np.testing.assert_allclose(predicted, room.distances(POSITIONS, pairs), rtol=1e-6)
