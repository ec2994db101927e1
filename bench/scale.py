"""Registers shape pairs in one process and on a local Ray cluster, one worker of which is killed half-way, and compares.

Says whether the tables are the same row by row, whether rows are lost or doubled, and pairs a second and core. Needs
`upcr[ray]` and the public shapes; exits with status 1 where anything differs.
"""

import argparse
import logging
import os
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import pairs as data
import pyarrow as pa
import pyarrow.parquet as pq
import ray

import upcr.ray

PROTOCOLS = ("consistent", "consistent-nd", "partial", "partial-nd", "independent", "independent-nd")
PAIRS_A_FILE = 250
SHAPES_IN_ALL = 469
TIMES = [name for name in upcr.ray.SCHEMA.names if name.endswith("_ms")]


def make(folder: Path, count: int) -> None:
    """Writes `count` pairs of the test shapes, of all protocols in turn, and their true poses."""
    shapes = data.shapes(SHAPES_IN_ALL)[0]
    folder.mkdir(parents=True)
    for first in range(0, count, PAIRS_A_FILE):
        rows = []
        for i in range(first, min(first + PAIRS_A_FILE, count)):
            turn = i // len(PROTOCOLS)
            pair = data.shape_pair(PROTOCOLS[i % len(PROTOCOLS)], turn, shapes[turn % len(shapes)])
            clouds = {"source": pair.source.astype(np.float32).tolist(), "target": pair.target.astype(np.float32).tolist()}
            rows.append({"id": i, "protocol": PROTOCOLS[i % len(PROTOCOLS)], **clouds, "truth": pair.T_target_source.ravel()})
        points = pa.list_(pa.list_(pa.float32(), 3))
        kinds = {"id": pa.int64(), "protocol": pa.string(), "source": points, "target": points}
        schema = pa.schema([*kinds.items(), ("truth", pa.list_(pa.float64(), 16))])
        pq.write_table(pa.Table.from_pylist(rows, schema=schema), folder / f"pairs-{first:08}.parquet")


def registrars() -> list[int]:
    """Processes of this one's cluster that register."""
    parents, found = {}, []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            # The name, in parentheses, may have blanks.
            parents[int(process.name)] = int((process / "stat").read_text().rpartition(")")[2].split()[1])
            title = (process / "cmdline").read_text()
        except OSError:
            continue
        if title.startswith("ray::") and "Registrar" in title:
            found.append(int(process.name))

    def is_own(process: int) -> bool:
        return process == os.getpid() or process in parents and is_own(parents[process])

    return sorted(filter(is_own, found))


def one_process(pairs: Path, out: Path, threads: int) -> float:
    """Seconds that one process takes, files read and written."""
    registrar = upcr.ray.Registrar(threads=threads)
    out.mkdir()
    start = time.perf_counter()
    for file in sorted(pairs.iterdir()):
        pq.write_table(registrar(pq.read_table(file)), out / file.name)
    return time.perf_counter() - start


def cluster(pairs: Path, out: Path, workers: int, kill_at: int | None = None) -> tuple[float, list[str]]:
    """Seconds that workers take, and what was done to them."""
    done: list[str] = []

    def kill() -> None:
        """Kills a worker once there are so many files."""
        while len(list(out.glob("*.parquet"))) < kill_at:
            time.sleep(0.02)
        processes = registrars()
        os.kill(processes[0], signal.SIGKILL)
        done.append(f"killed process {processes[0]} of {processes}, {kill_at} files written")

    killer = threading.Thread(target=kill, daemon=True)
    start = time.perf_counter()
    found = upcr.ray.register_pairs(upcr.ray.read_pairs(f"{pairs}/"), workers=workers)
    if kill_at is not None:
        killer.start()
    found.write_parquet(str(out), min_rows_per_file=PAIRS_A_FILE)
    return time.perf_counter() - start, done


class Nothing:
    """Does nothing with a block."""

    def __call__(self, block: pa.Table) -> pa.Table:
        return block


def blocks_a_second(blocks: int, workers: int) -> float:
    """How many blocks Ray hands to workers that do nothing with them, once these have started."""
    seconds = []
    for count in (workers, blocks):
        dataset = ray.data.range(count, override_num_blocks=count).materialize()
        pool = ray.data.ActorPoolStrategy(size=workers)
        start = time.perf_counter()
        dataset.map_batches(Nothing, batch_size=None, batch_format="pyarrow", compute=pool, num_cpus=1).materialize()
        seconds.append(time.perf_counter() - start)
    return (blocks - workers) / (seconds[1] - seconds[0])


def compare(name: str, out: Path, expected: pa.Table) -> bool:
    """Whether the folder's rows are those expected, times aside."""
    rows = pq.read_table(out)
    ids = rows.column("id").to_pylist()
    lost, doubled = len(set(range(len(expected))) - set(ids)), len(ids) - len(set(ids))
    rows = rows.sort_by("id").select(expected.column_names)
    same = rows.drop_columns(TIMES).equals(expected.drop_columns(TIMES))
    print(f"{name}: {len(ids)} rows, {lost} lost, {doubled} doubled, {'the same' if same else 'OTHER'} values", flush=True)
    return same and lost == doubled == 0


def right(rows: pa.Table) -> float:
    """Share of poses within the tolerance of shapes."""
    T, truth = (np.array(rows.column(name).to_pylist()).reshape(-1, 4, 4) for name in ("T_target_source", "truth"))
    return float(np.mean([data.rotation_angle(a[:3, :3] @ b[:3, :3].T) < data.SHAPES.rotation for a, b in zip(T, truth)]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--pairs", type=int, default=10_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--blocks", type=int, default=2000, help="empty blocks, to see how many Ray hands out a second")
    options = parser.parse_args()
    if not (data.DATA / "shapes69").is_dir():
        sys.exit(f"no shapes at {data.DATA} (set UPCR_DATA): nothing to do")
    # Reading and writing take a processor's share as well, but hardly its time.
    ray.init(num_cpus=options.workers + 1, include_dashboard=False, logging_level=logging.ERROR, log_to_driver=False)
    ray.data.DataContext.get_current().enable_progress_bars = False
    print(f"{blocks_a_second(options.blocks, options.workers):.0f} empty blocks a second", flush=True)
    good = True
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        make(folder / "pairs", options.pairs)
        print(f"{options.pairs} pairs, {sum(f.stat().st_size for f in (folder / 'pairs').iterdir()) / 1e6:.0f} MB", flush=True)

        def told(name: str, seconds: float, cores: int) -> None:
            rate = options.pairs / seconds
            print(f"{name}: {seconds:.1f} s, {rate:.1f} pairs a second, {rate / cores:.1f} a core", flush=True)

        for threads in (1, options.workers):
            told(f"one process, {threads} threads", one_process(folder / "pairs", folder / f"one-{threads}", threads), threads)
        expected = pq.read_table(folder / "one-1").sort_by("id")
        size = sum(f.stat().st_size for f in (folder / "one-1").iterdir()) / options.pairs
        print(f"{right(expected):.4f} of the poses right, {size:.0f} bytes a row of Parquet", flush=True)
        good &= compare("one process", folder / f"one-{options.workers}", expected)
        seconds, _ = cluster(folder / "pairs", folder / "ray", options.workers)
        told(f"{options.workers} workers", seconds, options.workers)
        good &= compare(f"{options.workers} workers", folder / "ray", expected)
        files = len(list((folder / "ray").glob("*.parquet")))
        seconds, done = cluster(folder / "pairs", folder / "killed", options.workers, kill_at=files // 2)
        good &= len(done) == 1
        print("; ".join(done), flush=True)
        told(f"{options.workers} workers, one killed", seconds, options.workers)
        good &= compare(f"{options.workers} workers, one killed", folder / "killed", expected)
    sys.exit(not good)


if __name__ == "__main__":
    main()
