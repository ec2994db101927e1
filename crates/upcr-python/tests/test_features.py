"""Descriptors."""

import numpy as np
import pytest
from conftest import Points, turn

import upcr
from upcr import _upcr, features


@pytest.mark.parametrize(("name", "dim"), [("distance", 72), ("ppf", 96), ("spfh", 33), ("pfh", 125), ("fpfh", 33)])
def test_shapes_and_invariance(blob: Points, name: str, dim: int) -> None:
    describe = getattr(features, name)
    rows = describe(blob)
    assert rows.shape == (1024, dim) and rows.dtype == np.float32 and np.isfinite(rows).all()
    assert np.array_equal(rows, describe(blob, k=24, threads=1))
    near = np.abs(rows - describe(blob @ turn(70).T + 5)).max(axis=1)
    # Points whose neighbours or bins rounding changes are few.
    assert np.median(near) < 1e-3 * np.abs(rows).max()
    assert describe(blob, 8).shape[0] == 1024 and not np.array_equal(describe(blob, radius=0.3), rows)


def test_histograms_are_histograms(blob: Points) -> None:
    assert np.allclose(features.pfh(blob).sum(axis=1), 100, atol=1e-2)
    assert np.allclose(features.spfh(blob).sum(axis=1), 300, atol=1e-2)


def test_own_normals_are_used(blob: Points) -> None:
    normals = blob / np.linalg.norm(blob, axis=1, keepdims=True)
    assert not np.array_equal(features.pfh(upcr.PointCloud(blob, normals)), features.pfh(blob))
    assert np.array_equal(features.distance(upcr.PointCloud(blob, normals)), features.distance(blob))


def test_what_is_refused(blob: Points) -> None:
    with pytest.raises(upcr.SettingError, match="`k`: at least 3"):
        features.fpfh(blob, k=2)
    with pytest.raises(upcr.SettingError, match="`radius`"):
        features.fpfh(blob, radius=-1.0)
    with pytest.raises(upcr.CloudError, match="cloud has too few points"):
        features.fpfh(blob[:2])
    with pytest.raises(upcr.SettingError, match="there is no shot; there are distance, ppf, spfh, pfh, fpfh"):
        _upcr.describe((blob, None, None, None), "shot", 24, None, None)
