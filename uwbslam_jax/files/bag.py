"""A recording as one, whether it is a file, several files, or the folder of a ROS 2 bag."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from uwbslam_jax.errors import LogError
from uwbslam_jax.files.mcap_container import RawMessage, Recording

_MOST_CHANNELS = 1 << 16
"""A channel's number in a file has 16 bits; the next bits are the file's [channels]."""

Source = str | Path | Sequence[str | Path]
"""A recording: an MCAP file, a bag's folder, or several of either that belong together."""


class Bag:
    """Files opened for reading as one recording, its messages merged by log time.

    Attributes:
      name: what messages call it: the path, or the first one and how many more.
      channels: every channel by its number, which is another one in each file.
      counts: messages by channel number (of a broken file: those that are whole).
      start, end: first and last log time [ns]; both 0 for a recording without messages.
    """

    def __init__(self, source: Source):
        """Opens the files.

        Raises:
          LogError: no such file, not an MCAP, empty, or not readable; a folder that leaves open which file is meant.
        """
        paths = [Path(source)] if isinstance(source, (str, Path)) else [Path(path) for path in source]
        if not paths:
            raise LogError("no recording was named")
        more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
        self.name = f"{paths[0]}{more}"
        self._parts = [Recording(file) for path in paths for file in files_of(path)]
        self.channels = {
            number + _MOST_CHANNELS * k: replace(channel, id=number + _MOST_CHANNELS * k)
            for k, part in enumerate(self._parts)
            for number, channel in part.channels.items()
        }
        self.counts: Counter[int] = Counter()
        for k, part in enumerate(self._parts):
            self.counts.update({number + _MOST_CHANNELS * k: count for number, count in part.counts.items()})
        spoken = [part for part in self._parts if part.end]
        self.start = min((part.start for part in spoken), default=0)
        self.end = max((part.end for part in spoken), default=0)

    @property
    def truncated(self) -> str | None:
        """Where and why the recording breaks, None where it does not (or is not known to, before `records`)."""
        if len(self._parts) == 1:
            return self._parts[0].truncated
        return "; ".join(f"{part.path.name}: {part.truncated}" for part in self._parts if part.truncated) or None

    def records(self, channels: set[int] | None = None) -> Iterator[RawMessage]:
        """Yields the messages of these channels (all by default) by log time, equal ones in the order of the files."""
        streams = [self._of_part(k, part, channels) for k, part in enumerate(self._parts)]
        return heapq.merge(*streams, key=attrgetter("log_time"))

    def _of_part(self, k: int, part: Recording, channels: set[int] | None) -> Iterator[RawMessage]:
        first = _MOST_CHANNELS * k
        own = None if channels is None else {number - first for number in channels if number // _MOST_CHANNELS == k}
        for message in part.records(own):
            yield message._replace(channel=message.channel + first) if first else message


def files_of(path: Path) -> list[Path]:
    """The MCAP files that a path means: itself, those that a bag's metadata.yaml names, or the only one in a folder.

    Raises:
      LogError: there is none, or it is not clear which.
    """
    if not path.exists():
        raise LogError(f"{path}: no such file")
    if not path.is_dir():
        return [path]
    if named := _named(path / "metadata.yaml"):
        odd = [name for name in named if not name.endswith(".mcap")]
        if odd:
            raise LogError(f"{path}: a bag of {Path(odd[0]).suffix} files: convert it to MCAP (ros2 bag convert)")
        missing = [name for name in named if not (path / name).exists()]
        if missing:
            raise LogError(f"{path}: metadata.yaml names what is not there: {', '.join(missing)}")
        return [path / name for name in named]
    files = sorted(path.glob("*.mcap"))
    if len(files) == 1:
        return files
    if files:
        raise LogError(
            f"{path}: {len(files)} .mcap files and no metadata.yaml that makes them one recording; name those "
            f"that are: {', '.join(file.name for file in files)}"
        )
    raise LogError(f"{path}: a folder without a .mcap file")


def _named(metadata: Path) -> list[str]:
    """What a bag's metadata.yaml lists under relative_file_paths; nothing where there is none."""
    if not metadata.exists():
        return []
    try:
        loaded = YAML(typ="safe").load(metadata.read_text(encoding="utf-8"))
        names = ((loaded or {}).get("rosbag2_bagfile_information") or {}).get("relative_file_paths") or []
        return [str(name) for name in names]
    except (OSError, ValueError, AttributeError, TypeError, YAMLError) as error:
        raise LogError(f"{metadata}: {' '.join(str(error).split())}") from None
