"""Start-up as a part of the host: collects keyframes and ranges, solves now and then, adopts what is decided."""

from __future__ import annotations

from uwbslam_jax.estimator import Changes, HostView, SlotEvent
from uwbslam_jax.reasons import Lack, StartUpLacks
from uwbslam_jax.result import EventKind, RunStatus
from uwbslam_jax.settings import HostParams
from uwbslam_jax.startup.adopt import adopt
from uwbslam_jax.startup.decide import choose_frame, solve
from uwbslam_jax.startup.keyframe_buffer import Buffer

_SOLVE_EVERY_S = 1.0
"""The problem is solved at most this often, in the log's time: it costs more than a second's steps [s]."""
_GROWTH = 1.05
"""And not before there are so many times the keyframes that the last one was solved with: what a long start could not
tell, a metre more does not. So its cost a second falls with the way, and a decision is late by a twentieth of it."""
_OVERDUE_S = 60.0
"""After so long it is told what start-up waits for [s]."""


class StartUp:
    """Start-up in progress.

    Attributes:
      lack: what it waits for. overdue: whether it has been waiting for long.
    """

    def __init__(self, host: HostParams):
        self.lack: Lack = StartUpLacks.MOTION
        self.overdue = False
        self._buffer = Buffer(host)
        self._began: int | None = None
        self._solved_at = self._solved_with = 0
        self._status = RunStatus.WAITING

    def look(self, view: HostView) -> Changes:
        """Takes in what was seen, and solves where that may have changed the answer."""
        self._buffer.host = view.host  # ids that were just heard have heights and biases of their own
        for frame, estimate in view.seen:
            self._buffer.add(frame, estimate)
        self._began = view.seen[0][0].stamp if self._began is None else self._began
        changes = self._solve(view) if self._is_due(view.now) else Changes()
        if self.overdue or changes.state is not None or view.now - self._began < _OVERDUE_S * 1e9:
            return changes
        self.overdue = True
        return changes._replace(events=[*changes.events, SlotEvent(0, EventKind.WAITS, self.lack)])

    def _is_due(self, now: int) -> bool:
        """Whether more can have been learnt than better averages."""
        return now - self._solved_at >= _SOLVE_EVERY_S * 1e9 and (
            self._buffer.taken >= max(_GROWTH * self._solved_with, self._solved_with + 1)
        )

    def _solve(self, view: HostView) -> Changes:
        ids, outcome = view.ids, solve(self._buffer, view.ids)
        self._solved_at = view.now
        if outcome.status is not RunStatus.WAITING:  # which costs nothing
            self._solved_with = self._buffer.taken
        self.lack = outcome.lack or self.lack
        events = [SlotEvent(0, EventKind.STATUS, outcome.status)] if outcome.status != self._status else []
        self._status = outcome.status
        known = Changes(status=outcome.status, hypotheses=outcome.hypotheses, events=events)
        if outcome.placement is None:
            return known
        frame_slots = choose_frame(outcome.placement, ids)
        state, tiles, moved = adopt(view, self._buffer, outcome.placement, frame_slots)
        found = outcome.found()
        events.append(SlotEvent(0, EventKind.FRAME_DECIDED, " and ".join(str(ids[slot]) for slot in frame_slots)))
        events += [SlotEvent(slot, EventKind.PLACED) for slot in outcome.placement.slots]
        left_out = self._buffer.sightings.keys() - set(outcome.placement.slots)
        known = known._replace(heard={slot: self._buffer.heard(slot, moved) for slot in sorted(left_out)})
        return known._replace(state=state, tiles=tiles, found=found, moved=moved, frame_slots=frame_slots)
