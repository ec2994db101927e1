"""Simulates the registration of any number of pairs on any number of cores: how long it takes, and what limits it.

One scheduler hands blocks of pairs to workers, one a core, at a limited pace. A worker takes a random time for each block,
and dies now and then, losing the block it is at: it is done again, by whoever is free, and the worker comes back later. The
paces are those that `scale.py` measures.
"""

import argparse
import heapq

import numpy as np


def simulate(options: argparse.Namespace) -> tuple[float, float, int, int]:
    """Seconds to the end, core-seconds of useful work, blocks done again, and blocks done."""
    rng = np.random.default_rng(options.seed)
    blocks = -(-int(options.pairs) // options.batch)
    mean = options.batch / options.rate
    deviation = options.spread * np.sqrt(options.batch) / options.rate
    # When workers are free: all at once, after their start.
    free = [(options.start, worker) for worker in range(options.workers)]
    dies = rng.exponential(3600 * options.hours_between_deaths, options.workers)
    scheduler, end, useful, again, left = 0.0, 0.0, 0.0, 0, blocks
    while left:
        now, worker = heapq.heappop(free)
        scheduler = begin = max(now, scheduler + 1 / options.blocks_a_second)
        took = max(0.1 * mean, rng.normal(mean, deviation))
        if begin + took > dies[worker]:
            # Dead at some moment of it, or before; another life begins once it is back.
            back = max(begin, dies[worker]) + options.start
            dies[worker] = back + rng.exponential(3600 * options.hours_between_deaths)
            heapq.heappush(free, (back, worker))
            again += 1
            continue
        left -= 1
        useful += took
        end = max(end, begin + took)
        heapq.heappush(free, (begin + took, worker))
    return end, useful, again, blocks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--pairs", type=float, default=1e9)
    parser.add_argument("--workers", type=int, nargs="+", default=[100, 1000, 10000], help="one a core")
    parser.add_argument("--batch", type=int, nargs="+", default=[32, 1024], help="pairs of a block")
    parser.add_argument("--rate", type=float, required=True, help="pairs a second and core")
    parser.add_argument("--spread", type=float, default=1.0, help="deviation of a pair's time, in its mean")
    parser.add_argument("--blocks-a-second", type=float, required=True, help="what the scheduler hands out at most")
    parser.add_argument("--hours-between-deaths", type=float, default=100.0, help="of one worker, on average")
    parser.add_argument("--start", type=float, default=30.0, help="seconds that a worker takes to start")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    print("| cores | pairs a block | hours | core-hours | of the cores' time useful | pairs done again |")
    print("| ---: | ---: | ---: | ---: | ---: | ---: |")
    for workers in given.workers:
        for batch in given.batch:
            seconds, useful, again, _ = simulate(argparse.Namespace(**vars(given) | {"workers": workers, "batch": batch}))
            share = useful / (seconds * workers)
            print(
                f"| {workers:,} | {batch} | {seconds / 3600:.1f} | {seconds * workers / 3600:,.0f} | {share:.1%} | {again * batch:,} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
