"""Ctrl-C, and Python's other threads, while a call is under way."""

import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from conftest import bumpy

import upcr

# Each prints a line when its long call begins.
LONG = {
    "register": "upcr.register(big, moved, voxel_size=0.002, threads=1, progress=begun)",
    "register_batch": "print(flush=True); upcr.register_batch([(big, moved)] * 20, voxel_size=0.002)",
    "merge": "upcr.merge([big, moved, big[::2]], voxel_size=0.002, threads=1, progress=begun)",
    "features": "print(flush=True); upcr.features.pfh(big, k=60, threads=1)",
    "adapt": "print(flush=True); upcr.adapt([big[:5000]] * 30, epochs=500)",
}
SCRIPT = """
import sys, time
import numpy as np
import upcr
big = np.random.default_rng(0).normal(size=(1_500_000, 3))
big /= np.linalg.norm(big, axis=1, keepdims=True)
big *= 1 + 0.2 * np.sin(4 * big[:, :1]) + 0.1 * np.cos(7 * big[:, 1:2])
moved = big @ np.linalg.qr(np.arange(9).reshape(3, 3) ** 2 + np.eye(3))[0]
first = []
def begun(at):
    if not first:
        first.append(at)
        print(flush=True)
try:
    {call}
except KeyboardInterrupt:
    print(time.time(), flush=True)
    sys.exit(130)
sys.exit("not interrupted")
"""


@pytest.mark.parametrize("call", LONG)
def test_interruption(call: str) -> None:
    script = SCRIPT.format(call=LONG[call])
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        # Beyond the copying of the clouds.
        time.sleep(0.7)
        assert process.poll() is None, "the call was too short"
        signaled = time.time()
        process.send_signal(signal.SIGINT)
        caught = float(process.stdout.readline())
        assert process.wait(timeout=20) == 130
    # A tenth of a second for the call, and as much for a loaded machine to run the process at all.
    assert caught - signaled < 0.2


def test_other_threads_run_meanwhile() -> None:
    cloud = bumpy(200_000)
    beats: list[float] = []
    over = threading.Event()

    def beat() -> None:
        while not over.is_set():
            beats.append(time.perf_counter())
            time.sleep(0.001)

    thread = threading.Thread(target=beat)
    thread.start()
    start = time.perf_counter()
    upcr.register(cloud, cloud)
    seconds = time.perf_counter() - start
    over.set()
    thread.join()
    during = [b for b in beats if b >= start]
    assert len(during) > 5
    assert max(np.diff(during)) < max(0.1, 0.3 * seconds)


def test_calls_side_by_side() -> None:
    cloud = bumpy(3000)
    alone = upcr.register(cloud, cloud[::-1].copy())
    found: list[upcr.Registration] = []

    def work() -> None:
        found.append(upcr.register(cloud, cloud[::-1].copy()))

    threads = [threading.Thread(target=work) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 6
    assert all(one.T_target_source.tobytes() == alone.T_target_source.tobytes() for one in found)
