from functools import partial

import jax

import uwbslam_jax as us

rollout = us.rollout(us.read("hall.mcap"), us.Settings())
step = partial(us.estimator.step, rollout.config, rollout.params)
ranges = rollout.frames.ranges
noise = 0.1 * jax.random.normal(jax.random.key(0), (4, *ranges.range.shape))  # one row of the first axis a seed
noisy = jax.vmap(lambda added: rollout.frames._replace(ranges=ranges._replace(range=ranges.range + added)))(noise)
poses = jax.vmap(lambda frames: jax.lax.scan(step, rollout.state, frames)[1].pose)(noisy)
print("spread at the end [m, m, rad]", poses[:, -1].std(axis=0))
