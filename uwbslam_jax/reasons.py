"""Why measurements are left out, and what start-up waits for: what files and pages call it, of which sensor, and what a
user can do about it."""

from __future__ import annotations

from enum import StrEnum


class Sensor(StrEnum):
    """What a measurement is of; the value is the word for one."""

    SCAN = "scan"
    RANGE = "range"
    ODOMETRY = "odometry"


class Reason(str):
    """A reason as it is counted, "sensor: words"; equal to any text that says the same.

    Attributes:
      sensor: whose measurement is lost.
      words: why.
      advice: the likely cause and what helps.
      of: what is counted where that is not the measurement itself, such as the line that held it; else "".
      told: whether what finds it out tells it, with its cause, wherever it is more than a few.
    """

    sensor: Sensor
    words: str
    advice: str
    of: str
    told: bool

    def __new__(cls, sensor: Sensor, words: str, advice: str, of: str = "", *, told: bool = False) -> Reason:
        made = super().__new__(cls, f"{of or sensor}: {words}")
        made.sensor, made.words, made.advice, made.of, made.told = sensor, words, advice, of, told
        return made

    def __getnewargs_ex__(self) -> tuple[tuple[Sensor, str, str, str], dict[str, bool]]:
        return (self.sensor, self.words, self.advice, self.of), {"told": self.told}


_CLOCK = "a clock was set back, a recording is looped, or stamps are of another clock; uwbslam inspect shows them"
"""Advice for a stamp that goes back [text]."""
_APART, _AGAIN = "stamp apart from its neighbours'", "recorded before, in a loop"
"""Words for what a clock tells of a message, whatever the sensor [text]."""
_ONE_STAMP = "a driver that stamps some messages wrongly"
"""Advice for single stamps [text]."""
_TWICE, _MERGED = "stamp of the one before", "two recordings of the same were merged, or stamps are whole seconds"
"""Words and advice for a message at the time of the one before [text]."""
_COPY = "a copy of one before"
"""Words for a measurement that was heard already [text]."""
_MERGED_TOO = (
    "two recordings of the same were merged, two topics carry the same, or both nodes tell of each exchange; each "
    "counts once"
)
"""Advice for copies [text]."""
_LOOP = "a recording that was played in a loop while it was recorded: its first pass is used"
"""Advice for what comes again [text]."""
_BYTES = "bytes are damaged or do not fit the type that the recording gives; uwbslam inspect lists the types"
"""Advice for a message that does not decode [text]."""
_LINE = "a loose or long cable, another baud, or a second program at the port"
"""Advice for what a device sent and did not arrive whole [text]."""


class ScanLost:
    """Of scans."""

    APART = Reason(Sensor.SCAN, _APART, _ONE_STAMP, told=True)
    AGAIN = Reason(Sensor.SCAN, _AGAIN, _LOOP, told=True)
    STAMP = Reason(Sensor.SCAN, "stamp not after the one before", _CLOCK)
    TWICE = Reason(Sensor.SCAN, _TWICE, _MERGED, told=True)
    COPY = Reason(Sensor.SCAN, _COPY, _MERGED_TOO)
    NO_BEARINGS = Reason(Sensor.SCAN, "no beams or no bearings", "the LiDAR's driver leaves its fields empty")
    NO_BEAMS = Reason(Sensor.SCAN, "no beams", "the LiDAR measures nothing, or its driver leaves the readings out")
    FAILED = Reason(
        Sensor.SCAN, "no return right after some that had", "the LiDAR fails at times; see its cable, supply and driver"
    )
    MALFORMED = Reason(Sensor.SCAN, "malformed", _BYTES)
    OTHER_SCANNER = Reason(
        Sensor.SCAN, "of another scanner", "one topic holds several scanners; one of them is used", told=True
    )
    IMPOSSIBLE = Reason(
        Sensor.SCAN, "impossible bearings", "the LiDAR's driver fills in angles that no scanner has", told=True
    )
    OVERTAKEN = Reason(
        Sensor.SCAN,
        "overtaken by a newer one",
        "this computer is too slow; fewer beams (--lidar.max-beams) or a smaller window (--map.size-m) help",
    )
    NO_TURN = Reason(Sensor.SCAN, "no new turn", "the motor stands still, or bytes are lost")
    FEW_SAMPLES = Reason(Sensor.SCAN, "too few samples", _LINE)
    ANGLES = Reason(Sensor.SCAN, "angles do not fit", _LINE)
    STAMP_DAMAGED = Reason(Sensor.SCAN, "stamp damaged", _LINE)
    NOT_INTACT = Reason(Sensor.SCAN, "too little of it intact", _LINE)


class RangeLost:
    """Of ranges."""

    APART = Reason(Sensor.RANGE, _APART, _ONE_STAMP, told=True)
    AGAIN = Reason(Sensor.RANGE, _AGAIN, _LOOP, told=True)
    IMPOSSIBLE = Reason(Sensor.RANGE, "not finite, not positive or too long", "another unit, or --uwb.max-range")
    NOT_POSITIVE = Reason(Sensor.RANGE, "not finite or not positive", "the radio reports failed exchanges as ranges")
    SELF = Reason(Sensor.RANGE, "a node to itself", "two radios have one id")
    FROM_SELF = Reason(Sensor.RANGE, "from a node to itself", "two radios have one id, or --robot.id is a beacon's")
    STAMP = Reason(Sensor.RANGE, "stamp not after the pair's one before", _CLOCK)
    COPY = Reason(Sensor.RANGE, _COPY, _MERGED_TOO)
    LATE = Reason(Sensor.RANGE, "arrived too late", "the radio's clock is behind the LiDAR's; uwbslam inspect shows it")
    NO_SLOT = Reason(
        Sensor.RANGE,
        "of a node heard too seldom, or more beacons than max_beacons",
        "ids that come once are bit errors; for more beacons give a larger --uwb.max-beacons",
    )
    NOT_VALID = Reason(Sensor.RANGE, "marked as not valid", "the radio itself says that its exchanges failed")
    FRAME_FULL = Reason(Sensor.RANGE, "more than one frame holds", "far more ranges come than scans, or scans are lost")
    MALFORMED = Reason(Sensor.RANGE, "malformed", _BYTES)
    LINE_DAMAGED = Reason(Sensor.RANGE, "damaged", _LINE, of="line")
    LINE_TOO_LONG = Reason(Sensor.RANGE, "too long", _LINE, of="line")
    WRONG_SUM = Reason(Sensor.RANGE, "wrong sum", _LINE, of="frame")

    @staticmethod
    def over(most: float) -> Reason:
        """Beyond the greatest range that is taken [m]."""
        return Reason(Sensor.RANGE, f"over {most:g} m", "are they in mm or cm? otherwise give a larger --uwb.max-range")


class OdometryLost:
    """Of odometry."""

    APART = Reason(Sensor.ODOMETRY, _APART, _ONE_STAMP, told=True)
    AGAIN = Reason(Sensor.ODOMETRY, _AGAIN, _LOOP, told=True)
    NOT_FINITE = Reason(Sensor.ODOMETRY, "not finite", "the wheels' node reports no pose")
    NO_ROTATION = Reason(
        Sensor.ODOMETRY,
        "orientation is no rotation",
        "the wheels' node leaves the quaternion at zero; mend it there",
        told=True,
    )
    TWICE = Reason(Sensor.ODOMETRY, _TWICE, _MERGED, told=True)
    COPY = Reason(Sensor.ODOMETRY, _COPY, _MERGED_TOO)
    STAMP = Reason(Sensor.ODOMETRY, "stamp not after the one before", _CLOCK)
    MALFORMED = Reason(Sensor.ODOMETRY, "malformed", _BYTES)


class Lack(str):
    """What start-up does not know yet; equal to any text that says the same.

    Attributes:
      advice: what helps.
    """

    advice: str

    def __new__(cls, words: str, advice: str) -> Lack:
        made = super().__new__(cls, words)
        made.advice = advice
        return made

    def __getnewargs__(self) -> tuple[str, str]:
        return str(self), self.advice


_SCALE_NEAR = 0.06
"""Ranges and way so near to a ratio of units are taken to be of these [ratio]."""
_SCALES = {
    3.281: "are the ranges in feet? --uwb.unit ft",
    0.3048: "are the LiDAR's readings, or the wheels' positions, in feet? see their driver",
    39.37: "are the ranges in inches? --uwb.unit in",
    0.0254: "are the LiDAR's readings, or the wheels' positions, in inches? see their driver",
    0.3937: "are the ranges in inches, and were taken for cm? --uwb.unit in",
    2.54: "are the LiDAR's readings in inches, and were taken for cm? see its driver",
    2.0: "do the ranges count the way there and back? mend it in the radio's driver, or give --uwb.bias-scale 1",
    0.5: "are the ranges halved once too often? mend it in the radio's driver, or give --uwb.bias-scale -0.5",
    100.0: "are the ranges in cm? --uwb.unit cm",
    0.01: "are the LiDAR's readings, or the wheels' positions, in cm? see their driver",
    1000.0: "are the ranges in mm? --uwb.unit mm",
    0.001: "are the LiDAR's readings, or the wheels' positions, in mm? see their driver",
}
"""What it likely means that ranges are so many times as long as the way of the robot tells [ratio -> advice]."""


class StartUpLacks:
    """Of start-up, in the order in which it asks."""

    MOTION = Lack("by its scans and odometry the robot has moved less than a metre", "drive on")
    RANGES = Lack(
        "fewer than two beacons were ranged along the way",
        "are the beacons on, and is --robot.id the robot's own? the robot's ranges are the ones that count",
    )
    FIT = Lack(
        "the ranges do not fit the track",
        "is --robot.id the robot's own? are ranges and odometry in m, and stamped by one clock? --no-odom leaves "
        "odometry out",
    )
    SIDE = Lack("the ranges fit a mirrored place as well", "drive on, and turn both ways")
    BEACONS = Lack(
        "of no two beacons the ranges tell one place",
        "drive on, not in a straight line and nearer to the beacons; more of them, or ranges between them, help",
    )
    HEADING = Lack(
        "it is not certain how robot and map are turned among the beacons",
        "drive on; scans and wheels that measure turns better, and ranges on both sides, help",
    )
    MORE = Lack("not every beacon is certain yet, and without a map those placed together are placed best", "drive on")

    @staticmethod
    def scale(factor: float) -> Lack:
        """That ranges are so many times as long as the track tells."""
        near = next((advice for ratio, advice in _SCALES.items() if abs(factor / ratio - 1.0) < _SCALE_NEAR), None)
        other = "in which units are they? see --uwb.unit, and the drivers of radio, LiDAR and wheels"
        return Lack(f"the ranges are {factor:.3g} times as long as the way of the robot tells", near or other)
