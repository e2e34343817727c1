"""What a user can repair: one base of all errors. Each message is one line that says what and where.

Anything else that is raised is a defect of this program.
"""

from __future__ import annotations


class UwbslamError(Exception):
    """Base of all errors that a user can repair."""


class ConfigError(UwbslamError, ValueError):
    """A setting that is unknown, of the wrong type or out of range."""


class LogError(UwbslamError, ValueError):
    """A recording that cannot be used."""


class RunError(UwbslamError, ValueError):
    """A run's folder, or a state saved in it, that cannot be read."""


class RolloutError(UwbslamError, ValueError):
    """A recording that has no rollout."""


class UsageError(UwbslamError, ValueError):
    """A request that cannot be met."""
