"""Where two nodes, a range and what else is known stand in the messages of UWB radios.

The drivers of radios call their fields by few names, in a flat message or in lists of them: a layout is found by the
fields of a message. The user's own description (`uwb.message`) is one more layout.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from uwbslam_jax.settings import RangeLayout

_SOURCES = (
    *("source", "sourceid", "src", "srcid", "fromid", "from", "requesterid", "requester", "initiatorid", "initiator"),
    *("tagid", "tag", "mobileid", "listenerid", "originid", "uwbid1", "id1", "nodeid1", "nodea", "ida", "ownid"),
)
"""What the node that ranges is called [names without case and underscores], the likeliest first."""
_TARGETS = (
    *("target", "targetid", "dst", "dstid", "destination", "destinationid", "destid", "toid", "to", "responderid"),
    *("responder", "anchorid", "anchor", "beaconid", "beacon", "uwbid2", "id2", "nodeid2", "nodeb", "idb"),
    *("remoteid", "peerid", "neighborid", "neighbourid"),
)
"""What the node that it ranges to is called."""
_OF_LIST = ("id", "nodeid", "name", "address", "addr", "shortaddress", "nodeaddress")
"""What the one node is called that an element of a list, or the frame around the list, is about."""
_RANGES = ("range", "distance", "dis", "dist", "rangecorr", "rangefiltered", "rangeraw", "rangemeas", "measuredrange")
"""What the distance is called; with m, cm or mm behind it the name tells the unit."""
_BY_PLACE = ("disarr", "distances", "dists", "ranges")
"""Lists of numbers whose places are the anchors' ids, where no list of ids stands beside them."""
_RECEIVE, _FIRST_PATH = ("receivepower", "rxpower", "rxrssi"), ("firstpathpower", "fppower", "fprssi")
"""What the two powers are called."""
_VALID = ("valid", "isvalid", "validrange")
"""What a truth value is called that tells whether there is a range."""
_MOST_FIELDS, _DEEPEST = 2000, 5
"""Of a definition so much is looked at [fields, levels]; no radio's message is larger."""


@dataclass(frozen=True)
class Layout:
    """Where things stand in a message: paths as "tags[].anchors[].dis", of what stands in the range's lists beside it.

    Attributes:
      range: of the distances; unit: of these, "" where nothing tells it; whole: whether they are whole numbers.
      source, target: of the nodes; "@robot": the robot's, "@topic": what the topic calls it, "@index": its place in the
        list.
      stamp: of the time, "" for the usual places. powers: receive and first path [dBm], "" where there is none.
      roles: of what tells tags and anchors apart that share an id. valid: of a truth value.
      apart: whether tags and anchors count apart, without telling roles.
    """

    range: str
    source: str
    target: str
    unit: str = ""
    whole: bool = False
    stamp: str = ""
    powers: tuple[str, str] = ("", "")
    roles: tuple[str, str] = ("", "")
    valid: str = ""
    apart: bool = False


def described(message: RangeLayout) -> Layout:
    """The layout that a user has described."""
    ends = message.source or "@robot", message.target or "@topic"
    powers = message.receive_power, message.first_path_power
    apart = message.source == ""
    return Layout(message.range, *ends, message.unit, stamp=message.stamp, powers=powers, apart=apart)


def fields_of_type(definitions: dict[str, Any], name: str) -> dict[str, str]:
    """Every field of a message type by its path, with what it is ("float32"); lists as "nodes[].id".

    Args:
      definitions: type -> (constants, fields), as a rosbags type store has them.
    """
    found: dict[str, str] = {}
    looks = iter(range(_MOST_FIELDS))

    def walk(name: str, prefix: str, depth: int) -> None:
        for label, (kind, about) in definitions.get(name, ((), ()))[1]:
            if next(looks, None) is None:
                return
            path, listed = f"{prefix}{label}", kind.name in ("ARRAY", "SEQUENCE")
            if listed:
                (kind, about), _ = about
                octets = kind.name == "BASE" and about[0] in ("uint8", "byte", "char", "octet")
                path, about = (path, "octets") if octets else (f"{path}[]", about)  # an address is one thing
            if kind.name == "NAME" and not about.endswith(("/Time", "/Duration")):
                if depth < _DEEPEST:
                    walk(about, f"{path}.", depth + 1)
            else:
                found[path] = about if isinstance(about, str) else about[0]

    walk(name, "", 0)
    return found


def fields_of_object(message: Any) -> dict[str, str]:
    """The same of a message whose definition is not known; any number may be a float."""
    found: dict[str, str] = {}

    def walk(value: Any, path: str, depth: int) -> None:
        if len(found) >= _MOST_FIELDS or depth > 2 * _DEEPEST:
            return
        if isinstance(value, list):
            for each in value[:1]:
                walk(each, f"{path}[]", depth + 1)
        elif hasattr(value, "__dict__"):
            for label, inner in vars(value).items():
                walk(inner, f"{path}.{label}" if path else label, depth + 1)
        else:
            found[path] = {bool: "bool", str: "string"}.get(type(value), "float64")

    walk(message, "", 0)
    return found


def find_layout(fields: dict[str, str]) -> Layout | None:
    """The layout of a message with these fields, None where they are not those of a range between nodes."""
    lists = sorted({path[: at.end()] for path in fields for at in re.finditer(r"\[\]\.?", path)}, key=len)
    for place in ["", *(each for each in lists if each.endswith("."))]:
        own = {_plain(path.removeprefix(place)): path for path in fields if _stands_in(path, place)}
        around = [each for each in ["", *lists] if place.startswith(each) and each != place]
        names = [name for name in own if re.sub("(mm|cm|m)$", "", name) in _RANGES or name in _RANGES]
        name = min(names, key=_likelihood, default=None)
        target = _first(own, _TARGETS if place == "" else (*_TARGETS, *_OF_LIST))
        if name is None or target is None:
            continue
        source, outer = _first(own, _SOURCES), "@robot"
        for each in around:
            frame = {_plain(path.removeprefix(each)): path for path in fields if _stands_in(path, each)}
            outer = _first(frame, (*_SOURCES, *_OF_LIST)) or outer
        ends = (source or outer), target
        roles = tuple(_beside(end, "role", fields) for end in ends)
        return Layout(
            own[name],
            *ends,
            unit=_unit(name),
            whole="int" in fields[own[name]],
            powers=(_first(own, _RECEIVE) or "", _first(own, _FIRST_PATH) or ""),
            roles=(roles[0], roles[1]) if all(roles) else ("", ""),
            valid=next((path for name, path in own.items() if name in _VALID and fields[path] == "bool"), ""),
            apart=ends[0] == "@robot" or ("tag" in _plain(ends[0]) and "anchor" in _plain(ends[1])),
        )
    return _lists_beside(fields)


def one_a_topic(fields: dict[str, str]) -> Layout | None:
    """The layout of a message that tells a range and names no node: its topic does, or its frame."""
    name = _first({_plain(path): path for path in fields if _stands_in(path, "")}, _RANGES)
    return Layout(name, "@robot", "@topic", _unit(_plain(name)), "int" in fields[name], apart=True) if name else None


def _lists_beside(fields: dict[str, str]) -> Layout | None:
    """A list of distances, and of the ids beside it or none: then the place in the list is the id."""
    for path, kind in fields.items():
        place, _, name = path.removesuffix("[]").rpartition(".")
        place = f"{place}." if place else ""
        if not path.endswith("[]") or "int8" in kind or _plain(name) not in (*_BY_PLACE, *(f"{r}s" for r in _RANGES)):
            continue
        own = {_plain(each.removeprefix(place)): each for each in fields if _stands_in(each, place)}
        beside = {_plain(each.removesuffix("[]").removeprefix(place)): each for each in fields if each.endswith("[]")}
        ids = _first(beside, [f"{t}s" for t in (*_TARGETS, *_OF_LIST)]) or _first(beside, _TARGETS)
        if ids is None and _plain(name) not in _BY_PLACE:
            continue
        source = _first(own, (*_SOURCES, *_OF_LIST)) or "@robot"
        return Layout(path, source, ids or "@index", _unit(_plain(name)), "int" in kind, apart=True)
    return None


def _plain(name: str) -> str:
    return name.lower().replace("_", "")


def _stands_in(path: str, place: str) -> bool:
    """Whether a field stands right there: in no list or part of it."""
    return path.startswith(place) and "[" not in path[len(place) :] and "." not in path[len(place) :]


def _first(own: dict[str, str], names: Iterable[str]) -> str | None:
    return next((own[name] for name in names if name in own), None)


def _likelihood(name: str) -> int:
    return _RANGES.index(name if name in _RANGES else re.sub("(mm|cm|m)$", "", name))


def _beside(path: str, name: str, fields: dict[str, str]) -> str:
    """The path of a field that stands where another one does, "" where there is none."""
    found = f"{path[: path.rfind('.') + 1]}{name}"
    return found if found in fields else ""


def _unit(name: str) -> str:
    """Unit of a distance by its name."""
    told = re.search("(mm|cm)$", name)
    return told[1] if told else ""
