"""The type checker that the import hook of conftest.py puts on every annotated call of the package."""

from __future__ import annotations

from beartype import BeartypeConf, beartype

# As in PEP 484 an int may stand for a float; beartype alone would refuse it.
check = beartype(conf=BeartypeConf(is_pep484_tower=True))
