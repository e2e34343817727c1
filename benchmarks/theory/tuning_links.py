"""Noise and bias of real radios at rest, tuned by the robust density of the filter: do they predict later ranges?"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from benchmarks.accuracy.public_logs import P2P_OFFSET, p2p
from benchmarks.metric import Metric
from uwbslam_jax import RangeMessage, Settings
from uwbslam_jax.estimator import ranging

_DATA = Path(__file__).parents[3] / "shared" / "data" / "p2p"
_FITTED = 0.75
"""First share of each link's exchanges."""
_WIDE_M = 0.3
"""Where the noise's fit starts: links are up to twice this off [m]."""
_BIAS_M, _LOG_SPREAD = 0.3, np.log(10.0)
_MODELS = {
    "sigma_n": "one sigma_n",
    "node": "sigma_n and a bias of each node",
    "link": "noise and bias of each link",
}


def links(quick: bool) -> Iterator[Metric]:
    """Log-likelihood a held-out range: with the defaults and the common offset, and with what was tuned."""
    try:
        log = p2p(_DATA)
    except FileNotFoundError:
        return
    known = log.beacons
    errors: dict[tuple[int, int], list[float]] = {}
    for m in log.messages:
        if isinstance(m, RangeMessage) and m.source in known and m.target in known:
            distance = np.hypot(*np.subtract(known[m.source], known[m.target]))
            errors.setdefault((m.source, m.target), []).append(m.range - P2P_OFFSET - distance)
    fitted = [(pair, e) for pair, values in errors.items() for e in values[: round(_FITTED * len(values))]]
    held = [(pair, e) for pair, values in errors.items() for e in values[round(_FITTED * len(values)) :]]
    pairs = sorted(errors)
    yield Metric("p2p: links between nodes of known place", float(len(pairs)), "")
    yield Metric("p2p: held-out ranges", float(len(held)), "")
    before = _likelihood(*_arrays(pairs, held), jnp.zeros(len(pairs)), jnp.full(len(pairs), Settings().uwb.sigma_n))
    yield Metric("p2p: log-likelihood a held-out range, defaults", float(before), "", "higher")
    for model, about in _MODELS.items():
        bias, sigma = _fit(model, pairs, *_arrays(pairs, fitted))
        after = _likelihood(*_arrays(pairs, held), bias, sigma)
        yield Metric(f"p2p: the same, {about} tuned", float(after), "", "higher", bar=float(before))
        yield Metric(f"p2p: sigma tuned (median over links), {about}", float(jnp.median(sigma)), "m")


def _arrays(pairs: list[tuple[int, int]], rows) -> tuple[jax.Array, jax.Array]:
    number = {pair: k for k, pair in enumerate(pairs)}
    return jnp.array([number[pair] for pair, _ in rows]), jnp.array([e for _, e in rows], jnp.float32)


def _likelihood(link: jax.Array, error: jax.Array, bias: jax.Array, sigma: jax.Array) -> jax.Array:
    """Mean log-density of ranges. bias, sigma: of each link [m]."""
    return jnp.mean(ranging.log_density(error - bias[link], sigma[link] ** 2, True))


def _fit(model: str, pairs: list[tuple[int, int]], link: jax.Array, error: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Bias and noise of each link by BFGS, with the priors of the tuning."""
    nodes = sorted({node for pair in pairs for node in pair})
    ends = np.array([[node in pair for node in nodes] for pair in pairs], np.float32)
    count = len(pairs)

    def unpack(x):
        if model == "link":
            return _BIAS_M * x[:count], _WIDE_M * jnp.exp(x[count:])
        bias = _BIAS_M * (jnp.asarray(ends) @ x[1:]) if model == "node" else jnp.zeros(count)
        return bias, _WIDE_M * jnp.exp(jnp.full(count, x[0]))

    size = {"sigma_n": 1, "node": 1 + len(nodes), "link": 2 * count}[model]

    def loss(x, _):
        biases, logs = (x[:count], x[count:]) if model == "link" else (x[1:], x[:1])
        prior = 0.5 * (jnp.sum(biases**2) + jnp.sum((logs / _LOG_SPREAD) ** 2)) / error.shape[0]
        return prior - _likelihood(link, error, *unpack(x))

    solver = optx.BFGS(rtol=1e-5, atol=1e-5)
    found = optx.minimise(loss, solver, jnp.zeros(size), max_steps=2000, throw=False)
    return unpack(found.value)
