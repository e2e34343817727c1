"""Errors that a user can mend have one base."""

from __future__ import annotations

import inspect

from uwbslam_drivers.device import DriverError
from uwbslam_jax import errors


def test_all_errors_have_one_base() -> None:
    found = [thing for thing in vars(errors).values() if inspect.isclass(thing) and issubclass(thing, BaseException)]
    assert len(found) > 1
    assert all(issubclass(error, errors.UwbslamError) for error in [*found, DriverError])
