"""The first messages of a recording tell how the rest is meant: a scanner's conventions, what its times are worth."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import NamedTuple

from uwbslam_jax.files.bag import Bag
from uwbslam_jax.files.log_order import Lateness, lateness
from uwbslam_jax.files.range_messages import Options
from uwbslam_jax.files.scan_messages import FIRST_LOOK
from uwbslam_jax.files.schemas import Decoder, Role
from uwbslam_jax.files.stamp_rates import stamp_rates

_LOOK_NS, _LOOK_MESSAGES = 3_000_000_000, 4000
"""The stamps of so much of a recording's beginning are looked at [ns, messages]."""


class FirstLook(NamedTuple):
    """What the first messages tell of stamps: see stamp_rates and lateness."""

    rates: dict[str, float]
    late: Lateness | None


def look_first(
    recording: Bag, decoders: Mapping[int, Decoder], roles: Mapping[int, Role], options: Options
) -> FirstLook:
    """Reads the first messages, and settles the scans of the options."""
    scans = {number for number, role in roles.items() if role == "scan" and recording.counts[number]}
    topics = {number: recording.channels[number].topic for number in decoders}
    seen: defaultdict[str, list[tuple[int, int]]] = defaultdict(list)
    first = messages = looked = 0
    for log_time, number, data in recording.records(set(decoders)):
        first, messages = first or log_time, messages + 1
        over = log_time - first > _LOOK_NS or messages > _LOOK_MESSAGES
        if over and (looked >= FIRST_LOOK or not scans):
            break
        if over and number not in scans:
            continue
        found = decoders[number](data, log_time)
        if not over:
            seen[topics[number]] += [(m.stamp, log_time) for m in found if m.stamp > 0]
        looked += number in scans
        if number in scans and looked == FIRST_LOOK:
            options.scans.settle()
    if looked < FIRST_LOOK:
        options.scans.settle()
    rates = stamp_rates(seen)
    options.scans.settle_time(min((rates.get(topics[number], 1.0) for number in scans), default=1.0))
    options.dropped.clear()
    return FirstLook(rates, lateness({topic: times for topic, times in seen.items() if topic not in rates}))
