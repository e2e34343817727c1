import numpy as np

import uwbslam_jax as us

slam, log = us.Slam(), np.load("arrays.npz")
for stamp, scan, ranges in zip(log["stamps"].tolist(), log["scans"], log["ranges"], strict=True):
    for beacon, distance in enumerate(ranges.tolist(), start=1):
        slam.add(us.RangeMessage(stamp, 0, beacon, distance))
    for update in slam.add(us.ScanMessage(stamp, log["angle"][0], np.ptp(log["angle"]) / 719, 0.0, 0.1, 30.0, scan)):
        print(update.stamp, update.status, update.pose)
slam.finish().save("out")
