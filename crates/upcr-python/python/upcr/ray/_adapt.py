"""Label-free adaptation by several workers."""

from __future__ import annotations

import asyncio
import itertools
import os
import shutil
import tempfile
import time
import uuid
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import ray
import ray.data
import ray.train
from ray.train import Checkpoint, CheckpointConfig, FailureConfig, RunConfig, ScalingConfig
from ray.train.collective import broadcast_from_rank_zero
from ray.train.v2.api.data_parallel_trainer import DataParallelTrainer

from .. import _upcr
from .._adapt import Adaptation, Errors, Pairs
from .._cloud import packed
from .._model import Model
from ._pairs import _value, warn_of_waiting

if TYPE_CHECKING:
    import numpy.typing as npt

    _Rows = list[npt.NDArray[np.float64]]

_CHECKPOINT = "checkpoint.safetensors"
_REPORTS_SHARE = 0.1
"""Share of the time that reports of checkpoints may take; all workers wait for one, some two seconds."""


def adapt(
    clouds: ray.data.Dataset,
    weights: Model | str | os.PathLike[str] | None = None,
    *,
    column: str = "cloud",
    workers: int = 2,
    cpus_per_worker: int = 1,
    parts: int | None = None,
    epochs: int | None = None,
    points: int | None = None,
    learning_rate: float | None = None,
    pairs: Pairs | None = None,
    partial: bool = False,
    fixed_pairs: bool = False,
    seed: int | None = None,
    name: str | None = None,
    storage_path: str | None = None,
    checkpoint_seconds: float = 60.0,
    max_failures: int = 3,
) -> Adaptation:
    """Lets the network learn on without labels, on many machines: :func:`upcr.adapt`, data-parallel, by Ray Train.

    Each worker learns from clouds of its own: its parts of every batch. The result is that of ``upcr.adapt`` with as many
    ``parts`` on one machine, to the last bit, however many workers share them out.

    Args:
        clouds: Rows with a column of points, shape (N, 3), or of files' names, each cloud the whole of a shape.
        weights: The network to start from, or its weights file; else the one in the package.
        column: The name of that column.
        workers: Processes that learn.
        cpus_per_worker: Processors, and threads, of each.
        parts: Parts of a batch, each of which normalises itself; else one a worker.
        epochs, points, learning_rate, pairs, partial, fixed_pairs, seed: As for :func:`upcr.adapt`.
        name: The run's name; one that was stopped goes on under the same.
        storage_path: Where its checkpoints go: a place that all machines see, where there are several.
        checkpoint_seconds: Time between checkpoints, from which the workers go on where one has died. It is longer where
            a tenth of the time would not do for them.
        max_failures: How often they do.

    Raises:
        SettingError: There are fewer clouds than parts, or fewer parts than workers.
        ray.train.TrainingFailedError: A worker failed for good; its cause is the error.
    """
    if not isinstance(clouds, ray.data.Dataset):
        raise TypeError(f"clouds: a Ray dataset is needed, such as ray.data.from_items(), not {type(clouds).__name__}")
    parts = parts or workers
    if workers < 1:
        raise _upcr.SettingError(f"setting `workers`: must be 1 at least, not {workers}")
    if workers > parts:
        raise _upcr.SettingError(f"setting `parts`: {workers} workers need as many at least, not {parts}")
    if weights is None:
        weights = Model.default()
    elif not isinstance(weights, Model):
        weights = Model.load(weights)
    # In memory once and in order, so that a part's rows are the same for whoever learns from it, and in the next run.
    names = clouds.columns() or []
    if column not in names:
        raise _upcr.SettingError(f"there is no column {column}; there are {', '.join(names)}")
    rows = clouds.select_columns([column])
    rows.context.execution_options.preserve_order = True
    rows = rows.materialize()
    count = rows.count()
    if count < parts:
        raise _upcr.SettingError(f"setting `parts`: {count} clouds make no {parts} parts")
    # The parts that one machine makes of as many clouds (`Shapes::in_parts`).
    bounds = [part * count // parts for part in range(parts + 1)]
    blocks = [part.to_arrow_refs() for part in rows.split_at_indices(bounds[1:-1])] if parts > 1 else [rows.to_arrow_refs()]
    told = {
        "blocks": blocks,
        "bounds": bounds,
        "column": column,
        "weights": weights.to_bytes(),
        "options": {
            "pairs": pairs,
            "partial": partial,
            "fixed_pairs": fixed_pairs,
            "epochs": epochs,
            "points": points,
            "learning_rate": learning_rate,
            "seed": seed,
            "threads": cpus_per_worker,
            "parts": parts,
            "checkpoint_seconds": checkpoint_seconds,
        },
    }
    warn_of_waiting(workers * cpus_per_worker, "the workers")
    if storage_path is not None and "://" not in storage_path:
        storage_path = os.path.abspath(storage_path)
    trainer = DataParallelTrainer(
        _learn,
        train_loop_config=told,
        scaling_config=ScalingConfig(num_workers=workers, resources_per_worker={"CPU": cpus_per_worker}),
        run_config=RunConfig(
            name=name,
            storage_path=storage_path,
            failure_config=FailureConfig(max_failures=max_failures),
            checkpoint_config=CheckpointConfig(num_to_keep=1),
        ),
    )
    result: Any = trainer.fit()
    found: dict[str, Any] = result.return_value
    if "error" in found:
        raise found["error"]
    model = Model.from_bytes(found.pop("model"))
    before, after = Errors(**found.pop("before")), Errors(**found.pop("after"))
    return Adaptation(model=model, before=before, after=after, **found)


def _learn(told: dict[str, Any]) -> dict[str, Any] | None:
    """What each worker does; the first gives the result."""
    context = ray.train.get_context()
    rank, workers = context.get_world_rank(), context.get_world_size()
    bounds = told["bounds"]
    parts = len(bounds) - 1
    own = range(rank * parts // workers, (rank + 1) * parts // workers)
    team = _Team(rank, workers)
    try:
        clouds = [packed(cloud) for part in own for cloud in _clouds(told["blocks"][part], told["column"])]
        with tempfile.TemporaryDirectory(prefix="upcr-") as folder:
            stopped = ray.train.get_checkpoint()
            if stopped is not None:
                with stopped.as_directory() as kept:
                    shutil.copy(os.path.join(kept, _CHECKPOINT), folder)
            member = {
                "first_part": own.start,
                "clouds_before": bounds[own.start],
                "sizes": [bounds[part + 1] - bounds[part] for part in own],
                "gather": team.gather,
            }
            team.checkpoint = os.path.join(folder, _CHECKPOINT)
            team.seen = team.age()
            weights = _upcr.Model.from_bytes(told["weights"])
            found = _upcr.adapt(clouds, weights, folder, told["options"], team.hear, member)
            found["model"] = found["model"].to_bytes()
            return found if rank == 0 else None
    except (_upcr.Error, OSError, TypeError) as error:
        # To try again would not help: all end, and the first gives the error.
        return {"error": team.failed(error)}


def _clouds(blocks: list[ray.ObjectRef[Any]], column: str) -> Iterator[Any]:
    for table in ray.get(blocks):
        for scalar in table.column(column):
            value = _value(scalar)
            yield value if isinstance(value, str) else np.asarray(value)


class _Board:
    """Where members leave word of their rows, and wait for all others'."""

    def __init__(self, members: int) -> None:
        self.members = members
        self.rounds: dict[int, dict[int, Any]] = {}
        self.changed = asyncio.Condition()
        self.failure: Exception | None = None

    async def fail(self, error: Exception) -> Exception:
        """Ends all rounds with the first error that a member has."""
        async with self.changed:
            self.failure = self.failure or error
            self.changed.notify_all()
            return self.failure

    async def exchange(self, number: int, member: int, word: Any) -> list[Any] | Exception:
        async with self.changed:
            words = self.rounds.setdefault(number, {})
            words[member] = word
            # Who is in a round has done with the one before the last.
            self.rounds.pop(number - 2, None)
            self.changed.notify_all()
            await self.changed.wait_for(lambda: self.failure or len(words) == self.members)
            if self.failure:
                return self.failure
        return [words[rank] for rank in range(self.members)]


class _Team:
    """The workers as one of them sees them. Rows go through Ray's object store; the board has references alone."""

    def __init__(self, rank: int, workers: int) -> None:
        self.rank = rank
        self.board: Any
        name = f"upcr-{uuid.uuid4()}" if rank == 0 else None
        if name is not None:
            self.board = ray.remote(num_cpus=0)(_Board).options(name=name).remote(workers)
        name = broadcast_from_rank_zero(name)
        if rank != 0:
            self.board = ray.get_actor(name)
        self.rounds = itertools.count()
        self.last: dict[str, Any] = {}
        self.checkpoint = ""
        self.seen: float | None = None
        self.reports_from = 0.0
        # Rows of this round and the last, which slower members may not have fetched yet.
        self.kept: list[Any] = []

    def age(self) -> float | None:
        """When the checkpoint was written."""
        try:
            return os.stat(self.checkpoint).st_mtime_ns
        except FileNotFoundError:
            return None

    def hear(self, event: dict[str, Any]) -> None:
        """Keeps what the learning curve says, for the next report."""
        self.last = event

    def gather(self, own: _Rows) -> _Rows:
        """All members' rows. Where the first has written a checkpoint, all report it: they agree by its word."""
        age = self.age() if self.rank == 0 else None
        written = age is not None and age != self.seen and time.monotonic() >= self.reports_from
        rows = ray.put(own)
        self.kept = [*self.kept[-1:], rows]
        words = ray.get(self.board.exchange.remote(next(self.rounds), self.rank, (written, [rows])))
        if isinstance(words, Exception):
            raise words
        if words[0][0]:
            self.seen = age
            start = time.monotonic()
            self.report()
            end = time.monotonic()
            self.reports_from = end + (end - start) / _REPORTS_SHARE
        return [row for rows in ray.get([rows for _, [rows] in words]) for row in rows]

    def failed(self, error: Exception) -> Exception:
        """Tells the others; gives the error that is all's."""
        first: Exception = ray.get(self.board.fail.remote(error))
        return first

    def report(self) -> None:
        """Hands Ray Train the checkpoint."""
        metrics = {name: value for name, value in self.last.items() if isinstance(value, (int, float))}
        if self.rank != 0:
            ray.train.report(metrics)
            return
        with tempfile.TemporaryDirectory(prefix="upcr-") as folder:
            shutil.copy(self.checkpoint, folder)
            ray.train.report(metrics, checkpoint=Checkpoint.from_directory(folder))
