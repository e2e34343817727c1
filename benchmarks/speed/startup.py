"""How long a user waits: for help, for the imports, and from the shell to the first pose in the published frame."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.metric import Metric, Report, ratio

_CHILD = """
import sys
import uwbslam_jax as us
slam = us.Slam()
with us.estimator.CompileClock() as clock:
    for message in us.read(sys.argv[1]):
        if any(update.decided for update in slam.add(message)):
            break
print(clock.seconds)
"""
_LOG_S = 20.0
_HELPS = 5


def measure(*, quick: bool) -> Report:
    """A new process each time; the cold ones with an empty compilation cache."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = folder / "hall.mcap"
        words = [sys.executable, "-m", "uwbslam_jax"]
        simulate = [*words, "simulate", "hall40", "-o", str(log), "--duration", str(_LOG_S), "--quiet"]
        subprocess.run(simulate, check=True, stdout=subprocess.DEVNULL)
        environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache")}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        pose = [sys.executable, "-c", _CHILD, str(log)]
        cold, compiled = _timed(pose, environment)
        warm = min(_timed(pose, environment) for _ in range(1 if quick else 3))
    help_s = np.median([_timed([*words, "--help"])[0] for _ in range(_HELPS)])
    imports = np.median([_timed([sys.executable, "-c", "import uwbslam_jax.api"])[0] for _ in range(3)])
    metrics = [
        Metric("uwbslam --help", float(help_s), "s", "lower", 1.0),
        Metric("imports of a run", float(imports), "s", "lower"),
        Metric("first published pose, empty cache", cold, "s", "lower", 40.0),
        Metric("of it compilation", compiled, "s", "lower"),
        Metric("first published pose, warm cache", warm[0], "s", "lower", 10.0),
        Metric("of it loading what was compiled", warm[1], "s", "lower"),
        ratio("warm / cold", warm[0] / cold),
    ]
    about = (
        "Each a new process, timed from the shell. First published pose: of the hall at 40 Hz, when start-up has "
        "decided the frame, some eight seconds into the recording; these are stepped too."
    )
    return Report("Start", about, metrics)


def _timed(words: list[str], environment: dict[str, str] | None = None) -> tuple[float, float]:
    """Seconds from start to end, and the number that the process printed, 0 where it printed none."""
    begin = time.perf_counter()
    done = subprocess.run(words, check=True, capture_output=True, text=True, env=environment)
    seconds = time.perf_counter() - begin
    try:
        return seconds, float(done.stdout)
    except ValueError:
        return seconds, 0.0
