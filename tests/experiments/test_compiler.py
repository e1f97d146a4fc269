"""When programs are compiled, and where they are kept."""

import os

import jax
import jax.numpy as jnp
import pytest
from jax._src import compilation_cache

from experiments.common import compiler
from jaxtune import devices


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


def test_what_was_compiled_beside_another_is_not_compiled_by_its_call(caplog):
    programs, value = [jax.jit(lambda x, by=by: by * x) for by in (2.0, 3.0)], jnp.ones(3)
    with compiler.beside(programs[0], value):
        pass
    with jax.log_compiles():
        assert devices.on_all(programs[0])(value).tolist() == [2.0] * 3
        assert "Finished XLA compilation" not in caplog.text
        devices.on_all(programs[1])(value)
    assert "Finished XLA compilation" in caplog.text


def test_what_cannot_be_compiled_beside_another_says_so_where_it_is_called():
    program = jax.jit(lambda x: x.no_such_method())
    with compiler.beside(program, jnp.ones(3)):
        pass
    with pytest.raises(AttributeError):
        devices.on_all(program)(jnp.ones(3))
