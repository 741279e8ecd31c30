"""From a case to a diagnosis."""

from dataclasses import replace

from cgf.diagnosis import remedies, rules
from cgf.diagnosis.case import Case
from cgf.diagnosis.findings import Diagnosis, Finding, Stage
from cgf.diagnosis.measures import Measures, take_measures
from cgf.pipeline import PairResult, PairSettings
from cgf.types import IsCancelled, Pair, Progress

_SEVERITIES = ("problem", "caution", "fine")
_STAGES: dict[Stage, str] = {
    "input": "the input",
    "overlap": "the overlap",
    "radius": "the radius",
    "features": "the features",
    "matching": "the matching",
    "estimator": "the estimator",
}


def diagnose(case: Case, *, progress: Progress | None = None, cancelled: IsCancelled | None = None) -> Diagnosis:
    """Find out why two clouds did not register, or that they did.

    Args:
        case: The pair after matching and registration.
        progress: Told the share done.
        cancelled: Asked between parts whether to give up.

    Returns:
        The findings; remedies that concern the input or the radius were tried on a sample of the points.

    Raises:
        Cancelled: `cancelled` returned True.
    """
    measured = take_measures(
        case,
        progress=None if progress is None else lambda share, text: progress(0.5 * share, text),
        cancelled=cancelled,
    )
    if progress is not None:
        progress(0.5, "Trying remedies")
    if remedies.suggestions(measured):
        measured = replace(measured, trials=remedies.seek(measured, cancelled=cancelled))
    findings = rules.judge(measured)
    found = tuple(sorted(findings, key=lambda finding: _SEVERITIES.index(finding.severity)))
    return Diagnosis(
        outcome=measured.outcome,
        verdict=_verdict(measured, found),
        is_judged_by_truth=case.truth is not None,
        findings=found,
        places=rules.places(measured, findings),
        pose=measured.pose,
    )


def diagnose_result(
    pair: Pair,
    settings: PairSettings,
    result: PairResult,
    *,
    progress: Progress | None = None,
    cancelled: IsCancelled | None = None,
) -> Diagnosis:
    """Diagnose what `cgf.run_pair` computed for `pair` with `settings`; see `diagnose`."""
    return diagnose(Case.of_result(pair, settings, result), progress=progress, cancelled=cancelled)


def _verdict(measured: Measures, findings: tuple[Finding, ...]) -> str:
    outcome = measured.outcome
    problems = [finding for finding in findings if finding.severity == "problem"]
    if outcome == "registered":
        first = measured.counts[0]
        support = f"{first:,} of {len(measured.asked):,} mutual matches agree on one pose"
        if measured.case.truth is not None:
            support = f"the estimate is within {_length(measured, measured.estimate_error)} of the true pose"
        if problems:
            return f"The clouds register ({support}), but: {problems[0].sentence} {problems[0].remedy}"
        return f"Nothing wrong found: the clouds register, {support}."
    says = "It fails" if outcome == "failed" else "The estimate is not to be trusted: it fails"
    if not problems:
        return f"{says}, for no reason that was found."
    main = problems[0]
    return f"{says} at {_STAGES[main.stage]}. {main.sentence} {main.remedy}".strip()


def _length(measured: Measures, value: float) -> str:
    settings = measured.case.settings
    if settings.model == "indoor":
        metres = value * settings.unit_m
        return f"{100 * metres:.2g} cm" if metres < 1 else f"{metres:.3g} m"
    return f"{100 * value / settings.diameter:.2g} % of the diameter"
