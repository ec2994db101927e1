"""Predicting the pose of one pair with the default network (K = 24, widths 64-64-128-256-512, both branches, m = 512;
neighbours, distances and head included): ours beside the same network written plainly in PyTorch, on the same threads,
taking turns.
"""

import argparse
import json
import os
import statistics
import subprocess
import time

import torch

import plain_network as plain

BENCH = ["cargo", "bench", "--quiet", "-p", "upcr", "--bench", "network", "--", "--json"]


def ours(points: int, repeats: int, threads: int) -> dict:
    environment = {**os.environ, "RAYON_NUM_THREADS": str(threads)}
    command = [*BENCH, str(points), str(repeats)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return json.loads(done.stdout)


def torch_predict(points: int, repeats: int) -> dict:
    torch.manual_seed(1)
    network = plain.Network(plain.Config())
    source, target = torch.nn.functional.normalize(torch.randn(2, points, 3), dim=2)
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        plain.predict(network, source, target)
        times.append((time.perf_counter() - start) * 1e3)
    times = times[1:]
    return {"ms_median": statistics.median(times), "ms_min": min(times)}


def row(points: int, args: argparse.Namespace) -> str:
    """A line of the table: medians and minima of the turns together."""
    theirs, mine = [], []
    for _ in range(args.turns):
        theirs.append(torch_predict(points, args.repeats))
        mine.append(ours(points, 10 * args.repeats, args.threads))
    median = lambda turns: statistics.median(turn["ms_median"] for turn in turns)
    least = lambda turns: min(turn["ms_min"] for turn in turns)
    shown = lambda turns: f"{median(turns):.1f} ({least(turns):.1f})"
    ratios = f"{median(theirs) / median(mine):.1f} ({least(theirs) / least(mine):.1f})"
    return f"| {points} | {shown(theirs)} | {shown(mine)} | {ratios} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, nargs="+", default=[256, 1024, 2048], help="points of each cloud")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--repeats", type=int, default=5, help="PyTorch's predictions in a turn; ours are ten times as many")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    args = parser.parse_args()
    torch.set_num_threads(args.threads)

    ours(16, 1, args.threads)  # builds
    load = os.getloadavg()[0]
    print(f"PyTorch {torch.__version__}, {args.threads} threads, load {load:.1f}; medians (minima) of {args.turns} turns\n")
    print("| points | PyTorch, ms | ours, ms | ratio |")
    print("| ---: | ---: | ---: | ---: |")
    for points in args.points:
        print(row(points, args), flush=True)


if __name__ == "__main__":
    main()
