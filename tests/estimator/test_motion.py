"""The process model: known motions, its Jacobian and its noise."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient, double, value_and_gradient
from hypothesis import given, strategies as st
from scipy.linalg import expm

from uwbslam_jax.estimator import motion, state_vector
from uwbslam_jax.estimator.state_vector import Nodes
from uwbslam_jax.measurements import Odometry
from uwbslam_jax.numerics.gaussian import Gaussian
from uwbslam_jax.settings import Params, Settings, UwbSettings, make_params

NODES = 3
SIZE = state_vector.state_size(NODES)
NONE = Odometry(jnp.zeros(3), jnp.array(False))
RESTING = jnp.zeros(NODES, bool)
CARRIED = jnp.array([False, True, False])
UNREST = jnp.array([0.02, 0.01]) ** 2

predict, transition = jax.jit(motion.predict), jax.jit(motion.transition)


@pytest.fixture
def params() -> Params:
    return make_params(Settings(uwb=UwbSettings(max_beacons=NODES - 1)))


def state(velocity=(0.0, 0.0), heading=0.0, yaw_rate=0.0, map_error=(0.0, 0.0, 0.0), beacon_velocity=(0.0, 0.0)):
    positions = jnp.array([[1.0, 2.0], [5.0, 0.0], [-3.0, 4.0]])
    velocities = jnp.array([velocity, beacon_velocity, beacon_velocity])
    nodes = Nodes(positions, velocities, jnp.array(heading), jnp.array(yaw_rate), jnp.array(map_error))
    return state_vector.pack(nodes)


def driven(dt: float, odometry: Odometry = NONE, moving=RESTING, **start) -> Nodes:
    return state_vector.unpack(transition(state(**start), jnp.array(dt), odometry, moving))


def odometry(x: float, y: float, turn: float) -> Odometry:
    return Odometry(jnp.array([x, y, turn]), jnp.array(True))


def test_layout_packs_and_unpacks_the_same_entries():
    vector = jnp.arange(SIZE, dtype=jnp.float32)
    np.testing.assert_array_equal(state_vector.pack(state_vector.unpack(vector)), vector)
    assert state_vector.node_count(SIZE) == NODES
    s = state_vector.unpack(vector)
    np.testing.assert_array_equal(vector[jnp.array(state_vector.pose_indices(NODES))], [*s.positions[0], s.heading])
    np.testing.assert_array_equal(vector[jnp.array(state_vector.map_error_indices(NODES))], s.map_error)
    want = state_vector.robot_pose(vector) + s.map_error
    np.testing.assert_array_equal(state_vector.matched_pose_jacobian(NODES) @ vector, want)


def test_constant_velocity_over_a_short_time():
    s = driven(0.01, velocity=(0.8, -0.2), yaw_rate=0.0)
    # coasting shortens the step by dt / (2 * 1.5 s) = 0.3 %
    np.testing.assert_allclose(s.positions[0] - jnp.array([1.0, 2.0]), [0.008, -0.002], rtol=5e-3)
    np.testing.assert_allclose(s.velocities[0], [0.8, -0.2], rtol=5e-3)


def test_coordinated_turn_follows_the_circle():
    v, w, dt = 1.0, 0.5, 0.1
    s = driven(dt, velocity=(v, 0.0), yaw_rate=w)
    arc = np.array([np.sin(w * dt), 1 - np.cos(w * dt)]) * v / w
    # the chord's direction is exact, its length is coasting's (3 % of 0.1 m)
    step = np.asarray(s.positions[0]) - [1.0, 2.0]
    np.testing.assert_allclose(np.arctan2(step[1], step[0]), np.arctan2(arc[1], arc[0]), rtol=0.05)
    np.testing.assert_allclose(step, arc, rtol=0.08)
    # the velocity turns with the robot and keeps its direction against the heading
    np.testing.assert_allclose(np.arctan2(s.velocities[0][1], s.velocities[0][0]), s.heading, atol=1e-6)


def test_a_robot_that_is_not_seen_comes_to_rest_within_its_coasting_distance():
    far, farther = driven(20.0, velocity=(1.0, 0.0)), driven(200.0, velocity=(1.0, 0.0))
    np.testing.assert_allclose(far.positions[0], [2.5, 2.0], atol=1e-4)  # 1.5 s of coasting, e^-13 from its end
    np.testing.assert_allclose(farther.positions[0], far.positions[0], atol=1e-4)


def test_odometry_moves_the_robot_by_its_increment_in_the_robots_own_frame():
    s = driven(0.1, odometry(0.1, 0.02, 0.05), heading=np.pi / 2, velocity=(0.2, 0.8), yaw_rate=0.3)
    # at a heading of 90 degrees, forward is +y and left is -x
    np.testing.assert_allclose(s.positions[0], [1.0 - 0.02, 2.0 + 0.1], atol=1e-6)
    np.testing.assert_allclose(s.heading, np.pi / 2 + 0.05, rtol=1e-6)
    np.testing.assert_allclose(s.velocities[0], [-0.2, 1.0], atol=1e-5)
    np.testing.assert_allclose(s.yaw_rate, 0.5, rtol=1e-5)


@pytest.mark.parametrize("dt", [0.0, 0.0025])
def test_an_increment_whose_stamps_came_late_moves_the_robot_but_makes_it_no_racer(dt):
    """0.17 m and 15 degrees in 2.5 ms: a logger that wrote two scans at once."""
    s = driven(dt, odometry(0.17, 0.0, 0.26), velocity=(0.3, 0.0), yaw_rate=0.1)
    np.testing.assert_allclose(s.positions[0], [1.17, 2.0], atol=1e-6)
    np.testing.assert_allclose(s.heading, 0.26, rtol=1e-6)
    # at most 5 m/s^2 and 15 rad/s^2
    np.testing.assert_allclose(s.velocities[0], [0.3 + 5.0 * dt, 0.0], atol=1e-6)
    np.testing.assert_allclose(s.yaw_rate, 0.1 + 15.0 * dt, atol=1e-6)


def test_only_carried_beacons_move():
    s = driven(0.01, moving=CARRIED, beacon_velocity=(1.0, 0.5))
    np.testing.assert_allclose(s.positions[1], [5.01, 0.005], rtol=5e-3)  # coasting, as above
    np.testing.assert_array_equal(s.positions[2], [-3.0, 4.0])
    np.testing.assert_array_equal(s.velocities[2], [0.0, 0.0])


def test_map_error_is_a_rigid_motion_that_a_later_pose_sees_through_its_lever_arm():
    """A map turned by a small angle about the start shows the robot off by angle x distance driven."""
    start = dict(map_error=(0.0, 0.0, 0.01), heading=0.0)
    s = driven(0.1, odometry(2.0, 0.0, 0.0), **start)
    turned = 2.0 * np.array([np.cos(0.01) - 1, np.sin(0.01)])
    np.testing.assert_allclose(s.map_error, [*turned, 0.01], atol=2e-4)  # second order: 2 m * 0.01^2 / 2


def test_time_zero_is_no_motion_and_finite(params):
    belief = Gaussian(state(velocity=(1.0, 0.0), yaw_rate=1.0), jnp.eye(SIZE))
    after = predict(belief, params, jnp.array(0.0), NONE, RESTING, UNREST)
    np.testing.assert_allclose(after.mean, belief.mean, atol=1e-6)
    assert np.isfinite(after.cov).all()


def test_white_acceleration_noise_is_that_of_the_exact_discretisation(params):
    """Q of [position, velocity] under white acceleration by Van Loan's matrix exponential, per axis."""
    dt = 0.1
    q = float(params.sigma_w) ** 2
    A, G = np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, q])
    block = expm(dt * np.block([[-A, G], [np.zeros((2, 2)), A.T]]))
    want = block[2:, 2:].T @ block[:2, 2:]
    diagonal, coupling = motion.process_noise(params, jnp.array(dt), NONE, RESTING)
    got = np.array([[diagonal[0], coupling[0]], [coupling[0], diagonal[2 * NODES]]])
    np.testing.assert_allclose(got, want, rtol=1e-5)  # float32


@pytest.mark.parametrize("measured", [NONE, odometry(0.2, 0.0, 0.3)], ids=["no odometry", "odometry"])
@given(st.floats(0.0, 30.0))
def test_predicted_covariance_is_symmetric_and_not_negative(measured, dt):
    params = make_params(Settings(uwb=UwbSettings(max_beacons=NODES - 1)))
    belief = Gaussian(state(velocity=(1.0, 0.3), yaw_rate=0.5), 1e-4 * jnp.eye(SIZE))
    after = predict(belief, params, jnp.float32(dt), measured, CARRIED, UNREST)
    P = np.asarray(after.cov, float)
    np.testing.assert_array_equal(P, P.T)
    scale = np.sqrt(np.diag(P))
    assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > -1e-6  # float32


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("measured", [None, (0.3, -0.1, 0.2)], ids=["no odometry", "odometry"])
def test_covariance_is_carried_by_the_jacobian_of_the_transition(params, measured):
    """F P F^T + Q with F by central differences of the transition."""
    params, dt = double(params), jnp.array(0.2)
    odometry = Odometry(jnp.array(measured or (0.0, 0.0, 0.0)), jnp.array(measured is not None))
    x = double(state(velocity=(0.8, 0.3), heading=0.4, yaw_rate=0.3, map_error=(0.01, 0.02, 0.003)))
    rng = np.random.default_rng(0)
    root = 0.1 * rng.normal(size=(SIZE, SIZE))
    F = np.stack(
        [
            (transition(x + h, dt, odometry, CARRIED) - transition(x - h, dt, odometry, CARRIED)) / 2e-6
            for h in 1e-6 * jnp.eye(SIZE)
        ],
        axis=1,
    )
    zero = Gaussian(x, jnp.zeros((SIZE, SIZE)))
    Q = predict(zero, params, dt, odometry, CARRIED, UNREST).cov
    belief = Gaussian(x, jnp.asarray(root @ root.T))
    after = predict(belief, params, dt, odometry, CARRIED, UNREST)
    np.testing.assert_allclose(after.cov - Q, F @ (root @ root.T) @ F.T, atol=1e-8)  # of a central difference


def test_motion_that_no_velocity_explains_widens_the_pose_and_nothing_else(params):
    belief = Gaussian(state(velocity=(0.8, 0.3)), 1e-4 * jnp.eye(SIZE))
    calm = predict(belief, params, jnp.array(0.1), NONE, RESTING, jnp.zeros(2))
    restless = predict(belief, params, jnp.array(0.1), NONE, RESTING, jnp.array([0.04, 0.01]))
    want = np.zeros(SIZE)
    want[np.array(state_vector.pose_indices(NODES))] = 0.04, 0.04, 0.01
    np.testing.assert_allclose(restless.cov - calm.cov, np.diag(want), atol=1e-8)  # float32
    np.testing.assert_array_equal(restless.mean, calm.mean)
    # an increment of the odometry is the motion: nothing is unexplained
    wheels = odometry(0.1, 0.0, 0.0)
    a, b = (predict(belief, params, jnp.array(0.1), wheels, RESTING, u) for u in (want[:2], 0 * want[:2]))
    np.testing.assert_array_equal(a.cov, b.cov)


def test_a_robot_not_seen_for_long_is_no_less_certain_than_a_robot_can_be(params):
    belief = Gaussian(state(velocity=(0.8, 0.3), yaw_rate=0.5), 1e-4 * jnp.eye(SIZE))
    for _ in range(20):
        belief = predict(belief, params, jnp.array(1.0), NONE, RESTING, UNREST)
    std = np.sqrt(np.diag(belief.cov))
    heading = 4 * NODES
    # the fastest: 1.5 m/s, 2 rad/s, and 2 rad is any heading
    np.testing.assert_allclose(std[[2 * NODES, 2 * NODES + 1, heading, heading + 1]], [1.5, 1.5, 2.0, 2.0], rtol=1e-5)
    assert np.linalg.eigvalsh(belief.cov / np.outer(std, std)).min() > -1e-6  # float32


def test_a_map_errs_by_no_more_than_it_can_and_its_covariance_stays_positive(params):
    at = np.array(state_vector.map_error_indices(NODES))
    cov = np.eye(SIZE, dtype=np.float32) * 1e-4
    cov[at, at] = 1e4
    after = predict(Gaussian(state(), jnp.asarray(cov)), params, jnp.array(0.1), NONE, RESTING, UNREST)
    spread = np.sqrt(np.diag(np.asarray(after.cov, float))[at])
    np.testing.assert_allclose(spread, [5.0, 5.0, 1.0], rtol=1e-3)
    assert np.linalg.eigvalsh(np.asarray(after.cov, float))[0] > 0


def test_the_map_of_a_robot_at_rest_errs_as_before_however_long_it_stands(params):
    """It changes where something is drawn or other ground is seen (trust), not with time."""
    rows = np.array(state_vector.map_error_indices(NODES))
    belief = Gaussian(state(map_error=(0.3, 0.2, 0.01)), 1e-4 * jnp.eye(SIZE))
    still = odometry(0.0, 0.0, 0.0)
    after = predict(belief, params, jnp.array(10.0), still, RESTING, UNREST)
    np.testing.assert_array_equal(after.mean[rows], belief.mean[rows])
    np.testing.assert_allclose(np.diag(after.cov)[rows], 1e-4, rtol=1e-5)  # float32


def weighted(at, params, cov, weights, measured):
    """A sum over what is predicted, with weights, of the things by which it is to be differentiated."""
    mean, sigma_w, dt, increment = at
    changed = params._replace(sigma_w=sigma_w)
    after = predict(Gaussian(mean, cov), changed, dt, Odometry(increment, measured), CARRIED, UNREST)
    return weights @ after.mean + jnp.sum(after.cov * jnp.outer(weights, weights))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("measured", [None, (0.3, -0.1, 0.2)], ids=["no odometry", "odometry"])
def test_gradient_of_a_prediction_agrees_with_finite_differences(params, measured):
    params = double(params)
    rng = np.random.default_rng(0)
    root = jnp.asarray(0.1 * rng.normal(size=(SIZE, SIZE)))
    x = double(state(velocity=(0.8, 0.3), heading=0.4, yaw_rate=0.3, map_error=(0.01, 0.02, 0.003)))
    weights = jnp.asarray(rng.normal(size=SIZE))
    at = (x, params.sigma_w, jnp.array(0.2), jnp.array(measured or (0.0, 0.0, 0.0)))
    assert_gradient(weighted, at, params, root @ root.T, weights, jnp.array(measured is not None))


@pytest.mark.usefixtures("x64")
def test_gradient_at_rest_without_odometry_is_finite(params):
    params = double(params)
    at = (double(state()), params.sigma_w, jnp.array(0.1), jnp.zeros(3))
    gradient = value_and_gradient(weighted)(at, params, jnp.eye(SIZE), jnp.ones(SIZE), jnp.array(False))[1]
    assert all(np.isfinite(leaf).all() for leaf in gradient)
