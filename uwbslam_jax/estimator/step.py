"""One step: a frame of measurements in, the corrected state and its estimate out. Reads like the list of steps.

    predict -> ranges -> match -> fuse -> draw                                    (preset "robust", DESIGN 1.1-1.9)
    predict -> ranges -> frame, heading -> joint match -> correct -> draw         (preset "paper", module `paper`)

Pure functions of fixed shape; a beacon that joins or drops changes a mask. Start-up and beacon life are not here.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from uwbslam_jax.estimator import match_fusion, matching, motion, paper, ranging, state_vector
from uwbslam_jax.estimator.batched_cond import seldom
from uwbslam_jax.estimator.matching import Match
from uwbslam_jax.estimator.state import Estimate, State
from uwbslam_jax.mapping import find_surface, grid as occupancy, undo_motion
from uwbslam_jax.measurements import Frame
from uwbslam_jax.numerics import Gaussian, rotation, safe_norm, transform_points, wrap_angle
from uwbslam_jax.settings import Config, Params

_KNOWN_ENOUGH = 0.25
"""Share of returns on observed cells below which a score says nothing: the robot looks at new ground."""
_POOR_SCORE = 0.55
_FOUND_KNOWN = 0.4
"""A place found by the search is believed only where this share of the returns falls on observed cells."""
_LOST_SCORE = 0.5
_FINE_SCORE = 0.8
_WIDE_HEADING = 0.15
"""A heading less certain than this [rad] is searched for unless the scan fits finely where it was expected."""
_FEWEST_RETURNS = 20  # a scan of fewer is not worth a search
_ALIGN_FLOOR = (0.1, 0.1, 0.05)
"""Alignment is LiDAR's business: the prior that holds it is never tighter than this [m, m, rad]."""
_NEAR_REACH = 5.0
"""Walls so far away are hit by a beam within a cell where the heading is known that well [m]."""
_DRAW_MOVED = (0.1, 0.05)
"""A scan is drawn when the robot has moved or turned this much since the last one [m, rad]."""
_DRAW_FIRST = 10  # the first scans are all drawn: there is no map yet to be blurred
_NEW_GROUND = 0.02
"""Share of new ground in a scan from which on it is drawn where the ranges say, not where the old map says."""
_DRAW_PULL = (0.003, 0.0003)
"""New ground is drawn at most this far from the match towards the fused pose [m, rad]."""


def step(config: Config, params: Params, state: State, frame: Frame) -> tuple[State, Estimate]:
    """One frame through the estimator.

    Differentiable in params, state and frame except through its decisions, which are held: cells, drawing, and the pose
    that a search has found.
    """
    belief = _predict(config, params, state, frame)
    usable = _usable(config, state, frame)
    robust = config.preset == "robust"
    belief, used, scatter = ranging.update(belief, frame.ranges, usable, params, state.scatter, robust=robust)
    state = state._replace(scatter=scatter)
    if config.preset == "paper":
        belief = paper.heading_from_velocity(paper.pin_frame(belief, state.frame_slots))
    s = state_vector.unpack(belief.mean)
    sweep = undo_motion(frame.scan, params.lidar, rotation(-s.heading) @ s.velocities[0], s.yaw_rate)
    surface = find_surface(sweep)
    align = _joint_match if config.preset == "paper" else _match_and_fuse
    belief, matched = align(config, params, state, belief, frame, sweep, surface, usable)
    state = state._replace(belief=belief, unrest=matched.unrest, map_spread=matched.map_spread)
    state, drawn = _draw(config, state, matched, sweep, surface)
    return state, _report(state, matched, used, drawn)


def _predict(config, params, state, frame) -> Gaussian:
    if config.preset == "paper":
        return paper.predict(state.belief, params, frame.dt)
    return motion.predict(state.belief, params, frame.dt, frame.odometry, state.moving, state.unrest)


def _usable(config, state, frame) -> Bool[Array, "M"]:
    r = frame.ranges
    heard = r.valid & state.active[r.i] & state.active[r.j] & (not config.lidar_only)
    return heard & ranging.line_of_sight(r, config.nlos_gap_db)


class _Matched(NamedTuple):
    """A match and what was made of it: how likely it was, the information it was given, whether it may be drawn, what
    it taught."""

    match: Match
    log_likelihood: Float[Array, ""]
    information: Float[Array, "3 3"]
    poor: Bool[Array, ""]
    searched: Bool[Array, ""]
    trusted: Bool[Array, ""]
    unrest: Float[Array, "2"]
    map_spread: match_fusion.MapSpread


def _match_and_fuse(config, params, state, belief, frame, sweep, surface, usable) -> tuple[Gaussian, _Matched]:
    """Preset "robust": align the scan fully, search where that fails, fuse what it is worth (DESIGN 1.8, 1.9)."""
    match, searched = _match(config, params, state, belief, sweep, surface, frame.has_scan)
    seen = jnp.where(frame.has_scan & _map_errs(config, state), _epoch_seen(config, state.grid, sweep, match.pose), 0.0)
    belief, spread = match_fusion.revisit(belief, state.map_spread, seen, params)
    # before the belief is widened for this very match
    likelihood = jnp.where(
        frame.has_scan, match_fusion.log_likelihood(match, belief, params, jnp.sum(sweep.valid)), 0.0
    )
    lost = (match.known > _KNOWN_ENOUGH) & (match.score < _LOST_SCORE)
    lost = lost | (searched & (match.known < _FOUND_KNOWN))
    sure = match_fusion.is_sure(match) & frame.has_scan
    needed = match_fusion.needs_jump(match, _expected_fit(config, state, belief, sweep))
    learning = sure & ~frame.odometry.valid
    unrest = jnp.where(learning, match_fusion.learn_unrest(state.unrest, match, belief, needed), state.unrest)
    credible = sure & (needed | match_fusion.restless(state.unrest))
    credible = credible & ~match_fusion.contradicted(match, belief, frame, usable, params)
    belief = match_fusion.allow_jump(belief, match, credible)
    surprise, information = match_fusion.weigh(match, belief, params, jnp.sum(sweep.valid))
    poor = lost | (surprise > match_fusion.SURPRISE)
    trusted = frame.has_scan & ~poor
    information = jnp.where(trusted, information, 0.0)
    belief = match_fusion.fuse(belief, match, information)
    # where the scan tells nothing the alignment has slid to wherever it liked: there the belief says where to draw
    expected = match_fusion.expected_match(belief)
    place = expected[:2] + match.informed @ (match.pose[:2] - expected[:2])
    match = match._replace(pose=match.pose.at[:2].set(place))
    return belief, _Matched(match, likelihood, information, poor & frame.has_scan, searched, trusted, unrest, spread)


def _expected_fit(config, state, belief, sweep) -> Float[Array, ""]:
    few = matching.thinned(sweep)
    score, known = matching.fit(state.grid, few, match_fusion.expected_match(belief), config.resolution)
    return score * known


def _joint_match(config, params, state, belief, frame, sweep, surface, usable) -> tuple[Gaussian, _Matched]:
    """Preset "paper": offset of all nodes and the heading by the joint objective, then the correction."""
    offset = jnp.zeros(2 * config.nodes + 1, belief.mean.dtype)
    if config.scan_matching:
        free = paper.free_coordinates(state.active, state.frame_slots)
        offset = paper.joint_match(state.grid, sweep, belief, frame.ranges, usable, free, params, config.resolution)
        offset = jnp.where(frame.has_scan, offset, 0.0)
    corrected = paper.correct(belief, offset)
    pose = state_vector.robot_pose(corrected.mean)
    match = matching.assess(state.grid, sweep, surface, pose, config.resolution)
    no = jnp.zeros((), bool)
    likelihood = paper.log_likelihood(match, params, sweep.valid)
    likelihood = jnp.where(frame.has_scan, likelihood, 0.0)
    matched = _Matched(match, likelihood, jnp.zeros((3, 3)), no, no, frame.has_scan, state.unrest, state.map_spread)
    return corrected if config.correction else belief, matched


def _match(config, params, state, belief, sweep, surface, has_scan) -> tuple[Match, Bool[Array, ""]]:
    C = state_vector.matched_pose_jacobian(config.nodes)
    prior = Gaussian(C @ belief.mean, C @ belief.cov @ C.T + jnp.diag(jnp.array(_ALIGN_FLOOR) ** 2))
    start = prior.mean
    blind = matching.blind_direction(surface, sweep.valid)
    cell = config.resolution * jnp.array([1.0, 1.0, 1.0 / _NEAR_REACH])
    near = jnp.all(jnp.diagonal(prior.cov) < jnp.array(_ALIGN_FLOOR) ** 2 + cell**2)
    pose = matching.align(state.grid, sweep, blind, start, prior, params.sigma_l, config.resolution, near)
    match = matching.assess(state.grid, sweep, surface, pose, config.resolution)
    unsure = (belief.cov[4 * config.nodes, 4 * config.nodes] > _WIDE_HEADING**2) | match_fusion.restless(state.unrest)
    fits = match.score > jnp.where(unsure, _FINE_SCORE, _POOR_SCORE)
    # on new ground a score says nothing, and a certain heading is believed
    searchable = jnp.where(match.known > _KNOWN_ENOUGH, ~fits, unsure & (state.scans_drawn > _DRAW_FIRST))
    wanted = has_scan & searchable & (jnp.sum(sweep.valid) > _FEWEST_RETURNS)

    def wide(found, grid, sweep, surface, likely, last, sigma_l):
        return matching.search(grid, sweep, surface, likely, (last, found), sigma_l, config.resolution)

    likely = prior._replace(cov=prior.cov - jnp.diag(jnp.array(_ALIGN_FLOOR) ** 2) * 0.75)
    last = C @ state.belief.mean
    # a choice among places: held in a derivative
    found = seldom(wanted, wide, match.pose, state.grid, sweep, surface, likely, last, params.sigma_l)

    def assessed(_):
        return matching.assess(state.grid, sweep, surface, found, config.resolution)

    return lax.cond(wanted, assessed, lambda _: match, None), wanted


def _draw(config, state, matched: _Matched, sweep, surface) -> tuple[State, Bool[Array, ""]]:
    """The map with the scan drawn, when it may be and the robot has moved or turned since the last one.

    New ground is drawn at a known place, so what the map errs by there is known to be the pose's own error.
    """
    pose = matched.match.pose
    moved = jnp.hypot(*(pose[:2] - state.drawn_pose[:2])) > _DRAW_MOVED[0]
    turned = jnp.abs(wrap_angle(pose[2] - state.drawn_pose[2])) > _DRAW_MOVED[1]
    wanted = matched.trusted & (moved | turned | (state.scans_drawn < _DRAW_FIRST))

    def anchored(_):
        new = _on_new_ground(config, state.grid, sweep, pose)
        novelty = jnp.sum(new) / jnp.maximum(jnp.sum(sweep.valid), 1)
        limit = jnp.array([_DRAW_PULL[0], _DRAW_PULL[0], _DRAW_PULL[1]])
        pull = jnp.clip(state_vector.unpack(state.belief.mean).map_error, -limit, limit)
        at = pose - jnp.minimum(1.0, novelty / _NEW_GROUND) * pull
        walls = matching.share_of_walls(surface, new, sweep.valid, pose[2])
        share = jnp.zeros((3, 3)).at[2, 2].set(novelty).at[:2, :2].set(walls)
        share = jnp.where(_map_errs(config, state), share, 0.0)
        way = safe_norm(pose[:2] - state.drawn_pose[:2])
        spread = match_fusion.learn_spread(state.map_spread, state.belief, share, way)
        return at, match_fusion.anchor(state.belief, at, share), spread

    def draw(grid, at, sweep, way):
        return occupancy.integrate(grid, at, sweep, config.resolution, way)

    kept = state.drawn_pose, state.belief, state.map_spread
    at, belief, spread = lax.cond(wanted, anchored, lambda _: kept, None)
    state = state._replace(
        belief=belief,
        map_spread=spread,
        grid=seldom(wanted, draw, state.grid, at, sweep, state.map_spread.way),
        drawn_pose=jnp.where(wanted, pose, state.drawn_pose),
        scans_drawn=state.scans_drawn + wanted,
    )
    return state, wanted


def _map_errs(config, state):
    """Whether ranges can tell the pose from the map. On LiDAR alone the map is the measure, and has no error; the paper
    knows of none."""
    return jnp.any(state.active[1:]) & (config.preset == "robust")


def _epoch_seen(config, grid, sweep, pose):
    return occupancy.epoch_seen(grid, transform_points(pose, sweep.points), sweep.valid, config.resolution)


def _on_new_ground(config, grid, sweep, pose):
    """Which returns end where the coarsest level has no wall yet in any of the four cells around."""
    ends = transform_points(pose, sweep.points)
    on_wall, inside = matching.on_known_wall(grid, ends, config.resolution, len(grid.levels) - 1)
    return sweep.valid & inside & ~on_wall


def _report(state, matched: _Matched, used, drawn) -> Estimate:
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
