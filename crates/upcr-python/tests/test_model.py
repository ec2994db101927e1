"""The network, and its adaptation."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from conftest import SAMPLES, Points, bumpy, turn

import upcr
from upcr._adapt import Pairs
from upcr._upcr import CHOICES


def test_prediction(blob: Points) -> None:
    model = upcr.Model.default()
    shape = (blob - blob.mean(axis=0)) / np.linalg.norm(blob - blob.mean(axis=0), axis=1).max()
    moved = shape @ turn(25).T + (0.1, 0.2, -0.1)
    # A pose about the canonical shape for each cloud: a cloud lies on itself, and what leads there leads back.
    assert np.allclose(model.predict(shape, shape), np.eye(4), atol=1e-6)
    there, back = model.predict(shape.astype(np.float32), moved), model.predict(moved, shape)
    assert there.shape == (4, 4) and there.dtype == np.float64
    assert np.allclose(there[:3, :3] @ there[:3, :3].T, np.eye(3), atol=1e-6)
    assert np.allclose(there @ back, np.eye(4), atol=1e-5) and not np.allclose(there, np.eye(4), atol=0.05)
    assert model.predict(SAMPLES / "source.ply", SAMPLES / "target.ply").shape == (4, 4)
    with pytest.raises(upcr.CloudError, match="source has too few points"):
        model.predict(np.zeros((0, 3)), shape)
    with pytest.raises(upcr.CloudError, match="target has NaN"):
        model.predict(shape, np.full((5, 3), np.nan))


def test_models_come_and_go(tmp_path: Path) -> None:
    model = upcr.Model.default()
    assert model.is_trained and model.config["k"] > 0 and model.fingerprint in repr(model)
    model.save(tmp_path / "a.safetensors")
    for again in (
        upcr.Model.load(tmp_path / "a.safetensors"),
        upcr.Model.from_bytes(model.to_bytes()),
        pickle.loads(pickle.dumps(model)),
    ):
        assert again == model and hash(again) == hash(model) and again.to_bytes() == model.to_bytes()
    with pytest.raises(FileNotFoundError):
        upcr.Model.load(tmp_path / "none.safetensors")
    (tmp_path / "b.safetensors").write_bytes(b"no weights")
    with pytest.raises(upcr.FormatError, match=r"b\.safetensors"):
        upcr.Model.load(tmp_path / "b.safetensors")
    with pytest.raises(upcr.WeightsError):
        upcr.Model.from_bytes(b"no weights")


@pytest.fixture(scope="module")
def shapes() -> list[Points]:
    return [bumpy(400, seed) * (1, 1 + 0.1 * seed, 1) for seed in range(3)]


def test_adaptation(shapes: list[Points], tmp_path: Path) -> None:
    heard: list[upcr.AdaptationProgress] = []
    options = {"epochs": 2, "points": 128, "seed": 5}
    done = upcr.adapt(shapes, folder=tmp_path / "run", progress=heard.append, **options)  # type: ignore[arg-type]
    assert done.steps == 2 and heard and heard[-1].step == heard[-1].steps == 2
    assert done.helped == (done.after.loss < done.before.loss) == (done.model != upcr.Model.default())
    assert (tmp_path / "run" / "checkpoint.safetensors").exists()
    # The same from files, whatever the number of threads.
    for i, shape in enumerate(shapes):
        upcr.write(tmp_path / f"{i}.npy", shape)
    again = upcr.adapt(tmp_path, upcr.Model.default(), threads=1, **options)  # type: ignore[arg-type]
    assert again.before == done.before and again.after == done.after and again.model == done.model
    upcr.register(shapes[0], shapes[0], method="upcr", network=done.model)


def test_a_folder_is_gone_on_with_where_all_is_the_same(shapes: list[Points], tmp_path: Path) -> None:
    def learn(shapes: list[Points], folder: Path, weights: upcr.Model | None = None) -> tuple[upcr.Model, bytes]:
        """What is learned, whether or not it helped, and what it makes of two clouds."""
        upcr.adapt(shapes, weights, folder=folder, epochs=1, points=64, learning_rate=1e-3)
        model = upcr.Model.load(folder / "checkpoint.safetensors")
        return model, model.predict(bumpy(100, 1), bumpy(100, 2)).tobytes()

    model, first = learn(shapes, tmp_path / "run")
    assert learn(shapes, tmp_path / "run")[1] == first, "it was at its end"
    others = shapes[::-1]
    assert learn(others, tmp_path / "run")[1] == learn(others, tmp_path / "new")[1] != first
    assert learn(others, tmp_path / "run", model)[1] == learn(others, tmp_path / "third", model)[1] != first


def test_what_adaptation_refuses(shapes: list[Points], tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        upcr.adapt(tmp_path / "none")
    with pytest.raises(upcr.FormatError, match="no known data set"):
        upcr.adapt(tmp_path)
    with pytest.raises(upcr.SettingError, match="`epochs`"):
        upcr.adapt(shapes, epochs=0)
    with pytest.raises(upcr.SettingError, match="`pairs`: there is no odd"):
        upcr.adapt(shapes, pairs="odd")  # type: ignore[arg-type]
    with pytest.raises(upcr.CloudError, match="degenerate"):
        upcr.adapt([np.zeros((50, 3))])
    with pytest.raises(TypeError, match="several clouds are needed, not one"):
        upcr.adapt(shapes[0])
    with pytest.raises(upcr.SettingError, match="3 clouds make no 4 parts"):
        upcr.adapt(shapes, parts=4)
    with pytest.raises(upcr.SettingError, match="0 clouds make no 1 part"):
        upcr.adapt([])


def test_pairs_are_the_command_line_s() -> None:
    assert set(Pairs.__args__) == set(CHOICES["pairs"])  # type: ignore[attr-defined]
