"""The report, as far as it can be looked at without a browser."""

import base64
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.main import main
from app.report import report_page, results_of
from app.session import Session
from app.settings import ViewSettings
from cgf.checks import InputError
from cgf.io import write_cloud
from cgf.types import Pair
from tests.app.scenes import LONG_S, hills, source_of


@pytest.fixture(scope="module")
def pair() -> Pair:
    return hills()


@pytest.fixture(scope="module")
def session(pair: Pair) -> Iterator[Session]:
    session = Session([source_of(pair)], ViewSettings(support_radius=0.8, line_count=30))
    session.start()
    assert session.wait_until_idle(LONG_S)
    yield session
    session.close()


def data_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, flags=re.DOTALL)
    assert found is not None
    data: dict[str, Any] = json.loads(found[1])
    return data


def test_results_hold_settings_figures_and_poses(session: Session, pair: Pair) -> None:
    results = results_of(session)
    assert results["settings"]["support_radius"] == 0.8
    assert results["numbers"]["matches"] == session.snapshot().numbers.matches  # type: ignore[union-attr]
    assert pair.target_from_source is not None
    np.testing.assert_array_equal(results["target_from_source"]["ground_truth"], pair.target_from_source)
    json.dumps(results, allow_nan=False)


def test_a_report_loads_nothing_and_lets_no_name_out_of_its_data(session: Session) -> None:
    page = report_page(session)
    assert not re.search(r"\b(src|href)=", page)
    assert "http://" not in page.replace("http://www.w3.org/", "")
    assert not re.search(r"^(import|export) ", page, flags=re.MULTILINE)
    assert "</script>" not in json.dumps(data_of(page))
    assert "default-src 'none'" in page


def test_points_of_a_report_are_those_of_the_scene(session: Session) -> None:
    scene = data_of(report_page(session))["scene"]
    picture = session.picture()
    assert picture is not None
    source = scene["source"]
    steps = np.frombuffer(base64.b64decode(source["steps"]), dtype="<u2").reshape(-1, 3)
    low, high = np.array(source["low"]), np.array(source["high"])
    np.testing.assert_allclose(
        low + steps / 65535 * (high - low), picture.source.points, atol=(high - low).max() / 60000
    )
    colors = np.frombuffer(base64.b64decode(scene["colors"]["error"]["source"]), dtype=np.uint8)
    np.testing.assert_array_equal(colors.reshape(-1, 3), picture.source.colors)
    ends = np.frombuffer(base64.b64decode(scene["lines"]["ends"]), dtype="<f4").reshape(-1, 2, 3)
    assert len(ends) == len(picture.line_points) > 0
    place = scene["places"][scene["pose"]][scene["layout"]]
    starts = ends[:, 0] @ np.reshape(place["rotation"], (3, 3)).T + place["position"]
    np.testing.assert_allclose(starts, picture.line_points[:, 0], atol=1e-5)


def test_before_there_are_clouds_there_is_nothing_to_report() -> None:
    session = Session([source_of(hills())], ViewSettings())
    with pytest.raises(InputError, match="wait until the clouds are loaded"):
        report_page(session)
    session.close()


def test_the_command_writes_a_report_with_the_state_it_is_given(
    pair: Pair, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [str(tmp_path / "a <b>.ply"), str(tmp_path / "b.ply")]
    write_cloud(paths[0], pair.source)
    write_cloud(paths[1], pair.target)
    out = tmp_path / "out.html"
    assert main([*paths, "--radius", "0.8", "--state", "mutual=true&dim=16", "--report", str(out), "--no-cache"]) == 0
    assert "Wrote" in capsys.readouterr().err
    results = data_of(out.read_text("utf-8"))["results"]
    assert results["settings"]["mutual"]
    assert results["resolved"]["dim"] == 16
    assert results["resolved"]["support_radius"] == 0.8
    assert "a <b>.ply" in results["view_command"]
    assert "a <b>" not in out.read_text("utf-8")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--report", "out.txt"], "output must end in .html, got out.txt"),
        (["--report", "no-such-folder/out.html"], "there is no folder no-such-folder"),
        (["--report", "out.html", "--state", "dim=0"], "Dim should be greater than or equal to 1"),
        (["--report", "out.html", "--state", "pair=3"], "pair must be from 0 to 0, got 3"),
    ],
)
def test_bad_input_ends_with_status_2_and_writes_nothing(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["--demo", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_diagnosis_goes_with_the_results(session: Session) -> None:
    told = results_of(session)["diagnosis"]
    assert told == session.diagnosing.plain()
    assert {finding["kind"] for finding in told["findings"]} >= {"scale", "normals", "overlap"}
