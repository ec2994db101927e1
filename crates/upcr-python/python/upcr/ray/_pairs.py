"""Registration of pairs in tables."""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import ray.data

from .. import _settings, _upcr
from .._cloud import PointCloud, read
from .._register import register_batch
from .._registration import Registration

if TYPE_CHECKING:
    import numpy.typing as npt
    from typing_extensions import Unpack

    from .._settings import Settings

SCHEMA = pa.schema(
    [
        ("T_target_source", pa.list_(pa.float64(), 16)),
        ("probability", pa.float64()),
        ("is_trustworthy", pa.bool_()),
        ("reasons", pa.list_(pa.string())),
        ("fitness", pa.float64()),
        ("inlier_rmse", pa.float64()),
        ("num_inliers", pa.int64()),
        ("converged", pa.bool_()),
        ("iterations", pa.int64()),
        ("covariance", pa.list_(pa.float64(), 36)),
        ("alternatives", pa.list_(pa.list_(pa.float64(), 16))),
        ("free_directions", pa.list_(pa.string())),
        ("source_scale", pa.float64()),
        ("method", pa.string()),
        ("voxel_size", pa.float64()),
        ("error", pa.string()),
        ("prepare_ms", pa.float64()),
        ("hypotheses_ms", pa.float64()),
        ("refine_ms", pa.float64()),
        ("verify_ms", pa.float64()),
        ("total_ms", pa.float64()),
    ]
)
"""The columns that registration adds, those of :class:`upcr.Registration`; matrices row after row. Where a pair could not
be looked at, ``error`` says why and the others are null. The last five are times: they alone change from run to run."""

_MATRICES = ("T_target_source", "covariance")


class Registrar:
    """Registers the pairs of a table, a row each: what each worker of :func:`register_pairs` does, and of use without Ray.

    The rows that come back are the table's, in order, with the columns of :data:`SCHEMA` in place of points.
    """

    def __init__(self, *, source: str = "source", target: str = "target", **settings: Unpack[Settings]) -> None:
        """Takes the names of the clouds' columns, and settings as :func:`upcr.register` has them."""
        _upcr.check(_settings.packed(settings))
        self.source = source
        self.target = target
        self.settings = settings

    def __call__(self, pairs: pa.Table) -> pa.Table:
        """Registers every row of ``pairs``, whose columns :func:`register_pairs` describes."""
        self.check(pairs.column_names)
        with tempfile.TemporaryDirectory(prefix="upcr-") as scratch:
            clouds = [self._pair(row, Path(scratch)) for row in _rows(pairs)]
            looked_at = [pair for pair in clouds if not isinstance(pair, Exception)]
            answers = iter(register_batch(looked_at, errors="return", **self.settings))
            found = [pair if isinstance(pair, Exception) else next(answers) for pair in clouds]
        points = [name for name in (self.source, self.target) if not _is_text(pairs.schema.field(name).type)]
        kept = pairs.drop_columns(points)
        rows = pa.Table.from_pylist([_row(one) for one in found], schema=SCHEMA)
        for name in SCHEMA.names:
            kept = kept.append_column(SCHEMA.field(name), rows.column(name))
        return kept

    def check(self, columns: list[str]) -> None:
        """Refuses a table of these columns where one is missing, or has a name of the result's."""
        taken = sorted(set(SCHEMA.names) & set(columns))
        if taken:
            raise _upcr.SettingError(f"columns that the result has too: {', '.join(taken)}; rename them")
        for column in (self.source, self.target):
            if column not in columns:
                raise _upcr.SettingError(f"there is no column {column}; there are {', '.join(columns)}")

    def _pair(self, row: Mapping[str, Any], scratch: Path) -> tuple[Any, Any, Any] | Exception:
        """A row's clouds and first guess as ``register_batch`` takes them, or what is wrong with them."""
        try:
            source, target = (_cloud(row, name, scratch) for name in (self.source, self.target))
            return source, target, _guess(row.get("init"))
        except (OSError, TypeError, ValueError, pa.ArrowException) as error:
            return error


def register_pairs(
    pairs: ray.data.Dataset,
    *,
    source: str = "source",
    target: str = "target",
    workers: int | None = None,
    cpus_per_worker: int = 1,
    batch_size: int = 32,
    **settings: Unpack[Settings],
) -> ray.data.Dataset:
    """Registers the rows of a dataset: a Ray Data transformation, lazy as all of them.

    Args:
        pairs: Rows with the columns ``source`` and ``target``: names of files (which all workers can read; or URIs that
            Arrow's file systems know, such as ``s3://``), or points of shape (N, 3). Further columns that are looked at
            where they are there: ``init`` (a first guess, shape (4, 4), or a file with one), ``source_viewpoint`` and
            ``target_viewpoint`` (shape (3,)). All columns are kept but the clouds' own where they are points;
            none may have a name of :data:`SCHEMA`'s.
        source: Name of the column of the clouds that are moved.
        target: Name of the column of those that stay.
        workers: Processes that register; else as many as find room.
        cpus_per_worker: Processors, and threads, of each. Reading and writing need some as well: workers that take all
            of a cluster's processors leave none for them.
        batch_size: Pairs that a worker is handed at once, and that are done again where it dies.
        **settings: As for :func:`upcr.register`.

    Returns:
        A row for each pair, with the columns of :data:`SCHEMA`, in blocks of ``batch_size``: ``write_parquet`` makes a
        file of each where its ``min_rows_per_file`` does not say otherwise.
    """
    if not isinstance(pairs, ray.data.Dataset):
        raise TypeError(f"pairs: a Ray dataset is needed, such as read_pairs() or ray.data.from_items(), not {type(pairs).__name__}")
    if "threads" in settings:
        raise _upcr.SettingError("setting `threads`: a worker's are told by `cpus_per_worker`")
    for name, value in (("workers", workers), ("cpus_per_worker", cpus_per_worker), ("batch_size", batch_size)):
        if value is not None and value < 1:
            raise _upcr.SettingError(f"setting `{name}`: must be 1 at least, not {value}")
    # Now, not when the job has started.
    registrar = Registrar(source=source, target=target, **settings)
    known = pairs.schema(fetch_if_missing=False)
    if known is not None:
        registrar.check(known.names)
    warn_of_waiting((workers or 1) * cpus_per_worker + 1, "the workers, and reading and writing,")
    pool = ray.data.ActorPoolStrategy(size=workers) if workers else ray.data.ActorPoolStrategy(min_size=1)
    # Ray's blocks are as large as memory likes, and a block is what a worker is handed and what is done again.
    return pairs.repartition(target_num_rows_per_block=batch_size).map_batches(
        Registrar,
        fn_constructor_kwargs={"source": source, "target": target, "threads": cpus_per_worker, **settings},
        batch_size=None,
        batch_format="pyarrow",
        compute=pool,
        num_cpus=cpus_per_worker,
    )


def warn_of_waiting(needed: int, who: str) -> None:
    """Warns where the cluster has fewer processors than are needed at once."""
    if ray.is_initialized():
        there = int(ray.cluster_resources().get("CPU", 0))
        if there < needed:
            text = f"{who} need {needed} processors, and there are {there}: unless the cluster grows, they wait for ever"
            warnings.warn(text, stacklevel=3)


def read_pairs(path: str | os.PathLike[str]) -> ray.data.Dataset:
    """Reads what :func:`register_pairs` takes.

    Args:
        path: Parquet, a file or a folder of files (or a URI), whose reading Ray shares out; or a text file with a pair
            a line, as ``upcr register --pairs`` takes it: source, target and, if there is one, a file with a first
            guess, apart by blanks (or tabs, where names have blanks), ``#`` before comments. Its rows have their number
            as ``id``, from 0, and names are made absolute.

    Raises:
        FormatError: A line of a list has not two or three columns.
    """
    name = os.fspath(path)
    if name.endswith(".parquet") or not os.path.isfile(name):
        return ray.data.read_parquet(name)
    rows: list[dict[str, Any]] = []
    with open(name, encoding="utf-8") as lines:
        for number, line in enumerate(lines, 1):
            files = [part.strip() for part in line.split("\t")] if "\t" in line else line.split()
            if not any(files) or files[0].startswith("#"):
                continue
            if len(files) not in (2, 3):
                raise _upcr.FormatError(f"{name}: line {number}: not two or three columns: {line.rstrip()!r}")
            files = [file if "://" in file else os.path.abspath(file) for file in files]
            rows.append(dict(zip(("source", "target", "init"), files)) | {"id": len(rows)})
    schema = pa.schema([("id", pa.int64()), *[(name, pa.string()) for name in ("source", "target", "init")]])
    table = pa.Table.from_pylist(rows, schema=schema)
    # Blocks that several workers can take.
    size = max(1, min(1024, -(-len(rows) // 64)))
    return ray.data.from_arrow([table.slice(start, size) for start in range(0, max(len(rows), 1), size)])


def _rows(table: pa.Table) -> Iterator[dict[str, Any]]:
    """A table's rows, tensors of any shape as NumPy arrays."""
    columns = {name: table.column(name) for name in table.column_names}
    for i in range(len(table)):
        yield {name: _value(column[i]) for name, column in columns.items()}


def _value(scalar: pa.Scalar) -> Any:
    if isinstance(scalar, pa.ExtensionScalar):
        # Arrow's tensors and Ray's.
        as_array = getattr(scalar, "to_numpy", None) or scalar.as_py
        return as_array()
    if isinstance(scalar, (pa.ListScalar, pa.FixedSizeListScalar)):
        values = scalar.values
        rows = None if values is None else len(values)
        while values is not None and isinstance(values, (pa.ListArray, pa.LargeListArray, pa.FixedSizeListArray)):
            values = values.flatten()
        if values is None or _is_text(values.type):
            return scalar.as_py()
        flat = values.to_numpy(zero_copy_only=False)
        # A list of rows, or of their entries.
        return flat.reshape(rows, -1) if rows and len(flat) != rows else flat
    return scalar.as_py()


def _is_text(kind: pa.DataType) -> bool:
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind))


def _cloud(row: Mapping[str, Any], name: str, scratch: Path) -> str | PointCloud:
    value = row[name]
    if value is None:
        raise _upcr.CloudError(f"{name}: there is no cloud")
    viewpoint = row.get(f"{name}_viewpoint")
    if isinstance(value, str):
        file = _local(value, scratch)
        return file if viewpoint is None else read(file, viewpoint=viewpoint)
    points = np.asarray(value)
    return PointCloud(points.reshape(-1, 3) if points.ndim == 1 and points.size % 3 == 0 else points, viewpoint=viewpoint)


def _guess(value: Any) -> str | npt.NDArray[np.float64] | None:
    if value is None or isinstance(value, str):
        return value
    guess = np.asarray(value, np.float64)
    return guess.reshape(4, 4) if guess.size == 16 else guess


def _local(name: str, scratch: Path) -> str:
    """A file's name on this machine; what is elsewhere is brought."""
    if "://" not in name:
        return name
    import pyarrow.fs

    system, path = pyarrow.fs.FileSystem.from_uri(name)
    here = scratch / f"{len(os.listdir(scratch))}-{os.path.basename(path)}"
    with system.open_input_stream(path) as there, open(here, "wb") as copy:
        while block := there.read(1 << 20):
            copy.write(block)
    return str(here)


def _row(found: Registration | Exception) -> dict[str, Any]:
    if isinstance(found, Exception):
        return {"error": str(found)}
    times = found.timings_ms
    return {
        "T_target_source": found.T_target_source.ravel(),
        "probability": found.probability,
        "is_trustworthy": found.is_trustworthy,
        "reasons": found.reasons,
        "fitness": found.fitness,
        "inlier_rmse": found.inlier_rmse,
        "num_inliers": found.num_inliers,
        "converged": found.converged,
        "iterations": found.iterations,
        "covariance": found.covariance.ravel(),
        "alternatives": [other.T_target_source.ravel() for other in found.alternatives],
        "free_directions": [direction.sentence for direction in found.free_directions],
        "source_scale": found.source_scale,
        "method": found.method,
        "voxel_size": found.voxel_size,
        "prepare_ms": times.prepare,
        "hypotheses_ms": times.hypotheses,
        "refine_ms": times.refine,
        "verify_ms": times.verify,
        "total_ms": times.total,
    }
