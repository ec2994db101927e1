"""Many scans into models."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from . import _settings, _upcr
from ._cloud import CloudLike, FloatArray, HasPoints, PointCloud, packed, place
from ._model import Model
from ._registration import Reason
from ._settings import Feature, Kernel, Method, Refinement


@dataclass(frozen=True)
class MergeProgress:
    """How far a merge is."""

    step: Literal["describe", "register"]
    """Scans are read and described, or pairs are registered. Pairs are registered in several rounds."""
    done: int
    """Scans or pairs of the round that are done."""
    of: int
    """All of them."""


@dataclass(frozen=True, eq=False, repr=False)
class MergedScan:
    """Where a scan lies."""

    name: str
    """The file's name, without its folder where that tells the files apart; of other clouds their number, as ``scan 3``."""
    state: Literal["placed", "alone", "unusable"]
    """In a model of two scans or more; or no pair with it is to be trusted; or it cannot be used."""
    model: int | None = None
    """The model's number, where it is in one: 0 is the model of the most scans."""
    T_model_scan: FloatArray | None = None
    """Takes the scan's coordinates to the model's, shape (4, 4): ``y = R x + t``; None where it is in no model."""
    pairs: int = 0
    """Kept pairs that hold it there."""
    probability: float = 0.0
    """Probability that one of these pairs at least is right, 0 to 1."""
    reason: str | None = None
    """Why it is in no model, where it is in none."""

    def __repr__(self) -> str:
        if self.model is None:
            return f"<upcr.MergedScan {self.name}: left out, {self.reason}>"
        return f"<upcr.MergedScan {self.name}: model {self.model}, {self.pairs} pairs, probability {self.probability:.3f}>"


@dataclass(frozen=True, eq=False, repr=False)
class MergedPair:
    """A pair that was registered, and what became of it."""

    source: int
    """Number of the scan that was moved."""
    target: int
    """Number of the scan that stayed."""
    proposal: Literal["sequence", "likeness", "overlap"]
    """Why these two: one follows the other, they look alike, or the poses of other pairs lay one on the other."""
    prior: FloatArray | None
    """Of an overlap, where the other pairs lay it, shape (4, 4)."""
    T_target_source: FloatArray
    """Takes source coordinates to target coordinates, shape (4, 4), as this pair alone has it."""
    probability: float
    """Probability that it does, 0 to 1."""
    covariance: FloatArray
    """As that of a :class:`Registration`, shape (6, 6)."""
    fitness: float
    """Share of held-out source points with a target point within ``voxel_size``, 0 to 1."""
    reasons: list[Reason]
    """What speaks against the pose."""
    kept: bool
    """Whether the scans' poses rest on it."""
    contradicted: bool
    """Whether it was trusted by itself, and the pairs that would come to lie on each other by it speak against it."""
    chi_sq: float | None
    """Squared error of the scans' poses under the covariance, where the pair was trusted by itself and is not contradicted."""

    @property
    def transformation(self) -> FloatArray:
        """``T_target_source``, by the name that Open3D gives it."""
        return self.T_target_source

    def __repr__(self) -> str:
        if self.kept:
            kept = "kept"
        elif self.contradicted:
            kept = "contradicted"
        else:
            kept = "not kept" if self.chi_sq is None else "at odds with the others"
        doubts = f", reasons: {', '.join(self.reasons)}" if self.reasons else ""
        return (
            f"<upcr.MergedPair {self.source} -> {self.target}: {kept}, probability {self.probability:.3f}, "
            f"fitness {self.fitness:.4f}{doubts}>"
        )


@dataclass(frozen=True, eq=False, repr=False)
class Merged:
    """What was made of scans: where each lies, and the pairs that say so.

    ``print`` shows it in full. The scans are kept for :meth:`fuse`: files by their names, others by a copy.
    """

    scans: list[MergedScan]
    """Where each scan lies, in the order in which they were given."""
    voxel_size: float
    """The common scale, in the scans' unit."""
    inflation: float
    """By how much the covariances of pairs were multiplied, so that pairs agree with each other as they should."""
    _pairs: str = field(repr=False)
    _scans: _upcr.Scans = field(repr=False)

    @cached_property
    def T_model_scan(self) -> list[FloatArray | None]:
        """The pose of each scan in its model, shape (4, 4); None where it is in none."""
        return [scan.T_model_scan for scan in self.scans]

    @cached_property
    def models(self) -> list[list[int]]:
        """Numbers of the scans of each model, that of the most scans first."""
        models: list[list[int]] = []
        for number, scan in enumerate(self.scans):
            if scan.model is not None:
                models += [[] for _ in range(scan.model + 1 - len(models))]
                models[scan.model].append(number)
        return models

    @property
    def is_whole(self) -> bool:
        """Whether all scans are in one model."""
        return len(self.models) == 1 and len(self.models[0]) == len(self.scans)

    @cached_property
    def pairs(self) -> list[MergedPair]:
        """All pairs that were registered, in order of their scans."""
        told: list[dict[str, Any]] = json.loads(self._pairs)
        return [
            MergedPair(
                **{
                    **pair,
                    "T_target_source": np.array(pair["T_target_source"]),
                    "covariance": np.array(pair["covariance"]),
                    "prior": None if pair["prior"] is None else np.array(pair["prior"]),
                }
            )
            for pair in told
        ]

    def fuse(
        self, model: int = 0, thin: float | None = None, *, progress: Callable[[int], object] | None = None
    ) -> PointCloud:
        """One cloud of all scans of a model, in the model's frame: the mean of all points in each cell, with their mean color.

        Args:
            model: The model's number.
            thin: Edge of the cells, in the scans' unit; else ``voxel_size``.
            progress: Called with the number of scans that are done, on this thread. What it raises ends the call, as
                does Ctrl-C.

        Raises:
            SettingError: There is no such model, or ``thin`` is no length.
            OSError: A file cannot be read any more.
        """
        if not 0 <= model < len(self.models):
            raise _upcr.SettingError(f"setting `model`: there is no {model}; there are {len(self.models)}, from 0 on")
        poses = [
            (number, pose.tolist())
            for number in self.models[model]
            if (pose := self.scans[number].T_model_scan) is not None
        ]
        return PointCloud(*self._scans.fuse(poses, self.voxel_size if thin is None else thin, progress))

    def __repr__(self) -> str:
        placed = [len(scans) for scans in self.models]
        where = {0: "no model", 1: "1 model"}.get(len(placed), f"{len(placed)} models")
        of = f" of {', '.join(map(str, placed))}" if len(placed) > 1 else ""
        out = f", {len(self.scans) - sum(placed)} left out" if sum(placed) < len(self.scans) else ""
        return f"<upcr.Merged: {sum(placed)} of {len(self.scans)} scans in {where}{of}{out}>"

    def __str__(self) -> str:
        lines = []
        for model, scans in enumerate(self.models):
            lines.append(f"model {model}: {len(scans)} scans")
            for scan in (self.scans[number] for number in scans):
                lines.append(f"  {scan.name}  {scan.pairs} pairs, probability {scan.probability:.3f}")
        if sum(map(len, self.models)) < len(self.scans):
            lines.append("left out:")
            lines += [f"  {scan.name}  {scan.reason}" for scan in self.scans if scan.model is None]
        lines.append(f"pairs        {len(self.pairs)} registered, {sum(pair.kept for pair in self.pairs)} kept")
        dropped = [pair for pair in self.pairs if pair.chi_sq is not None and not pair.kept]
        contradicted = [pair for pair in self.pairs if pair.contradicted]
        for what, pairs in [
            ("at odds with the others", dropped),
            ("what they lay on each other speaks against them", contradicted),
        ]:
            if pairs:
                lines.append(f"trusted as pairs, and {what}:")
            for pair in pairs:
                source, target = self.scans[pair.source].name, self.scans[pair.target].name
                lines.append(f"  {source} -> {target}  probability {pair.probability:.3f}")
        lines.append(f"voxel size   {self.voxel_size:.6g}")
        return "\n".join(lines)


def merge(
    scans: str | os.PathLike[str] | Iterable[CloudLike],
    *,
    neighbors: int | None = None,
    sequential: bool = False,
    method: Method | None = None,
    network: Model | str | os.PathLike[str] | None = None,
    feature: Feature | None = None,
    refine: Refinement | None = None,
    voxel_size: float | None = None,
    kernel: Kernel | None = None,
    overlap: float | None = None,
    calibration: str | os.PathLike[str] | None = None,
    seed: int | None = None,
    threads: int | None = None,
    max_memory_bytes: int | None = None,
    viewpoint: npt.ArrayLike | None = None,
    progress: Callable[[MergeProgress], object] | None = None,
) -> Merged:
    """Finds the poses of many scans, unordered and each in a frame of its own, in common models: what ``upcr merge`` does.

    Scans that cannot be used or placed are no error: the result says so (``scans[i].reason``). Ctrl-C ends the call. Other
    Python threads run meanwhile.

    Args:
        scans: Two scans or more, each as :func:`register` takes clouds; or a folder, of which every file of a known format
            is a scan, in the order of their names. Files are read when they are needed, and as often; all others are
            copied and held.
        neighbors: Scans that each is registered with, of those that look most like it.
        sequential: The scans are in the order in which they were taken: each is registered with the two after it as well.
        method: Where the first poses of pairs come from, as with :func:`register`.
        network: The network that is asked, or its weights file; else the one in the package.
        feature: The feature that is matched: ``fpfh``, ``spfh`` or ``pfh``.
        refine: What the refinement minimises: ``gicp``, ``plane``, ``point`` or ``none``.
        voxel_size: The one scale that drives every radius, in the scans' unit; else derived from the scans.
        kernel: How residuals are weighed: ``none``, ``huber``, ``cauchy``, ``geman_mcclure`` or ``tukey``.
        overlap: Share of the closest pairs of points that the refinement keeps, 0 to 1; else all within reach.
        calibration: What the evidence for a pose weighs: a file of ``upcr calibrate``.
        seed: Seed of every random choice.
        threads: Threads to use; else all. The result does not depend on it.
        max_memory_bytes: Bytes that scans may take at once, beside those that are held. The result does not depend on it.
        viewpoint: Where the sensor stood, shape (3,), in each scan's own frame and unit, where the scan does not say.
        progress: Called now and then, on this thread. What it raises ends the call.

    Raises:
        SettingError: A setting is out of its range, or there are fewer than two scans.
        CloudError: An array has not the shape of points.
        OSError: A file or the folder is not there. A file that is there and cannot be read is left out.
    """
    if isinstance(scans, (np.ndarray, HasPoints)):
        raise TypeError("scans: a folder or several clouds are needed, not one")
    given: Iterable[CloudLike] = _upcr.scans_in(os.fspath(scans)) if isinstance(scans, (str, os.PathLike)) else scans
    # Colors are for the model alone.
    clouds = [packed(cloud, f"scan {number}", colors=True) for number, cloud in enumerate(given)]
    if len(clouds) < 2:
        raise _upcr.SettingError(f"setting `scans`: two are needed at least, not {len(clouds)}")
    settings = {
        "neighbors": neighbors,
        "sequential": sequential,
        "method": method,
        "network": network,
        "feature": feature,
        "refine": refine,
        "voxel_size": voxel_size,
        "kernel": kernel,
        "overlap": overlap,
        "calibration": calibration,
        "seed": seed,
        "threads": threads,
        "max_memory_bytes": max_memory_bytes,
    }
    held = _upcr.Scans(clouds, place(viewpoint))
    hear = None if progress is None else lambda step, done, of: progress(MergeProgress(step, done, of))
    told, pairs = _upcr.merge(held, _settings.packed(settings), hear)
    places = zip(held.names, told.pop("reasons"), told.pop("places"), strict=True)
    return Merged(scans=[_scan(*one) for one in places], **told, _pairs=pairs, _scans=held)


def _scan(name: str, reason: str | None, told: dict[str, Any]) -> MergedScan:
    pose = told.get("T_model_scan")
    return MergedScan(
        **{**told, "name": name, "reason": reason, "T_model_scan": None if pose is None else np.array(pose)}
    )
