"""Devices, each read in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Sequence

from uwbslam_drivers import Source, open_source
from uwbslam_jax.files import recorded
from uwbslam_jax.live.message_queue import Inbox


class Devices:
    """Sources by name, each in a thread of its own.

    Attributes:
      defect: an error that no device explains; the run ends with it.
    """

    def __init__(self, lidar: str | None, uwb: Sequence[str]):
        """Reads the URLs, None for no LiDAR; nothing is opened yet. Raises DriverError."""
        names = ["uwb"] if len(uwb) == 1 else [f"uwb {k + 1}" for k in range(len(uwb))]
        self.sources: dict[str, Source] = {} if lidar is None else {"lidar": open_source(lidar, "lidar")}
        self.sources |= {name: open_source(url, "uwb") for name, url in zip(names, uwb, strict=True)}
        self.defect: BaseException | None = None
        self._threads: list[threading.Thread] = []

    def start(self, inbox: Inbox) -> None:
        """From now on, measurements go into an inbox."""
        for name, source in self.sources.items():
            self._threads.append(threading.Thread(target=self._read, args=(source, inbox), name=name, daemon=True))
            self._threads[-1].start()

    def _read(self, source: Source, inbox: Inbox) -> None:
        try:
            for reading in source:
                inbox.put(recorded(reading.message), reading.received)
        except Exception as error:
            self.defect = error

    def close(self) -> None:
        for source in self.sources.values():
            source.close()
        for thread in self._threads:
            thread.join()

    def counts(self) -> dict[str, dict[str, int]]:
        """What each device counted, and where it is."""
        return {name: dict(sorted(source.counts.items())) for name, source in self.sources.items()}

    def troubles(self) -> list[str]:
        """Devices that do not deliver, one line each."""
        return [_trouble(name, source) for name, source in self.sources.items() if source.status != "streaming"]

    def notes(self) -> list[str]:
        """How devices talk, where a user should know, one line each."""
        return [f"{name}: {note}" for name, source in self.sources.items() for note in source.notes]

    def silent(self) -> list[str]:
        """Devices that have not delivered anything, one line each."""
        lost = [(name, source) for name, source in self.sources.items() if not source.counts["measurements"]]
        return [f"nothing was measured: {_trouble(name, source)}" for name, source in lost]


def _trouble(name: str, source: Source) -> str:
    """A device that does not deliver, and why as far as it is known."""
    why = source.failure
    if not why and source.status == "waiting" and source.counts["bytes"]:
        why = f"{source.counts['bytes']} bytes came, no measurement among them; another protocol, mode or baud?"
    return f"{name} ({source.address.url}) is {source.status}{': ' if why else ''}{why}"
