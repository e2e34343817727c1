"""Biases and beacons from a lap's ranges: synthetic poses and ranges, fed as the session feeds them."""

from __future__ import annotations

from itertools import combinations

import jax.numpy as jnp
import numpy as np
import pytest
import small_room as room

from uwbslam_jax import calibration
from uwbslam_jax.calibration import Calibration, Solution
from uwbslam_jax.config import Params, Settings, UwbSettings, make_params
from uwbslam_jax.measurements import Frame, StampedFrame
from uwbslam_jax.slam import Estimate

BEACONS = np.array([[0.0, 0.0], [-1.5, -1.2], [1.8, -1.1], [1.5, 1.4], [-1.4, 1.5]])
"""By slot, the robot's own row is not used; so near the lap that moving a beacon cannot explain a bias."""
SLOTS = [1, 2, 3, 4]
NODES, MOST = 5, 10
SETTINGS = Settings(uwb=UwbSettings(max_beacons=NODES - 1))
PLAIN: Params = make_params(SETTINGS)
SIGMA_N = 0.1
BIAS = np.full(NODES, 0.15)
GUESS = BEACONS + 0.2 * np.array([[0, 0], [1, -1], [-1, 0.5], [0.5, 1], [-1, -1]])
"""Where the state has the beacons: up to 0.28 m off."""
QUIET = np.ones((NODES, NODES))


class Lap:
    """A robot that drives a circle of 3 m around the beacons and ranges with noise, its pose known to 0.02 m.

    Attributes:
      params: what antenna, heights and biases are.
    """

    def __init__(self, params: Params = PLAIN, bias=None, seed: int = 0):
        self.params = params
        self.calibration = Calibration(SIGMA_N)
        self.active, self.moving = np.ones(NODES, bool), np.zeros(NODES, bool)
        self._bias = np.zeros(NODES) if bias is None else bias
        self._rng = np.random.default_rng(seed)

    def drive(self, turns: float = 1.0, slots=SLOTS, pairs: bool = True, loudness=QUIET, age: float = 0.0) -> Lap:
        heard = [(0, slot) for slot in slots] + (list(combinations(slots, 2)) if pairs else [])
        for angle in 2 * np.pi * np.arange(0.0, turns, 1 / 200):
            frame, estimate = self._measure(heard, angle, age)
            self.calibration.hear(frame, estimate, self.params, loudness)
        return self

    def _measure(self, heard, angle: float, age: float) -> tuple[StampedFrame, Estimate]:
        """At 1 rad/s; the ranges are measured at `age` before the pose [s], <= 0."""
        pose = np.array([3 * np.cos(angle), 3 * np.sin(angle), angle + np.pi / 2])
        velocity = 3 * np.array([-np.sin(angle), np.cos(angle)])
        heading = pose[2] + age
        lever = np.asarray(self.params.antenna, float)
        turned = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]) @ lever
        nodes = BEACONS.copy()
        nodes[0] = pose[:2] + age * velocity + turned
        height = np.asarray(self.params.height, float)
        known = np.asarray(self.params.bias, float)
        z = [np.hypot(np.hypot(*(nodes[i] - nodes[j])), height[i] - height[j]) for i, j in heard]
        z = (1 + float(self.params.bias_scale)) * np.array(z)
        z += [known[i] + known[j] + self._bias[i] + self._bias[j] for i, j in heard]
        ranges = room.ranges(heard, z + SIGMA_N * self._rng.normal(size=len(z)), MOST, age)
        frame = Frame(np.float32(0.1), np.bool_(False), room.no_scan(8), ranges, room.no_odometry())
        empty = dict.fromkeys(Estimate._fields, np.zeros((), np.float32))
        filled = {"pose": pose, "pose_cov": 0.02**2 * np.eye(3), "velocity": velocity, "yaw_rate": np.float32(1.0)}
        filled |= {"active": self.active, "moving": self.moving, "weight": np.asarray(ranges.valid, np.float32)}
        return StampedFrame(0, frame), Estimate._make({**empty, **filled}.values())

    def solve(self, found=None, places=GUESS) -> Solution | None:
        return self.calibration.solve(places, {} if found is None else found, self.params)

    def solved(self, found=None, places=GUESS) -> Solution:
        solution = self.solve(found, places)
        assert solution is not None
        return solution


def equipped() -> Params:
    """An antenna off the middle, different heights, configured biases and a scale."""
    height = jnp.array([0.3, 1.5, 0.5, 2.0, 1.0])
    bias = jnp.array([0.05, -0.1, 0.2, 0.0, 0.1])
    return PLAIN._replace(antenna=jnp.array([0.2, -0.1]), height=height, bias=bias, bias_scale=jnp.array(0.01))


@pytest.mark.parametrize("params", [PLAIN, equipped()], ids=["plain", "equipped"])
def test_a_lap_finds_biases_and_beacons(params):
    solution = Lap(params, BIAS).drive().solved()
    assert solution.slots == SLOTS
    assert solution.biased
    assert solution.known
    assert solution.gain > 0
    np.testing.assert_allclose(solution.bias, BIAS, atol=0.03)
    np.testing.assert_allclose(solution.beacons, BEACONS[SLOTS], atol=0.05)
    # what it says of itself is not too little: all errors within three standard deviations
    assert np.all(np.abs(solution.bias - BIAS) < 3 * solution.bias_sigma)
    error = (solution.beacons - BEACONS[SLOTS]).ravel()
    assert np.all(np.abs(error) < 3 * np.sqrt(np.diag(solution.cov)))


def test_a_node_of_another_make_gets_its_own_bias():
    bias = np.array([0.1, 0.0, 0.3, 0.0, -0.1])
    np.testing.assert_allclose(Lap(bias=bias).drive().solved().bias, bias, atol=0.04)


@pytest.mark.parametrize("seed", range(3))
def test_ranges_without_bias_are_not_taken_for_biased(seed):
    solution = Lap(seed=seed).drive().solved()
    assert not solution.biased
    np.testing.assert_allclose(solution.bias, 0.0, atol=0.01)
    np.testing.assert_allclose(solution.beacons, BEACONS[SLOTS], atol=0.05)


def test_biases_that_are_known_are_nothing_new():
    """Started at what was found and at the beacons themselves, little is gained."""
    lap = Lap(bias=BIAS).drive()
    first = lap.solved()
    places = BEACONS.copy()
    places[SLOTS] = first.beacons
    again = lap.solved(dict(zip([0, *SLOTS], map(float, first.bias), strict=True)), places)
    assert abs(again.gain) < 0.5
    np.testing.assert_allclose(again.bias, first.bias, atol=0.01)


def test_ranges_are_taken_from_where_the_robot_was_when_they_were_measured():
    """0.05 s ago it was 0.15 m back."""
    lap = Lap().drive(age=-0.05)
    np.testing.assert_allclose(lap.solved().beacons, BEACONS[SLOTS], atol=0.05)


def test_a_forgotten_beacon_is_in_no_solution_until_it_is_heard_again():
    lap = Lap(bias=BIAS).drive()
    lap.calibration.forget(3)
    solution = lap.solved()
    assert solution.slots == [1, 2, 4]
    np.testing.assert_allclose(solution.bias, BIAS[:4], atol=0.04)
    assert lap.drive().solved().slots == SLOTS


def test_a_beacon_that_was_carried_off_and_forgotten_is_found_at_its_new_place(monkeypatch):
    lap = Lap(bias=BIAS).drive()
    lap.calibration.forget(3)
    moved = BEACONS.copy()
    moved[3] += [1.0, -2.0]
    monkeypatch.setitem(globals(), "BEACONS", moved)
    solution = lap.drive().solved(places=GUESS + (moved - BEACONS))
    np.testing.assert_allclose(solution.beacons, moved[SLOTS], atol=0.05)


def test_from_too_few_places_nothing_is_told():
    assert Lap().solve() is None
    few = (calibration._FEWEST_PLACES - 2) * calibration._PLACE_M / (2 * np.pi * 3)
    assert Lap(bias=BIAS).drive(turns=few / 2).solve() is None  # a place's square is crossed within 0.5 to 0.7 m
    # one beacon alone has nothing to be solved with
    assert Lap(bias=BIAS).drive(slots=[2]).solve() is None
    short = Lap(bias=BIAS).drive(turns=few / 2)
    assert short.drive(slots=[1, 2]).solved().slots == [1, 2]


def test_beacons_that_move_or_range_through_walls_are_left_out():
    lap = Lap(bias=BIAS)
    lap.moving[2] = True
    lap.active[1] = False
    assert lap.drive().solved().slots == [3, 4]
    loud = QUIET.copy()
    loud[0, 4] = loud[4, 0] = 2 * calibration._QUIET
    assert Lap(bias=BIAS).drive(loudness=loud).solved().slots == [1, 2, 3]


def test_the_jacobian_is_that_of_the_residuals():
    lap = Lap(equipped(), BIAS).drive()
    problem = lap.calibration._rows(SLOTS, lap.params)
    x = np.concatenate([GUESS[SLOTS].ravel(), BIAS])
    J, _ = problem._linearise(x, calibration.BIAS_M)
    steps = 1e-6 * np.eye(len(x))
    ahead = [problem._linearise(x + step, calibration.BIAS_M)[1] for step in steps]
    behind = [problem._linearise(x - step, calibration.BIAS_M)[1] for step in steps]
    numeric = (np.array(ahead) - np.array(behind)).T / 2e-6
    np.testing.assert_allclose(J, numeric, rtol=1e-5, atol=1e-6)  # of a central difference
