"""Fits a robot's model to logs with MuJoCo's own system identification, `mujoco.sysid` (extra `sysid`).

A fixed list of parameters is fitted and no effect is named: what discovery is compared with.
"""

import io
from collections.abc import Callable

import mujoco
import numpy as np

from experiments.discovery.playback import Pieces
from experiments.discovery.sysid_parameters import Robot, package

_DIFFERENCE = 1e-4  # step of finite differences in units of a parameter
_TOLERANCE = 1e-4


def fit(robot: Robot, start, pieces: Pieces, weight: float, iterations: int):
    """Fits parameters to pieces of a log by `mujoco.sysid.optimize`.

    The loss is the sum of squared position errors, divided by that of the nominal model, plus
    `weight` times the squared distance of the parameters from the nominal ones, in their units.

    Args:
      robot: the nominal model.
      start: parameters to start from, of `declare`; the nominal ones are theirs too.
      pieces: what to fit.
      weight: of the distance.
      iterations: at most.

    Returns:
      The fitted parameters, a `mujoco.sysid.ParameterDict`.
    """
    sysid = package()
    nominal = start.copy()
    nominal.reset()
    errors = (robot.play(nominal, pieces) - pieces.measured)[pieces.real]
    scale = 1.0 / np.sqrt((errors**2).sum())
    residual = sysid.build_residual_fn(
        models_sequences=[_sequences(robot, pieces)],
        build_model=lambda parameters, _: robot.compile(parameters),
        custom_rollout=_rollout(robot, pieces),
        modify_residual=_difference(scale),
        resample_true=False,
        n_threads=1,
    )
    centre = nominal.as_vector()

    def penalised(values, parameters):
        found, predicted, measured = residual(values, parameters)
        away = np.sqrt(weight) * (values.reshape(len(centre), -1) - centre[:, None])
        return [_by_column(found[0], values, len(pieces.start)), away.reshape(values.shape)], predicted, measured

    fitted, _ = sysid.optimize(
        initial_params=start,
        residual_fn=penalised,
        optimizer="mujoco",
        verbose=False,
        max_iters=iterations,
        eps=_DIFFERENCE,
        xtol=_TOLERANCE,
        output=io.StringIO(),
        x_scale="jac",
    )
    return fitted


def _sequences(robot: Robot, pieces: Pieces):
    """Hands the pieces to `mujoco.sysid` as one batch; controls are made by the rollout, which knows the delay."""
    sysid, model = package(), robot.spec.compile()
    names = [f"q.{joint}" for joint in robot.joints]
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    rows = np.arange(pieces.measured.shape[1], dtype=float)
    control = sysid.TimeSeries(rows[:2], np.zeros((2, model.nu)))
    # A row that is not real has no error, whatever is predicted.
    measured = np.where(pieces.real[..., None], pieces.measured, np.nan)
    series = [sysid.TimeSeries.from_names(rows, values, model, names) for values in measured]
    sequences = sysid.ModelSequences(
        "robot",
        robot.spec,
        [f"piece {number}" for number in range(len(series))],
        [np.zeros(size)] * len(series),
        [control] * len(series),
        series,
    )
    # In this form all pieces are simulated together, by one model for every set of parameters.
    sequences.measured_rollout = [sequences.measured_rollout]
    return sequences


def _rollout(robot: Robot, pieces: Pieces) -> Callable:
    def simulate(*, models, control_signal, initial_states, param_dicts, rollout_signal_mapping, **_):
        sysid, count, found = package(), len(pieces.start), []
        rows = np.arange(pieces.measured.shape[1], dtype=float)
        for number, parameters in enumerate(param_dicts):
            model = models[number * count]
            # The package checks times and sizes of the states, which nothing else reads.
            state = np.zeros((len(rows), 1 + model.nq + model.nv + model.na))
            state[:, 0] = rows
            for read in robot.play(parameters, pieces, model):
                found.append(
                    sysid.SystemTrajectory(
                        model=model,
                        control=control_signal[0],
                        sensordata=sysid.TimeSeries(rows, read, rollout_signal_mapping),
                        initial_state=initial_states[0],
                        state=sysid.TimeSeries(rows, state),
                    )
                )
        return found

    return simulate


def _difference(scale: float) -> Callable:
    def residual(parameters, predicted, measured, model, everything, **_):
        error = np.nan_to_num(scale * (predicted.data - measured.data))
        return error, predicted, measured

    return residual


def _by_column(found: np.ndarray, values: np.ndarray, pieces: int) -> np.ndarray:
    """Brings residuals to one column per set of parameters; the package returns one per set and piece."""
    if values.ndim == 1:
        return found
    return found.reshape(len(found), -1, pieces).transpose(2, 0, 1).reshape(-1, values.shape[1])


def subsample(pieces: Pieces, seconds: float) -> Pieces:
    """Takes pieces at even distances, so that together they last no longer than `seconds`, one at least."""
    length = pieces.stiffness.shape[1] * pieces.dt
    count = int(np.clip(seconds / length, 1, len(pieces.start)))
    return pieces[np.unique(np.linspace(0, len(pieces.start) - 1, count).round().astype(int))]
