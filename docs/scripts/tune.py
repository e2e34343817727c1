import uwbslam_jax as us

tuned = us.tune([us.read("hall.mcap")], params=("sigma_n",))
print(tuned.values)
us.save_settings(tuned.settings, "tuned.toml")
result = us.run("hall.mcap", us.load_settings("tuned.toml"))
