"""Evaluation against a second implementation, known motions and the statistics that honest covariances have."""

from __future__ import annotations

import csv
import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.optimize import minimize

from uwbslam_jax import evaluation
from uwbslam_jax.evaluation import Truth
from uwbslam_jax.measurements import TruthMessage
from uwbslam_jax.result import BeaconEstimate, BeaconStatus, MapImage, Result

EXACT = 1e-9  # rounding of a few float64 operations on numbers below 100
SECOND = 1_000_000_000
EPOCH = 1_700_000_000 * SECOND


def moved(poses: np.ndarray, angle: float, shift: np.ndarray) -> np.ndarray:
    """Poses or points (n, 2 or 3) turned about the origin, then shifted."""
    c, s = np.cos(angle), np.sin(angle)
    out = poses.copy()
    out[:, :2] = poses[:, :2] @ np.array([[c, s], [-s, c]]) + shift
    out[:, 2:] += angle
    return out


def drive(rng: np.random.Generator, count: int) -> np.ndarray:
    """A wandering track (count, 3) [m, m, rad]."""
    yaw = np.cumsum(rng.normal(0.02, 0.1, count))
    return np.column_stack([np.cumsum(0.1 * np.cos(yaw)), np.cumsum(0.1 * np.sin(yaw)), yaw])


def scene(seed: int, count: int = 900, start: int = 0) -> tuple[Truth, np.ndarray, np.ndarray, dict[int, np.ndarray]]:
    """A truth, and an estimate of it in another frame with errors: stamps, poses, beacons."""
    rng = np.random.default_rng(seed)
    robot = drive(rng, count)
    spots = rng.uniform(-10, 10, (4, 2))
    truth = Truth(
        stamps=start + np.arange(count) * (SECOND // 10),
        robot=robot,
        beacons={7 + k: np.array([[start, 0.0, 0.0], [start, *spot]], float) for k, spot in enumerate(spots)},
    )
    stamps = start + np.sort(rng.integers(0, (count - 1) * (SECOND // 10), count + 50))
    angle, shift = rng.uniform(-np.pi, np.pi), rng.uniform(-5, 5, 2)
    poses = truth.poses_at(stamps) + rng.normal(0, [0.1, 0.1, 0.03], (len(stamps), 3))
    beacons = moved(spots + rng.normal(0, 0.05, spots.shape), angle, shift)
    return truth, stamps, moved(poses, angle, shift), {7 + k: xy for k, xy in enumerate(beacons[:3])}


def test_rigid_fit_is_the_minimum() -> None:
    rng = np.random.default_rng(1)
    a, b, w = rng.normal(size=(30, 2)), rng.normal(size=(30, 2)), rng.uniform(0.1, 3, 30)

    def cost(x: np.ndarray) -> float:
        return float(np.sum(w * np.sum((moved(a, x[0], x[1:]) - b) ** 2, axis=1)))

    fit = evaluation.rigid_fit(a, b, w)
    searched = min((minimize(cost, [angle, 0, 0]) for angle in (-2, 0, 2)), key=lambda found: found.fun)
    # The search stops where its numerical gradient does: about 1e-6 from the minimum.
    assert cost(np.array([fit.angle, *fit.translation])) <= searched.fun + EXACT
    np.testing.assert_allclose([fit.angle, *fit.translation], searched.x, atol=1e-4)


@given(st.floats(-3, 3), st.floats(-50, 50), st.floats(-50, 50), st.integers(0, 99))
def test_rigid_fit_recovers_a_known_motion(angle: float, x: float, y: float, seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(5, 2))
    fit = evaluation.rigid_fit(points, moved(points, angle, np.array([x, y])))
    np.testing.assert_allclose([fit.angle, *fit.translation], [angle, x, y], atol=EXACT)


def test_rigid_fit_never_reflects() -> None:
    points = np.random.default_rng(2).normal(size=(20, 2))
    fit = evaluation.rigid_fit(points, points * [1, -1])
    assert np.linalg.det(fit.rotation) == pytest.approx(1)
    assert np.abs(fit.points(points) - points * [1, -1]).max() > 0.5


def test_a_weight_counts_like_a_repeated_point() -> None:
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(6, 2)), rng.normal(size=(6, 2))
    counts = np.array([1, 2, 3, 1, 5, 1])
    weighted = evaluation.rigid_fit(a, b, counts.astype(float))
    repeated = evaluation.rigid_fit(np.repeat(a, counts, 0), np.repeat(b, counts, 0))
    np.testing.assert_allclose(weighted.rotation, repeated.rotation, atol=EXACT)
    np.testing.assert_allclose(weighted.translation, repeated.translation, atol=EXACT)


def test_a_perfect_run_in_another_frame_has_no_error() -> None:
    truth, stamps, _, _ = scene(4)
    shift = np.array([3.0, -7.0])
    beacons = {node: moved(xy[None], 2.0, shift)[0] for node, xy in truth.beacon_positions().items()}
    figures = evaluation.evaluate(stamps, moved(truth.poses_at(stamps), 2.0, shift), beacons, truth)
    assert figures.pop("beacons_missing") == []
    assert figures.pop("covered") == pytest.approx((stamps[-1] - stamps[0]) / (89.9 * SECOND))
    assert figures == pytest.approx(dict.fromkeys(figures, 0.0), abs=1e-6)


def test_a_mirrored_run_fails() -> None:
    truth, stamps, _, _ = scene(5)
    mirrored = truth.poses_at(stamps) * [1, -1, -1]
    beacons = {node: xy * [1, -1] for node, xy in truth.beacon_positions().items()}
    figures = evaluation.evaluate(stamps, mirrored, beacons, truth)
    assert figures["robot_rmse_m"] > 0.3
    assert figures["beacon_max_m"] > 1.0


def test_known_errors_come_out() -> None:
    """Beacons exact and far heavier than one pose: its error stands alone."""
    truth, _, _, _ = scene(6, count=2)
    poses = truth.robot + np.array([[0.0, 0.0, 0.0], [1e-4, 0.0, np.deg2rad(3)]])
    figures = evaluation.evaluate(truth.stamps, poses, truth.beacon_positions(), truth)
    assert figures["robot_max_m"] == pytest.approx(1e-4, rel=0.1)
    assert figures["heading_deg_median"] == pytest.approx(1.5, abs=0.01)
    assert figures["heading_deg_p95"] == pytest.approx(0.95 * 3, abs=0.01)
    assert figures["covered"] == 1.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("with_beacons", [True, False])
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # the scorer leaves its files to the collector
def test_agrees_with_the_scorer(tmp_path: Path, seed: int, with_beacons: bool) -> None:
    path = Path(__file__).parents[2] / "shared" / "score.py"
    if not path.exists():
        pytest.skip(f"no scorer at {path}")
    spec = importlib.util.spec_from_file_location("score", path)
    assert spec is not None
    assert spec.loader is not None
    scorer = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(scorer)
    truth, stamps, poses, beacons = scene(seed)
    beacons = beacons if with_beacons else {}
    figures = evaluation.evaluate(stamps, poses, beacons, truth)

    half = poses[:, 2] / 2
    zero = np.zeros(len(poses))
    np.savetxt(
        tmp_path / "trajectory.tum",
        np.column_stack([stamps / 1e9, poses[:, :2], zero, zero, zero, np.sin(half), np.cos(half)]),
        fmt="%.17g",
    )
    with (tmp_path / "beacons.csv").open("w") as file:
        csv.writer(file).writerows(
            [("id", "x", "y"), *((node, *map(repr, xy.tolist())) for node, xy in beacons.items())]
        )
    last = np.stack(list(truth.beacon_positions().values()))
    np.savez(
        tmp_path / "truth.npz",
        t=truth.stamps / 1e9,
        robot=truth.robot,
        ids=np.array(list(truth.beacons)),
        beacons=np.broadcast_to(last, (len(truth.stamps), *last.shape)),
    )
    want = scorer.score(tmp_path, tmp_path / "truth.npz")
    assert figures.pop("beacons_missing") == want["beacons_missing"]
    theirs = {name: want[name.removesuffix("_m")] for name in figures}
    assert figures == pytest.approx(theirs, abs=EXACT, nan_ok=True)
    loaded = evaluation.evaluate(stamps, poses, beacons, Truth.load(tmp_path / "truth.npz"))
    assert {name: loaded[name] for name in figures} == pytest.approx(figures, abs=EXACT, nan_ok=True)


def test_nothing_to_compare_is_nan_and_not_an_error() -> None:
    truth, stamps, poses, beacons = scene(7)
    undecided = evaluation.evaluate(stamps, np.full_like(poses, np.nan), {}, truth)
    assert undecided["covered"] == 0.0
    assert np.isnan(undecided["robot_rmse_m"])
    assert undecided["beacons_missing"] == [7, 8, 9, 10]
    assert np.isnan(evaluation.evaluate(stamps, poses, {}, truth)["beacon_mean_m"])
    late = poses.copy()
    late[:100] = np.nan
    figures = evaluation.evaluate(stamps, late, {**beacons, 99: np.zeros(2)}, truth)
    assert figures["covered"] < 0.95
    assert figures["robot_rmse_m"] == pytest.approx(0.14, abs=0.03)  # sqrt(2) * 0.1 m of noise


def test_truth_from_messages_is_sorted_and_keeps_the_last_position() -> None:
    messages = [
        TruthMessage(EPOCH + SECOND, None, 1.0, 0.0, 3.2),
        TruthMessage(EPOCH + SECOND, 3, 5.0, 6.0),
        TruthMessage(EPOCH, None, 0.0, 0.0, -3.1),
        TruthMessage(EPOCH, 3, 4.0, 4.0),
    ]
    truth = Truth.from_messages(messages)
    np.testing.assert_array_equal(truth.stamps, [EPOCH, EPOCH + SECOND])
    np.testing.assert_array_equal(truth.beacon_positions()[3], [5.0, 6.0])
    halfway = truth.poses_at(np.array([EPOCH + SECOND // 2]))[0]
    # From -3.1 to 3.2 the short way is over -pi, so half way is near -pi and not near 0.
    assert halfway[0] == pytest.approx(0.5)
    assert halfway[2] == pytest.approx((-3.1 + 3.2 - 2 * np.pi) / 2)
    with pytest.raises(ValueError, match="no pose of the robot"):
        Truth.from_messages(messages[1:2])


def test_truth_file_of_the_recorded_building(shared_data: Path) -> None:
    truth = Truth.load(shared_data / "intel" / "intel.truth.npz")
    assert len(truth.stamps) == 2671
    assert sorted(truth.beacons) == [1, 2, 3, 4, 5, 6]
    travelled = np.linalg.norm(np.diff(truth.robot[:, :2], axis=0), axis=1).sum()
    assert travelled == pytest.approx(394, abs=2)


def test_a_wrong_truth_file_says_what_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "t.npz"
    np.savez(path, t=np.zeros(3), robot=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="no array named beacons, ids"):
        Truth.load(path)
    np.savez(path, t=np.zeros(3), robot=np.zeros((2, 3)), ids=np.zeros(1), beacons=np.zeros((3, 1, 2)))
    with pytest.raises(ValueError, match="do not fit together"):
        Truth.load(path)


def test_nees_of_honest_and_of_overconfident_covariances() -> None:
    rng = np.random.default_rng(8)
    root = rng.normal(size=(20_000, 3, 3))
    covs = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)
    errors = np.einsum("nij,nj->ni", np.linalg.cholesky(covs), rng.normal(size=(20_000, 3)))
    honest = evaluation.nees(errors, covs)
    # A chi-square of 3 has variance 6: the mean of 20 000 is good to 0.017, so 0.1 is six sigma.
    assert honest.mean == pytest.approx(3, abs=0.1)
    assert evaluation.nees(errors, covs / 4).ratio == pytest.approx(4 * honest.ratio)
    errors[5] = np.nan
    assert evaluation.nees(errors, covs).count == 19_999
    assert np.isnan(evaluation.nees(errors[:0], covs[:0]).mean)


def consistent_run(seed: int, *, frame_error: float = 0.0) -> tuple[Result, Truth]:
    """A run whose errors are what its covariances say, in the frame of beacons 3 and 8: 3 at the origin, 8 on +x.

    frame_error: angle by which the beacon on +x, and with it the frame, is wrong [rad].
    """
    rng = np.random.default_rng(seed)
    count, std = 4000, np.array([0.5, 0.05, 0.02])
    spots = {node: rng.uniform(-10, 10, 2) for node in (3, 8, *range(10, 60))}
    robot = drive(rng, count)
    truth = Truth(np.arange(count) * SECOND, robot, {n: np.array([[0.0, *xy]]) for n, xy in spots.items()})
    to = spots[8] - spots[3]
    angle = -np.arctan2(to[1], to[0]) - frame_error
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shift = -turn @ spots[3]
    poses = moved(robot, angle, shift) + rng.normal(0, std, (count, 3))
    beacons = []
    for node, xy in spots.items():
        error = rng.normal(0, std[:2]) * {3: (0, 0), 8: (1, 0)}.get(node, (1, 1))
        beacons.append(BeaconEstimate(node, turn @ xy + shift + error, np.diag(std[:2] ** 2), BeaconStatus.STATIC))
    empty = MapImage(np.zeros((1, 1), np.float32), 0.05, np.zeros(2))
    covs = np.broadcast_to(np.diag(std**2), (count, 3, 3)).copy()
    summary = {"frame_beacons": [3, 8], "decided_at": 2000.0}
    poses[:2000, :2] += 3.0  # before the frame was decided nothing is judged
    nothing = np.zeros((0, 4))
    return Result(truth.stamps, poses, poses, covs, beacons, {}, empty, nothing, nothing[:, :2], summary=summary), truth


def test_consistency_is_judged_in_the_frame_of_the_true_beacons() -> None:
    figures = evaluation.consistency(*consistent_run(9))
    assert figures["pose_nees_ratio"] == pytest.approx(1, abs=0.08)  # 2000 poses: four sigma of the mean
    assert figures["beacon_nees_ratio"] == pytest.approx(1, abs=0.6)  # 101 numbers: four sigma
    wrong = evaluation.consistency(*consistent_run(9, frame_error=0.2))
    assert wrong["pose_nees_ratio"] > 10  # a fit over robot and beacons would have turned this away
    assert wrong["beacon_nees_ratio"] > 10


def test_consistency_of_a_run_without_its_frame_in_the_truth_is_nan() -> None:
    result, truth = consistent_run(10)
    for frame in (None, [3, 99], [3, 3]):
        told = dataclasses.replace(result, summary={**result.summary, "frame_beacons": frame})
        assert all(np.isnan(v) for v in evaluation.consistency(told, truth).values())


def test_a_frame_whose_beacons_move_stays_where_it_was_decided() -> None:
    history = {
        1: np.array([[0.0, 1.0, 2.0], [10.0 * SECOND, 9.0, 9.0]]),
        2: np.array([[0.0, 1.0, 5.0], [1.0 * SECOND, 1.0, 6.0]]),
    }
    truth = Truth(np.array([0]), np.zeros((1, 3)), history)
    frame = evaluation.published_frame(truth, 1, 2, 5 * SECOND)
    np.testing.assert_allclose(frame.points(np.array([[0.0, 0.0], [4.0, 0.0]])), [[1, 2], [1, 6]], atol=EXACT)
