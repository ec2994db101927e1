"""Label-free adaptation of the network."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from . import _upcr
from ._cloud import CloudLike, HasPoints, packed
from ._model import Model

Pairs = Literal["upc", "uc", "nd", "mixed"]


@dataclass(frozen=True)
class Errors:
    """Errors on the clouds' own pairs, whose true poses are known."""

    loss: float
    """Mean loss: the Chamfer distance between canonical shapes."""
    mae_r_deg: float
    """Mean absolute error of the Euler angles, in degrees."""
    mae_t: float
    """Mean absolute error of the translations' components, in radii of the clouds."""
    recall: float
    """Share of the pairs within 5° and a tenth of a cloud's diameter."""


@dataclass(frozen=True)
class AdaptationProgress:
    """A point of the learning curve."""

    step: int
    """Steps done."""
    steps: int
    """Steps of the whole run."""
    points: int
    """Points of a cloud."""
    loss: float
    """Mean loss since the last event."""
    validation: Errors | None
    """Errors on held-out pairs, where they were measured."""
    learning_rate: float
    """Step size."""
    clouds_per_second: float
    """Clouds a second since the last event."""
    seconds: float
    """Seconds spent so far."""
    seconds_left: float
    """Seconds to the run's end at this pace."""


@dataclass(frozen=True)
class Adaptation:
    """What came of an adaptation."""

    model: Model
    """The better network: the adapted one, or the old one where its loss is not lower."""
    helped: bool
    """Whether it is the adapted one."""
    before: Errors
    """On the clouds' own pairs, before."""
    after: Errors
    """The same with the adapted network."""
    steps: int
    """Steps done."""
    seconds: float
    """Seconds spent on them."""


def adapt(
    clouds: str | os.PathLike[str] | Iterable[CloudLike],
    weights: Model | str | os.PathLike[str] | None = None,
    *,
    epochs: int | None = None,
    points: int | None = None,
    learning_rate: float | None = None,
    pairs: Pairs | None = None,
    partial: bool = False,
    fixed_pairs: bool = False,
    seed: int | None = None,
    threads: int | None = None,
    parts: int = 1,
    folder: str | os.PathLike[str] | None = None,
    progress: Callable[[AdaptationProgress], object] | None = None,
) -> Adaptation:
    """Lets the network learn on from your own clouds, without labels: what ``upcr adapt`` does.

    Args:
        clouds: A folder of clouds, a data set, or clouds as ``register`` takes them, each of the whole of a shape. They
            are thinned to 2,048 points; points that are not finite are left out.
        weights: The network to start from, or its weights file; else the one in the package.
        epochs: Passes over the clouds.
        points: Points of a cloud in a pair: at most three quarters of the clouds' where pairs are partial, as half of the
            ``mixed`` ones are.
        learning_rate: Adam's step size at the start.
        pairs: Pairs that are made of the clouds: ``upc`` (clean), ``nd`` (noisy) or ``mixed``.
        partial: Keep three quarters of each cloud.
        fixed_pairs: Learn from one pair of each cloud, not from new poses in every epoch.
        seed: Seed of the pairs.
        threads: Threads to use; else all. The result does not depend on it.
        parts: Parts of every batch, each of which normalises itself, as machines have them that learn together
            (:func:`upcr.ray.adapt`).
        folder: Where the run's checkpoint and learning curve go; a run that was stopped there goes on. Else nowhere.
        progress: Called now and then, on this thread. What it raises ends the call, as does Ctrl-C.

    Raises:
        WeightsError: The weights are of no network that learns so, or learning has lost its way.
        CloudError, FormatError, OSError: A cloud is not usable.
    """
    if isinstance(clouds, (np.ndarray, HasPoints)):
        raise TypeError("clouds: a folder or several clouds are needed, not one")
    given: Any = os.fspath(clouds) if isinstance(clouds, (str, os.PathLike)) else [packed(cloud) for cloud in clouds]
    if isinstance(given, list) and len(given) < max(parts, 1):
        raise _upcr.SettingError(f"setting `parts`: {len(given)} clouds make no {max(parts, 1)} parts")
    if weights is None:
        weights = Model.default()
    elif not isinstance(weights, Model):
        weights = Model.load(weights)
    options = {
        "pairs": pairs,
        "partial": partial,
        "fixed_pairs": fixed_pairs,
        "epochs": epochs,
        "points": points,
        "learning_rate": learning_rate,
        "seed": seed,
        "threads": threads,
        "parts": parts,
        "checkpoint_seconds": None,
    }

    def hear(event: dict[str, Any]) -> None:
        if progress is not None:
            validation = event.pop("validation")
            progress(AdaptationProgress(**event, validation=None if validation is None else Errors(**validation)))

    with ExitStack() as scratch:
        if folder is None:
            # A run that Ctrl-C has left alone may still write its last checkpoint there.
            place = scratch.enter_context(tempfile.TemporaryDirectory(prefix="upcr-", ignore_cleanup_errors=True))
        else:
            place = os.fspath(folder)
            os.makedirs(place, exist_ok=True)
        found = _upcr.adapt(given, weights._native, place, options, hear, None)
    before, after = Errors(**found.pop("before")), Errors(**found.pop("after"))
    return Adaptation(model=Model(found.pop("model")), before=before, after=after, **found)
