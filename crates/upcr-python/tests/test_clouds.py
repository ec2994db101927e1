"""Clouds, files and Open3D's objects."""

import copy
import pickle
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from conftest import SAMPLES, Points, turn

import upcr


def full(blob: Points) -> upcr.PointCloud:
    normals = blob / np.linalg.norm(blob, axis=1, keepdims=True)
    colors = np.arange(3 * len(blob)).reshape(-1, 3) % 256
    return upcr.PointCloud(blob, normals, colors, (1, 2, 3))


def equal(a: upcr.PointCloud, b: upcr.PointCloud) -> bool:
    return all(
        np.array_equal(getattr(a, name), getattr(b, name)) for name in ("points", "normals", "colors", "viewpoint")
    )


def test_arrays_are_taken_over_or_converted(blob: Points) -> None:
    assert upcr.PointCloud(blob).points is blob
    cloud = full(blob)
    assert cloud.normals is not None and cloud.colors is not None and cloud.viewpoint is not None
    assert cloud.points.dtype == np.float64 and cloud.normals.dtype == np.float32 and cloud.colors.dtype == np.uint8
    assert cloud.viewpoint.tolist() == [1, 2, 3]
    assert len(cloud) == 1024 and repr(cloud) == "<upcr.PointCloud: 1,024 points, normals, colors, seen from (1, 2, 3)>"
    for again in (copy.deepcopy(cloud), pickle.loads(pickle.dumps(cloud))):
        assert equal(cloud, again)
    with pytest.raises(upcr.CloudError, match="normals"):
        upcr.PointCloud(blob, blob[:, :2])


def test_colors(blob: Points) -> None:
    shares = np.linspace(0, 1, 3 * len(blob)).reshape(-1, 3)
    for colors in (shares, shares.astype(np.float32), np.rint(255 * shares).astype(int)):
        assert np.array_equal(upcr.PointCloud(blob, colors=colors).colors, np.rint(255 * shares))  # type: ignore[arg-type]
    for colors, message in (
        (255 * shares, "shares from 0 to 1"),
        (shares - 0.1, "shares"),
        (shares * np.nan, "shares"),
        (np.full(blob.shape, 256), "whole numbers from 0 to 255"),
        (np.full(blob.shape, -1), "whole"),
        (shares[:, 0], "shape"),
    ):
        with pytest.raises(upcr.CloudError, match=f"colors: .*{message}"):
            upcr.PointCloud(blob, colors=colors)


@pytest.mark.parametrize("name", ["a.ply", "a.pcd", "a.xyz", "a.npy", "a.las", "a.laz", "a.e57", "a.bin"])
def test_files(blob: Points, tmp_path: Path, name: str) -> None:
    upcr.write(tmp_path / name, upcr.PointCloud(blob))
    read = upcr.read(str(tmp_path / name))
    assert read.points.dtype == np.float64 and read.points.flags.c_contiguous and read.points.flags.writeable
    assert read.points.shape == blob.shape and np.abs(read.points - blob).max() < 1e-3
    assert read.normals is None


def test_what_files_keep(blob: Points, tmp_path: Path) -> None:
    cloud = full(blob)
    encodings: tuple[Literal["binary", "ascii"], ...] = ("binary", "ascii")
    for encoding in encodings:
        upcr.write(tmp_path / "a.ply", cloud, encoding=encoding)
        read = upcr.read(tmp_path / "a.ply")
        assert np.array_equal(read.points, cloud.points) and np.array_equal(read.normals, cloud.normals)  # type: ignore[arg-type]
        assert np.array_equal(read.colors, cloud.colors)  # type: ignore[arg-type]
    upcr.write(tmp_path / "a.pcd", cloud, encoding="compressed")
    assert upcr.read(tmp_path / "a.pcd").viewpoint is not None
    assert upcr.read(SAMPLES / "source.ply", viewpoint=[3, 4, 5]).viewpoint.tolist() == [3, 4, 5]  # type: ignore[union-attr]


def test_meshes_are_sampled(tmp_path: Path) -> None:
    mesh = tmp_path / "a.off"
    mesh.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    sampled = upcr.read(mesh, mesh_samples=50, mesh_seed=1).points
    assert sampled.shape == (50, 3)
    assert not np.array_equal(sampled, upcr.read(mesh, mesh_samples=50, mesh_seed=2).points)
    assert len(upcr.read(mesh)) == 100_000


def test_file_errors(blob: Points, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as caught:
        upcr.read(tmp_path / "none.ply")
    assert caught.value.filename == str(tmp_path / "none.ply")
    with pytest.raises(FileNotFoundError):
        upcr.write(tmp_path / "none" / "a.ply", blob)
    with pytest.raises(upcr.FormatError, match="can be read but not written"):
        upcr.write(tmp_path / "a.stl", blob)
    with pytest.raises(upcr.SettingError, match="there is no wide"):
        upcr.write(tmp_path / "a.ply", blob, encoding="wide")  # type: ignore[arg-type]
    with pytest.raises(upcr.CloudError, match="normals: 3 rows, where there are 1024 points"):
        cloud = upcr.PointCloud(blob)
        cloud.normals = np.zeros((3, 3), np.float32)
        upcr.write(tmp_path / "a.ply", cloud)
    assert list(tmp_path.iterdir()) == []


def test_a_moved_cloud(blob: Points) -> None:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn(40), (1, 2, 3)
    cloud = full(blob)
    moved = cloud.transformed(pose)
    assert np.allclose(moved.points, blob @ turn(40).T + (1, 2, 3))
    assert moved.normals is not None and cloud.normals is not None
    assert np.allclose(moved.normals, cloud.normals @ turn(40).T, atol=1e-6)
    assert moved.viewpoint is not None and np.allclose(moved.viewpoint, turn(40) @ (1, 2, 3) + (1, 2, 3))
    assert equal(cloud, full(blob))
    with pytest.raises(upcr.SettingError, match=r"`pose`: a 4x4 matrix is needed, not one of shape \[3, 3\]"):
        cloud.transformed(turn(40))
    with pytest.raises(upcr.SettingError, match="`viewpoint`: three coordinates"):
        upcr.PointCloud(blob, viewpoint=(1, 2))


def test_open3d(blob: Points, tmp_path: Path) -> None:
    o3d: Any = pytest.importorskip("open3d", reason="open3d cannot be imported", exc_type=ImportError)
    source = o3d.io.read_point_cloud(str(SAMPLES / "source.ply"))
    target = o3d.io.read_point_cloud(str(SAMPLES / "target.ply"))
    found = upcr.register(source, target)
    assert found.is_trustworthy
    files = upcr.register(SAMPLES / "source.ply", SAMPLES / "target.ply")
    assert found.transformation.tobytes() == files.transformation.tobytes()
    tensors = o3d.t.geometry.PointCloud.from_legacy(source, o3d.core.float64)
    assert upcr.register(tensors, target).transformation.tobytes() == found.transformation.tobytes()
    source.transform(found.transformation)
    agreement = o3d.pipelines.registration.evaluate_registration(source, target, found.voxel_size)
    assert agreement.fitness > 0.5

    cloud = full(blob)
    theirs = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points))
    theirs.normals = o3d.utility.Vector3dVector(np.asarray(cloud.normals, np.float64))
    assert cloud.colors is not None
    theirs.colors = o3d.utility.Vector3dVector(cloud.colors / 255)
    upcr.write(tmp_path / "a.ply", theirs)
    read = upcr.read(tmp_path / "a.ply")
    assert np.array_equal(read.colors, cloud.colors)  # type: ignore[arg-type]
    assert np.array_equal(upcr.features.fpfh(theirs), upcr.features.fpfh(cloud))


def test_clouds_are_made_of_what_has_points() -> None:
    cloud = upcr.PointCloud(np.eye(3), normals=np.eye(3), colors=np.eye(3), viewpoint=(0, 0, 1))
    again = upcr.PointCloud(cloud)
    assert again.normals is not None and again.colors is not None and again.viewpoint is not None
    assert (again.points == cloud.points).all() and (again.colors == cloud.colors).all()
    assert (again.normals == cloud.normals).all() and (again.viewpoint == cloud.viewpoint).all()
    with pytest.raises(upcr.CloudError, match="colors: 2 rows, where there are 3 points"):
        upcr.PointCloud(np.eye(3), colors=np.zeros((2, 3)))
