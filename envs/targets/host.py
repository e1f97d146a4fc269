"""Episodes in engines outside JAX. The engine simulates the physics; everything else is the same code as in MJX.

To add an engine, write an `Engine` and wrap it in a `HostTarget`.
"""

from collections.abc import Mapping
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from envs.biteno import Biteno, Drive, Motion, State
from envs.corrected import CorrectedBiteno
from envs.targets.protocol import Act, Commands, Recording, watch
from jaxtune.types import Trajectory


class Engine(Protocol):
    """A physics engine that simulates many robots of one model, one policy step at a time.

    It knows nothing of observation, reward or policy, which `HostTarget` adds.
    """

    def start(self, state: State) -> None:
        """Puts robots [episodes] into their first states, before the first call of `move`.

        An engine without a state of its own may ignore it, because `move` is given the state as well.
        """

    def move(self, state: State, drive: Drive) -> Motion:
        """Moves every robot [episodes] by one policy step.

        Args:
          state: before the step. Its velocity may differ from where the last motion ended, because robots are pushed.
          drive: joint targets of every sub-step.

        Returns:
          Where the robots are after the step, in MuJoCo's conventions (`Motion`), [episodes, ...].
        """


class HostTarget:
    """A target whose physics is simulated outside JAX, by MuJoCo C or PyBullet.

    Observation, reward, termination and commands are the functions of `Biteno`, so a target differs from the tuner's
    simulator in its physics alone.

    Args:
      robot: task and robot; its MJX model is not used.
      params: true physical values by name; only tests and reports may read them.
      engine: simulates the robots.

    Raises:
      ValueError: the robot has effects that only MJX can give it.
    """

    def __init__(self, robot: Biteno, params: Mapping[str, float], engine: Engine):
        if isinstance(robot, CorrectedBiteno):
            raise ValueError("target: got a corrected robot, expected the nominal one: other engines lack its effects")
        self.params = params
        self._engine, self._kept = engine, robot.kept
        self._reset = jax.jit(jax.vmap(lambda key: robot.reset({}, key)))
        self._with_command = jax.jit(jax.vmap(robot.with_command))
        self._drive = jax.jit(jax.vmap(lambda state, action: robot.drive(params, state, action)))
        self._choose = jax.jit(lambda act, obs, keys: jax.vmap(act)(obs, keys))
        self._settle = jax.jit(jax.vmap(robot.settle))

    def episodes(self, key: jax.Array, act: Act, count: int, steps: int, states: bool = False) -> Trajectory:
        """Measures episodes under a policy, on the host; `envs.targets.protocol.Target` describes arguments and result.

        It cannot be jitted, so the tuner is given its episodes through `Tuner.tune`.
        """
        return self._play(key, act, count, steps, None, states)[0]

    def record(
        self, key: jax.Array, act: Act, count: int, steps: int, commands: Commands | None = None
    ) -> tuple[Trajectory, Recording]:
        """Measures episodes and their motion; `envs.targets.protocol.Target` describes arguments and result.

        Robots that fell or broke are simulated on to the last step, masked.
        """
        return self._play(key, act, count, steps, commands, False)

    def _play(self, key, act, count, steps, commands, states) -> tuple[Trajectory, Recording]:
        # As a pytree a policy is an argument of one compiled program, not a constant of a new one.
        act = act if isinstance(act, jax.tree_util.Partial) else jax.tree_util.Partial(act)
        # The same keys as in `envs.targets.mjx.rollout`, so that episodes in all engines start alike.
        keys = jax.vmap(jax.random.split)(jax.random.split(key, count))
        step_keys = np.asarray(jax.vmap(lambda key: jax.random.split(key, steps))(keys[:, 1]))
        state = self._reset(keys[:, 0])
        if commands is not None and commands.phase is not None:
            state = self._with_command(state, commands.command[:, 0], commands.phase)
        self._engine.start(state)
        alive = np.ones(count, bool)
        not_finite = np.zeros(count, bool)
        records = []
        for index in range(steps):
            state = state if commands is None else self._with_command(state, commands.command[:, index], state.phase)
            action = self._choose(act, state.obs, step_keys[:, index])
            drive = self._drive(state, action)
            motion = self._engine.move(state, drive)
            following = self._settle(state, drive, motion)
            # The step in which a simulation broke has no valid score, so it is masked as well.
            broke = alive & (np.asarray(following.not_finite) > 0)
            valid = alive & ~broke
            score = np.where(valid, following.score, 0.0)
            kept = self._kept(state) if states else None
            record = (state.obs, action, valid, score, kept), watch(state, following, motion)
            records.append(jax.tree.map(np.asarray, record))
            alive &= np.asarray(following.done) == 0
            not_finite |= broke
            # Also after a fall: masked steps cost little, and the batch keeps its shape.
            state = following
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *records)
        (obs, action, valid, score, kept), recording = jax.tree.map(jnp.asarray, stacked)
        fell, not_finite = jnp.asarray(~alive), jnp.asarray(not_finite)
        ended = {"fell": fell, "not_finite": not_finite}
        return Trajectory(obs=obs, action=action, alive=valid, score=score, state=kept, **ended), recording
