"""Whether the answer is the same, byte for byte, on one thread and on two, for every method.

Registers all real pairs and some pairs of shapes with `upcr register --pairs - --json --no-times`, once with
`--threads 1` and once with `--threads 2`, and compares what is printed.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import pairs as data

METHODS = ("auto", "features", "prior", "upcr", "fgr", "ransac", "consensus")
REAL = "bunny,3dmatch,redkitchen,kitti"


def listed(sets: str, cache: Path, limit: int | None) -> list[str]:
    """Lines for `--pairs`."""
    return [
        "\t".join(map(str, pair.files)) for name in data.chosen(sets) for pair in data.pairs(name, cache, limit)
    ]


def answers(upcr: Path, lines: list[str], method: str, threads: int) -> list[bytes]:
    command = [upcr, "register", "--pairs", "-", "--no-times", "--method", method, "--threads", str(threads)]
    done = subprocess.run(command, input="\n".join(lines).encode(), capture_output=True)
    found = done.stdout.splitlines()
    if len(found) != len(lines):
        sys.exit(f"{len(found)} answers to {len(lines)} pairs: {done.stderr.decode(errors='replace')}")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--upcr", type=Path, default=data.ROOT / "target" / "release" / "upcr", help="the binary")
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--shapes", type=int, default=50, help="pairs of each of four protocols over shapes")
    parser.add_argument("--cache", type=Path, default=data.CACHE, help="where the pairs are written")
    options = parser.parse_args()
    lines = listed(REAL, options.cache, None)
    shapes = "shapes-consistent,shapes-nd,shapes-partial_nd,shapes-independent_nd"
    lines += listed(shapes, options.cache, options.shapes)
    print(f"{len(lines)} pairs")
    failed = False
    for method in options.methods.split(","):
        one, two = (answers(options.upcr, lines, method, threads) for threads in (1, 2))
        different = [line for line, a, b in zip(lines, one, two) if a != b]
        failed |= bool(different)
        print(f"{method:10} {len(different)} of {len(lines)} differ", *different[:5], sep="\n  " if different else " ", flush=True)
    sys.exit(failed)


if __name__ == "__main__":
    main()
