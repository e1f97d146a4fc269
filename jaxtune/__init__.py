"""jaxtune tunes a simulator to the robot that was measured, and says where the simulator's physics is wrong.

Which module to import for what:

- `jaxtune.tuner`: the tuner (Algorithm 1), its settings, and its default gate and update. Start here.
- `jaxtune.host`: the same tuner for a simulator that is not JAX, such as a Gymnasium environment.
- `jaxtune.types`: the records that you hand in and get back (`Trajectory`, `ParamDist`, `Verdict`, `Coords`).
- `jaxtune.dist`: make, sample, move and widen the distribution that is tuned.
- `jaxtune.baselines`: domain randomisation and the paper's ungated method, to compare with.
- `jaxtune.ppo`: a PPO update that can be jitted, for policies trained in Brax environments.
- `jaxtune.mjx`: simulates anyone's MJX environment with other masses, frictions, strengths or delays, from a table that
  says which may be wrong; needs MuJoCo.
- `jaxtune.discovery`: find the effect that a model lacks when the tuner's verdict is `unexplained`.
- `jaxtune.gate`, `jaxtune.update`, `jaxtune.spm`, `jaxtune.dvm`, `jaxtune.windows`: what the tuner is made of, to
  replace or to read.

`jaxtune.tuner` and the modules that it imports know no simulator; the functions that you hand in know yours.
"""
