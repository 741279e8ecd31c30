"""From two clouds to correspondences and a motion: the only part that knows every stage.

The stages in order: `resolve` settings, `prepare` each cloud, `describe` each, `match_features`, filter,
`register_pair`. `run_pair` does them all; the viewer calls them one by one and keeps what has not changed, by the
keys of `ResolvedSettings`. Errors that a user can mend are `InputError`s and name the option of the command line.
"""

from cgf.descriptors.settings import MODEL_DEFAULTS
from cgf.pipeline.settings import ModelChoice, PairSettings, ResolvedSettings, choose_model, resolve
from cgf.pipeline.stages import (
    PairResult,
    at_dim,
    describe,
    filtered_rows,
    load_pair,
    match_features,
    prepare,
    register_pair,
    registration_warning,
    run_pair,
)

__all__ = [
    "MODEL_DEFAULTS",
    "ModelChoice",
    "PairResult",
    "PairSettings",
    "ResolvedSettings",
    "at_dim",
    "choose_model",
    "describe",
    "filtered_rows",
    "load_pair",
    "match_features",
    "prepare",
    "register_pair",
    "registration_warning",
    "resolve",
    "run_pair",
]
