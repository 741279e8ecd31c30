"""The commands `cgf describe`, `cgf match` and `cgf register`: the viewer's computations, to files."""

import argparse
import json
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cgf.cli.common import (
    FAILED,
    add_feature_options,
    add_loading_options,
    add_matching_options,
    feature_settings,
    note,
    progress_bar,
)

if TYPE_CHECKING:
    from cgf.pipeline import PairResult, RegistrationSettings, ResolvedSettings
    from cgf.types import Features, Pair, PointCloud, Progress, RegistrationResult


def describe_options(parser: argparse.ArgumentParser) -> None:
    """Options of `cgf describe`."""
    parser.add_argument("cloud", type=Path, help="the cloud: PLY, PCD, XYZ, OBJ, STL, NPY or NPZ")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="features.npz")
    parser.add_argument(
        "--all-points", action="store_true", help="features of every point of the file, interpolated from one a voxel"
    )
    add_feature_options(parser)
    add_loading_options(parser)


def describe(options: argparse.Namespace) -> int:
    """Write the features of a cloud."""
    import numpy as np

    from cgf import io, pipeline
    from cgf.evaluation.matches import check_output, write_whole

    check_output(options.output, (".npz",))
    with progress_bar(options) as progress:
        raw = io.read_cloud(options.cloud, viewpoint=options.viewpoint, drop_invalid=options.drop_invalid)
        wanted = feature_settings(options)
        raw, _ = pipeline.correct(wanted, raw, raw)
        settings = pipeline.resolve(wanted, raw, raw)
        _note_choice(options, settings)
        if options.all_points:
            described, features = _describe_all(raw, settings, progress)
        else:
            cloud = pipeline.prepare(raw, settings)
            features = pipeline.at_dim(pipeline.describe(cloud, settings, progress=progress), settings)
            described = cloud.take(features.indices)
    arrays: dict[str, Any] = {
        "points": described.points,
        "normals": described.normals,
        "indices": features.indices,
        "features": features.vectors,
        "settings": json.dumps(asdict(settings), default=str),
    }
    if features.quality is not None:
        arrays["quality"] = features.quality
    write_whole(options.output, lambda file: np.savez_compressed(file, **arrays))
    note(
        options,
        f"Described {len(features):,} points ({len(raw):,} in the file) by {features.dim} values.",
    )
    note(options, f"Wrote {options.output}")
    return 0


def _describe_all(
    cloud: "PointCloud", settings: "ResolvedSettings", progress: "Progress | None"
) -> "tuple[PointCloud, Features]":
    """The points of the file with their features, and with the normals of the nearest described points if need be."""
    from cgf import pipeline

    features, prepared, few = pipeline.describe_all(cloud, settings, progress=progress)
    described = cloud.take(features.indices)
    if described.normals is None:
        assert prepared.normals is not None
        rows = few.indices[pipeline.nearest_described(described.points, prepared, few)]
        described = replace(described, normals=prepared.normals[rows])
    return described, features


def pair_options(parser: argparse.ArgumentParser) -> None:
    """Options of every command on two clouds."""
    parser.add_argument("source", type=Path, help="the cloud that is moved")
    parser.add_argument("target", type=Path, help="the cloud that stays")
    parser.add_argument(
        "--gt", type=Path, metavar="FILE", help="the true pose: a 4x4 that maps the source onto the target, or a gt.log"
    )
    add_feature_options(parser)
    add_matching_options(parser)
    add_loading_options(parser)


def match_options(parser: argparse.ArgumentParser) -> None:
    """Options of `cgf match`."""
    pair_options(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="matches.csv or matches.npz")


def match(options: argparse.Namespace) -> int:
    """Write the matches of two clouds."""
    import numpy as np

    from cgf.evaluation import matches, metrics

    matches.check_output(options.output)
    pair, result = _run_pair(options, register=False)
    settings = result.settings
    measured = matches.match_errors(
        result.source, result.target, result.table, target_from_source=pair.target_from_source, tau=settings.tau
    )
    matches.export_matches(options.output, result.source, result.target, result.table, result.rows, measured)
    note(options, f"{len(result.rows):,} matches of {len(result.table):,} source points with a feature.")
    if pair.target_from_source is not None:
        errors, partner = measured.errors[result.rows], measured.has_partner[result.rows]
        near = settings.precision_radius
        precision = metrics.precision(errors[partner], threshold=near)
        ratio = metrics.precision(errors, threshold=near)
        note(
            options,
            f"Precision within {near:.3g}: {_percent(precision)} of the {np.count_nonzero(partner):,} matches "
            f"whose point has a partner within {settings.tau:.3g}; inlier ratio {_percent(ratio)}.",
        )
    note(options, f"Wrote {options.output}")
    return 0


def register_options(parser: argparse.ArgumentParser) -> None:
    """Options of `cgf register`."""
    pair_options(parser)
    group = parser.add_argument_group("registration")
    group.add_argument("--method", metavar="NAME", help="ransac, fgr or icp (default: ransac)")
    group.add_argument("--inlier-distance", type=float, metavar="D", help="how near partners must come, in cloud units")
    group.add_argument("--iterations", type=int, metavar="N", help="samples of ransac or steps of the others, at most")
    group.add_argument("--no-refine", action="store_true", help="leave out the ICP that follows ransac and fgr")
    group.add_argument("--metric", choices=("plane", "point"), help="what ICP makes small (default: plane)")
    group.add_argument("--initial", type=Path, metavar="FILE", help="pose that --method icp starts from")
    group.add_argument("--seed", type=int, metavar="N", help="of the random samples (default: 0)")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="text file for the 4x4")


def register(options: argparse.Namespace) -> int:
    """Print, and write, the pose of one cloud relative to another."""
    from cgf import io
    from cgf.geometry import transforms

    wanted = _registration_settings(options)
    if wanted.method == "icp":
        pair, found = _refine_alone(options, wanted)
    else:
        pair, result = _run_pair(options, register=True, registration=wanted)
        found = result.registration
    if found is None or found.target_from_source is None:
        # The line that says so was among the warnings.
        return FAILED
    pose = found.target_from_source
    print("\n".join(" ".join(f"{value: .9g}".rjust(16) for value in row) for row in pose))
    agree = "" if wanted.method == "icp" else f", {len(found.inliers):,} correspondences agree"
    print(f"fitness {found.fitness:.4f}, rmse {found.inlier_rmse:.4g}{agree}")
    if pair.target_from_source is not None:
        turned = transforms.rotation_error_deg(pose, pair.target_from_source)
        shifted = transforms.translation_error(pose, pair.target_from_source)
        print(f"rotation error {turned:.3f} degrees, translation error {shifted:.4g}")
    if options.output is not None:
        io.write_transform(options.output, pose)
        note(options, f"Wrote {options.output}")
    return 0


def _registration_settings(options: argparse.Namespace) -> "RegistrationSettings":
    from cgf.checks import InputError
    from cgf.pipeline import RegistrationSettings

    names = ("method", "inlier_distance", "iterations", "metric")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    wanted = RegistrationSettings(refine=not options.no_refine, **given)
    if options.initial is not None and wanted.method != "icp":
        raise InputError(f"--initial must come with --method icp, got {wanted.method}, which needs no start")
    return wanted


def _refine_alone(
    options: argparse.Namespace, wanted: "RegistrationSettings"
) -> tuple["Pair", "RegistrationResult | None"]:
    """ICP needs no features, so none are computed."""
    from cgf import io, pipeline
    from cgf.matching import empty_correspondences

    with progress_bar(options) as progress:
        pair = _load_pair(options)
        initial = None
        if options.initial is not None:
            names = options.source.name, options.target.name
            initial = io.read_transform(options.initial, source_name=names[0], target_name=names[1])
        source, target = pipeline.correct(feature_settings(options), pair.source, pair.target)
        settings = pipeline.resolve(feature_settings(options), source, target)
        source = pipeline.prepare(source, settings, "source")
        target = pipeline.prepare(target, settings, "target")
        nothing = empty_correspondences()
        found = pipeline.register_pair(source, target, nothing, settings, wanted, initial=initial, progress=progress)
    if found.target_from_source is None:
        distance = wanted.inlier_distance or settings.inlier_distance
        print(
            f"Warning: Fewer than 10 source points come within {distance:.2g} of the target from this start; "
            "give a better --initial or a larger --inlier-distance",
            file=sys.stderr,
        )
    return pair, found


def _load_pair(options: argparse.Namespace) -> "Pair":
    from cgf import pipeline

    return pipeline.load_pair(
        options.source,
        options.target,
        gt=options.gt,
        viewpoint=None if options.viewpoint is None else tuple(options.viewpoint),
        drop_invalid=options.drop_invalid,
    )


def _run_pair(
    options: argparse.Namespace, *, register: bool, registration: "RegistrationSettings | None" = None
) -> tuple["Pair", "PairResult"]:
    from cgf import pipeline

    with progress_bar(options) as progress:
        pair = _load_pair(options)
        settings = feature_settings(options)
        result = pipeline.run_pair(
            pair.source, pair.target, settings, register=register, registration=registration, progress=progress
        )
    _note_choice(options, result.settings)
    for warning in result.warnings:
        print(f"Warning: {warning}", file=sys.stderr)
    return pair, result


def _note_choice(options: argparse.Namespace, settings: "ResolvedSettings") -> None:
    note(options, settings.choice.reason)
    note(
        options,
        f"Descriptor {settings.descriptor}, {settings.dim} dimensions, radius {settings.support_radius:.3g}, "
        f"voxel {settings.voxel_size:.3g}, frame radius {settings.lrf_radius:.3g}.",
    )


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
