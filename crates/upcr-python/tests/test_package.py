"""The package is what it says."""

import subprocess
import sys

import upcr


def test_import_is_quick() -> None:
    script = (
        "import numpy, time; start = time.perf_counter(); import upcr; print(time.perf_counter() - start); "
        "import sys; print(sorted({'html', 'open3d', 'tempfile', 'typing_extensions'} & set(sys.modules)))"
    )
    times = []
    for _ in range(5):
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
        times.append(float(done.stdout.split()[0]))
    assert min(times) < 0.1, times


def test_all_is_there() -> None:
    described = [getattr(upcr, name) for name in upcr.__all__ if name not in ("CloudLike", "TRUSTWORTHY", "__version__")]
    assert all(one.__doc__ for one in described)
    assert 0 < upcr.TRUSTWORTHY < 1
