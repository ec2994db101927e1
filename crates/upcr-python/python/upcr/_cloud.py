"""Clouds, from whatever holds points."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias, Union, runtime_checkable

import numpy as np
import numpy.typing as npt

from . import _upcr

if TYPE_CHECKING:
    from ._upcr import _Arrays, _Packed

FloatArray: TypeAlias = npt.NDArray[np.float64]


@runtime_checkable
class HasPoints(Protocol):
    """Whatever has points, such as Open3D's point clouds."""

    @property
    def points(self) -> Any:
        """Coordinates, shape (N, 3)."""


CloudLike: TypeAlias = Union[str, "os.PathLike[str]", npt.ArrayLike, HasPoints]
"""A cloud: a file's name, an array of shape (N, 3), or an object with ``points``."""


class PointCloud:
    """A point cloud in its file's own frame and unit.

    Attributes:
        points: float64, shape (N, 3), in the cloud's unit.
        normals: float32, shape (N, 3), unit vectors; or None.
        colors: uint8, shape (N, 3), red, green, blue, 0 to 255; or None.
        viewpoint: float64, shape (3,), where the sensor stood, in the cloud's frame and unit; or None.
    """

    points: FloatArray
    normals: npt.NDArray[np.float32] | None
    colors: npt.NDArray[np.uint8] | None
    viewpoint: FloatArray | None

    def __init__(
        self,
        points: npt.ArrayLike | HasPoints,
        normals: npt.ArrayLike | None = None,
        colors: npt.ArrayLike | None = None,
        viewpoint: npt.ArrayLike | None = None,
    ) -> None:
        """Takes over arrays that are of the attributes' types already, and converts all others: colors that are not whole
        numbers are shares, 0 to 1. Of an object with ``points``, such as Open3D's, it takes normals and colors too."""
        if isinstance(points, HasPoints) and not isinstance(points, np.ndarray):
            own_points, own_normals, own_colors, own_viewpoint = _arrays(points, normals=True, colors=True)
            points = own_points
            normals, colors = own_normals if normals is None else normals, own_colors if colors is None else colors
            viewpoint = own_viewpoint if viewpoint is None else viewpoint
        self.points = _rows(points, np.float64, "points")
        self.normals = None if normals is None else _rows(normals, np.float32, "normals")
        self.colors = None if colors is None else _bytes(colors)
        self.viewpoint = None if viewpoint is None else np.array(place(viewpoint))
        for name, rows in (("normals", self.normals), ("colors", self.colors)):
            if rows is not None and len(rows) != len(self.points):
                raise _upcr.CloudError(f"{name}: {len(rows)} rows, where there are {len(self.points)} points")

    def transformed(self, pose: npt.ArrayLike) -> PointCloud:
        """The cloud moved by ``pose``, shape (4, 4): points and viewpoint as points, normals as directions."""
        matrix = np.asarray(pose, np.float64)
        if matrix.shape != (4, 4):
            raise _upcr.SettingError(f"setting `pose`: a 4x4 matrix is needed, not one of shape {list(matrix.shape)}")
        rotation, translation = matrix[:3, :3], matrix[:3, 3]
        return PointCloud(
            self.points @ rotation.T + translation,
            None if self.normals is None else self.normals @ rotation.T.astype(np.float32),
            None if self.colors is None else self.colors.copy(),
            None if self.viewpoint is None else rotation @ self.viewpoint + translation,
        )

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        parts = [f"{len(self):,} points"]
        parts += ["normals"] if self.normals is not None else []
        parts += ["colors"] if self.colors is not None else []
        if self.viewpoint is not None:
            parts.append("seen from ({:g}, {:g}, {:g})".format(*self.viewpoint))
        return f"<upcr.PointCloud: {', '.join(parts)}>"


def read(
    path: str | os.PathLike[str],
    *,
    mesh_samples: int | None = None,
    mesh_seed: int | None = None,
    intrinsics: Sequence[float] | None = None,
    depth_scale: float | None = None,
    viewpoint: npt.ArrayLike | None = None,
) -> PointCloud:
    """Reads a cloud; the file's extension tells the format.

    Args:
        path: PLY, PCD, LAS, LAZ, E57, text, NumPy or KITTI clouds, OFF, OBJ or STL meshes, PNG depth images.
        mesh_samples: Points to sample from a mesh.
        mesh_seed: Seed of that sampling.
        intrinsics: Pinhole camera of a depth image, (fx, fy, cx, cy) in pixels; else a Kinect's, for 640x480 images.
        depth_scale: Depth image units per metre.
        viewpoint: Where the sensor stood, shape (3,), in the file's frame and unit, where the file does not say.

    Raises:
        OSError: The file cannot be read; FileNotFoundError where there is none.
        FormatError: It is not what its format demands, or the format is not known.
    """
    options = {
        "mesh_samples": mesh_samples,
        "mesh_seed": mesh_seed,
        "intrinsics": None if intrinsics is None else [float(value) for value in intrinsics],
        "depth_scale": depth_scale,
        "viewpoint": place(viewpoint),
    }
    return PointCloud(*_upcr.read(os.fspath(path), options))


def write(
    path: str | os.PathLike[str],
    cloud: CloudLike,
    *,
    encoding: Literal["binary", "ascii", "compressed"] | None = None,
) -> None:
    """Writes a cloud whole or not at all; the file's extension tells the format, which keeps what it can hold.

    Args:
        path: PLY, PCD, LAS, LAZ, E57, text, NumPy or KITTI.
        cloud: What is written, with its normals and colors.
        encoding: How numbers are stored, where the format has a choice: PLY and PCD, the last in PCD only.

    Raises:
        OSError: The file cannot be written.
        FormatError: The format cannot be written, or cannot hold the cloud.
    """
    _upcr.write(os.fspath(path), packed(cloud, normals=True, colors=True), encoding)


def packed(cloud: CloudLike, name: str = "points", *, normals: bool = False, colors: bool = False) -> _Packed:
    """The cloud as the native half takes it: a file's name, or C-contiguous arrays, with what else is asked for."""
    # Arrays first: to ask what is a path takes longer than all else that is done for them.
    if isinstance(cloud, np.ndarray):
        return _rows(cloud, np.float64, name), None, None, None
    if isinstance(cloud, (str, os.PathLike)):
        return os.fspath(cloud)
    return _arrays(cloud, name, normals=normals, colors=colors)


def _arrays(cloud: Any, name: str = "points", *, normals: bool, colors: bool) -> _Arrays:
    if hasattr(cloud, "to_legacy"):
        # Open3D's clouds of tensors.
        cloud = cloud.to_legacy()
    points = getattr(cloud, "points", None)
    if points is None:
        points = cloud
    return (
        _rows(points, np.float64, name),
        _rows_of(cloud, "normals", np.float32) if normals else None,
        _colors(cloud) if colors else None,
        place(getattr(cloud, "viewpoint", None)),
    )


def place(viewpoint: npt.ArrayLike | None) -> tuple[float, float, float] | None:
    """Three coordinates."""
    if viewpoint is None:
        return None
    try:
        values = np.asarray(viewpoint, np.float64).ravel().tolist()
    except (TypeError, ValueError):
        values = []
    if len(values) != 3:
        raise _upcr.SettingError(f"setting `viewpoint`: three coordinates are needed, not {viewpoint!r}")
    return (values[0], values[1], values[2])


def _rows(values: Any, dtype: npt.DTypeLike, name: str) -> npt.NDArray[Any]:
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        raise _upcr.CloudError(f"{name}: some entries are masked; leave these points out")
    array = np.asarray(values)
    if array.dtype == dtype and array.ndim == 2 and array.shape[1] == 3 and array.flags.c_contiguous and array.flags.aligned:
        return array
    if array.dtype.kind not in "fiu":
        what = type(values).__name__ if array.dtype.kind == "O" else f"an array of {array.dtype}"
        raise TypeError(f"{name}: an array of numbers, a file's name or an object with `points` is needed, not {what}")
    if array.ndim != 2 or array.shape[1] != 3:
        raise _upcr.CloudError(f"{name}: an array of shape (N, 3) is needed, not {array.shape}")
    return np.require(array, dtype, ["C_CONTIGUOUS", "ALIGNED"])


def _rows_of(cloud: Any, name: str, dtype: npt.DTypeLike) -> npt.NDArray[Any] | None:
    values = getattr(cloud, name, None)
    # Open3D has an empty array where there are none.
    return None if values is None or len(values) == 0 else _rows(values, dtype, name)


def _colors(cloud: Any) -> npt.NDArray[np.uint8] | None:
    values = getattr(cloud, "colors", None)
    return None if values is None or len(values) == 0 else _bytes(values)


def _bytes(values: Any) -> npt.NDArray[np.uint8]:
    """Colors, 0 to 255, of such or of shares, 0 to 1, as Open3D has them."""
    colors = np.asarray(values)
    shares = colors.dtype.kind == "f"
    most, rounding = (1, 1e-6) if shares else (255, 0)
    if colors.dtype.kind in "fiu" and not ((colors >= -rounding) & (colors <= most + rounding)).all():
        raise _upcr.CloudError(f"colors: {'shares' if shares else 'whole numbers'} from 0 to {most} are needed")
    return _rows(np.rint(255 * colors.clip(0, 1)) if shares else colors, np.uint8, "colors")
