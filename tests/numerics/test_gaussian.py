"""The belief's update against the textbook filter in numpy, and its health over many float32 updates."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import assert_gradient
from hypothesis import given, strategies as st
from scipy.stats import multivariate_normal

from uwbslam_jax.numerics import gaussian
from uwbslam_jax.numerics.gaussian import Gaussian


def random_case(seed: int, n: int = 6, m: int = 9):
    """Prior mean and covariance, Jacobian, noise variances and innovation."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-2, 1, size=(n, 1))
    return rng.normal(size=n), root @ root.T, rng.normal(size=(m, n)), rng.uniform(0.01, 1.0, m), rng.normal(size=m)


def textbook(mean, cov, H, R, innovation):
    """x + K nu and the Joseph form of the covariance with K = P H^T (H P H^T + R)^-1, in float64."""
    K = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + np.diag(R))
    A = np.eye(len(mean)) - K @ H
    return mean + K @ innovation, A @ cov @ A.T + K @ np.diag(R) @ K.T


def information_form(H, R, innovation):
    return H.T @ (H / R[:, None]), H.T @ (innovation / R)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("seed", range(5))
def test_information_update_is_the_textbook_kalman_update(seed):
    mean, cov, H, R, innovation = random_case(seed)
    want_mean, want_cov = textbook(mean, cov, H, R, innovation)
    after = gaussian.update_information(
        Gaussian(jnp.asarray(mean), jnp.asarray(cov)), *map(jnp.asarray, information_form(H, R, innovation))
    )
    # float64 with condition numbers up to 1e6
    np.testing.assert_allclose(after.mean, want_mean, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(after.cov, want_cov, rtol=1e-6, atol=1e-9)


@pytest.mark.usefixtures("x64")
def test_linear_system_gives_the_kalman_filter_sequence():
    rng = np.random.default_rng(3)
    F, Q = np.array([[1.0, 0.1], [0.0, 1.0]]), np.diag([1e-4, 1e-2])
    H, R = np.array([[1.0, 0.0]]), np.array([0.04])
    mean, cov = np.zeros(2), np.eye(2)
    belief = Gaussian(jnp.asarray(mean), jnp.asarray(cov))
    for _ in range(30):
        z = rng.normal(size=1)
        mean, cov = F @ mean, F @ cov @ F.T + Q
        belief = gaussian.predict(belief, jnp.asarray(F) @ belief.mean, jnp.asarray(F), jnp.asarray(Q))
        mean, cov = textbook(mean, cov, H, R, z - H @ mean)
        information, gradient = information_form(H, R, z - H @ np.asarray(belief.mean))
        belief = gaussian.update_information(belief, jnp.asarray(information), jnp.asarray(gradient))
    np.testing.assert_allclose(belief.mean, mean, rtol=1e-9)
    np.testing.assert_allclose(belief.cov, cov, rtol=1e-9)


@given(st.integers(0, 10_000))
def test_update_keeps_float32_covariance_symmetric_and_positive_definite(seed):
    mean, cov, H, R, innovation = random_case(seed)
    as32 = [jnp.asarray(x, jnp.float32) for x in (mean, cov, *information_form(H, R, innovation))]
    after = gaussian.update_information(Gaussian(*as32[:2]), *as32[2:])
    P = np.asarray(after.cov, float)
    scale = np.sqrt(np.diag(P))
    np.testing.assert_allclose(P / np.outer(scale, scale), P.T / np.outer(scale, scale), atol=1e-6)  # a float32 ulp
    assert np.linalg.eigvalsh((P + P.T) / np.outer(scale, scale)).min() > 0


def test_no_information_changes_nothing():
    mean, cov, *_ = random_case(0)
    belief = Gaussian(jnp.asarray(mean, jnp.float32), jnp.asarray(cov, jnp.float32))
    after = gaussian.update_information(belief, jnp.zeros((6, 6)), jnp.zeros(6))
    np.testing.assert_array_equal(after.mean, belief.mean)
    scale = np.sqrt(np.diag(cov))
    # the square root adds 8 eps n = 6e-6 to the unit diagonal
    np.testing.assert_allclose(after.cov / np.outer(scale, scale), cov / np.outer(scale, scale), atol=1e-5)


def test_a_state_known_exactly_stays_known_and_spoils_no_other():
    cov = np.diag([0.0, 1.0, 4.0])
    H = np.array([[1.0, 1.0, 0.0]])
    information, gradient = information_form(H, np.array([0.25]), np.array([2.0]))
    belief = Gaussian(jnp.zeros(3), jnp.asarray(cov, jnp.float32))
    after = gaussian.update_information(
        belief, jnp.asarray(information, jnp.float32), jnp.asarray(gradient, jnp.float32)
    )
    # by hand: the innovation of 2 is all the second state's; gain 1 / 1.25
    np.testing.assert_allclose(after.mean, [0.0, 1.6, 0.0], atol=1e-5)
    np.testing.assert_allclose(after.cov, np.diag([0.0, 0.2, 4.0]), atol=3e-5)  # 8 eps n of the largest


def test_symmetric_root_squares_to_the_covariance_over_twelve_decades():
    std = np.array([1e-5, 1e-3, 1.0, 1e1])
    rng = np.random.default_rng(0)
    A = rng.normal(size=(4, 8))
    correlation = np.corrcoef(A)
    cov = correlation * np.outer(std, std)
    L = np.asarray(gaussian.symmetric_root(jnp.asarray(cov, jnp.float32)), float)
    np.testing.assert_allclose(L @ L.T / np.outer(std, std), correlation, atol=1e-5)  # 8 eps n = 4e-6


def test_ten_thousand_float32_updates_keep_the_covariance_healthy_and_near_that_of_float64():
    """A robot that drives in a circle is ranged from three points: constant velocity, updates 10 times a second."""
    anchors, dt, variance = np.array([[5.0, 0.0], [-4.0, 3.0], [0.0, -6.0]]), 0.1, 0.01
    F = np.eye(4) + dt * np.eye(4, k=2)
    Q = np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(2)) * 0.1

    def jacobian(p, xp):
        u = p[None] - xp.asarray(anchors, p.dtype)
        d = xp.sqrt((u**2).sum(1))
        return xp.concatenate([u / d[:, None], 0 * u], axis=1), d

    def place(k, xp):
        return xp.stack([3 * xp.cos(0.01 * k), 3 * xp.sin(0.01 * k)])

    def step(belief, k):
        F32, Q32 = jnp.asarray(F, jnp.float32), jnp.asarray(Q, jnp.float32)
        belief = gaussian.predict(belief, F32 @ belief.mean, F32, Q32)
        H, h = jacobian(belief.mean[:2], jnp)
        truth = jnp.sqrt(jnp.sum((place(k, jnp)[None] - jnp.asarray(anchors, jnp.float32)) ** 2, axis=1))
        belief = gaussian.update_information(belief, H.T @ H / variance, H.T @ (truth - h) / variance)
        P = belief.cov
        spread = jnp.sqrt(jnp.diagonal(P))
        correlation = P / (spread[:, None] * spread[None, :])
        return belief, (jnp.abs(correlation - correlation.T).max(), jnp.linalg.eigvalsh(correlation)[0])

    start = Gaussian(jnp.array([3.0, 0.0, 0.0, 0.3]), jnp.eye(4))
    steps = np.arange(1, 10_001, dtype=np.float32)
    last, (skew, smallest) = jax.jit(lambda b: jax.lax.scan(step, b, steps))(start)
    assert float(skew.max()) < 1e-6  # a float32 ulp
    assert float(smallest.min()) > 1e-3
    mean, cov = np.array([3.0, 0.0, 0.0, 0.3]), np.eye(4)
    for k in steps:
        mean, cov = F @ mean, F @ cov @ F.T + Q
        H, h = jacobian(mean[:2], np)
        truth = np.sqrt(((place(float(k), np) - anchors) ** 2).sum(1))
        mean, cov = textbook(mean, cov, H, np.full(3, variance), truth - h)
    np.testing.assert_allclose(last.mean, mean, atol=1e-4)  # place() itself turns 100 rad in float32
    scale = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(last.cov / np.outer(scale, scale), cov / np.outer(scale, scale), atol=1e-3)


def test_log_likelihood_is_that_of_scipy():
    _, cov, _, _, _ = random_case(1, n=4)
    innovation = np.array([0.1, -2.0, 0.5, 1.0])
    want = multivariate_normal.logpdf(innovation, cov=cov)
    got = gaussian.log_likelihood(jnp.asarray(innovation, jnp.float32), jnp.asarray(cov, jnp.float32))
    np.testing.assert_allclose(got, want, rtol=1e-3)  # float32, condition number 1e5


def test_nees_is_the_squared_mahalanobis_distance():
    cov = np.array([[4.0, 1.0], [1.0, 2.0]])
    error = np.array([1.0, -3.0])
    want = error @ np.linalg.solve(cov, error)
    np.testing.assert_allclose(gaussian.nees(jnp.asarray(error), jnp.asarray(cov)), want, rtol=1e-5)  # float32


@pytest.mark.usefixtures("x64")
def test_gradient_of_an_update_agrees_with_finite_differences():
    mean, cov, H, R, innovation = random_case(2, n=4, m=5)
    cov = cov / np.abs(cov).max() + 0.1 * np.eye(4)

    def value(x):
        root, H, innovation = x
        P = root @ root.T
        after = gaussian.update_information(Gaussian(jnp.asarray(mean), P), H.T @ H, H.T @ innovation)
        return jnp.sum(after.mean**2) + jnp.sum(jnp.sin(after.cov))

    at = (np.linalg.cholesky(cov), H / np.sqrt(R)[:, None], innovation / np.sqrt(R))
    assert_gradient(value, tuple(map(jnp.asarray, at)))


def test_inverse_by_cofactors() -> None:
    rng = np.random.default_rng(7)
    for _ in range(20):
        A = np.eye(3) + rng.normal(size=(3, 3)) @ np.diag([1e3, 1e2, 1e4]) * 0.1
        np.testing.assert_allclose(gaussian.inverse3(jnp.asarray(A, jnp.float32)) @ A, np.eye(3), atol=2e-3)


@pytest.mark.parametrize("blind", [False, True])
def test_a_projected_measurement_is_that_of_the_information_form(blind: bool) -> None:
    """With a full and a singular information, from a belief much wider than the measurement to a much surer one."""
    rng = np.random.default_rng(3)
    C = rng.normal(size=(3, 9))
    for scale in (1e-4, 1.0, 1e4):
        L = rng.normal(size=(9, 9))
        before = Gaussian(jnp.asarray(rng.normal(size=9), jnp.float32), jnp.asarray(L @ L.T * 1e-2, jnp.float32))
        root = rng.normal(size=(3, 2 if blind else 3))
        Y, nu = scale * root @ root.T, rng.normal(size=3)
        told = gaussian.update_projected(before, *(jnp.asarray(a, jnp.float32) for a in (C, Y, nu)))
        P = np.asarray(before.cov, float)
        cov = np.linalg.inv(np.linalg.inv(P) + C.T @ Y @ C)
        np.testing.assert_allclose(told.cov, cov, atol=1e-4 * np.abs(cov).max())
        np.testing.assert_allclose(told.mean, before.mean + cov @ C.T @ Y @ nu, rtol=2e-2, atol=1e-3)


def test_a_hundred_thousand_matches_keep_the_covariance_healthy() -> None:
    """A known and an unknown direction: in float32, beside the same in float64."""
    C = np.zeros((3, 8))
    C[[0, 1, 2], [0, 1, 2]] = C[[0, 1, 2], [5, 6, 7]] = 1.0
    Q, Y = np.diag([1e-4, 1e-4, 1e-6, 1e-9, 1e-9, 1e-8, 1e-8, 1e-9]), np.diag([1e4, 0.0, 1e6])

    def run(dtype) -> np.ndarray:
        c, q, y = (jnp.asarray(a, dtype) for a in (C, Q, Y))

        def step(P, _):
            return gaussian.update_projected(Gaussian(jnp.zeros(8, dtype), P + q), c, y, jnp.zeros(3, dtype)).cov, None

        return np.asarray(jax.jit(lambda P: jax.lax.scan(step, P, length=100_000)[0])(jnp.eye(8, dtype=dtype)), float)

    small = run(jnp.float32)
    with jax.enable_x64(True):
        large = run(jnp.float64)
    assert np.array_equal(small, small.T)
    std = np.sqrt(np.diag(large))
    assert np.linalg.eigvalsh(small / np.outer(std, std)).min() > -1e-5
    np.testing.assert_allclose(np.sqrt(np.diag(small)), std, rtol=0.02)
