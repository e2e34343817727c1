import jax

import uwbslam_jax as us

rollout = us.rollout(us.read("hall.mcap"), us.Settings())
loss, gradient = jax.value_and_grad(rollout.loss)(rollout.params)
print("loss", loss, "by sigma_n", gradient.sigma_n, "by sigma_l", gradient.sigma_l)
