"""`python -m benchmarks NAME` measures one thing, prints and writes results/NAME.md and .json.

With --gate the exit status is 1 where a figure misses its bar, or a ratio is worse than the committed baseline by more
than its tolerance; --baseline puts this run's ratios into the baseline. How far off the answers are is
`python -m benchmarks.accuracy.scenarios` and `.recordings`.
"""

from __future__ import annotations

import argparse
import importlib
import sys

from benchmarks.metric import judge, publish

NAMES = {
    "step": "one online step beside KISS-ICP on the same scans",
    "scaling": "a step against beacons, beams, size of the map and levels",
    "batch": "a whole recording of ten minutes, and many parameter sets at once",
    "uwb": "the filter on ranges alone beside GTSAM",
    "startup": "from the shell to the first pose",
    "live": "a live run on emulated devices, with faults and kills (20 minutes)",
    "gpu": "many runs at once on a graphics card",
    "bound": "errors beside the Cramer-Rao bound, 50 runs",
    "tuning": "tuned noises, biases and mounting beside the truth, and what the gradient costs (an hour)",
    "gamma": "preset paper: error against gamma by features and ranges",
    "paper": "every table and figure of the paper in simulation (20 minutes)",
}
_THEORY = ("bound", "tuning", "gamma", "paper")
"""Measured in `theory`; the others in `speed`."""


def main() -> int:
    """Returns 0, or 1 where the gate is shut."""
    told = "\n".join(f"  {name:<8} {about}" for name, about in NAMES.items())
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description=f"{__doc__}\n{told}", formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("name", choices=NAMES, metavar="NAME")
    parser.add_argument("--gate", action="store_true", help="exit 1 where a bar or the baseline is missed")
    parser.add_argument("--baseline", action="store_true", help="make this run's ratios the baseline")
    parser.add_argument("--quick", action="store_true", help="less of everything, to try it out: nothing is written")
    parser.add_argument("--load", type=int, metavar="N", help="step: beside so many busy processes; nothing is written")
    options = parser.parse_args()
    if options.load and options.name != "step":
        parser.error("--load is for step only")
    wing = "theory" if options.name in _THEORY else "speed"
    beside = {"load": options.load} if options.load else {}
    report = importlib.import_module(f"benchmarks.{wing}.{options.name}").measure(quick=options.quick, **beside)
    if options.quick or options.load:
        for m in report.metrics:
            print(f"{m.name}: {m.value:.4g} {m.unit}")
        print(report.skipped)
        return 0
    print(publish(options.name, report))
    failed = judge(options.name, report, renew=options.baseline)
    for text in failed:
        print(text, file=sys.stderr)
    return int(bool(failed) and options.gate)


if __name__ == "__main__":
    sys.exit(main())
