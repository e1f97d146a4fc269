"""Robots, tasks, targets, missing effects and measured logs: everything that jaxtune works on.

- `biteno`, `pendulum`, `models`: the built-in robots and the walking task.
- `targets`: where measured episodes come from (MJX, MuJoCo C, PyBullet, recorded logs).
- `logs`, `diagnosis`: measured logs, and what is wrong with them.
- `effects`, `chain`, `rig`, `segments`, `regimes`, `null_logs`: the physics that a model may lack, and a robot on the
  test rig with all of it built in.
- `corrected`: a model as discovery leaves it, written to a folder and read again.
"""
