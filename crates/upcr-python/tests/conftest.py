"""Data that the tests share: the sample pair, whose true pose is known."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import upcr

ROOT = Path(__file__).parents[3]
SAMPLES = ROOT / "samples"

Points = npt.NDArray[np.float64]


@pytest.fixture(scope="session")
def clouds() -> tuple[Points, Points]:
    source, target = upcr.read(SAMPLES / "source.ply"), upcr.read(SAMPLES / "target.ply")
    return source.points, target.points


@pytest.fixture(scope="session")
def truth() -> Points:
    return np.loadtxt(SAMPLES / "T_target_source.txt")


@pytest.fixture(scope="session")
def found(clouds: tuple[Points, Points]) -> upcr.Registration:
    return upcr.register(*clouds)


@pytest.fixture
def blob() -> Points:
    """A bumpy closed surface without symmetries."""
    return bumpy(1024)


def bumpy(points: int, seed: int = 0) -> Points:
    """Points of a bumpy closed surface without symmetries, of radius about 1."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(points, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    x, y, z = direction.T
    radius = 1 + 0.3 * np.sin(3 * x + 1) + 0.2 * np.cos(5 * y * z) + 0.25 * x * y - 0.2 * z
    surface: Points = direction * radius[:, None]
    return surface


def turn(degrees: float, axis: tuple[float, float, float] = (0.2, 0.5, 0.84)) -> Points:
    """The rotation by an angle about an axis (Rodrigues), shape (3, 3)."""
    a = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    angle = np.radians(degrees)
    rotation: Points = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return rotation
