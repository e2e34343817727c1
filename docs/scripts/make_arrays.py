import numpy as np

rng, beacons = np.random.default_rng(0), np.array([[1.0, 1.0], [7.0, 1.5], [5.0, 5.5], [0.5, 4.5]])
t, angle = np.arange(0, 40, 0.1), np.linspace(-np.pi, np.pi, 720, endpoint=False) + 1e-3
x, y = (4 + 2.5 * np.sin(0.3 * t))[:, None], (3 + 1.5 * np.cos(0.3 * t))[:, None]
to_x, to_y = (np.maximum(-p / u, (side - p) / u) for p, u, side in ((x, np.cos(angle), 8), (y, np.sin(angle), 6)))
scans = np.minimum(to_x, to_y) + rng.normal(0, 0.01, (len(t), len(angle)))
ranges = np.hypot(x - beacons[:, 0], y - beacons[:, 1]) + rng.normal(0, 0.1, (len(t), len(beacons)))
np.savez("arrays.npz", stamps=(t * 1e9).astype(np.int64), angle=angle, scans=scans, ranges=ranges)
