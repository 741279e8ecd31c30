"""What `cgf train` refuses before it reads any data."""

from pathlib import Path

import pytest

from cgf.training.settings import TrainSettings


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"meshes": None}, "one of --meshes and --scenes must be given, got neither"),
        ({"scenes": (Path("a"),)}, "one of --meshes and --scenes must be given, got both"),
        ({"output": Path("weights.bin")}, "--output must end in .safetensors, got weights.bin"),
        ({"batch": 30}, r"--batch must be a multiple of --overlaps-per-batch \(4\), got 30"),
        ({"dims": (16, 8)}, "--dims must be ascending and positive"),
        ({"insets": (0, 16)}, r"--insets must be 0 and ascending numbers up to 15, got \(0, 16\)"),
        ({"insets": (3,)}, r"--insets must be 0 and ascending numbers up to 15, got \(3,\)"),
        ({"insets": (0, 3), "recipe": "paper"}, "--insets must be 0 but for the azimuth network"),
        ({"context": (2.0, 1.0)}, r"--context must be positive and ascending, got \(2.0, 1.0\)"),
        (
            {"context": (1.0,), "recipe": "paper"},
            "--context must come with the contrastive recipe, got .* paper",
        ),
        ({"join_steps": 0}, "--join-steps must be 1 or more, got 0"),
        ({"min_radius": 0.3}, "--min-radius must be above 0 and below --support-radius, got 0.3 and 0.2"),
        ({"histogram": "counts"}, "--histogram must be normals or roots for the azimuth network .* got counts"),
        ({"histogram": "normals", "network": "paper"}, "--histogram must be roots or counts for the paper network"),
        ({"histogram": "normals", "recipe": "paper"}, "--histogram must be roots or counts .* paper, got normals"),
        ({"histogram": "roots", "recipe": "pca"}, "--histogram must be counts .* recipe pca, got roots"),
        ({"normal_radii": (2.0, 0.0)}, r"--normal-radii must be positive, got \(2.0, 0.0\)"),
        ({"weight_decay": -0.1}, "--weight-decay must be 0 or more, got -0.1"),
        ({"dropout": 1.0}, "--dropout must be 0 or more and below 1, got 1"),
        ({"dropout": 0.1, "network": "paper"}, "--dropout must be 0 but for the azimuth network .* got 0.1"),
        ({"scenes_per_batch": 0}, "--scenes-per-batch must be 1 or more, got 0"),
        ({"bend": 0.5}, "--bend must be 0 or more and below 0.5, got 0.5"),
        ({"stretch": 1.5}, "--stretch must lie between 0 and 1, got 1.5"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(changes, message):
    values = {"meshes": Path("meshes"), "output": Path("a.safetensors"), "batch": 32, "overlaps_per_batch": 4}
    with pytest.raises(ValueError, match=message):
        TrainSettings(**values | changes)
