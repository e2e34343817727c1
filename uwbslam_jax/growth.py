"""The graph as it grows beside the run: frames are taken in by a thread of its own, in order.

Whoever asks for the graph waits until all that was given is in it, so a run and its re-run stay the same to the bit.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

from uwbslam_jax.config import Config, Params
from uwbslam_jax.graph import Graph
from uwbslam_jax.measurements import StampedFrame
from uwbslam_jax.slam import Estimate


class Growth:
    """A graph and the frames on their way into it.

    Attributes:
      keyframes: how many it had before the frames that were given last.
    """

    def __init__(self, graph: Graph):
        self.keyframes = 0
        self._graph = graph
        self._pool: ThreadPoolExecutor | None = None
        self._running: Future[None] | None = None

    @property
    def graph(self) -> Graph:
        """With all that was given."""
        if self._running is not None:
            running, self._running = self._running, None
            running.result()
        return self._graph

    def add(self, config: Config, params: Params, seen: list[tuple[int, StampedFrame, Estimate]]) -> None:
        """Take in a few frames, see `Graph.add`; what was given before is waited for."""
        self.keyframes = len(self.graph.keyframes)
        self._pool = self._pool or ThreadPoolExecutor(1, thread_name_prefix="graph")
        self._running = self._pool.submit(self._graph.add, config, params, seen)

    def close(self) -> None:
        """Nothing more is given; the thread ends."""
        _ = self.graph
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
