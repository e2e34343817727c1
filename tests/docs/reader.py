"""Where the checkout is, and what runs a reader's command."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parents[2]

Run = Callable[..., subprocess.CompletedProcess[str]]
"""run(*words, cwd=folder)."""
