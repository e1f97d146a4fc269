"""The command `sweep`, before anything is compiled."""

import pytest

from experiments import sweep
from experiments.common import checkpoint


def test_lanes_are_all_combinations_with_every_seed():
    grid = sweep.lanes(
        sweep.Args(step_sizes=(0.25, 0.5), widen_factors=(1.5,), radii=(0.2, 0.3, 0.4), seeds=(0, 1, 2, 3))
    )
    assert grid.shape == (2, 1, 3, 2, 4, 5)
    assert grid[1, 0, 2, 0, 3].tolist() == [0.5, 1.5, 0.4, 0.8, 3.0]
    assert len({tuple(lane) for lane in grid.reshape(-1, 5)}) == 48


def test_a_folder_in_which_another_process_works_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep, "sweep", lambda *_: pytest.fail("it was begun"))
    args = sweep.Args(out=tmp_path / "sweep", preset="smoke")
    with pytest.raises(pytest.fail.Exception, match="it was begun"):
        sweep.main(args)
    with checkpoint.lock(args.out / "summary.json"), pytest.raises(ValueError, match="another process works on"):
        sweep.main(args)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"step_sizes": (0.5, 0.0)}, "step_size: got 0.0"),
        ({"levels": (1.5,)}, "level: got 1.5"),
        ({"levels": (0.95, 0.99)}, "level: got 0.99, expected 0.95 or less with 19 simulated sets"),
        ({"seeds": ()}, "seeds: got none"),
        ({"radii": (0.2, 0.2)}, r"radii: got \(0.2, 0.2\), expected each value once"),
        ({"truth": ("left_thigh_mass=1.1", "left_thigh_mass=1.2")}, "truth: got 'left_thigh_mass' twice"),
        ({"seeds": (1, 1)}, "seeds: got 1, 1, expected 0 to 16777216, each once"),
        ({"update": "leap"}, "update: got 'leap', expected one of posterior, vote"),
        ({"update": "posterior"}, "step_sizes: got 3, expected one"),
        ({"lanes": 0}, "lanes: got 0"),
        ({"case": "delay"}, "a sweep needs a target in mjx|case: got 'delay'"),
    ],
)
def test_a_wrong_setting_is_named(options, named):
    with pytest.raises(ValueError, match=named):
        sweep.check(sweep.Args(preset="smoke", **options))
