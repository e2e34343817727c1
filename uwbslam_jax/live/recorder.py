"""The recording of a live run: messages to an MCAP file from a thread of its own, handed over several times a second.

Scans that the estimator used are on the scan topic, those that it dropped on another, so that `uwbslam run` sees what
the live run saw. Times of the log are those of arrival.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path

from uwbslam_jax.errors import LogError
from uwbslam_jax.files import LogWriter
from uwbslam_jax.live.message_queue import Arrival
from uwbslam_jax.settings import Settings

EVERY_S = 0.25
"""Time between two hand-overs to the operating system; a killed process loses no more than that and what waits [s]."""
DROPPED = "_dropped"
"""Added to the scan topic for scans that the estimator did not use [text]: another topic, which `run` ignores."""


class LogRecorder:
    """Writes what it is given until it is closed.

    Attributes:
      path: of the recording.
      failure: why nothing is written any more, in one line; "" while all is well.
    """

    def __init__(self, path: Path, settings: Settings, tick: Callable[[], object] = lambda: None):
        """Opens the file.

        Args:
          tick: called before each hand-over.

        Raises:
          LogError: the file cannot be opened.
        """
        self.path = path
        self.failure = ""
        self.tick = tick
        self._dropped_topic = settings.lidar.topic + DROPPED
        self._writer = LogWriter(path, scan_topic=settings.lidar.topic, uwb_topic=settings.uwb.topic)
        self._waiting: deque[tuple[Arrival, bool]] = deque()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def record(self, arrival: Arrival, dropped: bool) -> None:
        """Takes a message to be written soon; dropped: a scan that the estimator never sees."""
        self._waiting.append((arrival, dropped))

    def close(self) -> None:
        """Writes what waits and finishes the file."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        closing = False
        while not closing:
            closing = self._closing.wait(EVERY_S)
            self.tick()
            try:
                self._write()
            except (OSError, LogError) as error:  # a full disk must not end the run
                self.failure = self.failure or " ".join(str(error).split())
                self._waiting.clear()
        try:
            self._writer.close()
        except OSError as error:
            self.failure = self.failure or " ".join(str(error).split())

    def _write(self) -> None:
        while self._waiting:
            arrival, dropped = self._waiting.popleft()
            self._writer.write(arrival.message, arrival.log_time, self._dropped_topic if dropped else None)
        self._writer.flush()
