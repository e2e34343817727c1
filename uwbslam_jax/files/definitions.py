"""The types that the definitions in a recording define. A definition is a stranger's text: one that would cost minutes
or gigabytes to read, and that no message generator writes, is refused."""

from __future__ import annotations

import dataclasses
import functools
import re
from typing import Any

from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from uwbslam_jax.errors import LogError
from uwbslam_jax.files.mcap_container import Channel
from uwbslam_jax.files.ros_types import STORE

_LONGEST = 1 << 18
"""A definition with all that it uses is shorter [characters]: a large one has some ten thousand."""
_MOST_PARTS = 1000
"""A definition has at most so many fields and elements of fixed arrays of strings or messages [fields and elements]:
code is generated for each of them, in milliseconds."""
_MOST_EXPRESSIONS = 1000
"""An IDL text has at most so many constants, bounds and annotations [expressions]: each takes milliseconds."""
_NOT_PARSED = re.compile(r'"(?:\\.|[^"\\])*"|//[^\n]*|/\*.*?\*/', re.DOTALL)
"""Strings and comments of an IDL text [regex]."""
_ANNOTATION = re.compile(r"@\s*[\w:]+\s*\(")
"""How an annotation with arguments begins [regex]; its parenthesis is none of an expression's."""
_SHIFT = re.compile(r"<<(?!\s*\d{1,2}\b)")
"""A shift by what may be more than 99 bits [regex]: its value may fill the memory."""


def store_of(channel: Channel) -> tuple[Typestore, str]:
    """The types that a channel's definition defines, and the full name of its own. Raises LogError."""
    return _store_of(dataclasses.replace(channel, id=0))


@functools.lru_cache(maxsize=64)
def _store_of(channel: Channel) -> tuple[Typestore, str]:
    name = re.sub(r"^([^/]+)/([^/]+)$", r"\1/msg/\2", channel.schema)
    text = channel.definition.decode("utf-8", "replace")
    try:
        if not text.strip():
            return STORE, STORE.get_msgdef(name).name
        if len(text) > _LONGEST:
            raise ValueError(f"longer than {_LONGEST >> 10} KiB")
        store = get_typestore(Stores.EMPTY)
        if channel.schema_encoding in ("ros2idl", "omgidl"):
            types = {}
            for part in re.split(r"^=+\s*\n", text, flags=re.MULTILINE):
                part = re.sub(r"^(#.*|IDL: .*)$", "", part, flags=re.MULTILINE)  # rosbags' grammar has no #include
                _check_idl(part)
                types |= get_types_from_idl(part) if part.strip() else {}
        else:
            types = get_types_from_msg(text, name)
        if channel.encoding == "ros1":  # there time is a type of the language, in no definition
            types |= get_types_from_msg("uint32 sec\nuint32 nanosec\n", "builtin_interfaces/msg/Time")
        known = {key: value for key, value in types.items() if key not in store.fielddefs}
        _check_types(known)
        store.register(known)
        store.get_msgdef(name)
    except (TypesysError, KeyError, ValueError, SyntaxError, ArithmeticError, RecursionError) as error:
        why = " ".join([type(error).__name__, *str(error).splitlines()[:1]])
        why = "nested without end" if isinstance(error, RecursionError) else why
        raise LogError(f"topic {channel.topic}: unreadable definition of {channel.schema!r}: {why}") from None
    return store, name


def _check_idl(text: str) -> None:
    """Raises ValueError for expressions that take for ever: rosbags parses what a parenthesis holds a hundred times,
    what one in it holds ten thousand times."""
    plain = _ANNOTATION.sub("", _NOT_PARSED.sub("", text))
    if "(" in plain:
        raise ValueError("an expression in parentheses")
    if _SHIFT.search(plain):
        raise ValueError("a constant that is shifted too far")
    if len(re.findall(r"[=\[<]", plain)) > _MOST_EXPRESSIONS:
        raise ValueError(f"over {_MOST_EXPRESSIONS} constants and bounds")


def _check_types(types: dict[str, Any]) -> None:
    """Raises ValueError for more fields and elements than there may be, and for lists whose elements take no byte of a
    message, so that its size does not bound their number.

    Args:
      types: type -> (constants, fields), as rosbags has them.
    """

    @functools.cache
    def takes_bytes(name: str) -> bool:
        return name not in types or any(fills(*desc) for _, desc in types[name][1])

    def fills(kind: Any, about: Any) -> bool:
        if kind.name == "ARRAY":
            return about[1] > 0 and fills(*about[0])
        return kind.name != "NAME" or takes_bytes(about)

    parts = 0
    for label, (kind, about) in (field for _, fields in types.values() for field in fields):
        parts += 1
        if kind.name in ("ARRAY", "SEQUENCE"):
            (element, what), length = about
            plain = kind.name == "SEQUENCE" or (element.name == "BASE" and what[0] != "string")
            parts += 0 if plain else length
            if not fills(element, what):
                raise ValueError(f"{label} is a list of nothing")
    if parts > _MOST_PARTS:
        raise ValueError(f"{parts} fields and elements, over {_MOST_PARTS}")
