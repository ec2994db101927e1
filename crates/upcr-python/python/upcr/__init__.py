"""Rigid point-cloud registration: two clouds in, the pose that lays one on the other and an honest verdict out.

>>> import upcr
>>> found = upcr.register("source.ply", "target.ply")  # doctest: +SKIP
>>> found.transformation, found.probability, found.reasons  # doctest: +SKIP

Clouds are arrays of shape (N, 3), names of files, :class:`PointCloud` or anything with ``points``, such as Open3D's.
A pose takes source coordinates to target coordinates, ``y = R x + t``, both in the clouds' own frames and unit; angles
are in radians. Matrices are NumPy arrays, row after row.
"""

from . import features
from ._adapt import Adaptation, AdaptationProgress, Errors, adapt
from ._cloud import CloudLike, PointCloud, read, write
from ._merge import Merged, MergedPair, MergedScan, MergeProgress, merge
from ._model import Model
from ._register import Progress, register, register_batch
from ._registration import Alternative, Evidence, FreeDirection, Registration, Timings
from ._settings import Settings
from ._upcr import (
    TRUSTWORTHY,
    CloudError,
    Error,
    FormatError,
    SettingError,
    WeightsError,
    __version__,
)

__all__ = [
    "TRUSTWORTHY",
    "Adaptation",
    "AdaptationProgress",
    "Alternative",
    "CloudError",
    "CloudLike",
    "Error",
    "Errors",
    "Evidence",
    "FormatError",
    "FreeDirection",
    "MergeProgress",
    "Merged",
    "MergedPair",
    "MergedScan",
    "Model",
    "PointCloud",
    "Progress",
    "Registration",
    "SettingError",
    "Settings",
    "Timings",
    "WeightsError",
    "__version__",
    "adapt",
    "features",
    "merge",
    "read",
    "register",
    "register_batch",
    "write",
]
