"""The controllers' law, against numbers by hand and against the motor's own equations."""

import numpy as np

from envs.logs import Controller

PD = Controller(
    kind="pd",
    rate_hz=1000.0,
    gains={"kp": np.array([10.0, 20.0]), "kd": np.array([1.0, 2.0]), "torque_limit_nm": np.array([3.0, np.inf])},
)
SERVO = Controller(
    kind="servo",
    rate_hz=1000.0,
    gains={"gain": np.array([2.0]), "kt": np.array([0.4]), "resistance_ohm": np.array([4.0])},
)


def test_a_pd_controller_is_a_limited_spring_and_damper():
    # 10 x 0.5 - 1 x 1 = 4, of which 3 are had; 20 x 0.5 - 2 x 1 = 8.
    torque = PD.impedance().torque(np.array([0.5, 0.5]), np.zeros(2), np.ones(2))
    np.testing.assert_array_equal(torque, [3.0, 8.0])
    np.testing.assert_array_equal(PD.impedance().back_emf, [0.0, 0.0])


def test_a_controller_that_is_off_does_nothing_even_without_a_limit():
    law = PD.impedance(enabled=np.array([1.0, 0.0]))
    for field in (law.stiffness, law.damping, law.limit):
        assert field.shape == (2, 2)
        assert (field[0] > 0).all()
        np.testing.assert_array_equal(field[1], [0.0, 0.0])


def test_a_servo_is_a_dc_motor_behind_a_duty_cycle():
    rng = np.random.default_rng(0)
    target, position, velocity = rng.uniform(-0.5, 0.5, 50)[:, None], np.zeros((50, 1)), rng.normal(size=(50, 1))
    volts = rng.uniform(6.0, 8.0, 50)
    duty = np.clip(2.0 * (target - position), -1.0, 1.0)
    current = (duty * volts[:, None] - 0.4 * velocity) / 4.0
    law = SERVO.impedance(volts=volts)
    joint = law.torque(target, position, velocity) - law.back_emf * velocity
    np.testing.assert_allclose(joint, 0.4 * current, rtol=1e-12, atol=1e-14)
    # 7 V x 0.4 Nm/A / 4 Ohm = 0.7 Nm when stalled.
    np.testing.assert_allclose(SERVO.impedance(volts=np.array([7.0])).limit, [[0.7]], rtol=1e-12)


def test_rows_and_joints_are_taken_as_of_an_array():
    law = PD.impedance(enabled=np.ones(3))
    np.testing.assert_array_equal(law[1].stiffness, [10.0, 20.0])
    np.testing.assert_array_equal(PD.impedance()[[1, 0]].limit, [np.inf, 3.0])
