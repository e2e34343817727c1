import uwbslam_jax as us

result = us.run("hall.mcap")
print(result.errors())
result.save("out")
result.plot()
