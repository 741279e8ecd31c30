"""Opening pairs while the viewer runs, and writing the estimate back."""

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import numpy as np
import pytest

from app import loading
from app.loading import Loader, PairPaths, Recent, pair_source, recent_file
from app.pose_file import pose_text, save_beside
from app.session import Session
from app.settings import ViewSettings
from cgf.checks import InputError
from cgf.io import read_transform, write_cloud, write_transform
from tests.app.scenes import LONG_S, bumpy_cloud, hills, source_of


@pytest.fixture(scope="module")
def paths(tmp_path_factory: pytest.TempPathFactory) -> PairPaths:
    folder, pair = tmp_path_factory.mktemp("clouds"), hills()
    assert pair.target_from_source is not None
    found = PairPaths(folder / "a.ply", folder / "b.ply", folder / "gt.txt")
    write_cloud(found.source, pair.source)
    write_cloud(found.target, pair.target)
    write_transform(folder / "gt.txt", pair.target_from_source)
    return found


@pytest.fixture
def session() -> Iterator[Session]:
    session = Session([source_of(hills())], ViewSettings(support_radius=0.8, palette="viridis", source_scale=2.0))
    yield session
    session.close()


@pytest.fixture
def loader(session: Session, tmp_path: Path) -> Iterator[Loader]:
    loader = Loader(session, Recent(tmp_path / "state" / "recent.json"))
    yield loader
    loader.close()


async def chunks(*parts: bytes) -> AsyncIterator[bytes]:
    for part in parts:
        yield part


def test_an_opened_pair_is_shown_with_settings_of_its_own(session: Session, loader: Loader, paths: PairPaths) -> None:
    opened = loader.open(paths)
    assert opened.pairs[-1] == "a.ply to b.ply"
    assert opened.settings == ViewSettings(pair=1, palette="viridis")
    assert session.wait_until_idle(LONG_S)
    state = session.snapshot()
    assert state.settled
    assert state.source is not None
    assert state.source.name == "a.ply"
    assert state.reference == "ground_truth"
    assert state.open_command == f"cgf-viewer {paths.source} {paths.target} --gt {paths.gt}"
    assert loader.recent() == [paths]


def test_a_pair_that_cannot_be_read_changes_nothing(session: Session, loader: Loader, tmp_path: Path) -> None:
    before = session.snapshot()
    (tmp_path / "bad.ply").write_bytes(b"no cloud")
    for name in ("bad.ply", "missing.ply"):
        with pytest.raises(InputError, match=name):
            loader.open(PairPaths(tmp_path / name, tmp_path / name))
    assert session.snapshot() == before
    assert loader.recent() == []


def test_the_pair_read_for_the_check_is_not_held_for_ever(paths: PairPaths) -> None:
    source = pair_source(paths)
    pair = source.load()
    held = source.holding(pair)
    assert held.load() is pair
    assert held.load() is not pair


def test_dropped_files_are_kept_by_base_name_until_the_end(loader: Loader, paths: PairPaths) -> None:
    content = paths.source.read_bytes()
    received = [
        asyncio.run(loader.receive(name, chunks(content[:100], content[100:])))
        for name in ("../../a.ply", "C:\\scans\\a.ply")
    ]
    assert [path.name for path in received] == ["a.ply", "a.ply"]
    assert received[0] != received[1]
    assert all(path.read_bytes() == content for path in received)
    folder = received[0].parent.parent
    assert folder.stat().st_mode & 0o077 == 0
    opened = loader.open(PairPaths(received[0], received[1]))
    # They are gone when the viewer ends, so nothing refers to them.
    assert opened.pairs[-1] == "a.ply to a.ply"
    assert loader.recent() == []
    loader.close()
    assert not folder.exists()


@pytest.mark.parametrize("name", ["evil.html", "..", "a", "", ".ply"])
def test_what_is_no_cloud_or_pose_is_not_kept(loader: Loader, name: str) -> None:
    with pytest.raises(InputError, match="must be a point cloud or mesh"):
        asyncio.run(loader.receive(name, chunks(b"x")))


def test_a_dropped_file_that_is_too_large_leaves_nothing(loader: Loader, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loading, "MAX_UPLOAD", 1 << 20)
    with pytest.raises(InputError, match=r"a\.ply must be at most 1 MB; open it by its path"):
        asyncio.run(loader.receive("a.ply", chunks(b"x" * (1 << 20), b"x")))
    folder = loader._folder
    assert folder is not None
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[1]", b'[{"source": 3}]', b'{"source": "a"}', b"\xff\xfe", b"[" * 100_000, b"null"]
)
def test_a_damaged_list_of_recent_pairs_is_an_empty_one(tmp_path: Path, paths: PairPaths, content: bytes) -> None:
    path = tmp_path / "recent.json"
    path.write_bytes(content)
    recent = Recent(path)
    assert recent.read() == []
    recent.add(paths)
    assert recent.read() == [paths]


def test_recent_pairs_are_bounded_and_each_is_there_once(tmp_path: Path) -> None:
    recent = Recent(tmp_path / "recent.json")
    cloud = bumpy_cloud(side=4)
    for index in range(loading.MAX_RECENT + 3):
        write_cloud(tmp_path / f"{index}.ply", cloud)
        recent.add(PairPaths(tmp_path / f"{index}.ply", tmp_path / "0.ply"))
    recent.add(PairPaths(tmp_path / "5.ply", tmp_path / "0.ply"))
    found = recent.read()
    assert len(found) == loading.MAX_RECENT == len(set(found))
    assert [pair.source.name for pair in found[:3]] == ["5.ply", "12.ply", "11.ply"]
    (tmp_path / "5.ply").unlink()
    assert recent.read()[0].source.name == "12.ply"


def test_where_nothing_can_be_written_nothing_is_remembered(tmp_path: Path, paths: PairPaths) -> None:
    (tmp_path / "file").write_text("not a folder")
    recent = Recent(tmp_path / "file" / "recent.json")
    recent.add(paths)
    assert recent.read() == []


def test_recent_pairs_lie_in_the_folder_for_states(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert recent_file() == tmp_path / "cgf-viewer" / "recent.json"
    monkeypatch.setenv("XDG_STATE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert recent_file() == tmp_path / ".local" / "state" / "cgf-viewer" / "recent.json"


def test_the_estimate_is_written_beside_the_source_and_never_over_a_file_unasked(
    session: Session, loader: Loader, paths: PairPaths
) -> None:
    with pytest.raises(InputError, match="no estimate yet"):
        pose_text(session)
    loader.open(paths)
    assert session.wait_until_idle(LONG_S)
    analysis = session.shown()[0]
    assert analysis is not None
    saved = save_beside(session, overwrite=False)
    assert saved == paths.source.parent / "a_to_b.txt"
    np.testing.assert_array_equal(read_transform(saved), analysis.estimate)
    assert saved.read_bytes() == pose_text(session)
    saved.write_text("mine")
    with pytest.raises(InputError, match="exists already; confirm"):
        save_beside(session, overwrite=False)
    assert saved.read_text() == "mine"
    save_beside(session, overwrite=True)
    assert json.dumps(read_transform(saved).tolist())
    session.change({"source_scale": 0.5})
    with pytest.raises(InputError, match=r"scaled by 0\.5"):
        pose_text(session)


def test_a_pair_without_files_has_no_place_for_its_estimate(session: Session) -> None:
    with pytest.raises(InputError, match="download the pose instead"):
        save_beside(session, overwrite=False)
