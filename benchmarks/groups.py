"""The rows of the table: each group measures the project and its peers on the same input."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks import inputs, pcl
from benchmarks.timing import Timing, run_alone, timing_of

INSTALL_PEERS = "uv sync --inexact --group bench"


@dataclass(frozen=True)
class Plan:
    """What a run measures on, and how thoroughly."""

    data: Path | None
    cache: Path
    quick: bool
    repeats: int
    points: int
    """Points that the project describes at a time."""
    features: int
    """Features on either side of a search."""
    sizes: tuple[int, ...]


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    name: str
    unit: str
    timing: Timing | None
    """None where a peer is absent, or the row is no time of its own."""
    ratio: float | None = None
    """How much better the project is; for rows of the project, what the row's name says."""
    reach: float | None = None
    """What the ratio should at least be."""
    note: str = ""
    ours: bool = False
    by_clock: bool = False
    """Whether the ratio and the time shown are by the clock, as where threads are compared."""

    @property
    def seconds(self) -> float | None:
        if self.timing is None:
            return None
        return min(self.timing.wall) if self.by_clock else self.timing.best


@dataclass(frozen=True)
class Group:
    """Rows that belong together."""

    key: str
    title: str
    rows: list[Row] = field(default_factory=list)


def describing(plan: Plan) -> Group:
    """Frame, histogram and network beside other descriptors, and one thread beside two."""
    scan = inputs.load_scan(plan.data)
    one = run_alone("describe", threads=1, data=plan.data, points=plan.points, repeats=plan.repeats)
    two = run_alone("describe", threads=2, data=plan.data, points=plan.points, repeats=plan.repeats)
    ours, shared = timing_of(one, "time"), timing_of(two, "time")
    unit = "s / 1,000 points"
    note = f"{one['points']:,} points, in {one['precision']}"
    rows = [Row("32 dimensions, 1 thread", unit, ours, note=note, ours=True)]
    # Few points of the slow ones: their times are shares of a run that nobody would wait for.
    peers = {
        "spin": ("Spin Images (PCL)", 1000, 2.0),
        "shot": ("SHOT 352 (PCL)", 1000, 5.0),
        "fpfh": ("FPFH (PCL)", 300, 1.0),
        "rops": ("RoPS (PCL), mesh not counted", 300, 1.0),
        "usc": ("USC 1960 (PCL)", 40, 200.0),
        "pfh": ("PFH (PCL)", 3, 1.0),
    }
    counts = {key: max(count // 10, 1) if plan.quick else count for key, (_, count, _) in peers.items()}
    timings = _pcl_describe(plan, scan, counts)
    for key, (name, _, reach) in peers.items():
        rows.append(_peer(name, unit, timings.get(key), ours, reach, f"{counts[key]} points", scale=1000))
    if not plan.quick:
        result = run_alone("open3d_fpfh", threads=1, data=plan.data, repeats=plan.repeats)
        timing = timing_of(result, "time") if "time" in result else None
        absent = f"absent; {result.get('absent')}"
        rows.append(_peer("FPFH (Open3D)", unit, timing, ours, 1.0, "all points", absent=absent))
    rows.append(
        Row(
            "32 dimensions, 2 threads, by the clock",
            unit,
            shared,
            min(ours.wall) / min(shared.wall),
            1.9,
            "times as fast as 1 thread",
            ours=True,
            by_clock=True,
        )
    )
    return Group("describing", f"Describing, support of 17 %, {scan.name}", rows)


def histogram(plan: Plan) -> Group:
    """Frame and histogram beside only finding the neighbours, and beside the formula."""
    scan = inputs.load_scan(plan.data)
    result = run_alone("histogram", threads=1, data=plan.data, points=min(plan.points, 4000), repeats=plan.repeats)
    ours, unit = timing_of(result, "time"), "s / 1,000 points"
    found = _pcl_describe(plan, scan, {"search": 100 if plan.quick else 2000})
    loop, search = timing_of(result, "loop"), timing_of(result, "search")
    whole = Timing(
        tuple(value + search.best for value in loop.cpu), tuple(value + min(search.wall) for value in loop.wall)
    )
    note = (
        f"{result['neighbors']:,.0f} neighbours, of which {result['differing']:.2f} in another bin than by the formula"
    )
    rows = [
        Row("this project", unit, ours, note=note, ours=True),
        _peer("radius search alone (PCL)", unit, found.get("search"), ours, 1.0, "", scale=1000),
        _peer("straight loop with log, acos, atan2", unit, loop, ours, 10.0, "its neighbours and frames given"),
        _peer("the same and its search (SciPy)", unit, whole, ours, None, "frames given"),
    ]
    return Group("histogram", f"Frame and histogram, 1 thread, {scan.name}", rows)


def neighbors(plan: Plan) -> Group:
    """Exact nearest neighbours among real features."""
    unit, rows = "us / query", []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "features.npz"
        made = run_alone("features", threads=2, data=plan.data, points=plan.features, output=file)
        times: dict[int, float] = {}
        for dim in (32,) if plan.quick else (32, 16, 8):
            rows += _neighbors_of(plan, file, dim, unit, times)
    title = f"Nearest neighbours, 1 thread, {made['source']:,} x {made['target']:,} features of {made['name']}"
    return Group("neighbors", title, rows)


def _neighbors_of(plan: Plan, file: Path, dim: int, unit: str, times: dict[int, float]) -> list[Row]:
    options = {"file": file, "dim": dim, "repeats": plan.repeats}
    result = run_alone("match", threads=1, **options)
    ours = timing_of(result, "time")
    times[dim] = ours.best
    checked = f"{result['right']} of {result['checked']} checked are right"
    rows = [
        Row(
            f"{dim} dimensions: both directions, two nearest",
            unit,
            ours,
            None if dim == 32 else times[32] / ours.best,
            None if dim == 32 else 1.0,
            checked if dim == 32 else f"times as fast as 32; {checked}",
            ours=True,
        )
    ]
    tree = _flann_tree(plan, file, dim)
    rows.append(
        _peer(f"{dim}: FLANN, one k-d tree", unit, tree, ours, 8.0 if dim == 32 else 1.0, "2,000 queries", scale=1e6)
    )
    peers = {
        "faiss": ("faiss IndexFlatL2", 1 / 1.3 if dim == 32 else None),
        "numpy_product": ("NumPy, blocked product", None),
        "sklearn_brute": ("scikit-learn, brute", None),
        "scipy_tree": ("SciPy cKDTree", None),
        "hnswlib": ("hnswlib M16 ef64, approximate", None),
    }
    for case, found in run_alone("search_peers", threads=1, **options).items():
        name, reach = peers[case]
        if "absent" in found:
            rows.append(Row(f"{dim}: {name}", unit, None, reach=reach, note=f"absent; {INSTALL_PEERS}"))
            continue
        note = f"{found['queries']:,} queries; {found['right']} of {found['checked']} checked are right"
        rows.append(_peer(f"{dim}: {name}", unit, timing_of(found, "time"), ours, reach, note))
    return rows


def dense(plan: Plan) -> Group:
    """Two dense clouds: every point, beside only the voxels; and memory."""
    title = "Dense pair, 2 cm voxels, 2 threads"
    files = inputs.dense_files(plan.data)
    if files is None or plan.quick:
        reason = "not quick" if plan.quick else f"needs --data with {inputs.DENSE}"
        return Group("dense", title, [Row("redkitchen_dense", "s", None, note=reason)])
    options = {"data": plan.data, "voxel_size": 0.02}
    voxels = run_alone("dense", threads=2, **options, every_point=False)
    points = run_alone("dense", threads=2, **options, every_point=True)
    low, high = timing_of(voxels, "time"), timing_of(points, "time")
    over = points["peak"] - points["input"]
    return Group(
        "dense",
        title,
        [
            Row("described at the voxels", "s", low, note=_by_clock(low), ours=True),
            Row(
                f"all {points['points']:,} points described",
                "s",
                high,
                low.best / high.best,
                1 / 1.5,
                f"of the speed of the voxels alone; {_by_clock(high)}",
                ours=True,
            ),
            Row("peak memory of that over the input", "GB", None, over / 1e9, None, "reach: below 1.5", ours=True),
        ],
    )


def sizes(plan: Plan) -> Group:
    """One scan, resampled: opening it, describing its keypoints, and choosing what is shown."""
    rows: list[Row] = []
    name = ""
    with tempfile.TemporaryDirectory() as folder:
        for count in plan.sizes:
            file = Path(folder) / f"{count}.ply"
            name = run_alone("resample", threads=2, data=plan.data, points=count, output=file)["name"]
            result = run_alone("size", threads=2, file=file)
            file.unlink()
            stages = {stage: Timing(tuple(t["cpu"]), tuple(t["wall"])) for stage, t in result["stages"].items()}
            whole = Timing(
                (sum(stage.best for stage in stages.values()),), (sum(min(stage.wall) for stage in stages.values()),)
            )
            parts = ", ".join(f"{stage} {timing.best:.2f}" for stage, timing in stages.items())
            note = f"{parts} s; {_by_clock(whole)}; {result['keypoints']:,} keypoints"
            note += f"; peak {result['peak'] / 1e9:.2f} GB"
            before = rows[-1].seconds if rows else None
            growth = None
            if before is not None:
                growth = count / plan.sizes[len(rows) - 1] / (whole.best / before)
                note = f"times as cheap a point as the size before; {note}"
            rows.append(Row(f"{count:,} points", "s", whole, growth, growth and 1.0, note, ours=True))
    return Group("sizes", f"Cost against size, 2 threads, {name}", rows)


GROUPS: dict[str, Callable[[Plan], Group]] = {
    group.__name__: group for group in (describing, histogram, neighbors, dense, sizes)
}


def _peer(
    name: str,
    unit: str,
    timing: Timing | None,
    ours: Timing,
    reach: float | None,
    note: str,
    *,
    scale: float = 1,
    absent: str = f"absent; {pcl.INSTALL}",
) -> Row:
    if timing is None:
        return Row(name, unit, None, reach=reach, note=absent)
    timing = timing.per(1 / scale)
    return Row(name, unit, timing, timing.best / ours.best, reach, note)


def _by_clock(timing: Timing) -> str:
    return f"{min(timing.wall):.1f} s by the clock"


def _pcl_describe(plan: Plan, scan: inputs.Scan, counts: dict[str, int]) -> dict[str, Timing]:
    try:
        program = pcl.build(plan.cache)
    except pcl.Absent:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scan.f32"
        normals = scan.cloud.normals
        assert normals is not None
        np.hstack([scan.cloud.points, normals]).astype(np.float32).tofile(file)
        lengths = (scan.support_radius, scan.min_radius, scan.lrf_radius)
        return pcl.run(program, "describe", file, *lengths, plan.repeats, *(f"{k}:{n}" for k, n in counts.items()))


def _flann_tree(plan: Plan, file: Path, dim: int) -> Timing | None:
    from benchmarks.cases import load_vectors

    try:
        program = pcl.build(plan.cache)
    except pcl.Absent:
        return None
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / "target.f32", Path(folder) / "source.f32"]
        for path, vectors in zip(paths, reversed(load_vectors(file, dim)), strict=True):
            vectors.tofile(path)
        return pcl.run(program, "tree", *paths, dim, plan.repeats, 2000)["tree"]
