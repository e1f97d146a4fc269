"""Robots, tasks, targets, missing effects and measured logs: everything that jaxtune works on.

- `biteno`, `pendulum`, `models`: the built-in robots and the walking task.
- `targets`: where measured episodes come from (MJX, MuJoCo C, PyBullet, recorded logs).
- `logs`, `diagnosis`: measured logs, and what is wrong with them.
- `effects`, `chain`, `rig`: the physics that a model may lack, and a robot on the test rig with all of it built in.
- `segments`, `regimes`, `scales`, `null_logs`: what discovery computes from a log before it compares it with the rig.
- `corrected`: a model as discovery corrected it, saved to a folder and loaded again.
- `sensing`: the policy's observation, the same in every engine.
"""
