"""Corrected models: what discovery found missing in a model, saved to a folder and simulated again from it.

A corrected model is a folder of two files. `model.xml` is the MJCF with every correction that MJCF can express
(masses, armatures, friction); `effects.json` holds the rest (delays, backlash, sensor errors, ...), in physical units,
by effect, place and parameter. `save` and `load` write and read it as a robot on the test rig (`envs.rig`). `read`
returns it as a `Correction`, which `make` turns into a BITeno that walks with these effects.
"""

from envs.corrected.biteno import CorrectedBiteno, make
from envs.corrected.record import Correction, read
from envs.corrected.rig import coordinates, load, save

__all__ = ["CorrectedBiteno", "Correction", "coordinates", "load", "make", "read", "save"]
