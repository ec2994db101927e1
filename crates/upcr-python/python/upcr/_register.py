"""Registration of one pair, and of many."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy.typing as npt

from . import _settings, _upcr
from ._cloud import CloudLike, packed, place
from ._model import Model
from ._registration import Registration, registration
from ._settings import Feature, Kernel, Method, Refinement, Settings

if TYPE_CHECKING:
    from typing_extensions import Unpack

    Pair = tuple[CloudLike, CloudLike] | tuple[CloudLike, CloudLike, npt.ArrayLike | str | os.PathLike[str] | None]


@dataclass(frozen=True)
class Progress:
    """How far a registration is."""

    stage: Literal["prepare", "hypotheses", "refine", "verify"]
    """The step under way."""
    method: str | None
    """The source of first poses that it works for; None while the clouds are prepared."""
    done: float
    """Share of the longest way that the registration may take, 0 to 1. It never falls, and is 1 once, at the end."""


def register(
    source: CloudLike,
    target: CloudLike,
    *,
    method: Method | None = None,
    network: Model | str | os.PathLike[str] | None = None,
    feature: Feature | None = None,
    refine: Refinement | None = None,
    voxel_size: float | None = None,
    init: npt.ArrayLike | str | os.PathLike[str] | None = None,
    kernel: Kernel | None = None,
    overlap: float | None = None,
    locks: str | Iterable[str] | None = None,
    calibration: str | os.PathLike[str] | None = None,
    seed: int | None = None,
    threads: int | None = None,
    max_seconds: float | None = None,
    max_memory_bytes: int | None = None,
    source_viewpoint: npt.ArrayLike | None = None,
    target_viewpoint: npt.ArrayLike | None = None,
    progress: Callable[[Progress], object] | None = None,
) -> Registration:
    """Finds the pose that lays ``source`` on ``target``.

    Clouds that cannot be registered are no error: the result says so (``is_trustworthy``, ``reasons``). Ctrl-C ends the
    call. Other Python threads run meanwhile.

    Args:
        source: The cloud that is moved: an array of shape (N, 3), a file's name, or an object with ``points``.
        target: The cloud that stays.
        method: Where the first pose comes from: ``auto``, ``features``, ``prior`` (``init`` alone), ``upcr`` (the
            network), ``consensus``, ``fgr`` or ``ransac``.
        network: The network that is asked, or its weights file; else the one in the package.
        feature: The feature that is matched: ``fpfh``, ``spfh`` or ``pfh``.
        refine: What the refinement minimises: ``gicp``, ``plane``, ``point`` or ``none``.
        voxel_size: The one scale that drives every radius, in the clouds' unit; else derived from the clouds.
        init: A first guess of the pose, shape (4, 4), source to target, or a text file with one.
        kernel: How residuals are weighed: ``none``, ``huber``, ``cauchy``, ``geman_mcclure`` or ``tukey``.
        overlap: Share of the closest pairs that the refinement keeps, 0 to 1; else all within reach.
        locks: Degrees of freedom that keep their value in the first guess, such as ``"roll,pitch,z"``.
        calibration: What the evidence for a pose weighs: a file of ``upcr calibrate``.
        seed: Seed of every random choice.
        threads: Threads to use; else all. The result does not depend on it.
        max_seconds: Seconds after which the call ends with the best pose so far.
        max_memory_bytes: Bytes that the call may take beside its clouds; where it needs more, the clouds are thinned.
        source_viewpoint: Where the sensor stood that saw the source, shape (3,), in the source's frame and unit.
        target_viewpoint: Where the one stood that saw the target.
        progress: Called some tens of times, in order, on this thread. What it raises ends the call.

    Raises:
        CloudError: A cloud is too small, degenerate or not finite.
        SettingError: A setting is out of its range.
        OSError: A file cannot be read; FileNotFoundError where there is none.
        FormatError: A file is not what its format demands.
    """
    settings = {
        "method": method,
        "network": network,
        "feature": feature,
        "refine": refine,
        "voxel_size": voxel_size,
        "init": init,
        "kernel": kernel,
        "overlap": overlap,
        "locks": locks,
        "calibration": calibration,
        "seed": seed,
        "threads": threads,
        "max_seconds": max_seconds,
        "max_memory_bytes": max_memory_bytes,
    }
    hear = None if progress is None else lambda stage, method, done: progress(Progress(stage, method, done))
    found = _upcr.register(
        packed(source, "source"),
        packed(target, "target"),
        _settings.packed(settings),
        place(source_viewpoint),
        place(target_viewpoint),
        hear,
    )
    return registration(found)


@overload
def register_batch(
    pairs: Iterable[Pair],
    *,
    errors: Literal["raise"] = "raise",
    progress: Callable[[int], object] | None = None,
    **settings: Unpack[Settings],
) -> list[Registration]: ...
@overload
def register_batch(
    pairs: Iterable[Pair],
    *,
    errors: Literal["return"],
    progress: Callable[[int], object] | None = None,
    **settings: Unpack[Settings],
) -> list[Registration | Exception]: ...
def register_batch(
    pairs: Iterable[Pair],
    *,
    errors: Literal["raise", "return"] = "raise",
    progress: Callable[[int], object] | None = None,
    **settings: Unpack[Settings],
) -> Any:
    """Registers many pairs, several at a time; each result is what ``register`` finds.

    Args:
        pairs: Each a source and a target, as ``register`` takes them, and, if there is one, a first guess of the pose.
            A cloud that is part of several pairs is copied once. Where its sensor stood, a :class:`PointCloud` says.
        errors: ``raise`` the exception of the first pair that has one, with a note of its number, from 0, or ``return`` it in the pair's place.
        progress: Called with the number of pairs done, in whatever order they are.
        **settings: As for ``register``, for every pair; ``threads`` are those of all pairs together, ``max_seconds`` and
            ``max_memory_bytes`` each pair's.

    Returns:
        Results, or exceptions, in the pairs' order.
    """
    if errors not in ("raise", "return"):
        raise _upcr.SettingError(f"setting `errors`: there is no {errors}; there are raise, return")
    clouds: list[Any] = []
    places: dict[int, int | Exception] = {}
    # A cloud's identity lasts as long as the cloud.
    held = []

    def place_of(cloud: CloudLike, name: str) -> int:
        if id(cloud) not in places:
            held.append(cloud)
            try:
                clouds.append(packed(cloud, name))
                places[id(cloud)] = len(clouds) - 1
            except (TypeError, ValueError) as error:
                places[id(cloud)] = error
        known = places[id(cloud)]
        if isinstance(known, Exception):
            raise known
        return known

    wanted = []
    refused: dict[int, Exception] = {}
    for i, pair in enumerate(pairs):
        if not isinstance(pair, (tuple, list)) or len(pair) not in (2, 3):
            raise TypeError(f"pair {i}: a source, a target and, if there is one, a first guess are needed")
        source, target, *init = pair
        try:
            guess = None if not init or init[0] is None else _settings.pose(init[0])
            wanted.append((i, place_of(source, "source"), place_of(target, "target"), guess))
        except (TypeError, ValueError) as error:
            if errors == "raise":
                raise type(error)(f"pair {i}: {error}") from error
            refused[i] = error
    given = _settings.packed(settings)
    found = iter(_upcr.register_batch(clouds, wanted, given, errors == "raise", progress))
    answers = [refused[i] if i in refused else next(found) for i in range(len(wanted) + len(refused))]
    return [one if isinstance(one, Exception) else registration(one) for one in answers]
