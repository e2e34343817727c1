from dataclasses import replace

import uwbslam_jax as us

settings = us.Settings()
for sigma_n in (0.05, 0.1, 0.2):
    changed = replace(settings, uwb=replace(settings.uwb, sigma_n=sigma_n))
    print(sigma_n, us.run("hall.mcap", changed).errors())
