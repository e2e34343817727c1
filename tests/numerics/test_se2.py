"""SE(2) against homogeneous matrices, its group axioms, and the gauge map with its covariance."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient
from hypothesis import given, strategies as st

from uwbslam_jax.numerics import se2

ROUNDING = 2e-5
"""Float32 angles of 8 rad are right to 2.4e-7, which turns 30 m by 7e-6 m; a few such steps. [m], [rad]"""

lengths = st.floats(-10, 10, width=32)
angles = st.floats(-4, 4, width=32)
tiny = st.floats(-(2.0**-20), 2.0**-20, width=32)
poses = st.tuples(lengths, lengths, angles) | st.tuples(tiny, tiny, tiny)


def pose(values) -> jax.Array:
    return jnp.array(values, jnp.float32)


def matrix(pose) -> np.ndarray:
    x, y, theta = np.asarray(pose, float)
    return np.array([[np.cos(theta), -np.sin(theta), x], [np.sin(theta), np.cos(theta), y], [0, 0, 1]])


def assert_same_pose(a, b) -> None:
    np.testing.assert_allclose(matrix(a), matrix(b), atol=ROUNDING)


@given(poses, poses)
def test_compose_is_the_product_of_homogeneous_matrices(a, b):
    np.testing.assert_allclose(matrix(se2.compose(pose(a), pose(b))), matrix(a) @ matrix(b), atol=ROUNDING)


@given(poses, poses, poses)
def test_compose_is_associative(a, b, c):
    a, b, c = pose(a), pose(b), pose(c)
    left = se2.compose(se2.compose(a, b), c)
    assert_same_pose(left, se2.compose(a, se2.compose(b, c)))


@given(poses)
def test_identity_and_inverse(a):
    a, zero = pose(a), jnp.zeros(3)
    assert_same_pose(se2.compose(a, zero), a)
    assert_same_pose(se2.compose(zero, a), a)
    assert_same_pose(se2.compose(a, se2.inverse(a)), zero)
    assert_same_pose(se2.compose(se2.inverse(a), a), zero)
    np.testing.assert_allclose(matrix(se2.inverse(a)), np.linalg.inv(matrix(a)), atol=ROUNDING)


@given(poses, poses)
def test_between_undoes_compose(a, b):
    a, b = pose(a), pose(b)
    assert_same_pose(se2.compose(a, se2.between(a, b)), b)


@given(poses, st.lists(st.tuples(lengths, lengths), min_size=1, max_size=1))
def test_transform_points_is_the_homogeneous_product(a, points):
    want = (matrix(a) @ np.append(points[0], 1.0))[:2]
    moved = se2.transform_points(pose(a), jnp.array(points, jnp.float32))
    np.testing.assert_allclose(moved[0], want, atol=ROUNDING)


@given(st.floats(-100, 100, width=32))
def test_wrapped_angle_is_the_same_angle_within_half_a_turn(angle):
    wrapped = float(se2.wrap_angle(jnp.float32(angle)))
    slack = 1e-5  # rounding of an angle of 100 rad in float32
    assert -np.pi - slack <= wrapped <= np.pi + slack
    np.testing.assert_allclose([np.cos(wrapped), np.sin(wrapped)], [np.cos(angle), np.sin(angle)], atol=slack)


def test_wrap_angle_of_known_angles():
    wrapped = se2.wrap_angle(jnp.array([0.0, 3.0, -3.0, 4.0, -4.0]))
    turn = 2 * np.pi
    np.testing.assert_allclose(wrapped, [0.0, 3.0, -3.0, 4.0 - turn, turn - 4.0], atol=1e-6)  # float32


@pytest.mark.usefixtures("x64")
def test_half_a_turn_wraps_to_the_lower_end():
    np.testing.assert_array_equal(se2.wrap_angle(jnp.array([np.pi, -np.pi, 3 * np.pi])), -np.pi * np.ones(3))


def test_wrap_angle_has_slope_one():
    slope = jax.vmap(jax.grad(se2.wrap_angle))(jnp.array([-7.0, -0.5, 0.0, 2.0, 50.0]))
    np.testing.assert_array_equal(slope, np.ones(5))


@given(st.tuples(lengths, lengths))
def test_safe_norm_is_the_length(vector):
    # squares below the smallest float32 count as zero
    length = se2.safe_norm(jnp.array(vector, jnp.float32))
    np.testing.assert_allclose(length, np.hypot(*vector), rtol=1e-6, atol=1e-18)


def test_safe_norm_of_zero_has_gradient_zero():
    vectors = jnp.array([[0.0, 0.0], [3.0, -4.0]])
    value, pull = jax.vjp(se2.safe_norm, vectors)
    np.testing.assert_allclose(value, [0.0, 5.0], rtol=1e-6)
    np.testing.assert_allclose(pull(jnp.ones(2))[0], [[0.0, 0.0], [0.6, -0.8]], rtol=1e-6)
    np.testing.assert_allclose(jax.jvp(se2.safe_norm, (vectors,), (jnp.ones((2, 2)),))[1], [0.0, -0.2], rtol=1e-5)


def test_perpendicular_is_the_derivative_of_a_rotation():
    vector = jnp.array([1.5, -0.7])
    slope = jax.jacfwd(lambda theta: se2.rotation(theta) @ vector)(0.0)
    np.testing.assert_allclose(se2.perpendicular(vector), slope, atol=1e-7)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("scale", [1.0, 1e-9], ids=["anywhere", "near identity"])
def test_gradients_agree_with_finite_differences(scale):
    rng = np.random.default_rng(0)
    a, b = jnp.asarray(scale * rng.normal(size=(2, 3)))
    weights = jnp.asarray(rng.normal(size=3))
    for function in (se2.compose, se2.between):
        assert_gradient(lambda x, f=function: weights @ f(x[0], x[1]), (a, b))
    assert_gradient(lambda x: weights @ se2.inverse(x), a)
    points = jnp.asarray(rng.normal(size=(5, 2)))
    assert_gradient(lambda x: jnp.sum(se2.transform_points(*x) ** 2), (a, points))
    assert_gradient(lambda x: jnp.sum(se2.safe_norm(x)), points)
    assert_gradient(lambda x: weights @ se2.gauge_pose(x[0], x[1]), points)


# The gauge map of the paper's "Elimination of location ambiguities" (erratum 3).


def published(vector, origin=1, along=2):
    """The stacked positions (2 K,) after the gauge map."""
    points = vector.reshape(-1, 2)
    motion = se2.gauge_pose(points[origin], points[along])
    return se2.transform_points(motion, points).ravel()


@given(st.tuples(lengths, lengths), st.tuples(lengths, lengths))
def test_gauge_puts_one_point_at_the_origin_and_another_on_the_x_axis(first, second):
    a, b = pose(first), pose(second)
    apart = np.hypot(*(np.array(second) - first))
    motion = se2.gauge_pose(a, b)
    moved = se2.transform_points(motion, jnp.stack([a, b]))
    np.testing.assert_allclose(moved, [[0, 0], [apart, 0]], atol=2 * ROUNDING)


def test_gauge_does_not_depend_on_the_frame_that_the_points_come_in():
    points = jnp.array([[0.3, 0.4], [1.0, 2.0], [-3.0, 0.5], [2.5, -1.0]])
    elsewhere = se2.transform_points(jnp.array([5.0, -7.0, 2.2]), points)
    np.testing.assert_allclose(published(elsewhere.ravel()), published(points.ravel()), atol=ROUNDING)


def test_rotation_of_a_stacked_state_is_identity_kron_rotation_and_not_the_printed_form():
    points = jnp.array([[0.3, 0.4], [1.0, 2.0], [-3.0, 0.5]])
    motion = se2.gauge_pose(points[1], points[2])
    R = np.asarray(se2.rotation(motion[2]))
    shift = np.tile(motion[:2], 3)
    np.testing.assert_allclose(np.kron(np.eye(3), R) @ points.ravel() + shift, published(points.ravel()), atol=1e-6)
    # the printed R (x) I_2 even has the wrong size for three nodes; for two it mixes x with y of different nodes
    pair = points[1:].ravel()
    moved = published(pair, 0, 1)
    np.testing.assert_allclose(np.kron(np.eye(2), R) @ pair + shift[:4], moved, atol=1e-6)
    assert np.abs(np.kron(R, np.eye(2)) @ pair + shift[:4] - moved).max() > 1.0


@pytest.mark.usefixtures("x64")
def test_covariance_carried_by_the_jacobian_of_the_gauge_map_is_that_of_mapped_samples():
    rng = np.random.default_rng(1)
    points = jnp.array([[0.3, 0.4], [1.0, 2.0], [-3.0, 0.5], [2.5, -1.0]]).ravel()
    root = 0.01 * rng.normal(size=(8, 8))  # small against the distances, so that the map is linear over the samples
    samples = np.asarray(points) + rng.normal(size=(20_000, 8)) @ root.T
    mapped = np.asarray(jax.vmap(published)(jnp.asarray(samples)))
    J = np.asarray(jax.jacfwd(published)(points))
    cov = J @ (root @ root.T) @ J.T
    # a sample covariance of 20 000 is right to 1 % (1 / sqrt(10 000)); four times that
    np.testing.assert_allclose(np.cov(mapped.T), cov, atol=0.04 * cov.max())
    np.testing.assert_allclose(cov[2:4], 0.0, atol=1e-18)  # the origin is no longer uncertain
    np.testing.assert_allclose(cov[5], 0.0, atol=1e-18)  # nor is the other beacon's y
    # turning the covariance alone, as if the frame did not depend on the beacons, is a different matter
    R = np.kron(np.eye(4), np.asarray(se2.rotation(se2.gauge_pose(points[2:4], points[4:6])[2])))
    assert np.abs(R @ (root @ root.T) @ R.T - cov).max() > 0.3 * cov.max()
