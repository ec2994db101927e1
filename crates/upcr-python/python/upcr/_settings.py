"""All that a registration can be told."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Any, Literal, TypedDict

import numpy as np
import numpy.typing as npt

from ._model import Model

Method = Literal["auto", "features", "prior", "upcr", "fgr", "ransac", "consensus"]
Feature = Literal["fpfh", "spfh", "pfh"]
Refinement = Literal["gicp", "plane", "point", "none"]
Kernel = Literal["none", "huber", "cauchy", "geman_mcclure", "tukey"]


class Settings(TypedDict, total=False):
    """Keywords of ``register`` and ``register_batch``. One that is left out, or None, has the library's default, which
    the result's ``settings`` tell."""

    method: Method | None
    """Where the first pose comes from."""
    network: Model | str | os.PathLike[str] | None
    """The network that is asked, or its weights file; else the one in the package."""
    feature: Feature | None
    """The feature that is matched, where the method matches one."""
    refine: Refinement | None
    """What the refinement minimises."""
    voxel_size: float | None
    """The one scale that drives every radius, in the clouds' unit; else derived from the clouds."""
    init: npt.ArrayLike | str | os.PathLike[str] | None
    """A first guess of the pose, shape (4, 4), source to target, or a text file with one."""
    kernel: Kernel | None
    """How residuals of the refinement are weighed."""
    overlap: float | None
    """Share of the closest pairs that the refinement keeps, 0 to 1; else all within reach."""
    locks: str | Iterable[str] | None
    """Degrees of freedom that keep their value in the first guess, of roll, pitch, yaw, x, y, z."""
    calibration: str | os.PathLike[str] | None
    """What the evidence for a pose weighs: a file of ``upcr calibrate``."""
    seed: int | None
    """Seed of every random choice."""
    threads: int | None
    """Threads to use; the result does not depend on it."""
    max_seconds: float | None
    """Seconds after which the call ends with the best pose so far."""
    max_memory_bytes: int | None
    """Bytes that the call may take beside its clouds; where it needs more, the clouds are thinned."""


def packed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that are told, as the native half takes them."""
    told = {name: value for name, value in settings.items() if value is not None}
    if "network" in told:
        network = told["network"]
        told["network"] = network._native if isinstance(network, Model) else os.fspath(network)
    if "calibration" in told:
        told["calibration"] = os.fspath(told["calibration"])
    if "init" in told:
        told["init"] = pose(told["init"])
    if "locks" in told and not isinstance(told["locks"], str):
        told["locks"] = list(told["locks"])
    return told


def pose(init: npt.ArrayLike | str | os.PathLike[str]) -> npt.NDArray[np.float64] | str:
    """A first guess as the native half takes it."""
    if isinstance(init, (str, os.PathLike)):
        return os.fspath(init)
    matrix = np.require(init, np.float64, ["C_CONTIGUOUS", "ALIGNED"])
    # As files have it, the last row may be left out.
    return np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]]) if matrix.shape == (3, 4) else matrix
