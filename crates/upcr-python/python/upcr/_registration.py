"""What a registration returns."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ._cloud import FloatArray

if TYPE_CHECKING:
    from ._upcr import _Parts

Reason = Literal[
    "no_overlap",
    "low_overlap",
    "ambiguous",
    "seen_through",
    "degenerate_axis",
    "too_few_points",
    "scale_mismatch",
    "not_converged",
    "poor_fit",
    "time_limit",
    "cancelled",
]


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another pose that explains the clouds nearly as well."""

    T_target_source: FloatArray
    """As that of the registration, shape (4, 4)."""
    relative_score: float
    """Its score over that of the pose returned: 1 is as good."""

    @property
    def transformation(self) -> FloatArray:
        """``T_target_source``, by the name that Open3D gives it."""
        return self.T_target_source


@dataclass(frozen=True, eq=False)
class FreeDirection:
    """A motion of the registered source that leaves its surface on the target's, in the target's frame."""

    motion: Literal["translation", "rotation"]
    """A slide along the axis, or a turn about it."""
    axis: FloatArray
    """Unit vector, shape (3,)."""
    point: FloatArray | None
    """Of a rotation a point on the axis, shape (3,)."""
    sentence: str
    """The same in words."""

    def __str__(self) -> str:
        return self.sentence


@dataclass(frozen=True)
class Evidence:
    """What the probability is made of. Counts and shares are of points that the refinement did not use, of both clouds,
    unless said otherwise."""

    overlap: tuple[float, float]
    """Share of the source's points with a target point within a voxel, and of the target's with a source point."""
    inliers: int
    """Points within a voxel of the other cloud."""
    closeness: float
    """Score of the pose over several distances relative to the largest of them: 1 where residuals vanish."""
    residual_ratio: float
    """Median distance from the other cloud's tangent planes over that from the own cloud's."""
    near_misses: float
    """Of the points within four voxels of the other cloud, the share that is not within one."""
    facing: tuple[float, float]
    """Share of the points within a voxel whose normal agrees with the nearest there, and with the nearest of its own."""
    in_free_space: float | None
    """Share of the points where the other's sensor saw through; None where no viewpoint is known."""
    runner_up: float
    """Score of the best clearly different pose over that of this one; 0 where there is none."""
    glimpsed: float
    """The same after a coarse refinement, which more poses see."""
    rivals: int
    """How many clearly different poses score nearly as well."""
    agreement: float
    """Share of the most promising hypotheses that a coarse refinement led to this pose."""
    matches: tuple[int, int] | None
    """How many feature matches the pose explains, and of how many; None where none were looked for."""
    conditioning: float
    """Information about the motion that the surfaces hold least, over that about the one that they hold best."""
    free_directions: int
    """How many directions of motion nothing holds."""
    converged: bool
    """Whether the refinement settled."""
    points: int
    """Points of the smaller cloud."""
    samples: bool
    """Whether the points are samples as they were taken, not averages of many."""


@dataclass(frozen=True)
class Timings:
    """Milliseconds spent in each step; reading files is no part of it."""

    prepare: float
    """Checks, scale, downsampling, normals."""
    hypotheses: float
    """Features, matching, hypotheses."""
    refine: float
    """Refinement."""
    verify: float
    """Scoring and verdict."""
    total: float
    """All of it."""


@dataclass(frozen=True, eq=False, repr=False)
class Registration:
    """The one result, whatever the method, always completely filled.

    ``print`` shows it in full, a notebook with a picture of the clouds before and after.
    """

    T_target_source: FloatArray
    """Takes source coordinates to target coordinates, shape (4, 4): ``y = R x + t``, in the clouds' own frames and unit."""
    fitness: float
    """Share of held-out source points with a target point within ``voxel_size``, 0 to 1."""
    inlier_rmse: float
    """Root mean square distance of those, in the clouds' unit."""
    num_inliers: int
    """How many there are."""
    converged: bool
    """Whether the refinement settled, with inliers to settle on, and nothing ended the call early."""
    iterations: int
    """Refinement iterations of the returned pose."""
    probability: float
    """Probability that the pose is right, 0 to 1."""
    covariance: FloatArray
    """Shape (6, 6), rad² and squared units of the clouds, of the left twist (rotation, then translation) about the centre
    of the target's bounding box that takes the pose found to the right one, axes as in the target's frame."""
    reasons: list[Reason]
    """What speaks against the pose."""
    source_scale: float | None
    """The factor by which the source's lengths have to be multiplied for the clouds to fit, where they do not as they are."""
    method: str
    """Which source the winning first pose came from."""
    voxel_size: float
    """The scale used, in the clouds' unit; 0 where the call ended before it was known."""
    is_trustworthy: bool
    """Whether the pose is more likely right than wrong."""
    _more: str = field(repr=False)
    _pictured: tuple[FloatArray, FloatArray] = field(repr=False)

    @cached_property
    def caveats(self) -> list[str]:
        """The reasons in words."""
        return list(self._told["caveats"])

    @cached_property
    def free_directions(self) -> list[FreeDirection]:
        """Motions that the geometry does not hold."""
        return [
            FreeDirection(one["motion"], np.array(one["axis"]), np.array(one["point"]) if "point" in one else None, sentence)
            for one, sentence in zip(self._told["free_directions"], self._told["sentences"], strict=True)
        ]

    @cached_property
    def alternatives(self) -> list[Alternative]:
        """Other poses that explain the clouds nearly as well, best first."""
        return [
            Alternative(np.array(one["T_target_source"]), one["relative_score"]) for one in self._told["alternatives"]
        ]

    @cached_property
    def evidence(self) -> Evidence:
        """What the probability is made of."""
        told: dict[str, Any] = self._told["evidence"]
        return Evidence(**{name: _pair(value) for name, value in told.items()})

    @cached_property
    def points_used(self) -> tuple[int, int]:
        """Points of source and target that were looked at."""
        source, target = self._told["points_used"]
        return source, target

    @cached_property
    def settings(self) -> dict[str, Any]:
        """All settings in effect."""
        return dict(self._told["settings"])

    @cached_property
    def timings_ms(self) -> Timings:
        """Where the time went."""
        return Timings(**self._told["timings_ms"])

    @cached_property
    def _told(self) -> dict[str, Any]:
        told: dict[str, Any] = json.loads(self._more)
        return told

    @property
    def transformation(self) -> FloatArray:
        """``T_target_source``, by the name that Open3D gives it."""
        return self.T_target_source

    def __repr__(self) -> str:
        doubts = f", reasons: {', '.join(self.reasons)}" if self.reasons else ""
        return (
            f"<upcr.Registration: {self._verdict()}, fitness {self.fitness:.4f}, "
            f"inlier_rmse {self.inlier_rmse:.6g}{doubts}>"
        )

    def __str__(self) -> str:
        rows = "\n".join("  " + " ".join(f"{value:>14.6f}" for value in row) for row in self.T_target_source + 0.0)
        lines = [f"T_target_source\n{rows}", ""]
        lines += [f"{name:<13}{value}" for name, value in self._lines()]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        from ._picture import page

        return page(self._lines(), self._pictured, self.T_target_source)

    def _verdict(self) -> str:
        registered = "registered" if self.is_trustworthy else "not registered"
        return f"{registered} (probability {self.probability:.3f})"

    def _lines(self) -> list[tuple[str, str]]:
        lines = [("verdict", self._verdict())]
        lines += [("caveat", caveat) for caveat in self.caveats]
        if self.source_scale is not None:
            lines.append(("", f"they fit once the source's lengths are multiplied by {self.source_scale:.6f}"))
        lines += [("free", direction.sentence) for direction in self.free_directions]
        if self.alternatives:
            scores = ", ".join(f"{other.relative_score:.3f}" for other in self.alternatives)
            lines.append(("alternatives", f"{len(self.alternatives)}, of scores {scores} of the best"))
        fit = f"{self.fitness:.4f} ({self.num_inliers} points within a voxel, rmse {self.inlier_rmse:.6g})"
        lines.append(("fitness", fit))
        lines.append(("method", f"{self.method}, voxel size {self.voxel_size:.6g}"))
        lines.append(("time", f"{self.timings_ms.total:.1f} ms"))
        return lines


def _pair(value: Any) -> Any:
    """What are two of a kind in Rust."""
    return tuple(value) if isinstance(value, list) else value


def registration(parts: _Parts) -> Registration:
    """A result from what the native half gives."""
    fields, more, source, target = parts
    return Registration(**fields, _more=more, _pictured=(source, target))
