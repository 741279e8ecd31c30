import numpy as np


def random_weights(width, hidden, inputs):
    rng = np.random.default_rng(6)
    shapes = {"columns.0": (width, 3 * inputs // 12), "columns.1": (width, 3 * width), "columns.2": (width, 3 * width)}
    shapes["hidden"] = (hidden, 2 * width)
    weights = {}
    for name, (outputs, inputs) in shapes.items():
        weights[f"{name}.weight"] = rng.normal(scale=inputs**-0.5, size=(outputs, inputs)).astype(np.float32)
        weights[f"{name}.bias"] = rng.normal(scale=0.1, size=outputs).astype(np.float32)
    return weights
