"""The command `cgf diagnose`: why two clouds do not register, in plain words."""

import argparse
import json
from typing import TYPE_CHECKING

from cgf.cli.common import feature_settings, note, progress_bar
from cgf.cli.pairs import pair_options

if TYPE_CHECKING:
    from rich.console import Console

    from cgf.diagnosis import Diagnosis, Evidence, Finding
    from cgf.pipeline import ResolvedSettings

_STYLES = {"problem": "bold red", "caution": "yellow", "fine": "green"}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `cgf diagnose`."""
    pair_options(parser)
    parser.add_argument("--json", action="store_true", help="print the diagnosis as JSON")
    parser.add_argument("--all", action="store_true", help="print what was found to be fine, too")


def run(options: argparse.Namespace) -> int:
    """Register two clouds and print what is wrong with them."""
    from cgf import pipeline
    from cgf.checks import InputError
    from cgf.diagnosis import diagnose_loaded, diagnose_result

    wanted = feature_settings(options)
    with progress_bar(options) as progress:
        pair = pipeline.load_pair(
            options.source,
            options.target,
            gt=options.gt,
            viewpoint=None if options.viewpoint is None else tuple(options.viewpoint),
            drop_invalid=options.drop_invalid,
        )
        try:
            result = pipeline.run_pair(pair.source, pair.target, wanted, register=True, progress=progress)
        except InputError as error:
            settings = None
            diagnosis = diagnose_loaded(wanted, *pipeline.correct(wanted, pair.source, pair.target), str(error))
        else:
            settings = result.settings
            if progress is not None:
                progress(1.0, "Diagnosing")
            diagnosis = diagnose_result(pair, wanted, result)
    if options.json:
        print(json.dumps(diagnosis.as_plain(), indent=1, allow_nan=False))
        return 0
    _print(diagnosis, settings, everything=options.all)
    if not options.all:
        fine = sum(finding.severity == "fine" for finding in diagnosis.findings)
        note(options, f"{fine} more checks found nothing wrong; --all shows them.")
    return 0


def _print(diagnosis: "Diagnosis", settings: "ResolvedSettings | None", *, everything: bool) -> None:
    from rich.console import Console

    console = Console(highlight=False, soft_wrap=True)
    console.print(diagnosis.verdict, style="bold")
    for finding in diagnosis.findings:
        if everything or finding.severity != "fine":
            _print_finding(console, finding, settings)


def _print_finding(console: "Console", finding: "Finding", settings: "ResolvedSettings | None") -> None:
    from rich.markup import escape

    style = _STYLES[finding.severity]
    console.print(f"\n[{style}]{finding.severity.capitalize()}[/] ({finding.stage}): {escape(finding.sentence)}")
    for item in finding.evidence:
        mark = " " if item.holds else "!"
        console.print(f"  {mark} {escape(item.name)}: {escape(evidence_text(item, settings))}", style="dim")
    if finding.remedy and finding.severity != "fine":
        options = f"  {finding.options}" if finding.options else ""
        console.print(f"  [bold]Try:[/] {escape(finding.remedy)}[cyan]{escape(options)}[/]")


def evidence_text(item: "Evidence", settings: "ResolvedSettings | None") -> str:
    """The number with its unit, and what it is judged against."""
    text = _quantity(item.value, item, settings)
    if item.threshold is not None:
        text += f" (should be {item.rule} {_quantity(item.threshold, item, settings)})"
    return f"{text}, estimated" if item.estimated else text


def _quantity(value: float | int, item: "Evidence", settings: "ResolvedSettings | None") -> str:
    if item.quantity == "share":
        return f"{100 * value:.0f} %"
    if item.quantity == "count":
        return f"{value:,.0f}"
    if item.quantity == "degrees":
        return f"{value:.0f} degrees"
    if item.quantity == "length" and settings is not None and settings.model != "indoor":
        return f"{value:.3g} ({100 * value / settings.diameter:.2g} % of the diameter)"
    return f"{value:.3g}"
