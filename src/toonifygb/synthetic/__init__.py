"""A synthetic talking subject with ground truth: the demo's clip and the tests' oracle."""
