"""jaxtune tunes a simulator to the robot that was measured, and says where the simulator's physics is wrong.

Which module to import for what:

- `jaxtune.tuner`: the tuner (Algorithm 1), its settings and its default rules. Start here.
- `jaxtune.types`: the records that you hand in and get back (`Trajectory`, `ParamDist`, `Verdict`, `Coords`).
- `jaxtune.dist`: make, sample, move and widen the distribution that is tuned.
- `jaxtune.baselines`: domain randomisation and the paper's ungated method, to compare with.
- `jaxtune.ppo`: a PPO update that can be jitted, for policies trained in Brax environments.
- `jaxtune.mjx`: the table of an MJX model's parameters, and the model that has other values of them; needs MuJoCo.
- `jaxtune.discovery`: find the effect that a model lacks when the tuner's verdict is `unexplained`.
- `jaxtune.rules`, `jaxtune.spm`, `jaxtune.dvm`, `jaxtune.windows`: what the tuner is made of, to replace or to read.
- `jaxtune.mjx`: set the physical parameters of a MuJoCo or MJX model, with all derived fields.

`jaxtune.tuner` and the modules that it imports know no simulator; the functions that you hand in know yours.
"""
