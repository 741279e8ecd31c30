"""From two clouds to correspondences and a motion: the only part that knows every stage.

The stages in order: `correct` the clouds, `resolve` settings, `prepare` each cloud, `describe` each, `match_features`,
filter, `register_pair`. `run_pair` does them all; the viewer calls them one by one and keeps what has not changed, by
the keys of `ResolvedSettings`. `inspect_point` and `rejections` look into what came out. Errors that a user can mend
are `InputError`s and name the option of the command line.
"""

from cgf.descriptors.settings import MODEL_DEFAULTS
from cgf.pipeline.cache import DiskCache, describe_cached, feature_key, match_both_cached, match_key
from cgf.pipeline.dense import describe_all, interpolate, nearest_described
from cgf.pipeline.inspection import (
    ALIKE,
    PointInspection,
    Side,
    Surroundings,
    best_turn,
    far_modes,
    inspect_point,
    shell_edges,
    uses_frames,
)
from cgf.pipeline.registering import RegistrationSettings, register_pair, registration_warning
from cgf.pipeline.rejection import REJECTIONS, Rejection, rejections
from cgf.pipeline.settings import (
    METRES,
    Corrections,
    ModelChoice,
    PairSettings,
    ResolvedSettings,
    Unit,
    choose_model,
    correct,
    resolve,
)
from cgf.pipeline.stages import (
    PairResult,
    at_dim,
    describe,
    filtered_rows,
    load_pair,
    match_both_features,
    match_features,
    prepare,
    run_pair,
)

__all__ = [
    "ALIKE",
    "METRES",
    "MODEL_DEFAULTS",
    "REJECTIONS",
    "Corrections",
    "DiskCache",
    "ModelChoice",
    "PairResult",
    "PairSettings",
    "PointInspection",
    "RegistrationSettings",
    "Rejection",
    "ResolvedSettings",
    "Side",
    "Surroundings",
    "Unit",
    "at_dim",
    "best_turn",
    "choose_model",
    "correct",
    "describe",
    "describe_all",
    "describe_cached",
    "far_modes",
    "feature_key",
    "filtered_rows",
    "inspect_point",
    "interpolate",
    "load_pair",
    "match_both_cached",
    "match_both_features",
    "match_features",
    "match_key",
    "nearest_described",
    "prepare",
    "register_pair",
    "registration_warning",
    "rejections",
    "resolve",
    "run_pair",
    "shell_edges",
    "uses_frames",
]
