"""Tuning: the gradient of a rollout, the fit on functions of known shape, mounting and biases on made-up graphs."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_room as room
from derivatives import assert_reverse, double, value_and_gradient
from known_room import BEACONS, FLAT, PAIRS, PARAMS, drawn_map, knowing
from loop_graph import ANTENNA, BEACONS as SPOTS, K, host, loop, make, solved
from scipy.integrate import quad

from uwbslam_jax.errors import ConfigError
from uwbslam_jax.estimator import ranging
from uwbslam_jax.files.settings_file import differences, from_dict
from uwbslam_jax.numerics.se2_host import between, compose
from uwbslam_jax.settings import RobotSettings, Settings
from uwbslam_jax.tuning import Log, calibration, fit, parameters, rollout, tune
from uwbslam_jax.tuning.likelihood import Objective, Score

STEPS = 56
"""Of the rollout."""
NAMES = ("sigma_n", "sigma_w", "sigma_l", "sigma_w_yaw")


def drive(count: int):
    """Frames of a robot that drives round in the room, with noisy ranges."""
    rng = np.random.default_rng(0)
    frames = []
    for k in range(count):
        pose = np.array([0.33 + 0.03 * k, -0.41 + 0.3 * np.sin(0.05 * k), 0.6 + 0.02 * k])
        z = room.distances(np.vstack([pose[:2], BEACONS]), PAIRS) + 0.1 * rng.normal(size=6)
        frames.append(room.frame(FLAT, 0.1, room.scan(pose, FLAT.max_beams), room.ranges(PAIRS, z, FLAT.max_ranges)))
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *frames)


@pytest.mark.slow
@pytest.mark.usefixtures("x64")
def test_gradient_through_fifty_steps_agrees_with_central_differences():
    room_map = drawn_map()
    finest = room_map._replace(levels=room_map.levels[:1])
    state, frames, params = double(knowing(finest, velocity=(0.3, 0.1))), double(drive(STEPS)), double(PARAMS)

    made = rollout.Rollout(FLAT, params, state, frames, np.arange(STEPS) * 100_000_000, {}, "")

    def value(logs, frames):
        return made._replace(frames=frames).loss(parameters.put(params, NAMES, logs))

    logs = jnp.log(jnp.array([0.1, 1.0, 0.25, 2.0]))
    both = value_and_gradient(value)
    # small enough to stay clear of the borders of cells over all steps; its rounding is then 1e-6 of the values
    gradient = assert_reverse(both, logs, frames, rtol=1e-3, atol=1e-5, count=1, step=1e-8)
    assert np.all(np.abs(gradient) > 0)


def test_a_window_that_is_cut_out_sees_the_same_ground():
    room_map = drawn_map()
    origin = np.asarray(room_map.origin, float) + np.array([12.8, -6.4])  # cells of 0.1 m: tiles of 6.4 m
    cut = rollout.cropped(room_map, 0.1, origin, 128)
    for old, new, shift in zip(room_map.levels, cut.levels, (64, 32), strict=True):
        np.testing.assert_array_equal(new[shift:, : -2 * shift], old[:-shift, 2 * shift :])
        np.testing.assert_array_equal(new[:shift], 0.0)


@pytest.mark.parametrize("sigma", [0.02, 0.1, 1.0])
def test_the_robust_density_integrates_to_one_over_what_an_outlier_may_be(sigma):
    def density(x):
        return float(np.exp(ranging.log_density(jnp.float32(x), jnp.float32(sigma**2), True)))

    total = quad(density, -10.0, 10.0, points=[-3 * sigma, 0.0, 3 * sigma], limit=200)[0]
    np.testing.assert_allclose(total, 1.0, atol=1e-3)


# The fit, on functions whose minimum is known.


class Known(Objective):
    """A quadratic of curvatures about a best place; for one-sided fits its last logarithm is a noise beside another
    one of exp(floor), and the higher the worse. Beyond a jump of the last all is worse."""

    def __init__(self, best, curvature, floor=None, jump=np.inf):
        self.names = NAMES[: len(best)]
        self.best, self.curvature, self.floor, self.jump = np.array(best), np.array(curvature), floor, jump
        self.start, self.free = np.zeros(len(best)), np.ones(len(best), bool)
        self.weight, self.evaluations, self.goal, self.pieces = 1000.0, 0, "likelihood", []

    def value(self, logs):
        return self.value_and_gradient(logs)[0]

    def value_and_gradient(self, logs):
        gradient = self.curvature * (logs - self.best)
        total = 0.5 * gradient @ (logs - self.best) + 0.5 * np.sum((logs / parameters.LOG_SPREAD) ** 2)
        gradient = gradient + logs / parameters.LOG_SPREAD**2
        if self.floor is not None:
            noise, floor = np.exp(2 * logs[-1]), np.exp(2 * self.floor)
            total, gradient[-1] = total + 20 * np.log(noise + floor), gradient[-1] + 40 * noise / (noise + floor)
        return total / self.weight + (logs[-1] > self.jump), np.where(self.free, gradient, 0.0) / self.weight

    def held_out(self, logs):
        return Score(0.0, 0.0, -self.value(logs), np.nan, np.zeros(4))


def test_a_fit_finds_the_minimum_and_its_curvature():
    found = fit(Known([0.7, -1.2], [5000.0, 300.0]))
    np.testing.assert_allclose(np.log(found.values), [0.7, -1.2], atol=0.01)  # the prior pulls by 0.001
    np.testing.assert_allclose(found.sigma, [5000**-0.5, 300**-0.5], rtol=0.01)
    assert found.told == ("", "")
    low, high = found.interval(0)
    assert low < np.exp(0.7) < high


def test_what_is_not_observed_stays_where_it_was():
    found = fit(Known([0.7, -1.2], [5000.0, 0.01]))
    assert found.told == ("", "not observed")
    assert found.values[1] == 1.0
    np.testing.assert_allclose(np.log(found.values[0]), 0.7, atol=0.01)


def test_what_is_told_from_one_side_is_a_bound():
    objective = Known([0.7, 0.0], [5000.0, 0.0], floor=-3.0)
    found = fit(objective)
    assert found.told == ("", "at most")
    logs = np.log(found.values)
    least = min(objective.value(np.array([logs[0], at])) for at in np.linspace(-9.0, 0.0, 200))
    worse = (objective.value(logs) - least) * objective.weight
    assert 1.0 < worse < 2.5  # a log-likelihood of 2 rules out, found by bisection
    assert logs[1] > -5.0


def test_a_jump_nearby_is_told_and_does_not_hold_up_the_others():
    found = fit(Known([0.7, 0.4], [5000.0, 300.0], jump=0.38))
    assert list(found.jumps) == [False, True]
    np.testing.assert_allclose(np.log(found.values[0]), 0.7, atol=0.01)


class Twofold(Known):
    """Two valleys, the deeper one beyond a ridge at the start."""

    def value_and_gradient(self, logs):
        self.best = np.array([-0.5])
        near, slope = super().value_and_gradient(logs)
        self.best = np.array([0.7])
        deep, other = super().value_and_gradient(logs)
        deep -= 50.0 / self.weight
        return min(near, deep), slope if near < deep else other


def test_the_deeper_of_two_valleys_is_found():
    found = fit(Twofold([0.0], [500.0]))
    np.testing.assert_allclose(np.log(found.values), [0.7], atol=0.01)


# Names and settings.


def test_tuned_settings_are_read_back_as_they_were_written():
    import tomllib

    values = {"sigma_n": 0.0512345678, "bias.7": -0.1, "lidar.yaw": 0.05, "sigma_w": 0.3}
    found = parameters.configured(Settings(), values)
    again = from_dict(tomllib.loads(differences(found)))
    assert again == found
    for name, value in values.items():
        np.testing.assert_allclose(parameters.value(again, name), value, rtol=1e-5)


@pytest.mark.parametrize(("name", "near"), [("sigma", "sigma_"), ("bias.x", "bias.1"), ("lidar.z", "lidar.")])
def test_an_unknown_parameter_names_the_nearest(name, near):
    with pytest.raises(ConfigError, match=f"did you mean {near}"):
        parameters.check([name])


# Mounting and biases.


def mounted(change: np.ndarray, bias: dict[int, float], *, wheels: bool):
    """A graph as a run makes it whose LiDAR is configured wrong: the robot's frames are off by `change` throughout."""
    truth = loop(120)
    graph = make(truth, bias=bias)
    there = np.tile(change, (len(truth), 1))
    wrong = compose(truth, there)
    back = np.append(-rotated(-change[2], change[:2]), -change[2])
    rng = np.random.default_rng(5)
    steps = np.vstack([np.zeros(3), between(truth[:-1], truth[1:])])
    steps = 1.02 * steps + rng.normal(0, 0.003, steps.shape)
    graph.keyframes["pose"][:] = wrong
    if wheels:
        graph.keyframes["wheels"][:] = steps
    edges = graph.edges["between"]
    edges[:] = compose(compose(np.tile(back, (len(edges), 1)), edges), np.tile(change, (len(edges), 1)))
    for mean in graph.ranges.means:
        then = (1 - mean["share"]) * wrong[mean["at"]] + mean["share"] * wrong[mean["at"] + 1]
        antenna = then[:2] + rotated(then[2], ANTENNA)
        ends = [rotated(-p[2], antenna - p[:2]) for p in wrong[[mean["at"], mean["at"] + 1]]]
        mean["before"], mean["after"] = ends
    return graph


def rotated(theta: float, v: np.ndarray) -> np.ndarray:
    return np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]]) @ v


MOUNTING = np.array([0.2, -0.1, 0.1])
BIAS = {0: 0.1, 1: -0.15, 2: 0.05, 3: 0.2, 4: -0.1}
ASKED = [*(f"bias.{slot}" for slot in BIAS), "lidar.x", "lidar.y", "lidar.yaw"]


@pytest.mark.parametrize("wheels", [True, False])
def test_mounting_and_biases_are_found_or_told_as_not_observed(wheels):
    # a scan laid at X l has the robot at X l l0^-1, with l0 the origin
    graph = mounted(MOUNTING, BIAS, wheels=wheels)
    solution, slots = solved(graph), {slot: slot for slot in range(K)}
    found, sigma, told = calibration.solve(graph, host(), solution, slots, ASKED, np.zeros(len(ASKED)))
    assert len(SPOTS) == K - 1
    observed, error = np.array(told) == "", found - np.array([*BIAS.values(), *MOUNTING])
    assert observed[:K].sum() >= 3  # inside a ring of beacons some biases look like beacons farther off
    assert np.all(np.abs(error[:K])[observed[:K]] < 4 * sigma[:K][observed[:K]])
    np.testing.assert_array_equal(found[~observed], 0.0)
    if wheels:
        assert told[K:] == ("", "", "")
        np.testing.assert_allclose(found[K:], MOUNTING, atol=0.01)
        assert np.all(np.abs(found[K:] - MOUNTING) < 4 * sigma[K:])
    else:
        assert told[-1] == "not observed"
        assert found[-1] == 0.0
        # with the yaw as configured the LiDAR sits where the antenna is the same as seen from it
        seen = rotated(-MOUNTING[2], ANTENNA - MOUNTING[:2])
        np.testing.assert_allclose(ANTENNA - found[K : K + 2], seen, atol=0.02)


def test_each_recording_is_explained_by_its_own_robot(monkeypatch: pytest.MonkeyPatch):
    seen = []

    def calibrate(messages, settings, names):
        seen.append(settings.robot)
        one = np.ones(len(names))
        return calibration.Calibration(tuple(names), 0 * one, 0.1 * one, one, ("",) * len(names))

    monkeypatch.setattr(calibration, "calibrate", calibrate)

    def tuned(robots: list[RobotSettings], name: str) -> Settings:
        logs = [Log("a", [], Settings(robot=robot), None) for robot in robots]
        seen.clear()
        found = tune(logs, (name,), Settings(), "likelihood", lambda text: None).settings
        assert seen == robots
        return found

    turned, shifted = RobotSettings(lidar=(0.0, 0.0, 3.0), id=27), RobotSettings(lidar=(0.2, 0.0, 0.0))
    assert tuned([turned, shifted], "bias.3").robot == RobotSettings()
    assert tuned([turned, turned], "bias.3").robot == turned
    assert tuned([turned, turned], "lidar.x").robot.lidar == (0.1, 0.0, 3.0)
    with pytest.raises(ConfigError, match="tune it of each by itself"):
        tuned([turned, shifted], "lidar.x")
