"""Where the untuned policy is sent."""

import numpy as np
import pytest

from envs.biteno import constants
from experiments import gaps


def test_every_point_lies_within_the_bounds_of_its_parameters(robot):
    rows = gaps.points(robot.mj_model.geom(constants.FEET[0]).friction[0])
    assert {row[0] for row in rows} == set(gaps.SWEEPS)
    for _, _, params in rows:
        for name, value in params.items():
            low, high = constants.ENTRIES[name].bounds
            assert low <= value <= high


def test_friction_is_a_coefficient_and_masses_go_together():
    rows = {(sweep, value): params for sweep, value, params in gaps.points(0.6)}
    np.testing.assert_allclose(rows["friction", 0.3]["foot_friction"], 0.5)
    assert rows["motor", 0.6] == {"torque_scale": 0.6}
    masses = {name for name in constants.PARAMETER_SETS["whole_body"] if name.endswith("_mass")}
    assert rows["mass", 2.0] == dict.fromkeys(masses, 2.0)


@pytest.mark.parametrize(("field", "value", "named"), [("preset", "huge", "smoke, cpu, gpu"), ("episodes", 0, "1 or")])
def test_bad_input_of_gaps_is_named(field, value, named):
    with pytest.raises(ValueError, match=named):
        gaps.main(gaps.Args(**{field: value}))
