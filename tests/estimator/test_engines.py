"""Which engine steps a run, and when what it needs is compiled."""

from __future__ import annotations

import importlib.util
import os
from types import ModuleType

import pytest

from uwbslam_jax.errors import ConfigError
from uwbslam_jax.estimator import chosen
from uwbslam_jax.estimator.native import kept
from uwbslam_jax.files import settings_file
from uwbslam_jax.settings import FilterSettings, Settings


def settings(**filter_settings) -> Settings:
    return Settings(filter=FilterSettings(**filter_settings))


@pytest.mark.parametrize(
    ("asked", "preset", "compiled", "engine"),
    [
        ("auto", "robust", True, "native"),
        ("auto", "robust", False, "jax"),
        ("auto", "paper", True, "jax"),
        ("jax", "robust", True, "jax"),
        ("native", "robust", False, "native"),
    ],
)
def test_auto_is_native_where_it_serves_and_is_compiled(monkeypatch, asked, preset, compiled, engine):
    begun: list[int] = []
    monkeypatch.setattr(kept, "is_kept", lambda: compiled)
    monkeypatch.setattr(kept, "compile_beside", lambda: begun.append(1))
    found = chosen(settings(engine=asked, preset=preset), compile_beside=True)
    assert found == settings(engine=engine, preset=preset)
    assert chosen(found, compile_beside=True) == found
    assert len(begun) == (asked == "auto" and preset == "robust" and not compiled)


def test_settings_that_no_engine_serves_are_refused():
    with pytest.raises(ConfigError, match=r"filter.engine = 'native': serves filter.preset = 'robust' only"):
        settings_file.check(settings(engine="native", preset="paper"))
    with pytest.raises(ConfigError, match=r"filter.engine = 'fast': must be 'jax' or 'native' or 'auto'"):
        settings_file.from_dict({"filter": {"engine": "fast"}})


@pytest.fixture
def own(monkeypatch: pytest.MonkeyPatch, tmp_path) -> ModuleType:
    """The module with a cache folder of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    spec = importlib.util.spec_from_file_location("own_kept", kept.__file__)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_one_process_compiles_at_a_time_and_one_that_was_killed_is_not_waited_for(monkeypatch, own):
    begun: list[list[str]] = []
    monkeypatch.setattr(own.subprocess, "Popen", lambda command, **_: begun.append(command))
    assert not own.is_kept()
    own.compile_beside()
    own.compile_beside()
    assert len(begun) == 1
    os.utime(own.mark_of_work(), (0, 0))
    own.compile_beside()
    assert len(begun) == 2
    own.mark_of_work().unlink()
    own.compile_beside()
    assert len(begun) == 3
    (own.folder() / "step.step-1.py311.1.nbc").touch()
    assert own.is_kept()


def test_where_nothing_can_be_kept_nothing_is_compiled_beside(monkeypatch, own, tmp_path):
    monkeypatch.setattr(own.subprocess, "Popen", lambda *_, **__: pytest.fail("begun"))
    (tmp_path / "uwbslam_jax").write_text("a file where a folder should be")
    own.compile_beside()
    assert not own.is_kept()
