"""The residual blocks against the paper's sums over beams, and their derivatives."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient, double

from uwbslam_jax.estimator import lidar_objective, matching
from uwbslam_jax.mapping import grid as occupancy
from uwbslam_jax.numerics.se2 import transform_points

CELLS, SIZE, BEAMS = 40, 0.2, 60

JITTER = 2e-6
"""The root of the Gram matrix adds 1e-6 to its unit diagonal, to be safe where no beam has a gradient."""


@pytest.fixture
def case():
    """Pose, level, origin, points and which of them are valid, in float64 where x64 is on."""
    rng = np.random.default_rng(0)
    smooth = rng.normal(size=(CELLS, CELLS))
    points = rng.uniform(-2.5, 2.5, (BEAMS, 2))
    valid = rng.random(BEAMS) < 0.8
    pose = np.array([0.11, -0.07, 0.3])
    origin = np.full(2, -CELLS * SIZE / 2)
    return tuple(jnp.asarray(x) for x in (pose, smooth, origin, points, valid))


@jax.jit
def residuals(pose, level, origin, points, valid):
    """1 - Gamma of each beam by itself, 0 where it did not return: the first term of eq. (opt)."""
    window = occupancy.Grid((level,), origin, jnp.zeros((1, 1)))
    return jnp.where(valid, 1.0 - occupancy.lookup(window, transform_points(pose, points), SIZE), 0.0)


@jax.jit
def lidar(pose, level, origin, points, valid):
    return lidar_objective.lidar_residual(pose, level, origin, SIZE, points, valid)


residual_jacobian, lidar_jacobian = jax.jit(jax.jacfwd(residuals)), jax.jit(jax.jacfwd(lidar))


@pytest.mark.usefixtures("x64")
def test_gram_matrix_holds_the_papers_sums(case):
    pose, *rest = case
    r = residuals(pose, *rest)
    J = residual_jacobian(pose, *rest)
    level, origin, points, valid = rest
    G = jax.jit(lidar_objective.lidar_gram)(pose, level, origin, SIZE, points, valid)
    # H^(LiD), -M^(LiD) and twice the LiDAR term; float64
    np.testing.assert_allclose(G[:3, :3], J.T @ J, rtol=1e-10)
    np.testing.assert_allclose(G[:3, 3], J.T @ r, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(G[3, 3], r @ r, rtol=1e-12)


@pytest.mark.usefixtures("x64")
def test_four_rows_stand_for_all_beams_in_value_gradient_and_normal_equations(case):
    pose, *rest = case
    r, J = residuals(pose, *rest), residual_jacobian(pose, *rest)
    short, short_J = lidar(pose, *rest), lidar_jacobian(pose, *rest)
    assert short.shape == (4,)
    np.testing.assert_allclose(short @ short, r @ r, rtol=JITTER)
    np.testing.assert_allclose(short_J.T @ short, J.T @ r, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(short_J.T @ short_J, J.T @ J, rtol=1e-4, atol=JITTER * np.abs(J.T @ J).max())


@pytest.mark.usefixtures("x64")
def test_gradient_of_the_lidar_term_agrees_with_finite_differences(case):
    """1/2 sum (1 - Gamma)^2 with respect to pose, map and points."""
    *at, valid = case
    gradient = assert_gradient(
        lambda x: 0.5 * jnp.sum(lidar(x[0], x[1], x[2], x[3], valid) ** 2), tuple(at[:3] + at[3:]), rtol=1e-5
    )
    direct = jax.jit(jax.grad(lambda x: 0.5 * jnp.sum(residuals(*x, valid) ** 2)))(tuple(at))
    for got, want in zip(gradient, direct, strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-8)
    np.testing.assert_array_equal(gradient[3][~np.asarray(valid)], 0.0)


@pytest.mark.usefixtures("x64")
def test_gradient_of_the_objective_with_prior_agrees_with_finite_differences(case):
    pose, level, origin, points, valid = case
    rng = np.random.default_rng(1)
    root = jnp.asarray(rng.normal(size=(3, 3)))

    def J(at):
        pose, level, points, mean, root, sigma_l = at
        beams = lidar(pose, level, origin, points, valid) / sigma_l
        prior = lidar_objective.prior_residual(pose, mean, root)
        return 0.5 * (beams @ beams + prior @ prior)

    # the jitter of the root on terms of a few hundred that cancel
    assert_gradient(J, (pose, level, points, pose + 0.1, root, jnp.array(0.25)), atol=500 * JITTER)


@pytest.mark.usefixtures("x64")
def test_prior_residual_whitens():
    rng = np.random.default_rng(2)
    A = rng.normal(size=(3, 3))
    P, delta, mean = A @ A.T + np.eye(3), rng.normal(size=3), rng.normal(size=3)
    root = np.linalg.cholesky(np.linalg.inv(P)).T
    r = lidar_objective.prior_residual(*map(jnp.asarray, (delta, mean, root)))
    np.testing.assert_allclose(r @ r, (delta - mean) @ np.linalg.solve(P, delta - mean), rtol=1e-10)


@pytest.mark.parametrize("what", ["no beams", "unknown map", "outside"])
def test_nothing_to_match_is_finite_in_value_and_gradient(case, what):
    *at, valid = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype != bool else x, case)
    pose, level, origin, points = at
    if what == "no beams":
        valid = jnp.zeros_like(valid)
    elif what == "unknown map":
        level = jnp.zeros_like(level)
    else:
        origin = origin + 1000.0
    J = lidar_jacobian(pose, level, origin, points, valid)
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(lidar(x[0], x[1], origin, x[2], valid) ** 2)))((pose, level, points))
    assert np.isfinite(J).all()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    np.testing.assert_allclose(gradient[0], 0.0, atol=1e-6)


@pytest.mark.usefixtures("x64")
def test_one_move_without_ranges_and_prior_is_hectorslams(case):
    """H^-1 sum J^T (1 - Gamma), eq. (12) of HectorSLAM: the joint objective with gamma = 0."""
    pose, level, origin, points, valid = case
    # a prior too wide to matter
    args = matching._LidarAndPrior(
        level, origin, jnp.array(SIZE), points, valid, pose, 1e-9 * jnp.eye(3), jnp.array(1.0), jnp.eye(2)
    )
    moved = matching.gauss_newton(matching._residual, pose, args, 1)
    slope = -residual_jacobian(pose, level, origin, points, valid)  # gradient of Gamma
    H = slope.T @ slope
    M = slope.T @ residuals(pose, level, origin, points, valid)
    step = np.linalg.solve(H, M)
    np.testing.assert_allclose(moved - pose, step, rtol=1e-4)  # the jitter of the root, times the condition of H


@pytest.mark.usefixtures("x64")
def test_one_move_with_a_prior_solves_the_normal_equations(case):
    pose, level, origin, points, valid = case
    root, mean, sigma_l = 5.0 * jnp.eye(3), double(pose + jnp.array([0.05, -0.02, 0.01])), jnp.array(0.25)
    args = matching._LidarAndPrior(level, origin, jnp.array(SIZE), points, valid, mean, root, sigma_l, jnp.eye(2))
    moved = matching.gauss_newton(matching._residual, pose, args, 1)
    slope = -residual_jacobian(pose, level, origin, points, valid) / sigma_l
    r = residuals(pose, level, origin, points, valid) / sigma_l
    step = np.linalg.solve(slope.T @ slope + root.T @ root, slope.T @ r - root.T @ root @ (pose - mean))
    np.testing.assert_allclose(moved - pose, step, rtol=1e-4, atol=1e-7)
