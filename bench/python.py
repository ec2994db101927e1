"""What the Python package costs: the wheel's size, the time that its import takes, and what a call takes over Rust's.

A call's overhead is its wall time less the time that the library itself tells, for clouds of 1,024 points. Exits with
status 1 where one of them is beyond its limit; times are medians, and loaded machines miss the last one.
"""

import argparse
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import upcr

SAMPLES = Path(__file__).parents[1] / "samples"
MEGABYTES, IMPORT_MS, CALL_MS = 15.0, 100.0, 0.2


def import_ms(times: int) -> float:
    """Milliseconds that the import takes beyond NumPy's."""
    script = "import numpy, time; t = time.perf_counter(); import upcr; print(1e3 * (time.perf_counter() - t))"
    runs = [subprocess.run([sys.executable, "-c", script], capture_output=True, check=True) for _ in range(times)]
    return statistics.median(float(run.stdout) for run in runs)


def call_ms(times: int, method: str) -> tuple[float, float]:
    """Milliseconds that a call takes over the library's own, and those."""
    source, target = (upcr.read(SAMPLES / f"{name}.ply").points[:1024].copy() for name in ("source", "target"))
    over, own = [], []
    for _ in range(times):
        start = time.perf_counter()
        found = upcr.register(source, target, method=method)  # type: ignore[arg-type]
        wall = 1e3 * (time.perf_counter() - start)
        over.append(wall - found.timings_ms.total)
        own.append(found.timings_ms.total)
    return statistics.median(over), statistics.median(own)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--wheel", type=Path, help="the wheel, whose size is to be told")
    parser.add_argument("--times", type=int, default=100, help="calls")
    options = parser.parse_args()
    print(f"upcr {upcr.__version__}, Python {sys.version.split()[0]}, NumPy {np.__version__}")
    good = True
    if options.wheel:
        size = options.wheel.stat().st_size / 1e6
        good &= size < MEGABYTES
        print(f"wheel     {size:.1f} MB (limit {MEGABYTES:.0f})")
    spent = import_ms(9)
    good &= spent < IMPORT_MS
    print(f"import    {spent:.1f} ms beyond NumPy's (limit {IMPORT_MS:.0f})")
    for method in ("prior", "auto"):
        over, own = call_ms(options.times, method)
        print(f"register  {over:.3f} ms over the library's own {own:.2f} ms, method {method} (aim {CALL_MS})")
    sys.exit(not good)


if __name__ == "__main__":
    main()
