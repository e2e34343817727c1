"""A live run: devices -> queue -> Slam -> recording, view, publisher and, at the end, a Result. Prints nothing.

Devices and recorder have threads of their own; one loop takes messages in the order of their arrival and steps.
"""

from __future__ import annotations

import gc
import sys
import threading
import time
from array import array
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path

import numpy as np

from uwbslam_drivers.clock import host_time
from uwbslam_jax import process
from uwbslam_jax.api import Result, Slam
from uwbslam_jax.live.devices import Devices
from uwbslam_jax.live.message_queue import Inbox
from uwbslam_jax.live.publisher import Publisher
from uwbslam_jax.live.recorder import LogRecorder
from uwbslam_jax.measurements import Message, ScanMessage
from uwbslam_jax.session import Facts, MessageClocks, Saved, Update, saved_state
from uwbslam_jax.web import LivePage, Status

_MANY_LOST = 50
"""Losses are told along the way once they are so many [measurements]: the first seconds are no fifth of a run."""
_LASTING_S = 3.0
"""A device that does not deliver for so long is told of [s]: longer than most take to begin or to be found again."""
_IDLE_S, _STATUS_S, _SAVE_S = 0.05, 0.5, 10.0
"""Time between two looks at `go`, two figures for the page, two saved states, of which a killed run loses one [s]."""
_RECENT = 400
"""Latencies that the figures on the page are of [scans]: enough for a 99 % quantile, few enough to be recent."""
_SWITCH_S = 0.5e-3
"""A thread that waits for the interpreter gets it after so long: with 5 ms, three threads cost a scan's period [s]."""
_NO_LIDAR = "no LiDAR (--lidar URL): ranges alone give no track and no map, only where nodes at rest are to each other"
"""Warning [text]."""
_NO_LOSS = {"measurements", "bytes", "connections"}
"""What devices count that is no measurement lost [names]."""


class LiveRun:
    """One live run; `run` it once.

    Attributes:
      recording: path of the MCAP file.
      told: what a user was told while it ran, in order: subject -> line.
    """

    def __init__(
        self,
        slam: Slam,
        devices: Devices,
        recording: Path,
        *,
        page: LivePage | None = None,
        publisher: Publisher | None = None,
        tell: Callable[[str], object] = lambda line: None,
    ):
        """Opens the recording.

        Args:
          slam: the run, with room for lidar.max_beams beams.
          page, publisher: get each step.
          tell: called with each warning when it arises, once for each subject.

        Raises:
          LogError: the recording cannot be opened.
        """
        self.recording = recording
        self._slam, self._devices, self._page, self._publisher = slam, devices, page, publisher
        self.told: dict[object, str] = {}
        self._tell = tell
        self._troubles: dict[str, float] = {}  # that there are, since when
        slam.on_update = self._publish
        self._recorder = LogRecorder(recording, slam.settings)
        self._queue = Inbox(self._recorder.record)
        self._recorder.tick = lambda: self._queue.thin(host_time())
        self._clocks = MessageClocks()
        self._arrived: deque[tuple[np.ndarray, int]] = deque()  # scans on their way through the clocks
        self._scan_received: int | None = None
        self._latency_ms = array("f")
        self._beams: set[int] = set()
        self._status, self._status_at = Status(), 0.0
        self._measured: dict[str, int] = {}
        self._saver: threading.Thread | None = None
        self._saved_at = float("-inf")  # the first time as soon as there is something to save

    def run(self, go: Callable[[], bool]) -> Result:
        """Runs for as long as `go` says, which is asked between two messages. Raises what a device's driver raised."""
        interval = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_S)
        gc.collect()
        gc.freeze()  # what is there by now stays: no pause to look through it again
        try:
            self._devices.start(self._queue)
            while go() and self._devices.defect is None:
                self._turn(_IDLE_S)
            self._devices.close()
            while self._turn(0.0):
                pass
            self._take(self._clocks.flush())
            result = self._slam.finish(Facts(warnings=self._clocks.warnings, dropped=self._dropped()))
        finally:
            self._devices.close()
            self._recorder.close()
            gc.unfreeze()
            sys.setswitchinterval(interval)
        if self._devices.defect is not None:
            raise self._devices.defect
        self._save(wait=True)
        self._complete(result)
        return result

    def _turn(self, timeout: float) -> bool:
        """One message, if there is one within a time [s]."""
        arrival = self._queue.take(host_time(), timeout)
        if time.monotonic() - self._status_at > _STATUS_S:
            self._refresh()
        if arrival is None:
            return False
        message = arrival.message
        topics = self._slam.settings.uwb.topic, self._slam.settings.lidar.topic
        if isinstance(message, ScanMessage):
            self._arrived.append((message.ranges, arrival.received))
            self._beams.add(message.ranges.size)
        # with the times and topics of the recording, so that it gives the same again
        self._take(self._clocks.take(message, arrival.log_time, topics[isinstance(message, ScanMessage)]))
        return True

    def _take(self, timed: list[Message]) -> None:
        """Messages on one clock go in."""
        for message in timed:
            if isinstance(message, ScanMessage):
                ranges = None
                while ranges is not message.ranges:  # one that was dropped is passed over
                    ranges, self._scan_received = self._arrived.popleft()
            self._slam.add(message)

    def _publish(self, update: Update) -> None:
        """Called with each update, before the host looks at what it means for start-up and beacons."""
        session = self._slam.runner.session
        if self._publisher is not None:
            self._publisher.step(session, update)
        if self._page is not None:
            self._page.step(session, update, self._status)
        if update.frame.frame.has_scan and self._scan_received is not None:
            self._latency_ms.append((host_time() - self._scan_received) / 1e6)

    def _refresh(self) -> None:
        """Figures for the page, and the state for a later run, now and then."""
        now = time.monotonic()
        since, self._status_at = now - self._status_at, now
        measured = {name: source.counts["measurements"] for name, source in self._devices.sources.items()}
        rates = {name: (count - self._measured.get(name, count)) / since for name, count in measured.items()}
        self._measured = measured
        recent = np.array(self._latency_ms[-_RECENT:])
        latency = (float(np.median(recent)), float(np.percentile(recent, 99))) if len(recent) else None
        dropped = self._dropped()
        warnings = self._warn(dropped)
        troubles = [line for line in self._devices.troubles() if line not in warnings]
        told = dict(dropped + self._slam.runner.not_located)
        self._status = Status(rates, told, latency, [*troubles, *warnings])
        if self._page is not None:
            self._page.tell(self._status)
        if now - self._saved_at > _SAVE_S and self._save(wait=False):
            self._saved_at = now

    def _warn(self, dropped: Counter[str]) -> list[str]:
        """What a user should know by now, one line each; what was not told yet is told."""
        found: dict[object, str] = {} if "lidar" in self._devices.sources else {"lidar": _NO_LIDAR}
        found |= {line: line for line in self._devices.notes()}
        found |= {line: line for line in self._lasting(self._devices.troubles())}
        if self._recorder.failure:
            found["recording"] = f"recording: {self._recorder.failure}"
        found |= self._clocks.told()
        found |= self._slam.runner.warnings(dropped, _MANY_LOST)
        for subject, line in found.items():
            if subject not in self.told:
                self._tell(line)
            self.told[subject] = line
        return list(found.values())

    def _lasting(self, lines: list[str]) -> list[str]:
        """Of the troubles that there are now, those that have been for a while."""
        now = time.monotonic()
        self._troubles = {line: self._troubles.get(line, now) for line in lines}
        return [line for line, since in self._troubles.items() if now - since > _LASTING_S]

    def _save(self, *, wait: bool) -> bool:
        """Writes the state in a thread, which may be waited for. False where there is nothing to save, before the frame
        is decided, or the last one is still being written."""
        if self._saver is not None and (wait or not self._saver.is_alive()):
            self._saver.join()
            self._saver = None
        saved = self._slam.runner.saved() if self._saver is None else None
        if saved is None:
            return False
        self._saver = threading.Thread(target=self._write_state, args=(saved,), daemon=True)
        self._saver.start()
        if wait:
            self._saver.join()
        return True

    def _write_state(self, saved: Saved) -> None:
        try:
            saved_state.save(saved, self.recording.parent)
        except OSError as error:  # a full disk must not end the run
            self._recorder.failure = self._recorder.failure or f"{saved_state.FILE}: {error.strerror or error}"
        process.give_back()

    def _dropped(self) -> Counter[str]:
        counts: Counter[str] = self._queue.dropped + self._clocks.dropped
        for source in self._devices.sources.values():
            counts.update({why: n for why, n in source.counts.items() if why not in _NO_LOSS})
        return counts

    def _complete(self, result: Result) -> None:
        """Adds to the Result what only a live run knows."""
        summary, most = result.summary, self._slam.settings.lidar.max_beams
        summary["warnings"] += self._devices.notes() + self._devices.silent()
        if self._recorder.failure:
            summary["warnings"].append(f"recording: {self._recorder.failure}")
        if self._beams and max(self._beams) != most:
            summary["warnings"].append(
                f"scans have {max(self._beams)} beams, there was room for {most}: with --lidar.max-beams "
                f"{max(self._beams)} steps are faster and the recording gives the same bits again"
            )
        latency = np.array(self._latency_ms)
        if len(latency) == len(result.stamps):
            result.diagnostics["latency_ms"] = latency
        summary |= {
            "latency_ms_median": float(np.median(latency)) if len(latency) else None,
            "latency_ms_p99": float(np.percentile(latency, 99)) if len(latency) else None,
            "recording": self.recording.name,
            "devices": self._devices.counts(),
        }
