"""Writes the model of a robot as one MJCF file that needs no other: without includes, meshes and textures."""

import re
from pathlib import Path

import mujoco

_OTHER_FILES = re.compile(r"<include\b|\bfile\s*=")


def standalone(path: Path) -> str:
    """Returns a model as the text of one MJCF file with the same joints, masses and inertias.

    A file that refers to no others is returned as it is. In all others geoms of meshes and height fields are left out,
    after the masses of bodies have been written down; a suspended robot touches nothing.

    Args:
      path: of the MJCF file.

    Raises:
      ValueError: the file or one that it refers to cannot be read, or something needs a geom that is left out.
    """
    text = path.read_text(encoding="utf-8")
    # A comment may speak of files.
    if not _OTHER_FILES.search(re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)):
        return text
    spec = mujoco.MjSpec.from_file(str(path))
    _write_inertias(spec, spec.compile())
    shaped = (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_SDF)
    # A primitive that was fitted to a mesh needs the mesh too.
    for geom in [geom for geom in spec.geoms if geom.type in shaped or geom.meshname]:
        spec.delete(geom)
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for needless in (*spec.skins, *spec.meshes, *spec.hfields, *(one for one in spec.textures if one.file)):
        spec.delete(needless)
    spec.meshdir = spec.texturedir = ""
    try:
        spec.compile()
        written = spec.to_xml()
        mujoco.MjModel.from_xml_string(written)
    except ValueError as error:
        raise ValueError(f"robot: {path} without its mesh geoms: {error}") from error
    return written


def _write_inertias(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Gives every body the mass and inertia that it was compiled with, in the place of its geoms'."""
    for body in spec.bodies:
        if not model.body_mass[body.id]:
            continue
        body.explicitinertial = True
        body.mass = model.body_mass[body.id]
        body.inertia, body.fullinertia = model.body_inertia[body.id], [float("nan")] + 5 * [0.0]
        body.ipos, body.iquat = model.body_ipos[body.id], model.body_iquat[body.id]
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
