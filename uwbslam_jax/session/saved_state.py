"""What a run has found, saved to go on from: filter, map and beacons as one file, state.npz. And going on from it.

A run that goes on knows neither where the robot is now nor how it is turned: its ranges to the saved beacons tell the
place, and the search of the first match the heading.
"""

from __future__ import annotations

import json
import os
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from uwbslam_jax.beacons import state_edits
from uwbslam_jax.errors import RunError
from uwbslam_jax.estimator import State, init
from uwbslam_jax.mapping import Tiles
from uwbslam_jax.measurements import RangeMessage
from uwbslam_jax.numerics import Gaussian, locate
from uwbslam_jax.settings import Found, Settings, make_config, make_host_params, make_params

FILE, _VERSION = "state.npz", 2
"""Name of a saved state in a run's folder, and of what it holds [number]: another one is refused."""
_WINDOW_S = 0.5
"""The robot is placed by the ranges of so long a time; it may drive meanwhile."""
_FEWEST = 3
"""Beacons that place the robot."""
_PATIENCE_S = 5.0
"""Where the ranges do not tell for so long, the robot is taken to be where it was."""
_PINNED_M = 1e-3
"""Standard deviation of a beacon that is taken as it is [m]."""


@dataclass(frozen=True)
class Saved:
    """What a run has found, on the host.

    Attributes:
      state: of the estimator, numpy; tiles: of its map.
      slots: node id -> slot; found: what ranges were found to be off by.
    """

    state: State
    tiles: Tiles
    slots: dict[int, int]
    found: Found


def save(saved: Saved, directory: Path) -> None:
    """Writes state.npz; one that is there is replaced as a whole or not at all. Raises OSError."""
    places, layers = saved.tiles.dump()
    arrays = {f"state{name}": leaf for name, leaf in _leaves(saved.state)}
    arrays |= {"tiles": places} | {f"layer{k}": layer for k, layer in enumerate(layers)}
    about = {"version": _VERSION, "resolution": saved.tiles.resolution}
    found = saved.found
    about |= {"slots": list(saved.slots.items()), "found_bias": list(found.bias.items())}
    about |= {"found_height": list(found.height.items()), "found_scale": found.scale}
    part = directory / f"{FILE}.part"
    with part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, about=np.array(json.dumps(about)), **arrays)
    os.replace(part, directory / FILE)


def load(directory: Path, settings: Settings) -> Saved:
    """Reads state.npz for a run with these settings.

    Raises:
      RunError: there is none, it is damaged, or its map or slots have another size than these settings ask for.
    """
    path = directory / FILE
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:  # of a damaged one it keeps a path open
            arrays: dict[str, Any] = {name: file[name] for name in file.files}
        about = json.loads(str(arrays["about"]))
        if about["version"] != _VERSION:
            raise RunError(f"{path}: version {about['version']}, this program reads {_VERSION}")
        if about["resolution"] != settings.map.resolution:
            raise RunError(f"{path}: saved with map.resolution {about['resolution']:g}")
        tiles = Tiles(settings.map.resolution)
        tiles.load(arrays["tiles"], [arrays[f"layer{k}"] for k in range(sum(n.startswith("layer") for n in arrays))])
        like = jax.eval_shape(lambda: init(make_config(settings)))
        for name, leaf in _leaves(like):
            if arrays[f"state{name}"].shape != leaf.shape:
                raise RunError(f"{path}: saved with other map.size_m, map.levels or uwb.max_beacons")
        leaves = [arrays[f"state{name}"] for name, _ in _leaves(like)]
        state = jax.tree.unflatten(jax.tree.structure(like), leaves)
        slots = {int(node): int(slot) for node, slot in about["slots"]}
        bias, height = (
            {int(slot): float(value) for slot, value in about[name]} for name in ("found_bias", "found_height")
        )
        return Saved(state, tiles, slots, Found(bias, height, float(about["found_scale"])))
    except OSError as error:
        raise RunError(f"{path}: {error.strerror or error}") from None
    except (KeyError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise error if isinstance(error, RunError) else RunError(f"{path}: not a saved state: {error}") from None


def _leaves(tree: Any) -> list[tuple[str, Any]]:
    return [(jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]]


class Locator:
    """Where a robot is among saved beacons, by its first ranges."""

    def __init__(self, saved: Saved, settings: Settings):
        self._host = make_host_params(settings, make_params(settings, saved.slots, saved.found), saved.slots)
        self._slots = saved.slots
        self._places = np.asarray(saved.state.belief.mean, float)[: 2 * len(self._host.bias)].reshape(-1, 2)
        self._known = np.asarray(saved.state.active) & ~np.asarray(saved.state.moving)
        self._heard: list[tuple[int, int, float]] = []
        self._since: int | None = None

    def hear(self, stamp: int, message: object) -> np.ndarray | None:
        """Position (2,) [m] once the messages up to a stamp [ns] tell it, or have not told it for long."""
        self._since = stamp if self._since is None else self._since
        if isinstance(message, RangeMessage) and np.isfinite(message.range):
            ends = [self._slots.get(message.source, -1), self._slots.get(message.target, -1)]
            if 0 in ends and max(ends) > 0 and self._known[max(ends)]:
                self._heard.append((stamp, max(ends), message.range))
        self._heard = [entry for entry in self._heard if stamp - entry[0] < _WINDOW_S * 1e9]
        if len({slot for _, slot, _ in self._heard}) >= _FEWEST and stamp - self._heard[0][0] > 0.6 * _WINDOW_S * 1e9:
            slot = np.array([entry[1] for entry in self._heard])
            flat = np.asarray(self._host.flat(np.array([entry[2] for entry in self._heard]), slot, 0))
            found = locate(self._places[slot], flat, np.full(len(flat), 2 * self._host.sigma_n))
            if found is not None:
                return found[0]
        return self._places[0].copy() if stamp - self._since > _PATIENCE_S * 1e9 else None


def resumed(saved: Saved, place: np.ndarray, *, fixed: bool) -> State:
    """The saved state with the robot at a place (2,) [m]; fixed: beacons and map are not to change."""
    state = jax.tree.map(jnp.asarray, saved.state)
    for slot in np.flatnonzero(np.asarray(state.moving)):
        state = state_edits.remove(state, int(slot))  # where it has been carried since, nobody knows
    state = state_edits.put_robot(state, place)
    return _pinned(state) if fixed else state


def _pinned(state: State) -> State:
    """The state with beacons that ranges do not move."""
    slots = np.flatnonzero(np.asarray(state.active))[1:]
    own = (2 * slots[:, None] + np.arange(2)).ravel()
    P = np.array(state.belief.cov)
    P[own, :] = P[:, own] = 0.0
    P[own, own] = _PINNED_M**2
    return state._replace(belief=Gaussian(state.belief.mean, jnp.asarray(P, jnp.float32)))
