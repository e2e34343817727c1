"""Start-up as a part of the host: collects keyframes and ranges, solves now and then, adopts what is decided."""

from __future__ import annotations

from uwbslam_jax.estimator import Changes, HostView, SlotEvent
from uwbslam_jax.result import EventKind, RunStatus
from uwbslam_jax.settings import HostParams
from uwbslam_jax.startup.adopt import adopt
from uwbslam_jax.startup.decide import choose_frame, solve
from uwbslam_jax.startup.keyframe_buffer import Buffer

_SOLVE_EVERY_S = 1.0
"""The problem is solved at most this often, in the log's time: it costs more than a second's steps [s]."""


class StartUp:
    """Start-up in progress."""

    def __init__(self, host: HostParams):
        self._buffer = Buffer(host)
        self._solved_at = self._solved_with = 0
        self._status = RunStatus.WAITING

    def look(self, view: HostView) -> Changes:
        """Takes in what was seen, and solves where that may have changed the answer."""
        self._buffer.host = view.host  # ids that were just heard have heights and biases of their own
        for frame, estimate in view.seen:
            self._buffer.add(frame, estimate)
        now, ids = view.now, view.ids
        if now - self._solved_at < _SOLVE_EVERY_S * 1e9 or self._buffer.newest == self._solved_with:
            return Changes()  # nothing can have been learnt but better averages
        self._solved_at, self._solved_with = now, self._buffer.newest
        outcome = solve(self._buffer, ids)
        events = [SlotEvent(0, EventKind.STATUS, outcome.status)] if outcome.status != self._status else []
        self._status = outcome.status
        known = Changes(status=outcome.status, hypotheses=outcome.hypotheses, events=events)
        if outcome.placement is None:
            return known
        frame_slots = choose_frame(outcome.placement, ids)
        state, tiles, moved = adopt(view, self._buffer, outcome.placement, frame_slots)
        bias = None
        if outcome.biased:
            bias = dict(zip([0, *outcome.placement.slots], map(float, outcome.placement.bias), strict=True))
        events.append(SlotEvent(0, EventKind.FRAME_DECIDED, " and ".join(str(ids[slot]) for slot in frame_slots)))
        events += [SlotEvent(slot, EventKind.PLACED) for slot in outcome.placement.slots]
        return known._replace(state=state, tiles=tiles, bias=bias, moved=moved, frame_slots=frame_slots)
