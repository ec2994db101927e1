"""A large georeferenced pair: makes two LAS files of virtual airborne scans, registers them, prints time and memory.

The scans are of one procedural town on hills, overlap by 70 %, differ by a turn of 140° about the vertical and by
the offsets of their coordinate systems, and carry 3 cm of height noise.
"""

import argparse
import json
import os
import subprocess
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

import pairs as data

EXTENT = (400.0, 400.0)  # metres a scan
SHIFT = 120.0  # of the second scan, along x
TURN = np.radians(140)
SOURCE_OFFSET = np.array([433_000.0, 5_400_200.0, 100.0])
TARGET_OFFSET = np.array([512_000.0, 5_403_000.0, 320.0])


def town(count: int, rng: np.random.Generator, x_from: float) -> np.ndarray:
    """`count` points of the town seen from above, from `x_from` on."""
    x, y = rng.uniform(x_from, x_from + EXTENT[0], count), rng.uniform(0, EXTENT[1], count)
    z = 6 * np.sin(x / 37) + 4 * np.cos(y / 29 + x / 90) + 2 * np.sin((x + y) / 13)
    houses = np.random.default_rng(7)
    for _ in range(60):
        cx, cy = houses.uniform(0, EXTENT[0] + SHIFT), houses.uniform(0, EXTENT[1])
        width, depth, height = houses.uniform(8, 25), houses.uniform(8, 25), houses.uniform(4, 18)
        z[(abs(x - cx) < width / 2) & (abs(y - cy) < depth / 2)] = 8 + height
    return np.c_[x, y, z + rng.normal(0, 0.03, count)]


def make(file: Path, options, x_from: float, R: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Writes a scan of the town from `x_from` on, and returns its centroid."""
    points = town(options.points, np.random.default_rng(int(x_from)), x_from) @ R.T + offset
    np.save(file.with_suffix(".npy"), points)
    subprocess.run([options.upcr, "convert", file.with_suffix(".npy"), file], check=True, capture_output=True)
    file.with_suffix(".npy").unlink()
    return points.mean(axis=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=10_000_000, help="points a cloud")
    parser.add_argument("--upcr", type=Path, default=data.ROOT / "target" / "release" / "upcr")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()

    # A town point p is R p + SOURCE_OFFSET in the source's frame and p + TARGET_OFFSET in the target's.
    R = data.axis_rotation(np.array([0, 0, 1.0]), TURN)
    truth = data.rigid(R.T, TARGET_OFFSET - R.T @ SOURCE_OFFSET)
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / "source.las", Path(folder) / "target.las"]
        # Made in processes of their own: a process's peak memory counts its parent's.
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as other:
            centroid = other.submit(make, files[0], options, 0.0, R, SOURCE_OFFSET).result()
            other.submit(make, files[1], options, SHIFT, np.eye(3), TARGET_OFFSET).result()
        command = [options.upcr, "register", *files, "--json", "--threads", str(options.threads)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        answer = json.loads(process.stdout.read())
        _, status, usage = os.wait4(process.pid, 0)
    T = np.array(answer["T_target_source"])
    print(f"points a cloud   {options.points:,}")
    print(f"exit status      {os.waitstatus_to_exitcode(status)}, probability {answer['probability']:.3f}")
    print(f"rotation error   {data.rotation_angle(T[:3, :3] @ truth[:3, :3].T):.4f}°")
    print(f"error at centre  {np.linalg.norm(data.apply(T, centroid) - data.apply(truth, centroid)):.4f} m")
    print(f"registering      {answer['timings_ms']['total']:.0f} ms, reading excluded")
    print(f"peak memory      {usage.ru_maxrss / 1024:.0f} MiB, reading included")


if __name__ == "__main__":
    main()
