"""A recording as one, whether it is a file, several files, or the folder of a ROS 2 bag."""

from __future__ import annotations

import heapq
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from operator import attrgetter
from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from uwbslam_jax.errors import LogError
from uwbslam_jax.files.mcap_container import RawMessage
from uwbslam_jax.files.storage import ZSTD_MAGIC, Part, open_part, unpack_message

_MOST_CHANNELS = 1 << 16
"""A channel's number in a file has 16 bits; the next bits are the file's [channels]."""
_STORAGE = re.compile(r"(?P<series>.*?)(_(?P<number>\d+))?\.(mcap|db3|bag)(\.zstd)?")
"""What the files of a recording are called: rosbag2 and rosbag number the parts of one from 0."""
_DATE = re.compile(r"_\d{4}(-\d\d){5}$")
"""When it was begun: rosbag names each part of a split bag after it [regex]."""

Source = str | Path | Sequence[str | Path]
"""A recording: an MCAP, .db3 or .bag file, a bag's folder, or several of either that belong together."""


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
          LogError: no such file, no recording, empty, or not readable; a folder that leaves open which file is meant.
        """
        paths = [Path(source)] if isinstance(source, (str, Path)) else [Path(path) for path in source]
        if not paths:
            raise LogError("no recording was named")
        more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
        self.name = f"{paths[0]}{more}"
        self._parts = [open_part(file) for path in paths for file in files_of(path)]
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
        return heapq.merge(*streams, key=attrgetter("log_time")) if len(streams) > 1 else streams[0]

    def _of_part(self, k: int, part: Part, channels: set[int] | None) -> Iterator[RawMessage]:
        first = _MOST_CHANNELS * k
        own = None if channels is None else {number - first for number in channels if number // _MOST_CHANNELS == k}
        messages = iter(part.records(own))
        begin = next(messages, None)
        if begin is None:
            return
        packed = begin.data[:4] == ZSTD_MAGIC  # then all are
        stream = chain((begin,), messages)
        if not packed and not first:
            yield from stream
            return
        for message in stream:
            data = unpack_message(message.data) if packed else message.data
            yield message._replace(channel=message.channel + first, data=data)


def files_of(path: Path) -> list[Path]:
    """The files that a path means: itself, those that a bag's metadata.yaml names, or those of one in a folder.

    Raises:
      LogError: there is none, or it is not clear which.
    """
    if not path.exists():
        raise LogError(f"{path}: no such file")
    if not path.is_dir():
        return [path]
    present = [file for file in path.iterdir() if _STORAGE.fullmatch(file.name) and file.is_file()]
    names = {file.name for file in present}
    # rosbag2 leaves the compressed file beside the one that it has unpacked
    files = sorted((f for f in present if f.name.removesuffix(".zstd") not in names - {f.name}), key=_order)
    named = _named(path / "metadata.yaml")
    # older ones begin with the folder's name of that time; a file may have been compressed or unpacked since
    found = [_stored(path / Path(name).name) for name in named]
    if named and all(file is not None for file in found):
        return [file for file in found if file is not None]
    if any(found) or (named and len(files) != len(named)):
        missing = [name for name, file in zip(named, found, strict=True) if file is None]
        raise LogError(f"{path}: metadata.yaml names what is not there: {', '.join(missing)}")
    if files and (len(files) == 1 or named or _one_series(files)):
        return files
    if files:
        raise LogError(
            f"{path}: {len(files)} recordings and no metadata.yaml that makes them one; name those "
            f"that are: {', '.join(file.name for file in files)}"
        )
    raise LogError(f"{path}: a folder without a .mcap, .db3 or .bag file")


def _stored(file: Path) -> Path | None:
    """A file that a bag names, as it is there, with or without its compression."""
    other = file.with_name(file.name.removesuffix(".zstd") if file.suffix == ".zstd" else f"{file.name}.zstd")
    return next((each for each in (file, other) if each.is_file()), None)


def _series(file: Path) -> tuple[str, int]:
    """What a file's name says of the recording that it is a part of, and which part; -1 where it has no number."""
    match = _STORAGE.fullmatch(file.name)
    assert match is not None
    return _DATE.sub("", match["series"]), int(match["number"] or -1)


def _order(file: Path) -> tuple[int, str]:
    return _series(file)[1], file.name


def _one_series(files: list[Path]) -> bool:
    """Whether files are the numbered parts of one recording: no part is missing, none is there twice."""
    series = [_series(file) for file in files]
    return len({name for name, _ in series}) == 1 and [number for _, number in series] == list(range(len(files)))


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
