"""Simulated recordings of the ready-made scenarios, with their truth and settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from uwbslam_jax import sim
from uwbslam_jax.errors import UsageError
from uwbslam_jax.evaluation import Truth
from uwbslam_jax.files import LogWriter, settings_file
from uwbslam_jax.measurements import Message, ScanMessage, TruthMessage
from uwbslam_jax.settings import Settings


@dataclass(frozen=True)
class Simulation:
    """A simulated recording: iterates over its messages, the same each time, one at a time.

    Attributes:
      scenario: what is simulated.
    """

    scenario: sim.Scenario

    def __iter__(self) -> Iterator[Message]:
        return sim.simulate(self.scenario)

    @cached_property
    def settings(self) -> Settings:
        """What a user would configure for this robot: lever arms and heights, never what is to be found out."""
        return settings_file.from_dict(sim.settings_overrides(self.scenario))

    @cached_property
    def truth(self) -> Truth:
        """Where robot and beacons were."""
        return Truth.from_messages(m for m in self if isinstance(m, TruthMessage))

    def save(self, path: str | Path, progress: Callable[[int], object] | None = None) -> None:
        """Writes the recording as MCAP. progress: called with the number of scans so far. Raises LogError."""
        scans = 0
        with LogWriter(path) as writer:
            for message in self:
                writer.write(message)
                scans += isinstance(message, ScanMessage)
                if progress is not None:
                    progress(scans)


def simulate(name: str, seed: int = 0, duration: float | None = None, *, beams: int | None = None) -> Simulation:
    """A ready-made scenario, see `SCENARIOS`.

    Args:
      seed: another seed is another world. duration: [s], the scenario's own where not given.
      beams: of a scan, in place of the scenario's.

    Raises:
      UsageError: there is no such scenario, or a number is out of range.
    """
    if name not in sim.SCENARIOS:
        raise UsageError(f"no scenario {name}; there are {', '.join(sim.SCENARIOS)}")
    if seed < 0:
        raise UsageError(f"seed {seed}: must not be negative")
    if duration is not None and not 0.0 < duration < 1e6:
        raise UsageError(f"duration {duration:g} s: must be greater than 0")
    if beams is not None and beams < 2:
        raise UsageError(f"beams {beams}: must be 2 at least")
    made = sim.make_scenario(name, seed, duration)
    if beams is not None:
        made = dataclasses.replace(made, lidar=dataclasses.replace(made.lidar, beams=beams))
    return Simulation(made)
