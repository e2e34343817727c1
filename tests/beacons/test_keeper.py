"""A beacon's life after start-up: placed when its place is certain, silent, dropped, carried away, back again."""

from __future__ import annotations

from itertools import combinations

import jax.numpy as jnp
import numpy as np
import pytest
import small_room as room

from uwbslam_jax.beacons.keeper import BeaconKeeper
from uwbslam_jax.estimator import HostView, init, state_vector
from uwbslam_jax.estimator.state import Estimate, State
from uwbslam_jax.mapping import Tiles
from uwbslam_jax.measurements import Frame, StampedFrame
from uwbslam_jax.result import EventKind
from uwbslam_jax.session.frame_assembler import pad_scan
from uwbslam_jax.settings import Params, Settings, UwbSettings, make_config, make_host_params, make_params

SETTINGS = Settings(uwb=UwbSettings(max_beacons=3, sigma_n=0.1))
CONFIG = make_config(SETTINGS)
BEACONS = np.array([[0.0, 0.0], [4.0, 0.0], [1.0, 5.0], [-3.0, 2.0]])
"""Slot 0 is the robot's and not used."""
SECOND = 10**9


def params(**changed) -> Params:
    return make_params(SETTINGS)._replace(**changed)


def known(*slots: int) -> State:
    """A state that has some beacons at their places, known to a centimetre."""
    state = init(CONFIG)
    active = np.isin(np.arange(4), [0, *slots])
    s = state_vector.unpack(state.belief.mean)
    positions = jnp.asarray(np.where(active[:, None], BEACONS, 0.0), jnp.float32)
    rows = np.array([2 * slot + axis for slot in slots for axis in (0, 1)])
    cov = state.belief.cov.at[rows, rows].set(1e-4)
    belief = state.belief._replace(mean=state_vector.pack(s._replace(positions=positions)), cov=cov)
    return state._replace(belief=belief, active=jnp.asarray(active))


class World:
    """A robot on a circle that hands frames and estimates to a keeper, ten a look.

    With `pairs` the beacons range to each other as well. `walk` is the velocity of each node that is carried [m/s].
    """

    def __init__(
        self,
        state: State,
        *,
        straight: bool = False,
        pairs: bool = False,
        params: Params | None = None,
        seed: int = 0,
    ):
        self.keeper, self.state = BeaconKeeper(), state
        self.walk = np.zeros((4, 2))
        self._pairs = pairs
        self.params = make_params(SETTINGS) if params is None else params
        self.positions = BEACONS.copy()
        self.events: list[tuple[int, EventKind, str]] = []
        self.time = 0.0
        self.excess = np.zeros(4)
        self.carried = np.zeros(2)  # where the robot is minus where the estimate has it
        self._straight, self._rng = straight, np.random.default_rng(seed)
        for slot in np.flatnonzero(np.asarray(state.active)[1:]) + 1:
            self.keeper.placed(int(slot), 0)

    def pose(self) -> np.ndarray:
        if self._straight:
            return np.array([0.3 * self.time, 0.0, 0.0])
        a = 0.3 * self.time
        return np.array([2 * np.cos(a), 2 * np.sin(a), a + np.pi / 2])

    def run(self, seconds: float, heard: tuple[int, ...], dt: float = 0.1, gap: float = np.nan) -> None:
        pending = []
        for _ in range(round(seconds / dt)):
            self.time += dt
            self.positions += dt * self.walk
            between = list(combinations(heard, 2)) if self._pairs else []
            pending.append(self._measure([(0, slot) for slot in heard] + between, gap))
            if len(pending) == 10:
                self._look(pending)
                pending = []

    def _measure(self, pairs, gap) -> tuple[StampedFrame, Estimate]:
        pose, estimated = self.pose(), np.asarray(self.state.belief.mean[:8], float).reshape(4, 2)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        ax, ay = np.asarray(self.params.antenna, float)
        antenna = pose[:2] + np.array([c * ax - s * ay, s * ax + c * ay])
        i, j = np.array(pairs).T
        height, bias = np.asarray(self.params.height), np.asarray(self.params.bias)

        def slant(points, robot):
            nodes = np.concatenate([robot[None], points[1:]])
            distance = np.hypot(np.linalg.norm(nodes[i] - nodes[j], axis=1), height[i] - height[j])
            return (1 + float(self.params.bias_scale)) * distance + bias[i] + bias[j]

        excess = self.excess[i] + self.excess[j]
        z = slant(self.positions, antenna + self.carried) + excess + 0.1 * self._rng.normal(size=len(i))
        ranges = room.ranges(pairs, z, CONFIG.max_ranges, gap=gap)
        normalised = np.zeros(CONFIG.max_ranges, np.float32)
        normalised[: len(i)] = (z - slant(estimated, antenna)) / 0.12
        frame = Frame(np.float32(0.1), np.bool_(False), pad_scan(None, SETTINGS), ranges, room.no_odometry())
        zero = np.zeros((), np.float32)
        empty = dict.fromkeys(Estimate._fields, zero)
        active = np.asarray(self.state.active)
        known = {"pose": pose, "velocity": np.zeros(2), "beacons": estimated, "active": active}
        known |= {"moving": np.asarray(self.state.moving), "normalised": normalised}
        return StampedFrame(round(self.time * SECOND), frame), Estimate._make({**empty, **known}.values())

    def _look(self, pending) -> None:
        host = make_host_params(SETTINGS, self.params)
        slots = {node: node for node in range(CONFIG.nodes)}
        view = HostView(CONFIG, self.params, host, self.state, Tiles(0.05), slots, pending, np.zeros((0, 3)), {}, {})
        changes = self.keeper.look(view)
        self.state = self.state if changes.state is None else changes.state
        self.events += changes.events

    def position(self, slot: int) -> np.ndarray:
        return np.asarray(state_vector.unpack(self.state.belief.mean).positions[slot], float)


def test_a_beacon_that_joins_is_placed_where_it_stands_within_its_stated_covariance():
    world = World(known(1, 2))
    before = world.state
    world.run(12.0, (1, 2, 3))
    assert world.keeper.status(3) == "static"
    assert world.events == [(3, EventKind.PLACED, "")]
    np.testing.assert_array_equal(world.state.active, True)
    P = np.asarray(world.state.belief.cov, float)
    error = world.position(3) - BEACONS[3]
    assert error @ np.linalg.solve(P[6:8, 6:8], error) < 13.8  # chi-square of 2, 1 in 1000
    assert np.sqrt(P[6, 6]) < 0.15
    # the rest is as it was
    np.testing.assert_array_equal(world.position(2), BEACONS[2])
    kept = np.setdiff1d(np.arange(len(P)), [6, 7, 14, 15])  # its place and velocity
    np.testing.assert_array_equal(P[np.ix_(kept, kept)], np.asarray(before.belief.cov)[np.ix_(kept, kept)])
    np.testing.assert_allclose(np.diag(P)[14:16], 1e-8, rtol=1e-5)


def test_a_beacon_placed_by_a_robot_that_drifted_shares_the_drift():
    state = known(1, 2)
    pose = [0, 1, 16]
    drift = np.diag([0.5, 0.3, 0.05]) ** 2
    cov = state.belief.cov.at[np.ix_(pose, pose)].set(jnp.asarray(drift, jnp.float32))
    world = World(state._replace(belief=state.belief._replace(cov=cov)))
    robot = np.array([1.0, 2.0])  # not where the circle has it: what counts is how far off the beacon is
    world.state = world.state._replace(
        belief=world.state.belief._replace(mean=world.state.belief.mean.at[:2].set(robot))
    )
    world.run(12.0, (3,))
    assert world.keeper.status(3) == "static"
    P = np.asarray(world.state.belief.cov, float)
    x, y = world.position(3) - robot
    J = np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])  # all of the track turns and shifts with the robot
    np.testing.assert_allclose(P[np.ix_([6, 7], pose)], J @ drift, atol=1e-4)
    np.testing.assert_allclose(P[6:8, 6:8], J @ drift @ J.T, atol=0.15**2)
    assert np.linalg.eigvalsh(P)[0] > -1e-6


def test_lever_arm_height_and_bias_are_taken_off_before_placing():
    biased = params(
        antenna=jnp.array([0.3, -0.2]),
        bias=jnp.array([0.1, 0, 0, 0.25]),
        bias_scale=jnp.array(0.07),
        height=jnp.array([1.0, 1.0, 1.0, 2.5]),
    )
    world = World(known(1, 2), params=biased)
    world.run(12.0, (1, 2, 3))
    np.testing.assert_allclose(world.position(3), BEACONS[3], atol=0.1)  # 12 and more ranges of 0.1 m


def test_a_beacon_seen_from_a_straight_line_only_is_not_placed():
    world = World(known(1, 2), straight=True)
    world.run(12.0, (1, 2, 3))
    assert world.keeper.status(3) == "waiting"
    assert not bool(world.state.active[3])


def test_a_beacon_behind_walls_by_its_powers_is_not_placed():
    world = World(known(1, 2))
    world.run(12.0, (3,), gap=20.0)
    assert world.keeper.status(3) == "waiting"


def test_a_robot_that_was_carried_is_put_where_its_ranges_say_and_no_beacon_is_blamed():
    world = World(known(1, 2, 3))
    world.run(3.0, (1, 2, 3))
    assert world.events == []
    world.carried = np.array([0.0, -4.0])
    world.run(1.0, (1, 2, 3))
    assert world.events == [(0, EventKind.ROBOT_CARRIED, "")]
    place = np.asarray(world.state.belief.mean[:2], float)
    np.testing.assert_allclose(place, world.pose()[:2] + world.carried, atol=0.3)  # its own stated sigma
    np.testing.assert_array_equal(np.asarray(world.state.active), True)
    for slot in (1, 2, 3):
        np.testing.assert_array_equal(world.position(slot), BEACONS[slot])
    P = np.asarray(world.state.belief.cov, float)
    assert P[16, 16] > np.pi  # the heading is anyone's guess
    assert np.linalg.eigvalsh(P)[0] > 0


def test_one_beacon_that_was_moved_does_not_carry_the_robot():
    world = World(known(1, 2, 3))
    world.excess[3] = 3.0
    world.run(3.0, (1, 2, 3))
    assert all(slot == 3 for slot, _, _ in world.events)


def test_a_silent_beacon_keeps_its_place_and_is_dropped_after_a_minute():
    world = World(known(1, 2, 3))
    world.run(5.0, (1, 2))
    assert world.keeper.status(3) == "silent"
    assert bool(world.state.active[3])
    np.testing.assert_array_equal(world.position(3), BEACONS[3])
    world.run(53.0, (1, 2))
    assert world.keeper.status(3) == "silent"
    world.run(4.0, (1, 2))
    assert world.keeper.status(3) == "dropped"
    np.testing.assert_array_equal(world.state.active, [True, True, True, False])
    assert [kind for _, kind, _ in world.events] == [EventKind.SILENT, EventKind.DROPPED]
    assert {slot for slot, _, _ in world.events} == {3}


def test_a_silent_beacon_that_is_heard_again_is_static():
    world = World(known(1, 2, 3))
    world.run(6.0, (1, 2))
    world.run(2.0, (1, 2, 3))
    assert world.keeper.status(3) == "static"
    assert [kind for _, kind, _ in world.events] == [EventKind.SILENT, EventKind.HEARD_AGAIN]


def test_a_dropped_beacon_comes_back_the_same_way_as_a_new_one():
    world = World(known(1, 2, 3))
    world.run(62.0, (1, 2))
    assert world.keeper.status(3) == "dropped"
    world.positions[3] = [3.0, -4.0]
    world.run(12.0, (1, 2, 3))
    assert world.keeper.status(3) == "static"
    np.testing.assert_allclose(world.position(3), [3.0, -4.0], atol=0.15)  # as certain as it must be


def test_a_beacon_that_was_moved_is_placed_anew_when_the_robot_alone_hears_it():
    world = World(known(1, 2, 3))
    world.run(5.0, (1, 2, 3))
    assert world.events == []
    world.positions[3] = [2.0, 6.0]
    world.run(15.0, (1, 2, 3))
    assert world.keeper.status(3) == "static"
    assert (3, EventKind.MOVED, "") in world.events
    error, cov = world.position(3) - [2.0, 6.0], np.asarray(world.state.belief.cov, float)[6:8, 6:8]
    assert error @ np.linalg.solve(cov, error) < 13.8  # chi-square of 2, 1 in 1000
    assert world.keeper.status(1) == world.keeper.status(2) == "static"


def test_a_beacon_is_followed_while_it_is_carried_and_rests_where_it_is_put_down():
    world = World(known(1, 2, 3), pairs=True)
    world.run(3.0, (1, 2, 3))
    world.walk[3] = [1.0, 0.5]
    world.run(2.0, (1, 2, 3))
    assert world.keeper.status(3) == "moving"
    np.testing.assert_array_equal(world.state.moving, [False, False, False, True])
    # the keeper puts it where its last second says; the steps between the looks, which follow it, are not run here
    np.testing.assert_allclose(world.position(3), world.positions[3], atol=0.3)
    velocity = np.asarray(state_vector.unpack(world.state.belief.mean).velocities[3])
    np.testing.assert_allclose(velocity, [1.0, 0.5], atol=0.5)
    world.walk[3] = 0.0
    world.run(4.0, (1, 2, 3))
    assert world.keeper.status(3) == "static"
    assert not np.any(world.state.moving)
    np.testing.assert_allclose(world.position(3), world.positions[3], atol=0.1)
    assert [kind for _, kind, _ in world.events] == [EventKind.CARRIED, EventKind.PUT_DOWN]
    assert {slot for slot, _, _ in world.events} == {3}


def test_a_beacon_that_joins_while_it_is_carried_is_placed_as_moving():
    world = World(known(1, 2), pairs=True)
    world.positions[3], world.walk[3] = [1.0, 3.0], [-0.8, 0.2]
    world.run(2.0, (1, 2, 3))
    assert world.keeper.status(3) == "moving"
    np.testing.assert_allclose(world.position(3), world.positions[3], atol=0.5)
    assert [kind for _, kind, _ in world.events] == [EventKind.PLACED_MOVING]


def test_a_carried_beacon_that_falls_silent_leaves_the_state():
    world = World(known(1, 2, 3), pairs=True)
    world.walk[3] = [1.0, 0.5]
    world.run(4.0, (1, 2, 3))
    world.run(5.0, (1, 2))
    assert world.keeper.status(3) == "waiting"
    np.testing.assert_array_equal(world.state.active, [True, True, True, False])
    np.testing.assert_array_equal(world.state.moving, False)
    assert world.events[-1][1] is EventKind.SILENT_MOVING


def test_a_clock_that_drifts_is_told_of_and_nobody_is_thrown_out():
    """All ranges of one node grow; the others hear it and must not be blamed, nor is it taken to be carried."""
    world = World(known(1, 2, 3), pairs=True)
    for _ in range(30):
        world.excess[3] += 0.05
        world.run(1.0, (1, 2, 3))
    assert [world.keeper.status(slot) for slot in (1, 2, 3)] == ["static"] * 3
    np.testing.assert_array_equal(np.asarray(world.state.active), True)
    told = [(kind, detail) for slot, kind, detail in world.events if slot == 3]
    assert len(told) == 1
    assert told[0][0] is EventKind.DOUBTED
    assert told[0][1].startswith("+")
    world.excess[3] = 0.0
    world.run(3.0, (1, 2, 3))
    assert world.events[-1] == (3, EventKind.FITS_AGAIN, "")


def test_a_few_wild_ranges_do_not_take_a_beacon_out():
    world = World(known(1, 2, 3))
    world.run(3.0, (1, 2, 3))
    world.excess[3] = 5.0
    world.run(0.4, (1, 2, 3))
    world.excess[3] = 0.0
    world.run(3.0, (1, 2, 3))
    assert world.events == []


@pytest.mark.parametrize("slot", [1, 3])
def test_taking_a_beacon_out_leaves_a_healthy_covariance(slot):
    world = World(known(1, 2, 3))
    others = tuple(s for s in (1, 2, 3) if s != slot)
    root = np.random.default_rng(0).normal(size=(21, 21)).astype(np.float32)
    world.state = world.state._replace(belief=world.state.belief._replace(cov=jnp.asarray(root @ root.T)))
    world.run(62.0, others)
    P = np.asarray(world.state.belief.cov, float)
    assert np.linalg.eigvalsh(P)[0] > -1e-5  # float32 of entries of 20
    np.testing.assert_array_equal(P[2 * slot : 2 * slot + 2, 2 * slot : 2 * slot + 2], np.eye(2))
