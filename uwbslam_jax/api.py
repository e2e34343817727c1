"""A recording through the estimator: messages -> frames -> session -> Result. Reads no other file and writes none.

Batch mode steps groups of frames at once, online mode steps frame by frame; both give the same bits.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable

from uwbslam_jax.errors import LogError
from uwbslam_jax.estimator import CompileClock
from uwbslam_jax.evaluation import Truth
from uwbslam_jax.files import LogReader, Source
from uwbslam_jax.measurements import Message
from uwbslam_jax.result import Result
from uwbslam_jax.session import Facts, Runner, fit_beams
from uwbslam_jax.settings import Settings

_PROGRESS_EVERY = 100
"""Messages between two reports of progress."""


def run_log(
    source: Source,
    settings: Settings,
    *,
    online: bool = False,
    progress: Callable[[int, int], object] | None = None,
) -> tuple[Result, Truth | None]:
    """Runs a recording.

    Args:
      source: an MCAP file, a ROS 2 bag folder, or several that belong together.
      online: step frame by frame, as on the robot; the result is the same.
      progress: called now and then with the number of messages read and of all.

    Returns:
      What the estimator found, and the ground truth where the recording has some.

    Raises:
      LogError: the recording cannot be read, or holds no usable scan, no odometry and no ranges between nodes at
        rest that fix a geometry.
    """
    begin = time.perf_counter()
    reader = LogReader(
        source,
        scan_topic=settings.lidar.topic,
        uwb_topic=None if settings.filter.lidar_only else settings.uwb.topic,
        odom_topic=settings.odom.topic if settings.odom.use else None,
        robot_id=settings.robot.id,
        max_range=settings.uwb.max_range,
    )
    if "uwb" not in reader.topics.values():
        settings = dataclasses.replace(settings, filter=dataclasses.replace(settings.filter, lidar_only=True))
    settings = fit_beams(settings, reader)
    with CompileClock() as clock:
        runner = Runner(settings, clock, online=online)
        for count, message in enumerate(reader):
            runner.add(message)
            if progress is not None and count % _PROGRESS_EVERY == 0:
                progress(count, reader.message_count)
        runner.finish()
        facts = Facts(list(reader.warnings), reader.dropped, reader.truncated, compile_s=clock.seconds)
        facts.wall_s = time.perf_counter() - begin
    result = runner.result(facts)
    if not len(result.stamps) and not result.beacons:
        why = f"; {reader.truncated}" if reader.truncated else ""
        raise LogError(
            f"{reader.name}: no usable scan on {settings.lidar.topic}, no odometry on {settings.odom.topic}, and no "
            f"ranges that fix a geometry on {settings.uwb.topic}{why}"
        )
    if progress is not None:
        progress(reader.message_count, reader.message_count)
    return result, runner.truth()


def run_messages(
    messages: Iterable[Message], settings: Settings, *, online: bool = False
) -> tuple[Result, Truth | None]:
    """The same for messages in memory, as a recorder got them; iterated twice."""
    begin = time.perf_counter()
    settings = fit_beams(settings, messages)
    with CompileClock() as clock:
        runner = Runner(settings, clock, online=online)
        for message in messages:
            runner.add(message)
        runner.finish()
        facts = Facts(compile_s=clock.seconds, wall_s=time.perf_counter() - begin)
    return runner.result(facts), runner.truth()
