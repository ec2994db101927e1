"""The code in the documents runs, and prints what they say it prints.

In a page of the guide every fenced block is one of these, and is run or checked as such:

- ``python``: run in order, in one namespace a page; where Open3D or Ray cannot be imported, up to the first that names it.
- ``sh``: run by bash, ended by the first command that fails. A last line ``... # exit status 3`` says how.
- ``output``: what the block before it prints: words alike, numbers nearly, ``…`` standing for anything.
- ``text``, ``console``: not run; nor ``{eval-rst}``, which is Sphinx's to check.

Of the READMEs the ``python`` blocks are run. Each page has a folder of its own with the sample pair, ``my-scans`` with a
few clouds, and ``depth.png``, a wall at 1.5 m. Learning and fitting, which take minutes to hours, are cut short.
"""

import contextlib
import io
import os
import re
import shutil
import struct
import subprocess
import sysconfig
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from conftest import ROOT, SAMPLES, bumpy

import upcr

READMES = [ROOT / "README.md", ROOT / "crates/upcr-python/README.md"]
PAGES = [page for page in sorted((ROOT / "docs/guide").glob("*.md")) if "```" in page.read_text(encoding="utf-8")]
LANGUAGES = {"python", "sh", "output", "text", "console", "{eval-rst}"}
SHORT = {"epochs": 1, "points": 64}
SHORT_COMMANDS = {"upcr adapt ": "--epochs 1 --points 64 ", "upcr calibrate fit ": "--pairs 30 --scenes 0 "}
LEFT_OUT = "left out"
NUMBER = r"-?\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?"


@dataclass(frozen=True)
class Block:
    """A fenced block of a document."""

    document: Path
    line: int
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.document.name}, line {self.line}"


def blocks(document: Path) -> list[Block]:
    text = document.read_text(encoding="utf-8")
    found = [
        Block(document, text.count("\n", 0, fence.start()) + 2, fence[1], fence[2])
        for fence in re.finditer(r"^```(\S*)[^\n]*\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    ]
    assert 2 * len(found) == len(re.findall(r"^[ >]*(?:```|~~~)", text, re.MULTILINE)), f"{document}: a block is overlooked"
    return found


@pytest.fixture(autouse=True)
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that a page is run in."""
    shutil.copytree(SAMPLES, tmp_path / "samples")
    for name in ("source.ply", "target.ply"):
        shutil.copy(SAMPLES / name, tmp_path)
    (tmp_path / "my-scans").mkdir()
    for i in range(3):
        upcr.write(tmp_path / "my-scans" / f"{i}.ply", bumpy(300, i))
    depth = np.full((60, 80), 1500, ">u2")  # millimetres
    (tmp_path / "depth.png").write_bytes(png(depth))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", sysconfig.get_path("scripts") + os.pathsep + os.environ["PATH"])
    adapt = upcr.adapt
    monkeypatch.setattr(upcr, "adapt", lambda *given, **options: adapt(*given, **{**SHORT, **options}))
    return tmp_path


def png(grey: npt.NDArray[np.uint16]) -> bytes:
    """A PNG file of big-endian 16-bit grey values, rows and columns."""
    height, width = grey.shape
    rows = b"".join(b"\0" + row.tobytes() for row in grey)  # none of them filtered
    chunks = (b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )


def run_python(block: Block, namespace: dict[str, Any]) -> str:
    """Runs the block; returns what it prints. The lines of a traceback are the document's."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile("\n" * (block.line - 1) + block.text, str(block.document), "exec"), namespace)
    return printed.getvalue()


def run_sh(block: Block) -> str:
    script = block.text
    for command, options in SHORT_COMMANDS.items():
        script = script.replace(command, command + options)
    told = re.search(r"# exit status (\d+)[^\n]*\s*\Z", script)
    done = subprocess.run(["bash", "-euo", "pipefail", "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == (int(told[1]) if told else 0), f"{block}: status {done.returncode}\n{done.stderr}"
    return done.stdout


def agree(told: str, printed: str) -> bool:
    """Whether the words are alike, and numbers differ by no more than 1 %, or 2 in the last place told."""
    parts = re.split(rf"(…|{NUMBER})", " ".join(told.split()))
    numbers = parts[1::2]
    pattern = "".join(
        re.escape(part) if i % 2 == 0 else ".*?" if part == "…" else f"({NUMBER})" for i, part in enumerate(parts)
    )
    match = re.fullmatch(pattern, " ".join(printed.split()))

    def near(a: str, b: str) -> bool:
        decimals = len(a.partition("e")[0].partition(".")[2])
        x, y = float(a.replace(",", "")), float(b.replace(",", ""))
        return abs(x - y) <= max(0.01 * abs(x), 0 if "e" in a else 2 * 10.0**-decimals if decimals else 0)

    return match is not None and all(map(near, [n for n in numbers if n != "…"], match.groups()))


def run(document: Path, languages: set[str]) -> Iterator[str]:
    """Runs a document's blocks of these languages; yields those that were left out for want of a package."""
    namespace: dict[str, Any] = {"__name__": "__main__"}
    printed: str | None = None
    runs = True
    for block in blocks(document):
        match block.language:
            case language if language not in languages:
                continue
            case "python" if not (runs := runs and not any(name in block.text for name in missing())):
                printed = LEFT_OUT
                yield str(block)
            case "python":
                printed = run_python(block, namespace)
            case "sh":
                printed = run_sh(block)
            case "output":
                assert printed is not None, f"{block}: no code stands before this output"
                assert printed is LEFT_OUT or agree(block.text, printed), f"{block}: what is printed is\n{printed}"
                printed = None
            case _:
                printed = None


@cache
def missing() -> list[str]:
    """Words for packages that pages use where they are there, and are not."""
    found = []
    for word, package in {"open3d": "open3d", "upcr.ray": "ray"}.items():
        try:
            import_module(package)
        except ImportError:
            found.append(word)
    return found


@pytest.mark.parametrize("document", READMES, ids=["root", "package"])
def test_readmes(document: Path) -> None:
    assert any(block.language == "python" for block in blocks(document))
    assert list(run(document, {"python"})) == []


@pytest.mark.parametrize("document", PAGES, ids=lambda page: page.stem)
def test_guide(document: Path) -> None:
    strange = [f"{block}: {block.language!r}" for block in blocks(document) if block.language not in LANGUAGES]
    assert strange == [], f"there is no way to check these; there are {sorted(LANGUAGES)}"
    if skipped := list(run(document, LANGUAGES)):
        pytest.skip(f"{missing()} cannot be imported; run but for {len(skipped)} blocks, from {skipped[0]} on")


@pytest.mark.parametrize(
    "page",
    [
        "```python\n1 / 0\n```\n",
        "```python\na = 1\n```\n```python\nassert a == 2\n```\n",
        "```python\nprint('rmse 0.50')\n```\n```output\nrmse 0.55\n```\n",
        "```python\nprint('a')\n```\n```output\nb\n```\n",
        "```output\nfrom nowhere\n```\n",
        "```sh\nfalse\ntrue\n```\n",
        "```sh\nupcr register source.ply target.ply  # exit status 3\n```\n",
        "```sh\nupcr register --magic\n```\n",
        "- in a list\n  ```python\n  1 / 0\n  ```\n",
    ],
)
def test_a_false_page_fails(page: str, scratch: Path) -> None:
    (scratch / "page.md").write_text(page, encoding="utf-8")
    with pytest.raises((AssertionError, ZeroDivisionError)):
        list(run(scratch / "page.md", LANGUAGES))


def test_what_agrees() -> None:
    assert agree("pose  1.000 -0.5\ntime … ms", "pose 1.001 -0.5009\n  time 17.2 ms\n")
    assert agree("8,308 points", "8,308 points") and not agree("8,308 points", "8,508 points")
    assert not agree("voxel 0.0016", "voxel 0.0026") and not agree("rmse 2.7e-07", "rmse 3.7e-07")
    assert not agree("one", "one two")
