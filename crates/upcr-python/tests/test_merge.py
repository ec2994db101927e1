"""Merges: many scans into models."""

import copy
import dataclasses
import inspect
import json
import pickle
import subprocess
import sys
import threading
import typing
from pathlib import Path

import numpy as np
import pytest
from conftest import Points, bumpy, turn

import upcr

Scans = list[Points]


def seen(surface: Points, number: int, of: int) -> Points:
    """The half of a surface that faces one of so many sensors around it."""
    angle = 2 * np.pi * number / of
    return surface[surface @ (np.cos(angle), np.sin(angle), 0.3) > 0]


def frame(number: int) -> Points:
    """Where a scan's own frame lies: takes coordinates of the scene to the scan's, shape (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = turn(70 * number, (1, 0.3 * number, -0.5))
    pose[:3, 3] = 3 * number, -number, 2
    return pose


def in_frame(points: Points, pose: Points) -> Points:
    return np.ascontiguousarray(points @ pose[:3, :3].T + pose[:3, 3])


@pytest.fixture(scope="module")
def scans() -> Scans:
    """A bumpy shape from five sides, sampled anew for each, each in a frame of its own."""
    return [in_frame(seen(bumpy(6000, i), i, 5), frame(i)) for i in range(5)]


@pytest.fixture(scope="module")
def merged(scans: Scans) -> upcr.Merged:
    return upcr.merge(scans)


def poses(found: upcr.Merged) -> list[Points]:
    """Of all scans, each of which has one."""
    told = [pose for pose in found.T_model_scan if pose is not None]
    assert len(told) == len(found.scans)
    return told


def same(a: upcr.Merged, b: upcr.Merged) -> bool:
    """Whether two results have the same bits, names aside."""

    def bits(found: upcr.Merged) -> list[typing.Any]:
        def plain(one: upcr.MergedScan | upcr.MergedPair) -> dict[str, typing.Any]:
            told = dataclasses.asdict(one)
            told.pop("name", None)
            return {name: value.tobytes() if isinstance(value, np.ndarray) else value for name, value in told.items()}

        return [found.voxel_size, found.inflation, *map(plain, found.scans), *map(plain, found.pairs)]

    return bits(a) == bits(b)


def write(folder: Path, scans: Scans) -> list[Path]:
    folder.mkdir(exist_ok=True)
    paths = [folder / f"{i}.npy" for i in range(len(scans))]
    for path, scan in zip(paths, scans, strict=True):
        np.save(path, scan)
    return paths


def test_scans_come_together(merged: upcr.Merged, scans: Scans) -> None:
    assert merged.is_whole and merged.models == [[0, 1, 2, 3, 4]]
    found = poses(merged)
    to_scene = np.linalg.inv(found[0] @ frame(0))
    for number, pose in enumerate(found):
        assert pose.shape == (4, 4) and pose.dtype == np.float64
        assert np.abs(to_scene @ pose @ frame(number) - np.eye(4)).max() < 0.05
    for number, scan in enumerate(merged.scans):
        assert scan.name == f"scan {number}" and scan.state == "placed" and scan.model == 0
        held = [pair for pair in merged.pairs if pair.kept and number in (pair.source, pair.target)]
        assert scan.pairs == len(held) > 0 and scan.reason is None
        assert np.isclose(scan.probability, 1 - np.prod([1 - pair.probability for pair in held]))
    assert merged.voxel_size > 0 and merged.inflation >= 1


def test_pairs_are_complete(merged: upcr.Merged, scans: Scans) -> None:
    numbers = [(pair.source, pair.target) for pair in merged.pairs]
    assert numbers == sorted(set(numbers)) and all(source > target for source, target in numbers)
    assert len(numbers) == 10
    found = poses(merged)
    for pair in merged.pairs:
        assert pair.T_target_source.shape == (4, 4) and pair.covariance.shape == (6, 6)
        assert pair.transformation is pair.T_target_source and 0 <= pair.probability <= 1 and 0 <= pair.fitness <= 1
        assert (pair.chi_sq is None) == (pair.contradicted or pair.probability < upcr.TRUSTWORTHY)
        if pair.kept:
            together = np.linalg.inv(found[pair.target]) @ found[pair.source]
            moved = [in_frame(scans[pair.source], pose) for pose in (together, pair.T_target_source)]
            assert np.abs(moved[0] - moved[1]).max() < 0.15


def test_fields_are_those_of_the_library(merged: upcr.Merged) -> None:
    def fields(kind: typing.Any) -> set[str]:
        return {field.name for field in dataclasses.fields(kind)}

    told = json.loads(merged._pairs)
    assert {name for pair in told for name in pair} == fields(upcr.MergedPair)
    proposals = {pair["proposal"] for pair in told}
    sequence = {pair.proposal for pair in upcr.merge([bumpy(500)] * 3, sequential=True).pairs}
    known = set(typing.get_args(typing.get_type_hints(upcr.MergedPair)["proposal"]))
    assert "likeness" in proposals and "sequence" in sequence and proposals | sequence <= known
    settings = {
        name for name, one in inspect.signature(upcr.merge).parameters.items() if one.kind == one.KEYWORD_ONLY
    } - {"neighbors", "sequential", "viewpoint", "progress"}
    # What is of use to a single pair only.
    assert settings == set(upcr.Settings.__annotations__) - {"init", "locks", "max_seconds"}


def test_the_same_answer_as_the_command(merged: upcr.Merged, scans: Scans, tmp_path: Path) -> None:
    folder = tmp_path / "scans"
    write(folder, scans)
    # Poses and notes beside scans are none.
    np.savetxt(folder / "pose.txt", frame(1))
    (folder / "notes.md").write_text("five sides")
    model, poses_file = tmp_path / "model.ply", tmp_path / "poses.json"
    options = ["-o", str(model), "--poses", str(poses_file), "--json"]
    command = [sys.executable, "-m", "upcr", "merge", str(folder), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    found = upcr.merge(folder)
    assert same(found, merged)

    told, written = json.loads(done.stdout), json.loads(poses_file.read_text())
    assert told["voxel_size"] == found.voxel_size and told["covariance_inflation"] == found.inflation
    assert [scan.name for scan in found.scans] == [scan["name"] for scan in told["models"][0]] == list(written)
    for scan, other in zip(found.scans, told["models"][0], strict=True):
        assert scan.T_model_scan is not None
        assert scan.T_model_scan.tolist() == other["T_model_scan"] == written[scan.name]
        assert (scan.pairs, scan.probability) == (other["pairs"], other["probability"])
    for pair, other in zip(found.pairs, told["pairs"], strict=True):
        for name, value in vars(pair).items():
            assert (value.tolist() if isinstance(value, np.ndarray) else value) == other[name], name
    assert np.array_equal(found.fuse().points, upcr.read(model).points)


def test_every_kind_of_scan(merged: upcr.Merged, scans: Scans, tmp_path: Path) -> None:
    class Holder:
        def __init__(self, points: Points) -> None:
            self.points = points

    files = write(tmp_path, scans)
    assert same(merged, upcr.merge(files)) and same(merged, upcr.merge(tmp_path)) and same(merged, upcr.merge(str(tmp_path)))
    mixed = upcr.merge(iter([files[0], scans[1].tolist(), upcr.PointCloud(scans[2]), str(files[3]), Holder(scans[4])]))
    assert same(merged, mixed)
    assert [scan.name for scan in mixed.scans] == ["0.npy", "scan 1", "scan 2", "3.npy", "scan 4"]


def test_threads_and_memory_change_nothing(merged: upcr.Merged, scans: Scans, tmp_path: Path) -> None:
    for threads in (1, 2, 5):
        assert same(merged, upcr.merge(scans, threads=threads))
    assert same(merged, upcr.merge(write(tmp_path, scans), max_memory_bytes=1))


def test_every_setting_arrives(merged: upcr.Merged, scans: Scans, tmp_path: Path) -> None:
    assert upcr.merge(scans, voxel_size=0.06).voxel_size == 0.06
    for neighbors, pairs in ((None, {10}), (1, {3, 4, 5})):
        heard: list[upcr.MergeProgress] = []
        upcr.merge(scans, neighbors=neighbors, progress=heard.append)
        assert next(one.of for one in heard if one.step == "register") in pairs
    others: list[dict[str, typing.Any]] = [
        {"method": "fgr"},
        {"feature": "spfh"},
        {"refine": "plane"},
        {"kernel": "huber"},
        {"overlap": 0.7},
    ]
    for given in others:
        assert not same(merged, upcr.merge(scans, **given)), given
    upcr.Model.default().save(tmp_path / "weights.safetensors")
    assert upcr.merge(scans[:2], method="upcr", network=tmp_path / "weights.safetensors").voxel_size > 0


def test_viewpoints(scans: Scans) -> None:
    sensor = np.array([4.0, 0, 0])
    views = [in_frame(seen(bumpy(6000, i), 0, 5), turned) for i, turned in enumerate([np.eye(4)] * 3)]
    told = upcr.merge(views, viewpoint=sensor)
    assert same(told, upcr.merge([upcr.PointCloud(view, viewpoint=sensor) for view in views]))
    # Scans that say it themselves win.
    assert same(told, upcr.merge([upcr.PointCloud(view, viewpoint=sensor) for view in views], viewpoint=(0, 0, 9)))


def test_scans_of_no_use_are_left_out_and_named(scans: Scans, tmp_path: Path) -> None:
    broken = tmp_path / "broken.ply"
    broken.write_text("ply\nformat ascii 1.0\nelement vertex 3\n")
    u, v = np.random.default_rng(0).uniform(size=(2, 4000))
    sheet = np.stack([u, v, 0.1 * np.sin(9 * u * u) + 0.2 * np.cos(6 * v) * u], 1)
    found = upcr.merge([*scans, np.zeros((5, 3)), broken, sheet])
    assert not found.is_whole and found.models == [[0, 1, 2, 3, 4]]
    equal, unreadable, foreign = found.scans[5:]
    assert equal.state == unreadable.state == "unusable" and foreign.state == "alone"
    assert equal.reason is not None and "equal" in equal.reason
    assert unreadable.name == "broken.ply" and unreadable.reason is not None and "not a valid PLY file" in unreadable.reason
    assert foreign.reason == "no pair with it is to be trusted"
    for scan in found.scans[5:]:
        assert scan.model is None and scan.T_model_scan is None and (scan.pairs, scan.probability) == (0, 0)
    assert found.T_model_scan[5:] == [None] * 3
    assert repr(found) == "<upcr.Merged: 5 of 8 scans in 1 model, 3 left out>"
    assert f"left out:\n  scan 5  {equal.reason}\n  broken.ply" in str(found)
    assert repr(foreign) == f"<upcr.MergedScan scan 7: left out, {foreign.reason}>"


def test_what_nothing_joins_stays_apart(scans: Scans) -> None:
    # The same, squeezed.
    others = [in_frame(bumpy(6000, 20 + i) * (0.7, 1.3, 1), frame(i)) for i in range(2)]
    found = upcr.merge([others[0], *scans, others[1]])
    assert found.models == [[1, 2, 3, 4, 5], [0, 6]] and not found.is_whole
    assert [scan.model for scan in found.scans] == [1, 0, 0, 0, 0, 0, 1]
    assert repr(found) == "<upcr.Merged: 7 of 7 scans in 2 models of 5, 2>"
    assert 1000 < len(found.fuse(1)) < len(np.concatenate(others))


def test_fuse(scans: Scans) -> None:
    clouds = [
        upcr.PointCloud(scan.copy(), colors=np.full((len(scan), 3), 40 * i, np.uint8)) for i, scan in enumerate(scans)
    ]
    found = upcr.merge(clouds)
    done: list[int] = []
    whole = found.fuse(progress=done.append)
    assert done == [0, 1, 2, 3, 4]
    assert whole.colors is not None and len(np.unique(whole.colors)) > 5
    cells = np.floor(whole.points / found.voxel_size)
    assert len(np.unique(cells, axis=0)) == len(whole)
    laid = np.concatenate([in_frame(scan, pose) for scan, pose in zip(scans, poses(found), strict=True)])
    assert np.allclose(whole.points.min(axis=0), laid.min(axis=0), atol=found.voxel_size)
    assert np.allclose(whole.points.max(axis=0), laid.max(axis=0), atol=found.voxel_size)
    assert len(found.fuse(thin=4 * found.voxel_size)) < len(whole) / 4
    # What becomes of the clouds afterwards changes nothing.
    for cloud in clouds:
        cloud.points[:] = 0
    assert np.array_equal(found.fuse().points, whole.points)
    for wrong in (1, -1):
        with pytest.raises(upcr.SettingError, match=f"setting `model`: there is no {wrong}"):
            found.fuse(wrong)
    for thin in (0, -1, np.nan):
        with pytest.raises(upcr.SettingError, match="setting `thin`: must be a positive length"):
            found.fuse(thin=thin)


def test_open3d(merged: upcr.Merged, scans: Scans) -> None:
    o3d: typing.Any = pytest.importorskip("open3d", reason="open3d cannot be imported", exc_type=ImportError)
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(scan)) for scan in scans]
    found = upcr.merge(clouds)
    assert same(found, merged)
    for cloud, pose in zip(clouds, poses(found), strict=True):
        cloud.transform(pose)
    assert np.array_equal(found.fuse().points, merged.fuse().points)


def test_a_file_that_is_gone(scans: Scans, tmp_path: Path) -> None:
    files = write(tmp_path, scans)
    found = upcr.merge(files)
    files[2].unlink()
    with pytest.raises(FileNotFoundError, match=r"2\.npy"):
        found.fuse()
    with pytest.raises(FileNotFoundError, match=r"2\.npy"):
        upcr.merge(files)


def test_results_pickle_and_copy(merged: upcr.Merged, scans: Scans, tmp_path: Path) -> None:
    files = upcr.merge([upcr.PointCloud(scans[0], colors=np.ones_like(scans[0])), *write(tmp_path, scans)[1:]])
    for found in (merged, files):
        for again in (pickle.loads(pickle.dumps(found)), copy.copy(found), copy.deepcopy(found)):
            assert same(found, again) and str(again) == str(found) and repr(again) == repr(found)
            cloud, other = found.fuse(), again.fuse()
            assert np.array_equal(cloud.points, other.points) and (cloud.colors is None) == (other.colors is None)


def test_results_print(merged: upcr.Merged) -> None:
    assert repr(merged) == "<upcr.Merged: 5 of 5 scans in 1 model>"
    assert str(merged).startswith("model 0: 5 scans\n  scan 0  ") and f"voxel size   {merged.voxel_size:.6g}" in str(merged)
    kept = sum(pair.kept for pair in merged.pairs)
    assert f"pairs        10 registered, {kept} kept" in str(merged)
    scan, pair = merged.scans[3], next(pair for pair in merged.pairs if pair.kept)
    assert repr(scan) == f"<upcr.MergedScan scan 3: model 0, {scan.pairs} pairs, probability {scan.probability:.3f}>"
    assert repr(pair).startswith(f"<upcr.MergedPair {pair.source} -> {pair.target}: kept, probability {pair.probability:.3f}")
    odd = dataclasses.replace(pair, kept=False, reasons=["low_overlap"])
    assert "at odds with the others" in repr(odd) and repr(odd).endswith(", reasons: low_overlap>")
    assert ": not kept, " in repr(dataclasses.replace(odd, chi_sq=None))
    assert ": contradicted, " in repr(dataclasses.replace(odd, chi_sq=None, contradicted=True))


def test_progress(merged: upcr.Merged, scans: Scans) -> None:
    heard: list[upcr.MergeProgress] = []
    assert same(merged, upcr.merge(scans, progress=heard.append))
    assert heard[0] == upcr.MergeProgress("describe", 0, 5)
    steps = [one.step for one in heard]
    assert steps == sorted(steps)
    assert set(steps) == set(typing.get_args(typing.get_type_hints(upcr.MergeProgress)["step"]))
    assert all(0 <= one.done <= one.of for one in heard)


@pytest.mark.parametrize("step", ["describe", "register"])
def test_what_progress_raises_ends_the_call(scans: Scans, step: str) -> None:
    class Enough(Exception):
        pass

    def stop(at: upcr.MergeProgress) -> None:
        if at.step == step:
            raise Enough

    with pytest.raises(Enough):
        upcr.merge(scans, progress=stop)


def test_other_threads_run_meanwhile(merged: upcr.Merged, scans: Scans) -> None:
    found: list[upcr.Merged] = []
    threads = [threading.Thread(target=lambda: found.append(upcr.merge(scans))) for _ in range(3)]
    for thread in threads:
        thread.start()
    registered = upcr.register(scans[0], scans[1])
    for thread in threads:
        thread.join()
    assert registered.is_trustworthy and len(found) == 3 and all(same(one, merged) for one in found)


@pytest.mark.parametrize(
    ("keywords", "error", "words"),
    [
        ({"method": "magic"}, upcr.SettingError, "setting `method`: there is no magic"),
        ({"voxel_size": -1}, upcr.SettingError, "setting `voxel_size`: must be a positive length, not -1"),
        ({"neighbors": -1}, upcr.SettingError, "setting `neighbors`"),
        ({"neighbors": "all"}, TypeError, "setting `neighbors`"),
        ({"sequential": "yes"}, TypeError, "setting `sequential`"),
        ({"max_memory_bytes": -1}, upcr.SettingError, "setting `max_memory_bytes`"),
        ({"threads": 0}, upcr.SettingError, "setting `threads`"),
        ({"viewpoint": (0, np.inf, 0)}, upcr.SettingError, "not finite"),
        ({"viewpoint": (0, 0)}, upcr.SettingError, "three coordinates"),
        ({"calibration": "nowhere.json"}, FileNotFoundError, "nowhere.json"),
        ({"init": np.eye(4)}, TypeError, "init"),
    ],
)
def test_settings_that_are_refused(
    scans: Scans, keywords: dict[str, typing.Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error) as caught:
        upcr.merge(scans, **keywords)
    assert words in str(caught.value)


def test_scans_that_are_refused(scans: Scans, tmp_path: Path) -> None:
    for few in ([], scans[:1], tmp_path):
        with pytest.raises(upcr.SettingError, match="setting `scans`: two are needed at least, not [01]"):
            upcr.merge(few)
    for one in (scans[0], upcr.PointCloud(scans[0])):
        with pytest.raises(TypeError, match="a folder or several clouds are needed, not one"):
            upcr.merge(one)  # type: ignore[arg-type]
    with pytest.raises(FileNotFoundError, match="nowhere"):
        upcr.merge("nowhere")
    with pytest.raises(upcr.CloudError, match=r"scan 1: an array of shape \(N, 3\) is needed"):
        upcr.merge([scans[0], scans[1].T])
    nothing: typing.Any = [scans[0], None]
    with pytest.raises(TypeError, match="scan 1: an array of numbers"):
        upcr.merge(nothing)
