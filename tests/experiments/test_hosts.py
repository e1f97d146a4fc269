"""Two processes on this machine stand for two hosts."""

import itertools
import json
import os
import socket

import numpy as np
import pytest
from processes import ROBOT, SIM2SIM, TRAIN, end, networks, read, same, start

from experiments.common import hosts
from experiments.common.hosts import HostArgs


@pytest.fixture(scope="module")
def environment():
    flags = "--xla_force_host_platform_device_count={} --xla_backend_optimization_level=0"
    return {count: {**os.environ, "XLA_FLAGS": flags.format(count)} for count in (1, 2)}


def on_two(imports, options, environment, outs):
    """Gives a command to two hosts, each with a folder of its own, and waits for both."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    several = ["--coordinator", address, "--hosts", "2", "--host"]
    both = [
        start(imports, [*options, "--out", str(out), *several, str(number)], environment)
        for number, out in enumerate(outs)
    ]
    for process in both:
        end(process)


@pytest.mark.slow
def test_two_hosts_train_what_two_devices_train_and_one_of_them_writes(environment, tmp_path):
    first, other, alone = (tmp_path / name for name in ("first", "other", "alone"))
    options = ["--robot", ROBOT, "--preset", "smoke", "--updates", "6"]
    end(start(TRAIN, [*options, "--out", str(alone)], environment[2]))
    on_two(TRAIN, options, environment[1], (first, other))
    assert not other.exists()
    same(read(first / "curve.json"), read(alone / "curve.json"), 1e-4)
    assert all(np.isfinite(values).all() for values in networks(first))


@pytest.mark.slow
def test_a_comparison_on_two_hosts_joined_from_two_seeds(environment, tmp_path):
    first, other, alone = (tmp_path / name for name in ("first", "other", "alone"))
    options = ["--preset", "smoke", "--methods", "ours"]
    for seed in ("0", "3"):
        on_two(SIM2SIM, [*options, "--seeds", seed], environment[1], (first, other))
    # All is there already, so a single process joins it.
    end(start(SIM2SIM, [*options, "--seeds", "0", "3", "--out", str(first)], environment[2]))
    end(start(SIM2SIM, [*options, "--seeds", "0", "3", "--out", str(alone)], environment[2]))
    assert not other.exists()
    ours, theirs = (read(place / "summary.json") for place in (first, alone))
    assert ours["seeds"] == [0, 3] and len(ours["methods"]["ours"]["return_end"]) == 2
    assert ours["methods"]["ours"]["verdicts"] == theirs["methods"]["ours"]["verdicts"]
    lines = [json.loads(line) for line in (first / "metrics.jsonl").read_text().splitlines()]
    assert [line["seed"] for line in lines] == sorted(line["seed"] for line in lines)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"hosts": 0}, "hosts: got 0"),
        ({"hosts": 2}, "coordinator: got None"),
        ({"hosts": 2, "coordinator": "first"}, "coordinator: got 'first'"),
        ({"hosts": 2, "coordinator": "first:99999"}, "coordinator: got 'first:99999'"),
        ({"hosts": 2, "coordinator": "first:1", "host": 2}, "host: got 2"),
        ({"coordinator": "first:1"}, "hosts: got 1"),
    ],
)
def test_a_wrong_option_is_named(options, named):
    with pytest.raises(ValueError, match=named):
        hosts.join(HostArgs(**options))


def test_a_host_alone_calls_what_it_reads():
    calls = itertools.count()
    assert hosts.from_first(lambda: next(calls)) == 0
    with pytest.raises(OSError, match="full"):
        hosts.on_first(lambda: (_ for _ in ()).throw(OSError("full")))()
