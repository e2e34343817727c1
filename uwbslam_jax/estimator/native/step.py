"""One step of preset "robust" as plain loops: a frame in, the corrected state and its estimate out. Twin:
estimator.step. All buffers are changed in place.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from uwbslam_jax.estimator import match_fusion as fusion_twin, matching as matching_twin
from uwbslam_jax.estimator.native import match_fusion, matching, motion, ranging
from uwbslam_jax.estimator.native.grid import Ends, Window, corner_log_odds, epoch_seen, integrate
from uwbslam_jax.estimator.native.loops import entry, loops
from uwbslam_jax.estimator.native.matching import Match, View
from uwbslam_jax.estimator.native.records import Belief, Measured, Memory, Model, Record, Told
from uwbslam_jax.estimator.native.small import wrap_angle
from uwbslam_jax.estimator.native.sweep import find_surface, thinned, undo_motion
from uwbslam_jax.estimator.native.wide_search import search
from uwbslam_jax.estimator.step import (
    _ALIGN_FLOOR,
    _DRAW_FIRST,
    _DRAW_MOVED,
    _DRAW_PULL,
    _ELSEWHERE,
    _FEWEST_RETURNS,
    _FINE_SCORE,
    _FOUND_KNOWN,
    _KNOWN_ENOUGH,
    _LOST_SCORE,
    _NEAR_REACH,
    _NEW_GROUND,
    _POOR_SCORE,
    _WIDE_HEADING,
)

f32: Any = np.float32


class Buffers(NamedTuple):
    """All that a step reads and writes.

    Attributes:
      config: (1,) CONFIG. params, state, frame, told: (1,) records. bias, height, mean, cov, nodes, scatter: see Model
        and Memory. beams, slots, ranges: see Measured. ranges_told: see Told. cells, tables: see Window.
      sweep, surface, before, after, on_wall, ends, cell: work for each beam.
    """

    config: Record
    params: Record
    bias: Float[ndarray, "K"]
    height: Float[ndarray, "K"]
    state: Record
    mean: Float[ndarray, "n"]
    cov: Float[ndarray, "n n"]
    nodes: Float[ndarray, "2 K"]
    scatter: Float[ndarray, "3 K K"]
    frame: Record
    beams: Float[ndarray, "2 B"]
    slots: Float[ndarray, "2 M"]
    ranges: Float[ndarray, "4 M"]
    told: Record
    ranges_told: Float[ndarray, "3 M"]
    cells: Float[ndarray, "_"]
    tables: Float[ndarray, "_"]
    sweep: Float[ndarray, "4 B"]
    surface: Float[ndarray, "3 B"]
    before: Float[ndarray, "3 B"]
    after: Float[ndarray, "3 B"]
    on_wall: Float[ndarray, "B"]
    ends: Float[ndarray, "10 B"]
    cell: Int[ndarray, "B"]


class Run(NamedTuple):
    """What all stages know."""

    model: Model
    memory: Memory
    measured: Measured
    window: Window
    draws: bool


class Found(NamedTuple):
    """Twin: _Found."""

    match: Match
    searched: bool
    elsewhere: bool


class Matched(NamedTuple):
    """Twin: _Matched."""

    match: Match
    information: Float[ndarray, "3 3"]
    poor: bool
    searched: bool
    trusted: bool


@entry
def step(buffers: Buffers) -> None:
    b, config, state = buffers, buffers.config[0], buffers.state[0]
    model = Model(b.params[0], b.bias, b.height)
    memory = Memory(state, b.mean, b.cov, b.nodes, b.scatter)
    measured, told = Measured(b.frame[0], b.beams, b.slots, b.ranges), Told(b.told[0], b.ranges_told)
    corner = state.grid_origin
    window = Window(b.cells, b.tables, config.cells, config.levels, config.resolution, corner[0], corner[1])
    run = Run(model, memory, measured, window, config.draws)
    belief = Belief(b.mean.astype(np.float64), b.cov.astype(np.float64))
    motion.predict(belief, model.params, measured, memory)
    usable = ranging.usable_of(measured, memory.nodes[0], config.nlos_gap_db)
    if config.lidar_only:
        usable = usable[:0]
    ranging.update(belief, measured, usable, model, memory, told)
    x, n = belief.mean, belief.mean.size
    c, s, vx, vy = math.cos(x[n - 5]), math.sin(x[n - 5]), x[(n - 5) // 2], x[(n - 5) // 2 + 1]
    sweep = undo_motion(measured, model.params.lidar, (c * vx + s * vy, c * vy - s * vx), x[n - 4], b.sweep)
    find_surface(sweep, b.surface, b.before, b.after)
    blind = matching.blind_direction(matching.walls_of(b.surface, b.sweep[2], b.sweep[2]))
    view = View(sweep, b.surface, blind, model.params.sigma_l, Ends(b.ends, b.cell), b.on_wall)
    matched = match_and_fuse(run, belief, usable, view)
    told.told.drawn = draw(run, belief, matched, view)
    for i in range(n):
        b.mean[i] = x[i]
        for j in range(n):
            b.cov[i, j] = belief.cov[i, j]
    report(belief, matched, told.told)


@loops
def returns(view: View) -> float:
    """How many beams have one."""
    count, valid = f32(0.0), view.sweep.rows[2]
    for i in range(valid.size):
        count += valid[i]
    return float(count)


@loops
def map_errs(run: Run) -> bool:
    """Whether ranges can tell the pose from the map."""
    active = run.memory.nodes[0]
    count = 0
    for slot in range(1, active.size):
        count += 1 if active[slot] > 0 else 0
    return count > 0


@loops
def match_and_fuse(run: Run, belief: Belief, usable: Int[ndarray, "u"], view: View) -> Matched:
    params, state, frame, window = run.model.params, run.memory.state, run.measured.frame, run.window
    has_scan, beams = frame.has_scan, returns(view)
    match, searched, elsewhere = match_of(run, belief, view, beams)
    epoch = 0.0
    if has_scan and map_errs(run):
        epoch = epoch_seen(window, match.pose, view.sweep, view.ends)
    match_fusion.revisit(belief, state, epoch, params)
    lost = match.known > _KNOWN_ENOUGH and match.blurred < _LOST_SCORE
    lost = lost or (elsewhere and match.known < _FOUND_KNOWN)
    sure = match_fusion.is_sure(match) and has_scan
    needed = match_fusion.needs_jump(match, expected_fit(window, belief, view))
    innovation = match_fusion.innovation_of(match, belief)
    if sure and not frame.odometry_valid:
        match_fusion.learn_unrest(state.unrest, match_fusion.excess_of(innovation), needed)
    credible = sure and (needed or match_fusion.restless(state.unrest))
    if credible and not match_fusion.contradicted(belief, innovation.nu, run.measured, usable, run.model):
        match_fusion.allow_jump(belief, match_fusion.excess_of(innovation))
        innovation = match_fusion.innovation_of(match, belief)
    Y = match_fusion.information_of(match, params, beams)
    surprise = match_fusion.surprise_of(Y, innovation)
    poor = lost or surprise > fusion_twin.SURPRISE
    trusted = has_scan and not poor
    weight = 1.0 / (1.0 + surprise / fusion_twin.SURPRISE) ** 2
    for i in range(3):
        for j in range(3):
            Y[i, j] = Y[i, j] * weight if trusted else 0.0
    match_fusion.fuse(belief, Y, innovation)
    # in a direction that the scan does not observe the alignment is arbitrary: there the belief says where to draw
    expected, pose = match_fusion.expected_match(belief.mean), match.pose.copy()
    for i in range(2):
        pose[i] = expected[i]
        for j in range(2):
            pose[i] += match.informed[i, j] * (match.pose[j] - expected[j])
    match = Match(pose, match.information, match.informed, match.score, match.known, match.blurred)
    return Matched(match, Y, poor and has_scan, searched, trusted)


@loops
def expected_fit(window: Window, belief: Belief, view: View) -> float:
    few = thinned(view.sweep, matching_twin._CHECKED_BEAMS)
    score, known = matching.fit(window, 0, match_fusion.expected_match(belief.mean), few, view.ends)
    return score * known


@loops
def match_of(run: Run, belief: Belief, view: View, beams: float) -> Found:
    state, window, n = run.memory.state, run.window, belief.mean.size
    mean, cov = match_fusion.expected_match(belief.mean), match_fusion.expected_cov(belief.cov)
    last = match_fusion.expected_match(run.memory.mean.astype(np.float64))
    near = True
    for i in range(3):
        floor = (_ALIGN_FLOOR[0] if i < 2 else _ALIGN_FLOOR[2]) ** 2
        cell = window.size / (1.0 if i < 2 else _NEAR_REACH)
        cov[i, i] += floor
        near = near and cov[i, i] < floor + cell**2
    prior = Belief(mean, cov)
    pose = matching.align(window, view, mean, prior, near)
    match = matching.assess(window, view, pose)
    unsure = belief.cov[n - 5, n - 5] > _WIDE_HEADING**2 or match_fusion.restless(state.unrest)
    fits = match.score > (_FINE_SCORE if unsure else _POOR_SCORE)
    # on new ground a score says nothing, and a certain heading is believed
    searchable = not fits if match.known > _KNOWN_ENOUGH else unsure and state.scans_drawn > _DRAW_FIRST
    if not (run.measured.frame.has_scan and searchable and beams > _FEWEST_RETURNS):
        return Found(match, False, False)
    for i in range(3):
        cov[i, i] -= 0.75 * (_ALIGN_FLOOR[0] if i < 2 else _ALIGN_FLOOR[2]) ** 2
    found = search(window, view, prior, last, pose)
    off = math.hypot(found[0] - pose[0], found[1] - pose[1])
    elsewhere = off > _ELSEWHERE[0] or abs(wrap_angle(found[2] - pose[2])) > _ELSEWHERE[1]
    return Found(matching.assess(window, view, found), True, elsewhere)


@loops
def draw(run: Run, belief: Belief, matched: Matched, view: View) -> bool:
    """Whether the scan was drawn: when it may be and the robot has moved or turned since the last one."""
    pose, state = matched.match.pose, run.memory.state
    way = math.hypot(pose[0] - state.drawn_pose[0], pose[1] - state.drawn_pose[1])
    turned = abs(wrap_angle(pose[2] - state.drawn_pose[2]))
    moved = way > _DRAW_MOVED[0] or turned > _DRAW_MOVED[1] or state.scans_drawn < _DRAW_FIRST
    if not (run.draws and matched.trusted and moved):
        return False
    epoch = state.map_spread_way
    at = anchored(run, belief, pose, view, way)
    integrate(run.window, at, view.sweep, epoch, view.ends)
    for i in range(3):
        state.drawn_pose[i] = pose[i]
    state.scans_drawn += 1
    return True


@loops
def anchored(run: Run, belief: Belief, pose: Float[ndarray, "3"], view: View, way: float) -> Float[ndarray, "3"]:
    """Where the scan is drawn; belief and spread of the map's errors are what they are once it is."""
    valid, new, n, fresh = view.sweep.rows[2], view.on_wall, belief.mean.size, f32(0.0)
    on_new_ground(run.window, pose, view, new)
    for i in range(new.size):
        fresh += new[i]
    beams = returns(view)
    novelty = float(fresh) / max(beams, 1.0)
    at, share = pose.copy(), np.zeros((3, 3))
    for i in range(3):
        limit = max(way, _DRAW_MOVED[0]) * (_DRAW_PULL[0] if i < 2 else _DRAW_PULL[1])
        at[i] -= min(1.0, novelty / _NEW_GROUND) * min(max(belief.mean[n - 3 + i], -limit), limit)
    if map_errs(run):
        every, some = matching.walls_of(view.surface, valid, valid), matching.walls_of(view.surface, valid, new)
        share = matching.share_of_walls(every, some, pose[2], beams)
        share[2, 2] = novelty
    match_fusion.learn_spread(run.memory.state, belief.cov, share, way)
    match_fusion.anchor(belief, at, share)
    return at


@loops
def on_new_ground(window: Window, pose: Float[ndarray, "3"], view: View, new: Float[ndarray, "B"]) -> None:
    """1 for returns that end where the coarsest level has no wall yet in any of the four cells around."""
    corner_log_odds(window, window.levels - 1, pose, view.sweep, view.ends)
    matching.on_known_wall(view.ends, new)
    for i in range(new.size):
        new[i] = view.ends.rows[4, i] - new[i]


@loops
def report(belief: Belief, matched: Matched, told: Record) -> None:
    """What is told but for the ranges, which tell it themselves, and whether the scan was drawn."""
    x, P, n, match = belief.mean, belief.cov, belief.mean.size, matched.match
    for i in range(3):
        row = match_fusion.pose_row(n, i)
        told.pose[i], told.map_error[i], told.matched_pose[i] = x[row], x[n - 3 + i], match.pose[i]
        for j in range(3):
            told.pose_cov[i, j] = P[row, match_fusion.pose_row(n, j)]
            told.information[i, j] = matched.information[i, j]
    told.velocity[0], told.velocity[1], told.yaw_rate = x[(n - 5) // 2], x[(n - 5) // 2 + 1], x[n - 4]
    told.score, told.known, told.poor, told.searched = match.score, match.known, matched.poor, matched.searched
