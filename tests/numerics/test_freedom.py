"""How much of what may be off is left open."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from uwbslam_jax.numerics import Freedom, Off, fewest_open

UNKNOWNS = {"height": 5, "scale": 1, "bias": 6}


@dataclass
class Made:
    """A problem with some groups open. far: those that are known to be off beyond doubt."""

    cost: float
    far: tuple[str, ...]
    off: Off

    def strength(self, group: str) -> float:
        return 1e3 if group in self.far else 0.0


def opened(gain, before=(), each=15.0, far=(), scale=0.05):
    """What is left open, and what was tried. gain: of a group, or of the best of several that pass for each other."""
    tried = []

    def made(groups):
        gains = [most for of, most in gain.items() if set(of.split(" or ")) & set(groups)]
        return Made(1000.0 - sum(gains), far, Off(np.zeros(6), np.zeros(6), scale))

    def attempt(groups, _):
        tried.append(groups)
        return made(groups)

    return fewest_open(before, made(before), UNKNOWNS, attempt, each)[0], tried


@pytest.mark.parametrize(
    ("gain", "want"),
    [
        ({"bias": 14.0}, ()),  # nothing is decided
        ({"bias": 30.0}, ()),  # six unknowns gain more than that by chance
        ({"bias": 40.0}, ("bias",)),
        ({"scale": 20.0}, ("scale",)),
        ({"height": 40.0, "bias": 10.0}, ("height",)),
        ({"height": 40.0, "scale": 30.0, "bias": 60.0}, ("height", "scale", "bias")),
    ],
)
def test_a_group_is_left_open_that_pays_for_itself(gain, want):
    assert opened(gain)[0] == want


def test_what_others_explain_as_well_is_not_left_open():
    assert opened({"height or scale": 50.0})[0] == ()
    assert opened({"height or scale": 50.0, "height": 20.0})[0] == ("height",)
    assert opened({"height or scale": 50.0}, before=("height",))[0] == ("height",)


def test_a_small_scale_is_that_of_the_way():
    assert opened({"scale": 50.0}, scale=0.008)[0] == ()
    assert opened({"scale": 50.0, "height": 50.0}, scale=0.008)[0] == ("height",)


def test_calibrated_ranges_cost_one_trial_more():
    assert opened({"bias": 3.0})[1] == [tuple(UNKNOWNS)]


def test_what_is_known_beyond_doubt_is_not_tried_without():
    groups, tried = opened({"height": 900.0}, far=("height",))
    assert groups == ("height",)
    assert all("height" in each for each in tried)


def test_what_was_found_before_need_not_be_decided_again():
    gain = {"height": 20.0}
    assert opened(gain)[0] == ()
    assert opened(gain, before=("height",))[0] == ("height",)
    assert opened({"height": 5.0}, before=("height",))[0] == ()
    assert opened(gain, each=0.0)[0] == ("height",)


def test_strength_of_what_is_no_unknown_is_none():
    off = Off(np.array([0.0, 0.3]), np.zeros(2), 0.07)
    sigma = Off(np.array([0.1, 0.1]), np.zeros(2), 0.01)
    assert off.strength(sigma, "bias") == pytest.approx(4.5)
    assert off.strength(sigma, "scale") == pytest.approx(24.5)
    assert off.strength(sigma, "height") == 0.0


def test_the_measure_is_left_open_with_the_scale():
    assert min(Freedom.of(("scale",))[2:]) > 0
    assert Freedom.of(("height",)).lidar == Freedom.of(()).scale == 0.0
