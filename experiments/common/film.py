"""Renders the walking robot off screen with MuJoCo: a strip of pictures for a page, or an animated GIF."""

import os
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from envs.biteno import constants

_SIZE = 360, 270  # width and height of a picture
_PICTURES = 10
_EVERY_STRIP, _EVERY_GIF = 6, 4  # policy steps of 10 ms between two pictures


class NoPicture(RuntimeError):
    """Says that MuJoCo cannot render here, because there is no OpenGL off screen.

    Pictures are an extra, so a command that meets it prints the reason and continues without them.
    """


def strip(path: Path, model: mujoco.MjModel, qpos: np.ndarray) -> None:
    """Writes ten pictures of an episode's second half, 60 ms apart in two rows, so that a stride can be seen.

    Args:
      path: of the PNG.
      model: the robot.
      qpos: [time, 13] generalised positions of one episode, a row for each policy step.

    Raises:
      NoPicture: no OpenGL for rendering off screen.
    """
    first = len(qpos) // 2
    pictures = _render(model, qpos[first : first + _PICTURES * _EVERY_STRIP : _EVERY_STRIP])
    rows = [np.concatenate(pictures[row : row + 5], axis=1) for row in (0, 5)]
    Image.fromarray(np.concatenate(rows)).save(path)


def gif(path: Path, model: mujoco.MjModel, qpos: np.ndarray) -> None:
    """Writes the whole episode as an animated GIF that plays in real time, for a person who wants to see the gait.

    Args:
      path: of the GIF.
      model: the robot.
      qpos: [time, 13] generalised positions of one episode, a row for each policy step.

    Raises:
      NoPicture: no OpenGL for rendering off screen.
    """
    first, *rest = map(Image.fromarray, _render(model, qpos[::_EVERY_GIF]))
    milliseconds = round(1000 * _EVERY_GIF * constants.POLICY_DT_S)
    first.save(path, save_all=True, append_images=rest, duration=milliseconds, loop=0)


def _render(model: mujoco.MjModel, qpos: np.ndarray) -> list[np.ndarray]:
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, model.body("trunk").id
    camera.distance, camera.azimuth, camera.elevation = 1.8, 90.0, -10.0
    try:
        renderer = mujoco.Renderer(model, height=_SIZE[1], width=_SIZE[0])
    except Exception as error:  # every OpenGL backend raises an exception of its own
        raise NoPicture(
            f"MuJoCo cannot render off screen ({error}); with MUJOCO_GL={os.environ.get('MUJOCO_GL', '')!r}. "
            "Set MUJOCO_GL to egl on a GPU, or to osmesa with OSMesa installed."
        ) from error
    pictures = []
    with renderer:
        for row in qpos:
            data.qpos[:] = row
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            pictures.append(renderer.render().copy())
    return pictures
