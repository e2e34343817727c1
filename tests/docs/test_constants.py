"""docs/constants.md is what the code says."""

from __future__ import annotations

import importlib.util
from types import ModuleType

import pytest
from reader import ROOT


@pytest.fixture(scope="module")
def maker() -> ModuleType:
    """docs/make_constants.py."""
    spec = importlib.util.spec_from_file_location("make_constants", ROOT / "docs" / "make_constants.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_made_from_the_code(maker: ModuleType) -> None:
    made = maker.page() == maker.PAGE.read_text(encoding="utf-8")
    assert made, "python docs/make_constants.py makes it again"


def test_takes_constants_with_the_docstring_that_follows(maker: ModuleType) -> None:
    text = 'A = 1.5\n"""How\n  long [s]."""\n_B: int = 2\nC, D = (3, "x")\n"""Both."""\nE_F = G = [1, 2]\nlower = 3\n'
    found = [(c.name, c.value, c.about) for c in maker.of_module("m", text)]
    assert found == [
        ("A", "1.5", "How long [s]."),
        ("_B", "2", ""),
        ("C", "3", "Both."),
        ("D", "'x'", "Both."),
        ("E_F", "[1, 2]", ""),
        ("G", "[1, 2]", ""),
    ]


def test_every_constant_has_its_unit_and_reason(maker: ModuleType) -> None:
    assert maker.without_docstring() == []
