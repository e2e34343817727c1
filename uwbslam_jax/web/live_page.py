"""What the live view shows: a run in progress as the events that let its page grow. No socket here.

The loop calls `step` with each estimate, which only keeps references; `events`, in another thread, makes text of them.
"""

from __future__ import annotations

import html
import json
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from uwbslam_jax.mapping import Grid, Tiles
from uwbslam_jax.result import Event as RunEvent, RunStatus
from uwbslam_jax.session import Session, Update
from uwbslam_jax.web import page
from uwbslam_jax.web.page_data import beacon, extent, numbers, picture

STEP_S = 0.1
"""Time between two steps that are shown: a scan's period, which looks continuous [s]."""
WORDS_S, MAP_S = 0.5, 1.0
"""Time between two updates of the words, which are read no faster, and of the map, which is large [s]."""
_TRACK = 4000
"""Poses of the track that are kept [poses]: more than a screen shows; then every other one is left out."""
_LINK_S = 1.0
"""A link is shown for so long after its last range: several rounds of ranging [s]."""
_EVENTS = 12
"""Events that are listed [lines]: what a screen holds beside the beacons."""
_HINTS = {
    RunStatus.WAITING: "Waiting for motion: beacons and frame are found once the robot drives.",
    RunStatus.PLACING: "Placing beacons: not enough is known of them yet. Drive on, and turn.",
    RunStatus.UNDECIDED: "Reflection undecided: the ranges fit a mirrored place as well until the robot turns.",
}
"""What helps a run whose frame is not decided [status -> text]."""
_UNSEEN = "No scan and no odometry so far: nothing shows how the robot moves."
"""Says it in place of a hint to drive [text]."""
_COLUMNS = ("t", "x", "y", "yaw", "xx", "xy", "yy")
"""Columns of the track, as map.js names them [s, m, m, rad, m^2, m^2, m^2]."""

Event = tuple[str, str]
"""Name and JSON of an event."""


@dataclass
class Status:
    """Figures of a live run that are not in its estimates.

    Attributes:
      rates: of each device by name [1/s]; dropped: by reason.
      latency_ms: scan arrival to published pose, median and 99 % of the last few hundred; None before the first.
      troubles: what a user should repair or know, one line each.
    """

    rates: dict[str, float] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    latency_ms: tuple[float, float] | None = None
    troubles: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Now:
    """One step, as the loop left it: t since the first scan [s]; links, with when they were last ranged [s]."""

    t: float
    update: Update
    events: list[RunEvent]
    links: Mapping[tuple[int, int], tuple[float, float | None]]


class LivePage:
    """The page of a live run.

    Attributes:
      title: heading, plain text.
      watched: whether anybody looks; without, nothing is copied.
    """

    def __init__(self, title: str, *, scans: bool = True):
        """scans: whether a LiDAR is there; time then counts from its first scan, as in the report."""
        self.title = title
        self._scans = scans
        self._first = f"Waiting for the first {'scan' if scans else 'range'}."
        self._motion = False  # whether anything has shown it
        self.watched = False
        self._now: _Now | None = None
        self._sent: _Now | None = None
        self._status = Status()
        self._map: tuple[Grid, Tiles] | None = None
        self._map_at = 0.0
        self._picture: dict[str, Any] = {"map": None, "extent": [-5.0, -5.0, 5.0, 5.0]}
        self._track: list[tuple[float | None, ...]] = []
        self._every, self._skipped = 1, 0
        self._start: int | None = None
        self._events = 0
        self._lidar = (0.0, 0.0, 0.0)
        self._links: dict[tuple[int, int], tuple[float, float | None]] = {}
        self._lock = threading.Lock()
        self._fresh = False

    def step(self, session: Session, update: Update, status: Status) -> None:
        """Takes in one step; called by the loop."""
        if self._start is None:
            if self._scans and update.score is None:
                return
            self._start = update.stamp
        self._motion = self._motion or update.score is not None or bool(update.frame.frame.odometry.valid)
        t = (update.stamp - self._start) / 1e9
        before = self._now
        self._links |= {pair: (t, residual) for pair, residual in update.links.items()}
        if len(session.history.events) != self._events:
            self._events = len(session.history.events)
            self._take_track(session)
        elif before is not None and t - before.t < STEP_S:
            return
        self._lidar = session.settings.robot.lidar
        links = {pair: link for pair, link in self._links.items() if link[0] > t - _LINK_S}
        now = _Now(t, update, session.history.events[-_EVENTS:], links)
        with self._lock:
            self._now, self._status = now, status
            self._track.append(_row(t, update.pose, update.cov))
            if len(self._track) > _TRACK:
                del self._track[1:-1:2]
        if self.watched and time.monotonic() - self._map_at > MAP_S:
            self._map_at = time.monotonic()
            self._map = jax.tree.map(lambda leaf: np.array(leaf, copy=True), session.state.grid), session.tiles.copy()

    def tell(self, status: Status) -> None:
        """Takes in figures; called by the loop also while no step comes."""
        with self._lock:
            self._status = status

    def _take_track(self, session: Session) -> None:
        """What happened may have changed the track so far: the frame was decided, or revised."""
        history = session.history
        pick = np.unique(np.linspace(0, max(len(history.stamps) - 1, 0), _TRACK // 2).astype(int))
        with self._lock:
            self._track = [
                _row(float(history.stamps[k] - (self._start or 0)) / 1e9, history.poses[k], history.covs[k])
                for k in pick[: len(history.stamps)]
            ]
            self._fresh = True

    def whole(self) -> str:
        """The page as it is now, for a new viewer."""
        notice = page.notices([("info", self._first)])
        sections = "".join(
            page.section(title, f'<div id="{name}"></div>')
            for name, title in (("beacon-words", "Beacons"), ("event-words", "Events"))
        )
        data = {**self.begin(), "live": True, "diagnostics": []}
        data["residuals"] = {"t": [], "v": [], "pair": [], "pairs": [], "kind": [], "bound": 1.0}
        return page.render(page.Parts(self.title, "", notice, "", f'<div class="two">{sections}</div>', data))

    def begin(self) -> dict[str, Any]:
        """What a new viewer has to know: the event `begin`."""
        with self._lock:
            rows = list(self._track)
            now = self._now
        track = {name: [row[k] for row in rows] for k, name in enumerate(_COLUMNS)}
        beacons = [] if now is None else _beacons(now)
        scan, links = ([], []) if now is None else (_scan(now, self._lidar), _shown_links(now))
        last = rows[-1][0] if rows else None
        shown = {"track": track, "beacons": beacons, "scan": scan, "links": links}
        return {**self._picture, "duration": last or 1e-3, **shown}

    def events(self) -> Iterator[Event]:
        """What has changed since the last call, one event after the other."""
        with self._lock:
            now, fresh, self._fresh = self._now, self._fresh, False
        if now is None:
            return
        if fresh:
            yield "begin", _json(self.begin())
        seen, self._map = self._map, None
        if seen is not None:
            image = seen[1].image(seen[0])
            drawn = picture(image)
            spots = [now.update.pose[None, :2], *(b.position[None] for b in now.update.beacons.values())]
            self._picture = {"map": drawn, "extent": extent(spots, drawn)}
            yield "map", _json(self._picture)
        if now is self._sent:
            return
        self._sent = now
        pose = dict(zip(_COLUMNS, _row(now.t, now.update.pose, now.update.cov), strict=True))
        shown = {"pose": pose, "scan": _scan(now, self._lidar), "links": _shown_links(now), "beacons": _beacons(now)}
        yield "step", _json(shown)

    def words(self) -> Event:
        """Figures, warnings and tables: the event `words`, HTML by the id of the element that holds it."""
        with self._lock:
            now, status = self._now, self._status
        notices = [("warn", text) for text in status.troubles]
        if now is None:
            return "words", _json({"notices": page.notices([*notices, ("info", self._first)])})
        update = now.update
        if not update.decided and update.status in _HINTS:
            notices.append(("warn", _HINTS[update.status] if self._motion else _UNSEEN))
        if bool(update.estimate.poor) and update.score is not None:
            notices.append(("info", "The scan does not fit the map: it is not drawn."))
        begin = self._start or 0
        rows = [(f"{(event.stamp - begin) / 1e9:.1f}", event.text) for event in reversed(now.events)]
        return "words", _json(
            {
                "notices": page.notices(notices),
                "tiles": page.tiles(_figures(now, status)),
                "beacon-words": page.beacon_table(list(update.beacons.values())),
                "event-words": page.table(("Time [s]", "What happened"), rows, [0]),
            }
        )


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def _row(t: float, pose: np.ndarray, cov: np.ndarray) -> tuple[float | None, ...]:
    """Time, pose and covariance of the place as the page has them."""
    return (*numbers(np.array([t, *pose]), 3), *numbers(np.array([cov[0, 0], cov[0, 1], cov[1, 1]]), 6))


def _scan(now: _Now, lidar: tuple[float, float, float]) -> list[list[float | None]]:
    """Every other return of the scan in the frame of the map."""
    flat = numbers(now.update.scan_points(lidar, every=2), 2)
    return [flat[k : k + 2] for k in range(0, len(flat), 2)]


def _shown_links(now: _Now) -> list[list[float | None]]:
    return [[*pair, None if r is None else numbers(np.array(r), 3)[0]] for pair, (_, r) in sorted(now.links.items())]


def _beacons(now: _Now) -> list[dict[str, Any]]:
    return [beacon(b, 3) for b in now.update.beacons.values() if np.isfinite(b.position).all()]


def _figures(now: _Now, status: Status) -> list[tuple[str, str, str]]:
    """Headline figures."""
    median, worst = status.latency_ms or (None, None)
    e = now.update.estimate
    states = [b.status for b in now.update.beacons.values()]
    counts = ", ".join(f"{states.count(s)} {html.escape(s)}" for s in dict.fromkeys(states))
    speed = float(np.hypot(*np.asarray(e.velocity, float)))
    rates = [(name, page.figure(rate, "Hz", 1), "measurements a second") for name, rate in status.rates.items()]
    dropped = sum(status.dropped.values())
    reasons = ", ".join(f"{count} {html.escape(why)}" for why, count in sorted(status.dropped.items()))
    return [
        ("Time", page.figure(now.t, "s", 1), html.escape(now.update.status)),
        ("Beacons placed", str(int(np.sum(e.active)) - 1), counts),
        ("Speed", page.figure(speed, "m/s", 2), f"match score {page.figure(float(e.score), '', 2)}"),
        ("Arrival to pose", page.figure(median, "ms", 1), f"99 % {page.figure(worst, 'ms', 1)}"),
        *((html.escape(name), value, note) for name, value, note in rates),
        ("Dropped", str(dropped), reasons or "nothing"),
    ]
