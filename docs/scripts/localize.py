import uwbslam_jax as us

mapping, recording = us.Slam(), us.read("hall.mcap")
for message in recording:
    mapping.add(message)
mapping.save("saved")
slam = us.Slam(localize="saved")
for message in recording:
    for update in slam.add(message):
        print(update.stamp, update.status, update.pose)
