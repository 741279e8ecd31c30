"""Compact Geometric Features: describe the surface around points, match two clouds, register them.

The stages in order, and the module of each:

1. `cgf.io` reads clouds and poses; `cgf.datasets` yields pairs of clouds, the demo among them.
2. `cgf.geometry` downsamples, estimates normals and local reference frames.
3. `cgf.descriptors` turns neighbourhoods into vectors: `cgf`, and its peers for comparison.
4. `cgf.matching` finds nearest neighbours among the vectors and filters them.
5. `cgf.registration` finds the rigid motion that correspondences agree on.
6. `cgf.pipeline` chains these with one set of settings; `run_pair` does everything.
7. `cgf.evaluation` measures correspondences and motions against true poses.
8. `cgf.diagnosis` says why two clouds do not register, and what would mend it.
9. `cgf.training` makes the weights of the network.

Names below are imported on first use, so that `import cgf` itself costs next to nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cgf.checks import InputError
    from cgf.datasets.demo import load_demo
    from cgf.descriptors import make_descriptor
    from cgf.descriptors.settings import DescriptorSettings
    from cgf.diagnosis import Diagnosis, diagnose_result
    from cgf.evaluation.matches import MatchErrors, export_matches, match_errors
    from cgf.evaluation.metrics import correspondence_errors, has_partner, precision, precision_curve
    from cgf.geometry.lrf import estimate_lrf
    from cgf.geometry.normals import estimate_normals
    from cgf.geometry.sampling import voxel_downsample
    from cgf.geometry.transforms import invert, move
    from cgf.io import read_cloud, read_transform, write_cloud, write_transform
    from cgf.matching import MatchTable, filter_rows, match
    from cgf.pipeline import (
        PairResult,
        PairSettings,
        PointInspection,
        RegistrationSettings,
        ResolvedSettings,
        describe,
        inspect_point,
        load_pair,
        match_features,
        prepare,
        register_pair,
        rejections,
        resolve,
        run_pair,
    )
    from cgf.registration import make_estimator
    from cgf.types import (
        Cancelled,
        Correspondences,
        Descriptor,
        Estimator,
        Features,
        Pair,
        PointCloud,
        RegistrationResult,
    )

_MODULES = {
    "checks": ("InputError",),
    "datasets.demo": ("load_demo",),
    "descriptors": ("make_descriptor",),
    "descriptors.settings": ("DescriptorSettings",),
    "diagnosis": ("Diagnosis", "diagnose_result"),
    "evaluation.matches": ("MatchErrors", "export_matches", "match_errors"),
    "evaluation.metrics": ("correspondence_errors", "has_partner", "precision", "precision_curve"),
    "geometry.lrf": ("estimate_lrf",),
    "geometry.normals": ("estimate_normals",),
    "geometry.sampling": ("voxel_downsample",),
    "geometry.transforms": ("invert", "move"),
    "io": ("read_cloud", "read_transform", "write_cloud", "write_transform"),
    "matching": ("MatchTable", "filter_rows", "match"),
    "pipeline": (
        "PairResult",
        "PairSettings",
        "PointInspection",
        "RegistrationSettings",
        "ResolvedSettings",
        "describe",
        "inspect_point",
        "load_pair",
        "match_features",
        "prepare",
        "register_pair",
        "rejections",
        "resolve",
        "run_pair",
    ),
    "registration": ("make_estimator",),
    "types": (
        "Cancelled",
        "Correspondences",
        "Descriptor",
        "Estimator",
        "Features",
        "Pair",
        "PointCloud",
        "RegistrationResult",
    ),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "Cancelled",
    "Correspondences",
    "Descriptor",
    "DescriptorSettings",
    "Diagnosis",
    "Estimator",
    "Features",
    "InputError",
    "MatchErrors",
    "MatchTable",
    "Pair",
    "PairResult",
    "PairSettings",
    "PointCloud",
    "PointInspection",
    "RegistrationResult",
    "RegistrationSettings",
    "ResolvedSettings",
    "correspondence_errors",
    "describe",
    "diagnose_result",
    "estimate_lrf",
    "estimate_normals",
    "export_matches",
    "filter_rows",
    "has_partner",
    "inspect_point",
    "invert",
    "load_demo",
    "load_pair",
    "make_descriptor",
    "make_estimator",
    "match",
    "match_errors",
    "match_features",
    "move",
    "precision",
    "precision_curve",
    "prepare",
    "read_cloud",
    "read_transform",
    "register_pair",
    "rejections",
    "resolve",
    "run_pair",
    "voxel_downsample",
    "write_cloud",
    "write_transform",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'cgf' has no attribute {name!r}")
    value = getattr(import_module(f"cgf.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
