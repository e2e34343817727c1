"""The command line: finds the command, runs it, and turns what goes wrong into one line and an exit status.

The commands are in `cli.commands`; it is imported only once one is called, because JAX takes a second to load.
"""

from __future__ import annotations

import difflib
import os
import sys
from collections.abc import Sequence
from types import ModuleType

from uwbslam_jax import __version__
from uwbslam_jax.errors import UwbslamError

COMMANDS = {
    "demo": "simulate a robot in a workshop, run the recording, and report",
    "run": "run a recording: track, beacons, map and report into a folder",
    "tune": "find noise parameters, biases and the LiDAR's mounting from recordings",
    "live": "run on LiDAR and UWB devices, with a view in the browser",
    "simulate": "write a recording of a ready-made scenario, with ground truth",
    "evaluate": "compare a run's folder with ground truth",
    "inspect": "show what a recording holds",
    "emulate": "serve a simulated robot's sensors, to try live without hardware",
}
"""What a command does, in a line [name -> text]."""

BAD_INPUT, INTERRUPTED = 2, 130
"""Exit statuses [number]: what most programs return for bad usage, and 128 + SIGINT, as a shell reports it."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command. Returns the exit status: 0, 2 for a bad log, setting, file or usage, 130 after Ctrl-C."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        print(usage())
        return 0 if words else BAD_INPUT
    if words[0] == "--version":
        print(f"uwbslam {__version__}")
        return 0
    if words[0] not in COMMANDS:
        near = difflib.get_close_matches(words[0], COMMANDS, 1)
        hint = f", did you mean {near[0]}?" if near else f"; there are {', '.join(COMMANDS)}"
        return _fail(f"no command {words[0]}{hint}")
    try:
        from uwbslam_jax.cli import commands

        return _guarded(commands, words)
    except KeyboardInterrupt:
        print("uwbslam: interrupted", file=sys.stderr)
        return INTERRUPTED


def _guarded(commands: ModuleType, words: list[str]) -> int:
    try:
        commands.call(words[0], words[1:])
    except BrokenPipeError:  # the reader of our output has closed it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (UwbslamError, OSError) as error:
        if isinstance(error, OSError) and error.filename is not None and error.strerror is not None:
            return _fail(f"{error.filename}: {error.strerror}")
        return _fail(str(error))
    return 0


def _fail(text: str) -> int:
    print(f"uwbslam: {' '.join(text.split())}", file=sys.stderr)
    return BAD_INPUT


def usage() -> str:
    """The help of the whole program."""
    lines = [f"  {name:<10} {about}" for name, about in COMMANDS.items()]
    head = "usage: uwbslam COMMAND ...\n\nSLAM from LiDAR scans and UWB ranges, without prior knowledge.\n"
    return "\n".join([head, "commands:", *lines, "", "uwbslam COMMAND --help lists a command's options."])


if __name__ == "__main__":
    sys.exit(main())
