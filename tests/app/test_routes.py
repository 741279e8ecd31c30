"""The API without a server: what is typed, what is refused, what is served."""

import asyncio
import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI, WebSocket

from app.listeners import Listeners
from app.loading import Loader, Recent
from app.match_file import matches_file
from app.routes import create_app, state
from app.session import Session
from app.settings import ViewSettings
from app.snapshot import Snapshot, Status
from app.static_files import static_folder
from tests.app.asgi import Answer, request
from tests.app.scenes import LONG_S, hills, source_of

JSON = {"content-type": "application/json"}


@dataclass
class FakeScene:
    resets: list[bool] = field(default_factory=list)

    def page(self) -> str:
        return "<!doctype html><title>scene</title>"

    async def serve(self, socket: WebSocket) -> None:
        await socket.close()

    def reset_cameras(self) -> None:
        self.resets.append(True)


@pytest.fixture(scope="module")
def session() -> Iterator[Session]:
    session = Session([source_of(hills())], ViewSettings(support_radius=0.8))
    session.start()
    assert session.wait_until_idle(LONG_S)
    yield session
    session.close()


@pytest.fixture(scope="module")
def scene() -> FakeScene:
    return FakeScene()


@pytest.fixture(scope="module")
def app(session: Session, scene: FakeScene) -> Iterator[FastAPI]:
    loader = Loader(session, Recent(None))
    yield create_app(session, scene, loader)
    loader.close()


def patch(app: FastAPI, body: str) -> Answer:
    return request(app, "PATCH", "/api/settings", headers=JSON, body=body.encode())


def test_the_state_holds_what_the_page_shows(app: FastAPI) -> None:
    state = request(app, "GET", "/api/state").json()
    assert state["settled"]
    assert state["source"]["name"] == "source hills"
    assert 0 < state["numbers"]["precision"] <= 1
    assert len(state["legend"]["ramp"]) == 256
    assert state["controls"]["dims"][-1] >= 32


def test_a_change_is_answered_with_the_new_state(app: FastAPI) -> None:
    answer = patch(app, '{"coloring": "features", "line_count": 7}')
    assert answer.status == 200
    assert answer.json()["settings"]["coloring"] == "features"
    assert answer.json()["settings"]["line_count"] == 7
    assert request(app, "GET", "/api/state").json()["settings"]["line_count"] == 7


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('{"line_count": 100000}', "Line count should be less than or equal to 5000."),
        ('{"max_ratio": 1.5}', "Max ratio should be less than or equal to 1."),
        ('{"surest": 0}', "Surest should be greater than 0."),
        ('{"point_size": NaN}', "Point size should be"),
        ('{"support_radius": -1}', "Support radius should be greater than 0."),
        ('{"support_radius": 1e400}', "Support radius should be"),
        ('{"support_radius": 0.0001}', "Support radius must be above the point spacing"),
        ('{"layout": "stacked"}', "Layout should be 'side_by_side' or 'overlaid'."),
        ('{"pair": 99}', "pair must be from 0 to 0, got 99"),
        ('{"no_such_setting": 1}', "No such setting is not permitted."),
        ("{", "The request: JSON decode error."),
        ("[]", "The request should be"),
    ],
)
def test_what_cannot_be_set_is_refused_in_one_line(app: FastAPI, body: str, message: str) -> None:
    before = request(app, "GET", "/api/state").json()
    answer = patch(app, body)
    assert answer.status == 422
    assert answer.json()["message"].startswith(message)
    assert "\n" not in answer.json()["message"]
    assert request(app, "GET", "/api/state").json() == before


def test_matches_are_downloaded_as_a_file(app: FastAPI, session: Session) -> None:
    answer = request(app, "GET", "/api/matches.csv")
    assert answer.body == matches_file(session, ".csv")
    assert answer.headers["content-disposition"] == 'attachment; filename="matches.csv"'
    assert request(app, "GET", "/api/matches.npz").body[:2] == b"PK"


@pytest.mark.parametrize("suffix", ["exe", "csv.npz", ""])
def test_matches_are_not_written_in_other_formats(app: FastAPI, suffix: str) -> None:
    assert request(app, "GET", f"/api/matches.{suffix}").status in (404, 422)


def test_before_there_are_matches_none_are_exported(scene: FakeScene) -> None:
    session = Session([source_of(hills())], ViewSettings())
    app = create_app(session, scene, Loader(session, Recent(None)))
    answer = request(app, "GET", "/api/matches.csv")
    session.close()
    assert answer.status == 422
    assert answer.json() == {"message": "There are no matches yet; wait until they are computed."}


def test_the_cameras_are_reset_in_every_tab(app: FastAPI, scene: FakeScene) -> None:
    assert request(app, "POST", "/api/camera/reset").status == 204
    assert scene.resets == [True]


def test_cancelling_is_allowed_at_any_time(app: FastAPI) -> None:
    assert request(app, "POST", "/api/cancel").status == 204


def test_the_api_is_documented_with_its_types(app: FastAPI) -> None:
    openapi = request(app, "GET", "/api/openapi.json").json()
    assert {"/api/state", "/api/settings", "/api/events", "/api/matches.{suffix}"} <= set(openapi["paths"])
    properties = openapi["components"]["schemas"]["SettingsPatch"]["properties"]
    assert properties["line_count"]["maximum"] == 5000
    assert "Numbers" in openapi["components"]["schemas"]
    assert request(app, "GET", "/api/docs").status == 200


@pytest.mark.parametrize(
    "path",
    [
        "/",
        "/static/app.js",
        "/static/panels/summary.js",
        "/static/app.css",
        "/static/icon.svg",
        "/viewer/",
        "/api/docs",
    ],
)
def test_the_page_and_what_it_loads_are_served(app: FastAPI, path: str) -> None:
    assert request(app, "GET", path).status == 200


@pytest.mark.parametrize(
    "path",
    [
        "/static/../app/main.py",
        "/static/%2e%2e/app/main.py",
        "/static/..%2fapp%2fmain.py",
        "/static/....//app/main.py",
        "/static//etc/passwd",
        "/static/%2fetc%2fpasswd",
        "/static/..%5capp%5cmain.py",
        "/static/",
        "/app/main.py",
        "/viewer/../../etc/passwd",
    ],
)
def test_nothing_outside_the_static_folder_is_served(app: FastAPI, path: str) -> None:
    assert request(app, "GET", path).status in (404, 405)


def test_the_page_loads_nothing_from_elsewhere() -> None:
    for path in filter(Path.is_file, static_folder().rglob("*")):
        text = path.read_text(encoding="utf-8").replace("http://www.w3.org/", "")
        assert "http://" not in text, path
        assert "https://" not in text, path
        assert "style=" not in text, path
        # A report is a file of its own, with its script inside.
        assert path.suffix != ".html" or path.parent.name == "report" or "<script>" not in text, path


def test_a_point_is_picked_and_told_of(app: FastAPI) -> None:
    state = patch(app, '{"picked": {"side": "target", "index": 12}}').json()
    assert state["picked"]["index"] == state["settings"]["picked"]["index"] == 12
    point = request(app, "GET", "/api/point").json()
    assert (point["side"], point["index"]) == ("target", 12)
    assert len(point["point_histogram"]["bins"]) == 12 * 11 * 17
    stepped = request(app, "POST", "/api/step", headers=JSON, body=b'{"by": 1}').json()
    assert stepped["picked"]["side"] == "source"
    assert patch(app, '{"picked": null}').json()["picked"] is None
    answer = request(app, "GET", "/api/point")
    assert (answer.status, answer.json()) == (200, None)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('{"picked": {"side": "left", "index": 1}}', "Picked should be 'source' or 'target'."),
        ('{"picked": {"side": "source", "index": -1}}', "Picked should be greater than or equal to 0."),
        ('{"picked": {"side": "source", "index": 1.5}}', "Picked should be a valid integer"),
        ('{"picked": {"side": "source"}}', "Picked: Field required."),
        ('{"picked": 3}', "Picked should be a valid dictionary"),
        ('{"picked": {"side": "source", "index": 99999}}', "picked must be a row of the source from 0 to"),
        ('{"selected": {"side": "source", "indices": []}}', "Selected: List should have at least 1 item"),
        ('{"step_order": "nearest"}', "Step order should be 'worst', 'best' or 'random'."),
    ],
)
def test_a_point_that_cannot_be_picked_is_refused(app: FastAPI, body: str, message: str) -> None:
    answer = patch(app, body)
    assert answer.status == 422
    assert message in answer.json()["message"]


def test_files_are_sent_and_opened_and_a_bad_one_is_a_line_of_text(app: FastAPI) -> None:
    answer = request(app, "PUT", "/api/uploads/..%2Fbad%3Cb%3E.ply", body=b"no cloud")
    assert answer.status == 404
    answer = request(app, "PUT", "/api/uploads/bad%3Cb%3E.ply", body=b"no cloud")
    path = answer.json()["path"]
    assert Path(path).name == "bad<b>.ply"
    answer = request(app, "POST", "/api/open", headers=JSON, body=json.dumps({"source": path, "target": path}).encode())
    assert answer.status == 422
    assert answer.headers["content-type"] == "application/json"
    assert "bad<b>.ply" in answer.json()["message"]
    assert len(request(app, "GET", "/api/state").json()["pairs"]) == 1
    Path(path).unlink()
    assert request(app, "PUT", "/api/uploads/page.html", body=b"<script>").status == 422
    assert request(app, "GET", "/api/recent").json() == []


def test_results_report_and_pose_are_downloads(app: FastAPI) -> None:
    for path, kind in [
        ("results.json", "application/json"),
        ("report.html", "application/octet-stream"),
        ("estimate.txt", "text/plain; charset=utf-8"),
    ]:
        answer = request(app, "GET", f"/api/{path}")
        assert answer.status == 200
        assert answer.headers["content-type"] == kind
        assert answer.headers["content-disposition"].startswith("attachment")
    assert request(app, "GET", "/api/estimate/place").status == 422


class FakeSession:
    """Has nothing but a status, and notes when that is looked at."""

    def __init__(self, snapshot: Snapshot) -> None:
        self.told, self.looked, self._listeners = snapshot, asyncio.Event(), Listeners()
        self.listen = self._listeners.add

    def snapshot(self) -> Snapshot:
        self.looked.set()
        return self.told

    def change(self, **changes: Any) -> None:
        self.told = replace(self.told, **changes)
        self._listeners.notify()


def test_only_the_latest_of_several_statuses_is_told_and_a_new_state_at_once(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state, "STATUS_INTERVAL_S", 0.1)
    fake = FakeSession(session.snapshot())

    async def told() -> list[str]:
        events = state.events_of(fake)  # type: ignore[arg-type]
        first = await anext(events)
        following = asyncio.ensure_future(anext(events))
        for text in ("half", "nearly all"):
            fake.looked.clear()
            fake.change(status=Status("working", text, 0.5))
            await asyncio.wait_for(fake.looked.wait(), LONG_S)
        second = await following
        monkeypatch.setattr(state, "STATUS_INTERVAL_S", 2 * LONG_S)
        fake.change(revision=fake.told.revision + 1)
        third = await asyncio.wait_for(anext(events), LONG_S)
        await events.aclose()
        return [first, second, third]

    first, second, third = asyncio.run(told())
    assert first.startswith("event: state\n")
    assert second.startswith("event: status\n")
    assert json.loads(second.split("data: ")[1])["text"] == "nearly all"
    assert third.startswith("event: state\n")
    assert json.loads(third.split("data: ")[1])["revision"] == fake.told.revision
