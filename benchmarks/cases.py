"""What `timing.run_alone` runs: each case reads its options as JSON and writes what it measured.

`python -m benchmarks.cases CASE < options.json`; a library that is not installed is reported, not raised.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import inputs
from benchmarks.timing import measure, measure_cold, peak_bytes

Result = dict[str, Any]
CHECKED = 500
"""Queries whose result is compared with brute force in double precision."""


def describe(data: Path | None, points: int, repeats: int, **_: object) -> Result:
    """Frame, histogram and network, for points spread over a scan."""
    from cgf.descriptors.precision import chosen_precision

    scan = inputs.load_scan(data)
    rows = spread(len(scan.cloud), points)
    descriptor = inputs.describer(scan, model="object")
    timing = measure(lambda: descriptor.describe(scan.cloud, rows), repeats)
    return {"time": asdict(timing.per(len(rows) / 1000)), "points": len(rows), "precision": chosen_precision()}


def histogram(data: Path | None, points: int, repeats: int, **_: object) -> Result:
    """Frame and histogram; and the histogram by its formula."""
    from benchmarks.straight import find_neighbors, straight_histograms
    from cgf.descriptors.spherical_histogram import histogram_grid
    from cgf.geometry.lrf import estimate_lrf

    scan = inputs.load_scan(data)
    cloud = scan.cloud
    rows = spread(len(cloud), points)
    normals = cloud.normals
    assert normals is not None

    def compute() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        frames, defined = estimate_lrf(cloud.points, normals, rows, radius=scan.lrf_radius)
        centers = cloud.points[rows[defined]]
        grid = histogram_grid(cloud.points, support_radius=scan.support_radius, min_radius=scan.min_radius)
        return grid.histograms(centers, frames[defined])[0], centers, frames[defined]

    ours = measure(compute, repeats)
    result, centers, frames = compute()
    neighbors, starts = find_neighbors(cloud.points, centers, scan.support_radius)
    arguments = (cloud.points, centers, frames, neighbors, starts, scan.support_radius, scan.min_radius)
    straight = straight_histograms(*arguments)
    # Single precision may put a neighbour into the next bin.
    differing = np.abs(result - straight).sum(axis=1) / 2 * np.diff(starts)
    loop = measure(lambda: straight_histograms(*arguments), repeats)
    search = measure_cold(lambda: find_neighbors(cloud.points, centers, scan.support_radius), 1)
    return {
        "time": asdict(ours.per(len(rows) / 1000)),
        "loop": asdict(loop.per(len(rows) / 1000)),
        "search": asdict(search.per(len(rows) / 1000)),
        "neighbors": float(np.diff(starts).mean()),
        "differing": float(differing.mean()),
    }


def open3d_fpfh(data: Path | None, repeats: int, **_: object) -> Result:
    """Open3D describes all points of a cloud, or none."""
    from cgf.io import import_open3d

    open3d = import_open3d()
    scan = inputs.load_scan(data)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(scan.cloud.points))
    cloud.normals = open3d.utility.Vector3dVector(scan.cloud.normals)
    near = open3d.geometry.KDTreeSearchParamRadius(scan.support_radius)
    timing = measure_cold(lambda: open3d.pipelines.registration.compute_fpfh_feature(cloud, near), min(repeats, 2))
    return {"time": asdict(timing.per(len(scan.cloud) / 1000))}


def features(data: Path | None, points: int, output: Path, **_: object) -> Result:
    """Write the features that neighbours are searched among."""
    name, source, target = inputs.load_features(data, points)
    inputs.save_features(output, source, target)
    return {"name": name, "source": len(source), "target": len(target)}


def match(file: Path, dim: int, repeats: int, **_: object) -> Result:
    """Both directions and the second nearest, as the viewer needs them; checked against brute force."""
    from cgf.matching import match
    from cgf.types import Features

    source, target = load_vectors(file, dim)
    clouds = [Features(np.arange(len(vectors)), vectors, "cgf") for vectors in (source, target)]
    timing = measure(lambda: match(*clouds), repeats)
    table = match(*clouds)
    back = match(*clouds[::-1]).correspondences.indices[:, 1]
    found = table.correspondences.indices[:, 1]
    rows = spread(len(source), CHECKED)
    right = sum(int(found[row] == brute_nearest(source[row], target)) for row in rows)
    mutual = bool(np.array_equal(table.mutual, back[found] == np.arange(len(source))))
    return {"time": asdict(timing.per(len(source) / 1e6)), "checked": len(rows), "right": right, "mutual": mutual}


def search_peers(file: Path, dim: int, repeats: int, **_: object) -> Result:
    """What other libraries take for one direction, by their names; those that are not installed say so."""
    source, target = load_vectors(file, dim)
    results: Result = {}
    for peer in (faiss, numpy_product, sklearn_brute, scipy_tree, hnswlib):
        try:
            search, queries = peer(source, target)
        except ImportError as error:
            results[peer.__name__] = {"absent": str(error)}
            continue
        timing = measure(search, repeats)
        found = search()
        rows = spread(queries, CHECKED)
        results[peer.__name__] = {
            "time": asdict(timing.per(queries / 1e6)),
            "queries": queries,
            "checked": len(rows),
            "right": sum(int(found[row] == brute_nearest(source[row], target)) for row in rows),
        }
    return results


Search = Callable[[], np.ndarray]
"""Gives the nearest target of each query."""


def faiss(source: np.ndarray, target: np.ndarray) -> tuple[Search, int]:
    import faiss

    index = faiss.IndexFlatL2(target.shape[1])
    index.add(target)
    return lambda: index.search(source, 1)[1][:, 0], len(source)


def numpy_product(source: np.ndarray, target: np.ndarray) -> tuple[Search, int]:
    half_sq = np.square(target).sum(axis=1) / 2
    blocks = [source[start : start + 256] for start in range(0, len(source), 256)]
    return lambda: np.concatenate([(block @ target.T - half_sq).argmax(axis=1) for block in blocks]), len(source)


def sklearn_brute(source: np.ndarray, target: np.ndarray) -> tuple[Search, int]:
    from sklearn.neighbors import NearestNeighbors

    index, some = NearestNeighbors(n_neighbors=1, algorithm="brute").fit(target), source[:4000]
    return lambda: index.kneighbors(some)[1][:, 0], len(some)


def scipy_tree(source: np.ndarray, target: np.ndarray) -> tuple[Search, int]:
    from scipy.spatial import cKDTree

    index, some = cKDTree(target), source[:1000]
    return lambda: index.query(some)[1], len(some)


def hnswlib(source: np.ndarray, target: np.ndarray) -> tuple[Search, int]:
    import hnswlib

    index = hnswlib.Index(space="l2", dim=target.shape[1])
    index.init_index(len(target), ef_construction=200, M=16)
    index.add_items(target, num_threads=1)
    index.set_ef(64)
    return lambda: index.knn_query(source, k=1, num_threads=1)[0][:, 0], len(source)


def dense(data: Path | None, voxel_size: float, every_point: bool, **_: object) -> Result:
    """Describe two dense clouds once, at their voxels or everywhere."""
    import cgf
    from cgf import pipeline

    files = inputs.dense_files(data)
    assert files is not None
    source, target = map(cgf.read_cloud, files)
    settings = pipeline.resolve(pipeline.PairSettings(model="indoor", voxel_size=voxel_size), source, target)
    warm_up()

    def work() -> None:
        for cloud in (source, target):
            if every_point:
                pipeline.describe_all(cloud, settings)
            else:
                pipeline.describe(pipeline.prepare(cloud, settings), settings)

    timing = measure_cold(work, 1)
    size = source.points.nbytes + target.points.nbytes
    return {"time": asdict(timing), "points": len(source) + len(target), "input": size, "peak": peak_bytes()}


def resample(data: Path | None, points: int, output: Path, **_: object) -> Result:
    """Write a scan with any number of points."""
    import cgf

    files = inputs.dense_files(data)
    cloud = inputs.load_scan(data).cloud if files is None else cgf.read_cloud(files[1])
    cgf.write_cloud(output, inputs.resample(cloud, points))
    return {"name": "redkitchen_dense, fragment 0" if files else inputs.load_scan(data).name}


def size(file: Path, **_: object) -> Result:
    """Open a cloud, describe its keypoints, and give each point that is shown a colour."""
    import cgf
    from app.shown import choose_shown
    from cgf import pipeline

    warm_up()
    before = peak_bytes()
    state: dict[str, Any] = {}

    def read() -> None:
        state["cloud"] = cgf.read_cloud(file)

    def prepare() -> None:
        cloud = state["cloud"]
        state["settings"] = pipeline.resolve(pipeline.PairSettings(), cloud, cloud)
        state["prepared"] = pipeline.prepare(cloud, state["settings"])

    def describe() -> None:
        pipeline.describe(state["prepared"], state["settings"])

    def show() -> None:
        choose_shown(state["cloud"], state["prepared"])

    stages = {stage.__name__: asdict(measure_cold(stage, 1)) for stage in (read, prepare, describe, show)}
    return {"stages": stages, "keypoints": len(state["prepared"]), "before": before, "peak": peak_bytes()}


CASES: dict[str, Callable[..., Result]] = {
    case.__name__: case
    for case in (
        describe,
        histogram,
        open3d_fpfh,
        features,
        match,
        search_peers,
        dense,
        resample,
        size,
    )
}


def spread(count: int, wanted: int) -> np.ndarray:
    """So many rows of `count`, evenly, at most all."""
    return np.unique(np.linspace(0, count - 1, min(wanted, count)).astype(np.int64))


def load_vectors(file: Path, dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Features in `dim` dimensions: prefixes, of unit length again."""
    from cgf.descriptors.network import unit_rows

    with np.load(file) as arrays:
        source, target = (unit_rows(np.ascontiguousarray(arrays[key][:, :dim])) for key in ("source", "target"))
    return source, target


def brute_nearest(query: np.ndarray, target: np.ndarray) -> int:
    return int(np.square(query.astype(np.float64) - target.astype(np.float64)).sum(axis=1).argmin())


def warm_up() -> None:
    """Compile what will be timed once only."""
    import cgf

    pair = cgf.load_demo()
    cgf.run_pair(pair.source, pair.target, cgf.PairSettings())


def main() -> None:
    options = json.load(sys.stdin)
    paths = {key: Path(options[key]) for key in ("data", "file", "output") if options.get(key)}
    try:
        result = CASES[sys.argv[1]](**{**options, **paths})
    except ImportError as error:
        result = {"absent": str(error)}
    print(json.dumps(result))


if __name__ == "__main__":
    main()
