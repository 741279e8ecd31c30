"""`cgf train --config` makes weights again from their card."""

import json

import pytest

from cgf import cli
from cgf.cli.train import _given, _of_card, add_options
from cgf.descriptors.network import read_network, shipped_weights
from cgf.training.settings import TrainSettings
from tests.cloud_files import write_scene

SHIPPED = ("cgf-object", "cgf-indoor", "pca-object", "pca-indoor")
SIZES = ["--batch", "16", "--overlaps-per-batch", "4", "--width", "16", "--dims", "8", "16", "--quiet"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with data two levels deep, and the weights that two steps on it gave."""
    pytest.importorskip("torch")
    root = tmp_path_factory.mktemp("trained")
    (root / "data" / "rooms").mkdir(parents=True)
    scenes = [root / "data" / "rooms" / name for name in ("one", "two")]
    for seed, scene in enumerate(scenes):
        write_scene(scene, seed)
    words = ["--scenes", *map(str, scenes), "--model", "indoor", "--steps", "2", "--seed", "5", *SIZES]
    assert cli.main(["train", "-o", str(root / "first.safetensors"), *words]) == 0
    return root


def remake(root, card, *more):
    output = card.with_name(f"{card.stem}-again.safetensors")
    words = ["--config", str(card), "--data-root", str(root), "-o", str(output), "--quiet", *more]
    assert cli.main(["train", *words]) == 0
    return output


def test_a_card_makes_its_weights_again_to_the_bit(trained):
    first = trained / "first.safetensors"
    again = remake(trained, first.with_suffix(".json"))
    assert again.read_bytes() == first.read_bytes()
    cards = [json.loads(path.with_suffix(".json").read_text()) for path in (first, again)]
    assert cards[0]["config"]["scenes"] == ["one", "two"]
    # The commands differ by the name of the output.
    assert {**cards[0], "command": ""} == {**cards[1], "command": ""}


def test_a_card_of_a_command_alone_makes_its_weights_again_unless_told_otherwise(trained, tmp_path):
    card = json.loads((trained / "first.json").read_text())
    del card["config"]
    (tmp_path / "old.json").write_text(json.dumps(card))
    again = remake(trained, tmp_path / "old.json")
    assert again.read_bytes() == (trained / "first.safetensors").read_bytes()
    (tmp_path / "other.json").write_text(json.dumps(card))
    shorter = read_network(remake(trained, tmp_path / "other.json", "--steps", "1"))
    assert shorter.card.training["steps"] == shorter.card.config["steps"] == 1
    assert shorter.card.seed == 5


def options(*words):
    parser = cli.Parser()
    add_options(parser)
    return parser.parse_args(["-o", "new.safetensors", *words])


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_weights_can_be_made_again(name, tmp_path):
    card = shipped_weights(name).with_suffix(".json")
    content = read_network(shipped_weights(name)).card
    for folder in content.data.split(", "):
        (tmp_path / folder).mkdir()
    found = options("--config", str(card), "--data-root", str(tmp_path))
    settings = TrainSettings(**_of_card(found, _given(found)) | _given(found))
    assert settings.seed == content.seed
    assert settings.dims == content.dims
    assert settings.model == content.model
    folders = settings.scenes if settings.meshes is None else [settings.meshes]
    assert [str(folder.relative_to(tmp_path)) for folder in folders] == content.data.split(", ")


def test_other_data_needs_no_folder_of_the_card(tmp_path):
    card = shipped_weights("cgf-object").with_suffix(".json")
    found = options("--config", str(card), "--data-root", str(tmp_path), "--scenes", "mine", "--model", "indoor")
    settings = TrainSettings(**_of_card(found, _given(found)) | _given(found))
    assert (settings.meshes, [str(scene) for scene in settings.scenes]) == (None, ["mine"])
    assert settings.model == "indoor"


def test_every_setting_can_be_read_from_a_card(tmp_path):
    (tmp_path / "meshes").mkdir()
    content = json.loads(shipped_weights("cgf-object").with_suffix(".json").read_text())
    settings = TrainSettings(
        output=tmp_path / "a.safetensors", meshes=tmp_path / "meshes", steps=3, temperature=0.1, support_radius=0.3,
        min_radius=0.02, insets=(0, 2), histogram="roots",
    )  # fmt: skip
    (tmp_path / "a.json").write_text(json.dumps(content | {"config": settings.config()}))
    found = options("--config", str(tmp_path / "a.json"), "--data-root", str(tmp_path), "-o", str(settings.output))
    assert TrainSettings(**_of_card(found, _given(found)) | _given(found)) == settings


@pytest.mark.parametrize(
    ("changes", "folders", "message"),
    [
        (None, (), "--config must be a card written by cgf train, got no file"),
        ({"command": ""}, (), "--config must say how its weights were made, got"),
        ({"command": "cgf train --magic 3"}, (), "got a card with: unrecognized arguments: --magic 3"),
        ({"config": {"steps": "many"}}, (), "got a card with: argument --steps: invalid int value: 'many'"),
        ({"weather": "fine"}, (), "must be a network card written by cgf train"),
        ({}, (), "--data-root must hold a folder train_meshes, got none beneath"),
        ({}, ("a/train_meshes", "b/train_meshes"), "--data-root must hold one folder train_meshes, got"),
    ],
)
def test_a_card_that_does_not_serve_is_refused_in_one_line(tmp_path, capsys, changes, folders, message):
    if changes is not None:
        content = json.loads(shipped_weights("cgf-object").with_suffix(".json").read_text())
        content.pop("config", None)
        (tmp_path / "card.json").write_text(json.dumps(content | changes))
    for folder in folders:
        (tmp_path / folder).mkdir(parents=True)
    words = ["--config", str(tmp_path / "card.json"), "--data-root", str(tmp_path)]
    assert cli.main(["train", "-o", str(tmp_path / "new.safetensors"), *words]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1


def test_a_root_of_no_card_or_no_folder_is_refused(tmp_path, capsys):
    output = ["-o", str(tmp_path / "new.safetensors")]
    assert cli.main(["train", *output, "--meshes", "m", "--data-root", str(tmp_path)]) == 2
    assert "--data-root must come with --config" in capsys.readouterr().err
    card = str(shipped_weights("cgf-object").with_suffix(".json"))
    assert cli.main(["train", *output, "--config", card, "--data-root", str(tmp_path / "none")]) == 2
    assert "--data-root must be a folder, got" in capsys.readouterr().err
