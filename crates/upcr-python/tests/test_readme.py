"""The lines of the documents run, and the package is what it says."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, SAMPLES, bumpy

import upcr


@pytest.mark.parametrize("document", [ROOT / "README.md", ROOT / "crates/upcr-python/README.md"], ids=["root", "package"])
def test_documents(document: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = re.findall(r"^```python\n(.*?)^```", document.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert blocks
    for name in ("source.ply", "target.ply"):
        (tmp_path / name).write_bytes((SAMPLES / name).read_bytes())
    scans = tmp_path / "my-scans"
    scans.mkdir()
    for i in range(2):
        upcr.write(scans / f"{i}.ply", bumpy(300, i))
    monkeypatch.chdir(tmp_path)
    for block in blocks:
        # Learning takes hours with the defaults.
        exec(block.replace("upcr.adapt(", "upcr.adapt(epochs=1, points=64, clouds="), {"np": np})


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
