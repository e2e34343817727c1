"""Pictures of finished runs for the README: map, track and beacons of a run directory.

python -m benchmarks.pictures RUN_DIR -o docs/images/NAME.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np

from uwbslam_jax.files import read_run


def read_map(directory: Path) -> tuple[np.ndarray, tuple[float, float, float, float]]:
    """Grey values (rows, cols), row 0 the largest y, and extent (x0, x1, y0, y1) [m] of a map_server map."""
    lines = dict(line.split(": ", 1) for line in (directory / "map.yaml").read_text().splitlines() if ": " in line)
    x0, y0, _ = (float(v) for v in lines["origin"].strip("[] ").split(","))
    resolution = float(lines["resolution"])
    data = (directory / lines["image"].strip("'\" ")).read_bytes()
    header, _, rest = data.partition(b"255\n")
    cols, rows = (int(v) for v in header.split()[-2:])
    grey = np.frombuffer(rest, np.uint8, rows * cols).reshape(rows, cols)
    return grey, (x0, x0 + cols * resolution, y0, y0 + rows * resolution)


def draw(directory: Path, out: Path, title: str) -> None:
    """Write the picture of a run."""
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    grey, extent = read_map(directory)
    run = read_run(directory)
    t = (run.stamps - run.stamps[0]) / 1e9
    figure, axes = plt.subplots(figsize=(8, 8 * grey.shape[0] / grey.shape[1] + 0.6))
    axes.imshow(grey, cmap="gray", extent=extent, vmin=0, vmax=255, interpolation="nearest")
    track = axes.scatter(run.poses[:, 0], run.poses[:, 1], c=t, s=2, cmap="plasma", linewidths=0)
    beacons = np.asarray(run.beacons).reshape(-1, 2)
    axes.plot(beacons[:, 0], beacons[:, 1], "^", color="tab:blue", markersize=10, markeredgecolor="white")
    for node, (x, y) in zip(run.beacon_ids, beacons, strict=True):
        axes.annotate(str(node), (x, y), (6, 6), textcoords="offset points", color="tab:blue", weight="bold")
    figure.colorbar(track, ax=axes, shrink=0.6, label="time [s]")
    axes.set(title=title, xlabel="x [m]", ylabel="y [m]", aspect="equal")
    figure.savefig(out, dpi=110, bbox_inches="tight")
    plt.close(figure)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--title", default="")
    arguments = parser.parse_args()
    draw(arguments.run, arguments.out, arguments.title)


if __name__ == "__main__":
    main()
