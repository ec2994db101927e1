"""Registration: what goes in, what comes out."""

import copy
import dataclasses
import inspect
import multiprocessing
import pickle
import typing
from pathlib import Path

import numpy as np
import pytest
from conftest import SAMPLES, Points, bumpy, turn

import upcr
from upcr import _settings, _upcr

Clouds = tuple[Points, Points]


def same(a: upcr.Registration, b: upcr.Registration) -> bool:
    """Whether two results have the same bits, times aside."""
    return (
        a.T_target_source.tobytes() == b.T_target_source.tobytes()
        and a.covariance.tobytes() == b.covariance.tobytes()
        and (a.probability, a.fitness, a.inlier_rmse) == (b.probability, b.fitness, b.inlier_rmse)
        and a.evidence == b.evidence
        and (a.reasons, a.iterations, a.method) == (b.reasons, b.iterations, b.method)
    )


def test_arrays(found: upcr.Registration, clouds: Clouds, truth: Points) -> None:
    assert found.is_trustworthy and found.probability > 0.9
    assert found.transformation.shape == (4, 4) and found.transformation.dtype == np.float64
    assert np.abs(found.transformation - truth).max() < 0.02
    assert found.transformation is found.T_target_source
    assert found.covariance.shape == (6, 6) and (np.linalg.eigvalsh(found.covariance) > 0).all()
    assert 0.5 < found.fitness <= 1 and 0 < found.inlier_rmse < found.voxel_size
    assert found.points_used == tuple(map(len, clouds))
    assert found.converged and found.iterations > 0 and found.num_inliers > 100
    assert found.source_scale is None and found.free_directions == []
    assert found.timings_ms.total > found.timings_ms.refine > 0
    assert 0 < found.evidence.points <= min(map(len, clouds)) and len(found.evidence.overlap) == 2


def test_every_kind_of_cloud(found: upcr.Registration, clouds: Clouds) -> None:
    class Holder:
        def __init__(self, points: Points) -> None:
            self.points = points

    files = SAMPLES / "source.ply", SAMPLES / "target.ply"
    assert same(found, upcr.register(*files))
    assert same(found, upcr.register(str(files[0]), upcr.PointCloud(clouds[1])))
    assert same(found, upcr.register(Holder(clouds[0]), clouds[1].tolist()))


@pytest.mark.parametrize("dtype", ["float64", ">f8", "longdouble"])
@pytest.mark.parametrize("layout", ["C", "F", "strided", "reversed", "read-only", "unaligned"])
def test_layouts(found: upcr.Registration, clouds: Clouds, dtype: str, layout: str) -> None:
    def laid(points: Points) -> np.ndarray[typing.Any, typing.Any]:
        array = points.astype(dtype)
        if layout == "F":
            return np.asfortranarray(array)
        if layout == "strided":
            wide = np.zeros((2 * len(array), 5), array.dtype)
            wide[::2, 1:4] = array
            return wide[::2, 1:4]
        if layout == "reversed":
            return array[::-1].copy()[::-1]
        if layout == "read-only":
            array.flags.writeable = False
        if layout == "unaligned":
            room = np.zeros(array.nbytes + 1, np.uint8)
            view = room[1:].view(array.dtype).reshape(array.shape)
            view[:] = array
            return view
        return array

    assert same(found, upcr.register(laid(clouds[0]), laid(clouds[1])))


def test_single_and_half_precision(clouds: Clouds, truth: Points) -> None:
    for dtype, tolerance in ((np.float32, 0.02), (np.float16, 0.05)):
        moved = upcr.register(clouds[0].astype(dtype), clouds[1].astype(dtype))
        assert np.abs(moved.transformation - truth).max() < tolerance
    grid = np.unique((bumpy(4000) * 50).astype(np.int32), axis=0)
    assert upcr.register(grid, grid).is_trustworthy


def test_input_is_not_changed(clouds: Clouds) -> None:
    before = [cloud.copy() for cloud in clouds]
    upcr.register(*clouds)
    assert all(np.array_equal(a, b) for a, b in zip(before, clouds, strict=True))


def test_threads_and_repeats_give_the_same_bits(found: upcr.Registration, clouds: Clouds) -> None:
    for threads in (1, 2, 5):
        assert same(found, upcr.register(*clouds, threads=threads))
    # After a fork the child has no threads but the one that forked.
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert same(found, pool.apply(upcr.register, clouds))


def test_keywords_are_the_settings(found: upcr.Registration) -> None:
    keywords = {
        name for name, one in inspect.signature(upcr.register).parameters.items() if one.kind == one.KEYWORD_ONLY
    }
    assert keywords - {"source_viewpoint", "target_viewpoint", "progress"} == set(found.settings)
    assert set(upcr.Settings.__annotations__) == set(found.settings)
    choices = {
        "method": _settings.Method,
        "feature": _settings.Feature,
        "refine": _settings.Refinement,
        "kernel": _settings.Kernel,
    }
    for name, literal in choices.items():
        assert set(typing.get_args(literal)) == set(_upcr.CHOICES[name]), name


def test_every_setting_arrives(clouds: Clouds, truth: Points, tmp_path: Path) -> None:
    upcr.Model.default().save(tmp_path / "weights.safetensors")
    np.savetxt(tmp_path / "T.txt", truth)
    told = {
        "method": "prior",
        "network": tmp_path / "weights.safetensors",
        "feature": "spfh",
        "refine": "plane",
        "voxel_size": 0.05,
        "init": tmp_path / "T.txt",
        "kernel": "huber",
        "overlap": 0.8,
        "locks": ["roll", "z"],
        "seed": 2**63 + 7,
        "threads": 2,
        "max_seconds": 60,
        "max_memory_bytes": 2**33,
    }
    settings = upcr.register(*clouds, **told).settings  # type: ignore[arg-type]
    assert settings.pop("network") == upcr.Model.default().fingerprint
    assert settings.pop("calibration") is None
    assert np.abs(np.array(settings.pop("init")) - truth).max() < 1e-12
    assert {name for name, locked in settings.pop("locks").items() if locked} == {"roll", "z"}
    assert settings == {name: told[name] for name in settings}
    prior = upcr.register(*clouds, method="prior", init=truth, refine="none")
    assert np.abs(prior.transformation - truth).max() < 1e-12 and prior.method == "prior"
    assert upcr.register(*clouds, locks="x, y").settings["locks"]["y"]
    assert upcr.register(*clouds, network=upcr.Model.default()).settings["network"]


def test_viewpoints(clouds: Clouds) -> None:
    assert upcr.register(*clouds).evidence.in_free_space is None
    seen = upcr.register(*clouds, source_viewpoint=(0, 0, 5), target_viewpoint=np.array([0.0, 0, 5]))
    assert seen.evidence.in_free_space is not None
    held = [upcr.PointCloud(cloud, viewpoint=(0, 0, 5)) for cloud in clouds]
    assert same(seen, upcr.register(*held))


@pytest.mark.parametrize(
    ("keywords", "error", "words"),
    [
        ({"method": "magic"}, upcr.SettingError, "setting `method`: there is no magic; there are auto, "),
        ({"voxel_size": -1}, upcr.SettingError, "setting `voxel_size`: must be a positive length, not -1"),
        ({"voxel_size": "wide"}, TypeError, "setting `voxel_size`"),
        ({"seed": -1}, upcr.SettingError, "setting `seed`"),
        ({"threads": 0}, upcr.SettingError, "setting `threads`"),
        ({"init": np.eye(3)}, upcr.SettingError, "4x4"),
        ({"init": 2 * np.eye(4)}, upcr.SettingError, "setting `init`"),
        ({"init": np.full((4, 4), np.nan)}, upcr.SettingError, "NaN"),
        ({"locks": "roll,w"}, upcr.SettingError, "there is no axis w"),
        ({"source_viewpoint": (0, np.inf, 0)}, upcr.SettingError, "not finite"),
        ({"target_viewpoint": (0, 0)}, upcr.SettingError, "three coordinates"),
        ({"max_memory_bytes": 1}, upcr.SettingError, "needs at least"),
        ({"calibration": "nowhere.json"}, FileNotFoundError, "nowhere.json"),
        ({"network": "nowhere.safetensors"}, FileNotFoundError, "nowhere.safetensors"),
        ({"init": "nowhere.txt"}, FileNotFoundError, "nowhere.txt"),
        ({"init": b"abc"}, Exception, ""),
        ({"depth": 3}, TypeError, "depth"),
    ],
)
def test_settings_that_are_refused(
    clouds: Clouds, keywords: dict[str, typing.Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error) as caught:
        upcr.register(*clouds, **keywords)
    assert words in str(caught.value)


def test_clouds_that_are_refused(clouds: Clouds, tmp_path: Path) -> None:
    source, target = clouds
    holed = source.copy()
    holed[5, 1] = np.nan
    with pytest.raises(upcr.CloudError, match="source has NaN or infinite coordinates in 1 of its points.* 5"):
        upcr.register(holed, target)
    with pytest.raises(upcr.CloudError, match="target has too few points: 2"):
        upcr.register(source, target[:2])
    with pytest.raises(upcr.CloudError, match=r"(source|target): an array of shape \(N, 3\)"):
        upcr.register(source.T, target)
    with pytest.raises(TypeError, match="complex"):
        upcr.register(source.astype(complex), target)
    with pytest.raises(TypeError):
        upcr.register(None, target)  # type: ignore[arg-type]
    with pytest.raises(FileNotFoundError) as caught:
        upcr.register("nowhere.ply", target)
    assert caught.value.filename == "nowhere.ply" and caught.value.errno == 2
    with pytest.raises(IsADirectoryError):
        folder = tmp_path / "folder.ply"
        folder.mkdir()
        upcr.register(folder, target)
    few = tmp_path / "few.xyz"
    few.write_text("1 2 3\n")
    with pytest.raises(upcr.CloudError, match=r"few\.xyz: target has too few points"):
        upcr.register(source, few)
    with pytest.raises(upcr.FormatError, match="known format"):
        upcr.register("cloud.unknown", target)
    broken = tmp_path / "broken.ply"
    broken.write_text("ply\nformat ascii 1.0\nelement vertex 3\n")
    with pytest.raises(upcr.FormatError, match=r"broken\.ply: not a valid PLY file"):
        upcr.register(source, broken)


def test_errors_are_a_family() -> None:
    for error in (upcr.FormatError, upcr.CloudError, upcr.SettingError, upcr.WeightsError):
        assert issubclass(error, upcr.Error) and issubclass(error, ValueError)
        assert error.__module__ == "upcr" and error.__doc__
        again = pickle.loads(pickle.dumps(error("why")))
        assert type(again) is error and str(again) == "why"


def test_a_pose_that_is_not_trusted() -> None:
    plane, same_plane = (np.c_[np.random.default_rng(i).uniform(size=(2000, 2)), np.zeros(2000)] for i in range(2))
    found = upcr.register(plane, same_plane, method="prior")
    assert not found.is_trustworthy and "degenerate_axis" in found.reasons
    assert len(found.caveats) == len(found.reasons)
    kinds = [direction.motion for direction in found.free_directions]
    assert kinds == ["translation", "translation", "rotation"]
    turning = found.free_directions[2]
    assert np.allclose(np.abs(turning.axis), (0, 0, 1), atol=1e-6) and turning.point is not None
    assert str(turning).startswith("the pose is free to turn about")
    assert "not registered" in repr(found) and "degenerate_axis" in repr(found)

    moved = plane @ turn(30).T * 1000
    assert "scale_mismatch" in upcr.register(bumpy(1500), bumpy(1500) * 1000).reasons
    assert not upcr.register(same_plane, moved).is_trustworthy


def test_alternatives() -> None:
    def table(seed: int) -> Points:
        """A square plate with a skirt, whose four quarters look alike."""
        rng = np.random.default_rng(seed)
        top = np.c_[rng.uniform(-1, 1, (4000, 2)), np.zeros(4000)]
        side = np.c_[rng.uniform(-1, 1, 8000), np.ones(8000), rng.uniform(-0.5, 0, 8000)]
        return np.concatenate([top, *(side[k::4] @ turn(90 * k, (0, 0, 1)).T for k in range(4))])

    found = upcr.register(table(0), table(1))
    assert "ambiguous" in found.reasons and not found.is_trustworthy
    other = found.alternatives[0]
    assert other.transformation.shape == (4, 4) and 0.5 < other.relative_score <= 1.5
    assert "alternatives" in str(found)


def test_results_pickle_and_copy(found: upcr.Registration) -> None:
    for again in (pickle.loads(pickle.dumps(found)), copy.copy(found), copy.deepcopy(found)):
        assert same(found, again) and again.settings == found.settings
        assert str(again) == str(found) and again._repr_html_() == found._repr_html_()
    assert copy.deepcopy(found).T_target_source is not found.T_target_source
    assert dataclasses.replace(found, fitness=0.0).fitness == 0


def test_results_print(found: upcr.Registration) -> None:
    assert repr(found).startswith("<upcr.Registration: registered (probability ")
    assert f"fitness {found.fitness:.4f}" in repr(found)
    text = str(found)
    assert "T_target_source" in text and f"{found.T_target_source[0, 3]:.6f}" in text and "verdict" in text


def test_progress(clouds: Clouds, found: upcr.Registration) -> None:
    heard: list[upcr.Progress] = []
    assert same(found, upcr.register(*clouds, progress=heard.append))
    shares = [one.done for one in heard]
    assert shares == sorted(shares) and shares.count(1.0) == 1 and len(heard) > 5
    assert heard[0].stage == "prepare" and heard[0].method is None
    assert heard[-1].stage == "verify" and heard[-1].method is not None


def test_what_progress_raises_ends_the_call(clouds: Clouds) -> None:
    class Enough(Exception):
        pass

    calls = []

    def stop(at: upcr.Progress) -> None:
        calls.append(at)
        raise Enough

    with pytest.raises(Enough):
        upcr.register(*clouds, progress=stop)
    assert len(calls) == 1


def test_a_time_limit(clouds: Clouds) -> None:
    found = upcr.register(*clouds, max_seconds=0)
    assert "time_limit" in found.reasons and not found.is_trustworthy and not found.converged


def test_batch(clouds: Clouds, found: upcr.Registration, truth: Points) -> None:
    source, target = clouds
    pairs: list[typing.Any] = [
        (source, target),
        (SAMPLES / "source.ply", target),
        (source, target[:2]),
        (source, "nowhere.ply"),
        [source, target, truth],
    ]
    for threads in (None, 1, 2, 11):
        done: list[int] = []
        results = upcr.register_batch(iter(pairs), errors="return", progress=done.append, threads=threads)
        assert done == [1, 2, 3, 4, 5]
        for one in results[:2]:
            assert isinstance(one, upcr.Registration) and same(one, found)
            assert one.settings["threads"] == threads
        assert isinstance(results[2], upcr.CloudError) and isinstance(results[3], FileNotFoundError)
        guessed = results[4]
        assert isinstance(guessed, upcr.Registration) and guessed.method == "prior"
    with pytest.raises(upcr.CloudError, match="too few points"):
        upcr.register_batch(pairs)
    assert upcr.register_batch([]) == []
    few = upcr.register_batch(pairs[:1], method="fgr", seed=3)
    assert few[0].settings["method"] == "fgr" and few[0].settings["seed"] == 3
    with pytest.raises(upcr.SettingError):
        upcr.register_batch(pairs[:1], errors="ignore")  # type: ignore[call-overload]


def test_errors_of_a_batch_tell_the_pair(clouds: tuple[Points, Points]) -> None:
    source, target = clouds
    few = [(source, source), (source, target[:2])]
    with pytest.raises(upcr.CloudError, match="target has too few points: 2") as caught:
        upcr.register_batch(few)
    assert getattr(caught.value, "__notes__", ["pair 1"]) == ["pair 1"]
    wrong: list[typing.Any] = [(source, target), ({}, target)]
    with pytest.raises(TypeError, match=r"pair 1: source: an array of numbers.* is needed, not dict"):
        upcr.register_batch(wrong)
    strange: typing.Any
    for strange in [(source,), 5, (source, target, None, 1)]:
        with pytest.raises(TypeError, match="pair 0: a source, a target"):
            upcr.register_batch([strange], errors="return")
    wrong = [(source, None), few[1], (source, source)]
    refused = upcr.register_batch(wrong, errors="return")
    assert [type(one) for one in refused] == [TypeError, upcr.CloudError, upcr.Registration]


def test_what_files_may_leave_out_arrays_may_too(clouds: tuple[Points, Points], truth: Points) -> None:
    found = [upcr.register(*clouds, init=init, method="prior") for init in (truth, truth[:3])]
    assert np.array_equal(found[0].transformation, found[1].transformation)
    with pytest.raises(upcr.CloudError, match="source: some entries are masked"):
        upcr.register(np.ma.masked_array(clouds[0], clouds[0] > 0.05), clouds[1])
    with pytest.raises(upcr.SettingError, match="three coordinates are needed, not '0,0,0'"):
        upcr.register(*clouds, source_viewpoint="0,0,0")
