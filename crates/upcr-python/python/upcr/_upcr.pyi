"""The native half."""

from collections.abc import Callable, Sequence
from typing import Any, Final, TypeAlias, final

import numpy as np
import numpy.typing as npt

_Floats: TypeAlias = npt.NDArray[np.float64]
_Arrays: TypeAlias = tuple[
    _Floats, npt.NDArray[np.float32] | None, npt.NDArray[np.uint8] | None, tuple[float, float, float] | None
]
_Packed: TypeAlias = str | _Arrays
_Parts: TypeAlias = tuple[dict[str, Any], str, _Floats, _Floats]
_Place: TypeAlias = tuple[float, float, float] | None

__all__ = [
    "CHOICES",
    "DEFAULT_K",
    "TRUSTWORTHY",
    "CloudError",
    "Error",
    "FormatError",
    "Model",
    "Scans",
    "SettingError",
    "WeightsError",
    "__version__",
    "adapt",
    "check",
    "describe",
    "main",
    "merge",
    "read",
    "register",
    "register_batch",
    "scans_in",
    "write",
]

CHOICES: Final[dict[str, list[str]]]
DEFAULT_K: Final[int]
TRUSTWORTHY: Final[float]
__version__: Final[str]

class Error(ValueError):
    """Anything that the library refuses. A file that cannot be opened is an OSError, such as FileNotFoundError."""

class FormatError(Error):
    """A file is not what its format demands, its format is not known, or cannot hold what is to be written."""

class CloudError(Error):
    """A cloud has too few points, some that are not finite, or no surface."""

class SettingError(Error):
    """A setting is out of its range, or no such choice."""

class WeightsError(Error):
    """Weights are not a network's, or learning has lost its way."""

@final
class Model:
    @staticmethod
    def default() -> Model: ...
    @staticmethod
    def load(path: str) -> Model: ...
    @staticmethod
    def from_bytes(weights: bytes) -> Model: ...
    def to_bytes(self) -> bytes: ...
    def save(self, path: str) -> None: ...
    def predict(self, source: npt.NDArray[np.float32], target: npt.NDArray[np.float32]) -> _Floats: ...
    @property
    def fingerprint(self) -> str: ...
    @property
    def is_trained(self) -> bool: ...
    @property
    def config(self) -> dict[str, Any]: ...

def register(
    source: _Packed,
    target: _Packed,
    given: dict[str, Any],
    source_viewpoint: _Place,
    target_viewpoint: _Place,
    progress: Callable[[Any, Any, Any], object] | None,
) -> _Parts: ...
def register_batch(
    clouds: Sequence[_Packed],
    pairs: Sequence[tuple[int, int, int, _Floats | str | None]],
    given: dict[str, Any],
    raises: bool,
    progress: Callable[[int], object] | None,
) -> list[_Parts | Exception]: ...

@final
class Scans:
    def __new__(cls, scans: Sequence[_Packed], viewpoint: _Place) -> Scans: ...
    @property
    def names(self) -> list[str]: ...
    def fuse(
        self,
        poses: Sequence[tuple[int, Sequence[Sequence[float]]]],
        thin: float,
        progress: Callable[[int], object] | None,
    ) -> _Arrays: ...

def merge(
    scans: Scans, given: dict[str, Any], progress: Callable[[Any, Any, Any], object] | None
) -> tuple[dict[str, Any], str]: ...
def scans_in(folder: str) -> list[str]: ...
def check(given: dict[str, Any]) -> None: ...
def describe(
    cloud: _Packed, kind: str, k: int, radius: float | None, threads: int | None
) -> npt.NDArray[np.float32]: ...
def read(path: str, options: dict[str, Any]) -> _Arrays: ...
def write(path: str, cloud: _Packed, encoding: str | None) -> None: ...
def adapt(
    clouds: str | list[_Packed],
    weights: Model,
    folder: str,
    options: dict[str, Any],
    progress: Callable[[dict[str, Any]], object] | None,
    member: dict[str, Any] | None,
) -> dict[str, Any]: ...
def main(args: Sequence[str]) -> int: ...
