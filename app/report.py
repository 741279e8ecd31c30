"""One HTML file with the scene, its legend and all figures, which opens anywhere without a server."""

import base64
import json
import re
import shlex
from dataclasses import asdict, replace
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from app.legend import legend_of
from app.picture import CloudPicture, Picture
from app.session import Session
from app.settings import Coloring
from app.snapshot import Snapshot
from app.state_text import write_state
from app.static_files import static_folder
from cgf.checks import InputError

MAX_POINTS = 100_000
"""Of each cloud: two such clouds make a file of about 6 MB."""
MODULES = ("lib/dom.js", "lib/format.js", "lib/plot.js", "report/scene.js", "report/report.js")
"""In an order in which each needs only those before it."""


def results_of(session: Session) -> dict[str, Any]:
    """Settings, figures and poses, ready to become JSON.

    Raises:
        InputError: There are no clouds yet.
    """
    snapshot, (analysis, _, _, _) = session.snapshot(), session.shown()
    if analysis is None:
        raise InputError("There are no results yet; wait until the clouds are loaded.")
    poses = {"ground_truth": analysis.truth, "estimate": analysis.estimate}
    content = asdict(snapshot)
    for name in ("revision", "status", "pairs", "controls", "legend"):
        del content[name]
    content["diagnosis"] = None if snapshot.diagnosis is None else session.diagnosing.plain()
    content["settings"]["weights"] = str(snapshot.settings.weights) if snapshot.settings.weights else None
    return {
        "program": f"cgf-viewer {_version()}",
        "written": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "view_command": _view_command(snapshot),
        "pair": snapshot.pairs[snapshot.settings.pair],
        "resolved": _plain(asdict(analysis.resolved)),
        "target_from_source": {name: None if pose is None else pose.tolist() for name, pose in poses.items()},
        **content,
    }


def _view_command(snapshot: Snapshot) -> str:
    """The command line that shows the same on another machine."""
    # The command opens this pair alone.
    state = write_state(replace(snapshot.settings, pair=0))
    return (
        f"{snapshot.open_command} --state {shlex.quote(state)}"
        if snapshot.open_command and state
        else snapshot.open_command
    )


def report_page(session: Session) -> str:
    """The page, complete in itself.

    Raises:
        InputError: There are no clouds yet.
    """
    data = {"results": results_of(session), "legends": _legends(session), "scene": _scene(session)}
    static = static_folder()
    page = (static / "report" / "report.html").read_text(encoding="utf-8")
    # In a script, only the end tag could end the data early.
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    parts = {
        "style": (static / "report" / "report.css").read_text(encoding="utf-8"),
        "data": text,
        "script": "\n".join(_in_one_scope((static / name).read_text(encoding="utf-8")) for name in MODULES),
    }
    return re.sub(r"<!-- (style|data|script) -->", lambda found: parts[found[1]], page)


def write_report(session: Session, path: Path) -> None:
    """Write the page to a file.

    Raises:
        InputError: There is nothing to report, or the file cannot be written.
    """
    from cgf.evaluation.matches import write_whole

    page = report_page(session).encode()
    write_whole(path, lambda file: file.writelines([page]))


def _version() -> str:
    try:
        return metadata.version("cgf-viewer")
    except metadata.PackageNotFoundError:
        return "of a checkout"


def _scene(session: Session) -> dict[str, Any]:
    """What the report draws: points once, and every colouring, pose and layout of them."""
    snapshot = session.snapshot()
    shown = session.picture_with()
    keep = {side: _some(len(getattr(shown, side).points)) for side in ("source", "target")}
    colorings = {name: session.picture_with(coloring=name) for name in _colorings(snapshot)}
    poses = () if snapshot.controls is None else snapshot.controls.poses
    return {
        "source": _points(shown.source, keep["source"]),
        "target": _points(shown.target, keep["target"]),
        "colors": {
            name: {side: _base64(getattr(picture, side).colors[rows]) for side, rows in keep.items()}
            for name, picture in colorings.items()
        },
        "places": {pose: {layout: _place(session, pose, layout) for layout in _LAYOUTS} for pose in poses},
        "lines": _lines(shown),
        "point_size": shown.point_size,
        "up": shown.view.up.tolist(),
        "direction": shown.view.direction.tolist(),
        "coloring": snapshot.settings.coloring,
        "pose": snapshot.pose,
        "layout": snapshot.settings.layout,
        "left_out": int(sum(len(getattr(shown, side).points) - len(rows) for side, rows in keep.items())),
    }


def _legends(session: Session) -> dict[str, Any]:
    snapshot, (analysis, scores, settings, _) = session.snapshot(), session.shown()
    assert analysis is not None
    findings = session.findings()
    return {
        name: asdict(legend_of(analysis, scores, replace(settings, coloring=name), findings))
        for name in _colorings(snapshot)
    }


_LAYOUTS = ("side_by_side", "overlaid")


def _colorings(snapshot: Snapshot) -> tuple[Coloring, ...]:
    """Those that mean something without the page, and the one that is shown."""
    others: tuple[Coloring, ...] = (
        ("error", "features", "original") if snapshot.numbers is not None else ("features", "original")
    )
    return tuple(dict.fromkeys((snapshot.settings.coloring, *others)))


def _place(session: Session, pose: str, layout: str) -> dict[str, Any]:
    source = session.picture_with(pose=pose, pose_from=None, pose_to=None, layout=layout).source
    return {"rotation": source.rotation.ravel().tolist(), "position": source.position.tolist()}


def _some(count: int) -> npt.NDArray[np.int64]:
    """Rows to keep, the same ones every time."""
    if count <= MAX_POINTS:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, MAX_POINTS, replace=False))


def _points(cloud: CloudPicture, rows: npt.NDArray[np.int64]) -> dict[str, Any]:
    """Points as 16-bit steps between the corners of their box: 0.05 mm in a room of 3 m."""
    points = cloud.points[rows].astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    steps = np.rint((points - low) / np.maximum(high - low, 1e-12) * 65535).astype("<u2")
    return {"count": len(rows), "low": low.tolist(), "high": high.tolist(), "steps": _base64(steps)}


def _lines(picture: Picture) -> dict[str, Any]:
    """Matches, from a point in the source's own frame to one of the target."""
    starts = (picture.line_points[:, 0] - picture.source.position) @ picture.source.rotation
    ends = np.concatenate([starts, picture.line_points[:, 1]], axis=1).astype("<f4")
    return {"count": len(ends), "ends": _base64(ends), "colors": _base64(picture.line_colors)}


def _base64(array: npt.NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _plain(value: Any) -> Any:
    """Paths and such as text."""
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    return value if isinstance(value, (str, int, float, bool, list, tuple, type(None))) else str(value)


def _in_one_scope(script: str) -> str:
    """A module's text for a page that loads no file: what it exports becomes the page's, the rest stays inside."""
    exported = re.findall(r"^export (?:const|class|(?:async )?function) ([\w$]+)", script, flags=re.MULTILINE)
    inside = re.sub(r"^import [^;]*;\n|^export ", "", script, flags=re.MULTILINE)
    names = ", ".join(exported)
    return f"const {{ {names} }} = (() => {{\n{inside}return {{ {names} }};\n}})();" if names else inside
