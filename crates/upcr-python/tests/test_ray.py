"""Many pairs and adaptation on a local Ray cluster of two workers: the same as in one process."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import SAMPLES, Points, bumpy, turn

import upcr

ray = pytest.importorskip("ray")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

import upcr.ray  # noqa: E402  # needs Ray

TIMES = [name for name in upcr.ray.SCHEMA.names if name.endswith("_ms")]


@pytest.fixture(scope="module", autouse=True)
def cluster() -> Iterator[None]:
    # One processor for reading and writing beside two workers'.
    ray.init(num_cpus=3, include_dashboard=False, log_to_driver=False)
    ray.data.DataContext.get_current().enable_progress_bars = False
    yield
    ray.shutdown()


def moved(points: Points, i: int) -> Points:
    shifted: Points = points @ turn(10 + i).T + [0.1, -0.2, 0.05 * i]
    return shifted


def table(count: int) -> Any:
    """Pairs of points in three layouts of their own: rows of rows, and one whose source is missing."""
    points = pa.list_(pa.list_(pa.float64(), 3))
    clouds = [bumpy(200, i) for i in range(count)]
    sources: list[Any] = [cloud.tolist() for cloud in clouds]
    if count > 3:
        sources[3] = None
    return pa.table(
        {
            "id": pa.array(range(count)),
            "source": pa.array(sources, points),
            "target": pa.array([moved(cloud, i).tolist() for i, cloud in enumerate(clouds)], points),
        }
    )


def test_a_row_is_what_register_finds() -> None:
    rows = upcr.ray.Registrar(seed=3)(table(5)).to_pylist()
    assert [row["id"] for row in rows] == list(range(5))
    assert set(rows[0]) == {"id", *upcr.ray.SCHEMA.names}, "clouds are not kept"
    for i, row in enumerate(rows):
        if i == 3:
            assert "source: there is no cloud" in row["error"] and row["probability"] is None
            continue
        found = upcr.register(bumpy(200, i), moved(bumpy(200, i), i), seed=3)
        assert row["error"] is None
        assert np.array_equal(np.array(row["T_target_source"]).reshape(4, 4), found.T_target_source)
        assert np.array_equal(np.array(row["covariance"]).reshape(6, 6), found.covariance)
        assert row["probability"] == found.probability and row["is_trustworthy"] == found.is_trustworthy
        assert row["reasons"] == found.reasons and row["method"] == found.method
        assert row["total_ms"] >= row["prepare_ms"] > 0


def test_layouts_of_columns(tmp_path: Path) -> None:
    source, target = bumpy(200), moved(bumpy(200), 0)
    upcr.write(tmp_path / "s.ply", source)
    upcr.write(tmp_path / "t.ply", target)
    guess = np.eye(4)
    guess[:3, :3] = turn(9)
    flat = pa.table(
        {
            "source": pa.array([source.ravel()]),
            "target": pa.array([target.ravel()]),
            "init": pa.array([guess.ravel()]),
        }
    )
    files = pa.table(
        {
            "a": [str(tmp_path / "s.ply"), (tmp_path / "s.ply").as_uri(), str(tmp_path / "none.ply")],
            "b": [str(tmp_path / "t.ply")] * 3,
            "a_viewpoint": [None, [0.0, 0.0, 5.0], None],
        }
    )
    by_prior = upcr.register(source, target, init=guess, method="prior")
    row = upcr.ray.Registrar(method="prior")(flat).to_pylist()[0]
    assert np.array_equal(np.array(row["T_target_source"]).reshape(4, 4), by_prior.T_target_source)
    assert row["init"] == guess.ravel().tolist() and not {"source", "target"} & set(row)
    rows = upcr.ray.Registrar(source="a", target="b")(files).to_pylist()
    assert [row["error"] is None for row in rows] == [True, True, False]
    assert "none.ply" in rows[2]["error"] and rows[0]["a"] == str(tmp_path / "s.ply")
    seen = upcr.register(tmp_path / "s.ply", tmp_path / "t.ply", source_viewpoint=(0, 0, 5))
    assert rows[1]["probability"] == seen.probability

    tensors = ray.data.from_numpy([np.stack([source, source])]).rename_columns({"data": "source"})
    tensors = tensors.map_batches(lambda batch: batch | {"target": batch["source"] + 1.0}, num_cpus=0.5)
    found = upcr.ray.register_pairs(tensors, workers=1).take_all()
    assert np.allclose([np.reshape(row["T_target_source"], (4, 4))[:3, 3] for row in found], 1.0, atol=1e-6)


def test_what_is_wrong_is_said() -> None:
    pairs = table(1)
    dataset = ray.data.from_arrow(pairs)
    with pytest.warns(UserWarning, match="need 4 processors, and there are 3: unless the cluster grows, they wait for ever"):
        upcr.ray.register_pairs(dataset, workers=3)
    with pytest.warns(UserWarning, match="need 4 processors"):
        upcr.ray.register_pairs(dataset, cpus_per_worker=3)
    with pytest.raises(upcr.SettingError, match="no column scan; there are id, source, target"):
        upcr.ray.register_pairs(dataset, source="scan")
    with pytest.raises(upcr.SettingError, match="rename"):
        upcr.ray.Registrar()(pairs.append_column("error", pa.array([""])))
    with pytest.raises(upcr.SettingError, match="cpus_per_worker"):
        upcr.ray.register_pairs(dataset, threads=2)
    with pytest.raises(upcr.SettingError, match="colour"):
        upcr.ray.register_pairs(dataset, method="colour")  # type: ignore[arg-type]
    with pytest.raises(upcr.SettingError, match="voxel_size"):
        upcr.ray.register_pairs(dataset, voxel_size=-1)
    with pytest.raises(upcr.SettingError, match="`workers`: must be 1 at least, not 0"):
        upcr.ray.register_pairs(dataset, workers=0)
    no_dataset: Any = ["a.ply"]
    for function in (upcr.ray.register_pairs, upcr.ray.adapt):
        with pytest.raises(TypeError, match="a Ray dataset is needed"):
            function(no_dataset)
    with pytest.raises(upcr.SettingError, match="no column cloud; there are id, source, target"):
        upcr.ray.adapt(dataset)


def test_lists_of_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("source.ply", "target.ply"):
        (tmp_path / name).write_bytes((SAMPLES / name).read_bytes())
    Path("guess.txt").write_text("\n".join(" ".join(map(str, row)) for row in np.eye(4)))
    Path("pairs.txt").write_text("# two pairs\nsource.ply target.ply\n\ntarget.ply\tsource.ply\tguess.txt\n")
    rows = sorted(upcr.ray.read_pairs("pairs.txt").take_all(), key=lambda row: row["id"])
    assert [row["source"] for row in rows] == [str(tmp_path / "source.ply"), str(tmp_path / "target.ply")]
    assert [row["init"] for row in rows] == [None, str(tmp_path / "guess.txt")]
    found = upcr.ray.register_pairs(upcr.ray.read_pairs("pairs.txt"), workers=2).take_all()
    assert sorted(row["is_trustworthy"] for row in found) == [True, True]
    Path("bad.txt").write_text("source.ply\n")
    with pytest.raises(upcr.FormatError, match=r"bad.txt: line 1: not two or three columns"):
        upcr.ray.read_pairs("bad.txt")
    Path("empty.txt").write_text("# none\n")
    assert upcr.ray.read_pairs("empty.txt").count() == 0


def processes(kind: str) -> list[int]:
    """Ray's processes with this in their titles."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            title = (process / "cmdline").read_text()
        except OSError:
            continue
        if title.startswith("ray::") and kind in title:
            found.append(int(process.name))
    return found


def test_a_killed_worker_loses_and_doubles_nothing(tmp_path: Path) -> None:
    count = 240
    pairs = table(count)
    for i in range(0, count, 20):
        pq.write_table(pairs.slice(i, 20), tmp_path / f"pairs-{i:03}.parquet")
    (tmp_path / "in").mkdir()
    for file in tmp_path.glob("*.parquet"):
        file.rename(tmp_path / "in" / file.name)
    before = set(processes("Registrar"))
    killed = []

    def kill() -> None:
        while len(list((tmp_path / "out").glob("*.parquet"))) < 3:
            time.sleep(0.01)
        victim = min(set(processes("Registrar")) - before)
        os.kill(victim, signal.SIGKILL)
        killed.append(victim)

    killer = threading.Thread(target=kill, daemon=True)
    found = upcr.ray.register_pairs(upcr.ray.read_pairs(tmp_path / "in"), workers=2, batch_size=10)
    killer.start()
    found.write_parquet(str(tmp_path / "out"))
    assert len(killed) == 1
    rows = pq.read_table(tmp_path / "out").sort_by("id").drop_columns(TIMES)
    assert rows.equals(upcr.ray.Registrar()(pairs).drop_columns(TIMES).select(rows.column_names))


def test_adaptation_is_that_of_one_machine(tmp_path: Path) -> None:
    clouds = [bumpy(300, i) for i in range(7)]
    settings: dict[str, Any] = {"epochs": 6, "points": 64, "seed": 5}
    alone = upcr.adapt(clouds, parts=3, **settings)
    dataset = ray.data.from_items([{"cloud": cloud} for cloud in clouds], override_num_blocks=2)
    together = upcr.ray.adapt(dataset, parts=3, workers=2, storage_path=str(tmp_path), **settings)
    assert together.model.to_bytes() == alone.model.to_bytes()
    assert (together.before, together.after) == (alone.before, alone.after)
    assert together.steps == alone.steps == 6
    whole = upcr.adapt(clouds, **settings)
    assert whole.model.to_bytes() != alone.model.to_bytes(), "parts normalise themselves"
    files = ray.data.from_items([{"cloud": str(tmp_path / f"{i}.ply")} for i in range(3)])
    for i in range(2):
        upcr.write(tmp_path / f"{i}.ply", clouds[i])
    with pytest.raises(FileNotFoundError, match=r"2\.ply"):
        upcr.ray.adapt(files, storage_path=str(tmp_path), **settings)
    with pytest.raises(upcr.SettingError, match="8 parts"):
        upcr.ray.adapt(dataset, parts=8)
    with pytest.raises(upcr.SettingError, match="3 workers"):
        upcr.ray.adapt(dataset, parts=2, workers=3)


def test_learning_goes_on_where_a_worker_died(tmp_path: Path) -> None:
    clouds = [bumpy(300, i) for i in range(7)]
    settings: dict[str, Any] = {"epochs": 150, "points": 128, "seed": 5}
    dataset = ray.data.from_items([{"cloud": cloud} for cloud in clouds])
    before = set(processes("RayTrainWorker"))
    killed = []

    def kill() -> None:
        while not list(tmp_path.glob("run/checkpoint*/checkpoint.safetensors")):
            time.sleep(0.01)
        victim = max(set(processes("RayTrainWorker")) - before)
        os.kill(victim, signal.SIGKILL)
        killed.append(victim)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    together = upcr.ray.adapt(
        dataset, workers=2, name="run", storage_path=str(tmp_path), checkpoint_seconds=1.5, **settings
    )
    alone = upcr.adapt(clouds, parts=2, **settings)
    assert len(killed) == 1
    assert together.model.to_bytes() == alone.model.to_bytes()
    assert together.helped == alone.helped and together.after == alone.after
