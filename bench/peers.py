"""UPCR beside Open3D and small_gicp: same pairs, same run, same threads, taking turns pair by pair.

Times are medians over the pairs. Reading files is in none of them: the peers get their points in memory, in their
own containers; UPCR's are its own `timings_ms`. Each peer runs once, untimed, before a set; UPCR starts as a new
process each time, which its `timings_ms` do not show.
"""

import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

import evaluate
import pairs as data
from evaluate import median, number, table
from pairs import Pair

TABLES = ("register", "refine", "features")


def limit_threads(threads: int) -> None:
    """OpenMP, TBB and BLAS read these when they are loaded, so before Open3D is; UPCR inherits the processors."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "TBB_NUM_THREADS", "RAYON_NUM_THREADS"):
        os.environ[name] = str(threads)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])


# ---- Open3D's feature matching


@dataclass(frozen=True)
class Chain:
    """What Open3D's chain is told, in the clouds' unit."""

    voxel: float  # the scale of all else; also the grid's cell, unless `whole`
    fine: float  # grid cell of the cloud that is refined; 0: all points
    whole: bool = False  # features on all points
    toward: str = ""  # where normals point: "origin", from where the clouds were seen; "centroid"; "": as they come
    normal_radius: float = 2.0  # the rest in voxels
    feature_radius: float = 5.0
    distance: float = 1.5
    icp_distance: float = 1.0


# Chosen for successes first, then time. Depth frames, fragments and driving scans have a sensor at their origin.
CHAINS = {
    "shapes": Chain(voxel=0.06, fine=0.0, whole=True, toward="centroid", normal_radius=2.5, distance=1.25),
    "bunny": Chain(voxel=0.003, fine=0.0015, toward="centroid"),
    "3dmatch": Chain(voxel=0.05, fine=0.05, toward="origin"),
    "redkitchen": Chain(voxel=0.05, fine=0.05, toward="origin"),
    "kitti": Chain(voxel=0.5, fine=0.3, toward="origin"),
}


def kind(name: str) -> str:
    return name.split("-")[0]


def open3d_cloud(points: np.ndarray):
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


def open3d_register(source, target, chain: Chain) -> tuple[np.ndarray, dict[str, float]]:
    """T_target_source by FPFH, RANSAC and point-to-plane ICP, and the milliseconds of each step."""
    import open3d as o3d

    reg = o3d.pipelines.registration
    near = lambda radius, count: o3d.geometry.KDTreeSearchParamHybrid(radius * chain.voxel, count)  # noqa: E731
    o3d.utility.random.seed(0)
    clock = [time.perf_counter()]

    def prepared(cloud, cell):
        cloud = cloud.voxel_down_sample(cell) if cell else o3d.geometry.PointCloud(cloud)
        cloud.estimate_normals(near(chain.normal_radius, 30))
        if chain.toward:
            point = cloud.get_center() if chain.toward == "centroid" else np.zeros(3)
            cloud.orient_normals_towards_camera_location(point)
        return cloud

    cell = 0.0 if chain.whole else chain.voxel
    coarse = [prepared(cloud, cell) for cloud in (source, target)]
    if chain.fine == cell:
        fine = coarse
    else:
        fine = [source.voxel_down_sample(chain.fine), prepared(target, chain.fine)]
    clock.append(time.perf_counter())
    features = [reg.compute_fpfh_feature(cloud, near(chain.feature_radius, 100)) for cloud in coarse]
    clock.append(time.perf_counter())
    found = reg.registration_ransac_based_on_feature_matching(
        *coarse,
        *features,
        mutual_filter=True,
        max_correspondence_distance=chain.distance * chain.voxel,
        estimation_method=reg.TransformationEstimationPointToPoint(False),
        ransac_n=3,
        checkers=[
            reg.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            reg.CorrespondenceCheckerBasedOnDistance(chain.distance * chain.voxel),
        ],
        criteria=reg.RANSACConvergenceCriteria(100_000, 0.999),
    )
    clock.append(time.perf_counter())
    refined = reg.registration_icp(
        *fine,
        chain.icp_distance * chain.voxel,
        found.transformation,
        reg.TransformationEstimationPointToPlane(),
        reg.ICPConvergenceCriteria(max_iteration=50),
    )
    clock.append(time.perf_counter())
    steps = dict(zip(("prepare", "features", "ransac", "icp"), (np.diff(clock) * 1e3).tolist()))
    return refined.transformation, steps | {"total": (clock[-1] - clock[0]) * 1e3}


# ---- small_gicp


@dataclass(frozen=True)
class Gicp:
    """What both refinements are told, in the clouds' unit."""

    voxel: float
    reach: float  # small_gicp's maximum correspondence distance; UPCR derives its own from the voxel size


GICP = {"bunny": Gicp(0.0025, 0.015), "redkitchen": Gicp(0.05, 0.3), "kitti": Gicp(0.5, 3.0)}
TURN, SHIFT = 5.0, 0.03  # the start's error: degrees, and the centroid's displacement over the source's rms radius


def perturbed(pair: Pair) -> np.ndarray:
    """The true pose off by TURN and SHIFT at the source's centroid, in random directions."""
    rng = data.seeded("perturbed", pair.name)
    c = pair.source.mean(axis=0)
    radius = np.sqrt(((pair.source - c) ** 2).sum(axis=1).mean())
    R = data.axis_rotation(rng.standard_normal(3), np.radians(TURN))
    direction = rng.standard_normal(3)
    off = data.rigid(R, c - R @ c + SHIFT * radius * direction / np.linalg.norm(direction))
    return pair.T_target_source @ off


def small_gicp_refine(pair: Pair, start: np.ndarray, told: Gicp, threads: int) -> tuple[np.ndarray, dict[str, float]]:
    """Downsampling, covariances, trees and GICP in one call, as its users make it."""
    import small_gicp

    begin = time.perf_counter()
    result = small_gicp.align(
        pair.target,
        pair.source,
        start,
        registration_type="GICP",
        downsampling_resolution=told.voxel,
        max_correspondence_distance=told.reach,
        num_threads=threads,
        max_iterations=50,
        translation_epsilon=told.voxel * 4e-3,  # its own default's ratio to its default resolution
    )
    return result.T_target_source, {"total": (time.perf_counter() - begin) * 1e3}


# ---- taking turns


@dataclass
class Contestant:
    """One side of a comparison: a call from pair to pose and times, and what came of it, pair by pair."""

    name: str
    right: list[bool] = field(default_factory=list)
    errors: list = field(default_factory=list)  # None: no pose
    times: list = field(default_factory=list)  # dicts of ms; None: no pose

    def note(self, right: bool, error, times) -> None:
        self.right.append(bool(right))
        self.errors.append(error)
        self.times.append(times)

    def step(self, key: str) -> float:
        return median(t.get(key) for t in self.times if t)

    @property
    def total(self) -> float:
        return self.step("total")

    @property
    def successes(self) -> str:
        return f"{sum(self.right)}/{len(self.right)}" if self.right else "–"

    def error(self, name: str) -> float:
        return median(getattr(e, name) for e in self.errors if e)

    def figures(self) -> dict:
        steps = dict.fromkeys(key for t in self.times if t for key in t)
        return {
            "right": sum(self.right),
            "of": len(self.right),
            "rotation_deg": self.error("rotation"),
            "centroid": self.error("centroid"),
            "ms": {key: self.step(key) for key in steps},
            "pairs": [
                {"right": r, "error": asdict(e) if e else None, "ms": t}
                for r, e, t in zip(self.right, self.errors, self.times)
            ],
        }


def peer_turn(side: Contestant, pair: Pair, turn: Callable[[], tuple[np.ndarray, dict]], repeat: int, verbose: bool) -> None:
    """Runs a peer `repeat` times; a peer that raises has no pose for this pair."""
    try:
        answers = [turn() for _ in range(repeat)]
        error = data.pose_error(pair, np.asarray(answers[0][0]))
        times = {key: median(a[1][key] for a in answers) for key in answers[0][1]}
        side.note(error.within(pair.tolerance), error, times)
    except RuntimeError as reason:
        side.note(False, None, None)
        print(f"{side.name}, {pair.name}: {reason}", file=sys.stderr)
        return
    if verbose:
        mark = "ok " if side.right[-1] else "BAD"
        steps = " ".join(f"{k} {v:.1f}" for k, v in times.items())
        print(f"{mark} {side.name:10} {pair.name:28} {error.rotation:8.3f}° centroid {error.centroid:.5f} {steps}", file=sys.stderr)


def upcr_turn(side: Contestant, pair: Pair, options, extra: list[str] = []) -> None:
    if not options.upcr:
        return
    run = evaluate.register(options.upcr, pair, options.threads, extra, options.repeat, options.timeout, options.cold)
    side.note(run.right, run.error, run.timings_ms)
    if options.verbose:
        print(evaluate.line(run), file=sys.stderr, flush=True)


def compare_register(name: str, options) -> tuple[Contestant, Contestant]:
    """Open3D's chain and UPCR's default, from the clouds alone."""
    chain = CHAINS[kind(name)]
    peer, ours = Contestant("Open3D"), Contestant("UPCR")
    for pair in data.pairs(name, options.cache, options.limit):
        clouds = open3d_cloud(pair.source), open3d_cloud(pair.target)
        if not peer.right:
            open3d_register(*clouds, chain)
        peer_turn(peer, pair, lambda: open3d_register(*clouds, chain), options.repeat, options.verbose)
        upcr_turn(ours, pair, options)
    return peer, ours


def compare_refine(name: str, options) -> tuple[Contestant, Contestant]:
    """small_gicp and UPCR's GICP, from the same perturbed truth on the same scale."""
    told = GICP[kind(name)]
    peer, ours = Contestant("small_gicp"), Contestant("UPCR")
    for pair in data.pairs(name, options.cache, options.limit):
        start = perturbed(pair)
        init = pair.files[0].with_name(pair.files[0].name.replace(".source.ply", ".start.txt"))
        np.savetxt(init, start, fmt="%.17g")
        if not peer.right:
            small_gicp_refine(pair, start, told, options.threads)
        peer_turn(peer, pair, lambda: small_gicp_refine(pair, start, told, options.threads), options.repeat, options.verbose)
        extra = ["--method", "prior", "--init", str(init), "--refine", "gicp", "--voxel-size", repr(told.voxel)]
        upcr_turn(ours, pair, options, extra)
    return peer, ours


# ---- features

FEATURE_NEIGHBORS = 100
FEATURE_RUNS = 15  # UPCR starts a process each time: a few milliseconds wait for whatever else the machine does
FEATURE_VOXELS = {"bunny": 0.0025, "3dmatch": 0.05, "redkitchen": 0.05, "kitti": 0.3}


def open3d_features(cloud, param) -> float:
    """Milliseconds of FPFH; normals are given."""
    import open3d as o3d

    begin = time.perf_counter()
    o3d.pipelines.registration.compute_fpfh_feature(cloud, param)
    return (time.perf_counter() - begin) * 1e3


def upcr_features(path: Path, feature: str, k: int, options) -> float:
    """Milliseconds of UPCR's neighbours and feature, which is what Open3D's call does; normals are left out."""
    if not options.upcr:
        return float("nan")
    command = [str(options.upcr), "features", str(path), "--kind", feature, "-k", str(k), "--json"]
    time.sleep(0.05)  # the peer's threads spin for some milliseconds after a call, longer than a small cloud takes
    status, answer, message, _ = evaluate.call(command, options.threads, options.timeout)
    try:
        return float(answer["timings_ms"]["neighbors"] + answer["timings_ms"]["feature"])
    except (KeyError, TypeError) as reason:
        print(f"{' '.join(command)}: {message or repr(reason)}", file=sys.stderr)
        return float("nan")


def compare_features(names: list[str], options) -> list[dict]:
    """The same points through both, `repeat` times (at least FEATURE_RUNS), taking turns."""
    import open3d as o3d

    repeat, rows = max(FEATURE_RUNS, options.repeat), []

    def row(name: str, points: np.ndarray, radius: float | None, feature: str, k: int) -> None:
        path = options.cache / "features" / f"{name}.ply"
        data.write_ply(path, points)
        times = {"knn": [], "radius": [], "upcr": []}
        if feature == "fpfh":
            cloud = open3d_cloud(points.astype(np.float32).astype(np.float64))
            cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(30))
        for _ in range(repeat):
            if feature == "fpfh":
                times["knn"].append(open3d_features(cloud, o3d.geometry.KDTreeSearchParamKNN(k)))
                if radius:
                    times["radius"].append(open3d_features(cloud, o3d.geometry.KDTreeSearchParamHybrid(radius, k)))
            if not np.isnan(times["upcr"][:1]).any():  # what failed once is not asked again
                times["upcr"].append(upcr_features(path, feature, k, options))
        rows.append({"cloud": name, "points": len(points), "feature": feature, "k": k})
        rows[-1] |= {key: median(v) for key, v in times.items()}

    for name in dict.fromkeys(kind(n) for n in names):
        first = next(n for n in names if kind(n) == name)
        if name in FEATURE_VOXELS:
            voxel, target = FEATURE_VOXELS[name], next(data.pairs(first, None, 1)).target
            target = np.asarray(open3d_cloud(target).voxel_down_sample(voxel).points)
            row(name, target, 5 * voxel, "fpfh", FEATURE_NEIGHBORS)
        elif name == "shapes":
            for feature in ("fpfh", "spfh", "pfh"):
                row(name, data.shapes(1)[0][0][:1024], None, feature, 24)
    return rows


# ---- the program


def pose_table(results: dict[str, tuple[Contestant, Contestant]], markdown: bool) -> str:
    peer = next(iter(results.values()))[0].name
    head = ["set", f"{peer} ms", "UPCR ms", "ratio", f"{peer} right", "UPCR right"]
    head += [f"{peer} rot °", "UPCR rot °", f"{peer} centroid", "UPCR centroid"]
    rows = [
        [name, number(a.total), number(b.total), number(a.total / b.total, 2), a.successes, b.successes]
        + [number(s.error(e), 2) for e in ("rotation", "centroid") for s in (a, b)]
        for name, (a, b) in results.items()
    ]
    return table(head, rows, markdown)


def feature_table(rows: list[dict], markdown: bool) -> str:
    head = ["cloud", "points", "feature", "k", "Open3D ms", "Open3D radius ms", "UPCR ms", "ratio"]
    lines = [
        [r["cloud"], str(r["points"]), r["feature"], str(r["k"])]
        + [number(r[key]) for key in ("knn", "radius", "upcr")]
        + [number(r["knn"] / r["upcr"], 2)]
        for r in rows
    ]
    return table(head, lines, markdown)


def main() -> None:
    parser = evaluate.arguments(__doc__.split("\n")[0], "all")
    parser.add_argument("--tables", default=",".join(TABLES), help="comma-separated: " + ", ".join(TABLES))
    options = parser.parse_args()
    tables = options.tables.split(",")
    if unknown := set(tables) - set(TABLES):
        sys.exit(f"no table is called {', '.join(unknown)}; there are {', '.join(TABLES)}")
    names = [n for n in data.chosen(options.sets) if n != "disjoint"]
    if not names:
        return
    if not options.upcr.is_file():
        print(f"no binary at {options.upcr}: the peers run alone", file=sys.stderr)
        options.upcr = None
    limit_threads(options.threads)
    import open3d as o3d

    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    from importlib.metadata import version

    versions = [f"Open3D {version('open3d')}", f"small_gicp {version('small_gicp')}"]
    versions = [evaluate.version(options.upcr) if options.upcr else "no upcr", *versions]
    about = f"{', '.join(versions)}; {evaluate.machine(options.threads)}"
    if hasattr(os, "getloadavg") and (load := os.getloadavg()[0]) > 0.5:
        about += f"; load {load:.1f} at the start"
        print("other work is running: times will be too long, more so the more threads a step uses", file=sys.stderr)
    print(about, flush=True)
    measured = {"about": about}
    for title, wanted, compare, able in (
        ("register", "From the clouds alone", compare_register, CHAINS),
        ("refine", f"GICP from the truth off by {TURN:g}° and {SHIFT:.0%} of the rms radius", compare_refine, GICP),
    ):
        results = {n: compare(n, options) for n in names if title in tables and kind(n) in able}
        if results:
            print(f"\n{wanted}\n\n{pose_table(results, options.markdown)}", flush=True)
            measured[title] = {n: {s.name: s.figures() for s in sides} for n, sides in results.items()}
    if "features" in tables and (rows := compare_features(names, options)):
        print(f"\nFeatures, neighbours included, normals given\n\n{feature_table(rows, options.markdown)}")
        measured["features"] = rows
    if options.json:
        evaluate.save(options.json, measured)


if __name__ == "__main__":
    main()
