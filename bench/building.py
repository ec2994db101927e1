"""How `upcr merge` grows: virtual scans of a building, each turned at random, in random order, without any pose.

`upcr synth` makes the building, the more scans the more rooms. A pair that is kept counts as wrong where it is off by more than
2 degrees or 0.1 m; places are those of the scanner, against the true ones, after the rigid motion that fits each model best.
"""

import argparse
import json
import os
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from multiway import places_off

WRONG_DEG, WRONG_M = 2.0, 0.1


def measured(command: list[str]) -> tuple[float, float, float, str]:
    """Seconds by the clock and of the processor, largest resident memory in MB, and what it printed."""
    with tempfile.TemporaryFile("w+") as output:
        start = time.perf_counter()
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - start
        if os.waitstatus_to_exitcode(status) not in (0, 3):
            raise SystemExit(f"{' '.join(command[:2])} failed: {os.waitstatus_to_exitcode(status)}")
        output.seek(0)
        return seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024, output.read()


def scans(binary: str, folder: Path, count: int, seed: int) -> tuple[list[Path], list[np.ndarray]]:
    """Files in random order with names that tell nothing, and their true poses."""
    raw = folder / f"scans-{count}-{seed}"
    if not raw.exists():
        making = raw.with_suffix(".part")
        options = ["--scene", "building", "--scans", str(count), "--seed", str(seed), "--turned"]
        subprocess.run([binary, "synth", *options, "--out", making], check=True, stdout=subprocess.DEVNULL)
        making.rename(raw)
    files = sorted(raw.glob("scan_*.ply"))
    order = np.random.default_rng(seed).permutation(len(files))
    files = [files[i] for i in order]
    truth = [np.loadtxt(f.with_name(f.stem.replace("scan", "T_world") + ".txt")) for f in files]
    return files, truth


def off(T: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Degrees and metres at the origin between two poses."""
    error = np.linalg.inv(truth) @ T
    cosine = (np.trace(error[:3, :3]) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1))), np.linalg.norm(error[:3, 3])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--binary", default="target/release/upcr")
    parser.add_argument("--counts", default="100,1000")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("target/building"), help="where scans are made, and kept")
    parser.add_argument("--args", default="--viewpoint 0,0,0", help="more of upcr merge's")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)

    columns = ["scans", "seconds", "of the processor", "MB", "models", "left out", "pairs registered", "kept", "wrong and kept",
               "right and dropped", "rmse m", "largest m"]
    print("| " + " | ".join(columns) + " |\n|" + " ---: |" * len(columns))
    for count in map(int, args.counts.split(",")):
        files, truth = scans(args.binary, args.folder, count, args.seed)
        number = {file.name: i for i, file in enumerate(files)}
        with tempfile.TemporaryDirectory() as scratch:
            seconds, busy, memory, text = measured(
                [args.binary, "merge", *map(str, files), "-o", f"{scratch}/model.ply", "--json",
                 "--threads", str(args.threads), *args.args.split()]
            )
        told = json.loads(text)
        kept = wrong = dropped = 0
        for pair in told["pairs"]:
            a, b = number[pair["source_name"]], number[pair["target_name"]]
            degrees, metres = off(np.array(pair["T_target_source"]), np.linalg.inv(truth[b]) @ truth[a])
            right = degrees < WRONG_DEG and metres < WRONG_M
            kept += pair["kept"]
            wrong += pair["kept"] and not right
            dropped += right and not pair["kept"] and pair["chi_sq"] is not None
        errors = np.concatenate([
            places_off({number[scan["name"]]: np.array(scan["T_model_scan"]) for scan in model}, truth)
            for model in told["models"]
        ])
        sizes = " + ".join(str(len(model)) for model in told["models"])
        row = [count, f"{seconds:.0f}", f"{busy:.0f}", f"{memory:.0f}", sizes, len(told["left_out"]), len(told["pairs"]), kept, wrong,
               dropped, f"{np.sqrt((errors**2).mean()):.3f}", f"{errors.max():.3f}"]
        print("| " + " | ".join(map(str, row)) + " |", flush=True)


if __name__ == "__main__":
    main()
