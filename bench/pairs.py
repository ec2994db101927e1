"""Named sets of cloud pairs with known poses.

A pose takes source to target, y = R x + t, as a 4x4 matrix. Every random choice is seeded by the pair's
index and its set's name alone, so every method sees the same pairs, in any order.

Run as a program to write the pairs as PLY files and list them.
"""

import argparse
import os
import sys
import tempfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("UPCR_DATA") or ROOT.parent / "shared" / "data")
CACHE = Path(tempfile.gettempdir()) / "upcr-bench"


@dataclass(frozen=True)
class Tolerance:
    """When a pose counts as right. The translation error is the displacement of the source's centroid."""

    rotation: float  # degrees
    centroid: float  # the clouds' unit


@dataclass
class Pair:
    """Two clouds, exactly as the written files hold them (float32 values), and the true pose."""

    name: str
    source: np.ndarray  # (N, 3) float64
    target: np.ndarray  # (M, 3) float64
    T_target_source: np.ndarray | None  # None: there is no right pose
    tolerance: Tolerance
    files: tuple[Path, Path] | None = field(default=None)

    def __post_init__(self):
        self.source = self.source.astype(np.float32).astype(np.float64)
        self.target = self.target.astype(np.float32).astype(np.float64)

    def write(self, folder: Path) -> "Pair":
        """Writes both clouds as PLY below `folder` and remembers where."""
        stem = self.name.replace("/", "_")
        self.files = (folder / f"{stem}.source.ply", folder / f"{stem}.target.ply")
        for path, points in zip(self.files, (self.source, self.target)):
            write_ply(path, points)
        return self


# ---- poses


def rigid(R=np.eye(3), t=(0.0, 0.0, 0.0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def inverse(T: np.ndarray) -> np.ndarray:
    R = T[:3, :3].T
    return rigid(R, -R @ T[:3, 3])


def orthonormal(T: np.ndarray) -> np.ndarray:
    """The pose with the nearest true rotation: pose files print rounded numbers."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    return rigid(U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt, T[:3, 3])


def apply(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Uniform on SO(3), from a uniform unit quaternion."""
    w, x, y, z = (q := rng.standard_normal(4)) / np.linalg.norm(q)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])


def axis_rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rotation by `angle` radians about `axis` (Rodrigues)."""
    x, y, z = axis / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def rotation_angle(R: np.ndarray) -> float:
    """Geodesic angle in degrees, exact for small angles too."""
    sine = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    return float(np.degrees(np.arctan2(sine, np.trace(R) - 1)))


@dataclass(frozen=True)
class PoseError:
    rotation: float  # geodesic, degrees
    centroid: float  # |T_est c - T_true c| at the source's centroid c: does not depend on where the origin is
    translation: float  # |t_est - t_true|

    def within(self, tolerance: Tolerance) -> bool:
        return bool(self.rotation < tolerance.rotation and self.centroid < tolerance.centroid)


def pose_error(pair: Pair, T: np.ndarray) -> PoseError:
    truth = pair.T_target_source
    c = pair.source.mean(axis=0)
    return PoseError(
        rotation_angle(T[:3, :3] @ truth[:3, :3].T),
        float(np.linalg.norm(apply(T, c) - apply(truth, c))),
        float(np.linalg.norm(T[:3, 3] - truth[:3, 3])),
    )


def seeded(*key) -> np.random.Generator:
    """A random stream of its own for each key, the same on every machine and Python."""
    return np.random.default_rng([zlib.crc32(k.encode()) if isinstance(k, str) else k for k in key])


def turned(name: str, source, target, T, tolerance: Tolerance, shift: float = 0.0) -> Pair:
    """The pair with its source turned about the origin by any rotation, then moved by up to `shift` per axis."""
    rng = seeded("turned", name)
    Q = rigid(random_rotation(rng), rng.uniform(-shift, shift, 3))
    return Pair(name, apply(Q, source), target, T @ inverse(Q), tolerance)


# ---- files


def write_ply(path: Path, points: np.ndarray) -> None:
    """Binary little-endian PLY of float32 x, y, z; appears whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    part = path.with_name(f"{path.name}.{os.getpid()}")
    part.write_bytes(header.encode() + points.astype("<f4").tobytes())
    part.replace(path)


def read_ply(path: Path) -> np.ndarray:
    """x, y, z of a binary little-endian PLY whose vertices come first and hold scalars only."""
    types = {
        "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2",
        "ushort": "<u2", "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4",
        "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8",
    }  # fmt: skip
    raw = path.read_bytes()
    header, mark = raw.partition(b"end_header\n")[:2]
    count, element, columns = 0, None, []
    for words in (line.split() for line in header.decode("ascii").splitlines()):
        match words:
            case ["format", kind, _] if kind != "binary_little_endian":
                raise ValueError(f"{path}: {kind} is not read here")
            case ["element", element, n]:
                count = int(n) if element == "vertex" else count
            case ["property", kind, label] if element == "vertex":
                columns.append((label, types[kind]))
    rows = np.frombuffer(raw, np.dtype(columns), count, len(header) + len(mark))
    return np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)


def read_pose(path: Path) -> np.ndarray:
    return orthonormal(np.loadtxt(path))


@cache
def kitchen_frame(frame: int) -> np.ndarray:
    """A depth image (mm; 0 and 65535: nothing seen) as points in the camera's frame, metres."""
    from PIL import Image

    K = np.loadtxt(DATA / "redkitchen" / "camera-intrinsics.txt")
    with Image.open(DATA / "redkitchen" / f"frame-{frame:06d}.depth.png") as image:
        depth = np.asarray(image, dtype=np.uint16)
    v, u = np.nonzero((depth != 0) & (depth != 65535))
    z = depth[v, u] / 1000.0
    return np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], axis=1)


@cache
def shapes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """The first `count` test shapes, (count, 2048, 3), and their labels."""
    import h5py

    folder = DATA / "shapes69"
    clouds, labels, have = [], [], 0
    for line in (folder / "test_files.txt").read_text().split():
        with h5py.File(folder / Path(line).name) as file:
            clouds.append(file["data"][: count - have].astype(np.float64))
            labels.append(file["label"][: count - have].ravel())
        have += len(clouds[-1])
        if have == count:
            break
    return np.concatenate(clouds), np.concatenate(labels)


# ---- sets

BUNNY = Tolerance(1.0, 0.001)
FRAGMENTS = Tolerance(3.0, 0.10)
DRIVING = Tolerance(0.3, 0.10)
SHAPES = Tolerance(5.0, np.inf)
INDOOR = Tolerance(5.0, 0.10)
SHAPE_COUNT = 100


def bunny() -> Iterator[Pair]:
    folder = DATA / "stanford_bunny"
    for names in ("000 045", "000 315", "045 090", "270 315", "180 270", "000 top3", "000 chin"):
        a, b = names.split()
        files = [f if not f.isdigit() else f"bun{f}" for f in (a, b)]
        P = [read_pose(folder / f"{f}.pose.txt") for f in files]
        source, target = (read_ply(folder / f"{f}.ply") for f in files)
        yield turned(f"bunny/{a}-{b}", source, target, inverse(P[1]) @ P[0], BUNNY)


def fragments() -> Iterator[Pair]:
    for name in ("redkitchen_0_5", "hotel3_8_15"):
        folder = DATA / "3dmatch" / name
        source, target = read_ply(folder / "source.ply"), read_ply(folder / "target.ply")
        yield turned(f"3dmatch/{name}", source, target, read_pose(folder / "T_target_source.txt"), FRAGMENTS)


def kitti() -> Iterator[Pair]:
    folder = DATA / "kitti00"
    for a, b in ((0, 1), (0, 3), (0, 5), (1, 4), (2, 5)):
        P = [read_pose(folder / f"{i:06d}.pose.txt") for i in (a, b)]
        source, target = (np.fromfile(folder / f"{i:06d}.bin", "<f4").reshape(-1, 4)[:, :3] for i in (a, b))
        yield turned(f"kitti/{a}-{b}", source, target, inverse(P[1]) @ P[0], DRIVING)


def kitchen(step: int) -> Iterator[Pair]:
    for a in range(0, 1000, 100):
        P = [read_pose(DATA / "redkitchen" / f"frame-{i:06d}.pose.txt") for i in (a, a + step)]
        T = inverse(P[1]) @ P[0]
        yield turned(f"redkitchen/{a}-{a + step}", kitchen_frame(a), kitchen_frame(a + step), T, INDOOR)


def nearest(points: np.ndarray, viewpoint: np.ndarray, count: int = 768) -> np.ndarray:
    """The `count` points nearest to the viewpoint, in their order."""
    kept = np.argsort(np.linalg.norm(points - viewpoint, axis=1), kind="stable")[:count]
    return points[np.sort(kept)]


def far(rng: np.random.Generator) -> np.ndarray:
    """A viewpoint in a random direction, 500 away."""
    direction = rng.standard_normal(3)
    return 500.0 * direction / np.linalg.norm(direction)


def shape_pair(protocol: str, index: int, shape: np.ndarray) -> Pair:
    """One synthetic pair. Noise is drawn apart for the two clouds; crops are made in each cloud's own frame."""
    rng = seeded("shapes", protocol, index)
    angles, t = rng.uniform(0, np.pi / 4, 3), rng.uniform(-0.5, 0.5, 3)
    Rx, Ry, Rz = (axis_rotation(axis, angle) for axis, angle in zip(np.eye(3), angles))
    T = rigid(Rx @ Ry @ Rz, t)
    source, target = rng.permutation(shape[:1024]), rng.permutation(apply(T, shape[:1024]))
    if protocol.endswith("nd"):
        source, target = (p + rng.normal(0, 0.01, p.shape).clip(-0.05, 0.05) for p in (source, target))
    if protocol.startswith("partial"):
        viewpoint = far(rng)
        source, target = nearest(source, viewpoint), nearest(target, viewpoint)
    elif protocol.startswith("independent"):
        source, target = nearest(source, far(rng)), nearest(target, far(rng))
    return Pair(f"shapes-{protocol}/{index:03d}", source, target, T, SHAPES)


def shape_set(protocol: str) -> Iterator[Pair]:
    for index, shape in enumerate(shapes(SHAPE_COUNT)[0]):
        yield shape_pair(protocol, index, shape)


def disjoint() -> Iterator[Pair]:
    """Clouds of different places or things at the same scale: whatever pose is found, none is right."""

    def pair(name, source, target):
        P = turned(f"disjoint/{name}", source, target, np.eye(4), Tolerance(0.0, 0.0))
        P.T_target_source = None
        return P

    # Each block needs one data set only besides the fragments, and is left out where that is absent.
    if (folder := DATA / "3dmatch").is_dir():
        room = {
            f"{scene}.{side}": read_ply(folder / name / f"{side}.ply")
            for scene, name in (("kitchen", "redkitchen_0_5"), ("hotel", "hotel3_8_15"))
            for side in ("source", "target")
        }
        for a in room:
            for b in room:
                if a.split(".")[0] != b.split(".")[0]:
                    yield pair(f"{a}-{b}", room[a], room[b])
        if (DATA / "redkitchen").is_dir():
            for frame in (0, 200, 400, 600, 800):
                yield pair(f"frame{frame}-hotel", kitchen_frame(frame), room["hotel.target"])
    if (DATA / "shapes69").is_dir():
        clouds, labels = shapes(SHAPE_COUNT)
        rng = seeded("disjoint shapes")
        for n in range(20):
            a, b = rng.choice(SHAPE_COUNT, 2, replace=False)
            while labels[a] == labels[b]:
                a, b = rng.choice(SHAPE_COUNT, 2, replace=False)
            yield pair(f"shape{a}-shape{b}", clouds[a][:1024], clouds[b][:1024])
        if (folder := DATA / "stanford_bunny").is_dir():
            for scan, index in (("bun000", 0), ("bun090", 7), ("bun180", 21), ("top3", 42)):
                cloud = read_ply(folder / f"{scan}.ply")
                shape = clouds[index] * np.linalg.norm(np.std(cloud, axis=0)) / np.linalg.norm(np.std(clouds[index], axis=0))
                yield pair(f"{scan}-shape{index}", cloud, shape)


PROTOCOLS = ("consistent", "nd", "partial", "partial_nd", "independent", "independent_nd")
# name -> (folders of the data it needs, generator)
SETS = {
    **{f"shapes-{p}": (["shapes69"], lambda p=p: shape_set(p)) for p in PROTOCOLS},
    "bunny": (["stanford_bunny"], bunny),
    "3dmatch": (["3dmatch"], fragments),
    **{f"redkitchen-{n}": (["redkitchen"], lambda n=n: kitchen(n)) for n in (20, 40, 60)},
    "kitti": (["kitti00"], kitti),
    "disjoint": ([], disjoint),
}
GROUPS = {
    "shapes": [s for s in SETS if s.startswith("shapes-")],
    "redkitchen": [s for s in SETS if s.startswith("redkitchen-")],
    "all": [s for s in SETS if s != "disjoint"],
}


def chosen(names: str) -> list[str]:
    """Set names of a comma-separated list in which groups may stand; what lacks its data is said and left out."""
    wanted = []
    for name in names.split(","):
        if name not in SETS and name not in GROUPS:
            sys.exit(f"no set is called {name!r}; there are {', '.join([*SETS, *GROUPS])}")
        wanted += [s for s in GROUPS.get(name, [name]) if s not in wanted]
    if not DATA.is_dir():
        print(f"no data at {DATA} (set UPCR_DATA): nothing to do", file=sys.stderr)
        return []
    present = []
    for name in wanted:
        absent = [f for f in SETS[name][0] if not (DATA / f).is_dir()]
        if absent:
            print(f"skipped: {name}, {DATA / absent[0]} is absent", file=sys.stderr)
        else:
            present.append(name)
    return present


def pairs(name: str, folder: Path | None = CACHE, limit: int | None = None) -> Iterator[Pair]:
    """The pairs of a set, made one by one; written below `folder` unless it is None."""
    for count, pair in enumerate(SETS[name][1]()):
        if limit is not None and count >= limit:
            break
        yield pair.write(folder / name) if folder else pair


def main() -> None:
    parser = argparse.ArgumentParser(description="Write the pairs as PLY files, with T_target_source beside each.")
    parser.add_argument("--sets", default="all", help="comma-separated: " + ", ".join([*SETS, *GROUPS]))
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--limit", type=int)
    options = parser.parse_args()
    for name in chosen(options.sets):
        for pair in pairs(name, options.cache, options.limit):
            source, target = pair.files
            if pair.T_target_source is not None:
                np.savetxt(source.with_name(source.name.replace(".source.ply", ".truth.txt")), pair.T_target_source)
            print(f"{pair.name:32} {len(pair.source):7} {len(pair.target):7}  {source}")


if __name__ == "__main__":
    main()
