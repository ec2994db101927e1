"""Unordered depth frames into one model: `upcr merge` beside Open3D's multiway pipeline, on the same frames.

Open3D's is that of its own tutorial for frames without an order: FPFH and RANSAC between every pair, point-to-plane ICP, the
information matrix of the pair, and `global_optimization` with its default pruning. Both read the same files; times are of the
whole, reading included. Errors are of the sensor's places against the published ones, after the rigid motion that fits best.
"""

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import pairs as data

VOXEL = 0.05  # Open3D is told the scale; UPCR finds its own
FOCAL, CENTER = 585.0, (320.0, 240.0)


def frames(step: int, count: int) -> list[Path]:
    folder = data.DATA / "redkitchen"
    return sorted(folder.glob("*.depth.png"))[::step][:count]


def pose(frame: Path) -> np.ndarray:
    return np.loadtxt(frame.with_name(frame.name.replace(".depth.png", ".pose.txt")))


def places_off(found: dict[int, np.ndarray], truth: list[np.ndarray]) -> np.ndarray:
    """Distance of each sensor's place from where it should be, in metres."""
    scans = sorted(found)
    a = np.array([found[i][:3, 3] for i in scans])
    b = np.array([truth[i][:3, 3] for i in scans])
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return np.linalg.norm((a - a.mean(0)) @ rotation.T - (b - b.mean(0)), axis=1)


def upcr(binary: str, files: list[Path], threads: int) -> tuple[float, dict[int, np.ndarray], str]:
    with tempfile.TemporaryDirectory() as scratch:
        start = time.perf_counter()
        run = subprocess.run(
            [binary, "merge", *map(str, files), "-o", f"{scratch}/model.ply", "--json", "--threads", str(threads)],
            capture_output=True, text=True,
        )
        seconds = time.perf_counter() - start
    if run.returncode not in (0, 3):
        sys.exit(run.stderr)
    told = json.loads(run.stdout)
    number = {path.name: i for i, path in enumerate(files)}
    found = {number[scan["name"]]: np.array(scan["T_model_scan"]) for scan in told["models"][0]}
    kept = sum(pair["kept"] for pair in told["pairs"])
    return seconds, found, f"{len(told['pairs'])} pairs registered, {kept} kept"


def open3d(files: list[Path]) -> tuple[float, dict[int, np.ndarray], str]:
    import open3d as o3d

    reg = o3d.pipelines.registration
    camera = o3d.camera.PinholeCameraIntrinsic(640, 480, FOCAL, FOCAL, *CENTER)
    start = time.perf_counter()
    clouds, features = [], []
    for file in files:
        depth = np.asarray(o3d.io.read_image(str(file))).copy()
        depth[depth == 65535] = 0
        image = o3d.geometry.Image(depth)
        cloud = o3d.geometry.PointCloud.create_from_depth_image(image, camera, depth_scale=1000.0, depth_trunc=10.0)
        cloud = cloud.voxel_down_sample(VOXEL)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * VOXEL, 30))
        cloud.orient_normals_towards_camera_location(np.zeros(3))
        clouds.append(cloud)
        features.append(reg.compute_fpfh_feature(cloud, o3d.geometry.KDTreeSearchParamHybrid(5 * VOXEL, 100)))
    graph = reg.PoseGraph()
    for _ in files:
        graph.nodes.append(reg.PoseGraphNode(np.eye(4)))
    tried = joined = 0
    fitness = {}
    for i, j in itertools.combinations(range(len(files)), 2):
        tried += 1
        rough = reg.registration_ransac_based_on_feature_matching(
            clouds[i], clouds[j], features[i], features[j], True, 1.5 * VOXEL,
            reg.TransformationEstimationPointToPoint(False), 3,
            [reg.CorrespondenceCheckerBasedOnEdgeLength(0.9), reg.CorrespondenceCheckerBasedOnDistance(1.5 * VOXEL)],
            reg.RANSACConvergenceCriteria(100_000, 0.999),
        )
        fine = reg.registration_icp(
            clouds[i], clouds[j], VOXEL, rough.transformation, reg.TransformationEstimationPointToPlane()
        )
        if fine.fitness < 0.3:
            continue
        joined += 1
        information = reg.get_information_matrix_from_point_clouds(clouds[i], clouds[j], VOXEL, fine.transformation)
        graph.edges.append(reg.PoseGraphEdge(i, j, fine.transformation, information, uncertain=True))
        fitness[i, j] = (fine.fitness, fine.transformation)
    # Begins where the best pairs lead: without an order there is no odometry to begin with.
    placed = {0}
    while True:
        ways = [(f, i, j, T) for (i, j), (f, T) in fitness.items() if (i in placed) != (j in placed)]
        if not ways:
            break
        _, i, j, T = max(ways, key=lambda way: way[0])
        if j in placed:
            graph.nodes[i].pose = graph.nodes[j].pose @ T
            placed.add(i)
        else:
            graph.nodes[j].pose = graph.nodes[i].pose @ np.linalg.inv(T)
            placed.add(j)
    option = reg.GlobalOptimizationOption(VOXEL, edge_prune_threshold=0.25, reference_node=0)
    reg.global_optimization(
        graph, reg.GlobalOptimizationLevenbergMarquardt(), reg.GlobalOptimizationConvergenceCriteria(), option
    )
    seconds = time.perf_counter() - start
    found = {i: np.asarray(graph.nodes[i].pose) for i in placed}
    return seconds, found, f"{tried} pairs registered, {joined} joined, {len(graph.edges)} kept"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--binary", default="target/release/upcr")
    parser.add_argument("--step", type=int, default=4, help="every so-many-th file; the files are every fourth frame")
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only", choices=["upcr", "open3d"])
    args = parser.parse_args()

    files = frames(args.step, args.count)
    order = np.random.default_rng(1).permutation(len(files))
    files = [files[i] for i in order]
    truth = [pose(file) for file in files]
    runs = {"upcr": lambda: upcr(args.binary, files, args.threads), "open3d": lambda: open3d(files)}
    print("| | seconds | placed | rmse m | median m | largest m | |\n| --- | ---: | ---: | ---: | ---: | ---: | --- |")
    for name, run in runs.items():
        if args.only in (None, name):
            seconds, found, said = run()
            off = places_off(found, truth)
            rmse, median, largest = np.sqrt((off**2).mean()), np.median(off), off.max()
            print(f"| {name} | {seconds:.1f} | {len(found)} of {len(files)} | {rmse:.3f} | {median:.3f} | {largest:.3f} | {said} |", flush=True)


if __name__ == "__main__":
    main()
