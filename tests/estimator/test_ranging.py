"""The range model against plain numpy, its update against the textbook filter, and what it does with bad ranges."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_room as room
from derivatives import assert_gradient, double
from hypothesis import given, strategies as st
from scipy.stats import norm

from uwbslam_jax.estimator import motion, ranging, state_vector
from uwbslam_jax.estimator.state_vector import Nodes
from uwbslam_jax.measurements import Odometry, Ranges
from uwbslam_jax.numerics.gaussian import Gaussian
from uwbslam_jax.settings import Params, Settings, UwbSettings, make_params

NODES = 4
SIZE = state_vector.state_size(NODES)
PAIRS = room.all_pairs(NODES)
QUIET = ranging.quiet(NODES)
predicted_ranges = jax.jit(ranging.predicted_ranges)


@partial(jax.jit, static_argnames="robust")
def update(belief, ranges, usable, params, *, robust):
    """The update between pairs that have been quiet so far."""
    dtype = belief.mean.dtype
    scatter = QUIET._replace(log=QUIET.log.astype(dtype), last=QUIET.last.astype(dtype))
    return ranging.update(belief, ranges, usable, params, scatter, robust=robust)[:2]


POSITIONS = np.array([[0.5, -0.3], [4.0, 0.0], [-3.0, 3.0], [1.0, -5.0]])
VELOCITIES = np.array([[0.8, 0.4], [0.0, 0.0], [0.1, -0.2], [0.0, 0.0]])
HEADING, YAW_RATE = 0.7, 0.5


@pytest.fixture
def params() -> Params:
    plain = make_params(Settings(uwb=UwbSettings(max_beacons=NODES - 1)))
    return plain._replace(
        antenna=jnp.array([0.16, -0.05]),
        bias=jnp.array([0.02, 0.12, -0.03, 0.0]),
        bias_scale=jnp.array(0.07),
        height=jnp.array([1.12, 1.94, 0.4, 1.12]),
    )


def vector(positions=POSITIONS) -> jax.Array:
    nodes = Nodes(
        jnp.asarray(positions, float), jnp.asarray(VELOCITIES), jnp.array(HEADING), jnp.array(YAW_RATE), jnp.zeros(3)
    )
    return state_vector.pack(nodes)


def flat_params(**changed) -> Params:
    return make_params(Settings(uwb=UwbSettings(max_beacons=NODES - 1)))._replace(**changed)


def by_hand(i: int, j: int, age: float, params: Params) -> float:
    """Range between two antennas at the time of the exchange, in numpy."""

    def antenna(slot):
        place = POSITIONS[slot] + age * VELOCITIES[slot]
        if slot == 0:
            yaw = HEADING + age * YAW_RATE
            ax, ay = np.asarray(params.antenna, float)
            place = place + np.array([np.cos(yaw) * ax - np.sin(yaw) * ay, np.sin(yaw) * ax + np.cos(yaw) * ay])
        return np.append(place, params.height[slot])

    distance = np.linalg.norm(antenna(i) - antenna(j))
    return float((1 + params.bias_scale) * distance + params.bias[i] + params.bias[j])


def measured(distances, ages=0.0, gap=np.nan, size=8) -> Ranges:
    return jax.tree.map(jnp.asarray, room.ranges(PAIRS, distances, size, ages, gap))


def test_predicted_range_has_lever_arm_height_bias_and_age(params):
    ages = np.array([-0.09, -0.05, 0.0, -0.02, -0.08, -0.1])
    predicted = predicted_ranges(vector(), measured(np.zeros(6), ages), params)[:6]
    want = [by_hand(i, j, age, params) for (i, j), age in zip(PAIRS, ages, strict=True)]
    np.testing.assert_allclose(predicted, want, rtol=1e-6)  # float32


def test_slant_range_at_one_metre_with_0_8_m_of_height_is_0_28_m_longer():
    positions = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [5.0, 5.0]])
    flat = flat_params(height=jnp.zeros(NODES))
    raised = flat_params(height=jnp.array([0.0, 0.8, 0.0, 0.0]))
    ranges = measured(np.zeros(6))
    rise = predicted_ranges(vector(positions), ranges, raised) - predicted_ranges(vector(positions), ranges, flat)
    assert 0.28 < float(rise[0]) < 0.29  # sqrt(1.64) - 1
    np.testing.assert_allclose(rise[1], 0.0, atol=1e-6)  # nodes of one height


def test_bias_of_a_pair_is_the_sum_of_both_nodes():
    biased = flat_params(bias=jnp.array([0.1, 0.02, -0.3, 0.0]))
    ranges = measured(np.zeros(6))
    plain = predicted_ranges(vector(), ranges, flat_params())
    extra = predicted_ranges(vector(), ranges, biased) - plain
    np.testing.assert_allclose(extra[:6], [0.12, -0.2, 0.1, -0.28, 0.02, -0.3], atol=1e-6)


def test_nodes_at_one_place_give_a_finite_range_and_gradient():
    same = np.tile([[1.0, 2.0]], (NODES, 1))
    ranges = measured(np.zeros(6))
    value, pull = jax.vjp(lambda x: predicted_ranges(x, ranges, flat_params()), vector(same))
    np.testing.assert_array_equal(value, 0.0)
    np.testing.assert_array_equal(pull(jnp.ones(8))[0], 0.0)
    H = jax.jacfwd(predicted_ranges)(vector(same), ranges, flat_params())
    np.testing.assert_array_equal(H, 0.0)
    belief = Gaussian(vector(same), jnp.eye(SIZE))
    after, used = update(belief, measured(np.ones(6)), jnp.arange(8) < 6, flat_params(), robust=True)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((after, used)))


def random_belief() -> Gaussian:
    rng = np.random.default_rng(0)
    root = 0.05 * rng.normal(size=(SIZE, SIZE))
    return Gaussian(vector(), jnp.asarray(root @ root.T + 1e-3 * np.eye(SIZE)))


@pytest.mark.usefixtures("x64")
def test_update_by_many_ranges_is_the_textbook_update(params):
    params, belief = double(params), random_belief()
    truth = np.array([by_hand(i, j, 0.0, params) for i, j in PAIRS])
    z = truth + np.array([0.1, -0.05, 0.02, 0.07, -0.2, 0.03])
    ranges = measured(z)
    after, used = update(belief, ranges, ranges.valid, params, robust=False)
    H = np.asarray(jax.jacfwd(predicted_ranges)(belief.mean, ranges, params))[:6]
    P, R = np.asarray(belief.cov), float(params.sigma_n) ** 2 * np.eye(6)
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    nu = np.asarray(ranges.range)[:6] - truth  # a range is a float32
    # the model's rounding in float64; the antenna and heights came from float32
    np.testing.assert_allclose(used.innovation[:6], nu, atol=1e-9)
    np.testing.assert_allclose(after.mean, belief.mean + K @ nu, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(after.cov, P - K @ S @ K.T, atol=1e-9)
    np.testing.assert_allclose(used.normalised[:6], nu / np.sqrt(np.diag(S)), rtol=1e-8)
    # the likelihood takes each pair by itself
    want = norm.logpdf(nu, scale=np.sqrt(np.diag(S))).sum()
    np.testing.assert_allclose(used.log_likelihood, want, rtol=1e-8)


@pytest.mark.usefixtures("x64")
def test_robust_update_is_the_textbook_update_with_the_noise_of_doubted_ranges_raised(params):
    params, belief = double(params), random_belief()
    truth = np.array([by_hand(i, j, 0.0, params) for i, j in PAIRS])
    ranges = measured(truth + np.array([0.1, -1.5, 0.02, 4.0, -0.2, 0.03]))
    after, used = update(belief, ranges, ranges.valid, params, robust=True)
    H = np.asarray(jax.jacfwd(predicted_ranges)(belief.mean, ranges, params))[:6]
    P, weight = np.asarray(belief.cov), np.asarray(used.weight)[:6]
    np.testing.assert_allclose(weight, ranging.robust_weight(used.normalised)[:6], rtol=1e-12)
    assert weight.min() < 0.01 < 0.5 < weight.max()
    S = H @ P @ H.T + np.diag(float(params.sigma_n) ** 2 / weight)
    K = P @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(after.mean, belief.mean + K @ np.asarray(used.innovation)[:6], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(after.cov, P - K @ S @ K.T, atol=1e-9)


def test_ranges_that_are_not_usable_change_nothing():
    belief = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), random_belief())
    wild = measured(np.full(6, 100.0))
    after, used = update(belief, wild, jnp.zeros(8, bool), flat_params(), robust=True)
    np.testing.assert_array_equal(after.mean, belief.mean)
    np.testing.assert_array_equal(used.weight, 0.0)
    np.testing.assert_array_equal(used.innovation, 0.0)
    assert float(used.log_likelihood) == 0.0


def test_power_rule_drops_large_gaps_and_spares_radios_without_powers():
    gaps = np.array([np.nan, 9.9, 10.0, 10.1, 30.0, -5.0])
    sight = ranging.line_of_sight(measured(np.ones(6), gap=gaps), 10.0)
    np.testing.assert_array_equal(sight[:6], [True, True, True, False, False, True])
    everything = ranging.line_of_sight(measured(np.ones(6), gap=gaps), np.inf)
    assert bool(everything.all())


@given(st.floats(-1e4, 1e4))
def test_robust_weight_is_symmetric_never_zero_and_at_most_one(normalised):
    weight = float(ranging.robust_weight(jnp.float32(normalised)))
    assert 0.0 < weight <= 1.0
    assert weight == float(ranging.robust_weight(jnp.float32(-normalised)))


def test_robust_weight_is_a_quarter_at_three_sigma_and_bounds_the_pull():
    normalised = jnp.linspace(0.0, 100.0, 1001)
    weight = ranging.robust_weight(normalised)
    np.testing.assert_allclose(ranging.robust_weight(jnp.array([0.0, 3.0])), [1.0, 0.25], rtol=1e-6)
    assert bool((jnp.diff(weight) < 0).all())
    pull = weight * normalised  # redescending: a range far off pulls less than one a little off
    assert float(pull[-1]) < 0.01 * float(pull.max())


def learnt(noise, count=200) -> np.ndarray:
    """Factor of the noise of each pair after ranges with that noise, in standard deviations (count, 6)."""
    ranges = measured(np.ones(6))
    learn = jax.jit(ranging.learn_scatter)
    scatter = QUIET
    for z in noise[:count]:
        scatter = learn(scatter, ranges, ranges.valid, jnp.asarray(np.append(z, [0.0, 0.0])))
    np.testing.assert_array_equal(scatter.log, scatter.log.T)
    return np.asarray(ranging.loudness(scatter.log[ranges.i, ranges.j]))[:6]


def test_quiet_pairs_keep_their_weight():
    rng = np.random.default_rng(0)
    assert np.mean([learnt(rng.normal(size=(200, 6))) for _ in range(10)]) < 1.01


def test_a_pair_through_walls_is_found_out_and_forgiven_when_they_are_passed():
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(400, 6))
    noise[:200, 2] += rng.exponential(8.0, 200)  # 0.8 m at 0.1 m of noise
    factor = learnt(noise)
    assert factor[2] > 4.0
    assert np.delete(factor, 2).max() < 1.3
    assert learnt(noise, 60)[2] > 3.0  # six seconds at 10 Hz
    assert learnt(noise, 400).max() < 1.3


def test_a_state_that_is_wrong_does_not_silence_the_ranges_that_say_so():
    """The paper's Remark: innovations that are large but smooth are the state's fault, not the ranges'."""
    rng = np.random.default_rng(0)
    drifting = rng.normal(size=(100, 6)) + np.linspace(0.0, 20.0, 100)[:, None]
    assert learnt(drifting).max() < 1.3


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["too long", "too short"])
def test_an_outlier_of_either_sign_hardly_moves_the_state(sign):
    belief = Gaussian(vector(), 0.01 * jnp.eye(SIZE))
    good = predicted_ranges(belief.mean, measured(np.zeros(6)), flat_params())[:6]
    bad = good.at[0].add(sign * 3.0)
    moved = [
        update(belief, measured(bad), jnp.arange(8) < 6, flat_params(), robust=robust)[0].mean - belief.mean
        for robust in (True, False)
    ]
    assert np.abs(moved[0]).max() < 0.02 < 0.5 < np.abs(moved[1]).max()


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("robust", [True, False])
def test_gradient_of_one_filter_step_agrees_with_finite_differences(params, robust):
    """Prediction and range update, with respect to the mean, the covariance's root, the ranges and the parameters."""
    params, belief = double(params), random_belief()
    ranges = double(measured([by_hand(i, j, 0.0, params) + 0.1 for i, j in PAIRS], -0.03))
    none = Odometry(jnp.zeros(3), jnp.array(False))
    rng = np.random.default_rng(1)
    weights = jnp.asarray(rng.normal(size=SIZE))
    names = ("sigma_n", "sigma_w", "sigma_w_yaw", "antenna", "bias", "bias_scale", "height")

    def value(at):
        mean, root, distances, tunable = at
        changed = params._replace(**tunable)
        start = Gaussian(mean, root @ root.T)
        predicted = motion.predict(start, changed, jnp.array(0.1), none, jnp.zeros(NODES, bool), jnp.zeros(2))
        after, used = update(predicted, ranges._replace(range=distances), ranges.valid, changed, robust=robust)
        return weights @ after.mean + weights @ after.cov @ weights + 0.1 * used.log_likelihood

    at = (belief.mean, jnp.linalg.cholesky(belief.cov), ranges.range, {n: getattr(params, n) for n in names})
    gradient = assert_gradient(value, at, rtol=1e-5)
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(gradient))


@pytest.mark.usefixtures("x64")
def test_the_jacobian_that_is_written_out_is_that_of_the_model():
    params = double(flat_params())._replace(
        antenna=jnp.array([0.2, -0.1]), bias_scale=jnp.array(0.03), height=jnp.linspace(0.0, 1.0, 4)
    )
    rng = np.random.default_rng(0)
    at = jnp.asarray(rng.normal(size=vector().shape[0]))
    ranges = measured(np.ones(6), np.linspace(-0.05, 0.0, 6))
    h, H = jax.jit(ranging.linearised_ranges)(at, ranges, params)
    np.testing.assert_allclose(h, ranging.predicted_ranges(at, ranges, params), rtol=1e-12)
    np.testing.assert_allclose(H, jax.jacfwd(ranging.predicted_ranges)(at, ranges, params), atol=1e-9)
