"""One step: a frame of measurements in, the corrected state and its estimate out. Reads like the list of steps.

    predict -> ranges -> match -> fuse -> draw                                (preset "robust")
    predict -> ranges -> frame, heading -> joint match -> correct -> draw     (preset "paper", module `paper`)

docs/estimator.md, "The step", says what each computes. Pure functions of fixed shape; a beacon that joins or drops
changes a mask. Start-up and beacon life are not here.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from uwbslam_jax.estimator import match_fusion, matching, motion, paper, ranging, state_vector
from uwbslam_jax.estimator.batched_cond import seldom
from uwbslam_jax.estimator.matching import Match, View
from uwbslam_jax.estimator.state import Estimate, Seen, State
from uwbslam_jax.estimator.wide_search import search
from uwbslam_jax.mapping import Grid, Sweep, grid as occupancy, undo_motion
from uwbslam_jax.measurements import Frame
from uwbslam_jax.numerics import Gaussian, rotation, safe_norm, transform_points, wrap_angle
from uwbslam_jax.settings import Config, Params

_KNOWN_ENOUGH = 0.25
"""Share of returns on observed cells below which a score says nothing: the robot looks at new ground."""
_POOR_SCORE = 0.55
"""A scan that scores less is searched for: between a right match (0.8) and a wrong one (0.4)."""
_FOUND_KNOWN = 0.4
"""A place found by the search is believed only where this share of the returns falls on observed cells."""
_ELSEWHERE = (0.3, 0.2)
"""A search has found another place when it is so far from where alignment ended [m, rad]."""
_LOST_SCORE = 0.6
"""A match that scores less at the middle level is not believed: the right ones of real buildings, whatever their scans'
spacing, do not (0.66 at least of 750), seven in eight wrong ones do."""
_FINE_SCORE = 0.8
"""A scan scores about as much where it is right."""
_WIDE_HEADING = 0.15
"""A heading less certain than this [rad] is searched for unless the scan fits finely where it was expected."""
_FEWEST_RETURNS = 20
"""A scan of fewer fits too many places to be searched for."""
_ALIGN_FLOOR = (0.1, 0.1, 0.05)
"""Alignment is LiDAR's business: the prior that holds it is never tighter than this [m, m, rad]."""
_NEAR_REACH = 5.0
"""Walls so far away are hit by a beam within a cell where the heading is known that well [m]."""
_DRAW_MOVED = (0.1, 0.05)
"""A scan is drawn when the robot has moved or turned this much since the last one [m, rad]."""
_DRAW_FIRST = 10
"""The first scans are all drawn: there is no map yet to be blurred."""
_NEW_GROUND = 0.02
"""Share of new ground in a scan from which on it is drawn where the ranges say, not where the old map says."""
_DRAW_PULL = (0.03, 0.003)
"""New ground is drawn at most this far from the match towards the fused pose, for each metre driven since the last scan
that was drawn [m, rad]."""


def step(config: Config, params: Params, state: State, frame: Frame) -> tuple[State, Estimate]:
    """One frame through the estimator.

    Differentiable in params, state and frame except through its decisions, which are held: cells, drawing, and the pose
    that a search has found.
    """
    robust = config.preset == "robust"
    if robust:
        belief = motion.predict(state.belief, params, frame.dt, frame.odometry, state.moving, state.unrest)
    else:
        belief = paper.predict(state.belief, params, frame.dt)
    usable = _usable(config, state, frame)
    belief, used, scatter = ranging.update(belief, frame.ranges, usable, params, state.scatter, robust=robust)
    state = state._replace(scatter=scatter)
    if not robust:
        belief = paper.heading_from_velocity(paper.pin_frame(belief, state.frame_slots))
    s = state_vector.unpack(belief.mean)
    sweep = undo_motion(frame.scan, params.lidar, rotation(-s.heading) @ s.velocities[0], s.yaw_rate)
    seen = Seen(frame, usable, matching.view(sweep, params.sigma_l))
    align = _match_and_fuse if robust else _joint_match
    belief, matched = align(config, params, state, belief, seen)
    state = state._replace(belief=belief, unrest=matched.unrest, map_spread=matched.map_spread)
    state, drawn = _draw(config, state, matched, seen.view)
    return state, _report(state, matched, used, drawn)


def _usable(config: Config, state: State, frame: Frame) -> Bool[Array, "M"]:
    """Which ranges are used: between nodes that have a place, and in line of sight by the power rule."""
    r = frame.ranges
    heard = r.valid & state.active[r.i] & state.active[r.j] & (not config.lidar_only)
    return heard & ranging.line_of_sight(r, config.nlos_gap_db)


class _Matched(NamedTuple):
    """A match and what was made of it.

    Attributes:
      match: see there. log_likelihood: given what was expected. information: that it was fused with.
      poor: not believed. searched: over all headings. trusted: may be drawn.
      unrest, map_spread: see State, after this match.
    """

    match: Match
    log_likelihood: Float[Array, ""]
    information: Float[Array, "3 3"]
    poor: Bool[Array, ""]
    searched: Bool[Array, ""]
    trusted: Bool[Array, ""]
    unrest: Float[Array, "2"]
    map_spread: match_fusion.MapSpread


def _match_and_fuse(
    config: Config, params: Params, state: State, belief: Gaussian, seen: Seen
) -> tuple[Gaussian, _Matched]:
    """Preset "robust": align the scan fully, search where that fails, fuse it with the information that it deserves."""
    frame, sweep = seen.frame, seen.view.sweep
    beams = jnp.sum(sweep.valid)
    match, searched, elsewhere = _match(config, state, belief, seen)
    ends = transform_points(match.pose, sweep.points)
    epoch = occupancy.epoch_seen(state.grid, ends, sweep.valid, config.resolution)
    epoch = jnp.where(frame.has_scan & _map_errs(config, state), epoch, 0.0)
    belief, spread = match_fusion.revisit(belief, state.map_spread, epoch, params)
    # before the belief is widened for this very match
    likelihood = jnp.where(frame.has_scan, match_fusion.log_likelihood(match, belief, params, beams), 0.0)
    lost = (match.known > _KNOWN_ENOUGH) & (match.blurred < _LOST_SCORE)
    lost = lost | (elsewhere & (match.known < _FOUND_KNOWN))
    sure = match_fusion.is_sure(match) & frame.has_scan
    needed = match_fusion.needs_jump(match, _expected_fit(config, state, belief, sweep))
    learning = sure & ~frame.odometry.valid
    unrest = jnp.where(learning, match_fusion.learn_unrest(state.unrest, match, belief, needed), state.unrest)
    credible = sure & (needed | match_fusion.restless(state.unrest))
    credible = credible & ~match_fusion.contradicted(match, belief, frame, seen.usable, params)
    belief = match_fusion.allow_jump(belief, match, credible)
    surprise, information = match_fusion.weigh(match, belief, params, beams)
    poor = lost | (surprise > match_fusion.SURPRISE)
    trusted = frame.has_scan & ~poor
    information = jnp.where(trusted, information, 0.0)
    belief = match_fusion.fuse(belief, match, information)
    # in a direction that the scan does not observe the alignment is arbitrary: there the belief says where to draw
    expected = match_fusion.expected_match(belief)
    place = expected[:2] + match.informed @ (match.pose[:2] - expected[:2])
    match = match._replace(pose=match.pose.at[:2].set(place))
    return belief, _Matched(match, likelihood, information, poor & frame.has_scan, searched, trusted, unrest, spread)


def _expected_fit(config: Config, state: State, belief: Gaussian, sweep: Sweep) -> Float[Array, ""]:
    """Score x share known of the scan at the pose that was expected of it."""
    few = matching.thinned(sweep)
    score, known = matching.fit(state.grid, few, match_fusion.expected_match(belief), config.resolution)
    return score * known


def _joint_match(
    config: Config, params: Params, state: State, belief: Gaussian, seen: Seen
) -> tuple[Gaussian, _Matched]:
    """Preset "paper": offset of all nodes and the heading by the joint objective, then the correction."""
    has_scan = seen.frame.has_scan
    offset = jnp.zeros(2 * config.nodes + 1, belief.mean.dtype)
    if config.scan_matching:
        offset = paper.joint_match(params, state, belief, seen, config.resolution)
        offset = jnp.where(has_scan, offset, 0.0)
    corrected = paper.correct(belief, offset)
    match = matching.assess(state.grid, seen.view, state_vector.robot_pose(corrected.mean), config.resolution)
    no = jnp.zeros((), bool)
    likelihood = jnp.where(has_scan, paper.log_likelihood(match, params, seen.view.sweep.valid), 0.0)
    matched = _Matched(match, likelihood, jnp.zeros((3, 3)), no, no, has_scan, state.unrest, state.map_spread)
    return corrected if config.correction else belief, matched


class _Found(NamedTuple):
    """A match. searched: over all headings; elsewhere: it is not what alignment alone had come to."""

    match: Match
    searched: Bool[Array, ""]
    elsewhere: Bool[Array, ""]


def _match(config: Config, state: State, belief: Gaussian, seen: Seen) -> _Found:
    """The scan aligned from the pose expected of it, or found by a search of all headings."""
    view, resolution = seen.view, config.resolution
    C = state_vector.matched_pose_jacobian(config.nodes)
    prior = Gaussian(C @ belief.mean, C @ belief.cov @ C.T + jnp.diag(jnp.array(_ALIGN_FLOOR) ** 2))
    cell = resolution * jnp.array([1.0, 1.0, 1.0 / _NEAR_REACH])
    near = jnp.all(jnp.diagonal(prior.cov) < jnp.array(_ALIGN_FLOOR) ** 2 + cell**2)
    pose = matching.align(state.grid, view, prior.mean, prior, resolution, near)
    match = matching.assess(state.grid, view, pose, resolution)
    unsure = (belief.cov[4 * config.nodes, 4 * config.nodes] > _WIDE_HEADING**2) | match_fusion.restless(state.unrest)
    fits = match.score > jnp.where(unsure, _FINE_SCORE, _POOR_SCORE)
    # on new ground a score says nothing, and a certain heading is believed
    searchable = jnp.where(match.known > _KNOWN_ENOUGH, ~fits, unsure & (state.scans_drawn > _DRAW_FIRST))
    wanted = seen.frame.has_scan & searchable & (jnp.sum(view.sweep.valid) > _FEWEST_RETURNS)

    def wide(
        found: Float[Array, "3"], grid: Grid, view: View, expected: Gaussian, last: Float[Array, "3"]
    ) -> Float[Array, "3"]:
        return search(grid, view, expected, last, found, resolution)

    expected = prior._replace(cov=prior.cov - jnp.diag(jnp.array(_ALIGN_FLOOR) ** 2) * 0.75)
    # a choice among places: held in a derivative
    found = seldom(wanted, wide, match.pose, state.grid, view, expected, C @ state.belief.mean)
    off = found - match.pose
    elsewhere = wanted & ((safe_norm(off[:2]) > _ELSEWHERE[0]) | (jnp.abs(wrap_angle(off[2])) > _ELSEWHERE[1]))
    match = lax.cond(wanted, lambda: matching.assess(state.grid, view, found, resolution), lambda: match)
    return _Found(match, wanted, elsewhere)


def _draw(config: Config, state: State, matched: _Matched, view: View) -> tuple[State, Bool[Array, ""]]:
    """The map with the scan drawn, when it may be and the robot has moved or turned since the last one.

    New ground is drawn at a known place, so what the map errs by there is known to be the pose's own error.
    """
    if not config.draws:
        return state, jnp.zeros((), bool)
    pose, sweep = matched.match.pose, view.sweep
    moved = jnp.hypot(*(pose[:2] - state.drawn_pose[:2])) > _DRAW_MOVED[0]
    turned = jnp.abs(wrap_angle(pose[2] - state.drawn_pose[2])) > _DRAW_MOVED[1]
    wanted = matched.trusted & (moved | turned | (state.scans_drawn < _DRAW_FIRST))

    def anchored() -> tuple[Float[Array, "3"], Gaussian, match_fusion.MapSpread]:
        new = _on_new_ground(config, state.grid, sweep, pose)
        novelty = jnp.sum(new) / jnp.maximum(jnp.sum(sweep.valid), 1)
        way = safe_norm(pose[:2] - state.drawn_pose[:2])
        limit = jnp.maximum(way, _DRAW_MOVED[0]) * jnp.array([_DRAW_PULL[0], _DRAW_PULL[0], _DRAW_PULL[1]])
        pull = jnp.clip(state_vector.unpack(state.belief.mean).map_error, -limit, limit)
        at = pose - jnp.minimum(1.0, novelty / _NEW_GROUND) * pull
        walls = matching.share_of_walls(view.surface, new, sweep.valid, pose[2])
        share = jnp.zeros((3, 3)).at[2, 2].set(novelty).at[:2, :2].set(walls)
        share = jnp.where(_map_errs(config, state), share, 0.0)
        spread = match_fusion.learn_spread(state.map_spread, state.belief, share, way)
        return at, match_fusion.anchor(state.belief, at, share), spread

    def draw(grid: Grid, at: Float[Array, "3"], sweep: Sweep, way: Float[Array, ""]) -> Grid:
        return occupancy.integrate(grid, at, sweep, config.resolution, way)

    kept = state.drawn_pose, state.belief, state.map_spread
    at, belief, spread = lax.cond(wanted, anchored, lambda: kept)
    state = state._replace(
        belief=belief,
        map_spread=spread,
        grid=seldom(wanted, draw, state.grid, at, sweep, state.map_spread.way),
        drawn_pose=jnp.where(wanted, pose, state.drawn_pose),
        scans_drawn=state.scans_drawn + wanted,
    )
    return state, wanted


def _map_errs(config: Config, state: State) -> Bool[Array, ""]:
    """Whether ranges can tell the pose from the map. On LiDAR alone the map is the measure, and has no error; the paper
    knows of none."""
    return jnp.any(state.active[1:]) & (config.preset == "robust")


def _on_new_ground(config: Config, grid: Grid, sweep: Sweep, pose: Float[Array, "3"]) -> Bool[Array, "B"]:
    """Which returns end where the coarsest level has no wall yet in any of the four cells around."""
    ends = transform_points(pose, sweep.points)
    on_wall, inside = matching.on_known_wall(grid, ends, config.resolution, len(grid.levels) - 1)
    return sweep.valid & inside & ~on_wall


def _report(state: State, matched: _Matched, used: ranging.RangeUpdate, drawn: Bool[Array, ""]) -> Estimate:
    s = state_vector.unpack(state.belief.mean)
    k = s.positions.shape[0]
    at = jnp.array(state_vector.pose_indices(k))
    P = state.belief.cov
    blocks = P[: 2 * k, : 2 * k].reshape(k, 2, k, 2)
    node = jnp.arange(k)
    return Estimate(
        pose=state_vector.robot_pose(state.belief.mean),
        pose_cov=P[at[:, None], at[None, :]],
        velocity=s.velocities[0],
        yaw_rate=s.yaw_rate,
        beacons=s.positions,
        beacon_covs=blocks[node, :, node, :],
        active=state.active,
        moving=state.moving,
        map_error=s.map_error,
        matched_pose=matched.match.pose,
        information=matched.information,
        score=matched.match.score,
        known=matched.match.known,
        poor=matched.poor,
        searched=matched.searched,
        drawn=drawn,
        innovation=used.innovation,
        normalised=used.normalised,
        weight=used.weight,
        log_likelihood=used.log_likelihood,
        match_log_likelihood=matched.log_likelihood,
    )
