"""What is measured on: the benchmark data where they are, else the demo that comes with the package."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

import cgf
from cgf.types import Features, PointCloud

FGR = Path("objects/fgr_level_01/pair_01")
DENSE = Path("indoor/redkitchen_dense")
FGR_UNIT = 1.7
"""About the diameter of a whole model of that set."""


@dataclass(frozen=True, eq=False)
class Scan:
    """A cloud with normals and the lengths to describe it with: the paper's shares of the diameter."""

    name: str
    cloud: PointCloud
    diameter: float

    @property
    def support_radius(self) -> float:
        return 0.17 * self.diameter

    @property
    def min_radius(self) -> float:
        return 0.015 * self.diameter

    @property
    def lrf_radius(self) -> float:
        return 0.02 * self.diameter


def load_scan(data: Path | None) -> Scan:
    """A scan of the Fast Global Registration set, or one of the demo's."""
    if data is not None and (data / FGR).is_dir():
        return Scan("FGR pair 1, scan 0", cgf.read_cloud(data / FGR / "Depth_0000.ply"), FGR_UNIT)
    cloud = cgf.load_demo().target
    return Scan("demo (the FGR set is absent)", cloud, cloud.diameter)


def dense_files(data: Path | None) -> tuple[Path, Path] | None:
    """Two fragments of a kitchen at full density, if they are there."""
    if data is None or not (data / DENSE).is_dir():
        return None
    return data / DENSE / "cloud_bin_4.ply", data / DENSE / "cloud_bin_0.ply"


def load_features(data: Path | None, count: int) -> tuple[str, Features, Features]:
    """Real features of two fragments that overlap, `count` of each at most, in 64 dimensions or fewer."""
    from cgf import pipeline

    files = dense_files(data)
    if files is None:
        name, (source, target), voxel = "demo (the dense kitchen is absent)", _demo(), None
    else:
        name, (source, target), voxel = "redkitchen_dense at 1.8 cm", map(cgf.read_cloud, files), 0.018
    settings = pipeline.resolve(pipeline.PairSettings(model="indoor", dim=32, voxel_size=voxel), source, target)
    rng = np.random.default_rng(0)
    found = []
    for cloud in (source, target):
        prepared = pipeline.prepare(cloud, settings)
        rows = np.sort(rng.permutation(len(prepared))[:count])
        found.append(describer(settings).describe(prepared, rows))
    return name, found[0], found[1]


def save_features(file: Path, source: Features, target: Features) -> None:
    np.savez(file, source=source.vectors, target=target.vectors)


def describer(lengths: object, *, dim: int = 32, model: str = "indoor") -> cgf.Descriptor:
    """The project's descriptor with the lengths that `lengths` has."""
    from cgf.descriptors import DescriptorSettings, make_descriptor

    names = ("support_radius", "min_radius", "lrf_radius")
    radii = {name: getattr(lengths, name) for name in names}
    return make_descriptor("cgf", DescriptorSettings(**radii, dim=dim, model=model))  # type: ignore[arg-type]


def resample(cloud: PointCloud, count: int) -> PointCloud:
    """So many points of the surface: some of the cloud's, or more, each on a line to a neighbour."""
    from scipy.spatial import cKDTree

    rng = np.random.default_rng(0)
    rows = rng.permutation(len(cloud))[:count]
    if count > len(cloud):
        more = rng.integers(len(cloud), size=count - len(cloud))
        rows = np.concatenate([rows, more])
        neighbors = cKDTree(cloud.points).query(cloud.points, k=4)[1][more, rng.integers(1, 4, size=len(more))]
        steps = rng.uniform(size=(len(more), 1))
        points = cloud.points[rows]
        points[len(cloud) :] += steps * (cloud.points[neighbors] - cloud.points[more])
    else:
        points = cloud.points[rows]
    return PointCloud(points, None if cloud.normals is None else cloud.normals[rows], name=cloud.name)


def _demo() -> tuple[PointCloud, PointCloud]:
    pair = cgf.load_demo()
    return pair.source, pair.target
