import uwbslam_jax as us

print(us.inspect("hall.mcap"))
recording = us.read("hall.mcap")
print(recording.topics, sum(1 for message in recording), "messages")
