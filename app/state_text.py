"""The settings as one line of text, which links and `--state` carry: `dim=16&mutual=true`."""

import contextlib
import json
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from typing import Any
from urllib.parse import parse_qsl, urlencode

from pydantic import ValidationError

from app.schemas import SettingsPatch, in_words
from app.settings import ViewSettings
from cgf.checks import InputError

OF_A_WINDOW = ("tab", "camera")
"""What a link carries beside the settings; the page alone knows what to do with it."""

MAX_WORD = 400
"""Letters of one setting; a longer one, such as a box of many points, is left out of the line."""


def write_state(settings: ViewSettings) -> str:
    """The settings that are not at their default, in the order of the page's controls."""
    names = [field.name for field in fields(settings) if field.name in SettingsPatch.model_fields]
    usual = ViewSettings()
    changed = {
        name: _word(getattr(settings, name)) for name in names if getattr(settings, name) != getattr(usual, name)
    }
    return urlencode({name: word for name, word in changed.items() if len(word) <= MAX_WORD}, safe=",:")


def read_state(text: str) -> dict[str, Any]:
    """The settings that `text` names, checked as if the page had sent them.

    Args:
        text: What `write_state` wrote; a whole link is understood too.

    Raises:
        InputError: A setting is unknown or its value not allowed.
    """
    named = {name: _value(word) for name, word in _words(text).items() if name not in OF_A_WINDOW}
    try:
        return SettingsPatch.model_validate(named).changes()
    except ValidationError as error:
        raise InputError(f"the state cannot be used: {in_words(error.errors())}") from error


def of_a_window(text: str) -> str:
    """The part of `text` that `read_state` leaves out."""
    return urlencode({name: word for name, word in _words(text).items() if name in OF_A_WINDOW}, safe=",")


def restored(named: Mapping[str, Any]) -> dict[str, Any]:
    """Every setting of the page: those of `named`, and the others at their default."""
    usual = ViewSettings()
    return {name: named.get(name, getattr(usual, name)) for name in SettingsPatch.model_fields}


def _words(text: str) -> dict[str, str]:
    return dict(parse_qsl(text.rpartition("#")[2].strip(), keep_blank_values=True))


def _word(value: Any) -> str:
    if value is None:
        return ""
    plain = asdict(value) if is_dataclass(value) and not isinstance(value, type) else value
    return plain if isinstance(plain, str) else json.dumps(plain, separators=(",", ":"), default=asdict)


def _value(word: str) -> Any:
    if word.startswith(("{", "[")):
        with contextlib.suppress(json.JSONDecodeError):
            return json.loads(word)
    return word or None
