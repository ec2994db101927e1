"""Runs `upcr register` over sets of pairs: how many poses are right, how long it took, what the verdict was worth.

A pose is right when its rotation error and the displacement of the source's centroid are within the set's
tolerance. The time is the registration's own `timings_ms.total`: reading files and starting the process are no
part of it.
"""

import argparse
import json
import os
import platform
import shlex
import subprocess
import sys
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

import pairs as data
from pairs import Pair, PoseError

REGISTERED, FAILED, UNTRUSTED = 0, 1, 3  # exit statuses of `upcr register`
SURE = 0.5


@dataclass
class Run:
    """What came of one pair."""

    name: str
    status: int
    right: bool  # for a pair without a right pose: that none was offered
    error: PoseError | None = None
    probability: float | None = None
    reasons: tuple[str, ...] = ()
    method: str | None = None
    voxel_size: float | None = None
    fitness: float | None = None
    iterations: int | None = None
    timings_ms: dict[str, float] | None = None  # medians over the repeats
    wall_ms: float = 0.0
    steady: bool = True  # all repeats gave the same pose, bit for bit
    message: str = ""  # what went wrong


def call(command: list[str], threads: int, timeout: float) -> tuple[int, dict | None, str, float]:
    """Exit status, the JSON printed, why there is none, and the wall time in ms. Never raises."""
    environment = os.environ | {"RAYON_NUM_THREADS": str(threads), "RUST_BACKTRACE": "0"}
    start = time.perf_counter()
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, errors="replace", timeout=timeout)
    except subprocess.TimeoutExpired:
        return FAILED, None, f"no answer within {timeout:g} s", timeout * 1e3
    except OSError as error:
        return FAILED, None, str(error), 0.0
    wall = (time.perf_counter() - start) * 1e3
    if done.returncode not in (REGISTERED, UNTRUSTED):
        return done.returncode or FAILED, None, done.stderr.strip() or f"exit status {done.returncode}", wall
    try:
        answer = json.loads(done.stdout)
        if not isinstance(answer, dict):
            raise ValueError("not an object")
    except ValueError as error:
        return FAILED, None, f"no JSON on stdout: {error}; {done.stdout[:200]!r} {done.stderr.strip()}", wall
    return done.returncode, answer, done.stderr.strip(), wall


class Warm:
    """`upcr register --pairs -`, kept running: pairs go in and answers come out one by one.

    Other libraries are timed in a process that is warm too.
    """

    running: dict[tuple[str, ...], "Warm"] = {}

    def __init__(self, command: tuple[str, ...]):
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def ask(self, columns: list[str], timeout: float) -> tuple[int, dict | None, str, float]:
        start = time.perf_counter()
        alarm = threading.Timer(timeout, self.process.kill)
        alarm.start()
        try:
            self.process.stdin.write("\t".join(columns) + "\n")
            self.process.stdin.flush()
            line = self.process.stdout.readline()
        except OSError as error:
            return FAILED, None, str(error), 0.0
        finally:
            alarm.cancel()
        wall = (time.perf_counter() - start) * 1e3
        if not line:
            return FAILED, None, f"no answer within {timeout:g} s, or the process died", wall
        answer = json.loads(line)
        if "error" in answer:
            return FAILED, None, answer["error"], wall
        return (REGISTERED if answer["probability"] >= SURE else UNTRUSTED), answer, "", wall

    @classmethod
    def of(cls, command: list[str]) -> "Warm":
        key = tuple(command)
        warm = cls.running.get(key)
        if warm is None or warm.process.poll() is not None:
            warm = cls.running[key] = cls(key)
        return warm


def ask(upcr: Path, files, threads: int, extra: list[str], timeout: float, cold: bool) -> tuple[int, dict | None, str, float]:
    """One registration: by the warm process of these options, or by a process of its own."""
    options = ["--json", "--threads", str(threads)]
    if cold:
        return call([str(upcr), "register", *map(str, files), *options, *extra], threads, timeout)
    columns, rest = list(map(str, files)), list(extra)
    if "--init" in rest:
        at = rest.index("--init")
        columns.append(rest[at + 1])
        del rest[at : at + 2]
    return Warm.of([str(upcr), "register", "--pairs", "-", *options, *rest]).ask(columns, timeout)


def register(
    upcr: Path, pair: Pair, threads: int = 2, extra: list[str] = [], repeat: int = 1, timeout: float = 120, cold: bool = False
) -> Run:
    """Registers a written pair and judges the answer."""
    answers, walls = [], []
    for _ in range(repeat):
        status, answer, message, wall = ask(upcr, pair.files, threads, extra, timeout, cold)
        if answer is None:
            return Run(pair.name, status, right=False, wall_ms=wall, message=message)
        answers.append(answer)
        walls.append(wall)
    try:
        return judge(pair, status, answers, float(np.median(walls)), message)
    except (KeyError, TypeError, ValueError) as error:
        return Run(pair.name, FAILED, right=False, message=f"the JSON lacks what is asked: {error!r}")


def judge(pair: Pair, status: int, answers: list[dict], wall_ms: float, message: str) -> Run:
    first = answers[0]
    T = np.array(first["T_target_source"], dtype=float).reshape(4, 4)
    error = None if pair.T_target_source is None else pose_error_of(pair, T)
    return Run(
        pair.name,
        status,
        right=status == UNTRUSTED if error is None else error.within(pair.tolerance),
        error=error,
        probability=float(first["probability"]),
        reasons=tuple(map(str, first.get("reasons", ()))),
        method=first.get("method"),
        voxel_size=first.get("voxel_size"),
        fitness=first.get("fitness"),
        iterations=first.get("iterations"),
        timings_ms={key: median([a["timings_ms"][key] for a in answers]) for key in first["timings_ms"]},
        wall_ms=wall_ms,
        steady=all(a["T_target_source"] == first["T_target_source"] for a in answers),
        message=message,
    )


def pose_error_of(pair: Pair, T: np.ndarray) -> PoseError:
    if not np.isfinite(T).all():
        raise ValueError("T_target_source is not finite")
    return data.pose_error(pair, T)


# ---- summaries and tables


def median(values) -> float:
    values = [v for v in values if v is not None]
    return float(np.median(values)) if values else float("nan")


def summary(name: str, runs: list[Run]) -> dict:
    """One set's figures. Pairs without an answer count in `of`, in `failed`, and in nothing else."""
    answered = [r for r in runs if r.timings_ms is not None]
    errors = [r.error for r in answered if r.error]
    totals = [r.timings_ms["total"] for r in answered]
    steps = dict.fromkeys(key for r in answered for key in r.timings_ms if key != "total")
    negative = name == "disjoint"
    right = [] if negative else [r for r in answered if r.right]
    wrong = answered if negative else [r for r in answered if not r.right]
    return {
        "set": name,
        "right": sum(r.right for r in runs),
        "of": len(runs),
        "failed": len(runs) - len(answered),
        "unsteady": sum(not r.steady for r in runs),
        "rotation_deg": median(e.rotation for e in errors),
        "centroid": median(e.centroid for e in errors),
        "translation": median(e.translation for e in errors),
        "total_ms": median(totals),
        "p90_ms": float(np.percentile(totals, 90)) if totals else float("nan"),
        "steps_ms": {key: median(r.timings_ms.get(key) for r in answered) for key in steps},
        "p_right": float(np.mean([r.probability for r in right])) if right else float("nan"),
        "p_wrong": float(np.mean([r.probability for r in wrong])) if wrong else float("nan"),
        "wrong_sure": sum(r.probability >= SURE for r in wrong),
        "right_unsure": sum(r.probability < SURE for r in right),
        "wrong_accepted": sum(r.status == REGISTERED for r in wrong),
        "right_rejected": sum(r.status == UNTRUSTED for r in right),
    }


def number(value: float, digits: int = 3) -> str:
    """A figure short enough for a table."""
    if value is None or not np.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    decimals = max(0, digits - 1 - int(np.floor(np.log10(abs(value)))))
    return f"{value:,.{min(decimals, 6)}f}"


def table(head: list[str], rows: list[list[str]], markdown: bool) -> str:
    """The first column to the left, the rest to the right."""
    width = [max(len(row[i]) for row in [head, *rows]) for i in range(len(head))]
    cells = [[c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(row, width))] for row in [head, *rows]]
    rule = ["-" * w if i == 0 else "-" * (w - 1) + ":" for i, w in enumerate(width)] if markdown else ["-" * w for w in width]
    lines = [cells[0], rule, *cells[1:]]
    return "\n".join("| " + " | ".join(row) + " |" if markdown else "  ".join(row) for row in lines)


def report(sums: list[dict], markdown: bool) -> str:
    steps = list(dict.fromkeys(key for s in sums for key in s["steps_ms"]))
    poses = table(
        ["set", "right", "failed", "rot °", "centroid", "Δt", "median ms", "p90 ms", *steps],
        [
            [s["set"], f"{s['right']}/{s['of']}", str(s["failed"]), number(s["rotation_deg"]), number(s["centroid"])]
            + [number(s["translation"]), number(s["total_ms"]), number(s["p90_ms"])]
            + [number(s["steps_ms"].get(key, np.nan)) for key in steps]
            for s in sums
        ],
        markdown,
    )
    verdicts = table(
        ["set", "p of right", "p of wrong", f"wrong, p ≥ {SURE}", f"right, p < {SURE}", "wrong accepted", "right rejected"],
        [
            [s["set"], number(s["p_right"]), number(s["p_wrong"])]
            + [str(s[key]) for key in ("wrong_sure", "right_unsure", "wrong_accepted", "right_rejected")]
            for s in sums
        ],
        markdown,
    )
    unsteady = sum(s["unsteady"] for s in sums)
    return "\n\n".join([poses, verdicts, *([f"{unsteady} pairs gave different poses when repeated"] if unsteady else [])])


def line(run: Run) -> str:
    """One pair, for --verbose."""
    mark = "ok " if run.right else "BAD"
    if run.timings_ms is None:
        return f"{mark} {run.name}: {run.message}"
    error = run.error
    pose = f"{error.rotation:8.3f}° centroid {error.centroid:.5f} |Δt| {error.translation:.5f}" if error else "no right pose"
    text = f"{mark} {run.name:28} {pose} p {run.probability:.3f} exit {run.status} {run.method}"
    text += f" voxel {run.voxel_size:.4g}" if run.voxel_size is not None else ""
    text += f" {run.timings_ms['total']:8.1f} ms (" + " ".join(f"{k} {v:.1f}" for k, v in run.timings_ms.items() if k != "total")
    return text + f") {','.join(run.reasons)}" + ("" if run.steady else " UNSTEADY") + (f"\n    {run.message}" if run.message else "")


def machine(threads: int) -> str:
    """What the figures were measured on."""
    model = platform.processor() or platform.machine()
    try:
        for entry in Path("/proc/cpuinfo").read_text().splitlines():
            if entry.startswith("model name"):
                model = entry.partition(":")[2].strip()
                break
    except OSError:
        pass
    return f"{model}, {os.cpu_count()} cores, {threads} threads used; {platform.system()} {platform.machine()}"


def version(upcr: Path) -> str:
    try:
        return subprocess.run([str(upcr), "--version"], capture_output=True, text=True, timeout=10).stdout.strip() or "upcr"
    except (OSError, subprocess.TimeoutExpired):
        return "upcr (no answer to --version)"


def save(path: Path, result) -> None:
    """Writes strict JSON: what could not be measured is null."""

    def plain(value):
        if isinstance(value, dict):
            return {str(k): plain(v) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(v) for v in value]
        return None if isinstance(value, float) and not np.isfinite(value) else value

    path.write_text(json.dumps(plain(result), indent=1, allow_nan=False, default=str) + "\n")


def arguments(description: str, sets: str) -> argparse.ArgumentParser:
    """Options of both programs."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--upcr", type=Path, default=data.ROOT / "target" / "release" / "upcr", help="the binary")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=1, help="runs of each pair; its time is their median")
    parser.add_argument("--sets", default=sets, help="comma-separated: " + ", ".join([*data.SETS, *data.GROUPS]))
    parser.add_argument("--limit", type=int, help="first pairs of each set only")
    parser.add_argument("--cache", type=Path, default=data.CACHE, help="where the pairs are written")
    parser.add_argument("--cold", action="store_true", help="start a process for every pair, as a user at a terminal does")
    parser.add_argument("--timeout", type=float, default=120, help="seconds for one registration")
    parser.add_argument("--markdown", action="store_true", help="tables as Markdown")
    parser.add_argument("--verbose", action="store_true", help="one line for each pair, on stderr")
    parser.add_argument("--json", type=Path, help="file for everything measured")
    return parser


def main() -> None:
    parser = arguments(__doc__.split("\n")[0], "all,disjoint")
    parser.add_argument("--args", default="", help='more arguments of `upcr register`, e.g. --args="--method fgr"')
    options = parser.parse_args()
    names = data.chosen(options.sets)
    if names and not options.upcr.is_file():
        sys.exit(f"no binary at {options.upcr}: build it with `cargo build --release`, or name it with --upcr")
    runs = {name: [] for name in names}
    for name in names:
        for pair in data.pairs(name, options.cache, options.limit):
            extra = shlex.split(options.args)
            runs[name].append(register(options.upcr, pair, options.threads, extra, options.repeat, options.timeout, options.cold))
            if options.verbose:
                print(line(runs[name][-1]), file=sys.stderr, flush=True)
    if not names:
        return
    sums = [summary(name, runs[name]) for name in names]
    print(f"{version(options.upcr)} {options.args}".strip() + f"; {machine(options.threads)}\n")
    print(report(sums, options.markdown))
    if options.json:
        result = {"machine": machine(options.threads), "upcr": version(options.upcr), "args": options.args, "sets": sums}
        result["runs"] = {name: [asdict(r) for r in runs[name]] for name in names}
        save(options.json, result)


if __name__ == "__main__":
    main()
