"""Messages in, a Result out: frames -> session; groups of frames in batch mode, single ones online, the same bits."""

from __future__ import annotations

import dataclasses
import itertools
import time
from array import array
from collections import Counter
from collections.abc import Iterable

import numpy as np

from uwbslam_jax.estimator import CompileClock
from uwbslam_jax.evaluation import ROBOT, TRUTH, Truth, truth_row
from uwbslam_jax.measurements import Message, ScanMessage, StampedFrame, TruthMessage
from uwbslam_jax.numerics import Column
from uwbslam_jax.reasons import Sensor
from uwbslam_jax.result import Result, RunStatus
from uwbslam_jax.session.frame_assembler import FrameAssembler
from uwbslam_jax.session.losses import losses, unplaced
from uwbslam_jax.session.message_clocks import MessageClocks
from uwbslam_jax.session.result_builder import Facts, seen, to_result
from uwbslam_jax.session.saved_state import Locator, Saved
from uwbslam_jax.session.session import CONTROL_EVERY, Session
from uwbslam_jax.session.update import Update
from uwbslam_jax.settings import Settings
from uwbslam_jax.startup import Links, Relative, static_geometry

PEEK_SCANS = 10
"""So many scans tell how many beams a scan has."""
_VARYING_BEAMS = 1.25
"""Room for larger scans than those peeked at, where the scanner's number of beams varies."""


class Runner:
    """Messages in, a Result out. Truth is set aside: the estimator never sees it.

    Attributes:
      session: the estimator's.
      truths: rows of the ground truth so far.
      not_located: messages that came before the robot was located in a saved map, by reason.
    """

    def __init__(
        self,
        settings: Settings,
        clock: CompileClock,
        *,
        online: bool = False,
        saved: Saved | None = None,
        fixed: bool = False,
    ):
        """Nothing is stepped yet.

        Args:
          clock: what JAX compiles while it is entered does not count as a step's time.
          online: step frame by frame.
          saved: go on from this, once the robot is located in it; fixed: and only localise.
        """
        self.session = Session(settings)
        self.truths = Column(dtype=TRUTH)
        self._clocks = MessageClocks()
        self._assembler = FrameAssembler(settings, self.session.config.max_ranges)
        self._group = 1 if online else CONTROL_EVERY
        self._clock = clock
        self._waiting: list[StampedFrame] = []
        self._step_ms = array("f")
        self._links = Links()
        self._saved, self._fixed = saved, fixed
        self._locator = None if saved is None else Locator(saved, settings)
        self.not_located: Counter[str] = Counter()

    def add(self, message: Message) -> list[Update]:
        """Takes in a message whose clock only its stamp tells, see MessageClocks; the updates that it leads to, none in
        batch mode."""
        timed = self._clocks.take(message, None, type(message).__name__)
        return list(itertools.chain.from_iterable(map(self.take, timed)))

    def take(self, message: Message) -> list[Update]:
        """The same for a message that is on one clock with all others, as those of a Recording are."""
        if isinstance(message, TruthMessage):
            self.truths.append(truth_row(message))
            return []
        if self._locator is not None:
            self._locate(self._locator, message)
            return []
        return [update for frame in self._assembler.add(message) for update in self._take(frame)]

    def _locate(self, locator: Locator, message: Message) -> None:
        """Looks for the robot among the saved beacons; starts the session there once it is found."""
        self.not_located["message: before the robot was located"] += 1
        place = locator.hear(message.stamp, message)
        if place is not None and self._saved is not None:
            self._assembler.slots.update(self._saved.slots)
            self.session.go_on(self._saved, place, message.stamp, fixed=self._fixed)
            self._locator = None

    def saved(self) -> Saved | None:
        """What to go on from, see Session.saved; None while the robot is not located."""
        return self.session.saved() if self._locator is None else None

    def finish(self) -> list[Update]:
        """The updates of what still waits."""
        updates = list(itertools.chain.from_iterable(map(self.take, self._clocks.flush())))
        updates += [update for frame in self._assembler.flush() for update in self._take(frame)]
        updates += self._step()
        self.session.finish()
        return updates

    def result(self, facts: Facts) -> Result:
        """The Result so far; odometry, step times and the drops of the frames are added to the facts.

        While the robot waits for motion the beacons are those of the relative geometry, their status RELATIVE.
        """
        dropped = facts.dropped + self._clocks.dropped + self._assembler.dropped + self.not_located
        wheels = [*self._assembler.wheels.told(), *self.session.odometry.told()]
        own = [*self._assembler.warnings, *self._assembler.missing()]
        # what the stamps alone tell may have been told of the log already
        warnings = list(dict.fromkeys([*facts.warnings, *self._clocks.warnings, *own, *wheels]))
        told = dataclasses.replace(
            facts,
            warnings=warnings,
            used=self._assembler.used,
            blank=self._assembler.blank,
            dropped=dropped,
            odometry_used=self._assembler.odometry_used,
            step_ms=self._step_ms,
            relative=self.relative(),
        )
        return to_result(self.session, told)

    def warnings(self, dropped: Counter[str], least: int = 1) -> dict[Sensor | str, str]:
        """What a user should know by now, one line each, by what it is about. dropped, least: see losses."""
        used = self._assembler.used
        told: dict[Sensor | str, str] = {text: text for text in self._assembler.warnings}
        told |= losses(used, dropped + self._assembler.dropped, least)
        # at rest the status says all there is to say
        if self.session.overdue and self.session.status is not RunStatus.WAITING and Sensor.RANGE not in told:
            moves = seen(self.session, odometry_used=self._assembler.odometry_used)
            told["start-up"] = unplaced(self.session.lack, ranges=used[Sensor.RANGE], seen=moves)
        return told

    def relative(self) -> Relative | None:
        """Geometry of the nodes among themselves while the robot rests; None where the ranges do not fix one, or show
        that it does not rest."""
        if self.session.decided_at is not None or self.session.status is not RunStatus.WAITING:
            return None
        settings = self.session.settings
        if self._links.moving(settings.robot.id):
            return None
        return static_geometry.solve(
            self._links.averages(), self._links.rise, origin=settings.robot.id, fit_offset=settings.uwb.fit_offset
        )

    def truth(self) -> Truth | None:
        """The ground truth so far, None where there is none of the robot."""
        known = bool(np.any(self.truths["node"] == ROBOT))
        return Truth.from_rows(self.truths.values) if known else None

    def _take(self, frame: StampedFrame) -> list[Update]:
        self._waiting.append(frame)
        return self._step() if len(self._waiting) >= min(self._group, self.session.room()) else []

    def _step(self) -> list[Update]:
        frames, self._waiting = self._waiting, []
        if not frames:
            return []
        begin, compiled = time.perf_counter(), self._clock.seconds
        updates = []
        if self._group == 1:
            updates = [self.session.update(frames[0], self.session.step(frames[0]))]
        else:
            self.session.steps(frames)
        seconds = time.perf_counter() - begin - (self._clock.seconds - compiled)
        self._step_ms.extend([max(seconds, 0.0) * 1e3 / len(frames)] * len(frames))
        if self.session.status is RunStatus.WAITING:
            ids = self.session.ids
            for frame in frames:
                self._links.hear(frame, ids, self.session.host)
        return updates


def fit_beams(settings: Settings, messages: Iterable[Message]) -> Settings:
    """Settings with no more slots for beams than the first scans need: a step's cost grows with them.

    Where the scans differ in size there is room for larger ones; what still does not fit is thinned. Without any scan
    the least will do.
    """
    scans = (m.ranges.size for m in messages if isinstance(m, ScanMessage) and m.ranges.size > 1)
    sizes = list(itertools.islice(scans, PEEK_SCANS))
    beams = max(sizes, default=2) if len(set(sizes)) <= 1 else round(max(sizes) * _VARYING_BEAMS)
    beams = min(beams, settings.lidar.max_beams)
    return dataclasses.replace(settings, lidar=dataclasses.replace(settings.lidar, max_beams=beams))
