"""Features and matches on disk: found again, never stale, and bounded."""

import os
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from cgf.descriptors.network import load_network, read_network, shipped_weights, write_network
from cgf.pipeline import (
    DiskCache,
    PairSettings,
    cache,
    describe,
    describe_cached,
    feature_key,
    match_both_cached,
    match_both_features,
    prepare,
    resolve,
)
from tests.app.scenes import bumpy_cloud
from tests.judging import write_judging

ARRAYS = {"numbers": np.arange(6).reshape(2, 3), "none": np.zeros((0, 32), np.float32), "flags": np.array([True])}


@pytest.fixture
def disk(tmp_path):
    return DiskCache(tmp_path / "cache")


@pytest.fixture(scope="module")
def cloud():
    return bumpy_cloud(side=14)


@pytest.fixture(scope="module")
def resolved(cloud):
    return resolve(PairSettings(support_radius=0.9), cloud, cloud)


@pytest.fixture(scope="module")
def prepared(cloud, resolved):
    return prepare(cloud, resolved)


def assert_same(found, expected):
    assert found is not None
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert found[name].dtype == values.dtype
        np.testing.assert_array_equal(found[name], values)


def entry(disk):
    (path,) = disk.folder.iterdir()
    return path


def test_what_was_put_is_found_by_another_process_and_nothing_else(disk):
    assert disk.get("a") is None
    disk.put("a", ARRAYS)
    assert_same(DiskCache(disk.folder).get("a"), ARRAYS)
    assert disk.get("b") is None
    assert [path.name for path in disk.folder.iterdir()] == ["a.cgf"]


@pytest.mark.parametrize(
    "damage",
    [
        lambda _: b"",
        lambda content: content[:-1],
        lambda content: content[: len(content) // 2] + b"!" + content[len(content) // 2 + 1 :],
        lambda _: b"PK\x03\x04 an archive of someone else",
    ],
    ids=["empty", "truncated", "a byte changed", "foreign"],
)
def test_a_damaged_entry_is_ignored_and_replaced(disk, damage):
    disk.put("a", ARRAYS)
    entry(disk).write_bytes(damage(entry(disk).read_bytes()))
    assert disk.get("a") is None
    disk.put("a", ARRAYS)
    assert_same(disk.get("a"), ARRAYS)


def test_an_entry_under_the_name_of_another_is_ignored(disk):
    disk.put("a", ARRAYS)
    entry(disk).rename(disk.folder / "b.cgf")
    assert disk.get("b") is None


def test_the_longest_unused_entries_go_first(tmp_path):
    arrays = {"values": np.zeros(1_000)}
    disk = DiskCache(tmp_path, max_bytes=40_000)
    for age, key in enumerate("cab"):
        disk.put(key, arrays)
        os.utime(tmp_path / f"{key}.cgf", (1_000_000 + age, 1_000_000 + age))
    assert disk.get("c") is not None
    for key in "de":
        disk.put(key, arrays)
    assert sorted(path.stem for path in tmp_path.iterdir()) == ["b", "c", "d", "e"]
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 40_000


def test_an_entry_that_would_push_out_the_others_is_not_kept(tmp_path):
    disk = DiskCache(tmp_path, max_bytes=40_000)
    disk.put("a", {"values": np.zeros(2_000)})
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_was_never_finished_goes_after_a_while_and_not_before(disk):
    disk.put("a", ARRAYS)
    old, new = disk.folder / "old.part", disk.folder / "new.part"
    for path in (old, new):
        path.write_bytes(b"half")
    os.utime(old, (time.time() - 7200,) * 2)
    disk.put("b", ARRAYS)
    assert not old.exists()
    assert new.exists()


def test_a_folder_that_cannot_be_written_costs_only_time(tmp_path):
    (tmp_path / "file").write_text("no folder")
    disk = DiskCache(tmp_path / "file" / "cache")
    disk.put("a", ARRAYS)
    assert disk.get("a") is None


def test_writers_at_the_same_time_leave_whole_entries(disk):
    variants = [{"values": np.full(20_000, float(number))} for number in range(4)]
    wrong = []

    def work(number):
        for _ in range(20):
            disk.put("shared", variants[number])
            found = disk.get("shared")
            if found is None or len(np.unique(found["values"])) != 1:
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []
    assert [path.name for path in disk.folder.iterdir()] == ["shared.cgf"]


def test_the_folder_is_where_the_user_wants_caches(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.default_folder() == tmp_path / "cgf-viewer"
    monkeypatch.setenv("HOME", str(tmp_path))
    for relative in ("", "somewhere"):
        monkeypatch.setenv("XDG_CACHE_HOME", relative)
        assert cache.default_folder() == tmp_path / ".cache" / "cgf-viewer"


def test_features_and_matches_are_read_where_they_were_computed_before(disk, prepared, resolved, monkeypatch, tmp_path):
    resolved = replace(resolved, weights=write_judging(tmp_path / "judging.safetensors"))
    expected = describe(prepared, resolved)
    half = replace(
        expected, indices=expected.indices[::2], vectors=expected.vectors[::2], quality=expected.quality[::2]
    )
    tables = match_both_features(expected, half, resolved)
    for _ in range(2):
        found = describe_cached(prepared, resolved, disk)
        np.testing.assert_array_equal(found.indices, expected.indices)
        np.testing.assert_array_equal(found.vectors, expected.vectors)
        np.testing.assert_array_equal(found.quality, expected.quality)
        assert found.descriptor == "cgf"
        for matched, table in zip(match_both_cached(found, half, resolved, disk), tables, strict=True):
            for name in ("indices", "distances", "ratios"):
                wanted = getattr(table.correspondences, name)
                np.testing.assert_array_equal(getattr(matched.correspondences, name), wanted)
            for name in ("mutual", "source_quality", "target_quality"):
                np.testing.assert_array_equal(getattr(matched, name), getattr(table, name))
        # From here on nothing is computed any more.
        monkeypatch.setattr(cache, "describe", None)
        monkeypatch.setattr(cache, "match_both_features", None)
    with pytest.raises(TypeError):
        describe_cached(prepared, replace(resolved, support_radius=0.8), disk)
    with pytest.raises(TypeError):
        match_both_cached(half, found, resolved, disk)


def moved(values):
    changed = values.copy()
    changed[-1, 0] = np.nextafter(changed[-1, 0], np.inf)
    return changed


@pytest.mark.parametrize(
    "change",
    [
        lambda cloud, resolved: (replace(cloud, points=moved(cloud.points)), resolved),
        lambda cloud, resolved: (replace(cloud, normals=moved(cloud.normals)), resolved),
        lambda cloud, resolved: (cloud.take(np.arange(len(cloud))[::-1].copy()), resolved),
        lambda cloud, resolved: (cloud, replace(resolved, support_radius=0.91)),
        lambda cloud, resolved: (cloud, replace(resolved, min_radius=0.05)),
        lambda cloud, resolved: (cloud, replace(resolved, lrf_radius=0.26)),
        lambda cloud, resolved: (cloud, replace(resolved, descriptor="pca", computed_dim=32)),
        lambda cloud, resolved: (cloud, replace(resolved, descriptor="pca", computed_dim=16)),
        lambda cloud, resolved: (cloud, replace(resolved, descriptor="fpfh", computed_dim=33)),
    ],
    ids=["point", "normal", "order", "radius", "min radius", "frame radius", "descriptor", "dim", "fpfh"],
)
def test_a_change_of_anything_that_matters_gives_another_key(prepared, resolved, change):
    keys = {feature_key(*change(prepared, resolved)), feature_key(prepared, resolved)}
    keys.add(feature_key(prepared, replace(resolved, descriptor="pca", computed_dim=8)))
    assert len(keys) == 3


def test_what_does_not_matter_keeps_the_key(prepared, resolved):
    other = replace(resolved, mutual=True, max_ratio=0.5, dim=8, seed=3, diameter=99.0)
    renamed = replace(prepared, name="other", colors=np.zeros((len(prepared), 3), np.uint8))
    assert feature_key(renamed, other) == feature_key(prepared, resolved)


def test_a_changed_weight_gives_another_key(prepared, resolved, tmp_path):
    shipped = read_network(shipped_weights("cgf-indoor"))
    keys = {feature_key(prepared, resolved)}
    for number, change in enumerate((0.0, 1e-3)):
        weights = {name: values.copy() for name, values in shipped.weights.items()}
        weights["out.bias"][0] += np.float32(change)
        path = tmp_path / f"{number}.safetensors"
        write_network(path, replace(shipped, weights=weights))
        keys.add(feature_key(prepared, replace(resolved, weights=path)))
    load_network.cache_clear()
    # The same weights from another file are the same weights.
    assert len(keys) == 2


def test_another_precision_gives_another_key(prepared, resolved, monkeypatch):
    keys = set()
    for precision in ("bfloat16", "int8", "float32"):
        monkeypatch.setattr("cgf.descriptors.precision.chosen_precision", lambda precision=precision: precision)
        keys.add(feature_key(prepared, resolved))
    assert len(keys) == 3


def test_changed_code_gives_another_key(prepared, resolved, monkeypatch, tmp_path):
    before = feature_key(prepared, resolved)
    package = tmp_path / "cgf"
    (package / "geometry").mkdir(parents=True)
    versions = set()
    for line in ("RADIAL_BINS = 17", "RADIAL_BINS = 18"):
        (package / "geometry" / "grid.py").write_text(line)
        monkeypatch.setattr(cache.resources, "files", lambda _: package)
        cache.code_version.cache_clear()
        versions.add(cache.code_version())
        assert feature_key(prepared, resolved) != before
    assert len(versions) == 2
    monkeypatch.undo()
    cache.code_version.cache_clear()
    assert feature_key(prepared, resolved) == before


def test_values_that_look_alike_side_by_side_are_told_apart():
    assert cache._seal("ab", b"c") != cache._seal("a", b"bc")
