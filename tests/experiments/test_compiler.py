"""Where compiled programs are kept."""

import os

import pytest
from jax._src import compilation_cache

from experiments.common import compiler


def test_a_program_that_a_killed_process_left_unfinished_is_compiled_again(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("XLA_FLAGS", "")
    whole, torn = tmp_path / "whole-cache", tmp_path / "torn-cache"
    whole.write_bytes(compilation_cache.compress_executable(bytes(1000)))
    torn.write_bytes(whole.read_bytes()[:-5])
    compiler.set_up("")
    assert whole.exists() and not torn.exists()


def test_the_first_run_says_that_programs_are_compiled(tmp_path, monkeypatch, capsys):
    kept = tmp_path / "programs"
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(kept))
    monkeypatch.setenv("XLA_FLAGS", "")
    compiler.set_up("")
    assert f"later runs find them in {kept}" in capsys.readouterr().out.replace("\n", "")
    kept.mkdir()
    (kept / "one").touch()
    compiler.set_up("")
    assert not capsys.readouterr().out


@pytest.mark.parametrize("devices", [1, 40])
def test_there_are_more_threads_than_devices(tmp_path, monkeypatch, devices):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("XLA_FLAGS", f"--xla_force_host_platform_device_count={devices}")
    monkeypatch.delenv("NPROC", raising=False)
    compiler.set_up("")
    assert int(os.environ["NPROC"]) == max(8, compiler.cores(), devices + 1)
