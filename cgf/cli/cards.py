"""What the card of weights says of their making, as options of `cgf train`."""

import os
import shlex
from argparse import Namespace
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NoReturn

from cgf.cli.common import Parser


def options_of_card(card: Path, add_options: Callable[[Parser], None]) -> Namespace:
    """The options that make the weights of `card` again; folders are names, as they are in the card.

    Args:
        card: JSON file beside the weights.
        add_options: Declares the options of `cgf train`.

    Raises:
        InputError: There is no such card, or it does not say how the weights were made.
    """
    from cgf.checks import InputError
    from cgf.descriptors.network import NetworkCard

    if not card.is_file():
        raise InputError(f"--config must be a card written by cgf train, got no file {card}")
    content = NetworkCard.from_json(card.read_text("utf-8"), source=str(card))
    words = list(_words(content.config)) if content.config else shlex.split(content.command)[2:]
    if not words:
        raise InputError(f"--config must say how its weights were made, got {card} without config and command")
    parser = _CardParser(card)
    add_options(parser)
    options = parser.parse_args([*words, "--output", content.model])
    # Older cards keep them only here.
    for name in ("support_radius", "min_radius", "histogram"):
        if getattr(options, name) is None:
            setattr(options, name, getattr(content, name))
    return options


def find_folders(names: Sequence[str], root: Path, *, option: str) -> list[Path]:
    """The one folder of each of `names` that lies beneath `root`, at any depth.

    Raises:
        InputError: There is none, or more than one; the sentence tells to give `option` instead.
    """
    from cgf.checks import InputError

    if not root.is_dir():
        raise InputError(f"--data-root must be a folder, got {root}")
    found: dict[str, list[Path]] = {name: [] for name in names}
    if root.resolve().name in found:
        found[root.resolve().name].append(root)
    for folder, below, _ in os.walk(root):
        below[:] = sorted(name for name in below if not name.startswith("."))
        for name in below:
            if name in found:
                found[name].append(Path(folder, name))
    for name, places in found.items():
        if not places:
            raise InputError(f"--data-root must hold a folder {name}, got none beneath {root}; or give {option}")
        if len(places) > 1:
            raise InputError(
                f"--data-root must hold one folder {name}, got {places[0]} and {places[1]}; or give {option}"
            )
    return [found[name][0] for name in names]


def _words(config: dict[str, object]) -> Iterable[str]:
    """The settings of a card as somebody would type them; None is the default."""
    for name, value in config.items():
        if value not in (None, []):
            yield f"--{name.replace('_', '-')}"
            yield from map(str, value if isinstance(value, list) else [value])


class _CardParser(Parser):
    def __init__(self, card: Path) -> None:
        super().__init__(prog="cgf train", add_help=False, allow_abbrev=False)
        self._card = card

    def error(self, message: str) -> NoReturn:
        from cgf.checks import InputError

        raise InputError(f"{self._card} must say how its weights were made, got a card with: {message}")
