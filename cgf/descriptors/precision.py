"""In which numbers the network computes."""

import os
from typing import Literal

from cgf.descriptors.amx import has_tiles
from cgf.descriptors.vnni import has_bytes

Precision = Literal["bfloat16", "int8", "float32"]


def chosen_precision() -> Precision:
    """The quickest that this processor has, or what `CGF_PRECISION` says.

    Raises:
        ValueError: `CGF_PRECISION` names none of them, or one that this processor lacks.
    """
    has: dict[Precision, bool] = {"bfloat16": has_tiles(), "int8": has_bytes(), "float32": True}
    available = [precision for precision, is_there in has.items() if is_there]
    wanted = os.environ.get("CGF_PRECISION", "")
    if wanted not in ("", *has):
        raise ValueError(f"CGF_PRECISION must be bfloat16, int8 or float32, got {wanted}")
    for precision in available:
        if wanted in ("", precision):
            return precision
    raise ValueError(
        f"CGF_PRECISION must be what this processor multiplies ({' or '.join(available)}), got {wanted}; "
        "leave it out for the quickest"
    )
