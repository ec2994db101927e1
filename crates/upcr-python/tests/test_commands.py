"""``python -m upcr`` and the script ``upcr``."""

import json
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

import numpy as np
from conftest import SAMPLES, bumpy

import upcr

FILES = [str(SAMPLES / "source.ply"), str(SAMPLES / "target.ply")]


def run(*args: str, program: tuple[str, ...] = (sys.executable, "-m", "upcr")) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*program, *args], capture_output=True, text=True, check=False)


def test_the_same_answer_as_the_library(found: upcr.Registration) -> None:
    done = run("register", *FILES, "--json")
    assert done.returncode == 0 and done.stderr == ""
    told = json.loads(done.stdout)
    assert np.array(told["T_target_source"]).tobytes() == found.T_target_source.tobytes()
    assert told["probability"] == found.probability and told["settings"] == found.settings
    one = run("register", *FILES, "--json", "--no-times", "--threads", "1")
    assert one.returncode == 0 and json.loads(one.stdout)["T_target_source"] == told["T_target_source"]


def test_the_script() -> None:
    script = shutil.which("upcr", path=sysconfig.get_path("scripts"))
    assert script is not None
    done = run("--version", program=(script,))
    assert done.returncode == 0 and done.stdout == f"upcr {upcr.__version__}\n"
    assert "Usage: upcr register" in run("register", "--help", program=(script,)).stdout


def test_exit_statuses(tmp_path: Path) -> None:
    assert run().returncode == 2
    unknown = run("register", *FILES, "--magic")
    assert unknown.returncode == 2 and unknown.stdout == "" and "--magic" in unknown.stderr
    missing = run("info", "nowhere.ply")
    assert missing.returncode == 1 and missing.stderr.startswith("error: nowhere.ply")
    for i in range(2):
        x, y = np.random.default_rng(i).uniform(size=(2, 2000))
        upcr.write(tmp_path / f"{i}.ply", np.stack([x, y, 0 * x], 1))
    assert run("register", *(str(tmp_path / f"{i}.ply") for i in range(2))).returncode == 3


def test_interruption(tmp_path: Path) -> None:
    upcr.write(tmp_path / "a.npy", bumpy(1_000_000))
    args = [sys.executable, "-m", "upcr", "features", str(tmp_path / "a.npy"), "--kind", "pfh", "-k", "60"]
    with subprocess.Popen(args, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        time.sleep(1)
        assert process.poll() is None, "the command was too short"
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=1) == -signal.SIGINT
