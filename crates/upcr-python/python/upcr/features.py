"""Pose-invariant descriptors of points.

Each function takes a cloud of N points and gives float32 rows, one a point, over its ``k`` nearest neighbours, the point
itself included, or over those within ``radius`` (in the cloud's unit). Normals, where a descriptor needs them, are the
cloud's, or are estimated where it has none. The result does not depend on ``threads``.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from . import _upcr
from ._cloud import CloudLike, packed
from ._upcr import DEFAULT_K

__all__ = ["DEFAULT_K", "distance", "fpfh", "pfh", "ppf", "spfh"]

_Rows = npt.NDArray[np.float32]


def distance(
    points: CloudLike, k: int = DEFAULT_K, *, radius: float | None = None, threads: int | None = None
) -> _Rows:
    """For each neighbour its distance from the centroid and from the point, and the point's from the centroid: (N, 3k)."""
    return _upcr.describe(packed(points), "distance", k, radius, threads)


def ppf(
    points: CloudLike, k: int = DEFAULT_K, *, radius: float | None = None, threads: int | None = None
) -> _Rows:
    """Point pair features: for each neighbour its distance and three angles in rad, shape (N, 4k)."""
    return _upcr.describe(packed(points, normals=True), "ppf", k, radius, threads)


def spfh(
    points: CloudLike, k: int = DEFAULT_K, *, radius: float | None = None, threads: int | None = None
) -> _Rows:
    """Simplified point feature histograms, of the pairs with the point itself: shape (N, 33)."""
    return _upcr.describe(packed(points, normals=True), "spfh", k, radius, threads)


def pfh(
    points: CloudLike, k: int = DEFAULT_K, *, radius: float | None = None, threads: int | None = None
) -> _Rows:
    """Point feature histograms, of all pairs in the neighbourhood: shape (N, 125)."""
    return _upcr.describe(packed(points, normals=True), "pfh", k, radius, threads)


def fpfh(
    points: CloudLike, k: int = DEFAULT_K, *, radius: float | None = None, threads: int | None = None
) -> _Rows:
    """Fast point feature histograms (Rusu et al. 2009): shape (N, 33)."""
    return _upcr.describe(packed(points, normals=True), "fpfh", k, radius, threads)
