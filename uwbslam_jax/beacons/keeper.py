"""A beacon's life after start-up: joining, falling silent, being carried, coming back; the robot's too.

Host code that looks at a few frames at a time. A beacon that is not in the state is placed from its newest ranges to
nodes of known place, at rest or carried, when they leave one place only. One whose ranges say that it moves is taken
to be carried, until they say that it rests; one that is not heard for long leaves the state.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass, field

import numpy as np

from uwbslam_jax.beacons import state_edits
from uwbslam_jax.beacons.evidence import (
    DISTANCE,
    MEMORY_S,
    NORMALISED,
    OTHER,
    Known,
    Sightings,
    Verdict,
    calm,
    carried_place,
    judge,
    resting_elsewhere,
    resting_place,
)
from uwbslam_jax.beacons.range_table import Heard, heard
from uwbslam_jax.estimator import Changes, Estimate, HostView, Moved, SlotEvent, State, ranging
from uwbslam_jax.numerics import locate
from uwbslam_jax.result import BeaconStatus, EventKind

_SILENT_S, _DROP_S = 3.0, 60.0
"""A beacon is silent, and dropped, when it was not heard for so long [s]: behind a wall for a while, or gone."""
_SILENT_WALK = 0.01
"""Random walk of the place of a beacon that is not heard: somebody may push it [m/s^0.5]."""
_DOUBTED_S = 5.0
"""Ranges that do not fit for so long are told about."""
_LOST_M = 3.0
"""A carried beacon that is known no better than this has been lost."""
_WATCHED_S = 2.0
"""Of a beacon whose ranges fit, so much is remembered."""
_MISFIT = 4.0
"""Median absolute normalised innovation of a node's ranges to the robot beyond which they do not fit."""
_CARRIED_SHARE, _FOUND_SHARE = 0.4, 0.7
"""When the robot's ranges to so many of the beacons stop fitting at once, and one other place explains so many of
them, it is the robot that was carried. The filter may have settled where two or three of them fit by chance."""
_CARRIED_S, _CARRIED_M = 0.5, 0.5
"""Of the ranges of so long a time [s]; a robot that was carried less far finds itself by its scans [m]."""
_FITTING_SCORE, _CONTRADICTED_S = 0.7, 3.0
"""Where the scans fit, the ranges must speak against them for so long: ranges through walls and biases do so at times,
but not from one other place for long."""
_NEWEST = 4
"""So many of a beacon's newest ranges place a robot that was carried."""

_GROWTH = 1.05
"""One that is looked for over a long time is looked for again when it was ranged so many times as often."""
_WATCHED = (BeaconStatus.STATIC, BeaconStatus.MOVING, BeaconStatus.SILENT)
"""Of a beacon that is in the state its ranges are judged."""
_NOT_PLACED = (BeaconStatus.WAITING, BeaconStatus.DROPPED)
"""One that is not in the state is looked for."""


@dataclass
class _Life:
    """What the host knows of one slot. heard: when last [s]; doubted: since when its ranges do not fit [s], None where
    they do; told: whether that was told; tried: with how many rows it was looked for last."""

    status: BeaconStatus = BeaconStatus.WAITING
    heard: float = 0.0
    doubted: float | None = None
    told: bool = False
    tried: int = 0
    sightings: Sightings = field(default_factory=Sightings)


class _Copied:
    """What is asked of a state for every slot, on the host: copied once and not for each."""

    def __init__(self, state: State, sigma_n: float):
        k = state.active.shape[0]
        self.of = state
        places, velocities = np.asarray(state.belief.mean, float)[: 4 * k].reshape(2, k, 2)
        self.places = places
        self.variance = np.max(np.diag(np.asarray(state.belief.cov, float))[: 2 * k].reshape(k, 2), axis=1)
        self.variance[0] = 0.0  # the robot's track is taken as a whole, see state_edits.place
        self.rests = np.asarray(state.active) & ~np.asarray(state.moving)
        self.noise = sigma_n * ranging.loudness(np.asarray(state.scatter.log, float), np)
        self.velocities = np.where(np.asarray(state.moving)[:, None], velocities, 0.0)
        self.calm: tuple[tuple[float, list[int]], set[int]] | None = None  # when, and with whom doubted


class BeaconKeeper:
    """Life of all beacons; see the module's first lines."""

    def __init__(self) -> None:
        self._lives: dict[int, _Life] = {}
        self._start: int | None = None
        self._copied: _Copied | None = None
        self._contradicted: float | None = None  # since when another place explains the robot's ranges [s]

    def status(self, slot: int) -> BeaconStatus:
        """Of a beacon now; never RELATIVE."""
        return self._life(slot).status

    def placed(self, slot: int, stamp: int) -> None:
        """Start-up has put a beacon into the state."""
        life = self._life(slot)
        life.status, life.heard = BeaconStatus.STATIC, self._seconds(stamp)

    def heard_before(self, slot: int, stamps: np.ndarray, antenna: np.ndarray, distance: np.ndarray) -> None:
        """What start-up has heard of a beacon that it did not place.

        Args:
          stamps: (R,) in order [ns]. antenna: (R, 2) where the robot's was; distance: (R,) in the plane [m].
        """
        time = (stamps - (self._start or 0)) / 1e9
        life, none = self._life(slot), np.zeros(len(stamps))
        life.sightings.add(np.column_stack([time, none, antenna, distance, none]))
        life.heard = float(time[-1])

    def carry(self, moved: Moved) -> None:
        """The track was solved again: what was heard of beacons that are not placed was heard from there."""

        def move(time: np.ndarray, places: np.ndarray) -> np.ndarray:
            stamps = (self._start or 0) + np.round(time * 1e9).astype(np.int64)
            return moved.carry(stamps, np.column_stack([places, np.zeros(len(places))]))[:, :2]

        for life in self._lives.values():
            if life.status in _NOT_PLACED:
                life.sightings.carry(move)

    def _life(self, slot: int) -> _Life:
        return self._lives.setdefault(slot, _Life())

    def _seconds(self, stamp: int) -> float:
        self._start = stamp if self._start is None else self._start
        return (stamp - self._start) / 1e9

    def look(self, view: HostView) -> Changes:
        """What a few frames say about the beacons."""
        state, pending, sigma_n = view.state, view.seen, view.host.sigma_n
        self._seconds(pending[0][0].stamp)  # time counts from the first frame
        self._listen(heard(pending, view.host))
        span = self._seconds(pending[-1][0].stamp) - self._seconds(pending[0][0].stamp)
        now = self._seconds(pending[-1][0].stamp)
        share, found = self._find_carried_robot(state, self._known(state, sigma_n, now, 0))
        believed = self._believes(found, share, now, [e for frame, e in pending if frame.frame.has_scan])
        if found is not None and believed:
            for life in self._lives.values():
                life.sightings.forget(other=0)
            return Changes(state_edits.put_robot(state, found), events=[SlotEvent(0, EventKind.ROBOT_CARRIED)])
        events: list[SlotEvent] = []
        for slot, life in sorted(self._lives.items()):
            known = self._known(state, sigma_n, now, slot)
            if life.status in _NOT_PLACED:
                state = self._try_to_place(state, known, slot, life, events)
            elif life.status is BeaconStatus.MOVING:
                state = self._follow(state, known, slot, life, events)
            elif share <= _FOUND_SHARE:  # so many at once are not the beacons' fault
                state = self._watch(state, known, slot, life, span, events)
            trusted = life.status in (BeaconStatus.STATIC, BeaconStatus.SILENT) and life.doubted is None
            if life.status in _NOT_PLACED:
                life.sightings.condense(now)
            else:
                life.sightings.forget(before=now - (_WATCHED_S if trusted else MEMORY_S))
        return Changes(state, events=events)

    def _known(self, state: State, sigma_n: float, now: float, slot: int) -> Known:
        if self._copied is None or self._copied.of is not state:
            self._copied = _Copied(state, sigma_n)
        trusted = self._copied.rests.copy()
        trusted[self._doubted()] = False
        noise = self._copied.noise[slot]
        return Known(self._copied.places, self._copied.variance, trusted, sigma_n, noise, now)

    def _doubted(self) -> list[int]:
        return [slot for slot, life in self._lives.items() if life.doubted is not None]

    def _judge(self, known: Known, slot: int) -> Verdict:
        """What a node's newest ranges say, see `judge`; all nodes are looked at together, for as long as nothing is
        found about one. known: of the state that was copied last."""
        copied, asked = self._copied, (known.now, self._doubted())
        assert copied is not None
        if copied.calm is None or copied.calm[0] != asked:
            watched = {k: life.sightings for k, life in self._lives.items() if life.status in _WATCHED}
            copied.calm = asked, calm(watched, known, copied.noise, copied.velocities)
        if slot in copied.calm[1]:
            return Verdict(True, None, np.zeros((0, 6)), 0.0)
        return judge(self._lives[slot].sightings, known, slot, copied.velocities[slot])

    def _listen(self, ranges: Heard) -> None:
        """Remember each usable range to a node of known place."""
        time = (ranges.stamp - (self._start or 0)) / 1e9
        columns = [time + ranges.age, ranges.i, *ranges.antenna.T, ranges.flat, ranges.normalised]
        for node, other, usable in ((ranges.i, ranges.j, ranges.rests_j), (ranges.j, ranges.i, ranges.rests_i)):
            columns[OTHER] = other
            rows = np.stack(columns, axis=1)
            for slot in map(int, np.unique(node[node > 0])):
                life, mine = self._life(slot), node == slot
                life.heard = max(life.heard, float(time[mine][-1]))
                if (mine & usable).any():
                    life.sightings.add(rows[mine & usable])

    def _try_to_place(self, state: State, known: Known, slot: int, life: _Life, events: list[SlotEvent]) -> State:
        if life.sightings.reach_back and life.sightings.count < _GROWTH * life.tried:
            return state
        life.tried = life.sightings.count
        resting = resting_place(life.sightings, known)
        found = resting or carried_place(life.sightings, known)
        if found is None:
            return state
        self._enter(slot, life, BeaconStatus.MOVING if resting is None else BeaconStatus.STATIC, known)
        events.append(SlotEvent(slot, EventKind.PLACED_MOVING if resting is None else EventKind.PLACED))
        return state_edits.place(state, slot, *found, moving=resting is None)

    def _enter(self, slot: int, life: _Life, status: BeaconStatus, known: Known) -> None:
        """A beacon is at a new place: what was ranged to or from its old one is of no use."""
        life.status, life.doubted, life.told = status, None, False
        life.sightings.forget(before=known.now - 1.0)
        for other in self._lives.values():
            other.sightings.forget(other=slot)

    def _follow(self, state: State, known: Known, slot: int, life: _Life, events: list[SlotEvent]) -> State:
        """A beacon that is being carried: rests, is followed, or is lost."""
        resting = resting_place(life.sightings, known)
        if resting is not None:
            self._enter(slot, life, BeaconStatus.STATIC, known)
            events.append(SlotEvent(slot, EventKind.PUT_DOWN))
            return state_edits.place(state, slot, *resting, moving=False)
        quiet = known.now - life.heard
        if quiet > _SILENT_S or known.variance[slot] > _LOST_M**2:
            life.status = BeaconStatus.WAITING
            lost = EventKind.SILENT_MOVING if quiet > _SILENT_S else EventKind.LOST_MOVING
            events.append(SlotEvent(slot, lost))
            return state_edits.remove(state, slot)
        verdict = self._judge(known, slot)
        if verdict.carried is not None:
            return state_edits.place(state, slot, verdict.carried, verdict.rows, moving=True)
        return state

    def _watch(self, state: State, known: Known, slot: int, life: _Life, span: float, events: list[SlotEvent]) -> State:
        """A beacon that rests: is it still there, and heard?"""
        quiet = known.now - life.heard
        if quiet > _DROP_S:
            life.status = BeaconStatus.DROPPED
            events.append(SlotEvent(slot, EventKind.DROPPED))
            return state_edits.remove(state, slot)
        silent = quiet > _SILENT_S
        if silent != (life.status is BeaconStatus.SILENT):
            life.status = BeaconStatus.SILENT if silent else BeaconStatus.STATIC
            events.append(SlotEvent(slot, EventKind.SILENT if silent else EventKind.HEARD_AGAIN))
        if silent:
            return state_edits.loosen(state, slot, _SILENT_WALK**2 * span)
        verdict = self._judge(known, slot)
        if verdict.carried is not None:
            self._enter(slot, life, BeaconStatus.MOVING, known)
            events.append(SlotEvent(slot, EventKind.CARRIED))
            return state_edits.place(state, slot, verdict.carried, verdict.rows, moving=True)
        return self._doubt(state, known, slot, life, verdict, events)

    def _doubt(
        self, state: State, known: Known, slot: int, life: _Life, verdict: Verdict, events: list[SlotEvent]
    ) -> State:
        """A beacon whose ranges fit neither its place nor a motion: a clock, walls, or only the robot hears it."""
        if verdict.fits:
            if life.told:
                events.append(SlotEvent(slot, EventKind.FITS_AGAIN))
            life.doubted, life.told = None, False
            return state
        if life.doubted is None:
            life.doubted = known.now
            life.sightings.forget(before=known.now - 1.0)  # what it ranged from its old place
        elsewhere = resting_elsewhere(life.sightings, known, slot)
        if elsewhere is not None:
            self._enter(slot, life, BeaconStatus.STATIC, known)
            events.append(SlotEvent(slot, EventKind.MOVED))
            return state_edits.place(state, slot, *elsewhere, moving=False)
        if known.now - life.doubted > _DOUBTED_S and not life.told:
            life.told = True
            events.append(SlotEvent(slot, EventKind.DOUBTED, f"{verdict.bias:+.1f}"))
        return state

    def _believes(self, found: np.ndarray | None, share: float, now: float, seen: list[Estimate]) -> bool:
        """Whether the robot is believed to have been carried to another place that its ranges found: at once where the
        scans do not fit the map either, else when most of the ranges say so for long."""
        scores = [estimate.score for estimate in seen if not estimate.poor]
        fitting = len(scores) > 0 and float(np.median(scores)) > _FITTING_SCORE
        if found is None or (fitting and share <= _FOUND_SHARE):
            self._contradicted = None
            return False
        self._contradicted = now if self._contradicted is None else self._contradicted
        if fitting and now - self._contradicted < _CONTRADICTED_S:
            return False
        self._contradicted = None
        return True

    def _find_carried_robot(self, state: State, known: Known) -> tuple[float, np.ndarray | None]:
        """Share of the resting beacons that the robot's ranges do not fit, and where the robot is by its ranges alone
        when they say that it is not where the state has it."""
        active = np.asarray(state.active)
        rows, misfit = [], []
        for slot, life in self._lives.items():
            if not active[slot] or life.status is not BeaconStatus.STATIC:
                continue
            recent = life.sightings.since(known.now - _CARRIED_S)
            recent = recent[recent[:, OTHER] == 0]
            if len(recent) < 2:
                continue
            misfit.append(statistics.median(np.abs(recent[:, NORMALISED]).tolist()) > _MISFIT)
            rows.append(
                np.column_stack([np.tile(known.places[slot], (len(recent), 1)), recent[:, DISTANCE]])[-_NEWEST:]
            )
        share = float(np.mean(misfit)) if len(misfit) >= 3 else 0.0
        if share < _CARRIED_SHARE:
            return share, None
        anchors, distance = np.concatenate(rows)[:, :2], np.concatenate(rows)[:, 2]
        # the newest ranges were taken on the move: a few decimetres are as good as they get
        found = locate(anchors, distance, np.full(len(distance), 2 * known.sigma_n))
        if found is None or np.linalg.norm(found[0] - known.places[0]) < _CARRIED_M:
            return share, None
        left = np.abs(np.linalg.norm(anchors - found[0], axis=1) - distance)
        return share, found[0] if np.mean(left < _MISFIT * known.sigma_n) > _FOUND_SHARE else None
