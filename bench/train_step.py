"""A training step of the paper's network (K = 24, widths 64-64-128-256-512, both branches, Chamfer loss, backward,
Adam): ours beside the same network written plainly in PyTorch, on the same threads, one after the other.

The plain form keeps every edge's features for the backward pass: 26 pairs of 1,024 points need some 40 GB, so the two
are compared on fewer pairs, and ours is timed on 26 as well.
"""

import argparse
import json
import statistics
import subprocess
import time

import torch

import plain_network as plain

BUILD = ["cargo", "bench", "--quiet", "-p", "upcr-lab", "--bench", "train_step"]


def ours(pairs: int, points: int, repeats: int) -> dict:
    done = subprocess.run([*BUILD, "--", str(pairs), str(points), str(repeats)], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def torch_step(pairs: int, points: int, repeats: int) -> dict:
    torch.manual_seed(1)
    network = plain.Network(plain.Config())
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    clouds = torch.nn.functional.normalize(torch.randn(2 * pairs * points, 3), dim=1)
    sizes = [points] * (2 * pairs)
    # Ours gets its graphs from the loader's thread.
    graph = plain.nearest(clouds, sizes, network.config.k)
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        plain.train_step(network, optimizer, clouds, sizes, graph)
        times.append((time.perf_counter() - start) * 1e3)
    times = times[1:]
    return {"ms_median": statistics.median(times), "ms_min": min(times)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, nargs="+", default=[2, 4], help="pairs of a step, compared")
    parser.add_argument("--points", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    args = parser.parse_args()
    torch.set_num_threads(args.threads)

    print(f"PyTorch {torch.__version__}, {args.threads} threads, {args.points} points, medians of {args.repeats} steps\n")
    print("| pairs | PyTorch, ms | ours, ms | ratio |")
    print("| ---: | ---: | ---: | ---: |")
    ours(1, args.points, 1)  # builds
    for pairs in args.pairs:
        theirs = torch_step(pairs, args.points, args.repeats)["ms_median"]
        mine = ours(pairs, args.points, args.repeats)["ms_median"]
        print(f"| {pairs} | {theirs:.0f} | {mine:.0f} | {theirs / mine:.1f} |", flush=True)
    mine = ours(26, args.points, args.repeats)["ms_median"]
    print(f"| 26 | does not fit | {mine:.0f} | |")


if __name__ == "__main__":
    main()
