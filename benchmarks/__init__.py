"""How fast the project is, beside its peers, in one run: `python -m benchmarks`."""
